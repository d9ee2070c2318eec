"""Random undeclared effects of a case: all effects of the library and some outside it, with random parameters, scaled until they show."""

import math
from collections.abc import Callable, Mapping
from typing import NamedTuple

import numpy as np

from neuido.physics.effects.parameters import LIBRARY
from neuido.physics.effects.point_library import POINT_ENTRIES

ELASTIC, PLASTIC, GRAINS = "identity", "von_mises", "drucker_prager"
ANY, SOLID = (ELASTIC, PLASTIC, GRAINS), (ELASTIC, PLASTIC)
KNOTS = 5


class Scales(NamedTuple):
    """Typical scales of a case, which set the initial size of an effect."""

    young: float
    density: float
    length: float
    """Largest extent of the body [m]."""
    half: np.ndarray
    """Half the extents of the body [m], (3,)."""
    centre: np.ndarray
    """Centre of the body at t = 0 of the first recording [m], (3,)."""
    duration: float
    speed: float
    dt: float
    dx: float
    yield_stress: float

    @property
    def wave(self) -> float:
        """Travel time of a shear wave through the body [s]."""
        return self.length * math.sqrt(2.6 * self.density / self.young)


class Drawn(NamedTuple):
    """An effect with random values of its parameters."""

    kind: str
    values: dict[str, float]
    """Values of the parameters by flat names."""
    sizes: tuple[str, ...]
    """Names of the parameters that are zero without the effect; they are scaled together."""
    smallest: float
    largest: float
    """Range of the scale factor of the sizes."""

    def scaled(self, factor: float) -> "Drawn":
        """Multiply the sizes of the effect by `factor`."""
        values = {name: value * factor if name in self.sizes else value for name, value in self.values.items()}
        return self._replace(values=values, smallest=self.smallest / factor, largest=self.largest / factor)

    def rounded(self, digits: int = 4) -> "Drawn":
        """Round the parameters to significant digits."""
        return self._replace(values={name: float(f"{value:.{digits}g}") for name, value in self.values.items()})


class Kind(NamedTuple):
    """Definition of one kind of effect."""

    draw: Callable[[np.random.Generator, Scales], tuple[dict[str, float], str, float, float]]
    """Draws values by parameter, names of the sizes separated by spaces, and the smallest and largest scale factor."""
    models: tuple[str, ...]
    """Declared plasticities that the effect can be combined with."""
    stage: str
    """Part of the motion in which the effect acts: flight, contact or material."""
    names: tuple[str, ...]
    """Names that a diagnosis may give, because they produce the same motion."""
    meaning: str
    """The effect in words or as an equation."""
    directed: bool = False
    """Whether the effect has a direction in the material."""
    outside: bool = False
    """Whether the effect is outside the library."""
    near: tuple[str, ...] = ()
    """For an effect outside the library: the effects of the library that resemble it."""
    grid: bool = False
    """Whether the effect acts on the grid or between substeps, so that finite elements do not support it equally."""
    units: Mapping[str, str] = {}
    """Unit of each parameter, for an effect outside the library."""


def _direction(rng: np.random.Generator, *, level: bool = False) -> np.ndarray:
    d = rng.normal(size=3) * ([1.0, 0.25, 1.0] if level else 1.0)
    return d / np.linalg.norm(d)


def _sign(rng: np.random.Generator, negative: float = 0.5) -> float:
    return -1.0 if rng.random() < negative else 1.0


def _xyz(v: np.ndarray, names: str = "xyz") -> dict[str, float]:
    return dict(zip(names.split() if " " in names else names, map(float, v), strict=True))


def _vector(size: Callable[[Scales], float], largest: float, *, level: bool = False):
    return lambda rng, s: (_xyz(size(s) * _direction(rng, level=level)), "x y z", 0.05, largest)


def _scalar(name: str, size: Callable[[Scales], float], largest: float, *, smallest: float = 0.02, negative: float = 0.0, low: float = 1.0):
    """Return a function that draws one parameter; a negative size may reach the fraction `low` of `largest`."""

    def draw(rng: np.random.Generator, s: Scales):
        sign = _sign(rng, negative) if negative else 1.0
        return {name: sign * size(s)}, name, smallest, largest * (low if sign < 0 else 1.0)

    return draw


def _place(rng: np.random.Generator, s: Scales):
    offset = _direction(rng) * rng.uniform(0.15, 0.35)
    return {"k": _sign(rng, 0.3) * 4.0 / s.duration**2, **_xyz(s.centre + offset)}, "k", 0.02, 4.0


