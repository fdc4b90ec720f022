"""Simulated calibrations by releases: a hanging load is released, and the outputs ring.

`steps`: a six-component sensor, three kinds of rope. `loads`: a force sensor released by a thin line, with five masses
on its pillar.
"""

from __future__ import annotations

import json
from dataclasses import dataclass as plain_dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np
from pydantic.dataclasses import dataclass

from fusion.recording.toml import to_toml
from fusion.report.atomic_files import write_files
from fusion.simulate.preset import CHECKED, read_preset
from fusion.simulate.world import Draws
from fusion.simulate.write import RIG_FILE, TRUTH_FILE, Record, complex_table, write_recording
from shaker.labels import LOAD_COMPONENTS
from shaker.lti.system import ModalModel
from shaker.release.load_response import pole_responses
from shakercal._common.arrays import ComplexArray, FloatArray

DAQ_FILE = "outputs.h5"
CHANNEL, ROPE = "Fy", "fishing line"  # output and load component of the force sensor, and what releases it
Model = tuple[tuple[ModalModel, ...], ...]  # response of every output (row) to every load component (column)
Channels = list[dict[str, Any]]  # blocks of the channels in a manifest


@dataclass(frozen=True, config=CHECKED)
class SimulatedRope:
    """A release device: duration of the release, s, relative scatter, shape (ramp or half cosine)."""

    name: str
    release_s: float
    scatter: float
    shape: Literal["ramp", "smooth"] = "ramp"


@dataclass(frozen=True, config=CHECKED)
class SimulatedRecorder:
    """Common properties of all recordings: `noise` over the output change, offset, range, start.

    `range_v` on `bits`. Times in s: the release is `before_s`, plus a random time of up to `start_scatter_s`, after the
    first sample.
    """

    noise: float
    offset_v: float
    range_v: float
    bits: int
    sample_rate_hz: float
    before_s: float
    start_scatter_s: float

    def release_times(
        self, name: str, rope: SimulatedRope, duration_s: float, draws: Draws
    ) -> tuple[FloatArray, float, float]:
        """Return sample times (N,), onset of the release, and its duration."""
        rng = draws.stream(f"{name}.release")
        onset_s = self.before_s + float(rng.uniform(0.0, self.start_scatter_s))
        release_s = rope.release_s * (1.0 + rope.scatter * float(rng.uniform(-1.0, 1.0)))
        return np.arange(round(duration_s * self.sample_rate_hz)) / self.sample_rate_hz, onset_s, release_s

    def offsets(self, name: str, outputs: int, draws: Draws) -> FloatArray:
        """Return the level of every output (C,) without load, V."""
        return self.offset_v * draws.stream(f"{name}.offset").standard_normal(outputs)

    def record(self, name: str, volts: FloatArray, steps: FloatArray, channels: Channels, draws: Draws) -> Record:
        """Return the stored samples of outputs (C, N), V, with noise."""
        noise = self.noise * steps[:, None] * draws.stream(f"{name}.noise").standard_normal(volts.shape)
        step = 2.0 * self.range_v / 2**self.bits
        shown = np.clip(np.rint((volts + noise) / step), -(2 ** (self.bits - 1)), 2 ** (self.bits - 1) - 1) * step
        names = [str(channel["name"]) for channel in channels]
        samples = {name: values.astype(np.float32) for name, values in zip(names, shown, strict=True)}
        return Record(self.sample_rate_hz, samples, dict.fromkeys(names, "V"))


@dataclass(frozen=True, config=CHECKED)
class StepRig(SimulatedRecorder):
    """Truth and nominal values of sensor, amplifier and recorder.

    One mode per component (`frequency_hz`, `damping_ratio`) and the amplifier's real pole `chain_hz`. `capacity` and
    `sensitivity` by component, the latter in V/V per N or N·m. `mixing`: largest share of a load in the excitation, and
    of an output in the observation, of another component's mode. `load_share`: hanging load over the capacity. `gain`:
    V per V/V. `after_s`: duration of the record after the release. The first of the `ropes` releases every component,
    all of them release Fz.
    """

    frequency_hz: tuple[float, ...]
    damping_ratio: float
    chain_hz: float
    capacity: tuple[float, ...]
    sensitivity: tuple[float, ...]
    mixing: float
    load_share: float
    u_sensitivity: float
    gain: float
    after_s: float
    ropes: tuple[SimulatedRope, ...]


