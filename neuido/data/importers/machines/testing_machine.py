"""Columns of a testing machine's or rheometer's table, as stretch or shear, stress and time in SI units."""

import re
from collections.abc import Mapping
from typing import NamedTuple

import numpy as np

from neuido.data.files.delimited import is_number
from neuido.data.importers.tables.titled_tables import LONGEST_TITLE, Table
from neuido.data.importers.tables.titles import bare_title, find_columns
from neuido.data.importers.tables.units import conversion_factor, measures, parse_quantity
from neuido.errors import UserError

MODES = ("uniaxial", "compression", "equibiaxial", "pure_shear", "biaxial", "simple_shear")
_SIZES = {"length": r".*gau?ge length|.*(specimen|sample) (length|height)|length|messl.nge|einspannl.nge|anfangsl.nge|l0|(\w+ )?height|"
          r"gap|h.he|.*messl.nge.*|longueur( \w+)?|longitud( \w+)?", "width": r"(\w+ )?width|breite|probenbreite|largeur|ancho|anchura",
          "thickness": r"(\w+ )?thickness|dicke|probendicke|.paisseur|espesor",
          "diameter": r"(\w+ )?diameter|durchmesser|diam.tre|di.metro",
          "area": r".*cross[- ]?section\w*( area)?|(specimen |initial )?area|.*querschnitt\w*|section initiale|.rea"}  # fmt: skip
_COMPRESSED = re.compile(r"compress|stauch|druck", re.IGNORECASE)
UNEQUAL = 0.02
"""Difference of a stress column and the force over the cross-section, relative, that is said: sizes are measured to a per cent or so."""
LARGEST_RATIO = 3.0
"""Largest strain that is taken for a ratio where no unit is given; 300 % and more is rubber in tension."""


SENTINELS, FAR = (999.0, 9999.0, 99999.0, 999999.0), 3.0
"""Numbers that machines write for a missing one, and how many times smaller all others are."""


class Specimen(NamedTuple):
    """Dimensions of a specimen with units, such as `25.4 mm`. They replace the dimensions that the table states."""

    length: str | None = None
    width: str | None = None
    thickness: str | None = None
    diameter: str | None = None
    area: str | None = None
    """Cross-section, such as `20 mm^2`; it takes precedence over width, thickness and diameter."""


class MeasuredTest(NamedTuple):
    """Columns of one material test in SI units, and the lines of the summary."""

    columns: dict[str, np.ndarray]
    """Quantities of a material test, prescribed ones first, (n,) float64; NaN where a cell has no number."""
    summary: list[str]
    area: float | None = None
    """Cross-section [m^2], where a force was converted."""
    at_rest: bool = False
    """Whether the specimen is at rest until time zero, before the first row."""


