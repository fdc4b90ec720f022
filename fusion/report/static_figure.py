"""Figures as static SVG text for pages and files."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np

from fusion.report.figure import (
    BLACK,
    Band,
    Bounds,
    Boxes,
    Ellipses,
    Figure,
    Line,
    Mark,
    Panel,
    PanelAxis,
    Points,
    Rule,
    Scale,
    Span,
    Texts,
    power_text,
)
from fusion.report.layout import (
    WIDTH_IN,
    PanelFrame,
    decade_ticks,
    frames,
    has_upright_names,
    limits,
    number_texts,
    round_ticks,
    scale_below,
)
from fusion.report.svg_marks import (
    DRAWN,
    FONT,
    HEIGHTS,
    NUMBER_PT,
    AxisScale,
    PanelRect,
    half_height,
    path,
    polygons,
    scale_colours,
    shade,
    stroke,
    strokes,
    strokes_across,
    svg_text,
    width,
)
from shaker.arrays import FloatArray

PT = 72.0
LABEL_PT, TITLE_PT, AXIS_PT, GRID_PT, TICK_PT, GRID = 8.5, 8.0, 0.7, 0.6, 3.5, "#e8e8e8"
SIGN_PT, GAP_PT, ROW_PT = 12.8, 16.0, 14.4  # of the legend: sign, gap between entries, height of a row
POWER_IN = 0.4  # room for a power of ten that is taken off the numbers of an axis
MOST_STEPS, CLOSEST_PT = 8, 11.0
"""Largest number of steps between ticks of an axis, and smallest distance of vertical ones."""


def static_svg(figure: Figure) -> str:
    """Return a figure as SVG text of the page's width; equal figures give equal text."""
    entries = dict[str, Mark]()
    for panel in figure.panels:
        for mark in panel.marks:
            if mark.label:
                entries.setdefault(mark.label, mark)
    legend, legend_pt = _legend(entries)
    parts = [f'<rect width="100%" height="100%" fill="#fff"/>{legend}']
    columns, turned = len(figure.widths), has_upright_names(figure)
    every = frames(figure, legend_pt / PT)
    for place, frame in enumerate(every):
        row, column = divmod(place, columns)
        until = every[place + 1].left - POWER_IN if column < columns - 1 else WIDTH_IN
        until -= POWER_IN if figure.panels[place].y.second is not None else 0.0
        inner = (figure.shared_x and row < len(figure.heights) - 1, figure.shared_y and column > 0)
        room = replace(_room(figure, place, frame), title=PT * (until - frame.left) - 4.0)
        parts += _panel(figure.panels[place], room, f"c{place}", inner, turned=turned)
    body = "".join(parts)
    wide, tall = f"{PT * WIDTH_IN:g}", f"{PT * figure.height_in:g}"
    head = f'width="{wide}pt" height="{tall}pt" viewBox="0 0 {wide} {tall}" fill="none" stroke-linejoin="round"'
    names = f'xmlns="http://www.w3.org/2000/svg" xmlns:xlink="http://www.w3.org/1999/xlink" font-family="{FONT}"'
    return f'<?xml version="1.0" encoding="utf-8"?>\n<svg {names} {head}>\n{body}\n</svg>\n'


def _room(figure: Figure, place: int, frame: PanelFrame) -> PanelRect:
    """Return the rectangle of a panel with the scales of its axes.

    Equal scales of both axes shrink the rectangle or widen the limits.
    """
    columns, panel = len(figure.widths), figure.panels[place]
    column = figure.panels[place % columns :: columns] if figure.shared_x else [panel]
    first = place - place % columns
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
    across = AxisScale(*x, left, left + wide, any(own.x.log for own in column))
    down = AxisScale(*y, top + tall, top, any(own.y.log for own in row))
    return PanelRect(across, down, PT * frame.left_margin, PT * frame.bottom_margin)


def _widened(ends: tuple[float, float], size: float) -> tuple[float, float]:
    """Return limits of the same centre and another size."""
    middle, half = 0.5 * (ends[0] + ends[1]), 0.5 * size * np.sign(ends[1] - ends[0])
    return float(middle - half), float(middle + half)


# Panels, axes and the legend.


