"""Kernels of a whole substep, and transfers that sum by warp, against the kernels of a substep's parts."""

import pytest
import torch

from neuido.errors import UserError
from neuido.physics.effects.parameters import Effects
from neuido.physics.laws.classical import DruckerPrager, FixedCorotated, Fluid, NeoHookean, Sigma, Snow, VolumetricReset, VonMises, stack
from neuido.physics.laws.neural.bounded import BoundedElastic, FullPlastic
from neuido.physics.laws.neural.networks import ObjectiveElastic, ObjectivePlastic
from neuido.physics.mpm import passes
from neuido.physics.mpm.passes import ClassicalPass, NetworkPass, TransferPass, choose
from neuido.physics.mpm.plan import FIXED, STATES, Plan
from neuido.physics.mpm.simulator import Simulator
from neuido.types import Body, Box, ParticleState, Scene, Walls
from tests.physics.bodies import DEVICE

WALLS = {
    "separate": Walls("separate", 0.3),
    "sticky": Walls("separate", float("inf")),
    "slip": Walls("slip"),
}
MOTION, GRADIENT = {torch.float64: 1e-12, torch.float32: 1e-5}, {torch.float64: 1e-10, torch.float32: 1e-3}


def simulator(fusion: str, walls: Walls, dtype: torch.dtype, **options) -> Simulator:
    """Two scenes with boxes that fall onto the floor, one of them clamped at a corner, so that warps are full and not."""
    bodies, scenes = [], []
    for count, height in ((4, 0.19), (5, 0.16)):
        side = torch.linspace(0.3, 0.55, count, dtype=torch.float64)
        x = torch.cartesian_prod(side, side - 0.3 + height, side)
        v = torch.tensor([0.4, -1.5, 0.2], dtype=torch.float64).expand_as(x)
        bodies.append(Body(x, v, torch.full((len(x),), 0.25**3 / len(x), dtype=torch.float64)))
        clamps = (Box((0.5, 0.35, 0.5), (0.6, 0.5, 0.6)),) if count == 5 else ()
        scenes.append(Scene(cells=10 + 2 * count, dt=1e-3, walls=walls, clamps=clamps))
    return Simulator(scenes, bodies, device=DEVICE, dtype=dtype, fusion=fusion, **options)


def run(sim: Simulator, laws, steps: int = 12, every: int = 3, **options) -> tuple[list, list]:
    """Return the frames and all gradients of a rollout from a deformed start."""
    g = torch.Generator().manual_seed(1)
    F = sim.state.F + 0.04 * torch.randn(sim.state.F.shape, generator=g, dtype=torch.float64).to(sim.state.F)
    state = ParticleState(*(t.clone().requires_grad_() for t in (*sim.state[:3], F)))
    mass, gravity = (t.clone().requires_grad_() for t in (sim.mass, sim.gravity))
    elastic, plastic, leaves = laws()
    frames = sim.rollout(steps, elastic, plastic, state=state, mass=mass, gravity=gravity, every=every, **options)
    loss = torch.zeros((), dtype=torch.float64, device=sim.device)
    for t, scale in zip((frames.x, frames.v, frames.C, frames.F), (1.0, 0.1, 1e-3, 0.3)):
        loss = loss + scale * (t * torch.randn(t.shape, generator=g, dtype=torch.float64).to(t)).sum()
    leaves = [*state, mass, gravity, *leaves]
    return [t.detach() for t in (frames.x, frames.v, frames.C, frames.F)], list(torch.autograd.grad(loss, leaves))


def assert_agree(ours, twins, dtype: torch.dtype) -> None:
    for tolerance, own, other in zip((MOTION, GRADIENT), ours, twins):
        for a, b in zip(own, other, strict=True):
            assert b.abs().max() > 0
            assert (a - b).norm() <= tolerance[dtype] * b.norm()


def classical(elastic, plastic):
    def laws():
        young = torch.tensor([4e4, 6e4], dtype=torch.float64, requires_grad=True)
        limit = torch.tensor([900.0, 700.0], dtype=torch.float64, requires_grad=True)
        if plastic is None:
            return elastic(young, 0.3), None, [young]
        if plastic is DruckerPrager:
            return elastic(young, 0.3), DruckerPrager(25.0, young, 0.3), [young]
        return elastic(young, 0.3), VonMises(limit, young, 0.3), [young, limit]

    return laws


@pytest.mark.parametrize("walls", WALLS)
@pytest.mark.parametrize(("elastic", "plastic"), [(FixedCorotated, VonMises), (Sigma, DruckerPrager)])
def test_a_whole_substep_is_that_of_its_parts(elastic, plastic, walls):
    twins = run(simulator("separate", WALLS[walls], torch.float64), classical(elastic, plastic))
    sim = simulator("fused", WALLS[walls], torch.float64)
    assert_agree(run(sim, classical(elastic, plastic)), twins, torch.float64)


@pytest.mark.parametrize("plastic", [None, VonMises])
def test_transfers_by_warp_are_those_by_particle(plastic):
    laws = classical(NeoHookean, plastic)
    twins = run(simulator("separate", WALLS["separate"], torch.float32), laws)
    assert_agree(run(simulator("transfers", WALLS["separate"], torch.float32), laws), twins, torch.float32)


