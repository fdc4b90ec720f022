"""Marks of a figure as SVG: positions in pt, strokes, areas and texts."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from html import escape
from itertools import groupby
from typing import Any

import numpy as np

from fusion.report.figure import (
    BLACK,
    LIGHT,
    Arrows,
    Band,
    Bounds,
    Boxes,
    Ellipses,
    Image,
    Line,
    Mark,
    Points,
    Rule,
    Scale,
    Span,
    Texts,
    jpeg_uri,
)
from shakercal._common.arrays import FloatArray

NUMBER_PT, TEXT_PT, SMALL_PT, CAP_PT = 8.0, 7.5, 5.5, 2.5
"""Sizes of numbers, texts and small texts, and width of the caps of error bars."""
MANY = 200
"""Number of points above which a line is written to a tenth of a pt."""
CAPPED = 500
"""Largest number of points whose error bars end in strokes (open markers and triangles)."""
FAR_PT = 1e4
"""Largest coordinate; positions beyond are moved to it."""
LEVELS = 64
"""Number of different colours of a scale."""
COLOURS = {
    "viridis": (
        "#440154", "#48186a", "#472d7b", "#424086", "#3b528b", "#33638d", "#2c728e", "#26828e", "#21918c", "#1fa088",
        "#28ae80", "#3fbc73", "#5ec962", "#84d44b", "#addc30", "#d8e219", "#fde725",
    ),
    "Blues": (
        "#f7fbff", "#deebf7", "#c6dbef", "#9dcae1", "#6aaed6", "#4191c6", "#2070b4", "#08509b", "#08306b",
    ),
    "RdBu": (
        "#053061", "#2065ab", "#4393c3", "#90c4dd", "#d1e5f0", "#f7f6f6", "#fddbc7", "#f3a481", "#d6604d", "#b1182b",
        "#67001f",
    ),
    "cividis": (
        "#00224e", "#123570", "#3b496c", "#575d6d", "#707173", "#8a8678", "#a59c74", "#c3b369", "#e1cc55", "#fee838",
    ),
}  # fmt: skip
"""Colours of the named scales at equal steps."""
OUTLINES: dict[str, tuple[tuple[float, float], ...]] = {
    "circle": tuple((np.cos(turn), np.sin(turn)) for turn in np.linspace(0.0, 2.0 * np.pi, 25)[:-1]),
    "square": ((-1, -1), (1, -1), (1, 1), (-1, 1)),
    "diamond": ((0, -1.414), (1.414, 0), (0, 1.414), (-1.414, 0)),
    "triangle": ((0, -1), (1, 1), (-1, 1)),
    "inverted_triangle": ((0, 1), (1, -1), (-1, -1)),
    "cross": (
        (-0.33, -1), (0.33, -1), (0.33, -0.33), (1, -0.33), (1, 0.33), (0.33, 0.33), (0.33, 1), (-0.33, 1),
        (-0.33, 0.33), (-1, 0.33), (-1, -0.33), (-0.33, -0.33),
    ),
}  # fmt: skip
"""Corners of markers in halves of their size, y downwards."""
OUTLINE_POINTS = 72  # of an ellipse
STROKES = {"x": ((-1, -1, 1, 1), (-1, 1, 1, -1)), "plus": ((-1, 0, 1, 0), (0, -1, 0, 1))}


@dataclass(frozen=True)
class AxisScale:
    """Scale of one axis: the values `low` and `high` are at `start` and `end`."""

    low: float
    high: float
    start: float
    end: float
    log: bool = False

    def __call__(self, values: Any) -> FloatArray:
        """Return positions of values; values without a logarithm are far beyond the smaller end."""
        values, low, high = np.asarray(values, dtype=np.float64), self.low, self.high
        if self.log:
            low, high = float(np.log10(low)), float(np.log10(high))
            with np.errstate(divide="ignore", invalid="ignore"):
                values = np.where(values > 0.0, np.log10(values), np.where(np.isnan(values), np.nan, -np.inf))
        with np.errstate(over="ignore"):
            share = (values - low) / (high - low)
        return np.asarray(np.clip(self.start + (self.end - self.start) * share, -FAR_PT, FAR_PT))


@dataclass(frozen=True)
class PanelRect:
    """Rectangle of a panel in pt with the scales of both axes and its margins."""

    x: AxisScale
    y: AxisScale
    left_margin: float = 0.0
    bottom_margin: float = 0.0
    title: float = 0.0

    @property
    def right(self) -> float:
        """Right end."""
        return self.x.end

    def positions(self, x: Any, y: Any) -> FloatArray:
        """Return positions (N, 2) of values (N,)."""
        return np.column_stack([self.x(x), self.y(y)])

    def contains(self, positions: FloatArray, reach: float = 0.0) -> Any:
        """Return whether positions are in the panel, or at most `reach` outside."""
        (x, y), (a, b, c, d) = positions.T, (self.x.start, self.x.end, self.y.end, self.y.start)
        return (x >= a - reach) & (x <= b + reach) & (y >= c - reach) & (y <= d + reach)


# Parts of a drawing.

FONT = "DejaVu Sans, Verdana, Arial, sans-serif"
NARROW, WIDE = " .,:;'|!ijl()[]/−-ftrI⁻", "mwMW±%@∂∫"


def svg_text(x: float, y: float, text: str, size: float = NUMBER_PT, align: str = "center", **look: Any) -> str:
    """Return a text with its base line at `y` (at `x` if `upright`)."""
    turn = f' transform="rotate(-90 {x:.2f} {y:.2f})"' if look.get("upright") else ""
    anchor = {"left": "start", "center": "middle", "right": "end"}[align]
    attributes = (
        f'x="{x:.2f}" y="{y:.2f}" font-size="{size:.3g}" text-anchor="{anchor}" fill="{look.get("colour", BLACK)}"'
    )
    return f"<text {attributes}{turn}>{escape(text)}</text>"


def width(text: str) -> float:
    """Return the approximate width of a text over its letter size."""
    return sum(0.36 if letter in NARROW else 0.94 if letter in WIDE else 0.63 for letter in text)


def half_height(size: float) -> float:
    """Return the distance from a text's base line to its middle."""
    return 0.365 * size


