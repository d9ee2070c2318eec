"""The finite elements against closed forms, a slow twin in torch, and what they must share with the material point method."""

import math
from types import SimpleNamespace

import pytest
import torch

from neuido.errors import UserError
from neuido.physics.effects.constitutive import Constitutive
from neuido.physics.effects.parameters import Effects
from neuido.physics.fem import element_loop
from neuido.physics.fem.assembly import Assembly
from neuido.physics.fem.assembly_rollout import AssemblyRollout
from neuido.physics.fem.finite_elements import FiniteElements
from neuido.physics.fem.meshing import mesh_body
from neuido.physics.laws.classical import DruckerPrager, FixedCorotated, Hyperfoam, Identity, NeoHookean, Snow, VonMises, lame
from neuido.physics.mpm import reference
from neuido.physics.mpm.simulator import Simulator
from neuido.types import AttachedMass, Body, Box, ParticleState, Plane, Scene
from tests.physics.bodies import block

FREE = Scene(gravity=(0.0, 0.0, 0.0), walls=None, dt=1e-3)


def solver(scene, body, **options):
    return FiniteElements(scene, body, **{"density": 1000.0, "dtype": torch.float64} | options, device="cpu")


def joined(sim, count, graphs=False):
    """The scenes of a solver on the CPU in one set of arrays, as on a GPU."""
    return AssemblyRollout(Assembly(sim.arrays, [a.meshes[0] for a in sim.assemblies], 0, count), graphs)


def momenta(sim, out):
    """Linear and angular momentum of the nodes at the end."""
    assembly = sim.assemblies[0]
    _, x, v, _, _ = assembly.last
    m = assembly.node_mass(sim.mass)[:, None]
    return (m * v).sum(dim=0), (m * torch.linalg.cross(x, v)).sum(dim=0)


def test_free_fall_is_exact_and_a_spin_goes_on():
    scene = Scene(gravity=(0.0, -9.8, 0.5), walls=None, dt=1e-3)
    body = block((0.3, 0.6, 0.3), (0.6, 0.8, 0.7), (6, 4, 8), (1.0, 0.5, 0.0), (4.0, -6.0, 5.0))
    sim = solver(scene, body, elements=400)
    out = sim.rollout(100, FixedCorotated(1e5, 0.3), every=50, inner=1)
    assembly = sim.assemblies[0]
    m = assembly.node_mass(sim.mass)[:, None]
    centre = (m * assembly.nodes).sum(dim=0) / m.sum()
    moved = (m * assembly.last[1]).sum(dim=0) / m.sum() - centre
    g = torch.tensor(scene.gravity, dtype=torch.float64)
    assert torch.allclose(moved, torch.tensor([1.0, 0.5, 0.0], dtype=torch.float64) * 0.1 + g * 1e-6 * 100 * 101 / 2, atol=1e-10)
    assert torch.allclose(out.x[0], body.x, atol=1e-10)
    assert torch.allclose(out.v[0], body.v, atol=1e-6)

    free = solver(FREE, body, elements=400)
    linear, angular = [], []
    for _ in range(2):
        state = free.state if not linear else ParticleState(*(t[-1] for t in out))
        out = free.rollout(150, FixedCorotated(1e5, 0.3), state=state, every=150)
        p, L = momenta(free, out)
        linear.append(p), angular.append(L)  # fmt: skip
    assert torch.allclose(linear[0], linear[1], atol=1e-9)
    assert torch.allclose(angular[0], angular[1], atol=1e-8)
    assert float(angular[0].norm()) > 0.1


