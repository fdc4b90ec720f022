"""Figures of a compensation: gain, phase and step before and after, noise, mismatch, and a filtered recording."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
from matplotlib.ticker import MultipleLocator

from fusion.base import MILLI, PERCENT, prefix
from fusion.report.style import (
    BLACK,
    BLUE,
    COLOURS,
    GREY,
    LIGHT,
    RED,
    Picture,
    draw_response,
    panel_label,
    plain_logarithm,
    sheet,
)
from fusion.sensor.compensate.evaluate import CompensateEvaluation
from fusion.sensor.compensate.source import CompensatedChannel, CompensatedRecording, LoadFilter, SubjectResult
from shaker.arrays import FloatArray
from shaker.compensation.effects import gain_band
from shaker.labels import typeset

DASHED = (0, (4, 2))
POINTS = 900
STEP_POINTS, STEP_PERIODS = 3000, 20.0
DRAWN = 20_000
"""Samples of a recording that are drawn at the most."""


def frequencies(made: LoadFilter) -> FloatArray:
    """Frequencies (K,) in Hz of the curves of a filter: two decades below its modes to half the sampling rate."""
    known = [*made.compensation.sensor.frequency_hz, *made.compensation.sensor.real_hz]
    low, high = min(known) / 50.0, 0.5 * made.sections.sample_rate_hz
    even = np.geomspace(low, min(high, 40.0 * made.compensation.target.frequency_hz), POINTS)
    return np.unique(np.concatenate([even, *(f * (1.0 + np.linspace(-0.05, 0.05, 101)) for f in known)]))


def expanded_gain(made: LoadFilter, hertz: FloatArray) -> FloatArray:
    """Relative U (K,) for 95 % of the compensated gain at frequencies (K,), by the covariance of the model."""
    design, sensor = made.compensation, made.compensation.sensor
    u = gain_band(design, hertz).u_gain
    part = np.zeros_like(u)
    if sensor.scatter is not None:
        part = gain_band(replace(design, sensor=replace(sensor, covariance=sensor.scatter)), hertz).u_gain
    return np.asarray(made.subject.factors(u, part)[1] * u)


def draw_bode(name: str, made: LoadFilter, permitted_error: float) -> Picture:
    """Gain and phase over the static gain before and after, the band of the permitted error, and the sampled filter."""
    design, hertz, title = made.compensation, frequencies(made), made.name
    sensor = design.sensor.system.response(hertz) / design.sensor.static_gain
    after = sensor * design.system.response(hertz) / design.gain
    sampled = sensor * made.sections.response(hertz) / made.sections.gain
    with sheet(name, 4.4, 2, heights=(1.8, 1.0)) as drawn:
        upper, lower = drawn.panels
        look: dict[str, Any] = {"unwrapped": True, "linewidth": 1.1}
        draw_response(upper, lower, hertz, sensor, color=GREY, label="sensor", **look)
        draw_response(upper, lower, hertz, after, color=BLUE, label="compensated", **look)
        draw_response(upper, lower, hertz, sampled, color=RED, linestyle=DASHED, label="for samples", zorder=3, **look)
        if design.sensor.covariance is not None:
            half = expanded_gain(made, hertz)
            low, high = np.abs(after) * np.exp(-half), np.abs(after) * np.exp(half)
            upper.fill_between(hertz, low, high, color=BLUE, alpha=0.25, linewidth=0, label="U (95 %)")
        upper.axhspan(1.0 - permitted_error, 1.0 + permitted_error, color=LIGHT, zorder=0)
        for indices, colour in ((made.before.indices, GREY), (made.after.indices, BLUE)):
            if indices.band_10_hz is not None and np.isfinite(indices.band_10_hz):
                upper.axvline(indices.band_10_hz, color=colour, linewidth=0.7, linestyle=DASHED, zorder=1)
        upper.set_xscale("log")
        plain_logarithm(upper.yaxis, (1.0,))
        highest = max(3.0, 1.5 * float(np.max(np.abs([sensor, after]))))
        lowest = float(np.degrees(np.min(np.unwrap(np.angle([sensor, after]))))) - 30.0
        upper.set(ylabel="gain / static gain", ylim=(0.03, highest))
        lower.set(xlabel="frequency / Hz", ylim=(lowest, 30.0))
        lower.yaxis.set_major_locator(MultipleLocator(90.0))
        upper.legend(loc="lower left")
        panel_label(upper, title)
        caption = (
            f"Grey: ±{PERCENT * permitted_error:g} % of the static gain; dashed uprights: where sensor and compensated "
            "sensor leave ±10 %. Red: the filter for samples behind the sensor."
        )
        return drawn.picture(f"{title}: gain and phase before and after", caption, gap=(0.5, 0.18))


def draw_step(name: str, made: LoadFilter) -> Picture:
    """The response to a step over its final value before and after."""
    design, title = made.compensation, made.name
    time = np.linspace(0.0, STEP_PERIODS / design.target.frequency_hz, STEP_POINTS)
    before = design.sensor.system.step(time) / design.sensor.static_gain
    after = design.compensated.step(time) / design.compensated.static_gain
    with sheet(name, 2.9) as drawn:
        (axes,) = drawn.panels
        axes.axhspan(0.98, 1.02, color=LIGHT, zorder=0)
        axes.plot(MILLI * time, before, color=GREY, linewidth=0.9, label="sensor")
        axes.plot(MILLI * time, after, color=BLUE, label="compensated")
        limits = (0.0, MILLI * float(time[-1]))
        axes.set(xlabel="time after the step / ms", ylabel="output / final value", xlim=limits)
        axes.legend(loc="upper right")
        panel_label(axes, title)
        return drawn.picture(f"{title}: a step before and after", "Grey: ±2 % of the final value.")


def draw_noise(evaluation: CompensateEvaluation) -> Picture:
    """What every filter makes of noise over frequency."""
    with sheet("noise", 2.8) as drawn:
        (axes,) = drawn.panels
        for place, made in enumerate(evaluation.filters):
            hertz = frequencies(made)
            gain = np.abs(made.sections.response(hertz) / made.sections.gain)
            text = f"{made.name} (white noise × {made.noise_factor:.3g})"
            axes.loglog(hertz, gain, color=COLOURS[place % len(COLOURS)], label=text)
        plain_logarithm(axes.yaxis, (1.0,))
        axes.set(xlabel="frequency / Hz", ylabel="gain of the filter")
        panel_label(axes, "noise")
        axes.legend(loc="upper left")
        caption = "Gain of the filters over their static gain: the density of the noise is raised by this factor."
        return drawn.picture("What the filters do to noise", caption)


def draw_mismatch(name: str, result: SubjectResult) -> Picture | None:
    """Residual ringing of every filter over the load, or over an error of the frequency; None without either."""
    first, subject = result.filters[0], result.subject
    if len(first.off_load) > 1:
        scale, unit = (MILLI, "g") if subject.load_unit == "N" else (1.0, "(kg·m²)")
        axis, loads = f"load / {unit}", [subject.load_text(one.load_mass or 0.0) for one in result.filters]
        curves = [
            (f"filter for {load}", scale * one.off_load, one.load_ringing)
            for load, one in zip(loads, result.filters, strict=True)
        ]
    elif len(first.off_frequency):
        axis = "frequency of the sensor off by / %"
        curves = [(one.name, PERCENT * one.off_frequency, one.off_ringing) for one in result.filters]
    else:
        return None
    with sheet(name, 2.8) as drawn:
        (axes,) = drawn.panels
        for place, (text, off, ringing) in enumerate(curves):
            colour = COLOURS[place % len(COLOURS)]
            axes.plot(off, PERCENT * ringing, "o-", color=colour, markersize=3.5, label=text)
        axes.set(xlabel=axis, ylabel="ringing / % of the step", ylim=(0.0, None))
        panel_label(axes, "another sensor than the filter is for")
        axes.legend(loc="best")
        after = f"Largest deviation from the final value from {MILLI * first.after_s:.3g} ms after a step on."
        return drawn.picture("Residual ringing", after)


def draw_force_feedback(evaluation: CompensateEvaluation) -> Picture | None:
    """Applied and fed-back force with the filter for no load and with the own one, at the same force gain."""
    check = evaluation.haptics
    if check is None:
        return None
    cases = check.cases[1:3]
    with sheet("haptics", 2.8, 1, len(cases), sharey=True) as drawn:
        top = 1.4 * float(np.nanmax(cases[-1].run.fed_back))
        for axes, case in zip(drawn.panels, cases, strict=True):
            time, fed_back = case.run.time_s, case.run.fed_back
            axes.plot(time, case.run.applied, color=GREY, linewidth=1.4, label="applied by the hand")
            axes.plot(time, fed_back, color=BLUE, linewidth=0.9, linestyle=DASHED, label="fed back by the ball")
            axes.set(xlabel="time / s", ylim=(-0.3 * top, top))
            panel_label(axes, f"{case.name}, K = {check.gain:.3g}")
        drawn.panels[0].set_ylabel("force / N")
        drawn.panels[-1].legend(loc="upper right")
        caption = "Curves end where the loop has run away."
        return drawn.picture("Applied and fed-back force", caption, gap=(0.4, 0.2))


def draw_channel(recording: CompensatedRecording, channel: CompensatedChannel) -> Picture:
    """A channel of the recording before and after, less its first value, and its uncertainty."""
    keep = slice(None, None, max(1, -(-len(channel.value) // DRAWN)))
    time, u = recording.time_s[keep], channel.expanded[keep]
    raw, value = (channel.raw - channel.raw[0])[keep], (channel.value - channel.value[0])[keep]
    with sheet(f"recording-{channel.channel}", 3.8, 2, heights=(2.0, 1.0)) as drawn:
        upper, lower = drawn.panels
        (scale, letter), (small, small_letter) = prefix(value), prefix(u)
        upper.plot(time, raw / scale, color=GREY, linewidth=0.7, label="output", zorder=2)
        upper.plot(time, value / scale, color=BLUE, linewidth=0.8, label="compensated", zorder=3)
        lower.plot(time, u / small, color=BLACK, linewidth=0.7)
        upper.set_ylabel(f"change / {_unit(letter, channel.unit)}")
        highest = 1.1 * float(np.max(u)) / small or 1.0
        lower.set(xlabel="time / s", ylabel=f"U / {_unit(small_letter, channel.unit)}", ylim=(0.0, highest))
        upper.legend(loc="upper right")
        panel_label(upper, channel.channel)
        for axes in drawn.panels:
            axes.set_rasterization_zorder(4)
        caption = "Both less their first value, the output times the static gain of the filter. "
        caption += "Below: U (95 %) of every sample, from model and noise."
        return drawn.picture(f"{channel.channel}: recording before and after", caption, gap=(0.5, 0.18))


def _unit(letter: str, unit: str) -> str:
    """A unit with its prefix, in parentheses where it is made of several."""
    nice = typeset(unit)
    return f"({letter}{nice})" if letter == "" and ("/" in nice or "·" in nice) else f"{letter}{nice}"
