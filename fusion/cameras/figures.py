"""Figures of a calibration: from where the target was seen, what was found (lens, target) and what is left over."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from typing import Any

import numpy as np
from matplotlib import colormaps
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.collections import PatchCollection, PolyCollection
from matplotlib.colors import BoundaryNorm
from matplotlib.figure import Figure
from matplotlib.patches import Rectangle
from matplotlib.patheffects import withStroke
from matplotlib.ticker import MaxNLocator
from scipy.spatial import ConvexHull, QhullError

from fusion.cameras.quantities import (
    SIDES,
    Distortion,
    Side,
    camera_of,
    cell_px,
    correlation,
    covariance_of,
    distortion,
    empty_cells,
    pictures,
    residual_map,
    target_middles_m,
    target_shape,
    tilts_rad,
    turns_rad,
    used_points,
)
from fusion.report.figure import BLACK, BLUE, GREY, LIGHT, ORANGE, RED, padded
from fusion.report.style import (
    RASTER_ABOVE,
    WIDTH_IN,
    Picture,
    Sheet,
    decades,
    finish,
    lay_out,
    panel_label,
    sheet,
    square_corners,
)
from fusion.report.table import signed
from photogram.calibration.result import Calibration
from photogram.camera import LEFT, RIG_PARAMETERS, RIGHT, ROTATION, TRANSLATION, Camera
from shaker.arrays import FloatArray, IntArray

MARGIN_IN, BETWEEN_IN, TOP_IN, AXIS_IN = (0.62, 0.12), 0.55, 0.28, 0.42
"""Left and right margin, gap between panels, room for a label above and for an axis below."""
FLATTEST_IN, TALLEST_IN = 1.2, 4.5
KEY_IN, BAR_IN = 0.2, 0.55
"""Room below the axis for the key of arrows, and for a colour bar."""
ARROW_WIDTH = 0.0035  # of a panel's width; thinner where there are many
KEPT = 0.98  # quantile of the arrows' lengths that sets their scale
ELLIPSE_QUANTILE = 2.448
"""Half axes, in standard uncertainties, of the ellipse that holds two coordinates with 95 %: √χ²(0.95; 2)."""
LEVELS = 8
"""Numbers of parameters after which another group begins: left camera, right camera, rotation, translation."""
STRONG = 0.9  # coefficient from which on it is written into the figure
MEAN_QUANTILE = 1.731
"""Length of a mean of noise, in units of its rms length, that one in twenty exceeds: √(−ln 0.05)."""
LONGEST_SHARE = 0.04  # of the picture's width, of the longest arrow
SIDE_COLOUR = {"left": BLUE, "right": ORANGE}
INK = {"left": "white", "right": BLACK}
MOST_NAMES = 8  # dropped pictures that are named in the figure
LONGEST_NAME = 16
BINS = 40
CIRCLES_DEG = 15.0  # between the circles of the tilts
LEAST_TURN_DEG, LEAST_DISTANCE_SHARE = 40.0, 0.2
"""Least spans of the axes of turn and, of its median, of distance: views that are alike shall look so."""
NUMBER_PT = np.array([9.0, 7.0])  # room that the number of a view takes
POINTS_DRAWN = 8000.0  # from this number on points are drawn at their smallest
HALO = [withStroke(linewidth=1.8, foreground="white")]


@contextmanager
def picture_sheet(name: str, count: int, size_px: IntArray, below_in: float = 0.0) -> Iterator[Sheet]:
    """Give a figure of the page's width with laid out panels side by side that show one picture area each, to scale."""
    width = (WIDTH_IN - sum(MARGIN_IN) - (count - 1) * BETWEEN_IN) / count
    height = float(np.clip(width * size_px[1] / size_px[0], FLATTEST_IN, TALLEST_IN))
    bottom = AXIS_IN + below_in
    with sheet(name, height + TOP_IN + bottom, 1, count) as drawn:
        for axes in drawn.panels:
            axes.set_xlim(-0.5, size_px[0] - 0.5)
            axes.set_ylim(size_px[1] - 0.5, -0.5)  # y down
            axes.set_aspect("equal")
            axes.set_xlabel("x / px")
            bordered(axes)
        drawn.panels[0].set_ylabel("y / px")
        left, right = MARGIN_IN
        layout: dict[str, Any] = {"left": left, "right": right, "bottom": bottom, "top": TOP_IN, "label": 0.48}
        lay_out(drawn.panels, gap=(BETWEEN_IN, 0.1), **layout)
        yield drawn