@plain_dataclass(frozen=True)
class SimulatedRelease:
    """One recording: loaded component, release device, number of the repeat."""

    component: str
    rope: SimulatedRope
    repeat: int

    @property
    def name(self) -> str:
        """Name of the recording's folder."""
        return f"{self.component}-{self.rope.name.replace(' ', '-')}-{self.repeat}"


def releases(rig: StepRig) -> tuple[SimulatedRelease, ...]:
    """Return all releases: three of each rope on Fz, two on other components."""
    axial = [SimulatedRelease("Fz", rope, repeat) for rope in rig.ropes for repeat in (1, 2, 3)]
    other = [SimulatedRelease(c, rig.ropes[0], repeat) for c in LOAD_COMPONENTS if c != "Fz" for repeat in (1, 2)]
    return (*axial, *other)


def write_steps(folder: Path, seed: int, rig: StepRig | None = None) -> tuple[Path, ...]:
    """Write `rig.toml`, `truth.json` and all recordings, and return the folders of the recordings.

    The static sensitivities of the rig have errors of their stated uncertainty.
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
    write_files(folder, {RIG_FILE: to_toml(tables), TRUTH_FILE: json.dumps(truth)})
    return recordings


def sensor_model(rig: StepRig, draws: Draws) -> Model:
    """Return the response of every output (row) to every load component (column).

    In V/V per N or N·m. H = C·diag[ω²/(s² + 2ζωs + ω²)]·B·2πf_c/(s + 2πf_c): loads excite the modes by B, outputs
    observe them by C, both nearly diagonal; the amplifier is the last factor. Residues follow from partial fractions.
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


def _write_release(folder: Path, rig: StepRig, model: Model, release: SimulatedRelease, draws: Draws) -> Path:
    """Write one recording: the load vanishes, and every output returns to zero."""
    name, index = release.name, LOAD_COMPONENTS.index(release.component)
    load, column = rig.load_share * rig.capacity[index], [row[index] for row in model]
    time_s, onset_s, release_s = rig.release_times(name, release.rope, rig.before_s + rig.after_s, draws)
    offset, static = rig.offsets(name, len(model), draws), [one.static_gain for one in column]
    # the poles of all outputs are the same
    response = pole_responses(column[0].poles, time_s, onset_s, release_s, release.rope.shape)
    upper, real = np.split(response, [len(rig.frequency_hz)], axis=1)
    responses = (2.0 * np.real(upper @ one.residue) + np.real(real) @ one.real_residue for one in column)
    clean = np.stack([load * (gain - response_v) for gain, response_v in zip(static, responses, strict=True)])
    steps = np.array(rig.sensitivity) * np.array(rig.capacity) * rig.load_share
    truth = {
        "format": 1,
        "preset": "steps",
        "component": release.component,
        "amplitude": -load,
        "onset_s": onset_s,
        "release": release.rope.name,
        "release_s": release_s,
        "shape": release.rope.shape,
        "baseline": [load * gain + float(zero) / rig.gain for gain, zero in zip(static, offset, strict=True)],
        "steady": (offset / rig.gain).tolist(),
        "static_gain": static,
        "noise": (rig.noise * steps).tolist(),
    }
    channels = [{"name": c, "quantity": "output", "channel": c, "scale": 1.0 / rig.gain} for c in LOAD_COMPONENTS]
    title = f"{release.component} released by {release.rope.name}, {release.repeat}, simulated"
    manifest = _step_tables(title, RIG_FILE, (release.component, -load, release.rope.name), channels)
    record = rig.record(name, rig.gain * clean + offset[:, None], rig.gain * steps, channels, draws)
    return write_recording(folder, manifest, truth, {DAQ_FILE: record})


def _step_tables(name: str, rig: str, released: tuple[str, float, str], channels: Channels) -> dict[str, Any]:
    """Return recording.toml as nested dictionaries; `released`: component, change of the load, device."""
    component, amplitude, rope = released
    return {
        "format": 1,
        "name": name,
        "rig": f"../{rig}",
        "excitation": {"kind": "step", "component": component, "step_amplitude": amplitude, "release": rope},
        "daq": [{"name": "daq", "file": DAQ_FILE, "clock_uncertainty": 1e-6, "channel": channels}],
    }


