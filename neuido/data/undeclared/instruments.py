"""What instruments see of a motion: marked points, with a clock, a ruler and a launch that may be off."""

from collections.abc import Mapping, Sequence

import numpy as np
import torch

from neuido.data.undeclared.motion import Motion
from neuido.data.undeclared.random_bodies import Launch
from neuido.physics.fem.meshing import follow

WRONG_NUISANCES = (  # name, unit, standard deviation: of the frame interval, of one, of the fastest speed, of that over the body's size
    ("release_time", "s", 0.1),
    ("time_base", "1", 0.003),
    ("length_scale", "1", 0.003),
    ("velocity", "m/s", 0.005),
    ("spin", "rad/s", 0.01),
)


class Markers:
    """The recorded points: particles, or places glued to the material."""

    def __init__(self, rng: np.random.Generator, points: np.ndarray, count: int) -> None:
        self.glued = rng.random() < 0.4
        self.track = np.sort(rng.permutation(len(points))[:count])
        gap = (np.prod(np.ptp(points, axis=0)) / len(points)) ** (1 / 3)
        self.shift = rng.uniform(-0.4, 0.4, (count, 3)) * gap if self.glued else np.zeros((count, 3))

    def fix(self, launches: Sequence[Launch], points: np.ndarray) -> None:
        """Find them in the launched bodies."""
        self.places, self.maps = [], []
        for launch in launches:
            x = launch.centre + points @ launch.rotation.T
            places = launch.centre + (points[self.track] + self.shift) @ launch.rotation.T
            index, weight = follow(torch.from_numpy(x), torch.from_numpy(places))
            self.places.append(places)
            self.maps.append((index.numpy(), weight.numpy()))

    def follow(self, x: np.ndarray, recording: int) -> np.ndarray:
        """Return the markers' positions (T, N, 3) for particles at x (T, P, 3)."""
        if not self.glued:
            return x[:, self.track]
        index, weight = self.maps[recording]
        return np.einsum("nk,tnkc->tnc", weight, x[:, index])

    def named(self, recording: int) -> dict[str, torch.Tensor]:
        """Return `track` or `anchor` of a recording."""
        if self.glued:
            return {"anchor": torch.from_numpy(self.places[recording]).float()}
        return {"track": torch.from_numpy(self.track.astype(np.int64))}


def wrong_nuisances(rng: np.random.Generator, plain: np.ndarray, interval: float, length: float) -> list[dict[str, float]]:
    """Draw the nuisances of two recordings whose motion without nuisances is (2, T, N, 3) [m]."""
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
    """Return the positions that the instruments measure; clock and ruler may be off."""
    place, _ = motion.at(at * (1 + off.get("time_base", 0.0)) + off.get("release_time", 0.0), i)
    x = markers.follow(place, i)
    centre = x[0].mean(axis=0)
    return centre + (1 + off.get("length_scale", 0.0)) * (x - centre)


def nuisance_vector(own: Mapping[str, float], name: str) -> np.ndarray:
    """Return the velocity or the spin of some nuisances."""
    return np.array([own[f"{name}_{a}"] for a in "xyz"])


def max_speed(x: np.ndarray, interval: float) -> float:
    """Return the largest speed of the mean point [m/s], (T, N, 3)."""
    return float(np.linalg.norm(np.diff(x.mean(axis=1), axis=0), axis=1).max() / interval)
