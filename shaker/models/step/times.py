"""Onset and length of a release with what noise, and an unknown lag behind the sensor, leave open of them."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from shaker._checks import BoolArray, FloatArray
from shaker.models.step.beginning import Beginning, Window, longest_lag_s, moved_by, slopes_of, solved

_NODES = 13  # lags at which everything else is fitted anew
_FEWEST = 5
_GRID = 121
_FAR, _NEAR = 10.0, 6.0  # standard deviations that the lags, and the lengths at each of them, reach
_COVERAGE = 1.96
_LIKELY = (1.92, 3.0)  # logarithm of the likelihood below its largest: 95 % of one and of two parameters
_DAMPER = 2.0 / np.sqrt(3.0)  # of ζ/ω: rectangular distribution of half width 2ζ/ω
_SPREAD = {"ramp": 1.0 / 12.0, "smooth": 0.25 - 2.0 / np.pi**2, "step": 1.0 / 12.0, "measured": 1.0 / 12.0}


@dataclass(frozen=True)
class ReleaseTimes:
    """Onset, length and lag in s with standard uncertainties."""

    onset_s: float
    u_onset_s: float
    release_s: float
    u_release_s: float
    lag_s: float
    u_lag_s: float


@dataclass(frozen=True)
class _Node:
    """What a given lag leaves: squares of the residual at the best length, its square and `centre_s` there.

    `by_square`: change of the centre with the squared length; variances of the latter and of the centre beside it.
    """

    squares: float
    length2: float
    variance: float
    centre_s: float
    by_square: float
    own: float


def release_times(window: Window, fit: Beginning, correlation: float) -> ReleaseTimes | None:
    """Return means and standard deviations of onset, length T and lag τ of a fit to a window.

    At each lag everything else is fitted, the likelihood being normal in T²; priors are flat in T ≥ 0 and in τ from 0
    to the lag whose corner is the lowest mode's frequency. Onset = centre - T/2 - τ. `correlation`: by how much that of
    the residual enlarges variances. Added to the onset: an output that holds the force of the sensor's damper too,
    (2ζs/ω + 1), comes earlier by 2ζ/ω. None where the lags cannot be told apart at all.
    """
    variance = fit.squares / max(fit.rows - len(fit.vector), 1) * correlation
    lags, nodes = _nodes(window, fit, variance)
    if len(nodes) < _FEWEST:
        return None
    lag = np.linspace(lags[0], lags[-1], _GRID)
    squares, length2, spread, centre, by_square, own = _between(lags, nodes, lag)
    length = _lengths(length2, np.sqrt(spread))
    away = length**2 - length2[:, None]
    log_weight = -0.5 * ((squares - squares.min()) / variance)[:, None] - 0.5 * away**2 / spread[:, None]
    weight = np.exp(log_weight - log_weight.max()) * (length[:, -1] - length[:, 0])[:, None]
    weight /= weight.sum()
    onset = centre[:, None] + by_square[:, None] * away - 0.5 * length - lag[:, None]
    edges = np.concatenate([log_weight[0], log_weight[-1], log_weight[length == 0.0]])
    bounded = bool(np.any(edges > log_weight.max() - _LIKELY[0]))
    likely = log_weight > log_weight.max() - _LIKELY[int(bounded)]
    damper = _DAMPER * float(np.max(np.abs(fit.damping_ratio) / (2 * np.pi * fit.frequency_hz)))
    onset_s, u_onset_s = _moments(weight, onset, likely)
    release_s, u_release_s = _moments(weight, length, likely)
    lag_s, u_lag_s = _moments(weight, np.broadcast_to(lag[:, None], weight.shape), likely)
    u_onset_s = float(np.sqrt(u_onset_s**2 + np.sum(weight * own[:, None]) + damper**2))
    return ReleaseTimes(onset_s, u_onset_s, release_s, u_release_s, lag_s, u_lag_s)


def _nodes(window: Window, fit: Beginning, variance: float) -> tuple[FloatArray, list[_Node]]:
    """Return lags (L,) around that of the fit, and what each of them leaves, each started from its neighbour."""
    if fit.covariance is None:
        raise ValueError("fit: expected one with its covariance, found none")
    u_square = float(np.sqrt(fit.covariance[2, 2] / max(fit.squares / max(fit.rows - len(fit.vector), 1), 1e-300)))
    reach = _FAR * u_square * float(np.sqrt(variance))
    low = float(np.sqrt(max(fit.lag_s**2 - reach, 0.0)))
    high = min(float(np.sqrt(fit.lag_s**2 + reach)), longest_lag_s(fit))
    lags = np.linspace(min(low, 0.99 * high), high, _NODES)
    middle = int(np.argmin(np.abs(lags - fit.lag_s)))
    nodes: dict[int, _Node] = {}
    for way in (range(middle, _NODES), range(middle - 1, -1, -1)):
        here = fit
        for place in way:
            found = _node(window, here, float(lags[place]), variance)
            if found is None:
                break
            nodes[place], here = found
    places = sorted(nodes)
    return lags[places], [nodes[place] for place in places]


def _node(window: Window, near: Beginning, lag_s: float, variance: float) -> tuple[_Node, Beginning] | None:
    """Return what a lag leaves, by one step of Gauss and Newton from a fit near by, and the fit there.

    None where the step leads out of what can be.
    """
    square = near.release_s**2 + (near.lag_s**2 - lag_s**2) / _SPREAD[near.shape]
    start = replace(near, lag_s=lag_s, release_s=float(np.sqrt(max(square, 0.0))))
    here, residual, columns = solved(window, start)
    basis, _ = np.linalg.qr(columns)
    slopes = np.delete(slopes_of(window, here, columns), 2, axis=1)
    slopes = slopes - basis @ (basis.T @ slopes)
    scale = np.maximum(np.linalg.norm(slopes, axis=0), 1e-300)
    inverse = np.linalg.pinv((slopes / scale).T @ (slopes / scale), rcond=1e-12, hermitian=True) / np.outer(
        scale, scale
    )
    downhill = slopes.T @ residual
    step = inverse @ downhill
    whole = np.insert(step, 2, 0.0)
    there = moved_by(window, here, whole)
    if there is None:
        return None
    moved = here.vector[: len(whole)] + whole
    covariance = variance * inverse
    by_square = float(covariance[0, 1] / covariance[1, 1])
    node = _Node(
        squares=here.squares - float(downhill @ step),
        length2=float(moved[1]),
        variance=float(covariance[1, 1]),
        centre_s=float(moved[0]),
        by_square=by_square,
        own=max(float(covariance[0, 0] - by_square * covariance[0, 1]), 0.0),
    )
    return node, there


def _between(lags: FloatArray, nodes: list[_Node], lag: FloatArray) -> FloatArray:
    """Return the six numbers of the nodes (6, G) at lags between them."""
    from scipy.interpolate import CubicSpline

    table = [[n.squares, n.length2, n.variance, n.centre_s, n.by_square, n.own] for n in nodes]
    found = np.asarray(CubicSpline(lags, np.array(table))(lag)).T
    found[[2, 5]] = np.maximum(found[[2, 5]], np.array([1e-300, 0.0])[:, None])
    return found


def _lengths(square: FloatArray, u_square: FloatArray) -> FloatArray:
    """Return lengths (G, G), at each lag a row whose squares cover their distribution, none below zero."""
    low = np.sqrt(np.maximum(square - _NEAR * u_square, 0.0))
    high = np.sqrt(np.maximum(square + _NEAR * u_square, 1e-3 * u_square))
    return np.asarray(np.linspace(low, high, _GRID, axis=1))


def _moments(weight: FloatArray, value: FloatArray, likely: BoolArray) -> tuple[float, float]:
    """Return mean and standard deviation of values under weights that sum to 1.

    The standard deviation is at least what makes the 95 % interval hold every likely value: zero, where a time may be
    zero.
    """
    mean = float(np.sum(weight * value))
    away = float(np.max(np.abs(value[likely] - mean)))
    return mean, max(float(np.sqrt(np.sum(weight * (value - mean) ** 2))), away / _COVERAGE)
