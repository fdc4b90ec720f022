"""Evaluation of recordings: corrected transfer functions and resonances."""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from fusion.errors import ARGUMENT
from fusion.instruments.channel import scale_is_stated
from fusion.recording.excitation import kinds_of
from fusion.recording.load import Manifest
from fusion.recording.manifest import ChannelEntry
from fusion.recording.transducer import TRANSDUCERS
from fusion.sensor import response_notices as declared
from fusion.sensor.transfer.transfer_estimate import estimate_transfer
from fusion.sensor.transfer.transfer_records import (
    REPEAT,
    ChannelChain,
    FoundResonance,
    Quantity,
    ReferenceResult,
    SynchronousRecord,
    TransferEvaluation,
    TransferSettings,
    channel_chain,
    ratio_errors,
    read_synchronous,
    repeat_errors,
)
from fusion.sensor.unmodelled_effects import NO_INFLUENCES, ModelInfluences, stated_influences
from shaker.frf.chain import QUANTITIES, common_covariance, motion_order, ratio_unit
from shaker.frf.result import TransferFunction
from shaker.identification.measured_curves import CurveError, MeasuredCurve
from shaker.identification.oscillator import Resonance, ResonanceKind, fit_resonance
from shaker.labels import MOTION_UNITS
from shakercal._common.arrays import ComplexArray, FloatArray
from shakercal._common.notices import Notice

# Resonances in a measured transfer function: where the peaks are, and an oscillator fitted to each.

_PROMINENCE = np.log(2.0)  # of a peak in ln|H|
_SIGNIFICANT = 8.0  # standard uncertainties by which a peak exceeds its surroundings
_DOWN_TO = 1.0 / 8.0  # of the peak: lines around it that are fitted
_FEWEST_LINES = 6
_POOR_FIT = 2.0  # χ² per degree of freedom from which the rest of all other modes is fitted too
_VAGUE = 0.25  # relative standard uncertainty of the damping above which a peak is no resonance
_MOST = 12
_ROUNDS = 4  # of fitting peaks one after the other, each without all others
_DEPARTS = 3.0  # residuals over the noise, rms, from which one oscillator does not explain a peak


@dataclass(frozen=True)
class _Curve:
    """One response over its reference: values (K,), noise covariance, and common errors."""

    name: str
    transfer: TransferFunction
    value: ComplexArray
    covariance: FloatArray
    errors: dict[str, ComplexArray]
    kind: ResonanceKind

    def fit(self, lines: slice, value: ComplexArray, *, residual_terms: bool) -> Resonance:
        """Fit one oscillator to values (L,) at some lines."""
        curve = MeasuredCurve(
            self.transfer.ratio.frequency_hz[lines],
            value,
            self.covariance[lines],
            line_correlation=self.transfer.line_correlation,
            added_decay_per_s=self.transfer.added_decay_per_s,
            dof=self.transfer.ratio.dof[lines],
        )
        return fit_resonance(curve, self.kind, residual_terms=residual_terms)


def find_resonances(
    transfer: TransferFunction,
    errors: Sequence[CurveError],
    kinds: Sequence[ResonanceKind],
    u_clock: float,
    influences: ModelInfluences = NO_INFLUENCES,
) -> tuple[tuple[FoundResonance, ...], tuple[Notice, ...]]:
    """Return the resonances of every response, and notices of peaks without a fitted oscillator.

    `transfer` has the covariance of its noise only. `kinds` (C): form of an oscillator in each response. `u_clock`:
    relative standard uncertainty of the clock, and so of every frequency. `influences`: influences on a resonance that
    the record does not show.
    """
    found: list[FoundResonance] = []
    notices: list[Notice] = []
    for c, (name, kind) in enumerate(zip(transfer.ratio.channels, kinds, strict=True)):
        of_channel = {error.name: error.relative[:, c] for error in errors if np.any(error.relative[:, c] != 0.0)}
        curve = _Curve(name, transfer, transfer.ratio.value[:, c], transfer.channel_covariance(name), of_channel, kind)
        peaks, where = _peaks(curve), f"{name}/{transfer.reference}"
        for (peak, lines), mode in zip(peaks, _separated(curve, [lines for _, lines in peaks]), strict=True):
            frequency_hz = float(transfer.ratio.frequency_hz[peak])
            if isinstance(mode, str):
                notices.append(Notice(declared.PEAK_NOT_FITTED, where, frequency_hz=frequency_hz, reason=mode))
                continue
            found.append(_with_budget(curve, lines, mode, u_clock, influences))
            departs = np.sqrt(mode.fit.chi_squared / mode.fit.dof)
            if departs >= _DEPARTS:
                notices.append(Notice(declared.PEAK_DEPARTS, where, frequency_hz=frequency_hz, ratio=departs))
    return tuple(found), tuple(notices)


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
            frequency = curve.transfer.ratio.frequency_hz[lines]
            value = curve.value[lines].copy()
            for other in (*found[:index], *found[index + 1 :]):
                if isinstance(other, _Mode):
                    oscillator = replace(other.fit, residual_terms=np.zeros(2, dtype=np.complex128))
                    value -= oscillator.model(frequency, curve.transfer.added_decay_per_s)
            try:
                found[index] = _Mode(_best(curve, lines, value), value)
            except (ValueError, np.linalg.LinAlgError) as error:
                found[index] = ARGUMENT.sub("", str(error))
    return found


