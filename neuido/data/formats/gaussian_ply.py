"""Reader of 3D Gaussian splatting (3DGS) PLY files such as `point_cloud.ply`. The files are not trusted."""

import io
import re
import warnings
from pathlib import Path

import numpy as np

from neuido.data.files.parsing import parser_errors
from neuido.errors import UserError
from neuido.physics.runtime.limits import check_limit

REST_COUNTS = (0, 9, 24, 45)
"""Number of `f_rest` columns for spherical harmonics of degree 0, 1, 2 and 3."""
HEADER_BYTES = 1 << 20


def column_names(rest: int) -> list[str]:
    """List the columns of a 3DGS PLY file in file order; `rest` is the number of `f_rest` columns (`REST_COUNTS`)."""
    names = ["x", "y", "z", "nx", "ny", "nz", "f_dc_0", "f_dc_1", "f_dc_2", *(f"f_rest_{i}" for i in range(rest)), "opacity"]
    return [*names, *(f"scale_{i}" for i in range(3)), *(f"rot_{i}" for i in range(4))]


def read_gaussian_vertices(path: Path) -> np.ndarray:
    """Read the vertices of a 3DGS PLY file as a structured array with the columns of `column_names`; normals may be absent.

    Rows with a NaN or an infinity are dropped, and a warning names them. Exports of Gaussian editors contain such rows.

    Raises:
        UserError: The file is missing, too large or not a PLY file; it holds no 3D Gaussians (it is compressed, a point cloud or has 2D
            Gaussians); or no row is finite.
    """
    from plyfile import PlyData

    if not path.is_file():
        raise UserError(f"the PLY file {path} is missing")
    length = _check_header(path)
    with parser_errors(path, "PLY file with vertices"), path.open("rb") as stream:
        header = stream.read(length)
        stream.seek(0)
        if not header.isascii():  # plyfile accepts ASCII comments alone
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
            raise UserError(f"{path} contains 2D Gaussians (2DGS: it has no column scale_2): train or export 3D Gaussians")
        raise UserError(f"{path} is not a 3DGS file: its vertices lack the columns {', '.join(missing)}")
    if rest not in REST_COUNTS:
        raise UserError(f"{path} has {rest} f_rest columns; a 3DGS file has 0, 9, 24 or 45")
    if wrong := [name for name in needed if vertices.dtype[name].kind not in "iuf"]:
        raise UserError(f"{path}: the column {wrong[0]} contains lists; it must contain numbers")
    if not len(vertices):
        raise UserError(f"{path} contains no Gaussian: its vertex list is empty")
    finite = np.ones(len(vertices), bool)
    for name in needed:
        with np.errstate(over="ignore", invalid="ignore"):
            finite &= np.isfinite(vertices[name].astype(np.float32))
    if not finite.all():
        rows = np.flatnonzero(~finite)
        some = f"{', '.join(map(str, rows[:5]))}{', ...' if len(rows) > 5 else ''}"
        if len(rows) == len(vertices):
            raise UserError(f"{path}: all {len(vertices)} Gaussians contain a NaN or an infinity")
        warnings.warn(
            f"{path}: {len(rows)} of {len(vertices)} Gaussians contain a NaN or an infinity and are dropped: rows {some}", stacklevel=3
        )
        vertices = vertices[finite]
    return vertices


def _check_header(path: Path) -> int:
    """Check the header of a PLY file; return its length in bytes.

    Raises:
        UserError: The file is not a PLY file, is compressed, or is shorter than its header says.
    """
    with path.open("rb") as stream:
        start = stream.read(HEADER_BYTES)
    if not start.startswith((b"ply\n", b"ply\r")):
        kind = "a gzip file, perhaps .spz" if start.startswith(b"\x1f\x8b") else "its first line is not `ply`; perhaps a .splat file"
        raise UserError(f"{path} is not a PLY file ({kind}): export the Gaussians as an uncompressed .ply")
    end = re.search(rb"end_header[ \t]*(\r\n|\n|\r)", start)
    if end is None:
        raise UserError(f"{path} is not a PLY file with vertices: its header lacks end_header")
    header = start[: end.start()].decode("latin-1")
    properties = re.findall(r"^\s*property\s+\S+\s+(\S+)\s*$", header, re.MULTILINE)
    if any(name.startswith("packed_") for name in properties) or "element chunk" in header:
        raise UserError(f"{path} is a compressed PLY file (packed_position, ...): export the Gaussians as an uncompressed .ply")
    counts = re.findall(r"^\s*element\s+(\S+)\s+(\S+)\s*$", header, re.MULTILINE)
    for element, count in counts:
        if not re.fullmatch(r"[0-9]{1,18}", count):
            raise UserError(f"{path}: element {element} has the count {count!r}; it must be a whole number")
        check_limit(int(count), "NEUIDO_MAX_PARTICLES", f"{path}: element {element} has {int(count)} rows")
        if int(count) > path.stat().st_size:  # a row takes at least one byte
            raise UserError(
                f"{path} is truncated: element {element} has {int(count)} rows, but the file has only {path.stat().st_size} bytes"
            )
    return end.end()