def energy(sim, mu: float, lam: float, smoothing: bool = False) -> float:
    """Kinetic energy plus fixed corotated strain energy of the last state [J]."""
    assembly = sim.assemblies[0]
    _, x, v, _, F = assembly.last
    if smoothing:
        V = assembly.volume
        J = torch.linalg.det(F)
        index = assembly.elements.long().reshape(-1)
        nodal = torch.zeros(len(x), dtype=x.dtype).index_add_(0, index, (V * J).repeat_interleave(4))
        nodal = nodal / torch.zeros_like(nodal).index_add_(0, index, V.repeat_interleave(4))
        F = (nodal[assembly.elements.long()].mean(dim=1) / J).pow(1 / 3)[:, None, None] * F
    sigma = torch.linalg.svdvals(F)
    strain = mu * (sigma - 1).square().sum(dim=1) + 0.5 * lam * (sigma.prod(dim=1) - 1).square()
    return float(0.5 * (assembly.node_mass(sim.mass)[:, None] * v.square()).sum() + (assembly.volume * strain).sum())


@pytest.mark.parametrize("smoothing", ["none", "nodal"])
def test_vibration_keeps_its_energy(smoothing):
    body = block((0.3, 0.3, 0.3), (0.6, 0.5, 0.5), (6, 4, 4))
    x = body.x - body.x.mean(dim=0)
    body = body._replace(v=torch.stack([3.0 * x[:, 0] + 4.0 * x[:, 1], -2.0 * x[:, 1], 5.0 * x[:, 0] * x[:, 2] / 0.1], dim=1))
    sim = solver(FREE, body, elements=480, smoothing=smoothing)
    law, (mu, lam) = FixedCorotated(5e4, 0.3), (float(t) for t in lame(torch.tensor(5e4), torch.tensor(0.3)))
    sim.rollout(1, law, inner=20)
    start = energy(sim, mu, lam, smoothing == "nodal")
    seen = []
    state = None
    for _ in range(10):
        out = sim.rollout(40, law, state=state, every=40, inner=4)
        state = ParticleState(*(t[-1] for t in out))
        seen.append(energy(sim, mu, lam, smoothing == "nodal"))
    assert start > 0.05
    assert max(abs(e / start - 1) for e in seen) < 0.01, [e / start for e in seen]


def test_a_bar_rings_at_the_frequency_of_its_waves():
    length, young = 1.0, 1e6
    body = block((0.0, 0.0, 0.0), (length, 0.1, 0.1), (40, 4, 4))
    body = body._replace(v=torch.stack([0.1 * torch.cos(math.pi * body.x[:, 0] / length), *2 * [torch.zeros(len(body.x)).double()]], dim=1))
    sim = solver(FREE, body, elements=5 * 640)
    period = 2 * length / math.sqrt(young / 1000.0)
    out = sim.rollout(90, NeoHookean(young, 0.0), every=1)
    amplitude = (out.v[:, :, 0] * torch.cos(math.pi * body.x[:, 0] / length)).mean(dim=1)
    crossings = [n + float(amplitude[n] / (amplitude[n] - amplitude[n + 1])) for n in range(90) if amplitude[n] * amplitude[n + 1] < 0]
    assert (crossings[1] - crossings[0]) * 2e-3 == pytest.approx(period, rel=0.01)


def sag(elements: int, smoothing: str = "none", poisson: float = 0.0) -> float:
    """Sag of a clamped beam's end under its own weight over Timoshenko's, without the contraction at the clamp."""
    length, height, young, g = 0.32, 0.08, 2e5, 0.2
    body = block((0.0, 0.0, 0.0), (length, height, height), (32, 8, 8))
    scene = Scene(lower=(-1, -1, -1), gravity=(0.0, -g, 0.0), walls=None, dt=4e-3, clamps=(Box((-1, -1, -1), (6e-3, 1, 1)),))
    sim = solver(scene, body, elements=elements, smoothing=smoothing)
    out = sim.rollout(300, FixedCorotated(young, poisson), effects=Effects(drag_linear=10.0), every=300)
    end, a = body.x[:, 0] > length - 0.011, length - 0.005
    line = 1000.0 * height**2 * g
    bending = line * (a**4 - 4 * a**3 * length + 6 * a**2 * length**2) / 24 / (young * height**4 / 12)
    shear = line * (length * a - a * a / 2) / ((5 / 6) * young / (2 * (1 + poisson)) * height**2)
    return float((body.x - out.x[-1])[end, 1].mean()) / (bending + shear)


