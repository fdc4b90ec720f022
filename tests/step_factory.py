"""Small campaigns of step recordings on disk, their outputs made by scipy's state-space solver."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

import h5py
import numpy as np
from numpy.typing import NDArray
from scipy import signal

FloatArray = NDArray[np.float64]
RATE_HZ = 50_000.0
FINE = 8
RIG = """format = 1
name = "rope rig"

[sensor]
name = "test sensor"
serial = "7"
channels = ["Fx", "Fz"]
unit = "V/V"
sense = "on_sensor"
static_sensitivity = [[0.0, 0.0, 2e-8, 0.0, 0.0, 0.0], [0.0, 0.0, 2e-6, 0.0, 0.0, 0.0]]
static_sensitivity_uncertainty = 1e-3
internal_mass = 0.05
"""


@dataclass(frozen=True)
class Truth:
    """A second-order sensor behind a first-order amplifier, and its releases by one rope."""

    frequency_hz: float = 1700.0
    damping_ratio: float = 0.015
    chain_hz: float = 6000.0
    gain: float = 2e-6
    amplitude: float = -100.0
    onset_s: float = 0.00513
    release_s: float = 2e-4
    noise: float = 2e-7
    length_s: float = 0.05
    cross: float = 0.01

    @property
    def transfer(self) -> tuple[FloatArray, FloatArray]:
        """Numerator and denominator in s of output over load."""
        omega, pole = 2 * np.pi * self.frequency_hz, 2 * np.pi * self.chain_hz
        bottom = np.polymul([1.0, 2 * self.damping_ratio * omega, omega**2], [1.0, pole])
        return np.array([self.gain * omega**2 * pole]), np.asarray(bottom, dtype=np.float64)

    def outputs(self, rng: np.random.Generator) -> tuple[FloatArray, FloatArray]:
        """Load (N,) and outputs Fx, Fz (2, N) of a load that goes along a straight line from `amplitude` to none."""
        time = np.arange(round(self.length_s * RATE_HZ) * FINE) / (RATE_HZ * FINE)
        share = np.clip((time - self.onset_s) / max(self.release_s, 1e-9), 0.0, 1.0)
        load = self.amplitude * share
        _, ringing, _ = signal.lsim(self.transfer, load, time)
        driven = ringing[::FINE] - self.gain * self.amplitude
        both = np.stack([self.cross * driven, driven])
        return load[::FINE], np.asarray(both + self.noise * rng.standard_normal(both.shape), dtype=np.float64)


@dataclass(frozen=True)
class StepFolder:
    """A campaign folder that is being filled."""

    path: Path
    rng: np.random.Generator = field(default_factory=lambda: np.random.default_rng(8))

    def start(self, rig: str = RIG) -> StepFolder:
        """Write rig.toml."""
        self.path.mkdir(parents=True, exist_ok=True)
        (self.path / "rig.toml").write_text(rig, encoding="utf-8")
        return self

    def add(
        self,
        name: str,
        truth: Truth,
        *,
        release: str = "fishing line",
        mounting: str = "1",
        force: bool = False,
        channels: Sequence[str] = ("Fx", "Fz"),
    ) -> Path:
        """Write one release and return its folder."""
        folder = self.path / name
        folder.mkdir()
        load, outputs = truth.outputs(self.rng)
        samples = dict(zip(("Fx", "Fz"), outputs, strict=True))
        with h5py.File(folder / "daq.h5", "w") as file:
            for channel in channels:
                file[channel] = samples[channel]
            if force:
                file["load cell"] = load - truth.amplitude + 0.001 * self.rng.standard_normal(len(load))
            for data in file.values():
                data.attrs["sample_rate"] = RATE_HZ
        text = [
            'format = 1\nrig = "../rig.toml"',
            f'name = "{name}"\nmounting = "{mounting}"\n',
            f'[excitation]\nkind = "step"\ncomponent = "Fz"\nstep_amplitude = {truth.amplitude}\nrelease = "{release}"',
            'force = "load cell"\n' if force else "",
            '[[daq]]\nname = "daq"\nfile = "daq.h5"\n',
            *(f'[[daq.channel]]\nname = "{c}"\nquantity = "output"\nchannel = "{c}"\n' for c in channels),
            '[[daq.channel]]\nname = "load cell"\nquantity = "force"\n' if force else "",
        ]
        (folder / "recording.toml").write_text("\n".join(text), encoding="utf-8")
        return folder
