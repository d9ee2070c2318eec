"""The command on folders whose truth is known: answers, files, resuming, and one line for whatever is wrong with a folder."""

import json
import os
import shutil
import signal
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import yaml

import neuido
from neuido.commands.main import main
from neuido.data.measured.experiment import read_experiment
from neuido.discrepancy import diagnose
from neuido.discrepancy.inference.calibration import calibration
from neuido.discrepancy.inference.evidence import evidences, judged
from neuido.discrepancy.inference.search.decision import decide
from neuido.discrepancy.inference.statistics import read_fits
from neuido.discrepancy.problems.body import body_problem
from neuido.discrepancy.problems.settings import SETTINGS
from neuido.discrepancy.report.wording import MORE_LEFT
from neuido.discrepancy.workflow import solved_by
from tests import command
from tests.discrepancy import made
from tests.waiting import wait_for

ROOT = Path(neuido.__file__).parents[1]
DRAGS = ["--effects", "drag_linear,drag_quadratic,gravity", "--progress", "false"]


def run(capsys, *args) -> tuple[int, str, str]:
    return command.run(capsys, "diagnose", *args)


@pytest.fixture(scope="module")
def folders(tmp_path_factory) -> dict[str, Path]:
    """One sound folder of each kind."""
    root = tmp_path_factory.mktemp("folders")
    made.experiment(root / "experiment", {"drag_linear.k": 3.0})
    made.track(root / "track")
    made.material_test(root / "test")
    return {name: root / name for name in ("experiment", "track", "test")}


def change(file: str, *steps):
    """An edit of a YAML file: a path of keys and the new value, or a value that is removed where it is `...`."""
    *path, value = steps

    def edit(folder: Path) -> None:
        content = yaml.safe_load((folder / file).read_text())
        at = content
        for key in path[:-1]:
            at = at[key]
        if value is ...:
            del at[path[-1]]
        else:
            at[path[-1]] = value
        (folder / file).write_text(yaml.safe_dump(content, sort_keys=False))

    return edit


def text(file: str, content: str):
    return lambda folder: (folder / file).write_text(content)


def remove(file: str):
    def edit(folder: Path) -> None:
        path = folder / file
        shutil.rmtree(path) if path.is_dir() else path.unlink()

    return edit


def arrays(**changes):
    """An edit of the arrays of a recording."""

    def edit(folder: Path) -> None:
        path = folder / "throw" / "particles.npz"
        with np.load(path) as archive:
            content = dict(archive)
        for key, f in changes.items():
            content[key] = f(content[key])
        np.savez(path, **{k: v for k, v in content.items() if v is not None})

    return edit


def spoiled(row: int, column: int, value: float):
    def f(a: np.ndarray) -> np.ndarray:
        a = a.copy()
        a.reshape(len(a), -1)[row, column] = value
        return a

    return f


