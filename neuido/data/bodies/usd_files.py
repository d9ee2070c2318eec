"""Meshes of USD files, through usd-core. A file is not trusted: what it refers to must lie in its folder."""

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from neuido.data.bodies.triangle_mesh import check_triangles
from neuido.data.files.parsing import parser_errors
from neuido.data.files.values import path_inside
from neuido.errors import UserError
from neuido.physics.runtime.lazy import import_extra
from neuido.physics.runtime.limits import check_limit

MOST_LAYERS = 1000
"""Number of files that a USD file may refer to, directly or through others."""
SHOWN = ("default", "render")
"""Purposes of the prims that are read; guides and proxies repeat them."""


def open_stage(path: Path) -> Any:
    """Open a USD file as a `Usd.Stage`.

    Raises:
        UserError: The file is damaged, refers to files outside its folder or that are missing, or usd-core is not installed.
    """
    Sdf = import_extra("pxr.Sdf", f"a mesh from {path.name}", extra="usd")
    Usd = import_extra("pxr.Usd", f"a mesh from {path.name}", extra="usd")
    waiting, seen = [path.resolve()], set()
    with parser_errors(path, "USD file"):
        while waiting:
            own = waiting.pop()
            if own in seen:
                continue
            seen.add(own)
            check_limit(own.stat().st_size, "NEUIDO_MAX_MESH_BYTES", f"{own} has {own.stat().st_size} bytes")
            if len(seen) > MOST_LAYERS:
                raise UserError(f"{path} refers to more than {MOST_LAYERS} files: flatten it (usdcat --flatten)")
            layer = Sdf.Layer.FindOrOpen(str(own))
            if layer is None:
                raise UserError(f"{own} is not a valid USD file")
            if own.suffix.lower() == ".usdz":  # a package holds its files itself
                continue
            for asset in filter(None, layer.GetCompositionAssetDependencies()):  # "" is the file itself
                named = path_inside(own.parent, asset.split(":SDF_FORMAT_ARGS:")[0], f"{own.name}: a reference", kind="folder")
                if not path_inside(path.parent, _relative(named, path), f"{own.name}: a reference").is_file():
                    raise UserError(f"{own.name} refers to {asset}, which is missing: flatten it (usdcat --flatten)")
                waiting.append(named.resolve())
        stage = Usd.Stage.Open(str(path.resolve()))
    if stage is None:
        raise UserError(f"{path} is not a valid USD file")
    return stage


def _relative(named: Path, path: Path) -> str:
    try:
        return str(named.resolve().relative_to(path.parent.resolve()))
    except ValueError:
        raise UserError(f"{path.name} refers to {named}, outside its folder: flatten it (usdcat --flatten)") from None


def stage_units(stage: Any) -> tuple[float, str]:
    """Return the metres per unit and the axis that points up, x, y or z."""
    UsdGeom = import_extra("pxr.UsdGeom", "USD", extra="usd")
    metres = float(UsdGeom.GetStageMetersPerUnit(stage))
    if not 0 < metres < float("inf"):
        raise UserError(f"{stage.GetRootLayer().realPath}: metersPerUnit = {metres} must be positive")
    return metres, str(UsdGeom.GetStageUpAxis(stage)).lower()


def shown_prims(stage: Any) -> Iterator[Any]:
    """Yield the prims of a stage that are active, visible and for show; those of instances too."""
    Usd = import_extra("pxr.Usd", "USD", extra="usd")
    UsdGeom = import_extra("pxr.UsdGeom", "USD", extra="usd")
    count = 0
    for prim in Usd.PrimRange.Stage(stage, Usd.TraverseInstanceProxies()):
        count += 1
        check_limit(count, "NEUIDO_MAX_TRIANGLES", f"{stage.GetRootLayer().realPath} has {count} prims")
        image = UsdGeom.Imageable(prim)
        if not image or (image.ComputePurpose() in SHOWN and image.ComputeVisibility() != UsdGeom.Tokens.invisible):
            yield prim


def prim_mesh(prim: Any, time: Any) -> tuple[np.ndarray, np.ndarray]:
    """Return vertices (V, 3), in units and axes of the prim itself, and triangles (T, 3) of a `UsdGeomMesh`; polygons are fans.

    Subdivision surfaces are read as their cage.

    Raises:
        UserError: Counts and indices of the faces do not agree, or are too many.
    """
    UsdGeom = import_extra("pxr.UsdGeom", "USD", extra="usd")
    mesh, where = UsdGeom.Mesh(prim), str(prim.GetPath())
    vertices = np.asarray(mesh.GetPointsAttr().Get(time) or [], np.float64).reshape(-1, 3)
    counts = np.asarray(mesh.GetFaceVertexCountsAttr().Get(time) or [], np.int64)
    index = np.asarray(mesh.GetFaceVertexIndicesAttr().Get(time) or [], np.int64)
    if len(counts) and (counts.min() < 0 or counts.sum() != len(index)):
        raise UserError(f"{where}: faceVertexCounts sum to {counts.sum()}, but there are {len(index)} faceVertexIndices")
    fans = np.maximum(counts - 2, 0)
    check_triangles(int(fans.sum()), len(vertices), where)
    if len(index) and (index.min() < 0 or index.max() >= len(vertices)):
        raise UserError(f"{where}: faceVertexIndices name vertex {index.max()} of {len(vertices)}")
    start = np.repeat(np.cumsum(counts) - counts, fans)
    step = np.arange(fans.sum()) - np.repeat(np.cumsum(fans) - fans, fans)
    faces = np.stack([index[start], index[start + step + 1], index[start + step + 2]], axis=1) if len(start) else np.empty((0, 3), np.int64)
    if mesh.GetOrientationAttr().Get() == UsdGeom.Tokens.leftHanded:
        faces = faces[:, ::-1]
    return vertices, faces


def placed(vertices: np.ndarray, faces: np.ndarray, matrix: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return a mesh moved by a 4 x 4 matrix for column vectors; a mirror image keeps its outside."""
    return vertices @ matrix[:3, :3].T + matrix[:3, 3], faces[:, ::-1] if np.linalg.det(matrix[:3, :3]) < 0 else faces


def world_matrix(prim: Any, time: Any) -> np.ndarray:
    """Return the transform of a prim to the world, (4, 4), for column vectors."""
    UsdGeom = import_extra("pxr.UsdGeom", "USD", extra="usd")
    return np.array(UsdGeom.Xformable(prim).ComputeLocalToWorldTransform(time)).T


def read_usd_mesh(path: Path) -> tuple[np.ndarray, np.ndarray, float, str]:
    """Read all meshes of a USD file at its first time.

    Returns:
        Vertices (V, 3) in units of the file, triangles (T, 3), metres per unit, and the axis that points up.

    Raises:
        UserError: As `open_stage`; or there is no mesh, or it is too large.
    """
    stage = open_stage(path)
    Usd = import_extra("pxr.Usd", "USD", extra="usd")
    UsdGeom = import_extra("pxr.UsdGeom", "USD", extra="usd")
    time = Usd.TimeCode.EarliestTime()
    vertices, faces, count, triangles = [], [], 0, 0
    for prim in shown_prims(stage):
        if prim.IsA(UsdGeom.Mesh):
            own, its = placed(*prim_mesh(prim, time), world_matrix(prim, time))
            count, triangles = count + len(own), triangles + len(its)
            check_triangles(triangles, count, str(path))
            vertices.append(own)
            faces.append(its + count - len(own))
    if not triangles:
        raise UserError(f"{path} has no mesh with triangles that is shown")
    return (np.concatenate(vertices), np.concatenate(faces), *stage_units(stage))
