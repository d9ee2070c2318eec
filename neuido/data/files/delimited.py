"""Reader of text tables of any dialect: encoding, separator, decimal sign, comments. The files are not trusted."""

import csv
import re
from pathlib import Path
from typing import NamedTuple

from neuido.data.files.parsing import one_line
from neuido.errors import UserError
from neuido.physics.runtime.limits import check_limit

DIALECTS = ((",", "."), (";", ","), (";", "."), ("\t", "."), ("\t", ","), (" ", "."), (" ", ","), ("|", "."), ("|", ","), (",", ","))
"""Separators and decimal signs, the most likely first; a blank means any white space. The last one is of numbers in quotation marks."""
NUMBER = re.compile(r"[+-]?(\d+(\.\d*)?|\.\d+)([eE][+-]?\d+)?")  # each digit is matched in one way: no time grows with the square
_COMMA = re.compile(r"[+-]?(\d+|\d*,\d+)([eE][+-]?\d+)?")
_MARKS = "'\u2019 \u00a0\u2009\u202f"
"""Marks between thousands in Switzerland, France and by SI; points and commas do so too."""
_GROUPED = {
    ".": re.compile(rf"[+-]?[1-9]\d{{0,2}}((,\d{{3}})+|([{_MARKS}]\d{{3}})+)(\.\d+)?"),
    ",": re.compile(rf"[+-]?[1-9]\d{{0,2}}((\.\d{{3}})+|([{_MARKS}]\d{{3}})+)(,\d+)?"),
}
"""Numbers with marks between thousands. None begins with 0, so that 0.125 is no 125."""
_UNIT = re.compile(r"(?<=\d)\s?(?![eE][+-]?\d)[a-zA-Z%‰µμ°][^\s,;.]{0,11}$")
"""A unit after a number in a cell: `5 %`, `12,3 mm`."""
CLOCK = re.compile(
    r"(?:(?P<date>\d{4}-\d\d-\d\d|\d{4}/\d\d/\d\d|\d{1,2}\.\d{1,2}\.\d{4}|\d{1,2}/\d{1,2}/\d{4}),?[T ] ?)?(?P<first>\d{1,2}):"
    r"(?P<second>\d\d(?:[.,]\d{1,9}(?!:))?)(?::(?P<third>\d\d(?:[.,]\d{1,9})?))?(?:(?P<mark>[:;])(?P<frames>\d\d))?"
    r"(?: ?(?:Z|UTC|[+-]\d\d:?\d\d|(?P<half>[AaPp])\.?[Mm]\.?))?"
)
"""Time as hours:minutes:seconds or minutes:seconds, with a date before it, and hundredths of a second or frames after it."""
BROKEN, WORD, THOUSANDS = 2.0, 1.5, 0.01
"""What a cell takes from the score of a dialect: a broken number, a word (a name may be a column), and 1.250 read as 1250."""
BLOCK = "point"
"""Title of the column that names the trajectory of each row, where a file has one trajectory below the other."""
_RULE = re.compile(r"[\s|+:]*[-=_]{3,}([\s|+:]+[-=_]{3,})*[\s|+:]*")
"""A line that is drawn between titles and numbers."""
_MINUS = re.compile(r"\u2212(?=[\d.,])")
_FORTRAN = re.compile(r"([+-]?(?:\d+(?:[.,]\d*)?|[.,]\d+))[dD]([+-]?\d{1,3})")
"""A number of Fortran: 1.25D+02."""
_BOOKED = re.compile(r"\((\d+[.,]\d+)\)")
"""A negative number of a spreadsheet's accounting: (1.25). Without a decimal sign it may be a footnote."""
ENCODINGS = {
    "gb18030": ("时间", "位移", "应变", "应力", "变形", "载荷", "试验"),
    "cp932": ("時間", "変位", "荷重", "ひずみ", "歪", "応力", "試験"),
    "cp1251": ("время", "нагрузка", "перемещение", "деформация", "напряжение", "усилие", "удлинение"),
    "cp1250": ("siła", "obciążenie", "naprężenie", "odkształcenie", "wydłużenie"),
}
"""Encodings of text that is no UTF-8, each with words that show it; else it is of Western Europe."""
_SAMPLE = 400
"""Number of lines from which the dialect is detected."""


