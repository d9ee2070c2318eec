import hashlib
import json
import multiprocessing
import os
import shutil
import signal

import numpy as np
import pytest
import torch

from neuido.data.bodies import families
from neuido.data.trajectories import generation as generate
from neuido.data.trajectories import trajectory_files
from neuido.data.trajectories.options import FAMILIES, make_trajectories
from neuido.data.trajectories.reference_viscosity import REFERENCE_RATE, reference_viscosity
from neuido.errors import UserError
from tests.waiting import wait_for

from .conftest import TINY

NAMES = ["jelly", "elastic-001", "elastic-002", "plasticine", "plasticine-001", "plasticine-002", "sand", "sand-001", "sand-002"]
HELD_OUT = [f"{family}-{number:03d}" for family in ("elastic", "plasticine", "sand") for number in (3, 4)]


def files(folder) -> dict[str, bytes]:
    return {path.name: path.read_bytes() for path in folder.iterdir()}


def index(folder) -> dict:
    return json.loads((folder / "index.json").read_text())


def setup(**changes) -> generate.Setup:
    paper = {"seed": 0, "length": 0.5, "angular_velocity": (4.0, 4.0, 4.0), "density": 1e3, "gravity": (0.0, -9.8, 0.0)}
    grid = {"cells": 20, "wall_inset": 2.0, "dt": 5e-4, "record_every": 1, "families": FAMILIES}
    tiny = {key: value for key, value in TINY.items() if key not in ("device", "progress")}
    return generate.Setup(**(paper | grid | tiny | changes))


def test_index(folder):
    entries = index(folder)["trajectories"]
    assert [e["name"] for e in entries] == NAMES + HELD_OUT
    assert [e["split"] for e in entries] == ["train"] * 9 + ["held_out"] * 6
    published = {e["name"]: e["parameters"] for e in entries if e["name"] in ("jelly", "plasticine", "sand")}
    assert published == {
        "jelly": {"young": 1e5, "poisson": 0.2},
        "plasticine": {"young": 3e5, "poisson": 0.25, "yield_stress": 5e3},
        "sand": {"young": 1e6, "poisson": 0.2, "friction_angle": 25.0},
    }
    for entry in entries:
        array = np.load(folder / f"{entry['name']}.npy").astype(np.float64)
        assert array.shape == (30, 64, 27)
        assert np.isfinite(array).all()
        norms = np.sqrt(np.square(array[..., 18:]).sum(-1).mean()), np.sqrt(np.square(array[..., 9:18] - array[..., :9]).sum(-1).mean())
        assert (entry["stress_rms"], entry["residual_rms"]) == pytest.approx(norms)
        assert entry["stress_rms"] > 100.0  # it met the floor
        assert (entry["residual_rms"] > 1e-5) == (entry["family"] != "elastic")
        for name, value in entry["parameters"].items():
            low, high = FAMILIES[entry["family"]][name]
            assert low <= value <= high


def test_parameters_depend_on_seed_family_and_number_alone():
    few, many = (generate.plan(setup(instances=n, held_out=h)) for n, h in ((3, 2), (6, 0)))
    one = {i.name: i.parameters for i in few}
    other = {i.name: i.parameters for i in many}
    shared = set(one) & set(other)
    assert len(shared) == 15
    assert all(one[name] == other[name] for name in shared)
    moved = {i.name: i.parameters for i in generate.plan(setup(seed=1))}
    assert all((moved[name] == one[name]) == (name in families.PARAMETERS or name == "jelly") for name in one)


@pytest.mark.parametrize("name", ["jelly", "plasticine-001", "sand-002", "elastic-004"])
def test_targets_are_the_laws_of_the_stored_inputs(folder, name):
    entry = next(e for e in index(folder)["trajectories"] if e["name"] == name)
    elastic, plastic = families.laws(entry["family"], [entry["parameters"]])
    trial, corrected, stress = torch.from_numpy(np.load(folder / f"{name}.npy")).view(-1, 3, 3, 3).unbind(1)
    if entry["family"] == "elastic":
        assert torch.equal(corrected, trial)
    torch.testing.assert_close(corrected, plastic(trial.double()).float(), rtol=1e-6, atol=1e-7)
    expected = elastic(corrected.double())
    torch.testing.assert_close(stress, expected.float(), rtol=1e-5, atol=1e-7 * float(expected.abs().max()))


