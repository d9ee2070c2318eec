"""The folder of a plane specimen: what is read, and one line for each misuse."""

import shutil

import numpy as np
import pytest
import yaml

from neuido.commands.main import main
from neuido.data.measured.plane_experiment import read_plane_experiment
from neuido.errors import PlausibilityWarning, UserError

NODES = [(0, 0, "left", "low"), (1, 0, "right", "low"), (1, 1, "right", ""), (0, 1, "left", ""), (0.5, 0.4, "", "")]
MODEL = {"elasticity": {"law": "neo_hookean", "young": 1e6, "poisson": 0.3}, "free": ["young", "poisson"]}


def folder(path, *, nodes=NODES, elements=((0, 1, 4), (1, 2, 4), (2, 3, 4), (3, 0, 4)), moved=None, forces="right_x\n1600\n3500\n", **more):
    """Write a square that is pulled along x in two load steps."""
    path.mkdir(exist_ok=True)
    (path / "nodes.csv").write_text("x,y,boundary_x,boundary_y\n" + "".join(",".join(map(str, row)) + "\n" for row in nodes))
    titles = ",".join(f"node{i + 1}" for i in range(max(map(len, elements))))
    (path / "elements.csv").write_text(titles + "\n" + "".join(",".join(map(str, row)) + "\n" for row in elements))
    for step, size in enumerate((0.1, 0.2)):
        u = [(size * x, -0.3 * size * y) for x, y, *_ in nodes] if moved is None else moved(step, nodes)
        (path / f"u{step}.csv").write_text("ux,uy\n" + "".join(f"{a},{b}\n" for a, b in u))
    (path / "f.csv").write_text(forces)
    entry = {"name": "pull", "role": "fit", "displacements": ["u0.csv", "u1.csv"], "forces": "f.csv"} | more.pop("entry", {})
    content = {"format": "neuido-plane/1", "name": "square", "model": more.pop("model", MODEL), "recordings": [entry]}
    content["specimen"] = {"nodes": "nodes.csv", "elements": "elements.csv", "thickness": 0.02, "condition": "stress"} | more.pop(
        "specimen", {}
    )
    (path / "plane.yaml").write_text(yaml.safe_dump(content | more))
    return path


def test_a_folder_is_read(tmp_path):
    found = read_plane_experiment(folder(tmp_path / "a", boundary={"left_x": "held", "right_x": "rigid"}))
    assert [(part.name, part.motion, part.nodes.tolist()) for part in found.boundary] == [
        ("left_x", "held", [0, 3]), ("right_x", "rigid", [1, 2]), ("low_y", "measured", [0, 1])
    ]  # fmt: skip
    (one,) = found.recordings
    np.testing.assert_allclose(one.displacement[1, 2], [0.2, -0.06])
    np.testing.assert_allclose(one.force[:, 1], [1600, 3500])
    assert np.isnan(one.force[:, [0, 2]]).all() and one.displacement_noise is None
    assert found.prescribed.sum() == 6 and len(found.specimen.triangles) == 4


def test_quadrilaterals_are_cut_in_two(tmp_path):
    found = read_plane_experiment(folder(tmp_path / "a", nodes=[*NODES[:4], (2, 0, "", "")], elements=((0, 1, 2, 3), (1, 4, 2, ""))))
    assert found.specimen.triangles.tolist() == [[0, 1, 2], [1, 4, 2], [0, 2, 3]]


def test_what_was_not_measured_is_empty(tmp_path):
    moved = lambda step, nodes: [(0.1 * x, 0) for x, *_ in nodes[:4]] + [("nan", 0.01)]  # noqa: E731
    found = read_plane_experiment(folder(tmp_path / "a", moved=moved, forces="right_x\nnan\n3500\n"))
    np.testing.assert_array_equal(np.isnan(found.recordings[0].displacement), [[[False] * 2] * 4 + [[True, False]]] * 2)
    assert np.isnan(found.recordings[0].force[:, 1]).tolist() == [True, False]


