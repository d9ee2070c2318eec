import re
from dataclasses import replace

import numpy as np
import pytest
import torch

from neuido.data.bodies.scene_files import scene_from_dict
from neuido.data.cameras import project
from neuido.data.measured.experiment import Experiment, Recording, read_experiment, scene_to_dict, write_experiment
from neuido.data.scenes.multiview import SceneViews
from neuido.data.scenes.readers import read_recording
from neuido.errors import UserError
from neuido.physics.laws.classical import material
from neuido.physics.mpm.simulator import Simulator
from neuido.types import AttachedMass, Body, Box, Plane, Scene, Walls
from tests.data import samples
from tests.data.refused import assert_refused

S = samples.Sample()


@pytest.fixture
def folder(tmp_path):
    return samples.experiment(tmp_path / "soft-cube", S)


def test_read(folder):
    experiment = read_experiment(folder)
    assert (experiment.name, experiment.free) == ("soft-cube", ("young", "yield_stress"))
    assert experiment.model == {
        "density": 1000.0,
        "elasticity": {"law": "fixed_corotated", "young": 1e5, "poisson": 0.3},
        "plasticity": {"law": "von_mises", "yield_stress": 2e3},
    }
    plane = Plane((0.0, 0.1, 0.0), (0.0, 1.0, 0.0), "separate", 0.2)
    clamp = Box((0.3, 0.3, 0.3), (0.7, 0.35, 0.7))
    assert experiment.scene == Scene(dt=5e-4, colliders=(plane,), clamps=(clamp,))
    drop, loaded = experiment.recordings
    assert experiment.of("fit") == (drop,) and experiment.of("held_out") == (loaded,) and experiment["loaded"] is loaded
    assert (drop.scene, drop.noise, drop.frame_interval) == (experiment.scene, 5e-4, 0.02)
    mass = AttachedMass(Box((0.3, 0.6, 0.3), (0.7, 0.7, 0.7)), 0.052)
    assert loaded.scene == replace(experiment.scene, gravity=(0.0, 0.0, 0.0), attached_masses=(mass,)) and loaded.noise is None

    arrays = samples.particles(S, track=True)
    np.testing.assert_array_equal(drop.x, arrays["x"])
    np.testing.assert_array_equal(drop.t, arrays["t"])
    np.testing.assert_array_equal(drop.body.volume, arrays["volume"])
    assert drop.track.tolist() == [3, -1, 124] and drop.track.dtype == torch.int64 and drop.anchor is None and drop.body.F is None
    assert drop.seen.sum() == 11 and not drop.seen[1, 2]
    assert loaded.track is None and loaded.anchor.shape == (3, 3) and loaded.body.F[7].diagonal().tolist() == pytest.approx([1.1, 0.9, 1])
    assert len(drop.video.views) == 3 and drop.gaussians == folder / "drop" / "gaussians.ply"
    assert loaded.video is None and loaded.gaussians is None
    assert read_experiment(folder / "experiment.yaml").name == "soft-cube"
    with pytest.raises(UserError, match="choose from drop, loaded"):
        experiment["slam"]


def equal(a, b) -> bool:
    if a is None or b is None:
        return a is b
    missing = a.isnan()  # NaN marks a point that was not seen: it must be missing in both
    return a.dtype == b.dtype and torch.equal(missing, b.isnan()) and torch.equal(a[~missing], b[~missing])


def test_round_trip(folder, tmp_path):
    first = read_experiment(folder)
    write_experiment(first, tmp_path / "copy")
    second = read_experiment(tmp_path / "copy")
    assert (second.name, second.scene, second.model, second.free) == (first.name, first.scene, first.model, first.free)
    for a, b in zip(first.recordings, second.recordings, strict=True):
        assert (a.name, a.role, a.scene, a.frame_interval, a.noise) == (b.name, b.role, b.scene, b.frame_interval, b.noise)
        for key in ("x", "t", "track", "anchor"):
            assert equal(getattr(a, key), getattr(b, key)), key
        for key in ("x", "v", "volume", "F"):
            assert equal(getattr(a.body, key), getattr(b.body, key)), key
        if a.video is not None:
            assert torch.equal(a.video.cameras.viewmats, b.video.cameras.viewmats) and torch.equal(a.video.times, b.video.times)
            assert [p.read_bytes() for row in a.video.images for p in row] == [p.read_bytes() for row in b.video.images for p in row]
            assert b.gaussians.read_bytes() == b"ply\n"
    assert [path.name for path in sorted((tmp_path / "copy" / "drop").iterdir())] == [
        "gaussians.ply", "images", "particles.npz", "transforms.json",
    ]  # fmt: skip
    with pytest.raises(UserError, match="contains an experiment already"):
        write_experiment(first, folder)


