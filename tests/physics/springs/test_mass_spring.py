"""Masses and springs: closed forms, what is conserved, and the hand adjoint against the twin."""

import math

import pytest
import torch

from neuido.errors import UserError
from neuido.physics.springs.mass_spring import MassSpring, Springs, connect
from neuido.types import Plane, Scene, Walls
from tests.physics.bodies import DEVICES

FREE = Scene(gravity=(0.0, 0.0, 0.0), walls=None)
ZERO = torch.zeros((), dtype=torch.float64)


def cloud(count=40, seed=0):
    g = torch.Generator().manual_seed(seed)
    return 0.4 + 0.2 * torch.rand(count, 3, generator=g, dtype=torch.float64)


def body(scene, x, neighbours=8, power=0.5):
    mass = torch.linspace(0.5, 1.5, len(x), dtype=torch.float64, device=x.device)
    return MassSpring(scene, connect(x, neighbours), mass, power=power, dtype=torch.float64)


def test_frequency_of_one_spring():
    """w^2 = k (1/m1 + 1/m2) of two masses; semi-implicit Euler's own frequency at this step is 1e-5 higher."""
    x = torch.tensor([[0.0, 0.0, 0.0], [0.3, 0.4, 0.0]], dtype=torch.float64)
    springs = Springs(torch.tensor([[0, 1]]), torch.tensor([0.5], dtype=torch.float64), torch.tensor([0]))
    mass, k, dt = torch.tensor([1.0, 3.0], dtype=torch.float64), torch.tensor([30.0], dtype=torch.float64), 2e-3
    pair = MassSpring(FREE, springs, mass, power=0.0, dtype=torch.float64)
    start = x + torch.tensor([[0.0, 0.0, 0.0], [0.006, 0.008, 0.0]], dtype=torch.float64)  # along the spring
    xs, _ = pair.rollout(4000, dt, start, torch.zeros_like(x), k, torch.zeros_like(k), ZERO)
    stretch = (xs[:, 1] - xs[:, 0]).norm(dim=1) - 0.5
    falls = ((stretch[:-1] > 0) & (stretch[1:] <= 0)).nonzero()[:, 0]
    crossing = falls + stretch[falls] / (stretch[falls] - stretch[falls + 1])
    period = float((crossing[-1] - crossing[0]) * dt / (len(crossing) - 1))
    assert 2 * math.pi / period == pytest.approx(math.sqrt(30.0 * (1 + 1 / 3)), rel=2e-5)
    assert float(stretch.max()) == pytest.approx(0.01, rel=1e-2)


def test_a_damped_spring_loses_what_its_damper_takes():
    """|x| of m x'' + c x' + k x = 0 falls as exp(-c t / 2 m), m the reduced mass."""
    x = torch.tensor([[0.0, 0.0, 0.0], [0.5, 0.0, 0.0]], dtype=torch.float64)
    springs = Springs(torch.tensor([[0, 1]]), torch.tensor([0.49], dtype=torch.float64), torch.tensor([0]))
    k, c, dt = torch.tensor([40.0], dtype=torch.float64), torch.tensor([0.2], dtype=torch.float64), 1e-3
    pair = MassSpring(FREE, springs, torch.ones(2, dtype=torch.float64), power=0.0, dtype=torch.float64)
    xs, vs = pair.rollout(3000, dt, x, torch.zeros_like(x), k, c, ZERO)
    energy = pair.energy(xs, vs, k)
    assert float(energy[-1] / energy[0]) == pytest.approx(math.exp(-0.2 * 3.0 / 0.5), rel=2e-2)


def test_momentum_and_energy_are_kept():
    x = cloud()
    one = body(FREE, x, power=0.0)
    k = torch.full_like(one.rest, 50.0)
    g = torch.Generator().manual_seed(1)
    v = 0.1 * torch.randn(x.shape, generator=g, dtype=torch.float64)
    xs, vs = one.rollout(500, 1e-3, 1.02 * x, v, k, torch.zeros_like(k), ZERO)
    momentum = (one.mass[:, None] * vs).sum(1)
    spin = torch.linalg.cross(xs, one.mass[:, None] * vs).sum(1)
    torch.testing.assert_close(momentum, momentum[:1].expand_as(momentum), rtol=0, atol=1e-12)
    torch.testing.assert_close(spin, spin[:1].expand_as(spin), rtol=0, atol=1e-12)
    energy = one.energy(xs, vs, k)
    assert float((energy / energy[0] - 1).abs().max()) < 2e-2  # of a symplectic step: it swings, and does not drift
    assert float((energy[-100:].mean() / energy[:100].mean() - 1).abs()) < 5e-3


