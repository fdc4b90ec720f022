"""The continuous compensation filter: the sensor's denominator over the wanted one."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from shaker._checks import ComplexArray, FloatArray
from shaker.models.compensation.dynamics import SensorDynamics
from shaker.models.compensation.target import Target, cancelled_poles, low_pass_poles, target_poles
from shaker.models.linear_system import LinearSystem


@dataclass(frozen=True)
class Compensation:
    """G_c(s) = gain·Π_i [Π(s - zero)/Π(s - pole)]_i, each factor i scaled to 1 at s = 0.

    The zeros are the poles of `sensor` that go, the poles those of `target`: at least as many, so that it is proper.
    gain is 1, or 1/H(0) of the sensor where the filter is `calibrated` and turns the output into the load (paper "load
    characteristics", eqs. 15 and 17, for one mode).
    """

    sensor: SensorDynamics
    target: Target
    calibrated: bool = False

    def __post_init__(self) -> None:
        target_poles(self.sensor, self.target)

    @property
    def gain(self) -> float:
        """G_c(0)."""
        return 1.0 / self.sensor.static_gain if self.calibrated else 1.0

    @property
    def factors(self) -> list[tuple[ComplexArray, ComplexArray]]:
        """Zeros and poles in rad/s of every factor: those of a low-pass, two of each mode, one of each real pole."""
        first = [(np.zeros(0, dtype=np.complex128), poles) for poles in low_pass_poles(self.target)]
        return [*first, *zip(cancelled_poles(self.sensor), target_poles(self.sensor, self.target), strict=True)]

    @property
    def system(self) -> LinearSystem:
        """The filter as zeros, poles and gain."""
        zeros, poles = (np.concatenate(part) for part in zip(*self.factors, strict=True))
        return LinearSystem(zeros, poles, self.gain * float(np.real(np.prod(poles) / np.prod(zeros))))

    @property
    def compensated(self) -> LinearSystem:
        """Sensor and filter in a row, without the poles that the filter cancels."""
        left, gain = list(self.sensor.system.poles), self.system.gain * self.sensor.system.gain
        zeros, poles = (np.concatenate(part) for part in zip(*self.factors, strict=True))
        for zero in zeros:
            left.pop(int(np.argmin(np.abs(np.array(left) - zero))))
        return LinearSystem(self.sensor.system.zeros, np.concatenate([left, poles]), gain)

    @property
    def least_white_gain(self) -> float:
        """|G_c| far above all poles: what the filter does to the noise there; 0 with a low-pass."""
        return abs(self.system.direct)

    def sensitivities(self, frequency_hz: FloatArray) -> ComplexArray:
        """Return ∂ ln G_c/∂θ (K, P) of the parameters θ of `sensor.vector` at frequencies (K,) in Hz.

        A mode's factor N = 1 + 2ζs/ω + s²/ω², a real pole's N = 1 + s/a; the static gain counts if calibrated.
        """
        s = 2j * np.pi * np.asarray(frequency_hz, dtype=np.float64)[:, None]
        omega, zeta, a = (
            2 * np.pi * self.sensor.frequency_hz,
            self.sensor.damping_ratio,
            2 * np.pi * self.sensor.real_hz,
        )
        mode = 1.0 + 2.0 * zeta * s / omega + (s / omega) ** 2
        by_frequency = -2 * np.pi * (2.0 * zeta * s / omega**2 + 2.0 * s**2 / omega**3) / mode
        by_real = -2 * np.pi * s / a**2 / (1.0 + s / a)
        by_gain = np.full_like(s, -1.0 / self.sensor.static_gain if self.calibrated else 0.0)
        return np.concatenate([by_frequency, 2.0 * s / omega / mode, by_real, by_gain], axis=1)
