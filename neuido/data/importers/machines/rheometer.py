"""Tables of rheometers: a relaxation modulus becomes a step of shear; curves that no kind of test holds are refused by name."""

import re
from collections.abc import Mapping

import numpy as np

from neuido.data.importers.machines.testing_machine import MachineTable, MeasuredTest, Specimen
from neuido.data.importers.tables.titled_tables import Table
from neuido.errors import UserError

REFUSED = {  # quantities of the curve: what it is, and what to export in its place
    ("storage_modulus",): (
        "a frequency sweep (storage and loss modulus)",
        "the waveforms of strain and stress over time at each frequency, with --mode simple_shear",
    ),
    ("compliance",): ("a creep compliance", "strain and stress over time, of which a diagnosis takes the strain as prescribed"),
    ("rate", "viscosity"): ("a flow curve", "strain and stress over time at each rate, with --mode simple_shear"),
    ("rate", "nominal_stress"): ("a flow curve", "strain and stress over time at each rate, with --mode simple_shear"),
    ("rate", "shear_stress"): ("a flow curve", "strain and stress over time at each rate, with --mode simple_shear"),
}
"""Curves without a history of strain, which a material test needs."""
PATHS = {"strain", "strain_1", "log_strain", "stretch", "stretch_1", "shear", "displacement", "displacement_1"}


def refuse_curve(found: Mapping[str, int], name: str) -> None:
    """Raise where a table holds a curve that is no history of strain: a frequency sweep, a compliance, a flow curve.

    Raises:
        UserError: It does; the message says what to export.
    """
    if "time" in found and PATHS & set(found):
        return
    for quantities, (what, instead) in REFUSED.items():
        if set(quantities) <= set(found):
            raise UserError(f"{name} is {what}; a material test has strain, stress and time: export {instead}")


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
