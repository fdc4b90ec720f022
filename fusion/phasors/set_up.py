"""One sequential set-up, recorded at once: from its files to the phasors of every instrument.

A recording in sequential set-ups (`[[take]]` blocks, the points of a scan) has the same lines in all of them.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from fusion.base import CheckpointStore, Executor, ProgressCallback, Settings
from fusion.errors import ComputeError, InputError
from fusion.instruments.channel import ChannelReading
from fusion.phasors.broadband import BroadbandRecord, broadband_channels, read_broadband
from fusion.phasors.channel_phasors import (
    MIN_BEAT_PERIODS,
    ChannelResult,
    channel_phasors,
    find_channel_lines,
    line_clock,
    line_record,
    line_strength,
)
from fusion.phasors.clocks import refine_ties, tie_clocks_by_motion
from fusion.phasors.phasor_notices import (
    CAMERAS_OUT_OF_STEP,
    FRAMES_OUT_OF_ORDER,
    HARMONIC_UNRESOLVED,
    NO_INSTRUMENT,
    ROWS_INTERLACED,
    TAKES_REFUSED,
    TIME_STAMP_GAP,
)
from fusion.phasors.steadiness import delay_notices, distortions, enlarge_doubted, folding_notices, line_stationarity
from fusion.phasors.stereo_motion import (
    PreparedImages,
    RejectedPair,
    StereoMotion,
    measure_points,
    motion_lines,
    prepare_images,
    reject_decalibrated,
)
from fusion.phasors.timing import TimeBase, tie_daqs
from fusion.phasors.tracked_blocks import tracked_pairs
from fusion.recording.daq_records import FileCache, errors_in_set_up, read_set_ups
from fusion.recording.excitation import KINDS
from fusion.recording.load import Manifest
from fusion.recording.transducer import TRANSDUCERS
from fusion.recording.units import unit_notices
from shaker.lines.frequencies import LineFrequencies
from shaker.sine.aliasing import alias_frequency
from shakercal._common.arrays import FloatArray
from shakercal._common.notices import Notice

if TYPE_CHECKING:
    from fusion.phasors.stereo_phasors import StereoPhasors

LineKey = tuple[float, int]
"""Identity of a line in several set-ups: its nominal fundamental and its multiple of it."""


@dataclass(frozen=True)
class PreparedSetUp:
    """A set-up recorded at once, read and checked; its images are not yet tracked.

    `name`: "take 2", empty for a single set-up. `where`: its position in recording.toml. `lines`: on the clock of its
    first block, None if all its channels are triggers; these have no phasors before `with_channels`. `broadband`:
    channels of a chirp, noise or blows, None for sines.
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
    broadband: BroadbandRecord | None = None

    def refusal(self, key: str, *, found: str, expected: str) -> InputError:
        """Return the error at a key of the set-up."""
        return InputError(TAKES_REFUSED, self.manifest.path, self.where + key, found=found, expected=expected)


@dataclass(frozen=True)
class MeasuredSetUp:
    """A set-up with the phasors of all its instruments at its `lines`.

    On the clock of its first block. `line_notices`: of lines that frame rates cannot resolve, and of rejected pairs.
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
        notices += base.inverted_trigger_notices()
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
    """Read all files set-up by set-up and find the lines.

    No channel is fitted and no image tracked. Clocks are tied, images opened and points read. Files `already` read are
    not read again.
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
            broadband = found if isinstance(found, BroadbandRecord) else None
            base, lines = one.base, None if broadband is None else broadband.lines
            if isinstance(found, LineFrequencies):
                base, lines = refine_ties(one.base, found)
            images = tuple(prepare_images(one.manifest, base, entry, already) for entry in one.manifest.images)
            points = tuple(measure_points(one.manifest, base, entry) for entry in one.manifest.points)
            fitted.append(replace(one, base=base, images=images, points=points, lines=lines, broadband=broadband))
    return tuple(fitted)


