"""Onset and time course of a release, and the rise time of the output."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from shaker.lti.system import modal_poles
from shaker.release.load_response import load_rate, load_share, pole_responses
from shaker.release.record import ApproximateOnset, ReleaseShape, ringing_poles
from shakercal._common.arrays import Arrays, ComplexArray, FloatArray
from shakercal._common.fitting import BlockJacobian, LinearBlock, LMOptions, SeparablePoint, levenberg_marquardt

# Fit of the onset and the length of a release from the response of the modes.

_GROWTH = 30.0  # largest exponent of a growing trial mode over the window
_DIFFERENCE = 1e-5  # relative step of numerical derivatives
_AHEAD = 2  # prior rows before the samples
_SHORT = 0.3  # samples: smallest step of release and lag for derivatives


@dataclass(frozen=True, repr=False)
class Window(Arrays):
    """Samples (N,) at `time_s` (N,) around the onset.

    `rest`: mean of `before` earlier samples. `small`: standard deviation of a sample over that of the change in modes
    too high to be observed. `longest_s`: longest release that is considered.
    """

    time_s: FloatArray
    samples: FloatArray
    rest: float
    before: float
    small: float
    longest_s: float

    @property
    def step_s(self) -> float:
        """Sampling interval."""
        return float(self.time_s[1] - self.time_s[0])


@dataclass(frozen=True, repr=False)
class OnsetModel(Arrays):
    """Response of modes behind one lag to a load of `shape`.

    y = b + Σ g·S + h·L. Modes ω²/(s² + 2ζωs + ω²) behind one lag 1/(1 + τs). Free residues would not determine the
    onset, because a delay δ of H(s) is to first order a zero, H(s)·(1 - δs). The onset is determined because every mode
    starts like t², behind a lag like t³. A short release and a lag act like a delay to first order and differ in second
    order only. The parameters are therefore centre = onset + T/2 + τ, T² and τ². Modes too high to be observed follow
    the load L behind the lag; their part h has a small prior (`Window`).

    `frequency_hz`, `damping_ratio` (M,) of the modes. `linear` = [b, g (M,), h]. `covariance` of `vector`, None before
    the fit. `squares` of the residual over `rows`.
    """

    shape: ReleaseShape
    centre_s: float
    release_s: float
    lag_s: float
    frequency_hz: FloatArray
    damping_ratio: FloatArray
    linear: FloatArray
    squares: float = 0.0
    rows: int = 0
    covariance: FloatArray | None = None

    @property
    def onset_s(self) -> float:
        """Time at which the load starts to change."""
        return self.centre_s - 0.5 * self.release_s - self.lag_s

    @property
    def vector(self) -> FloatArray:
        """All parameters: [centre_s, release_s², lag_s², frequency_hz, damping_ratio, linear]."""
        times = [self.centre_s, self.release_s**2, self.lag_s**2]
        return np.concatenate([times, self.frequency_hz, self.damping_ratio, self.linear])

    def with_vector(self, vector: FloatArray) -> OnsetModel:
        """Return the model with other parameters; negative squared times are set to zero."""
        modes = len(self.frequency_hz)
        (centre, release, lag), f, z, linear = np.split(vector, np.cumsum([3, modes, modes]))
        return replace(
            self,
            centre_s=float(centre),
            release_s=float(np.sqrt(max(release, 0.0))),
            lag_s=float(np.sqrt(max(lag, 0.0))),
            frequency_hz=f,
            damping_ratio=z,
            linear=linear,
        )

    @property
    def steady(self) -> float:
        """Level long after the release, b + Σ g + h."""
        return float(np.sum(self.linear))

    @cached_property
    def poles(self) -> ComplexArray:
        """Upper poles of the modes (M,) in rad/s, then of a lag."""
        rate = np.array([1.0 / self.lag_s] if self.lag_s > 0 else [])
        return modal_poles(2 * np.pi * self.frequency_hz, self.damping_ratio, rate)

    @cached_property
    def weights(self) -> ComplexArray:
        """Weights (P, M) whose product with the responses of `poles` has the real part wanted."""
        modes = len(self.frequency_hz)
        upper, omega = self.poles[:modes], 2 * np.pi * self.frequency_hz
        direct = np.diag(omega**2 / (1j * upper.imag * (1.0 + self.lag_s * upper)))
        if self.lag_s <= 0:
            return np.asarray(direct)
        behind = omega**2 * self.lag_s / ((1.0 + self.lag_s * upper) * (1.0 + self.lag_s * upper.conj()))
        return np.concatenate([direct, behind[None]])

    def responses(self, time_s: FloatArray) -> ComplexArray:
        """Return the responses (N, P) of `poles`, an optional argument of `columns` and `speed`."""
        return pole_responses(self.poles, time_s, self.onset_s, self.release_s, self.shape)

    def columns(self, time_s: FloatArray, responses: ComplexArray | None = None) -> FloatArray:
        """Return the design (N, 2 + M) of `linear`."""
        responses = self.responses(time_s) if responses is None else responses
        if self.lag_s > 0:
            follows = responses[:, -1].real / self.lag_s
        else:
            follows = load_share(self.shape, time_s, self.onset_s, self.release_s)
        modes = np.real(responses @ self.weights)
        return np.concatenate([np.ones((len(responses), 1)), modes, follows[:, None]], axis=1)

    def at(self, time_s: FloatArray) -> FloatArray:
        """Return y (N,)."""
        return np.asarray(self.columns(time_s) @ self.linear)

    def speed(self, time_s: FloatArray, responses: ComplexArray | None = None) -> FloatArray:
        """Return dy/dt (N,): pR + load for a response R of 1/(s - p)."""
        responses = self.responses(time_s) if responses is None else responses
        load = load_share(self.shape, time_s, self.onset_s, self.release_s)
        rates = responses * self.poles + load[:, None]
        if self.lag_s > 0:
            follows = rates[:, -1].real / self.lag_s
        else:
            follows = load_rate(self.shape, time_s, self.onset_s, self.release_s)
        return np.asarray(np.real(rates @ (self.weights @ self.linear[1:-1])) + self.linear[-1] * follows)

    @property
    def penalty(self) -> float:
        """Schwarz criterion N·ln(squares/N) + P·ln N."""
        count = len(self.vector)
        return float(self.rows * np.log(max(self.squares, 1e-300) / self.rows) + count * np.log(self.rows))


@dataclass(frozen=True)
class OnsetTrial:
    """An onset model with its linear part solved, as a point of the search.

    Times and modes are its parameters. The first rows are the mean of the rest and the prior of h.
    """

    fit: OnsetModel
    projected: SeparablePoint

    @property
    def parameters(self) -> FloatArray:
        """Times and modes (K,)."""
        return self.projected.parameters

    @property
    def loss(self) -> float:
        """Sum of squares."""
        return self.fit.squares

    @property
    def freedom(self) -> int:
        """Degrees of freedom."""
        return self.projected.freedom

    @property
    def normal(self) -> tuple[FloatArray, FloatArray]:
        """Normal equations, with parameters fixed at bounds that the descent would leave."""
        normal, downhill = (part.copy() for part in self.projected.normal)
        fit, fixed = self.fit, np.zeros(len(downhill), dtype=np.bool_)
        fixed[1] = fit.release_s <= 0.0 and downhill[1] < 0.0
        longest = fit.lag_s >= (1.0 - 1e-9) * longest_lag_s(fit)
        fixed[2] = (fit.lag_s <= 0.0 and downhill[2] < 0.0) or (longest and downhill[2] > 0.0)
        normal[fixed], normal[:, fixed], downhill[fixed] = 0.0, 0.0, 0.0
        return normal, downhill

    @property
    def with_covariance(self) -> OnsetModel:
        """The fit with the covariance of the joint problem, from the variance of the residual."""
        columns = self.projected.blocks[0].design
        jacobian = np.concatenate([self.projected.jacobians[0].rows[:, :, 0], columns], axis=1)
        scale = np.maximum(np.linalg.norm(jacobian, axis=0), 1e-300)
        inverse = np.linalg.pinv((jacobian / scale).T @ (jacobian / scale), rcond=1e-13, hermitian=True)
        variance = self.loss / max(self.fit.rows - jacobian.shape[1], 1)
        return replace(self.fit, covariance=np.asarray(variance * inverse / np.outer(scale, scale)))


def fit_onset(window: Window, start: OnsetModel, min_gain: float) -> OnsetTrial:
    """Return the least-squares fit from `start`; steps gain `min_gain` variances or more."""
    rows = len(window.samples) + _AHEAD
    rules = LMOptions(
        predicted_decrease_share=0.0, actual_decrease_share=min_gain / rows, max_steps=30, max_damping=1e5
    )

    def at(parameters: FloatArray) -> OnsetTrial | None:
        model = bounded_parameters(window, start, parameters)
        return None if model is None else solve_amplitudes(window, model)

    return levenberg_marquardt(at, solve_amplitudes(window, start), rules).point


def solve_amplitudes(window: Window, start: OnsetModel) -> OnsetTrial:
    """Return an onset model with its linear part solved."""
    responses = start.responses(window.time_s)
    columns, target = _rows(window, start.columns(window.time_s, responses))
    count = 3 + 2 * len(start.frequency_hz)

    def changes(coefficients: FloatArray) -> BlockJacobian:
        return BlockJacobian(
            np.arange(count), _slopes(window, replace(start, linear=coefficients[:, 0]), columns, responses)[:, :, None]
        )

    point = SeparablePoint(start.vector[:count], (LinearBlock(columns, target[:, None], changes),))
    linear = point.coefficients[0][:, 0]
    return OnsetTrial(replace(start, linear=linear, squares=point.loss, rows=len(target)), point)


def _rows(window: Window, columns: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return columns (…, N + 2, 2 + M) and target, two prior rows first."""
    weight = np.sqrt(window.before)
    ahead = np.zeros((*columns.shape[:-2], _AHEAD, columns.shape[-1]))
    ahead[..., 0, 0], ahead[..., 1, -1] = weight, window.small
    return np.concatenate([ahead, columns], axis=-2), np.concatenate([[weight * window.rest, 0.0], window.samples])


