"""Loads and outputs of driven lines with known truth: many recordings, every systematic error drawn once.

What `fusion.campaign` gets from a laboratory, without the records: for coverage of matrix, ratios and repeats.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from fusion.campaign.excited_line import ExcitedLine
from fusion.estimation.uncertainty import Contribution, Influence, Scope, Uncertainty
from shaker.labels import LOAD_COMPONENTS
from shakercal._common.arrays import ComplexArray, FloatArray

CAPACITY = np.array([2000.0, 2000.0, 4000.0, 100.0, 100.0, 100.0])
MAIN = np.array([5.1e-7, 5.1e-7, 2.0e-7, 9.1e-6, 9.1e-6, 8.2e-6])
_LOAD_KG, _CROSS_KG = 7.73, 2.0
_U_MASS_KG, _U_CENTRE_M, _U_INERTIA_KGM2 = 1e-3, 1e-4, 1e-4
_U_MOTION, _U_TURN_RAD, _U_TIME_S = 2.5e-4, 5e-4, 0.5e-6
_U_BRIDGE, _U_CHANNEL = 1e-4, 1e-4
_MOTION_NOISE, _OUTPUT_NOISE = 1e-5, 1e-6
_BODY_M = 0.1


@dataclass(frozen=True)
class DriveSetup:
    """One recording: a load on the axis and a mass on a beam cross, shaken.

    `acceleration` (6,) of the sensor origin, `cross_m` (3,): where the mass on the cross sits; `direction`: as the
    manifest states it; `mounting` of the whole; `frequency_hz`; `step`: relative error of all outputs that nobody
    states.
    """

    recording: str
    direction: tuple[float, ...]
    acceleration: ComplexArray
    cross_m: tuple[float, float, float]
    mounting: str = "1"
    frequency_hz: float = 100.0
    step: float = 0.0


@dataclass
class DriveErrors:
    """Draws of unknowns by the name under which they are the same; all zero without systematic errors."""

    rng: np.random.Generator
    systematic: bool = True
    drawn: dict[str, float] = field(default_factory=dict)

    def of(self, name: str) -> float:
        """Return an unknown in its standard uncertainties."""
        if name not in self.drawn:
            self.drawn[name] = float(self.rng.standard_normal()) if self.systematic else 0.0
        return self.drawn[name]


def true_matrix(rng: np.random.Generator, cross_talk: float = 0.02) -> ComplexArray:
    """Return a matrix (6, 6) whose cross-talk at rated loads is anywhere within ± `cross_talk`."""
    share = rng.uniform(-cross_talk, cross_talk, (6, 6)) * np.exp(0.1j * rng.standard_normal((6, 6)))
    share[np.diag_indices(6)] = np.exp(-0.01j) * rng.uniform(0.98, 1.02, 6)
    return np.asarray(share * (MAIN * CAPACITY)[:, None] / CAPACITY)


def eight_setups(rng: np.random.Generator) -> tuple[DriveSetup, ...]:
    """Return axial, eccentric and transverse recordings that excite six independent loads."""
    places = (
        ("z", (0.0, 0.0, 0.08)), ("z", (0.15, 0.0, 0.08)), ("z", (-0.15, 0.0, 0.08)), ("z", (0.0, 0.15, 0.08)),
        ("x", (0.0, 0.0, 0.03)), ("x", (0.0, 0.15, 0.12)), ("y", (0.0, 0.0, 0.03)), ("y", (0.15, 0.0, 0.12)),
    )  # fmt: skip
    return tuple(drive_setup(rng, f"{n} {axis}", axis, place, str(n)) for n, (axis, place) in enumerate(places, 1))


def drive_setup(
    rng: np.random.Generator, recording: str, axis: str, cross_m: tuple[float, float, float], mounting: str = "1"
) -> DriveSetup:
    """Return a recording shaken along an axis, with one per cent of the motion in every other component."""
    size = 100.0 * 0.01 * np.array([1.0, 1.0, 1.0, *np.full(3, 1.0 / _BODY_M)]) * rng.uniform(0.3, 1.0, 6)
    acceleration = size * np.exp(2j * np.pi * rng.uniform(size=6))
    place = "xyz".index(axis)
    acceleration[place] = 100.0
    return DriveSetup(recording, tuple(np.eye(3)[place].tolist()), acceleration, cross_m, mounting)


def simulate_drives(
    setups: Sequence[DriveSetup], matrix: ComplexArray, errors: DriveErrors, noise: float = 1.0
) -> tuple[ExcitedLine, ...]:
    """Return what a laboratory finds for true motions: loads and outputs with their errors and what is stated of them.

    `noise` scales the noise of motions and outputs, in what is drawn and in what is stated.
    """
    return tuple(_drive(setup, matrix, errors, noise) for setup in setups)


@dataclass(frozen=True)
class _Unknown:
    """An unknown: name, label, scope, and its change of the matrix (6, 6) that takes true motions to stated loads."""

    name: str
    label: str
    u: float
    unit: str
    scope: Scope
    change: NDArray[Any]


def _drive(setup: DriveSetup, matrix: ComplexArray, errors: DriveErrors, noise: float) -> ExcitedLine:
    """One recording."""
    mass = _mass_matrix(_LOAD_KG, np.array([0.0, 0.0, 0.035]), np.diag([0.036, 0.036, 0.031]))
    mass = mass + _mass_matrix(_CROSS_KG, np.array(setup.cross_m), np.diag([2e-3, 2e-3, 3e-3]))
    unknowns = _unknowns(setup, mass)
    key = {"rig": "", "mounting": setup.mounting, "recording": setup.recording}
    drawn = [errors.of(f"{unknown.name} {key[unknown.scope]}") for unknown in unknowns]
    size = np.max(np.abs(setup.acceleration))
    sigma = noise * _MOTION_NOISE * size * np.array([1.0, 1.0, 1.0, *np.full(3, 1.0 / _BODY_M)])
    motion = setup.acceleration + sigma * _complex_normal(errors.rng, 6)
    # What is stated differs from the truth by the errors drawn, so the truth is what is stated without them.
    load = mass @ setup.acceleration
    wrong = load + sum((e * (unknown.change @ setup.acceleration) for e, unknown in zip(drawn, unknowns, strict=True)))
    found = wrong + mass @ (motion - setup.acceleration)
    jacobian = np.kron(np.eye(2), mass)
    spread = jacobian @ np.diag(np.tile(sigma**2, 2)) @ jacobian.T
    seen = np.linalg.solve(mass, found)
    influences = tuple(_influence(unknown, unknown.change @ seen) for unknown in unknowns)
    outputs, outputs_uncertainty = _outputs(setup, matrix @ load * (1.0 + setup.step), errors, noise)
    return ExcitedLine(
        recording=setup.recording,
        mounting=setup.mounting,
        frequency_hz=setup.frequency_hz,
        nominal_hz=setup.frequency_hz,
        direction=setup.direction,
        load=found,
        load_uncertainty=Uncertainty(
            (Contribution("noise of the motion", "A", spread[None], np.array([60.0])),), influences
        ),
        outputs=outputs,
        outputs_uncertainty=outputs_uncertainty,
        channels=LOAD_COMPONENTS,
    )


def _outputs(
    setup: DriveSetup, true: ComplexArray, errors: DriveErrors, noise: float
) -> tuple[ComplexArray, Uncertainty]:
    """Outputs of one amplifier with a common scale and one of each channel."""
    relative = [("bridge: scale", "output scale", _U_BRIDGE, np.full(6, _U_BRIDGE))]
    relative += [
        (f"bridge: individual scale {name}", "output individual scale", _U_CHANNEL, _U_CHANNEL * np.eye(6)[c])
        for c, name in enumerate(LOAD_COMPONENTS)
    ]
    wrong = true * (1.0 + sum((errors.of(f"{name} ") * effect for name, _, _, effect in relative), np.zeros(6)))
    sigma = noise * _OUTPUT_NOISE * MAIN * CAPACITY
    found = wrong + sigma * _complex_normal(errors.rng, 6)
    spread = Contribution("output noise", "A", np.diag(np.tile(sigma**2, 2))[None], np.array([200.0]))
    influences = tuple(
        Influence(name, label, u, "1", _stacked(effect * found)[None], "rig") for name, label, u, effect in relative
    )
    return found, Uncertainty((spread,), influences)


def _unknowns(setup: DriveSetup, mass: FloatArray) -> list[_Unknown]:
    """What is uncertain between true motions and stated loads."""
    where = " ".join(f"{value:g}" for value in setup.cross_m)
    centre = np.array([0.0, 0.0, 0.035])
    found = [
        _Unknown("load: mass", "load: mass", _U_MASS_KG, "kg", "rig", _mass_matrix(_U_MASS_KG, centre)),
        _Unknown("laser: scale", "laser: scale", _U_MOTION, "1", "rig", _U_MOTION * mass),
        _Unknown("clock bridge: time", "clock: time", _U_TIME_S, "s", "recording",
                 -2j * np.pi * setup.frequency_hz * _U_TIME_S * mass),
    ]  # fmt: skip
    for axis, letter in enumerate("xyz"):
        for name, kg, place, scope in (
            ("load: centre of mass", _LOAD_KG, centre, "rig"),
            (f"cross at {where}: centre of mass", _CROSS_KG, np.array(setup.cross_m), "mounting"),
        ):
            moved = _mass_matrix(kg, place + _U_CENTRE_M * np.eye(3)[axis]) - _mass_matrix(kg, place)
            label = name.split(" at")[0].split(":")[0] + ": centre of mass"
            found.append(
                _Unknown(f"{name} {letter}", label, _U_CENTRE_M, "m", "mounting" if scope == "mounting" else "rig",
                         moved)
            )  # fmt: skip
        inertia = np.zeros((6, 6), np.complex128)
        inertia[3 + axis, 3 + axis] = _U_INERTIA_KGM2
        turn = np.kron(np.eye(2), np.cross(np.eye(3), _U_TURN_RAD * np.eye(3)[axis]))
        found.append(_Unknown(f"load: inertia {letter}", "load: inertia", _U_INERTIA_KGM2, "kg.m^2", "rig", inertia))
        found.append(_Unknown(f"pose: rotation {letter}", "pose", _U_TURN_RAD, "rad", "rig", mass @ turn))
    return found


def _mass_matrix(mass_kg: float, centre_m: FloatArray, inertia_kgm2: FloatArray | None = None) -> FloatArray:
    """Mass matrix (6, 6) of one part about the sensor origin: F = m·(a + α × c), M = c × F + J·α."""
    lever = np.cross(np.eye(3), centre_m)  # lever · v = centre × v
    matrix = np.zeros((6, 6))
    matrix[:3, :3] = mass_kg * np.eye(3)
    matrix[:3, 3:], matrix[3:, :3] = -mass_kg * lever, mass_kg * lever
    matrix[3:, 3:] = (np.zeros((3, 3)) if inertia_kgm2 is None else inertia_kgm2) - mass_kg * lever @ lever
    return matrix


def _influence(unknown: _Unknown, change: ComplexArray) -> Influence:
    """One unknown of the load."""
    return Influence(unknown.name, unknown.label, unknown.u, unknown.unit, _stacked(change)[None], unknown.scope)


def _stacked(values: ComplexArray) -> FloatArray:
    """[Re, Im] of complex values."""
    return np.concatenate([values.real, values.imag])


def _complex_normal(rng: np.random.Generator, count: int) -> ComplexArray:
    """Complex numbers with standard normal real and imaginary part."""
    return np.asarray(rng.standard_normal(count) + 1j * rng.standard_normal(count))
