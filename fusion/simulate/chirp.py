"""Simulated chirps with several load masses."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from fusion.base import ProgressCallback
from fusion.simulate.channels import complex_table, part_keys, sensor_keys, to_toml
from fusion.simulate.preset import NITSCHE2018, TRIGGER, DaqSpec, PartSpec, Preset, accelerometer, bridge, laser
from fusion.simulate.sines import RECORDERS_HZ, STEP_HZ, STEPS, Run, as_phasors, camera_rate, timed
from fusion.simulate.world import (
    STATIC_UNCERTAINTY,
    CampaignDraws,
    Draws,
    TruePart,
    make_world,
    static_sensitivity,
    true_part,
)
from fusion.simulate.write import TRIGGER_JITTER_S, write_run
from shaker.arrays import ComplexArray, FloatArray
from shaker.frf.chain import filter_poles, pole_response
from shaker.labels import MOTION_COMPONENTS

# Simulated transfer recordings: accelerometers on a base that a periodic chirp drives, and on what stands on it.


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


# Simulated loads on the sensor's springs, driven by a chirp of the base: what identifies stiffness, damping, mass.


Place = tuple[float, float, float]

STIFFNESS_UNITS = ("N/m", "N/m", "N/m", "N.m/rad", "N.m/rad", "N.m/rad")


@dataclass(frozen=True)
class Suspension:
    """A sensor of which the `free` components of the load move on springs and dampers, and what is mounted on it.

    `stiffness` in N/m and N·m/rad, `damping` in N·s/m and N·m·s/rad, about the sensor origin. `sensor`: set-up whose
    sensor, sensitivity and surroundings the rigs state. `loads` by the name of their rig and recording. The base moves
    along `direction`, as do the accelerometers on base and load (`tops`) measure.
    """

    sensor: Preset
    internal: PartSpec
    free: tuple[int, ...]
    stiffness: tuple[float, ...]
    damping: tuple[float, ...]
    loads: dict[str, PartSpec]
    direction: Place
    base: Place
    tops: dict[str, Place]
    chirp: Chirp

    def transfer(self, load: TruePart, internal: TruePart, point: Place, frequency_hz: FloatArray) -> ComplexArray:
        """Return the acceleration of a point of the load over that of the base, both along the direction.

        (M s² + b s + k) q = (b s + k) q_base for the free components q, all others move as the base does.
        """
        s = 2j * np.pi * np.asarray(frequency_hz)[:, None, None]
        spring = np.diag(self.stiffness) + s * np.diag(self.damping)
        free = np.array(self.free)
        matrix = mass_matrix(load) + mass_matrix(internal)
        drive = np.array([*self.direction, 0.0, 0.0, 0.0])
        held = np.setdiff1d(np.arange(6), free)
        inertia = matrix[np.ix_(free, free)]
        pull = spring @ drive[free] - s[:, :, 0] ** 2 * (matrix[np.ix_(free, held)] @ drive[held])
        moved = np.linalg.solve(s**2 * inertia + spring, pull[:, :, None])[:, :, 0]
        row = np.array([*self.direction, *np.cross(point, self.direction)])
        return np.asarray(moved @ row[free] + drive[held] @ row[held])

    def resonances_hz(self, load: TruePart, internal: TruePart) -> FloatArray:
        """Return the undamped natural frequencies, ascending."""
        matrix = (mass_matrix(load) + mass_matrix(internal))[np.ix_(self.free, self.free)]
        squared = np.linalg.eigvals(np.linalg.solve(matrix, np.diag(self.stiffness)))
        return np.sort(np.sqrt(squared.real)) / (2.0 * np.pi)


def mass_matrix(part: TruePart) -> FloatArray:
    """Return the mass matrix (6, 6) of a rigid part about the origin: force and moment of its accelerations."""
    m, (x, y, z) = part.mass_kg, part.centre_of_mass_m
    cross = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    return np.block([[m * np.eye(3), -m * cross], [m * cross, part.inertia_kgm2 - m * cross @ cross]])


def write_chirps(folder: Path, stand: Suspension, draws: Draws) -> None:
    """Write the rigs into a campaign folder, and a chirp recording of each load.

    The accelerometers, their amplifiers and the clock are the same in all recordings, and so are their errors.
    """
    internal = true_part(stand.internal, draws)
    for name, load in stand.loads.items():
        file = rig_file(name)
        (folder / file).write_text(to_toml(rig_tables(stand, load, draws)), encoding="utf-8", newline="\n")
        true = true_part(load, draws)
        ratios = {top: _ratio(stand, true, internal, point) for top, point in stand.tops.items()}
        samples = chirp_samples(stand.chirp, draws, ratios, f"{name}.")
        channels = chirp_channels(stand.chirp, stand.base, stand.tops, stand.direction)
        tables = chirp_tables(stand.chirp, f"chirp, load mass {load.mass:g} kg, simulated", f"../{file}", channels)
        truth = _suspended_truth(stand, true, internal, draws)
        write_chirp_files(folder / f"{RECORDING}-{name}", stand.chirp, samples, tables, truth)


def rig_file(name: str) -> str:
    """Return the name of the file that describes the rig with a load."""
    return f"rig-{name}.toml"


def rig_tables(stand: Suspension, load: PartSpec, draws: Draws) -> dict[str, Any]:
    """Return rig.toml with one of the loads as nested dictionaries; the sensor is the same in all."""
    preset = replace(stand.sensor, internal=stand.internal)
    return {
        "format": 1,
        "name": f"{preset.rig_name}, {load.name}",
        "sensor": sensor_keys(preset, static_sensitivity(preset, draws)[0])
        | {"static_sensitivity_uncertainty": STATIC_UNCERTAINTY},
        "load": part_keys(load),
        "environment": {"gravity": preset.gravity_mps2.tolist(), "temperature": 23.0, "air_density": 1.19},
    }


def write_truth(folder: Path, preset: str, stand: Suspension, draws: Draws, others: dict[str, Any]) -> None:
    """Write what all recordings of the campaign share into its folder, and what each load does."""
    internal = true_part(stand.internal, draws)
    loads = {name: true_part(load, draws) for name, load in stand.loads.items()}
    truth = {
        "format": 1,
        "preset": preset,
        "seed": draws.seed,
        **_springs(stand),
        "internal_mass_kg": internal.mass_kg,
        "load_mass_kg": {name: load.mass_kg for name, load in loads.items()},
        "resonances_hz": {name: stand.resonances_hz(load, internal).tolist() for name, load in loads.items()},
        **others,
        "drawn": draws.values,
    }
    (folder / TRUTH_FILE).write_text(json.dumps(truth), encoding="utf-8", newline="\n")


def _ratio(stand: Suspension, load: TruePart, internal: TruePart, point: Place) -> Callable[[FloatArray], ComplexArray]:
    """Return the ratio that an accelerometer at a point sees, over frequency."""
    return lambda frequency_hz: stand.transfer(load, internal, point, frequency_hz)


def _springs(stand: Suspension) -> dict[str, Any]:
    """Return stiffness and damping by component."""
    names = [MOTION_COMPONENTS[place] for place in stand.free]
    return {
        "stiffness": dict(zip(names, stand.stiffness, strict=True)),
        "damping": dict(zip(names, stand.damping, strict=True)),
    }


def _suspended_truth(stand: Suspension, load: TruePart, internal: TruePart, draws: Draws) -> dict[str, Any]:
    """Return truth.json of one recording: masses, springs, the curves at every line, and every error drawn so far."""
    frequency = stand.chirp.lines_hz
    curves = {top: complex_table(stand.transfer(load, internal, point, frequency)) for top, point in stand.tops.items()}
    return {
        "format": 1,
        "seed": draws.seed,
        **_springs(stand),
        "mass_matrix": mass_matrix(load).tolist(),
        "internal_mass_kg": internal.mass_kg,
        "resonances_hz": stand.resonances_hz(load, internal).tolist(),
        "frequency_hz": frequency.tolist(),
        "transfer": curves,
        "drawn": dict(draws.values),
    }


# The campaign for stiffness, damping, internal mass: two loads on one axial spring, the output over frequency.


LAG_S = 50e-6
LOADS = {
    "4kg": PartSpec("load 4 kg", 4.236, 3e-4, (0.0, 0.0, 0.0), 5e-5, (0.0055, 0.0055, 0.0058), 2e-5),
    "9kg": PartSpec("load 9 kg", 8.798, 3e-4, (0.0, 0.0, 0.0), 5e-5, (0.0142, 0.0142, 0.0135), 2e-5),
}
SINE_LOAD = "9kg"
MOUNTING = "1"
_INTERNAL = PartSpec("internal", 0.769, 0.002, (0.0, 0.0, 0.0), 2e-4, (7.0e-4, 7.0e-4, 1.2e-3), 1e-5)
_STIFFNESS, _DAMPING = 4.5e8, 900.0  # N/m, N·s/m: Q of 53 and 73
_DRIVE_MPS2 = 60.0
_FREQUENCY_ERROR = 2.4e-6
_TOP_M = 0.0973
STAND = Suspension(
    sensor=replace(NITSCHE2018, name="masses", rig_name="10 kN shaker"),
    internal=_INTERNAL,
    free=(2,),
    stiffness=(_STIFFNESS,),
    damping=(_DAMPING,),
    loads=LOADS,
    direction=(0.0, 0.0, 1.0),
    base=(0.0, 0.0, -0.05),
    tops={"top_1": (0.03, 0.0, _TOP_M), "top_2": (-0.03, 0.0, _TOP_M)},
    chirp=Chirp(period_s=1.28),
)


def write_masses(folder: Path, seed: int, progress: ProgressCallback) -> None:
    """Write both rigs, a chirp recording of each load, twelve sine recordings of one load, and the truth.

    Everything stated as an uncertainty is drawn, once for the whole campaign. The period of the chirps gives the line
    spacing of the publication, 0.78125 Hz.
    """
    draws = CampaignDraws(seed, True, mounting=MOUNTING)
    write_chirps(folder, STAND, draws)
    for number, step in enumerate(STEPS, 1):
        run = sine_run(step, draws)
        own = replace(draws, recording=run.preset.recording)
        write_run(folder, run, make_world(run.preset, own, TRIGGER_JITTER_S), own, noise=True)
        progress("write", number, len(STEPS))
    others = {"spring_lag_s": _DAMPING / _STIFFNESS, "chain_lag_s": LAG_S, "sine_load": SINE_LOAD}
    write_truth(folder, "masses", STAND, draws, others)


def sine_run(step: int, draws: CampaignDraws) -> Run:
    """Return one sine recording: the load moves along z alone, its base on the true spring below it."""
    nominal = round(step * STEP_HZ, 1)
    rig = _sine_rig(draws)
    preset = replace(
        rig,
        recording=f"Fz-{nominal:06.1f}",
        fundamental_hz=nominal * (1.0 + _FREQUENCY_ERROR),
        multiples=(1, 2),
        acceleration=as_phasors(_motion(step)),
    )
    title = f"Fz {nominal:g} Hz, load mass {rig.load.mass:g} kg, simulated"
    preset = timed(preset, camera_rate(nominal))
    return Run(title, preset, rig, rig_file(SINE_LOAD), MOUNTING, "sine", (0.0, 0.0, 1.0), 2, (nominal,))


def _sine_rig(draws: CampaignDraws) -> Preset:
    """Return the set-up of the sines: three points on the load seen by a vibrometer, a base accelerometer, output Fz.

    Its resonance is that of the true masses, so that its base moves as the chirps say.
    """
    places = ((0.045, 0.0, _TOP_M), (-0.0225, 0.0390, _TOP_M), (-0.0225, -0.0390, _TOP_M))
    lasers = tuple(laser(f"velocity_{n}", place, 0.125) for n, place in enumerate(places, 1))
    motion = (*lasers, accelerometer("base_acceleration", "base", (0.0, 0.0, -0.045)), TRIGGER)
    load, own = true_part(LOADS[SINE_LOAD], draws), true_part(_INTERNAL, draws)
    axial_hz = float(STAND.resonances_hz(load, own)[0])
    return replace(
        STAND.sensor,
        internal=_INTERNAL,
        load=LOADS[SINE_LOAD],
        rig_name=f"{STAND.sensor.rig_name}, {LOADS[SINE_LOAD].name}",
        mount_hz=(*NITSCHE2018.mount_hz[:2], axial_hz, *NITSCHE2018.mount_hz[3:]),
        mount_damping=np.pi * axial_hz * _DAMPING / _STIFFNESS,
        damping_s=(0.0, 0.0, _DAMPING / _STIFFNESS, 0.0, 0.0, 0.0),
        lag_s=LAG_S,
        stereo=(),
        frames=48,
        daqs=(
            DaqSpec("vibrometer", "vibrometer.h5", RECORDERS_HZ[0], 1e-6, 0.0, 1.2, motion),
            DaqSpec("bridge", "bridge.h5", RECORDERS_HZ[1], 1e-6, 0.0, 1.2, (*bridge(("Fz",), 2e-5), TRIGGER)),
        ),
    )


def _motion(step: int) -> np.ndarray:
    """Return the load's acceleration (2, 6): z at the driven line, and 0.4 % of it at twice its frequency."""
    phase = np.random.default_rng([7, step]).uniform(0.0, 2.0 * np.pi, 2)
    motion = np.zeros((2, 6), dtype=np.complex128)
    motion[:, 2] = _DRIVE_MPS2 * np.array([1.0, 0.004]) * np.exp(1j * phase)
    return motion


