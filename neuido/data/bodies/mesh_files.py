"""Triangle meshes from OBJ, STL, PLY, GLB (trimesh) and USD files (usd-core), in metres with +y up. The files are not trusted."""

import io
import json
import os
import struct
from pathlib import Path

import numpy as np

from neuido.data.bodies.triangle_mesh import TriangleMesh, check_triangles, clean_mesh
from neuido.data.bodies.usd_files import read_usd_mesh
from neuido.data.files.parsing import parser_errors, refuse_pointer
from neuido.data.files.values import number
from neuido.errors import UserError, suggest
from neuido.physics.runtime.lazy import import_extra
from neuido.physics.runtime.limits import check_limit

TRIMESH_FORMATS = (".obj", ".stl", ".ply", ".glb")
USD_FORMATS = (".usd", ".usda", ".usdc", ".usdz")
UP_AXES = {"x": ((0.0, -1.0, 0.0), (1.0, 0.0, 0.0), (0.0, 0.0, 1.0)),
           "y": ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0)),
           "z": ((1.0, 0.0, 0.0), (0.0, 0.0, 1.0), (0.0, -1.0, 0.0))}  # fmt: skip
"""The rotation that turns each axis upright, to +y."""


def read_mesh(path: str | os.PathLike, *, scale: float | None = None, up: str | None = None) -> TriangleMesh:
    """Read all triangles of a mesh file; parts are placed as the file places them, and materials are ignored.

    Polygons are split into triangles. Vertices at one place become one, so that a mesh that is cut along its texture is whole again.

    Args:
        path: An .obj, .stl, .ply, .glb, .usd, .usda, .usdc or .usdz file.
        scale: Metres per unit of the file; by default what a USD file says (centimetres where it does not), else 1.
        up: The axis that points up: x, y or z. It becomes y. By default what a USD file says, else y.

    Raises:
        UserError: The file is missing, too large, damaged or of another format, has no triangles, refers to files outside its folder, or
            the library that reads it is not installed.
    """
    path = Path(path).expanduser()
    suffix = path.suffix.lower()
    if suffix not in TRIMESH_FORMATS + USD_FORMATS:
        known = TRIMESH_FORMATS + USD_FORMATS
        raise UserError(f"{path} is not a mesh file: its name must end in {', '.join(known)}{suggest(suffix, known)}")
    if scale is not None:
        number(scale, "scale", above=0.0)
    if up is not None and up not in UP_AXES:
        raise UserError(f"up = {up!r} must be x, y or z")
    if not path.is_file():
        raise UserError(f"the mesh file {path} is missing" if not path.exists() else f"{path} is not a file")
    check_limit(path.stat().st_size, "NEUIDO_MAX_MESH_BYTES", f"{path} has {path.stat().st_size} bytes")
    if suffix in USD_FORMATS:
        vertices, faces, metres, upright = read_usd_mesh(path)
    else:
        vertices, faces = _read_with_trimesh(path, suffix)
        metres, upright = 1.0, "y"
    vertices = vertices * (metres if scale is None else float(scale)) @ np.array(UP_AXES[up or upright]).T
    return clean_mesh(vertices, faces, str(path))


def _read_with_trimesh(path: Path, suffix: str) -> tuple[np.ndarray, np.ndarray]:
    """Return vertices (V, 3) and faces (T, 3) of all parts. No other file is opened: a stream has no folder."""
    trimesh = import_extra("trimesh", f"a mesh from {path.name}", extra="mesh")
    content = path.read_bytes()
    refuse_pointer(path, content)
    with parser_errors(path, f"{suffix[1:].upper()} file with a mesh"):
        if suffix == ".glb":
            _check_glb(content, path)
        if suffix == ".ply":
            _check_ply(content, path)
        scene = trimesh.load_scene(io.BytesIO(content), file_type=suffix[1:], process=False, skip_materials=True)
        meshes = {name: part for name, part in scene.geometry.items() if hasattr(part, "faces")}
        placed = [(name, node) for node in scene.graph.nodes_geometry for name in (scene.graph[node][1],) if name in meshes]
        check_triangles(
            sum(len(meshes[name].faces) for name, _ in placed), sum(len(meshes[name].vertices) for name, _ in placed), str(path)
        )
        if not placed:
            raise UserError(f"{path} has no triangles: export a mesh with faces (points alone are no mesh)")
        vertices, faces, count = [], [], 0
        for name, node in placed:
            transform, part = np.asarray(scene.graph[node][0], np.float64), meshes[name]
            own = np.asarray(part.faces, np.int64)
            vertices.append(np.asarray(part.vertices, np.float64) @ transform[:3, :3].T + transform[:3, 3])
            faces.append((own[:, ::-1] if np.linalg.det(transform[:3, :3]) < 0 else own) + count)
            count += len(part.vertices)
    return np.concatenate(vertices), np.concatenate(faces)


def _check_glb(content: bytes, path: Path) -> None:
    """Check the counts in the header of a GLB file, which trimesh allocates before it looks at the data."""
    if len(content) < 20 or content[:4] != b"glTF":
        raise UserError(f"{path} is not a GLB file: it does not begin with glTF")
    length, kind = struct.unpack_from("<I4s", content, 12)
    if kind != b"JSON" or length > len(content) - 20:
        raise UserError(f"{path} is truncated or has no JSON part")
    header = json.loads(content[20 : 20 + length])
    if any(buffer.get("uri") for buffer in header.get("buffers", [])):
        raise UserError(f"{path} refers to other files: export it as one .glb with everything in it")
    if needs := header.get("extensionsRequired"):
        compressed = [name for name in needs if "draco" in name or "meshopt" in name or "quantization" in name]
        if compressed:
            raise UserError(f"{path} is compressed ({compressed[0]}): export it without compression")
    counts = [int(accessor.get("count", 0)) for accessor in header.get("accessors", [])]
    # indices count too, three a triangle
    check_limit(max(counts, default=0) // 3, "NEUIDO_MAX_TRIANGLES", f"{path}: an accessor has {max(counts, default=0)} entries")
    if sum(counts) > len(content):  # an entry takes at least one byte
        raise UserError(f"{path} is damaged: its accessors count {sum(counts)} entries, but the file has only {len(content)} bytes")
    check_limit(len(header.get("nodes", [])), "NEUIDO_MAX_TRIANGLES", f"{path} has {len(header.get('nodes', []))} nodes")


def _check_ply(content: bytes, path: Path) -> None:
    """Check the counts in the header of a PLY file against its size."""
    end = content.find(b"end_header", 0, 1 << 20)
    if not content.startswith(b"ply") or end < 0:
        raise UserError(f"{path} is not a PLY file: it does not begin with a header from ply to end_header")
    for line in content[:end].decode("latin-1").splitlines():
        word = line.split()
        if word[:1] == ["element"]:
            count = word[2] if len(word) == 3 else ""
            if not (count.isascii() and count.isdigit()):
                raise UserError(f"{path}: `{line.strip()[:80]}` must be element, a name and a whole number")
            if len(count) > 18 or int(count) > len(content):
                raise UserError(f"{path} is truncated: {line.strip()[:80]}, but the file has only {len(content)} bytes")
            check_limit(int(count), "NEUIDO_MAX_TRIANGLES", f"{path}: {line.strip()[:80]}")
