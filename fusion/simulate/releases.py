"""Calibrations by releases: what hangs on a sensor lets go, and its outputs ring.

`steps`: a six-component sensor, three kinds of rope. `loads`: a force sensor that a thin line releases, with five
masses on its pillar.
"""

from __future__ import annotations

import json
from dataclasses import dataclass as plain_dataclass
from pathlib import Path
from typing import Any

import numpy as np
from pydantic.dataclasses import dataclass

from fusion.simulate.preset import CHECKED, read_preset
from fusion.simulate.world import Draws
from fusion.simulate.write import (
    RIG_FILE,
    TRUTH_FILE,
    Record,
    complex_table,
    to_toml,
    write_recording,
    write_texts,
)
from shaker.arrays import FloatArray
from shaker.labels import LOAD_COMPONENTS
from shaker.lti.system import ModalModel
from shaker.release.load_model import LoadModel
from shaker.release.response import pole_responses

DAQ_FILE = "outputs.h5"
CHANNEL, ROPE = "Fy", "fishing line"
"""Output and load component of the force sensor, and what releases it."""
Model = tuple[tuple[ModalModel, ...], ...]
"""Response of every output (row) to every load component (column)."""


@dataclass(frozen=True, config=CHECKED)
class Rope:
    """What lets go: how long the load takes to vanish along a straight line, in s, and its relative scatter."""

    name: str
    release_s: float
    scatter: float


@dataclass(frozen=True, config=CHECKED)
class StepRig:
    """Truth and nominal values of sensor, amplifier and recorder.

    One mode per component (`frequency_hz`, `damping_ratio`) and the amplifier's real pole `chain_hz`; `capacity` and
    `sensitivity` by component, the latter in V/V per N or N·m; `mixing`: largest share by which a load drives, and an
    output shows, the mode of another component. `load_share`: what hangs on the rope, over the capacity; `noise`: over
    the output's change. Recorder: `range_v` on `bits`, `gain` V per V/V, times in s. The first of the `ropes` releases
    every component, all of them release Fz.
    """

    frequency_hz: tuple[float, ...]
    damping_ratio: float
    chain_hz: float
    capacity: tuple[float, ...]
    sensitivity: tuple[float, ...]
    mixing: float
    load_share: float
    u_sensitivity: float
    noise: float
    offset_v: float
    gain: float
    range_v: float
    bits: int
    sample_rate_hz: float
    before_s: float
    after_s: float
    start_scatter_s: float
    ropes: tuple[Rope, ...]


@plain_dataclass(frozen=True)
class Release:
    """One recording: the component that is loaded, what lets go, and the number of the repeat."""

    component: str
    rope: Rope
    repeat: int

    @property
    def name(self) -> str:
        """Name of the recording's folder."""
        return f"{self.component}-{self.rope.name.replace(' ', '-')}-{self.repeat}"


def releases(rig: StepRig) -> tuple[Release, ...]:
    """Return three releases of each rope on Fz, and two releases of the first on every other component."""
    axial = [Release("Fz", rope, repeat) for rope in rig.ropes for repeat in (1, 2, 3)]
    other = [Release(c, rig.ropes[0], repeat) for c in LOAD_COMPONENTS if c != "Fz" for repeat in (1, 2)]
    return (*axial, *other)


def write_steps(folder: Path, seed: int, rig: StepRig | None = None) -> tuple[Path, ...]:
    """Write `rig.toml`, `truth.json` and all recordings into an empty folder and return the recordings' folders.

    The static sensitivities of the rig are off by what is stated as their uncertainty.
    """
    rig = rig or read_preset(StepRig, "steps")
    draws = Draws(seed, True)
    model = sensor_model(rig, draws)
    static = np.array([[one.static_gain for one in row] for row in model])
    error = draws.normal("sensor.static_sensitivity", rig.u_sensitivity, static.size).reshape(static.shape)
    tables = {
        "format": 1,
        "name": "rope and weight on a six-component sensor, simulated",
        "sensor": {
            "name": "six-component wrist sensor",
            "channels": list(LOAD_COMPONENTS),
            "unit": "V/V",
            "sense": "on_sensor",
            "capacity": list(rig.capacity),
            "static_sensitivity": [[float(f"{v:.7e}") for v in row] for row in static * (1.0 + error)],
            "static_sensitivity_uncertainty": rig.u_sensitivity,
            "internal_mass": 0.049,
        },
    }
    truth = {
        "format": 1,
        "preset": "steps",
        "seed": draws.seed,
        "channels": list(LOAD_COMPONENTS),
        "components": list(LOAD_COMPONENTS),
        "frequency_hz": list(rig.frequency_hz),
        "damping_ratio": [rig.damping_ratio] * len(rig.frequency_hz),
        "residue": complex_table(np.array([[one.residue for one in row] for row in model])),
        "real_hz": [rig.chain_hz],
        "real_residue": [[one.real_residue.tolist() for one in row] for row in model],
        "static_gain": static.tolist(),
        "drawn": draws.values,
    }
    recordings = tuple(_write_release(folder / release.name, rig, model, release, draws) for release in releases(rig))
    write_texts(folder, {RIG_FILE: to_toml(tables), TRUTH_FILE: json.dumps(truth)})
    return recordings