def bordered(axes: Axes) -> None:
    """A border on all sides and no grid."""
    axes.grid(visible=False)
    axes.spines[["top", "right"]].set_visible(True)


def view_colours(count: int) -> FloatArray:
    """Colours (count, 4) of the views in their order."""
    return np.asarray(colormaps["viridis"](np.linspace(0.0, 0.92, count)))


def arrows(axes: Axes, place: FloatArray, vector: FloatArray, longest: float, colour: Any, unit: str) -> None:
    """Arrows (N, 2) at places (N, 2), nearly the longest drawn `longest` data units long, with their key below."""
    if not len(place):
        return
    size = float(np.quantile(np.hypot(vector[:, 0], vector[:, 1]), KEPT)) or 1.0
    scale: dict[str, Any] = {"angles": "xy", "scale_units": "xy", "scale": size / longest, "headwidth": 3.5}
    many = len(place) > RASTER_ABOVE
    width = ARROW_WIDTH * min(1.0, (RASTER_ABOVE / len(place)) ** 0.5)
    axes.quiver(*np.hstack([place, vector]).T, color=colour, width=width, rasterized=many, **scale)
    lone = axes.quiver(*place[:1].T, [0.0], [0.0], width=ARROW_WIDTH, **scale)
    key = float(f"{size:.1g}")
    low = -(AXIS_IN + 0.07) / height_in(axes)
    axes.quiverkey(lone, 0.5, low, key, f"{key:g} {unit}", labelpos="E", labelsep=0.06, color=BLACK)
    lone.set_visible(False)


def colour_bar(axes: Axes, drawn: ScalarMappable, label: str) -> Axes:
    """Horizontal colour bar below a panel's axis."""
    height = height_in(axes)
    place = axes.inset_axes((0.0, -(AXIS_IN + 0.14) / height, 1.0, 0.1 / height))
    axes.figure.colorbar(drawn, cax=place, orientation="horizontal")
    place.set_xlabel(label)
    place.grid(visible=False)
    return place


def height_in(axes: Axes) -> float:
    """Height of a panel as laid out."""
    return float(axes.get_position(original=True).height * figure_of(axes).get_size_inches()[1])


def figure_of(axes: Axes) -> Figure:
    """Figure that a panel belongs to."""
    figure = axes.get_figure(root=True)
    if figure is None:
        raise ValueError("axes: expected a panel of a figure")
    return figure


def two_digits(value: float) -> str:
    """Two significant digits without an exponent."""
    known = np.isfinite(value) and value != 0.0
    places = max(0, 1 - int(f"{value:.1e}".partition("e")[2])) if known else 0
    return signed(value, f".{places}f")


