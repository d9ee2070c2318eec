"""How the nuisances of a recording begin a motion, and how it is seen: in flight, on a pendulum, spring, axis or plane."""

import math
from collections.abc import Mapping, Sequence

import numpy as np

from neuido.data.measured.track import AXES, Constraint, Track
from neuido.discrepancy.problems.problem import Parameter

VELOCITY_FRAMES = 4
"""Number of frames for the first estimate of the velocity."""
NEAR = 0.1
"""Relative standard deviation of the distance of a tracked point from its pivot, about the declared length of the pendulum."""
BEYOND = 5.0
"""Half the range of a velocity, in standard deviations of its first estimate, and the same of a displacement that is seen."""
Values = Mapping[str, np.ndarray]
"""Nuisances of P parameter sets by their names without that of the recording, (P,) each."""


class Guide:
    """Free flight: position and velocity along each measured axis begin the motion.

    Args:
        track: The recording.
        sigma: Standard deviation of its noise, in the unit of its data.
        pull: Acceleration that may change the velocity within the first frames, in the unit of the data per s^2.
    """

    def __init__(self, track: Track, sigma: float, pull: float) -> None:
        self.track, self.sigma, self.pull = track, sigma, pull
        self.axes = list(track.axes)
        n = min(VELOCITY_FRAMES, len(track.t))
        span = float(track.t[n - 1] - track.t[0])
        self.slope = np.polyfit(track.t[:n] - track.t[0], track.x[:n], 1)[0]
        self.extent = max(float(np.ptp(track.x)), 10 * sigma)
        # noise and acceleration alone change the slope of the first frames by this much
        self.spread = float(np.hypot(2 * sigma / span, max(pull, 1e-3) * span))

    release: float | None = None
    """Time at which a hand is seen to let go [s]; None where the first frames do not show it."""

    def thrown(self) -> "Guide":
        """Take the velocity from where the body is seen to move, if a hand held it before and no force explains the change."""
        moved = np.linalg.norm(self.track.x - np.median(self.track.x[:3], axis=0), axis=1)
        first = int(np.argmax(moved > BEYOND * self.sigma))
        rows = slice(first, first + VELOCITY_FRAMES)
        if first and len(t := self.track.t[rows]) == VELOCITY_FRAMES:
            slope = np.polyfit(t - t[0], self.track.x[rows], 1)[0]
            noise = 2 * self.sigma / float(t[-1] - t[0])
            if np.linalg.norm(slope - self.slope) > BEYOND * noise + self.pull * float(t[0] - self.track.t[0]):
                self.slope, self.release = slope, float(self.track.t[first - 1])
        return self

    def parameters(self) -> list[Parameter]:
        """Return the parameters that begin a motion."""
        names = ["angle"] if self.track.angle else [f"position_{AXES[a]}" for a in self.axes]
        rates = ["rate"] if self.track.angle else [f"velocity_{AXES[a]}" for a in self.axes]
        at = np.median(self.track.x[:3], axis=0)
        return [self.place(name, float(x)) for name, x in zip(names, at, strict=True)] + [
            self.speed(name, float(v)) for name, v in zip(rates, self.slope, strict=True)
        ]

    def begin(self, values: Values) -> tuple[np.ndarray, np.ndarray]:
        """Return position and velocity at the release, (P, 3) each."""
        x, v = (np.zeros((len(next(iter(values.values()))), 3)) for _ in "xv")
        for a in self.axes:
            x[:, a], v[:, a] = values[f"position_{AXES[a]}"], values[f"velocity_{AXES[a]}"]
        return x, v

    def seen(self, moved: np.ndarray, values: Values) -> np.ndarray:
        """Return the measured coordinates (P, n, A) of a motion (P, n, 3)."""
        return moved[..., self.axes]

    def place(self, name: str, at: float) -> Parameter:
        """Return the parameter of a coordinate, in the unit of the data."""
        step = max(3 * self.sigma, 1e-3 * self.extent)
        return Parameter(f"{name}:{self.track.name}", self.unit, at, step, at - self.extent, at + self.extent)

    def speed(self, name: str, at: float) -> Parameter:
        """Return the parameter of a velocity, in the unit of the data per second."""
        low, high = at - BEYOND * self.spread, at + BEYOND * self.spread
        return Parameter(f"{name}:{self.track.name}", f"{self.unit}/s", at, self.spread / 4, low, high, prior=4.0)

    @property
    def unit(self) -> str:
        """Unit of the data."""
        return "rad" if self.track.angle else "m"


