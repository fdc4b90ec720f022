"""Phasors of every channel: lines of a recording, sine approximation, correction of delay and response."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial
from hashlib import sha256
from typing import TYPE_CHECKING

import numpy as np

from fusion.errors import InputError, as_input_error
from fusion.instruments.channel import (
    NOISE_REACH,
    ChainUncertainty,
    ChannelReading,
    ChannelRelativeError,
    nonzero_errors,
)
from fusion.phasors.phasor_notices import (
    CLIPPED_CHANNEL,
    COARSE_CONVERTER,
    LINE_ABOVE_SAMPLING,
    LINES_FROM_BAND,
    REJECTED_SAMPLES,
    UNUSABLE_CHANNEL,
)
from fusion.phasors.timing import TimeBase, TimingError, combine_timing_errors, lines_not_found_error
from fusion.recording.placement import chain_name
from fusion.recording.response import read_response
from fusion.recording.transducer import HEAD, STATIONARY, TRANSDUCERS
from shaker.io.channel import Stacked
from shaker.io.condition import FEWEST_STEPS, Defect, converter_step
from shaker.lines.detection import relative_strength, survey_lines
from shaker.lines.frequencies import LineFrequencies, find_lines
from shaker.lines.spectrum import Spectrum, amplitude_spectrum
from shaker.sine.aliasing import (
    CAPTURE,
    AliasedHarmonic,
    alias_frequency,
    find_aliased_harmonics,
    nearest_grid,
    sampling_grid,
)
from shaker.sine.phasor import Phasors
from shaker.sine.sine_fit import Stationarity, fit_sines, quantisation_error, rows_present, stationarity
from shaker.sine.solve import SineFit, SineModel
from shakercal._common.arrays import Arrays, BoolArray, ComplexArray, FloatArray
from shakercal._common.notices import Notice

if TYPE_CHECKING:
    from fusion.recording.daq_records import DaqRecord
    from fusion.recording.load import Manifest
    from fusion.recording.manifest import ChannelEntry
    from shaker.frf.chain import ChainResponse

EXCERPT_PERIODS = 4
MOST_BINS = 1 << 18
"""Largest number of bins of a stored spectrum (chosen for file size)."""
DRIVEN = 0.05
"""Smallest line of a multisine without stated frequencies, over the strongest one (chosen)."""
MIN_BEAT_PERIODS = 2.0
"""Beat periods with every line of the recording that a record must contain for another line to be fitted (chosen)."""
HARMONICS = (2, 3, 4, 5)
FEW = 3
"""Largest number of fundamentals with harmonics: a multisine has other lines and intermodulation there."""
_ROBUST = SineModel(robust=True)
_NO_SPECTRUM = Spectrum(np.empty(0), np.empty((0, 1)))
# Quantities for finding the lines in order of preference: those that show high frequencies best.
LINE_QUANTITIES = (*sorted(TRANSDUCERS, key=lambda name: -TRANSDUCERS[name].order), "output", "force", "voltage")


@dataclass(frozen=True, repr=False)
class ChannelResult(Arrays):
    """Phasors of one DAQ channel at the recording's lines, in SI units.

    `excerpt_s`, `excerpt`, `excerpt_fit` (S,): a short stretch with its fit. `spectrum_hz`, `spectrum` (B,): amplitude
    spectrum of the signal, of long records the largest of neighbouring bins. `residual_rms`: of the residuals, in the
    channel's SI unit. `stationarity`: phasors over blocks of whole periods, without correction of delay and response.
    `notices`: of its fit. `harmonics`: fundamentals and their harmonics up to the fifth, whether or not they are lines
    of the recording, as far as this channel samples them; None with many fundamentals.
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
    notices: tuple[Notice, ...] = ()
    harmonics: Phasors | None = None


# The lines, in the fastest channels.


@dataclass(frozen=True)
class LineRecord:
    """The channels in which a recording's lines are searched, in SI units."""

    record: DaqRecord
    channels: tuple[ChannelEntry, ...]
    time_s: FloatArray
    values: Stacked


