"""One take: what was recorded at once, from its files to the phasors of every instrument."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np

from fusion.channels import APART_PERIODS, channel_results, find_channel_lines, line_record
from fusion.crew import Crew
from fusion.errors import InputError
from fusion.manifest import Manifest
from fusion.measured_results import ChannelResult
from fusion.notices import AnyNotice, Notice
from fusion.observe import Reading, StereoReading
from fusion.readings import channel_readings, stereo_readings
from fusion.records import TakeRecords, read_takes, told_in
from fusion.settings import ProgressCallback, Settings
from fusion.stereo_motion import OpenImages, StereoMotion, measure_points, motion_lines, open_images
from fusion.stereo_pairs import measure_pairs
from fusion.stereo_phasors import StereoPhasors, pairs_phasors
from fusion.timing import TimeBase, tie_daqs
from shaker.signals.folding import alias_frequency
from shaker.signals.frequencies import Lines

Key = tuple[float, int]
"""What makes lines of two takes the same: their nominal fundamental and their multiple of it."""


@dataclass(frozen=True)
class OpenTake:
    """What was recorded at once, read and checked; its images are opened and not yet followed.

    `name`: "take 2", empty where a recording has one take only; `where`: its place in recording.toml. `lines`: on its
    own first block's clock, None where all its channels are triggers.
    """

    name: str
    where: str
    manifest: Manifest
    base: TimeBase
    images: tuple[OpenImages, ...]
    points: tuple[StereoMotion, ...]
    lines: Lines | None = None
    channels: tuple[ChannelResult, ...] = ()
    readings: tuple[Reading, ...] = ()


@dataclass(frozen=True)
class MeasuredTake:
    """A take with the phasors of all its instruments at its `lines`, counted on its own first block's clock.

    `folded`: what was said of the lines that camera rates cannot tell apart.
    """

    opened: OpenTake
    lines: Lines
    stereo: tuple[StereoPhasors, ...]
    pairs: tuple[StereoReading, ...]
    folded: tuple[AnyNotice, ...]

    @property
    def notices(self) -> tuple[AnyNotice, ...]:
        """Return what clocks, lines, channels and stereo pairs of the take want the user to know."""
        found = [*_clock_notices(self.opened.base), *self.lines.notices, *self.folded]
        found += [notice for channel in self.opened.channels for notice in channel.notices]
        found += [notice for item in self.stereo for notice in item.notices]
        return tuple(found)


def open_takes(manifest: Manifest) -> tuple[OpenTake, ...]:
    """Read everything that was recorded, take by take, and fit the lines to the channels; no image is followed yet."""
    parts = read_takes(manifest)
    names = [f"take {number}" if len(parts) > 1 else "" for number in range(1, len(parts) + 1)]
    takes = [_opened(name, part) for name, part in zip(names, parts, strict=True)]
    return tuple(_with_channels(take, lines) for take, lines in zip(takes, _lines(takes), strict=True))


def measure_take(
    take: OpenTake, settings: Settings, progress: ProgressCallback, crew: Crew | None = None
) -> MeasuredTake:
    """Follow the images of a take, or have a crew do it, and fit the lines to the motion of every stereo pair."""
    with told_in(take.manifest.path, take.where, take.name):
        motions = (*measure_pairs(take.manifest, take.images, settings, progress, crew), *take.points)
        lines = motion_lines(take.manifest, take.base, motions) if take.lines is None else take.lines
        stereo, folded = pairs_phasors(motions, lines)
    pairs = stereo_readings(take.manifest, take.base, take.readings, stereo, lines)
    return MeasuredTake(take, lines, stereo, pairs, folded)


def _opened(name: str, part: TakeRecords) -> OpenTake:
    """Tie the clocks of a take, open its images and read its points."""
    manifest = part.manifest
    with told_in(manifest.path, part.where, name):
        base = tie_daqs(manifest, part.records)
        images = tuple(open_images(manifest, base, entry) for entry in manifest.images)
        points = tuple(measure_points(manifest, base, entry) for entry in manifest.points)
    return OpenTake(name, part.where, manifest, base, images, points)


def _with_channels(take: OpenTake, lines: Lines | None) -> OpenTake:
    """Fit the lines to all channels of a take."""
    if lines is None:
        return take
    with told_in(take.manifest.path, take.where, take.name):
        channels = channel_results(take.manifest, take.base, lines)
        return replace(take, lines=lines, channels=channels, readings=channel_readings(take.base, channels))


def _lines(takes: Sequence[OpenTake]) -> list[Lines | None]:
    """Find the lines of every take, each on its own clock: the same in all of them, and in the same order."""
    first = find_channel_lines(takes[0].manifest, takes[0].base)
    if len(takes) == 1 or first is None:
        return [first for _ in takes]
    nominal = tuple(np.unique(first.nominal_hz).tolist())
    found = [first]
    for take in takes[1:]:
        excitation = take.manifest.excitation.model_copy(update={"frequencies": nominal})
        with told_in(take.manifest.path, take.where, take.name):
            lines = find_channel_lines(replace(take.manifest, excitation=excitation), take.base)
        found.append(_same_fundamentals(take, lines, nominal))
    known = {key: f for lines in reversed(found) for key, f in zip(_keys(lines), lines.frequency_hz, strict=True)}
    keys = sorted(known, key=lambda key: float(known[key]))
    folded = {key: take.name for take, lines in zip(takes, found, strict=True) for key in _folded(take, lines, keys)}
    found[0] = replace(found[0], notices=(*found[0].notices, *(_left_out(*item) for item in folded.items())))
    return [_extended(lines, [key for key in keys if key not in folded]) for lines in found]


def _left_out(key: Key, take: str) -> Notice:
    """Say that a harmonic of one take is no line of the recording."""
    text = f"harmonic {key[1]} of {key[0]:g} Hz is left out: {take} cannot tell it from another line"
    return Notice("warning", text, f"{key[0] * key[1]:g} Hz")


def _same_fundamentals(take: OpenTake, lines: Lines | None, nominal: Sequence[float]) -> Lines:
    """Refuse a take whose channels cannot tell all fundamentals of the first take."""
    there = [] if lines is None else np.unique(lines.nominal_hz).tolist()
    missing = [frequency for frequency in nominal if frequency not in there]
    if lines is None or missing:
        listed = " and ".join(f"{frequency:g} Hz" for frequency in missing)
        found, expected = f"no such line in {take.name}", f"channels that tell {listed} as those of the first take do"
        raise InputError(take.manifest.path, f"{take.where}daq", found, expected)
    return lines


def _keys(lines: Lines) -> list[Key]:
    """Return what identifies each line over all takes."""
    return list(zip(lines.nominal_hz.tolist(), lines.multiple.tolist(), strict=True))


def _folded(take: OpenTake, lines: Lines, keys: Sequence[Key]) -> Iterator[Key]:
    """Yield the lines of other takes that the fastest channel of this one cannot tell from another or from zero."""
    record = line_record(take.base)
    added = set(keys) - set(_keys(lines))
    if record is None or not added:
        return
    length_s = float(record.time_s[-1] - record.time_s[0])
    rate_hz = (len(record.time_s) - 1) / length_s
    places = alias_frequency(_extended(lines, keys).frequency_hz, rate_hz)
    for k, key in enumerate(keys):
        others = np.concatenate([np.delete(places, k), [0.0, rate_hz / 2.0]])
        if key in added and np.min(np.abs(others - places[k])) * length_s < APART_PERIODS:
            yield key


def _extended(lines: Lines, keys: Sequence[Key]) -> Lines:
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


def _clock_notices(base: TimeBase) -> list[AnyNotice]:
    """Return the remarks of triggers and clock ties, naming their block."""
    found = [(daq, notice) for (daq, _), fit in base.triggers.items() for notice in fit.notices]
    found += [(daq, notice) for daq, tie in base.ties.items() if tie is not None for notice in tie.notices]
    return [Notice(notice.severity, f"{daq}: {notice.text}", daq) for daq, notice in found]
