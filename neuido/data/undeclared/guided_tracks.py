"""Generate tracks of guided bodies, discs and balls in water with an undeclared effect: `Case.measured` = guided."""

import functools
import math
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import yaml

from neuido.data.files.writing import write_text
from neuido.data.measured.track import read_tracks
from neuido.data.undeclared.case import Case
from neuido.data.undeclared.curve_files import PAIR, drawn_effects, values_of
from neuido.data.undeclared.random_effects import Drawn, rms, rounded_to_4
from neuido.errors import UserError
from neuido.physics.effects.library import LIBRARY
from neuido.physics.points.point_mass import Forces, fly

G = 9.81
UP = np.array([0.0, 1.0, 0.0])
STEP = 1e-3
"""Time step of the true motion [s]."""


class Guided(NamedTuple):
    """One true experiment without an effect."""

    constraint: dict[str, float | str] | None
    """The declared constraint."""
    forces: dict[str, Any]
    """Forces of the true motion."""
    start: np.ndarray
    """Position (3,) and velocity (3,) at the start of each recording, (R, 6)."""
    seconds: float
    columns: tuple[str, ...]
    """Measured columns."""
    free: tuple[str, ...] = ()
    body: Mapping[str, Any] = {}
    model: Mapping[str, Any] = {}
    length: float = 1.0
    """Length of a pendulum [m]."""


def _pendulum(rng: np.random.Generator) -> Guided:
    length = round(rng.uniform(0.4, 1.2), 3)
    angle = rng.uniform(0.3, 0.9, 3) * rng.choice([-1, 1], 3)
    start = np.zeros((3, 6))
    start[:, 0] = length * angle
    declared = round(length * rng.uniform(0.96, 1.04), 3)
    columns = ("angle",) if rng.random() < 0.5 else ("x", "y")
    forces = {"gravity": (0.0, 0.0, 0.0), "pendulum": (G, length)}
    return Guided({"type": "pendulum", "length": declared}, forces, start, rng.uniform(6.0, 14.0), columns, ("length",), length=length)


def _spring(rng: np.random.Generator) -> Guided:
    mass, rate = round(rng.uniform(0.1, 0.5), 3), rng.uniform(4.0, 9.0)
    start = np.zeros((3, 6))
    start[:, 0] = rng.uniform(0.05, 0.15, 3)
    declared = float(f"{mass * rate**2 * rng.uniform(0.95, 1.05):.3g}")
    forces = {"gravity": (0.0, 0.0, 0.0), "position_force": rate**2}
    return Guided({"type": "spring", "stiffness": declared}, forces, start, rng.uniform(5.0, 9.0), ("y",), ("stiffness",), {"mass": mass})


def _axis(rng: np.random.Generator) -> Guided:
    start = np.zeros((3, 6))
    start[:, 3] = rng.uniform(5.0, 25.0, 3)
    return Guided({"type": "axis"}, {"gravity": (0.0, 0.0, 0.0)}, start, rng.uniform(8.0, 15.0), ("angle",))


def _plane(rng: np.random.Generator) -> Guided:
    heading, speed = rng.uniform(0, 2 * math.pi, 3), rng.uniform(0.8, 2.5, 3)
    start = np.zeros((3, 6))
    start[:, 3], start[:, 5] = speed * np.cos(heading), speed * np.sin(heading)
    return Guided({"type": "plane", "inertia": 0.4}, {"gravity": (0.0, 0.0, 0.0)}, start, rng.uniform(1.5, 3.0), ("x", "z"))


def _bounce(rng: np.random.Generator) -> Guided:
    start = np.zeros((3, 6))
    start[:, 1], start[:, 3] = rng.uniform(0.6, 1.5, 3), rng.uniform(0.4, 1.5, 3)
    e = round(rng.uniform(0.7, 0.88), 3)
    forces = {"floor_normal": UP, "floor_height": 0.03, "restitution": e, "roundness": 0.4}
    declared = {"type": "bounce", "floor": 0.03, "restitution": round(e * rng.uniform(0.95, 1.05), 3)}
    body = {"diameter": 0.06, "shape": "ball"}
    return Guided(declared, forces, start, rng.uniform(1.6, 2.4), ("x", "y"), ("restitution",), body)


def _disc(rng: np.random.Generator) -> Guided:
    start = np.zeros((3, 6))
    start[:, 1], start[:, 3], start[:, 4] = 1.2, rng.uniform(9.0, 14.0, 3), rng.uniform(0.0, 2.5, 3)
    tilt = rng.normal(0.05, 0.1, 3)
    drag = round(rng.uniform(0.012, 0.025), 4)
    forces = {"drag_quadratic": drag, "disc_normal": np.stack([-np.sin(tilt), np.cos(tilt), 0 * tilt], axis=1)}
    model = {"effects": {"drag_quadratic.k": round(drag * rng.uniform(0.8, 1.2), 4)}}
    body = {"mass": 0.175, "diameter": 0.27, "shape": "disc"}
    return Guided(None, forces, start, rng.uniform(0.9, 1.3), ("x", "y"), ("drag_quadratic.k",), body, model)


