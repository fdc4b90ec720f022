"""Figures of an acceptance test: noise, fields over the image, steps of the stage."""

from __future__ import annotations

import numpy as np

from fusion.base import prefix
from fusion.cameras.accept.moved_plate import MotionTest
from fusion.cameras.accept.stationary_scene import COMPONENTS, StationaryTest
from fusion.cameras.camera_figures import LONGEST_SHARE, draw_arrows, two_digits
from fusion.report.figure import BLACK, BLUE, COLOURS, GREY, PURPLE, Figure, Panel, Scale, empty_figure
from shaker.lines.spectrum import amplitude_spectrum
from shakercal._common.arrays import FloatArray

HALVES = (("translation", slice(0, 3), "m"), ("rotation", slice(3, 6), "rad"))
FIELD_QUANTILE = 0.99
"""Share of the points whose values are inside the colour scale."""
PALE = 2.5
"""End of a colour scale over the largest value where arrows are drawn on the colours."""


def draw_drift(test: StationaryTest) -> Figure:
    """Draw the six components of the scene at rest over time."""
    drawn = empty_figure("drift", 3.0, 1, 2)
    for panel, (title, part, unit) in zip(drawn.panels, HALVES, strict=True):
        factor, letter = prefix(test.pose[:, part])
        for colour, name, column in zip(COLOURS, COMPONENTS[part], test.pose[:, part].T, strict=False):
            panel.line(test.time, column / factor, name, colour=colour, width=0.8)
        panel.x.label = "time / s" if test.has_rate else "frame"
        panel.y.label, panel.title = f"{title} / {letter}{unit}", title
    caption = (
        "Apparent motion of the body at rest about its centre, in the left camera's axes. A slope is a drift, usually "
        "by warm-up; it ends when cameras and room are in balance. A regular wave is a vibration."
    )
    return drawn.with_title("Scene at rest over time", caption)


def draw_noise_spectrum(test: StationaryTest) -> Figure:
    """Draw the amplitude spectrum of the scene at rest, with predicted noise and vibrations."""
    drawn = empty_figure("noise-spectrum", 3.0, 1, 2)
    rate = 1.0 / float(test.time[1] - test.time[0])
    spectrum = amplitude_spectrum(test.pose, rate)
    for panel, (title, part, unit) in zip(drawn.panels, HALVES, strict=True):
        values = spectrum.amplitude[1:-1, part]
        factor, letter = prefix(values)
        for colour, name, column in zip(COLOURS, COMPONENTS[part], values.T, strict=False):
            panel.line(spectrum.frequency_hz[1:-1], column / factor, name, colour=colour, width=0.8)
        # mean amplitude of white noise in a bin of the Hann spectrum: √(π/4) of its rms, 2·σ·√(1.5/N)
        floor = test.predicted[part] * 2.0 * np.sqrt(1.5 / len(test.time)) * np.sqrt(np.pi) / 2.0
        for colour, at in zip(COLOURS, (floor / factor).tolist(), strict=False):
            panel.rule(at, "", colour=colour, dashed=True)
        panel.rule(test.lines.frequency_hz, "vibration", along="x", colour=PURPLE, width=2.0)
        panel.y.log = True
        panel.x.label = "frequency / Hz" if test.has_rate else "periods per frame"
        panel.y.label, panel.title = f"amplitude / {letter}{unit}", title
    caption = (
        "Amplitude spectrum of the scene at rest. Dashed, in the colour of each component: noise that the Cramér–Rao "
        "bound of these images predicts for it. A flat spectrum at this level is the best that the images permit. A "
        "peak is a vibration, or the alias of a faster one; a rise to low frequencies is drift or moving air."
    )
    return drawn.with_title("Noise spectrum of the scene at rest", caption, main=True)


