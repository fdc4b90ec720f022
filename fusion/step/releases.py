"""One recording: what its outputs show, which of them is driven, and the model of that."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from fusion.errors import InputError
from fusion.manifest import Manifest
from fusion.notices import Notice
from fusion.step.records import StepInput, read_step
from fusion.step.result import Release
from fusion.step.settings import StepSettings
from shaker.models.step.reading import Reading
from shaker.models.step.record import StepRecord
from shaker.models.step.release import read_release
from shaker.models.step_fit.fit import fit_step
from shaker.models.step_fit.result import StepFit


def read_recording(manifest: Manifest) -> tuple[Release, tuple[Notice, ...]]:
    """Return a recording with the readings of its outputs, not fitted yet.

    Raises `InputError` for a record without a step in the driven output, and for one that was clipped.
    """
    found = read_step(manifest)
    record = replace(found.record, u_amplitude=0.0)
    driven = _driven(manifest, record)
    reading = _read(found, record, driven)
    if reading.clipped:
        entry = next(e for daq in manifest.daq for e in daq.channel if driven in (e.channel, e.name))
        raise InputError(
            manifest.path,
            f"daq.channel.{entry.name}",
            found="samples that stay at the limit of the range",
            expected="an output that was not clipped",
        )
    others, notices = [], list(found.notices)
    for channel in record.channels:
        if channel == driven:
            continue
        try:
            other = read_release(replace(record, onset_s=reading.onset_s), channel)
        except ValueError as error:
            notices.append(Notice("info", f"output {channel} is left out: {error}", record.name))
            continue
        if other.clipped:
            notices.append(Notice("warning", f"output {channel} was clipped and is left out", record.name))
        else:
            others.append(other)
    told = (*notices, *_at(reading, record))
    return Release(found, driven, (reading, *others), None), told


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
    told = tuple(Notice(n.severity, f"{release.driven}: {n.text}", release.name) for n in fit.notices)
    return replace(release, fit=fit), told


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


def _read(found: StepInput, record: StepRecord, channel: str) -> Reading:
    """What the driven output shows; without a step the recording cannot be used."""
    try:
        return read_release(record, channel)
    except ValueError as error:
        manifest = found.manifest
        key = "excitation.onset" if record.onset_s is not None and "onset" in str(error) else f"daq.channel.{channel}"
        raise InputError.told_by(error, manifest.path, key) from error


def _at(reading: Reading, record: StepRecord) -> Sequence[Notice]:
    """The remarks of a reading, with the recording they belong to."""
    return [Notice(n.severity, f"{reading.channel}: {n.text}", record.name) for n in reading.notices]
