"""Reading of a release: times, levels and ringing; comparison of release devices."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from itertools import pairwise
from typing import Literal, NamedTuple

import numpy as np

from shaker.frf.chain import cubic_spline
from shaker.io.condition import cut_run
from shaker.model_notices import (
    FORCE_CONTRADICTS_AMPLITUDE,
    LEVEL_DRIFT,
    OTHER_CHANNEL_TIMES,
    OUTPUT_AT_LIMIT,
    RELEASE_BY_LINE,
    RELEASE_MISFIT,
)
from shaker.release.load_response import MOMENTS, load_rate, load_share
from shaker.release.onset import (
    OnsetModel,
    Window,
    bounded_parameters,
    find_onset,
    longest_lag_s,
    rise_time,
    solve_amplitudes,
)
from shaker.release.record import (
    ApproximateOnset,
    Level,
    ReleaseReading,
    ReleaseShape,
    StepRecord,
    correlation_factor,
    locate_change,
    ringing_level,
    spectrum_peaks,
)
from shakercal._common.arrays import BoolArray, FloatArray
from shakercal._common.fitting import BlockJacobian, LinearBlock, LMOptions, SeparablePoint, levenberg_marquardt
from shakercal._common.notices import Notice

# Onset and length of a release with uncertainties from noise and an unknown lag behind the sensor.

_NODES = 13  # lags at which all other parameters are fitted
_FEWEST = 5  # lags for an interpolation
_TIMES = 121  # points of the integration over lags and lengths
_FAR, _NEAR = 10.0, 6.0  # range of the lags, and of the lengths at each of them, in standard deviations
_COVERAGE = 1.96  # half a 95 % interval over its standard uncertainty
_LIKELY = (1.92, 3.0)  # logarithm of the likelihood below its largest: 95 % of one and of two parameters
_DAMPER = 2.0 / np.sqrt(3.0)  # of ζ/ω: rectangular distribution of half width 2ζ/ω


@dataclass(frozen=True)
class Interval:
    """Start and duration of a change of load, in s with standard uncertainties."""

    onset_s: float
    u_onset_s: float
    release_s: float
    u_release_s: float


class _Node(NamedTuple):
    """Result of a fit at a fixed lag.

    `squares` of the residual at the best length, with `length2` (its square) and `centre_s`. `by_square`: change of the
    centre with the squared length. `variance`: of the squared length; `centre_variance`: of the centre at fixed length.
    """

    squares: float
    length2: float
    variance: float
    centre_s: float
    by_square: float
    centre_variance: float


def release_times(window: Window, fit: OnsetModel, correlation: float) -> tuple[Interval, float] | None:
    """Return means and standard deviations of onset and length T, and the mean lag τ.

    All other parameters are fitted at each lag; the likelihood is normal in T². Priors are flat in T ≥ 0 and in τ from
    0 to the lag whose corner is the lowest mode's frequency. Onset = centre - T/2 - τ. `correlation`: factor on
    variances for the correlation of the residual. An output that includes the force of the sensor's damper, (2ζs/ω +
    1), is early by 2ζ/ω; this is added to the uncertainty of the onset. None if the data do not distinguish the lags.
    """
    variance = fit.squares / max(fit.rows - len(fit.vector), 1) * correlation
    lags, nodes = _nodes(window, fit, variance)
    if len(nodes) < _FEWEST:
        return None
    lag = np.linspace(lags[0], lags[-1], _TIMES)
    squares, length2, spread, centre, by_square, centre_variance = (
        cubic_spline(lags, part, lag) for part in np.array(nodes).T
    )
    spread, centre_variance = np.maximum(spread, 1e-300), np.maximum(centre_variance, 0.0)
    u_square = np.sqrt(spread)
    low = np.sqrt(np.maximum(length2 - _NEAR * u_square, 0.0))
    high = np.sqrt(np.maximum(length2 + _NEAR * u_square, 1e-3 * u_square))
    length = np.linspace(low, high, _TIMES, axis=1)
    deviation = length**2 - length2[:, None]
    log_weight = -0.5 * ((squares - squares.min()) / variance)[:, None] - 0.5 * deviation**2 / spread[:, None]
    weight = np.exp(log_weight - log_weight.max()) * (length[:, -1] - length[:, 0])[:, None]
    weight /= weight.sum()
    onset = centre[:, None] + by_square[:, None] * deviation - 0.5 * length - lag[:, None]
    edges = np.concatenate([log_weight[0], log_weight[-1], log_weight[length == 0.0]])
    bounded = bool(np.any(edges > log_weight.max() - _LIKELY[0]))
    likely = log_weight > log_weight.max() - _LIKELY[int(bounded)]
    damper = _DAMPER * float(np.max(np.abs(fit.damping_ratio) / (2 * np.pi * fit.frequency_hz)))
    onset_s, u_onset_s = _moments(weight, onset, likely)
    release_s, u_release_s = _moments(weight, length, likely)
    u_onset_s = float(np.sqrt(u_onset_s**2 + np.sum(weight * centre_variance[:, None]) + damper**2))
    return Interval(onset_s, u_onset_s, release_s, u_release_s), float(np.sum(weight * lag[:, None]))


def _nodes(window: Window, fit: OnsetModel, variance: float) -> tuple[FloatArray, list[_Node]]:
    """Return lags (L,) around that of the fit with their results."""
    if fit.covariance is None:
        raise ValueError("fit: expected one with its covariance, found none")
    u_square = float(np.sqrt(fit.covariance[2, 2] / max(fit.squares / max(fit.rows - len(fit.vector), 1), 1e-300)))
    reach = _FAR * u_square * float(np.sqrt(variance))
    low = float(np.sqrt(max(fit.lag_s**2 - reach, 0.0)))
    high = min(float(np.sqrt(fit.lag_s**2 + reach)), longest_lag_s(fit))
    lags = np.linspace(min(low, 0.99 * high), high, _NODES)
    middle = int(np.argmin(np.abs(lags - fit.lag_s)))
    nodes: dict[int, _Node] = {}
    for direction in (range(middle, _NODES), range(middle - 1, -1, -1)):
        neighbour = fit
        for index in direction:
            at_lag = _node(window, neighbour, float(lags[index]), variance)
            if at_lag is None:
                break
            nodes[index], neighbour = at_lag
    indices = sorted(nodes)
    return lags[indices], [nodes[index] for index in indices]


def _node(window: Window, near: OnsetModel, lag_s: float, variance: float) -> tuple[_Node, OnsetModel] | None:
    """Return the result at a lag by one Gauss-Newton step, None if impossible."""
    square = near.release_s**2 + (near.lag_s**2 - lag_s**2) / MOMENTS[near.shape]
    start = replace(near, lag_s=lag_s, release_s=float(np.sqrt(max(square, 0.0))))
    trial = solve_amplitudes(window, start)
    fit, (normal, downhill) = trial.fit, trial.projected.normal
    others = np.arange(len(downhill)) != 2
    scale = np.sqrt(np.maximum(np.diag(normal)[others], 1e-300))
    inverse = np.linalg.pinv(normal[np.ix_(others, others)] / np.outer(scale, scale), rcond=1e-12, hermitian=True)
    inverse = inverse / np.outer(scale, scale)
    step = inverse @ downhill[others]
    parameters = trial.parameters + np.insert(step, 2, 0.0)
    moved = bounded_parameters(window, fit, parameters)
    if moved is None:
        return None
    covariance = variance * inverse
    by_square = float(covariance[0, 1] / covariance[1, 1])
    node = _Node(
        squares=fit.squares - float(downhill[others] @ step),
        length2=float(parameters[1]),
        variance=float(covariance[1, 1]),
        centre_s=float(parameters[0]),
        by_square=by_square,
        centre_variance=max(float(covariance[0, 0] - by_square * covariance[0, 1]), 0.0),
    )
    return node, moved


def _moments(weight: FloatArray, value: FloatArray, likely: BoolArray) -> tuple[float, float]:
    """Return mean and standard deviation; its 95 % interval includes every likely value."""
    mean = float(np.sum(weight * value))
    farthest = float(np.max(np.abs(value[likely] - mean)))
    return mean, max(float(np.sqrt(np.sum(weight * (value - mean) ** 2))), farthest / _COVERAGE)


# The release in a force channel.

_LENGTHS = 3.0  # lengths of the release on either side, in the fit


class ForceReading(NamedTuple):
    """Change of the load in N or N·m with its u, time, shape."""

    interval: Interval
    change: float
    u_change: float
    shape: Literal["ramp", "smooth"]


def read_force(force: FloatArray, sample_rate_hz: float, start_s: float) -> ForceReading:
    """Return the release that a force channel (N,) from `start_s` on shows."""
    location = locate_change(force)
    length = max((location.index_90 - location.index_10) / 0.8, 2.0)
    low = max(0, int(location.index_10 - _LENGTHS * length - 8))
    high = min(len(force), int(location.index_90 + _LENGTHS * length + 8))
    number, data = np.arange(low, high, dtype=np.float64), force[low:high, None]

    def at(times: FloatArray, shape: Literal["ramp", "smooth"]) -> SeparablePoint | None:
        middle, long = (float(value) for value in times)
        if not (low <= middle <= high and 0.1 <= long <= 2.0 * (high - low)):
            return None
        share = load_share(shape, number, middle - 0.5 * long, long)
        rate = load_rate(shape, number, middle - 0.5 * long, long)
        slopes = np.stack([-rate, -rate * (number - middle) / long], axis=1)
        design = np.stack([np.ones(len(number)), share], axis=1)

        def changes(coefficients: FloatArray) -> BlockJacobian:
            return BlockJacobian(np.arange(2), (coefficients[1, 0] * slopes)[:, :, None])

        return SeparablePoint(times, (LinearBlock(design, data, changes),))

    def fitted(shape: Literal["ramp", "smooth"]) -> tuple[ForceReading, float]:
        begin = at(np.array([0.5 * (location.index_10 + location.index_90), length]), shape)
        assert begin is not None
        point = levenberg_marquardt(lambda times: at(times, shape), begin, LMOptions()).point
        part = point.solved[0]
        jacobian = np.concatenate([point.blocks[0].design, point.jacobians[0].rows[:, :, 0]], axis=1)
        variance = point.loss / max(len(number) - 4, 1) * correlation_factor(part.residual[:, 0])
        covariance = variance * np.linalg.pinv(jacobian.T @ jacobian, hermitian=True)
        half, u = np.array([0.0, 0.0, 1.0, -0.5]), np.sqrt(np.diagonal(covariance))
        middle, long = point.parameters
        times = np.array([middle - 0.5 * long, np.sqrt(half @ covariance @ half), long, u[3]]) / sample_rate_hz
        times[0] += start_s
        interval = Interval(*times.tolist())
        return ForceReading(interval, float(part.coefficients[1, 0]), float(u[1]), shape), point.loss

    return min((fitted("ramp"), fitted("smooth")), key=lambda reading: reading[1])[0]


# Times and ringing of the channels of a record.

STRONG = 5.0  # change of level, over the noise of a sample, above which a channel is read separately
_NEAR_ENOUGH = 1.0  # gain of a step in variances of the residual, for a fit that is only a start
_ROUGH = 2.0  # uncertainty of times without a fit, over the longest plausible ramp: lag, ringing and noise


@dataclass(frozen=True)
class Timing(Interval):
    """Times of a load change from the output `reference_channel`; `fit` is None without a model.

    `misfit`: standard deviation of the fit's residual over the noise at rest.
    """

    reference_channel: str
    lag_s: float
    rise_s: float
    u_rise_s: float
    shape: ReleaseShape
    fit: OnsetModel | None
    misfit: float


def locate_channels(record: StepRecord) -> list[ApproximateOnset]:
    """Return the approximate release of every channel; a record without one is refused."""
    near = None if record.onset_s is None else round((record.onset_s - record.start_s) * record.sample_rate_hz)
    locations = [locate_change(samples, near) for samples in record.samples]
    strength = max(location.signal_to_noise for location in locations)
    if strength < STRONG:
        raise ValueError(
            f"record: expected an output that changes by {STRONG:g} standard deviations of its noise or more, found "
            f"{strength:.2g} at most in {record.name}"
        )
    return locations


def timing_of(record: StepRecord, channel: int, location: ApproximateOnset) -> Timing:
    """Return the times of a channel's release; a measured force gives start and length."""
    samples, name = record.samples[channel], record.channels[channel]
    window, found = find_onset(samples, record.sample_rate_hz, record.start_s, location)
    fit = found.with_covariance
    residual = (window.samples - fit.at(window.time_s))[window.time_s > fit.onset_s]
    correlation = correlation_factor(residual)
    assert fit.covariance is not None
    fit = replace(fit, covariance=fit.covariance * correlation)
    crossing, times = rise_time(fit), release_times(window, fit, correlation)
    if crossing is None or times is None:
        # a straight line through 10 % and 90 %
        step_s = 1.0 / record.sample_rate_hz
        rise_s = max(location.index_90 - location.index_10, 1.0) * step_s
        u = float(np.hypot(_ROUGH * location.max_ramp_samples * step_s, step_s))
        onset_s = record.start_s + location.index_10 * step_s - rise_s / 8.0
        timing = Timing(onset_s, u, rise_s / 0.8, u, name, 0.0, rise_s, u, "ramp", None, 1.0)
    else:
        interval, lag_s = times
        shape: ReleaseShape = "step" if interval.release_s < 2.0 * interval.u_release_s else fit.shape
        block = window.step_s * record.sample_rate_hz
        misfit = float(np.sqrt(block * np.mean(residual**2))) / max(location.noise, 1e-300)
        when = interval.onset_s, interval.u_onset_s, interval.release_s, interval.u_release_s
        timing = Timing(*when, name, lag_s, *crossing, shape, fit, misfit)
    if record.force is None:
        return timing
    interval = read_force(record.force, record.sample_rate_hz, record.start_s).interval
    return replace(timing, **asdict(interval), shape="measured")


