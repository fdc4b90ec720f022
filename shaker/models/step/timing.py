"""When the channels of a record were released, and what they ring with."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from shaker.models.step.beginning import Beginning, Window
from shaker.models.step.levels import correlation_factor
from shaker.models.step.locate import Location, locate
from shaker.models.step.measured_force import read_force
from shaker.models.step.reading import Shape
from shaker.models.step.record import StepRecord
from shaker.models.step.rise import rise_time
from shaker.models.step.search import find_beginning
from shaker.models.step.times import release_times

STRONG = 5.0
"""Change of level, over the noise of a sample, from which a channel shows the release by itself."""
_ROUGH = 2.0  # of the longest ramp that the output may follow: what lag, ringing and noise make of times without a fit


@dataclass(frozen=True)
class Timing:
    """Times in s of a release as channel `of` shows it; `fit` is None where none describes it.

    `misfit`: standard deviation of the fit's residual over the noise at rest.
    """

    of: str
    onset_s: float
    u_onset_s: float
    release_s: float
    u_release_s: float
    lag_s: float
    rise_s: float
    u_rise_s: float
    shape: Shape
    fit: Beginning | None
    misfit: float


def places_of(record: StepRecord) -> list[Location]:
    """Return where every channel's release is, roughly; a record without one is refused."""
    near = None if record.onset_s is None else round((record.onset_s - record.start_s) * record.sample_rate_hz)
    places = [locate(samples, near) for samples in record.samples]
    strength = max(place.strength for place in places)
    if strength < STRONG:
        raise ValueError(
            f"record: expected an output that changes by {STRONG:g} standard deviations of its noise or more, found "
            f"{strength:.2g} at most in {record.name}"
        )
    return places


def timing_of(record: StepRecord, channel: int, place: Location) -> Timing:
    """Return when a channel was released; where the force was measured along, it tells begin and length."""
    samples = record.samples[channel]
    window, fit = find_beginning(samples, record.sample_rate_hz, record.start_s, place)
    timing = _by_fit(record, channel, place, window, fit)
    if record.force is None:
        return timing
    force = read_force(record.force, record.sample_rate_hz, record.start_s)
    return replace(
        timing,
        onset_s=force.onset_s,
        u_onset_s=force.u_onset_s,
        release_s=force.release_s,
        u_release_s=force.u_release_s,
        shape="measured",
    )


def _by_fit(record: StepRecord, channel: int, place: Location, window: Window, fit: Beginning) -> Timing:
    """Return the times of a fitted beginning, its covariance enlarged by the residual's correlation."""
    late = window.time_s > fit.onset_s
    residual = (window.samples - fit.at(window.time_s))[late]
    correlation = correlation_factor(residual)
    assert fit.covariance is not None
    fit = replace(fit, covariance=fit.covariance * correlation)
    crossing, times = rise_time(fit), release_times(window, fit, correlation)
    if crossing is None or times is None:
        return _by_straight_line(record, channel, place)
    rise_s, u_rise_s = crossing
    block = window.step_s * record.sample_rate_hz
    return Timing(
        of=record.channels[channel],
        onset_s=times.onset_s,
        u_onset_s=times.u_onset_s,
        release_s=times.release_s,
        u_release_s=times.u_release_s,
        lag_s=times.lag_s,
        rise_s=rise_s,
        u_rise_s=u_rise_s,
        shape="step" if times.release_s < 2.0 * times.u_release_s else fit.shape,
        fit=fit,
        misfit=float(np.sqrt(block * np.mean(residual**2))) / max(place.noise, 1e-300),
    )


def _by_straight_line(record: StepRecord, channel: int, place: Location) -> Timing:
    """Return the times of a straight line through 10 % and 90 %."""
    step_s = 1.0 / record.sample_rate_hz
    rise_s = max(place.high - place.low, 1.0) * step_s
    u = float(np.hypot(_ROUGH * place.longest * step_s, step_s))
    onset_s = record.start_s + place.low * step_s - rise_s / 8.0
    return Timing(record.channels[channel], onset_s, u, rise_s / 0.8, u, 0.0, rise_s, u, "ramp", None, 1.0)
