"""The sensor and its load as masses in a row on a rigid base."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from shaker._checks import ComplexArray, FloatArray, check_shape
from shaker.models.linear_system import LinearSystem

PARAMETERS = ("stiffness", "damping", "coupling_stiffness", "coupling_damping")


@dataclass(frozen=True)
class LoadModel:
    """Moving mass m_E on the sensor's spring k, c; the load mass m_L on it through k_L, c_L, which may be rigid (None).

    Output U = n·x_E over a force on the load (eqs. 2, 3 of the publication named in `docs/load.md`):
    H(s) = n (c_L s + k_L)/B(s), B(s) = m_L m_E s⁴ + [m_L (c + c_L) + m_E c_L] s³ + [m_L (k + k_L) + c c_L + m_E k_L] s²
    + (k c_L + c k_L) s + k k_L; rigid: H(s) = n/[(m_E + m_L) s² + c s + k]. `moving_mass` in kg with `u_moving_mass`,
    stiffnesses in N/m, dampings in N·s/m, `sensitivity` = n/k in output unit per N. `covariance` (P, P) of
    `PARAMETERS`, the first two where the load is rigid, for the stated masses; `covariance_with_mass` (P + 1, P + 1) of
    [*parameters, moving mass] with what the uncertain masses add; None where they are not known. `load_masses`: those
    that the model was fitted to. `solution` of `solutions`: number of this one of those that the data cannot tell
    apart. Of a moment, inertias stand in place of masses, N·m/rad in place of N/m.
    """

    component: str
    channel: str
    unit: str
    moving_mass: float
    stiffness: float
    damping: float
    coupling_stiffness: float | None = None
    coupling_damping: float | None = None
    sensitivity: float = 1.0
    u_moving_mass: float = 0.0
    covariance: FloatArray | None = None
    u_sensitivity: float = 0.0
    covariance_with_mass: FloatArray | None = None
    load_masses: tuple[float, ...] = ()
    solution: int = 1
    solutions: int = 1

    def __post_init__(self) -> None:
        if (self.coupling_stiffness is None) != (self.coupling_damping is None):
            raise ValueError("coupling_stiffness, coupling_damping: expected both or none, found one")
        if self.covariance is not None:
            check_shape("covariance", self.covariance, (len(self.vector),) * 2)
        if self.covariance_with_mass is not None:
            check_shape("covariance_with_mass", self.covariance_with_mass, (len(self.vector) + 1,) * 2)

    @property
    def is_rigid(self) -> bool:
        """Whether the load moves as one with the sensor's moving mass (two-mass model)."""
        return self.coupling_stiffness is None

    @property
    def vector(self) -> FloatArray:
        """The parameters (P,) in the order of `PARAMETERS`."""
        values = (self.stiffness, self.damping, self.coupling_stiffness, self.coupling_damping)
        return np.array([value for value in values if value is not None])

    @property
    def total_covariance(self) -> FloatArray | None:
        """Covariance (P + 1, P + 1) of [*parameters, moving mass]; without `covariance_with_mass` masses add only u."""
        if self.covariance_with_mass is not None or self.covariance is None:
            return self.covariance_with_mass
        size = len(self.vector)
        total = np.zeros((size + 1, size + 1))
        total[:size, :size], total[size, size] = self.covariance, self.u_moving_mass**2
        return total

    def with_numbers(self, numbers: FloatArray) -> LoadModel:
        """Return the model of other [*parameters, moving mass] (P + 1,), with the same covariances."""
        *values, mass = (float(number) for number in numbers)
        k, c = values[:2]
        kl, cl = values[2:] if not self.is_rigid else (None, None)
        return replace(self, moving_mass=mass, stiffness=k, damping=c, coupling_stiffness=kl, coupling_damping=cl)

    def propagate(self, function: Callable[[LoadModel], FloatArray]) -> tuple[FloatArray, FloatArray]:
        """Return a function's values (Q,) and their covariance (Q, Q), by central differences over every number."""
        total = self.total_covariance
        if total is None:
            raise ValueError("covariance: expected that of the parameters, found none")
        value, u = np.asarray(function(self)), np.sqrt(np.diag(total))
        numbers = np.append(self.vector, self.moving_mass)
        jacobian = np.zeros((len(value), len(u)))
        for place in np.flatnonzero(u):
            shift = np.eye(len(u))[place] * min(1e-2 * u[place], 1e-3 * abs(numbers[place]) or np.inf)
            up, down = (np.asarray(function(self.with_numbers(numbers + s * shift))) for s in (1.0, -1.0))
            jacobian[:, place] = (up - down) / (2.0 * shift[place])
        return value, jacobian @ total @ jacobian.T

    def poles(self, load_mass: float) -> ComplexArray:
        """Return all poles in rad/s with a load mass in kg, 2 or 4; a load of no mass is rigid."""
        return self.system(load_mass).poles

    def system(self, load_mass: float) -> LinearSystem:
        """Return output over the force on a load of given mass, in output unit per N."""
        if not load_mass >= 0:
            raise ValueError(f"load_mass: expected 0 or more, found {load_mass}")
        m, k, c, n = self.moving_mass, self.stiffness, self.damping, self.sensitivity * self.stiffness
        kl, cl, ml = self.coupling_stiffness, self.coupling_damping, load_mass
        if kl is None or cl is None or ml == 0:
            return LinearSystem.from_coefficients(np.array([n]), np.array([m + ml, c, k]))
        below = [ml * m, ml * (c + cl) + m * cl, ml * (k + kl) + c * cl + m * kl, k * cl + c * kl, k * kl]
        return LinearSystem.from_coefficients(n * np.array([cl, kl]), np.array(below))