# Reading of a release: times, levels and ringing.

_SETTLED = 8.0  # lags after the release; exp(-8) of the lag's response remains
_LEAST = 32  # samples of either level, at least
_DRIFTS = 4.0  # significant drift, in standard uncertainties
_MISFIT = 1.5  # residual over the noise at rest above which a notice is given


def read_release(record: StepRecord, channel: str) -> ReleaseReading:
    """Read the release that one channel of a record shows.

    A channel whose level hardly changes is read at the times of the channel with the largest change.

    Parameters
    ----------
    record
        outputs during one release
    channel
        name of the output

    Returns
    -------
    ReleaseReading : times, levels, static gain, noise and spectral peaks, with standard uncertainties

    Raises
    ------
    ValueError : unknown channel, no change of level, or too few samples before or after the release

    Examples
    --------
    >>> import numpy as np
    >>> from shaker import StepRecord, read_release
    >>> time_s, noise = np.arange(4000) / 10e3 - 0.05, 1e-3 * np.random.default_rng(0).normal(size=4000)
    >>> ring = np.exp(-40.0 * time_s) * np.cos(2 * np.pi * 310.0 * time_s)
    >>> volts = np.where(time_s < 0.0, 2.0, 2.0 * ring) + noise  # 20 N are taken off
    >>> record = StepRecord("line 1", ("Fz",), "V", volts[None], 10e3, "Fz", -20.0)
    >>> reading = read_release(record, "Fz")
    >>> print(f"from {reading.baseline:.2f} V to {abs(reading.steady):.2f} V at {1e3 * reading.onset_s:.0f} ms")
    from 2.00 V to 0.00 V at 50 ms
    """
    if channel not in record.channels:
        raise ValueError(f"channel: expected one of {', '.join(record.channels)}, found {channel!r}")
    locations = locate_channels(record)
    index = record.channels.index(channel)
    timed = index if locations[index].signal_to_noise >= STRONG else _strongest(locations)
    return _reading(record, index, locations[index], timing_of(record, timed, locations[timed]))


