"""Tables of rheometers: relaxation moduli and creep compliances, frequency sweeps and flow curves become material tests."""

import re
from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np

from neuido.data.importers.machines.loading_path import LEAST_ROWS
from neuido.data.importers.machines.testing_machine import MachineTable, MeasuredTest, Specimen
from neuido.data.importers.tables.titled_tables import Table
from neuido.errors import UserError

PATHS = {"strain", "strain_1", "log_strain", "stretch", "stretch_1", "shear", "displacement", "displacement_1"}
MOST_ROWS = 150
"""Most rows of a creep test, which is computed row by row."""
SMALL = 0.01
"""Largest shear of a creep test that is made from a compliance: in the linear range any size serves."""


class Curve(NamedTuple):
    """A table that is no history of strain, as the columns and the keys of a material test."""

    columns: dict[str, np.ndarray]
    """Quantities by the keys of the format, (n,) in SI units."""
    entry: dict[str, Any]
    """Further keys of the test."""
    modulus: float
    """Young's modulus [Pa] from which a fit may start; of a fluid its viscosity [Pa s]."""
    summary: list[str]


def read_curve(table: Table, name: str, columns: dict[str, str], units: Mapping[str, str]) -> Curve | None:
    """Convert a frequency sweep, a creep compliance or a flow curve; return None for any other table.

    Args:
        table: The table.
        name: Name of the file in messages.
        columns: Title of the column of a quantity, if its title does not reveal it.
        units: Unit of a quantity; SI units are taken where none is given.

    Raises:
        UserError: A column is missing, a frequency has no unit, or too few rows have positive values.
    """
    given = MachineTable(table, name, Specimen(), columns, units)
    found = set(given.found)
    if "time" in found and PATHS & found:
        return None
    if "storage_modulus" in found:
        return _sweep(given)
    if "compliance" in found:
        return _creep(given)
    stress = next((quantity for quantity in ("shear_stress", "nominal_stress") if quantity in found), "")
    return _flow(given, stress) if "rate" in found and (stress or "viscosity" in found) else None


def _sweep(given: MachineTable) -> Curve:
    for quantity, what in (("loss_modulus", "loss modulus"), ("frequency", "frequency")):
        if quantity not in given.found:
            raise given.missing(what, quantity)
    unit = given.units.get("frequency") or given.table.units[given.found["frequency"]]
    angular = re.search(r"rad|angular|ang\.|omega|\u03c9|kreis", f"{unit} {given.title('frequency')}", re.IGNORECASE)
    if not unit and not angular:
        raise UserError(f"{given.name}: column {given.title('frequency')!r} has no unit: give --units.frequency Hz or rad/s")
    omega = given.column("frequency", "1/s", required=False) * (1.0 if angular else 2 * np.pi)
    moduli = [given.column(f"{kind}_modulus", "Pa", required=False) for kind in ("storage", "loss")]
    given.summary.append(f"a frequency sweep, in {'angular frequency' if angular else 'cycles per second'}: small oscillations in shear")
    kept = _positive(given, {"angular_frequency": omega, "storage_modulus": moduli[0], "loss_modulus": moduli[1]})
    return Curve(kept, {"mode": "oscillation"}, 3 * float(kept["storage_modulus"].min()), given.summary)  # what is left when all relaxed


def _creep(given: MachineTable) -> Curve:
    if "time" not in given.found:
        raise given.missing("time", "time")
    kept = _positive(
        given, {"time": given.column("time", "s", required=False), "shear": given.column("compliance", "1/Pa", required=False)}
    )
    kept = _evenly_in_logarithm(kept, given.summary)
    modulus, stress = 3 / float(np.median(kept["shear"])), float(f"{SMALL / kept['shear'].max():.3g}")
    shear = kept["shear"] * stress
    given.summary.append(
        f"creep compliance -> shear under a shear stress of {stress:g} Pa, in the linear range, where its size does not matter"
    )
    columns = {"shear": shear, "shear_stress": np.full(len(shear), stress), "time": kept["time"]}
    return Curve(columns, {"mode": "simple_shear", "control": "stress"}, modulus, given.summary)


