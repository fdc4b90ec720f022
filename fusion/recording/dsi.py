r"""Units of certificates (D-SI, `\milli\volt\newton\tothe{-1}`) and plain units (`mV/N`).

Names after Hutzschenreuter et al. 2019, SmartCom Digital System of Units guide, and the SI brochure.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from fractions import Fraction
from functools import cache
from math import log, log10, pi

Powers = Sequence[tuple[str, int]]
DECIMALS = {"deca": 1, "hecto": 2, "kilo": 3, "mega": 6, "giga": 9, "tera": 12, "peta": 15, "exa": 18, "zetta": 21}
DECIMALS |= {"yotta": 24, "ronna": 27, "quetta": 30, "deci": -1, "centi": -2, "milli": -3, "micro": -6, "nano": -9}
DECIMALS |= {"pico": -12, "femto": -15, "atto": -18, "zepto": -21, "yocto": -24, "ronto": -27, "quecto": -30}
BINARY = dict(zip(("kibi", "mebi", "gibi", "tebi", "pebi", "exbi", "zebi", "yobi"), range(10, 90, 10), strict=True))
SIZES = {name: 10.0**power for name, power in DECIMALS.items()} | {name: 2.0**power for name, power in BINARY.items()}
"""Factors of decimal and binary prefixes."""
PREFIXES = {"": "", "k": r"\kilo", "m": r"\milli", "u": r"\micro", "\u00b5": r"\micro", "\u03bc": r"\micro"}
PREFIXES |= {"n": r"\nano", "p": r"\pico", "M": r"\mega", "h": r"\hecto", "c": r"\centi", "G": r"\giga"}
SYMBOLS = {"V": r"\volt", "A": r"\ampere", "C": r"\coulomb", "N": r"\newton", "m": r"\metre", "s": r"\second"}
SYMBOLS |= {"Hz": r"\hertz", "Ohm": r"\ohm", "\u03a9": r"\ohm", "F": r"\farad", "W": r"\watt", "Pa": r"\pascal"}
SYMBOLS |= {"g": r"\gram", "K": r"\kelvin", "rad": r"\radian", "J": r"\joule"}
BASE = ("m", "kg", "s", "A", "K", "mol", "cd", "Np", "bit")
"""Base units of dimensions, with those of levels (of field quantities) and information."""
Dimension = tuple[int | Fraction, ...]
NONE: Dimension = (0,) * len(BASE)


def _dimension(powers: str) -> Dimension:
    """Return the dimension of a text such as `kg m2 s-2`."""
    found = {name: int(power or 1) for name, power in re.findall(r"([A-Za-z]+)(-?\d)?", powers)}
    return tuple(found.get(name, 0) for name in BASE)


LEVEL = _dimension("Np")
ANGLES = {"radian": 1.0, "degree": pi / 180.0, "arcminute": pi / 10_800.0, "arcsecond": pi / 648_000.0}
UNITS: Mapping[str, tuple[float, Dimension]] = {
    **{name: (factor, NONE) for name, factor in ANGLES.items()},
    **{
        name: (factor, _dimension(powers))
        for powers, units in {
            "": {"one": 1.0, "percent": 1e-2, "ppm": 1e-6, "steradian": 1.0},
            "m": {"metre": 1.0, "meter": 1.0, "nauticalmile": 1852.0, "astronomicalunit": 149_597_870_700.0}
            | {"angstrom": 1e-10, "bohr": 5.29177210903e-11},
            "kg": {"gram": 1e-3, "kilogram": 1.0, "tonne": 1e3, "electronmass": 9.1093837139e-31}
            | dict.fromkeys(("dalton", "atomicmassunit"), 1.66053906660e-27),
            "s": {"second": 1.0, "minute": 60.0, "hour": 3600.0, "day": 86_400.0},
            "A": {"ampere": 1.0},
            "K": {"kelvin": 1.0, "degreecelsius": 1.0},
            "mol": {"mole": 1.0},
            "cd": {"candela": 1.0, "lumen": 1.0},
            "cd m-2": {"lux": 1.0},
            "mol s-1": {"katal": 1.0},
            "Np": {"neper": 1.0, "bel": log(10.0) / 2.0, "decibel": log(10.0) / 20.0},
            "bit": {"bit": 1.0, "byte": 8.0},
            "s-1": {"hertz": 1.0, "becquerel": 1.0},
            "m s-1": {"knot": 1852.0 / 3600.0, "clight": 299_792_458.0},
            "m2": {"hectare": 1e4, "barn": 1e-28},
            "m3": {"litre": 1e-3, "liter": 1e-3},
            "m2 s-2": {"gray": 1.0, "sievert": 1.0},
            "m kg s-2": {"newton": 1.0},
            "m-1 kg s-2": {"pascal": 1.0, "bar": 1e5, "mmhg": 133.322387415},
            "m2 kg s-2": {"joule": 1.0, "electronvolt": 1.602176634e-19, "hartree": 4.3597447222060e-18},
            "m2 kg s-1": {"planckbar": 1.054571817e-34},
            "m2 kg s-3": {"watt": 1.0},
            "s A": {"coulomb": 1.0, "elementarycharge": 1.602176634e-19},
            "m2 kg s-3 A-1": {"volt": 1.0},
            "m-2 kg-1 s4 A2": {"farad": 1.0},
            "m2 kg s-3 A-2": {"ohm": 1.0},
            "m-2 kg-1 s3 A2": {"siemens": 1.0},
            "m2 kg s-2 A-2": {"henry": 1.0},
            "m2 kg s-2 A-1": {"weber": 1.0},
            "kg s-2 A-1": {"tesla": 1.0},
        }.items()
        for name, factor in units.items()
    },
}
CELSIUS_AT_0_K = -273.15
MOST_PARTS = 12
SMALLEST_FACTOR, LARGEST_FACTOR = 1e-60, 1e60
TOKEN = re.compile(r"\\([A-Za-z]+)(?:\{([-+]?\d(?:\.\d{1,3}|_[1-9])?)\})?")


@dataclass(frozen=True)
class Unit:
    """A unit with its `factor` to the coherent SI unit of its `dimension`.

    `dimension`: exponents of `BASE`.     `celsius`: a temperature on the Celsius scale, with the value `CELSIUS_AT_0_K`
    at 0 K. `angle`: exponent of the radian, which has no dimension. `other`: the unit if `\\per` divides only by the
    next unit, if that differs.
    """

    factor: float
    dimension: Dimension
    text: str
    celsius: bool = False
    angle: int | Fraction = 0
    other: Unit | None = None


def dsi_unit(unit: str, further: Powers = (), power: int = 1) -> str:
    r"""Return a unit, times further units, to a power, in the notation of the D-SI.

    `ValueError` for units other than products of volts, amperes, coulombs, newtons, metres, ohms and similar ones.

    >>> from fusion.recording.dsi import dsi_unit
    >>> print(dsi_unit("mV/V", [(r"\newton", -1)]))
    \milli\volt\volt\tothe{-1}\newton\tothe{-1}
    """
    parts = [(name, power * exponent) for name, exponent in (*_powers(unit), *further)]
    return "".join(name if exponent == 1 else rf"{name}\tothe{{{exponent}}}" for name, exponent in parts) or r"\one"


def _powers(unit: str) -> Iterator[tuple[str, int]]:
    """Yield units with exponents; a stroke divides by all up to the next one."""
    none = f"expected a unit of V, A, C, N, m and similar ones, such as mV/V, found {unit}"
    outer, sign, last = [1], 1, "/"  # of open brackets, and after a stroke within the last one
    for token in re.findall(r"[()/]|[^()/\u00b7.*\s]+", unit):
        if token == "(":
            outer, sign = [*outer, outer[-1] * sign], 1
        elif token == ")" and len(outer) > 1:
            sign = outer.pop() * outer[-1]
        elif token == "/" and last not in ("/", "("):
            sign = -1
        elif token != "1":
            name, raised, exponent = token.replace("\u00b2", "^2").replace("\u00b3", "^3").partition("^")
            ends = [symbol for symbol in SYMBOLS if name.endswith(symbol) and name[: -len(symbol)] in PREFIXES]
            if not ends or (raised and not re.fullmatch(r"-?\d", exponent)):
                raise ValueError(none)
            symbol = max(ends, key=len)
            yield PREFIXES[name[: -len(symbol)]] + SYMBOLS[symbol], outer[-1] * sign * int(exponent or 1)
        last = token
    if len(outer) > 1 or last in ("/", "("):
        raise ValueError(none)


@cache
def parse_unit(text: str) -> Unit:
    r"""Return a unit of the D-SI, or a plain one such as `(mV/V)/N`.

    `ValueError` for other texts.     `\per` divides by all units after it; the D-SI allows one. The LaTeX reading,
    division by the next unit only, is the unit's `other`.

    >>> from fusion.recording.dsi import parse_unit
    >>> parse_unit(r"\milli\volt\per\newton") == parse_unit("mV/N")
    False
    >>> parse_unit(r"\milli\volt\per\newton").factor, parse_unit("mV/N").factor
    (0.001, 0.001)
    """
    notation = text.strip()
    if not notation.startswith(("\\", "|")):
        notation = dsi_unit(notation)
    notation = re.sub(r"\^\{?(-?\d+)\}?", r"\\tothe{\1}", notation)
    wrong = ValueError(rf"expected a unit of the D-SI such as \volt\per\newton, found {text.strip()[:80]}")
    parts: list[tuple[str, str, int | Fraction, int]] = []  # unit, prefix, exponent, strokes before it
    end, prefix, strokes, stroke = 0, "", 0, False
    for found in TOKEN.finditer(notation):
        name, exponent = found[1], found[2]
        if found.start() != end:
            break
        end = found.end()
        if name == "tothe" and exponent and parts and not prefix and not stroke:
            last, size, power, above = parts[-1]
            parts[-1] = last, size, power * Fraction(exponent.replace("_", "/")), above
        elif name == "per" and not exponent and not stroke and not prefix:
            strokes, stroke = strokes + 1, True
        elif name in SIZES and not exponent and not prefix:
            prefix = name
        elif name.lower() in UNITS and not exponent:
            parts.append((name.lower(), prefix, 1, strokes))
            prefix, stroke = "", False
        else:
            raise wrong
    if end != len(notation) or not 0 < len(parts) <= MOST_PARTS or prefix or stroke:
        raise wrong
    behind = [-1 if part[3] else 1 for part in parts]
    first = [-1 if part[3] > (parts[n - 1][3] if n else 0) else 1 for n, part in enumerate(parts)]
    names = [rf"\{prefix}\{name}" if prefix else rf"\{name}" for name, prefix, _, _ in parts]
    powers = [str(sign * part[2]).replace("/", "_") for sign, part in zip(first, parts, strict=True)]
    plain = "".join(rf"{name}\tothe{{{power}}}" for name, power in zip(names, powers, strict=True))
    units = [_product(parts, behind, text.strip()), _product(parts, first, plain)]
    if not all(SMALLEST_FACTOR < unit.factor < LARGEST_FACTOR for unit in units):
        raise wrong
    return units[0] if behind == first else replace(units[0], other=units[1])


def _product(parts: Sequence[tuple[str, str, int | Fraction, int]], signs: Sequence[int], text: str) -> Unit:
    """Return the product of units with prefixes and exponents, the latter with their signs."""
    factor, dimension, angle = 1.0, list(NONE), Fraction(0)
    for (name, prefix, exponent, _), sign in zip(parts, signs, strict=True):
        of_unit, unit_dimension = UNITS[name]
        size, power = of_unit * SIZES.get(prefix, 1.0), float(sign * exponent)
        factor *= size**power if abs(power * log10(size)) < 100.0 else 0.0
        dimension = [d + sign * exponent * o for d, o in zip(dimension, unit_dimension, strict=True)]
        angle += sign * exponent * (name in ANGLES)
    celsius = len(parts) == 1 and parts[0][0] == "degreecelsius" and parts[0][2] == 1
    return Unit(factor, tuple(dimension), text, celsius, angle)


def same_dimension(one: str, other: str) -> bool:
    """Whether two units have the same dimension; other texts only match themselves."""
    try:
        return one == other or parse_unit(one).dimension == parse_unit(other).dimension
    except ValueError:
        return False
