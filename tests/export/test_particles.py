"""The frames of a rollout as files that other programs read."""

from types import SimpleNamespace

import numpy as np
import pytest
import torch
from plyfile import PlyData

import neuido
from neuido.errors import UserError

torch.manual_seed(0)
FRAMES = SimpleNamespace(x=torch.rand(3, 5, 3), v=torch.rand(3, 5, 3), F=torch.rand(3, 5, 3, 3), times=torch.tensor([0.0, 0.1, 0.2]))


def test_archive_holds_every_tensor(tmp_path):
    path = neuido.export(FRAMES, tmp_path / "new" / "motion.npz")
    with np.load(path, allow_pickle=False) as archive:
        assert set(archive) == {"x", "v", "F", "t"}
        assert np.array_equal(archive["x"], FRAMES.x.numpy())
        assert np.array_equal(archive["t"], FRAMES.times.numpy())
    assert [p.name for p in path.parent.iterdir()] == ["motion.npz"]


def test_sequence_has_a_file_for_each_frame_and_replaces_a_longer_one(tmp_path):
    (tmp_path / "motion-007.ply").touch()
    (tmp_path / "motion-final.ply").touch()
    first = neuido.export(FRAMES, tmp_path / "motion.ply")
    assert sorted(p.name for p in tmp_path.iterdir()) == ["motion-000.ply", "motion-001.ply", "motion-002.ply", "motion-final.ply"]
    assert first.name == "motion-000.ply"
    vertices = PlyData.read(str(tmp_path / "motion-002.ply"))["vertex"]
    read = np.stack([vertices[name] for name in ("x", "y", "z", "vx", "vy", "vz")], 1)
    assert np.array_equal(read, torch.cat([FRAMES.x, FRAMES.v], 2)[2].numpy())


def test_table_has_a_row_for_each_frame_and_particle(tmp_path):
    path = neuido.export(FRAMES, str(tmp_path / "motion.csv"))
    table = np.genfromtxt(path, delimiter=",", names=True)
    assert table.dtype.names == ("frame", "particle", "t", "x", "y", "z", "vx", "vy", "vz")
    assert len(table) == 15
    row = table[(table["frame"] == 2) & (table["particle"] == 4)][0]
    assert row["t"] == pytest.approx(0.2)
    assert [row["x"], row["vz"]] == pytest.approx([float(FRAMES.x[2, 4, 0]), float(FRAMES.v[2, 4, 2])], rel=1e-6)


def test_what_a_simulator_returns(tmp_path):
    simulator = neuido.Simulator(
        neuido.Scene(cells=16, dt=1e-3), neuido.shapes.cube(length=0.2, particles_per_side=4), density=1000.0, device="cpu"
    )
    from neuido.physics.laws.classical import material

    frames = simulator.rollout(20, *material({"law": "fixed_corotated", "young": 1e4, "poisson": 0.3}), every=10)
    with np.load(neuido.export(frames, tmp_path / "motion.npz")) as archive:
        assert archive["x"].shape == tuple(frames.x.shape)


@pytest.mark.parametrize(
    ("frames", "path", "word"), [(FRAMES, "motion.xyz", r"\.ply"), (SimpleNamespace(x=torch.rand(5, 3)), "a.npz", "shape")]
)
def test_what_cannot_be_written_is_named(frames, path, word, tmp_path):
    with pytest.raises(UserError, match=word):
        neuido.export(frames, tmp_path / path)
    assert not list(tmp_path.iterdir())
