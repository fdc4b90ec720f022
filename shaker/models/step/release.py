"""Reading of a release: when, how long, from which level to which, and what rings then."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from shaker.models.step.levels import Level, clipped, rest_level, ringing_level
from shaker.models.step.locate import Location
from shaker.models.step.measured_force import read_force
from shaker.models.step.peaks import spectrum_peaks
from shaker.models.step.reading import Reading
from shaker.models.step.record import StepRecord
from shaker.models.step.timing import STRONG, Timing, places_of, timing_of
from shaker.notice import Notice

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
