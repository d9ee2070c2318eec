"""Physical effects beyond the declared law. Each is a parameter that is None or zero when the effect is absent.

A model with fewer effects is thus a special case of one with more, and the gradient at zero tests a candidate effect (score test). A
rollout takes the parameters as differentiable inputs and skips absent effects. Forces, contact and inertia act on the grid. Material
effects act on the stress and on a history (`coefficients`, `stress_kernels`, and an implementation in torch, `constitutive`).
`LIBRARY` gives for each effect its equation, parameters, prior range, where it shows and what it is confused with.
"""

import math
from collections.abc import Mapping
from typing import Any, NamedTuple

import torch
from torch import Tensor

from neuido.errors import UserError
from neuido.physics.effects.entry import Entry, Parameter
from neuido.physics.effects.library import LIBRARY
from neuido.physics.effects.point_library import FIELD, PLANE_ENTRIES, POINT_ENTRIES
from neuido.types import brief_fields

__all__ = ["LIBRARY", "Effects", "Entry", "Parameter", "ball_inclusion", "linear_gradient"]

Number = Tensor | float | None
Triple = Tensor | tuple[float, float, float] | None

_MATERIAL = (
    "stiffness", "relative_density", "stiffness_change", "maxwell_ratio", "hysteresis", "strain_stiffening", "second_invariant",
    "tension_compression", "fibre", "yield_inverse", "hardening", "softening", "kinematic_hardening", "rate_yield", "yield_index",
    "compaction_hardening", "cohesion", "point",
)  # fmt: skip
_LOWER_BOUNDS = {
    "added_mass": (-1.0, ""), "spin_decay": (0.0, " 1/s"), "drag_linear": (0.0, " 1/s"), "drag_quadratic": (0.0, " 1/m"),
    "viscosity_shear": (0.0, " Pa s"), "viscosity_bulk": (0.0, " Pa s"), "stick": (0.0, " 1/s"), "restitution": (0.0, " 1/s"),
    "maxwell_ratio": (0.0, ""), "hysteresis": (0.0, ""), "second_invariant": (-1.0, ""), "tension_compression": (-1.0, ""),
    "fibre": (0.0, " Pa"), "yield_inverse": (0.0, " 1/Pa"), "hardening": (0.0, " Pa"), "softening": (0.0, ""),
    "kinematic_hardening": (0.0, " Pa"), "rate_yield": (0.0, " Pa s"), "yield_index": (0.1, ""), "compaction_hardening": (0.0, ""),
    "cohesion": (0.0, " Pa"),
}  # fmt: skip


