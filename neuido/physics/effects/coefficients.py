"""Tables of coefficients that the kernels of the effects read, computed from `Effects` and the moduli of the base law.

A table has one row per scene. `Tables` and `Layout` define the columns for the kernels (`stress_kernels`, `history_kernels`,
`flow_kernels`) and for the implementation in torch (`constitutive`).
"""

import functools
import math
from collections.abc import Callable
from typing import NamedTuple

import torch
from torch import Tensor

from neuido.errors import UserError
from neuido.physics.effects.parameters import Effects
from neuido.physics.effects.point_library import BODIES_TOO
from neuido.physics.laws import classical_kernels
from neuido.physics.laws.base import ElasticLaw, PlasticLaw
from neuido.physics.laws.parametric import ParametricElastic, ParametricLaw
from neuido.types import Particles

NO_FLOW, VON_MISES, DRUCKER_PRAGER = classical_kernels.IDENTITY, classical_kernels.VON_MISES, classical_kernels.DRUCKER_PRAGER
"""Kinds of plastic flow that the kernels of the effects compute in place of the base law."""

BAND = (0.5, 200.0)
"""Band of frequencies [Hz] in which `hysteresis` has a constant loss factor."""
BRANCHES, MARGIN = 6, 1.8
"""Number of Maxwell branches of `hysteresis`, and how far their relaxation times extend beyond the band, in ln of the time."""


PRONY = 5
"""Number of Maxwell branches of `relaxation_spectrum`."""
SPACING, DECADES = 1.535, 6
"""Distance in ln T of the Maxwell branches of `fractional` (three in two decades), and their number on either side of its time."""


class Layout(NamedTuple):
    """Columns of the history of each particle, (P, width): 6 per Maxwell branch, alpha, 6 for the backstress, e_max, ln J_P.

    Symmetric matrices are stored as xx, yy, zz, xy, xz, yz.
    """

    branches: int = 0
    """Number of Maxwell branches."""
    alpha: bool = False
    """Whether the accumulated plastic strain alpha is stored."""
    backstress: bool = False
    """Whether the backstress is stored."""
    e_max: bool = False
    """Whether e_max, the largest norm of the deviatoric Hencky strain so far, is stored."""
    compaction: bool = False
    """Whether ln J_P, the logarithm of the plastic change of volume, is stored."""

    @property
    def alpha_column(self) -> int:
        """Column of alpha, -1 where absent."""
        return 6 * self.branches if self.alpha else -1

    @property
    def backstress_column(self) -> int:
        """First column of the backstress, -1 where absent."""
        return 6 * self.branches + self.alpha if self.backstress else -1

    @property
    def e_max_column(self) -> int:
        """Column of e_max, -1 where absent."""
        return 6 * self.branches + self.alpha + 6 * self.backstress if self.e_max else -1

    @property
    def compaction_column(self) -> int:
        """Column of ln J_P, -1 where absent."""
        return self.width - 1 if self.compaction else -1

    @property
    def width(self) -> int:
        """Number of columns."""
        return 6 * self.branches + self.alpha + 6 * self.backstress + self.e_max + self.compaction


class Tables(NamedTuple):
    """Coefficients of the effects that act on the law, one row per scene; a table is None if no effect needs it."""

    layout: Layout
    material: Tensor | None
    """(S, 10): mu k of `strain_stiffening`, mu c of `second_invariant`, 2 mu r of `tension_compression`, c of `fibre` [Pa each], the unit
    direction of the fibres x, y, z [-], s of damage (`softening` without yield) [-], k of `strain_stiffening` [-], xi of
    `compaction_hardening` [-]."""
    spectral: bool
    """Whether the stress needs principal strains (`tension_compression`)."""
    branches: Tensor | None
    """(S, B, 2): 2 g mu [Pa] and relaxation time [s] of each Maxwell branch, with g the branch's share of the shear modulus."""
    flow: Tensor | None
    """(S, 9): 2 mu [Pa], 1/yield stress [1/Pa] (0: no yield), H of `hardening` [Pa], s of `softening` [-], H_k of `kinematic_hardening`
    [Pa], eta of `rate_yield` [Pa s], slope of the Drucker-Prager cone in Hencky strain [-], volumetric strain of the cone's tip [-], n of
    `yield_index` [-]."""
    kinds: tuple[int, ...]
    """Kind of plastic flow of each scene: `NO_FLOW`, `VON_MISES` or `DRUCKER_PRAGER`."""
    stiffening: Tensor
    """What the effects add to the P-wave modulus at rest [Pa], (S,); it bounds the time step."""


