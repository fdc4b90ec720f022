"""Releases of `other_physics.py`: campaigns for `step`, `decouple` and `load`, with their truths."""

from __future__ import annotations

import json
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from other_physics_files import Case, FloatArray, Numbers, Readings, number, rows_of, write_channels, write_toml
from other_physics_sensor import (
    ComplexArray,
    Plant,
    Spring,
    butterworth,
    converted,
    frequency_truths,
    hum,
    lag,
    mechanical,
    modes,
    noise,
    release,
    respond,
    ring,
    step_truths,
)
from scipy.optimize import brentq

COMPONENTS = ("Fx", "Fy", "Fz", "Mx", "My", "Mz")
Modes = tuple[tuple[float, float, float], ...]


def step_manifest(name: str, component: str, amplitude: float, channels: list[dict[str, Any]]) -> dict[str, Any]:
    """Return the recording.toml of a release."""
    return {
        "name": name,
        "rig": "../rig.toml",
        "excitation": {
            "kind": "step",
            "component": component,
            "step_amplitude": amplitude,
            "release": "fishing line",
        },
        "daq": [{"name": "daq", "file": "outputs.h5", "channel": channels}],
    }


def output(name: str) -> dict[str, Any]:
    """Return the block of an output of the sensor."""
    return {"name": name, "quantity": "output", "channel": name}


# `step`: one output, the force that drives it, its amplifier.


@dataclass(frozen=True)
class StepPlan:
    """What is recorded: modes by their shares, amplifier, releases, noise over the step, and what disturbs it."""

    figures: Modes = ((1700.0, 0.015, 1.0),)
    releases: int = 3
    shapes: tuple[str, ...] = ("ramp",)
    time_s: tuple[float, float] = (0.2e-3, 0.35e-3)
    noise: str = "white"
    level: float = 0.01
    hum: float = 0.0
    bits: int = 0
    rate_hz: float = 50e3
    samples: int = 6000
    rest_s: float = 0.02
    filter_hz: float = 0.0
    filter_stated: bool = False
    measured: bool = False
    growing: bool = False
    softening: float = 0.0
    friction: float = 0.0

    def plant(self, rng: np.random.Generator) -> tuple[Plant, Modes]:
        """Return sensor and chain of one draw: frequencies within ±8 %, damping ratios within ±20 %."""
        wide, damped = 1.0 + 0.08 * rng.uniform(-1.0, 1.0), 1.0 + 0.2 * rng.uniform(-1.0, 1.0)
        figures = tuple((f * wide, z * damped, share) for f, z, share in self.figures)
        plant = modes(figures, 0.01).into(lag(6e3))
        return (plant.into(butterworth(4, self.filter_hz)) if self.filter_hz else plant), figures


def build_step(plan: StepPlan, folder: Path, rng: np.random.Generator) -> Numbers:
    """Write the releases of 100 N from a sensor of 0.01 V/N, and return its true indices."""
    plant, figures = plan.plant(rng)
    truth = frequency_truths(plant) | step_truths(plant)
    truth["read_static_gain"] = truth["static_gain"]
    sensor = {
        "name": "force sensor",
        "channels": ["Fz"],
        "unit": "V",
        "sense": "on_sensor",
        "static_sensitivity": [[0.0, 0.0, 0.01, 0.0, 0.0, 0.0]],
        "internal_mass": 0.5,
    }
    write_toml(folder / "rig.toml", {"name": "releases", "sensor": sensor})
    for index in range(plan.releases):
        place = folder / f"release-{index + 1}"
        manifest = step_manifest(place.name, "Fz", -100.0, [output("Fz")])
        shape = plan.shapes[index % len(plan.shapes)]
        channels = _recorded_step(plan, plant, figures, release(shape, float(rng.uniform(*plan.time_s))), rng)
        if plan.growing and index == 1:
            time_s = np.arange(plan.samples) / plan.rate_hz
            channels["Fz"] += 0.03 * np.exp((time_s - time_s[-1]) / 0.03) * np.sin(2.0 * np.pi * 2310.0 * time_s)
        if plan.measured:
            manifest["excitation"]["force"] = "load cell"
            del manifest["excitation"]["release"]
            manifest["daq"][0]["channel"].append(
                {
                    "name": "load cell",
                    "quantity": "force",
                    "body": "load",
                    "point": [0.0, 0.0, 0.05],
                    "direction": [0.0, 0.0, 1.0],
                }
            )
        if plan.filter_stated:
            manifest["daq"][0]["channel"][0]["response"] = "filter.toml"
            element = {"name": "anti-aliasing filter", "filter": "butterworth", "order": 4, "corner": plan.filter_hz}
            write_toml(place / "filter.toml", {"element": [element]})
        write_toml(place / "recording.toml", manifest)
        write_channels(place / "outputs.h5", plan.rate_hz, channels)
    return truth


