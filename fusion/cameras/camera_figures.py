"""Figures of a calibration: views, residuals, lens distortion and target geometry."""

from __future__ import annotations

import numpy as np

from fusion.cameras.camera_quantities import (
    SIDES,
    DistortionField,
    Side,
    camera_of,
    cell_px,
    correlation,
    covariance_of,
    distortion,
    empty_cells,
    images_of_camera,
    residual_map,
    target_middles_m,
    target_shape,
    tilts_rad,
    turns_rad,
    used_points,
)
from fusion.report.figure import (
    BLACK,
    BLUE,
    GREY,
    LIGHT,
    ORANGE,
    RED,
    Figure,
    Panel,
    Scale,
    empty_figure,
    padded_limits,
)
from photogram.calibration.calibration_result import Calibration
from photogram.camera import LEFT, RIG_PARAMETERS, RIGHT, ROTATION, TRANSLATION, Camera
from photogram.targets.target_view import outline
from shakercal._common.arrays import FloatArray
from shakercal._common.digits import signed_text

AROUND_IN, BAR_IN = 0.75, 0.45
"""Margin above and below panels of an image area, and height of a colour bar."""
WIDTH_IN = 7.6  # text width of the page
FLATTEST_IN, TALLEST_IN = 1.2, 4.5  # limits of the height of an image area
ARROW_QUANTILE = 0.98  # quantile of the arrows' lengths that sets their scale
ELLIPSE_QUANTILE = 2.448
"""Half axes, in standard uncertainties, of the 95 % ellipse of two coordinates: √χ²(0.95; 2)."""
STRONG = 0.9  # coefficient from which it is written into the figure
MEAN_QUANTILE = 1.731
"""Length of a mean of noise, in units of its rms length, that one in twenty exceeds: √(−ln 0.05)."""
LONGEST_SHARE = 0.04  # length of the longest arrow over the image width
SIDE_COLOUR = {"left": BLUE, "right": ORANGE}
MOST_NAMES = 8  # rejected images that are named in the figure
BINS = 40  # of the histogram of residuals
CIRCLES_DEG = 15.0  # between the circles of the tilts
LEAST_TURN_DEG, LEAST_DISTANCE_SHARE = 40.0, 0.2
"""Least spans of the axes of rotation and, relative to the median, of distance: similar views look similar."""
NAMED_VIEWS = 60  # views up to which numbers are written


def image_sheet(name: str, count: int, size_px: FloatArray, below_in: float = 0.0) -> Figure:
    """Return a figure with panels that show one image area each, to scale."""
    height = float(np.clip(WIDTH_IN / count * 0.85 * size_px[1] / size_px[0], FLATTEST_IN, TALLEST_IN))
    drawn = empty_figure(name, height + AROUND_IN + below_in, 1, count)
    for panel in drawn.panels:
        panel.x.limits, panel.y.limits = (-0.5, float(size_px[0]) - 0.5), (float(size_px[1]) - 0.5, -0.5)  # y down
        panel.equal, panel.x.grid, panel.y.grid = True, False, False
        panel.x.label = "x / px"
    drawn.panels[0].y.label = "y / px"
    return drawn


def view_scale(count: int) -> Scale:
    """Return the colours of the views in their order."""
    return Scale("viridis", 1.0, max(1.09 * count, 2.0))


def draw_arrows(
    panel: Panel, position: FloatArray, vector: FloatArray, longest: float, colour: str | FloatArray
) -> float:
    """Draw vectors (N, 2) at positions (N, 2) and return their length.

    The `ARROW_QUANTILE` of the lengths is returned and drawn `longest` data units long.
    """
    if not len(position):
        return 0.0
    size = float(np.quantile(np.hypot(vector[:, 0], vector[:, 1]), ARROW_QUANTILE)) or 1.0
    colours = np.full(len(position), colour) if isinstance(colour, str) else np.asarray(colour)
    for one in dict.fromkeys(colours.tolist()):
        members = colours == one
        panel.arrows(position[members], vector[members] * (longest / size), colour=one)
    return size


def two_digits(value: float) -> str:
    """Return a number with two significant digits and no exponent."""
    nonzero = np.isfinite(value) and value != 0.0
    digits = max(0, 1 - int(f"{value:.1e}".partition("e")[2])) if nonzero else 0
    return signed_text(value, f".{digits}f")


