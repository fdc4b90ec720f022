"""Figure of a plan: condition of the fit and uncertainty over the camera rate, and the rates chosen."""

from __future__ import annotations

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch

from fusion.plan import FloatArray, Plan
from fusion.plots.style import BLUE, GREY, ORANGE, RED, as_file, decades, drawing, lay_out, new_figure, panel_label
from shaker.signals.plan.search import Scan, condition_over_rate, scan_rates
from shaker.signals.separation import MAX_CONDITION

COLUMNS = 420  # of a panel; each shows the largest condition of the rates in it
RATES_PER_COLUMN = 6
TOP = 100.0  # where the axis ends
PREFERRED_COLOUR = "#e3f3ec"


def draw_plan(plan: Plan, kind: str) -> bytes:
    """Draw condition number and uncertainty of every point over the camera rate, as a file (png, svg, pdf)."""
    rates = np.linspace(*plan.request.limits_hz, COLUMNS * RATES_PER_COLUMN)
    single = len(plan.points) == 1
    with drawing("plan"):
        figure = new_figure(1.0 + (2.0 if single else 0.62 * len(plan.points)))
        panels = figure.subplots(len(plan.points), 1, squeeze=False, sharex=True, sharey=True)[:, 0]
        for index, (axes, point) in enumerate(zip(panels, plan.points, strict=True)):
            scan = scan_rates(point.lines, rates, plan.request.sampling)
            _draw_curves(axes, scan, condition_over_rate(point.lines, rates, plan.request.sampling.frames))
            _draw_choices(axes, plan, index)
        panels[-1].set_xlabel("camera rate / Hz")
        panels[-1].set_xlim(rates[0], rates[-1])
        panels[-1].set_ylim(1.0, TOP)
        decades(panels[-1].yaxis)
        lay_out(figure, panels, top=0.55, gap=(0.5, 0.2))
        _legend(figure, plan)
        return as_file(figure, kind)


def _draw_curves(axes: Axes, scan: Scan, condition: FloatArray) -> None:
    """Condition (largest of each column) and uncertainty, above where the fundamental is best seen."""
    rates = scan.rate_hz
    best = scan.preferred == max(1, int(scan.preferred.max()))
    axes.fill_between(rates, 1.0, TOP, where=best.tolist(), color=PREFERRED_COLOUR, linewidth=0, step="mid")
    axes.set_yscale("log")
    centre = rates.reshape(COLUMNS, -1).mean(axis=1)
    columns = np.minimum(condition, 2.0 * TOP).reshape(COLUMNS, -1)
    axes.fill_between(centre, 1.0, columns.max(axis=1), color=BLUE, linewidth=0.5, step="mid")
    axes.plot(centre, np.median(scan.penalty.reshape(COLUMNS, -1), axis=1), color=ORANGE, linewidth=0.9)
    axes.axhline(MAX_CONDITION, color=GREY, linewidth=0.7, linestyle=(0, (4, 2)))


def _draw_choices(axes: Axes, plan: Plan, index: int) -> None:
    """Mark the rates of this point, and those that serve several."""
    point = plan.points[index]
    for choice in point.choices:
        axes.plot(choice.rate_hz, TOP, marker="v", color=RED, markersize=5.5, clip_on=False, zorder=5)
    for shared in plan.shared if len(plan.points) > 1 else ():
        if index in shared.points:
            axes.axvline(shared.rate_hz, color=RED, linewidth=0.9)
    low, high = float(point.lines.fundamentals_hz.min()), float(point.lines.fundamentals_hz.max())
    panel_label(axes, f"{low:.7g} Hz" if low == high else f"{low:.7g} to {high:.7g} Hz together")


def _legend(figure: Figure, plan: Plan) -> None:
    """Name curves and marks, once for all panels."""
    marks: list[Line2D | Patch] = [
        Patch(color=BLUE, label="condition number"),
        Line2D([], [], color=ORANGE, label="worst u over that of white noise"),
        Patch(color=PREFERRED_COLOUR, label="fundamental at 0.1 to 0.4 of the rate"),
        Line2D([], [], color=GREY, linestyle=(0, (4, 2)), label="lines dropped above"),
        Line2D([], [], color=RED, marker="v", linestyle="", label="given" if plan.request.rate_hz else "best rates"),
    ]
    if plan.shared and len(plan.points) > 1:
        marks.append(Line2D([], [], color=RED, label="as few as possible"))
    figure.legend(handles=marks, loc="upper right", ncols=3, fontsize=7.0, borderaxespad=0.1)
