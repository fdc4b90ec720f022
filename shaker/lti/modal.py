"""A system as a sum of modes: what is fitted to a record, with its covariance."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from shaker.arrays import ComplexArray, FloatArray, check_shape
from shaker.lti.system import LinearSystem


@dataclass(frozen=True)
class ModalModel:
    """H(s) = Σ_m [r_m/(s - p_m) + r̄_m/(s - p̄_m)] + Σ_q r_q/(s - p_q), output over load.

    Oscillating modes m: p = -ζω + jω√(1 - ζ²), ω = 2π·`frequency_hz` (M,), `damping_ratio` ζ (M,), complex `residue`
    (M,); real poles q: p = -2π·`real_hz` (Q,), `real_residue` (Q,). Residues in output unit per load unit and second.
    `covariance` (P, P), P = 4M + 2Q, of `vector` = [frequency_hz, damping_ratio, Re residue, Im residue, real_hz,
    real_residue], None where it is not known. ζ < 1; a negative ζ or `real_hz` is an unstable model, kept as found.
    """

    frequency_hz: FloatArray
    damping_ratio: FloatArray
    residue: ComplexArray
    real_hz: FloatArray
    real_residue: FloatArray
    covariance: FloatArray | None = None

    def __post_init__(self) -> None:
        modes, reals = len(self.frequency_hz), len(self.real_hz)
        for name, count in (("frequency_hz", modes), ("damping_ratio", modes), ("residue", modes)):
            check_shape(name, getattr(self, name), (count,))
        check_shape("real_hz", self.real_hz, (reals,))
        check_shape("real_residue", self.real_residue, (reals,))
        if self.covariance is not None:
            check_shape("covariance", self.covariance, (4 * modes + 2 * reals,) * 2)
        if np.any(np.abs(self.damping_ratio) >= 1.0):
            raise ValueError(
                f"damping_ratio: expected below 1, found {self.damping_ratio.tolist()}; use two real poles"
            )

    @property
    def vector(self) -> FloatArray:
        """All parameters (P,) in the order of `covariance`."""
        parts = (self.frequency_hz, self.damping_ratio, self.residue.real, self.residue.imag, self.real_hz)
        return np.concatenate([*parts, self.real_residue])

    def with_vector(self, vector: FloatArray) -> ModalModel:
        """Return the model of another vector (P,), with the same covariance."""
        modes, reals = len(self.frequency_hz), len(self.real_hz)
        f, z, re, im, hz, r = np.split(np.asarray(vector), np.cumsum([modes] * 4 + [reals]))
        return replace(self, frequency_hz=f, damping_ratio=z, residue=re + 1j * im, real_hz=hz, real_residue=r)

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the parameters: frequency_hz_1, … with the number of the mode or of the real pole."""
        modes = ("frequency_hz", "damping_ratio", "residue_re", "residue_im")
        found = [f"{name}_{m + 1}" for name in modes for m in range(len(self.frequency_hz))]
        return tuple(
            found + [f"{name}_{q + 1}" for name in ("real_hz", "real_residue") for q in range(len(self.real_hz))]
        )

    @property
    def poles(self) -> ComplexArray:
        """Poles in rad/s: the upper ones of the modes (M,), then the real ones (Q,)."""
        omega, zeta = 2 * np.pi * self.frequency_hz, self.damping_ratio
        upper = omega * (-zeta + 1j * np.sqrt(1 - zeta**2))
        return np.concatenate([upper, -2 * np.pi * self.real_hz + 0j])

    def response(self, frequency_hz: FloatArray) -> ComplexArray:
        """Return H (K,) at frequencies (K,) in Hz."""
        s = 2j * np.pi * np.asarray(frequency_hz, dtype=np.float64)[:, None]
        upper, real = np.split(self.poles, [len(self.frequency_hz)])
        both = self.residue / (s - upper) + self.residue.conj() / (s - upper.conj())
        return np.asarray(both.sum(axis=1) + (self.real_residue / (s - real)).sum(axis=1))

    @property
    def static_gain(self) -> float:
        """H(0), the static sensitivity of the model."""
        return float(self.response(np.zeros(1))[0].real)

    def step(self, time_s: FloatArray) -> FloatArray:
        """Return the response (N,) to a unit step at t = 0: Σ r/p·(exp(pt) - 1), zero before."""
        t = np.maximum(np.asarray(time_s, dtype=np.float64), 0.0)[:, None]
        upper, real = np.split(self.poles, [len(self.frequency_hz)])
        swing = 2.0 * np.real(self.residue / upper * np.expm1(upper * t)).sum(axis=1)
        return np.asarray(swing + (self.real_residue / real.real * np.expm1(real.real * t)).sum(axis=1))

    def impulse(self, time_s: FloatArray) -> FloatArray:
        """Return the response (N,) to a unit impulse at t = 0: Σ r·exp(pt), zero before."""
        time = np.asarray(time_s, dtype=np.float64)
        t = np.maximum(time, 0.0)[:, None]
        upper, real = np.split(self.poles, [len(self.frequency_hz)])
        swing = 2.0 * np.real(self.residue * np.exp(upper * t)).sum(axis=1)
        return np.asarray((swing + (self.real_residue * np.exp(real.real * t)).sum(axis=1)) * (time >= 0))

    @property
    def system(self) -> LinearSystem:
        """The same as zeros, poles and gain."""
        upper, real = np.split(self.poles, [len(self.frequency_hz)])
        poles = np.concatenate([upper, upper.conj(), real])
        residues = np.concatenate([self.residue, self.residue.conj(), self.real_residue + 0j])
        return LinearSystem.from_residues(poles, residues)

    @staticmethod
    def from_system(system: LinearSystem) -> ModalModel:
        """Return a continuous system of different poles, with fewer zeros than poles, as a sum of modes."""
        if system.sample_rate_hz is not None:
            raise ValueError(f"system: expected a continuous one, found samples at {system.sample_rate_hz} Hz")
        if len(system.zeros) >= len(system.poles):
            raise ValueError(f"zeros: expected fewer than poles, {len(system.poles)}, found {len(system.zeros)}")
        residues = system.residues()
        if not np.all(np.isfinite(residues)):
            raise ValueError(f"poles: expected different ones, found {system.poles.tolist()}")
        upper, real = system.poles.imag > 0, system.poles.imag == 0
        size = np.abs(system.poles[upper])
        damping = -system.poles[upper].real / size
        hertz = -system.poles[real].real / (2 * np.pi)
        return ModalModel(size / (2 * np.pi), damping, residues[upper], hertz, residues[real].real)

    def jacobian(
        self, function: Callable[[ModalModel], FloatArray], step: float = 1e-2
    ) -> tuple[FloatArray, FloatArray]:
        """Return a function's values (Q,) and their derivatives (Q, P), by central differences over each parameter.

        `step`: by how many of its standard uncertainties a parameter is moved to either side, real poles by 5 % at
        most; one without uncertainty is not moved.
        """
        moves = step * np.sqrt(np.diag(self._known_covariance()))
        reals = slice(4 * len(self.frequency_hz), 4 * len(self.frequency_hz) + len(self.real_hz))
        moves[reals] = np.minimum(moves[reals], 0.05 * np.abs(self.real_hz))
        value = np.asarray(function(self))
        found = np.zeros((len(value), len(moves)))
        for place in np.flatnonzero(moves):
            up, down = (self.vector + sign * moves[place] * np.eye(len(moves))[place] for sign in (1.0, -1.0))
            change = np.asarray(function(self.with_vector(up))) - np.asarray(function(self.with_vector(down)))
            found[:, place] = change / (2 * moves[place])
        return value, found

    def propagate(
        self, function: Callable[[ModalModel], FloatArray], step: float = 1e-2
    ) -> tuple[FloatArray, FloatArray]:
        """Return a function's values (Q,) and their covariance (Q, Q) by its `jacobian`."""
        value, slope = self.jacobian(function, step)
        return value, np.asarray(slope @ self._known_covariance() @ slope.T)

    def _known_covariance(self) -> FloatArray:
        """The covariance, which must be there."""
        if self.covariance is None:
            raise ValueError("covariance: expected that of the parameters, found none")
        return self.covariance
