"""Onset and shape of a release: where the load begins to leave, and how."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from shaker.arrays import BoolArray, ComplexArray, FloatArray
from shaker.release.record import Location, Shape, ringing_poles

# What a pole answers to a release that takes its time.


def pole_responses(poles: ComplexArray, time_s: FloatArray, onset_s: float, release_s: float) -> ComplexArray:
    """Return responses (N, P) of 1/(s - p), poles (P,) in rad/s, to a load that grows from 0 to 1, at `time_s` (N,).

    The load is clip((t - onset)/T, 0, 1) with T = `release_s` ≥ 0, a step for T = 0. With τ = t - onset: before the end
    of the ramp [(exp(pτ) - 1)/p - τ]/(pT); after it [exp(p(τ - T))·(exp(pT) - 1)/(pT) - 1]/p; zero before the onset.
    """
    p = np.asarray(poles, dtype=np.complex128)
    if release_s < 0:
        raise ValueError(f"release_s: expected 0 or more, found {release_s}")
    tau = np.asarray(time_s, dtype=np.float64)[:, None] - onset_s
    during = (tau > 0) & (tau < release_s)
    after = (tau > 0) & ~during
    found = np.zeros((len(tau), len(p)), dtype=np.complex128)
    late, early = tau[after[:, 0]], tau[during[:, 0]]
    spread = np.expm1(p * release_s) / (p * release_s) if release_s > 0 else np.ones_like(p)
    found[after[:, 0]] = (np.exp(p * (late - release_s)) * spread - 1.0) / p
    if early.size:
        found[during[:, 0]] = (np.expm1(p * early) / p - early) / (p * release_s)
    return found


# Shapes of a release: how the load goes, and what poles answer.


def load_share(shape: Shape, time_s: FloatArray, onset_s: float, release_s: float) -> FloatArray:
    """Return the share (N,) of the load's change at `time_s` (N,): 0 before `onset_s`, 1 from its end on.

    In between, with x = (t - onset)/T: x of a "ramp", (1 - cos πx)/2 of a "smooth" release.
    """
    tau = np.asarray(time_s, dtype=np.float64) - onset_s
    if release_s <= 0.0 or shape == "step":
        return np.asarray((tau > 0).astype(np.float64))
    x = np.clip(tau / release_s, 0.0, 1.0)
    return np.asarray(x if shape == "ramp" else 0.5 * (1.0 - np.cos(np.pi * x)))


def load_rate(shape: Shape, time_s: FloatArray, onset_s: float, release_s: float) -> FloatArray:
    """Return the derivative (N,) of `load_share` in 1/s, 0 of a step."""
    tau = np.asarray(time_s, dtype=np.float64) - onset_s
    if release_s <= 0.0 or shape == "step":
        return np.zeros(len(tau))
    during = (tau > 0) & (tau < release_s)
    rate = 1.0 if shape == "ramp" else 0.5 * np.pi * np.sin(np.pi * tau / release_s)
    return np.asarray(np.where(during, rate, 0.0) / release_s)


def shape_responses(
    shape: Shape, poles: ComplexArray, time_s: FloatArray, onset_s: float, release_s: float
) -> ComplexArray:
    """Return responses (N, P) of 1/(s - p), poles (P,) in rad/s, at `time_s` (N,), to a load of a shape.

    "step" and "ramp" as in `pole_responses`. "smooth": with ω = π/T and τ = t - onset, until the end
    [(exp(pτ) - 1)/p - (p(exp(pτ) - cos ωτ) + ω sin ωτ)/(p² + ω²)]/2; then the free motion from there under full load.
    """
    if shape == "measured":
        raise ValueError('shape: expected "step", "ramp" or "smooth", found "measured"')
    if shape != "smooth" or release_s <= 0.0:
        return pole_responses(poles, time_s, onset_s, 0.0 if shape == "step" else release_s)
    p = np.asarray(poles, dtype=np.complex128)
    tau = np.asarray(time_s, dtype=np.float64)[:, None] - onset_s
    omega = np.pi / release_s
    found = np.zeros((len(tau), len(p)), dtype=np.complex128)
    during = (tau[:, 0] > 0) & (tau[:, 0] < release_s)
    after = tau[:, 0] >= release_s
    early, late = tau[during], tau[after] - release_s
    swing = p * (np.exp(p * early) - np.cos(omega * early)) + omega * np.sin(omega * early)
    found[during] = 0.5 * (np.expm1(p * early) / p - swing / (p**2 + omega**2))
    end = 0.5 * (np.expm1(p * release_s) / p - p * (np.exp(p * release_s) + 1.0) / (p**2 + omega**2))
    found[after] = end * np.exp(p * late) + np.expm1(p * late) / p
    return found


def force_responses(poles: ComplexArray, force: FloatArray, sample_rate_hz: float) -> ComplexArray:
    """Return responses (N, P) of 1/(s - p), poles (P,) in rad/s, from rest, to a measured load (N,).

    Between samples the load is a straight line, for which the recursion is exact:
    x[n+1] = z·x[n] + (u[n]·(z - 1 - w) + u[n+1]·w)/p with z = exp(pΔ) and w = (z - 1)/(pΔ) - 1.
    """
    from scipy.signal import lfilter

    p = np.asarray(poles, dtype=np.complex128)
    u = np.asarray(force, dtype=np.float64)
    step = 1.0 / sample_rate_hz
    found = np.zeros((len(u), len(p)), dtype=np.complex128)
    for place, pole in enumerate(p):
        grown = np.expm1(pole * step)
        new = grown / (pole * step) - 1.0
        drive = (u[:-1] * (grown - new) + u[1:] * new) / pole
        found[1:, place] = lfilter([1.0], [1.0, -np.exp(pole * step)], drive)
    return found


# The beginning of a response: onset and length of the release, by the modes that answer it.


_ITERATIONS = 30
_GROWTH = 30.0  # largest exponent by which a trial mode may grow over the window
_DIFFERENCE = 1e-5
_AHEAD = 2  # rows ahead of the samples
_SHORT = 0.3  # samples: shortest release and lag by which slopes are taken


@dataclass(frozen=True)
class Window:
    """Samples (N,) at `time_s` (N,) around the beginning, and the mean of `before` samples ahead of them, `rest`.

    `small`: standard deviation of a sample over that of the change which modes too high to be seen may carry;
    `longest_s`: of releases that are thought of.
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


