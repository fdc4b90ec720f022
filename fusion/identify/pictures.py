"""The figures of an identification's page, from its results."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from fusion.identify.readings import FEWEST_LINES
from fusion.identify.result import ComponentResult
from fusion.identify.sensor import SensitivityResult
from fusion.plots.identify import FittedCurve, draw_circles, draw_fit
from fusion.plots.identify_sensitivity import (
    ExplainedSensitivity,
    LoadedOutput,
    draw_explained,
    draw_outputs_over_load,
)
from fusion.plots.style import Picture
from fusion.plots.transfer import uncertainty
from shaker.models.sensor.chain_shape import NO_CHAIN
from shaker.models.sensor.sensor_model import Load
from shaker.signals.chain import common_covariance

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
