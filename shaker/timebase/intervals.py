"""Posterior of straight lines given intervals, by adaptive importance sampling."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cache
from statistics import NormalDist

import numpy as np

from shakercal._common.arrays import Arrays, FloatArray

_POINTS, _LAST_POINTS = 250, 1000  # while the proposals settle, and afterwards
_WIDER = 1.35  # of the standard deviation: proposals reach over the corners of a polygon
_ROUNDS = 30  # of fitting a proposal at most
_SETTLED = 0.15  # relative change of the standard deviations below which the sampling has settled
_STRAY = 1e-6  # probability of an edge that the model does not explain
_STEP = 1.0  # in the logarithm of the jitter
_STEEP = 2.0  # change of the log-likelihood from step to step above which a step is halved
_MIN_STEP = 0.02  # in the logarithm of the jitter; chosen
_NEGLIGIBLE_JITTER = 0.1  # of the line's smallest standard deviation: smaller jitter has no effect
_NEGLIGIBLE_SHARE = 1e-4  # share of the whole below which a step of the jitter does not count
_NODES, _WIDE_NODES, _FARTHEST = 512, 64, 9.0  # of Φ and of ln ΔΦ: how many for one standard deviation, up to where
_AT_ONCE = 16384  # values of Φ: their memory stays in the processor's cache
_EQUAL_WIDTH = 1e-6  # relative difference between the widths of intervals that one record reads


@dataclass(frozen=True)
class Posterior(Arrays, shapes="mean P; covariance P P"):
    """Mean (P,) and covariance (P, P) of the parameters, and the mean jitter, in seconds."""

    mean: FloatArray
    covariance: FloatArray
    jitter_s: float


@dataclass(frozen=True)
class Slopes(Arrays, shapes="mean R; weight R R"):
    """External information about the half spans h (R,) of R lines.

    They are normal about `mean` (R,) with the inverse covariance `weight` (R, R), which is singular where only a
    combination of them is stated.
    """

    mean: FloatArray
    weight: FloatArray

    def update(self, line: Posterior) -> Posterior:
        """Return normal lines updated with this reading by linear least squares."""
        select = np.kron(np.eye(len(self.mean)), [0.0, 1.0])
        cross = line.covariance @ select.T
        covariance, difference = select @ cross, self.mean - select @ line.mean
        gain = cross @ np.linalg.solve(np.eye(len(covariance)) + self.weight @ covariance, self.weight)
        left = line.covariance - gain @ cross.T
        return Posterior(line.mean + gain @ difference, (left + left.T) / 2.0, line.jitter_s)

    def log_likelihood(self, points: FloatArray) -> FloatArray:
        """Return the log-likelihood (N,) of lines (N, 2R)."""
        off = points[:, 1::2] - self.mean
        return np.asarray(-0.5 * np.einsum("nr,rs,ns->n", off, self.weight, off))


def line_posterior(
    position: FloatArray,
    lower: FloatArray,
    upper: FloatArray,
    start: Posterior,
    min_jitter_s: float,
    slopes: Slopes | None = None,
) -> Posterior:
    """Return the posterior of one line of instants per record.

    Record r has edge e, with jitter ε_e common to all records, at m_r + h_r·position_e + ε_e in the interval (lower_re,
    upper_re] (R, E), infinite for an edge that it has not seen. Parameters: m_1 h_1 m_2 h_2 …. The likelihood of an
    edge is Φ(b/σ) - Φ(a/σ) with a the largest lower and b the smallest upper bound minus its line; σ is unknown,
    log-uniform above `min_jitter_s`. The posterior tends to the polygon of all intervals as the jitter vanishes and to
    the paired differences as it grows. `start` need only be roughly right; `slopes` is a further factor of the
    likelihood.

    Lines and jitter together fill a funnel that no Gaussian proposal fits. The lines are therefore sampled for one
    jitter after another, in smaller steps where the likelihood is steep, and averaged.
    """
    width = upper - lower
    most = 3.0 * start.jitter_s + 0.3 * float(np.median(width[np.isfinite(width)]))
    left = float(np.log(max(most / min_jitter_s, 3.0)))
    start = start if slopes is None else slopes.update(start)
    intervals, line = (position, lower, upper, slopes), (start.mean, start.covariance)
    steps: list[_JitterStep] = []
    while left > 0.0:
        step = _at_jitter(float(np.log(min_jitter_s)) + left, min(left, _STEP), line, intervals)
        best, line = max([step.log_weight, *(s.log_weight for s in steps)]), (step.mean, step.covariance)
        settled = step.jitter_s < _NEGLIGIBLE_JITTER * np.sqrt(np.diagonal(step.covariance).min())
        steps.append(replace(step, width=left) if settled else step)
        left -= left if settled or step.log_weight < best + np.log(_NEGLIGIBLE_SHARE) else step.width
    while True:
        level = np.array([s.log_weight - np.log(s.width) for s in steps])
        counts = _shares(steps) > 0.01
        steep = np.abs(np.diff(level)) > _STEEP
        halved = (
            counts
            & (np.array([s.width for s in steps]) > _MIN_STEP)
            & (np.append(steep, False) | np.append(False, steep))
        )
        if not halved.any():
            break
        steps = [
            part for s, split in zip(steps, halved, strict=True) for part in (s.halves(intervals) if split else (s,))
        ]
    steps = [s.refined(intervals) for s, share in zip(steps, _shares(steps), strict=True) if share > _NEGLIGIBLE_SHARE]
    share = _shares(steps)
    means = np.array([s.mean for s in steps])
    mean = share @ means
    covariance = np.einsum("j,jpq->pq", share, np.array([s.covariance for s in steps]))
    covariance += (share[:, None] * (means - mean)).T @ (means - mean)
    return Posterior(mean, covariance, float(share @ [s.jitter_s for s in steps]))


_Intervals = tuple[FloatArray, FloatArray, FloatArray, Slopes | None]


@dataclass(frozen=True)
class _JitterStep:
    """Mean and covariance of lines at a step `width` down from `top` in ln jitter."""

    top: float
    width: float
    log_likelihood: float
    mean: FloatArray
    covariance: FloatArray

    @property
    def log_weight(self) -> float:
        """Logarithm of the integral of the likelihood over the step."""
        return self.log_likelihood + float(np.log(self.width))

    @property
    def jitter_s(self) -> float:
        """Jitter in the middle of the step."""
        return float(np.exp(self.top - 0.5 * min(self.width, _STEP)))

    def halves(self, intervals: _Intervals) -> tuple[_JitterStep, _JitterStep]:
        """Return the two halves of the step."""
        line, half = (self.mean, self.covariance), 0.5 * self.width
        return _at_jitter(self.top, half, line, intervals), _at_jitter(self.top - half, half, line, intervals)

    def refined(self, intervals: _Intervals) -> _JitterStep:
        """Return the step from more points."""
        normal = _normal_points(len(self.mean))
        log_likelihood, mean, covariance, _ = _sample_lines(
            self.jitter_s, (self.mean, self.covariance), normal, intervals
        )
        return _JitterStep(self.top, self.width, log_likelihood, mean, covariance)


def _shares(steps: Sequence[_JitterStep]) -> FloatArray:
    """Return the share of each step in the integral of the likelihood."""
    log_weight = np.array([step.log_weight for step in steps])
    weight = np.exp(log_weight - log_weight.max())
    return np.asarray(weight / weight.sum())


def _at_jitter(top: float, width: float, line: tuple[FloatArray, FloatArray], intervals: _Intervals) -> _JitterStep:
    """Return a step of the jitter. `line`: mean and covariance of the first proposal.

    Gaussian proposals are fitted to the weighted points until they settle, tempered where few points have most of the
    weight (Cappé et al., Statistics and Computing 18, 2008: adaptive importance sampling). The points are a
    low-discrepancy sequence, not random numbers.
    """
    step = _JitterStep(top, width, -np.inf, *line)
    normal = _normal_points(len(step.mean))[:_POINTS]
    for _ in range(_ROUNDS):
        old = step.covariance
        log_likelihood, mean, covariance, power = _sample_lines(step.jitter_s, (step.mean, old), normal, intervals)
        step = _JitterStep(top, width, log_likelihood, mean, covariance)
        change = np.sqrt(np.diagonal(step.covariance) / np.diagonal(old)) - 1.0
        if power == 1.0 and np.max(np.abs(change)) < _SETTLED:
            break
    return step


def _sample_lines(
    jitter_s: float, line: tuple[FloatArray, FloatArray], normal: FloatArray, intervals: _Intervals
) -> tuple[float, FloatArray, FloatArray, float]:
    """Return log mean likelihood, mean, covariance and power of weighted points."""
    mean, covariance = line
    root = _WIDER * np.linalg.cholesky(covariance)
    points = mean + normal @ root.T
    log_weight = _log_likelihood(points, jitter_s, intervals) + 0.5 * np.sum(normal**2, axis=1)
    highest = float(log_weight.max())
    size = highest + float(np.log(np.mean(np.exp(log_weight - highest))) + np.sum(np.log(np.diagonal(root))))
    power = 1.0
    while True:
        weight = np.exp(power * (log_weight - highest))
        weight /= weight.sum()
        if 1.0 / np.sum(weight**2) >= len(weight) / 20.0:
            break
        power *= 0.7
    mean = weight @ points
    centred = points - mean
    return size, mean, (weight[:, None] * centred).T @ centred, power


def _log_likelihood(points: FloatArray, jitter: float, intervals: _Intervals) -> FloatArray:
    """Return the log-likelihood (N,) of points (N, 2R), a line per record, at a jitter."""
    from scipy.special import ndtr

    position, lower, upper, slopes = intervals
    result, rows = np.empty(len(points)), max(1, _AT_ONCE // len(position))
    for first in range(0, len(points), rows):
        line = points[first : first + rows].T[:, :, None]
        lines = line[::2] + line[1::2] * position
        below, above = (lower[:, None] - lines).max(axis=0), (upper[:, None] - lines).min(axis=0)
        # Edges whose intervals include every line with a margin contribute no information.
        telling = (below.max(axis=0) > -6.0 * jitter) | (above.min(axis=0) < 6.0 * jitter)
        below, above = below[:, telling] / jitter, above[:, telling] / jitter
        each = np.log(np.maximum(ndtr(above) - ndtr(below), 0.0) + _STRAY)
        result[first : first + rows] = each.sum(axis=1)
    return result if slopes is None else result + slopes.log_likelihood(points)


@cache
def _normal_points(dimensions: int) -> FloatArray:
    """Return standard normal points (N, D) from the additive recurrence with the generalised golden ratio."""
    ratio = 1.5
    for _ in range(50):  # ratio^(D + 1) = ratio + 1
        ratio = (1.0 + ratio) ** (1.0 / (dimensions + 1))
    step = ratio ** -np.arange(1.0, dimensions + 1)
    chance = (0.5 + np.arange(1.0, _LAST_POINTS + 1)[:, None] * step) % 1.0
    points = np.array([[NormalDist().inv_cdf(p) for p in row] for row in chance.tolist()])
    points.flags.writeable = False
    return points
