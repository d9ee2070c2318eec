"""The frames of a rollout as files that other programs read."""

import json
from types import SimpleNamespace

import numpy as np
import pytest
import torch

import neuido
from neuido.data.formats.ply import read_ply_vertices
from neuido.errors import UserError
from neuido.types import ParticleState

torch.manual_seed(0)
FRAMES = SimpleNamespace(x=torch.rand(3, 5, 3), v=torch.rand(3, 5, 3), F=torch.rand(3, 5, 3, 3), times=torch.tensor([0.0, 0.1, 0.2]))


def test_archive_holds_every_tensor(tmp_path):
    path = neuido.export(FRAMES, tmp_path / "new" / "motion.npz")
    with np.load(path, allow_pickle=False) as archive:
        assert set(archive) == {"x", "v", "F", "times", "scene"}
        assert np.array_equal(archive["x"], FRAMES.x.numpy())
        assert archive["times"] == pytest.approx(FRAMES.times.numpy())
    assert [p.name for p in path.parent.iterdir()] == ["motion.npz"]


def test_sequence_has_a_file_for_each_frame_and_replaces_a_longer_one(tmp_path):
    (tmp_path / "motion_0007.ply").touch()
    (tmp_path / "motion_final.ply").touch()
    first = neuido.export(FRAMES, tmp_path / "motion.ply")
    names = ["motion.json", "motion_0000.ply", "motion_0001.ply", "motion_0002.ply", "motion_final.ply"]
    assert json.loads((tmp_path / "motion.json").read_text())["series"] == {"motion": names[1:4]}
    assert sorted(p.name for p in tmp_path.iterdir()) == names
    assert first.name == "motion_0000.ply"
    vertices = read_ply_vertices(tmp_path / "motion_0002.ply")
    read = np.stack([vertices[name] for name in ("x", "y", "z", "vx", "vy", "vz")], 1)
    assert np.array_equal(read, torch.cat([FRAMES.x, FRAMES.v], 2)[2].numpy())


def test_table_has_a_row_for_each_frame_and_particle(tmp_path):
    path = neuido.export(FRAMES, str(tmp_path / "motion.csv"))
    header, *rows = path.read_text().splitlines()
    assert header == "frame,time [s],scene,particle,x [m],y [m],z [m],vx [m/s],vy [m/s],vz [m/s]"
    table = np.array([[float(value) for value in row.split(",")] for row in rows])
    assert len(table) == 15
    row = table[(table[:, 0] == 2) & (table[:, 3] == 4)][0]
    assert row[1] == pytest.approx(0.2)
    assert [row[4], row[9]] == pytest.approx([float(FRAMES.x[2, 4, 0]), float(FRAMES.v[2, 4, 2])], rel=1e-6)


def test_frames_of_a_simulator_are_written_as_save_writes_them(tmp_path):
    simulator = neuido.Simulator(
        neuido.Scene(cells=16, dt=1e-3), neuido.shapes.cube(length=0.2, particles_per_side=4), density=1000.0, device="cpu"
    )
    frames = simulator.rollout(20, neuido.laws.FixedCorotated(1e4, 0.3), every=10)
    assert isinstance(frames, neuido.Frames)
    (saved,) = frames.save(tmp_path / "saved.csv")
    assert neuido.export(frames, tmp_path / "motion.csv").read_text() == saved.read_text()
    with np.load(neuido.export(frames, tmp_path / "motion.npz")) as archive:
        assert archive["x"].shape == tuple(frames.x.shape)


def test_motion_without_times_takes_an_interval(tmp_path):
    motion = ParticleState(FRAMES.x, FRAMES.v, FRAMES.F, FRAMES.F)
    assert neuido.export(motion, tmp_path / "motion.ply").is_file()
    with np.load(neuido.export(motion, tmp_path / "motion.npz", frame_interval=0.05)) as archive:
        assert archive["times"] == pytest.approx([0.0, 0.05, 0.1])


@pytest.mark.parametrize(
    ("frames", "path", "word"),
    [
        (FRAMES, "motion.xyz", r"\.ply"),
        (SimpleNamespace(x=torch.rand(5, 3), v=torch.rand(5, 3)), "a.npz", "shape"),
        (SimpleNamespace(x=FRAMES.x), "a.ply", r"frames\.v is absent"),
        (SimpleNamespace(x=FRAMES.x, v=FRAMES.v), "a.csv", "frame_interval"),
        (SimpleNamespace(x=FRAMES.x, v=FRAMES.v, times=[0.0, 0.1, 0.3]), "a.npz", "even times"),
    ],
)
def test_what_cannot_be_written_is_named(frames, path, word, tmp_path):
    with pytest.raises(UserError, match=word):
        neuido.export(frames, tmp_path / path)
    assert not list(tmp_path.iterdir())
