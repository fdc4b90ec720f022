"""Poles of the loaded sensor and how they move with every stiffness, damping and mass."""

from __future__ import annotations

import numpy as np

from shaker._checks import ComplexArray, FloatArray


def upper_poles(numbers: FloatArray, moving_mass: float, load_mass: float) -> tuple[ComplexArray, ComplexArray]:
    """Return the upper poles (M,) in rad/s, the lowest first, and their derivatives (M, P + 2).

    `numbers` (P,): stiffness, damping, and those of the coupling unless the load is rigid. Derivatives by the numbers,
    the moving mass and the load mass: dp/dθ = -(∂B/∂θ)/(∂B/∂s) with the polynomial B of `LoadModel`. A load of no mass
    has no second mode. Overdamped modes have no upper pole and are missing.
    """
    if len(numbers) == 2 or load_mass == 0.0:
        below, rates = _rigid(numbers, moving_mass, load_mass)
    else:
        below, rates = _elastic(numbers, moving_mass, load_mass)
    order = len(below) - 1
    companion = np.eye(order, k=-1)
    companion[0] = -below[1:] / below[0]
    roots = np.linalg.eigvals(companion)
    poles = roots[roots.imag > 0.0]
    poles = poles[np.argsort(np.abs(poles))]
    powers = poles[:, None] ** np.arange(order, -1, -1)
    slope = powers[:, 1:] @ (below[:-1] * np.arange(order, 0, -1))
    return np.asarray(poles, dtype=np.complex128), np.asarray(-(powers @ rates.T) / slope[:, None], dtype=np.complex128)


def _rigid(numbers: FloatArray, m: float, ml: float) -> tuple[FloatArray, FloatArray]:
    """B = (m_E + m_L) s² + c s + k and its derivatives by all numbers and both masses."""
    below = np.array([m + ml, numbers[1], numbers[0]])
    rates = np.zeros((len(numbers) + 2, 3))
    rates[0, 2], rates[1, 1] = 1.0, 1.0
    rates[-2:, 0] = 1.0
    return below, rates


def _elastic(numbers: FloatArray, m: float, ml: float) -> tuple[FloatArray, FloatArray]:
    """B of the three-mass model and its derivatives by k, c, k_L, c_L, m_E, m_L."""
    k, c, kl, cl = numbers
    below = np.array([ml * m, ml * (c + cl) + m * cl, ml * (k + kl) + c * cl + m * kl, k * cl + c * kl, k * kl])
    rates = np.array(
        [
            [0.0, 0.0, ml, cl, kl],
            [0.0, ml, cl, kl, 0.0],
            [0.0, 0.0, ml + m, c, k],
            [0.0, ml + m, c, k, 0.0],
            [ml, cl, kl, 0.0, 0.0],
            [m, c + cl, k + kl, 0.0, 0.0],
        ]
    )
    return below, rates
