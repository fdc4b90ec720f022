"""Figures of a rotation test: readings over the angle with fit and residuals, masses against what was weighed."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from matplotlib.axes import Axes

from fusion.base import prefix, typeset
from fusion.report.style import (
    BLACK,
    BLUE,
    GREEN,
    GREY,
    LIGHT,
    RED,
    Picture,
    drawing,
    finish,
    lay_out,
    new_figure,
    panel_label,
)
from shaker.arrays import FloatArray

COLOURS = (BLUE, RED, GREEN)
MARKERS = ("o", "s", "^")
FULL_TURN_DEG = 360.0


@dataclass(frozen=True)
class TurnedReadings:
    """Components of one recording: reading and residual (N, C) at angles (N,) come to in a sense (N,), and the fit."""

    recording: str
    kind: str
    unit: str
    components: tuple[str, ...]
    angle_rad: FloatArray
    sense: FloatArray
    reading: FloatArray
    residual: FloatArray
    curve: Callable[[FloatArray], FloatArray]


@dataclass(frozen=True)
class Deviations:
    """Load mass by some components less the weighed mass in %, with U; `weighed`: U of the weighed mass in %."""

    names: tuple[str, ...]
    value: Sequence[float]
    expanded: Sequence[float]
    weighed: float


def draw_readings(turned: TurnedReadings) -> Picture:
    """Readings over the angle with the harmonics fitted, and what these leave."""
    name = f"rotation-{turned.recording}-{turned.kind}"
    with drawing(name):
        figure = new_figure(4.6)
        upper, lower = figure.subplots(2, 1, sharex=True, gridspec_kw={"height_ratios": [2.0, 1.0]})
        angle = np.radians(np.linspace(0.0, FULL_TURN_DEG, 361))
        fitted = turned.curve(angle)
        scale, letter = prefix(turned.residual, coarse=False)
        for c, component in enumerate(turned.components):
            upper.plot(np.degrees(angle), fitted[:, c], color=COLOURS[c], linewidth=0.9, zorder=2)
            _points(upper, turned, c, turned.reading[:, c], component)
            _points(lower, turned, c, turned.residual[:, c] / scale, "")
        lower.axhline(0.0, color=LIGHT, linewidth=0.8, zorder=1)
        unit = typeset(turned.unit)
        upper.set_ylabel(f"load / {unit}" if "·" not in unit else f"load / ({unit})")
        lower.set_ylabel(f"residual / {letter}{unit}" if "·" not in unit else f"residual / ({letter}{unit})")
        panel_label(upper, f"{turned.recording}: {turned.kind}, readings and fit")
        panel_label(lower, "readings less fit")
        upper.legend(loc="lower right", ncols=3, bbox_to_anchor=(1.0, 1.0), borderaxespad=0.0)
        _angle_axis(lower)
        lay_out(figure, (upper, lower), top=0.3, gap=(0.5, 0.3), left=0.78, label=0.58)
        both = np.ptp(turned.sense) > 0.0
        caption = "Curves: offset and harmonics fitted to all channels in one solve."
        caption += " Filled: come to with the angle growing; open: with the angle falling." if both else ""
        return finish(figure, name, f"{turned.recording}, {turned.kind} over the angle of the head", caption)


def draw_deviations(deviations: Deviations) -> Picture:
    """Load mass by each axis and by all against the weighed mass."""
    name = "rotation-deviations"
    with drawing(name):
        figure = new_figure(2.5)
        axes = figure.subplots(1, 1)
        places = np.arange(len(deviations.names))
        axes.axhspan(-deviations.weighed, deviations.weighed, color=GREY, alpha=0.3, linewidth=0, zorder=1)
        axes.axhline(0.0, color=GREY, linewidth=0.8, zorder=1.5)
        axes.errorbar(places, deviations.value, deviations.expanded, fmt="o", color=BLACK, zorder=2)
        axes.set_xticks(places, deviations.names)
        axes.set_xlim(-0.6, len(places) - 0.4)
        axes.set_ylabel("deviation / %")
        panel_label(axes, "load mass less weighed mass, with U")
        lay_out(figure, (axes,), top=0.3, left=0.78, label=0.58)
        caption = "Bars: expanded uncertainty U of the difference. Grey: U of the weighed mass."
        return finish(figure, name, "Load mass against the weighed mass", caption)


def _points(axes: Axes, turned: TurnedReadings, component: int, values: FloatArray, label: str) -> None:
    """Readings of one component, filled where the angle grew and open where it fell."""
    degrees = _within_turn(turned.angle_rad)
    for sense, filled in ((1.0, True), (-1.0, False)):
        here = turned.sense >= 0.0 if filled else turned.sense < 0.0
        if here.any():
            axes.plot(
                degrees[here],
                values[here],
                linestyle="none",
                marker=MARKERS[component],
                color=COLOURS[component],
                markerfacecolor=COLOURS[component] if filled else "white",
                markersize=4.0,
                markeredgewidth=0.9,
                label=label if sense > 0.0 or not np.any(turned.sense >= 0.0) else None,
                zorder=3,
            )


def _within_turn(angle_rad: FloatArray) -> FloatArray:
    """Angles in degrees from 0 to 360, a full turn staying one."""
    degrees = np.degrees(angle_rad)
    inside = (degrees >= 0.0) & (degrees <= FULL_TURN_DEG + 1e-6)
    return np.asarray(np.where(inside, degrees, np.mod(degrees, FULL_TURN_DEG)))


def _angle_axis(axes: Axes) -> None:
    """A turn in steps of 45 degrees."""
    axes.set_xlim(-8.0, FULL_TURN_DEG + 8.0)
    axes.set_xticks(np.arange(0.0, FULL_TURN_DEG + 1.0, 45.0))
    axes.set_xlabel("angle of the head / °")