class MachineTable:
    """One table and what converts its columns: the units and the sizes of the specimen.

    Args:
        table: The table.
        name: Name of the file in messages.
        specimen: Dimensions of the specimen.
        columns: Title of the column of a quantity, if its title does not reveal it.
        units: Unit of a quantity, if the table does not state it.
    """

    def __init__(self, table: Table, name: str, specimen: Specimen, columns: dict[str, str], units: Mapping[str, str]) -> None:
        self.table, self.name, self.units = table, name, units
        self.found = find_columns(table.titles, columns, table.units)
        self.sizes = _sizes(table, specimen)
        self.summary = list(table.notes)
        self.used_area: float | None = None

    def title(self, quantity: str) -> str:
        return self.table.titles[self.found[quantity]]

    def column(self, quantity: str, unit: str, *, required: bool = True) -> np.ndarray:
        """Return the column of a quantity in `unit`; where no unit is given it is taken to be in SI units unless one is `required`."""
        index = self.found[quantity]
        own = self.units.get(quantity) or self.table.units[index]
        if not own and required:
            raise UserError(f"{self.name}: column {self.title(quantity)!r} has no unit: give --units.{quantity} {unit or 'percent'}")
        known = own or (f"taken as {unit} (--units.{quantity})" if unit else "a ratio")
        self.summary.append(f"column {index + 1} {self.title(quantity)!r} -> {quantity}, {known}")
        values = self._measured(index)
        return values * (conversion_factor(own, unit, f"{self.name}, --units.{quantity}") if own else 1.0)

    def _measured(self, index: int) -> np.ndarray:
        """Return a column with NaN in place of 9999 and the like, which stand for a missing number where all others are far smaller."""
        values = self.table.data[:, index]
        lost = np.isin(np.abs(values), SENTINELS)
        others = values[~lost & np.isfinite(values)]
        if not lost.any() or not len(others) or np.abs(others).max() * FAR > np.abs(values[lost]).min():
            return values
        self.summary.append(f"column {index + 1}: {int(lost.sum())} rows with {values[lost][0]:g} count as missing")
        return np.where(lost, np.nan, values)

    def missing(self, what: str, quantity: str) -> UserError:
        titles = ", ".join(filter(None, self.table.titles))
        return UserError(f"{self.name} has no {what}: name its column with --columns.{quantity} TITLE (titles: {titles[:300]})")

    def refuse_component(self, name: str, what: str, quantities: tuple[str, str]) -> None:
        """Refuse a component such as `E11` or `S11`, whose name is used for two quantities, and name the options for both."""
        title = next((title for title in self.table.titles if bare_title(title) == name), None)
        if title is not None:
            options = " or ".join(f"--columns.{quantity} {title!r}" for quantity in quantities)
            raise UserError(f"{self.name}: column {title!r} may be {what}: give {options}")

    def strain(self, quantity: str) -> np.ndarray:
        """Return a strain as a ratio; one of more than `LARGEST_RATIO` needs a unit."""
        values = self._measured(self.found[quantity])
        largest = float(np.nanmax(np.abs(values))) if np.isfinite(values).any() else 0.0
        known = self.units.get(quantity) or self.table.units[self.found[quantity]]
        out = self.column(quantity, "", required=largest > LARGEST_RATIO)
        if not known:
            self.summary.append(f"{quantity} has no unit and is taken as a ratio, up to {largest:.3g} (--units.{quantity} percent)")
        return out

    def size(self, name: str, why: str) -> float:
        """Return a dimension of the specimen [m]."""
        if name not in self.sizes:
            raise UserError(f"{self.name} {why}: give its {name}, for example --{name} '{50 if name == 'length' else 2} mm'")
        return self.sizes[name]

    def known_area(self) -> float | None:
        """Return the cross-section of the specimen [m^2]; None where it is not known."""
        if "area" in self.sizes:
            return self.sizes["area"]
        if "diameter" in self.sizes:
            return np.pi / 4 * self.sizes["diameter"] ** 2
        return self.sizes["width"] * self.sizes["thickness"] if {"width", "thickness"} <= self.sizes.keys() else None

    def compare_force(self, stress: np.ndarray) -> None:
        """Say it where a column of forces, over the cross-section, is not the column of nominal stresses [Pa], (n,), that is used."""
        area = self.known_area()
        unit = self.units.get("force") or (self.table.units[self.found["force"]] if "force" in self.found else "")
        if area is None or not unit or not measures(unit, "N"):
            return
        force = self._measured(self.found["force"]) * conversion_factor(unit, "N", f"{self.name}, --units.force")
        both = np.isfinite(force) & np.isfinite(stress)
        if not both.any() or not (size := float(stress[both] @ stress[both])):
            return
        ratio = abs(float(force[both] @ stress[both])) / (area * size)
        if abs(ratio - 1) > UNEQUAL:
            self.summary.append(
                f"odd: column {self.title('force')!r} over the cross-section of {1e6 * area:g} mm^2 is {ratio:.3g} times column "
                f"{self.title('nominal_stress')!r}, which is used: check the cross-section (--columns.nominal_stress names another)"
            )

    def area(self) -> float:
        """Return the cross-section of the specimen [m^2]."""
        out = self.known_area()
        if out is None:
            raise UserError(
                f"{self.name} has a force: give the cross-section, --area '20 mm^2', --width '10 mm' --thickness '2 mm' or "
                "--section_diameter '10 mm'"
            )
        self.used_area = out
        self.summary.append(f"cross-section of {1e6 * out:g} mm^2 -> nominal stress")
        return out


def read_machine(
    table: Table, name: str, specimen: Specimen, mode: str, columns: dict[str, str], units: Mapping[str, str], compression: bool
) -> MeasuredTest:
    """Convert a testing machine's table to stress [Pa] over stretch or shear [-].

    Args:
        table: The table.
        name: Name of the file in messages.
        specimen: Dimensions of the specimen.
        mode: One of `MODES`.
        columns: Title of the column of a quantity, if its title does not reveal it.
        units: Unit of a quantity, if the table does not state it.
        compression: Whether the table counts compression as positive.

    Raises:
        UserError: A column, a unit or a dimension is missing. The message names the option that supplies it.
    """
    given = MachineTable(table, name, specimen, columns, units)
    if mode == "biaxial":
        out = _biaxial(given)
    elif mode == "simple_shear":
        out = _shear(given)
    else:
        out = _one_axis(given, mode, compression)
    if "time" in given.found:
        out["time"] = given.column("time", "s", required=False)
    return MeasuredTest(out, given.summary, given.used_area)


