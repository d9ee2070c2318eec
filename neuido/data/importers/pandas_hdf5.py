"""Reader of a table that pandas wrote to HDF5, as DeepLabCut does; nothing in the file is unpickled or followed out of it."""

import math
import pickletools
from pathlib import Path
from typing import Any

import numpy as np

from neuido.data.files.parsing import parser_errors
from neuido.errors import UserError
from neuido.physics.runtime.lazy import import_extra
from neuido.physics.runtime.limits import check_limit

MAX_NAMES = 100_000
"""Largest number of opcodes in the list of column names."""


def read_frame(path: Path) -> tuple[list[tuple[str, ...]], np.ndarray, np.ndarray]:
    """Read the first table of a file; return the names of its columns by level, its index (n,) and its values (n, C).

    Args:
        path: The file, with a table in pandas' layout `table` or `fixed` and numbers of one type.

    Raises:
        UserError: h5py is not installed, or the file is no such table.
    """
    h5py = import_extra("h5py", path.name)
    with parser_errors(path, "HDF5 file of pandas"), h5py.File(path, "r") as file:
        group = next(
            (file[name] for name in file if isinstance(file.get(name, getlink=True), h5py.HardLink) and hasattr(file[name], "keys")), None
        )
        if group is None:
            raise UserError(f"{path} has no table of pandas")

        def array(name: str) -> np.ndarray:
            if not isinstance(group.get(name, getlink=True), h5py.HardLink):
                raise UserError(f"{path} has no array {name}, or it lies in another file")
            found = group[name]
            if not isinstance(found, h5py.Dataset) or found.external or found.is_virtual:
                raise UserError(f"{path}: {name} is no array, or it lies in another file")
            count = math.prod(found.shape) * max(found.dtype.itemsize // 8, 1)
            check_limit(count, "NEUIDO_MAX_ARRAY_ELEMENTS", f"{path}: {name} has {count} numbers")
            return found[()]

        if "table" in group:
            table = array("table")
            if table.dtype.names is None or table.ndim != 1 or not {"index", "values_block_0"} <= set(table.dtype.names):
                raise UserError(f"{path}: its table has no values of one type")
            names = _pickled_names(bytes(group["table"].attrs["values_block_0_kind"]), path)
            index, values = table["index"], table["values_block_0"]
        else:
            values, index = array("block0_values"), array("axis1")
            levels = [array(f"block0_items_level{i}") for i in range(int(group.attrs["block0_items_nlevels"]))]
            codes = [array(f"block0_items_label{i}") for i in range(len(levels))]
            names = [tuple(level[code].decode() for level, code in zip(levels, row)) for row in zip(*codes)]
        if values.ndim != 2 or values.dtype.kind not in "iuf" or index.dtype.kind not in "iuf" or values.shape != (len(index), len(names)):
            raise UserError(f"{path}: {len(names)} names do not fit values of shape {values.shape}")
    return names, index.astype(np.float64), values.astype(np.float64)


def _pickled_names(data: bytes, path: Path) -> list[tuple[str, ...]]:
    """Read a pickled list of tuples of text by its opcodes, none of which can call anything; others are refused."""
    stack: list[Any] = []
    memo: dict[int, Any] = {}
    mark = object()

    def above() -> list[Any]:
        at = len(stack) - 1 - stack[::-1].index(mark)
        found = stack[at + 1 :]
        del stack[at:]
        return found

    for count, (opcode, value, _) in enumerate(pickletools.genops(data)):
        name = opcode.name
        if count > MAX_NAMES:
            break
        if name in ("PROTO", "FRAME"):
            continue
        if name == "STOP":
            names = stack.pop()
            if isinstance(names, list) and all(isinstance(each, tuple) and all(isinstance(part, str) for part in each) for each in names):
                return names
            break
        if name == "MARK":
            stack.append(mark)
        elif name in ("UNICODE", "BINUNICODE", "SHORT_BINUNICODE"):
            stack.append(value)
        elif name in ("EMPTY_LIST", "EMPTY_TUPLE"):
            stack.append([] if name == "EMPTY_LIST" else ())
        elif name in ("LIST", "TUPLE"):
            found = above()
            stack.append(found if name == "LIST" else tuple(found))
        elif name in ("TUPLE1", "TUPLE2", "TUPLE3"):
            size = int(name[-1])
            stack[-size:] = [tuple(stack[-size:])]
        elif name == "APPEND":
            last = stack.pop()
            stack[-1].append(last)
        elif name == "APPENDS":
            found = above()
            stack[-1].extend(found)
        elif name in ("PUT", "BINPUT", "LONG_BINPUT"):
            memo[value] = stack[-1]
        elif name == "MEMOIZE":
            memo[len(memo)] = stack[-1]
        elif name in ("GET", "BINGET", "LONG_BINGET"):
            stack.append(memo[value])
        else:
            break
    raise UserError(f"{path}: the names of its columns are no list of text")
