"""Figures of stereo pairs: motion, deformation, stability of the cameras, and tracked surfaces."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from fusion.base import prefix
from fusion.phasors.deformation import DeflectionShape, ShapePhasors
from fusion.phasors.stereo_phasors import StereoResult
from fusion.report.figure import (
    BLACK,
    BLUE,
    COLOURS,
    GREY,
    ORANGE,
    PHASE_COLOURS,
    RED,
    Figure,
    Panel,
    Scale,
    empty_figure,
)
from fusion.report.page_images import neighbour_distance, shown_grey
from fusion.sensitivity.analyse import Evaluation
from photogram.measure.epipolar import COVERAGE, EpipolarCheck
from shaker.frf.sampled_motion import SampledFit
from shaker.labels import AXES, MOTION_COMPONENTS, component_units
from shaker.sine.aliasing import alias_frequency
from shakercal._common.arrays import BoolArray, ComplexArray, FloatArray, IntArray
from shakercal._common.digits import number_text, quantity_text

# Figure of one stereo pair: how its body bends at a line, out of its plane and in it.


OUT_QUANTILE, INSIDE_QUANTILE = 2.448, 3.080
"""Amplitude of one and of two components, in standard uncertainties of their parts, that noise exceeds at 5 % of the
points: square roots of the 95 % quantiles of chi-square with 2 and 4 degrees of freedom.
"""
LONGEST_ARROW = 1.6  # distances between neighbours
PANEL_IN, TALLEST_IN, FLATTEST_IN = 2.2, 3.2, 0.8
FIGURE_MARGIN_IN = 1.45
"""Height of title, labels and colour bar around the panels."""
MARGIN_SHARE = 0.03
"""Margin around the body, over its size."""


@dataclass(frozen=True)
class _View:
    """Deflection shape at one line as it is drawn.

    `plan_mm` (N, 2): positions; `out` (N,): out of plane; `inside` (N, 2): in plane; with the levels of noise.
    """

    plan_mm: FloatArray
    out: ComplexArray
    out_level: FloatArray
    inside: ComplexArray
    inside_level: FloatArray
    normal: int
    across: tuple[int, int]

    @cached_property
    def side_mm(self) -> float:
        """Distance of neighbouring points."""
        return neighbour_distance(self.plan_mm, 1e-6)

    @property
    def limits_mm(self) -> tuple[FloatArray, FloatArray]:
        """Lower and upper corner of the panels: the whole body with a margin."""
        low, high = self.plan_mm.min(axis=0), self.plan_mm.max(axis=0)
        margin = 1.2 * self.side_mm + MARGIN_SHARE * float((high - low).max())
        return low - margin, high + margin

    @property
    def height_in(self) -> float:
        """Height of the panels for equal scales."""
        low, high = self.limits_mm
        return float(np.clip(PANEL_IN * (high[1] - low[1]) / (high[0] - low[0]), FLATTEST_IN, TALLEST_IN))


def draw_deflection(shape: DeflectionShape, line: int, rigid: ComplexArray, name: str, body: str) -> Figure | None:
    """Draw the deflection shape: amplitude and phase out of plane, and in plane.

    `rigid` (6,): displacement phasors of the body at this line; phases are relative to its largest translation. None if
    fewer than three points have a deflection.
    """
    finite = np.isfinite(shape.value[line]).all(axis=1)
    if finite.sum() < 3:
        return None
    view = _view(shape.reference_m[finite], shape.value[line][finite], shape.u[line][finite])
    leader = int(np.argmax(np.abs(rigid[:3])))
    above = np.abs(view.out) > view.out_level
    drawn = empty_figure(f"deflection-{name}", view.height_in + FIGURE_MARGIN_IN, 1, 3)
    panels = drawn.panels
    _draw_amplitude(panels[0], view)
    _draw_phase(panels[1], view, above, (float(np.angle(rigid[leader])), AXES[leader]))
    _draw_in_plane(panels[2], view)
    low, high = view.limits_mm
    for panel in panels:
        panel.x.limits, panel.y.limits = (low[0], high[0]), (low[1], high[1])
        panel.equal, panel.x.grid, panel.y.grid = True, False, False
        panel.x.label = f"{AXES[view.across[0]]} / mm"
    panels[0].y.label = f"{AXES[view.across[1]]} / mm"
    caption = (
        f"Motion of the {body} in addition to its rigid motion at {shape.frequency_hz[line]:.4f} Hz, by stereo pair "
        f"“{name}” (peak values). Left: amplitude along {AXES[view.normal]}, out of the plane of the points; "
        f"{above.sum()} of {len(above)} points are above the noise level, which noise alone exceeds at one point "
        f"in twenty. Middle: phase against the rigid translation along {AXES[leader]}, grey where the amplitude "
        "is below that level. Right: deflection in the plane at the instant of its largest extent, grey below "
        "the noise level. Bending appears smaller by its best-fit rigid motion."
    )
    return drawn.with_title(f"Operating deflection shape seen by {name}", caption)


def _view(reference_m: FloatArray, value: ComplexArray, u: FloatArray) -> _View:
    """Return plan and components of a shape (N, 3) in the points' best-fit plane."""
    _, _, axes = np.linalg.svd(reference_m - reference_m.mean(axis=0), full_matrices=False)
    normal = axes[2]
    main = int(np.argmax(np.abs(normal)))
    normal = normal * np.sign(normal[main])
    first, second = (axis for axis in range(3) if axis != main)
    out = value @ normal
    inside = (value - out[:, None] * normal)[:, [first, second]]
    return _View(
        plan_mm=1e3 * reference_m[:, [first, second]],
        out=out,
        out_level=OUT_QUANTILE * np.sqrt(u**2 @ normal**2),
        inside=inside,
        inside_level=INSIDE_QUANTILE * np.sqrt(np.mean(u[:, [first, second]] ** 2, axis=1)),
        normal=main,
        across=(first, second),
    )