def _recorded_step(
    plan: StepPlan, plant: Plant, figures: Modes, stages: list[Any], rng: np.random.Generator
) -> dict[str, FloatArray]:
    """Return the channels of one record, whose release begins at any time between samples."""
    count, rate_hz = plan.samples, plan.rate_hz
    times_s = np.arange(count) / rate_hz - plan.rest_s - rng.uniform() / rate_hz
    if plan.softening or plan.friction:
        spring = Spring(figures[0][0], figures[0][1], plan.softening, plan.friction)
        values, gone = ring(spring, stages[0].last_s, 6e3, times_s), np.zeros(count)
    else:
        found, gone = respond(plant, np.array([-100.0]), stages, times_s)
        values = 1.0 + found[0]
    if plan.hum:
        values = values + plan.hum * hum(count, rate_hz, rng)
    values = 0.1 + values + plan.level * noise(plan.noise, count, rate_hz, rng)
    if plan.bits:
        values = converted(values, 10.0 / 2**plan.bits)
    force = 100.0 * (1.0 - gone) + 0.5 * rng.standard_normal(count)
    return {"Fz": values} | ({"load cell": force} if plan.measured else {})


def read_step(results: Path) -> Readings:
    """Return the indices of the driven output."""
    rows = [row for row in rows_of(results / "indices.csv") if row["component"] == row["channel"]]
    return {row["name"]: (number(row["value"]), number(row["U"])) for row in rows}


# `decouple`: a rigid body on six springs, whose strains every output reads.


@dataclass(frozen=True)
class BodyPlan:
    """A six-component sensor and its releases: two of every component."""

    shape: str = "ramp"
    time_s: tuple[float, float] = (0.12e-3, 0.3e-3)
    level: float = 0.01
    hum: float = 0.0
    bits: int = 0
    rate_hz: float = 50e3
    samples: int = 3000


def six_component(rng: np.random.Generator) -> Plant:
    """Return a body of 0.6 kg on the springs of a sensor, outputs in V (0.01 V/N, 0.2 V/(N·m)) behind 6 kHz."""
    off = 1e-3 * rng.uniform(-4.0, 4.0, 3) + np.array([0.0, 0.0, 0.008])
    cross = np.array([[0.0, -off[2], off[1]], [off[2], 0.0, -off[0]], [-off[1], off[0], 0.0]])
    own = 0.6
    mass = np.block(
        [[own * np.eye(3), -own * cross], [own * cross, np.diag([6e-4, 6.5e-4, 5e-4]) - own * cross @ cross]]
    )
    frequency = np.array([1000.0, 1120.0, 1500.0, 2150.0, 2300.0, 2900.0]) * (1.0 + 0.03 * rng.uniform(-1, 1, 6))
    stiffness = np.diag(np.diag(mass) * (2.0 * np.pi * frequency) ** 2)
    shapes = np.linalg.inv(np.linalg.cholesky(mass)).T
    w2, turned = np.linalg.eigh(shapes.T @ stiffness @ shapes)
    to_modes = np.linalg.inv(shapes @ turned)
    damping = to_modes.T @ np.diag(2.0 * rng.uniform(0.012, 0.018, 6) * np.sqrt(w2)) @ to_modes
    size = np.array([0.01] * 3 + [0.2] * 3)
    sensitivity = np.diag(size) + 0.02 * size[:, None] * rng.uniform(-1.0, 1.0, (6, 6)) * (
        np.array([1.0] * 3 + [20.0] * 3)
    )
    return mechanical(mass, damping, stiffness, sensitivity @ stiffness).into(lag(6e3))


