"""Figure of parallel vibrometer points: where they are, how far from their mean, and what a rigid plane explains."""

from __future__ import annotations

import numpy as np
from matplotlib.axes import Axes

from fusion.coverage import coverage_factor
from fusion.evaluation import Evaluation
from fusion.highlights import main_line
from fusion.plots.style import BLACK, BLUE, GREY, ORANGE, FloatArray, Picture, drawing, finish, lay_out, new_figure
from fusion.point_spread import PointSpread, axis_name

NAMES_BELOW = 24
"""Number of points up to which each is named in the map."""


def point_pictures(evaluation: Evaluation) -> list[Picture]:
    """Return one figure per group of parallel points."""
    line = main_line(evaluation)
    return [draw_points(spread, line, place) for place, spread in enumerate(evaluation.points)]


def draw_points(spread: PointSpread, line: int, place: int) -> Picture:
    """Map of the points, and deviations of their amplitude and phase from the mean with the best plane's."""
    name = f"points-{place}"
    with drawing(name):
        figure = new_figure(max(2.9, 0.8 + 0.24 * len(spread.channels)))
        chart, amplitude, phase = figure.subplots(1, 3, gridspec_kw={"width_ratios": [1.15, 1.0, 1.0]})
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
        lay_out(figure, [chart, amplitude, phase], gap=(0.75, 0.2), top=0.35, right=0.15)
        _make_room(amplitude, figure.get_size_inches()[0])
        handles, labels = amplitude.get_legend_handles_labels()
        figure.legend(handles, labels, loc="upper right", ncols=2)
        caption = (
            f"Vibrometer points along {axis_name(spread.direction)} on the {spread.body} at "
            f"{spread.frequency_hz[line]:.4f} Hz: where they are (red: amplitude above the mean, blue: below), and "
            f"deviation from the mean; bars: U of the deviation; open: the best rigid plane, mean and rocking, there."
        )
        return finish(figure, name, "Vibrometer points and rocking", caption)


def _make_room(axes: Axes, width_in: float) -> None:
    """Move the left side of a panel to the right, for names that are longer than numbers."""
    box = axes.get_position()
    shift = 0.55 / width_in
    axes.set_position((box.x0 + shift, box.y0, box.width - shift, box.height))


def _deviations(spread: PointSpread, line: int) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
    """Deviations of the points from their mean, along and across it, relative to it, and their expanded uncertainty."""
    count = len(spread.channels)
    centre = np.kron(np.eye(2), np.eye(count) - 1.0 / count)
    every = np.broadcast_to(centre, (len(spread.mean), *centre.shape))
    turned = spread.uncertainty.transformed(every).scaled(np.repeat(1.0 / spread.mean[:, None], count, axis=1))
    u = np.sqrt(turned.covariance[line].diagonal())
    k = np.array([coverage_factor(float(dof)) for dof in turned.dof()[line]])
    ratio = spread.value[line] / spread.mean[line]
    return ratio.real - 1.0, ratio.imag, k * u[:count], k * u[count:]


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