def _pulse(rng: np.random.Generator, s: Scales):
    waves = rng.choice([1.0, 1.5, 2.0])
    d = 2.0 * _direction(rng, level=True)
    knots = {f"{a}{j}": float(d[i] * math.sin(math.pi * waves * (j + 0.5) / KNOTS)) for j in range(KNOTS) for i, a in enumerate("xyz")}
    return {**knots, "interval": s.duration / (KNOTS - 1)}, " ".join(knots), 0.02, 4.0


def _viscous(name: str, share: float, relative: float):
    def draw(rng: np.random.Generator, s: Scales):
        largest = relative * s.density * s.dx**2 / s.dt  # stability limit of an explicit substep, on finer cells too
        size = min(share * s.young * s.wave, 0.5 * largest)
        return {name: size}, name, 0.01, largest / size

    return draw


def _maxwell(rng: np.random.Generator, s: Scales):
    return {"ratio": 0.5, "time": s.wave * 10 ** rng.uniform(-0.4, 0.5)}, "ratio", 0.05, 6.0


def _gradient(rng: np.random.Generator, s: Scales):
    return _xyz(_direction(rng)), "x y z", 0.2, 2.6


def _inclusion(rng: np.random.Generator, s: Scales):
    centre = rng.uniform(-0.5, 0.5, 3) * s.half
    log = {"log_ratio": _sign(rng, 0.3)}
    return {**log, **_xyz(centre, "cx cy cz"), "radius": rng.uniform(0.25, 0.36) * s.length, "width": 0.0}, "log_ratio", 0.3, 2.7


def _fibre(rng: np.random.Generator, s: Scales):
    d = _direction(rng)
    angles = {"azimuth": math.atan2(d[2], d[0]), "elevation": math.asin(np.clip(d[1], -1, 1))}
    return {"c": 0.5 * s.young, **angles}, "c", 0.05, 10.0


def _magnet(rng: np.random.Generator, s: Scales):
    place = s.centre + np.array([rng.uniform(-0.1, 0.1), -s.half[1] - rng.uniform(0.15, 0.25), rng.uniform(-0.1, 0.1)])
    return {"m": _sign(rng, 0.3) * 0.02, **_xyz(place)}, "m", 0.02, 8.0


def _delayed(rng: np.random.Generator, s: Scales):
    offset = _direction(rng, level=True) * rng.uniform(0.05, 0.12)
    return {"k": 6.0 / s.duration**2, "delay": rng.uniform(0.06, 0.12), **_xyz(s.centre + offset)}, "k", 0.02, 8.0


def _floor(rng: np.random.Generator, s: Scales):
    return {"amplitude": 0.005, "frequency": rng.uniform(3.0, 9.0)}, "amplitude", 0.1, 5.0


