"""Loads on a sensor of `other_physics.py`: releases for `load`, with their truths.

A moving mass on k and c, loads on k_L and c_L above it or rigid parts of it.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from other_physics_files import Case, Numbers, Readings, number, rows_of, write_channels, write_toml
from other_physics_release import output, step_manifest
from other_physics_sensor import (
    Plant,
    Spring,
    frequency_truths,
    mechanical,
    noise,
    release,
    respond,
    rest_of,
    ring,
)
from scipy.optimize import brentq


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
    truth = {"stiffness": k, "sensitivity": 0.4 * rest_of(plan.softening), "moving_mass": moving}
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
        values = 4.0 * ring(spring, time_s, 0.0, times_s)
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


def _load(name: str, about: str, plan: LoadPlan, **more: Any) -> Case:
    return Case(name, about, ("load",), partial(build_load, plan), read_load, **more)


LOAD = LoadPlan()
RIGID = replace(LOAD, coupled=False)
CASES: tuple[Case, ...] = (
    _load("load_coupled", "five loads on a spring of their own", LOAD, within=True),
    _load("load_rigid", "five rigid loads", RIGID, within=True),
    _load("load_softening", "springs 0.5 % softer at the load", replace(RIGID, softening=0.005)),
    _load("load_friction", "friction of 2 % of the load", replace(RIGID, friction=0.02)),
    _load("load_light_friction", "friction of 0.1 % of the load", replace(RIGID, friction=0.001)),
    _load("load_loss_factor", "constant loss factor 0.8 %", replace(RIGID, loss_factor=0.008)),
)
