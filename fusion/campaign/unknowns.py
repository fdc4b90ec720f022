"""Joint estimate of the unknowns that recordings share, and the correction of their loads."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from scipy.special import chdtrc

from fusion.campaign.campaign_notices import CONTRADICTING_RECORDINGS, JOINT_UNKNOWNS, RECORDINGS_WITHOUT_ESTIMATE
from fusion.campaign.excited_line import SECOND_ORDER, ExcitedLine, Knowledge, LazyUncertainty, UnknownDescription
from fusion.campaign.recording_results import RecordingResults
from fusion.estimation.instrument_consistency import UNTESTABLE_SHARE
from fusion.estimation.uncertainty import Contribution, Influence, Uncertainty, as_complex
from fusion.estimation.variance_components import TEST_CONFIDENCE
from shakercal._common.arrays import FloatArray, IntArray
from shakercal._common.notices import Notice

AS_STATED = 0.95
"""Ratio of the joint to the stated standard uncertainty above which an unknown counts as stated (chosen)."""
NOISE = "noise of the joint estimate of unknowns"
"""Label of the noise of all recordings in their joint estimate of unknowns."""
ROUNDING = 1e-12
"""Relative eigenvalue below which a covariance has no variance in a direction."""


@dataclass(frozen=True)
class JointUnknown:
    """Campaign's estimate of one unknown of the rig, relative to its stated `u` (in `unit`).

    `estimate` and `remaining` uncertainty are ratios to `u`.

    `recordings`: how many recordings reduce its uncertainty by more than 1 % each.
    """

    name: str
    label: str
    u: float
    unit: str
    estimate: float
    remaining: float
    recordings: int

    @property
    def is_as_stated(self) -> bool:
        """Whether the campaign leaves it as stated."""
        return self.remaining > AS_STATED


@dataclass(frozen=True)
class _Source:
    """A recording and a callable for its estimate of unknowns."""

    recording: str
    mounting: str
    knowledge: Callable[[], Knowledge]


@dataclass(frozen=True)
class _Member:
    """One recording of a mounting; `indices`: positions of its shared unknowns, wide ones first."""

    source: _Source
    indices: IntArray


@dataclass(frozen=True)
class _Mounted:
    """Joint information and score of W wide unknowns and n of the mounting."""

    members: tuple[_Member, ...]
    about: tuple[UnknownDescription, ...]
    information: FloatArray
    score: FloatArray
    wide: int

    @cached_property
    def conditional(self) -> FloatArray:
        """Covariance (n, n) of the mounting's unknowns for given wide ones."""
        information = self.information[self.wide :, self.wide :]
        return np.asarray(np.linalg.inv(np.eye(len(information)) + information))

    @cached_property
    def slope(self) -> FloatArray:
        """Coefficients (n, W) of the wide unknowns in the estimate of those of the mounting."""
        return np.asarray(self.conditional @ self.information[self.wide :, : self.wide])

    def of_wide(self) -> tuple[FloatArray, FloatArray]:
        """Return information and score of the wide unknowns, those of the mounting marginalised."""
        wide, mixed = slice(self.wide), self.information[: self.wide, self.wide :]
        rest = self.conditional @ self.score[self.wide :]
        return self.information[wide, wide] - mixed @ self.slope, self.score[wide] - mixed @ rest


