"""Structures: a rigid load on a sensor's springs, and masses in a row."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import islice, permutations

import numpy as np

from shaker.arrays import ComplexArray, FloatArray, check_shape
from shaker.identification.measured import MeasuredTransfer
from shaker.identification.model import Mechanics, Parameter, Response, measured_poles, poles, respond

# A rigid load on the springs and dampers of a sensor that stands on a moving base.


_APART = 1.5  # factor between the resonances of the components where a fit starts
_FAR_APART = 6.0  # the same where only the lowest is seen
_MOST_ORDERS = 24  # of resonances to components that are tried
_DAMPING_RATIO = 0.01  # where a fit starts
AXES = ("x", "y", "z", "rx", "ry", "rz")


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
        found = self.components
        if not found or len(set(found)) < len(found) or not set(found) <= set(range(6)):
            raise ValueError(f"components: expected different ones of 0 to 5, found {found}")

    @property
    def parameters(self) -> tuple[Parameter, ...]:
        """Stiffness and damping of each free component, then internal mass and moments of inertia."""
        springs, dampers = [], []
        for axis in (AXES[c] for c in self.components):
            turning = axis.startswith("r")
            springs.append(Parameter(f"stiffness_{axis}", f"stiffness k, {axis}", "N·m/rad" if turning else "N/m"))
            dampers.append(Parameter(f"damping_{axis}", f"damping b, {axis}", "N·m·s/rad" if turning else "N·s/m"))
        inertias = [Parameter(*words) for words, _ in self._internal]
        return (*springs, *dampers, *inertias)

    @property
    def _internal(self) -> list[tuple[tuple[str, str, str], FloatArray]]:
        """Words and mass matrix (6, 6) per unit of what moves with the load inside the sensor."""
        found = []
        if any(c < 3 for c in self.components):
            words = ("internal_mass", "internal mass m_i", "kg")
            found.append((words, np.diag([1.0, 1.0, 1.0, 0.0, 0.0, 0.0])))
        for c in self.components:
            if c >= 3:
                words = (f"internal_inertia_{AXES[c]}", f"internal moment of inertia, {AXES[c]}", "kg·m²")
                found.append((words, np.diag(np.eye(6)[c])))
        return found

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


# Masses in a row on springs and dampers: a load on its sensor, the sensor on an adapter that gives way.


BASE = "base"
SENSOR = "sensor"


@dataclass(frozen=True)
class MassChain:
    """Stages (N,) above a base that is moved, each on spring and damper that join it to the one below.

    `mass` kg, `stiffness` N/m, `damping` N·s/m (N,) along an axis, or kg·m², N·m/rad, N·m·s/rad about it.
    mᵢ ẍᵢ = kᵢ(xᵢ₋₁ - xᵢ) + bᵢ(ẋᵢ₋₁ - ẋᵢ) - kᵢ₊₁(xᵢ - xᵢ₊₁) - bᵢ₊₁(ẋᵢ - ẋᵢ₊₁), x₀ the base.
    """

    stages: tuple[str, ...]
    mass: FloatArray
    stiffness: FloatArray
    damping: FloatArray

    def __post_init__(self) -> None:
        _check_names(self.stages)
        for name in ("mass", "stiffness", "damping"):
            check_shape(name, getattr(self, name), (len(self.stages),))

    def transfer(self, frequency_hz: FloatArray, of: str, over: str = BASE) -> Response:
        """Return the motion of one stage over that of another or of the base, while the base is moved.

        `value` (K, 1), `by_term` (K, 1, 3N): derivatives by mass, stiffness, damping of every stage, `by_log_s` (K, 1).
        """
        return respond(self._mechanics(of, over), self._weights, _laplace(frequency_hz))

    def receptance(self, frequency_hz: FloatArray) -> ComplexArray:
        """Return displacements (K, N, N) of stage i for a force of 1 N on stage j, the base at rest, in m/N."""
        (mass, damping, stiffness), _ = self._mechanics(self.stages[-1], BASE).at(self._weights)
        s = _laplace(frequency_hz)[:, None, None]
        return np.asarray(np.linalg.inv(s * s * mass + s * damping + stiffness))

    def modes(self) -> tuple[FloatArray, FloatArray]:
        """Return f₀ = |λ|/2π in Hz and ζ = -Re λ/|λ| (N,) of the poles λ of the chain on a base at rest, ascending."""
        found = poles(self._mechanics(self.stages[-1], BASE), self._weights)[0]
        size = np.abs(found)
        return size / (2.0 * np.pi), -found.real / size

    @property
    def _weights(self) -> FloatArray:
        """Weights (1+3N,) of the terms of `_mechanics`."""
        return np.concatenate([[1.0], self.mass, self.stiffness, self.damping])

    def _mechanics(self, of: str, over: str) -> Mechanics:
        """Return the chain's mechanics, linear in mass, stiffness and damping of every stage."""
        matrices, forcing = _terms(len(self.stages))
        return Mechanics(
            matrices=matrices,
            forcing=forcing,
            rows=self._reading(of)[None],
            offset=np.ones(1),
            reference=self._reading(over),
            reference_offset=1.0,
        )

    def _reading(self, stage: str) -> FloatArray:
        """Return the row (N,) that reads the motion of a stage relative to the base."""
        if stage not in (BASE, *self.stages):
            raise ValueError(f"stage: expected one of {', '.join((BASE, *self.stages))}, found {stage}")
        return np.array([float(stage == name) for name in self.stages])


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
        _check_names(tuple(stage.name for stage in self.stages))
        if self.component not in range(6):
            raise ValueError(f"component: expected one of 0 to 5, found {self.component}")

    @property
    def parameters(self) -> tuple[Parameter, ...]:
        """Stiffness of every stage, damping of every stage, masses of their own."""
        axis, turning = AXES[self.component], self.component >= 3
        springs, dampers = [], []
        for name in (stage.name for stage in self.stages):
            ending, told = (axis, axis) if name == SENSOR else (f"{axis}_{name}", f"{axis}, {name}")
            springs.append(Parameter(f"stiffness_{ending}", f"stiffness k, {told}", "N·m/rad" if turning else "N/m"))
            dampers.append(Parameter(f"damping_{ending}", f"damping b, {told}", "N·m·s/rad" if turning else "N·s/m"))
        masses = [self._mass(stage.name) for stage in self.stages if stage.own_mass]
        return (*springs, *dampers, *masses)

    def _mass(self, name: str) -> Parameter:
        """Return the parameter of a stage's own mass or moment of inertia."""
        if self.component < 3:
            words = ("internal_mass", "internal mass m_i") if name == SENSOR else (f"mass_{name}", f"mass, {name}")
            return Parameter(*words, "kg")
        axis = AXES[self.component]
        if name == SENSOR:
            return Parameter(f"internal_inertia_{axis}", f"internal moment of inertia, {axis}", "kg·m²")
        return Parameter(f"inertia_{axis}_{name}", f"moment of inertia, {axis}, {name}", "kg·m²")

    @property
    def body(self) -> FloatArray:
        """Motion (6, n) of the last stage beside the base."""
        return np.outer(np.eye(6)[self.component], np.eye(len(self.stages))[-1])

    def mechanics(self, record: MeasuredTransfer) -> Mechanics:
        """Return M, B, K and f of a recording; its responses stand on the last stage, its reference on the base."""
        count = len(self.stages)
        matrices, forcing = _terms(count)
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
        from itertools import permutations

        count = len(self.stages)
        found = []
        for record in records[:1]:
            measured = measured_poles(record, count)
            load = record.mass_matrix[self.component, self.component]
            for order in permutations(range(count)):
                pole = measured[list(order)]
                size = np.abs(pole)
                damping = np.maximum(-2.0 * pole.real, 1e-3 * size) * load
                masses = [0.1 * load for stage in self.stages if stage.own_mass]
                found.append(np.concatenate([size**2 * load, damping, masses]))
        return np.array(found)


