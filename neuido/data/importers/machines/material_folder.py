"""Write tables of testing machines and rheometers as a folder of material tests."""

import os
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from neuido.data.files.parsing import naming
from neuido.data.importers.machines.loading_path import LEAST_ROWS, Part, Preparation, holds_stress, loading_parts, prepare
from neuido.data.importers.machines.rheometer import read_curve, read_relaxation
from neuido.data.importers.machines.testing_machine import MODES, MeasuredTest, Specimen, read_machine
from neuido.data.importers.tables.checked_folder import recording_name, roles_of, write_tables
from neuido.data.importers.tables.titled_tables import Table, read_tables
from neuido.data.importers.tables.titles import find_columns
from neuido.errors import UserError

START = 0.1
"""Share of the first loading whose slope is the modulus that a fit starts from."""
FLOWS = 0.1
"""Slope at the start, relative to that of the whole first loading, below which the latter is taken."""

ONE_AXIS = ("uniaxial", "equibiaxial", "pure_shear", "simple_shear")
"""Modes in which the stress may be prescribed."""


class Material(NamedTuple):
    """The declared material; what is None is taken from the data or assumed, and said."""

    density: float | None = None
    """[kg/m^3]"""
    young: float | None = None
    """[Pa]"""
    poisson: float | None = None


def write_material_tests(
    files: Mapping[str, Path],
    out: str | os.PathLike | None,
    *,
    held_out: Sequence[str],
    mode: str,
    columns: dict[str, str],
    units: Mapping[str, str],
    specimen: Specimen,
    compression: bool,
    preparation: Preparation,
    step: str | None,
    sheet: str | None,
    material: Material,
) -> list[str]:
    """Write the tests of several files as a folder `neuido-material-test/1`; return the lines of the summary.

    Args:
        files: The files by the names of their recordings.
        out: The folder to create. None: check the content and write nothing.
        held_out: Names of tests, or of files, that are only scored.
        mode: One of `MODES`.
        columns: Title of the column of a quantity.
        units: Unit of a quantity.
        specimen: Dimensions of the specimen.
        compression: Whether the tables count compression as positive.
        preparation: What is done to each path.
        step: Step of shear of a relaxation modulus.
        sheet: Name of the only sheet to read.
        material: The declared material.

    Raises:
        UserError: Something cannot be read or is missing.
    """
    from neuido.data.measured.material_test import read_material_tests

    if mode not in MODES:
        raise UserError(f"--mode {mode} is unknown: choose from {', '.join(MODES)}")
    summary: list[str] = []
    notes: dict[str, list[str]] = {}
    tables: dict[str, dict[str, np.ndarray]] = {}
    tests: list[dict[str, Any]] = []
    of_file: dict[str, list[str]] = {}
    secants: list[float] = []
    fluids: list[bool] = []
    for file, path in files.items():
        with naming(path):
            found = read_tables(path, sheet, numbered=mode != "biaxial")
            kept = [table for table in found if len(found) == 1 or _has_test(table, columns)] or found[:1]
            for table in kept:
                own = recording_name(f"{file}-{table.label}" if len(kept) > 1 else file, tables)
                try:
                    curve = None if step is not None else read_curve(table, path.name, columns, units)
                    if curve is not None:
                        measured, used, prepared, parts = curve, curve.entry["mode"], curve.columns, [Part("", 0, 0)]
                        fluids.append(used == "flow_curve")
                        secants.append(curve.modulus)
                    else:
                        measured, used = _measured(table, path.name, mode, columns, units, specimen, compression, step)
                        made = measured.columns, preparation, measured.summary
                        prepared, parts = prepare(*made, area=measured.area, at_rest=measured.at_rest)
                        fluids.append(False)
                        secants.append(modulus(prepared))
                except UserError as error:
                    raise UserError(f"{error} ({table.label})" if len(kept) > 1 else str(error)) from error
                label = f" ({table.label})" if len(kept) > 1 else ""
                notes[f"{path.name}{label}"] = list(dict.fromkeys(measured.summary))
                tables[own] = prepared
                more = curve.entry if curve is not None else {}
                entries = [_entry(own, part, used, prepared) | more for part in parts]
                tests += entries
                of_file.setdefault(file, []).extend(entry["name"] for entry in entries)
            left = len(found) - len(kept)
            if left:
                summary.append(f"{path.name}: {left} tables without strain and stress are left out")
    summary = said(notes) + summary
    if all(test["mode"] in ONE_AXIS and "control" not in test for test in tests) and all(map(holds_stress, tables.values())):
        tests = [test | {"control": "stress"} for test in tests]
        summary.append("the stress stays at its levels while the strain follows: the stress is prescribed (control: stress in test.yaml)")
    roles = roles_of([test["name"] for test in tests], held_out, of_file)
    tests = [test | {"role": roles[test["name"]]} for test in tests]
    if len(tests) > 1:
        summary.append(f"held out: {', '.join(name for name, role in roles.items() if role == 'held_out') or 'none'} (--held_out NAMES)")
    if not material.young and not np.isfinite(np.median(secants)):
        names = ", ".join(path.name for path in files.values())
        raise UserError(
            f"{names}: stress over strain of the first rows is {np.median(secants):g} Pa: a number is too large, or give --young"
        )
    model, words = declared_fluid(material, secants) if all(fluids) else declared_model(material, secants)
    summary += words
    content = {"format": "neuido-material-test/1", "name": next(iter(files)), "model": model, "tests": tests}
    return summary + write_tables(out, "test.yaml", content, tables, read_material_tests)


