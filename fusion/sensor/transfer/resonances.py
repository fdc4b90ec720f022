"""Resonances in a measured transfer function: peaks, and the oscillator fitted to each."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from fusion.errors import ARGUMENT
from fusion.sensor import response_notices as declared
from fusion.sensor.transfer.chain_filter import (
    UNSTATED_FILTER,
    FoundFilter,
    WideFit,
    decided_law,
    unstated_filter,
    wide_fits,
)
from fusion.sensor.transfer.transfer_records import FoundResonance
from fusion.sensor.unmodelled_effects import NO_INFLUENCES, ModelInfluences
from shaker.frf.result import TransferFunction
from shaker.identification.amplitude import AmplitudeEffect, ExcitedLines, amplitude_effect
from shaker.identification.measured_curves import CurveError, MeasuredCurve
from shaker.identification.oscillator import DampingLaw, Resonance, ResonanceKind, fit_resonance
from shaker.identification.rival_models import added_uncertainty
from shakercal._common.arrays import ComplexArray, FloatArray
from shakercal._common.notices import Notice

_PROMINENCE = np.log(2.0)  # of a peak in ln|H|
_SIGNIFICANT = 8.0  # standard uncertainties by which a peak exceeds its surroundings
_DOWN_TO = 1.0 / 8.0  # of the peak: lines around it that are fitted
_FEWEST_LINES = 6
_POOR_FIT = 2.0  # χ² per degree of freedom from which the rest of all other modes is fitted too
_VAGUE = 0.25  # relative standard uncertainty of the damping above which a peak is no resonance
_MOST = 12
_ROUNDS = 4  # of fitting peaks one after the other, each without all others
REJECTED_FROM = 3.0
"""Residuals over the noise, rms, from which one oscillator does not explain a peak and has no U."""
LAW_OF_DAMPING = "law of damping, viscous or loss factor"
"""Cause in the budget."""
FIRST_ORDER = 1.3
"""Factor of changes with the amplitude, which are estimated to first order and from the lines of a peak."""
AMPLITUDE = "change with the amplitude"
"""Cause in the budget."""
_NEGLIGIBLE = 0.2  # standard uncertainties by which both laws may differ in f₀ without a decision


@dataclass(frozen=True)
class _Curve:
    """One response over its reference: values (K,), noise covariance, and common errors.

    `base` (K,): acceleration of a base with periodic motion. `factor` (K,): of a filter that is not stated.
    """

    name: str
    transfer: TransferFunction
    value: ComplexArray
    covariance: FloatArray
    errors: dict[str, ComplexArray]
    kind: ResonanceKind
    base: ComplexArray | None = None
    factor: ComplexArray | None = None

    @property
    def causes(self) -> list[CurveError]:
        """Return the common errors (K,)."""
        return [CurveError(name, relative) for name, relative in self.errors.items()]

    def fit(
        self,
        lines: slice,
        value: ComplexArray,
        *,
        law: DampingLaw = "viscous",
        **terms: bool,
    ) -> Resonance:
        """Fit one oscillator to values (L,) at some lines; `terms` of `fit_resonance` in addition."""
        return fit_resonance(self.measured(lines, value), self.kind, law=law, **terms)

    def measured(self, lines: slice, value: ComplexArray) -> MeasuredCurve:
        """Return values (L,) at some lines with their noise."""
        return MeasuredCurve(
            self.transfer.ratio.frequency_hz[lines],
            value,
            self.covariance[lines],
            line_correlation=self.transfer.line_correlation,
            added_decay_per_s=self.transfer.added_decay_per_s,
            dof=self.transfer.ratio.dof[lines],
        )

    def amplitude_effect(self, lines: slice, mode: _Mode) -> AmplitudeEffect | None:
        """Return how a mode deviates from a linear one, None if not significantly."""
        if self.base is None or self.kind != "transmissibility" or mode.fit.law != "viscous":
            return None
        excited = ExcitedLines(self.transfer.ratio.frequency_hz, self.value, self.base)
        return amplitude_effect(self.measured(lines, mode.value), mode.fit, excited)


def find_resonances(
    transfer: TransferFunction,
    errors: Sequence[CurveError],
    kinds: Sequence[ResonanceKind],
    u_clock: float,
    influences: ModelInfluences = NO_INFLUENCES,
    base: ComplexArray | None = None,
) -> tuple[tuple[FoundResonance, ...], tuple[CurveError, ...], tuple[Notice, ...]]:
    """Return the resonances of every response, errors of curves by unstated filters, and notices.

    `transfer` has the covariance of its noise only. `kinds` (C): form of an oscillator in each response. `u_clock`:
    relative standard uncertainty of the clock, and so of every frequency. `influences`: influences on a resonance that
    the record does not show. `base` (K,): acceleration of a base with periodic motion.
    """
    found: list[FoundResonance] = []
    notices: list[Notice] = []
    filters: list[CurveError] = []
    for c, (name, kind) in enumerate(zip(transfer.ratio.channels, kinds, strict=True)):
        of_channel = {error.name: error.relative[:, c] for error in errors if np.any(error.relative[:, c] != 0.0)}
        curve = _Curve(
            name, transfer, transfer.ratio.value[:, c], transfer.channel_covariance(name), of_channel, kind, base
        )
        peaks, where = _peaks(curve), f"{name}/{transfer.reference}"
        curve = curve if len(peaks) == 1 else replace(curve, base=None)
        modes = _separated(curve, [peak.lines for peak in peaks])
        for index, (peak, mode) in enumerate(zip(peaks, modes, strict=True)):
            frequency_hz = float(transfer.ratio.frequency_hz[peak.line])
            if isinstance(mode, str):
                notices.append(Notice(declared.PEAK_NOT_FITTED, where, frequency_hz=frequency_hz, reason=mode))
                continue
            others = [one for one in (*modes[:index], *modes[index + 1 :]) if isinstance(one, _Mode)]
            wide = _wide_fits(curve, peak, others)
            best, other = _with_law(curve, peak, mode, wide)
            seen = _unstated_filter(curve, wide) if len(peaks) == 1 else None
            if seen is not None:
                curve = replace(curve, factor=seen.factor)
                acts = np.array([float(channel == name) for channel in transfer.ratio.channels])
                error = np.multiply.outer(seen.error(curve.causes), acts)
                filters.append(CurveError(f"{UNSTATED_FILTER}, {name}", error))
                notices.append(_filter_notice(curve, seen, where))
            one = _with_budget(curve, peak.lines, best, other, u_clock, influences)
            found.append(one)
            notices += _mode_notices(one, other, where)
    return tuple(found), tuple(filters), tuple(notices)


def _mode_notices(found: FoundResonance, other: Resonance | None, where: str) -> Iterator[Notice]:
    """Yield notices of misfit, law of damping and amplitude of a resonance."""
    fit, amplitude = found.fit, found.amplitude
    at = {"frequency_hz": fit.frequency_hz}
    if amplitude is not None:
        changes = {
            "stiffness_percent": 200.0 * amplitude.frequency_change,
            "damping_percent": 100.0 * amplitude.damping_change,
        }
        forces = 100.0 * amplitude.stiffening, 100.0 * amplitude.friction
        over = (
            f"the deflections of this record, at the largest of which a cubic part of the spring force makes "
            f"{forces[0]:+.2g} % and dry friction {forces[1]:.2g} %"
        )
        yield Notice(declared.CHANGES_WITH_AMPLITUDE, where, **changes, range=over)
    if np.isnan(found.u_frequency_hz):
        yield Notice(declared.PEAK_DEPARTS, where, **at, ratio=np.sqrt(fit.chi_squared / fit.dof))
    elif fit.law == "loss factor":
        yield Notice(declared.RESONANCE_LOSS_FACTOR, where, **at)
    elif other is not None:
        share = abs(other.frequency_hz - fit.frequency_hz) / fit.frequency_hz
        yield Notice(declared.LAW_UNDECIDED, where, **at, share=share)


@dataclass(frozen=True)
class _Peak:
    """A peak: its line, lines to an eighth of it, lines up to the valleys."""

    line: int
    lines: slice
    wide: slice


@dataclass(frozen=True)
class _Mode:
    """One oscillator, and the values (L,) to which it was fitted, corrected for all others."""

    fit: Resonance
    value: ComplexArray


def _separated(curve: _Curve, windows: Sequence[slice]) -> list[_Mode | str]:
    """Fit every peak without the others, in rounds; a text is a failure's reason."""
    found: list[_Mode | str] = ["no fit" for _ in windows]
    for _ in range(_ROUNDS if len(windows) > 1 else 1):
        for index, lines in enumerate(windows):
            value = _without(
                curve, lines, [one for one in (*found[:index], *found[index + 1 :]) if isinstance(one, _Mode)]
            )
            try:
                found[index] = _Mode(_best(curve, lines, value), value)
            except (ValueError, np.linalg.LinAlgError) as error:
                found[index] = ARGUMENT.sub("", str(error))
    return found