def test_trial_follows_from_the_motion(folder):
    """The first recorded trial gradient is I + dt C_1, and C_1 is about the spin of the start."""
    trial = np.load(folder / "sand.npy")[0, :, :9].reshape(-1, 3, 3).mean(0)
    spin = np.array([[0, -4, 4], [4, 0, -4], [-4, 4, 0]])
    assert (trial - np.eye(3)) / 5e-4 == pytest.approx(spin, abs=0.6)


def test_shards_and_batches_make_the_same_bytes(folder, tmp_path):
    for shard in (1, 0):
        make_trajectories(str(tmp_path / "two"), **TINY, shard=shard, shards=2)
        assert (tmp_path / "two" / "index.json").exists() == (shard == 0)
    assert files(tmp_path / "two") == files(folder)
    make_trajectories(str(tmp_path / "batch"), **TINY, batch=4)
    assert files(tmp_path / "batch") == files(folder)


def test_restart_makes_only_what_is_missing_or_cut_short(folder, tmp_path):
    copy = tmp_path / "copy"
    shutil.copytree(folder, copy)
    whole = (copy / "sand-001.npy").read_bytes()
    (copy / "sand-001.npy").write_bytes(whole[:-4])
    (copy / "jelly.npy").write_bytes(b"")
    (copy / "plasticine.npy").unlink()
    (copy / "index.json").unlink()
    (copy / ".sand-001.npy.tmp").write_bytes(b"left behind by a killed run")
    before = {path.name: path.stat().st_mtime_ns for path in copy.glob("*.npy")}
    make_trajectories(str(copy), **TINY)
    assert files(copy) == files(folder)
    after = {path.name: path.stat().st_mtime_ns for path in copy.glob("*.npy")}
    assert {name for name in after if after[name] != before.get(name)} == {"sand-001.npy", "jelly.npy", "plasticine.npy"}


def test_what_its_writer_did_not_leave_is_not_published(folder, tmp_path, capsys):
    """A file of the right size with zeros, as two processes in one folder once left; one without a digest; a digest of another file."""
    copy = tmp_path / "copy"
    shutil.copytree(folder, copy)
    (copy / "index.json").unlink()
    content = (copy / "sand.npy").read_bytes()
    (copy / "sand.npy").write_bytes(content[:2000] + bytes(len(content) - 2000))
    (copy / ".jelly.npy.sha256").unlink()
    shutil.copy(copy / ".sand-001.npy.sha256", copy / ".sand-002.npy.sha256")
    make_trajectories(str(copy), **TINY)
    assert files(copy) == files(folder)
    told = [line.split()[0] for line in capsys.readouterr().out.splitlines() if "is not as it was written" in line]
    assert sorted(told) == ["jelly.npy", "sand-002.npy", "sand.npy"]
    for entry in index(copy)["trajectories"]:
        assert entry["sha256"] == hashlib.sha256((copy / f"{entry['name']}.npy").read_bytes()).hexdigest()


def test_published_trajectories_of_earlier_versions_are_kept(folder, tmp_path, capsys):
    copy = tmp_path / "copy"
    shutil.copytree(folder, copy)
    for path in copy.glob(".*.sha256"):
        path.unlink()
    make_trajectories(str(copy), **TINY)
    assert not list(copy.glob(".*.sha256")) and "again" not in capsys.readouterr().out


def test_segments_do_not_show(folder, tmp_path, monkeypatch):
    monkeypatch.setattr(generate, "SEGMENT", 7)
    make_trajectories(str(tmp_path), **TINY)
    assert files(tmp_path) == files(folder)


def test_record_every(folder, tmp_path, monkeypatch):
    monkeypatch.setattr(generate, "SEGMENT", 8)
    make_trajectories(str(tmp_path), **(TINY | {"record_every": 4}))
    for name in NAMES:
        assert np.array_equal(np.load(tmp_path / f"{name}.npy"), np.load(folder / f"{name}.npy")[3::4])


