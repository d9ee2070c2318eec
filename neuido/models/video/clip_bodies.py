"""Random bodies of the clips: solids given by inequalities and the published bodies, in groups that no two parts of the data share.

An encoder that is trained on the shapes `seen`, and calibrated on `held-out` ones, is scored on `unseen` ones.
"""

import math
from collections.abc import Callable
from functools import lru_cache
from typing import Literal, get_args

import numpy as np

from neuido.data.bodies.particle_volume import body_volume
from neuido.data.bodies.scene_files import data_root
from neuido.data.files.parsing import read_arrays
from neuido.errors import UserError
from neuido.types import Vector

Group = Literal["seen", "held-out", "unseen"]
GROUPS: tuple[str, ...] = get_args(Group)
LARGEST = 0.8
"""Longest side of a body's box [m]: the walls are a metre apart."""
SAMPLES = 20_000
"""Least number of random points of which those inside make the body."""
Inside = Callable[[np.random.Generator, np.ndarray], np.ndarray]


def _ball(random: np.random.Generator, x: np.ndarray) -> np.ndarray:
    return (x**2).sum(1) < 1


def _box(random: np.random.Generator, x: np.ndarray) -> np.ndarray:
    return np.ones(len(x), dtype=bool)


def _cylinder(random: np.random.Generator, x: np.ndarray) -> np.ndarray:
    return _radius(x) < 1


def _cone(random: np.random.Generator, x: np.ndarray) -> np.ndarray:
    top = random.uniform(0, 0.6)
    return _radius(x) < 0.5 * (1 - x[:, 1]) + 0.5 * top * (1 + x[:, 1])


def _torus(random: np.random.Generator, x: np.ndarray) -> np.ndarray:
    tube = random.uniform(0.28, 0.42)
    return (_radius(x) - (1 - tube)) ** 2 / tube**2 + x[:, 1] ** 2 < 1


def _capsule(random: np.random.Generator, x: np.ndarray) -> np.ndarray:
    core = random.uniform(0.2, 0.6)
    return _radius(x) ** 2 + ((np.abs(x[:, 1]) - core).clip(0) / (1 - core)) ** 2 < 1


def _wedge(random: np.random.Generator, x: np.ndarray) -> np.ndarray:
    return x[:, 1] < 1 - 2 * np.abs(x[:, 0] - random.uniform(-0.3, 0.3)).clip(0, 1)


def _dumbbell(random: np.random.Generator, x: np.ndarray) -> np.ndarray:
    end, bar = random.uniform(0.4, 0.55), random.uniform(0.35, 0.6)
    return (_radius(x) ** 2 + ((np.abs(x[:, 1]) - (1 - end)) / end) ** 2 < 1) | ((_radius(x) < bar) & (np.abs(x[:, 1]) < 1 - end))


def _blob(random: np.random.Generator, x: np.ndarray) -> np.ndarray:
    """Return a union of three thick ellipsoids."""
    centres, radii = random.uniform(-0.45, 0.45, (3, 3)), random.uniform(0.35, 0.55, (3, 1, 3))
    return ((((x - centres[:, None]) / radii) ** 2).sum(2) < 1).any(0)


def _limbs(random: np.random.Generator, x: np.ndarray) -> np.ndarray:
    """Return a trunk with four limbs, which bend long before the trunk yields."""
    trunk = ((x / random.uniform(0.3, 0.6, 3)) ** 2).sum(1) < 1
    tips = random.standard_normal((4, 3))
    tips *= random.uniform(0.5, 0.95, (4, 1)) / np.linalg.norm(tips, axis=1, keepdims=True)
    along = np.clip(x @ tips.T / (tips**2).sum(1), 0, 1)
    distance = np.linalg.norm(x[:, None] - along[..., None] * tips, axis=2)
    return trunk | (distance < random.uniform(0.12, 0.3, 4)).any(1)


def _superquadric(random: np.random.Generator, x: np.ndarray) -> np.ndarray:
    """Return a superquadric, from a rounded octahedron to a rounded box."""
    round_, flat = random.uniform(1.2, 6.0, 2)
    across = (np.abs(x[:, 0]) ** round_ + np.abs(x[:, 2]) ** round_) ** (flat / round_)
    return across + np.abs(x[:, 1]) ** flat < 1


def _assembly(random: np.random.Generator, x: np.ndarray) -> np.ndarray:
    """Return turned superquadrics, added to the first one or cut out of it in turn."""
    inside = _part(random, x, 0.45, 0.75, 0.15)
    for _ in range(random.integers(1, 5)):
        part = _part(random, x, 0.2, 0.55, 0.5)
        cut = inside & ~part
        inside = cut if random.random() < 0.35 and cut.sum() > 0.5 * inside.sum() else inside | part
    return inside


def _part(random: np.random.Generator, x: np.ndarray, least: float, largest: float, away: float) -> np.ndarray:
    turn, _ = np.linalg.qr(random.standard_normal((3, 3)))
    return _superquadric(random, (x - random.uniform(-away, away, 3)) @ turn / random.uniform(least, largest, 3))


