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
from neuido.data.measured.motion_plausibility import (
    check_bounces,
    check_figures,
    check_flight,
    check_released,
    check_track,
    check_upright,
)
from neuido.errors import UserError
from neuido.physics.effects.point_library import TRACK_ENTRIES
from neuido.types import Vector

FORMAT = "neuido-track/1"
AXES = ("x", "y", "z")
ANGLE = "angle"
"""Column of a pendulum's or an axis's angle [rad], in the place of coordinates."""
NUISANCES = {"release_time": 0.0, "length_scale": 0.0, "time_base": 0.0, "spin": 0.2, "attitude": 0.3}
"""Measurement errors of a recording, with their standard deviations where a file says nothing.

Spins read from video are off by 10 to 20 %, and the attitude of a thrown disc is within 17 degrees of level.
"""
FIGURES = ("mass", "diameter")
SHAPES = ("ball", "disc")
AIR = 1.2
"""Density of air [kg/m^3]."""
EFFECTS = (
    "gravity", "uniform_acceleration", "drag_linear", "drag_quadratic", "magnus", "position_force", "time_force", "added_mass",
    *(entry.name for entry in TRACK_ENTRIES),
)  # fmt: skip
"""Effects that act on the centre of mass of a body."""
CONSTRAINTS: dict[str, tuple[tuple[str, ...], dict[str, float]]] = {
    "pendulum": (("length",), {}),
    "spring": (("stiffness",), {}),
    "axis": ((), {"stiffness": 0.0}),
    "plane": (("inertia",), {}),
    "bounce": (("floor", "restitution"), {"friction": 0.0, "inertia": 0.4}),
}
"""Figures of each type of constraint: those that must be given, and the others with the value that holds where they are not."""
FIGURE_UNITS = {"length": "m", "stiffness": "N/m", "inertia": "1", "floor": "m", "restitution": "1", "friction": "1"}
"""Unit of each figure; the stiffness of an axis is per moment of inertia [1/s^2]."""


@dataclass(frozen=True)
class Constraint:
    """What guides or returns a body: a key of `CONSTRAINTS` with its figures."""

    type: str
    figures: dict[str, float]
    normal: Vector | None = None
    """Unit normal of the plane on which a body rolls; None: against gravity."""

    def unit(self, figure: str) -> str:
        """Return the unit of a figure."""
        return "1/s^2" if self.type == "axis" else FIGURE_UNITS[figure]


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
    attitude: Vector | None = None
    """Normal of a disc at the start; None if unknown."""
    angle: bool = False
    """Whether `x` is an angle [rad], (n, 1)."""
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
    nuisances: dict[str, float] = field(default_factory=lambda: dict(NUISANCES))
    """Standard deviation of the measurement errors of a recording: release_time [s], length_scale, time_base and spin [-] (relative) and
    attitude [rad]."""
    bodies: dict[str, dict[str, float]] = field(default_factory=dict)
    """mass [kg] and diameter [m] of each body, if known."""
    recordings: tuple[Track, ...] = ()
    constraint: Constraint | None = None
    """What guides the bodies; None: they fly."""
    fluid_density: float = AIR
    """Density of what the bodies move in [kg/m^3]."""
    shapes: dict[str, str] = field(default_factory=dict)
    """`ball` or `disc` of each body, if known."""

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
        gravity, effects, free, constraint, fluid = _model(content["model"] if model is None else model)
        given = mapping(content.get("nuisances") or {}, "nuisances")
        check_keys(given, "nuisances", tuple(NUISANCES), tuple(NUISANCES))
        nuisances = NUISANCES | {key: number(value, f"nuisances.{key}", least=0.0) for key, value in given.items()}
        bodies, shapes = _bodies(content["bodies"])
        recordings = read_entries(
            content["recordings"], "recordings", "recording", lambda entry, where: _recording(entry, where, bodies, file.parent)
        )
        for body, figures in bodies.items():
            check_figures(body, figures)
        for i, track in enumerate(recordings):
            where = f"recordings[{i}] ({track.name})"
            axes = [ANGLE] if track.angle else [AXES[a] for a in track.axes]
            check_track(track.t, track.x, axes, where, free=constraint is None)
            check_constraint(constraint, track, bodies[track.body], gravity, where)
            if constraint is None and not track.angle and any(gravity[a] for a in track.axes):
                along = [gravity[a] for a in track.axes]
                check_upright(track.t, track.x, along, axes, where)
                if nuisances["release_time"] == 0.0:
                    check_released(track.t, track.x, along, where)
            for column, a in enumerate(track.axes if constraint is None else ()):
                if abs(gravity[a]) > 1.0:
                    check_bounces(track.t, -math.copysign(1.0, gravity[a]) * track.x[:, column], AXES[a], where)
                check_flight(track.t, track.x[:, column], gravity[a], AXES[a], f"recordings[{i}] ({track.name})")
        for body in bodies:
            if not any(track.body == body and track.role == "fit" for track in recordings):
                raise UserError(f"recordings has no entry of the body {body!r} with role fit: give at least one")
    return Tracks(name, file.parent, gravity, effects, free, nuisances, bodies, recordings, constraint, fluid, shapes)


