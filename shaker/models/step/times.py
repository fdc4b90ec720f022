"""Onset and length of a release with what noise, and an unknown lag behind the sensor, leave open of them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from shaker._checks import BoolArray, FloatArray
from shaker.models.step.beginning import Beginning, longest_lag_s

_GRID = 121
_REACH = 6.0  # standard deviations
_COVERAGE = 1.96
_LIKELY = (1.92, 3.0)  # logarithm of the likelihood below its largest, 95 % of one and of two parameters
_DAMPER = 2.0 / np.sqrt(3.0)  # of ζ/ω: rectangular distribution of half width 2ζ/ω


@dataclass(frozen=True)
class ReleaseTimes:
    """Onset, length and lag in s with standard uncertainties."""

    onset_s: float
    u_onset_s: float
    release_s: float
    u_release_s: float
    lag_s: float
    u_lag_s: float


def release_times(fit: Beginning) -> ReleaseTimes:
    """Return means and standard deviations of onset, length T and lag τ.

    The fit is linear in T² and τ², so that its likelihood is normal in them; priors are flat in T ≥ 0 and in τ from 0
    to the lag whose corner is the lowest mode's frequency. The centre follows from both linearly, and onset = centre -
    T/2 - τ. Added to the onset: an output that holds the force of the sensor's damper too, (2ζs/ω + 1), comes earlier
    by 2ζ/ω.
    """
    if fit.covariance is None:
        raise ValueError("fit: expected one with its covariance, found none")
    mean, covariance = fit.vector[:3], fit.covariance[:3, :3]
    u_squares = np.sqrt(np.maximum(np.diagonal(covariance)[1:], 1e-300))
    length = _grid(mean[1], u_squares[0], np.inf)
    lag = _grid(mean[2], u_squares[1], longest_lag_s(fit))
    squares = np.stack(np.meshgrid(length**2, lag**2, indexing="ij"), axis=-1) - mean[1:]
    scaled = covariance[1:, 1:] / np.outer(u_squares, u_squares)
    inverse = np.linalg.pinv(scaled, rcond=1e-10, hermitian=True) / np.outer(u_squares, u_squares)
    log_weight = -0.5 * np.einsum("...i,ij,...j", squares, inverse, squares)
    weight = np.exp(log_weight - log_weight.max())
    weight /= weight.sum()
    slope = inverse @ covariance[1:, 0]
    onset = mean[0] + squares @ slope - 0.5 * length[:, None] - lag[None, :]
    own = max(float(covariance[0, 0] - covariance[0, 1:] @ slope), 0.0)
    damper = _DAMPER * float(np.max(np.abs(fit.damping_ratio) / (2 * np.pi * fit.frequency_hz)))
    edges = np.concatenate([log_weight[:, [0, -1]].ravel(), log_weight[0, :]])
    bounded = bool(np.any(edges > log_weight.max() - _LIKELY[0]))
    likely = log_weight > log_weight.max() - _LIKELY[int(bounded)]
    onset_s, u_onset_s = _moments(weight, onset, likely)
    release_s, u_release_s = _moments(weight, np.broadcast_to(length[:, None], weight.shape), likely)
    lag_s, u_lag_s = _moments(weight, np.broadcast_to(lag, weight.shape), likely)
    return ReleaseTimes(onset_s, float(np.sqrt(u_onset_s**2 + own + damper**2)), release_s, u_release_s, lag_s, u_lag_s)


def _grid(square: float, u_square: float, most: float) -> FloatArray:
    """Return values (G,) whose squares cover a normal distribution, from 0 to `most`."""
    low = np.sqrt(max(square - _REACH * u_square, 0.0))
    high = min(np.sqrt(max(square + _REACH * u_square, 0.0)), most)
    return np.asarray(np.linspace(min(low, high), high, _GRID))


def _moments(weight: FloatArray, value: FloatArray, likely: BoolArray) -> tuple[float, float]:
    """Return mean and standard deviation of values under weights that sum to 1.

    The standard deviation is at least what makes the 95 % interval hold every likely value: zero, where a time may be
    zero.
    """
    mean = float(np.sum(weight * value))
    away = float(np.max(np.abs(value[likely] - mean)))
    return mean, max(float(np.sqrt(np.sum(weight * (value - mean) ** 2))), away / _COVERAGE)
