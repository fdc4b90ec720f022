"""Disturbances: temperature of the sensor, strain of its foot, motion of supports.

Each is a named unknown if the rig states it; otherwise a note gives its possible size.
"""

from __future__ import annotations

from collections.abc import Collection, Iterator, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from fusion.estimation.measurement_model import CommonError, Observation
from fusion.estimation.uncertainty import Uncertainty, Unknown, added_up, polar_elements, real_stack
from fusion.instruments.channel import Outputs
from fusion.sensitivity.sensitivity_notices import (
    BASE_STRAIN_NOT_ASSESSED,
    CABLES_NOT_ASSESSED,
    OUTPUT_LAGS,
    OUTPUT_LEADS_LOAD,
    OUTPUT_OPPOSES_LOAD,
    SUPPORT_MOTION_NOT_ASSESSED,
    TEMPERATURE_NOT_ASSESSED,
)
from shakercal._common.arrays import ComplexArray
from shakercal._common.notices import Notice, Value

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
"""Stiffness of a hose or of several cables, N/m, for the possible size of their effect (chosen)."""
MATTERS = 1e-4
"""Relative change of the result above which an influence that is not assessed is reported (chosen)."""
SURROUNDINGS = "surroundings"
"""Where the notes on influences of the surroundings belong."""


def at_reference_temperature(outputs: Outputs, sensor: Sensor, environment: Environment) -> Outputs:
    """Return the outputs at the reference temperature of the sensor.

    U/(1 + α·(T - T_ref)), with the unknowns α and T, if the temperature coefficient α (1/K) of the sensitivity and the
    temperature T of the sensor are stated; otherwise the outputs are unchanged.
    """
    alpha, temperature = sensor.temperature_coefficient, environment.sensor_temperature
    if alpha is None or temperature is None:
        return outputs
    warmer = temperature - sensor.reference_temperature
    factor = 1.0 / (1.0 + alpha * warmer)
    value = outputs.phasors.value * factor
    scaled = outputs.uncertainty.scaled(np.full(value.shape, factor, dtype=np.complex128))
    label = "temperature of the sensor"
    u_alpha, u_temperature = sensor.temperature_coefficient_uncertainty, environment.sensor_temperature_uncertainty
    unknowns = (
        Unknown(f"{label}: coefficient", label, u_alpha, "1/K", -factor * warmer * u_alpha * value, "rig"),
        Unknown(label, label, u_temperature, "K", -factor * alpha * u_temperature * value, "recording"),
    )
    influences = [unknown.acting(real_stack(unknown.effect)) for unknown in unknowns if np.any(unknown.effect)]
    uncertainty = Uncertainty(scaled.random, added_up([*scaled.influences, *influences]))
    phasors = replace(outputs.phasors, value=value, covariance=uncertainty.covariance)
    return replace(outputs, phasors=phasors, uncertainty=uncertainty)


def with_base_strain(outputs: Outputs, sensor: Sensor, environment: Environment) -> Outputs:
    """Return the outputs with the uncertainty caused by strain of the sensor's foot.

    S·ε with the strain sensitivity S (output unit per m/m, of unknown sign) and the largest amplitude ε of the strain
    (ISO 5347-13: output of a transducer on a bent beam at 250 µm/m). Its phasor is uniform in a disc of that radius,
    with the standard uncertainty S·ε/2 in either part. It is one unknown for all lines, because shaker and table do not
    change.
    """
    sensitivity, strain = sensor.base_strain_sensitivity, environment.base_strain
    if not sensitivity or not strain:
        return outputs
    label, shape = "strain of the sensor's foot", outputs.phasors.value.shape
    influences = []
    for index, channel in enumerate(outputs.phasors.channels):
        for part, turn in (("in phase", 1.0), ("in quadrature", 1.0j)):
            effect: ComplexArray = np.zeros(shape, dtype=np.complex128)
            effect[:, index] = turn * sensitivity * strain / 2.0
            unknown = Unknown(f"{label}: {channel}, {part}", label, strain / 2.0, "m/m", effect, "mounting")
            influences.append(unknown.acting(real_stack(effect)))
    earlier = outputs.uncertainty
    uncertainty = Uncertainty(earlier.random, added_up([*earlier.influences, *influences]))
    phasors = replace(outputs.phasors, covariance=uncertainty.covariance)
    return Outputs(phasors, uncertainty, tuple(one.name for one in influences))


def with_support_motion(
    observations: Sequence[Observation], limit: float | None, measured: Collection[str] = ()
) -> tuple[Observation, ...]:
    """Return the observations with the motion of optical instruments' supports as common errors.

    `limit`: largest amplitude of that motion over the measured motion. Its phasor is uniform in a disc of that radius,
    with the standard uncertainty limit/2 in either part. It is one unknown for all optical instruments of a body: on
    one floor they cannot distinguish it from motion of the body, but accelerometers can. `measured`: rows of
    instruments with a measured support motion, which includes the limit.
    """
    if not limit:
        return tuple(observations)
    u, label = limit / 2.0, "motion of the supports of lasers and cameras"

    def shaken(observation: Observation) -> Observation:
        none: ComplexArray = np.zeros_like(observation.phasors.value)
        affected = np.array([member not in measured for member in observation.members])
        rows: ComplexArray = observation.design * affected[:, None]
        parts = ("in phase", 1.0), ("in quadrature", 1.0j)
        errors = [
            CommonError(f"{label}, {observation.body}, {part}", label, u, "1", "mounting", turn * u * rows, none)
            for part, turn in parts
        ]
        return replace(observation, common=(*observation.common, *errors)) if affected.any() else observation

    return tuple(shaken(o) if o.kind in OPTICAL else o for o in observations)


