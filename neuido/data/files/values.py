"""Checks of values that come from files: numbers, vectors, mappings, lists, and paths that must stay in a folder."""

import math
from collections.abc import Mapping
from pathlib import Path, PurePosixPath, PureWindowsPath
from typing import Any

from neuido.errors import UserError, suggest
from neuido.types import Vector


def number(value: Any, where: str, *, least: float = -math.inf, above: float = -math.inf, infinite: bool = False) -> float:
    """Return a number as a float.

    Args:
        value: What the file holds.
        where: What it is called in an error.
        least: The smallest value that is allowed.
        above: A bound that the value must exceed.
        infinite: Whether infinity is allowed.

    Raises:
        UserError: Text, a truth value, a NaN, or a number outside its range.
    """
    try:
        wrong = isinstance(value, bool) or not isinstance(value, int | float) or math.isnan(value) or (math.isinf(value) and not infinite)
    except OverflowError as error:
        raise UserError(f"{where} must be a finite number, got one that is too large") from error
    if wrong:
        raise UserError(f"{where} must be a {'' if infinite else 'finite '}number, got {value!r}")
    if not (value >= least and value > above):
        raise UserError(f"{where} must be {f'above {above:g}' if above > -math.inf else f'at least {least:g}'}, got {value!r}")
    return float(value)


def vector(value: Any, where: str) -> Vector:
    """Return a list of three finite numbers as a tuple."""
    if not isinstance(value, list) or len(value) != 3:
        raise UserError(f"{where} must be three numbers, got {value!r}")
    return tuple(number(c, where) for c in value)  # type: ignore[return-value]


def mapping(value: Any, where: str) -> dict[str, Any]:
    """Return a copy of a mapping; anything else is refused."""
    if not isinstance(value, Mapping):
        raise UserError(f"{where} must be a mapping of keys to values, got {value!r}")
    return dict(value)


def check_keys(value: Any, where: str, allowed: tuple[str, ...], optional: tuple[str, ...] = ()) -> None:
    """Refuse unknown keys of a mapping, and require those that are not optional."""
    value = mapping(value, where)
    for key in value:
        if key not in allowed:
            close = suggest(str(key), allowed) or ";"
            raise UserError(f"unknown key {key!r} in {where}{close} it takes {', '.join(allowed)}")
    for key in allowed:
        if key not in value and key not in optional:
            raise UserError(f"{where} lacks the key {key!r}")


def list_of_mappings(content: Any, where: str) -> list[dict[str, Any]]:
    """Return a list of mappings that is not empty."""
    if not isinstance(content, list) or not content or not all(isinstance(entry, dict) for entry in content):
        raise UserError(f"{where} must be a list of frames, each a mapping of keys to values, and not empty")
    return content


def require_key(entry: dict[str, Any], key: str, where: str) -> Any:
    """Return the value of a key that must be there."""
    if key not in entry:
        raise UserError(f"{where} lacks the key {key!r}")
    return entry[key]


def file_name(value: Any, where: str) -> str:
    """Return a name that becomes the name of a file or folder: one part of a path, so that it stays where it is put.

    Raises:
        UserError: Not text, empty, longer than 120 bytes, hidden, or with a slash, a colon or a character that does not print.
    """
    if not isinstance(value, str) or not value.strip():
        raise UserError(f"{where} must be text, got {value!r}")
    wrong = any(c in '/\\:*?"<>|' or not c.isprintable() for c in value) or value[0] == "." or value != value.strip()
    try:
        wrong = wrong or len(value.encode()) > 120
    except UnicodeEncodeError:  # half of a character
        wrong = True
    if wrong:
        raise UserError(
            f"{where} = {value[:80]!r} cannot name a file: use letters, digits, spaces, - and _, at most 120 bytes, and no dot in front"
        )
    return value


def path_inside(folder: Path, relative: Any, where: str, *, kind: str = "folder") -> Path:
    r"""Return the path that a file names, which must stay in the folder; `\` separates folders as `/` does.

    Raises:
        UserError: Not text, absolute, with a `..` in it, or outside the folder by way of a link.
    """
    if not isinstance(relative, str) or not relative or "\0" in relative or len(relative) > 4000:
        raise UserError(f"{where} must be the path of a file, got {str(relative)[:80]!r}")
    windows = PureWindowsPath(relative)  # it knows both kinds of slashes
    path = folder / PurePosixPath(relative)
    if not path.exists() and "\\" in relative:
        path = folder / PurePosixPath(*windows.parts)
    try:
        stays = path.resolve().is_relative_to(folder.resolve())
    except (OSError, RuntimeError) as error:  # a name that is too long, a circle of links
        raise UserError(f"{where} = {relative[:80]!r} is no path: {error}") from error
    if windows.drive or windows.root or ".." in windows.parts or not stays:
        raise UserError(f"{where} = {relative!r} leaves the {kind} {folder}")
    return path
