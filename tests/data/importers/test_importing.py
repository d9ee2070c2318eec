"""A made sample of each layout, imported, and its numbers."""

import numpy as np
import pytest
import yaml
from hypothesis import given, settings
from hypothesis import strategies as st

import neuido
from neuido.data.importers.machines.testing_machine import Specimen
from neuido.errors import UserError

pytest.importorskip("pint")

STRETCH = np.linspace(1, 1.5, 26)
STRESS = 4e5 * (STRETCH - STRETCH**-2)  # Pa


def write(path, lines, encoding="utf-8"):
    path.write_bytes("\r\n".join([*lines, ""]).encode(encoding))
    return path


def comma(value):
    return f"{value:.8f}".replace(".", ",")


def instron(path):
    head = [
        '"Specimen label","1"',
        '"Width","10.0","mm"',
        '"Thickness","2.0","mm"',
        '"Length","50.0","mm"',
        "",
        '"Time","Extension","Load"',
        '"(s)","(mm)","(N)"',
    ]
    rows = zip(np.arange(26) * 0.1, 50 * (STRETCH - 1), STRESS * 20e-6)
    return write(path / "instron.csv", [*head, *(",".join(f'"{v:.8f}"' for v in row) for row in rows)])


def zwick(path):
    rows = zip(100 * (STRETCH - 1), STRESS / 1e6)
    return write(
        path / "zwick.txt", ["Prüfer: Müller", "Dehnung;Spannung", "%;MPa", *(";".join(map(comma, row)) for row in rows)], "cp1252"
    )


def trios(path):
    rows = zip(np.arange(26) * 0.1, STRETCH - 1, STRESS)
    return write(
        path / "trios.txt",
        ["Filename\tsample", "Time\tStrain\tStress", "s\tmm/mm\tPa", *("\t".join(f"{v:.8f}" for v in row) for row in rows)],
    )


def excel(path):
    book = pytest.importorskip("openpyxl").Workbook()
    for row in [["Engineering strain [mm/mm]", "Stress [kPa]"], *zip((STRETCH - 1).tolist(), (STRESS / 1e3).tolist())]:
        book.active.append(row)
    book.save(path / "sheet.xlsx")
    return path / "sheet.xlsx"


@pytest.mark.parametrize("make", [instron, zwick, trios, excel])
def test_testing_machines(tmp_path, make):
    said = neuido.import_file(make(tmp_path), tmp_path / "out")
    (test,) = neuido.read_material_tests(tmp_path / "out").tests
    np.testing.assert_allclose(test.path[:, 0], STRETCH, atol=1e-7)
    np.testing.assert_allclose(test.stress[:, 0], STRESS, rtol=1e-4, atol=1)
    assert (test.time is not None) == (make in (instron, trios)) and "neuido diagnose" in said[-1]


def test_what_only_the_user_knows(tmp_path):
    rows = [f"{50 * (a - 1):.6f},{s * 20e-6:.6f}" for a, s in zip(STRETCH, STRESS)]
    path = write(tmp_path / "bare.csv", ["Extension (mm),Force", *rows])
    for options, words in (
        ({}, "--length"),
        ({"specimen": Specimen("50 mm")}, "--width"),
        ({"specimen": Specimen("50 mm", "1 cm", "2 mm")}, "--units.force"),
        ({"specimen": Specimen("50")}, "with a unit"),
        ({"specimen": Specimen("50 mm", "1 s", "2 mm")}, "cannot be converted to m"),
    ):
        with pytest.raises(UserError, match=words):
            neuido.import_file(path, tmp_path / "out", **options)
        assert not (tmp_path / "out").exists()
    neuido.import_file(path, None, specimen=Specimen("50 mm", "1 cm", "2 mm"), units={"force": "N"})
    assert [file.name for file in tmp_path.iterdir()] == ["bare.csv"]
    neuido.import_file(path, tmp_path / "out", specimen=Specimen("50 mm", "1 cm", "2 mm"), units={"force": "N"})
    np.testing.assert_allclose(neuido.read_material_tests(tmp_path / "out").tests[0].stress[:, 0], STRESS, rtol=1e-3, atol=1)
    with pytest.raises(UserError, match=r"--out .* exists already"):
        neuido.import_file(path, tmp_path / "out")


T = np.arange(31) / 30
FLIGHT = np.stack([2 * T, 1 + 4 * T - 4.905 * T**2, 0.1 * T], 1)


def table(*columns, separator=",", digits=9):
    return [separator.join(f"{v:.{digits}f}" for v in row) for row in zip(*columns)]