class Effects(NamedTuple):
    """Parameters of the physical effects of S scenes.

    Each is a number or a tensor of shape () or (S,), a vector (3,) or (S, 3). None: the effect is absent. `LIBRARY` has the equations.
    """

    uniform_acceleration: Triple = None
    """A uniform acceleration added to gravity [m/s^2], (3,) or (S, 3): a tilt or a steady wind."""
    drag_linear: Number = None
    """c of the acceleration -c v [1/s]."""
    drag_quadratic: Number = None
    """k of the acceleration -k |v| v [1/m]."""
    position_force: Number = None
    """k of the acceleration -k (x - centre) [1/s^2], a pull towards a point."""
    position_centre: Triple = None
    """The centre of `position_force` [m], (3,) or (S, 3)."""
    viscosity_shear: Number = None
    """eta of Kelvin-Voigt's Cauchy stress 2 eta D [Pa s], with the full D rather than its deviator."""
    viscosity_bulk: Number = None
    """zeta of Kelvin-Voigt's Cauchy stress zeta tr(D) I [Pa s]."""
    gravity: Number = None
    """Added to the magnitude of gravity, along its direction [m/s^2]."""
    magnus: Triple = None
    """w of the acceleration w x v [1/s], (3,) or (S, 3): the spin times a coefficient; in a turning frame minus twice its rate."""
    time_force: Tensor | None = None
    """Accelerations [m/s^2] at J evenly spaced times from t = 0, (J, 3) or (S, J, 3); linearly interpolated, constant after the last."""
    time_force_interval: float | None = None
    """Time between two knots of `time_force` [s]."""
    stiffness: Tensor | None = None
    """Factor of each particle's elastic stress [-], (P,) in the order of the bodies; see `linear_gradient` and `ball_inclusion`."""
    stiffness_change: Number = None
    """r of the elastic stress times exp(r t) [1/s]."""
    maxwell_ratio: Number = None
    """Shear modulus of a parallel Maxwell branch over the base law's [-]."""
    maxwell_time: Number = None
    """Relaxation time of the Maxwell branch [s], > 0."""
    hysteresis: Number = None
    """Loss factor [-] of a rate-independent loss (`coefficients.hysteresis_spectrum`); twice a damping ratio."""
    strain_stiffening: Number = None
    """k of tau += mu k x / (1 - k x) dev bbar with x = I1bar - 3 [-], Gent's law: for small x Yeoh's second term mu k x dev bbar;
    x cannot exceed 1/k. Negative k: a body that softens. The factor is bounded at `classical_kernels.LOCKED`."""
    second_invariant: Number = None
    """c of W = 3/2 mu c ln(I2bar / 3) [-], Gent and Thomas' second term: for small strains Mooney and Rivlin's mu c / 2 (I2bar - 3)."""
    tension_compression: Number = None
    """r of tau += 2 mu r sum min(e_i, 0) n_i n_i [-]: principal Hencky strains that are negative resist 1 + r times as much."""
    fibre: Number = None
    """c of W = c / 4 (I4 - 1)^2 [Pa]."""
    fibre_direction: Triple = None
    """Direction of the fibres in the reference body, (3,) or (S, 3); normalised."""
    yield_inverse: Number = None
    """One over the yield stress of an elastic body, the norm of its deviatoric Kirchhoff stress 2 mu dev ln V at yield [1/Pa]."""
    hardening: Number = None
    """H of isotropic hardening [Pa], which adds H alpha to the yield stress; alpha is the accumulated norm of the plastic strain."""
    softening: Number = None
    """s of the factor exp(-s alpha) on the yield stress [-]; for a body that does not yield, of exp(-s e_max) on the elastic stress."""
    kinematic_hardening: Number = None
    """H_k [Pa] of Prager's backstress, which grows by H_k times the plastic strain and turns with the spin."""
    rate_yield: Number = None
    """eta of Perzyna's overstress [Pa s]; 0 is rate-independent flow."""
    yield_index: Number = None
    """n of the overstress eta (r/r0)^n r0 with the rate of plastic strain r and r0 = 1/s, Herschel and Bulkley's law [-]; None: 1, that
    of Bingham. Below 1 the flow thins as it quickens. At least 0.1."""
    compaction_hardening: Number = None
    """xi of the factor exp(xi (1 - J_P)) on the elastic stress [-], with J_P the plastic change of volume: compacted snow is harder. J_P
    is bounded below by `history_functions.COMPACTED`. Source: Stomakhin et al. 2013."""
    cohesion: Number = None
    """Mohr-Coulomb cohesion c of a body declared as Drucker-Prager [Pa]."""
    friction: Number = None
    """Added to the friction coefficient of every collider and wall [-]."""
    stick: Number = None
    """Rate of the factor exp(-stick dt) on the velocity of a node inside a collider, after contact [1/s]; infinity is a sticky floor."""
    restitution: Number = None
    """Rate of the factor exp(-restitution dt) on the outward normal velocity of such a node [1/s]: a lossy floor."""
    swelling: Number = None
    """rate of the stress-free size g = 1 + rate t, the same along all axes [1/s]; negative: drying. The elastic gradient is F / g, which is
    what a rollout returns as F. The energy of a piece of matter is that of the elastic gradient: swelling adds no stiffness."""
    spin_decay: Number = None
    """k of a torque -k L on a body with the angular momentum L about its centre of mass [1/s]; it leaves the centre of mass alone."""
    added_mass: Number = None
    """c of the factor 1 + c on the inertia at unchanged weight [-]."""
    relative_density: Tensor | None = None
    """Factor of each particle's mass and elastic stress [-], (P,) in the order of the bodies. It describes a foam or a hollow body,
    whose modulus is proportional to its relative density (Gibson and Ashby, exponent 1), or particles that lie closer together than
    their volumes imply. The yield strain is that of the solid."""
    point: Mapping[str, Tensor | float] | None = None
    """Parameters of the effects of `point_library` by name, such as "mullins.share"; most of them only a material point has."""

    @classmethod
    def of(cls, values: Mapping[str, Tensor | float], *, x: Tensor | None = None, scene: Tensor | None = None) -> "Effects":
        """Create effects from the parameter names of `LIBRARY`: "viscosity_shear.eta", "uniform_acceleration.x", "time_force.y2", ...

        Args:
            values: Numbers or tensors (S,).
            x: Reference positions [m], (P, 3); needed by `stiffness_gradient`.
            scene: Scene of each particle, (P,); needed if the values of `stiffness_gradient` have S > 1 rows.

        Raises:
            UserError: A name that is not in the library, or that needs another argument.
        """
        return cls(**_fields(values, x, scene))

    @property
    def changes_law(self) -> bool:
        """Whether an effect other than viscosity acts on the stress or the plastic flow."""
        return any(getattr(self, name) is not None for name in _MATERIAL)

    def rows(self, name: str, scene_count: int, like: Tensor) -> Tensor:
        """Return the parameter `name` as (S, 1) or (S, 3), differentiable, in the type and on the device of `like`; zero where absent.

        Raises:
            UserError: Below its range, not a number, or a shape that fits neither one scene nor all.
        """
        width = 3 if name in ("uniform_acceleration", "position_centre", "magnus", "fibre_direction") else 1
        value = getattr(self, name)
        if value is None:
            return like.new_zeros(scene_count, width)
        rows = _tensor(value).to(like.device, like.dtype)
        rows = rows.reshape((1, width) if rows.numel() == width else (-1, width))
        if rows.shape[0] not in (1, scene_count):
            raise UserError(f"{name} has {rows.shape[0]} rows for {scene_count} scenes; give one value or one for each scene")
        least, unit = _LOWER_BOUNDS.get(name, (-math.inf, ""))
        if bool((~(rows >= least)).any()):
            worst = rows[~(rows >= least)][0].item()
            bound = "zero" if least == 0.0 else f"{least:g}"
            raise UserError(f"{name} is {worst:g}{unit}; it must be {bound} or more")
        return rows.expand(scene_count, width)

    def point_rows(self, effect: str, part: str, scene_count: int, like: Tensor) -> Tensor:
        """Return a parameter of an effect of `point_library`, (S,), in the type and on the device of `like`; zero where absent.

        Raises:
            UserError: Outside its range, not a number, or neither one value nor one for each scene.
        """
        value = (self.point or {}).get(f"{effect}.{part}")
        if value is None:
            return like.new_zeros(scene_count)
        rows = _tensor(value).to(like.device, like.dtype).reshape(-1)
        if len(rows) not in (1, scene_count):
            raise UserError(f"{effect}.{part} has {len(rows)} values for {scene_count} scenes; give one value or one for each scene")
        p = _POINT[f"{effect}.{part}"]
        wrong = ~((rows >= p.low) & (rows <= p.high))
        if bool(wrong.any()):
            raise UserError(f"{effect}.{part} is {rows[wrong][0].item():g} {p.unit}; it must be from {p.low:g} to {p.high:g}")
        return rows.expand(scene_count)

    def particle_stiffness(self, count: int, like: Tensor) -> Tensor | None:
        """Return the factor on each particle's elastic stress, (P,), from `stiffness` and `relative_density`; None without either.

        Raises:
            UserError: As `particle_factor`.
        """
        factors = [self.particle_factor(name, count, like) for name in ("stiffness", "relative_density") if getattr(self, name) is not None]
        return math.prod(factors[1:], start=factors[0]) if factors else None

    def particle_factor(self, name: str, count: int, like: Tensor) -> Tensor:
        """Return `stiffness` or `relative_density` as (P,), validated.

        Raises:
            UserError: Another number of particles, or a factor that is not positive.
        """
        factor = _tensor(getattr(self, name)).to(like.device, like.dtype)
        if factor.ndim == 0:
            factor = factor.expand(count)
        if factor.shape != (count,):
            raise UserError(f"{name} has shape {tuple(factor.shape)} for {count} particles; give one factor for each")
        if bool((~(factor > 0)).any()):
            raise UserError(f"{name} is {factor.min().item():g} somewhere; it must be positive")
        return factor

    def accelerations(self, gravity: Tensor, dt: Tensor, steps: int) -> Tensor:
        """Return gravity plus all spatially uniform accelerations, (1, S, 3), or (T, S, 3) if they vary in time.

        Args:
            gravity: [m/s^2], (S, 3).
            dt: Step of each scene [s], (S,).
            steps: Number of substeps T; `time_force` is evaluated at the middle of each.
        """
        count = len(gravity)
        if self.gravity is not None:
            size = gravity.norm(dim=1, keepdim=True)
            direction = gravity / torch.where(size > 0, size, 1.0)
            gravity = gravity + self.rows("gravity", count, gravity) * direction
        if self.added_mass is not None:
            gravity = gravity / (1 + self.rows("added_mass", count, gravity))
        total = (gravity + self.rows("uniform_acceleration", count, gravity))[None]
        if self.time_force is None:
            return total
        if self.time_force_interval is None or not self.time_force_interval > 0:
            raise UserError(f"time_force_interval is {self.time_force_interval}; time_force needs a positive time between its knots")
        knots = _tensor(self.time_force).to(gravity)
        if knots.ndim not in (2, 3) or knots.shape[-1] != 3 or (knots.ndim == 3 and len(knots) not in (1, count)):
            raise UserError(f"time_force has shape {tuple(knots.shape)}; give (J, 3), or (S, J, 3) for {count} scenes")
        knots = knots.expand(count, *knots.shape[-2:])
        at = (torch.arange(steps, dtype=torch.float64, device=dt.device)[:, None] + 0.5) * dt.double() / self.time_force_interval
        at = at.clamp(max=knots.shape[1] - 1)
        left = at.floor().long().clamp(max=max(knots.shape[1] - 2, 0))
        share = (at - left).to(gravity)[..., None]
        scene = torch.arange(count, device=dt.device)
        right = (left + 1).clamp(max=knots.shape[1] - 1)
        return total + (1 - share) * knots[scene, left] + share * knots[scene, right]

    def force_table(self, scene_count: int, like: Tensor) -> Tensor:
        """Return the table of body forces that `mpm.kernels.grid.update_grid` reads.

        The columns are linear drag, quadratic drag, pull, centre x, y, z, (S, 6). If `magnus`, `stick` or `restitution` is given, five
        follow: magnus x, y, z, stick, restitution, (S, 11).
        """
        names = ["drag_linear", "drag_quadratic", "position_force", "position_centre"]
        more = ["magnus", "stick", "restitution"]
        if any(getattr(self, name) is not None for name in more):
            names += more
        return torch.cat([self.rows(name, scene_count, like) for name in names], dim=1)

    def viscosity(self, scene_count: int, like: Tensor) -> Tensor | None:
        """Return eta and zeta of the viscous stress 2 eta dev D + zeta tr(D) I, (S, 2) [Pa s]; None without viscosity.

        `viscosity_shear` defines 2 eta D with the full D; the trace of that term is part of zeta.
        """
        if self.viscosity_shear is None and self.viscosity_bulk is None:
            return None
        eta, zeta = (self.rows(name, scene_count, like) for name in ("viscosity_shear", "viscosity_bulk"))
        return torch.cat([eta, zeta + 2.0 / 3.0 * eta], dim=1)

    def growth(self, dt: Tensor, steps: int) -> Tensor | None:
        """Return exp(r t) of `stiffness_change` at the start of each substep, (T, S); None without it."""
        if self.stiffness_change is None:
            return None
        times = torch.arange(steps, dtype=torch.float64, device=dt.device)[:, None] * dt.double()
        return torch.exp(self.rows("stiffness_change", len(dt), dt)[:, 0] * times.to(dt))

    def stress_free_size(self, dt: Tensor, steps: int) -> Tensor | None:
        """Return g = 1 + rate t of `swelling` at the end of each substep, (T, S) float64; None without it.

        Raises:
            UserError: A body that would shrink to nothing.
        """
        if self.swelling is None:
            return None
        rate = self.rows("swelling", len(dt), dt)[:, 0].double()
        size = 1 + rate * (torch.arange(1, steps + 1, dtype=torch.float64, device=dt.device)[:, None] * dt.double())
        if bool((size <= 0).any()):
            raise UserError(f"swelling is {rate.min().item():g} 1/s; the body would vanish within {steps * dt.max().item():g} s")
        return size

    def shrinkage(self, dt: Tensor, steps: int) -> Tensor | None:
        """Return e of the factor 1 - e = g(t) / g(t + dt) of each substep, (T, S), with g of `stress_free_size`; None without it."""
        size = self.stress_free_size(dt, steps)
        return None if size is None else (self.rows("swelling", len(dt), dt)[:, 0].double() * dt.double() / size).to(dt)

    def spin_loss(self, dt: Tensor) -> Tensor | None:
        """Return the share 1 - exp(-k dt) of the angular momentum that `spin_decay` takes in a substep, (S, 1); None without it."""
        if self.spin_decay is None:
            return None
        return -torch.expm1(-self.rows("spin_decay", len(dt), dt) * dt[:, None])

    def __repr__(self) -> str:
        return brief_fields(self)


