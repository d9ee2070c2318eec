"""Quantities by which the particles of a motion are coloured: speed, strain, stress and the like, with their units and colours."""

import functools
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

QUANTILE = 0.98
"""Share of the values below the top of the legend, so that a few extreme particles do not make the others one colour."""
SAMPLED = 12
"""Frames, evenly spaced, from which the range of the legend is taken."""
NEIGHBOURS = 12
"""Nearest particles from which the total deformation gradient is estimated; about the first shell of a lattice."""
COLLAPSED = 1e-6
"""Squared stretch below which matter counts as collapsed [-]; its logarithm is that of this number."""
GREY = 150
"""Each channel of the colour of particles whose value is not known."""
PREFIXES = ((1e9, "G"), (1e6, "M"), (1e3, "k"), (1.0, ""), (1e-3, "m"), (1e-6, "µ"), (1e-9, "n"))


@dataclass(eq=False)
class Quantity:
    """One number for each particle of a frame.

    Args:
        name: As in the legend.
        unit: SI unit; empty for pure numbers.
        values: Function of a frame's index that returns the values, (P,).
        frames: Number of frames.
        around: Value in the middle of the colours, such as 1 for a ratio of volumes; None: colours begin at the smallest value.
    """

    name: str
    unit: str
    values: Callable[[int], np.ndarray]
    frames: int
    around: float | None = None

    @functools.cached_property
    def range(self) -> tuple[float, float]:
        """Values at the ends of the legend, over all frames."""
        chosen = np.unique(np.linspace(0, self.frames - 1, min(self.frames, SAMPLED)).round().astype(int))
        found = np.concatenate([np.asarray(self.values(int(k)), float) for k in chosen])
        found = found[np.isfinite(found)]
        if not len(found):
            return 0.0, 1.0
        if self.around is not None:
            half = float(np.quantile(np.abs(found - self.around), QUANTILE)) or 1e-3
            return self.around - half, self.around + half
        low, high = float(min(0.0, found.min())), float(np.quantile(found, QUANTILE))
        return (low, high) if high > low else (low, low + 1.0)

    def colours(self, frame: int) -> np.ndarray:
        """Return the colour of each particle, (P, 3) uint8; grey where the value is not a number."""
        low, high = self.range
        values = np.asarray(self.values(frame), float)
        known = ~np.isnan(values)
        place = np.clip((np.where(known, values, low) - low) / (high - low), 0.0, 1.0)
        colours = table(self.around is not None)[(255 * place).astype(np.uint8)]
        return np.where(known[:, None], colours, np.uint8(GREY))

    @property
    def scaled(self) -> tuple[float, str]:
        """Factor and unit in which people read the range: 0.001 and kPa for some thousand Pa."""
        return readable(max(map(abs, self.range)), self.unit)

    def legend(self) -> tuple[str, str, str]:
        """Return the title with its unit and the numbers at the two ends."""
        factor, unit = self.scaled
        low, high = (f"{factor * value:.3g}" for value in self.range)
        return f"{self.name} [{unit}]" if unit else self.name, low, high


def readable(size: float, unit: str) -> tuple[float, str]:
    """Return the factor and the unit with a prefix for values of a size in an SI unit; pure numbers stay as they are."""
    if not unit or not size > 0:
        return 1.0, unit
    step, prefix = next((each for each in PREFIXES if size >= 0.999 * each[0]), PREFIXES[-1])
    return 1.0 / step, prefix + unit


@functools.cache
def table(diverging: bool = False) -> np.ndarray:
    """Return 256 colours, (256, 3) uint8: viridis, or blue over white to red around a middle."""
    from matplotlib import colormaps

    chosen = colormaps["RdYlBu_r" if diverging else "viridis"]
    return (255 * chosen(np.linspace(0.0, 1.0, 256))[:, :3]).round().astype(np.uint8)


