"""Shapes that a measuring chain can give the sensitivity: delay, lag, low-pass of second order."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np

from shaker._checks import ComplexArray, FloatArray, check_shape

ChainKind = Literal["none", "delay", "lag", "butterworth", "second_order", "delay_lag"]

CHAIN_PARAMETERS: dict[ChainKind, tuple[str, ...]] = {
    "none": (),
    "delay": ("delay_s",),
    "lag": ("lag_s",),
    "butterworth": ("lag_s",),
    "second_order": ("lag_s", "square_s2"),
    "delay_lag": ("delay_s", "lag_s"),
}
"""Names of the parameters of each shape, in their order."""


@dataclass(frozen=True)
class Chain:
    """exp(−sD) / (1 + a₁s + a₂s²), s = jω, with the terms that `kind` has.

    `parameters` (P,) in the order of `CHAIN_PARAMETERS`: D `delay_s`, a₁ `lag_s`, a₂ `square_s2`. A low-pass of
    second order has a₁ = 2ζ/ω_c and a₂ = 1/ω_c²; a Butterworth filter a₂ = a₁²/2.
    """

    kind: ChainKind
    parameters: FloatArray

    def __post_init__(self) -> None:
        check_shape("parameters", self.parameters, (len(self.names),))

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the parameters."""
        return CHAIN_PARAMETERS[self.kind]

    @property
    def delay_s(self) -> float:
        """Pure delay D."""
        return self._value("delay_s")

    @property
    def lag_s(self) -> float:
        """a₁ = 2ζ/ω_c: the delay of the low-pass at low frequencies."""
        return self._value("lag_s")

    @property
    def square_s2(self) -> float:
        """a₂ = 1/ω_c²."""
        return 0.5 * self.lag_s**2 if self.kind == "butterworth" else self._value("square_s2")

    def response(self, frequency_hz: FloatArray) -> ComplexArray:
        """Return the response (K,) at frequencies in Hz."""
        s = laplace(frequency_hz)
        return np.asarray(np.exp(-s * self.delay_s) / self._divisor(s))

    def log_slopes(self, frequency_hz: FloatArray) -> ComplexArray:
        """Return the derivatives (K, P) of the logarithm of the response by the parameters."""
        s = laplace(frequency_hz)
        divisor = self._divisor(s)
        by_lag = -s * (1.0 + s * self.lag_s) if self.kind == "butterworth" else -s
        columns = {"delay_s": -s, "lag_s": by_lag / divisor, "square_s2": -s * s / divisor}
        slopes = np.empty((len(s), len(self.names)), dtype=np.complex128)
        for place, name in enumerate(self.names):
            slopes[:, place] = columns[name]
        return slopes

    def log_frequency_slope(self, frequency_hz: FloatArray) -> ComplexArray:
        """Return the derivative (K,) of the logarithm of the response by the frequency, in 1/Hz."""
        s = laplace(frequency_hz)
        by_s = -self.delay_s - (self.lag_s + 2.0 * self.square_s2 * s) / self._divisor(s)
        return np.asarray(2j * np.pi * by_s)

    def corner(self, covariance: FloatArray) -> tuple[tuple[float, float], tuple[float, float]] | None:
        """Return (f_c, u) in Hz and (ζ, u) of a low-pass from the covariance (P, P) of its parameters.

        f_c = 1/(2π√a₂), ζ = a₁/(2√a₂); None where the chain has no low-pass of second order (a₂ ≤ 0).
        """
        if self.kind not in {"butterworth", "second_order"} or not self.square_s2 > 0.0:
            return None
        root = float(np.sqrt(self.square_s2))
        frequency, damping = 1.0 / (2.0 * np.pi * root), 0.5 * self.lag_s / root
        if self.kind == "butterworth":
            slopes = np.array([[-frequency / self.lag_s], [0.0]])
        else:
            slopes = np.array([[0.0, -0.5 * frequency], [0.5 * self.square_s2 / root, -0.5 * damping]]) / self.square_s2
        u = np.sqrt(np.maximum((slopes @ covariance @ slopes.T).diagonal(), 0.0)).tolist()
        return (frequency, u[0]), (damping, u[1])

    def _value(self, name: str) -> float:
        """Return a parameter, 0 where the shape has none of this name."""
        return float(self.parameters[self.names.index(name)]) if name in self.names else 0.0

    def _divisor(self, s: ComplexArray) -> ComplexArray:
        """Return 1 + a₁s + a₂s²."""
        return np.asarray(1.0 + self.lag_s * s + self.square_s2 * s * s)


def laplace(frequency_hz: FloatArray) -> ComplexArray:
    """Return s = jω (K,) of frequencies in Hz."""
    return np.asarray(2j * np.pi * np.asarray(frequency_hz, dtype=np.float64), dtype=np.complex128)


NO_CHAIN = Chain("none", np.empty(0))
"""A chain that passes everything as it is."""