def _draw_amplitude(panel: Panel, view: _View) -> None:
    """Draw squares coloured by the amplitude out of the plane."""
    factor, letter = prefix(np.abs(view.out))
    largest = float(np.abs(view.out).max()) / factor
    level = float(np.median(view.out_level)) / factor
    scale = Scale("viridis", 0.0, max(largest, level), f"amplitude / {letter}m")
    panel.squares(view.plan_mm, 0.94 * view.side_mm, values=np.abs(view.out) / factor, scale=scale)
    panel.title = f"out of plane ({AXES[view.normal]}), noise {level:#.2g} {letter}m"


def _draw_phase(panel: Panel, view: _View, above: NDArray[np.bool_], leader: tuple[float, str]) -> None:
    """Draw squares coloured by the phase out of plane, for amplitudes above the noise."""
    phase = np.degrees(np.angle(view.out * np.exp(-1j * leader[0])))
    scale = Scale(PHASE_COLOURS, -180.0, 180.0, f"phase against {leader[1]} / °")
    panel.squares(view.plan_mm, 0.94 * view.side_mm, values=np.where(above, phase, np.nan), scale=scale)
    panel.title = f"out of plane ({AXES[view.normal]}), phase"


def _draw_in_plane(panel: Panel, view: _View) -> None:
    """Draw arrows at the instant of the largest deflection in the plane."""
    instant = np.exp(-0.5j * np.angle(np.sum(view.inside**2)))
    vector = (view.inside * instant).real
    length = np.sqrt(np.sum(np.abs(view.inside) ** 2, axis=1))
    factor, letter = prefix(vector)
    longest = max(float(np.quantile(np.hypot(vector[:, 0], vector[:, 1]), 0.98)), 1e-12 * factor)
    shown = vector * (LONGEST_ARROW * view.side_mm / longest)
    weak = length <= view.inside_level
    for mask, colour in ((~weak, BLUE), (weak, GREY)):
        if mask.any():
            panel.arrows(view.plan_mm[mask], shown[mask], colour=colour)
    level = float(np.median(view.inside_level)) / factor
    names = ", ".join(AXES[axis] for axis in view.across)
    panel.title = f"in plane ({names}): longest {longest / factor:#.2g}, noise {level:#.2g} {letter}m"


# Figures of one stereo pair: motion over time and folded, residuals, and the first image.


