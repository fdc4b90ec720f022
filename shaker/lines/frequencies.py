"""Lines of a recording: refined fundamentals, significant harmonics, and other lines."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Literal

import numpy as np

from shaker.io.channel import Stacked
from shaker.lines.detection import (
    FALSE_ALARM,
    DetectedLines,
    Survey,
    detect_lines,
    empty_survey,
    expected_frequencies,
    name_lines,
    relative_strength,
)
from shaker.lines.peaks import FloorSpectrum, excess_power
from shaker.signal_notices import HARMONIC_OUT_OF_REACH, HARMONICS_ON_ALIAS, OTHER_LINES
from shaker.sine.aliasing import (
    CAPTURE,
    SamplingGrid,
    alias_frequency,
    find_aliased_harmonics,
    frequency_of_alias,
    nearest_grid,
    sampling_grid,
    usable_lines,
)
from shaker.sine.sine_fit import fit_sines, rows_present
from shaker.sine.solve import SineFit, SineModel
from shakercal._common.arrays import Arrays, BoolArray, FloatArray, IntArray, check_shape
from shakercal._common.digits import number_text
from shakercal._common.notices import Notice

MAX_MULTIPLE = 20  # harmonics searched for
_PROMINENT = 36.0  # times the noise power that a fundamental must reach; exp(-36) by chance in one bin
_NYQUIST_SHARE = 0.98  # of the Nyquist frequency up to which harmonics are searched for
_SMALLEST = 1e-9  # of the strongest line: below it, rounding looks like lines
_ROUNDS = 4  # of fitting and searching the residual, where gaps let lines leak
_FINER = 8  # grid points per interval for the search, where samples lie on no grid
_LEAK = 0.1  # of a line's uncertainty: leakage of another line above which that is fitted too
_MOST_NUISANCES = 12  # other lines fitted at most; chosen to limit the fit
_NAMED = 4  # aliased harmonics named in one notice
_STRANGERS = 3  # other lines named in one notice


@dataclass(frozen=True)
class LineFrequencies(
    Arrays, shapes="frequency_hz K; u_frequency_hz K; nominal_hz K; multiple K; why K; nuisance_hz N"
):
    """Lines of a recording in ascending frequency.

    Attributes
    ----------
    frequency_hz, u_frequency_hz : (K,), in Hz on the clock of the given times.
    nominal_hz, multiple : (K,), nominal fundamental and harmonic number of each line.
    why : K reasons for including the line.
    notices : notices of the search.
    others : other lines of the recording at their spectral position, with their explanation.
    nuisance_hz : (N,), other lines that would leak into the lines; they are fitted too but are no result.
    """

    frequency_hz: FloatArray
    u_frequency_hz: FloatArray
    nominal_hz: FloatArray
    multiple: IntArray
    why: tuple[str, ...]
    notices: tuple[Notice, ...]
    others: Survey = field(default_factory=empty_survey)
    nuisance_hz: FloatArray = field(default_factory=lambda: np.empty(0))


def find_lines(
    time_s: FloatArray,
    values: FloatArray | Stacked,
    nominal_hz: Sequence[float],
    harmonics: Literal["auto"] | Sequence[int] = "auto",
) -> LineFrequencies:
    """Find the lines of a recording in its fastest channels.

    `values` (S,) or (S, C) are samples at `time_s` (S,). Times on no uniform grid are searched on the nearest one and
    fitted unchanged.

    Each nominal fundamental must exceed the noise of the spectrum within 0.5 % and two bins, and is refined by least
    squares. Below the Nyquist rate it is searched for at its alias. `survey_lines` searches the residual for further
    lines. "auto" adds the harmonics among them (up to the 20th, below 0.98 of the Nyquist frequency), so that noise
    alone adds any with probability 1e-3 only. A list adds those multiples instead. All other lines are reported as
    `others`. Those that would leak into a line by more than a tenth of its uncertainty are fitted with it. Lines that
    alias onto another are left out.
    """
    time, data = _complete_samples(time_s, values)
    exact = sampling_grid(time)
    grid, fine = (exact, exact) if exact else (nearest_grid(time), nearest_grid(time, _FINER))
    if grid is None or fine is None:
        raise ValueError("time_s: expected ascending times, most of them near a uniform grid, found long gaps")
    nominal = np.array(sorted(set(nominal_hz)), dtype=np.float64)
    usable, notices = usable_lines(time, nominal)
    if not np.any(usable):
        raise ValueError(f"nominal_hz: expected a line that the sampling can separate, found none: {notices[0].text}")
    notices += _alias_notices(nominal[usable], nominal, grid)
    nominal = nominal[usable]
    record = _Record(time, data, grid, fine)
    chosen = _LineSelection(record.peaks_near(nominal), [[1] for _ in nominal], np.empty(0))
    if harmonics != "auto":
        multiples, above = _select_multiples(nominal, harmonics, grid)
        chosen, notices = _LineSelection(chosen.fundamental, multiples, np.empty(0)), notices + above
    fitted = record.fit(chosen)
    for _ in range(_ROUNDS if len(time) < grid.length else 1):  # where samples are missing, lines leak
        others = record.search(fitted)
        extended = _extend_lines(record, fitted, others, harmonics == "auto")
        added = extended.lines.size > fitted.chosen.lines.size or extended.nuisance.size > fitted.chosen.nuisance.size
        others = others.select(~_coincides(others.frequency_hz, record.alias(extended.lines), record.resolution_hz))
        if not added:
            break
        fitted = record.fit(extended)
    return _build_lines(fitted, others, nominal, notices, harmonics == "auto")


@dataclass(frozen=True)
class _LineSelection:
    """Fundamentals (Q,) in Hz with their multiples, and nuisance lines (N,) in Hz."""

    fundamental: FloatArray
    multiples: list[list[int]]
    nuisance: FloatArray

    @property
    def line_orders(self) -> list[tuple[int, int]]:
        """Fundamental and multiple of each line."""
        return [(q, m) for q, orders in enumerate(self.multiples) for m in orders]

    @property
    def lines(self) -> FloatArray:
        """All lines (K,) in Hz, fundamental by fundamental."""
        return np.array([m * self.fundamental[q] for q, m in self.line_orders])


@dataclass(frozen=True)
class _Fitted:
    """The fitted lines at their refined frequencies, and their fit with nuisance lines last."""

    chosen: _LineSelection
    u_fundamental: FloatArray
    fit: SineFit


@dataclass(frozen=True)
class _Record:
    """Complete samples (S, C) on a grid, and a finer grid for the search.

    A sample at the nearest grid point is up to half an interval off, which would rotate a line by its phase there. The
    finer grid is used where samples lie only near a grid.
    """

    time_s: FloatArray
    data: Stacked
    grid: SamplingGrid
    fine: SamplingGrid

    @property
    def resolution_hz(self) -> float:
        """One bin."""
        return self.grid.rate_hz / self.grid.length

    def alias(self, frequency_hz: FloatArray) -> FloatArray:
        """Return where lines appear."""
        return alias_frequency(frequency_hz, self.grid.rate_hz)

    def peaks_near(self, nominal: FloatArray) -> FloatArray:
        """Return the peaks nearest to the aliases of nominal frequencies, or raise `ValueError`."""
        rate_hz = self.fine.rate_hz
        alias = alias_frequency(nominal, rate_hz)
        distance = np.abs(np.subtract.outer(alias, alias)) + np.where(np.eye(len(alias)) > 0.0, np.inf, 0.0)
        capture = np.minimum(CAPTURE * nominal + 2.0 * self.resolution_hz, distance.min(axis=1) / 2.0)
        capture = np.maximum(capture, self.resolution_hz)
        bin_hz = rate_hz / self.fine.length
        intervals = np.stack([alias - capture, alias + capture], axis=1) / bin_hz
        peaks = [
            excess_power(self.fine.filled(samples - samples.mean()), intervals)
            for samples in self.data.iterate_channels()
        ]
        height = np.stack([ratio for ratio, _ in peaks], axis=1)
        for q in np.flatnonzero(~(height.max(axis=1) > _PROMINENT)):
            raise ValueError(
                f"nominal_hz: expected {nominal[q]:.6g} Hz to exceed the noise of the spectrum, found no peak above "
                f"{np.sqrt(_PROMINENT):g} times the noise within {capture[q]:.3g} Hz"
            )
        best = np.argmax(height, axis=1)
        seen = np.array([peaks[c][1][q] for q, c in enumerate(best)]) * bin_hz
        return frequency_of_alias(seen, nominal, rate_hz)

    def fit(self, chosen: _LineSelection) -> _Fitted:
        """Refine the fundamentals jointly with their harmonics; nuisance lines are free."""
        label = [q for q, _ in chosen.line_orders] + [len(chosen.fundamental) + n for n in range(len(chosen.nuisance))]
        start = np.concatenate([chosen.lines, chosen.nuisance])
        names = [str(c) for c in range(self.data.shape[1])]
        try:
            fit = fit_sines(self.time_s, self.data, start, names, names, model=SineModel(free=tuple(label)))
        except ValueError:
            if not len(chosen.nuisance):
                raise
            return self.fit(_LineSelection(chosen.fundamental, chosen.multiples, np.empty(0)))
        first, frequency = [label.index(q) for q in range(len(chosen.fundamental))], fit.phasors.frequency_hz
        order = np.array([chosen.line_orders[k][1] for k in first], dtype=np.float64)
        refined = _LineSelection(frequency[first] / order, chosen.multiples, frequency[len(chosen.lines) :])
        return _Fitted(refined, fit.u_frequency_hz[first] / order, fit)

    def search(self, fitted: _Fitted) -> Survey:
        """Return the named lines of the residual, with the nuisance lines."""
        lines, fit = fitted.chosen.lines, fitted.fit
        amplitude = np.abs(fit.phasors.value)
        residuals = (
            FloorSpectrum(self.grid.filled(samples - fit.model(self.time_s, slice(c, c + 1))[:, 0]))
            for c, samples in enumerate(self.data.iterate_channels())
        )
        others = detect_lines(
            residuals,
            (self.grid.length, self.data.shape[1]),
            self.grid.rate_hz,
            FALSE_ALARM,
            expected_frequencies(fitted.chosen.fundamental, self.grid.rate_hz),
            fit.phasors.frequency_hz,
            _SMALLEST * amplitude.max(axis=0),
        )
        if len(lines) < len(amplitude):  # the nuisances that were fitted are put back
            u = np.sqrt((fit.phasors.u_re**2 + fit.phasors.u_im**2) / 2.0)[len(lines) :]
            nuisance_hz, u_nuisance_hz = fit.phasors.frequency_hz[len(lines) :], fit.u_frequency_hz[len(lines) :]
            others = others.with_lines(nuisance_hz, u_nuisance_hz, amplitude[len(lines) :], u)
        frequency = np.concatenate([self.alias(lines), others.frequency_hz])
        u = np.concatenate([fit.u_frequency_hz[: len(lines)], others.u_frequency_hz])
        strength = relative_strength(np.concatenate([amplitude[: len(lines)], others.amplitude]))
        every = DetectedLines(frequency, u, strength, self.grid.rate_hz, self.resolution_hz)
        return replace(others, origin=name_lines(every, fitted.chosen.fundamental)[len(lines) :])


def _extend_lines(record: _Record, fitted: _Fitted, others: Survey, auto: bool) -> _LineSelection:
    """Return the lines of the next fit, with new harmonics and leaking lines."""
    multiples = [list(orders) for orders in fitted.chosen.multiples]
    limit = _NYQUIST_SHARE * record.grid.rate_hz / 2.0
    for frequency, origin in zip(others.frequency_hz, others.origin, strict=True):
        if auto and origin.kind == "harmonic" and origin.multiple <= MAX_MULTIPLE and frequency < limit:
            q = int(np.argmin(np.abs(fitted.chosen.fundamental - origin.fundamental_hz)))
            multiples[q] = sorted({*multiples[q], origin.multiple})
    chosen = _LineSelection(fitted.chosen.fundamental, multiples, fitted.chosen.nuisance)
    lines = record.alias(chosen.lines)
    left = others.select(~_coincides(others.frequency_hz, lines, record.resolution_hz))
    if not len(left.frequency_hz):
        return chosen
    phasors = fitted.fit.phasors
    u = np.sqrt((phasors.u_re**2 + phasors.u_im**2) / 2.0)[: len(fitted.chosen.lines)].min(axis=0)
    distance = np.min(np.abs(np.subtract.outer(left.frequency_hz, lines)), axis=1) / record.resolution_hz
    leak = np.max(np.nan_to_num(left.amplitude) / np.maximum(u, np.finfo(np.float64).tiny), axis=1) / (np.pi * distance)
    strongest = np.argsort(-leak, kind="stable")[:_MOST_NUISANCES]
    return _LineSelection(chosen.fundamental, multiples, np.sort(left.frequency_hz[strongest[leak[strongest] > _LEAK]]))


def _coincides(frequency_hz: FloatArray, lines: FloatArray, resolution_hz: float) -> BoolArray:
    """Return which frequencies (L,) coincide with lines."""
    return np.asarray(np.any(np.abs(np.subtract.outer(frequency_hz, lines)) < 1.5 * resolution_hz, axis=1))


def _complete_samples(time_s: FloatArray, values: FloatArray | Stacked) -> tuple[FloatArray, Stacked]:
    """Return times and values (S, C) without NaN and without constant channels."""
    check_shape("time_s", time_s, (None,))
    data = Stacked.from_array(values)
    check_shape("values", data, (len(time_s), None))
    present = rows_present(data)
    time_s, data = time_s if present is None else time_s[present], data.select_rows(present)
    moving = [c for c, samples in enumerate(data.iterate_channels()) if len(samples) and np.ptp(samples) > 0.0]
    if not moving:
        raise ValueError(f"values: expected a channel that changes, found {data.shape[1]} without any change")
    return time_s, data.select(moving)


def _alias_notices(nominal: FloatArray, all_nominal: FloatArray, grid: SamplingGrid) -> tuple[Notice, ...]:
    """Return notices of harmonics that share the alias of a fundamental above the Nyquist frequency."""
    resolution = grid.rate_hz / grid.length
    notices = []
    for frequency in nominal[nominal > grid.rate_hz / 2.0].tolist():
        folds = find_aliased_harmonics(frequency, all_nominal.tolist(), grid.rate_hz, resolution, MAX_MULTIPLE)
        if folds:
            names = [f"{fold.frequency_hz:.6g} Hz ({fold.multiple} × {fold.fundamental_hz:.6g} Hz)" for fold in folds]
            more = f" and {len(names) - _NAMED} higher ones" if len(names) > _NAMED else ""
            notice = Notice(
                HARMONICS_ON_ALIAS,
                f"{frequency:.6g} Hz",
                frequency_hz=frequency,
                rate_hz=grid.rate_hz,
                alias_hz=folds[0].alias_hz,
                harmonics=", ".join(names[:_NAMED]) + more,
            )
            notices.append(notice)
    return tuple(notices)


def _select_multiples(
    nominal: FloatArray, harmonics: Sequence[int], grid: SamplingGrid
) -> tuple[list[list[int]], tuple[Notice, ...]]:
    """Return the requested multiples below the Nyquist frequency, and notices about the others."""
    wrong = [m for m in harmonics if m < 1]
    if wrong:
        raise ValueError(f"harmonics: expected multiples of 1 and above, found {wrong[0]}")
    limit = _NYQUIST_SHARE * grid.rate_hz / 2.0
    taken: list[float] = []
    multiples: list[list[int]] = [[] for _ in nominal]
    notices = []
    for m in sorted({1, *harmonics}):
        for q, f in enumerate(nominal):
            if m > 1 and m * f >= limit:
                values = {"multiple": m, "fundamental_hz": f, "limit_hz": limit}
                notices.append(Notice(HARMONIC_OUT_OF_REACH, f"{m * f:.6g} Hz", **values))
            elif not any(abs(m * f - other) <= 1.5 * grid.rate_hz / grid.length for other in taken):
                multiples[q].append(m)
                taken.append(m * f)
    return multiples, tuple(notices)


def _build_lines(
    fitted: _Fitted, others: Survey, nominal: FloatArray, notices: tuple[Notice, ...], auto: bool
) -> LineFrequencies:
    """Return the result in ascending frequency, with reasons and notices."""
    chosen, phasors = fitted.chosen, fitted.fit.phasors
    line_orders, lines = chosen.line_orders, chosen.lines
    amplitude = np.abs(phasors.value)[: len(lines)]
    level = np.sqrt((phasors.u_re**2 + phasors.u_im**2) / 2.0)[: len(lines)]
    height = np.max(amplitude / np.maximum(level, np.finfo(np.float64).tiny), axis=1)
    first = {q: k for k, (q, m) in enumerate(line_orders) if m == 1}
    why = []
    for k, (q, m) in enumerate(line_orders):
        share = float(np.max(amplitude[k] / amplitude[first[q]]))
        reason = "is significant" if auto else "requested"
        why.append(
            f"fundamental, {number_text(float(height[k]))} times its noise"
            if m == 1
            else f"harmonic {m} of {nominal[q]:.6g} Hz {reason}: {share:.2g} of the fundamental, "
            f"{number_text(float(height[k]))} times its noise"
        )
    listed = [f"{others.frequency_hz[i]:.6g} Hz ({others.why[i]})" for i in np.argsort(-others.snr, kind="stable")]
    if listed:
        more = f" and {len(listed) - _STRANGERS} more" if len(listed) > _STRANGERS else ""
        notices += (Notice(OTHER_LINES, "lines", count=len(listed), lines="; ".join(listed[:_STRANGERS]) + more),)
    order = np.argsort(lines)
    index = np.array([q for q, _ in line_orders])
    order_of = np.array([m for _, m in line_orders])
    return LineFrequencies(
        frequency_hz=lines[order],
        u_frequency_hz=(order_of * fitted.u_fundamental[index])[order],
        nominal_hz=nominal[index][order],
        multiple=order_of[order],
        why=tuple(why[i] for i in order),
        notices=notices,
        others=others,
        nuisance_hz=chosen.nuisance,
    )
