"""Readers of untrusted files: JSON, YAML, CSV, NumPy archives and images.

Each reader converts every failure of its parser into a `UserError` that names the file, and checks sizes before it allocates memory.
`physics/runtime/limits.py` has the largest sizes.
"""

import contextlib
import csv
import json
import math
import os
import re
import zipfile
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from neuido.errors import UserError
from neuido.physics.runtime.limits import check_limit, limit


@contextlib.contextmanager
def parser_errors(path: str | os.PathLike, what: str) -> Iterator[None]:
    """Convert any exception of a parser into a one-line `UserError`: "<path> is not a valid <what>: <reason>"."""
    try:
        yield
    except UserError:
        raise
    except BaseException as error:
        # Parsers raise undocumented exceptions: zlib.error, TokenError, RecursionError, and, where they are written in Rust, a panic, which
        # is no Exception and which no module exports.
        if not isinstance(error, Exception) and type(error).__name__ != "PanicException":
            raise
        raise UserError(f"{path} is not a valid {what}: {one_line(error)}") from error


@contextlib.contextmanager
def naming(path: str | os.PathLike, what: str = "") -> Iterator[None]:
    """Put the name of a file before each `UserError`, and turn any other exception into one: the check of a content that failed.

    Args:
        path: The file, or the folder of several.
        what: What the error says instead of "cannot be read" where a check failed that nobody foresaw.
    """
    path = Path(path)
    try:
        yield
    except UserError as error:
        if path.name in str(error):
            raise
        raise UserError(f"{path}: {error}") from error
    except (KeyboardInterrupt, GeneratorExit):
        raise
    except MemoryError:
        raise
    except OSError as error:
        raise UserError(f"{error.filename or path} cannot be read: {one_line(error)}") from error
    except Exception as error:  # a value of a kind that no check foresaw, far too large, or nested without end
        raise UserError(f"{path} {what or 'cannot be read'}: {type(error).__name__}: {one_line(error)}") from error


def refuse_pointer(path: str | os.PathLike, start: bytes) -> None:
    """Refuse the small text that Git LFS leaves in the place of a file which was not downloaded.

    Raises:
        UserError: The file begins like one.
    """
    if start.startswith(b"version https://git-lfs"):
        raise UserError(f"{path} is not the file itself but a pointer of Git LFS to it: run `git lfs pull` in its repository")


def one_line(error: BaseException) -> str:
    """Return the message of an exception as one line of at most 300 characters, or its type if it has no message."""
    if isinstance(error, OSError) and error.strerror:
        return error.strerror.lower()
    text = " ".join(str(error).split())
    if isinstance(error, RecursionError):
        return "it is nested too deeply"
    if isinstance(error, MemoryError):
        return "it needs more memory than available"
    return text[:300] if text else type(error).__name__


def read_text(path: str | os.PathLike, failure: str = "is not text in UTF-8") -> str:
    """Read a UTF-8 text file, with or without a byte order mark.

    Args:
        path: The file.
        failure: Error message for a file that is not text, after the path.

    Raises:
        UserError: The file is missing, too large, or not UTF-8.
    """
    path = Path(path)
    if not path.is_file():
        raise UserError(f"{path} is missing" if not path.exists() else f"{path} is not a file")
    try:
        check_limit(path.stat().st_size, "NEUIDO_MAX_TEXT_BYTES", f"{path} has {path.stat().st_size} bytes")
        return path.read_text(encoding="utf-8-sig")
    except (OSError, UnicodeDecodeError) as error:
        raise UserError(f"{path} {failure}: {one_line(error)}") from error


def read_json(path: Path) -> Any:
    """Read a JSON file.

    Raises:
        UserError: The file is missing or is not JSON.
    """
    text = read_text(path, "is not valid JSON")
    try:
        return json.loads(text)
    except (ValueError, RecursionError) as error:
        raise UserError(f"{path} is not valid JSON: {one_line(error)}") from error