def draw_coverage(calibration: Calibration) -> Figure:
    """Draw all points of both cameras in their image areas, with empty cells in grey."""
    rig = calibration.rig
    drawn = image_sheet("coverage", 2, np.maximum(rig.left.size_px, rig.right.size_px).astype(np.float64))
    for panel, side in zip(drawn.panels, SIDES, strict=True):
        position, _, view = used_points(calibration, side)
        cells = np.asarray(empty_cells(position, camera_of(rig, side)[0].size_px), dtype=np.float64).reshape(-1, 4)
        panel.boxes((cells[:, 0], cells[:, 2]), (cells[:, 1], cells[:, 3]), "without a point", colour=LIGHT)
        names = tuple(f"view {number + 1}" for number in view)
        scale = view_scale(len(calibration.views))
        panel.points(position[:, 0], position[:, 1], values=view + 1.0, scale=scale, names=names, size=2.4)
        left_out = [p.position_px[~p.used] for p in images_of_camera(calibration, side) if p is not None]
        crosses = np.concatenate([np.empty((0, 2)), *left_out])
        if len(crosses):
            panel.points(crosses[:, 0], crosses[:, 1], "rejected", marker="x", colour=RED, size=3.5)
        share = calibration.image_coverage[SIDES.index(side)]
        panel.title = f"{side} camera: {len(view)} points, {100 * share:.0f} % of the image covered"
    caption = (
        "Found points in the image area of each camera, one colour per view in the order of the session; red crosses "
        "are rejected points. Grey cells have no point: the lens distortion is extrapolated there. A good session "
        "reaches all corners."
    )
    return drawn.with_title("Positions of the target in the images", caption, main=True)


def draw_views(calibration: Calibration) -> Figure:
    """Draw tilt, rotation and distance of the target, and the scene from above."""
    drawn = empty_figure("views", 3.2, 1, 3)
    panels = drawn.panels
    tilt = np.degrees(tilts_rad(calibration))
    _draw_tilts(panels[0], float(np.hypot(*tilt.T).max()))
    distance = 1e3 * np.linalg.norm(target_middles_m(calibration), axis=1)
    turn = np.degrees(turns_rad(calibration))
    panels[1].x.limits = _at_least(turn, LEAST_TURN_DEG)
    panels[1].y.limits = _at_least(distance, LEAST_DISTANCE_SHARE * float(np.median(distance)))
    panels[1].x.label, panels[1].y.label = "rotation in the left image / °", "distance from the left camera / mm"
    _draw_scene(panels[2], calibration)
    _mark(panels[0], tilt)
    _mark(panels[1], np.stack([turn, distance], axis=1))
    caption = (
        "Left: direction and angle by which the target's normal is tilted off the left camera's axis; views with "
        "the same tilt add little. Tilts of 30° and more in several directions separate focal length and distance. "
        "Middle: rotation of the target about the camera's axis, and its distance. Right: the "
        "scene in the plane of the baseline and the left camera's axis, with the optical axes dashed and the "
        "target's outline."
    )
    return drawn.with_title("Poses of the target", caption)


def _draw_tilts(panel: Panel, largest: float) -> None:
    """Draw circles of equal angle for tilts in degrees up to the largest."""
    reach = CIRCLES_DEG * max(2.0, float(np.ceil(1.02 * largest / CIRCLES_DEG)))
    radii = np.arange(CIRCLES_DEG, reach + 1.0, CIRCLES_DEG)
    for radius in radii:
        panel.ellipse(0j, (radius, radius), 0.0, colour=LIGHT)
    panel.text(0.707 * radii, -0.707 * radii, [f"{radius:.0f}°" for radius in radii], colour=GREY)
    for along in ("x", "y"):
        panel.rule(0.0, along=along, colour=LIGHT, width=0.7)
    panel.x.limits, panel.y.limits = (-1.05 * reach, 1.05 * reach), (1.05 * reach, -1.05 * reach)
    panel.equal, panel.x.grid, panel.y.grid = True, False, False
    panel.x.label, panel.y.label = "tilt to the right / °", "tilt down / °"


