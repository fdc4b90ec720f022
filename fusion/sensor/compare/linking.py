"""Laboratories of a comparison: repeated results, stability of the artefact, rounds linked by a pilot.

Every step is a linear map of the logarithms of magnitudes, and of phases. Values and their errors pass through the same
map, so that all correlations are included afterwards.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from scipy.special import chdtrc

from fusion.sensor.compare.comparison_inputs import ComparedValue
from fusion.sensor.compare.consistency import SIGNIFICANCE, SharedInput, drift, weighted_mean
from shakercal._common.arrays import FloatArray

QUANTITIES = ("magnitude", "phase")
LINK, ARTEFACT = "link of rounds", "drift of the artefact"
"""Evidence of the errors that results have in common by the evaluation."""
NEGLIGIBLE = 1e-9
"""Share of the largest effect of an error below which it cancels: rounding."""


class Participant(NamedTuple):
    """Round, laboratory and day that a result's name states: `rc/ptb@2024-03-01`.

    Parts that it does not state are empty.
    """

    round: str
    laboratory: str
    day: str

    @classmethod
    def of(cls, name: str) -> Participant:
        """Return the parts of a name."""
        before, _, laboratory = name.rpartition("/")
        laboratory, _, day = laboratory.partition("@")
        return cls(before, laboratory, day)

    @property
    def name(self) -> str:
        """Return round and laboratory without the day."""
        return "/".join(filter(None, (self.round, self.laboratory)))


@dataclass(frozen=True)
class ComparedGroup:
    """N values of one element at one frequency, and the inputs that correlate them.

    `acting`: inputs with effects (N, 2) for one standard uncertainty, on relative magnitudes and on phases (rad).
    """

    names: tuple[str, ...]
    values: tuple[ComparedValue, ...]
    acting: tuple[tuple[SharedInput, FloatArray], ...]

    @property
    def participants(self) -> list[Participant]:
        """Return the participant of each value."""
        return [Participant.of(name) for name in self.names]

    @property
    def coordinates(self) -> FloatArray:
        """Return logarithms of magnitudes, and phases (N, 2) unwrapped in each round.

        NaN without a phase.
        """
        found = np.array([[np.log(v.magnitude), np.nan if v.phase_rad is None else v.phase_rad] for v in self.values])
        rounds = np.array([participant.round for participant in self.participants])
        for name in dict.fromkeys(rounds.tolist()):
            phase = found[rounds == name, 1]
            first = phase[np.isfinite(phase)][:1]
            if len(first):
                found[rounds == name, 1] = first + np.angle(np.exp(1j * (phase - first)))
        return found

    @property
    def effects(self) -> FloatArray:
        """Return the effects (S, N, 2) of the inputs."""
        return np.array([effect for _, effect in self.acting]).reshape(-1, len(self.names), 2)

    @property
    def individual(self) -> FloatArray:
        """Return the standard uncertainty (N, 2) of each value without the inputs."""
        u = np.array([[v.u_magnitude / v.magnitude, v.u_phase_rad] for v in self.values])
        return np.asarray(np.sqrt(np.maximum(u**2 - np.sum(self.effects**2, axis=0), 0.0)))

    def covariance(self, column: int) -> FloatArray:
        """Return the covariance (N, N) of log magnitudes (0) or phases (1)."""
        effects = self.effects[:, :, column]
        return np.asarray(np.diag(self.individual[:, column] ** 2) + effects.T @ effects)

    def mapped(self, names: Sequence[str], maps: FloatArray, evidence: str, years: Sequence[float]) -> ComparedGroup:
        """Return the group after a linear map (2, M, N) of its coordinates.

        The error of a value that enters several new values becomes an input that they share.
        """
        old, own = self.coordinates, self.individual
        lost = (maps != 0.0) & np.isnan(old.T[:, None, :])
        new = np.einsum("cmn,nc->mc", maps, np.nan_to_num(old))
        new[lost.any(axis=-1).T] = np.nan
        renamed = {name: Participant.of(name).name for name in self.names}
        first = [int(np.flatnonzero(row)[0]) for row in maps[0]]
        acting = []
        for item, effect in self.acting:
            unknowns = {renamed.get(name, name): unknown for name, unknown in item.unknowns.items()}
            acting.append((replace(item, unknowns=unknowns), np.einsum("cmn,nc->mc", maps, np.nan_to_num(effect))))
        variance = sum((effect**2 for _, effect in acting), np.zeros(new.shape))
        variance = variance + np.einsum("cmn,nc->mc", maps**2, np.nan_to_num(own) ** 2)
        for n, column in np.ndindex(own.shape):
            reached = np.flatnonzero(maps[column, :, n])
            if len(reached) > 1 and own[n, column] > 0.0:
                effect = np.zeros(new.shape)
                effect[:, column] = maps[column, :, n] * own[n, column]
                unknowns = {names[m]: f"{QUANTITIES[column]} of {self.names[n]}" for m in reached.tolist()}
                acting.append((SharedInput(f"result of {self.names[n]}", evidence, unknowns, proven=False), effect))
        values = [
            replace(
                self.values[at],
                magnitude=float(np.exp(coordinate[0])),
                u_magnitude=float(np.exp(coordinate[0]) * u[0]),
                phase_rad=None if np.isnan(coordinate[1]) else float(coordinate[1]),
                u_phase_rad=float(u[1]) if np.isfinite(coordinate[1]) else np.nan,
                year=float(year),
            )
            for at, coordinate, u, year in zip(first, new, np.sqrt(variance), years, strict=True)
        ]
        for _, effect in acting:
            effect[np.abs(effect) < NEGLIGIBLE * np.sqrt(variance)] = 0.0
        return ComparedGroup(tuple(names), tuple(values), tuple(acting))


class ArtefactStability(NamedTuple):
    """Change per year of an artefact by repeated results of one laboratory.

    Relative for magnitudes, rad for phases. `p`: probability of a change at least as large without any drift.
    `removed`: whether it is refuted that the artefact is stable, and the change removed.
    """

    value: ComparedValue
    quantity: str
    laboratory: str
    repeats: int
    per_year: float
    u_per_year: float
    p: float
    removed: bool


class RoundLink(NamedTuple):
    """Link of a round to the first.

    `transfer`: ratio of the artefacts, or difference of their phases (rad), with u. `p`: of χ² of the
    differences of several linking laboratories, NaN of one.
    """

    value: ComparedValue
    quantity: str
    round: str
    laboratories: tuple[str, ...]
    transfer: float
    u: float
    p: float


# Repeated results of one laboratory.


def merge_repeats(group: ComparedGroup) -> tuple[ComparedGroup, list[ArtefactStability]]:
    """Return one value of every laboratory and round, and the stability of the artefact.

    A drift of the artefact that the repeats of one laboratory show is removed, with its uncertainty, from all values of
    its round. Repeats are then merged to their weighted mean.
    """
    participants = group.participants
    names = list(dict.fromkeys(participant.name for participant in participants))
    if tuple(names) == group.names:
        return group, []
    year = np.array([value.year for value in group.values])
    found, maps = [], np.zeros((2, len(names), len(participants)))
    for column in range(len(QUANTITIES)):
        usable = np.isfinite(group.coordinates[:, column])
        covariance, removal = group.covariance(column), np.eye(len(participants))
        for name in dict.fromkeys(participant.round for participant in participants):
            of_round = np.array([participant.round == name for participant in participants]) & usable
            stability, weights = _stability(group, column, of_round)
            if stability is None:
                continue
            found.append(stability)
            if stability.removed:
                pilot = weights != 0.0
                since = np.where(of_round, year - year[pilot].mean(), 0.0)
                removal -= np.outer(since, weights)
        for row, name in enumerate(names):
            own = np.array([participant.name == name for participant in participants])
            mean = np.flatnonzero(own & usable if (own & usable).any() else own)
            # Of the drifting pilot, this is the straight line by generalised least squares at the mean date.
            share = weighted_mean(np.zeros(len(mean)), covariance[np.ix_(mean, mean)])[2] if len(mean) > 1 else [1.0]
            maps[column, row] = np.asarray(share) @ removal[mean]
    years = [float(np.mean([y for y, p in zip(year, participants, strict=True) if p.name == name])) for name in names]
    return group.mapped(names, maps, ARTEFACT, years), found


def _stability(
    group: ComparedGroup, column: int, of_round: np.typing.NDArray[np.bool_]
) -> tuple[ArtefactStability | None, FloatArray]:
    """Return the drift by the laboratory with most dated results, and its weights (N,)."""
    year, weights = np.array([value.year for value in group.values]), np.zeros(len(group.names))
    dated: dict[str, list[int]] = {}
    for index in np.flatnonzero(of_round & np.isfinite(year)):
        dated.setdefault(group.participants[index].name, []).append(int(index))
    name, repeats = max(dated.items(), key=lambda entry: len(entry[1]), default=("", []))
    if len(np.unique(year[repeats])) < 2:
        return None, weights
    covariance, at = group.covariance(column)[np.ix_(repeats, repeats)], year[repeats]
    weights[repeats] = [drift(at, unit, covariance)[0] for unit in np.eye(len(repeats))]
    slope, u = drift(at, group.coordinates[repeats, column], covariance)
    p = float(chdtrc(1.0, (slope / u) ** 2))
    # A value without a date cannot be corrected: a drift is then only reported.
    removed = p < SIGNIFICANCE and bool(np.isfinite(year[of_round]).all())
    return ArtefactStability(group.values[0], QUANTITIES[column], name, len(repeats), slope, u, p, removed), weights


# Rounds linked by laboratories that took part in several of them.


def linking_laboratories(names: Sequence[str], selected: Sequence[str] = ()) -> frozenset[str]:
    """Return the laboratories in several rounds, or those `selected` of them."""
    rounds: dict[str, set[str]] = {}
    for participant in map(Participant.of, names):
        rounds.setdefault(participant.laboratory, set()).add(participant.round)
    several = {name for name, found in rounds.items() if len(found) > 1}
    return frozenset(several & set(selected) if selected else several)


def linked_rounds(names: Sequence[str], links: frozenset[str], first: str) -> set[str]:
    """Return the rounds that linking laboratories connect with the first, directly or by others."""
    participants, found = [Participant.of(name) for name in names], {first}
    while True:
        known = {p.laboratory for p in participants if p.round in found and p.laboratory in links}
        more = {p.round for p in participants if p.laboratory in known} - found
        if not more:
            return found
        found |= more


def link_rounds(group: ComparedGroup, links: frozenset[str], first: str) -> tuple[ComparedGroup, list[RoundLink]]:
    """Return all values transferred to the artefact of the first round, and the links.

    Generalised least squares with one artefact per round and one deviation per linking laboratory. A linking laboratory
    has its value in its first round only. All rounds must be linked (`linked_rounds`).
    """
    participants = group.participants
    others = [name for name in dict.fromkeys(p.round for p in participants) if name != first]
    if not others:
        return group, []
    found, names, transfers = [], list[str](), []
    for column, quantity in enumerate(QUANTITIES):
        usable = np.isfinite(group.coordinates[:, column])
        transfer, p = _transfers(group, column, others, links, usable)
        transfers.append(transfer)
        u = np.sqrt(np.einsum("rn,nm,rm->r", transfer, np.nan_to_num(group.covariance(column)), transfer))
        change = transfer @ np.nan_to_num(group.coordinates[:, column])
        for row in np.flatnonzero(transfer.any(axis=1)).tolist():
            by = dict.fromkeys(participants[n].laboratory for n in np.flatnonzero(transfer[row]))
            # The ratio of magnitudes and its u; phases differ by a sum.
            size = np.exp(change[row]) if column == 0 else 1.0
            shift = size if column == 0 else float(np.angle(np.exp(1j * change[row])))
            link = group.values[0], quantity, others[row], tuple(by), float(shift), float(size * u[row]), p
            found.append(RoundLink(*link))
    rows_used, seen = [], set[str]()
    for n in sorted(range(len(participants)), key=lambda n: participants[n].round != first):
        if participants[n].laboratory not in seen:
            rows_used.append(n)
            names.append(group.names[n])
        seen |= {participants[n].laboratory} & links
    maps = np.stack([np.eye(len(participants))[rows_used]] * 2)
    for row, n in enumerate(rows_used):
        if participants[n].round != first:
            for column in range(2):
                of_round = transfers[column][others.index(participants[n].round)]
                # Without a link of phases, the phase is not transferred.
                maps[column, row] -= of_round if of_round.any() else np.nan
    years = [group.values[n].year for n in rows_used]
    return group.mapped(names, maps, LINK, years), found


def _transfers(
    group: ComparedGroup,
    column: int,
    others: Sequence[str],
    links: frozenset[str],
    usable: np.typing.NDArray[np.bool_],
) -> tuple[FloatArray, float]:
    """Return weights (R, N) of the differences from the first artefact, and p."""
    participants = group.participants
    rows = [n for n, p in enumerate(participants) if p.laboratory in links and usable[n]]
    laboratories = list(dict.fromkeys(participants[n].laboratory for n in rows))
    design = np.zeros((len(rows), len(others) + len(laboratories)))
    for row, n in enumerate(rows):
        if participants[n].round in others:
            design[row, others.index(participants[n].round)] = 1.0
        design[row, len(others) + laboratories.index(participants[n].laboratory)] = 1.0
    weights = np.zeros((len(others), len(participants)))
    if np.linalg.matrix_rank(design) < design.shape[1]:
        return weights, np.nan
    inverse = np.linalg.inv(group.covariance(column)[np.ix_(rows, rows)])
    solution = np.linalg.solve(design.T @ inverse @ design, design.T @ inverse)
    weights[:, rows] = np.where(np.abs(solution) < NEGLIGIBLE, 0.0, solution)[: len(others)]
    values = group.coordinates[rows, column]
    residual, dof = values - design @ (solution @ values), len(rows) - design.shape[1]
    return weights, float(chdtrc(float(dof), float(residual @ inverse @ residual))) if dof else np.nan
