"""A recording whose outputs go through their filters."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from fusion.channels import channel_unit
from fusion.compensate.result import CompensatedChannel, CompensatedRecording, FloatArray, SubjectResult
from fusion.compensate.sources import Sources
from fusion.compensate.wish import COMMAND, Wish
from fusion.errors import InputError
from fusion.manifest import Manifest, find_recordings, load_manifest
from fusion.notices import Notice
from fusion.records import read_daqs
from fusion.transfer.records import align
from shaker.models.compensation.uncertainty import CompensationWithUncertainty

NOISE_FACTOR = float(np.sqrt(20.0))
"""Standard deviation of third differences over that of white noise: √(1 + 9 + 9 + 1)."""
MEDIAN_TO_STD = 1.482602218505602
STATED = "sensor"


@dataclass(frozen=True)
class OutputRecord:
    """Outputs `values` (C, N) of `channels` (C,) of a recording, at `start_s` + n/`sample_rate_hz`."""

    manifest: Manifest
    channels: tuple[str, ...]
    unit: str
    values: FloatArray
    sample_rate_hz: float
    start_s: float
    notices: tuple[Notice, ...]


def read_outputs(path: Path, *, allow_outside: bool = False) -> OutputRecord:
    """Read every output channel of one recording of any kind on one time base; raises `InputError`."""
    recordings = find_recordings(path)
    if len(recordings) != 1:
        raise InputError(path, "", found=f"{len(recordings)} recordings", expected="one recording for --apply")
    manifest = load_manifest(recordings[0], allow_outside=allow_outside)
    if manifest.take:
        raise InputError(manifest.path, "take", found=f"{len(manifest.take)} takes", expected="a recording of one take")
    wanted = [(daq.name, entry) for daq in manifest.daq for entry in daq.channel if entry.quantity == "output"]
    if not wanted:
        raise InputError(manifest.path, "daq.channel", found="none", expected='a channel with quantity = "output"')
    found = align(manifest, read_daqs(manifest), wanted, "daq")
    names = tuple(entry.channel or entry.name for _, entry in wanted)
    unit = channel_unit(manifest, wanted[0][1])
    return OutputRecord(manifest, names, unit, np.stack(found.values), found.rate_hz, found.start_s, found.notices)


def rig_load_mass(manifest: Manifest) -> float | None:
    """Return the mass in kg that the rig says stands on the sensor, None where it names no load."""
    rig = manifest.rig
    if rig.load is None:
        return None
    return rig.load.mass + sum(part.mass for part in rig.part if part.body == "load")


def apply(
    record: OutputRecord, results: Sequence[SubjectResult], wish: Wish
) -> tuple[CompensatedRecording, tuple[Notice, ...]]:
    """Run every output through the filter of its channel; a stated sensor's filter is that of all outputs.

    Each filter starts settled at the mean of the record's first target period. The noise of the output is read from its
    third differences.
    """
    filtered, skipped = [], []
    for name, values in zip(record.channels, record.values, strict=True):
        own = [one for one in results if one.subject.channel in (name, STATED)]
        if own:
            filtered.append(_channel(name, values, record, own[0], wish))
        else:
            skipped.append(name)
    if not filtered:
        known = ", ".join(one.subject.channel for one in results)
        found = f"outputs {', '.join(record.channels)}"
        raise InputError(record.manifest.path, "daq.channel", found=found, expected=f"one of the channels {known}")
    notices = record.notices
    if skipped:
        text = f"left out, since no filter is for it: {', '.join(skipped)}"
        notices = (*notices, Notice("info", text, record.manifest.folder.name))
    name = record.manifest.folder.name
    return CompensatedRecording(name, record.sample_rate_hz, record.start_s, tuple(filtered)), notices


def _channel(
    name: str, values: FloatArray, record: OutputRecord, result: SubjectResult, wish: Wish
) -> CompensatedChannel:
    """One output after its filter."""
    subject, found = result.subject, result.filters[0]
    if subject.channel != STATED and subject.unit != record.unit:
        expected = f"{subject.unit}, the unit of the model of {name}"
        raise InputError(record.manifest.path, "sensor.unit", found=record.unit, expected=expected)
    if found.sections.sample_rate_hz != record.sample_rate_hz:
        told = f"{found.sections.sample_rate_hz:g} Hz"
        raise InputError(
            record.manifest.path,
            "daq",
            found=f"{record.sample_rate_hz:g} Hz",
            expected=f"samples at {told}, the rate of the filter",
        )
    first = max(1, min(len(values), round(record.sample_rate_hz / found.compensation.target.frequency_hz)))
    run = CompensationWithUncertainty(
        found.compensation,
        record.sample_rate_hz,
        wish.discretisation,
        level=float(np.mean(values[:first])),
        noise=white_noise(values),
    )
    signal = run(values[None])
    unit = record.unit if not wish.calibrated else result.output_unit
    return CompensatedChannel(name, unit, found.sections.gain * values, signal.value[0], signal.u[0], signal.u_noise)


def white_noise(values: FloatArray) -> float:
    """Return the standard deviation of the noise of samples (N,) by their third differences, robust against steps."""
    if len(values) < 8:
        return 0.0
    return float(MEDIAN_TO_STD * np.median(np.abs(np.diff(values, 3))) / NOISE_FACTOR)


def with_load(wish: Wish, sources: Sources, record: OutputRecord | None) -> Wish:
    """Return the wish with the load of the rig where a recording is filtered by models over the load."""
    if record is None or not any(subject.is_scheduled for subject in sources.subjects):
        return wish
    if len(wish.load_masses) > 1:
        expected = "one load mass with --apply, that of the recording"
        raise InputError(COMMAND, "--load-mass", found=f"{len(wish.load_masses)}", expected=expected)
    mass = rig_load_mass(record.manifest)
    return wish if wish.load_masses or mass is None else replace(wish, load_masses=(mass,))
