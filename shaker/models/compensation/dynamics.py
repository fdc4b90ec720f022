"""What a compensation filter takes out of a sensor: modes, real poles and static gain, with covariance."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from shaker._checks import ComplexArray, FloatArray, IntArray, check_shape
from shaker.models.indices.indices import step_shares
from shaker.models.linear_system import LinearSystem
from shaker.models.load_series.model import LoadModel
from shaker.models.modal import ModalModel

RELATIVE_STEP = 1e-5
"""Of the load mass, to either side, for the derivative by it."""


@dataclass(frozen=True)
class SensorDynamics:
    """The poles of a sensor that a filter cancels, and the whole sensor `system`, output unit per load unit.

    Modes `frequency_hz` (M,), rising, with `damping_ratio` (M,) and real poles at -2π·`real_hz` (Q,); `static_gain` =
    H(0). `covariance` (P, P), P = 2M + Q + 1, of `vector` = [frequency_hz, damping_ratio, real_hz, static_gain]; None
    where it is not known.
    """

    frequency_hz: FloatArray
    damping_ratio: FloatArray
    real_hz: FloatArray
    static_gain: float
    system: LinearSystem
    covariance: FloatArray | None = None

    def __post_init__(self) -> None:
        modes, reals = len(self.frequency_hz), len(self.real_hz)
        check_shape("damping_ratio", self.damping_ratio, (modes,))
        if modes + reals == 0:
            raise ValueError("frequency_hz: expected a mode or a real pole to compensate, found none")
        for name in ("frequency_hz", "real_hz"):
            if not np.all(getattr(self, name) > 0):
                raise ValueError(f"{name}: expected positive numbers, found {getattr(self, name).tolist()}")
        if np.any(self.damping_ratio < 0) or np.any(self.damping_ratio >= 1):
            told = self.damping_ratio.tolist()
            raise ValueError(f"damping_ratio: expected 0 or more and below 1 of a stable sensor, found {told}")
        if not np.isfinite(self.static_gain) or self.static_gain == 0:
            raise ValueError(f"static_gain: expected a number other than 0, found {self.static_gain}")
        if self.covariance is not None:
            check_shape("covariance", self.covariance, (2 * modes + reals + 1,) * 2)

    @property
    def vector(self) -> FloatArray:
        """All parameters (P,) in the order of `covariance`."""
        return np.concatenate([self.frequency_hz, self.damping_ratio, self.real_hz, [self.static_gain]])

    @property
    def u(self) -> FloatArray:
        """Standard uncertainties (P,) of `vector`, NaN where they are not known."""
        if self.covariance is None:
            return np.full(len(self.vector), np.nan)
        return np.asarray(np.sqrt(np.diag(self.covariance)))


def single_mode(
    frequency_hz: float,
    damping_ratio: float,
    *,
    static_gain: float = 1.0,
    u_frequency_hz: float | None = None,
    u_damping_ratio: float | None = None,
) -> SensorDynamics:
    """Return the dynamics of G = gain·ω²/(s² + 2ζωs + ω²); u are independent, one that is not given counts as 0."""
    omega = 2 * np.pi * frequency_hz
    system = LinearSystem.from_coefficients(
        np.array([static_gain * omega**2]), np.array([1.0, 2 * damping_ratio * omega, omega**2])
    )
    known = u_frequency_hz is not None or u_damping_ratio is not None
    covariance = np.diag([u_frequency_hz or 0.0, u_damping_ratio or 0.0, 0.0]) ** 2 if known else None
    frequency, damping = np.array([float(frequency_hz)]), np.array([float(damping_ratio)])
    return SensorDynamics(frequency, damping, np.zeros(0), static_gain, system, covariance)


def modal_dynamics(model: ModalModel, *, modes: int = 1, real_poles: bool = False) -> SensorDynamics:
    """Return the `modes` modes with the largest share in the step response, and all real poles if wanted.

    The covariance is that of the model, static gain and poles together.
    """
    count = len(model.frequency_hz)
    if not 0 <= modes <= count:
        raise ValueError(f"modes: expected 0 to {count}, as many as the model has, found {modes}")
    share = np.abs(model.residue / model.poles[:count])
    chosen = np.argsort(-share, kind="stable")[:modes]
    chosen = chosen[np.argsort(model.frequency_hz[chosen])]

    def vector(one: ModalModel) -> FloatArray:
        reals = one.real_hz if real_poles else np.zeros(0)
        return np.concatenate([one.frequency_hz[chosen], one.damping_ratio[chosen], reals, [one.static_gain]])

    value, covariance = (vector(model), None) if model.covariance is None else model.propagate(vector)
    f, zeta, real, gain = np.split(value, np.cumsum([modes, modes, len(value) - 2 * modes - 1]))
    return SensorDynamics(f, zeta, real, float(gain[0]), model.system, covariance)


def loaded_dynamics(model: LoadModel, load_mass: float, *, modes: int = 1, u_load_mass: float = 0.0) -> SensorDynamics:
    """Return the dynamics of a sensor with a load mass in kg: the modes with the largest share in the step response.

    The covariance holds that of stiffnesses, dampings and moving mass, and the uncertainties of static sensitivity and
    load mass, of a load that is there. A load without mass leaves one mode, also where more are wanted.
    """
    system = model.system(load_mass)
    upper = int(np.sum(system.poles.imag > 0))
    if not upper:
        raise ValueError(f"load_mass: expected a load that lets the sensor oscillate, found {load_mass} kg")
    chosen = dominant(system, min(modes, upper))
    value, covariance = _read(system, chosen), None
    if model.total_covariance is not None:
        covariance = model.propagate(lambda one: _read(one.system(load_mass), chosen))[1]
        covariance[-1, -1] += model.u_sensitivity**2
        if u_load_mass and load_mass:
            ends = (_read(model.system(load_mass * (1.0 + by)), chosen) for by in (RELATIVE_STEP, -RELATIVE_STEP))
            slope = np.subtract(*ends) / (2.0 * RELATIVE_STEP * load_mass)
            covariance = covariance + u_load_mass**2 * np.outer(slope, slope)
    f, zeta, gain = np.split(value, [len(chosen), 2 * len(chosen)])
    return SensorDynamics(f, zeta, np.zeros(0), float(gain[0]), system, covariance)


def dominant(system: LinearSystem, count: int) -> IntArray:
    """Return the places (count,) of the oscillating modes, by rising frequency, that swing most after a step."""
    upper = np.flatnonzero(system.poles.imag > 0)
    if not 0 <= count <= len(upper):
        raise ValueError(f"count: expected 0 to {len(upper)}, as many modes as there are, found {count}")
    return np.sort(np.argsort(-step_shares(system)[upper], kind="stable")[:count])


def _read(system: LinearSystem, chosen: IntArray) -> FloatArray:
    """Frequencies, damping ratios of chosen modes, and the static gain."""
    upper: ComplexArray = system.poles[system.poles.imag > 0][chosen]
    return np.concatenate([np.abs(upper) / (2 * np.pi), -upper.real / np.abs(upper), [system.static_gain]])
