"""The recordings that lower U of stated matrix elements most per hour."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import islice, product
from typing import NamedTuple

import numpy as np
from scipy.linalg import cho_factor, cho_solve, solve_triangular

from fusion.campaign.excited_line import FREQUENCY_TOLERANCE, LOADS
from fusion.campaign.line_stack import Stack, stack_drives
from fusion.campaign.matrix import MatrixFit
from fusion.campaign.matrix_solve import reading_model
from fusion.campaign.recording_results import RecordingResults
from fusion.campaign.unknowns import as_stated
from fusion.estimation.coverage import Polar
from fusion.estimation.uncertainty import Influence, Uncertainty, polar_elements, real_stack
from shakercal._common.arrays import ComplexArray, FloatArray, IntArray

LONGER, POINTS, HEAVIER = 4, 2, 2
"""Length, number of measuring points and moved mass of a candidate over those of the present recording (chosen)."""
WORTH = 0.05
"""Share of a variance from which on an exchange of the mass or instrument is a candidate (chosen)."""
LEAST_GAIN = 1e-3
"""Smallest decrease of the criterion for which a recording is proposed (chosen)."""
EXCHANGES = 20
"""Largest number of exchanges; a few are usual."""
ENDLESS = 1e5
"""Number of repeats that stands for infinitely many."""
ROUNDING = 1e-9
"""Relative tolerance of the available time."""
OTHER = " (another)"
"""Suffix of the names of unknowns of an exchanged mass or instrument."""
OF_PARTS = (": mass", ": inertia")
"""Ends of the labels of unknowns of the rig that belong to a part of the load."""
INTERNAL = "internal mass"
"""Beginning of the names of unknowns of the sensor's own mass, which no exchange changes."""
HEAD = "head "
"""Beginning of the names of unknowns of a head, which all its points share."""
Element = tuple[str, int]
"""Output channel, and index of the load component."""


@dataclass(frozen=True)
class Minutes:
    """Durations of changes of the rig, in minutes.

    A new `mounting`; alignment of as many `points` again; `exchange` of a mass or an instrument.
    """

    mounting: float = 20.0
    points: float = 15.0
    exchange: float = 30.0


@dataclass(frozen=True)
class Candidate:
    """A possible further recording: that of `folder`, mounted anew, with one change.

    `change`: what differs, in words; empty for the same again. `longer`, `points`, `heavier`: factors of its length, of
    the number of its measuring points, and of the whole moved mass by parts of their own, with equal acceleration and
    relative uncertainties. `exchanged`: beginning of the names of unknowns that another mass or instrument has of its
    own.
    """

    folder: str
    minutes: float
    change: str = ""
    longer: int = 1
    points: int = 1
    heavier: int = 1
    exchanged: str = ""


def list_candidates(
    recorded: Sequence[RecordingResults],
    length_s: Mapping[str, float],
    groups: Sequence[str],
    minutes: Minutes,
) -> tuple[Candidate, ...]:
    """Return the candidates: every direction and load again, longer, with more points, with exchanges.

    `length_s`: length of each recording by its folder; `groups`: masses and instruments to exchange.
    """
    once = dict[object, RecordingResults]()
    for entry in recorded:
        for drive in entry.excited_lines[:1]:
            parts = frozenset(one.name for one in drive.load_uncertainty.influences if "centre of mass" in one.label)
            once[drive.direction, parts] = entry
    found = []
    for entry in once.values():
        record = length_s.get(entry.folder, 0.0) / 60.0
        usual = minutes.mounting + record
        same = Candidate(entry.folder, usual)
        more = [replace(same, minutes=usual + (LONGER - 1) * record, change=f"{LONGER} times as long", longer=LONGER)]
        if entry.knowledge is not None:
            text = f"{POINTS} times as many points"
            more.append(replace(same, minutes=usual + minutes.points, change=text, points=POINTS))
        other = replace(same, minutes=usual + minutes.exchange)
        more.append(replace(other, change=f"{HEAVIER} times the mass", heavier=HEAVIER))
        found += [same, *more, *(replace(other, change=f"another {one}", exchanged=f"{one}: ") for one in groups)]
    return tuple(found)


