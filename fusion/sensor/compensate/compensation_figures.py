"""Figures of a compensation: responses before and after, noise, mismatch, and filtered recordings."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from fusion.base import MILLI, PERCENT, prefix
from fusion.report.figure import BLACK, BLUE, COLOURS, GREY, RED, Figure, draw_response, empty_figure
from fusion.sensor.compensate.compensation_evaluation import CompensateEvaluation
from fusion.sensor.compensate.compensation_subjects import (
    CompensatedChannel,
    CompensatedRecording,
    LoadFilter,
    SubjectResult,
)
from shaker.compensation.effects import gain_band
from shakercal._common.arrays import FloatArray
from shakercal._common.digits import number_text, typeset

POINTS = 900
STEP_POINTS, STEP_PERIODS = 3000, 20.0
DRAWN = 20_000
"""Largest number of drawn samples of a recording."""


def frequencies(made: LoadFilter) -> FloatArray:
    """Return the frequencies (K,) of a filter's curves, up to half the sampling rate."""
    frequencies_hz = [*made.compensation.sensor.frequency_hz, *made.compensation.sensor.real_hz]
    low, high = min(frequencies_hz) / 50.0, 0.5 * made.sections.sample_rate_hz
    even = np.geomspace(low, min(high, 40.0 * made.compensation.target.frequency_hz), POINTS)
    return np.unique(np.concatenate([even, *(f * (1.0 + np.linspace(-0.05, 0.05, 101)) for f in frequencies_hz)]))


def expanded_gain(made: LoadFilter, hertz: FloatArray) -> FloatArray:
    """Return the relative U (K,) of the compensated gain by the model's covariance."""
    design, sensor = made.compensation, made.compensation.sensor
    u = gain_band(design, hertz).u_gain
    part = np.zeros_like(u)
    if sensor.scatter is not None:
        part = gain_band(replace(design, sensor=replace(sensor, covariance=sensor.scatter)), hertz).u_gain
    return np.asarray(made.subject.factors(u, part)[1] * u)


