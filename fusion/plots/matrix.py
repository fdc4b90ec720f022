"""Figures of the 6x6 sensitivity: cross-talk as a map, cross-talk over frequency, strength of the excitations."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import LogNorm
from numpy.typing import NDArray

from fusion.plots.style import (
    BLACK,
    LIGHT,
    RED,
    FloatArray,
    Picture,
    decades,
    drawing,
    finish,
    lay_out,
    new_figure,
    panel_label,
)

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
