"""All sequential set-ups of a recording as if recorded at once."""

from __future__ import annotations

from collections.abc import Hashable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from fusion.base import AnyNotice
from fusion.estimation.consistency import fails
from fusion.estimation.measurement_model import Reading, StereoReading, added_up
from fusion.phasors.channels import drift_notices as steadiness_notices
from fusion.phasors.channels import drifts
from fusion.phasors.results import ChannelResult, ClockResult, StereoResult, TakeResult
from fusion.phasors.setup import MeasuredTake, Referral, drift_notices
from fusion.recording.manifest import ChannelEntry
from shaker.arrays import ComplexArray, FloatArray, Notice
from shaker.lines.frequencies import Lines
from shaker.sine.fit import Stationarity
from shaker.sine.phasor import Phasors

# A channel that several takes recorded: one reading from all of them, what they scatter by being noise.


LEAST_SPREAD = 1e-9  # of the reading: below it, rounding looks like scatter


def pool_readings(takes: Sequence[tuple[str, Sequence[Reading]]]) -> tuple[tuple[Reading, ...], tuple[Notice, ...]]:
    """Return every channel of several takes (name and readings, referred to the first) once.

    The same channel at the same place, and the same output of the sensor, is pooled. Channels of one name that measured
    at different places remain rows of one instrument, each named by its take.
    """
    groups: dict[Hashable, list[tuple[str, Reading]]] = {}
    for name, readings in takes:
        for reading in readings:
            groups.setdefault(_identity(reading.entry), []).append((name, reading))
    names = [group[0][1].entry.name for group in groups.values()]
    found, notices = [], []
    for group in groups.values():
        (take, first), alone = group[0], names.count(group[0][1].entry.name) == 1
        pooled = _Pool.of([reading for _, reading in group])
        found.append(pooled.reading(first.entry if alone else _named(first.entry, take)))
        notices += pooled.notices(first.entry.name)
    return tuple(found), tuple(notices)


def _identity(entry: ChannelEntry) -> Hashable:
    """What makes channels of two takes the same: the sensor's output, or name and place of an instrument."""
    if entry.quantity == "output":
        return entry.channel
    return entry.name, entry.quantity, entry.body, entry.point, entry.direction, entry.common


def _named(entry: ChannelEntry, take: str) -> ChannelEntry:
    """Return a channel by the name of its take; the instrument keeps its name."""
    return entry.model_copy(update={"name": f"{take}: {entry.name}", "common": entry.common or entry.name})


@dataclass(frozen=True)
class _Pool:
    """Readings of one channel in T takes with their weights (T, K) and what they scatter by.

    `spread` (K,): standard deviation of one take's complex value beyond noise and drift; `failed` (K,): the scatter is
    beyond the 99 % quantile of what noise and drift make.
    """

    readings: tuple[Reading, ...]
    weight: FloatArray
    spread: FloatArray
    failed: NDArray[np.bool_]

    @classmethod
    def of(cls, readings: Sequence[Reading]) -> _Pool:
        """Weigh readings by their whole covariance over the takes.

        A complex value has one variance, the sum of those of its parts. Where chi-square is above its degrees of
        freedom, all takes get the variance that makes it equal to them (Paule & Mandel 1982, J. Res. NBS 87, 377).
        """
        lines = len(readings[0].phasors.frequency_hz)
        weight, spread = np.zeros((len(readings), lines)), np.zeros(lines)
        failed = np.zeros(lines, dtype=np.bool_)
        value = np.stack([reading.phasors.value[:, 0] for reading in readings])
        covariance = _between_takes(readings, value)
        for k in range(lines):
            takes = np.flatnonzero(np.isfinite(value[:, k]))
            if len(takes) == 1:
                weight[takes, k] = 1.0
            elif len(takes):
                own = covariance[k][np.ix_(takes, takes)]
                weight[takes, k], spread[k], failed[k] = _weighted(value[takes, k], own)
        return cls(tuple(readings), weight, spread, failed)

    def reading(self, entry: ChannelEntry) -> Reading:
        """Return one reading: noise of its own from noise and scatter, further errors by their names."""
        first = self.readings[0]
        if len(self.readings) == 1:
            return replace(first, entry=entry)
        further = [
            replace(error, relative=weight[:, None] * error.relative)
            for weight, reading in zip(self.weight, self.readings, strict=True)
            for error in reading.further
        ]
        return Reading(entry, self._phasors(entry), first.chain, added_up(further))

    def notices(self, name: str) -> list[Notice]:
        """Say where the takes differ by more than noise and drift make."""
        found = []
        for k in np.flatnonzero(self.failed):
            share = self.spread[k] / np.nanmax([abs(reading.phasors.value[k, 0]) for reading in self.readings])
            text = (
                f"{name} differs from take to take by {100.0 * share:.2g} % at "
                f"{self.readings[0].phasors.frequency_hz[k]:.6g} Hz (standard deviation beyond noise and drift); "
                "the scatter is part of its uncertainty"
            )
            found.append(Notice("warning", text, name))
        return found

    def _phasors(self, entry: ChannelEntry) -> Phasors:
        """Weighted mean with the covariance of noise and scatter, and its degrees of freedom (Welch-Satterthwaite)."""
        parts, square = [reading.phasors for reading in self.readings], self.weight**2
        known = np.any(self.weight != 0.0, axis=0)
        value = np.nansum([w * p.value[:, 0] for w, p in zip(self.weight, parts, strict=True)], axis=0)
        own = np.nan_to_num([s[:, None, None] * p.covariance for s, p in zip(square, parts, strict=True)])
        scatter = square.sum(axis=0) * self.spread**2
        covariance = own.sum(axis=0) + scatter[:, None, None] / 2.0 * np.eye(2)
        noise = np.trace(own, axis1=2, axis2=3)
        weighted = np.sum(noise**2 / np.maximum([p.dof for p in parts], 1.0), axis=0)
        weighted += scatter**2 / np.maximum(np.sum(self.weight != 0.0, axis=0) - 1.0, 1.0)
        total = np.trace(covariance, axis1=1, axis2=2)
        return Phasors(
            frequency_hz=parts[0].frequency_hz,
            value=np.where(known, value, complex(np.nan, np.nan))[:, None],
            covariance=np.where(known[:, None, None], covariance, np.nan),
            channels=(entry.name,),
            unit=parts[0].unit,
            dof=np.divide(total**2, weighted, out=np.full(len(total), np.inf), where=weighted > 0.0),
        )


