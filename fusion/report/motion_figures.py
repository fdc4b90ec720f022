"""Figures of stereo pairs: motion, deformation, and whether the cameras still are what was calibrated."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from matplotlib import colormaps
from matplotlib.axes import Axes
from matplotlib.collections import PolyCollection
from matplotlib.colors import Colormap, LinearSegmentedColormap
from numpy.typing import NDArray

from fusion.base import prefix
from fusion.phasors.stereo_phasors import DeflectionShape, StereoResult
from fusion.report.style import (
    BLACK,
    BLUE,
    COLOURS,
    GREEN,
    GREY,
    LIGHT,
    ORANGE,
    PURPLE,
    RASTER_ABOVE,
    RED,
    WIDTH_IN,
    Picture,
    panel_label,
    sheet,
    square_corners,
)
from fusion.sensitivity.analyse import Evaluation
from photogram.epipolar import COVERAGE, EpipolarCheck
from shaker.arrays import ComplexArray, FloatArray
from shaker.labels import AXES, MOTION_COMPONENTS, component_units
from shaker.sine.aliasing import alias_frequency

# Figure of one stereo pair: how its body bends at a line, out of its plane and in it.


OUT_QUANTILE, INSIDE_QUANTILE = 2.448, 3.080
"""Amplitude of one and of two components, in standard uncertainties of their parts, that noise exceeds at 5 % of the
points: square roots of the 95 % quantiles of chi-square with 2 and 4 degrees of freedom."""
LONGEST_ARROW = 1.6  # distances between neighbours
PHASE_COLOURS = (BLUE, GREEN, ORANGE, PURPLE, BLUE)
"""Colours of -180, -90, 0, 90 and 180 degrees, distinct from the grey of points without a phase."""
PANEL_IN, TALLEST_IN, FLATTEST_IN = 2.2, 3.2, 0.8
BELOW_IN, ABOVE_IN, BAR_IN, BAR_HEIGHT_IN = 1.15, 0.3, 0.68, 0.11
MARGIN_SHARE = 0.03


@dataclass(frozen=True)
class _View:
    """A shape at one line as it is drawn: plan (N, 2) in mm, out of plane (N,), in plane (N, 2), and noise levels."""

    plan_mm: FloatArray
    out: ComplexArray
    out_level: FloatArray
    inside: ComplexArray
    inside_level: FloatArray
    normal: int
    across: tuple[int, int]

    @property
    def side_mm(self) -> float:
        """Distance of neighbouring points."""
        return neighbour_distance(self.plan_mm, 1e-6)

    @property
    def limits_mm(self) -> tuple[FloatArray, FloatArray]:
        """Lower and upper corner of the panels: the whole body with room for a square at its edge."""
        low, high = self.plan_mm.min(axis=0), self.plan_mm.max(axis=0)
        room = 1.2 * self.side_mm + MARGIN_SHARE * float((high - low).max())
        return low - room, high + room

    @property
    def height_in(self) -> float:
        """Height of the panels for equal scales."""
        low, high = self.limits_mm
        return float(np.clip(PANEL_IN * (high[1] - low[1]) / (high[0] - low[0]), FLATTEST_IN, TALLEST_IN))


def draw_deflection(shape: DeflectionShape, line: int, rigid: ComplexArray, name: str, body: str) -> Picture | None:
    """Amplitude and phase of the deflection out of the plane of the points, and the deflection in that plane.

    `rigid` (6,): displacement phasors of the body at this line; phases are counted from its largest translation. None
    when fewer than three points have a deflection.
    """
    known = np.isfinite(shape.value[line]).all(axis=1)
    if known.sum() < 3:
        return None
    view = _view(shape.reference_m[known], shape.value[line][known], shape.u[line][known])
    leader = int(np.argmax(np.abs(rigid[:3])))
    above = np.abs(view.out) > view.out_level
    with sheet(f"deflection-{name}", view.height_in + BELOW_IN + ABOVE_IN, 1, 3) as drawn:
        panels = drawn.panels
        _draw_amplitude(panels[0], view)
        _draw_phase(panels[1], view, above, (float(np.angle(rigid[leader])), AXES[leader]))
        _draw_in_plane(panels[2], view)
        low, high = view.limits_mm
        for axes in panels:
            axes.set_xlim(low[0], high[0])
            axes.set_ylim(low[1], high[1])
            axes.set_aspect("equal")
            axes.set_xlabel(f"{AXES[view.across[0]]} / mm")
            axes.grid(visible=False)
        panels[0].set_ylabel(f"{AXES[view.across[1]]} / mm")
        caption = (
            f"What the {body} does beside its rigid motion at {shape.frequency_hz[line]:.4f} Hz, seen by stereo pair "
            f"“{name}” (peak values). Left: amplitude along {AXES[view.normal]}, out of the plane of the points; "
            f"{above.sum()} of {len(above)} points are above the noise level, which noise alone exceeds at one point "
            f"in twenty. Middle: phase against the rigid translation along {AXES[leader]}, grey where the amplitude "
            "is below that level. Right: deflection in the plane at the instant of its largest extent, grey below "
            "the noise level. Bending appears smaller by the rigid motion that fits it best."
        )
        layout: dict[str, Any] = {"left": 0.6, "bottom": BELOW_IN, "top": ABOVE_IN, "gap": (0.5, 0.1), "label": 0.42}
        return drawn.picture(f"Operating deflection shape seen by {name}", caption, **layout)


def _view(reference_m: FloatArray, value: ComplexArray, u: FloatArray) -> _View:
    """Plan and components of a shape (N, 3) with uncertainties (N, 3), in the plane that fits the points best."""
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


def _draw_amplitude(axes: Axes, view: _View) -> None:
    """Squares coloured by the amplitude out of the plane; the colour bar shows the noise level."""
    factor, letter = prefix(np.abs(view.out))
    largest = float(np.abs(view.out).max()) / factor
    level = float(np.median(view.out_level)) / factor
    squares = _squares(view, np.abs(view.out) / factor, colormaps["viridis"], (0.0, max(largest, level)))
    axes.add_collection(squares)
    bar = _colour_bar(axes, view, squares, f"amplitude / {letter}m")
    bar.axvline(level, color="white", linewidth=2.6)
    bar.axvline(level, color=BLACK, linewidth=1.2)
    panel_label(axes, f"out of plane ({AXES[view.normal]}), noise level {float(f'{level:.2g}'):g} {letter}m")


def _draw_phase(axes: Axes, view: _View, above: NDArray[np.bool_], leader: tuple[float, str]) -> None:
    """Squares coloured by the phase out of the plane, against the leader's, where the amplitude is above the noise."""
    phase = np.degrees(np.angle(view.out * np.exp(-1j * leader[0])))
    colours = LinearSegmentedColormap.from_list("phase", PHASE_COLOURS)
    squares = _squares(view, np.where(above, phase, np.nan), colours, (-180.0, 180.0))
    axes.add_collection(squares)
    bar = _colour_bar(axes, view, squares, f"phase against {leader[1]} / °")
    bar.set_xticks([-180, -90, 0, 90, 180])
    panel_label(axes, f"out of plane ({AXES[view.normal]}), phase")


