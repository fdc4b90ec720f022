"""Figures of step responses and their models."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from matplotlib.axes import Axes
from matplotlib.ticker import FuncFormatter, LogLocator, MaxNLocator, NullLocator

from fusion.estimation.uncertainty import typeset
from fusion.report.style import (
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
    Picture,
    decades,
    drawing,
    finish,
    lay_out,
    new_figure,
    panel_label,
    power_text,
)
from shaker.arrays import ComplexArray, FloatArray

# Figures of a step response: record, fit and residual; releases by different ropes.


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


# Figures of models from step responses: response over frequency with bands, and how methods came to theirs.


STEP_MODELS_COLOURS = (BLUE, RED, GREEN, ORANGE, PURPLE)


@dataclass(frozen=True)
class BodeCurve:
    """A model over frequency: H over its static gain (K,) at `frequency_hz` (K,) with relative u of |H| (K,).

    `measured_hz` (L,), `measured` (L,), `noise` (L,): what the releases show by themselves, over the same gain, and the
    size of what noise adds; `model_there` (L,): the model at these. `bands_hz`: up to where |H| stays within 5 and 10 %
    of the static gain, NaN where there is no such band.
    """

    channel: str
    component: str
    frequency_hz: FloatArray
    value: ComplexArray
    u: FloatArray
    measured_hz: FloatArray
    measured: ComplexArray
    noise: FloatArray
    model_there: ComplexArray
    bands_hz: tuple[float, ...]


@dataclass(frozen=True)
class Convergence:
    """Loss (N,) of a method over its order or generation 1 … N; `over`: which of them; `chosen`: the place taken."""

    label: str
    over: str
    loss: FloatArray
    chosen: int | None


def draw_bode(name: str, curve: BodeCurve) -> Picture:
    """Magnitude with bands, phase, and what the releases depart from the model by."""
    with drawing(name):
        figure = new_figure(6.0)
        panels = figure.subplots(3, 1, sharex=True, gridspec_kw={"height_ratios": [2.0, 1.3, 1.1]})
        _draw_magnitude(panels[0], curve)
        _draw_phase(panels[1], curve)
        _draw_departure(panels[2], curve)
        for axes in panels:
            axes.set_rasterization_zorder(2.2 if len(curve.measured_hz) > 400 else -1)
        panels[-1].set_xscale("log")
        panels[-1].set_xlim(float(curve.frequency_hz[0]), float(curve.frequency_hz[-1]))
        panels[-1].xaxis.set_major_locator(LogLocator(10.0, subs=(1.0, 2.0, 5.0)))
        panels[-1].xaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
        panels[-1].xaxis.set_minor_locator(NullLocator())
        panels[-1].set_xlabel("frequency / Hz")
        lay_out(figure, panels, top=0.24, gap=(0.5, 0.28), left=0.78, label=0.58)
        caption = (
            "Model (red, with U) over its static gain, and what the releases show without a model (blue): the spectrum "
            "of the output's derivative over that of the load's. Green and orange: where |H| is within 5 and 10 % of "
            "the static gain. Below: their difference over the static gain, and what noise alone makes of it (grey)."
        )
        title = f"Output {curve.channel} over load {curve.component}"
        return finish(figure, name, title, caption)


def draw_convergence(name: str, curves: Sequence[Convergence]) -> Picture:
    """Loss over the order or the generations of every method that has such a curve."""
    with drawing(name):
        figure = new_figure(2.7)
        panels = figure.subplots(1, len(curves), squeeze=False)[0]
        for place, (axes, curve) in enumerate(zip(panels, curves, strict=True)):
            _draw_loss(axes, curve, STEP_MODELS_COLOURS[place % len(STEP_MODELS_COLOURS)])
        panels[0].set_ylabel("loss over the smallest")
        lay_out(figure, panels, top=0.24, gap=(0.62, 0.3), left=0.72, label=0.54)
        caption = (
            "Loss as each method defines it. SIM: of the equation error over the order, where it stops to fall the "
            "order is enough for that error, which is not yet the mode's. Differential evolution: of the best member."
        )
        return finish(figure, name, "How the methods came to their models", caption)


def _draw_magnitude(axes: Axes, curve: BodeCurve) -> None:
    """|H| over the static gain."""
    size = np.abs(curve.value)
    for end, colour, label in zip(curve.bands_hz, (GREEN, ORANGE), ("±5 %", "±10 %"), strict=True):
        if np.isfinite(end):
            axes.axvline(end, color=colour, linewidth=1.0, zorder=1.5, label=f"{label} up to {end:.4g} Hz")
    axes.plot(curve.measured_hz, np.abs(curve.measured), ".", color=BLUE, markersize=2.0, zorder=2, label="releases")
    low, high_edge = size * np.maximum(1.0 - 2.0 * curve.u, 1e-3), size * (1.0 + 2.0 * curve.u)
    axes.fill_between(curve.frequency_hz, low, high_edge, color=RED, alpha=0.3, linewidth=0, zorder=2.3)
    axes.plot(curve.frequency_hz, size, color=RED, linewidth=1.0, zorder=2.5, label="model")
    axes.axhline(1.0, color=LIGHT, linewidth=0.8, zorder=1)
    axes.set_yscale("log")
    axes.set_ylim(0.4 * min(1.0, float(size.min())), 2.0 * float(size.max()))
    decades(axes.yaxis)
    axes.set_ylabel("|H / H(0)|")
    axes.legend(loc="upper left", ncols=2)
    panel_label(axes, f"output {curve.channel} over load {curve.component}: magnitude")


def _draw_phase(axes: Axes, curve: BodeCurve) -> None:
    """Phase in degrees, not wrapped for the model, near it for the releases."""
    model = np.degrees(np.unwrap(np.angle(curve.value)))
    there = np.interp(curve.measured_hz, curve.frequency_hz, model)
    off = np.degrees(np.angle(curve.measured * np.exp(-1j * np.radians(there))))
    axes.plot(curve.measured_hz, there + off, ".", color=BLUE, markersize=2.0, zorder=2)
    axes.plot(curve.frequency_hz, model, color=RED, linewidth=1.0, zorder=2.5)
    low, high = float(model.min()) - 60.0, max(float(model.max()), 0.0) + 60.0
    axes.set_ylim(low, high)
    axes.yaxis.set_major_locator(MaxNLocator(5, steps=[1, 3, 4.5, 9, 10]))
    axes.set_ylabel("phase / °")
    panel_label(axes, "phase")


def _draw_departure(axes: Axes, curve: BodeCurve) -> None:
    """|releases - model| over the static gain, and the noise of the releases."""
    away = np.abs(curve.measured - curve.model_there)
    axes.plot(curve.measured_hz, 100.0 * away, ".", color=BLACK, markersize=2.0, zorder=2)
    order = np.argsort(curve.measured_hz)
    axes.plot(curve.measured_hz[order], 100.0 * curve.noise[order], color=GREY, linewidth=0.8, zorder=2.5)
    axes.set_yscale("log")
    decades(axes.yaxis)
    axes.set_ylabel("difference / %")
    panel_label(axes, "releases less model, over the static gain")


def _draw_loss(axes: Axes, curve: Convergence, colour: str) -> None:
    """One curve of losses."""
    number = np.arange(1, len(curve.loss) + 1)
    marker = "o" if len(curve.loss) <= 20 else ""
    loss = curve.loss / float(curve.loss.min()) if curve.loss.min() > 0.0 else curve.loss
    axes.plot(number, loss, color=colour, linewidth=0.9, marker=marker, markersize=3.5, zorder=2)
    if curve.chosen is not None:
        axes.plot(number[curve.chosen], loss[curve.chosen], "o", color=BLACK, markersize=6.5, fillstyle="none")
    if loss.max() > 20.0 * loss.min() > 0.0:
        axes.set_yscale("log")
        decades(axes.yaxis)
    axes.set_xlabel(curve.over)
    axes.xaxis.set_major_locator(MaxNLocator(6, integer=True))
    panel_label(axes, curve.label)
