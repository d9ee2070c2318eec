"""Shared parts of the readers of measured data: headers, CSV columns, declared effects and roles. The files are not trusted."""

import contextlib
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

from neuido.data.files.delimited import is_number, read_delimited
from neuido.data.files.parsing import read_yaml
from neuido.data.files.values import check_keys, mapping, number, path_inside
from neuido.data.files.yaml_files import checking
from neuido.errors import UserError
from neuido.physics.effects.parameters import LIBRARY, Effects

Entry = TypeVar("Entry")
ROLES = ("fit", "held_out")
WAVES = ["frequency", *(f"{part}{a}" for part in "sc" for a in "xyz")]
"""Parameters of a harmonic `time_force`, s sin(2 pi f t) + c cos(2 pi f t) [m/s^2], beside its knots."""


def read_header(folder: Path, name: str, form: str) -> tuple[Path, dict[str, Any]]:
    """Read the YAML file of a folder of measured data; return its path and content.

    Args:
        folder: The folder, or the file itself.
        name: Name of the file in the folder.
        form: Required value of the key `format`.

    Raises:
        UserError: The file is missing, not valid YAML, or has another format.
    """
    given = Path(folder).expanduser()
    file = given if given.is_file() else given / name
    if not file.is_file():
        raise UserError(f"{file} is missing: {given} is not a folder of the format {form}")
    content = read_yaml(file)
    if content.get("format") != form:
        raise UserError(f"{file}: format = {content.get('format')!r} must be {form!r}")
    return file, content


@contextlib.contextmanager
def errors_of(file: Path) -> Iterator[None]:
    """Add the path of the file to errors about its content."""
    with checking(file):
        try:
            yield
        except OverflowError as error:
            raise UserError(f"{file}: a number is too large: {error}") from error


def read_entries(given: Any, key: str, what: str, read: Callable[[Any, str], Entry]) -> tuple[Entry, ...]:
    """Read the entries of a non-empty list; require distinct names.

    Args:
        given: The list.
        key: Name of the list in error messages.
        what: What an entry is, in error messages.
        read: Reads an entry, given its name in error messages; the result has an attribute `name`.

    Raises:
        UserError: It is not a non-empty list, or two entries have the same name.
    """
    if not isinstance(given, list) or not given:
        raise UserError(f"{key} must be a list of at least one {what}, got {given!r}")
    entries: list[Entry] = []
    for i, entry in enumerate(given):
        entries.append(read(entry, f"{key}[{i}]"))
        if entries[-1].name in [other.name for other in entries[:-1]]:  # type: ignore[attr-defined]
            raise UserError(f"{key}[{i}].name = {entries[-1].name!r} is the name of another {what}: rename one of them")  # type: ignore[attr-defined]
    return tuple(entries)


def read_columns(folder: Path, entry: Mapping[str, Any], where: str, *, scale: Mapping[str, float]) -> tuple[dict[str, np.ndarray], range]:
    """Read the columns of a CSV file that `entry` names.

    Args:
        folder: The folder that must contain the file.
        entry: `file`; `columns`, the title in the file of each key; and optionally `rows`, a half-open range of data rows.
        where: Name of the entry in error messages.
        scale: Factor of each key; 1 if absent.

    Returns:
        The columns by key, (n,) float64, and the range of the data rows that were read.

    Raises:
        UserError: The file or a column is missing, a cell is not a finite number, or `rows` is outside the file.
    """
    path = path_inside(folder, entry["file"], f"{where}.file")
    if not path.is_file():
        raise UserError(f"{where}: the file {path} is missing")
    columns = mapping(entry["columns"], f"{where}.columns")
    try:
        table = read_delimited(path).rows
    except UserError as error:
        raise UserError(f"{where}: {error}") from error
    if not table:
        raise UserError(f"{where}: {path} is empty")
    header, lines = _titles(table, [title for title in columns.values() if isinstance(title, str)])
    rows = _rows(entry.get("rows"), len(lines), where)
    out = {}
    for key, title in columns.items():
        if not isinstance(title, str) or title not in header:
            raise UserError(f"{where}.columns.{key} = {title!r} is not in {path.name}, which has {', '.join(header)}")
        if header.count(title) > 1:
            raise UserError(f"{where}.columns.{key}: {path.name} has {header.count(title)} columns named {title!r}")
        index = header.index(title)
        cells = np.array([_cell(lines[i], index, f"{where}: {path.name}, data row {i}, {title}") for i in rows])
        with np.errstate(over="ignore"):
            out[key] = cells * scale.get(key, 1.0)
        if not np.isfinite(out[key]).all():
            raise UserError(f"{where}: {path.name}, {title}: a number exceeds the range of floating point after scaling: check scale")
    return out, rows


