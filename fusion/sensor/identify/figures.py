"""Figures of an identification."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from matplotlib.axes import Axes
from matplotlib.ticker import FuncFormatter, LogLocator, MaxNLocator, NullFormatter
from numpy.typing import NDArray

from fusion.base import typeset
from fusion.report.style import (
    BLACK,
    BLUE,
    GREEN,
    GREY,
    LIGHT,
    ORANGE,
    PURPLE,
    RED,
    SKY,
    Picture,
    drawing,
    finish,
    lay_out,
    new_figure,
    padded,
    panel_label,
    power_text,
    static_axis,
)
from fusion.sensor.identify.evaluate import FEWEST_LINES, ComponentResult
from fusion.sensor.identify.fit import SensitivityResult
from fusion.sensor.transfer.figures import uncertainty
from shaker.arrays import ComplexArray, FloatArray
from shaker.frf.chain import common_covariance
from shaker.identification.sensor import NO_CHAIN, Load

# Figures of an identification: curves with model and residual, and the circles of the resonances.


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


# Figures of the sensitivity over frequency with its explanations, and of what a load mass does to the output.


LOADS = (BLUE, ORANGE, GREEN, PURPLE, SKY, GREY)
COVERAGE = 2.0
STYLES = ((GREEN, (0, (2, 2))), (PURPLE, (0, (6, 2))), (BLACK, "solid"))


@dataclass(frozen=True)
class ExplainedSensitivity:
    """Sensitivity of one output at K lines with `u_magnitude`, `u_phase_rad` (K,), and the curves of explanations.

    `label`: "output Fz per Fz"; `curve_hz` (L,); `curves`: words and complex values (L,); `static`: None where unknown.
    """

    label: str
    unit: str
    frequency_hz: FloatArray
    value: ComplexArray
    u_magnitude: FloatArray
    u_phase_rad: FloatArray
    static: float | None
    curve_hz: FloatArray
    curves: tuple[tuple[str, ComplexArray], ...]


@dataclass(frozen=True)
class LoadedOutput:
    """What the output says over the force for one load mass, in `unit`: `ratio` (L,) of magnitudes, band within which
    it departs by no more than what is permitted.
    """

    load: float
    unit: str
    frequency_hz: FloatArray
    ratio: FloatArray
    band_hz: float


def draw_explained(name: str, item: ExplainedSensitivity) -> Picture:
    """Magnitude and phase with the curves that the spring, the chain and both would give."""
    power = int(np.floor(np.log10(float(np.abs(item.value).max()))))
    factor = 1.0 if -2 <= power < 4 else 10.0**power
    sign = np.sign(item.curves[0][1][0].real)
    with drawing(name):
        figure = new_figure(4.6)
        upper, lower = figure.subplots(2, 1, sharex=True, gridspec_kw={"height_ratios": [1.4, 1.0]})
        size, u_size = np.abs(item.value) / factor, COVERAGE * item.u_magnitude / factor
        phase = np.angle(item.value * sign)
        bars = {"fmt": "o", "color": BLUE, "markersize": 3.5, "elinewidth": 0.9, "zorder": 2.5}
        upper.errorbar(item.frequency_hz, size, u_size, label="measured, U (k = 2)", **bars)
        lower.errorbar(item.frequency_hz, phase, COVERAGE * item.u_phase_rad, **bars)
        for (words, curve), (colour, dash) in zip(item.curves, STYLES, strict=False):
            upper.plot(item.curve_hz, np.abs(curve) / factor, color=colour, linestyle=dash, label=words, zorder=2)
            lower.plot(item.curve_hz, np.angle(curve * sign), color=colour, linestyle=dash, zorder=2)
        ends = [*(size - u_size), *(size + u_size), *(np.abs(curve).min() / factor for _, curve in item.curves)]
        ends += [] if item.static is None else [abs(item.static) / factor]
        upper.set_ylim(padded(min(ends), max(ends)))
        upper.set_ylabel(f"magnitude / {f'{power_text(power)} ' if factor != 1.0 else ''}{typeset(item.unit)}")
        lower.set_ylabel("phase / rad")
        lower.set_xlabel("frequency / Hz")
        lower.axhline(0.0, color=GREY, linewidth=0.7)
        upper.set_xlim(0.0, float(item.curve_hz[-1]))
        if item.static is not None:
            static_axis(upper, abs(item.static) / factor, "static")
        upper.legend(loc="lower left")
        lay_out(figure, [upper, lower], right=0.75, left=0.8, label=0.62)
        caption = (
            f"Complex sensitivity, {item.label}, and what would make it fall: the sensor's spring and damper alone "
            "with k and b of the resonance (equations 1 and 2), the measuring chain alone, and both together."
        )
        return finish(figure, name, f"Sensitivity with model curves, {item.label}", caption)


def draw_outputs_over_load(name: str, loads: Sequence[LoadedOutput], permitted: float) -> Picture:
    """Output over force of several load masses, and how far it stays within the error permitted."""
    with drawing(name):
        figure = new_figure(3.3)
        axes = figure.subplots()
        axes.axhspan(-100.0 * permitted, 100.0 * permitted, color=GREY, alpha=0.15, linewidth=0, zorder=1)
        for load, colour in zip(loads, LOADS, strict=False):
            away = 100.0 * (load.ratio - 1.0)
            axes.plot(load.frequency_hz, away, color=colour, label=f"{load.load:.4g} {load.unit}", zorder=2)
            if np.isfinite(load.band_hz):
                axes.axvline(load.band_hz, color=colour, linewidth=0.8, linestyle=(0, (3, 2)), zorder=1.5)
        _limit(axes, loads, permitted)
        axes.set_xlabel("frequency / Hz")
        axes.set_ylabel("output over force − 1 / %")
        axes.legend(loc="upper left")
        panel_label(axes, "uncorrected output, force applied to a load on a rigid base")
        lay_out(figure, [axes], top=0.24)
        caption = (
            "By how much the magnitude of the output departs from the force that acts on a load of the mass given, and "
            f"where it leaves ±{100.0 * permitted:g} % (dashed): the usable band without correction."
        )
        return finish(figure, name, "Usable band by load mass", caption)


def _limit(axes: Axes, loads: Sequence[LoadedOutput], permitted: float) -> None:
    """Limits of three times the error permitted, up to a little beyond the widest band."""
    axes.set_ylim(-300.0 * permitted, 300.0 * permitted)
    bands = [load.band_hz for load in loads if np.isfinite(load.band_hz)]
    highest = 1.6 * max(bands) if bands else float(loads[0].frequency_hz[-1])
    axes.set_xlim(0.0, min(highest, float(loads[0].frequency_hz[-1])))
    axes.yaxis.set_major_locator(MaxNLocator(7))


# The figures of an identification's page, from its results.


_POINTS = 400


def curve_pictures(component: ComponentResult) -> list[Picture]:
    """Curve, model and residual of every recording, then all circles."""
    groups = [list(curves) for curves in _curves(component)]
    name = component.name
    found = [draw_fit(f"fit-{name}-{place}", curves) for place, curves in enumerate(groups)]
    return [*found, draw_circles(f"circles-{name}", [curve for curves in groups for curve in curves])]


def sensitivity_pictures(component: ComponentResult) -> list[Picture]:
    """Sensitivity with its explanations, and the output over force of every load."""
    found = []
    if component.sensitivity is not None:
        found.append(draw_explained(f"sensitivity-{component.name}", _explained(component, component.sensitivity)))
    if component.bands:
        permitted = component.bands[0].permitted
        found.append(draw_outputs_over_load(f"bands-{component.name}", _loaded(component), permitted))
    return found


def _curves(component: ComponentResult) -> Iterator[Iterator[FittedCurve]]:
    """The curves of every recording with lines enough to be drawn."""
    for place, item in enumerate(component.fit.prepared):
        if len(item.measured.ratio.frequency_hz) >= FEWEST_LINES:
            yield (_curve(component, place, name) for name in item.measured.ratio.channels)


def _curve(component: ComponentResult, place: int, response: str) -> FittedCurve:
    """One response of one recording."""
    measured, found = component.fit.prepared[place].measured, component.fit.identification
    column = measured.ratio.channels.index(response)
    one = measured.ratio.select([response])
    modes = [mode for mode in found.modes if mode.record == measured.name]
    return FittedCurve(
        recording=measured.name,
        response=response,
        frequency_hz=one.frequency_hz,
        value=one.value[:, 0],
        model=found.model[place][:, column],
        u=np.sqrt(np.linalg.eigvalsh(one.covariance)[:, -1]),
        modes=tuple((mode.frequency_hz, 2.0 * mode.damping_ratio * mode.frequency_hz) for mode in modes),
    )


def _explained(component: ComponentResult, item: SensitivityResult) -> ExplainedSensitivity:
    """The sensitivity with three curves: spring alone, chain alone, both."""
    measured, comparison = item.measured, item.comparison
    covariance = measured.covariance
    if measured.errors:
        relative = np.stack([error.relative for error in measured.errors])
        covariance = covariance + common_covariance(measured.value[:, None], relative)
    u_relative, u_phase = uncertainty(measured.value, covariance)
    frequency = np.linspace(0.0, 1.08 * float(measured.frequency_hz[-1]), _POINTS)
    best = comparison.best
    s = 2j * np.pi * frequency
    spring = best.sensitivity / (1.0 + s * component.model.damping / component.model.stiffness)
    curves = [("spring and damper of the resonance alone", np.asarray(spring, dtype=np.complex128))]
    if best.chain.kind != NO_CHAIN.kind:
        curves.append(("chain alone", np.asarray(best.sensitivity * best.chain.response(frequency))))
        curves.append(("both", best.model(frequency)))
    return ExplainedSensitivity(
        label=f"output {measured.channel} per {measured.component}",
        unit=measured.unit,
        frequency_hz=measured.frequency_hz,
        value=measured.value,
        u_magnitude=u_relative * np.abs(measured.value),
        u_phase_rad=u_phase,
        static=measured.static,
        curve_hz=frequency,
        curves=tuple(curves),
    )


def _loaded(component: ComponentResult) -> list[LoadedOutput]:
    """Output over force for every load."""
    highest = max(component.model.resonance_hz(Load(kg, "force")) for kg in component.loads)
    frequency = np.linspace(0.0, highest, _POINTS)
    unit = "kg" if component.fit.component < 3 else "kg·m²"
    found = []
    for kg, band in zip(component.loads, component.bands, strict=True):
        ratio = np.abs(component.model.output_factor(frequency, Load(kg, "force")) / component.model.sensitivity)
        found.append(LoadedOutput(kg, unit, frequency, ratio, band.upper_hz))
    return found