def _draw_in_plane(axes: Axes, view: _View) -> None:
    """Arrows at the instant at which the deflection in the plane is largest."""
    instant = np.exp(-0.5j * np.angle(np.sum(view.inside**2)))
    arrows = (view.inside * instant).real
    length = np.sqrt(np.sum(np.abs(view.inside) ** 2, axis=1))
    factor, letter = prefix(arrows)
    colour = np.where(length > view.inside_level, BLUE, GREY)
    longest = float(np.quantile(np.hypot(arrows[:, 0], arrows[:, 1]), 0.98)) / factor
    scale = max(longest, 1e-12) / (LONGEST_ARROW * view.side_mm)
    quiver = axes.quiver(
        *view.plan_mm.T,
        *(arrows / factor).T,
        color=list(colour),
        angles="xy",
        scale_units="xy",
        scale=scale,
        width=0.006,
        headwidth=3.5,
        rasterized=len(arrows) > RASTER_ABOVE,
    )
    key = float(f"{longest:.1g}")
    axes.quiverkey(
        quiver,
        0.5,
        -(BAR_IN - BAR_HEIGHT_IN) / view.height_in,
        key,
        f"{key:g} {letter}m",
        labelpos="S",
        labelsep=0.06,
        color=BLACK,
    )
    level = float(np.median(view.inside_level)) / factor
    names = ", ".join(AXES[axis] for axis in view.across)
    panel_label(axes, f"in plane ({names}), noise level {float(f'{level:.2g}'):g} {letter}m")