MEASURED: dict[str, Any] = {"label": "measured", "colour": BLUE, "size": 2.6}
FITTED: dict[str, Any] = {"label": "sine approximation", "colour": RED}
BY_CHANNELS = "motion by the channels"
CURVE_POINTS = 600
LARGEST_IMAGE_PX = 520
"""Largest side of an image on a page; larger ones are reduced to keep pages small."""
MOST_PERCENT = 45.0
"""Right end of the histograms: a class of a normal distribution in eight contains up to 35 %."""


def pair_motion_figures(stereo: StereoResult) -> list[Figure]:
    """Return all figures of one stereo pair."""
    figures = [
        draw_sampled_motion(stereo) if isinstance(stereo.fit, SampledFit) else draw_motion(stereo),
        draw_residuals(stereo),
    ]
    if len(stereo.time_s) >= 8:
        figures.append(draw_residual_spectrum(stereo))
    if stereo.epipolar is not None:
        figures.append(draw_epipolar(stereo.epipolar, stereo.time_s, stereo.name))
    rigid = stereo.fit.phasors.value
    if stereo.deflection is None or len(rigid) == 0:
        return figures
    line = int(np.argmax(np.linalg.norm(rigid[:, :3], axis=1)))  # that of the largest motion
    bent = draw_deflection(stereo.deflection, line, rigid[line], stereo.name, stereo.body)
    return figures if bent is None else [*figures, bent]


def draw_motion(stereo: StereoResult) -> Figure:
    """Draw six components over time with the fitted lines, and folded over one period."""
    frequency, rate = main_frequency(stereo), camera_rate_hz(stereo)
    start, end = stereo.time_s[0], stereo.time_s[-1]
    phase = np.mod(stereo.time_s * frequency, 1.0)
    fine, fine_phase = np.linspace(start, end, CURVE_POINTS), np.linspace(0.0, 1.0, 241)
    # Folded: other lines, offset and drift taken off.
    folded = folded_curve(stereo, frequency, phase) + stereo.residual
    curve, folded_fit = beat_curve(stereo, fine), folded_curve(stereo, frequency, fine_phase)
    drawn = empty_figure(f"motion-{stereo.name}", 8.4, 6, (1.9, 1.0))
    for component, (left, right) in enumerate(zip(drawn.panels[::2], drawn.panels[1::2], strict=True)):
        poses = stereo.motion_from_mean.pose
        pose, (factor, letter) = poses[:, component], prefix(poses[:, :3] if component < 3 else poses[:, 3:])
        left.line(fine, curve[:, component] / factor, **FITTED)
        left.points(stereo.time_s, pose / factor, **MEASURED)
        left.y.label = f"{MOTION_COMPONENTS[component]} / {letter}{component_units(0)[component]}"
        left.x.link = f"time of {stereo.name}"
        right.points(phase, folded[:, component] / factor, **MEASURED)
        right.line(fine_phase, folded_fit[:, component] / factor, **FITTED)
        right.x.limits = (0.0, 1.0)
    drawn.panels[0].title = "at the exposure times"
    drawn.panels[1].title = "folded over one period"
    drawn.panels[-2].x.label = "time / s"
    drawn.panels[-1].x.label = f"phase of {frequency:.4f} Hz / periods"
    beat = float(alias_frequency(frequency, rate))
    caption = (
        f"Motion of the {stereo.body} seen by stereo pair “{stereo.name}”, about its mean pose: "
        f"{len(stereo.time_s)} frames at {rate:.4f} Hz. Points: measured; curves: sine approximation. Left, the "
        f"curve is drawn at the beat frequency of {beat:.4f} Hz, the alias of "
        f"{frequency:.4f} Hz at this camera rate; it equals the fit at every frame. Right, frames ordered by phase."
    )
    return drawn.with_title(f"Motion seen by {stereo.name}", caption)


