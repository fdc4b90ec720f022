"""The load on the sensor, and the uncertainty budget of any result."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from fusion.base import AnyNotice
from fusion.estimation.least_squares import BODY_SIZE_M, UNOBSERVED
from fusion.estimation.uncertainty import (
    Contribution,
    Influence,
    Kind,
    Uncertainty,
    Unknown,
    real_design,
    real_stack,
    total_variance,
)
from fusion.sensitivity.body import Body
from shaker.arrays import BoolArray, ComplexArray, FloatArray, Notice, brief, check_shape, check_shapes
from shaker.labels import LOAD_COMPONENTS, LOAD_UNITS, MOTION_COMPONENTS
from shaker.sine.phasor import Phasors, real_stacked_diagonal

if TYPE_CHECKING:
    from fusion.estimation.fuse import Acceleration

# The load at the sensor origin: mass matrix and gravity tilt applied to the acceleration, with its uncertainty.


UNOBSERVED_LIMIT = 0.05
"""Largest relative standard uncertainty that unobserved components may bring to a load component that is given.

Half of the usual 10 %: given is what the geometry keeps half of that motion away from. What is given has it in U.
"""
MATTERS = 0.1
"""Share of the variance from which on an assumption about motion that nobody observed deserves a warning."""


@dataclass(frozen=True)
class LoadResult:
    """Wrench phasors at the sensor origin in N and N.m, with the manifest's sense.

    `value` (K, 6): the whole estimate, with components of the motion that nobody observed at zero; NaN at lines without
    any reading. `uncertainty`: of all six, in which those components are contributions of their own. `observed` (K, 6):
    which components are given as results, since the unobserved ones matter little to them.
    """

    frequency_hz: FloatArray
    value: ComplexArray
    uncertainty: Uncertainty
    observed: BoolArray
    notices: tuple[AnyNotice, ...]

    __repr__ = brief

    def __post_init__(self) -> None:
        lines = len(self.frequency_hz)
        check_shapes(self, (lines, 6), "value", "observed")
        check_shape("covariance", self.uncertainty.covariance, (lines, 12, 12))

    @property
    def phasors(self) -> Phasors:
        """Return the components that are given as results, NaN elsewhere; `dof` of the largest force of each line."""
        mask = ~np.tile(self.observed, (1, 2))
        covariance = np.where(mask[:, :, None] | mask[:, None, :], np.nan, self.uncertainty.covariance)
        value = np.where(self.observed, self.value, complex(np.nan, np.nan))
        size = np.abs(self.value) / np.where(np.arange(6) < 3, 1.0, BODY_SIZE_M)
        largest = np.argmax(np.where(self.observed, size, -1.0), axis=1)
        dof = self.uncertainty.dof()[np.arange(len(value)), largest]
        return Phasors(self.frequency_hz, value, covariance, LOAD_COMPONENTS, LOAD_UNITS, dof)

    @property
    def contributions(self) -> tuple[Contribution, ...]:
        """Return the budget: one contribution per label; they add up to the covariance of `value`."""
        return self.uncertainty.grouped()


def load_phasors(acceleration: Acceleration, body: Body) -> LoadResult:
    """Return the wrench L = ±(M A + gravity tilt) at the sensor origin, positive in the body's sense.

    Its uncertainty is that of the acceleration carried through, and one influence per uncertain number of body, joint
    and gravity, (dM/dp · A) u(p). Acceleration components that no instrument observed are taken as zero within the
    amplitudes of `acceleration.unseen`, a type B contribution "unobserved NAME"; a load component to which they bring
    more than 5 % is not given. No load is given at lines at which
    a component of the acceleration is disputed.
    """
    frequency = acceleration.phasors.frequency_hz
    # At a line without any reading nothing is known, neither what is zero nor how uncertain it is; nor is it where
    # instruments dispute a component, which is neither zero nor small.
    known_lines = np.any(acceleration.observed, axis=1)
    if acceleration.disputed is not None:
        known_lines = known_lines & ~np.any(acceleration.disputed, axis=1)
    seen = np.where(known_lines, 1.0, np.nan)[:, None, None]
    matrix = seen * body.load_matrix(frequency)
    changes = [replace(change, effect=seen * change.effect) for change in body.matrix_changes(frequency)]
    known = np.nan_to_num(acceleration.phasors.value)
    value = np.einsum("kij,kj->ki", matrix, known)
    hidden = _hidden_contributions(acceleration, matrix, changes)
    spread = np.sum([np.zeros(value.shape), *(total_variance(part.covariance) for part in hidden.values())], axis=0)
    observed = np.isfinite(value) & (np.sqrt(spread) <= UNOBSERVED_LIMIT * np.abs(value))
    # What is not observed has contributions of its own.
    carried = acceleration.uncertainty.where_known().transformed(real_design(matrix))
    own = tuple(c.acting(real_stack(np.einsum("kij,kj->ki", c.effect, known))) for c in changes)
    total = Uncertainty((*carried.random, *hidden.values()), (*carried.influences, *own))
    rigid = np.einsum("kij,kj->ki", seen * replace(body, joint=None).load_matrix(frequency), known)
    notices = (*_notices(acceleration, total, value, observed, hidden), *_joint_notice(body, frequency, value, rigid))
    return LoadResult(frequency, value, total, observed, notices)


def _hidden_contributions(
    acceleration: Acceleration, matrix: ComplexArray, changes: Sequence[Unknown[ComplexArray]]
) -> dict[str, Contribution]:
    """One type B contribution per component nobody observed; its real and imaginary parts are independent."""
    known = np.nan_to_num(acceleration.phasors.value)
    variance = acceleration.unseen.amplitude(known, acceleration.observed) ** 2 / 2.0
    # Through the uncertain parameters an unobserved component acts even where its coefficient is zero.
    ways = np.stack([matrix, *(c.effect for c in changes)])
    hidden = {}
    for place, name in enumerate(MOTION_COMPONENTS):
        if np.any(variance[:, place] > 0.0):
            columns = real_design(ways[..., place, None])
            covariance = np.einsum("wkia,wkja,k->kij", columns, columns, variance[:, place])
            hidden[name] = Contribution(f"unobserved {name}", "B", covariance)
    return hidden


def _notices(
    acceleration: Acceleration,
    total: Uncertainty,
    value: ComplexArray,
    observed: BoolArray,
    hidden: Mapping[str, Contribution],
) -> tuple[Notice, ...]:
    """Say what was assumed of motion that nobody observed, what that does, and which load components are not given."""
    told = []
    disputed = acceleration.disputed
    if disputed is not None:
        lines = np.count_nonzero(np.any(disputed, axis=1))
        text = f"no load, and no sensitivity, at {lines} of {len(disputed)} lines: instruments contradict each other"
        told.append(Notice("warning", f"{text} about the acceleration and nothing decides between them", "load"))
    given = np.where(observed, np.abs(value) / np.where(np.arange(6) < 3, 1.0, BODY_SIZE_M), 0.0)
    line, largest = np.unravel_index(int(np.argmax(given)), given.shape)
    if hidden and given[line, largest] > 0.0:
        whole = float(total_variance(total.covariance)[line, largest])
        # What reaches the load directly, and what uncertain directions let into the observed components.
        ways = [*hidden.values(), *(part for part in total.random if part.label == UNOBSERVED)]
        part = float(sum(total_variance(way.covariance)[line, largest] for way in ways))
        if part > 0.0:
            share, size = part / whole, np.sqrt(part / 2.0) / np.abs(value[line, largest])
            text = (
                f"nothing measures {', '.join(hidden)} of the load at some lines: amplitudes up to "
                f"{acceleration.unseen} are assumed ([shaker] states others); they make u = {100.0 * size:.2g} % of "
                f"{LOAD_COMPONENTS[largest]} at {acceleration.phasors.frequency_hz[line]:.6g} Hz, {share:.0%} of its "
                "variance"
            )
            told.append(Notice("warning" if share > MATTERS else "info", text, acceleration.body))
    missing = [name for place, name in enumerate(LOAD_COMPONENTS) if not np.any(observed[:, place])]
    if missing:
        text = f"no value of {', '.join(missing)}: components of the motion that were not observed may dominate them"
        told.append(Notice("info", text, "load"))
    return tuple(told)


def _joint_notice(body: Body, frequency_hz: FloatArray, value: ComplexArray, rigid: ComplexArray) -> tuple[Notice, ...]:
    """Say what the elastic joint does to the largest force, at the line where that is most."""
    if body.joint is None:
        return ()
    sizes = np.nan_to_num(np.abs(rigid))
    largest, lines = np.argmax(sizes[:, :3], axis=1), np.arange(len(value))
    before, after = sizes[lines, largest], np.abs(value)[lines, largest]
    change = np.divide(after, before, out=np.full(len(value), np.nan), where=before > 0.0) - 1.0
    if not np.any(np.isfinite(change)):
        return ()
    line = int(np.nanargmax(np.abs(change)))
    name, resonance = LOAD_COMPONENTS[largest[line]], body.joint.frequency_hz[largest[line]]
    where = f"{name} at {frequency_hz[line]:.6g} Hz"
    if body.joint.u_frequency_hz[largest[line]] == 0.0:
        text = f"the load's joint ({resonance:.6g} Hz) is only named: {where} is not corrected for it, U contains it"
    else:
        text = f"the load's joint ({resonance:.6g} Hz) changes {where} by {change[line]:+.2%} from that of a rigid body"
    return (Notice("info", text, "load"),)


# The uncertainty budget: what each cause does to magnitude and phase of complex values, line by line.


@dataclass(frozen=True)
class BudgetEntry:
    """What one cause contributes to C complex values at K lines; all entries of a budget are independent.

    `label`, `type` A or B; `count`: how many unknowns stand behind it, 0 for noise. `u` in `unit`: standard uncertainty
    of the unknown, NaN for noise and where unknowns of different uncertainty were put together. `coefficient` (2, K,
    C): change of the relative magnitude and of the phase (rad) per unit of the unknown; for several unknowns of one
    uncertainty the root of the sum of squares. `u_relative`, `u_phase_rad` (K, C): contribution to the standard
    uncertainty of the relative magnitude and of the phase. `dof` (K,).
    """

    label: str
    type: Kind
    count: int
    u: float
    unit: str
    coefficient: FloatArray
    u_relative: FloatArray
    u_phase_rad: FloatArray
    dof: FloatArray


def budget(uncertainty: Uncertainty, value: ComplexArray) -> tuple[BudgetEntry, ...]:
    """Return the budget of complex values (K, C): one entry per label, in the order of their first appearance.

    With dX/X = d ln|X| + j d arg X the contributions are those to X turned and divided by X (JCGM 102, 9.4). What an
    unknown does on several ways (to outputs and load) has been added up in its effect before any square is taken.
    """
    usable = np.isfinite(value) & (value != 0.0)
    turn = np.divide(1.0, value, out=np.full(value.shape, complex(np.nan, np.nan)), where=usable)
    relative = uncertainty.transformed(real_stacked_diagonal(turn))
    unknowns: dict[str, list[Influence]] = {}
    for influence in relative.influences:
        unknowns.setdefault(influence.label, []).append(influence)
    entries = []
    for part in relative.grouped():
        variance = np.maximum(part.covariance.diagonal(axis1=1, axis2=2), 0.0)
        both = np.sqrt(variance).reshape(len(value), 2, -1).swapaxes(0, 1)
        own = unknowns.get(part.label, [])
        # What the unknowns of one label have in common; one alone has a sign.
        stated = {(influence.u, influence.unit) for influence in own}
        u, unit = stated.pop() if len(stated) == 1 else (np.nan, "")
        signed = own[0].effect.reshape(len(value), 2, -1).swapaxes(0, 1) if len(own) == 1 else both
        coefficient = np.asarray(signed / u) if u > 0.0 else np.full(both.shape, np.nan)
        dof = np.full(len(value), np.inf) if part.dof is None else part.dof
        entries.append(BudgetEntry(part.label, part.type, len(own), u, unit, coefficient, both[0], both[1], dof))
    return tuple(entries)
