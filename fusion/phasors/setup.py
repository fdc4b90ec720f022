"""One sequential set-up, and what ties it to the first."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from fusion.base import AnyNotice, Crew, InputError, ProgressCallback, Settings
from fusion.estimation.measurement_model import PERIODIC, PulseExposure, Reading, RelativeError, StereoReading, added_up
from fusion.phasors.channels import APART_PERIODS, channel_results, find_channel_lines, line_record
from fusion.phasors.results import ChannelResult, TakeResult
from fusion.phasors.stereo_motion import (
    OpenImages,
    StereoMotion,
    measure_pairs,
    measure_points,
    motion_lines,
    open_images,
)
from fusion.phasors.stereo_phasors import StereoPhasors, channel_readings, pairs_phasors, stereo_readings
from fusion.phasors.timing import TimeBase, tie_daqs
from fusion.recording.files import TakeRecords, read_takes, told_in
from fusion.recording.load import Manifest
from shaker.arrays import BoolArray, ComplexArray, FloatArray, Notice
from shaker.lines.aliasing import alias_frequency
from shaker.lines.frequencies import Lines
from shaker.sine.phasor import Phasors, real_stacked_diagonal

# One take: what was recorded at once, from its files to the phasors of every instrument.


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


# What ties takes to each other: phasors of take i times R_1/R_i of the reference, and what that leaves open.


LEAST_SNR = 6.0
"""Of its own standard uncertainty: what the reference must reach at a line; 1/R_i is biased by u²/R², 3 % there."""
TOLD_DRIFT, LARGE_DRIFT = 1e-3, 2e-2
SAME_FREQUENCY = 1e-4  # relative: what clocks and generators differ by from take to take
KEPT_NOISE = 1e-6  # of a covariance that an unknown has taken over: enough to stay positive definite


@dataclass(frozen=True)
class Referral:
    """How one take is referred to the first: its phasors times `factor` (K,), NaN at lines without a reference.

    `first`: this is the take that all are referred to. `frequency_hz` (K,): lines of the first take, at which results
    are given. `noise`: the reference's noise in this take as relative errors (K, 1) of its phasor, at lines where it
    stands out; `errors`: those that all referred phasors of the take share.
    """

    name: str
    first: bool
    frequency_hz: FloatArray
    factor: ComplexArray
    noise: tuple[RelativeError, ...]
    errors: tuple[RelativeError, ...]
    result: TakeResult

    def phasors(self, phasors: Phasors) -> Phasors:
        """Return phasors of the take as those of the first."""
        return replace(phasors.scaled(self.factor[:, None]), frequency_hz=self.frequency_hz)

    def reading(self, reading: Reading) -> Reading:
        """Return a channel of the take as one of the first, its clock's errors among its own."""
        chain = replace(reading.chain, clock=f"{self.name}: {reading.chain.clock}", u_clock_s=0.0)
        further = added_up([*_clock_error(self.name, reading), *self.errors])
        return Reading(reading.entry, self.phasors(reading.phasors), chain, further)

    def reference(self, reading: Reading) -> Reading:
        """Return the reference channel of the first take, its noise being that which all other takes share."""
        known = np.zeros(len(self.frequency_hz), dtype=np.bool_)
        for error in self.noise:
            known |= error.relative[:, 0] != 0.0
        phasors = reading.phasors
        kept = np.where(known, KEPT_NOISE, 1.0)[:, None, None]
        own = self.reading(replace(reading, phasors=replace(phasors, covariance=phasors.covariance * kept)))
        return replace(own, further=added_up([*own.further, *self.noise]))

    def stereo(self, pair: StereoReading) -> StereoReading:
        """Return a stereo pair of the take as one of the first; what its frames have in common is the take's own."""
        effects: Mapping[str, ComplexArray] = {
            f"{what}, {self.name}" if what == PERIODIC else what: change * self.factor[:, None]
            for what, change in pair.effects.items()
        }
        pulse = pair.pulse
        return replace(
            pair,
            phasors=self.phasors(pair.phasors),
            effects=effects,
            trigger=(f"{self.name}: {pair.trigger[0]}", pair.trigger[1]),
            pulse=None if pulse is None else PulseExposure(f"{self.name}: {pulse.trigger}", pulse.width_s, pulse.u_s),
            further=self.errors,
        )