@dataclass(frozen=True)
class JointEstimate:
    """Posterior of unknowns that recordings of a campaign share: `estimate` (W,) and `covariance` (W, W).

    The information of the recordings adds up, 1 + ΣM_i, and so does the score (Plackett 1950, Biometrika 37, 149: least
    squares with added observations). Unknowns of one mounting are eliminated mounting by mounting, so that time grows
    linearly. `descriptions`: the wide unknowns, those of the rig and, if there is only one mounting, those of the
    mounting.
    """

    campaign: str
    sources: tuple[_Source, ...]
    single: bool
    descriptions: tuple[UnknownDescription, ...]
    estimate: FloatArray
    covariance: FloatArray
    information: FloatArray
    recordings: IntArray

    @classmethod
    def of(cls, campaign: str, recorded: Sequence[RecordingResults]) -> JointEstimate:
        """Return the joint estimate of recordings."""
        sources = tuple(_Source(e.name, e.mounting, e.knowledge) for e in recorded if e.knowledge is not None)
        single = len({source.mounting for source in sources}) < 2
        about: dict[str, UnknownDescription] = {}
        count: dict[str, int] = {}
        for source in sources:
            knowledge = source.knowledge()
            remaining = np.sqrt(np.diag(knowledge.covariance))
            for index in np.flatnonzero(knowledge.shared).tolist():
                if single or knowledge.descriptions[index][4] == "rig":
                    name = knowledge.descriptions[index][0]
                    about.setdefault(name, knowledge.descriptions[index])
                    count[name] = count.get(name, 0) + bool(remaining[index] < UNTESTABLE_SHARE)
        none = np.zeros(len(about))
        joint = cls(
            campaign, sources, single, tuple(about.values()), none, np.eye(len(about)), np.outer(none, none),
            np.array([count[name] for name in about], dtype=np.int64),
        )  # fmt: skip
        information, score = np.outer(none, none), none
        for mounted in joint._mounted():
            more, score_of = mounted.of_wide()
            information, score = information + more, score + score_of
        covariance = np.asarray(np.linalg.inv(np.eye(len(none)) + information), dtype=np.float64)
        return replace(joint, information=information, covariance=covariance, estimate=covariance @ score)

    def unknowns(self) -> tuple[JointUnknown, ...]:
        """Return the campaign's estimate of every wide unknown."""
        remaining = np.sqrt(np.diag(self.covariance))
        columns = self.descriptions, self.estimate.tolist(), remaining.tolist(), self.recordings.tolist()
        return tuple(JointUnknown(*about[:4], *numbers) for about, *numbers in zip(*columns, strict=True))

    def _mounted(self) -> Iterator[_Mounted]:
        """Yield the joint recordings of every mounting."""
        wide = {one[0]: index for index, one in enumerate(self.descriptions)}
        groups: dict[str, list[_Source]] = {}
        for source in self.sources:
            groups.setdefault("" if self.single else source.mounting, []).append(source)
        for group in groups.values():
            positions, descriptions, members = dict(wide), list[UnknownDescription](), list[_Member]()
            information, score = np.zeros((len(positions), len(positions))), np.zeros(len(positions))
            for source in group:
                knowledge = source.knowledge()  # of one recording at a time, or memory grows as the campaign
                shared = [knowledge.descriptions[index] for index in np.flatnonzero(knowledge.shared).tolist()]
                for one in shared:
                    if one[0] not in positions:
                        positions[one[0]] = len(positions)
                        descriptions.append(one)
                more = len(positions) - len(score)
                information, score = np.pad(information, (0, more)), np.pad(score, (0, more))
                members.append(_Member(source, np.array([positions[one[0]] for one in shared], np.int64)))
                information[np.ix_(members[-1].indices, members[-1].indices)] += knowledge.information
                score[members[-1].indices] += knowledge.score
            yield _Mounted(tuple(members), tuple(descriptions), information, score, len(wide))

    def _all(self, mounted: _Mounted) -> tuple[FloatArray, FloatArray]:
        """Return estimate and covariance of the wide unknowns and those of one mounting."""
        slope, score = mounted.slope, mounted.score[mounted.wide :]
        mixed = -slope @ self.covariance
        estimate = np.concatenate([self.estimate, mounted.conditional @ score - slope @ self.estimate])
        return estimate, np.block([[self.covariance, mixed.T], [mixed, mounted.conditional - mixed @ slope.T]])

    def contradicting(self) -> tuple[str, ...]:
        """Return the recordings that contradict all others, at 1 % for all tests together."""
        found: list[tuple[float, str]] = []
        for mounted in self._mounted():
            estimate, covariance = self._all(mounted)
            for member in mounted.members:
                indices = member.indices
                p = _contradiction(member.source.knowledge(), estimate[indices], covariance[np.ix_(indices, indices)])
                found.append((p, member.source.recording))
        limit = 1.0 - TEST_CONFIDENCE ** (1.0 / max(len(found), 1))
        return tuple(name for p, name in sorted(found) if p < limit)

    def corrections(self) -> Iterator[tuple[str, JointCorrection]]:
        """Yield the correction of the loads of every recording by the joint estimate."""
        root = _root(self.information)
        for mounted in self._mounted():
            estimate, _ = self._all(mounted)
            for member in mounted.members:
                yield member.source.recording, JointCorrection(self, mounted, member, estimate[member.indices], root)


