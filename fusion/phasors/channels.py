"""Phasors of every channel: the lines of a recording, the sine approximation, delay and response taken off."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from fusion.base import AnyNotice, InputError, as_input_error
from fusion.instruments.channel import ChainUncertainty, Reading
from fusion.instruments.transducer import TRANSDUCERS
from fusion.phasors.timing import TimeBase
from fusion.recording.response import read_response
from shaker.arrays import BoolArray, FloatArray, Notice, brief
from shaker.lines.detection import relative_strength, survey_lines
from shaker.lines.frequencies import Lines, find_lines
from shaker.lines.spectrum import amplitude_spectrum
from shaker.sine.aliasing import alias_frequency
from shaker.sine.fit import Stationarity, fit_sines, stationarity
from shaker.sine.phasor import Phasors
from shaker.sine.solve import SineFit, SineModel

if TYPE_CHECKING:
    from fusion.recording.files import DaqRecord
    from fusion.recording.load import Manifest
    from fusion.recording.manifest import ChannelEntry

EXCERPT_PERIODS = 4
DRIVEN = 0.05
"""Of the strongest line: what a line of a multisine without stated frequencies must reach."""
APART_PERIODS = 2.0
"""Periods of the beat with every wanted line that a record must hold for another line to be fitted beside them."""
# The order in which quantities are preferred for finding the lines: those that show high frequencies best.
LINE_QUANTITIES = (*sorted(TRANSDUCERS, key=lambda name: -TRANSDUCERS[name].order), "output", "force", "voltage")


@dataclass(frozen=True)
class ChannelResult:
    """One DAQ channel: phasors in SI at the recording's lines, and what the figures need.

    `excerpt_s`, `excerpt`, `excerpt_fit` (S,): a short stretch with its fit. `spectrum_hz`, `spectrum` (B,):
    amplitude spectrum of the signal; `residual_rms`: of what the lines leave, in the channel's SI unit.
    `stationarity`: phasors over blocks of whole periods, delay and response not corrected. `notices`: what its fit
    wants the user to know.
    """

    name: str
    daq: str
    quantity: str
    body: str
    unit: str
    sample_rate_hz: float
    samples: int
    phasors: Phasors
    residual_rms: float
    excerpt_s: FloatArray
    excerpt: FloatArray
    excerpt_fit: FloatArray
    spectrum_hz: FloatArray
    spectrum: FloatArray
    stationarity: Stationarity | None = None
    notices: tuple[AnyNotice, ...] = ()

    __repr__ = brief


# The lines, in the fastest channels.


@dataclass(frozen=True)
class LineRecord:
    """The channels in which a recording's lines are looked for: `values` (S, C) in SI at `time_s` (S,)."""

    record: DaqRecord
    channels: tuple[ChannelEntry, ...]
    time_s: FloatArray
    values: FloatArray


def line_record(base: TimeBase) -> LineRecord | None:
    """Return the fastest channel and all that were sampled with it; None where there are only triggers.

    Of equally fast ones it is the first by quantity and place.
    """
    candidates = [
        (-record.raw[channel.name].sample_rate_hz, LINE_QUANTITIES.index(channel.quantity), place, record, channel)
        for place, record in enumerate(base.records)
        for channel in record.entry.channel
        if channel.quantity in LINE_QUANTITIES
    ]
    if not candidates:
        return None
    *_, record, channel = min(candidates, key=lambda item: item[:3])
    time_s = base.to_base_s(record.entry.name, record.time_s(channel.name))
    together = next(group for group in _same_times(record) if channel in group)
    values = np.stack([record.values(member) for member in together], axis=1)
    return LineRecord(record, tuple(together), time_s, values)


def find_channel_lines(manifest: Manifest, base: TimeBase) -> Lines | None:
    """Find the lines in the fastest channels; None where there are only triggers."""
    chosen = line_record(base)
    return None if chosen is None else lines_in(manifest, chosen)


def lines_in(manifest: Manifest, chosen: LineRecord) -> Lines:
    """Find the lines that the manifest states, their harmonics and all else in the channels chosen for it."""
    record, together, time_s, values = chosen.record, chosen.channels, chosen.time_s, chosen.values
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
    lines = survey_lines(values[:, chosen], rate_hz)
    low, high = excitation.band or (0.0, rate_hz / 2.0)
    in_band = lines.select((lines.frequency_hz >= low) & (lines.frequency_hz <= high))
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


# The sine approximation, channel by channel.


def channel_phasors(
    manifest: Manifest, base: TimeBase, lines: Lines
) -> tuple[tuple[ChannelResult, ...], tuple[Reading, ...]]:
    """Fit the lines to every channel of every block: the phasors with what the figures show, and with their errors.

    Lines above the Nyquist frequency are left out, since recorders filter them away, but not in the fastest channels,
    where the lines were found.
    """
    groups = [(record, group) for record in base.records for group in _same_times(record)]
    rates_hz = [record.raw[group[0].name].sample_rate_hz for record, group in groups]
    fitted: list[tuple[ChannelResult, Reading]] = []
    for (record, group), rate_hz in zip(groups, rates_hz, strict=True):
        seen = (lines.frequency_hz < rate_hz / 2.0) | (rate_hz >= max(rates_hz))
        if not seen.any():
            above = f"a sampling rate above {2.0 * lines.frequency_hz.min():g} Hz"
            expected = f"{above}, or no such channel in recording.toml"
            raise InputError(record.entry.file, group[0].name, found=f"{rate_hz:g} Hz", expected=expected)
        units = [manifest.rig.unit_of(channel) for channel in group]
        fitted += _fit_group(base, record, group, units, lines, seen)
    return tuple(result for result, _ in fitted), tuple(reading for _, reading in fitted)


