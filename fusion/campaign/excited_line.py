"""One excited line of one recording: load, outputs and shared unknowns."""

from __future__ import annotations

import os
import pickle
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, lru_cache, partial
from typing import IO, TYPE_CHECKING, Any, TypeVar

import numpy as np

from fusion.estimation.uncertainty import Contribution, Distribution, Influence, Kind, Scope, Uncertainty
from fusion.phasors.timing import EdgeGrid
from shakercal._common.arrays import BoolArray, ComplexArray, FloatArray, IntArray, check_shape

if TYPE_CHECKING:
    from fusion.instruments.channel import Outputs
    from fusion.sensitivity.analyse import Evaluation
    from fusion.sensitivity.load_phasors import LoadResult


Item = TypeVar("Item")
Numbers = tuple[tuple[Contribution, ...], FloatArray]
UnknownDescription = tuple[str, str, float, str, Scope, Kind, float, Distribution]
"""Unknown without its effect: name, label, u, unit, scope, type, degrees of freedom, distribution."""


class LazyUncertainty(Uncertainty):
    """Uncertainty whose influences are created on access, which needs a fifth of the memory.

    In between it keeps the random contributions and one table `effects` (E, K, 2C), in memory or on disk. Each
    unknown's `descriptions` (E) exist once for all lines.
    """

    descriptions: tuple[UnknownDescription, ...]
    numbers: Callable[[], Numbers]

    def __init__(self, about: tuple[UnknownDescription, ...], numbers: Callable[[], Numbers]) -> None:
        object.__setattr__(self, "descriptions", about)
        object.__setattr__(self, "numbers", numbers)

    @classmethod
    def of(cls, uncertainty: Uncertainty) -> LazyUncertainty:
        """Return a given uncertainty with its numbers in memory."""
        influences = uncertainty.influences
        rows = ((i.name, i.label, i.u, i.unit, i.scope, i.type, i.dof, i.distribution) for i in influences)
        effects = np.array([influence.effect for influence in influences])
        return cls(tuple(intern_unknown(*row) for row in rows), partial(identity, (uncertainty.random, effects)))

    @property
    def random(self) -> tuple[Contribution, ...]:
        """Random contributions."""
        return self.numbers()[0]

    @property
    def influences(self) -> tuple[Influence, ...]:
        """Influences."""
        pairs = zip(self.descriptions, self.numbers()[1], strict=True)
        return tuple(Influence(*row[:4], effect, *row[4:]) for row, effect in pairs)

    def _mapped(
        self, of_covariance: Callable[[FloatArray], FloatArray], of_effect: Callable[[FloatArray], FloatArray]
    ) -> LazyUncertainty:
        random, effects = self.numbers()
        mapped = tuple(replace(part, covariance=of_covariance(part.covariance)) for part in random)
        effects = np.ascontiguousarray(of_effect(effects)) if self.descriptions else effects
        return LazyUncertainty(self.descriptions, partial(identity, (mapped, effects)))


def identity(value: Item) -> Item:
    """Return the argument; `partial(identity, value)` is a callable that returns a value."""
    return value


@lru_cache(maxsize=4096)
def intern_unknown(*description: *UnknownDescription) -> UnknownDescription:
    """Return the same object for the same unknown."""
    return description


SECOND_ORDER_U = 0.05
"""Standard uncertainty, in the stated one, of the difference between an unknown in one recording and in the rig.

It allows for errors of first order: a direction error of 10 mrad shortens a reading by 5e-5, a tenth of the u of a
laser's scale. Recordings with little noise would otherwise contradict each other.
"""
SECOND_ORDER = "unknowns beyond first order"


