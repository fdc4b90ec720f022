"""The sensor as a whole: what it puts out for the force on its load."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np

from shaker._checks import ComplexArray, FloatArray, check_shape
from shaker.models.sensor.chain_shape import Chain, laplace
from shaker.models.sensor.sensitivity_fit import SensitivityFit
from shaker.signals.chain import ChainResponse

Drive = Literal["base", "force"]

SENSOR_PARAMETERS = ("sensitivity", "stiffness", "damping", "internal_mass")


@dataclass(frozen=True)
class Load:
    """A mass on the sensor and how it is driven: `base` moves under the sensor, or a `force` acts on the load.

    `mass` ± `u_mass` in kg; of a rotation the moment of inertia in kg·m².
    """

    mass: float
    drive: Drive
    u_mass: float = 0.0

    def __post_init__(self) -> None:
        if not (self.mass > 0.0 and self.u_mass >= 0.0):
            raise ValueError(
                f"mass, u_mass: expected mass > 0 and u_mass >= 0, found {self.mass:g} and {self.u_mass:g}"
            )


@dataclass(frozen=True)
class SensorModel:
    """Static `sensitivity` S₀ in `unit`, `stiffness` k, `damping` b, `internal_mass` m_i (as estimated, by
    chance below 0) and the chain behind them.

    `covariance` (4 + P, 4 + P) of [S₀, k, b, m_i, parameters of the chain]. N/m, kg/s and kg; of a rotation N·m/rad,
    N·m·s/rad and kg·m².
    """

    sensitivity: float
    stiffness: float
    damping: float
    internal_mass: float
    chain: Chain
    covariance: FloatArray
    unit: str

    def __post_init__(self) -> None:
        count = len(SENSOR_PARAMETERS) + len(self.chain.names)
        check_shape("covariance", self.covariance, (count, count))
        if not self.stiffness > 0.0:
            raise ValueError(f"stiffness: expected k > 0, found {self.stiffness:g}")

    def resonance_hz(self, load: Load) -> float:
        """Return √(k/(m + m_i))/2π, the undamped resonance with a load."""
        total = load.mass + self.internal_mass
        if not total > 0.0:
            raise ValueError(f"load: expected a mass that with the internal one is above 0, found {total:g}")
        return float(np.sqrt(self.stiffness / total) / (2.0 * np.pi))

    def output_factor(self, frequency_hz: FloatArray, load: Load) -> ComplexArray:
        """Return the output per force on the load (K,), in `unit`, at frequencies in Hz.

        `force`: S₀·k/(k − (m + m_i)ω² + jωb)·chain. `base`, where m·a is the force on the load and (m + m_i)·a that in
        the spring: S₀·(1 + m_i/m)/(1 + jωb/k)·chain.
        """
        gain = self.sensitivity * (1.0 + self.internal_mass / load.mass if load.drive == "base" else 1.0)
        return np.asarray(gain / self._divisor(laplace(frequency_hz), load) * self.chain.response(frequency_hz))

    def log_slopes(self, frequency_hz: FloatArray, load: Load) -> ComplexArray:
        """Return the derivatives (K, 4 + P + 1) of ln `output_factor` by the parameters and by the load's mass."""
        s, total = laplace(frequency_hz), load.mass + self.internal_mass
        divisor = self._divisor(s, load)
        by_force = np.asarray(-s * s / self.stiffness / divisor)
        mass = by_force if load.drive == "force" else np.full(len(s), 1.0 / total + 0j)
        own = mass if load.drive == "force" else mass - 1.0 / load.mass
        stretch = self._divisor(s, load) - 1.0
        columns = [
            np.full(len(s), 1.0 / self.sensitivity + 0j),
            stretch / self.stiffness / divisor,
            -s / self.stiffness / divisor,
            mass,
            *self.chain.log_slopes(frequency_hz).T,
            own,
        ]
        return np.stack(columns, axis=1)

    def log_frequency_slope(self, frequency_hz: FloatArray, load: Load) -> ComplexArray:
        """Return the derivative (K,) of ln `output_factor` by the frequency, in 1/Hz."""
        s = laplace(frequency_hz)
        mass = load.mass + self.internal_mass if load.drive == "force" else 0.0
        own = -(self.damping + 2.0 * s * mass) / self.stiffness / self._divisor(s, load)
        return np.asarray(2j * np.pi * own + self.chain.log_frequency_slope(frequency_hz))

    def covariance_root(self, load: Load) -> FloatArray:
        """Return the parameters' deviations (4 + P + 1, E) by E independent causes of variance one."""
        count = len(self.covariance)
        whole = np.zeros((count + 1, count + 1))
        whole[:count, :count], whole[count, count] = self.covariance, load.u_mass**2
        size = np.sqrt(whole.diagonal())
        scale = np.where(size > 0.0, size, 1.0)
        value, vector = np.linalg.eigh(whole / np.multiply.outer(scale, scale))
        kept = value > 1e-12
        return np.asarray(scale[:, None] * vector[:, kept] * np.sqrt(value[kept]))

    def response(self, frequency_hz: FloatArray, load: Load) -> ChainResponse:
        """Return `output_factor` with the relative deviations that the parameters' covariance makes at all lines."""
        errors = (self.log_slopes(frequency_hz, load) @ self.covariance_root(load)).T
        causes = tuple(f"sensor model {number}" for number in range(1, len(errors) + 1))
        return ChainResponse(self.output_factor(frequency_hz, load), np.asarray(errors), causes)

    def _divisor(self, s: ComplexArray, load: Load) -> ComplexArray:
        """Return (k + bs)/k of a moving base, (k + bs + Ms²)/k of a force on the load."""
        mass = load.mass + self.internal_mass if load.drive == "force" else 0.0
        return np.asarray(1.0 + (self.damping + s * mass) * s / self.stiffness)


