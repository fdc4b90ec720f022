"""Where the fit starts: poles of the free decay by a matrix pencil or by instrumental variables."""

from __future__ import annotations

import numpy as np

from shaker._checks import ComplexArray, FloatArray

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