GRAVITY_ALIKE = ("gravity", "uniform_acceleration")
KINDS: dict[str, Kind] = {
    "gravity": Kind(_scalar("g", lambda s: 1.0, 4.0, negative=0.5), ANY, "flight", GRAVITY_ALIKE, "the size of gravity is another"),
    "uniform_acceleration": Kind(_vector(lambda s: 1.0, 3.5, level=True), ANY, "flight", ("uniform_acceleration",), "wind or tilt"),
    "drag_linear": Kind(_scalar("k", lambda s: 0.4 / s.duration, 8.0), ANY, "flight", ("drag_linear",), "acceleration -k v"),
    "drag_quadratic": Kind(_scalar("k", lambda s: 0.4 / (s.duration * s.speed), 8.0), ANY, "flight", ("drag_quadratic",), "-k |v| v"),
    "magnus": Kind(_vector(lambda s: 0.5 / s.duration, 6.0), ANY, "flight", ("magnus",), "acceleration w x v"),
    "position_force": Kind(_place, ANY, "flight", ("position_force",), "acceleration -k (x - centre)"),
    "time_force": Kind(_pulse, ANY, "flight", ("time_force",), "an acceleration that varies with time, linear between knots"),
    "added_mass": Kind(_scalar("c", lambda s: 0.2, 4.0, negative=0.3, low=0.35), ANY, "flight", ("added_mass",), "inertia (1 + c) fold"),
    "viscosity_shear": Kind(_viscous("eta", 0.03, 0.2), ANY, "material", ("viscosity_shear",), "Cauchy stress 2 eta D"),
    "viscosity_bulk": Kind(_viscous("zeta", 0.2, 0.4), ANY, "material", ("viscosity_bulk",), "Cauchy stress zeta tr(D) I"),
    "maxwell": Kind(_maxwell, SOLID, "material", ("maxwell",), "a parallel branch that relaxes"),
    "hysteresis": Kind(_scalar("eta", lambda s: 0.2, 3.0, smallest=0.1), SOLID, "material", ("hysteresis",), "loss at any rate"),
    "strain_stiffening": Kind(_scalar("k", lambda s: 2.0, 10.0), (ELASTIC,), "material", ("strain_stiffening",), "stiffer at large strain"),
    "second_invariant": Kind(_scalar("c", lambda s: 0.5, 6.0), (ELASTIC,), "material", ("second_invariant",), "Mooney's second term"),
    "tension_compression": Kind(_scalar("r", lambda s: 0.5, 8.0, negative=0.3, low=0.15), (ELASTIC,), "material", ("tension_compression",),
                                "another stiffness in compression"),
    "fibre": Kind(_fibre, (ELASTIC,), "material", ("fibre",), "one direction is stiffer", directed=True),
    "yield": Kind(_scalar("inverse", lambda s: 1 / (0.1 * s.young), 12.0, smallest=0.2), (ELASTIC,), "material", ("yield",),
                  "von Mises flow"),
    "hardening": Kind(_scalar("h", lambda s: 0.3 * s.young, 8.0), (PLASTIC,), "material", ("hardening",), "yield stress + h alpha"),
    "kinematic_hardening": Kind(_scalar("h", lambda s: 0.3 * s.young, 8.0), (PLASTIC,), "material", ("kinematic_hardening",), "backstress"),
    "softening": Kind(_scalar("s", lambda s: 1.0, 12.0), SOLID, "material", ("softening",), "softer after large strain"),
    "rate_yield": Kind(_scalar("eta", lambda s: 0.1 * s.yield_stress * s.duration, 12.0), (PLASTIC,), "material", ("rate_yield",),
                       "overstress"),
    "stiffness_gradient": Kind(_gradient, (ELASTIC,), "material", ("stiffness_gradient",), "elastic stress times exp(s . (X - mean) / L)",
                               directed=True),
    "stiffness_gradient:inclusion": Kind(_inclusion, (ELASTIC,), "material", ("stiffness_gradient",), "a stiffer ball", directed=True),
    "stiffness_change": Kind(_scalar("rate", lambda s: 0.6 / s.duration, 4.0, negative=0.5, low=0.8), (ELASTIC,), "material",
                             ("stiffness_change",), "elastic stress times exp(rate t)"),
    "friction": Kind(_scalar("mu", lambda s: 0.2, 4.0, smallest=0.1), ANY, "contact", ("friction",), "added to the declared coefficient"),
    "stick": Kind(_scalar("rate", lambda s: 0.1 / s.dt, 50.0), SOLID, "contact", ("stick",), "velocity at the floor decays", grid=True),
    "restitution": Kind(_scalar("rate", lambda s: 0.5 / s.dt, 30.0), SOLID, "contact", ("restitution",), "its normal part alone",
                        grid=True),
    "swelling": Kind(_scalar("rate", lambda s: 0.1 / s.duration, 6.0, negative=0.4, low=0.5), SOLID, "material", ("swelling",),
                     "the stress-free size grows as 1 + rate t"),
    "spin_decay": Kind(_scalar("k", lambda s: 0.4 / s.duration, 12.0), ANY, "flight", ("spin_decay",), "torque -k L about the centre"),
    "cohesion": Kind(_scalar("c", lambda s: 0.3 * s.density * 9.8 * s.length, 10.0), (GRAINS,), "material", ("cohesion",), "Coulomb's c"),
}  # fmt: skip
"""Effects of the library, by name."""

OUTSIDE: dict[str, Kind] = {
    "dry_drag": Kind(_scalar("c", lambda s: 1.5, 5.0), SOLID, "flight", (), "acceleration -c v / |v|", outside=True,
                     grid=True,
                     near=("drag_linear", "drag_quadratic"), units={"c": "m/s^2"}),
    "moving_floor": Kind(_floor, SOLID, "contact", (), "the floor is at amplitude (1 - cos(2 pi frequency t))", outside=True,
                         near=("restitution", "time_force"), units={"amplitude": "m", "frequency": "Hz"}),
    "delayed_spring": Kind(_delayed, SOLID, "flight", (), "acceleration -k (x(t - delay) - place) of the centre of mass", outside=True,
                     grid=True,
                           near=("position_force", "time_force"), units={"k": "1/s^2", "delay": "s", "x": "m", "y": "m", "z": "m"}),
    "magnet": Kind(_magnet, SOLID, "flight", (), "acceleration -m (x - place) / |x - place|^5, |x - place| at least 0.08 m", outside=True,
                     grid=True,
                   near=("position_force", "gravity", "uniform_acceleration"), units={"m": "m^4/s^2", "x": "m", "y": "m", "z": "m"}),
    "density_gradient": Kind(_gradient, (ELASTIC,), "material", (), "density times exp(s . (X - mean) / L), the same mass", outside=True,
                             directed=True, near=("stiffness_gradient",), units={"x": "1", "y": "1", "z": "1"}),
}  # fmt: skip
"""Effects that the library cannot express, by name."""