def _panel(panel: Panel, room: PanelRect, name: str, inner: tuple[bool, bool], *, turned: bool) -> Iterator[str]:
    """Yield one panel; `inner`: whether another panel has its numbers of x, of y.

    `name`: identifier of its clipping path.
    """
    x, y = room.x, room.y
    size = f'x="{x.start:.2f}" y="{y.end:.2f}" width="{x.end - x.start:.2f}" height="{y.start - y.end:.2f}"'
    yield f'<clipPath id="{name}"><rect {size}/></clipPath>\n'
    across, down = _Ticks.of(panel.x, x), _Ticks.of(panel.y, y, PT * 0.5)
    for kinds in HEIGHTS:
        if not kinds and not panel.blank:
            for said, ticks, along in ((panel.x, across, "x"), (panel.y, down, "y")):
                if said.grid and not (said.names and along == "y"):
                    yield path(strokes(strokes_across(room, ticks.values, along)), stroke(GRID, GRID_PT))
        drawn = "".join(
            part for mark in panel.marks if isinstance(mark, kinds) for part in DRAWN[type(mark)](room, mark)
        )
        window = "" if kinds == (Texts,) else f' clip-path="url(#{name})"'
        yield f"<g{window}>{drawn}</g>\n" if drawn else ""
    if panel.title:
        fitting = min(TITLE_PT, room.title / width(panel.title))
        yield svg_text(x.start, y.end - 3.0, panel.title, fitting, "left")
    if panel.blank:
        return
    second = [[x.end, y.start, x.end, y.end]] if panel.y.second is not None else []
    frame = np.array([[x.start, y.start, x.start, y.end], [x.start, y.start, x.end, y.start], *second])
    yield path(strokes(frame), f'{stroke(BLACK, AXIS_PT)} stroke-linecap="square"')
    yield from _bottom(panel.x, room, across, hidden=inner[0], turned=turned)
    yield from _left(panel.y, room, down, hidden=inner[1])
    yield from _right(panel.y, room)
    scale = scale_below(panel)
    if scale is not None:
        yield from _bar(room, scale, name)


class _Ticks(NamedTuple):
    """Ticks of an axis, their texts, and the power of ten of the numbers."""

    values: FloatArray
    texts: list[str]
    power: str = ""

    @classmethod
    def of(cls, said: PanelAxis, way: AxisScale, wide: float = 0.0) -> _Ticks:
        """Return the stated ticks, or round ones that fit.

        `wide`: width for the numbers of a vertical axis, 0 for a horizontal one.
        """
        low, high, length = min(way.low, way.high), max(way.low, way.high), abs(way.end - way.start)
        if said.names:
            return cls(np.arange(len(said.names), dtype=np.float64), list(said.names))
        if said.ticks:
            values = np.array(said.ticks)
            return cls._numbers(values[(values >= low) & (values <= high)], wide)
        if way.log:
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
        # One number does not tell a scale.
        finer = (cls._numbers(round_ticks(low, high, more), wide) for more in range(steps, 2 * MOST_STEPS))
        return next((own for own in finer if len(own.values) > 1), ticks)

    @classmethod
    def _numbers(cls, values: FloatArray, wide: float) -> _Ticks:
        """Return plain numbers if they fit and are readable, else over a power of ten."""
        texts = number_texts(values)
        largest = float(np.max(np.abs(values), initial=0.0))
        power = int(np.floor(np.log10(largest))) if largest > 0.0 else 0
        long = wide > 0.0 and any(NUMBER_PT * width(text) > wide for text in texts)
        if power in (-1, 0, 1) or not (long or not -5 < power < 6):
            return cls(values, texts)
        return cls(values, number_texts(values / 10.0**power), f"×{power_text(power)}")


def _bottom(said: PanelAxis, room: PanelRect, ticks: _Ticks, *, hidden: bool, turned: bool) -> Iterator[str]:
    """Yield ticks, numbers and label below a panel."""
    at, y = room.x(ticks.values), room.y.start
    yield path(strokes(np.column_stack([at, 0 * at + y, at, 0 * at + y + TICK_PT])), stroke(BLACK, AXIS_PT))
    if hidden:
        return
    for x, text in zip(at.tolist(), ticks.texts, strict=True):
        if turned:
            yield svg_text(x + half_height(NUMBER_PT), y + 7.0, text, align="right", turned=True)
        else:
            yield svg_text(x, y + 13.5, text)
    if ticks.power:
        yield svg_text(room.right, y + 25.5, ticks.power, align="right")
    if said.label:
        yield svg_text((room.x.start + room.right) / 2.0, y + max(25.5, room.bottom_margin - 5.5), said.label, LABEL_PT)


