"""What acts beside the excitation: temperature of the sensor, strain of its foot, motion of what carries instruments.

Each is a named unknown where the rig states it; of what it does not state the user is told how much would matter.
"""

from __future__ import annotations

from collections.abc import Collection, Iterable, Iterator, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from fusion.estimation.measurement_model import CommonError, Observation
from fusion.estimation.uncertainty import Uncertainty, Unknown, added_up, polar_elements, real_stack
from fusion.instruments.channel import Outputs
from shaker.arrays import ComplexArray
from shakercal._common.notices import Notice

if TYPE_CHECKING:
    from fusion.recording.environment import Environment
    from fusion.recording.manifest import ChannelEntry
    from fusion.recording.rig import Rig, Sensor
    from fusion.sensitivity.moving_body import Body
    from fusion.sensitivity.ratio import Sensitivity

OPTICAL = ("photogrammetry", "vibrometer")
USUAL_COEFFICIENT = 1e-4
"""Relative change per kelvin of the sensitivity of a strain gauge sensor that is compensated as usual."""
USUAL_DEVIATION_K = 5.0
CABLE_NPM = 1000.0
"""Stiffness of a hose or of several cables, N/m, by which the user is told what such ones would do."""
MATTERS = 1e-4
"""Relative change of the result from which on an influence that is not assessed is worth a word."""


def at_reference_temperature(outputs: Outputs, sensor: Sensor, environment: Environment) -> Outputs:
    """Return the outputs as the sensor would have given them at its reference temperature.

    U/(1 + α·(T - T_ref)), with the unknowns α and T, where the temperature coefficient α (1/K) of the sensitivity and
    the temperature T of the sensor are stated; otherwise the outputs as they are.
    """
    alpha, temperature = sensor.temperature_coefficient, environment.sensor_temperature
    if alpha is None or temperature is None:
        return outputs
    warmer = temperature - sensor.reference_temperature
    factor = 1.0 / (1.0 + alpha * warmer)
    value = outputs.phasors.value * factor
    known = outputs.uncertainty.scaled(np.full(value.shape, factor, dtype=np.complex128))
    label = "temperature of the sensor"
    u_alpha, u_temperature = sensor.temperature_coefficient_uncertainty, environment.sensor_temperature_uncertainty
    unknowns = (
        Unknown(f"{label}: coefficient", label, u_alpha, "1/K", -factor * warmer * u_alpha * value, "rig"),
        Unknown(label, label, u_temperature, "K", -factor * alpha * u_temperature * value, "recording"),
    )
    own = [unknown.acting(real_stack(unknown.effect)) for unknown in unknowns if np.any(unknown.effect)]
    uncertainty = Uncertainty(known.random, added_up([*known.influences, *own]))
    phasors = replace(outputs.phasors, value=value, covariance=uncertainty.covariance)
    return replace(outputs, phasors=phasors, uncertainty=uncertainty)


def with_base_strain(outputs: Outputs, sensor: Sensor, environment: Environment) -> Outputs:
    """Return the outputs with what strain of the sensor's foot adds to each of them.

    S·ε with the strain sensitivity S (output unit per m/m, of unknown sign) and the largest amplitude ε of the strain
    (ISO 5347-13: output of a transducer on a bent beam at 250 µm/m). Its phasor, anywhere in a disc of that radius, has
    the standard uncertainty S·ε/2 in either part; one unknown for all lines, since shaker and table stay.
    """
    sensitivity, strain = sensor.base_strain_sensitivity, environment.base_strain
    if not sensitivity or not strain:
        return outputs
    label, shape = "strain of the sensor's foot", outputs.phasors.value.shape
    own = []
    for place, channel in enumerate(outputs.phasors.channels):
        for part, turn in (("in phase", 1.0), ("in quadrature", 1.0j)):
            effect: ComplexArray = np.zeros(shape, dtype=np.complex128)
            effect[:, place] = turn * sensitivity * strain / 2.0
            unknown = Unknown(f"{label}: {channel}, {part}", label, strain / 2.0, "m/m", effect, "mounting")
            own.append(unknown.acting(real_stack(effect)))
    known = outputs.uncertainty
    uncertainty = Uncertainty(known.random, added_up([*known.influences, *own]))
    phasors = replace(outputs.phasors, covariance=uncertainty.covariance)
    return Outputs(phasors, uncertainty, tuple(one.name for one in own))


def with_support_motion(
    observations: Sequence[Observation], limit: float | None, measured: Collection[str] = ()
) -> tuple[Observation, ...]:
    """Return the observations, those of lasers and cameras with the motion of what carries them as common errors.

    `limit`: largest amplitude of that motion over the motion measured. Its phasor, anywhere in a disc of that radius,
    has the standard uncertainty limit/2 in either part. One unknown for all optical instruments of a body: they stand
    on one floor, so that they cannot tell it from motion of the body; accelerometers can. `measured`: rows of
    instruments whose support's motion was measured, for which the limit is part of that.
    """
    if not limit:
        return tuple(observations)
    u, label = limit / 2.0, "motion of the supports of lasers and cameras"

    def shaken(observation: Observation) -> Observation:
        none: ComplexArray = np.zeros_like(observation.phasors.value)
        open_ = np.array([member not in measured for member in observation.members])
        rows: ComplexArray = observation.design * open_[:, None]
        parts = ("in phase", 1.0), ("in quadrature", 1.0j)
        own = [
            CommonError(f"{label}, {observation.body}, {part}", label, u, "1", "mounting", turn * u * rows, none)
            for part, turn in parts
        ]
        return replace(observation, common=(*observation.common, *own)) if open_.any() else observation

    return tuple(shaken(o) if o.kind in OPTICAL else o for o in observations)


