"""Where subsets will be in many frames to come: one sine through the frames so far."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise

import numpy as np

from photogram._checks import FloatArray
from photogram.predict import predict_warp

FEWEST = 8
FREE_PARAMETERS = 4
GOOD_FIT = 0.5
FINER = 33
REFINEMENTS = 4


def forecast_warps(history: Sequence[FloatArray], count: int) -> FloatArray:
    """Warps (count,N,6) of the frames after those in `history` (oldest first, N,6 each).

    One frame is foretold by `predict_warp`. More are foretold by the sine with a mean, of one frequency for all
    subsets, that fits at least eight frames in all components; where it leaves more than half of the motion, and with
    fewer frames, by the last warps. In a frame in which it was lost, a subset counts as in the one before.
    """
    if count == 1:
        return predict_warp(history[-6:])[None]
    series = _filled(np.stack(history))
    stay = np.repeat(series[-1:], count, axis=0)
    shifts = _common(np.stack(history), series)
    if len(series) < FEWEST or shifts.size == 0:
        return stay
    past, coming = np.split(np.arange(len(series) + count, dtype=np.float64), [len(series)])
    frequency = _frequency(shifts)
    fit = np.linalg.pinv(_design(frequency, past))
    left = np.sum((shifts - _design(frequency, past) @ (fit @ shifts)) ** 2) * len(past)
    if left > GOOD_FIT**2 * np.sum((shifts - shifts[-1]) ** 2) * (len(past) - FREE_PARAMETERS):
        return stay
    guess: FloatArray = _design(frequency, coming) @ (fit @ series.reshape(len(past), -1))
    return guess.reshape(stay.shape)


def _filled(series: FloatArray) -> FloatArray:
    """Warps (M,N,6) with those of the frame before in the place of missing ones."""
    filled = series.copy()
    for before, here in pairwise(filled):
        np.copyto(here, before, where=np.isnan(here))
    return filled


def _common(found: FloatArray, filled: FloatArray) -> FloatArray:
    """Shifts (M,K) of the subsets that were found in all frames (M,N,6); if there are none, of those filled in all."""
    whole = [np.isfinite(series).all(axis=(0, 2)) for series in (found, filled)]
    chosen = whole[0] if whole[0].any() else whole[1]
    return filled[:, chosen][..., [0, 3]].reshape(len(filled), -1)


def _design(frequency: FloatArray | float, frames: FloatArray) -> FloatArray:
    """Columns (...,M,3) of a mean, a cosine and a sine of `frequency` (...) in radians per frame."""
    phase = np.multiply.outer(frequency, frames)
    columns: FloatArray = np.stack([np.ones_like(phase), np.cos(phase), np.sin(phase)], axis=-1)
    return columns


def _frequency(shifts: FloatArray) -> float:
    """Frequency in radians per frame of the sine that fits the leading component of the shifts (M,K) best.

    At least half a period lies within the M frames. A grid of a quarter of the resolution is made finer four times.
    """
    centred = shifts - shifts.mean(axis=0)
    _, vectors = np.linalg.eigh(centred @ centred.T)
    course, frames = vectors[:, -1], np.arange(len(shifts), dtype=np.float64)
    lowest = np.pi / len(shifts)
    grid = np.linspace(lowest, np.pi, 4 * len(shifts))
    for _ in range(REFINEMENTS):
        basis, _ = np.linalg.qr(_design(grid, frames))
        best = grid[np.argmax(np.sum((course @ basis) ** 2, axis=-1))]
        reach = grid[1] - grid[0]
        grid = np.linspace(max(best - reach, lowest), min(best + reach, np.pi), FINER)
    return float(best)
