"""What poles answer to a load that changes, with the derivatives that a fit needs."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from shaker._checks import BoolArray, ComplexArray, FloatArray
from shaker.models.step.reading import Shape
from shaker.models.step_fit.samples import Samples

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
