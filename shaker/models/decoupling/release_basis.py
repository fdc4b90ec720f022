"""What poles answer to a release, in averages over blocks of samples, with the slopes that a fit needs."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np

from shaker._checks import ComplexArray, FloatArray

Shape = Literal["ramp", "smooth"]
SHORTEST = 1e-3
"""A release shorter than this share of a sample counts as a step."""
_DIFFERENCE = 1e-5


@dataclass(frozen=True)
class ReleaseBasis:
    """Answers (A, P) of 1/(s - p) to a load that goes from 0 to 1, and their slopes: over p (analytic), over the middle
    of the release, over its duration with the middle held."""

    value: ComplexArray
    by_pole: ComplexArray
    by_middle: ComplexArray
    by_duration: ComplexArray


@dataclass(frozen=True)
class SampleBlocks:
    """Times of samples that are averaged: `count` blocks of `size` samples at `rate_hz`, the first at `start_s`."""

    start_s: float
    rate_hz: float
    count: int
    size: int


def release_basis(
    poles: ComplexArray, blocks: SampleBlocks, middle_s: float, duration_s: float, shape: Shape
) -> ReleaseBasis:
    """Return what poles (P,) in rad/s answer, averaged over blocks (A,).

    The load goes along a straight line ("ramp") or half a cosine ("smooth") of `duration_s` around `middle_s`. With τ
    from the onset, x = pT and S the release's spectrum, (1 - e^-x)/x or π²(1 + e^-x)/(2(x² + π²)): after the release
    (S e^{pτ} - 1)/p, of which a block's mean is closed; during it sample by sample.
    """
    p = np.asarray(poles, dtype=np.complex128)
    short = duration_s * blocks.rate_hz < SHORTEST
    length = 0.0 if short else duration_s
    onset = middle_s - length / 2.0
    first = blocks.start_s + np.arange(blocks.count) * blocks.size / blocks.rate_hz - onset
    late = first >= length
    touched = ~late & (first + (blocks.size - 1) / blocks.rate_hz > 0.0)
    parts = [np.zeros((blocks.count, len(p)), dtype=np.complex128) for _ in range(4)]
    for part, found in zip(parts, _after(p, first[late] - length, length, blocks, shape), strict=True):
        part[late] = found
    if touched.any():
        tau = (first[touched][:, None] + np.arange(blocks.size) / blocks.rate_hz).ravel()
        for part, found in zip(parts, _sampled(p, tau, length, shape), strict=True):
            part[touched] = found.reshape(-1, blocks.size, len(p)).mean(axis=1)
    value, by_pole, by_onset, by_duration = parts
    return ReleaseBasis(value, by_pole, by_onset, by_duration - by_onset / 2.0)


def _spectrum(x: ComplexArray, shape: Shape) -> tuple[ComplexArray, ...]:
    """Factors (a, b), (a', b') with S = a + b·e^-x and ∂S/∂x = a' + b'·e^-x."""
    if shape == "ramp":
        return 1 / x, -1 / x, -1 / x**2, (1 + x) / x**2
    below = x**2 + np.pi**2
    half = np.pi**2 / 2
    return half / below, half / below, -2 * half * x / below**2, -half / below - 2 * half * x / below**2


def _after(
    p: ComplexArray, since_s: FloatArray, length: float, blocks: SampleBlocks, shape: Shape
) -> tuple[ComplexArray, ...]:
    """Mean answers and slopes over p, onset and duration of blocks whose first sample is `since_s` after the end."""
    inside = np.arange(blocks.size)[:, None] / blocks.rate_hz
    turns = np.exp(inside * p)
    mean, mean_slope = turns.mean(axis=0), (inside * turns).mean(axis=0)
    grown = np.exp(since_s[:, None] * p)
    decay, decay_slope = grown * mean, since_s[:, None] * grown * mean + grown * mean_slope
    if length == 0.0:
        value = (decay - 1) / p
        return value, (decay_slope - value) / p, -decay, -decay / 2
    a, b, a_slope, b_slope = _spectrum(p * length, shape)
    through = np.exp(p * length)
    share, share_slope = a * through + b, a_slope * through + b_slope
    value = (share * decay - 1) / p
    by_pole = (share * decay_slope + length * (share_slope + share) * decay - value) / p
    return value, by_pole, -share * decay, share_slope * decay


def _sampled(p: ComplexArray, tau: FloatArray, length: float, shape: Shape) -> tuple[ComplexArray, ...]:
    """Answers and slopes over p, onset and duration sample by sample."""
    value = _answer(p, tau, length, shape)
    step = _DIFFERENCE * np.abs(p)
    by_pole = (_answer(p + step, tau, length, shape) - _answer(p - step, tau, length, shape)) / (2 * step)
    by_onset = -(p * value + _load(tau, length, shape)[:, None])
    if length == 0.0:
        return value, by_pole, by_onset, by_onset / 2
    change = _DIFFERENCE * length
    longer, shorter = (_answer(p, tau, length + sign * change, shape) for sign in (1.0, -1.0))
    return value, by_pole, by_onset, (longer - shorter) / (2 * change)


def _load(tau: FloatArray, length: float, shape: Shape) -> FloatArray:
    """Load over the time since the onset."""
    if length == 0.0:
        return np.asarray(np.where(tau > 0, 1.0, 0.0))
    share = np.clip(tau / length, 0.0, 1.0)
    return np.asarray(share if shape == "ramp" else (1 - np.cos(np.pi * share)) / 2)


def _answer(p: ComplexArray, tau: FloatArray, length: float, shape: Shape) -> ComplexArray:
    """Answers (N, P) at times since the onset."""
    t = np.maximum(tau, 0.0)[:, None]
    if length == 0.0:
        return np.asarray(np.expm1(p * t) / p)
    within = np.minimum(t, length)
    if shape == "ramp":
        found = (np.expm1(p * within) / p - within) / (p * length)
    else:
        turn = np.pi / length
        forced = p * np.cos(turn * within) - turn * np.sin(turn * within)
        found = np.expm1(p * within) / (2 * p) - (p * np.exp(p * within) - forced) / (2 * (p**2 + turn**2))
    return np.asarray(found * np.exp(p * (t - within)) + np.expm1(p * (t - within)) / p)