def build_body(plan: BodyPlan, folder: Path, rng: np.random.Generator) -> Numbers:
    """Write twelve releases and return poles, residues and static gains, in the order of ascending frequency."""
    plant = six_component(rng)
    static = plant.response(np.zeros(1))[0].real
    sensor = {
        "name": "six-component sensor",
        "channels": list(COMPONENTS),
        "unit": "V",
        "sense": "on_sensor",
        "capacity": [200.0, 200.0, 200.0, 10.0, 10.0, 10.0],
        "internal_mass": 0.6,
    }
    write_toml(folder / "rig.toml", {"name": "releases of six components", "sensor": sensor})
    for index, component in enumerate(COMPONENTS):
        amplitude = -100.0 if index < 3 else -5.0
        for repeat in (1, 2):
            place = folder / f"{component}-{repeat}"
            times_s = np.arange(plan.samples) / plan.rate_hz - 0.012 - rng.uniform() / plan.rate_hz
            stages = release(plan.shape, float(rng.uniform(*plan.time_s)))
            values = respond(plant, amplitude * np.eye(6)[index], stages, times_s)[0]
            values += plan.level * np.array([noise("white", plan.samples, plan.rate_hz, rng) for _ in range(6)])
            if plan.hum:
                values += plan.hum * rng.uniform(0.3, 1.0, 6)[:, None] * hum(plan.samples, plan.rate_hz, rng)
            if plan.bits:
                values = converted(values, 10.0 / 2**plan.bits)
            write_toml(
                place / "recording.toml",
                step_manifest(place.name, component, amplitude, [output(one) for one in COMPONENTS]),
            )
            write_channels(place / "outputs.h5", plan.rate_hz, dict(zip(COMPONENTS, values, strict=True)))
    return _body_truths(plant, static) | _keep(folder, plant)


def _body_truths(plant: Plant, static: FloatArray) -> Numbers:
    poles, residues = plant.modal()
    found: Numbers = {}
    swinging = [index for index in np.argsort(np.abs(poles)) if poles[index].imag > 1.0]
    for place, index in enumerate(swinging):
        found[f"frequency_hz[{place}]"] = abs(poles[index]) / (2.0 * np.pi)
        found[f"damping_ratio[{place}]"] = -poles[index].real / abs(poles[index])
        for row, column in np.ndindex(6, 6):
            sort = "residue" if row == column else "residue_cross"
            found[f"{sort}[{place} re {row} {column}]"] = residues[index][row, column].real
            found[f"{sort}[{place} im {row} {column}]"] = residues[index][row, column].imag
    for row, column in np.ndindex(6, 6):
        found[f"{'static_gain' if row == column else 'static_cross_talk'}[{row} {column}]"] = float(static[row, column])
    return found


LINES_HZ = (50.0, 300.0, 700.0, 1000.0, 1500.0, 2200.0)
"""Cross-talk behind the filter is compared at the stated lines nearest to these."""


def _keep(folder: Path, plant: Plant) -> Numbers:
    """Keep the true plant for `read_body`, which leads it through the filter that the command designs."""
    np.savez(folder / "true.npz", a=plant.a, b=plant.b, c=plant.c)
    return {
        f"filtered{'' if row == column else '_cross_talk'}[{hz} {row} {column}]": 0.0
        for hz in LINES_HZ
        for row, column in np.ndindex(6, 6)
    }


