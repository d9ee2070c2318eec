"""Attachments against the oscillator, the reaction on their collider, and finite differences, in float64."""

import math

import pytest
import torch

from neuido.errors import UserError
from neuido.physics.colliders import Cuboid, SolidInputs, Sphere
from neuido.physics.laws.classical import FixedCorotated
from neuido.physics.mpm.simulator import Simulator
from neuido.types import Attachment, Box, Scene, Skin
from tests.physics.bodies import DEVICE, block
from tests.physics.colliders.test_solid_gradients import leaf

LAW = FixedCorotated(1e5, 0.3)
WHOLE = Box((0.0, 0.0, 0.0), (1.0, 1.0, 1.0))
STILL = {"cells": 10, "dt": 1e-3, "walls": None, "gravity": (0.0, 0.0, 0.0)}


def cube(velocity=(0.0, 0.0, 0.0)):
    return block((0.4, 0.5, 0.4), (0.6, 0.7, 0.6), (4, 4, 4), velocity=velocity)


def test_a_body_on_a_spring_swings_at_its_frequency_and_is_damped():
    mass, stiffness, damping = 8.0, 800.0, 16.0
    body = cube((0.0, 0.5, 0.0))
    held = Attachment(WHOLE, stiffness=stiffness, damping=damping)
    sim = Simulator(Scene(attachments=(held,), **STILL), body, dtype=torch.float64, device=DEVICE)
    assert float(sim.mass.sum()) == pytest.approx(mass)
    with torch.no_grad():
        frames = sim.rollout(600, LAW, every=10)
    height = frames.x[:, :, 1].mean(1).cpu() - 0.6
    decay = damping / (2 * mass)
    rate = math.sqrt(stiffness / mass - decay**2)
    t = frames.times
    expected = 0.5 / rate * torch.exp(-decay * t) * torch.sin(rate * t)
    assert float((height - expected).abs().max()) < 0.05 * 0.5 / rate  # the implicit step of 1 ms damps by 2.5 % itself


def test_a_hanging_body_pulls_at_its_collider_with_its_weight_and_follows_it():
    hook = Cuboid((0.2, 0.1, 0.2), position=(0.5, 0.9, 0.5), name="hook", velocity=(0.1, 0.0, 0.0))
    held = Attachment(Box((0.3, 0.64, 0.3), (0.7, 0.8, 0.7)), to="hook", stiffness=2e4, damping=300.0)
    scene = Scene(**STILL | {"gravity": (0.0, -9.8, 0.0), "colliders": (hook,), "attachments": (held,)})
    sim = Simulator(scene, cube((0.1, 0.0, 0.0)), dtype=torch.float64, device=DEVICE)
    with torch.no_grad():
        frames = sim.rollout(1200, LAW, every=400)
    weight = float(sim.mass.sum()) * 9.8
    assert abs(float(frames.forces[-1, 0, 1]) + weight) < 0.01 * weight
    assert abs(float(frames.v[-1, :, 0].mean()) - 0.1) < 2e-3


def test_rigid_attachments_keep_their_places_and_keep_momentum_with_a_free_collider():
    ball = Sphere(0.1, position=(0.5, 0.3, 0.5), mass=5.0, velocity=(0.0, -0.5, 0.0), spin=(0.0, 0.0, 1.0), name="ball")
    held = Attachment(Box((0.3, 0.5, 0.3), (0.7, 0.58, 0.7)), to="ball")
    sim = Simulator(Scene(colliders=(ball,), attachments=(held,), **STILL), cube(), dtype=torch.float64, device=DEVICE)
    with torch.no_grad():
        frames = sim.rollout(100, LAW, every=50)
    (found,) = frames.colliders
    momentum = (sim.mass[:, None] * frames.v).sum(1) + 5.0 * found.velocity[:, :3]
    assert float((momentum - momentum[0]).abs().max()) < 1e-13
    low = frames.x[0, :, 1] < 0.58
    pose = found.poses
    local = torch.einsum("kji,kpj->kpi", pose[:, :3, :3], frames.x[:, low] - pose[:, None, :3, 3])
    assert float((local[-1] - local[0]).norm(dim=-1).max()) < 2e-3


