"""Tables of nodes, elements, displacements and forces become a folder of a plane specimen."""

import numpy as np
import pytest

import neuido
from neuido.errors import UserError

NODES = [(1, 0, 2, 3), (1, 1, 2, 0), (0, 1, 1, 0), (0, 0, 1, 3), (0.5, 0.4, 0, 0)]
"""The second part of the boundary comes before the first."""
OPTIONS = {"units": {"displacement": "mm", "force": "N"}, "condition": "stress"}


def raw(path, *, first: int = 0) -> list[str]:
    """Write three load steps of a square as a finite element program does, each with the places of its nodes."""
    files = []
    for step in (2, 10, 11):
        u = [(0.01 * step * x, -0.003 * step * y) for x, y, *_ in NODES]
        rows = [(i + 10, x, y, *moved, bx, by) for i, ((x, y, bx, by), moved) in enumerate(zip(NODES, u))]
        text = "id,x,y,ux,uy,bcx,bcy\n" + "".join(",".join(map(str, row)) + "\n" for row in rows)
        (path / f"nodes_{step}.csv").write_text(text)
        (path / f"reactions_{step}.csv").write_text(f"forces\n{-20 * step}\n{20 * step}\n0\n")
        files.append(str(path / f"nodes_{step}.csv"))
    (path / "elements.csv").write_text("node1,node2,node3\n" + "".join(f"{10 + i},{10 + (i + 1) % 4},14\n" for i in range(4)))
    return files


def read(path, files, **more):
    from neuido.data.importers.machines.testing_machine import Specimen

    options = OPTIONS | {"elements": str(path / "elements.csv"), "forces": str(path / "reactions_*.csv")} | more
    options["specimen"] = Specimen(None, None, options.pop("thickness", "2 mm"), None, None)
    return neuido.import_file(files, path / "out", **options)


def test_steps_of_a_finite_element_program(tmp_path):
    lines = read(tmp_path, raw(tmp_path))
    assert any("5 nodes, 4 elements, 3 load steps, plane stress" in line for line in lines)
    assert any("held out: nodes_11" in line for line in lines)
    assert lines[-1].startswith("next: neuido check")
    found = neuido.read_plane_experiment(tmp_path / "out")
    assert [(r.name, len(r.displacement)) for r in found.recordings] == [("fit", 2), ("held_out", 1)]
    assert [r.continues for r in found.recordings] == ["", "fit"]
    assert [part.name for part in found.boundary] == ["2_x", "1_x", "3_y"]
    np.testing.assert_allclose(found.recordings[0].displacement[1, 1], [1e-4, -3e-5])
    np.testing.assert_allclose(found.recordings[1].force, [[220, -220, 0]])
    np.testing.assert_allclose(found.specimen.nodes[4].tolist(), [5e-4, 4e-4])
    assert found.specimen.triangles.tolist()[1] == [1, 2, 4]
    assert found.model["elasticity"]["young"] == pytest.approx(200 / (1e-3 * 2e-3) / 0.1, rel=0.3)


def test_quadrilaterals_beside_triangles(tmp_path):
    files = raw(tmp_path)
    (tmp_path / "elements.csv").write_text("node1,node2,node3,node4\n10,11,12,14\n12,13,14,\n13,10,14,\n")
    assert any("5 nodes, 3 elements" in line for line in read(tmp_path, files))
    assert (tmp_path / "out" / "elements.csv").read_text() == "node1,node2,node3,node4\n0,1,2,4\n2,3,4,\n3,0,4,\n"
    found = neuido.read_plane_experiment(tmp_path / "out")
    assert found.specimen.triangles.tolist() == [[0, 1, 2], [2, 3, 4], [3, 0, 4], [0, 2, 4]]
    assert found.model["elasticity"]["young"] == pytest.approx(200 / (1e-3 * 2e-3) / 0.1, rel=0.3)


def test_places_and_forces_in_tables_of_their_own(tmp_path):
    (tmp_path / "nodes.csv").write_text(
        "x [mm],y [mm],boundary_x,boundary_y\n"
        + "".join(f"{x},{y},{['', 'left', 'right'][bx]},{'low' if by else ''}\n" for x, y, bx, by in NODES)
    )
    for step in (1, 2):
        u = "".join(f"{0.1 * step * x};{-0.03 * step * y}\n" for x, y, *_ in NODES)
        (tmp_path / f"displacement_{step}.csv").write_text("ux;uy\n" + u)
    (tmp_path / "elements.csv").write_text("n1,n2,n3\n1,2,5\n2,3,5\n3,4,5\n4,1,5\n")
    (tmp_path / "forces.csv").write_text("right_x (kN)\n0.2\n0.4\n")
    files = [str(tmp_path / name) for name in ("nodes.csv", "displacement_1.csv", "displacement_2.csv")]
    read(tmp_path, files, forces=str(tmp_path / "forces.csv"), units={}, held_out=["displacement_1"])
    found = neuido.read_plane_experiment(tmp_path / "out")
    assert {r.role: r.force[:, 0].tolist() for r in found.recordings} == {"fit": [400.0], "held_out": [200.0]}


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"thickness": None}, "needs its thickness: give --thickness"),
        ({"condition": None}, "--condition None must be stress .* or strain"),
        ({"units": {"force": "N"}}, "have no unit: give --units.displacement"),
        ({"units": {"displacement": "mm"}}, "the forces have no unit: give --units.force"),
        ({"density": 1000.0}, "--density has no part"),
        ({"held_out": ["nodes_3"]}, "unknown load step 'nodes_3': choose from nodes_2, nodes_10, nodes_11"),
        ({"held_out": ["nodes_2", "nodes_10", "nodes_11"]}, "lists every load step"),
        ({"forces": "none_*.csv"}, "finds 0 files and there are 3 load steps"),
        ({"elements": "missing.csv"}, "missing"),
    ],
)
def test_what_is_missing_is_asked_for(change, message, tmp_path):
    with pytest.raises(UserError, match=message):
        read(tmp_path, raw(tmp_path), **change)
    assert not (tmp_path / "out").exists()


def test_options_of_a_mesh_are_for_fields(tmp_path):
    (tmp_path / "a.csv").write_text("Time (s),Force (N),Displacement (mm)\n" + "".join(f"{i},{i},{i}\n" for i in range(5)))
    with pytest.raises(UserError, match="--condition is for a full field on a mesh"):
        neuido.import_file(str(tmp_path / "a.csv"), None, condition="stress")