E, T, M = "experiment.yaml", "track.yaml", "test.yaml"
WRONG = {  # kind, what is done to it, words of the line
    "no-file": ("experiment", remove(E), "none of experiment.yaml"),
    "two-kinds": ("experiment", text(T, "format: neuido-track/1\n"), "both"),
    "not-yaml": ("experiment", text(E, "a: [1, 2"), "YAML"),
    "list": ("experiment", text(E, "- 1\n"), "mapping"),
    "binary": ("experiment", lambda f: (f / E).write_bytes(b"\xff\xfe\x00\x81"), "YAML"),
    "format": ("experiment", change(E, "format", "neuido-experiment/9"), "format"),
    "unknown-key": ("experiment", change(E, "colour", "red"), "colour"),
    "no-model": ("experiment", change(E, "model", ...), "model"),
    "law": ("experiment", change(E, "model", "elasticity", "law", "jelly"), "jelly"),
    "young": ("experiment", change(E, "model", "elasticity", "young", -1.0), "young"),
    "density": ("experiment", change(E, "model", "density", 0.0), "density"),
    "free": ("experiment", change(E, "model", "free", ["colour"]), "colour"),
    "effect-name": ("experiment", change(E, "model", "effects", {"jelly.k": 1.0}), "jelly"),
    "effect-part": ("experiment", change(E, "model", "effects", {"drag_linear.q": 1.0}), "q"),
    "effect-text": ("experiment", change(E, "model", "effects", {"drag_linear.k": "much"}), "drag_linear.k"),
    "no-recordings": ("experiment", change(E, "recordings", []), "recordings"),
    "role": ("experiment", change(E, "recordings", 0, "role", "train"), "role"),
    "no-fit": ("experiment", change(E, "recordings", 0, "role", "held_out"), "fit"),
    "twice": ("experiment", change(E, "recordings", 1, "name", "throw"), "throw"),
    "outside": ("experiment", change(E, "recordings", 0, "name", "../throw"), "name"),
    "noise": ("experiment", change(E, "recordings", 0, "noise", -1.0), "noise"),
    "interval": ("experiment", change(E, "recordings", 0, "frame_interval", 1.0), "frame_interval"),
    "grid": ("experiment", change(E, "discretisation", "grid", 1.5), "grid"),
    "step": ("experiment", change(E, "discretisation", "dt", 0.0), "dt"),
    "no-folder": ("experiment", remove("throw"), "throw"),
    "no-arrays": ("experiment", remove("throw/particles.npz"), "particles.npz"),
    "cut-short": (
        "experiment",
        lambda f: (f / "throw/particles.npz").write_bytes((f / "throw/particles.npz").read_bytes()[:300]),
        "particles.npz",
    ),
    "shape": ("experiment", arrays(x=lambda x: x[:, :, :2]), "shape"),
    "infinite": ("experiment", arrays(x=spoiled(3, 2, np.inf)), "infinity"),
    "times": ("experiment", arrays(t=lambda t: t[::-1].copy()), "t must increase from 0"),
    "body": ("experiment", arrays(x0=lambda x: x + 2.0), "outside"),
    "track": ("experiment", arrays(track=lambda i: i + 1000), "track"),
    "neither-track": ("experiment", arrays(track=lambda i: None), "anchor"),
    "too-short": ("experiment", arrays(x=lambda x: x[:3], t=lambda t: t[:3]), "at least 4"),
    "object-array": ("experiment", lambda f: np.savez(f / "throw/particles.npz", x=np.array([{}], dtype=object)), "particles.npz"),
    "t-format": ("track", change(T, "format", "neuido-track/0"), "format"),
    "t-body": ("track", change(T, "recordings", 0, "body", "moon"), "moon"),
    "t-column": ("track", change(T, "recordings", 0, "columns", "y", "height"), "height"),
    "t-file": ("track", remove("ball-0-0.csv"), "ball-0-0.csv"),
    "t-path": ("track", change(T, "recordings", 0, "file", "../../secret.csv"), "file"),
    "t-nan": ("track", text("ball-0-0.csv", "t,x,y\n0,1,1\n0.1,nan,2\n0.2,2,2\n0.3,2,2\n"), "finite"),
    "t-rise": ("track", text("ball-0-0.csv", "t,x,y\n0,1,1\n0.2,1,2\n0.1,2,2\n0.3,2,2\n"), "must increase"),
    "t-effect": ("track", change(T, "model", "effects", {"viscosity_shear.eta": 1.0}), "viscosity_shear"),
    "m-mode": ("test", change(M, "tests", 0, "mode", "torsion"), "torsion"),
    "m-stretch": ("test", text("uniaxial.csv", "stretch,stress\n1,1\n-1.1,2\n1.2,3\n1.3,4\n"), "positive"),
    "m-key": ("test", change(M, "model", "colour", 1), "colour"),
    "m-empty": ("test", text("uniaxial.csv", ""), "empty"),
    "m-role": ("test", change(M, "tests", 0, "role", "guess"), "role"),
    "m-free": ("test", change(M, "model", "free", ["yield_stress"]), "yield_stress"),
}


def test_there_are_thirty_ways():
    assert len(WRONG) >= 30
    assert {kind for kind, *_ in WRONG.values()} == {"experiment", "track", "test"}


@pytest.mark.parametrize("name", WRONG)
def test_wrong_folder_is_one_line(name, folders, tmp_path, capsys):
    kind, spoil, word = WRONG[name]
    folder = tmp_path / "folder"
    shutil.copytree(folders[kind], folder)
    spoil(folder)
    status, out, err = run(capsys, folder, "--out", tmp_path / "out")
    lines = err.splitlines()
    assert (status, len(lines), out) == (2, 1, ""), err
    assert lines[0].startswith("neuido: ")
    assert word in lines[0]
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize(
    ("more", "word"),
    [
        (["--draws", "3"], "draws"),
        (["--max_effects", "9"], "max_effects"),
        (["--device", "abacus"], "abacus"),
        (["--effects", "jelly"], "jelly"),
        (["--effects", "yield"], "drag_linear"),
        (["--model", "nowhere.yaml"], "nowhere.yaml"),
        (["--solver", "abacus"], "abacus"),
        (["--solver", "finite_elements"], "is no body that moves"),
    ],
)
def test_wrong_option_is_one_line(more, word, folders, tmp_path, capsys):
    status, _, err = run(capsys, folders["track"], "--out", tmp_path / "out", *more)
    assert status == 2
    assert len(err.splitlines()) == 1
    assert word in err
    assert not (tmp_path / "out").exists()


