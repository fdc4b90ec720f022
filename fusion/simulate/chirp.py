"""Simulated transfer recordings: accelerometers on a base that a periodic chirp drives, and on what stands on it."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from fusion.simulate.draws import Draws
from fusion.simulate.toml_text import to_toml
from shaker._checks import ComplexArray, FloatArray
from shaker.signals.chain import filter_poles, pole_response

TRUTH_FILE = "truth.json"
RECORDING = "chirp"
DAQ_FILE, FILTER_FILE = "accelerometers.h5", "amplifier.toml"
CORNER_HZ, ORDER = 20e3, 4
Ratio = Callable[[FloatArray], ComplexArray]
"""Acceleration of a point over that of the base (K,) at frequencies (K,)."""


@dataclass(frozen=True)
class Chirp:
    """Excitation and sampling, and what the manifests state as uncertain; accelerations in m/s^2, times in s."""

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

    @property
    def lines_hz(self) -> FloatArray:
        """Frequencies (K,) of the chirp: every harmonic of its period inside the band."""
        low, high = (edge * self.period_s for edge in self.band_hz)
        return np.asarray(np.arange(np.ceil(low), np.floor(high) + 1.0) / self.period_s)


@dataclass(frozen=True)
class ChirpRig(Chirp):
    """An oscillator on the base, and what is recorded of it."""

    frequency_hz: float = 1477.35
    damping_ratio: float = 0.5 / 66.0


def write_chirp(folder: Path, seed: int, rig: ChirpRig | None = None) -> Path:
    """Write `rig.toml` and the recording `chirp` with its truth into an empty folder and return the recording's folder.

    Everything stated as an uncertainty is drawn. The shaker starts from rest, so that the first period is not settled.
    """
    rig = rig or ChirpRig()
    draws = Draws(seed, True)
    recording = folder / RECORDING
    samples = chirp_samples(rig, draws, {"top": lambda frequency_hz: transmissibility(rig, frequency_hz)})
    write_chirp_files(recording, rig, samples, _recording(rig), _truth(rig, seed, draws))
    rig_text = to_toml({"format": 1, "name": "oscillator on a shaker, simulated"})
    (folder / "rig.toml").write_text(rig_text, encoding="utf-8", newline="\n")
    return recording


def write_chirp_files(
    recording: Path,
    chirp: Chirp,
    samples: Mapping[str, NDArray[np.float32]],
    tables: Mapping[str, Any],
    truth: Mapping[str, Any],
) -> None:
    """Write a recording's new folder: record (V), `recording.toml` from its `tables`, amplifier, truth."""
    import h5py

    recording.mkdir(parents=True)
    with h5py.File(recording / DAQ_FILE, "w") as file:
        for name, values in samples.items():
            data = file.create_dataset(name, data=values, compression="gzip", shuffle=True)
            data.attrs["sample_rate"] = chirp.sample_rate_hz
            data.attrs["unit"] = "V"
    texts = {
        "recording.toml": to_toml(dict(tables)),
        FILTER_FILE: to_toml(_amplifier(chirp)),
        TRUTH_FILE: json.dumps(truth),
    }
    for name, text in texts.items():
        (recording / name).write_text(text, encoding="utf-8", newline="\n")


def transmissibility(rig: ChirpRig, frequency_hz: FloatArray) -> ComplexArray:
    """Return (1 + 2ζp)/(1 + 2ζp + p²), p = jω/ω₀: acceleration of the mass over that of the base."""
    p = 1j * frequency_hz / rig.frequency_hz
    turned = 1.0 + 2.0 * rig.damping_ratio * p
    return np.asarray(turned / (turned + p * p))


def chirp_samples(
    chirp: Chirp, draws: Draws, tops: Mapping[str, Ratio], noise: str = ""
) -> dict[str, NDArray[np.float32]]:
    """Return what `base` and all `tops` hold, in V: acceleration through sensor, delay, amplifier, noise, converter.

    The record begins at rest: one period of silence precedes the chirps in the transform and is cut off. `noise` names
    the recording whose noise it is.
    """
    length = round(chirp.period_s * chirp.sample_rate_hz)
    silent = 2  # periods of rest, in which what the transform wraps around has decayed
    drive = np.concatenate([np.zeros(silent * length), np.tile(_sweep(chirp, length), chirp.periods)])
    clock = 1.0 + float(draws.normal("daq.clock", chirp.clock_uncertainty))  # generator and converter share it
    frequency = clock * np.asarray(np.fft.rfftfreq(len(drive), 1.0 / chirp.sample_rate_hz), dtype=np.float64)
    spectrum = np.fft.rfft(drive)
    found = {}
    for name in ("base", *tops):
        motion = tops[name](frequency) if name in tops else np.ones(len(frequency))
        chain = _true_chain(chirp, name, frequency, draws)
        clean = np.fft.irfft(spectrum * motion * chain, len(drive))[silent * length :]
        random = chirp.noise * draws.stream(f"{noise}{name}.noise").standard_normal(len(clean))
        found[name] = np.asarray((clean + random) * 0.01, dtype=np.float32)
    return found


