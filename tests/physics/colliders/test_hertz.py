"""An elastic ball between two rigid spheres of triangles against Hertz's contact."""

import math

import numpy as np
import pytest
import torch

from neuido.physics.colliders import MeshCollider
from neuido.physics.effects.parameters import Effects
from neuido.physics.laws.classical import FixedCorotated
from neuido.physics.mpm.simulator import Simulator
from neuido.types import Body, Keyframes, Scene, Walls
from tests.physics.balances import note
from tests.physics.bodies import DEVICE

RADIUS, YOUNG, POISSON = 0.2, 1e5, 0.3
SPEED = 11.6
"""Speed of the P-wave for this modulus and 1000 kg/m^3 [m/s]."""


def ball_of_triangles(count: int = 2000) -> tuple[np.ndarray, np.ndarray]:
    """Return vertices on a Fibonacci lattice and their convex hull."""
    hull = pytest.importorskip("scipy.spatial").ConvexHull
    turn = np.arange(count) + 0.5
    up, around = 1 - 2 * turn / count, math.pi * (1 + 5**0.5) * turn
    flat = np.sqrt(1 - up**2)
    x = np.stack([flat * np.cos(around), up, flat * np.sin(around)], axis=1)
    faces = hull(x).simplices
    a, b, c = x[faces].transpose(1, 0, 2)
    outward = np.einsum("ti,ti->t", np.cross(b - a, c - a), a) > 0
    return RADIUS * x, np.where(outward[:, None], faces, faces[:, ::-1])


def stiffness(dx: float) -> tuple[float, float]:
    """Return the factor of F = K d^1.5, and the force at the largest approach d of 0.02 m, over Hertz's.

    An eighth of the ball lies between three frictionless walls. K is that of the slope of F^(2/3) over d, as in indentation tests, from
    0.006 to 0.02 m.
    """
    axis = (torch.arange(int(2 * RADIUS / dx) + 1) + 0.5) * dx / 2
    x = torch.cartesian_prod(axis, axis, axis)
    x = x[x.norm(dim=1) < RADIUS]
    body = Body(x, torch.zeros_like(x), torch.full((len(x),), math.pi / 6 * RADIUS**3 / len(x)))
    dt = 0.3 * dx / SPEED
    steps = int(0.3 / dt) // 30 * 30
    path = Keyframes((0.0, dt * steps), ((0.0, 2 * RADIUS + dx, 0.0), (0.0, 2 * RADIUS - 0.024, 0.0)))
    scene = Scene(upper=(0.24,) * 3, cells=round(0.24 / dx), dt=dt, gravity=(0.0, 0.0, 0.0), walls=Walls("slip"),
                  colliders=(MeshCollider(*ball_of_triangles(), path=path),))  # fmt: skip
    with torch.no_grad():
        damped = Effects(viscosity_shear=2e3 * dx, viscosity_bulk=2e3 * dx)
        frames = Simulator(scene, body, device=DEVICE).rollout(steps, FixedCorotated(YOUNG, POISSON), every=steps // 30, effects=damped)
    force = 4 * frames.forces[1:, 0, 1].cpu().numpy()
    height = frames.colliders[0].poses[:, 1, 3].cpu().numpy()
    depth = 2 * RADIUS - (height[1:] + height[:-1]) / 2  # a force is the mean between two frames
    hertz = 4 / 3 * YOUNG / (1 - POISSON**2) * math.sqrt(RADIUS / 2)
    window = (depth > 0.006) & (depth < 0.02)
    slope = np.polyfit(depth[window], force[window] ** (2 / 3), 1)[0]
    return float(slope**1.5 / hertz), float(force[window][-1] / (hertz * depth[window][-1] ** 1.5))


@pytest.mark.slow
def test_a_ball_pressed_by_a_mesh_sphere_approaches_hertz(record_property):
    coarse, fine = stiffness(0.02), stiffness(0.01)  # balls of 10 and 20 cells a radius
    for cells, found in ((10, coarse), (20, fine)):
        for what, value in zip(("stiffness by the slope of F^(2/3)", "largest force"), found, strict=True):
            note(record_property, f"{what} of a ball and a sphere of triangles, over Hertz's [-]", f"{cells} cells a radius", value, 1.0)
    assert abs(fine[1] - 1) < 0.1
    assert abs(fine[1] - 1) < 0.5 * abs(coarse[1] - 1)
    assert abs(fine[0] - 1) < 0.15