class Rolling(Guide):
    """A point that rolls on a plane: its velocity has no component along the normal.

    Args:
        track: The recording.
        sigma: Standard deviation of its noise [m].
        pull: See `Guide`.
        normal: Unit normal of the plane, (3,).
    """

    def __init__(self, track: Track, sigma: float, pull: float, normal: np.ndarray) -> None:
        super().__init__(track, sigma, pull)
        plane = np.linalg.svd(normal[None])[2][1:].T  # two directions in the plane, (3, 2)
        self.within = plane @ np.linalg.pinv(plane[self.axes])  # (3, A)

    def begin(self, values: Values) -> tuple[np.ndarray, np.ndarray]:
        x, v = super().begin(values)
        return x, v[:, self.axes] @ self.within.T


class Sprung(Guide):
    """A mass on a spring, or a body that an axis turns back: the coordinate counts from the place of rest."""

    def parameters(self) -> list[Parameter]:
        low, high = self.track.x.min(), self.track.x.max()
        return [*super().parameters(), self.place("rest", 0.5 * float(low + high))]

    def begin(self, values: Values) -> tuple[np.ndarray, np.ndarray]:
        at, rate = (np.zeros((len(values["rest"]), 3)) for _ in "xv")
        names = ("angle", "rate") if self.track.angle else (f"position_{AXES[self.axes[0]]}", f"velocity_{AXES[self.axes[0]]}")
        at[:, 0], rate[:, 0] = values[names[0]] - values["rest"], values[names[1]]
        return at, rate

    def seen(self, moved: np.ndarray, values: Values) -> np.ndarray:
        return moved[..., :1] + values["rest"][:, None, None]


class Turning(Guide):
    """A body on an axis that nothing turns back: its angle alone."""

    def begin(self, values: Values) -> tuple[np.ndarray, np.ndarray]:
        x, v = (np.zeros((len(values["angle"]), 3)) for _ in "xv")
        x[:, 0], v[:, 0] = values["angle"], values["rate"]
        return x, v