def test_a_clamped_beam_sags_as_timoshenko_says():
    two, four = sag(160), sag(1280)  # cells over the height
    # linear tetrahedra are too stiff in bending; the lack goes down by nearly the square of their size
    assert 0.85 < four < 1.0
    assert (1 - two) > 2.5 * (1 - four)


@pytest.mark.slow
def test_nodal_smoothing_takes_the_locking_off():
    free, locked, smoothed = sag(160), sag(160, poisson=0.49), sag(160, "nodal", poisson=0.49)
    assert locked < 0.8 * free
    assert smoothed > locked + 0.6 * (free - locked)


def bounce(make, **options) -> float:
    """Speed of a flat cuboid's centre after a floor over that before it."""
    scene = Scene(gravity=(0.0, 0.0, 0.0), cells=36, dt=5e-4, walls=None, colliders=(Plane((0.0, 0.1, 0.0), (0.0, 1.0, 0.0)),))
    body = block((0.3, 0.12, 0.3), (0.6, 0.345, 0.56), (20, 15, 17), (0.0, -2.0, 0.0))
    sim = make(scene, body, density=950.0, **options)
    out = sim.rollout(260, FixedCorotated(1.3e5, 0.3), every=260)
    return float(out.v[-1, :, 1].mean()) / 2.0


@pytest.mark.slow
def test_a_cuboid_rebounds_as_finite_elements_do():
    """Ours and another finite-element code: 0.68 to 0.69; the material point method 0.85 to 0.87: part of the energy is vibration."""
    assert bounce(FiniteElements) < 0.8 < bounce(Simulator)


def slow_twin(sim, steps, law, plastic, effects, dt):
    """One scene in plain torch, elements as scenes of their own: no contact but the planes' normals, no friction."""
    a = sim.assemblies[0]
    elements, count = a.elements.long(), len(a.elements)
    model = Constitutive(law, plastic, effects, count=count)
    x, v, C, F = (t.clone() for t in a.start(sim.state))
    history, mass = model.start(), a.node_mass(sim.mass)[:, None]
    plane = sim.colliders.plane[0]
    loss = effects.spin_loss(torch.tensor([dt], dtype=torch.float64))
    for n in range(steps):
        corner = x[elements]
        G = torch.linalg.inv((corner[:, 1:] - corner[:, :1]).mT)
        tau = model.stress(F, C, history, n * dt)
        H = -a.volume[:, None, None] * tau @ G.mT
        force = torch.zeros_like(x)
        force.index_add_(0, elements[:, 0], -H.sum(dim=2))
        for c in range(3):
            force.index_add_(0, elements[:, c + 1], H[:, :, c])
        v = v if loss is None else reference.damp_spin(x, v, None, mass[:, 0], 0.0, loss)[0]
        v = v + dt * (force / mass + sim.gravity[0])
        for p in plane:
            gap = x @ p[:3] - p[3]
            least = -gap.clamp(min=0.0) / dt
            vn = v @ p[:3]
            v = v + torch.where((gap + dt * vn <= 0) & (vn < least), least - vn, 0.0)[:, None] * p[:3]
        x = x + dt * v
        vc = v[elements]
        C = (vc[:, 1:] - vc[:, :1]).mT @ G
        F, history = model.advance(F + dt * C @ F, C, history, dt, n * dt)
    return x, v, F


