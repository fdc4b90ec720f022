"""Whether instruments agree: each against the others' prediction, and their scatter beyond what is stated."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import brentq
from scipy.stats import chi2 as chi_square

from fusion.estimate import BODY_SIZE_M, SCALE, Solution, System, real_design, real_rows, real_stack
from fusion.observe import Observation

FloatArray = NDArray[np.float64]
ComplexArray = NDArray[np.complex128]
IntArray = NDArray[np.int64]

TEST_LEVEL = 0.99
RANK_TOLERANCE = 1e-11
DISCREPANCY_RANGE = (1e-9, 10.0)


@dataclass(frozen=True)
class Consistency:
    """How one instrument agrees with the prediction of all others.

    `normalised_deviation`: root of chi-square per degree of freedom of the leave-one-out difference (1 is expected,
    NaN where the others cannot predict it); `channels` of it; `used` in the fused estimate or only compared;
    `ratio`: measured over predicted at its largest reading, complex, NaN where it has no prediction.
    """

    instrument: str
    normalised_deviation: float
    channels: int
    used: bool = True
    ratio: complex = complex(np.nan, np.nan)


def fails(chi2: float, dof: int) -> bool:
    """Return whether chi-square is beyond its 99 % quantile."""
    return dof > 0 and chi2 > float(chi_square.ppf(TEST_LEVEL, dof))


def leave_one_out(system: System, solution: Solution) -> tuple[Consistency, ...]:
    """Return for each member its readings against what all others predict for them.

    With q = P y the difference is d = P_II^-1 q_I with covariance P_II^-1 (deletion formula of generalised least
    squares), so that no fit is repeated; chi-square is q_I^T P_II^+ q_I on the rank of P_II.
    """
    sizes = np.sqrt(np.diag(solution.noise))
    projector = solution.projector * np.outer(sizes, sizes)
    weighted = projector @ (system.readings / sizes)
    found = []
    for member, name in enumerate(system.member_names):
        rows = np.flatnonzero(system.member == member)
        values, vectors = np.linalg.eigh(projector[np.ix_(rows, rows)])
        kept = values > RANK_TOLERANCE
        turned = vectors[:, kept].T @ weighted[rows]
        channels = sum(o.members.count(name) for o in system.observations)
        deviation, ratio = np.nan, complex(np.nan, np.nan)
        if np.any(kept):
            deviation = float(np.sqrt(np.sum(turned**2 / values[kept]) / np.count_nonzero(kept)))
        if np.all(kept) and len(rows):
            difference = sizes[rows] * (vectors @ (turned / values))
            ratio = _largest_ratio(system, rows, system.readings[rows] - difference)
        found.append(Consistency(name, deviation, channels, True, ratio))
    return tuple(found)


def _largest_ratio(system: System, rows: IntArray, predicted: FloatArray) -> complex:
    """Measured over predicted phasor of the row pair (Re, Im) of a member with the largest prediction."""
    measured, best, size = system.readings[rows], complex(np.nan, np.nan), 0.0
    keys = np.stack([system.line[rows], system.observation[rows]], axis=1)
    for key in np.unique(keys, axis=0):
        both = np.flatnonzero(np.all(keys == key, axis=1)).reshape(2, -1)
        true = predicted[both[0]] + 1j * predicted[both[1]]
        place = int(np.argmax(np.abs(true)))
        if abs(true[place]) > size:
            size = float(abs(true[place]))
            best = complex((measured[both[0][place]] + 1j * measured[both[1][place]]) / true[place])
    return best


def compare(observation: Observation, acceleration: ComplexArray, covariance: FloatArray) -> tuple[Consistency, ...]:
    """Return how the members of an instrument that was not fused agree with A (K, 6) and its covariance (K, 12, 12)."""
    found = []
    names = np.array(observation.members)
    for name in dict.fromkeys(observation.members):
        chi2, count, size, ratio = 0.0, 0, 0.0, complex(np.nan, np.nan)
        for k, value in enumerate(observation.phasors.value):
            rows = np.flatnonzero((names == name) & np.isfinite(value))
            design = observation.design[k, rows]
            usable = np.all((design == 0.0) | np.isfinite(acceleration[k]), axis=1)
            rows, design = rows[usable], design[usable]
            predicted = design @ np.nan_to_num(acceleration[k])
            both = np.concatenate([rows, rows + len(names)])
            jacobian = real_design(design)
            spread = observation.phasors.covariance[k][np.ix_(both, both)]
            spread = spread + jacobian @ np.nan_to_num(covariance[k]) @ jacobian.T
            difference = real_stack(value[rows] - predicted)
            chi2 += float(difference @ np.linalg.pinv(spread, rcond=1e-12, hermitian=True) @ difference)
            count += len(both)
            place = int(np.argmax(np.abs(predicted))) if len(rows) else -1
            if place >= 0 and abs(predicted[place]) > size:
                size = float(abs(predicted[place]))
                ratio = complex(value[rows[place]] / predicted[place])
        deviation = float(np.sqrt(chi2 / count)) if count else np.nan
        found.append(Consistency(name, deviation, int(np.sum(names == name)), False, ratio))
    return tuple(found)


def discrepancy(system: System, solution: Solution) -> FloatArray:
    """Return (N,) standard deviations that make every failing line consistent, zero in lines that pass.

    A reading of one line gets tau times the motion's size at the instrument (translation and 0.1 m times rotation),
    tau such that chi-square of that line alone equals its degrees of freedom (Paule & Mandel 1982, J. Res. NBS 87, 377,
    with the common errors kept in the covariance).
    """
    sizes = _row_sizes(system.observations, solution.acceleration)
    found = np.zeros(len(system.readings))
    for line in np.unique(system.line):
        rows = np.flatnonzero(system.line == line)
        design = system.design[rows]
        design = design[:, np.any(design != 0.0, axis=0)]
        spread = solution.noise[np.ix_(rows, rows)] + solution.effects[rows] @ solution.effects[rows].T
        dof = len(rows) - design.shape[1]
        args = (system.readings[rows], design, spread, sizes[rows])
        if not fails(_chi2(-np.inf, *args), dof):
            continue
        low, high = np.log(DISCREPANCY_RANGE)
        inside = _chi2(low, *args) > dof > _chi2(high, *args)
        log_tau = float(brentq(lambda t, a=args, d=dof: _chi2(t, *a) - d, low, high, xtol=1e-3)) if inside else high
        found[rows] = np.exp(log_tau) * sizes[rows]
    return found


def _row_sizes(observations: Sequence[Observation], acceleration: ComplexArray) -> FloatArray:
    """Size of the motion in each real row's unit: the estimate's or, if larger, the largest reading's."""
    size = np.linalg.norm(acceleration / SCALE, axis=1)
    factors = []
    for observation in observations:
        shift = np.linalg.norm(observation.design[..., :3], axis=2)
        turn = np.linalg.norm(observation.design[..., 3:], axis=2) / BODY_SIZE_M
        factors.append(np.where(shift > 0.0, shift, turn))
        readings = np.nan_to_num(np.abs(observation.phasors.value)) / factors[-1]
        size = np.maximum(size, np.max(readings, axis=1))
    return np.concatenate(
        [real_rows(o, factor * size[:, None] * (1.0 + 1.0j)) for o, factor in zip(observations, factors, strict=True)]
    )


def _chi2(log_tau: float, readings: FloatArray, design: FloatArray, spread: FloatArray, sizes: FloatArray) -> float:
    """Minimum chi-square of one line with the additional standard deviations exp(log_tau) · sizes."""
    root = np.linalg.cholesky(spread + np.diag((np.exp(log_tau) * sizes) ** 2))
    white = np.linalg.solve(root, np.column_stack([design, readings]))
    white[:, :-1] /= np.linalg.norm(white[:, :-1], axis=0)
    basis = np.linalg.qr(white[:, :-1])[0]
    residual = white[:, -1] - basis @ (basis.T @ white[:, -1])
    return float(residual @ residual)
