"""Figures of a step response: record, fit and residual; releases by different ropes."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from matplotlib.axes import Axes
from matplotlib.ticker import MaxNLocator

from fusion.plots.style import (
    BLACK,
    BLUE,
    GREEN,
    GREY,
    LIGHT,
    ORANGE,
    PURPLE,
    RASTER_ABOVE,
    RED,
    SKY,
    FloatArray,
    Picture,
    drawing,
    finish,
    lay_out,
    new_figure,
    panel_label,
    power_text,
)
from fusion.polar import typeset

COLOURS = (BLUE, RED, GREEN, ORANGE, PURPLE, SKY)
DASHES = (0, (4, 2))
MILLI, PERCENT = 1e3, 100.0
BEFORE, AFTER = 0.6, 8.0
"""Periods of the lowest mode that the zoomed panel shows before the onset and after the release."""


@dataclass(frozen=True)
class StepCurve:
    """One output of one release: `measured` (N,) and `fitted` (N,) in `unit` at `time_s` (N,).

    `baseline`, `steady`: its levels; `onset_s`, `release_s`: when the load begins to change, and for how long;
    `period_s`: of the lowest mode.
    """

    recording: str
    channel: str
    unit: str
    time_s: FloatArray
    measured: FloatArray
    fitted: FloatArray
    baseline: float
    steady: float
    onset_s: float
    release_s: float
    period_s: float


@dataclass(frozen=True)
class RopeCurve:
    """Driven output of one release by one thing: share of its change (N,) over the time since the onset (N,) in s."""

    rope: str
    recording: str
    time_s: FloatArray
    share: FloatArray
    release_s: float


def draw_step(name: str, curve: StepCurve) -> Picture:
    """The whole record left, the release right; below what the fit leaves, over the change of the output."""
    with drawing(name):
        figure = new_figure(4.8)
        panels = figure.subplots(2, 2, sharex="col", gridspec_kw={"height_ratios": [2.0, 1.0]})
        near = _near(curve)
        for column, shown in enumerate((np.ones(len(near), dtype=np.bool_), near)):
            _draw_output(panels[0, column], curve, shown)
            _draw_rest(panels[1, column], curve, shown)
            zoom = ", around the release" if column else ""
            panel_label(panels[0, column], f"{curve.recording}: output {curve.channel}{zoom}")
            panel_label(panels[1, column], f"record less fit{zoom}")
        unit = typeset(curve.unit)
        power, scale = _power(curve)
        unit = f"{power} {unit}" if scale != 1.0 else unit
        panels[0, 0].set_ylabel(f"output / ({unit})" if " " in unit or "/" in unit else f"output / {unit}")
        panels[1, 0].set_ylabel("residual / %")
        panels[0, 1].legend(loc="best")
        lay_out(figure, panels.ravel(), top=0.24, gap=(0.6, 0.3), left=0.82, label=0.62)
        caption = (
            "Record (blue) and fit (red, dashed); grey: while the load changes, by the fit. Below: the residual over "
            "the output's change; where the model is right it is noise alone."
        )
        return finish(figure, name, f"{curve.recording}: record, fit and residual", caption)


def draw_ropes(name: str, channel: str, curves: Sequence[RopeCurve]) -> Picture:
    """One release by each thing, over the time since its onset."""
    with drawing(name):
        figure = new_figure(3.0)
        axes = figure.subplots(1, 1)
        for place, curve in enumerate(curves):
            colour = COLOURS[place % len(COLOURS)]
            label = f"{curve.rope}, {MILLI * curve.release_s:.3g} ms"
            axes.plot(
                MILLI * curve.time_s, curve.share, color=colour, linewidth=0.9, label=label, zorder=3 - 0.1 * place
            )
        for level in (0.0, 1.0):
            axes.axhline(level, color=LIGHT, linewidth=0.8, zorder=1)
        axes.set_rasterization_zorder(4 if sum(len(c.share) for c in curves) > RASTER_ABOVE else -1)
        axes.set_xlabel("time since the onset / ms")
        axes.set_ylabel("share of the change")
        axes.margins(x=0.01)
        axes.legend(loc="lower right")
        panel_label(axes, f"output {channel}")
        lay_out(figure, (axes,), top=0.24, left=0.7, label=0.5)
        caption = (
            "One release by each, over the output's change, with how long the load changed. What lets go at once makes "
            "the sensor ring; what takes longer than a period of the mode hardly does."
        )
        return finish(figure, name, "What let go", caption)


def _near(curve: StepCurve) -> np.ndarray[tuple[int], np.dtype[np.bool_]]:
    """The samples around the release."""
    low = curve.onset_s - BEFORE * curve.period_s - 0.3 * curve.release_s
    high = curve.onset_s + curve.release_s + AFTER * curve.period_s
    inside = (curve.time_s >= low) & (curve.time_s <= high)
    return np.asarray(inside if np.count_nonzero(inside) > 8 else np.ones(len(inside), dtype=np.bool_))


def _power(curve: StepCurve) -> tuple[str, float]:
    """Power of ten in which the output is drawn, as text and as a number."""
    largest = float(np.abs(curve.measured).max())
    exponent = int(np.floor(np.log10(largest))) if largest > 0.0 and not 0.01 <= largest < 1e4 else 0
    return power_text(exponent), 10.0**exponent


def _draw_output(axes: Axes, curve: StepCurve, shown: np.ndarray[tuple[int], np.dtype[np.bool_]]) -> None:
    """Record and fit."""
    time = MILLI * curve.time_s[shown]
    axes.axvspan(MILLI * curve.onset_s, MILLI * (curve.onset_s + curve.release_s), color=GREY, alpha=0.2, linewidth=0)
    dense = len(time) > RASTER_ABOVE
    style = {"linewidth": 0.8} if dense else {"marker": ".", "markersize": 3.5, "linestyle": "none"}
    _, scale = _power(curve)
    axes.plot(time, curve.measured[shown] / scale, color=BLUE, label="record", zorder=2, **style)
    axes.plot(time, curve.fitted[shown] / scale, color=RED, linewidth=0.9, linestyle=DASHES, label="fit", zorder=2.5)
    axes.set_rasterization_zorder(3 if dense else -1)
    axes.yaxis.set_major_locator(MaxNLocator(6))
    axes.margins(x=0.01)


def _draw_rest(axes: Axes, curve: StepCurve, shown: np.ndarray[tuple[int], np.dtype[np.bool_]]) -> None:
    """What the fit leaves, in percent of the output's change."""
    time, rest = MILLI * curve.time_s[shown], (curve.measured - curve.fitted)[shown]
    change = abs(curve.steady - curve.baseline)
    axes.plot(time, PERCENT * rest / change, color=BLACK, linewidth=0.6, zorder=2)
    axes.axhline(0.0, color=LIGHT, linewidth=0.8, zorder=1)
    axes.set_rasterization_zorder(3 if len(time) > RASTER_ABOVE else -1)
    axes.yaxis.set_major_locator(MaxNLocator(4))
    axes.set_xlabel("time / ms")