CASES = {
    "elastic": ((FixedCorotated(4e4, 0.3), None), {}),
    "mises": ((FixedCorotated(4e4, 0.3), VonMises(1.5e3, 4e4, 0.3)), {}),
    "sand": ((NeoHookean(4e4, 0.3), DruckerPrager(30.0, 4e4, 0.3)), {"cohesion": 200.0}),
    "viscous": ((NeoHookean(4e4, 0.3), Identity()), {"viscosity_shear": 5.0, "viscosity_bulk": 3.0, "stiffness_change": -0.7}),
    "branches": ((FixedCorotated(4e4, 0.3), None), {"maxwell_ratio": 0.5, "maxwell_time": 0.01, "hysteresis": 0.1, "fibre": 1e4,
                 "fibre_direction": (1.0, 2.0, 0.5), "strain_stiffening": 0.5, "tension_compression": 0.3}),
    "yielding": ((FixedCorotated(4e4, 0.3), None), {"yield_inverse": 1 / 1.5e3, "hardening": 2e3,
                 "kinematic_hardening": 5e3, "rate_yield": 20.0}),
    "damage": ((FixedCorotated(4e4, 0.3), None), {"softening": 0.5, "second_invariant": 0.2}),
    "foam": ((Hyperfoam(1.5e4, 4.0, 0.2), None), {}),
    "thinning": ((FixedCorotated(4e4, 0.3), VonMises(1.5e3, 4e4, 0.3)), {"rate_yield": 20.0, "yield_index": 0.6}),
    "snow": ((FixedCorotated(4e4, 0.3), Snow(0.02, 0.01)), {"compaction_hardening": 5.0}),
    "drying": ((FixedCorotated(4e4, 0.3), VonMises(1.5e3, 4e4, 0.3)), {"swelling": -3.0, "spin_decay": 20.0}),
}  # fmt: skip


@pytest.mark.parametrize("name", CASES)
def test_motion_equals_its_slow_twin(name):
    (law, plastic), given = CASES[name]
    scene = Scene(dt=5e-4, walls=None, colliders=(Plane((0.0, 0.1, 0.0), (0.1, 1.0, 0.0)),))
    body = block((0.3, 0.1, 0.3), (0.5, 0.3, 0.5), (4, 4, 4), (0.4, -3.0, 0.0), (3.0, 0.0, 2.0))
    sim = solver(scene, body, elements=320)
    sim.rollout(60, law, plastic, effects=Effects(**given), inner=1, every=60)
    _, x, v, _, F = sim.assemblies[0].last
    expected = slow_twin(sim_start(sim), 60, law, plastic, Effects(**given), 5e-4)
    assert float((torch.linalg.svdvals(F) - 1).abs().max()) > 0.02  # the motion has strains to speak of
    for got, want in zip((x, v, F), expected):
        assert torch.allclose(got, want, rtol=0, atol=1e-9 * float(want.abs().max())), name


def sim_start(sim):
    """The solver as if it had not run yet."""
    sim.assemblies[0].last = None
    return sim


def test_parameter_sets_in_one_call_equal_single_ones():
    scene = Scene(dt=1e-3, walls=None, colliders=(Plane((0.0, 0.1, 0.0), (0.0, 1.0, 0.0), friction=0.2),))
    body = block((0.3, 0.11, 0.3), (0.5, 0.3, 0.5), (4, 4, 4), (0.5, -2.0, 0.0))
    young = torch.tensor([4e4, 8e4, 6e4], dtype=torch.float64)
    drag, mu = torch.tensor([0.0, 1.0, 2.0]), torch.tensor([0.0, 0.3, 0.1])
    stiffness = torch.linspace(0.5, 1.5, len(body.x), dtype=torch.float64)
    sim = solver([scene] * 3, [body] * 3)
    assert len({id(m) for m in sim.meshes}) == 1
    effects = Effects(drag_linear=drag, friction=mu, viscosity_shear=mu, stiffness=stiffness.repeat(3), maxwell_ratio=mu, maxwell_time=0.01)
    out = sim.rollout(50, FixedCorotated(young, 0.3), effects=effects, every=25)
    for s in range(3):
        one = Effects(
            drag_linear=drag[s], friction=mu[s], viscosity_shear=mu[s], stiffness=stiffness, maxwell_ratio=mu[s], maxwell_time=0.01
        )
        alone = solver(scene, body).rollout(50, FixedCorotated(young[s : s + 1], 0.3), effects=one, every=25)
        own = slice(s * len(body.x), (s + 1) * len(body.x))
        for a, b in zip(out, alone):
            assert torch.equal(a[:, own], b)
    # on a GPU the scenes share their launches: the same arrays, here on the CPU
    sim.runs, sim.pool = [joined(sim, 3)], None
    together = sim.rollout(50, FixedCorotated(young, 0.3), effects=effects, every=25)
    for a, b in zip(out, together):
        assert torch.allclose(a, b, rtol=0, atol=1e-9 * float(a.abs().max()))