def initial_release(record: StepRecord) -> tuple[float, float, ReleaseShape]:
    """Return middle and length in s, and shape, of a release to start a fit.

    They are from a measured force, else from the clearest channel. To second order a lag behind the sensor acts like a
    later and longer release: the middle is later by the lag, and its second moment adds to the release's.
    """
    locations = locate_channels(record)
    shape: ReleaseShape
    if record.force is not None:
        interval, _, _, shape = read_force(record.force, record.sample_rate_hz, record.start_s)
        middle_s, length_s = interval.onset_s + 0.5 * interval.release_s, interval.release_s
    else:
        index, rate = _strongest(locations), record.sample_rate_hz
        fit = find_onset(record.samples[index], rate, record.start_s, locations[index], _NEAR_ENOUGH)[1].fit
        middle_s, shape = fit.centre_s, fit.shape
        length_s = float(np.sqrt(fit.release_s**2 + fit.lag_s**2 / MOMENTS[shape]))
    ends = (middle_s + length_s * np.array([-0.5, 0.5]) - record.start_s) * record.sample_rate_hz
    _check_length(record, float(ends[0]), float(ends[1]) + 1.0)
    return middle_s, length_s, shape


def _check_length(record: StepRecord, rests_to: float, rings_from: float) -> None:
    """Refuse a record with too few samples before the onset or after the release."""
    count = record.samples.shape[1]
    if rests_to < _LEAST or rings_from > count - _LEAST:
        raise ValueError(
            f"record: expected {_LEAST} samples or more before the onset and after the release, found the onset at "
            f"sample {rests_to:.0f} and the end of the release at {rings_from:.0f} of {count} in {record.name}"
        )