def read_body(results: Path) -> Readings:
    """Return the model by ascending frequency, and errors of the stated loads behind the filter."""
    rows = rows_of(results / "model.csv")
    frequency = {row["number"]: number(row["value"]) for row in rows if row["quantity"] == "frequency_hz"}
    if len(frequency) != 6:
        return {}
    place = {mode: index for index, mode in enumerate(sorted(frequency, key=lambda one: frequency[one]))}
    found: Readings = {}
    for row in rows:
        both = number(row["value"]), number(row["U"])
        quantity = row["quantity"]
        if quantity in {"frequency_hz", "damping_ratio"}:
            found[f"{quantity}[{place[row['number']]}]"] = both
        elif quantity in {"residue_re", "residue_im", "static_gain"}:
            at = COMPONENTS.index(row["channel"]), COMPONENTS.index(row["component"])
            if quantity == "static_gain":
                found[f"{'static_gain' if at[0] == at[1] else 'static_cross_talk'}[{at[0]} {at[1]}]"] = both
            else:
                sort = "residue" if at[0] == at[1] else "residue_cross"
                found[f"{sort}[{place[row['number']]} {quantity[-2:]} {at[0]} {at[1]}]"] = both
    return found | _filtered(results)


def _filtered(results: Path) -> Readings:
    """Return the real part of stated less true load behind the filter, with the U of its size."""
    true = np.load(results.parent / "true.npz")
    plant = Plant(true["a"], true["b"], true["c"])
    rows = [r for r in rows_of(results / "crosstalk.csv") if (r["stage"], r["quantity"]) == ("filtered", "response")]
    if not rows:
        return {}
    stated_hz = np.unique([number(row["frequency_hz"]) for row in rows])
    found: Readings = {}
    for hz in LINES_HZ:
        near = float(stated_hz[np.argmin(np.abs(stated_hz - hz))])
        loads = _filter_response(results / "decoupling.json", near) @ plant.response(np.array([near]))[0]
        for row in rows:
            if number(row["frequency_hz"]) == near:
                at = COMPONENTS.index(row["reading"]), COMPONENTS.index(row["load"])
                name = f"filtered{'' if at[0] == at[1] else '_cross_talk'}[{hz} {at[0]} {at[1]}]"
                stated = number(row["magnitude"]) * np.exp(1j * number(row["phase_rad"]))
                found[name] = float((stated - loads[at]).real), number(row["U"])
    return found


def _filter_response(path: Path, frequency_hz: float) -> ComplexArray:
    """Return the response of the recursion that decoupling.json states, loads over outputs."""
    stated = json.loads(path.read_text(encoding="utf-8"))

    def pairs(name: str) -> ComplexArray:
        both = np.asarray(stated[name], dtype=np.float64)
        return np.asarray(both[..., 0] + 1j * both[..., 1])

    z = np.exp(2j * np.pi * frequency_hz / float(stated["sample_rate_hz"]))
    poles, driven, shown = pairs("poles"), pairs("driven"), pairs("shown")
    total = sum(np.asarray(tap) * z**-delay for delay, tap in enumerate(stated["taps"]))
    late = z ** -int(stated["delay_samples"])
    for one in ((poles, driven, shown), (poles.conj(), driven.conj(), shown.conj())):
        total = total + 0.5 * late * (one[2] / (z - one[0])) @ one[1]
    return np.asarray(total)


# `load`: a sensor with loads, k and c below its moving mass, k_L and c_L between it and the load.


@dataclass(frozen=True)
class LoadPlan:
    """Masses on a sensor: `coupled` stand on a spring of their own, others are rigid parts of the moving mass."""

    coupled: bool = True
    shape: str = "ramp"
    masses: tuple[float, ...] = (0.0, 0.008, 0.048, 0.098, 0.198)
    level: float = 0.01
    softening: float = 0.0
    friction: float = 0.0
    loss_factor: float = 0.0
    rate_hz: float = 20e3
    samples: int = 8000
    corner_hz: float = 0.0
    stated_u: float = 5e-5


