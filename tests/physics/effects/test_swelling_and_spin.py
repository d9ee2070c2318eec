"""Swelling and the decay of a spin against closed forms, by the material point method and by finite elements."""

import math

import pytest
import torch

from neuido.errors import UserError
from neuido.physics.effects.constitutive import Constitutive
from neuido.physics.effects.parameters import Effects
from neuido.physics.fem.finite_elements import FiniteElements
from neuido.physics.laws.classical import FixedCorotated, NeoHookean
from neuido.physics.mpm.simulator import Simulator
from neuido.physics.points.material_point import Specimen, stress_along
from neuido.types import Scene
from tests.physics.bodies import DEVICE, block, same

SOFT = FixedCorotated(5e4, 0.3)
FREE = Scene(cells=16, dt=1e-3, gravity=(0.0, 0.0, 0.0), walls=None)
MOVING = {"velocity": (0.3, -0.2, 0.1)}


def body(**motion):
    return block((0.4, 0.4, 0.4), (0.6, 0.55, 0.62), (5, 4, 5), **motion)


def solver(name, given, scene=FREE, dtype=torch.float64):
    if name == "points":
        return Simulator(scene, given, dtype=dtype, device=DEVICE)
    return FiniteElements(scene, given, density=1000.0, dtype=dtype, device=DEVICE, elements=150)


def momenta(sim, frames, n):
    """Linear and angular momentum about the centre of mass of a frame, with what the particles rotate within themselves."""
    x, v, C = frames.x[n], frames.v[n], frames.C[n]
    m = sim.mass[:, None]
    r, u = x - (m * x).sum(0) / m.sum(), v - (m * v).sum(0) / m.sum()
    own = torch.stack([C[:, 2, 1] - C[:, 1, 2], C[:, 0, 2] - C[:, 2, 0], C[:, 1, 0] - C[:, 0, 1]], dim=1) * float(sim.dx[0]) ** 2 / 4
    return (m * v).sum(0), (m * (torch.linalg.cross(r, u) + own)).sum(0)


# Swelling.


@pytest.mark.parametrize("rate", [0.8, -0.8])
@pytest.mark.parametrize("name", ["points", "elements"])
def test_a_free_body_that_swells_has_g_times_its_size(name, rate):
    """Started with the velocities of the growth it stays free of stress, and each point moves to centre + g(t) (X - centre).

    Elements do so exactly; in the material point method C lags by a substep, an error of dt rate^2 in the velocities at the surface.
    """
    error = 2e-6 if name == "points" else 1e-10
    given = body(**MOVING)
    x0 = given.x.to(DEVICE)
    centre = x0.mean(dim=0)
    sim = solver(name, given._replace(v=given.v.to(DEVICE) + rate * (x0 - centre)))
    out = sim.rollout(200, SOFT, effects=Effects(swelling=rate), every=100)
    for n, t in enumerate((0.0, 0.1, 0.2)):
        moved = torch.tensor(MOVING["velocity"], dtype=torch.float64, device=DEVICE) * t
        torch.testing.assert_close(out.x[n], centre + moved + (1 + rate * t) * (x0 - centre), rtol=0, atol=error)
        torch.testing.assert_close(out.F[n], sim.state.F, rtol=0, atol=100 * error)


@pytest.mark.parametrize("name", ["points", "elements"])
def test_from_rest_it_breathes_about_that_size(name):
    sim = solver(name, body())
    x = sim.rollout(600, SOFT, effects=Effects(swelling=0.3, viscosity_shear=20.0), every=100).x
    radius = (x - x.mean(dim=1, keepdim=True)).norm(dim=2).mean(dim=1)
    t = 0.1 * torch.arange(7, dtype=torch.float64, device=DEVICE)
    torch.testing.assert_close(radius / radius[0], 1 + 0.3 * t, rtol=0, atol=2e-3)