REPLAYED = {
    "elastic": ((FixedCorotated, None), {}),
    "pulled": ((FixedCorotated, None), {"time_force": ((3.0, 0.0, 0.0), (-4.0, 1.0, 0.0)), "stiffness_change": 5.0}),
    "yielding": ((FixedCorotated, Identity()), {"yield_inverse": 1 / 1.5e3, "hardening": 2e3, "kinematic_hardening": 5e3}),
    "branches": ((NeoHookean, VonMises(3e3, 4e4, 0.3)), {"maxwell_ratio": 0.5, "maxwell_time": 0.01, "viscosity_shear": 5.0}
                 | {"swelling": 2.0, "spin_decay": 10.0}),
}  # fmt: skip


def replayed(name: str, device: str, graphs: bool, every: int, dtype: torch.dtype) -> list[ParticleState]:
    """Two rollouts of two scenes by one solver, the second with another stiffness, time force and start."""
    (law, plastic), given = REPLAYED[name]
    scene = Scene(dt=5e-4, walls=None, colliders=(Plane((0.0, 0.1, 0.0), (0.1, 1.0, 0.0)),))
    body = block((0.3, 0.1, 0.3), (0.5, 0.3, 0.5), (4, 4, 4), (0.4, -3.0, 0.0), (3.0, 0.0, 2.0))
    sim = FiniteElements([scene] * 2, [body] * 2, density=1000.0, device=device, dtype=dtype, elements=320, graphs=graphs)
    if device == "cpu":  # as on a GPU, where the scenes share their launches
        sim.runs, sim.pool = [joined(sim, 2, graphs)], None
    out = []
    for factor in (1.0, 1.4):
        effects = dict(given)
        if "time_force" in effects:
            effects |= {"time_force": factor * torch.tensor(effects["time_force"]), "time_force_interval": 0.03}
        state = sim.state._replace(v=factor * sim.state.v)
        young = factor * torch.tensor([4e4, 5e4], dtype=torch.float64)
        out.append(sim.rollout(60, law(young, 0.3), plastic, state=state, effects=Effects(**effects), inner=1, every=every))
    return out


@pytest.mark.parametrize("name", REPLAYED)
@pytest.mark.parametrize("every", [10, 15])
def test_a_kept_loop_is_a_fresh_one(name, every, monkeypatch):
    """What a graph replays finds all that it reads in the loop's own memory; the graph is a stand-in, which launches anew."""
    monkeypatch.setattr(element_loop, "capture", lambda launches: (SimpleNamespace(replay=launches), None))
    kept = replayed(name, "cpu", True, every, torch.float64)
    for a, b in zip(kept, replayed(name, "cpu", False, every, torch.float64)):
        for got, want in zip(a, b):
            assert torch.equal(got, want)
    assert float((kept[0].x - kept[1].x).abs().max()) > 1e-3