def _with_load(k: float, c: float, kl: float, cl: float, moving: float, load: float) -> Plant:
    """Return the output 0.4·k·x of the moving mass over a force on what is mounted (V/N)."""
    if load == 0.0 or kl == 0.0:
        return mechanical(np.array([[moving + load]]), np.array([[c]]), np.array([[k]]), np.array([[0.4 * k]]))
    plant = mechanical(
        np.diag([moving, load]),
        np.array([[c + cl, -cl], [-cl, cl]]),
        np.array([[k + kl, -kl], [-kl, kl]]),
        np.array([[0.4 * k, 0.0]]),
    )
    return Plant(plant.a, plant.b[:, 1:], plant.c)


def build_load(plan: LoadPlan, folder: Path, rng: np.random.Generator) -> Numbers:
    """Write a release of 10 N per load, and return stiffnesses, dampings, resonances and limits."""
    k, c = 2.36e6 * rng.uniform(0.9, 1.1), 6.0 * rng.uniform(0.8, 1.2)
    kl, cl = (1.89e6 * rng.uniform(0.9, 1.1), 4.0 * rng.uniform(0.8, 1.2)) if plan.coupled else (0.0, 0.0)
    moving = 0.24 + plan.stated_u * rng.standard_normal()
    truth = {"stiffness": k, "sensitivity": 0.4, "moving_mass": moving}
    if not plan.loss_factor:
        truth |= {"damping": c} | ({"coupling_stiffness": kl, "coupling_damping": cl} if plan.coupled else {})
        truth |= _limits(k, c, kl, cl, moving)
    for stated in plan.masses:
        load = stated + (5e-6 * rng.standard_normal() if stated else 0.0)
        if plan.loss_factor:
            c = plan.loss_factor * float(np.sqrt(k * (moving + load)))
        plant, name = _with_load(k, c, kl, cl, moving, load), f"{round(1e3 * stated):03d}g"
        poles = sorted(plant.modal()[0][plant.modal()[0].imag > 0.0], key=abs)
        truth[f"first_hz[{stated:g}]"] = abs(poles[0]) / (2.0 * np.pi)
        truth[f"damping_first[{stated:g}]"] = -poles[0].real / abs(poles[0])
        if len(poles) > 1:
            truth[f"second_hz[{stated:g}]"] = abs(poles[1]) / (2.0 * np.pi)
        found = frequency_truths(plant, 5e3)
        truth |= {f"{band}[{stated:g}]": found[band] for band in ("band_5_hz", "band_10_hz")}
        _write_load(plan, folder, name, stated, rng, plant)
    return truth


def _limits(k: float, c: float, kl: float, cl: float, moving: float) -> Numbers:
    """Return the load that lowers the resonance by 5 %, and that which two masses get wrong by 5 %."""

    def first_hz(load: float) -> float:
        poles = _with_load(k, c, kl, cl, moving, load).modal()[0]
        return float(np.min(np.abs(poles[poles.imag > 0.0]))) / (2.0 * np.pi)

    def formula_excess(load: float) -> float:
        return float(np.sqrt(k / (moving + load))) / (2.0 * np.pi) / first_hz(load) - 1.05

    change = float(brentq(lambda load: first_hz(load) - 0.95 * first_hz(0.0), 1e-6, 0.5))
    return {"change_limit": change} | ({"formula_limit": float(brentq(formula_excess, 1e-4, 1.0))} if kl else {})