@dataclass(frozen=True)
class Beginning:
    """y = b + Σ g·S + h·L: modes ω²/(s² + 2ζωs + ω²) behind one lag 1/(1 + τs) answer a load of `shape`.

    Free residues would tell nothing of the onset: a delay δ of H(s) is, to first order, a zero, H(s)·(1 - δs). That
    every mode begins like t², behind a lag like t³, is what fixes it. A short release and a lag do what a delay does to
    first order and show in second order only, so that centre = onset + T/2 + τ, T² and τ² are the parameters.
    Modes too high to be seen follow the load, L, behind the lag; what they carry, h, is small beforehand (`Window`).
    `frequency_hz`, `damping_ratio` (M,) of the modes, `linear` = [b, g (M,), h]; `covariance` of `vector`, None before
    the fit; `squares` of the residual over `rows`.
    """

    shape: Shape
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
        """When the load begins to change."""
        return self.centre_s - 0.5 * self.release_s - self.lag_s

    @property
    def vector(self) -> FloatArray:
        """All parameters: [centre_s, release_s², lag_s², frequency_hz, damping_ratio, linear]."""
        times = [self.centre_s, self.release_s**2, self.lag_s**2]
        return np.concatenate([times, self.frequency_hz, self.damping_ratio, self.linear])

    def with_vector(self, vector: FloatArray) -> Beginning:
        """Return the same with other parameters; squared times below zero are taken as zero."""
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

    @property
    def poles(self) -> ComplexArray:
        """Upper poles of the modes (M,), and that of the lag where there is one, in rad/s."""
        omega, zeta = 2 * np.pi * self.frequency_hz, self.damping_ratio
        upper = omega * (-zeta + 1j * np.sqrt(1 - zeta**2))
        return np.append(upper, -1.0 / self.lag_s + 0j) if self.lag_s > 0 else np.asarray(upper)

    @property
    def weights(self) -> ComplexArray:
        """Weights (P, M) with which responses of `poles` (P,) add up, as real parts, to those of the modes."""
        modes = len(self.frequency_hz)
        upper, omega = self.poles[:modes], 2 * np.pi * self.frequency_hz
        own = np.diag(omega**2 / (1j * upper.imag * (1.0 + self.lag_s * upper)))
        if self.lag_s <= 0:
            return np.asarray(own)
        behind = omega**2 * self.lag_s / ((1.0 + self.lag_s * upper) * (1.0 + self.lag_s * upper.conj()))
        return np.concatenate([own, behind[None]])

    def columns(self, time_s: FloatArray) -> FloatArray:
        """Return what `linear` multiplies (N, 2 + M)."""
        responses = shape_responses(self.shape, self.poles, time_s, self.onset_s, self.release_s)
        if self.lag_s > 0:
            follows = responses[:, -1].real / self.lag_s
        else:
            follows = load_share(self.shape, time_s, self.onset_s, self.release_s)
        modes = np.real(responses @ self.weights)
        return np.concatenate([np.ones((len(responses), 1)), modes, follows[:, None]], axis=1)

    def at(self, time_s: FloatArray) -> FloatArray:
        """Return y (N,)."""
        return np.asarray(self.columns(time_s) @ self.linear)

    def speed(self, time_s: FloatArray) -> FloatArray:
        """Return dy/dt (N,): of a response R of 1/(s - p) it is pR + load."""
        responses = shape_responses(self.shape, self.poles, time_s, self.onset_s, self.release_s)
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


