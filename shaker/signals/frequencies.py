"""Which lines a recording contains: fundamentals refined, harmonics that stand out of the noise."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import permutations
from typing import Literal

import numpy as np

from shaker._checks import FloatArray, IntArray, check_shape
from shaker.notice import Notice
from shaker.signals.folding import (
    SamplingGrid,
    alias_frequency,
    folded_harmonics,
    sampling_grid,
    sine_columns,
)
from shaker.signals.refine import Refined, noise_around, refine_frequency
from shaker.signals.separation import usable_lines
from shaker.signals.sine import solve_sines
from shaker.signals.spectrum import amplitude_spectrum, noise_floor

__all__ = ["Lines", "Refined", "find_lines", "refine_frequency"]

MAX_MULTIPLE = 20  # harmonics looked for
FALSE_ALARM = 1e-3  # probability that noise alone adds any harmonic to the list
_CAPTURE = 5e-3  # relative: how far a fundamental may lie from its nominal frequency, besides two bins
_PROMINENT = 6.0  # noise floors that a fundamental must reach; exp(-36) by chance in one bin
_NYQUIST_SHARE = 0.98  # of the Nyquist frequency up to which harmonics are looked for
_SMALLEST = 1e-9  # of the fundamental: below it, rounding looks like harmonics
_ROUNDS = 6
_MAINS_HZ = (50.0, 60.0)
_MAINS_TOLERANCE = 2e-3
_STRANGER = 8.0  # noise floors above which a peak that is no line is worth a notice
_SKIRT = 4  # bins beside a line in which its own modulation stands
_NAMED = 4  # folded harmonics named in one notice
_STRANGERS = 3  # notices about unexplained peaks


@dataclass(frozen=True)
class Lines:
    """Lines of a recording in ascending frequency.

    `frequency_hz`, `u_frequency_hz` (K,) on the clock of the times given; `nominal_hz` (K,) the nominal fundamental
    each belongs to, `multiple` (K,) its harmonic number; `why` (K,) why it is in the list.
    """

    frequency_hz: FloatArray
    u_frequency_hz: FloatArray
    nominal_hz: FloatArray
    multiple: IntArray
    why: tuple[str, ...]
    notices: tuple[Notice, ...]

    def __post_init__(self) -> None:
        check_shape("frequency_hz", self.frequency_hz, (None,))
        lines = self.frequency_hz.shape
        check_shape("u_frequency_hz", self.u_frequency_hz, lines)
        check_shape("nominal_hz", self.nominal_hz, lines)
        check_shape("multiple", self.multiple, lines)
        if len(self.why) != lines[0]:
            raise ValueError(f"why: expected {lines[0]} texts, one per line, found {len(self.why)}")


def find_lines(
    time_s: FloatArray,
    values: FloatArray,
    nominal_hz: Sequence[float],
    harmonics: Literal["auto"] | Sequence[int] = "auto",
) -> Lines:
    """Find the lines of a recording in its fastest channels: `values` (S,) or (S, C) at uniform `time_s` (S,).

    Each nominal fundamental must stand out of the spectrum within 0.5 % and two bins and is refined by least squares;
    below the Nyquist rate it is looked for at its alias. "auto" adds the harmonics (up to the 20th, below 0.98 of the
    Nyquist frequency) whose power in the residual exceeds the local noise so much that noise alone would add any with
    probability 1e-3 only: F test with (2, ν) degrees of freedom, repeated with the lines found so far subtracted, so
    that no line's leakage passes for another. A list adds those multiples. Lines folding onto another are left out.
    """
    time, data = _complete(time_s, values)
    grid = sampling_grid(time)
    if grid is None:
        raise ValueError("time_s: expected ascending times on a uniform grid, found gaps that are no multiples of it")
    nominal = np.array(sorted(set(nominal_hz)), dtype=np.float64)
    usable, notices = usable_lines(time, nominal)
    if not np.any(usable):
        raise ValueError(f"nominal_hz: expected a line that the sampling can tell apart, but {notices[0].text}")
    notices += _unfiltered(nominal[usable], nominal, grid)
    nominal = nominal[usable]
    start = np.array([_peak_near(float(f), nominal, grid, data) for f in nominal])
    if harmonics == "auto":
        multiples: list[list[int]] = [[1] for _ in nominal]
        refined = _add_harmonics(time, data, start, multiples)
    else:
        multiples, above = _listed(nominal, harmonics, grid)
        notices += above
        refined = refine_frequency(time, data, start, multiples)
    return _as_lines(time, data, grid, nominal, multiples, refined, notices, harmonics == "auto")


def _complete(time_s: FloatArray, values: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return times and values (S, C) of the samples without NaN, channels that never change left out."""
    check_shape("time_s", time_s, (None,))
    data = values[:, None] if values.ndim == 1 else values
    check_shape("values", data, (len(time_s), None))
    present = np.isfinite(data).all(axis=1)
    moving = np.ptp(data[present], axis=0) > 0.0 if present.any() else np.zeros(data.shape[1], dtype=np.bool_)
    if not moving.any():
        raise ValueError(f"values: expected a channel that changes, found {data.shape[1]} without any change")
    return time_s[present], data[present][:, moving]


