"""What the simulator must do whatever its code looks like: conservation laws, closed forms, symmetries, convergence."""

import math

import pytest
import torch

from neuido.errors import UserError
from neuido.physics.effects.parameters import Effects
from neuido.physics.laws.classical import DruckerPrager, FixedCorotated, Identity, NeoHookean, Sigma, VonMises, stack
from neuido.physics.mpm.plan import Plan
from neuido.physics.mpm.rollout import add_to_grid
from neuido.physics.mpm.simulator import Simulator
from neuido.physics.mpm.state import affine_velocity
from neuido.types import AttachedMass, Body, Box, ParticleState, Plane, Scene, Walls
from tests.physics.bodies import DEVICE, DEVICES, block, busy_scenes, same

NO_GRAVITY = (0.0, 0.0, 0.0)
SOFT = FixedCorotated(1e5, 0.3)


def simulator(scene, body, device=DEVICE, **options):
    return Simulator(scene, body, dtype=torch.float64, device=device, **options)


def energy(sim, frames, young, poisson, gravity=9.8):
    """Kinetic (with APIC's affine part), elastic (fixed corotated) and potential energy of each frame [J]."""
    x, v, C, F = frames
    m = sim.mass
    kinetic = 0.5 * (m * v.square().sum(-1)).sum(-1) + 0.5 * (m * C.square().sum((-1, -2))).sum(-1) * float(sim.dx[0]) ** 2 / 4
    mu, lam = young / (2 * (1 + poisson)), young * poisson / ((1 + poisson) * (1 - 2 * poisson))
    s = torch.linalg.svdvals(F)
    density = mu * (s - 1).square().sum(-1) + 0.5 * lam * (s.prod(-1) - 1).square()
    return kinetic + (sim.volume * density).sum(-1) + (m * x[..., 1]).sum(-1) * gravity


@pytest.mark.parametrize("device", DEVICES)
def test_a_substep_conserves_mass_momentum_and_spin(device):
    body = block((0.3, 0.3, 0.3), (0.7, 0.6, 0.65), (6, 5, 5), velocity=(0.7, -0.4, 1.1), spin=(3.0, -2.0, 5.0))
    sim = simulator(Scene(gravity=NO_GRAVITY, cells=16, dt=1e-3), body, device)
    g = torch.Generator().manual_seed(0)
    F = sim.state.F + 0.1 * torch.randn(sim.state.F.shape, generator=g, dtype=torch.float64).to(device)
    start = sim.state._replace(F=F)
    plan = Plan(sim.setup, SOFT, None, 1, 1)
    tau = SOFT(F)
    grid = sim.setup.room.scratch("grid").zero_()
    add_to_grid(plan, start.x, start.v, start.C, tau, sim.mass, grid)
    assert torch.isclose(grid[..., 3].sum(), sim.mass.sum(), rtol=1e-13)
    m = sim.mass[:, None]
    frames = sim.rollout(5, SOFT, state=start)

    def momentum(n):
        return (m * frames.v[n]).sum(0)

    def spin(n):
        # APIC: the affine part of a particle carries m D (C - C^T), D = dx^2/4
        x, v, C = frames.x[n], frames.v[n], frames.C[n]
        D = float(sim.dx[0]) ** 2 / 4
        W = C - C.transpose(1, 2)
        affine = torch.stack([W[:, 2, 1], W[:, 0, 2], W[:, 1, 0]], dim=1) * D
        return (m * (torch.linalg.cross(x, v) + affine)).sum(0)

    for n in range(1, 6):
        assert torch.allclose(momentum(n), momentum(0), rtol=1e-12)
        assert torch.allclose(spin(n), spin(0), rtol=1e-10)


def test_a_rollout_starts_with_the_affine_velocity():
    body = block((0.35, 0.35, 0.35), (0.65, 0.65, 0.65), (8, 8, 8), velocity=(1.0, -2.0, 0.0), spin=(4.0, 4.0, 4.0))
    sim = simulator(Scene(gravity=NO_GRAVITY, cells=32, dt=5e-4), body)
    omega = torch.tensor([[0.0, -4.0, 4.0], [4.0, 0.0, -4.0], [-4.0, 4.0, 0.0]], dtype=torch.float64, device=DEVICE)
    assert torch.allclose(sim.state.C, omega.expand_as(sim.state.C), atol=1e-6)

    def spin(C):
        frames = sim.rollout(1, SOFT, state=sim.state._replace(C=C))
        x, v = frames.x[1], frames.v[1]
        return float(torch.linalg.cross(x - x.mean(0), v - v.mean(0)).sum(0).norm())

    x, v = sim.state.x, sim.state.v
    start = float(torch.linalg.cross(x - x.mean(0), v - v.mean(0)).sum(0).norm())
    assert abs(spin(sim.state.C) / start - 1) < 2e-3
    assert spin(torch.zeros_like(sim.state.C)) / start < 0.99