def _sweep(chirp: Chirp, length: int) -> FloatArray:
    """Return one period (S,) of a chirp with a flat spectrum inside the band and none outside (Schroeder's phases)."""
    harmonic = np.rint(chirp.lines_hz * chirp.period_s).astype(np.int64)
    number = np.arange(len(harmonic))
    spectrum = np.zeros(length // 2 + 1, dtype=np.complex128)
    spectrum[harmonic] = np.exp(-1j * np.pi * number**2 / len(harmonic))
    sweep = np.fft.irfft(spectrum, length)
    return np.asarray(chirp.amplitude * sweep / np.abs(sweep).max())


def _true_chain(chirp: Chirp, name: str, frequency_hz: FloatArray, draws: Draws) -> ComplexArray:
    """Return the response of one chain as it is: scale, delay and corner off by what the manifest leaves open."""
    scale = float(draws.normal(f"{name}.scale", chirp.scale_uncertainty))
    delay = float(draws.normal(f"{name}.delay", chirp.delay_uncertainty))
    factor = np.exp(-2j * np.pi * frequency_hz * delay) / (1.0 + scale)
    if name != "base":
        off = draws.normal(f"{name.replace('top', 'amplifier')}.corner", chirp.corner_uncertainty)
        corner = CORNER_HZ * (1.0 + float(off))
        factor = factor * pole_response(frequency_hz, filter_poles("butterworth", ORDER, corner)).value
    return np.asarray(factor)


def chirp_channels(
    chirp: Chirp,
    base: tuple[float, float, float],
    tops: Mapping[str, tuple[float, float, float]],
    direction: tuple[float, float, float],
) -> list[dict[str, Any]]:
    """Return the blocks of the channels of `base` and `tops`, which measure along a direction at the places given."""
    stated = {
        "scale": 100.0,
        "scale_uncertainty": chirp.scale_uncertainty,
        "delay_uncertainty": chirp.delay_uncertainty,
    }
    place = {"quantity": "acceleration", "direction": list(direction)}
    above = [
        {"name": name, **place, "body": "load", "point": list(point), **stated} | {"response": FILTER_FILE}
        for name, point in tops.items()
    ]
    return [{"name": "base", **place, "body": "base", "point": list(base), **stated}, *above]


def chirp_tables(chirp: Chirp, name: str, rig_file: str, channels: list[dict[str, Any]]) -> dict[str, Any]:
    """Return recording.toml as nested dictionaries; the direction is that of the first channel, the reference."""
    return {
        "format": 1,
        "name": name,
        "rig": rig_file,
        "excitation": {
            "kind": "chirp",
            "direction": channels[0]["direction"],
            "band": list(chirp.band_hz),
            "period": chirp.period_s,
            "settle_periods": chirp.settle_periods,
            "reference": [channels[0]["name"]],
            "response": [channel["name"] for channel in channels[1:]],
        },
        "daq": [
            {"name": "daq", "file": DAQ_FILE, "clock_uncertainty": chirp.clock_uncertainty, "channel": channels},
        ],
    }


def _recording(rig: ChirpRig) -> dict[str, Any]:
    """Return recording.toml of the oscillator."""
    channels = chirp_channels(rig, (0.0, 0.0, -0.05), {"top": (0.0, 0.0, 0.05)}, (0.0, 0.0, 1.0))
    return chirp_tables(rig, "chirp, base and top acceleration, simulated", "../rig.toml", channels)


def _amplifier(chirp: Chirp) -> dict[str, Any]:
    """Return the stated response of an amplifier of an accelerometer above as nested dictionaries."""
    element = {"name": "amplifier", "filter": "butterworth", "order": ORDER, "corner": CORNER_HZ}
    return {"format": 1, "element": [{**element, "frequency_uncertainty": chirp.corner_uncertainty}]}


def _truth(rig: ChirpRig, seed: int, draws: Draws) -> dict[str, Any]:
    """Return truth.json: the oscillator, its transmissibility at every harmonic of the chirp, and every error drawn."""
    frequency = rig.lines_hz
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