def fit_beginning(window: Window, start: Beginning) -> Beginning:
    """Return the least-squares fit of everything in `start`, linear parts first (variable projection, Kaufman 1975).

    Levenberg-Marquardt on times and modes; the covariance is that of the joint problem with the variance of the
    residual.
    """
    best, residual, columns = solved(window, start)
    damping = 1e-3
    for _ in range(_ITERATIONS):
        basis, _ = np.linalg.qr(columns)
        slopes = slopes_of(window, best, columns)
        slopes = slopes - basis @ (basis.T @ slopes)
        slopes[:, _held(best, slopes.T @ residual)] = 0.0
        scale = np.maximum(np.linalg.norm(slopes, axis=0), 1e-300)
        normal, target = (slopes / scale).T @ (slopes / scale), (slopes / scale).T @ residual
        gained = 0.0
        while damping < 1e6:
            step = np.linalg.solve(normal + damping * np.eye(len(target)), target) / scale
            trial = moved_by(window, best, step)
            tried = None if trial is None else solved(window, trial)
            if tried is not None and tried[0].squares < best.squares:
                gained = 1.0 - tried[0].squares / best.squares
                best, residual, columns = tried
                damping = max(damping / 10.0, 1e-9)
                break
            damping *= 10.0
        if gained < 1e-3 / best.rows:
            break
    return replace(best, covariance=_covariance(window, best, columns))


def solved(window: Window, start: Beginning) -> tuple[Beginning, FloatArray, FloatArray]:
    """Return the fit with its linear parts solved, the residual (N + 2,), and the columns (N + 2, L).

    Ahead of the samples stand the mean of the rest and the smallness of h.
    """
    weight = np.sqrt(window.before)
    ahead = np.zeros((_AHEAD, 2 + len(start.frequency_hz)))
    ahead[0, 0], ahead[1, -1] = weight, window.small
    columns = np.concatenate([ahead, start.columns(window.time_s)])
    target = np.concatenate([[weight * window.rest, 0.0], window.samples])
    normal = columns.T @ columns
    size = np.sqrt(np.maximum(np.diagonal(normal), 1e-300))
    linear = np.linalg.lstsq(normal / np.outer(size, size), columns.T @ target / size, rcond=1e-12)[0] / size
    residual = target - columns @ linear
    return replace(start, linear=linear, squares=float(residual @ residual), rows=len(target)), residual, columns


