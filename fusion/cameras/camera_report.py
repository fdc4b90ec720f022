"""Page of a calibration, every number rounded to its U (k = 2)."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from markupsafe import Markup

from fusion.cameras.camera_figures import (
    draw_correlation,
    draw_coverage,
    draw_distortion,
    draw_distribution,
    draw_image_residuals,
    draw_residuals,
    draw_shape,
    draw_views,
)
from fusion.cameras.camera_quantities import (
    LENGTH_SHARE,
    SIDES,
    ResidualParts,
    Side,
    axes_angle_rad,
    baseline_m,
    camera_of,
    correlation,
    covariance_of,
    distance_m,
    images_of_camera,
    length_u,
    residual_parts,
    target_middles_m,
    tilts_rad,
    turns_rad,
    working_point_m,
)
from fusion.report.folder import Provenance, origin_frame, render_page
from fusion.report.table import Headline, Table, TableColumn, page_column, table
from photogram.calibration.calibration_result import CalibratedImage, Calibration, CalibrationParameter, Rejection
from photogram.camera import RIG_PARAMETERS, ROTATION, StereoRig
from photogram.geometry import vector_from_rotation
from shakercal._common.arrays import IntArray
from shakercal._common.digits import (
    DASH,
    number_text,
    quantity_text,
    round_to_uncertainty,
    signed_text,
    small,
    times_ten,
)

STATES = {
    "determined": "determined",
    "indistinct": "not significantly different from zero",
    "undetermined": "not determined by these views",
}
MEANINGS = {
    "fx": "focal length across",
    "fy": "focal length down",
    "cx": "principal point, x",
    "cy": "principal point, y",
    "k1": "radial distortion, r²",
    "k2": "radial distortion, r⁴",
    "k3": "radial distortion, r⁶",
    "k4": "radial distortion, r² of the denominator",
    "k5": "radial distortion, r⁴ of the denominator",
    "k6": "radial distortion, r⁶ of the denominator",
    "skew": "skew of the pixel axes",
    "p1": "tangential distortion, down",
    "p2": "tangential distortion, across",
    "rotation": "rotation vector, right from left",
    "translation": "translation, right from left",
}
KINDS = {
    "chessboard": "chessboard",
    "charuco": "ChArUco board",
    "aprilgrid": "AprilGrid",
    "dots": "dots",
    "asymmetric-dots": "dots in staggered rows",
}
STRONGEST = 8  # correlations listed
DISPLAY = {"m": (1e3, "mm"), "1": (1.0, "")}
"""Factor and name of units that are displayed in another unit."""


def verdict(calibration: Calibration) -> str:
    """Return the first warning and the undetermined parameters in one or two sentences."""
    warnings = [notice for notice in calibration.notices if notice.severity == "warning"]
    missing = [item.name for item in calibration.parameters if item.state == "undetermined"]
    text = "Number, position and angle of the views and the residuals give no warning."
    if warnings:
        where = f" ({warnings[0].where})" if warnings[0].where else ""
        count = "One warning" if len(warnings) == 1 else f"{len(warnings)} warnings, the first"
        text = f"{count}{where}: {warnings[0].text}"
    if missing:
        text += f" Not determined by these views: {', '.join(missing)}."
    return text


def subject(calibration: Calibration) -> list[tuple[str, str]]:
    """Return the target, its spacing and the image sizes."""
    target = calibration.target
    size = f", {target.size[0]} × {target.size[1]}" if target.size is not None else ""
    sizes = [
        " × ".join(str(int(n)) for n in camera.size_px) for camera in (calibration.rig.left, calibration.rig.right)
    ]
    spacing = quantity_text(1e3 * target.spacing_m, 2e3 * target.spacing_m * calibration.scale_u, "mm")
    stated = f"{spacing}, k = 2" if calibration.scale_u > 0 else f"{spacing}, its uncertainty not stated"
    gap = f", gaps of {number_text(target.tag_spacing, 6)} tags" if target.tag_spacing is not None else ""
    return [
        ("Target", f"{KINDS[target.kind]}{size}{gap}"),
        ("Spacing", stated),
        ("Images", f"{sizes[0]} px" if sizes[0] == sizes[1] else f"left {sizes[0]} px, right {sizes[1]} px"),
    ]


def camera_headlines(calibration: Calibration) -> list[Headline]:
    """Return the main results."""
    rig = calibration.rig
    baseline, angle = baseline_m(rig), axes_angle_rad(rig)
    left, right = calibration.rms_sides_px
    noise = ", ".join(f"{value:.3f}" for value in calibration.added_px)
    share = 200.0 * baseline.u / baseline.value
    distances = 1e3 * np.linalg.norm(target_middles_m(calibration), axis=1)
    middle = float(np.median(distances))
    pixel = 1e3 * middle / float(rig.left.matrix[0, 0])
    spacing, scale, common = (
        "missing",
        "not stated",
        "the uncertainty of all lengths does not include that of the spacing",
    )
    if calibration.scale_u > 0:
        spacing, scale = "included", f"U (k = 2) = {small(200.0 * calibration.scale_u)} %"
        common = "common to all points and all frames"
    return [
        Headline(
            "Residuals of the pair, rms length",
            f"{calibration.rms_px:.3f} px",
            f"left {left:.3f} px, right {right:.3f} px; additional noise: {noise} px per coordinate",
        ),
        _views_headline(calibration),
        Headline(
            "Baseline",
            quantity_text(1e3 * baseline.value, 2e3 * baseline.u, "mm"),
            f"U (k = 2) = {number_text(share, 2)} %, the spacing's uncertainty {spacing}",
        ),
        Headline(
            "Angle between the optical axes",
            quantity_text(float(np.degrees(angle.value)), float(np.degrees(2.0 * angle.u)), "°").replace(" °", "°"),
            quantity_text(1e3 * angle.value, 2e3 * angle.u, "mrad"),
        ),
        *(_focal_headline(calibration, side) for side in SIDES),
        Headline(
            "Working distance, median of the views",
            f"{middle:.0f} mm",
            f"{distances.min():.0f} mm to {distances.max():.0f} mm; 1 px is {pixel:.0f} µm in the middle",
        ),
        Headline("Scale: share of every length from the target's spacing", scale, common),
    ]


def parameters_table(calibration: Calibration) -> Table | None:
    """Return all parameters of the pair with uncertainty and state."""
    turn = vector_from_rotation(calibration.rig.right_from_left.rotation)
    turns = dict(zip(RIG_PARAMETERS[ROTATION], turn, strict=True))

    def printed(item: CalibrationParameter) -> tuple[str, str, str, str]:
        """Value, u and U with one power of ten, and their unit."""
        factor, unit = DISPLAY.get(item.unit, (1.0, item.unit))
        value, u = factor * float(turns.get(item.name, item.value)), factor * item.u
        text = round_to_uncertainty(value, 2.0 * u)
        shown = times_ten(text.exponent, unit) or "1"
        return text.value, round_to_uncertainty(value, u, text.exponent).expanded, text.expanded, shown

    def meaning(item: CalibrationParameter) -> str:
        part, _, name = item.name.partition(".")
        return f"{MEANINGS[part]}, {name}" if part in MEANINGS else MEANINGS.get(name, "")

    columns: list[TableColumn[CalibrationParameter]] = [
        page_column("parameter", lambda item: item.name, "l"),
        page_column("meaning", meaning, "l"),
        page_column("value", lambda item: printed(item)[0]),
        page_column("u (k = 1)", lambda item: printed(item)[1]),
        page_column("U (k = 2)", lambda item: printed(item)[2]),
        page_column("unit", lambda item: printed(item)[3], "l"),
        page_column("state", lambda item: STATES[item.state] if item.u > 0 else "fixed", "l"),
    ]
    return table("Parameters of the pair", columns, calibration.parameters)


def judgement_table(calibration: Calibration) -> Table | None:
    """Return the results of halves of the views and of alternative models."""
    judged = calibration.cross_validation
    if judged is None:
        return None
    taken = f"{judged.shape}, {judged.lens}"
    rows = [(f"all views ({taken})", calibration.rig, f"{judged.predicted_px:.4f}")]
    rows += [
        (f"{name} half of the views", rig, DASH)
        for name, rig in zip(("odd", "even"), judged.halves or (), strict=False)
    ]
    rows += [(f"all views ({o.shape}, {o.lens})", o.rig, f"{o.predicted_px:.4f}") for o in judged.alternatives]
    whole = calibration.rig
    focal_u = [np.sqrt(camera_of(whole, side)[1][0, 0]) for side in SIDES]
    baseline, angle = baseline_m(whole), axes_angle_rad(whole)

    def length(rig: StereoRig) -> str:
        return round_to_uncertainty(
            1e3 * float(np.linalg.norm(rig.right_from_left.translation_m)), 2e3 * baseline.u
        ).value

    def turn(rig: StereoRig) -> str:
        return round_to_uncertainty(
            np.degrees(np.arccos(rig.right_from_left.rotation[2, 2])), np.degrees(2 * angle.u)
        ).value

    columns: list[TableColumn[tuple[str, StereoRig, str]]] = [
        page_column("from", lambda row: row[0], "l"),
        page_column("fx, left / px", lambda row: round_to_uncertainty(row[1].left.matrix[0, 0], 2 * focal_u[0]).value),
        page_column(
            "fx, right / px", lambda row: round_to_uncertainty(row[1].right.matrix[0, 0], 2 * focal_u[1]).value
        ),
        page_column("baseline / mm", lambda row: length(row[1])),
        page_column("angle / °", lambda row: turn(row[1])),
        page_column("predicted views, rms length / px", lambda row: row[2]),
    ]
    return table("Results of halves of the views and of other models for the same images", columns, rows)


def views_share(calibration: Calibration) -> str:
    """Return the increase of the uncertainties by the scatter of the views."""
    if calibration.cross_validation is None or calibration.rig.covariance is None:
        return ""
    u, alone = np.sqrt(np.diagonal(calibration.rig.covariance)), calibration.cross_validation.u_fit
    more = (u / np.where(alone > 0, alone, np.inf))[[item.u > 0 and item.unit != "m" for item in _every(calibration)]]
    return f"{float(np.median(more)):.2g} (median of the parameters), at most {float(more.max()):.2g}"


def _every(calibration: Calibration) -> list[CalibrationParameter]:
    """Return the rig's parameters, including fixed ones."""
    named = {item.name: item for item in calibration.parameters}
    return [named.get(name, CalibrationParameter(name, 0.0, 0.0, "1", "determined")) for name in RIG_PARAMETERS]