def stroke(colour: str, width: float, *, dashed: bool = False) -> str:
    """Return the attributes of a line.

    Dashes are five times as long as the line is wide.
    """
    dash = f' stroke-dasharray="{5.0 * width:.3g} {3.0 * width:.3g}"' if dashed else ""
    return f'stroke="{colour}" stroke-width="{width:.3g}"{dash}'


def path(d: str, look: str) -> str:
    """Return a path element with its attributes, empty for an empty path."""
    return f'<path d="{d}" {look}/>' if d else ""


def strokes(ends: FloatArray) -> str:
    """Return the path of straight strokes (N, 4) from x, y to x, y."""
    rows = ends[np.isfinite(ends).all(axis=1)].tolist()
    return "".join(f"M{a:.2f} {b:.2f}L{c:.2f} {d:.2f}" for a, b, c, d in rows)


def _chain(positions: FloatArray) -> str:
    """Return the path through positions (N, 2), interrupted at NaN."""
    parts, digits = [], 1 if len(positions) > MANY else 2
    for is_finite, run in groupby(positions.tolist(), lambda point: point[0] == point[0] and point[1] == point[1]):
        if is_finite:
            points = [f"{x:.{digits}f} {y:.{digits}f}" for x, y in run]
            parts.append("M" + "L".join(points) + ("h0" if len(points) == 1 else ""))
    return "".join(parts)


def polygons(corners: FloatArray) -> str:
    """Return the path of polygons (N, C, 2)."""
    finite = corners[np.isfinite(corners).all(axis=(1, 2))].tolist()
    return "".join("M" + "L".join(f"{x:.2f} {y:.2f}" for x, y in polygon) + "Z" for polygon in finite)


def _signs(positions: FloatArray, marker: str, size: float, colour: str, *, edge: float, empty: bool = False) -> str:
    """Return markers at positions (N, 2), filled unless `empty`."""
    half = 0.5 * size
    if marker in STROKES:
        attributes = half * np.array(STROKES[marker], dtype=np.float64)
        ends = (np.tile(positions, 2)[:, None, :] + attributes).reshape(-1, 4)
        return path(strokes(ends), stroke(colour, edge or 1.0))
    if marker == "circle" and not empty:
        rows = positions[np.isfinite(positions).all(axis=1)].tolist()
        dots = "".join(f"M{x:.1f} {y:.1f}h0" for x, y in rows)
        return path(dots, f'{stroke(colour, size)} stroke-linecap="round"')
    border, filling = f" {stroke(colour, edge)}" if edge else "", "none" if empty else colour
    outline = half * np.array(OUTLINES[marker])
    return path(polygons(positions[:, None, :] + outline), f'fill="{filling}"{border}')


# Colours of values.


