"""CSV tables of scores, and the folder of each scene's results. Importing this module does not load torch."""

import csv
import io
import os
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from neuido.errors import UserError


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
    try:
        with Path(path).open(newline="", encoding="utf-8-sig") as file:
            return [{k: number(v) for k, v in row.items() if k is not None and v} for row in csv.DictReader(file)]
    except (OSError, UnicodeDecodeError, csv.Error) as error:
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
