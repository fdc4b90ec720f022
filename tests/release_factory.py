"""Records of releases, integrated step by step by scipy: nothing of the program makes them."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache

import numpy as np
from numpy.typing import NDArray
from scipy.signal import lsim

from shaker.release.record import ReleaseReading, StepRecord

FloatArray = NDArray[np.float64]
_FINE = 10


@dataclass(frozen=True)
class Truth:
    """A sensor of modes (`frequency_hz`, their `share` of the static gain) behind a lag, and its release."""

    frequency_hz: tuple[float, ...] = (1700.0,)
    share: tuple[float, ...] = (1.0,)
    damping_ratio: float = 0.015
    lag_hz: float | None = 6000.0
    onset_s: float = 10.0371e-3
    release_s: float = 0.4e-3
    smooth: bool = False
    gain: float = 0.05
    amplitude: float = -20.0
    baseline: float = 1.0
    rate_hz: float = 100e3
    length_s: float = 60e-3

    def load(self, time_s: FloatArray) -> FloatArray:
        """Share of the load's change."""
        x = np.clip((time_s - self.onset_s) / max(self.release_s, 1e-12), 0.0, 1.0)
        return np.asarray(0.5 - 0.5 * np.cos(np.pi * x) if self.smooth else x)

    def transfers(self) -> list[tuple[FloatArray, FloatArray]]:
        """Numerator and denominator in s of every mode behind the lag, over the load's share of the static change."""
        parts = []
        for frequency, share in zip(self.frequency_hz, self.share, strict=True):
            omega = 2 * np.pi * frequency
            bottom, top = np.array([1.0, 2 * self.damping_ratio * omega, omega**2]), share * omega**2
            if self.lag_hz is not None:
                corner = 2 * np.pi * self.lag_hz
                bottom, top = np.polymul(bottom, [1.0, corner]), top * corner
            parts.append((np.array([top]), bottom))
        return parts

    def response(self, frequency_hz: FloatArray) -> NDArray[np.complex128]:
        """Output over load at frequencies (K,)."""
        s = 2j * np.pi * np.asarray(frequency_hz)
        return self.gain * sum(np.polyval(top, s) / np.polyval(bottom, s) for top, bottom in self.transfers())

    def clean(self) -> FloatArray:
        """Output (N,) without noise; integrated once."""
        return _integrated(self)

    def record(self, rng: np.random.Generator, ratio_db: float, resolution: float = 0.0) -> StepRecord:
        """Record with white noise so far below the change, and the steps of a converter."""
        clean = self.clean()
        noise = abs(self.gain * self.amplitude) * 10 ** (-ratio_db / 20)
        samples = clean + noise * rng.standard_normal(len(clean))
        return self.of(np.round(samples / resolution) * resolution if resolution else samples)

    def of(self, samples: FloatArray) -> StepRecord:
        """Record of other samples (N,) or (C, N)."""
        rows = np.atleast_2d(samples)
        return StepRecord("release", ("Fz", "Mx")[: len(rows)], "V", rows, self.rate_hz, "Fz", self.amplitude)


@cache
def _integrated(truth: Truth) -> FloatArray:
    time = np.arange(round(truth.length_s * truth.rate_hz) * _FINE) / (truth.rate_hz * _FINE)
    total = sum(lsim(transfer, truth.load(time), time)[1] for transfer in truth.transfers())
    return np.asarray(truth.baseline + truth.gain * truth.amplitude * total[::_FINE])


def reading_of(record: StepRecord, onset_s: float, release_s: float = 0.0, **stated: object) -> ReleaseReading:
    """What is known of the only channel of a record; levels are means of its samples."""
    samples = record.samples[0]
    before = samples[: int(onset_s * record.sample_rate_hz) - 10]
    baseline, steady = float(np.mean(before)), float(np.mean(samples[-len(samples) // 5 :]))
    gain = (steady - baseline) / record.amplitude
    times = {"onset_s": onset_s, "u_onset_s": 1e-5, "release_s": release_s, "u_release_s": 0.1 * release_s + 1e-6}
    rise = {"rise_s": 1e-4 + release_s, "u_rise_s": 1e-5, "shape": "ramp" if release_s else "step"}
    levels = {"baseline": baseline, "u_baseline": 0.01, "steady": steady, "u_steady": 0.01, "noise": np.std(before)}
    gains = {"sign": int(np.sign(steady - baseline)), "static_gain": gain, "u_static_gain": 1e-3, "clipped": False}
    names = {"record": record.name, "channel": record.channels[0], "component": record.component, "unit": record.unit}
    return ReleaseReading(**{**names, "release": "", **times, **rise, **levels, **gains, **stated})  # type: ignore[arg-type]


def two_masses(moving: float, load: float, numbers: FloatArray) -> FloatArray:
    """State matrix of [x_E, x_L, v_E, v_L]: the sensor's mass on k, c, and on it the load's on k_L, c_L.

    Of [x_E, v_E] alone without load.
    """
    k, c, kl, cl = numbers
    if load == 0.0:
        return np.array([[0.0, 1.0], [-k / moving, -c / moving]])
    matrix = np.zeros((4, 4))
    matrix[:2, 2:] = np.eye(2)
    matrix[2] = np.array([-(k + kl), kl, -(c + cl), cl]) / moving
    matrix[3] = np.array([kl, -kl, cl, -cl]) / load
    return matrix


def other_numbers(numbers: FloatArray, moving: float, load: float) -> FloatArray:
    """The other k, c, k_L, c_L (4,) with the same poles at one load mass.

    With K = k + c s and K_L = k_L + c_L s the poles are those of m_E m_L s⁴ + [m_L K + (m_E + m_L) K_L] s² + K K_L. It
    stays the same where K' = K_L (m_E + m_L)/m_L and K_L' = K m_L/(m_E + m_L), for any damping.
    """
    ratio = (moving + load) / load
    k, c, kl, cl = numbers
    return np.array([kl * ratio, cl * ratio, k / ratio, c / ratio])
