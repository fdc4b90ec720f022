"""The DAQ channels of a recording turned into phasors in SI, delay and chain response taken off."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from fusion.errors import InputError
from fusion.manifest import ChannelEntry, Manifest
from fusion.measured_results import ChannelResult
from fusion.records import DaqRecord
from fusion.response import read_response
from fusion.timing import TimeBase
from shaker._checks import FloatArray
from shaker.notice import Notice
from shaker.signals.folding import alias_frequency
from shaker.signals.frequencies import Lines, find_lines
from shaker.signals.phasor import Phasors
from shaker.signals.sine import SineFit, fit_sines
from shaker.signals.spectrum import amplitude_spectrum
from shaker.signals.stationarity import stationarity
from shaker.signals.survey import relative_strength, survey_lines

QUANTITY_UNITS = {
    "displacement": "m",
    "velocity": "m/s",
    "acceleration": "m/s^2",
    "angular_velocity": "rad/s",
    "force": "N",
    "voltage": "V",
}
EXCERPT_PERIODS = 4
DRIVEN = 0.05
"""Of the strongest line: what a line of a multisine without stated frequencies must reach."""
APART_PERIODS = 2.0
"""Periods of the beat with every wanted line that a record must hold for another line to be fitted beside them."""
# The order in which quantities are preferred for finding the lines: those that show high frequencies best.
LINE_QUANTITIES = ("acceleration", "velocity", "angular_velocity", "displacement", "output", "force", "voltage")


def channel_unit(manifest: Manifest, channel: ChannelEntry) -> str:
    """Return the unit of a channel after its scale."""
    if channel.quantity == "output":
        return manifest.rig.sensor.unit if manifest.rig.sensor else "1"
    return QUANTITY_UNITS[channel.quantity]


def nominal_lines(manifest: Manifest) -> tuple[Sequence[float], Literal["auto"] | Sequence[int]]:
    """Return the nominal fundamentals in Hz and the harmonics asked for, as the manifest states them."""
    excitation = manifest.excitation
    if excitation.frequencies is None:
        expected = "the frequencies of the lines, since no channel shows them"
        raise InputError(manifest.path, "excitation.frequencies", found="none", expected=expected)
    return excitation.frequencies, excitation.harmonics


@dataclass(frozen=True)
class LineRecord:
    """The channels in which a recording's lines are looked for: `values` (S, C) in SI at `time_s` (S,)."""

    record: DaqRecord
    channels: tuple[ChannelEntry, ...]
    time_s: FloatArray
    values: FloatArray


def line_record(base: TimeBase) -> LineRecord | None:
    """Return the fastest channel and all that were sampled with it; None where there are only triggers."""
    best = _line_channel(base)
    if best is None:
        return None
    record, channel = best
    time_s = base.to_base_s(record.entry.name, record.time_s(channel.name))
    together = next(group for group in _same_times(record) if channel in group)
    values = np.stack([record.values(member) for member in together], axis=1)
    return LineRecord(record, tuple(together), time_s, values)


def find_channel_lines(manifest: Manifest, base: TimeBase) -> Lines | None:
    """Find the lines in the fastest channels; None where there are only triggers."""
    found = line_record(base)
    return None if found is None else lines_in(manifest, found)


def lines_in(manifest: Manifest, found: LineRecord) -> Lines:
    """Find the lines that the manifest states, their harmonics and all else in the channels chosen for it."""
    record, together, time_s, values = found.record, found.channels, found.time_s, found.values
    harmonics = manifest.excitation.harmonics
    try:
        if manifest.excitation.frequencies is not None:
            return find_lines(time_s, values, manifest.excitation.frequencies, harmonics)
        nominal_hz, told = _driven_lines(manifest, time_s, values, [member.name for member in together])
        lines = find_lines(time_s, values, nominal_hz, harmonics)
        return replace(lines, notices=(told, *lines.notices))
    except ValueError as error:
        names = ", ".join(member.name for member in together)
        where = f"{'channel' if len(together) == 1 else 'channels'} {names} of {record.entry.file.name}"
        raise InputError.told_by(ValueError(f"{error} ({where})"), manifest.path, "excitation.frequencies") from error


