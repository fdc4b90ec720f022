"""What the fit of a release is made of: samples, structure, start, the response to the load."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from shaker.arrays import BoolArray, ComplexArray, FloatArray, IntArray, check_shape
from shaker.release.record import Shape

# How many poles and zeros a model has, and what its parameters make of them.


@dataclass(frozen=True)
class Structure:
    """Poles of `modes` oscillating modes and `reals` real ones, and `terms` of the numerator, 1 … 2M + Q.

    H(s) = Σ_k z_k (s/ω0)^k·Π ω0/(s - p), k below `terms`: 2M + Q terms are residues without a condition, fewer make
    the response start smoother: its first 2M + Q - terms derivatives are continuous at a step.
    A vector is [ln ω (M), ζ (M), ln a (Q)], poles ω(-ζ ± j√(1 - ζ²)) and -a in rad/s. `scale` ω0 in rad/s, fixed.
    """

    modes: int
    reals: int
    terms: int
    scale: float

    @property
    def order(self) -> int:
        """Number of poles."""
        return 2 * self.modes + self.reals

    @property
    def smoothest(self) -> int:
        """Number of numerator terms of a chain of masses whose displacement is read, behind low-pass filters: 2M - 1.

        The displacement of a mass answers a force like 1/s² at first, and every low-pass filter adds 1/s.
        """
        return max(1, 2 * self.modes - 1)

    def with_terms(self, terms: int) -> Structure:
        """Return the same poles with another number of numerator terms."""
        return replace(self, terms=terms)

    def poles(self, vector: FloatArray) -> ComplexArray:
        """Return the upper poles of the modes and the real ones (M + Q,) in rad/s."""
        m = self.modes
        log_omega, zeta, log_real = vector[:m], vector[m : 2 * m], vector[2 * m : self.order]
        upper = np.exp(log_omega) * (-zeta + 1j * np.sqrt(1.0 - zeta**2))
        return np.concatenate([upper, -np.exp(log_real) + 0j])

    def vector(self, poles: ComplexArray) -> FloatArray:
        """Return the parameters (2M + Q,) of poles (M + Q,), upper ones first."""
        upper, real = poles[: self.modes], poles[self.modes :].real
        return np.concatenate([np.log(np.abs(upper)), -upper.real / np.abs(upper), np.log(np.abs(real))])

    def pole_slopes(self, vector: FloatArray) -> ComplexArray:
        """Return derivatives (M + Q, 2M + Q) of the poles to the parameters."""
        poles, zeta = self.poles(vector), vector[self.modes : 2 * self.modes]
        slopes = np.zeros((len(poles), self.order), dtype=np.complex128)
        mode, real = np.arange(self.modes), np.arange(self.modes, len(poles))
        slopes[mode, mode] = poles[: self.modes]
        slopes[mode, mode + self.modes] = np.abs(poles[: self.modes]) * (-1.0 - 1j * zeta / np.sqrt(1.0 - zeta**2))
        slopes[real, real + self.modes] = poles[self.modes :]
        return slopes

    def shares(self, vector: FloatArray) -> tuple[ComplexArray, ComplexArray]:
        """Return residues (M + Q, terms) of every numerator term, and their derivatives (M + Q, terms, 2M + Q).

        Residue of term k at p_i: ω0^n (p_i/ω0)^k/Π_{j≠i}(p_i - p_j) over all n poles.
        """
        poles, slopes = self.poles(vector), self.pole_slopes(vector)
        every = np.concatenate([poles, poles[: self.modes].conj()])
        moves = np.concatenate([slopes, slopes[: self.modes].conj()])
        size = len(poles)
        gaps = poles[:, None] - every
        gaps[np.arange(size), np.arange(size)] = self.scale
        power = np.arange(self.terms)
        values = self.scale * np.prod(self.scale / gaps, axis=1)[:, None] * (poles[:, None] / self.scale) ** power
        spread = slopes[:, None, :] - moves[None, :, :]
        rate = power[:, None] * (slopes / poles[:, None])[:, None, :] - (spread / gaps[:, :, None]).sum(axis=1)[:, None]
        return values, values[:, :, None] * rate


# Which samples of a record are fitted: all of them about the release, means of blocks elsewhere.


BLOCKS_PER_PERIOD = 12  # blocks in a period of the fastest mode: its mean over one loses 1 % of it, sinc(1/12)
_RESTS = 40  # blocks of what comes before the release


@dataclass(frozen=True)
class Samples:
    """Means of neighbouring samples: block b is the mean `value` (B,) of `length` (B,) samples.

    They are `step_s` apart and the first of them is taken at `time_s` (B,). Noise of white samples stays white, with
    1/√length of its standard deviation, and what a pole answers stays an exponential, so nothing is filtered away
    and no filter has to be modelled.
    """

    time_s: FloatArray
    length: IntArray
    value: FloatArray
    step_s: float

    def __post_init__(self) -> None:
        check_shape("time_s", self.time_s, (None,))
        check_shape("length", self.length, self.time_s.shape)
        check_shape("value", self.value, self.time_s.shape)

    @cached_property
    def lengths(self) -> tuple[IntArray, IntArray]:
        """Lengths (L,) that occur, and which of them every block has (B,)."""
        sizes, place = np.unique(self.length, return_inverse=True)
        return sizes, place

    @cached_property
    def weight(self) -> FloatArray:
        """Reciprocal standard deviation (B,) of a mean over that of a sample: √length."""
        return np.sqrt(self.length.astype(np.float64))

    def between(self, from_s: float, to_s: float) -> Samples:
        """Return the blocks that begin in a stretch of time."""
        kept = (self.time_s >= from_s) & (self.time_s <= to_s)
        return Samples(self.time_s[kept], self.length[kept], self.value[kept], self.step_s)


def every_sample(value: FloatArray, time_s: FloatArray, step_s: float) -> Samples:
    """Return samples (N,) at times (N,) as blocks of one."""
    return Samples(time_s, np.ones(len(time_s), dtype=np.int64), value, step_s)


def in_blocks(whole: Samples, fine_from_s: float, fine_to_s: float, length: int) -> Samples:
    """Return samples one by one between two times, as means of `length` after them, as means of many before them."""
    first, last = np.searchsorted(whole.time_s, [fine_from_s, fine_to_s])
    ahead = _edges(0, int(first), max(1, int(first) // _RESTS))
    after = _edges(int(last), len(whole.value), length)
    edges = np.concatenate([ahead, np.arange(first, last), after, [len(whole.value)]]).astype(np.int64)
    lengths = np.diff(edges)
    means = np.add.reduceat(whole.value, edges[:-1]) / lengths
    return Samples(whole.time_s[edges[:-1]], lengths, means, whole.step_s)


def _edges(start: int, stop: int, length: int) -> IntArray:
    """Return where blocks of a length begin; what is left over is the first one."""
    if stop <= start:
        return np.zeros(0, dtype=np.int64)
    places = np.arange(stop - length, start, -length, dtype=np.int64)[::-1]
    return np.concatenate([np.array([start], dtype=np.int64), places[places > start]])


def block_length(sample_rate_hz: float, highest_hz: float) -> int:
    """Return how many samples a block after the release takes, twelve blocks in the period of the fastest mode."""
    return max(1, int(sample_rate_hz / (BLOCKS_PER_PERIOD * highest_hz)))


# Where the fit starts: poles of the free decay by a matrix pencil or by instrumental variables.


PER_PERIOD = 8  # samples that are left of the period of the fastest mode
_LONGEST = 240  # decimated samples that a start is taken from
_STRETCHES = 16  # stretches of the spectrum that tell their own noise
_FLOOR = 25.0  # power of a peak over the median of the spectrum, that noise alone passes once in 10^7 lines


def peaks_hz(decay: FloatArray, step_s: float, count: int, local: bool = False) -> FloatArray:
    """Return frequencies (≤ count,) in Hz of the highest peaks, above the noise, in the spectrum of a decay (N,).

    The level of its end is taken off, and a window that falls from 1 to 0 keeps the strong beginning. The noise is the
    median of the spectrum, or where `local` of the lines about, for noise that is not the same everywhere.
    """
    phase = 0.5 * np.pi * np.arange(len(decay)) / len(decay)
    level = float(np.average(decay, weights=np.sin(phase) ** 4 + 1e-300))
    power = np.abs(np.fft.rfft((decay - level) * np.cos(phase) ** 2, 2 * len(decay))) ** 2
    frequency = np.fft.rfftfreq(2 * len(decay), step_s)
    top = np.flatnonzero((power[1:-1] > power[:-2]) & (power[1:-1] >= power[2:])) + 1
    floor = _about(power)[top] if local else np.median(power)
    lines = top[(power[top] > _FLOOR * floor) & (frequency[top] > 3.0 / (len(decay) * step_s))]
    found: list[int] = []
    for line in lines[np.argsort(power[lines])[::-1]]:
        if all(abs(line - other) > 4 for other in found):
            found.append(int(line))
    return np.asarray(frequency[found[:count]])


def _about(power: FloatArray) -> FloatArray:
    """Return the median of the lines about every line, by stretches and straight lines between them."""
    size = max(1, len(power) // _STRETCHES)
    stretches = power[: len(power) // size * size].reshape(-1, size)
    middle = (np.arange(len(stretches)) + 0.5) * size
    return np.asarray(np.interp(np.arange(len(power)), middle, np.median(stretches, axis=1)))


def thinned(decay: FloatArray, step_s: float, highest_hz: float) -> tuple[FloatArray, float]:
    """Return means of blocks of a decay and their distance in s: eight in the period of the fastest mode."""
    length = max(1, int(1.0 / (step_s * PER_PERIOD * highest_hz)))
    size = min(len(decay) // length, _LONGEST)
    return decay[: size * length].reshape(size, length).mean(axis=1), length * step_s


def pencil(values: FloatArray, step_s: float, order: int) -> ComplexArray:
    """Return poles (order,) in rad/s of a sum of exponentials, by the matrix pencil (Hua and Sarkar, 1990).

    The shift between both halves of the Hankel matrix's leading right singular vectors has the samples' poles as
    eigenvalues.
    """
    width = len(values) // 2
    hankel = np.lib.stride_tricks.sliding_window_view(values, width)
    leading = np.linalg.svd(hankel, full_matrices=False)[2][:order].T
    shift = np.linalg.lstsq(leading[:-1], leading[1:], rcond=None)[0]
    return _continuous(np.linalg.eigvals(shift).astype(np.complex128), step_s)


def instruments(values: FloatArray, step_s: float, order: int) -> ComplexArray:
    """Return poles (order,) in rad/s of an autoregression, older samples as instruments.

    White noise of the output biases y(k) = Σ a_i y(k - i) fitted by least squares; samples older than all of these
    share no noise with them, and as many older ones as three times the order make the equations.
    """
    more = 3 * order
    windows = np.lib.stride_tricks.sliding_window_view(values, more + order + 1)
    older, recent, last = windows[:, :more], windows[:, more:-1], windows[:, -1]
    found = np.linalg.lstsq(older.T @ recent, older.T @ last, rcond=None)[0]
    return _continuous(np.roots(np.concatenate([[1.0], -found[::-1]])).astype(np.complex128), step_s)


def upper_poles(found: ComplexArray, modes: int, near_hz: FloatArray) -> ComplexArray:
    """Return as many upper poles (M,) as asked: those next to the peaks of the spectrum, then lightly damped ones.

    A peak without a pole within 15 % of it starts at ζ = 0.02.
    """
    left = [complex(pole) for pole in found if pole.imag > 0 and abs(pole.real) < 0.5 * abs(pole)]
    kept = []
    for omega in 2 * np.pi * near_hz[:modes]:
        nearest = min(left, key=lambda pole: abs(abs(pole) - omega), default=0j)
        fits = abs(abs(nearest) - omega) < 0.15 * omega
        kept.append(nearest if fits else complex(omega * (-0.02 + 1j)))
        left = [pole for pole in left if pole != kept[-1]]
    left.sort(key=lambda pole: -pole.real / abs(pole))
    kept += left[: modes - len(kept)]
    kept += [kept[-1] * 1.1 ** (k + 1) for k in range(modes - len(kept))]
    settled = [complex(-max(abs(pole.real), 1e-3 * abs(pole)), pole.imag) for pole in kept]
    return np.asarray(sorted(settled, key=abs), dtype=np.complex128)


def _continuous(z: ComplexArray, step_s: float) -> ComplexArray:
    """Return poles in rad/s of poles of samples, those at zero left out."""
    return np.asarray(np.log(z[np.abs(z) > 1e-6]) / step_s)


# What poles answer to a load that changes, with the derivatives that a fit needs.


_SMALL = 1e-2  # |pT| below which the spread of a release is taken from its series


@dataclass(frozen=True)
class Load:
    """How a load goes: by `amplitude` in a `shape`, or as the samples `force` (N,) from `start_s`, for "measured".

    The response of 1/(s - p) to it is that of the amplitude times clip(τ/T, 0, 1) for "ramp", to (1 - cos(πτ/T))/2
    for "smooth", τ = t - onset; to the force, linear between its samples and less its level of rest, for "measured".
    """

    shape: Shape
    amplitude: float
    force: FloatArray | None = None
    start_s: float = 0.0

    @property
    def timed(self) -> bool:
        """Whether the onset is unknown."""
        return self.shape != "measured"

    @property
    def lasting(self) -> bool:
        """Whether the release takes a time that is unknown."""
        return self.shape in ("ramp", "smooth")


@dataclass(frozen=True)
class Answers:
    """Responses (B, P) of 1/(s - p) in blocks, and their derivatives: to the poles, the onset, the release's length.

    The last moves the onset too, by half as much to the other side: the middle of the release stays.
    """

    value: ComplexArray
    by_pole: ComplexArray
    by_onset: ComplexArray
    by_length: ComplexArray


def answers(load: Load, poles: ComplexArray, samples: Samples, middle_s: float, length_s: float) -> Answers:
    """Return what poles (P,) in rad/s answer to a load whose release of `length_s` has its middle at `middle_s`."""
    if load.shape == "measured":
        return _to_force(load, poles, samples)
    length = length_s if load.lasting else 0.0
    tau = samples.time_s - (middle_s - 0.5 * length)
    found = Answers(*(np.zeros((len(tau), len(poles)), dtype=np.complex128) for _ in range(4)))
    after = (tau > 0) & (tau >= length)
    _fill_after(found, after, load, poles, tau, samples, length)
    during = (tau > 0) & ~after
    if np.any(during):
        _fill_during(found, during, load, poles, tau, length)
    return Answers(*(load.amplitude * part for part in (found.value, found.by_pole, found.by_onset, found.by_length)))


def responses(load: Load, poles: ComplexArray, samples: Samples, middle_s: float, length_s: float) -> ComplexArray:
    """Return the responses (B, P) of `answers` alone, for half the work."""
    length = length_s if load.lasting else 0.0
    tau = samples.time_s - (middle_s - 0.5 * length)
    if load.shape == "measured" or np.any((tau > 0) & (tau < length)):
        return answers(load, poles, samples, middle_s, length_s).value
    spread = release_factor(load, poles * length)[0] if length > 0 else 1.0
    mean = _block_factors(poles * samples.step_s, samples)[0][samples.lengths[1]]
    value = (mean * spread * np.exp(poles * np.maximum(tau, 0.0)[:, None]) - 1.0) * (load.amplitude / poles)
    return np.asarray(np.where(tau[:, None] > 0, value, 0.0))


def _fill_after(
    found: Answers,
    rows: BoolArray,
    load: Load,
    poles: ComplexArray,
    tau: FloatArray,
    samples: Samples,
    length: float,
) -> None:
    """Write what follows the release: (g·S·exp(pτ) - 1)/p, g of the block's mean and S of the release's length."""
    late = tau[rows][:, None]
    ones = np.ones_like(poles)
    spread, slope = release_factor(load, poles * length) if length > 0 else (ones, -0.5 * ones)
    mean, mean_slope = (part[samples.lengths[1][rows]] for part in _block_factors(poles * samples.step_s, samples))
    swing = np.exp(poles * late)
    value = mean * spread * swing
    found.value[rows] = (value - 1.0) / poles
    change = mean_slope * samples.step_s * spread + mean * (late * spread + length * slope)
    found.by_pole[rows] = (change * swing - found.value[rows]) / poles
    found.by_onset[rows] = -value
    found.by_length[rows] = mean * (slope + 0.5 * spread) * swing


def _fill_during(
    found: Answers, rows: BoolArray, load: Load, poles: ComplexArray, tau: FloatArray, length: float
) -> None:
    """Write what the release itself brings; the derivative to its length follows from those to time and to the pole."""
    early = tau[rows][:, None]
    share, value, by_pole = _ramp(poles, early, length) if load.shape == "ramp" else _cosine(poles, early, length)
    by_onset = -(poles * value + share)
    found.value[rows], found.by_pole[rows], found.by_onset[rows] = value, by_pole, by_onset
    found.by_length[rows] = (value + early * by_onset + poles * by_pole) / length - 0.5 * by_onset


def _ramp(p: ComplexArray, tau: FloatArray, length: float) -> tuple[FloatArray, ComplexArray, ComplexArray]:
    """Return a ramp's load, response and derivative to the pole."""
    rise = np.expm1(p * tau) / p
    value = (rise - tau) / (p * length)
    slope = (tau * np.exp(p * tau) - rise) / p
    return tau / length, value, slope / (p * length) - value / p