def test_one_method_alone(folders):
    problem = solved_by(body_problem(read_experiment(folders["experiment"])), "material_points")
    assert (problem.settings, problem.solvers) == (5, (0,))
    assert all(SETTINGS[i].solver == "material_points" for i in problem.others(0))
    problem = solved_by(body_problem(read_experiment(folders["experiment"])), "finite_elements")
    assert [SETTINGS[i].solver for i in problem.solvers] == ["finite_elements"]


def test_missing_folder(tmp_path, capsys):
    status, _, err = run(capsys, tmp_path / "nowhere", "--out", tmp_path / "out")
    assert (status, len(err.splitlines())) == (2, 1)


def without_time(path: Path) -> dict:
    content = json.loads(path.read_text())
    for part in content.get("bodies", [content]):
        part.pop("seconds")
    return content


@pytest.fixture(scope="module")
def track_answer(folders, tmp_path_factory) -> Path:
    out = tmp_path_factory.mktemp("track")
    with pytest.raises(SystemExit) as stop:
        main(["diagnose", str(folders["track"]), "--out", str(out), *DRAGS])
    assert stop.value.code == 0
    return out


@pytest.mark.slow
def test_track_finds_its_drag(track_answer):
    content = json.loads((track_answer / "diagnosis.json").read_text())
    assert content["answer"] in ("effect", "class")
    (effect,) = content["effects"]
    assert "drag_quadratic" in effect["class"]
    assert content["error"]["after"]["held_out"] < 0.2 * content["error"]["before"]["held_out"]
    assert {p.name for p in track_answer.iterdir()} == {
        "diagnosis.json",
        "report.html",
        "model_after.yaml",
        "trace.json",
        "log.csv",
        "predicted",
    }
    assert (track_answer / "log.csv").read_text().startswith("seconds,body,stage,simulations\n")


@pytest.mark.slow
def test_killed_run_goes_on_to_the_same_answer(folders, track_answer, tmp_path):
    """Killed outright after some predictions are stored; the same command then finds them and ends with the same figures."""
    out = tmp_path / "out"
    command = [sys.executable, "-m", "neuido", "diagnose", str(folders["track"]), "--out", str(out), *DRAGS]
    process = subprocess.Popen(command, cwd=ROOT, env={**os.environ, "OMP_NUM_THREADS": "1"}, stdout=subprocess.DEVNULL)
    wait_for(lambda: len(list(out.glob(".work/*/0/*.npy"))) >= 6, process)
    process.send_signal(signal.SIGKILL)
    process.wait()
    kept = list(out.glob(".work/*/0/*.npy"))
    assert not (out / "diagnosis.json").exists()
    before = {p.name: p.stat().st_mtime_ns for p in kept}
    again = subprocess.run(command, cwd=ROOT, env={**os.environ, "OMP_NUM_THREADS": "1"}, capture_output=True, text=True, check=True)
    assert again.stdout.startswith("The model lacks quadratic air drag")
    assert len(before) >= 6
    assert not (out / ".work").exists()
    assert without_time(out / "diagnosis.json") == without_time(track_answer / "diagnosis.json")
    assert json.loads((out / "trace.json").read_text()) == json.loads((track_answer / "trace.json").read_text())
    assert (out / "model_after.yaml").read_text() == (track_answer / "model_after.yaml").read_text()


@pytest.mark.slow
def test_track_with_its_drag_declared_lacks_nothing(folders, track_answer, tmp_path, capsys):
    status, out, _ = run(capsys, folders["track"], "--out", tmp_path / "out", "--model", track_answer / "model_after.yaml")
    assert status == 0
    assert out.startswith("Nothing is missing")


@pytest.mark.slow
def test_bodies_are_diagnosed_one_by_one(tmp_path, capsys):
    made.track(tmp_path / "balls", bodies=2)
    options = ["--effects", "drag_linear,drag_quadratic", "--draws", "39"]
    status, _, _ = run(capsys, tmp_path / "balls", "--out", tmp_path / "out", *options)
    assert status == 0
    content = json.loads((tmp_path / "out" / "diagnosis.json").read_text())
    assert [b["body"] for b in content["bodies"]] == ["ball-0", "ball-1"]
    assert [b["answer"] in ("effect", "class") for b in content["bodies"]] == [True, False]
    assert content["bodies"][1]["answer"] == "none"
    models = yaml.safe_load((tmp_path / "out" / "model_after.yaml").read_text())["bodies"]
    assert models["ball-0"]["effects"]
    assert models["ball-1"]["effects"] == {}


@pytest.mark.slow
def test_what_a_decision_rests_on_is_kept_and_decided_again(folders, tmp_path):
    found = diagnose(folders["track"], out=tmp_path / "out", effects=["drag_linear", "drag_quadratic"], draws=39, statistics=True)
    case, fits = read_fits(tmp_path / "out" / "fits" / "0.npz")
    decision = decide(case)
    assert (decision.answer, list(decision.effects)) == (found.answer, [e.name for e in found.effects])
    assert ("drag_quadratic",) in judged(evidences(case, fits), calibration()).sets