def slopes_of(window: Window, fit: Beginning, columns: FloatArray) -> FloatArray:
    """Return the derivatives (N + 2, K) of y by centre, squared length and lag, frequencies and damping ratios."""
    time = window.time_s
    found = np.zeros((len(time) + _AHEAD, len(fit.vector) - len(fit.linear)))
    found[_AHEAD:, 0] = -fit.speed(time)
    here = columns[_AHEAD:] @ fit.linear
    vector = fit.vector
    least = [0.0, *[(_SHORT * window.step_s) ** 2] * 2, *[0.0] * len(fit.frequency_hz), *[1e-9] * len(fit.frequency_hz)]
    for place in range(1, found.shape[1]):
        span = max(_DIFFERENCE * abs(vector[place]), least[place])
        moved = vector.copy()
        moved[place] += span
        found[_AHEAD:, place] = (fit.with_vector(moved).at(time) - here) / span
    return found


def _held(fit: Beginning, downhill: FloatArray) -> BoolArray:
    """Tell which parameters (K,) stand at a bound that the way downhill would leave."""
    held = np.zeros(len(downhill), dtype=np.bool_)
    held[1] = fit.release_s <= 0.0 and downhill[1] < 0.0
    longest = fit.lag_s >= (1.0 - 1e-9) * longest_lag_s(fit)
    held[2] = (fit.lag_s <= 0.0 and downhill[2] < 0.0) or (longest and downhill[2] > 0.0)
    return held


def moved_by(window: Window, fit: Beginning, step: FloatArray) -> Beginning | None:
    """Return the fit with its times and modes moved up to their bounds, None outside what can be."""
    vector = fit.vector
    vector[: len(step)] += step
    vector[2] = min(vector[2], longest_lag_s(fit) ** 2)
    found = fit.with_vector(vector)
    inside = window.time_s[0] <= found.onset_s <= window.time_s[-1] and found.release_s < window.longest_s
    modes = (found.frequency_hz > 0) & (found.frequency_hz < 0.5 / window.step_s) & (np.abs(found.damping_ratio) < 0.9)
    modes &= -found.damping_ratio * 2 * np.pi * found.frequency_hz * np.ptp(window.time_s) < _GROWTH
    return found if inside and bool(np.all(modes)) else None


def longest_lag_s(fit: Beginning) -> float:
    """Return the lag whose corner frequency is that of the lowest mode: what records it rings slower than no mode."""
    return float(1.0 / (2 * np.pi * np.min(fit.frequency_hz)))


def _covariance(window: Window, fit: Beginning, columns: FloatArray) -> FloatArray:
    """Return the covariance of all parameters with the variance of the residual."""
    jacobian = np.concatenate([slopes_of(window, fit, columns), columns], axis=1)
    scale = np.maximum(np.linalg.norm(jacobian, axis=0), 1e-300)
    inverse = np.linalg.pinv((jacobian / scale).T @ (jacobian / scale), rcond=1e-13, hermitian=True)
    variance = fit.squares / max(fit.rows - jacobian.shape[1], 1)
    return np.asarray(variance * inverse / np.outer(scale, scale))


# The fit of a beginning from start values that the record itself gives.


_PERIODS = 12.0  # of the lowest mode after the release that the fit takes
_PER_PERIOD = 50  # samples per period of the highest mode below which nothing is averaged
_MOST = 2000
_LENGTHS = np.array([0.1, 0.35, 0.55, 0.75, 0.95, 1.15, 1.4])  # tried, over that of a ramp that the output follows
_LONGEST = 2.0
_CENTRES = 7
_GRID = 160  # samples that the search for start values takes
_SMOOTHER = 1.33  # length of a smooth release over that of the ramp of the same spread
_UNSEEN = 0.03  # share of the change that modes too high to be seen may carry, standard deviation
_NOTHING = 1e6  # weight that leaves nothing to modes that are not seen, in the search for start values
_DECIDED = 6.0  # difference of the Schwarz criterion that decides