def _write_load(plan: LoadPlan, folder: Path, name: str, stated: float, rng: np.random.Generator, plant: Plant) -> None:
    sensor = {
        "name": "force sensor",
        "channels": ["Fy"],
        "unit": "V",
        "sense": "on_sensor",
        "static_sensitivity": [[0.0, 0.4, 0.0, 0.0, 0.0, 0.0]],
        "internal_mass": 0.24,
        "internal_mass_uncertainty": plan.stated_u,
    }
    rig: dict[str, Any] = {"name": f"load {name}", "sensor": sensor}
    if stated:
        rig["load"] = {
            "mass": stated,
            "mass_uncertainty": 5e-6,
            "centre_of_mass": [0.0, 0.0, 0.0],
            "inertia": np.zeros((3, 3)),
        }
    write_toml(folder / f"rig-{name}.toml", rig)
    times_s = np.arange(plan.samples) / plan.rate_hz - 0.02 - rng.uniform() / plan.rate_hz
    time_s = float(rng.uniform(0.2e-3, 0.4e-3))
    if plan.softening or plan.friction:
        pole = plant.modal()[0][0]
        spring = Spring(abs(pole) / (2 * np.pi), -pole.real / abs(pole), plan.softening, plan.friction)
        values = 4.0 * ring(spring, time_s, 1e5, times_s)
    else:
        values = 4.0 + respond(plant, np.array([-10.0]), release(plan.shape, time_s), times_s)[0][0]
    values = values + 4.0 * plan.level * noise("white", plan.samples, plan.rate_hz, rng)
    manifest = step_manifest(f"release with {name}", "Fy", -10.0, [output("Fy")])
    write_toml(folder / f"step-{name}" / "recording.toml", manifest | {"rig": f"../rig-{name}.toml"})
    write_channels(folder / f"step-{name}" / "outputs.h5", plan.rate_hz, {"Fy": values})


def read_load(results: Path) -> Readings:
    """Return parameters and, of every recorded load, resonances, damping ratio and bands of the first solution."""
    found: Readings = {}
    for row in rows_of(results / "parameters.csv"):
        if row["solution"] == "1" and not row["name"].startswith("error"):
            found[row["name"].split(":")[0]] = number(row["value"]), number(row["U"])
    for row in rows_of(results / "load.csv"):
        if row["solution"] == "1" and row["kind"] == "recorded":
            at = f"[{number(row['load_mass']):g}]"
            for name in ("first_hz", "second_hz", "band_5_hz", "band_10_hz"):
                found[f"{name}{at}"] = number(row[name]), number(row[f"U_{name}"])
            found[f"damping_first{at}"] = (
                number(row["damping_first"]),
                number(row["k"]) * number(row["u_damping_first"]),
            )
    return found


def _step(name: str, about: str, plan: StepPlan, **more: Any) -> Case:
    return Case(name, about, ("step",), lambda folder, rng: build_step(plan, folder, rng), read_step, **more)


def _body(name: str, about: str, plan: BodyPlan, **more: Any) -> Case:
    return Case(name, about, ("decouple",), lambda folder, rng: build_body(plan, folder, rng), read_body, **more)


def _load(name: str, about: str, plan: LoadPlan, **more: Any) -> Case:
    return Case(name, about, ("load",), lambda folder, rng: build_load(plan, folder, rng), read_load, **more)