def test_write_from_tensors(tmp_path):
    """What a simulation makes needs no file to come from."""
    scene = Scene(cells=16, dt=1e-4, walls=None, gravity=(0.5, -9.8, 0.0))
    x0 = torch.rand(20, 3) * 0.5 + 0.2
    body = Body(x0, torch.zeros(20, 3), torch.full((20,), 1e-3))
    t = 0.01 * torch.arange(3, dtype=torch.float64)
    one = Recording("a", "fit", scene, 0.01, 0.0, x0.expand(3, 20, 3).clone(), t, body, torch.arange(20))
    two = replace(one, name="b", role="held_out", scene=replace(scene, gravity=(0.0, 0.0, 0.0)))
    model = {"density": 900.0, "elasticity": {"law": "sigma", "young": 2e4, "poisson": 0.2}, "plasticity": {"law": "identity"}}
    write_experiment(Experiment("made", tmp_path, scene, model, ("density",), (one, two)), tmp_path / "made")
    again = read_experiment(tmp_path / "made")
    assert again.scene == scene and again["b"].scene == two.scene and again["a"].noise == 0.0 and again.free == ("density",)
    foreign = replace(one, video=read_recording(samples.pacnerf(tmp_path / "pacnerf", S)))
    with pytest.raises(UserError, match=r"has no transforms\.json"):
        write_experiment(Experiment("made", tmp_path, scene, model, (), (foreign,)), tmp_path / "foreign")
    worse = replace(two, scene=replace(scene, cells=32))
    with pytest.raises(UserError, match="differs from the experiment in more than gravity"):
        write_experiment(Experiment("made", tmp_path, scene, model, (), (one, worse)), tmp_path / "other")
    with pytest.raises(UserError, match="leaves the folder"):
        write_experiment(Experiment("made", tmp_path, scene, model, (), (replace(one, name="../b"),)), tmp_path / "third")


def test_scene_to_dict():
    scene = Scene(
        lower=(0.0, 0.0, -1.0), upper=(1.0, 2.0, 1.0), cells=40, dt=1e-4, gravity=(0.0, 0.0, 9.8), clamps=(Box((0, 0, 0), (1, 1, 1)),),
        colliders=(Plane((0.0, 0.1, 0.0), (0.0, 1.0, 0.0), "sticky"),), walls=Walls("slip", 0.0, 2.0),
        attached_masses=(AttachedMass(Box((0, 0, 0), (1, 1, 1)), 0.1),),
    )  # fmt: skip
    assert scene_from_dict(*scene_to_dict(scene)) == scene


