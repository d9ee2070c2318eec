"""Reader and writer of PLY files (Stanford polygon format): text and both byte orders. The files are not trusted."""

import itertools
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import IO, NamedTuple

import numpy as np

from neuido.data.files.parsing import parser_errors, refuse_pointer
from neuido.errors import UserError
from neuido.physics.runtime.limits import check_limit

WHAT = "PLY file with vertices"
HEADER_BYTES = 1 << 20
TYPES = {
    "char": "i1", "uchar": "u1", "short": "i2", "ushort": "u2", "int": "i4", "uint": "u4", "float": "f4", "double": "f8",
    "int8": "i1", "uint8": "u1", "int16": "i2", "uint16": "u2", "int32": "i4", "uint32": "u4", "float32": "f4", "float64": "f8",
}  # fmt: skip
"""NumPy's name of each type of the format."""
FORMATS = {"ascii": "", "binary_little_endian": "<", "binary_big_endian": ">"}


class Property(NamedTuple):
    """A column of an element; `length` is the type of a list's length, or None where each row has one number."""

    name: str
    type: str
    length: str | None = None


class Element(NamedTuple):
    """A table of a PLY file."""

    name: str
    count: int
    properties: list[Property]


class Header(NamedTuple):
    """What the header of a PLY file says: byte order ("" for text), elements in their order, and its length in bytes."""

    order: str
    elements: list[Element]
    length: int


def read_ply_header(path: Path) -> Header:
    """Read the header of a PLY file, and check its counts.

    Raises:
        UserError: The file is missing or not a PLY file, or has more rows than the limit or than its size allows.
    """
    if not path.is_file():
        raise UserError(f"the PLY file {path} is missing")
    with path.open("rb") as stream:
        start = stream.read(HEADER_BYTES)
    refuse_pointer(path, start)
    if not start.startswith((b"ply\n", b"ply\r")):
        kind = "a gzip file, perhaps .spz" if start.startswith(b"\x1f\x8b") else "its first line is not `ply`; perhaps a .splat file"
        raise UserError(f"{path} is not a PLY file ({kind}): export an uncompressed .ply")
    with parser_errors(path, WHAT):
        header = _parsed(start)
    size = path.stat().st_size
    for element in header.elements:
        what = f"{path}: element {element.name} has {element.count} rows"
        check_limit(element.count, "NEUIDO_MAX_PARTICLES", what)
        if element.count > size:  # a row takes at least one byte
            raise UserError(f"{path} is truncated: element {element.name} has {element.count} rows, but the file has only {size} bytes")
    return header


def _parsed(start: bytes) -> Header:
    """Parse a header from the first bytes of a file."""
    end_of_line = b"\r\n" if start.startswith(b"ply\r\n") else start[3:4]
    order, elements, at = None, [], 3 + len(end_of_line)
    while True:
        stop = start.find(end_of_line, at)
        if stop < 0:
            raise ValueError("its header lacks end_header")
        line, at = start[at:stop].decode("latin-1"), stop + len(end_of_line)
        match line.split():
            case ["end_header"]:
                break
            case [] | ["comment" | "obj_info", *_]:
                pass
            case ["format", name, _] if name in FORMATS and order is None:
                order = FORMATS[name]
            case ["element", name, count]:
                if not (count.isascii() and count.isdigit() and len(count) <= 18):
                    raise ValueError(f"element {name} has the count {count!r}; it must be a whole number")
                if any(name == element.name for element in elements):
                    raise ValueError(f"element {name} is there twice")
                elements.append(Element(name, int(count), []))
            case ["property", "list", length, kind, name] if elements and kind in TYPES and TYPES.get(length, "f")[0] in "iu":
                elements[-1].properties.append(Property(name, TYPES[kind], TYPES[length]))
            case ["property", kind, name] if elements and kind in TYPES:
                elements[-1].properties.append(Property(name, TYPES[kind]))
            case _:
                raise ValueError(f"its header has the line {line[:80]!r}")
    if order is None:
        raise ValueError("its header lacks the line of the format")
    return Header(order, elements, at)


