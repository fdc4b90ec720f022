"""Figures of a calibration: what it found (lens, correlations, target) and what it leaves (residuals)."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import numpy as np
from matplotlib import colormaps
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.collections import PolyCollection
from matplotlib.colors import BoundaryNorm
from matplotlib.figure import Figure
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
    pictures,
    residual_map,
    target_shape,
    used_points,
)
from fusion.report.style import (
    BLACK,
    BLUE,
    GREY,
    LIGHT,
    ORANGE,
    RASTER_ABOVE,
    RED,
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
from photogram.camera import RIG_PARAMETERS, Camera
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
GROUPS = (9, 18, 21)
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
    coefficients = correlation(covariance_of(calibration.rig))
    names = [name.replace(".", " ") for name in RIG_PARAMETERS]
    with sheet("correlation", 6.9) as drawn:
        (axes,) = drawn.panels
        shown = axes.imshow(coefficients, cmap=colormaps["RdBu_r"].with_extremes(bad=LIGHT), vmin=-1.0, vmax=1.0)
        for edge in GROUPS:
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
        layout: dict[str, Any] = {"left": 1.1, "right": 1.1, "bottom": 0.95, "top": 0.1, "label": 0.52}
        return drawn.picture("Correlation of the parameters", caption, **layout)


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
        layout: dict[str, Any] = {"left": 0.72, "top": 0.12, "gap": (0.75, 0.1), "label": 0.52}
        return drawn.picture("Distribution of the residuals", caption, **layout)


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