def line_clock(base: TimeBase) -> tuple[TimingError, ...]:
    """Return the errors of the clock on which the lines are found."""
    fastest = fastest_channel(base)
    return () if fastest is None else base.tie_errors(fastest[0].entry.name)


def fastest_channel(base: TimeBase) -> tuple[DaqRecord, ChannelEntry] | None:
    """Return the fastest channel and its block.

    Of equally fast ones the first by quantity and index. Channels of a room or a laser head, which should be at rest,
    are the last choice.
    """
    candidates = [
        (record, channel)
        for record in base.records
        for channel in record.entry.channel
        if channel.quantity in LINE_QUANTITIES
    ]

    def preference(candidate: tuple[DaqRecord, ChannelEntry]) -> tuple[bool, float, bool, int]:
        record, channel = candidate
        rate_hz, defective = record.raw[channel.name].sample_rate_hz, bool(record.defects(channel))
        return channel.body in (STATIONARY, HEAD), -rate_hz, defective, LINE_QUANTITIES.index(channel.quantity)

    return min(candidates, key=preference, default=None)


def line_record(base: TimeBase) -> LineRecord | None:
    """Return the fastest channel and all sampled with it, None if there are only triggers."""
    fastest = fastest_channel(base)
    if fastest is None:
        return None
    record, channel = fastest
    time_s = base.to_base_s(record.entry.name, record.time_s(channel.name))
    group = next(group for group in channels_of_same_times(record) if channel in group)
    require_usable(record, channel)
    return LineRecord(record, tuple(group), time_s, record.usable_samples(group))


def find_channel_lines(manifest: Manifest, base: TimeBase) -> LineFrequencies | None:
    """Find the lines in the fastest channels, None if there are only triggers."""
    chosen = line_record(base)
    return None if chosen is None else base.add_clock_uncertainty(lines_of_record(manifest, chosen), line_clock(base))


def lines_of_record(manifest: Manifest, chosen: LineRecord) -> LineFrequencies:
    """Find the stated lines, their harmonics and all others in the chosen channels."""
    record, together, time_s, values = chosen.record, chosen.channels, chosen.time_s, chosen.values
    harmonics, half_rate = manifest.excitation.harmonics, record.raw[together[0].name].sample_rate_hz / 2.0
    # A line above is looked for where it folds to, within `CAPTURE` of its nominal frequency: the whole band, some day.
    beyond = [f for f in manifest.excitation.frequencies or () if CAPTURE * f >= half_rate]
    if beyond:
        limit = f"at most {half_rate / CAPTURE:g} Hz, for {together[0].name} at {2.0 * half_rate:g} samples per second"
        found, expected = f"{beyond[0]:g} Hz", f"frequencies of {limit}"
        raise InputError(LINE_ABOVE_SAMPLING, manifest.path, "excitation.frequencies", found=found, expected=expected)
    try:
        if manifest.excitation.frequencies is not None:
            return find_lines(time_s, values, manifest.excitation.frequencies, harmonics)
        record.check_uniform(together)
        nominal_hz, notice = _driven_lines(manifest, time_s, values, [member.name for member in together])
        lines = find_lines(time_s, values, nominal_hz, harmonics)
        return replace(lines, notices=(notice, *lines.notices))
    except ValueError as error:
        names = ", ".join(member.name for member in together)
        where = f"{'channel' if len(together) == 1 else 'channels'} {names} of {record.entry.file.name}"
        raise lines_not_found_error(manifest, where, error) from error