def _cosine(p: ComplexArray, tau: FloatArray, length: float) -> tuple[FloatArray, ComplexArray, ComplexArray]:
    """Return the load of half a cosine, its response and the derivative to the pole."""
    omega = np.pi / length
    swing, cosine, sine = np.exp(p * tau), np.cos(omega * tau), np.sin(omega * tau)
    below, top = p**2 + omega**2, p * (swing - cosine) + omega * sine
    value = 0.5 * ((swing - 1.0) / p - top / below)
    slope = tau * swing / p - (swing - 1.0) / p**2 - (swing - cosine + p * tau * swing) / below + 2 * p * top / below**2
    return 0.5 * (1.0 - cosine), value, 0.5 * slope


def release_factor(load: Load, x: ComplexArray) -> tuple[ComplexArray, ComplexArray]:
    """Return ∫ du/dt·exp(-pt) dt over the release, x = pT, and its derivative to x; 1 and 0 for a step.

    A ramp's is (1 - exp(-x))/x, half a cosine's ½π²(1 + exp(-x))/(x² + π²).
    """
    if load.shape == "smooth":
        below, fall = x**2 + np.pi**2, np.exp(-x)
        value = 0.5 * np.pi**2 * (1.0 + fall) / below
        return value, -0.5 * np.pi**2 * fall / below - 2.0 * x * value / below
    small = np.abs(x) < _SMALL
    safe = np.where(small, 1.0, x)
    value = np.where(small, 1 - x / 2 + x**2 / 6 - x**3 / 24 + x**4 / 120, -np.expm1(-safe) / safe)
    series = -0.5 + x / 3 - x**2 / 8 + x**3 / 30 - x**4 / 144
    return value, np.where(small, series, (np.exp(-safe) - value) / safe)