def _water(rng: np.random.Generator) -> Guided:
    start = np.zeros((3, 6))
    start[:, 4] = rng.uniform(-0.2, 0.6, 3)
    body = {"mass": round(0.0335 * rng.uniform(1.5, 4.0), 4), "diameter": 0.04, "shape": "ball"}
    return Guided(None, {}, start, rng.uniform(0.4, 0.7), ("x", "y"), (), body, {"fluid_density": 1000.0})


GUIDES: dict[str, Callable[[np.random.Generator], Guided]] = {
    "pendulum": _pendulum, "spring": _spring, "axis": _axis, "plane": _plane, "bounce": _bounce, "disc": _disc, "water": _water,
}  # fmt: skip
DAMPINGS = ("drag_linear", "drag_quadratic", "dry_friction")
KINDS = {
    **{f"{guide}:{kind}": kind for guide in ("pendulum", "spring", "axis", "plane") for kind in DAMPINGS},
    **{f"{guide}:local_force": "local_force" for guide in ("pendulum", "spring")},
    "plane:uniform_acceleration": "uniform_acceleration", "bounce:drag_quadratic": "drag_quadratic",
    "bounce:bounce_friction": "bounce_friction", "bounce:bounce_speed": "bounce_speed", "disc:lift": "lift", "water:buoyancy": "buoyancy",
}  # fmt: skip
"""The effect of each kind of case, "guide:effect"."""
PAIRS = {f"{guide}:drag_linear+dry_friction": "drag_linear+dry_friction" for guide in ("pendulum", "spring", "axis")}
"""The two effects of each kind of case that has two."""


def guided_case(
    rng: np.random.Generator, case: Case, name: str, device: str, advance: Callable[[int], Any]
) -> tuple[Callable[[Path], None], dict[str, Any]]:
    """Draw a track of a guided body; return a function that writes its folder, and the content of its key.

    The computation runs on the CPU; `device` is not used.

    Raises:
        UserError: An option does not apply to the kind of data.
        Redraw: The drawn values make no usable case.
    """
    for option in ("solver", "nuisances", "particles", "seconds"):
        if getattr(case, option):
            raise UserError(f"case.{option} = {getattr(case, option)} applies to bodies only: remove it, or give case.measured = body")
    if case.kind is not None and case.kind not in ("none", *KINDS, *PAIRS):
        raise UserError(f"case.kind = {case.kind!r} does not suit case.measured = guided: choose from none, {', '.join((*KINDS, *PAIRS))}")
    kind = case.kind or ("none" if rng.random() < 1 / 3 else str(rng.choice(list(KINDS if rng.random() < 1 - PAIR else PAIRS))))
    guide = str(rng.choice([g for g in GUIDES if g not in ("disc", "water")])) if kind == "none" else kind.partition(":")[0]
    made = GUIDES[guide](rng)
    fps = float(rng.choice([60.0, 100.0]))
    t = np.arange(round(made.seconds * fps)) / fps

    def seen(values: Mapping[str, float]) -> np.ndarray:
        advance(1)
        count = len(made.start)
        forces = Forces(**(made.forces | _forces(values, made)))
        x = fly(t, made.start[:, :3], made.start[:, 3:], np.zeros(count), forces, step=STEP)
        angle = x[..., 0] / made.length
        if made.columns == ("angle",):
            return angle[..., None]
        if guide == "pendulum":
            return np.stack([0.1 + made.length * np.sin(angle), 1.5 - made.length * np.cos(angle)], axis=-1)
        return x[..., [0]] if guide == "spring" else x[..., ["xyz".index(c) for c in made.columns]]

    plain = seen({})
    noise = float(f"{rng.uniform(1.0, 3.0) * 1e-3 * (np.ptp(plain) if guide in ('spring', 'axis') else 1.0):.3g}")
    ratio = case.separation or float(np.exp(rng.uniform(np.log(20.0), np.log(80.0))))
    effects = {"none": "none", **KINDS, **PAIRS}[kind]
    sizes = {effect: (*_sizes(rng, made, effect), 1e-4, 100.0) for effect in effects.split("+") if effect != "none"}
    drawn = drawn_effects(effects, sizes, ratio * noise, noise, lambda values: rms((seen(values) - plain)[:2]))
    true = seen(values_of(drawn)) if drawn else plain
    roles, names = ("fit", "fit", "held_out"), ("run-1", "run-2", "run-3")
    rows = [
        {"name": n, "role": r, "separation_over_noise": rounded_to_4(rms(a - b) / noise)} for n, r, a, b in zip(names, roles, true, plain)
    ]
    truth = {
        "undeclared": [_entry(one) for one in drawn],
        "measured": "guided",
        "guide": guide,
        "simulated_with": f"a point mass, Runge-Kutta steps of {STEP:g} s",
        "noise": noise,
        "recordings": rows if drawn else [],
    }
    tables = [np.column_stack([t, one + noise * rng.normal(size=one.shape)]) for one in true]
    entries = [
        {"name": n, "body": "body", "file": f"{n}.csv", "columns": {c: c for c in ("t", *made.columns)}, "noise": noise, "role": r}
        for n, r in zip(names, roles)
    ]
    model = {"gravity": [0.0, -G if guide not in ("axis", "plane") else 0.0, 0.0], "free": list(made.free), **made.model}
    if guide == "plane":
        model["gravity"] = [0.0, -G, 0.0]
    if made.constraint:
        model["constraint"] = dict(made.constraint)
    content = {
        "format": "neuido-track/1", "name": name, "model": model, "nuisances": {},
        "bodies": {"body": dict(made.body)}, "recordings": entries,
    }  # fmt: skip
    return functools.partial(_write, content, tables, made.columns), truth