def tracker(path):
    return write(path / "tracker.txt", ["mass_A\t\t\t", "t\tx\ty\tz", *table(T, *FLIGHT.T, separator="\t")])


def millimetres(path):
    return write(
        path / "plain.csv", ["Zeit (ms);x (mm);y (mm);z (mm)", *(";".join(map(comma, row)) for row in zip(1e3 * T, *(1e3 * FLIGHT.T)))]
    )


def epoch(path):
    shuffled = np.random.default_rng(0).permutation(31)
    return write(path / "epoch.csv", ["t,x,y,z", *table(1.7e9 + T[shuffled], *FLIGHT[shuffled].T, digits=6)])


def optitrack(path):
    head = ["Format Version,1.23,Take Name,Take 1,Length Units,Millimeters,Coordinate Space,Global",
            ",,Rigid Body,Rigid Body,Rigid Body", ",Name,ball,ball,ball",
            ",ID,1,1,1", ",,Position,Position,Position", "Frame,Time (Seconds),X,Y,Z"]  # fmt: skip
    return write(path / "optitrack.csv", [*head, *(f"{i},{row}" for i, row in enumerate(table(T, *(1e3 * FLIGHT.T))))])


def vicon(path):
    head = ["Trajectories", "30", ",,subject:ball,,", "Frame,Sub Frame,X,Y,Z", ",,mm,mm,mm"]
    return write(path / "vicon.csv", [*head, *(f"{i + 1},0,{row}" for i, row in enumerate(table(*(1e3 * FLIGHT.T))))])


def trc(path):
    head = [
        "PathFileType\t4\t(X/Y/Z)\tball.trc",
        "DataRate\tCameraRate\tNumFrames\tNumMarkers\tUnits",
        "30\t30\t31\t1\tmm",
        "Frame#\tTime\tball\t\t",
        "\t\tX1\tY1\tZ1",
    ]
    return write(path / "ball.trc", [*head, *(f"{i + 1}\t{row}" for i, row in enumerate(table(T, *(1e3 * FLIGHT.T), separator="\t")))])


def c3d(path):
    made = pytest.importorskip("c3d").Writer(point_rate=30.0, point_units="mm", point_scale=-1.0)
    made.set_point_labels(["ball"])
    points = np.zeros((len(FLIGHT), 1, 5), np.float32)
    points[:, 0, :3] = 1e3 * FLIGHT
    made.add_frames([(frame, np.zeros((0, 0))) for frame in points])
    with (path / "ball.c3d").open("wb") as file:
        made.write(file)
    return path / "ball.c3d"


@pytest.mark.parametrize("make", [tracker, millimetres, epoch, optitrack, vicon, trc, c3d])
def test_tracks(tmp_path, make):
    neuido.import_file(make(tmp_path), tmp_path / "out", mass=0.06, diameter=0.07)
    (track,) = neuido.read_tracks(tmp_path / "out").recordings
    np.testing.assert_allclose(track.t, T, atol=2e-6)
    np.testing.assert_allclose(track.x, FLIGHT, atol=2e-6)


def test_a_truncated_c3d_file_is_refused(tmp_path):
    path = c3d(tmp_path)
    path.write_bytes(path.read_bytes()[:-1024])
    with pytest.raises(UserError, match=r"ball\.c3d is truncated: it states 31 frames"):
        neuido.import_file(path, tmp_path / "out")


def test_pixels_of_deeplabcut(tmp_path):
    pixels = np.stack([200 * FLIGHT[:, 0], 1080 - 200 * FLIGHT[:, 1], np.where(np.arange(31) == 5, 0.1, 0.99)], 1)
    head = ["scorer,net,net,net", "bodyparts,ball,ball,ball", "coords,x,y,likelihood"]
    path = write(tmp_path / "dlc.csv", [*head, *(f"{i},{row}" for i, row in enumerate(table(*pixels.T)))])
    with pytest.raises(UserError, match="--frame_rate"):
        neuido.import_file(path, tmp_path / "out")
    with pytest.raises(UserError, match="--scale"):
        neuido.import_file(path, tmp_path / "out", frame_rate=30)
    with pytest.raises(UserError, match="y points down"):
        neuido.import_file(path, tmp_path / "out", frame_rate=30, scale=0.005)
    neuido.import_file(path, tmp_path / "out", frame_rate=30, scale=0.005, y_down=True)
    (track,) = neuido.read_tracks(tmp_path / "out").recordings
    np.testing.assert_allclose(np.diff(track.x[:, 1]), np.diff(np.delete(FLIGHT[:, 1], 5)), atol=1e-6)
    assert len(track.t) == 30