def draw_sampled_motion(stereo: StereoResult) -> Figure:
    """Draw six components over time and over the motion that the channels predict."""
    poses, fitted = stereo.motion_from_mean.pose, stereo.motion_from_mean.pose - stereo.residual
    drawn = empty_figure(f"motion-{stereo.name}", 10.2, 6, (1.9, 1.0), shared_x=False)
    for component, (left, right) in enumerate(zip(drawn.panels[::2], drawn.panels[1::2], strict=True)):
        factor, letter = prefix(poses[:, :3] if component < 3 else poses[:, 3:])
        seen, predicted = poses[:, component] / factor, fitted[:, component] / factor
        left.points(stereo.time_s, seen, **MEASURED)
        left.points(stereo.time_s, predicted, label=BY_CHANNELS, colour=RED, size=2.0)
        left.y.label = f"{MOTION_COMPONENTS[component]} / {letter}{component_units(0)[component]}"
        left.x.link = f"time of {stereo.name}"
        right.points(predicted, seen, **MEASURED)
    drawn.panels[0].title = "at the exposure times"
    drawn.panels[1].title = f"over the {BY_CHANNELS}"
    drawn.panels[-2].x.label = "time / s"
    drawn.panels[-1].x.label = "in the same unit"
    caption = (
        f"Motion of the {stereo.body} seen by stereo pair “{stereo.name}”, about its mean pose: {len(stereo.time_s)} "
        f"frames at {camera_rate_hz(stereo):.4f} Hz, and the drift and motion that the channels give with the fitted "
        "transfer functions."
    )
    return drawn.with_title(f"Motion seen by {stereo.name}", caption)


def draw_residuals(stereo: StereoResult) -> Figure:
    """Draw the residuals of the fit over time and as histograms."""
    residual, fitted = stereo.residual, BY_CHANNELS if isinstance(stereo.fit, SampledFit) else FITTED["label"]
    drawn = empty_figure(f"residuals-{stereo.name}", 6.4, 6, (3.4, 1.0), shared_y=True)
    for component, (over_time, histogram) in enumerate(zip(drawn.panels[::2], drawn.panels[1::2], strict=True)):
        factor, letter = prefix(residual[:, :3] if component < 3 else residual[:, 3:])
        scaled = residual[:, component] / factor
        over_time.points(stereo.time_s, scaled, colour=BLUE, size=2.6)
        over_time.rule(0.0, width=0.6)
        over_time.y.label = f"{MOTION_COMPONENTS[component]} / {letter}{component_units(0)[component]}"
        over_time.x.link = f"time of {stereo.name}"
        _draw_histogram(histogram, scaled[np.isfinite(scaled)])
    drawn.panels[-2].x.label = "time / s"
    drawn.panels[-1].x.label = "frames / %"
    caption = (
        f"Measured motion minus {fitted}, frame by frame, and its distribution, with the normal "
        "distribution of the same standard deviation s."
    )
    return drawn.with_title(f"Residuals of {stereo.name}", caption)


def draw_residual_spectrum(stereo: StereoResult) -> Figure:
    """Draw the amplitude spectrum of the residuals with the aliases of fitted lines."""
    rate = camera_rate_hz(stereo)
    spectrum_hz, amplitude = residual_spectrum(stereo)
    lines_hz = np.empty(0) if isinstance(stereo.fit, SampledFit) else stereo.fit.phasors.frequency_hz
    alias = alias_frequency(lines_hz, rate)
    drawn = empty_figure(f"residual-spectrum-{stereo.name}", 3.1, 1, 2)
    for panel, components, unit in zip(drawn.panels, ((0, 1, 2), (3, 4, 5)), ("m", "rad"), strict=True):
        factor, letter = prefix(amplitude[1:, components], coarse=True)
        for component, colour in zip(components, COLOURS, strict=False):
            line = amplitude[1:, component] / factor
            panel.line(spectrum_hz[1:], line, MOTION_COMPONENTS[component], colour=colour, width=0.9)
        panel.y.limits = (0.0, 1.25 * float(np.nanmax(amplitude[1:, components])) / factor)
        panel.x.limits = (0.0, rate / 2.0)
        panel.x.label, panel.y.label = "frequency at the camera / Hz", f"amplitude / {letter}{unit}"
        if len(alias):
            names = tuple(f"{line:.4f} Hz" for line in lines_hz)
            panel.points(alias, np.zeros_like(alias), "fitted lines", marker="triangle", colour=BLACK, names=names)
    marks = " Triangles: aliases of the fitted lines." if len(alias) else ""
    caption = (
        f"Amplitude spectrum of the residuals over the frequency at the camera.{marks} White noise alone gives a level "
        "spectrum; any other peak is a disturbance or a motion that was not fitted."
    )
    return drawn.with_title(f"Residual spectrum of {stereo.name}", caption)


