"""The fused networks on a GPU against the laws' own engine, and captured rollouts against eager ones."""

import pytest
import torch

from neuido.physics.laws.base import Engine
from neuido.physics.laws.neural import fused
from neuido.physics.laws.neural.bounded import BoundedElastic, FullPlastic
from neuido.physics.laws.neural.fused import FusedEngine
from neuido.physics.laws.neural.networks import ObjectiveElastic, ObjectivePlastic
from neuido.physics.mpm.simulator import Simulator
from neuido.types import Particles, Scene, Walls
from tests.physics.bodies import block

pytestmark = pytest.mark.gpu

KINDS = {
    ObjectiveElastic: [0.5, 1.0, 0.1, -0.1],
    ObjectivePlastic: [2.0, 0.3, 1.0],
    BoundedElastic: [0.1, 0.3, 0.5, -0.4],
    FullPlastic: [2.0, 0.3, 0.4, 0.6],
}


def network(kind, width, scenes, shared, device="cuda"):
    """Weights of a network about constant coefficients; first layers for `shared` scenes, last ones for `scenes`."""
    g = torch.Generator().manual_seed(0)

    def draw(*shape, scale):
        return (scale * torch.randn(*shape, generator=g)).to(device)

    bias = torch.tensor(KINDS[kind], device=device)
    first = [draw(shared, width, 9, scale=0.5), draw(shared, width, scale=0.5)]
    second = [draw(shared, width, width, scale=0.1), draw(shared, width, scale=0.1)]
    return [*first, *second, draw(scenes, len(bias), width, scale=0.02), bias + draw(scenes, len(bias), scale=0.1)]


@pytest.mark.parametrize("width", [32, 64])
@pytest.mark.parametrize("kind", list(KINDS))
@pytest.mark.parametrize(("scenes", "shared"), [(1, 1), (3, 1), (3, 3)])
@pytest.mark.parametrize("wanted", ["all", "last", "none"])
def test_fused_engine_equals_the_laws_own(width, kind, scenes, shared, wanted, monkeypatch):
    monkeypatch.setattr(fused, "BATCH", 2)  # two of the three substeps together, then one
    weights = network(kind, width, scenes, shared)
    offsets = (0, 700) if scenes == 1 else (0, 201, 450, 700)  # scenes that do not end with a warp
    scene = torch.cat([torch.full((j - i,), s, dtype=torch.int32) for s, (i, j) in enumerate(zip(offsets, offsets[1:]))]).cuda()
    g = torch.Generator().manual_seed(1)
    F = torch.eye(3) + 0.05 * torch.randn(700, 3, 3, generator=g)
    F[0] = torch.eye(3)
    F[1:5] = torch.diag(torch.tensor([0.05, 1.2, 4.0])) @ F[1:5]  # beyond the range of the bounded law's features
    if kind is BoundedElastic:
        F[5:9] = torch.diag(torch.tensor([-0.4, 1.1, 0.9])) @ F[5:9]
    F, grad = F.cuda(), torch.randn(700, 3, 3, generator=g).cuda()
    flags = {"all": [True] * 6, "last": [False] * 4 + [True] * 2, "none": [False] * 6}[wanted]
    law, particles = kind(*weights), Particles(scene, offsets)
    results = []
    for engine in (Engine(law, weights, particles), FusedEngine(law, weights, particles)):
        out, grad_F = torch.full_like(F, torch.nan), torch.ones_like(F)
        engine.forward(F, out)
        engine.start_adjoint(flags)
        for _ in range(3):
            engine.adjoint(F, grad, grad_F)
        results.append([out, grad_F, *engine.gradients()])
    for n, (a, b) in enumerate(zip(*results, strict=True)):
        assert (a is None) == (b is None)
        if a is not None:
            assert float((a - b).norm()) <= 2e-5 * float(a.norm()), f"result {n}: {float((a - b).norm() / a.norm()):.1e}"


@pytest.mark.parametrize(
    ("kind", "plasticity"), [(ObjectiveElastic, ObjectivePlastic), (BoundedElastic, ObjectivePlastic), (BoundedElastic, FullPlastic)]
)
def test_captured_rollout_equals_the_eager_one_and_its_gradient(kind, plasticity):
    body = block((0.3, 0.05, 0.3), (0.7, 0.45, 0.7), (12, 12, 12), velocity=(0.0, -2.0, 0.5))
    scene = Scene(cells=16, dt=5e-4, walls=Walls("separate", 0.3))
    results = []
    for graphs in (False, True):
        sim = Simulator([scene] * 2, [body] * 2, device="cuda", graphs=graphs, store="all" if graphs else "state")
        elastic, plastic = network(kind, 64, 2, 1), network(plasticity, 64, 2, 1)
        leaves = [t.requires_grad_() for t in (*elastic, *plastic)]
        laws = kind(*elastic), plasticity(*plastic)
        if not graphs:
            for law in laws:
                law.engine = lambda tensors, particles, law=law: Engine(law, tensors, particles)
        for _ in range(2):  # the second run replays
            frames = sim.rollout(100, *laws, every=20)
            loss = frames.x[-1].square().sum() + frames.F[-1].square().sum()
            gradients = torch.autograd.grad(loss, leaves)
        results.append((frames.x - frames.x[0], *gradients))
    for n, (a, b) in enumerate(zip(*results, strict=True)):
        assert float((a - b).norm()) <= (1e-5 if n == 0 else 1e-3) * float(a.norm()), f"result {n}: {float((a - b).norm() / a.norm()):.1e}"


def test_an_earlier_captured_rollout_keeps_its_gradient():
    body = block((0.3, 0.3, 0.3), (0.7, 0.7, 0.7), (8, 8, 8), velocity=(0.0, -1.0, 0.0))
    sim = Simulator(Scene(cells=16, dt=5e-4), body, device="cuda")
    laws = ObjectiveElastic(*network(ObjectiveElastic, 32, 1, 1)), ObjectivePlastic(*network(ObjectivePlastic, 32, 1, 1))

    def start(speed):
        v = (sim.state.v * speed).requires_grad_()
        return v, sim.rollout(30, *laws, state=sim.state._replace(v=v), every=30).x[1].square().sum()

    v, loss = start(1.0)
    start(-2.0)
    late = torch.autograd.grad(loss, v)[0]
    v, loss = start(1.0)
    assert torch.allclose(late, torch.autograd.grad(loss, v)[0], rtol=1e-4, atol=1e-7)
