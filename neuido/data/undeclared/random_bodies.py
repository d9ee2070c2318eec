"""Random bodies, launches, materials and scenes of cases with an undeclared effect."""

import math
from typing import Any, NamedTuple

import numpy as np
import torch

from neuido.types import Body, Plane, Scene

SHAPES = ("box", "ball", "cylinder", "ellipsoid", "tee", "angle", "cross", "tube")
FLOORS = (0.13, 0.14, 0.15, 0.16)
WRONG = {"young": (0.6, 1.6), "yield_stress": (0.65, 1.5), "friction_angle": (0.8, 1.25)}
"""Range of the ratio of starting value to true value, by parameter."""


class Launch(NamedTuple):
    """Initial pose and velocity of a body."""

    rotation: np.ndarray
    """Rotation matrix, (3, 3)."""
    centre: np.ndarray
    """Centre of mass [m], (3,)."""
    velocity: np.ndarray
    """Velocity of the centre of mass [m/s], (3,)."""
    gradient: np.ndarray
    """Velocity gradient: spin, stretching and shearing [1/s], (3, 3)."""


class Material(NamedTuple):
    """True material of a body, and its declared parameters."""

    density: float
    elasticity: dict[str, Any]
    plasticity: dict[str, Any]
    free: tuple[str, ...]
    declared: dict[str, float]
    """Starting values of `free`."""

    def model(self) -> dict[str, Any]:
        """Return the key `model` of an experiment file, with the declared parameters."""

        def part(given: dict[str, Any]) -> dict[str, Any]:
            return {key: self.declared.get(key, value) for key, value in given.items()}

        return {"density": self.density, "elasticity": part(self.elasticity), "plasticity": part(self.plasticity)}


def draw_body(rng: np.random.Generator, count: int) -> tuple[str, np.ndarray, float]:
    """Draw a random shape with about `count` particles.

    Returns:
        Name of the shape, particles about their mean (P, 3) [m], and volume of a particle [m^3].
    """
    name = str(rng.choice(SHAPES))
    half = rng.uniform([0.1, 0.08, 0.08], [0.16, 0.13, 0.13])
    if name in ("ball", "cross"):
        half = np.full(3, rng.uniform(0.115, 0.15))
    thick = rng.uniform(0.38, 0.55)  # thickness of the limbs in half widths

    def inside(p: np.ndarray) -> np.ndarray:
        x, y, z = (p / half).T
        limbs = {
            "box": lambda: np.ones(len(p), bool),
            "ball": lambda: x**2 + y**2 + z**2 <= 1,
            "ellipsoid": lambda: x**2 + y**2 + z**2 <= 1,
            "cylinder": lambda: y**2 + z**2 <= 1,
            "tube": lambda: (y**2 + z**2 <= 1) & (y**2 + z**2 >= 0.18),
            "tee": lambda: (y >= 1 - 2 * thick) | (np.abs(x) <= thick),
            "angle": lambda: (y <= 2 * thick - 1) | (x <= 2 * thick - 1),
            "cross": lambda: ((np.abs(x) <= thick).astype(int) + (np.abs(y) <= thick) + (np.abs(z) <= thick)) >= 2,
        }
        return limbs[name]()

    probe = (rng.random((20000, 3)) * 2 - 1) * half
    spacing = (inside(probe).mean() * np.prod(2 * half) / count) ** (1 / 3)
    counts = np.maximum(np.round(2 * half / spacing), 2).astype(int)
    step = 2 * half / counts
    axes = [(np.arange(n) + 0.5) * s - h for n, s, h in zip(counts, step, half)]
    points = np.stack(np.meshgrid(*axes, indexing="ij"), -1).reshape(-1, 3)
    points = points[inside(points)]
    return name, points - points.mean(axis=0), float(np.prod(step))


def draw_launches(
    rng: np.random.Generator,
    points: np.ndarray,
    floor: float,
    seconds: float,
    *,
    turned: bool,
    sliding: bool,
    hard: bool,
    spinning: bool = False,
) -> list[Launch]:
    """Draw two launches of a body above a floor, in opposite directions and with different spins.

    Args:
        rng: Random generator.
        points: The body about its mean [m], (P, 3).
        floor: Height of the floor [m].
        seconds: Duration of the recordings [s].
        turned: Whether the second launch may have another orientation, which an anisotropic material excludes.
        sliding: Whether both launches have a large horizontal speed.
        hard: Whether both launches cause large strains.
        spinning: Whether both launches spin fast.
    """
    side = rng.choice([-1.0, 1.0])
    first = rotation(rng, rng.uniform(0.0, 0.5) if rng.random() < 0.5 else 0.0)
    out = []
    for i in range(2):
        turn = first if i == 0 or not turned else rotation(rng, rng.uniform(0.3, 1.2)) @ first
        low, high = (0.4, 0.85) if sliding else (0.1, 0.6)
        horizontal = np.array([side * rng.uniform(low, high) * (1 - 2 * i), 0.0, rng.uniform(-0.25, 0.25)])
        down = rng.uniform(-0.9, -0.3) if i == 0 else rng.uniform(-1.4, -0.4)
        if hard:
            down = rng.uniform(-1.9, -1.0)
        elif rng.random() < 0.2:
            down = rng.uniform(0.2, 0.7)
        spin = rng.normal(size=3) * (1.0 if i else [0.2, 0.2, 1.0])
        spin *= (3.0 if spinning else 1.0) * rng.uniform(0.5, 3.2) / np.linalg.norm(spin)
        gradient = np.array([[0, -spin[2], spin[1]], [spin[2], 0, -spin[0]], [-spin[1], spin[0], 0]])
        if rng.random() < (0.6 if hard else 0.35):
            stretch = rng.normal(size=(3, 3))
            stretch = stretch + stretch.T
            stretch -= np.trace(stretch) / 3 * np.eye(3)
            gradient = gradient + stretch * rng.uniform(2.0, 4.5) / np.linalg.norm(stretch)
        gap = rng.uniform(0.03, 0.1) if i == 0 else rng.uniform(0.06, 0.17)
        bottom = (points @ turn.T)[:, 1].min()
        centre = np.clip(0.5 - 0.5 * seconds * horizontal, 0.3, 0.7)
        centre[1] = floor + gap - bottom
        out.append(Launch(turn, centre, horizontal + np.array([0.0, down, 0.0]), gradient))
    return out


