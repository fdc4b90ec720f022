"""Figures of a campaign: curves over frequency, the 6 x 6 matrix."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import LogNorm
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator
from numpy.typing import NDArray

from fusion.base import typeset
from fusion.report.style import (
    BLACK,
    BLUE,
    GREEN,
    GREY,
    LIGHT,
    ORANGE,
    PURPLE,
    RED,
    SKY,
    Picture,
    decades,
    drawing,
    finish,
    lay_out,
    new_figure,
    padded,
    panel_label,
    power_text,
    static_axis,
)
from shaker.arrays import FloatArray, IntArray

# Figures of a campaign over frequency: elements of the sensitivity relative to static, their U, all outputs.


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


# Figures of the 6x6 sensitivity: cross-talk as a map, cross-talk over frequency, strength of the excitations.


MAPS_BESIDE = 2
CELL_IN = 0.42
DARK_ABOVE = 0.55
"""Share of the colour scale above which text is white."""


@dataclass(frozen=True)
class CrosstalkMap:
    """Cross-talk at one frequency: `size` (C, 6) in per cent of the rated main output.

    `half_axis` (C, 6): of the 95 % region, in per cent; `holds_zero` (C, 6): whether the region holds zero, so that
    `size` is only bounded, by the sum of both; `main` (C,): component of each channel.
    """

    frequency_hz: float
    channels: tuple[str, ...]
    components: tuple[str, ...]
    size: FloatArray
    half_axis: FloatArray
    holds_zero: NDArray[np.bool_]
    main: tuple[int, ...]

    @property
    def shown(self) -> FloatArray:
        """Return size or upper bound (C, 6) of every element, NaN at the main ones."""
        bound = np.where(self.holds_zero, self.size + self.half_axis, self.size)
        bound[np.arange(len(self.main)), list(self.main)] = np.nan
        return bound


@dataclass(frozen=True)
class ExcitationDrawing:
    """Singular values (6,) of the loads at one frequency, largest first, and the least that determines a matrix."""

    frequency_hz: float
    singular: FloatArray
    least: float


def draw_crosstalk(maps: Sequence[CrosstalkMap]) -> Picture:
    """Draw one map of cross-talk per frequency, numbers in the cells, one colour scale for all."""
    rows = -(-len(maps) // MAPS_BESIDE)
    cells = max(len(item.channels) for item in maps)
    with drawing("crosstalk"):
        figure = new_figure(0.5 + rows * (cells * CELL_IN + 0.65))
        every = figure.subplots(rows, MAPS_BESIDE, squeeze=False)
        norm = _norm(maps)
        for place, axes in enumerate(every.ravel()):
            if place < len(maps):
                _draw_map(axes, maps[place], norm)
            else:
                axes.set_axis_off()
        lay_out(figure, every.ravel(), left=0.8, top=0.42, bottom=0.3, gap=(0.75, 0.65), label=0.55)
        caption = (
            "Cross-talk S_ij·capacity_j / (S_ii·capacity_i) in per cent: output i under the rated load j, as a share "
            "of its rated output. “<”: 95 % upper bound of an element that cannot be told from zero. 1: main elements."
        )
        return finish(figure, "crosstalk", "Cross-talk", caption)


def draw_excitation(items: Sequence[ExcitationDrawing]) -> Picture:
    """Draw the singular values of the loads at every frequency and the level below which a matrix is refused."""
    with drawing("excitation"):
        figure = new_figure(2.7)
        axes = figure.subplots()
        axes.set_yscale("log")
        decades(axes.yaxis)
        for place, item in enumerate(items):
            shift = np.linspace(-0.28, 0.28, len(items))[place] if len(items) > 1 else 0.0
            shade = mpl.colormaps["cividis"](0.1 + 0.75 * place / max(len(items) - 1, 1))
            number = np.arange(1, len(item.singular) + 1) + shift
            axes.plot(number, item.singular, "o", color=shade, label=f"{item.frequency_hz:.4g} Hz")
        axes.axhline(items[0].least, color=RED, linewidth=1.0, linestyle=(0, (5, 3)), label="least that determines")
        axes.set_xticks(range(1, 7))
        axes.set_xlabel("independent excitation")
        axes.set_ylabel("amplitude / standard uncertainty")
        axes.legend(loc="upper left", bbox_to_anchor=(1.01, 1.0))
        lay_out(figure, [axes], right=1.9)
        caption = (
            "Singular values of the loads of all recordings: amplitude of each independent load in its standard "
            "uncertainties. Six above the line determine the whole matrix."
        )
        return finish(figure, "excitation", "Independent excitations", caption)


def _norm(maps: Sequence[CrosstalkMap]) -> LogNorm:
    """Colour scale that holds all cells: three decades at most."""
    shown = np.concatenate([item.shown.ravel() for item in maps])
    sizes = shown[np.isfinite(shown) & (shown > 0.0)]
    high = float(sizes.max()) if sizes.size else 1.0
    low = max(float(sizes.min()), 1e-3 * high) if sizes.size else 0.1
    return LogNorm(low, high if high > low else 10.0 * low)


def _draw_map(axes: Axes, item: CrosstalkMap, norm: LogNorm) -> None:
    """One map with its numbers."""
    shown = item.shown
    colours = mpl.colormaps["Blues"].with_extremes(bad=LIGHT)
    axes.imshow(np.ma.masked_invalid(shown), cmap=colours, norm=norm, aspect="auto")
    for i, j in np.ndindex(shown.shape):
        dark = np.isfinite(shown[i, j]) and float(norm(shown[i, j])) > DARK_ABOVE
        colour = "white" if dark else BLACK
        axes.text(j, i, _cell(item, i, j), ha="center", va="center", fontsize=7.5, color=colour)
    axes.set_xticks(range(len(item.components)), list(item.components))
    axes.set_yticks(range(len(item.channels)), list(item.channels))
    axes.tick_params(length=0, labeltop=False)
    axes.grid(visible=False)
    axes.set_xticks(np.arange(len(item.components) + 1) - 0.5, minor=True)
    axes.set_yticks(np.arange(len(item.channels) + 1) - 0.5, minor=True)
    axes.grid(which="minor", color="white", linewidth=1.5)
    axes.tick_params(which="minor", length=0)
    for spine in axes.spines.values():
        spine.set_visible(False)
    panel_label(axes, f"{item.frequency_hz:.6g} Hz: outputs down, loads across, per cent")


def _cell(item: CrosstalkMap, i: int, j: int) -> str:
    """Text of one cell: an upper bound where the region holds zero."""
    if item.main[i] == j:
        return "1"
    shown = float(item.shown[i, j])
    if not np.isfinite(shown):
        return "–"
    return f"< {_short(shown)}" if item.holds_zero[i, j] else _short(shown)


def _short(size: float) -> str:
    """Two significant digits without an exponent."""
    return f"{size:#.2g}".removesuffix(".") if size >= 1e-4 else f"{size:.0e}"