def read_releases(record: StepRecord) -> tuple[ReleaseReading, ...]:
    """Return the readings of all channels of a record, as `read_release`."""
    locations = locate_channels(record)
    strongest = _strongest(locations)
    common = timing_of(record, strongest, locations[strongest])
    readings = []
    for channel, location in enumerate(locations):
        by_itself = location.signal_to_noise >= STRONG and channel != strongest
        readings.append(
            _reading(record, channel, location, timing_of(record, channel, location) if by_itself else common)
        )
    return tuple(readings)


def _strongest(locations: list[ApproximateOnset]) -> int:
    """Return the channel with the largest change of level over its noise."""
    return int(np.argmax([location.signal_to_noise for location in locations]))


def _reading(record: StepRecord, channel: int, location: ApproximateOnset, timing: Timing) -> ReleaseReading:
    """Return the reading of a channel at given times."""
    samples, rate = record.samples[channel], record.sample_rate_hz
    rests_to = (timing.onset_s - 2.0 * timing.u_onset_s - record.start_s) * rate
    end_s = timing.onset_s + timing.release_s + 2.0 * timing.u_release_s + _SETTLED * timing.lag_s
    rings_from = (end_s - record.start_s) * rate + 1.0
    _check_length(record, rests_to, rings_from)
    poles, after = np.zeros(0, dtype=np.complex128), int(np.ceil(rings_from))
    if timing.fit is not None:
        poles = np.asarray(timing.fit.poles[: len(timing.fit.frequency_hz)] / rate)
    baseline = ringing_level(samples[: int(rests_to)], poles[:0], location.resolution)
    steady = ringing_level(samples[after:], poles, location.resolution)
    change = steady.value - baseline.value
    gain = change / record.amplitude
    u_gain = np.hypot(np.hypot(baseline.u, steady.u) / record.amplitude, gain * record.u_amplitude)
    reading = ReleaseReading(
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
        clipped=any(cut_run(side, location.resolution, baseline.noise) for side in (samples, -samples)),
        peaks=spectrum_peaks(samples[after:] - steady.value, rate, baseline.noise),
    )
    return replace(reading, notices=_remarks(record, reading, timing, (baseline, steady)))


