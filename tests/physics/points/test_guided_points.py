"""Pendulums, springs, dry friction, discs and bounces of a point mass against closed forms, and their slopes by the parameters."""

import math

import numpy as np
import pytest
from scipy.special import ellipk

from neuido.errors import UserError
from neuido.physics.points.point_mass import Forces, fly

NOW = np.zeros(1)
STILL = (0.0, 0.0, 0.0)


def along(t, x, v, forces, step):
    """The first coordinate of a motion at times t."""
    return fly(t, np.array([[x, 0.0, 0.0]]), np.array([[v, 0.0, 0.0]]), NOW, forces, step=step)[0, :, 0]


def test_a_pendulum_swings_with_its_period_of_finite_amplitude():
    g, length, angle = 9.81, 0.7, 1.2
    period = 4 * math.sqrt(length / g) * ellipk(math.sin(angle / 2) ** 2)
    t = np.array([0.0, period / 4, period / 2, 5.0 * period])
    s = along(t, length * angle, 0.0, Forces(gravity=STILL, pendulum=(g, length)), 0.01)
    np.testing.assert_allclose(s, length * np.array([angle, 0.0, -angle, angle]), atol=2e-5)


def test_dry_friction_takes_the_same_from_each_swing_and_ends_the_motion():
    rate, c, start = 4.0, 0.08, 0.0545
    lost = 2 * c / rate**2  # of the amplitude, in half a period
    half = math.pi / rate
    t = half * np.arange(12)
    forces = Forces(gravity=STILL, position_force=rate**2, dry_friction=c)
    x = along(t, start, 0.0, forces, 2e-4)
    swings = math.floor((start + lost / 2) / lost)  # it stays where the spring is weaker than the friction
    wanted = [(-1) ** n * (start - min(n, swings) * lost) if n <= swings else (-1) ** swings * (start - swings * lost) for n in range(12)]
    np.testing.assert_allclose(x, wanted, atol=3e-5)


def test_slopes_by_the_parameters_are_those_of_the_closed_forms():
    t = np.linspace(0.0, 1.0, 5)
    h = 1e-4

    def slope(one, value):
        return (one(value + h) - one(value - h)) / (2 * h)

    slide = slope(lambda c: along(t, 0.0, 2.0, Forces(gravity=STILL, dry_friction=c), 1e-3), 0.5)
    np.testing.assert_allclose(slide, -(t**2) / 2, atol=1e-4)
    swing = slope(lambda g: along(t, 1e-3, 0.0, Forces(gravity=STILL, pendulum=np.array([[g, 1.0]])), 2e-3), 9.81)
    rate = math.sqrt(9.81)
    np.testing.assert_allclose(swing, -1e-3 * t / (2 * rate) * np.sin(rate * t), atol=1e-9)
    back = slope(lambda e: bounced(np.array([0.6]), e)[:, 1], 0.8)
    fall = math.sqrt(2 / 9.81)
    np.testing.assert_allclose(back, 9.81 * fall * (0.6 - fall), rtol=1e-6)


def bounced(t, restitution, *, velocity=STILL, **more):
    forces = Forces(floor_normal=np.array([0.0, 1.0, 0.0]), floor_height=0.0, restitution=restitution, **more)
    return fly(t, np.array([[0.0, 1.0, 0.0]]), np.array([velocity]), NOW, forces, step=0.02)[0]


def test_each_bounce_returns_its_share_of_the_speed_until_the_body_rests():
    e, fall = 0.7, math.sqrt(2 / 9.81)
    tops = fall + np.cumsum([fall * e] + [fall * (e**n + e ** (n + 1)) for n in range(1, 4)])
    np.testing.assert_allclose(bounced(tops, e)[:, 1], e ** (2 * np.arange(1, 5)), atol=1e-6)
    end = fall + 2 * fall * e / (1 - e)
    np.testing.assert_allclose(bounced(np.array([end + 1.0, end + 5.0]), e)[:, 1], 0.0, atol=1e-9)
    speed = math.sqrt(2 * 9.81)
    rest = bounced(np.array([fall + 1e-3]), e, restitution_speed=0.25)[0, 1]
    assert rest == pytest.approx(e * speed**-0.25 * speed * 1e-3, rel=1e-2)