def draw_coverage(calibration: Calibration) -> Picture:
    """All points of both cameras in their picture areas; cells without a point are grey."""
    rig = calibration.rig
    with picture_sheet("coverage", 2, np.maximum(rig.left.size_px, rig.right.size_px)) as drawn:
        for axes, side in zip(drawn.panels, SIDES, strict=True):
            size = camera_of(rig, side)[0].size_px
            position, _, view = used_points(calibration, side)
            cells = empty_cells(position, size)
            patches = [Rectangle((x0, y0), x1 - x0, y1 - y0) for x0, y0, x1, y1 in cells]
            axes.add_collection(PatchCollection(patches, facecolor=LIGHT, edgecolor="white", linewidth=0.6))
            colours = view_colours(len(calibration.views))
            size_pt, many = np.clip(POINTS_DRAWN / len(view), 2.0, 7.0), len(view) > RASTER_ABOVE
            axes.scatter(position[:, 0], position[:, 1], s=size_pt, c=colours[view], linewidths=0.0, rasterized=many)
            left_out = [p.position_px[~p.used] for p in pictures(calibration, side) if p is not None]
            crosses = np.concatenate([np.empty((0, 2)), *left_out])
            axes.plot(*crosses.T, "x", color=RED, markersize=3.5, markeredgewidth=0.9)
            away = np.linalg.norm(position - position.mean(axis=0), axis=1)
            seen = np.unique(view)
            _number(axes, position[[np.argmax(np.where(view == number, away, -1.0)) for number in seen]], seen)
            share = calibration.covered[SIDES.index(side)]
            panel_label(axes, f"{side} camera: {len(view)} points, {100 * share:.0f} % of the picture covered")
        caption = (
            "Found points over the picture area of either camera, one colour per view in the order of the session, "
            "numbers at outermost points where there is room; red crosses are points left out. Grey cells hold no "
            "point: there the lens distortion is extrapolated. A good session reaches all corners."
        )
        return finish(drawn.figure, drawn.name, "Where the target was seen", caption)


def draw_views(calibration: Calibration) -> Picture:
    """Tilt, turn and distance of the target in every view, and the scene from above."""
    with sheet("views", 3.0, 1, 3) as drawn:
        panels = drawn.panels
        colours = view_colours(len(calibration.views))
        tilt = np.degrees(tilts_rad(calibration))
        _draw_tilts(panels[0], float(np.hypot(*tilt.T).max()))
        distance = 1e3 * np.linalg.norm(target_middles_m(calibration), axis=1)
        turn = np.degrees(turns_rad(calibration))
        panels[1].set_xlim(*_at_least(turn, LEAST_TURN_DEG))
        panels[1].set_ylim(*_at_least(distance, LEAST_DISTANCE_SHARE * float(np.median(distance))))
        panels[1].set_xlabel("turn in the left picture / °")
        panels[1].set_ylabel("distance from the left camera / mm")
        _draw_scene(panels[2], calibration, colours)
        lay_out(panels, left=0.62, top=0.28, gap=(0.72, 0.1), label=0.5)
        _mark(panels[0], tilt, colours)
        _mark(panels[1], np.stack([turn, distance], axis=1), colours)
        caption = (
            "Left: direction and angle by which the target's normal is tilted off the left camera's axis; views with "
            "the same tilt add little, and focal length and distance are told apart by tilts of 30° and more in "
            "several directions. Middle: turn of the target about the camera's axis, and its distance. Right: the "
            "scene in the plane of the baseline and the left camera's axis, with the optical axes dashed and the "
            "target's outline."
        )
        return finish(drawn.figure, drawn.name, "How the target was held", caption)


def _draw_tilts(axes: Axes, largest: float) -> None:
    """Circles of equal angle for tilts in degrees up to the largest."""
    reach = CIRCLES_DEG * max(2.0, np.ceil(1.02 * largest / CIRCLES_DEG))
    angle = np.linspace(0.0, 2.0 * np.pi, 121)
    for radius in np.arange(CIRCLES_DEG, reach + 1.0, CIRCLES_DEG):
        axes.plot(radius * np.cos(angle), radius * np.sin(angle), color=LIGHT, linewidth=0.7, zorder=1)
        axes.text(0.707 * radius, -0.707 * radius, f"{radius:.0f}°", fontsize=6.5, color=GREY, path_effects=HALO)
    for line in (axes.axhline, axes.axvline):
        line(0.0, color=LIGHT, linewidth=0.7, zorder=1)
    axes.set_xlim(-1.05 * reach, 1.05 * reach)
    axes.set_ylim(1.05 * reach, -1.05 * reach)
    axes.set_aspect("equal")
    axes.grid(visible=False)
    axes.set_xlabel("tilt to the right / °")
    axes.set_ylabel("tilt down / °")


