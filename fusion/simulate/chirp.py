"""A simulated transfer recording: an oscillator on a shaker driven by a periodic chirp, two accelerometers."""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from fusion.simulate.draws import Draws
from fusion.simulate.toml_text import to_toml
from shaker.signals.chain import filter_poles, pole_response

FloatArray = NDArray[np.float64]
ComplexArray = NDArray[np.complex128]

TRUTH_FILE = "truth.json"
RECORDING = "chirp"
DAQ_FILE, FILTER_FILE = "accelerometers.h5", "amplifier.toml"
CORNER_HZ, ORDER = 20e3, 4


@dataclass(frozen=True)
class ChirpRig:
    """Truth and nominal values: oscillator, excitation, sampling; accelerations in m/s^2, times in s."""

    frequency_hz: float = 1477.35
    damping_ratio: float = 0.5 / 66.0
    sample_rate_hz: float = 51.2e3
    period_s: float = 1.0
    periods: int = 6
    settle_periods: int = 1
    band_hz: tuple[float, float] = (200.0, 3000.0)
    amplitude: float = 5.0
    noise: float = 0.02
    scale_uncertainty: float = 2e-3
    delay_uncertainty: float = 0.2e-6
    corner_uncertainty: float = 0.01
    clock_uncertainty: float = 1e-6


def write_chirp(folder: Path, seed: int, rig: ChirpRig | None = None) -> Path:
    """Write `rig.toml` and the recording `chirp` with its truth into an empty folder and return the recording's folder.

    Everything stated as an uncertainty is drawn. The shaker starts from rest, so that the first period is not settled.
    """
    import h5py

    rig = rig or ChirpRig()
    draws = Draws(seed, True)
    recording = folder / RECORDING
    recording.mkdir(parents=True)
    samples = _samples(rig, draws)
    with h5py.File(recording / DAQ_FILE, "w") as file:
        for name, values in samples.items():
            data = file.create_dataset(name, data=values, compression="gzip", shuffle=True)
            data.attrs["sample_rate"] = rig.sample_rate_hz
            data.attrs["unit"] = "V"
    texts = {
        folder / "rig.toml": to_toml({"format": 1, "name": "oscillator on a shaker, simulated"}),
        recording / "recording.toml": to_toml(_recording(rig)),
        recording / FILTER_FILE: to_toml(_amplifier(rig)),
        recording / TRUTH_FILE: json.dumps(_truth(rig, seed, draws)),
    }
    for path, text in texts.items():
        path.write_text(text, encoding="utf-8", newline="\n")
    return recording


def transmissibility(rig: ChirpRig, frequency_hz: FloatArray) -> ComplexArray:
    """Return (1 + 2ζp)/(1 + 2ζp + p²), p = jω/ω₀: acceleration of the mass over that of the base."""
    p = 1j * frequency_hz / rig.frequency_hz
    turned = 1.0 + 2.0 * rig.damping_ratio * p
    return np.asarray(turned / (turned + p * p))


def _samples(rig: ChirpRig, draws: Draws) -> dict[str, NDArray[np.float32]]:
    """Return what both channels hold, in V: true acceleration through sensor, delay, amplifier, noise, converter.

    The record begins at rest: one period of silence precedes the chirps in the transform and is cut off.
    """
    length = round(rig.period_s * rig.sample_rate_hz)
    silent = 2  # periods of rest, in which what the transform wraps around has decayed
    drive = np.concatenate([np.zeros(silent * length), np.tile(_sweep(rig, length), rig.periods)])
    clock = 1.0 + float(draws.normal("daq.clock", rig.clock_uncertainty))  # generator and converter share it
    frequency = clock * np.asarray(np.fft.rfftfreq(len(drive), 1.0 / rig.sample_rate_hz), dtype=np.float64)
    spectrum = np.fft.rfft(drive)
    found = {}
    for name, motion in (("base", np.ones(len(frequency))), ("top", transmissibility(rig, frequency))):
        chain = _true_chain(rig, name, frequency, draws)
        clean = np.fft.irfft(spectrum * motion * chain, len(drive))[silent * length :]
        noise = rig.noise * draws.stream(f"{name}.noise").standard_normal(len(clean))
        found[name] = np.asarray((clean + noise) * 0.01, dtype=np.float32)
    return found


