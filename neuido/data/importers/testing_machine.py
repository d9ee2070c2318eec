"""Tables of testing machines, as one material test each."""

import re
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from neuido.data.files.delimited import is_number
from neuido.data.importers.titled_tables import Table, read_titled
from neuido.data.importers.titles import find_columns
from neuido.data.importers.units import conversion_factor, parse_quantity
from neuido.errors import UserError

MAX_ROWS = 400
"""Of a longer table every second, third, ... row is kept."""
_SIZES = {"length": r".*gau?ge length|.*specimen length|length|messl.nge|einspannl.nge", "width": r"width|breite|probenbreite",
          "thickness": r"thickness|dicke|probendicke", "diameter": r"diameter|durchmesser"}  # fmt: skip


class Specimen(NamedTuple):
    """Sizes with units, as `25.4 mm`; what the table says itself need not be given."""

    length: str | None = None
    width: str | None = None
    thickness: str | None = None
    diameter: str | None = None


class MeasuredTest(NamedTuple):
    """The columns of one test in SI units, and what was understood."""

    columns: dict[str, np.ndarray]
    summary: list[str]


def read_machine(
    path: Path, specimen: Specimen, mode: str, columns: dict[str, str], units: dict[str, str], compression: bool
) -> MeasuredTest:
    """Read a table of a testing machine.

    Args:
        path: The file.
        specimen: Its sizes.
        mode: As `tests[].mode` of a material test.
        columns: quantity -> title, in place of what the titles say.
        units: quantity -> unit, where the table gives none.
        compression: Whether the figures count compression as positive.

    Raises:
        UserError: A column, a unit or a size is missing; the line names the option.
    """
    table = read_titled(path)
    found = find_columns(table.titles, columns)
    sizes = _sizes(table, specimen)
    out: dict[str, np.ndarray] = {}
    said = list(table.notes)
    sign = -1.0 if compression else 1.0

    def take(name: str, unit: str, *, ask: bool = True) -> np.ndarray:
        own = units.get(name) or table.units[found[name]]
        if not own and ask:
            raise UserError(
                f"{path.name}: column {table.titles[found[name]]!r} has no unit: give --units.{name}, for example {unit or 'percent'}"
            )
        said.append(f"column {found[name] + 1} {table.titles[found[name]]!r} -> {name}, {own or 'a ratio'}")
        return table.data[:, found[name]] * conversion_factor(own, unit, f"{path.name}, {name}")

    if mode == "biaxial":
        for key in ("stretch_1", "stretch_2", "nominal_stress_1", "nominal_stress_2"):
            if key not in found:
                raise UserError(f"{path.name} has no column for {key}: name it, --columns.{key} TITLE")
            out[key] = take(key, "Pa" if "stress" in key else "", ask="stress" in key)
    elif mode == "simple_shear":
        for key, unit in (("shear", ""), ("shear_stress", "Pa")):
            if key not in found:
                raise UserError(f"{path.name} has no column for {key}: name it, --columns.{key} TITLE")
            out[key] = take(key, unit, ask=bool(unit))
    else:
        if "log_strain" in found and "true_stress" in found:
            out["log_strain"] = sign * take("log_strain", "", ask=False)
        elif "stretch" in found:
            out["stretch"] = take("stretch", "", ask=False)
        elif "strain" in found:
            plain = table.data[:, found["strain"]]
            out["stretch"] = 1 + sign * take("strain", "", ask=bool(np.nanmax(np.abs(plain)) > 3))
        elif "displacement" in found:
            if "length" not in sizes:
                raise UserError(f"{path.name} gives a displacement: give the specimen's length, for example --length '50 mm'")
            out["stretch"] = 1 + sign * take("displacement", "m") / sizes["length"]
            said.append(f"specimen of length {1e3 * sizes['length']:g} mm -> stretch")
        else:
            raise UserError(
                f"{path.name} has no stretch, strain or displacement: name it, --columns.strain TITLE ({', '.join(table.titles)})"
            )
        if "log_strain" in out or ("true_stress" in found and "nominal_stress" not in found):
            out["true_stress"] = sign * take("true_stress", "Pa")
        elif "nominal_stress" in found:
            out["nominal_stress"] = sign * take("nominal_stress", "Pa")
        elif "force" in found:
            if "diameter" in sizes:
                area = np.pi / 4 * sizes["diameter"] ** 2
            elif "width" in sizes and "thickness" in sizes:
                area = sizes["width"] * sizes["thickness"]
            else:
                raise UserError(f"{path.name} gives a force: give the section, --width '10 mm' --thickness '2 mm' or --diameter '10 mm'")
            out["nominal_stress"] = sign * take("force", "N") / area
            said.append(f"section of {1e6 * area:g} mm^2 -> nominal stress")
        else:
            raise UserError(f"{path.name} has no stress or force: name it, --columns.force TITLE ({', '.join(table.titles)})")
    if "time" in found:
        out["time"] = take("time", "s", ask=False) if table.units[found["time"]] or "time" in units else table.data[:, found["time"]]
    return MeasuredTest(_cleaned(out, said), said)


def _sizes(table: Table, specimen: Specimen) -> dict[str, float]:
    sizes: dict[str, Any] = {}
    for row in table.preamble:
        cells = [cell for cell in row if cell]
        label = re.sub(r"\s*[\(\[].*?[\)\]]|:", "", cells[0]).strip().lower()
        unit = re.search(r"[\(\[](.+?)[\)\]]", cells[0])
        if len(cells) > 1 and is_number(cells[1]) and (len(cells) > 2 or unit):
            for name, pattern in _SIZES.items():
                if re.fullmatch(pattern, label):
                    sizes[name] = float(cells[1]) * conversion_factor(unit[1] if unit else cells[2], "m", f"{cells[0]} in the preamble")
    return sizes | {name: parse_quantity(text, "m", name) for name, text in specimen._asdict().items() if text}


def _cleaned(columns: dict[str, np.ndarray], said: list[str]) -> dict[str, np.ndarray]:
    keep = np.isfinite(np.stack(list(columns.values()))).all(axis=0)
    if "time" in columns:
        latest = np.maximum.accumulate(np.where(keep, columns["time"], -np.inf))
        again = keep & (np.concatenate([[-np.inf], latest[:-1]]) >= columns["time"])
        if again.any():
            said.append(f"{again.sum()} rows whose time does not rise are left out")
        keep &= ~again
    rows = np.flatnonzero(keep)
    every = -(-len(rows) // MAX_ROWS)
    if every > 1:
        said.append(f"one row in {every} is kept of {len(rows)}")
    if len(rows[::every]) < 3:
        raise UserError("fewer than 3 rows have all figures: see --columns")
    out = {key: values[rows[::every]] for key, values in columns.items()}
    if "time" in out:
        out["time"] = out["time"] - out["time"][0]
    return out
