"""Generate material tests and tracks with an undeclared effect."""

import functools
import math
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
import yaml

from neuido.data.files.writing import write_text
from neuido.data.measured.track import read_tracks
from neuido.data.undeclared.case import Case
from neuido.data.undeclared.curve_files import PAIR, Sizes, drawn_effects, key_rows, outside_entry, values_of, write_csv, write_tests
from neuido.data.undeclared.laboratory_tests import form_of
from neuido.data.undeclared.random_effects import ELASTIC, PLASTIC, Drawn, Redraw, rms, rounded_to_4, truth_entry
from neuido.errors import UserError
from neuido.physics.effects.parameters import Effects
from neuido.physics.laws.classical import material
from neuido.physics.points.material_point import Specimen, stress_along
from neuido.physics.points.point_mass import Forces, fly
from neuido.types import Vector

TEST_KINDS = ("viscosity_shear", "maxwell", "hysteresis", "strain_stiffening", "second_invariant", "tension_compression", "yield",
              "hardening", "kinematic_hardening", "rate_yield", "softening", "stiffness_change", "relaxation_spectrum", "fractional",
              "mullins", "permanent_set", "nonlinear_backstress", "cyclic_hardening", "rate_power", "power_law", "carreau", "bingham",
              "herschel_bulkley", "thixotropy", "creep", "compaction")  # fmt: skip
YIELDING = ("hardening", "kinematic_hardening", "rate_yield", "nonlinear_backstress", "cyclic_hardening", "rate_power")
"""Effects of a body that is declared as one that yields."""
TRACK_KINDS = ("gravity", "uniform_acceleration", "drag_linear", "drag_quadratic", "magnus", "position_force")
TEST_PAIRS = ("viscosity_shear+strain_stiffening", "maxwell+mullins", "hysteresis+second_invariant", "hardening+nonlinear_backstress",
              "rate_power+kinematic_hardening", "maxwell+strain_stiffening")  # fmt: skip
TRACK_PAIRS = ("drag_quadratic+uniform_acceleration", "drag_linear+magnus", "gravity+drag_quadratic", "drag_quadratic+magnus")
TEST_OUTSIDE, TRACK_OUTSIDE = ("swinging_stiffness",), ("dry_drag",)
"""Effects that the library cannot express in a test or in a free flight."""
OUTSIDE = 0.1
"""Share of effects outside the library among the cases with an effect."""
PERIOD = 2.0
"""Period of the loading of a specimen [s]."""
SWING = 0.37
"""Period of `swinging_stiffness` over that of the loading."""


def curve_case(
    rng: np.random.Generator, case: Case, name: str, device: str, advance: Callable[[int], Any]
) -> tuple[Callable[[Path], None], dict[str, Any]]:
    """Draw a material test or a track; return a function that writes its folder, and the content of its key.

    The computation runs on the CPU; `device` is not used.

    Raises:
        UserError: An option does not apply to the kind of data.
        Redraw: The drawn values make no usable case.
    """
    for option in ("solver", "nuisances", "particles", "seconds"):
        if getattr(case, option):
            raise UserError(f"case.{option} = {getattr(case, option)} applies to bodies only: remove it, or give case.measured = body")
    tests = case.measured == "material_test"
    singles, pairs, outside = (TEST_KINDS, TEST_PAIRS, TEST_OUTSIDE) if tests else (TRACK_KINDS, TRACK_PAIRS, TRACK_OUTSIDE)
    kinds = (*singles, *pairs, *outside)
    if case.kind is not None and case.kind != "none" and case.kind not in kinds:
        raise UserError(f"case.kind = {case.kind!r} does not suit case.measured = {case.measured}: choose from none, {', '.join(kinds)}")
    kind = case.kind or _drawn_kind(rng, singles, pairs, outside)
    ratio = case.separation or float(np.exp(rng.uniform(np.log(20.0), np.log(80.0))))
    return (_test if case.measured == "material_test" else _track)(rng, kind, ratio, name, advance)


def _drawn_kind(rng: np.random.Generator, singles: tuple[str, ...], pairs: tuple[str, ...], outside: tuple[str, ...]) -> str:
    """Draw a kind: a third of the cases have no effect."""
    if rng.random() < 1 / 3:
        return "none"
    share = rng.random()
    return str(rng.choice(outside if share < OUTSIDE else pairs if share < OUTSIDE + PAIR else singles))


