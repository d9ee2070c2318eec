"""A declared model that cannot run is refused in its simulator's words with the factor that lets it run, and leaves nothing behind."""

import shutil
from dataclasses import replace

import numpy as np
import pytest
import yaml

from neuido.data.measured.experiment import read_experiment
from neuido.discrepancy.inference.least_squares import Covariance, NotFinite
from neuido.discrepancy.problems.body import body_problem
from tests import command
from tests.discrepancy import made


@pytest.fixture(scope="module")
def sound(tmp_path_factory):
    folder = tmp_path_factory.mktemp("sound") / "experiment"
    made.experiment(folder, {}, frames=6, side=4)
    return folder


def changed(sound, folder, *, model=None, discretisation=None, particles=None):
    """A copy of an experiment with other declarations, and particles that a function changes."""
    shutil.copytree(sound, folder)
    content = yaml.safe_load((folder / "experiment.yaml").read_text())
    for part, change in (("model", model), ("discretisation", discretisation)):
        for key, value in (change or {}).items():
            if isinstance(value, dict):
                content[part][key] |= value
            else:
                content[part][key] = value
    (folder / "experiment.yaml").write_text(yaml.safe_dump(content))
    for path in folder.glob("*/particles.npz") if particles else ():
        with np.load(path) as stored:
            arrays = dict(stored)
        particles(arrays)
        np.savez(path, **arrays)
    return folder


def faster(arrays):
    arrays["v0"] = arrays["v0"] * np.float32(1e6)


CASES = {
    "a modulus 100 times too large": ({"model": {"elasticity": {"young": 8e6}}}, "above the limit"),
    "a density in g/cm^3": ({"model": {"density": 1.0}}, "above the limit"),
    "a step longer than a frame": ({"discretisation": {"dt": 0.011}}, "above the limit"),
    "a speed a million times too large": ({"particles": faster}, "crosses a cell"),
}


@pytest.mark.parametrize("case", CASES)
def test_a_model_that_cannot_run_is_refused_with_a_factor_that_lets_it_run(case, sound, tmp_path, capsys):
    change, told = CASES[case]
    folder, out = changed(sound, tmp_path / "given", **change), tmp_path / "out"
    status, _, err = command.run(capsys, "diagnose", folder, "--out", out, "--device", "cpu", "--progress", "false")
    (error,) = (line for line in err.splitlines() if not line.startswith("neuido: odd: "))  # what is odd in the data may be told before
    assert status == 2 and "the declared model cannot run: recording throw:" in error and told in error
    assert not out.exists()
    factor = float(err.split("discretisation.dt times ")[1].split(",")[0])
    experiment = read_experiment(folder)
    assert 0 < factor < 1 and body_problem(experiment).margin({}) < 0
    shorter = tuple(replace(r, scene=replace(r.scene, dt=factor * r.scene.dt)) for r in experiment.recordings)
    assert body_problem(replace(experiment, recordings=shorter)).margin({}) >= 0


def test_a_folder_that_holds_something_keeps_it(sound, tmp_path, capsys):
    folder, out = changed(sound, tmp_path / "given", model={"density": 1.0}), tmp_path / "out"
    out.mkdir()
    (out / "mine.txt").write_text("kept")
    status, _, _ = command.run(capsys, "diagnose", folder, "--out", out, "--device", "cpu", "--progress", "false")
    assert status == 2 and [path.name for path in out.iterdir()] == ["mine.txt"]


def test_one_particle_is_no_body_of_an_experiment(sound, tmp_path, capsys):
    def one(arrays):
        arrays |= {"x0": arrays["x0"][:1], "v0": arrays["v0"][:1], "volume": arrays["volume"][:1]}
        arrays["track"] = 0 * arrays["track"]

    folder = changed(sound, tmp_path / "given", particles=one)
    status, _, err = command.run(capsys, "diagnose", folder, "--out", tmp_path / "out", "--device", "cpu")
    assert status == 2 and "x0 has 1 particles in one place" in err and not (tmp_path / "out").exists()


def test_columns_that_are_not_finite_never_reach_linear_algebra():
    with pytest.raises(NotFinite):
        Covariance.of(1.0, np.array([[1.0], [np.nan]]))