def _driven_lines(
    manifest: Manifest, time_s: FloatArray, values: Stacked, names: Sequence[str]
) -> tuple[Sequence[float], Notice]:
    """Return the lines in the band of a multisine without stated frequencies, and a notice.

    In the reference channels if they are among these, else in all. A line reaches a twentieth of the strongest one and,
    if the period is stated, is a multiple of its inverse.
    """
    excitation = manifest.excitation
    chosen = [c for c, name in enumerate(names) if name in excitation.reference] or list(range(len(names)))
    rate_hz = (len(time_s) - 1) / float(time_s[-1] - time_s[0])
    lines = survey_lines(fill_gaps(values.select(chosen)), rate_hz)
    low, high = excitation.band or (0.0, rate_hz / 2.0)
    in_band = lines.select((lines.frequency_hz >= low) & (lines.frequency_hz <= high))
    strong = in_band.select(relative_strength(in_band.amplitude) >= DRIVEN) if len(in_band.frequency_hz) else in_band
    nominal_hz = [float(f"{f:.6g}") for f in strong.frequency_hz]
    if excitation.period is not None:
        turns = [(f, round(f * excitation.period) / excitation.period) for f in strong.frequency_hz.tolist()]
        nominal_hz = [whole for f, whole in turns if abs(f - whole) <= rate_hz / len(time_s)]
    if not nominal_hz:
        raise ValueError(f"band: expected lines between {low:g} and {high:g} Hz above the noise, found none")
    listed = ", ".join(f"{f:.6g}" for f in nominal_hz)
    return nominal_hz, Notice(LINES_FROM_BAND, "excitation.band", count=len(nominal_hz), frequencies=listed)


# The sine approximation, channel by channel.


def channel_phasors(
    manifest: Manifest, base: TimeBase, lines: LineFrequencies, *, shown: bool = True
) -> tuple[tuple[ChannelResult, ...], tuple[ChannelReading, ...]]:
    """Fit the lines to every channel of every block.

    Lines above the Nyquist frequency are omitted, because recorders filter them, but not in the fastest channels, in
    which the lines were found. Without `shown`, spectra, harmonics and stationarity are omitted; they cause no refusal.
    """
    groups = [(record, group) for record in base.records for group in channels_of_same_times(record)]
    rates_hz = [record.raw[group[0].name].sample_rate_hz for record, group in groups]
    line_errors = base.line_errors(lines, line_clock(base))
    fitted: list[tuple[ChannelResult, ChannelReading]] = []
    for (record, group), rate_hz in zip(groups, rates_hz, strict=True):
        seen = (lines.frequency_hz < rate_hz / 2.0) | (rate_hz >= max(rates_hz))
        if not seen.any():
            expected = f"a sampling rate above {2.0 * lines.frequency_hz.min():g} Hz"
            file, name, found = record.entry.file, group[0].name, f"{rate_hz:g} Hz"
            raise InputError(LINE_ABOVE_SAMPLING, file, name, found=found, expected=expected)
        units = [manifest.rig.unit_of(channel.quantity) for channel in group]
        errors = combine_timing_errors([*base.tie_errors(record.entry.name), *line_errors])
        fitted += _fit_group(base, record, group, units, (lines, seen, errors), shown)
    return tuple(result for result, _ in fitted), tuple(reading for _, reading in fitted)


def channels_of_same_times(record: DaqRecord) -> list[list[ChannelEntry]]:
    """Group channels of equal times, without triggers, to be fitted together; defective ones stay alone."""
    groups: dict[tuple[float, float, int, bytes, str], list[ChannelEntry]] = {}
    for channel in record.entry.channel:
        if channel.quantity != "trigger":
            raw = record.raw[channel.name]
            stamps = b"" if raw.stamp_s is None else sha256(raw.stamp_s.tobytes()).digest()
            alone = channel.name if record.defects(channel) else ""
            groups.setdefault((raw.sample_rate_hz, raw.start_s, len(raw.samples), stamps, alone), []).append(channel)
    return list(groups.values())