class _Loader(yaml.SafeLoader):
    """SafeLoader that reads 1e5 as a number, as in YAML 1.2; in YAML 1.1, which PyYAML follows, it is text."""


_Loader.add_implicit_resolver(
    "tag:yaml.org,2002:float",
    re.compile(r"^[-+]?(\.[0-9]+|[0-9]+(\.[0-9]*)?)[eE][-+]?[0-9]+$"),
    list("-+0123456789."),
)


def read_yaml(path: Path, *, plain: bool = False) -> dict[str, Any]:
    """Read a YAML file that contains a mapping; 1e5 and 1.0e5 are numbers, as in YAML 1.2.

    Args:
        path: The file.
        plain: Whether 1e5 stays text, as YAML 1.1 has it.

    Raises:
        UserError: The file is missing, not valid YAML, not a mapping, or its aliases expand to too many values.
    """
    text = read_text(path, "is not valid YAML")
    check_limit(len(text), "NEUIDO_MAX_YAML_BYTES", f"{path} has {len(text)} characters")
    try:
        loader = (yaml.SafeLoader if plain else _Loader)(text)
        try:
            root = loader.get_single_node()
            check_limit(_expanded(root, {}), "NEUIDO_MAX_YAML_NODES", f"{path}: its aliases expand to too many values")
            content = loader.construct_document(root) if root is not None else None
        finally:
            loader.dispose()
    except UserError:
        raise
    except yaml.MarkedYAMLError as error:
        mark = error.problem_mark or error.context_mark
        line, column = (mark.line + 1, mark.column + 1) if mark else (1, 1)
        what = ", ".join(filter(None, (error.context, error.problem)))
        raise UserError(f"{path}:{line}: it is not valid YAML: {what} (line {line}, column {column})") from error
    except Exception as error:  # YAMLError; ValueError of a date or a huge integer; RecursionError; TypeError of a key
        raise UserError(f"{path} is not valid YAML: {one_line(error)}") from error
    if not isinstance(content, dict):
        raise UserError(f"{path} must contain a mapping of keys to values")
    return content


def _expanded(node: yaml.Node | None, sizes: dict[int, int]) -> int:
    """Count the values below a node; the values of an alias count once for each use."""
    if node is None or isinstance(node, yaml.ScalarNode):
        return 1
    if id(node) in sizes:
        if sizes[id(node)] == 0:
            raise ValueError(f"line {node.start_mark.line + 1}: an alias refers to a node that contains it")
        return sizes[id(node)]
    sizes[id(node)] = 0
    children = (part for pair in node.value for part in pair) if isinstance(node, yaml.MappingNode) else iter(node.value)
    sizes[id(node)] = total = 1 + sum(_expanded(child, sizes) for child in children)
    return total


def read_table(path: Path) -> list[list[str]]:
    """Read the rows of a CSV file, header first; skip empty rows.

    Raises:
        UserError: The file is missing or not valid CSV.
    """
    text = read_text(path, "is not a valid CSV file")
    try:
        return [row for row in csv.reader(text.splitlines(keepends=True), strict=True) if row]
    except (csv.Error, ValueError) as error:
        raise UserError(f"{path} is not a valid CSV file: {one_line(error)}") from error


def read_arrays(
    path: str | os.PathLike, needed: Iterable[str] | None, optional: Iterable[str] = (), *, what: str = "", others: bool = True
) -> dict[str, np.ndarray]:
    """Read arrays of a NumPy archive (.npz); pickled objects are refused.

    Args:
        path: The file.
        needed: Names of the required arrays; None: all arrays of the file are read, at most a thousand.
        optional: Names of arrays that may be absent.
        what: What the file should be, for error messages; by default "archive of <needed>".
        others: True: ignore arrays of other names. False: refuse them.

    Raises:
        UserError: The file is missing, damaged or too large, or lacks an array.
    """
    path, every, needed, optional = Path(path), needed is None, tuple(needed or ()), tuple(optional)
    what = what or f"archive of {', '.join(needed) or 'arrays'}"
    if not path.is_file():
        raise UserError(f"{path} is missing")
    with parser_errors(path, what), zipfile.ZipFile(path) as archive:
        members = {name.removesuffix(".npy"): name for name in archive.namelist()}
        needed = tuple(members)[:1000] if every else needed
        if not others and (unknown := sorted(set(members) - {*needed, *optional})):
            raise UserError(f"{path}: unknown array {unknown[0]!r}; it takes {', '.join((*needed, *optional))}")
        if missing := [name for name in needed if name not in members]:
            raise UserError(
                f"{path} is not a valid {what}: it lacks the array {missing[0]!r}; it has {', '.join(sorted(members)[:20]) or 'none'}"
            )
        return {name: _read_array(archive, members[name], path, what) for name in (*needed, *optional) if name in members}


