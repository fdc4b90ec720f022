"""A sampled signal read at other times: band-limited interpolation."""

from __future__ import annotations

import numpy as np

from shaker._checks import FloatArray, check_shape

PASS_BAND = 0.4
"""Share of the lower of the two rates below which a resampled signal is what it was."""
_BETA = 10.06  # Kaiser window of -100 dB
_BLOCK = 1 << 14  # times interpolated at once
_PHASES = 1 << 11  # rows of the kernel's table per sample; linear in between errs by less than 1e-6


def kernel_reach(share: float) -> int:
    """Return how many samples to either side of a time enter its value, at a new rate of `share` of the old one.

    Half of Kaiser's N = (A - 8)/(2.285·Δω) for A = 100 dB and the transition from 0.4 to 0.6 of the lower rate.
    """
    taps = (100.0 - 8.0) / (2.285 * 2.0 * np.pi * (1.0 - 2.0 * PASS_BAND) * share)
    return int(np.ceil(0.5 * taps))


def resampled(samples: FloatArray, position: FloatArray, share: float = 1.0) -> FloatArray:
    """Return samples (S,) at fractional positions (T,), counted in samples from the first one.

    Convolution with a sinc of the pass band up to half of `share` of the sampling rate, under a Kaiser window (Kaiser
    and Schafer, IEEE Trans. Acoust. 28, 1980): a line below 0.4·`share` of the rate keeps amplitude and phase to 3e-5,
    what lies above 0.6·`share`, and would fold onto it at a rate of `share`, is taken out by 100 dB. `share` is the
    new rate over the old one where that is lower. Positions must lie `kernel_reach` inside the record.
    """
    check_shape("samples", samples, (None,))
    check_shape("position", position, (None,))
    if not 0.0 < share <= 1.0:
        raise ValueError(f"share: expected a number above 0 and at most 1, found {share:g}")
    reach = kernel_reach(share)
    low, high = float(position.min(initial=reach)), float(position.max(initial=reach))
    if low < reach - 1 or high > len(samples) - reach:
        raise ValueError(
            f"position: expected {reach - 1} to {len(samples) - reach} samples, found {low:.1f} to {high:.1f}"
        )
    table = _kernel(reach, share)
    offsets = np.arange(1 - reach, reach + 1)
    found = np.empty(len(position))
    for start in range(0, len(position), _BLOCK):
        part = position[start : start + _BLOCK]
        first = np.floor(part).astype(np.int64)
        row, between = np.divmod((part - first) * _PHASES, 1.0)
        place = row.astype(np.int64)
        near = samples[first[:, None] + offsets]
        lower, upper = (np.einsum("ts,ts->t", table[place + step], near) for step in (0, 1))
        found[start : start + _BLOCK] = lower + between * (upper - lower)
    return found


def _kernel(reach: int, share: float) -> FloatArray:
    """Return the weights (phases + 1, 2·reach) of the samples around a time, by its place between two samples."""
    away = np.arange(1 - reach, reach + 1) - np.linspace(0.0, 1.0, _PHASES + 1)[:, None]
    weight = np.sinc(share * away) * np.i0(_BETA * np.sqrt(np.maximum(0.0, 1.0 - (away / reach) ** 2)))
    return np.asarray(weight / weight.sum(axis=1, keepdims=True))
