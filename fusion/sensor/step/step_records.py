"""Recordings of releases: choices of an identification, and records on one time base."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from fusion.errors import InputError
from fusion.phasors.aligned_channels import AlignedChannels, align
from fusion.recording.daq_records import read_daqs
from fusion.recording.load import Manifest
from fusion.recording.manifest import ChannelEntry
from fusion.recording.response import read_response
from fusion.sensor import model_notices as declared
from shaker.release.record import StepRecord, locate_change, peaks_hz
from shaker.timebase.edges import kernel_reach, resample
from shakercal._common.notices import Notice

# Choices of an identification from step responses.

MethodChoice = Literal["pencil", "arx", "all"]
ReleaseChoice = Literal["auto", "step", "ramp", "smooth", "exponential", "measured"]


@dataclass(frozen=True)
class StepSettings:
    """Choices of an identification from step responses.

    Attributes
    ----------
    method : method that starts a fit, "pencil" or "arx"; "all" compares every method in addition. Default "pencil".
    modes : number of modes; None selects it by rule.
    real_poles : number of real poles; None selects it by rule.
    release : course of the load: "step", "ramp", "smooth", "exponential" or "measured"; "auto" (default): by rule.

    Examples
    --------
    >>> from fusion import StepSettings
    >>> StepSettings(method="arx", modes=2).modes
    2
    """

    method: MethodChoice = "pencil"
    modes: int | None = None
    real_poles: int | None = None
    release: ReleaseChoice = "auto"

    def as_settings(self) -> dict[str, str | float | int]:
        """Return the choices for the results."""
        structure = {"modes": self.modes, "real_poles": self.real_poles}
        by_rule = {name: "by rule" if number is None else number for name, number in structure.items()}
        return {"method": self.method, "release": self.release, **by_rule}


# The record of a release: outputs and force on one time base, in their units.


@dataclass(frozen=True)
class StepInput:
    """A recording with its record and the notices of its reading."""

    manifest: Manifest
    record: StepRecord
    notices: tuple[Notice, ...]


def output_entries(manifest: Manifest) -> dict[str, tuple[str, ChannelEntry]]:
    """Return block and entry of every output by name; `InputError` without or twice."""
    outputs: dict[str, tuple[str, ChannelEntry]] = {}
    recorded = [(daq.name, entry) for daq in manifest.daq for entry in daq.channel if entry.quantity == "output"]
    for block, entry in recorded:
        name = entry.channel or entry.name
        if name in outputs:
            raise InputError(declared.DUPLICATE_OUTPUT, manifest.path, "daq.channel", output=name)
        outputs[name] = block, entry
    if not outputs:
        expected = 'a channel with quantity = "output"'
        raise InputError(declared.MISSING_STEP_ENTRY, manifest.path, "daq.channel", expected=expected)
    return outputs


def read_step(manifest: Manifest) -> StepInput:
    """Return all outputs of a step recording on one time base.

    With its force channel if it names one. The origin of time is the earliest sample of the first block. Raises
    `InputError`.
    """
    manifest.check_command("step")
    excitation, outputs = manifest.excitation, output_entries(manifest)
    selected = [*outputs.values(), *_force(manifest)]
    aligned = _without_delays(align(manifest, read_daqs(manifest), selected, "daq"))
    if excitation.component is None or excitation.step_amplitude is None:
        raise InputError(
            declared.MISSING_STEP_ENTRY, manifest.path, "excitation.component", expected="the load of the step"
        )
    record = StepRecord(
        name=manifest.folder.name,
        channels=tuple(outputs),
        unit=manifest.rig.unit_of(next(iter(outputs.values()))[1].quantity),
        samples=np.stack(aligned.values[: len(outputs)]),
        sample_rate_hz=aligned.rate_hz,
        component=excitation.component,
        amplitude=excitation.step_amplitude,
        u_amplitude=excitation.step_uncertainty,
        start_s=aligned.start_s,
        force=aligned.values[-1] if len(selected) > len(outputs) else None,
        onset_s=excitation.onset,
        release=excitation.release or "",
    )
    driven = record.channels.index(record.component) if record.component in record.channels else 0
    record = with_stated_lag(record, driven, [*outputs.values()][driven][1])
    end_s = record.start_s + (record.samples.shape[1] - 1) / record.sample_rate_hz
    if record.onset_s is not None and not record.start_s < record.onset_s < end_s:
        path, start_s, found_s = manifest.path, record.start_s, record.onset_s
        raise InputError(
            declared.ONSET_OUTSIDE_RECORD, path, "excitation.onset", start_s=start_s, end_s=end_s, found_s=found_s
        )
    notices, entries = [*aligned.notices], [channel.entry for channel in aligned.channels]
    if chained := ", ".join(entry.name for entry in entries if entry.response is not None):
        notices.append(Notice(declared.CHAIN_IN_MODEL, record.name, channels=chained))
    if late := ", ".join(entry.name for entry in entries if entry.filter_delay_s > 0.0):
        notices.append(Notice(declared.FILTER_IN_MODEL, record.name, channels=late))
    return StepInput(manifest, record, tuple(notices))


_FAR_BELOW = 10.0  # ratio of the frequencies between which the magnitude of a chain gives its lag
_NO_LAG = 5e-3  # lag in radians of the ringing, below which a stated response says nothing of an amplifier


def with_stated_lag(record: StepRecord, driven: int, entry: ChannelEntry) -> StepRecord:
    """Return a record with lag and further delay of its output's stated response.

    |H| = 1/√(1 + ω²τ²) at the frequency of the ringing relative to a tenth of it. A response without a lag, as that of
    an anti-aliasing filter alone, does not state the lag of the amplifier.
    """
    if entry.response is None:
        return record
    samples = record.samples[driven]
    try:
        rings = samples[int(np.ceil(locate_change(samples).index_90)) :]
        hertz = float(peaks_hz(rings, 1.0 / record.sample_rate_hz, 1)[0])
        at = np.array([hertz / _FAR_BELOW, hertz])
        chain = read_response(entry.response, at, entry.response_result, entry.response_columns)
    except (InputError, ValueError, IndexError):  # no ringing, or a table that ends below it
        return record
    below, omega = np.abs(chain.value[0] / chain.value[1]) ** 2, 2.0 * np.pi * hertz
    per_omega = omega**2 * (1.0 - below / _FAR_BELOW**2)
    square, u_square = max(0.0, (below - 1.0) / per_omega), 2.0 * below / per_omega
    u_square *= float(np.linalg.norm((chain.errors[:, 1] - chain.errors[:, 0]).real))
    lag = float(np.sqrt(square))
    later = -float(np.angle(chain.value[1] / chain.value[0])) / (omega - omega / _FAR_BELOW)
    record = replace(record, delay_s=later - float(np.arctan(omega * lag)) / omega)
    if omega * lag < _NO_LAG:
        return record
    return replace(record, lag_s=lag, u_lag_s=float(u_square / (2.0 * max(lag, np.sqrt(u_square), 1e-12))))


def _force(manifest: Manifest) -> list[tuple[str, ChannelEntry]]:
    """Return block and entry of the channel that measured the load, if named."""
    name = manifest.excitation.force
    if name is None:
        return []
    named = [(daq.name, entry) for daq in manifest.daq for entry in daq.channel if entry.name == name]
    if len(named) != 1 or named[0][1].quantity != "force":
        found = f'"{name}", of quantity {named[0][1].quantity}' if len(named) == 1 else f'"{name}" {len(named)} times'
        raise InputError(declared.WRONG_FORCE_CHANNEL, manifest.path, "excitation.force", found=found)
    return named


def _without_delays(aligned: AlignedChannels) -> AlignedChannels:
    """Correct the stated delays: a common delay shifts the time, individual differences are resampled."""
    delays = np.array([channel.entry.delay for channel in aligned.channels])
    start_s, shift = aligned.start_s - float(delays[0]), (delays - delays[0]) * aligned.rate_hz
    if not shift.any():
        return replace(aligned, start_s=start_s)
    reach, count = kernel_reach(1.0), len(aligned.values[0])
    low = int(np.ceil(max(0.0, reach - shift.min())))
    high = int(np.floor(min(count, count - reach - shift.max())))
    position = np.arange(low, high, dtype=np.float64)
    values = tuple(
        resample(value, position + by, 1.0) if by else value[low:high]
        for value, by in zip(aligned.values, shift, strict=True)
    )
    return replace(aligned, values=values, start_s=start_s + low / aligned.rate_hz)
