"""One recording: what its outputs show, which of them is driven, and the model of that."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from fusion.errors import InputError
from fusion.manifest import Manifest
from fusion.notices import Notice
from fusion.step.records import read_step
from fusion.step.result import Release
from fusion.step.settings import StepSettings
from shaker.models.step.reading import Reading
from shaker.models.step.record import StepRecord
from shaker.models.step.release import read_releases
from shaker.models.step_fit.fit import fit_step
from shaker.models.step_fit.result import StepFit

CLEAR = 4.0
"""Change of the driven output, over its standard uncertainty, below which there is no step."""


def read_recording(manifest: Manifest) -> tuple[Release, tuple[Notice, ...]]:
    """Return a recording with the readings of its outputs, not fitted yet.

    Raises `InputError` for a record without a step in the driven output, and for one that was clipped.
    """
    found = read_step(manifest)
    record = replace(found.record, u_amplitude=0.0)
    driven = _driven(manifest, record)
    readings = {reading.channel: reading for reading in _read(manifest, record)}
    _check(manifest, readings[driven])
    others = [reading for reading in readings.values() if reading.channel != driven and not reading.clipped]
    cut = [reading.channel for reading in readings.values() if reading.channel != driven and reading.clipped]
    told = [Notice("warning", f"output {channel} was clipped and is left out", record.name) for channel in cut]
    release = Release(found, driven, (readings[driven], *others), None)
    return release, (*found.notices, *told, *_remarks(readings[driven], record))


def fit_release(
    release: Release, settings: StepSettings, structure: tuple[int, int] | None = None
) -> tuple[Release, tuple[Notice, ...]]:
    """Return a release with its model, of a given structure (modes, real poles) where that is given.

    Without one where none is found: then a notice says why.
    """
    modes, real_poles = structure or (settings.modes, settings.real_poles)
    record = replace(release.input.record, u_amplitude=0.0)
    try:
        fit = fit_step(
            record,
            release.driven,
            reading=release.reading,
            modes=modes,
            real_poles=real_poles,
            method="arx" if settings.method == "arx" else "pencil",
            release=None if settings.release == "auto" else settings.release,
        )
    except (ValueError, ArithmeticError, np.linalg.LinAlgError) as error:
        return release, (Notice("warning", f"no model of {release.driven} was found: {error}", release.name),)
    return replace(release, fit=fit), ()


def structure_of(fit: StepFit) -> tuple[int, int] | None:
    """Return the numbers of modes and of real poles of a model, None where it has no modal form."""
    return None if fit.model is None else (len(fit.model.frequency_hz), len(fit.model.real_hz))


def _driven(manifest: Manifest, record: StepRecord) -> str:
    """The output of the driven component: the one of its name, of outputs named otherwise the one that changes most."""
    if record.component in record.channels:
        return record.component
    sensor = manifest.rig.sensor
    if sensor is not None and record.component in sensor.channels:
        expected = f"the output {record.component}, the component that is driven"
        raise InputError(manifest.path, "daq.channel", found=", ".join(record.channels), expected=expected)
    size = max(1, record.samples.shape[1] // 20)
    change = record.samples[:, -size:].mean(axis=1) - record.samples[:, :size].mean(axis=1)
    return record.channels[int(np.argmax(np.abs(change)))]


def _read(manifest: Manifest, record: StepRecord) -> tuple[Reading, ...]:
    """What the outputs show; without a step the recording cannot be used."""
    try:
        return read_releases(record)
    except ValueError as error:
        key = "daq.channel" if record.onset_s is None else "excitation.onset"
        raise InputError.told_by(error, manifest.path, key) from error


def _check(manifest: Manifest, reading: Reading) -> None:
    """Refuse a driven output that was clipped, or that does not change."""
    entries = [entry for daq in manifest.daq for entry in daq.channel if entry.quantity == "output"]
    entry = next(entry for entry in entries if reading.channel == (entry.channel or entry.name))
    key = f"daq.channel.{entry.name}"
    if reading.clipped:
        found, expected = "samples that stay at the limit of the range", "an output that was not clipped"
        raise InputError(manifest.path, key, found=found, expected=expected)
    if abs(reading.static_gain) <= CLEAR * reading.u_static_gain:
        change = f"{reading.steady - reading.baseline:.2g} {reading.unit}, no more than noise"
        expected = f"a step in the output that {reading.component} drives"
        raise InputError(manifest.path, key, found=f"a change of {change}", expected=expected)


def _remarks(reading: Reading, record: StepRecord) -> Sequence[Notice]:
    """The remarks of a reading, with the recording they belong to."""
    return [Notice(n.severity, f"{reading.channel}: {n.text}", record.name) for n in reading.notices]