def shear_modulus(law: ElasticLaw) -> Tensor:
    """Compute the shear modulus of an elastic law at F = I, differentiable in the tensors of the law.

    For a classical law it comes from the parameters. For any other law it is the mean of central differences of tau_ij in three pure
    shears of 1e-4 (1e-2 in float32).

    Args:
        law: The elastic law.

    Returns:
        Shear modulus [Pa], one value per scene of the law.
    """
    tensors = law.tensors()
    if isinstance(law, ParametricElastic):
        return law.moduli()[0]
    rows = law.modulus().shape[0]
    like = tensors[0] if tensors else law.modulus()
    h = 1e-4 if like.dtype == torch.float64 else 1e-2
    F = torch.eye(3, dtype=like.dtype, device=like.device).repeat(rows, 6, 1, 1)
    planes = ((0, 1), (0, 2), (1, 2))
    for n, (i, j) in enumerate(planes):
        for side, sign in enumerate((1.0, -1.0)):
            F[:, 2 * n + side, i, j] = F[:, 2 * n + side, j, i] = sign * h
    scene = torch.arange(rows, dtype=torch.int32, device=like.device).repeat_interleave(6)
    tau = law(F.reshape(-1, 3, 3), Particles(scene, tuple(range(0, 6 * rows + 1, 6)))).reshape(rows, 3, 2, 3, 3)
    jump = tau[:, :, 0] - tau[:, :, 1]
    return torch.stack([jump[:, n, i, j] + jump[:, n, j, i] for n, (i, j) in enumerate(planes)]).sum(dim=0) / (24 * h)


def hysteresis_spectrum(loss: Tensor) -> tuple[Tensor, Tensor]:
    """Choose six Maxwell branches whose common loss factor is nearly constant over the frequencies `BAND`.

    A material of constant loss factor eta has the relaxation spectrum h(T) = (2 eta / pi) G'(1/T). The storage modulus G' rises as the
    power (2/pi) atan(eta) of the frequency, by the Kramers-Kronig relations. Equal weights, which neglect this rise, give a loss factor
    that is 16-37 % too small at eta = 0.1. Source: Findley, Lai and Onaran, Creep and Relaxation of Nonlinear Viscoelastic Materials, 1976.

    Args:
        loss: Loss factor eta [-], (S,).

    Returns:
        Weights as shares of the relaxed shear modulus [-], (S, 6), and relaxation times [s], (6,).
    """
    low, high = (math.log(1 / (2 * math.pi * f)) for f in reversed(BAND))
    at = torch.linspace(low - MARGIN, high + MARGIN, BRANCHES, dtype=loss.dtype, device=loss.device)
    step = (high - low + 2 * MARGIN) / (BRANCHES - 1)
    power = 2 / math.pi * torch.atan(loss)
    rise = torch.exp(power[:, None] * (at[-1] + step / 2 - at))
    return 2 / math.pi * step * loss[:, None] * rise, at.exp()


