"""Evaluation of recordings: corrected transfer functions and resonances."""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from fusion.instruments.channel import scale_is_stated
from fusion.recording.excitation import kinds_of
from fusion.recording.load import Manifest
from fusion.recording.manifest import ChannelEntry
from fusion.recording.transducer import TRANSDUCERS
from fusion.sensor import response_notices as declared
from fusion.sensor.transfer.resonances import find_resonances
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
from fusion.sensor.unmodelled_effects import stated_influences
from shaker.frf.chain import QUANTITIES, common_covariance, motion_order, ratio_unit
from shaker.frf.distortion import harmonics_above_band
from shaker.frf.periodic import find_period, period_phasors
from shaker.frf.result import TransferFunction
from shaker.identification.oscillator import ResonanceKind
from shaker.labels import MOTION_UNITS
from shakercal._common.arrays import ComplexArray
from shakercal._common.notices import Notice

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
    base = _base_acceleration(manifest, together, raw) if moved else None
    resonances, filters, peak_notices = find_resonances(
        corrected, (*errors, *repeats), kinds, together.u_clock, influences, base
    )
    ratio = corrected.ratio
    if errors or filters:
        common = common_covariance(ratio.value, np.stack([error.relative for error in (*errors, *filters)]))
        ratio = replace(ratio, covariance=ratio.covariance + common)
    result = ReferenceResult(
        name=reference.entry.name,
        transfer=replace(corrected, ratio=ratio),
        random_covariance=corrected.ratio.covariance,
        errors=(*errors, *repeats),
        resonances=tuple(_with_one_repeatability(found) for found in resonances),
        peaks=tuple(np.abs(together.samples.responses - together.samples.responses.mean(axis=0)).max(axis=0).tolist()),
    )
    notices = [*raw.notices, *_distortions(manifest, together, raw), *peak_notices]
    return result, [*together.aligned.notices, *notices, *_unstated_scales([reference, *responses])]


def _base_acceleration(manifest: Manifest, together: SynchronousRecord, raw: TransferFunction) -> ComplexArray | None:
    """Return phasors (K,) of a periodic base motion as accelerations, None for other excitations."""
    period_s, rate = manifest.excitation.period, together.samples.sample_rate_hz
    if period_s is None or raw.estimator != "periodic":
        return None
    reference = together.samples.reference
    period = find_period(reference, period_s * rate, manifest.excitation.settle_periods)
    frequency = raw.ratio.frequency_hz
    seen = period_phasors(reference[:, None], period, (0.99 * frequency[0] / rate, 1.01 * frequency[-1] / rate))
    harmonic = np.rint(frequency * period.samples / rate).astype(np.int64)
    order = TRANSDUCERS[together.aligned.channels[0].entry.quantity].order
    return np.asarray(seen.value.mean(axis=0)[harmonic - seen.harmonic[0], 0] * (2j * np.pi * frequency) ** -order)


def _distortions(manifest: Manifest, together: SynchronousRecord, raw: TransferFunction) -> list[Notice]:
    """Return notices of harmonics above the band of a periodic excitation."""
    excitation, highest_hz = manifest.excitation, float(raw.ratio.frequency_hz[-1])
    if excitation.period is None or raw.estimator != "periodic":
        return []
    return list(harmonics_above_band(together.samples, excitation.period, excitation.settle_periods, highest_hz))


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
