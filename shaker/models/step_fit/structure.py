"""How many poles and zeros a model has, and what its parameters make of them."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from shaker._checks import ComplexArray, FloatArray


@dataclass(frozen=True)
class Structure:
    """Poles of `modes` oscillating modes and `reals` real ones, and `terms` of the numerator, 1 … 2M + Q.

    H(s) = Σ_k z_k (s/ω0)^k·Π ω0/(s - p), k below `terms`: 2M + Q terms are residues without a condition, fewer make
    the response start smoother: its first 2M + Q - terms derivatives are continuous at a step.
    A vector is [ln ω (M), ζ (M), ln a (Q)], poles ω(-ζ ± j√(1 - ζ²)) and -a in rad/s. `scale` ω0 in rad/s, fixed.
    """

    modes: int
    reals: int
    terms: int
    scale: float

    @property
    def order(self) -> int:
        """Number of poles."""
        return 2 * self.modes + self.reals

    @property
    def smoothest(self) -> int:
        """Number of numerator terms of a chain of masses whose displacement is read, behind low-pass filters: 2M - 1.

        The displacement of a mass answers a force like 1/s² at first, and every low-pass filter adds 1/s.
        """
        return max(1, 2 * self.modes - 1)

    def with_terms(self, terms: int) -> Structure:
        """Return the same poles with another number of numerator terms."""
        return replace(self, terms=terms)

    def poles(self, vector: FloatArray) -> ComplexArray:
        """Return the upper poles of the modes and the real ones (M + Q,) in rad/s."""
        m = self.modes
        log_omega, zeta, log_real = vector[:m], vector[m : 2 * m], vector[2 * m : self.order]
        upper = np.exp(log_omega) * (-zeta + 1j * np.sqrt(1.0 - zeta**2))
        return np.concatenate([upper, -np.exp(log_real) + 0j])

    def vector(self, poles: ComplexArray) -> FloatArray:
        """Return the parameters (2M + Q,) of poles (M + Q,), upper ones first."""
        upper, real = poles[: self.modes], poles[self.modes :].real
        return np.concatenate([np.log(np.abs(upper)), -upper.real / np.abs(upper), np.log(np.abs(real))])

    def pole_slopes(self, vector: FloatArray) -> ComplexArray:
        """Return derivatives (M + Q, 2M + Q) of the poles to the parameters."""
        poles, zeta = self.poles(vector), vector[self.modes : 2 * self.modes]
        slopes = np.zeros((len(poles), self.order), dtype=np.complex128)
        mode, real = np.arange(self.modes), np.arange(self.modes, len(poles))
        slopes[mode, mode] = poles[: self.modes]
        slopes[mode, mode + self.modes] = np.abs(poles[: self.modes]) * (-1.0 - 1j * zeta / np.sqrt(1.0 - zeta**2))
        slopes[real, real + self.modes] = poles[self.modes :]
        return slopes

    def shares(self, vector: FloatArray) -> tuple[ComplexArray, ComplexArray]:
        """Return residues (M + Q, terms) of every numerator term, and their derivatives (M + Q, terms, 2M + Q).

        Residue of term k at p_i: ω0^n (p_i/ω0)^k/Π_{j≠i}(p_i - p_j) over all n poles.
        """
        poles, slopes = self.poles(vector), self.pole_slopes(vector)
        every = np.concatenate([poles, poles[: self.modes].conj()])
        moves = np.concatenate([slopes, slopes[: self.modes].conj()])
        size = len(poles)
        gaps = poles[:, None] - every
        gaps[np.arange(size), np.arange(size)] = self.scale
        power = np.arange(self.terms)
        values = self.scale * np.prod(self.scale / gaps, axis=1)[:, None] * (poles[:, None] / self.scale) ** power
        spread = slopes[:, None, :] - moves[None, :, :]
        rate = power[:, None] * (slopes / poles[:, None])[:, None, :] - (spread / gaps[:, :, None]).sum(axis=1)[:, None]
        return values, values[:, :, None] * rate