def _contradiction(knowledge: Knowledge, estimate: FloatArray, covariance: FloatArray) -> float:
    """Return the probability that a recording deviates this far from the estimate of all others.

    Without it the joint estimate has S = (S_joint⁻¹ - M)⁻¹; the score less M times that has the covariance M + MSM.
    Only directions count whose uncertainty this recording alone reduces by more than 1 %.
    """
    values, vectors = np.linalg.eigh(knowledge.information)
    significant = values > 1.0 / UNTESTABLE_SHARE**2 - 1.0
    if not np.any(significant):
        return 1.0
    inverse = np.linalg.inv(covariance)
    others = np.linalg.inv(inverse - knowledge.information)
    off = knowledge.score - knowledge.information @ (others @ (inverse @ estimate - knowledge.score))
    root, directions = np.sqrt(values[significant]), vectors[:, significant]
    white = directions.T @ off / root
    spread = np.eye(len(root)) + root[:, None] * (directions.T @ others @ directions) * root
    return float(chdtrc(float(len(root)), white @ np.linalg.solve(spread, white)))


@dataclass(frozen=True)
class JointCorrection:
    """Correction of a recording's loads by the joint estimate, to first order in the unknowns.

    A load l with its recording's estimate ε_i becomes l - K·(ε - ε_i), K = e·(1 + M) of its influences e. Its
    uncertainty has two parts. (a) The individual part N: influences of unshared unknowns and noise lose their effect
    through ε_i. (b) K·(ε - ε_joint): for the wide unknowns, S·ε less S times the noise of all scores, of covariance ΣM.
    The first appears under their names, the second as unknowns of the campaign. For those of the mounting, given the
    wide ones, it is a symmetric root of the remaining covariance under their names.
    """

    joint: JointEstimate
    mounted: _Mounted
    member: _Member
    estimate: FloatArray
    root: FloatArray

    def of(self, drive: ExcitedLine) -> ExcitedLine:
        """Return a line with the load and its uncertainty by the joint estimate."""
        knowledge, wide = self.member.source.knowledge(), self.mounted.wide
        uncertainty = drive.load_uncertainty
        old = {influence.name: influence for influence in uncertainty.influences}
        none = np.zeros((1, uncertainty.random[0].covariance.shape[1]))
        effects = np.array(
            [old[about[0]].effect[0] if about[0] in old else none[0] for about in knowledge.descriptions]
        )
        shared, local = (
            effects[knowledge.shared],
            effects[~knowledge.shared] + knowledge.local.T @ effects[knowledge.shared],
        )
        gain = knowledge.attenuation @ knowledge.inverse @ shared
        full = np.zeros((len(self.mounted.score), none.shape[1]))
        full[self.member.indices] = gain
        through = full[:wide] - self.mounted.slope.T @ full[wide:]
        remaining = self.joint.covariance @ through
        narrow = _root(self.mounted.conditional) @ full[wide:]
        both = zip((*self.joint.descriptions, *self.mounted.about), (*remaining, *narrow), strict=True)
        found = dict(old)
        individual = [about for about, mine in zip(knowledge.descriptions, knowledge.shared, strict=True) if not mine]
        for about, effect in (*both, *zip(individual, local, strict=True)):
            if about[0] in old or np.any(effect):
                found[about[0]] = Influence(*about[:4], effect[None], *about[4:])
        for number, effect in enumerate(self.root.T @ remaining):
            name = f"campaign {self.joint.campaign}: noise of unknowns {number + 1}"
            found[name] = Influence(name, NOISE, 1.0, "1", effect[None], "rig", "A")
        # Of N = n + E_l·E_lᵀ the noise n alone: its part and that of the unshared unknowns cancel.
        mixed = local.T @ knowledge.local.T @ shared
        size = np.eye(len(shared))
        lost = shared.T @ (knowledge.inverse - size - knowledge.local @ knowledge.local.T) @ shared + mixed + mixed.T
        beyond = shared.T @ knowledge.inverse @ knowledge.second_order @ gain
        random = (*_without(uncertainty.random, lost), Contribution(SECOND_ORDER, "B", beyond[None]))
        # The individual part of ε_i is T(1 + MT)⁻¹EᵀPy, in addition to that of the rig's unknowns.
        individual_part = knowledge.second_order @ knowledge.score @ knowledge.inverse @ shared
        change = (
            self.estimate @ gain + individual_part - knowledge.estimate[knowledge.shared] @ knowledge.inverse @ shared
        )
        return replace(
            drive,
            load=drive.load - as_complex(change),
            load_uncertainty=LazyUncertainty.of(Uncertainty(random, tuple(found.values()))),
        )


