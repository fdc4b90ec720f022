"""The noise floor of a power spectrum, and how far above it chance alone does not reach."""

from __future__ import annotations

from functools import lru_cache
from math import lgamma

import numpy as np

from shaker._checks import FloatArray

FIRST_BIN = 3  # the lowest bin looked at: fewer periods are drift
_BLOCKS = (64, 256)  # bins per median, narrow and wide
_LOW_BINS = 256  # in which a slope of the noise towards zero is taken off first
_CAPPED = 4.0  # times the floor: what stands higher does not pull at the slope
_FIT_STEPS = 60
BINS_PER_INDEPENDENT = 1.94  # 1 + 2·(4/9 + 1/36): Hann bins share their noise


def noise_level(power: FloatArray) -> tuple[FloatArray, float]:
    """Return the noise power of every bin (B,) and the number of independent bins each value rests on.

    Medians of blocks of bins, which pass over lines, divided by ln 2 (a bin's power has an exponential distribution)
    and interpolated; of narrow and wide blocks the higher value. Towards zero frequency, where drift and 1/f noise
    rise faster than a block sees, a parabola in log power over log frequency is taken off first, by maximum Whittle
    likelihood of the power capped at four times the floor.
    """
    usable = len(power) - FIRST_BIN
    if usable < 1:
        return np.ones_like(power), 1.0
    trend = _low_trend(power)
    flat = power / trend
    levels: list[FloatArray] = []
    counts: list[float] = []
    for size in _BLOCKS:
        blocks = max(1, usable // size)
        if blocks == 1 and counts:
            break
        edges = FIRST_BIN + np.round(np.linspace(0.0, usable, blocks + 1)).astype(np.int64)
        medians = _medians(flat, edges)
        centres = (edges[:-1] + edges[1:] - 1) / 2.0
        log_level = np.log(np.maximum(medians / np.log(2.0), np.finfo(np.float64).tiny))
        levels.append(np.asarray(np.exp(np.interp(np.arange(len(power)), centres, log_level))))
        counts.append(usable / blocks)
    level = levels[0] if len(levels) == 1 else np.maximum(levels[0], levels[1])
    return np.asarray(level * trend), max(counts) / BINS_PER_INDEPENDENT


def _medians(flat: FloatArray, edges: np.typing.NDArray[np.int64]) -> FloatArray:
    """Return the median of each block."""
    size = int(np.min(np.diff(edges)))
    rows = np.lib.stride_tricks.sliding_window_view(flat, size)[edges[:-1]]
    return np.asarray(np.median(rows, axis=1))


def _low_trend(power: FloatArray) -> FloatArray:
    """Return the slope of the noise over the lowest bins (B,), constant beyond them."""
    last = min(_LOW_BINS, len(power) - 1)
    if last - FIRST_BIN < 16:
        return np.ones_like(power)
    bins = np.arange(FIRST_BIN, last + 1)
    log_bin = np.log(bins / last)
    columns, _ = np.linalg.qr(np.stack([np.ones_like(log_bin), log_bin, log_bin**2], axis=1))
    observed = np.maximum(power[bins], np.finfo(np.float64).tiny)
    log_power = columns @ (columns.T @ (np.log(observed) + np.euler_gamma))
    share = 1.0 - np.exp(-_CAPPED)
    for _ in range(_FIT_STEPS):
        excess = np.minimum(observed / np.exp(log_power), _CAPPED) / share - 1.0
        log_power = log_power + columns @ (columns.T @ excess)
    trend = np.exp(log_power - log_power[-1])
    return np.concatenate([np.full(FIRST_BIN, trend[0]), trend, np.ones(len(power) - last - 1)])


@lru_cache(maxsize=256)
def chance_height(chance: float, independent: float) -> float:
    """Return by which factor a bin exceeds the noise level with probability `chance`, the level being a median.

    The level is known from `independent` bins only: of n exponential values, another exceeds T times the k-th smallest
    with probability Π (n - i) / (n - i + T), i < k (Rohling, IEEE Trans. AES 19 (1983), eq. 39).
    """
    n = max(independent, 1.5)
    k = (n + 1.0) / 2.0
    low, high = 0.0, 1e12
    for _ in range(200):
        t = 0.5 * (low + high) if high < 1e3 else np.sqrt(max(low, 1e-3) * high)
        log_chance = lgamma(n + 1.0) - lgamma(n - k + 1.0) + lgamma(n - k + 1.0 + t) - lgamma(n + 1.0 + t)
        low, high = (t, high) if log_chance > np.log(chance) else (low, t)
        if high - low < 1e-9 * high:
            break
    return float(high * np.log(2.0))
