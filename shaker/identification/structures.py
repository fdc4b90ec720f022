"""Structures that `identify` fits: a load on the sensor's springs, a chain of stages."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import islice, permutations
from typing import Protocol

import numpy as np

from shaker.identification.measured_curves import MeasuredTransfer
from shaker.labels import LOAD_COMPONENTS, MOTION_COMPONENTS, mechanical_units
from shaker.mechanics import Mechanics, chain_terms, check_stages
from shakercal._common.arrays import FloatArray


@dataclass(frozen=True)
class StructureParameter:
    """One number of a structure: `name` in files, e.g. "stiffness_z", `label` on pages, `unit`."""

    name: str
    label: str
    unit: str


class MechanicalStructure(Protocol):
    """A model for a fit: named parameters, their mechanics in a recording, start values."""

    @property
    def parameters(self) -> tuple[StructureParameter, ...]:
        """Parameters (P,); "stiffness_…" and "damping_…" with the same ending are one spring and its damper."""

    @property
    def body(self) -> FloatArray:
        """Motion (6, n) of the load, x y z rx ry rz, per p."""

    def mechanics(self, record: MeasuredTransfer) -> Mechanics:
        """Return the mechanics of a recording, terms in the order 1, `parameters`, `record.inertia_errors`."""

    def starts(self, records: Sequence[MeasuredTransfer]) -> FloatArray:
        """Return start values (S, P) of the right order of magnitude."""


def _spring_and_damper(component: int, ending: str, words: str) -> tuple[StructureParameter, StructureParameter]:
    """Return stiffness and damping along or about a component."""
    units = mechanical_units(LOAD_COMPONENTS[component])
    stiffness = StructureParameter(f"stiffness_{ending}", f"stiffness k, {words}", units.stiffness)
    return stiffness, StructureParameter(f"damping_{ending}", f"damping b, {words}", units.damping)


def _internal(component: int) -> StructureParameter:
    """Return the parameter of the internal mass, or moment of inertia about an axis."""
    unit = mechanical_units(LOAD_COMPONENTS[component]).inertia
    if component < 3:
        return StructureParameter("internal_mass", "internal mass m_i", unit)
    axis = MOTION_COMPONENTS[component]
    return StructureParameter(f"internal_inertia_{axis}", f"internal moment of inertia, {axis}", unit)


def _seen(
    record: MeasuredTransfer, body: FloatArray, matrices: FloatArray, forcing: FloatArray, loss_hz: float
) -> Mechanics:
    """Return the mechanics of p with the readings of a recording."""
    rows = np.stack([sight.row for sight in record.tops])
    base = float(record.base.row @ record.drive)
    return Mechanics(matrices, forcing, rows @ body, rows @ record.drive, np.zeros(body.shape[1]), base, loss_hz)


SENSOR = "sensor"
"""Name of the stage of the sensor."""
CHANGE = "change_"
"""Begin of the names of changes from the smallest to the largest amplitude."""
_SPACING = 1.5  # factor between the resonances of the components in a start
_WIDE_SPACING = 6.0  # the same if only the lowest is observed
_MOST_ORDERS = 24  # assignments of resonances to components, at most
_DAMPING_RATIO = 0.01  # of a start


@dataclass(frozen=True)
class SpringSuspension:
    """Load on springs k and dampers b along `components`, rigid along all others.

    `components`: indices into x y z rx ry rz. The base moves as a rigid body along `record.drive` = d. The load follows
    it and moves in addition by p along the free components F: (M_FF s² + b s + k) p = -s² (M d)_F. M is the mass matrix
    of the load with the internal mass at the origin (Nitsche et al., J. Sens. Sens. Syst. 7, 2018, eqs 8, 9 for one
    translation). With component z alone H = (k + bs)/((m + m_i)s² + bs + k). (0, 4) is pitching: the height of the
    centre of mass couples x and ry in M. (4,) is a rotation, J α against k_ry. The internal mass is unknown: one mass
    for all translations, one moment of inertia per rotation. Recordings of a single load do not determine it;
    `identify` uses a stated value. `loss_hz` as in `Mechanics`: 0 for viscous damping, else b is that of a loss factor
    at this frequency. `by_amplitude`: k and b change in proportion to `record.level`, by one parameter each.
    """

    components: tuple[int, ...]
    loss_hz: float = 0.0
    by_amplitude: bool = False

    def __post_init__(self) -> None:
        chosen = self.components
        if not chosen or len(set(chosen)) < len(chosen) or not set(chosen) <= set(range(6)):
            raise ValueError(f"components: expected different ones of 0 to 5, found {chosen}")

    @property
    def parameters(self) -> tuple[StructureParameter, ...]:
        """Stiffness and damping of each free component, then internal mass and moments of inertia."""
        axes = [(c, MOTION_COMPONENTS[c]) for c in self.components]
        springs, dampers = zip(*(_spring_and_damper(c, axis, axis) for c, axis in axes), strict=True)
        changing = (*springs, *dampers) if self.by_amplitude else ()
        changes = (
            StructureParameter(f"{CHANGE}{one.name}", f"change over the amplitudes of {one.label}", one.unit)
            for one in changing
        )
        return (*springs, *dampers, *changes, *(parameter for parameter, _ in self._internal))

    @property
    def _internal(self) -> list[tuple[StructureParameter, FloatArray]]:
        """Internal mass and moments of inertia, each with its mass matrix (6, 6) per unit."""
        masses = [(_internal(0), np.diag([1.0, 1.0, 1.0, 0.0, 0.0, 0.0]))] if min(self.components) < 3 else []
        return masses + [(_internal(c), np.diag(np.eye(6)[c])) for c in self.components if c >= 3]

    @property
    def body(self) -> FloatArray:
        """Motion (6, n) of the load relative to the base: along the free components."""
        return np.asarray(np.eye(6)[:, list(self.components)])

    def mechanics(self, record: MeasuredTransfer) -> Mechanics:
        """Return M, b, k and M d of a recording along the free components."""
        free = np.array(self.components)
        size = len(free)
        masses = [record.mass_matrix, *(matrix for _, matrix in self._internal)]
        masses += [error.change for error in record.inertia_errors]
        factors = (1.0, record.level) if self.by_amplitude else (1.0,)
        full = np.stack([masses[0], *np.zeros((2 * size * len(factors), 6, 6)), *masses[1:]])
        matrices = np.zeros((len(full), 3, size, size))
        matrices[:, 0] = full[:, free[:, None], free]
        index = np.arange(size)
        for number, factor in enumerate(factors):
            first = 1 + 2 * size * number
            matrices[first + index, 2, index, index] = factor
            matrices[first + size + index, 1, index, index] = factor
        return _seen(record, self.body, matrices, (full @ record.drive)[:, free], self.loss_hz)

    def starts(self, records: Sequence[MeasuredTransfer]) -> FloatArray:
        """Return starts (S, P), resonances around the largest ratio in every order."""
        size = len(self.components)
        largest = max(records, key=lambda record: float(np.abs(record.ratio.value).max()))
        line = int(np.argmax(np.abs(largest.ratio.value).max(axis=1)))
        peak = 2.0 * np.pi * float(largest.ratio.frequency_hz[line])
        rank = np.arange(size)
        spacings = [peak * _SPACING ** (rank - 0.5 * (size - 1)), peak * _WIDE_SPACING**rank]
        spacings = spacings[: 1 if size == 1 else 2]
        orders = np.array([order for omega in spacings for order in islice(permutations(omega), _MOST_ORDERS)])
        inertia = largest.mass_matrix.diagonal()[list(self.components)]
        damping = 2.0 * _DAMPING_RATIO * orders * inertia
        rest = len(self.parameters) - 2 * size
        return np.hstack([orders**2 * inertia, damping, np.zeros((len(orders), rest))])


@dataclass(frozen=True)
class Stage:
    """A stage with an unknown spring and damper, with or without a mass."""

    name: str
    has_mass: bool = True


@dataclass(frozen=True)
class ChainStructure:
    """Stages in a row with the load on the last.

    It is fitted if the base is measured below a compliant mount. `component`: index into x y z rx ry rz of the axis
    along or about which the chain moves. Along all others everything moves as the base. Parameters: stiffness and
    damping of every stage, then the masses of stages with a mass. Those of the stage "sensor" are named as in
    `SpringSuspension`: "stiffness_z", "damping_z", "internal_mass" (or "internal_inertia_rz"). Those of other stages
    are named "stiffness_z_adapter", "damping_z_adapter", "mass_adapter".
    """

    component: int
    stages: tuple[Stage, ...] = (Stage("adapter"), Stage(SENSOR))
    loss_hz: float = 0.0

    def __post_init__(self) -> None:
        check_stages(tuple(stage.name for stage in self.stages))
        if self.component not in range(6):
            raise ValueError(f"component: expected one of 0 to 5, found {self.component}")

    @property
    def parameters(self) -> tuple[StructureParameter, ...]:
        """Stiffness of every stage, damping of every stage, masses of the stages."""
        axis, pairs, masses = MOTION_COMPONENTS[self.component], [], []
        for stage in self.stages:
            name = stage.name
            ending, words = (axis, axis) if name == SENSOR else (f"{axis}_{name}", f"{axis}, {name}")
            pairs.append(_spring_and_damper(self.component, ending, words))
            inertia = _internal(self.component)
            if name != SENSOR and self.component < 3:
                inertia = replace(inertia, name=f"mass_{name}", label=f"mass, {name}")
            elif name != SENSOR:
                inertia = replace(inertia, name=f"inertia_{ending}", label=f"moment of inertia, {words}")
            masses += [inertia] if stage.has_mass else []
        springs, dampers = zip(*pairs, strict=True)
        return (*springs, *dampers, *masses)

    @property
    def body(self) -> FloatArray:
        """Motion (6, n) of the last stage relative to the base."""
        return np.outer(np.eye(6)[self.component], np.eye(len(self.stages))[-1])

    def mechanics(self, record: MeasuredTransfer) -> Mechanics:
        """Return M, B, K and f of a recording with responses on the last stage."""
        count = len(self.stages)
        matrices, forcing = chain_terms(count)
        mass = slice(1, 1 + count)
        spring, damper = (matrices[1 + shift : 1 + shift + count] for shift in (count, 2 * count))
        massive = [index for index, stage in enumerate(self.stages) if stage.has_mass]
        loads = [record.mass_matrix, *(error.change for error in record.inertia_errors)]
        load = np.array([matrix[self.component, self.component] for matrix in loads])[:, None, None, None]
        push = np.array([matrix[self.component] @ record.drive for matrix in loads])[:, None]
        last, ahead = matrices[count], forcing[count]
        stage_forcing = forcing[mass][massive] * record.drive[self.component]
        moved = np.concatenate([load[:1] * last, spring, damper, matrices[mass][massive], load[1:] * last])
        pushed = np.concatenate([push[:1] * ahead, 0.0 * forcing[: 2 * count], stage_forcing, push[1:] * ahead])
        return _seen(record, self.body, moved, pushed, self.loss_hz)

    def starts(self, records: Sequence[MeasuredTransfer]) -> FloatArray:
        """Return start values (S, P) from the measured poles in every order."""
        load = records[0].mass_matrix[self.component, self.component]
        masses = [0.1 * load for stage in self.stages if stage.has_mass]
        starts = []
        for order in permutations(records[0].poles(len(self.stages))):
            pole = np.array(order)
            size = np.abs(pole)
            damping = np.maximum(-2.0 * pole.real, 1e-3 * size) * load
            starts.append(np.concatenate([size**2 * load, damping, masses]))
        return np.array(starts)
