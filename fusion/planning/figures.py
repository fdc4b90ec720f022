"""Figures of `shakercal plan` (condition and uncertainty over the camera rate) and `shakercal lines` (spectrum)."""

from __future__ import annotations

import re
from collections.abc import Sequence
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.lines import Line2D
from matplotlib.patches import Patch

from fusion.planning.lines import LineList
from fusion.planning.plan import Plan
from fusion.report.figure import BLACK, BLUE, GREY, ORANGE, RED, thin_out
from fusion.report.style import decades, panel_label, sheet
from shaker.arrays import FloatArray
from shaker.lines.rate_planner import condition_over_rate, scan_rates
from shaker.lines.spectrum import FIRST_BIN
from shaker.sine.aliasing import MAX_CONDITION

COLUMNS = 420  # of a panel; each shows the largest condition of the rates in it
RATES_PER_COLUMN = 6
TOP = 100.0  # where the axis ends
PREFERRED_COLOUR = "#e3f3ec"
POINTS = 1600  # of a spectrum
DETAILS = re.compile(r" of |[,(]|(?<=combination) ")
"""Where the details of what a line is begin."""
LABELLED = 12  # lines of a panel that are named, the highest


def draw_plan(plan: Plan, kind: str) -> bytes:
    """Draw condition number and uncertainty of every point over the camera rate, as a file (png, svg, pdf)."""
    rates = np.linspace(*plan.request.limits_hz, COLUMNS * RATES_PER_COLUMN)
    height = 1.0 + (2.0 if len(plan.points) == 1 else 0.62 * len(plan.points))
    with sheet("plan", height, len(plan.points), sharex=True, sharey=True) as drawn:
        for index, axes in enumerate(drawn.panels):
            _draw_point(axes, plan, index, rates)
        last = drawn.panels[-1]
        last.set_xlabel("camera rate / Hz")
        last.set_xlim(rates[0], rates[-1])
        last.set_ylim(1.0, TOP)
        decades(last.yaxis)
        marks: list[Line2D | Patch] = [
            Patch(color=BLUE, label="condition number"),
            Line2D([], [], color=ORANGE, label="worst u over that of white noise"),
            Patch(color=PREFERRED_COLOUR, label="fundamental at 0.1 to 0.4 of the rate"),
            Line2D([], [], color=GREY, linestyle=(0, (4, 2)), label="lines dropped above"),
            Line2D(
                [], [], color=RED, marker="v", linestyle="", label="given" if plan.request.rate_hz else "best rates"
            ),
        ]
        if plan.shared and len(plan.points) > 1:
            marks.append(Line2D([], [], color=RED, label="as few as possible"))
        drawn.figure.legend(handles=marks, loc="upper right", ncols=3, fontsize=7.0, borderaxespad=0.1)
        return drawn.file(kind, top=0.55, gap=(0.5, 0.2))


def _draw_point(axes: Axes, plan: Plan, index: int, rates: FloatArray) -> None:
    """Condition (largest of each column) and uncertainty of one point, above where the fundamental is best seen.

    Marks: the rates of this point, and those that serve several.
    """
    point, sampling = plan.points[index], plan.request.sampling
    scan = scan_rates(point.lines, rates, sampling)
    condition = condition_over_rate(point.lines, rates, sampling.frames)
    best = scan.preferred == max(1, int(scan.preferred.max()))
    axes.fill_between(rates, 1.0, TOP, where=best.tolist(), color=PREFERRED_COLOUR, linewidth=0, step="mid")
    axes.set_yscale("log")
    centre = rates.reshape(COLUMNS, -1).mean(axis=1)
    columns = np.minimum(condition, 2.0 * TOP).reshape(COLUMNS, -1)
    axes.fill_between(centre, 1.0, columns.max(axis=1), color=BLUE, linewidth=0.5, step="mid")
    axes.plot(centre, np.median(scan.penalty.reshape(COLUMNS, -1), axis=1), color=ORANGE, linewidth=0.9)
    axes.axhline(MAX_CONDITION, color=GREY, linewidth=0.7, linestyle=(0, (4, 2)))
    for choice in point.choices:
        axes.plot(choice.rate_hz, TOP, marker="v", color=RED, markersize=5.5, clip_on=False, zorder=5)
    for shared in plan.shared if len(plan.points) > 1 else ():
        if index in shared.points:
            axes.axvline(shared.rate_hz, color=RED, linewidth=0.9)
    low, high = float(point.lines.fundamentals_hz.min()), float(point.lines.fundamentals_hz.max())
    panel_label(axes, f"{low:.7g} Hz" if low == high else f"{low:.7g} to {high:.7g} Hz together")


def draw_lines(lists: Sequence[LineList], kind: str) -> bytes:
    """Draw spectrum, noise floor and lines of every channel, as a file (png, svg, pdf)."""
    panels = [(item, c) for item in lists for c in range(len(item.channels))]
    with sheet("lines", 0.7 + 2.3 * len(panels), len(panels), sharex=False) as drawn:
        for axes, (item, c) in zip(drawn.panels, panels, strict=True):
            _draw_channel(axes, item, c)
        drawn.panels[-1].set_xlabel("frequency / Hz")
        return drawn.file(kind, top=0.25, gap=(0.5, 0.42))


def _draw_channel(axes: Axes, item: LineList, c: int) -> None:
    """One channel's spectrum with its lines."""
    if item.spectrum is None:
        raise ValueError("item: expected lines surveyed with `drawn`, found no spectrum")
    frequency, amplitude = item.spectrum.frequency_hz[FIRST_BIN:], item.spectrum.amplitude[FIRST_BIN:, c]
    edges = np.geomspace(frequency[0], frequency[-1] * 1.0001, POINTS)
    axes.loglog(*thin_out(frequency, amplitude, edges), color=BLUE, linewidth=0.6)
    floor_hz, floor = item.survey.floor_hz, item.survey.floor
    if len(floor_hz):
        above = floor_hz >= frequency[0]
        axes.plot(floor_hz[above], floor[above, c], color=BLACK, linewidth=0.9)
    shown = [entry for entry in item.entries if np.isfinite(entry.amplitude[c])]
    for rank, entry in enumerate(sorted(shown, key=lambda entry: -float(entry.amplitude[c]))):
        place = float(abs(entry.frequency_hz - item.rate_hz * round(entry.frequency_hz / item.rate_hz)))  # as sampled
        colour = ORANGE if entry.what.startswith("unexplained") else GREY
        if entry.use == "fitted" or (not entry.use and entry.what.startswith("fundamental")):
            colour = RED
        axes.plot(place, entry.amplitude[c], marker="v", color=colour, markersize=4.0, linestyle="")
        if rank < LABELLED:
            text = f"{entry.frequency_hz:.5g} {DETAILS.split(entry.what)[0].strip()}"
            look: dict[str, Any] = {"fontsize": 5.5, "rotation": 90, "ha": "center", "color": colour}
            axes.annotate(text, (place, float(entry.amplitude[c])), (0, 5), textcoords="offset points", **look)
    lowest = floor[:, c] if len(floor_hz) else amplitude[amplitude > 0.0]
    axes.set_ylim(0.2 * float(np.min(lowest)), 1e4 * float(amplitude.max()))
    decades(axes.yaxis)
    unit = f" / {item.units[c]}" if item.units[c] else ""
    axes.set_ylabel(f"amplitude{unit}")
    panel_label(axes, f"{item.channels[c]}: spectrum, noise floor (black) and lines")
