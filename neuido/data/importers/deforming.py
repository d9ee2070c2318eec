"""Write tracked points on a deforming body as an experiment folder; the first frame is the rest shape."""

import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from neuido.data.files.writing import write_arrays, write_text
from neuido.data.importers.declared_guide import GRAVITY
from neuido.data.importers.rest_body import rest_body
from neuido.data.importers.tables.checked_folder import write_checked
from neuido.errors import UserError

VELOCITY_FRAMES = 4
"""Number of frames from which the initial velocities are estimated."""
CELL, CELLS = 1.5, (12, 64)
"""Size of a cell in spacings of the particles: three or four of these fill one, and no gap opens between them; and range of the cells."""
SCATTER = 2.0
"""Variance of velocities about a linear field, relative to what the noise of the points explains, at which the field is taken."""


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
    arrays, summary, low, high, spacings = {}, [], [], [], []
    for name, (t, points) in takes.items():
        if any(x.shape[1] != 3 for x in points.values()):
            raise UserError(f"{name}: a deforming body needs three coordinates: give --columns.x, --columns.y and --columns.z")
        x = np.stack(list(points.values()), 1)
        known = np.isfinite(x[0]).all(axis=1)
        x = x[:, known]
        if x.shape[1] < 8:
            raise UserError(
                f"{name}: {x.shape[1]} points are seen in the first frame; at least 8 are needed: cut the recording, or give --kind track"
            )
        if not known.all():
            summary.append(f"{name}: {int((~known).sum())} points that are not seen in the first frame are left out")
        x[~np.isfinite(x).all(axis=2)] = np.nan
        velocity, kind = start_velocity(t, x)
        body = rest_body(x[0], velocity, volume, name)
        speed = np.linalg.norm(velocity.mean(axis=0))
        summary.append(f"{name}: starts at {speed:.3g} m/s by the first {min(VELOCITY_FRAMES, len(t))} frames, {kind}")
        summary.append(f"{name}: {x.shape[1]} points, {len(t)} frames, volume {body.volume:.4g} m^3 ({body.note})")
        each = f"{body.volume / len(body.x0):.3g} m^3 each, {1e3 * body.spacing:.3g} mm apart"
        summary.append(f"{name}: at rest without stress in the first frame; {len(body.x0)} particles of {each}")
        places = {"anchor": x[0].astype(np.float32)} if body.filled else {"track": np.arange(x.shape[1], dtype=np.int32)}
        arrays[name] = {
            "x": x.astype(np.float32),
            "t": t,
            "x0": body.x0.astype(np.float32),
            "v0": body.v0.astype(np.float32),
            "volume": np.full(len(body.x0), body.volume / len(body.x0), np.float32),
            **places,
        }
        spacings.append(body.spacing)
        low.append(np.minimum(np.nanmin(x, axis=(0, 1)), body.x0.min(axis=0)))
        high.append(np.maximum(np.nanmax(x, axis=(0, 1)), body.x0.max(axis=0)))
    recordings = [
        {"name": name, "role": roles[name], "frame_interval": float(np.median(np.diff(take["t"])))} for name, take in arrays.items()
    ]
    lower, upper, spacing = np.min(low, axis=0), np.max(high, axis=0), float(np.median(spacings))
    content, notes = declared_content(next(iter(takes)), lower, upper, spacing, density, young, poisson, floor, recordings)
    summary += notes

    def fill(folder: Path) -> None:
        for name, take in arrays.items():
            write_arrays(folder / name / "particles.npz", take)
        write_text(folder / "experiment.yaml", yaml.safe_dump(content, sort_keys=False, default_flow_style=None))

    return summary + write_checked(out, fill, read_experiment)


