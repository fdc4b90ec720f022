"""Layout of a figure on paper: frames of panels, limits of axes, ticks and numbers."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from fusion.report.figure import (
    Along,
    Arrows,
    Band,
    Bounds,
    Boxes,
    Ellipses,
    Figure,
    Image,
    Line,
    Mark,
    Panel,
    PanelAxis,
    Points,
    Rule,
    Scale,
    Span,
    padded_limits,
    power_text,
)
from shakercal._common.arrays import FloatArray

WIDTH_IN, CHARACTER_IN = 8.4, 0.066
"""Width of a page's figure, and mean width of a character in its font."""
MARGIN = 0.05  # share of the range of all marks beyond the outermost one
STEPS = (1.0, 2.0, 2.5, 5.0, 10.0)
MOST_DECADES = 8
"""Largest number of powers of ten with a label on a logarithmic axis; more would overlap."""


@dataclass(frozen=True)
class PanelFrame:
    """Rectangle of a panel in inches from the upper left corner, with margins for labels."""

    left: float
    top: float
    width: float
    height: float
    left_margin: float
    bottom_margin: float


def frames(figure: Figure, legend_in: float) -> list[PanelFrame]:
    """Return the frame of every panel.

    Margins and gaps follow from titles, numbers, names, second scales and colour bars. `legend_in`: height of the
    legend above all panels.
    """
    rows, columns = len(figure.heights), len(figure.widths)
    grid = [figure.panels[r * columns : (r + 1) * columns] for r in range(rows)]
    longest = [max(len(name) for row in grid for name in ("", *row[c].y.names)) for c in range(columns)]
    left_margins = [0.82 if not n else 0.3 + CHARACTER_IN * n for n in longest]
    right_margins = [0.72 if any(row[c].y.second for row in grid) else 0.12 for c in range(columns)]
    top_margins = [0.2 if any(panel.title for panel in row) else 0.08 for row in grid]
    names = (
        max(len(name) for panel in figure.panels for name in ("", *panel.x.names)) if has_upright_names(figure) else 0
    )
    numbers = [
        max(0.45, 0.1 + CHARACTER_IN * names) if r == rows - 1 or not figure.shared_x else 0.06 for r in range(rows)
    ]
    bottom_margins = [n + (0.52 if any(map(scale_below, grid[r])) else 0.0) for r, n in enumerate(numbers)]
    if figure.shared_y:
        left_margins = [left_margins[0], *([0.12] * (columns - 1))]
    width, height = (
        WIDTH_IN - sum(left_margins) - sum(right_margins),
        figure.height_in - legend_in - sum(top_margins) - sum(bottom_margins),
    )
    lefts = np.cumsum([0.0, *(width * w / sum(figure.widths) for w in figure.widths)]).tolist()
    tops = np.cumsum([0.0, *(height * h / sum(figure.heights) for h in figure.heights)]).tolist()
    return [
        PanelFrame(
            lefts[c] + sum(left_margins[: c + 1]) + sum(right_margins[:c]),
            legend_in + tops[r] + sum(top_margins[: r + 1]) + sum(bottom_margins[:r]),
            lefts[c + 1] - lefts[c],
            tops[r + 1] - tops[r],
            left_margins[c],
            numbers[r],
        )
        for r, c in np.ndindex(rows, columns)
    ]


def has_upright_names(figure: Figure) -> bool:
    """Return whether names below a panel must be upright, since they would overlap."""
    characters = WIDTH_IN / len(figure.widths) / CHARACTER_IN
    return any(sum(len(name) + 1 for name in panel.x.names) > 0.8 * characters for panel in figure.panels)


def scale_below(panel: Panel) -> Scale | None:
    """Return the colour scale that is shown below a panel, if it has one."""
    scales = (mark.scale for mark in panel.marks if isinstance(mark, Points | Boxes) and mark.scale is not None)
    return next((scale for scale in scales if scale.label), None)


# Limits.


