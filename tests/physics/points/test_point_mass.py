import numpy as np
import pytest

from neuido.errors import UserError
from neuido.physics.points.point_mass import Forces, fly

T = np.linspace(0, 3, 31)
ZERO = np.zeros((1, 3))
NOW = np.zeros(1)


def drop(**forces) -> np.ndarray:
    """The height at T of a body dropped from rest at the origin."""
    return fly(T, ZERO, ZERO, NOW, Forces(**forces))[0, :, 1]


def test_free_fall_of_a_throw():
    x, v = np.array([[1.0, 2.0, 3.0]]), np.array([[4.0, 5.0, -6.0]])
    out = fly(T, x, v, NOW, Forces(gravity=(0.0, -9.81, 0.5)))
    wanted = x + v * T[:, None] + np.array([0, -9.81, 0.5]) * T[:, None] ** 2 / 2
    np.testing.assert_allclose(out[0], wanted, rtol=0, atol=1e-12)


def test_held_until_the_release():
    out = fly(T, np.array([[0.0, 7.0, 0.0]]), ZERO, np.array([1.05]), Forces())[0, :, 1]
    np.testing.assert_array_equal(out[T <= 1.05], 7.0)
    np.testing.assert_allclose(out, 7 - 9.81 / 2 * np.maximum(T - 1.05, 0) ** 2, atol=1e-12)
    early = fly(T, ZERO, np.array([[0.0, 2.0, 0.0]]), np.array([-0.5]), Forces())[0, :, 1]
    np.testing.assert_allclose(early, 2 * (T + 0.5) - 9.81 / 2 * (T + 0.5) ** 2, atol=1e-12)


def test_drag_has_closed_forms():
    c, k, g = 0.7, 0.05, 9.81
    np.testing.assert_allclose(drop(drag_linear=c), -g / c * (T - (1 - np.exp(-c * T)) / c), atol=1e-8)
    terminal = np.sqrt(g / k)
    np.testing.assert_allclose(drop(drag_quadratic=k), -np.log(np.cosh(g * T / terminal)) / k, atol=1e-7)
    across = fly(T, ZERO, np.array([[20.0, 0, 0]]), NOW, Forces(gravity=(0, 0, 0), drag_quadratic=k))[0, :, 0]
    np.testing.assert_allclose(across, np.log1p(k * 20 * T) / k, atol=1e-6)


def test_magnus_is_a_circle():
    w, v = 2.0, 3.0
    out = fly(T, ZERO, np.array([[v, 0, 0]]), NOW, Forces(gravity=(0, 0, 0), magnus=np.array([0, 0, w])))[0]
    np.testing.assert_allclose(out, v / w * np.stack([np.sin(w * T), 1 - np.cos(w * T), 0 * T], 1), atol=1e-7)


def test_position_force_is_a_spring():
    k, centre = 4.0, np.array([0.0, 0.3, 0.0])
    out = fly(T, ZERO, ZERO, NOW, Forces(gravity=(0, 0, 0), position_force=k, position_centre=centre))[0, :, 1]
    np.testing.assert_allclose(out, 0.3 * (1 - np.cos(2 * T)), atol=1e-7)


def test_time_force_is_linear_between_its_knots():
    knots = np.zeros((3, 3))
    knots[:, 1] = [0.0, 2.0, 0.0]
    out = fly(T, ZERO, ZERO, NOW, Forces(gravity=(0, 0, 0), time_force=knots, time_force_interval=0.5), step=0.005)[0, :, 1]
    np.testing.assert_allclose(out[T <= 0.5], 4 * T[T <= 0.5] ** 3 / 6, atol=1e-6)
    np.testing.assert_allclose(np.diff(out[T >= 1.0]) / 0.1, 1.0, atol=1e-5)  # the area under the hat, 1 m/s
    late = fly(T, ZERO, ZERO, np.array([1.0]), Forces(gravity=(0, 0, 0), time_force=knots, time_force_interval=0.5))[0, :, 1]
    np.testing.assert_allclose(late, 0, atol=1e-9)  # its time is the recording's, not the flight's


def test_added_mass_slows_the_fall():
    np.testing.assert_allclose(drop(added_mass=0.25), -9.81 / 1.25 * T**2 / 2, atol=1e-12)


def test_a_batch_equals_its_members():
    rng = np.random.default_rng(0)
    x, v, r = rng.normal(size=(4, 3)), rng.normal(size=(4, 3)), rng.uniform(-0.2, 0.5, 4)
    forces = Forces(
        drag_quadratic=np.array([0, 0.1, 0.2, 0.3]),
        drag_linear=0.1,
        magnus=rng.normal(size=(4, 3)),
        added_mass=np.full(4, 0.1),
        uniform_acceleration=np.array([0.1, 0.2, 0.3]),
        time_force=rng.normal(size=(4, 5, 3)),
    )
    whole = fly(T, x, v, r, forces)
    for i in range(4):
        own = forces._replace(
            drag_quadratic=forces.drag_quadratic[i], magnus=forces.magnus[i], added_mass=0.1, time_force=forces.time_force[i]
        )
        np.testing.assert_allclose(fly(T, x[i : i + 1], v[i : i + 1], r[i : i + 1], own)[0], whole[i], rtol=0, atol=1e-12)


def test_order_of_the_scheme():
    forces = Forces(drag_quadratic=0.2, drag_linear=0.1)
    fine = fly(T, ZERO, ZERO, NOW, forces, step=1e-3)
    errors = [np.abs(fly(T, ZERO, ZERO, NOW, forces, step=h) - fine).max() for h in (0.1, 0.05)]
    assert 12 < errors[0] / errors[1] < 24


def test_what_blows_up_is_nan_alone():
    out = fly(T, np.ones((2, 3)), np.zeros((2, 3)), np.zeros(2), Forces(drag_quadratic=np.array([-5.0, 0.1])))
    assert np.isnan(out[0]).all() and np.isfinite(out[1]).all()


def test_errors():
    with pytest.raises(UserError, match=r"step = 0 s must be positive"):
        fly(T, ZERO, ZERO, NOW, Forces(), step=0)
    with pytest.raises(UserError, match=r"drag_linear has the shape \(2,\) for 1 point masses"):
        fly(T, ZERO, ZERO, NOW, Forces(drag_linear=np.ones(2)))
    with pytest.raises(UserError, match="time_force_interval"):
        fly(T, ZERO, ZERO, NOW, Forces(time_force=np.ones((2, 3)), time_force_interval=0.0))