def test_gradients_equal_finite_differences():
    plate = Cuboid(
        (0.3, 0.2, 0.3), position=(0.513, 0.423, 0.491), name="plate", velocity=(0.2, 0.1, 0.0), spin=(0.0, 1.0, 0.5), friction=0.2
    )
    ball = Sphere(0.1, position=(0.512, 0.793, 0.487), mass=5.0, velocity=(0.3, 0.0, 0.0), spin=(0.0, 2.0, 1.0), name="ball")
    skin = Skin(torch.zeros(1, 3), torch.zeros(1, 3, dtype=torch.int64), torch.arange(40, 64)[None], torch.ones(1, 24) / 24)
    held = (
        Attachment(tuple(range(10)), to="plate", stiffness=3e3, damping=20.0),
        Attachment([20, 22, 25], point=(0.5, 0.3, 0.5), stiffness=500.0, damping=2.0),
        Attachment(skin, to="ball", stiffness=4e3, damping=10.0),
        Attachment((12, 13)),
    )
    scene = Scene(**STILL | {"colliders": (plate, ball), "attachments": held, "gravity": (0.0, -9.8, 0.0)})
    sim = Simulator(scene, cube((0.1, 0.3, 0.0)), dtype=torch.float64, device=DEVICE)
    solids = SolidInputs(*(leaf(t) for t in sim.solid_inputs(4)))
    rates = leaf(sim.setup.attached.given)
    x, v, mass = leaf(sim.state.x), leaf(sim.state.v), leaf(sim.mass)
    leaves = {"pose": solids.pose, "velocity": solids.velocity, "twist": solids.twist, "rates": rates, "x": x, "v": v, "mass": mass}

    def loss(**options):
        own = {"solids": solids, "attachments": rates, "state": sim.state._replace(x=x, v=v), "mass": mass}
        frames = sim.rollout(4, LAW, every=2, **own, **options)
        total = 0.0
        for i, t in enumerate((*frames, 1e-2 * frames.forces, 0.1 * frames.torques, frames.colliders[1].poses)):
            weights = torch.randn(t.shape, generator=torch.Generator().manual_seed(i), dtype=t.dtype)
            total = total + (t * weights.to(t.device)).sum()
        return total

    gradients = torch.autograd.grad(loss(), list(leaves.values()))
    for (name, t), gradient in zip(leaves.items(), gradients, strict=True):
        direction = torch.randn(t.shape, generator=torch.Generator().manual_seed(9), dtype=t.dtype).to(t.device)
        if name == "rates":
            direction = torch.where(torch.isinf(t), 0.0, direction * t).detach()
        h = 1e-6 * (1.0 if name == "rates" else float(t.detach().norm() / direction.norm()))
        with torch.no_grad():
            values = []
            for shift in (-1, 1):
                t.add_(shift * h * direction)
                values.append(float(loss()))
                t.sub_(shift * h * direction)
        numeric, analytic = (values[1] - values[0]) / (2 * h), float((gradient * direction).sum())
        scale = max(abs(analytic), 1e-2 * float(gradient.norm() * direction.norm()))
        assert scale > 0 and abs(numeric - analytic) <= 1e-5 * scale, f"{name}: {numeric:.9g} by differences, {analytic:.9g}"
    parts = torch.autograd.grad(loss(segment=2), list(leaves.values()))
    for name, a, b in zip(leaves, parts, gradients, strict=True):
        assert float((a - b).norm()) <= 1e-11 * float(b.norm()), name


def test_impossible_attachments_are_one_line():
    def simulator(*held, colliders=()):
        return Simulator(Scene(colliders=colliders, attachments=held, **STILL), cube(), device="cpu")

    ball = Sphere(0.2, name="ball")
    for held, message in (
        ((Attachment(WHOLE, to="bal"),), "is to 'bal', which is not the name"),
        ((Attachment((1, 2)), Attachment((2, 3))), "another attachment holds"),
        ((Attachment((0, 64)),), "indices from 0 to 63"),
        ((Attachment(WHOLE, stiffness=0.0),), "has stiffness 0.0"),
        ((Attachment(Box((0.0, 0.0, 0.0), (0.1, 0.1, 0.1))),), "contains no particle"),
        ((Attachment(()),), "must be a Box, a Skin or whole numbers"),
    ):
        with pytest.raises(UserError, match=message):
            simulator(*held, colliders=(ball,))
    with pytest.raises(UserError, match=r"attachments has shape \(1, 2\); the scenes have 0"):
        simulator().rollout(2, LAW, attachments=torch.ones(1, 2))