def optional_numbers(cells: Sequence[str], name_row: Callable[[int], str]) -> np.ndarray:
    """Return the numbers of a column, (n,); NaN where a cell is empty or `nan`.

    Args:
        cells: The cells of the column.
        name_row: Returns the words for a row, counted from 0, in error messages.

    Raises:
        UserError: Another cell is no number.
    """
    missing = [not cell or cell.lower() == "nan" for cell in cells]
    wrong = next((i for i, cell in enumerate(cells) if not missing[i] and not is_number(cell)), None)
    if wrong is not None:
        raise UserError(f"{name_row(wrong)} is {cells[wrong]!r}, which is no number")
    return np.array([np.nan if lacks else float(cell) for cell, lacks in zip(cells, missing)])


def named_columns(
    folder: Path, file: Any, where: str, wanted: Sequence[str], optional: Sequence[str] = (), words: Sequence[str] = ()
) -> tuple[dict[str, np.ndarray], dict[str, list[str]]]:
    """Read columns of a CSV file by their titles; return them as numbers (NaN: an empty cell), and optional columns of words as text.

    Raises:
        UserError: The file or a wanted column is missing, a title stands twice, or a cell is no number.
    """
    path = path_inside(folder, file, where)
    if not path.is_file():
        raise UserError(f"{where}: the file {path} is missing")
    table = read_delimited(path)
    if len(table.rows) < 2:
        raise UserError(f"{where}: {path.name} has no rows below its titles")
    titles, rows = [cell.strip() for cell in table.rows[0]], table.rows[1:]
    if missing := [title for title in wanted if title not in titles]:
        raise UserError(f"{where}: {path.name} has no column {missing[0]!r}; its columns are {', '.join(titles)[:120]}")
    numbers, texts = {}, {}
    for title in (*wanted, *(t for t in (*optional, *words) if t in titles)):
        if titles.count(title) > 1:
            raise UserError(f"{where}: {path.name} has {titles.count(title)} columns named {title!r}")
        at = titles.index(title)
        cells = [row[at].strip() if at < len(row) else "" for row in rows]
        if title in words:
            texts[title] = cells
        else:
            numbers[title] = optional_numbers(cells, lambda i, title=title: f"{where}: {path.name}, line {table.lines[i + 1]}, {title}")
    return numbers, texts


def read_effects(given: Any, where: str, *, known: tuple[str, ...]) -> dict[str, float]:
    """Read the effects that a model declares; return their parameters by flat names, for example {"drag_quadratic.k": 0.01}.

    Args:
        given: The key `effects`: a number for "name.parameter"; or, for a name, a mapping of its parameters, a list of them in the order of
            the library, or a number if the effect has one parameter. Effects that are not listed are absent.
        where: Name of the key in error messages.
        known: Names of the effects that the kind of data supports.

    Raises:
        UserError: An effect or parameter is unknown, a value is not a number, or a parameter lacks another one that it needs.
    """
    library = {entry.name: [parameter.name for parameter in entry.parameters] for entry in LIBRARY}
    library["time_force"] += WAVES
    flat: dict[str, float] = {}
    for name, value in mapping({} if given is None else given, where).items():
        name, _, part = str(name).partition(".")
        value = {part: value} if part else value
        if name not in known:
            raise UserError(f"{where} has the unknown effect {name!r}: choose from {', '.join(known)}")
        own = library[name]
        if not isinstance(value, Mapping):
            values = value if isinstance(value, list) else [value]
            if len(values) > len(own) or (len(values) < len(own) and not own[0] == "x"):
                raise UserError(f"{where}.{name} takes {', '.join(own)}, got {value!r}")
            value = dict(zip(own, values))
        check_keys(value, f"{where}.{name}", tuple(own), tuple(own))
        for key, figure in value.items():
            flat[f"{name}.{key}"] = number(figure, f"{where}.{name}.{key}")
    try:
        later = [f"time_force.{key}" for key in WAVES]  # `discrepancy.problems.candidates` converts them to knots; a gradient needs a body
        other = {entry.name for entry in LIBRARY if entry.only == "track"} | {"stiffness_gradient"}
        Effects.of({key: figure for key, figure in flat.items() if key.partition(".")[0] not in other and key not in later})
    except UserError as error:
        raise UserError(f"{where}: {error}") from error
    return flat