def _draw_scene(panel: Panel, calibration: Calibration) -> None:
    """Draw cameras, optical axes and targets in the plane of baseline and left axis."""
    right = calibration.rig.right_from_left
    centre, axis = -right.rotation.T @ right.translation_m, right.rotation[2]
    across = centre * [1.0, 1.0, 0.0]
    across = across / np.linalg.norm(across) if np.linalg.norm(across) > 0 else np.array([1.0, 0.0, 0.0])
    plane = 1e3 * np.stack([across, [0.0, 0.0, 1.0]])
    (x0, y0, z0), (x1, y1, z1) = calibration.shape_m.min(axis=0), calibration.shape_m.max(axis=0)
    middle = 0.5 * (z0 + z1)
    outline = np.array([[x, y, middle] for x, y in ((x0, y0), (x1, y0), (x1, y1), (x0, y1), (x0, y0))])
    every = [plane @ view.left_from_target.apply(outline).T for view in calibration.views]
    gaps = [np.concatenate([part, np.full((2, 1), np.nan)], axis=1) for part in every]
    x, y = np.concatenate(gaps, axis=1)
    panel.line(x, y, "target", colour=BLUE, width=0.9)
    reach = 1.15 * float(np.linalg.norm(target_middles_m(calibration), axis=1).max())
    for name, origin, direction in (("left", np.zeros(3), np.array([0.0, 0.0, 1.0])), ("right", centre, axis)):
        ends = plane @ np.stack([origin, origin + reach * direction]).T
        panel.line(*ends, colour=GREY, width=0.8, dashed=True)
        panel.points(*ends[:, :1], colour=BLACK, marker="square", size=5.0, names=(f"{name} camera",))
        panel.text(ends[0, :1], ends[1, :1], name, offset_px=(0.0, -12.0))
        every.append(ends)
    low, high = (getattr(np, end)(np.concatenate(every, axis=1), axis=1) for end in ("min", "max"))
    margin = 0.12 * float((high - low).max())
    panel.x.limits, panel.y.limits = (low[0] - margin, high[0] + margin), (low[1] - margin, high[1] + margin)
    panel.equal = True
    panel.x.label, panel.y.label = "along the baseline / mm", "along the left axis / mm"


def _mark(panel: Panel, position: FloatArray) -> None:
    """Draw a disc per view at positions (V, 2), with its number."""
    number = np.arange(1, len(position) + 1)
    names = tuple(f"view {one}" for one in number)
    panel.points(*position.T, values=number.astype(np.float64), scale=view_scale(len(position)), size=4.7, names=names)
    if len(position) <= NAMED_VIEWS:
        panel.text(position[:, 0], position[:, 1], [str(one) for one in number], align="left", offset_px=(4.0, 3.0))


def _at_least(values: FloatArray, span: float) -> tuple[float, float]:
    """Return limits of values with a margin and a minimum span."""
    low, high = padded_limits(float(values.min()), float(values.max()))
    margin = max(0.0, 0.5 * (span - (high - low)))
    return low - margin, high + margin


def draw_distortion(calibration: Calibration, side: Side) -> Figure:
    """Draw the lens distortion with its uncertainty over the image, and the principal point."""
    camera, covariance = camera_of(calibration.rig, side)
    field = distortion(calibration, side)
    seen = outline(used_points(calibration, side)[0])
    seen = np.concatenate([seen, seen[:1]])
    drawn = image_sheet(f"distortion-{side}", 3, camera.size_px.astype(np.float64), BAR_IN)
    panels = drawn.panels
    length = np.linalg.norm(field.displacement_px, axis=-1)
    _draw_field(panels[0], field, length, Scale("viridis", 0.0, float(np.nanmax(length)) or 1.0, "displacement / px"))
    u = field.u_px
    low = max(float(np.nanmin(u)), 1e-2 * float(np.nanmax(u)), 1e-12)
    high = max(float(np.nanmax(u)), 2.0 * low)
    _draw_field(panels[1], field, u, Scale("viridis", low, high, "standard uncertainty / px", log=True))
    some = (slice(2, None, 4), slice(2, None, 4))  # directions on a coarse grid
    position, vector = field.pixel[some].reshape(-1, 2), field.displacement_px[some].reshape(-1, 2)
    finite = np.isfinite(vector).all(axis=1)
    draw_arrows(
        panels[0], position[finite], vector[finite], 3.5 * float(field.pixel[0, 1, 0] - field.pixel[0, 0, 0]), "#ffffff"
    )
    centre = camera.parameters[2:4]
    panels[0].points(*centre[:, None], marker="plus", colour="#ffffff", size=7.0, names=("principal point",))
    for panel in panels[:2]:
        panel.line(seen[:, 0], seen[:, 1], "outline of the points seen", colour=RED, width=1.0, dashed=True)
    panels[0].title = f"displacement, up to {two_digits(np.nanmax(length))} px"
    panels[1].title = f"its u, up to {two_digits(np.nanmax(u))} px"
    _draw_principal_point(panels[2], camera, covariance[2:4, 2:4])
    caption = (
        "Left: how far the lens moves points off where one without distortion would show them; the arrows give the "
        "direction, the cross is the principal point. Middle: standard uncertainty u (k = 1) per coordinate of "
        "that displacement, from the covariance of all nine parameters. Outside the dashed outline no point was "
        "seen and the distortion is extrapolated. Right: the principal point with its 95 % ellipse, and the centre of "
        "the image."
    )
    return drawn.with_title(f"Lens distortion of the {side} camera", caption)


