"""Figures of `shakercal plan` (condition and uncertainty over the camera rate) and `shakercal lines` (spectrum)."""

from __future__ import annotations

import re
from collections.abc import Sequence

import numpy as np

from fusion.planning.lines import ChannelLines
from fusion.planning.plan import Plan
from fusion.report.figure import BLACK, BLUE, GREY, ORANGE, RED, Panel, decimate_edges, empty_figure
from fusion.report.figure_files import render_figure
from shaker.lines.rate_planner import condition_over_rate, scan_rates
from shaker.lines.spectrum import FIRST_BIN
from shaker.sine.aliasing import MAX_CONDITION
from shakercal._common.arrays import FloatArray
from shakercal._common.digits import number_text

COLUMNS = 420  # columns of a panel; each shows the largest condition of its rates
RATES_PER_COLUMN = 6  # resolution within a column
TOP = 100.0  # end of the axis
PREFERRED_COLOUR = "#7cc9a6"
POINTS = 1600  # points of a spectrum
DETAILS = re.compile(r" of |[,(]|(?<=combination) ")
"""Beginning of the details in the description of a line."""
LABELLED = 12  # highest lines of a panel that are named


def draw_plan(plan: Plan, kind: str) -> bytes:
    """Draw condition number and uncertainty of every point over the camera rate.

    `kind` is the file format: png, svg or pdf.
    """
    rates = np.linspace(*plan.request.limits_hz, COLUMNS * RATES_PER_COLUMN)
    height = 1.0 + (2.0 if len(plan.points) == 1 else 0.62 * len(plan.points))
    drawn = empty_figure("plan", height, len(plan.points))
    for index, panel in enumerate(drawn.panels):
        _draw_point(panel, plan, index, rates)
    drawn.panels[-1].x.label = "camera rate / Hz"
    return render_figure(drawn.with_title("Plan", "Condition and uncertainty over the camera rate."), kind)


def _draw_point(panel: Panel, plan: Plan, index: int, rates: FloatArray) -> None:
    """Draw condition (largest of each column) and uncertainty of one point.

    The band of the preferred alias frequencies, the rates of this point, and common rates are marked.
    """
    point, sampling = plan.points[index], plan.request.sampling
    scan = scan_rates(point.lines, rates, sampling)
    condition = condition_over_rate(point.lines, rates, sampling.frames)
    best = scan.preferred == max(1, int(scan.preferred.max()))
    ends = np.flatnonzero(np.diff(np.concatenate([[False], best, [False]]).astype(int))).reshape(-1, 2)
    for first, last in ends:
        text = "fundamental at 0.1 to 0.4 of the rate"
        panel.span(rates[first], rates[last - 1], text, along="x", colour=PREFERRED_COLOUR)
    centre = rates.reshape(COLUMNS, -1).mean(axis=1)
    columns = np.minimum(condition, 2.0 * TOP).reshape(COLUMNS, -1)
    panel.band(centre, np.ones(COLUMNS), columns.max(axis=1), "condition number", colour=BLUE)
    panel.line(centre, columns.max(axis=1), "condition number", colour=BLUE, width=0.6)
    penalty = np.median(scan.penalty.reshape(COLUMNS, -1), axis=1)
    panel.line(centre, penalty, "worst u over that of white noise", colour=ORANGE, width=0.9)
    panel.rule(MAX_CONDITION, "lines dropped above", colour=GREY, dashed=True)
    chosen = [choice.rate_hz for choice in point.choices]
    marked = "given" if plan.request.rate_hz else "best rates"
    if chosen:
        panel.points(chosen, np.full(len(chosen), 0.8 * TOP), marked, marker="inverted_triangle", colour=RED, size=5.5)
    for shared in plan.shared if len(plan.points) > 1 else ():
        if index in shared.points:
            panel.rule(shared.rate_hz, "as few as possible", along="x", colour=RED, width=0.9)
    low, high = float(point.lines.fundamentals_hz.min()), float(point.lines.fundamentals_hz.max())
    panel.title = (
        f"{number_text(low, 7)} Hz" if low == high else f"{number_text(low, 7)} to {number_text(high, 7)} Hz together"
    )
    panel.y.log, panel.y.limits, panel.x.limits = True, (1.0, TOP), (float(rates[0]), float(rates[-1]))


def draw_lines(lists: Sequence[ChannelLines], kind: str) -> bytes:
    """Draw spectrum, noise floor and lines of every channel.

    `kind` is the file format: png, svg or pdf.
    """
    panels = [(item, c) for item in lists for c in range(len(item.channels))]
    drawn = empty_figure("lines", 0.7 + 2.3 * len(panels), len(panels), shared_x=False)
    for panel, (item, c) in zip(drawn.panels, panels, strict=True):
        _draw_channel(panel, item, c)
    drawn.panels[-1].x.label = "frequency / Hz"
    return render_figure(drawn.with_title("Lines", "Spectrum, noise floor and lines of every channel."), kind)


def _draw_channel(panel: Panel, item: ChannelLines, c: int) -> None:
    """Draw one channel's spectrum with its lines."""
    if item.spectrum is None:
        raise ValueError("item: expected lines surveyed with `drawn`, found no spectrum")
    frequency, amplitude = item.spectrum.frequency_hz[FIRST_BIN:], item.spectrum.amplitude[FIRST_BIN:, c]
    edges = np.geomspace(frequency[0], frequency[-1] * 1.0001, POINTS)
    panel.line(*decimate_edges(frequency, amplitude, edges), colour=BLUE, width=0.6)
    floor_hz, floor = item.survey.floor_hz, item.survey.floor
    if len(floor_hz):
        above = floor_hz >= frequency[0]
        panel.line(floor_hz[above], floor[above, c], "noise floor", colour=BLACK, width=0.9)
    shown = [entry for entry in item.entries if np.isfinite(entry.amplitude[c])]
    for rank, entry in enumerate(sorted(shown, key=lambda entry: -float(entry.amplitude[c]))):
        frequency_hz = float(
            abs(entry.frequency_hz - item.rate_hz * round(entry.frequency_hz / item.rate_hz))
        )  # as sampled
        colour, label = (ORANGE, "unexplained") if entry.what.startswith("unexplained") else (GREY, "other lines")
        if entry.use == "fitted" or (not entry.use and entry.what.startswith("fundamental")):
            colour, label = RED, "driven, fitted"
        height = float(entry.amplitude[c])
        panel.points(frequency_hz, height, label, marker="inverted_triangle", colour=colour, size=4.0)
        if rank < LABELLED:
            text = f"{number_text(entry.frequency_hz, 5)} {DETAILS.split(entry.what)[0].strip()}"
            panel.text(frequency_hz, height, text, colour=colour, offset_px=(0.0, 5.0), upright=True)
    lowest = floor[:, c] if len(floor_hz) else amplitude[amplitude > 0.0]
    panel.x.log = panel.y.log = True
    panel.x.limits = (float(frequency[0]), float(frequency[-1]))
    panel.y.limits = (0.2 * float(np.min(lowest)), 1e4 * float(amplitude.max()))
    unit = f" / {item.units[c]}" if item.units[c] else ""
    panel.y.label, panel.title = f"amplitude{unit}", f"{item.channels[c]}: spectrum, noise floor (black) and lines"