def declared_content(
    name: str,
    lower: np.ndarray,
    upper: np.ndarray,
    spacing: float,
    density: float,
    young: float,
    poisson: float | None,
    floor: float | None,
    recordings: list[dict[str, Any]],
) -> tuple[dict[str, Any], list[str]]:
    """Return the content of experiment.yaml for a body of which only rough values are known, and what was assumed, for the summary.

    Args:
        name: Name of the experiment.
        lower, upper: Corners of what the body passes through [m], (3,) each.
        spacing: Distance of neighbouring particles [m].
        density: Declared density [kg/m^3].
        young: Declared Young's modulus [Pa].
        poisson: Declared Poisson's ratio; 0.3 if None.
        floor: Height of the floor [m]; None: there is no floor.
        recordings: The entries of the recordings.
    """
    size = float((upper - lower).max())
    lower, upper = lower - 0.15 * size, upper + 0.15 * size
    colliders = []
    if floor is not None:
        lower[1] = min(lower[1], floor - 0.1 * size)
        colliders = [
            {"type": "plane", "point": [0.0, float(floor), 0.0], "normal": [0.0, 1.0, 0.0], "contact": "separate", "friction": 0.0}
        ]
    longest = float((upper - lower).max())
    cells = int(np.clip(round(longest / (CELL * spacing)), *CELLS))
    wave = np.sqrt(young / density)
    dt = float(f"{min(0.2 * longest / cells / wave, 1e-3):.1g}")
    elasticity = {"law": "fixed_corotated", "young": float(young), "poisson": 0.3 if poisson is None else poisson}
    content = {
        "format": "neuido-experiment/1",
        "name": name,
        "scene": {"domain": [lower.tolist(), upper.tolist()], "gravity": [0.0, -GRAVITY, 0.0], "colliders": colliders},
        "model": {"density": float(density), "elasticity": elasticity, "plasticity": {"law": "identity"}, "free": ["young"]},
        "discretisation": {"grid": cells, "dt": dt},
        "recordings": recordings,
    }
    notes = [
        f"model: fixed corotated elasticity, Young's modulus {young:g} Pa (fitted), density {density:g} kg/m^3, Poisson's ratio "
        f"{elasticity['poisson']:g}{'' if poisson is not None else ' (assumed: --poisson)'}, no plasticity",
        f"gravity {GRAVITY:g} m/s^2 along -y (--up z where z points up); "
        + (f"floor at y = {floor:g} m" if floor is not None else "no floor (--floor HEIGHT adds one)"),
        f"grid of {cells} cells of {1e3 * longest / cells:.3g} mm, steps of {1e3 * dt:g} ms",
    ]
    if len(recordings) == 1:
        notes.append("one recording, so that none is held out: a second file would test the answer")
    return content, notes


def start_velocity(t: np.ndarray, x: np.ndarray) -> tuple[np.ndarray, str]:
    """Estimate the velocities of points at the start from their first frames.

    A parabola is fitted to each point. Where the velocities scatter about a linear field by no more than the noise of the points explains,
    the field is taken: the error of each is then that of all together. A point that is not seen in all of these frames gets the field.

    Args:
        t: Times [s], (T,), from 0.
        x: Positions [m], (T, N, 3); NaN where a point was not seen.

    Returns:
        Velocities (N, 3) [m/s], and what they are, for the summary.

    Raises:
        UserError: No point is seen in all of the first frames.
    """
    count = min(VELOCITY_FRAMES, len(t))
    basis = np.stack([t[:count] ** power for power in range(min(3, count))], 1)
    inverse = np.linalg.pinv(basis)
    out = np.einsum("f,fna->na", inverse[1], x[:count])
    seen = np.isfinite(out).all(axis=1)
    if not seen.any():
        raise UserError(f"no point is seen in all of the first {count} frames: cut the start of the recording")
    field = np.column_stack([np.ones(x.shape[1]), x[0] - x[0].mean(axis=0)])
    if seen.sum() < 2 * field.shape[1] or count <= basis.shape[1]:
        out[~seen] = out[seen].mean(axis=0)
        return out, "of each point"
    linear = field @ np.linalg.lstsq(field[seen], out[seen], rcond=None)[0]
    left = x[:count, seen] - np.einsum("fg,gna->fna", basis @ inverse, x[:count, seen])
    noise = float(np.sum(left**2)) / (left[0].size * (count - basis.shape[1]))
    scatter = float(np.sum((out[seen] - linear[seen]) ** 2)) / (3 * (seen.sum() - field.shape[1]))
    if scatter < SCATTER * noise * float(inverse[1] @ inverse[1]):
        return linear, "a linear field, about which single points scatter as their noise does"
    out[~seen] = linear[~seen]
    return out, "of each point"
