"""Figures of the DIC Challenge: measured against true displacement, noise against resolution, bias in the pixel."""

from __future__ import annotations

import io
from collections.abc import Mapping
from typing import Any

import numpy as np
from dic_metrics import (
    AMPLITUDE_PX,
    LEVEL,
    LONG_PX,
    Field,
    centre_row,
    period_px,
    projected_amplitude,
    running_mean,
    true_shift,
)
from matplotlib.figure import Figure
from matplotlib.ticker import NullFormatter, ScalarFormatter
from PIL import Image

from fusion.report.figure import BLACK, BLUE, GREEN, GREY, LIGHT, ORANGE, PURPLE, RED, SKY
from fusion.report.figure_files import drawing, new_figure

STYLES: dict[str, tuple[str, str]] = {
    "shakercal, affine": (BLUE, "o"),
    "shakercal, quadratic": (BLUE, "s"),
    "shakercal, translation": (SKY, "o"),
    "pyvale, affine": (RED, "o"),
    "pyvale, quadratic": (RED, "s"),
    "pyvale, affine, filtered": (ORANGE, "o"),
    "pyvale, quadratic, filtered": (ORANGE, "s"),
    "pyidi, translation": (GREEN, "o"),
    "al-dic, affine": (PURPLE, "o"),
    "al-dic, affine, global": (BLACK, "x"),
}
"""Colour and marker of every program."""
BINS = 20
NOISE_MPX = (2.5, 50.0)
PANELS = (("translation", "affine"), 1), (("quadratic",), 2)  # shape functions and the order of the prediction


def cut_figure(fields: Mapping[str, Field], side_px: int) -> bytes:
    """Return measured over true displacement along the centre row, with what least squares predict."""
    with drawing("dic-cut"):
        figure = new_figure(3.9)
        for axes, (shapes, order), limits in zip(
            figure.subplots(1, 2), PANELS, ((20.0, 200.0), (12.0, 80.0)), strict=True
        ):
            own = fields.get(f"shakercal, {shapes[-1]}")
            if own is not None:
                x, ratio = centre_row(own)
                axes.plot(period_px(x), ratio, ".", color=LIGHT, markersize=2.0, zorder=0)
            period = np.linspace(*limits, 400)
            for name, field in fields.items():
                if any(shape in name for shape in shapes):
                    axes.plot(*running_mean(field), color=STYLES[name][0], linewidth=0.9, label=name)
            predicted = projected_amplitude(side_px, order, period)
            axes.plot(period, predicted, "--", color=BLACK, linewidth=0.9, label="least squares, no noise")
            axes.axhline(LEVEL, color=GREY, linewidth=0.7)
            axes.set(xlim=limits, ylim=(0.4, 1.1), xlabel="period p in px", ylabel="measured v / true v, centre row")
            axes.set_title(f"{' and '.join(shapes)}, {side_px} × {side_px} px", fontsize=8)
        return _with_legend(figure)


def _with_legend(figure: Figure) -> bytes:
    """Return a figure with one legend below its panels as a PNG file of few colours."""
    entries = dict[str, Any]()
    for axes in figure.axes:
        entries |= {label: line for line, label in zip(*axes.get_legend_handles_labels(), strict=True)}
    figure.legend(entries.values(), entries.keys(), fontsize=7, ncols=4, loc="lower center", frameon=False)
    figure.tight_layout(rect=(0.0, 0.06 + 0.25 / figure.get_figheight(), 1.0, 1.0))
    return _png(figure)


def _png(figure: Figure) -> bytes:
    drawn, stored = io.BytesIO(), io.BytesIO()
    figure.savefig(drawn, format="png", dpi=160)
    Image.open(drawn).convert("RGB").quantize(200, dither=Image.Dither.NONE).save(stored, format="png", optimize=True)
    return stored.getvalue()