def _tensor(value) -> Tensor:
    """Return a value as a tensor; numbers become float64, to lose no precision."""
    return value if isinstance(value, Tensor) else torch.as_tensor(value, dtype=torch.float64)


def linear_gradient(x: Tensor, slope: Tensor, *, mean: Tensor | None = None, length: Tensor | float | None = None) -> Tensor:
    """Return the factor exp(slope . (X - mean) / length), (P,): a stiffness gradient across the body.

    Args:
        x: Reference positions [m], (P, 3).
        slope: Change of the factor's logarithm over `length` along each axis [-], (3,) or (P, 3).
        mean: Position at which the factor is one [m]; by default the mean of `x`.
        length: Reference length [m]; by default the largest extent of `x`.
    """
    mean = x.mean(dim=0) if mean is None else mean
    length = (x.amax(dim=0) - x.amin(dim=0)).max().clamp(min=1e-30) if length is None else length  # one point: a factor of one
    return torch.exp(((x - mean) / length * slope).sum(-1))


def ball_inclusion(
    x: Tensor, log_ratio: Tensor | float, centre: Tensor, radius: Tensor | float, *, width: Tensor | float = 0.0, mean: Tensor | None = None
) -> Tensor:
    """Return the factor exp(log_ratio) inside a ball and 1 outside, (P,): a stiffer or softer inclusion.

    Args:
        x: Reference positions [m], (P, 3).
        log_ratio: Logarithm of the factor inside [-], () or (P,).
        centre: Centre of the ball relative to the mean of `x` [m], (3,) or (P, 3).
        radius: Radius of the ball [m], () or (P,).
        width: Width of a smooth border tanh((radius - r) / width) [m]. With 0 the border is sharp, and the factor has no gradient with
            respect to centre and radius.
        mean: Replaces the mean of `x`.
    """
    r = torch.linalg.vector_norm(x - (x.mean(dim=0) if mean is None else mean) - centre, dim=-1)
    width = torch.as_tensor(width, dtype=x.dtype, device=x.device)
    soft = 0.5 + 0.5 * torch.tanh((radius - r) / torch.where(width > 0, width, 1.0))
    inside = torch.where(width > 0, soft, (r <= radius).to(x.dtype))
    return torch.exp(log_ratio * inside)


