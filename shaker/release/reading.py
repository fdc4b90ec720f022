"""The reading of a release, and the comparison of release devices."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from shaker.arrays import FloatArray, Notice
from shaker.release.record import (
    Level,
    Location,
    Reading,
    StepRecord,
    clipped,
    rest_level,
    ringing_level,
    spectrum_peaks,
)
from shaker.release.timing import STRONG, Timing, places_of, read_force, timing_of

# Reading of a release: when, how long, from which level to which, and what rings then.


_SETTLED = 8.0  # lags after the release from which the ringing is free
_LEAST = 32  # samples of either level
_DRIFTS = 4.0  # standard uncertainties
_MISFIT = 1.5


def read_release(record: StepRecord, channel: str) -> Reading:
    """Return what one channel of a record shows of its release.

    A channel whose level hardly changes is read at the times of the one that changes most.
    """
    if channel not in record.channels:
        raise ValueError(f"channel: expected one of {', '.join(record.channels)}, found {channel!r}")
    places = places_of(record)
    own = record.channels.index(channel)
    timed = own if places[own].strength >= STRONG else _strongest(places)
    return _reading(record, own, places[own], timing_of(record, timed, places[timed]))


def read_releases(record: StepRecord) -> tuple[Reading, ...]:
    """Return what every channel of a record shows of its release, as `read_release`."""
    places = places_of(record)
    strongest = _strongest(places)
    common = timing_of(record, strongest, places[strongest])
    found = []
    for channel, place in enumerate(places):
        by_itself = place.strength >= STRONG and channel != strongest
        found.append(_reading(record, channel, place, timing_of(record, channel, place) if by_itself else common))
    return tuple(found)


def _strongest(places: list[Location]) -> int:
    """Return the channel whose level changes most, over its noise."""
    return int(np.argmax([place.strength for place in places]))


def _reading(record: StepRecord, channel: int, place: Location, timing: Timing) -> Reading:
    """Return the reading of a channel at known times."""
    samples, rate = record.samples[channel], record.sample_rate_hz
    _, after = _limits(record, timing)
    baseline, steady = _levels(record, channel, place, timing)
    change = steady.value - baseline.value
    gain = change / record.amplitude
    u_gain = np.hypot(np.hypot(baseline.u, steady.u) / record.amplitude, gain * record.u_amplitude)
    reading = Reading(
        record=record.name,
        channel=record.channels[channel],
        component=record.component,
        unit=record.unit,
        release=record.release,
        onset_s=timing.onset_s,
        u_onset_s=timing.u_onset_s,
        sign=int(np.sign(change)),
        baseline=baseline.value,
        u_baseline=baseline.u,
        steady=steady.value,
        u_steady=steady.u,
        rise_s=timing.rise_s,
        u_rise_s=timing.u_rise_s,
        shape=timing.shape,
        release_s=timing.release_s,
        u_release_s=timing.u_release_s,
        static_gain=gain,
        u_static_gain=float(u_gain),
        noise=baseline.noise,
        clipped=clipped(samples, place.resolution, baseline.noise),
        peaks=spectrum_peaks(samples[after:] - steady.value, rate, baseline.noise),
    )
    return replace(reading, notices=_remarks(record, reading, timing, (baseline, steady)))


def _limits(record: StepRecord, timing: Timing) -> tuple[int, int]:
    """Return the samples up to which the output rests and from which it rings freely."""
    rate, count = record.sample_rate_hz, record.samples.shape[1]
    before = (timing.onset_s - 2.0 * timing.u_onset_s - record.start_s) * rate
    end_s = timing.onset_s + timing.release_s + 2.0 * timing.u_release_s + _SETTLED * timing.lag_s
    after = (end_s - record.start_s) * rate + 1.0
    if before < _LEAST or after > count - _LEAST:
        raise ValueError(
            f"record: expected {_LEAST} samples or more before the onset and after the release, found the onset at "
            f"sample {before:.0f} and the end of the release at {after:.0f} of {count} in {record.name}"
        )
    return int(before), int(np.ceil(after))


def _levels(record: StepRecord, channel: int, place: Location, timing: Timing) -> tuple[Level, Level]:
    """Return the levels before and after the release."""
    before, after = _limits(record, timing)
    samples = record.samples[channel]
    poles = np.zeros(0, dtype=np.complex128)
    if timing.fit is not None:
        poles = np.asarray(timing.fit.poles[: len(timing.fit.frequency_hz)] / record.sample_rate_hz)
    return (
        rest_level(samples[:before], place.resolution),
        ringing_level(samples[after:], poles, place.resolution),
    )


def _remarks(record: StepRecord, reading: Reading, timing: Timing, levels: tuple[Level, Level]) -> tuple[Notice, ...]:
    """Return what the user should know of a reading."""
    told = []
    strength = abs(reading.steady - reading.baseline) / reading.noise
    if reading.clipped:
        told.append(("warning", "the output stands at its limit: the record is cut, its peaks and poles are wrong"))
    if timing.of != reading.channel:
        told.append(
            ("info", f"changes by {strength:.2g} standard deviations of its noise: read at the times of {timing.of}")
        )
    elif timing.fit is None:
        told.append(
            (
                "warning",
                "modes behind a lag do not describe the release: onset and length by a straight line from 10 % to 90 %",
            )
        )
    elif timing.misfit > _MISFIT:
        text = (
            f"modes that start together behind one lag leave {timing.misfit:.3g} times the noise at rest around the "
            "release: onset and length are less certain than stated"
        )
        told.append(("warning", text))
    for level, name in zip(levels, ("before the release", "after the ringing"), strict=True):
        if abs(level.drift_over_u) > _DRIFTS:
            share = level.drift / (reading.steady - reading.baseline)
            told.append(("warning", f"the level {name} drifts by {share:.2g} of the change over its samples"))
    if record.force is not None:
        told += _of_force(record)
    return tuple(Notice("warning" if kind == "warning" else "info", text, reading.channel) for kind, text in told)


def _of_force(record: StepRecord) -> list[tuple[str, str]]:
    """Return what the measured force says against the stated amplitude."""
    assert record.force is not None
    force = read_force(record.force, record.sample_rate_hz, record.start_s)
    u = float(np.hypot(force.u_change, record.u_amplitude * record.amplitude))
    if abs(force.change - record.amplitude) < max(3.0 * u, 0.01 * abs(record.amplitude)):
        return []
    text = (
        f"the force changes by {force.change:.5g}, stated are {record.amplitude:.5g}: the gain is over the stated one"
    )
    return [("warning", text)]


# Comparison of what lets go: which release is fastest, and which repeats best.


@dataclass(frozen=True)
class Spread:
    """Mean of one quantity over releases with its standard uncertainty, and the standard deviation of a single one.

    `u_mean` has `dof` degrees of freedom: infinite where the readings' own uncertainties are all that is known of one
    release, whose `repeatability` is NaN. `u_repeatability` is s/√(2(n - 1)).
    """

    mean: float
    u_mean: float
    repeatability: float
    u_repeatability: float
    dof: float


@dataclass(frozen=True)
class ReleaseKind:
    """Releases by one means, `release`: how many, their rise time and the length of the release in s.

    `rank` 1 has the shortest rise time. `faster`: probability that it rises faster than the next rank does, from
    Welch's t; NaN of the last one and where one release alone does not tell how it repeats.
    """

    release: str
    count: int
    rise: Spread
    length: Spread
    rank: int
    faster: float


def compare_releases(readings: Sequence[Reading]) -> tuple[ReleaseKind, ...]:
    """Return the kinds of release among readings of one output and one component, by rank."""
    places = {(reading.channel, reading.component) for reading in readings}
    if len(places) != 1:
        found = ", ".join(f"{channel} under {component}" for channel, component in sorted(places)) or "none"
        raise ValueError(f"readings: expected those of one output under one component, found {found}")
    names = dict.fromkeys(reading.release for reading in readings)
    spreads = {}
    for name in names:
        own = [reading for reading in readings if reading.release == name]
        rise = _spread([r.rise_s for r in own], [r.u_rise_s for r in own])
        spreads[name] = len(own), rise, _spread([r.release_s for r in own], [r.u_release_s for r in own])
    order = sorted(names, key=lambda name: spreads[name][1].mean)
    following: list[str | None] = [*order[1:], None]
    return tuple(
        ReleaseKind(
            name, *spreads[name], rank, np.nan if other is None else _faster(spreads[name][1], spreads[other][1])
        )
        for rank, (name, other) in enumerate(zip(order, following, strict=True), 1)
    )


def _spread(values: Sequence[float], u: Sequence[float]) -> Spread:
    """Return mean and scatter of values; the mean is no better known than the values' own uncertainties allow."""
    value: FloatArray = np.asarray(values, dtype=np.float64)
    count = len(value)
    own = float(np.sqrt(np.sum(np.square(u)))) / count
    if count == 1:
        return Spread(float(value[0]), own, np.nan, np.nan, np.inf)
    scatter = float(np.std(value, ddof=1))
    u_mean = scatter / np.sqrt(count)
    dof = float(count - 1) if u_mean >= own else np.inf
    return Spread(float(value.mean()), max(u_mean, own), scatter, scatter / np.sqrt(2.0 * (count - 1)), dof)


def _faster(one: Spread, other: Spread) -> float:
    """Return the probability that one mean is below another (Welch 1947), NaN where one release has no scatter."""
    from scipy.stats import t

    if np.isnan(one.repeatability) or np.isnan(other.repeatability):
        return float("nan")
    parts = np.array([one.u_mean**2, other.u_mean**2])
    dofs = np.array([one.dof, other.dof])
    total = float(parts.sum())
    if total == 0.0:
        return 1.0 if other.mean > one.mean else 0.5
    inverse = float(np.sum(parts**2 / dofs)) / total**2
    dof = 1.0 / inverse if inverse > 0.0 else np.inf
    return float(t.cdf((other.mean - one.mean) / np.sqrt(total), dof))
