"""The tables of the page of a camera calibration: every number rounded to its expanded uncertainty, k = 2."""

from __future__ import annotations

import numpy as np
from markupsafe import Markup

from fusion.camera_facts import (
    LENGTH_SHARE,
    ROTATION,
    SIDES,
    Side,
    axes_angle_rad,
    baseline_m,
    correlation,
    covariance_of,
    distance_m,
    length_u,
    pictures,
    residual_parts,
    target_middles_m,
    tilts_rad,
    turns_rad,
    working_point_m,
)
from fusion.polar import DASH, rounded
from fusion.report_numbers import measured, small, times_ten
from fusion.report_tables import Headline, Table
from photogram.calibrate.result import CalibratedPicture, Calibration, Parameter
from photogram.camera import RIG_PARAMETERS
from photogram.rigid import vector_from_rotation

STATES = {
    "determined": "determined",
    "indistinct": "not distinguishable from zero",
    "open": "not determined by these views",
}
MEANINGS = {
    "fx": "focal length across",
    "fy": "focal length down",
    "cx": "principal point, x",
    "cy": "principal point, y",
    "k1": "radial distortion, r²",
    "k2": "radial distortion, r⁴",
    "k3": "radial distortion, r⁶",
    "p1": "tangential distortion, down",
    "p2": "tangential distortion, across",
    "rotation": "rotation vector, right from left",
    "translation": "translation, right from left",
}
KINDS = {
    "chessboard": "chessboard",
    "charuco": "ChArUco board",
    "dots": "dots",
    "asymmetric-dots": "dots in staggered rows",
}
STRONGEST = 8  # correlations listed
DISPLAY = {"m": (1e3, "mm"), "1": (1.0, "")}
"""Factor and name of the units that are printed otherwise."""


def verdict(calibration: Calibration) -> str:
    """One or two plain sentences: whether something speaks against this calibration, and what first."""
    warnings = [notice for notice in calibration.notices if notice.severity == "warning"]
    missing = [item.name for item in calibration.parameters if item.state == "open"]
    text = "Nothing in number, place and angle of the views or in the residuals speaks against this calibration."
    if warnings:
        where = f" ({warnings[0].where})" if warnings[0].where else ""
        count = "One warning" if len(warnings) == 1 else f"{len(warnings)} warnings, the first"
        text = f"{count}{where}: {warnings[0].text}."
    if missing:
        text += f" Not determined by these views: {', '.join(missing)}."
    return text


def subject(calibration: Calibration) -> list[tuple[str, str]]:
    """What was calibrated with what."""
    target = calibration.target
    size = f", {target.size[0]} × {target.size[1]}" if target.size is not None else ""
    sizes = [
        " × ".join(str(int(n)) for n in camera.size_px) for camera in (calibration.rig.left, calibration.rig.right)
    ]
    spacing = measured(1e3 * target.spacing_m, 2e3 * target.spacing_m * calibration.scale_u, "mm").striptags()
    stated = f"{spacing}, k = 2" if calibration.scale_u > 0 else f"{spacing}, its uncertainty not stated"
    return [
        ("Target", f"{KINDS[target.kind]}{size}"),
        ("Spacing", stated),
        ("Pictures", f"{sizes[0]} px" if sizes[0] == sizes[1] else f"left {sizes[0]} px, right {sizes[1]} px"),
    ]


def camera_headlines(calibration: Calibration) -> list[Headline]:
    """The results to remember."""
    rig = calibration.rig
    baseline, angle = baseline_m(rig), axes_angle_rad(rig)
    left, right = calibration.rms_sides_px
    noise = ", ".join(f"{value:.3f}" for value in calibration.added_px)
    spacing = "included" if calibration.scale_u > 0 else "missing"
    share = 200.0 * baseline.u / baseline.value
    return [
        Headline(
            "Residuals of the pair, rms length",
            f"{calibration.rms_px:.3f} px",
            f"left {left:.3f} px, right {right:.3f} px; noise added to the points' own: {noise} px per coordinate",
        ),
        _views_headline(calibration),
        Headline(
            "Baseline",
            measured(1e3 * baseline.value, 2e3 * baseline.u, "mm"),
            f"U (k = 2) = {share:.2g} %, the spacing's uncertainty {spacing}",
        ),
        Headline(
            "Angle between the optical axes",
            measured(float(np.degrees(angle.value)), float(np.degrees(2.0 * angle.u)), "°").replace(" °", "°"),
            measured(1e3 * angle.value, 2e3 * angle.u, "mrad").striptags(),
        ),
        *(_focal_headline(calibration, side) for side in SIDES),
        _distance_headline(calibration),
        _scale_headline(calibration),
    ]