def _squares(view: _View, values: FloatArray, colours: Colormap, limits: tuple[float, float]) -> PolyCollection:
    """Squares about the points, coloured by values (N,), light grey where they are NaN."""
    corners = square_corners(view.plan_mm, 0.94 * view.side_mm)
    squares = PolyCollection(list(corners), linewidth=0.0, edgecolor="none")
    squares.set_array(np.ma.masked_invalid(values))
    squares.set_cmap(colours.with_extremes(bad=LIGHT))
    squares.set_clim(*limits)
    squares.set_rasterized(len(values) > RASTER_ABOVE)
    return squares


def _colour_bar(axes: Axes, view: _View, squares: PolyCollection, label: str) -> Axes:
    """Horizontal colour bar under a panel."""
    place = axes.inset_axes((0.0, -BAR_IN / view.height_in, 1.0, BAR_HEIGHT_IN / view.height_in))
    axes.figure.colorbar(squares, cax=place, orientation="horizontal")
    place.set_xlabel(label)
    place.grid(visible=False)
    return place


# Figures of one stereo pair: motion over time and folded, what the fit leaves, and the image it was seen in.


POINT: dict[str, Any] = {"marker": "o", "linestyle": "none", "markersize": 2.6, "markeredgewidth": 0}
CURVE_POINTS = 600
LARGEST_IMAGE_PX = 520


def motion_pictures(stereo: StereoResult) -> list[Picture]:
    """All figures of one stereo pair."""
    pictures = [draw_motion(stereo), draw_residuals(stereo)]
    if len(stereo.time_s) >= 8:
        pictures.append(draw_residual_spectrum(stereo))
    if stereo.epipolar is not None:
        pictures.append(draw_epipolar(stereo.epipolar, stereo.time_s, stereo.name))
    rigid = stereo.fit.phasors.value
    if stereo.deflection is None or len(rigid) == 0:
        return pictures
    line = int(np.argmax(np.linalg.norm(rigid[:, :3], axis=1)))  # that of the largest motion
    bent = draw_deflection(stereo.deflection, line, rigid[line], stereo.name, stereo.body)
    return pictures if bent is None else [*pictures, bent]


def draw_motion(stereo: StereoResult) -> Picture:
    """Six components over time with the fitted lines as this camera rate sees them, and folded over one period."""
    frequency, rate = main_frequency(stereo), camera_rate_hz(stereo)
    start, end = stereo.time_s[0], stereo.time_s[-1]
    phase = np.mod(stereo.time_s * frequency, 1.0)
    look = {**POINT, "color": BLUE, "rasterized": len(stereo.time_s) > RASTER_ABOVE}
    fitted: dict[str, Any] = {"color": RED, "linewidth": 1.1, "zorder": 3}
    fine, fine_phase = np.linspace(start, end, CURVE_POINTS), np.linspace(0.0, 1.0, 241)
    # Folded: other lines, offset and drift taken off.
    folded = folded_curve(stereo, frequency, phase) + stereo.residual
    curve, folded_fit = beat_curve(stereo, fine), folded_curve(stereo, frequency, fine_phase)
    with sheet(f"motion-{stereo.name}", 8.4, 6, 2, widths=(1.9, 1.0)) as drawn:
        for component, (left, right) in enumerate(zip(drawn.panels[::2], drawn.panels[1::2], strict=True)):
            pose = stereo.motion_from_mean.pose[:, component]
            factor, letter = prefix(pose)
            left.plot(fine, curve[:, component] / factor, **fitted)
            left.plot(stereo.time_s, pose / factor, **look)
            left.set_ylabel(f"{MOTION_COMPONENTS[component]} / {letter}{component_units(0)[component]}")
            right.plot(phase, folded[:, component] / factor, **look)
            right.plot(fine_phase, folded_fit[:, component] / factor, **fitted)
            right.set_xlim(0.0, 1.0)
        drawn.panels[0].set_title("at the exposure times")
        drawn.panels[1].set_title("folded over one period")
        drawn.panels[-2].set_xlabel("time / s")
        drawn.panels[-1].set_xlabel(f"phase of {frequency:.4f} Hz / periods")
        beat = float(alias_frequency(frequency, rate))
        caption = (
            f"Motion of the {stereo.body} seen by stereo pair “{stereo.name}”, about its mean pose: "
            f"{len(stereo.time_s)} frames at {rate:.4f} Hz. Points: measured; curves: sine approximation. Left, the "
            f"curve is drawn at the beat frequency of {beat:.4f} Hz, to which this camera rate folds "
            f"{frequency:.4f} Hz; it passes through the fit at every frame. Right, the frames are ordered by phase."
        )
        title = f"Motion seen by {stereo.name}"
        return drawn.picture(title, caption, left=0.72, top=0.25, gap=(0.5, 0.14), label=0.52)