def _draw_field(panel: Panel, field: DistortionField, values: FloatArray, scale: Scale) -> None:
    """Draw values over the image, one cell for each finite value."""
    middle, half = field.pixel.reshape(-1, 2), 0.5 * (field.pixel[1, 1] - field.pixel[0, 0])
    x, y = middle.T
    panel.boxes((x - half[0], x + half[0]), (y - half[1], y + half[1]), values=values.ravel(), scale=scale)


def _draw_principal_point(panel: Panel, camera: Camera, covariance: FloatArray) -> None:
    """Draw the principal point with its ellipse and the image centre, enlarged."""
    point, middle = camera.matrix[:2, 2], 0.5 * (camera.size_px - 1.0)
    variance, directions = np.linalg.eigh(covariance)
    half = ELLIPSE_QUANTILE * np.sqrt(np.maximum(variance, 0.0))
    angle = float(np.arctan2(directions[1, 1], directions[0, 1]))
    panel.ellipse(complex(*point), (float(half[1]), float(half[0])), angle, label="principal point", colour=BLUE)
    panel.points(point[:1], point[1:], "principal point", colour=BLUE, marker="plus", size=7.0)
    panel.points(middle[:1], middle[1:], "centre of the image", colour=GREY, marker="square", size=4.0)
    every = np.stack([point - half.max(), point + half.max(), middle])
    centre = 0.5 * (every.min(axis=0) + every.max(axis=0))
    reach = max(1.0, 0.65 * float(np.ptp(every, axis=0).max()))
    panel.x.limits = (float(centre[0] - reach), float(centre[0] + reach))
    panel.y.limits = (float(centre[1] + reach), float(centre[1] - reach))
    panel.x.grid = panel.y.grid = True
    panel.title = "principal point, enlarged"


def draw_correlation(calibration: Calibration) -> Figure:
    """Draw the correlation coefficients of all parameters of the pair."""
    covariance = covariance_of(calibration.rig)
    further = np.diagonal(covariance)[TRANSLATION.stop :] > 0
    uncertain = np.concatenate([np.ones(TRANSLATION.stop, np.bool_), further])
    groups = [indices[uncertain[indices]] for indices in (LEFT, RIGHT, np.r_[ROTATION], np.r_[TRANSLATION])]
    order = np.concatenate(groups)
    coefficients = correlation(covariance[np.ix_(order, order)])
    names = tuple(RIG_PARAMETERS[index].replace(".", " ") for index in order)
    drawn = empty_figure("correlation", 7.4)
    (panel,) = drawn.panels
    i, j = (index.ravel() for index in np.indices(coefficients.shape))
    labels = tuple(f"{names[a]}, {names[b]}" for a, b in zip(i, j, strict=True))
    scale = Scale("RdBu", -1.0, 1.0, "correlation coefficient")
    ends = (j - 0.5, j + 0.5), (i - 0.5, i + 0.5)
    panel.boxes(*ends, values=coefficients.ravel(), scale=scale, names=labels)
    edges = np.cumsum([len(group) for group in groups[:-1]]) - 0.5
    panel.rule(edges, along="x", width=0.7)
    panel.rule(edges, along="y", width=0.7)
    strong = np.argwhere((np.abs(coefficients) >= STRONG) & ~np.eye(len(names), dtype=np.bool_))
    texts = [signed_text(np.trunc(100 * coefficients[a, b]), ".0f") for a, b in strong]
    panel.text(strong[:, 1], strong[:, 0], texts, colour="#ffffff")
    panel.x.names = panel.y.names = names
    panel.x.grid = panel.y.grid = False
    caption = (
        f"Coefficients beyond ±{STRONG:g} are written in hundredths. Strongly correlated parameters are individually "
        "less certain than their combined effect, such as k1, k2 and k3, or principal point and tangential distortion. "
        "The uncertainty of the distortion shows that effect. Grey: fixed."
    )
    return drawn.with_title("Correlation of the parameters", caption)