def referrals(takes: Sequence[OpenTake]) -> tuple[Referral, ...]:
    """Tie takes to the first one by the channel with `reference = true` in all of them.

    With R_i the reference's phasors, delay and response taken off, the factor is R_1/R_i. Its scale, delay and response
    cancel; its noise in take i is one complex unknown per line for all phasors of that take, its noise in the first
    take one for all other takes and for itself. A drift of its amplitude between the takes is made good, but what else
    changed with it is not known: d = ||R_i/R_1| - 1|, less its noise and with twice the relative change of the
    frequency, acts on magnitude and phase of all phasors of take i at that line (type B, rectangular of half-width d).
    """
    references = [_reference(take) for take in takes]
    return tuple(_referral(takes, references, place) for place in range(len(takes)))


def drift_notices(found: Sequence[Referral], driven: BoolArray) -> tuple[Notice, ...]:
    """Say how far the reference's amplitude, and the frequency, at the `driven` lines (K,) changed between takes."""
    notices = []
    for referral in found:
        result = referral.result
        changed = np.abs(result.frequency_hz / referral.frequency_hz - 1.0)
        for k in np.flatnonzero(driven & np.isfinite(result.drift)):
            at = f"{referral.frequency_hz[k]:.6g} Hz"
            if abs(result.drift[k]) > TOLD_DRIFT:
                text = (
                    f"the reference {result.reference} reads {100.0 * result.drift[k]:+.2g} % at {at} against the "
                    "first take; the level is made good, the drift is part of the uncertainty"
                )
                large = abs(result.drift[k]) > LARGE_DRIFT
                notices.append(Notice("warning" if large else "info", f"{referral.name}: {text}", referral.name))
            if changed[k] > SAME_FREQUENCY:
                text = f"driven at {result.frequency_hz[k]:.7g} Hz, in the first take at {at}"
                notices.append(Notice("warning", f"{referral.name}: {text}", referral.name))
    return tuple(notices)


def _reference(take: OpenTake) -> Reading:
    """Return the channel that ties a take to the others."""
    marked = [reading for reading in take.readings if reading.entry.reference]
    if len(marked) != 1:
        expected = "one channel with reference = true, the same in every take"
        raise InputError(take.manifest.path, f"{take.where}daq", found=f"{len(marked) or 'none'}", expected=expected)
    return marked[0]


def _referral(takes: Sequence[OpenTake], references: Sequence[Reading], place: int) -> Referral:
    """Tie one take to the first."""
    take, first, own = takes[place], references[0], references[place]
    stands_out = _standing_out(own) & _standing_out(first)
    _check_driven(take, own, stands_out)
    base_hz = first.phasors.frequency_hz
    here, there = own.phasors.value[:, 0], first.phasors.value[:, 0]
    factor = np.full(len(base_hz), complex(np.nan, np.nan))
    np.divide(there, here, out=factor, where=stands_out)
    u_drift = np.hypot(_u_relative(own), _u_relative(first)) if place else np.zeros(len(base_hz))
    drift = 1.0 / np.abs(factor) - 1.0
    noise = _noise(take.name, own, base_hz, _standing_out(own))
    errors: tuple[RelativeError, ...] = ()
    if place:
        known = np.sqrt(np.maximum(drift**2 - u_drift**2, 0.0))
        half_width = known + 2.0 * np.abs(own.phasors.frequency_hz / base_hz - 1.0)
        inherited = [*_noise(takes[0].name, first, base_hz, stands_out), *_clock_error(takes[0].name, first)]
        lost = [*noise, *_clock_error(take.name, own)]
        taken_off = [replace(error, relative=-error.relative) for error in lost]
        errors = added_up([*inherited, *taken_off, *_drift(take.name, base_hz, np.where(stands_out, half_width, 0.0))])
    result = TakeResult(
        name=take.name,
        reference=own.entry.name,
        frequency_hz=own.phasors.frequency_hz,
        value=here,
        factor=factor,
        drift=drift,
        u_drift=u_drift,
    )
    used = factor if place else np.ones(len(base_hz), dtype=np.complex128)
    return Referral(take.name, place == 0, base_hz, used, noise, errors, result)


