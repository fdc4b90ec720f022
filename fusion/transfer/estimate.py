"""Which estimate a recording calls for, and what the user is told where it cannot be made."""

from __future__ import annotations

from dataclasses import replace

from fusion.errors import InputError
from fusion.manifest import Manifest
from fusion.notices import Notice
from fusion.transfer.records import Together
from fusion.transfer.result import TransferSettings
from shaker.signals.transfer import (
    TransferFunction,
    TransferRecord,
    transfer_impact,
    transfer_periodic,
    transfer_random,
)

_SEGMENTS = 16  # segments beside each other in a record where no line spacing is wanted
_BLOW_S = 1.0  # window around a blow where no line spacing is wanted
_KEYS = {
    "period_s": "excitation.period",
    "band_hz": "excitation.band",
    "record": "excitation.reference",
    "reference": "excitation.reference",
    "resolution_hz": "--resolution",
    "duration_s": "--resolution",
}
"""Where the user can mend what an argument of the estimate says."""


def estimated(manifest: Manifest, together: Together, settings: TransferSettings) -> TransferFunction:
    """Return the transfer functions as recorded, by the estimator wanted or by the excitation's kind.

    With a period: ratio of the means over whole periods. Impacts: windows around the blows. Else local polynomials, or
    averaged spectra of overlapping segments. Raises `InputError` naming the manifest's key, or the option, at fault.
    """
    excitation, record, band = manifest.excitation, together.samples, _band(manifest, together)
    repeats = excitation.period is not None or excitation.kind == "multisine"
    periodic = settings.estimator == "periodic" or (settings.estimator == "auto" and repeats)
    if periodic and excitation.period is None:
        expected = "the period in s, which the periodic estimate needs"
        raise InputError(manifest.path, "excitation.period", found="nothing", expected=expected)
    try:
        if periodic and excitation.period is not None:
            return transfer_periodic(record, excitation.period, settle_periods=excitation.settle_periods, band_hz=band)
        found = _averaged(_settled(manifest, record), settings, band, blows=excitation.kind == "impact")
    except ValueError as error:
        argument = str(error).partition(":")[0]
        if periodic and argument == "record":
            found_text = f"{excitation.period:g} s, at whose harmonics {record.reference_name} holds only noise"
            expected = "the period with which the excitation repeats"
            raise InputError(manifest.path, "excitation.period", found=found_text, expected=expected) from error
        raise InputError.told_by(error, manifest.path, _KEYS.get(argument, "excitation")) from error
    return replace(found, notices=(*found.notices, *_single_sweep(manifest)))


def _band(manifest: Manifest, together: Together) -> tuple[float, float] | None:
    """Return the band to evaluate: the excitation's, and no more than the samples allow."""
    band, highest = manifest.excitation.band, together.highest_hz
    if highest is None:
        return band
    if band is not None and band[0] >= highest:
        expected = f"a band that begins below {highest:.6g} Hz, what the slowest channel can show"
        raise InputError(manifest.path, "excitation.band", found=f"{band[0]:g} to {band[1]:g} Hz", expected=expected)
    return (0.0, highest) if band is None else (band[0], min(band[1], highest))


def _settled(manifest: Manifest, record: TransferRecord) -> TransferRecord:
    """Return a record without the periods in which it settles."""
    excitation = manifest.excitation
    left_out = round(excitation.settle_periods * (excitation.period or 0.0) * record.sample_rate_hz)
    return replace(record, reference=record.reference[left_out:], responses=record.responses[left_out:])


def _averaged(
    record: TransferRecord, settings: TransferSettings, band_hz: tuple[float, float] | None, *, blows: bool
) -> TransferFunction:
    """Return the transfer functions from averaged spectra, of blows or of segments."""
    estimator = "auto" if settings.estimator == "periodic" else settings.estimator
    length_s = len(record.reference) / record.sample_rate_hz
    if blows:
        window_s = min(_BLOW_S, 0.5 * length_s) if settings.resolution_hz is None else 1.0 / settings.resolution_hz
        advised = "auto" if estimator == "local" else estimator
        return transfer_impact(record, window_s, estimator=advised, band_hz=band_hz)
    resolution_hz = settings.resolution_hz or _SEGMENTS / length_s
    return transfer_random(record, resolution_hz, estimator=estimator, band_hz=band_hz)


def _single_sweep(manifest: Manifest) -> tuple[Notice, ...]:
    """Say what a chirp without a period loses."""
    if manifest.excitation.kind != "chirp" or manifest.excitation.period is not None:
        return ()
    text = (
        "no period is stated, so the chirp is taken like noise, which leaves its uncertainty to neighbouring lines; of "
        "a chirp that repeats, state the period"
    )
    return (Notice("warning", text, "excitation.period"),)
