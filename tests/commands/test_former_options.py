"""What `neuido simulate` did in earlier versions still works, says in one line what it is called now, and does the same."""

import json

import numpy as np
import pytest
import yaml

from neuido.commands.simulation.former_options import current_command
from neuido.errors import UserError
from tests.command import run

SMALL = {
    "instances": 1,
    "held_out": 0,
    "particles_per_side": 3,
    "steps": 20,
    "families": {"elastic": {"young": [1e5, 1e5], "poisson": [0.2, 0.2]}},
}
SCENES = {
    "scenes": [
        {
            "name": "Ball",
            "scene": {"domain": [[0.0, 0.0, 0.0], [1.0, 1.0, 1.0]], "gravity": [0.0, -9.8, 0.0]},
            "discretisation": {"grid": 8, "dt": 2e-3},
            "model": {"density": 1000.0, "elasticity": {"law": "fixed_corotated", "young": 3e4, "poisson": 0.2}},
            "body": {"shape": "ball", "centre": [0.5, 0.5, 0.5], "radius": 0.2, "spacing": 0.1, "velocity": [0.0, -1.0, 0.0]},
        }
    ],
    "film": {"views": 3, "held_out": [1], "width": 24, "height": 24, "frames": 2, "density": 1},
}


def written(content: dict, path) -> str:
    path.write_text(yaml.safe_dump(content, sort_keys=False))
    return str(path)


def test_trajectories_by_their_former_command_are_the_same(tmp_path, capsys):
    more = ["--device", "cpu", "--progress", "false"]
    new = {**{k: v for k, v in SMALL.items() if k not in ("particles_per_side", "steps")}, "setup": {"particles_per_side": 3, "steps": 20}}
    status, _, err = run(capsys, "trajectories", "--config", written(new, tmp_path / "new.yaml"), "--out", tmp_path / "new", *more)
    assert (status, err) == (0, "")
    options = ["--instances=1", "--held_out", "0", "--particles_per_side", "3", "--steps=20", "--families", json.dumps(SMALL["families"])]
    ways = {
        "options": ("simulate", *options),
        "file": ("simulate", "--config", written(SMALL, tmp_path / "old.yaml")),
        "new file": ("simulate", f"--config={tmp_path / 'new.yaml'}"),
        "old file": ("trajectories", "--config", tmp_path / "old.yaml"),
    }
    for name, words in ways.items():
        status, _, err = run(capsys, *words, "--out", tmp_path / name, *more)
        assert status == 0, err
        assert err.count("\n") == 1 and ("`neuido trajectories`" if words[0] == "simulate" else "--setup.length") in err
        for file in ("plan.json", "jelly.npy"):
            assert (tmp_path / name / file).read_bytes() == (tmp_path / "new" / file).read_bytes()


@pytest.mark.slow
def test_scenes_cases_and_recordings_by_their_former_command(tmp_path, capsys):
    config = written({**SCENES, "undeclared": None, "case": {"measured": "body"}, "dt": 5e-4}, tmp_path / "scenes.yaml")
    status, _, err = run(capsys, "simulate", "--config", config, "--out", tmp_path / "film", "--device", "cpu", "--progress", "false")
    assert status == 0, err
    assert err.count("\n") == 1 and "`neuido scenes`" in err and (tmp_path / "film" / "Ball" / "experiment.yaml").is_file()
    config = written({"undeclared": 1, "case": {"measured": "track", "kind": "none"}}, tmp_path / "case.yaml")
    ways = (["simulate", "--config", config], ["simulate", "--undeclared=1", "--case.measured", "track", "--case.kind=none"])
    for i, words in enumerate(ways):
        status, _, err = run(capsys, *words, "--out", tmp_path / str(i) / "a", "--device", "cpu", "--progress", "false")
        assert status == 0, err
        assert err.count("\n") == 1 and "`neuido undeclared`" in err
    first, second = (sorted(p for p in (tmp_path / str(i) / "a").iterdir()) for i in range(2))
    assert [p.read_bytes() for p in first] == [p.read_bytes() for p in second] and np.size(first) > 1


def test_each_job_finds_its_command(tmp_path, capsys):
    config = written({**SCENES, "undeclared": None, "case": {"measured": "body"}, "dt": 5e-4}, tmp_path / "scenes.yaml")
    name, words = current_command("simulate", ["--out", "film", "--config", config])
    assert name == "scenes" and yaml.safe_load(words[-1]) == SCENES
    config = written({"undeclared": 1, "case": {"measured": "track"}}, tmp_path / "case.yaml")
    name, words = current_command("simulate", ["--config=" + config, "--case.kind=none", "--out", "a"])
    assert (name, words[1:]) == ("undeclared", ["--kind=none", "--out", "a"])
    assert yaml.safe_load(words[0].removeprefix("--config=")) == {"seed": 1, "measured": "track"}
    assert capsys.readouterr().err.count("\n") == 2
    name, words = current_command("simulate", ["--config", "{instances: 1, steps: 3}", "--out", "a"])  # the content itself
    assert name == "trajectories" and yaml.safe_load(words[1]) == {"instances": 1, "setup": {"steps": 3}}
    assert capsys.readouterr().err.count("\n") == 1
    name, words = current_command("simulate", ["--experiment", "throws", "--model=after.yaml", "--out", "again"])
    assert (name, words) == ("replay", ["--folder", "throws", "--model=after.yaml", "--out", "again"])
    assert capsys.readouterr().err.count("\n") == 1


@pytest.mark.parametrize("command", ["simulate", "scenes"])
def test_options_of_trajectories_are_not_for_scenes(command, tmp_path, capsys):
    config = written(SCENES, tmp_path / "scenes.yaml")
    for more in (["--config", config, "--instances", "3"], ["--config", written({**SCENES, "instances": 3}, tmp_path / "both.yaml")]):
        status, _, err = run(capsys, command, *more, "--out", tmp_path / "out")
        assert status == 2 and "instances" in err.splitlines()[-1]
        assert command == "simulate" or "no option of neuido scenes" in err
        assert not (tmp_path / "out").exists()


def test_two_jobs_at_once_are_refused(tmp_path):
    for words, told in (
        (["--model", "after.yaml"], "experiment too"),
        (["--experiment", "a", "--undeclared", "3"], "undeclared are both given"),
        (["--undeclared", "3", "--config", written(SCENES, tmp_path / "s.yaml")], "scenes are both given"),
    ):
        with pytest.raises(UserError, match=told):
            current_command("simulate", words)


def test_a_scene_stays_a_scene_and_a_missing_one_is_asked_for(capsys, tmp_path):
    for words in (["bouncy-ball", "--out", "x"], ["own.yaml"], ["--scene", "own", "--steps", "3"], ["--help"], []):
        assert current_command("simulate", words) == ("simulate", words)
    status, _, err = run(capsys, "simulate", "--out", tmp_path / "x")
    assert status == 2 and "scene" in err and err.count("\n") == 1 and not (tmp_path / "x").exists()