@pytest.mark.gpu
@pytest.mark.parametrize("name", REPLAYED)
@pytest.mark.parametrize("every", [10, 15])
def test_a_graph_is_the_eager_loop(name, every):
    """Nodes gather their forces, so that no sum depends on an order: the graph's motion is the eager one's, bit for bit."""
    graph = replayed(name, "cuda", True, every, torch.float32)
    for a, b in zip(graph, replayed(name, "cuda", False, every, torch.float32)):
        for got, want in zip(a, b):
            assert torch.equal(got, want)


def test_a_motion_in_pieces_is_the_whole_motion():
    scene = Scene(dt=1e-3, walls=None, colliders=(Plane((0.0, 0.1, 0.0), (0.0, 1.0, 0.0)),))
    body = block((0.3, 0.11, 0.3), (0.5, 0.3, 0.5), (5, 4, 3), (0.5, -2.0, 0.0), (1.0, 2.0, 3.0))
    law = (FixedCorotated(5e4, 0.3), VonMises(2e3, 5e4, 0.3))
    whole = solver(scene, body).rollout(60, *law, every=20)
    sim, state = solver(scene, body), None
    for n in range(3):
        out = sim.rollout(20, *law, state=state, every=20)
        state = ParticleState(*(t[-1] for t in out))
        for a, b in zip(state, whole):
            assert torch.allclose(a, b[n + 1], rtol=0, atol=1e-9 * float(b.abs().max()))
    again = sim.rollout(60, *law, every=20)
    assert torch.equal(again.x, whole.x)  # and a start is a start


def test_a_deformed_start_springs_back():
    """F of the start is elastic strain: a body that is stretched by it, at rest, contracts."""
    body = block((0.3, 0.3, 0.3), (0.6, 0.5, 0.5), (6, 4, 4))
    F = torch.diag(torch.tensor([1.1, 1.0, 1.0], dtype=torch.float64)).expand(len(body.x), 3, 3)
    out = solver(FREE, body._replace(F=F)).rollout(10, NeoHookean(1e5, 0.0))
    assert torch.allclose(out.F[0], F)
    length = out.x[:, :, 0].amax(dim=1) - out.x[:, :, 0].amin(dim=1)
    assert bool((length.diff() < 0).all())


def test_contact_stops_at_the_plane_and_rubs():
    n = torch.tensor([0.0, 1.0, 0.0], dtype=torch.float64)
    body = block((0.1, 0.105, 0.3), (0.3, 0.205, 0.5), (6, 3, 6), (1.0, -0.5, 0.0))
    distance = {}
    for contact, mu in (("separate", 0.0), ("separate", 0.2), ("sticky", 0.0), ("slip", 0.0)):
        scene = Scene(dt=1e-3, walls=None, colliders=(Plane((0.0, 0.1, 0.0), (0.0, 1.0, 0.0), contact, mu),))
        sim = solver(scene, body)
        out = sim.rollout(200, FixedCorotated(2e5, 0.3), effects=Effects(viscosity_shear=20.0), every=200)
        assert float((sim.assemblies[0].last[1] @ n).min()) > 0.1 - 1e-9
        distance[contact, mu] = float(out.v[-1, :, 0].mean())
        if contact == "sticky":
            _, x, v, _, _ = sim.assemblies[0].last
            base = x @ n < 0.1 + 1e-5
            assert int(base.sum()) > 10
            assert float(v[base].abs().max()) == 0.0
    assert distance["separate", 0.0] == pytest.approx(1.0, abs=3e-3)
    # by the impulse: friction takes mu times all that the floor gives, the fall's 0.5 m/s and the weight
    assert distance["separate", 0.2] == pytest.approx(1.0 - 0.2 * (0.5 + 9.8 * 0.2), abs=0.02)
    assert distance["slip", 0.0] == pytest.approx(1.0, abs=3e-3)


