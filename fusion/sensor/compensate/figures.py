"""Figures of a compensation: gain, phase and step before and after, noise, mismatch, and a filtered recording."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from matplotlib.axes import Axes
from matplotlib.ticker import FuncFormatter, LogLocator, MultipleLocator, NullFormatter

from fusion.estimation.uncertainty import prefix, typeset
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
    drawing,
    finish,
    lay_out,
    new_figure,
    panel_label,
)
from shaker.arrays import ComplexArray, FloatArray

COLOURS = (BLUE, GREEN, ORANGE, PURPLE, SKY)
DASHED = (0, (4, 2))
MILLI, PERCENT = 1e3, 1e2


@dataclass(frozen=True)
class BodeCurves:
    """Sensor and compensated sensor over their static gains (K,), sampled filter behind the sensor; bands in Hz.

    `u_gain` (K,) relative, None where it is not known; `error`: the permitted one.
    """

    title: str
    frequency_hz: FloatArray
    before: ComplexArray
    after: ComplexArray
    sampled: ComplexArray
    u_gain: FloatArray | None
    error: float
    bands_hz: tuple[float | None, float | None]


@dataclass(frozen=True)
class StepCurves:
    """Step responses over their final values (N,) at `time_s` (N,)."""

    title: str
    time_s: FloatArray
    before: FloatArray
    after: FloatArray


@dataclass(frozen=True)
class NoiseCurve:
    """|G_c| over its static gain (K,) of one filter, and the noise gain of white noise."""

    name: str
    frequency_hz: FloatArray
    gain: FloatArray
    white: float


@dataclass(frozen=True)
class MismatchCurve:
    """Residual ringing (K,) over what is off (K,): a load in g or a frequency in %, for one filter."""

    name: str
    off: FloatArray
    ringing: FloatArray


@dataclass(frozen=True)
class FilteredChannel:
    """A channel before and after, less its first value, with u (N,), at `time_s`."""

    channel: str
    unit: str
    time_s: FloatArray
    raw: FloatArray
    value: FloatArray
    u: FloatArray


@dataclass(frozen=True)
class PushedBall:
    """Forces (N,) in N at `time_s` while a hand pushes a virtual ball; NaN from where the loop ran away."""

    name: str
    time_s: FloatArray
    applied: FloatArray
    fed_back: FloatArray


def draw_bode(name: str, curves: BodeCurves) -> Picture:
    """Gain and phase before and after, the band of the permitted error, and the sampled filter."""
    with drawing(name):
        figure = new_figure(4.4)
        upper, lower = figure.subplots(2, 1, sharex=True, gridspec_kw={"height_ratios": [1.8, 1.0]})
        for values, colour, text in ((curves.before, GREY, "sensor"), (curves.after, BLUE, "compensated")):
            upper.loglog(curves.frequency_hz, np.abs(values), color=colour, label=text, zorder=2)
            lower.semilogx(curves.frequency_hz, _degrees(values), color=colour, zorder=2)
        upper.loglog(
            curves.frequency_hz, np.abs(curves.sampled), color=RED, linestyle=DASHED, label="for samples", zorder=3
        )
        lower.semilogx(curves.frequency_hz, _degrees(curves.sampled), color=RED, linestyle=DASHED, zorder=3)
        if curves.u_gain is not None:
            half = 2.0 * curves.u_gain
            low, high = np.abs(curves.after) * np.exp(-half), np.abs(curves.after) * np.exp(half)
            upper.fill_between(curves.frequency_hz, low, high, color=BLUE, alpha=0.25, linewidth=0, label="U (k = 2)")
        upper.axhspan(1.0 - curves.error, 1.0 + curves.error, color=LIGHT, zorder=0)
        for edge, colour in zip(curves.bands_hz, (GREY, BLUE), strict=True):
            if edge is not None and np.isfinite(edge):
                upper.axvline(edge, color=colour, linewidth=0.7, linestyle=DASHED, zorder=1)
        _log_ticks(upper)
        upper.set_ylim(*_limits(curves))
        upper.set_ylabel("gain / static gain")
        lower.set_ylabel("phase / °")
        lower.set_xlabel("frequency / Hz")
        lowest = min(float(np.min(_degrees(values))) for values in (curves.before, curves.after))
        lower.set_ylim(lowest - 30.0, 30.0)
        lower.yaxis.set_major_locator(MultipleLocator(90.0))
        upper.legend(loc="lower left")
        panel_label(upper, curves.title)
        lay_out(figure, (upper, lower), top=0.24, gap=(0.5, 0.18), left=0.78, label=0.58)
        caption = (
            f"Grey: ±{PERCENT * curves.error:g} % of the static gain; dashed uprights: where sensor and compensated "
            "sensor leave ±10 %. Red: the filter for samples behind the sensor."
        )
        return finish(figure, name, f"{curves.title}: gain and phase before and after", caption)


def draw_steps(name: str, curves: StepCurves) -> Picture:
    """The response to a step before and after."""
    with drawing(name):
        figure = new_figure(2.9)
        axes = figure.subplots(1, 1)
        axes.axhspan(0.98, 1.02, color=LIGHT, zorder=0)
        axes.plot(MILLI * curves.time_s, curves.before, color=GREY, linewidth=0.9, label="sensor")
        axes.plot(MILLI * curves.time_s, curves.after, color=BLUE, label="compensated")
        axes.set_xlabel("time after the step / ms")
        axes.set_ylabel("output / final value")
        axes.set_xlim(0.0, MILLI * float(curves.time_s[-1]))
        axes.legend(loc="upper right")
        panel_label(axes, curves.title)
        lay_out(figure, (axes,), top=0.24, left=0.78, label=0.58)
        return finish(figure, name, f"{curves.title}: a step before and after", "Grey: ±2 % of the final value.")


def draw_noise(name: str, curves: Sequence[NoiseCurve]) -> Picture:
    """What every filter makes of noise over frequency."""
    with drawing(name):
        figure = new_figure(2.8)
        axes = figure.subplots(1, 1)
        for place, curve in enumerate(curves):
            text = f"{curve.name} (white noise × {curve.white:.3g})"
            axes.loglog(curve.frequency_hz, curve.gain, color=COLOURS[place % len(COLOURS)], label=text)
        _log_ticks(axes)
        axes.set_xlabel("frequency / Hz")
        axes.set_ylabel("gain of the filter")
        axes.legend(loc="upper left")
        panel_label(axes, "noise")
        lay_out(figure, (axes,), top=0.24, left=0.78, label=0.58)
        caption = "Gain of the filters over their static gain: the density of the noise is raised by this factor."
        return finish(figure, name, "What the filters do to noise", caption)


def draw_mismatch(name: str, curves: Sequence[MismatchCurve], axis: str, own: str) -> Picture:
    """Residual ringing of every filter over what is off."""
    with drawing(name):
        figure = new_figure(2.8)
        axes = figure.subplots(1, 1)
        for place, curve in enumerate(curves):
            colour = COLOURS[place % len(COLOURS)]
            axes.plot(curve.off, PERCENT * curve.ringing, "o-", color=colour, markersize=3.5, label=curve.name)
        axes.set_xlabel(axis)
        axes.set_ylabel("ringing / % of the step")
        axes.set_ylim(bottom=0.0)
        axes.legend(loc="best")
        panel_label(axes, "another sensor than the filter is for")
        lay_out(figure, (axes,), top=0.24, left=0.78, label=0.58)
        return finish(figure, name, "Residual ringing", own)


def draw_haptics(name: str, runs: Sequence[PushedBall], gain: float) -> Picture:
    """Applied and fed-back force of two ways to treat the signal at the same force gain."""
    with drawing(name):
        figure = new_figure(2.8)
        panels = figure.subplots(1, len(runs), sharey=True)
        top = 1.4 * float(np.nanmax(runs[-1].fed_back))
        for axes, run in zip(panels, runs, strict=True):
            axes.plot(run.time_s, run.applied, color=GREY, linewidth=1.4, label="applied by the hand")
            axes.plot(
                run.time_s, run.fed_back, color=BLUE, linewidth=0.9, linestyle=DASHED, label="fed back by the ball"
            )
            axes.set_xlabel("time / s")
            axes.set_ylim(-0.3 * top, top)
            panel_label(axes, f"{run.name}, K = {gain:.3g}")
        panels[0].set_ylabel("force / N")
        panels[-1].legend(loc="upper right")
        lay_out(figure, panels, top=0.24, gap=(0.4, 0.2), left=0.78, label=0.58)
        caption = "Curves end where the loop has run away."
        return finish(figure, name, "Applied and fed-back force", caption)


def draw_channel(name: str, channel: FilteredChannel) -> Picture:
    """A channel of the recording before and after, and its uncertainty."""
    with drawing(name):
        figure = new_figure(3.8)
        upper, lower = figure.subplots(2, 1, sharex=True, gridspec_kw={"height_ratios": [2.0, 1.0]})
        scale, letter = prefix(channel.value)
        small, small_letter = prefix(channel.u)
        upper.plot(channel.time_s, channel.raw / scale, color=GREY, linewidth=0.7, label="output", zorder=2)
        upper.plot(channel.time_s, channel.value / scale, color=BLUE, linewidth=0.8, label="compensated", zorder=3)
        lower.plot(channel.time_s, 2.0 * channel.u / small, color=BLACK, linewidth=0.7)
        lower.set_ylim(0.0, 2.2 * float(np.max(channel.u)) / small or 1.0)
        upper.set_ylabel(f"change / {_unit(letter, channel.unit)}")
        lower.set_ylabel(f"U / {_unit(small_letter, channel.unit)}")
        lower.set_xlabel("time / s")
        upper.legend(loc="upper right")
        panel_label(upper, channel.channel)
        for axes in (upper, lower):
            axes.set_rasterization_zorder(4)
        lay_out(figure, (upper, lower), top=0.24, gap=(0.5, 0.18), left=0.78, label=0.58)
        caption = "Both less their first value, the output times the static gain of the filter. "
        caption += "Below: U (k = 2) of every sample, from model and noise."
        return finish(figure, name, f"{channel.channel}: recording before and after", caption)


def _unit(letter: str, unit: str) -> str:
    """A unit with its prefix, in parentheses where it is made of several."""
    nice = typeset(unit)
    return f"({letter}{nice})" if letter == "" and ("/" in nice or "·" in nice) else f"{letter}{nice}"


def _degrees(values: ComplexArray) -> FloatArray:
    """Unwrapped phase in degrees."""
    return np.asarray(np.degrees(np.unwrap(np.angle(values))))


def _limits(curves: BodeCurves) -> tuple[float, float]:
    """Limits of the gain that hold both peaks and one decade and a half below 1."""
    top = float(np.max(np.abs(np.concatenate([curves.before, curves.after]))))
    return 0.03, max(3.0, 1.5 * top)


def _log_ticks(axes: Axes) -> None:
    """Plain numbers on a logarithmic gain."""
    axes.yaxis.set_major_locator(LogLocator(10.0, numticks=8))
    axes.yaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
    axes.yaxis.set_minor_formatter(NullFormatter())
