"""Reader of measured tables, from a text file of any dialect or a spreadsheet: titles, units, numbers and preamble."""

import math
import re
from pathlib import Path
from typing import NamedTuple

import numpy as np

from neuido.data.files.delimited import is_number, read_delimited
from neuido.data.importers.tables.cell_units import with_units_above
from neuido.data.importers.tables.clocks import clock_seconds, is_clock, over_midnight
from neuido.data.importers.tables.spreadsheets import is_spreadsheet, read_spreadsheet
from neuido.data.importers.tables.titles import SPECIMEN, UNIT_IN_TITLE, bare_title, find_columns
from neuido.data.importers.tables.units import is_unit
from neuido.errors import UserError

LONGEST_TITLE = 200
"""Characters of a title that are looked at."""
LEAST_ROWS = 3
"""Rows of numbers that make a table, at the least."""
MISSING = ("", "-", "--", "nan", "na", "n/a", "null", "none", "inf", "-inf")
"""Words for a number that is missing."""
MOST_TABLES = 200
"""Tables of one file, at the most."""
_STATISTIC = re.compile(
    r"(mean|average|avg|std|sd|s\.d\.|st\.?dev|standard ?deviation|variance|min|max|minimum|maximum|median|range|sum|total|count|cv|"
    r"mittelwert|standardabweichung|summe|anzahl|moyenne|m.diane|.cart[- ]type|somme|media|promedio|m.ximo|m.nimo)\.?:?",
    re.IGNORECASE,
)
"""A word that heads a row of a summary below a table."""
_MICRO = re.compile(r"\b(micro[- _]?strain|mikrodehnung|[µμ]strain|[µμ]ε)", re.IGNORECASE)
"""A title of strains that is their unit too."""
_PAGE = re.compile(r"(page|seite|blatt|p.gina)\b.{0,30}", re.IGNORECASE)
"""A line between the pages of one table."""


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
    cells: list[list[str]]
    """The n rows as text; a row may be shorter than C."""
    label: str = ""
    """What tells this table from the others of its file: the name of its sheet or of its specimen."""


def read_cells(path: Path) -> tuple[list[list[str]], list[str]]:
    """Read the rows of a text file or of the first sheet of a spreadsheet; return them and notes for the summary."""
    sheets, notes = _sheets(path)
    name, rows = next(iter(sheets.items()))
    return rows, [*notes, f"first sheet {name!r}"] if name else notes


def _sheets(path: Path) -> tuple[dict[str, list[list[str]]], list[str]]:
    """Read the rows of each sheet by name; a text file is one sheet without a name."""
    if is_spreadsheet(path):
        sheets = read_spreadsheet(path)
        return {name: with_units_above(rows, LEAST_ROWS, path.name) for name, rows in sheets.items()}, []
    table = read_delimited(path)
    names = {"\t": "tabs", " ": "blanks", ",": "commas", ";": "semicolons", "|": "bars"}
    notes = [f"{names[table.separator]} between columns", f"encoding {table.encoding}"]
    return {"": with_units_above(table.rows, LEAST_ROWS, path.name)}, [*notes, "decimal commas"] if table.decimal == "," else notes


def read_titled(path: Path) -> Table:
    """Read the first table of a file; `read_tables` describes it."""
    sheets, notes = _sheets(path)
    name = next((name for name, rows in sheets.items() if _first_block(rows, 0) is not None), next(iter(sheets)))
    return _block(sheets[name], *_extent(sheets[name], 0, path), [*notes, f"sheet {name!r}"] if name else notes)