def subset_figures(evaluation: Evaluation) -> list[Figure]:
    """Draw the tracked subsets in the first left image of every stereo pair."""
    pairs = [
        (item.name, item.reference_image, item.subsets_px)
        for item in evaluation.stereo
        if item.reference_image is not None and item.subsets_px is not None
    ]
    if not pairs:
        return []
    columns = max(2, len(pairs))
    tallest = max(image.shape[0] / image.shape[1] for _, image, _ in pairs)
    drawn = empty_figure("subsets", 0.75 + 7.2 / columns * tallest, 1, columns)
    for panel, (name, image, points) in zip(drawn.panels, pairs, strict=False):
        _draw_image(panel, image)
        side = 0.92 * (21.0 if len(points) < 2 else neighbour_distance(points, 0.5))
        panel.squares(points, side, "subsets", colour=ORANGE, filled=False)
        panel.x.label, panel.title = "x / px", f"{name}: {len(points)} subsets"
    for panel in drawn.panels[len(pairs) :]:
        panel.blank = True
    drawn.panels[0].y.label = "y / px"
    return [drawn.with_title("Subsets", "First left images, contrast stretched, with the subsets tracked in them.")]


def main_frequency(stereo: StereoResult) -> float:
    """Return the frequency of the strongest translational line of the fit."""
    phasors = stereo.fit.phasors
    return float(phasors.frequency_hz[np.argmax(np.abs(phasors.value[:, :3]).max(axis=1))])


def camera_rate_hz(stereo: StereoResult) -> float:
    """Return the mean frame rate; the median spacing is one frame, gaps count as several."""
    spacing = np.diff(stereo.time_s)
    frames = np.round(spacing / np.median(spacing)).sum()
    return float(frames / (stereo.time_s[-1] - stereo.time_s[0]))


def beat_curve(stereo: StereoResult, time_s: FloatArray) -> FloatArray:
    """Return the fitted curve (T, 6) at the aliases of the lines.

    It equals the fit at every frame.
    """
    rate, start = camera_rate_hz(stereo), float(stereo.time_s[0])
    phasors = stereo.fit.phasors
    alias = phasors.frequency_hz - rate * np.round(phasors.frequency_hz / rate)
    turns = np.exp(2j * np.pi * (phasors.frequency_hz * start + np.multiply.outer(time_s - start, alias)))
    drift = np.multiply.outer(time_s - stereo.fit.middle_s, stereo.fit.drift_per_s)
    return np.asarray(stereo.fit.offset + drift + (turns @ phasors.value).real)


def folded_curve(stereo: StereoResult, frequency_hz: float, phase: FloatArray) -> FloatArray:
    """Return the fitted curve (T, 6) of one line and its multiples over its phase."""
    phasors = stereo.fit.phasors
    multiple = phasors.frequency_hz / frequency_hz
    multiples = np.abs(multiple - np.round(multiple)) * frequency_hz * np.ptp(stereo.time_s) < 0.02
    turns = np.exp(2j * np.pi * np.multiply.outer(phase, np.round(multiple[multiples])))
    return np.asarray((turns @ phasors.value[multiples]).real)


def residual_spectrum(stereo: StereoResult) -> tuple[FloatArray, FloatArray]:
    """Return frequencies (B,) and amplitudes (B, 6) of the residuals; missing frames count as zero."""
    spacing = np.diff(stereo.time_s)
    index = np.concatenate([[0], np.cumsum(np.round(spacing / np.median(spacing)))]).astype(np.int64)
    filled = np.zeros((index[-1] + 1, 6))
    filled[index] = np.nan_to_num(stereo.residual)
    frequency = np.fft.rfftfreq(len(filled), 1.0 / camera_rate_hz(stereo))
    present = int(np.isfinite(stereo.residual).all(axis=1).sum())
    return np.asarray(frequency, dtype=np.float64), np.abs(np.fft.rfft(filled, axis=0)) * 2.0 / max(present, 1)