def _fit_group(
    base: TimeBase,
    record: DaqRecord,
    group: Sequence[ChannelEntry],
    units: Sequence[str],
    group_lines: tuple[LineFrequencies, BoolArray, Sequence[TimingError]],
    shown: bool,
) -> list[tuple[ChannelResult, ChannelReading]]:
    """Fit the lines seen (K,) to all channels of one group.

    Other lines are fitted too if they are below Nyquist and separable. Errors of times and lines act through the fit.
    """
    lines, seen, errors = group_lines
    time_s = base.to_base_s(record.entry.name, record.time_s(group[0].name))
    rate_hz = record.raw[group[0].name].sample_rate_hz
    names = [channel.name for channel in group]
    distance = np.abs(np.subtract.outer(lines.nuisance_hz, alias_frequency(lines.frequency_hz, rate_hz)))
    clear = np.all(distance * float(time_s[-1] - time_s[0]) >= MIN_BEAT_PERIODS, axis=1)
    nuisance_hz = lines.nuisance_hz[clear & (lines.nuisance_hz < rate_hz / 2.0)]
    frequency_hz = np.concatenate([lines.frequency_hz[seen], nuisance_hz])
    first = lines.frequency_hz[(lines.multiple == 1) & seen]
    multiples = _multiples(first, frequency_hz, rate_hz, float(time_s[-1] - time_s[0]))
    added = multiples[~np.isin(multiples, frequency_hz)]
    with as_input_error(record.entry.file, names[0]):
        every = np.concatenate([frequency_hz, added])
        fitted_to = partial(fit_sines, time_s, frequency_hz=every, channels=names, unit=units, model=_ROBUST)
        fit, values, clipped = fit_usable(record, group, fitted_to, time_s)
    phasors = expand_lines(fit.phasors.at_lines(np.arange(np.count_nonzero(seen))), seen, lines.frequency_hz)
    regular = None
    if len(fit.spikes):
        regular = np.ones(len(values), dtype=np.bool_)
        regular[fit.spikes] = False
    times = time_s if regular is None else time_s[regular]
    steady = stationarity(times, values.select_rows(regular), frequency_hz, names) if shown else None
    fitted: list[tuple[ChannelResult, ChannelReading]] = []
    for c, channel in enumerate(group):
        of_channel = phasors.select([channel.name])
        result, reading = _result(record, channel, time_s, fit, of_channel, shown)
        order = -TRANSDUCERS[channel.quantity].order if channel.quantity in TRANSDUCERS else 0
        late = [error.effect_on_fit(fit, seen, order).of_channel(c).relative_to(of_channel) for error in errors]
        value_errors, notices = assess_condition(record, c, fit, time_s, clipped, seen)
        of_blocks = steady and steady.select(channel.name)
        harmonics = _harmonics(channel, fit, every, multiples) if shown else None
        result = replace(result, stationarity=of_blocks, harmonics=harmonics, notices=(*result.notices, *notices))
        result = replace(result, spectrum_hz=fitted[0][0].spectrum_hz) if fitted else result  # the same object
        fitted.append((result, replace(reading, further_errors=nonzero_errors([*late, *value_errors]))))
    return fitted


def _multiples(first: FloatArray, fitted: FloatArray, rate_hz: float, length_s: float) -> FloatArray:
    """Return fundamentals and the harmonics that are lines or can be fitted separately."""
    if not 0 < len(first) <= FEW:
        return np.empty(0)
    alias, multiples = alias_frequency(fitted, rate_hz), list(first)
    for frequency in (m * f for f in first for m in HARMONICS):
        equal = fitted[np.abs(fitted - frequency) < 1e-9 * frequency]
        clear = np.min(np.abs(np.append(alias, [0.0, rate_hz / 2.0]) - frequency)) * length_s >= MIN_BEAT_PERIODS
        if len(equal) or (clear and frequency < rate_hz / 2.0):
            multiples.append(equal[0] if len(equal) else frequency)
            alias = np.append(alias, frequency)
    return np.array(multiples)


def _harmonics(channel: ChannelEntry, fit: SineFit, fitted: FloatArray, multiples: FloatArray) -> Phasors | None:
    """Return fundamentals and harmonics of one channel, None if its response is not stated there."""
    if not len(multiples):
        return None
    indices = [int(np.argmin(np.abs(fitted - frequency))) for frequency in multiples]
    of_channel = fit.phasors.at_lines(np.array(indices)).select([channel.name])
    try:
        return of_channel.scaled(chain_correction(channel, of_channel.frequency_hz)[0][:, None])
    except InputError:
        return None


