"""The mounted sensor as oscillators in a row: hand on sensor on pedestal."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from shaker._checks import ComplexArray, FloatArray
from shaker.models.mass_chain import MassChain

STAGES = ("pedestal", "sensor", "hand")


@dataclass(frozen=True)
class MountedChain:
    """Hand, elastic element and pedestal along one direction, each (3,) in this order of the publication.

    `mass_kg` m_h, m_t, m_k (kg·m² about an axis), `stiffness` k_h, k_t, k_k of the spring that joins each to the next,
    the pedestal's to the ground, `damping` likewise. A hand of no mass, with the mass zero, is left out.
    """

    mass_kg: FloatArray
    stiffness: FloatArray
    damping: FloatArray

    def __post_init__(self) -> None:
        for name in ("mass_kg", "stiffness", "damping"):
            value = np.asarray(getattr(self, name), dtype=np.float64)
            if value.shape != (3,) or np.any(value < 0.0):
                raise ValueError(f"{name}: expected 3 numbers, none negative, found {value.tolist()}")
            object.__setattr__(self, name, value)
        if np.any(self.mass_kg[1:] == 0.0) or np.any(self.stiffness == 0.0):
            raise ValueError("mass_kg, stiffness: expected above 0 for sensor, pedestal and every spring, found 0")

    def matrices(self) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Return M, C, K (3, 3) of M ü + C u̇ + K u = 0, u = (u_h, u_t, u_k), equation 14 put right.

        C has -c_h, not -c_k, in row 1, and -c_t, not 0, in row 2, column 3: K's pattern, without which it is not
        symmetric and a rigid motion of all three would be damped between them.
        """
        return np.diag(self.mass_kg), _chained(self.damping), _chained(self.stiffness)

    def impedance(self, frequency_hz: FloatArray) -> ComplexArray:
        """Return Z(ω) = -ω²M + jωC + K (N, 3, 3), equation 16 put right as `matrices`."""
        mass, damping, stiffness = self.matrices()
        omega = 2.0 * np.pi * np.asarray(frequency_hz, dtype=np.float64)[:, None, None]
        return np.asarray(-(omega**2) * mass + 1j * omega * damping + stiffness)

    def modes(self) -> tuple[FloatArray, FloatArray]:
        """Return f₀ = |s|/2π in Hz and ζ (N,) of the roots s of det Z = 0, ascending.

        These, not the eigenvalues of Z at some frequency, are the natural frequencies; damped f_d = f₀√(1 - ζ²).
        """
        return self._chain().modes()

    def _chain(self) -> MassChain:
        """The same from the ground upwards, without a hand that has no mass."""
        count = 3 if self.mass_kg[0] > 0.0 else 2
        mass, stiffness, damping = (x[::-1][:count] for x in (self.mass_kg, self.stiffness, self.damping))
        return MassChain(STAGES[:count], mass, stiffness, damping)


def mounted_hz(stiffness: float, sensor_kg: float, hand_kg: FloatArray) -> FloatArray:
    """Return the mounted resonance in Hz (N,) over the mass of a rigidly joined hand (N,), equation 17.

    f = √(k/(m_h + m_t))/2π.
    """
    total = np.asarray(hand_kg, dtype=np.float64) + sensor_kg
    if stiffness <= 0.0 or np.any(total <= 0.0):
        raise ValueError("stiffness, sensor_kg: expected above 0 with every hand, found 0 or less")
    return np.asarray(np.sqrt(stiffness / total) / (2.0 * np.pi))


def _chained(value: FloatArray) -> FloatArray:
    """Tridiagonal matrix (3, 3) of elements between neighbours (3,), the last one to the ground."""
    h, t, k = value
    return np.array([[h, -h, 0.0], [-h, h + t, -t], [0.0, -t, t + k]])
