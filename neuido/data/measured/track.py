"""Tracks: measured motion of bodies as points, in the folder format `neuido-track/1`."""

import math
import os
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from neuido.data.files.values import check_keys, file_name, mapping, number, vector
from neuido.data.measured.columns import (
    check_increasing,
    errors_of,
    read_columns,
    read_effects,
    read_entries,
    read_free,
    read_header,
    read_role,
    read_text,
)
from neuido.data.measured.motion_plausibility import check_figures, check_flight, check_track
from neuido.errors import UserError
from neuido.types import Vector

FORMAT = "neuido-track/1"
AXES = ("x", "y", "z")
NUISANCES = ("release_time", "length_scale", "time_base")
FIGURES = ("mass", "diameter")
EFFECTS = (
    "gravity", "uniform_acceleration", "drag_linear", "drag_quadratic", "magnus", "position_force", "time_force", "added_mass",
)  # fmt: skip
"""Effects of the library that act on the centre of mass of a body."""


@dataclass(frozen=True, eq=False)
class Track:
    """Recorded motion of one body as a point, with n frames."""

    name: str
    body: str
    role: str
    """`fit` or `held_out`; held-out recordings are scored but never fitted."""
    t: np.ndarray
    """Times [s], (n,) float64, increasing."""
    x: np.ndarray
    """Measured coordinates [m], (n, A) float64."""
    axes: tuple[int, ...]
    """Axes of the A coordinates: 0, 1, 2 for x, y, z."""
    spin: Vector | None = None
    """Angular velocity at the start [rad/s]; None if unknown."""
    noise: float | None = None
    """Standard deviation of the position error [m]; None if unknown."""


@dataclass(frozen=True, eq=False)
class Tracks:
    """All recordings of one or more bodies in the same surroundings."""

    name: str
    folder: Path
    gravity: Vector = (0.0, -9.81, 0.0)
    """Declared gravity [m/s^2]."""
    effects: dict[str, float] = field(default_factory=dict)
    """Effects of the declared model by flat names, for example {"drag_quadratic.k": 0.01}."""
    free: tuple[str, ...] = ()
    """Parameters of the model to fit: `gravity` (its magnitude) or names of `effects`."""
    nuisances: dict[str, float] = field(default_factory=lambda: dict.fromkeys(NUISANCES, 0.0))
    """Standard deviation of the nuisance parameters of a recording: release_time [s], length_scale [-] and time_base [-] (relative)."""
    bodies: dict[str, dict[str, float]] = field(default_factory=dict)
    """mass [kg] and diameter [m] of each body, if known."""
    recordings: tuple[Track, ...] = ()

    def of(self, role: str, body: str | None = None) -> tuple[Track, ...]:
        """Return the recordings with this role, of one body or of all bodies."""
        return tuple(track for track in self.recordings if track.role == role and body in (None, track.body))


def read_tracks(path: str | os.PathLike, *, model: Mapping[str, Any] | None = None) -> Tracks:
    """Read a track folder, or its `track.yaml`.

    Args:
        path: The folder or the file.
        model: Replaces the key `model` of the file.

    Raises:
        UserError: A key, body, effect, column or file is unknown or missing, a value is a NaN or outside its range, times do not
            increase, or the unit of a flight is not metres. The message names the file and the key.
    """
    file, content = read_header(Path(path), "track.yaml", FORMAT)
    with errors_of(file):
        check_keys(content, "the file", ("format", "name", "model", "nuisances", "bodies", "recordings"), ("nuisances",))
        name = read_text(content["name"], "name")
        gravity, effects, free = _model(content["model"] if model is None else model)
        nuisances = dict.fromkeys(NUISANCES, 0.0)
        given = mapping(content.get("nuisances") or {}, "nuisances")
        check_keys(given, "nuisances", NUISANCES, NUISANCES)
        nuisances |= {key: number(value, f"nuisances.{key}", least=0.0) for key, value in given.items()}
        bodies = _bodies(content["bodies"])
        recordings = read_entries(
            content["recordings"], "recordings", "recording", lambda entry, where: _recording(entry, where, bodies, file.parent)
        )
        for body, figures in bodies.items():
            check_figures(body, figures)
        for i, track in enumerate(recordings):
            check_track(track.t, track.x, [AXES[a] for a in track.axes], f"recordings[{i}] ({track.name})")
            for column, a in enumerate(track.axes):
                check_flight(track.t, track.x[:, column], gravity[a], AXES[a], f"recordings[{i}] ({track.name})")
        for body in bodies:
            if not any(track.body == body and track.role == "fit" for track in recordings):
                raise UserError(f"recordings has no entry of the body {body!r} with role fit: give at least one")
    return Tracks(name, file.parent, gravity, effects, free, nuisances, bodies, recordings)


def _model(given: Any) -> tuple[Vector, dict[str, float], tuple[str, ...]]:
    check_keys(given, "model", ("gravity", "effects", "free"), ("effects", "free"))
    gravity = vector(given["gravity"], "model.gravity")
    effects = read_effects(given.get("effects"), "model.effects", known=EFFECTS)
    return gravity, effects, read_free(given.get("free", []), ("gravity", *effects))


def _bodies(given: Any) -> dict[str, dict[str, float]]:
    bodies = mapping(given, "bodies")
    if not bodies:
        raise UserError("bodies is empty: give at least one body")
    out = {}
    for name, figures in bodies.items():
        file_name(name, "the name of a body")
        figures = mapping(figures or {}, f"bodies.{name}")
        check_keys(figures, f"bodies.{name}", FIGURES, FIGURES)
        out[name] = {key: number(value, f"bodies.{name}.{key}", above=0.0) for key, value in figures.items()}
    return out


def _recording(entry: Any, where: str, bodies: Mapping[str, Any], folder: Path) -> Track:
    optional = ("rows", "spin", "noise", "scale")
    check_keys(entry, where, ("name", "body", "file", "columns", "role", *optional), optional)
    name = file_name(entry["name"], f"{where}.name")
    where = f"{where} ({name})"
    if not isinstance(entry["body"], str) or entry["body"] not in bodies:
        raise UserError(f"{where}.body = {entry['body']!r} is unknown: choose from {', '.join(bodies)}")
    role = read_role(entry["role"], where)
    columns = mapping(entry["columns"], f"{where}.columns")
    check_keys(columns, f"{where}.columns", ("t", *AXES), AXES)
    axes = tuple(a for a, key in enumerate(AXES) if key in columns)
    if not axes:
        raise UserError(f"{where}.columns has none of {', '.join(AXES)}: give at least one coordinate")
    scale = mapping(entry.get("scale", {}), f"{where}.scale")
    check_keys(scale, f"{where}.scale", ("t", *AXES), ("t", *AXES))
    for key, factor in scale.items():
        if not number(factor, f"{where}.scale.{key}", above=0.0 if key == "t" else -math.inf):
            raise UserError(f"{where}.scale.{key} must not be zero")
    data, _ = read_columns(folder, entry, where, scale=scale)
    return Track(
        name=name,
        body=entry["body"],
        role=role,
        t=check_increasing(data["t"], where),
        x=np.stack([data[AXES[a]] for a in axes], 1),
        axes=axes,
        spin=vector(entry["spin"], f"{where}.spin") if entry.get("spin") is not None else None,
        noise=number(entry["noise"], f"{where}.noise", above=0.0) if entry.get("noise") is not None else None,
    )