def _one_axis(given: MachineTable, mode: str, compression: bool) -> dict[str, np.ndarray]:
    """Return stretch or logarithmic strain, and nominal or true stress."""
    found, out = given.found, {}
    found |= {
        own: found[f"{own}_1"]
        for own in ("stretch", "green_strain", "strain", "nominal_stress", "force")
        if own not in found and f"{own}_1" in found
    }
    pairs = [("log_strain", "true_stress"), ("stretch", "nominal_stress"), ("strain", "nominal_stress")]
    path = next((p for p, s in pairs if p in found and s in found and p in ("stretch", "strain")), None)
    path = path or next((key for key in ("log_strain", "stretch", "green_strain", "strain", "displacement") if key in found), None)
    if path is None:
        given.refuse_component("e11", "a Green or an engineering strain", ("green_strain", "strain"))
        raise given.missing("stretch, strain or displacement", "strain")
    if path == "stretch":
        out["stretch"] = given.column("stretch", "", required=False)
    elif path == "green_strain":
        out["stretch"] = _stretch_of_green(given, "green_strain")
    elif path == "displacement":
        length = given.size("length", "has a displacement of a specimen")
        moved = given.column("displacement", "m")
        start = moved[np.isfinite(moved)][:1]
        if len(start) and abs(start[0]) > max(float(np.nanmax(moved) - np.nanmin(moved)), 0.5 * length):
            moved = moved - start[0]
            given.summary.append(f"the displacement starts at {1e3 * start[0]:g} mm, which becomes 0 mm")
        out["stretch"] = 1 + moved / length
        given.summary.append(f"specimen of length {1e3 * length:g} mm -> stretch")
    else:
        out["log_strain" if path == "log_strain" else "stretch"] = given.strain(path) + (0.0 if path == "log_strain" else 1.0)
    stress = next((key for key in ("nominal_stress", "true_stress", "second_piola_stress", "force") if key in found), None)
    if path == "log_strain" and "true_stress" in found:
        stress = "true_stress"
    if stress is None:
        given.refuse_component("s11", "a second Piola-Kirchhoff or a true stress", ("second_piola_stress", "true_stress"))
        raise given.missing("stress or force", "force")
    if stress == "force":
        area = given.area()
        out["nominal_stress"] = given.column("force", "N") / area
    elif stress == "second_piola_stress":
        stretch = np.exp(out["log_strain"]) if path == "log_strain" else out["stretch"]
        out["nominal_stress"] = given.column(stress, "Pa") * stretch
        given.summary.append("nominal stress = stretch times second Piola-Kirchhoff stress")
    else:
        out[stress] = given.column(stress, "Pa")
        if stress == "nominal_stress":
            given.compare_force(out[stress])
    sources = (given.title(path), given.title(stress))
    if mode == "compression" or (not compression and any(_COMPRESSED.search(title) for title in sources)):
        _make_compression(out, given, stated=mode != "compression")
    elif compression:
        if path == "stretch":
            raise UserError(f"{given.name}: --compression true is for a strain or a displacement; {given.title(path)!r} is a stretch")
        for key in out:
            out[key] = 2.0 - out[key] if key == "stretch" else -out[key]
        given.summary.append("compression is counted as positive, signs turned")
    return out


def _stretch_of_green(given: MachineTable, quantity: str) -> np.ndarray:
    """Return the stretch of a Green strain E, sqrt(1 + 2 E)."""
    strain = given.strain(quantity)
    if (strain <= -0.5).any():
        raise UserError(
            f"{given.name}: {given.title(quantity)!r} reaches {np.nanmin(strain):.3g}, and a Green strain is above -0.5: is it an "
            f"engineering strain (--columns.{quantity.removeprefix('green_')}), or is compression positive?"
        )
    if "stretch = sqrt(1 + 2 E) of the Green strain E" not in given.summary:
        given.summary.append("stretch = sqrt(1 + 2 E) of the Green strain E")
    return np.sqrt(1 + 2 * strain)


def _make_compression(out: dict[str, np.ndarray], given: MachineTable, *, stated: bool) -> None:
    """Turn the signs of strain and stress where the table counts compression as positive; say so, and that friction is left out."""
    for key, values in out.items():
        rest = 1.0 if key == "stretch" else 0.0
        away = values[np.isfinite(values)] - rest
        if len(away) and away[np.argmax(np.abs(away))] > 0:
            out[key] = 2 * rest - values
            given.summary.append(f"{key}: compression is counted as positive, sign turned")
    if stated:
        given.summary.append("a title says compression, so both strain and stress are negative (else --columns names other columns)")
    given.summary.append(
        "compression: friction at the platens makes a specimen stiffer, and the library has no effect for it: lubricate the platens"
    )