class _PartialInformation(NamedTuple):
    """Information (12C + A, 12C + A) about matrix and A unknowns by name."""

    names: tuple[str, ...]
    information: FloatArray


@dataclass(frozen=True)
class JointInformation:
    """Information about E stated elements and shared unknowns at one frequency.

    `base` (P, P): of the recordings and of the stated uncertainties; `added` (Q, P, P): of each candidate. The first
    12C of P unknowns are [Re, Im] of the matrix, then those of `unknowns` (group, label). `rows` (E, P): magnitudes of
    the elements. `present` (E): their values with present U.
    """

    frequency_hz: float
    base: FloatArray
    added: FloatArray
    unknowns: tuple[tuple[str, str], ...]
    rows: FloatArray
    present: tuple[Polar, ...]

    @property
    def elements(self) -> int:
        """Number of parameters of the matrix, 12C."""
        return len(self.base) - len(self.unknowns)

    def covariance(self, counts: FloatArray | IntArray, further: FloatArray | float = 0.0) -> FloatArray:
        """Return the covariance (E, P) of elements and unknowns with `counts` (Q,) of the candidates.

        `further` (P, P) or 0: information of another source.
        """
        chosen = np.flatnonzero(counts)
        total = self.base + np.tensordot(np.asarray(counts, np.float64)[chosen], self.added[chosen], 1) + further
        size = 1.0 / np.sqrt(np.diagonal(total))
        factor = cho_factor(total * np.outer(size, size))
        return np.asarray(cho_solve(factor, (self.rows * size).T).T * size)

    def variance(self, counts: FloatArray | IntArray, further: FloatArray | float = 0.0) -> FloatArray:
        """Return the variances (E,) with `counts` (Q,) of the candidates."""
        return np.asarray(np.sum(self.covariance(counts, further) * self.rows, axis=1))

    def shares(self, counts: FloatArray | IntArray, part: int) -> dict[str, FloatArray]:
        """Return shares (E,) of shared unknowns in the variances.

        By label (`part` 1) or group (0). The estimate contains c·ε of an unknown with unit prior if c is its covariance
        with the element.
        """
        covariance = self.covariance(counts)
        variance = np.sum(covariance * self.rows, axis=1)
        found: dict[str, FloatArray] = {}
        for about, effect in zip(self.unknowns, covariance[:, self.elements :].T, strict=True):
            found[about[part]] = found.get(about[part], np.zeros(len(variance))) + effect**2 / variance
        return found

    def halved(self, counts: FloatArray | IntArray, label: str) -> FloatArray:
        """Return the variances (E,) with half the u of the unknowns of one label."""
        further = [3.0 * (about[1] == label) for about in self.unknowns]
        return self.variance(counts, np.diag([*np.zeros(self.elements), *further]))


def joint_information(
    recorded: Sequence[RecordingResults],
    fits: Sequence[MatrixFit],
    elements: Sequence[Element],
    candidates: Sequence[Candidate],
) -> tuple[JointInformation, ...]:
    """Return the information about elements at every frequency of a matrix.

    A reading y = (1 + ρ·ε)∘(S·L) of a load l = L + E·ε + noise is linear in S and in the shared unknowns ε with unit
    prior. Recordings are independent for given ε, so their information adds up (Plackett 1950, Biometrika 37, 149).
    Unknowns of one mounting are eliminated. `recorded`: with unique names, and without `knowledge` if the campaign does
    not use it.
    """
    base, mounted = [as_stated(entry) for entry in recorded], dict[str, list[RecordingResults]]()
    source = {entry.folder: entry for entry in base}
    for entry in base:
        mounted.setdefault(entry.mounting, []).append(entry)
    further = [_virtual(source[one.folder], one, f"next {number}") for number, one in enumerate(candidates, 1)]
    groups = [*mounted.values(), *([entry] for entry in further)]
    changes = [*[Candidate("", 0.0)] * len(mounted), *candidates]
    return tuple(_information(fit, elements, groups, changes, len(mounted)) for fit in fits)


