"""Reader of MATLAB files of version 5 to 7 for what an import needs: numbers in nested structures.

Nothing but the parts that are asked for is read, and every size is compared with what the file holds before it is used. Format: "MAT-File
Format", The MathWorks, chapter 1 (level 5).
"""

import math
import struct
import zlib
from pathlib import Path

import numpy as np

from neuido.errors import UserError
from neuido.physics.runtime.limits import check_limit, limit

NUMBERS = {1: "i1", 2: "u1", 3: "i2", 4: "u2", 5: "i4", 6: "u4", 7: "f4", 9: "f8", 12: "i8", 13: "u8"}
"""NumPy's name of each type of stored numbers."""
MATRIX, COMPRESSED = 14, 15
CELL, STRUCTURE, TEXT, FIRST_NUMERIC, LAST_NUMERIC = 1, 2, 4, 6, 15
COMPLEX = 0x0800
"""Bit of an array's flags."""
HEADER = 128
"""Bytes before the first variable: text, version and byte order."""


class Matrix:
    """An array of a MATLAB file whose values are read when they are asked for.

    Args:
        data: Content of its element, without the tag.
        order: `<` or `>`, the byte order of the file.

    Raises:
        ValueError: A size does not fit the content.
    """

    def __init__(self, data: memoryview, order: str) -> None:
        self.order, self.shape, self.name, self.kind, self.bits = order, (0, 0), "", FIRST_NUMERIC, 0
        self.rest = data
        if not len(data):  # an empty array has no content at all
            return
        flags, rest = self._numbers(data)
        if len(flags) != 2:
            raise ValueError("an array has no flags")
        self.kind, self.bits = int(flags[0]) & 0xFF, int(flags[0])
        if self.kind not in (CELL, STRUCTURE, TEXT, *range(FIRST_NUMERIC, LAST_NUMERIC + 1)):
            self.shape = ()  # objects, functions and sparse arrays have a layout of their own
            return
        dims, rest = self._numbers(rest)
        if len(dims) < 2 or len(dims) > 32 or (dims < 0).any():
            raise ValueError(f"an array has the sizes {dims[:8].tolist()}")
        self.shape = tuple(int(n) for n in dims)
        name, self.rest = self._numbers(rest)
        self.name = name.tobytes().decode("latin-1")

    def _numbers(self, data: memoryview) -> tuple[np.ndarray, memoryview]:
        """Return the numbers of the element at the front, and what follows it."""
        kind, content, rest = element(data, self.order)
        if kind not in NUMBERS:
            raise ValueError(f"an element of kind {kind} stands where numbers should be")
        dtype = np.dtype(self.order + NUMBERS[kind])
        if len(content) % dtype.itemsize:
            raise ValueError(f"{len(content)} bytes are no whole count of numbers of {dtype.itemsize} bytes")
        return np.frombuffer(content, dtype), rest

    def values(self) -> np.ndarray:
        """Return a numeric array.

        Raises:
            ValueError: It is no array of real numbers, or its values do not fit its sizes.
        """
        if not self.shape or not FIRST_NUMERIC <= self.kind <= LAST_NUMERIC:
            raise ValueError(f"an array of class {self.kind} stands where numbers should be")
        if self.bits & COMPLEX:
            raise ValueError("an array is complex")
        if not math.prod(self.shape):
            return np.zeros(self.shape)
        found, _ = self._numbers(self.rest)
        if len(found) != math.prod(self.shape):
            raise ValueError(f"an array of shape {list(self.shape)[:8]} has {len(found)} values")
        return found.reshape(self.shape, order="F")

    def number(self) -> float:
        """Return a single number.

        Raises:
            ValueError: It is no array of one number.
        """
        found = self.values()
        if found.size != 1:
            raise ValueError(f"expected a number, found an array of shape {list(self.shape)[:8]}")
        return float(found.flat[0])

    def parts(self, *names: str) -> list[dict[str, "Matrix"]]:
        """Return fields of each element of an array of structures; a cell array of structures counts as one.

        Raises:
            ValueError: It is no such array, or a field is missing.
        """
        if self.kind == CELL and self.shape:
            return [one for cell in self._matrices(self.rest, math.prod(self.shape)) for one in cell.parts(*names)]
        if self.kind != STRUCTURE:
            raise ValueError(f"an array of class {self.kind} stands where a structure with {', '.join(names)} should be")
        width, rest = self._numbers(self.rest)
        if len(width) != 1 or width[0] < 1:
            raise ValueError("the names of a structure have no length")
        text, rest = self._numbers(rest)
        raw, step = text.tobytes(), int(width[0])
        known = [raw[i : i + step].partition(b"\0")[0].decode("latin-1") for i in range(0, len(raw), step)]
        if missing := [name for name in names if name not in known]:
            raise ValueError(f"a structure lacks {missing[0]}; it has {', '.join(known)[:150]}")
        found = self._matrices(rest, math.prod(self.shape) * len(known))
        return [{name: found[start + known.index(name)] for name in names} for start in range(0, len(found), len(known))]

    def _matrices(self, data: memoryview, count: int) -> list["Matrix"]:
        if count * 8 > len(data):  # each has a tag of eight bytes
            raise ValueError(f"{count} arrays do not fit into {len(data)} bytes")
        found = []
        for _ in range(count):
            kind, content, data = element(data, self.order)
            if kind != MATRIX:
                raise ValueError(f"an element of kind {kind} stands where an array should be")
            found.append(Matrix(content, self.order))
        return found