def _peak_near(nominal: float, all_nominal: FloatArray, grid: SamplingGrid, data: FloatArray) -> float:
    """Return the frequency of the peak nearest to a nominal frequency (at its alias), or raise `ValueError`."""
    filled = grid.filled(data - data.mean(axis=0))
    spectrum = amplitude_spectrum(filled, grid.rate_hz)
    resolution = grid.rate_hz / grid.length
    alias = float(alias_frequency(nominal, grid.rate_hz))
    others = alias_frequency(all_nominal[all_nominal != nominal], grid.rate_hz)
    room = float(np.min(np.abs(others - alias), initial=np.inf)) / 2.0
    capture = max(min(_CAPTURE * nominal + 2.0 * resolution, room), resolution)
    low, high = np.searchsorted(spectrum.frequency_hz, [alias - capture, alias + capture])
    low, high = max(int(low), 1), min(max(int(high), int(low) + 1), len(spectrum.frequency_hz) - 1)
    height = np.max(spectrum.amplitude / np.maximum(noise_floor(spectrum), np.finfo(np.float64).tiny), axis=1)
    if not np.max(height[low:high], initial=0.0) > _PROMINENT:
        raise ValueError(
            f"nominal_hz: expected {nominal:.6g} Hz to stand out of the spectrum, found no peak above "
            f"{_PROMINENT:g} times the noise within {capture:.3g} Hz"
        )
    top = low + int(np.argmax(height[low:high]))
    channel = int(np.argmax(spectrum.amplitude[top] / data.std(axis=0)))
    fraction = _hann_offset(spectrum.amplitude[top - 1 : top + 2, channel])
    folded = float(spectrum.frequency_hz[top]) + fraction * resolution
    downwards = nominal - grid.rate_hz * np.floor(nominal / grid.rate_hz) > grid.rate_hz / 2.0
    return nominal + (alias - folded if downwards else folded - alias)


def _unfiltered(nominal: FloatArray, all_nominal: FloatArray, grid: SamplingGrid) -> tuple[Notice, ...]:
    """Name for each fundamental above the Nyquist frequency the harmonics that nothing can have kept off its alias."""
    resolution = grid.rate_hz / grid.length
    notices = []
    for frequency in nominal[nominal > grid.rate_hz / 2.0].tolist():
        folds = folded_harmonics(frequency, all_nominal.tolist(), grid.rate_hz, resolution, MAX_MULTIPLE)
        if folds:
            names = [f"{fold.frequency_hz:.6g} Hz ({fold.multiple} × {fold.fundamental_hz:.6g} Hz)" for fold in folds]
            text = (
                f"{frequency:.6g} Hz, sampled at {grid.rate_hz:.6g} Hz, is read at {folds[0].alias_hz:.5g} Hz, where "
                f"these would be too and add to it: {', '.join(names[:_NAMED])}"
            )
            more = f" and {len(names) - _NAMED} higher ones" if len(names) > _NAMED else ""
            notices.append(Notice("warning", text + more, f"{frequency:.6g} Hz"))
    return tuple(notices)


def _hann_offset(three: FloatArray) -> float:
    """Return where a sine lies between the bins, from three Hann amplitudes around its peak: ±(2r - 1) / (r + 1)."""
    left, top, right = (float(a) for a in three)
    larger, sign = (right, 1.0) if right > left else (left, -1.0)
    ratio = larger / top
    return sign * float(np.clip((2.0 * ratio - 1.0) / (ratio + 1.0), 0.0, 0.5))