def _without(curve: _Curve, lines: slice, others: Sequence[_Mode]) -> ComplexArray:
    """Return the values at some lines without other oscillators."""
    value = curve.value[lines].copy()
    for other in others:
        oscillator = replace(other.fit, residual_terms=np.zeros(2, dtype=np.complex128))
        value -= oscillator.model(curve.transfer.ratio.frequency_hz[lines], curve.transfer.added_decay_per_s)
    return value


def _wide_fits(curve: _Curve, peak: _Peak, others: Sequence[_Mode]) -> list[WideFit]:
    """Return the fits of one oscillator from valley to valley, without the others."""
    return wide_fits(partial(curve.fit, peak.wide, _without(curve, peak.wide, others)))


def _with_law(curve: _Curve, peak: _Peak, mode: _Mode, wide: Sequence[WideFit]) -> tuple[_Mode, Resonance | None]:
    """Return a mode by its law of damping, and the other if undecided.

    Viscous damping and a loss factor give the same peak; f₀ then differs by the share ζ². The lines up to the valleys
    distinguish them, with the phase of gain and chains left free.
    """
    residual_terms = "constant_re" in mode.fit.parameters
    try:
        other = curve.fit(peak.lines, mode.value, residual_terms=residual_terms, law="loss factor")
    except (ValueError, np.linalg.LinAlgError):
        return mode, None
    if mode.fit.damping_ratio**2 * mode.fit.frequency_hz < _NEGLIGIBLE * mode.fit.u("frequency_hz"):
        return mode, None
    law = decided_law(wide)
    return (replace(mode, fit=other), None) if law == "loss factor" else (mode, other if law is None else None)


