"""When a release happened and how long it took, from the outputs or a measured force."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from shaker.arrays import BoolArray, FloatArray
from shaker.release.onset import Beginning, Window, find_beginning, longest_lag_s, moved, solved
from shaker.release.record import Location, Shape, StepRecord, correlation_factor, locate
from shaker.release.response import load_share

# The rise time of a response from its fitted beginning.


_FROM, _TO = 0.1, 0.9
_GRID = 800
_PERIODS = 1.5


def rise_time(fit: Beginning) -> tuple[float, float] | None:
    """Return how long the fitted curve takes from 10 % to 90 % of its change, first crossings, and its uncertainty.

    None where the curve does not get there. A crossing t of the level b + share·Σg moves by -(∂(y - level)/∂θ)/(dy/dt)
    with the parameters θ of the fit.
    """
    if fit.covariance is None:
        raise ValueError("fit: expected one with its covariance, found none")
    crossings = [_crossing_s(fit, share) for share in (_FROM, _TO)]
    if crossings[0] is None or crossings[1] is None:
        return None
    times = np.array(crossings)
    vector, u = fit.vector, np.sqrt(np.maximum(np.diagonal(fit.covariance), 0.0))
    here = _above(fit, times)
    slopes = np.zeros((2, len(u)))
    for place in np.flatnonzero(u):
        moved = vector.copy()
        moved[place] += 1e-2 * u[place]
        slopes[:, place] = (_above(fit.with_vector(moved), times) - here) / (1e-2 * u[place])
    by = -slopes / fit.speed(times)[:, None]
    gradient = by[1] - by[0]
    return float(times[1] - times[0]), float(np.sqrt(max(gradient @ fit.covariance @ gradient, 0.0)))


def _crossing_s(fit: Beginning, share: float) -> float | None:
    """Return when the fitted curve first passes a share of its change, None where it does not soon."""
    span = fit.release_s + 4.0 * fit.lag_s + _PERIODS / float(np.min(fit.frequency_hz))
    time = fit.onset_s + np.linspace(0.0, span, _GRID)
    change = fit.steady - fit.linear[0]
    relative = (fit.at(time) - fit.linear[0]) / change
    above = np.flatnonzero(relative >= share)
    if not above.size or above[0] == 0:
        return None
    after = int(above[0])
    low, high = relative[after - 1], relative[after]
    return float(time[after - 1] + (share - low) / (high - low) * (time[after] - time[after - 1]))


def _above(fit: Beginning, time_s: FloatArray) -> FloatArray:
    """Return the curve above the levels of 10 % and 90 % (2,) at two times (2,)."""
    shares = np.array([_FROM, _TO])
    return np.asarray(fit.at(time_s) - fit.linear[0] - shares * (fit.steady - fit.linear[0]))


# Onset and length of a release with what noise, and an unknown lag behind the sensor, leave open of them.


_NODES = 13  # lags at which everything else is fitted anew
_FEWEST = 5
_times_GRID = 121
_FAR, _NEAR = 10.0, 6.0  # standard deviations that the lags, and the lengths at each of them, reach
_COVERAGE = 1.96
_LIKELY = (1.92, 3.0)  # logarithm of the likelihood below its largest: 95 % of one and of two parameters
_DAMPER = 2.0 / np.sqrt(3.0)  # of ζ/ω: rectangular distribution of half width 2ζ/ω
_SPREAD = {"ramp": 1.0 / 12.0, "smooth": 0.25 - 2.0 / np.pi**2, "step": 1.0 / 12.0, "measured": 1.0 / 12.0}


@dataclass(frozen=True)
class ReleaseTimes:
    """Onset, length and lag in s with standard uncertainties."""

    onset_s: float
    u_onset_s: float
    release_s: float
    u_release_s: float
    lag_s: float
    u_lag_s: float


@dataclass(frozen=True)
class _Node:
    """What a given lag leaves: squares of the residual at the best length, its square and `centre_s` there.

    `by_square`: change of the centre with the squared length; variances of the latter and of the centre beside it.
    """

    squares: float
    length2: float
    variance: float
    centre_s: float
    by_square: float
    own: float


def release_times(window: Window, fit: Beginning, correlation: float) -> ReleaseTimes | None:
    """Return means and standard deviations of onset, length T and lag τ of a fit to a window.

    At each lag everything else is fitted, the likelihood being normal in T²; priors are flat in T ≥ 0 and in τ from 0
    to the lag whose corner is the lowest mode's frequency. Onset = centre - T/2 - τ. `correlation`: by how much that of
    the residual enlarges variances. Added to the onset: an output that holds the force of the sensor's damper too,
    (2ζs/ω + 1), comes earlier by 2ζ/ω. None where the lags cannot be told apart at all.
    """
    variance = fit.squares / max(fit.rows - len(fit.vector), 1) * correlation
    lags, nodes = _nodes(window, fit, variance)
    if len(nodes) < _FEWEST:
        return None
    lag = np.linspace(lags[0], lags[-1], _times_GRID)
    squares, length2, spread, centre, by_square, own = _between(lags, nodes, lag)
    length = _lengths(length2, np.sqrt(spread))
    away = length**2 - length2[:, None]
    log_weight = -0.5 * ((squares - squares.min()) / variance)[:, None] - 0.5 * away**2 / spread[:, None]
    weight = np.exp(log_weight - log_weight.max()) * (length[:, -1] - length[:, 0])[:, None]
    weight /= weight.sum()
    onset = centre[:, None] + by_square[:, None] * away - 0.5 * length - lag[:, None]
    edges = np.concatenate([log_weight[0], log_weight[-1], log_weight[length == 0.0]])
    bounded = bool(np.any(edges > log_weight.max() - _LIKELY[0]))
    likely = log_weight > log_weight.max() - _LIKELY[int(bounded)]
    damper = _DAMPER * float(np.max(np.abs(fit.damping_ratio) / (2 * np.pi * fit.frequency_hz)))
    onset_s, u_onset_s = _moments(weight, onset, likely)
    release_s, u_release_s = _moments(weight, length, likely)
    lag_s, u_lag_s = _moments(weight, np.broadcast_to(lag[:, None], weight.shape), likely)
    u_onset_s = float(np.sqrt(u_onset_s**2 + np.sum(weight * own[:, None]) + damper**2))
    return ReleaseTimes(onset_s, u_onset_s, release_s, u_release_s, lag_s, u_lag_s)


def _nodes(window: Window, fit: Beginning, variance: float) -> tuple[FloatArray, list[_Node]]:
    """Return lags (L,) around that of the fit, and what each of them leaves, each started from its neighbour."""
    if fit.covariance is None:
        raise ValueError("fit: expected one with its covariance, found none")
    u_square = float(np.sqrt(fit.covariance[2, 2] / max(fit.squares / max(fit.rows - len(fit.vector), 1), 1e-300)))
    reach = _FAR * u_square * float(np.sqrt(variance))
    low = float(np.sqrt(max(fit.lag_s**2 - reach, 0.0)))
    high = min(float(np.sqrt(fit.lag_s**2 + reach)), longest_lag_s(fit))
    lags = np.linspace(min(low, 0.99 * high), high, _NODES)
    middle = int(np.argmin(np.abs(lags - fit.lag_s)))
    nodes: dict[int, _Node] = {}
    for way in (range(middle, _NODES), range(middle - 1, -1, -1)):
        here = fit
        for place in way:
            found = _node(window, here, float(lags[place]), variance)
            if found is None:
                break
            nodes[place], here = found
    places = sorted(nodes)
    return lags[places], [nodes[place] for place in places]


def _node(window: Window, near: Beginning, lag_s: float, variance: float) -> tuple[_Node, Beginning] | None:
    """Return what a lag leaves, by one step of Gauss and Newton from a fit near by, and the fit there.

    None where the step leads out of what can be.
    """
    square = near.release_s**2 + (near.lag_s**2 - lag_s**2) / _SPREAD[near.shape]
    start = replace(near, lag_s=lag_s, release_s=float(np.sqrt(max(square, 0.0))))
    trial = solved(window, start)
    here, (normal, downhill) = trial.fit, trial.projected.normal
    others = np.arange(len(downhill)) != 2
    scale = np.sqrt(np.maximum(np.diag(normal)[others], 1e-300))
    inverse = np.linalg.pinv(normal[np.ix_(others, others)] / np.outer(scale, scale), rcond=1e-12, hermitian=True)
    inverse = inverse / np.outer(scale, scale)
    step = inverse @ downhill[others]
    parameters = trial.parameters + np.insert(step, 2, 0.0)
    there = moved(window, here, parameters)
    if there is None:
        return None
    covariance = variance * inverse
    by_square = float(covariance[0, 1] / covariance[1, 1])
    node = _Node(
        squares=here.squares - float(downhill[others] @ step),
        length2=float(parameters[1]),
        variance=float(covariance[1, 1]),
        centre_s=float(parameters[0]),
        by_square=by_square,
        own=max(float(covariance[0, 0] - by_square * covariance[0, 1]), 0.0),
    )
    return node, there


def _between(lags: FloatArray, nodes: list[_Node], lag: FloatArray) -> FloatArray:
    """Return the six numbers of the nodes (6, G) at lags between them."""
    from scipy.interpolate import CubicSpline

    table = [[n.squares, n.length2, n.variance, n.centre_s, n.by_square, n.own] for n in nodes]
    found = np.asarray(CubicSpline(lags, np.array(table))(lag)).T
    found[[2, 5]] = np.maximum(found[[2, 5]], np.array([1e-300, 0.0])[:, None])
    return found


def _lengths(square: FloatArray, u_square: FloatArray) -> FloatArray:
    """Return lengths (G, G), at each lag a row whose squares cover their distribution, none below zero."""
    low = np.sqrt(np.maximum(square - _NEAR * u_square, 0.0))
    high = np.sqrt(np.maximum(square + _NEAR * u_square, 1e-3 * u_square))
    return np.asarray(np.linspace(low, high, _times_GRID, axis=1))


def _moments(weight: FloatArray, value: FloatArray, likely: BoolArray) -> tuple[float, float]:
    """Return mean and standard deviation of values under weights that sum to 1.

    The standard deviation is at least what makes the 95 % interval hold every likely value: zero, where a time may be
    zero.
    """
    mean = float(np.sum(weight * value))
    away = float(np.max(np.abs(value[likely] - mean)))
    return mean, max(float(np.sqrt(np.sum(weight * (value - mean) ** 2))), away / _COVERAGE)


# The release as a force channel measured it.


_LENGTHS = 3.0  # of the release on either side that the fit takes


@dataclass(frozen=True)
class ForceReading:
    """Onset and length in s of the load's change, and the change in N or N·m, with standard uncertainties.

    `shape`: the better of a straight ramp and half a cosine.
    """

    onset_s: float
    u_onset_s: float
    release_s: float
    u_release_s: float
    change: float
    u_change: float
    shape: Literal["ramp", "smooth"]


def read_force(force: FloatArray, sample_rate_hz: float, start_s: float) -> ForceReading:
    """Return what a force channel (N,), its first sample at `start_s`, shows of a release.

    Least squares of level, change, middle and length of `load_share` around the release.
    """
    place = locate(force)
    readings = [_fitted(force, sample_rate_hz, start_s, place, shape) for shape in ("ramp", "smooth")]
    return min(readings, key=lambda reading: reading[1])[0]


def _fitted(
    force: FloatArray, sample_rate_hz: float, start_s: float, place: Location, shape: Literal["ramp", "smooth"]
) -> tuple[ForceReading, float]:
    """Return the reading of one shape and its sum of squares."""
    from scipy.optimize import least_squares

    length = max((place.high - place.low) / 0.8, 2.0)
    low = max(0, int(place.low - _LENGTHS * length - 8))
    high = min(len(force), int(place.high + _LENGTHS * length + 8))
    number = np.arange(low, high, dtype=np.float64)
    start = [place.baseline, place.steady - place.baseline, 0.5 * (place.low + place.high), length]

    def residual(x: FloatArray) -> FloatArray:
        return np.asarray(x[0] + x[1] * load_share(shape, number, x[2] - 0.5 * x[3], x[3]) - force[low:high])

    bounds = ([-np.inf, -np.inf, low, 0.1], [np.inf, np.inf, high, 2.0 * (high - low)])
    scale = [abs(start[1]), abs(start[1]), length, length]
    found = least_squares(residual, start, bounds=bounds, x_scale=scale, diff_step=1e-5)
    variance = 2.0 * found.cost / max(len(number) - 4, 1) * correlation_factor(found.fun)
    covariance = variance * np.linalg.pinv(found.jac.T @ found.jac, hermitian=True)
    half = np.array([0.0, 0.0, 1.0, -0.5])
    u = np.sqrt(np.diagonal(covariance))
    reading = ForceReading(
        onset_s=start_s + float(half @ found.x) / sample_rate_hz,
        u_onset_s=float(np.sqrt(half @ covariance @ half)) / sample_rate_hz,
        release_s=float(found.x[3]) / sample_rate_hz,
        u_release_s=float(u[3]) / sample_rate_hz,
        change=float(found.x[1]),
        u_change=float(u[1]),
        shape=shape,
    )
    return reading, float(found.cost)


# When the channels of a record were released, and what they ring with.


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
