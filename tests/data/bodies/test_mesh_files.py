import json
import struct

import numpy as np
import pytest

from neuido.data.bodies.mesh_files import read_mesh
from neuido.errors import UserError

trimesh = pytest.importorskip("trimesh")

CORNERS = np.array([[x, y, z] for x in (0.0, 1.0) for y in (0.0, 2.0) for z in (0.0, 3.0)])
QUADS = [(0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3)]
"""A box of 1 by 2 by 3 with its outside outside."""


def volume(mesh) -> float:
    a, b, c = (mesh.vertices[mesh.faces[:, i]] for i in range(3))
    return float((a * np.cross(b, c)).sum() / 6)


def write(path, transform=None):
    """Write the box in the format that the name says."""
    faces = [(q[0], q[i], q[i + 1]) for q in QUADS for i in (1, 2)]
    if path.suffix.startswith(".usd"):
        pytest.importorskip("pxr")
        from pxr import Gf, Usd, UsdGeom

        stage = Usd.Stage.CreateNew(str(path))
        UsdGeom.SetStageMetersPerUnit(stage, 1.0)
        mesh = UsdGeom.Mesh.Define(stage, "/part/box")
        mesh.GetPointsAttr().Set(CORNERS.astype(np.float32))
        mesh.GetFaceVertexCountsAttr().Set([4] * 6)
        mesh.GetFaceVertexIndicesAttr().Set(np.array(QUADS).ravel().tolist())
        if transform is not None:
            UsdGeom.Xformable(mesh).AddTransformOp().Set(Gf.Matrix4d(*transform.T.ravel().tolist()))
        stage.Save()
        return path
    scene = trimesh.Scene()
    scene.add_geometry(trimesh.Trimesh(CORNERS, faces, process=False), transform=transform)
    scene.export(path)
    return path


@pytest.mark.parametrize("suffix", ["obj", "stl", "ply", "glb", "usda", "usdc"])
def test_each_format_gives_the_box(tmp_path, suffix):
    mesh = read_mesh(write(tmp_path / f"box.{suffix}"), scale=0.1)
    assert mesh.vertices.shape == (8, 3) and mesh.faces.shape == (12, 3)
    assert volume(mesh) == pytest.approx(6e-3, rel=1e-6)
    assert mesh.vertices.max(axis=0) == pytest.approx([0.1, 0.2, 0.3])


@pytest.mark.parametrize("suffix", ["glb", "usda"])
def test_a_mirrored_part_keeps_its_outside(tmp_path, suffix):
    transform = np.diag([-1.0, 1.0, 1.0, 1.0])
    transform[:3, 3] = 5.0, 0.0, 0.0
    mesh = read_mesh(write(tmp_path / f"box.{suffix}", transform))
    assert volume(mesh) == pytest.approx(6.0)
    assert mesh.vertices[:, 0].min() == pytest.approx(4.0) and mesh.vertices[:, 0].max() == pytest.approx(5.0)


@pytest.mark.parametrize(("up", "extent"), [("x", (2, 1, 3)), ("y", (1, 2, 3)), ("z", (1, 3, 2))])
def test_up_turns_the_mesh(tmp_path, up, extent):
    mesh = read_mesh(write(tmp_path / "box.obj"), up=up)
    assert np.ptp(mesh.vertices, axis=0) == pytest.approx(extent)
    assert volume(mesh) == pytest.approx(6.0)  # turned, not mirrored
    top = mesh.vertices[mesh.vertices[:, 1] == mesh.vertices[:, 1].max()]
    assert len(top) == 4 and mesh.vertices[:, 1].max() == pytest.approx({"x": 1, "y": 2, "z": 3}[up])


def test_usd_says_its_units_and_axes(tmp_path):
    path = write(tmp_path / "box.usda")
    from pxr import Usd, UsdGeom

    stage = Usd.Stage.Open(str(path))
    UsdGeom.SetStageUpAxis(stage, "Z")
    UsdGeom.SetStageMetersPerUnit(stage, 0.01)
    stage.Save()
    mesh = read_mesh(path)
    assert np.ptp(mesh.vertices, axis=0) == pytest.approx((0.01, 0.03, 0.02))
    assert np.ptp(read_mesh(path, scale=1.0, up="y").vertices, axis=0) == pytest.approx((1, 2, 3))


