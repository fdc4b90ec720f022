"""The record of a release from a recording: outputs and force on one time base, in their units."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from fusion.channels import channel_unit
from fusion.errors import InputError
from fusion.manifest import ChannelEntry, Manifest
from fusion.notices import Notice
from fusion.records import read_daqs
from fusion.transfer.records import Aligned, align
from shaker.models.step.record import StepRecord
from shaker.signals.resample import kernel_reach, resampled

KIND = "step"


@dataclass(frozen=True)
class StepInput:
    """A recording, its record, and what had to be done to read it."""

    manifest: Manifest
    record: StepRecord
    notices: tuple[Notice, ...]


def read_step_record(manifest: Manifest) -> StepRecord:
    """Return every output channel of a recording of kind step on one time base, and its force where it names one.

    Time is counted on the first block's clock from its earliest sample. Raises `InputError`.
    """
    return read_step(manifest).record


def read_step(manifest: Manifest) -> StepInput:
    """Return the record of a recording of kind step, and what had to be done to read it; raises `InputError`."""
    check_kind(manifest)
    outputs, force = _outputs(manifest), _force(manifest)
    wanted = outputs if force is None else [*outputs, force]
    found = _without_delays(align(manifest, read_daqs(manifest), wanted, "daq"))
    excitation = manifest.excitation
    if excitation.component is None or excitation.step_amplitude is None:
        raise InputError(manifest.path, "excitation.component", found="nothing", expected="the load of the step")
    record = StepRecord(
        name=manifest.folder.name,
        channels=tuple(entry.channel or entry.name for _, entry in outputs),
        unit=channel_unit(manifest, outputs[0][1]),
        samples=np.stack(found.values[: len(outputs)]),
        sample_rate_hz=found.rate_hz,
        component=excitation.component,
        amplitude=excitation.step_amplitude,
        u_amplitude=excitation.step_uncertainty,
        start_s=found.start_s,
        force=None if force is None else found.values[-1],
        onset_s=excitation.onset,
        release=excitation.release or "",
    )
    _check_onset(manifest, record)
    return StepInput(manifest, record, (*found.notices, *_of_chains(found, record)))


def check_kind(manifest: Manifest) -> None:
    """Refuse recordings that are no step responses, and several takes in one recording."""
    kind = manifest.excitation.kind
    if kind != KIND:
        expected = f"{KIND}, the kind that shakercal step evaluates"
        raise InputError(manifest.path, "excitation.kind", found=kind, expected=expected)
    if manifest.take:
        expected = "one release per recording, in a folder of its own"
        raise InputError(manifest.path, "take", found=f"{len(manifest.take)} takes", expected=expected)


def _outputs(manifest: Manifest) -> list[tuple[str, ChannelEntry]]:
    """Blocks and entries of the sensor's output channels."""
    found = [(daq.name, entry) for daq in manifest.daq for entry in daq.channel if entry.quantity == "output"]
    if not found:
        raise InputError(manifest.path, "daq.channel", found="none", expected='a channel with quantity = "output"')
    names = [entry.channel or entry.name for _, entry in found]
    twice = next((name for name in names if names.count(name) > 1), None)
    if twice is not None:
        expected = "one record of every output of the sensor"
        raise InputError(manifest.path, "daq.channel", found=f'output "{twice}" twice', expected=expected)
    return found


def _force(manifest: Manifest) -> tuple[str, ChannelEntry] | None:
    """Block and entry of the channel that measured the load along, None where the recording names none."""
    name = manifest.excitation.force
    if name is None:
        return None
    found = [(daq.name, entry) for daq in manifest.daq for entry in daq.channel if entry.name == name]
    if len(found) != 1 or found[0][1].quantity != "force":
        told = f'"{name}", of quantity {found[0][1].quantity}' if len(found) == 1 else f'"{name}" {len(found)} times'
        expected = 'the name of one channel with quantity = "force"'
        raise InputError(manifest.path, "excitation.force", found=told, expected=expected)
    return found[0]


def _without_delays(found: Aligned) -> Aligned:
    """Take the stated delays off: what all channels share moves the time, what they do not is resampled."""
    delays = np.array([channel.entry.delay for channel in found.channels])
    start_s, shift = found.start_s - float(delays[0]), (delays - delays[0]) * found.rate_hz
    if not shift.any():
        return replace(found, start_s=start_s)
    reach = kernel_reach(1.0)
    low = int(np.ceil(max(0.0, reach - shift.min())))
    high = int(np.floor(min(len(found.values[0]), len(found.values[0]) - reach - shift.max())))
    kept = np.arange(low, high, dtype=np.float64)
    values = tuple(
        resampled(value, kept + by, 1.0) if by else value[low:high]
        for value, by in zip(found.values, shift, strict=True)
    )
    return replace(found, values=values, start_s=start_s + low / found.rate_hz)


def _check_onset(manifest: Manifest, record: StepRecord) -> None:
    """Refuse a stated onset outside the record."""
    onset, last = record.onset_s, record.start_s + (record.samples.shape[1] - 1) / record.sample_rate_hz
    if onset is not None and not record.start_s < onset < last:
        expected = f"a time within the record, {record.start_s:.6g} s to {last:.6g} s"
        raise InputError(manifest.path, "excitation.onset", found=f"{onset:g} s", expected=expected)


def _of_chains(found: Aligned, record: StepRecord) -> Sequence[Notice]:
    """Say of channels with a stated response that the models hold it."""
    named = [channel.entry.name for channel in found.channels if channel.entry.response is not None]
    if not named:
        return ()
    text = f"the stated response of {', '.join(named)} is not taken off: the model is that of sensor and chain together"
    return (Notice("warning", text, record.name),)