def _same_times(record: DaqRecord) -> list[list[ChannelEntry]]:
    """Group a block's channels (triggers left out) by equal rate, start and length, to be fitted in one solve."""
    groups: dict[tuple[float, float, int], list[ChannelEntry]] = {}
    for channel in record.entry.channel:
        if channel.quantity != "trigger":
            raw = record.raw[channel.name]
            groups.setdefault((raw.sample_rate_hz, raw.start_s, len(raw.samples)), []).append(channel)
    return list(groups.values())


def _fit_group(
    base: TimeBase,
    record: DaqRecord,
    group: Sequence[ChannelEntry],
    units: Sequence[str],
    lines: Lines,
    seen: BoolArray,
) -> list[tuple[ChannelResult, Reading]]:
    """Fit the lines seen (K,) to all channels of one group and split the result by channel.

    Other lines are fitted beside the wanted ones where they are below Nyquist, and so far off that they can.
    """
    time_s = base.to_base_s(record.entry.name, record.time_s(group[0].name))
    rate_hz = record.raw[group[0].name].sample_rate_hz
    values = np.stack([record.values(channel) for channel in group], axis=1)
    names = [channel.name for channel in group]
    apart = np.abs(np.subtract.outer(lines.nuisance_hz, alias_frequency(lines.frequency_hz, rate_hz)))
    clear = np.all(apart * float(time_s[-1] - time_s[0]) >= APART_PERIODS, axis=1)
    beside = lines.nuisance_hz[clear & (lines.nuisance_hz < rate_hz / 2.0)]
    frequency_hz = np.concatenate([lines.frequency_hz[seen], beside])
    with as_input_error(record.entry.file, names[0]):
        fit = fit_sines(time_s, values, frequency_hz, names, units, model=SineModel(robust=True))
    wanted = spread_lines(fit.phasors.at_lines(np.arange(np.count_nonzero(seen))), seen, lines.frequency_hz)
    whole = values
    if len(fit.spikes):
        values = values.copy()
        values[fit.spikes] = np.nan
    steady = stationarity(time_s, values, frequency_hz, names)
    fitted = []
    for c, channel in enumerate(group):
        result, reading = _result(base, record, channel, time_s, whole[:, c], fit, wanted.select([channel.name]))
        fitted.append((replace(result, stationarity=steady and steady.select(channel.name)), reading))
    return fitted


def _result(
    base: TimeBase,
    record: DaqRecord,
    channel: ChannelEntry,
    time_s: FloatArray,
    values: FloatArray,
    fit: SineFit,
    phasors: Phasors,
) -> tuple[ChannelResult, Reading]:
    """Correct one channel's phasors for delay and response, and keep what its figures need.

    The factor from a channel's phasor to the true one is exp(+jω·delay) / response(f).
    """
    block, rate_hz, tie = record.entry.name, record.raw[channel.name].sample_rate_hz, base.ties[record.entry.name]
    middle_s = np.asarray(len(values) / rate_hz / 2)
    chain = ChainUncertainty(clock=block, u_clock_s=0.0 if tie is None else float(tie.u_to_base_s(middle_s)))
    correction = np.exp(2j * np.pi * phasors.frequency_hz * channel.delay)
    if channel.response is not None:
        response = read_response(channel.response, phasors.frequency_hz)
        correction = correction / response.value
        chain = replace(chain, u_magnitude=response.u_magnitude, u_phase_rad=response.u_phase_rad)
    phasors = phasors.scaled(correction[:, None])
    place = fit.phasors.channels.index(channel.name)
    shown = slice(0, min(len(values), int(EXCERPT_PERIODS * rate_hz / fit.phasors.frequency_hz[0]) + 2))
    spectrum = amplitude_spectrum(values, rate_hz)
    result = ChannelResult(
        name=channel.name,
        daq=block,
        quantity=channel.quantity,
        body=channel.body or "",
        unit=phasors.unit[0],
        sample_rate_hz=rate_hz,
        samples=len(values),
        phasors=phasors,
        residual_rms=float(fit.residual_rms[place]),
        excerpt_s=time_s[shown],
        excerpt=values[shown],
        excerpt_fit=fit.model(time_s[shown])[:, place],
        spectrum_hz=spectrum.frequency_hz,
        spectrum=spectrum.amplitude,
        notices=tuple(Notice(n.severity, f"{block}, {n.where}: {n.text}", block) for n in fit.notices),
    )
    return result, Reading(channel, phasors, chain)


def spread_lines(phasors: Phasors, mask: BoolArray, frequency_hz: FloatArray) -> Phasors:
    """Return phasors at all lines `frequency_hz` (K,) from those at the lines of `mask` (K,), NaN at the others."""
    lines, channels = len(mask), len(phasors.channels)
    value = np.full((lines, channels), np.nan, dtype=np.complex128)
    covariance = np.full((lines, 2 * channels, 2 * channels), np.nan)
    dof = np.zeros(lines)
    value[mask], covariance[mask], dof[mask] = phasors.value, phasors.covariance, phasors.dof
    return Phasors(frequency_hz, value, covariance, phasors.channels, phasors.unit, dof)