@dataclass(frozen=True, config=CHECKED)
class SeriesRig(SimulatedRecorder):
    """Truth and nominal values: masses in kg, N/m, N·s/m; output in V; times in s.

    `loads_g`: masses on the pillar in g. The load of `force_n` vanishes linearly within `release_s`.
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
    release_s: float
    duration_s: float


def write_loads(folder: Path, seed: int, rig: SeriesRig | None = None) -> tuple[Path, ...]:
    """Write rigs, recordings and truth of all loads; return the recordings' folders.

    The true masses differ from the stated ones within the stated uncertainties; the error of the moving mass is common.
    """
    rig = rig or read_preset(SeriesRig, "loads")
    draws = Draws(seed, True)
    moving = rig.moving_mass_kg + float(draws.normal("moving.mass", rig.u_moving_mass_kg))
    recordings, masses = [], {}
    for grams in rig.loads_g:
        load = grams * 1e-3
        if grams:
            load += float(draws.normal(f"load {grams} g.mass", rig.u_load_mass_kg))
        masses[f"step-{grams:03d}g"] = load
        write_files(folder, {f"rig-{grams:03d}g.toml": to_toml(_series_rig(rig, grams))})
        recordings.append(_write_series_release(folder, rig, grams, (moving, load), draws))
    truth = {
        "format": 1,
        "preset": "loads",
        "seed": draws.seed,
        "component": CHANNEL,
        "channel": CHANNEL,
        "moving_mass_kg": moving,
        "load_mass_kg": masses,
        "stiffness": rig.stiffness,
        "damping": rig.damping,
        "coupling_stiffness": rig.coupling_stiffness,
        "coupling_damping": rig.coupling_damping,
        "sensitivity": rig.sensitivity,
        "release_s": rig.release_s,
        "drawn": draws.values,
    }
    write_files(folder, {TRUTH_FILE: json.dumps(truth)})
    return tuple(recordings)


def true_modes(rig: SeriesRig, moving: float, load: float) -> tuple[ComplexArray, ComplexArray]:
    """Return poles, rad/s, and residues of the output over a force.

    M ẍ + B ẋ + K x = f of the moving mass and the load on their springs, by the eigenvectors of the first-order
    equations. It is independent of `shaker.release.load_model`, whose results are tested with these recordings.
    """
    joint = np.array([[1.0, -1.0], [-1.0, 1.0]])
    stiffness = np.diag([rig.stiffness, 0.0]) + rig.coupling_stiffness * joint
    damping = np.diag([rig.damping, 0.0]) + rig.coupling_damping * joint
    mass = np.array([moving, load])
    if load == 0.0:  # nothing on the spring of the coupling
        mass, stiffness, damping = mass[:1], np.array([[rig.stiffness]]), np.array([[rig.damping]])
    size, inverse = len(mass), np.diag(1.0 / mass)
    system = np.block([[np.zeros((size, size)), np.eye(size)], [-inverse @ stiffness, -inverse @ damping]])
    poles, shapes = np.linalg.eig(system)
    push = np.concatenate([np.zeros(size), inverse[:, -1]])
    return poles, rig.sensitivity * rig.stiffness * shapes[0] * np.linalg.solve(shapes, push)


def _write_series_release(folder: Path, rig: SeriesRig, grams: int, masses: tuple[float, float], draws: Draws) -> Path:
    """Write one recording: the force vanishes, the output falls to zero and rings."""
    name, (poles, residues) = f"step-{grams:03d}g", true_modes(rig, *masses)
    time_s, onset_s, release_s = rig.release_times(name, SimulatedRope(ROPE, rig.release_s, 0.0), rig.duration_s, draws)
    offset, steps = rig.offsets(name, 1, draws), np.array([rig.force_n * rig.sensitivity])
    change = (pole_responses(poles, time_s, onset_s, release_s) @ residues).real
    upper = sorted(poles[poles.imag > 0.0], key=abs)
    truth = {
        "format": 1,
        "preset": "loads",
        "load_mass_kg": masses[1],
        "amplitude": -rig.force_n,
        "onset_s": onset_s,
        "release_s": release_s,
        "baseline": float(steps[0] + offset[0]),
        "steady": float(offset[0]),
        "frequency_hz": [float(abs(pole)) / (2.0 * np.pi) for pole in upper],
        "damping_ratio": [float(-pole.real / abs(pole)) for pole in upper],
    }
    channels = [{"name": CHANNEL, "quantity": "output", "channel": CHANNEL}]
    title = f"release of {CHANNEL} with a load of {grams} g, simulated"
    manifest = _step_tables(title, f"rig-{grams:03d}g.toml", (CHANNEL, -rig.force_n, ROPE), channels)
    volts = rig.force_n * (rig.sensitivity - change[None]) + offset[:, None]
    return write_recording(folder / name, manifest, truth, {DAQ_FILE: rig.record(name, volts, steps, channels, draws)})


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
