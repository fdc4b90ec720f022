"""Sensitivities of a sensor with a spring, a damper and a chain, measured with noise and common errors."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from shaker.identification.measured_curves import CurveError, MeasuredSensitivity
from shaker.identification.sensitivity import SpringPrior

FloatArray = NDArray[np.float64]
ComplexArray = NDArray[np.complex128]

FREQUENCY = np.array([53.7, 107.4, 161.1, 214.8, 322.2, 375.9, 483.3, 590.7, 698.1, 805.5, 912.9, 1020.3])
STATIC = 2e-6
STIFFNESS, DAMPING = 4.3125e8, 699.18
LAG = 50e-6
U_SCALE, U_DELAY, U_STATIC, NOISE = 2e-4, 2e-6, 5e-4, 1e-3


def lag(frequency_hz: FloatArray, time_s: float = LAG) -> ComplexArray:
    """A first-order lag."""
    return np.asarray(1.0 / (1.0 + 2j * np.pi * frequency_hz * time_s))


def true_sensitivity(chain: ComplexArray) -> ComplexArray:
    """Spring, damper and chain (K,)."""
    omega = 2.0 * np.pi * FREQUENCY
    return np.asarray(STATIC * STIFFNESS / (STIFFNESS + 1j * omega * DAMPING) * chain)


def measured(chain: ComplexArray, rng: np.random.Generator | None = None) -> MeasuredSensitivity:
    """A measurement: noise of 0.1 %, a common error of the masses and one of the timing, a static calibration."""
    value, size, static = true_sensitivity(chain), NOISE * STATIC, STATIC
    scale = np.full((len(FREQUENCY), 1), U_SCALE + 0j)
    turn = -2j * np.pi * FREQUENCY[:, None] * U_DELAY
    if rng is not None:
        value = value * np.exp(rng.standard_normal() * scale[:, 0] + rng.standard_normal() * turn[:, 0])
        value = value + size * (rng.standard_normal(len(value)) + 1j * rng.standard_normal(len(value)))
        static = STATIC * (1.0 + U_STATIC * rng.standard_normal())
    return MeasuredSensitivity(
        channel="S1",
        component="fz",
        frequency_hz=FREQUENCY,
        value=value,
        covariance=np.full((len(FREQUENCY), 1, 1), size**2) * np.eye(2),
        unit="(V/V)/N",
        errors=(CurveError("masses", scale), CurveError("timing", turn)),
        static=static,
        u_static=U_STATIC * STATIC,
    )


def resonance(rng: np.random.Generator | None = None, u_k: float = 5e-4, u_b: float = 0.02) -> SpringPrior:
    """Stiffness and damping as a resonance gives them, with errors drawn within their uncertainty."""
    drawn = np.zeros(2) if rng is None else rng.standard_normal(2)
    k, b = STIFFNESS * (1.0 + u_k * drawn[0]), DAMPING * (1.0 + u_b * drawn[1])
    return SpringPrior(float(k), STIFFNESS * u_k, float(b), DAMPING * u_b)
