"""Shaken bases of `other_physics.py`: campaigns for `identify` and `transfer`, with their truths.

A load of mass m + m_i stands on a spring whose base moves. Periodic motions are solved line by line, those of a
spring that is not linear by iterating the force of the cubic term over the lines until it agrees with the motion.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import h5py
import numpy as np
from other_physics_files import Case, FloatArray, Numbers, Readings, number, rows_of, write_channels, write_toml
from other_physics_sensor import ComplexArray
from scipy.optimize import brentq
from scipy.stats import t as student

RATE_HZ, PERIOD_S, PERIODS = 8192.0, 0.5, 5
BAND_HZ = (150.0, 2800.0)
LINES = 25
"""Lines of a curve that are compared, evenly over the band."""


@dataclass(frozen=True)
class ShakenPlan:
    """What is recorded: load masses, the joint below, the damping, filters that nobody states, how it is driven."""

    masses: tuple[float, ...] = (4.236, 6.5, 8.798)
    loss_factor: float = 0.0
    mount: float = 0.0
    lag_hz: float = 0.0
    second_order_hz: float = 0.0
    softening: float = 0.0
    noise: float = 0.02
    sweeps: tuple[float, ...] = ()


@dataclass(frozen=True)
class Spring:
    """Stiffness, damping and masses of one draw."""

    stiffness: float
    damping: float
    internal: float
    loss_factor: float

    def dynamic(self, w: FloatArray) -> ComplexArray:
        """Return the complex stiffness at angular frequencies."""
        return np.asarray(self.stiffness * (1.0 + 1j * self.loss_factor) + 1j * w * self.damping)

    def ratio(self, frequency_hz: FloatArray, mass: float, mount: float) -> ComplexArray:
        """Return motion of the load over that which the base's accelerometer sees, below a mount where there is one."""
        w = 2.0 * np.pi * np.asarray(frequency_hz)
        below, above = self.dynamic(w), -(mass + self.internal) * w**2
        if not mount:
            return np.asarray(below / (below + above))
        joint = mount * self.stiffness * (1.0 + 1j * w * 2e-6)
        body = np.asarray([-1.5 * w**2 + joint + below, -below, -below, below + above])
        return np.asarray(-body[2] * joint / (body[0] * body[3] - body[1] * body[2]))


def _drawn(plan: ShakenPlan, rng: np.random.Generator) -> Spring:
    stiffness = 4.5e8 * rng.uniform(0.9, 1.1)
    damping = 0.0 if plan.loss_factor else 900.0 * rng.uniform(0.8, 1.2)
    return Spring(stiffness, damping, 0.769 + 0.002 * rng.standard_normal(), plan.loss_factor)


def _unstated(plan: ShakenPlan, frequency_hz: FloatArray) -> ComplexArray:
    """Return what the chain of the load's accelerometer does and no manifest says."""
    factor = np.ones(len(frequency_hz), complex)
    if plan.lag_hz:
        factor = factor / (1.0 + 1j * frequency_hz / plan.lag_hz)
    if plan.second_order_hz:
        r = frequency_hz / plan.second_order_hz
        factor = factor / (1.0 - r**2 + 2j * 0.02 * r)
    return factor


def _softened(spring: Spring, mass: float, base: ComplexArray, frequency_hz: FloatArray, share: float) -> ComplexArray:
    """Return the load's acceleration by harmonic balance: k (1 − share·(z/z₀)²) z, z₀ the largest linear z."""
    count, wide = 2 * (len(base) - 1), 4
    w = 2.0 * np.pi * frequency_hz
    total = mass + spring.internal
    linear = spring.dynamic(w) - total * w**2
    drive = -total * base
    longer = np.zeros(wide * (len(base) - 1) + 1, complex)

    def in_time(lines: ComplexArray) -> FloatArray:
        longer[: len(lines)] = lines * wide
        return np.fft.irfft(longer, wide * count)

    z = drive / linear
    largest = float(np.max(np.abs(in_time(z))))
    for _ in range(400):
        course = in_time(z)
        cubic = np.fft.rfft(course**3)[: len(base)] / wide * spring.stiffness * share / largest**2
        after = (drive + cubic) / linear
        change = float(np.max(np.abs(after - z)) / np.max(np.abs(z)))
        z = 0.5 * (z + after)
        if change < 1e-10:
            return np.asarray(base - w**2 * z)
    raise ArithmeticError("the motion on a softening spring does not settle")


