"""Figures of what a calibration found: distortion and principal point, correlations, shape of the target."""

from __future__ import annotations

import numpy as np
from matplotlib import colormaps
from matplotlib.axes import Axes
from matplotlib.collections import PolyCollection
from matplotlib.colors import BoundaryNorm
from matplotlib.ticker import MaxNLocator

from fusion.camera_facts import (
    Distortion,
    Side,
    TargetShape,
    correlation,
    covariance_of,
    distortion,
    principal_point,
    target_shape,
    used_points,
)
from fusion.plots.camera_panels import BAR_IN, arrows, bordered, colour_bar, picture_panels, two_digits
from fusion.plots.style import (
    BLACK,
    BLUE,
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
    panel_label,
)
from photogram.calibrate.result import Calibration
from photogram.camera import RIG_PARAMETERS

ELLIPSE_QUANTILE = 2.448
"""Half axes, in standard uncertainties, of the ellipse that holds two coordinates with 95 %: √χ²(0.95; 2)."""
LEVELS = 8
GROUPS = (9, 18, 21)
"""Numbers of parameters after which another group begins: left camera, right camera, rotation, translation."""
STRONG = 0.9  # coefficient from which on it is written into the figure


def draw_distortion(calibration: Calibration, side: Side) -> Picture:
    """Displacement by the lens with its uncertainty over the picture, and the principal point."""
    camera = calibration.rig.left if side == "left" else calibration.rig.right
    field = distortion(calibration, side)
    hull = _hull(used_points(calibration, side)[0])
    with drawing(f"distortion-{side}"):
        figure, panels = picture_panels(3, camera.size_px, BAR_IN)
        length = np.linalg.norm(field.displacement_px, axis=-1)
        _draw_contours(panels[0], field, length, "displacement / px", log=False)
        _draw_displacement(panels[0], field)
        panels[0].plot(*camera.parameters[2:4], "+", color="white", markersize=7.0)
        _draw_contours(panels[1], field, field.u_px, "standard uncertainty / px", log=True)
        for axes in panels[:2]:
            axes.plot(*hull.T, color=RED, linewidth=1.0, linestyle="--")
        panel_label(panels[0], f"displacement by distortion, up to {two_digits(np.nanmax(length))} px")
        panel_label(panels[1], f"its u, up to {two_digits(np.nanmax(field.u_px))} px")
        _draw_principal_point(panels[2], calibration, side)
        caption = (
            "Left: how far the lens moves points off where one without distortion would show them; the arrows give the "
            "direction, the cross is the principal point. Middle: standard uncertainty u (k = 1) per coordinate of "
            "that displacement, from the covariance of all nine parameters. Outside the dashed outline no point was "
            "seen and the distortion is extrapolated. Right: the principal point, against the middle of the picture, "
            "with the ellipse that holds it with 95 %."
        )
        return finish(figure, f"distortion-{side}", f"Lens distortion of the {side} camera", caption)


def draw_correlation(calibration: Calibration) -> Picture:
    """Correlation coefficients of all parameters of the pair."""
    coefficients = correlation(covariance_of(calibration.rig))
    names = [name.replace(".", " ") for name in RIG_PARAMETERS]
    with drawing("correlation"):
        figure = new_figure(6.9)
        axes = figure.subplots()
        shown = axes.imshow(coefficients, cmap=colormaps["RdBu_r"].with_extremes(bad=LIGHT), vmin=-1.0, vmax=1.0)
        for edge in GROUPS:
            axes.axhline(edge - 0.5, color=BLACK, linewidth=0.7)
            axes.axvline(edge - 0.5, color=BLACK, linewidth=0.7)
        axes.set_xticks(range(len(names)), names, rotation=90, fontsize=7.0)
        axes.set_yticks(range(len(names)), names, fontsize=7.0)
        for i, j in np.argwhere(np.abs(coefficients) >= STRONG):
            if i != j:
                text = str(int(100 * coefficients[i, j])).replace("-", "−")
                axes.text(j, i, text, ha="center", va="center", fontsize=5.5, color="white")
        bordered(axes)
        axes.tick_params(length=2.0)
        lay_out(figure, [axes], left=1.1, right=1.1, bottom=0.95, top=0.1)
        bar = figure.colorbar(shown, cax=axes.inset_axes((1.03, 0.0, 0.025, 1.0)))
        bar.set_label("correlation coefficient")
        caption = (
            f"Coefficients beyond ±{STRONG:g} are written in hundredths. Parameters that answer for each other, "
            "as k1, k2 and k3, or principal point and tangential distortion, are each less certain than what they do "
            "together: judge them by the uncertainty of the distortion. Grey: held fixed."
        )
        return finish(figure, "correlation", "Correlation of the parameters", caption)


