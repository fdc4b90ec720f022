"""Resonances in a measured transfer function: where the peaks are, and an oscillator fitted to each."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from fusion.errors import ARGUMENT
from fusion.notices import Notice
from fusion.transfer.result import CommonError, FoundResonance
from shaker._checks import ComplexArray, FloatArray
from shaker.models.resonance.oscillator import Kind, Resonance, fit_resonance
from shaker.signals.transfer import TransferFunction

_PROMINENCE = np.log(2.0)  # of a peak in ln|H|
_SIGNIFICANT = 8.0  # standard uncertainties by which a peak stands out
_DOWN_TO = 1.0 / 8.0  # of the peak: lines around it that are fitted
_FEWEST_LINES = 6
_POOR_FIT = 2.0  # χ² per degree of freedom from which the rest of all other modes is fitted too
_VAGUE = 0.25  # relative standard uncertainty of the damping above which a peak is no resonance
_MOST = 12
_ROUNDS = 4  # of fitting peaks one after the other, each without all others
_DEPARTS = 3.0  # residuals over the noise, rms, from which one oscillator does not explain a peak


@dataclass(frozen=True)
class _Curve:
    """One response over its reference: values (K,), covariance (K, 2, 2) of the noise, common errors by name (K,)."""

    name: str
    transfer: TransferFunction
    value: ComplexArray
    covariance: FloatArray
    errors: dict[str, ComplexArray]
    kind: Kind


def find_resonances(
    transfer: TransferFunction, errors: Sequence[CommonError], kinds: Sequence[Kind], u_clock: float
) -> tuple[tuple[FoundResonance, ...], tuple[Notice, ...]]:
    """Return the resonances of every response and what is to be said of peaks that no oscillator fits.

    `transfer` with the covariance of its noise alone; `kinds` (C) say which form an oscillator takes in each response;
    `u_clock`: relative standard uncertainty of the clock, and so of every frequency.
    """
    found: list[FoundResonance] = []
    notices: list[Notice] = []
    for c, (name, kind) in enumerate(zip(transfer.ratio.channels, kinds, strict=True)):
        own = {error.name: error.relative[:, c] for error in errors if np.any(error.relative[:, c] != 0.0)}
        curve = _Curve(name, transfer, transfer.ratio.value[:, c], transfer.channel_covariance(name), own, kind)
        peaks = _peaks(curve)
        for (peak, lines), one in zip(peaks, _separated(curve, [lines for _, lines in peaks]), strict=True):
            if isinstance(one, _Mode):
                found.append(_with_budget(curve, lines, one, u_clock))
            notices += _remarks(one, float(transfer.ratio.frequency_hz[peak]), f"{name}/{transfer.reference}")
    return tuple(found), tuple(notices)


@dataclass(frozen=True)
class _Mode:
    """One oscillator, and the values (L,) of its lines that it was fitted to, all other oscillators taken off."""

    fit: Resonance
    value: ComplexArray


def _remarks(one: _Mode | str, peak_hz: float, where: str) -> list[Notice]:
    """Say of a peak that no oscillator was fitted, or that one does not explain it."""
    if isinstance(one, str):
        return [Notice("info", f"no oscillator was fitted to the peak at {peak_hz:.6g} Hz ({one})", where)]
    departs = np.sqrt(one.fit.chi_squared / one.fit.dof)
    if departs < _DEPARTS:
        return []
    text = (
        f"the peak at {peak_hz:.6g} Hz departs from one oscillator by {departs:.2g} times the noise; its frequency and "
        "damping depend on the lines that are fitted"
    )
    return [Notice("warning", text, where)]


def _separated(curve: _Curve, windows: Sequence[slice]) -> list[_Mode | str]:
    """Fit every peak with the oscillators of all others taken off, in rounds; a text where there is no fit."""
    found: list[_Mode | str] = ["no fit" for _ in windows]
    for _ in range(_ROUNDS if len(windows) > 1 else 1):
        for place, lines in enumerate(windows):
            frequency = curve.transfer.ratio.frequency_hz[lines]
            value = curve.value[lines].copy()
            for other in (*found[:place], *found[place + 1 :]):
                if isinstance(other, _Mode):
                    alone = replace(other.fit, residual=np.zeros(2, dtype=np.complex128))
                    value -= alone.model(frequency, curve.transfer.added_decay_per_s)
            try:
                found[place] = _Mode(_best(curve, lines, value), value)
            except (ValueError, np.linalg.LinAlgError) as error:
                found[place] = ARGUMENT.sub("", str(error))
    return found


def _peaks(curve: _Curve) -> list[tuple[int, slice]]:
    """Return the largest significant peaks of |H|, each with the lines around it down to an eighth of its height."""
    from scipy.signal import find_peaks

    size = np.abs(curve.value)
    relative = np.sqrt(np.trace(curve.covariance, axis1=1, axis2=2) / 2.0) / size
    logarithm = np.log(size)
    places, found = find_peaks(logarithm, prominence=_PROMINENCE)
    keep = (found["prominences"] > _SIGNIFICANT * relative[places]) & (relative[places] < 1.0 / _SIGNIFICANT)
    places = places[keep]
    largest = np.sort(places[np.argsort(-found["prominences"][keep])[:_MOST]])
    windows = []
    for number, place in enumerate(largest):
        low = 0 if number == 0 else largest[number - 1] + int(np.argmin(size[largest[number - 1] : place]))
        high = len(size) if number + 1 == len(largest) else place + int(np.argmin(size[place : largest[number + 1]]))
        weak = np.flatnonzero(size[low:high] < _DOWN_TO * size[place]) + low
        low = max([low, *(weak[weak < place] + 1)])
        high = min([high, *weak[weak > place]])
        if high - low >= _FEWEST_LINES:
            windows.append((int(place), slice(int(low), int(high))))
    return windows


def _best(curve: _Curve, lines: slice, value: ComplexArray) -> Resonance:
    """Fit one oscillator to values (L,) of some lines, with the rest of all other modes where that explains more."""
    frequency = curve.transfer.ratio.frequency_hz[lines]
    fit = _fit(curve, lines, value, residual_terms=False)
    if fit.chi_squared > _POOR_FIT * fit.dof and len(frequency) >= 2 * _FEWEST_LINES:
        richer = _fit(curve, lines, value, residual_terms=True)
        fit = richer if richer.chi_squared / richer.dof < 0.5 * fit.chi_squared / fit.dof else fit
    if not frequency[0] <= fit.frequency_hz <= frequency[-1]:
        raise ValueError(f"its frequency would be {fit.frequency_hz:.6g} Hz")
    if fit.u("damping_ratio") > _VAGUE * fit.damping_ratio:
        raise ValueError("the noise leaves its damping open")
    return fit


def _with_budget(curve: _Curve, lines: slice, mode: _Mode, u_clock: float) -> FoundResonance:
    """Return a fit with its uncertainty: noise, and what one standard deviation of every common error changes."""
    frequency, fit = curve.transfer.ratio.frequency_hz[lines], mode.fit
    residual_terms = "constant_re" in fit.parameters
    budget = {"noise": (fit.u("frequency_hz"), fit.u("damping_ratio"))}
    for name, relative in curve.errors.items():
        moved = _fit(curve, lines, mode.value * (1.0 + relative[lines]), residual_terms=residual_terms)
        budget[name] = (moved.frequency_hz - fit.frequency_hz, moved.damping_ratio - fit.damping_ratio)
    if u_clock > 0.0:
        budget["rate of the clock"] = (u_clock * fit.frequency_hz, 0.0)
    u_frequency, u_damping = np.sqrt(np.sum(np.square(list(budget.values())), axis=0))
    return FoundResonance(
        curve.name,
        curve.transfer.reference,
        fit,
        (float(frequency[0]), float(frequency[-1])),
        float(u_frequency),
        float(u_damping),
        budget,
    )


def _fit(curve: _Curve, lines: slice, value: ComplexArray, *, residual_terms: bool) -> Resonance:
    """Fit one oscillator to values at some lines of a curve."""
    return fit_resonance(
        curve.transfer.ratio.frequency_hz[lines],
        value,
        curve.covariance[lines],
        curve.kind,
        residual_terms=residual_terms,
        added_decay_per_s=curve.transfer.added_decay_per_s,
        line_correlation=curve.transfer.line_correlation,
        covariance_dof=curve.transfer.ratio.dof[lines],
    )
