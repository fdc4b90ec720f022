"""Figures of the DAQ side: channels with their fit and spectrum, camera trigger."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from matplotlib.axes import Axes

from fusion.evaluation import Evaluation
from fusion.measured_results import ChannelResult, ClockResult
from fusion.plots.style import (
    BLACK,
    BLUE,
    GREY,
    ORANGE,
    RED,
    FloatArray,
    Picture,
    decades,
    drawing,
    finish,
    lay_out,
    new_figure,
    panel_label,
    power_text,
    thin_out,
)
from fusion.polar import prefix, typeset

SPECTRUM_POINTS = 700
EXCERPT_POINTS = 300
MOST_CHANNELS = 24
"""Channels and triggers that a figure has room for."""
PREFIXED = ("m", "m/s", "m/s^2", "rad/s", "N", "V")


def channel_pictures(evaluation: Evaluation) -> list[Picture]:
    """The figure of all channels, where there are any."""
    return [draw_channels(evaluation.channels[:MOST_CHANNELS], evaluation)] if evaluation.channels else []


def trigger_pictures(evaluation: Evaluation) -> list[Picture]:
    """The figure of all camera triggers, where there are any."""
    clocks = [clock for clock in evaluation.clocks if clock.trigger is not None and len(clock.trigger.number) > 2]
    return [draw_trigger(clocks[:MOST_CHANNELS])] if clocks else []


def draw_channels(channels: Sequence[ChannelResult], evaluation: Evaluation) -> Picture:
    """An excerpt of every channel with its fit and the exposures, and its amplitude spectrum with the lines found."""
    exposures = evaluation.stereo[0].time_s if evaluation.stereo and not evaluation.takes else np.empty(0)
    lines = evaluation.lines.frequency_hz
    with drawing("channels"):
        figure = new_figure(0.7 + 1.2 * len(channels))
        panels = figure.subplots(
            len(channels), 2, squeeze=False, gridspec_kw={"width_ratios": [1.15, 1.0]}, sharex="col"
        )
        for (excerpt, spectrum), channel in zip(panels, channels, strict=True):
            _draw_excerpt(excerpt, channel, exposures)
            _draw_spectrum(spectrum, channel, lines)
        panels[-1, 0].set_xlabel("time / s")
        panels[-1, 1].set_xlabel("frequency / Hz")
        lay_out(figure, panels.flat, top=0.22, gap=(0.7, 0.28), label=0.5)
        marks = " Vertical lines: middles of the camera exposures." if len(exposures) else ""
        more = len(evaluation.channels) - len(channels)
        caption = f"Left: samples (points) and fitted lines (curve).{marks} Right: triangles mark the lines fitted."
        caption += f" {more} more channels are not drawn." if more else ""
        return finish(figure, "channels", "Channels", caption)


def draw_trigger(clocks: Sequence[ClockResult]) -> Picture:
    """Deviation of every trigger edge from the periodic model, for each DAQ block."""
    with drawing("trigger"):
        figure = new_figure(0.55 + 1.35 * len(clocks))
        panels = figure.subplots(len(clocks), 1, squeeze=False, sharex=True)[:, 0]
        for axes, clock in zip(panels, clocks, strict=True):
            trigger = clock.trigger
            if trigger is None:
                continue
            deviation = trigger.edge_s - trigger.time_s(trigger.number)
            factor, letter = prefix(np.append(deviation, trigger.resolution_s / 2.0), coarse=True)
            axes.axhspan(*_half(trigger.resolution_s / factor), color=ORANGE, alpha=0.18, linewidth=0)
            axes.plot(trigger.number, deviation / factor, "o", color=BLUE, markersize=2.6, markeredgewidth=0)
            axes.axhline(0.0, color=BLACK, linewidth=0.6)
            axes.set_ylabel(f"deviation / {letter}s")
            panel_label(axes, clock.daq)
        panels[-1].set_xlabel("number of the edge")
        lay_out(figure, panels, top=0.22, gap=(0.5, 0.28))
        caption = "Camera trigger edges minus the fitted periodic model. Band: the interval that sampling leaves open."
        return finish(figure, "trigger", "Trigger", caption)


def _draw_excerpt(axes: Axes, channel: ChannelResult, exposures: FloatArray) -> None:
    """Samples and fit over a short stretch of time."""
    time, chosen = channel.excerpt_s, slice(0, EXCERPT_POINTS)
    factor, letter = prefix(channel.excerpt) if channel.unit in PREFIXED else _power(channel.excerpt)
    if len(time):
        last = time[chosen][-1]
        for instant in exposures[(exposures >= time[0]) & (exposures <= last)]:
            axes.axvline(float(instant), color=GREY, linewidth=0.9, linestyle=(0, (4, 2)))
    axes.plot(time[chosen], channel.excerpt[chosen] / factor, "o", color=BLUE, markersize=1.7, markeredgewidth=0)
    axes.plot(time[chosen], channel.excerpt_fit[chosen] / factor, color=RED, linewidth=0.9)
    axes.set_ylabel(f"{letter}{typeset(channel.unit)}")
    panel_label(axes, f"{channel.name} ({channel.daq})")


def _draw_spectrum(axes: Axes, channel: ChannelResult, lines: FloatArray) -> None:
    """Amplitude spectrum on logarithmic axes with the lines marked."""
    keep = (channel.spectrum_hz > 0.0) & (channel.spectrum > 0.0)
    frequency, amplitude = channel.spectrum_hz[keep], channel.spectrum[keep]
    if not len(frequency):
        return
    edges = np.geomspace(frequency[0], frequency[-1] * 1.0001, SPECTRUM_POINTS)
    thin_frequency, thin_amplitude = thin_out(frequency, amplitude, edges)
    axes.loglog(thin_frequency, thin_amplitude, color=BLUE, linewidth=0.8)
    for line in lines[(lines >= frequency[0]) & (lines <= frequency[-1])]:
        near = np.abs(frequency - line) <= 2.0 * (frequency[1] - frequency[0] if len(frequency) > 1 else line)
        top = float(amplitude[near].max()) if near.any() else float(np.median(amplitude))
        axes.plot(line, 2.2 * top, marker="v", color=RED, markersize=4.5)
    axes.set_ylim(0.3 * float(np.median(thin_amplitude)), 12.0 * float(amplitude.max()))
    decades(axes.xaxis)
    decades(axes.yaxis)
    axes.set_ylabel(typeset(channel.unit))
    panel_label(axes, f"{channel.name}: amplitude spectrum")


def _power(values: FloatArray) -> tuple[float, str]:
    """Factor for units that take no prefix."""
    largest = float(np.nanmax(np.abs(values))) if values.size else 1.0
    power = 3 * int(np.floor(np.log10(largest) / 3.0)) if largest > 0.0 else 0
    return (1.0, "") if power == 0 else (10.0**power, f"{power_text(power)} ")


def _half(width: float) -> tuple[float, float]:
    """Interval of a width about zero."""
    return -width / 2.0, width / 2.0