def test_affine_velocity_of_a_field_that_is_not_affine():
    x = torch.rand(4000, 3, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    v = torch.stack([torch.sin(2 * x[:, 1]), x[:, 0] ** 2, torch.zeros(len(x), dtype=torch.float64)], dim=1)
    C = affine_velocity(x, v)
    inner = ((x > 0.2) & (x < 0.8)).all(1)
    expected = torch.zeros_like(C)
    expected[:, 0, 1], expected[:, 1, 0] = 2 * torch.cos(2 * x[:, 1]), 2 * x[:, 0]
    assert float((C - expected)[inner].norm(dim=(1, 2)).mean()) < 0.05


def test_rigid_translation_gives_no_stress():
    body = block((0.2, 0.2, 0.2), (0.5, 0.5, 0.5), (5, 5, 5), velocity=(2.0, 1.0, 1.5))
    sim = simulator(Scene(gravity=NO_GRAVITY, cells=16, dt=1e-3), body)
    frames = sim.rollout(100, SOFT, every=100)
    assert float(SOFT(frames.F[1]).abs().max()) < 1e-6
    assert torch.allclose(frames.x[1], sim.state.x + 0.1 * sim.state.v, atol=1e-12)


def test_rigid_rotation_gives_no_stress_as_the_step_goes_to_zero():
    def stress(dt):
        body = block((0.35, 0.35, 0.35), (0.65, 0.65, 0.65), (6, 6, 6), spin=(0.0, 0.0, 5.0))
        sim = simulator(Scene(gravity=NO_GRAVITY, cells=16, dt=dt), body)
        return float(SOFT(sim.rollout(1, SOFT).F[1]).abs().mean())

    # explicit Euler stretches a rotating body by (omega dt)^2 / 2 a step
    coarse, fine = stress(1e-3), stress(1.25e-4)
    assert fine < 0.02 * coarse


@pytest.mark.parametrize("device", DEVICES)
def test_free_fall_in_closed_form(device):
    body = block((0.4, 0.6, 0.4), (0.6, 0.8, 0.6), (4, 4, 4), velocity=(0.3, 1.0, -0.2))
    sim = simulator(Scene(cells=16, dt=1e-3), body, device)
    frames = sim.rollout(200, SOFT, every=50)
    for k in range(5):
        n = 50 * k
        fall = 9.8 * 1e-6 * n * (n + 1) / 2  # symplectic Euler's own closed form
        expected = sim.state.x + 1e-3 * n * sim.state.v
        expected[:, 1] -= fall
        assert torch.allclose(frames.x[k], expected, atol=1e-11)


def test_drag_and_pull_in_closed_form():
    body = block((0.45, 0.45, 0.45), (0.55, 0.55, 0.55), (3, 3, 3), velocity=(0.0, -1.0, 0.0))
    scene = Scene(gravity=(0.0, -9.8, 0.0), cells=16, dt=1e-3)
    v, steps = -1.0, 60
    frames = simulator(scene, body).rollout(steps, SOFT, effects=Effects(drag_linear=3.0), every=steps)
    w = v
    for _ in range(steps):
        w = (w - 9.8e-3) / (1 + 3e-3)
    assert torch.allclose(frames.v[1][:, 1], torch.tensor(w, dtype=torch.float64, device=DEVICE), atol=1e-10)
    exact = -9.8 / 3 + (v + 9.8 / 3) * math.exp(-3 * 0.06)
    assert abs(w - exact) < 2e-3
    frames = simulator(scene, body).rollout(steps, SOFT, effects=Effects(drag_quadratic=2.0), every=steps)
    terminal = math.sqrt(9.8 / 2)
    exact = -terminal * math.tanh(math.atanh(1 / terminal) + 0.06 * math.sqrt(9.8 * 2))
    assert abs(float(frames.v[1][:, 1].mean()) - exact) < 5e-3
    # a stiff pull (many times the body's own weight) on a rigid-like body: a harmonic oscillator of its centre
    still = block((0.55, 0.45, 0.45), (0.65, 0.55, 0.55), (3, 3, 3))
    effects = Effects(position_force=400.0, position_centre=(0.5, 0.5, 0.5))
    frames = simulator(Scene(gravity=NO_GRAVITY, cells=16, dt=2.5e-4), still).rollout(
        400, FixedCorotated(1e5, 0.3), effects=effects, every=400
    )
    assert abs(float(frames.x[1][:, 0].mean()) - (0.5 + 0.1 * math.cos(20 * 0.1))) < 2e-3


@pytest.mark.parametrize("device", DEVICES)
def test_energy_never_grows_in_an_elastic_bounce(device):
    young, poisson = 1e5, 0.3
    body = block((0.35, 0.1, 0.35), (0.65, 0.4, 0.65), (7, 7, 7), velocity=(0.0, -2.0, 0.0))
    sim = simulator(Scene(cells=16, dt=5e-4), body, device)
    frames = sim.rollout(600, FixedCorotated(young, poisson), every=5)
    total = energy(sim, frames, young, poisson)
    scale = float(total[0] - total.min())
    assert float(frames.x[:, :, 1].mean(1).diff().max()) > 0, "the body never bounced"
    best = torch.cummin(total, 0).values
    assert float((total - best).max()) < 0.01 * float(total[0]), "energy grew"
    assert float(total[-1]) < float(total[0]) and scale > 0


def test_frame_indifference_of_a_rollout():
    """A scene turned by 90 degrees about y gives the turned motion."""
    R = torch.tensor([[0.0, 0.0, 1.0], [0.0, 1.0, 0.0], [-1.0, 0.0, 0.0]], dtype=torch.float64, device=DEVICE)
    centre = torch.tensor([0.5, 0.0, 0.5], dtype=torch.float64, device=DEVICE)
    body = block((0.3, 0.1, 0.4), (0.7, 0.3, 0.55), (6, 4, 4), velocity=(1.0, -2.0, 0.5), spin=(1.0, 2.0, 3.0))
    turned = Body((body.x - centre) @ R.T + centre, body.v @ R.T, body.volume)
    laws = Sigma(3e5, 0.25), VonMises(5e3, 3e5, 0.25)
    a, b = (simulator(Scene(cells=16, dt=5e-4), which).rollout(150, *laws, every=150) for which in (body, turned))
    assert torch.allclose((a.x - centre) @ R.T + centre, b.x, atol=1e-9)
    assert torch.allclose(R @ a.F @ R.T, b.F, atol=1e-8)


def test_a_body_in_a_corner_stays_in_the_domain():
    body = block((0.0, 0.0, 0.0), (0.25, 0.25, 0.25), (5, 5, 5), velocity=(-4.0, -5.0, -4.0))
    for contact in ("separate", "slip", "sticky"):
        sim = simulator(Scene(cells=16, dt=5e-4, walls=Walls(contact)), body)
        frames = sim.rollout(400, SOFT, every=20)
        assert float(frames.x.min()) > -0.5 * sim.scenes[0].dx
        assert float(frames.x.max()) < 1.0
    top = block((0.75, 0.75, 0.75), (1.0, 1.0, 1.0), (5, 5, 5), velocity=(4.0, 5.0, 4.0))
    sim = simulator(Scene(cells=16, dt=5e-4, gravity=(0.0, 9.8, 9.8)), top)
    assert float(sim.rollout(400, SOFT, every=20).x.max()) < 1.0 + 0.5 * sim.scenes[0].dx


@pytest.mark.parametrize("device", DEVICES)
def test_one_launch_of_three_scenes_equals_three_launches(device):
    scenes = [
        Scene(cells=16, dt=5e-4),
        Scene(cells=12, dt=1e-3, gravity=(0.0, 0.0, 9.8), colliders=(Plane((0, 0, 0.8), (0, 0, -1.0), "sticky"),)),
        Scene(lower=(0.0, -0.5, 0.0), upper=(1.0, 1.0, 2.0), cells=20, dt=2e-4, walls=Walls("separate", math.inf, 1.0)),
    ]
    bodies = [
        block((0.3, 0.05, 0.3), (0.7, 0.4, 0.7), (5, 5, 5), velocity=(0.0, -2.0, 0.0)),
        block((0.3, 0.3, 0.5), (0.6, 0.6, 0.7), (4, 5, 6), velocity=(0.0, 0.0, 2.0)),
        block((0.3, -0.3, 0.3), (0.7, 0.0, 0.9), (4, 4, 5), velocity=(1.0, -1.0, 0.0)),
    ]
    elastic = [FixedCorotated(1e5, 0.2), Sigma(3e4, 0.25), Sigma(5e5, 0.2)]
    plastic = [Identity(), VonMises(5e3, 3e4, 0.25), DruckerPrager(25.0, 5e5, 0.2)]
    together = simulator(scenes, bodies, device, density=[1000.0, 800.0, 1500.0])
    frames = together.rollout(120, stack(elastic), stack(plastic), every=40)
    for s in range(3):
        alone = simulator(scenes[s], bodies[s], device, density=[1000.0, 800.0, 1500.0][s]).rollout(120, elastic[s], plastic[s], every=40)
        own = slice(together.particles.offsets[s], together.particles.offsets[s + 1])
        for name, a, b in zip("xvCF", frames, alone):
            assert torch.allclose(a[:, own], b, rtol=1e-10, atol=1e-9), name


@pytest.mark.skipif(DEVICE != "cpu", reason="threads are the CPU's")
def test_threads_do_not_change_a_bit_of_the_motion_nor_the_gradient():
    scenes, bodies = busy_scenes()
    young = torch.tensor([4e4, 6e4], dtype=torch.float64, requires_grad=True)
    viscosity = torch.tensor([3.0, 5.0], dtype=torch.float64, requires_grad=True)
    results = []
    for threads in (False, True):
        sim = simulator(scenes, bodies, threads=threads)
        start = sim.state._replace(v=sim.state.v.clone().requires_grad_())
        effects = Effects(viscosity_shear=viscosity, drag_linear=0.3)
        friction = sim.colliders.friction.clone().requires_grad_()
        shared = torch.tensor(2e3, dtype=torch.float64, requires_grad=True)
        frames = sim.rollout(12, Sigma(young, 0.3), VonMises(shared, 5e4, 0.3), state=start, effects=effects, friction=friction, every=3)
        with torch.no_grad():
            again = sim.rollout(12, Sigma(young, 0.3), VonMises(shared, 5e4, 0.3), effects=effects, every=3)
        loss = frames.x.square().sum() + frames.F[2].square().sum()
        results.append((*frames, *again, *torch.autograd.grad(loss, (start.v, young, viscosity, friction, shared))))
    for a, b in zip(*results, strict=True):
        assert torch.allclose(a, b, rtol=1e-12, atol=1e-300), float((a - b).abs().max())


def test_a_parameter_batch_of_one_scene_equals_single_runs():
    body = block((0.3, 0.02, 0.3), (0.7, 0.4, 0.7), (5, 5, 5), velocity=(0.0, -2.0, 0.0))
    young = torch.tensor([5e4, 1e5, 2e5], dtype=torch.float64, device=DEVICE)
    sim = simulator([Scene(cells=16)] * 3, [body] * 3)
    frames = sim.rollout(80, NeoHookean(young, 0.3), effects=Effects(drag_linear=torch.tensor([0.0, 1.0, 2.0])), every=80)
    for s in range(3):
        alone = simulator(Scene(cells=16), body).rollout(
            80, NeoHookean(float(young[s]), 0.3), effects=Effects(drag_linear=float(s)), every=80
        )
        assert torch.allclose(frames.x[1].view(3, -1, 3)[s], alone.x[1], atol=1e-12)


@pytest.mark.parametrize(("friction", "tilt"), [(0.2, 0.0), (0.5, 0.0), (0.3, 0.5)])
def test_coulomb_friction_on_a_plane(friction, tilt):
    """A stiff slab slides with the deceleration mu g (and down a slope with g (sin - mu cos))."""
    body = block((0.2, 0.25, 0.3), (0.5, 0.32, 0.6), (10, 3, 10), velocity=(1.0, 0.0, 0.0))
    gravity = (9.8 * math.sin(tilt), -9.8 * math.cos(tilt), 0.0)
    scene = Scene(cells=32, dt=2.5e-4, gravity=gravity, colliders=(Plane((0, 0.25, 0), (0, 1, 0), "separate", friction),))
    frames = simulator(scene, body).rollout(800, FixedCorotated(1e6, 0.2), every=400)
    expected = gravity[0] + friction * gravity[1]
    measured = float(frames.v[2][:, 0].mean() - frames.v[1][:, 0].mean()) / 0.1
    if 1.0 + expected * 0.2 <= 0:
        assert abs(float(frames.v[2][:, 0].mean())) < 0.02
    else:
        assert abs(measured - expected) < 0.05 * 9.8


def test_contacts_do_what_their_names_say():
    def end(contact, friction=0.0):
        body = block((0.3, 0.25, 0.3), (0.5, 0.35, 0.5), (6, 4, 6), velocity=(1.0, -0.5, 0.0))
        scene = Scene(cells=32, dt=5e-4, colliders=(Plane((0, 0.25, 0), (0, 1, 0), contact, friction),))
        return simulator(scene, body).rollout(200, FixedCorotated(1e5, 0.3), every=200).v[1].mean(0)

    assert abs(float(end("slip")[0]) - 1.0) < 1e-6
    assert abs(float(end("separate")[0]) - 1.0) < 1e-6
    assert abs(float(end("sticky")[0])) < 0.3
    assert abs(float(end("separate", math.inf)[0])) < 0.3


@pytest.mark.parametrize("effects", [Effects(), Effects(viscosity_shear=400.0), Effects(fibre=3e5, fibre_direction=(1.0, 0.0, 0.0))])
def test_the_step_margin_is_where_a_rollout_refuses(effects):
    body, law, dt = block((0.4, 0.4, 0.4), (0.6, 0.6, 0.6), (5, 5, 5)), FixedCorotated(1e5, 0.3), 1e-4

    def scenes(factor):
        return simulator([Scene(cells=16, dt=factor * dt), Scene(cells=20, dt=factor * dt)], [body, body])

    margin = scenes(1.0).step_margin(5, law, effects=effects)
    assert margin == pytest.approx(scenes(0.5).step_margin(5, law, effects=effects) / 2)
    assert margin < 0.9 * simulator(Scene(cells=16, dt=dt), body).step_margin(5, law, effects=effects), "the finer grid bears less"
    scenes(0.999 * margin).rollout(5, law, effects=effects)
    with pytest.raises(UserError, match="above the limit"):
        scenes(1.001 * margin).rollout(5, law, effects=effects)


def test_a_clamped_beam_sags_and_its_clamp_holds():
    body = block((0.2, 0.45, 0.45), (0.7, 0.55, 0.55), (20, 4, 4))
    clamp = Box((0.2, 0.4, 0.4), (0.28, 0.6, 0.6))
    mass = AttachedMass(Box((0.64, 0.4, 0.4), (0.7, 0.6, 0.6)), 0.5)
    scene = Scene(cells=32, dt=5e-4, clamps=(clamp,), attached_masses=(mass,))
    sim = simulator(scene, body)
    assert torch.isclose(sim.mass.sum(), torch.tensor(1000 * 0.5 * 0.1 * 0.1 + 0.5, dtype=torch.float64, device=DEVICE))
    frames = sim.rollout(200, FixedCorotated(3e5, 0.3), every=200)
    held = body.x[:, 0] <= 0.28
    assert torch.equal(frames.x[1][held], body.x[held])
    assert float((frames.x[1] - body.x)[body.x[:, 0] > 0.65][:, 1].max()) < -0.01


@pytest.mark.parametrize("kind", [torch.float32, torch.float64])
@pytest.mark.parametrize("cells", [30, 35, 36, 41, 42, 47, 60])
@pytest.mark.slow
def test_a_body_does_not_slide_out_of_its_clamp(cells, kind):
    """In single precision 6 * (0.15 / 36) is past 0.025; at 35, 41 and 47 cells the last layer inside is 0.8 of a cell from the face."""
    body = block((0.06, 0.06, 0.0125), (0.09, 0.09, 0.075), (10, 10, 20))
    scene = Scene(upper=(0.15, 0.15, 0.15), cells=cells, dt=2e-5, walls=None, clamps=(Box((0.0, 0.0, 0.0), (0.15, 0.15, 0.025)),))
    sim = Simulator(scene, body, device=DEVICE, dtype=kind)
    steps = 2500
    last = sim.rollout(steps, FixedCorotated(3e5, 0.3), every=steps).x[-1]
    first = (body.x[:, 2] > 0.025) & (body.x[:, 2] < 0.029)
    fall = 0.5 * 9.8 * (steps * scene.dt) ** 2
    assert float((last - body.x)[first].norm(dim=1).max()) < 0.02 * fall


class Column:
    """A column between slip walls, fixed below and free above, in its first longitudinal mode."""

    young, poisson, length = 1e5, 0.25, 0.5
    modulus = young * (1 - poisson) / ((1 + poisson) * (1 - 2 * poisson))
    wave_number = math.pi / (2 * length)
    frequency = math.sqrt(modulus / 1000.0) / (4 * length)

    def __init__(self, cells):
        width = 4 / cells
        self.dt = 0.2 / cells / math.sqrt(self.modulus / 1000.0)
        body = block((0.0, 0.0, 0.0), (width, self.length, width), (8, cells, 8))
        v = body.v.clone()
        v[:, 1] = 0.02 * torch.sin(self.wave_number * body.x[:, 1])
        scene = Scene(lower=(0.0, -0.1, 0.0), upper=(width, 0.9, width), cells=cells, dt=self.dt, gravity=NO_GRAVITY, walls=Walls("slip"),
                      colliders=(Plane((0, 0, 0), (0, 1, 0), "slip"),))  # fmt: skip
        self.sim = simulator(scene, body._replace(v=v))

    def run(self, periods, effects=None):
        """The mean displacement [m] at each step."""
        steps = round(periods / self.frequency / self.dt)
        y = self.sim.rollout(steps, NeoHookean(self.young, self.poisson), effects=effects).x[:, :, 1].mean(1)
        return y - y[0]


def test_standing_wave_converges_to_the_p_wave_frequency():
    def frequency(cells):
        column = Column(cells)
        y = column.run(1.2)
        first, second = [n + float(y[n] / (y[n] - y[n + 1])) for n in range(2, len(y) - 1) if y[n] * y[n + 1] < 0][:2]
        return 0.5 / ((second - first) * column.dt)

    errors = [abs(frequency(cells) / Column.frequency - 1) for cells in (10, 20, 40)]
    assert errors[2] < 0.03, errors
    assert errors[2] < 0.6 * errors[0], errors


@pytest.mark.parametrize(("shear", "bulk"), [(30.0, 0.0), (0.0, 40.0)])
def test_viscosity_damps_the_wave_at_the_rate_of_the_closed_form(shear, bulk):
    """A Kelvin-Voigt rod loses exp(-nu k^2 t / 2) in amplitude, nu = (2 eta + zeta) / rho."""
    column = Column(20)
    plain, damped = (column.run(2.0, effects) for effects in (None, Effects(viscosity_shear=shear, viscosity_bulk=bulk)))
    half = len(plain) // 2
    loss = math.log(float(damped[half:].abs().max() / damped[:half].abs().max()))
    own = math.log(float(plain[half:].abs().max() / plain[:half].abs().max()))
    rate = (2 * shear + bulk) / 1000.0 * column.wave_number**2 / 2
    expected = -rate / column.frequency
    assert abs((loss - own) - expected) < 0.05 * abs(expected)


def test_viscosity_leaves_a_fall_alone():
    fall = simulator(Scene(cells=16, dt=5e-4), block((0.35, 0.35, 0.35), (0.65, 0.65, 0.65), (6, 6, 6)))
    a = fall.rollout(100, SOFT, every=100, effects=Effects(viscosity_shear=10.0, viscosity_bulk=5.0))
    b = fall.rollout(100, SOFT, every=100)
    assert torch.allclose(a.x, b.x, atol=1e-10)


def test_state_round_trip_continues_a_rollout():
    body = block((0.35, 0.02, 0.35), (0.65, 0.32, 0.65), (6, 6, 6), velocity=(0.0, -1.0, 0.0))
    sim = simulator(Scene(cells=16, dt=5e-4), body)
    whole = sim.rollout(60, Sigma(1e5, 0.3), VonMises(2e3, 1e5, 0.3), every=30)
    half = ParticleState(*(t[1] for t in whole))
    rest = sim.rollout(30, Sigma(1e5, 0.3), VonMises(2e3, 1e5, 0.3), state=half, every=30)
    for a, b in zip(whole, rest):
        assert same(a[2], b[1])