def _virtual(entry: RecordingResults, candidate: Candidate, name: str) -> RecordingResults:
    """Return a candidate as a recording with the readings of its source."""
    descriptions = () if entry.knowledge is None else entry.knowledge().descriptions
    of_points = {name for name, *_, scope, _, _, _ in descriptions if _of_points(name, scope)}

    def of_load(one: Influence) -> Influence:
        internal = one.name.startswith(INTERNAL)
        size = (1.0 if internal else candidate.heavier) / np.sqrt(candidate.points if one.name in of_points else 1.0)
        other_parts = candidate.heavier > 1 and not internal and one.scope == "rig" and one.label.endswith(OF_PARTS)
        name = one.name + OTHER if other_parts else _exchanged(one.name, candidate, one.scope)
        return replace(one, name=name, effect=one.effect * size)

    def of_output(one: Influence) -> Influence:
        return replace(one, name=_exchanged(one.name, candidate, one.scope), effect=one.effect * candidate.heavier)

    longer, heavier = candidate.longer, candidate.heavier
    lines = tuple(
        replace(
            drive, recording=name, mounting=name, start="", load=drive.load * heavier, outputs=drive.outputs * heavier,
            load_uncertainty=_changed(drive.load_uncertainty, heavier**2 / (longer * candidate.points), of_load),
            outputs_uncertainty=_changed(drive.outputs_uncertainty, 1.0 / longer, of_output),
        )
        for drive in entry.excited_lines
    )  # fmt: skip
    return replace(entry, name=name, mounting=name, excited_lines=lines)


def _changed(uncertainty: Uncertainty, noise: float, of: Callable[[Influence], Influence]) -> Uncertainty:
    """Return an uncertainty with `noise` times the variance of its noise, and changed influences."""
    random = (
        replace(one, covariance=one.covariance * (noise if one.type == "A" else 1.0)) for one in uncertainty.random
    )
    return Uncertainty(tuple(random), tuple(map(of, uncertainty.influences)))


def _known(entry: RecordingResults, candidate: Candidate, wide: int) -> _PartialInformation:
    """Return the information of a recording with the changes of a candidate about shared unknowns.

    M = EᵀPE grows with the inverse of the noise. Twice the points have the mean of two independent unknowns of the
    mounting, of half the variance, at twice the information: in its u, that is unchanged.
    """
    if entry.knowledge is None:
        return _PartialInformation((), np.zeros((wide, wide)))
    knowledge = entry.knowledge()
    about = [knowledge.descriptions[index] for index in np.flatnonzero(knowledge.shared).tolist()]
    more = [1 if _of_points(name, scope) else candidate.points for name, *_, scope, _, _, _ in about]
    scale, alone = np.sqrt(candidate.longer * np.array(more)), np.eye(len(about))
    raw = scale[:, None] * (knowledge.inverse - alone) * scale
    information = np.linalg.solve(alone + raw @ knowledge.second_order, raw)
    names = [
        _exchanged(name, candidate, scope) if scope == "rig" else f"{name} [{entry.mounting}]"
        for name, *_, scope, _, _, _ in about
    ]
    return _PartialInformation(tuple(names), np.pad((information + information.T) / 2.0, (wide, 0)))


def _of_points(name: str, scope: str) -> bool:
    """Return whether more measuring points average an unknown of the motion."""
    return scope == "mounting" and not name.startswith(HEAD)


def _exchanged(name: str, candidate: Candidate, scope: str) -> str:
    """Return the name of an unknown in a candidate."""
    own = scope == "rig" and candidate.exchanged and name.startswith(candidate.exchanged)
    return name + OTHER if own else name


