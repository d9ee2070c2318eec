"""The weak residual against closed forms, and its noise against draws."""

import numpy as np
import pytest

from neuido.discrepancy.report import residual
from neuido.types import Plane

RNG = np.random.default_rng(3)
X = RNG.uniform(-0.1, 0.1, (60, 3))
T = np.linspace(0.0, 0.6, 61)
MASS = RNG.uniform(0.5, 1.5, 60)
UNIT = np.broadcast_to(np.eye(3)[:, None], (3, 60, 3))
FLOOR = Plane((0.0, 0.0, 0.0), (0.0, 1.0, 0.0))


def falling(a: np.ndarray) -> np.ndarray:
    """A body that moves with acceleration a from some velocity, (T, N, 3)."""
    return X + np.array([0.4, 2.0, -0.3]) * T[:, None, None] + 0.5 * a * T[:, None, None] ** 2


@pytest.mark.parametrize("frames", [slice(0, 61), slice(10, 19), slice(3, 10)])
def test_missing_force_is_exact_for_a_steady_acceleration(frames):
    gravity, extra = np.array([0.0, -9.8, 0.0]), np.array([0.3, 0.0, -0.2])
    bump = residual.window(T, frames)
    value, _ = residual.weak_residual(falling(gravity + extra), bump, UNIT, MASS, force=gravity)
    np.testing.assert_allclose(value, extra * MASS.sum() * bump.area, rtol=1e-9, atol=1e-9)


def test_window_of_uneven_frames():
    t = np.sort(RNG.uniform(0.0, 1.0, 40))
    bump = residual.window(t, slice(0, 40))
    np.testing.assert_allclose(bump.second @ np.stack([np.ones(40), t, t**2], 1), [0.0, 0.0, 2 * bump.area], atol=1e-9)


def test_bump_agrees_with_its_analytic_integral():
    t = np.linspace(0.0, 1.0, 400)
    bump = residual.window(t, slice(0, 400))
    s = 2 * t - 1
    phi = np.gradient(np.gradient((1 - s**2) ** 4, t), t)
    path = np.sin(5 * t)
    assert bump.second @ path == pytest.approx(np.trapezoid(phi * path, t), rel=2e-3)
    assert bump.area == pytest.approx(0.5 * 256 / 315, rel=1e-5)  # the integral of (1 - s^2)^4 over -1..1 is 256/315


def test_noise_in_closed_form():
    bump = residual.window(T, slice(5, 30))
    fields = np.concatenate([UNIT, residual._rotations(X)])
    draws = []
    for _ in range(600):
        value, sd = residual.weak_residual(2e-3 * RNG.standard_normal((61, 60, 3)), bump, fields, MASS, sigma=2e-3)
        draws.append(value)
    np.testing.assert_allclose(np.std(draws, axis=0), sd, rtol=0.12)


def test_stress_balances_a_uniformly_accelerated_strain():
    """x = A(t) X of an unloaded body: sum m w.x'' over linear w is minus the work of its stress; made to balance, it must vanish."""
    rate = 30.0
    A = np.eye(3) + np.diag([0.1, -0.05, 0.02]) * 0.5 * rate * T[:, None, None] ** 2
    x = np.einsum("tab,nb->tna", A, X)
    second = np.diag([0.1, -0.05, 0.02]) * rate
    fields = residual._strains(X)
    gradients = np.stack([np.linalg.lstsq(X, f, rcond=None)[0].T for f in fields])
    gradients = np.broadcast_to(gradients[:, None], (6, 60, 3, 3))
    moment = np.einsum("n,na,nb->ab", MASS, X, X)
    volume = np.full(60, 1e-3 / 60)
    P = -(second @ moment) / 1e-3
    stress = np.broadcast_to(P, (61, 60, 3, 3))
    bump = residual.window(T, slice(0, 61))
    value, _ = residual.weak_residual(x, bump, fields, MASS, stress=stress, gradients=gradients, volume=volume)
    alone, _ = residual.weak_residual(x, bump, fields, MASS)
    assert np.abs(value).max() < 1e-9 * np.abs(alone).max()


def test_deformation_gradients_of_an_affine_motion_and_unseen_points():
    F = np.eye(3) + 0.2 * RNG.standard_normal((3, 3))
    x = (X @ F.T)[None].repeat(2, axis=0)
    np.testing.assert_allclose(residual.deformation_gradients(X, x), np.broadcast_to(F, (2, 60, 3, 3)), atol=1e-9)
    x[1, 7] = np.nan
    assert np.isnan(residual.deformation_gradients(X, x)[1, 7]).any()
    assert np.isfinite(residual.deformation_gradients(X, x)[0]).all()