def with_channels(prepared: PreparedSetUp, *, shown: bool = True) -> PreparedSetUp:
    """Fit the lines to a set-up's channels; only what pages show needs `shown`."""
    if prepared.lines is None:
        return prepared
    with errors_in_set_up(prepared.manifest.path, prepared.where, prepared.name):
        if prepared.broadband is not None:
            channels, readings = broadband_channels(prepared.base, prepared.broadband)
        else:
            channels, readings = channel_phasors(prepared.manifest, prepared.base, prepared.lines, shown=shown)
    return replace(prepared, channels=channels, readings=readings)


def measure_set_ups(
    set_ups: Sequence[PreparedSetUp],
    settings: Settings,
    progress: ProgressCallback,
    executor: Executor | None = None,
    checkpoints: CheckpointStore | None = None,
) -> list[MeasuredSetUp]:
    """Track the images of all set-ups, and fit lines to channels and motions.

    By threads or an executor. All channels are fitted while the bodies of the first set-up are prepared, so that their
    errors are reported early.
    """
    fitted, measured = list[PreparedSetUp](), list[MeasuredSetUp]()
    for prepared in set_ups:
        lines = None if prepared.broadband is not None else prepared.lines
        with tracked_pairs(prepared.images, settings, executor, checkpoints, lines) as motions:
            fitted = fitted or [with_channels(each) for each in set_ups]
            prepared.base.pulse_widths()  # stored by the records, which provide them later
            with errors_in_set_up(prepared.manifest.path, prepared.where, prepared.name):
                measured.append(fit_motions(fitted[len(measured)], motions(progress)))
    return measured


def fit_motions(prepared: PreparedSetUp, followed: Sequence[StereoMotion | RejectedPair]) -> MeasuredSetUp:
    """Fit the lines to the motion of every stereo pair of a set-up.

    Without the images, motion during an exposure is not corrected.
    """
    from fusion.phasors.shutter_refinement import refine_rolling_shutter  # here, for `check` follows no images
    from fusion.phasors.stereo_phasors import pairs_phasors

    if prepared.broadband is not None:
        return _broadband_motions(prepared, prepared.broadband, followed)
    manifest, base = prepared.manifest, prepared.base
    lines_hz = (
        np.array(manifest.excitation.frequencies or ()) if prepared.lines is None else prepared.lines.frequency_hz
    )
    seen = [
        item
        if isinstance(item, RejectedPair) or any(item.sight.pair.row_time)
        else _as_stated(item, lines_hz, prepared.images)
        for item in followed
    ]
    left_out = [item for item in seen if isinstance(item, RejectedPair)]
    motions = (*(item for item in seen if isinstance(item, StereoMotion)), *prepared.points)
    _check_left(prepared, motions, left_out)
    if prepared.lines is None:
        lines, first = motion_lines(manifest, base, motions)
        clock = base.sight_errors(first)
    else:
        prepared, motions, lines = _tied(prepared, motions, prepared.lines)
        base = prepared.base
        clock = line_clock(base)
    refined = [refine_rolling_shutter(item, prepared.images, lines) if prepared.images else item for item in motions]
    checked = [
        _as_stated(item, lines_hz, ()) if any(item.sight.pair.row_time) else reject_decalibrated(item)
        for item in refined
    ]
    left_out += [item for item in checked if isinstance(item, RejectedPair)]
    motions = tuple(item for item in checked if isinstance(item, StereoMotion))
    _check_left(prepared, motions, left_out)
    strength = line_strength(prepared.readings, lines)
    stereo, aliased, unfitted = pairs_phasors(base, motions, lines, base.line_errors(lines, clock), strength)
    left_out += unfitted
    _check_left(prepared, stereo, left_out)
    changes = line_stationarity(prepared.channels, [item.result for item in stereo], lines, base.results())
    readings = enlarge_doubted(prepared.readings, changes, distortions(prepared.channels, lines))
    rejections = tuple(item.notice for item in left_out)
    return MeasuredSetUp(replace(prepared, readings=readings), lines, stereo, (*rejections, *aliased))