def element(data: memoryview, order: str) -> tuple[int, memoryview, memoryview]:
    """Return kind and content of the element at the front of some bytes, and what follows it.

    Raises:
        ValueError: The element is longer than what is there.
    """
    if len(data) < 8:
        raise ValueError("it ends within an element")
    kind, size = struct.unpack_from(order + "II", data)
    if kind >> 16:  # a small element: size and kind share a word, and the content is the next
        kind, size = kind & 0xFFFF, kind >> 16
        if size > 4:
            raise ValueError(f"a small element has {size} bytes")
        return kind, data[4 : 4 + size], data[8:]
    if size > len(data) - 8:
        raise ValueError(f"an element of {size} bytes has {len(data) - 8}")
    padded = size if kind == COMPRESSED else size + -size % 8
    return kind, data[8 : 8 + size], data[8 + padded :]


def read_variable(path: Path, name: str) -> Matrix | None:
    """Return a variable of a MATLAB file of version 5 to 7; None if the file has none of that name.

    Raises:
        UserError: The file is another version, or a limit is exceeded.
        ValueError: It is damaged.
        OSError: It cannot be read.
    """
    left = 8 * limit("NEUIDO_MAX_ARRAY_ELEMENTS")
    size = path.stat().st_size
    check_limit(size // 8, "NEUIDO_MAX_ARRAY_ELEMENTS", f"{path} has {size // 8} numbers")
    data = memoryview(path.read_bytes())
    order = {b"IM": "<", b"MI": ">"}.get(bytes(data[126:HEADER]))
    if order is None or struct.unpack_from(order + "H", data, 124)[0] != 0x0100:
        raise UserError(f"{path} is no MATLAB file of version 5 to 7: save it with the option '-v7'")
    rest = data[HEADER:]
    while len(rest):
        kind, content, rest = element(rest, order)
        if kind == COMPRESSED:
            whole = zlib.decompressobj().decompress(content, left + 1)
            left -= len(whole)
            if left < 0:
                count = limit("NEUIDO_MAX_ARRAY_ELEMENTS") + 1
                check_limit(count, "NEUIDO_MAX_ARRAY_ELEMENTS", f"{path} has {count} numbers or more")
            kind, content, _ = element(memoryview(whole), order)
        if kind == MATRIX and (found := Matrix(content, order)).name == name:
            return found
    return None
