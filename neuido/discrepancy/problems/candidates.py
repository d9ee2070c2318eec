"""The effects that a moving body may lack, with ranges and starts of the fits in proportion to the body.

The equations are in `physics.effects`. Here stresses are scaled by the modulus of the body, times by its waves and by the recording,
and accelerations by gravity.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np
import torch

from neuido.data.measured.experiment import Experiment
from neuido.discrepancy.problems.problem import Candidate, Parameter
from neuido.physics.effects.library import KNOTS
from neuido.physics.effects.parameters import Effects

REST = {"maxwell.time": 1.0, "stiffness_gradient.radius": 1e-6, "time_force.frequency": 0.0}
"""Values of shape parameters in parameter sets without the effect, when others of the same launch have it."""


class Scales(NamedTuple):
    """Typical sizes of an experiment."""

    young: float
    """Declared Young's modulus [Pa]."""
    wave: float
    """Travel time of a shear wave through the body [s]."""
    duration: float
    """Length of the longest fitted recording [s]."""
    speed: float
    """Typical speed [m/s]."""
    length: float
    """Size of the body [m]."""
    gravity: float
    """Acceleration of gravity [m/s^2]."""
    step: float
    """Substep [s]."""


def scales(experiment: Experiment) -> Scales:
    """Estimate the typical sizes of an experiment from its declared model and its fitted recordings."""
    model = experiment.model
    young, rho = float(model["elasticity"]["young"]), float(model["density"])
    fits = [r for r in experiment.recordings if r.role == "fit"]
    length = max(float(np.ptp(r.body.x.numpy(), axis=0).max()) for r in fits)
    speed = max(_speed(r.x.numpy(), r.t.numpy()) for r in fits)
    wave = length * math.sqrt(2.6 * rho / young)
    gravity = max(math.hypot(*experiment.scene.gravity), 1e-3)
    return Scales(young, wave, max(float(r.t[-1]) for r in fits if r.t is not None), speed, length, gravity, experiment.scene.dt)


def _speed(x: np.ndarray, t: np.ndarray) -> float:
    """Return the root mean square speed of the points between the two frames where it is largest [m/s]."""
    v = np.diff(x, axis=0) / np.diff(t)[:, None, None]
    seen = np.isfinite(v).all(axis=(1, 2)) if not np.isfinite(v).all() else np.ones(len(v), bool)
    square = np.nanmean((v[seen] if seen.any() else v) ** 2, axis=1).sum(axis=-1)
    return max(float(np.sqrt(np.nanmax(square))), 1e-3)


