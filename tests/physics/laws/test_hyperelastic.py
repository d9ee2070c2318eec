"""The laws of rubber, foam, fluid and snow: kernels against twins and finite differences, energies, moduli, closed forms."""

import functools
from collections.abc import Callable

import pytest
import torch
from torch import Tensor

from neuido.errors import UserError
from neuido.physics.laws import classical as laws
from neuido.physics.laws.classical import FixedCorotated, Fluid, Gent, Hyperfoam, MooneyRivlin, Snow, VolumetricReset, VonMises, stack
from neuido.physics.linalg.warp_functions import FLOOR
from neuido.types import Particles
from tests.physics.laws.test_classical import (
    CASES,
    EYE,
    assert_relative,
    engine,
    engine_adjoint,
    finite_difference,
    generic,
    rotations,
    weights,
    with_stretches,
)

C10, C01, SHEAR, BULK, LIMIT = 1.2e4, 4e3, 3e4, 1e5, 0.9
EXPONENT, POISSON = 3.0, 0.2
COMPRESSION, STRETCH = 0.06, 0.03
ELASTIC = {
    "mooney_rivlin": (MooneyRivlin, {"c10": C10, "c01": C01, "bulk": BULK}),
    "gent": (Gent, {"shear": SHEAR, "limit": LIMIT, "bulk": BULK}),
    "hyperfoam": (Hyperfoam, {"shear": SHEAR, "exponent": EXPONENT, "poisson": POISSON}),
    "fluid": (Fluid, {"bulk": BULK}),
}
PLASTIC = {
    "volumetric_reset": (VolumetricReset, {}),
    "snow": (Snow, {"compression": COMPRESSION, "stretch": STRETCH}),
}


def law_of(name: str) -> laws.ElasticLaw | laws.PlasticLaw:
    kind, values = (ELASTIC | PLASTIC)[name]
    return kind(**values)


def _edges() -> Tensor:
    """Return stretches on both sides of each bound of snow, and repeated ones."""
    low, high = 1 - COMPRESSION, 1 + STRETCH
    rows = [[high + 1e-3, 1.0, low - 1e-3], [high - 1e-3, 1.0, low + 1e-3], [high + 1e-3, high - 1e-3, 1.0], [1.0, low + 1e-3, low - 1e-3]]
    return with_stretches([*rows, [1.2, 1.2, 1.2], [1.2, 1.2, 0.7], [0.7, 0.7, 0.7], [1.01, 1.01, 0.99], [1.2, 0.8, -0.4]])


SNOW_CASES = {"edges": _edges(), "generic": generic(20), "slight": generic(20, 0.04)}
# J above its floor: below it, where the adjoint with respect to J is zero, only the stress of rubber and fluid is left
COMPRESSIBLE = {name: F for name, F in CASES.items() if name != "inverted"}


@pytest.mark.parametrize("case", CASES)
@pytest.mark.parametrize("name", ELASTIC)
def test_stress_adjoint(name, case):
    law, F = law_of(name), CASES[case]
    expected = finite_difference(functools.partial(engine, law), F, weights(F))
    error = (engine_adjoint(law, F, weights(F))[0] - expected).flatten(1).norm(dim=1)
    assert (error <= 1e-6 * expected.flatten(1).norm(dim=1) + 1e-4 * (name == "fluid")).all()  # an inverted fluid has a constant stress


@pytest.mark.parametrize("case", SNOW_CASES)
@pytest.mark.parametrize("name", PLASTIC)
def test_correction_adjoint(name, case):
    law, F = law_of(name), SNOW_CASES[case]
    F = F[torch.linalg.det(F) > 0] if name == "volumetric_reset" else F
    expected = finite_difference(functools.partial(engine, law), F, weights(F), 2e-6)  # the bounds of snow are 1e-3 away
    assert_relative(engine_adjoint(law, F, weights(F))[0], expected, 1e-6)