def _block_factors(x: ComplexArray, samples: Samples) -> tuple[ComplexArray, ComplexArray]:
    """Return means (L, P) of exp(kx), k = 0 … length - 1, for x = p·step and all lengths, and derivatives to x."""
    sizes = samples.lengths[0]
    values, slopes = np.ones((len(sizes), len(x)), complex), np.zeros((len(sizes), len(x)), complex)
    for place in np.flatnonzero(sizes > 1):
        k = np.arange(int(sizes[place]))[:, None]
        powers = np.exp(k * x)
        values[place], slopes[place] = powers.mean(axis=0), (k * powers).mean(axis=0)
    return values, slopes


def _to_force(load: Load, poles: ComplexArray, samples: Samples) -> Answers:
    """Return what poles answer to a measured force, exact where it is linear between samples."""
    from scipy.signal import lfilter

    assert load.force is not None
    force, step = load.force, samples.step_s
    first = np.round((samples.time_s - load.start_s) / step).astype(int)
    value, slope = np.zeros((2, len(force), len(poles)), dtype=np.complex128)
    for place, p in enumerate(poles):
        fall, now, next_ = _hold(p, step)
        value[:, place] = lfilter([next_[0], now[0]], [1.0, -fall], force)
        moved = lfilter([0.0, step * fall], [1.0, -fall], value[:, place])
        slope[:, place] = moved + lfilter([next_[1], now[1]], [1.0, -fall], force)
    start = -force[0] * np.array([_hold(p, step)[2] for p in poles])
    decay = np.exp(np.arange(len(force))[:, None] * step * poles)
    value += start[:, 0] * decay
    slope += (start[:, 1] + start[:, 0] * np.arange(len(force))[:, None] * step) * decay
    blank = np.zeros((len(first), len(poles)), dtype=np.complex128)
    return Answers(_means(value, first, samples), _means(slope, first, samples), blank, blank)


