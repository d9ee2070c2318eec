"""Rows of the real measurements, each written in other ways that should change no answer.

    python -m tests.discrepancy.real_rows --out research/results/loop_invariances.md [--rows fish-relax,laos]

As a command it diagnoses every row in every way with all effects that its kind of test could show, and writes the table of the answers.
"""

import argparse
import math
import os
import sys
import tempfile
import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from neuido.data.files.writing import write_text
from neuido.discrepancy.inference.search.attribution import diagnose
from neuido.discrepancy.problems.problem import Problem
from neuido.discrepancy.problems.specimens.material import MaterialProblem
from neuido.discrepancy.problems.tracks.track_problem import track_problems
from neuido.discrepancy.workflow import restricted

SOLID = {"elasticity": {"law": "neo_hookean", "young": 3.0e5, "poisson": 0.499}, "plasticity": {"law": "identity"}}
CREEP_STRESS, CREEP_ROWS = 100.0, 60
"""Shear stress that the creep compliance is multiplied by [Pa], and rows that are kept, evenly in the logarithm of the time."""
CURVES = {
    "oscillation": (
        "oscillation-polystyrene.csv",
        {"density": 1000.0, **SOLID, "free": ["young"], "incompressible": True},
        {"angular_frequency": "Angular Frequency", "storage_modulus": "Storage Modulus", "loss_modulus": "Loss Modulus"},
    ),
    "flow_curve": (
        "flow-curve-emulsion-0.70.csv",
        {"density": 1000.0, "flow": {"law": "newtonian", "viscosity": 10.0}, "free": ["viscosity"]},
        {"shear_rate": "Shear Rate", "shear_stress": "Stress"},
    ),
    "creep": (
        "creep-polystyrene-160C.csv",
        {"density": 1000.0, **SOLID, "free": ["young"], "incompressible": True},
        {"time": "Time", "shear": "Creep Compliance", "shear_stress": "Creep Compliance"},
    ),
}
"""Rheometer curves, which come without a folder of their own: file, declared model, columns."""
ROWS = {
    "treloar-rubber": "strain_stiffening,second_invariant",
    "silicone-EF30_25T": "strain_stiffening,second_invariant",
    "kawabata-rubber": "second_invariant,strain_stiffening",
    "diani-rubber": "fibre,second_invariant",
    "fish-relax": "relaxation_spectrum,creep,yield",
    "steel-s2": "nonlinear_backstress,kinematic_hardening",
    "cyclic-steel": "nonlinear_backstress,kinematic_hardening",
    "laos": "creep,hysteresis",
    "oscillation": "fractional,hysteresis",
    "flow_curve": "herschel_bulkley,power_law",
    "creep": "creep,viscosity_shear",
}
"""Material tests, with the effects that each is asked of by the tests; the first is in its answer."""
BALLS = ("bowling-ball", "golf-ball", "whiffle-ball-1", "volleyball")
DRAG = "drag_linear,drag_quadratic,added_mass"
"""Bodies of the folder of drops, and the effects that the tests ask of them."""
STRESSES = ("nominal_stress", "true_stress", "shear_stress", "storage_modulus", "loss_modulus")
INDEPENDENT = ("oscillation", "flow_curve")
"""Rows of which the order says nothing."""
FEWER = ("thinned", "twice")
"""Ways that change how much is measured, so that the members of a class may differ."""


def ways_of(row: str) -> dict[str, dict[str, Any]]:
    """Return the ways in which a row is written, by name, as options of `written`."""
    if row in BALLS:
        return {"clock": {"origin": 1.7e6}, "unit": {"unit": 0.001}, "axis": {"axis": "z"}, "order": {"backwards": True},
                "thinned": {"every": 2}, "twice": {"twice": True}}  # fmt: skip
    ways: dict[str, dict[str, Any]] = {
        "unit": {"unit": 1e3},
        "order": {"backwards": True},
        "thinned": {"every": 2},
        "twice": {"twice": True},
    }
    if row not in INDEPENDENT:
        ways["clock"] = {"origin": 1.7e6}
    if row in INDEPENDENT:
        ways["rows"] = {"mixed": True}
    if row not in CURVES:
        ways["axis"] = {"axis": True}
    return ways


