"""Figures of a campaign: curves over frequency with the scatter of recordings, all outputs, and the 6 x 6 matrix."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import replace
from typing import Any

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import LogNorm
from matplotlib.lines import Line2D
from matplotlib.ticker import MaxNLocator

from fusion.campaign.curve import LEAST_POINTS, Curve, CurvePoint, curve_elements, interpolate, single_points
from fusion.campaign.drive import Drive
from fusion.campaign.matrix import CrossTalk, MatrixFit
from fusion.campaign.matrix_solve import LEAST_SINGULAR
from fusion.report.style import (
    BLACK,
    BLUE,
    COLOURS,
    GREY,
    LIGHT,
    ORANGE,
    RED,
    SKY,
    Picture,
    Sheet,
    decades,
    frame_bars,
    padded,
    panel_label,
    polar_bars,
    power_of_ten,
    sheet,
)
from fusion.sensitivity.ratio import StatedMatrix
from shaker.arrays import FloatArray
from shaker.labels import LOAD_COMPONENTS, typeset

OUTPUT_MARKERS = ("o", "s", "D", "^", "v", "P")
MOUNTING_MARKERS = ("o", "s", "^", "v", "D")
BESIDE_SHARE = 0.012
"""How far ratios stand to the left of elements of matrices, as a share of the axis."""
SPREAD_SHARE = 0.008
"""Distance of the mountings from each other beside their frequency, as a share of the axis."""
SPREAD_OVER = 0.06
"""What all of them take of it, at most."""
IN_LEGEND = 14
BETWEEN_POINTS = 121
"""Number of places at which the interpolated curve is drawn."""
LARGEST_MAPS = 6
"""Number of frequencies whose cross-talk is drawn: those spread evenly over all."""
MAPS_BESIDE = 2
CELL_IN = 0.42
DARK_ABOVE = 0.55
"""Share of the colour scale above which text is white."""


def draw_curve(
    points: Sequence[CurvePoint], curves: Iterable[Curve], drives: Iterable[Drive], stated: StatedMatrix | None = None
) -> Picture:
    """Draw magnitude (relative to static where that is stated) and phase of one element over frequency.

    `points`: those of the element, of single recordings and of matrices; `curves` and `drives`: all of the campaign,
    from which the curve between the points is taken, and, below each, the single recordings if several are behind a
    point; `stated`: of the sensor's matrix, where elements of single recordings rest on it.
    """
    first, frequency = points[0], np.array([point.frequency_hz for point in points])
    name = f"output {first.channel} per load {first.component}"
    factor, power = power_of_ten(np.array([point.element.magnitude for point in points]))
    value, expanded = polar_bars([point.element for point in points], factor)
    static = [p.element.magnitude / p.relative.magnitude / factor for p in points if p.relative is not None]
    behind = [
        (curve, e)
        for curve in curves
        for e, (c, j) in enumerate(curve.elements)
        if (curve.channels[c], LOAD_COMPONENTS[j]) == (first.channel, first.component)
        and curve.kind in {point.kind for point in points}
    ]
    alone = [(curve, e) for curve, e in behind if curve.kind != "matrix"]
    singles = [one for curve, e in alone for one in single_points(curve, e, drives, stated)]
    repeated = len(singles) > len(points)
    heights = [1.5, 0.9, 1.2, 0.9] if repeated else [1.5, 1.2]
    kinds = [point.kind for point in points]
    what = "Ratio" if set(kinds) == {"ratio"} else "Sensitivity"
    text = f"{what}, {name}: magnitude and phase over frequency; bars and band: U."
    with sheet(
        f"curve-{first.channel}-{first.component}", 6.9 if repeated else 4.6, len(heights), heights=heights
    ) as drawn:
        upper, lower = drawn.panels[0], drawn.panels[len(heights) // 2]
        _draw_between((upper, lower), behind, factor)
        for axes, level, half in zip((upper, lower), value, expanded, strict=True):
            _draw_bars(axes, frequency, kinds, level, half)
        unit = f"{power}{typeset(first.unit)}"
        frame_bars(upper, lower, (value, expanded), unit, (static[0], "static") if static else None)
        lower.yaxis.set_major_locator(MaxNLocator(5))
        right = lower.secondary_yaxis("right", functions=(np.degrees, np.radians))
        right.set_ylabel("phase / °")
        right.spines["right"].set_visible(True)
        if repeated:
            single, _ = polar_bars([element for _, _, element in singles], factor)
            own = np.argmin(np.abs(np.array([f for f, _, _ in singles])[:, None] - frequency), axis=1)
            turn = np.mod(single[1] - value[1, own] + np.pi, 2.0 * np.pi) - np.pi
            for axes, off, half, unit in (
                (drawn.panels[1], 100.0 * (single[0] / value[0, own] - 1.0), 100.0 * expanded[0] / value[0], "%"),
                (drawn.panels[3], 1e3 * turn, 1e3 * expanded[1], "mrad"),
            ):
                _draw_bars(axes, frequency, kinds, np.zeros_like(half), half)
                _draw_mountings(axes, [(f, mounting) for f, mounting, _ in singles], off, _right_end(frequency))
                ends = np.concatenate([off, half, -half])
                axes.set_ylim(padded(float(np.nanmin(ends)), float(np.nanmax(ends))))
                axes.set_ylabel(f"from the curve / {unit}")
        upper.set_xlim(0.0, _right_end(frequency))
        drawn.panels[-1].set_xlabel("frequency / Hz")
        if len(set(kinds)) > 1:
            text += " Ratios and elements of single recordings stand to the left of their frequency."
        if "ratio" in kinds:
            text += " Ratios contain what the other loads do."
        if repeated:
            text += (
                " Below each: single recordings (open, by mounting, beside their frequency) about the curve with its U."
            )
        return _picture_with_legend(drawn, f"{what}, {name}", text, right=0.85)


def draw_outputs(curve: Curve, main: int) -> Picture:
    """Draw the magnitude of every output over frequency, relative to the `main` one, which belongs to the load.

    The axis is logarithmic; arrows where a value is below its U.
    """
    load = LOAD_COMPONENTS[curve.elements[0][1]]
    rows = [
        [(np.nan, np.nan) if p is None else (p.magnitude, p.expanded_magnitude) for p in row]
        for row in curve_elements(curve)
    ]
    size, u = np.moveaxis(np.asarray(rows, dtype=np.float64), 2, 0)
    share, expanded = 100.0 * size / size[:, [main]], 100.0 * u / size[:, [main]]
    reference = f"ratio to output {curve.channels[main]}"
    with sheet(f"outputs-{load}", 3.3) as drawn:
        (axes,) = drawn.panels
        axes.set_yscale("log")
        decades(axes.yaxis)
        for c, channel in enumerate(curve.channels):
            weak = share[:, c] <= expanded[:, c]
            colour = BLACK if c == main else COLOURS[c % len(COLOURS)]
            line, half = (
                np.where(np.isfinite(share[:, c]) & ~weak, values[:, c], np.nan) for values in (share, expanded)
            )
            look: dict[str, Any] = {"color": colour, "elinewidth": 1.0, "linewidth": 0.6, "label": channel}
            axes.errorbar(curve.frequency_hz, line, half, fmt=f"{OUTPUT_MARKERS[c % len(OUTPUT_MARKERS)]}-", **look)
            bound = (share + expanded)[weak, c]
            if bound.size:
                arrow: dict[str, Any] = {"yerr": [0.5 * bound, np.zeros_like(bound)], "uplims": True, "fmt": "none"}
                axes.errorbar(curve.frequency_hz[weak], bound, color=colour, alpha=0.7, **arrow)
        ends = share + expanded
        if np.isfinite(ends).any():
            floor = np.maximum(share - expanded, 0.3 * ends)
            axes.set_ylim(0.5 * float(np.nanmin(floor)), 2.0 * float(np.nanmax(ends)))
        axes.set_xlim(0.0, 1.08 * float(curve.frequency_hz.max(initial=1.0)))
        axes.set_xlabel("frequency / Hz")
        axes.set_ylabel(f"{reference} / %")
        caption = (
            f"Magnitude of the responses of all outputs to the driven load {load}, {reference}; bars: U. An arrow is "
            f"an upper bound where the signal is below its U."
        )
        return _picture_with_legend(drawn, f"All outputs under {load}", caption)


def draw_crosstalk(cross_talks: Sequence[CrossTalk]) -> Picture | None:
    """Draw maps of cross-talk, numbers in the cells, one colour scale for all; None where none is known."""
    if not cross_talks:
        return None
    chosen = np.linspace(0, len(cross_talks) - 1, min(len(cross_talks), LARGEST_MAPS)).round().astype(int)
    maps = [cross_talks[place] for place in np.unique(chosen)]
    rows, cells = -(-len(maps) // MAPS_BESIDE), max(len(found.channels) for found in maps)
    every = np.concatenate([_map(found).ravel() for found in maps])
    sizes = every[np.isfinite(every) & (every > 0.0)]
    high = float(sizes.max()) if sizes.size else 1.0
    low = max(float(sizes.min()), 1e-3 * high) if sizes.size else 0.1
    norm = LogNorm(low, high if high > low else 10.0 * low)
    with sheet("crosstalk", 0.5 + rows * (cells * CELL_IN + 0.65), rows, MAPS_BESIDE, sharex=False) as drawn:
        for axes, found in zip(drawn.panels, maps, strict=False):
            _draw_map(axes, found, norm)
        for axes in drawn.panels[len(maps) :]:
            axes.set_axis_off()
        caption = (
            "Cross-talk S_ij·capacity_j / (S_ii·capacity_i) in per cent: output i under the rated load j, as a share "
            "of its rated output. “<”: 95 % upper bound of an element that cannot be told from zero. 1: main elements."
        )
        layout: dict[str, Any] = {"left": 0.8, "top": 0.42, "bottom": 0.3, "gap": (0.75, 0.65), "label": 0.55}
        return drawn.picture("Cross-talk", caption, **layout)


def draw_excitation(fits: Sequence[MatrixFit]) -> Picture | None:
    """Draw the singular values of the loads at every frequency and the level below which a matrix is refused."""
    if not fits:
        return None
    with sheet("excitation", 2.7) as drawn:
        (axes,) = drawn.panels
        axes.set_yscale("log")
        decades(axes.yaxis)
        shift = np.linspace(-0.28, 0.28, len(fits)) if len(fits) > 1 else np.zeros(1)
        for place, fit in enumerate(fits):
            shade = mpl.colormaps["cividis"](0.1 + 0.75 * place / max(len(fits) - 1, 1))
            number = np.arange(1, len(fit.excitation.singular) + 1) + shift[place]
            axes.plot(number, fit.excitation.singular, "o", color=shade, label=f"{fit.frequency_hz:.4g} Hz")
        axes.axhline(LEAST_SINGULAR, color=RED, linewidth=1.0, linestyle=(0, (5, 3)), label="least that determines")
        axes.set_xticks(range(1, 7))
        axes.set_xlabel("independent excitation")
        axes.set_ylabel("amplitude / standard uncertainty")
        axes.legend(loc="upper left", bbox_to_anchor=(1.01, 1.0))
        caption = (
            "Singular values of the loads of all recordings: amplitude of each independent load in its standard "
            "uncertainties. Six above the line determine the whole matrix."
        )
        return drawn.picture("Independent excitations", caption, left=0.72, right=1.9, top=0.12, label=0.52)


def _right_end(frequency_hz: FloatArray) -> float:
    """Right end of the frequency axis."""
    return 1.06 * float(frequency_hz.max(initial=1.0))


def _draw_between(panels: Sequence[Axes], behind: Iterable[tuple[Curve, int]], factor: float) -> None:
    """Draw the interpolated element with its U, of the first curve that has enough points."""
    for curve, element in behind:
        usable = np.isfinite(curve.value[:, element])
        if np.count_nonzero(usable) < LEAST_POINTS:
            continue
        known, one = curve.frequency_hz[usable], curve.uncertainty.at([element])
        alone = replace(curve, elements=(curve.elements[element],), value=curve.value[:, [element]], uncertainty=one)
        fine = interpolate(alone, np.linspace(float(known.min()), float(known.max()), BETWEEN_POINTS))
        found = [(f, row[0]) for f, row in zip(fine.frequency_hz, curve_elements(fine), strict=True)]
        frequency = [f for f, element in found if element is not None]
        bars = polar_bars([element for _, element in found if element is not None], factor)
        for axes, value, expanded in zip(panels, *bars, strict=True):
            axes.fill_between(frequency, value - expanded, value + expanded, color=SKY, alpha=0.25, linewidth=0.0)
            axes.plot(frequency, value, color=SKY, linewidth=0.9, label="interpolated, U")
        return


def _draw_bars(
    axes: Axes, frequency: FloatArray, kinds: Sequence[str], value: FloatArray, expanded: FloatArray
) -> None:
    """Points of the curve with error bars: dots for single recordings, diamonds for elements of the matrix."""
    looks = {
        "ratio": ("o", BLUE, "ratio, U"),
        "element": ("o", BLUE, "element, U"),
        "matrix": ("D", ORANGE, "matrix element, U"),
    }
    for kind, (marker, colour, label) in looks.items():
        own = np.array([other == kind for other in kinds])
        if own.any():
            place = frequency[own] - (0.0 if kind == "matrix" or own.all() else BESIDE_SHARE * _right_end(frequency))
            look: dict[str, Any] = {"color": colour, "elinewidth": 1.1, "label": label, "zorder": 3}
            axes.errorbar(place, value[own], expanded[own], fmt=marker, **look)


def _draw_mountings(axes: Axes, recorded: Sequence[tuple[float, str]], off: FloatArray, right: float) -> None:
    """Single recordings of given frequency and mounting, off the curve (R,), each mounting beside its frequency."""
    mountings, all_hz = (np.array(column) for column in ([m for _, m in recorded], [f for f, _ in recorded]))
    names = np.unique(mountings)
    step = right * min(SPREAD_SHARE, SPREAD_OVER / len(names))
    for place, mounting in enumerate(names):
        own = mountings == mounting
        frequency = all_hz[own] + step * (place + 1)
        look: dict[str, Any] = {"markerfacecolor": "none", "markersize": 3.8, "markeredgewidth": 0.8, "linestyle": ""}
        marker = MOUNTING_MARKERS[place % len(MOUNTING_MARKERS)]
        axes.plot(frequency, off[own], marker, color=BLACK, label=f"mounting {mounting}", **look)
    axes.axhline(0.0, color=GREY, linewidth=0.8)
    axes.yaxis.set_major_locator(MaxNLocator(4, symmetric=True))


def _picture_with_legend(drawn: Sheet, title: str, caption: str, **layout: Any) -> Picture:
    """Turn a figure into a picture with one legend for all panels above the first, of many entries the first ones."""
    distinct: dict[str, Any] = {}
    for axes in drawn.panels:
        handles, labels = axes.get_legend_handles_labels()
        distinct |= {label: handle for label, handle in zip(labels, handles, strict=True) if label not in distinct}
    if len(distinct) > IN_LEGEND:
        kept = dict(list(distinct.items())[: IN_LEGEND - 1])
        distinct = {**kept, f"and {len(distinct) - len(kept)} more": Line2D([], [], linestyle="none")}
    drawn.figure.legend(distinct.values(), distinct.keys(), loc="upper left", ncols=7, bbox_to_anchor=(0.085, 1.0))
    return drawn.picture(title, caption, **{"top": 0.3, "left": 0.8, "label": 0.62, **layout})


def _map(found: CrossTalk) -> FloatArray:
    """Return size or upper bound (C, 6) of every element in per cent, NaN at the main ones."""
    size = 100.0 * np.abs(found.value)
    bound = np.where(found.holds_zero, size + 100.0 * found.half_axis, size)
    bound[np.arange(len(found.main)), list(found.main)] = np.nan
    return bound


def _draw_map(axes: Axes, found: CrossTalk, norm: LogNorm) -> None:
    """One map with its numbers: an upper bound where the region holds zero."""
    shown = _map(found)
    colours = mpl.colormaps["Blues"].with_extremes(bad=LIGHT)
    axes.imshow(np.ma.masked_invalid(shown), cmap=colours, norm=norm, aspect="auto")
    for i, j in np.ndindex(shown.shape):
        size, dark = float(shown[i, j]), False
        text = "1" if found.main[i] == j else "–"
        if np.isfinite(size):
            digits = f"{size:#.2g}".removesuffix(".") if size >= 1e-4 else f"{size:.0e}"
            text, dark = f"< {digits}" if found.holds_zero[i, j] else digits, float(norm(size)) > DARK_ABOVE
        axes.text(j, i, text, ha="center", va="center", fontsize=7.5, color="white" if dark else BLACK)
    axes.tick_params(length=0, labeltop=False)
    axes.grid(visible=False)
    for axis, names in ((axes.xaxis, found.components), (axes.yaxis, found.channels)):
        axis.set_ticks(range(len(names)), list(names))
        axis.set_ticks(np.arange(len(names) + 1) - 0.5, minor=True)
    axes.grid(which="minor", color="white", linewidth=1.5)
    axes.tick_params(which="minor", length=0)
    axes.spines[:].set_visible(False)
    panel_label(axes, f"{found.frequency_hz:.6g} Hz: outputs down, loads across, per cent")
