"""Interpolation of noisy values over frequency, with what is not known between the points."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from shaker._checks import FloatArray

LEAST_POINTS = 5
_LENGTHS = np.geomspace(0.05, 10.0, 6)
"""Correlation lengths tried first, in units of the range of ln f."""
_SIZES = np.geomspace(1e-6, 1.0, 7)
"""Standard deviations tried first, in units of the values."""
_JITTER = 1e-9
"""Standard deviation in units of the values that keeps matrices of noiseless points regular."""
_DIGITS = 1e-13


@dataclass(frozen=True)
class Weights:
    """Values at Q frequencies as sums over K points: `weight` (Q, K), rows of sum 1.

    `variance` (Q,): by what lies between the points, in squares of the values' unit; `dof`: of its estimate.
    """

    weight: FloatArray
    variance: FloatArray
    dof: float


def interpolation_weights(
    frequency_hz: FloatArray, value: FloatArray, variance: FloatArray, wanted_hz: FloatArray
) -> Weights:
    """Return how values (K,) of random `variance` (K,) predict those at other frequencies (Q,).

    Universal kriging over ln f: a parabola in f, which is what stiffness, mass and damping make far below a resonance,
    plus a stationary process of Matérn's kind with ν = 5/2 (Rasmussen & Williams 2006, Gaussian Processes, 2.7 and
    eq. 4.17). Its size and length by restricted maximum likelihood; where points left out are predicted worse than
    that (mean of their normalised squares, ibid. eq. 5.12), its variance is enlarged.
    """
    if len(frequency_hz) < LEAST_POINTS:
        raise ValueError(f"frequency_hz: expected at least {LEAST_POINTS} points, found {len(frequency_hz)}")
    low, high = float(np.min(frequency_hz)), float(np.max(frequency_hz))
    outside = wanted_hz[(wanted_hz < low) | (wanted_hz > high)]
    if len(outside):
        raise ValueError(f"wanted_hz: expected {low:g} to {high:g} Hz, the range of the points, found {outside[0]:g}")
    largest = float(np.max(np.abs(value)))
    size = largest if largest > 0.0 else 1.0
    data = value[:, None] / size
    noise = variance / size**2 + _JITTER**2
    trend, trend_wanted = _parabola(frequency_hz, high), _parabola(wanted_hz, high)
    place, wanted = np.log(frequency_hz), np.log(wanted_hz)
    distance = np.abs(place[:, None] - place)
    contrasts = np.linalg.qr(trend, mode="complete")[0][:, trend.shape[1] :]
    best = _restricted_maximum(distance, contrasts, data, noise)
    covariance = _matern(distance, best)
    across = _matern(np.abs(wanted[:, None] - place), best)
    readings = covariance + np.diag(noise + _rounding(best))
    projector = contrasts @ np.linalg.solve(contrasts.T @ readings @ contrasts, contrasts.T)
    plain = trend_wanted @ np.linalg.pinv(trend)
    weight = plain + (across - plain @ readings) @ projector
    between = np.exp(2.0 * best[0]) - 2.0 * np.sum(weight * across, axis=1)
    between = np.maximum(between + np.einsum("qk,kl,ql->q", weight, covariance, weight), 0.0)
    factor = _left_out(projector, data)
    return Weights(weight, factor * between * size**2, float(contrasts.shape[1]))


def _parabola(frequency_hz: FloatArray, high: float) -> FloatArray:
    """Columns 1, f, f² of a trend."""
    return np.stack([(frequency_hz / high) ** power for power in range(3)], axis=1)


def _matern(distance: FloatArray, log_parameters: FloatArray) -> FloatArray:
    """Matérn covariance, ν = 5/2, of standard deviation and length given by their logarithms."""
    size, length = np.exp(log_parameters)
    ratio = np.sqrt(5.0) * distance / length
    return np.asarray(size**2 * (1.0 + ratio + ratio**2 / 3.0) * np.exp(-ratio))


def _rounding(log_parameters: FloatArray) -> float:
    """Variance of what rounding leaves of a covariance."""
    return _DIGITS * float(np.exp(2.0 * log_parameters[0]))


def _restricted_maximum(distance: FloatArray, contrasts: FloatArray, data: FloatArray, noise: FloatArray) -> FloatArray:
    """Logarithms of size and length of greatest restricted likelihood: the best of a grid, refined."""
    from scipy.optimize import minimize

    span = float(np.max(distance))
    bounds = np.log([[1e-9, 10.0], [_LENGTHS[0] * span, _LENGTHS[-1] * span]])
    left = contrasts.T @ data

    def cost(parameters: FloatArray) -> float:
        inside = np.clip(parameters, bounds[:, 0], bounds[:, 1])
        readings = _matern(distance, inside) + np.diag(noise + _rounding(inside))
        return _negative_likelihood(contrasts.T @ readings @ contrasts, left) + float(
            np.sum((parameters - inside) ** 2)
        )

    grid = [np.log([size, length * span]) for size in _SIZES for length in _LENGTHS]
    start = min(grid, key=cost)
    found = minimize(cost, start, method="Nelder-Mead", options={"xatol": 1e-2, "fatol": 1e-3, "maxiter": 100})
    return np.asarray(np.clip(found.x, bounds[:, 0], bounds[:, 1]))


def _negative_likelihood(covariance: FloatArray, left: FloatArray) -> float:
    """Minus twice the log-likelihood of what contrasts free of the trend leave, up to a constant."""
    root = np.linalg.cholesky(covariance)
    return float(2.0 * np.sum(np.log(np.diag(root))) + np.sum(np.linalg.solve(root, left) ** 2))


def _left_out(projector: FloatArray, data: FloatArray) -> float:
    """Mean normalised square of what points left out differ by from their prediction, at least 1."""
    return max(1.0, float(np.mean((projector @ data) ** 2 / np.diag(projector)[:, None])))
