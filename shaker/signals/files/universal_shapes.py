"""Universal files: mode shapes and operating deflection shapes, data set 55 (data at nodes)."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from shaker._checks import ComplexArray, IntArray, check_shape
from shaker.signals.files.common import reading
from shaker.signals.files.universal_sets import data_sets, fixed_width, free_width

_ANALYSES = (
    "unknown", "static", "normal mode", "complex mode, first order", "transient", "frequency response", "buckling",
    "complex mode, second order",
)  # fmt: skip
_QUANTITIES = {0: "unknown", 1: "general", 8: "displacement", 9: "reaction force", 11: "velocity", 12: "acceleration"}
_MODE, _TRANSIENT, _RESPONSE, _COMPLEX_MODES = 2, 4, 5, (3, 7)
_COMPLEX = 5  # data type of complex values


@dataclass(frozen=True)
class UniversalShape:
    """A shape: `value` (N, D) at nodes `node` (N,), D components in the order x, y, z (, rx, ry, rz).

    `analysis` and `quantity` in words ("normal mode", "frequency response"; "displacement", …); `frequency_hz` is NaN
    where the analysis has none, `damping_ratio` where the file states none, `time_s` except for transients.
    """

    node: IntArray
    value: ComplexArray
    analysis: str
    quantity: str
    frequency_hz: float
    damping_ratio: float
    time_s: float
    titles: tuple[str, ...]

    def __post_init__(self) -> None:
        check_shape("node", self.node, (None,))
        check_shape("value", self.value, (len(self.node), None))


def read_universal_shapes(path: Path) -> tuple[UniversalShape, ...]:
    """Read all shapes of a universal file, in its order; data sets of other kinds are passed over."""
    shapes = []
    with reading(path), path.open("rb") as stream:
        for data in list(data_sets(path, stream)):
            if data.kind == 55:
                stream.seek(data.start)
                shapes.append(_shape(path, data.line, stream.read(data.stop - data.start).splitlines()))
    return tuple(shapes)


def _shape(path: Path, line: int, lines: list[bytes]) -> UniversalShape:
    """Return the shape that the lines of one data set hold."""
    if len(lines) < 8:
        raise ValueError(f"{path}: line {line}: expected at least 8 records of data set 55, found {len(lines)}")
    _, analysis, _, quantity, data_type, components = _integers(lines[5], 6)
    counts = _integers(lines[6], 2)
    place = 7 + (2 + counts[0] - 1) // 8  # eight whole numbers a line, its two counts among them
    real_lines = max(1, -(-counts[1] // 6))
    reals = _reals(path, line, lines[place : place + real_lines])
    node, value = _nodes(path, line, lines[place + real_lines :], components * (2 if data_type == _COMPLEX else 1))
    complex_value = value[:, ::2] + 1j * value[:, 1::2] if data_type == _COMPLEX else value.astype(complex)
    frequency, damping, time = _abscissa(analysis, reals)
    titles = tuple(text.decode("latin-1").strip() for text in lines[:5])
    return UniversalShape(
        node,
        complex_value,
        _ANALYSES[analysis] if 0 <= analysis < len(_ANALYSES) else f"analysis type {analysis}",
        _QUANTITIES.get(quantity, f"data type {quantity}"),
        frequency,
        damping,
        time,
        tuple("" if title == "NONE" else title for title in titles),
    )


def _abscissa(analysis: int, reals: np.ndarray) -> tuple[float, float, float]:
    """Return frequency, damping ratio and time of a shape from its real parameters."""
    reals = np.concatenate([reals, np.full(4, np.nan)])
    if analysis == _MODE:
        return float(reals[0]), float(reals[2]), np.nan
    if analysis == _RESPONSE:
        return float(reals[0]), np.nan, np.nan
    if analysis in _COMPLEX_MODES:
        eigenvalue = complex(reals[0], reals[1])
        size = abs(eigenvalue)
        return size / (2.0 * np.pi), -eigenvalue.real / size if size else np.nan, np.nan
    return np.nan, np.nan, float(reals[0]) if analysis == _TRANSIENT else np.nan


def _nodes(path: Path, line: int, lines: list[bytes], values: int) -> tuple[IntArray, np.ndarray]:
    """Return node numbers (N,) and their numbers (N, values)."""
    lines = [text for text in lines if text.strip()]
    each = 1 + max(1, -(-values // 6))
    if not lines or len(lines) % each:
        raise ValueError(f"{path}: line {line}: expected {each} lines for every node, found {len(lines)} in all")
    node = np.array([_integers(text, 1)[0] for text in lines[::each]], dtype=np.int64)
    data = [text for i, text in enumerate(lines) if i % each]
    return node, _reals(path, line, data, len(node) * values).reshape(len(node), values)


def _integers(text: bytes, count: int) -> list[int]:
    """Return the first whole numbers of a record."""
    return [int(cell) for cell in text.split()[:count]] + [0] * (count - len(text.split()[:count]))


def _reals(path: Path, line: int, lines: list[bytes], count: int | None = None) -> np.ndarray:
    """Return the numbers of records of format 6E13.5, or between blanks, `count` of them where it is known."""
    for numbers in (fixed_width(lines, (13,) * 6), free_width(b" ".join(lines))):
        if numbers is not None and count in (None, len(numbers)):
            return numbers
    raise ValueError(f"{path}: line {line}: expected {count or 'some'} numbers of data set 55, found others")
