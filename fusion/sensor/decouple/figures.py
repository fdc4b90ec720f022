"""Figures of a decoupling: cross-talk over frequency, and readings while a load makes a step."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from matplotlib.axes import Axes

from fusion.report.style import (
    BLUE,
    GREEN,
    GREY,
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
    panel_label,
)
from shaker.arrays import FloatArray

STAGE_COLOURS = {"raw": GREY, "static": ORANGE, "filtered": BLUE}
READING_COLOURS = (BLUE, RED, GREEN, ORANGE, PURPLE, SKY)
COLUMNS = 2
LEAST = 1e-6


@dataclass(frozen=True)
class CrosstalkCurves:
    """Largest reading (K,) of any other load while one oscillates, by stage, in per cent, with U (K,)."""

    load: str
    frequency_hz: FloatArray
    stages: tuple[str, ...]
    labels: tuple[str, ...]
    value: tuple[FloatArray, ...]
    expanded: tuple[FloatArray, ...]


@dataclass(frozen=True)
class StepCurves:
    """Readings (N, D) of all loads by stage while one makes a step, in rated loads, at times (N,)."""

    load: str
    readings: tuple[str, ...]
    time_s: FloatArray
    labels: tuple[str, ...]
    value: tuple[FloatArray, ...]


def draw_crosstalk(curves: Sequence[CrosstalkCurves], modes_hz: FloatArray, target_hz: float) -> Picture:
    """Draw the largest cross-talk of every load over frequency before and after."""
    name = "decouple-crosstalk"
    rows = -(-len(curves) // COLUMNS)
    with drawing(name):
        figure = new_figure(1.9 * rows + 0.6)
        panels = figure.subplots(rows, COLUMNS, sharex=True, sharey=True, squeeze=False).ravel()
        for axes, item in zip(panels, curves, strict=False):
            _draw_curves(axes, item, modes_hz, target_hz)
        for axes in panels[len(curves) :]:
            axes.set_visible(False)
        for axes in panels[max(0, len(curves) - COLUMNS) : len(curves)]:
            axes.set_xlabel("frequency / Hz")
            axes.tick_params(labelbottom=True)
        for axes in panels[: len(curves) : COLUMNS]:
            axes.set_ylabel("cross-talk / %")
        panels[0].legend(loc="lower right", ncols=3, bbox_to_anchor=(2.1, 1.08), borderaxespad=0.0)
        lay_out(figure, panels[: len(curves)], top=0.42, gap=(0.25, 0.3), left=0.7)
        caption = (
            "Largest reading of any other load while one oscillates, in rated loads. Shaded: U (k = 2) by the "
            "uncertainty of the model. Dotted: modes; dashed: frequency of the wanted dynamics."
        )
        return finish(figure, name, "Cross-talk over frequency", caption)


def draw_step(step: StepCurves) -> Picture:
    """Draw the readings of the other loads while one makes a step, one panel per stage."""
    name = f"decouple-step-{step.load}"
    with drawing(name):
        figure = new_figure(1.5 * len(step.labels) + 0.6)
        panels = figure.subplots(len(step.labels), 1, sharex=True, squeeze=False).ravel()
        for axes, label, value in zip(panels, step.labels, step.value, strict=True):
            for d, reading in enumerate(step.readings):
                if reading != step.load:
                    axes.plot(
                        1e3 * step.time_s, 100 * value[:, d], color=READING_COLOURS[d % 6], label=reading, linewidth=0.8
                    )
            axes.set_ylabel("reading / %")
            panel_label(axes, f"step of {step.load}: {label}")
        panels[-1].set_xlabel("time after the step / ms")
        panels[0].legend(loc="lower right", ncols=6, bbox_to_anchor=(1.0, 1.02), borderaxespad=0.0)
        lay_out(figure, panels, top=0.3, gap=(0.5, 0.3), left=0.78)
        caption = (
            "Readings of all other loads by the model, in per cent of their rated loads for a step of the rated one."
        )
        return finish(figure, name, f"Other loads while {step.load} makes a step", caption)


def _draw_curves(axes: Axes, item: CrosstalkCurves, modes_hz: FloatArray, target_hz: float) -> None:
    """One load."""
    axes.set_xscale("log")
    axes.set_yscale("log")
    for stage, label, value, expanded in zip(item.stages, item.labels, item.value, item.expanded, strict=True):
        colour = STAGE_COLOURS[stage]
        shown = np.maximum(value, LEAST)
        axes.plot(item.frequency_hz, shown, color=colour, label=label)
        low, high = np.maximum(value - expanded, LEAST), np.maximum(value + expanded, LEAST)
        axes.fill_between(item.frequency_hz, low, high, color=colour, alpha=0.2, linewidth=0)
    for frequency in modes_hz:
        axes.axvline(frequency, color=GREY, linewidth=0.6, linestyle=":")
    axes.axvline(target_hz, color=GREY, linewidth=0.8, linestyle=(0, (5, 3)))
    axes.set_xlim(item.frequency_hz[0], item.frequency_hz[-1])
    axes.set_ylim(1e-3, 1e3)
    decades(axes.yaxis)
    panel_label(axes, f"{item.load} oscillates")