class Swinging(Guide):
    """A pendulum: its arc is the first coordinate of the motion, and its angle, or two coordinates of a point on it, are seen.

    Args:
        track: The recording.
        sigma: Standard deviation of its noise, in the unit of its data.
        length: Length of the pendulum in each of P parameter sets [m]; `begin` and `seen` take it from the values `length`.
        gravity: Gravity [m/s^2], (3,).
    """

    def __init__(self, track: Track, sigma: float, length: float, gravity: Sequence[float]) -> None:
        self.down = int(np.argmax(np.abs(gravity)))
        self.up = -math.copysign(1.0, gravity[self.down])
        self.length = length
        super().__init__(track, sigma, float(np.linalg.norm(gravity)) / (length if track.angle else 1.0))
        if not track.angle:
            self.level = next(column for column, a in enumerate(self.axes) if a != self.down)
            self.upright = self.axes.index(self.down)

    def parameters(self) -> list[Parameter]:
        if self.track.angle:
            low, high = self.track.x.min(), self.track.x.max()
            middle = 0.5 * float(low + high)
            zero = self.place("zero", middle if abs(middle) < 0.5 * (high - low) else 0.0)
            return [*super().parameters(), zero]
        pivot, radius = self.circle()
        name = self.track.name
        angle = np.unwrap(np.arctan2(self.track.x[:, self.level] - pivot[0], self.up * (pivot[1] - self.track.x[:, self.upright])))
        n = min(VELOCITY_FRAMES, len(angle))
        rate, spread = float(np.polyfit(self.track.t[:n], angle[:n], 1)[0]), self.spread / radius
        step = max(3 * self.sigma, 1e-3 * self.extent)
        out = [Parameter(f"angle:{name}", "rad", float(np.median(angle[:3])), step / radius, float(angle[0]) - 1.0, float(angle[0]) + 1.0)]
        out += [Parameter(f"rate:{name}", "rad/s", rate, spread / 4, rate - BEYOND * spread, rate + BEYOND * spread, prior=4.0)]
        for key, at in zip("lu", pivot):
            label = "pivot_level" if key == "l" else "pivot_up"
            out.append(Parameter(f"{label}:{name}", "m", float(at), step, float(at) - self.length, float(at) + self.length))
        sd = NEAR * self.length
        out.append(Parameter(f"radius:{name}", "m", self.length, sd / 4, 0.3 * self.length, 3 * self.length, prior=4.0))
        return out

    def circle(self) -> tuple[np.ndarray, float]:
        """Return the pivot (2,), level and upright, and the distance of the point from it, nearly the declared length."""
        x, y = self.track.x[:, self.level], self.track.x[:, self.upright]
        side = np.median([x.min(), x.max()])
        lowest = np.min(self.up * y)
        return np.array([side, self.up * (lowest + self.length)]), self.length

    def begin(self, values: Values) -> tuple[np.ndarray, np.ndarray]:
        x, v = (np.zeros((len(values["angle"]), 3)) for _ in "xv")
        zero = values.get("zero", 0.0)
        x[:, 0], v[:, 0] = values["length"] * (values["angle"] - zero), values["length"] * values["rate"]
        return x, v

    def seen(self, moved: np.ndarray, values: Values) -> np.ndarray:
        angle = moved[..., 0] / values["length"][:, None]
        if self.track.angle:
            return (angle + values["zero"][:, None])[..., None]
        radius = values["radius"][:, None]
        columns = {self.level: values["pivot_level"][:, None] + radius * np.sin(angle)}
        columns[self.upright] = values["pivot_up"][:, None] - self.up * radius * np.cos(angle)
        return np.stack([columns[i] for i in sorted(columns)], axis=-1)


def guide_of(track: Track, constraint: Constraint | None, sigma: float, gravity: Sequence[float], stiffness: float) -> Guide:
    """Return the guide of a recording.

    Args:
        track: The recording.
        constraint: What guides the body; None: it flies.
        sigma: Standard deviation of the noise, in the unit of the data.
        gravity: Gravity [m/s^2], (3,).
        stiffness: Squared angular frequency of a spring or an axis [1/s^2].
    """
    kind = None if constraint is None else constraint.type
    size = float(np.linalg.norm(gravity))
    if kind == "pendulum":
        return Swinging(track, sigma, constraint.figures["length"], gravity)
    if kind == "spring" or (kind == "axis" and stiffness > 0):
        return Sprung(track, sigma, max(stiffness, 1.0) * float(np.ptp(track.x)))
    if kind == "axis":
        return Turning(track, sigma, float(np.ptp(track.x)) / max(float(np.ptp(track.t)), 1e-9) ** 2)
    if kind == "plane":
        return Rolling(track, sigma, size, normal_of(constraint, gravity))
    return Guide(track, sigma, size).thrown()


def normal_of(constraint: Constraint | None, gravity: Sequence[float]) -> np.ndarray:
    """Return the unit normal of a plane or floor, (3,): the declared one, or the direction against gravity; +y without gravity."""
    if constraint is not None and constraint.normal is not None:
        return np.array(constraint.normal)
    size = float(np.linalg.norm(gravity))
    return -np.array(gravity) / size if size > 0 else np.array([0.0, 1.0, 0.0])
