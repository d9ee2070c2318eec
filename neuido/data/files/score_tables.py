"""CSV tables of scores, and the folder of each scene's results. Importing this module does not load torch."""

import csv
import io
import os
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from neuido.data.files.parsing import read_text
from neuido.errors import UserError
from neuido.physics.runtime.limits import check_limit, limit


def write_rows(path: str | os.PathLike, rows: Sequence[dict[str, Any]]) -> None:
    """Write rows as a CSV file, atomically; a key that a row lacks gives an empty cell."""
    from neuido.data.files.writing import write_text

    path = Path(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    names = list(dict.fromkeys(name for row in rows for name in row))
    text = io.StringIO()
    writer = csv.DictWriter(text, names, restval="", lineterminator="\n")
    writer.writeheader()
    writer.writerows({name: f"{value:.6g}" if isinstance(value, float) else value for name, value in row.items()} for row in rows)
    write_text(path, text.getvalue())


def read_rows(path: str | os.PathLike) -> list[dict[str, Any]]:
    """Read a CSV file as one dictionary per row; numbers become floats, and empty cells are omitted.

    Raises:
        UserError: The file is missing or not text.
    """
    text = read_text(path, "cannot be read as a table")
    cells = text.count(",") + text.count("\n")
    check_limit(cells, "NEUIDO_MAX_TABLE_CELLS", f"{path} has {cells} cells")
    try:
        rows = csv.DictReader(io.StringIO(text, newline=""))
        if rows.fieldnames is not None and len(rows.fieldnames) * (text.count("\n") + 1) > 10 * limit("NEUIDO_MAX_TABLE_CELLS"):
            raise UserError(f"{path} has {len(rows.fieldnames)} columns and too many rows to fill: NEUIDO_MAX_TABLE_CELLS raises the limit")
        return [{k: number(v) for k, v in row.items() if k is not None and v} for row in rows]
    except csv.Error as error:
        raise UserError(f"{path} cannot be read as a table: {error}") from error


def number(text: str) -> float | str:
    """Convert a cell to a float if it is a number; return it unchanged otherwise."""
    try:
        return float(text)
    except (TypeError, ValueError):
        return text


def folder_of(out: str | os.PathLike, name: str) -> Path:
    """Return the folder of a scene's results; unsafe characters of the name are replaced, so the folder lies inside `out`."""
    clean = "".join(c if c.isalnum() or c in "-_." else "-" for c in name).lstrip(".") or "scene"
    return Path(out) / clean