def draw_shape(calibration: Calibration) -> Figure | None:
    """Draw height and in-plane deviation of the target's points; None for a flat model."""
    shape = target_shape(calibration)
    if shape is None:
        return None
    spacing_mm = 1e3 * calibration.target.cell_m
    extent = 1e3 * np.ptp(shape.lattice_m, axis=0) + 4.0 * spacing_mm
    drawn = image_sheet("shape", 2, extent, BAR_IN)
    height, inside = 1e6 * shape.height_m, np.hypot(*shape.inside_m.T)
    low, high = float(height.min()), float(height.max())
    scale = Scale("viridis", low, high if high > low else low + 1.0, "height / µm")
    drawn.panels[0].squares(1e3 * shape.lattice_m, 0.94 * spacing_mm, values=height, scale=scale)
    drawn.panels[0].title = f"height, from {two_digits(low)} to {two_digits(high)} µm"
    size = draw_arrows(drawn.panels[1], 1e3 * shape.lattice_m, 1e6 * shape.inside_m, 1.5 * spacing_mm, BLUE)
    rms = two_digits(1e6 * float(np.sqrt(np.mean(inside**2))))
    drawn.panels[1].title = f"in the plane, rms {rms} µm, longest arrow {two_digits(size)} µm"
    corner = 1e3 * shape.lattice_m.min(axis=0) - 2.0 * spacing_mm
    for panel in drawn.panels:
        panel.x.limits, panel.y.limits = ((float(corner[k]), float(corner[k] + extent[k])) for k in range(2))
        panel.x.label = "x / mm"
    drawn.panels[0].y.label = "y / mm"
    caption = (
        "Estimated positions of the target's points relative to a flat lattice of the stated spacing, fitted as a "
        "rigid body, in the target's frame. Left: out of the plane; right: in it, strongly enlarged. A bow indicates "
        "a bent plate, a gradient in the plane a print with unequal scales."
    )
    return drawn.with_title("Geometry of the target", caption)


def draw_residuals(calibration: Calibration, side: Side) -> Figure:
    """Draw all residuals of one camera and their means in cells."""
    size = camera_of(calibration.rig, side)[0].size_px
    position, residual, _ = used_points(calibration, side)
    cells = residual_map(position, residual, cell_px(calibration, side))
    drawn = image_sheet(f"residuals-{side}", 2, size.astype(np.float64))
    every, means = drawn.panels
    longest = draw_arrows(every, position, residual, LONGEST_SHARE * float(size[0]), SIDE_COLOUR[side])
    rms_px = two_digits(calibration.rms_sides_px[SIDES.index(side)])
    every.title = f"{len(position)} points, rms {rms_px} px, longest arrow {two_digits(longest)} px"
    length = np.hypot(*cells.mean_px.T)
    clear = length > MEAN_QUANTILE * cells.within_px / np.sqrt(cells.count)
    longest = draw_arrows(means, cells.centre_px, cells.mean_px, 0.95 * cells.side_px, np.where(clear, RED, GREY))
    systematic = two_digits(cells.systematic_px)
    means.title = f"cells of {cells.side_px:.0f} px, systematic {systematic} px, longest arrow {two_digits(longest)} px"
    caption = (
        "Found minus modelled positions, strongly enlarged (the two scales differ). Left: "
        "every point in the fit. Right: mean per cell, red where it is longer than noise would make it in one "
        f"cell of twenty ({int(clear.sum())} of {len(clear)} cells). The systematic part is the rms length of the "
        "cells' means without their noise: the deviation of lens model and target. The scatter within the cells is "
        f"{two_digits(cells.within_px)} px."
    )
    return drawn.with_title(f"Residuals of the {side} camera", caption)