# What is wrong is one line that names the key.


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("format: neuido-experiment/1", "format: neuido-experiment/2", "format = 'neuido-experiment/2'"),
        ("name: soft-cube", "name: 7", "name must be text"),
        ("name: soft-cube", "nam: soft-cube", "unknown key 'nam' in the file"),
        ("discretisation: {grid: 32, dt: 5.0e-4}", "", "lacks the key 'discretisation'"),
        ("dt: 5.0e-4", "dt: -1", "discretisation.dt must be above 0"),
        ("gravity: [0, -9.8, 0]", "gravity: [0, -9.8]", "scene.gravity must be three numbers"),
        ("contact: separate", "contact: glue", r"scene.colliders\[0\].contact = 'glue'"),
        ("friction: 0.2", "friction: -0.2", r"scene.colliders\[0\].friction must be at least 0"),
        ("poisson: 0.3", "poisson: 0.6", "model: .*poisson"),
        ("young: 1.0e5", "young: 0", "model: .*young"),
        ("density: 1000.0", "density: heavy", "model.density must be a finite number"),
        ("free: [young, yield_stress]", "free: [young, friction_angle]", "model.free has the unknown parameter 'friction_angle'"),
        ("free: [young, yield_stress]", "free: young", "model.free must be a list"),
        ("free: [young, yield_stress]", "free: [young, young]", "lists a parameter twice"),
        ("role: fit", "role: train", r"recordings\[0\] \(drop\).role = 'train'"),
        ("noise: 0.0005", "noise: -1", r"recordings\[0\] \(drop\).noise must be at least 0"),
        ("noise: 0.0005", "nois: 1", r"unknown key 'nois' in recordings\[0\]"),
        ("frame_interval: 0.02, noise", "frame_interval: 0, noise", "frame_interval must be above 0"),
        ("frame_interval: 0.02, noise", "frame_interval: 20, noise", "t has a frame every 0.02 s, but frame_interval is 20 s"),
        ("name: drop", "name: slam", "the folder .*slam is missing"),
        ("name: drop", "name: .", "cannot name a file"),
        ("name: drop", "name: ../soft-cube/drop", "cannot name a file"),
        ("name: drop", "name: /tmp", "cannot name a file"),
        ("name: loaded", "name: drop", "the name of another recording"),
        ("mass: 0.052", "mass: 0", r"\(loaded\): scene.attached_masses\[0\].mass must be above 0"),
        ("box: [[0.3, 0.6, 0.3], [0.7, 0.7, 0.7]]", "box: [[0.3, 0.7, 0.3], [0.7, 0.9, 0.7]]", r"\(loaded\): attached_masses\[0\].box"),
        ("box: [[0.3, 0.3, 0.3], [0.7, 0.35, 0.7]]", "box: [[0, 0, 0], [0.1, 0.1, 0.1]]", r"clamps\[0\].box = .* contains no particle"),
        ("domain: [[0, 0, 0], [1, 1, 1]]", "domain: [[0, 0, 0], [0.5, 1, 1]]", "particles of x0 lie outside scene.domain"),
        ("scene:\n", "scene: [\n", "is not valid YAML"),
        ("density: 1000.0", f"density: {10**400}", "must be a finite number, got one beyond the range"),
        ("noise: 0.0005", f"noise: {10**400}", "noise must be a finite number"),
        ("law: fixed_corotated", "law: [sigma]", "model.elasticity.law must be text"),
        (
            "law: von_mises, yield_stress: 2e3",
            "law: snow, compression: 0.02, stretch: 0.01",
            "model.plasticity.law = snow is a law of scenes",
        ),
    ],
)
def test_malformed_yaml(folder, old, new, message):
    assert_refused(read_experiment, folder / "experiment.yaml", old, new, message)


