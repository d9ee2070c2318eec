"""Solid colliders in scene files: each kind is read, the schema and the reader agree, mistakes are one line, and forces are written."""

import json
from pathlib import Path

import numpy as np
import pytest
import yaml

from neuido.data.bodies.collider_entries import mesh_collider
from neuido.data.bodies.scene_files import load_scene, scene_from_dict
from neuido.errors import UserError
from neuido.types import Keyframes, Plane
from tests.command import run

SCHEMA = Path(__file__).parents[3] / "docs" / "formats" / "schemas" / "neuido-scene-1.schema.json"
CUBE = """solid cube
{}endsolid cube
"""
ENTRIES = {
    "plane": {"kind": "plane", "point": [0, 0.1, 0], "normal": [0, 1, 0], "contact": "slip"},
    "half_space": {"kind": "half_space", "position": [0, 0.1, 0], "velocity": [0.1, 0, 0]},
    "sphere": {"kind": "sphere", "radius": 0.1, "mass": 2.0, "spin": [0, 0, 1], "name": "ball"},
    "cuboid": {"kind": "cuboid", "size": [0.5, 0.2, 0.4], "rotation": [1, 0, 0, 0.1], "contact": "sticky", "friction": 0.3},
    "capsule": {"kind": "capsule", "radius": 0.1, "length": 0.2},
    "cylinder": {"kind": "cylinder", "radius": 0.1, "length": 0.2, "path": {"times": [0, 1], "positions": [[0, 0, 0], [0, 1, 0]]}},
    "height_field": {"kind": "height_field", "heights": [[0.0, 0.1], [0.0, 0.1]], "size": [1, 1]},
    "mesh": {"kind": "mesh", "file": "cube.stl", "scale": 0.1, "position": [0.5, 0.1, 0.5]},
}


def write_cube(path: Path, faces: int = 12) -> None:
    """Write the unit cube, or as many of its triangles, as an STL file of text."""
    corners = np.array(np.meshgrid(*[[0.0, 1.0]] * 3, indexing="ij")).reshape(3, -1).T
    quads = [(0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3)]
    triangles = [(a, b, c) for q in quads for a, b, c in ((q[0], q[1], q[2]), (q[0], q[2], q[3]))][:faces]
    text = ""
    for triangle in triangles:
        rows = "".join("vertex {} {} {}\n".format(*corners[i]) for i in triangle)
        text += f"facet normal 0 0 0\nouter loop\n{rows}endloop\nendfacet\n"
    path.write_text(CUBE.format(text))


def scene_file(folder: Path, colliders: list, steps: int = 4) -> Path:
    content = {
        "format": "neuido-scene/1",
        "name": "solids",
        "scene": {"domain": [[0, 0, 0], [1, 1, 1]], "gravity": [0, -9.8, 0], "colliders": colliders},
        "model": {"density": 1000.0, "elasticity": {"law": "fixed_corotated", "young": 3.0e4, "poisson": 0.2}},
        "body": {"shape": "box", "lower": [0.4, 0.32, 0.4], "upper": [0.6, 0.48, 0.6], "spacing": 0.05},
        "discretisation": {"grid": 12, "dt": 1.0e-3},
        "steps": steps,
    }
    path = folder / "scene.yaml"
    path.write_text(yaml.safe_dump(content))
    return path


def agreed(path: Path) -> bool:
    """Return whether the reader takes a scene file, which the schema must too."""
    jsonschema = pytest.importorskip("jsonschema")
    valid = jsonschema.Draft202012Validator(json.loads(SCHEMA.read_text())).is_valid(yaml.safe_load(path.read_text()))
    try:
        load_scene(path)
    except UserError:
        assert not valid
        return False
    assert valid
    return True


def test_each_kind_is_read_and_the_schema_agrees(tmp_path):
    write_cube(tmp_path / "cube.stl")
    assert agreed(scene_file(tmp_path, list(ENTRIES.values())))
    found = load_scene(tmp_path / "scene.yaml").scene.colliders
    assert [type(c).__name__ for c in found] == "Plane HalfSpace Sphere Cuboid Capsule Cylinder HeightField MeshCollider".split()
    assert found[0] == Plane((0.0, 0.1, 0.0), (0.0, 1.0, 0.0), "slip")
    assert found[2].mass == 2.0 and found[2].name == "ball" and found[2].spin == (0.0, 0.0, 1.0)
    assert found[3].rotation == (1.0, 0.0, 0.0, 0.1) and found[3].contact == "sticky" and found[3].friction == 0.3
    assert found[5].path == Keyframes((0.0, 1.0), ((0.0, 0.0, 0.0), (0.0, 1.0, 0.0)))
    assert np.ptp(np.asarray(found[7].vertices), axis=0) == pytest.approx([0.1, 0.1, 0.1])


