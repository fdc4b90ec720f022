"""Start values of poles from matrix pencils and spectral lines.

Every window of L samples of Σ a·exp(p t) is in the span of the vectors exp(p n/f), n = 0 … L - 1, for any amplitudes a.
The leading singular vectors of the windows span it. A shift by one sample multiplies it by exp(p/f) (Hua and Sarkar,
IEEE Trans. ASSP 38 (1990) 814; Roy and Kailath, ESPRIT, 1989).
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from shakercal._common.arrays import ComplexArray, FloatArray

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
    window = np.cos(0.5 * np.pi * np.arange(count) / count) ** 2
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