def quantities_of(
    times: np.ndarray,
    x: np.ndarray,
    v: np.ndarray | None = None,
    F: np.ndarray | None = None,
    *,
    stress: Callable[[np.ndarray], np.ndarray] | None = None,
    reference: np.ndarray | None = None,
    gradients: "TotalGradients | None" = None,
) -> dict[str, Quantity]:
    """Return the quantities that a motion has.

    Args:
        times: Times of the frames [s], (K,).
        x: Position [m], (K, P, 3); NaN where a point was not seen.
        v: Velocity [m/s], (K, P, 3); from differences of positions where absent.
        F: Elastic deformation gradient [-], (K, P, 3, 3).
        stress: Function from F (P, 3, 3) to the Kirchhoff stress [Pa], (P, 3, 3).
        reference: Positions that x is compared with [m], (K, P, 3).
        gradients: Total deformation gradients, for the plastic strain; from the first frame on where absent.
    """
    count = len(x)
    made: list[Quantity] = []

    def add(name: str, unit: str, values: Callable[[int], np.ndarray], around: float | None = None) -> None:
        made.append(Quantity(name, unit, functools.lru_cache(maxsize=2 * SAMPLED)(values), count, around))

    if reference is not None:
        add("residual", "m", lambda k: np.linalg.norm(x[k] - reference[k], axis=1))
    if v is not None:
        add("speed", "m/s", lambda k: np.linalg.norm(v[k], axis=1))
    elif count > 1:
        add("speed", "m/s", lambda k: speed_from_positions(times, x, k))
    if F is not None:
        if stress is not None:
            add("von Mises stress", "Pa", lambda k: von_mises(stress(F[k]), F[k]))
        add("strain", "", lambda k: equivalent_strain(F[k]))
        add("volume ratio", "", lambda k: np.linalg.det(F[k].astype(np.float64)), 1.0)
        if count > 1 and x.shape[1] > 2 * NEIGHBOURS:
            total = gradients or TotalGradients(x[0], F[0])
            add("plastic strain", "", lambda k: equivalent_strain(np.linalg.solve(_regular(F[k]), total(x[k]))))
    if count > 1:
        add("displacement", "m", lambda k: np.linalg.norm(x[k] - x[0], axis=1))
    return {each.name: each for each in made}


def speed_from_positions(times: np.ndarray, x: np.ndarray, frame: int) -> np.ndarray:
    """Return the speed [m/s] of each point, (P,), by central differences; one-sided at the ends."""
    before, after = max(frame - 1, 0), min(frame + 1, len(x) - 1)
    return np.linalg.norm(x[after] - x[before], axis=1) / max(float(times[after] - times[before]), 1e-12)


def equivalent_strain(F: np.ndarray) -> np.ndarray:
    """Return the equivalent logarithmic strain sqrt(2/3) |dev ln V| of deformation gradients, (P, 3, 3) -> (P,)."""
    F = F.astype(np.float64)
    squared = symmetric_eigenvalues(F @ F.transpose(0, 2, 1))
    logs = 0.5 * np.log(np.maximum(squared, COLLAPSED))
    return np.sqrt(2.0 / 3.0) * np.linalg.norm(logs - logs.mean(axis=1, keepdims=True), axis=1)


def von_mises(kirchhoff: np.ndarray, F: np.ndarray) -> np.ndarray:
    """Return von Mises' equivalent of the Cauchy stress [Pa], (P,), from Kirchhoff stresses and deformation gradients (P, 3, 3)."""
    J = np.maximum(np.abs(np.linalg.det(F.astype(np.float64))), COLLAPSED)
    cauchy = kirchhoff.astype(np.float64) / J[:, None, None]
    deviator = cauchy - np.trace(cauchy, axis1=1, axis2=2)[:, None, None] / 3.0 * np.eye(3)
    return np.sqrt(1.5) * np.linalg.norm(deviator, axis=(1, 2))