def rotation(rng: np.random.Generator, angle: float) -> np.ndarray:
    """Draw a rotation matrix (3, 3) by `angle` [rad] about a random axis."""
    a = rng.normal(size=3)
    x, y, z = a / np.linalg.norm(a)
    K = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    return np.eye(3) + math.sin(angle) * K + (1 - math.cos(angle)) * K @ K


def launched_body(
    points: np.ndarray, volume: float, launch: Launch, *, velocity: np.ndarray | None = None, spin: np.ndarray | None = None
) -> Body:
    """Create the body at t = 0 of a launch; `velocity` [m/s] and `spin` [rad/s] are added to those of the launch.

    Args:
        points: The body about its mean [m], (P, 3).
        volume: Volume of a particle [m^3].
        launch: The launch.
        velocity: Additional velocity [m/s], (3,).
        spin: Additional angular velocity [rad/s], (3,).
    """
    arm = points @ launch.rotation.T
    v = launch.velocity + (0.0 if velocity is None else velocity) + arm @ launch.gradient.T
    if spin is not None:
        v = v + np.cross(spin, arm)
    x = torch.tensor(launch.centre + arm, dtype=torch.float32)
    return Body(x, torch.tensor(v, dtype=torch.float32), torch.full((len(x),), volume, dtype=torch.float32))


def draw_material(rng: np.random.Generator, plastic: str, *, soft: bool = False) -> Material:
    """Draw a material with this plasticity, and wrong starting values of its free parameters.

    Args:
        rng: Random generator.
        plastic: identity, von_mises or drucker_prager.
        soft: Whether Young's modulus is below 9e4 Pa.
    """
    wrong: dict[str, float] = {}
    if plastic == "drucker_prager":
        elastic = {"law": "sigma", "young": 2.2e5, "poisson": 0.25}
        flow = {"law": plastic, "friction_angle": float(round(rng.uniform(26.0, 38.0), 1))}
        density, free = 1600.0, ("friction_angle",)
    else:
        law = str(rng.choice(["fixed_corotated", "fixed_corotated", "neo_hookean", "sigma"])) if plastic == "identity" else "sigma"
        elastic = {
            "law": law,
            "young": _digits(np.exp(rng.uniform(np.log(5e4), np.log(9e4 if soft else 1.7e5)))),
            "poisson": _digits(rng.uniform(0.22, 0.36)),
        }
        density = float(rng.choice([400.0, 700.0, 1000.0, 1000.0, 1200.0]))
        flow, free = {"law": "identity"}, ("young", "poisson") if rng.random() < 0.4 else ("young",)
        if plastic == "von_mises":
            flow = {"law": plastic, "yield_stress": _digits(elastic["young"] * rng.uniform(0.025, 0.07))}
            free = ("young", "yield_stress") if rng.random() < 0.5 else ("yield_stress",)
    true = {**elastic, **flow}
    for key in free:
        if key == "poisson":
            wrong[key] = _digits(true[key] + rng.choice([-0.03, 0.03]))
            continue
        low, high = WRONG[key]
        factor = rng.uniform(low, 0.8) if rng.random() < 0.5 else rng.uniform(1.2, high)
        wrong[key] = _digits(true[key] * (min(max(factor, 0.8), 1.25) if key == "friction_angle" else factor))
    return Material(density, elastic, flow, free, wrong)


def draw_scene(rng: np.random.Generator, material: Material, *, slippery: bool = False) -> Scene:
    """Draw the declared scene with the suggested grid and substep; a `slippery` floor has no friction."""
    floor = float(rng.choice(FLOORS))
    sand = material.plasticity["law"] == "drucker_prager"
    mu = 0.4 if sand else 0.0 if slippery else float(rng.choice([0.0, 0.0, 0.2, 0.3]))
    return Scene(
        cells=int(rng.choice([30, 32, 32, 32, 34])),
        dt=2.5e-4 if sand else 5e-4,
        colliders=(Plane((0.0, floor, 0.0), (0.0, 1.0, 0.0), "separate", mu),),
    )


def _digits(value: float, digits: int = 3) -> float:
    return float(f"{value:.{digits}g}")
