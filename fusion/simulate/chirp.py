"""Simulated recordings under a periodic chirp of the base, and campaigns of loads on springs.

`chirp`: an oscillator on the base. `masses`: two loads on one axial spring, the output over frequency, for stiffness,
damping and internal mass. `pitching`: a load that shifts and pitches on two springs, with overlapping resonances.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from pydantic.dataclasses import dataclass

from fusion.base import ProgressCallback, no_progress
from fusion.recording.toml import to_toml
from fusion.report.atomic_files import write_files
from fusion.simulate.preset import CHECKED, PartSpec, Preset, Vector, read_preset
from fusion.simulate.sines import (
    DRIVE_MPS2,
    FREQUENCY_ERROR,
    STEP_HZ,
    STEPS,
    TRIGGER_JITTER_S,
    Run,
    camera_rate,
    driven,
    environment_keys,
    part_keys,
    sensor_keys,
    write_run,
)
from fusion.simulate.world import STATIC_UNCERTAINTY, Draws, TruePart, make_world, static_sensitivity, true_part
from fusion.simulate.write import RIG_FILE, TRUTH_FILE, Record, complex_table, write_recording
from shaker.frf.chain import filter_poles, pole_response
from shaker.labels import MOTION_COMPONENTS
from shakercal._common.arrays import ComplexArray, FloatArray

RECORDING = "chirp"
DAQ_FILE, FILTER_FILE = "accelerometers.h5", "amplifier.toml"
CORNER_HZ, ORDER = 20e3, 4
SINE_LOAD, MOUNTING = "9kg", "1"
Ratio = Callable[[FloatArray], ComplexArray]  # acceleration of a point over that of the base (K,) at frequencies (K,)


@dataclass(frozen=True, config=CHECKED)
class Chirp:
    """Excitation and sampling with stated uncertainties; accelerations in m/s^2, times in s."""

    sample_rate_hz: float
    period_s: float
    periods: int
    settle_periods: int
    band_hz: tuple[float, float]
    amplitude: float
    noise: float
    scale_uncertainty: float
    delay_uncertainty: float
    corner_uncertainty: float
    clock_uncertainty: float

    @property
    def lines_hz(self) -> FloatArray:
        """Frequencies (K,) of the chirp: every harmonic of its period inside the band."""
        low, high = (edge * self.period_s for edge in self.band_hz)
        return np.asarray(np.arange(np.ceil(low), np.floor(high) + 1.0) / self.period_s)


@dataclass(frozen=True, config=CHECKED)
class Oscillator:
    """A mass on a spring on the base, with the points of the accelerometers."""

    frequency_hz: float
    damping_ratio: float
    base: Vector
    top: Vector
    chirp: Chirp

    def transmissibility(self, frequency_hz: FloatArray) -> ComplexArray:
        """Return the acceleration of the mass over that of the base.

        (1 + 2ζp)/(1 + 2ζp + p²), p = jω/ω₀.
        """
        p = 1j * frequency_hz / self.frequency_hz
        spring = 1.0 + 2.0 * self.damping_ratio * p
        return np.asarray(spring / (spring + p * p))


@dataclass(frozen=True, config=CHECKED)
class SimulatedSuspension:
    """A sensor whose `free` components are springs and dampers, with its loads.

    `stiffness` in N/m and N·m/rad, `damping` in N·s/m and N·m·s/rad, about the sensor origin. `sensor`: set-up with
    sensor, sensitivity and environment of the rigs. `loads`: by the name of their rig and recording. The base moves
    along `direction`; the accelerometers on base and load (`tops`) measure along it.
    """

    sensor: Preset
    internal: PartSpec
    free: tuple[int, ...]
    stiffness: tuple[float, ...]
    damping: tuple[float, ...]
    loads: dict[str, PartSpec]
    direction: Vector
    base: Vector
    tops: dict[str, Vector]
    chirp: Chirp

    def transfer(self, load: TruePart, internal: TruePart, point: Vector, frequency_hz: FloatArray) -> ComplexArray:
        """Return the acceleration of a point of the load over that of the base.

        (M s² + b s + k) q = (b s + k) q_base for the free components q; the others move with the base.
        """
        s = 2j * np.pi * np.asarray(frequency_hz)[:, None, None]
        spring = np.diag(self.stiffness) + s * np.diag(self.damping)
        free = np.array(self.free)
        matrix = mass_matrix(load) + mass_matrix(internal)
        drive = np.array([*self.direction, 0.0, 0.0, 0.0])
        rigid = np.setdiff1d(np.arange(6), free)
        inertia = matrix[np.ix_(free, free)]
        pull = spring @ drive[free] - s[:, :, 0] ** 2 * (matrix[np.ix_(free, rigid)] @ drive[rigid])
        moved = np.linalg.solve(s**2 * inertia + spring, pull[:, :, None])[:, :, 0]
        row = np.array([*self.direction, *np.cross(point, self.direction)])
        return np.asarray(moved @ row[free] + drive[rigid] @ row[rigid])

    def resonances_hz(self, load: TruePart, internal: TruePart) -> FloatArray:
        """Return the undamped natural frequencies, in ascending order."""
        matrix = (mass_matrix(load) + mass_matrix(internal))[np.ix_(self.free, self.free)]
        squared = np.linalg.eigvals(np.linalg.solve(matrix, np.diag(self.stiffness)))
        return np.sort(np.sqrt(squared.real)) / (2.0 * np.pi)

    @property
    def springs(self) -> dict[str, dict[str, float]]:
        """Stiffness and damping by component, for the truth files."""
        names = [MOTION_COMPONENTS[index] for index in self.free]
        return {
            "stiffness": dict(zip(names, self.stiffness, strict=True)),
            "damping": dict(zip(names, self.damping, strict=True)),
        }


def mass_matrix(part: TruePart) -> FloatArray:
    """Return the mass matrix (6, 6) of a rigid part about the origin."""
    m, (x, y, z) = part.mass_kg, part.centre_of_mass_m
    cross = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    return np.block([[m * np.eye(3), -m * cross], [m * cross, part.inertia_kgm2 - m * cross @ cross]])


def write_chirp(folder: Path, seed: int, rig: Oscillator | None = None) -> Path:
    """Write `rig.toml` and the recording `chirp` with its truth, and return its folder.

    All stated uncertainties are sampled. The shaker starts from rest, so that the first period is not settled.
    """
    rig = rig or read_preset(Oscillator, "chirp")
    draws, frequency = Draws(seed, True), rig.chirp.lines_hz
    samples = chirp_samples(rig.chirp, draws, {"top": rig.transmissibility})
    channels = chirp_channels(rig.chirp, rig.base, {"top": rig.top}, (0.0, 0.0, 1.0))
    manifest = chirp_tables(rig.chirp, "chirp, base and top acceleration, simulated", f"../{RIG_FILE}", channels)
    truth = {
        "format": 1,
        "preset": RECORDING,
        "seed": seed,
        "resonance_hz": rig.frequency_hz,
        "damping_ratio": rig.damping_ratio,
        "frequency_hz": frequency.tolist(),
        "transfer": complex_table(rig.transmissibility(frequency)),
        "drawn": draws.values,
    }
    write_files(folder, {RIG_FILE: to_toml({"format": 1, "name": "oscillator on a shaker, simulated"})})
    return write_chirp_files(folder / RECORDING, rig.chirp, samples, manifest, truth)


def write_chirp_files(
    recording: Path,
    chirp: Chirp,
    samples: Mapping[str, NDArray[np.float32]],
    manifest: Mapping[str, Any],
    truth: Mapping[str, Any],
) -> Path:
    """Write the folder of a recording: record (V), manifest, amplifier, truth; return it."""
    element = {"name": "amplifier", "filter": "butterworth", "order": ORDER, "corner": CORNER_HZ}
    amplifier = {"format": 1, "element": [{**element, "frequency_uncertainty": chirp.corner_uncertainty}]}
    record = Record(chirp.sample_rate_hz, samples, dict.fromkeys(samples, "V"))
    return write_recording(recording, manifest, truth, {DAQ_FILE: record}, {FILTER_FILE: to_toml(amplifier)})


def chirp_samples(
    chirp: Chirp, draws: Draws, tops: Mapping[str, Ratio], noise: str = ""
) -> dict[str, NDArray[np.float32]]:
    """Return the samples of `base` and all `tops`, V.

    The acceleration passes sensor, delay, amplifier, noise, converter. Scale, delay and corner of every chain deviate
    within the stated uncertainties. The record begins at rest: one silent period precedes the chirps in the transform
    and is cut off. `noise`: name of the noise of the recording.
    """
    length = round(chirp.period_s * chirp.sample_rate_hz)
    silent = 2  # periods of rest, in which the wrapped part of the transform decays
    harmonic = np.rint(chirp.lines_hz * chirp.period_s).astype(np.int64)
    flat = np.zeros(length // 2 + 1, dtype=np.complex128)  # inside the band, none outside: Schroeder's phases
    flat[harmonic] = np.exp(-1j * np.pi * np.arange(len(harmonic)) ** 2 / len(harmonic))
    sweep = np.fft.irfft(flat, length)
    sweep = chirp.amplitude * sweep / np.abs(sweep).max()
    drive = np.concatenate([np.zeros(silent * length), np.tile(sweep, chirp.periods)])
    clock = 1.0 + float(draws.normal("daq.clock", chirp.clock_uncertainty))  # generator and converter share it
    frequency = clock * np.asarray(np.fft.rfftfreq(len(drive), 1.0 / chirp.sample_rate_hz), dtype=np.float64)
    spectrum = np.fft.rfft(drive)
    samples = {}
    for name in ("base", *tops):
        motion = tops[name](frequency) if name in tops else np.ones(len(frequency))
        scale = float(draws.normal(f"{name}.scale", chirp.scale_uncertainty))
        delay = float(draws.normal(f"{name}.delay", chirp.delay_uncertainty))
        chain = np.exp(-2j * np.pi * frequency * delay) / (1.0 + scale)
        if name != "base":
            off = float(draws.normal(f"{name.replace('top', 'amplifier')}.corner", chirp.corner_uncertainty))
            chain = chain * pole_response(frequency, filter_poles("butterworth", ORDER, CORNER_HZ * (1.0 + off))).value
        clean = np.fft.irfft(spectrum * motion * chain, len(drive))[silent * length :]
        random = chirp.noise * draws.stream(f"{noise}{name}.noise").standard_normal(len(clean))
        samples[name] = np.asarray((clean + random) * 0.01, dtype=np.float32)
    return samples


def chirp_channels(chirp: Chirp, base: Vector, tops: Mapping[str, Vector], direction: Vector) -> list[dict[str, Any]]:
    """Return the channel blocks of `base` and `tops`, which measure along a direction."""
    stated = {
        "scale": 100.0,
        "scale_uncertainty": chirp.scale_uncertainty,
        "delay_uncertainty": chirp.delay_uncertainty,
    }
    along = {"quantity": "acceleration", "direction": list(direction)}
    above = [
        {"name": name, **along, "body": "load", "point": list(point), **stated, "response": FILTER_FILE}
        for name, point in tops.items()
    ]
    return [{"name": "base", **along, "body": "base", "point": list(base), **stated}, *above]


def chirp_tables(chirp: Chirp, name: str, rig: str, channels: list[dict[str, Any]]) -> dict[str, Any]:
    """Return recording.toml as nested dictionaries, with the direction of the reference channel."""
    return {
        "format": 1,
        "name": name,
        "rig": rig,
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


def write_chirps(folder: Path, suspension: SimulatedSuspension, draws: Draws) -> None:
    """Write the rigs into a campaign folder, and a chirp recording of each load.

    Accelerometers, amplifiers and clock, with their errors, are the same in all recordings.
    """
    internal = true_part(suspension.internal, draws)
    lines = suspension.chirp.lines_hz
    for name, stated in suspension.loads.items():
        write_files(folder, {rig_file(name): to_toml(suspension_rig(suspension, stated, draws))})
        load = true_part(stated, draws)
        ratios = {top: partial(suspension.transfer, load, internal, point) for top, point in suspension.tops.items()}
        samples = chirp_samples(suspension.chirp, draws, ratios, f"{name}.")
        channels = chirp_channels(suspension.chirp, suspension.base, suspension.tops, suspension.direction)
        title = f"chirp, load mass {stated.mass:g} kg, simulated"
        truth = {
            "format": 1,
            "seed": draws.seed,
            **suspension.springs,
            "mass_matrix": mass_matrix(load).tolist(),
            "internal_mass_kg": internal.mass_kg,
            "resonances_hz": suspension.resonances_hz(load, internal).tolist(),
            "frequency_hz": lines.tolist(),
            "transfer": {top: complex_table(ratio(lines)) for top, ratio in ratios.items()},
            "drawn": dict(draws.values),
        }
        manifest = chirp_tables(suspension.chirp, title, f"../{rig_file(name)}", channels)
        write_chirp_files(folder / f"{RECORDING}-{name}", suspension.chirp, samples, manifest, truth)


def rig_file(name: str) -> str:
    """Return the file name of the rig with a load."""
    return f"rig-{name}.toml"


def suspension_rig(suspension: SimulatedSuspension, load: PartSpec, draws: Draws) -> dict[str, Any]:
    """Return rig.toml with one of the loads as nested dictionaries."""
    preset = replace(suspension.sensor, internal=suspension.internal)
    return {
        "format": 1,
        "name": f"{preset.rig_name}, {load.name}",
        "sensor": sensor_keys(preset, static_sensitivity(preset, draws)[0])
        | {"static_sensitivity_uncertainty": STATIC_UNCERTAINTY},
        "load": part_keys(load),
        "environment": environment_keys(preset),
    }


def write_pitching(folder: Path, seed: int, suspension: SimulatedSuspension | None = None) -> None:
    """Write both rigs, a chirp recording along x of each load, and the truth.

    All uncertainties are sampled once.
    """
    suspension = suspension or read_preset(SimulatedSuspension, "pitching")
    draws = Draws(seed, True)
    write_chirps(folder, suspension, draws)
    _write_truth(folder, suspension, draws, {})


def write_masses(
    folder: Path,
    seed: int,
    progress: ProgressCallback = no_progress,
    suspension: SimulatedSuspension | None = None,
    steps: Sequence[int] = STEPS,
) -> None:
    """Write both rigs, chirp recordings of both loads, twelve sine recordings, and the truth.

    All stated uncertainties are sampled once for the campaign. The period of the chirps gives the line spacing of the
    publication, 0.78125 Hz.
    """
    suspension = suspension or read_preset(SimulatedSuspension, "masses")
    draws = Draws(seed, True, mounting=MOUNTING, recording="")
    write_chirps(folder, suspension, draws)
    for number, step in enumerate(steps, 1):
        run = sine_run(suspension, step, draws)
        recording_draws = replace(draws, recording=run.preset.recording)
        write_run(folder, run, make_world(run.preset, recording_draws, TRIGGER_JITTER_S), recording_draws)
        progress("write", number, len(steps))
    lags = {"spring_lag_s": _spring_lag_s(suspension), "chain_lag_s": suspension.sensor.lag_s}
    _write_truth(folder, suspension, draws, lags | {"sine_load": SINE_LOAD})


def sine_run(suspension: SimulatedSuspension, step: int, draws: Draws) -> Run:
    """Return one sine recording of a load that moves along z.

    z moves at the driven line, and with 0.4 % of it at twice its frequency. The resonance of the set-up is that of the
    true masses, so that the base moves as in the chirps.
    """
    nominal = round(step * STEP_HZ, 1)
    motion = np.zeros((2, 6), dtype=np.complex128)
    phase = np.random.default_rng([7, step]).uniform(0.0, 2.0 * np.pi, 2)
    motion[:, 2] = DRIVE_MPS2 * np.array([1.0, 0.004]) * np.exp(1j * phase)
    sensor, load = suspension.sensor, suspension.loads[SINE_LOAD]
    axial_hz = float(suspension.resonances_hz(true_part(load, draws), true_part(suspension.internal, draws))[0])
    rig = replace(
        sensor,
        internal=suspension.internal,
        load=load,
        rig_name=f"{sensor.rig_name}, {load.name}",
        mount_hz=(*sensor.mount_hz[:2], axial_hz, *sensor.mount_hz[3:]),
        mount_damping=np.pi * axial_hz * suspension.damping[0] / suspension.stiffness[0],
        damping_s=(0.0, 0.0, _spring_lag_s(suspension), 0.0, 0.0, 0.0),
        camera_rate_hz=camera_rate(sensor, nominal),
    )
    return Run(
        name=f"Fz {nominal:g} Hz, load mass {load.mass:g} kg, simulated",
        preset=driven(rig, f"Fz-{nominal:06.1f}", nominal * (1.0 + FREQUENCY_ERROR), motion),
        nominal_hz=(nominal,),
        rig_file=rig_file(SINE_LOAD),
        mounting=MOUNTING,
    )


def _spring_lag_s(suspension: SimulatedSuspension) -> float:
    """Return b/k of the first spring."""
    return suspension.damping[0] / suspension.stiffness[0]


def _write_truth(folder: Path, suspension: SimulatedSuspension, draws: Draws, others: dict[str, Any]) -> None:
    """Write the common truth of all recordings of the campaign, and that of each load."""
    internal = true_part(suspension.internal, draws)
    loads = {name: true_part(load, draws) for name, load in suspension.loads.items()}
    truth = {
        "format": 1,
        "preset": suspension.sensor.name,
        "seed": draws.seed,
        **suspension.springs,
        "internal_mass_kg": internal.mass_kg,
        "load_mass_kg": {name: load.mass_kg for name, load in loads.items()},
        "resonances_hz": {name: suspension.resonances_hz(load, internal).tolist() for name, load in loads.items()},
        **others,
        "drawn": draws.values,
    }
    write_files(folder, {TRUTH_FILE: json.dumps(truth)})
