"""Memory that later rollouts use again, the nodes near colliders, and the order of the particles."""

import torch

from neuido.physics.laws.classical import FixedCorotated, VonMises
from neuido.physics.mpm.differentiable import permuted
from neuido.physics.mpm.simulator import Simulator
from tests.physics.bodies import DEVICE, busy_scenes, same


def results(sim: Simulator, speed: float, young: torch.Tensor) -> list[torch.Tensor]:
    """Return frames and gradients of a rollout with the initial velocities times a number."""
    v = (speed * sim.state.v).requires_grad_()
    frames = sim.rollout(10, FixedCorotated(young, 0.3), VonMises(500.0, young, 0.3), state=sim.state._replace(v=v), every=5)
    loss = frames.x[-1].square().sum() + frames.F[-1].square().sum()
    return [frames.x, frames.F, *torch.autograd.grad(loss, [v, young])]


def test_results_outlive_the_next_rollout():
    sim = Simulator(*busy_scenes(), dtype=torch.float64, device=DEVICE)
    young = torch.tensor([2e4], dtype=torch.float64, requires_grad=True)
    first = results(sim, 1.0, young)
    kept = [t.detach().clone() for t in first]
    other = results(sim, 0.5, young)
    for t, copy, changed in zip(first, kept, other):
        assert torch.equal(t, copy) and not torch.equal(t, changed)
    for t, copy in zip(results(sim, 1.0, young), kept):
        assert same(t.detach(), copy)


def test_nodes_are_marked_where_a_collider_or_a_clamp_may_act():
    sim = Simulator(*busy_scenes(), dtype=torch.float64, device=DEVICE)
    setup, table = sim.setup, sim.colliders
    scene = setup.room.index[:, 3].long()
    x = setup.origin[scene] + setup.room.index[:, :3] * setup.dx[scene, None]
    depth = (table.plane[scene, :, :3] * x[:, None]).sum(-1) - table.plane[scene, :, 3]
    outside = torch.maximum(setup.clamp_lower[scene] - x[:, None], x[:, None] - setup.clamp_upper[scene]).amax(-1)
    inside = (depth <= 0).any(1) | (outside <= 0).any(1)
    far = (depth > setup.dx[scene, None]).all(1) & (outside > setup.dx[scene, None]).all(1)
    near = setup.room.near.bool()
    assert inside.any() and far.any()
    assert bool(near[inside].all()) and not bool(near[far].any())


def test_a_permutation_and_its_gradient():
    g = torch.Generator().manual_seed(0)
    order = torch.randperm(7, generator=g)
    inverse = torch.argsort(order)
    t = torch.randn(2, 7, 3, generator=g, requires_grad=True)
    weight = torch.randn(2, 7, 3, generator=g)
    ours, indexed = permuted(t, order, inverse, 1), t[:, order]
    assert torch.equal(ours, indexed)
    gradients = [torch.autograd.grad((moved * weight).sum(), t)[0] for moved in (ours, indexed)]
    assert torch.equal(*gradients)