def _periodic_base(rng: np.random.Generator) -> tuple[FloatArray, ComplexArray]:
    """Return the lines of one period and the base's acceleration there: a chirp of 10 m/s² r.m.s."""
    count = round(RATE_HZ * PERIOD_S)
    frequency_hz = np.asarray(np.fft.rfftfreq(count, 1.0 / RATE_HZ))
    inside = (frequency_hz >= BAND_HZ[0]) & (frequency_hz <= BAND_HZ[1])
    place = np.cumsum(inside) / np.count_nonzero(inside)
    phase = -np.pi * np.count_nonzero(inside) * place**2 + rng.uniform(0.0, 2.0 * np.pi)
    size = 10.0 * count / np.sqrt(2.0 * np.count_nonzero(inside))
    return frequency_hz, np.asarray(np.where(inside, size * np.exp(1j * phase), 0.0))


def _sweep_base(level: float) -> tuple[FloatArray, ComplexArray, int]:
    """Return lines of a padded record, the acceleration there, and samples: one sweep from rest to rest."""
    count, padded = round(1.2 * RATE_HZ), 32_768
    time_s = np.arange(padded) / RATE_HZ - 0.1
    rate = (BAND_HZ[1] * 1.05 - BAND_HZ[0] * 0.7) / 0.9
    phase = 2.0 * np.pi * (BAND_HZ[0] * 0.7 * time_s + 0.5 * rate * time_s**2)
    edge = np.clip(np.minimum(time_s, 0.9 - time_s) / 0.05, 0.0, 1.0)
    course = level * 14.0 * np.sin(phase) * np.sin(0.5 * np.pi * edge) ** 2
    return np.asarray(np.fft.rfftfreq(padded, 1.0 / RATE_HZ)), np.asarray(np.fft.rfft(course)), count


def _record(
    plan: ShakenPlan, spring: Spring, mass: float, level: float, errors: FloatArray, rng: np.random.Generator
) -> dict[str, FloatArray]:
    """Return both accelerations of one record as the channels give them, with errors of scale and delay."""
    if plan.sweeps:
        frequency_hz, base, count = _sweep_base(level)
    else:
        frequency_hz, base = _periodic_base(rng)
        count = PERIODS * 2 * (len(base) - 1)
    if plan.softening:
        top = _softened(spring, mass, base, frequency_hz, plan.softening)
    else:
        top = base * spring.ratio(frequency_hz, mass, plan.mount)
    top = top * _unstated(plan, frequency_hz)
    channels = {}
    for index, (name, lines) in enumerate((("base", base), ("top", top))):
        late = lines * np.exp(-2j * np.pi * frequency_hz * errors[index, 1]) / (1.0 + errors[index, 0])
        course = np.fft.irfft(late)
        samples = course[:count] if plan.sweeps else np.tile(course, PERIODS)
        channels[name] = samples + plan.noise * rng.standard_normal(count)
    return channels


def _manifest(plan: ShakenPlan, name: str, rig: str) -> dict[str, Any]:
    """Return the recording.toml of a base and a load acceleration."""
    channels = [
        {
            "name": channel,
            "quantity": "acceleration",
            "body": body,
            "point": [0.0, 0.0, height],
            "direction": [0.0, 0.0, 1.0],
            "scale_uncertainty": 2e-3,
            "delay_uncertainty": 2e-7,
        }
        for channel, body, height in (("base", "base", -0.05), ("top", "load", 0.05))
    ]
    excitation: dict[str, Any] = {
        "kind": "chirp",
        "direction": [0.0, 0.0, 1.0],
        "band": list(BAND_HZ),
        "reference": ["base"],
        "response": ["top"],
    }
    if not plan.sweeps:
        excitation |= {"period": PERIOD_S}
    return {
        "name": name,
        "rig": f"../{rig}",
        "excitation": excitation,
        "daq": [{"name": "daq", "file": "accelerometers.h5", "channel": channels}],
    }


def _transducer_errors(rng: np.random.Generator) -> FloatArray:
    """Return errors of scale and delay of both accelerometers, the same in all recordings."""
    return np.asarray(rng.standard_normal((2, 2)) * np.array([2e-3, 2e-7]))


