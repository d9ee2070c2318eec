"""Points on a deforming body as an experiment: the first frame is its rest shape."""

import os
from collections.abc import Mapping
from pathlib import Path

import numpy as np
import yaml

from neuido.data.importers.checked_folder import write_checked
from neuido.errors import UserError

VELOCITY_FRAMES = 4
"""Frames from which the first velocities are estimated."""


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
    """Write an experiment of takes, each with times (T,) and points (T, 3) by name; return the lines of the summary.

    Raises:
        UserError: Density or modulus are not given, or a point was not seen in the first frame by all.
    """
    from neuido.data.measured.experiment import read_experiment

    if density is None or young is None:
        raise UserError("a deforming body needs a declared material: give --density (kg/m^3) and --young (Pa); a guess is enough")
    arrays, said, low, high = {}, [], [], []
    for name, (t, points) in takes.items():
        if any(x.shape[1] != 3 for x in points.values()):
            raise UserError(f"{name}: a deforming body needs x, y and z")
        x = np.stack(list(points.values()), 1)
        x = x[:, np.isfinite(x[0]).all(axis=1)]
        if x.shape[1] < 8:
            raise UserError(f"{name}: {x.shape[1]} points are seen in the first frame; a body needs at least 8")
        x[~np.isfinite(x).all(axis=2)] = np.nan
        velocity = _velocity(t, x)
        whole = volume or _hull(x[0], name)
        whence = "" if volume else " (hull of the first frame, --volume)"
        said.append(f"{name}: {x.shape[1]} points, {len(t)} frames, volume {whole:.4g} m^3{whence}")
        arrays[name] = {
            "x": x.astype(np.float32),
            "t": t,
            "x0": x[0].astype(np.float32),
            "v0": velocity.astype(np.float32),
            "volume": np.full(x.shape[1], whole / x.shape[1], np.float32),
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
    said.append(f"floor at y = {floor:g} m" if floor is not None else "no floor (--floor HEIGHT)")

    def fill(folder: Path) -> None:
        for name, take in arrays.items():
            (folder / name).mkdir()
            np.savez_compressed(folder / name / "particles.npz", **take)
        (folder / "experiment.yaml").write_text(yaml.safe_dump(content, sort_keys=False, default_flow_style=None))

    write_checked(out, fill, read_experiment)
    return said


def _velocity(t: np.ndarray, x: np.ndarray) -> np.ndarray:
    """Return the velocities (N, 3) at the first frame [m/s], from a parabola through the first frames; the mean where points were lost."""
    count = min(VELOCITY_FRAMES, len(t))
    basis = np.stack([t[:count] ** power for power in range(min(3, count))], 1)
    out = np.einsum("f,fna->na", np.linalg.pinv(basis)[1], x[:count])
    lost = ~np.isfinite(out).all(axis=1)
    if lost.all():
        raise UserError(f"no point is seen in all of the first {count} frames: cut the recording to where it is")
    out[lost] = out[~lost].mean(axis=0)
    return out


def _hull(x: np.ndarray, name: str) -> float:
    from scipy.spatial import ConvexHull, QhullError

    try:
        return float(ConvexHull(x).volume)
    except QhullError as error:
        raise UserError(f"{name}: the points of the first frame lie in a plane and span no volume: give --volume, in m^3") from error