def _draw_scene(axes: Axes, calibration: Calibration, colours: FloatArray) -> None:
    """Cameras, optical axes and targets in the plane of the baseline and the left camera's axis."""
    right = calibration.rig.right_from_left
    centre, axis = -right.rotation.T @ right.translation_m, right.rotation[2]
    across = centre * [1.0, 1.0, 0.0]
    across = across / np.linalg.norm(across) if np.linalg.norm(across) > 0 else np.array([1.0, 0.0, 0.0])
    plane = 1e3 * np.stack([across, [0.0, 0.0, 1.0]])
    (x0, y0, z0), (x1, y1, z1) = calibration.shape_m.min(axis=0), calibration.shape_m.max(axis=0)
    middle = 0.5 * (z0 + z1)
    outline = np.array([[x, y, middle] for x, y in ((x0, y0), (x1, y0), (x1, y1), (x0, y1), (x0, y0))])
    for view, colour in zip(calibration.views, colours, strict=True):
        target = plane @ view.left_from_target.apply(outline).T
        axes.plot(*target, color=colour, linewidth=1.0, solid_capstyle="round")
    reach = 1.15 * float(np.linalg.norm(target_middles_m(calibration), axis=1).max())
    for name, place, direction in (("left", np.zeros(3), np.array([0.0, 0.0, 1.0])), ("right", centre, axis)):
        ends = plane @ np.stack([place, place + reach * direction]).T
        axes.plot(*ends, color=GREY, linewidth=0.8, linestyle=(0, (5, 3)), zorder=1)
        axes.plot(*ends[:, 0], marker="s", color=BLACK, markersize=5.0)
        axes.annotate(name, ends[:, 0], (0.0, -6.0), textcoords="offset points", ha="center", va="top", fontsize=7.5)
    axes.margins(0.12)
    axes.set_aspect("equal", adjustable="datalim")
    axes.set_xlabel("along the baseline / mm")
    axes.set_ylabel("along the left axis / mm")


def _mark(axes: Axes, place: FloatArray, colours: FloatArray) -> None:
    """A disc per view at places (V, 2), with its number beside it; axes that have their limits."""
    axes.scatter(place[:, 0], place[:, 1], s=22.0, c=colours, linewidths=0.0, zorder=3)
    _number(axes, place, range(len(place)))


def _number(axes: Axes, place: FloatArray, views: Iterable[int]) -> None:
    """Numbers of views, counted from 1, beside places (V, 2), as far as they do not cover each other."""
    taken = np.empty((0, 2))
    for point, view in zip(place, views, strict=True):
        shown = axes.transData.transform(point) * 72.0 / figure_of(axes).dpi
        if (np.abs(taken - shown) < NUMBER_PT).all(axis=1).any():
            continue
        taken = np.vstack([taken, shown])
        look: dict[str, Any] = {"fontsize": 6.5, "path_effects": HALO, "zorder": 4}
        axes.annotate(str(view + 1), (float(point[0]), float(point[1])), (3.5, 2.0), textcoords="offset points", **look)


def _at_least(values: FloatArray, span: float) -> tuple[float, float]:
    """Limits that hold values with some room and span at least so much, so that alike looks alike."""
    low, high = padded(float(values.min()), float(values.max()))
    room = max(0.0, 0.5 * (span - (high - low)))
    return low - room, high + room