def draw_effect(kind: str, rng: np.random.Generator, scales: Scales) -> Drawn:
    """Draw an effect of a kind with typical values of its parameters."""
    entry = KINDS[kind] if kind in KINDS else OUTSIDE[kind]
    values, sizes, smallest, largest = entry.draw(rng, scales)
    name = kind.partition(":")[0]
    return Drawn(
        kind, {f"{name}.{key}": value for key, value in values.items()}, tuple(f"{name}.{key}" for key in sizes.split()), smallest, largest
    )


ALSO_RIGHT = {"bingham": ("herschel_bulkley",), "power_law": ("herschel_bulkley", "carreau"), "relaxation_spectrum": ("fractional",)}
"""Effects that have another one as a limit, so that their name is right too."""


def truth_entry(drawn: Drawn, *, free: tuple[str, ...] = ()) -> dict:
    """Describe an effect for the list `undeclared` of the key of a case."""
    name = drawn.kind.partition(":")[0]
    entry = next((entry for entry in POINT_ENTRIES if entry.name == name), None)
    if entry is not None:
        values = {key.partition(".")[2]: value for key, value in drawn.values.items()}
        return {
            "kind": name,
            "diagnosis_names": [name, *ALSO_RIGHT.get(name, ())],
            "parameters": values,
            "sizes": [key.partition(".")[2] for key in drawn.sizes],
            "units": {p.name: p.unit for p in entry.parameters if p.name in values},
            "meaning": entry.equation,
            "outside_library": False,
            "near": list(entry.confusions),
        }
    kind = KINDS[drawn.kind] if drawn.kind in KINDS else OUTSIDE[drawn.kind]
    values = {key.partition(".")[2]: value for key, value in drawn.values.items()}
    known = {p.name: p.unit for entry in LIBRARY if entry.name == name for p in entry.parameters}
    units = {key: kind.units.get(key) or known.get(key) or known.get(f"{key[0]}0", "1") for key in values}
    names = kind.names
    if name == "added_mass" and "young" in free:  # a free modulus absorbs the inertia; a smaller weight remains
        names = (*names, *GRAVITY_ALIKE)
    return {
        "kind": drawn.kind,
        "diagnosis_names": list(names),
        "parameters": values,
        "sizes": [key.partition(".")[2] for key in drawn.sizes],
        "units": units,
        "meaning": kind.meaning,
        "outside_library": kind.outside,
        "near": list(kind.near),
    }


MIN_SEPARATION, MAX_SEPARATION = 15.0, 150.0
"""Range of the ratio of separation to noise of a case."""
OVER_FLOOR = 2.0
"""Smallest ratio of separation to the difference between solvers; a smaller effect cannot be identified."""


class Redraw(Exception):
    """The drawn values make no usable case; draw again."""


def scale_to_separation(drawn: Drawn, target: float, separation: Callable[[Drawn], float], smallest: float) -> Drawn:
    """Scale an effect until it moves the points by about `target`.

    Args:
        drawn: The effect.
        target: Wanted separation, in the unit of the measured values.
        separation: Simulates an effect; returns its separation.
        smallest: Smallest acceptable separation.

    Raises:
        Redraw: The range of the effect allows no separation between `smallest` and twice `target`.
    """
    s = separation(drawn)
    low, high = drawn.smallest, drawn.largest
    factor, slope, previous = 1.0, 1.0, None
    for _ in range(5):
        if 0.85 < s / target < 1.18:
            break
        if previous is not None and s > 0 and previous[1] > 0 and factor != previous[0] and s != previous[1]:
            slope = float(np.clip(math.log(s / previous[1]) / math.log(factor / previous[0]), 0.3, 3.0))
        previous = (factor, s)
        step = (target / s) ** (1 / slope) if s > 0 else 3.0
        factor = float(np.clip(factor * np.clip(step, 1 / 6, 6.0), low, high))
        if factor == previous[0]:
            break
        s = separation(drawn.scaled(factor))
    if not smallest < s < 2.0 * target:
        raise Redraw(f"{drawn.kind} has a separation of {s:.2g}, not {target:.2g}")
    return drawn.scaled(factor)


def rms(d: np.ndarray) -> float:
    """Return the root mean square of all entries."""
    return float(np.sqrt(np.mean(d**2)))


def rounded_to_4(value: float) -> float:
    """Round to four significant digits."""
    return float(f"{value:.4g}")
