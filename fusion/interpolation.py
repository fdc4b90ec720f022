"""Interpolation of noisy values over frequency, with what is not known between the points."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

FloatArray = NDArray[np.float64]

LEAST_POINTS = 5
_LENGTHS = np.geomspace(0.05, 10.0, 6)
"""Correlation lengths tried first, in units of the range of ln f."""
_SIZES = np.geomspace(1e-6, 1.0, 7)
"""Standard deviations tried first, in units of the values."""
_JITTER = 1e-9
"""Standard deviation in units of the values that keeps matrices of noiseless points regular."""


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
    best = _restricted_maximum(distance, trend, data, noise)
    covariance = _matern(distance, best)
    inverse = np.asarray(np.linalg.inv(covariance + np.diag(noise)))
    factor = _left_out(inverse, trend, data)
    across = _matern(np.abs(wanted[:, None] - place), best)
    normal = trend.T @ inverse @ trend
    missing = trend_wanted - across @ inverse @ trend
    weight = across @ inverse + missing @ np.linalg.solve(normal, trend.T @ inverse)
    between = np.exp(2.0 * best[0]) - 2.0 * np.sum(weight * across, axis=1)
    between = np.maximum(between + np.einsum("qk,kl,ql->q", weight, covariance, weight), 0.0)
    dof = float(len(frequency_hz) - trend.shape[1])
    return Weights(weight, factor * between * size**2, dof)


def _parabola(frequency_hz: FloatArray, high: float) -> FloatArray:
    """Columns 1, f, f² of a trend."""
    return np.stack([(frequency_hz / high) ** power for power in range(3)], axis=1)


def _matern(distance: FloatArray, log_parameters: FloatArray) -> FloatArray:
    """Matérn covariance, ν = 5/2, of standard deviation and length given by their logarithms."""
    size, length = np.exp(log_parameters)
    ratio = np.sqrt(5.0) * distance / length
    return np.asarray(size**2 * (1.0 + ratio + ratio**2 / 3.0) * np.exp(-ratio))


def _restricted_maximum(distance: FloatArray, trend: FloatArray, data: FloatArray, noise: FloatArray) -> FloatArray:
    """Logarithms of size and length of greatest restricted likelihood: the best of a grid, refined."""
    from scipy.optimize import minimize

    span = float(np.max(distance))
    bounds = np.log([[1e-9, 10.0], [_LENGTHS[0] * span, _LENGTHS[-1] * span]])

    def cost(parameters: FloatArray) -> float:
        inside = np.clip(parameters, bounds[:, 0], bounds[:, 1])
        outside = float(np.sum((parameters - inside) ** 2))
        return _negative_likelihood(_matern(distance, inside) + np.diag(noise), trend, data) + outside

    grid = [np.log([size, length * span]) for size in _SIZES for length in _LENGTHS]
    start = min(grid, key=cost)
    found = minimize(cost, start, method="Nelder-Mead", options={"xatol": 1e-2, "fatol": 1e-3, "maxiter": 100})
    return np.asarray(np.clip(found.x, bounds[:, 0], bounds[:, 1]))


def _negative_likelihood(covariance: FloatArray, trend: FloatArray, data: FloatArray) -> float:
    """Minus twice the restricted log-likelihood of columns with one covariance, up to a constant."""
    root = np.linalg.cholesky(covariance)
    white = np.linalg.solve(root, np.concatenate([trend, data], axis=1))
    basis, upper = np.linalg.qr(white[:, : trend.shape[1]])
    rest = white[:, trend.shape[1] :]
    rest = rest - basis @ (basis.T @ rest)
    columns = data.shape[1]
    logs = np.sum(np.log(np.diag(root))) + np.sum(np.log(np.abs(np.diag(upper))))
    return float(2.0 * columns * logs + np.sum(rest**2))


def _left_out(inverse: FloatArray, trend: FloatArray, data: FloatArray) -> float:
    """Mean normalised square of what points left out differ by from their prediction, at least 1."""
    projector = inverse - inverse @ trend @ np.linalg.solve(trend.T @ inverse @ trend, trend.T @ inverse)
    own = np.diag(projector)
    kept = own > 1e-9 * np.diag(inverse)
    squares = (projector @ data)[kept] ** 2 / own[kept, None]
    return max(1.0, float(np.mean(squares)))
