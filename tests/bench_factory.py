"""A bench without cameras: any channels on a load of 2 kg, one output of the sensor below it, all as one sine."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import h5py
import numpy as np
from support import AT_ORIGIN, block, channel, recording_head

MASS_KG, SENSITIVITY, LINE_HZ = 2.0, 2e-6 * np.exp(-0.05j), 106.25
ACCELERATION = 50.0 * np.exp(0.4j)
RATE_HZ, SAMPLES = 10e3, 10_000
SENSOR = {"name": "s", "channels": ["Fz"], "unit": "V/V", "sense": "on_load", "internal_mass": 0.0}
LOAD = {"mass": MASS_KG, "mass_uncertainty": 1e-4, "centre_of_mass": [0.0] * 3, "inertia": np.diag([1e-3] * 3).tolist()}
SHAKER = {"transverse_motion": 1e-3, "rocking_motion": 1e-3}


@dataclass(frozen=True)
class Bench:
    """Channel `signal` in the file: phasor in the unit that the file states, what the manifest says of it."""

    phasor: complex
    unit: str | None
    quantity: str = "acceleration"
    keys: Mapping[str, Any] = field(default_factory=dict)

    def block(self, name: str) -> str:
        """Return the channel in the manifest; by default at the origin along z."""
        if self.quantity == "output":
            return channel(name, "output", **{"channel": name, **self.keys})
        position = {"body": "load", **AT_ORIGIN} if self.quantity not in ("force", "voltage") else {}
        return channel(name, self.quantity, **{**position, **self.keys})


FORCE_OUTPUT = Bench(SENSITIVITY * MASS_KG * ACCELERATION, "V/V", "output")


def write_bench(
    folder: Path,
    channels: Mapping[str, Bench],
    *,
    noise: float = 1e-6,
    seed: int = 1,
    sensor: Mapping[str, Any] | None = None,
    load: Mapping[str, Any] | None = None,
    shaker: Mapping[str, Any] | None = None,
    **excitation: Any,
) -> Path:
    """Write rig and recording of some channels; `noise` relative to each of them."""
    run, rng = folder / "run", np.random.default_rng(seed)
    run.mkdir(parents=True)
    rig = block(format=1, name="bench") + block("sensor", **{**SENSOR, **(sensor or {})})
    rig += block("load", **{**LOAD, **(load or {})}) + block("shaker", **(SHAKER if shaker is None else shaker))
    (folder / "rig.toml").write_text(rig, encoding="utf-8")
    hertz = excitation.pop("hertz", LINE_HZ)
    text = recording_head("run 1", hertz, **excitation)
    time_s = np.arange(SAMPLES) / RATE_HZ
    with h5py.File(run / "daq.h5", "w") as file:
        file.attrs["sample_rate"] = RATE_HZ
        for name, bench in channels.items():
            samples = (bench.phasor * np.exp(2j * np.pi * hertz * time_s)).real
            file[name] = samples + noise * abs(bench.phasor) * rng.normal(size=SAMPLES)
            if bench.unit is not None:
                file[name].attrs["unit"] = bench.unit
            text += bench.block(name)
    (run / "recording.toml").write_text(text, encoding="utf-8")
    return run
