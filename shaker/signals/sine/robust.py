"""Samples that stand out of the noise of a fit."""

from __future__ import annotations

import numpy as np

from shaker._checks import BoolArray, FloatArray
from shaker.notice import Notice
from shaker.signals.sine.normal import Columns, Samples, residuals
from shaker.signals.sine.solve import SineModel, estimate

_FALSE_ALARM = 0.01  # samples of a whole record that Gaussian noise may lose
_SCATTER = 1.16  # relative standard deviation of a median absolute deviation, times the root of the samples
_SAMPLE = 1 << 16  # residuals from which the scale of a long record is read
_NORMAL_MEDIAN = 0.6744897501960817  # of |x| for a standard normal x
_ROUNDS = 20
_ROUNDING = 1e-12  # of the largest coefficient: no residual is judged more finely
_MOST = 0.25  # of the samples: more are no spikes


def find_spikes(samples: Samples, frequency_hz: FloatArray, model: SineModel) -> BoolArray:
    """Return the rows (S,) whose residual stands out of the noise in any channel.

    Fit, take away what stands out by more than `spike_limit` standard deviations, fit again, until it is the same set;
    every row is judged anew each time. The deviation is that of the median absolute residual, which half of the rows
    may spoil (Hampel, J. Am. Stat. Assoc. 69 (1974) 383). Where more than a quarter stands out, this is no Gaussian
    noise with spikes, and nothing is left out.
    """
    limit = spike_limit(samples, len(frequency_hz), model)
    spikes = np.zeros(samples.timeline.samples, dtype=np.bool_)
    for _ in range(_ROUNDS):
        columns, _, coefficients = estimate(samples.without(spikes) if spikes.any() else samples, frequency_hz, model)
        scale = _scale(samples, columns, coefficients)
        found = np.zeros_like(spikes)
        for chunk, _, residual in residuals(samples, columns, coefficients):
            rows = slice(samples.timeline.edges[chunk.first], samples.timeline.edges[chunk.last])
            found[rows] = (np.abs(chunk.in_order(residual)) > limit * scale).any(axis=1)
        if np.count_nonzero(found) > _MOST * samples.count:
            return np.zeros_like(spikes)
        if np.array_equal(found, spikes):
            break
        spikes = found
    return spikes


def spike_limit(samples: Samples, lines: int, model: SineModel) -> float:
    """Return how many standard deviations a sample must stand out: Gaussian noise does so in 1 of 100 records.

    Wider by two standard deviations of the scale itself, so that short records lose no more.
    """
    from scipy.special import ndtri

    count = samples.count
    tail = -float(ndtri(_FALSE_ALARM / (2.0 * count * samples.values.shape[1])))
    parameters = 2 * lines + (2 if model.drift else 1)
    return tail * (1.0 + 2.0 * _SCATTER / float(np.sqrt(count))) * float(np.sqrt(count / (count - parameters)))


def spike_notice(spikes: BoolArray, samples: Samples, limit: float, first_s: float, where: str) -> Notice:
    """Tell how many samples were left out."""
    text = (
        f"{np.count_nonzero(spikes)} of {samples.count} samples stand out of the noise by more than {limit:.2g} "
        f"standard deviations and are left out, the first at {first_s:.6g} s"
    )
    return Notice("warning", text, where)


def _scale(samples: Samples, columns: Columns, coefficients: FloatArray) -> FloatArray:
    """Return the standard deviation (C,) of the weighted residual, from evenly spaced rows, by its median."""
    step = -(-samples.timeline.samples // _SAMPLE)
    chosen = []
    for chunk, _, residual in residuals(samples, columns, coefficients):
        rows = slice(-int(samples.timeline.edges[chunk.first]) % step, None, step)
        part = chunk.in_order(residual)[rows]
        chosen.append(part.copy() if chunk.root is None else part[(chunk.root[rows] > 0.0).all(axis=1)])
    scale = np.median(np.abs(np.concatenate(chosen)), axis=0) / _NORMAL_MEDIAN
    return np.asarray(np.maximum(scale, _ROUNDING * np.max(np.abs(coefficients), axis=0)))