def draw_bode(name: str, made: LoadFilter, permitted_error: float) -> Figure:
    """Draw gain and phase before and after, with the permitted error and the sampled filter."""
    design, hertz, title = made.compensation, frequencies(made), made.name
    sensor = design.sensor.system.response(hertz) / design.sensor.static_gain
    after = sensor * design.system.response(hertz) / design.gain
    sampled = sensor * made.sections.response(hertz) / made.sections.gain
    drawn = empty_figure(name, 4.6, (1.8, 1.0))
    upper, lower = drawn.panels
    upper.span(1.0 - permitted_error, 1.0 + permitted_error)
    draw_response(upper, lower, hertz, sensor, unwrapped=True, width=1.1, colour=GREY, label="sensor")
    draw_response(upper, lower, hertz, after, unwrapped=True, width=1.1, colour=BLUE, label="compensated")
    draw_response(upper, lower, hertz, sampled, unwrapped=True, colour=RED, dashed=True, label="for samples")
    if design.sensor.covariance is not None:
        half = expanded_gain(made, hertz)
        upper.band(hertz, np.abs(after) * np.exp(-half), np.abs(after) * np.exp(half), "U (95 %)", colour=BLUE)
    for indices, colour in ((made.before.indices, GREY), (made.after.indices, BLUE)):
        if indices.band_10_hz is not None and np.isfinite(indices.band_10_hz):
            upper.rule(indices.band_10_hz, along="x", colour=colour, width=0.7, dashed=True)
    lowest = float(np.degrees(np.min(np.unwrap(np.angle([sensor, after]))))) - 30.0
    upper.y.label, upper.y.limits = "gain / static gain", (0.03, max(3.0, 1.5 * float(np.max(np.abs([sensor, after])))))
    lower.y.limits, lower.y.ticks = (lowest, 30.0), tuple(range(-90 * int(-lowest // 90), 1, 90))
    for panel in drawn.panels:
        panel.x.log, panel.x.link = True, "frequency"
    lower.x.label, upper.title = "frequency / Hz", title
    caption = (
        f"Grey: ±{PERCENT * permitted_error:.6g} % of the static gain; dashed vertical lines: ±10 % limits of sensor "
        "and compensated sensor. Red: the filter for samples behind the sensor."
    )
    return drawn.with_title(f"{title}: gain and phase before and after", caption, main=True)


def draw_step(name: str, made: LoadFilter) -> Figure:
    """Draw the step response over its final value, before and after."""
    design, title = made.compensation, made.name
    time = np.linspace(0.0, STEP_PERIODS / design.target.frequency_hz, STEP_POINTS)
    before = design.sensor.system.step(time) / design.sensor.static_gain
    after = design.compensated.step(time) / design.compensated.static_gain
    drawn = empty_figure(name, 2.9)
    (panel,) = drawn.panels
    panel.span(0.98, 1.02)
    panel.line(MILLI * time, before, "sensor", colour=GREY, width=0.9)
    panel.line(MILLI * time, after, "compensated", colour=BLUE)
    panel.x.label, panel.y.label, panel.title = "time after the step / ms", "output / final value", title
    panel.x.limits = (0.0, MILLI * float(time[-1]))
    return drawn.with_title(f"{title}: a step before and after", "Grey: ±2 % of the final value.")


def draw_noise(evaluation: CompensateEvaluation) -> Figure:
    """Draw the gain of every filter for noise over frequency."""
    drawn = empty_figure("noise", 2.8)
    (panel,) = drawn.panels
    for index, made in enumerate(evaluation.filters):
        hertz = frequencies(made)
        gain = np.abs(made.sections.response(hertz) / made.sections.gain)
        text = f"{made.name} (white noise × {number_text(made.noise_factor)})"
        panel.line(hertz, gain, text, colour=COLOURS[index % len(COLOURS)])
    panel.x.log = panel.y.log = True
    panel.x.label, panel.y.label, panel.x.link = "frequency / Hz", "gain of the filter", "frequency"
    caption = "Gain of the filters over their static gain: the density of the noise is raised by this factor."
    return drawn.with_title("Noise of the filters", caption)


def draw_mismatch(name: str, result: SubjectResult) -> Figure | None:
    """Draw the residual ringing of every filter over load or frequency error; None without either."""
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
    drawn = empty_figure(name, 2.8)
    (panel,) = drawn.panels
    for index, (text, off, ringing) in enumerate(curves):
        colour = COLOURS[index % len(COLOURS)]
        panel.line(off, PERCENT * ringing, text, colour=colour)
        panel.points(off, PERCENT * ringing, text, colour=colour, size=3.5)
    highest = max(float(np.nanmax(PERCENT * ringing)) for _, _, ringing in curves)
    panel.x.label, panel.y.label, panel.y.limits = axis, "ringing / % of the step", (0.0, 1.1 * highest or 1.0)
    panel.title = "sensor that differs from the design"
    after = f"Largest deviation from the final value from {number_text(MILLI * first.after_s)} ms after a step on."
    return drawn.with_title("Residual ringing", after)


def draw_force_feedback(evaluation: CompensateEvaluation) -> Figure | None:
    """Draw applied and fed-back force with the filters for no load and for the load."""
    check = evaluation.haptics
    if check is None:
        return None
    cases = check.cases[1:3]
    drawn = empty_figure("haptics", 2.8, 1, len(cases), shared_y=True)
    top = 1.4 * float(np.nanmax(cases[-1].run.fed_back))
    for panel, case in zip(drawn.panels, cases, strict=True):
        panel.line(case.run.time_s, case.run.applied, "applied by the hand", colour=GREY, width=1.4)
        panel.line(case.run.time_s, case.run.fed_back, "fed back by the ball", colour=BLUE, width=0.9, dashed=True)
        panel.x.label, panel.y.limits = "time / s", (-0.3 * top, top)
        panel.title = f"{case.name}, K = {number_text(check.gain)}"
    drawn.panels[0].y.label = "force / N"
    return drawn.with_title("Applied and fed-back force", "Curves end where the loop diverges.")


def draw_channel(recording: CompensatedRecording, channel: CompensatedChannel) -> Figure:
    """Draw a channel of the recording before and after, and its uncertainty."""
    keep = slice(None, None, max(1, -(-len(channel.value) // DRAWN)))
    time, u = recording.time_s[keep], channel.expanded[keep]
    raw, value = (channel.raw - channel.raw[0])[keep], (channel.value - channel.value[0])[keep]
    drawn = empty_figure(f"recording-{channel.channel}", 3.8, (2.0, 1.0))
    upper, lower = drawn.panels
    (scale, letter), (small, small_letter) = prefix(value), prefix(u)
    upper.line(time, raw / scale, "output", colour=GREY, width=0.7)
    upper.line(time, value / scale, "compensated", colour=BLUE, width=0.8)
    lower.line(time, u / small, colour=BLACK, width=0.7)
    upper.y.label, upper.title = f"change / {_unit(letter, channel.unit)}", channel.channel
    lower.x.label, lower.y.label = "time / s", f"U / {_unit(small_letter, channel.unit)}"
    lower.y.limits = (0.0, 1.1 * float(np.max(u)) / small or 1.0)
    caption = "Both less their first value, the output times the static gain of the filter. "
    caption += "Below: U (95 %) of every sample, from model and noise."
    return drawn.with_title(f"{channel.channel}: recording before and after", caption)


def _unit(letter: str, unit: str) -> str:
    """Return a unit with its prefix, in parentheses if it is a quotient or product."""
    nice = typeset(unit)
    return f"({letter}{nice})" if letter == "" and ("/" in nice or "·" in nice) else f"{letter}{nice}"
