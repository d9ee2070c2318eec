"""Units inside the cells of a table, such as `5 %` and `12.3 mm`, become a row of units above the numbers."""

import math
import re

from neuido.data.files.delimited import NUMBER, is_number
from neuido.data.importers.tables.units import is_unit, ratio
from neuido.errors import UserError

MEASURED = re.compile(rf"(?P<number>{NUMBER.pattern})\s*(?P<unit>[a-zA-Z%‰µμ°][\w%/^²³°*·-]{{0,11}})")
"""A number with its unit."""


def with_units_above(rows: list[list[str]], least: int, name: str) -> list[list[str]]:
    """Move the units of cells into a row of their own, below the titles of each block of rows.

    Args:
        rows: Rows of a sheet.
        least: Rows that make a block, at the least.
        name: Name of the file in messages.

    Raises:
        UserError: A cell has no unit, or one of another kind, among cells of its column that have one.
    """
    found = [_measured(row) for row in rows]
    out: list[list[str]] = []
    start = 0
    while start < len(rows):
        stop = start
        while stop < len(rows) and found[stop]:
            stop += 1
        if stop - start >= least and start > 0:
            units, plain = _split(rows[start:stop], start, name)
            out += [units, *plain]
        else:
            out += rows[start:stop]
        out += rows[stop : stop + 1]
        start = stop + 1
    return out


def _measured(row: list[str]) -> bool:
    """Whether more than half of the filled cells of a row are numbers, and one of them at least has a unit."""
    filled = [cell for cell in row if cell]
    own = sum(_cell(cell) is not None for cell in filled)
    return own > 0 and len(filled) > 1 and own + sum(map(is_number, filled)) > 0.5 * len(filled)


def _cell(cell: str) -> tuple[float, str] | None:
    found = MEASURED.fullmatch(cell) if cell and cell[-1] not in "0123456789." else None
    return (float(found["number"]), found["unit"]) if found and is_unit(found["unit"]) else None


def _split(rows: list[list[str]], start: int, name: str) -> tuple[list[str], list[list[str]]]:
    """Return the unit of each column, and the rows without units, all in that of the first cell which has one."""
    units, plain = [""] * max(map(len, rows)), [list(row) for row in rows]
    for j in range(len(units)):
        own = [(i, _cell(row[j])) for i, row in enumerate(rows) if j < len(row)]
        units[j] = next((cell[1] for _, cell in own if cell), "")
        for i, cell in own:
            where = f"{name}, row {start + i + 1}: the cell {rows[i][j][:40]!r}"
            if cell is None:
                if units[j] and is_number(rows[i][j]) and float(rows[i][j]) != 0:
                    raise UserError(f"{where} has no unit, and others of its column have {units[j]}: write the unit in the title alone")
                continue
            factor = ratio(cell[1], units[j])
            if factor is None or not math.isfinite(factor):
                raise UserError(f"{where} is not in {units[j]}, as others of its column: give each quantity a column")
            plain[i][j] = repr(cell[0] * factor)
    return units, plain