def read_tables(path: Path, sheet: str | None = None, *, numbered: bool = True) -> list[Table]:
    """Read all tables of a file whose titles stand directly above their numbers, with or without a row of units between them.

    A file has several where its sheets, blocks one below the other, groups of columns with the same titles, or the entries of a column
    `Specimen` are specimens of their own.

    Args:
        path: The file.
        sheet: Name of the only sheet to read; None: all sheets that contain a table.
        numbered: Whether the number at the end of a title counts specimens; in a biaxial test it names an axis.

    Raises:
        UserError: The file has no block of at least three rows of numbers, or no sheet of this name.
    """
    sheets, notes = _sheets(path)
    if sheet is not None:
        if sheet not in sheets:
            raise UserError(f"{path.name} has no sheet {sheet!r}: choose from {', '.join(sheets) if '' not in sheets else 'a spreadsheet'}")
        sheets = {sheet: sheets[sheet]}
    tables: list[Table] = []
    for name, rows in sheets.items():
        if len(sheets) > 1 and _first_block(rows, 0) is None:
            notes.append(f"sheet {name!r} has no table")
            continue
        own = _stacked(rows, path, [*notes, f"sheet {name!r}"] if name else notes, numbered)
        tables += [one._replace(label=" ".join(filter(None, (name if len(sheets) > 1 else "", one.label)))) for one in own]
    if not tables:
        raise UserError(f"{path} has no sheet with three rows of numbers: is it a table of measured values?")
    if len(tables) > MOST_TABLES:
        raise UserError(f"{path} has {len(tables)} tables, more than {MOST_TABLES}: split the file")
    return tables


def _stacked(rows: list[list[str]], path: Path, notes: list[str], numbered: bool) -> list[Table]:
    """Read the blocks of one sheet, one below the other, each with titles of its own."""
    out: list[Table] = []
    start, stop = _extent(rows, 0, path)
    above = 0
    while True:
        following = _next_titled(rows, stop)
        while following is not None and _goes_on_after(rows, start, stop, following):
            stop = _end_of_block(rows, following)
            following = _next_titled(rows, stop)
        end = len(rows) if following is None else _titles_row(rows, following)
        block = _block(rows[above:end], start - above, end - above, notes)
        block = block._replace(preamble=[*(out[0].preamble if out else []), *block.preamble])
        beside = _side_by_side(block, numbered)
        out += beside if len(beside) > 1 else _by_specimen(block)
        if following is None:
            break
        above, start = stop, following
        stop = _end_of_block(rows, start)
    if len(out) > 1:
        out = [one if one.label else one._replace(label=str(i + 1)) for i, one in enumerate(out)]
    return out


def _first_block(rows: list[list[str]], start: int) -> int | None:
    """Return the first row of three rows of numbers; rows with gaps may lie between them, and before them."""
    first = next((i for i in range(start, len(rows)) if _numeric(rows[i]) and _goes_on(rows, i)), None)
    while first is not None and first > start and _has_gaps(rows[first - 1]):
        first -= 1
    return first


def _goes_on(rows: list[list[str]], first: int) -> bool:
    """Whether three rows of numbers follow, before any row that has a word."""
    count = 0
    for row in rows[first:]:
        if not _numeric(row) and not _has_gaps(row):
            return False
        count += _numeric(row)
        if count >= LEAST_ROWS:
            return True
    return False


def _has_gaps(row: list[str]) -> bool:
    """Whether a row has a number, and else nothing or the word for a missing one."""
    return any(map(_is_value, row)) and all(_is_value(cell) or cell.lower() in MISSING for cell in row)


def _extent(rows: list[list[str]], start: int, path: Path) -> tuple[int, int]:
    first = _first_block(rows, start)
    if first is None:
        raise UserError(f"{path} has no block of three rows of numbers: is it a table of measured values?")
    return first, _end_of_block(rows, first)


def _end_of_block(rows: list[list[str]], first: int) -> int:
    return next((i for i in range(first, len(rows)) if not any(is_number(cell) for cell in rows[i])), len(rows))


def _next_titled(rows: list[list[str]], stop: int) -> int | None:
    """Return the first row of the next block below `stop` that has titles of its own: a name of a quantity in two columns or more."""
    while stop < len(rows):
        first = _first_block(rows, stop)
        if first is None or first == stop:
            return None
        if len(find_columns(rows[_titles_row(rows, first)])) > 1:
            return first
        stop = _end_of_block(rows, first)
    return None