def body_candidates(experiment: Experiment) -> tuple[Candidate, ...]:
    """Return the candidates for an experiment: the effects that its declared model allows, with ranges and starts."""
    s = scales(experiment)
    plastic = experiment.model["plasticity"]["law"]
    planes = [p for r in experiment.recordings for p in r.scene.colliders]
    out: list[Candidate] = []

    def add(
        name: str,
        where: str,
        starts: Sequence[Mapping[str, float]],
        *parameters: tuple,
        form: str = "",
        sizes: str = "",
        linear: bool = True,
        apart: str = "",
        far: float = 0.0,
        beside: Mapping[str, float] | None = None,
        takes: Sequence[str] = (),
        saturates: bool = False,
    ):
        def absent(key: str) -> float:
            return 0.0 if not sizes or key in sizes.split() else starts[0][key]

        made = tuple(
            Parameter(f"{name}.{key}", unit, absent(key), scale, low, high, log=log, saturates=saturates)
            for key, unit, scale, low, high, log in parameters
        )
        named = tuple({f"{name}.{k}": v for k, v in start.items()} for start in starts)
        own = tuple(f"{name}.{k}" for k in sizes.split())
        out.append(Candidate(name, made, named, where, form, own, linear, apart and f"{name}.{apart}", far, beside or {}, tuple(takes)))

    def vector(keys: Sequence[str], unit: str, scale: float, high: float) -> list[tuple]:
        return [(key, unit, scale, -high, high, False) for key in keys]

    g = s.gravity
    add("gravity", "flight", [{"g": 0.05 * g}], ("g", "m/s^2", 0.05 * g, -0.6 * g, 0.6 * g, False))
    add("uniform_acceleration", "flight", [dict.fromkeys("xyz", 0.05 * g)], *vector("xyz", "m/s^2", 0.05 * g, 0.6 * g))
    k = 0.3 / s.duration
    add("drag_linear", "flight", [{"k": k}], ("k", "1/s", k, 0.0, 30 * k, False))
    k = 0.3 / (s.duration * s.speed)
    add("drag_quadratic", "flight", [{"k": k}], ("k", "1/m", k, 0.0, 30 * k, False))
    k = 0.3 / s.duration
    add("magnus", "flight", [dict.fromkeys("xyz", k)], *vector("xyz", "1/s", k, 20 * k))
    k = 1.0 / s.duration**2
    centre = np.nanmean(experiment.recordings[0].x.numpy(), axis=(0, 1))
    places = dict(zip("xyz", map(float, centre), strict=True))
    # a pull to a far centre is almost a uniform force, so that a fit from a centre in the body ends there; hence the starts outside
    centres = [places, *(places | {a: c + far * s.length} for a, c in places.items() for far in (2, -2))]
    add("position_force", "flight", [{"k": k, **c} for c in centres], ("k", "1/s^2", k, -40 * k, 40 * k, False),
        *[(a, "m", s.length, c - 20 * s.length, c + 20 * s.length, False) for a, c in places.items()], sizes="k", apart="k")  # fmt: skip
    knots = [f"{a}{j}" for j in range(KNOTS) for a in "xyz"]
    add("time_force", "flight", [dict.fromkeys(knots, 0.1 * g)], *vector(knots, "m/s^2", 0.1 * g, 2 * g))
    waves = ("sx", "sy", "sz", "cx", "cy", "cz")
    add("time_force", "flight", [dict.fromkeys(waves, 0.1 * g) | {"frequency": n / s.duration} for n in (1.5, 4.0)],
        *vector(waves, "m/s^2", 0.1 * g, 5 * g), ("frequency", "Hz", 0.15, 0.3 / s.duration, 20 / s.duration, True),
        form="harmonic", sizes=" ".join(waves))  # fmt: skip
    add("added_mass", "flight", [{"c": 0.1}], ("c", "1", 0.1, -0.5, 3.0, False))
    k = 0.3 / s.duration
    add("spin_decay", "rotation", [{"k": k}], ("k", "1/s", k, 0.0, 30 * k, False))
    rate = 0.05 / s.duration  # at a total of -1 nothing of the body would be left
    add("swelling", "rest", [{"rate": rate}], ("rate", "1/s", rate, -0.8 / s.duration, 2.0 / s.duration, False))
    eta = 0.05 * s.young * s.wave
    add("viscosity_shear", "internal modes", [{"eta": 0.1 * eta}, {"eta": eta}], ("eta", "Pa s", eta, 0.0, 20 * eta, False))
    add("viscosity_bulk", "internal modes", [{"zeta": eta}, {"zeta": 5 * eta}], ("zeta", "Pa s", eta, 0.0, 60 * eta, False))
    add("maxwell", "internal modes", [{"ratio": 0.5, "time": s.wave * f} for f in (0.3, 1.5, 6.0)],
        ("ratio", "1", 0.3, 0.0, 20.0, False), ("time", "s", 0.5, s.step, 20 * s.duration, True),
        sizes="ratio", takes=("young",))  # fmt: skip
    # its Maxwell branches stiffen the body, relative to its modulus, by about twice the loss factor
    add("hysteresis", "internal modes", [{"eta": 0.1}], ("eta", "1", 0.1, 0.0, 1.5, False), beside={"young": -2.0})
    add(
        "stiffness_change",
        "internal modes",
        [{"rate": 0.5 / s.duration}],
        ("rate", "1/s", 0.3 / s.duration, -8 / s.duration, 8 / s.duration, False),
        beside={"young": -0.5 * s.duration},
    )
    add("tension_compression", "internal modes", [{"r": 0.3}], ("r", "1", 0.2, -0.8, 5.0, False), takes=("young",))
    add("stiffness_gradient", "internal modes", [dict.fromkeys("xyz", 0.6)], *vector("xyz", "1", 0.4, 5.0), form="gradient")
    add("stiffness_gradient", "internal modes", _places(experiment, s.length), ("log_ratio", "1", 0.5, -4.0, 4.0, False),
        *[(a, "m", 0.1 * s.length, -0.6 * s.length, 0.6 * s.length, False) for a in ("cx", "cy", "cz")],
        ("radius", "m", 0.15, 0.08 * s.length, 0.8 * s.length, True), form="inclusion", sizes="log_ratio",
        apart="log_ratio", far=math.log(8.0), beside={"young": -1 / 6})  # fmt: skip
    if plastic != "drucker_prager":
        add("strain_stiffening", "internal modes", [{"k": 1.0}], ("k", "1", 1.0, -1.0, 60.0, False), takes=("young",))
        add("second_invariant", "internal modes", [{"c": 0.3}], ("c", "1", 0.3, -0.5, 5.0, False), takes=("young",))
        add("fibre", "internal modes", [{"c": 0.3 * s.young, "azimuth": a, "elevation": e} for a, e in DIRECTIONS],
            ("c", "Pa", 0.3 * s.young, 0.0, 30 * s.young, False), ("azimuth", "rad", 0.2, -7.0, 7.0, False),
            ("elevation", "rad", 0.2, -3.5, 3.5, False), sizes="c", takes=("young",))  # fmt: skip
        add("softening", "internal modes" if plastic == "identity" else "rest", [{"s": 1.0}], ("s", "1", 0.5, 0.0, 40.0, False))
    if planes:
        least = min(p.friction for p in planes)
        add("friction", "contact", [{"mu": 0.15}, {"mu": 0.5}], ("mu", "1", 0.1, -least, 3.0, False), linear=False)
        # rate times substep: half of the speed lost in one substep is much, and above 10 no speed is left and the slope is zero
        rates = [0.02 / s.step, 0.2 / s.step]
        rate = ("rate", "1/s", 1.0, 1e-4 / s.step, 200 / s.step, True)
        for name in ("stick", "restitution"):
            add(name, "contact", [{"rate": r} for r in rates], rate, sizes="rate", linear=False, saturates=True)
    if plastic == "identity":
        # at large yield stresses nothing yields and the slope is zero, so that fits start at yield stresses that are reached
        starts = [{"inverse": 1.0 / (f * s.young)} for f in (0.2, 0.08, 0.03, 0.012)]
        add("yield", "rest", starts, ("inverse", "1/Pa", 0.3, 1e-9 / s.young, 1.0 / (0.001 * s.young), True), sizes="inverse", linear=False)
    if plastic == "von_mises":
        h = 0.1 * s.young
        for name in ("hardening", "kinematic_hardening"):
            add(name, "rest", [{"h": h}, {"h": 5 * h}], ("h", "Pa", h, 0.0, 100 * h, False), takes=("yield_stress",))
        eta = float(experiment.model["plasticity"]["yield_stress"]) * s.duration
        starts = [{"eta": 0.2 * eta}, {"eta": 0.02 * eta}]
        add("rate_yield", "rest", starts, ("eta", "Pa s", 0.1 * eta, 0.0, 20 * eta, False), takes=("yield_stress",))
    if plastic == "drucker_prager":
        c = 0.3 * float(experiment.model["density"]) * g * s.length
        add("cohesion", "rest", [{"c": c}], ("c", "Pa", c, 0.0, 100 * c, False))
    return tuple(out)