@dataclass(frozen=True)
class Knowledge:
    """Estimate of the E unknowns of one recording by its readings, in their u.

    `descriptions` (E): the unknowns; `shared` (E,): those that other recordings may have, too, and that act on the load
    through the motion alone. A₀ = A at no errors, K its change by one u of each shared unknown, N all other
    uncertainty, P = N⁻¹ - N⁻¹X(XᵀN⁻¹X)⁻¹XᵀN⁻¹ and E the effects of the shared unknowns on the readings y = X·A + E·ε +
    n. The readings determine ε through EᵀPy = M·ε + noise of covariance M alone, M = EᵀPE. The estimate applies to the
    rig with ε = ε_rig + η, where η has the covariance T of second-order effects: squares of `SECOND_ORDER_U` and
    `products` (E,).
    """

    descriptions: tuple[UnknownDescription, ...]
    shared: BoolArray
    estimate: FloatArray
    covariance: FloatArray
    products: FloatArray

    @classmethod
    def of(cls, influences: Sequence[Influence], both: Sequence[str], *numbers: FloatArray) -> Knowledge:
        """Return the estimate for unknowns of the motion.

        `both`: those that also act on the load directly.
        """
        about = tuple(
            intern_unknown(i.name, i.label, i.u, i.unit, i.scope, i.type, i.dof, i.distribution) for i in influences
        )
        shared = [one[4] in ("rig", "mounting") and one[0] not in both for one in about]
        return cls(about, np.array(shared, dtype=np.bool_), *numbers)

    @cached_property
    def second_order(self) -> FloatArray:
        """T, whose off-diagonal elements are zero."""
        return np.diag(SECOND_ORDER_U**2 + self.products[self.shared] ** 2)

    @cached_property
    def inverse(self) -> FloatArray:
        """1 + M, the inverse of the covariance of the shared unknowns, all others marginalised."""
        return np.asarray(np.linalg.inv(self.covariance[np.ix_(self.shared, self.shared)]))

    @cached_property
    def attenuation(self) -> FloatArray:
        """(1 + MT)⁻¹, the attenuation of information between recording and rig by second-order effects."""
        size = np.eye(len(self.inverse))
        return np.asarray(np.linalg.inv(size + (self.inverse - size) @ self.second_order))

    @property
    def information(self) -> FloatArray:
        """Information of the recording on the unknowns of the rig: (1 + MT)⁻¹M."""
        product = self.attenuation @ (self.inverse - np.eye(len(self.inverse)))
        return np.asarray((product + product.T) / 2.0)

    @property
    def score(self) -> FloatArray:
        """(1 + MT)⁻¹EᵀPy."""
        return np.asarray(self.attenuation @ self.inverse @ self.estimate[self.shared])

    @property
    def local(self) -> FloatArray:
        """EᵀP times the effects of the unshared unknowns on the readings."""
        return np.asarray(-self.inverse @ self.covariance[np.ix_(self.shared, ~self.shared)])


class DiskStore:
    """Temporary file for the uncertainties of thousands of lines; it disappears when it is closed."""

    def __init__(self, file: IO[bytes]) -> None:
        self._file = file

    def put(self, drive: ExcitedLine) -> ExcitedLine:
        """Return a line whose uncertainties are on disk."""
        load, outputs = (self._put(u) for u in (drive.load_uncertainty, drive.outputs_uncertainty))
        return replace(drive, load_uncertainty=load, outputs_uncertainty=outputs)

    def store(self, value: Item) -> Callable[[], Item]:
        """Write an object to disk and return a callable that reads it."""
        offset = self._file.seek(0, os.SEEK_END)
        pickle.dump(value, self._file, protocol=pickle.HIGHEST_PROTOCOL)
        return partial(self._get, offset)

    def _put(self, uncertainty: Uncertainty) -> LazyUncertainty:
        stored = uncertainty if isinstance(uncertainty, LazyUncertainty) else LazyUncertainty.of(uncertainty)
        return LazyUncertainty(stored.descriptions, self.store(stored.numbers()))  # which may come from this file

    def _get(self, offset: int) -> Any:
        self._file.seek(offset)
        return pickle.load(self._file)


LOADS = 6
"""Number of load components."""
FREQUENCY_TOLERANCE = 0.01
"""Relative width of a group of lines at one frequency; a multi-axis shaker drives several lines close to each other."""


