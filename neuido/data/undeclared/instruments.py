"""Simulated measurement of a motion: marked points, seen with errors of clock, ruler and launch."""

from collections.abc import Mapping, Sequence
from typing import TypedDict

import numpy as np
import torch

from neuido.data.undeclared.motion import Motion
from neuido.data.undeclared.random_bodies import Launch
from neuido.physics.fem.particle_weights import interpolation_weights

WRONG_NUISANCES = (  # name, unit, standard deviation relative to: frame interval, 1, 1, largest speed, largest speed over size of the body
    ("release_time", "s", 0.1),
    ("time_base", "1", 0.003),
    ("length_scale", "1", 0.003),
    ("velocity", "m/s", 0.005),
    ("spin", "rad/s", 0.01),
)


class Attachment(TypedDict, total=False):
    """How the points of a `Recording` follow the body: one of its fields, by name."""

    track: torch.Tensor
    anchor: torch.Tensor


class Markers:
    """Recorded points of a body: particles, or points attached to the material between particles."""

    def __init__(self, rng: np.random.Generator, points: np.ndarray, count: int) -> None:
        self.glued = rng.random() < 0.4
        self.track = np.sort(rng.permutation(len(points))[:count])
        gap = (np.prod(np.ptp(points, axis=0)) / len(points)) ** (1 / 3)
        self.shift = rng.uniform(-0.4, 0.4, (count, 3)) * gap if self.glued else np.zeros((count, 3))

    def fix(self, launches: Sequence[Launch], points: np.ndarray) -> None:
        """Locate the markers in the launched bodies; `points` (P, 3) is the body about its mean [m]."""
        self.places, self.maps = [], []
        for launch in launches:
            x = launch.centre + points @ launch.rotation.T
            places = launch.centre + (points[self.track] + self.shift) @ launch.rotation.T
            index, weight = interpolation_weights(torch.from_numpy(x), torch.from_numpy(places))
            self.places.append(places)
            self.maps.append((index.numpy(), weight.numpy()))

    def follow(self, x: np.ndarray, recording: int) -> np.ndarray:
        """Compute the positions of the markers (T, N, 3) from those of the particles x (T, P, 3) of a recording."""
        if not self.glued:
            return x[:, self.track]
        index, weight = self.maps[recording]
        return np.einsum("nk,tnkc->tnc", weight, x[:, index])

    def named(self, recording: int) -> Attachment:
        """Return the field `track` or `anchor` of a `Recording`, which says how its points follow the body."""
        if self.glued:
            return {"anchor": torch.from_numpy(self.places[recording]).float()}
        return {"track": torch.from_numpy(self.track.astype(np.int64))}


def wrong_nuisances(rng: np.random.Generator, plain: np.ndarray, interval: float, length: float) -> list[dict[str, float]]:
    """Draw measurement errors of two recordings.

    Args:
        rng: Random generator.
        plain: Positions without errors [m], (2, T, N, 3).
        interval: Time between frames [s].
        length: Size of the body [m].

    Returns:
        For each recording, the errors by nuisance parameter (`WRONG_NUISANCES`); many are zero.
    """
    out = []
    for i in range(2):
        speed = max_speed(plain[i], interval)
        unit = {"release_time": interval, "velocity": speed, "spin": speed / length}
        own: dict[str, float] = {}
        for name, _, relative in WRONG_NUISANCES:
            for axis in ("",) if name not in ("velocity", "spin") else ("_x", "_y", "_z"):
                size = rng.choice([-1.0, 1.0]) * rng.uniform(0.7, 2.0) if rng.random() < 0.6 else 0.0
                own[f"{name}{axis}"] = float(f"{size * relative * unit.get(name, 1.0):.4g}")
        out.append(own)
    return out


def measured_positions(motion: Motion, markers: Markers, i: int, at: np.ndarray, off: Mapping[str, float]) -> np.ndarray:
    """Return the measured positions (T, N, 3) of recording `i` at the times `at` [s], with the errors `off` of clock and ruler."""
    place, _ = motion.at(at * (1 + off.get("time_base", 0.0)) + off.get("release_time", 0.0), i)
    x = markers.follow(place, i)
    centre = x[0].mean(axis=0)
    return centre + (1 + off.get("length_scale", 0.0)) * (x - centre)


def nuisance_vector(own: Mapping[str, float], name: str) -> np.ndarray:
    """Collect the components of `velocity` [m/s] or `spin` [rad/s] from nuisance parameters, (3,)."""
    return np.array([own[f"{name}_{a}"] for a in "xyz"])


def max_speed(x: np.ndarray, interval: float) -> float:
    """Return the largest speed [m/s] of the mean of points x (T, N, 3) [m] between frames."""
    return float(np.linalg.norm(np.diff(x.mean(axis=1), axis=0), axis=1).max() / interval)
