"""Records of releases, integrated step by step by scipy: nothing of the program makes them."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray
from scipy.signal import lsim

from shaker.release.record import StepRecord

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
    _made: dict[str, FloatArray] = field(default_factory=dict, compare=False)

    def load(self, time_s: FloatArray) -> FloatArray:
        """Share of the load's change."""
        x = np.clip((time_s - self.onset_s) / max(self.release_s, 1e-12), 0.0, 1.0)
        return np.asarray(0.5 - 0.5 * np.cos(np.pi * x) if self.smooth else x)

    def clean(self) -> FloatArray:
        """Output (N,) without noise; integrated once."""
        if "clean" not in self._made:
            time = np.arange(round(self.length_s * self.rate_hz) * _FINE) / (self.rate_hz * _FINE)
            load, total = self.load(time), np.zeros(len(time))
            for frequency, share in zip(self.frequency_hz, self.share, strict=True):
                omega = 2 * np.pi * frequency
                bottom = np.array([1.0, 2 * self.damping_ratio * omega, omega**2])
                top = share * omega**2
                if self.lag_hz is not None:
                    corner = 2 * np.pi * self.lag_hz
                    bottom, top = np.polymul(bottom, [1.0, corner]), top * corner
                total += lsim(([top], bottom), load, time)[1]
            self._made["clean"] = np.asarray(self.baseline + self.gain * self.amplitude * total[::_FINE])
        return self._made["clean"]

    def record(self, rng: np.random.Generator, ratio_db: float, resolution: float = 0.0) -> StepRecord:
        """Record with white noise so far below the change, and the steps of a converter."""
        clean = self.clean()
        noise = abs(self.gain * self.amplitude) * 10 ** (-ratio_db / 20)
        samples = clean + noise * rng.standard_normal(len(clean))
        if resolution:
            samples = np.round(samples / resolution) * resolution
        return self.of(samples)

    def of(self, samples: FloatArray, **more: object) -> StepRecord:
        """Record of other samples (N,) or (C, N)."""
        rows = np.atleast_2d(samples)
        names = ("Fz", "Mx", "My")[: len(rows)]
        return StepRecord("release", names, "V", rows, self.rate_hz, "Fz", self.amplitude, **more)  # type: ignore[arg-type]


def two_masses(moving: float, load: float, numbers: FloatArray) -> FloatArray:
    """State matrix of [x_E, x_L, v_E, v_L]: the sensor's mass on k, c, and on it the load's on k_L, c_L."""
    k, c, kl, cl = numbers
    matrix = np.zeros((4, 4))
    matrix[:2, 2:] = np.eye(2)
    matrix[2] = np.array([-(k + kl), kl, -(c + cl), cl]) / moving
    matrix[3] = np.array([kl, -kl, cl, -cl]) / load
    return matrix