def chain_correction(channel: ChannelEntry, frequency_hz: FloatArray) -> tuple[ComplexArray, ChainResponse | None]:
    """Return the factor exp(+jω·delay) / response(f) of a channel's phasor, and the response."""
    correction = np.exp(2j * np.pi * frequency_hz * channel.delay)
    if channel.response is None:
        return correction, None
    response = read_response(channel.response, frequency_hz, channel.response_result, channel.response_columns)
    return correction / response.value, response


def _result(
    record: DaqRecord, channel: ChannelEntry, time_s: FloatArray, fit: SineFit, phasors: Phasors, shown: bool
) -> tuple[ChannelResult, ChannelReading]:
    """Correct one channel's phasors for delay and response, and collect the data of its figures."""
    block, rate_hz, values = record.entry.name, record.raw[channel.name].sample_rate_hz, record.stacked([channel])
    chain = ChainUncertainty(clock=block)
    correction, response = chain_correction(channel, phasors.frequency_hz)
    if response is not None:
        chain = replace(chain, u_magnitude=response.u_magnitude, u_phase_rad=response.u_phase_rad)
    phasors = phasors.scaled(correction[:, None])
    index = fit.phasors.channels.index(channel.name)
    first = slice(0, min(len(values), int(EXCERPT_PERIODS * rate_hz / fit.phasors.frequency_hz[0]) + 2))
    uneven_s = None if record.raw[channel.name].stamp_s is None else time_s
    spectrum = channel_spectrum(fill_gaps(values), uneven_s, rate_hz) if shown else _NO_SPECTRUM
    result = ChannelResult(
        name=channel.name,
        daq=block,
        quantity=channel.quantity,
        body=channel.body or "",
        unit=phasors.unit[0],
        sample_rate_hz=rate_hz,
        samples=len(values),
        phasors=phasors,
        residual_rms=float(fit.residual_rms[index]),
        excerpt_s=time_s[first].copy(),  # a view would reference the whole record
        excerpt=values[first][:, 0],
        excerpt_fit=fit.model(time_s[first], slice(index, index + 1))[:, 0],
        spectrum_hz=spectrum.frequency_hz,
        spectrum=spectrum.amplitude[:, 0],
        notices=tuple(notice.at(f"{block}, {notice.where}") for notice in fit.notices),
    )
    return result, ChannelReading(channel, phasors, chain)


def channel_spectrum(values: FloatArray | Stacked, uneven_s: FloatArray | None, rate_hz: float) -> Spectrum:
    """Return the spectrum of a channel, at uneven times (S,) on the nearest grid."""
    if uneven_s is None:
        return amplitude_spectrum(values, rate_hz, MOST_BINS)
    grid = sampling_grid(uneven_s) or nearest_grid(uneven_s)
    if grid is None:
        return _NO_SPECTRUM
    column = values[:]
    share = len(column) / grid.length  # of the grid points, the others are zero
    return amplitude_spectrum(grid.filled(column - column.mean(axis=0)) / share, grid.rate_hz, MOST_BINS)


def fill_gaps(values: Stacked) -> FloatArray | Stacked:
    """Return values (S, C) with gaps replaced by the mean of their channel, for spectra."""
    if rows_present(values) is None:
        return values
    every = values[:]
    return np.where(np.isfinite(every), every, np.nanmean(every, axis=0))


def folding(
    frequency_hz: Sequence[float], rate_hz: float, samples: int, most: int = HARMONICS[-1]
) -> list[AliasedHarmonic]:
    """Return the harmonics of driven lines that alias onto one of these.

    Up to order `most`, within a bin. Of lines below half the rate. None for many lines, whose harmonics alias onto each
    other in any case.
    """
    few = frequency_hz if len(frequency_hz) <= FEW else ()
    below = [f for f in few if f < rate_hz / 2.0]
    return [fold for f in below for fold in find_aliased_harmonics(f, frequency_hz, rate_hz, rate_hz / samples, most)]


