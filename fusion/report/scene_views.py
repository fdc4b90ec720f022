"""Shapes in the sensor frame, and three views of them as one SVG image.

Fills and strokes have the colour of the class `k-…` of their kind, which the page defines (templates/scene.html).
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Literal

import cv2
import numpy as np
from markupsafe import Markup

from shakercal._common.arrays import FloatArray
from shakercal._common.digits import number_text

ROUND, SIDES = 0.05, 24  # moments of inertia that differ less are those of a round body; sides that it is drawn with
THINNEST = 0.02  # smallest thickness of a body, over its largest length
WIDTH_PX, TALLEST_PX, LEFT_PX, BELOW_PX, ABOVE_PX, RIGHT_PX = 940.0, 420.0, 52.0, 36.0, 24.0, 12.0
MARGIN, LETTER_PX, LINE_PX, CLOSEST_PX = 0.06, 6.2, 13.0, 48.0
"""Margin over the largest side, sizes of letters and lines, and smallest distance of ticks."""
VIEWS = (("front, seen along +y", 0, 2, -1.0), ("side, seen along −x", 1, 2, 1.0), ("from above", 0, 1, 1.0))
"""Title, axis to the right, axis upwards, and the sign of the third axis that points at the viewer."""


@dataclass(frozen=True)
class SceneShape:
    """Shape of one kind, at rest in the sensor frame.

    `kind`: entry of the legend; `name`, `description`: with positions and units; `label`: text in the drawing. `body`:
    the body with which it moves. `faces` of a `closed` shape run counter-clockwise seen from outside; `fill`: their
    opacity. `arrow`: the first stroke ends in a head. `dots`: at the first point, or at each. `surface`: the surface
    whose deflection it has.
    """

    kind: str
    name: str
    description: str
    points_m: FloatArray
    faces: tuple[tuple[int, ...], ...] = ()
    strokes: tuple[tuple[int, ...], ...] = ()
    body: str = ""
    label: str = ""
    dots: Literal["", "one", "many"] = ""
    arrow: bool = False
    dashed: bool = False
    closed: bool = False
    fill: float = 0.0
    surface: str = ""

    @property
    def anchor(self) -> int:
        """Index of the point of the label.

        It is the head of an arrow without a dot, else the first point.
        """
        return -1 if self.arrow and not self.dots else 0


Faces = tuple[tuple[int, ...], ...]


def solid(mass_kg: float, centre_m: FloatArray, inertia_kgm2: FloatArray) -> tuple[FloatArray, Faces, Faces, str]:
    """Return points, faces, edges and name of a solid of this mass and inertia.

    Cylinder of radius r and height h: I = m·r²/2 along its axis, m·(r²/4 + h²/12) across; block of sides a, b, c: I =
    m·(b² + c²)/12 about a. A mass without inertia is a point at its centre.
    """
    moments, axes = np.linalg.eigh(inertia_kgm2)
    if mass_kg <= 0.0 or moments[2] <= 0.0:
        return centre_m[None], (), (), "a point mass"
    equal = np.abs(np.diff(moments)) <= ROUND * moments[2]
    if equal.all():
        moments, axes = np.diagonal(inertia_kgm2), np.eye(3)
    if not equal.any():
        square = 6.0 * (moments.sum() - 2.0 * moments) / mass_kg
        sides = np.sqrt(np.maximum(square, THINNEST**2 * square.max()))
        points, faces, edges = make_box(sides)
        text = "block of " + " × ".join(f"{1e3 * side:.1f}" for side in sides) + " mm"
    else:
        axis = 2 if equal[0] else 0
        radius = np.sqrt(2.0 * moments[axis] / mass_kg)
        across = np.delete(moments, axis).mean()
        height = np.sqrt(max(12.0 * (across / mass_kg - radius**2 / 4.0), (THINNEST * radius) ** 2))
        points, faces, edges = _cylinder(radius, height)
        axes = axes[:, [(axis + 1) % 3, (axis + 2) % 3, axis]]
        text = f"cylinder ⌀ {2e3 * radius:.1f} × {1e3 * height:.1f} mm"
    axes = axes * np.array([1.0, 1.0, np.linalg.det(axes)])
    return centre_m + points @ axes.T, faces, edges, f"drawn as a {text} of this inertia"


def make_box(sides: FloatArray) -> tuple[FloatArray, Faces, Faces]:
    """Return corners (8, 3) about the origin, faces and edges of a block."""
    corners = [(x, y, z) for z in (-1, 1) for x, y in ((-1, -1), (1, -1), (1, 1), (-1, 1))]
    return 0.5 * np.array(corners, dtype=np.float64) * sides, BOX_FACES, BOX_EDGES


BOX_FACES: Faces = ((3, 2, 1, 0), (4, 5, 6, 7), *((k, (k + 1) % 4, (k + 1) % 4 + 4, k + 4) for k in range(4)))
BOX_EDGES: Faces = ((0, 1, 2, 3, 0), (4, 5, 6, 7, 4), *((k, k + 4) for k in range(4)))
"""Faces and edges of a box whose lower corners run counter-clockwise seen from above, then its upper ones."""


def _cylinder(radius: float, height: float) -> tuple[FloatArray, Faces, Faces]:
    angle = 2.0 * np.pi * np.arange(SIDES) / SIDES
    ring = np.column_stack([radius * np.cos(angle), radius * np.sin(angle), np.full(SIDES, -0.5 * height)])
    points = np.concatenate([ring, ring * np.array([1.0, 1.0, -1.0])])
    low, high = tuple(range(SIDES)), tuple(range(SIDES, 2 * SIDES))
    sides = tuple((k, (k + 1) % SIDES, (k + 1) % SIDES + SIDES, k + SIDES) for k in range(SIDES))
    return points, (low[::-1], high, *sides), ((*low, 0), (*high, SIDES))


# Drawing.


@dataclass(frozen=True)
class _Panel:
    """One view: limits (2, 2) in m, lower left corner in px, and scale."""

    title: str
    axes: tuple[int, int]
    towards: float
    low_m: FloatArray
    high_m: FloatArray
    corner_px: tuple[float, float]
    scale: float

    def position_px(self, points_m: FloatArray) -> FloatArray:
        """Return points (N, 3) in px (N, 2), downwards positive."""
        flat = (points_m[:, list(self.axes)] - self.low_m) * self.scale
        return np.asarray(np.array(self.corner_px) + flat * np.array([1.0, -1.0]))

    def depth(self, points_m: FloatArray) -> float:
        """Return the mean depth of points; larger is closer to the viewer."""
        return self.towards * float(points_m[:, 3 - sum(self.axes)].mean())


def static_views(shapes: Sequence[SceneShape]) -> Markup:
    """Return the three views next to each other, to one scale, with axes in mm."""
    points = np.concatenate([shape.points_m for shape in shapes])
    low, high = points.min(axis=0), points.max(axis=0)
    margin = MARGIN * float((high - low).max()) + 1e-6
    low, high = low - margin, high + margin
    widths = [float((high - low)[view[1]]) for view in VIEWS]
    tallest = max(float((high - low)[view[2]]) for view in VIEWS)
    free = WIDTH_PX - len(VIEWS) * (LEFT_PX + RIGHT_PX)
    scale = min(free / sum(widths), TALLEST_PX / tallest)
    total = ABOVE_PX + tallest * scale + BELOW_PX
    drawn, left = [], 0.0
    for (title, right, up, towards), width in zip(VIEWS, widths, strict=True):
        axes, corner = (right, up), (left + LEFT_PX, total - BELOW_PX)
        panel = _Panel(title, axes, towards, low[list(axes)], high[list(axes)], corner, scale)
        drawn += [*_frame(panel), *_drawn(panel, shapes)]
        left += LEFT_PX + width * scale + RIGHT_PX
    size = Markup('<svg viewBox="0 0 {:.0f} {:.0f}" role="img" aria-label="{}">').format(
        left, total, "The rig from the front, from the side and from above"
    )
    return Markup("").join([size, *drawn, Markup("</svg>")])


def _frame(panel: _Panel) -> Iterator[Markup]:
    """Yield title, border and ticks of a view."""
    (x, y), size = panel.corner_px, (panel.high_m - panel.low_m) * panel.scale
    box = Markup('<rect class="edge" x="{:.1f}" y="{:.1f}" width="{:.1f}" height="{:.1f}"/>')
    yield box.format(x, y - size[1], *size)
    yield _text(x, y - size[1] - 7.0, panel.title, "title")
    letters = ["xyz"[axis] for axis in panel.axes]
    yield _text(x + size[0] / 2.0, y + 30.0, f"{letters[0]} / mm", "middle")
    vertical_label = Markup('<text class="middle" transform="translate({:.1f} {:.1f}) rotate(-90)">{} / mm</text>')
    yield vertical_label.format(x - 38.0, y - size[1] / 2.0, letters[1])
    step = _step(CLOSEST_PX / panel.scale)
    for axis, marks in enumerate(zip(panel.low_m, panel.high_m, strict=True)):
        for k in range(int(np.ceil(marks[0] / step)), int(np.floor(marks[1] / step)) + 1):
            at = (k * step - marks[0]) * panel.scale
            text = number_text(1e3 * k * step, 5).replace("-", "\N{MINUS SIGN}")
            if axis == 0:
                yield Markup('<path class="grid" d="M{:.1f} {:.1f}v{:.1f}"/>').format(x + at, y, -size[1])
                yield _text(x + at, y + 13.0, text, "middle")
            else:
                yield Markup('<path class="grid" d="M{:.1f} {:.1f}h{:.1f}"/>').format(x, y - at, size[0])
                yield _text(x - 5.0, y - at + 3.5, text, "end")


def _step(least: float) -> float:
    """Return a round tick distance of at least `least`.

    It is 1, 2 or 5 times a power of ten.
    """
    power = 10.0 ** np.floor(np.log10(least))
    return float(power * next(factor for factor in (1.0, 2.0, 5.0, 10.0) if factor * power >= least))


def _text(x: float, y: float, text: str, kind: str) -> Markup:
    return Markup('<text class="{}" x="{:.1f}" y="{:.1f}">{}</text>').format(kind, x, y, text)


def _drawn(panel: _Panel, shapes: Sequence[SceneShape]) -> Iterator[Markup]:
    """Yield the shapes of a view, the farthest first, and the labels that fit."""
    for shape in sorted(shapes, key=lambda shape: panel.depth(shape.points_m)):
        yield from _strokes(panel, shape)
    taken: list[tuple[float, float, float, float]] = []
    written = set()
    for shape in shapes:
        position = panel.position_px(shape.points_m[[shape.anchor]])[0]
        key = (shape.label, *np.round(position, 0).tolist())
        if shape.label and key not in written:
            written.add(key)
            at = _label_position(panel, position, LETTER_PX * len(shape.label), taken)
            if at is not None:
                yield _text(*at, shape.label, f"label k-{shape.kind}")


def _strokes(panel: _Panel, shape: SceneShape) -> Iterator[Markup]:
    """Yield outlines, faces, lines, arrow head and dot of a shape."""
    flat, kind = panel.position_px(shape.points_m), f"k-{shape.kind}"
    if shape.closed or shape.dots == "many":
        yield _path([_hull(flat)], kind, fill=shape.fill or 0.35, closed=True)
    elif shape.faces:
        yield _path([flat[list(face)] for face in shape.faces], kind, fill=shape.fill, closed=True)
    if shape.closed:
        edges = [_hull(flat[list(stroke)]) for stroke in shape.strokes]
        yield _path(edges, kind + (" dash" if shape.dashed else ""), closed=True)
    elif shape.strokes:
        yield _path([flat[list(stroke)] for stroke in shape.strokes], kind + (" dash" if shape.dashed else ""))
    if shape.arrow:
        foot, tip = shape.strokes[0][-2:]
        yield _head(flat[foot], flat[tip], kind)
    if shape.dots == "one":
        yield Markup('<circle class="fill {}" cx="{:.1f}" cy="{:.1f}" r="2.6"/>').format(kind, *flat[0])


def _path(lines: Sequence[FloatArray], kind: str, fill: float = 0.0, *, closed: bool = False) -> Markup:
    parts = ["M" + "L".join(f"{x:.1f} {y:.1f}" for x, y in line.tolist()) + "Z" * closed for line in lines]
    opacity = Markup(' fill-opacity="{:.2g}"').format(fill) if fill else Markup("")
    return Markup('<path class="{} {}"{} d="{}"/>').format("fill" if fill else "stroke", kind, opacity, "".join(parts))


def _head(foot: FloatArray, tip: FloatArray, kind: str) -> Markup:
    """Return the head of an arrow, empty if it points at the viewer."""
    step = tip - foot
    length = float(np.hypot(*step))
    if length < 4.0:
        return Markup("")
    back, side = tip - 7.0 * step / length, 2.8 * np.array([-step[1], step[0]]) / length
    return _path([np.stack([tip, back + side, back - side])], kind, fill=1.0, closed=True)


def _hull(points: FloatArray) -> FloatArray:
    """Return the corners of the convex hull of points (N, 2)."""
    return np.asarray(cv2.convexHull(points.astype(np.float32)).reshape(-1, 2), dtype=np.float64)


def _label_position(
    panel: _Panel, position: FloatArray, width: float, occupied: list[tuple[float, float, float, float]]
) -> tuple[float, float] | None:
    """Return a free position for a label near a point within its view, or None."""
    x, y = position.tolist()
    (left, bottom), size = panel.corner_px, (panel.high_m - panel.low_m) * panel.scale
    for dx, dy in ((5, -4), (5, 11), (-width - 5, -4), (-width - 5, 11), (-width / 2, -8), (-width / 2, 17), (5, -18)):
        box = (x + dx, y + dy - LINE_PX + 3.0, x + dx + width, y + dy + 3.0)
        inside = box[0] >= left and box[2] <= left + size[0] and box[1] >= bottom - size[1] and box[3] <= bottom
        if inside and all(box[2] <= t[0] or t[2] <= box[0] or box[3] <= t[1] or t[3] <= box[1] for t in occupied):
            occupied.append(box)
            return x + dx, y + dy
    return None