def _driven_lines(
    manifest: Manifest, time_s: FloatArray, values: FloatArray, names: Sequence[str]
) -> tuple[Sequence[float], Notice]:
    """Return the lines in the band of a multisine that states no frequencies, and a notice that lists them.

    Of the reference channels where they are among these, else of all: what reaches a twentieth of the strongest line
    and, where the period is stated, lies at a multiple of its inverse.
    """
    excitation = manifest.excitation
    chosen = [c for c, name in enumerate(names) if name in excitation.reference] or list(range(len(names)))
    rate_hz = (len(time_s) - 1) / float(time_s[-1] - time_s[0])
    found = survey_lines(values[:, chosen], rate_hz)
    low, high = excitation.band or (0.0, rate_hz / 2.0)
    in_band = found.select((found.frequency_hz >= low) & (found.frequency_hz <= high))
    kept = in_band.select(relative_strength(in_band.amplitude) >= DRIVEN) if len(in_band.frequency_hz) else in_band
    nominal_hz = [float(f"{f:.6g}") for f in kept.frequency_hz]
    if excitation.period is not None:
        turns = [(f, round(f * excitation.period) / excitation.period) for f in kept.frequency_hz.tolist()]
        nominal_hz = [whole for f, whole in turns if abs(f - whole) <= rate_hz / len(time_s)]
    if not nominal_hz:
        raise ValueError(
            f"band: expected lines between {low:g} and {high:g} Hz that stand out of the noise, found none"
        )
    listed = ", ".join(f"{f:.6g}" for f in nominal_hz)
    return nominal_hz, Notice("info", f"no frequencies are stated; found in the band: {listed} Hz", "excitation.band")


def _line_channel(base: TimeBase) -> tuple[DaqRecord, ChannelEntry] | None:
    """Return the channel with the highest rate, of equally fast ones the first by quantity and place."""
    candidates = [
        (-record.raw[channel.name].sample_rate_hz, LINE_QUANTITIES.index(channel.quantity), place, record, channel)
        for place, record in enumerate(base.records)
        for channel in record.entry.channel
        if channel.quantity in LINE_QUANTITIES
    ]
    if not candidates:
        return None
    *_, record, channel = min(candidates, key=lambda item: item[:3])
    return record, channel


def channel_results(manifest: Manifest, base: TimeBase, lines: Lines) -> tuple[ChannelResult, ...]:
    """Fit the lines to every channel of every block and return the phasors with what the figures show."""
    results: list[ChannelResult] = []
    for record in base.records:
        for group in _same_times(record):
            results += _fit_group(manifest, base, record, group, lines)
    return tuple(results)


def _fastest_rate_hz(base: TimeBase) -> float:
    """Return the highest sampling rate of the channels that are no triggers."""
    return max(
        record.raw[channel.name].sample_rate_hz
        for record in base.records
        for channel in record.entry.channel
        if channel.quantity != "trigger"
    )


def _same_times(record: DaqRecord) -> list[list[ChannelEntry]]:
    """Group a block's channels (triggers left out) by equal rate, start and length, to be fitted in one solve."""
    groups: dict[tuple[float, float, int], list[ChannelEntry]] = {}
    for channel in record.entry.channel:
        if channel.quantity != "trigger":
            raw = record.raw[channel.name]
            groups.setdefault((raw.sample_rate_hz, raw.start_s, len(raw.samples)), []).append(channel)
    return list(groups.values())


def _fit_group(
    manifest: Manifest, base: TimeBase, record: DaqRecord, group: Sequence[ChannelEntry], lines: Lines
) -> list[ChannelResult]:
    """Fit all channels of one group and split the result by channel.

    Lines above the Nyquist frequency are left out, since recorders filter them away, but not in the fastest channels,
    where the lines were found.
    """
    time_s = base.to_base_s(record.entry.name, record.time_s(group[0].name))
    rate_hz = record.raw[group[0].name].sample_rate_hz
    seen = (lines.frequency_hz < rate_hz / 2.0) | (rate_hz >= _fastest_rate_hz(base))
    if not seen.any():
        expected = f"a sampling rate above {2.0 * lines.frequency_hz.min():g} Hz, or no such channel in recording.toml"
        raise InputError(record.entry.file, group[0].name, found=f"{rate_hz:g} Hz", expected=expected)
    values = np.stack([record.values(channel) for channel in group], axis=1)
    names = [channel.name for channel in group]
    units = [channel_unit(manifest, channel) for channel in group]
    wanted = lines.frequency_hz[seen]
    frequency_hz = np.concatenate([wanted, _nuisances(lines, time_s, rate_hz)])
    try:
        fit = fit_sines(time_s, values, frequency_hz, names, units, robust=True)
    except ValueError as error:
        raise InputError.told_by(error, record.entry.file, names[0]) from error
    spread = spread_lines(_first_lines(fit.phasors, len(wanted)), seen, lines.frequency_hz)
    steady = stationarity(time_s, _without(values, fit.spikes), frequency_hz, names)
    found = [
        _result(record, channel, time_s, values[:, c], fit, spread.select([channel.name]))
        for c, channel in enumerate(group)
    ]
    return found if steady is None else [replace(one, stationarity=steady.select(one.name)) for one in found]