@pytest.mark.parametrize("kind", ENTRIES)
def test_each_kind_takes_each_motion(kind, tmp_path):
    write_cube(tmp_path / "cube.stl")
    plain = {key: value for key, value in ENTRIES[kind].items() if key not in ("path", "mass", "velocity", "spin")}
    motions = [{"path": {"times": [0, 1], "positions": [[0, 0, 0], [0, 1, 0]]}}, {"velocity": [1, 0, 0], "spin": [0, 0, 1]}]
    motions += [{"mass": 2.0}] * (kind not in ("half_space", "height_field"))
    for motion in motions if kind != "plane" else ():
        assert agreed(scene_file(tmp_path, [plain | motion]))


def test_a_mesh_collider_follows_a_path(tmp_path):
    write_cube(tmp_path / "cube.stl")
    path = Keyframes((0.0, 1.0), ((0.0, 0.0, 0.0), (0.0, 1.0, 0.0)))
    assert mesh_collider(tmp_path / "cube.stl", path=path).path == path


@pytest.mark.parametrize("kind", ENTRIES)
def test_schema_and_reader_refuse_the_same(kind, tmp_path):
    write_cube(tmp_path / "cube.stl")
    entry = ENTRIES[kind]
    for key in entry:
        for value in (None, {"no": "such thing"}):
            changed = {k: v for k, v in entry.items() if k != key} | ({} if value is None else {key: value})
            agreed(scene_file(tmp_path, [changed]))
    assert not agreed(scene_file(tmp_path, [entry | {"surprise": 1}]))


def test_mistakes_are_one_line(tmp_path):
    for entry, message in (
        ({"kind": "sphre", "radius": 0.1}, "kind = 'sphre' is unknown"),
        ({"kind": "sphere", "radius": -1}, r"colliders\[0\].radius"),
        ({"kind": "sphere", "radius": 0.1, "contact": "glue"}, "'glue'"),
        ({"kind": "mesh", "file": "../cube.stl"}, "file"),
        ({"kind": "height_field", "heights": [[0, 1], [0]], "size": [1, 1]}, "rows of different lengths"),
    ):
        with pytest.raises(UserError, match=message) as error:
            load_scene(scene_file(tmp_path, [entry]))
        assert "\n" not in str(error.value)
    with pytest.raises(UserError, match="here colliders are planes"):
        scene_from_dict({"domain": [[0, 0, 0], [1, 1, 1]], "gravity": [0, 0, 0], "colliders": [ENTRIES["sphere"]]}, {"grid": 8, "dt": 1e-3})
    write_cube(tmp_path / "open.stl", faces=11)
    with pytest.raises(UserError, match=r"open\.stl: a MeshCollider is not watertight: 3 edges"):
        mesh_collider(tmp_path / "open.stl")


def test_simulate_writes_the_forces(tmp_path, capsys):
    file = scene_file(tmp_path, [ENTRIES["cuboid"] | {"position": [0.5, 0.2, 0.5], "name": "table"}], steps=20)
    status, printed, err = run(capsys, "simulate", file, "--out", tmp_path / "out", "--every", 10, "--device", "cpu")
    assert status == 0, err
    assert "mean force on table in the last frame: (" in printed
    with np.load(tmp_path / "out" / "frames.npz") as saved:
        assert saved["forces"].shape == saved["torques"].shape == (3, 1, 3)
        assert saved["collider_0_poses"].shape == (3, 4, 4) and saved["force_names"].tolist() == ["table"]
        assert saved["forces"][-1, 0, 1] < 0
        rows = (tmp_path / "out" / "forces.csv").read_text().splitlines()
        assert len(rows) == 4 and rows[-1].startswith('2,0.02,"table",')
        assert float(rows[-1].split(",")[4]) == pytest.approx(saved["forces"][-1, 0, 1], rel=1e-8)