def draw_residuals(stereo: StereoResult) -> Picture:
    """What the sine approximation leaves of each component, over time and as a histogram."""
    residual = stereo.residual
    with sheet(f"residuals-{stereo.name}", 6.4, 6, 2, widths=(3.4, 1.0), sharey="row") as drawn:
        for component, (over_time, histogram) in enumerate(zip(drawn.panels[::2], drawn.panels[1::2], strict=True)):
            factor, letter = prefix(residual[:, :3] if component < 3 else residual[:, 3:])
            scaled = residual[:, component] / factor
            over_time.plot(stereo.time_s, scaled, color=BLUE, rasterized=len(stereo.time_s) > RASTER_ABOVE, **POINT)
            over_time.axhline(0.0, color=BLACK, linewidth=0.6)
            over_time.set_ylabel(f"{MOTION_COMPONENTS[component]} / {letter}{component_units(0)[component]}")
            _draw_histogram(histogram, scaled[np.isfinite(scaled)])
        drawn.panels[-2].set_xlabel("time / s")
        drawn.panels[-1].set_xlabel("frames")
        caption = (
            "Measured motion minus sine approximation, frame by frame, and its distribution beside the normal "
            "distribution of the same standard deviation s."
        )
        title = f"Residuals of {stereo.name}"
        return drawn.picture(title, caption, left=0.72, top=0.12, gap=(0.12, 0.14), label=0.52)


def draw_residual_spectrum(stereo: StereoResult) -> Picture:
    """Amplitude spectrum of the residuals up to half the camera rate, with the places to which the lines fold."""
    rate = camera_rate_hz(stereo)
    spectrum_hz, amplitude = residual_spectrum(stereo)
    alias = alias_frequency(stereo.fit.phasors.frequency_hz, rate)
    with sheet(f"residual-spectrum-{stereo.name}", 3.1, 1, 2, sharex=True) as drawn:
        for axes, components, unit in zip(drawn.panels, ((0, 1, 2), (3, 4, 5)), ("m", "rad"), strict=True):
            factor, letter = prefix(amplitude[1:, components], coarse=True)
            for component, colour in zip(components, COLOURS, strict=False):
                line = amplitude[1:, component] / factor
                axes.plot(spectrum_hz[1:], line, color=colour, linewidth=0.9, label=MOTION_COMPONENTS[component])
            axes.set_ylim(0.0, 1.25 * float(np.nanmax(amplitude[1:, components])) / factor)
            axes.set_xlim(0.0, rate / 2.0)
            axes.set_xlabel("frequency at the camera / Hz")
            axes.set_ylabel(f"amplitude / {letter}{unit}")
            look: dict[str, Any] = {"marker": "^", "linestyle": "none", "color": BLACK, "markersize": 4.5}
            axes.plot(alias, np.zeros_like(alias), clip_on=False, **look)
            axes.legend(ncols=3, loc="upper right")
        caption = (
            "Amplitude spectrum of the residuals over the frequency at which the camera sees them. Triangles: where "
            "the fitted lines fold to. White noise alone gives a level spectrum; a peak elsewhere is a disturbance "
            "or a line that was not fitted."
        )
        title = f"Residual spectrum of {stereo.name}"
        return drawn.picture(title, caption, left=0.72, top=0.12, gap=(0.75, 0.14), label=0.52)


def subset_pictures(evaluation: Evaluation) -> list[Picture]:
    """First left image of every stereo pair with the subsets that were tracked in it, where there are images."""
    seen = [
        (item.name, item.reference_image, item.subsets_px)
        for item in evaluation.stereo
        if item.reference_image is not None and item.subsets_px is not None
    ]
    if not seen:
        return []
    columns = max(2, len(seen))
    tallest = max(image.shape[0] / image.shape[1] for _, image, _ in seen)
    with sheet("subsets", 0.75 + (WIDTH_IN - 1.2) / columns * tallest, 1, columns) as drawn:
        for axes, (name, image, points) in zip(drawn.panels, seen, strict=False):
            _draw_image(axes, image)
            squares = square_corners(points, 0.92 * (21.0 if len(points) < 2 else neighbour_distance(points, 0.5)))
            axes.add_collection(PolyCollection(list(squares), facecolor="none", edgecolor=ORANGE, linewidth=0.5))
            axes.set_xlabel("x / px")
            axes.grid(visible=False)
            panel_label(axes, f"{name}: {len(points)} subsets")
        for axes in drawn.panels[len(seen) :]:
            axes.set_axis_off()
        drawn.panels[0].set_ylabel("y / px")
        caption = "First left images, contrast stretched, with the subsets tracked in them."
        return [drawn.picture("Subsets", caption, left=0.6, top=0.25, gap=(0.45, 0.1), label=0.45)]


