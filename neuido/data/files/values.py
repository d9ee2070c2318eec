"""Validation of values from files: numbers, vectors, mappings, lists, and paths that must lie in a folder."""

import math
from collections.abc import Mapping
from pathlib import Path, PurePosixPath, PureWindowsPath
from typing import Any

from neuido.errors import UserError, suggest
from neuido.types import Vector


def number(value: Any, where: str, *, least: float = -math.inf, above: float = -math.inf, infinite: bool = False) -> float:
    """Validate a number; return it as a float.

    Args:
        value: The value in the file.
        where: Name of the value in error messages.
        least: Smallest allowed value.
        above: Bound that the value must exceed.
        infinite: Whether infinity is allowed.

    Raises:
        UserError: The value is not a number (text, true or false, a NaN), or it is outside its range.
    """
    try:
        wrong = isinstance(value, bool) or not isinstance(value, int | float) or math.isnan(value) or (math.isinf(value) and not infinite)
    except OverflowError as error:
        raise UserError(f"{where} must be a finite number, got one beyond the range of floating point") from error
    if wrong:
        raise UserError(f"{where} must be a {'' if infinite else 'finite '}number, got {value!r}")
    if not (value >= least and value > above):
        raise UserError(f"{where} must be {f'above {above:g}' if above > -math.inf else f'at least {least:g}'}, got {value!r}")
    return float(value)


def vector(value: Any, where: str) -> Vector:
    """Validate a list of three finite numbers; return it as a tuple.

    Raises:
        UserError: It is not such a list.
    """
    if not isinstance(value, list) or len(value) != 3:
        raise UserError(f"{where} must be three numbers, got {value!r}")
    return tuple(number(c, where) for c in value)  # type: ignore[return-value]


def mapping(value: Any, where: str) -> dict[str, Any]:
    """Validate that a value is a mapping; return a copy.

    Raises:
        UserError: It is not a mapping.
    """
    if not isinstance(value, Mapping):
        raise UserError(f"{where} must be a mapping of keys to values, got {value!r}")
    return dict(value)


def check_keys(value: Any, where: str, allowed: tuple[str, ...], optional: tuple[str, ...] = ()) -> None:
    """Check the keys of a mapping.

    Args:
        value: The mapping.
        where: Name of the mapping in error messages.
        allowed: All keys that it may have.
        optional: Those of `allowed` that may be absent.

    Raises:
        UserError: It is not a mapping, a key is not allowed, or a required key is missing.
    """
    value = mapping(value, where)
    for key in value:
        if key not in allowed:
            close = suggest(str(key), allowed) or ";"
            raise UserError(f"unknown key {key!r} in {where}{close} it takes {', '.join(allowed)}")
    for key in allowed:
        if key not in value and key not in optional:
            raise UserError(f"{where} lacks the key {key!r}")


def list_of_mappings(content: Any, where: str) -> list[dict[str, Any]]:
    """Validate a non-empty list of mappings, such as the frames of a recording.

    Raises:
        UserError: It is not such a list.
    """
    if not isinstance(content, list) or not content or not all(isinstance(entry, dict) for entry in content):
        raise UserError(f"{where} must be a non-empty list of mappings of keys to values")
    return content


def require_key(entry: dict[str, Any], key: str, where: str) -> Any:
    """Return the value of a required key.

    Raises:
        UserError: The key is missing.
    """
    if key not in entry:
        raise UserError(f"{where} lacks the key {key!r}")
    return entry[key]


def file_name(value: Any, where: str) -> str:
    r"""Validate a name that becomes the name of a file or folder.

    Raises:
        UserError: The name is not text, is empty, is longer than 120 bytes, begins with a dot, or or contains a control
            character or one of / \ : * ? " < > |.
    """
    if not isinstance(value, str) or not value.strip():
        raise UserError(f"{where} must be text, got {value!r}")
    wrong = any(c in '/\\:*?"<>|' or not c.isprintable() for c in value) or value[0] == "." or value != value.strip()
    try:
        wrong = wrong or len(value.encode()) > 120
    except UnicodeEncodeError:  # half of a surrogate pair
        wrong = True
    if wrong:
        raise UserError(
            f"{where} = {value[:80]!r} cannot name a file: use at most 120 letters, digits, spaces, - and _, and no leading dot"
        )
    return value


def path_inside(folder: Path, relative: Any, where: str, *, kind: str = "folder") -> Path:
    r"""Resolve a relative path from a file; require that it lies inside a folder.

    Args:
        folder: The folder.
        relative: The path in the file; `\` separates folders as `/` does.
        where: Name of the value in error messages.
        kind: What the folder is called in error messages.

    Raises:
        UserError: The path is not text, is absolute, contains `..`, or leaves the folder through a link.
    """
    if not isinstance(relative, str) or not relative or "\0" in relative or len(relative) > 4000:
        raise UserError(f"{where} must be the path of a file, got {str(relative)[:80]!r}")
    windows = PureWindowsPath(relative)  # it splits at both kinds of slashes
    path = folder / PurePosixPath(relative)
    if not path.exists() and "\\" in relative:
        path = folder / PurePosixPath(*windows.parts)
    try:
        stays = path.resolve().is_relative_to(folder.resolve())
    except (OSError, RuntimeError) as error:  # too long a name, or a circle of links
        raise UserError(f"{where} = {relative[:80]!r} is not a path: {error}") from error
    if windows.drive or windows.root or ".." in windows.parts or not stays:
        raise UserError(f"{where} = {relative!r} leaves the {kind} {folder}: give a path inside it")
    return path


def with_prefix(value: float, unit: str) -> str:
    """Format a number with three significant digits and an SI prefix, such as `98.3 kPa`."""
    size = abs(value)
    factor, prefix = next(((f, p) for f, p in ((1e9, "G"), (1e6, "M"), (1e3, "k")) if size >= f), (1.0, ""))
    return f"{value / factor:.3g} {prefix}{unit}"
