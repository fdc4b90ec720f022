"""The free oscillation after a release, decimated: what the poles of a load are fitted to."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from shaker._checks import ComplexArray, FloatArray, check_shape
from shaker.models.step.reading import Reading
from shaker.models.step.record import StepRecord

RATE_OVER_FIRST = 16.0
"""Sampling rate over the first resonance: second modes up to six times the first stay in the passband."""
PASSBAND = 0.42
"""Edge of the decimating filter's passband over the rate it decimates to."""
TAPS = 20
"""Length of the decimating filter in samples of the decimated record."""
FEWEST = 64


@dataclass(frozen=True)
class FreeDecay:
    """The output of one record from the end of its release on: `value` (N,) in output units at `time_s` (N,).

    Low-pass filtered and decimated by `decimation`. A filter scales every exponential by a number of its own, which the
    free amplitudes take up; so does the release, whatever its shape, once it is over. Poles stay as they are.
    """

    name: str
    time_s: FloatArray
    value: FloatArray
    decimation: int

    def __post_init__(self) -> None:
        check_shape("value", self.value, self.time_s.shape)

    @property
    def rate_hz(self) -> float:
        """Sampling rate."""
        return float((len(self.time_s) - 1) / (self.time_s[-1] - self.time_s[0]))


def free_decay(record: StepRecord, channel: str, reading: Reading) -> FreeDecay:
    """Return the free oscillation of one channel after its release, of which `reading` says when it is over."""
    from scipy.signal import firwin, upfirdn

    begin = reading.onset_s + 2.0 * reading.u_onset_s + reading.release_s + reading.u_release_s
    first = int(np.ceil((begin - record.start_s) * record.sample_rate_hz)) + 1
    value = record.samples[record.channels.index(channel)][max(first, 0) :]
    if len(value) < FEWEST:
        raise ValueError(f"record: expected {FEWEST} samples of {record.name} after the release, found {len(value)}")
    peak = _highest(value - reading.steady, record.sample_rate_hz)
    decimation = max(1, int(record.sample_rate_hz / (RATE_OVER_FIRST * peak)))
    time_s = record.start_s + (max(first, 0) + np.arange(len(value))) / record.sample_rate_hz
    if decimation > 1 and len(value) >= (TAPS + FEWEST) * decimation:
        taps = firwin(TAPS * decimation + 1, PASSBAND, window=("kaiser", 6.0), fs=float(decimation))
        whole = (len(value) - len(taps)) // decimation + 1
        value = upfirdn(taps, value - reading.steady, 1, decimation)[TAPS : TAPS + whole] + reading.steady
        time_s = time_s[TAPS * decimation // 2 :: decimation][:whole]
    else:
        decimation = 1
    return FreeDecay(record.name, time_s, np.asarray(value), decimation)


def projected(decay: FreeDecay, poles: ComplexArray) -> tuple[FloatArray, FloatArray]:
    """Return what free amplitudes of modes (M,) and a level leave (N,), and its derivatives (N, 2M) by Re p and Im p.

    y = b + Σ Re{a_m exp(p_m t)} with b and a_m by linear least squares (variable projection, Golub & Pereyra 1973, the
    derivatives in Kaufman's form).
    """
    t = decay.time_s - decay.time_s[0]
    waves = np.exp(t[:, None] * poles)
    design = np.hstack([np.ones((len(t), 1)), waves.real, -waves.imag])
    basis, triangle = np.linalg.qr(design)
    along = basis.T @ decay.value
    amplitude = np.linalg.solve(triangle, along)[1:].reshape(2, -1)
    swing = t[:, None] * waves * (amplitude[0] + 1j * amplitude[1])
    slope = -np.stack([swing.real, -swing.imag], axis=2).reshape(len(t), -1)
    return decay.value - basis @ along, slope - basis @ (basis.T @ slope)


def coloured(slope: FloatArray, residual: FloatArray) -> FloatArray:
    """Return Jᵀ R J (P, P): derivatives (N, P) and the autocovariance R of the noise that the residual (N,) shows.

    R has the residual's periodogram, smoothed over neighbouring lines, as its spectrum.
    """
    count = len(residual)
    power = np.abs(np.fft.rfft(residual)) ** 2 / count
    width = min(101, max(3, len(power) // 8) | 1)
    padded = np.pad(power, width // 2, mode="reflect")
    smooth = np.convolve(padded, np.full(width, 1.0 / width), mode="valid")
    lines = np.fft.rfft(slope, axis=0)
    weight = np.full(len(smooth), 2.0)
    weight[0] = 1.0
    if count % 2 == 0:
        weight[-1] = 1.0
    return np.asarray((lines.conj().T * (smooth * weight / count)) @ lines).real


def _highest(value: FloatArray, rate_hz: float) -> float:
    """Frequency in Hz of the highest line of the spectrum, to a line."""
    window = np.hanning(len(value))
    size = np.abs(np.fft.rfft((value - np.mean(value)) * window))
    size[:3] = 0.0
    return float(np.argmax(size)) * rate_hz / len(value)
