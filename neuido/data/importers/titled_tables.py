"""Tables of measured figures, from text of any dialect or a sheet of Excel: titles, units, numbers, and what stood before them."""

import re
from pathlib import Path
from typing import NamedTuple

import numpy as np

from neuido.data.files.delimited import is_number, read_delimited
from neuido.data.files.parsing import parser_errors
from neuido.data.importers.units import import_extra, is_unit
from neuido.errors import UserError


class Table(NamedTuple):
    """A table of C columns and n rows."""

    titles: list[str]
    units: list[str]
    """Of each column, empty where not given."""
    data: np.ndarray
    """(n, C) float64, NaN where a cell holds no number."""
    preamble: list[list[str]]
    notes: list[str]
    """What was found on the way, for the summary."""


def read_cells(path: Path) -> tuple[list[list[str]], list[str]]:
    """Return the rows of a file of text or of the first sheet of an Excel file, and notes for the summary."""
    if path.suffix.lower() in (".xlsx", ".xls", ".xlsm"):
        pandas = import_extra("pandas", f"{path.name}")
        import_extra("openpyxl", f"{path.name}")
        with parser_errors(path, "sheet of Excel"):
            sheet = pandas.read_excel(path, header=None, dtype=object)
        rows = [["" if pandas.isna(cell) else str(cell).strip() for cell in row] for row in sheet.to_numpy()]
        return [row for row in rows if any(row)], ["first sheet"]
    table = read_delimited(path)
    names = {"\t": "tabs", " ": "blanks", ",": "commas", ";": "semicolons"}
    notes = [f"{names[table.separator]} between columns", f"encoding {table.encoding}"]
    return table.rows, [*notes, "decimal commas"] if table.decimal == "," else notes


def read_titled(path: Path) -> Table:
    """Read a table whose titles stand right above its numbers, with a row of units or without.

    Raises:
        UserError: There is no block of numbers.
    """
    rows, notes = read_cells(path)
    first = next((i for i in range(len(rows)) if all(_numeric(row) for row in rows[i : i + 3]) and len(rows) - i > 2), None)
    if first is None:
        raise UserError(f"{path} holds no three rows of numbers in a block: is it a table of measured figures?")
    width = max(len(row) for row in rows[first:])
    above = rows[first - 1] if first else [f"column {i + 1}" for i in range(width)]
    units = [""] * width
    head = first - 1
    if first > 1 and all(is_unit(cell) for cell in above) and not all(is_unit(cell) for cell in rows[first - 2]):
        units = [cell.strip("()[] ") for cell in above] + [""] * (width - len(above))
        above, head = rows[first - 2], first - 2
        notes.append("a row of units")
    titles = [" ".join(cell.split()) for cell in above] + [""] * (width - len(above))
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
    filled = [cell for cell in row if cell]
    return len(filled) > 1 and sum(is_number(cell) for cell in filled) > 0.5 * len(filled)
