"""`shakercal lines`: all lines of a file or recording with origin and aliases."""

from __future__ import annotations

import csv
import io
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from fusion.base import K2
from fusion.errors import InputError, as_input_error
from fusion.phasors.channel_phasors import MOST_BINS, fill_gaps, line_record, lines_of_record
from fusion.phasors.timing import tie_daqs
from fusion.planning.planning_notices import NO_SIGNAL, NOT_FINITE
from fusion.recording.daq_records import check_uniform, errors_in_set_up, read_set_ups
from fusion.recording.load import Manifest
from fusion.report.terminal import print_table, print_text
from shaker.io import read_channels
from shaker.io.channel import RawChannel, Stacked
from shaker.lines.detection import Survey, decibel, survey_lines
from shaker.lines.frequencies import LineFrequencies
from shaker.lines.spectrum import Spectrum, amplitude_spectrum
from shaker.sine.aliasing import alias_frequency
from shaker.sine.sine_fit import fit_sines
from shakercal._common.arrays import FloatArray
from shakercal._common.digits import number_text, quantity_text, scaled_text
from shakercal._common.notices import Notice

COLUMNS = ("channel", "frequency_hz", "u_frequency_hz", "amplitude", "u_amplitude", "unit", "floor_db", "what", "use")
WHY = "what and why"
LISTED = "lines"
"""Location of notices whose content the table shows."""
_SAME_U, _SAME_HZ = 6.0, 1e-6  # largest shift of a line when it is fitted together with others
_HANN_NOISE = 3.0  # noise power in a bin of the figure's spectrum over the variance of a fitted quadrature


@dataclass(frozen=True)
class LineEntry:
    """One spectral line with amplitude, origin and aliases.

    `amplitude` and `u_amplitude` (C,) are NaN in channels without the line; `floor_db` is the level above the noise in
    a bin. `use`: its use by a run (empty for a file); `alias_hz`: its frequency for each camera.
    """

    frequency_hz: float
    u_frequency_hz: float
    amplitude: FloatArray
    u_amplitude: FloatArray
    floor_db: float
    what: str
    use: str = ""
    alias_hz: tuple[float, ...] = ()


@dataclass(frozen=True)
class ChannelLines:
    """Lines of channels sampled together, by frequency, with their noise floor.

    `cameras`: name and rate (Hz) of cameras that observe the lines aliased. `spectrum` is None unless it is drawn.
    """

    source: Path
    channels: tuple[str, ...]
    units: tuple[str, ...]
    rate_hz: float
    samples: int
    entries: tuple[LineEntry, ...]
    cameras: tuple[tuple[str, float], ...]
    spectrum: Spectrum | None
    survey: Survey
    notices: tuple[Notice, ...]


def lines_of_file(
    path: Path,
    names: Sequence[str] | None,
    rate_hz: float | None,
    band_hz: tuple[float, float] | None,
    *,
    drawn: bool = False,
) -> list[ChannelLines]:
    """Return the lines of a DAQ file's channels, in groups of equal sampling.

    A band selects the lines in it. `drawn`: with their spectra for the figure, which need as much memory as the
    samples.
    """
    with as_input_error(path):
        channels = read_channels(path, names, rate_hz)
    groups: dict[tuple[float, int], dict[str, RawChannel]] = {}
    for name, channel in channels.items():
        groups.setdefault((channel.sample_rate_hz, len(channel.samples)), {})[name] = channel
    if not groups:
        raise InputError(NO_SIGNAL, path, found="none", expected="a channel of samples over time")
    return [_file_group(path, group, band_hz, drawn=drawn) for group in groups.values()]