def test_free_fall_and_the_ground():
    x = cloud()
    scene = Scene(gravity=(0.0, -9.8, 0.0), colliders=(Plane((0.0, 0.1, 0.0), (0.0, 1.0, 0.0), "separate"),), walls=None)
    one = body(scene, x)
    k, none = torch.full_like(one.rest, 20.0), torch.zeros_like(one.rest)
    xs, vs = one.rollout(100, 1e-3, x, torch.zeros_like(x), k, none, ZERO)
    torch.testing.assert_close(vs[-1], torch.tensor([[0.0, -0.98, 0.0]], dtype=torch.float64).expand_as(x), rtol=1e-9, atol=1e-9)
    xs, vs = one.rollout(1500, 1e-3, x, torch.zeros_like(x), k, 0.05 * k, ZERO, every=10)
    assert float(xs[..., 1].min()) > 0.1 - 1e-9 and float(xs[-1, :, 1].min()) < 0.11
    assert float(vs[-1].norm(dim=1).max()) < 0.05  # it lies


def scene_with_every_contact():
    tilted = Plane((0.5, 0.42, 0.5), (0.2, 1.0, 0.1), "separate")
    return Scene(colliders=(tilted, Plane((0.42, 0, 0), (1.0, 0, 0), "slip"), Plane((0, 0, 0.58), (0, 0, -1.0), "sticky")), walls=Walls())


def leaves(one, x):
    g = torch.Generator().manual_seed(2)
    v = torch.randn(x.shape, generator=g, dtype=torch.float64)
    k = 20 + 40 * torch.rand(one.rest.shape, generator=g, dtype=torch.float64)
    c = 0.2 * torch.rand(one.rest.shape, generator=g, dtype=torch.float64)
    return [t.to(x.device).requires_grad_() for t in (x.clone(), v, k, c, torch.tensor(0.3, dtype=torch.float64))]


@pytest.mark.parametrize("device", DEVICES)
@pytest.mark.parametrize(("power", "lanes"), [(0.0, 1), (0.5, 1), (0.5, 4), (0.5, 32)])
def test_rollout_and_adjoint_equal_the_twin(power, lanes, device):
    x = cloud().to(device)
    one = body(scene_with_every_contact(), x, power=power)
    one.lanes = lanes
    inputs = leaves(one, x)
    xs, vs = one.rollout(30, 2e-3, *inputs, every=10)
    state, frames = inputs[:2], [inputs[:2]]
    for n in range(30):
        state = one.reference_step(*state, *inputs[2:], 2e-3)
        if n % 10 == 9:
            frames.append(state)
    expected = [torch.stack(part) for part in zip(*frames)]
    torch.testing.assert_close([xs, vs], expected, rtol=1e-11, atol=1e-11)
    g = torch.Generator().manual_seed(3)
    weights = [torch.randn(t.shape, generator=g, dtype=torch.float64).to(device) for t in expected]
    got = torch.autograd.grad([xs, vs], inputs, weights)
    want = torch.autograd.grad(expected, inputs, weights)
    for a, b in zip(got, want, strict=True):
        assert float(b.abs().max()) > 0
        torch.testing.assert_close(a, b, rtol=1e-9, atol=1e-9 * float(b.abs().max()))


def test_connect_names_each_pair_once_and_ranks_it():
    x = torch.tensor([[0.0, 0, 0], [1.0, 0, 0], [2.5, 0, 0], [2.5, 0, 0]], dtype=torch.float64)
    springs = connect(x, 2)
    assert springs.pairs.tolist() == [[0, 1], [0, 2], [1, 2], [1, 3]] or springs.pairs.tolist() == [[0, 1], [0, 3], [1, 2], [1, 3]]
    assert springs.rest.tolist() == [1.0, 2.5, 1.5, 1.5]  # none between the two in one place
    assert springs.rank.tolist()[0] == 0


def test_substeps_keep_a_stiff_body_stable():
    x = cloud()
    one = body(FREE, x)
    k = torch.full_like(one.rest, 1e6)
    c = torch.full_like(k, 10.0)
    parts = one.substeps(k, c, 1e-3)
    assert parts > 1
    xs, vs = one.rollout(200 * parts, 1e-3 / parts, 1.01 * x, torch.zeros_like(x), k, c, ZERO, every=parts)
    size = (xs - xs.mean(1, keepdim=True)).norm(dim=2).max()
    assert float(size) < 0.4
    with pytest.raises(UserError, match="not finite"):
        one.rollout(400, 1e-2, 1.01 * x, torch.zeros_like(x), k, c, ZERO)


def test_impossible_bodies_are_named():
    with pytest.raises(UserError, match="neighbours"):
        connect(cloud(), 0)
    with pytest.raises(UserError, match="least mass is 0"):
        MassSpring(FREE, connect(cloud(), 4), torch.zeros(40))