def _between_takes(readings: Sequence[Reading], value: ComplexArray) -> FloatArray:
    """Return (K, T, T): covariances of the complex values, from noise and from what takes have in common.

    Relative errors count at the median amplitude, never at the reading itself.
    """
    size = np.array([np.median(np.abs(v[np.isfinite(v)])) if np.isfinite(v).any() else 0.0 for v in value.T])
    own = np.array([np.trace(reading.phasors.covariance, axis1=1, axis2=2) for reading in readings])
    own = np.nan_to_num(own) + (LEAST_SPREAD * size) ** 2
    covariance = np.einsum("tk,ts->kts", own, np.eye(len(readings)))
    names = dict.fromkeys(error.name for reading in readings for error in reading.further)
    place = {name: number for number, name in enumerate(names)}
    relative = np.zeros((len(names), len(readings), len(size)), dtype=np.complex128)
    for take, reading in enumerate(readings):
        for error in reading.further:
            relative[place[error.name], take] = error.relative[:, 0]
    shared = np.einsum("ntk,nsk->kts", relative, relative.conj()).real
    return np.asarray(covariance + shared * size[:, None, None] ** 2)


def _weighted(value: ComplexArray, covariance: FloatArray) -> tuple[FloatArray, float, bool]:
    """Return the weights (T,) of complex values, the standard deviation they have beyond their covariance, and whether
    chi-square fails at 1 %."""
    from scipy.optimize import brentq

    dof = 2 * (len(value) - 1)

    def chi2(variance: float) -> float:
        whole = covariance + variance * np.eye(len(value))
        rest = value - _weights(whole) @ value
        return float(2.0 * np.vdot(rest, np.linalg.solve(whole, rest)).real)

    first = chi2(0.0)
    if first <= dof:
        return _weights(covariance), 0.0, False
    high = float(np.var(value)) * len(value)
    while chi2(high) > dof:
        high *= 2.0
    extra = float(brentq(lambda v: chi2(v) - dof, 0.0, high, rtol=1e-3, xtol=1e-12 * high))
    return _weights(covariance + extra * np.eye(len(value))), float(np.sqrt(extra)), fails(first, dof)


def _weights(covariance: FloatArray) -> FloatArray:
    """Weights (T,) of the best linear mean."""
    solved = np.linalg.solve(covariance, np.ones(len(covariance)))
    return np.asarray(solved / solved.sum())


# All takes of a recording as if they had been recorded at once: everything referred to the first one.


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
    clocks = [_takes_named(c, take.opened.name) for take in takes for c in take.opened.base.results()]
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


def _takes_named(clock: ClockResult, name: str) -> ClockResult:
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
