"""Reader of spreadsheets (xlsx, xlsm, xls), recognised by their content. The files are not trusted."""

import re
import zipfile
from pathlib import Path
from typing import Any

from neuido.data.files.parsing import is_zip, one_line, parser_errors
from neuido.errors import UserError
from neuido.physics.runtime.lazy import import_extra
from neuido.physics.runtime.limits import check_limit

ZIP, COMPOUND = b"PK\x03\x04", b"\xd0\xcf\x11\xe0"
"""First bytes of an xlsx file and of an xls file."""
_COMMA = re.compile(r"[+-]?\d*,\d+([eE][+-]?\d+)?")
_REFERENCE = re.compile(rb'<(?:\w+:)?c [^>]*?r="([A-Z]{1,3})(\d{1,7})"')
"""The place of a cell in the XML of a sheet."""
_CHUNK = 1 << 20


def is_spreadsheet(path: Path) -> bool:
    """Whether a file is a spreadsheet by its first bytes; text that is called .xls, as some machines write it, is none."""
    if not path.is_file():
        return False
    try:
        with path.open("rb") as file:
            return file.read(4) in (ZIP, COMPOUND)
    except OSError as error:
        raise UserError(f"{path} cannot be read: {one_line(error)}") from error


def read_spreadsheet(path: Path) -> dict[str, list[list[str]]]:
    """Read the rows of each sheet that is not empty, as text, by the name of the sheet.

    Raises:
        UserError: The file is damaged, is no spreadsheet, or is too large.
    """
    calamine = import_extra("python_calamine", path.name)
    check_limit(path.stat().st_size, "NEUIDO_MAX_TEXT_BYTES", f"{path} has {path.stat().st_size} bytes")
    with parser_errors(path, "spreadsheet"):
        if is_zip(path):
            _check_size(path)
        book = calamine.CalamineWorkbook.from_path(str(path))
        sheets = {name: book.get_sheet_by_name(name).to_python(skip_empty_area=True) for name in book.sheet_names}
    out = {}
    for name, cells in sheets.items():
        count = len(cells) * max((len(row) for row in cells), default=0)
        check_limit(count, "NEUIDO_MAX_TABLE_CELLS", f"{path}, sheet {name!r} has {count} cells")
        rows = [[_text(cell) for cell in row] for row in cells]
        if any(filled := [row for row in rows if any(row)]):
            out[name] = filled
    if not out:
        raise UserError(f"{path} has no cells: is it the right file?")
    return out


def _check_size(path: Path) -> None:
    """Check the unpacked size of an xlsx file and the extent of its sheets before either is allocated."""
    with zipfile.ZipFile(path) as archive:
        size = sum(entry.file_size for entry in archive.infolist())
        check_limit(size, "NEUIDO_MAX_TEXT_BYTES", f"{path} unpacks to {size} bytes")
        for entry in archive.infolist():
            if not re.search(r"worksheets/[^/]*\.xml$", entry.filename):
                continue
            rows = columns = 0
            kept = b""
            with archive.open(entry) as stream:
                while chunk := stream.read(_CHUNK):
                    for letters, number in _REFERENCE.findall(kept + chunk):
                        rows, columns = max(rows, int(number)), max(columns, _column(letters))
                    kept = chunk[-100:]
            check_limit(rows * columns, "NEUIDO_MAX_TABLE_CELLS", f"{path}, {entry.filename} has {rows} x {columns} cells")


def _column(letters: bytes) -> int:
    number = 0
    for letter in letters:
        number = 26 * number + letter - 64
    return number


def _text(cell: Any) -> str:
    """Return a cell as text; a number that was typed with a decimal comma gets a point."""
    if isinstance(cell, bool):
        return str(cell)
    if isinstance(cell, float) and cell.is_integer() and abs(cell) < 1e15:
        return str(int(cell))
    text = str(cell).strip()
    return text.replace(",", ".") if isinstance(cell, str) and _COMMA.fullmatch(text) else text
