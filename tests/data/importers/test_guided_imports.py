"""Pendulums, springs, wheels, planes and bounces are imported as guided tracks; what a user must say is asked for by its option."""

import numpy as np
import pytest

import neuido
from neuido.data.importers.declared_guide import Guide
from neuido.errors import UserError

pytest.importorskip("pint")
T = np.arange(0, 6, 0.02)
SWING = np.radians(20) * np.exp(-0.05 * T) * np.cos(np.sqrt(9.81 / 0.8) * T)
OSCILLATION = 0.05 * np.cos(9 * T)


def table(path, head, *columns, separator=","):
    path.write_text("\n".join([head, *(separator.join(f"{value:.7f}" for value in row) for row in zip(*columns)), ""]))
    return path


@pytest.mark.parametrize(
    ("head", "factor", "separator"),
    [("Time (s),Angle (deg)", 180 / np.pi, ","), ("t,theta (rad)", 1.0, ","), ("Zeit/s;Winkel/°", 180 / np.pi, ";"),
     ("t (ms),angle_deg", 180 / np.pi, ",")],
)  # fmt: skip
def test_angles_of_a_pendulum(tmp_path, head, factor, separator):
    clock = 1e3 if "ms" in head else 1.0
    path = table(tmp_path / "a.csv", head, clock * T, factor * SWING, separator=separator)
    neuido.import_file(path, tmp_path / "out", guide=Guide("pendulum", "80 cm"))
    read = neuido.read_tracks(tmp_path / "out")
    assert read.constraint.type == "pendulum" and read.constraint.figures["length"] == pytest.approx(0.8) and read.free == ("length",)
    assert read.nuisances["length_scale"] == 0
    np.testing.assert_allclose(read.recordings[0].x[:, 0], SWING, atol=1e-7)
    np.testing.assert_allclose(read.recordings[0].t, T, atol=1e-6)


def test_coordinates_of_a_pendulum(tmp_path):
    jitter = 1e-4 * np.random.default_rng(0).standard_normal(len(T))
    path = table(tmp_path / "a.csv", "t (s),x (m),y (m),z (m)", T, 0.8 * np.sin(SWING), -0.8 * np.cos(SWING), jitter)
    said = neuido.import_file(path, tmp_path / "out", guide=Guide("pendulum", "0.8 m"))
    assert list(neuido.read_tracks(tmp_path / "out").recordings[0].axes) == [0, 1]
    assert neuido.read_tracks(tmp_path / "out").nuisances["length_scale"] == 0.01 and any("known to 1 %" in line for line in said)
    assert any("z moves least and is left out for --guide pendulum" in line for line in said)


@pytest.mark.parametrize("head", ["Time (s),Displacement (mm)", "t (s),Position (mm)", "Zeit (s),Weg (mm)", "t (s),x (mm)", "t (s),y (mm)"])
def test_a_mass_on_a_spring(tmp_path, head):
    path = table(tmp_path / "a.csv", head, T, 1e3 * OSCILLATION)
    neuido.import_file(path, tmp_path / "out", guide=Guide("spring", stiffness=20.0), mass=0.25)
    read = neuido.read_tracks(tmp_path / "out")
    assert read.constraint.figures == {"stiffness": 20.0} and read.free == ("stiffness",) and read.bodies["body"]["mass"] == 0.25
    np.testing.assert_allclose(read.recordings[0].x[:, 0], OSCILLATION, atol=1e-7)


def test_an_air_track_a_slope_a_wheel_and_a_bounce(tmp_path):
    place = 0.3 * T - 0.005 * T**2
    path = table(tmp_path / "a.csv", "t (s),Position (cm)", T, 100 * place)
    neuido.import_file(path, tmp_path / "level", guide=Guide("plane", inertia=0.0))
    np.testing.assert_allclose(neuido.read_tracks(tmp_path / "level").recordings[0].x[:, 0], place, atol=1e-7)
    neuido.import_file(path, tmp_path / "slope", guide=Guide("plane", inertia=0.4, tilt=30.0))
    assert neuido.read_tracks(tmp_path / "slope").gravity[0] == pytest.approx(9.81 / 2)
    wheel = table(tmp_path / "w.csv", "t (s),rotation (deg)", T, 300 * T - 3 * T**2)
    neuido.import_file(wheel, tmp_path / "wheel", guide=Guide("axis"))
    assert neuido.read_tracks(tmp_path / "wheel").recordings[0].angle
    t = np.arange(0, 1, 0.01)
    ball = table(tmp_path / "b.csv", "t (s),y (m)", t, 0.5 * np.abs(np.sin(6 * t)))
    neuido.import_file(ball, tmp_path / "ball", guide=Guide("bounce", restitution=0.8), floor=0.0)
    assert neuido.read_tracks(tmp_path / "ball").constraint.figures["restitution"] == 0.8


def test_what_is_missing_is_asked_for(tmp_path):
    angle = table(tmp_path / "angle.csv", "Time (s),Angle (deg)", T, np.degrees(SWING))
    bare = table(tmp_path / "bare.csv", "Time (s),theta", T, SWING)
    spring = table(tmp_path / "spring.csv", "Time (s),Displacement (mm)", T, 1e3 * OSCILLATION)
    for path, guide, options, words in (
        (angle, Guide(), {}, "has an angle: give --guide pendulum and its length"),
        (angle, Guide("pendulum"), {}, "needs the length from the pivot to the centre of mass: give --length '0.8 m'"),
        (angle, Guide("pendulum", "0.8"), {}, "must be a number with a unit"),
        (angle, Guide("pendulm", "1 m"), {}, "is unknown, did you mean 'pendulum'"),
        (angle, Guide("spring", stiffness=3.0), {"mass": 1.0}, "has an angle: give --guide pendulum"),
        (bare, Guide("pendulum", "1 m"), {}, "has an angle without a unit: give --units.angle deg or rad"),
        (spring, Guide("spring"), {}, "needs the stiffness of the spring"),
        (spring, Guide("spring", stiffness=20.0), {}, "needs the mass of the body in kg: give --mass"),
        (spring, Guide("plane"), {}, "needs the moment of inertia over m r.2"),
        (spring, Guide("plane", inertia=0.0, tilt=120.0), {}, "--tilt 120 must be an angle of at most 90 degrees"),
        (spring, Guide("bounce", restitution=0.8), {}, "needs the height of the tracked point at contact"),
        (spring, Guide("none", stiffness=2.0), {}, "--stiffness belongs to --guide spring"),
        (spring, Guide("pendulum", "1 m", tilt=3.0), {}, "--tilt belongs to --guide plane"),
        (spring, Guide(), {"floor": 0.1}, "--floor belongs to --guide bounce"),
    ):  # fmt: skip
        with pytest.raises(UserError, match=words):
            neuido.import_file(path, tmp_path / "out", guide=guide, **options)
        assert not (tmp_path / "out").exists()
    neuido.import_file(bare, None, guide=Guide("pendulum", "1 m"), units={"angle": "rad"})
