"""Frames unpack as a state does, know their times, say what they are in one line, and are saved whole."""

import importlib

import numpy as np
import pytest
import torch

from neuido.data.bodies.shapes import cube
from neuido.data.formats.ply import read_ply_vertices
from neuido.errors import UserError
from neuido.physics import FiniteElements, Frames, Simulator, laws
from neuido.physics.effects import Effects
from neuido.types import Scene

BODY = cube(length=0.2, centre=(0.5, 0.5, 0.5), particles_per_side=4)
LAW = laws.FixedCorotated(2e5, 0.3)


def moved(steps=20, dts=(5e-4, 1e-3)):
    simulator = Simulator([Scene(cells=12, dt=dt) for dt in dts], [BODY] * len(dts), device="cpu")
    return simulator.rollout(steps, LAW, every=10, effects=Effects(maxwell_ratio=0.3, maxwell_time=0.1))


def test_frames_are_a_state_with_times():
    out = moved()
    x, v, C, F = out
    assert x is out.x and F.shape == (3, 128, 3, 3) and v.shape == x.shape and C.shape == F.shape
    assert torch.allclose(out.times, torch.tensor([[0.0, 0.005, 0.01], [0.0, 0.01, 0.02]], dtype=torch.float64), atol=1e-12)
    assert out.history.shape == (3, 128, 6)
    assert moved(dts=(1e-3,)).times.tolist() == pytest.approx([0.0, 0.01, 0.02])
    assert out._replace(x=v).x is v


def test_a_line_says_what_there_is():
    out = moved()
    assert repr(out) == "Frames(3 frames of 128 particles in 2 scenes, the last at 0.01 to 0.02 s, float32 on cpu)"
    for thing in (Simulator(Scene(cells=12), BODY, device="cpu"), FiniteElements(Scene(), BODY, device="cpu"), BODY, LAW,
                  Effects(magnus=BODY.x),
                  laws.VonMises(1e3, torch.tensor([1e5, 2e5]), 0.3), laws.stack([LAW, laws.Sigma(1e5, 0.3)])):  # fmt: skip
        assert "tensor(" not in repr(thing) and "\n" not in repr(thing) and type(thing).__name__ in repr(thing)
    assert repr(LAW) == "FixedCorotated(young 200000 Pa, poisson 0.3)"


def test_finite_elements_return_frames_too():
    out = FiniteElements(Scene(dt=1e-3), BODY, device="cpu").rollout(4, LAW, every=2)
    assert isinstance(out, Frames) and out.times.tolist() == pytest.approx([0.0, 0.002, 0.004])


def test_saved_files_hold_the_frames(tmp_path):
    out = moved()
    (npz,) = out.save(tmp_path / "new" / "a.npz")
    with np.load(npz) as data:
        assert np.array_equal(data["x"], out.x.numpy()) and np.array_equal(data["F"], out.F.numpy())
        assert data["times"].shape == (2, 3) and data["scene"].tolist() == [0] * 64 + [1] * 64
    plys = out.save(tmp_path / "a.ply")
    assert [path.name for path in plys] == ["a_0000.ply", "a_0001.ply", "a_0002.ply"]
    vertices = read_ply_vertices(plys[2])
    assert np.array_equal(vertices["y"], out.x[2, :, 1].numpy()) and np.array_equal(vertices["vz"], out.v[2, :, 2].numpy())
    (csv,) = out.save(tmp_path / "a.csv")
    rows = np.loadtxt(csv, delimiter=",", skiprows=1)
    assert rows.shape == (3 * 128, 10) and rows[-1, :4].tolist() == pytest.approx([2, 0.02, 1, 127])
    assert np.allclose(rows[:, 4:7].reshape(3, 128, 3), out.x.numpy(), atol=1e-8)


def test_a_shorter_series_leaves_nothing_of_a_longer_one(tmp_path):
    moved().save(tmp_path / "a.ply")
    (tmp_path / "a_note.ply").write_text("mine")
    moved(steps=10).save(tmp_path / "a.ply")
    assert sorted(path.name for path in tmp_path.iterdir()) == ["a_0000.ply", "a_0001.ply", "a_note.ply"]


def test_what_cannot_be_saved_is_one_line(tmp_path):
    out = moved(steps=10)
    with pytest.raises(UserError, match=r"must be one of \.npz .*\.ply .*\.csv "):
        out.save(tmp_path / "a.vtk")
    (tmp_path / "file").write_text("")
    with pytest.raises(UserError, match="cannot be written"):
        out.save(tmp_path / "file" / "a.npz")
    assert [path.name for path in tmp_path.iterdir()] == ["file"]


@pytest.mark.skipif(torch.cuda.is_available(), reason="needs a machine without CUDA")
def test_a_device_that_is_not_there_is_one_line():
    for make in (Simulator, FiniteElements):
        assert make(Scene(), BODY).device.type == "cpu"
        for name, word in (("cuda", "0 CUDA devices"), ("cuda:3", "0 CUDA devices"), ("gpu", "auto, cpu, cuda"), ("meta", "cpu and cuda")):
            with pytest.raises(UserError, match=word):
                make(Scene(), BODY, device=name)


def test_public_names_exist():
    rooms = ("", ".laws", ".laws.neural", ".effects", ".mpm", ".fem", ".springs", ".points", ".colliders", ".linalg")
    for package in (importlib.import_module(f"neuido.physics{room}") for room in rooms):
        assert package.__all__ and all(getattr(package, name) is not None for name in package.__all__)
        assert set(package.__all__) <= set(dir(package))
    with pytest.raises(AttributeError, match=r"No neuido\.physics\.laws attribute Nothing"):
        _ = laws.Nothing
