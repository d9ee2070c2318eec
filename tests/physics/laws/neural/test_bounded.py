"""The bounded law: signs and growth of the stress for any weights at any stretch, and what it does to bodies far outside of training."""

import itertools
import math

import pytest
import torch

from neuido.models.operator.dynamics_operator import IntrinsicDynamicsOperator
from neuido.physics.laws.neural.bounded import BoundedElastic, bounded_features, bounded_stress
from neuido.physics.laws.neural.bounded_kernels import EXPONENT, RANGE, SPREAD
from neuido.physics.laws.neural.networks import STRESS_SCALE
from neuido.physics.mpm.simulator import Simulator
from neuido.types import Scene, Walls
from tests.physics.bodies import DEVICE, block
from tests.physics.laws.neural.test_networks import law, run

STRETCHES = torch.logspace(-2, 1, 13, dtype=torch.float64)
LATENTS = 1000


def rotations(count, seed=0):
    Q = torch.linalg.qr(torch.randn(count, 3, 3, generator=torch.Generator().manual_seed(seed), dtype=torch.float64))[0]
    return Q * torch.linalg.det(Q)[:, None, None]


def grid():
    """All triples of the stretches without rest, (n, 3); with their F in a common turned frame, (n, 3, 3)."""
    s = torch.tensor(list(itertools.combinations_with_replacement(STRETCHES.tolist(), 3)), dtype=torch.float64)
    s = s[(s.log().abs() > 1e-9).any(1)]
    Q, R = rotations(2)
    return s, Q @ torch.diag_embed(s) @ R, Q


def principal(tau, Q):
    return (Q.T @ tau @ Q).diagonal(dim1=-2, dim2=-1)


def operators():
    """`pretrained` with its latents and 1,000 random ones, and operators with random weights up to ten times as large."""
    shipped = IntrinsicDynamicsOperator.load("pretrained")
    yield shipped, torch.cat([shipped.latents, shipped.random_latents(LATENTS, torch.Generator().manual_seed(3))])
    z = torch.randn(LATENTS, 16, generator=torch.Generator().manual_seed(3))
    for seed, gain in ((0, 1.0), (1, 4.0), (2, 10.0)):
        torch.manual_seed(seed)
        operator = IntrinsicDynamicsOperator("bounded", latent_dim=16, basis_dim=8, hidden_dim=16, head_dim=16)
        with torch.no_grad():
            for parameter in operator.parameters():
                parameter.mul_(gain)
        yield operator, z


def test_every_random_law_has_the_right_signs_on_the_whole_grid():
    s, F, Q = grid()
    strain = s.log()
    short, long = (strain <= 1e-9).all(1), (strain >= -1e-9).all(1)
    assert short.sum() > 100 and long.sum() > 10
    for operator, z in operators():
        with torch.no_grad():
            tau = operator.elastic(z, F.float().expand(len(z), *F.shape)).double()
        assert torch.isfinite(tau).all()
        t = principal(tau, Q)
        scale = t.abs().amax(-1)
        assert ((t * strain).sum(-1) > 0).all()  # the work of the stress in going further the same way
        assert (t[:, short].amax(-1) <= 2e-6 * scale[:, short]).all()
        assert (t[:, long].amin(-1) >= -2e-6 * scale[:, long]).all()
        assert (tau - tau.mT).abs().max() <= 1e-6 * tau.abs().max()


@pytest.mark.parametrize(
    ("name", "random"),
    [("pretrained-bounded", 0), ("pretrained-materials", 0), pytest.param("pretrained-materials", LATENTS, marks=pytest.mark.slow)],
)
def test_every_shipped_law_has_the_right_signs_on_the_whole_grid(name, random):
    """All latents of the file, and random ones beside them."""
    s, F, Q = grid()
    operator = IntrinsicDynamicsOperator.load(name)
    z = operator.latents if not random else operator.random_latents(random, torch.Generator().manual_seed(3))
    assert len(z) == (random or {"pretrained-bounded": 90, "pretrained-materials": 480}[name])
    inverted = F @ torch.diag(torch.tensor([-1.0, 1.0, 1.0], dtype=F.dtype))
    strain = s.log()
    short, long = (strain <= 1e-9).all(1), (strain >= -1e-9).all(1)
    for own in z.split(250):
        with torch.no_grad():
            t = principal(operator.elastic(own, F.float().expand(len(own), *F.shape)).double(), Q)
            tau = operator.elastic(own, inverted.float().expand(len(own), *F.shape)).double()
        scale = t.abs().amax(-1)
        assert torch.isfinite(t).all() and ((t * strain).sum(-1) > 0).all()
        assert (t[:, short].amax(-1) <= 2e-6 * scale[:, short]).all() and (t[:, long].amin(-1) >= -2e-6 * scale[:, long]).all()
        back = torch.linalg.solve(inverted, torch.linalg.solve(inverted, tau).mT).diagonal(dim1=-2, dim2=-1).sum(-1)  # tr(F^-1 tau F^-T)
        assert (back > 0).all()