def _without(values: FloatArray, spikes: NDArray[np.int64]) -> FloatArray:
    """Return values (S, C) with NaN in the rows of spikes."""
    if not len(spikes):
        return values
    left = values.copy()
    left[spikes] = np.nan
    return left


def _nuisances(lines: Lines, time_s: FloatArray, rate_hz: float) -> FloatArray:
    """Return the other lines (N,) to be fitted beside the wanted ones: below Nyquist, and so far off that they can."""
    apart = np.abs(np.subtract.outer(lines.nuisance_hz, alias_frequency(lines.frequency_hz, rate_hz)))
    clear = np.all(apart * float(time_s[-1] - time_s[0]) >= APART_PERIODS, axis=1)
    return np.asarray(lines.nuisance_hz[clear & (lines.nuisance_hz < rate_hz / 2.0)])


def _first_lines(phasors: Phasors, count: int) -> Phasors:
    """Return the phasors of the first lines only."""
    part = slice(0, count)
    return Phasors(
        phasors.frequency_hz[part],
        phasors.value[part],
        phasors.covariance[part],
        phasors.channels,
        phasors.unit,
        phasors.dof[part],
    )


def _result(
    record: DaqRecord, channel: ChannelEntry, time_s: FloatArray, values: FloatArray, fit: SineFit, phasors: Phasors
) -> ChannelResult:
    """Correct one channel's phasors for delay and response, and keep what its figures need."""
    place = fit.phasors.channels.index(channel.name)
    rate_hz, block = record.raw[channel.name].sample_rate_hz, record.entry.name
    shown = slice(0, min(len(values), int(EXCERPT_PERIODS * rate_hz / fit.phasors.frequency_hz[0]) + 2))
    spectrum = amplitude_spectrum(values, rate_hz)
    return ChannelResult(
        name=channel.name,
        daq=block,
        quantity=channel.quantity,
        body=channel.body or "",
        unit=phasors.unit[0],
        sample_rate_hz=rate_hz,
        samples=len(values),
        phasors=phasors.scaled(_correction(channel, phasors.frequency_hz)[:, None]),
        residual_rms=float(fit.residual_rms[place]),
        excerpt_s=time_s[shown],
        excerpt=values[shown],
        excerpt_fit=fit.model(time_s[shown])[:, place],
        spectrum_hz=spectrum.frequency_hz,
        spectrum=spectrum.amplitude,
        notices=tuple(Notice(n.severity, f"{block}, {n.where}: {n.text}", block) for n in fit.notices),
    )


def _correction(channel: ChannelEntry, frequency_hz: FloatArray) -> NDArray[np.complex128]:
    """Return exp(+jω·delay) / response(f), the factor from a channel's phasor to the true one."""
    factor = np.exp(2j * np.pi * frequency_hz * channel.delay)
    if channel.response is None:
        return np.asarray(factor)
    return np.asarray(factor / read_response(channel.response, frequency_hz).value)


def spread_lines(phasors: Phasors, mask: NDArray[np.bool_], frequency_hz: FloatArray) -> Phasors:
    """Return phasors at all lines `frequency_hz` (K,) from those at the lines of `mask` (K,), NaN at the others."""
    lines, channels = len(mask), len(phasors.channels)
    value = np.full((lines, channels), np.nan, dtype=np.complex128)
    covariance = np.full((lines, 2 * channels, 2 * channels), np.nan)
    dof = np.zeros(lines)
    value[mask], covariance[mask], dof[mask] = phasors.value, phasors.covariance, phasors.dof
    return Phasors(frequency_hz, value, covariance, phasors.channels, phasors.unit, dof)
