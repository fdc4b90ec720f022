"""The dynamics a compensated sensor shall have, stated or found for a wanted bandwidth."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from shaker._checks import ComplexArray
from shaker.models.compensation.dynamics import SensorDynamics

MODE_SPACING = 2.0
"""How far apart, over the target's frequency, further modes are put at least."""


@dataclass(frozen=True)
class Target:
    """Natural frequency in Hz and damping ratio that the lowest compensated mode shall have.

    Further compensated modes get the same damping ratio and keep their frequency, but are moved to twice, four times, …
    the target's where they lie below. `real_hz`: where the slowest compensated real pole shall lie, the others by the
    same factor; needed only where there is one. `low_pass_hz`: corner of a second-order Butterworth low-pass in the
    filter, None for none: the sensor is then damped as wanted and less noise passes.
    """

    frequency_hz: float
    damping_ratio: float
    real_hz: float | None = None
    low_pass_hz: float | None = None

    def __post_init__(self) -> None:
        for name in ("frequency_hz", "damping_ratio", "real_hz", "low_pass_hz"):
            value = getattr(self, name)
            if value is not None and not (value > 0 and np.isfinite(value)):
                raise ValueError(f"{name}: expected a positive number, found {value}")


def best_damping(permitted_error: float) -> float:
    """Return the damping ratio with the widest band |H|/H(0) within 1 ± δ of one mode of given natural frequency.

    Its peak 1/(2ζ√(1 - ζ²)) just comes to 1 + δ: ζ² = [1 - √(1 - (1 + δ)⁻²)]/2; 0.540 for 10 %, 0.590 for 5 %.
    """
    if not 0 < permitted_error < 1:
        raise ValueError(f"permitted_error: expected above 0 and below 1, found {permitted_error}")
    return float(np.sqrt(0.5 * (1.0 - np.sqrt(1.0 - (1.0 + permitted_error) ** -2))))


def band_ratio(damping_ratio: float, permitted_error: float) -> float:
    """Return up to which f/fn one mode of fn stays within |H|/H(0) = 1 ± δ.

    With x = (f/fn)², |H|⁻² = x² - 2(1 - 2ζ²)x + 1; the lower of the roots for 1 + δ, where it is passed, and 1 - δ.
    """
    middle = 1.0 - 2.0 * damping_ratio**2
    up = middle**2 - 1.0 + (1.0 + permitted_error) ** -2
    if middle > 0 and up > 0:
        return float(np.sqrt(middle - np.sqrt(up)))
    return float(np.sqrt(middle + np.sqrt(middle**2 - 1.0 + (1.0 - permitted_error) ** -2)))


def cancelled_poles(sensor: SensorDynamics) -> list[ComplexArray]:
    """Return the poles in rad/s that a filter cancels, section by section: a pair of each mode, one of a real pole."""
    pairs = [mode_poles(f, z) for f, z in zip(sensor.frequency_hz, sensor.damping_ratio, strict=True)]
    return [*pairs, *(np.array([-2 * np.pi * f + 0j]) for f in sensor.real_hz)]


def target_poles(sensor: SensorDynamics, target: Target) -> list[ComplexArray]:
    """Return the poles in rad/s that take their place, section by section."""
    found = []
    if len(sensor.frequency_hz):
        least = target.frequency_hz * MODE_SPACING * np.arange(1, len(sensor.frequency_hz))
        frequencies = [target.frequency_hz, *np.maximum(sensor.frequency_hz[1:], least)]
        found = [mode_poles(float(f), target.damping_ratio) for f in frequencies]
    if len(sensor.real_hz):
        if target.real_hz is None:
            raise ValueError("real_hz: expected where the slowest real pole shall lie, found none")
        factor = target.real_hz / np.min(sensor.real_hz)
        found += [np.array([-2 * np.pi * factor * f + 0j]) for f in sensor.real_hz]
    return found


def low_pass_poles(target: Target) -> list[ComplexArray]:
    """Return the poles in rad/s of the low-pass, a section of its own, or no section."""
    return [] if target.low_pass_hz is None else [mode_poles(target.low_pass_hz, float(np.sqrt(0.5)))]


def mode_poles(frequency_hz: float, damping_ratio: float) -> ComplexArray:
    """Return both poles in rad/s of a mode, real ones from a damping ratio of 1 on."""
    root = np.sqrt(complex(damping_ratio**2 - 1.0))
    return np.asarray(2 * np.pi * frequency_hz * np.array([-damping_ratio + root, -damping_ratio - root]))