# The campaign of a horizontal set-up: the load shifts and pitches on two springs, and its two resonances overlap.


PITCHING_LOADS = {
    "4kg": PartSpec("load 4 kg", 4.236, 3e-4, (0.0, 0.0, 0.012), 5e-5, (0.0182, 0.0182, 0.0200), 2e-5),
    "7kg": PartSpec("load 7 kg", 6.962, 3e-4, (0.0, 0.0, -0.002), 5e-5, (0.0118, 0.0118, 0.0105), 2e-5),
}
"""Centre of mass above and below the sensor origin; of the second load the resonances overlap."""
PITCHING_STAND = Suspension(
    sensor=replace(NITSCHE2018, name="pitching", rig_name="horizontal shaker"),
    internal=PartSpec("internal", 0.904, 0.002, (0.0, 0.0, 0.0), 0.0, (0.0, 0.0, 0.0), 0.0),
    free=(0, 4),
    stiffness=(7.0e8, 1.07e6),
    damping=(2500.0, 4.0),
    loads=PITCHING_LOADS,
    direction=(1.0, 0.0, 0.0),
    base=(-0.12, 0.0, 0.0),
    tops={"top_high": (0.05, 0.0, 0.06), "top_low": (0.05, 0.0, -0.03)},
    chirp=Chirp(period_s=1.28),
)


def write_pitching(folder: Path, seed: int) -> None:
    """Write both rigs, a chirp recording along x of each load, and the truth; everything uncertain is drawn once."""
    draws = Draws(seed, True)
    write_chirps(folder, PITCHING_STAND, draws)
    write_truth(folder, "pitching", PITCHING_STAND, draws, {})
