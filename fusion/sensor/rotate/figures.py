"""Figures of a rotation test: readings over the angle with fit and residuals, masses against what was weighed."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from matplotlib.axes import Axes

from fusion.base import prefix, typeset
from fusion.report.style import (
    BLACK,
    COLOURS,
    GREY,
    LIGHT,
    Picture,
    panel_label,
    sheet,
)
from fusion.sensor.rotate.readings import RotationEvaluation, RotationRecording
from shaker.arrays import FloatArray
from shaker.labels import LOAD_COMPONENTS, LOAD_UNITS
from shaker.static_rotation.harmonics import turning_sense

MARKERS = ("o", "s", "^")
FULL_TURN_DEG = 360.0


def _within_turn(angle_rad: FloatArray) -> FloatArray:
    """Angles in degrees from 0 to 360, a full turn staying one."""
    degrees = np.degrees(angle_rad)
    inside = (degrees >= 0.0) & (degrees <= FULL_TURN_DEG + 1e-6)
    return np.asarray(np.where(inside, degrees, np.mod(degrees, FULL_TURN_DEG)))


def draw_readings(recording: RotationRecording, places: Sequence[int], kind: str) -> Picture:
    """Readings of some load components over the angle with the harmonics fitted, and what these leave."""
    fit, calibration, title = recording.fit, recording.inverse[places], f"{recording.name}: {kind}, readings and fit"
    sense, angle = turning_sense(fit.angle_rad), np.radians(np.linspace(0.0, FULL_TURN_DEG, 361))
    residual, fitted, unit = (
        fit.residual @ calibration.T,
        fit.curve(angle) @ calibration.T,
        typeset(LOAD_UNITS[places[0]]),
    )
    with sheet(f"rotation-{recording.name}-{kind}", 4.6, 2, heights=(2.0, 1.0)) as drawn:
        upper, lower = drawn.panels
        scale, letter = prefix(residual, coarse=False)
        for c, place in enumerate(places):
            upper.plot(np.degrees(angle), fitted[:, c], color=COLOURS[c], linewidth=0.9, zorder=2)
            _draw_points(upper, fit.angle_rad, sense, recording.load[:, place], c, LOAD_COMPONENTS[place])
            _draw_points(lower, fit.angle_rad, sense, residual[:, c] / scale, c, "")
        lower.axhline(0.0, color=LIGHT, linewidth=0.8, zorder=1)
        upper.set_ylabel(f"load / {unit}" if "·" not in unit else f"load / ({unit})")
        lower.set_ylabel(f"residual / {letter}{unit}" if "·" not in unit else f"residual / ({letter}{unit})")
        panel_label(upper, title)
        panel_label(lower, "readings less fit")
        upper.legend(loc="lower right", ncols=3, bbox_to_anchor=(1.0, 1.0), borderaxespad=0.0)
        lower.set_xlim(-8.0, FULL_TURN_DEG + 8.0)
        lower.set_xticks(np.arange(0.0, FULL_TURN_DEG + 1.0, 45.0))
        lower.set_xlabel("angle of the head / °")
        caption = "Curves: offset and harmonics fitted to all channels in one solve."
        if np.ptp(sense) > 0.0:
            caption += " Filled: come to with the angle growing; open: with the angle falling."
        title = f"{recording.name}, {kind} over the angle of the head"
        return drawn.picture(title, caption, top=0.3, gap=(0.5, 0.3))


def draw_deviations(evaluation: RotationEvaluation) -> Picture | None:
    """Load mass by each axis and by all less the weighed mass in %, with U; None without both."""
    deviations = [q for q in evaluation.quantities if q.name == "load_mass_relative_deviation"]
    weighed = evaluation.find("weighed_mass", "stated")
    if not deviations or weighed is None:
        return None
    own = 100.0 * weighed.expanded / weighed.value
    with sheet("rotation-deviations", 2.5) as drawn:
        (axes,) = drawn.panels
        places = np.arange(len(deviations))
        axes.axhspan(-own, own, color=GREY, alpha=0.3, linewidth=0, zorder=1)
        axes.axhline(0.0, color=GREY, linewidth=0.8, zorder=1.5)
        expanded = [q.expanded for q in deviations]
        axes.errorbar(places, [q.value for q in deviations], expanded, fmt="o", color=BLACK, zorder=2)
        axes.set_xticks(places, [q.component for q in deviations])
        axes.set_xlim(-0.6, len(places) - 0.4)
        axes.set_ylabel("deviation / %")
        panel_label(axes, "load mass less weighed mass, with U")
        caption = "Bars: expanded uncertainty U of the difference. Grey: U of the weighed mass."
        return drawn.picture("Load mass against the weighed mass", caption, top=0.3)


def _draw_points(
    axes: Axes, angle_rad: FloatArray, sense: FloatArray, values: FloatArray, place: int, label: str
) -> None:
    """Readings (N,) of one component, filled where the angle grew and open where it fell."""
    degrees, rose = _within_turn(angle_rad), sense >= 0.0
    for here, filled in ((rose, True), (~rose, False)):
        if here.any():
            axes.plot(
                degrees[here],
                values[here],
                linestyle="none",
                marker=MARKERS[place],
                color=COLOURS[place],
                markerfacecolor=COLOURS[place] if filled else "white",
                markersize=4.0,
                markeredgewidth=0.9,
                label=label if filled or not rose.any() else None,
                zorder=3,
            )
