"""The effects that a tracked body may lack, with ranges and starts from its motion, and its declared parameters."""

import math
from collections.abc import Mapping, Sequence

import numpy as np

from neuido.data.measured.track import AXES, Track, Tracks
from neuido.discrepancy.problems.noise import high_pass
from neuido.discrepancy.problems.problem import Candidate, Parameter
from neuido.physics.effects.library import KNOTS, LIBRARY

LIGHTEST, SMALLEST = 30.0, 0.02
"""Least density [kg/m^3] and diameter [m] of a flying body, assumed where the folder does not give them."""
SPHERE_DRAG = 0.47
"""Drag coefficient of a smooth sphere at Reynolds numbers of 1e3 to 2e5 (Hoerner, Fluid-Dynamic Drag, 1965)."""
LARGEST_DRAG = 2.0
"""Upper limit of the drag coefficient of a compact body."""
DAMPED = 1000.0
"""Upper limit of the damping of a guided body, relative to a damping by a tenth within the recording."""
ABOVE_NOISE = 5.0
"""Displacement from which a speed is taken, in standard deviations of the noise."""
PLACES = (0.25, 0.5, 0.75)
"""Places within the range of the motion where the search of `local_force` begins."""
FARTHEST = 30.0
"""Ratio to a declared figure, either way, that ends the range of its fit: beyond it the declared unit is doubtful."""


def track_candidates(tracks: Tracks, body: str, flights: Sequence[Track]) -> tuple[Candidate, ...]:
    """Return the effects that a body may lack, with ranges and starts scaled by its motion; vectors have the measured axes alone.

    Args:
        tracks: The folder's content.
        body: Name of the body.
        flights: Recordings of the body as they are fitted.
    """
    fits = [track for track in flights if track.role == "fit"]
    constraint = tracks.constraint
    kind = None if constraint is None else constraint.type
    flies = kind in (None, "bounce")
    lever = constraint.figures["length"] if kind == "pendulum" else 1.0
    angle, one = fits[0].angle, kind in ("pendulum", "spring", "axis")
    size = lever if angle else 1.0  # from the unit of the data to that of the motion
    duration = max(float(np.ptp(track.t)) for track in flights)
    speed = size * max(typical_speed(track) for track in fits)
    axes = [0] if one else sorted({a for track in fits for a in track.axes})
    names = [AXES[a] for a in axes]
    g = float(np.linalg.norm(tracks.gravity)) or 9.81
    figures = tracks.bodies[body]
    diameter = figures.get("diameter", SMALLEST)
    density = LIGHTEST
    if len(figures) == 2:
        density = figures["mass"] / (math.pi / 6 * diameter**3)
    most = 0.75 * tracks.fluid_density * LARGEST_DRAG / (density * diameter)  # drag per mass of a sphere [1/m]
    small = 0.1 / (duration * speed)
    most = most if flies else max(most, DAMPED * small)
    out: list[Candidate] = []

    def add(name: str, start: Mapping[str, float], *parameters: tuple, sizes: str = "", others: Sequence[Mapping[str, float]] = ()) -> None:
        """Add a candidate with parameters (name, typical step, lower, upper); `sizes` are zero when it is absent (all where empty)."""
        entry = next(entry for entry in LIBRARY if entry.name == name)
        units = {p.name: p.unit for p in entry.parameters} | {"coefficient": "1"}
        if kind == "axis":
            units = {key: _of_angles(unit) for key, unit in units.items()}
        made = []
        for key, scale, lower, upper in parameters:
            value = tracks.effects.get(f"{name}.{key}", start[key] if sizes and key not in sizes.split() else 0.0)
            made.append(Parameter(f"{name}.{key}", units[key], value, scale, min(lower, value), max(upper, value)))
        starts = tuple({f"{name}.{k}": float(v) for k, v in one.items()} for one in (start, *others))
        out.append(Candidate(name, tuple(made), starts, entry.stage, sizes=tuple(f"{name}.{k}" for k in sizes.split())))

    def on_scales(name: str, key: str, first: float, step: float, upper: float) -> None:
        add(name, {key: first}, (key, step, 0.0, upper), others=[{key: min(4 * first, upper / 2)}])

    fixed = kind in (None, "bounce", "plane") or (kind == "pendulum" and "length" not in tracks.free)
    along = any(abs(tracks.gravity[a]) > 0 for a in axes) or kind == "pendulum"
    if fixed and along and "gravity" not in tracks.free:
        add("gravity", {"g": 0.05 * g}, ("g", 0.03 * g, -0.5 * g, 0.5 * g))
    if kind not in ("pendulum", "spring"):  # where they rest is not known before
        push = g if kind != "axis" else 10 * speed / duration
        add("uniform_acceleration", dict.fromkeys(names, 0.05 * push), *((a, 0.03 * push, -0.5 * push, 0.5 * push) for a in names))
    k = min(small, most / 2)
    on_scales("drag_linear", "k", k * speed, k * speed, 2 * most * speed)
    on_scales("drag_quadratic", "k", k, k, most)
    if not flies:
        on_scales("dry_friction", "c", small * speed**2, small * speed**2, DAMPED * small * speed**2)
    if len(axes) > 1:
        w = 0.1 / duration
        rates = [float(np.linalg.norm(track.spin)) for track in flights if track.spin is not None]
        turning = AXES if len(axes) == 3 else [a for i, a in enumerate(AXES) if i not in axes]
        if len(rates) == len(flights) and min(rates) > 0:
            add("magnus", {"coefficient": w / max(rates)}, ("coefficient", w / max(rates), -1.0, 1.0))
        else:
            add("magnus", dict.fromkeys(turning, w), *((a, w, -50 * w, 50 * w) for a in turning))
    k = 0.1 / duration**2
    centre = size * np.mean([track.x.mean(axis=0) for track in fits], axis=0)
    extent = size * float(np.max([np.ptp(track.x, axis=0).max() for track in fits]))
    places = dict(zip(names, map(float, centre), strict=False)) if not one else {"x": 0.0}
    shape = [(a, 0.2 * extent, c - 3 * extent, c + 3 * extent) for a, c in places.items()]
    if not one:
        add("position_force", {"k": k} | places, ("k", k, -100 * k, 100 * k), *shape, sizes="k")
    elif kind in ("spring", "axis") and "stiffness" not in tracks.free:
        mass = figures["mass"] if kind == "spring" else 1.0
        pull = max(constraint.figures["stiffness"] / mass, k)
        add("position_force", {"k": 0.03 * pull}, ("k", 0.03 * pull, -0.9 * pull, FARTHEST * pull))
    if not flies:
        a0, w = 0.1 * speed**2 / extent, extent / 8
        low = {a: (c - 0.5 * extent) for a, c in places.items()}
        begun = [{"a0": s * a0} | {a: low[a] + share * extent for a in places} | {"w": w} for share in PLACES for s in (1, -1)]
        bounds = [(a, 0.1 * extent, c - extent, c + extent) for a, c in places.items()]
        sized = ("a0", a0, -100 * a0, 100 * a0)
        add("local_force", begun[0], sized, *bounds, ("w", w, 0.01 * extent, 2 * extent), sizes="a0", others=begun[1:])
    knots = [f"{a}{j}" for j in range(KNOTS) for a in names]
    push = g if kind != "axis" else 10 * speed / duration
    add("time_force", dict.fromkeys(knots, 0.05 * push), *((key, 0.03 * push, -push, push) for key in knots))
    if flies:
        c = 0.5 * tracks.fluid_density / density  # the added mass of a sphere
        add("added_mass", {"c": 0.5 * c}, ("c", min(0.03, c), 0.0, c))
        if any(abs(tracks.gravity[a]) > 0 for a in axes):
            add("buoyancy", {"q": c}, ("q", min(0.03, c), 0.0, 3 * c))
    level = [a for a in axes if abs(tracks.gravity[a]) < 0.1 * g]
    if flies and tracks.shapes.get(body, "") == "disc" and level and len(axes) > 1:
        add("lift", {"k": small, "d": small}, ("k", small, -10 * most, 10 * most), ("d", small, 0.0, 10 * most))
    if kind == "bounce":
        if level and "friction" not in tracks.free:
            add("bounce_friction", {"mu": 0.1}, ("mu", 0.05, 0.0, 2.0))
        add("bounce_speed", {"p": 0.05}, ("p", 0.03, -0.5, 0.5))
    return tuple(out)