def _slopes(window: Window, fit: OnsetModel, columns: FloatArray, responses: ComplexArray) -> FloatArray:
    """Return the derivatives (N + 2, K) of y by centre, squared times, and modes."""
    time = window.time_s
    slopes = np.zeros((len(time) + _AHEAD, len(fit.vector) - len(fit.linear)))
    slopes[_AHEAD:, 0] = -fit.speed(time, responses)
    fitted = columns[_AHEAD:] @ fit.linear
    vector, modes = fit.vector, len(fit.frequency_hz)
    for index in (1, 2):
        shifted = vector.copy()
        span = max(_DIFFERENCE * abs(vector[index]), (_SHORT * window.step_s) ** 2)
        shifted[index] += span
        slopes[_AHEAD:, index] = (fit.with_vector(shifted).at(time) - fitted) / span
    # a frequency or damping ratio affects its mode only: all changed modes are evaluated together
    f, z = np.tile(fit.frequency_hz, 2), np.tile(fit.damping_ratio, 2)
    spans = _DIFFERENCE * np.abs(vector[3 : 3 + 2 * modes])
    spans[modes:] = np.maximum(spans[modes:], 1e-9)
    f[:modes], z[modes:] = f[:modes] + spans[:modes], z[modes:] + spans[modes:]
    changed = replace(fit, frequency_hz=f, damping_ratio=z).columns(time)[:, 1:-1]
    differences = changed - np.tile(columns[_AHEAD:, 1:-1], 2)
    slopes[_AHEAD:, 3:] = differences * (np.tile(fit.linear[1:-1], 2) / spans)
    return slopes


