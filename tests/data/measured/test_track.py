import numpy as np
import pytest

from neuido.data.measured.track import read_tracks
from neuido.errors import UserError
from tests.data.refused import assert_refused

YAML = """format: neuido-track/1
name: balls
model:
  gravity: [0, -9.81, 0]
  effects: {drag_quadratic: 0.01, uniform_acceleration: [0.1, 0, 0]}
  free: [gravity]
nuisances: {release_time: 0.1, length_scale: 0.03}
bodies:
  golf: {mass: 0.0459, diameter: 0.0439}
  stone: {}
recordings:
  - {name: golf-1, body: golf, file: golf.csv, columns: {t: time, x: across, y: up}, rows: [1, 5],
     spin: [0, 0, 120.0], noise: 0.3, role: fit}
  - {name: golf-2, body: golf, file: golf.csv, columns: {t: time, y: up}, role: held_out}
  - {name: stone-1, body: stone, file: golf.csv, columns: {t: time, z: up}, role: fit}
"""
GOLF = "time,across,up\n0.0,0,9\n0.1,1,8\n0.2,2,7\n0.3,3,6\n0.4,4,5\n0.5,5,4\n"


@pytest.fixture
def folder(tmp_path):
    (tmp_path / "track.yaml").write_text(YAML)
    (tmp_path / "golf.csv").write_text(GOLF)
    return tmp_path


def test_read(folder):
    tracks = read_tracks(folder)
    assert (tracks.name, tracks.gravity, tracks.free) == ("balls", (0.0, -9.81, 0.0), ("gravity",))
    assert tracks.effects == {
        "drag_quadratic.k": 0.01,
        "uniform_acceleration.x": 0.1,
        "uniform_acceleration.y": 0,
        "uniform_acceleration.z": 0,
    }
    assert tracks.nuisances == {"release_time": 0.1, "length_scale": 0.03, "time_base": 0.0, "spin": 0.2, "attitude": 0.3}
    assert tracks.bodies == {"golf": {"mass": 0.0459, "diameter": 0.0439}, "stone": {}}
    one, two, three = tracks.recordings
    assert tracks.of("fit") == (one, three) and tracks.of("held_out", "golf") == (two,) and tracks.of("held_out", "stone") == ()
    np.testing.assert_array_equal(one.x, [[1, 8], [2, 7], [3, 6], [4, 5]])
    np.testing.assert_allclose(one.t, [0.1, 0.2, 0.3, 0.4])
    assert (one.axes, one.spin, one.noise) == ((0, 1), (0.0, 0.0, 120.0), 0.3)
    assert (two.axes, two.spin, two.noise) == ((1,), None, None) and three.axes == (2,)


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("format: neuido-track/1", "format: neuido-track/2", "format = 'neuido-track/2'"),
        ("name: balls", "title: balls", "unknown key 'title'"),
        ("gravity: [0, -9.81, 0]", "gravity: 9.81", "model.gravity must be three numbers"),
        ("gravity: [0, -9.81, 0]", "gravity: [0, -.inf, 0]", "model.gravity must be a finite number"),
        ("drag_quadratic: 0.01", "viscosity_shear: 0.01", "model.effects has the unknown effect 'viscosity_shear': choose from"),
        ("drag_quadratic: 0.01", "wind: 0.01", "model.effects has the unknown effect 'wind'"),
        ("[0.1, 0, 0]}", "{up: 1}}", "unknown key 'up' in model.effects.uniform_acceleration"),
        ("free: [gravity]", "free: [magnus]", "model.free has the unknown parameter 'magnus': choose from gravity, drag_quadratic.k"),
        ("free: [gravity]", "free: gravity", "model.free must be a list"),
        ("release_time: 0.1", "release: 0.1", "unknown key 'release' in nuisances"),
        ("release_time: 0.1", "release_time: -0.1", "nuisances.release_time must be at least 0"),
        ("mass: 0.0459", "mass: 0", "bodies.golf.mass must be above 0"),
        ("mass: 0.0459", "weight: 1", "unknown key 'weight' in bodies.golf"),
        ("  stone: {}\n", "", r"recordings\[2\] \(stone-1\).body = 'stone' is unknown: choose from golf"),
        ("  stone: {}\n", "  stone: {}\n  feather: {}\n", "recordings has no entry of the body 'feather' with role fit"),
        ("body: golf", "body: [golf]", "is unknown: choose from golf, stone"),
        ("file: golf.csv", "file: gulf.csv", "the file .*gulf.csv is missing"),
        ("file: golf.csv", "file: ../golf.csv", "leaves the folder"),
        ("t: time, x: across", "t: when, x: across", "columns.t = 'when' is not in golf.csv, which has time, across, up"),
        ("t: time, x: across, y: up", "t: time", "columns has none of x, y, z"),
        ("t: time, x: across", "x: across", "columns lacks the key 't'"),
        ("x: across", "w: across", "unknown key 'w' in .*columns"),
        ("rows: [1, 5]", "rows: [5, 1]", r"rows must be \[first row, row after the last\]"),
        ("rows: [1, 5]", "rows: [1, 50]", "exceeds the 6 data rows"),
        ("spin: [0, 0, 120.0]", "spin: 120", "spin must be three numbers"),
        ("noise: 0.3", "noise: 0", "noise must be above 0"),
        ("role: held_out", "role: test", "role = 'test' is unknown"),
        ("name: golf-2", "name: golf-1", "is the name of another recording"),
        ("recordings:", "recordings: []\nmore:", "unknown key 'more'"),
        ("bodies:", "bodies: [", "is not valid YAML"),
    ],
)
def test_malformed(folder, old, new, message):
    assert_refused(read_tracks, folder / "track.yaml", old, new, message)


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("0.2,2,7", "0.1,2,7", "times must increase from row to row, but 0.1 s follows 0.1 s"),
        ("0.2,2,7", "0.2,2,nan", "data row 2, up is 'nan', which is not a finite number"),
        ("0.2,2,7", "0.2,2,", "data row 2, up is '', which is not a finite number"),
        ("0.2,2,7", "0.2", "data row 2, across is missing"),
        ("0.2,2,7", "0.2,2,seven", "up is 'seven', which is not a finite number"),
    ],
)
def test_malformed_table(folder, old, new, message):
    (folder / "golf.csv").write_text(GOLF.replace(old, new))
    with pytest.raises(UserError, match=message):
        read_tracks(folder)


def test_no_folder(tmp_path):
    with pytest.raises(UserError, match=r"track.yaml is missing"):
        read_tracks(tmp_path)


def test_measured(data_root):
    tracks = read_tracks(data_root / "measured" / "bridge-balls")
    assert len(tracks.bodies) == 11 and len(tracks.recordings) == 22 and tracks.bodies["volleyball"] == {}
    for track in tracks.recordings:
        assert 40 < len(track.t) < 60 and track.axes == (1,) and 42 < track.x[0, 0] < 50 and abs(np.diff(track.t) - 1 / 15).max() < 0.04
    assert [track.role for track in tracks.of("fit", "bowling-ball") + tracks.of("held_out", "bowling-ball")] == ["fit", "held_out"]