def _unstated_filter(curve: _Curve, wide: Sequence[WideFit]) -> FoundFilter | None:
    """Return what a chain does that nobody states."""
    names = f"{curve.name} or {curve.transfer.reference}"
    return unstated_filter(wide, curve.transfer.ratio.frequency_hz, curve.causes, names)


def _filter_notice(curve: _Curve, seen: FoundFilter, where: str) -> Notice:
    """Return the notice of an unstated filter, or of models that the data leave open."""
    if seen.rivals:
        return Notice(declared.MODELS_UNDECIDED, where, models="; ".join(seen.rivals))
    highest_hz = float(curve.transfer.ratio.frequency_hz[-1])
    values = {"lag_us": 1e6 * seen.lag_s, "change_percent": 100.0 * seen.change, "frequency_hz": highest_hz}
    effect = "It is not corrected. U of the curve and of its resonance includes it."
    channel = f"{curve.name} or {curve.transfer.reference}"
    return Notice(declared.UNSTATED_FILTER_FOUND, where, channel=channel, **values, consequence=effect)


def _peaks(curve: _Curve) -> list[_Peak]:
    """Return the largest significant peaks of |H|."""
    from scipy.signal import find_peaks

    size = np.abs(curve.value)
    relative = np.sqrt(np.trace(curve.covariance, axis1=1, axis2=2) / 2.0) / size
    logarithm = np.log(size)
    peaks, found = find_peaks(logarithm, prominence=_PROMINENCE)
    keep = (found["prominences"] > _SIGNIFICANT * relative[peaks]) & (relative[peaks] < 1.0 / _SIGNIFICANT)
    peaks = peaks[keep]
    largest = np.sort(peaks[np.argsort(-found["prominences"][keep])[:_MOST]])
    windows = []
    for number, peak in enumerate(largest):
        low = 0 if number == 0 else largest[number - 1] + int(np.argmin(size[largest[number - 1] : peak]))
        high = len(size) if number + 1 == len(largest) else peak + int(np.argmin(size[peak : largest[number + 1]]))
        wide = slice(int(low), int(high))
        weak = np.flatnonzero(size[low:high] < _DOWN_TO * size[peak]) + low
        low = max([low, *(weak[weak < peak] + 1)])
        high = min([high, *weak[weak > peak]])
        if high - low >= _FEWEST_LINES:
            windows.append(_Peak(int(peak), slice(int(low), int(high)), wide))
    return windows