def test_clamps_hold_and_masses_are_kept():
    scene = Scene(dt=1e-3, walls=None, clamps=(Box((0.0, 0.0, 0.0), (0.12, 1.0, 1.0)),),
                  attached_masses=(AttachedMass(Box((0.4, 0.0, 0.0), (0.6, 1.0, 1.0)), 0.5),))  # fmt: skip
    body = block((0.1, 0.3, 0.3), (0.5, 0.4, 0.4), (16, 4, 4))
    sim = solver(scene, body)
    assembly = sim.assemblies[0]
    mass = assembly.node_mass(sim.mass)
    assert float(mass.sum()) == pytest.approx(float(sim.mass.sum())) == pytest.approx(4.5)
    assert float((mass * assembly.nodes[:, 0]).sum()) == pytest.approx(float((sim.mass * body.x[:, 0]).sum()), rel=0.02)
    out = sim.rollout(50, FixedCorotated(1e5, 0.3), every=50)
    held = assembly.held.bool()
    assert 0 < int(held.sum()) < len(held)
    assert torch.equal(assembly.last[1][held], assembly.nodes[held])
    end = body.x[:, 0] > 0.45
    assert float((out.x[-1] - body.x)[end, 1].mean()) < -1e-3


def test_steps_are_cut_as_the_stiffness_asks():
    body = block((0.3, 0.3, 0.3), (0.6, 0.5, 0.5), (6, 4, 4), (0.0, 0.0, 1.0))
    sim = solver(FREE, body)
    soft, stiff = sim.inner_steps(FixedCorotated(1e4, 0.3))[0], sim.inner_steps(FixedCorotated(1e8, 0.3))[0]
    assert soft == 1
    assert 10 < stiff < 30
    sim.rollout(3, FixedCorotated(1e8, 0.3))
    with pytest.raises(UserError, match="inner steps"):
        sim.rollout(3, FixedCorotated(1e13, 0.3))
    viscous = sim.inner_steps(FixedCorotated(1e4, 0.3), torch.tensor([[2000.0, 0.0]]))[0]
    assert viscous > 3
    with pytest.raises(UserError, match=r"needs \d+ inner steps of its smallest element, more than max_inner_steps = 3;"):
        solver(FREE, body, max_inner_steps=3).rollout(3, FixedCorotated(1e4, 0.3), effects=Effects(viscosity_shear=2000.0))
    body = body._replace(v=body.v + 2.0 * (body.x - body.x.mean(dim=0)))
    with pytest.raises(UserError, match="not finite from step 0 of 60"):
        solver(FREE, body).rollout(60, FixedCorotated(1e8, 0.3), every=10, inner=1)
    out = solver(FREE, body).rollout(100, FixedCorotated(1e4, 0.3), effects=Effects(viscosity_shear=2000.0), every=50)
    assert float((out.x[-1] - out.x[0]).norm(dim=1).max()) < 0.2


@pytest.mark.parametrize("effects", [Effects(), Effects(viscosity_shear=400.0), Effects(fibre=3e6, fibre_direction=(1.0, 0.0, 0.0))])
def test_the_margin_is_where_a_rollout_refuses(effects):
    """Of two bodies, the stiffer one's; and it is no whole number, so that it has a slope."""
    body = block((0.3, 0.3, 0.3), (0.6, 0.5, 0.5), (6, 4, 4))
    law = FixedCorotated(torch.tensor([1e5, 1e8]), torch.full((2,), 0.3))

    def bodies(most):
        return FiniteElements([FREE] * 2, [body] * 2, max_inner_steps=most, device="cpu")

    margin = bodies(1000).step_margin(5, law, effects=effects)
    needed = math.ceil(1000 / margin)
    assert 1000 / margin > needed - 1 and needed > 5
    bodies(needed).rollout(5, law, effects=effects)
    assert bodies(needed).step_margin(5, law, effects=effects) >= 1.0 > bodies(needed - 1).step_margin(5, law, effects=effects)
    with pytest.raises(UserError, match=f"scene 1 needs {needed} inner steps"):
        bodies(needed - 1).rollout(5, law, effects=effects)
    out = bodies(needed - 1).rollout(5, law, effects=effects, nan_on_failure=True)
    refused = out.x[-1].isnan().any(dim=1).reshape(2, -1)
    assert not refused[0].any() and refused[1].all()