def sensor_model(rig: StepRig, draws: Draws) -> Model:
    """Return the response of every output (row) to every load component (column), in V/V per N or N·m.

    H = C·diag[ω²/(s² + 2ζωs + ω²)]·B·2πf_c/(s + 2πf_c): loads drive the modes by B, outputs show them by C, both close
    to diagonal; the amplifier is the last factor. Residues follow from partial fractions.
    """
    modes = len(rig.frequency_hz)
    off = [draws.stream(f"mixing.{name}").uniform(-rig.mixing, rig.mixing, (modes, modes)) for name in ("B", "C")]
    drive, show = (np.where(np.eye(modes, dtype=np.bool_), 1.0, part) for part in off)
    sensitivity, capacity = np.array(rig.sensitivity), np.array(rig.capacity)
    show = (sensitivity * capacity)[:, None] * show
    drive = drive / capacity
    frequency = np.array(rig.frequency_hz)
    damping = np.full(modes, rig.damping_ratio)
    omega, corner = 2 * np.pi * frequency, 2 * np.pi * rig.chain_hz
    pole = omega * (-damping + 1j * np.sqrt(1 - damping**2))
    swing = omega**2 * corner / ((pole - pole.conj()) * (pole + corner))
    lag = omega**2 * corner / (corner**2 - 2 * damping * omega * corner + omega**2)

    def response(output: int, load: int) -> ModalModel:
        share = show[output] * drive[:, load]
        real = np.array([rig.chain_hz]), np.array([np.sum(share * lag)])
        return ModalModel(frequency, damping, np.asarray(share * swing), *real)

    return tuple(tuple(response(i, c) for c in range(modes)) for i in range(modes))


def _write_release(folder: Path, rig: StepRig, model: Model, release: Release, draws: Draws) -> Path:
    """Write one recording: what hung on the rope vanishes, and every output goes from its loaded to its zero level."""
    place = LOAD_COMPONENTS.index(release.component)
    load = rig.load_share * rig.capacity[place]
    rng = draws.stream(f"{release.name}.release")
    onset_s = rig.before_s + float(rng.uniform(0.0, rig.start_scatter_s))
    release_s = release.rope.release_s * (1.0 + release.rope.scatter * float(rng.uniform(-1.0, 1.0)))
    count = round((rig.before_s + rig.after_s) * rig.sample_rate_hz)
    time_s = np.arange(count) / rig.sample_rate_hz
    offset = rig.offset_v * draws.stream(f"{release.name}.offset").standard_normal(len(model))
    column = [row[place] for row in model]
    response = pole_responses(column[0].poles, time_s, onset_s, release_s)  # the poles of all outputs are the same
    upper, real = np.split(response, [len(rig.frequency_hz)], axis=1)
    answers = (2.0 * np.real(upper @ one.residue) + np.real(real) @ one.real_residue for one in column)
    clean = np.stack([load * (one.static_gain - answer) for one, answer in zip(column, answers, strict=True)])
    steps = np.array(rig.sensitivity) * np.array(rig.capacity) * rig.load_share
    noise = rig.noise * steps[:, None] * draws.stream(f"{release.name}.noise").standard_normal(clean.shape)
    volts = _digitised(rig.gain * (clean + noise) + offset[:, None], rig.range_v, rig.bits)
    static = [one.static_gain for one in column]
    truth = {
        "format": 1,
        "preset": "steps",
        "component": release.component,
        "amplitude": -load,
        "onset_s": onset_s,
        "release": release.rope.name,
        "release_s": release_s,
        "shape": "ramp",
        "baseline": [load * gain + float(zero) / rig.gain for gain, zero in zip(static, offset, strict=True)],
        "steady": (offset / rig.gain).tolist(),
        "static_gain": static,
        "noise": (rig.noise * steps).tolist(),
    }
    channels = [
        {"name": name, "quantity": "output", "channel": name, "scale": 1.0 / rig.gain} for name in LOAD_COMPONENTS
    ]
    title = f"{release.component} released by {release.rope.name}, {release.repeat}, simulated"
    manifest = _step_tables(title, RIG_FILE, (release.component, -load, release.rope.name), channels)
    return write_recording(folder, manifest, truth, {DAQ_FILE: _record(volts, channels, rig.sample_rate_hz)})


