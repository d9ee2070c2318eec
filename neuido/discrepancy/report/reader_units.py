"""The units of a page: one for each quantity, chosen by the values on the page."""

import math
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

LENGTHS = ((1e-6, "µm"), (1e-3, "mm"), (1.0, "m"), (1e3, "km"))
PRESSURES = ((1e-3, "mPa"), (1.0, "Pa"), (1e3, "kPa"), (1e6, "MPa"), (1e9, "GPa"))
FAR = {"m": 1e4, "Pa": 1e6}
"""Largest number in front of a unit: a flight below 10 m is in mm, a modulus of steel in MPa."""
LEAST = 0.3
"""Smallest number in front of a unit; for smaller ones a smaller unit is chosen."""
SPOKEN = {"1/s": "per second", "1/m": "per metre", "1": "", "m/s^2": "m/s²", "1/s^2": "per s²", "m/s": "m/s", "rad": "rad"}
WRITTEN = {"1": "–", "m/s^2": "m/s²", "1/s^2": "1/s²", "rad/s^2": "rad/s²", "Pa s": "Pa s"}
DIGITS = 3


class Units:
    """The units of a page.

    Args:
        lengths: Lengths on the page [m].
        pressures: Stresses and moduli on the page [Pa].
    """

    def __init__(self, lengths: Iterable[float] = (), pressures: Iterable[float] = ()) -> None:
        self.length = _chosen(LENGTHS, lengths, FAR["m"], (1e-3, "mm"))
        self.pressure = _chosen(PRESSURES, pressures, FAR["Pa"], (1e3, "kPa"))

    @classmethod
    def of(cls, contents: Sequence[Mapping[str, Any]], *, reach: float = 0.0) -> "Units":
        """Return the units for diagnoses that share a page.

        Args:
            contents: Parts of diagnosis.json, one per body.
            reach: Largest coordinate or length that is drawn [m], where the parts do not contain it.
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
        """Return the factor from an SI unit to the unit of the page, and the name of that unit."""
        (length, metre), (pressure, pascal) = self.length, self.pressure
        own = {"m": (1 / length, metre), "Pa": (1 / pressure, pascal), "1/Pa": (pressure, f"1/{pascal}")}
        return own.get(unit, (1.0, WRITTEN.get(unit, unit)))

    def label(self, unit: str) -> str:
        """Return the name of the page's unit for a table or axis; a dash for dimensionless quantities."""
        return self.scaled(unit)[1]

    def said(self, value: float | None, unit: str, *, digits: int = DIGITS) -> str:
        """Return a value with its unit for a sentence, such as "3.00 per second"."""
        if value is None or not math.isfinite(value):
            return "infinite"
        factor, label = self.scaled(unit)
        spoken = SPOKEN.get(unit, label)
        return f"{rounded(value * factor, digits)}{f' {spoken}' if spoken else ''}"

    def figures(self, value: float, interval: Sequence[float | None], unit: str) -> tuple[str, str]:
        """Return a value and its interval in the unit of the page, with as many digits as the interval justifies."""
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
    """Return the largest length in the plots of motions [m]: extent of a body's motion, or coordinate of a track; 0 for other data.

    Args:
        motion: Arrays of each recording, as in `predicted`.
        unit: Unit of the errors.
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
    """Return the abscissa of each value of a recording, and its label: stretch, shear, time, or the order of the rows.

    Args:
        arrays: Arrays of the recording, as in `predicted`.
        told: Entry of the recording in diagnosis.json.
        units: Units of the page.
    """
    if "axis" in arrays and told.get("axis"):
        factor, unit = units.scaled(told["axis"]["unit"])
        return factor * arrays["axis"], told["axis"]["label"] + (f" [{unit}]" if told["axis"]["unit"] != "1" else "")
    return arrays["times"], "time [s]" if told.get("timed") else "time [s], or order of the rows"


def rounded(value: float, digits: int = DIGITS) -> str:
    """Return a number with some significant digits, with an exponent only if it is very large or small."""
    if value == 0 or not math.isfinite(value):
        return f"{value:g}"
    return fixed(value, digits - 1 - math.floor(math.log10(abs(value))))


def fixed(value: float, decimals: int) -> str:
    """Return a number with some decimals; -1 rounds to tens. From a million, and below 1e-4, it has an exponent."""
    shown = round(value, decimals)
    if shown and not 1e-4 <= abs(shown) < 1e6:
        size = math.floor(math.log10(abs(shown)))
        return f"{shown / 10.0**size:.{max(decimals + size, 0)}f}e{size}".replace("-", "−")
    return f"{shown:.{max(decimals, 0)}f}".replace("-", "−")


def _chosen(units: Sequence[tuple[float, str]], sizes: Iterable[float], far: float, usual: tuple[float, str]) -> tuple[float, str]:
    """Return the largest unit in which the smallest size is at least `LEAST`, of those in which the largest size is below `far`.

    `usual` is the unit where there are no sizes.
    """
    own = sorted(abs(v) for v in sizes if v and math.isfinite(v))
    if not own:
        return usual
    able = [u for u in units if own[-1] < far * u[0]] or [units[-1]]
    return next((u for u in reversed(able) if own[0] >= LEAST * u[0]), able[0])