@pytest.mark.slow
def test_material_test_finds_its_stiffening(folders, tmp_path, capsys):
    options = ["--effects", "strain_stiffening,yield", "--draws", "39"]
    status, _, _ = run(capsys, folders["test"], "--out", tmp_path / "out", *options)
    assert status == 0
    content = json.loads((tmp_path / "out" / "diagnosis.json").read_text())
    assert "strain_stiffening" in content["effects"][0]["class"]
    model = yaml.safe_load((tmp_path / "out" / "model_after.yaml").read_text())
    assert model["incompressible"] is True
    path = folders["test"].parent / "again"
    shutil.copytree(folders["test"], path)
    change(M, "model", model)(path)
    status, out, _ = run(capsys, path, "--out", tmp_path / "second", *options)
    assert status == 0
    again = json.loads((tmp_path / "second" / "diagnosis.json").read_text())
    assert MORE_LEFT in " ".join(content["words"])
    assert again["answer"] == "unknown" and not again["effects"], "what the first answer left is no other effect"
    assert again["error"]["after"]["held_out"] == pytest.approx(content["error"]["after"]["held_out"], rel=0.02)


@pytest.mark.slow
def test_experiment_closes_the_loop(folders, tmp_path, capsys):
    """Diagnose; put the model that comes out in the folder; diagnose again: nothing is missing."""
    options = ["--effects", "drag_linear,viscosity_shear", "--draws", "39"]
    status, _, _ = run(capsys, folders["experiment"], "--out", tmp_path / "out", *options)
    assert status == 0
    content = json.loads((tmp_path / "out" / "diagnosis.json").read_text())
    assert content["answer"] == "effect"
    (effect,) = content["effects"]
    assert effect["name"] == "drag_linear"
    low, high = effect["parameters"]["k"]["interval90"]
    assert low < effect["parameters"]["k"]["value"] < high
    assert effect["parameters"]["k"]["value"] == pytest.approx(3.0, rel=0.1)
    assert content["after"]["young"]["value"] == pytest.approx(6e4, rel=0.1)
    assert content["error"]["after"]["held_out"] < 1.3 * content["error"]["noise_floor"]
    assert {r["name"] for r in content["rejected"]} == {"viscosity_shear"}
    page = (tmp_path / "out" / "report.html").read_text()
    assert page.count('class="player"') == 1
    assert "viscosity_shear" in page
    with np.load(tmp_path / "out" / "predicted" / "drop.npz") as archive:
        assert archive["after"].shape == archive["measured"].shape == archive["before"].shape
        left = archive["after"] - archive["measured"]
    assert np.sqrt(3 * np.nanmean(left[1:] ** 2)) == pytest.approx(content["error"]["after"]["by_recording"]["drop"], rel=1e-3)

    path = tmp_path / "folder"
    shutil.copytree(folders["experiment"], path)
    change(E, "model", yaml.safe_load((tmp_path / "out" / "model_after.yaml").read_text()))(path)
    status, out, _ = run(capsys, path, "--out", tmp_path / "second", *options)
    assert status == 0
    assert out.startswith("Nothing is missing")
    assert json.loads((tmp_path / "second" / "diagnosis.json").read_text())["effects"] == []


def test_declared_effects_are_simulated_and_are_the_candidates_start(folders):
    """What the model declares is in every prediction, as if the point had it; and a candidate of that name starts from it."""
    from neuido.data.measured.experiment import read_experiment
    from neuido.discrepancy.problems.body import body_problem

    plain = read_experiment(folders["experiment"])
    for effects in (
        {"drag_linear.k": 3.0},
        {"time_force.sx": 4.0, "time_force.frequency": 9.0},
        {"stiffness_gradient.x": 1.0},
        {"time_force.y0": 3.0, "time_force.y4": -3.0},
    ):
        model = {**plain.model, "free": ["young"], "effects": effects}
        declared = body_problem(read_experiment(folders["experiment"], model=model))
        (with_it,) = declared.predict([{"young": 6e4}], 0)
        (asked,) = body_problem(plain).predict([{"young": 6e4, **effects}], 0)
        (without,) = body_problem(plain).predict([{"young": 6e4}], 0)
        np.testing.assert_allclose(with_it, asked, atol=1e-6)
        assert np.abs(with_it - without).max() > 1e-3
        for name, value in effects.items():
            assert value in [p.value for c in declared.candidates for p in c.parameters if p.name == name]
            assert declared.model_after({"young": 6e4}, [])["effects"][name] == value