@dataclass(frozen=True)
class ExcitedLine:
    """One driven line (its fundamental) of one recording.

    `mounting`: recordings with different texts have different mountings. `direction`: 3 or 6 numbers of the excitation.
    `load` (6,) in N and N·m with the uncertainty of unobserved motion; `observed` (6,): which components are results.
    `outputs` (C,) in the sensor's unit, NaN if a channel has no usable reading. Their uncertainties have one line (K =
    1) and the names of the recording. `grids`: positions of trigger edges between the samples of every block; empty if
    unknown or not constant. `start`: the first recording with the same grids (`with_starts`), empty for this one.
    """

    recording: str
    mounting: str
    frequency_hz: float
    nominal_hz: float
    direction: tuple[float, ...]
    load: ComplexArray
    load_uncertainty: Uncertainty
    outputs: ComplexArray
    outputs_uncertainty: Uncertainty
    channels: tuple[str, ...]
    grids: tuple[EdgeGrid, ...] = ()
    start: str = ""
    observed: tuple[bool, ...] = (True,) * LOADS

    def __post_init__(self) -> None:
        channels = len(self.channels)
        check_shape("load", self.load, (LOADS,))
        check_shape("outputs", self.outputs, (channels,))
        check_shape("load_uncertainty", self.load_uncertainty.random[0].covariance, (1, 2 * LOADS, 2 * LOADS))
        check_shape(
            "outputs_uncertainty", self.outputs_uncertainty.random[0].covariance, (1, 2 * channels, 2 * channels)
        )

    def output(self, channel: str) -> complex:
        """Return the reading of a channel, NaN if there is none."""
        recorded = channel in self.channels
        return complex(self.outputs[self.channels.index(channel)]) if recorded else complex(np.nan, np.nan)

    def campaign_uncertainties(self) -> tuple[Uncertainty, Uncertainty]:
        """Return the uncertainties of load and outputs under names that are unique in the campaign."""
        names = self.recording, self.mounting, self.start
        return with_campaign_names(self.load_uncertainty, *names), with_campaign_names(self.outputs_uncertainty, *names)


def excited_lines_of(evaluation: Evaluation) -> tuple[ExcitedLine, ...]:
    """Return the driven lines of a recording.

    None without a load, an output or a stated direction.
    """
    manifest, load, outputs = evaluation.manifest, evaluation.load, evaluation.outputs
    if load is None or outputs is None or manifest.excitation.direction is None:
        return ()
    lines, direction = evaluation.lines, manifest.excitation.direction
    names, clocks = (manifest.name, manifest.mounting), [c for c in evaluation.clocks if c.trigger is not None]
    grids = tuple(clock.grid for clock in clocks if clock.grid is not None)
    driven = excited_lines(*names, direction, lines.nominal_hz, lines.multiple, load, outputs)
    return tuple(replace(drive, grids=grids if len(grids) == len(clocks) else ()) for drive in driven)


def excited_lines(
    recording: str,
    mounting: str,
    direction: Sequence[float],
    nominal_hz: FloatArray,
    multiple: IntArray,
    load: LoadResult,
    outputs: Outputs,
) -> tuple[ExcitedLine, ...]:
    """Return the lines of multiple 1 of one recording at which the load is available.

    `nominal_hz`, `multiple` (K,): of the lines of `load` and `outputs`.
    """
    driven = np.flatnonzero((multiple == 1) & np.isfinite(load.value).all(axis=1))
    return tuple(
        ExcitedLine(
            recording=recording,
            mounting=mounting,
            frequency_hz=float(load.frequency_hz[line]),
            nominal_hz=float(nominal_hz[line]),
            direction=tuple(float(number) for number in direction),
            load=load.value[line],
            load_uncertainty=LazyUncertainty.of(load.uncertainty.at_lines([line])),
            outputs=outputs.phasors.value[line],
            outputs_uncertainty=LazyUncertainty.of(outputs.uncertainty.at_lines([line])),
            channels=outputs.phasors.channels,
            observed=tuple(load.observed[line].tolist()),
        )
        for line in driven.tolist()
    )


def with_starts(drives: Iterable[ExcitedLine]) -> tuple[ExcitedLine, ...]:
    """Return all lines of a campaign with their `start` (`start_names`)."""
    named = tuple(drives)
    starts = start_names({drive.recording: drive.grids for drive in named})
    return tuple(replace(drive, start=starts[drive.recording]) for drive in named)