@pytest.mark.slow
def test_killed_run_leaves_no_broken_file(tmp_path):
    """SIGKILL in the middle: every file that has its name is whole."""
    options = TINY | {"steps": 400, "velocity": (1.0, -1.5, -2.0)}
    worker = multiprocessing.get_context("spawn").Process(target=make_trajectories, args=(str(tmp_path),), kwargs=options)
    worker.start()
    wait_for(lambda: list(tmp_path.glob("*.npy")), worker)
    os.kill(worker.pid, signal.SIGKILL)
    worker.join()
    made = list(tmp_path.glob("*.npy"))
    assert made
    assert len(made) < 15
    assert not (tmp_path / "index.json").exists()
    assert all(trajectory_files.is_complete(path, (400, 64, 27)) for path in made)


@pytest.mark.parametrize(
    ("options", "word"),
    [
        ({"shard": 2, "shards": 2}, "shard"),
        ({"shard": -1}, "shard"),
        ({"device": "tpu"}, "device"),
        ({"batch": -1}, "batch"),
        ({"instances": 0}, "instances"),
        ({"steps": 0}, "steps"),
        ({"record_every": 31}, "record_every"),
        ({"dt": 0.0}, "dt"),
        ({"dt": 8e-3, "velocity": (0.0, 0.0, 0.0)}, "dt is 0.008 s"),
        ({"particles_per_side": 1}, "particles_per_side"),
        ({"length": 1.5}, "domain"),
        ({"families": {}}, "families"),
        ({"families": {"water": {}}}, "water"),
        ({"families": {"elastic": {"young": (1e4, 1e5)}}}, "poisson"),
        ({"families": {"elastic": {"young": (1e4, 1e5), "poisson": (0.1, 0.6)}}}, "poisson"),
        ({"families": {"elastic": {"young": (1e5, 1e4), "poisson": (0.1, 0.2)}}}, "exceeds the upper bound"),
        ({"families": {"elastic": {"young": (0.0, 1e4), "poisson": (0.1, 0.2)}}}, "young"),
    ],
)
def test_errors_are_one_line(tmp_path, options, word):
    with pytest.raises(UserError, match=word) as error:
        make_trajectories(str(tmp_path / "out"), **(TINY | options))
    assert "\n" not in str(error.value)
    assert not (tmp_path / "out").exists() or not list((tmp_path / "out").iterdir())


def test_folders_that_cannot_be_written(folder, tmp_path):
    (tmp_path / "file").write_text("")
    with pytest.raises(UserError, match="is a file"):
        make_trajectories(str(tmp_path / "file"), **TINY)
    with pytest.raises(UserError, match="is a file"):
        make_trajectories(str(tmp_path / "file" / "below"), **TINY)
    with pytest.raises(UserError, match=r"other options \(steps is 30 there and 31 here\)"):
        make_trajectories(str(folder), **(TINY | {"steps": 31}))


@pytest.mark.slow
def test_a_fluid_forgets_its_shape_and_not_its_rotation(tmp_path):
    ranges = {"fluid": {"bulk": (1e5, 1e5), "viscosity": (2.0, 2.0)}}
    make_trajectories(str(tmp_path), **{**TINY, "families": ranges, "instances": 1, "held_out": 0})
    (entry,) = index(tmp_path)["trajectories"]
    assert entry["viscosity"] == pytest.approx(2.0)
    trial, corrected, stress = torch.from_numpy(np.load(tmp_path / f"{entry['name']}.npy")).view(-1, 3, 3, 3).double().unbind(1)
    J = torch.linalg.det(trial)[:, None, None]
    eye = torch.eye(3, dtype=trial.dtype).expand_as(trial)
    torch.testing.assert_close(corrected @ corrected.mT, J ** (2 / 3) * eye, rtol=1e-6, atol=1e-6)  # no shear
    turned = corrected.mT @ trial
    torch.testing.assert_close(turned, turned.mT, rtol=1e-6, atol=1e-6)  # the rotation of the trial gradient
    torch.testing.assert_close(stress, 1e5 / 7 * (J - J**-6) * eye, rtol=1e-3, atol=1.0)


def test_a_power_law_counts_at_the_reference_rate():
    given = {"young": 1e5, "poisson": 0.3, "yield_stress": 1e3, "viscosity": 20.0, "index": 0.5}
    assert reference_viscosity(families.effects("viscoplastic", [given])) == pytest.approx(20.0 * REFERENCE_RATE**-0.5)
    assert reference_viscosity(families.effects("viscoplastic", [given | {"index": 1.0}])) == pytest.approx(20.0)
    assert reference_viscosity(families.effects("sand", [{"young": 1e6, "poisson": 0.2, "friction_angle": 25.0}])) == 0.0