def _digitised(volts: FloatArray, range_v: float, bits: int) -> FloatArray:
    """Return what the converter shows: whole steps within its range."""
    step = 2.0 * range_v / 2**bits
    return np.asarray(np.clip(np.rint(volts / step), -(2 ** (bits - 1)), 2 ** (bits - 1) - 1) * step)


def _record(volts: FloatArray, channels: list[dict[str, Any]], sample_rate_hz: float) -> Record:
    """Return the samples (C, N) of the channels as they are stored, in V."""
    names = [str(channel["name"]) for channel in channels]
    samples = {name: values.astype(np.float32) for name, values in zip(names, volts, strict=True)}
    return Record(sample_rate_hz, samples, dict.fromkeys(names, "V"))


def _step_tables(
    name: str, rig: str, released: tuple[str, float, str], channels: list[dict[str, Any]]
) -> dict[str, Any]:
    """Return recording.toml as nested dictionaries; `released`: component, change of the load, what lets go."""
    component, amplitude, rope = released
    return {
        "format": 1,
        "name": name,
        "rig": f"../{rig}",
        "excitation": {"kind": "step", "component": component, "step_amplitude": amplitude, "release": rope},
        "daq": [{"name": "daq", "file": DAQ_FILE, "clock_uncertainty": 1e-6, "channel": channels}],
    }


@dataclass(frozen=True, config=CHECKED)
class SeriesRig:
    """Truth and nominal values: masses in kg, N/m, N·s/m; output in V, recorded as it is; times in s.

    `loads_g`: masses on the pillar in g; `noise` over the output's change; the load of `force_n` vanishes along a
    straight line of `release_s`.
    """

    loads_g: tuple[int, ...]
    moving_mass_kg: float
    u_moving_mass_kg: float
    u_load_mass_kg: float
    stiffness: float
    damping: float
    coupling_stiffness: float
    coupling_damping: float
    sensitivity: float
    force_n: float
    noise: float
    offset_v: float
    range_v: float
    bits: int
    release_s: float
    before_s: float
    start_scatter_s: float
    duration_s: float
    sample_rate_hz: float


def write_loads(folder: Path, seed: int, rig: SeriesRig | None = None) -> tuple[Path, ...]:
    """Write a rig and a recording for every load, and the truth, into an empty folder; return the recordings' folders.

    The masses differ from the stated ones by errors of the stated uncertainties, the moving mass by one for all.
    """
    rig = rig or read_preset(SeriesRig, "loads")
    draws = Draws(seed, True)
    model = true_model(rig, draws)
    recordings, masses = [], {}
    for grams in rig.loads_g:
        load = grams * 1e-3
        if grams:
            load += float(draws.normal(f"load {grams} g.mass", rig.u_load_mass_kg))
        masses[recording_name(grams)] = load
        write_texts(folder, {f"rig-{grams:03d}g.toml": to_toml(_series_rig(rig, grams))})
        recordings.append(_write_series_release(folder, rig, model, grams, load, draws))
    truth = {
        "format": 1,
        "preset": "loads",
        "seed": draws.seed,
        "component": CHANNEL,
        "channel": CHANNEL,
        "moving_mass_kg": model.moving_mass,
        "load_mass_kg": masses,
        "stiffness": rig.stiffness,
        "damping": rig.damping,
        "coupling_stiffness": rig.coupling_stiffness,
        "coupling_damping": rig.coupling_damping,
        "sensitivity": rig.sensitivity,
        "release_s": rig.release_s,
        "drawn": draws.values,
    }
    write_texts(folder, {TRUTH_FILE: json.dumps(truth)})
    return tuple(recordings)


