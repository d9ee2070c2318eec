"""The ceiling tells a lawful residual from noise, and a law that does not carry over from one that does."""

import numpy as np
import pytest

from neuido.discrepancy.report import ceiling

NOISE = 0.05


def part(seed: int, *, law: float = 1.0, fitted: bool = True, rows: int = 1500):
    """Residuals of which a smooth function of place and velocity makes up a share, in the order of time."""
    rng = np.random.default_rng(seed)
    x = rng.uniform(-1, 1, (rows, 6))
    t = np.linspace(0.0, 1.0, rows)[:, None]
    r = law * np.stack([np.sin(2 * x[:, 0]) * x[:, 3], 0.5 * x[:, 4], x[:, 5] ** 2], 1) + NOISE * rng.standard_normal((rows, 3))
    return fitted, np.concatenate([x, t], 1), r, np.ones(rows)


def shares(parts) -> ceiling.Ceiling:
    return ceiling.train(parts, noises=[NOISE] * len(parts), seed=1)


def test_lawful_residual_carries_over():
    found = shares([part(0), part(1, fitted=False)])
    assert found.held_out > 0.8
    assert found.held_out <= 1.05


def test_noise_is_not_explained():
    """In the mean squares themselves: what the network takes off pure noise is little."""
    fitted, features, r, w = part(0, law=0.0)
    other = part(1, law=0.0, fitted=False)
    found = ceiling.train([(fitted, features, r, w), other], noises=[0.0, 0.0], seed=0)
    assert found.held_out < 0.05


def test_law_that_turns_round_is_worse_than_nothing():
    found = shares([part(0), part(1, law=-1.0, fitted=False)])
    assert found.held_out < -0.5


def test_same_seed_same_figure():
    parts = [part(0, rows=400), part(1, fitted=False, rows=400)]
    assert shares(parts) == shares(parts)


def test_without_held_out_parts():
    assert np.isnan(shares([part(0, rows=400)]).held_out)


def test_slope_within_groups():
    t = np.repeat(np.linspace(0.0, 1.0, 11), 2)
    groups = np.tile([0, 1], 11)
    values = np.where(groups == 0, 3.0 * t, -2.0 * t)
    np.testing.assert_allclose(ceiling._slope(values, t, groups), np.where(groups == 0, 3.0, -2.0))
    assert ceiling._slope(np.array([1.0]), np.array([0.0]), np.array([0]))[0] == pytest.approx(0.0)