_FIELDS = {
    f"{entry.name}.{parameter.name}": parameter.field
    for entry in LIBRARY
    for parameter in entry.parameters
    if parameter.field in Effects._fields and entry.only != "track"
}
_FIELDS |= {"rate_yield.index": "yield_index", "compaction_hardening.xi": "compaction_hardening"}
"""The field of `Effects` that each parameter name of `LIBRARY` sets, whole or as its component x, y or z; and two names that a model may
declare and no diagnosis proposes."""


def _fields(values: Mapping[str, Tensor | float], x: Tensor | None, scene: Tensor | None) -> dict[str, Any]:
    given = {name: value for name, value in values.items() if value is not None}
    out: dict[str, Any] = {}
    vectors: dict[str, dict[str, Tensor | float]] = {}
    gradient: dict[str, Tensor | float] = {}
    for name, value in given.items():
        effect, _, part = name.partition(".")
        if effect == "time_force" and part[:1] in ("x", "y", "z") and part[1:].isdigit():
            vectors.setdefault("time_force", {})[part] = value
        elif effect == "fibre" and part in ("azimuth", "elevation"):
            vectors.setdefault("fibre", {})[part] = value
        elif effect == "stiffness_gradient" and name in _NAMES:
            gradient[part] = value
        elif name not in _FIELDS:
            known = ", ".join(_parameter_names(effect)) or "drag_linear.k"
            raise UserError(f"{name} is not a parameter of an effect; use a name of LIBRARY, for example {known}")
        elif name == "time_force.interval":
            intervals = _tensor(value).detach().reshape(-1)
            if bool((intervals != intervals[0]).any()):
                raise UserError(f"time_force.interval is {intervals.tolist()}; all scenes share one, so give one value")
            out["time_force_interval"] = intervals[0].item()
        elif _FIELDS[name] == FIELD:
            out.setdefault(FIELD, {})[name] = value
        elif part in ("x", "y", "z"):
            vectors.setdefault(_FIELDS[name], {})[part] = value
        else:
            out[_FIELDS[name]] = value
    for field, parts in vectors.items():
        tensors = {key: _tensor(v).reshape(-1) for key, v in parts.items()}
        like = next((t for t in tensors.values() if t.requires_grad), next(iter(tensors.values())))
        size = max(len(t) for t in tensors.values())
        part = {key: t.to(like).expand(size) for key, t in tensors.items()}
        zero = like.new_zeros(size)
        if field == "time_force":
            knots = 1 + max(int(key[1:]) for key in part)
            out[field] = torch.stack([torch.stack([part.get(f"{a}{j}", zero) for a in "xyz"], -1) for j in range(knots)], 1)
        elif field == "fibre":
            az, el = part.get("azimuth", zero), part.get("elevation", zero)
            out["fibre_direction"] = torch.stack([el.cos() * az.cos(), el.sin(), el.cos() * az.sin()], -1)
        else:
            out[field] = torch.stack([part.get(a, zero) for a in "xyz"], -1)
    if "fibre" in out and "fibre_direction" not in out:
        out["fibre_direction"] = torch.tensor([1.0, 0.0, 0.0], dtype=torch.float64)
    if gradient:
        out["stiffness"] = _stiffness(gradient, x, scene)
    return out