def true_model(rig: SeriesRig, draws: Draws) -> LoadModel:
    """Return the sensor as it is, its moving mass drawn."""
    return LoadModel(
        component=CHANNEL,
        channel=CHANNEL,
        unit="V",
        moving_mass=rig.moving_mass_kg + float(draws.normal("moving.mass", rig.u_moving_mass_kg)),
        stiffness=rig.stiffness,
        damping=rig.damping,
        coupling_stiffness=rig.coupling_stiffness,
        coupling_damping=rig.coupling_damping,
        sensitivity=rig.sensitivity,
    )


def load_change(model: LoadModel, load_mass: float, time_s: FloatArray, onset_s: float, release_s: float) -> FloatArray:
    """Return the output (N,) while a unit force comes up on the load along a straight line (partial fractions of H)."""
    system = model.system(load_mass)
    poles = system.poles
    others = [np.prod(p - np.delete(poles, place)) for place, p in enumerate(poles)]
    tops = [np.prod(p - system.zeros) for p in poles]
    residues = system.gain * np.array(tops) / np.array(others)
    return np.asarray((pole_responses(poles, time_s, onset_s, release_s) @ residues).real)


def recording_name(grams: int) -> str:
    """Return the name of a recording's folder."""
    return f"step-{grams:03d}g"


def _write_series_release(
    folder: Path, rig: SeriesRig, model: LoadModel, grams: int, load: float, draws: Draws
) -> Path:
    """Write one recording: the force vanishes, the output falls from its loaded level to zero and rings."""
    name = recording_name(grams)
    onset_s = rig.before_s + float(draws.stream(f"{name}.release").uniform(0.0, rig.start_scatter_s))
    time_s = np.arange(round(rig.duration_s * rig.sample_rate_hz)) / rig.sample_rate_hz
    offset = rig.offset_v * float(draws.stream(f"{name}.offset").standard_normal())
    clean = rig.force_n * (rig.sensitivity - load_change(model, load, time_s, onset_s, rig.release_s))
    noise = rig.noise * rig.force_n * rig.sensitivity * draws.stream(f"{name}.noise").standard_normal(len(clean))
    volts = _digitised(clean + noise + offset, rig.range_v, rig.bits)
    poles = model.poles(load)
    upper = poles[poles.imag > 0]
    truth = {
        "format": 1,
        "preset": "loads",
        "load_mass_kg": load,
        "amplitude": -rig.force_n,
        "onset_s": onset_s,
        "release_s": rig.release_s,
        "baseline": rig.force_n * rig.sensitivity + offset,
        "steady": offset,
        "frequency_hz": (np.sort(np.abs(upper)) / (2.0 * np.pi)).tolist(),
        "damping_ratio": (-upper.real / np.abs(upper))[np.argsort(np.abs(upper))].tolist(),
    }
    channels = [{"name": CHANNEL, "quantity": "output", "channel": CHANNEL}]
    title = f"release of {CHANNEL} with a load of {grams} g, simulated"
    manifest = _step_tables(title, f"rig-{grams:03d}g.toml", (CHANNEL, -rig.force_n, ROPE), channels)
    records = {DAQ_FILE: _record(volts[None], channels, rig.sample_rate_hz)}
    return write_recording(folder / name, manifest, truth, records)


def _series_rig(rig: SeriesRig, grams: int) -> dict[str, Any]:
    """Return the rig with a load as nested dictionaries."""
    tables: dict[str, Any] = {
        "format": 1,
        "name": f"force sensor of a haptic device, load mass {grams} g, simulated",
        "sensor": {
            "name": "three-component force sensor",
            "channels": [CHANNEL],
            "unit": "V",
            "sense": "on_sensor",
            "static_sensitivity": [[rig.sensitivity if name == CHANNEL else 0.0 for name in LOAD_COMPONENTS]],
            "internal_mass": rig.moving_mass_kg,
            "internal_mass_uncertainty": rig.u_moving_mass_kg,
        },
    }
    if grams:
        tables["load"] = {
            "mass": grams * 1e-3,
            "mass_uncertainty": rig.u_load_mass_kg,
            "centre_of_mass": [0.0, 0.0, 0.0],
            "inertia": [[0.0, 0.0, 0.0], [0.0, 0.0, 0.0], [0.0, 0.0, 0.0]],
        }
    return tables