def _add_harmonics(time: FloatArray, data: FloatArray, start: FloatArray, multiples: list[list[int]]) -> Refined:
    """Extend `multiples` by the harmonics that stand out until none is left; return the fundamentals refined."""
    refined = refine_frequency(time, data, start, multiples)
    for _ in range(_ROUNDS):
        found = _standing_out(time, data, refined.frequency_hz, multiples)
        if not found:
            break
        for q, m in found:
            multiples[q].append(m)
            multiples[q].sort()
        refined = refine_frequency(time, data, refined.frequency_hz, multiples)
    return refined


def _line_list(fundamental: FloatArray, multiples: Sequence[Sequence[int]]) -> FloatArray:
    """Return all lines, fundamental by fundamental."""
    return np.array([m * f for f, orders in zip(fundamental, multiples, strict=True) for m in orders])


def _standing_out(
    time: FloatArray, data: FloatArray, fundamental: FloatArray, multiples: Sequence[Sequence[int]]
) -> list[tuple[int, int]]:
    """Return (fundamental, multiple) of the harmonics not yet listed whose power is significant in any channel."""
    lines = _line_list(fundamental, multiples)
    candidates = _candidates(fundamental, lines, time)
    if not candidates:
        return []
    solution = solve_sines(sine_columns(time, lines), data)
    wanted = np.array([m * fundamental[q] for q, m in candidates])
    noise = noise_around(time, solution.residual, lines, wanted)
    if noise is None:
        return []
    turns = np.exp(-2j * np.pi * np.mod(np.multiply.outer(wanted, time), 1.0))
    power = np.abs(turns @ solution.residual) ** 2 / len(time)
    strongest = np.sum(solution.coefficients[:-1] ** 2, axis=0)
    ratio = power / np.maximum(noise.variance, np.finfo(np.float64).tiny)
    chance = (1.0 + 2.0 * ratio / noise.dof[:, None]) ** (-noise.dof[:, None] / 2.0)
    clear = (chance < FALSE_ALARM / chance.size) & (power > _SMALLEST**2 * strongest)
    return [candidate for candidate, yes in zip(candidates, clear.any(axis=1), strict=True) if yes]


def _candidates(fundamental: FloatArray, lines: FloatArray, time: FloatArray) -> list[tuple[int, int]]:
    """Return the harmonics below the Nyquist frequency that are no line yet, each frequency once."""
    rate = (len(time) - 1) / float(time[-1] - time[0])
    apart = 1.5 / float(time[-1] - time[0])
    taken = list(lines)
    found = []
    for m in range(2, MAX_MULTIPLE + 1):
        for q, f in enumerate(fundamental):
            if m * f < _NYQUIST_SHARE * rate / 2.0 and np.min(np.abs(np.array(taken) - m * f)) > apart:
                taken.append(m * f)
                found.append((q, m))
    return found


def _listed(
    nominal: FloatArray, harmonics: Sequence[int], grid: SamplingGrid
) -> tuple[list[list[int]], tuple[Notice, ...]]:
    """Return the multiples asked for that lie below the Nyquist frequency, and notices about the others."""
    wrong = [m for m in harmonics if m < 1]
    if wrong:
        raise ValueError(f"harmonics: expected multiples of 1 and above, found {wrong[0]}")
    orders = sorted({1, *harmonics})
    limit = _NYQUIST_SHARE * grid.rate_hz / 2.0
    taken: list[float] = []
    multiples: list[list[int]] = [[] for _ in nominal]
    notices = []
    for m in orders:
        for q, f in enumerate(nominal):
            if m > 1 and m * f >= limit:
                text = f"harmonic {m} of {f:.6g} Hz lies above {limit:.6g} Hz, out of reach of the fastest channel"
                notices.append(Notice("warning", text, f"{m * f:.6g} Hz"))
            elif not any(abs(m * f - other) <= 1.5 * grid.rate_hz / grid.length for other in taken):
                multiples[q].append(m)
                taken.append(m * f)
    return multiples, tuple(notices)