class Delimited(NamedTuple):
    """Cells of a text table; its numbers have a decimal point."""

    rows: list[list[str]]
    """Rows that are neither empty nor comments; titles that stand in a comment directly above the numbers are a row."""
    lines: list[int]
    """Line number of each row in the file, from 1."""
    encoding: str
    separator: str
    decimal: str


def is_number(cell: str) -> bool:
    """Whether a cell is one finite number with a decimal point."""
    return NUMBER.fullmatch(cell.strip()) is not None


def read_delimited(path: Path) -> Delimited:
    """Read a text table; detect its encoding, separator and decimal sign.

    Raises:
        UserError: The file is missing, too large or not text.
    """
    text, encoding = _decoded(path)
    cells = max(text.count(separator) for separator in ",;\t |") + text.count("\n") + text.count("\r")
    check_limit(cells, "NEUIDO_MAX_TABLE_CELLS", f"{path} has {cells} cells")
    numbered = [
        (i, line)
        for i, line in enumerate(text.splitlines(), 1)
        if line.strip() and not line.lstrip().startswith("#") and not _RULE.fullmatch(line)
    ]
    separator, decimal = _dialect([line for _, line in numbered[-_SAMPLE:]])
    rows, lines = [], []
    for i, line in numbered:
        try:
            cells = _split(line, separator)
        except csv.Error as error:
            raise UserError(f"{path}, line {i} is not valid CSV: {one_line(error)}") from error
        cells = [_with_point(cell, decimal) for cell in cells]
        if any(cells):
            rows.append(cells)
            lines.append(i)
    titles = _titles_in_comment(text, rows, lines, separator)
    if titles is not None:
        blocks = _blocks(text, titles, rows, lines)
        if len(set(blocks)) > 1:
            titles, rows = (titles[0], [*titles[1], BLOCK]), [[*row, name] for row, name in zip(rows, blocks)]
        rows, lines = [titles[1], *rows], [titles[0], *lines]
    return Delimited(rows, lines, encoding, separator, decimal)


def _titles_in_comment(text: str, rows: list[list[str]], lines: list[int], separator: str) -> tuple[int, list[str]] | None:
    """Return the line and the cells of the comment above a table without titles, `# t x y`, if it has as many cells as a row.

    Other comments may stand between if it names t and x.
    """
    if not rows or not all(is_number(cell) or CLOCK.fullmatch(cell) for cell in rows[0] if cell):
        return None
    above = [(i, line) for i, line in enumerate(text.splitlines()[: lines[0] - 1], 1) if line.strip()]
    for nearest, (number, line) in enumerate(reversed(above)):
        if nearest and not line.lstrip().startswith("#"):
            return None
        bare = line.strip().lstrip("#").strip()
        for own in (separator, " ", ","):
            cells = _split(bare, own) if own == " " or '"' not in bare else []
            named = not nearest or {"t", "x"} <= {cell.lower() for cell in cells}
            if named and len(cells) == len(rows[0]) and len(cells) > 1 and not any(is_number(cell) for cell in cells) and all(cells):
                return number, cells
    return None


def _blocks(text: str, titles: tuple[int, list[str]], rows: list[list[str]], lines: list[int]) -> list[str]:
    """Return the name of the trajectory of each row of a file for gnuplot, as Kinovea writes it: `# name`, its rows, and blank lines.

    Without names, two blank lines begin a trajectory, and so does one if the times start again below it.
    """
    if not {"t", "x"} <= {cell.lower() for cell in titles[1]}:
        return [""] * len(rows)
    at = [cell.lower() for cell in titles[1]].index("t")
    every = [line.strip() for line in text.splitlines()]
    gaps = [every[a:b] for a, b in zip([titles[0], *lines], [line - 1 for line in lines])]
    names = [next((line.lstrip("# ") for line in reversed(gap) if line.startswith("#")), "") for gap in gaps]
    out, named = list[str](), bool(names[0])
    for i, (gap, name) in enumerate(zip(gaps, names)):
        begins = not i or (bool(name) if named else len(gap) > 1 or (len(gap) == 1 and _before(rows[i], rows[i - 1], at)))
        if begins:
            count = len(dict.fromkeys(out))
            own = name if named else f"point {count + 1}"
            out.append(f"{own} ({count + 1})" if own in out else own)
        else:
            out.append(out[-1])
    return out