def find_beginning(
    samples: FloatArray, sample_rate_hz: float, start_s: float, place: Location
) -> tuple[Window, Beginning]:
    """Return the window around the beginning of samples (N,), the first at `start_s`, and its fit.

    The release is taken as a straight ramp unless the Schwarz criterion asks for a smooth one. Where nothing rings, the
    one mode tried is all there is.
    """
    after = _after_release(place, len(samples))
    poles = ringing_poles(samples[after:] - place.steady, sample_rate_hz, place.noise)
    sets = [poles] if len(poles) else _unseen(place, sample_rate_hz)
    fits = []
    for trial in sets:
        window = _window(samples, sample_rate_hz, start_s, place, trial)
        seen = replace(window, small=_NOTHING)
        first = fit_beginning(seen, _start(seen, place, trial, sample_rate_hz, start_s))
        fits.append((window, fit_beginning(window, first)) if len(poles) else (seen, first))
    window, ramp = min(fits, key=lambda fit: fit[1].squares / fit[1].rows)
    smooth = fit_beginning(window, replace(ramp, shape="smooth", release_s=_SMOOTHER * ramp.release_s))
    return window, smooth if smooth.penalty < ramp.penalty - _DECIDED else ramp


def _unseen(place: Location, sample_rate_hz: float) -> list[ComplexArray]:
    """Return poles that are tried where nothing rings: one well damped mode at several times the rise."""
    rise_s = max(place.high - place.low, 2.0) / sample_rate_hz
    frequency = np.minimum(np.array([0.3, 1.0, 3.0]) / rise_s, 0.2 * sample_rate_hz)
    return [2 * np.pi * f * np.array([-0.5 + 0.75**0.5 * 1j]) for f in frequency]


def _after_release(place: Location, count: int) -> int:
    """Return a sample that is after the release with all likelihood."""
    end = place.first + 1.5 * max(place.high - place.first, 4.0)
    return int(min(end, place.first + 0.5 * (count - place.first)))


def _window(samples: FloatArray, sample_rate_hz: float, start_s: float, place: Location, poles: ComplexArray) -> Window:
    """Return the samples around the beginning, as means of blocks where they are denser than is needed."""
    block = max(1, int(2 * np.pi * sample_rate_hz / (_PER_PERIOD * float(np.max(np.abs(poles))))))
    length = place.high - place.first
    period = 2 * np.pi * sample_rate_hz / float(np.min(np.abs(poles)))
    margin = int(min(place.first // 2, 2.0 * length + 0.7 * period + 4 * block))
    low = place.first - margin
    count = int(min(len(samples) - low, _MOST * block, margin + 2.0 * length + _PERIODS * period))
    blocks = count // block
    means = np.asarray(samples[low : low + blocks * block].reshape(blocks, block).mean(axis=1))
    middle = low + (np.arange(blocks, dtype=np.float64) + 0.5) * block - 0.5
    small = place.noise / np.sqrt(block) / max(_UNSEEN * abs(place.steady - place.baseline), 1e-300)
    rest = float(np.mean(samples[:low])) if low else 0.0
    return Window(
        np.asarray(start_s + middle / sample_rate_hz),
        means,
        rest,
        low / block,
        float(small),
        _LONGEST * place.longest / sample_rate_hz,
    )


def _start(window: Window, place: Location, poles: ComplexArray, sample_rate_hz: float, start_s: float) -> Beginning:
    """Return the best of a grid of centres and lengths, with fixed modes and no lag."""
    every = max(1, len(window.samples) // _GRID)
    thin = replace(
        window,
        time_s=window.time_s[::every],
        samples=window.samples[::every],
        before=window.before / every,
        small=float(window.small / np.sqrt(every)),
    )
    plain_s = place.longest / sample_rate_hz
    middle_s = start_s + 0.5 * (place.low + place.high) / sample_rate_hz
    early_s = np.linspace(0.0, 0.3 * 2 * np.pi / float(np.min(np.abs(poles))), _CENTRES)
    frequency, damping = np.abs(poles) / (2 * np.pi), -poles.real / np.abs(poles)
    trials = [
        Beginning("ramp", middle_s - early, length, 0.0, frequency, damping, np.zeros(0))
        for length in _LENGTHS * plain_s
        for early in early_s
    ]
    return min((solved(thin, trial)[0] for trial in trials), key=lambda trial: trial.squares)