def start_names(grids: Mapping[str, tuple[EdgeGrid, ...]]) -> dict[str, str]:
    """Return for every recording of a campaign the first one with equal `grids`, or itself.

    The timing error between sampled edges is common to these recordings; a mean does not reduce it.
    """
    # First recordings by the position of their edges, in steps no smaller than the difference of equal grids.
    step_s = max((grid.sample_s for edges in grids.values() for grid in edges), default=1.0) / 2.0
    firsts: dict[int, list[tuple[int, str]]] = {}
    named: dict[str, str] = {}
    for number, (recording, edges) in enumerate(grids.items()):
        step = int(edges[0].start_s // step_s) if edges else 0
        near = sorted(first for k in (-1, 0, 1) for first in firsts.get(step + k, ())) if edges else []
        named[recording] = next((first for _, first in near if _same_grids(grids[first], edges)), recording)
        if edges and named[recording] == recording:
            firsts.setdefault(step, []).append((number, recording))
    return named


def _same_grids(first: tuple[EdgeGrid, ...], second: tuple[EdgeGrid, ...]) -> bool:
    """Return whether two recordings have the same grids."""
    return len(first) == len(second) > 0 and all(map(EdgeGrid.has_same_edges, first, second))


def with_campaign_names(uncertainty: Uncertainty, recording: str, mounting: str, start: str = "") -> Uncertainty:
    """Return the uncertainty with names of unknowns that are unique in a campaign.

    An unknown of the rig keeps its name. One of the mounting is common to recordings of equal `mounting`, one of the
    start to those of equal `start` (empty: this recording only), one of the recording to this recording only. All
    scopes become "rig".
    """
    suffix = {
        "rig": "",
        "mounting": f" [{mounting}]",
        "recording": f" [{recording}]",
        "start": f" [{start or recording}]",
    }
    if isinstance(uncertainty, LazyUncertainty):
        descriptions: list[UnknownDescription] = [
            (f"{a[0]}{suffix[a[4]]}", a[1], a[2], a[3], "rig", *a[5:]) for a in uncertainty.descriptions
        ]
        return LazyUncertainty(tuple(descriptions), uncertainty.numbers)
    influences = [replace(i, name=f"{i.name}{suffix[i.scope]}", scope="rig") for i in uncertainty.influences]
    return replace(uncertainty, influences=tuple(influences))


def join_lines(parts: Sequence[Uncertainty]) -> Uncertainty:
    """Join uncertainties of the same C values at single lines to one of K lines.

    Unknowns of one name become one; names must be unique in the campaign (`with_campaign_names`).
    """
    lines, size = len(parts), parts[0].random[0].covariance.shape[1]
    random: dict[str, Contribution] = {}
    influences: dict[str, Influence] = {}
    for line, part in enumerate(parts):
        for contribution in Uncertainty(part.random).grouped():
            total = random.get(contribution.label)
            if total is None:
                empty = np.zeros((lines, size, size))
                total = random[contribution.label] = Contribution(
                    contribution.label, contribution.type, empty, np.full(lines, np.inf)
                )
            total.covariance[line] = contribution.covariance[0]
            if contribution.dof is not None and total.dof is not None:
                total.dof[line] = contribution.dof[0]
        for influence in part.influences:
            if influence.name not in influences:
                influences[influence.name] = replace(influence, effect=np.zeros((lines, size)))
            influences[influence.name].effect[line] = influence.effect[0]
    return Uncertainty(tuple(random.values()), tuple(influences.values()))


def group_by_frequency(drives: Sequence[ExcitedLine]) -> tuple[tuple[ExcitedLine, ...], ...]:
    """Return the lines in groups of one frequency, ascending, each at most 1 % wide."""
    groups: list[list[ExcitedLine]] = []
    for drive in sorted(drives, key=lambda drive: drive.frequency_hz):
        if groups and drive.frequency_hz <= groups[-1][0].frequency_hz * (1.0 + FREQUENCY_TOLERANCE):
            groups[-1].append(drive)
        else:
            groups.append([drive])
    return tuple(tuple(group) for group in groups)