def parameters_table(calibration: Calibration) -> Table:
    """All parameters of the pair with their uncertainty and what the views say about them."""
    head = ("parameter", "meaning", "value", "u (k = 1)", "U (k = 2)", "unit", "state")
    turn = vector_from_rotation(calibration.rig.right_from_left.rotation)
    turns = dict(zip(RIG_PARAMETERS[ROTATION], turn, strict=True))
    rows = tuple(_parameter_row(item, float(turns.get(item.name, item.value))) for item in calibration.parameters)
    return Table("Parameters of the pair", head, "llrrrll", rows)


def correlations_table(calibration: Calibration) -> Table:
    """The strongest correlations of different parameters."""
    found = np.nan_to_num(correlation(covariance_of(calibration.rig)))
    first, second = np.triu_indices(len(found), 1)
    order = np.argsort(-np.abs(found[first, second]))[:STRONGEST]
    rows = tuple(
        (RIG_PARAMETERS[first[n]], RIG_PARAMETERS[second[n]], _signed(f"{found[first[n], second[n]]:+.4f}"))
        for n in order
    )
    return Table("Strongest correlations", ("parameter", "with", "coefficient"), "llr", rows)


def residuals_table(calibration: Calibration) -> Table:
    """What the residuals have in common."""
    rows = []
    for side in SIDES:
        parts = residual_parts(calibration, side)
        lengths = (parts.whole_px, parts.place_px, parts.point_px, parts.smooth_px, parts.alone_px)
        rows.append((side, *(f"{length:.3f}" for length in lengths), f"{1e6 * parts.point_m:.1f}"))
    shared = ("same place in the picture", "same point of the target", "neighbours in one picture", "each point alone")
    head = ("camera", "all", *shared, "same point of the target / µm")
    return Table("What the residuals have in common, rms length / px", head, "lrrrrrr", tuple(rows))


def lengths_table(calibration: Calibration) -> Table:
    """What the calibration leaves uncertain of a length at the working point."""
    relative = length_u(calibration)
    length = LENGTH_SHARE * float(np.linalg.norm(working_point_m(calibration)))
    ways = ("x, to the right", "y, down", "z, away from the camera")
    rows = tuple((way, small(200.0 * u), small(1e6 * 2.0 * u * length)) for way, u in zip(ways, relative, strict=True))
    head = ("along, left camera", "U (k = 2) / %", f"U (k = 2) of {1e3 * length:.0f} mm / µm")
    return Table("Lengths at the middle of the target's positions: what the calibration leaves", head, "lrr", rows)


def views_table(calibration: Calibration) -> Table:
    """Every view: pictures, points in the fit, residuals, and how the target was held."""
    tilt = np.degrees(np.linalg.norm(tilts_rad(calibration), axis=1))
    turn = np.degrees(turns_rad(calibration))
    rows = []
    for place, view in enumerate(calibration.views):
        distance = distance_m(calibration, view)
        both = (view.left, view.right)
        rows.append(
            (
                str(place + 1),
                _pair(*(picture.name if picture is not None else DASH for picture in both)),
                _pair(*(_points(picture) for picture in both)),
                _pair(*(_rms(picture) for picture in both)),
                f"{tilt[place]:.1f}",
                _signed(f"{turn[place]:.1f}"),
                measured(1e3 * distance.value, 2e3 * distance.u),
            )
        )
    head = ("view", "picture, left and right", "points", "rms length / px", "tilt / °", "turn / °", "distance / mm")
    caption = (
        "Views: points in the fit of those found; distance of the target's middle from the left camera with U (k = 2)"
    )
    return Table(caption, head, "rlrrrrr", tuple(rows))