def _test(rng: np.random.Generator, kind: str, ratio: float, name: str, advance: Callable[[int], Any]):
    form = form_of(rng, kind)
    if form is not None:
        return form(rng, kind, ratio, name, advance)
    plastic = PLASTIC if set(kind.split("+")) & set(YIELDING) else ELASTIC
    if kind == "none" and rng.random() < 0.3:
        plastic = PLASTIC
    young = float(f"{math.exp(rng.uniform(math.log(1e5), math.log(1e6))):.3g}")
    elasticity = {"law": "sigma" if plastic == PLASTIC else "neo_hookean", "young": young, "poisson": round(rng.uniform(0.3, 0.45), 2)}
    plasticity: dict[str, Any] = {"law": plastic}
    reach = rng.uniform(0.35, 0.5)
    if plastic == PLASTIC:
        reach = rng.uniform(0.06, 0.1)
        plasticity["yield_stress"] = float(f"{young * rng.uniform(0.015, 0.025):.3g}")
    paths, n = [], 160
    plans: tuple = (
        ("slow", "uniaxial", "fit", 1.0, 1.0),
        ("flat", "equibiaxial", "fit", 0.6, 0.7),
        ("fast", "uniaxial", "held_out", 1.15, 0.4),
    )
    if kind == "compaction":  # it shows in large compression alone
        reach = rng.uniform(0.7, 0.9)
        plans = (("once", "uniaxial", "fit", 1.0, 1.0), ("deeper", "uniaxial", "held_out", 1.1, 1.0))
    for _, _, _, amount, period in plans:
        t = np.linspace(0.0, 2.25 * period * PERIOD, n)
        swing = np.sin(2 * np.pi * t / (period * PERIOD)) * (0.55 + 0.45 * t / t[-1])
        paths.append((t, np.exp(-reach * amount * swing**2 if kind == "compaction" else reach * amount * swing)))

    def stresses(values: Mapping[str, float]) -> list[np.ndarray]:
        swing = values.get("swinging_stiffness.a", 0.0)
        own = {key: value for key, value in values.items() if not key.startswith("swinging_stiffness.")}
        specimen = Specimen(*material(elasticity, plasticity), Effects.of(own), 1)
        found = []
        for (_, mode, *_), (t, path) in zip(plans, paths):
            given = torch.from_numpy(path)[:, None]
            stress = stress_along(specimen, mode, given, time=torch.from_numpy(t))[0, :, 0].numpy()
            found.append(stress * (1 + swing * np.sin(2 * np.pi * t / (SWING * PERIOD))))
        advance(1)
        if not all(np.isfinite(one).all() for one in found):
            raise Redraw("the stress of the specimen does not converge")
        return found

    plain = stresses({})
    noise = 3e-3 * max(float(np.abs(one).max()) for one in plain)
    flow = plasticity.get("yield_stress", young)
    sizes = _test_sizes(rng, young, flow)
    drawn = drawn_effects(kind, sizes, ratio * noise, noise, lambda values: rms(stresses(values)[0] - plain[0]))
    true = stresses(values_of(drawn)) if drawn else plain
    declared = float(f"{young * (rng.uniform(0.65, 0.85) if rng.random() < 0.5 else rng.uniform(1.2, 1.5)):.3g}")
    free = ["young", "yield_stress"] if plastic == PLASTIC and rng.random() < 0.5 else ["young"]
    start = {"young": declared} | ({"yield_stress": float(f"{1.3 * flow:.3g}")} if len(free) > 1 else {})
    roles, names = [plan[2] for plan in plans], [plan[0] for plan in plans]
    truth = {
        "undeclared": [_entry(one, tuple(free)) for one in drawn],
        "measured": "material_test",
        "material": {"elasticity": elasticity["law"], "plasticity": plastic,
                     **{k: v for part in (elasticity, plasticity) for k, v in part.items() if k != "law"}},
        "started_from": start,
        "simulated_with": "the law along the path",
        "noise": rounded_to_4(noise),
        "tests": key_rows(true, plain, noise, roles, names, "pa") if drawn else [],
    }  # fmt: skip
    tests = []
    for (title, mode, role, *_), (t, path), stress in zip(plans, paths, true):
        columns = {"time": "time_s", "stretch": "stretch", "nominal_stress": "stress_pa"}
        tests.append((title, mode, role, columns, np.stack([t, path, stress + noise * rng.normal(size=n)], axis=1)))
    model = {
        "density": 1000.0,
        "elasticity": {k: start.get(k, v) for k, v in elasticity.items()},
        "plasticity": {k: start.get(k, v) for k, v in plasticity.items()},
        "free": free,
    }
    return functools.partial(write_tests, name, model, tests), truth