def _model(given: Any) -> tuple[Vector, dict[str, float], tuple[str, ...], Constraint | None, float]:
    optional = ("effects", "free", "constraint", "fluid_density")
    check_keys(given, "model", ("gravity", *optional), optional)
    gravity = vector(given["gravity"], "model.gravity")
    effects = read_effects(given.get("effects"), "model.effects", known=EFFECTS)
    constraint = None if given.get("constraint") is None else _constraint(given["constraint"], gravity)
    own = () if constraint is None else tuple(key for key in constraint.figures if key != "inertia")
    fluid = number(given.get("fluid_density", AIR), "model.fluid_density", least=0.0)
    return gravity, effects, read_free(given.get("free", []), ("gravity", *own, *effects)), constraint, fluid


def _constraint(given: Any, gravity: Vector) -> Constraint:
    given = mapping(given, "model.constraint")
    kind = given.get("type")
    if not isinstance(kind, str) or kind not in CONSTRAINTS:
        raise UserError(f"model.constraint.type = {kind!r} is unknown: choose from {', '.join(CONSTRAINTS)}")
    needed, others = CONSTRAINTS[kind]
    more = (*others, *(("normal",) if kind == "plane" else ()))
    check_keys(given, f"model.constraint ({kind})", ("type", *needed, *more), more)
    if kind in ("pendulum", "bounce") and not any(gravity):
        raise UserError(f"model.constraint: a {kind} needs gravity, and model.gravity is zero")
    figures = dict(others)
    for key in (*needed, *others):
        if key in given:
            limits = {"above": 0.0} if key in ("length", "restitution") or (key == "stiffness" and kind == "spring") else {"least": 0.0}
            figures[key] = number(given[key], f"model.constraint.{key}", **({} if key == "floor" else limits))
    if figures.get("restitution", 0.0) > 1.0:
        raise UserError(f"model.constraint.restitution = {figures['restitution']:g} must be at most 1: no bounce gains speed")
    normal = None
    if given.get("normal") is not None:
        normal = vector(given["normal"], "model.constraint.normal")
        size = math.hypot(*normal)
        if size == 0:
            raise UserError("model.constraint.normal must not be zero")
        normal = (normal[0] / size, normal[1] / size, normal[2] / size)
    return Constraint(kind, figures, normal)