def build_masses(plan: ShakenPlan, folder: Path, rng: np.random.Generator) -> Numbers:
    """Write one chirp per load mass, and return stiffness, damping, internal mass and resonances."""
    spring, errors = _drawn(plan, rng), _transducer_errors(rng)
    truth: Numbers = {"stiffness_z": spring.stiffness, "internal_mass": spring.internal}
    if not plan.loss_factor:
        truth |= {"damping_z": spring.damping, "lag_z": spring.damping / spring.stiffness}
    for stated in plan.masses:
        mass = stated + 3e-4 * rng.standard_normal()
        name = f"load {stated} kg"
        sensor = {
            "name": "force sensor",
            "channels": ["Fz"],
            "unit": "V/V",
            "sense": "on_load",
            "static_sensitivity": [[0.0, 0.0, 2e-7, 0.0, 0.0, 0.0]],
            "internal_mass": 0.769,
            "internal_mass_uncertainty": 0.002,
        }
        load = {
            "mass": stated,
            "mass_uncertainty": 3e-4,
            "centre_of_mass": [0.0, 0.0, 0.0],
            "inertia": np.diag([0.0055, 0.0055, 0.0058]),
        }
        write_toml(folder / f"rig-{stated}.toml", {"name": name, "sensor": sensor, "load": load})
        place = folder / f"chirp-{stated}"
        write_toml(place / "recording.toml", _manifest(plan, name, f"rig-{stated}.toml"))
        write_channels(place / "accelerometers.h5", RATE_HZ, _record(plan, spring, mass, 1.0, errors, rng))
        if not plan.mount:
            truth |= {f"{key}[{name}]": value for key, value in _oscillator(spring, mass).items()}
            truth[f"usable_band[{stated:g}]"] = _usable_hz(spring, stated)
    return truth


def _oscillator(spring: Spring, mass: float) -> Numbers:
    w = float(np.sqrt(spring.stiffness / (mass + spring.internal)))
    ratio = 0.5 * spring.loss_factor + 0.5 * spring.damping * w / spring.stiffness
    return {"frequency": w / (2.0 * np.pi), "damping_ratio": ratio}


def _usable_hz(spring: Spring, mass: float) -> float:
    """Return up to where the deflection by a force on the load stays within 5 % of that at rest."""

    def excess(frequency_hz: float) -> float:
        w = 2.0 * np.pi * frequency_hz
        whole = spring.dynamic(np.array([w]))[0] - (mass + spring.internal) * w**2
        return abs(complex(spring.dynamic(np.zeros(1))[0]) / complex(whole)) - 1.05

    return float(brentq(excess, 1.0, 0.9 * _oscillator(spring, mass)["frequency"]))


def build_transfer(plan: ShakenPlan, folder: Path, rng: np.random.Generator) -> Numbers:
    """Write the recordings of one load, and return resonance, damping ratio and lines of the curve."""
    spring, errors = _drawn(plan, rng), _transducer_errors(rng)
    mass = plan.masses[0]
    write_toml(folder / "rig.toml", {"name": "load on a spring"})
    place, levels = folder / "chirp", plan.sweeps or (1.0,)
    manifest = _manifest(plan, place.name, "rig.toml")
    manifest["daq"][0]["file"] = "record-1.h5"
    if len(levels) > 1:
        manifest["daq"][0]["repeats"] = "record-*.h5"
    write_toml(place / "recording.toml", manifest)
    for index, level in enumerate(levels):
        write_channels(place / f"record-{index + 1}.h5", RATE_HZ, _record(plan, spring, mass, level, errors, rng))
    grid = np.linspace(BAND_HZ[0] * 1.1, BAND_HZ[1] * 0.95, LINES)
    figures = np.array([spring.stiffness, spring.damping, spring.internal, spring.loss_factor])
    np.savez(folder / "true.npz", grid=grid, spring=figures, mass=np.array(mass))
    truth = _oscillator(spring, mass)
    if plan.softening:
        return truth
    return truth | {f"{sort}[{line}]": 0.0 for sort in ("magnitude", "phase") for line in range(LINES)}


def read_masses(results: Path) -> Readings:
    """Return the parameters of the joint fit by their names."""
    found: Readings = {}
    for row in rows_of(results / "parameters.csv"):
        name, _, of = row["name"].partition(": ")
        if ", mode " in of:
            of, _, mode = of.rpartition(", mode ")
            if mode != "1":
                continue
        key = f"{name}[{of.removeprefix('load ') if name == 'usable_band' else of}]" if of else name
        found[key] = number(row["value"]), number(row["U"])
    return found