def read_ply_vertices(path: Path, header: Header | None = None) -> np.ndarray:
    """Read the vertices of a PLY file as a structured array; a column of lists has the type object, with an array for each row.

    Args:
        path: The file.
        header: What `read_ply_header` returned, where that was called before.

    Raises:
        UserError: The file is missing, too large, damaged or cut, or has no vertices.
    """
    header = header or read_ply_header(path)
    with parser_errors(path, WHAT), path.open("rb") as stream:
        size = path.stat().st_size
        stream.seek(header.length)
        for element in header.elements:
            left = size - stream.tell()
            if not header.order:
                rows = _text_rows(stream, element, left)
            elif any(p.length for p in element.properties):
                rows = _rows_of_lists((_binary_numbers(stream, header.order, size) for _ in range(element.count)), element)
            else:
                rows = _binary_rows(stream, element, header.order, left)
            if element.name == "vertex":
                return rows
        raise ValueError(f"its elements are {', '.join(each.name for each in header.elements) or 'none'}")


def _binary_rows(stream: IO[bytes], element: Element, order: str, left: int) -> np.ndarray:
    dtype = np.dtype([(p.name, order + p.type) for p in element.properties])
    if element.count * dtype.itemsize > left:
        raise ValueError(f"element {element.name} needs {element.count * dtype.itemsize} bytes, and {left} are left")
    return np.frombuffer(stream.read(element.count * dtype.itemsize), dtype) if dtype.itemsize else np.empty(element.count, dtype)


def _text_rows(stream: IO[bytes], element: Element, left: int) -> np.ndarray:
    if element.count * max(1, 2 * len(element.properties)) > left + 1:  # a number takes two bytes; the last line may lack its end
        raise ValueError(f"element {element.name} has {element.count} rows, and {left} bytes are left")
    lines = (stream.readline() for _ in range(element.count))
    if any(p.length for p in element.properties):
        return _rows_of_lists((_text_numbers(line) for line in lines), element)
    dtype = np.dtype([(p.name, p.type) for p in element.properties])
    if not element.properties or not element.count:
        return np.empty(element.count, dtype)
    rows = np.loadtxt(lines, dtype, comments=None, encoding="latin-1", ndmin=1)
    if len(rows) != element.count:
        raise ValueError(f"element {element.name} has {element.count} rows, and {len(rows)} are there")
    return rows


Numbers = Callable[[str, int], np.ndarray]
"""Return the next numbers of a row, by their type and count."""


def _binary_numbers(stream: IO[bytes], order: str, size: int) -> Numbers:
    def numbers(kind: str, count: int) -> np.ndarray:
        dtype = np.dtype(order + kind)
        if count * dtype.itemsize > size - stream.tell():
            raise ValueError("it ends inside of a row")
        return np.frombuffer(stream.read(count * dtype.itemsize), dtype)

    return numbers


def _text_numbers(line: bytes) -> Numbers:
    words = iter(line.split())

    def numbers(kind: str, count: int) -> np.ndarray:
        found = list(itertools.islice(words, count))
        if len(found) < count:
            raise ValueError(f"the row {line[:80].decode('latin-1')!r} is too short")
        return np.array([float(word) for word in found]).astype(kind)

    return numbers


def _rows_of_lists(rows: Iterable[Numbers], element: Element) -> np.ndarray:
    """Read rows one number or list after the other."""
    found = []
    for numbers in rows:
        row = []
        for each in element.properties:
            length = 1 if each.length is None else int(numbers(each.length, 1)[0])
            if length < 0:
                raise ValueError(f"a list of {each.name} has the length {length}")
            values = numbers(each.type, length)
            row.append(values[0] if each.length is None else values)
        found.append(tuple(row))
    return np.array(found, np.dtype([(p.name, "O" if p.length else p.type) for p in element.properties]))


def ply_bytes(vertices: np.ndarray, faces: np.ndarray | None = None) -> bytes:
    """Return the content of a binary PLY file.

    Args:
        vertices: Structured array; columns of whole numbers are written as 32-bit integers, others as 32-bit floats.
        faces: Vertices of triangles, (T, 3); None: there are no faces.
    """
    names = vertices.dtype.names or ()
    whole = [vertices.dtype[name].kind in "iu" for name in names]
    columns = "".join(f"property {'int' if own else 'float'} {name}\n" for name, own in zip(names, whole))
    head = f"ply\nformat binary_little_endian 1.0\nelement vertex {len(vertices)}\n{columns}"
    body = vertices.astype([(name, "<i4" if own else "<f4") for name, own in zip(names, whole)]).tobytes()
    if faces is not None:
        head += f"element face {len(faces)}\nproperty list uchar int vertex_indices\n"
        rows = np.empty(len(faces), [("count", "u1"), ("corners", "<i4", (3,))])
        rows["count"], rows["corners"] = 3, faces
        body += rows.tobytes()
    return f"{head}end_header\n".encode("ascii") + body
