"""Simulated releases: step responses, several loads."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from fusion.simulate.channels import to_toml
from fusion.simulate.world import Draws
from shaker.arrays import FloatArray
from shaker.labels import LOAD_COMPONENTS
from shaker.lti.modal import ModalModel
from shaker.release.load_model import LoadModel
from shaker.release.onset import pole_responses

# The simulated calibration by releases: a six-component sensor, a rope that parts, six outputs that ring.


TRUTH_FILE, DAQ_FILE = "truth.json", "outputs.h5"


@dataclass(frozen=True)
class Rope:
    """What lets go: how long the load takes to vanish along a straight line, in s, and its relative scatter."""

    name: str
    release_s: float
    scatter: float


COTTON, LINE, PLASTIC = (
    Rope("cotton rope", 3e-3, 0.15),
    Rope("fishing line", 0.15e-3, 0.05),
    Rope("plastic rope", 1.2e-3, 0.1),
)


@dataclass(frozen=True)
class StepRig:
    """Truth and nominal values of sensor, amplifier and recorder.

    One mode per component (`frequency_hz`, `damping_ratio`) and the amplifier's real pole `chain_hz`; `capacity` and
    `sensitivity` by component, the latter in V/V per N or N·m; `mixing`: largest share by which a load drives, and an
    output shows, the mode of another component. `load_share`: what hangs on the rope, over the capacity; `noise`: over
    the output's change. Recorder: `range_v` on `bits`, `gain` V per V/V, times in s.
    """

    frequency_hz: tuple[float, ...] = (1700.0, 1735.0, 2000.0, 3500.0, 3570.0, 5000.0)
    damping_ratio: float = 0.015
    chain_hz: float = 6000.0
    capacity: tuple[float, ...] = (200.0, 200.0, 400.0, 10.0, 10.0, 10.0)
    sensitivity: tuple[float, ...] = (5e-6, 5e-6, 2.5e-6, 1e-4, 1e-4, 1e-4)
    mixing: float = 0.02
    load_share: float = 0.3
    u_sensitivity: float = 1e-3
    noise: float = 0.01
    offset_v: float = 0.05
    gain: float = 1e4
    range_v: float = 10.0
    bits: int = 16
    sample_rate_hz: float = 100e3
    before_s: float = 10e-3
    after_s: float = 50e-3
    start_scatter_s: float = 0.2e-3


@dataclass(frozen=True)
class Release:
    """One recording: the component that is loaded, what lets go, and the number of the repeat."""

    component: str
    rope: Rope
    repeat: int

    @property
    def name(self) -> str:
        """Name of the recording's folder."""
        return f"{self.component}-{self.rope.name.replace(' ', '-')}-{self.repeat}"


def releases() -> tuple[Release, ...]:
    """Return three ropes on Fz with three releases each, and two releases of a fishing line on every other one."""
    axial = [Release("Fz", rope, repeat) for rope in (COTTON, LINE, PLASTIC) for repeat in (1, 2, 3)]
    other = [Release(c, LINE, repeat) for c in LOAD_COMPONENTS if c != "Fz" for repeat in (1, 2)]
    return (*axial, *other)


def write_steps(folder: Path, seed: int, rig: StepRig | None = None) -> tuple[Path, ...]:
    """Write `rig.toml`, `truth.json` and all recordings into an empty folder and return the recordings' folders."""
    rig = rig or StepRig()
    draws = Draws(seed, True)
    model = sensor_model(rig, draws)
    _write_texts(folder, {"rig.toml": to_toml(_rig_tables(rig, model, draws))})
    found = [_write_release(folder / release.name, rig, model, release, draws) for release in releases()]
    _write_texts(folder, {TRUTH_FILE: json.dumps(_truth(rig, model, draws))})
    return tuple(found)


def sensor_model(rig: StepRig, draws: Draws) -> tuple[tuple[ModalModel, ...], ...]:
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
    return tuple(
        tuple(
            ModalModel(
                frequency,
                damping,
                np.asarray(show[i] * drive[:, c] * swing),
                np.array([rig.chain_hz]),
                np.array([np.sum(show[i] * drive[:, c] * lag)]),
            )
            for c in range(modes)
        )
        for i in range(modes)
    )


def change(model: ModalModel, time_s: FloatArray, onset_s: float, release_s: float) -> FloatArray:
    """Return the output (N,) while a unit load is put on from `onset_s` along a straight line of `release_s`."""
    response = pole_responses(model.poles, time_s, onset_s, release_s)
    upper, real = np.split(response, [len(model.frequency_hz)], axis=1)
    return np.asarray(2.0 * np.real(upper @ model.residue) + np.real(real) @ model.real_residue)