_UP = math.atan(math.sqrt(0.5))
DIRECTIONS = ((0.0, 0.0), (0.0, math.pi / 2), (math.pi / 2, 0.0), (0.0, math.pi / 4), (0.0, -math.pi / 4), (math.pi / 2, math.pi / 4),
              (math.pi / 2, -math.pi / 4), (math.pi / 4, 0.0), (-math.pi / 4, 0.0), (math.pi / 4, _UP), (math.pi / 4, -_UP),
              (-math.pi / 4, _UP), (-math.pi / 4, -_UP))  # fmt: skip
"""Azimuth and elevation [rad] of the fibre directions where fits start: axes, diagonals of the faces, diagonals of the cube."""


def _places(experiment: Experiment, length: float) -> list[dict[str, float]]:
    """Return starts of an inclusion: balls around those points of a 3 x 3 x 3 lattice that lie inside the body of size `length` [m]."""
    x = next(r for r in experiment.recordings if r.role == "fit").body.x.double().numpy()
    mean, half = x.mean(axis=0), 0.5 * np.ptp(x, axis=0)
    middle = 0.5 * (x.min(axis=0) + x.max(axis=0))
    spacing = (np.prod(2 * half) / len(x)) ** (1 / 3)
    out = []
    for i in np.ndindex(3, 3, 3):
        place = middle + 0.55 * half * (np.array(i) - 1)
        if np.linalg.norm(x - place, axis=1).min() < 1.5 * spacing:
            c = place - mean
            # the border is one particle spacing wide: at a sharp one, particles would switch one by one and the slope would be zero
            out.append(
                {"log_ratio": 1.0, "cx": float(c[0]), "cy": float(c[1]), "cz": float(c[2]), "radius": 0.3 * length, "width": float(spacing)}
            )
    return out


