"""What intervals say about straight lines: the posterior of a trigger's model by adaptive importance sampling."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from shaker._checks import FloatArray, check_shape

_POINTS = 500  # while the proposals settle
_LAST_POINTS = 2000
_WIDER = 1.35  # of the standard deviation: proposals reach over the corners of a polygon
_ROUNDS = 30
_SETTLED = 0.15  # relative change of the standard deviations below which the sampling has settled
_STRAY = 1e-6  # probability of an edge that the model does not explain


@dataclass(frozen=True)
class Posterior:
    """Mean (P,) and covariance (P, P) of the parameters, and the mean jitter, in seconds."""

    mean: FloatArray
    covariance: FloatArray
    jitter_s: float

    def __post_init__(self) -> None:
        check_shape("covariance", self.covariance, (len(self.mean), len(self.mean)))


def line_posterior(
    place: FloatArray, lower: FloatArray, upper: FloatArray, start: Posterior, least_jitter_s: float
) -> Posterior:
    """Return what intervals (R, E) in R records say about one line of instants per record.

    Record r puts edge e, with jitter ε_e common to all records, at m_r + h_r·place_e + ε_e, which lies in
    (lower_re, upper_re]; infinite bounds stand for an edge that record has not seen. Parameters: m_1 h_1 m_2 h_2 …
    Likelihood of an edge: Φ(b/σ) - Φ(a/σ) with a the largest lower and b the smallest upper bound less its line;
    Gaussian jitter σ of unknown size, log-uniform above `least_jitter_s`. The posterior tends to the polygon of all
    intervals as the jitter vanishes and to the paired differences as it grows. `start` need only be roughly right:
    Gaussian proposals are fitted to the weighted points, tempered where few points carry the weight, until they
    settle (Cappé et al., Statistics and Computing 18, 2008: adaptive importance sampling). No random numbers: the
    points are a low-discrepancy sequence.
    """
    all_points = _normal_points(len(start.mean) + 1)
    normal = all_points[:_POINTS]
    most = 3.0 * start.jitter_s + 0.3 * float(np.median((upper - lower)[np.isfinite(upper - lower)]))
    limits = np.log([least_jitter_s, max(most, 3.0 * least_jitter_s)])
    mean = np.append(start.mean, np.clip(np.log(max(start.jitter_s, least_jitter_s)), *limits))
    covariance = np.zeros((len(mean), len(mean)))
    covariance[:-1, :-1], covariance[-1, -1] = start.covariance, 1.0
    for _ in range(_ROUNDS):
        points = mean + normal @ (_WIDER * np.linalg.cholesky(covariance)).T
        log_weight = _log_likelihood(points, limits, place, lower, upper) + 0.5 * np.sum(normal**2, axis=1)
        weight, tempered = _weights(log_weight)
        mean = weight @ points
        centred = points - mean
        old, covariance = covariance, (weight[:, None] * centred).T @ centred
        if len(normal) == _LAST_POINTS:
            break
        change = np.sqrt(np.diagonal(covariance) / np.diagonal(old)) - 1.0
        if not tempered and np.max(np.abs(change)) < _SETTLED:
            normal = all_points
    jitter = float(weight @ np.exp(points[:, -1]))
    return Posterior(mean[:-1], covariance[:-1, :-1], jitter)


def _weights(log_weight: FloatArray) -> tuple[FloatArray, bool]:
    """Return weights that sum to one, flattened until at least a twentieth of the points counts, and whether so."""
    power = 1.0
    while True:
        weight = np.exp(power * (log_weight - log_weight.max()))
        weight /= weight.sum()
        if 1.0 / np.sum(weight**2) >= len(weight) / 20.0:
            return weight, power < 1.0
        power *= 0.7


def _log_likelihood(
    points: FloatArray, limits: FloatArray, place: FloatArray, lower: FloatArray, upper: FloatArray
) -> FloatArray:
    """Return the log-likelihood (N,) of points (N, 2R + 1): a line per record and the logarithm of the jitter."""
    from scipy.special import ndtr

    jitter = np.exp(np.clip(points[:, -1], *limits))
    below = np.full((len(points), len(place)), -np.inf)
    above = np.full((len(points), len(place)), np.inf)
    for record, (low, high) in enumerate(zip(lower, upper, strict=True)):
        line = points[:, 2 * record, None] + points[:, 2 * record + 1, None] * place
        below, above = np.maximum(below, low - line), np.minimum(above, high - line)
    # Edges whose intervals hold every line with room to spare say nothing.
    reach = 6.0 * jitter.max()
    telling = (below.max(axis=0) > -reach) | (above.min(axis=0) < reach)
    below, above = below[:, telling] / jitter[:, None], above[:, telling] / jitter[:, None]
    share = np.maximum(ndtr(above) - ndtr(below), 0.0) + _STRAY
    outside = (points[:, -1] < limits[0]) | (points[:, -1] > limits[1])
    return np.where(outside, -np.inf, np.log(share).sum(axis=1))


def _normal_points(dimensions: int) -> FloatArray:
    """Return standard normal points (N, D) from the additive recurrence with the generalised golden ratio."""
    from scipy.special import ndtri

    ratio = 1.5
    for _ in range(50):  # ratio^(D + 1) = ratio + 1
        ratio = (1.0 + ratio) ** (1.0 / (dimensions + 1))
    step = ratio ** -np.arange(1.0, dimensions + 1)
    return np.asarray(ndtri((0.5 + np.arange(1.0, _LAST_POINTS + 1)[:, None] * step) % 1.0))
