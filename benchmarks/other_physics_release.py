"""Releases of `other_physics.py`: campaigns for `step` and `compensate`, with their truths."""

from __future__ import annotations

import json
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from other_physics_files import Case, FloatArray, Numbers, Readings, number, rows_of, write_channels, write_toml
from other_physics_sensor import (
    Filtered,
    Plant,
    Spring,
    butterworth,
    converted,
    frequency_truths,
    hum,
    lag,
    modes,
    noise,
    release,
    respond,
    rest_of,
    ring,
    step_truths,
)

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
    chain_stated: bool = False
    ropes: tuple[tuple[str, float], ...] = ()
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
    truth["static_gain"] *= rest_of(plan.softening)  # of this load, as a calibration finds it
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
        shape, time_s = plan.shapes[index % len(plan.shapes)], float(rng.uniform(*plan.time_s))
        if plan.ropes:
            shape, middle_s = plan.ropes[index % len(plan.ropes)]
            time_s = middle_s * rng.uniform(0.9, 1.1)
            manifest["excitation"]["release"] = f"rope {index % len(plan.ropes) + 1}"
        channels = _recorded_step(plan, plant, figures, release(shape, time_s), rng)
        if plan.growing and index == 1:
            course_s = np.arange(plan.samples) / plan.rate_hz
            channels["Fz"] += 0.3 * np.exp((course_s - course_s[-1]) / 0.03) * np.sin(2.0 * np.pi * 2310.0 * course_s)
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
        elements = []
        if plan.chain_stated:
            elements.append({"name": "amplifier", "filter": "butterworth", "order": 1, "corner": 6e3})
        if plan.filter_stated:
            elements.append({"name": "filter", "filter": "butterworth", "order": 4, "corner": plan.filter_hz})
        if elements:
            manifest["daq"][0]["channel"][0]["response"] = "chain.toml"
            write_toml(place / "chain.toml", {"element": elements})
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


# `compensate`: the filter that follows from those releases, on the true sensor.

AFTER = ("static_gain", "band_10_hz", "band_5_hz", "half_power_hz", "quadrature_hz", "peak_gain", "overshoot", "rise_s")


def build_compensation(plan: StepPlan, folder: Path, rng: np.random.Generator) -> Numbers:
    """Write releases and keep the true sensor for `read_compensation`."""
    state = rng.bit_generator.state
    plant, _ = plan.plant(rng)
    rng.bit_generator.state = state
    np.savez(folder / "true.npz", a=plant.a, b=plant.b, c=plant.c)
    return build_step(plan, folder, rng) | {f"after_{name}": 0.0 for name in AFTER}


def read_compensation(results: Path) -> Readings:
    """Return the figures before the filter, and stated less true ones behind it."""
    rows = {row["name"]: row for row in rows_of(results / "compensate.csv")}
    path = results / "compensation.json"
    if not path.is_file():
        return {}
    stated = json.loads(path.read_text(encoding="utf-8"))["filters"][0]["continuous"]
    true = np.load(results.parent / "true.npz")
    zeros, poles = (np.array([complex(*one) for one in stated[name]]) for name in ("zeros", "poles"))
    filtered = Filtered(Plant(true["a"], true["b"], true["c"]), zeros, poles, float(stated["gain"]))
    exact = frequency_truths(filtered) | step_truths(filtered)
    both = {name: (number(row["value"]), number(row["U"])) for name, row in rows.items()}
    found = {name.removeprefix("before_"): pair for name, pair in both.items() if name.startswith("before_")}
    for name in AFTER:
        value, u = both.get(f"after_{name}", (np.nan, np.nan))
        found[f"after_{name}"] = value - exact[name], u
    return found


def _step(name: str, about: str, plan: StepPlan, **more: Any) -> Case:
    return Case(name, about, ("step",), partial(build_step, plan), read_step, **more)


def _compensated(name: str, about: str, plan: StepPlan, **more: Any) -> Case:
    command = ("compensate", "--frequency", "2500", "--damping", "0.55")
    build = partial(build_compensation, plan)
    return Case(name, about, command, build, read_compensation, ("step",), **more)


STEP = StepPlan()
TWO_MODES: Modes = ((1700.0, 0.015, 0.8), (3100.0, 0.012, 0.2))
SLOW = replace(STEP, rate_hz=25e3, samples=9000, rest_s=0.06)
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
    _step(
        "exponential_50us_chain",
        "the same, amplifier stated",
        replace(STEP, shapes=("exponential",), time_s=(45e-6, 55e-6), chain_stated=True),
    ),
    _step(
        "exponential_two_ropes",
        "three exponentials each of 50 µs and 150 µs",
        replace(STEP, releases=6, ropes=(("exponential", 50e-6), ("exponential", 150e-6))),
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
    _compensated("compensated_ramp", "filter from three ramps", STEP, within=True),
    _compensated(
        "compensated_exponential",
        "filter from exponentials of 50 µs",
        replace(STEP, shapes=("exponential",), time_s=(45e-6, 55e-6)),
    ),
)