def draw_shape(calibration: Calibration) -> Picture | None:
    """Height and in-plane departure of the target's points; None for a target held flat."""
    shape = target_shape(calibration)
    if shape is None:
        return None
    with drawing("shape"):
        extent = 1e3 * np.ptp(shape.lattice_m, axis=0) + 4e3 * calibration.target.spacing_m
        figure, panels = picture_panels(2, extent, BAR_IN)
        squares = _squares(shape, calibration.target.spacing_m)
        panels[0].add_collection(squares)
        colour_bar(panels[0], squares, "height / µm")
        panel_label(
            panels[0],
            f"height, from {two_digits(1e6 * shape.height_m.min())} to {two_digits(1e6 * shape.height_m.max())} µm",
        )
        spacing_mm = 1e3 * calibration.target.spacing_m
        arrows(panels[1], 1e3 * shape.lattice_m, 1e6 * shape.inside_m, 1.5 * spacing_mm, BLUE, "µm")
        inside = np.hypot(*shape.inside_m.T)
        panel_label(panels[1], f"in the plane, rms {two_digits(1e6 * float(np.sqrt(np.mean(inside**2))))} µm")
        low = 1e3 * shape.lattice_m.min(axis=0) - 2.0 * spacing_mm
        for axes in panels:
            axes.set_xlim(low[0], low[0] + extent[0])
            axes.set_ylim(low[1], low[1] + extent[1])
            axes.set_xlabel("x / mm")
        panels[0].set_ylabel("y / mm")
        caption = (
            "Estimated positions of the target's points against a flat lattice of the stated spacing, laid onto it as "
            "a rigid body, in the target's frame. Left: out of the plane; right: in it, strongly enlarged "
            "(arrow below). A bow tells a bent plate, a gradient in the plane a print with unequal scales."
        )
        return finish(figure, "shape", "Shape of the target", caption)


def _draw_contours(axes: Axes, field: Distortion, values: FloatArray, label: str, *, log: bool) -> None:
    """Filled contours over the picture with their colour bar, at equal steps or at 1, 2, 5, 10."""
    known = np.ma.masked_invalid(values)
    levels = _one_two_five(known.min(), known.max()) if log else MaxNLocator(LEVELS).tick_values(0.0, known.max())
    place = field.pixel[0, :, 0], field.pixel[:, 0, 1], np.maximum(known, levels[0])
    scale = BoundaryNorm(levels, 256)
    shown = axes.contourf(*place, levels=levels, cmap="viridis", norm=scale)
    axes.contour(*place, levels=levels[1:], colors="white", linewidths=0.4)
    bar = colour_bar(axes, shown, label)
    bar.set_xticks(levels[:: 1 + len(levels) // 8], [f"{level:g}" for level in levels[:: 1 + len(levels) // 8]])


def _one_two_five(low: float, high: float) -> FloatArray:
    """Round levels from below `low` to above `high`, at most the last two decades."""
    low = max(float(low), 1e-2 * float(high), 1e-12)
    decade = np.arange(np.floor(np.log10(low)), np.ceil(np.log10(max(float(high), 2.0 * low))) + 1)
    every = np.multiply.outer(10.0**decade, [1.0, 2.0, 5.0]).ravel()
    return every[np.searchsorted(every, low, "right") - 1 : np.searchsorted(every, max(float(high), 2.0 * low)) + 1]


def _draw_displacement(axes: Axes, field: Distortion) -> None:
    """Directions of the displacement as arrows on a coarse grid."""
    some = (slice(2, None, 4), slice(2, None, 4))
    place, vector = field.pixel[some].reshape(-1, 2), field.displacement_px[some].reshape(-1, 2)
    known = np.isfinite(vector).all(axis=1)
    longest = float(np.hypot(*vector[known].T).max(initial=0.0)) or 1.0
    reach = 3.5 * float(field.pixel[0, 1, 0] - field.pixel[0, 0, 0])
    axes.quiver(
        *place[known].T,
        *vector[known].T,
        color="white",
        angles="xy",
        scale_units="xy",
        scale=longest / reach,
        width=0.006,
        headwidth=3.5,
    )


def _draw_principal_point(axes: Axes, calibration: Calibration, side: Side) -> None:
    """Principal point with its ellipse and the middle of the picture, enlarged."""
    point, covariance = principal_point(calibration.rig, side)
    size = (calibration.rig.left if side == "left" else calibration.rig.right).size_px
    middle = 0.5 * (size - 1.0)
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


def _hull(points: FloatArray) -> FloatArray:
    """Closed convex outline (K, 2) of points, themselves where they span no area."""
    from scipy.spatial import ConvexHull, QhullError

    try:
        corners = ConvexHull(points).vertices
    except (QhullError, ValueError):
        return points
    return np.asarray(points[[*corners, corners[0]]])


def _squares(shape: TargetShape, spacing_m: float) -> PolyCollection:
    """Squares about the target's points, coloured by their height in µm."""
    corner = 0.47e3 * spacing_m * np.array([[-1.0, -1.0], [1.0, -1.0], [1.0, 1.0], [-1.0, 1.0]])
    squares = PolyCollection(list(1e3 * shape.lattice_m[:, None, :] + corner), linewidth=0.0)
    squares.set_array(1e6 * shape.height_m)
    squares.set_cmap("viridis")
    squares.set_rasterized(len(shape.height_m) > RASTER_ABOVE)
    return squares
