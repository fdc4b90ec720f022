"""From a recording of a chirp, a multisine, noise or impacts to its transfer functions."""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from fusion.errors import InputError
from fusion.manifest import ChannelEntry, Manifest
from fusion.notices import Notice
from fusion.provenance import versions
from fusion.transfer.errors import ChannelChain, channel_chain, ratio_errors
from fusion.transfer.estimate import estimated
from fusion.transfer.records import Located, Together, read_together
from fusion.transfer.resonances import find_resonances
from fusion.transfer.result import CommonError, Quantity, ReferenceResult, TransferEvaluation, TransferSettings
from shaker._checks import ComplexArray
from shaker.models.resonance.oscillator import Kind
from shaker.signals.chain import MOTION_UNITS, QUANTITIES, common_covariance, motion_order, ratio_unit
from shaker.signals.transfer import TransferFunction

KINDS = ("chirp", "multisine", "noise", "impact")
_FORCED_KIND: dict[int, Kind] = {0: "receptance", 1: "mobility", 2: "accelerance"}


def evaluate_transfer(
    manifest: Manifest, settings: TransferSettings, input_hashes: dict[str, str]
) -> TransferEvaluation:
    """Return the transfer functions of one recording: files → estimate → delay, response and quantity → resonances.

    Raises `InputError` for what the user can mend in the files.
    """
    started = time.monotonic()
    check_kind(manifest)
    read = read_together(manifest)
    found = [_evaluated(manifest, together, settings) for together in read]
    base = next((together.base for together in read if together.base is not None), None)
    notices = [notice for _, told in found for notice in told]
    return TransferEvaluation(
        manifest=manifest,
        references=tuple(result for result, _ in found),
        clocks=() if base is None else base.results(),
        notices=tuple(dict.fromkeys(notices)),
        settings=settings.as_dict(),
        versions=versions(),
        input_hashes=input_hashes,
        duration_s=time.monotonic() - started,
    )


def check_kind(manifest: Manifest) -> None:
    """Refuse recordings that this command does not evaluate."""
    excitation = manifest.excitation
    if excitation.kind not in KINDS:
        others = {"sine": "run", "rotation": "rotate", "step": "step"}
        command = others.get(excitation.kind)
        hint = "" if command is None else f"; shakercal {command} evaluates {excitation.kind}s"
        expected = f"{', '.join(KINDS[:-1])} or {KINDS[-1]}, the kinds that shakercal transfer evaluates{hint}"
        raise InputError(manifest.path, "excitation.kind", found=excitation.kind, expected=expected)
    if manifest.take:
        expected = "no [[take]] blocks, since shakercal transfer evaluates what was recorded at once"
        raise InputError(manifest.path, "take", found=f"{len(manifest.take)}", expected=expected)


def _evaluated(
    manifest: Manifest, together: Together, settings: TransferSettings
) -> tuple[ReferenceResult, list[Notice]]:
    """Return the transfer functions over one reference with what is to be said of them."""
    raw = estimated(manifest, together, settings)
    reference = _chain(together.reference, raw)
    responses = [_chain(item, raw) for item in together.responses]
    errors = ratio_errors(reference, responses)
    factor = np.stack([chain.correction / reference.correction for chain in responses], axis=1)
    corrected = _converted(raw, factor, together, settings.quantity)
    kinds = [_kind(reference.entry, chain.entry, settings.quantity) for chain in responses]
    resonances, told = find_resonances(corrected, errors, kinds, together.u_clock)
    result = ReferenceResult(
        name=reference.entry.name,
        transfer=_with_errors(corrected, errors),
        random_covariance=corrected.ratio.covariance,
        errors=errors,
        resonances=resonances,
    )
    return result, [*together.notices, *raw.notices, *told, *_silent([reference, *responses])]


def _chain(channel: Located, raw: TransferFunction) -> ChannelChain:
    """Return a channel's chain at the lines found."""
    return channel_chain(channel.entry, raw.ratio.frequency_hz, channel.record.entry.name, channel.u_clock_s)


def _converted(
    raw: TransferFunction, factor: ComplexArray, together: Together, quantity: Quantity | None
) -> TransferFunction:
    """Return ratios times `factor` (K, C), every motion as the quantity wanted.

    Behind an exponential window a ratio is H(s) at s = a + jω, and a derivative multiplies it by s.
    """
    s = raw.added_decay_per_s + 2j * np.pi * raw.ratio.frequency_hz
    below, unit_below = _as_wanted(together.reference.entry, together.samples.reference_unit, quantity)
    factors, units = factor.copy(), []
    for c, (item, unit) in enumerate(zip(together.responses, together.samples.unit, strict=True)):
        above, unit_above = _as_wanted(item.entry, unit, quantity)
        factors[:, c] *= s ** (above - below)
        units.append(ratio_unit(unit_above, unit_below))
    return replace(raw, ratio=raw.ratio.scaled(factors, units))


def _as_wanted(entry: ChannelEntry, unit: str, quantity: Quantity | None) -> tuple[int, str]:
    """Return how many times a channel is to be differentiated, and the unit it then has; 0 for what is no motion."""
    if quantity is None or entry.quantity not in ChannelEntry.MOTION:
        return 0, unit
    family, have = motion_order(unit)
    want = QUANTITIES.index(quantity)
    return want - have, MOTION_UNITS[family][want]


def _kind(reference: ChannelEntry, response: ChannelEntry, quantity: Quantity | None) -> Kind:
    """Return which form one oscillator takes: a base that moves, or a force on the mass."""
    if reference.quantity in ChannelEntry.MOTION:
        return "transmissibility"
    if response.quantity not in QUANTITIES:
        return "receptance"
    return _FORCED_KIND[QUANTITIES.index(quantity or response.quantity)]


def _with_errors(transfer: TransferFunction, errors: Sequence[CommonError]) -> TransferFunction:
    """Return a transfer function with the covariance of noise and common errors together."""
    if not errors:
        return transfer
    ratio = transfer.ratio
    common = common_covariance(ratio.value, np.stack([error.relative for error in errors]))
    return replace(transfer, ratio=replace(ratio, covariance=ratio.covariance + common))


def _silent(chains: Sequence[ChannelChain]) -> list[Notice]:
    """Name the channels whose scale is taken as exact because nothing else is stated."""
    names = [
        chain.entry.name
        for chain in chains
        if not (chain.entry.scale_uncertainty or chain.entry.individual_uncertainty or chain.entry.common)
    ]
    if not names:
        return []
    text = f"no uncertainty of the scale is stated for {', '.join(names)}: the uncertainties hold without it"
    return [Notice("warning", text, "scale_uncertainty")]