def read_transfer(results: Path) -> Readings:
    """Return the resonance (k = 2), and relative errors and errors of phase of lines of the curve."""
    tables, files = sorted(results.rglob("transfer.csv")), sorted(results.rglob("transfer.h5"))
    if not tables:
        return {}
    found: Readings = {}
    with h5py.File(files[0]) as file:
        groups = [group["resonances"] for group in file["references"].values() if "resonances" in group]
        peaks = [peak for group in groups for peak in group.values()]
        for peak in peaks[:1]:
            fit = peak["fit"].attrs
            found["frequency"] = float(fit["frequency_hz"]), 2.0 * float(peak.attrs["u_frequency_hz"])
            found["damping_ratio"] = float(fit["damping_ratio"]), 2.0 * float(peak.attrs["u_damping_ratio"])
    true = np.load(results.parent / "true.npz")
    spring = Spring(*true["spring"])
    rows = rows_of(tables[0])
    lines_hz = np.array([number(row["frequency_hz"]) for row in rows])
    for line, hz in enumerate(true["grid"]):
        row = rows[int(np.argmin(np.abs(lines_hz - hz)))]
        exact = complex(spring.ratio(np.array([number(row["frequency_hz"])]), float(true["mass"]), 0.0)[0])
        k = float(student.ppf(0.975, number(row["dof"])))
        turn = np.angle(np.exp(1j * (number(row["phase_rad"]) - np.angle(exact))))
        found[f"magnitude[{line}]"] = (
            number(row["magnitude"]) / abs(exact) - 1.0,
            k * number(row["u_magnitude"]) / abs(exact),
        )
        found[f"phase[{line}]"] = float(turn), k * number(row["u_phase_rad"])
    return found


def _case(build: Callable[..., Numbers], command: str, read: Callable[[Path], Readings]) -> Callable[..., Case]:
    def case(name: str, about: str, plan: ShakenPlan, **more: Any) -> Case:
        return Case(name, about, (command,), lambda folder, rng: build(plan, folder, rng), read, **more)

    return case


BASE = ShakenPlan()
SWEEP = replace(BASE, sweeps=(1.0, 1.0, 1.0, 1.0))
_masses = _case(build_masses, "identify", read_masses)
_transfer = _case(build_transfer, "transfer", read_transfer)
CASES: tuple[Case, ...] = (
    _masses("masses", "three loads, chirps", BASE, within=True),
    _masses("masses_mount", "a mount of 10 k below the base's accelerometer", replace(BASE, mount=10.0)),
    _masses("masses_lag", "a lag of 20 kHz on one channel, not stated", replace(BASE, lag_hz=20e3)),
    _masses(
        "masses_accelerometer",
        "an accelerometer's resonance of 30 kHz, not stated",
        replace(BASE, second_order_hz=30e3),
    ),
    _masses("masses_loss_factor", "loss factor 1.6 %", replace(BASE, loss_factor=0.016)),
    _masses("masses_softening", "spring 0.5 % softer at the largest motion", replace(BASE, softening=0.005)),
    _transfer("transfer", "periodic chirp", BASE, within=True),
    _transfer("transfer_lag", "a lag of 20 kHz on one channel, not stated", replace(BASE, lag_hz=20e3)),
    _transfer(
        "transfer_accelerometer",
        "an accelerometer's resonance of 30 kHz, not stated",
        replace(BASE, second_order_hz=30e3),
    ),
    _transfer("transfer_loss_factor", "loss factor 1.6 %", replace(BASE, loss_factor=0.016)),
    _transfer("transfer_softening", "spring 0.5 % softer at the largest motion", replace(BASE, softening=0.005)),
    _transfer("sweep_once", "one sweep from rest to rest", replace(SWEEP, sweeps=(1.0,)), within=True),
    _transfer("sweeps", "four sweeps from rest to rest, a file each", SWEEP, within=True),
    _transfer(
        "sweeps_levels", "the same at levels 0.5, 1, 1, 2", replace(SWEEP, sweeps=(0.5, 1.0, 1.0, 2.0)), within=True
    ),
)