def _kinds(plasticity: PlasticLaw | None, scene_count: int) -> tuple[int, ...] | None:
    """Return the kind of each scene's base plasticity; None for a law that is not classical."""
    if plasticity is None or plasticity.identity:
        return (NO_FLOW,) * scene_count
    if not isinstance(plasticity, ParametricLaw):
        return None
    kinds = tuple(law.kind for law in plasticity.scene_laws())
    return kinds * scene_count if len(kinds) == 1 else kinds


def _flow(
    effects: Effects,
    elasticity: ElasticLaw,
    plasticity: PlasticLaw | None,
    count: int,
    like: Tensor,
    mu: Tensor,
) -> tuple[Tensor | None, tuple[int, ...]]:
    """Return `Tables.flow` and `Tables.kinds`; None if the base law alone computes the plastic flow."""
    base = _kinds(plasticity, count)
    own = {name: getattr(effects, name) for name in ("hardening", "softening", "kinematic_hardening", "rate_yield")}
    given = [name for name, value in own.items() if value is not None]
    of_yield = effects.yield_inverse is not None
    scaled = effects.stiffness is not None or effects.stiffness_change is not None
    if base is None:
        if of_yield or effects.cohesion is not None or given:
            name = "yield_inverse" if of_yield else "cohesion" if effects.cohesion is not None else given[0]
            raise UserError(
                f"{name} needs a classical plastic law or none, not {type(plasticity).__name__}; change the law or leave {name} out"
            )
        return None, ()
    if effects.cohesion is not None and any(kind != DRUCKER_PRAGER for kind in base):
        raise UserError("cohesion needs a declared drucker_prager plasticity, whose cone it moves; declare it or leave cohesion out")
    if of_yield and any(kind != NO_FLOW for kind in base):
        raise UserError("yield_inverse needs an elastic body, and the declared plasticity yields already; leave one of them out")
    if effects.yield_index is not None and effects.rate_yield is None:
        raise UserError("yield_index is the exponent of rate_yield: give rate_yield too")
    if given and any(kind not in (NO_FLOW, VON_MISES) for kind in base):
        raise UserError(f"{given[0]} needs a declared von_mises plasticity, or an elastic body")
    flowing = [name for name in given if name != "softening"]
    if flowing and not of_yield and all(kind == NO_FLOW for kind in base):
        raise UserError(f"{flowing[0]} needs a yield stress: a declared von_mises plasticity, or yield_inverse")
    declared = any(kind != NO_FLOW for kind in base)
    if not (of_yield or effects.cohesion is not None or (declared and (given or (scaled and VON_MISES in base)))):
        return None, ()
    if any(kind > DRUCKER_PRAGER for kind in base):
        raise UserError("bodies whose yield stress an effect changes cannot share a rollout with snow or a fluid: run them by themselves")
    column = {name: effects.rows(name, count, like)[:, 0] for name in ("yield_inverse", *own, "cohesion")}
    kinds = tuple(VON_MISES if of_yield and kind == NO_FLOW else kind for kind in base)
    radius = like.new_zeros(count)
    if plasticity is not None and declared:
        radius = plasticity.tensors()[0].to(like)[:, 0].expand(count)
    is_mises = torch.tensor([kind == VON_MISES for kind in base], device=like.device)
    is_cone = torch.tensor([kind == DRUCKER_PRAGER for kind in base], device=like.device)
    inverse = torch.where(is_mises, 1 / (2 * mu * torch.where(is_mises, radius, 1.0)), column["yield_inverse"])
    slope = torch.where(is_cone, radius, 0.0)
    # the tip of the Mohr-Coulomb cone |dev tau| = -alpha (tr tau - 3 c cot phi) lies at tr tau = 3 c cot phi
    bulk3 = 3 * elasticity.modulus().to(like).expand(count) - 4 * mu
    a = torch.where(is_cone, radius, 0.1 * bulk3 / mu) * 2 * mu / bulk3 / math.sqrt(2 / 3)
    sine = 3 * a / (2 + a)
    tip = torch.where(is_cone, 3 * column["cohesion"] * torch.sqrt(1 - sine**2) / sine / bulk3, 0.0)
    index = torch.ones_like(tip)
    if effects.yield_index is not None:
        index = effects.rows("yield_index", count, like)[:, 0]
    given_columns = [column[name] for name in ("hardening", "softening", "kinematic_hardening", "rate_yield")]
    return torch.stack([2 * mu, inverse, *given_columns, slope, tip, index], dim=1), kinds