def bounded_parameters(window: Window, fit: OnsetModel, parameters: FloatArray) -> OnsetModel | None:
    """Return the fit with other times and modes within their bounds, None if impossible."""
    vector = fit.vector
    vector[: len(parameters)] = parameters
    vector[2] = min(vector[2], longest_lag_s(fit) ** 2)
    model = fit.with_vector(vector)
    inside = window.time_s[0] <= model.onset_s <= window.time_s[-1] and model.release_s < window.longest_s
    modes = (model.frequency_hz > 0) & (model.frequency_hz < 0.5 / window.step_s) & (np.abs(model.damping_ratio) < 0.9)
    modes &= -model.damping_ratio * 2 * np.pi * model.frequency_hz * np.ptp(window.time_s) < _GROWTH
    return model if inside and bool(np.all(modes)) else None


def longest_lag_s(fit: OnsetModel) -> float:
    """Return the lag whose corner is the lowest mode; instruments are faster."""
    return float(1.0 / (2 * np.pi * np.min(fit.frequency_hz)))


# Fit of an onset from start values of the record.

_PERIODS = 12.0  # of the lowest mode after the release, in the fit
_PER_PERIOD = 50  # samples per period of the highest mode that are retained
_MOST = 2000  # blocks in the fit, at most
_LENGTHS = np.array([0.1, 0.35, 0.55, 0.75, 0.95, 1.15, 1.4])  # trial lengths over that of the longest plausible ramp
_LONGEST = 2.0  # length of a release over that of the longest plausible ramp, at most
_CENTRES = 7  # trial centres
_GRID = 160  # samples in the search for start values
_SMOOTHER = 1.33  # length of a smooth release over that of the ramp of equal second moment
_HIGH_MODE_SHARE = 0.03  # standard deviation of the share of the change in modes too high to be observed
_NO_HIGH_MODES = 1e6  # prior weight that suppresses unobserved modes in the search for start values
_DECIDED = 6.0  # significant difference of the Schwarz criterion
_CALM = 1e-3  # gain of a step, in variances of the residual, at which a search ends