def dropped_table(calibration: Calibration) -> Table | None:
    """What did not go into the fit, and why; pictures first."""
    ordered = sorted(calibration.dropped, key=lambda item: item.points > 0)
    rows = tuple((item.name, str(item.points) if item.points else "all", item.reason) for item in ordered)
    return Table("Left out of the fit", ("picture", "points", "reason"), "lrl", rows) if rows else None


def _views_headline(calibration: Calibration) -> Headline:
    """Numbers of pairs, points and what was dropped."""
    found = [picture for side in SIDES for picture in pictures(calibration, side) if picture is not None]
    used, every = sum(int(picture.used.sum()) for picture in found), sum(len(picture.used) for picture in found)
    pairs = sum(view.left is not None and view.right is not None for view in calibration.views)
    whole = sum(item.points == 0 for item in calibration.dropped)
    value = f"{pairs} pairs" if pairs == len(calibration.views) else f"{pairs} pairs in {len(calibration.views)} views"
    remark = f"{used} points in the fit, {every - used} left out; pictures dropped: {whole}"
    return Headline("Views", value, remark)


def _focal_headline(calibration: Calibration, side: Side) -> Headline:
    """Focal length of one camera, and what it sees."""
    fx, fy = (item for item in calibration.parameters if item.name in (f"{side}.fx", f"{side}.fy"))
    size = (calibration.rig.left if side == "left" else calibration.rig.right).size_px
    field = [2.0 * np.degrees(np.arctan(0.5 * n / item.value)) for n, item in zip(size, (fx, fy), strict=True)]
    down = measured(fy.value, 2.0 * fy.u, "px").striptags()
    remark = f"fy = {down}; field of view {field[0]:.1f}° × {field[1]:.1f}°"
    return Headline(f"Focal length fx of the {side} camera", measured(fx.value, 2.0 * fx.u, "px"), remark)


def _distance_headline(calibration: Calibration) -> Headline:
    """Where the target was, and the size of a pixel there."""
    distances = 1e3 * np.linalg.norm(target_middles_m(calibration), axis=1)
    middle = float(np.median(distances))
    pixel = 1e3 * middle / float(calibration.rig.left.matrix[0, 0])
    remark = f"{distances.min():.0f} mm to {distances.max():.0f} mm; 1 px is {pixel:.0f} µm in the middle"
    return Headline("Working distance, median of the views", f"{middle:.0f} mm", remark)


def _scale_headline(calibration: Calibration) -> Headline:
    """The part of the uncertainty that all lengths share."""
    label = "Scale: share of every length from the target's spacing"
    if calibration.scale_u == 0:
        return Headline(label, "not stated", "the uncertainty of the spacing is missing in all lengths")
    return Headline(label, f"U (k = 2) = {small(200.0 * calibration.scale_u)} %", "common to all points and all frames")


def _parameter_row(item: Parameter, plain: float) -> tuple[str, ...]:
    """One parameter of plain value; value, u and U with the same power of ten."""
    factor, unit = DISPLAY.get(item.unit, (1.0, item.unit))
    value, u = factor * plain, factor * item.u
    text = rounded(value, 2.0 * u)
    standard = rounded(value, u, text.exponent).expanded
    part, _, name = item.name.partition(".")
    meaning = f"{MEANINGS[part]}, {name}" if part in MEANINGS else MEANINGS.get(name, "")
    state = STATES[item.state] if item.u > 0 else "held"
    shown = times_ten(text.exponent, unit) if text.exponent else Markup(unit or "1")
    return item.name, meaning, text.value, standard, text.expanded, shown, state


def _points(picture: CalibratedPicture | None) -> str:
    """Points in the fit of those found."""
    return f"{int(picture.used.sum())} of {len(picture.used)}" if picture is not None else DASH


def _rms(picture: CalibratedPicture | None) -> str:
    """Rms length of one picture's residuals."""
    return f"{picture.rms_px:.3f}" if picture is not None and picture.used.any() else DASH


def _pair(left: str, right: str) -> Markup:
    """A cell with the entry of the left camera above that of the right."""
    return Markup("{}<br>{}").format(left, right)


def _signed(text: str) -> str:
    """Number with a typographic minus."""
    return text.replace("-", "\N{MINUS SIGN}")