def test_the_work_of_every_random_law_grows_without_bound():
    """Along each ray of strain the stress does at least the work of the softest modulus, linear in the logarithm of the stretch."""
    way = torch.randn(40, 3, generator=torch.Generator().manual_seed(4), dtype=torch.float64)
    way = way / way.norm(dim=1, keepdim=True)
    size = torch.linspace(0.05, 12.0, 240, dtype=torch.float64)  # of the logarithmic strain
    F = torch.diag_embed((size[:, None, None] * way).exp()).view(-1, 3, 3)
    softest = (1 - SPREAD) * STRESS_SCALE * math.exp(-EXPONENT)
    for seed in range(5):
        power = (run(law(BoundedElastic, scenes=1, seed=seed), F, None).diagonal(dim1=1, dim2=2).view(240, 40, 3) * way).sum(-1)
        assert (power >= softest * size.clamp(max=1.0)[:, None]).all()
        work = torch.cumulative_trapezoid(power, size, dim=0)
        assert (work.diff(dim=0) > 0).all() and (work[-1] > 1.3 * work[119]).all()


def test_every_random_law_turns_inverted_matter_back():
    """Along its shortest, inverted direction matter is pulled together most; nowhere is it pushed apart."""
    s, _, Q = grid()
    s = torch.cat([s, torch.ones(1, 3, dtype=torch.float64)])
    F = Q @ torch.diag_embed(s * torch.tensor([-1.0, 1.0, 1.0])) @ rotations(1, 5)[0]  # the first is the smallest
    assert (torch.linalg.det(F) < 0).all()
    for operator, z in operators():
        with torch.no_grad():
            t = principal(operator.elastic(z, F.float().expand(len(z), *F.shape)).double(), Q)
        assert (t[..., 0] > 0).all()
        assert (t >= -1e-6 * t.amax(-1, keepdim=True)).all()
        assert (t[..., 0] >= (1 - 1e-5) * t.amax(-1)).all()
        away = (t / s.square()).sum(-1)  # -d(det F)/dt along the force: P : cof F = J tr(F^-1 tau F^-T)
        assert (away > 0).all()


def test_kernels_equal_the_twin_and_finite_differences_everywhere():
    """Stretches beyond the features' range, and inverted F."""
    generator = torch.Generator().manual_seed(7)
    stretch = (2.0 * torch.rand(40, 3, generator=generator, dtype=torch.float64) - 1.0).mul(2.0).exp()
    stretch[20:, 0] *= -1
    F = rotations(40, 8) @ torch.diag_embed(stretch) @ rotations(40, 9)
    the_law = law(BoundedElastic, scenes=1, requires_grad=True)
    grad_out = torch.randn(F.shape, generator=generator, dtype=F.dtype)
    leaf = F.clone().requires_grad_(True)
    expected = the_law(leaf)
    wanted = torch.autograd.grad(expected, (leaf, *the_law.tensors()), grad_out)
    torch.testing.assert_close(run(the_law, F, None), expected.detach(), rtol=1e-10, atol=1e-8)
    grad_F, grads = torch.zeros_like(F), [torch.zeros_like(t) for t in the_law.tensors()]
    the_law.adjoint(the_law.tensors(), F, grad_out, grad_F, grads, None)
    for got, want in zip((grad_F, *grads), wanted):
        assert (got - want).norm() <= 1e-9 * want.norm()
    direction = torch.randn(F.shape, generator=generator, dtype=F.dtype)
    step = 1e-5 * F.flatten(1).norm(dim=1)[:, None, None]

    def along(k):
        return (run(the_law, F + k * step * direction, None) * grad_out).sum((1, 2))

    numeric = (8 * (along(1) - along(-1)) - (along(2) - along(-2))) / (12 * step[:, 0, 0])
    scale = grad_F.flatten(1).norm(dim=1) * direction.flatten(1).norm(dim=1)
    assert (((grad_F * direction).sum((1, 2)) - numeric).abs() <= 1e-5 * scale).all()


