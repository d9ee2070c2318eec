"""Clamps on a given path: waves and static stretch of a bar by closed forms, balance of forces, gradients, and smooth paths."""

import numpy as np
import pytest
import torch

from neuido import Attachment, Body, Box, Keyframes, Scene, Simulator
from neuido.errors import UserError
from neuido.physics.colliders.solid_tables import path_poses
from neuido.physics.colliders.solids import Grip
from neuido.physics.laws import FixedCorotated

YOUNG, DENSITY, LENGTH, SIDE, HELD = 1.0e5, 1000.0, 0.4, 0.05, 0.0375
"""A bar along x without a lateral strain (Poisson's ratio 0): modulus [Pa], density, length, width, length in each clamp [m]."""
WAVE = (YOUNG / DENSITY) ** 0.5
AREA = SIDE**2
FREE = LENGTH - 2 * HELD
LEFT = 0.1


def bar(cells: int, path: Keyframes, *, per: int = 2, dt: float | None = None) -> Simulator:
    """A bar between two grips, of which the right one follows a path; two particles a cell along each axis."""
    dx = 0.6 / cells
    n = [round(side / dx * per) for side in (LENGTH, SIDE, SIDE)]
    axes = [(torch.arange(k, dtype=torch.float64) + 0.5) * side / k for k, side in zip(n, (LENGTH, SIDE, SIDE))]
    x = torch.cartesian_prod(*axes) + torch.tensor([LEFT, 0.1, 0.1], dtype=torch.float64)
    body = Body(x, torch.zeros_like(x), torch.full((len(x),), LENGTH * AREA / len(x), dtype=torch.float64))
    low, high = (0.0, 0.0, 0.0), (1.0, 1.0, 1.0)
    left, right = Box(low, (LEFT + HELD, 1, 1)), Box((LEFT + LENGTH - HELD, 0, 0), high)
    scene = Scene(
        (0.0, 0.0, 0.0), (0.6, 0.25, 0.25), cells, 0.25 * dx / WAVE if dt is None else dt, (0.0, 0.0, 0.0),
        (Grip(name="left"), Grip(path=path, name="right")), None, attachments=(Attachment(left, "left"), Attachment(right, "right")),
    )  # fmt: skip
    return Simulator(scene, body, density=DENSITY, device="cpu", dtype=torch.float64)


def law(young: torch.Tensor | float = YOUNG) -> FixedCorotated:
    return FixedCorotated(young, 0.0)


def test_a_pull_sends_a_wave():
    """The force on the driven end is rho c A v until the wave is back; that on the held end begins when it arrives, with twice as much."""
    speed, crossing = 0.2, FREE / WAVE
    own = bar(48, Keyframes((0.0, 1.0), ((0.0, 0.0, 0.0), (speed, 0.0, 0.0))))
    frames = own.rollout(int(1.9 * crossing / own.scenes[0].dt), law())
    t = frames.times.numpy() / crossing
    force = -frames.forces[:, :, 0].numpy()  # of the grips on the bar
    wave = DENSITY * WAVE * AREA * speed
    assert force[(t > 0.2) & (t < 1.6), 1].mean() == pytest.approx(wave, rel=0.01)
    assert np.abs(force[t < 0.8, 0]).max() < 0.01 * wave
    assert force[(t > 1.25) & (t < 1.8), 0].mean() == pytest.approx(-2 * wave, rel=0.02)
    middle = np.abs(frames.x[0, :, 0].numpy() - (LEFT + LENGTH / 2)) < 0.004
    passed = frames.v[:, middle, 0].mean(1).numpy() > 0.5 * speed
    assert t[passed.argmax()] == pytest.approx(0.5, abs=0.05)  # a cell and a half


@pytest.mark.slow
def test_a_slow_pull_ends_in_the_static_stretch():
    """F = E A u / L of a bar without lateral strain. The grid adds half a cell to the free length: the error falls with the cells."""
    stretch, t = 0.1 * FREE, np.linspace(0.0, 1.0, 41)
    u = stretch * (10 * t**3 - 15 * t**4 + 6 * t**5)
    path = Keyframes(tuple(t), tuple((float(a), 0.0, 0.0) for a in u), smooth=True)
    found = []
    for cells in (24, 48):
        own = bar(cells, path)
        frames = own.rollout(10 * int(0.13 / own.scenes[0].dt), law(), every=10)
        left, right = -frames.forces[frames.times > 1.0, :, 0].numpy().mean(0).T
        assert left == pytest.approx(-right, rel=1e-3)
        found.append(right)
    exact = YOUNG * AREA * stretch / FREE
    assert found[1] == pytest.approx(exact, rel=0.025)
    assert 2 * found[1] - found[0] == pytest.approx(exact, rel=0.003)


def test_gradients_of_reaction_and_motion():
    """With respect to modulus and motion of the clamp, against finite differences."""
    own = bar(12, Keyframes((0.0, 0.05), ((0.0, 0.0, 0.0), (0.01, 0.002, 0.0)), ((1.0, 0.0, 0.0, 0.0), (1.0, 0.02, 0.0, 0.01))))
    steps, given = 12, own.solid_inputs(12)
    weight = torch.linspace(-1.0, 1.0, len(own.state.x), dtype=torch.float64)[:, None]

    def loss(young: torch.Tensor, scale: torch.Tensor) -> torch.Tensor:
        frames = own.rollout(steps, law(young), solids=given._replace(twist=scale * given.twist), every=4)
        return frames.forces[:, 1].sum(0) @ torch.tensor([1.0, 3.0, -2.0], dtype=torch.float64) + 1e4 * (weight * frames.x[-1]).sum()

    young, scale = (torch.tensor(value, dtype=torch.float64, requires_grad=True) for value in (YOUNG, 1.0))
    found = torch.autograd.grad(loss(young, scale), (young, scale))
    with torch.no_grad():
        h = 1e-4
        by_young = (loss(young * (1 + h), scale) - loss(young * (1 - h), scale)) / (2 * h * YOUNG)
        by_scale = (loss(young, scale * (1 + h)) - loss(young, scale * (1 - h))) / (2 * h)
    torch.testing.assert_close(found[0], by_young, rtol=1e-5, atol=0)
    torch.testing.assert_close(found[1], by_scale, rtol=1e-5, atol=0)


def test_a_smooth_path_has_no_jumps():
    times = np.linspace(0.0, 1.0, 11)
    angle = 0.3 * np.sin(3 * times)
    turns = tuple((float(np.cos(a / 2)), 0.0, 0.0, float(np.sin(a / 2))) for a in angle)
    places = tuple((float(np.sin(4 * t)), 0.0, 0.0) for t in times)
    at = np.linspace(0.0, 1.0, 501)
    found = path_poses(Keyframes(tuple(times), places, turns, smooth=True), (1.0, 0.0, 0.0, 0.0), at)
    np.testing.assert_allclose(found[:, 0], np.sin(4 * at), atol=0.02)
    np.testing.assert_allclose(2 * np.arctan2(found[:, 6], found[:, 3]), 0.3 * np.sin(3 * at), atol=3e-3)
    straight = path_poses(Keyframes(tuple(times), places, turns), (1.0, 0.0, 0.0, 0.0), at)
    jumps = [np.abs(np.diff(own[:, 0], 2)).max() for own in (found, straight)]
    assert jumps[0] < 0.1 * jumps[1]
    np.testing.assert_allclose(np.linalg.norm(straight[:, 3:], axis=1), 1.0, atol=1e-12)


def test_a_grip_has_no_mass():
    with pytest.raises(UserError, match="a Grip has a mass; it moves as given"):
        Grip(mass=1.0)