@pytest.mark.parametrize(("mu", "kept"), [(0.05, None), (1.0, 5 / 7)])
def test_friction_in_a_bounce_slides_or_rolls(mu, kept):
    """Garwin 1969: a solid ball without spin keeps 5/7 of its speed along the floor if it grips, and loses mu (1 + e) v_n if it slides."""
    fall, e = math.sqrt(2 / 9.81), 0.8
    t = np.array([fall, fall + 0.1])
    x = bounced(t, e, velocity=(2.0, 0.0, 0.0), bounce_friction=mu, roundness=0.4)[:, 0]
    wanted = 2.0 * kept if kept else 2.0 - mu * (1 + e) * math.sqrt(2 * 9.81)
    assert (x[1] - x[0]) / 0.1 == pytest.approx(wanted, rel=1e-6)
    again = bounced(np.array([fall, fall + 0.1]), e, velocity=(2.0, 0.0, 0.0), bounce_friction=mu, roundness=0.4,
                    surface_velocity=np.array([0.0, 0.0, -2.0]))[:, 0]  # it rolls already  # fmt: skip
    assert (again[1] - again[0]) / 0.1 == pytest.approx(2.0, rel=1e-6)


def test_the_lift_of_a_disc_turns_the_path_and_keeps_the_speed():
    k, v, tilt = 0.3, 6.0, 0.4
    t = np.linspace(0.0, 2.0, 401)
    normal = np.array([-math.sin(tilt), math.cos(tilt), 0.0])
    x = fly(t, np.zeros((1, 3)), np.array([[v, 0.0, 0.0]]), NOW, Forces(gravity=STILL, lift=k, disc_normal=normal), step=2e-3)[0]
    step = np.diff(x[:, :2], axis=0)
    heading = np.arctan2(step[:, 1], step[:, 0])
    middle = 0.5 * (t[1:] + t[:-1])
    np.testing.assert_allclose(np.linalg.norm(step, axis=1) / np.diff(t), v, rtol=1e-5)
    np.testing.assert_allclose(heading, tilt - 2 * np.arctan(np.tan(tilt / 2) * np.exp(-k * v * middle)), atol=1e-5)
    flat = fly(t, np.zeros((1, 3)), np.array([[v, 0, 0]]), NOW, Forces(gravity=STILL, lift_drag=k, disc_normal=np.array([-0.6, 0.8, 0.0])))[
        0
    ]
    np.testing.assert_allclose(flat[:, 0], np.log1p(0.36 * k * v * t) / (0.36 * k), atol=1e-6)


def test_a_force_near_a_place_has_a_potential():
    a0, w, v = 3.0, 0.2, 1.5
    forces = Forces(gravity=STILL, local_force=a0, local_centre=np.array([0.5, 0.0, 0.0]), local_width=w)
    x = along(np.linspace(0.0, 1.0, 2001), 0.0, v, forces, 5e-4)
    speed = np.diff(x) / 5e-4
    r = (0.5 * (x[1:] + x[:-1]) - 0.5) / w
    potential = -a0 * w * np.exp(0.5 * (1 - r**2))
    energy = 0.5 * speed**2 + potential
    np.testing.assert_allclose(energy, energy[0], rtol=1e-5)
    with pytest.raises(UserError, match="local_width"):
        along(np.zeros(1), 0.0, 0.0, Forces(local_force=1.0), 0.1)