def _sizes(rng: np.random.Generator, made: Guided, effect: str) -> tuple[dict[str, float], str]:
    """Return the values of an effect before it is scaled, and the names of its sizes."""
    reach = float(np.abs(made.start[:, 0]).max())
    speed = max(float(np.abs(made.start[:, 3:]).max()), reach * 5.0)
    damping = 0.1 / made.seconds
    return {
        "drag_linear": ({"k": damping}, "k"),
        "drag_quadratic": ({"k": damping / max(speed, 1e-3)}, "k"),
        "dry_friction": ({"c": damping * speed}, "c"),
        "local_force": ({"a0": float(rng.choice([-1, 1])) * 0.05 * reach * 20.0, "x": rng.uniform(-0.4, 0.4) * reach,
                         "w": rng.uniform(0.2, 0.4) * reach}, "a0"),
        "uniform_acceleration": (dict(zip("xz", rng.normal(0.0, 0.05, 2))), "x z"),
        "bounce_friction": ({"mu": 0.1}, "mu"),
        "bounce_speed": ({"p": 0.05}, "p"),
        "lift": ({"k": 0.05, "d": 0.05}, "k d"),
        "buoyancy": ({"q": 1000.0 / (made.body.get("mass", 1.0) / (math.pi / 6 * made.body.get("diameter", 1.0) ** 3))}, "q"),
    }[effect]  # fmt: skip


def _forces(values: Mapping[str, float], made: Guided) -> dict[str, Any]:
    """Return the forces of an effect."""
    fields = {f"{entry.name}.{p.name}": p.field for entry in LIBRARY for p in entry.parameters}
    out: dict[str, Any] = {}
    for name, value in values.items():
        field, part = fields[name], name.partition(".")[2]
        if part in ("x", "y", "z"):
            out.setdefault(field, np.zeros(3))["xyz".index(part)] = value
        elif name == "buoyancy.q":
            out |= {"gravity": (0.0, -G * (1 - value), 0.0), "added_mass": 0.5 * value}
        else:
            out[field] = value
    return out


def _entry(drawn: Drawn) -> dict[str, Any]:
    """Describe an effect for the list `undeclared` of the key of a case."""
    entry = next(one for one in LIBRARY if one.name == drawn.kind)
    units = {p.name: p.unit for p in entry.parameters}
    values = {key.partition(".")[2]: value for key, value in drawn.values.items()}
    alike = {"buoyancy": ["gravity", "uniform_acceleration", "added_mass"]}
    return {
        "kind": drawn.kind,
        "diagnosis_names": [drawn.kind, *alike.get(drawn.kind, [])],
        "parameters": values,
        "sizes": [key.partition(".")[2] for key in drawn.sizes],
        "units": {key: units[key] for key in values},
        "meaning": entry.equation,
        "outside_library": False,
        "near": [],
    }


def _write(content: Mapping[str, Any], tables: list[np.ndarray], columns: tuple[str, ...], folder: Path) -> None:
    for entry, rows in zip(content["recordings"], tables, strict=True):
        lines = (("t", *columns), *([f"{value:.7g}" for value in row] for row in rows))
        write_text(folder / entry["file"], "".join(f"{','.join(line)}\r\n" for line in lines))
    write_text(folder / "track.yaml", yaml.safe_dump(dict(content), sort_keys=False, default_flow_style=None))
    read_tracks(folder)
