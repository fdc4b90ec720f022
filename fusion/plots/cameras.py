"""Figures of a camera calibration: which figures there are, and from where the target was seen."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import PatchCollection
from matplotlib.patches import Rectangle
from matplotlib.patheffects import withStroke

from fusion.camera_facts import (
    SIDES,
    Side,
    empty_cells,
    pictures,
    target_middles_m,
    tilts_rad,
    turns_rad,
    used_points,
)
from fusion.plots.camera_lens import draw_correlation, draw_distortion, draw_shape
from fusion.plots.camera_panels import figure_of, picture_panels, view_colours
from fusion.plots.camera_residuals import draw_distribution, draw_pictures, draw_residuals
from fusion.plots.style import (
    BLACK,
    GREY,
    LIGHT,
    RASTER_ABOVE,
    RED,
    FloatArray,
    Picture,
    drawing,
    finish,
    lay_out,
    new_figure,
    padded,
    panel_label,
)
from photogram.calibrate.result import CalibratedView, Calibration

CIRCLES_DEG = 15.0  # between the circles of the tilts
LEAST_TURN_DEG, LEAST_DISTANCE_SHARE = 40.0, 0.2
"""Least spans of the axes of turn and, of its median, of distance: views that are alike shall look so."""
NUMBER_PT = np.array([9.0, 7.0])  # room that the number of a view takes
POINTS_DRAWN = 8000.0  # from this number on points are drawn at their smallest
HALO = [withStroke(linewidth=1.8, foreground="white")]


def draw_cameras(calibration: Calibration) -> dict[str, list[Picture]]:
    """All figures of a calibration, by the section of the page that shows them."""
    return {
        "coverage": [draw_coverage(calibration), draw_views(calibration)],
        "residuals": [
            *(draw_residuals(calibration, side) for side in SIDES),
            draw_distribution(calibration),
            draw_pictures(calibration),
        ],
        "lens": [draw_distortion(calibration, side) for side in SIDES],
        "correlation": [draw_correlation(calibration)],
        "shape": [picture for picture in [draw_shape(calibration)] if picture is not None],
    }


def draw_coverage(calibration: Calibration) -> Picture:
    """All points of both cameras in their picture areas; cells without a point are grey."""
    rig = calibration.rig
    with drawing("coverage"):
        figure, panels = picture_panels(2, np.maximum(rig.left.size_px, rig.right.size_px))
        for axes, side in zip(panels, SIDES, strict=True):
            _draw_points(axes, calibration, side)
        caption = (
            "Found points over the picture area of either camera, one colour per view in the order of the session, "
            "numbers at outermost points where there is room; red crosses are points left out. Grey cells hold no "
            "point: there the lens distortion is extrapolated. A good session reaches all corners."
        )
        return finish(figure, "coverage", "Where the target was seen", caption)


def draw_views(calibration: Calibration) -> Picture:
    """Tilt, turn and distance of the target in every view, and the scene from above."""
    with drawing("views"):
        figure = new_figure(3.0)
        panels = figure.subplots(1, 3)
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
        lay_out(figure, panels, left=0.62, top=0.28, gap=(0.72, 0.1), label=0.5)
        _mark(panels[0], tilt, colours)
        _mark(panels[1], np.stack([turn, distance], axis=1), colours)
        caption = (
            "Left: direction and angle by which the target's normal is tilted off the left camera's axis; views with "
            "the same tilt add little, and focal length and distance are told apart by tilts of 30° and more in "
            "several directions. Middle: turn of the target about the camera's axis, and its distance. Right: the "
            "scene in the plane of the baseline and the left camera's axis, with the optical axes dashed and the "
            "target's outline."
        )
        return finish(figure, "views", "How the target was held", caption)


def _draw_points(axes: Axes, calibration: Calibration, side: Side) -> None:
    """Points of one camera, coloured and numbered by view, with the cells that have none."""
    size = (calibration.rig.left if side == "left" else calibration.rig.right).size_px
    position, _, view = used_points(calibration, side)
    cells = empty_cells(position, size)
    patches = [Rectangle((x0, y0), x1 - x0, y1 - y0) for x0, y0, x1, y1 in cells]
    axes.add_collection(PatchCollection(patches, facecolor=LIGHT, edgecolor="white", linewidth=0.6))
    colours = view_colours(len(calibration.views))
    axes.scatter(
        position[:, 0],
        position[:, 1],
        s=np.clip(POINTS_DRAWN / len(view), 2.0, 7.0),
        c=colours[view],
        linewidths=0.0,
        rasterized=len(view) > RASTER_ABOVE,
    )
    left_out = [p.position_px[~p.used] for p in pictures(calibration, side) if p is not None]
    crosses = np.concatenate([np.empty((0, 2)), *left_out])
    axes.plot(*crosses.T, "x", color=RED, markersize=3.5, markeredgewidth=0.9)
    away = np.linalg.norm(position - position.mean(axis=0), axis=1)
    seen = np.unique(view)
    _number(axes, position[[np.argmax(np.where(view == number, away, -1.0)) for number in seen]], seen)
    share = calibration.covered[SIDES.index(side)]
    panel_label(axes, f"{side} camera: {len(view)} points, {100 * share:.0f} % of the picture covered")


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
    for view, colour in zip(calibration.views, colours, strict=True):
        axes.plot(*(plane @ _ends(calibration, view).T), color=colour, linewidth=1.0, solid_capstyle="round")
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


def _ends(calibration: Calibration, view: CalibratedView) -> FloatArray:
    """Corners (5, 3) of the target in one view, the first again at the end, in the left camera's frame."""
    low, high = calibration.shape_m.min(axis=0), calibration.shape_m.max(axis=0)
    corners = np.array([[low[0], low[1]], [high[0], low[1]], [high[0], high[1]], [low[0], high[1]], [low[0], low[1]]])
    return view.left_from_target.apply(np.column_stack([corners, np.full(5, 0.5 * (low[2] + high[2]))]))


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
        axes.annotate(
            str(view + 1),
            (float(point[0]), float(point[1])),
            (3.5, 2.0),
            textcoords="offset points",
            fontsize=6.5,
            path_effects=HALO,
            zorder=4,
        )


def _at_least(values: FloatArray, span: float) -> tuple[float, float]:
    """Limits that hold values with some room and span at least so much, so that alike looks alike."""
    low, high = padded(float(values.min()), float(values.max()))
    room = max(0.0, 0.5 * (span - (high - low)))
    return low - room, high + room
