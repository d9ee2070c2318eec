"""Untested versions of Warp and torch get one warning and slower public calls, with the same results."""

import warnings

import pytest
import torch

from neuido.data.bodies.shapes import cube
from neuido.physics.laws.classical import FixedCorotated
from neuido.physics.mpm.simulator import Simulator
from neuido.physics.runtime import internals
from neuido.types import Scene


@pytest.mark.parametrize(("version", "tried"), [("2.13.1+cpu", True), ("2.11.0", True), ("2.10.9", False), ("3.0.0a1", False)])
def test_a_version_that_was_not_tried_is_one_line(version, tried):
    with warnings.catch_warnings(record=True) as said:
        warnings.simplefilter("always")
        assert internals.is_tested("torch", version) is tried
    assert [str(w.message).count("\n") for w in said] == ([] if tried else [0])
    assert all(version in str(w.message) and "2.11 to 2.13" in str(w.message) for w in said)


def test_the_public_way_moves_as_the_private_one(monkeypatch):
    body = cube(length=0.2, centre=(0.3, 0.2, 0.5), particles_per_side=4, velocity=(2.5, -2.0, 0.3))

    def frames():
        simulator = Simulator(Scene(cells=12, dt=5e-4), body, device="cpu")
        young = torch.tensor([2e4], requires_grad=True)
        out = simulator.rollout(20, FixedCorotated(young, 0.3), every=10)
        return *(t.detach() for t in out), *torch.autograd.grad(out.x.square().sum(), young)

    fast = frames()
    for name in ("WARP_TESTED", "TORCH_TESTED"):
        monkeypatch.setattr(internals, name, False)
    assert all(torch.equal(a, b) for a, b in zip(fast, frames(), strict=True))


@pytest.mark.parametrize("name", ["silu", "gelu"])
def test_activations_are_the_same_either_way(monkeypatch, name):
    into, adjoint_into = getattr(internals, f"{name}_into"), getattr(internals, f"{name}_adjoint_into")
    x, grad = torch.linspace(-6, 6, 101, dtype=torch.float64), torch.linspace(1, 2, 101, dtype=torch.float64)

    def both():
        out, back = torch.empty_like(x), grad.clone()
        into(x, out)
        adjoint_into(back, x, back)
        return out, back

    fast = both()
    monkeypatch.setattr(internals, "TORCH_TESTED", False)
    for a, b in zip(fast, both(), strict=True):
        assert torch.allclose(a, b, rtol=1e-13, atol=1e-15)