def draw_distortion(calibration: Calibration, side: Side) -> Picture:
    """Displacement by the lens with its uncertainty over the picture, and the principal point."""
    camera, covariance = camera_of(calibration.rig, side)
    field = distortion(calibration, side)
    seen = used_points(calibration, side)[0]
    try:
        corners = ConvexHull(seen).vertices
        seen = seen[[*corners, corners[0]]]
    except (QhullError, ValueError):
        pass  # points that span no area are their own outline
    with picture_sheet(f"distortion-{side}", 3, camera.size_px, BAR_IN) as drawn:
        panels = drawn.panels
        length = np.linalg.norm(field.displacement_px, axis=-1)
        _draw_contours(panels[0], field, length, "displacement / px", log=False)
        some = (slice(2, None, 4), slice(2, None, 4))  # directions on a coarse grid
        place, vector = field.pixel[some].reshape(-1, 2), field.displacement_px[some].reshape(-1, 2)
        known = np.isfinite(vector).all(axis=1)
        longest = float(np.hypot(*vector[known].T).max(initial=0.0)) or 1.0
        reach = 3.5 * float(field.pixel[0, 1, 0] - field.pixel[0, 0, 0])
        scale: dict[str, Any] = {"angles": "xy", "scale_units": "xy", "scale": longest / reach, "headwidth": 3.5}
        panels[0].quiver(*place[known].T, *vector[known].T, color="white", width=0.006, **scale)
        panels[0].plot(*camera.parameters[2:4], "+", color="white", markersize=7.0)
        _draw_contours(panels[1], field, field.u_px, "standard uncertainty / px", log=True)
        for axes in panels[:2]:
            axes.plot(*seen.T, color=RED, linewidth=1.0, linestyle="--")
        panel_label(panels[0], f"displacement by distortion, up to {two_digits(np.nanmax(length))} px")
        panel_label(panels[1], f"its u, up to {two_digits(np.nanmax(field.u_px))} px")
        _draw_principal_point(panels[2], camera, covariance[2:4, 2:4])
        caption = (
            "Left: how far the lens moves points off where one without distortion would show them; the arrows give the "
            "direction, the cross is the principal point. Middle: standard uncertainty u (k = 1) per coordinate of "
            "that displacement, from the covariance of all nine parameters. Outside the dashed outline no point was "
            "seen and the distortion is extrapolated. Right: the principal point, against the middle of the picture, "
            "with the ellipse that holds it with 95 %."
        )
        return finish(drawn.figure, drawn.name, f"Lens distortion of the {side} camera", caption)


def draw_correlation(calibration: Calibration) -> Picture:
    """Correlation coefficients of all parameters of the pair."""
    covariance = covariance_of(calibration.rig)
    further = np.diagonal(covariance)[TRANSLATION.stop :] > 0
    kept = np.concatenate([np.ones(TRANSLATION.stop, np.bool_), further])
    groups = [places[kept[places]] for places in (LEFT, RIGHT, np.r_[ROTATION], np.r_[TRANSLATION])]
    order = np.concatenate(groups)
    coefficients = correlation(covariance[np.ix_(order, order)])
    names = [RIG_PARAMETERS[place].replace(".", " ") for place in order]
    with sheet("correlation", 6.9) as drawn:
        (axes,) = drawn.panels
        shown = axes.imshow(coefficients, cmap=colormaps["RdBu_r"].with_extremes(bad=LIGHT), vmin=-1.0, vmax=1.0)
        for edge in np.cumsum([len(group) for group in groups[:-1]]):
            axes.axhline(edge - 0.5, color=BLACK, linewidth=0.7)
            axes.axvline(edge - 0.5, color=BLACK, linewidth=0.7)
        axes.set_xticks(range(len(names)), names, rotation=90, fontsize=7.0)
        axes.set_yticks(range(len(names)), names, fontsize=7.0)
        for i, j in np.argwhere(np.abs(coefficients) >= STRONG):
            if i != j:
                text = signed(np.trunc(100 * coefficients[i, j]), ".0f")
                axes.text(j, i, text, ha="center", va="center", fontsize=5.5, color="white")
        bordered(axes)
        axes.tick_params(length=2.0)
        bar = drawn.figure.colorbar(shown, cax=axes.inset_axes((1.03, 0.0, 0.025, 1.0)))
        bar.set_label("correlation coefficient")
        caption = (
            f"Coefficients beyond ±{STRONG:g} are written in hundredths. Parameters that answer for each other, "
            "as k1, k2 and k3, or principal point and tangential distortion, are each less certain than what they do "
            "together: judge them by the uncertainty of the distortion. Grey: held fixed."
        )
        margins = {"left": 1.1, "right": 1.1, "bottom": 0.95, "top": 0.1}
        return drawn.picture("Correlation of the parameters", caption, label=0.52, **margins)