def _draw_histogram(panel: Panel, values: FloatArray) -> None:
    """Draw a horizontal histogram in per cent, with a normal distribution."""
    panel.x.limits = (0.0, MOST_PERCENT)
    if len(values) < 3:
        return
    deviation = float(np.std(values, ddof=1))
    counts, edges = np.histogram(values, bins=min(max(8, int(np.sqrt(len(values)))), 30))
    share = 100.0 / len(values)
    panel.boxes((np.zeros(len(counts)), share * counts), (edges[:-1], edges[1:]), colour=BLUE)
    level = np.linspace(edges[0], edges[-1], 121)
    if deviation > 0.0:
        density = np.exp(-0.5 * (level / deviation) ** 2) / (np.sqrt(2.0 * np.pi) * deviation)
        panel.line(100.0 * density * (edges[1] - edges[0]), level, colour=BLACK, width=0.9)
    panel.text(0.97 * MOST_PERCENT, edges[-1], f"s = {number_text(deviation, 2)}", align="right")


def _draw_image(panel: Panel, image: NDArray[Any]) -> None:
    """Draw one reference image, reduced to its size on the page."""
    height, width = image.shape
    scale = min(1.0, LARGEST_IMAGE_PX / max(height, width))
    shown = cv2.resize(shown_grey(image), None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA)
    panel.image(shown.astype(np.uint8), (-0.5, width - 0.5), (-0.5, height - 0.5))
    panel.x.limits, panel.y.limits = (-0.5, width - 0.5), (height - 0.5, -0.5)
    panel.equal, panel.x.grid, panel.y.grid = True, False, False


# Figure of one stereo pair: whether its cameras agree with their calibration.


MPX = 1e3
SMALLEST_PX = 1e-3  # range of the colours where residuals are smaller


def draw_epipolar(check: EpipolarCheck, time_s: FloatArray, name: str) -> Figure:
    """Draw the mean epipolar residual over time and over the image."""
    drawn = empty_figure(f"epipolar-{name}", 3.0, 1, (1.5, 1.0))
    _draw_mean_residual(drawn.panels[0], check, time_s)
    drawn.panels[0].x.link = f"time of {name}"
    _draw_residuals(drawn.panels[1], check)
    explained = (
        "Grey band: uncertainty of calibration and matching, k = 2. "
        if check.pattern_covariance is not None
        else "The calibration states no uncertainty to compare with. "
    )
    caption = (
        "Distance of the points of the right image from the epipolar lines of the left ones. Left: mean over "
        f"the points, frame by frame, bars: image noise, k = 2. {explained}A camera that moves makes a step or a "
        "drift. Right: mean over the frames, over the left image."
    )
    return drawn.with_title(f"Epipolar residuals of {name}", caption)


def _draw_mean_residual(panel: Panel, check: EpipolarCheck, time_s: FloatArray) -> None:
    """Draw the mean residual over time."""
    if check.pattern_covariance is not None:
        explained = MPX * COVERAGE * float(np.sqrt(check.pattern_covariance[0, 0]))
        panel.span(-explained, explained)
    panel.rule(0.0, width=0.6)
    half = MPX * COVERAGE * check.u_residual_trend_px[:, 0]
    panel.points(time_s, MPX * check.mean_px, half_y=half, colour=BLUE, size=2.6)
    panel.x.label, panel.y.label = "time / s", "mean residual / mpx"


def _draw_residuals(panel: Panel, check: EpipolarCheck) -> None:
    """Draw the mean residual of every point at its position in the left image.

    Outliers as crosses.
    """
    finite = np.isfinite(check.residual_px)
    if not finite.any():
        panel.blank = True
        return
    limit = MPX * max(SMALLEST_PX, float(np.abs(check.residual_px[finite]).max()))
    x, y = check.position_px.T
    scale = Scale("RdBu", -limit, limit, "residual / mpx")
    panel.points(x[finite], y[finite], values=MPX * check.residual_px[finite], scale=scale, size=3.8)
    if not finite.all():
        panel.points(x[~finite], y[~finite], "left out", marker="x", colour=RED, size=4.0)
    panel.equal = True
    panel.x.limits = (float(x.min()) - 20.0, float(x.max()) + 20.0)
    panel.y.limits = (float(y.max()) + 20.0, float(y.min()) - 20.0)
    panel.x.label, panel.y.label = "x / px", "y / px"


# Surfaces that stereo pairs track, for the scene.


MOST_POINTS = 120  # of one tracked surface that a page shows
SIGNIFICANT_RATIO = 1.5  # rms of a deflection over that of noise (chosen)
VECTOR_QUANTILE = 3.548
"""Amplitude of three components, in standard uncertainties of their parts, that noise exceeds at 5 % of the points:
square root of the 95 % quantile of chi-square with 6 degrees of freedom."""


