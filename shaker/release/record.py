"""Records of releases: location, levels, spectral peaks, and poles of what rings."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np

from shaker.lines.spectrum import Spectrum
from shakercal._common.arrays import ComplexArray, FloatArray, check_shape
from shakercal._common.notices import Notice

# The record of one release.


@dataclass(frozen=True)
class StepRecord:
    """Outputs of a sensor while a load is suddenly applied or removed.

    Attributes
    ----------
    name : of the record, for messages
    channels : names of C outputs
    unit : of the outputs
    samples : (C, N) outputs
    sample_rate_hz : Hz, above 0
    component : load component that changes, Fx … Mz
    amplitude : signed change of the load, N or N·m, not 0
    u_amplitude : relative standard uncertainty of `amplitude`, default 0
    start_s : time of the first sample, s, default 0
    force : (N,) measured load, N or N·m, default None
    onset_s : stated start of the release, s, default None
    release : release device, such as "fishing line", default ""
    lag_s, u_lag_s : stated lag of the outputs' chain with standard uncertainty, s, default None: not stated
    delay_s : further delay of the chain at the ringing, as its stated response has, s, default None: not stated

    Examples
    --------
    >>> import numpy as np
    >>> from shaker import StepRecord
    >>> StepRecord("line 1", ("Fz",), "V", np.zeros((1, 4000)), 10e3, "Fz", -20.0)
    StepRecord(line 1: Fz changes by -20, 4000 samples at 10000 Hz of Fz [V])
    """

    name: str
    channels: tuple[str, ...]
    unit: str
    samples: FloatArray
    sample_rate_hz: float
    component: str
    amplitude: float
    u_amplitude: float = 0.0
    start_s: float = 0.0
    force: FloatArray | None = None
    onset_s: float | None = None
    release: str = ""
    lag_s: float | None = None
    u_lag_s: float = 0.0
    delay_s: float | None = None

    def __post_init__(self) -> None:
        check_shape("samples", self.samples, (len(self.channels), None))
        if self.force is not None:
            check_shape("force", self.force, self.samples.shape[1:])
        if not self.sample_rate_hz > 0:
            raise ValueError(f"sample_rate_hz: expected a positive number, found {self.sample_rate_hz}")
        if self.amplitude == 0 or not np.isfinite(self.amplitude):
            raise ValueError(f"amplitude: expected a number other than 0, found {self.amplitude}")
        if self.lag_s is not None and not (self.lag_s >= 0.0 and self.u_lag_s >= 0.0):
            raise ValueError(f"lag_s: expected 0 or more, found {self.lag_s}")

    def __repr__(self) -> str:
        channels = ", ".join(f"{name} [{self.unit}]" for name in self.channels)
        size = f"{self.samples.shape[1]} samples at {self.sample_rate_hz:g} Hz"
        return f"StepRecord({self.name}: {self.component} changes by {self.amplitude:g}, {size} of {channels})"

    @property
    def time_s(self) -> FloatArray:
        """Time of every sample (N,) in s."""
        return np.asarray(self.start_s + np.arange(self.samples.shape[1]) / self.sample_rate_hz)


# Reading of a record before a model is identified.

ReleaseShape = Literal["step", "ramp", "smooth", "exponential", "stages", "measured"]
"""Time course of a load: at once, linear, along half a cosine, like a lag, in two ramps, or as the force shows."""


@dataclass(frozen=True)
class SpectrumPeak:
    """A peak of the amplitude spectrum of the response.

    Frequency with standard uncertainty in Hz; amplitude over that of the highest peak (`share`) with its standard
    uncertainty.
    """

    frequency_hz: float
    u_frequency_hz: float
    share: float
    u_share: float


@dataclass(frozen=True)
class ReleaseReading:
    """Characteristics of one release, estimated from one output.

    Times in s of the record's clock, levels in `unit`. `onset_s`: start of the change of load, `release_s`: its
    duration, `shape`: its time course, with standard uncertainties `u_…`. `baseline`, `steady`: output before and long
    after the release; `sign` of their difference; `rise_s`: from 10 % to 90 % of it. `static_gain`: (steady -
    baseline)/amplitude, in output unit per N or N·m. `noise`: standard deviation of a sample. `clipped`: whether the
    output reached its limit. `peaks`: first and second of the spectrum. `record`, `release`: names of the record and
    the release device.
    """

    record: str
    channel: str
    component: str
    unit: str
    release: str
    onset_s: float
    u_onset_s: float
    sign: int
    baseline: float
    u_baseline: float
    steady: float
    u_steady: float
    rise_s: float
    u_rise_s: float
    shape: ReleaseShape
    release_s: float
    u_release_s: float
    static_gain: float
    u_static_gain: float
    noise: float
    clipped: bool
    peaks: tuple[SpectrumPeak, ...] = ()
    notices: tuple[Notice, ...] = ()


# Location of the release in a record, without a model.

_REST_SHARE = 0.005  # share of the record that is at rest in the first step of the search
_FINAL_SHARE = 0.2  # share of the samples after the release that give the new level
_MOTION_SIGMAS = 5.0  # significant deviation of a sample from the baseline, in standard deviations
_MIN_SUCCESSIVE = 3  # successive samples beyond a level
_ROUNDING = 1e-12  # relative change of a level that is rounding of its mean
_REST_GUARD_SHARE = 0.9  # share of the samples before the first motion that are certainly at rest


@dataclass(frozen=True)
class ApproximateOnset:
    """Approximate location of a release, and levels with the noise of the samples.

    `first_motion`: sample of the first motion above the noise. `index_10`, `index_90`: first passage of 10 % and 90 %
    of the change, in fractional samples.
    """

    first_motion: int
    index_10: float
    index_90: float
    baseline: float
    steady: float
    noise: float
    resolution: float

    @property
    def signal_to_noise(self) -> float:
        """Change of level over the noise of a sample, 0 for a constant output."""
        change = abs(self.steady - self.baseline)
        rounding = _ROUNDING * max(abs(self.baseline), abs(self.steady))
        return change / max(self.noise, 1e-300) if change > rounding else 0.0

    @property
    def max_ramp_samples(self) -> float:
        """Length in samples of the longest plausible ramp, which noise may lengthen."""
        seen = max(0.9 - max(0.1, _MOTION_SIGMAS / max(self.signal_to_noise, 1e-300)), 0.2)
        return max(self.index_90 - self.index_10, 2.0) * 0.8 / seen**2


def locate_change(samples: FloatArray, near: int | None = None) -> ApproximateOnset:
    """Return the location of the change of samples (N,); `near`: its stated sample.

    The first motion follows the last sample within five standard deviations of the baseline before the half-way point.
    """
    count = len(samples)
    if count < 64:
        raise ValueError(f"samples: expected at least 64 of a release, found {count}")
    if near is not None and not 8 <= near < count - 16:
        raise ValueError(f"near: expected a sample of 8 to {count - 17} that leaves rest and response, found {near}")
    rest = max(16, int(_REST_SHARE * count)) if near is None else int(_REST_GUARD_SHARE * near)
    baseline, steady = float(np.mean(samples[:rest])), float(np.mean(samples[-max(8, int(_FINAL_SHARE * count)) :]))
    noise, steps = 0.0, np.diff(np.unique(samples))
    resolution = float(steps.min()) if steps.size else 0.0
    for _ in range(3):
        before = samples[:rest]
        baseline = float(np.mean(before))
        noise = max(float(np.std(before)), resolution / np.sqrt(12.0))
        half = _passing(samples, baseline, steady, 0.5, rest)
        quiet = np.flatnonzero(np.abs(samples[: int(half) + 1] - baseline) <= _MOTION_SIGMAS * noise)
        first = int(quiet[-1]) + 1 if quiet.size else int(half)
        rest = max(16, int(_REST_GUARD_SHARE * first)) if first > 16 else rest
        steady = float(np.mean(samples[first + int((1.0 - _FINAL_SHARE) * (count - first)) :]))
    low, high = (_passing(samples, baseline, steady, share, max(first - 1, 0)) for share in (0.1, 0.9))
    return ApproximateOnset(first, low, high, baseline, steady, noise, resolution)


def _passing(samples: FloatArray, baseline: float, steady: float, share: float, start: int) -> float:
    """Return the first passage of a share by several samples after `start`, interpolated."""
    change = steady - baseline
    relative = (samples[start:] - baseline) / change if change else np.zeros(len(samples) - start)
    runs = np.convolve(relative >= share, np.ones(_MIN_SUCCESSIVE))[_MIN_SUCCESSIVE - 1 :]
    above = np.flatnonzero(runs[: len(relative)] >= _MIN_SUCCESSIVE)
    if not above.size:
        return float(len(samples) - 1)
    index = int(above[0])
    if index == 0:
        return float(start)
    return start + index - 1 + float((share - relative[index - 1]) / (relative[index] - relative[index - 1]))


# Levels before and after a release, and noise.


@dataclass(frozen=True)
class Level:
    """A level with standard uncertainty, noise of the samples about it, and drift.

    `drift`: over the samples; `drift_over_u`: over its standard uncertainty.
    """

    value: float
    u: float
    noise: float
    drift: float
    drift_over_u: float


def ringing_level(samples: FloatArray, poles: ComplexArray, resolution: float) -> Level:
    """Return the level of ringing samples (N,) by least squares.

    Decays of upper poles (M,) per sample are fitted together with the level. The uncertainty includes the correlation
    of the residual, the last digit, and slow noise.
    """
    count = len(samples)
    number = np.arange(count, dtype=np.float64)
    decays = np.exp(np.outer(number, poles))
    middle = (number - number.mean()) / count
    columns = np.concatenate([np.ones((count, 1)), decays.real, decays.imag], axis=1)
    value, u, residual = _fit_coefficient(columns, samples, 0)
    drift, u_drift, _ = _fit_coefficient(np.concatenate([columns, middle[:, None]], axis=1), samples, columns.shape[1])
    least = resolution / np.sqrt(12.0)
    noise = float(np.sqrt(residual @ residual / max(count - columns.shape[1], 1)))
    if not is_white(residual):
        gain = np.linalg.pinv(columns, rcond=1e-12)
        u = float(np.hypot(u, np.sqrt(np.sum(slow_noise(columns, residual, gain, noise**2)[0]))))
    digit = least if noise < least else 0.0  # without noise the last digit is the same in all samples
    return Level(value, float(np.hypot(u, digit)), max(noise, least), drift, drift / max(u_drift, digit, 1e-300))


def _fit_coefficient(columns: FloatArray, samples: FloatArray, column: int) -> tuple[float, float, FloatArray]:
    """Return one coefficient with standard uncertainty, and the residual (N,)."""
    size = np.maximum(np.linalg.norm(columns, axis=0), 1e-300)
    inverse = np.linalg.pinv((columns / size).T @ (columns / size), rcond=1e-12, hermitian=True)
    linear = inverse @ ((columns / size).T @ samples)
    residual = samples - (columns / size) @ linear
    variance = float(residual @ residual) / max(len(samples) - columns.shape[1], 1) * correlation_factor(residual)
    u = float(np.sqrt(variance * inverse[column, column]) / size[column])
    return float(linear[column] / size[column]), u, residual


TESTED_LAGS = 40  # lags of the test of a residual for correlation
_WHITE = 73.4  # 99.9 % quantile of the sum of N·r² over 40 lags for white noise: χ² of 40
_SLOW_COSINES = 20  # half periods per record of the fastest slow cosine


def is_white(residual: FloatArray) -> bool:
    """Return whether a residual (N,) passes as white noise; one of zeros does."""
    correlation = np.fft.irfft(np.abs(np.fft.rfft(residual, 2 * len(residual))) ** 2)[: TESTED_LAGS + 1]
    return not np.any(residual) or bool(len(residual) * np.sum((correlation[1:] / correlation[0]) ** 2) < _WHITE)


def slow_noise(
    columns: FloatArray, residual: FloatArray, gain: FloatArray, variance: float
) -> tuple[FloatArray, FloatArray]:
    """Return variances (S,) of slow cosines in the residual, and their fitted coefficients (K, S).

    Drift, hum and 1/f noise hardly show in a correlation over lags. Cosines of 1, 2, … half periods over the record are
    fitted to the residual (N,) one by one, orthogonal to the columns (N, K). Each has the variance that cosines up to
    an octave above it show beyond white noise of a `variance`, because the fit absorbs most of the slowest itself.
    `gain` (K, N): coefficients from samples.
    """
    count = len(residual)
    wave = np.cos(np.pi * np.arange(1, 2 * _SLOW_COSINES + 1) * (np.arange(count)[:, None] + 0.5) / count)
    taken = gain @ wave
    power = np.einsum("nk,nk->k", wave, wave - columns @ taken)
    shown = (wave.T @ residual) ** 2 / np.maximum(power, 1e-12 * count)
    sums = np.concatenate([np.zeros((2, 1)), np.cumsum([shown, power], axis=1)], axis=1)
    first = np.arange(_SLOW_COSINES)
    of_octave = sums[:, 2 * first + 2] - sums[:, first]
    excess = np.maximum(of_octave[0] - variance * (first + 2.0), 0.0) / of_octave[1]
    return np.asarray(excess), np.asarray(taken[:, :_SLOW_COSINES])


def correlation_factor(residual: FloatArray) -> float:
    """Return the factor by which correlation enlarges the variance of a mean.

    1 + 2Σρ over lags until the sum of two neighbouring ones is within its scatter (Geyer, Stat. Sci. 7, 1992).
    """
    count = len(residual)
    centred = residual - residual.mean()
    power = float(centred @ centred)
    total, lag = 0.0, 1
    while power > 0.0 and lag + 1 < count // 2:
        pair = float(centred[:-lag] @ centred[lag:] + centred[: -lag - 1] @ centred[lag + 1 :]) / power
        if pair < 2.0 * np.sqrt(2.0 / count):
            break
        total, lag = total + pair, lag + 2
    return max(1.0, 1.0 + 2.0 * total)


# Spectrum of a response with its first and second peak.

_MIN_PEAK_NOISE_RATIO = 5.0  # smallest height of a peak, in noise levels
_MIN_PADDING = 4  # length of the transform over that of the record, at least
_MIN_DIP_NOISE_RATIO = 7.0  # smallest dip between two peaks, in noise levels
_MIN_RELATIVE_PEAK = 1e-3  # of the highest peak; lower ones are side lobes of the window
_MAX_NEWTON_STEPS = 40  # for the maximum between bins


def response_spectrum(ringing: FloatArray, sample_rate_hz: float) -> Spectrum:
    """Return the one-sided amplitude spectrum of ringing samples (N,) about their level.

    The weight is half a Hann window, 1 at the start of the ringing and 0 at its end. A lasting sine has its amplitude.
    """
    window, count = _window(len(ringing)), _MIN_PADDING * len(ringing)
    even = 1 << max(0, count.bit_length() - 6)  # multiples of which have no large prime factors
    count = -(-count // even) * even
    amplitude = 2.0 * np.abs(np.fft.rfft(ringing * window, count)) / window.sum()
    frequency = np.fft.rfftfreq(count, 1.0 / sample_rate_hz)
    return Spectrum(np.asarray(frequency, dtype=np.float64), np.asarray(amplitude, dtype=np.float64))


def spectrum_peaks(ringing: FloatArray, sample_rate_hz: float, noise: float) -> tuple[SpectrumPeak, ...]:
    """Return up to two highest peaks, interpolated between bins, sorted by frequency.

    At a maximum of |X|², X(f) = Σ w·y·exp(-j2πft), white noise of standard deviation `noise` moves the frequency by -Σ
    n·c/(|X|²)'' with c = d(|X|²)'/dy, and the amplitude by Re(X* N)/|X|.
    """
    spectrum = response_spectrum(ringing, sample_rate_hz)
    window = _window(len(ringing))
    size, floor = spectrum.amplitude, 2.0 * noise * float(np.sqrt(np.sum(window**2))) / window.sum()
    inner = size[1:-1]
    tops = np.flatnonzero((inner > size[:-2]) & (inner >= size[2:])) + 1
    least = max(_MIN_PEAK_NOISE_RATIO * floor, _MIN_RELATIVE_PEAK * size.max())
    tops = tops[(tops >= 2 * _MIN_PADDING) & (size[tops] > least)]
    order: list[int] = []
    for top in tops[np.argsort(-size[tops], kind="stable")].tolist():
        # level below which the spectrum falls between two peaks
        dip = min(size[top] / 1.5, size[top] - _MIN_DIP_NOISE_RATIO * floor)
        separated = all(np.min(size[min(top, other) : max(top, other) + 1]) < dip for other in order)
        if separated and len(order) < 2:
            order.append(top)
    weighted, near = ringing * window, spectrum.frequency_hz[order].tolist()
    refined = np.array([_refine_peak(weighted, window, sample_rate_hz, hertz, noise) for hertz in near]).reshape(-1, 4)
    f, u_f, size, u_size = refined.T
    share = size / size[:1]
    u_share = np.hypot(u_size / size[:1], share * u_size[:1] / size[:1])
    u_share[:1] = 0.0
    peaks = [SpectrumPeak(*map(float, numbers)) for numbers in zip(f, u_f, share, u_share, strict=True)]
    return tuple(sorted(peaks, key=lambda peak: peak.frequency_hz))


def _refine_peak(
    weighted: FloatArray, window: FloatArray, sample_rate_hz: float, near_hz: float, noise: float
) -> tuple[float, float, float, float]:
    """Return frequency and amplitude of the maximum near a line, each with its uncertainty."""
    time_s = (np.arange(len(weighted)) - 0.5 * len(weighted)) / sample_rate_hz
    omega = 2 * np.pi * near_hz
    limit = np.pi * sample_rate_hz / (_MIN_PADDING * len(weighted))
    for _ in range(_MAX_NEWTON_STEPS):
        rotation = np.exp(-1j * omega * time_s)
        x0, x1, x2 = (np.sum(weighted * rotation * (-1j * time_s) ** k) for k in range(3))
        slope = 2.0 * float(np.real(np.conj(x0) * x1))
        curvature = 2.0 * float(np.abs(x1) ** 2 + np.real(np.conj(x0) * x2))
        move = float(np.clip(-slope / curvature, -limit, limit)) if curvature < 0 else float(np.sign(slope)) * limit
        omega += move
        if abs(move) < 1e-9 * omega:
            break
    by_sample = 2.0 * np.real(window * rotation * (np.conj(x0) * (-1j * time_s) + np.conj(x1)))
    by_size = np.real(np.conj(x0) * window * rotation) / abs(x0)
    scale = 2.0 / window.sum()
    u_omega = noise * float(np.linalg.norm(by_sample)) / abs(curvature)
    u_size = noise * float(np.linalg.norm(by_size)) * scale
    return omega / (2 * np.pi), u_omega / (2 * np.pi), float(abs(x0)) * scale, u_size


def _window(count: int) -> FloatArray:
    """Return half a Hann window (N,) that starts at 1."""
    return np.asarray(np.cos(0.5 * np.pi * np.arange(count) / count) ** 2)


# Start values of poles from what rings, by matrix pencils and spectral lines. Every window of L samples of Σ a·exp(p t)
# is in the span of the vectors exp(p n/f), n = 0 … L - 1, for any amplitudes a. The leading singular vectors of the
# windows span it; a shift by one sample multiplies it by exp(p/f) (Hua and Sarkar, IEEE Trans. ASSP 38 (1990) 814; Roy
# and Kailath, ESPRIT, 1989).

PER_PERIOD = 8  # samples per period of the fastest mode after decimation
_LONGEST = 240  # samples for a start, at most
UNCLEAR = 0.25  # relative standard uncertainty of a real pole or damping ratio above which it is doubtful


def shift_poles(space: FloatArray, step_s: float) -> ComplexArray:
    """Return the non-zero poles in rad/s of a space (L, P) under a shift."""
    turns = np.linalg.eigvals(np.linalg.lstsq(space[:-1], space[1:], rcond=None)[0]).astype(np.complex128)
    return np.asarray(np.log(turns[np.abs(turns) > 1e-6]) / step_s)


def matrix_pencil(values: FloatArray, step_s: float, order: int) -> ComplexArray:
    """Return poles (≤ order,) in rad/s of a sum of exponentials (N,)."""
    hankel = np.lib.stride_tricks.sliding_window_view(values, len(values) // 2)
    return shift_poles(np.linalg.svd(hankel, full_matrices=False)[2][:order].T, step_s)


def instrumental_variables(values: FloatArray, step_s: float, order: int) -> ComplexArray:
    """Return poles (≤ order,) in rad/s of an autoregression, older samples as instruments.

    White noise of the output biases the least squares of y(k) = Σ a_i y(k - i). Three times the order of older samples,
    with independent noise, make the equations.
    """
    more = 3 * order
    windows = np.lib.stride_tricks.sliding_window_view(values, more + order + 1)
    older, recent, last = windows[:, :more], windows[:, more:-1], windows[:, -1]
    terms = np.linalg.lstsq(older.T @ recent, older.T @ last, rcond=None)[0]
    turns = np.roots(np.concatenate([[1.0], -terms[::-1]])).astype(np.complex128)
    return np.asarray(np.log(turns[np.abs(turns) > 1e-6]) / step_s)


# One ringing output: all modes above its noise.

_LINE = 6.0  # smallest height of a spectral line, in noise levels
_SMALL = 3e-3  # share of the highest line below which others are ignored
_MODES = 3  # at most


def ringing_poles(samples: FloatArray, sample_rate_hz: float, noise: float) -> ComplexArray:
    """Return the upper poles (M,) in rad/s of a free decay, strongest first.

    The decay (N,) is about zero. Matrix pencil of block means; the number of modes is that of singular values above the
    noise.
    """
    highest_hz = _highest_line(samples, sample_rate_hz, noise)
    if highest_hz is None:
        return np.zeros(0, dtype=np.complex128)
    means, step_s = decimate(samples, 1.0 / sample_rate_hz, highest_hz)
    rough = noise / np.sqrt(step_s * sample_rate_hz)
    hankel = np.lib.stride_tricks.sliding_window_view(means, len(means) // 3 + 1)
    _, size, right = np.linalg.svd(hankel, full_matrices=False)
    # 1.5 times the largest singular value of a white Hankel matrix, about σ(√rows + √columns)
    threshold = 1.5 * rough * (np.sqrt(hankel.shape[0]) + np.sqrt(hankel.shape[1]))
    rank = int(np.clip(np.count_nonzero(size > max(threshold, 1e-9 * size[0])), 2, 2 * _MODES))
    poles = shift_poles(right[: rank + rank % 2].T, step_s)
    powers = np.exp(np.outer(np.arange(len(means)) * step_s, poles))
    weights = np.linalg.lstsq(powers, means.astype(np.complex128), rcond=None)[0]
    upper = (poles.imag > 0) & (np.abs(poles.imag) < 0.9 * np.pi / step_s)
    upper &= np.abs(poles.real) < 0.7 * np.abs(poles)
    return np.asarray(poles[upper][np.argsort(-np.abs(weights[upper]), kind="stable")])


def _highest_line(samples: FloatArray, sample_rate_hz: float, noise: float) -> float | None:
    """Return the highest frequency of a significant spectral line, None without one."""
    count = len(samples)
    window = _window(count)
    size = np.abs(np.fft.rfft(samples * window))
    floor = max(_LINE * noise * float(np.sqrt(np.sum(window**2))), _SMALL * float(size[2:].max(initial=0.0)))
    inner = size[2:-1]
    lines = np.flatnonzero((inner > size[1:-2]) & (inner >= size[3:]) & (inner > floor)) + 2
    return float(lines[-1] * sample_rate_hz / count) if lines.size else None


# One output, modes of the highest peaks.

_STRETCHES = 16  # parts of the spectrum with separate noise levels
_FLOOR = 25.0  # power of a peak over the median of the spectrum; noise alone exceeds it once in 10^7 lines


def peaks_hz(decay: FloatArray, step_s: float, count: int, local: bool = False) -> FloatArray:
    """Return at most `count` frequencies in Hz of the highest significant peaks.

    Of a decay (N,) without its final level, weighted towards its beginning. The noise is the median of the spectrum, or
    with `local` that of neighbouring lines, for noise that depends on frequency.
    """
    phase = 0.5 * np.pi * np.arange(len(decay)) / len(decay)
    level = float(np.average(decay, weights=np.sin(phase) ** 4 + 1e-300))
    power = np.abs(np.fft.rfft((decay - level) * np.cos(phase) ** 2, 2 * len(decay))) ** 2
    frequency = np.fft.rfftfreq(2 * len(decay), step_s)
    top = np.flatnonzero((power[1:-1] > power[:-2]) & (power[1:-1] >= power[2:])) + 1
    floor = np.median(power)
    if local:
        size = max(1, len(power) // _STRETCHES)
        stretches = power[: len(power) // size * size].reshape(-1, size)
        middle = (np.arange(len(stretches)) + 0.5) * size
        floor = np.interp(np.arange(len(power)), middle, np.median(stretches, axis=1))[top]
    lines = top[(power[top] > _FLOOR * floor) & (frequency[top] > 3.0 / (len(decay) * step_s))]
    selected: list[int] = []
    for line in lines[np.argsort(power[lines])[::-1]]:
        if all(abs(line - other) > 4 for other in selected):
            selected.append(int(line))
    return np.asarray(frequency[selected[:count]])


def decimate(decay: FloatArray, step_s: float, highest_hz: float) -> tuple[FloatArray, float]:
    """Return block means of a decay, eight per fastest period, and their distance."""
    length = max(1, int(1.0 / (step_s * PER_PERIOD * highest_hz)))
    size = min(len(decay) // length, _LONGEST)
    return decay[: size * length].reshape(size, length).mean(axis=1), length * step_s


def start_poles(offered: ComplexArray, modes: int, near_hz: FloatArray) -> ComplexArray:
    """Return `modes` upper poles: next to the spectral peaks, then lightly damped ones."""
    left = [complex(pole) for pole in offered if pole.imag > 0 and abs(pole.real) < 0.5 * abs(pole)]
    selected = []
    for omega in 2 * np.pi * near_hz[:modes]:
        nearest = min(left, key=lambda pole: abs(abs(pole) - omega), default=0j)
        fits = abs(abs(nearest) - omega) < 0.15 * omega
        selected.append(nearest if fits else complex(omega * (-0.02 + 1j)))
        left = [pole for pole in left if pole != selected[-1]]
    left.sort(key=lambda pole: -pole.real / abs(pole))
    selected += left[: modes - len(selected)]
    selected += [selected[-1] * 1.1 ** (k + 1) for k in range(modes - len(selected))]
    settled = [complex(-max(abs(pole.real), 1e-3 * abs(pole)), pole.imag) for pole in selected]
    return np.asarray(sorted(settled, key=abs), dtype=np.complex128)


# Many outputs of many records that share their poles.

_WINDOW = 128  # samples, at most
_SIGNIFICANT_DENSITY = 30.0  # density over its mean; noise alone reaches it once in exp(30) lines
_ABOVE_NOISE = 1.5  # significant eigenvalue over that of the noise
_MOST = 40  # dimensions of the space, at most
_QUICKEST = 0.4  # largest damping ratio of a mode


def highest_frequency(parts: Sequence[FloatArray], rate_hz: float) -> float:
    """Return the highest frequency in Hz of significant oscillation in records of unit noise."""
    highest = 0.0
    for part in parts:
        window = np.hanning(part.shape[1])
        lines = np.fft.rfft((part - part.mean(axis=1, keepdims=True)) * window, axis=1)
        density = np.abs(lines) ** 2 / np.sum(window**2)
        floor = np.maximum(1.0, np.median(density[:, density.shape[1] // 2 :], axis=1, keepdims=True) / np.log(2.0))
        clear = np.flatnonzero(np.any(density > _SIGNIFICANT_DENSITY * floor, axis=0))
        highest = max(highest, float(clear[-1] if clear.size else 1) * rate_hz / part.shape[1])
    return highest


def shared_poles(parts: Sequence[FloatArray], rate_hz: float) -> ComplexArray:
    """Return the common upper poles in rad/s of decaying records (C, N).

    The records have equal white noise. The eigenvectors of the summed products of windows with eigenvalues above the
    noise span the space of the poles.
    """
    length = min(_WINDOW, min(part.shape[1] for part in parts) // 2)
    gram, windows = np.zeros((length, length)), 0
    for part in parts:
        # G[i, j] sums y(n + i)·y(n + j) over the first samples n of windows. The next element of a diagonal contains
        # in addition the product after the last window, and not that before the first
        count = part.shape[1] - length + 1
        head, tail = part[:, : length - 1], part[:, count:]
        gram[1:, 1:] += tail.T @ tail - head.T @ head
        gram[0] += sum(row[:count] @ np.lib.stride_tricks.sliding_window_view(row, length) for row in part)
        windows += count * len(part)
    for index in range(1, length):
        gram[index, index:] += gram[index - 1, index - 1 : -1]
    gram = np.triu(gram) + np.triu(gram, 1).T
    value, vector = np.linalg.eigh(gram / windows)
    noise = float(np.median(value[: length // 2]))
    count = int(np.clip(np.count_nonzero(value > _ABOVE_NOISE * noise), 3, min(_MOST, length // 2)))
    poles = shift_poles(vector[:, -count:], 1.0 / rate_hz)
    ratio = -poles.real / np.abs(poles)
    oscillating = (poles.imag > 2e-3 * rate_hz) & (poles.imag < 0.9 * np.pi * rate_hz)
    return np.asarray(poles[oscillating & (ratio > 0.0) & (ratio < _QUICKEST)])
