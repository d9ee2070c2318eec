"""Unit conversion of columns and options, with pint."""

import re
from functools import lru_cache
from typing import Any

from neuido.errors import UserError
from neuido.physics.runtime.lazy import import_extra
from neuido.physics.runtime.once import cached

_SPELLED = {
    "°c": "degC", "sec": "s", "seconds": "s", "msec": "ms", "n/mm²": "N/mm^2", "n/mm2": "N/mm^2", "mm/mm": "", "-": "", "%": "percent",
    "mpa": "MPa", "kpa": "kPa", "gpa": "GPa", "kn": "kN", "newton": "N", "px": "pixel",
    "meters": "m", "millimeters": "mm", "centimeters": "cm", "metres": "m", "millimetres": "mm", "centimetres": "cm", "inches": "inch",
    "lbs": "lbf", "lb": "lbf", "pounds": "lbf", "kp": "kgf", "kg": "kgf", "°": "deg", "grad": "deg", "µstrain": "microstrain",
    "g": "gram_force",
    "m/m": "", "in/in": "", "cm/cm": "", "secs": "s", "sekunden": "s", "secondes": "s", "segundos": "s", "minuten": "min", "minutes": "min",
    "с": "s", "мм": "mm", "н": "N", "кн": "kN", "па": "Pa", "кпа": "kPa", "мпа": "MPa", "秒": "s", "毫米": "mm", "牛": "N", "千牛": "kN",
}  # fmt: skip


_TOWER = re.compile(r"(\^|\*\*)\s*[+-]?\s*\d{2}|\^.*\^|\*\*.*\*\*|\d{5}")
"""Powers above 9, and powers of powers: numbers without end, in a file that is not trusted."""


@cached
def _registry() -> Any:
    return import_extra("pint", "a unit").UnitRegistry(non_int_type=float)


def conversion_factor(unit: str, to: str, where: str) -> float:
    """Return the factor that converts values in `unit` to the unit `to`.

    Args:
        unit: Unit as written in a file or an option, such as `MPa`; empty for a ratio.
        to: Target unit; empty for a ratio.
        where: Prefix of the error message.

    Raises:
        UserError: `unit` is not a unit, or it has another dimension than `to`.
    """
    found = _ratio(_spelled(unit), to)
    if found is None:
        raise UserError(f"{where}: the unit {unit[:40]!r} cannot be converted to {to or 'a ratio'}")
    return found


def measures(unit: str, to: str) -> bool:
    """Whether a unit is of the kind of `to`, an SI unit; an empty `to` stands for a ratio."""
    return _ratio(_spelled(unit), to) is not None


def ratio(unit: str, other: str) -> float | None:
    """Return how many of `other` a unit is; None where they are of different kinds."""
    return _ratio(_spelled(unit), _spelled(other))


@lru_cache(512)
def _ratio(own: str, to: str) -> float | None:
    """Return the ratio of two units; None where the first is no unit, or one of another kind."""
    if not re.fullmatch(r"[\w\s/*^.µ%·-]{0,30}", own) or _TOWER.search(own):
        return None
    try:
        return float(_registry().Quantity(1.0, own or "dimensionless").to(to or "dimensionless").magnitude)
    except Exception:  # pint raises errors of several kinds
        return None


def parse_quantity(text: str, to: str, option: str) -> float:
    """Convert the text of an option, such as `25.4 mm`, to a number in the unit `to`.

    Raises:
        UserError: The text is not a number with a unit, or the number is not positive.
    """
    found = re.fullmatch(r"\s*([0-9.]+(?:[eE][-+]?[0-9]+)?)\s*([^\s\d.].*)", str(text))
    if found is None or found[1].count(".") > 1:
        raise UserError(f"--{option} = {text!r} must be a number with a unit, for example '25.4 mm'")
    value = float(found[1]) * conversion_factor(found[2].strip(), to, f"--{option}")
    if not value > 0:
        raise UserError(f"--{option} = {text!r} must be above 0")
    return value


def is_unit(text: str) -> bool:
    """Whether a cell contains a unit; an empty cell counts as one."""
    text = text.strip().strip("()[]")
    if not text or _spelled(text) == "":
        return True
    return re.fullmatch(r"[\w/^%µ°²·* -]{1,12}", text) is not None and _names_unit(_spelled(text))


@lru_cache(512)
def _names_unit(spelled: str) -> bool:
    if _TOWER.search(spelled):
        return False
    try:
        return _registry().parse_units(spelled) is not None
    except Exception:  # pint raises errors of several kinds
        return False


def _spelled(unit: str) -> str:
    """Return a unit in pint's spelling."""
    unit = unit.strip().strip("()[]").strip()
    return _SPELLED.get(unit.lower(), re.sub(r"(?<=m)²|(?<=m)2$", "^2", unit))
