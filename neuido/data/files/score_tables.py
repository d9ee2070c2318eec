"""Results on disk: tables as CSV files, and the folder of each scene. No torch at import."""

import csv
import io
import os
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from neuido.errors import UserError


def write_rows(path: str | os.PathLike, rows: Sequence[dict[str, Any]]) -> None:
    """Write rows as CSV, all at once; a value that a row lacks is empty."""
    from neuido.data.files.storage import write_text

    path = Path(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    names = list(dict.fromkeys(name for row in rows for name in row))
    text = io.StringIO()
    writer = csv.DictWriter(text, names, restval="", lineterminator="\n")
    writer.writeheader()
    writer.writerows({name: f"{value:.6g}" if isinstance(value, float) else value for name, value in row.items()} for row in rows)
    write_text(path, text.getvalue())


def read_rows(path: str | os.PathLike) -> list[dict[str, Any]]:
    """Read a CSV file: numbers as floats, other words as they are; an empty cell is left out.

    Raises:
        UserError: A file that is missing or no text.
    """
    try:
        with Path(path).open(newline="", encoding="utf-8-sig") as file:
            return [{k: number(v) for k, v in row.items() if k is not None and v} for row in csv.DictReader(file)]
    except (OSError, UnicodeDecodeError, csv.Error) as error:
        raise UserError(f"{path} cannot be read as a table: {error}") from error


def number(text: str) -> float | str:
    """Return a cell as a float where it is a number, else as text."""
    try:
        return float(text)
    except (TypeError, ValueError):
        return text


def folder_of(out: str | os.PathLike, name: str) -> Path:
    """Return the folder of a scene's results, under a name that stays inside `out`."""
    clean = "".join(c if c.isalnum() or c in "-_." else "-" for c in name).lstrip(".") or "scene"
    return Path(out) / clean
