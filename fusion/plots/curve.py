"""Figures of a campaign over frequency: elements of the sensitivity relative to static, their U, all outputs."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator
from numpy.typing import NDArray

from fusion.plots.style import (
    BLACK,
    BLUE,
    GREEN,
    GREY,
    ORANGE,
    PURPLE,
    RED,
    SKY,
    FloatArray,
    Picture,
    decades,
    drawing,
    finish,
    lay_out,
    new_figure,
    padded,
    power_text,
    static_axis,
)
from fusion.polar import typeset
from shaker._checks import IntArray

OUTPUT_COLOURS = (BLUE, ORANGE, GREEN, RED, PURPLE, SKY)
OUTPUT_MARKERS = ("o", "s", "D", "^", "v", "P")
MOUNTING_MARKERS = ("o", "s", "^", "v", "D")
BESIDE_SHARE = 0.012
"""How far ratios stand to the left of elements of matrices, as a share of the axis."""
SPREAD_SHARE = 0.008
"""Distance of the mountings from each other beside their frequency, as a share of the axis."""


@dataclass(frozen=True)
class Points:
    """Values over frequency: magnitude and phase with expanded uncertainties (N,)."""

    frequency_hz: FloatArray
    magnitude: FloatArray
    phase_rad: FloatArray
    expanded_magnitude: FloatArray
    expanded_phase_rad: FloatArray


@dataclass(frozen=True)
class CurveDrawing:
    """One element of the sensitivity as a campaign found it.

    `name`: what the figure is called in the page; `label`: output per load; `unit`: of the magnitude; `value`: the
    curve; `matrix`: whether a point is an element of the matrix (N,); `static`: magnitude at rest, None where it is
    not stated; `single`: what each recording says by itself, with its `mounting` (R,) as a number; `between`:
    interpolated values, None where there is no interpolation.
    """

    name: str
    label: str
    unit: str
    value: Points
    matrix: NDArray[np.bool_]
    static: float | None
    single: Points
    mounting: NDArray[np.str_]
    between: Points | None


@dataclass(frozen=True)
class OutputsDrawing:
    """All outputs under one load over frequency: `share` (K, C) in per cent of `reference`, with expanded U (K, C)."""

    name: str
    load: str
    reference: str
    channels: tuple[str, ...]
    driven: int
    frequency_hz: FloatArray
    share: FloatArray
    expanded: FloatArray


def draw_campaign_curve(curve: CurveDrawing) -> Picture:
    """Draw magnitude (relative to static where that is stated) and phase over frequency, each above its residuals."""
    with drawing(curve.name):
        repeated = len(curve.single.frequency_hz) > len(curve.value.frequency_hz)
        figure = new_figure(6.9 if repeated else 4.6)
        ratios = [1.5, 0.9, 1.2, 0.9] if repeated else [1.5, 1.2]
        panels = figure.subplots(len(ratios), 1, sharex=True, gridspec_kw={"height_ratios": ratios})
        factor, label = _magnitude_scale(curve)
        _draw_magnitude(panels[0], curve, factor, label)
        _draw_phase(panels[len(ratios) // 2], curve)
        if repeated:
            _draw_scatter(panels[1], curve, *_magnitude_scatter(curve), "from the curve / %")
            _draw_scatter(panels[3], curve, *_phase_scatter(curve), "from the curve / mrad")
        panels[-1].set_xlabel("frequency / Hz")
        lay_out(figure, panels, right=0.85, left=0.8, top=0.3, label=0.62)
        _legend_above(figure, panels)
        return finish(figure, curve.name, f"Sensitivity, {curve.label}", _caption(curve, repeated))


def draw_campaign_outputs(outputs: OutputsDrawing) -> Picture:
    """Draw the magnitude of every output over frequency on a logarithmic axis; arrows where a value is below its U."""
    with drawing(outputs.name):
        figure = new_figure(3.3)
        axes = figure.subplots()
        axes.set_yscale("log")
        decades(axes.yaxis)
        for c, channel in enumerate(outputs.channels):
            _draw_output(axes, outputs, c, channel)
        ends = outputs.share + outputs.expanded
        floor = np.maximum(outputs.share - outputs.expanded, 0.3 * ends)
        if np.isfinite(ends).any():
            axes.set_ylim(0.5 * float(np.nanmin(floor)), 2.0 * float(np.nanmax(ends)))
        axes.set_xlim(0.0, 1.08 * float(outputs.frequency_hz.max(initial=1.0)))
        axes.set_xlabel("frequency / Hz")
        axes.set_ylabel(f"{outputs.reference} / %")
        lay_out(figure, [axes], top=0.3, left=0.8, label=0.62)
        _legend_above(figure, [axes])
        caption = (
            f"Magnitude of all outputs under the {outputs.load} load, {outputs.reference}; bars: U. An arrow is an "
            f"upper bound where the signal is below its U."
        )
        return finish(figure, outputs.name, f"All outputs under {outputs.load}", caption)


def _magnitude_scale(curve: CurveDrawing) -> tuple[float, str]:
    """Factor to divide magnitudes by, and the label of the axis."""
    sizes = curve.value.magnitude[np.isfinite(curve.value.magnitude)]
    largest = float(sizes.max()) if sizes.size else 1.0
    power = int(np.floor(np.log10(largest))) if largest > 0.0 else 0
    power = 0 if -2 <= power < 4 else power
    times = f"{power_text(power)} " if power else ""
    return 10.0**power, f"magnitude / {times}{typeset(curve.unit)}"


def _draw_magnitude(axes: Axes, curve: CurveDrawing, factor: float, label: str) -> None:
    """Magnitude with bars; the deviation from static on the right."""
    value = curve.value
    _band(axes, curve.between, "magnitude", factor)
    _bars(axes, curve, value.magnitude / factor, value.expanded_magnitude / factor)
    static = [] if curve.static is None else [curve.static]
    ends = [*(value.magnitude - value.expanded_magnitude), *(value.magnitude + value.expanded_magnitude), *static]
    axes.set_ylim(padded(*_range([end / factor for end in ends])))
    axes.set_xlim(0.0, _right_end(curve))
    axes.yaxis.set_major_locator(MaxNLocator(6))
    axes.set_ylabel(label)
    if curve.static is not None:
        static_axis(axes, curve.static / factor, "static")


def _draw_phase(axes: Axes, curve: CurveDrawing) -> None:
    """Phase with bars, in rad and on the right in degrees."""
    value = curve.value
    _band(axes, curve.between, "phase_rad", 1.0)
    _bars(axes, curve, value.phase_rad, value.expanded_phase_rad)
    ends = [*(value.phase_rad - value.expanded_phase_rad), *(value.phase_rad + value.expanded_phase_rad), 0.0]
    axes.set_ylim(padded(*_range(ends)))
    axes.axhline(0.0, color=GREY, linewidth=0.8)
    axes.yaxis.set_major_locator(MaxNLocator(5))
    axes.set_ylabel("phase / rad")
    right = axes.secondary_yaxis("right", functions=(np.degrees, np.radians))
    right.set_ylabel("phase / °")
    right.spines["right"].set_visible(True)


def _nearest(curve: CurveDrawing) -> IntArray:
    """Place on the curve (R,) that every single recording belongs to."""
    distance = np.abs(curve.single.frequency_hz[:, None] - curve.value.frequency_hz)
    return np.asarray(np.argmin(distance, axis=1), dtype=np.int64)


def _magnitude_scatter(curve: CurveDrawing) -> tuple[FloatArray, FloatArray]:
    """Deviations of the single magnitudes from the curve (R,), and the curve's U (N,), in per cent."""
    expanded = 100.0 * curve.value.expanded_magnitude / curve.value.magnitude
    return 100.0 * (curve.single.magnitude / curve.value.magnitude[_nearest(curve)] - 1.0), expanded


