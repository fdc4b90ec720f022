"""The estimator of a recording: by rest, period, blows or averaged spectra."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Literal

from fusion.errors import InputError
from fusion.recording.load import Manifest
from fusion.sensor import response_notices as declared
from fusion.sensor.transfer.transfer_records import SynchronousRecord, TransferSettings
from shaker.frf.impact import transfer_impact
from shaker.frf.periodic import transfer_periodic
from shaker.frf.random import transfer_random
from shaker.frf.rest import RestError, find_bursts
from shaker.frf.result import TransferFunction, TransferRecord
from shaker.frf.sweeps import transfer_from_rest, usable_band
from shakercal._common.notices import Notice

AVERAGED: tuple[Literal["auto", "local", "H1", "H2", "Hv"], ...] = ("auto", "local", "H1", "H2", "Hv")
"""Estimators of averaged spectra, the default first."""
_SEGMENTS = 16  # segments of a record if no line spacing is requested
_BLOW_S = 1.0  # window around a blow if no line spacing is requested
_REPEATS = 2  # whole periods, or bursts, from which their scatter shows the noise
_CONTINUOUS = 0.9  # share of a record from which noise is no burst
_KEYS = {
    "period_s": "excitation.period",
    "band_hz": "excitation.band",
    "record": "excitation.reference",
    "records": "daq.repeats",
    "reference": "excitation.reference",
    "resolution_hz": "--resolution",
    "spacing_hz": "--resolution",
    "duration_s": "--resolution",
}
"""Keys and options of the arguments that an estimate may refuse."""


def estimate_transfer(manifest: Manifest, together: SynchronousRecord, settings: TransferSettings) -> TransferFunction:
    """Return the transfer functions as recorded, by the selected estimator or that of the excitation.

    Records from rest to rest, in one file or several: errors in variables over repeats. With a period: ratio of the
    means over whole periods. Impacts: windows around the blows. Otherwise local polynomials, or averaged spectra of
    overlapping segments. Raises `InputError` at the key or the option to correct.
    """
    excitation, record, band = manifest.excitation, together.samples, _band(manifest, together)
    repeats = excitation.period is not None or excitation.kind == "multisine"
    periodic = settings.estimator == "periodic" or (settings.estimator == "auto" and repeats)
    if periodic and excitation.period is None:
        expected = "the period in s, which the periodic estimate requires"
        raise InputError(declared.MISSING_TRANSFER_ENTRY, manifest.path, "excitation.period", expected=expected)
    unrest = None
    try:
        if settings.estimator == "rest" or together.repeats:
            return transfer_from_rest((record, *together.repeats), spacing_hz=settings.resolution_hz, band_hz=band)
        if settings.estimator == "auto":
            at_rest, unrest = _at_rest(manifest, record, settings, band)
            if at_rest is not None:
                return at_rest
        if periodic and excitation.period is not None:
            return transfer_periodic(record, excitation.period, settle_periods=excitation.settle_periods, band_hz=band)
        found = _averaged(manifest, record, settings, band)
    except RestError as error:
        file, name = _file_of(manifest, error)
        percent = 100.0 * error.level
        raise InputError(declared.NOT_FROM_REST, file, name, end=error.end, percent=percent) from error
    except ValueError as error:
        argument = str(error).partition(":")[0]
        if periodic and argument == "record":
            key, found_s, channel = "excitation.period", excitation.period or 0.0, record.reference_name
            raise InputError(
                declared.PERIOD_WITHOUT_SIGNAL, manifest.path, key, found_s=found_s, channel=channel
            ) from error
        raise InputError.from_exception(error, manifest.path, _KEYS.get(argument, "excitation")) from error
    if unrest is not None:
        return replace(found, notices=(*found.notices, unrest.notice))
    if excitation.kind != "chirp" or excitation.period is not None:
        return found
    return replace(found, notices=(*found.notices, Notice(declared.CHIRP_WITHOUT_PERIOD, "excitation.period")))


def _at_rest(
    manifest: Manifest, record: TransferRecord, settings: TransferSettings, band_hz: tuple[float, float] | None
) -> tuple[TransferFunction | None, RestError | None]:
    """Return the estimate from rest to rest, or why a chirp has none.

    It suits chirps of fewer than two whole periods, and noise in bursts.
    """
    excitation, samples = manifest.excitation, len(record.reference)
    length_s = samples / record.sample_rate_hz
    whole = 0.0 if excitation.period is None else length_s / excitation.period - excitation.settle_periods
    if excitation.kind not in ("chirp", "noise") or whole >= _REPEATS:
        return None, None
    try:
        if excitation.kind == "noise":
            bursts = find_bursts(record, usable_band(record, band_hz))
            if len(bursts) < _REPEATS and bursts[0].last - bursts[0].first > _CONTINUOUS * samples:
                return None, None
        return transfer_from_rest((record,), spacing_hz=settings.resolution_hz, band_hz=band_hz), None
    except RestError as error:
        return None, error if excitation.kind == "chirp" and excitation.period is None else None
    except ValueError:  # the other estimators say what is wrong
        return None, None


def _file_of(manifest: Manifest, error: RestError) -> tuple[Path, str]:
    """Return file and stored name of the channel that moves."""
    daq, entry = next((daq, entry) for daq in manifest.daq for entry in daq.channel if entry.name == error.channel)
    return (daq.file, *daq.further_files)[error.record], entry.stored_name


def _band(manifest: Manifest, together: SynchronousRecord) -> tuple[float, float] | None:
    """Return the band to evaluate: the excitation's, and no more than the samples allow."""
    band, highest = manifest.excitation.band, together.aligned.highest_hz
    if highest is None:
        return band
    if band is not None and band[0] >= highest:
        path, (low_hz, high_hz) = manifest.path, band
        raise InputError(
            declared.BAND_ABOVE_LIMIT, path, "excitation.band", limit_hz=highest, low_hz=low_hz, high_hz=high_hz
        )
    return (0.0, highest) if band is None else (band[0], min(band[1], highest))


def _averaged(
    manifest: Manifest, record: TransferRecord, settings: TransferSettings, band_hz: tuple[float, float] | None
) -> TransferFunction:
    """Return the transfer functions from averaged spectra of blows or segments, after settling."""
    excitation, chosen = manifest.excitation, settings.estimator
    estimator = next((one for one in AVERAGED if one == chosen), AVERAGED[0])
    left_out = round(excitation.settle_periods * (excitation.period or 0.0) * record.sample_rate_hz)
    record = replace(record, reference=record.reference[left_out:], responses=record.responses[left_out:])
    length_s = len(record.reference) / record.sample_rate_hz
    if excitation.kind == "impact":
        window_s = min(_BLOW_S, 0.5 * length_s) if settings.resolution_hz is None else 1.0 / settings.resolution_hz
        advised = "auto" if estimator == "local" else estimator
        return transfer_impact(record, window_s, estimator=advised, band_hz=band_hz)
    resolution_hz = settings.resolution_hz or _SEGMENTS / length_s
    return transfer_random(record, resolution_hz, estimator=estimator, band_hz=band_hz)