def wrong(key: str, change):
    def apply(arrays: dict) -> None:
        arrays[key] = change(arrays[key])

    return apply


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda a: a.pop("v0"), "lacks the array 'v0'"),
        (lambda a: a.update(colour=np.zeros(3)), "unknown array 'colour'"),
        (lambda a: a.pop("track"), "either track or anchor, got neither"),
        (lambda a: a.update(anchor=np.zeros((3, 3), np.float32)), "either track or anchor, got both"),
        (wrong("x", lambda x: x[..., :2]), r"x must have the shape \(T, N, 3\), got \(4, 3, 2\)"),
        (wrong("x", lambda x: x[:2]), r"t has the shape \(4,\); it must be \(T\) with T = 2"),
        (wrong("x", lambda x: x[:0]), r"t has the shape \(4,\); it must be \(T\) with T = 0"),
        (wrong("x", lambda x: np.where(np.isnan(x), np.inf, x)), "an infinity"),
        (wrong("x", lambda x: x + np.array([np.nan, 0, 0], np.float32)), "NaN in some coordinates only"),
        (wrong("x", lambda x: (1000 * np.where(np.isnan(x), 0, x)).astype(np.int32)), "x must hold floating-point numbers, got int32"),
        (wrong("t", lambda t: t + 1), "t must increase from 0"),
        (wrong("t", lambda t: 0 * t), "t must increase from 0"),
        (wrong("t", lambda t: np.append(t[:-1], np.nan)), "t contains a NaN"),
        (wrong("x0", lambda x: x[:9]), r"has the shape .*; it must be .* with P = 9"),
        (wrong("x0", lambda x: x + 2), "125 particles of x0 lie outside"),
        (wrong("v0", lambda v: v * np.nan), "v0 contains a NaN"),
        (wrong("volume", lambda v: -v), "volume must be positive"),
        (wrong("volume", lambda v: 1e3 * v), "more than the whole domain has"),
        (wrong("volume", lambda v: v[:, None]), r"volume must have the shape \(P\)"),
        (lambda a: a.update(F0=np.tile(np.diag([1.0, 1, -1]), (125, 1, 1))), "F0 must have positive determinants"),
        (wrong("track", lambda k: k + 1), r"track must lie in -1..124, got 0..125"),
        (wrong("track", lambda k: k[:2]), "track has the shape"),
        (wrong("track", lambda k: k.astype(float)), "track must hold whole numbers"),
        (wrong("track", lambda k: k.astype(object)), "not a valid archive of arrays"),
    ],
)
def test_malformed_particles(folder, change, message):
    arrays = samples.particles(S, track=True)
    change(arrays)
    np.savez(folder / "drop" / "particles.npz", **arrays)
    with pytest.raises(UserError, match=message) as caught:
        read_experiment(folder)
    assert "\n" not in str(caught.value) and "particles.npz" in str(caught.value)


@pytest.mark.parametrize("content", [b"\xff\xfe\x00", b"a: " + b"[" * 20_000, b"", b"- 1", b"a: !!python/object/apply:os.getcwd []"])
def test_what_is_no_yaml(folder, content):
    (folder / "experiment.yaml").write_bytes(content)
    with pytest.raises(UserError, match=r"not valid YAML|must contain a mapping"):
        read_experiment(folder)


@pytest.mark.parametrize("content", [b"", b"PK\x03\x04 cut short", b"\x93NUMPY", b"text"])
def test_particles_that_are_no_archive(folder, content):
    (folder / "drop" / "particles.npz").write_bytes(content)
    with pytest.raises(UserError, match="not a valid archive"):
        read_experiment(folder)


def test_missing_files(folder, tmp_path):
    with pytest.raises(UserError, match=r"experiment.yaml is missing"):
        read_experiment(tmp_path)
    (folder / "drop" / "images" / "2_001.png").unlink()
    with pytest.raises(UserError, match=r"2_001.png is missing"):
        read_experiment(folder)
    (folder / "drop" / "transforms.json").unlink()
    assert read_experiment(folder)["drop"].video is None
    (folder / "loaded" / "particles.npz").unlink()
    with pytest.raises(UserError, match=r"neither particles\.npz nor transforms\.json"):
        read_experiment(folder)


def test_images_alone_will_do(folder):
    (folder / "drop" / "particles.npz").unlink()
    drop = read_experiment(folder)["drop"]
    assert drop.body is None and drop.x is None and len(drop.video.times) == 4
    with pytest.raises(UserError, match="no tracked points"):
        _ = drop.seen


# The real ones.

TAKES = {  # frames, points, particles
    "dropped-duck": (56, 400, 2593),
    "filled-bar": (58, 420, 2299),
    "foam-angle": (54, 260, 1680),
    "gel-ball": (60, 420, 2288),
    "rubber-cuboid": (52, 350, 2520),
    "sand-ball": (52, 450, 2036),
    "sliding-tee": (58, 400, 1620),
    "tumbling-block": (60, 400, 2340),
}