def declared_fluid(material: Material, viscosities: Sequence[float]) -> tuple[dict[str, Any], list[str]]:
    """Return the declared model of flow curves, and the lines of the summary that say what was assumed."""
    guess, density = float(f"{np.median(viscosities):.2g}"), material.density or 1000.0
    said = f"model: a Newtonian fluid, viscosity {guess:g} Pa s from the rows, fitted; density {density:g} kg/m^3"
    model = {"density": density, "flow": {"law": "newtonian", "viscosity": guess}, "free": ["viscosity"]}
    return model, [said + ("" if material.density else " (assumed: --density)")]


def declared_model(material: Material, secants: Sequence[float]) -> tuple[dict[str, Any], list[str]]:
    """Return the declared model of material tests, and the lines of the summary that say what was assumed.

    Args:
        material: What the user declares.
        secants: A modulus of each test [Pa], from which the fit starts.
    """
    guess = material.young or float(f"{np.median(secants):.2g}")
    summary = [
        f"model: neo-Hooke, Young's modulus {guess:g} Pa {'as given' if material.young else 'from the first rows'}, fitted; density "
        f"{material.density or 1000.0:g} kg/m^3{'' if material.density else ' (assumed: --density)'}"
    ]
    model = {
        "density": material.density or 1000.0,
        "elasticity": {"law": "neo_hookean", "young": guess, "poisson": 0.499 if material.poisson is None else material.poisson},
        "plasticity": {"law": "identity"},
        "free": ["young"],
    }
    if material.poisson is None:
        model["incompressible"] = True
        summary.append("incompressible (else give --poisson)")
    return model, summary


def modulus(columns: Mapping[str, np.ndarray]) -> float:
    """Estimate Young's modulus [Pa] by the slope at the start of the first loading, as the starting value of the fit.

    Raises:
        UserError: The stress does not change.
    """
    path, stress = next(iter(columns.values())), next(values for key, values in columns.items() if "stress" in key)
    strain = path - (1.0 if next(iter(columns)).startswith("stretch") else 0.0)
    first = loading_parts(strain)[0]
    away = np.abs(strain[: first.stop] - strain[0])
    near = np.flatnonzero(away <= START * away.max())
    near = near if len(near) >= LEAST_ROWS else np.argsort(away, kind="stable")[:LEAST_ROWS]
    offset = strain[near] - strain[near].mean()
    slope = abs(float(offset @ stress[near]) / float(offset @ offset)) if np.ptp(strain[near]) > 0 else 0.0
    secant = float(np.ptp(stress[: first.stop]) / away.max()) if away.max() > 0 else 0.0
    if slope < FLOWS * secant:  # the specimen flows, or did not rest, at the start
        slope = secant
    if not slope > 0:
        raise UserError("the stress is zero although the specimen deforms: name the right columns with --columns")
    return slope * (3.0 if next(iter(columns)) == "shear" else 1.0)


def said(notes: Mapping[str, Sequence[str]]) -> list[str]:
    """Return the lines of a summary from the notes on each file; what holds for all of several files is said once."""
    lists = list(notes.values())
    common = [note for note in lists[0] if all(note in other for other in lists)] if len(lists) > 1 else []
    lines = [f"all files: {note}" for note in common]
    return lines + [f"{name}: {note}" for name, own in notes.items() for note in own if note not in common]


def _has_test(table: Table, columns: dict[str, str]) -> bool:
    """Whether a table of several has a strain and a stress; results and statistics of a machine's sheets have none."""
    given = {quantity: title for quantity, title in columns.items() if title in table.titles}
    found = set(find_columns(table.titles, given, table.units))
    path = found & {"strain", "log_strain", "green_strain", "green_strain_1", "stretch", "stretch_1", "strain_1", "displacement",
                    "displacement_1", "shear", "time"}  # fmt: skip
    load = found & {"force", "force_1", "nominal_stress", "nominal_stress_1", "true_stress", "second_piola_stress", "shear_stress",
                    "relaxation_modulus", "storage_modulus", "compliance", "viscosity"}  # fmt: skip
    return bool((path or found & {"rate", "frequency"}) and load)


def _measured(
    table: Table, name: str, mode: str, columns: dict[str, str], units: Mapping[str, str], specimen: Specimen, compression: bool,
    step: str | None,
) -> tuple[MeasuredTest, str]:  # fmt: skip
    """Convert one table; return the test and the mode of the format that it has."""
    relaxation = read_relaxation(table, name, step, columns, units)
    if relaxation is not None:
        return relaxation, "simple_shear"
    if step is not None:
        raise UserError(f"--step is for a relaxation modulus, and {name} has none")
    return read_machine(table, name, specimen, mode, columns, units, compression), "uniaxial" if mode == "compression" else mode


def _entry(name: str, part: Part, mode: str, columns: Mapping[str, np.ndarray]) -> dict[str, Any]:
    entry = {"name": f"{name}-{part.name}" if part.name else name, "file": f"{name}.csv", "mode": mode,
             "columns": {key: key for key in columns}}  # fmt: skip
    return entry | {"rows": [part.start, part.stop]} if part.name else entry