def not_assessed(
    rig: Rig,
    observations: Sequence[Observation],
    body: Body | None,
    frequency_hz: float,
    further: Iterable[str] = (),
    measured: Collection[str] = (),
) -> Iterator[Notice]:
    """Yield what is said of influences that the rig does not state, so that U has no part of them.

    `frequency_hz`: the lowest line; `body`: what the sensor moves there; `further`: what else is not assessed;
    `measured`: rows of instruments whose support's motion is known.
    """
    kinds = {observation.kind for observation in observations if observation.body == "load" and observation.stated}
    sensor, environment = rig.sensor, rig.surroundings
    told = []
    if sensor is not None and (sensor.temperature_coefficient is None or environment.sensor_temperature is None):
        if environment.sensor_temperature is None:
            what = "the temperature of the sensor (environment.sensor_temperature, sensor.temperature_coefficient)"
            deviation = USUAL_DEVIATION_K
        else:
            deviation = environment.sensor_temperature - sensor.reference_temperature
            what = f"the sensor's temperature of {environment.sensor_temperature:g} °C (sensor.temperature_coefficient)"
        share = USUAL_COEFFICIENT * abs(deviation)
        if share >= MATTERS:
            told.append(f"{what}: {deviation:g} K from the reference at {USUAL_COEFFICIENT:g}/K would be {share:.2%}")
    if rig.load is not None and rig.load.cable_stiffness is None and body is not None:
        mass = sum(part.mass_kg for part in body.parts)
        share = CABLE_NPM / (mass * (2.0 * np.pi * frequency_hz) ** 2)
        if share >= MATTERS:
            told.append(
                f"cables and hoses on the load (load.cable_stiffness): {CABLE_NPM:g} N/m would change the force by "
                f"{share:.2%} at {frequency_hz:.6g} Hz"
            )
    if sensor is not None and (sensor.base_strain_sensitivity is None or environment.base_strain is None):
        keys = ["sensor.base_strain_sensitivity"] * (sensor.base_strain_sensitivity is None)
        keys += ["environment.base_strain"] * (environment.base_strain is None)
        told.append(f"strain of the sensor's foot by bending of what it stands on ({', '.join(keys)})")
    seeing = [o for o in observations if o.body == "load" and o.kind in OPTICAL and o.stated]
    optical = {member for observation in seeing for member in observation.members}
    if environment.support_motion is None and optical - set(measured):
        text = (
            "motion that all lasers and cameras share with what carries them (environment.support_motion): a "
            "thousandth of the motion measured would change the sensitivity by as much"
        )
        others = "only accelerometers on the load can show it" if kinds - set(OPTICAL) else "nothing here can show it"
        told.append(f"{text}, and {others}")
    told += dict.fromkeys(further)
    if told:
        yield Notice("note", "not assessed, not in U: " + "; ".join(told), "surroundings")


TURNED_RAD, TURNED_U = 5e-3, 3.0
"""Phase from which on a measuring chain of which nothing is stated is asked for; the same in standard uncertainties."""
MOST_LAG_RAD = 0.2
"""Lag beyond which it is doubtful that a measuring chain causes it; no chain causes a lead."""


def unstated_chain(
    found: Sensitivity | None, entries: Sequence[ChannelEntry], component: int, *, signed: bool
) -> Iterator[Notice]:
    """Yield a question where the main output turns against the load, and nothing is stated of its measuring chain.

    `signed`: whether the sign of the sensitivity is stated; an output that opposes the load is asked about if not.

    Far below its resonance a sensor turns hardly; filters of amplifiers and delays of converters do, in proportion to
    the frequency. `component`: of the load that was driven; its lowest line counts.
    """
    places = [e for e, (_, j) in enumerate(found.elements) if j == component] if found is not None else []
    if found is None or not places:
        return
    value = found.value[:, [found.elements[e][0] for e in places], component]
    driven = [k for k, kind in enumerate(found.kind) if kind != "harmonic" and np.isfinite(value[k]).any()]
    if not driven:
        return
    line = min(driven, key=lambda k: float(found.frequency_hz[k]))
    main = int(np.nanargmax(np.abs(value[line])))
    entry = next((e for e in entries if e.channel == found.channels[found.elements[places[main]][0]]), None)
    seen = polar_elements(value[[line]], found.uncertainty.at([*places]).at_lines([line]))[0][main]
    if entry is None or seen is None:
        return
    if not signed and abs(seen.phase_rad) > np.pi / 2.0:
        text = (
            f"output {entry.name} opposes the load (phase {seen.phase_rad:.3g} rad), and no sensor.static_sensitivity "
            "states its sign: is a direction, sensor.sense or the wiring reversed?"
        )
        yield Notice("warning", text, "sensitivity")
    if entry.response is not None or entry.delay or entry.delay_uncertainty:
        return
    turn = float(np.angle(np.exp(2j * seen.phase_rad))) / 2.0  # either sign of the sensor
    if abs(turn) > max(TURNED_RAD, TURNED_U * seen.u_phase_rad):
        hertz = float(found.frequency_hz[line])
        lag_us = 1e6 * abs(turn) / (2 * np.pi * hertz)
        text = (
            f"output {entry.name} {'lags' if turn < 0 else 'leads'} the load by {1e3 * abs(turn):.3g} mrad at "
            f"{hertz:.6g} Hz, as much as {lag_us:.3g} us, and neither delay nor response of its measuring chain is "
            "stated: does its amplifier have one?"
        )
        yield Notice("note" if -MOST_LAG_RAD < turn < 0.0 else "warning", text, "sensitivity")