def _before(row: list[str], other: list[str], column: int) -> bool:
    """Whether the time of a row is not after that of another one; clocks are compared as text of the same length."""
    a, b = (cells[column] if column < len(cells) else "" for cells in (row, other))
    return float(a) <= float(b) if is_number(a) and is_number(b) else (len(a), a) <= (len(b), b)


def _decoded(path: Path) -> tuple[str, str]:
    if not path.is_file():
        raise UserError(f"{path} is missing" if not path.exists() else f"{path} is not a file")
    try:
        size = path.stat().st_size
        check_limit(size, "NEUIDO_MAX_TEXT_BYTES", f"{path} has {size} bytes")
        data = path.read_bytes()
    except OSError as error:
        raise UserError(f"{path} cannot be read: {one_line(error)}") from error
    encodings = ["utf-16"] if data.startswith((b"\xff\xfe", b"\xfe\xff")) else ["utf-8-sig", *_by_words(data), "cp1252"]
    if b"\0" in data and encodings[0] != "utf-16":
        raise UserError(f"{path} is not a CSV file: it contains zero bytes; convert an Excel sheet with `neuido import`")
    for encoding in encodings:
        try:
            return data.decode(encoding), encoding
        except UnicodeDecodeError:
            continue
    raise UserError(f"{path} is not a CSV file: its encoding is none of {', '.join(encodings)}; save it as UTF-8")


def _by_words(data: bytes) -> list[str]:
    """Return the encodings in whose text a word stands that shows them."""
    start = data[:10_000]
    return [name for name, words in ENCODINGS.items() if any(word in start.decode(name, errors="replace").lower() for word in words)]


def _dialect(lines: list[str]) -> tuple[str, str]:
    """Detect separator and decimal sign: those that make most cells numbers."""
    best, chosen = 0.0, DIALECTS[0]
    for separator, decimal in DIALECTS:
        score = 0.0
        for line in lines:
            try:
                cells = [cell for cell in _split(line, separator) if cell]
            except csv.Error:
                continue
            others = [cell for cell in cells if not _in_dialect(cell, decimal) and CLOCK.fullmatch(cell) is None]
            numbers = len(cells) - len(others)
            score += numbers - sum(BROKEN if cell[0] in "+-.,0123456789" else WORD for cell in others) if numbers else 0
            if (separator, decimal) != (",", "."):
                mark, other = (".", NUMBER) if decimal == "," else (",", _COMMA)
                score -= THOUSANDS * sum(mark in cell and other.fullmatch(cell) is not None for cell in cells)
        if score > best:
            best, chosen = score, (separator, decimal)
    if best > 0:
        return chosen
    counts = {
        separator: sum(line.count(separator) for line in lines) for separator in ("\t", ";", ",")
    }  # without numbers the titles decide
    commonest = max(counts, key=counts.__getitem__)
    return (commonest if counts[commonest] > counts[","] else ","), "."


def _split(line: str, separator: str) -> list[str]:
    if separator == " ":
        return [_plain(cell) for cell in line.split()]
    return [_plain(cell.strip()) for cell in next(csv.reader([line], delimiter=separator, strict=True, skipinitialspace=True))]


def _plain(cell: str) -> str:
    """Rewrite the typographic minus sign, Fortran's exponents and the negative numbers of accounting; return other text unchanged."""
    if not cell or cell[-1] not in "0123456789).,%":
        return cell
    cell = _MINUS.sub("-", cell)
    if found := _BOOKED.fullmatch(cell):
        return f"-{found[1]}"
    return f"{found[1]}e{found[2]}" if (found := _FORTRAN.fullmatch(cell)) else cell


def _in_dialect(cell: str, decimal: str) -> bool:
    """Whether a cell is a number in this dialect, alone or before its unit."""
    cell = _UNIT.sub("", cell)
    number = _COMMA.fullmatch(cell) if decimal == "," else NUMBER.fullmatch(cell)
    return number is not None or _GROUPED[decimal].fullmatch(cell) is not None


def _with_point(cell: str, decimal: str) -> str:
    """Rewrite a number with a decimal point and without thousands separators; return other text unchanged."""
    if not _in_dialect(cell, decimal):
        return cell
    if _GROUPED[decimal].fullmatch(_UNIT.sub("", cell)):
        cell = re.sub(rf"[{_MARKS}{',' if decimal == '.' else '.'}]", "", cell)
    return cell.replace(",", ".")