def _goes_on_after(rows: list[list[str]], start: int, stop: int, following: int) -> bool:
    """Whether the block at `following` is the next page of the one from `start` to `stop`: same titles, and its first column goes on."""
    above, below = _titles_row(rows, start), _titles_row(rows, following)
    between = [row for row in rows[stop:below] if not _PAGE.fullmatch(" ".join(filter(None, row)))]
    if between or above < 0 or rows[above:start] != rows[below:following]:
        return False
    first = [_value(row[0]) for row in rows[start:stop] if row and _is_value(row[0])]
    ahead = next((_value(row[0]) for row in rows[following:] if row and _is_value(row[0])), math.nan)
    steps = np.diff(first)
    return len(first) > 1 and abs(ahead - first[-1]) <= 3 * float(np.max(np.abs(steps))) and abs(ahead - first[-1]) < abs(ahead - first[0])


def _titles_row(rows: list[list[str]], first: int) -> int:
    """Return the row of titles above the first row of numbers: the one above it, or the next where that is a row of units."""
    units = first > 1 and all(is_unit(cell) for cell in rows[first - 1]) and not all(is_unit(cell) for cell in rows[first - 2])
    return first - 2 if units else first - 1


def _block(rows: list[list[str]], first: int, stop: int, notes: list[str]) -> Table:
    """Read one table; `rows` begin with its preamble, its numbers are in the rows from `first` to `stop`, or interrupted by other rows."""
    notes = list(notes)
    width = max(len(row) for row in rows[first:])
    units, head = [""] * width, first - 1
    above = rows[first - 1] if first else [f"column {i + 1}" for i in range(width)]
    if first and _titles_row(rows, first) == first - 2:
        units = [cell.strip("()[]<> ") for cell in above] + [""] * (width - len(above))
        above, head = rows[first - 2], first - 2
        notes.append("a row of units")
    titles = [" ".join(cell[:LONGEST_TITLE].split()) for cell in above] + [""] * (width - len(above))
    if head > 0:
        titles, units = _under_groups(rows[head - 1], titles, units)
    for i, title in enumerate(titles[:width]):
        found = UNIT_IN_TITLE.search(title)
        if found and not units[i] and is_unit(found[1] or found[2] or ""):
            units[i] = (found[1] or found[2] or "").strip()
        elif not units[i] and _MICRO.search(title):
            units[i] = "microstrain"
    cells = _without_summary(rows, first, notes)
    data = np.full((len(cells), width), np.nan)
    for i, row in enumerate(cells):
        for j, cell in enumerate(row):
            data[i, j] = _value(cell)
    for j in {j for row in cells[:LEAST_ROWS] for j, cell in enumerate(row) if is_clock(cell)}:
        data[:, j] = over_midnight(data[:, j].tolist(), [row[j] if j < len(row) else "" for row in cells])
    empty = int((~np.isfinite(data)).all(axis=1).sum())
    if head > 0:
        notes.append(f"{head} lines of preamble skipped")
    if empty:
        notes.append(f"{empty} rows without data")
    return Table(titles[:width], units[:width], data, rows[: max(head, 0)], notes, cells)


def _under_groups(groups: list[str], titles: list[str], units: list[str]) -> tuple[list[str], list[str]]:
    """Complete titles and units by a row of groups above them, as merged cells of a spreadsheet give it.

    A group's unit is that of the columns under it. Its name is put before titles only if more quantities are recognised then.
    """
    if any(map(_is_value, groups)) or sum(map(bool, groups)) < 1 or len(groups) > len(titles):
        return titles, units
    wide, last = [], ""
    for cell in [*groups, *[""] * (len(titles) - len(groups))]:  # a merged cell holds its text in the first column alone
        last = " ".join(cell[:LONGEST_TITLE].split()) or last
        wide.append(last)
    bare = [*groups, *[""] * (len(titles) - len(groups))]
    joined = [f"{group} {title}" if title else own for group, title, own in zip(wide, titles, bare)]
    if len(find_columns(joined)) > len(find_columns(titles)):
        titles = joined
    units = list(units)
    for i, group in enumerate(wide):
        found = UNIT_IN_TITLE.search(group)
        unit = (found[1] or "").strip() if found else ""  # in brackets: other words above a table may end in a unit too
        if unit and titles[i] and not units[i] and not UNIT_IN_TITLE.search(titles[i]) and is_unit(unit):
            units[i] = unit
    return titles, units