def test_wrong_options_are_named():
    body = block((0.3, 0.3, 0.3), (0.6, 0.5, 0.5), (4, 4, 4))
    with pytest.raises(UserError, match="smoothing is 'all'"):
        FiniteElements(FREE, body, smoothing="all", device="cpu")
    mesh = mesh_body(body.x, body.volume)
    with pytest.raises(UserError, match="1 meshes for 2 bodies"):
        FiniteElements([FREE] * 2, [body] * 2, meshes=[mesh], device="cpu")
    with pytest.raises(UserError, match="multiple of every"):
        solver(FREE, body).rollout(5, FixedCorotated(1e4, 0.3), every=2)
    with pytest.raises(UserError, match="friction has shape"):
        solver(FREE, body).rollout(4, FixedCorotated(1e4, 0.3), friction=torch.zeros(3, 3))
    given = FiniteElements([FREE] * 2, [body, Body(body.x, body.v, body.volume)], meshes=mesh, device="cpu")
    assert given.meshes[1] is mesh


def test_scenes_that_fail_are_nan_and_the_others_as_alone():
    """One needs too many inner steps, one leaves the finite: the others are what they are without them, in arrays of their own or not."""
    scene = Scene(dt=1e-3, walls=None, gravity=(0.0, 0.0, 0.0))
    body = block((0.4, 0.4, 0.4), (0.6, 0.6, 0.6), (4, 4, 4), (0.5, 0.0, 0.0), (0.0, 0.0, 3.0))
    young = torch.tensor([4e4, 1e13, 4e5, 8e4], dtype=torch.float64)
    sim = solver([scene] * 4, [body] * 4)
    start = ParticleState(*(t.clone() for t in sim.state))
    start.v[sim.particles.offsets[2] : sim.particles.offsets[3]] *= 1e4
    for runs in (sim.runs, [joined(sim, 4)]):
        sim.runs, sim.pool = runs, None
        out = sim.rollout(20, FixedCorotated(young, 0.3), state=start, every=10, nan_on_failure=True)
        for s in range(4):
            own = slice(sim.particles.offsets[s], sim.particles.offsets[s + 1])
            if s in (1, 2):
                assert all(bool(torch.isnan(t[:, own]).all()) for t in out)
                continue
            alone = solver(scene, body).rollout(20, FixedCorotated(young[s : s + 1], 0.3), every=10)
            assert float((out.x[:, own] - alone.x).abs().max()) < 1e-4, "more inner steps than alone"
    with pytest.raises(UserError, match="dt of scene 1 needs"):
        sim.rollout(20, FixedCorotated(young, 0.3), state=start, every=10)


def test_elements_turned_inside_out_move_alike_whatever_might_flow():
    """A soft body is crushed through itself; a yield stress that is not there changes nothing, in single precision neither."""
    scene = Scene(dt=1e-3, walls=None, gravity=(0.0, 0.0, 0.0), colliders=(Plane((0.0, 0.1, 0.0), (0.0, 1.0, 0.0)),))
    body = block((0.3, 0.1, 0.3), (0.5, 0.3, 0.5), (4, 4, 4), (0.0, -6.0, 0.0), (0.0, 0.0, 0.0))
    moved = []
    for effects in (None, Effects(yield_inverse=0.0)):
        sim = solver(scene, body, dtype=torch.float32)
        moved.append(sim.rollout(60, FixedCorotated(3e3, 0.3), effects=effects, every=4))
    assert float(torch.linalg.det(moved[0].F).min()) < -0.05
    for a, b in zip(*moved, strict=True):
        torch.testing.assert_close(a, b, atol=1e-5 * float(a.abs().max()), rtol=0.0)