def draw_fields(test: MotionTest) -> Figure:
    """Draw epipolar residuals, scale, strain and bending over the left image."""
    drawn = empty_figure(f"fields-{test.label}".replace(" ", "-"), 6.6, 2, 2, shared_x=False)
    residual, scale, strain, bending = drawn.panels
    field = test.field
    places = test.position_px
    side = float(2 * test.tracked.radius_px + 1)
    _colours(residual, places, side, test.epipolar_px, "epipolar residual / px")
    residual.title = f"epipolar residual, rms {two_digits(float(np.sqrt(np.mean(test.epipolar_px**2))))} px"
    if test.kind == "translation":
        relative, _ = field.scale_over_field(field.axes.T @ test.direction)
        _colours(scale, places, side, 100.0 * relative, "change of the scale / %")
        scale.title = f"scale over the field, ±{two_digits(100.0 * float(np.max(np.abs(relative))))} %"
    else:
        factor, letter = prefix(test.travel * field.remainder)
        down = test.travel * field.remainder[:, 1]
        _colours(scale, places, side, down / factor, f"departure down / {letter}m")
        scale.title = "departure from rigid motion and strain, down"
    strains = 1e6 * test.travel * field.strain_map
    _colours(strain, places, side, strains, "strain / 10⁻⁶")
    strain.title = "apparent strain at the end of the motion"
    out = test.travel * field.remainder[:, 2]
    factor, letter = prefix(out)
    _colours(bending, places, side, out / factor, f"out of plane / {letter}m", PALE)
    width = float(np.ptp(places[:, 0]))
    longest = draw_arrows(bending, places, test.travel * field.remainder[:, :2], LONGEST_SHARE * width, BLACK)
    factor, letter = prefix(longest)
    bending.title = f"residual vectors, longest {two_digits(longest / factor)} {letter}m"
    for panel in drawn.panels:
        panel.x.limits = (float(places[:, 0].min()) - side, float(places[:, 0].max()) + side)
        panel.y.limits = (float(places[:, 1].max()) + side, float(places[:, 1].min()) - side)  # y down
        panel.equal, panel.x.grid, panel.y.grid = True, False, False
        panel.x.label, panel.y.label = "x / px", "y / px"
    caption = (
        "Each square is a subset in the left image. With a rigid body and a right calibration all four show noise "
        "without a pattern. A plane of epipolar residuals indicates a rotated camera, a slope across the image a "
        "wrong focal length, a curved field of scale a wrong distortion."
    )
    return drawn.with_title(f"Residual fields, {test.label}", caption, main=test.kind == "translation")


def _colours(panel: Panel, places: FloatArray, side: float, values: FloatArray, label: str, reach: float = 1.0) -> None:
    """Draw a signed field as coloured squares, symmetric about zero.

    The scale ends at `reach` times the largest values.
    """
    largest = reach * (float(np.quantile(np.abs(values), FIELD_QUANTILE)) or 1.0)
    panel.squares(
        places, side, values=np.clip(values, -largest, largest), scale=Scale("RdBu", -largest, largest, label)
    )


def draw_steps(test: MotionTest) -> Figure:
    """Draw departures along and across the stage over its positions, with U."""
    drawn = empty_figure(f"steps-{test.name}".replace(" ", "-"), 2.9, 1, 2)
    along, across = drawn.panels
    departure = test.departure_m @ test.direction
    u = np.sqrt(np.einsum("i,fij,j->f", test.direction, test.motion.covariance[:, :3, :3], test.direction))
    factor, letter = prefix(np.concatenate([departure, 2.0 * u]))
    position = 1e3 * test.along
    along.points(position, departure / factor, "steps", half_y=2.0 * u / factor, colour=BLUE)
    along.rule(0.0, colour=GREY)
    along.y.label, along.title = f"departure / {letter}m", "along the stage, scale removed"
    factor, letter = prefix(test.departure_m)
    for colour, name, column in zip(COLOURS, ("x", "y", "z"), test.departure_m.T, strict=False):
        across.points(position, column / factor, name, colour=colour)
    across.rule(0.0, colour=GREY)
    across.y.label, across.title = f"departure / {letter}m", "from a straight line, left camera's axes"
    for panel in drawn.panels:
        panel.x.label = "position of the stage / mm"
    caption = (
        "Measured positions of the plate's centre less the straight line through them. A loop between forward and "
        "return steps is backlash or drift, a parabola a curved stage or a wrong calibration."
    )
    return drawn.with_title(f"Steps, {test.label}", caption)


def draw_local_scale(tests: tuple[MotionTest, ...]) -> Figure:
    """Draw the local scale of single points over their place on the plate."""
    drawn = empty_figure("scale", 2.9, 1, max(len(tests), 1))
    for panel, test in zip(drawn.panels, tests, strict=True):
        direction = test.field.axes.T @ test.direction
        scale = test.field.slope @ direction
        for colour, name, place in zip(COLOURS, ("right", "down"), test.field.plane_m.T, strict=False):
            panel.points(1e3 * place, 1e2 * (scale - 1.0), f"over the place to the {name}", colour=colour, size=2.2)
        panel.rule(0.0, colour=GREY)
        panel.x.label, panel.y.label = "place on the plate / mm", "error of the scale / %"
        panel.title = test.label
    caption = (
        "Displacement of each point over the stated travel, less 1. The mean is the error of the scale, its slope and "
        "curvature over the plate are the change over the field. Each dot has the noise of its subset."
    )
    return drawn.with_title("Scale over the plate", caption)
