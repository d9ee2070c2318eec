"""What does not change the tests changes no answer: real material tests with another clock, unit, axis, order, sampling or a repeat."""

import math

import numpy as np
import pytest
import yaml

from neuido.discrepancy.inference.search.attribution import diagnose
from neuido.discrepancy.problems.specimens.material import MaterialProblem
from neuido.discrepancy.workflow import restricted

SOLID = {"elasticity": {"law": "neo_hookean", "young": 3.0e5, "poisson": 0.499}, "plasticity": {"law": "identity"}}
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
}
"""Rheometer curves, which come without a folder of their own."""
ROWS = {
    "treloar-rubber": "strain_stiffening,second_invariant",
    "silicone-EF30_25T": "strain_stiffening,second_invariant",
    "kawabata-rubber": "second_invariant,strain_stiffening",
    "diani-rubber": "fibre,second_invariant",
    "fish-relax": "relaxation_spectrum,creep",
    "steel-s2": "nonlinear_backstress,kinematic_hardening",
    "oscillation": "fractional,hysteresis",
    "flow_curve": "herschel_bulkley,power_law",
}
"""The rows, with two effects that each is asked of."""
STRESSES = ("nominal_stress", "true_stress", "shear_stress", "storage_modulus", "loss_modulus")
INDEPENDENT = ("oscillation", "flow_curve")
"""Rows of which the order says nothing."""


def source_of(data_root, row):
    """Return the content of test.yaml and the folder of the files."""
    folder = data_root / "measured" / (row if row not in CURVES else "rheometer-curves")
    if row not in CURVES:
        return yaml.safe_load((folder / "test.yaml").read_text()), folder
    file, model, columns = CURVES[row]
    entry = {"name": row, "file": file, "mode": row, "columns": columns, "role": "fit"}
    return {"format": "neuido-material-test/1", "name": row, "model": model, "tests": [entry]}, folder


def written(data_root, target, row, *, origin=0.0, unit=1.0, axis=False, backwards=False, mixed=False, every=1, twice=False):
    """Write one row in another way."""
    content, source = source_of(data_root, row)
    target.mkdir()
    tests = content["tests"]
    tables = {file: np.genfromtxt(source / file, delimiter="," if "," in (source / file).read_text() else "\t", names=True, deletechars="",
                                  replace_space=" ") for file in {t["file"] for t in tests}}  # fmt: skip
    for test in tests:
        own = {key: f"c{i}" for i, key in enumerate(test["columns"])}
        table = tables[test["file"]]
        rows = np.stack([np.asarray(table[title], dtype=float) for title in test["columns"].values()], 1)[::every]
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
        again = tests[0] | {"name": "again", "file": "again.csv"}
        (target / "again.csv").write_bytes((target / tests[0]["file"]).read_bytes())
        tests.append(again)
    content["tests"] = tests[::-1] if backwards else tests
    (target / "test.yaml").write_text(yaml.safe_dump(content))
    return target


def answered(folder, effects):
    """The answer, and all effects of its classes."""
    found = diagnose(restricted(MaterialProblem(folder), effects), draws=39, most=1)
    names = {t.candidate.name for r in found.rounds if r.chosen is not None for t in r.members} if found.effects else set()
    return found.answer, names | {t.candidate.name for t in found.effects}


@pytest.mark.slow
@pytest.mark.parametrize("row", ROWS)
def test_no_answer_changes(data_root, tmp_path, row):
    answer, names = answered(written(data_root, tmp_path / "plain", row), ROWS[row])
    assert answer in ("effect", "class") and ROWS[row].partition(",")[0] in names
    others = {"clock": {"origin": 1.7e6}, "unit": {"unit": 1e3}, "axis": {"axis": row not in CURVES}, "order": {"backwards": True},
              "mixed": {"mixed": row in INDEPENDENT}, "thinned": {"every": 2}, "twice": {"twice": True}}  # fmt: skip
    for name, options in others.items():
        again, same = answered(written(data_root, tmp_path / name, row, **options), ROWS[row])
        if name in ("thinned", "twice"):  # fewer data or more: the members of a class may differ
            assert again in ("effect", "class") and ROWS[row].partition(",")[0] in same, name
        else:
            assert (again, same) == (answer, names), name
