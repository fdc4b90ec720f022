"""The sensor and its load as masses in a row on a rigid base."""

from __future__ import annotations

from dataclasses import dataclass

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
    `PARAMETERS`, the first two where the load is rigid, for the stated masses; None where it is not known.
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

    def __post_init__(self) -> None:
        if (self.coupling_stiffness is None) != (self.coupling_damping is None):
            raise ValueError("coupling_stiffness, coupling_damping: expected both or none, found one")
        if self.covariance is not None:
            check_shape("covariance", self.covariance, (len(self.vector),) * 2)

    @property
    def vector(self) -> FloatArray:
        """The parameters (P,) in the order of `PARAMETERS`."""
        values = (self.stiffness, self.damping, self.coupling_stiffness, self.coupling_damping)
        return np.array([value for value in values if value is not None])

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
