"""What cannot be done is refused before work begins, and the clock does not say what is newer."""

import os
import tracemalloc
from pathlib import Path

import pytest

from neuido.commands.simulation.trajectories import trajectories
from neuido.commands.sweep import logged
from neuido.data.bodies.scene_files import scene_from_dict
from neuido.data.files.parsing import read_arrays, read_image
from neuido.data.files.results import logged_curves
from neuido.discrepancy import workflow
from neuido.errors import UserError
from tests.command import run
from tests.faults.mutations import bomb, png_bomb

PLANE = {"type": "plane", "point": [0.0, 0.0, 0.0], "normal": [0.0, 1.0, 0.0], "contact": "separate", "friction": 0.0}
SCENE = {"domain": [[0.0, 0.0, 0.0], [1.0, 1.0, 1.0]], "gravity": [0.0, -9.8, 0.0]}


def test_logs_are_ordered_by_their_version(tmp_path):
    for time, version in ((3, 2), (1, 10), (2, 9)):  # as a copy of a folder may date them
        path = tmp_path / f"version_{version}" / "metrics.csv"
        path.parent.mkdir()
        path.write_text(f"step,loss\n1,{version}\n")
        os.utime(path, (time, time))
    assert logged(tmp_path)["loss"] == 10
    assert logged_curves(tmp_path)["loss"] == [(1.0, 10.0)]


def test_out_below_a_file_is_refused_before_work(tmp_path, monkeypatch):
    (tmp_path / "file").write_text("")
    monkeypatch.setattr("neuido.commands.simulation.trajectories.make_trajectories", lambda *a, **k: pytest.fail("work began"))
    with pytest.raises(UserError, match="is a file"):
        trajectories(str(tmp_path / "file" / "out"))
    monkeypatch.setattr(workflow, "choose_device", lambda *a, **k: pytest.fail("work began"))
    monkeypatch.setattr(workflow, "kind_of", lambda folder: ("experiment", Path(folder)))
    with pytest.raises(UserError, match="is a file"):
        workflow.diagnose(tmp_path, out=tmp_path / "file" / "out")
    assert [path.name for path in tmp_path.iterdir()] == ["file"]


WRITING = {  # command: its arguments but for --out
    "simulate": ["nclaw-cube"],
    "trajectories": [],
    "scenes": ["--config", "six_small"],
    "undeclared": ["--seed", "1"],
    "replay": ["absent"],
    "reconstruct": ["absent"],
    "film": [],
    "latents": [],
    "sweep": ["sweeps/views"],
    "report": ["absent"],
    "import": ["absent.csv"],
    "demo": [],
}


@pytest.mark.parametrize("command", WRITING)
def test_every_command_tests_its_folder_before_work(command, tmp_path, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "file").write_text("kept")
    status, out, err = run(capsys, command, *WRITING[command], "--out", "file/below/out.html")
    assert (status, out, err.count("\n")) == (2, "", 1)
    assert "file is a file" in err and "out = file/below" in err.replace(f"{tmp_path}/", "")
    assert [path.name for path in tmp_path.iterdir()] == ["file"] and (tmp_path / "file").read_text() == "kept"


def test_too_many_colliders_are_refused(monkeypatch):
    numbers = {"grid": 8, "dt": 1e-4}
    assert len(scene_from_dict(SCENE | {"colliders": [PLANE] * 3}, numbers).colliders) == 3
    monkeypatch.setenv("NEUIDO_MAX_COLLIDERS", "2")
    with pytest.raises(UserError, match="NEUIDO_MAX_COLLIDERS"):
        scene_from_dict(SCENE | {"colliders": [PLANE] * 3}, numbers)


@pytest.mark.parametrize(
    ("name", "content", "read", "limit"),
    [
        ("bomb.npz", lambda: bomb((2_000_000,)), lambda path: read_arrays(path, ["x"]), "NEUIDO_MAX_ARRAY_ELEMENTS"),
        ("bomb.png", lambda: png_bomb(4_000, 4_000), read_image, "NEUIDO_MAX_IMAGE_PIXELS"),
    ],
)
def test_a_small_file_of_much_content_is_refused_before_it_is_unpacked(name, content, read, limit, tmp_path, monkeypatch):
    path = tmp_path / name
    path.write_bytes(content())
    unpacked = 16_000_000
    assert path.stat().st_size < unpacked / 500
    assert read(path) is not None  # whole, and below the usual limit
    monkeypatch.setenv(limit, "1000000")
    tracemalloc.start()
    with pytest.raises(UserError, match=rf"{name}.*the limit of 1000000.*{limit}"):
        read(path)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < unpacked / 10
