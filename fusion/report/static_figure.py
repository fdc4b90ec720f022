"""Figures as static SVG text for pages and files: layout, axes, ticks, legend."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np

from fusion.report.figure import (
    BLACK,
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
    Texts,
    padded_limits,
)
from fusion.report.svg_marks import (
    DRAWN,
    FONT,
    HEIGHTS,
    LEVELS,
    NUMBER_PT,
    AxisScale,
    PanelRect,
    half_height,
    path,
    polygons,
    stroke,
    strokes,
    strokes_across,
    svg_text,
    width,
)
from shakercal._common.arrays import FloatArray
from shakercal._common.digits import exponent_of, number_text, power_text, tick_texts

CHARACTER_IN = 0.066  # mean width of a character
MARGIN = 0.05  # share of the range of all marks beyond the outermost one
STEPS = (1.0, 2.0, 2.5, 5.0, 10.0)
MOST_DECADES = 8
"""Largest number of powers of ten with a label on a logarithmic axis; more would overlap."""
PT = 72.0
LABEL_PT, TITLE_PT, AXIS_PT, GRID_PT, TICK_PT, GRID = 8.5, 8.0, 0.7, 0.6, 3.5, "#e8e8e8"
SIGN_PT, GAP_PT, ROW_PT = 12.8, 16.0, 14.4  # of the legend: sign, gap between entries, height of a row
POWER_IN = 0.4  # room for a power of ten that is taken off the numbers of an axis
MOST_STEPS, CLOSEST_PT = 8, 11.0
"""Largest number of steps between ticks of an axis, and smallest distance of vertical ones."""


def static_svg(figure: Figure) -> str:
    """Return a figure as SVG text; equal figures give equal text."""
    entries = dict[str, Mark]()
    for panel in figure.panels:
        for mark in panel.marks:
            if mark.label and (isinstance(mark, Points) or not isinstance(entries.get(mark.label), Points)):
                entries[mark.label] = mark if isinstance(mark, Points) else entries.get(mark.label, mark)
    legend, legend_pt = _legend(entries, figure.width_in)
    parts = [f'<rect width="100%" height="100%" fill="#fff"/>{legend}']
    columns, upright = len(figure.widths), has_upright_names(figure)
    every = frames(figure, legend_pt / PT)
    for index, frame in enumerate(every):
        row, column = divmod(index, columns)
        until = every[index + 1].left - POWER_IN if column < columns - 1 else figure.width_in
        until -= POWER_IN if figure.panels[index].y.second is not None else 0.0
        inner = (figure.shared_x and row < len(figure.heights) - 1, figure.shared_y and column > 0)
        rect = replace(_panel_rect(figure, index, frame), title=PT * (until - frame.left) - 4.0)
        parts += _panel(figure.panels[index], rect, f"c{index}", inner, upright=upright)
    body = "".join(parts)
    wide, tall = f"{PT * figure.width_in:g}", f"{PT * figure.height_in:g}"
    head = f'width="{wide}pt" height="{tall}pt" viewBox="0 0 {wide} {tall}" fill="none" stroke-linejoin="round"'
    names = f'xmlns="http://www.w3.org/2000/svg" xmlns:xlink="http://www.w3.org/1999/xlink" font-family="{FONT}"'
    return f'<?xml version="1.0" encoding="utf-8"?>\n<svg {names} {head}>\n{body}\n</svg>\n'


def _panel_rect(figure: Figure, index: int, frame: PanelFrame) -> PanelRect:
    """Return the rectangle of a panel with the scales of its axes.

    Equal scales of both axes shrink the rectangle or widen the limits.
    """
    columns, panel = len(figure.widths), figure.panels[index]
    column = figure.panels[index % columns :: columns] if figure.shared_x else [panel]
    first = index - index % columns
    row = figure.panels[first : first + columns] if figure.shared_y else [panel]
    x, y = limits(column, "x"), limits(row, "y")
    left, top, wide, tall = (PT * part for part in (frame.left, frame.top, frame.width, frame.height))
    if panel.equal:
        each = max(abs(x[1] - x[0]) / wide, abs(y[1] - y[0]) / tall)  # units of the axes in a pt
        if panel.x.limits is None:
            x, y = _widened(x, each * wide), _widened(y, each * tall)
        else:
            new = abs(x[1] - x[0]) / each, abs(y[1] - y[0]) / each
            left, top, wide, tall = left + (wide - new[0]) / 2.0, top + (tall - new[1]) / 2.0, *new
    across = AxisScale(*x, left, left + wide, any(panel_of.x.log for panel_of in column))
    down = AxisScale(*y, top + tall, top, any(panel_of.y.log for panel_of in row))
    return PanelRect(across, down, PT * frame.left_margin, PT * frame.bottom_margin)


def _widened(ends: tuple[float, float], size: float) -> tuple[float, float]:
    """Return limits of the same centre and another size."""
    middle, half = 0.5 * (ends[0] + ends[1]), 0.5 * size * np.sign(ends[1] - ends[0])
    return float(middle - half), float(middle + half)


# Panels, axes and the legend.


def _panel(panel: Panel, rect: PanelRect, name: str, inner: tuple[bool, bool], *, upright: bool) -> Iterator[str]:
    """Yield one panel; `inner`: whether another panel has its numbers of x, of y.

    `name`: identifier of its clipping path.
    """
    x, y = rect.x, rect.y
    size = f'x="{x.start:.2f}" y="{y.end:.2f}" width="{x.end - x.start:.2f}" height="{y.start - y.end:.2f}"'
    yield f'<clipPath id="{name}"><rect {size}/></clipPath>\n'
    across, down = _Ticks.of(panel.x, x), _Ticks.of(panel.y, y, PT * 0.5)
    for kinds in HEIGHTS:
        if not kinds and not panel.blank:
            for spec, ticks, along in ((panel.x, across, "x"), (panel.y, down, "y")):
                if spec.grid and not (spec.names and along == "y"):
                    yield path(strokes(strokes_across(rect, ticks.values, along)), stroke(GRID, GRID_PT))
        drawn = "".join(
            part for mark in panel.marks if isinstance(mark, kinds) for part in DRAWN[type(mark)](rect, mark)
        )
        window = "" if kinds == (Texts,) else f' clip-path="url(#{name})"'
        yield f"<g{window}>{drawn}</g>\n" if drawn else ""
    if panel.title:
        fitting = min(TITLE_PT, rect.title / width(panel.title))
        yield svg_text(x.start, y.end - 3.0, panel.title, fitting, "left")
    if panel.blank:
        return
    second = [[x.end, y.start, x.end, y.end]] if panel.y.second is not None else []
    frame = np.array([[x.start, y.start, x.start, y.end], [x.start, y.start, x.end, y.start], *second])
    yield path(strokes(frame), f'{stroke(BLACK, AXIS_PT)} stroke-linecap="square"')
    yield from _bottom(panel.x, rect, across, hidden=inner[0], upright=upright)
    yield from _left(panel.y, rect, down, hidden=inner[1])
    yield from _right(panel.y, rect)
    scale = scale_below(panel)
    if scale is not None:
        yield from _bar(rect, scale)


class _Ticks(NamedTuple):
    """Ticks of an axis, their texts, and the power of ten of the numbers."""

    values: FloatArray
    texts: list[str]
    power: str = ""

    @classmethod
    def of(cls, spec: PanelAxis, axis_scale: AxisScale, wide: float = 0.0) -> _Ticks:
        """Return the stated ticks, or round ones that fit.

        `wide`: width for the numbers of a vertical axis, 0 for a horizontal one.
        """
        low, high, length = (
            min(axis_scale.low, axis_scale.high),
            max(axis_scale.low, axis_scale.high),
            abs(axis_scale.end - axis_scale.start),
        )
        if spec.names:
            return cls(np.arange(len(spec.names), dtype=np.float64), list(spec.names))
        if spec.ticks:
            values = np.array(spec.ticks)
            return cls._numbers(values[(values >= low) & (values <= high)], wide)
        if axis_scale.log:
            values, texts = decade_ticks(low, high)
            if len(values) > 1:
                return cls(values, texts)
        steps = max(1, min(MOST_STEPS, int(length / CLOSEST_PT)))
        while True:
            ticks = cls._numbers(round_ticks(low, high, steps), wide)
            widest = NUMBER_PT * max(map(width, ticks.texts), default=0.0)
            if wide or steps == 1 or len(ticks.values) * (widest + NUMBER_PT) <= length + widest:
                break
            steps -= 1
        # One number does not define a scale.
        finer = (cls._numbers(round_ticks(low, high, more), wide) for more in range(steps, 2 * MOST_STEPS))
        return next((ticks_of for ticks_of in finer if len(ticks_of.values) > 1), ticks)

    @classmethod
    def _numbers(cls, values: FloatArray, wide: float) -> _Ticks:
        """Return plain numbers if they fit and are readable, else over a power of ten."""
        texts = tick_texts(values.tolist())
        largest = float(np.max(np.abs(values), initial=0.0))
        power = exponent_of(largest)
        if wide > 0.0 and not power and any(NUMBER_PT * width(text) > wide for text in texts):
            power = int(np.floor(np.log10(largest)))
        if power in (-1, 0, 1):
            return cls(values, texts)
        return cls(values, tick_texts((values / 10.0**power).tolist()), f"×{power_text(power)}")


def _bottom(spec: PanelAxis, rect: PanelRect, ticks: _Ticks, *, hidden: bool, upright: bool) -> Iterator[str]:
    """Yield ticks, numbers and label below a panel."""
    at, y = rect.x(ticks.values), rect.y.start
    yield path(strokes(np.column_stack([at, 0 * at + y, at, 0 * at + y + TICK_PT])), stroke(BLACK, AXIS_PT))
    if hidden:
        return
    for x, text in zip(at.tolist(), ticks.texts, strict=True):
        if upright:
            yield svg_text(x + half_height(NUMBER_PT), y + 7.0, text, align="right", upright=True)
        else:
            yield svg_text(x, y + 13.5, text)
    if ticks.power:
        yield svg_text(rect.right, y + 25.5, ticks.power, align="right")
    if spec.label:
        yield svg_text((rect.x.start + rect.right) / 2.0, y + max(25.5, rect.bottom_margin - 5.5), spec.label, LABEL_PT)


def _left(spec: PanelAxis, rect: PanelRect, ticks: _Ticks, *, hidden: bool) -> Iterator[str]:
    """Yield ticks, numbers and label to the left of a panel; long numbers are smaller."""
    at, x = rect.y(ticks.values), rect.x.start
    yield path(strokes(np.column_stack([0 * at + x - TICK_PT, at, 0 * at + x, at])), stroke(BLACK, AXIS_PT))
    if hidden:
        return
    free, widest = rect.left_margin - (8.5 if spec.names else 25.0), max(map(width, ticks.texts), default=0.0)
    size = min(NUMBER_PT, max(4.0, free / widest)) if widest else NUMBER_PT
    for y, text in zip(at.tolist(), ticks.texts, strict=True):
        yield svg_text(x - 7.0, y + half_height(size), text, size, "right")
    if ticks.power:
        yield svg_text(x - 4.0, rect.y.end - 4.0, ticks.power, 6.5, "right")
    if spec.label:
        middle = (rect.y.start + rect.y.end) / 2.0
        yield svg_text(x - rect.left_margin + 14.5, middle, spec.label, LABEL_PT, upright=True)


def _right(spec: PanelAxis, rect: PanelRect) -> Iterator[str]:
    """Yield ticks, numbers and label of a second scale."""
    if spec.second is None:
        return
    label, zero, factor = spec.second
    axis_scale = AxisScale(factor * (rect.y.low - zero), factor * (rect.y.high - zero), rect.y.start, rect.y.end)
    ticks = _Ticks.of(PanelAxis(), axis_scale, PT * 0.45)
    at, x = axis_scale(ticks.values), rect.right
    yield path(strokes(np.column_stack([0 * at + x, at, 0 * at + x + TICK_PT, at])), stroke(BLACK, AXIS_PT))
    for y, text in zip(at.tolist(), ticks.texts, strict=True):
        yield svg_text(x + 7.0, y + half_height(NUMBER_PT), text, align="left")
    if ticks.power:
        yield svg_text(x + 4.0, rect.y.end - 4.0, ticks.power, 6.5, "left")
    yield svg_text(x + PT * 0.72 - 3.0, (rect.y.start + rect.y.end) / 2.0, label, LABEL_PT, upright=True)


def _bar(rect: PanelRect, scale: Scale) -> Iterator[str]:
    """Yield a colour bar below the numbers of a panel, with numbers and label."""
    left, right, top, tall = rect.x.start, rect.right, rect.y.start + rect.bottom_margin, 7.2
    inside = PanelRect(AxisScale(0.0, 1.0, left, right), AxisScale(0.0, 1.0, top + tall, top))
    ends, share = np.linspace(0.0, 1.0, LEVELS + 1), np.linspace(0.0, 1.0, LEVELS)
    whole: dict[str, Any] = {"low": 0.0 * share, "high": 0.0 * share + 1.0}
    colours = Scale(scale.colours, 0.0, 1.0)
    yield from DRAWN[Boxes](inside, Boxes(left=ends[:-1], right=ends[1:], values=share, scale=colours, **whole))
    corners = np.array([[[left, top], [right, top], [right, top + tall], [left, top + tall]]])
    yield path(polygons(corners), stroke(BLACK, AXIS_PT))
    below = replace(inside, x=AxisScale(scale.low, scale.high, left, right, scale.log))
    spec = PanelAxis(label=scale.label, log=scale.log)
    yield from _bottom(spec, below, _Ticks.of(spec, below.x), hidden=False, upright=False)


def _legend(entries: dict[str, Mark], width_in: float) -> tuple[str, float]:
    """Return the legend of all marks, and the height of its rows."""
    left, end = 0.05 * PT * width_in, PT * (width_in - 0.1)
    parts, x, rows = [], left, 1 if entries else 0
    for name, mark in entries.items():
        wide = SIGN_PT + 6.4 + NUMBER_PT * width(name)
        if x > left and x + wide > end:
            x, rows = left, rows + 1
        y = ROW_PT * (rows - 0.5)
        parts += [
            *_legend_sign(mark, x, y),
            svg_text(x + SIGN_PT + 6.4, y + half_height(NUMBER_PT), name, align="left"),
        ]
        x += wide + GAP_PT
    return "".join(parts), ROW_PT * rows


def _legend_sign(mark: Mark, x: float, y: float) -> Iterable[str]:
    """Return the symbol of a mark in the legend."""
    across, up = AxisScale(0.0, 1.0, x, x + SIGN_PT), AxisScale(-1.0, 1.0, y + 3.0, y - 3.0)
    rect, half, one = PanelRect(across, up), np.array([0.5]), np.zeros(1)
    if isinstance(mark, Line | Rule | Ellipses | Arrows):
        dashed = getattr(mark, "dashed", False)
        return DRAWN[Line](
            rect, Line(x=np.array([0.0, 1.0]), y=np.zeros(2), colour=mark.colour, width=1.1, dashed=dashed)
        )
    if isinstance(mark, Points):
        bars: dict[str, Any] = {"half_y": one + 1.0} if mark.half_y is not None else {}
        bars |= {"half_x": one + 0.4} if mark.half_x is not None else {}
        look: dict[str, Any] = {"marker": mark.marker, "size": max(mark.size, 3.0), "open": mark.open}
        return DRAWN[Points](rect, Points(x=half, y=one, colour=mark.colour, **bars, **look))
    if isinstance(mark, Bounds):
        return DRAWN[Bounds](
            replace(rect, y=replace(up, low=0.5, high=1.0)), Bounds(x=half, y=one + 1.0, colour=mark.colour)
        )
    filled = not (isinstance(mark, Boxes) and not mark.filled)
    opacity = mark.opacity if isinstance(mark, Span) else 0.25 if isinstance(mark, Band) else 1.0
    corners = np.array([[[x, y - 2.8], [x + SIGN_PT, y - 2.8], [x + SIGN_PT, y + 2.8], [x, y + 2.8]]])
    look_of = f'fill="{mark.colour}" fill-opacity="{opacity:.3g}"' if filled else stroke(mark.colour, 0.8)
    return [path(polygons(corners), look_of)]


# Frames of panels.


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
        figure.width_in - sum(left_margins) - sum(right_margins),
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
    characters = figure.width_in / len(figure.widths) / CHARACTER_IN
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
    elif isinstance(mark, Boxes):
        yield from (mark.left, mark.right) if along_x else (mark.low, mark.high)
    elif isinstance(mark, Ellipses):
        half, values = 0.5 * np.maximum(mark.width, mark.height), mark.x if along_x else mark.y
        yield from (values - half, values + half)
    elif isinstance(mark, Image):
        yield [mark.left, mark.right] if along_x else [mark.top, mark.bottom]
    elif isinstance(mark, Line | Arrows):
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
        return values, list(map(number_text, values.tolist()))
    stride = -(-(last - first + 1) // MOST_DECADES)
    powers = range(first + (-first) % stride, last + 1, stride)
    values = 10.0 ** np.array(powers, dtype=np.float64)
    return values, list(map(power_text, powers) if any(map(exponent_of, values)) else map(number_text, values.tolist()))