def as_stated(entry: RecordingResults) -> RecordingResults:
    """Return a recording whose loads err by its shared unknowns as stated.

    The effects are those at given readings, as if these said nothing about the unknowns; what they say is
    `Knowledge.information`, independent of the remaining noise of the loads.
    """
    if entry.knowledge is None:
        return entry
    knowledge = entry.knowledge()
    about = tuple(knowledge.descriptions[index] for index in np.flatnonzero(knowledge.shared).tolist())
    count = len(about)
    none, zero, source = np.zeros((count, count)), np.zeros(count), _Source(entry.name, entry.mounting, entry.knowledge)
    member = _Member(source, np.arange(count))
    joint = JointEstimate("", (source,), True, about, zero, np.eye(count), none, np.zeros(count, np.int64))
    mounted = _Mounted((member,), (), none, zero, count)
    carry = JointCorrection(joint, mounted, member, knowledge.estimate[knowledge.shared], none[:, :0])
    return replace(entry, excited_lines=tuple(map(carry.of, entry.excited_lines)))


def _root(matrix: FloatArray) -> FloatArray:
    """Return a symmetric root of a covariance."""
    values, vectors = np.linalg.eigh(matrix)
    return np.asarray((vectors * np.sqrt(np.maximum(values, 0.0))) @ vectors.T)


def _without(random: Sequence[Contribution], lost: FloatArray) -> tuple[Contribution, ...]:
    """Return contributions (K = 1) whose sum is a covariance less `lost` (12, 12).

    Each is transformed by R^½(1 - R^-½·D·R^-½)^½R^-½, R being their sum and D `lost`; this is the identity if D is
    zero.
    """
    total = np.sum([part.covariance[0] for part in random], axis=0)
    size = np.sqrt(np.maximum(np.diag(total), 0.0))
    size = np.where(size > 0.0, size, 1.0)
    values, vectors = np.linalg.eigh(total / np.outer(size, size))
    significant = values > ROUNDING * values[-1]
    root, directions = np.sqrt(values[significant]), vectors[:, significant]
    share, axes = np.linalg.eigh((directions.T @ (lost / np.outer(size, size)) @ directions) / np.outer(root, root))
    inner = (axes * np.sqrt(1.0 - np.minimum(share, 1.0))) @ axes.T
    turn = (size[:, None] * directions * root) @ inner @ (directions / root / size[:, None]).T
    return tuple(replace(part, covariance=(turn @ part.covariance[0] @ turn.T)[None]) for part in random)


def apply_joint_estimate(
    campaign: str, recorded: Sequence[RecordingResults], keep: Callable[[ExcitedLine], ExcitedLine]
) -> tuple[tuple[RecordingResults, ...], tuple[JointUnknown, ...], tuple[Notice, ...]]:
    """Return recordings whose loads use the joint estimate of all shared unknowns, with notices.

    If a recording contradicts the others, all keep their individual estimates. `keep`: stores changed lines.
    """
    joint = JointEstimate.of(campaign, recorded)
    if len(joint.sources) < 2 or not joint.descriptions:
        return tuple(recorded), (), ()
    contradicting = joint.contradicting()
    if contradicting:
        named, level = ", ".join(contradicting), 100.0 * (1.0 - TEST_CONFIDENCE)
        notice = Notice(CONTRADICTING_RECORDINGS, "campaign", recordings=named, level_percent=level)
        return tuple(recorded), (), (notice,)
    unknowns = joint.unknowns()
    index_of = {entry.name: index for index, entry in enumerate(recorded)}
    found = list(recorded)
    for name, carry in joint.corrections():
        entry = recorded[index_of[name]]
        found[index_of[name]] = replace(
            entry, excited_lines=tuple(keep(carry.of(drive)) for drive in entry.excited_lines)
        )
    return tuple(found), unknowns, _notices(unknowns, len(recorded) - len(joint.sources))


def _notices(unknowns: Sequence[JointUnknown], excluded: int) -> tuple[Notice, ...]:
    improved = sum(not unknown.is_as_stated for unknown in unknowns)
    notices = [Notice(JOINT_UNKNOWNS, "campaign", improved=improved, count=len(unknowns))]
    if excluded:
        notices.append(Notice(RECORDINGS_WITHOUT_ESTIMATE, "campaign", count=excluded))
    return tuple(notices)