def tables(
    effects: Effects,
    elasticity: ElasticLaw,
    plasticity: PlasticLaw | None,
    count: int,
    like: Tensor,
    *,
    shear: Tensor | float | None = None,
    point: bool = False,
) -> Tables:
    """Compute the tables of the effects that act on the law, differentiable in the effects and in the parameters of the base laws.

    Args:
        effects: The effects.
        elasticity: Elastic base law.
        plasticity: Plastic base law, or None.
        count: Number of scenes S.
        like: A tensor of the dtype and device of the tables.
        shear: Shear modulus of the elastic base law [Pa], () or (S,); `shear_modulus(elasticity)` by default.
        point: Whether a material point asks, which computes the other effects of `point_library` itself.

    Raises:
        UserError: An effect that only a material point has, or that the base law does not admit (hardening without a yield stress, cohesion
            without a Drucker-Prager law), a parameter out of its range, or one parameter of a pair without the other.
    """
    for pair in (("maxwell_ratio", "maxwell_time"), ("fibre", "fibre_direction")):
        missing = [name for name in pair if getattr(effects, name) is None]
        if len(missing) == 1:
            raise UserError(f"{pair[0]} and {pair[1]} come together; give {missing[0]} too")
    alone = {name.partition(".")[0]: None for name in effects.point or {}}
    if not point and (refused := [name for name in alone if name not in BODIES_TOO]):
        raise UserError(f"{refused[0]} is an effect of material tests, and no body has it yet: leave it out")
    for name in ("yield_index", "compaction_hardening"):
        if point and getattr(effects, name) is not None:
            raise UserError(f"{name} is an effect of bodies, and no material test has it yet: leave it out")
    if effects.compaction_hardening is not None and (plasticity is None or plasticity.identity):
        raise UserError("compaction_hardening needs a plastic law that changes the volume, such as snow: declare one or leave it out")
    if not effects.changes_law:
        return Tables(Layout(), None, False, None, None, (), like.new_zeros(count))
    mu = torch.as_tensor(shear_modulus(elasticity) if shear is None else shear, dtype=like.dtype, device=like.device)
    mu = mu.reshape(-1).expand(count)
    branches = _branches(effects, count, like, mu)
    flow, kinds = _flow(effects, elasticity, plasticity, count, like, mu)
    damages = effects.softening is not None and (flow is None or bool((flow[:, 1] <= 0).any()))
    material, stiff = _material(effects, count, like, mu, flow, damages)
    if branches is not None:
        stiff = stiff + 2 / 3 * branches[:, :, 0].sum(dim=1)
    layout = Layout(
        0 if branches is None else branches.shape[1],
        flow is not None and (effects.hardening is not None or effects.softening is not None),
        flow is not None and effects.kinematic_hardening is not None,
        damages,
        effects.compaction_hardening is not None,
    )
    return Tables(layout, material, effects.tension_compression is not None, branches, flow, kinds, stiff.detach())


def _prony(value: Callable[[str], Tensor]) -> tuple[Tensor, Tensor]:
    """Return weights and relaxation times (S, 5) of `relaxation_spectrum`; `value` gives a parameter (S,)."""
    g = torch.stack([value(f"g{i}") for i in range(1, PRONY + 1)], dim=1)
    first, last = (torch.where(t > 0, t, 1.0)[:, None] for t in (value("first"), value("last")))  # any time serves a weight of zero
    share = torch.linspace(0.0, 1.0, PRONY, dtype=g.dtype, device=g.device)
    return g, torch.exp(first.log() + share * (last / first).log())


