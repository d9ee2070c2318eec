"""Bodies of one particle, and of particles in one place, fall freely: as the shared case 17-one-particle asks."""

import pytest
import torch

from neuido.physics.laws import FixedCorotated
from neuido.physics.mpm import Simulator
from neuido.types import Body, Scene

DT, STEPS = 5e-4, 100
FALL = -9.8 * DT**2 * STEPS * (STEPS + 1) / 2
"""Of the symplectic Euler method: -0.012372 m."""


@pytest.mark.parametrize("count", [1, 2, 40])
def test_particles_in_one_place_fall_freely(count):
    x = torch.tensor([[0.5, 0.6, 0.5]]).repeat(count, 1)
    sim = Simulator(Scene(cells=32, dt=DT, walls=None), Body(x, torch.zeros_like(x), torch.full((count,), 1e-6)), device="cpu")
    frames = sim.rollout(STEPS, FixedCorotated(1e5, 0.3), every=STEPS)
    torch.testing.assert_close(frames.x[-1] - x, torch.tensor([0.0, FALL, 0.0]).expand(count, 3), rtol=1e-3, atol=1e-6)


def test_particles_in_one_place_within_a_body_whose_velocity_is_not_affine():
    """No gradient of the velocity can be fitted to the copies; the momentum is kept all the same."""
    own = torch.stack(torch.meshgrid(*[torch.linspace(0.45, 0.55, 4)] * 3, indexing="ij"), -1).reshape(-1, 3)
    x = torch.cat([own, own[:1].repeat(40, 1)])
    v = torch.sin(40 * x)
    v = v - v.mean(0)
    sim = Simulator(Scene(cells=32, dt=DT, walls=None), Body(x, 0.1 * v, torch.full((104,), 1e-6)), device="cpu")
    frames = sim.rollout(STEPS, FixedCorotated(1e5, 0.3), every=STEPS)
    torch.testing.assert_close((frames.x[-1] - x).mean(0), torch.tensor([0.0, FALL, 0.0]), rtol=2e-3, atol=2e-5)
