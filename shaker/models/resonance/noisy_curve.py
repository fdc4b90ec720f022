"""A measured complex curve with its noise, and what that noise does to any number read from the curve."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from shaker._checks import ComplexArray, FloatArray, check_shape


@dataclass(frozen=True)
class NoisyCurve:
    """H `value` (K,) at ascending `frequency_hz` (K,), `covariance` (K, 2, 2) of [Re, Im], the noise of each line.

    `line_correlation` (D,): correlation of the errors of lines 0, 1, 2 … apart, as in `TransferFunction`.
    """

    frequency_hz: FloatArray
    value: ComplexArray
    covariance: FloatArray
    line_correlation: ComplexArray | None = None

    def __post_init__(self) -> None:
        check_shape("frequency_hz", self.frequency_hz, (None,))
        check_shape("value", self.value, self.frequency_hz.shape)
        check_shape("covariance", self.covariance, (*self.frequency_hz.shape, 2, 2))
        if not (self.frequency_hz[0] > 0.0 and np.all(np.diff(self.frequency_hz) > 0.0)):
            raise ValueError("frequency_hz: expected ascending positive frequencies, found others")
        if not (np.all(np.isfinite(self.value)) and np.all(np.abs(self.value) > 0.0)):
            raise ValueError("value: expected finite numbers other than zero, found others")
        c = self.covariance
        if not (np.all(c[:, 0, 0] > 0.0) and np.all(c[:, 0, 0] * c[:, 1, 1] > c[:, 0, 1] * c[:, 1, 0])):
            raise ValueError("covariance: expected positive definite matrices (K, 2, 2), found others")

    @property
    def spacing_hz(self) -> float:
        """Return the distance of neighbouring lines."""
        return float(np.min(np.diff(self.frequency_hz)))

    def variance_along(self, direction: ComplexArray) -> FloatArray:
        """Return the variance (K,) of Re{conj(d)·δH} for a direction d (K,) in the complex plane."""
        re, im, c = direction.real, direction.imag, self.covariance
        return np.asarray(re * re * c[:, 0, 0] + 2.0 * re * im * c[:, 0, 1] + im * im * c[:, 1, 1])

    def propagated(self, gradient: ComplexArray) -> FloatArray:
        """Return the covariance (P, P) of numbers y with δy = Σₖ Re{conj(g)·δH}, `gradient` g (P, K)."""
        first = np.sqrt(self.covariance[:, 0, 0])
        second = self.covariance[:, 0, 1] / first
        rest = np.sqrt(self.covariance[:, 1, 1] - second**2)
        white = gradient.real * first + gradient.imag * (second + 1j * rest)
        if self.line_correlation is None or len(self.line_correlation) < 2:
            return np.asarray((white.conj() @ white.T).real)
        place = np.round((self.frequency_hz - self.frequency_hz[0]) / self.spacing_hz).astype(np.int64)
        length = place[-1] + 1
        grid = np.zeros((length + len(self.line_correlation), len(gradient)), dtype=np.complex128)
        grid[place] = white.T
        spread = (grid.conj().T @ grid).real
        for apart, correlation in enumerate(self.line_correlation[1:], start=1):
            pair = correlation * grid[apart : apart + length].conj().T @ grid[:length]
            spread += (pair + pair.conj().T).real
        return np.asarray(spread)
