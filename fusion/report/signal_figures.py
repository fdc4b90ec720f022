"""Figures of channels, clocks and vibrometer points."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from matplotlib.axes import Axes

from fusion.base import prefix
from fusion.estimation.coverage import coverage_factor
from fusion.instruments.vibrometer import PointSpread, axis_name
from fusion.phasors.channels import ChannelResult
from fusion.phasors.timing import ClockResult
from fusion.report.style import (
    BLACK,
    BLUE,
    GREY,
    ORANGE,
    RED,
    Picture,
    decades,
    finish,
    lay_out,
    panel_label,
    power_text,
    sheet,
    thin_out,
)
from fusion.report.tables import PREFIXED, main_line
from fusion.sensitivity.analyse import Evaluation
from shaker.arrays import FloatArray
from shaker.labels import typeset

# Figures of the DAQ side: channels with their fit and spectrum, camera trigger.


SPECTRUM_POINTS = 700
EXCERPT_POINTS = 300
MOST_CHANNELS = 24
"""Channels and triggers that a figure has room for."""


def channel_pictures(evaluation: Evaluation) -> list[Picture]:
    """The figure of all channels, where there are any."""
    return [draw_channels(evaluation.channels[:MOST_CHANNELS], evaluation)] if evaluation.channels else []


def trigger_pictures(evaluation: Evaluation) -> list[Picture]:
    """The figure of all camera triggers, where there are any."""
    clocks = [clock for clock in evaluation.clocks if clock.trigger is not None and len(clock.trigger.number) > 2]
    return [draw_trigger(clocks[:MOST_CHANNELS])] if clocks else []


def draw_channels(channels: Sequence[ChannelResult], evaluation: Evaluation) -> Picture:
    """An excerpt of every channel with its fit and the exposures, and its amplitude spectrum with the lines found."""
    exposures = evaluation.stereo[0].time_s if evaluation.stereo and not evaluation.set_ups else np.empty(0)
    with sheet("channels", 0.7 + 1.2 * len(channels), len(channels), 2, widths=(1.15, 1.0)) as drawn:
        for place, channel in enumerate(channels):
            _draw_excerpt(drawn.panels[2 * place], channel, exposures)
            _draw_spectrum(drawn.panels[2 * place + 1], channel, evaluation.lines.frequency_hz)
        drawn.panels[-2].set_xlabel("time / s")
        drawn.panels[-1].set_xlabel("frequency / Hz")
        marks = " Vertical lines: middles of the camera exposures." if len(exposures) else ""
        more = len(evaluation.channels) - len(channels)
        caption = f"Left: samples (points) and fitted lines (curve).{marks} Right: triangles mark the lines fitted."
        caption += f" {more} more channels are not drawn." if more else ""
        return drawn.picture("Channels", caption, left=0.72, top=0.22, gap=(0.7, 0.28), label=0.5)


def draw_trigger(clocks: Sequence[ClockResult]) -> Picture:
    """Deviation of every trigger edge from the periodic model, for each DAQ block."""
    with sheet("trigger", 0.55 + 1.35 * len(clocks), len(clocks)) as drawn:
        for axes, clock in zip(drawn.panels, clocks, strict=True):
            trigger = clock.trigger
            if trigger is None:
                continue
            deviation = trigger.edge_s - trigger.time_s(trigger.number)
            factor, letter = prefix(np.append(deviation, trigger.resolution_s / 2.0), coarse=True)
            half = trigger.resolution_s / factor / 2.0
            axes.axhspan(-half, half, color=ORANGE, alpha=0.18, linewidth=0)
            axes.plot(trigger.number, deviation / factor, "o", color=BLUE, markersize=2.6, markeredgewidth=0)
            axes.axhline(0.0, color=BLACK, linewidth=0.6)
            axes.set_ylabel(f"deviation / {letter}s")
            panel_label(axes, clock.daq)
        drawn.panels[-1].set_xlabel("number of the edge")
        caption = "Camera trigger edges minus the fitted periodic model. Band: the interval that sampling leaves open."
        return drawn.picture("Trigger", caption, left=0.72, top=0.22, gap=(0.5, 0.28), label=0.52)


def _draw_excerpt(axes: Axes, channel: ChannelResult, exposures: FloatArray) -> None:
    """Samples and fit over a short stretch of time."""
    time, chosen = channel.excerpt_s, slice(0, EXCERPT_POINTS)
    if channel.unit in PREFIXED:
        factor, letter = prefix(channel.excerpt)
    else:  # a power of a thousand for units that take no prefix
        largest = float(np.nanmax(np.abs(channel.excerpt))) if channel.excerpt.size else 1.0
        power = 3 * int(np.floor(np.log10(largest) / 3.0)) if largest > 0.0 else 0
        factor, letter = (1.0, "") if power == 0 else (10.0**power, f"{power_text(power)} ")
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


# Figure of parallel vibrometer points: where they are, how far from their mean, and what a rigid plane explains.


NAMES_BELOW = 24
"""Number of points up to which each is named in the map."""


def point_pictures(evaluation: Evaluation) -> list[Picture]:
    """Return one figure per group of parallel points."""
    line = main_line(evaluation)
    return [draw_points(spread, line, place) for place, spread in enumerate(evaluation.points)]


def draw_points(spread: PointSpread, line: int, place: int) -> Picture:
    """Map of the points, and deviations of their amplitude and phase from the mean with the best plane's."""
    height = max(2.9, 0.8 + 0.24 * len(spread.channels))
    with sheet(f"points-{place}", height, 1, 3, widths=(1.15, 1.0, 1.0)) as drawn:
        chart, amplitude, phase = drawn.panels
        _draw_map(chart, spread, line)
        along, across, u_along, u_across = _deviations(spread, line)
        planned = (spread.value[line] - spread.residual[line]) / spread.mean[line]
        _draw_bars(amplitude, 100.0 * along, 100.0 * u_along, 100.0 * (planned.real - 1.0))
        _draw_bars(phase, 1e3 * across, 1e3 * u_across, 1e3 * planned.imag)
        names = [f"{name} ({number})" for number, name in enumerate(spread.channels, 1)]
        amplitude.set_yticks(range(len(names)), names)
        phase.set_yticks(range(len(names)), [])
        amplitude.set_xlabel("amplitude from the mean / %")
        phase.set_xlabel("phase from the mean / mrad")
        lay_out(drawn.panels, gap=(0.75, 0.2), top=0.35, right=0.15)
        # Names are longer than numbers: the left side of their panel moves to the right.
        box, shift = amplitude.get_position(), 0.55 / drawn.figure.get_size_inches()[0]
        amplitude.set_position((box.x0 + shift, box.y0, box.width - shift, box.height))
        handles, labels = amplitude.get_legend_handles_labels()
        drawn.figure.legend(handles, labels, loc="upper right", ncols=2)
        caption = (
            f"Vibrometer points along {axis_name(spread.direction)} on the {spread.body} at "
            f"{spread.frequency_hz[line]:.4f} Hz: where they are (red: amplitude above the mean, blue: below), and "
            f"deviation from the mean; bars: U of the deviation; open: the best rigid plane, mean and rocking, there."
        )
        return finish(drawn.figure, drawn.name, "Vibrometer points and rocking", caption)


