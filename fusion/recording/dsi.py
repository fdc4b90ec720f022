r"""Units as certificates write them (D-SI, `\milli\volt\newton\tothe{-1}`) and as people do (`mV/N`).

Names after Hutzschenreuter et al. 2019, SmartCom Digital System of Units guide, and the SI brochure.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from math import pi

Powers = Sequence[tuple[str, int]]
DECIMALS = {"deca": 1, "hecto": 2, "kilo": 3, "mega": 6, "giga": 9, "tera": 12, "peta": 15}
DECIMALS |= {"deci": -1, "centi": -2, "milli": -3, "micro": -6, "nano": -9, "pico": -12, "femto": -15}
PREFIXES = {"": "", "k": r"\kilo", "m": r"\milli", "u": r"\micro", "\u00b5": r"\micro", "\u03bc": r"\micro"}
PREFIXES |= {"n": r"\nano", "p": r"\pico", "M": r"\mega", "h": r"\hecto", "c": r"\centi", "G": r"\giga"}
SYMBOLS = {"V": r"\volt", "A": r"\ampere", "C": r"\coulomb", "N": r"\newton", "m": r"\metre", "s": r"\second"}
SYMBOLS |= {"Hz": r"\hertz", "Ohm": r"\ohm", "\u03a9": r"\ohm", "F": r"\farad", "W": r"\watt", "Pa": r"\pascal"}
SYMBOLS |= {"g": r"\gram", "K": r"\kelvin", "rad": r"\radian", "J": r"\joule"}
BASE = ("m", "kg", "s", "A", "K")
Dimension = tuple[int, int, int, int, int]
NONE: Dimension = (0, 0, 0, 0, 0)
UNITS: Mapping[str, tuple[float, Dimension]] = {
    "one": (1.0, NONE),
    "percent": (1e-2, NONE),
    "ppm": (1e-6, NONE),
    "radian": (1.0, NONE),
    "degree": (pi / 180.0, NONE),
    "arcminute": (pi / 10_800.0, NONE),
    "arcsecond": (pi / 648_000.0, NONE),
    "metre": (1.0, (1, 0, 0, 0, 0)),
    "gram": (1e-3, (0, 1, 0, 0, 0)),
    "kilogram": (1.0, (0, 1, 0, 0, 0)),
    "tonne": (1e3, (0, 1, 0, 0, 0)),
    "second": (1.0, (0, 0, 1, 0, 0)),
    "minute": (60.0, (0, 0, 1, 0, 0)),
    "hour": (3600.0, (0, 0, 1, 0, 0)),
    "day": (86_400.0, (0, 0, 1, 0, 0)),
    "ampere": (1.0, (0, 0, 0, 1, 0)),
    "kelvin": (1.0, (0, 0, 0, 0, 1)),
    "degreecelsius": (1.0, (0, 0, 0, 0, 1)),
    "hertz": (1.0, (0, 0, -1, 0, 0)),
    "newton": (1.0, (1, 1, -2, 0, 0)),
    "pascal": (1.0, (-1, 1, -2, 0, 0)),
    "bar": (1e5, (-1, 1, -2, 0, 0)),
    "joule": (1.0, (2, 1, -2, 0, 0)),
    "watt": (1.0, (2, 1, -3, 0, 0)),
    "coulomb": (1.0, (0, 0, 1, 1, 0)),
    "volt": (1.0, (2, 1, -3, -1, 0)),
    "farad": (1.0, (-2, -1, 4, 2, 0)),
    "ohm": (1.0, (2, 1, -3, -2, 0)),
    "siemens": (1.0, (-2, -1, 3, 2, 0)),
    "henry": (1.0, (2, 1, -2, -2, 0)),
    "tesla": (1.0, (0, 1, -2, -1, 0)),
    "litre": (1e-3, (3, 0, 0, 0, 0)),
}
CELSIUS_AT_0_K = -273.15
MOST_PARTS = 12
TOKEN = re.compile(r"\\([A-Za-z]+)(?:\{(-?\d(?:\.0)?)\})?")


@dataclass(frozen=True)
class Unit:
    """A unit: `factor` to the coherent SI unit of its `dimension` (exponents of m, kg, s, A, K), and its text.

    `celsius`: a temperature on the Celsius scale, of which a value is `CELSIUS_AT_0_K` at 0 K.
    """

    factor: float
    dimension: Dimension
    text: str
    celsius: bool = False


def dsi_unit(unit: str, further: Powers = (), power: int = 1) -> str:
    r"""Return a unit such as `mV/V`, times further units with their exponents, to a power, as the D-SI writes it.

    `ValueError` where it is not made of volts, amperes, coulombs, newtons, metres, ohms and their like.

    >>> from fusion.recording.dsi import dsi_unit
    >>> print(dsi_unit("mV/V", [(r"\newton", -1)]))
    \milli\volt\volt\tothe{-1}\newton\tothe{-1}
    """
    parts = [(name, power * exponent) for name, exponent in (*_powers(unit), *further)]
    return "".join(name if exponent == 1 else rf"{name}\tothe{{{exponent}}}" for name, exponent in parts) or r"\one"


def _powers(unit: str) -> Iterator[tuple[str, int]]:
    """Yield the units of a text with their exponents, in their order; a stroke divides by all up to the next one."""
    none = f"expected a unit made of V, A, C, N, m and their like, such as mV/V, found {unit}"
    outer, sign, last = [1], 1, "/"  # of the brackets that are open, and behind a stroke within the last one
    for token in re.findall(r"[()/]|[^()/\u00b7.*\s]+", unit):
        if token == "(":
            outer, sign = [*outer, outer[-1] * sign], 1
        elif token == ")" and len(outer) > 1:
            sign = outer.pop() * outer[-1]
        elif token == "/" and last not in ("/", "("):
            sign = -1
        elif token != "1":
            name, raised, exponent = token.replace("\u00b2", "^2").replace("\u00b3", "^3").partition("^")
            ends = [own for own in SYMBOLS if name.endswith(own) and name[: -len(own)] in PREFIXES]
            if not ends or (raised and not re.fullmatch(r"-?\d", exponent)):
                raise ValueError(none)
            known = max(ends, key=len)
            yield PREFIXES[name[: -len(known)]] + SYMBOLS[known], outer[-1] * sign * int(exponent or 1)
        last = token
    if len(outer) > 1 or last in ("/", "("):
        raise ValueError(none)


@cache
def parse_unit(text: str) -> Unit:
    r"""Read a unit of the D-SI, or a plain one such as `(mV/V)/N`; `ValueError` for what is none.

    >>> from fusion.recording.dsi import parse_unit
    >>> parse_unit(r"\milli\volt\per\newton") == parse_unit("mV/N")
    False
    >>> parse_unit(r"\milli\volt\per\newton").factor, parse_unit("mV/N").factor
    (0.001, 0.001)
    """
    own = text.strip()
    if not own.startswith("\\"):
        own = dsi_unit(own)
    own = re.sub(r"\^\{?(-?\d+)\}?", r"\\tothe{\1}", own)
    factor, dimension, place = 1.0, list(NONE), 0
    parts: list[tuple[str, int, int]] = []  # unit, decimal prefix, exponent
    decimals, below = 0, False
    for found in TOKEN.finditer(own):
        name, exponent = found[1], found[2]
        if found.start() != place:
            break
        place = found.end()
        if name == "tothe" and exponent and parts and not decimals:
            last, size, power = parts[-1]
            parts[-1] = last, size, power * int(float(exponent))
        elif name == "per" and not below and not decimals:
            below = True
        elif name in DECIMALS and not decimals:
            decimals = DECIMALS[name]
        elif name.lower() in UNITS:
            parts.append((name.lower(), decimals, -1 if below else 1))
            decimals, below = 0, False
        else:
            raise ValueError(rf"expected a unit of the D-SI such as \volt\per\newton, found {text[:80]}")
    if place != len(own) or not 0 < len(parts) <= MOST_PARTS or decimals or below:
        raise ValueError(rf"expected a unit of the D-SI such as \volt\per\newton, found {text[:80]}")
    for name, decimal, power in parts:
        of_unit, own_dimension = UNITS[name]
        factor *= (of_unit * 10.0**decimal) ** power
        dimension = [d + power * o for d, o in zip(dimension, own_dimension, strict=True)]
    celsius = parts == [("degreecelsius", 0, 1)]
    metre, kilogram, second, ampere, kelvin = dimension
    return Unit(factor, (metre, kilogram, second, ampere, kelvin), text.strip(), celsius)


def same_dimension(one: str, other: str) -> bool:
    """Whether two units can be converted into each other; a text that is no unit is equal to itself only."""
    try:
        return one == other or parse_unit(one).dimension == parse_unit(other).dimension
    except ValueError:
        return False