@pytest.mark.parametrize("dtype", [torch.float64, torch.float32])
@pytest.mark.parametrize("name", [*ELASTIC, *PLASTIC])
def test_kernel_equals_twin(name, dtype):
    """Values and gradients; in float32 the kernel against the twin in float64."""
    law, exact = law_of(name), dtype == torch.float64
    F = torch.cat(list((CASES if name in ELASTIC else SNOW_CASES).values())).to(dtype)
    at = F.double().requires_grad_()
    expected = law(at)
    strained = torch.linalg.svdvals(F.double()).sub(1).abs().amax(1) > 1e-6
    assert_relative(engine(law, F).double()[strained], expected.detach()[strained], 1e-10 if exact else 2e-4)
    grad = torch.autograd.grad(expected, at, weights(F).double())[0]
    got = engine_adjoint(law, F, weights(F))[0].double()
    error = (got - grad).flatten(1).norm(dim=1) / grad.flatten(1).norm(dim=1).clamp(min=1e-6 * float(grad.abs().max()))
    assert error.quantile(1.0 if exact else 0.9) <= (1e-9 if exact else 2e-3)


def energy(name: str, F: Tensor) -> Tensor:
    """Return the stored energy per reference volume [Pa], (..., ), from the equations of the docstrings."""
    J, b = torch.linalg.det(F), F @ F.mT
    I1 = J ** (-2 / 3) * b.diagonal(dim1=-2, dim2=-1).sum(-1)
    I2 = J ** (-4 / 3) * ((J ** (2 / 3) * I1) ** 2 - (b @ b).diagonal(dim1=-2, dim2=-1).sum(-1)) / 2
    U = BULK / 4 * (J**2 - 1 - 2 * J.log())
    if name == "mooney_rivlin":
        return C10 * (I1 - 3) + C01 * (I2 - 3) + U
    if name == "gent":
        lock = 0.95 * LIMIT  # beyond it the slope is constant
        W = -SHEAR * LIMIT / 2 * torch.log1p(-(I1 - 3).clamp(max=lock) / LIMIT)
        return W + SHEAR / 2 / 0.05 * (I1 - 3 - lock).clamp(min=0) + U
    if name == "fluid":
        return BULK / 7 * (J + J**-6 / 6 - 7 / 6)
    sigma, beta = torch.linalg.svdvals(F), POISSON / (1 - 2 * POISSON)
    return 2 * SHEAR / EXPONENT**2 * ((sigma**EXPONENT - 1).sum(-1) + (J ** (-EXPONENT * beta) - 1) / beta)


@pytest.mark.parametrize("name", ELASTIC)
def test_stress_is_the_derivative_of_the_energy(name):
    """On both sides of the limit of Gent's law, and growing without bound towards no volume and towards infinite volume."""
    F = with_stretches([[1.3, 1.1, 0.7], [1.9, 0.9, 0.6], [2.5, 0.7, 0.6], [0.4, 0.3, 0.2], [1.05, 1.0, 0.97]]).requires_grad_()
    (P,) = torch.autograd.grad(energy(name, F).sum(), F)
    F = F.detach()
    assert_relative(engine(law_of(name), F), P @ F.mT, 1e-10)
    size = torch.tensor([1e-4, 0.01, 0.1, 1.0, 10.0, 100.0], dtype=torch.float64)
    W = energy(name, size[:, None, None] * EYE)
    assert (W[:2] > W[1:3]).all() and (W[4:] > W[3:5]).all() and W[3].abs() < 1e-9 * BULK


@pytest.mark.parametrize("name", ELASTIC)
def test_moduli_at_rest(name):
    """Shear, bulk and P-wave modulus against central differences of the stress; no stress at rest, in float32 too."""
    law, h = law_of(name), 1e-6
    for dtype in (torch.float64, torch.float32):
        assert torch.equal(engine(law, EYE[None].to(dtype)), torch.zeros(1, 3, 3, dtype=dtype))
    pull, shear = torch.zeros(2, 3, 3, dtype=torch.float64).unbind(0)
    pull[0, 0], shear[0, 1] = h, h
    up, down = (engine(law, torch.stack([EYE + sign * step for step in (pull, shear, h * EYE)])) for sign in (1, -1))
    slope = (up - down) / (2 * h)
    mu, bulk = law.moduli()
    assert float(slope[0, 0, 0]) == pytest.approx(float(law.modulus()), rel=1e-6)
    assert float(slope[1, 0, 1]) == pytest.approx(float(mu), rel=1e-6, abs=1e-3)
    assert float(slope[2, 0, 0]) / 3 == pytest.approx(float(bulk), rel=1e-6)