def describe_folds(folds: Sequence[AliasedHarmonic]) -> str:
    """Return aliased harmonics and the lines that they alias onto."""
    return ", ".join(
        f"harmonic {fold.multiple} of {fold.fundamental_hz:.6g} Hz aliases onto {fold.line_hz:.6g} Hz" for fold in folds
    )


def line_strength(readings: Sequence[ChannelReading], lines: LineFrequencies) -> FloatArray | None:
    """Return the acceleration (K,) at each line relative to the strongest one.

    The largest share in any motion channel, else in the sensor's outputs; 0 if no channel measures a line. None without
    such channels.
    """
    moving = [(reading, TRANSDUCERS[q].order) for reading in readings if (q := reading.entry.quantity) in TRANSDUCERS]
    chosen = moving or [(reading, 0) for reading in readings if reading.entry.quantity == "output"]
    shares = []
    for reading, order in chosen:
        size = np.abs(np.nan_to_num(reading.phasors.value[:, 0])) * (2.0 * np.pi * lines.frequency_hz) ** -order
        shares.append(size / max(size.max(), np.finfo(np.float64).tiny))
    return np.asarray(np.max(shares, axis=0)) if shares else None


def expand_lines(phasors: Phasors, mask: BoolArray, frequency_hz: FloatArray) -> Phasors:
    """Return phasors at all lines from those of `mask`, NaN at the others."""
    lines, channels = len(mask), len(phasors.channels)
    value = np.full((lines, channels), np.nan, dtype=np.complex128)
    covariance = np.full((lines, 2 * channels, 2 * channels), np.nan)
    dof = np.zeros(lines)
    value[mask], covariance[mask], dof[mask] = phasors.value, phasors.covariance, phasors.dof
    return Phasors(frequency_hz, value, covariance, phasors.channels, phasors.unit, dof)


# Channels with clipped, lost or coarse samples, and the errors that these cause.

MIN_USABLE_SHARE = 0.25
"""Smallest share of samples that are neither clipped nor lost (chosen); with fewer there is no result."""
DEPTH, NARROWER = 4.0, 0.1
"""Distance of used samples from a limit in deviations of the residual; further distance of a second fit, over the
amplitude (chosen)."""
COARSE_SHARE = 0.05
"""Change by converter steps over the noise of a line above which U includes it (chosen)."""
Fitter = Callable[[Stacked], SineFit]


def require_usable(record: DaqRecord, channel: ChannelEntry) -> None:
    """Raise if too few samples of a channel are neither clipped nor lost."""
    raw, defects = record.raw[channel.name], record.defects(channel)
    if sum(defect.count for defect in defects) > (1.0 - MIN_USABLE_SHARE) * len(raw.samples):
        raise _unusable(record, channel, defects)


def _unusable(record: DaqRecord, channel: ChannelEntry, defects: Sequence[Defect]) -> InputError:
    defects_found = " and ".join(_described(record, channel, defect) for defect in defects)
    expected = f"at least {100 * MIN_USABLE_SHARE:g} % of the samples, at all phases, within the range of the recorder"
    found = f"a channel that {defects_found}"
    return InputError(UNUSABLE_CHANNEL, record.entry.file, channel.stored_name, found=found, expected=expected)


def _described(record: DaqRecord, channel: ChannelEntry, defect: Defect) -> str:
    return defect.text(record.time_s(channel.name), record.raw[channel.name].unit)