def _as_lines(
    time: FloatArray,
    data: FloatArray,
    grid: SamplingGrid,
    nominal: FloatArray,
    multiples: Sequence[Sequence[int]],
    refined: Refined,
    notices: tuple[Notice, ...],
    auto: bool,
) -> Lines:
    """Assemble the result in ascending frequency, with reasons and remarks."""
    lines = _line_list(refined.frequency_hz, multiples)
    solution = solve_sines(sine_columns(time, lines), data)
    amplitude = np.hypot(solution.coefficients[0:-1:2], solution.coefficients[1:-1:2])
    noise = noise_around(time, solution.residual, lines, lines)
    level = np.sqrt(noise.variance) if noise is not None else np.tile(solution.residual.std(axis=0), (len(lines), 1))
    height = np.max(amplitude / np.maximum(level, np.finfo(np.float64).tiny), axis=1)
    place = [(q, m) for q, orders in enumerate(multiples) for m in orders]
    first = {q: k for k, (q, m) in enumerate(place) if m == 1}
    why = []
    for k, (q, m) in enumerate(place):
        share = float(np.max(amplitude[k] / amplitude[first[q]]))
        reason = "stands out" if auto else "asked for"
        why.append(
            f"fundamental, {height[k]:.3g} times its noise"
            if m == 1
            else f"harmonic {m} of {nominal[q]:.6g} Hz {reason}: {share:.2g} of the fundamental, "
            f"{height[k]:.3g} times its noise"
        )
    order = np.argsort(lines)
    index = np.array([q for q, _ in place])
    order_of = np.array([m for _, m in place])
    return Lines(
        frequency_hz=lines[order],
        u_frequency_hz=(order_of * refined.u_frequency_hz[index])[order],
        nominal_hz=nominal[index][order],
        multiple=order_of[order],
        why=tuple(why[i] for i in order),
        notices=notices + _strangers(solution.residual, grid, lines, refined.frequency_hz, float(amplitude.max())),
    )


def _strangers(
    residual: FloatArray, grid: SamplingGrid, lines: FloatArray, fundamental: FloatArray, largest: float
) -> tuple[Notice, ...]:
    """Tell about the largest peaks of the residual that are no lines: mains, sub-harmonics, others."""
    filled = grid.filled(residual)
    spectrum = amplitude_spectrum(filled, grid.rate_hz)
    height = np.max(spectrum.amplitude / np.maximum(noise_floor(spectrum), _SMALLEST * largest), axis=1)
    resolution = grid.rate_hz / grid.length
    for f in [0.0, grid.rate_hz / 2.0, *alias_frequency(lines, grid.rate_hz)]:
        centre = round(float(f) / resolution)
        height[max(0, centre - _SKIRT) : centre + _SKIRT + 1] = 0.0
    notices = []
    for _ in range(_STRANGERS):
        top = int(np.argmax(height))
        if height[top] <= _STRANGER:
            break
        frequency = float(spectrum.frequency_hz[top])
        text = f"{_origin(frequency, grid, fundamental)} at {frequency:.5g} Hz, {height[top]:.3g} times the noise"
        notices.append(Notice("info", text + ", is in no line", f"{frequency:.5g} Hz"))
        height[max(0, top - _SKIRT) : top + _SKIRT + 1] = 0.0
    return tuple(notices)


def _origin(frequency: float, grid: SamplingGrid, fundamental: FloatArray) -> str:
    """Name what a peak most likely is: a harmonic or combination (folded, maybe), mains hum, a sub-harmonic."""
    resolution = grid.rate_hz / grid.length

    def fits(wanted: float) -> bool:
        return abs(float(alias_frequency(wanted, grid.rate_hz)) - frequency) <= resolution

    for m in range(2, MAX_MULTIPLE + 1):
        for f in fundamental:
            if fits(m * f):
                return f"harmonic {m} of {f:.6g} Hz"
    for f, g in permutations(np.sort(fundamental)[::-1], 2):
        for m, n in ((1, 1), (1, -1), (2, 1), (2, -1)):
            if fits(m * f + n * g):
                return f"the combination {'2·' if m == 2 else ''}{f:.6g} {'+' if n > 0 else '-'} {g:.6g} Hz"
    for mains in _MAINS_HZ:
        multiple = max(1, round(frequency / mains))
        if abs(frequency - multiple * mains) <= max(resolution, _MAINS_TOLERANCE * frequency) and multiple <= 7:
            return f"mains hum ({mains:g} Hz)" if multiple == 1 else f"mains hum (harmonic {multiple} of {mains:g} Hz)"
    for f in fundamental:
        for part in (2, 3):
            if fits(f / part):
                return f"a sub-harmonic of {f:.6g} Hz"
    return "an unexplained peak"