def _relief(random: np.random.Generator, x: np.ndarray) -> np.ndarray:
    """Return a ball whose radius varies as a sum of waves."""
    waves, phases = random.standard_normal((6, 3)) * random.uniform(1.0, 4.0), random.uniform(0, 2 * math.pi, 6)
    distance = np.linalg.norm(x, axis=1)
    bumps = np.sin(x / distance[:, None].clip(1e-9) @ waves.T + phases).sum(1) / 6
    return distance < 0.65 + random.uniform(0.2, 0.9) * bumps.clip(-0.5, 0.38)


def _pyramid(random: np.random.Generator, x: np.ndarray) -> np.ndarray:
    return np.abs(x[:, [0, 2]]).max(1) < 0.5 * (1 - x[:, 1])


def _cross(random: np.random.Generator, x: np.ndarray) -> np.ndarray:
    arm = random.uniform(0.3, 0.5)
    return np.sort(np.abs(x), axis=1)[:, 1] < arm


def _star(random: np.random.Generator, x: np.ndarray) -> np.ndarray:
    angle = np.arctan2(x[:, 2], x[:, 0])
    return _radius(x) < 0.68 + random.uniform(0.2, 0.3) * np.cos(random.integers(4, 7) * angle)


def _mushroom(random: np.random.Generator, x: np.ndarray) -> np.ndarray:
    cap = (_radius(x) ** 2 + (x[:, 1] / 1.0) ** 2 < 1) & (x[:, 1] > 0)
    return cap | ((_radius(x) < random.uniform(0.3, 0.5)) & (x[:, 1] <= 0))


def _hourglass(random: np.random.Generator, x: np.ndarray) -> np.ndarray:
    waist = random.uniform(0.35, 0.55)
    return _radius(x) < waist + (1 - waist) * x[:, 1] ** 2


def _table(random: np.random.Generator, x: np.ndarray) -> np.ndarray:
    leg = random.uniform(0.35, 0.5)
    return (x[:, 1] > 0.3) | ((np.abs(np.abs(x[:, 0]) - (1 - leg)) < leg) & (np.abs(np.abs(x[:, 2]) - (1 - leg)) < leg))


def _arch(random: np.random.Generator, x: np.ndarray) -> np.ndarray:
    radius = np.hypot(x[:, 0], 0.5 * (x[:, 1] + 1))
    return (radius < 1) & (radius > random.uniform(0.4, 0.55))


def _radius(x: np.ndarray) -> np.ndarray:
    return np.hypot(x[:, 0], x[:, 2])


SOLIDS: dict[str, dict[str, Inside]] = {
    "seen": {"ball": _ball, "box": _box, "cylinder": _cylinder, "cone": _cone, "torus": _torus, "capsule": _capsule, "wedge": _wedge,
             "dumbbell": _dumbbell, "blob": _blob, "limbs": _limbs, "superquadric": _superquadric, "assembly": _assembly,
             "relief": _relief},
    "held-out": {"pyramid": _pyramid, "cross": _cross},
    "unseen": {"star": _star, "mushroom": _mushroom, "hourglass": _hourglass, "table": _table, "arch": _arch},
}  # fmt: skip
"""Solids within the cube [-1, 1]^3 of each group, by name; each has the axis y."""
PUBLISHED: dict[str, tuple[str, ...]] = {
    "seen": ("bouncy-ball", "jelly-duck", "clay-cat", "real-bun", "real-burger", "real-pig"),
    "held-out": ("honey-bottle",),
    "unseen": ("sand-fish", "rubber-pawn", "real-dog"),
}
"""The ten bodies of the literature, of which NEUIDO_DATA has the particles, in each group."""
WEIGHTS = {"blob": 2, "limbs": 4, "superquadric": 2, "assembly": 8, "relief": 4}
"""How much more often than others a kind of solid is drawn: no two assemblies are alike, and limbs bend where a trunk does not."""


def random_body(
    random: np.random.Generator, particles: int, group: str, published: bool, *, fill: int = 0
) -> tuple[str, np.ndarray, float]:
    """Sample a randomly rotated body about the origin.

    Args:
        random: Source of randomness.
        particles: Approximate number of particles P.
        group: Group of shapes: `seen`, `held-out` or `unseen`.
        published: Whether to draw from the ten bodies of the literature too; their particles lie in NEUIDO_DATA.
        fill: Number of the filling: the same body with other particles.

    Returns:
        The name of the shape, the particles (P, 3) [m], and the volume [m^3].

    Raises:
        UserError: The group is unknown, or the particles of a body are missing.
    """
    name = random_shape(random, group, published)
    filling = np.random.default_rng([int(random.integers(2**31)), fill])
    if name in SOLIDS[group]:
        points, volume = _solid(random, filling, name, SOLIDS[group][name], particles)
    else:
        points, volume = _published(name)
        factor = random.uniform(0.35, 0.6) / float(np.ptp(points, axis=0).max())
        points, volume = factor * (points - points.mean(0)), factor**3 * volume
    turn, _ = np.linalg.qr(random.standard_normal((3, 3)))
    points = points @ turn
    factor = min(1.0, LARGEST / float(np.ptp(points, axis=0).max()))
    points, volume = factor * points, factor**3 * volume
    return name, _evenly(points, (volume / particles) ** (1 / 3), filling), volume


