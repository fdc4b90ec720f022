"""Drives of two campaigns with known truth: a sweep along z in two mountings, and eight recordings for the matrix."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from fusion.campaign.repeats import Drive
from fusion.estimation.uncertainty import Contribution, Influence, Scope, Uncertainty
from fusion.report.recorded import Recorded, SensorFacts
from fusion.report.provenance import Provenance
from shaker.arrays import Notice

ComplexArray = NDArray[np.complex128]
FloatArray = NDArray[np.float64]

LOADS = ("Fx", "Fy", "Fz", "Mx", "My", "Mz")
STATIC = np.diag([5.1e-7, 5.1e-7, 2.0e-7, 9.1e-6, 9.1e-6, 8.2e-6])
CAPACITY = np.array([2000.0, 2000.0, 4000.0, 100.0, 100.0, 100.0])
SWEEP_HZ = (53.7, 161.1, 375.9, 590.7, 805.5, 1020.3)
MATRIX_HZ = (80.0, 170.0)
RESONANCE_HZ = 2600.0
U_SCALE, U_MASS, U_AMPLIFIER, U_CLOCK_S, U_MOUNTING = 2.5e-4, 1.4e-4, 2e-4, 1e-7, 3e-4
NOISE = 3e-5
SENSOR = SensorFacts("six-component transducer", "0815", LOADS, "V/V", "on_load", CAPACITY, STATIC, 1e-4)


@dataclass(frozen=True)
class Errors:
    """The errors of one campaign, in standard uncertainties: by name for all unknowns."""

    rng: np.random.Generator
    drawn: dict[str, float]

    def of(self, name: str) -> float:
        """Return the error of an unknown, drawn when it is first asked for."""
        return self.drawn.setdefault(name, float(self.rng.standard_normal()))


def truth(frequency_hz: float) -> ComplexArray:
    """Return the true matrix (6, 6): static times a resonance, with cross-talk of two per cent of rated outputs."""
    signs = np.random.default_rng(42).uniform(-1.0, 1.0, (6, 6))
    cross = 0.02 * signs * (np.diag(STATIC) * CAPACITY)[:, None] / CAPACITY
    np.fill_diagonal(cross, 0.0)
    growth = 1.0 / (1.0 - (frequency_hz / RESONANCE_HZ) ** 2) * np.exp(-2j * np.pi * frequency_hz * 20e-6)
    return np.asarray((STATIC + cross) * growth)


def sweep(seed: int = 0) -> tuple[Recorded, ...]:
    """Return recordings along z: two mountings of two recordings at every frequency."""
    errors = Errors(np.random.default_rng(seed), {})
    load = np.array([2.0, 1.5j, 460.0, 0.1, 0.05j, 0.02])
    return tuple(
        _recorded(f"Fz {f:g} Hz, {mounting}{take}", mounting, (0.0, 0.0, 1.0), (f,), (load,), errors)
        for f in SWEEP_HZ
        for mounting in ("1", "2")
        for take in "ab"
    )


def eight(seed: int = 0) -> tuple[Recorded, ...]:
    """Return eight recordings whose loads are independent, at two frequencies each."""
    errors = Errors(np.random.default_rng(seed), {})
    loads = 0.05 * np.random.default_rng(7).standard_normal((8, 6)) + np.eye(8, 6)
    loads[6:] += 0.5 * np.eye(6)[:2] + 0.4 * np.eye(6)[3:5]
    found = []
    for number, share in enumerate(loads, 1):
        load = share * 0.2 * CAPACITY * np.exp(0.3j * number)
        direction = tuple(float(value) for value in share * CAPACITY)
        found.append(_recorded(f"run {number}", str(number), direction, MATRIX_HZ, (load, 0.8 * load), errors))
    return tuple(found)


def _recorded(
    name: str,
    mounting: str,
    direction: tuple[float, ...],
    frequencies: Sequence[float],
    loads: Sequence[ComplexArray],
    errors: Errors,
) -> Recorded:
    """One recording with its drives."""
    drives = tuple(
        _drive(name, mounting, direction, f, load, errors) for f, load in zip(frequencies, loads, strict=True)
    )
    return Recorded(
        folder=name.replace(" ", "-").replace(",", ""),
        name=name,
        mounting=mounting,
        rig="10 kN shaker",
        kind="sine" if len(drives) == 1 else "multisine",
        direction=direction,
        frequencies=tuple(frequencies),
        sensor=SENSOR,
        drives=drives,
        notices=(Notice("warning", "the phase drifts", "velocity"),),
        origin=Provenance({f"{name}/recording.toml": "ab" * 32}, {"spline_degree": 5}, {"shakercal": "0.1.0"}, ()),
    )


def _drive(
    name: str, mounting: str, direction: tuple[float, ...], frequency_hz: float, load: ComplexArray, errors: Errors
) -> Drive:
    """One driven line, measured with drawn errors."""
    output = truth(frequency_hz) @ load
    turn = 2j * np.pi * frequency_hz * U_CLOCK_S
    of_load: list[tuple[str, Scope, ComplexArray]] = [
        ("laser: scale", "rig", U_SCALE * load),
        ("load mass", "rig", U_MASS * load),
        ("point of the laser", "mounting", U_MOUNTING * load),
        ("clock bridge: time", "recording", turn * load),
    ]
    of_output: list[tuple[str, Scope, ComplexArray]] = [("amplifier: scale", "rig", U_AMPLIFIER * output)]
    return Drive(
        recording=name,
        mounting=mounting,
        frequency_hz=frequency_hz * (1.0 + 1e-7 * errors.rng.standard_normal()),
        nominal_hz=frequency_hz,
        direction=direction,
        load=_erring(load, of_load, name, mounting, errors),
        load_uncertainty=_uncertainty(load, of_load, "load noise"),
        outputs=_erring(output, of_output, name, mounting, errors),
        outputs_uncertainty=_uncertainty(output, of_output, "output noise"),
        channels=LOADS,
    )


def _erring(
    value: ComplexArray, causes: Sequence[tuple[str, Scope, ComplexArray]], name: str, mounting: str, errors: Errors
) -> ComplexArray:
    """A value with the errors of its causes and noise of its own."""
    place = {"rig": "", "mounting": mounting, "recording": name}
    total = value + sum(errors.of(f"{cause} {place[scope]}") * effect for cause, scope, effect in causes)
    noise = errors.rng.standard_normal((2, len(value))) * NOISE * np.max(np.abs(value))
    return np.asarray(total + noise[0] + 1j * noise[1])


def _uncertainty(value: ComplexArray, causes: Sequence[tuple[str, Scope, ComplexArray]], label: str) -> Uncertainty:
    """What is stated of the causes and the noise."""
    noise = Contribution(
        label, "A", ((NOISE * np.max(np.abs(value))) ** 2 * np.eye(2 * len(value)))[None], np.array([200.0])
    )
    influences = tuple(
        Influence(cause, cause.partition(":")[0], 1.0, "1", np.concatenate([effect.real, effect.imag])[None], scope)
        for cause, scope, effect in causes
    )
    return Uncertainty((noise,), influences)