def _broadband_motions(
    prepared: PreparedSetUp, record: BroadbandRecord, followed: Sequence[StereoMotion | RejectedPair]
) -> MeasuredSetUp:
    """Fit the motion of every stereo pair by the channels."""
    from fusion.phasors.broadband_motion import broadband_pairs  # here, for `check` follows no images

    seen = [item if isinstance(item, RejectedPair) else reject_decalibrated(item) for item in followed]
    left_out = [item for item in seen if isinstance(item, RejectedPair)]
    motions = (*(item for item in seen if isinstance(item, StereoMotion)), *prepared.points)
    stereo, unfitted = broadband_pairs(prepared.base, record, motions)
    left_out += unfitted
    _check_left(prepared, stereo, left_out)
    return MeasuredSetUp(prepared, record.lines, stereo, tuple(item.notice for item in left_out))


def _as_stated(
    motion: StereoMotion, frequency_hz: FloatArray, images: Sequence[PreparedImages]
) -> StereoMotion | RejectedPair:
    """Return the motion, or the rejected pair whose cameras are not as stated.

    The rows of `images` are compared.
    """
    from fusion.phasors.frame_order import check_frame_order, check_rows  # here, for `check` follows no images

    checked = check_frame_order(motion, frequency_hz)
    for item in images:
        if item.sight.name == motion.sight.name and isinstance(checked, StereoMotion):
            checked = check_rows(checked, item)
    return checked if isinstance(checked, RejectedPair) else reject_decalibrated(checked)


def _tied(
    prepared: PreparedSetUp, motions: tuple[StereoMotion, ...], lines: LineFrequencies
) -> tuple[PreparedSetUp, tuple[StereoMotion, ...], LineFrequencies]:
    """Return a set-up with clocks tied by the motion, its motions and its lines."""
    base, renewed, lines = tie_clocks_by_motion(prepared.manifest, prepared.base, motions, lines)
    tied = any(tie is not prepared.base.ties[name] for name, tie in base.ties.items())
    prepared = replace(prepared, base=base, lines=lines)
    return (with_channels(prepared) if tied else prepared), renewed, lines


def _check_left(prepared: PreparedSetUp, stereo: Sequence[object], left_out: Sequence[RejectedPair]) -> None:
    """Raise the error of the first rejected pair if no other instrument measures a motion."""
    if left_out and not stereo and all(r.entry.quantity not in TRANSDUCERS for r in prepared.readings):
        error = left_out[0].error
        if isinstance(error, InputError) or error.declared in (
            CAMERAS_OUT_OF_STEP,
            FRAMES_OUT_OF_ORDER,
            ROWS_INTERLACED,
        ):
            raise error
        raise ComputeError(NO_INSTRUMENT, quantity="a motion", reason=f": {error.sentence.rstrip('.')}")


# The lines of all set-ups.


def _lines(set_ups: Sequence[PreparedSetUp]) -> Sequence[LineFrequencies | BroadbandRecord | None]:
    """Find the lines of every set-up on its clock.

    The same in all, and in the same order. A harmonic that one set-up cannot separate from another line is omitted from
    all.
    """
    if KINDS[set_ups[0].manifest.excitation.kind].is_broadband:
        if len(set_ups) > 1:
            raise set_ups[1].refusal("daq", found="several takes", expected="one take for a chirp, noise or blows")
        return [read_broadband(one.manifest, one.base) for one in set_ups]
    first = find_channel_lines(set_ups[0].manifest, set_ups[0].base)
    if len(set_ups) == 1 or first is None:
        return [first for _ in set_ups]
    nominal = tuple(np.unique(first.nominal_hz).tolist())
    separate = [first, *(_further_lines(prepared, nominal) for prepared in set_ups[1:])]
    frequencies = {
        key: f for lines in reversed(separate) for key, f in zip(_keys(lines), lines.frequency_hz, strict=True)
    }
    keys = sorted(frequencies, key=lambda key: float(frequencies[key]))
    hidden: dict[LineKey, str] = {}
    for prepared, lines in zip(set_ups, separate, strict=True):
        hidden |= dict.fromkeys(_indistinct(prepared, lines, keys), prepared.name)
    left_out = [
        Notice(
            HARMONIC_UNRESOLVED, f"{nominal_hz * multiple:g} Hz", take=name, order=multiple, fundamental_hz=nominal_hz
        )
        for (nominal_hz, multiple), name in hidden.items()
    ]
    separate[0] = replace(separate[0], notices=(*separate[0].notices, *left_out))
    return [_extended(lines, [key for key in keys if key not in hidden]) for lines in separate]


