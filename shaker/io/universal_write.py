"""Writers of universal files: units (164), nodes (2411), shapes (55), functions (58, 58b).

All numbers are doubles. 58b has unevenly spaced abscissas in double precision, as other programs read it. Text has 13
digits of values and six of an uneven abscissa. Where six digits cannot represent start and interval of even spacing,
eight are written, which fill their field. Exponents have an E, which Fortran's format D also reads and other programs
need. The end mark follows binary numbers at once. `universal` reads these files.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Sequence

import numpy as np
from numpy.typing import NDArray

from shaker.io.universal import UniversalFunction, UniversalShape
from shakercal._common.arrays import FloatArray, IntArray, check_shape

_MARK = b"    -1\r\n"
_FUNCTIONS = {"time response": 1, "frequency response": 4, "transmissibility": 5, "spectrum": 12}
_DIRECTIONS = {"": 0, "X": 1, "Y": 2, "Z": 3, "RX": 4, "RY": 5, "RZ": 6}
_QUANTITIES = {
    "m": 8, "rad": 8, "m/s": 11, "rad/s": 11, "m/s^2": 12, "rad/s^2": 12, "N": 13, "N.m": 13, "s": 17, "Hz": 18,
}  # fmt: skip
"""Specific data type of a unit: displacement, velocity, acceleration, excitation force, time, frequency; 1: general."""
_EXACT = 1e-9  # relative difference of numbers that count as equal
_ANALYSES = {"normal mode": 2, "frequency response": 5}
_SHAPES = {"displacement": 8, "velocity": 11, "acceleration": 12}


def universal_units() -> bytes:
    """Return data set 164: all units are SI."""
    factors = [f"{f:25.16E}" for f in (1.0, 1.0, 1.0, 273.15)]
    return _text_set(164, [f"{1:10d}{'SI: meter (newton)':20s}{2:10d}", "".join(factors[:3]), factors[3]])


def universal_nodes(node: IntArray, position_m: FloatArray) -> bytes:
    """Return data set 2411: nodes (N,) at `position_m` (N, 3)."""
    check_shape("position_m", position_m, (len(node), 3))
    lines = []
    for number, coordinates in zip(node.tolist(), position_m.tolist(), strict=True):
        lines += [f"{number:10d}{1:10d}{1:10d}{11:10d}", "".join(f"{x:25.16E}" for x in coordinates)]
    return _text_set(2411, lines)


def universal_shape(shape: UniversalShape, number: int) -> bytes:
    """Return data set 55: a normal mode or frequency response with three or six components."""
    if shape.analysis not in _ANALYSES or shape.value.shape[1] not in (3, 6):
        raise ValueError(f"shape: expected {' or '.join(_ANALYSES)} of 3 or 6 components, found {shape.analysis}")
    analysis, complex_values = _ANALYSES[shape.analysis], bool(np.iscomplexobj(shape.value) and shape.value.imag.any())
    components = shape.value.shape[1]
    kind = f"{1:10d}{analysis:10d}{2 if components == 3 else 3:10d}{_SHAPES.get(shape.quantity, 1):10d}"
    damping = 0.0 if np.isnan(shape.damping_ratio) else shape.damping_ratio
    reals = [shape.frequency_hz, 1.0, damping, 0.0] if analysis == 2 else [shape.frequency_hz]
    lines = [*_titles(shape.titles), f"{kind}{5 if complex_values else 2:10d}{components:10d}"]
    lines += [f"{2:10d}{len(reals):10d}{1:10d}{number:10d}", _fields(reals)]
    for node, row in zip(shape.node.tolist(), shape.value, strict=True):
        parts = np.stack([row.real, row.imag], axis=1).ravel() if complex_values else row.real
        cells = parts.tolist()
        lines += [f"{node:10d}", *(_fields(cells[i : i + 6]) for i in range(0, len(cells), 6))]
    return _text_set(55, lines)


def universal_function(function: UniversalFunction, *, binary: bool = True) -> bytes:
    """Return data set 58, or 58b if `binary`: a function over time or frequency."""
    x, y = function.abscissa, function.value
    start, step = _spacing(function)
    even = step != ""
    columns = ([] if even else [x]) + ([y.real, y.imag] if np.iscomplexobj(y) else [y])
    head = _header(function, start, step)
    numbers: NDArray[np.float64] = np.stack(columns, axis=1).astype(np.float64)
    if binary:
        raw = numbers.astype("<f8").tobytes()
        first = f"{58:6d}b{1:6d}{2:6d}{11:12d}{len(raw):12d}{0:6d}{0:6d}{0:12d}{0:12d}"
        return b"".join([_MARK, _lines([first, *head]), raw, _MARK])
    widths = ["13.5E"] * (not even) + ["20.12E"] * (len(columns) - (not even))
    cells = [f"{value:{form}}" for row in numbers.tolist() for value, form in zip(row, widths, strict=True)]
    each = 4 if even or len(columns) == 2 else 3
    return _text_set(58, [*head, *("".join(cells[i : i + each]) for i in range(0, len(cells), each))])


def _spacing(function: UniversalFunction) -> tuple[str, str]:
    """Return start and interval of an evenly spaced abscissa as texts; both empty for others.

    Times may be off by a hundredth of the interval, which every recorder's clock exceeds; frequencies must be exact.
    """
    x = function.abscissa
    if len(x) < 2:
        return "", ""
    step = float(x[-1] - x[0]) / (len(x) - 1)
    limit = 0.01 * abs(step) if function.kind == "time response" else _EXACT * float(np.abs(x).max())
    for form, enough in (("13.5E", min(limit, _EXACT * abs(step) * len(x))), ("13.7E", limit)):
        start, interval = f"{float(x[0]):{form}}", f"{step:{form}}"
        off = float(np.abs(float(start) + float(interval) * np.arange(len(x)) - x).max())
        if len(start) == len(interval) == 13 and off <= enough:
            return start, interval
    return "", ""


def _header(function: UniversalFunction, start: str, step: str) -> list[str]:
    """Return the eleven text records."""
    kind = _FUNCTIONS.get(function.kind, 0)
    numerator, denominator = function.unit, ""
    if parts := re.fullmatch(r"\((.*)\)/\((.*)\)", function.unit):
        numerator, denominator = parts[1], parts[2]
    points = map(_node_and_direction, (function.response, function.reference))
    response, reference = (f"{node:10d}{direction:4d}" for node, direction in points)
    ordinate = 6 if np.iscomplexobj(function.value) else 4
    spacing = f"{int(step != ''):10d}{start or f'{0.0:13.5E}'}{step or f'{0.0:13.5E}'}{0.0:13.5E}"
    return [
        *_titles(function.titles),
        f"{kind:5d}{0:10d}{0:5d}{0:10d} {_ascii(function.name, 10) or 'NONE':10s}{response} {'NONE':10s}{reference}",
        f"{ordinate:10d}{len(function.value):10d}{spacing}",
        *(_axis(unit) for unit in (function.abscissa_unit, numerator, denominator, "")),
    ]


def _axis(unit: str) -> str:
    """Return the record of an axis: its quantity and unit."""
    kind = _QUANTITIES.get(unit, 1) if unit else 0
    return f"{kind:10d}{0:5d}{0:5d}{0:5d} {'NONE':20s} {_ascii(unit, 20) or 'NONE':20s}"


def _node_and_direction(point: str) -> tuple[int, int]:
    """Return node and direction of a point such as 12+Z or 12-RX."""
    found = re.fullmatch(r"(\d*)([+-]?)(R?[XYZ])?", point)
    if found is None:
        raise ValueError(f"response, reference: expected node and direction such as 12+Z, found {point!r}")
    return int(found[1] or 0), (-1 if found[2] == "-" else 1) * _DIRECTIONS[found[3] or ""]


def _titles(titles: Sequence[str]) -> list[str]:
    """Return the title records."""
    return [_ascii(title, 80) or "NONE" for title in (*titles, *[""] * 5)[:5]]


def _ascii(text: str, length: int) -> str:
    """Return a text in the characters and length of a field."""
    return "".join(c if " " <= c <= "~" else "?" for c in text)[:length].strip()


def _fields(values: Iterable[float]) -> str:
    return "".join(f"{value:13.5E}" for value in values)


def _text_set(kind: int, lines: Iterable[str]) -> bytes:
    return b"".join([_MARK, _lines([f"{kind:6d}", *lines]), _MARK])


def _lines(lines: Iterable[str]) -> bytes:
    return "".join(f"{line}\r\n" for line in lines).encode("ascii")