def _u_relative(reading: Reading) -> FloatArray:
    """Standard uncertainty (K,) of real and imaginary part over the amplitude, mean of both."""
    phasors = reading.phasors
    u = np.sqrt((phasors.u_re[:, 0] ** 2 + phasors.u_im[:, 0] ** 2) / 2.0)
    size = np.abs(phasors.value[:, 0])
    return np.asarray(np.divide(u, size, out=np.full(len(u), np.inf), where=size > 0.0))


def _standing_out(reading: Reading) -> BoolArray:
    """Lines (K,) at which a reference is far above its noise."""
    return np.asarray(np.nan_to_num(_u_relative(reading), nan=np.inf) * LEAST_SNR < 1.0)


def _check_driven(take: OpenTake, reference: Reading, stands_out: BoolArray) -> None:
    """Refuse a reference that does not show a driven line."""
    driven = np.ones(0, dtype=np.bool_) if take.lines is None else take.lines.multiple == 1
    lost = np.flatnonzero(driven & ~stands_out)
    if len(lost):
        clock = next(daq for daq in take.manifest.daq if reference.entry in daq.channel)
        key = f"{take.where}daq.{clock.name}.channel.{reference.entry.name}.reference"
        amplitude, u = np.abs(reference.phasors.value[lost[0], 0]), reference.phasors.u_re[lost[0], 0]
        frequency = f"{reference.phasors.frequency_hz[lost[0]]:.6g} Hz"
        found = f"an amplitude of {amplitude:.2g} with a standard uncertainty of {u:.2g} in {take.name}"
        expected = f"a channel that shows the driven line at {frequency} in every take"
        raise InputError(take.manifest.path, key, found=found, expected=expected)


def _noise(name: str, reading: Reading, frequency_hz: FloatArray, lines: BoolArray) -> tuple[RelativeError, ...]:
    """Relative errors (K, 1) of a reference's phasor from its noise: two real unknowns at each of the lines chosen."""
    found = []
    phasors = reading.phasors
    for k in np.flatnonzero(lines):
        (turn,) = real_stacked_diagonal(1.0 / phasors.value[k : k + 1])
        variances, vectors = np.linalg.eigh(turn @ phasors.covariance[k] @ turn.T)
        for part, (variance, vector) in enumerate(zip(variances.tolist(), vectors.T, strict=True)):
            relative = np.zeros((len(frequency_hz), 1), dtype=np.complex128)
            relative[k, 0] = np.sqrt(max(variance, 0.0)) * complex(*vector)
            unknown = f"reference noise of {name} at {frequency_hz[k]:.9g} Hz, part {part + 1}"
            found.append(RelativeError(unknown, "reference noise", 1.0, "1", "recording", relative, "A"))
    return tuple(found)


def _clock_error(name: str, reading: Reading) -> tuple[RelativeError, ...]:
    """Relative error (K, 1) of a channel from the tie of its clock to the first one of its take."""
    chain = reading.chain
    if chain.u_clock_s == 0.0:
        return ()
    relative = np.asarray(-2j * np.pi * reading.phasors.frequency_hz[:, None] * chain.u_clock_s)
    label = f"clock {chain.clock}: time"
    return (RelativeError(f"clock {name}: {chain.clock}: time", label, chain.u_clock_s, "s", "recording", relative),)


def _drift(name: str, frequency_hz: FloatArray, half_width: FloatArray) -> Iterator[RelativeError]:
    """Relative errors (K, 1) of magnitude and phase of all phasors of a take whose reference drifted this far."""
    label = "drift between takes"
    for k in np.flatnonzero(half_width > 0.0):
        u = float(half_width[k]) / np.sqrt(3.0)
        for part, unit, turn in (("magnitude", "1", 1.0 + 0.0j), ("phase", "rad", 1.0j)):
            relative = np.zeros((len(frequency_hz), 1), dtype=np.complex128)
            relative[k, 0] = u * turn
            unknown = f"{label}: {part} of {name} at {frequency_hz[k]:.9g} Hz"
            yield RelativeError(unknown, label, u, unit, "recording", relative)
