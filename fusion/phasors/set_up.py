"""One sequential set-up: what was recorded at once, from its files to the phasors of every instrument.

A recording in sequential set-ups (`[[take]]` blocks, the points of a scan) finds its lines in all of them together.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from fusion.base import CheckpointStore, Executor, ProgressCallback, Settings
from fusion.errors import ComputeError, InputError
from fusion.instruments.channel import ChannelReading
from fusion.instruments.transducer import TRANSDUCERS
from fusion.phasors.channel_phasors import (
    MIN_BEAT_PERIODS,
    ChannelResult,
    channel_phasors,
    delay_notices,
    find_channel_lines,
    folding_notices,
    line_clock,
    line_record,
    line_strength,
    refine_ties,
)
from fusion.phasors.phasor_notices import HARMONIC_UNRESOLVED, NO_INSTRUMENT, TAKES_REFUSED, TIME_STAMP_GAP
from fusion.phasors.steadiness import distortions, enlarge_doubted, line_stationarity
from fusion.phasors.stereo_motion import (
    PreparedImages,
    RejectedPair,
    StereoMotion,
    measure_points,
    motion_lines,
    prepare_images,
    reject_decalibrated,
    tracked_pairs,
)
from fusion.phasors.timing import TimeBase, tie_daqs
from fusion.recording.daq_records import FileCache, errors_in_set_up, read_set_ups
from fusion.recording.load import Manifest
from fusion.recording.units import unit_notices
from shaker.lines.frequencies import LineFrequencies
from shaker.sine.aliasing import alias_frequency
from shakercal._common.notices import Notice

if TYPE_CHECKING:
    from fusion.phasors.stereo_phasors import StereoPhasors

LineKey = tuple[float, int]
"""What makes lines of two set-ups the same: their nominal fundamental and their multiple of it."""


@dataclass(frozen=True)
class PreparedSetUp:
    """What was recorded at once, read and checked; its images are opened and not yet followed.

    `name`: "take 2", empty where a recording has one set-up only; `where`: its place in recording.toml. `lines`: on its
    own first block's clock, None where all its channels are triggers. Those have no phasors before `with_channels`.
    """

    name: str
    where: str
    manifest: Manifest
    base: TimeBase
    images: tuple[PreparedImages, ...]
    points: tuple[StereoMotion, ...]
    lines: LineFrequencies | None = None
    channels: tuple[ChannelResult, ...] = ()
    readings: tuple[ChannelReading, ...] = ()

    def refusal(self, key: str, *, found: str, expected: str) -> InputError:
        """Return the error at a key of the set-up."""
        return InputError(TAKES_REFUSED, self.manifest.path, self.where + key, found=found, expected=expected)


@dataclass(frozen=True)
class MeasuredSetUp:
    """A set-up with the phasors of all its instruments at its `lines`, counted on its own first block's clock.

    `aliased`: what was said of the lines that camera rates cannot tell apart, and of pairs that were left out.
    """

    prepared: PreparedSetUp
    lines: LineFrequencies
    stereo: tuple[StereoPhasors, ...]
    line_notices: tuple[Notice, ...]

    @property
    def notices(self) -> tuple[Notice, ...]:
        """Return the notices of clocks, lines, channels and stereo pairs of the set-up."""
        base = self.prepared.base
        clocks = [(daq, notice) for (daq, _), fit in base.triggers.items() for notice in fit.notices]
        clocks += [(daq, notice) for daq, tie in base.ties.items() if tie is not None for notice in tie.notices]
        notices: list[Notice] = [notice.at(f"{daq}, {notice.where}") for daq, notice in clocks]
        notices += base.inverted()
        notices += [Notice(TIME_STAMP_GAP, r.entry.name, gap=gap) for r in base.records for gap in r.gaps]
        notices += [notice for r in base.records for notice in unit_notices(self.prepared.manifest, r.entry, r.raw)]
        notices += [
            *delay_notices(self.prepared.readings, self.prepared.manifest.path),
            *self.lines.notices,
            *self.line_notices,
        ]
        notices += [notice for channel in self.prepared.channels for notice in channel.notices]
        notices += folding_notices(self.prepared.channels, self.prepared.readings, self.lines)
        notices += [found.notice for found in distortions(self.prepared.channels, self.lines)]
        notices += [notice for item in self.stereo for notice in item.notices]
        return tuple(notices)


def prepare_set_ups(manifest: Manifest, already: FileCache | None = None) -> tuple[PreparedSetUp, ...]:
    """Read everything that was recorded, set-up by set-up, and find its lines; no channel is fitted, no image followed.

    Clocks are tied, images opened, points read; what was `already` read of the files is not read again.
    """
    parts = read_set_ups(manifest, already)
    tied = []
    for number, recorded in enumerate(parts, 1):
        name, part = f"take {number}" if len(parts) > 1 else "", recorded.manifest
        with errors_in_set_up(part.path, recorded.where, name):
            tied.append(PreparedSetUp(name, recorded.where, part, tie_daqs(part, recorded.records), (), ()))
    fitted = []
    for one, found in zip(tied, _lines(tied), strict=True):
        with errors_in_set_up(one.manifest.path, one.where, one.name):
            base, lines = (one.base, None) if found is None else refine_ties(one.base, found)
            images = tuple(prepare_images(one.manifest, base, entry, already) for entry in one.manifest.images)
            points = tuple(measure_points(one.manifest, base, entry) for entry in one.manifest.points)
            fitted.append(replace(one, base=base, images=images, points=points, lines=lines))
    return tuple(fitted)


def with_channels(prepared: PreparedSetUp, *, shown: bool = True) -> PreparedSetUp:
    """Fit the lines of a set-up to its channels; where nothing is `shown`, without what only pages and notices need."""
    if prepared.lines is None:
        return prepared
    with errors_in_set_up(prepared.manifest.path, prepared.where, prepared.name):
        channels, readings = channel_phasors(prepared.manifest, prepared.base, prepared.lines, shown=shown)
    return replace(prepared, channels=channels, readings=readings)


def measure_set_ups(
    set_ups: Sequence[PreparedSetUp],
    settings: Settings,
    progress: ProgressCallback,
    executor: Executor | None = None,
    checkpoints: CheckpointStore | None = None,
) -> list[MeasuredSetUp]:
    """Follow the images of all set-ups, here or by an executor, and fit the lines to channels and motions.

    All channels are fitted while the bodies of the first set-up are prepared: what is wrong with one is told early.
    """
    fitted, measured = list[PreparedSetUp](), list[MeasuredSetUp]()
    for opened in set_ups:
        with tracked_pairs(opened.images, settings, executor, checkpoints, opened.lines) as motions:
            fitted = fitted or [with_channels(each) for each in set_ups]
            opened.base.pulses()  # kept by the records, which are asked for them in the end
            with errors_in_set_up(opened.manifest.path, opened.where, opened.name):
                measured.append(_measured(fitted[len(measured)], motions(progress)))
    return measured


def _measured(opened: PreparedSetUp, followed: Sequence[StereoMotion | RejectedPair]) -> MeasuredSetUp:
    """Fit the lines to the motion of every stereo pair of a set-up."""
    from fusion.phasors.shutter_refinement import refine_rolling_shutter  # here, for `check` follows no images
    from fusion.phasors.stereo_phasors import pairs_phasors

    manifest, base = opened.manifest, opened.base
    seen = [
        item if isinstance(item, RejectedPair) or any(item.sight.pair.row_time) else reject_decalibrated(item)
        for item in followed
    ]
    left_out = [item for item in seen if isinstance(item, RejectedPair)]
    motions = (*(item for item in seen if isinstance(item, StereoMotion)), *opened.points)
    _check_left(opened, motions, left_out)
    if opened.lines is None:
        lines, first = motion_lines(manifest, base, motions)
        clock = base.sight_errors(first)
    else:
        opened, motions, lines = _tied(opened, motions, opened.lines)
        base = opened.base
        clock = line_clock(base)
    again = [reject_decalibrated(refine_rolling_shutter(item, opened.images, lines)) for item in motions]
    left_out += [item for item in again if isinstance(item, RejectedPair)]
    motions = tuple(item for item in again if isinstance(item, StereoMotion))
    _check_left(opened, motions, left_out)
    strength = line_strength(opened.readings, lines)
    stereo, aliased, unfitted = pairs_phasors(base, motions, lines, base.line_errors(lines, clock), strength)
    left_out += unfitted
    _check_left(opened, stereo, left_out)
    changes = line_stationarity(opened.channels, [item.result for item in stereo], lines, base.results())
    readings = enlarge_doubted(opened.readings, changes, distortions(opened.channels, lines))
    told = tuple(item.notice for item in left_out)
    return MeasuredSetUp(replace(opened, readings=readings), lines, stereo, (*told, *aliased))


def _tied(
    opened: PreparedSetUp, motions: tuple[StereoMotion, ...], lines: LineFrequencies
) -> tuple[PreparedSetUp, tuple[StereoMotion, ...], LineFrequencies]:
    """Return a set-up, what its pairs saw, and its lines, with clocks that the motion ties; channels on others anew."""
    from fusion.phasors.clocks import tie_clocks_by_motion

    base, renewed, lines = tie_clocks_by_motion(opened.manifest, opened.base, motions, lines)
    tied = any(tie is not opened.base.ties[name] for name, tie in base.ties.items())
    opened = replace(opened, base=base, lines=lines)
    return (with_channels(opened) if tied else opened), renewed, lines


def _check_left(opened: PreparedSetUp, stereo: Sequence[object], left_out: Sequence[RejectedPair]) -> None:
    """Raise why the first pair is left out where no other pair and no channel of the set-up measures a motion."""
    if left_out and not stereo and all(r.entry.quantity not in TRANSDUCERS for r in opened.readings):
        error = left_out[0].error
        if isinstance(error, InputError):
            raise error
        raise ComputeError(NO_INSTRUMENT, quantity="a motion", reason=f": {error.sentence}")


# The lines of all set-ups.


def _lines(set_ups: Sequence[PreparedSetUp]) -> list[LineFrequencies | None]:
    """Find the lines of every set-up, each on its own clock: the same in all of them, and in the same order.

    A harmonic that one set-up cannot tell from another line is left out of all.
    """
    first = find_channel_lines(set_ups[0].manifest, set_ups[0].base)
    if len(set_ups) == 1 or first is None:
        return [first for _ in set_ups]
    nominal = tuple(np.unique(first.nominal_hz).tolist())
    own = [first, *(_own_lines(opened, nominal) for opened in set_ups[1:])]
    known = {key: f for lines in reversed(own) for key, f in zip(_keys(lines), lines.frequency_hz, strict=True)}
    keys = sorted(known, key=lambda key: float(known[key]))
    hidden: dict[LineKey, str] = {}
    for opened, lines in zip(set_ups, own, strict=True):
        hidden |= dict.fromkeys(_indistinct(opened, lines, keys), opened.name)
    left_out = [
        Notice(
            HARMONIC_UNRESOLVED, f"{nominal_hz * multiple:g} Hz", take=name, order=multiple, fundamental_hz=nominal_hz
        )
        for (nominal_hz, multiple), name in hidden.items()
    ]
    own[0] = replace(own[0], notices=(*own[0].notices, *left_out))
    return [_extended(lines, [key for key in keys if key not in hidden]) for lines in own]


def _own_lines(opened: PreparedSetUp, nominal: tuple[float, ...]) -> LineFrequencies:
    """Find the lines of a further set-up; refuse one whose channels cannot tell all fundamentals of the first."""
    manifest = opened.manifest
    excitation = manifest.excitation.model_copy(update={"frequencies": nominal})
    with errors_in_set_up(manifest.path, opened.where, opened.name):
        lines = find_channel_lines(replace(manifest, excitation=excitation), opened.base)
    missing = [frequency for frequency in nominal if lines is None or frequency not in lines.nominal_hz]
    if lines is None or missing:
        listed = " and ".join(f"{frequency:g} Hz" for frequency in missing)
        expected = f"channels that resolve {listed} as in the first take"
        raise opened.refusal("daq", found=f"no such line in {opened.name}", expected=expected)
    return lines


def _keys(lines: LineFrequencies) -> list[LineKey]:
    return list(zip(lines.nominal_hz.tolist(), lines.multiple.tolist(), strict=True))


def _indistinct(opened: PreparedSetUp, lines: LineFrequencies, keys: Sequence[LineKey]) -> list[LineKey]:
    """Return the lines of other set-ups that the fastest channel of this one cannot tell from another or from zero."""
    record = line_record(opened.base)
    added = set(keys) - set(_keys(lines))
    if record is None or not added:
        return []
    length_s = float(record.time_s[-1] - record.time_s[0])
    rate_hz = (len(record.time_s) - 1) / length_s
    places = alias_frequency(_extended(lines, keys).frequency_hz, rate_hz)
    hidden = []
    for k, key in enumerate(keys):
        others = np.concatenate([np.delete(places, k), [0.0, rate_hz / 2.0]])
        if key in added and np.min(np.abs(others - places[k])) * length_s < MIN_BEAT_PERIODS:
            hidden.append(key)
    return hidden


def _extended(lines: LineFrequencies, keys: Sequence[LineKey]) -> LineFrequencies:
    """Return the lines named by `keys`, in that order; those that did not stand out here are multiples of their own.

    Lines that are not named are fitted beside them.
    """
    own = {key: place for place, key in enumerate(_keys(lines))}
    if list(own) == list(keys):
        return lines
    base = np.array([own.get(key, own[key[0], 1]) for key in keys])
    beside = [f for key, f in zip(own, lines.frequency_hz.tolist(), strict=True) if key not in keys]
    factor = np.array([1.0 if key in own else float(key[1]) for key in keys])
    return replace(
        lines,
        frequency_hz=lines.frequency_hz[base] * factor,
        u_frequency_hz=lines.u_frequency_hz[base] * factor,
        nominal_hz=np.array([nominal for nominal, _ in keys]),
        multiple=np.array([multiple for _, multiple in keys], dtype=np.int64),
        nuisance_hz=np.concatenate([lines.nuisance_hz, beside]),
        why=tuple(lines.why[own[key]] if key in own else "stands out in another take" for key in keys),
    )