def _remarks(
    record: StepRecord, reading: ReleaseReading, timing: Timing, levels: tuple[Level, Level]
) -> tuple[Notice, ...]:
    """Return the notices of a reading."""
    where, notices = reading.channel, list[Notice]()
    if reading.clipped:
        notices.append(Notice(OUTPUT_AT_LIMIT, where))
    if timing.reference_channel != reading.channel:
        strength = abs(reading.steady - reading.baseline) / reading.noise
        notices.append(Notice(OTHER_CHANNEL_TIMES, where, strength=strength, channel=timing.reference_channel))
    elif timing.fit is None:
        notices.append(Notice(RELEASE_BY_LINE, where))
    elif timing.misfit > _MISFIT:
        notices.append(Notice(RELEASE_MISFIT, where, factor=timing.misfit))
    for level, stage in zip(levels, ("before the release", "after the ringing"), strict=True):
        if abs(level.drift_over_u) > _DRIFTS:
            share = level.drift / (reading.steady - reading.baseline)
            notices.append(Notice(LEVEL_DRIFT, where, stage=stage, share=share))
    if record.force is not None:
        force = read_force(record.force, record.sample_rate_hz, record.start_s)
        u = float(np.hypot(force.u_change, record.u_amplitude * record.amplitude))
        if abs(force.change - record.amplitude) >= max(3.0 * u, 0.01 * abs(record.amplitude)):
            measured, stated = force.change, record.amplitude
            notices.append(Notice(FORCE_CONTRADICTS_AMPLITUDE, where, measured=measured, stated=stated))
    return tuple(notices)