def _entry(drawn: Drawn, free: tuple[str, ...] = ()) -> dict[str, Any]:
    """Describe an effect for the key."""
    if drawn.kind == "swinging_stiffness":
        meaning = f"stress times 1 + a sin(2 pi t / {SWING * PERIOD:g} s)"
        return outside_entry(drawn, meaning, {"a": "1"}, ("stiffness_change", "hysteresis", "viscosity_shear", "maxwell"))
    return truth_entry(drawn, free=free)


def _test_sizes(rng: np.random.Generator, young: float, flow: float) -> Sizes:
    """Return for each effect: initial values, names of the parameters to scale, and the smallest and largest scale factor."""
    return {
        "viscosity_shear": ({"eta": 0.01 * young * PERIOD}, "eta", 0.01, 30),
        "maxwell": ({"ratio": 0.3, "time": PERIOD * 10 ** rng.uniform(-1.3, 0.0)}, "ratio", 0.05, 8),
        "hysteresis": ({"eta": 0.15}, "eta", 0.1, 4),
        "strain_stiffening": ({"k": 0.3}, "k", 0.05, 8),
        "second_invariant": ({"c": 0.3}, "c", 0.05, 8),
        "tension_compression": ({"r": 0.3}, "r", 0.05, 6),
        "yield": ({"inverse": 6.0 / young}, "inverse", 0.2, 6),
        "hardening": ({"h": 0.05 * young}, "h", 0.02, 10),
        "kinematic_hardening": ({"h": 0.05 * young}, "h", 0.02, 10),
        "rate_yield": ({"eta": 0.1 * flow * PERIOD}, "eta", 0.02, 30),
        "softening": ({"s": 0.5}, "s", 0.05, 6),
        "relaxation_spectrum": (
            {**{f"g{i}": float(rng.uniform(0.02, 0.2)) for i in range(1, 6)}, "first": 0.02 * PERIOD, "last": 2 * PERIOD},
            "g1 g2 g3 g4 g5",
            0.05,
            20,
        ),
        "fractional": ({"ratio": 0.2, "exponent": rng.uniform(0.15, 0.5), "time": 0.2 * PERIOD}, "ratio", 0.05, 20),
        "mullins": ({"share": 0.1, "width": rng.uniform(0.2, 1.0)}, "share", 0.05, 8),
        "compaction": ({"k": 0.3, "lock": rng.uniform(1.2, 1.6)}, "k", 0.02, 20),
        "permanent_set": ({"share": 0.05}, "share", 0.05, 10),
        "nonlinear_backstress": ({"h1": 0.3 * young, "g1": 15.0}, "h1", 0.02, 20),
        "cyclic_hardening": ({"q": (-0.2 if rng.random() < 0.5 else 0.3) * flow, "b": 5.0}, "q", 0.02, 3),
        "rate_power": ({"k": 0.2 * flow, "n": rng.uniform(0.2, 0.6)}, "k", 0.02, 20),
        "swinging_stiffness": ({"a": 0.1}, "a", 0.05, 5),
        "stiffness_change": ({"rate": -0.1 if rng.random() < 0.5 else 0.1}, "rate", 0.05, 3),
    }