def test_single_precision_keeps_a_slow_swelling():
    """A change of 1e-6 a substep is an eighth of what float32 resolves of F."""
    scene = Scene(cells=8, dt=1e-4, gravity=(0.0, 0.0, 0.0), walls=None)
    sim = solver("points", block((0.3, 0.3, 0.3), (0.7, 0.7, 0.7), (6, 6, 6)), scene, torch.float32)
    x = sim.rollout(4000, NeoHookean(2e4, 0.3), effects=Effects(swelling=0.01, viscosity_shear=20.0), every=4000).x.double()
    radius = (x - x.mean(dim=1, keepdim=True)).norm(dim=2).mean(dim=1)
    assert float(radius[1] / radius[0]) - 1 == pytest.approx(0.01 * 0.4, rel=0.03)


def test_a_held_gradient_is_divided_by_the_size():
    law = Constitutive(SOFT, None, Effects(swelling=torch.tensor([0.5, -0.5], dtype=torch.float64)), count=2)
    F, history = torch.eye(3, dtype=torch.float64).repeat(2, 1, 1), law.start()
    still = torch.zeros_like(F)
    for n in range(20):
        F, history = law.advance(F, still, history, 0.05, 0.05 * n)
    expected = torch.eye(3, dtype=torch.float64) / torch.tensor([1.5, 0.5], dtype=torch.float64)[:, None, None]
    torch.testing.assert_close(F, expected)


def test_a_specimen_that_swells_relaxes_to_its_new_size():
    t = torch.linspace(0.1, 1.0, 10, dtype=torch.float64)
    path = torch.full((10, 1), 1.2, dtype=torch.float64)
    stress = stress_along(Specimen(NeoHookean(1e5, 0.3), None, Effects(swelling=0.2), 1), "uniaxial", path, time=t)[0, :, 0]
    assert (stress.diff() < 0).all()
    later = stress_along(Specimen(NeoHookean(1e5, 0.3), None, Effects(), 1), "uniaxial", torch.tensor([[1.2 / (1.18 / 0.98)]]).double())
    # the clock starts with the first row, 0.1 s after the specimen was free; a stress-free size in place of one is a stretch less
    assert float(stress[-1]) == pytest.approx(float(later) / (1.18 / 0.98), abs=1e-3)
    with pytest.raises(UserError, match="times of the path"):
        stress_along(Specimen(NeoHookean(1e5, 0.3), None, Effects(swelling=0.2), 1), "uniaxial", path)
    with pytest.raises(UserError, match="swelling changes the volume"):
        stress_along(Specimen(NeoHookean(1e5, 0.3), None, Effects(swelling=0.2), 1, True), "uniaxial", path, time=t)


def test_a_body_cannot_shrink_to_nothing():
    with pytest.raises(UserError, match=r"swelling is -10 1/s; the body would vanish within 0\.2 s"):
        solver("points", body()).rollout(200, SOFT, effects=Effects(swelling=-10.0))
    t = torch.linspace(0.1, 1.0, 10, dtype=torch.float64)
    with pytest.raises(UserError, match="the body would vanish"):
        stress_along(Specimen(SOFT, None, Effects(swelling=-2.0), 1), "uniaxial", torch.ones(10, 1, dtype=torch.float64), time=t)
    for rows in (1, 2):  # the path begins 1 s before its first row, where g = 1 - 1.5
        with pytest.raises(UserError, match=r"swelling is 1\.5 1/s; 1 s before the first row"):
            path, t = torch.ones(rows, 1, dtype=torch.float64), torch.arange(rows, dtype=torch.float64)
            stress_along(Specimen(SOFT, None, Effects(swelling=torch.tensor([0.5, 1.5])), 2), "uniaxial", path, time=t)


# Spin decay.


def test_angular_momentum_decays_exponentially_and_linear_momentum_does_not():
    sim = solver("points", body(spin=(3.0, -2.0, 5.0), **MOVING))
    out = sim.rollout(120, SOFT, effects=Effects(spin_decay=4.0), every=40)
    p0, L0 = momenta(sim, out, 0)
    for n in (1, 2, 3):
        p, L = momenta(sim, out, n)
        torch.testing.assert_close(p, p0, rtol=1e-12, atol=1e-13)
        torch.testing.assert_close(L, L0 * math.exp(-4.0 * 0.04 * n), rtol=1e-9, atol=1e-9 * float(L0.norm()))