def random_shape(random: np.random.Generator, group: str, published: bool) -> str:
    """Sample the name of a shape, as `random_body` does first: a thousandth of the time where the particles are not needed.

    Raises:
        UserError: The group is unknown.
    """
    if group not in GROUPS:
        raise UserError(f"shapes = {group!r}: choose from {', '.join(GROUPS)}")
    names = list(SOLIDS[group]) + (list(PUBLISHED[group]) if published else [])
    weights = np.array([WEIGHTS.get(name, 1.0) for name in names])
    return str(random.choice(names, p=weights / weights.sum()))


def _solid(
    random: np.random.Generator, filling: np.random.Generator, name: str, inside: Inside, particles: int
) -> tuple[np.ndarray, float]:
    """Return random points (N, 3) of a solid of random size, and its volume."""
    half = random.uniform(0.17, 0.3, 3) if name == "limbs" else random.uniform(0.09, 0.24, 3)
    if name == "ball":
        half = np.full(3, half[0])
    if name in ("cone", "torus", "capsule", "dumbbell", "mushroom", "hourglass", "star"):
        half[2] = half[0]  # round
        if name == "torus":
            half[[0, 2]] = random.uniform(0.18, 0.28)
            half[1] = max(half[1], 0.35 * half[0])
    points = filling.uniform(-1, 1, (max(SAMPLES, 25 * particles), 3))
    mask = inside(random, points)
    return points[mask] * half, float(8 * half.prod() * mask.mean())


@lru_cache(maxsize=16)
def _published(name: str) -> tuple[np.ndarray, float]:
    x = read_arrays(data_root() / "scenes" / "particles" / f"{name}.npz", ("x",))["x"].astype(np.float64)
    return x, body_volume(x)


def _evenly(points: np.ndarray, spacing: float, filling: np.random.Generator) -> np.ndarray:
    """Return one of the points (N, 3) of each cell of a grid: even, without the rows of a lattice."""
    place = np.floor(points / spacing + filling.random(3)).astype(np.int64) + 10_000
    return points[np.unique(place @ np.array([10**10, 10**5, 1]), return_index=True)[1]]


def launch(
    random: np.random.Generator, x: np.ndarray, duration: float, speeds: tuple[float, float] = (0.5, 3.0)
) -> tuple[np.ndarray, Vector, Vector]:
    """Sample a drop, a throw or a spinning throw of a body that meets the floor within the first third of a film.

    Args:
        random: Source of randomness.
        x: Particles about the origin [m], (P, 3).
        duration: Length of the film [s].
        speeds: Smallest and largest downward speed of a throw [m/s].

    Returns:
        How far to move the particles above the floor y = 0 [m], (3,), the velocity [m/s] and the angular velocity [rad/s].
    """
    kind = random.choice(["drop", "throw", "spin"], p=[0.2, 0.5, 0.3])
    room = max(0.01, 0.92 - float(np.ptp(x[:, 1])))
    flight = random.uniform(0.05, 0.33) * min(duration, 1.0)
    if kind == "drop":
        height, v = min(0.5 * 9.8 * flight**2, room), (0.0, -random.uniform(0.0, 0.3), 0.0)
    else:
        down, side = random.uniform(*speeds), 0.5 if duration < 0.5 else 1.0
        height = min(down * flight + 0.5 * 9.8 * flight**2, room)
        v = (random.uniform(-side, side), -down, random.uniform(-side, side))
    spin = tuple(random.uniform(-1, 1, 3) * {"drop": 0.0, "throw": 3.0, "spin": 8.0}[kind])
    lift = np.array([0.5, max(height, 0.01) - x[:, 1].min(), 0.5])
    margin = max(0.0, min(0.05, 0.5 * (0.96 - float(np.ptp(x[:, [0, 2]], axis=0).max()))))
    lift[[0, 2]] += random.uniform(-margin, margin, 2) - 0.5 * (x[:, [0, 2]].min(0) + x[:, [0, 2]].max(0))
    return lift, v, spin  # type: ignore[return-value]


def frame_steps(rates: tuple[float, float], limit: float, random: np.random.Generator) -> tuple[float, int]:
    """Draw a frame rate, log-uniformly; return the substep [s] and the number of substeps between frames.

    Args:
        rates: Smallest and largest frame rate [1/s].
        limit: Longest substep [s].
        random: Source of randomness.

    The numbers are few (`STEPS`), so that clips of different rates may share a launch.
    """
    interval = 1 / math.exp(random.uniform(math.log(rates[0]), math.log(rates[1])))
    needed = interval / limit
    steps = next((n for n in STEPS if n >= needed), math.ceil(needed))
    return interval / steps, steps


STEPS = (4, 6, 8, 12, 16, 24, 32, 48, 64, 96)
"""Numbers of substeps between frames that are drawn."""
