"""A linear system with one input and one output, by its zeros, poles and gain, continuous or sampled."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from shaker._checks import ComplexArray, FloatArray, check_shape


@dataclass(frozen=True)
class LinearSystem:
    """H = gain·Π(x - zeros)/Π(x - poles), x = s in rad/s, or x = z of samples at `sample_rate_hz`.

    `zeros` (Z,), `poles` (P,) complex, those that are not real in conjugate pairs; Z ≤ P. Polynomial coefficients are
    made from them where a format asks for it and never kept: rounded ones move the poles of an oversampled system.
    """

    zeros: ComplexArray
    poles: ComplexArray
    gain: float
    sample_rate_hz: float | None = None

    def __post_init__(self) -> None:
        for name in ("zeros", "poles"):
            value = np.asarray(getattr(self, name), dtype=np.complex128)
            check_shape(name, value, (None,))
            object.__setattr__(self, name, paired(value, name))
        if len(self.zeros) > len(self.poles):
            raise ValueError(f"zeros: expected at most as many as poles, {len(self.poles)}, found {len(self.zeros)}")

    @staticmethod
    def from_coefficients(
        numerator: FloatArray, denominator: FloatArray, sample_rate_hz: float | None = None
    ) -> LinearSystem:
        """Return the system of polynomials in falling powers of s or z (of z⁻¹: both padded to one length)."""
        top, bottom = (
            np.trim_zeros(np.asarray(numerator, float), "f"),
            np.trim_zeros(np.asarray(denominator, float), "f"),
        )
        if not len(top) or not len(bottom):
            raise ValueError("numerator, denominator: expected a coefficient other than 0 in both, found none")
        zeros, poles = (np.asarray(np.roots(part) + 0j) for part in (top, bottom))
        return LinearSystem(zeros, poles, float(top[0] / bottom[0]), sample_rate_hz)

    def coefficients(self) -> tuple[FloatArray, FloatArray]:
        """Return numerator and monic denominator in falling powers, the numerator padded with zeros in front."""
        top = np.atleast_1d(self.gain * np.real(np.poly(self.zeros)))
        bottom = np.atleast_1d(np.real(np.poly(self.poles)))
        return np.concatenate([np.zeros(len(bottom) - len(top)), top]), bottom

    @property
    def rest(self) -> complex:
        """The s or z of frequency zero."""
        return 0j if self.sample_rate_hz is None else 1 + 0j

    @property
    def static_gain(self) -> float:
        """H at frequency zero."""
        return float(self.at(np.array([self.rest]))[0].real)

    def at(self, x: ComplexArray) -> ComplexArray:
        """Return H (K,) at s or z (K,), factor by factor, so that no coefficient loses digits."""
        place = np.asarray(x, dtype=np.complex128)[:, None]
        below = np.full((len(place), len(self.poles)), 1.0 + 0j)
        below[:, : len(self.zeros)] = place - self.zeros
        return np.asarray(self.gain * np.prod(below / (place - self.poles), axis=1))

    def response(self, frequency_hz: FloatArray) -> ComplexArray:
        """Return H (K,) at frequencies (K,) in Hz: at s = jω, or at z = exp(jω/fs)."""
        s = 2j * np.pi * np.asarray(frequency_hz, dtype=np.float64)
        return self.at(np.asarray(s if self.sample_rate_hz is None else np.exp(s / self.sample_rate_hz)))

    @property
    def stable(self) -> bool:
        """Whether every pole decays."""
        return bool(np.all(self.poles.real < 0) if self.sample_rate_hz is None else np.all(np.abs(self.poles) < 1))

    def sections(self) -> FloatArray:
        """Return a sampled system as second-order sections (S, 6) for `scipy.signal.sosfilt`."""
        from scipy.signal import zpk2sos

        if self.sample_rate_hz is None:
            raise ValueError("sample_rate_hz: expected that of a sampled system, found none")
        return np.asarray(zpk2sos(self.zeros, self.poles, self.gain))

    def times(self, other: LinearSystem) -> LinearSystem:
        """Return the product of two systems; nothing is cancelled."""
        if self.sample_rate_hz != other.sample_rate_hz:
            raise ValueError(f"other: expected one at {self.sample_rate_hz}, found one at {other.sample_rate_hz} Hz")
        zeros, poles = np.concatenate([self.zeros, other.zeros]), np.concatenate([self.poles, other.poles])
        return LinearSystem(zeros, poles, self.gain * other.gain, self.sample_rate_hz)


def paired(roots: ComplexArray, name: str) -> ComplexArray:
    """Return roots (N,) with conjugate pairs exact, pairs first by size, then real ones; one alone is refused."""
    scale = 1e-9 * max(1e-300, float(np.max(np.abs(roots), initial=0.0)))
    above = roots[roots.imag > scale]
    below = roots[roots.imag < -scale]
    real = roots[np.abs(roots.imag) <= scale].real
    left = list(below.conj())
    for root in above:
        near = int(np.argmin(np.abs(np.array(left) - root))) if left else -1
        if near < 0 or abs(left[near] - root) > 1e-6 * abs(root):
            raise ValueError(f"{name}: expected conjugate pairs, found {root} without its conjugate")
        left.pop(near)
    if left:
        raise ValueError(f"{name}: expected conjugate pairs, found {left[0].conjugate()} without its conjugate")
    above = above[np.argsort(np.abs(above), kind="stable")]
    return np.concatenate([np.stack([above, above.conj()], axis=1).ravel(), np.sort(real) + 0j])