def _information(
    fit: MatrixFit,
    elements: Sequence[Element],
    groups: Sequence[Sequence[RecordingResults]],
    changes: Sequence[Candidate],
    mountings: int,
) -> JointInformation:
    """Return the information at one frequency.

    `groups`: recordings of each mounting, then each candidate."""
    near, wide = FREQUENCY_TOLERANCE * fit.frequency_hz, 2 * fit.value.size
    lines = [
        [one for entry in of for one in entry.excited_lines if abs(one.frequency_hz - fit.frequency_hz) < near]
        for of in groups
    ]
    stack = stack_drives([one for of in lines for one in of], fit.channels)
    readings = _readings(stack, fit.value * stack.load_size / stack.output_size[:, None], fit.discrepancy)
    parts = [
        [*islice(readings, len(of)), *(_known(entry, change, wide) for entry in entries)]
        for of, entries, change in zip(lines, groups, changes, strict=True)
    ]
    count = Counter(name for of in parts for name in set().union(*(part.names for part in of)))
    shared = [name for name in count if count[name] > 1]
    found = [_gathered(of, shared, wide) for of in parts]
    index = np.array([fit.channels.index(channel) * LOADS + j for channel, j in elements])
    value, label = fit.value.ravel()[index], {influence.name: influence.label for influence in stack.unknowns}
    both = np.eye(wide + len(shared))[np.concatenate([index, index + wide // 2])]
    (polar,) = polar_elements(value[None], fit.uncertainty.at(index))
    return JointInformation(
        frequency_hz=fit.frequency_hz,
        base=np.sum(found[:mountings], axis=0) + np.diag(np.repeat([0.0, 1.0], [wide, len(shared)])),
        added=np.array(found[mountings:]),
        unknowns=tuple((name.rpartition(": ")[0].partition(": ")[0], label.get(name, name)) for name in shared),
        rows=np.sum(
            real_stack(np.exp(1j * np.angle(value))).reshape(2, -1, 1) * both.reshape(2, len(index), -1), axis=0
        ),
        present=tuple(one for one in polar if one is not None),
    )


def _readings(stack: Stack, matrix: ComplexArray, discrepancy: float) -> Iterator[_PartialInformation]:
    """Yield the information of every line.

    A disagreement of recordings is an unknown of the mounting and direction."""
    effects, design, noise = reading_model(stack, matrix)
    sizes = discrepancy * np.linalg.norm(stack.load, axis=1)[:, None] * np.max(np.abs(matrix), axis=1)
    for r, drive in enumerate(stack.drives):
        names = [stack.unknowns[place].name for place in stack.acting[r] if place >= 0]
        columns = [design[r], effects[r][:, : len(names)]]
        if discrepancy:
            names += [f"disagreement {place} [{drive.mounting}] {drive.direction}" for place in range(len(noise[r]))]
            columns.append(np.diag(np.tile(sizes[r], 2)) * np.tile(stack.usable[r], 2))
        white = solve_triangular(np.linalg.cholesky(noise[r]), np.concatenate(columns, axis=1), lower=True)
        yield _PartialInformation(tuple(names), white.T @ white)


def _gathered(parts: Sequence[_PartialInformation], shared: Sequence[str], wide: int) -> FloatArray:
    """Return the information (P, P) of some parts about matrix and shared unknowns, others eliminated."""
    names = dict.fromkeys([*shared, *(name for part in parts for name in part.names)])
    place = {name: wide + index for index, name in enumerate(names)}
    size, total = wide + len(shared), np.zeros((wide + len(place), wide + len(place)))
    for part in parts:
        index = np.array([*range(wide), *(place[name] for name in part.names)])
        total[np.ix_(index, index)] += part.information
    alone = total[size:, size:] + np.eye(len(total) - size)
    return np.asarray(total[:size, :size] - total[:size, size:] @ np.linalg.solve(alone, total[size:, :size]))


# The choice among candidates.


def choose(criterion: Callable[[IntArray], float], minutes: Sequence[float], available: float) -> list[int]:
    """Return the candidates that lower a criterion most within the available minutes.

    Each step adds the candidate of the largest decrease per minute. Then single candidates are exchanged while this
    lowers the criterion (Fedorov 1972, Theory of Optimal Experiments). A second start adds those of the largest
    decrease, and the better result counts. `criterion`: of the counts (Q,).
    """
    cost, one_of = np.asarray(minutes, np.float64), np.eye(len(minutes), dtype=np.int64)
    limit = available * (1.0 + ROUNDING)

    def extended(counts: IntArray, per: FloatArray) -> IntArray:
        """Add the candidates of the largest decrease over `per` (Q,) while they fit."""
        while True:
            now = criterion(counts)
            gains = [(now - criterion(counts + one_of[q]), q) for q in np.flatnonzero(counts @ cost + cost <= limit)]
            useful = [(gain / per[q], q) for gain, q in gains if gain > LEAST_GAIN * now]
            if not useful:
                return counts
            counts = counts + one_of[max(useful)[1]]

    def exchanged(counts: IntArray) -> IntArray:
        """Return counts after the single exchanges that lower the criterion."""
        for _ in range(EXCHANGES):
            pairs = product(np.flatnonzero(counts), range(len(cost)))
            swapped = (counts - one_of[out] + one_of[into] for out, into in pairs if into != out)
            best = min((one for one in swapped if one @ cost <= limit), key=criterion, default=counts)
            if not criterion(best) < (1.0 - LEAST_GAIN) * criterion(counts):
                break
            counts = extended(best, cost)
        return counts

    none = np.zeros(len(cost), np.int64)
    counts = min((exchanged(extended(none, per)) for per in (cost, np.ones(len(cost)))), key=criterion)
    ordered, taken = list[int](), np.zeros_like(counts)
    while np.any(taken < counts):
        left = np.flatnonzero(taken < counts).tolist()
        ordered.append(min(left, key=lambda q: (criterion(taken + one_of[q]) - criterion(taken)) / cost[q]))
        taken = taken + one_of[ordered[-1]]
    return ordered


@dataclass(frozen=True)
class Proposal:
    """The proposed recordings in order, of `candidates` (Q), with the joint information at every frequency."""

    elements: tuple[Element, ...]
    candidates: tuple[Candidate, ...]
    information: tuple[JointInformation, ...]
    chosen: tuple[int, ...]

    def counts(self, steps: int) -> IntArray:
        """Return the counts (Q,) after some recordings."""
        return np.bincount(np.array(self.chosen[:steps], np.int64), minlength=len(self.candidates))

    def ratios(self, steps: int) -> FloatArray:
        """Return predicted over present u (F, E) after some recordings."""
        counts = self.counts(steps)
        return np.sqrt([one.variance(counts) / one.variance(0 * counts) for one in self.information])

    @property
    def repeated(self) -> FloatArray:
        """Ratios (F, E) to which u falls if all set-ups are repeated endlessly."""
        endless = np.array([ENDLESS * (not one.change) for one in self.candidates])
        return np.sqrt([one.variance(endless) / one.variance(0 * endless) for one in self.information])


def propose(
    elements: Sequence[Element],
    candidates: Sequence[Candidate],
    information: Sequence[JointInformation],
    available: float,
) -> Proposal:
    """Return the recordings that lower U of elements most within the available minutes.

    The criterion is the mean over elements and frequencies of predicted over present variance: C-optimality for one
    element, else A-optimality with the present variances as weights (Pukelsheim 1993, Optimal Design of Experiments).
    """
    present = [one.variance(np.zeros(len(candidates))) for one in information]

    def criterion(counts: IntArray) -> float:
        pairs = zip(information, present, strict=True)
        return float(np.mean([one.variance(counts) / variance for one, variance in pairs]))

    chosen = choose(criterion, [one.minutes for one in candidates], available)
    return Proposal(tuple(elements), tuple(candidates), tuple(information), tuple(chosen))
