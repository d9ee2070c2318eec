"""Reader of testing-machine tables; each table is one material test."""

import re
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from neuido.data.files.delimited import is_number
from neuido.data.importers.titled_tables import LONGEST_TITLE, Table, read_titled
from neuido.data.importers.titles import find_columns
from neuido.data.importers.units import conversion_factor, parse_quantity
from neuido.errors import UserError

MAX_ROWS = 400
"""Largest number of rows; a longer table is thinned evenly."""
_SIZES = {"length": r".*gau?ge length|.*specimen length|length|messl.nge|einspannl.nge", "width": r"width|breite|probenbreite",
          "thickness": r"thickness|dicke|probendicke", "diameter": r"diameter|durchmesser"}  # fmt: skip


class Specimen(NamedTuple):
    """Dimensions of a specimen with units, such as `25.4 mm`. They replace the dimensions that the table states."""

    length: str | None = None
    width: str | None = None
    thickness: str | None = None
    diameter: str | None = None


class MeasuredTest(NamedTuple):
    """Columns of one material test in SI units, and the lines of the summary."""

    columns: dict[str, np.ndarray]
    summary: list[str]


def read_machine(
    path: Path, specimen: Specimen, mode: str, columns: dict[str, str], units: dict[str, str], compression: bool
) -> MeasuredTest:
    """Read a testing-machine table; convert forces and displacements to stress [Pa] and stretch [-].

    Args:
        path: The file.
        specimen: Dimensions of the specimen.
        mode: Loading mode, one of `tests[].mode` of a material test.
        columns: Title of the column of a quantity, if its title does not reveal it.
        units: Unit of a quantity, if the table does not state it.
        compression: Whether the table counts compression as positive.

    Raises:
        UserError: A column, a unit or a dimension is missing. The message names the option that supplies it.
    """
    table = read_titled(path)
    found = find_columns(table.titles, columns)
    sizes = _sizes(table, specimen)
    out: dict[str, np.ndarray] = {}
    summary = list(table.notes)
    sign = -1.0 if compression else 1.0

    def column(name: str, unit: str, *, unit_required: bool = True) -> np.ndarray:
        own = units.get(name) or table.units[found[name]]
        if not own and unit_required:
            raise UserError(f"{path.name}: column {table.titles[found[name]]!r} has no unit: give --units.{name} {unit or 'percent'}")
        summary.append(f"column {found[name] + 1} {table.titles[found[name]]!r} -> {name}, {own or 'a ratio'}")
        return table.data[:, found[name]] * conversion_factor(own, unit, f"{path.name}, {name}")

    if mode == "biaxial":
        for key in ("stretch_1", "stretch_2", "nominal_stress_1", "nominal_stress_2"):
            if key not in found:
                raise UserError(f"{path.name} has no column for {key}: name it with --columns.{key} TITLE")
            out[key] = column(key, "Pa" if "stress" in key else "", unit_required="stress" in key)
    elif mode == "simple_shear":
        for key, unit in (("shear", ""), ("shear_stress", "Pa")):
            if key not in found:
                raise UserError(f"{path.name} has no column for {key}: name it with --columns.{key} TITLE")
            out[key] = column(key, unit, unit_required=bool(unit))
    else:
        if "log_strain" in found and "true_stress" in found:
            out["log_strain"] = sign * column("log_strain", "", unit_required=False)
        elif "stretch" in found:
            out["stretch"] = column("stretch", "", unit_required=False)
        elif "strain" in found:
            strain = table.data[:, found["strain"]]
            out["stretch"] = 1 + sign * column("strain", "", unit_required=bool(np.nanmax(np.abs(strain)) > 3))
        elif "displacement" in found:
            if "length" not in sizes:
                raise UserError(f"{path.name} has a displacement: give the length of the specimen, for example --length '50 mm'")
            out["stretch"] = 1 + sign * column("displacement", "m") / sizes["length"]
            summary.append(f"specimen of length {1e3 * sizes['length']:g} mm -> stretch")
        else:
            raise UserError(
                f"{path.name} has no stretch, strain or displacement: give --columns.strain TITLE (titles: {', '.join(table.titles)})"
            )
        if "log_strain" in out or ("true_stress" in found and "nominal_stress" not in found):
            out["true_stress"] = sign * column("true_stress", "Pa")
        elif "nominal_stress" in found:
            out["nominal_stress"] = sign * column("nominal_stress", "Pa")
        elif "force" in found:
            if "diameter" in sizes:
                area = np.pi / 4 * sizes["diameter"] ** 2
            elif "width" in sizes and "thickness" in sizes:
                area = sizes["width"] * sizes["thickness"]
            else:
                raise UserError(
                    f"{path.name} has a force: give the cross-section, --width '10 mm' --thickness '2 mm' or --diameter '10 mm'"
                )
            out["nominal_stress"] = sign * column("force", "N") / area
            summary.append(f"cross-section of {1e6 * area:g} mm^2 -> nominal stress")
        else:
            raise UserError(
                f"{path.name} has no stress or force: name its column with --columns.force TITLE (titles: {', '.join(table.titles)})"
            )
    if "time" in found:
        out["time"] = (
            column("time", "s", unit_required=False) if table.units[found["time"]] or "time" in units else table.data[:, found["time"]]
        )
    return MeasuredTest(_clean_rows(out, summary), summary)


def _sizes(table: Table, specimen: Specimen) -> dict[str, float]:
    """Return the known dimensions of the specimen [m], from the lines above the table and from `specimen`."""
    sizes: dict[str, Any] = {}
    for row in table.preamble:
        cells = [cell for cell in row if cell]
        title = cells[0][:LONGEST_TITLE]
        label = re.sub(r"\s*[\(\[].*?[\)\]]|:", "", title).strip().lower()
        unit = re.search(r"[\(\[](.+?)[\)\]]", title)
        if len(cells) > 1 and is_number(cells[1]) and (len(cells) > 2 or unit):
            for name, pattern in _SIZES.items():
                if re.fullmatch(pattern, label):
                    sizes[name] = float(cells[1]) * conversion_factor(unit[1] if unit else cells[2], "m", f"{cells[0]} in the preamble")
    return sizes | {name: parse_quantity(text, "m", name) for name, text in specimen._asdict().items() if text}


def _clean_rows(columns: dict[str, np.ndarray], summary: list[str]) -> dict[str, np.ndarray]:
    """Drop rows that are incomplete or whose time does not increase, and thin a long table; append notes to `summary`."""
    valid = np.isfinite(np.stack(list(columns.values()))).all(axis=0)
    if "time" in columns:
        latest = np.maximum.accumulate(np.where(valid, columns["time"], -np.inf))
        repeated = valid & (np.concatenate([[-np.inf], latest[:-1]]) >= columns["time"])
        if repeated.any():
            summary.append(f"{repeated.sum()} rows whose time does not increase are left out")
        valid &= ~repeated
    rows = np.flatnonzero(valid)
    every = max(1, -(-len(rows) // MAX_ROWS))
    if every > 1:
        summary.append(f"every {every}th of {len(rows)} rows is used")
    if len(rows[::every]) < 3:
        raise UserError("fewer than 3 rows have a number in every column: name the right columns with --columns")
    out = {key: values[rows[::every]] for key, values in columns.items()}
    if "time" in out:
        out["time"] = out["time"] - out["time"][0]
    return out