def _flow(given: MachineTable, stress: str) -> Curve:
    rate = given.column("rate", "1/s", required=False)
    seen = given.column(stress, "Pa", required=False) if stress else rate * given.column("viscosity", "Pa*s", required=False)
    given.summary.append("a flow curve of a fluid; every row counts as steady")
    kept = _positive(given, {"shear_rate": rate, "shear_stress": seen})
    viscosity = float(np.exp(np.mean(np.log(kept["shear_stress"] / kept["shear_rate"]))))
    return Curve(kept, {"mode": "flow_curve"}, viscosity, given.summary)


def _evenly_in_logarithm(columns: dict[str, np.ndarray], summary: list[str]) -> dict[str, np.ndarray]:
    """Return at most `MOST_ROWS` rows, evenly spread in the logarithm of the time; a creep is a course over decades."""
    time = columns["time"]
    if len(time) <= MOST_ROWS:
        return columns
    place = np.floor((MOST_ROWS - 1) * np.log(time / time[0]) / np.log(time[-1] / time[0]))
    _, rows = np.unique(place, return_index=True)
    summary.append(f"{len(rows)} of {len(time)} rows are kept, evenly in the logarithm of the time")
    return {key: values[rows] for key, values in columns.items()}


def _positive(given: MachineTable, columns: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
    """Return the rows in which all values are positive.

    Raises:
        UserError: They are too few.
    """
    good = np.all([np.isfinite(values) & (values > 0) for values in columns.values()], axis=0)
    if good.sum() < LEAST_ROWS:
        raise UserError(f"{given.name} has {int(good.sum())} rows with positive values, and a curve takes {LEAST_ROWS} at least")
    if not good.all():
        given.summary.append(f"{int((~good).sum())} rows without positive values are left out")
    return {key: values[good] for key, values in columns.items()}


def read_relaxation(table: Table, name: str, step: str | None, columns: dict[str, str], units: Mapping[str, str]) -> MeasuredTest | None:
    """Convert a relaxation modulus [Pa] over time after a step of shear, in the linear range, to a test in simple shear.

    The stress is the modulus times the step; a row at rest at time zero stands before it.

    Args:
        table: The table.
        name: Name of the file in messages.
        step: The step, as a ratio or a percentage: `0.01` or `1 %`.
        columns: Title of the column of a quantity, if its title does not reveal it.
        units: Unit of a quantity; the modulus is in Pa where none is given.

    Returns:
        None if the table has no relaxation modulus, or has a strain of its own.

    Raises:
        UserError: The table has no time, or the step is missing or malformed.
    """
    given = MachineTable(table, name, Specimen(), columns, units)
    if "relaxation_modulus" not in given.found or PATHS & set(given.found):
        return None
    if "time" not in given.found:
        raise given.missing("time", "time")
    if step is None:
        raise UserError(f"{name} is a relaxation modulus: give the step of shear that was applied, for example --step 0.01")
    found = re.fullmatch(r"\s*([0-9.]+(?:[eE][-+]?[0-9]+)?)\s*(%|percent)?\s*", str(step))
    size = float(found[1]) * (0.01 if found[2] else 1.0) if found is not None and found[1].count(".") < 2 else 0.0
    if not 0 < size < 10:
        raise UserError(f"--step {str(step)[:40]!r} must be a shear above 0, for example 0.01 or '1 %'")
    modulus = given.column("relaxation_modulus", "Pa", required=False)
    time = given.column("time", "s", required=False)
    kept = np.isfinite(modulus) & np.isfinite(time)
    if not (time[kept] > 0).all():
        raise UserError(f"{name}: a relaxation modulus starts after the step: the times must be above 0 s")
    given.summary.append(f"relaxation modulus after a step of shear of {size:g} -> shear stress; a row at rest before it")
    shear = np.where(kept, size, np.nan)
    return MeasuredTest({"shear": shear, "shear_stress": size * modulus, "time": time}, given.summary, at_rest=True)
