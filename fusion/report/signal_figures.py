"""Figures of channels, clocks and vibrometer points."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from fusion.base import prefix
from fusion.estimation.coverage import coverage_factor
from fusion.instruments.vibrometer import PointSpread, axis_name
from fusion.phasors.channel_phasors import ChannelResult
from fusion.phasors.timing import ClockResult
from fusion.report.figure import (
    BLUE,
    GREY,
    ORANGE,
    RED,
    Figure,
    Panel,
    Scale,
    decimate_edges,
    empty_figure,
    padded_limits,
    power_text,
)
from fusion.report.tables import PREFIXED, main_line
from fusion.sensitivity.analyse import Evaluation
from shaker.labels import typeset
from shakercal._common.arrays import FloatArray

# Figures of the DAQ side: channels with their fit and spectrum, camera trigger.


SPECTRUM_POINTS = 700
"""Number of intervals of a drawn spectrum, about one per pixel."""
EXCERPT_POINTS = 300
"""Number of samples in an excerpt (chosen)."""
MOST_CHANNELS = 24
"""Largest number of channels and triggers in a figure (chosen)."""


def channel_figures(evaluation: Evaluation) -> list[Figure]:
    """Return the figure of all channels, if there are any."""
    return [draw_channels(evaluation.channels[:MOST_CHANNELS], evaluation)] if evaluation.channels else []


def trigger_figures(evaluation: Evaluation) -> list[Figure]:
    """Return the figure of all camera triggers, if there are any."""
    clocks = [clock for clock in evaluation.clocks if clock.trigger is not None and len(clock.trigger.number) > 2]
    return [draw_trigger(clocks[:MOST_CHANNELS])] if clocks else []


def draw_channels(channels: Sequence[ChannelResult], evaluation: Evaluation) -> Figure:
    """Draw an excerpt of every channel with its fit and exposures, and its amplitude spectrum."""
    exposures = evaluation.stereo[0].time_s if evaluation.stereo and not evaluation.set_ups else np.empty(0)
    # Blocks have separate clocks: no common axis.
    drawn = empty_figure("channels", 0.3 + 1.7 * len(channels), len(channels), (1.15, 1.0), shared_x=False)
    for index, channel in enumerate(channels):
        _draw_excerpt(drawn.panels[2 * index], channel, exposures)
        _draw_spectrum(drawn.panels[2 * index + 1], channel, evaluation.lines.frequency_hz)
        drawn.panels[2 * index].x.label, drawn.panels[2 * index + 1].x.label = "time / s", "frequency / Hz"
    marks = " Vertical lines: middles of the camera exposures." if len(exposures) else ""
    more = len(evaluation.channels) - len(channels)
    caption = f"Left: samples (points) and fitted lines (curve).{marks} Right: triangles mark the lines fitted."
    caption += f" {more} more channels are not drawn." if more else ""
    return drawn.with_title("Channels", caption)


def draw_trigger(clocks: Sequence[ClockResult]) -> Figure:
    """Draw the deviation of every trigger edge from the periodic model, for each DAQ block."""
    drawn = empty_figure("trigger", 0.55 + 1.35 * len(clocks), len(clocks))
    for panel, clock in zip(drawn.panels, clocks, strict=True):
        trigger = clock.trigger
        if trigger is None:
            continue
        deviation = trigger.edge_s - trigger.time_s(trigger.number)
        factor, letter = prefix(np.append(deviation, trigger.resolution_s / 2.0), coarse=True)
        half = trigger.resolution_s / factor / 2.0
        panel.span(-half, half, "undetermined by sampling", colour=ORANGE)
        panel.points(trigger.number, deviation / factor, colour=BLUE, size=2.6)
        panel.rule(0.0, width=0.6)
        panel.y.label, panel.title = f"deviation / {letter}s", clock.daq
        ends = np.append(deviation / factor, [-half, half])
        panel.y.limits = padded_limits(float(ends.min()), float(ends.max()))
    drawn.panels[-1].x.label = "number of the edge"
    caption = "Camera trigger edges minus the fitted periodic model. Band: the interval between two samples."
    return drawn.with_title("Trigger", caption)


def _draw_excerpt(panel: Panel, channel: ChannelResult, exposures: FloatArray) -> None:
    """Draw samples and fit over a short time."""
    time, chosen = channel.excerpt_s, slice(0, EXCERPT_POINTS)
    if channel.unit in PREFIXED:
        factor, letter = prefix(channel.excerpt)
    else:  # a power of a thousand for units that take no prefix
        largest = float(np.nanmax(np.abs(channel.excerpt))) if channel.excerpt.size else 1.0
        power = 3 * int(np.floor(np.log10(largest) / 3.0)) if largest > 0.0 else 0
        factor, letter = (1.0, "") if power == 0 else (10.0**power, f"{power_text(power)} ")
    if len(time):
        within = exposures[(exposures >= time[0]) & (exposures <= time[chosen][-1])]
        if len(within):
            panel.rule(within, "exposures", along="x", colour=GREY, dashed=True)
    panel.points(time[chosen], channel.excerpt[chosen] / factor, "samples", colour=BLUE, size=1.8)
    panel.line(time[chosen], channel.excerpt_fit[chosen] / factor, "fitted lines", colour=RED, width=0.9)
    panel.y.label, panel.title = f"{letter}{typeset(channel.unit)}", f"{channel.name} ({channel.daq})"
    panel.x.link = f"excerpt of {channel.daq}"


def _draw_spectrum(panel: Panel, channel: ChannelResult, lines: FloatArray) -> None:
    """Draw the amplitude spectrum on logarithmic axes with the lines marked."""
    keep = (channel.spectrum_hz > 0.0) & (channel.spectrum > 0.0)
    frequency, amplitude = channel.spectrum_hz[keep], channel.spectrum[keep]
    if not len(frequency):
        return
    edges = np.geomspace(frequency[0], frequency[-1] * 1.0001, SPECTRUM_POINTS)
    thin_frequency, thin_amplitude = decimate_edges(frequency, amplitude, edges)
    panel.line(thin_frequency, thin_amplitude, "amplitude spectrum", colour=BLUE, width=0.8)
    marked = lines[(lines >= frequency[0]) & (lines <= frequency[-1])]
    width = 2.0 * (frequency[1] - frequency[0]) if len(frequency) > 1 else np.inf
    around = [slice(*np.searchsorted(frequency, (line - 2.0 * width, line + 2.0 * width))) for line in marked]
    near = [amplitude[part][np.abs(frequency[part] - line) <= width] for part, line in zip(around, marked, strict=True)]
    tops = [float(values.max() if len(values) else np.median(amplitude)) for values in near]
    if len(marked):
        names = tuple(f"{line:.4f} Hz" for line in marked)
        panel.points(marked, 2.2 * np.array(tops), "lines", marker="inverted_triangle", colour=RED, names=names)
    panel.x.log = panel.y.log = True
    panel.x.limits = (float(frequency[0]), float(frequency[-1]))
    panel.y.limits = (0.3 * float(np.median(thin_amplitude)), 12.0 * float(amplitude.max()))
    panel.y.label, panel.title, panel.x.link = typeset(channel.unit), f"{channel.name}: amplitude spectrum", "spectrum"


# Figure of parallel vibrometer points: positions, deviations from their mean, and the best rigid plane.


NAMES_BELOW = 24
"""Largest number of points with names in the map."""


def point_figures(evaluation: Evaluation) -> list[Figure]:
    """Return one figure per group of parallel points."""
    line = main_line(evaluation)
    return [draw_points(spread, line, number) for number, spread in enumerate(evaluation.points)]


def draw_points(spread: PointSpread, line: int, group: int) -> Figure:
    """Draw the vibrometer points, and the deviations of amplitude and phase from mean and plane."""
    height = max(2.9, 0.8 + 0.24 * len(spread.channels))
    drawn = empty_figure(f"points-{group}", height, 1, (1.15, 1.0, 1.0))
    chart, amplitude, phase = drawn.panels
    _draw_map(chart, spread, line)
    along, across, u_along, u_across = _deviations(spread, line)
    planned = (spread.value[line] - spread.residual[line]) / spread.mean[line]
    _draw_bars(amplitude, 100.0 * along, 100.0 * u_along, 100.0 * (planned.real - 1.0))
    _draw_bars(phase, 1e3 * across, 1e3 * u_across, 1e3 * planned.imag)
    names = tuple(f"{name} ({number})" for number, name in enumerate(spread.channels, 1))
    amplitude.y.names, phase.y.names = names, ("",) * len(names)
    amplitude.x.label, phase.x.label = "amplitude from the mean / %", "phase from the mean / mrad"
    caption = (
        f"Vibrometer points along {axis_name(spread.direction)} on the {spread.body} at "
        f"{spread.frequency_hz[line]:.4f} Hz: positions (red: amplitude above the mean, blue: below), and "
        f"deviation from the mean; bars: U of the deviation; open: best rigid plane (mean and rocking)."
    )
    return drawn.with_title("Vibrometer points and rocking", caption)


def _deviations(spread: PointSpread, line: int) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
    """Return relative deviations of the points along and across their mean, and their U."""
    count = len(spread.channels)
    centre = np.kron(np.eye(2), np.eye(count) - 1.0 / count)
    every = np.broadcast_to(centre, (len(spread.mean), *centre.shape))
    relative = spread.uncertainty.transformed(every).scaled(np.repeat(1.0 / spread.mean[:, None], count, axis=1))
    u = np.sqrt(relative.covariance[line].diagonal())
    parts = [relative.dof_along(np.full(count, direction))[line] for direction in (1.0 + 0.0j, 1.0j)]
    expanded = np.array([coverage_factor(float(dof)) for dof in np.concatenate(parts)]) * u
    ratio = spread.value[line] / spread.mean[line]
    return ratio.real - 1.0, ratio.imag, expanded[:count], expanded[count:]


def _draw_bars(panel: Panel, value: FloatArray, expanded: FloatArray, planned: FloatArray) -> None:
    """Draw deviations with bars, and those of the plane as open markers."""
    rows = np.arange(len(value))
    panel.rule(0.0, along="x", colour=GREY)
    panel.points(value, rows, "point", half_x=expanded, colour=BLUE)
    panel.points(planned, rows, "rigid plane", marker="diamond", open=True, colour=ORANGE, size=7.0)


def _draw_map(panel: Panel, spread: PointSpread, line: int) -> None:
    """Draw points seen against their direction, coloured by the deviation of their amplitude."""
    first, second = (axis_name(axis) for axis in spread.axes)
    position_mm = 1e3 * spread.place_m
    deviation = 100.0 * (np.abs(spread.value[line] / spread.mean[line]) - 1.0)
    limit = float(np.max(np.abs(deviation))) or 1.0
    scale = Scale("RdBu", -limit, limit, "amplitude from the mean / %")
    panel.points(*position_mm.T, values=deviation, scale=scale, size=8.4, names=tuple(spread.channels))
    if len(position_mm) <= NAMES_BELOW:
        panel.text(
            position_mm[:, 0],
            position_mm[:, 1],
            [str(number + 1) for number in range(len(position_mm))],
            align="left",
            offset_px=(7.0, 6.0),
        )
    panel.points(0.0, 0.0, marker="plus", colour=GREY, names=("origin",))
    panel.equal = True
    low, high = position_mm.min(axis=0, initial=0.0), position_mm.max(axis=0, initial=0.0)
    margin = 0.2 * float((high - low).max())
    panel.x.limits, panel.y.limits = (low[0] - margin, high[0] + margin), (low[1] - margin, high[1] + margin)
    panel.x.label, panel.y.label = f"{first} / mm", f"{second} / mm"