def draw_distribution(calibration: Calibration) -> Figure:
    """Draw the distribution of normalised residuals and that of normal noise."""
    lengths: dict[Side, FloatArray] = {}
    for side in SIDES:
        used = [image.normalised[image.used] for image in images_of_camera(calibration, side) if image is not None]
        lengths[side] = np.concatenate([np.empty(0), *used])
    every = np.concatenate(list(lengths.values()))
    scale = float(np.sqrt(np.mean(every**2) / 2.0)) if len(every) else 1.0
    drawn = empty_figure("distribution", 2.9, 1, 2)
    density, beyond = drawn.panels
    reach = 4.5 * max(scale, 1.0)
    farthest = max(reach, float(every.max(initial=0.0)))
    edges = np.linspace(0.0, reach, BINS + 1)
    for side, values in lengths.items():
        colour = SIDE_COLOUR[side]
        if len(values):
            counts, _ = np.histogram(values, bins=edges)
            level = counts / (len(values) * np.diff(edges))
            density.line(edges, np.append(level, level[-1]), side, colour=colour, step=True)
        share = 1.0 - (np.arange(len(values)) + 0.5) / max(len(values), 1)
        beyond.line(np.sort(values), share, side, colour=colour, width=1.3, step=True)
    for size, dashed, name in ((1.0, False, "normal noise"), (scale, True, f"normal noise × {scale:.2f}")):
        d = np.linspace(0.0, reach, 181)
        density.line(d, d / size**2 * np.exp(-0.5 * (d / size) ** 2), name, colour=BLACK, width=0.9, dashed=dashed)
        d = np.linspace(0.0, farthest, 181)
        beyond.line(d, np.exp(-0.5 * (d / size) ** 2), name, colour=BLACK, width=0.9, dashed=dashed)
    density.x.limits, beyond.x.limits = (0.0, reach), (0.0, farthest)
    density.y.label, beyond.y.label = "density", "share of points beyond d"
    beyond.y.log, beyond.y.limits = True, (0.3 / max(1, *map(len, lengths.values())), 1.5)
    for panel in drawn.panels:
        panel.x.label = "normalised residual d"
    caption = (
        "Length d of the residuals in units of their standard uncertainty, which includes the added noise. Left: "
        "density; right: share of points beyond d. Normal noise of that size follows the solid line, exp(−d²/2); "
        f"dashed: the same for {scale:.2f} times the noise, the size found. Points above the lines on the right are "
        "outliers within the limit of rejection, or a systematic part."
    )
    return drawn.with_title("Distribution of the residuals", caption)


def draw_image_residuals(calibration: Calibration) -> Figure:
    """Draw the rms residual of each image with rejected points and images."""
    whole = [item for item in calibration.rejections if item.points == 0]
    drawn = empty_figure("pictures", 2.8)
    (panel,) = drawn.panels
    highest = 0.0
    for offset, side in zip((-0.21, 0.21), SIDES, strict=True):
        views = [(number, p) for number, p in enumerate(images_of_camera(calibration, side), 1) if p is not None]
        x = np.array([number + offset for number, _ in views])
        rms = np.nan_to_num([p.rms_px for _, p in views])
        highest = max(highest, float(rms.max(initial=0.0)))
        names = tuple(f"view {number}, {int((~p.used).sum())} points rejected" for number, p in views)
        label = f"{side}, all {two_digits(calibration.rms_sides_px[SIDES.index(side)])} px"
        look = {"colour": SIDE_COLOUR[side], "names": names}
        panel.boxes((x - 0.19, x + 0.19), (np.zeros(len(x)), rms), label, **look)
        panel.rule(calibration.rms_sides_px[SIDES.index(side)], label, colour=SIDE_COLOUR[side], dashed=True)
        some = [(number, int((~p.used).sum())) for number, p in views if not p.used.all()]
        if some:
            at, counts = zip(*some, strict=True)
            panel.text(np.array(at) + offset, np.zeros(len(at)), [str(n) for n in counts], offset_px=(0.0, 7.0))
    start = len(calibration.views) + 1.0
    if whole:
        panel.span(start - 0.4, start + len(whole) - 0.6, along="x")
        names = tuple(item.name for item in whole)
        number = start + np.arange(len(whole))
        panel.points(number, np.full(len(whole), 0.06 * highest), "dropped", marker="x", colour=RED, names=names)
    panel.x.limits = (0.4, start + len(whole) - (0.4 if whole else 0.5))
    panel.y.limits = (0.0, 1.15 * highest or 1.0)
    panel.x.grid = False
    panel.x.label, panel.y.label = "view", "rms length / px"
    caption = (
        "Rms length of the residuals in every image; numbers in the bars count the rejected points, crosses are "
        "rejected images. Lines: rms over all images of the camera. An image with large residuals was "
        "blurred, or the target moved between the exposures of the two cameras."
    )
    return drawn.with_title("Residuals of each image", caption)
