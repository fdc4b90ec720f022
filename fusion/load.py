"""The load at the sensor origin: mass matrix and gravity tilt applied to the acceleration, with its budget."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from fusion.body import COMPONENTS, Body, BodyParameter
from fusion.estimate import BODY_SIZE_M, UNOBSERVED_MOTION, hidden_motion
from fusion.fuse import Acceleration, Contribution
from fusion.notices import AnyNotice, Notice
from shaker.signals.phasor import Phasors

FloatArray = NDArray[np.float64]
ComplexArray = NDArray[np.complex128]
BoolArray = NDArray[np.bool_]

LOAD_COMPONENTS = ("Fx", "Fy", "Fz", "Mx", "My", "Mz")
LOAD_UNITS = ("N", "N", "N", "N.m", "N.m", "N.m")
UNOBSERVED_LIMIT = 0.01
"""Largest relative standard uncertainty that unobserved components may bring to a load component."""


@dataclass(frozen=True)
class LoadResult:
    """Wrench phasors at the sensor origin (K, 6) in N and N.m, NaN where not `observed` (K, 6), and their budget."""

    phasors: Phasors
    observed: BoolArray
    contributions: tuple[Contribution, ...]
    notices: tuple[AnyNotice, ...]


def load_phasors(
    acceleration: Acceleration,
    body: Body,
    gravity_mps2: ArrayLike | None = None,
    sense: Literal["on_load", "on_sensor"] = "on_load",
) -> LoadResult:
    """Return the wrench L = ±(M A + gravity tilt) at the sensor origin, positive as it acts on the load ("on_load").

    Its covariance is that of the acceleration carried through, contribution by contribution, plus one term per
    uncertain parameter of the body, (dM/dp · A) u(p). Acceleration components that no instrument observed are taken as
    zero with a standard uncertainty of 2 % of the observed motion's amplitude (rotations: of amplitude over 0.1 m), a
    type B contribution "unobserved NAME"; a load component to which they bring more than 1 % is not given.
    """
    frequency = acceleration.phasors.frequency_hz
    gravity = None if gravity_mps2 is None else np.asarray(gravity_mps2, dtype=np.float64)
    sign = {"on_load": 1.0, "on_sensor": -1.0}[sense]
    matrix = sign * body.terms.load_matrix(frequency, gravity)
    known = np.nan_to_num(acceleration.phasors.value)
    value = np.einsum("kij,kj->ki", matrix, known)
    parameters = body.parameters()
    changes = [(p, sign * p.change.load_matrix(frequency, gravity)) for p in parameters]
    hidden = _hidden_variances(acceleration, matrix, [change for _, change in changes])
    spread = np.sqrt(2.0 * hidden.sum(axis=2))
    size = np.abs(value)
    observed = np.any(acceleration.observed, axis=1)[:, None] & (spread <= UNOBSERVED_LIMIT * size)
    contributions = [
        Contribution(c.label, c.type, carry(matrix, np.nan_to_num(c.covariance))) for c in acceleration.contributions
    ]
    contributions += _parameter_contributions(changes, known) + _hidden_contributions(hidden)
    mask = ~np.tile(observed, (1, 2))
    contributions = [Contribution(c.label, c.type, _hide(c.covariance, mask)) for c in contributions]
    phasors = Phasors(
        frequency_hz=frequency,
        value=np.where(observed, value, complex(np.nan, np.nan)),
        covariance=_hide(np.sum([c.covariance for c in contributions], axis=0), mask),
        channels=LOAD_COMPONENTS,
        unit=LOAD_UNITS,
        dof=_load_dof(acceleration, contributions, value),
    )
    return LoadResult(phasors, observed, tuple(contributions), _notices(acceleration, observed, hidden))


def carry(matrix: FloatArray, covariance: FloatArray) -> FloatArray:
    """Return the real-stacked covariance (K, 12, 12) of real matrices (K, 6, 6) times complex vectors."""
    both = np.zeros((len(matrix), 12, 12))
    both[:, :6, :6] = both[:, 6:, 6:] = matrix
    return np.asarray(both @ covariance @ both.swapaxes(1, 2))


def _hide(covariance: FloatArray, hidden: BoolArray) -> FloatArray:
    """NaN in the rows and columns of components that are not given."""
    return np.where(hidden[:, :, None] | hidden[:, None, :], np.nan, covariance)


def _parameter_contributions(
    changes: Sequence[tuple[BodyParameter, FloatArray]], acceleration: ComplexArray
) -> list[Contribution]:
    """One type B contribution per label of the body's parameters."""
    merged: dict[str, FloatArray] = {}
    for parameter, change in changes:
        effect = np.einsum("kij,kj->ki", change, acceleration)
        column = np.concatenate([effect.real, effect.imag], axis=1)
        covariance = column[:, :, None] * column[:, None, :]
        merged[parameter.label] = merged.get(parameter.label, 0.0) + covariance
    return [Contribution(label, "B", covariance) for label, covariance in merged.items()]


def _hidden_variances(acceleration: Acceleration, matrix: FloatArray, changes: Sequence[FloatArray]) -> FloatArray:
    """Variance (K, 6 loads, 6 accelerations) of real and of imaginary part from components nobody observed."""
    # Through the uncertain parameters an unobserved component acts even where its coefficient is zero.
    square = matrix**2 + sum((change**2 for change in changes), np.zeros_like(matrix))
    motion = hidden_motion(np.nan_to_num(acceleration.phasors.value), acceleration.observed)
    variance = motion**2 / 2.0
    return np.asarray(square * variance[:, None, :])


def _hidden_contributions(hidden: FloatArray) -> list[Contribution]:
    """One type B contribution per unobserved component; its real and imaginary parts are independent."""
    found = []
    for place, name in enumerate(COMPONENTS):
        if np.any(hidden[:, :, place] > 0.0):
            diagonal = np.tile(hidden[:, :, place], (1, 2))
            found.append(Contribution(f"unobserved {name}", "B", diagonal[:, :, None] * np.eye(12)))
    return found


def _load_dof(acceleration: Acceleration, contributions: Sequence[Contribution], value: ComplexArray) -> FloatArray:
    """Degrees of freedom (K,) of the largest force: those of the acceleration, diluted by the share of the rest."""
    lines = np.arange(len(value))
    weight = np.abs(np.nan_to_num(value)) / np.where(np.arange(6) < 3, 1.0, BODY_SIZE_M)
    component = np.argmax(weight, axis=1)
    from_motion, total = np.zeros(len(value)), np.zeros(len(value))
    inherited = {contribution.label for contribution in acceleration.contributions}
    for entry in contributions:
        variance = entry.covariance[lines, component, component] + entry.covariance[lines, component + 6, component + 6]
        total += variance
        from_motion += variance if entry.label in inherited else 0.0
    share = np.divide(total, from_motion, out=np.ones(len(value)), where=from_motion > 0.0)
    return np.asarray(acceleration.phasors.dof * share**2)


def _notices(acceleration: Acceleration, observed: BoolArray, hidden: FloatArray) -> tuple[Notice, ...]:
    """Say which load components rest on assumed zeros and which are not given."""
    found = []
    assumed = [name for place, name in enumerate(COMPONENTS) if np.any((hidden[:, :, place] > 0.0) & observed)]
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
