"""Sensors with known poles and residues, their outputs to releases by scipy's discretisation at a finer step."""

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray
from scipy.signal import cont2discrete, lfilter

from shaker.release.record import StepRecord

FloatArray = NDArray[np.float64]
ComplexArray = NDArray[np.complex128]


@dataclass(frozen=True)
class Sensor:
    """Modes that loads drive and outputs show, behind one lag; each load changes by about `size` in `release_s`."""

    loads: tuple[str, ...] = ("Fx", "Fy", "Mz")
    frequency_hz: FloatArray = field(default_factory=lambda: np.array([310.0, 335.0, 560.0]))
    damping: FloatArray = field(default_factory=lambda: np.array([0.02, 0.015, 0.018]))
    lag_hz: float = 700.0
    drive: FloatArray = field(
        default_factory=lambda: np.array([[1.0, 0.06, -0.03], [-0.05, 1.0, 0.04], [0.02, -0.06, 1.0]])
    )
    show: FloatArray = field(
        default_factory=lambda: np.array([[2.0, 0.1, 0.05], [-0.08, 2.0, -0.06], [0.02, 0.03, 0.5]])
    )
    size: FloatArray = field(default_factory=lambda: np.array([10.0, 12.0, 9.0]))
    rate_hz: float = 10e3
    release_s: float = 0.8e-3
    onset_s: float = 20e-3
    count: int = 1400
    finer: int = 20

    def response(self, frequency_hz: FloatArray) -> ComplexArray:
        """H (K, C, D): mode by mode, drive and show, then the lag of the amplifier."""
        s, omega = 2j * np.pi * np.asarray(frequency_hz)[:, None], 2.0 * np.pi * self.frequency_hz
        swing = omega**2 / (s**2 + 2.0 * self.damping * omega * s + omega**2) / (1.0 + s / (2.0 * np.pi * self.lag_hz))
        return np.asarray(np.einsum("cm,km,md->kcd", self.show, swing, self.drive))

    @property
    def residues(self) -> ComplexArray:
        """Residues (M, C, D) of the modes, by partial fractions."""
        omega, corner = 2.0 * np.pi * self.frequency_hz, 2.0 * np.pi * self.lag_hz
        pole = omega * (-self.damping + 1j * np.sqrt(1.0 - self.damping**2))
        swing = omega**2 * corner / ((pole - pole.conj()) * (pole + corner))
        return np.asarray(np.einsum("cm,m,md->mcd", self.show, swing, self.drive))

    def outputs(self, load: FloatArray, component: int) -> FloatArray:
        """Outputs (C, N) to a load in steps `finer` times as short, which is taken to go straight between them."""
        states = []
        for omega, zeta in zip(2.0 * np.pi * self.frequency_hz, self.damping, strict=True):
            below = np.polymul([1.0, 2.0 * zeta * omega, omega**2], [1.0 / (2.0 * np.pi * self.lag_hz), 1.0])
            top, bottom, _ = cont2discrete(([omega**2], below), 1.0 / (self.rate_hz * self.finer), "foh")
            states.append(lfilter(top.ravel(), bottom, load))
        return np.asarray((self.show * self.drive[:, component]) @ np.array(states))[:, :: self.finer]

    def releases(self, seed: int, share: float = 0.01, each: int = 2) -> list[StepRecord]:
        """Loads taken off along lines, `each` times each; noise is a share of every output's own step."""
        rng = np.random.default_rng(seed)
        noise, records = share * self.size * np.diag(self.show @ self.drive), []
        time_s = np.arange(self.count * self.finer) / (self.rate_hz * self.finer)
        for d, name in enumerate(self.loads):
            for k in range(each):
                duration_s, onset_s = self.release_s * rng.uniform(0.8, 1.2), self.onset_s + rng.uniform(0.0, 1e-4)
                amplitude = -float(self.size[d]) * rng.uniform(0.9, 1.0)
                clean = amplitude * self.outputs(np.clip((time_s - onset_s) / duration_s, 0.0, 1.0), d)
                level = rng.standard_normal(len(noise)) - amplitude * self.response(np.zeros(1))[0].real[:, d]
                samples = level[:, None] + clean + noise[:, None] * rng.standard_normal(clean.shape)
                records.append(StepRecord(f"{name}-{k}", self.loads, "V", samples, self.rate_hz, name, amplitude))
        return records


SENSOR = Sensor()