def test_a_long_motion_is_within_a_limit(monkeypatch):
    monkeypatch.setenv("NEUIDO_MAX_STEPS", "1000")
    with pytest.raises(UserError, match="NEUIDO_MAX_STEPS"):
        along(np.array([0.0, 100.0]), 0.0, 0.0, Forces(), 0.01)
    with pytest.raises(UserError, match="increase"):
        along(np.array([1.0, 0.5]), 0.0, 0.0, Forces(), 0.1)


def slope(one, value, h=1e-4):
    """The derivative of a motion by a parameter, by a central difference as in a fit."""
    return (one(value + h) - one(value - h)) / (2 * h)


def test_slopes_of_lift_force_near_a_place_and_buoyancy_are_those_of_the_closed_forms():
    t = np.linspace(0.0, 0.5, 6)
    v, tilt, k = 6.0, 0.4, 0.3
    normal = np.array([-math.sin(tilt), math.cos(tilt), 0.0])

    def thrown(**more):
        return fly(t, np.zeros((1, 3)), np.array([[v, 0.0, 0.0]]), NOW, Forces(gravity=STILL, **more), step=1e-3)[0]

    def heading(k):
        return tilt - 2 * np.arctan(np.tan(tilt / 2) * np.exp(-k * v * t))

    by_lift = slope(lambda k: thrown(lift=k, disc_normal=normal), k)
    courses = [np.stack([np.cos(heading(k + s * 1e-4)), np.sin(heading(k + s * 1e-4))], 1) for s in (1, -1)]
    of_speed = v * (courses[0] - courses[1]) / 2e-4
    np.testing.assert_allclose(np.gradient(by_lift[:, 0], t)[1:-1], of_speed[1:-1, 0], atol=0.1 * np.abs(of_speed).max())
    np.testing.assert_allclose(np.gradient(by_lift[:, 1], t)[1:-1], of_speed[1:-1, 1], atol=0.1 * np.abs(of_speed).max())

    start, w = 0.1, 0.2  # from rest close to the place: r exp((1 - r^2)/2) is r exp(1/2), so that the place is a spring
    small = 1e-3 * start
    swing = slope(lambda a0: along(t, small, 0.0, Forces(gravity=STILL, local_force=a0, local_centre=STILL, local_width=w), 1e-3), 3.0)
    rate = math.sqrt(3.0 * math.exp(0.5) / w)
    np.testing.assert_allclose(swing, -small * t * rate / (2 * 3.0) * np.sin(rate * t), atol=1e-6 * start)

    def fall(q):
        moved = Forces(gravity=np.array([0.0, -9.81 * (1 - q), 0.0]), added_mass=0.5 * q)
        return fly(t, np.zeros((1, 3)), np.zeros((1, 3)), NOW, moved, step=1e-3)[0, :, 1]

    q = 0.4  # a = g (1 - q)/(1 + q/2)
    np.testing.assert_allclose(fall(q), -9.81 * (1 - q) / (1 + q / 2) * t**2 / 2, atol=1e-9)
    np.testing.assert_allclose(slope(fall, q), 9.81 * 1.5 / (1 + q / 2) ** 2 * t**2 / 2, rtol=1e-5, atol=1e-12)


def test_slopes_of_a_bounce_are_those_of_the_closed_forms():
    fall, e, after = math.sqrt(2 / 9.81), 0.8, 0.1
    t, speed = np.array([fall + after]), math.sqrt(2 * 9.81)

    def x(mu):
        return bounced(t, e, velocity=(2.0, 0.0, 0.0), bounce_friction=mu, roundness=0.4)[:, 0]

    np.testing.assert_allclose(slope(x, 0.05), -(1 + e) * speed * after, rtol=1e-5)
    np.testing.assert_allclose(slope(x, 1.0), 0.0, atol=1e-9)  # it rolls, whatever the friction

    def y(p):
        return bounced(t, e, restitution_speed=p)[:, 1]

    np.testing.assert_allclose(slope(y, 0.25), -e * speed * speed**-0.25 * math.log(speed) * after, rtol=1e-5)