def correlations_table(calibration: Calibration) -> Table | None:
    """Return the strongest correlations of different parameters."""
    coefficients = np.nan_to_num(correlation(covariance_of(calibration.rig)))
    pairs = np.column_stack(np.triu_indices(len(coefficients), 1))
    order = np.argsort(-np.abs(coefficients[tuple(pairs.T)]))[:STRONGEST]
    columns: list[TableColumn[IntArray]] = [
        page_column("parameter", lambda pair: RIG_PARAMETERS[pair[0]], "l"),
        page_column("with", lambda pair: RIG_PARAMETERS[pair[1]], "l"),
        page_column("coefficient", lambda pair: signed_text(float(coefficients[tuple(pair)]), "+.4f")),
    ]
    return table("Strongest correlations", columns, pairs[order])


def residuals_table(calibration: Calibration) -> Table | None:
    """Return the common parts of the residuals."""
    columns: list[TableColumn[tuple[str, ResidualParts]]] = [
        page_column("camera", lambda row: row[0], "l"),
        page_column("all", lambda row: f"{row[1].whole_px:.3f}"),
        page_column("same position in the image", lambda row: f"{row[1].position_px:.3f}"),
        page_column("same point of the target", lambda row: f"{row[1].point_px:.3f}"),
        page_column("neighbours in one image", lambda row: f"{row[1].smooth_px:.3f}"),
        page_column("each point alone", lambda row: f"{row[1].alone_px:.3f}"),
        page_column("same point of the target / µm", lambda row: f"{1e6 * row[1].point_m:.1f}"),
    ]
    parts = [(side, residual_parts(calibration, side)) for side in SIDES]
    return table("Common parts of the residuals, rms length / px", columns, parts)