@pytest.mark.parametrize("name", TAKES)
def test_simulated_experiment(data_root, name):
    experiment = read_experiment(data_root / "experiments" / name)
    assert [(r.name, r.role) for r in experiment.recordings] == [("take1", "fit"), ("take2", "held_out")]
    material(experiment.model["elasticity"], experiment.model["plasticity"])
    for recording in experiment.recordings:
        frames, points, particles = TAKES[name]
        assert recording.x.shape == (frames, points, 3) and recording.body.x.shape == (particles, 3)
        assert recording.scene == experiment.scene and recording.body.F is None
        torch.testing.assert_close(recording.t, recording.frame_interval * torch.arange(frames, dtype=torch.float64), atol=1e-9, rtol=0)
        assert (recording.track is None) == (name == "foam-angle")
        assert bool(recording.seen.all()) == (name not in ("rubber-cuboid", "sliding-tee"))
        # the points start at their particles, up to the noise that the experimenter states
        if recording.track is not None:
            known = recording.track >= 0
            start = recording.x[0, known] - recording.body.x[recording.track[known]]
        else:
            start = recording.x[0] - recording.anchor
        start = start[~start[:, 0].isnan()]
        assert float(start.square().mean().sqrt()) == pytest.approx(recording.noise, rel=0.15)
        assert 1e-3 < float(recording.body.volume.sum()) < 0.05


def test_silicone_beam(data_root):
    experiment = read_experiment(data_root / "measured" / "silicone-beam")
    assert [r.name for r in experiment.of("fit")] == ["gravity_a"] and len(experiment.of("held_out")) == 5
    assert experiment.model["density"] == 1070 and experiment.free == ("young", "poisson")
    assert experiment.scene.dx == pytest.approx(0.005) and experiment.scene.attached_masses == ()
    for recording in experiment.recordings:
        assert recording.x.shape == (81, 3, 3) and recording.body.x.shape == (3500, 3) and recording.body.F.shape == (3500, 3, 3)
        assert recording.track is None and torch.equal(recording.x[0], recording.anchor)
        simulator = Simulator(recording.scene, recording.body, density=experiment.model["density"], dtype=torch.float64, device="cpu")
        assert int(simulator.held.sum()) == 300  # three layers of 10 x 10 behind the clamp's face
        load = {"gravity": 0.0, "load52": 0.052, "load101": 0.101}[recording.name.split("_")[0]]
        beam = experiment.model["density"] * float(recording.body.volume.double().sum())
        assert float(simulator.mass.sum()) == pytest.approx(beam + load, abs=1e-6)
        assert beam == pytest.approx(1070 * 0.03 * 0.03 * 0.109375, rel=0.01)
        assert recording.scene.attached_masses == () or recording.scene.attached_masses[0].mass == load
    # the first lower turning point, mm below the pose before release
    drop = 1e3 * (experiment["gravity_a"].x[0, :, 1] - experiment["gravity_a"].x[:20, :, 1]).mean(dim=1)
    assert float(drop.max()) == pytest.approx(10.0, abs=0.3) and int(drop.argmax()) == 6


def test_silicone_video(data_root):
    experiment = read_experiment(data_root / "measured" / "silicone-video")
    swing = experiment["swing"]
    assert swing.x.shape == (13, 3, 3) and swing.body.x.shape == (2989, 3) and swing.noise == 8e-4
    video = swing.video
    assert len(video.views) == 1 and len(video.times) == 13 and (video.cameras.width, video.cameras.height) == (512, 384)
    torch.testing.assert_close(video.times, swing.t, atol=1e-6, rtol=0)
    assert float(video.cameras.Ks[0, 0, 0]) == pytest.approx(369.6875) and video.masks is None
    assert not re.search("[^a-z-]", experiment.name)


def test_silicone_video_camera_sees_the_body(data_root):
    """The particles at t = 0 fall on the mask of the first frame: the README gives an overlap of 0.95 with the free part."""
    found = read_recording(data_root / "measured" / "silicone-video")
    assert found.format == "experiment" and found.name == "silicone-video-swing"
    images, masks = SceneViews(found, width=256, frame_count=1).load([0])
    assert images.shape == (1, 1, 192, 256, 3)
    scene = SceneViews(found, frame_count=1)
    mask = scene.load([0])[1][0, 0] > 0.5
    pixels, depth = project(found.body.x, scene.cameras)
    column, row = pixels[0].long().T
    assert bool((depth > 0.1).all()) and bool(((column >= 0) & (column < 512) & (row >= 0) & (row < 384)).all())
    assert float(mask[row, column].float().mean()) > 0.95