def _phase_scatter(curve: CurveDrawing) -> tuple[FloatArray, FloatArray]:
    """Deviations of the single phases from the curve (R,), and the curve's U (N,), in mrad."""
    turn = curve.single.phase_rad - curve.value.phase_rad[_nearest(curve)]
    return 1e3 * (np.mod(turn + np.pi, 2.0 * np.pi) - np.pi), 1e3 * curve.value.expanded_phase_rad


def _draw_scatter(axes: Axes, curve: CurveDrawing, single: FloatArray, expanded: FloatArray, label: str) -> None:
    """Single recordings about the curve, beside the curve's own U."""
    _bars(axes, curve, np.zeros_like(expanded), expanded)
    width = SPREAD_SHARE * _right_end(curve)
    mountings = np.unique(curve.mounting)
    for place, mounting in enumerate(mountings):
        own = curve.mounting == mounting
        marker = MOUNTING_MARKERS[place % len(MOUNTING_MARKERS)]
        frequency = curve.single.frequency_hz[own] + width * (place + 1)
        style: dict[str, Any] = {"markerfacecolor": "none", "markersize": 3.8, "markeredgewidth": 0.8, "linestyle": ""}
        axes.plot(frequency, single[own], marker, color=BLACK, label=f"mounting {mounting}", **style)
    axes.axhline(0.0, color=GREY, linewidth=0.8)
    axes.set_ylim(padded(*_range([*single, *expanded, *-expanded])))
    axes.yaxis.set_major_locator(MaxNLocator(4, symmetric=True))
    axes.set_ylabel(label)


