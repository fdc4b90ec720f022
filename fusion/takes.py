"""All takes of a recording as if they had been recorded at once: everything referred to the first one."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from fusion.drift import drift_notices as steadiness_notices
from fusion.drift import drifts
from fusion.measured_results import ChannelResult, ClockResult, StereoResult, TakeResult
from fusion.notices import AnyNotice
from fusion.observe import Reading, StereoReading
from fusion.pool import pool_readings
from fusion.referral import Referral, drift_notices
from fusion.take import MeasuredTake
from shaker._checks import FloatArray
from shaker.signals.frequencies import Lines
from shaker.signals.stationarity import Stationarity


@dataclass(frozen=True)
class Joined:
    """What a recording consists of, on the clock and at the lines of its first take.

    `readings`, `pairs`: every channel and stereo pair with its errors; `takes`: empty where there is one only.
    """

    lines: Lines
    clocks: tuple[ClockResult, ...]
    channels: tuple[ChannelResult, ...]
    stereo: tuple[StereoResult, ...]
    readings: tuple[Reading, ...]
    pairs: tuple[StereoReading, ...]
    takes: tuple[TakeResult, ...]
    folded: tuple[AnyNotice, ...]
    notices: tuple[AnyNotice, ...]


def join_takes(takes: Sequence[MeasuredTake], tied: Sequence[Referral]) -> Joined:
    """Refer all takes to the first and name what they hold by its take; `tied` is empty for a recording of one take."""
    if not tied:
        return _alone(takes[0])
    lines = takes[0].lines
    both = list(zip(takes, tied, strict=True))
    pairs = [referral.stereo(pair) for take, referral in both for pair in take.pairs]
    readings, pooled = pool_readings([(referral.name, _referred(take, referral)) for take, referral in both])
    clocks = [_named(c, take.opened.name) for take in takes for c in take.opened.base.results()]
    channels = [_channel(c, take, referral) for take, referral in both for c in take.opened.channels]
    stereo = _stereo(takes)
    notices = [_told(notice, take.opened.name) for take in takes for notice in take.notices]
    notices += [*drift_notices(tied, lines.multiple == 1), *pooled]
    return Joined(
        lines=lines,
        clocks=tuple(clocks),
        channels=tuple(channels),
        stereo=stereo,
        readings=readings,
        pairs=tuple(pairs),
        takes=tuple(referral.result for referral in tied),
        folded=tuple(notice for take in takes for notice in take.folded),
        notices=(*notices, *steadiness_notices(drifts(channels, stereo, lines, clocks))),
    )


def _alone(take: MeasuredTake) -> Joined:
    """Return what was recorded at once, as it is."""
    opened, stereo, clocks = take.opened, tuple(item.result for item in take.stereo), take.opened.base.results()
    steadiness = steadiness_notices(drifts(opened.channels, stereo, take.lines, clocks))
    return Joined(
        lines=take.lines,
        clocks=clocks,
        channels=opened.channels,
        stereo=stereo,
        readings=opened.readings,
        pairs=take.pairs,
        takes=(),
        folded=take.folded,
        notices=(*take.notices, *steadiness),
    )


def _referred(take: MeasuredTake, referral: Referral) -> list[Reading]:
    """Return the channels of a take as those of the first; the reference is that of the first take and counts once."""
    found = []
    for reading in take.opened.readings:
        if not reading.entry.reference:
            found.append(referral.reading(reading))
        elif referral.first:
            found.append(referral.reference(reading))
    return found


def _named(clock: ClockResult, name: str) -> ClockResult:
    """Return a clock by the name of its take."""
    return replace(clock, daq=f"{name}: {clock.daq}")


def _told(notice: AnyNotice, name: str) -> AnyNotice:
    """Return a notice that says of which take it is."""
    return replace(notice, text=f"{name}: {notice.text}")


def _channel(channel: ChannelResult, take: MeasuredTake, referral: Referral) -> ChannelResult:
    """Return a channel by the name of its take, its phasors referred to the first; what the figures show stays."""
    name = take.opened.name
    return replace(
        channel,
        name=f"{name}: {channel.name}",
        daq=f"{name}: {channel.daq}",
        phasors=referral.phasors(channel.phasors),
        stationarity=_at_lines(channel.stationarity, take.lines, referral.frequency_hz),
    )


def _stereo(takes: Sequence[MeasuredTake]) -> tuple[StereoResult, ...]:
    """Return the stereo pairs; one that saw more than one take is named by the later ones."""
    found: dict[str, StereoResult] = {}
    for take in takes:
        for item in take.stereo:
            name = item.result.name
            if name in found:
                name = f"{name}-{take.opened.name.replace(' ', '')}"
            steady = _at_lines(item.result.stationarity, take.lines, takes[0].lines.frequency_hz)
            found[name] = replace(item.result, name=name, stationarity=steady)
    return tuple(found.values())


def _at_lines(steady: Stationarity | None, own: Lines, frequency_hz: FloatArray) -> Stationarity | None:
    """Return what a take says of its own lines as said of those at `frequency_hz` (K,)."""
    if steady is None:
        return None
    first = dict(zip(own.frequency_hz.tolist(), frequency_hz.tolist(), strict=True))
    return replace(steady, frequency_hz=np.array([first.get(f, f) for f in steady.frequency_hz.tolist()]))