def turned(step, nodes):
    return [(-2.0 * x, 0.0) for x, *_ in nodes]


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"nodes": [(*row[:2], "", "") for row in NODES]}, "the specimen can move freely: name in boundary_x"),
        ({"nodes": [*NODES, (3, 3, "", "")]}, "1 nodes belong to no triangle, the first is 5"),
        ({"entry": {"continues": "later"}}, "continues = .later. must name an earlier recording: there is none"),
        ({"elements": ((0, 1, 4), (1, 2, 9))}, "triangles name the nodes 0 to 9, and there are 5"),
        ({"elements": ((0, 1, 4), (1, 2, 2.5))}, "must be whole numbers, counted from 0"),
        ({"nodes": [(1e3 * row[0], 1e3 * row[1], *row[2:]) for row in NODES]}, "the specimen is 1000 m large: give places in m"),
        (
            {"nodes": [("a", *NODES[0][1:]), *NODES[1:]], "moved": lambda step, nodes: [(0.1, 0)] * 5},
            "nodes.csv, line 2, x is 'a', which is no number",
        ),
        ({"moved": lambda step, nodes: [(0, 0)] * 5}, "all displacements are zero"),
        ({"moved": lambda step, nodes: [(100 * x, 0) for x, *_ in nodes]}, "a node moves by 100 m in load step 0"),
        ({"moved": turned}, "load step 0 turns 4 of 4 triangles inside out"),
        ({"moved": lambda step, nodes: [(0.1, 0)] * 4}, "u0.csv has 4 rows and there are 5 nodes"),
        ({"moved": lambda step, nodes: [("nan", "nan"), *[(0.1 * x, 0) for x, *_ in nodes[1:]]]}, "node 0 of left_x has no displacement"),
        ({"forces": "right_x\n0\n0\n"}, "all forces are zero"),
        ({"forces": "right_x\n1600\n"}, "f.csv has 1 rows and there are 2 load steps"),
        ({"forces": "right\n1600\n3500\n"}, "f.csv names no part of the boundary: title its columns left_x, right_x, low_y"),
        ({"forces": "right_x\n-1600\n-3500\n"}, "work against the motion"),
        ({"forces": "right_x\n1.6e9\n3.5e9\n"}, "check the units"),
        ({"entry": {"forces": None}}, "young changes no displacement here"),
        ({"entry": {"noise": {"displacement": 0}}}, "noise.displacement"),
        ({"entry": {"role": "held_out"}}, "no entry with role fit"),
        ({"entry": {"displacements": []}}, "must be a list of files"),
        ({"entry": {"displacements": ["u0.csv", "../u1.csv"]}}, "u1.csv"),
        ({"boundary": {"top_x": "held"}}, "boundary.top_x is no part of the boundary"),
        ({"boundary": {"left_x": "fixed"}}, "choose from measured, rigid, held"),
        ({"specimen": {"thickness": 0}}, "specimen.thickness"),
        ({"specimen": {"condition": "plane"}}, "choose from strain, stress"),
        ({"model": {"elasticity": MODEL["elasticity"] | {"law": "hooke"}}}, "model.elasticity.law = 'hooke' is not known"),
        ({"model": MODEL | {"free": ["density"]}}, "unknown parameter 'density'"),
        ({"model": MODEL | {"effects": {"geometric_nonlinearity": 0.5}}}, "is a law of large deformation already"),
    ],
)
def test_a_folder_that_is_none(change, message, tmp_path):
    with pytest.raises(UserError, match=message) as error:
        read_plane_experiment(folder(tmp_path / "a", **change))
    assert "\n" not in str(error.value)


def test_odd_forces_are_said(tmp_path):
    with pytest.warns(PlausibilityWarning, match="check the units"):
        read_plane_experiment(folder(tmp_path / "a", forces="right_x\n1.6e5\n3.5e5\n"))
    with pytest.warns(PlausibilityWarning, match="add up to 50% of the largest"):
        read_plane_experiment(folder(tmp_path / "a", forces="right_x,left_x\n1600,-800\n3500,-1750\n"))


def test_check_says_what_is_there(tmp_path, capsys):
    with pytest.raises(SystemExit, match="0"):
        main(["check", str(folder(tmp_path / "a"))])
    assert "plane specimen square, 1 recording" in capsys.readouterr().out
    shutil.copy(tmp_path / "a" / "plane.yaml", tmp_path / "a" / "track.yaml")
    with pytest.raises(UserError, match="holds both track"):
        from neuido.discrepancy.workflow import kind_of

        kind_of(str(tmp_path / "a"))
