"""The target that keeps a whole sensor within a permitted error up to a wanted frequency."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from shaker._checks import ComplexArray, FloatArray
from shaker.models.compensation.dynamics import SensorDynamics
from shaker.models.compensation.target import Target, best_damping, cancelled_poles, low_pass_poles, target_poles

KEPT_SHARE = 0.1
"""Share of the permitted error that is left to the uncertainty of the model."""
HIGHEST_FACTOR = 32.0
RESOLUTION = 1e-10
REACH, FINE = 4.0, 2001
POINTS = 257


def target_for_bandwidth(
    sensor: SensorDynamics,
    bandwidth_hz: float,
    permitted_error: float = 0.1,
    real_hz: float | None = None,
    low_pass_hz: float | None = None,
) -> Target:
    """Return the target of lowest natural frequency with which the whole sensor stays within 1 ± δ up to a frequency.

    All its poles and zeros count, also those that stay. A tenth of δ is left to the uncertainty of the model.
    The lowest natural frequency passes the least noise.
    """
    from scipy.optimize import minimize_scalar

    if not bandwidth_hz > 0:
        raise ValueError(f"bandwidth_hz: expected a positive number, found {bandwidth_hz}")
    if not len(sensor.frequency_hz):
        raise ValueError("frequency_hz: expected a mode to compensate for a bandwidth, found real poles only")
    start = best_damping((1.0 - KEPT_SHARE) * permitted_error)

    wanted = Target(bandwidth_hz, start, real_hz, low_pass_hz)

    def lowest(damping: float) -> float:
        return _lowest_frequency(sensor, bandwidth_hz, permitted_error, replace(wanted, damping_ratio=float(damping)))

    dampings = start + np.linspace(-0.25, 0.4, 27)
    tried = np.array([lowest(damping) for damping in dampings])
    if not np.any(np.isfinite(tried)):
        raise ValueError(
            f"bandwidth_hz: expected one that the poles which are not compensated leave within ±{permitted_error:.2g}"
            f" of the static gain, found {bandwidth_hz:g}; compensate more modes or the real poles, "
            "or raise the low-pass"
        )
    near = dampings[int(np.argmin(tried))]
    found = minimize_scalar(lowest, bounds=(near - 0.025, near + 0.025), method="bounded", options={"xatol": 1e-7})
    damping = float(found.x) if found.fun <= np.min(tried) else float(near)
    return replace(wanted, frequency_hz=lowest(damping), damping_ratio=damping)


def target_for_frequency(
    sensor: SensorDynamics,
    frequency_hz: float,
    permitted_error: float = 0.1,
    real_hz: float | None = None,
    low_pass_hz: float | None = None,
) -> Target:
    """Return the target of a natural frequency whose damping ratio gives the whole sensor the widest band of 1 ± δ.

    A tenth of δ is left to the uncertainty of the model. For one mode that is `best_damping` of what is left.
    """
    start = best_damping((1.0 - KEPT_SHARE) * permitted_error)
    wanted = Target(frequency_hz, start, real_hz, low_pass_hz)
    if not len(sensor.frequency_hz):
        return wanted
    gain = _gains(sensor, np.linspace(0.0, REACH * frequency_hz, FINE))
    allowed = (1.0 - KEPT_SHARE) * permitted_error

    def reached(damping: float) -> int:
        outside = np.abs(gain(replace(wanted, damping_ratio=damping)) - 1.0) > allowed
        return int(np.argmax(np.append(outside, True)))

    dampings = np.concatenate([[start], start + np.arange(-250, 401) * 1e-3])
    best = int(np.argmax([reached(float(one)) for one in dampings]))
    return replace(wanted, damping_ratio=float(dampings[best]))


def _lowest_frequency(sensor: SensorDynamics, bandwidth_hz: float, permitted_error: float, wanted: Target) -> float:
    """Lowest natural frequency with which the band is kept, infinite where none does."""
    gain = _gains(sensor, np.linspace(0.0, bandwidth_hz, POINTS))
    allowed = (1.0 - KEPT_SHARE) * permitted_error

    def kept(frequency: float) -> bool:
        return bool(np.max(np.abs(gain(replace(wanted, frequency_hz=frequency)) - 1.0)) <= allowed)

    low, high = bandwidth_hz / HIGHEST_FACTOR, bandwidth_hz * HIGHEST_FACTOR
    if not kept(high):
        return float("inf")
    while high / low > 1.0 + RESOLUTION:
        middle = float(np.sqrt(low * high))
        low, high = (low, middle) if kept(middle) else (middle, high)
    return high


def _gains(sensor: SensorDynamics, frequency_hz: FloatArray) -> Callable[[Target], FloatArray]:
    """The gain over the static one (K,) of the compensated sensor at frequencies (K,), as a function of the target."""
    s: ComplexArray = np.asarray(2j * np.pi * frequency_hz, dtype=np.complex128)
    rest = np.abs(sensor.system.at(s) / sensor.static_gain * _denominator(s, cancelled_poles(sensor)))

    def gain(target: Target) -> FloatArray:
        poles = [*target_poles(sensor, target), *low_pass_poles(target)]
        return np.asarray(rest / np.abs(_denominator(s, poles)))

    return gain


def _denominator(s: ComplexArray, poles: list[ComplexArray]) -> ComplexArray:
    """Π(1 - s/p) (K,) over all poles p."""
    return np.asarray(np.prod(1.0 - s[:, None] / np.concatenate(poles), axis=1))