@pytest.mark.parametrize("name", [*ELASTIC, *PLASTIC])
def test_laws_are_objective_and_isotropic(name):
    law, F, Q = law_of(name), generic(12), rotations(12, 11)
    out = engine(law, F)
    scale = 1e-11 * out.abs().max().item()
    turned = Q @ out @ Q.mT if name in ELASTIC else Q @ out
    if name == "volumetric_reset":
        turned = out  # a fluid forgets its rotation too
    torch.testing.assert_close(engine(law, Q @ F), turned, rtol=0, atol=scale)
    again = out @ Q if name == "snow" else out
    torch.testing.assert_close(engine(law, F @ Q), again, rtol=0, atol=scale)


@pytest.mark.parametrize("name", ELASTIC)
@pytest.mark.parametrize("strain", [1e-5, 1e-3])
def test_float32_stress_keeps_the_digits_of_small_strains(name, strain):
    law, F = law_of(name), generic(200, strain).float()
    assert_relative(engine(law, F).double(), law(F.double()), 1e-5)


@pytest.mark.parametrize("stretch", [0.6, 1.5, 2.0])
def test_closed_forms_of_uniaxial_and_simple_shear(stretch):
    """Uniaxial tau_11 - tau_22 at constant volume, tau_12 = shear modulus times shear, and the law of a foam without lateral strain."""
    s = stretch
    F = torch.diag(torch.tensor([s, s**-0.5, s**-0.5], dtype=torch.float64))[None]
    shear = EYE + torch.tensor([[0.0, s, 0.0], [0.0, 0.0, 0.0], [0.0, 0.0, 0.0]], dtype=torch.float64)
    tau, turned = (engine(law_of("mooney_rivlin"), at.reshape(1, 3, 3))[0] for at in (F, shear))
    assert float(tau[0, 0] - tau[1, 1]) == pytest.approx(2 * (s**2 - 1 / s) * (C10 + C01 / s), rel=1e-10)
    assert float(turned[0, 1]) == pytest.approx(2 * (C10 + C01) * s, rel=1e-10)
    tau, x = engine(law_of("gent"), F)[0], s**2 + 2 / s - 3
    assert float(tau[0, 0] - tau[1, 1]) == pytest.approx(SHEAR * (s**2 - 1 / s) / max(1 - x / LIMIT, 0.05), rel=1e-10)
    lateral = s**-POISSON  # the ratio of a Hyperfoam is that of small strains at every strain
    free = torch.diag(torch.tensor([s, lateral, lateral], dtype=torch.float64))[None]
    tau = engine(law_of("hyperfoam"), free)[0]
    assert float(tau[1, 1]) == pytest.approx(0.0, abs=1e-8 * SHEAR)
    assert float(tau[0, 0]) == pytest.approx(2 * SHEAR / EXPONENT * (s**EXPONENT - s ** (-EXPONENT * POISSON)), rel=1e-10)
    tau = engine(law_of("fluid"), s * EYE[None])[0]
    assert float(tau[0, 0]) == pytest.approx(-(s**3) * BULK / 7 * (s**-21 - 1), rel=1e-10)
    assert float(tau[0, 1]) == 0.0


def test_resets():
    """A fluid keeps its volume and no shear; snow keeps F within its bounds bit for bit, and stretches at the bounds beyond them."""
    F = generic(50, 0.2)
    J = torch.linalg.det(F)
    torch.testing.assert_close(engine(law_of("volumetric_reset"), F), J[:, None, None] ** (1 / 3) * EYE)
    flat = torch.diag(torch.tensor([1.0, 1.0, -1.0], dtype=torch.float64))[None].contiguous()
    torch.testing.assert_close(engine(law_of("volumetric_reset"), flat), FLOOR ** (1 / 3) * EYE[None])
    law, small = law_of("snow"), generic(100, 0.005)
    assert torch.equal(engine(law, small), small) and torch.equal(engine(law, small.float()), small.float())
    sigma = torch.linalg.svdvals(engine(law, F))
    expected = torch.linalg.svdvals(F).clamp(1 - COMPRESSION, 1 + STRETCH)
    torch.testing.assert_close(sigma, expected, rtol=0, atol=1e-12)
    torch.testing.assert_close(engine(law, engine(law, F)), engine(law, F), rtol=0, atol=1e-14)
    broken = EYE.repeat(2, 1, 1)
    broken[0, 1, 2] = torch.nan
    for name in (*ELASTIC, *PLASTIC):
        assert engine(law_of(name), broken).isnan().flatten(1).any(1).tolist() == [True, False], name