def limits(panels: Sequence[Panel], axis_name: Along) -> tuple[float, float]:
    """Return the limits of an axis that some panels share.

    These are stated ones, or those of its names or marks.
    """
    axes: list[PanelAxis] = [getattr(panel, axis_name) for panel in panels]
    log = any(axis.log for axis in axes)
    names = max(len(axis.names) for axis in axes)
    stated = next((axis.limits for axis in reversed(axes) if axis.limits is not None), None)
    if stated is not None and (min(stated) > 0.0 or not log):
        return stated
    if names:
        return (-0.6, names - 0.4) if axis_name == "x" else (names - 0.4, -0.6)
    marks = [mark for panel in panels for mark in panel.marks]
    values = np.concatenate([np.empty(0), *(np.ravel(part) for mark in marks for part in _reach(mark, axis_name))])
    values = values[np.isfinite(values) & ((values > 0.0) | (not log))]
    ends = (float(values.min()), float(values.max())) if len(values) else (1.0, 10.0) if log else (0.0, 1.0)
    if log:
        low, high = (float(np.log10(end)) for end in ends)
        low, high = padded_limits(low, high, MARGIN) if low < high else (low - 0.5, high + 0.5)
        return 10.0**low, 10.0**high
    if all(isinstance(mark, Image) for mark in marks) and len(values):
        return ends
    return padded_limits(*ends, MARGIN) if ends != (0.0, 0.0) else (-MARGIN, MARGIN)


def _reach(mark: Mark, axis_name: Along) -> Iterator[Any]:
    """Yield the values of x or y that a mark covers."""
    along_x = axis_name == "x"
    if isinstance(mark, Points):
        half, values = (mark.half_x, mark.x) if along_x else (mark.half_y, mark.y)
        yield values
        yield from () if half is None else (values - half, values + half)
    elif isinstance(mark, Bounds):
        values = mark.x if along_x else mark.y
        yield from (values, 0.5 * values) if mark.along == axis_name else (values,)
    elif isinstance(mark, Band):
        yield from (mark.x,) if along_x else (mark.low, mark.high)
    elif isinstance(mark, Span):
        yield from (mark.low, mark.high) if mark.along == axis_name else ()
    elif isinstance(mark, Rule):
        yield from (mark.at,) if mark.along == axis_name else ()
    elif isinstance(mark, Ellipses):
        values, reach = mark.x if along_x else mark.y, 0.5 * np.maximum(mark.width, mark.height)
        yield from (values - reach, values + reach)
    elif isinstance(mark, Boxes):
        yield from (mark.left, mark.right) if along_x else (mark.low, mark.high)
    elif isinstance(mark, Arrows):
        yield from (mark.x, mark.x + mark.dx) if along_x else (mark.y, mark.y + mark.dy)
    elif isinstance(mark, Image):
        yield from (mark.left, mark.right) if along_x else (mark.bottom, mark.top)
    elif isinstance(mark, Line):
        yield mark.x if along_x else mark.y


# Ticks.


def round_ticks(low: float, high: float, most: int) -> FloatArray:
    """Return round ticks between two ends: multiples of 1, 2, 2.5 or 5.

    `most`: largest number of steps from end to end. The multiples are times a power of ten.
    """
    low, high = min(low, high), max(low, high)
    least = (high - low) / max(most, 1)
    if not least > 1e-14 * max(abs(low), abs(high)):
        return np.array([low])
    power = 10.0 ** np.floor(np.log10(least))
    step = power * next(factor for factor in STEPS if factor * power >= least * (1.0 - 1e-9))
    first, last = np.ceil(low / step - 1e-9), np.floor(high / step + 1e-9)
    return np.asarray(step * np.arange(first, last + 0.5))


def decade_ticks(low: float, high: float) -> tuple[FloatArray, list[str]]:
    """Return powers of ten between two ends with their texts.

    If the ends span less than two decades, 1, 2 and 5 times the powers are returned.
    """
    low, high = min(low, high), max(low, high)
    first, last = int(np.ceil(np.log10(low) - 1e-9)), int(np.floor(np.log10(high) + 1e-9))
    if high < 100.0 * low and high < 1e5:
        values = np.ravel(10.0 ** np.arange(first - 1.0, last + 1.0)[:, None] * [1.0, 2.0, 5.0])
        values = values[(values >= low * (1.0 - 1e-9)) & (values <= high * (1.0 + 1e-9))]
        return values, [f"{value:g}" for value in values]
    stride = -(-(last - first + 1) // MOST_DECADES)
    powers = range(first + (-first) % stride, last + 1, stride)
    return 10.0 ** np.array(powers, dtype=np.float64), [power_text(power) for power in powers]


def number_texts(values: FloatArray) -> list[str]:
    """Return texts of ticks with as many decimals as are needed to distinguish them."""
    spread = float(np.min(np.diff(np.sort(values)))) if len(values) > 1 else float(np.max(np.abs(values), initial=1.0))
    for decimals in range(12):
        if np.all(np.abs(np.round(values, decimals) - values) <= 1e-3 * spread):
            break
    return [
        f"{value:.{decimals}f}".replace("-", "\N{MINUS SIGN}") for value in (np.round(values, decimals) + 0.0).tolist()
    ]
