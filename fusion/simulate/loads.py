"""The simulated load series: a force sensor that a thin line releases, with five masses on its pillar."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from fusion.simulate.draws import Draws
from fusion.simulate.steps import TRUTH_FILE, write_outputs
from fusion.simulate.toml_text import to_toml
from shaker._checks import FloatArray
from shaker.models.load_series.model import LoadModel
from shaker.models.step.basis import pole_responses

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
        _write_texts(folder, {_rig_file(grams): to_toml(_rig_tables(rig, grams))})
        found.append(_write_release(folder, rig, model, grams, load, draws))
    masses = [grams * 1e-3 + draws.values.get(f"load {grams} g.mass", [0.0])[0] for grams in rig.loads_g]
    _write_texts(folder, {TRUTH_FILE: json.dumps(_truth(rig, model, masses, draws))})
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


def _write_release(folder: Path, rig: SeriesRig, model: LoadModel, grams: int, load: float, draws: Draws) -> Path:
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
    tables = _recording_tables(rig, grams)
    _write_texts(folder / name, {"recording.toml": to_toml(tables), TRUTH_FILE: json.dumps(truth)})
    return folder / name


def _rig_tables(rig: SeriesRig, grams: int) -> dict[str, Any]:
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


def _recording_tables(rig: SeriesRig, grams: int) -> dict[str, Any]:
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


def _truth(rig: SeriesRig, model: LoadModel, masses: list[float], draws: Draws) -> dict[str, Any]:
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


def _write_texts(folder: Path, texts: Mapping[str, str]) -> None:
    """Write text files into a folder."""
    for name, text in texts.items():
        (folder / name).write_text(text, encoding="utf-8", newline="\n")