def test_axes_that_are_absent(tmp_path):
    across = 0.3 * T
    plane = write(tmp_path / "plane.csv", ["t (s),y (m),z (m)", *table(T, FLIGHT[:, 1], across)])
    neuido.import_file(plane, tmp_path / "plane")
    (track,) = neuido.read_tracks(tmp_path / "plane").recordings
    assert list(track.axes) == [1, 2]
    np.testing.assert_allclose(track.x, np.stack([FLIGHT[:, 1], across], 1), atol=1e-9)
    height = write(tmp_path / "height.csv", ["t (s),x (m),z (m)", *table(T, across, FLIGHT[:, 1])])
    with pytest.raises(UserError, match=r"has z and no y, which points up: give --columns.y 'z .m.'"):
        neuido.import_file(height, tmp_path / "height")
    neuido.import_file(height, tmp_path / "height", columns={"y": "z (m)"})
    (track,) = neuido.read_tracks(tmp_path / "height").recordings
    np.testing.assert_allclose(track.x, np.stack([across, FLIGHT[:, 1]], 1), atol=1e-9)


def test_particles_of_a_body(tmp_path):
    grid = np.stack(np.meshgrid(*[np.linspace(0.4, 0.6, 4)] * 3, indexing="ij"), -1).reshape(-1, 3)
    lines = [f"{t},{i},{x},{y - 4.905 * t * t},{z}" for t in T[:8] for i, (x, y, z) in enumerate(grid)]
    path = write(tmp_path / "particles.csv", ["t,id,x,y,z", *lines])
    with pytest.raises(UserError, match=r"--density .* --young"):
        neuido.import_file(path, tmp_path / "out")
    neuido.import_file(path, tmp_path / "out", density=1000.0, young=5e4, floor=0.0)
    take = neuido.read_experiment(tmp_path / "out").recordings[0]
    np.testing.assert_allclose(take.body.x, grid, atol=1e-6)
    assert float(take.body.volume.sum()) == pytest.approx(0.008, rel=1e-3) and float(take.body.v.abs().max()) < 1e-5
    assert yaml.safe_load((tmp_path / "out" / "experiment.yaml").read_text())["scene"]["colliders"][0]["point"] == [0.0, 0.0, 0.0]
    late = write(tmp_path / "late.csv", ["t,id,x,y,z", *lines, lines[-1], f"{T[1]},99,0.5,0.5,0.5"])
    said = neuido.import_file(late, None, density=1000.0, young=5e4)
    assert "late: 1 points that are not seen in the first frame are left out" in said
    assert "late.csv: 1 rows repeat the time of a point, of which the last counts" in said
    with pytest.raises(UserError, match="1 rows have a position and no name in column 'id'"):
        neuido.import_file(write(tmp_path / "named.csv", ["t,id,x,y,z", *lines, f"{T[0]},,0.5,0.5,0.5"]), None)
    named = [line.replace(",", ",P", 1) for line in lines]
    said = neuido.import_file(write(tmp_path / "named.csv", ["t,id,x,y,z", *named]), None, density=1000.0, young=5e4)
    assert "named.csv: 64 points by id" in said and any("particles of" in line and "at rest" in line for line in said)


@settings(max_examples=15, deadline=None)
@given(
    start=st.floats(-1e4, 1.8e9),
    unit=st.sampled_from([("s", 1.0), ("ms", 1e3), ("min", 1 / 60)]),
    length=st.sampled_from([("m", 1.0), ("mm", 1e3), ("cm", 1e2)]),
)
def test_any_start_and_unit(tmp_path_factory, start, unit, length):
    folder = tmp_path_factory.mktemp("units")
    head = f"t ({unit[0]}),x ({length[0]}),y ({length[0]})"
    path = write(folder / "a.csv", [head, *table((start + T) * unit[1], *(FLIGHT[:, :2] * length[1]).T)])
    neuido.import_file(path, folder / "out")
    (track,) = neuido.read_tracks(folder / "out").recordings
    np.testing.assert_allclose(track.t, T, atol=1e-5)
    np.testing.assert_allclose(track.x, FLIGHT[:, :2], atol=1e-6)


@pytest.mark.parametrize(
    "content", [b"", b"\0\0\0", b"hello", b"a,b\n1,2\n", b"t,x\n1,nan\n2,nan\n", b"Format Version,1\n", b"scorer\n1,2\n", b"Trajectories\n"]
)
def test_hostile(tmp_path, content):
    (tmp_path / "a.csv").write_bytes(content)
    with pytest.raises(UserError):
        neuido.import_file(tmp_path / "a.csv", tmp_path / "out")
    assert not (tmp_path / "out").exists()