def shade(scale: Scale, share: float) -> str:
    """Return the colour at a share of a scale."""
    names = COLOURS[scale.colours] if isinstance(scale.colours, str) else scale.colours
    stops = np.array([[int(name[k : k + 2], 16) for k in (1, 3, 5)] for name in names], dtype=np.float64)
    at = share * (len(stops) - 1)
    return "#" + "".join(f"{round(float(np.interp(at, range(len(stops)), part))):02x}" for part in stops.T)


def _shaded(scale: Scale, values: FloatArray) -> Iterator[tuple[str, Any]]:
    """Yield every colour of some values with a mask of these; NaN is grey."""
    axis_scale = AxisScale(scale.low, scale.high, 0.0, 1.0, scale.log)
    share = np.clip(axis_scale(values), 0.0, 1.0)
    level = np.where(np.isnan(share), -1.0, np.round(share * (LEVELS - 1)))
    for one in np.unique(level).tolist():
        yield (LIGHT if one < 0.0 else shade(scale, one / (LEVELS - 1))), level == one


# One function per kind of mark.


def _line(rect: PanelRect, mark: Line) -> Iterator[str]:
    positions = rect.positions(mark.x, mark.y)
    if mark.step and len(positions):
        positions = np.repeat(positions, 2, axis=0)
        positions = np.column_stack([positions[1:, 0], positions[:-1, 1]])
    yield path(_chain(positions), stroke(mark.colour, mark.width, dashed=mark.dashed))


def _points(rect: PanelRect, mark: Points) -> Iterator[str]:
    positions = rect.positions(mark.x, mark.y)
    seen = rect.contains(positions, mark.size)
    if mark.values is not None and mark.scale is not None:
        for colour, which in _shaded(mark.scale, mark.values):
            yield _signs(positions[which & seen], mark.marker, mark.size, colour, edge=0.0)
        return
    bars, caps = [np.empty((0, 4))], [np.empty((0, 4))]
    for half, cap, along in ((mark.half_x, (0.0, CAP_PT), "x"), (mark.half_y, (CAP_PT, 0.0), "y")):
        if half is not None:
            shift = (half, 0.0) if along == "x" else (0.0, half)
            low, high = (rect.positions(mark.x + sign * shift[0], mark.y + sign * shift[1]) for sign in (-1.0, 1.0))
            bars.append(np.hstack([low, high]))
            caps += [np.hstack([end - cap, end + cap]) for end in (low, high)]
    look = stroke(mark.colour, 1.0)
    yield path(strokes(np.concatenate(bars)), look)
    edge = 0.0 if not mark.open and mark.marker in ("circle", "square", "diamond") else 1.0
    yield path(strokes(np.concatenate(caps)), look) if edge and len(positions) <= CAPPED else ""
    yield _signs(positions[seen], mark.marker, mark.size, mark.colour, edge=edge, empty=mark.open)


def _bounds(rect: PanelRect, mark: Bounds) -> Iterator[str]:
    share = (0.5, 1.0) if mark.along == "x" else (1.0, 0.5)
    start, end = rect.positions(mark.x, mark.y), rect.positions(share[0] * mark.x, share[1] * mark.y)
    yield path(strokes(np.hstack([start, end])), stroke(mark.colour, 1.0))
    yield _heads(start, end, 5.0, mark.colour)


def _heads(start: FloatArray, end: FloatArray, size: float, colour: str) -> str:
    """Return the heads of arrows between positions (N, 2)."""
    along = end - start
    length = np.hypot(*along.T)[:, None]
    with np.errstate(divide="ignore", invalid="ignore"):
        ahead = along / length * np.minimum(size, 0.5 * length)
    across = 0.4 * ahead[:, ::-1] * [-1.0, 1.0]
    return path(polygons(np.stack([end, end - ahead + across, end - ahead - across], 1)), f'fill="{colour}"')


def _band(rect: PanelRect, mark: Band) -> Iterator[str]:
    low, high = rect.positions(mark.x, mark.low), rect.positions(mark.x, mark.high)
    finite = np.isfinite(low).all(axis=1) & np.isfinite(high[:, 1])
    ends = np.flatnonzero(np.diff(np.concatenate([[False], finite, [False]]).astype(int))).reshape(-1, 2)
    areas = [np.concatenate([low[a:b], high[a:b][::-1]]) for a, b in ends]
    yield path("".join(polygons(area[None]) for area in areas), f'fill="{mark.colour}" fill-opacity="0.25"')


