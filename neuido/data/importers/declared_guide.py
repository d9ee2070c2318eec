"""What guides a body whose track is imported: a pendulum, a spring, an axis, a plane or a floor, from a user's options."""

import math
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np

from neuido.data.files.values import number
from neuido.data.importers.tables.units import parse_quantity
from neuido.errors import UserError, suggest

GUIDES = ("none", "pendulum", "spring", "axis", "plane", "bounce")
FIGURES = {
    "length": ("the length from the pivot to the centre of mass", "--length '0.8 m'"),
    "stiffness": ("the stiffness of the spring in N/m, a rough value", "--stiffness 20"),
    "mass": ("the mass of the body in kg", "--mass 0.2"),
    "inertia": ("the moment of inertia over m r^2: 0.4 of a solid ball that rolls, 0 of a glider or a block that slides", "--inertia 0.4"),
    "floor": ("the height of the tracked point at contact in m", "--floor 0.02"),
    "restitution": ("the restitution, a rough value", "--restitution 0.8"),
}
"""What each figure is, and how it is given."""
FREE = ("length", "stiffness", "restitution")
"""Figures that are fitted, since a ruler or a guess gives them to a few percent."""
GRAVITY = 9.81
"""[m/s^2]"""
STEEPEST = 90.0
"""Largest tilt of a plane [deg]."""


class Guide(NamedTuple):
    """A user's options on what guides a body."""

    type: str = "none"
    length: str | None = None
    """Of a pendulum, with its unit."""
    stiffness: float | None = None
    """Of a spring [N/m]; of an axis per moment of inertia [1/s^2]."""
    inertia: float | None = None
    """Moment of inertia over m r^2 of a body on a plane."""
    restitution: float | None = None
    tilt: float | None = None
    """Angle of a plane [deg]; x points down the slope."""

    def figures(self, floor: float | None, mass: float | None) -> dict[str, float]:
        """Return the given figures in SI units."""
        length = None if self.length is None else parse_quantity(self.length, "m", "length")
        given = {"length": length, "stiffness": self.stiffness, "inertia": self.inertia, "restitution": self.restitution, "floor": floor,
                 "mass": mass}  # fmt: skip
        return {key: value for key, value in given.items() if value is not None}


def declared_guide(guide: Guide, *, floor: float | None, mass: float | None) -> tuple[dict[str, Any], list[str]]:
    """Return the key `model` of a track, and the lines of the summary.

    Raises:
        UserError: A figure is missing, out of range, or for another guide; the message names the option.
    """
    from neuido.data.measured.track import CONSTRAINTS

    level = [0.0, -GRAVITY, 0.0]
    needs = {kind: (*needed, *(("mass",) if kind == "spring" else ())) for kind, (needed, _) in CONSTRAINTS.items()}
    if guide.type not in GUIDES:
        raise UserError(f"--guide {guide.type} is unknown{suggest(guide.type, GUIDES)}: choose from {', '.join(GUIDES)}")
    given = guide.figures(floor, mass)
    own = set(needs.get(guide.type, ())) | ({"stiffness"} if guide.type == "axis" else set())
    wrong = next((key for key in given if key != "mass" and key not in own), None)
    if guide.tilt is not None and guide.type != "plane":
        wrong = "tilt"
    if wrong is not None:
        other = "--guide plane" if wrong == "tilt" else " or ".join(f"--guide {name}" for name, own in needs.items() if wrong in own)
        raise UserError(f"--{wrong} belongs to {other}, and the track is that of {_words(guide.type)}: leave it out, or give {other}")
    if guide.type == "none":
        said = f"the body flies freely under {GRAVITY:g} m/s^2 along -y (--guide pendulum, spring, axis, plane or bounce)"
        return {"gravity": level}, [said]
    for key in needs[guide.type]:
        if key not in given:
            what, option = FIGURES[key]
            raise UserError(f"--guide {guide.type} needs {what}: give {option}")
    figures = {key: number(value, f"--{key}") for key, value in given.items() if key in own and key != "mass"}
    free = [key for key in FREE if key in figures]
    model: dict[str, Any] = {"gravity": level, "constraint": {"type": guide.type, **figures}}
    if guide.tilt is not None:
        if not abs(guide.tilt) <= STEEPEST:
            raise UserError(f"--tilt {guide.tilt:g} must be an angle of at most {STEEPEST:g} degrees")
        angle = math.radians(guide.tilt)
        model["gravity"] = [GRAVITY * math.sin(angle), -GRAVITY * math.cos(angle), 0.0]
        model["constraint"]["normal"] = [0.0, 1.0, 0.0]
    if free:
        model["free"] = free
    said = ", ".join(f"{key} {value:g}{' (fitted)' if key in free else ''}" for key, value in figures.items())
    return model, [f"guided: {_words(guide.type)}{', ' + said if said else ''}; gravity {GRAVITY:g} m/s^2"]


def guided_axes(kind: str, x: np.ndarray, names: Sequence[str]) -> tuple[list[str], str]:
    """Return the axes that a guide leaves, of those of positions x (n, A), and a line for the summary; the line is empty where all stay."""
    reach = {name: float(np.ptp(x[:, a])) for a, name in enumerate(names)}
    kept = list(names)
    if kind == "spring":
        kept = [max(reach, key=reach.__getitem__)]
    elif kind == "pendulum" and len(names) == 3:
        kept = sorted(("y", max("xz", key=reach.__getitem__)))
    left = [name for name in names if name not in kept]
    return kept, f"{', '.join(left)} moves least and is left out for --guide {kind}" if left else ""


def _words(kind: str) -> str:
    return {"none": "a free flight", "pendulum": "a pendulum", "spring": "a mass on a spring", "axis": "a body on an axis",
            "plane": "a body on a plane", "bounce": "a body that bounces"}[kind]  # fmt: skip
