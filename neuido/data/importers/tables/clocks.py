"""Times that are written as clocks: times of day, minutes and seconds, dates, and timecodes that end in frames."""

import math
import re
from collections.abc import Sequence
from datetime import date

from neuido.data.files.delimited import CLOCK
from neuido.errors import UserError

DAY = 86400.0
"""[s]"""
NEW_YEAR = date(2000, 1, 1).toordinal()
"""Day from which dates are counted, so that seconds keep a tenth of a microsecond."""
DROPPED = 2
"""Frame numbers that drop-frame timecode (SMPTE ST 12-1) leaves out each minute but every tenth, so that 30 a second count 29.97."""
HUNDREDTHS = 61
"""Most values that a field of frames has: that of 60 frames a second runs from 0 to 59."""


def is_clock(cell: str) -> bool:
    """Whether a cell is a time of day or of a film, with or without a date."""
    return CLOCK.fullmatch(cell) is not None


def clock_seconds(cell: str) -> float:
    """Return a clock in seconds, from midnight or, with a date, from a fixed day; a last field of two digits counts as hundredths.

    Without hours, `12:30.5` is minutes and seconds; a date or `AM` makes two fields hours and minutes. NaN for anything else.
    """
    found = CLOCK.fullmatch(cell)
    if found is None:
        return math.nan
    days = _day(found["date"]) if found["date"] else 0
    fields = [float(found[key].replace(",", ".")) for key in ("first", "second", "third") if found[key]]
    if days is None or (len(fields) == 2 and (found["date"] or found["half"]) and "." in found["second"]):
        return math.nan
    if len(fields) == 2:
        fields = [*fields, 0.0] if found["date"] or found["half"] else [0.0, *fields]
    hours, minutes, seconds = fields
    if found["half"]:
        hours = hours % 12 + 12 * (found["half"].lower() == "p")
    return DAY * days + 3600 * hours + 60 * minutes + seconds + 0.01 * float(found["frames"] or 0)


def _day(text: str) -> int | None:
    """Return the number of a day since the year 2000; `3/5/2024` is the fifth of March, and the third of May is `3.5.2024`."""
    parts = [int(part) for part in re.split(r"[-/.]", text)]
    if parts[0] > 31:
        year, month, day = parts
    elif "/" in text and parts[0] <= 12:
        month, day, year = parts
    else:
        day, month, year = parts
    try:
        return date(year, month, day).toordinal() - NEW_YEAR
    except ValueError:
        return None


def over_midnight(seconds: Sequence[float], cells: Sequence[str]) -> list[float]:
    """Return times of day without dates as times that go on after midnight."""
    out, days, last = [], 0, math.nan
    for value, cell in zip(seconds, cells):
        found = CLOCK.fullmatch(cell)
        if found is not None and not found["date"]:
            days += value < last - DAY / 2
            last = value
            value += DAY * days
        out.append(value)
    return out


def timecode_seconds(cells: Sequence[str], frame_rate: float | None, name: str) -> list[float] | None:
    """Convert timecodes, hours:minutes:seconds:frames, to seconds; NaN for cells that are none.

    Args:
        cells: Cells of a column.
        frame_rate: Frames a second [1/s], where it is known.
        name: Name of the file in messages.

    Returns:
        None where the column has no timecodes, or its last field counts hundredths of a second.

    Raises:
        UserError: The last field counts frames, and their rate is unknown.
    """
    found = [CLOCK.fullmatch(cell) for cell in cells]
    fields = [int(each["frames"]) for each in found if each is not None and each["frames"]]
    dropped = any(each is not None and each["mark"] == ";" for each in found)
    if not fields or (max(fields) >= HUNDREDTHS and not dropped):
        return None
    if frame_rate is None:
        if not dropped and (len(set(fields)) < 3 or not _counts(fields)):
            return None
        raise UserError(f"{name} has times that end in frames (up to {max(fields)}): give --frame_rate (frames per second)")
    nominal = round(frame_rate)
    if max(fields) >= nominal:
        return None if not dropped else [math.nan] * len(cells)
    drops = DROPPED * round(nominal / 30) if dropped else 0
    out = []
    for each in found:
        if each is None or not each["third"]:
            out.append(math.nan)
            continue
        minutes = 60 * int(each["first"]) + int(each["second"])
        count = nominal * (60 * minutes + int(float(each["third"].replace(",", ".")))) + int(each["frames"] or 0)
        out.append((count - drops * (minutes - minutes // 10)) / frame_rate)
    return out


def _counts(fields: Sequence[int]) -> bool:
    """Whether a field goes up by one from row to row, as frames of a film do, and hundredths of a second do not."""
    steps = [b - a for a, b in zip(fields, fields[1:])]
    return sum(step == 1 for step in steps) > len(steps) / 2
