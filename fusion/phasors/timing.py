"""Time base of a recording: clocks and instants of frames from trigger edges."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import reduce
from itertools import combinations
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from fusion.errors import ARGUMENT, InputError, as_input_error
from fusion.estimation.uncertainty import Kind as ErrorType
from fusion.estimation.uncertainty import Scope
from fusion.instruments.channel import FittedError
from fusion.instruments.stereo import Exposure
from fusion.phasors.phasor_notices import (
    EDGES_AMBIGUOUS,
    EXPOSURE_REFUSED,
    FRAME_NUMBER_GAP,
    FRAME_NUMBERS_SHIFTED,
    IMAGES_REFUSED,
    INVERTED_TRIGGER,
    LINES_NOT_FOUND,
    NO_SHARED_TRIGGER,
    TOO_FEW_EDGES,
)
from fusion.recording.manifest import MINIMUM_FRAMES, Frames, Images, PointFiles
from fusion.recording.rig import Stereo
from fusion.recording.values import FILE, PULSE
from photogram.images.sequence import FrameNumbers
from shaker.timebase.tie import ClockTie, edge_instants, tie_clocks
from shaker.timebase.trigger import PulseWidth, TriggerFit, nominal_trigger
from shakercal._common.arrays import BoolArray, FloatArray, IntArray
from shakercal._common.notices import Notice, Value

if TYPE_CHECKING:
    from fusion.recording.daq_records import DaqRecord
    from fusion.recording.load import Manifest
    from shaker.lines.frequencies import LineFrequencies
    from shaker.sine.solve import SineFit


@dataclass(frozen=True)
class Sight:
    """One stereo pair over one recording: placement, exposure and times of its frames.

    `pair`: of the rig, with values of the recording. `time_s` (F,): exposure middles on the first block's clock.
    `model_share`: mean effect of an error of the trigger's periodic model on them. `where`: file and key that error
    messages name. `edge` (F,): number of the edge of each frame. `files`: numbers (F,) of the frames among the files of
    each camera; () where all files are used.
    """

    name: str
    pair: Stereo
    exposure: Exposure
    time_s: FloatArray
    model_share: float
    where: tuple[Path, str]
    edge: IntArray
    files: tuple[IntArray, ...] = ()


@dataclass(frozen=True)
class TimingError:
    """One unknown of clocks, triggers or lines, with the effect of one standard uncertainty `u`.

    Times are later by `offset_s` + `rate`·t, t on the first block's clock. The frequencies of the K lines are higher by
    the relative `frequency_error` (K,), or () if it is the same for all. `dof`: degrees of freedom of a fit to edges
    (type A), whose errors have the `scope` "start".
    """

    name: str
    u: float
    unit: str
    offset_s: float
    rate: float
    frequency_error: FloatArray
    dof: float = np.inf
    scope: Scope = "recording"

    def effect_on_fit(self, fit: SineFit, seen: BoolArray, order: int) -> FittedError:
        """Return the effect on the phasors (K, C) that a sine approximation determines.

        `seen` (K,): lines in the fit, which are its first ones. A signal late by L(t), including the phase of a
        frequency too high by φ, was y(t - L). The fit returns X - jω·L(middle)·X, plus the part of the remaining slope
        that the lines, their conjugates and the offset can represent over the record. Readings ∝ ω^-order of an
        acceleration increase by order·φ.
        """
        omega, value, lines = 2.0 * np.pi * fit.phasors.frequency_hz, fit.phasors.value, np.count_nonzero(seen)
        stretch = np.zeros(len(omega))
        stretch[:lines] = self.frequency_error[seen] if self.frequency_error.ndim else self.frequency_error
        turn = -1j * omega * (self.offset_s + (self.rate + stretch) * fit.middle_s) + order * stretch
        slopes = fit.slope_response((-1j * omega * (self.rate + stretch))[:, None] * value)
        effect = np.zeros((len(seen), 1), dtype=np.complex128)
        rest = np.zeros((len(seen), value.shape[1]), dtype=np.complex128)
        effect[seen, 0], rest[seen] = turn[:lines], slopes[:lines]
        kind: ErrorType = "B" if np.isinf(self.dof) else "A"
        return FittedError(self.name, self.name, self.u, self.unit, effect, self.scope, kind, self.dof, additive=rest)


def combine_timing_errors(errors: Iterable[TimingError]) -> tuple[TimingError, ...]:
    """Return every unknown once, with its effects added."""
    merged: dict[str, TimingError] = {}
    for error in errors:
        earlier = merged.get(error.name)
        if earlier is None:
            merged[error.name] = error
        else:
            offset_s, rate = earlier.offset_s + error.offset_s, earlier.rate + error.rate
            frequency_error = np.asarray(earlier.frequency_error + error.frequency_error)
            merged[error.name] = replace(earlier, offset_s=offset_s, rate=rate, frequency_error=frequency_error)
    return tuple(merged.values())


@dataclass(frozen=True)
class _StraightLine:
    """Uncertainty of a straight line.

    From its covariance (2, 2) of value at 0 and slope. `at`: argument at which value and slope are uncorrelated.
    `u_value`, `u_slope`: their standard uncertainties there.
    """

    at: float
    u_value: float
    u_slope: float

    @classmethod
    def of(cls, covariance: FloatArray) -> _StraightLine:
        (first, mixed), (_, slope) = covariance.tolist()
        at = -mixed / slope if slope > 0.0 else 0.0
        return cls(at, float(np.sqrt(max(first + at * mixed, 0.0))), float(np.sqrt(slope)))


_SAME_PERIOD = 1e-5  # relative difference below which two periods are treated as equal


@dataclass(frozen=True)
class EdgeGrid:
    """Positions of a trigger's edges between the samples of one block.

    They determine the sampling error. Seconds: first edge after the first sample, period, sampling interval, `offset_s`
    of the tie to the first block's clock (0 for that), `width_s` of the pulses (NaN if not measurable).
    """

    start_s: float
    period_s: float
    sample_s: float
    offset_s: float
    width_s: float

    @classmethod
    def of(cls, trigger: TriggerFit, tie: ClockTie | None, width_s: float | None) -> EdgeGrid | None:
        """Return the grid, None for a trigger with jitter, whose positions vary."""
        sample_s = trigger.sample_s
        if trigger.jitter_s > sample_s / 2.0:
            return None
        offset_s = 0.0 if tie is None else tie.offset_s
        return cls(trigger.start_s, trigger.period_s, sample_s, offset_s, np.nan if width_s is None else width_s)

    def has_same_edges(self, other: EdgeGrid) -> bool:
        """Return whether edges have the same positions: within half a sample, periods within 1e-5."""
        ours, theirs = ((g.start_s, g.offset_s, g.width_s) for g in (self, other))
        near = np.allclose(ours, theirs, rtol=0.0, atol=self.sample_s / 2.0, equal_nan=True)
        pace = (other.period_s / self.period_s, other.sample_s / self.sample_s)
        return bool(near and np.allclose(pace, 1.0, rtol=0.0, atol=_SAME_PERIOD))


@dataclass(frozen=True)
class ClockResult:
    """One DAQ block: its file, its trigger and its tie to the first block's clock.

    The first block has no tie. `pulse_width_s`, `u_pulse_width_s`: of the trigger's pulses, None if not measurable.
    `grid`: positions of the edges between the samples, None without a trigger or with jitter.
    """

    daq: str
    file: Path
    trigger: TriggerFit | None
    tie: ClockTie | None
    pulse_width_s: float | None = None
    u_pulse_width_s: float | None = None
    grid: EdgeGrid | None = None


INVERTED_TOLERANCE = 0.02
"""Largest difference, over the period, of pulses in one block and pauses in another if one is inverted (chosen)."""


@dataclass(frozen=True)
class TimeBase:
    """The clocks of a recording; times on the first block's clock from its earliest sample.

    `triggers`: per block and trigger channel, in seconds from the block's earliest sample. `ties`: per block, None for
    the first.
    """

    records: tuple[DaqRecord, ...]
    triggers: dict[tuple[str, str], TriggerFit]
    ties: dict[str, ClockTie | None]

    def to_base_s(self, daq: str, time_s: FloatArray) -> FloatArray:
        """Return times of a block's clock on the first block's clock."""
        tie = self.ties[daq]
        return time_s if tie is None else tie.to_base_s(time_s)

    def first_with(self, trigger: str) -> tuple[str, TriggerFit]:
        """Return the first block that records a trigger, and its fit."""
        return next((daq, fit) for (daq, name), fit in self.triggers.items() if name == trigger)

    def tie_errors(self, daq: str) -> tuple[TimingError, ...]:
        """Return the errors of a block's tie to the first clock.

        Empty for the first block. Effects of an error of the first block's trigger have the name of that unknown, which
        the frames share.
        """
        tie = self.ties[daq]
        if tie is None:
            return ()
        found: list[TimingError] = []
        independent = tie.covariance - tie.noise
        if tie.follows is not None and tie.remaining_covariance is not None:
            name = self.shared_triggers(self.records[0].entry.name, daq)[0]
            fit = self.first_with(name)[1]
            line, independent = _StraightLine.of(fit.covariance), tie.remaining_covariance
            dof = float(max(len(fit.number) - 2, 1))
            for kind, unit, u, error in (
                ("time", "s", line.u_value, np.array([line.u_value, 0.0])),
                ("rate", "1", line.u_slope / fit.period_s, line.u_slope * np.array([-line.at, 1.0])),
            ):
                offset_s, rate = (tie.follows @ error).tolist()
                rate /= tie.rate  # on the first clock
                offset_s -= rate * tie.offset_s
                found.append(TimingError(f"{name}: {kind}", u, unit, offset_s, rate, np.zeros(()), dof, "start"))
        parts: tuple[tuple[str, FloatArray, Scope], ...] = (
            ("", independent, "start"),
            (" (noise of its edges)", tie.noise, "recording"),
        )
        for what, covariance, scope in parts:
            line = _StraightLine.of(covariance)
            at_s, rate = float(tie.to_base_s(np.asarray(line.at))), line.u_slope / tie.rate
            found += _offset_rate_errors(f"clock {daq}{what}", at_s, line.u_value, rate, tie.pairs, scope)
        return tuple(error for error in found if error.u > 0.0)

    def sight_errors(self, sight: Sight) -> tuple[TimingError, ...]:
        """Return the errors of the frames' instants by the trigger's model and its clock.

        Instants from measured edges follow the model only by `model_share`; errors common to all edges remain.
        """
        name = sight.exposure.trigger
        daq, fit = self.first_with(name)
        line, tie = _StraightLine.of(fit.covariance), self.ties[daq]
        at_s = self.to_base_s(daq, np.asarray(fit.start_s + line.at * fit.period_s))
        common = min(fit.open_s / np.sqrt(12.0), line.u_value)
        u_time = np.hypot(sight.model_share * np.sqrt(line.u_value**2 - common**2), common)
        rate = sight.model_share * line.u_slope / fit.period_s
        scale = 1.0 if tie is None else tie.rate
        return (
            *_offset_rate_errors(name, float(at_s), scale * float(u_time), rate, len(fit.number)),
            *self.tie_errors(daq),
        )

    @staticmethod
    def add_clock_uncertainty(lines: LineFrequencies, clock: Sequence[TimingError]) -> LineFrequencies:
        """Return the lines, u of their frequencies enlarged by the rate error of their clock."""
        rate = float(np.sqrt(sum(error.rate**2 for error in clock)))
        return replace(lines, u_frequency_hz=np.hypot(lines.u_frequency_hz, rate * lines.frequency_hz))

    @staticmethod
    def line_errors(lines: LineFrequencies, clock: Sequence[TimingError]) -> tuple[TimingError, ...]:
        """Return the frequency errors of the lines from `add_clock_uncertainty`.

        A fast clock lowers the frequencies. The remaining part of `u_frequency_hz` is separate for each fundamental.
        """
        shared = [replace(e, offset_s=0.0, rate=0.0, frequency_error=np.asarray(-e.rate)) for e in clock if e.rate]
        ours = sum(e.rate**2 for e in clock) * lines.frequency_hz**2
        remaining = np.sqrt(np.maximum(lines.u_frequency_hz**2 - ours, 0.0))
        for f in np.unique(lines.nominal_hz).tolist():
            group = lines.nominal_hz == f
            u_hz = float(remaining[group][np.argmin(lines.multiple[group])])
            stretch = np.where(group, remaining / lines.frequency_hz, 0.0)
            shared.append(TimingError(f"frequency of {f:.6g} Hz", u_hz, "Hz", 0.0, 0.0, stretch))
        return tuple(shared)

    def shared_triggers(self, first: str, second: str) -> list[str]:
        """Return the triggers that two blocks record; the first of them ties their clocks."""
        return [name for daq, name in self.triggers if daq == first and (second, name) in self.triggers]

    def pulse_widths(self) -> dict[tuple[str, str], PulseWidth]:
        """Return the pulse width per block and trigger where both edges are resolved."""
        widths = {}
        for daq, name in self.triggers:
            with suppress(ValueError):
                widths[daq, name] = self.record(daq).pulse_width(name)
        return widths

    def inverted_trigger_notices(self) -> Iterator[Notice]:
        """Yield a warning for each trigger that is probably inverted in one of two blocks.

        Its pulses in one block are as long as its pauses in the other.
        """
        widths = self.pulse_widths()
        for (one, name), (other, same) in combinations(widths, 2):
            if name != same or one == other:
                continue
            shares = [widths[daq, name].width_s / self.triggers[daq, name].period_s for daq in (one, other)]
            if abs(sum(shares) - 1.0) < INVERTED_TOLERANCE and abs(shares[0] - shares[1]) > 4.0 * INVERTED_TOLERANCE:
                yield Notice(
                    INVERTED_TRIGGER,
                    other,
                    trigger=name,
                    first_block=one,
                    second_block=other,
                    first_share=shares[0],
                    second_share=shares[1],
                )

    def record(self, daq: str) -> DaqRecord:
        """Return a block by its name."""
        return next(record for record in self.records if record.entry.name == daq)

    def results(self) -> tuple[ClockResult, ...]:
        """Return one entry per block for the result tree."""
        clocks, pulses = [], self.pulse_widths()
        for record in self.records:
            name = record.entry.name
            key = next((key for key in self.triggers if key[0] == name and key[1] in record.raw), ("", ""))
            pulse = pulses.get(key)
            width, u_width = (None, None) if pulse is None else (pulse.width_s, pulse.u_width_s)
            trigger, tie = self.triggers.get(key), self.ties[name]
            grid = None if trigger is None else EdgeGrid.of(trigger, tie, width)
            clocks.append(ClockResult(name, record.entry.file, trigger, tie, width, u_width, grid))
        return tuple(clocks)


def _offset_rate_errors(
    name: str, at_s: float, u_s: float, rate: float, edges: int, scope: Scope = "start"
) -> tuple[TimingError, ...]:
    """Return the errors of a time base with uncorrelated offset and `rate`.

    The offset has the standard uncertainty `u_s` at the time `at_s`. Degrees of freedom: `edges` less two.
    """
    steady, dof = np.zeros(()), float(max(edges - 2, 1))
    both = (
        TimingError(f"{name}: time", u_s, "s", u_s, 0.0, steady, dof, scope),
        TimingError(f"{name}: rate", rate, "1", -rate * at_s, rate, steady, dof, scope),
    )
    return tuple(error for error in both if error.u > 0.0)


U_FRAME_RATE, MOST_FREE_FRAMES = 1e-3, 2**17
"""Relative standard uncertainty of a stated `frame_rate` before the motion determines it, and most frames (chosen)."""


def tie_daqs(manifest: Manifest, records: Sequence[DaqRecord]) -> TimeBase:
    """Find all trigger edges, and tie every clock to the first by a shared trigger."""
    base, *others = records
    first = base.entry.name
    triggers: dict[tuple[str, str], TriggerFit] = {}
    for record in records:
        for channel in (channel for channel in record.entry.channel if channel.quantity == "trigger"):
            with as_input_error(record.entry.file, channel.name):
                fit = record.fit_trigger(channel)
            triggers[record.entry.name, channel.name] = fit.delay_by(record.lag_s(channel.name) - channel.delay)
    for entry in manifest.images:
        if entry.frame_rate is not None:
            covariance: FloatArray = np.diag([0.0, (U_FRAME_RATE / entry.frame_rate) ** 2])
            triggers[first, entry.trigger] = nominal_trigger(MOST_FREE_FRAMES, 1.0 / entry.frame_rate, covariance)
    ties: dict[str, ClockTie | None] = {first: None}
    time_base = TimeBase(tuple(records), triggers, ties)
    for other in others:
        name = other.entry.name
        key = f"daq.{name}.channel"
        shared = time_base.shared_triggers(first, name)
        if not shared:
            expected = f"a trigger channel of the same name as in block {first}, which ties the two clocks"
            raise InputError(NO_SHARED_TRIGGER, manifest.path, key, found="none", expected=expected)
        later_s = other.start_s - base.start_s if base.start_s and other.start_s else None
        pair = triggers[first, shared[0]], triggers[name, shared[0]]
        with as_input_error(manifest.path, f"{key}.{shared[0]}"):
            ties[name] = tie_clocks(*pair, other.entry.first_edge, start_difference_s=later_s)
    return time_base


def frame_sight(
    manifest: Manifest,
    base: TimeBase,
    entry: Images | PointFiles,
    frames: int | IntArray,
    rows: int = 1,
    first_edge: int | None = None,
) -> Sight:
    """Return a stereo pair with exposure and instants of its frames.

    The middle of an exposure is edge + delay + exposure / 2. `frames`: number of consecutive frames, or the edge number
    of each (F,), counted from that of the first frame, `first_edge`, by default as stated. With a rolling shutter of
    `rows`, instants are those of the first row.

    The edge is that of the periodic model if the trigger has no jitter, and otherwise the measured edge. Measured edges
    include those in other blocks whose clocks are tied by this trigger. The exposure is as stated, or the pulse width
    in the first block.
    """
    daq, trigger = base.first_with(entry.trigger)
    key = f"{'images' if isinstance(entry, Images) else 'points'}.{entry.stereo}"
    index = np.arange(frames) if isinstance(frames, int) else frames
    span = int(index[-1]) + 1
    stated = entry.first_edge if first_edge is None else first_edge
    if stated is None and trigger.edges > span:
        expected = f"the number of the edge that belongs to the first of {len(index)} frames"
        found = f"none, and {trigger.edges} edges in {entry.trigger}"
        raise InputError(EDGES_AMBIGUOUS, manifest.path, f"{key}.first_edge", found=found, expected=expected)
    first = stated if isinstance(stated, int) else 0
    if first + span > trigger.edges:
        expected, edges_found = (
            f"at least {first + span} edges in {entry.trigger} for {len(index)} frames",
            trigger.edges,
        )
        raise InputError(TOO_FEW_EDGES, manifest.path, f"{key}.trigger", found=str(edges_found), expected=expected)
    other_records = []
    if daq == base.records[0].entry.name:
        for other, tie in base.ties.items():
            if tie is not None and base.shared_triggers(daq, other)[:1] == [entry.trigger]:
                other_records.append((base.triggers[other, entry.trigger], tie))
    edges = edge_instants(trigger, first + index, other_records)
    if entry.exposure == PULSE:
        try:
            pulse = base.record(daq).pulse_width(entry.trigger)
        except ValueError as error:
            raise pulse_width_error(manifest, daq, entry, error) from error
        dof = float(max(pulse.pulses - 2, 1))
        exposure = Exposure(entry.trigger, pulse.width_s, pulse.u_width_s, dof)
    elif entry.exposure == FILE:
        found, expected = f'"{FILE}", but points have no video file', "the exposure in s"
        raise InputError(EXPOSURE_REFUSED, manifest.path, f"{key}.exposure", found=found, expected=expected)
    else:
        exposure = Exposure(entry.trigger, entry.exposure)
    if exposure.length_s > trigger.period_s:
        file, exposure_key = _exposure_key(manifest, entry, exposure.length_s)
        found, expected = f"{exposure.length_s:g} s", f"less than the {trigger.period_s:.4g} s from frame to frame"
        raise InputError(EXPOSURE_REFUSED, file, exposure_key, found=found, expected=expected)
    read_s = manifest.rig.stereo[entry.stereo].readout_s(rows)
    if read_s > trigger.period_s:
        found, expected = f"{read_s:g} s for {rows} rows", f"less than the {trigger.period_s:.4g} s from frame to frame"
        row_time = f"stereo.{entry.stereo}.row_time"
        raise InputError(EXPOSURE_REFUSED, manifest.rig_path, row_time, found=found, expected=expected)
    middle_s = base.to_base_s(daq, edges.time_s) + entry.delay + exposure.length_s / 2.0
    pair = manifest.rig.stereo[entry.stereo].model_copy(update={"delay_uncertainty": entry.delay_uncertainty})
    share = float(np.mean(edges.model_share))
    return Sight(entry.stereo, pair, exposure, np.asarray(middle_s), share, (manifest.path, key), first + index)


def edges_of_runs(entry: Images, side: str, numbers: FrameNumbers | None, frames: int) -> IntArray:
    """Return the edge of each frame (F,) of a camera, by its stated runs."""
    assert isinstance(entry.first_edge, dict)
    index = np.arange(frames) if numbers is None else numbers.frame_index
    edges = np.zeros(frames, dtype=np.int64)
    for frame, edge in entry.first_edge[side]:
        edges[frame:] = edge + (entry.edge_step or 1) * (index[frame:] - index[frame : frame + 1])
    return edges


def shared_edges(
    manifest: Manifest, base: TimeBase, entry: Images, numbers: Sequence[FrameNumbers | None], frames: Sequence[int]
) -> tuple[IntArray, list[IntArray]]:
    """Return the edges that all cameras show, and their frames in each.

    By the stated runs. `numbers`, `frames`: numbering of the files of each camera and their count. Of frames with one
    edge the first one is used.
    """
    assert isinstance(entry.first_edge, dict)
    key, shown = f"images.{entry.stereo}.first_edge", list[IntArray]()
    for (side, _), of_camera, count in zip(entry.cameras, numbers, frames, strict=True):
        late = [frame for frame, _ in entry.first_edge[side] if frame >= count]
        if late:
            expected = f"a frame before {count}, their number"
            raise InputError(EDGES_AMBIGUOUS, manifest.path, f"{key}.{side}", found=str(late[0]), expected=expected)
        shown.append(edges_of_runs(entry, side, of_camera, count))
    recorded = np.arange(base.first_with(entry.trigger)[1].edges)
    common = np.asarray(reduce(np.intersect1d, [*shown, recorded]))
    if len(common) < MINIMUM_FRAMES:
        expected = f"at least {MINIMUM_FRAMES} edges of {entry.trigger} that all cameras show"
        raise InputError(EDGES_AMBIGUOUS, manifest.path, key, found=str(len(common)), expected=expected)
    first = [dict(zip(edges[::-1].tolist(), range(len(edges))[::-1], strict=True)) for edges in shown]
    return common, [np.array([of_camera[edge] for edge in common.tolist()]) for of_camera in first]


def frame_edges(
    manifest: Manifest,
    base: TimeBase,
    entry: Images | PointFiles,
    cameras: Mapping[str, FrameNumbers | None],
    frames: int,
) -> tuple[IntArray, tuple[Notice, ...]]:
    """Return the edge number of each frame (F,) by the file numbers.

    Edges are counted from that of the first frame. A number that is missing in all `cameras` belongs to an edge without
    a frame, if there are enough edges. Refused are numbers that differ between the cameras, too few edges, and, without
    `edge_step`, numbers in steps larger than one if the edges between may exist.
    """
    key = f"{'images' if isinstance(entry, Images) else 'points'}.{entry.stereo}"
    available = {side: numbers for side, numbers in cameras.items() if numbers is not None}
    side, first = next(iter(available.items()), ("", None))
    notices = list[Notice]()
    if first is None:
        return np.arange(frames) * (entry.edge_step or 1), ()
    for other, numbers in [(other, cameras[other]) for other in cameras if other != side]:
        index, step = (np.arange(frames), first.step) if numbers is None else (numbers.frame_index, numbers.step)
        if not np.array_equal(index, first.frame_index) or step != first.step:
            found = " and ".join(f"{name}: {_describe_numbers(one)}" for name, one in cameras.items())
            expected = "the same numbers of frames in both cameras, or `first_edge` of each, which uses the common ones"
            raise InputError(IMAGES_REFUSED, manifest.path, f"{key}.{other}", found=found, expected=expected)
        if numbers is None or not (first.exact and numbers.exact):
            continue
        if 0 < abs(int(numbers.first) - int(first.first)) // first.step < frames:
            notices.append(
                Notice(
                    FRAME_NUMBERS_SHIFTED,
                    entry.stereo,
                    first=first.first,
                    second=numbers.first,
                    first_camera=side,
                    second_camera=other,
                )
            )
    trigger = base.first_with(entry.trigger)[1]
    start = entry.first_edge if isinstance(entry.first_edge, int) else 0
    edges, last = trigger.edges - start, int(first.frame_index[-1])
    if entry.edge_step is None and first.step > 1 and first.step * last < edges:
        found = f"none, numbers of files that count by {first.step} and {trigger.edges} edges in {entry.trigger}"
        expected = f"1, where each frame has the next edge, or {first.step}, where edges between have no frame"
        raise InputError(EDGES_AMBIGUOUS, manifest.path, f"{key}.edge_step", found=found, expected=expected)
    every = entry.edge_step or 1
    if not first.missing:
        return first.frame_index * every, tuple(notices)
    values: dict[str, Value] = {
        "count": frames,
        "first": first.first,
        "last": first.last,
        "missing": str(first.missing),
    }
    if every * last < edges:
        notice = Notice(FRAME_NUMBER_GAP, entry.stereo, assignment="their numbers", **values)
        return first.frame_index * every, (*notices, notice)
    if first.exact:
        gap = f"a gap in the numbers of {frames} files ({first.first} to {first.last}): {first.missing} missing"
        expected = f"an edge in {entry.trigger} for each number, {every * last + 1} from the first frame on"
        found = f"{edges} edges and {gap}"
        raise InputError(TOO_FEW_EDGES, manifest.path, f"{key}.trigger", found=found, expected=expected)
    assignment = f"their order, because {entry.trigger} has no edges for the gaps"
    notice = Notice(FRAME_NUMBER_GAP, entry.stereo, assignment=assignment, **values)
    return np.arange(frames) * every, (*notices, notice)


def _describe_numbers(numbers: FrameNumbers | None) -> str:
    """Return range, step and gaps of frame numbers as text."""
    if numbers is None:
        return "no numbers that show gaps"
    by = f" by {numbers.step}" if numbers.step > 1 else ""
    return f"{numbers.first} to {numbers.last}{by}, " + (f"missing {numbers.missing}" if numbers.missing else "no gap")


def _exposure_key(manifest: Manifest, entry: Frames, stated: float | str) -> tuple[Path, str]:
    """Return file and key that state the exposure: of the rig or the manifest."""
    if manifest.rig.stereo[entry.stereo].exposure == stated:
        return manifest.rig_path, f"stereo.{entry.stereo}.exposure"
    return manifest.path, f"{'images' if isinstance(entry, Images) else 'points'}.{entry.stereo}.exposure"


def lines_not_found_error(manifest: Manifest, instruments: str, error: ValueError) -> InputError:
    """Return the error that the signals of some instruments do not show the lines."""
    reason, key = ARGUMENT.sub("", str(error), count=1), "excitation.frequencies"
    return InputError(LINES_NOT_FOUND, manifest.path, key, reason=reason, instruments=instruments)


def pulse_width_error(manifest: Manifest, daq: str, entry: Frames, error: ValueError) -> InputError:
    """Return the error that the exposure is the pulse width, which cannot be measured."""
    file, key = _exposure_key(manifest, entry, PULSE)
    reason = ARGUMENT.sub("", str(error), count=1)
    found = f'"{PULSE}", but the width of the pulses of {entry.trigger} in {daq} cannot be measured ({reason})'
    return InputError(EXPOSURE_REFUSED, file, key, found=found, expected="the exposure in s")