def _peaks(curve: _Curve) -> list[tuple[int, slice]]:
    """Return the largest significant peaks of |H|, with lines to an eighth of each."""
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
        weak = np.flatnonzero(size[low:high] < _DOWN_TO * size[peak]) + low
        low = max([low, *(weak[weak < peak] + 1)])
        high = min([high, *weak[weak > peak]])
        if high - low >= _FEWEST_LINES:
            windows.append((int(peak), slice(int(low), int(high))))
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
    curve: _Curve, lines: slice, mode: _Mode, u_clock: float, influences: ModelInfluences
) -> FoundResonance:
    """Return a fit with its uncertainty by noise, common errors, clock and influences."""
    frequency, fit = curve.transfer.ratio.frequency_hz[lines], mode.fit
    residual_terms = "constant_re" in fit.parameters
    budget = {"noise": (fit.u("frequency_hz"), fit.u("damping_ratio"))}
    for name, relative in curve.errors.items():
        moved = curve.fit(lines, mode.value * (1.0 + relative[lines]), residual_terms=residual_terms)
        budget[name] = (moved.frequency_hz - fit.frequency_hz, moved.damping_ratio - fit.damping_ratio)
    if u_clock > 0.0:
        budget["rate of the clock"] = (u_clock * fit.frequency_hz, 0.0)
    for cause, (by_frequency, by_damping) in influences.relative.items():
        budget[cause] = (by_frequency * fit.frequency_hz, by_damping * fit.damping_ratio)
    u_frequency, u_damping = np.sqrt(np.sum(np.square(list(budget.values())), axis=0))
    where, band_hz = (curve.name, curve.transfer.reference), (float(frequency[0]), float(frequency[-1]))
    return FoundResonance(*where, fit, band_hz, float(u_frequency), float(u_damping), budget)


# From a recording of a chirp, a multisine, noise or impacts to its transfer functions.

KINDS = kinds_of("transfer")
_FORCED_KINDS: dict[int, ResonanceKind] = {
    -2: "receptance",
    -1: "mobility",
    0: "accelerance",
}  # by the order of a transducer


def evaluate_transfer(
    manifest: Manifest, settings: TransferSettings, input_hashes: dict[str, str]
) -> TransferEvaluation:
    """Evaluate the transfer functions of one recording: files → estimate → corrections → resonances.

    Parameters
    ----------
    manifest
        Recording of a chirp, a multisine, noise or impacts.
    settings
        Choices of the estimate.
    input_hashes
        SHA-256 of the input files by name, for the results.

    Returns
    -------
    TransferEvaluation : transfer functions and resonances over every reference.

    Raises
    ------
    InputError : a file or key that the user has to correct.

    Examples
    --------
    >>> from fusion import TransferSettings, evaluate_transfer, load_manifest
    >>> evaluation = evaluate_transfer(load_manifest("chirp/chirp"), TransferSettings(), {})  # doctest: +SKIP
    """
    started = time.monotonic()
    manifest.check_command("transfer")
    read = read_synchronous(manifest)
    found = [_evaluated(manifest, together, settings) for together in read]
    base = next((together.aligned.base for together in read if together.aligned.base is not None), None)
    notices = [*manifest.certificate_notices, *(notice for _, of_reference in found for notice in of_reference)]
    return TransferEvaluation(
        name=manifest.name,
        manifest=manifest,
        references=tuple(result for result, _ in found),
        clocks=() if base is None else base.results(),
        notices=tuple(dict.fromkeys(notices)),
        settings=settings.as_dict(),
        input_hashes=input_hashes,
        duration_s=time.monotonic() - started,
    )