@pytest.mark.parametrize("name", [*ELASTIC, "snow"])
def test_gradients_reach_the_parameters(name):
    """Of two scenes, against finite differences of the kernel."""
    kind, values = (ELASTIC | PLASTIC)[name]
    F = torch.cat([SNOW_CASES["generic"], 0.9 * SNOW_CASES["generic"]])
    particles = Particles(torch.tensor([0] * 20 + [1] * 20, dtype=torch.int32), (0, 20, 40))
    leaves = {key: torch.tensor([v, 0.9 * v], dtype=torch.float64, requires_grad=True) for key, v in values.items()}
    law = kind(**leaves)
    _, grads = engine_adjoint(law, F, weights(F), particles)
    got = torch.autograd.grad(law.tensors(), list(leaves.values()), grads)
    for (key, leaf), g in zip(leaves.items(), got):
        for s in range(2):
            h = torch.zeros(2, dtype=torch.float64)
            h[s] = 1e-6 * leaf.detach()[s]
            up, down = (engine(kind(**(leaves | {key: leaf.detach() + sign * h})), F, particles) for sign in (1, -1))
            change = ((up - down) * weights(F)).sum() / (2 * h[s])
            assert g[s].item() == pytest.approx(change.item(), rel=1e-5), key


def test_stacked_laws_of_all_kinds():
    """Old and new laws with one, two and three parameters in one launch equal each law alone, gradients included."""
    elastic = [FixedCorotated(1e5, 0.3), law_of("fluid"), law_of("gent"), law_of("hyperfoam")]
    plastic = [VonMises(1e4, 1e5, 0.3), law_of("volumetric_reset"), law_of("snow"), laws.Identity()]
    scene = torch.arange(4, dtype=torch.int32).repeat_interleave(5)
    F, particles = generic(20, 0.2), Particles(scene, (0, 5, 10, 15, 20))
    for parts in (elastic, plastic):
        law = stack(parts)
        assert law.extended and not stack(parts[:1]).extended
        out, (grad, _) = engine(law, F, particles), engine_adjoint(law, F, weights(F), particles)
        torch.testing.assert_close(law(F, particles), out)
        for i, part in enumerate(parts):
            own = slice(5 * i, 5 * i + 5)
            torch.testing.assert_close(out[own], engine(part, F[own]))
            torch.testing.assert_close(grad[own], engine_adjoint(part, F[own], weights(F)[own])[0])


@pytest.mark.parametrize("name", [*ELASTIC, *PLASTIC])
def test_laws_of_the_sections_of_a_file(name):
    kind, values = (ELASTIC | PLASTIC)[name]
    sections = ({"law": name, **values}, None) if name in ELASTIC else ({"law": "fluid", "bulk": BULK}, {"law": name, **values})
    made = laws.material(*sections)[name in PLASTIC]
    assert type(made) is kind and repr(made) == repr(law_of(name))


@pytest.mark.parametrize(
    ("make", "match"),
    [
        (lambda: MooneyRivlin(-1.0, 0.0, 1e5), r"c10 = -1 Pa is out of range: need c10 > 0"),
        (lambda: MooneyRivlin(1e4, -1.0, 1e5), r"c01 = -1 Pa is out of range: need c01 >= 0"),
        (lambda: Gent(1e4, 0.0, 1e5), r"limit = 0 is out of range"),
        (lambda: Hyperfoam(1e4, 2.0, 0.5), r"poisson = 0.5 is out of range"),
        (lambda: Snow(1.0, 0.1), r"compression = 1 is out of range: need 0 < compression < 1"),
    ],
)
def test_parameters_out_of_range(make: Callable, match: str):
    with pytest.raises(UserError, match=match):
        make()
