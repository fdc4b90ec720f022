"""Figures of an identification: curves with model and residual, and the circles of the resonances."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from matplotlib.axes import Axes
from matplotlib.ticker import FuncFormatter, LogLocator, MaxNLocator, NullFormatter
from numpy.typing import NDArray

from fusion.plots.style import (
    BLACK,
    BLUE,
    GREEN,
    LIGHT,
    ORANGE,
    PURPLE,
    RED,
    SKY,
    FloatArray,
    Picture,
    drawing,
    finish,
    lay_out,
    new_figure,
    panel_label,
)
from shaker._checks import ComplexArray

COLOURS = (BLUE, GREEN, ORANGE, PURPLE, SKY)
NEAR_WIDTHS = 8.0  # half-power widths on both sides of the resonances that the enlarged panels show
CIRCLE_WIDTHS = 4.0
PANELS_ACROSS = 3
REGION = float(np.sqrt(-2.0 * np.log(0.05)))
"""Radius of the circle that holds a complex error 95 times in 100, in standard uncertainties of its parts."""
RASTER_ABOVE = 1500


@dataclass(frozen=True)
class FittedCurve:
    """One response over the base at K lines with the model fitted.

    `value`, `model` (K,); `u` (K,): noise of the residual, standard uncertainty of its larger part; `modes`: frequency
    and half-power width of every mode, Hz.
    """

    recording: str
    response: str
    frequency_hz: FloatArray
    value: ComplexArray
    model: ComplexArray
    u: FloatArray
    modes: tuple[tuple[float, float], ...]

    @property
    def near(self) -> NDArray[np.bool_]:
        """Lines around the resonances (K,)."""
        low = min(f - NEAR_WIDTHS * width for f, width in self.modes)
        high = max(f + NEAR_WIDTHS * width for f, width in self.modes)
        return np.asarray((self.frequency_hz >= low) & (self.frequency_hz <= high))


def draw_fit(name: str, curves: Sequence[FittedCurve]) -> Picture:
    """All responses of one recording: magnitude, phase and residual, the whole band left and the resonance right."""
    with drawing(name):
        figure = new_figure(5.6)
        panels = figure.subplots(3, 2, sharex="col", gridspec_kw={"height_ratios": [1.7, 1.1, 1.0]})
        for column, zoom in enumerate((False, True)):
            for place, curve in enumerate(curves):
                lines = curve.near if zoom and np.count_nonzero(curve.near) > 2 else np.ones(len(curve.value), np.bool_)
                _draw_curve(panels[:, column], curve, lines, COLOURS[place % len(COLOURS)], dots=zoom)
            _label_column(panels[:, column], zoom=zoom)
        panels[0, 0].set_ylabel("|H|")
        panels[1, 0].set_ylabel("phase / °")
        panels[2, 0].set_ylabel("residual")
        panels[0, 0].legend(loc="upper left")
        for axes in panels.ravel():
            axes.set_rasterization_zorder(3 if len(curves[0].value) > RASTER_ABOVE else -1)
        lay_out(figure, panels.ravel(), top=0.24, gap=(0.55, 0.28), left=0.78, label=0.56)
        caption = (
            "Acceleration of the load over that of the base: measured (colours) and the joint model (black, dashed), "
            "the whole band left, the resonance right. Below: |measured − model| over the radius that holds "
            "the noise 95 times in 100, the common errors found taken off: 5 % of the lines are expected above one."
        )
        return finish(figure, name, f"{curves[0].recording}: curve, model and residual", caption)


def draw_circles(name: str, curves: Sequence[FittedCurve]) -> Picture:
    """Every curve in the complex plane around its resonances, with the model."""
    across = 2 if len(curves) in (2, 4) else min(len(curves), PANELS_ACROSS)
    down = -(-len(curves) // across)
    with drawing(name):
        figure = new_figure(0.55 + 3.0 * down)
        panels = figure.subplots(down, across, squeeze=False)
        for axes, curve in zip(panels.ravel(), curves, strict=False):
            _draw_circle(axes, curve)
        for axes in panels.ravel()[len(curves) :]:
            axes.set_visible(False)
        panels[0, 0].legend(loc="center")
        lay_out(figure, panels.ravel(), top=0.4, gap=(0.62, 0.85), left=0.72, label=0.5)
        caption = (
            f"Lines within {CIRCLE_WIDTHS:g} half-power widths of the resonances in the complex plane (dots), the "
            "joint model (line), and the frequencies of its modes (crosses)."
        )
        return finish(figure, name, "Nyquist circles", caption)


def _draw_curve(
    panels: Sequence[Axes], curve: FittedCurve, lines: NDArray[np.bool_], colour: str, *, dots: bool
) -> None:
    """One response in the three panels of a column."""
    frequency, value, model = curve.frequency_hz[lines], curve.value[lines], curve.model[lines]
    style = {"marker": ".", "markersize": 3.0, "linestyle": "none"} if dots else {"linewidth": 0.9}
    dash = (0, (4, 2))
    for axes, measured, fitted in (
        (panels[0], np.abs(value), np.abs(model)),
        (panels[1], _unbroken(np.degrees(np.angle(value))), _unbroken(np.degrees(np.angle(model)))),
    ):
        axes.plot(frequency, measured, color=colour, label=curve.response, zorder=2, **style)
        axes.plot(frequency, fitted, color=BLACK, linewidth=0.9, linestyle=dash, zorder=2.5)
    away = np.abs(value - model) / (REGION * curve.u[lines])
    panels[2].plot(frequency, away, ".", color=colour, markersize=2.5 if dots else 1.2, zorder=2)


def _label_column(panels: Sequence[Axes], *, zoom: bool) -> None:
    """Scales and labels of one column."""
    panels[0].set_yscale("log")
    panels[0].yaxis.set_major_locator(LogLocator(10.0, subs=(1.0, 2.0, 5.0), numticks=8))
    panels[0].yaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
    panels[0].yaxis.set_minor_formatter(NullFormatter())
    panels[1].set_ylim(-190.0, 190.0)
    panels[1].set_yticks([-180, -90, 0, 90, 180])
    panels[2].axhline(1.0, color=RED, linewidth=0.7, linestyle=(0, (4, 2)), zorder=1.5)
    panels[2].set_ylim(bottom=0.0)
    panels[2].yaxis.set_major_locator(MaxNLocator(4))
    panels[2].set_xlabel("frequency / Hz")
    panels[2].margins(x=0.01)
    for axes, text in zip(panels, ("magnitude", "phase", "residual"), strict=True):
        panel_label(axes, f"{text}, around the resonance" if zoom else text)


def _unbroken(phase: FloatArray) -> FloatArray:
    """Phase without strokes across the wrap."""
    return np.asarray(np.where(np.abs(np.diff(phase, prepend=phase[0])) > 180.0, np.nan, phase))


def _draw_circle(axes: Axes, curve: FittedCurve) -> None:
    """One curve in the complex plane."""
    low = min(f - CIRCLE_WIDTHS * width for f, width in curve.modes)
    high = max(f + CIRCLE_WIDTHS * width for f, width in curve.modes)
    lines = (curve.frequency_hz >= low) & (curve.frequency_hz <= high)
    value, model, frequency = curve.value[lines], curve.model[lines], curve.frequency_hz[lines]
    for zero in (axes.axhline, axes.axvline):
        zero(0.0, color=LIGHT, linewidth=0.8, zorder=1)
    axes.plot(value.real, value.imag, ".", color=BLUE, markersize=3.5, label="measured", zorder=2)
    axes.plot(model.real, model.imag, color=RED, linewidth=0.9, label="model", zorder=2.5)
    for f0, _ in curve.modes:
        if len(frequency):
            place = int(np.argmin(np.abs(frequency - f0)))
            axes.plot(model.real[place], model.imag[place], "x", color=BLACK, markersize=6.0, zorder=3)
    if len(frequency):
        reach = 0.55 * max(np.ptp(model.real), np.ptp(model.imag), 1e-12)
        middle = 0.5 * (model.real.max() + model.real.min()), 0.5 * (model.imag.max() + model.imag.min())
        axes.set_xlim(middle[0] - reach, middle[0] + reach)
        axes.set_ylim(middle[1] - reach, middle[1] + reach)
    axes.set_aspect("equal", adjustable="box")
    axes.xaxis.set_major_locator(MaxNLocator(5))
    axes.yaxis.set_major_locator(MaxNLocator(5))
    axes.set_xlabel("Re H")
    axes.set_ylabel("Im H")
    panel_label(axes, f"{curve.recording}\n{curve.response}")
