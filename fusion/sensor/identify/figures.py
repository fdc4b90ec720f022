"""Figures of an identification: curves with model and residual, circles, sensitivity with its explanations, bands."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.ticker import MaxNLocator

from fusion.base import K2
from fusion.report.style import (
    BLACK,
    BLUE,
    COLOURS,
    GREEN,
    GREY,
    LIGHT,
    PURPLE,
    RED,
    Picture,
    draw_response,
    frame_bars,
    panel_label,
    plain_logarithm,
    power_of_ten,
    sheet,
)
from fusion.sensor.identify.evaluate import FEWEST_LINES, ComponentResult
from fusion.sensor.identify.fit import SensitivityResult
from fusion.sensor.identify.measured import mass_unit
from fusion.sensor.transfer.records import uncertainty
from shaker.arrays import BoolArray, ComplexArray, FloatArray
from shaker.frf.chain import common_covariance
from shaker.identification.sensor import NO_CHAIN, Load
from shaker.labels import typeset

STYLES = ((GREEN, (0, (2, 2))), (PURPLE, (0, (6, 2))), (BLACK, "solid"))
DASHED = (0, (4, 2))
NEAR_WIDTHS, CIRCLE_WIDTHS = 8.0, 4.0
"""Half-power widths on both sides of the resonances that the enlarged panels and the circles show."""
PANELS_ACROSS = 3
REGION = float(np.sqrt(-2.0 * np.log(0.05)))
"""Radius of the circle that holds a complex error 95 times in 100, in standard uncertainties of its parts."""
RASTER_ABOVE = 1500
POINTS = 400


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

    def near(self, widths: float) -> BoolArray:
        """Lines (K,) within some half-power widths of the resonances."""
        low = min(f - widths * width for f, width in self.modes)
        high = max(f + widths * width for f, width in self.modes)
        return np.asarray((self.frequency_hz >= low) & (self.frequency_hz <= high))


def curve_pictures(component: ComponentResult) -> list[Picture]:
    """Curve, model and residual of every recording with lines enough to be drawn, then all circles."""
    recordings = [
        [_curve(component, place, name) for name in item.measured.ratio.channels]
        for place, item in enumerate(component.fit.prepared)
        if len(item.measured.ratio.frequency_hz) >= FEWEST_LINES
    ]
    pictures = [draw_fit(f"fit-{component.name}-{place}", curves) for place, curves in enumerate(recordings)]
    return [*pictures, draw_circles(f"circles-{component.name}", [curve for curves in recordings for curve in curves])]


def _curve(component: ComponentResult, place: int, response: str) -> FittedCurve:
    measured, identified = component.fit.prepared[place].measured, component.fit.identification
    one = measured.ratio.select([response])
    modes = [mode for mode in identified.modes if mode.record == measured.name]
    return FittedCurve(
        recording=measured.name,
        response=response,
        frequency_hz=one.frequency_hz,
        value=one.value[:, 0],
        model=identified.model[place][:, measured.ratio.channels.index(response)],
        u=np.sqrt(np.linalg.eigvalsh(one.covariance)[:, -1]),
        modes=tuple((mode.frequency_hz, 2.0 * mode.damping_ratio * mode.frequency_hz) for mode in modes),
    )


def draw_fit(name: str, curves: Sequence[FittedCurve]) -> Picture:
    """All responses of one recording: magnitude, phase and residual, the whole band left and the resonance right."""
    with sheet(name, 5.6, 3, 2, heights=(1.7, 1.1, 1.0)) as drawn:
        for column, zoom in enumerate((False, True)):
            upper, middle, lower = drawn.panels[column::2]
            for place, curve in enumerate(curves):
                near, colour = curve.near(NEAR_WIDTHS), COLOURS[place % len(COLOURS)]
                lines = near if zoom and np.count_nonzero(near) > 2 else np.ones(len(near), np.bool_)
                frequency, value, model = curve.frequency_hz[lines], curve.value[lines], curve.model[lines]
                dots: dict[str, Any] = {"marker": ".", "markersize": 3.0, "linestyle": "none"} if zoom else {}
                draw_response(upper, middle, frequency, value, color=colour, label=curve.response, **dots)
                draw_response(upper, middle, frequency, model, color=BLACK, linestyle=DASHED, zorder=2.5)
                away = np.abs(value - model) / (REGION * curve.u[lines])
                lower.plot(frequency, away, ".", color=colour, markersize=2.5 if zoom else 1.2, zorder=2)
            plain_logarithm(upper.yaxis)
            lower.axhline(1.0, color=BLACK, linewidth=0.7, linestyle=DASHED, zorder=1.5)
            lower.set_ylim(bottom=0.0)
            lower.yaxis.set_major_locator(MaxNLocator(4))
            lower.set_xlabel("frequency / Hz")
            lower.margins(x=0.01)
            for axes, text in zip((upper, middle, lower), ("magnitude", "phase", "residual"), strict=True):
                axes.set_ylabel("" if zoom else {"magnitude": "|H|", "phase": "phase / °"}.get(text, text))
                axes.set_rasterization_zorder(3 if len(curves[0].value) > RASTER_ABOVE else -1)
                panel_label(axes, f"{text}, around the resonance" if zoom else text)
        drawn.panels[0].legend(loc="upper left")
        caption = (
            "Acceleration of the load over that of the base: measured (colours) and the joint model (black, dashed), "
            "the whole band left, the resonance right. Below: |measured − model| over the radius that holds "
            "the noise 95 times in 100, the common errors found taken off: 5 % of the lines are expected above one."
        )
        title = f"{curves[0].recording}: curve, model and residual"
        return drawn.picture(title, caption, gap=(0.55, 0.28), label=0.56)


def draw_circles(name: str, curves: Sequence[FittedCurve]) -> Picture:
    """Every curve in the complex plane around its resonances, with the model."""
    across = 2 if len(curves) in (2, 4) else min(len(curves), PANELS_ACROSS)
    down = -(-len(curves) // across)
    with sheet(name, 0.55 + 3.0 * down, down, across, sharex=False) as drawn:
        for axes, curve in zip(drawn.panels, curves, strict=False):
            _draw_circle(axes, curve)
        for axes in drawn.panels[len(curves) :]:
            axes.set_visible(False)
        drawn.panels[0].legend(loc="center")
        caption = (
            f"Lines within {CIRCLE_WIDTHS:g} half-power widths of the resonances in the complex plane (dots), the "
            "joint model (line), and the frequencies of its modes (crosses)."
        )
        return drawn.picture("Nyquist circles", caption, top=0.4, gap=(0.62, 0.85), left=0.72, label=0.5)


def _draw_circle(axes: Axes, curve: FittedCurve) -> None:
    lines = curve.near(CIRCLE_WIDTHS)
    value, model, frequency = curve.value[lines], curve.model[lines], curve.frequency_hz[lines]
    for zero in (axes.axhline, axes.axvline):
        zero(0.0, color=LIGHT, linewidth=0.8, zorder=1)
    axes.plot(value.real, value.imag, ".", color=BLUE, markersize=3.5, label="measured", zorder=2)
    axes.plot(model.real, model.imag, color=RED, linewidth=0.9, label="model", zorder=2.5)
    if len(frequency):
        for f0, _ in curve.modes:
            place = int(np.argmin(np.abs(frequency - f0)))
            axes.plot(model.real[place], model.imag[place], "x", color=BLACK, markersize=6.0, zorder=3)
        reach = 0.55 * max(np.ptp(model.real), np.ptp(model.imag), 1e-12)
        middle = 0.5 * (model.real.max() + model.real.min()), 0.5 * (model.imag.max() + model.imag.min())
        axes.set_xlim(middle[0] - reach, middle[0] + reach)
        axes.set_ylim(middle[1] - reach, middle[1] + reach)
    axes.set_aspect("equal", adjustable="box")
    for axis in (axes.xaxis, axes.yaxis):
        axis.set_major_locator(MaxNLocator(5))
    axes.set_xlabel("Re H")
    axes.set_ylabel("Im H")
    panel_label(axes, f"{curve.recording}\n{curve.response}")


def sensitivity_pictures(component: ComponentResult) -> list[Picture]:
    """Sensitivity with its explanations, and the output over force of every load."""
    explained = [] if component.sensitivity is None else [draw_explained(component, component.sensitivity)]
    return [*explained, *([draw_outputs_over_load(component)] if component.bands else [])]


def draw_explained(component: ComponentResult, item: SensitivityResult) -> Picture:
    """Magnitude and phase of the sensitivity with U (k = 2), and what spring, chain and both would make of it."""
    measured, best = item.measured, item.comparison.best
    covariance = measured.covariance
    if measured.errors:
        relative = np.stack([error.relative for error in measured.errors])
        covariance = covariance + common_covariance(measured.value[:, None], relative)
    u_relative, u_phase = uncertainty(measured.value, covariance)
    hertz = np.linspace(0.0, 1.08 * float(measured.frequency_hz[-1]), POINTS)
    lag = 2j * np.pi * hertz * component.model.damping / component.model.stiffness
    curves = [("spring and damper of the resonance alone", np.asarray(best.sensitivity / (1.0 + lag)))]
    if best.chain.kind != NO_CHAIN.kind:
        curves.append(("chain alone", np.asarray(best.sensitivity * best.chain.response(hertz))))
        curves.append(("both", best.model(hertz)))
    label = f"output {measured.channel} per {measured.component}"
    sign, (factor, tens) = np.sign(curves[0][1][0].real), power_of_ten(np.abs(measured.value))
    size = np.abs(measured.value) / factor
    level = np.stack([size, np.angle(measured.value * sign)])
    half = K2 * np.stack([u_relative * size, u_phase])
    lines = [np.stack([np.abs(curve) / factor, np.angle(curve * sign)]) for _, curve in curves]
    static = None if measured.static is None else (abs(measured.static) / factor, "static")
    with sheet(f"sensitivity-{component.name}", 4.6, 2, heights=(1.4, 1.0)) as drawn:
        upper, lower = drawn.panels
        bars: dict[str, Any] = {"fmt": "o", "color": BLUE, "markersize": 3.5, "elinewidth": 0.9, "zorder": 2.5}
        upper.errorbar(measured.frequency_hz, level[0], half[0], label="measured, U (k = 2)", **bars)
        lower.errorbar(measured.frequency_hz, level[1], half[1], **bars)
        for (words, _), line, (colour, dash) in zip(curves, lines, STYLES, strict=False):
            upper.plot(hertz, line[0], color=colour, linestyle=dash, label=words, zorder=2)
            lower.plot(hertz, line[1], color=colour, linestyle=dash, zorder=2)
        shown = np.hstack([level, *lines]), np.hstack([half, *map(np.zeros_like, lines)])
        frame_bars(upper, lower, shown, f"{tens}{typeset(measured.unit)}", static)
        upper.set_xlim(0.0, float(hertz[-1]))
        lower.set_xlabel("frequency / Hz")
        upper.legend(loc="lower left")
        caption = (
            f"Complex sensitivity, {label}, and what would make it fall: the sensor's spring and damper alone "
            "with k and b of the resonance (equations 1 and 2), the measuring chain alone, and both together."
        )
        title = f"Sensitivity with model curves, {label}"
        return drawn.picture(title, caption, top=0.12, right=0.75, left=0.8, label=0.62)


def draw_outputs_over_load(component: ComponentResult) -> Picture:
    """Output over force of several load masses, and how far it stays within the error permitted."""
    model, permitted = component.model, component.bands[0].permitted
    highest = max(model.resonance_hz(Load(kg, "force")) for kg in component.loads)
    hertz, unit = np.linspace(0.0, highest, POINTS), mass_unit(component.fit.component)
    with sheet(f"bands-{component.name}", 3.3) as drawn:
        (axes,) = drawn.panels
        axes.axhspan(-100.0 * permitted, 100.0 * permitted, color=GREY, alpha=0.15, linewidth=0, zorder=1)
        for kg, band, colour in zip(component.loads, component.bands, COLOURS, strict=False):
            away = 100.0 * (np.abs(model.output_factor(hertz, Load(kg, "force")) / model.sensitivity) - 1.0)
            axes.plot(hertz, away, color=colour, label=f"{kg:.4g} {unit}", zorder=2)
            if np.isfinite(band.upper_hz):
                axes.axvline(band.upper_hz, color=colour, linewidth=0.8, linestyle=(0, (3, 2)), zorder=1.5)
        widest = max((band.upper_hz for band in component.bands if np.isfinite(band.upper_hz)), default=highest)
        axes.set_xlim(0.0, min(1.6 * widest, highest))
        axes.set_ylim(-300.0 * permitted, 300.0 * permitted)
        axes.yaxis.set_major_locator(MaxNLocator(7))
        axes.set_xlabel("frequency / Hz")
        axes.set_ylabel("output over force − 1 / %")
        axes.legend(loc="upper left")
        panel_label(axes, "uncorrected output, force applied to a load on a rigid base")
        caption = (
            "By how much the magnitude of the output departs from the force that acts on a load of the mass given, and "
            f"where it leaves ±{100.0 * permitted:g} % (dashed): the usable band without correction."
        )
        return drawn.picture("Usable band by load mass", caption, left=0.72, label=0.52)
