"""Resonances in a measured transfer function: peaks, and the oscillator fitted to each."""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np

from fusion.errors import ARGUMENT
from fusion.sensor import response_notices as declared
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
LAWS: tuple[DampingLaw, DampingLaw] = ("viscous", "loss factor")
"""The laws of damping that are compared."""
_NEGLIGIBLE = 0.2  # standard uncertainties by which both laws may differ in f₀ without a decision
_EXPLAINED = 1.2  # χ² per degree of freedom up to which a law explains the lines up to the valleys
_DELAY = re.compile(r": delay$|^clock ")  # names of errors that delay a channel
_LONGER = 3.0  # standard uncertainties from which a delay is not the stated one
_DECISIVE = 6.0  # difference of χ² that decides, a likelihood ratio of 20


@dataclass(frozen=True)
class _Curve:
    """One response over its reference: values (K,), noise covariance, and common errors.

    `base` (K,): acceleration of a base with periodic motion.
    """

    name: str
    transfer: TransferFunction
    value: ComplexArray
    covariance: FloatArray
    errors: dict[str, ComplexArray]
    kind: ResonanceKind
    base: ComplexArray | None = None

    def fit(
        self,
        lines: slice,
        value: ComplexArray,
        *,
        residual_terms: bool = False,
        delay: bool = False,
        law: DampingLaw = "viscous",
    ) -> Resonance:
        """Fit one oscillator to values (L,) at some lines."""
        curve = self.measured(lines, value)
        return fit_resonance(curve, self.kind, residual_terms=residual_terms, delay=delay, law=law)

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
) -> tuple[tuple[FoundResonance, ...], tuple[Notice, ...]]:
    """Return the resonances of every response, and notices of peaks without a fitted oscillator.

    `transfer` has the covariance of its noise only. `kinds` (C): form of an oscillator in each response. `u_clock`:
    relative standard uncertainty of the clock, and so of every frequency. `influences`: influences on a resonance that
    the record does not show. `base` (K,): acceleration of a base with periodic motion.
    """
    found: list[FoundResonance] = []
    notices: list[Notice] = []
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
            best, other, wide = _with_law(curve, peak, mode, others)
            one = _with_budget(curve, peak.lines, best, other, u_clock, influences)
            found.append(one)
            notices += _mode_notices(one, other, where)
            late = _late(curve, wide) if len(peaks) == 1 else None
            if late is not None:
                values = {"lag_us": 1e6 * late, "change_percent": 0.0, "frequency_hz": frequency_hz}
                effect = "The lines of the curve are turned by it, beyond their U."
                notices.append(
                    Notice(declared.UNSTATED_FILTER_FOUND, where, channel=name, **values, consequence=effect)
                )
    return tuple(found), tuple(notices)


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


def _with_law(
    curve: _Curve, peak: _Peak, mode: _Mode, others: Sequence[_Mode]
) -> tuple[_Mode, Resonance | None, Resonance | None]:
    """Return a mode by its law of damping, the other law, and a wide fit.

    Viscous damping and a loss factor give the same peak; f₀ then differs by the share ζ². The lines up to the valleys
    distinguish them, with the phase of gain and delay left free.
    """
    residual_terms = "constant_re" in mode.fit.parameters
    try:
        other = curve.fit(peak.lines, mode.value, residual_terms=residual_terms, law="loss factor")
        wide, is_decided = _wide_fit(curve, peak.wide, _without(curve, peak.wide, others))
    except (ValueError, np.linalg.LinAlgError):
        return mode, None, None
    if mode.fit.damping_ratio**2 * mode.fit.frequency_hz < _NEGLIGIBLE * mode.fit.u("frequency_hz"):
        return mode, None, wide
    if is_decided and wide is not None and wide.law == "loss factor":
        return replace(mode, fit=other), None, wide
    return mode, None if is_decided else other, wide


def _wide_fit(curve: _Curve, lines: slice, value: ComplexArray) -> tuple[Resonance | None, bool]:
    """Return the oscillator that explains values (L,), and whether it decides the law."""
    for residual_terms in (False, True):
        fits = [curve.fit(lines, value, residual_terms=residual_terms, delay=True, law=law) for law in LAWS]
        left = np.array([fit.chi_squared for fit in fits])
        best = fits[int(np.argmin(left))]
        if best.chi_squared < max(_EXPLAINED, 1.0 + 5.0 * np.sqrt(2.0 / best.dof)) * best.dof:
            return best, float(np.ptp(left)) > _DECISIVE
    return None, False


def _late(curve: _Curve, wide: Resonance | None) -> float | None:
    """Return the delay of a response in s if it is longer than stated.

    Below its resonance a load follows its base, so that the delay of both chains remains. Errors of delay and clock are
    the stated ones.
    """
    if wide is None or curve.kind != "transmissibility":
        return None
    turn = 2.0 * np.pi * curve.transfer.ratio.frequency_hz
    stated = [np.max(np.abs(error.imag) / turn) for name, error in curve.errors.items() if _DELAY.search(name)]
    limit = _LONGER * float(np.linalg.norm([wide.u("delay_s"), *stated]))
    return wide.delay_s if abs(wide.delay_s) > limit else None


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
    if other is not None:
        budget[LAW_OF_DAMPING] = (
            added_uncertainty(fit.frequency_hz, u_noise[0], other.frequency_hz, other.u("frequency_hz")),
            added_uncertainty(fit.damping_ratio, u_noise[1], other.damping_ratio, other.u("damping_ratio")),
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
