"""Reader of measured tables, from a text file of any dialect or an Excel sheet: titles, units, numbers and preamble."""

import re
from pathlib import Path
from typing import NamedTuple

import numpy as np

from neuido.data.files.delimited import is_number, read_delimited
from neuido.data.files.parsing import parser_errors
from neuido.data.importers.units import is_unit
from neuido.errors import UserError
from neuido.physics.runtime.lazy import import_extra

LONGEST_TITLE = 200
"""Characters of a title that are looked at."""


class Table(NamedTuple):
    """A table of C columns and n rows."""

    titles: list[str]
    units: list[str]
    """Unit of each column; empty if the table does not state it."""
    data: np.ndarray
    """(n, C) float64; NaN if a cell contains no number."""
    preamble: list[list[str]]
    """Rows above the titles."""
    notes: list[str]
    """How the file was read, for the summary."""


def read_cells(path: Path) -> tuple[list[list[str]], list[str]]:
    """Read the rows of a text file or of the first sheet of an Excel file; return them and notes for the summary."""
    if path.suffix.lower() in (".xlsx", ".xls", ".xlsm"):
        pandas = import_extra("pandas", f"{path.name}")
        import_extra("openpyxl", f"{path.name}")
        with parser_errors(path, "Excel sheet"):
            sheet = pandas.read_excel(path, header=None, dtype=object)
        rows = [["" if pandas.isna(cell) else str(cell).strip() for cell in row] for row in sheet.to_numpy()]
        return [row for row in rows if any(row)], ["first sheet"]
    table = read_delimited(path)
    names = {"\t": "tabs", " ": "blanks", ",": "commas", ";": "semicolons"}
    notes = [f"{names[table.separator]} between columns", f"encoding {table.encoding}"]
    return table.rows, [*notes, "decimal commas"] if table.decimal == "," else notes


def read_titled(path: Path) -> Table:
    """Read a table whose titles stand directly above its numbers, with or without a row of units between them.

    Raises:
        UserError: The file has no block of at least three rows of numbers.
    """
    rows, notes = read_cells(path)
    first = next((i for i in range(len(rows)) if all(_numeric(row) for row in rows[i : i + 3]) and len(rows) - i > 2), None)
    if first is None:
        raise UserError(f"{path} has no block of three rows of numbers: is it a table of measured values?")
    width = max(len(row) for row in rows[first:])
    above = rows[first - 1] if first else [f"column {i + 1}" for i in range(width)]
    units = [""] * width
    head = first - 1
    if first > 1 and all(is_unit(cell) for cell in above) and not all(is_unit(cell) for cell in rows[first - 2]):
        units = [cell.strip("()[] ") for cell in above] + [""] * (width - len(above))
        above, head = rows[first - 2], first - 2
        notes.append("a row of units")
    titles = [" ".join(cell[:LONGEST_TITLE].split()) for cell in above] + [""] * (width - len(above))
    for i, title in enumerate(titles[:width]):
        found = re.search(r"[\(\[]([^()\[\]]*)[\)\]]\s*$|\s(?:in\s)?(%|k?N|[kMG]?Pa|mm|ms|s)$", title)
        if found and not units[i] and is_unit(found[1] or found[2] or ""):
            units[i] = (found[1] or found[2] or "").strip()
    data = np.full((len(rows) - first, width), np.nan)
    for i, row in enumerate(rows[first:]):
        for j, cell in enumerate(row):
            if is_number(cell):
                data[i, j] = float(cell)
    empty = int((~np.isfinite(data)).all(axis=1).sum())
    if head > 0:
        notes.append(f"{head} lines of preamble skipped")
    if empty:
        notes.append(f"{empty} rows without data")
    return Table(titles[:width], units[:width], data, rows[: max(head, 0)], notes)


def _numeric(row: list[str]) -> bool:
    """Whether more than half of the filled cells of a row are numbers."""
    filled = [cell for cell in row if cell]
    return len(filled) > 1 and sum(is_number(cell) for cell in filled) > 0.5 * len(filled)