def present(candidates: Sequence[Candidate], effects: Mapping[str, float]) -> tuple[Candidate, ...]:
    """Return the candidates with effects that the model declares already: a declared value is the one that counts as absent."""

    def own(p: Parameter) -> Parameter:
        value = effects.get(p.name, p.value)
        return replace(p, value=value, lower=min(p.lower, value), upper=max(p.upper, value))

    return tuple(replace(c, parameters=tuple(own(p) for p in c.parameters)) for c in candidates)


def effects_of(
    points: Sequence[Mapping[str, float]], x: torch.Tensor, scene: torch.Tensor, duration: float, *, always: Sequence[str] = ()
) -> Effects:
    """Build the effects of a rollout from several parameter sets, one scene each.

    Args:
        points: Complete parameter sets. Names with a dot belong to effects.
        x: Particles at the start [m], (P, 3), for effects that depend on the place in the body.
        scene: Parameter set that each particle belongs to, (P,).
        duration: Time over which the knots of a time-dependent force are spread [s].
        always: Names that are included even if absent in all sets, so that one captured launch serves every set of effects.
    """
    names = sorted({name for point in points for name in point if "." in name}.union(always))
    rows = {name: [point.get(name, REST.get(name, 0.0)) for point in points] for name in names}
    active = {name.split(".")[0] for name in names if name in always or any(point.get(name) for point in points)}
    values: dict[str, torch.Tensor] = {
        name: torch.tensor(row, dtype=torch.float64) for name, row in rows.items() if name.split(".")[0] in active
    }
    interval = max(values.pop("time_force.interval", torch.zeros(1)).tolist())  # of a declared force, the same in all sets
    waves = {name: values.pop(name) for name in [n for n in values if n.startswith("time_force.") and not n[-1].isdigit()]}
    made = Effects.of(values, x=x, scene=scene)
    if made.time_force is not None and made.time_force_interval is None:
        made = made._replace(time_force_interval=interval or duration / (KNOTS - 1))
    if waves:
        made = _with_waves(made, waves, duration)
    return made


def _with_waves(made: Effects, waves: Mapping[str, torch.Tensor], duration: float) -> Effects:
    """Add harmonic accelerations s sin(2 pi f t) + c cos(2 pi f t), sampled at knots that resolve the highest frequency."""
    zero = torch.zeros_like(next(iter(waves.values())))
    frequency = waves.get("time_force.frequency", zero)
    count = int(min(max(16 * float(frequency.max()) * duration, 32), 512)) + 1
    t = torch.linspace(0.0, duration, count, dtype=torch.float64)
    phase = 2 * math.pi * frequency[:, None] * t
    parts = [
        waves.get(f"time_force.s{a}", zero)[:, None] * phase.sin() + waves.get(f"time_force.c{a}", zero)[:, None] * phase.cos()
        for a in "xyz"
    ]
    knots = torch.stack(parts, -1)
    if made.time_force is not None and made.time_force_interval is not None:  # other parameter sets of the launch have a force at knots
        own = torch.as_tensor(made.time_force).double().expand(len(zero), -1, 3)
        at = (t / float(made.time_force_interval)).clamp(max=own.shape[1] - 1)
        left = at.floor().long().clamp(max=own.shape[1] - 2)
        share = (at - left)[None, :, None]
        knots = knots + (1 - share) * own[:, left] + share * own[:, left + 1]
    return made._replace(time_force=knots, time_force_interval=duration / (count - 1))