def _hold(p: complex, step: float) -> tuple[complex, FloatArray, FloatArray]:
    """Return exp(pΔ) and the weights, with derivatives to p, of a sample and of the next for a straight line."""
    x = p * step
    if abs(x) < _SMALL:
        now = 0.5 + x / 3 + x**2 / 8 + x**3 / 30 + x**4 / 144
        next_ = 0.5 + x / 6 + x**2 / 24 + x**3 / 120 + x**4 / 720
        slopes = 1 / 3 + x / 4 + x**2 / 10 + x**3 / 36, 1 / 6 + x / 12 + x**2 / 40 + x**3 / 180
        return np.exp(x), step * np.array([now, slopes[0] * step]), step * np.array([next_, slopes[1] * step])
    fall = np.exp(x)
    now = (fall * (x - 1) + 1) / x**2
    next_ = (fall - 1 - x) / x**2
    slopes = fall / x - 2 * now / x, (fall - 1) / x**2 - 2 * next_ / x
    return fall, step * np.array([now, slopes[0] * step]), step * np.array([next_, slopes[1] * step])


def _means(values: ComplexArray, first: np.ndarray, samples: Samples) -> ComplexArray:
    """Return the means of blocks (B, P) of samples (N, P), blocks without gaps."""
    if np.all(samples.length == 1):
        return np.asarray(values[first])
    total = np.concatenate([np.zeros((1, values.shape[1]), complex), np.cumsum(values, axis=0)])
    return np.asarray((total[first + samples.length] - total[first]) / samples.length[:, None])
