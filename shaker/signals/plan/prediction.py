"""How uncertain the amplitudes of a least-squares fit of sines will be, before anything is measured."""

from __future__ import annotations

import numpy as np

from shaker._checks import FloatArray, check_shape
from shaker.signals.folding import condition_number, sine_columns

_REFINEMENT = 16  # points of the noise integral per bin of the record


def amplitude_covariance(
    frequency_hz: FloatArray, rate_hz: float, frames: int, corner_hz: float = 0.0
) -> tuple[FloatArray, float]:
    """Return the covariance (K, 2, 2) of the fitted cosine and sine amplitudes of lines (K,), and the condition number.

    For an ordinary least-squares fit of the lines and an offset to `frames` uniform samples, disturbed by noise of
    spectral density S(f) = (2/rate)·(1 + corner/f): white with unit variance per frame, and 1/f noise that is as
    strong at `corner_hz`. With C = (XᵀX)⁻¹Xᵀ the covariance is (XᵀX)⁻¹ + ∫(corner/|f|)·C(f)·C(f)ᴴ df/rate, where C(f)
    are the Fourier transforms of the rows of C; for well separated lines both quadratures have (2/frames)·(1 +
    corner/alias). The integral is finite because the fitted offset takes out what is constant.
    """
    check_shape("frequency_hz", frequency_hz, (None,))
    lines = len(frequency_hz)
    if not frames > 2 * lines + 1:
        raise ValueError(f"frames: expected more than {2 * lines + 1} for {lines} lines and an offset, found {frames}")
    columns = sine_columns(np.arange(frames) / rate_hz, frequency_hz)
    gram = columns.T @ columns
    condition = condition_number(gram)
    if not np.isfinite(condition):
        return np.full((lines, 2, 2), np.inf), condition
    inverse = np.linalg.inv(gram)
    covariance = inverse if corner_hz == 0.0 else inverse + _coloured(inverse @ columns.T, rate_hz, corner_hz)
    pairs = np.arange(2 * lines).reshape(lines, 2)
    return np.asarray(2.0 / frames * covariance[pairs[:, :, None], pairs[:, None, :]]), condition


def rms_uncertainty(covariance: FloatArray) -> FloatArray:
    """Return √(trace/2) of covariances (K, 2, 2): the standard uncertainty of an amplitude, over all phases (K,)."""
    return np.asarray(np.sqrt(np.trace(covariance, axis1=1, axis2=2) / 2.0))


def _coloured(rows: FloatArray, rate_hz: float, corner_hz: float) -> FloatArray:
    """Return the covariance (P, P) that 1/f noise leaves in the coefficients rows (P, S) · samples."""
    length = _REFINEMENT * rows.shape[1]
    response = np.fft.rfft(rows, n=length, axis=1)[:, 1:]  # at zero the offset takes all
    density = corner_hz / (rate_hz / length * np.arange(1, response.shape[1] + 1))
    weight = np.full(response.shape[1], 2.0 / length)
    weight[-1] = 1.0 / length  # the length is even: the Nyquist frequency counts once
    return np.asarray(((response * (weight * density)) @ response.conj().T).real)
