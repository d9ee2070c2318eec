"""A name that a file of measured data gives never becomes a path outside the folder."""

import shutil

import pytest
import yaml

from neuido.data.measured.experiment import read_experiment
from neuido.data.measured.material_test import read_material_tests
from neuido.data.measured.track import read_tracks
from neuido.errors import UserError

ROWS = "a,b\n" + "".join(f"{1 + 0.01 * i},{100 * i}\n" for i in range(9))
TEST = {"name": "uniaxial", "file": "a.csv", "mode": "uniaxial", "columns": {"stretch": "a", "stress": "b"}, "role": "fit"}
TRACK = {"name": "drop", "body": "ball", "file": "a.csv", "columns": {"t": "a", "y": "b"}, "role": "fit"}


def written(folder, name, content):
    (folder / "a.csv").write_text(ROWS)
    (folder / name).write_text(yaml.safe_dump(content))
    return folder


@pytest.mark.parametrize("name", ["../../evil", "/tmp/evil", "a/b", "..", "x" * 500])
def test_names_of_measured_data(tmp_path, name, data_root):
    tracks = {
        "format": "neuido-track/1",
        "name": "t",
        "model": {"gravity": [0, -9.81, 0], "effects": {}, "free": []},
        "bodies": {"ball": {}},
    }
    with pytest.raises(UserError, match="cannot name a file"):
        read_tracks(written(tmp_path, "track.yaml", {**tracks, "recordings": [{**TRACK, "name": name}]}))
    with pytest.raises(UserError, match="cannot name a file"):
        read_tracks(written(tmp_path, "track.yaml", {**tracks, "bodies": {name: {}}, "recordings": [{**TRACK, "body": name}]}))
    case = data_root / "cases" / "faults" / "cases"
    if not case.is_dir():
        pytest.skip("the cases of faults are not here")
    for source, file, read in (
        ("test-name-mathtext", "test.yaml", read_material_tests),
        ("one-particle", "experiment.yaml", read_experiment),
    ):
        folder = tmp_path / source
        shutil.copytree(case / source, folder)
        content = yaml.safe_load((folder / file).read_text())
        content["tests" if "tests" in content else "recordings"][0]["name"] = name
        (folder / file).write_text(yaml.safe_dump(content))
        with pytest.raises(UserError, match="cannot name a file"):
            read(folder)