def _best(curve: _Curve, lines: slice, value: ComplexArray) -> Resonance:
    """Fit one oscillator to values (L,), with residual terms if they improve it."""
    frequency = curve.transfer.ratio.frequency_hz[lines]
    fit = curve.fit(lines, value, residual_terms=False)
    if fit.chi_squared > _POOR_FIT * fit.dof and len(frequency) >= 2 * _FEWEST_LINES:
        richer = curve.fit(lines, value, residual_terms=True)
        fit = richer if richer.chi_squared / richer.dof < 0.5 * fit.chi_squared / fit.dof else fit
    if not frequency[0] <= fit.frequency_hz <= frequency[-1]:
        raise ValueError(f"its frequency would be {fit.frequency_hz:.6g} Hz")
    if fit.u("damping_ratio") > _VAGUE * fit.damping_ratio:
        raise ValueError("its damping is not determined because of noise")
    return fit


def _with_budget(
    curve: _Curve,
    lines: slice,
    mode: _Mode,
    other: Resonance | None,
    u_clock: float,
    influences: ModelInfluences,
) -> FoundResonance:
    """Return a fit with its uncertainty by noise and all other causes.

    U (k = 2) covers the values by the other law. A fit that the data refute has none.
    """
    frequency, fit = curve.transfer.ratio.frequency_hz[lines], mode.fit
    where, band_hz = (curve.name, curve.transfer.reference), (float(frequency[0]), float(frequency[-1]))
    amplitude = curve.amplitude_effect(lines, mode)
    excess = fit.chi_squared / fit.dof
    if min(excess, excess if amplitude is None else amplitude.excess) >= REJECTED_FROM**2:
        return FoundResonance(*where, fit, band_hz, np.nan, np.nan, {}, amplitude)
    residual_terms = "constant_re" in fit.parameters
    u_noise = fit.u("frequency_hz"), fit.u("damping_ratio")
    budget = {"noise": u_noise}
    for name, relative in curve.errors.items():
        off = mode.value * (1.0 + relative[lines])
        moved = curve.fit(lines, off, residual_terms=residual_terms, law=fit.law)
        budget[name] = (moved.frequency_hz - fit.frequency_hz, moved.damping_ratio - fit.damping_ratio)
    rivals = {} if other is None else {LAW_OF_DAMPING: other}
    if curve.factor is not None:
        off = mode.value / curve.factor[lines]
        rivals[UNSTATED_FILTER] = curve.fit(lines, off, residual_terms=residual_terms, law=fit.law)
    for name, rival in rivals.items():
        budget[name] = (
            added_uncertainty(fit.frequency_hz, u_noise[0], rival.frequency_hz, rival.u("frequency_hz")),
            added_uncertainty(fit.damping_ratio, u_noise[1], rival.damping_ratio, rival.u("damping_ratio")),
        )
    if amplitude is not None:
        at_rest = (
            fit.frequency_hz * (1.0 - FIRST_ORDER * amplitude.frequency_change),
            fit.damping_ratio * (1.0 - FIRST_ORDER * amplitude.damping_change),
        )
        budget[AMPLITUDE] = (
            added_uncertainty(fit.frequency_hz, u_noise[0], at_rest[0], u_noise[0]),
            added_uncertainty(fit.damping_ratio, u_noise[1], at_rest[1], u_noise[1]),
        )
    if u_clock > 0.0:
        budget["rate of the clock"] = (u_clock * fit.frequency_hz, 0.0)
    for cause, (by_frequency, by_damping) in influences.relative.items():
        budget[cause] = (by_frequency * fit.frequency_hz, by_damping * fit.damping_ratio)
    u_frequency, u_damping = np.sqrt(np.sum(np.square(list(budget.values())), axis=0))
    return FoundResonance(*where, fit, band_hz, float(u_frequency), float(u_damping), budget, amplitude)