def _write_release(
    folder: Path, rig: StepRig, model: tuple[tuple[ModalModel, ...], ...], release: Release, draws: Draws
) -> Path:
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
    clean = np.stack([load * (one.static_gain - change(one, time_s, onset_s, release_s)) for one in column])
    steps = np.array(rig.sensitivity) * np.array(rig.capacity) * rig.load_share
    noise = rig.noise * steps[:, None] * draws.stream(f"{release.name}.noise").standard_normal(clean.shape)
    volts = _digitised(rig, rig.gain * (clean + noise) + offset[:, None])
    write_outputs(folder, dict(zip(LOAD_COMPONENTS, volts, strict=True)), rig.sample_rate_hz)
    baseline = [load * one.static_gain + float(zero) / rig.gain for one, zero in zip(column, offset, strict=True)]
    truth = {
        "format": 1,
        "preset": "steps",
        "component": release.component,
        "amplitude": -load,
        "onset_s": onset_s,
        "release": release.rope.name,
        "release_s": release_s,
        "shape": "ramp",
        "baseline": baseline,
        "steady": (offset / rig.gain).tolist(),
        "static_gain": [one.static_gain for one in column],
        "noise": (rig.noise * steps).tolist(),
    }
    tables = _recording_tables(rig, release, -load)
    _write_texts(folder, {"recording.toml": to_toml(tables), TRUTH_FILE: json.dumps(truth)})
    return folder


def write_outputs(folder: Path, volts: Mapping[str, FloatArray], sample_rate_hz: float) -> None:
    """Write the samples (N,) of every channel, in V, into the DAQ file of a recording's new folder."""
    import h5py

    folder.mkdir(parents=True)
    with h5py.File(folder / DAQ_FILE, "w") as file:
        for name, values in volts.items():
            data = file.create_dataset(name, data=values.astype(np.float32), compression="gzip", shuffle=True)
            data.attrs["sample_rate"] = sample_rate_hz
            data.attrs["unit"] = "V"


def _digitised(rig: StepRig, volts: FloatArray) -> FloatArray:
    """Return what the converter shows: whole steps within its range."""
    step = 2.0 * rig.range_v / 2**rig.bits
    return np.asarray(np.clip(np.rint(volts / step), -(2 ** (rig.bits - 1)), 2 ** (rig.bits - 1) - 1) * step)