def find_onset(
    samples: FloatArray, sample_rate_hz: float, start_s: float, location: ApproximateOnset, min_gain: float = _CALM
) -> tuple[Window, OnsetTrial]:
    """Return the window around the onset of samples (N,), and its fit.

    The first sample is at `start_s`. The release is a straight ramp unless the Schwarz criterion selects a smooth one.
    Without ringing, one trial mode is fitted.
    """
    # a sample that is almost certainly after the release
    end = location.first_motion + 1.5 * max(location.index_90 - location.first_motion, 4.0)
    after = int(min(end, location.first_motion + 0.5 * (len(samples) - location.first_motion)))
    poles = ringing_poles(samples[after:] - location.steady, sample_rate_hz, location.noise)
    sets = [poles]
    if not len(poles):  # trial modes with large damping, by the rise time
        rise_s = max(location.index_90 - location.index_10, 2.0) / sample_rate_hz
        frequency = np.minimum(np.array([0.3, 1.0, 3.0]) / rise_s, 0.2 * sample_rate_hz)
        sets = [2 * np.pi * f * np.array([-0.5 + 0.75**0.5 * 1j]) for f in frequency]
    fits = []
    for trial in sets:
        window = _window(samples, sample_rate_hz, start_s, location, trial)
        seen = replace(window, small=_NO_HIGH_MODES)
        first = fit_onset(seen, _start(seen, location, trial, sample_rate_hz, start_s), min_gain)
        fits.append((window, fit_onset(window, first.fit, min_gain)) if len(poles) else (seen, first))
    window, ramp = min(fits, key=lambda trial: trial[1].loss / trial[1].fit.rows)
    start = replace(ramp.fit, shape="smooth", release_s=_SMOOTHER * ramp.fit.release_s)
    smooth = fit_onset(window, start, min_gain)
    return window, smooth if smooth.fit.penalty < ramp.fit.penalty - _DECIDED else ramp