def sensor_model(fit: SensitivityFit, mechanics: FloatArray, covariance: FloatArray) -> SensorModel:
    """Join a sensitivity with `mechanics` (3,) [k, b, m_i] of an identification and their `covariance` (3, 3).

    The fit must have had the same k and b as its `SpringPrior`. What it added to the knowledge of τ = b/k moves k, b
    and m_i along C·g, g = ∂τ/∂[k, b, m_i], C their covariance.
    """
    check_shape("mechanics", mechanics, (3,))
    check_shape("covariance", covariance, (3, 3))
    k, b = float(mechanics[0]), float(mechanics[1])
    slope = np.array([-b / k**2, 1.0 / k, 0.0])
    variance = float(slope @ covariance @ slope)
    known = "spring_time_s" in fit.parameters
    if known != (variance > 0.0) or (not known and fit.spring_time_s != b / k):
        raise ValueError("fit: expected one that holds b/k by these k and b, found another")
    others = [place for place, name in enumerate(fit.parameters) if name != "spring_time_s"]
    joined = np.zeros((3 + len(others), 3 + len(others)))
    joined[:3, :3] = covariance
    joined[3:, 3:] = fit.covariance[np.ix_(others, others)]
    moved = np.asarray(mechanics, dtype=np.float64)
    if known:
        gain = covariance @ slope / variance
        moved = moved + gain * (fit.spring_time_s - b / k)
        joined[:3, :3] -= np.multiply.outer(gain, gain) * (variance - fit.covariance[1, 1])
        joined[:3, 3:] = np.multiply.outer(gain, fit.covariance[1, others])
        joined[3:, :3] = joined[:3, 3:].T
    order = [3, 0, 1, 2, *range(4, len(joined))]
    return SensorModel(
        fit.sensitivity,
        float(moved[0]),
        float(moved[1]),
        float(moved[2]),
        fit.chain,
        joined[np.ix_(order, order)],
        fit.unit,
    )