def written(data_root: Path, target: Path, row: str, **options: Any) -> Path:
    """Write one row in a way that `ways_of` names (without options: as it is), and return the folder."""
    return (_drop if row in BALLS else _tests)(data_root / "measured", target, row, **options)


def _source(measured: Path, row: str) -> tuple[dict[str, Any], Path]:
    """Return the content of test.yaml and the folder of the files."""
    if row not in CURVES:
        return yaml.safe_load((measured / row / "test.yaml").read_text()), measured / row
    file, model, columns = CURVES[row]
    entry: dict[str, Any] = {"name": row, "file": file, "mode": row, "columns": columns, "role": "fit"}
    if row == "creep":
        entry |= {"mode": "simple_shear", "control": "stress"}
    return {"format": "neuido-material-test/1", "name": row, "model": model, "tests": [entry]}, measured / "rheometer-curves"


def _tests(
    measured: Path, target: Path, row: str, *, origin: float = 0.0, unit: float = 1.0, axis: bool = False, backwards: bool = False,
    mixed: bool = False, every: int = 1, twice: bool = False,
) -> Path:  # fmt: skip
    content, source = _source(measured, row)
    target.mkdir()
    tests = content["tests"]
    tables = {file: _table(source / file) for file in {test["file"] for test in tests}}
    for test in tests:
        own = {key: f"c{i}" for i, key in enumerate(test["columns"])}
        table = tables[test["file"]]
        rows = np.stack([np.asarray(table[title], dtype=float) for title in test["columns"].values()], 1)
        if row == "creep":
            rows = _as_shear(rows)
        rows = rows[::every]
        if "time" in own:
            rows[:, list(own).index("time")] += origin
        scale = {key: float(test.get("scale", {}).get(key, 1.0)) for key in own}
        for i, key in enumerate(own):
            if key.startswith(STRESSES):
                rows[:, i] /= unit
                scale[key] *= unit
        if mixed:
            rows = np.random.default_rng(0).permutation(rows)
        columns = "-".join(test["columns"].values()).replace(" ", "_")  # tests of one specimen share a file, others do not
        file = f"{test['file'].partition('.')[0]}-{columns}.csv"
        np.savetxt(target / file, rows, delimiter=",", header=",".join(own.values()), comments="", fmt="%.12g")
        if axis:
            x, y, z = test.get("direction", [1, 0, 0])
            test["direction"] = [y, x, z]
        if "rows" in test:
            test["rows"] = [math.ceil(n / every) for n in test["rows"]]
        test |= {"file": file, "columns": own, "scale": scale}
    if twice:
        (target / "again.csv").write_bytes((target / tests[0]["file"]).read_bytes())
        tests.append(tests[0] | {"name": "again", "file": "again.csv"})
    content["tests"] = tests[::-1] if backwards else tests
    (target / "test.yaml").write_text(yaml.safe_dump(content))
    return target


def _table(path: Path) -> np.ndarray:
    delimiter = "," if "," in path.read_text() else "\t"
    return np.genfromtxt(path, delimiter=delimiter, names=True, deletechars="", replace_space=" ")


def _as_shear(rows: np.ndarray) -> np.ndarray:
    """Return time, shear and shear stress (n, 3) of a creep compliance, from rest on."""
    log = np.log(rows[:, 0])
    kept = np.unique(np.searchsorted(log, np.linspace(log[0], log[-1], CREEP_ROWS)).clip(max=len(rows) - 1))
    out = rows[kept]
    out[:, 1] *= CREEP_STRESS
    out[:, 2] = CREEP_STRESS
    return out