def lines_of_recording(manifest: Manifest, *, drawn: bool = False) -> ChannelLines:
    """Return the lines that a run fits, all others, and the cameras' aliases.

    For a recording in takes they are those of the first one.
    """
    where, block = manifest.set_ups[0]
    with errors_in_set_up(block.path, where):
        first = read_set_ups(block)[0]
        manifest, base = first.manifest, tie_daqs(first.manifest, first.records)
    chosen = line_record(base)
    if chosen is None:
        expected = "a channel that shows the excitation"
        raise InputError(NO_SIGNAL, manifest.path, "daq", found="triggers only", expected=expected)
    lines = lines_of_record(manifest, chosen)
    names = tuple(channel.name for channel in chosen.channels)
    rates = {name: 1.0 / fit.period_s for (_, name), fit in base.triggers.items()}
    pairs: dict[str, list[str]] = {}  # pairs of one trigger
    for pair in (*manifest.images, *manifest.points):
        if pair.trigger in rates:
            pairs.setdefault(pair.trigger, []).append(pair.stereo)
    cameras = tuple((", ".join(seen_by), rates[trigger]) for trigger, seen_by in pairs.items())
    rate_hz = chosen.record.raw[names[0]].sample_rate_hz
    entries = [*_fitted(chosen.time_s, chosen.values, lines, rate_hz), *_others(lines.others, lines.nuisance_hz)]
    return ChannelLines(
        chosen.record.entry.file,
        names,
        tuple(manifest.rig.unit_of(channel.quantity) for channel in chosen.channels),
        rate_hz,
        len(chosen.values),
        tuple(
            replace(entry, alias_hz=tuple(float(alias_frequency(entry.frequency_hz, rate)) for _, rate in cameras))
            for entry in sorted(entries, key=lambda entry: entry.frequency_hz)
        ),
        cameras,
        amplitude_spectrum(fill_gaps(chosen.values), rate_hz, MOST_BINS) if drawn else None,
        lines.others,
        lines.notices,
    )


def lines_csv(lists: Sequence[ChannelLines]) -> str:
    """Return all lines as a table: a row per line and channel."""
    stream = io.StringIO()
    writer = csv.writer(stream, lineterminator="\n")
    cameras = [f"alias_hz_{name.replace(', ', '_')}" for name, _ in lists[0].cameras]
    writer.writerow((*COLUMNS, *cameras))
    for item in lists:
        for entry in item.entries:
            aliases = [f"{alias:.9g}" for alias in entry.alias_hz]
            frequency = [f"{entry.frequency_hz:.12g}", f"{entry.u_frequency_hz:.3g}"]
            for c in np.flatnonzero(np.isfinite(entry.amplitude)):
                size = [f"{entry.amplitude[c]:.9g}", f"{entry.u_amplitude[c]:.3g}", item.units[c]]
                cells = [*size, f"{entry.floor_db:.1f}", entry.what, entry.use, *aliases]
                writer.writerow([item.channels[c], *frequency, *cells])
    return stream.getvalue()


def _file_group(
    path: Path, group: dict[str, RawChannel], band_hz: tuple[float, float] | None, *, drawn: bool
) -> ChannelLines:
    """Return the lines of channels with equal sampling."""
    rate_hz = next(iter(group.values())).sample_rate_hz
    values = Stacked(tuple(channel.samples for channel in group.values()), (1.0,) * len(group))
    for name, channel in group.items():
        check_uniform(path, name, channel)
        missing = int(np.count_nonzero(~np.isfinite(channel.samples)))
        if missing:
            raise InputError(NOT_FINITE, path, name, found=f"{missing} that are not", expected="finite samples")
    with as_input_error(path, next(iter(group))):
        survey = survey_lines(values, rate_hz)
    if band_hz is not None:
        survey = survey.select((survey.frequency_hz >= band_hz[0]) & (survey.frequency_hz <= band_hz[1]))
    return ChannelLines(
        path,
        tuple(group),
        tuple(channel.unit for channel in group.values()),
        rate_hz,
        len(values),
        tuple(_others(survey, None)),
        (),
        amplitude_spectrum(values, rate_hz, MOST_BINS) if drawn else None,
        survey,
        survey.notices,
    )