def _track(rng: np.random.Generator, kind: str, ratio: float, name: str, advance: Callable[[int], Any]):
    fps, seconds, noise = float(rng.choice([60.0, 100.0])), rng.uniform(0.8, 1.2), float(rng.choice([2e-3, 3e-3, 5e-3]))
    t = np.arange(round(seconds * fps)) / fps
    count = 4
    heading = rng.uniform(0, 2 * np.pi) + np.arange(count) * np.pi / 2 + rng.uniform(-0.3, 0.3, count)
    speed, up = rng.uniform(1.0, 4.0, count), rng.uniform(1.0, 5.0, count)
    velocity = np.stack([speed * np.cos(heading), up, speed * np.sin(heading)], axis=1)
    start = np.tile([0.0, 1.5, 0.0], (count, 1)) + rng.uniform(-0.3, 0.3, (count, 3))
    gravity = (0.0, -9.81, 0.0)

    def paths(values: Mapping[str, float]) -> np.ndarray:
        acting: dict[str, Any] = {"gravity": np.array(gravity)}
        for name in dict.fromkeys(key.partition(".")[0] for key in values):
            own = {key.partition(".")[2]: value for key, value in values.items() if key.startswith(f"{name}.")}
            if name == "gravity":
                acting["gravity"] = np.array(gravity) * (1 + own["g"] / 9.81)
            elif name in ("uniform_acceleration", "magnus"):
                acting[name] = np.array([own[a] for a in "xyz"])
            elif name == "position_force":
                acting |= {"position_force": own["k"], "position_centre": np.array([own[a] for a in "xyz"])}
            elif name == "dry_drag":
                acting["dry_friction"] = own["c"]
            else:
                acting[name] = own["k"]
        advance(1)
        return fly(t, start, velocity, np.zeros(count), Forces(**acting), step=2e-3)

    plain = paths({})
    sizes = _track_sizes(rng)
    drawn = drawn_effects(kind, sizes, ratio * noise, noise, lambda values: rms((paths(values) - plain)[:2]))
    true = paths(values_of(drawn)) if drawn else plain
    roles, names = ["fit", "fit", "held_out", "held_out"], [f"throw-{i + 1}" for i in range(count)]
    truth = {
        "undeclared": [_entry(one) for one in drawn],
        "measured": "track",
        "simulated_with": "a point mass, Runge-Kutta steps of 2 ms",
        "noise": noise,
        "recordings": key_rows(list(true), list(plain), noise, roles, names, "m") if drawn else [],
    }
    seen = true + noise * rng.normal(size=true.shape)
    rows = [(title, role, np.concatenate([t[:, None], x], axis=1)) for title, role, x in zip(names, roles, seen)]
    return functools.partial(_write_tracks, name, gravity, noise, rows), truth


def _track_sizes(rng: np.random.Generator) -> Sizes:
    """Return for each effect of a track the same as `_test_sizes`."""
    level = np.array([1.0, 0.2, 1.0]) * rng.normal(size=3)
    level /= np.linalg.norm(level)
    turn = rng.normal(size=3)
    turn /= np.linalg.norm(turn)
    place = np.array([0.0, 1.5, 0.0]) + rng.uniform(-1.0, 1.0, 3)
    return {
        "gravity": ({"g": -0.6 if rng.random() < 0.5 else 0.6}, "g", 0.05, 6),
        "uniform_acceleration": (dict(zip("xyz", level)), "x y z", 0.05, 3),
        "drag_linear": ({"k": 0.2}, "k", 0.02, 10),
        "drag_quadratic": ({"k": 0.05}, "k", 0.02, 10),
        "magnus": (dict(zip("xyz", 0.3 * turn)), "x y z", 0.05, 8),
        "dry_drag": ({"c": 0.5}, "c", 0.02, 10),
        "position_force": ({"k": 1.0, **dict(zip("xyz", place))}, "k", 0.05, 8),
    }


def _write_tracks(name: str, gravity: Vector, noise: float, tracks: Sequence[tuple[str, str, np.ndarray]], folder: Path) -> None:
    entries = []
    for title, role, rows in tracks:
        write_csv(folder / f"{title}.csv", ("t_s", "x_m", "y_m", "z_m"), rows)
        columns = {"t": "t_s", "x": "x_m", "y": "y_m", "z": "z_m"}
        entries.append({"name": title, "body": "ball", "file": f"{title}.csv", "columns": columns, "noise": noise, "role": role})
    content = {
        "format": "neuido-track/1", "name": name, "model": {"gravity": list(gravity), "effects": {}, "free": []},
        "nuisances": {"release_time": 0.002, "length_scale": 0.002, "time_base": 0.001}, "bodies": {"ball": {}}, "recordings": entries,
    }  # fmt: skip
    write_text(folder / "track.yaml", yaml.safe_dump(content, sort_keys=False, default_flow_style=None))
    read_tracks(folder)