def _without_summary(rows: list[list[str]], first: int, notes: list[str]) -> list[list[str]]:
    """Return the rows of a table from `first` on, without its summary: rows headed by a statistic, and rows under other titles."""
    own = {cell for row in rows[max(first - 2, 0) : first] for cell in row}
    kept, words = [], []
    for i, row in enumerate(rows[first:]):
        filled = [cell for cell in row if cell]
        if len(filled) > 1 and not any(map(_is_value, filled)) and not own & set(filled) and len(find_columns(row)) > 1:
            if count := sum(any(map(_is_value, other)) for other in rows[first + i :]):
                notes.append(f"{count} rows under other titles ({', '.join(filled)[:60]}) are left out")
            break
        word = next((cell for cell in filled if _STATISTIC.fullmatch(cell)), None)
        if word is not None and any(map(_is_value, filled)):
            words.append(word)
        else:
            kept.append(row)
    if words:
        notes.append(f"{len(words)} rows of a summary are left out ({', '.join(dict.fromkeys(words))[:60]})")
    return kept


def _side_by_side(table: Table, numbered: bool) -> list[Table]:
    """Split a table whose titles repeat from left to right, once for each specimen."""
    names = [bare_title(title) for title in table.titles]
    for strip in (False, True)[: 1 + numbered]:
        keys = [re.sub(r"[ _.#]*\d+$", "", name) if strip else name for name in names]
        filled = [i for i, key in enumerate(keys) if key]
        own = [keys[i] for i in filled]
        size = next((k for k in range(2, len(own) // 2 + 1) if own[:k] * (len(own) // k) == own and len(set(own[:k])) == k), None)
        if size is None:
            continue
        out = []
        for start in range(0, len(filled), size):
            chosen = filled[start : start + size]
            labels = [cell for row in table.preamble[-1:] for cell in row[chosen[0] : chosen[-1] + 1] if cell and not is_number(cell)]
            out.append(
                Table(
                    [re.sub(r"[ _.#]*\d+(?=\s*([(\[<]|$))", "", table.titles[i]) if strip else table.titles[i] for i in chosen],
                    [table.units[i] for i in chosen],
                    table.data[:, chosen],
                    table.preamble,
                    [*table.notes, f"columns {chosen[0] + 1} to {chosen[-1] + 1}"],
                    [[row[i] if i < len(row) else "" for i in chosen] for row in table.cells],
                    labels[0][:40] if labels else str(start // size + 1),
                )
            )
        return out
    return [table]


def _by_specimen(table: Table) -> list[Table]:
    """Split a table by its column that names the specimen of each row."""
    column = next((i for i, title in enumerate(table.titles) if SPECIMEN.fullmatch(bare_title(title))), None)
    if column is None:
        return [table]
    names = [row[column] if column < len(row) else "" for row in table.cells]
    for i in range(1, len(names)):
        names[i] = names[i] or names[i - 1]  # merged cells of a spreadsheet hold their name in the first row
    named = [name for name in dict.fromkeys(names) if name]
    own = [name for name in named if names.count(name) >= LEAST_ROWS]
    if len(named) < 2 or 2 * sum(map(names.count, own)) < len(names):  # such a column may also count the rows
        return [table]
    out = []
    short = [f"{table.titles[column]} {name[:40]} has fewer than {LEAST_ROWS} rows and is left out" for name in named if name not in own]
    for name in own:
        chosen = [i for i, other in enumerate(names) if other == name]
        notes = [*table.notes, f"{table.titles[column]} {name[:40]}", *short]
        cells = [table.cells[i] for i in chosen]
        out.append(table._replace(data=table.data[chosen], cells=cells, notes=notes, label=name[:40]))
    return out


def _value(cell: str) -> float:
    """Return a cell as a number, or a clock in seconds; NaN for anything else."""
    return float(cell) if is_number(cell) else clock_seconds(cell)


def _numeric(row: list[str]) -> bool:
    """Whether more than half of the filled cells of a row are numbers."""
    filled = [cell for cell in row if cell]
    return len(filled) > 1 and sum(map(_is_value, filled)) > 0.5 * len(filled)


def _is_value(cell: str) -> bool:
    """Whether a cell is a number or a time."""
    return is_number(cell) or is_clock(cell)