def main_frequency(stereo: StereoResult) -> float:
    """Frequency of the strongest translational line of the fit."""
    phasors = stereo.fit.phasors
    return float(phasors.frequency_hz[np.argmax(np.abs(phasors.value[:, :3]).max(axis=1))])


def camera_rate_hz(stereo: StereoResult) -> float:
    """Mean frame rate: the median spacing is taken as one frame, gaps count as several."""
    spacing = np.diff(stereo.time_s)
    frames = np.round(spacing / np.median(spacing)).sum()
    return float(frames / (stereo.time_s[-1] - stereo.time_s[0]))


def beat_curve(stereo: StereoResult, time_s: FloatArray) -> FloatArray:
    """Fitted curve (T, 6) with every line moved to its alias, so that it can be drawn between the frames.

    At frame times t_n = t_0 + n/f_c, exp(j2πft_n) = exp(j2πft_0)·exp(j2π(f − m·f_c)(t_n − t_0)) for whole m.
    """
    rate, start = camera_rate_hz(stereo), float(stereo.time_s[0])
    phasors = stereo.fit.phasors
    alias = phasors.frequency_hz - rate * np.round(phasors.frequency_hz / rate)
    turns = np.exp(2j * np.pi * (phasors.frequency_hz * start + np.multiply.outer(time_s - start, alias)))
    drift = np.multiply.outer(time_s - stereo.fit.middle_s, stereo.fit.drift_per_s)
    return np.asarray(stereo.fit.offset + drift + (turns @ phasors.value).real)


def folded_curve(stereo: StereoResult, frequency_hz: float, phase: FloatArray) -> FloatArray:
    """Fitted curve (T, 6) of one line and its multiples over its phase in periods."""
    phasors = stereo.fit.phasors
    multiple = phasors.frequency_hz / frequency_hz
    own = np.abs(multiple - np.round(multiple)) * frequency_hz * np.ptp(stereo.time_s) < 0.02
    turns = np.exp(2j * np.pi * np.multiply.outer(phase, np.round(multiple[own])))
    return np.asarray((turns @ phasors.value[own]).real)


def residual_spectrum(stereo: StereoResult) -> tuple[FloatArray, FloatArray]:
    """Frequencies (B,) and amplitudes (B, 6) of the residuals; missing frames count as zero."""
    spacing = np.diff(stereo.time_s)
    place = np.concatenate([[0], np.cumsum(np.round(spacing / np.median(spacing)))]).astype(np.int64)
    filled = np.zeros((place[-1] + 1, 6))
    filled[place] = np.nan_to_num(stereo.residual)
    frequency = np.fft.rfftfreq(len(filled), 1.0 / camera_rate_hz(stereo))
    present = int(np.isfinite(stereo.residual).all(axis=1).sum())
    return np.asarray(frequency, dtype=np.float64), np.abs(np.fft.rfft(filled, axis=0)) * 2.0 / max(present, 1)


def _draw_histogram(axes: Axes, values: FloatArray) -> None:
    """Horizontal histogram with the normal distribution of the same standard deviation."""
    if len(values) < 3:
        return
    deviation = float(np.std(values, ddof=1))
    counts, edges = np.histogram(values, bins=min(max(8, int(np.sqrt(len(values)))), 30))
    axes.stairs(counts, edges, orientation="horizontal", fill=True, color=BLUE, alpha=0.45)
    level = np.linspace(edges[0], edges[-1], 121)
    if deviation > 0.0:
        density = np.exp(-0.5 * (level / deviation) ** 2) / (np.sqrt(2.0 * np.pi) * deviation)
        axes.plot(density * len(values) * (edges[1] - edges[0]), level, color=BLACK, linewidth=0.9)
    axes.set_xlim(0.0, 1.75 * float(counts.max()))
    axes.text(
        0.97, 0.97, f"s = {float(f'{deviation:.2g}'):g}", transform=axes.transAxes, ha="right", va="top", fontsize=7.5
    )