def test_hats_add_up_to_one():
    fields = residual.hats(X)
    np.testing.assert_allclose(fields.sum(axis=0), 1.0)
    assert (fields > 0).sum(axis=1).max() < 60  # each is local


def test_decompose_finds_shift_turn_strain_and_the_rest():
    x = np.broadcast_to(X, (4, 60, 3))
    A = np.array([[0.01, -0.003, 0.0], [0.003, -0.02, 0.0], [0.0, 0.0, 0.005]])
    moved = x + [0.1, 0.2, 0.3] + (X - X.mean(axis=0)) @ A.T
    moved[2, 5] = np.nan
    parts = residual.decompose(moved, x)
    np.testing.assert_allclose(parts.rotation[0], [0.0, 0.0, 0.003], atol=1e-9)
    np.testing.assert_allclose(parts.strain[0], [0.01, -0.02, 0.005, 0.0, 0.0, 0.0], atol=1e-9)
    np.testing.assert_allclose(parts.centre[0], [0.1, 0.2, 0.3], atol=1e-9)
    assert parts.remainder.max() < 1e-9
    bent = moved + 1e-3 * np.sin(40 * X[:, :1])
    assert 1e-4 < residual.decompose(bent, x).remainder[0] < 1.7e-3


@pytest.mark.parametrize("kind", ["flight", "internal modes", "rotation", "none"])
def test_stages_tell_where(kind):
    """A missing body force shows in flight alone; a missing strain or turn in modes or rotation; noise in none."""
    before = falling(np.array([0.0, -9.8, 0.0])) + np.array([0.0, 5.0, 0.0])
    truth = before.copy()
    if kind == "flight":
        truth = truth + 0.5 * np.array([2.0, 0.0, 0.0]) * T[:, None, None] ** 2
    arm = X - X.mean(axis=0)
    wave = 0.05 * np.sin(25 * T)[:, None, None]
    if kind == "internal modes":
        truth = truth + wave * arm * [1.0, -1.0, 0.5]
    if kind == "rotation":
        truth = truth + wave * np.cross([0.0, 1.0, 0.0], arm)
    x = truth + 2e-4 * RNG.standard_normal(truth.shape)
    found = residual.stages(x, T, before, truth, mass=2.0, sigma=2e-4, planes=(FLOOR,), margin=0.02)
    excess = {s.name: (s.excess(s.before), s.excess(s.after)) for s in found}
    assert "contact" not in excess
    for name, (_, after) in excess.items():
        assert after < 3.0, name
    if kind == "none":
        assert all(before < 3.0 for before, _ in excess.values())
    else:
        assert excess[kind][0] > 30.0
        others = {"flight", "internal modes", "rotation"} - {kind}
        assert all(excess[name][0] < 0.1 * excess[kind][0] for name in others)
        assert residual.telling([s for s in found if s.name in ("flight", "internal modes", "rotation")]).name == kind


def test_contact_is_told_from_flight():
    x = falling(np.array([0.0, -9.8, 0.0])) + np.array([0.0, 0.15, 0.0])
    touch = residual.in_contact(x, (FLOOR,), 0.02)
    low = x[..., 1].min(axis=1)
    np.testing.assert_array_equal(touch, low < 0.02)
    assert 0 < touch.sum() < len(touch)
    names = {s.name for s in residual.stages(x, T, x, x, mass=1.0, sigma=1e-4, planes=(FLOOR,), margin=0.02)}
    assert {"contact", "flight"} <= names


def test_place_finds_the_corner_that_is_pushed():
    before = falling(np.array([0.0, -9.8, 0.0]))
    corner = X[:, 0] + X[:, 1] - X[:, 2]
    pushed = np.exp(-((corner.max() - corner) ** 2) / 2e-3)[:, None] * np.array([1.0, 0.0, 0.0])
    x = before + 0.5 * pushed * T[:, None, None] ** 2 + 1e-4 * RNG.standard_normal(before.shape)
    where, excess = residual.place(x, T, before, sigma=1e-4)
    assert excess > 3
    signs = np.sign(where - X.mean(axis=0))
    np.testing.assert_array_equal(signs, [1, 1, -1])


def test_place_of_few_points():
    few = np.linspace(0, len(X) - 1, 6).astype(int)
    before = falling(np.array([0.0, -9.8, 0.0]))[:, few]
    x = before + np.linspace(0.0, 0.1, 6)[:, None] * 0.5 * T[:, None, None] ** 2
    where, excess = residual.place(x, T, before, sigma=1e-4)
    assert np.isfinite(where).all()
    assert excess >= 1.0