def _sweep(rig: ChirpRig, length: int) -> FloatArray:
    """Return one period (S,) of a chirp with a flat spectrum inside the band and none outside (Schroeder's phases)."""
    harmonic = np.arange(np.ceil(rig.band_hz[0] * rig.period_s), np.floor(rig.band_hz[1] * rig.period_s) + 1.0)
    number = np.arange(len(harmonic))
    spectrum = np.zeros(length // 2 + 1, dtype=np.complex128)
    spectrum[harmonic.astype(np.int64)] = np.exp(-1j * np.pi * number**2 / len(harmonic))
    sweep = np.fft.irfft(spectrum, length)
    return np.asarray(rig.amplitude * sweep / np.abs(sweep).max())


def _true_chain(rig: ChirpRig, name: str, frequency_hz: FloatArray, draws: Draws) -> ComplexArray:
    """Return the response of one chain as it is: scale, delay and corner off by what the manifest leaves open."""
    scale = float(draws.normal(f"{name}.scale", rig.scale_uncertainty))
    delay = float(draws.normal(f"{name}.delay", rig.delay_uncertainty))
    factor = np.exp(-2j * np.pi * frequency_hz * delay) / (1.0 + scale)
    if name == "top":
        corner = CORNER_HZ * (1.0 + float(draws.normal("amplifier.corner", rig.corner_uncertainty)))
        factor = factor * pole_response(frequency_hz, filter_poles("butterworth", ORDER, corner)).value
    return np.asarray(factor)


def _recording(rig: ChirpRig) -> dict[str, Any]:
    """Return recording.toml as nested dictionaries."""
    stated = {
        "scale": 100.0,
        "scale_uncertainty": rig.scale_uncertainty,
        "delay_uncertainty": rig.delay_uncertainty,
    }
    place = {"quantity": "acceleration", "direction": [0.0, 0.0, 1.0]}
    return {
        "format": 1,
        "name": "chirp, base and top acceleration, simulated",
        "rig": "../rig.toml",
        "excitation": {
            "kind": "chirp",
            "direction": [0.0, 0.0, 1.0],
            "band": list(rig.band_hz),
            "period": rig.period_s,
            "settle_periods": rig.settle_periods,
            "reference": ["base"],
            "response": ["top"],
        },
        "daq": [
            {
                "name": "daq",
                "file": DAQ_FILE,
                "clock_uncertainty": rig.clock_uncertainty,
                "channel": [
                    {"name": "base", **place, "body": "base", "point": [0.0, 0.0, -0.05], **stated},
                    {"name": "top", **place, "body": "load", "point": [0.0, 0.0, 0.05], **stated}
                    | {"response": FILTER_FILE},
                ],
            }
        ],
    }


def _amplifier(rig: ChirpRig) -> dict[str, Any]:
    """Return the stated response of the top accelerometer's amplifier as nested dictionaries."""
    element = {"name": "amplifier", "filter": "butterworth", "order": ORDER, "corner": CORNER_HZ}
    return {"format": 1, "element": [{**element, "frequency_uncertainty": rig.corner_uncertainty}]}


def _truth(rig: ChirpRig, seed: int, draws: Draws) -> dict[str, Any]:
    """Return truth.json: the oscillator, its transmissibility at every harmonic of the chirp, and every error drawn."""
    harmonic = np.arange(np.ceil(rig.band_hz[0] * rig.period_s), np.floor(rig.band_hz[1] * rig.period_s) + 1.0)
    frequency = harmonic / rig.period_s
    value = transmissibility(rig, frequency)
    return {
        "format": 1,
        "preset": RECORDING,
        "seed": seed,
        "resonance_hz": rig.frequency_hz,
        "damping_ratio": rig.damping_ratio,
        "frequency_hz": frequency.tolist(),
        "transfer": {"re": value.real.tolist(), "im": value.imag.tolist()},
        "drawn": draws.values,
    }