def fit_usable(
    record: DaqRecord, group: Sequence[ChannelEntry], fitted: Fitter, time_s: FloatArray
) -> tuple[SineFit, Stacked, ComplexArray | None]:
    """Fit lines to samples that are neither lost nor clipped.

    Returns the fit and the values used (S, C). A channel with such samples is alone in its group. The fitted curve
    decides which samples are clipped, so that noise near a limit does not select them. The third result is the relative
    change of the lines, as Re and Im, if the fit keeps a larger distance from the limits: filters, or a saturating
    amplifier, round samples near them. None without clipping.
    """
    channel, values = group[0], record.usable_samples(group)
    require_usable(record, channel)
    fit = fitted(values)
    clipped = next((defect for defect in record.defects(channel) if defect.kind == "clipped"), None)
    if clipped is None:
        return fit, values, None
    column = values[:]
    low, high = sorted(level * channel.scale for level in clipped.levels)
    for more in (0.0, 0.0, NARROWER):
        curve, before = fit.model(time_s)[:, 0], fit
        depth = DEPTH * float(fit.residual_rms[0]) + more * float(np.ptp(curve)) / 2.0
        inside = (curve > low + depth) & (curve < high - depth)
        if np.count_nonzero(inside & np.isfinite(column[:, 0])) < MIN_USABLE_SHARE * len(values):
            raise _unusable(record, channel, [clipped])
        used = Stacked.from_array(np.where(inside[:, None], column, np.nan))
        try:
            fit = fitted(used)
        except ValueError as error:  # samples that are synchronous with a line show it at too few phases
            raise _unusable(record, channel, [clipped]) from error
        values = values if more else used
    change = fit.phasors.value[:, 0] / before.phasors.value[:, 0] - 1.0
    return before, values, np.asarray(np.abs(change) * (1.0 + 1.0j))


def assess_condition(
    record: DaqRecord, index: int, fit: SineFit, time_s: FloatArray, clipped: ComplexArray | None, seen: BoolArray
) -> tuple[list[ChannelRelativeError], list[Notice]]:
    """Return the errors of a fitted channel caused by its samples, and notices.

    `clipped`: third result of `fit_usable`. The errors are those of all lines (K,), of which the fit contains those
    `seen` first.
    """
    channel = next(entry for entry in record.entry.channel if entry.name == fit.phasors.channels[index])
    step = abs(channel.scale) * converter_step(record.raw[channel.name].samples)
    rounded = _rounded(fit, index, step, time_s)
    where = f"{record.entry.name}, {channel.name}"
    errors, notices = list[ChannelRelativeError](), list[Notice]()
    for kind, change in (("clipping", clipped), ("converter steps", rounded)):
        if change is not None:
            errors += _sample_errors(channel, kind, change, seen)
    for defect in record.defects(channel):
        text = _described(record, channel, defect)
        if defect.kind == "clipped" and clipped is not None:
            u_percent = 100.0 * float(clipped.real[0])
            notices.append(Notice(CLIPPED_CHANNEL, where, defect=text, u_percent=u_percent))
        else:
            notices.append(Notice(REJECTED_SAMPLES, where, defect=text))
    size = float(np.max(np.abs(fit.phasors.value[:, index])))
    if rounded is not None and size < FEWEST_STEPS * step:
        bound_percent = 100.0 * float(np.sqrt(3.0) * rounded.real[0])
        notices.append(Notice(COARSE_CONVERTER, where, steps=size / step, bound_percent=bound_percent))
    return errors, notices


def _rounded(fit: SineFit, index: int, step: float, time_s: FloatArray) -> ComplexArray | None:
    """Return the relative u (K,) by converter steps, Re and Im, None if negligible."""
    size = np.abs(fit.phasors.value[:, index])
    if not step > 0.0 or not size.any():
        return None
    noise = np.hypot(fit.phasors.u_re[:, index], fit.phasors.u_im[:, index])
    u = quantisation_error(fit, index, time_s, step) / np.sqrt(3.0)
    u[size <= NOISE_REACH * noise] = 0.0
    return u if np.any(np.abs(u) * size > COARSE_SHARE * noise) else None


def _sample_errors(
    channel: ChannelEntry, kind: str, change: ComplexArray, seen: BoolArray
) -> Iterator[ChannelRelativeError]:
    """Yield the errors of amplitude and phase of a channel."""
    for part, relative in (("amplitude", change.real + 0.0j), ("phase", 1j * change.imag)):
        effect = np.zeros((len(seen), 1), dtype=np.complex128)
        effect[seen, 0] = relative[: np.count_nonzero(seen)]
        yield ChannelRelativeError(
            f"{channel.name}: {kind}, {part}", f"{chain_name(channel)}: {kind}", 1.0, "1", effect
        )
