"""Sines that stand out beside lines, and straight-line changes of the lines, taken off before noise is read."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from shaker._checks import ComplexArray, FloatArray, IntArray, check_shape

OFFSET_BIN = 0.5  # a place up to here is that of the offset
TONE_CLEARANCE = 1.9  # bins beside a line within which a peak is the line's own unrest
_TONE_LIMIT = 9.2  # height of a sine over the level: exceeded by pure noise once in 10⁴ places
_TONES = 16  # sines and changes that are looked for

LevelOf = Callable[[ComplexArray], FloatArray]


@dataclass(frozen=True)
class WithoutTones:
    """What is left of ordinates (K, M, C) near lines (K,) when tones have been taken off.

    `rest` (K, M, C) without sines and changes of the lines, `steady` (K, M, C) without the changes only, `leaked`
    (K, C) the power that the sines have left in the fitted lines.
    """

    rest: ComplexArray
    steady: ComplexArray
    leaked: FloatArray

    def __post_init__(self) -> None:
        check_shape("steady", self.steady, self.rest.shape)
        check_shape("leaked", self.leaked, (self.rest.shape[0], self.rest.shape[2]))


def take_tones_off(
    ordinates: ComplexArray, bins: FloatArray, line_bin: FloatArray, length: int, level_of: LevelOf
) -> WithoutTones:
    """Take sines and straight-line changes of lines (K,) at fractional bins off ordinates (K, M, C) at bins (K, M).

    The ordinates, DFT over the root of the number of samples, are those near each line of a record of `length`
    samples. Sines on and between bins and what a line's straight-line change makes are compared by their height over
    the noise level that `level_of` reads from the ordinates (K, M, C), and the highest goes first, until pure noise
    would be as high (Högbom 1974, CLEAN, one channel and line at a time).
    """
    rest, changed = ordinates.copy(), np.zeros_like(ordinates)
    leaked = np.zeros((len(bins), ordinates.shape[2]))
    places = line_bin[line_bin > OFFSET_BIN]
    for _ in range(_TONES):
        level = level_of(rest)
        place, height = _highest_peak(rest, level, bins, line_bin)
        change, drift_height = _highest_change(rest, level, bins, places, length)
        drifts = (drift_height > height) & (drift_height > _TONE_LIMIT)
        peaks = (height >= drift_height) & (height > _TONE_LIMIT)
        if not (drifts.any() or peaks.any()):
            break
        where, top = _sine_at(rest, place, bins, length)
        top = np.where(peaks, top, 0.0)
        change = np.where(drifts[:, None, :], change, 0.0)
        leaked += np.abs(_sine(line_bin[:, None], where, top, length)) ** 2
        rest -= change + _sine(bins[:, :, None], where[:, None, :], top[:, None, :], length)
        changed += change
    return WithoutTones(rest, ordinates - changed, leaked)


def _highest_peak(
    ordinates: ComplexArray, level: FloatArray, bins: FloatArray, line_bin: FloatArray
) -> tuple[IntArray, FloatArray]:
    """Return the index (K, C) of the lower of the two ordinates where a sine stands highest, and its height there.

    Ordinates on a bin and, as half the squared difference of neighbours, between two bins are standard exponential
    variables over the level where there is no sine. Near a line a peak is the line's own unrest.
    """
    relative = ordinates / np.sqrt(level)
    between = np.abs(relative[:, 1:] - relative[:, :-1]) ** 2 / 2.0
    height = np.maximum(between, np.maximum(np.abs(relative[:, 1:]) ** 2, np.abs(relative[:, :-1]) ** 2))
    away = np.abs(bins[:, None, :] - line_bin[None, :, None]).min(axis=1) > TONE_CLEARANCE
    allowed = (np.diff(bins, axis=1) == 1.0) & away[:, :-1] & away[:, 1:]
    height = np.where(allowed[:, :, None], height, 0.0)
    # Of the two pairs that an ordinate belongs to, the one with the higher partner.
    pair = np.abs(relative[:, 1:]) ** 2 + np.abs(relative[:, :-1]) ** 2
    top = height.max(axis=1, keepdims=True)
    place = np.argmax(np.where(height >= top, pair, -1.0), axis=1)
    return place, top[:, 0]


def _sine_at(
    ordinates: ComplexArray, place: IntArray, bins: FloatArray, length: int
) -> tuple[FloatArray, ComplexArray]:
    """Return place in bins and transform (K, C) of the sine between the ordinates `place` and the next.

    For a rectangular window these are as 1/distance from it, of opposite sign.
    """
    low = np.take_along_axis(ordinates, place[:, None, :], axis=1)[:, 0]
    high = np.take_along_axis(ordinates, place[:, None, :] + 1, axis=1)[:, 0]
    difference = high - low
    share = np.clip((high / np.where(difference == 0.0, 1.0, difference)).real, 0.0, 1.0)
    where = np.take_along_axis(bins[:, :, None], place[:, None, :], axis=1)[:, 0] + share
    before, after = _kernel(-share, length), _kernel(1.0 - share, length)
    top = (low * before.conj() + high * after.conj()) / (np.abs(before) ** 2 + np.abs(after) ** 2)
    return where, np.asarray(top)


def _highest_change(
    ordinates: ComplexArray, level: FloatArray, bins: FloatArray, places: FloatArray, length: int
) -> tuple[ComplexArray, FloatArray]:
    """Return what the straight-line change of a line that stands highest makes (K, M, C), and its height (K, C)."""
    best, height = np.zeros_like(ordinates), np.zeros((len(bins), ordinates.shape[2]))
    for place in places:
        near = (bins[:, 0] < place) & (place < bins[:, -1])
        ramp = np.where(near[:, None], _ramp_kernel(bins - place, length), 0.0)[:, :, None]
        seen = np.sum(np.abs(ramp) ** 2 / level, axis=1)
        size = np.sum(ramp.conj() * ordinates / level, axis=1) / np.where(near[:, None], seen, 1.0)
        own = np.abs(size) ** 2 * seen
        size = size[:, None, :]
        made = size * ramp + size.conj() * _ramp_kernel(bins + place, length)[:, :, None]
        best = np.where((own > height)[:, None, :], made, best)
        height = np.maximum(own, height)
    return best, height


def _sine(bins: FloatArray, place: FloatArray, top: ComplexArray, length: int) -> ComplexArray:
    """Return the transform at `bins` of a real sine: `top` at its place, and its image below zero."""
    return np.asarray(top * _kernel(bins - place, length) + top.conj() * _kernel(bins + place, length))


def _kernel(distance: FloatArray, length: int) -> ComplexArray:
    """Return the transform of a complex sine of `length` samples at `distance` bins from it, 1 at its place."""
    turn = np.exp(-1j * np.pi * distance * (1.0 - 1.0 / length))
    return np.asarray(np.sinc(distance) / np.sinc(distance / length) * turn)


def _ramp_kernel(distance: FloatArray, length: int) -> ComplexArray:
    """Return the transform of a complex sine that grows from -1 to 1 over the record, at `distance` bins from it."""
    angle = np.pi * distance
    size = (np.cos(angle) - np.sinc(distance)) / np.where(angle == 0.0, 1.0, angle)
    return np.asarray(1j * size * np.exp(-1j * angle * (1.0 - 1.0 / length)))