def _window(
    samples: FloatArray, sample_rate_hz: float, start_s: float, location: ApproximateOnset, poles: ComplexArray
) -> Window:
    """Return the samples around the onset, averaged in blocks if they are denser than necessary."""
    block = max(1, int(2 * np.pi * sample_rate_hz / (_PER_PERIOD * float(np.max(np.abs(poles))))))
    length = location.index_90 - location.first_motion
    period = 2 * np.pi * sample_rate_hz / float(np.min(np.abs(poles)))
    margin = int(min(location.first_motion // 2, 2.0 * length + 0.7 * period + 4 * block))
    low = location.first_motion - margin
    count = int(min(len(samples) - low, _MOST * block, margin + 2.0 * length + _PERIODS * period))
    blocks = count // block
    means = np.asarray(samples[low : low + blocks * block].reshape(blocks, block).mean(axis=1))
    middle = low + (np.arange(blocks, dtype=np.float64) + 0.5) * block - 0.5
    small = location.noise / np.sqrt(block) / max(_HIGH_MODE_SHARE * abs(location.steady - location.baseline), 1e-300)
    rest = float(np.mean(samples[:low])) if low else 0.0
    return Window(
        np.asarray(start_s + middle / sample_rate_hz),
        means,
        rest,
        low / block,
        float(small),
        _LONGEST * location.max_ramp_samples / sample_rate_hz,
    )


def _start(
    window: Window, location: ApproximateOnset, poles: ComplexArray, sample_rate_hz: float, start_s: float
) -> OnsetModel:
    """Return the best of a grid of centres and lengths without lag."""
    every = max(1, len(window.samples) // _GRID)
    thin = replace(
        window,
        time_s=window.time_s[::every],
        samples=window.samples[::every],
        before=window.before / every,
        small=float(window.small / np.sqrt(every)),
    )
    plain_s = location.max_ramp_samples / sample_rate_hz
    middle_s = start_s + 0.5 * (location.index_10 + location.index_90) / sample_rate_hz
    early_s = np.linspace(0.0, 0.3 * 2 * np.pi / float(np.min(np.abs(poles))), _CENTRES)
    frequency, damping = np.abs(poles) / (2 * np.pi), -poles.real / np.abs(poles)
    best, least = OnsetModel("ramp", middle_s, plain_s, 0.0, frequency, damping, np.zeros(0)), np.inf
    for length in _LENGTHS * plain_s:
        trial = replace(best, centre_s=middle_s, release_s=length)
        times = thin.time_s + early_s[:, None]  # times relative to an earlier centre
        columns, target = _rows(thin, trial.columns(times.ravel()).reshape(*times.shape, -1))
        joined = np.concatenate([columns, np.broadcast_to(target[:, None], (*columns.shape[:2], 1))], axis=-1)
        squares = np.asarray(np.linalg.qr(joined, mode="r"))[:, -1, -1] ** 2
        if np.min(squares) < least:
            least = float(np.min(squares))
            best = replace(trial, centre_s=middle_s - early_s[np.argmin(squares)])
    return solve_amplitudes(thin, best).fit


# Rise time of a response from its fitted onset.

_SHARES = np.array([0.1, 0.9])
_CURVE = 800  # points of the curve for the search of crossings
_SOON = 1.5  # periods of the lowest mode after release and lag within which the crossings must be


def rise_time(fit: OnsetModel) -> tuple[float, float] | None:
    """Return the time from 10 % to 90 % of the change with its uncertainty.

    First crossings of the fitted curve count; None if it does not reach them soon. A crossing of the level b + share·Σg
    moves by -(∂(y - level)/∂θ)/(dy/dt) with the parameters θ of the fit.
    """
    if fit.covariance is None:
        raise ValueError("fit: expected one with its covariance, found none")
    span = fit.release_s + 4.0 * fit.lag_s + _SOON / float(np.min(fit.frequency_hz))
    time = fit.onset_s + np.linspace(0.0, span, _CURVE)
    relative = (fit.at(time) - fit.linear[0]) / (fit.steady - fit.linear[0])
    after = np.argmax(relative >= _SHARES[:, None], axis=1)
    if np.any(after == 0):
        return None
    low, high = relative[after - 1], relative[after]
    times = time[after - 1] + (_SHARES - low) / (high - low) * (time[after] - time[after - 1])

    def above(curve: OnsetModel) -> FloatArray:
        return np.asarray(curve.at(times) - curve.linear[0] - _SHARES * (curve.steady - curve.linear[0]))

    vector, u = fit.vector, np.sqrt(np.maximum(np.diagonal(fit.covariance), 0.0))
    slopes = np.zeros((2, len(u)))
    for index in np.flatnonzero(u):
        shifted = vector.copy()
        shifted[index] += 1e-2 * u[index]
        slopes[:, index] = (above(fit.with_vector(shifted)) - above(fit)) / (1e-2 * u[index])
    gradient = np.diff(-slopes / fit.speed(times)[:, None], axis=0)[0]
    return float(times[1] - times[0]), float(np.sqrt(max(gradient @ fit.covariance @ gradient, 0.0)))