STEP, BODY, LOAD = StepPlan(), BodyPlan(), LoadPlan()
TWO_MODES: Modes = ((1700.0, 0.015, 0.8), (3100.0, 0.012, 0.2))
SLOW = replace(STEP, rate_hz=25e3, samples=9000, rest_s=0.06)
RIGID = replace(LOAD, coupled=False)
CASES: tuple[Case, ...] = (
    _step("ramp", "three ramps of 0.2 to 0.35 ms, white noise 40 dB", STEP, within=True),
    _step("cosine", "three half cosines", replace(STEP, shapes=("cosine",)), within=True),
    _step("one_release", "one ramp", replace(STEP, releases=1), within=True),
    _step("two_releases", "two ramps", replace(STEP, releases=2), within=True),
    _step("eight_releases", "eight ramps", replace(STEP, releases=8), within=True),
    _step("filtered_noise", "noise behind a low-pass of 8 kHz", replace(STEP, noise="filtered"), within=True),
    _step("two_modes", "a second mode of 20 %", replace(STEP, figures=TWO_MODES), within=True),
    _step(
        "measured_force", "two stages, load measured", replace(STEP, shapes=("two stages",), measured=True), within=True
    ),
    _step("filter_stated", "anti-aliasing filter of 10 kHz, stated", replace(STEP, filter_hz=10e3, filter_stated=True)),
    _step("filter_unstated", "anti-aliasing filter of 10 kHz, not stated", replace(STEP, filter_hz=10e3)),
    _step(
        "exponential_50us",
        "exponential, time constant 50 µs",
        replace(STEP, shapes=("exponential",), time_s=(45e-6, 55e-6)),
    ),
    _step("exponential_100us", "exponential, 100 µs", replace(STEP, shapes=("exponential",), time_s=(90e-6, 110e-6))),
    _step(
        "two_stages_240us", "two strands in 0.24 ms", replace(STEP, shapes=("two stages",), time_s=(0.23e-3, 0.25e-3))
    ),
    _step(
        "two_stages_450us", "two strands in 0.45 ms", replace(STEP, shapes=("two stages",), time_s=(0.43e-3, 0.47e-3))
    ),
    _step("pink_noise", "1/f noise 40 dB", replace(STEP, noise="pink")),
    _step("mains_hum", "50, 150, 250 Hz of 1 %", replace(SLOW, hum=0.01, level=0.003)),
    _step("twelve_bit", "12 bits over ±5 V, quiet", replace(STEP, bits=12, level=0.0007)),
    _step("growing_mode", "one of three records with a growing 2310 Hz", replace(STEP, growing=True)),
    _step(
        "bench_60hz", "a bench mode of 60 Hz, 2 %", replace(SLOW, figures=((1700.0, 0.015, 0.98), (60.0, 0.03, 0.02)))
    ),
    _step(
        "bench_60hz_damped",
        "the same, damping ratio 0.3",
        replace(SLOW, figures=((1700.0, 0.015, 0.98), (60.0, 0.3, 0.02))),
    ),
    _step(
        "bench_near",
        "a bench mode of 0.9 % at 1360 Hz",
        replace(STEP, figures=((1700.0, 0.015, 0.991), (1360.0, 0.02, 0.009))),
    ),
    _step("dry_friction", "friction of 2 % of the load", replace(STEP, friction=0.02)),
    _step("light_friction", "friction of 0.2 % of the load", replace(STEP, friction=0.002)),
    _step("softening", "spring 0.5 % softer at the load", replace(STEP, softening=0.005)),
    _body("body_ramp", "six components, ramps", BODY, within=True),
    _body("body_exponential", "exponential, 50 µs", replace(BODY, shape="exponential", time_s=(45e-6, 55e-6))),
    _body(
        "body_quiet_exponential",
        "exponential, 80 dB",
        replace(BODY, shape="exponential", time_s=(45e-6, 55e-6), level=1e-4),
    ),
    _body("body_quiet", "ramps, 80 dB", replace(BODY, level=1e-4)),
    _body("body_hum", "mains hum of 1 %", replace(BODY, hum=0.01, level=0.003)),
    _body("body_twelve_bit", "12 bits over ±5 V, quiet", replace(BODY, bits=12, level=0.0007)),
    _load("load_coupled", "five loads on a spring of their own", LOAD, within=True),
    _load("load_rigid", "five rigid loads", RIGID, within=True),
    _load("load_softening", "springs 0.5 % softer at the load", replace(RIGID, softening=0.005)),
    _load("load_friction", "friction of 2 % of the load", replace(RIGID, friction=0.02)),
    _load("load_light_friction", "friction of 0.1 % of the load", replace(RIGID, friction=0.001)),
    _load("load_loss_factor", "constant loss factor 0.8 %", replace(RIGID, loss_factor=0.008)),
)