def is_zip(path: str | os.PathLike) -> bool:
    """Return whether a path is a zip file, such as an .npz or a checkpoint, whose table of contents is there."""
    try:
        return Path(path).is_file() and zipfile.is_zipfile(path)
    except (zipfile.BadZipFile, OSError):  # a table of contents that lies
        return False


def _read_array(archive: zipfile.ZipFile, member: str, path: Path, what: str) -> np.ndarray:
    with archive.open(member) as stream:
        version = np.lib.format.read_magic(stream)
        if version not in ((1, 0), (2, 0)):
            raise UserError(f"{path}: {member} has the unsupported .npy version {version}")
        header = np.lib.format.read_array_header_1_0 if version == (1, 0) else np.lib.format.read_array_header_2_0
        shape, _, dtype = header(stream)
    if dtype.kind not in "biufU":
        raise UserError(f"{path} is not a valid {what}: {member} contains {dtype} and not numbers")
    check_limit(math.prod(shape), "NEUIDO_MAX_ARRAY_ELEMENTS", f"{path}: {member} has {math.prod(shape)} elements")
    with archive.open(member) as stream:
        array = np.lib.format.read_array(stream, allow_pickle=False)
    return array.astype(dtype.newbyteorder("="), copy=False)  # torch takes no other byte order


def _size_in_header(path: Path) -> tuple[int, int] | None:
    """Read width and height [px] from the header of an image; return None if Pillow does not know the format.

    Raises:
        UserError: The file is missing, or the image exceeds `NEUIDO_MAX_IMAGE_PIXELS`.
    """
    from PIL import Image

    if not path.is_file():
        raise UserError(f"the image {path} is missing")
    name = "NEUIDO_MAX_IMAGE_PIXELS"
    try:
        with Image.open(path) as image:
            size = image.size
    except Image.DecompressionBombError as error:
        if limit(name) <= 2 * (Image.MAX_IMAGE_PIXELS or 0):
            raise UserError(
                f"{path} has more than the limit of {limit(name)} pixels: raise it with the environment variable {name}"
            ) from error
        return None
    except Exception:  # a damaged header; OpenCV decides
        return None
    check_limit(size[0] * size[1], name, f"{path} has {size[0]} x {size[1]} pixels")
    return size


def image_size(path: Path) -> tuple[int, int]:
    """Return width and height [px] of an image file; read only its header if possible.

    Raises:
        UserError: The file is missing, not an image, or too large.
    """
    return _size_in_header(path) or read_image(path).shape[1::-1]  # type: ignore[return-value]


def read_image(path: Path) -> np.ndarray:
    """Read an image (H, W) or (H, W, C) of 8 or 16 bits as stored: BGR or BGRA, without EXIF rotation.

    Raises:
        UserError: The file is missing, not readable by OpenCV, of another bit depth, or too large.
    """
    import cv2

    _size_in_header(path)
    try:
        raw = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
    except cv2.error as error:
        raise UserError(f"{path} is not an image that OpenCV can read: {one_line(error)}") from error
    if raw is None or raw.dtype not in (np.uint8, np.uint16):
        raise UserError(f"{path} is not an image of 8 or 16 bits that OpenCV can read")
    return raw