def _deviations(spread: PointSpread, line: int) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
    """Deviations of the points from their mean, along and across it, relative to it, and their expanded uncertainty."""
    count = len(spread.channels)
    centre = np.kron(np.eye(2), np.eye(count) - 1.0 / count)
    every = np.broadcast_to(centre, (len(spread.mean), *centre.shape))
    turned = spread.uncertainty.transformed(every).scaled(np.repeat(1.0 / spread.mean[:, None], count, axis=1))
    u = np.sqrt(turned.covariance[line].diagonal())
    parts = [turned.dof_along(np.full(count, direction))[line] for direction in (1.0 + 0.0j, 1.0j)]
    expanded = np.array([coverage_factor(float(dof)) for dof in np.concatenate(parts)]) * u
    ratio = spread.value[line] / spread.mean[line]
    return ratio.real - 1.0, ratio.imag, expanded[:count], expanded[count:]


def _draw_bars(axes: Axes, value: FloatArray, expanded: FloatArray, planned: FloatArray) -> None:
    """Deviations with bars, and the plane's as open markers, one row per point."""
    rows = np.arange(len(value))
    axes.axvline(0.0, color=GREY, linewidth=0.8)
    axes.errorbar(value, rows, xerr=expanded, fmt="o", color=BLUE, elinewidth=1.0, label="point")
    axes.plot(planned, rows, "D", markerfacecolor="none", markeredgecolor=ORANGE, markersize=7.0, label="rigid plane")
    axes.set_ylim(len(value) - 0.4, -0.6)


def _draw_map(axes: Axes, spread: PointSpread, line: int) -> None:
    """Points as seen against their direction, coloured by the deviation of their amplitude."""
    first, second = (axis_name(axis) for axis in spread.axes)
    place = 1e3 * spread.place_m
    deviation = 100.0 * (np.abs(spread.value[line] / spread.mean[line]) - 1.0)
    limit = float(np.max(np.abs(deviation))) or 1.0
    axes.scatter(
        place[:, 0], place[:, 1], c=deviation, cmap="RdBu_r", vmin=-limit, vmax=limit, s=70, edgecolors=BLACK, zorder=3
    )
    for number, (x, y) in enumerate(place if len(place) <= NAMES_BELOW else []):
        axes.annotate(str(number + 1), (x, y), (6, 5), textcoords="offset points", fontsize=7.0)
    axes.plot(0.0, 0.0, "+", color=GREY)
    axes.set_aspect("equal", adjustable="datalim")
    axes.margins(0.2)
    axes.set_xlabel(f"{first} / mm")
    axes.set_ylabel(f"{second} / mm")