def _left(said: PanelAxis, room: PanelRect, ticks: _Ticks, *, hidden: bool) -> Iterator[str]:
    """Yield ticks, numbers and label to the left of a panel; long numbers are smaller."""
    at, x = room.y(ticks.values), room.x.start
    yield path(strokes(np.column_stack([0 * at + x - TICK_PT, at, 0 * at + x, at])), stroke(BLACK, AXIS_PT))
    if hidden:
        return
    free, widest = room.left_margin - (8.5 if said.names else 25.0), max(map(width, ticks.texts), default=0.0)
    size = min(NUMBER_PT, max(4.0, free / widest)) if widest else NUMBER_PT
    for y, text in zip(at.tolist(), ticks.texts, strict=True):
        yield svg_text(x - 7.0, y + half_height(size), text, size, "right")
    if ticks.power:
        yield svg_text(x - 4.0, room.y.end - 4.0, ticks.power, 6.5, "right")
    if said.label:
        middle = (room.y.start + room.y.end) / 2.0
        yield svg_text(x - room.left_margin + 14.5, middle, said.label, LABEL_PT, turned=True)


def _right(said: PanelAxis, room: PanelRect) -> Iterator[str]:
    """Yield ticks, numbers and label of a second scale."""
    if said.second is None:
        return
    label, zero, factor = said.second
    way = AxisScale(factor * (room.y.low - zero), factor * (room.y.high - zero), room.y.start, room.y.end)
    ticks = _Ticks.of(PanelAxis(), way, PT * 0.45)
    at, x = way(ticks.values), room.right
    yield path(strokes(np.column_stack([0 * at + x, at, 0 * at + x + TICK_PT, at])), stroke(BLACK, AXIS_PT))
    for y, text in zip(at.tolist(), ticks.texts, strict=True):
        yield svg_text(x + 7.0, y + half_height(NUMBER_PT), text, align="left")
    if ticks.power:
        yield svg_text(x + 4.0, room.y.end - 4.0, ticks.power, 6.5, "left")
    yield svg_text(x + PT * 0.72 - 3.0, (room.y.start + room.y.end) / 2.0, label, LABEL_PT, turned=True)


def _bar(room: PanelRect, scale: Scale, name: str) -> Iterator[str]:
    """Yield a colour bar below the numbers of a panel, with numbers and label."""
    left, right, top, tall = room.x.start, room.right, room.y.start + room.bottom_margin, 7.2
    stops = scale_colours(scale)
    told = "".join(
        f'<stop offset="{k / (len(stops) - 1):.4f}" stop-color="{shade(scale, k / (len(stops) - 1))}"/>'
        for k in range(len(stops))
    )
    yield f'<linearGradient id="{name}s">{told}</linearGradient>'
    box = f'x="{left:.2f}" y="{top:.2f}" width="{right - left:.2f}" height="{tall}"'
    yield f'<rect {box} fill="url(#{name}s)" {stroke(BLACK, AXIS_PT)}/>'
    below = PanelRect(AxisScale(scale.low, scale.high, left, right, scale.log), AxisScale(0.0, 1.0, top + tall, top))
    said = PanelAxis(label=scale.label, log=scale.log)
    yield from _bottom(said, below, _Ticks.of(said, below.x), hidden=False, turned=False)


def _legend(entries: dict[str, Mark]) -> tuple[str, float]:
    """Return the legend of all marks, and the height of its rows."""
    left, end = 0.05 * PT * WIDTH_IN, PT * (WIDTH_IN - 0.1)
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
    way, up = AxisScale(0.0, 1.0, x, x + SIGN_PT), AxisScale(-1.0, 1.0, y + 3.0, y - 3.0)
    room, half, one = PanelRect(way, up), np.array([0.5]), np.zeros(1)
    if isinstance(mark, Line | Rule):
        dashed = mark.dashed
        return DRAWN[Line](
            room, Line(x=np.array([0.0, 1.0]), y=np.zeros(2), colour=mark.colour, width=1.1, dashed=dashed)
        )
    if isinstance(mark, Points):
        bars: dict[str, Any] = {"half_y": one + 1.0} if mark.half_y is not None else {}
        bars |= {"half_x": one + 0.4} if mark.half_x is not None else {}
        look: dict[str, Any] = {"marker": mark.marker, "size": max(mark.size, 3.0), "open": mark.open}
        return DRAWN[Points](room, Points(x=half, y=one, colour=mark.colour, **bars, **look))
    if isinstance(mark, Bounds):
        return DRAWN[Bounds](
            replace(room, y=replace(up, low=0.5, high=1.0)), Bounds(x=half, y=one + 1.0, colour=mark.colour)
        )
    filled = not isinstance(mark, Ellipses) and not (isinstance(mark, Boxes) and not mark.filled)
    opacity = mark.opacity if isinstance(mark, Span) else 0.25 if isinstance(mark, Band) else 1.0
    corners = np.array([[[x, y - 2.8], [x + SIGN_PT, y - 2.8], [x + SIGN_PT, y + 2.8], [x, y + 2.8]]])
    look_of = f'fill="{mark.colour}" fill-opacity="{opacity:.3g}"' if filled else stroke(mark.colour, 0.8)
    return [path(polygons(corners), look_of)]
