"""Figures of an identification: fitted curves, circles, sensitivity, and usable bands."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from fusion.base import K2
from fusion.report.figure import (
    BLACK,
    BLUE,
    COLOURS,
    GREEN,
    GREY,
    LIGHT,
    PURPLE,
    RED,
    Figure,
    Panel,
    draw_response,
    empty_figure,
    frame_bars,
    power_of_ten,
)
from fusion.sensor.identify.identification_evaluation import FEWEST_LINES, IdentifiedComponent
from fusion.sensor.identify.identification_inputs import mass_unit
from fusion.sensor.identify.joint_fit import SensitivityResult
from fusion.sensor.transfer.transfer_records import uncertainty
from shaker.frf.chain import common_covariance
from shaker.identification.sensor import NO_CHAIN, Load
from shakercal._common.arrays import BoolArray, ComplexArray, FloatArray
from shakercal._common.digits import number_text, typeset

STYLES = ((GREEN, True), (PURPLE, True), (BLACK, False))
"""Colour of each explanation of a sensitivity, and whether its line is dashed."""
NEAR_WIDTHS, CIRCLE_WIDTHS = 8.0, 4.0
"""Half-power widths on both sides of the resonances that the enlarged panels and the circles show."""
PANELS_ACROSS = 3
REGION = float(np.sqrt(-2.0 * np.log(0.05)))
"""Radius of the 95 % region of a complex error, in standard uncertainties of its parts: sqrt(-2 ln 0.05)."""
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
        """Return the lines (K,) within some half-power widths of the resonances."""
        low = min(f - widths * width for f, width in self.modes)
        high = max(f + widths * width for f, width in self.modes)
        return np.asarray((self.frequency_hz >= low) & (self.frequency_hz <= high))


def curve_figures(component: IdentifiedComponent) -> list[Figure]:
    """Return figures of every recording with enough lines, then all circles."""
    recordings = [
        [_curve(component, index, name) for name in item.measured.ratio.channels]
        for index, item in enumerate(component.fit.prepared)
        if len(item.measured.ratio.frequency_hz) >= FEWEST_LINES
    ]
    figures = [draw_fit(f"fit-{component.name}-{index}", curves) for index, curves in enumerate(recordings)]
    return [*figures, draw_circles(f"circles-{component.name}", [curve for curves in recordings for curve in curves])]


def _curve(component: IdentifiedComponent, index: int, response: str) -> FittedCurve:
    measured, identified = component.fit.prepared[index].measured, component.fit.identification
    one = measured.ratio.select([response])
    modes = [mode for mode in identified.modes if mode.record == measured.name]
    return FittedCurve(
        recording=measured.name,
        response=response,
        frequency_hz=one.frequency_hz,
        value=one.value[:, 0],
        model=identified.model[index][:, measured.ratio.channels.index(response)],
        u=np.sqrt(np.linalg.eigvalsh(one.covariance)[:, -1]),
        modes=tuple((mode.frequency_hz, 2.0 * mode.damping_ratio * mode.frequency_hz) for mode in modes),
    )


def draw_fit(name: str, curves: Sequence[FittedCurve]) -> Figure:
    """Draw all responses of one recording: magnitude, phase and residual, whole band and resonance."""
    drawn = empty_figure(name, 5.8, (1.7, 1.1, 1.0), 2)
    for column, zoom in enumerate((False, True)):
        upper, middle, lower = drawn.panels[column::2]
        for index, curve in enumerate(curves):
            near, colour = curve.near(NEAR_WIDTHS), COLOURS[index % len(COLOURS)]
            lines = near if zoom and np.count_nonzero(near) > 2 else np.ones(len(near), np.bool_)
            frequency, value, model = curve.frequency_hz[lines], curve.value[lines], curve.model[lines]
            draw_response(upper, middle, frequency, value, dots=zoom, colour=colour, label=curve.response)
            draw_response(upper, middle, frequency, model, colour=BLACK, dashed=True, label="joint model")
            scaled = np.abs(value - model) / (REGION * curve.u[lines])
            lower.points(frequency, scaled, curve.response, colour=colour, size=2.0 if zoom else 1.2)
        lower.rule(1.0, width=0.7, dashed=True)
        lower.x.label = "frequency / Hz"
        for panel, text in zip((upper, middle, lower), ("magnitude", "phase", "residual"), strict=True):
            panel.y.label = "" if zoom else {"magnitude": "|H|", "phase": "phase / °"}.get(text, text)
            panel.title = f"{text}, around the resonance" if zoom else text
    caption = (
        "Acceleration of the load over that of the base: measured (colours) and the joint model (black, dashed), "
        "the whole band left, the resonance right. Below: |measured − model| over the radius of the "
        "95 % region of the noise, corrected for common errors: 5 % of the lines are expected above one."
    )
    return drawn.with_title(f"{curves[0].recording}: curve, model and residual", caption, main=True)


def draw_circles(name: str, curves: Sequence[FittedCurve]) -> Figure:
    """Draw every curve in the complex plane around its resonances, with the model."""
    across = 2 if len(curves) in (2, 4) else min(len(curves), PANELS_ACROSS)
    down = -(-len(curves) // across)
    drawn = empty_figure(name, 0.75 + 3.0 * down, down, across, shared_x=False)
    for panel, curve in zip(drawn.panels, curves, strict=False):
        _draw_circle(panel, curve)
    for panel in drawn.panels[len(curves) :]:
        panel.blank = True
    caption = (
        f"Lines within {CIRCLE_WIDTHS:g} half-power widths of the resonances in the complex plane (dots), the "
        "joint model (line), and the frequencies of its modes (crosses)."
    )
    return drawn.with_title("Nyquist circles", caption)


def _draw_circle(panel: Panel, curve: FittedCurve) -> None:
    lines = curve.near(CIRCLE_WIDTHS)
    value, model, frequency = curve.value[lines], curve.model[lines], curve.frequency_hz[lines]
    for along in ("x", "y"):
        panel.rule(0.0, along=along, colour=LIGHT)
    names = tuple(f"{number_text(hertz, 6)} Hz" for hertz in frequency)
    panel.points(value.real, value.imag, "measured", colour=BLUE, size=2.4, names=names)
    panel.line(model.real, model.imag, "model", colour=RED, width=0.9)
    if len(frequency):
        at = [int(np.argmin(np.abs(frequency - f0))) for f0, _ in curve.modes]
        names = tuple(f"mode, {number_text(f0, 6)} Hz" for f0, _ in curve.modes)
        panel.points(model.real[at], model.imag[at], "modes", colour=BLACK, marker="x", size=6.0, names=names)
        reach = 0.55 * max(np.ptp(model.real), np.ptp(model.imag), 1e-12)
        middle = 0.5 * (model.real.max() + model.real.min()), 0.5 * (model.imag.max() + model.imag.min())
        panel.x.limits, panel.y.limits = ((float(at - reach), float(at + reach)) for at in middle)
    panel.equal = True
    panel.x.label, panel.y.label, panel.title = "Re H", "Im H", f"{curve.recording}, {curve.response}"


def sensitivity_figures(component: IdentifiedComponent) -> list[Figure]:
    """Return figures of the sensitivity with its explanations, and of the output over force."""
    explained = [] if component.sensitivity is None else [draw_explained(component, component.sensitivity)]
    return [*explained, *([draw_outputs_over_load(component)] if component.bands else [])]


def draw_explained(component: IdentifiedComponent, item: SensitivityResult) -> Figure:
    """Draw the sensitivity with U (k = 2), and the curves of spring and chain."""
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
    drawn = empty_figure(f"sensitivity-{component.name}", 4.6, (1.4, 1.0))
    upper, lower = drawn.panels
    for panel, value, reach in zip(drawn.panels, level, half, strict=True):
        look = {"half_y": reach, "colour": BLUE, "size": 3.5}
        panel.points(measured.frequency_hz, value, "measured, U (k = 2)", **look)
    for (words, _), line, (colour, dashed) in zip(curves, lines, STYLES, strict=False):
        for panel, value in zip(drawn.panels, line, strict=True):
            panel.line(hertz, value, words, colour=colour, dashed=dashed)
    shown = np.hstack([level, *lines]), np.hstack([half, *map(np.zeros_like, lines)])
    frame_bars(upper, lower, shown, f"{tens}{typeset(measured.unit)}", static)
    for panel in drawn.panels:
        panel.x.limits, panel.x.link = (0.0, float(hertz[-1])), "frequency"
    lower.x.label = "frequency / Hz"
    caption = (
        f"Complex sensitivity, {label}, and possible explanations: the sensor's spring and damper "
        "with k and b of the resonance (equations 1 and 2), the measuring chain, and both together."
    )
    return drawn.with_title(f"Sensitivity with model curves, {label}", caption, main=True)


def draw_outputs_over_load(component: IdentifiedComponent) -> Figure:
    """Draw the output over force of several load masses with the permitted error."""
    model, permitted = component.model, component.bands[0].permitted
    highest = max(model.resonance_hz(Load(kg, "force")) for kg in component.loads)
    hertz, unit = np.linspace(0.0, highest, POINTS), mass_unit(component.fit.component)
    drawn = empty_figure(f"bands-{component.name}", 3.3)
    (panel,) = drawn.panels
    panel.span(-100.0 * permitted, 100.0 * permitted, colour=GREY)
    for kg, band, colour in zip(component.loads, component.bands, COLOURS, strict=False):
        deviation = 100.0 * (np.abs(model.output_factor(hertz, Load(kg, "force")) / model.sensitivity) - 1.0)
        panel.line(hertz, deviation, f"{number_text(kg, 4)} {unit}", colour=colour)
        if np.isfinite(band.upper_hz):
            panel.rule(band.upper_hz, f"{number_text(kg, 4)} {unit}", along="x", colour=colour, dashed=True)
            if np.isnan(band.u_upper_hz):  # refuted by the data
                continue
            ends = (band.upper_hz - K2 * band.u_upper_hz, band.upper_hz + K2 * band.u_upper_hz)
            panel.span(*ends, f"{number_text(kg, 4)} {unit}", along="x", colour=colour)
    widest = max((band.upper_hz for band in component.bands if np.isfinite(band.upper_hz)), default=highest)
    panel.x.limits, panel.y.limits = (0.0, min(1.6 * widest, highest)), (-300.0 * permitted, 300.0 * permitted)
    panel.x.label, panel.y.label = "frequency / Hz", "output over force − 1 / %"
    panel.title = "uncorrected output, force applied to a load on a rigid base"
    caption = (
        "By how much the magnitude of the output departs from the force that acts on a load of the mass given, and "
        f"where it leaves ±{100.0 * permitted:.6g} % (dashed, U with k = 2 shaded): the usable band without correction."
    )
    return drawn.with_title("Usable band by load mass", caption)
