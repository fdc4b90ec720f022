"""The sensor of one component as a correction needs it: spring and damper of the joint fit, chain of S(f)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from fusion.errors import ARGUMENT, ComputeError
from fusion.identify.fit import JointFit, mass_name
from fusion.load import LOAD_COMPONENTS
from fusion.manifest import Sensor
from fusion.notices import Notice
from fusion.results_csv import sensitivity_unit
from shaker._checks import FloatArray
from shaker.models.measured import MeasuredSensitivity
from shaker.models.sensor.chain_shape import NO_CHAIN
from shaker.models.sensor.sensor_model import SensorModel, sensor_model
from shaker.models.sensor.sensor_response import SensitivityComparison, fit_sensitivity
from shaker.models.sensor.spring_damper import SpringPrior
from shaker.notice import Severity

_FEWEST_LINES = 4


@dataclass(frozen=True)
class SensitivityResult:
    """The sensitivity of one output over frequency, as measured and as explained."""

    measured: MeasuredSensitivity
    comparison: SensitivityComparison


@dataclass(frozen=True)
class Modelled:
    """The model of one component, the frequencies from data of which it comes, and its sensitivity where measured."""

    model: SensorModel
    range_hz: tuple[float, float]
    sensitivity: SensitivityResult | None
    notices: tuple[Notice, ...]


def modelled(fit: JointFit, measured: MeasuredSensitivity | None, sensor: Sensor | None) -> Modelled:
    """Return the model of a component with the chain that its sensitivity supports, or with none."""
    found, covariance = mechanics(fit)
    if measured is None or len(measured.frequency_hz) < _FEWEST_LINES:
        return _without_sensitivity(fit, found, covariance, sensor)
    r_kb = covariance[0, 1] / np.sqrt(covariance[0, 0] * covariance[1, 1]) if covariance[0, 1] != 0.0 else 0.0
    u_k, u_b = (float(np.sqrt(covariance[place, place])) for place in (0, 1))
    spring = SpringPrior(float(found[0]), u_k, float(found[1]), u_b, float(r_kb))
    try:
        comparison = fit_sensitivity(measured, spring)
        model = sensor_model(comparison.best, found, covariance)
    except (ValueError, np.linalg.LinAlgError) as error:
        reason = ARGUMENT.sub("", str(error))
        text = f"the sensitivity of {measured.channel} over frequency was not explained ({reason})"
        bare = _without_sensitivity(fit, found, covariance, sensor)
        return Modelled(bare.model, bare.range_hz, None, (*bare.notices, Notice("warning", text, measured.channel)))
    range_hz = (float(measured.frequency_hz[0]), float(measured.frequency_hz[-1]))
    notices = _verdicts(comparison, f"sensitivity {measured.component}")
    return Modelled(model, range_hz, SensitivityResult(measured, comparison), notices)


def _verdicts(comparison: SensitivityComparison, where: str) -> tuple[Notice, ...]:
    """Say which explanation the data support, and whether the damping found contradicts the resonance."""
    supported = Notice("info", _clause(comparison.text), where)
    if comparison.damping is None:
        return (supported,)
    severity: Severity = "warning" if comparison.damping.contradicts else "info"
    return supported, Notice(severity, _clause(comparison.damping.text), where)


def mechanics(fit: JointFit) -> tuple[FloatArray, FloatArray]:
    """Return [k, b, m_i] (3,) of a joint fit and their covariance (3, 3).

    Of a damping for each recording it is the mean, as uncertain as the dampings scatter.
    """
    found, axis = fit.identification, fit.axis
    dampers = [i for i, name in enumerate(found.names) if name.partition(": ")[0] == f"damping_{axis}"]
    pick = np.zeros((3, len(found.names)))
    pick[0, found.names.index(f"stiffness_{axis}")] = 1.0
    pick[1, dampers] = 1.0 / len(dampers)
    pick[2, found.names.index(mass_name(fit.component))] = 1.0
    used = np.any(pick != 0.0, axis=0)
    if not np.all(np.isfinite(found.covariance[used][:, used])):
        text = f"the recordings leave stiffness, damping or internal mass of {axis} open"
        raise ComputeError(f"{text}; another load mass, or --internal-mass stated, tells them")
    values = np.array([estimate.value for estimate in found.estimates])
    covariance = pick[:, used] @ found.covariance[np.ix_(used, used)] @ pick[:, used].T
    if len(dampers) > 1:
        covariance[1, 1] += float(np.var(values[dampers], ddof=1))
    return pick @ values, covariance


def _without_sensitivity(fit: JointFit, found: FloatArray, covariance: FloatArray, sensor: Sensor | None) -> Modelled:
    """Return a model without a chain, its sensitivity the static one that is stated, else one output per force."""
    static, u_static, unit, which = _static(fit, sensor)
    whole = np.zeros((4, 4))
    whole[0, 0], whole[1:, 1:] = u_static**2, covariance
    mass = max(float(found[2]), 0.0)
    model = SensorModel(static, float(found[0]), float(found[1]), mass, NO_CHAIN, whole, unit)
    lines = np.concatenate([item.measured.ratio.frequency_hz for item in fit.prepared])
    text = (
        f"no sensitivity over frequency was evaluated for {LOAD_COMPONENTS[fit.component]}, for which `shakercal run` "
        f"has to evaluate sines of {_FEWEST_LINES} frequencies or more: the model has {which} and no chain"
    )
    return Modelled(model, (float(lines.min()), float(lines.max())), None, (Notice("info", text, fit.axis),))


def _static(fit: JointFit, sensor: Sensor | None) -> tuple[float, float, str, str]:
    """Return the static sensitivity of the component's output with its u, unit and name, else one per force."""
    component = LOAD_COMPONENTS[fit.component]
    if sensor is not None and sensor.static_sensitivity is not None:
        column = np.array(sensor.static_sensitivity)[:, fit.component]
        place = sensor.channels.index(component) if component in sensor.channels else int(np.argmax(np.abs(column)))
        if column[place] != 0.0:
            u = abs(float(column[place])) * sensor.static_sensitivity_uncertainty
            return float(column[place]), u, sensitivity_unit(sensor.unit, component), "the static sensitivity stated"
    return 1.0, 0.0, sensitivity_unit("1", component), "an output of one per force"


def _clause(text: str) -> str:
    """A sentence as the text of a notice."""
    return text[:1].lower() + text[1:].removesuffix(".")
