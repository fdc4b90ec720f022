"""Where subsets will be in many frames to come, from a long past."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise

import numpy as np

from photogram._checks import FloatArray
from photogram.predict import predict_warp

FEWEST = 8
TRUSTED_PX = 0.5
FINER = 33
REFINEMENTS = 4


def forecast_warps(history: Sequence[FloatArray], most: int) -> FloatArray:
    """Warps (K,N,6) of the next 1 ≤ K ≤ `most` frames after those in `history` (oldest first, N,6 each).

    Frames stay where the last one was, or follow a sine with a mean and a drift, of one frequency for all subsets,
    fitted to all frames: whichever would have foretold the last quarter of them better. Not more frames are foretold
    than there were, and only the next one, by `predict_warp`, when that last quarter would have been missed by half a
    pixel. In a frame in which it was lost, a subset counts as in the one before.
    """
    found = np.stack(history)
    series = _filled(found)
    kept = np.isfinite(found if np.isfinite(found).all(axis=(0, 2)).any() else series).all(axis=(0, 2))
    shifts = series[:, kept][..., [0, 3]].reshape(len(series), -1)
    count, tested = min(most, len(series)), len(series) // 4
    if count == 1 or len(series) - tested < FEWEST or shifts.size == 0:
        return predict_warp(history[-6:])[None]
    known, truth = np.split(shifts, [len(series) - tested])
    stayed = float(np.median(np.abs(known[-1] - truth)))
    swung = float(np.median(np.abs(_continued(known, _frequency(known), tested) - truth)))
    if min(stayed, swung) > TRUSTED_PX:
        return predict_warp(history[-6:])[None]
    if stayed < swung:
        return np.repeat(series[-1:], count, axis=0)
    return _continued(series.reshape(len(series), -1), _frequency(shifts), count).reshape(count, *series.shape[1:])


def _filled(series: FloatArray) -> FloatArray:
    """Warps (M,N,6) with those of the frame before in the place of missing ones."""
    filled = series.copy()
    for before, here in pairwise(filled):
        np.copyto(here, before, where=np.isnan(here))
    return filled


def _continued(series: FloatArray, frequency: float, count: int) -> FloatArray:
    """The next values (count,K) of a series (M,K) by least squares."""
    past, coming = np.split(np.arange(len(series) + count, dtype=np.float64), [len(series)])
    guess: FloatArray = _design(frequency, coming) @ (np.linalg.pinv(_design(frequency, past)) @ series)
    return guess


def _design(frequency: FloatArray | float, frames: FloatArray) -> FloatArray:
    """Columns (...,M,4) of a mean, a drift, a cosine and a sine of `frequency` (...) in radians per frame."""
    phase = np.multiply.outer(frequency, frames)
    drift = np.broadcast_to(frames, phase.shape)
    columns: FloatArray = np.stack([np.ones_like(phase), drift, np.cos(phase), np.sin(phase)], axis=-1)
    return columns


def _frequency(shifts: FloatArray) -> float:
    """Frequency in radians per frame of the sine that fits the leading component of the shifts (M,K) best.

    At least half a period lies within the M frames. A grid of a quarter of the resolution is made finer four times.
    """
    frames = np.arange(len(shifts), dtype=np.float64)
    line = np.stack([np.ones_like(frames), frames], axis=1)
    left = shifts - line @ (np.linalg.pinv(line) @ shifts)
    _, vectors = np.linalg.eigh(left @ left.T)
    course, lowest = vectors[:, -1], np.pi / len(shifts)
    grid = np.linspace(lowest, np.pi, 4 * len(shifts))
    for _ in range(REFINEMENTS):
        basis, _ = np.linalg.qr(_design(grid, frames))
        best = grid[np.argmax(np.sum((course @ basis) ** 2, axis=-1))]
        reach = grid[1] - grid[0]
        grid = np.linspace(max(best - reach, lowest), min(best + reach, np.pi), FINER)
    return float(best)