def _evaluated(
    manifest: Manifest, together: SynchronousRecord, settings: TransferSettings
) -> tuple[ReferenceResult, list[Notice]]:
    """Return the transfer functions over one reference with their notices."""
    raw = estimate_transfer(manifest, together, settings)
    reference, *responses = (channel_chain(channel, raw.ratio.frequency_hz) for channel in together.aligned.channels)
    errors, repeats = ratio_errors(reference, responses), repeat_errors(raw)
    factor = np.stack([chain.correction / reference.correction for chain in responses], axis=1)
    corrected = _converted(raw, factor, together, settings.quantity)
    moved = reference.entry.quantity in TRANSDUCERS
    kinds = ["transmissibility" if moved else _forced_kind(chain.entry, settings.quantity) for chain in responses]
    influences = stated_influences(manifest.rig, [manifest.mounting])
    resonances, peak_notices = find_resonances(corrected, (*errors, *repeats), kinds, together.u_clock, influences)
    ratio = corrected.ratio
    if errors:
        common = common_covariance(ratio.value, np.stack([error.relative for error in errors]))
        ratio = replace(ratio, covariance=ratio.covariance + common)
    result = ReferenceResult(
        name=reference.entry.name,
        transfer=replace(corrected, ratio=ratio),
        random_covariance=corrected.ratio.covariance,
        errors=(*errors, *repeats),
        resonances=tuple(_with_one_repeatability(found) for found in resonances),
    )
    return result, [*together.aligned.notices, *raw.notices, *peak_notices, *_unstated_scales([reference, *responses])]


def _with_one_repeatability(found: FoundResonance) -> FoundResonance:
    """Return a resonance with the effects of all repeats as one line of its budget."""
    of_repeats = [change for name, change in found.budget.items() if name.startswith(REPEAT)]
    if not of_repeats:
        return found
    others = {name: change for name, change in found.budget.items() if not name.startswith(REPEAT)}
    by_frequency, by_damping = np.sqrt(np.sum(np.square(of_repeats), axis=0))
    return replace(found, budget={**others, "repeatability": (float(by_frequency), float(by_damping))})


def _forced_kind(entry: ChannelEntry, quantity: Quantity | None) -> ResonanceKind:
    """Return the form of an oscillator driven by a force; no motion follows the spring."""
    if entry.quantity not in TRANSDUCERS:
        return "receptance"
    order = QUANTITIES.index(quantity) - 2 if quantity else TRANSDUCERS[entry.quantity].order
    return _FORCED_KINDS[order]


def _converted(
    raw: TransferFunction, factor: ComplexArray, together: SynchronousRecord, quantity: Quantity | None
) -> TransferFunction:
    """Return ratios times `factor` (K, C), with every motion as the requested quantity.

    With an exponential window a ratio is H(s) at s = a + jω, and a derivative multiplies it by s.
    """
    s = raw.added_decay_per_s + 2j * np.pi * raw.ratio.frequency_hz
    reference, *responses = (channel.entry for channel in together.aligned.channels)
    below, unit_below = _in_quantity(reference, together.samples.reference_unit, quantity)
    factors, units = factor.copy(), []
    for c, (entry, unit) in enumerate(zip(responses, together.samples.unit, strict=True)):
        above, unit_above = _in_quantity(entry, unit, quantity)
        factors[:, c] *= s ** (above - below)
        units.append(ratio_unit(unit_above, unit_below))
    return replace(raw, ratio=raw.ratio.scaled(factors, units))


def _in_quantity(entry: ChannelEntry, unit: str, quantity: Quantity | None) -> tuple[int, str]:
    """Return the number of differentiations of a channel (0: no motion) and its unit."""
    if quantity is None or entry.quantity not in TRANSDUCERS:
        return 0, unit
    family, have = motion_order(unit)
    want = QUANTITIES.index(quantity)
    return want - have, MOTION_UNITS[family][want]


def _unstated_scales(chains: Sequence[ChannelChain]) -> list[Notice]:
    """Return a notice of the channels without a stated uncertainty of the scale."""
    unstated = [c.entry.name for c in chains if not (scale_is_stated(c.entry, c.response) or c.entry.common)]
    channels = ", ".join(unstated)
    return [Notice(declared.SCALE_UNCERTAINTY_NOT_STATED, "scale_uncertainty", channels=channels)] if channels else []
