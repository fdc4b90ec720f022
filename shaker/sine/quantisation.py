"""Effect of converter steps on a sine approximation."""

from __future__ import annotations

import numpy as np

from shaker.sine.solve import SineFit
from shakercal._common.arrays import ComplexArray, FloatArray

_MOST = 1 << 21  # values of the exponentials of all lines
_LONGEST = 1 << 15  # samples that are rounded
_OFFSETS, _SIZES = 4, np.arange(-16, 17) / 32.0  # offsets between two steps; changes of the amplitude, in steps
_SHIFTS, _GOLDEN = 6, (5.0**0.5 - 1.0) / 2.0  # phases of the sampling times between two samples, and their increment
_UNDITHERED = 0.1  # of a step: noise below which rounding is that of the sine alone
_DITHERED = 0.8  # of a step: with more noise less than 1e-5 of a step is left
_TERMS = 30.0  # exponent at which terms of the series end


def quantisation_error(fit: SineFit, channel: int, time_s: FloatArray, step: float) -> ComplexArray:
    """Return the largest relative change of each line (K,) by rounding.

    Its real and imaginary part are those of the change; samples are rounded to a `step`. Rounding x + noise of standard
    deviation σ to multiples of q adds, on average over the noise, Σ (-1)^m q/(πm)·exp(-2π²m²σ²/q²)·sin(2πm·x/q). For
    one sine between two steps that changes its amplitude A by Σ (-1)^m 2q/(πm)·J₁(2πmA/q)·cos(2πm·offset/q) without
    noise (Widrow and Kollár, Quantization Noise, 2008). Samples that are synchronous with the line add the terms that
    alias onto it.

    The sum is evaluated at the sampling times, for all lines together. The largest change over offsets, over amplitudes
    within a step and over sampling times within an interval is returned, because synchronous samples do not show where
    between them a step lies. Lines below half a step may be caused by rounding alone. The noise is that around each
    line, at most the residual, minus the q²/12 that rounding may contribute.
    """
    phasors, value = fit.phasors, fit.phasors.value[:, channel]
    count = min(len(time_s), _LONGEST, max(_MOST // max(len(value), 1), 256))
    time, size = time_s[:count], float(np.max(np.abs(value)))
    near = 0.5 * len(time_s) * float(np.min(phasors.u_re[:, channel] ** 2 + phasors.u_im[:, channel] ** 2)) / 2.0
    noise = np.sqrt(max(min(near, float(fit.residual_rms[channel]) ** 2) - step**2 / 12.0, 0.0)) / step
    if noise > _DITHERED:
        return np.zeros(len(value), dtype=np.complex128)
    used_lines = np.where(np.abs(value) > min(0.5 * step, 0.5 * size), value, 0.0)
    sizes = _SIZES if size > step else np.zeros(_SHIFTS)
    interval = float(time[-1] - time[0]) / (count - 1)
    largest = np.zeros((2, len(value)))
    for number, late in enumerate(np.arange(_SHIFTS) * _GOLDEN % 1.0 * interval):
        turns = np.exp(-2j * np.pi * np.multiply.outer(phasors.frequency_hz, time + late))
        curve = (used_lines.conj() @ turns).real / step
        for scale in 1.0 + sizes[number::_SHIFTS] * step / size:
            for offset in np.arange(_OFFSETS) / _OFFSETS:
                change = turns @ _rounding(scale * curve + offset, noise) * (2.0 / count * step)
                relative = np.divide(change, value, out=np.zeros_like(change), where=value != 0.0)
                largest = np.maximum(largest, np.abs([relative.real, relative.imag]))
    return np.asarray(largest[0] + 1j * largest[1])


def _rounding(values: FloatArray, noise: float) -> FloatArray:
    """Return the mean error (S,) of rounding values with noise to whole numbers."""
    if noise < _UNDITHERED:
        return np.asarray(np.rint(values) - values)
    orders = np.arange(1, int(np.ceil(np.sqrt(_TERMS / 2.0) / (np.pi * noise))) + 1)
    total = np.zeros_like(values)
    for m in orders.tolist():
        total += (-1.0) ** m / (np.pi * m) * np.exp(-2.0 * (np.pi * m * noise) ** 2) * np.sin(2.0 * np.pi * m * values)
    return total
