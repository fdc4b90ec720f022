"""Reading of a release: when, how long, from which level to which."""

from __future__ import annotations

import numpy as np

from shaker._checks import FloatArray
from shaker.models.step.locate import Location, locate
from shaker.models.step.reading import Reading
from shaker.models.step.record import StepRecord


def read_release(record: StepRecord, channel: str) -> Reading:
    """Return what one channel of a record shows of its release."""
    if channel not in record.channels:
        raise ValueError(f"channel: expected one of {', '.join(record.channels)}, found {channel!r}")
    samples = record.samples[record.channels.index(channel)]
    near = None if record.onset_s is None else round((record.onset_s - record.start_s) * record.sample_rate_hz)
    place = locate(samples, near)
    step_s = 1.0 / record.sample_rate_hz
    rise_s = (place.high - place.low) * step_s
    u_baseline = place.noise / np.sqrt(max(place.first, 1))
    u_steady = _scatter_of_end(samples, place)
    change = place.steady - place.baseline
    gain = change / record.amplitude
    u_gain = np.hypot(np.hypot(u_baseline, u_steady) / record.amplitude, gain * record.u_amplitude)
    return Reading(
        record=record.name,
        channel=channel,
        component=record.component,
        unit=record.unit,
        release=record.release,
        onset_s=record.start_s + (place.first - 1) * step_s,
        u_onset_s=max(step_s, rise_s / 4.0),
        sign=int(np.sign(change)),
        baseline=place.baseline,
        u_baseline=u_baseline,
        steady=place.steady,
        u_steady=u_steady,
        rise_s=rise_s,
        u_rise_s=step_s,
        shape="ramp",
        release_s=rise_s / 0.8,
        u_release_s=rise_s / 2.0,
        static_gain=gain,
        u_static_gain=float(u_gain),
        noise=place.noise,
        clipped=False,
    )


def _scatter_of_end(samples: FloatArray, place: Location) -> float:
    """Return the standard uncertainty of the steady level from the scatter of eight blocks of the record's end."""
    tail = samples[place.first + (len(samples) - place.first) * 4 // 5 :]
    blocks = [float(np.mean(block)) for block in np.array_split(tail, 8)]
    return float(np.std(blocks, ddof=1) / np.sqrt(8.0))