def lengths_table(calibration: Calibration) -> Table | None:
    """Return the uncertainty of a length at the working point by the calibration."""
    length = LENGTH_SHARE * float(np.linalg.norm(working_point_m(calibration)))
    columns: list[TableColumn[tuple[str, float]]] = [
        page_column("along, left camera", lambda row: row[0], "l"),
        page_column("U (k = 2) / %", lambda row: small(200.0 * row[1])),
        page_column(f"U (k = 2) of {1e3 * length:.0f} mm / µm", lambda row: small(1e6 * 2.0 * row[1] * length)),
    ]
    directions = zip(("x, to the right", "y, down", "z, away from the camera"), length_u(calibration), strict=True)
    return table(
        "Uncertainty of lengths at the centre of the target's positions by the calibration", columns, directions
    )


def views_table(calibration: Calibration) -> Table | None:
    """Return every view with images, fitted points, residuals and target pose."""
    tilt = np.degrees(np.linalg.norm(tilts_rad(calibration), axis=1))
    turn = np.degrees(turns_rad(calibration))
    lengths = (distance_m(calibration, view) for view in calibration.views)
    distances = [quantity_text(1e3 * length.value, 2e3 * length.u) for length in lengths]

    every = calibration.target.points

    def both(index: int, shown: Callable[[CalibratedImage], str]) -> Markup:
        """Return a cell with the entry of the left image above that of the right."""
        view = calibration.views[index]
        cells = (DASH if image is None else shown(image) for image in (view.left, view.right))
        return Markup("{}<br>{}").format(*cells)

    columns: list[TableColumn[int]] = [
        page_column("view", lambda index: str(index + 1)),
        page_column("image, left and right", lambda index: both(index, lambda p: p.name), "l"),
        page_column("points", lambda index: both(index, lambda p: f"{int(p.used.sum())} of {every or len(p.used)}")),
        page_column(
            "rms length / px", lambda index: both(index, lambda p: f"{p.rms_px:.3f}" if p.used.any() else DASH)
        ),
        page_column("tilt / °", lambda index: f"{tilt[index]:.1f}"),
        page_column("turn / °", lambda index: signed_text(float(turn[index]), ".1f")),
        page_column("distance / mm", lambda index: distances[index]),
    ]
    caption = (
        f"Views: points in the fit of {'those found' if every is None else 'the target'}; "
        "distance of the target's middle from the left camera with U (k = 2)"
    )
    return table(caption, columns, range(len(calibration.views)))


