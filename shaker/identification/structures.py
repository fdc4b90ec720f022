"""Structures that `identify` fits: a load on the sensor's springs, a chain of stages; their measured poles."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import islice, permutations
from typing import Protocol

import numpy as np

from shaker.arrays import ComplexArray, FloatArray
from shaker.identification.measured import MeasuredTransfer
from shaker.labels import MOTION_COMPONENTS
from shaker.mechanics import Mechanics, chain_terms, check_stages


@dataclass(frozen=True)
class Parameter:
    """One number of a structure: `name` for files, e.g. "stiffness_z", `label` for readers, `unit`."""

    name: str
    label: str
    unit: str


class Structure(Protocol):
    """What is fitted: named parameters, what they mean in a recording, and where a fit may start."""

    @property
    def parameters(self) -> tuple[Parameter, ...]:
        """Parameters (P,); "stiffness_…" and "damping_…" with one ending belong together."""

    @property
    def body(self) -> FloatArray:
        """How the load moves beside the base, (6, n) [x y z rx ry rz] per p; the base moves as `record.drive`."""

    def mechanics(self, record: MeasuredTransfer) -> Mechanics:
        """Return the mechanics of a recording, terms in the order 1, `parameters`, `record.inertia_errors`."""

    def starts(self, records: Sequence[MeasuredTransfer]) -> FloatArray:
        """Return starting values (S, P), the right order of magnitude; the best of what they lead to is taken."""


SENSOR = "sensor"
"""Name of the stage that is the sensor itself."""
_APART = 1.5  # factor between the resonances of the components where a fit starts
_FAR_APART = 6.0  # the same where only the lowest is seen
_MOST_ORDERS = 24  # of resonances to components that are tried
_DAMPING_RATIO = 0.01  # where a fit starts


@dataclass(frozen=True)
class Suspension:
    """Load on springs k and dampers b along `components` (indices into x y z rx ry rz), rigid along all others.

    The base moves as a rigid body along `record.drive` = d, the load with it and by p along the free components F:
    (M_FF s² + b s + k) p = -s² (M d)_F, M = mass matrix of the load + internal mass at the origin (Nitsche et al.,
    J. Sens. Sens. Syst. 7, 2018, eqs 8, 9 for one translation). With component z alone H = (k + bs)/((m + m_i)s² + bs +
    k); (0, 4) pitches, since the height of the centre of mass couples x and ry in M; (4,) turns: J α against k_ry.
    What moves with the load inside the sensor is unknown: a mass for all translations, a moment of inertia for each
    rotation. Recordings of one load alone leave it open; `identify` takes it as known where it is stated.
    """

    components: tuple[int, ...]

    def __post_init__(self) -> None:
        chosen = self.components
        if not chosen or len(set(chosen)) < len(chosen) or not set(chosen) <= set(range(6)):
            raise ValueError(f"components: expected different ones of 0 to 5, found {chosen}")

    @property
    def parameters(self) -> tuple[Parameter, ...]:
        """Stiffness and damping of each free component, then internal mass and moments of inertia."""
        springs, dampers = [], []
        for c in self.components:
            axis, force = MOTION_COMPONENTS[c], "N" if c < 3 else "N·m"
            per = "m" if c < 3 else "rad"
            springs.append(Parameter(f"stiffness_{axis}", f"stiffness k, {axis}", f"{force}/{per}"))
            dampers.append(Parameter(f"damping_{axis}", f"damping b, {axis}", f"{force}·s/{per}"))
        return (*springs, *dampers, *(parameter for parameter, _ in self._internal))

    @property
    def _internal(self) -> list[tuple[Parameter, FloatArray]]:
        """What moves with the load inside the sensor, and its mass matrix (6, 6) per unit."""
        internal = []
        if any(c < 3 for c in self.components):
            mass = Parameter("internal_mass", "internal mass m_i", "kg")
            internal.append((mass, np.diag([1.0, 1.0, 1.0, 0.0, 0.0, 0.0])))
        for c in (c for c in self.components if c >= 3):
            axis = MOTION_COMPONENTS[c]
            inertia = Parameter(f"internal_inertia_{axis}", f"internal moment of inertia, {axis}", "kg·m²")
            internal.append((inertia, np.diag(np.eye(6)[c])))
        return internal

    @property
    def body(self) -> FloatArray:
        """Motion (6, n) of the load beside the base: along the free components."""
        return np.asarray(np.eye(6)[:, list(self.components)])

    def mechanics(self, record: MeasuredTransfer) -> Mechanics:
        """Return M, b, k and M d of a recording along the free components; other readings are those of the base."""
        free = np.array(self.components)
        size = len(free)
        masses = [record.mass_matrix, *(matrix for _, matrix in self._internal)]
        masses += [error.change for error in record.inertia_errors]
        full = np.stack([masses[0], *np.zeros((2 * size, 6, 6)), *masses[1:]])
        matrices = np.zeros((len(full), 3, size, size))
        matrices[:, 0] = full[:, free[:, None], free]
        place = np.arange(size)
        matrices[1 + place, 2, place, place] = 1.0
        matrices[1 + size + place, 1, place, place] = 1.0
        rows = np.stack([sight.row for sight in record.tops])
        return Mechanics(
            matrices=matrices,
            forcing=(full @ record.drive)[:, free],
            rows=rows @ self.body,
            offset=rows @ record.drive,
            reference=np.zeros(size),
            reference_offset=float(record.base.row @ record.drive),
        )

    def starts(self, records: Sequence[MeasuredTransfer]) -> FloatArray:
        """Return starts (S, P): resonances of the components around the largest ratio and above it, in every order."""
        size = len(self.components)
        largest = max(records, key=lambda record: float(np.abs(record.ratio.value).max()))
        line = int(np.argmax(np.abs(largest.ratio.value).max(axis=1)))
        peak = 2.0 * np.pi * float(largest.ratio.frequency_hz[line])
        rank = np.arange(size)
        spacings = [peak * _APART ** (rank - 0.5 * (size - 1)), peak * _FAR_APART**rank]
        spacings = spacings[: 1 if size == 1 else 2]
        orders = np.array([order for omega in spacings for order in islice(permutations(omega), _MOST_ORDERS)])
        inertia = largest.mass_matrix.diagonal()[list(self.components)]
        damping = 2.0 * _DAMPING_RATIO * orders * inertia
        return np.hstack([orders**2 * inertia, damping, np.zeros((len(orders), len(self._internal)))])


@dataclass(frozen=True)
class Stage:
    """A stage whose spring and damper are sought; `own_mass`: whether it has an unknown mass besides the load."""

    name: str
    own_mass: bool = True


@dataclass(frozen=True)
class ChainStructure:
    """What `identify` fits where the base is measured below a mount that gives way: stages in a row, load on the last.

    `component`: index into x y z rx ry rz of the axis along which, or about which, the chain moves; along all others
    everything moves as the base. Parameters: stiffness and damping of every stage, then the masses of those that have
    one of their own. Those of the stage "sensor" are named as `Suspension` names them: "stiffness_z", "damping_z",
    "internal_mass" (or "internal_inertia_rz"); of others "stiffness_z_adapter", "damping_z_adapter", "mass_adapter".
    """

    component: int
    stages: tuple[Stage, ...] = (Stage("adapter"), Stage(SENSOR))

    def __post_init__(self) -> None:
        check_stages(tuple(stage.name for stage in self.stages))
        if self.component not in range(6):
            raise ValueError(f"component: expected one of 0 to 5, found {self.component}")

    @property
    def parameters(self) -> tuple[Parameter, ...]:
        """Stiffness of every stage, damping of every stage, masses of their own."""
        axis, turning = MOTION_COMPONENTS[self.component], self.component >= 3
        springs, dampers, masses = [], [], []
        for stage in self.stages:
            sensor = stage.name == SENSOR
            ending, words = (axis, axis) if sensor else (f"{axis}_{stage.name}", f"{axis}, {stage.name}")
            springs.append(Parameter(f"stiffness_{ending}", f"stiffness k, {words}", "N·m/rad" if turning else "N/m"))
            dampers.append(Parameter(f"damping_{ending}", f"damping b, {words}", "N·m·s/rad" if turning else "N·s/m"))
            if stage.own_mass and turning:
                inside = "internal_" if sensor else ""
                label = f"{'internal ' if sensor else ''}moment of inertia, {words}"
                masses.append(Parameter(f"{inside}inertia_{ending}", label, "kg·m²"))
            elif stage.own_mass:
                own = (
                    ("internal_mass", "internal mass m_i") if sensor else (f"mass_{stage.name}", f"mass, {stage.name}")
                )
                masses.append(Parameter(*own, "kg"))
        return (*springs, *dampers, *masses)

    @property
    def body(self) -> FloatArray:
        """Motion (6, n) of the last stage beside the base."""
        return np.outer(np.eye(6)[self.component], np.eye(len(self.stages))[-1])

    def mechanics(self, record: MeasuredTransfer) -> Mechanics:
        """Return M, B, K and f of a recording; its responses stand on the last stage, its reference on the base."""
        count = len(self.stages)
        matrices, forcing = chain_terms(count)
        mass = slice(1, 1 + count)
        spring, damper = (matrices[1 + shift : 1 + shift + count] for shift in (count, 2 * count))
        own = [place for place, stage in enumerate(self.stages) if stage.own_mass]
        loads = [record.mass_matrix, *(error.change for error in record.inertia_errors)]
        load = np.array([matrix[self.component, self.component] for matrix in loads])[:, None, None, None]
        push = np.array([matrix[self.component] @ record.drive for matrix in loads])[:, None]
        last, ahead = matrices[count], forcing[count]
        rows = np.stack([sight.row for sight in record.tops])
        drive = record.drive[self.component]
        return Mechanics(
            matrices=np.concatenate([load[:1] * last, spring, damper, matrices[mass][own], load[1:] * last]),
            forcing=np.concatenate(
                [push[:1] * ahead, 0.0 * forcing[: 2 * count], forcing[mass][own] * drive, push[1:] * ahead]
            ),
            rows=rows @ self.body,
            offset=rows @ record.drive,
            reference=np.zeros(count),
            reference_offset=float(record.base.row @ record.drive),
        )

    def starts(self, records: Sequence[MeasuredTransfer]) -> FloatArray:
        """Return starting values (S, P): the measured poles in every order to the springs, as if each bore the load."""
        load = records[0].mass_matrix[self.component, self.component]
        masses = [0.1 * load for stage in self.stages if stage.own_mass]
        starts = []
        for order in permutations(measured_poles(records[0], len(self.stages))):
            pole = np.array(order)
            size = np.abs(pole)
            damping = np.maximum(-2.0 * pole.real, 1e-3 * size) * load
            starts.append(np.concatenate([size**2 * load, damping, masses]))
        return np.array(starts)


# Poles of measured curves from a linear rational fit: where an identification starts.

_ROUNDS = 8
_SIGNIFICANT = 30.0  # decrease of χ² per real number by which a pole is more than a feature of the noise
_SETTLED = 1e-4  # change of the denominator's coefficients that no longer moves a start


def measured_poles(record: MeasuredTransfer, count: int) -> ComplexArray:
    """Return `count` poles (Im λ > 0, ascending |λ|) of the common denominator of all responses of a recording.

    Ratios are fitted by polynomials Nᶜ(s)/D(s) of degree 2·count, linearised (Levy, IRE Trans. Autom. Control 4, 1959)
    and weighted anew in rounds (Sanathanan and Koerner, IEEE Trans. Autom. Control 8, 1963). Unstable poles are
    mirrored; in place of real ones stand poles above the band.
    """
    value, s = record.ratio.value, record.s
    middle = float(np.sqrt(np.abs(s).min() * np.abs(s).max()))
    q = s / middle
    noise = np.sqrt(record.ratio.u_re**2 + record.ratio.u_im**2)
    highest = q ** (2 * count)
    power = q[:, None] ** np.arange(2 * count)
    numerator = np.concatenate([power, highest[:, None]], axis=1)

    def denominator_of(weight: FloatArray) -> FloatArray:
        """Coefficients of one weighted linear fit, the numerator projected out of each response."""
        left, right = [], []
        for c in range(value.shape[1]):
            wanted = np.column_stack([-value[:, c, None] * power, value[:, c] * highest]) * weight[:, c, None]
            own = numerator * weight[:, c, None]
            rest = np.concatenate([wanted.real, wanted.imag])
            basis = np.linalg.qr(np.concatenate([own.real, own.imag]))[0]
            rest = rest - basis @ (basis.T @ rest)
            left.append(rest[:, :-1])
            right.append(rest[:, -1])
        return np.asarray(np.linalg.lstsq(np.concatenate(left), np.concatenate(right), rcond=None)[0])

    weight, denominator = 1.0 / noise, np.zeros(2 * count)
    for _ in range(_ROUNDS):
        before, denominator = denominator, denominator_of(weight)
        if np.abs(denominator - before).max() < _SETTLED:
            break
        at = np.abs(highest + power @ denominator)
        weight = 1.0 / (noise * np.maximum(at, 1e-9 * at.max())[:, None])
    roots = np.roots([1.0, *denominator[::-1]])
    roots = -np.abs(roots.real) + 1j * roots.imag
    oscillating = roots[roots.imag > 1e-9 * np.abs(roots)] * middle
    above = float(np.abs(s).max()) * 2.0 ** np.arange(1, count - len(oscillating) + 1) * (-0.02 + 1j)
    return np.concatenate([oscillating[np.argsort(np.abs(oscillating))], above])


def significant_poles(record: MeasuredTransfer, poles: ComplexArray) -> ComplexArray:
    """Return those of some poles without which a sum of partial fractions explains the ratios clearly worse.

    Basis: 1/(s - λ) and 1/(s - λ*) of each pole, 1, s and s², for each response by itself.
    """
    if len(poles) < 2:
        return poles
    value, s = record.ratio.value, record.s
    noise = np.sqrt(0.5 * (record.ratio.u_re**2 + record.ratio.u_im**2))
    unit = float(np.abs(s).max())
    smooth = (s[:, None] / unit) ** np.arange(3)
    fractions = [np.stack([unit / (s - pole), unit / (s - pole.conjugate())], axis=1) for pole in poles]

    def misfit(columns: Sequence[ComplexArray]) -> float:
        """χ² of the best sums of columns for the ratios, each with its own coefficients."""
        total = 0.0
        for c in range(value.shape[1]):
            right = value[:, c] / noise[:, c]
            basis = np.linalg.qr(np.concatenate(columns, axis=1) / noise[:, c, None])[0]
            total += float(np.sum(np.abs(right - basis @ (basis.conj().T @ right)) ** 2))
        return total

    every = misfit([*fractions, smooth])
    lost = [misfit([*fractions[:i], *fractions[i + 1 :], smooth]) - every for i in range(len(poles))]
    return np.asarray(poles[np.array(lost) > _SIGNIFICANT * 4.0 * value.shape[1]])