def test_small_strains_are_hencky_s_and_moduli_are_bounded():
    F = torch.eye(3, dtype=torch.float64) + 0.02 * torch.randn(50, 3, 3, generator=torch.Generator().manual_seed(10), dtype=torch.float64)
    U, s, _ = torch.linalg.svd(F)
    c = torch.tensor([-0.3, 0.4, 0.0, 0.0], dtype=torch.float64).expand(50, 4)
    lam, d = (1e5 * c[0, i].exp() for i in (0, 1))
    tau = (U * (d * s.log() + lam * s.log().sum(1, keepdim=True))[:, None]) @ U.mT
    torch.testing.assert_close(bounded_stress(F, c), tau, rtol=1e-6, atol=1e-3)
    for sign in (-1.0, 1.0):
        far = bounded_stress(F, sign * torch.full((50, 4), 1e3, dtype=torch.float64))
        limit = bounded_stress(F, sign * torch.tensor([EXPONENT, EXPONENT, 1e3, 1e3], dtype=torch.float64).expand(50, 4))
        torch.testing.assert_close(far, limit)


def test_features_do_not_grow_beyond_the_range_of_training():
    size = torch.tensor([0.5, 0.1, 0.01, 1e-3, 3.0, 10.0, 1e3], dtype=torch.float64)
    x = bounded_features(size[:, None, None] * torch.eye(3, dtype=torch.float64))
    torch.testing.assert_close(x[1:4], x[[0]].expand(3, 9), rtol=0, atol=0.01)  # up to q, which is DELTA here and shortened too
    torch.testing.assert_close(x[5:], x[[4]].expand(2, 9), rtol=0, atol=0.01)
    _, F, _ = grid()
    assert float(bounded_features(F).abs().max()) <= 10 * RANGE + 1e-9


def plausible(seed):
    """The elastic law of a shipped material, or a random one whose moduli are within about three of 1e5 Pa, as the steps below need it."""
    if isinstance(seed, tuple):
        operator = IntrinsicDynamicsOperator.load(seed[0]).to(DEVICE)
        return operator.requires_grad_(False).laws(operator.latent(seed[1]))[0]
    *first, W3, b3 = law(BoundedElastic, scenes=1, seed=seed, dtype=torch.float32).tensors()
    return BoundedElastic(*(t.to(DEVICE) for t in (*first, 0.3 * W3, 0.3 * b3)))


SHIPPED = [(weights, material) for weights in ("pretrained", "pretrained-materials") for material in ("jelly", "plasticine", "sand")]


@pytest.mark.slow
@pytest.mark.parametrize("seed", [0, 1, *SHIPPED], ids=str)
def test_a_body_crushed_to_a_tenth_comes_back(seed):
    body = block((0.4, 0.4, 0.4), (0.6, 0.6, 0.6), (8, 8, 8))
    scene = Scene(lower=(-1.0,) * 3, upper=(2.0,) * 3, gravity=(0.0, 0.0, 0.0), cells=48, dt=1e-4, walls=None)
    sim = Simulator(scene, body, device=DEVICE)
    squeeze = torch.diag(torch.tensor([1.0, 0.1, 1.0])).to(sim.state.F)
    state = sim.state._replace(F=squeeze.expand_as(sim.state.F).contiguous(), x=(sim.state.x - 0.5) @ squeeze + 0.5)
    frames = sim.rollout(200, plausible(seed), state=state, every=20)
    assert torch.isfinite(frames.x[-1]).all()
    height = frames.x[..., 1].amax(1) - frames.x[..., 1].amin(1)
    assert float(height.max()) > 5 * float(height[0])
    assert float(torch.linalg.det(frames.F[-1]).median()) > 0.3


GAINS = {("pretrained", "jelly"): 1.5, ("pretrained-materials", "jelly"): 2.0}
"""Most kinetic energy after a fall at 30 m/s, relative to that before it, of laws that gain some."""


@pytest.mark.slow
@pytest.mark.parametrize(
    ("seed", "speed", "gain"),
    [(seed, speed, GAINS.get(seed, 1.02) if speed > 10 else 1.02) for seed in (0, 1, *SHIPPED) for speed in (10.0, 30.0)],
    ids=str,
)
def test_a_body_dropped_at_30_metres_a_second_bounces(seed, speed, gain):
    """The law has no energy: jelly crushed to a millionth of its volume, far beyond training, gains 37 and 85 %; else none is gained."""
    body = block((0.4, 0.2, 0.4), (0.6, 0.4, 0.6), (8, 8, 8), velocity=(0.0, -speed, 0.0))
    scene = Scene(gravity=(0.0, 0.0, 0.0), cells=16, dt=5e-5, walls=Walls("separate"))
    sim = Simulator(scene, body, device=DEVICE)
    frames = sim.rollout(int(1000 * 30.0 / speed), plausible(seed), every=20)
    assert torch.isfinite(frames.x).all()
    kinetic = frames.v.square().sum(-1).mean(-1)
    assert float(kinetic.max()) <= gain * float(kinetic[0])
    assert float(frames.v[..., 1].mean(1).max()) > 1.0
    extent = frames.x[-1].amax(0) - frames.x[-1].amin(0)
    assert float(extent.min()) > 0.1  # half of its first size