def _stiffness(part: Mapping[str, Tensor | float], x: Tensor | None, scene: Tensor | None) -> Tensor:
    """Return the stiffness factor of each particle, (P,), from the parameters of `stiffness_gradient`.

    Mean and length are those of each scene's own body.
    """
    if x is None:
        raise UserError("stiffness_gradient needs the particles' reference positions: Effects.of(values, x=...)")
    index = torch.zeros(len(x), dtype=torch.long, device=x.device) if scene is None else scene.long()
    scenes = int(index.max()) + 1

    def row(name: str, s: int) -> Tensor:
        t = _tensor(part.get(name, 0.0)).to(x).reshape(-1)
        if len(t) not in (1, scenes):
            raise UserError(f"stiffness_gradient.{name} has {len(t)} values for {scenes} scenes; give one, or `scene` of each particle")
        return t[s if len(t) > 1 else 0]

    factor = x.new_ones(len(x))
    for s in range(scenes):
        (own,) = torch.nonzero(index == s, as_tuple=True)
        slope, centre = (torch.stack([row(f"{name}{a}", s) for a in "xyz"]) for name in ("", "c"))
        f = linear_gradient(x[own], slope)
        if "log_ratio" in part:
            f = f * ball_inclusion(x[own], row("log_ratio", s), centre, row("radius", s), width=row("width", s))
        factor = factor.index_copy(0, own, f)
    return factor


_POINT = {f"{entry.name}.{p.name}": p for entry in (*POINT_ENTRIES, *PLANE_ENTRIES) for p in entry.parameters}
_NAMES = {f"{entry.name}.{parameter.name}" for entry in LIBRARY for parameter in entry.parameters}


def _parameter_names(effect: str) -> list[str]:
    return [name for name in sorted(_NAMES) if name.startswith(effect + ".")]