@dataclass(frozen=True)
class TrackedSurface:
    """Surface tracked by a pair: resolved lines and shown points; `fitted`: its deformation in shapes."""

    name: str
    usable: BoolArray
    shape: DeflectionShape
    shown: IntArray
    fitted: ShapePhasors | None = None

    @property
    def points_m(self) -> FloatArray:
        """Shown points (N, 3) at rest."""
        return np.asarray(self.shape.reference_m[self.shown])

    def _sizes(self, line: int) -> tuple[float, float] | None:
        """Return the rms of the deflection at a line, and that of noise alone."""
        if not self.usable[line]:
            return None
        k = int(np.count_nonzero(self.usable[:line]))
        value, u = self.shape.value[k], self.shape.u[k]
        return float(np.sqrt(3.0 * np.nanmean(np.abs(value) ** 2))), float(np.sqrt(6.0 * np.nanmean(u**2)))

    def _bends(self, line: int) -> ShapePhasors | None:
        """Return the deformation in shapes, None if it is not significant at a line."""
        fitted = self.fitted
        if fitted is None or fitted.form is None or not self.usable[line]:
            return None
        return fitted if fitted.deforms[int(np.count_nonzero(self.usable[:line]))] else None

    def deflection(self, line: int) -> ComplexArray | None:
        """Return the deflection (N, 3) of the shown points, None if not significant.

        By the shapes fitted to all pixels where these are significant, else by the points; those not above their noise
        are not deflected.
        """
        k, fitted, sizes = int(np.count_nonzero(self.usable[:line])), self._bends(line), self._sizes(line)
        if fitted is not None and fitted.form is not None:
            return np.asarray(np.einsum("s,snc->nc", fitted.phasors.value[k], fitted.form[:, self.shown]))
        if sizes is None or not sizes[0] > SIGNIFICANT_RATIO * sizes[1]:
            return None
        value, u = self.shape.value[k][self.shown], self.shape.u[k][self.shown]
        above = np.sqrt(np.sum(np.abs(value / u) ** 2, axis=1)) > VECTOR_QUANTILE
        return np.asarray(np.where(above[:, None], value, 0.0))

    def texts(self, line: int) -> Iterator[str]:
        """Yield amplitudes of significant shapes with U, and the deflection of the points."""
        fitted = self._bends(line)
        if fitted is not None:
            k = int(np.count_nonzero(self.usable[:line]))
            sizes = np.abs(fitted.phasors.value[k]), fitted.u_size[k]
            for name, size, u in zip(fitted.phasors.channels, *sizes, strict=True):
                if size > OUT_QUANTILE * u:
                    factor, letter = prefix(size)
                    amount = quantity_text(size / factor, 2.0 * u / factor, f"{letter}m")
                    yield f"{self.name}, {name}: {amount} (k = 2)"
        if text := self.text(line):
            yield text

    def text(self, line: int) -> str:
        """Return the size of the deflection of the points as text."""
        sizes = self._sizes(line)
        if sizes is None:
            return ""
        factor, letter = prefix(max(sizes))
        size, noise = (f"{number_text(value / factor)} {letter}m" for value in sizes)
        above, drawn = (
            sizes[0] > SIGNIFICANT_RATIO * sizes[1],
            "drawn by its shapes" if self._bends(line) else "not drawn",
        )
        end = f"of which noise {noise}" if above else f"no more than their noise ({noise}); {drawn}"
        return f"points of {self.name} deviate from the rigid motion by {size} (rms), {end}"


def tracked_surface(item: StereoResult) -> Iterator[TrackedSurface]:
    """Yield the surface of a pair with a limited number of finite points."""
    shape = item.deflection
    if shape is None:
        return
    finite = np.flatnonzero(np.isfinite(shape.value).all(axis=(0, 2)) & np.isfinite(shape.reference_m).all(axis=1))
    if len(finite) >= 3:
        chosen = np.unique(np.linspace(0, len(finite) - 1, min(MOST_POINTS, len(finite))).round().astype(int))
        yield TrackedSurface(item.name, item.usable, shape, finite[chosen], item.shapes)
