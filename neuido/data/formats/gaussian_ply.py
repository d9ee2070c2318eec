"""Reader of 3D Gaussian splatting (3DGS) PLY files such as `point_cloud.ply`. The files are not trusted."""

import warnings
from pathlib import Path

import numpy as np

from neuido.data.formats.ply import read_ply_header, read_ply_vertices
from neuido.errors import UserError

REST_COUNTS = (0, 9, 24, 45)
"""Number of `f_rest` columns for spherical harmonics of degree 0, 1, 2 and 3."""


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
    header = read_ply_header(path)
    columns = [each.name for element in header.elements for each in element.properties]
    if any(name.startswith("packed_") for name in columns) or any(element.name == "chunk" for element in header.elements):
        raise UserError(f"{path} is a compressed PLY file (packed_position, ...): export the Gaussians as an uncompressed .ply")
    vertices = read_ply_vertices(path, header)
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
