"""The vertices of a 3DGS PLY file (`point_cloud.ply`), checked before anything is made of them. The files are not trusted."""

import io
import re
import warnings
from pathlib import Path

import numpy as np

from neuido.data.files.parsing import check_limit, parser_errors
from neuido.errors import UserError

REST_COUNTS = (0, 9, 24, 45)
"""Numbers of `f_rest` columns, of harmonics of degree 0 to 3."""
HEADER_BYTES = 1 << 20


def column_names(rest: int) -> list[str]:
    """Return the columns of a 3DGS file with `rest` harmonics above degree 0, in the order in which they are written."""
    names = ["x", "y", "z", "nx", "ny", "nz", "f_dc_0", "f_dc_1", "f_dc_2", *(f"f_rest_{i}" for i in range(rest)), "opacity"]
    return [*names, *(f"scale_{i}" for i in range(3)), *(f"rot_{i}" for i in range(4))]


def read_gaussian_vertices(path: Path) -> np.ndarray:
    """Return the vertices of a 3DGS PLY file, a structured array with the columns of `column_names` but the normals.

    Rows that are not finite are left out with a warning that says which; exports of editors have some.

    Raises:
        UserError: The file is missing, no PLY, no file of 3D Gaussians (compressed, of 2D Gaussians, a point cloud), too large, or has no
            finite row.
    """
    from plyfile import PlyData

    if not path.is_file():
        raise UserError(f"no PLY file {path}")
    length = _check_header(path)
    with parser_errors(path, "PLY file with vertices that can be read"), path.open("rb") as stream:
        header = stream.read(length)
        stream.seek(0)
        if not header.isascii():  # plyfile refuses comments that are not
            stream.seek(length)
            content = io.BytesIO(bytes(byte if byte < 128 else ord("?") for byte in header) + stream.read())
        else:
            content = stream
        vertices = PlyData.read(content)["vertex"].data
    names = vertices.dtype.names or ()
    rest = sum(name.startswith("f_rest_") for name in names)
    needed = [name for name in column_names(rest) if not name.startswith("n")]
    if missing := [name for name in needed if name not in names]:
        if missing == ["scale_2"]:
            raise UserError(f"{path} holds 2D Gaussians (2DGS: no scale_2), which are flat; train or export 3D Gaussians")
        raise UserError(f"{path} is not a 3DGS file: its vertices lack {', '.join(missing)}")
    if rest not in REST_COUNTS:
        raise UserError(f"{path} has {rest} f_rest columns; needed 0, 9, 24 or 45")
    if wrong := [name for name in needed if vertices.dtype[name].kind not in "iuf"]:
        raise UserError(f"{path}: the column {wrong[0]} holds lists, not numbers")
    if not len(vertices):
        raise UserError(f"{path} holds no Gaussian: its vertices are empty")
    finite = np.ones(len(vertices), bool)
    for name in needed:
        with np.errstate(over="ignore", invalid="ignore"):
            finite &= np.isfinite(vertices[name].astype(np.float32))
    if not finite.all():
        rows = np.flatnonzero(~finite)
        some = f"{', '.join(map(str, rows[:5]))}{', ...' if len(rows) > 5 else ''}"
        if len(rows) == len(vertices):
            raise UserError(f"{path}: none of its {len(vertices)} Gaussians is finite")
        warnings.warn(
            f"{path}: {len(rows)} of {len(vertices)} Gaussians hold a NaN or an infinity and are left out: rows {some}", stacklevel=3
        )
        vertices = vertices[finite]
    return vertices


def _check_header(path: Path) -> int:
    """Refuse what is no PLY, compressed, or larger than the file itself; return the header's length in bytes."""
    with path.open("rb") as stream:
        start = stream.read(HEADER_BYTES)
    if not start.startswith((b"ply\n", b"ply\r")):
        kind = "a gzip file, perhaps .spz" if start.startswith(b"\x1f\x8b") else "it does not begin with ply; perhaps a .splat file"
        raise UserError(f"{path} is not a PLY file ({kind}): export the Gaussians as an uncompressed .ply")
    end = re.search(rb"end_header[ \t]*(\r\n|\n|\r)", start)
    if end is None:
        raise UserError(f"{path} is not a PLY file with vertices: its header has no end")
    header = start[: end.start()].decode("latin-1")
    properties = re.findall(r"^\s*property\s+\S+\s+(\S+)\s*$", header, re.MULTILINE)
    if any(name.startswith("packed_") for name in properties) or "element chunk" in header:
        raise UserError(f"{path} is a compressed PLY file (packed_position, ...): export the Gaussians uncompressed")
    counts = re.findall(r"^\s*element\s+(\S+)\s+(\S+)\s*$", header, re.MULTILINE)
    for element, count in counts:
        if not re.fullmatch(r"[0-9]{1,18}", count):
            raise UserError(f"{path}: element {element} has the count {count!r}, no whole number")
        check_limit(int(count), "NEUIDO_MAX_PARTICLES", f"{path}: element {element} has {int(count)} rows")
        if int(count) > path.stat().st_size:  # a row takes a byte at least
            raise UserError(f"{path} is cut short: element {element} has {int(count)} rows, the file {path.stat().st_size} bytes")
    return end.end()