def shared_spring(frequency_hz: FloatArray, mass: FloatArray) -> tuple[float, float]:
    """Return stiffness k and internal mass m_i that give resonances (N,) in Hz with loads (N,) of known mass.

    1/(2πf)² = (m + m_i)/k is a straight line over m: exact for two loads, of least squares for more.
    """
    check_shape("mass", np.asarray(mass), np.asarray(frequency_hz).shape)
    if len(np.unique(mass)) < 2:
        raise ValueError(f"mass: expected two different loads or more, found {np.asarray(mass).tolist()}")
    softness, offset = np.polyfit(mass, 1.0 / (2.0 * np.pi * np.asarray(frequency_hz)) ** 2, 1)
    return float(1.0 / softness), float(offset / softness)


def _check_names(stages: tuple[str, ...]) -> None:
    """Raise unless stages have different names, none of them that of the base."""
    if not stages or len({BASE, *stages}) <= len(stages):
        raise ValueError(f"stages: expected different names other than {BASE}, found {', '.join(stages) or 'none'}")


def _terms(count: int) -> tuple[FloatArray, FloatArray]:
    """Return M, B, K (1+3N, 3, N, N) and f (1+3N, N) of nothing, then per unit of every mass, stiffness, damping."""
    unit = np.eye(count)
    stretch = unit - np.eye(count, k=-1)
    matrices = np.zeros((1 + 3 * count, 3, count, count))
    forcing = np.zeros((1 + 3 * count, count))
    for place in range(count):
        matrices[1 + place, 0] = np.outer(unit[place], unit[place])
        matrices[1 + count + place, 2] = np.outer(stretch[place], stretch[place])
        matrices[1 + 2 * count + place, 1] = matrices[1 + count + place, 2]
        forcing[1 + place] = unit[place]
    return matrices, forcing


def _laplace(frequency_hz: FloatArray) -> ComplexArray:
    """Return s = jω (K,)."""
    return np.asarray(2j * np.pi * np.asarray(frequency_hz, dtype=np.float64))
