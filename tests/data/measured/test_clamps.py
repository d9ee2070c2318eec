"""Clamps that move and measure a force: the files, the means between frames, and what is refused."""

import re

import numpy as np
import pytest
import torch
import yaml

from neuido.commands.check import check
from neuido.data.measured.clamps import Clamp, MeasuredForce, carried
from neuido.data.measured.experiment import read_experiment, write_experiment
from neuido.data.undeclared import Case, make_undeclared
from neuido.errors import PlausibilityWarning, UserError
from neuido.types import Box, Keyframes


@pytest.fixture(scope="module")
def pulled(tmp_path_factory):
    """A made bar that is pulled at one end."""
    folder = tmp_path_factory.mktemp("made") / "bar"
    make_undeclared(3, str(folder), case=Case(measured="driven", kind="none", seconds=0.1), device="cpu", progress=False)
    return folder


@pytest.fixture
def copied(pulled, tmp_path):
    """A copy of it that may be changed."""
    folder = tmp_path / "bar"
    write_experiment(read_experiment(pulled), folder)
    return folder


def changed(folder, change):
    content = yaml.safe_load((folder / "experiment.yaml").read_text())
    change(content)
    (folder / "experiment.yaml").write_text(yaml.safe_dump(content))


def test_a_folder_is_read_written_and_checked(pulled, copied, capsys):
    first, again = read_experiment(pulled), read_experiment(copied)
    for a, b in zip(first.recordings, again.recordings, strict=True):
        assert [c.name for c in a.clamps] == [c.name for c in b.clamps] == ["lower", "upper"]
        assert a.clamps[0].motion is None and a.clamps[1].motion.smooth and a.clamps[1].motion == b.clamps[1].motion
        np.testing.assert_allclose(b.clamps[1].force.values, a.clamps[1].force.values, rtol=1e-9)
        assert np.isnan(a.clamps[1].force.values[:, 2]).all() and a.clamps[1].force.noise == b.clamps[1].force.noise
        assert not a.scene.attachments and [one.to for one in a.held_scene.attachments] == ["lower", "upper"]
    check(str(copied))
    assert "plausible" in capsys.readouterr().out


def test_means_are_those_of_the_integral():
    t = np.linspace(0.0, 1.0, 201)
    values = np.stack([t**2, np.full_like(t, np.nan), np.where(t < 0.3, np.nan, 1.0)], 1)
    means, counts = MeasuredForce(t, values).means(np.array([0.0, 0.25, 0.5, 1.0]))
    np.testing.assert_allclose(means[:, 0], [0.25**2 / 3, (0.5**3 - 0.25**3) / 0.75, (1 - 0.5**3) / 1.5], rtol=1e-3)
    assert np.isnan(means[:, 1]).all() and np.isnan(means[:2, 2]).all() and means[2, 2] == 1.0
    assert counts[:, 0].tolist() == [50, 50, 101] and counts[0, 2] == 0


def test_a_clamp_carries_points_rigidly():
    """A quarter turn about z while the reference point moves: only the change of the pose counts."""
    half = 0.5**0.5
    path = Keyframes((0.0, 1.0), ((1.0, 0.0, 0.0), (1.0, 2.0, 0.0)), ((half, 0.0, half, 0.0), (0.5, -0.5, 0.5, 0.5)))
    found = carried(Clamp("a", Box((0, 0, 0), (1, 1, 1)), path), torch.tensor([[2.0, 0.0, 3.0]], dtype=torch.float64), np.array([0.0, 1.0]))
    np.testing.assert_allclose(found[0], [[2.0, 0.0, 3.0]], atol=1e-12)
    np.testing.assert_allclose(found[1], [[1.0, 3.0, 3.0]], atol=1e-12)


def _first(content):
    return content["recordings"][0]["clamps"]


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda c: _first(c).update(top={"motion": "a.csv"}), "has no clamp of that name; it has lower, upper"),
        (lambda c: _first(c)["upper"].update(motion="no.csv"), "the file .*no.csv is missing"),
        (lambda c: _first(c)["upper"].update(motion="pull1/upper_force.csv"), "no column 'x'"),
        (lambda c: _first(c)["upper"].update(force="pull1/upper_motion.csv"), "title its columns fx, fy, fz"),
        (lambda c: _first(c)["lower"].pop("force"), "noise is that of a force, and there is none"),
        (lambda c: _first(c)["upper"].update(speed=1.0), "unknown key 'speed'"),
        (lambda c: c["scene"]["clamps"][0].update(name="upper"), "is the name of another clamp"),
        (lambda c: c["scene"]["clamps"][0].update(box=[[0, 0, 0], [0.01, 0.01, 0.01]]), "its box holds no particle"),
    ],
)
def test_entries_that_are_none(copied, change, message):
    changed(copied, change)
    with pytest.raises(UserError, match=message):
        read_experiment(copied)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda rows: rows[:-6], r"is known from 0 to .* s, and the frames are from 0 to 0.1 s"),
        (lambda rows: rows[3:], "is known from 0.03"),
        (lambda rows: rows[::-1], "times must increase"),
        (lambda rows: rows * np.array([1.0, 1e3, 1e3, 1e3]), "give it in m"),
        (lambda rows: np.where(np.arange(len(rows))[:, None] == 4, [0.04, np.nan, 0, 0], rows), "x is empty in data row 4"),
        (lambda rows: rows[:1], "has one row"),
    ],
)
def test_paths_that_are_none(copied, change, message):
    path = copied / "pull1" / "upper_motion.csv"
    rows = np.loadtxt(path, delimiter=",", skiprows=1)
    np.savetxt(path, change(rows), delimiter=",", header="t,x,y,z", comments="")
    with pytest.raises(UserError, match=message):
        read_experiment(copied)


def test_half_a_rotation_is_said(copied):
    path = copied / "pull1" / "upper_motion.csv"
    path.write_text(re.sub("(?m)$", ",1,0,0", path.read_text().strip()).replace("z,1,0,0", "z,qw,qx,qy") + "\n")
    with pytest.raises(UserError, match="a quaternion of four columns"):
        read_experiment(copied)


def test_points_that_do_not_follow_their_clamp_are_odd(copied):
    """A path along another axis than that of the points."""
    changed(copied, lambda content: content["scene"]["clamps"][1].update(box=[[0, 0.2, 0], [0.18, 0.45, 0.18]]))
    path = copied / "pull1" / "upper_motion.csv"
    rows = np.loadtxt(path, delimiter=",", skiprows=1)
    np.savetxt(path, rows[:, [0, 2, 3, 1]], delimiter=",", header="t,x,y,z", comments="")
    with pytest.warns(PlausibilityWarning, match="are its axes, unit and clock those of the points"):
        read_experiment(copied)
