"""What is left where a filter meets another sensor than it was made for: another load, or a model that is off."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from shaker._checks import FloatArray
from shaker.models.compensation.dynamics import SensorDynamics
from shaker.models.compensation.filter import Compensation
from shaker.models.compensation.target import cancelled_poles, mode_poles
from shaker.models.linear_system import LinearSystem

PERIODS = 6
PER_PERIOD = 256


def met(compensation: Compensation, sensor: LinearSystem) -> LinearSystem:
    """Return the filter behind another sensor, all poles and zeros kept."""
    return sensor.times(compensation.system)


def moved(sensor: SensorDynamics, vector: FloatArray) -> LinearSystem:
    """Return the whole sensor with other values of `SensorDynamics.vector`; its other poles and zeros stay."""
    modes, reals = len(sensor.frequency_hz), len(sensor.real_hz)
    f, zeta, real, gain = np.split(np.asarray(vector, dtype=np.float64), np.cumsum([modes, modes, reals]))
    poles = [pole for one, damping in zip(f, zeta, strict=True) for pole in mode_poles(one, damping)]
    left = list(sensor.system.poles)
    for pole in np.concatenate(cancelled_poles(sensor)):
        left.pop(int(np.argmin(np.abs(np.array(left) - pole))))
    found = LinearSystem(sensor.system.zeros, np.array([*left, *poles, *(-2 * np.pi * real)]), 1.0)
    return replace(found, gain=float(gain[0]) / found.static_gain)


def with_frequency(sensor: SensorDynamics, factor: float) -> LinearSystem:
    """Return the whole sensor with the frequencies of the cancelled modes times a factor, as another load makes it."""
    vector = sensor.vector.copy()
    vector[: len(sensor.frequency_hz)] *= factor
    return moved(sensor, vector)


def residual_ringing(compensation: Compensation, sensor: LinearSystem, after_s: float) -> float:
    """Return the largest |y/y(∞) - 1| after a step from `after_s` on, over some periods of the slowest oscillation.

    y is the response of `sensor` with the filter behind it. The sensor that the filter was made for leaves the target's
    own decay; another one rings at its own frequency.
    """
    if not after_s >= 0:
        raise ValueError(f"after_s: expected 0 or more, found {after_s}")
    whole = met(compensation, sensor)
    swinging = np.abs(whole.poles.imag[whole.poles.imag > 0])
    if not len(swinging):
        return float(np.abs(whole.step(np.array([after_s]))[0] / whole.static_gain - 1.0))
    span = PERIODS * 2 * np.pi / np.min(swinging)
    count = int(min(1 << 15, PERIODS * PER_PERIOD * np.max(swinging) / np.min(swinging)))
    time = after_s + np.linspace(0.0, span, count)
    return float(np.max(np.abs(whole.step(time) / whole.static_gain - 1.0)))


def ringing_amplitude(compensation: Compensation, sensor: LinearSystem) -> FloatArray:
    """Return the amplitude after a step of every oscillating pole of the sensor (M,), over the final value."""
    whole = met(compensation, sensor)
    upper = sensor.poles[sensor.poles.imag > 0]
    places = [int(np.argmin(np.abs(whole.poles - pole))) for pole in upper]
    terms, _ = whole.step_terms()
    return np.asarray(2.0 * np.abs(terms[places]) / abs(whole.static_gain))