def draw_shape(calibration: Calibration) -> Picture | None:
    """Height and in-plane departure of the target's points; None for a target held flat."""
    shape = target_shape(calibration)
    if shape is None:
        return None
    extent = 1e3 * np.ptp(shape.lattice_m, axis=0) + 4e3 * calibration.target.spacing_m
    spacing_mm = 1e3 * calibration.target.spacing_m
    with picture_sheet("shape", 2, extent, BAR_IN) as drawn:
        panels, corners = drawn.panels, square_corners(1e3 * shape.lattice_m, 0.94 * spacing_mm)
        squares = PolyCollection(list(corners), linewidth=0.0, cmap="viridis")
        squares.set_array(1e6 * shape.height_m)
        squares.set_rasterized(len(shape.height_m) > RASTER_ABOVE)
        panels[0].add_collection(squares)
        colour_bar(panels[0], squares, "height / µm")
        low, high = (two_digits(1e6 * end) for end in (shape.height_m.min(), shape.height_m.max()))
        panel_label(panels[0], f"height, from {low} to {high} µm")
        arrows(panels[1], 1e3 * shape.lattice_m, 1e6 * shape.inside_m, 1.5 * spacing_mm, BLUE, "µm")
        inside = np.hypot(*shape.inside_m.T)
        panel_label(panels[1], f"in the plane, rms {two_digits(1e6 * float(np.sqrt(np.mean(inside**2))))} µm")
        corner = 1e3 * shape.lattice_m.min(axis=0) - 2.0 * spacing_mm
        for axes in panels:
            axes.set_xlim(corner[0], corner[0] + extent[0])
            axes.set_ylim(corner[1], corner[1] + extent[1])
            axes.set_xlabel("x / mm")
        panels[0].set_ylabel("y / mm")
        caption = (
            "Estimated positions of the target's points against a flat lattice of the stated spacing, laid onto it as "
            "a rigid body, in the target's frame. Left: out of the plane; right: in it, strongly enlarged "
            "(arrow below). A bow tells a bent plate, a gradient in the plane a print with unequal scales."
        )
        return finish(drawn.figure, drawn.name, "Shape of the target", caption)