def _drop(
    measured: Path, target: Path, body: str, *, origin: float = 0.0, unit: float = 1.0, axis: str = "y", backwards: bool = False,
    every: int = 1, twice: bool = False,
) -> Path:  # fmt: skip
    """Write the folder of all drops, which together tell effects of the surroundings; a repeat is one of `body`."""
    source = measured / "bridge-balls"
    content = yaml.safe_load((source / "track.yaml").read_text())
    target.mkdir()
    recordings = content["recordings"]
    if twice:
        recordings.append({**next(r for r in recordings if r["body"] == body), "name": "again"})
    for entry in recordings:
        rows = np.loadtxt(source / entry["file"], delimiter=",", skiprows=1)[::every]
        entry["file"] = f"{entry['name']}.csv"
        np.savetxt(target / entry["file"], rows * [1.0, 1 / unit] + [origin, 0.0], delimiter=",", header="t_s,height", comments="",
                   fmt="%.12g")  # fmt: skip
        entry["columns"] = {"t": "t_s", axis: "height"}
        entry["scale"] = {axis: unit}
    content["model"]["gravity"] = [-9.81 if a == axis else 0.0 for a in "xyz"]
    content["recordings"] = recordings[::-1] if backwards else recordings
    (target / "track.yaml").write_text(yaml.safe_dump(content))
    return target


def problem_of(folder: Path, row: str) -> Problem:
    """Return the problem of a row in a folder that `written` made."""
    if (folder / "test.yaml").is_file():
        return MaterialProblem(folder)
    return next(problem for problem in track_problems(folder) if problem.labels["body"] == row)


def answered(problem: Problem, effects: str | None, **options: Any) -> tuple[str, set[str], Any]:
    """Return the answer, all effects of its classes, and the result of the search."""
    found = diagnose(problem if effects is None else restricted(problem, effects), draws=39, **options)
    names = {t.candidate.name for r in found.rounds if r.chosen is not None for t in r.members} if found.effects else set()
    return found.answer, names | {t.candidate.name for t in found.effects}, found


def _cells(row: str, data_root: Path, folder: Path) -> Mapping[str, str]:
    """Return the answer of each way, as text of a table."""
    out: dict[str, str] = {}
    first: tuple[str, set[str]] | None = None
    for way, options in {"as it is": {}, **ways_of(row)}.items():
        begun = time.process_time()
        answer, names, found = answered(problem_of(written(data_root, folder / f"{row}-{way}", row, **options), row), None)
        text = f"{answer}: {', '.join(sorted(names))}" if names else answer
        if first is None:
            first = answer, names
            out[way] = f"{text} ({time.process_time() - begun:.0f} s)"
            continue
        main = {t.candidate.name for t in found.effects}
        same = (answer, names) == first
        near = bool(main) == bool(first[1]) and main <= first[1]
        out[way] = "same" if same else f"within: {text}" if near else f"**other**: {text}"
    return out


INTRODUCTION = """# Diagnosis: real rows in other ways

Each row is diagnosed with all effects that its kind of test could show, as it is and written in other ways: the clock starts at 1.7e6 s,
the unit is a thousandth or a thousandfold, axes change their names, tests or recordings come in reverse order, rows without an order are
permuted, every second row is left out, a test is given twice. `same`: the same answer with the same effects in its classes. `within`: an
answer of the same kind whose effects were in the classes before. Seconds are of the processor.

"""


def _main() -> None:
    parser = argparse.ArgumentParser(description="Diagnose real rows in ways that should change no answer, and write the table.")
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--rows", default=",".join((*ROWS, *BALLS)))
    given = parser.parse_args()
    data_root = Path(os.environ["NEUIDO_DATA"])
    columns = ("as it is", "clock", "unit", "axis", "order", "rows", "thinned", "twice")
    lines = [f"| row | {' | '.join(columns)} |", "| --- " * (len(columns) + 1) + "|"]
    with tempfile.TemporaryDirectory() as folder:
        for row in given.rows.split(","):
            cells = _cells(row, data_root, Path(folder))
            lines.append(f"| {row} | " + " | ".join(cells.get(name, "") for name in columns) + " |")
            print(lines[-1], file=sys.stderr, flush=True)
            write_text(given.out, INTRODUCTION + "\n".join(lines) + "\n")


if __name__ == "__main__":
    _main()
