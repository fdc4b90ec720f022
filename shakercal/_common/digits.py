"""Printed numbers: U with two digits, the value to its place, powers of ten, units."""

from __future__ import annotations

import math
import re
from collections.abc import Sequence
from itertools import pairwise
from typing import NamedTuple

DASH, MINUS = "–", "\N{MINUS SIGN}"
SMALLEST_PLAIN, LARGEST_PLAIN = 1e-3, 1e6
"""Sizes from the first and below the second are printed without a power of ten (`figures.js` has the same two)."""
SUPERSCRIPT = str.maketrans("-0123456789", "⁻⁰¹²³⁴⁵⁶⁷⁸⁹")
PLAIN_DIGITS = {ord(raised): plain for raised, plain in zip("⁻⁰¹²³⁴⁵⁶⁷⁸⁹", "-0123456789", strict=True)}
MOST_DECIMALS = 12
"""Decimals of a tick at most."""
POWER = re.compile(r"(?<=\d)e([+-]?)0*(\d+)")
"""Power of ten of a number that Python formatted."""


def exponent_of(size: float) -> int:
    """Return the power of ten for a number of this size, 0 for none."""
    size = abs(size)
    plain = not math.isfinite(size) or size == 0.0 or SMALLEST_PLAIN <= size < LARGEST_PLAIN
    return 0 if plain else math.floor(math.log10(size))


def power_text(exponent: int) -> str:
    """Return a power of ten in plain characters: `10⁻⁷`."""
    return "10" + str(exponent).translate(SUPERSCRIPT)


def typeset(unit: str) -> str:
    """Return a unit in typographic form: `kg.m^2` becomes `kg·m²`."""
    return re.sub(r"(?<=[a-z)])\.(?=[a-z(])", "·", unit, flags=re.IGNORECASE).replace("^2", "²")


def times_ten(exponent: int, unit: str = "") -> str:
    """Return a power of ten and a unit, as a head names them: `10⁻⁷ V/N`."""
    return " ".join(filter(None, (power_text(exponent) if exponent else "", typeset(unit))))


def python_typeset(text: str) -> str:
    """Return a number in typographic form: `-2e-07` becomes `−2 × 10⁻⁷`."""
    text = re.sub(r"^-(?=[\d.])", MINUS, text)
    return POWER.sub(lambda power: f" × {power_text(int(power[1] + power[2]))}", text)


def python_number(text: str) -> float:
    """Return the number that a text of this module states, without its uncertainty."""
    mantissa, _, power = text.partition(" × 10")
    return float(f"{mantissa}e{power.translate(PLAIN_DIGITS) or 0}".replace(MINUS, "-"))


# Values with their expanded uncertainty.


class RoundedValue(NamedTuple):
    """A value and its expanded uncertainty as decimal texts, both times 10^`exponent`."""

    value: str
    expanded: str
    exponent: int

    @property
    def text(self) -> str:
        """Value, uncertainty and power: `(2.0012 ± 0.0013) × 10⁻⁷`, `2.001 ± 0.013`."""
        return self.with_unit("")

    def with_unit(self, unit: str) -> str:
        """Return the text with a unit: `(2.0012 ± 0.0013) V/N`."""
        power, unit = (f" × {power_text(self.exponent)}" if self.exponent else ""), typeset(unit)
        body = self.scaled if self.expanded == DASH or not (power or unit) else f"({self.scaled})"
        return f"{body}{power}{'' if unit in ('', '°') else ' '}{unit}"

    @property
    def scaled(self) -> str:
        """Value and uncertainty without the power, which a head names."""
        return self.value if self.expanded == DASH else f"{self.value} ± {self.expanded}"


def round_to_uncertainty(value: float, expanded: float, exponent: int | None = None) -> RoundedValue:
    """Return a value rounded to two significant digits of its expanded uncertainty (GUM 7.2.6).

    `exponent`: power of ten to remove, by default that of the larger of the two (`exponent_of`). Without a finite
    uncertainty the value has five significant digits and the uncertainty is a dash.
    """
    if not math.isfinite(value):
        return RoundedValue(DASH, DASH, 0)
    usable = math.isfinite(expanded) and expanded > 0.0
    power = exponent_of(max(abs(value), expanded if usable else 0.0)) if exponent is None else exponent
    texts = [f"{value * 10.0**-power:.5g}", DASH]
    if usable:
        # A negative number of decimal places rounds to tens or hundreds.
        decimals = 1 - int(f"{expanded * 10.0**-power:.1e}".partition("e")[2])
        texts = [f"{round(x * 10.0**-power, decimals):.{max(decimals, 0)}f}" for x in (value, expanded)]
    signed = texts[0].lstrip("-") if not texts[0].strip("-0.") else python_typeset(texts[0])
    return RoundedValue(signed, texts[1], power)


def quantity_text(value: float, expanded: float, unit: str = "") -> str:
    """Return value with U, power of ten and unit: `(2.0012 ± 0.0013) × 10⁻⁷ V/N`."""
    return round_to_uncertainty(value, expanded).with_unit(unit)


def scaled_text(value: float, expanded: float, exponent: int = 0) -> str:
    """Return value with U in units of a power of ten, which the head names."""
    return round_to_uncertainty(value, expanded, exponent).scaled


# Numbers without an uncertainty.


def number_text(value: float | None, digits: int = 3, unit: str = "") -> str:
    """Return a number of some significant digits, with a power of ten if needed."""
    if value is None or not math.isfinite(value):
        return DASH
    value = float(f"{value:.{max(digits, 1) - 1}e}")
    exponent = exponent_of(value)
    text = f"{value / 10.0**exponent:.{digits}g}" if exponent else f"{value:.{max(digits, 6)}g}"
    return RoundedValue(python_typeset(text), DASH, exponent).with_unit(unit)


def signed_text(value: float, form: str = ".2f") -> str:
    """Return a number of a given form with typographic signs, a dash for NaN."""
    text = format(value + 0.0, form) if math.isfinite(value) else DASH
    return text.removeprefix("-") if not text.strip("-0.") else python_typeset(text)


def small(value: float) -> str:
    """Return two significant digits of an uncertainty, or a bound if it is very small."""
    return f"{value:#.2g}".removesuffix(".") if value >= SMALLEST_PLAIN else "< 0.001"


# Ticks of an axis.


def tick_texts(values: Sequence[float]) -> list[str]:
    """Return texts of ticks with as many decimals as are needed to distinguish them."""
    ordered = sorted(values)
    steps = [after - before for before, after in pairwise(ordered)]
    spread = min(steps) if steps else max(map(abs, ordered), default=1.0)
    needed = (d for d in range(MOST_DECIMALS) if all(abs(round(v, d) - v) <= 1e-3 * spread for v in ordered))
    decimals = next(needed, MOST_DECIMALS - 1)
    return [signed_text(round(value, decimals), f".{decimals}f") for value in values]
