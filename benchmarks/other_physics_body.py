"""Six-component sensors of `other_physics.py`: releases for `decouple`, with their truths.

A rigid body on six springs, whose strains every output reads, behind one amplifier each.
"""

from __future__ import annotations

import json
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from other_physics_files import Case, FloatArray, Numbers, Readings, number, rows_of, write_channels, write_toml
from other_physics_release import output, step_manifest
from other_physics_sensor import (
    ComplexArray,
    Plant,
    converted,
    hum,
    lag,
    mechanical,
    noise,
    release,
    respond,
)

COMPONENTS = ("Fx", "Fy", "Fz", "Mx", "My", "Mz")


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


def _places(results: Path, stated: dict[str, float]) -> dict[str, int]:
    """Return which true mode, ascending, each stated one within 3 % is; further stated ones have no place."""
    true = np.load(results.parent / "true.npz")
    poles = np.linalg.eigvals(true["a"])
    exact_hz = np.sort(np.abs(poles[poles.imag > 1.0])) / (2.0 * np.pi)
    places = {}
    for place, hz in enumerate(exact_hz):
        near = min(stated, key=lambda mode: abs(stated[mode] - hz), default=None)
        if near is not None and abs(stated[near] / hz - 1.0) < 0.03:
            places[near] = place
    return places


def read_body(results: Path) -> Readings:
    """Return the model by ascending frequency, and errors of the stated loads behind the filter."""
    rows = rows_of(results / "model.csv")
    place = _places(results, {r["number"]: number(r["value"]) for r in rows if r["quantity"] == "frequency_hz"})
    found: Readings = {}
    for row in rows:
        both = number(row["value"]), number(row["U"])
        quantity = row["quantity"]
        if quantity in {"frequency_hz", "damping_ratio", "residue_re", "residue_im"} and row["number"] not in place:
            continue
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


def _body(name: str, about: str, plan: BodyPlan, **more: Any) -> Case:
    return Case(name, about, ("decouple",), partial(build_body, plan), read_body, **more)


BODY = BodyPlan()
CASES: tuple[Case, ...] = (
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
)