def _draw_contours(axes: Axes, field: Distortion, values: FloatArray, label: str, *, log: bool) -> None:
    """Filled contours over the picture with their colour bar, at equal steps or at 1, 2, 5, 10."""
    known = np.ma.masked_invalid(values)
    levels = np.asarray(MaxNLocator(LEVELS).tick_values(0.0, known.max()))
    if log:  # from below the lowest to above the highest, at most the last two decades
        low = max(float(known.min()), 1e-2 * float(known.max()), 1e-12)
        high = max(float(known.max()), 2.0 * low)
        decade = np.arange(np.floor(np.log10(low)), np.ceil(np.log10(high)) + 1)
        every = np.multiply.outer(10.0**decade, [1.0, 2.0, 5.0]).ravel()
        levels = every[np.searchsorted(every, low, "right") - 1 : np.searchsorted(every, high) + 1]
    place = field.pixel[0, :, 0], field.pixel[:, 0, 1], np.maximum(known, levels[0])
    scale = BoundaryNorm(levels, 256)
    shown = axes.contourf(*place, levels=levels, cmap="viridis", norm=scale)
    axes.contour(*place, levels=levels[1:], colors="white", linewidths=0.4)
    bar = colour_bar(axes, shown, label)
    bar.set_xticks(levels[:: 1 + len(levels) // 8], [f"{level:g}" for level in levels[:: 1 + len(levels) // 8]])


def _draw_principal_point(axes: Axes, camera: Camera, covariance: FloatArray) -> None:
    """Principal point with its ellipse and the middle of the picture, enlarged."""
    point, middle = camera.matrix[:2, 2], 0.5 * (camera.size_px - 1.0)
    variance, directions = np.linalg.eigh(covariance)
    angle = np.linspace(0.0, 2.0 * np.pi, 121)
    circle = np.stack([np.cos(angle), np.sin(angle)])
    ellipse = point[:, None] + ELLIPSE_QUANTILE * directions @ (np.sqrt(np.maximum(variance, 0.0))[:, None] * circle)
    axes.plot(*ellipse, color=BLUE, linewidth=1.1)
    axes.plot(*point, "+", color=BLUE, markersize=7.0, label="principal point")
    axes.plot(*middle, "s", color=GREY, markersize=4.0, label="middle of the picture")
    every = np.column_stack([ellipse, middle])
    centre = 0.5 * (every.min(axis=1) + every.max(axis=1))
    half = max(1.0, 0.65 * float(np.ptp(every, axis=1).max()))
    axes.set_xlim(centre[0] - half, centre[0] + half)
    axes.set_ylim(centre[1] + half, centre[1] - half)
    axes.grid(visible=True)
    axes.legend(loc="upper center", bbox_to_anchor=(0.5, -0.22), borderaxespad=0.0)
    panel_label(axes, "principal point, enlarged")


def draw_residuals(calibration: Calibration, side: Side) -> Picture:
    """All residuals of one camera, and their means in cells, which show what the model does not describe."""
    size = camera_of(calibration.rig, side)[0].size_px
    position, residual, _ = used_points(calibration, side)
    cells = residual_map(position, residual, cell_px(calibration, side))
    with picture_sheet(f"residuals-{side}", 2, size, KEY_IN) as drawn:
        panels = drawn.panels
        arrows(panels[0], position, residual, LONGEST_SHARE * float(size[0]), SIDE_COLOUR[side], "px")
        rms_px = two_digits(calibration.rms_sides_px[SIDES.index(side)])
        panel_label(panels[0], f"all {len(position)} points, rms length {rms_px} px")
        length = np.hypot(*cells.mean_px.T)
        clear = length > MEAN_QUANTILE * cells.within_px / np.sqrt(cells.count)
        arrows(panels[1], cells.centre_px, cells.mean_px, 0.95 * cells.side_px, np.where(clear, RED, GREY), "px")
        systematic = two_digits(cells.systematic_px)
        panel_label(panels[1], f"mean per cell of {cells.side_px:.0f} px, systematic part {systematic} px")
        panels[1].set_ylabel("")
        caption = (
            "Found minus modelled positions, strongly enlarged (arrow below each panel; the two scales differ). Left: "
            "every point in the fit. Right: mean per cell, red where it is longer than noise would make it in one "
            f"cell of twenty ({int(clear.sum())} of {len(clear)} cells). The systematic part is the rms length "
            "of the cells' means, their noise taken off: what lens model and target leave, beside a scatter of "
            f"{two_digits(cells.within_px)} px within the cells."
        )
        return finish(drawn.figure, drawn.name, f"Residuals of the {side} camera", caption)


def draw_distribution(calibration: Calibration) -> Picture:
    """How long the residuals are in units of their standard uncertainty, beside what normal noise gives."""
    lengths: dict[Side, FloatArray] = {}
    for side in SIDES:
        known = [picture.normalised[picture.used] for picture in pictures(calibration, side) if picture is not None]
        lengths[side] = np.concatenate([np.empty(0), *known])
    every = np.concatenate(list(lengths.values()))
    scale = float(np.sqrt(np.mean(every**2) / 2.0)) if len(every) else 1.0
    with sheet("distribution", 2.7, 1, 2) as drawn:
        density, beyond = drawn.panels
        reach = 4.5 * max(scale, 1.0)
        farthest = max(reach, float(every.max(initial=0.0)))
        edges = np.linspace(0.0, reach, BINS + 1)
        for side, values in lengths.items():
            look: dict[str, Any] = {"color": SIDE_COLOUR[side], "label": side}
            if len(values):
                counts, _ = np.histogram(values, bins=edges)
                density.stairs(counts / (len(values) * np.diff(edges)), edges, linewidth=1.1, **look)
            share = 1.0 - (np.arange(len(values)) + 0.5) / max(len(values), 1)
            beyond.plot(np.sort(values), share, linewidth=1.3, drawstyle="steps-post", **look)
        for size, dashes, name in ((1.0, "-", "normal noise"), (scale, "--", f"normal noise × {scale:.2f}")):
            d = np.linspace(0.0, reach, 181)
            density.plot(d, d / size**2 * np.exp(-0.5 * (d / size) ** 2), dashes, color=BLACK, linewidth=0.9)
            d = np.linspace(0.0, farthest, 181)
            beyond.plot(d, np.exp(-0.5 * (d / size) ** 2), dashes, color=BLACK, linewidth=0.9, label=name)
        density.set_xlim(0.0, reach)
        density.set_ylim(bottom=0.0)
        density.set_ylabel("density")
        density.legend()
        beyond.set_xlim(0.0, farthest)
        beyond.set_yscale("log")
        beyond.set_ylim(0.3 / max(1, *map(len, lengths.values())), 1.5)
        decades(beyond.yaxis)
        beyond.set_ylabel("share of points beyond d")
        beyond.legend(loc="lower left")
        for axes in drawn.panels:
            axes.set_xlabel("normalised residual d")
        caption = (
            "Length d of the residuals in units of their standard uncertainty: the points' own noise and what was "
            "added to it. Left: density; right: share of points beyond d. Normal noise of that size follows the solid "
            f"line, exp(−d²/2); dashed: the same for {scale:.2f} times the noise, the size found. Points above the "
            "lines on the right are outliers that the rule for dropping them has kept, or a systematic part."
        )
        title = "Distribution of the residuals"
        return drawn.picture(title, caption, left=0.72, top=0.12, gap=(0.75, 0.1), label=0.52)


def draw_pictures(calibration: Calibration) -> Picture:
    """Rms of the residuals picture by picture, points left out and pictures dropped."""
    whole = [item for item in calibration.dropped if item.points == 0]
    with sheet("pictures", 2.6) as drawn:
        (axes,) = drawn.panels
        for offset, side in zip((-0.21, 0.21), SIDES, strict=True):
            for place, picture in enumerate(pictures(calibration, side)):
                if picture is None:
                    continue
                x = place + 1 + offset
                axes.bar(x, np.nan_to_num(picture.rms_px), 0.38, color=SIDE_COLOUR[side])
                if not picture.used.all():
                    left_out = str(int((~picture.used).sum()))
                    look: dict[str, Any] = {"ha": "center", "fontsize": 7.0, "color": INK[side]}
                    axes.annotate(left_out, (x, 0.0), (0, 2.5), textcoords="offset points", **look)
            level = calibration.rms_sides_px[SIDES.index(side)]
            label = f"{side}, all {two_digits(level)} px"
            axes.axhline(level, color=SIDE_COLOUR[side], linewidth=0.9, linestyle="--", label=label)
        top = 1.3 * float(np.nanmax([p.rms_px for side in SIDES for p in pictures(calibration, side) if p is not None]))
        axes.set_ylim(0.0, top)
        start = len(calibration.views) + 1.0
        if whole:
            axes.axvspan(start - 0.4, start + len(whole) - 0.6, color=LIGHT, alpha=0.5, linewidth=0.0)
            axes.plot(start + np.arange(len(whole)), np.full(len(whole), 0.05 * top), "x", color=RED, label="dropped")
        for place, item in enumerate(whole if len(whole) <= MOST_NAMES else []):
            name = item.name if len(item.name) <= LONGEST_NAME else "…" + item.name[1 - LONGEST_NAME :]
            look = {"rotation": 90, "ha": "center", "va": "bottom", "fontsize": 6.5}
            axes.text(start + place, 0.12 * top, name, parse_math=False, **look)
        axes.set_xlim(0.4, start + len(whole) - (0.4 if whole else 0.5))
        axes.set_xticks(range(1, len(calibration.views) + 1, 1 + len(calibration.views) // 30))
        axes.set_xlabel("view")
        axes.set_ylabel("rms length / px")
        axes.grid(visible=False, axis="x")
        axes.legend(ncols=5, loc="upper right")
        caption = (
            "Rms length of the residuals in every picture; numbers in the bars count the points left out, crosses are "
            "pictures dropped as a whole. Lines: rms over all pictures of the camera. A picture that stands out was "
            "blurred, or the target moved between the exposures of the two cameras."
        )
        return drawn.picture("Residuals picture by picture", caption, left=0.72, top=0.12, label=0.52)
