"""Figures of a campaign: curves, all outputs, cross-talk and excitation."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import replace

import numpy as np

from fusion.campaign.curve import MIN_POINTS, CurvePoint, SensitivityCurve, curve_elements, interpolate, single_points
from fusion.campaign.excited_line import ExcitedLine
from fusion.campaign.matrix import CrossTalk, MatrixFit
from fusion.campaign.matrix_solve import MIN_SINGULAR
from fusion.report.figure import (
    BLACK,
    BLUE,
    COLOURS,
    DARK,
    GREY,
    ORANGE,
    RED,
    SKY,
    WHITE,
    Figure,
    Panel,
    Scale,
    empty_figure,
    frame_bars,
    padded_limits,
    polar_bars,
    power_of_ten,
)
from fusion.sensitivity.ratio import StatedMatrix
from shaker.labels import LOAD_COMPONENTS
from shakercal._common.arrays import FloatArray
from shakercal._common.digits import number_text, small, typeset

OUTPUT_MARKERS = ("circle", "square", "diamond", "triangle", "inverted_triangle", "cross")
MOUNTING_MARKERS = ("circle", "square", "triangle", "inverted_triangle", "diamond")
SHIFT_SHARE = 0.012
"""Shift of ratios to the left of matrix elements, as a share of the axis."""
SPREAD_SHARE = 0.008
"""Distance between the mountings of one frequency, as a share of the axis."""
SPREAD_OVER = 0.06
"""Largest width of all mountings of one frequency, as a share of the axis."""
IN_LEGEND = 12
"""Largest number of mountings with an entry in the legend; the others have one together."""
BETWEEN_POINTS = 121
"""Number of frequencies at which the interpolated curve is drawn."""
LARGEST_MAPS = 6
"""Largest number of frequencies whose cross-talk is drawn, evenly chosen from all."""
MAP_COLUMNS = 2
"""Number of maps per row."""
CELL_IN = 0.42
"""Height of a cell of a map."""
DARK_ABOVE = 0.55
"""Share of the colour scale above which text is white."""


def draw_curve(points: Sequence[CurvePoint], curves: Iterable[SensitivityCurve]) -> Figure:
    """Draw magnitude (its deviation from static if stated) and phase over frequency.

    `points`: those of the element, of single recordings and of matrices; `curves`: all of the campaign, which give the
    interpolated curve.
    """
    first, frequency = points[0], np.array([point.frequency_hz for point in points])
    factor, power = power_of_ten(np.array([point.element.magnitude for point in points]))
    value, expanded = polar_bars([point.element for point in points], factor)
    static = [p.element.magnitude / p.relative.magnitude / factor for p in points if p.relative is not None]
    kinds = [point.kind for point in points]
    drawn = empty_figure(f"curve-{first.channel}-{first.component}", 4.0, [1.5, 1.2])
    _draw_between(drawn.panels, _matching(points, curves), factor)
    for panel, level, half in zip(drawn.panels, value, expanded, strict=True):
        _draw_bars(panel, frequency, kinds, level, half)
        panel.x.limits, panel.x.link = (0.0, _right_end(frequency)), "frequency"
    upper, lower = drawn.panels
    unit = f"{power}{typeset(first.unit)}"
    frame_bars(upper, lower, (value, expanded), unit, (static[0], "static") if static else None)
    lower.y.second = ("phase / °", 0.0, float(np.degrees(1.0)))
    lower.x.label = "frequency / Hz"
    text = "Magnitude and phase over frequency; bars and band: U."
    if len(set(kinds)) > 1:
        text += " Ratios and elements of single recordings are shifted to the left of their frequency."
    if "ratio" in kinds:
        text += " Ratios include the effect of the other loads."
    return drawn.with_title(_curve_title(points), text, main=True)


def draw_recordings(
    points: Sequence[CurvePoint],
    curves: Iterable[SensitivityCurve],
    drives: Iterable[ExcitedLine],
    stated: StatedMatrix | None = None,
) -> Figure | None:
    """Draw single recordings relative to the curve; None if no point has several.

    `points`, `curves`: as of `draw_curve`; `drives`: all of the campaign; `stated`: the stated matrix for elements of
    single recordings.
    """
    single_kind = [(curve, e) for curve, e in _matching(points, curves) if curve.kind != "matrix"]
    singles = [one for curve, e in single_kind for one in single_points(curve, e, drives, stated)]
    if len(singles) <= len(points):
        return None
    first, frequency, kinds = points[0], np.array([p.frequency_hz for p in points]), [p.kind for p in points]
    value, expanded = polar_bars([point.element for point in points], 1.0)
    single, _ = polar_bars([element for _, _, element in singles], 1.0)
    nearest = np.argmin(np.abs(np.array([f for f, _, _ in singles])[:, None] - frequency), axis=1)
    phase = np.mod(single[1] - value[1, nearest] + np.pi, 2.0 * np.pi) - np.pi
    drawn = empty_figure(f"recordings-{first.channel}-{first.component}", 3.6, 2)
    for panel, off, half, label in zip(
        drawn.panels,
        (100.0 * (single[0] / value[0, nearest] - 1.0), 1e3 * phase),
        (100.0 * expanded[0] / value[0], 1e3 * expanded[1]),
        ("magnitude / %", "phase / mrad"),
        strict=True,
    ):
        _draw_bars(panel, frequency, kinds, np.zeros_like(half), half)
        _draw_mountings(panel, [(f, mounting) for f, mounting, _ in singles], off, _right_end(frequency))
        ends = np.concatenate([off, half, -half])
        panel.y.limits = padded_limits(float(np.nanmin(ends)), float(np.nanmax(ends)))
        panel.y.label = label
        panel.x.limits, panel.x.link = (0.0, _right_end(frequency)), "frequency"
    drawn.panels[-1].x.label = "frequency / Hz"
    text = "Single recordings less the curve (open, by mounting, shifted in frequency); bars: U of the curve."
    return drawn.with_title(f"Single recordings, output {first.channel} per load {first.component}", text)


def draw_deviations(mains: Sequence[Sequence[CurvePoint]]) -> Figure:
    """Draw the main elements over frequency in one figure: magnitude from static, and phase.

    `mains`: the points of each. A magnitude is relative to the first one if not all static values are stated.
    """
    every = [point for points in mains for point in points]
    by_static = all(point.relative is not None for point in every)
    drawn = empty_figure("deviations", 4.0, [1.5, 1.2])
    right = _right_end(np.array([point.frequency_hz for point in every]))
    ends: list[list[FloatArray]] = [[], []]
    for index, points in enumerate(mains):
        colour, marker = COLOURS[index % len(COLOURS)], OUTPUT_MARKERS[index % len(OUTPUT_MARKERS)]
        level, half = polar_bars([point.element for point in points], 1.0)
        if by_static:
            relative, half_relative = polar_bars([p.relative for p in points if p.relative is not None], 1.0)
            level[0], half[0] = relative[0], half_relative[0]
        else:
            level[0], half[0] = level[0] / level[0, 0], half[0] / level[0, 0]
        shift = SHIFT_SHARE * right * (index - 0.5 * (len(mains) - 1))
        frequency = np.array([point.frequency_hz for point in points]) + shift
        label = f"{points[0].channel} per {points[0].component}"
        rows = (100.0 * (level[0] - 1.0), 100.0 * half[0]), (level[1], half[1])
        for panel, (size, bars), reach in zip(drawn.panels, rows, ends, strict=True):
            panel.line(frequency, size, label, colour=colour, width=0.6)
            panel.points(frequency, size, label, half_y=bars, colour=colour, marker=marker)
            reach += [size - bars, size + bars]
    for panel, reach in zip(drawn.panels, ends, strict=True):
        finite = np.concatenate([*reach, np.zeros(1)])
        panel.y.limits = padded_limits(float(np.nanmin(finite)), float(np.nanmax(finite)))
        panel.x.limits, panel.x.link = (0.0, 1.04 * right), "frequency"
        panel.rule(0.0, colour=GREY)
    upper, lower = drawn.panels
    upper.y.label = "from static / %" if by_static else "from the first / %"
    lower.y.label, lower.x.label = "phase / rad", "frequency / Hz"
    text = "Main elements over frequency, slightly shifted; bars: U."
    return drawn.with_title("Sensitivity of every output to its load", text, main=True)


def _curve_title(points: Sequence[CurvePoint]) -> str:
    quantity = "Ratio" if {point.kind for point in points} == {"ratio"} else "Sensitivity"
    return f"{quantity}, output {points[0].channel} per load {points[0].component}"


def _matching(points: Sequence[CurvePoint], curves: Iterable[SensitivityCurve]) -> list[tuple[SensitivityCurve, int]]:
    """Return the curves that have the element of some points, with its index in each."""
    first, kinds = points[0], {point.kind for point in points}
    return [
        (curve, e)
        for curve in curves
        for e, (c, j) in enumerate(curve.elements)
        if (curve.channels[c], LOAD_COMPONENTS[j]) == (first.channel, first.component) and curve.kind in kinds
    ]


def draw_outputs(curve: SensitivityCurve, main: int) -> Figure:
    """Draw the magnitude of every output over frequency, relative to the `main` one.

    The axis is logarithmic; arrows are upper bounds of values below their U.
    """
    load = LOAD_COMPONENTS[curve.elements[0][1]]
    rows = [
        [(np.nan, np.nan) if p is None else (p.magnitude, p.expanded_magnitude) for p in row]
        for row in curve_elements(curve)
    ]
    size, u = np.moveaxis(np.asarray(rows, dtype=np.float64), 2, 0)
    share, expanded = 100.0 * size / size[:, [main]], 100.0 * u / size[:, [main]]
    reference = f"ratio to output {curve.channels[main]}"
    drawn = empty_figure(f"outputs-{load}", 3.3)
    (panel,) = drawn.panels
    panel.y.log = True
    for c, channel in enumerate(curve.channels):
        weak = share[:, c] <= expanded[:, c]
        colour = BLACK if c == main else COLOURS[c % len(COLOURS)]
        level, half = (np.where(np.isfinite(share[:, c]) & ~weak, values[:, c], np.nan) for values in (share, expanded))
        panel.line(curve.frequency_hz, level, channel, colour=colour, width=0.6)
        marker = OUTPUT_MARKERS[c % len(OUTPUT_MARKERS)]
        panel.points(curve.frequency_hz, level, channel, half_y=half, colour=colour, marker=marker)
        if weak.any():
            panel.bounds(curve.frequency_hz[weak], (share + expanded)[weak, c], channel, colour=colour)
    ends = share + expanded
    if np.isfinite(ends).any():
        floor = np.maximum(share - expanded, 0.3 * ends)
        panel.y.limits = (0.5 * float(np.nanmin(floor)), 2.0 * float(np.nanmax(ends)))
    panel.x.limits, panel.x.link = (0.0, 1.08 * float(curve.frequency_hz.max(initial=1.0))), "frequency"
    panel.x.label, panel.y.label = "frequency / Hz", f"{reference} / %"
    caption = (
        f"Magnitude of the responses of all outputs to the driven load {load}, {reference}; bars: U. An arrow is "
        f"an upper bound where the signal is below its U."
    )
    return drawn.with_title(f"All outputs under {load}", caption)


def draw_crosstalk(cross_talks: Sequence[CrossTalk]) -> Figure | None:
    """Draw maps of cross-talk with numbers and one colour scale; None without cross-talk."""
    if not cross_talks:
        return None
    chosen = np.linspace(0, len(cross_talks) - 1, min(len(cross_talks), LARGEST_MAPS)).round().astype(int)
    maps = [cross_talks[index] for index in np.unique(chosen)]
    columns = min(MAP_COLUMNS, len(maps))
    rows, cells = -(-len(maps) // columns), max(len(found.channels) for found in maps)
    every = np.concatenate([_map(found).ravel() for found in maps])
    sizes = every[np.isfinite(every) & (every > 0.0)]
    high = float(sizes.max()) if sizes.size else 1.0
    low = max(float(sizes.min()), 1e-3 * high) if sizes.size else 0.1
    label = "share of the rated output / %"
    scale = Scale("Blues", low, high if high > low else 10.0 * low, label, log=True)
    drawn = empty_figure("crosstalk", 0.5 + rows * (cells * CELL_IN + 1.3), rows, columns, shared_x=False)
    for panel, found in zip(drawn.panels, maps, strict=False):
        _draw_map(panel, found, scale)
    for panel in drawn.panels[len(maps) :]:
        panel.blank = True
    caption = (
        "Cross-talk S_ij·capacity_j / (S_ii·capacity_i) in per cent: output i under the rated load j, as a share "
        "of its rated output. 100: main elements. “<”: 95 % upper bound of an element not distinguishable from zero."
    )
    return drawn.with_title("Cross-talk", caption, main=True)


def draw_excitation(fits: Sequence[MatrixFit]) -> Figure | None:
    """Draw the singular values of the loads at every frequency, and their limit."""
    if not fits:
        return None
    drawn = empty_figure("excitation", 2.9)
    (panel,) = drawn.panels
    panel.y.log = True
    shift = np.linspace(-0.28, 0.28, len(fits)) if len(fits) > 1 else np.zeros(1)
    frequency = [fit.frequency_hz for fit in fits]
    scale = Scale(
        "cividis", min(frequency), max(frequency) if len(fits) > 1 else min(frequency) + 1.0, "frequency / Hz"
    )
    singular = [fit.excitation.singular for fit in fits]
    number = np.concatenate(
        [np.arange(1, len(values_of) + 1) + offset for values_of, offset in zip(singular, shift, strict=True)]
    )
    values = np.repeat(frequency, [len(values_of) for values_of in singular])
    panel.points(number, np.concatenate(singular), values=values, scale=scale)
    panel.rule(MIN_SINGULAR, "limit for a matrix", colour=RED, width=1.0, dashed=True)
    panel.x.ticks = tuple(range(1, 7))
    panel.x.label, panel.y.label = "independent excitation", "amplitude / standard uncertainty"
    caption = (
        "Singular values of the loads of all recordings: amplitude of each independent load in its standard "
        "uncertainties. Six above the line determine the whole matrix."
    )
    return drawn.with_title("Independent excitations", caption)


def _right_end(frequency_hz: FloatArray) -> float:
    """Return the right end of the frequency axis."""
    return 1.06 * float(frequency_hz.max(initial=1.0))


def _draw_between(panels: Sequence[Panel], candidates: Iterable[tuple[SensitivityCurve, int]], factor: float) -> None:
    """Draw the interpolated element with its U, of the first curve with enough points."""
    for curve, element in candidates:
        usable = np.isfinite(curve.value[:, element])
        if np.count_nonzero(usable) < MIN_POINTS:
            continue
        available, one = curve.frequency_hz[usable], curve.uncertainty.at([element])
        alone = replace(curve, elements=(curve.elements[element],), value=curve.value[:, [element]], uncertainty=one)
        fine = interpolate(alone, np.linspace(float(available.min()), float(available.max()), BETWEEN_POINTS))
        found = [(f, row[0]) for f, row in zip(fine.frequency_hz, curve_elements(fine), strict=True)]
        frequency = [f for f, element in found if element is not None]
        bars = polar_bars([element for _, element in found if element is not None], factor)
        for panel, value, expanded in zip(panels, *bars, strict=True):
            panel.line(frequency, value, "interpolated, U", colour=SKY, width=0.9)
            panel.band(frequency, value - expanded, value + expanded, "interpolated, U", colour=SKY)
        return


def _draw_bars(
    panel: Panel, frequency: FloatArray, kinds: Sequence[str], value: FloatArray, expanded: FloatArray
) -> None:
    """Draw points of the curve with error bars, with one marker per kind."""
    looks = {
        "ratio": ("circle", BLUE, "ratio, U"),
        "element": ("circle", BLUE, "element, U"),
        "matrix": ("diamond", ORANGE, "matrix element, U"),
    }
    for kind, (marker, colour, label) in looks.items():
        mask = np.array([other == kind for other in kinds])
        if mask.any():
            position = frequency[mask] - (
                0.0 if kind == "matrix" or mask.all() else SHIFT_SHARE * _right_end(frequency)
            )
            panel.points(position, value[mask], label, half_y=expanded[mask], colour=colour, marker=marker)


def _draw_mountings(panel: Panel, recorded: Sequence[tuple[float, str]], off: FloatArray, right: float) -> None:
    """Draw single recordings relative to the curve (R,), each mounting slightly shifted in frequency."""
    mountings, all_hz = (np.array(column) for column in ([m for _, m in recorded], [f for f, _ in recorded]))
    names = np.unique(mountings)
    step = right * min(SPREAD_SHARE, SPREAD_OVER / len(names))
    for number, mounting in enumerate(names):
        mask = mountings == mounting
        label = f"mounting {mounting}" if number < IN_LEGEND else f"{len(names) - IN_LEGEND} more mountings"
        marker = MOUNTING_MARKERS[number % len(MOUNTING_MARKERS)]
        labels = (f"mounting {mounting}",) * int(mask.sum())
        frequency = all_hz[mask] + step * (number + 1)
        panel.points(frequency, off[mask], label, colour=BLACK, marker=marker, open=True, size=3.8, names=labels)
    panel.rule(0.0, colour=GREY)


def _map(found: CrossTalk) -> FloatArray:
    """Return size or upper bound (C, 6) of every element in per cent."""
    size = 100.0 * np.abs(found.value)
    bound = np.where(found.holds_zero, size + 100.0 * found.half_axis, size)
    bound[np.arange(len(found.main)), list(found.main)] = np.nan
    return bound


def _draw_map(panel: Panel, found: CrossTalk, scale: Scale) -> None:
    """Draw one map with its numbers; an upper bound if the region includes zero."""
    shown = _map(found)
    i, j = (cell.ravel() for cell in np.indices(shown.shape))
    names = [f"output {found.channels[a]} under {found.components[b]}" for a, b in zip(i, j, strict=True)]
    ends = (j - 0.48, j + 0.48), (i - 0.48, i + 0.48)
    coloured = np.where(found.holds_zero, np.nan, shown)
    panel.boxes(*ends, values=coloured.ravel(), scale=scale, names=tuple(names))
    span = np.log(scale.high / scale.low)
    for cell in np.ndindex(shown.shape):
        size, dark = float(shown[cell]), False
        text = "100" if found.main[cell[0]] == cell[1] else "–"
        if np.isfinite(size):
            digits = small(size).removeprefix("< ")
            text = f"< {digits}" if found.holds_zero[cell] else digits
            log_size = np.log(max(size, scale.low) / scale.low)
            dark = bool(log_size > DARK_ABOVE * span and not found.holds_zero[cell])
        panel.text(cell[1], cell[0], text, colour=WHITE if dark else DARK if np.isfinite(size) else BLACK)
    panel.x.names, panel.y.names = tuple(found.components), tuple(found.channels)
    panel.x.grid = panel.y.grid = False
    panel.title = f"{number_text(found.frequency_hz, 6)} Hz: outputs down, loads across, per cent"
