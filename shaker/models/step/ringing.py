"""What rings after a release: start values of its poles."""

from __future__ import annotations

import numpy as np

from shaker._checks import ComplexArray, FloatArray

_POINTS = 240  # samples of the ringing that the pencil takes
_PER_PERIOD = 8  # of them per period of the highest line
_LINE = 6.0  # noise levels that a line of the spectrum must stand above
_SMALL = 3e-3  # share of the highest line below which others are left out
_MODES = 3


def ringing_poles(samples: FloatArray, sample_rate_hz: float, noise: float) -> ComplexArray:
    """Return the upper poles (M,) in rad/s of a free decay (N,) about zero, the strongest first, none where none rings.

    Matrix pencil (Hua & Sarkar 1990) of block means; the number of modes follows from the singular values above the
    noise.
    """
    highest = _highest_line(samples, sample_rate_hz, noise)
    if highest is None:
        return np.zeros(0, dtype=np.complex128)
    block = max(1, int(sample_rate_hz / (_PER_PERIOD * highest)))
    count = min(len(samples) // block, _POINTS)
    means = samples[: count * block].reshape(count, block).mean(axis=1)
    poles, weights = pencil(means, noise / np.sqrt(block), 2 * _MODES)
    poles = poles * sample_rate_hz / block
    upper = (poles.imag > 0) & (np.abs(poles.imag) < 0.9 * np.pi * sample_rate_hz / block)
    upper &= np.abs(poles.real) < 0.7 * np.abs(poles)
    order = np.argsort(-np.abs(weights[upper]), kind="stable")
    return np.asarray(poles[upper][order])


def pencil(samples: FloatArray, noise: float, most: int) -> tuple[ComplexArray, ComplexArray]:
    """Return poles (P,) per sample and weights (P,) of Σ w·exp(p n) in samples (N,), P at most `most`."""
    length = len(samples) // 3
    hankel = np.lib.stride_tricks.sliding_window_view(samples, length + 1)
    _, size, right = np.linalg.svd(hankel, full_matrices=False)
    # the largest singular value of a white Hankel matrix, about σ(√rows + √columns), is passed by a margin
    threshold = 1.5 * noise * (np.sqrt(hankel.shape[0]) + np.sqrt(hankel.shape[1]))
    kept = int(np.clip(np.count_nonzero(size > max(threshold, 1e-9 * size[0])), 2, most))
    kept += kept % 2
    basis = right[:kept].T
    moved = np.linalg.lstsq(basis[:-1], basis[1:], rcond=None)[0]
    poles = np.log(np.linalg.eigvals(moved).astype(np.complex128))
    powers = np.exp(np.outer(np.arange(len(samples)), poles))
    weights = np.linalg.lstsq(powers, samples.astype(np.complex128), rcond=None)[0]
    return np.asarray(poles), np.asarray(weights)


def _highest_line(samples: FloatArray, sample_rate_hz: float, noise: float) -> float | None:
    """Return the highest frequency at which the spectrum has a line above noise and above a share of the strongest."""
    count = len(samples)
    window = np.cos(0.5 * np.pi * np.arange(count) / count) ** 2
    size = np.abs(np.fft.rfft(samples * window))
    floor = max(_LINE * noise * float(np.sqrt(np.sum(window**2))), _SMALL * float(size[2:].max(initial=0.0)))
    inner = size[2:-1]
    lines = np.flatnonzero((inner > size[1:-2]) & (inner >= size[3:]) & (inner > floor)) + 2
    return float(lines[-1] * sample_rate_hz / count) if lines.size else None