def efficiency_figure(places: Mapping[tuple[str, int], tuple[float, float]]) -> bytes:
    """Return noise over resolution of every program and size in px, with lines of equal MEI."""
    with drawing("dic-efficiency"):
        figure = new_figure(4.2)
        axes = figure.subplots()
        spread = np.array([10.0, 220.0])
        for mei in (0.3, 0.4, 0.5, 0.6, 0.7, 0.8, 0.9):
            axes.plot(spread, 1e3 * mei / spread, color=LIGHT, linewidth=0.7, zorder=0)
            end = min(spread[1], 1e3 * mei / NOISE_MPX[0])
            axes.annotate(f"{mei:.1f} px²", (end, 1e3 * mei / end), fontsize=6, color=GREY, ha="left", va="bottom")
        for name, (colour, marker) in STYLES.items():
            own = sorted((side, *place) for (program, side), place in places.items() if program == name)
            if not own:
                continue
            sides, resolution, noise = (np.array(column) for column in zip(*own, strict=True))
            axes.plot(resolution, 1e3 * noise, marker + "-", color=colour, markersize=3.5, linewidth=0.7, label=name)
            if name.startswith("shakercal") and "translation" not in name:
                for side, x, y in zip(sides, resolution, 1e3 * noise, strict=True):
                    axes.annotate(f"{side} px ", (x, y), fontsize=6, color=colour, ha="right", va="top")
        axes.set(xscale="log", yscale="log", xlim=spread, xlabel="spatial resolution λ in px")
        axes.set(ylabel="noise σ in mpx", ylim=NOISE_MPX)
        _plain_ticks(axes.xaxis, (10, 20, 50, 100, 200))
        _plain_ticks(axes.yaxis, (3, 5, 10, 20, 50))
        axes.legend(fontsize=7, loc="upper right")
        figure.tight_layout()
        return _png(figure)


def _plain_ticks(axis: Any, ticks: tuple[int, ...]) -> None:
    axis.set_ticks(ticks)
    axis.set_major_formatter(ScalarFormatter())
    axis.set_minor_formatter(NullFormatter())


def bias_figure(fields: Mapping[str, Field], side_px: int) -> bytes:
    """Return the mean error of v over the true v, long periods, one panel per shape function."""
    with drawing("dic-bias"):
        figure = new_figure(3.6)
        for axes, (shapes, order) in zip(figure.subplots(1, 2, sharey=True), PANELS, strict=True):
            used = {name: field for name, field in fields.items() if any(shape in name for shape in shapes)}
            for name, field in used.items():
                axes.plot(*_mean_errors(field), color=STYLES[name][0], linewidth=0.9, label=name)
            for field in list(used.values())[:1]:
                shares = projected_amplitude(side_px, order, field.period)[:, None]
                predicted = Field(field.points, true_shift(field.points) * shares)
                axes.plot(*_mean_errors(predicted), "--", color=BLACK, linewidth=0.9, label="least squares, no noise")
            axes.axhline(0.0, color=GREY, linewidth=0.7)
            axes.set(xlabel="true v in px", ylabel="mean error of v in mpx", xlim=(-AMPLITUDE_PX, AMPLITUDE_PX))
            axes.set_title(f"{' and '.join(shapes)}, {side_px} × {side_px} px, p > {LONG_PX:.0f} px", fontsize=8)
        return _with_legend(figure)


def _mean_errors(field: Field) -> tuple[Any, Any]:
    """Return the middles of bins of the true v in px and the mean error of v in each in mpx."""
    v, error = true_shift(field.points)[:, 1], field.error[:, 1]
    used = np.isfinite(error) & (field.period > LONG_PX)
    edges = np.linspace(-AMPLITUDE_PX, AMPLITUDE_PX, BINS + 1)
    place = np.clip(np.digitize(v[used], edges) - 1, 0, BINS - 1)
    count, total = np.bincount(place, minlength=BINS), np.bincount(place, error[used], BINS)
    mean = np.where(count > 30, 1e3 * total / np.maximum(count, 1), np.nan)
    return (edges[:-1] + edges[1:]) / 2.0, mean