def test_elements_lose_their_spin_and_keep_their_momentum():
    scene = Scene(cells=16, dt=2e-4, gravity=(0.0, 0.0, 0.0), walls=None)
    given = block((0.4, 0.4, 0.4), (0.6, 0.6, 0.6), (5, 5, 5), spin=(0.0, 0.0, 3.0), **MOVING)
    sim = solver("elements", given, scene)
    plain, damped = (sim.rollout(500, SOFT, effects=effects, every=250) for effects in (None, Effects(spin_decay=4.0)))
    assembly = sim.assemblies[0]
    m = assembly.node_mass(sim.mass)[:, None]
    x, v = assembly.last[1:3]
    start = assembly.start(sim.state._replace(x=sim.state.x + 1e-3))  # far from the last end: the body as loaded
    centre = (m * start[0]).sum(0) / m.sum()
    L0 = (m * torch.linalg.cross(start[0] - centre, start[1])).sum(0)
    L = (m * torch.linalg.cross(x - (m * x).sum(0) / m.sum(), v)).sum(0)
    assert float(L[2] / L0[2]) == pytest.approx(math.exp(-4.0 * 0.1), rel=1e-6)
    torch.testing.assert_close((m * v).sum(0), (m * start[1]).sum(0), rtol=1e-12, atol=1e-13)
    torch.testing.assert_close(damped.x[-1].mean(0), plain.x[-1].mean(0), rtol=0, atol=2e-4)


def test_it_acts_on_each_body_alone():
    bodies = [body(spin=(0.0, 0.0, w)) for w in (4.0, 4.0)]
    sim = Simulator([FREE] * 2, bodies, dtype=torch.float64, device=DEVICE)
    out = sim.rollout(50, SOFT, effects=Effects(spin_decay=torch.tensor([0.0, 10.0])), every=50)
    alone = solver("points", bodies[1]).rollout(50, SOFT, effects=Effects(spin_decay=10.0), every=50)
    count = len(bodies[0].x)
    torch.testing.assert_close(out.x[:, count:], alone.x, rtol=0, atol=1e-12)
    plain = solver("points", bodies[0]).rollout(50, SOFT, every=50)
    torch.testing.assert_close(out.x[:, :count], plain.x, rtol=0, atol=1e-12)
    assert float((out.x[-1, :count] - out.x[-1, count:]).abs().max()) > 1e-3


# At size zero, where every diagnosis begins.


@pytest.mark.parametrize("name", ["points", "elements"])
def test_size_zero_changes_no_bit(name):
    plain, zero = (
        solver(name, body(spin=(3.0, 0.0, 1.0), **MOVING)).rollout(50, SOFT, effects=effects, every=25)
        for effects in (None, Effects(swelling=0.0, spin_decay=0.0))
    )
    for a, b in zip(plain, zero):
        assert same(a, b)


@pytest.mark.parametrize("field", ["swelling", "spin_decay"])
def test_the_gradient_at_zero_equals_finite_differences(field):
    sim = solver("points", body(spin=(3.0, -2.0, 5.0), **MOVING))
    weights = torch.randn(sim.state.x.shape, generator=torch.Generator().manual_seed(0), dtype=torch.float64).to(DEVICE)

    def loss(size):
        out = sim.rollout(20, SOFT, effects=Effects(**{field: size}), every=20)
        return (weights * out.x[-1]).sum() + (weights * out.v[-1]).sum()

    zero = torch.zeros((), dtype=torch.float64, requires_grad=True)
    analytic = float(torch.autograd.grad(loss(zero), zero)[0])
    h = 1e-3
    values = [float(loss(torch.tensor(k * h, dtype=torch.float64))) for k in range(5)]  # one-sided: a decay is not negative
    numeric = (-25 * values[0] + 48 * values[1] - 36 * values[2] + 16 * values[3] - 3 * values[4]) / (12 * h)
    assert analytic == pytest.approx(numeric, rel=1e-6)