def _power(value: Callable[[str], Tensor]) -> tuple[Tensor, Tensor]:
    """Return weights and relaxation times (S, B) of `fractional`, whose sum is a power law of time; `value` gives a parameter (S,).

    (t/t0)^-a is the integral over ln T of (T/t0)^-a exp(-t/T) / Gamma(a). The sum over branches `SPACING` apart in ln T differs from it by
    less than 1 % within three decades of t0.
    """
    ratio, a, t0 = value("ratio")[:, None], value("exponent")[:, None], value("time")[:, None]
    a, t0 = torch.where(a > 0, a, 0.5), torch.where(t0 > 0, t0, 1.0)
    at = SPACING * torch.arange(-DECADES, DECADES + 1, dtype=a.dtype, device=a.device)
    slower = torch.cat([torch.zeros_like(at[1:]), torch.ones_like(at[:1])]) / torch.expm1(a * SPACING)  # all beyond the slowest
    return ratio * SPACING * torch.exp(-a * at - torch.lgamma(a)) * (1 + slower), t0 * at.exp()


def _branches(effects: Effects, count: int, like: Tensor, mu: Tensor) -> Tensor | None:
    """Return `Tables.branches`; None without a Maxwell branch."""
    weights, times = [], []
    if effects.maxwell_ratio is not None:
        ratio, time = (effects.rows(name, count, like)[:, 0] for name in ("maxwell_ratio", "maxwell_time"))
        if bool(((time <= 0) & (ratio != 0)).any()):
            raise UserError(f"maxwell_time is {time.min().item():g} s; it must be positive")
        time = torch.where(time > 0, time, 1.0)  # any time serves a branch of weight zero
        weights.append(ratio[:, None])
        times.append(time[:, None])
    if effects.hysteresis is not None:
        g, T = hysteresis_spectrum(effects.rows("hysteresis", count, like)[:, 0])
        weights.append(g)
        times.append(T.expand_as(g))
    for name, spectrum in (("relaxation_spectrum", _prony), ("fractional", _power)):
        if any(key.startswith(name) for key in effects.point or {}):
            g, T = spectrum(functools.partial(effects.point_rows, name, scene_count=count, like=like))
            weights.append(g)
            times.append(T)
    return torch.stack([2 * mu[:, None] * torch.cat(weights, 1), torch.cat(times, 1)], dim=-1) if weights else None


def _material(effects: Effects, count: int, like: Tensor, mu: Tensor, flow: Tensor | None, damages: bool) -> tuple[Tensor | None, Tensor]:
    """Return `Tables.material`, and what its effects add to the P-wave modulus [Pa], (S,)."""
    names = ("strain_stiffening", "second_invariant", "tension_compression", "fibre")
    zero = like.new_zeros(count)
    if not damages and all(getattr(effects, name) is None for name in (*names, "compaction_hardening")):
        return None, zero
    damage = zero
    if effects.softening is not None:
        damage = effects.rows("softening", count, like)[:, 0]
        if flow is not None:
            damage = torch.where(flow[:, 1] > 0, 0.0, damage)
    direction = like.new_zeros(count, 3)
    if effects.fibre_direction is not None:
        direction = effects.rows("fibre_direction", count, like)
        size = direction.norm(dim=1, keepdim=True)
        if bool((size <= 0).any()):
            raise UserError("fibre_direction is zero; give a vector of any length")
        direction = direction / size
    k, c, r, f = (effects.rows(name, count, like)[:, 0] for name in names)
    xi = effects.rows("compaction_hardening", count, like)
    material = torch.cat([torch.stack([mu * k, mu * c, 2 * mu * r, f], dim=1), direction, damage[:, None], k[:, None], xi], dim=1)
    return material, 4 / 3 * mu * c + 2 * mu * r.clamp(min=0) + 2 * f
