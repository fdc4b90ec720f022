"""Phasors of every channel, and how steady they are."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from fusion.base import AnyNotice, InputError
from fusion.phasors.results import ChannelResult, ClockResult, StereoResult
from fusion.phasors.timing import TimeBase
from fusion.recording.files import DaqRecord, read_response
from fusion.recording.load import Manifest
from fusion.recording.manifest import ChannelEntry
from shaker.arrays import FloatArray, Notice
from shaker.labels import QUANTITY_UNITS
from shaker.lines.aliasing import alias_frequency
from shaker.lines.detection import relative_strength, survey_lines
from shaker.lines.frequencies import Lines, find_lines
from shaker.lines.spectrum import amplitude_spectrum
from shaker.sine.fit import Stationarity, fit_sines, stationarity
from shaker.sine.phasor import Phasors
from shaker.sine.solve import SineFit

# How far amplitude and phase of the driven lines changed while each instrument was recording.


SURE = 4.0  # standard uncertainties; noise reaches it once in 16 000 cases
MATTERS = 1e-3  # of the amplitude, or rad, over the record: a mean over another stretch differs by up to half of it
NAMED = 4


@dataclass(frozen=True)
class Drift:
    """Change of one line in one channel over its record: `amplitude`, relative to itself, and `phase_rad`.

    `chance` is how often noise alone moves the blocks that far from their mean.
    """

    name: str
    frequency_hz: float
    blocks: int
    periods: float
    whole: bool
    amplitude: float
    u_amplitude: float
    phase_rad: float
    u_phase_rad: float
    chance: float


def drifts(
    channels: Sequence[ChannelResult], stereo: Sequence[StereoResult], lines: Lines, clocks: Sequence[ClockResult]
) -> tuple[Drift, ...]:
    """Return the changes of the driven lines in every channel and in the strongest component of every stereo pair.

    The rate of a clock that is tied to the first one is known no better than its edges tell, and so is a phase's drift.
    """
    u_rate = {clock.daq: float(np.sqrt(clock.tie.covariance[1, 1])) for clock in clocks if clock.tie is not None}
    driven = lines.frequency_hz[lines.multiple == 1]
    found: list[Drift] = []
    for channel in channels:
        if channel.stationarity is not None:
            found += _of_lines(channel.name, channel.stationarity, driven, u_rate.get(channel.daq, 0.0))
    for pair in stereo:
        if pair.stationarity is not None:
            found += _of_lines(f"stereo pair {pair.name}", pair.stationarity, driven, 0.0)
    return tuple(found)


def drift_notices(found: Sequence[Drift]) -> tuple[AnyNotice, ...]:
    """Return a notice for each line whose amplitude, and one for each whose phase, surely changed by what matters."""
    notices: list[AnyNotice] = []
    for frequency in dict.fromkeys(drift.frequency_hz for drift in found):
        here = [drift for drift in found if drift.frequency_hz == frequency]
        where = f"{frequency:.6g} Hz"
        grown = [d for d in here if abs(d.amplitude) > max(MATTERS, SURE * d.u_amplitude)]
        turned = [d for d in here if abs(d.phase_rad) > max(MATTERS, SURE * d.u_phase_rad)]
        by = _listed([f"{100.0 * d.amplitude:+.2g} % in {d.name}" for d in grown])
        angle = _listed([f"{1e3 * d.phase_rad:+.2g} mrad in {d.name}" for d in turned])
        end = "results are means over each instrument's own record"
        if grown:
            notices.append(Notice("warning", f"the amplitude at {where} changes over the record: {by}; {end}", where))
        if turned:
            notices.append(Notice("warning", f"the phase at {where} drifts over the record: {angle}; {end}", where))
    return tuple(notices)


def _listed(texts: Sequence[str]) -> str:
    """Join some texts and say how many more there are."""
    more = f" and {len(texts) - NAMED} more" if len(texts) > NAMED else ""
    return ", ".join(texts[:NAMED]) + more


def _of_lines(name: str, steady: Stationarity, driven: Sequence[float], u_rate: float) -> Iterator[Drift]:
    """Return the changes of the driven lines, each in the channel that shows it best."""
    length = steady.length_s
    for frequency in driven:
        for line in np.flatnonzero(steady.frequency_hz == frequency):
            mean = np.abs(steady.value[:, line].mean(axis=0))
            clear = mean / np.maximum(steady.u_amplitude_per_s[line], np.finfo(np.float64).tiny)
            c = int(np.argmax(clear))
            if mean[c] > 0.0:
                part = length / mean[c]
                u_phase = np.hypot(steady.u_phase_rad_per_s[line, c], 2.0 * np.pi * frequency * u_rate)
                yield Drift(
                    name,
                    float(frequency),
                    len(steady.time_s),
                    steady.periods,
                    steady.whole,
                    float(steady.amplitude_per_s[line, c] * part),
                    float(steady.u_amplitude_per_s[line, c] * part),
                    float(steady.phase_rad_per_s[line, c] * length),
                    float(u_phase * length),
                    float(steady.p_value[line, c]),
                )


# The DAQ channels of a recording turned into phasors in SI, delay and chain response taken off.


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