def symmetric_eigenvalues(A: np.ndarray) -> np.ndarray:
    """Return the eigenvalues of symmetric matrices in closed form (Smith 1961), largest first, (P, 3, 3) -> (P, 3)."""
    mean = np.trace(A, axis1=1, axis2=2) / 3.0
    deviator = A - mean[:, None, None] * np.eye(3)
    size = np.sqrt(np.maximum(np.sum(deviator**2, axis=(1, 2)) / 6.0, 0.0))
    half = np.linalg.det(deviator / np.maximum(size, 1e-300)[:, None, None]) / 2.0
    angle = np.arccos(np.clip(half, -1.0, 1.0)) / 3.0
    first = mean + 2.0 * size * np.cos(angle)
    last = mean + 2.0 * size * np.cos(angle + 2.0 * np.pi / 3.0)
    return np.stack([first, 3.0 * mean - first - last, last], axis=1)


class TotalGradients:
    """Total deformation gradients of a motion, by least squares over each particle's neighbours in the first frame.

    A simulation gives the elastic gradient alone. Where matter separates, the estimate takes the gap as strain.

    Args:
        x: Positions in the first frame [m], (P, 3).
        F: Elastic deformation gradients there [-], (P, 3, 3), which the total ones begin with.
    """

    def __init__(self, x: np.ndarray, F: np.ndarray) -> None:
        from scipy.spatial import KDTree

        self.first, self.F = x.astype(np.float64), F.astype(np.float64)

        @functools.cache
        def prepared() -> tuple[np.ndarray, np.ndarray]:
            _, index = KDTree(self.first).query(self.first, k=NEIGHBOURS + 1)
            index = np.asarray(index)[:, 1:]
            edges = self.first[index] - self.first[:, None]
            moment = np.einsum("pki,pkj->pij", edges, edges)
            floor = 1e-9 * np.trace(moment, axis1=1, axis2=2)[:, None, None] * np.eye(3)
            return index, np.einsum("pki,pij->pkj", edges, np.linalg.inv(moment + floor))

        self._prepared = prepared

    def __call__(self, x: np.ndarray) -> np.ndarray:
        """Return the total deformation gradients of a frame, (P, 3, 3), from its positions (P, 3)."""
        index, weights = self._prepared()
        x = x.astype(np.float64)
        return np.einsum("pki,pkj->pij", x[index] - x[:, None], weights) @ self.F


def _regular(F: np.ndarray) -> np.ndarray:
    """Return gradients that can be inverted: a collapsed one is replaced by the identity."""
    F = F.astype(np.float64)
    return np.where((np.abs(np.linalg.det(F)) > COLLAPSED)[:, None, None], F, np.eye(3))


def stress_of(law: Any) -> Callable[[np.ndarray], np.ndarray]:
    """Return the Kirchhoff stress [Pa] of an elastic law as a function of NumPy arrays F (P, 3, 3)."""
    import torch

    def stress(F: np.ndarray) -> np.ndarray:
        with torch.no_grad():
            return law(torch.from_numpy(np.ascontiguousarray(F, dtype=np.float32))).numpy()

    return stress


def stress_by_body(laws: Sequence[Any], body: np.ndarray) -> Callable[[np.ndarray], np.ndarray] | None:
    """Return the Kirchhoff stress [Pa] where each body has its own elastic law; None where a body's law varies within it or is not given.

    Args:
        laws: The law of each body.
        body: Index of each particle's body, (P,).
    """
    if not all(hasattr(law, "tensors") and all(len(t) == 1 for t in law.tensors()) for law in laws):
        return None
    own = [stress_of(law) for law in laws]

    def stress(F: np.ndarray) -> np.ndarray:
        out = np.zeros_like(F, dtype=np.float64)
        for i, each in enumerate(own):
            if (chosen := body == i).any():
                out[chosen] = each(F[chosen])
        return out

    return stress