def not_assessed(
    rig: Rig,
    observations: Sequence[Observation],
    body: Body | None,
    frequency_hz: float,
    measured: Collection[str] = (),
) -> Iterator[Notice]:
    """Yield a note for each influence that the rig does not state.

    U does not include it. `frequency_hz`: the lowest line; `body`: the moving parts on the sensor; `measured`: rows of
    instruments with a measured motion of their support.
    """
    kinds = {observation.kind for observation in observations if observation.body == "load" and observation.stated}
    sensor, environment = rig.sensor, rig.surroundings
    if sensor is not None and (sensor.temperature_coefficient is None or environment.sensor_temperature is None):
        temperature = environment.sensor_temperature
        deviation = USUAL_DEVIATION_K if temperature is None else temperature - sensor.reference_temperature
        keys = ["environment.sensor_temperature"] * (temperature is None) + ["sensor.temperature_coefficient"]
        share = USUAL_COEFFICIENT * abs(deviation)
        if share >= MATTERS:
            yield Notice(
                TEMPERATURE_NOT_ASSESSED,
                SURROUNDINGS,
                missing=_unstated(keys),
                share=share,
                deviation_k=deviation,
                coefficient_per_k=USUAL_COEFFICIENT,
            )
    if rig.load is not None and rig.load.cable_stiffness is None and body is not None:
        mass = sum(part.mass_kg for part in body.parts)
        share = CABLE_NPM / (mass * (2.0 * np.pi * frequency_hz) ** 2)
        if share >= MATTERS:
            yield Notice(
                CABLES_NOT_ASSESSED, SURROUNDINGS, share=share, frequency_hz=frequency_hz, stiffness_npm=CABLE_NPM
            )
    if sensor is not None and (sensor.base_strain_sensitivity is None or environment.base_strain is None):
        keys = ["sensor.base_strain_sensitivity"] * (sensor.base_strain_sensitivity is None)
        keys += ["environment.base_strain"] * (environment.base_strain is None)
        yield Notice(BASE_STRAIN_NOT_ASSESSED, SURROUNDINGS, missing=_unstated(keys))
    seeing = [o for o in observations if o.body == "load" and o.kind in OPTICAL and o.stated]
    optical = {member for observation in seeing for member in observation.members}
    if environment.support_motion is None and optical - set(measured):
        others = "accelerometers" if kinds - set(OPTICAL) else "no instrument"
        detectable = f"{others} on the load can show it"
        yield Notice(SUPPORT_MOTION_NOT_ASSESSED, SURROUNDINGS, detectable=detectable)


def _unstated(keys: Sequence[str]) -> str:
    """Return the keys with their verb."""
    return f"{' and '.join(f'`{key}`' for key in keys)} {'is' if len(keys) == 1 else 'are'}"


MIN_LAG_RAD, MIN_LAG_U = 5e-3, 3.0
"""Phase above which an unstated measuring chain is reported, and the same in standard uncertainties (chosen)."""
MAX_LAG_RAD = 0.2
"""Largest lag that a measuring chain is assumed to cause (chosen); no chain causes a lead."""


def unstated_chain(
    found: Sensitivity | None, entries: Sequence[ChannelEntry], component: int, *, signed: bool
) -> Iterator[Notice]:
    """Yield a notice if the main output's phase shows an unstated measuring chain.

    `signed`: whether the sign of the sensitivity is stated; if not, an output that opposes the load is reported.

    Far below its resonance a sensor hardly turns the phase. Filters of amplifiers and delays of converters turn it in
    proportion to the frequency. `component`: of the driven load; its lowest line is used.
    """
    indices = [e for e, (_, j) in enumerate(found.elements) if j == component] if found is not None else []
    if found is None or not indices:
        return
    value = found.value[:, [found.elements[e][0] for e in indices], component]
    driven = [k for k, kind in enumerate(found.kind) if kind != "harmonic" and np.isfinite(value[k]).any()]
    if not driven:
        return
    line = min(driven, key=lambda k: float(found.frequency_hz[k]))
    main = int(np.nanargmax(np.abs(value[line])))
    entry = next((e for e in entries if e.channel == found.channels[found.elements[indices[main]][0]]), None)
    seen = polar_elements(value[[line]], found.uncertainty.at([*indices]).at_lines([line]))[0][main]
    if entry is None or seen is None or seen.u_phase_rad > np.pi / 2.0:  # frames without a trigger have no phase
        return
    if not signed and abs(seen.phase_rad) > np.pi / 2.0:
        yield Notice(OUTPUT_OPPOSES_LOAD, "sensitivity", output=entry.name, phase_rad=seen.phase_rad)
    if entry.response is not None or entry.delay or entry.delay_uncertainty:
        return
    turn = float(np.angle(np.exp(2j * seen.phase_rad))) / 2.0  # either sign of the sensor
    if abs(turn) > max(MIN_LAG_RAD, MIN_LAG_U * seen.u_phase_rad):
        hertz = float(found.frequency_hz[line])
        lag_us = 1e6 * abs(turn) / (2 * np.pi * hertz)
        values: dict[str, Value] = {
            "output": entry.name,
            "lag_mrad": 1e3 * abs(turn),
            "frequency_hz": hertz,
            "lag_us": lag_us,
        }
        if -MAX_LAG_RAD < turn < 0.0:
            yield Notice(OUTPUT_LAGS, "sensitivity", **values)
        else:
            yield Notice(OUTPUT_LEADS_LOAD, "sensitivity", direction="lags" if turn < 0 else "leads", **values)