def _draw_image(axes: Axes, image: NDArray[Any]) -> None:
    """One reference image, reduced to the size at which it is shown."""
    height, width = image.shape
    low, high = np.percentile(image, (0.5, 99.5))
    grey = np.clip((image - low) / max(float(high - low), 1.0), 0.0, 1.0).astype(np.float32)
    scale = min(1.0, LARGEST_IMAGE_PX / max(height, width))
    shown = cv2.resize(grey, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA)
    extent = (-0.5, width - 0.5, height - 0.5, -0.5)
    axes.imshow(shown, cmap="gray", vmin=0.0, vmax=1.0, extent=extent, interpolation="none")


def neighbour_distance(points: FloatArray, least: float) -> float:
    """Median distance of neighbours on a grid of points (N, 2); what is closer than `least` is the same point."""
    sample = points[:: max(1, len(points) // 200)]
    distance = np.abs(sample[:, None, :] - points[None, :, :]).max(axis=2)
    distance[distance < least] = np.inf
    return float(np.median(distance.min(axis=1)))


# Figure of one stereo pair: whether its cameras still are, and stay, what was calibrated.


MPX = 1e3
SMALLEST_PX = 1e-3  # range of the colours where residuals are smaller


def draw_epipolar(check: EpipolarCheck, time_s: FloatArray, name: str) -> Picture:
    """Mean epipolar residual over time with what the calibration explains, and its mean over time over the picture."""
    with sheet(f"epipolar-{name}", 2.7, 1, 2, widths=(1.5, 1.0)) as drawn:
        _draw_course(drawn.panels[0], check, time_s)
        _draw_residuals(drawn.panels[1], check)
        explained = (
            "Grey band: what calibration and matching explain, k = 2. "
            if check.pattern_covariance is not None
            else "The calibration states no uncertainty to compare with. "
        )
        caption = (
            "How far the points of the right picture are off the epipolar lines of their left ones. Left: mean over "
            f"the points, frame by frame, bars: image noise, k = 2. {explained}A camera that moves makes a step or a "
            "drift. Right: mean over the frames, over the left picture."
        )
        layout: dict[str, Any] = {"left": 0.72, "right": 0.75, "top": 0.12, "gap": (0.75, 0.14), "label": 0.52}
        return drawn.picture(f"Epipolar residuals of {name}", caption, **layout)


def _draw_course(axes: Axes, check: EpipolarCheck, time_s: FloatArray) -> None:
    """The mean residual over time."""
    if check.pattern_covariance is not None:
        explained = MPX * COVERAGE * float(np.sqrt(check.pattern_covariance[0, 0]))
        axes.axhspan(-explained, explained, color=LIGHT, linewidth=0)
    axes.axhline(0.0, color=BLACK, linewidth=0.6)
    look: dict[str, Any] = {
        "markersize": 2.6,
        "elinewidth": 0.7,
        "capsize": 0.0,
        "rasterized": len(time_s) > RASTER_ABOVE,
    }
    half = MPX * COVERAGE * check.u_course_px[:, 0]
    axes.errorbar(time_s, MPX * check.mean_px, yerr=half, color=BLUE, fmt="o", **look)
    axes.set_xlabel("time / s")
    axes.set_ylabel("mean residual / mpx")


def _draw_residuals(axes: Axes, check: EpipolarCheck) -> None:
    """The mean residual of every point at its place in the left picture; outliers as crosses."""
    known = np.isfinite(check.residual_px)
    if not known.any():
        axes.set_axis_off()
        return
    limit = MPX * max(SMALLEST_PX, float(np.abs(check.residual_px[known]).max()))
    x, y = check.position_px.T
    points = axes.scatter(
        x[known], y[known], c=MPX * check.residual_px[known], cmap="RdBu_r", vmin=-limit, vmax=limit, s=14, linewidths=0
    )
    points.set_rasterized(int(known.sum()) > RASTER_ABOVE)
    axes.plot(x[~known], y[~known], "x", color=RED, markersize=4)
    axes.set_aspect("equal", adjustable="datalim")
    axes.invert_yaxis()
    axes.set_xlabel("x / px")
    axes.set_ylabel("y / px")
    bar = axes.inset_axes((1.03, 0.0, 0.04, 1.0))
    axes.figure.colorbar(points, cax=bar)
    bar.set_ylabel("residual / mpx")