def ordinary_sizes(tracks: Tracks, body: str) -> dict[str, float]:
    """Return the sizes of effects that a flying sphere has by its mass, its diameter and what it moves in, by parameter."""
    figures = tracks.bodies[body]
    flies = tracks.constraint is None or tracks.constraint.type == "bounce"
    if not flies or len(figures) < 2 or tracks.shapes.get(body) == "disc" or tracks.fluid_density == 0:
        return {}
    area = math.pi / 4 * figures["diameter"] ** 2
    return {"drag_quadratic.k": tracks.fluid_density * SPHERE_DRAG * area / (2 * figures["mass"])}


def _of_angles(unit: str) -> str:
    """Return the unit of a quantity of a rotation for that of the same quantity along a path."""
    return {"m/s^2": "rad/s^2", "1/m": "1/rad", "m": "rad"}.get(unit, unit)


def typical_speed(track: Track) -> float:
    """Return the mean speed along a path, in the unit of the data per s; the way there and back counts twice.

    It is taken over the shortest number of frames in which the point moves `ABOVE_NOISE` standard deviations of the noise.
    """
    sigma = track.noise or high_pass([(track.t, channel) for channel in track.x.T]) or 0.0
    stride, speed = 1, 0.0
    while stride < len(track.t):
        moved = np.linalg.norm(track.x[stride:] - track.x[:-stride], axis=1)
        speed = float(np.mean(moved / (track.t[stride:] - track.t[:-stride])))
        if float(np.median(moved)) > ABOVE_NOISE * sigma:
            break
        stride *= 2
    return max(speed, 1e-9)


def declared_parameter(tracks: Tracks, name: str, flights: Sequence[Track]) -> Parameter:
    """Return the parameter of a declared figure that is fitted."""
    if name == "gravity":
        g = float(np.linalg.norm(tracks.gravity))
        return Parameter("gravity", "m/s^2", g, 0.03 * max(g, 1.0), 0.0, 3 * max(g, 1.0))
    effect, _, part = name.partition(".")
    if part:
        parameter = next(p for entry in LIBRARY if entry.name == effect for p in entry.parameters if p.name == part)
        value = tracks.effects[name]
        far = FARTHEST * abs(value)
        lower = min(parameter.low, -far if parameter.signed else 0.0)
        return Parameter(name, parameter.unit, value, max(0.1 * abs(value), 1e-4), lower, max(parameter.high, far))
    value, unit = tracks.constraint.figures[name], tracks.constraint.unit(name)
    if name == "floor":
        extent = max(float(np.ptp(track.x)) for track in flights)
        return Parameter(name, unit, value, 0.01 * extent, value - extent, value + extent)
    if name in ("restitution", "friction"):
        return Parameter(name, unit, value, 0.03, 0.0, 1.0 if name == "restitution" else 2.0)
    return Parameter(name, unit, value, 0.02, value / FARTHEST, value * FARTHEST, log=True)
