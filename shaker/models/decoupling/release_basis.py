"""What poles answer to a release, in averages over blocks of samples, with the slopes that a fit needs."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np

from shaker._checks import ComplexArray, FloatArray

Shape = Literal["ramp", "smooth"]
SHORTEST = 1e-3
"""A release shorter than this share of a sample counts as a step."""


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
        for part, found in zip(parts, _sampled(p, tau, length, blocks.rate_hz, shape), strict=True):
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


def _sampled(p: ComplexArray, tau: FloatArray, length: float, rate_hz: float, shape: Shape) -> tuple[ComplexArray, ...]:
    """Answers and slopes over p, onset and duration at single times since the onset."""
    found = tuple(np.zeros((len(tau), len(p)), dtype=np.complex128) for _ in range(4))
    single = SampleBlocks(0.0, rate_hz, 1, 1)
    after, during = tau >= length, (tau > 0.0) & (tau < length)
    for whole, part in zip(found, _after(p, tau[after] - length, length, single, shape), strict=True):
        whole[after] = part
    if during.any():
        follow = _along_line if shape == "ramp" else _along_cosine
        for whole, part in zip(found, follow(p, tau[during][:, None], length), strict=True):
            whole[during] = part
    return found


def _along_line(p: ComplexArray, t: FloatArray, length: float) -> tuple[ComplexArray, ...]:
    """Answers and slopes while the load goes along a line: y = (expm1(pt)/p - t)/(pT)."""
    grown = np.expm1(p * t)
    value = (grown / p - t) / (p * length)
    by_pole = (t * (grown + 1.0) - grown / p) / (p**2 * length) - value / p
    return value, by_pole, -(p * value + t / length), -value / length


def _along_cosine(p: ComplexArray, t: FloatArray, length: float) -> tuple[ComplexArray, ...]:
    """Answers and slopes while the load goes along half a cosine, w = π/T.

    y = expm1(pt)/(2p) - (p e^{pt} - p cos wt + w sin wt)/(2(p² + w²)).
    """
    turn = np.pi / length
    cosine, sine = np.cos(turn * t), np.sin(turn * t)
    grown, below = np.exp(p * t), p**2 + turn**2
    above = p * grown - p * cosine + turn * sine
    value = np.expm1(p * t) / (2 * p) - above / (2 * below)
    by_pole = (t * grown - np.expm1(p * t) / p) / (2 * p)
    by_pole += p * above / below**2 - ((1.0 + p * t) * grown - cosine) / (2 * below)
    by_turn = turn * above / below**2 - (p * t * sine + sine + turn * t * cosine) / (2 * below)
    return value, by_pole, -(p * value + (1.0 - cosine) / 2.0), -by_turn * turn / length