def read_free(given: Any, known: tuple[str, ...], where: str = "model.free") -> tuple[str, ...]:
    """Validate the list of parameters to fit; return it as a tuple.

    Raises:
        UserError: It is not a list, or a parameter is unknown or listed twice.
    """
    if not isinstance(given, list):
        raise UserError(f"{where} must be a list of parameters, got {given!r}")
    for key in given:
        if key not in known:
            raise UserError(f"{where} has the unknown parameter {key!r}: choose from {', '.join(known)}")
    if len(set(given)) < len(given):
        raise UserError(f"{where} lists a parameter twice: {given}")
    return tuple(given)


def read_text(given: Any, where: str) -> str:
    """Validate text that is not blank; return it.

    Raises:
        UserError: The value is not text, or is blank.
    """
    if not isinstance(given, str) or not given.strip():
        raise UserError(f"{where} must be text, got {given!r}")
    return given


def read_role(given: Any, where: str) -> str:
    """Validate a role, `fit` or `held_out`; return it.

    Raises:
        UserError: The role is unknown.
    """
    if given not in ROLES:
        raise UserError(f"{where}.role = {given!r} is unknown: choose from {', '.join(ROLES)}")
    return given


def check_increasing(t: np.ndarray, where: str) -> np.ndarray:
    """Check that times [s] (n,) increase from row to row; return them.

    Raises:
        UserError: A time does not exceed the one before.
    """
    if (np.diff(t) <= 0).any():
        i = int(np.argmax(np.diff(t) <= 0))
        raise UserError(f"{where}: times must increase from row to row, but {t[i + 1]:g} s follows {t[i]:g} s (data row {i + 1})")
    return t


def _titles(table: list[list[str]], wanted: list[str]) -> tuple[list[str], list[list[str]]]:
    """Split a table into titles and data rows.

    The titles are the first row that has all `wanted` ones. A row of units below the titles is skipped.
    """
    first = next((i for i, row in enumerate(table) if set(wanted) <= set(row)), 0)
    lines = table[first + 1 :]
    if lines and len(lines[0]) > 1 and not any(is_number(cell) or cell.lower() in ("nan", "inf") for cell in lines[0]) and all(lines[0]):
        lines = lines[1:]
    return table[first], lines


def _rows(given: Any, count: int, where: str) -> range:
    if given is None:
        rows = range(count)
    else:
        whole = isinstance(given, list) and len(given) == 2 and all(isinstance(i, int) and not isinstance(i, bool) for i in given)
        if not whole or not 0 <= given[0] < given[1]:
            raise UserError(f"{where}.rows must be [first row, row after the last], got {given!r}")
        if given[1] > count:
            raise UserError(f"{where}.rows = {given} exceeds the {count} data rows of the file")
        rows = range(*given)
    if len(rows) < 3:
        raise UserError(f"{where} has {len(rows)} data rows; at least 3 are needed")
    return rows


def _cell(line: list[str], index: int, where: str) -> float:
    try:
        value = float(line[index])
    except (IndexError, ValueError):
        value = np.nan
    if not np.isfinite(value):
        raise UserError(f"{where} is {line[index]!r}, which is not a finite number" if index < len(line) else f"{where} is missing")
    return value
