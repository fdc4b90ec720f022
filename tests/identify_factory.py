"""A small campaign of two loads on one axial spring: short chirps, and sines whose output passes a lag of the chain."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from support import write_daq

from fusion.recording.toml import to_toml
from fusion.simulate.chirp import Chirp, SimulatedSuspension, rig_file, write_chirps
from fusion.simulate.preset import read_preset
from fusion.simulate.world import Draws, true_part

QUICK = read_preset(Chirp, "chirp.chirp", sample_rate_hz=12800.0, period_s=0.64, periods=4, band_hz=(800.0, 2400.0))
SMALL = read_preset(SimulatedSuspension, "masses", chirp=QUICK)
STIFFNESS, DAMPING, LAG_S, SENSITIVITY = SMALL.stiffness[0], SMALL.damping[0], 50e-6, 2e-7
SINES_HZ = (200.0, 400.0, 600.0, 800.0, 1000.0)
SINE_LOAD = "9kg"
TOP = (0.0, 0.0, 0.1)
Below = Callable[..., NDArray[np.complex128]]
_RATE_HZ, _LENGTH_S, _DRIVE_MPS2, _NOISE = 12800.0, 0.5, 20.0, 2e-3


def write_campaign(folder: Path, suspension: SimulatedSuspension = SMALL, seed: int = 1) -> Path:
    """Write rigs and a chirp of each load into a new folder and return it; uncertain quantities are drawn."""
    folder.mkdir(parents=True)
    write_chirps(folder, suspension, Draws(seed, True))
    return folder


def write_sines(
    folder: Path, seed: int = 1, suspension: SimulatedSuspension = SMALL, below: Below = SMALL.transfer
) -> list[Path]:
    """Add a recording of each sine to a campaign and return their folders.

    `below`: motion of the mass on the sensor's spring over that of the base; for a rigid load, motion of the load.
    """
    return [_write_sine(folder, frequency, seed, suspension, below) for frequency in SINES_HZ]


def _write_sine(folder: Path, frequency: float, seed: int, suspension: SimulatedSuspension, below: Below) -> Path:
    """One sine: acceleration of base and load, output Fz."""
    draws, rng = Draws(seed, True), np.random.default_rng([seed, round(frequency)])
    load, internal = true_part(SMALL.loads[SINE_LOAD], draws), true_part(SMALL.internal, draws)
    recording = folder / f"sine-{frequency:04.0f}"
    recording.mkdir()
    s = 2j * np.pi * frequency
    known = load, internal, TOP, np.array([frequency])
    top, spring = _DRIVE_MPS2 * complex(suspension.transfer(*known)[0]), _DRIVE_MPS2 * complex(below(*known)[0])
    force = (STIFFNESS + s * DAMPING) * (_DRIVE_MPS2 - spring) / s**2
    output = SENSITIVITY * force / (1.0 + s * DAMPING / STIFFNESS) / (1.0 + s * LAG_S)
    time_s = np.arange(round(_LENGTH_S * _RATE_HZ)) / _RATE_HZ
    turning = np.exp(s * time_s)
    measured = {"base_motion": (_DRIVE_MPS2, _NOISE), "top_motion": (top, _NOISE), "bridge": (output, 1e-10)}
    signals = {name: (x * turning).real + u * rng.standard_normal(len(time_s)) for name, (x, u) in measured.items()}
    write_daq(recording / "daq.h5", _RATE_HZ, signals)
    motion = {"quantity": "acceleration", "direction": [0.0, 0.0, 1.0], "scale_uncertainty": 2e-4}
    channels = [
        {"name": "base_motion", **motion, "body": "base", "point": [0.0, 0.0, -0.05]},
        {"name": "top_motion", **motion, "body": "load", "point": [0.0, 0.0, 0.1]},
        {"name": "bridge", "quantity": "output", "channel": "Fz", "scale_uncertainty": 1e-4},
    ]
    excitation = {"kind": "sine", "direction": [0.0, 0.0, 1.0], "frequencies": [frequency], "harmonics": []}
    daq = {"name": "daq", "file": "daq.h5", "clock_uncertainty": 1e-6, "channel": channels}
    names = {"name": f"sine {frequency:g} Hz", "rig": f"../{rig_file(SINE_LOAD)}"}
    tables = {"format": 1, **names, "excitation": excitation, "daq": [daq]}
    (recording / "recording.toml").write_text(to_toml(tables), encoding="utf-8")
    return recording