def dropped_table(calibration: Calibration) -> Table | None:
    """Return the rejected images and points with the reason."""
    columns: list[TableColumn[Rejection]] = [
        page_column("image", lambda item: item.name, "l"),
        page_column("points", lambda item: str(item.points) if item.points else "all"),
        page_column("reason", lambda item: item.reason, "l"),
    ]
    return table("Rejected from the fit", columns, sorted(calibration.rejections, key=lambda item: item.points > 0))


def _views_headline(calibration: Calibration) -> Headline:
    """Return the numbers of pairs, points and rejections."""
    seen = [image for side in SIDES for image in images_of_camera(calibration, side) if image is not None]
    used, every = sum(int(image.used.sum()) for image in seen), sum(len(image.used) for image in seen)
    pairs = sum(view.left is not None and view.right is not None for view in calibration.views)
    whole = sum(item.points == 0 for item in calibration.rejections)
    views, poses = len(calibration.views), calibration.pose_count()
    value = f"{pairs} pairs" + (f" in {views} views" if pairs < views else "")
    value += f" of {poses} poses" if poses < views else ""
    remark = f"{used} points in the fit, {every - used} rejected; images rejected: {whole}"
    return Headline("Views", value, remark)


def _focal_headline(calibration: Calibration, side: Side) -> Headline:
    """Return focal length and field of view of one camera."""
    fx, fy = (item for item in calibration.parameters if item.name in (f"{side}.fx", f"{side}.fy"))
    size = camera_of(calibration.rig, side)[0].size_px
    field = [2.0 * np.degrees(np.arctan(0.5 * n / item.value)) for n, item in zip(size, (fx, fy), strict=True)]
    down = quantity_text(fy.value, 2.0 * fy.u, "px")
    remark = f"fy = {down}; field of view {field[0]:.1f}° × {field[1]:.1f}°"
    return Headline(f"Focal length fx of the {side} camera", quantity_text(fx.value, 2.0 * fx.u, "px"), remark)


def render_camera_report(calibration: Calibration, name: str, provenance: Provenance, duration_s: float) -> str:
    """Return the HTML text of one self-contained page about the calibrated stereo pair `name`.

    `provenance`: hashes of the images, settings, versions and the names of the files written with the page.
    """
    shape = draw_shape(calibration)
    drawn = {
        "coverage": [draw_coverage(calibration), draw_views(calibration)],
        "residuals": [
            *(draw_residuals(calibration, side) for side in SIDES),
            draw_distribution(calibration),
            draw_image_residuals(calibration),
        ],
        "lens": [draw_distortion(calibration, side) for side in SIDES],
        "correlation": [draw_correlation(calibration)],
        "shape": [] if shape is None else [shape],
    }
    context = {
        "name": name,
        "subject": subject(calibration),
        "verdict": verdict(calibration),
        "headlines": camera_headlines(calibration),
        "pictures": drawn,
        "views": views_table(calibration),
        "dropped": dropped_table(calibration),
        "residuals": residuals_table(calibration),
        "parameters": parameters_table(calibration),
        "judged": judgement_table(calibration),
        "views_share": views_share(calibration),
        "correlations": correlations_table(calibration),
        "lengths": lengths_table(calibration),
        "scale_u": calibration.scale_u,
        **origin_frame(provenance, calibration.notices),
        "duration_s": duration_s,
        "files": provenance.files,
    }
    return render_page("cameras.html", context)