def _right_end(curve: CurveDrawing) -> float:
    """Right end of the frequency axis."""
    return 1.06 * float(curve.value.frequency_hz.max(initial=1.0))


def _range(ends: Sequence[float]) -> tuple[float, float]:
    """Smallest and largest finite number."""
    finite = [float(end) for end in ends if np.isfinite(end)]
    return (min(finite), max(finite)) if finite else (0.0, 1.0)


def _bars(axes: Axes, curve: CurveDrawing, value: FloatArray, expanded: FloatArray) -> None:
    """Points of the curve with error bars: dots for ratios, diamonds for elements of the matrix."""
    for matrix, marker, label in ((False, "o", "ratio, U"), (True, "D", "matrix element, U")):
        own = curve.matrix == matrix
        if np.any(own):
            colour = ORANGE if matrix else BLUE
            aside = BESIDE_SHARE * _right_end(curve) if not matrix and np.any(curve.matrix) else 0.0
            place = curve.value.frequency_hz[own] - aside
            axes.errorbar(
                place, value[own], expanded[own], fmt=marker, color=colour, elinewidth=1.1, label=label, zorder=3
            )


def _band(axes: Axes, between: Points | None, field: str, factor: float) -> None:
    """Interpolated curve with its expanded uncertainty."""
    if between is None:
        return
    value = getattr(between, field) / factor
    expanded = getattr(between, f"expanded_{field}") / factor
    axes.fill_between(between.frequency_hz, value - expanded, value + expanded, color=SKY, alpha=0.25, linewidth=0.0)
    axes.plot(between.frequency_hz, value, color=SKY, linewidth=0.9, label="interpolated, U")


def _draw_output(axes: Axes, outputs: OutputsDrawing, c: int, channel: str) -> None:
    """One output: points with bars where it is above its U, else arrows from the upper bound."""
    share, expanded = outputs.share[:, c], outputs.expanded[:, c]
    known = np.isfinite(share)
    weak = known & (share <= expanded)
    colour = BLACK if c == outputs.driven else OUTPUT_COLOURS[c % len(OUTPUT_COLOURS)]
    marker = OUTPUT_MARKERS[c % len(OUTPUT_MARKERS)]
    strong = known & ~weak
    style: dict[str, Any] = {"color": colour, "elinewidth": 1.0, "linewidth": 0.6}
    line = np.where(strong, share, np.nan)
    axes.errorbar(
        outputs.frequency_hz, line, np.where(strong, expanded, np.nan), fmt=f"{marker}-", label=channel, **style
    )
    bound = (share + expanded)[weak]
    if bound.size:
        arrow = [0.5 * bound, np.zeros_like(bound)]
        axes.errorbar(outputs.frequency_hz[weak], bound, yerr=arrow, uplims=True, fmt="none", color=colour, alpha=0.7)


def _legend_above(figure: Figure, panels: Sequence[Axes]) -> None:
    """Legend in one row above the first panel."""
    distinct: dict[str, Any] = {}
    for axes in panels:
        handles, labels = axes.get_legend_handles_labels()
        distinct |= {label: handle for label, handle in zip(labels, handles, strict=True) if label not in distinct}
    figure.legend(distinct.values(), distinct.keys(), loc="upper left", ncols=7, bbox_to_anchor=(0.085, 1.0))


def _caption(curve: CurveDrawing, repeated: bool) -> str:
    """What the figure shows."""
    text = f"Complex sensitivity, {curve.label}: magnitude and phase over frequency; bars and band: U."
    if np.any(curve.matrix) and not np.all(curve.matrix):
        text += " Ratios stand to the left of their frequency; they contain what the other loads do."
    if not repeated:
        return text
    return (
        f"{text} Below each: single recordings (open, by mounting, beside their frequency) about the curve with its U."
    )