def test_extended_laws_run_between_the_transfers():
    def laws():
        bulk = torch.tensor([4e4, 6e4], dtype=torch.float64, requires_grad=True)
        return Fluid(bulk), VolumetricReset(), [bulk]

    twins = run(simulator("separate", WALLS["separate"], torch.float32), laws)
    assert_agree(run(simulator("fused", WALLS["separate"], torch.float32), laws), twins, torch.float32)


YIELD = {ObjectivePlastic: [3.0, 0.1, 0.0], FullPlastic: [3.0, 0.1, 0.1, 0.5]}


def networks(kind, plastic=ObjectivePlastic, seed: int = 0):
    def laws():
        g = torch.Generator().manual_seed(seed)

        def draw(*shape: int, scale: float = 0.2) -> torch.Tensor:
            return (scale * torch.randn(*shape, generator=g)).to(DEVICE)

        pair, leaves = [], []
        for network, bias in ((kind, [0.5, 1.0, 0.0, 0.0]), (plastic, YIELD[plastic])):
            last = draw(2, len(bias), 32, scale=2e-2).requires_grad_()
            offset = torch.tensor(bias).expand(2, -1).clone().to(DEVICE).requires_grad_()
            pair.append(network(draw(1, 32, 9, scale=0.5), draw(1, 32), draw(1, 32, 32), draw(1, 32), last, offset))
            leaves += [last, offset]
        return *pair, leaves

    return laws


@pytest.mark.slow
@pytest.mark.parametrize(
    ("kind", "plastic"), [(ObjectiveElastic, ObjectivePlastic), (BoundedElastic, ObjectivePlastic), (BoundedElastic, FullPlastic)]
)
@pytest.mark.parametrize("per_warp", [16, 32])
def test_networks_inside_the_kernels_are_those_outside(kind, plastic, per_warp, monkeypatch):
    monkeypatch.setattr(passes, "PER_WARP", per_warp)
    laws = networks(kind, plastic)
    twins = run(simulator("separate", WALLS["separate"], torch.float32), laws, check=False)
    assert_agree(run(simulator("fused", WALLS["separate"], torch.float32), laws, check=False), twins, torch.float32)


def test_segments_and_frames_alone():
    laws = classical(FixedCorotated, VonMises)
    twins = run(simulator("separate", WALLS["slip"], torch.float64), laws)
    sim = simulator("fused", WALLS["slip"], torch.float64)
    assert_agree(run(sim, laws, segment=6), twins, torch.float64)
    with torch.no_grad():
        frames = sim.rollout(12, *laws()[:2], every=3)
        twin = simulator("separate", WALLS["slip"], torch.float64).rollout(12, *laws()[:2], every=3)
    assert (frames.x - twin.x).abs().max() < 1e-13


def test_a_stored_state_alone_takes_the_separate_adjoint():
    laws = classical(FixedCorotated, VonMises)
    twins = run(simulator("separate", WALLS["slip"], torch.float64), laws)
    assert_agree(run(simulator("fused", WALLS["slip"], torch.float64, store="state"), laws), twins, torch.float64)


def test_what_the_kernels_cannot_do_runs_by_parts():
    sim = simulator("fused", WALLS["slip"], torch.float32)

    def chosen(elastic, plastic=None, given: int | None = None):
        plan = Plan(sim.setup, elastic, plastic, 4, 1)
        inputs = [torch.zeros(0) for _ in range(FIXED)]
        inputs[STATES] = sim.mass
        if given is not None:
            inputs[given] = torch.ones(1)
        return choose(plan, [*inputs, *plan.law_tensors()])

    law = FixedCorotated(torch.tensor([1e4, 2e4]), 0.3)
    assert isinstance(chosen(law), ClassicalPass)
    assert isinstance(chosen(stack([law, NeoHookean(1e4, 0.3)])), ClassicalPass)
    assert isinstance(chosen(*networks(ObjectiveElastic)()[:2]), NetworkPass)
    assert isinstance(chosen(law, networks(ObjectiveElastic)()[1]), TransferPass)
    assert isinstance(chosen(stack([law, Fluid(1e4)])), TransferPass)  # laws of the extended kernels
    assert isinstance(chosen(law, Snow(0.02, 0.01)), TransferPass)
    assert chosen(law, given=STATES + 4) is None  # viscosity


def test_effects_run_by_parts():
    laws = classical(FixedCorotated, VonMises)
    effects = Effects(drag_linear=0.4, viscosity_shear=5.0)
    results = [run(simulator(fusion, WALLS["slip"], torch.float64), laws, effects=effects)[0] for fusion in ("fused", "separate")]
    for a, b in zip(*results):
        torch.testing.assert_close(a, b, rtol=1e-10, atol=1e-12)  # a GPU adds in any order


def test_a_wrong_name_is_refused():
    with pytest.raises(UserError, match="fusion is 'whole'"):
        simulator("whole", WALLS["slip"], torch.float64)