def check_constraint(constraint: Constraint | None, track: Track, figures: Mapping[str, float], gravity: Vector, where: str) -> None:
    """Check that a recording has what its constraint needs.

    Raises:
        UserError: A column, an axis or a figure of the body is missing; the message says which, and for what.
    """
    kind = None if constraint is None else constraint.type
    if track.angle and kind not in ("pendulum", "axis"):
        raise UserError(f"{where}.columns has angle: give model.constraint of the type pendulum or axis, or coordinates")
    if kind == "axis" and not track.angle:
        raise UserError(f"{where}.columns has no angle: a body on an axis needs its angle [rad] over time")
    down = int(np.argmax(np.abs(gravity)))
    if kind == "pendulum" and not track.angle and len(track.axes) != 2:
        raise UserError(f"{where}.columns: a pendulum needs its angle [rad], or two coordinates, {AXES[down]} and a horizontal one")
    if kind in ("pendulum", "bounce") and not track.angle and down not in track.axes:
        raise UserError(f"{where}.columns has no {AXES[down]}, along gravity: a {kind} needs it")
    if kind == "spring" and len(track.axes) != 1:
        raise UserError(f"{where}.columns: a mass on a spring needs one coordinate, along the spring, and has {len(track.axes)}")
    if kind == "spring" and "mass" not in figures:
        raise UserError(f"bodies.{track.body} has no mass: a spring's stiffness [N/m] needs it")
    if kind == "bounce" and constraint.figures["friction"] and track.spin is not None and "diameter" not in figures:
        raise UserError(f"bodies.{track.body} has no diameter: the friction of a spinning body in a bounce needs it")


def _bodies(given: Any) -> tuple[dict[str, dict[str, float]], dict[str, str]]:
    bodies = mapping(given, "bodies")
    if not bodies:
        raise UserError("bodies is empty: give at least one body")
    out, shapes = {}, {}
    for name, figures in bodies.items():
        file_name(name, "the name of a body")
        figures = dict(mapping(figures or {}, f"bodies.{name}"))
        check_keys(figures, f"bodies.{name}", (*FIGURES, "shape"), (*FIGURES, "shape"))
        shape = figures.pop("shape", None)
        if shape is not None and shape not in SHAPES:
            raise UserError(f"bodies.{name}.shape = {shape!r} is unknown: choose from {', '.join(SHAPES)}, or leave it out")
        shapes |= {} if shape is None else {name: shape}
        out[name] = {key: number(value, f"bodies.{name}.{key}", above=0.0) for key, value in figures.items()}
    return out, shapes


def _recording(entry: Any, where: str, bodies: Mapping[str, Any], folder: Path) -> Track:
    optional = ("rows", "spin", "attitude", "noise", "scale")
    check_keys(entry, where, ("name", "body", "file", "columns", "role", *optional), optional)
    name = file_name(entry["name"], f"{where}.name")
    where = f"{where} ({name})"
    if not isinstance(entry["body"], str) or entry["body"] not in bodies:
        raise UserError(f"{where}.body = {entry['body']!r} is unknown: choose from {', '.join(bodies)}")
    role = read_role(entry["role"], where)
    columns = mapping(entry["columns"], f"{where}.columns")
    check_keys(columns, f"{where}.columns", ("t", *AXES, ANGLE), (*AXES, ANGLE))
    axes = tuple(a for a, key in enumerate(AXES) if key in columns)
    angle = ANGLE in columns
    if not axes and not angle:
        raise UserError(
            f"{where}.columns has none of {', '.join(AXES)}: give at least one coordinate, or the angle of a pendulum or an axis"
        )
    if axes and angle:
        raise UserError(f"{where}.columns has coordinates and an angle: give one of the two")
    scale = mapping(entry.get("scale", {}), f"{where}.scale")
    check_keys(scale, f"{where}.scale", ("t", *AXES, ANGLE), ("t", *AXES, ANGLE))
    for key, factor in scale.items():
        if not number(factor, f"{where}.scale.{key}", above=0.0 if key == "t" else -math.inf):
            raise UserError(f"{where}.scale.{key} must not be zero")
    data, _ = read_columns(folder, entry, where, scale=scale)
    attitude = None if entry.get("attitude") is None else vector(entry["attitude"], f"{where}.attitude")
    if attitude is not None and not any(attitude):
        raise UserError(f"{where}.attitude is zero: give the direction of the disc's axis")
    return Track(
        name=name,
        body=entry["body"],
        role=role,
        t=check_increasing(data["t"], where),
        x=data[ANGLE][:, None] if angle else np.stack([data[AXES[a]] for a in axes], 1),
        axes=axes or (0,),
        angle=angle,
        attitude=attitude,
        spin=vector(entry["spin"], f"{where}.spin") if entry.get("spin") is not None else None,
        noise=number(entry["noise"], f"{where}.noise", above=0.0) if entry.get("noise") is not None else None,
    )
