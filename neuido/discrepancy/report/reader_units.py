"""The units in which a person reads a diagnosis: one for each quantity of a page, chosen by the sizes that stand on it."""

import math
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

LENGTHS = ((1e-6, "µm"), (1e-3, "mm"), (1.0, "m"), (1e3, "km"))
PRESSURES = ((1e-3, "mPa"), (1.0, "Pa"), (1e3, "kPa"), (1e6, "MPa"), (1e9, "GPa"))
FAR = {"m": 1e4, "Pa": 1e6}
"""Largest figure that stands in a unit: a flight of less than 10 m in mm, a modulus of steel in MPa."""
LEAST = 0.3
"""Smallest figure for whose sake no smaller unit is taken."""
SPOKEN = {"1/s": "per second", "1/m": "per metre", "1": "", "m/s^2": "m/s²", "1/s^2": "per s²", "m/s": "m/s", "rad": "rad"}
WRITTEN = {"1": "–", "m/s^2": "m/s²", "1/s^2": "1/s²", "rad/s^2": "rad/s²", "Pa s": "Pa s"}
DIGITS = 3


class Units:
    """The units of a page.

    Args:
        lengths: Sizes of lengths on the page [m].
        pressures: Sizes of stresses and moduli [Pa].
    """

    def __init__(self, lengths: Iterable[float] = (), pressures: Iterable[float] = ()) -> None:
        self.length = _chosen(LENGTHS, lengths, FAR["m"], (1e-3, "mm"))
        self.pressure = _chosen(PRESSURES, pressures, FAR["Pa"], (1e3, "kPa"))

    @classmethod
    def of(cls, contents: Sequence[Mapping[str, Any]], *, reach: float = 0.0) -> "Units":
        """Return the units for diagnoses that share a page.

        Args:
            contents: Parts of diagnosis.json, one a body.
            reach: Largest coordinate or length that is drawn [m], where the parts do not tell it.
        """
        found: dict[str, list[float]] = {"m": [reach, *(c.get("reach", 0.0) for c in contents)], "Pa": []}
        for c in contents:
            error = c["error"]
            found.setdefault(error["unit"], []).extend(v for v in (error["noise_floor"], error["discretisation_floor"]) if v)
            for when in ("before", "after"):
                found.setdefault(error["unit"], []).extend(v for v in (error[when].get("fit"), error[when].get("held_out")) if v)
                figures = c["declared" if when == "before" else "after"].values()
                for p in (*figures, *(p for e in c["effects"] for p in e["parameters"].values())):
                    if isinstance(p["value"], int | float):
                        found.setdefault(p["unit"], []).append(abs(p["value"]))
        return cls(found["m"], found["Pa"])

    def scaled(self, unit: str) -> tuple[float, str]:
        """Return the factor from an SI unit to that of the page, and its name."""
        (length, metre), (pressure, pascal) = self.length, self.pressure
        own = {"m": (1 / length, metre), "Pa": (1 / pressure, pascal), "1/Pa": (pressure, f"1/{pascal}")}
        return own.get(unit, (1.0, WRITTEN.get(unit, unit)))

    def label(self, unit: str) -> str:
        """Return a unit as a table's or an axis' label has it; a dash where there is none."""
        return self.scaled(unit)[1]

    def said(self, value: float | None, unit: str, *, digits: int = DIGITS) -> str:
        """Return a figure with its unit, in words where the unit has any."""
        if value is None or not math.isfinite(value):
            return "infinite"
        factor, label = self.scaled(unit)
        spoken = SPOKEN.get(unit, label)
        return f"{rounded(value * factor, digits)}{f' {spoken}' if spoken else ''}"

    def figures(self, value: float, interval: Sequence[float | None], unit: str) -> tuple[str, str]:
        """Return a figure and its interval in the unit of the page, as many digits as the interval bears."""
        factor = self.scaled(unit)[0]
        low, high = (None if end is None or not math.isfinite(end) else end * factor for end in interval)
        if low is None or high is None or not high > low:
            shown = rounded(value * factor)
            if low is not None and low == high:
                return shown, ""
            return shown, f"{'infinite' if low is None else rounded(low)} to {'infinite' if high is None else rounded(high)}"
        half = 0.5 * (high - low)
        first = math.floor(math.log10(half))
        decimals = -first + (half / 10.0**first < 2)
        shown, *ends = (fixed(v, decimals) for v in (value * factor, low, high))
        return shown, f"{ends[0]} to {ends[1]}" if low < 0 else "–".join(ends)


def reach(motion: Mapping[str, Mapping[str, Any]], unit: str) -> float:
    """Return the largest length that plots of motions show [m]: an extent in space, or a coordinate of a track; 0 of other data.

    Args:
        motion: Arrays of each recording.
        unit: Of the errors.
    """
    import numpy as np

    out = 0.0
    for arrays in motion.values():
        x = np.asarray(arrays["measured"]) if "measured" in arrays else np.empty(0)
        if "positions" in arrays:
            x = x.reshape(-1, 3)
            x = x[np.isfinite(x).all(axis=1)]
            out = max(out, float(np.ptp(x, axis=0).max())) if len(x) else out
        elif unit == "m" and np.isfinite(x).any():
            out = max(out, float(np.nanmax(np.abs(x))))
    return out


def axis_of(arrays: Mapping[str, Any], told: Mapping[str, Any], units: Units) -> tuple[Any, str]:
    """Return the physical abscissa of each datum and its label; the time, or the order of the rows, where a file tells no more.

    Args:
        arrays: Of a recording in `predicted`.
        told: Its entry of `recordings` in diagnosis.json.
        units: Of the page.
    """
    if "axis" in arrays and told.get("axis"):
        factor, unit = units.scaled(told["axis"]["unit"])
        return factor * arrays["axis"], told["axis"]["label"] + (f" [{unit}]" if told["axis"]["unit"] != "1" else "")
    return arrays["times"], "time [s]" if told.get("timed") else "time [s], or order of the rows"


def rounded(value: float, digits: int = DIGITS) -> str:
    """Return a figure with some significant digits, without an exponent where it can be read without one."""
    if value == 0 or not math.isfinite(value):
        return f"{value:g}"
    return fixed(value, digits - 1 - math.floor(math.log10(abs(value))))


def fixed(value: float, decimals: int) -> str:
    """Return a figure with some decimals; fewer than none rounds to tens. Beyond a million, or below a ten-thousandth, with an exponent."""
    shown = round(value, decimals)
    if shown and not 1e-4 <= abs(shown) < 1e6:
        size = math.floor(math.log10(abs(shown)))
        return f"{shown / 10.0**size:.{max(decimals + size, 0)}f}e{size}".replace("-", "−")
    return f"{shown:.{max(decimals, 0)}f}".replace("-", "−")


def _chosen(units: Sequence[tuple[float, str]], sizes: Iterable[float], far: float, usual: tuple[float, str]) -> tuple[float, str]:
    """The largest unit in which the smallest size reads well, if the largest is no number of too many digits in it."""
    own = sorted(abs(v) for v in sizes if v and math.isfinite(v))
    if not own:
        return usual
    able = [u for u in units if own[-1] < far * u[0]] or [units[-1]]
    return next((u for u in reversed(able) if own[0] >= LEAST * u[0]), able[0])