def _biaxial(given: MachineTable) -> dict[str, np.ndarray]:
    """Return stretch and nominal stress along two axes; strains, or forces and displacements with the sizes, are converted."""
    out: dict[str, np.ndarray] = {}
    for axis in "12":
        if f"stretch_{axis}" in given.found:
            out[f"stretch_{axis}"] = given.column(f"stretch_{axis}", "", required=False)
        elif f"green_strain_{axis}" in given.found:
            out[f"stretch_{axis}"] = _stretch_of_green(given, f"green_strain_{axis}")
        elif f"strain_{axis}" in given.found:
            out[f"stretch_{axis}"] = 1 + given.strain(f"strain_{axis}")
        elif f"displacement_{axis}" in given.found:
            length = given.size("length", "has displacements of a specimen")
            out[f"stretch_{axis}"] = 1 + given.column(f"displacement_{axis}", "m") / length
        else:
            given.refuse_component(f"e{2 * axis}", "a Green or an engineering strain", (f"green_strain_{axis}", f"strain_{axis}"))
            raise given.missing(f"column for stretch_{axis}", f"stretch_{axis}")
    for axis in "12":
        if f"nominal_stress_{axis}" in given.found:
            out[f"nominal_stress_{axis}"] = given.column(f"nominal_stress_{axis}", "Pa")
        elif f"force_{axis}" in given.found:
            area = given.area()
            out[f"nominal_stress_{axis}"] = given.column(f"force_{axis}", "N") / area
        else:
            raise given.missing(f"column for nominal_stress_{axis}", f"nominal_stress_{axis}")
    return out


def _shear(given: MachineTable) -> dict[str, np.ndarray]:
    """Return the amount of shear and the shear stress; a rheometer's strain and stress, or a lap joint's, are converted."""
    out: dict[str, np.ndarray] = {}
    path = next((key for key in ("shear", "strain", "strain_1", "displacement") if key in given.found), None)
    if path is None:
        raise given.missing("column for shear", "shear")
    if path == "displacement":
        out["shear"] = given.column("displacement", "m") / given.size("thickness", "has the displacement of a sheared layer")
    else:
        out["shear"] = given.strain(path)
    stress = next((key for key in ("shear_stress", "nominal_stress", "nominal_stress_1", "force") if key in given.found), None)
    if stress is None:
        raise given.missing("column for shear_stress", "shear_stress")
    if stress == "force":
        sides = [given.size(side, "has the force on a sheared layer") for side in ("length", "width")]
        out["shear_stress"] = given.column("force", "N") / (sides[0] * sides[1])
        given.summary.append(f"sheared face of {1e6 * sides[0] * sides[1]:g} mm^2 -> shear stress")
    else:
        out["shear_stress"] = given.column(stress, "Pa")
    return out


def _sizes(table: Table, specimen: Specimen) -> dict[str, float]:
    """Return the known dimensions of the specimen [m], from the lines above the table and from `specimen`."""
    sizes: dict[str, float] = {}
    for row in table.preamble:
        for title, value, unit in _stated(row):
            for name, pattern in _SIZES.items():
                if re.fullmatch(pattern, bare_title(title)):
                    sizes[name] = value * conversion_factor(unit, _KINDS.get(name, "m"), f"{title} in the preamble")
    given = {name: text for name, text in specimen._asdict().items() if text}
    if given.keys() & {"area", "width", "thickness", "diameter"}:  # a stated section replaces that in the file
        sizes = {name: value for name, value in sizes.items() if name not in ("area", "diameter")}
    return sizes | {name: parse_quantity(text, _KINDS.get(name, "m"), _OPTIONS.get(name, name)) for name, text in given.items()}


_KINDS = {"area": "m^2"}
"""SI units of sizes that are no lengths."""
_OPTIONS = {"diameter": "section_diameter"}
"""Options whose name is not that of the field of `Specimen`."""
_IN_ONE = re.compile(r"([^:=]{1,60})[:=]\s*([+-]?\d[\d.]*)\s*([a-zA-Zµ]{1,3}(?:\^?[2²])?(?!\w))")


def _stated(row: list[str]) -> list[tuple[str, float, str]]:
    """Return the title, number and unit of a line above the table: `Width;10;mm`, `Width (mm);10` or `Width: 10 mm`."""
    cells = [cell[:LONGEST_TITLE] for cell in row if cell]
    if len(cells) == 1 or (len(cells) > 1 and not is_number(cells[1])):
        joined = " ".join(cells[:3])
        return [(title.strip(), float(number), unit) for title, number, unit in _IN_ONE.findall(joined) if is_number(number)]
    unit = re.search(r"[\(\[](.+?)[\)\]]", cells[0]) if cells else None
    if len(cells) > 1 and (unit or len(cells) > 2):
        return [(cells[0].rstrip(": "), float(cells[1]), unit[1] if unit else cells[2])]
    return []
