"""Write tracked points on a deforming body as an experiment folder; the first frame is the rest shape."""

import os
from collections.abc import Mapping
from pathlib import Path

import numpy as np
import yaml

from neuido.data.files.writing import write_arrays, write_text
from neuido.data.importers.tables.checked_folder import write_checked
from neuido.errors import UserError

VELOCITY_FRAMES = 4
"""Number of frames from which the initial velocities are estimated."""


def write_deforming_body(
    takes: Mapping[str, tuple[np.ndarray, Mapping[str, np.ndarray]]],
    out: str | os.PathLike | None,
    *,
    roles: Mapping[str, str],
    density: float | None,
    young: float | None,
    poisson: float | None,
    volume: float | None,
    floor: float | None,
) -> list[str]:
    """Write recordings of tracked points as an experiment folder (`neuido-experiment/1`); return the lines of the summary.

    Args:
        takes: Times [s] (T,) and positions [m] (T, 3) of each named point, for each recording.
        out: The folder to create. None: check the content and write nothing.
        roles: `fit` or `held_out` for each recording.
        density: Declared density [kg/m^3].
        young: Declared Young's modulus [Pa].
        poisson: Declared Poisson's ratio; 0.3 if None.
        volume: Volume of the body [m^3]; if None, that of the convex hull of the first frame.
        floor: Height of the floor [m]; None: there is no floor.

    Raises:
        UserError: Density or Young's modulus is missing, points are two-dimensional, or fewer than 8 points are seen in the first frame.
    """
    from neuido.data.measured.experiment import read_experiment

    if density is None or young is None:
        raise UserError("a deforming body needs a declared material: give --density (kg/m^3) and --young (Pa); rough values are enough")
    arrays, summary, low, high = {}, [], [], []
    for name, (t, points) in takes.items():
        if any(x.shape[1] != 3 for x in points.values()):
            raise UserError(f"{name}: a deforming body needs three coordinates: give --columns.x, --columns.y and --columns.z")
        x = np.stack(list(points.values()), 1)
        x = x[:, np.isfinite(x[0]).all(axis=1)]
        if x.shape[1] < 8:
            raise UserError(
                f"{name}: {x.shape[1]} points are seen in the first frame; at least 8 are needed: cut the recording, or give --kind track"
            )
        x[~np.isfinite(x).all(axis=2)] = np.nan
        velocity = _velocity(t, x)
        total = volume or _hull(x[0], name)
        origin = "" if volume else " (convex hull of the first frame; --volume replaces it)"
        summary.append(f"{name}: {x.shape[1]} points, {len(t)} frames, volume {total:.4g} m^3{origin}")
        arrays[name] = {
            "x": x.astype(np.float32),
            "t": t,
            "x0": x[0].astype(np.float32),
            "v0": velocity.astype(np.float32),
            "volume": np.full(x.shape[1], total / x.shape[1], np.float32),
            "track": np.arange(x.shape[1], dtype=np.int32),
        }
        low.append(np.nanmin(x, axis=(0, 1)))
        high.append(np.nanmax(x, axis=(0, 1)))
    lower, upper = np.min(low, axis=0), np.max(high, axis=0)
    size = float((upper - lower).max())
    lower, upper = lower - 0.15 * size, upper + 0.15 * size
    colliders = []
    if floor is not None:
        lower[1] = min(lower[1], floor - 0.1 * size)
        colliders = [
            {"type": "plane", "point": [0.0, float(floor), 0.0], "normal": [0.0, 1.0, 0.0], "contact": "separate", "friction": 0.0}
        ]
    speed = np.sqrt(young / density)
    dt = float(f"{min(0.2 * size * 1.3 / 32 / speed, 1e-3):.1g}")
    elasticity = {"law": "fixed_corotated", "young": float(young), "poisson": 0.3 if poisson is None else poisson}
    content = {
        "format": "neuido-experiment/1",
        "name": next(iter(takes)),
        "scene": {"domain": [lower.tolist(), upper.tolist()], "gravity": [0.0, -9.81, 0.0], "colliders": colliders},
        "model": {"density": float(density), "elasticity": elasticity, "plasticity": {"law": "identity"}, "free": ["young"]},
        "discretisation": {"grid": 32, "dt": dt},
        "recordings": [
            {"name": name, "role": roles[name], "frame_interval": float(np.median(np.diff(take["t"])))} for name, take in arrays.items()
        ],
    }
    summary.append(f"floor at y = {floor:g} m" if floor is not None else "no floor (--floor HEIGHT adds one)")

    def fill(folder: Path) -> None:
        for name, take in arrays.items():
            write_arrays(folder / name / "particles.npz", take)
        write_text(folder / "experiment.yaml", yaml.safe_dump(content, sort_keys=False, default_flow_style=None))

    return summary + write_checked(out, fill, read_experiment)


def _velocity(t: np.ndarray, x: np.ndarray) -> np.ndarray:
    """Estimate the initial velocities (N, 3) [m/s] from a parabola fitted to the first frames.

    A point that is not seen in all of these frames gets the mean velocity.
    """
    count = min(VELOCITY_FRAMES, len(t))
    basis = np.stack([t[:count] ** power for power in range(min(3, count))], 1)
    out = np.einsum("f,fna->na", np.linalg.pinv(basis)[1], x[:count])
    lost = ~np.isfinite(out).all(axis=1)
    if lost.all():
        raise UserError(f"no point is seen in all of the first {count} frames: cut the start of the recording")
    out[lost] = out[~lost].mean(axis=0)
    return out


def _hull(x: np.ndarray, name: str) -> float:
    """Return the volume [m^3] of the convex hull of points x (N, 3) [m]."""
    from scipy.spatial import ConvexHull, QhullError

    try:
        return float(ConvexHull(x).volume)
    except QhullError as error:
        raise UserError(f"{name}: the points of the first frame lie in a plane and enclose no volume: give --volume (m^3)") from error