def test_usd_stays_in_its_folder(tmp_path):
    write(tmp_path / "outside.usda")
    folder = tmp_path / "in"
    folder.mkdir()
    write(folder / "part.usda")
    (folder / "a.usda").write_text('#usda 1.0\n(metersPerUnit = 1)\ndef "a" (references = @part.usda@</part>) {}\n')
    assert volume(read_mesh(folder / "a.usda")) == pytest.approx(6.0)
    for asset in ("../outside.usda", str(tmp_path / "outside.usda"), "none.usda"):
        path = folder / "b.usda"
        path.write_text(f'#usda 1.0\ndef "a" (references = @{asset}@</part>) {{}}\n')
        with pytest.raises(UserError, match=r"missing|leaves"):
            read_mesh(path)
        path.unlink()


def glb(path, header: dict, data: bytes = b""):
    text = json.dumps(header).encode()
    text += b" " * (-len(text) % 4)
    body = struct.pack("<I4s", len(text), b"JSON") + text + struct.pack("<I4s", len(data), b"BIN\0") + data
    path.write_bytes(struct.pack("<4sII", b"glTF", 2, 12 + len(body)) + body)
    return path


HOSTILE = {
    "empty.obj": b"",
    "points.obj": b"v 0 0 0\nv 1 0 0\nv 0 1 0\n",
    "index.obj": b"v 0 0 0\nv 1 0 0\nf 1 2 9\n",
    "nan.obj": b"v 0 0 nan\nv 1 0 0\nv 0 1 0\nf 1 2 3\n",
    "flat.obj": b"v 0 0 0\nv 1 0 0\nf 1 2 2\n",
    "short.stl": b"\0" * 80 + struct.pack("<I", 1 << 31) + b"\0" * 50,
    "count.ply": b"ply\nformat binary_little_endian 1.0\nelement vertex 99999999999\nproperty float x\nend_header\n",
    "text.ply": b"ply\nformat ascii 1.0\nelement vertex two\nend_header\n",
    "junk.glb": b"glTF" + b"\xff" * 40,
    "junk.usdc": b"PXR-USDC" + b"\xff" * 90,
    "junk.usda": b"#usda 1.0\ndef {",
    "box.fbx": b"FBX",
}


@pytest.mark.parametrize("name", HOSTILE)
def test_hostile_files_are_refused_in_a_line(tmp_path, name):
    (tmp_path / name).write_bytes(HOSTILE[name])
    with pytest.raises(UserError) as caught:
        read_mesh(tmp_path / name)
    assert name in str(caught.value) and "\n" not in str(caught.value)


def test_glb_counts_are_checked_before_memory_is_taken(tmp_path):
    accessor = {"componentType": 5126, "count": 1 << 40, "type": "VEC3"}
    mesh = {"primitives": [{"attributes": {"POSITION": 0}}]}
    header = {"asset": {"version": "2.0"}, "accessors": [accessor], "meshes": [mesh], "nodes": [{"mesh": 0}], "scenes": [{"nodes": [0]}]}
    with pytest.raises(UserError, match="NEUIDO_MAX_TRIANGLES"):
        read_mesh(glb(tmp_path / "bomb.glb", header))
    accessor["count"] = 1 << 20
    with pytest.raises(UserError, match="only"):
        read_mesh(glb(tmp_path / "bomb.glb", header))
    circle = {**header, "accessors": [], "meshes": [], "nodes": [{"children": [1]}, {"children": [0]}]}
    with pytest.raises(UserError, match=r"circle\.glb"):
        read_mesh(glb(tmp_path / "circle.glb", circle))


def test_limits_hold(tmp_path, monkeypatch):
    path = write(tmp_path / "box.obj")
    monkeypatch.setenv("NEUIDO_MAX_TRIANGLES", "11")
    with pytest.raises(UserError, match="12 triangles"):
        read_mesh(path)
    monkeypatch.setenv("NEUIDO_MAX_MESH_BYTES", "10")
    with pytest.raises(UserError, match="NEUIDO_MAX_MESH_BYTES"):
        read_mesh(path)


def test_missing_libraries_are_named(tmp_path, monkeypatch):
    import sys

    for suffix, module, extra in (("obj", "trimesh", "mesh"), ("usda", "pxr.Sdf", "usd")):
        path = write(tmp_path / f"box.{suffix}")
        monkeypatch.setitem(sys.modules, module, None)
        with pytest.raises(UserError, match=rf"pip install 'neuido\[{extra}\]'"):
            read_mesh(path)