# Comparison of release devices: rise time and repeatability.


@dataclass(frozen=True)
class RepeatedMean:
    """Mean of one quantity over releases, and the standard deviation of a single release.

    `u_mean` has `dof` degrees of freedom, infinite if only the readings' uncertainties are available; `repeatability`
    of a single release is NaN.
    """

    mean: float
    u_mean: float
    repeatability: float
    u_repeatability: float
    dof: float


@dataclass(frozen=True)
class ReleaseKind:
    """Releases by one device, `release`: their number, rise time and length in s.

    `rank` 1 has the shortest rise time. `faster`: probability (Welch's t) of a shorter rise time than the next rank,
    NaN for the last rank and without repeatability.
    """

    release: str
    count: int
    rise: RepeatedMean
    length: RepeatedMean
    rank: int
    faster: float


def compare_releases(readings: Sequence[ReleaseReading]) -> tuple[ReleaseKind, ...]:
    """Return the kinds of release among readings of one output and one component, by rank."""
    outputs = {(reading.channel, reading.component) for reading in readings}
    if len(outputs) != 1:
        found = ", ".join(f"{channel} under {component}" for channel, component in sorted(outputs)) or "none"
        raise ValueError(f"readings: expected those of one output under one component, found {found}")
    kinds = []
    for name in dict.fromkeys(reading.release for reading in readings):
        members = [reading for reading in readings if reading.release == name]
        rise = _spread([r.rise_s for r in members], [r.u_rise_s for r in members])
        kinds.append(
            (name, len(members), rise, _spread([r.release_s for r in members], [r.u_release_s for r in members]))
        )
    kinds.sort(key=lambda kind: kind[2].mean)
    faster = [*(_faster(one[2], other[2]) for one, other in pairwise(kinds)), np.nan]
    ranked = enumerate(zip(kinds, faster, strict=True), 1)
    return tuple(ReleaseKind(*kind, rank, chance) for rank, (kind, chance) in ranked)


def _spread(values: Sequence[float], u: Sequence[float]) -> RepeatedMean:
    """Return mean and scatter of values; `u_mean` is at least that of the values' uncertainties."""
    value: FloatArray = np.asarray(values, dtype=np.float64)
    count = len(value)
    u_readings = float(np.sqrt(np.sum(np.square(u)))) / count
    if count == 1:
        return RepeatedMean(float(value[0]), u_readings, np.nan, np.nan, np.inf)
    scatter = float(np.std(value, ddof=1))
    u_mean = scatter / np.sqrt(count)
    dof = float(count - 1) if u_mean >= u_readings else np.inf
    return RepeatedMean(
        float(value.mean()), max(u_mean, u_readings), scatter, scatter / np.sqrt(2.0 * (count - 1)), dof
    )


def _faster(one: RepeatedMean, other: RepeatedMean) -> float:
    """Return the probability that one mean is below another (Welch 1947), NaN without scatter."""
    from scipy.special import stdtr

    if np.isnan(one.repeatability) or np.isnan(other.repeatability):
        return float("nan")
    parts = np.array([one.u_mean**2, other.u_mean**2])
    dofs = np.array([one.dof, other.dof])
    total = float(parts.sum())
    if total == 0.0:
        return 1.0 if other.mean > one.mean else 0.5
    inverse = float(np.sum(parts**2 / dofs)) / total**2
    dof = 1.0 / inverse if inverse > 0.0 else np.inf
    return float(stdtr(dof, (other.mean - one.mean) / np.sqrt(total)))