def _rig_tables(rig: StepRig, model: tuple[tuple[ModalModel, ...], ...], draws: Draws) -> dict[str, Any]:
    """Return rig.toml as nested dictionaries: the static sensitivities off by what is stated as their uncertainty."""
    static = np.array([[one.static_gain for one in row] for row in model])
    error = draws.normal("sensor.static_sensitivity", rig.u_sensitivity, static.size).reshape(static.shape)
    return {
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


def _recording_tables(rig: StepRig, release: Release, amplitude: float) -> dict[str, Any]:
    """Return recording.toml as nested dictionaries."""
    channels = [
        {"name": name, "quantity": "output", "channel": name, "scale": 1.0 / rig.gain} for name in LOAD_COMPONENTS
    ]
    return {
        "format": 1,
        "name": f"{release.component} released by {release.rope.name}, {release.repeat}, simulated",
        "rig": "../rig.toml",
        "excitation": {
            "kind": "step",
            "component": release.component,
            "step_amplitude": amplitude,
            "release": release.rope.name,
        },
        "daq": [{"name": "daq", "file": DAQ_FILE, "clock_uncertainty": 1e-6, "channel": channels}],
    }


def _truth(rig: StepRig, model: tuple[tuple[ModalModel, ...], ...], draws: Draws) -> dict[str, Any]:
    """Return truth.json of the campaign: poles, residues of every output (row) and load component (column)."""
    residue = np.array([[one.residue for one in row] for row in model])
    return {
        "format": 1,
        "preset": "steps",
        "seed": draws.seed,
        "channels": list(LOAD_COMPONENTS),
        "components": list(LOAD_COMPONENTS),
        "frequency_hz": list(rig.frequency_hz),
        "damping_ratio": [rig.damping_ratio] * len(rig.frequency_hz),
        "residue": {"re": residue.real.tolist(), "im": residue.imag.tolist()},
        "real_hz": [rig.chain_hz],
        "real_residue": [[one.real_residue.tolist() for one in row] for row in model],
        "static_gain": [[one.static_gain for one in row] for row in model],
        "drawn": draws.values,
    }


def _write_texts(folder: Path, texts: Mapping[str, str]) -> None:
    """Write text files into a folder."""
    for name, text in texts.items():
        (folder / name).write_text(text, encoding="utf-8", newline="\n")


# The simulated load series: a force sensor that a thin line releases, with five masses on its pillar.


CHANNEL, COMPONENT, ROPE = "Fy", "Fy", "fishing line"
PLACE = 1
"""Place of the component among Fx … Mz."""


@dataclass(frozen=True)
class SeriesRig:
    """Truth and nominal values: masses in kg, N/m, N·s/m; output in V, recorded as it is; times in s.

    `loads_g`: masses on the pillar in g; `noise` over the output's change; the load of `force_n` vanishes along a
    straight line of `release_s`.
    """

    loads_g: tuple[int, ...] = (0, 8, 48, 98, 198)
    moving_mass_kg: float = 0.240
    u_moving_mass_kg: float = 5e-5
    u_load_mass_kg: float = 5e-6
    stiffness: float = 2.36e6
    damping: float = 6.0
    coupling_stiffness: float = 1.89e6
    coupling_damping: float = 4.0
    sensitivity: float = 0.4
    force_n: float = 10.0
    noise: float = 0.01
    offset_v: float = 0.1
    range_v: float = 10.0
    bits: int = 16
    release_s: float = 0.4e-3
    before_s: float = 20e-3
    start_scatter_s: float = 1e-3
    duration_s: float = 0.5
    sample_rate_hz: float = 100e3


def write_loads(folder: Path, seed: int, rig: SeriesRig | None = None) -> tuple[Path, ...]:
    """Write a rig and a recording for every load, and the truth, into an empty folder; return the recordings' folders.

    The masses differ from the stated ones by errors of the stated uncertainties, the moving mass by one for all.
    """
    rig = rig or SeriesRig()
    draws = Draws(seed, True)
    model = true_model(rig, draws)
    found = []
    for grams in rig.loads_g:
        load = grams * 1e-3
        if grams:
            load += float(draws.normal(f"load {grams} g.mass", rig.u_load_mass_kg))
        _write_texts(folder, {_rig_file(grams): to_toml(_loads_rig_tables(rig, grams))})
        found.append(_loads_write_release(folder, rig, model, grams, load, draws))
    masses = [grams * 1e-3 + draws.values.get(f"load {grams} g.mass", [0.0])[0] for grams in rig.loads_g]
    _write_texts(folder, {TRUTH_FILE: json.dumps(_loads_truth(rig, model, masses, draws))})
    return tuple(found)


def true_model(rig: SeriesRig, draws: Draws) -> LoadModel:
    """Return the sensor as it is, its moving mass drawn."""
    return LoadModel(
        component=COMPONENT,
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


def _rig_file(grams: int) -> str:
    """Name of the rig with a load."""
    return f"rig-{grams:03d}g.toml"


def _loads_write_release(folder: Path, rig: SeriesRig, model: LoadModel, grams: int, load: float, draws: Draws) -> Path:
    """Write one recording: the force vanishes, the output falls from its loaded level to zero and rings."""
    name = recording_name(grams)
    onset_s = rig.before_s + float(draws.stream(f"{name}.release").uniform(0.0, rig.start_scatter_s))
    time_s = np.arange(round(rig.duration_s * rig.sample_rate_hz)) / rig.sample_rate_hz
    offset = rig.offset_v * float(draws.stream(f"{name}.offset").standard_normal())
    clean = rig.force_n * (rig.sensitivity - load_change(model, load, time_s, onset_s, rig.release_s))
    noise = rig.noise * rig.force_n * rig.sensitivity * draws.stream(f"{name}.noise").standard_normal(len(clean))
    step = 2.0 * rig.range_v / 2**rig.bits
    volts = np.clip(np.rint((clean + noise + offset) / step) * step, -rig.range_v, rig.range_v - step)
    write_outputs(folder / name, {CHANNEL: np.asarray(volts)}, rig.sample_rate_hz)
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
    tables = _loads_recording_tables(rig, grams)
    _write_texts(folder / name, {"recording.toml": to_toml(tables), TRUTH_FILE: json.dumps(truth)})
    return folder / name


def _loads_rig_tables(rig: SeriesRig, grams: int) -> dict[str, Any]:
    """Return the rig with a load as nested dictionaries."""
    row = [rig.sensitivity if place == PLACE else 0.0 for place in range(6)]
    tables: dict[str, Any] = {
        "format": 1,
        "name": f"force sensor of a haptic device, load mass {grams} g, simulated",
        "sensor": {
            "name": "three-component force sensor",
            "channels": [CHANNEL],
            "unit": "V",
            "sense": "on_sensor",
            "static_sensitivity": [row],
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


def _loads_recording_tables(rig: SeriesRig, grams: int) -> dict[str, Any]:
    """Return recording.toml as nested dictionaries."""
    return {
        "format": 1,
        "name": f"release of {COMPONENT} with a load of {grams} g, simulated",
        "rig": f"../{_rig_file(grams)}",
        "excitation": {
            "kind": "step",
            "component": COMPONENT,
            "step_amplitude": -rig.force_n,
            "release": ROPE,
        },
        "daq": [
            {
                "name": "daq",
                "file": "outputs.h5",
                "clock_uncertainty": 1e-6,
                "channel": [{"name": CHANNEL, "quantity": "output", "channel": CHANNEL}],
            }
        ],
    }


def _loads_truth(rig: SeriesRig, model: LoadModel, masses: list[float], draws: Draws) -> dict[str, Any]:
    """Return truth.json of the campaign."""
    return {
        "format": 1,
        "preset": "loads",
        "seed": draws.seed,
        "component": COMPONENT,
        "channel": CHANNEL,
        "moving_mass_kg": model.moving_mass,
        "load_mass_kg": dict(zip(map(recording_name, rig.loads_g), masses, strict=True)),
        "stiffness": rig.stiffness,
        "damping": rig.damping,
        "coupling_stiffness": rig.coupling_stiffness,
        "coupling_damping": rig.coupling_damping,
        "sensitivity": rig.sensitivity,
        "release_s": rig.release_s,
        "drawn": draws.values,
    }