def _fitted(time_s: FloatArray, values: Stacked, lines: LineFrequencies, rate_hz: float) -> list[LineEntry]:
    """Return the lines that a run fits."""
    names = [str(c) for c in range(values.shape[1])]
    both = np.concatenate([lines.frequency_hz, lines.nuisance_hz])
    phasors = fit_sines(time_s, values, both, names, names).phasors
    amplitude = np.abs(phasors.value)
    u = np.sqrt((phasors.u_re**2 + phasors.u_im**2) / 2.0)
    entries = []
    for k, (frequency, u_frequency) in enumerate(zip(lines.frequency_hz, lines.u_frequency_hz, strict=True)):
        height = decibel(float(np.max((amplitude[k] / np.maximum(u[k], np.finfo(np.float64).tiny)) ** 2)) / _HANN_NOISE)
        nominal_hz, multiple = lines.nominal_hz[k], lines.multiple[k]
        what = f"fundamental, nominally {number_text(nominal_hz, 6)} Hz"
        if multiple != 1:
            (first, *_) = np.flatnonzero((lines.multiple == 1) & (lines.nominal_hz == nominal_hz))
            share = float(np.max(amplitude[k] / amplitude[first]))
            what = f"harmonic {multiple} of {number_text(nominal_hz, 6)} Hz, {number_text(share, 2)} of it"
        if frequency > rate_hz / 2.0:
            what += f", read at {number_text(float(alias_frequency(frequency, rate_hz)), 6)} Hz"
        entries.append(LineEntry(float(frequency), float(u_frequency), amplitude[k], u[k], height, what, "fitted"))
    return entries


def _others(survey: Survey, nuisance_hz: FloatArray | None) -> list[LineEntry]:
    """Return lines of a survey, with their use in addition to fitted lines."""
    entries = []
    for i, origin in enumerate(survey.origin):
        frequency = float(survey.frequency_hz[i])
        use = ""
        if nuisance_hz is not None:
            is_nuisance = bool(np.any(np.abs(nuisance_hz - frequency) <= _SAME_U * survey.u_frequency_hz[i] + _SAME_HZ))
            use = "fitted in addition" if is_nuisance else "not fitted"
        numbers = frequency, float(survey.u_frequency_hz[i]), survey.amplitude[i], survey.u_amplitude[i]
        entries.append(LineEntry(*numbers, decibel(float(survey.snr[i])), origin.text, use))
    return entries


def print_lines(lists: Sequence[ChannelLines]) -> None:
    """Print the lines to stdout, a table for each group of channels."""
    for item in lists:
        names, duration = ", ".join(item.channels), item.samples / item.rate_hz
        seen = "".join(f"; {pairs}: lines as seen at {number_text(rate, 6)} Hz" for pairs, rate in item.cameras)
        size = f"{item.samples} samples at {number_text(item.rate_hz, 9)} Hz, {number_text(duration, 4)} s"
        print_text(f"{item.source.name}: {names}; {size}{seen}")
        if not item.entries:
            print_text("  no line above the noise")
            continue
        rows = [_cells(item, entry) for entry in item.entries]
        align = "".join("l" if head in ("in channel", WHY) else "r" for head in rows[0])
        print_table("", [*rows[0]], align, [[[*row.values()] for row in rows]])
    for notice in dict.fromkeys(notice for item in lists for notice in item.notices if notice.where != LISTED):
        print_text(f"{notice.severity} {notice.code}: {notice.text}")
    print_text(
        "U (k = 2); amplitude: in the channel with the highest line; dB: its power over that of the noise in a bin of "
        "the Hann spectrum"
    )


def _cells(item: ChannelLines, entry: LineEntry) -> dict[str, str]:
    """Return the cells of a line by the heads of their columns."""
    best = int(np.nanargmax(entry.amplitude / np.maximum(entry.u_amplitude, np.finfo(np.float64).tiny)))
    size = quantity_text(float(entry.amplitude[best]), K2 * float(entry.u_amplitude[best]), item.units[best])
    aliases = {
        f"seen by {name} at / Hz": f"{alias:.4f}" for (name, _), alias in zip(item.cameras, entry.alias_hz, strict=True)
    }
    return {
        "frequency / Hz": scaled_text(entry.frequency_hz, K2 * entry.u_frequency_hz),
        **aliases,
        "amplitude": size,
        **({"in channel": item.channels[best]} if len(item.channels) > 1 else {}),
        "dB": f"{entry.floor_db:.0f}",
        WHY: f"{entry.use}: {entry.what}" if entry.use else entry.what,
    }