def strokes_across(rect: PanelRect, values: Any, along: str) -> FloatArray:
    """Return strokes (N, 4) across the whole panel at values of x or y."""
    at = (rect.x if along == "x" else rect.y)(values)
    axis_scale = rect.y if along == "x" else rect.x
    start, end = np.full_like(at, axis_scale.start), np.full_like(at, axis_scale.end)
    return np.column_stack([at, start, at, end] if along == "x" else [start, at, end, at])


def _span(rect: PanelRect, mark: Span) -> Iterator[str]:
    (a, b, c, d), (e, f, g, h) = strokes_across(rect, [mark.low, mark.high], mark.along).tolist()
    opacity = f'fill="{mark.colour}" fill-opacity="{mark.opacity:.3g}"'
    yield path(polygons(np.array([[[a, b], [c, d], [g, h], [e, f]]])), opacity)


def _rule(rect: PanelRect, mark: Rule) -> Iterator[str]:
    yield path(strokes(strokes_across(rect, mark.at, mark.along)), stroke(mark.colour, mark.width, dashed=mark.dashed))


def _boxes(rect: PanelRect, mark: Boxes) -> Iterator[str]:
    x, y = [mark.left, mark.left, mark.right, mark.right], [mark.low, mark.high, mark.high, mark.low]
    corners = np.stack([rect.x(np.stack(x, 1)), rect.y(np.stack(y, 1))], 2)
    if mark.values is not None and mark.scale is not None:
        for colour, which in _shaded(mark.scale, mark.values):
            yield path(polygons(corners[which]), f'fill="{colour}" {stroke(colour, 0.2)}')
    else:
        yield path(polygons(corners), f'fill="{mark.colour}"' if mark.filled else stroke(mark.colour, 0.5))


def _texts(rect: PanelRect, mark: Texts) -> Iterator[str]:
    positions = rect.positions(mark.x, mark.y)
    seen = rect.contains(positions, 0.5)
    positions += np.array([mark.offset_px[0], -mark.offset_px[1]])
    for (x, y), shown, text in zip(positions.tolist(), seen, mark.texts, strict=True):
        if shown and mark.upright:
            side = {"left": 0.73, "center": 0.365, "right": 0.0}[mark.align] * SMALL_PT
            yield svg_text(x + side, y, text, SMALL_PT, "left", upright=True, colour=mark.colour)
        elif shown:
            yield svg_text(x, y + half_height(TEXT_PT), text, TEXT_PT, mark.align, colour=mark.colour)


def _ellipses(rect: PanelRect, mark: Ellipses) -> Iterator[str]:
    turn = np.exp(1j * np.linspace(0.0, 2.0 * np.pi, OUTLINE_POINTS, endpoint=False))
    halves = 0.5 * (mark.width[:, None] * turn.real + 1j * mark.height[:, None] * turn.imag)
    outline = (mark.x + 1j * mark.y)[:, None] + halves * np.exp(1j * mark.angle_rad)[:, None]
    corners = np.stack([rect.x(outline.real), rect.y(outline.imag)], 2)
    yield path(polygons(corners), stroke(mark.colour, 1.1))


def _arrows(rect: PanelRect, mark: Arrows) -> Iterator[str]:
    start, end = rect.positions(mark.x, mark.y), rect.positions(mark.x + mark.dx, mark.y + mark.dy)
    yield path(strokes(np.hstack([start, end])), stroke(mark.colour, 0.8))
    yield _heads(start, end, 4.0, mark.colour)


def _image(rect: PanelRect, mark: Image) -> Iterator[str]:
    (left, top), (right, bottom) = rect.positions([mark.left, mark.right], [mark.top, mark.bottom]).tolist()
    size = f'width="{right - left:.2f}" height="{bottom - top:.2f}" preserveAspectRatio="none"'
    yield f'<image x="{left:.2f}" y="{top:.2f}" {size} href="{jpeg_uri(mark.grey)}"/>'


DRAWN: dict[type[Mark], Callable[[PanelRect, Any], Iterator[str]]] = {
    Line: _line,
    Points: _points,
    Bounds: _bounds,
    Band: _band,
    Span: _span,
    Rule: _rule,
    Boxes: _boxes,
    Texts: _texts,
    Ellipses: _ellipses,
    Arrows: _arrows,
    Image: _image,
}
HEIGHTS = ((Image, Span), (), (Band, Boxes), (Line, Rule, Bounds, Ellipses, Arrows), (Points,), (Texts,))
"""Drawing order of marks, lowest first; the grid is the second."""