def _further_lines(prepared: PreparedSetUp, nominal: tuple[float, ...]) -> LineFrequencies:
    """Find the lines of a further set-up; raise if it does not resolve all fundamentals."""
    manifest = prepared.manifest
    excitation = manifest.excitation.model_copy(update={"frequencies": nominal})
    with errors_in_set_up(manifest.path, prepared.where, prepared.name):
        lines = find_channel_lines(replace(manifest, excitation=excitation), prepared.base)
    missing = [frequency for frequency in nominal if lines is None or frequency not in lines.nominal_hz]
    if lines is None or missing:
        listed = " and ".join(f"{frequency:g} Hz" for frequency in missing)
        expected = f"channels that resolve {listed} as in the first take"
        raise prepared.refusal("daq", found=f"no such line in {prepared.name}", expected=expected)
    return lines


def _keys(lines: LineFrequencies) -> list[LineKey]:
    return list(zip(lines.nominal_hz.tolist(), lines.multiple.tolist(), strict=True))


def _indistinct(prepared: PreparedSetUp, lines: LineFrequencies, keys: Sequence[LineKey]) -> list[LineKey]:
    """Return other set-ups' lines that this one's fastest channel cannot separate."""
    record = line_record(prepared.base)
    added = set(keys) - set(_keys(lines))
    if record is None or not added:
        return []
    length_s = float(record.time_s[-1] - record.time_s[0])
    rate_hz = (len(record.time_s) - 1) / length_s
    aliases = alias_frequency(_extended(lines, keys).frequency_hz, rate_hz)
    hidden = []
    for k, key in enumerate(keys):
        others = np.concatenate([np.delete(aliases, k), [0.0, rate_hz / 2.0]])
        if key in added and np.min(np.abs(others - aliases[k])) * length_s < MIN_BEAT_PERIODS:
            hidden.append(key)
    return hidden


def _extended(lines: LineFrequencies, keys: Sequence[LineKey]) -> LineFrequencies:
    """Return the lines named by `keys`, in that order.

    Lines that were not significant are multiples of their fundamentals. Lines without a key are fitted in addition.
    """
    index_of = {key: index for index, key in enumerate(_keys(lines))}
    if list(index_of) == list(keys):
        return lines
    base = np.array([index_of.get(key, index_of[key[0], 1]) for key in keys])
    further = [f for key, f in zip(index_of, lines.frequency_hz.tolist(), strict=True) if key not in keys]
    factor = np.array([1.0 if key in index_of else float(key[1]) for key in keys])
    return replace(
        lines,
        frequency_hz=lines.frequency_hz[base] * factor,
        u_frequency_hz=lines.u_frequency_hz[base] * factor,
        nominal_hz=np.array([nominal for nominal, _ in keys]),
        multiple=np.array([multiple for _, multiple in keys], dtype=np.int64),
        nuisance_hz=np.concatenate([lines.nuisance_hz, further]),
        why=tuple(lines.why[index_of[key]] if key in index_of else "stands out in another take" for key in keys),
    )
