"""What is left where a filter meets another sensor than it was made for: another load, or a model that is off."""

from __future__ import annotations

import numpy as np

from shaker._checks import FloatArray
from shaker.models.compensation.filter import Compensation
from shaker.models.linear_system import LinearSystem

PERIODS = 6
PER_PERIOD = 256


def met(compensation: Compensation, sensor: LinearSystem) -> LinearSystem:
    """Return the filter behind another sensor, all poles and zeros kept."""
    return sensor.times(compensation.system)


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
