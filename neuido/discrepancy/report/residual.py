"""The weak residual of a body's motion, divided into stages: flight, contact, rotation, internal modes, power and rest.

The weak residual tests the balance of momentum with a field w over the body times a bump phi(t). The bump and its slope vanish at both
ends. Integration by parts moves both time derivatives to the bump, so that measured positions are never differentiated:

    R[w, phi] = sum_p m_p w_p . INT x_p phi'' dt + sum_p V_p INT phi P_p : grad w_p dt - sum_p m_p w_p . INT phi b dt,

which is zero where nothing is missing. Its variance by noise is sigma^2 sum_p m_p^2 |w_p|^2 INT phi''^2 dt. For the difference of a
measured and a predicted motion with the same forces, the last two terms cancel (exactly for w = 1, else to first order in the difference),
and R is the missing force. Source: Messenger and Bortz, Weak SINDy, 2021.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from neuido.types import Plane

WINDOWS = 12
"""Number of bumps over a recording, which overlap by half."""
FEWEST = 7
"""Least number of frames in a window."""
POWER = 4
"""Exponent of the bump (1 - s^2)^4."""
REST = 0.1
"""Share of the recording at its end whose mean residual is the stage `rest`."""


class Window(NamedTuple):
    """A bump over some frames."""

    frames: slice
    second: np.ndarray
    """Weights of the frames for the integral INT x phi'' dt [1/s], exact for paths up to t^2."""
    value: np.ndarray
    """Weights of the frames for the integral INT f phi dt [s]."""
    time: float
    """Middle of the window [s]."""

    @property
    def area(self) -> float:
        """Integral of the bump, INT phi dt [s]."""
        return float(self.value.sum())


def window(t: np.ndarray, frames: slice) -> Window:
    """Return the bump over the frames of a slice, for a recording with times t (T,) [s]."""
    at = t[frames]
    half = 0.5 * (at[-1] - at[0])
    s = np.clip((at - at[0]) / half - 1.0, -1.0, 1.0)
    step = np.gradient(at)
    step[[0, -1]] *= 0.5
    u = 1.0 - s**2
    value = step * u**POWER
    second = step * (4 * POWER * (POWER - 1) * s**2 * u ** (POWER - 2) - 2 * POWER * u ** (POWER - 1)) / half**2
    # corrected for few frames: rest and steady motion must give exactly zero, and a steady acceleration a exactly a times the area
    basis = np.stack([np.ones_like(s), s, s**2], axis=1)
    wanted = np.array([0.0, 0.0, 2 * value.sum() / half**2])
    shape = basis * u[:, None] ** 2
    second = second + shape @ np.linalg.solve(basis.T @ shape, wanted - basis.T @ second)
    return Window(frames, second, value, float(0.5 * (at[0] + at[-1])))


def windows(t: np.ndarray, count: int = WINDOWS) -> list[Window]:
    """Return half-overlapping bumps over a recording with times t (T,) [s]; fewer than `count` where it is short."""
    length = max(2 * len(t) // (count + 1), FEWEST)
    if length > len(t):
        return [window(t, slice(0, len(t)))] if len(t) >= 5 else []
    starts = np.unique(np.linspace(0, len(t) - length, max(1, round(2 * (len(t) - length) / length) + 1)).round().astype(int))
    return [window(t, slice(int(i), int(i) + length)) for i in starts]


def weak_residual(
    x: np.ndarray,
    bump: Window,
    fields: np.ndarray,
    mass: np.ndarray,
    *,
    sigma: float = 0.0,
    force: Sequence[float] = (0.0, 0.0, 0.0),
    stress: np.ndarray | None = None,
    gradients: np.ndarray | None = None,
    volume: np.ndarray | None = None,
) -> tuple[np.ndarray, np.ndarray]:
    """Compute the weak residual R[w, phi] of K fields, and its standard deviation by noise of the positions.

    Args:
        x: Positions, or measured less predicted ones, (T, N, 3) [m]. A point that is not seen (NaN) in the window is left out.
        bump: The window.
        fields: Fields w, (K, N, 3).
        mass: Masses of the points [kg], (N,).
        sigma: Standard deviation of the noise of a coordinate [m].
        force: Force b per mass [m/s^2].
        stress: First Piola-Kirchhoff stress of the points [Pa], (T, N, 3, 3). It needs `gradients` and `volume`.
        gradients: Derivatives of w by the reference positions, (K, N, 3, 3).
        volume: Volumes of the points [m^3], (N,).

    Returns:
        Residuals (K,) and standard deviations (K,), in N s times the unit of w.

    Raises:
        ValueError: Stress is given without gradients or volume.
    """
    own = x[bump.frames]
    seen = np.isfinite(own).all(axis=(0, 2))
    own, w, m = own[:, seen], fields[:, seen], mass[seen]
    moved = np.einsum("t,tnc->nc", bump.second, own - own[:1])  # constants drop out: less rounding
    out = np.einsum("n,knc,nc->k", m, w, moved) - bump.area * np.einsum("n,knc,c->k", m, w, np.asarray(force, dtype=np.float64))
    if stress is not None:
        if gradients is None or volume is None:
            raise ValueError("stress needs gradients and volume")
        total = np.einsum("t,tnab->nab", bump.value, stress[bump.frames][:, seen])
        out = out + np.einsum("n,nab,knab->k", volume[seen], total, gradients[:, seen])
    return out, sigma * np.sqrt(np.einsum("n,knc->k", m**2, w**2) * np.sum(bump.second**2))


def deformation_gradients(reference: np.ndarray, x: np.ndarray, neighbours: int = 12) -> np.ndarray:
    """Estimate F of each point, (T, N, 3, 3), from its neighbours by weighted least squares; exact for affine motions.

    Args:
        reference: Points at rest, (N, 3) [m].
        x: Moved points, (T, N, 3) [m]. NaN makes F of a point and its neighbours NaN.
        neighbours: Number of neighbours. The weight of the farthest one is exp(-2).
    """
    distance = np.linalg.norm(reference[:, None] - reference[None], axis=-1)
    index = np.argsort(distance, axis=1)[:, 1 : neighbours + 1]
    far = np.take_along_axis(distance, index, axis=1)
    weight = np.exp(-2.0 * (far / far[:, -1:]) ** 2)
    arm = reference[index] - reference[:, None]
    inverse = np.linalg.pinv(np.einsum("nk,nka,nkb->nab", weight, arm, arm))
    moved = x[:, index] - x[:, :, None]
    return np.einsum("tnka,nk,nkb,nbc->tnac", moved, weight, arm, inverse)


def hats(reference: np.ndarray, nodes: int = 3) -> np.ndarray:
    """Return piecewise linear shape functions of a lattice over the body at its points, (nodes^3, N), which add up to one."""
    low, size = reference.min(axis=0), np.maximum(np.ptp(reference, axis=0), 1e-12)
    s = (reference - low) / size * (nodes - 1)
    one = np.maximum(0.0, 1.0 - np.abs(s[:, None, :] - np.arange(nodes)[None, :, None]))
    return np.einsum("ni,nj,nk->ijkn", *(one[..., a] for a in range(3))).reshape(nodes**3, -1)


def place(x: np.ndarray, t: np.ndarray, predicted: np.ndarray, *, sigma: float) -> tuple[np.ndarray, float]:
    """Find the part of the body where the missing force per mass is largest, among the shape functions of `hats`.

    Args:
        x: Measured points, (T, N, 3) [m], NaN where not seen.
        t: Times, (T,) [s].
        predicted: Predicted points, (T, N, 3) [m].
        sigma: Standard deviation of the noise of a coordinate [m].

    Returns:
        The centre of the part at t = 0, (3,) [m], and the ratio of its squared force to the median of all parts.
    """
    shape = hats(predicted[0])
    points = shape.sum(axis=1)
    shape = shape[points > min(1.0, 0.5 * float(points.max()))]  # parts with hardly a point show noise alone
    fields = np.einsum("kn,ac->kanc", shape, np.eye(3)).reshape(-1, *predicted.shape[1:])
    total = np.zeros(len(shape))
    for bump in windows(t):
        value, sd = weak_residual(x - predicted, bump, fields, np.ones(x.shape[1]), sigma=sigma)
        total += np.sum((value / np.maximum(sd, 1e-300)).reshape(-1, 3) ** 2, axis=1) / shape.sum(axis=1)  # a force per mass
    best = int(total.argmax())
    return shape[best] @ predicted[0] / shape[best].sum(), float(total[best] / max(float(np.median(total)), 1e-300))


class Parts(NamedTuple):
    """Affine part of a residual field and its remainder, for each of T frames."""

    centre: np.ndarray
    """Translation, (T, 3) [m]."""
    rotation: np.ndarray
    """Infinitesimal rotation, (T, 3) [rad]."""
    strain: np.ndarray
    """Strains xx, yy, zz, yz, xz, xy, (T, 6) [-]."""
    remainder: np.ndarray
    """Root mean square distance that no affine motion explains, (T,) [m]."""


def decompose(x: np.ndarray, predicted: np.ndarray) -> Parts:
    """Fit x - predicted = a + A (predicted - mean) in each frame by least squares; both are (T, N, 3) [m], NaN where not seen."""
    out = np.full((len(x), 13), np.nan)
    for k, (a, b) in enumerate(zip(x, predicted)):
        seen = np.isfinite(a).all(axis=1) & np.isfinite(b).all(axis=1)
        if seen.sum() < 4:
            continue
        r, arm = (a - b)[seen], b[seen] - b[seen].mean(axis=0)
        centre = r.mean(axis=0)
        A = np.linalg.lstsq(arm, r - centre, rcond=1e-6)[0].T
        left = r - centre - arm @ A.T
        W, S = 0.5 * (A - A.T), 0.5 * (A + A.T)
        turn = [W[2, 1], W[0, 2], W[1, 0]]
        out[k] = [*centre, *turn, S[0, 0], S[1, 1], S[2, 2], S[1, 2], S[0, 2], S[0, 1], np.sqrt(np.mean(np.sum(left**2, axis=1)))]
    return Parts(out[:, :3], out[:, 3:6], out[:, 6:12], out[:, 12])


def in_contact(x: np.ndarray, planes: Sequence[Plane], margin: float) -> np.ndarray:
    """Return the mask (T,) of frames in which a point of x (T, N, 3) [m] is nearer to a plane than `margin` [m]."""
    out = np.zeros(len(x), dtype=bool)
    for plane in planes:
        normal = np.array(plane.normal) / np.linalg.norm(plane.normal)
        height = (x - np.array(plane.point)) @ normal
        out |= np.nanmin(height, axis=1) < margin
    return out


class Series(NamedTuple):
    """Missing quantity of one stage over W windows of time, such as a missing acceleration in flight."""

    name: str
    unit: str
    times: np.ndarray
    """Middles of the windows [s], (W,)."""
    before: np.ndarray
    """Root mean square of the missing quantity without the effects, (W,)."""
    after: np.ndarray
    """Root mean square of the missing quantity with the effects, (W,)."""
    noise: np.ndarray
    """Value that noise alone causes, (W,)."""
    degrees: int
    """Number of components of the quantity."""

    def size(self, values: np.ndarray) -> float:
        """Return the root mean square over the windows."""
        return float(np.sqrt(np.mean(values**2))) if len(values) else 0.0

    def excess(self, values: np.ndarray) -> float:
        """Return the mean square in units of the noise: about 1 where there is noise alone."""
        return float(np.mean((values / np.maximum(self.noise, 1e-300)) ** 2)) if len(values) else 0.0


def stages(
    x: np.ndarray,
    t: np.ndarray,
    before: np.ndarray,
    after: np.ndarray,
    *,
    mass: float,
    sigma: float,
    planes: Sequence[Plane],
    margin: float,
) -> list[Series]:
    """Compute what two predictions lack, by stage.

    Args:
        x: Measured points, (T, N, 3) [m], NaN where not seen.
        t: Times, (T,) [s].
        before: Points predicted without the effects, (T, N, 3) [m].
        after: Points predicted with the effects, (T, N, 3) [m].
        mass: Mass of the body [kg], spread evenly over the points.
        sigma: Standard deviation of the noise of a coordinate [m].
        planes: Colliders that the body may touch.
        margin: Distance that counts as contact [m].

    Returns:
        The stages that occur: flight (missing acceleration of the centre, in windows without contact), contact (missing impulse, in windows
        with contact), rotation (angular acceleration), internal modes (acceleration of the six affine strains), power (of the missing
        force along the predicted motion) and rest (mean distance at the end).
    """
    masses = np.full(x.shape[1], mass / x.shape[1])
    touch = in_contact(x, planes, margin)
    rows: dict[str, list[tuple[float, float, float, float]]] = {}
    for bump in windows(t):
        middle = int(np.abs(t - bump.time).argmin())
        place = after[middle] - after[middle].mean(axis=0)
        frames = range(len(t))[bump.frames]
        a, b = max(middle - 1, frames[0]), min(middle + 1, frames[-1])
        velocity = (after[b] - after[a]) / (t[b] - t[a])
        fields = {"centre": np.broadcast_to(np.eye(3)[:, None], (3, len(place), 3)), "rotation": _rotations(place)}
        fields |= {"internal modes": _strains(place), "power": velocity[None]}
        for name, w in fields.items():
            scale = {"power": bump.area}.get(name, bump.area * np.maximum(np.einsum("n,knc->k", masses, w**2), 1e-300))
            label = name
            if name == "centre":
                label = "contact" if touch[bump.frames].any() else "flight"
                scale = 1.0 if label == "contact" else scale
            found = []
            for predicted in (before, after):
                value, sd = weak_residual(x - predicted, bump, w, masses, sigma=sigma)
                found.append(np.sqrt(np.mean((value / scale) ** 2)))
            rows.setdefault(label, []).append((bump.time, *found, float(np.sqrt(np.mean((sd / scale) ** 2)))))
    units = {"flight": ("m/s^2", 3), "rotation": ("rad/s^2", 3), "internal modes": ("1/s^2", 6), "contact": ("N s", 3), "power": ("W", 1)}
    out = []
    for name, (unit, degrees) in units.items():
        if name in rows:
            out.append(Series(name, unit, *np.array(rows[name]).T, degrees))
    return [*out, _rest(x, t, before, after, sigma)]


def _rest(x: np.ndarray, t: np.ndarray, before: np.ndarray, after: np.ndarray, sigma: float) -> Series:
    """Return the stage `rest`: the distance of the mean places at the end of the recording (`REST`) from the predicted ones."""
    late = t >= t[-1] - REST * (t[-1] - t[0])
    late &= np.isfinite(x).any(axis=(1, 2))
    if not late.any():
        late[np.flatnonzero(np.isfinite(x).any(axis=(1, 2)))[-1]] = True
    count = np.isfinite(x[late][..., 0]).sum(axis=0)
    found = []
    for predicted in (before, after):
        r = np.nanmean(np.where(count[:, None] > 0, x[late] - predicted[late], 0.0), axis=0)[count > 0]
        found.append([float(np.sqrt(np.mean(np.sum(r**2, axis=1))))])
    noise = sigma * np.sqrt(3.0 * np.mean(1.0 / count[count > 0]))
    return Series("rest", "m", np.array([float(t[late].mean())]), np.array(found[0]), np.array(found[1]), np.array([noise]), 3)


def _rotations(place: np.ndarray) -> np.ndarray:
    """Return the velocity fields e_k x r of unit rotations about the three axes, (3, N, 3)."""
    return np.stack([np.cross(axis, place) for axis in np.eye(3)])


def _strains(place: np.ndarray) -> np.ndarray:
    """Return the six symmetric linear fields (unit strains) at the points, (6, N, 3)."""
    out = []
    for i, j in ((0, 0), (1, 1), (2, 2), (1, 2), (0, 2), (0, 1)):
        field = np.zeros_like(place)
        field[:, i] += place[:, j]
        if i != j:
            field[:, j] += place[:, i]
        out.append(field)
    return np.stack(out)


def telling(series: Sequence[Series]) -> Series | None:
    """Return the stage whose excess over the noise the effects lower most; None where there is none."""
    able = [s for s in series if len(s.times)]
    return max(able, key=lambda s: s.excess(s.before) - s.excess(s.after), default=None)
