"""Dates and times of day in the cells of text tables."""

from __future__ import annotations

import re
from collections.abc import Sequence
from datetime import date
from fractions import Fraction

import numpy as np

from shakercal._common.arrays import FloatArray

_DATE = r"(?:(\d{4})[-/.](\d{1,2})[-/.](\d{1,2})|(\d{1,2})([./-])(\d{1,2}|[A-Za-z]{3})[./-](\d{4}|\d{2}))"
_CLOCK = r"(\d{1,2}):(\d{2})(?::(\d{2}))?(?:[.,:](\d{1,9}))?\s*([AaPp])?\.?[Mm]?\.?"
_STAMP = re.compile(rf"(?:{_DATE}[T ,]?\s*)?{_CLOCK}\s*(?:Z|UTC|[+-]\d\d:?\d\d)?")
_ONLY_DATE = re.compile(_DATE)
_MONTHS = ["jan", "feb", "mar", "apr", "may", "jun", "jul", "aug", "sep", "oct", "nov", "dec"]
DAY_S = 86400


def is_stamp(cell: str) -> bool:
    """Return whether a cell is a time of day, a date, or both."""
    text = cell.strip().strip('"')
    return _STAMP.fullmatch(text) is not None or _ONLY_DATE.fullmatch(text) is not None


def is_date(cell: str) -> bool:
    """Return whether a cell is a date without a time of day."""
    return _ONLY_DATE.fullmatch(cell.strip().strip('"')) is not None


def seconds_of_stamps(cells: Sequence[str]) -> tuple[FloatArray, float, float]:
    """Return times (S,) from the first stamp, that stamp, and the last printed digit.

    All are in s; the first stamp counts from 1970, or from midnight.

    Times of day without a date continue after midnight. `ValueError` for a cell that is no stamp.
    """
    days: dict[str, int] = {}
    ticks, digits = np.empty(len(cells), dtype=np.int64), 0
    for index, cell in enumerate(cells):
        ticks[index], decimals = _nanoseconds(cell.strip().strip('"'), days)
        digits = max(digits, decimals)
    if not days:
        day = DAY_S * 10**9
        ticks += day * np.concatenate([[0], np.cumsum(np.diff(ticks) < -day // 2)])
    return (ticks - ticks[0]) / 1e9, float(Fraction(int(ticks[0]), 10**9)), 10.0**-digits


def _nanoseconds(cell: str, days: dict[str, int]) -> tuple[int, int]:
    """Return nanoseconds since 1970 or midnight, and the decimals of the seconds."""
    found = _STAMP.fullmatch(cell)
    if found is None:
        raise ValueError(f"expected a time of day, found {cell[:40]!r}")
    *parts, hours, minutes, seconds, fraction, half = found.groups()
    if seconds is None and fraction is not None:  # minutes and seconds, as spreadsheets show short times
        hours, minutes, seconds = "0", hours, minutes
    hour = int(hours) % 12 + (12 if half.lower() == "p" else 0) if half else int(hours)
    total = 60 * (60 * hour + int(minutes)) + int(seconds or 0)
    text = cell[: found.start(8)] if any(parts) else ""
    if text:
        if text not in days:
            days[text] = _days(parts)
        total += DAY_S * days[text]
    return total * 10**9 + (int(fraction.ljust(9, "0")) if fraction else 0), len(fraction or "")


def _days(parts: Sequence[str | None]) -> int:
    """Return the days from 1970 to a date.

    The month is second, unless slashes separate the parts.
    """
    year, month, day, first, separator, second, short = parts
    if year is None:
        named = (second or "").lower() in _MONTHS
        middle = str(_MONTHS.index((second or "").lower()) + 1) if named else second
        american = separator == "/" and not named and int(first or 0) <= 12
        day, month = (middle, first) if american else (first, middle)
        year = short if len(short or "") == 4 else f"{19 if int(short or 0) >= 70 else 20}{short}"
    return date(int(year or 0), int(month or 0), int(day or 0)).toordinal() - date(1970, 1, 1).toordinal()
