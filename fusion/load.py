"""The load at the sensor origin: mass matrix and gravity tilt applied to the acceleration, with its uncertainty."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike

from fusion.body import COMPONENTS, Body, MatrixChange
from fusion.estimate import BODY_SIZE_M, UNOBSERVED_MOTION, hidden_motion, real_design, real_stack
from fusion.fuse import Acceleration
from fusion.notices import AnyNotice, Notice
from fusion.uncertainty import Contribution, Influence, Uncertainty, total_variance
from shaker._checks import BoolArray, ComplexArray, FloatArray, check_shape
from shaker.signals.phasor import Phasors

LOAD_COMPONENTS = ("Fx", "Fy", "Fz", "Mx", "My", "Mz")
LOAD_UNITS = ("N", "N", "N", "N.m", "N.m", "N.m")
UNOBSERVED_LIMIT = 0.01
"""Largest relative standard uncertainty that unobserved components may bring to a load component."""


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

    def __post_init__(self) -> None:
        lines = len(self.frequency_hz)
        check_shape("value", self.value, (lines, 6))
        check_shape("observed", self.observed, (lines, 6))
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


def load_phasors(
    acceleration: Acceleration,
    body: Body,
    gravity_mps2: ArrayLike | None = None,
    sense: Literal["on_load", "on_sensor"] = "on_load",
    u_gravity_mps2: ArrayLike | None = None,
) -> LoadResult:
    """Return the wrench L = ±(M A + gravity tilt) at the sensor origin, positive as it acts on the load ("on_load").

    Its uncertainty is that of the acceleration carried through, and one influence per uncertain number of body, joint
    and gravity, (dM/dp · A) u(p). Acceleration components that no instrument observed are taken as zero with a standard
    uncertainty of 2 % of the observed motion's amplitude (rotations: of amplitude over 0.1 m), a type B contribution
    "unobserved NAME"; a load component to which they bring more than 1 % is not given.
    """
    frequency = acceleration.phasors.frequency_hz
    gravity, u_gravity = (None if g is None else np.asarray(g, np.float64) for g in (gravity_mps2, u_gravity_mps2))
    sign = {"on_load": 1.0, "on_sensor": -1.0}[sense]
    # At a line without any reading nothing is known, neither what is zero nor how uncertain it is.
    seen = np.where(np.any(acceleration.observed, axis=1), sign, np.nan)[:, None, None]
    matrix = seen * body.load_matrix(frequency, gravity)
    changes = [replace(c, change=seen * c.change) for c in body.matrix_changes(frequency, gravity, u_gravity)]
    known = np.nan_to_num(acceleration.phasors.value)
    value = np.einsum("kij,kj->ki", matrix, known)
    hidden = _hidden_contributions(acceleration, matrix, changes)
    spread = np.sum([np.zeros(value.shape), *(total_variance(part.covariance) for part in hidden.values())], axis=0)
    observed = np.isfinite(value) & (np.sqrt(spread) <= UNOBSERVED_LIMIT * np.abs(value))
    carried = _where_observed(acceleration.uncertainty).transformed(real_design(matrix))
    own = tuple(
        Influence(c.name, c.label, c.u, c.unit, real_stack(np.einsum("kij,kj->ki", c.change, known)), c.scope)
        for c in changes
    )
    total = Uncertainty((*carried.random, *hidden.values()), (*carried.influences, *own))
    rigid = np.einsum("kij,kj->ki", seen * replace(body, joint=None).load_matrix(frequency, gravity), known)
    notices = (*_notices(acceleration, observed, hidden), *_joint_notice(body, frequency, value, rigid))
    return LoadResult(frequency, value, total, observed, notices)


def _where_observed(uncertainty: Uncertainty) -> Uncertainty:
    """Acceleration's uncertainty with nothing in place of what is not observed: that has a contribution of its own."""
    random = tuple(replace(part, covariance=np.nan_to_num(part.covariance)) for part in uncertainty.random)
    return Uncertainty(random, tuple(replace(i, effect=np.nan_to_num(i.effect)) for i in uncertainty.influences))


def _hidden_contributions(
    acceleration: Acceleration, matrix: ComplexArray, changes: Sequence[MatrixChange]
) -> dict[str, Contribution]:
    """One type B contribution per component nobody observed; its real and imaginary parts are independent."""
    variance = hidden_motion(np.nan_to_num(acceleration.phasors.value), acceleration.observed) ** 2 / 2.0
    # Through the uncertain parameters an unobserved component acts even where its coefficient is zero.
    ways = np.stack([matrix, *(c.change for c in changes)])
    found = {}
    for place, name in enumerate(COMPONENTS):
        if np.any(variance[:, place] > 0.0):
            columns = real_design(ways[..., place, None])
            covariance = np.einsum("wkia,wkja,k->kij", columns, columns, variance[:, place])
            found[name] = Contribution(f"unobserved {name}", "B", covariance)
    return found


def _notices(acceleration: Acceleration, observed: BoolArray, hidden: Mapping[str, Contribution]) -> tuple[Notice, ...]:
    """Say which load components rest on assumed zeros and which are not given."""
    found = []
    assumed = [name for name, part in hidden.items() if np.any((total_variance(part.covariance) > 0.0) & observed)]
    if assumed:
        text = (
            f"{', '.join(assumed)} of the load were not observed at some lines: taken as zero with a standard "
            f"uncertainty of {UNOBSERVED_MOTION:.0%} of the motion (rotations: over {BODY_SIZE_M} m)"
        )
        found.append(Notice("warning", text, acceleration.body))
    missing = [name for place, name in enumerate(LOAD_COMPONENTS) if not np.any(observed[:, place])]
    if missing:
        text = f"no value of {', '.join(missing)}: components of the motion that were not observed may dominate them"
        found.append(Notice("info", text, "load"))
    return tuple(found)


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
