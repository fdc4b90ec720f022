"""Checks of channels: clipping, failure, drift, mains, triggers, aliases."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from fusion.phasors.channel_phasors import describe_folds, folding
from fusion.planning.look.finding import Finding
from fusion.planning.look.look_notices import (
    ALIASED_HARMONIC,
    ALIASED_LINES,
    DRIVEN_LINE_MISSING,
    IRREGULAR_EDGES,
    LOOK_CONSTANT_CHANNEL,
    LOOK_TRIGGER_JITTER,
    MAINS_PICKUP,
    NO_PERIODIC_TRIGGER,
    OTHER_LINE_DRIVEN,
    SIGNAL_DEFECT,
    SIGNAL_DRIFT,
)
from fusion.recording.daq_records import DaqRecord
from fusion.recording.load import Manifest
from fusion.recording.manifest import ChannelEntry, Daq
from fusion.recording.placement import main_direction
from fusion.recording.transducer import TRANSDUCERS
from shaker.io.channel import RawChannel
from shaker.io.condition import FEWEST_STEPS, Defect, converter_step
from shaker.lines.detection import Survey, survey_lines
from shaker.sine.aliasing import alias_frequency, nearest_clear_rate, separation_bins
from shaker.timebase.trigger import TriggerFit
from shakercal._common.arrays import FloatArray
from shakercal._common.notices import Notice

LOOKED_AT = 1 << 16  # samples in which lines are searched for
FEWEST = 64  # least number of samples for a search of lines
DRIFTS, MAINS = 0.2, 0.05  # limits relative to the amplitude of the driven line
DRIVEN_SHARE = 0.7  # cosine between driven direction and channel from which the line must be visible
CLOSE_BINS, LOST_BINS = 1.0, 0.5  # distance of lines that disturb each other; that cannot be resolved


@dataclass(frozen=True)
class LineStrength:
    """A driven line in a channel: amplitude in SI and relative u by noise."""

    entry: ChannelEntry
    frequency_hz: float
    amplitude: float
    u_relative: float


def examine_channels(manifest: Manifest, record: DaqRecord) -> tuple[list[Finding], list[LineStrength]]:
    """Return the findings of a recorder's channels, and the amplitudes of the driven lines."""
    daq, raw = record.entry, record.raw
    found: list[Finding] = []
    strengths: list[LineStrength] = []
    groups: dict[tuple[float, int], list[ChannelEntry]] = {}
    for entry in daq.channel:
        channel = raw[entry.name]
        where = f"{daq.name}.{entry.name}"
        if not np.isfinite(channel.samples).any():
            found.append(Finding("REPEAT", Notice(SIGNAL_DEFECT, where, defect="no sample is a finite number")))
        elif np.ptp(channel.samples[np.isfinite(channel.samples)]) == 0.0:
            constant = Notice(LOOK_CONSTANT_CHANNEL, where, value=float(channel.samples[0]), unit=channel.unit)
            found.append(Finding("REPEAT", constant))
        elif entry.quantity != "trigger":
            texts = [defect.text(record.time_s(entry.name), channel.unit) for defect in record.defects(entry)]
            found += [Finding("REPEAT", Notice(SIGNAL_DEFECT, where, defect=text)) for text in texts]
            # Only the evaluation finds lines at stamped times, and in a record with gaps.
            if channel.stamp_s is None and not texts and np.isfinite(channel.samples).all():
                groups.setdefault((channel.sample_rate_hz, len(channel.samples)), []).append(entry)
    for (rate_hz, samples), entries in groups.items():
        if samples < FEWEST:
            found.append(Finding("REPEAT", Notice(SIGNAL_DEFECT, daq.name, defect=f"only {samples} samples")))
            continue
        folds = folding(manifest.excitation.frequencies or (), rate_hz, samples)
        if folds and not all(entry.response for entry in entries):
            notice = Notice(ALIASED_HARMONIC, daq.name, lines=describe_folds(folds), rate_hz=rate_hz)
            found.append(Finding("CHECK", notice))
        for finding, strength in _lines(manifest, daq, entries, raw):
            found += finding
            strengths += strength
    return found, strengths


def _lines(
    manifest: Manifest, daq: Daq, entries: Sequence[ChannelEntry], raw: Mapping[str, RawChannel]
) -> Iterator[tuple[list[Finding], list[LineStrength]]]:
    """Yield findings and driven lines of channels with equal sampling, channel by channel."""
    nominal = manifest.excitation.frequencies or ()
    rate_hz, samples = raw[entries[0].name].sample_rate_hz, len(raw[entries[0].name].samples)
    values = np.stack([raw[entry.name].samples[:LOOKED_AT] for entry in entries], axis=1)
    length = len(values)
    survey = survey_lines(values - values.mean(axis=0), rate_hz, [f for f in nominal if f < rate_hz / 2])
    alias = alias_frequency(np.array(nominal), rate_hz) if nominal else np.empty(0)
    near = [int(np.argmin(np.abs(survey.frequency_hz - a))) if len(survey.frequency_hz) else -1 for a in alias]
    bins = rate_hz / length
    near = [
        i if i >= 0 and abs(survey.frequency_hz[i] - a) < 1e-2 * a + 3 * bins else -1
        for i, a in zip(near, alias, strict=True)
    ]
    for c, entry in enumerate(entries):
        where, found, strengths = f"{daq.name}.{entry.name}", list[Finding](), list[LineStrength]()
        for frequency, i in zip(nominal, near, strict=True):
            amplitude = float(survey.amplitude[i, c]) if i >= 0 else np.nan
            if np.isfinite(amplitude):
                u = float(survey.u_amplitude[i, c]) / amplitude * np.sqrt(length / samples)
                strengths.append(LineStrength(entry, frequency, abs(entry.scale) * amplitude, u))
            elif _must_see(manifest, entry):
                found.append(_missing_line(where, frequency, survey, c))
        strongest = max((s.amplitude / abs(entry.scale) for s in strengths), default=0.0)
        if strongest > 0.0:
            found += _drift_and_steps(where, raw[entry.name], strongest, driven=_must_see(manifest, entry))
            mains = [
                (float(survey.amplitude[i, c]), survey.frequency_hz[i], origin)
                for i, origin in enumerate(survey.origin)
                if origin.kind == "mains" and np.isfinite(survey.amplitude[i, c])
            ]
            if mains and max(mains)[0] > MAINS * strongest:
                share_percent = 100 * max(mains)[0] / strongest
                notice = Notice(MAINS_PICKUP, where, frequency_hz=max(mains)[1], share_percent=share_percent)
                found.append(Finding("CHECK", notice))
        yield found, strengths


def _missing_line(where: str, frequency_hz: float, survey: Survey, c: int) -> Finding:
    """Return a missing driven line, with the line in its place.

    Another line in its place is a mistake of the manifest.
    """
    driven = [
        (float(survey.amplitude[i, c]), float(survey.frequency_hz[i]))
        for i, origin in enumerate(survey.origin)
        if origin.kind != "mains" and np.isfinite(survey.amplitude[i, c])
    ]
    if not driven:
        return Finding("REPEAT", Notice(DRIVEN_LINE_MISSING, where, frequency_hz=frequency_hz))
    notice = Notice(OTHER_LINE_DRIVEN, where, frequency_hz=frequency_hz, found_hz=max(driven)[1])
    return Finding("FIX MANIFEST", notice)


def _drift_and_steps(where: str, channel: RawChannel, amplitude: float, *, driven: bool) -> Iterator[Finding]:
    """Yield drift, and a signal of few converter steps."""
    tenth = max(len(channel.samples) // 10, 1)
    drift = abs(float(np.mean(channel.samples[-tenth:]) - np.mean(channel.samples[:tenth])))
    if drift > DRIFTS * amplitude:
        sizes = {"drift": drift, "share_percent": 100 * drift / amplitude}
        yield Finding("CHECK", Notice(SIGNAL_DRIFT, where, unit=channel.unit, **sizes))
    step = converter_step(channel.samples) if driven else 0.0
    if step > 0.0 and amplitude < FEWEST_STEPS * step:
        coarse = Defect("steps", np.zeros((0, 2), dtype=np.int64), (), step, amplitude / step)
        yield Finding("CHECK", Notice(SIGNAL_DEFECT, where, defect=coarse.text(channel.time_s, channel.unit)))


def _must_see(manifest: Manifest, entry: ChannelEntry) -> bool:
    """Return whether a channel measures the driven direction."""
    driven = np.asarray(manifest.excitation.direction or ())
    if len(driven) != 3:
        return False
    if entry.quantity == "output":
        names = ("Fx", "Fy", "Fz")
        return entry.channel in names and abs(float(driven[names.index(entry.channel)])) > DRIVEN_SHARE
    aimed = entry.quantity in TRANSDUCERS and not TRANSDUCERS[entry.quantity].rotational
    return aimed and abs(float(np.asarray(main_direction(entry)) @ driven)) > DRIVEN_SHARE


# Triggers, and aliases of the driven lines.


def fit_trigger_channel(record: DaqRecord, entry: ChannelEntry) -> TriggerFit | str:
    """Return the periodic model of a trigger channel, or the reason without one."""
    try:
        return record.fit_trigger(entry)
    except ValueError as error:
        return str(error).partition(": ")[2] or str(error)


def examine_trigger(where: str, fit: TriggerFit | str) -> Iterator[Finding]:
    """Yield the errors of a trigger's edges."""
    if isinstance(fit, str):
        yield Finding("REPEAT", Notice(NO_PERIODIC_TRIGGER, where, reason=fit))
        return
    if fit.missing:
        numbers = ", ".join(map(str, fit.missing[:5])) + (" …" if len(fit.missing) > 5 else "")
        lost = Notice(IRREGULAR_EDGES, where, count=len(fit.missing), edges=fit.edges, kind=f"lost (number {numbers})")
        yield Finding("REPEAT", lost)
    if fit.doubled or fit.spurious:
        count, kind = fit.doubled + fit.spurious, "doubled or stray"
        yield Finding("CHECK", Notice(IRREGULAR_EDGES, where, count=count, edges=fit.edges, kind=kind))
    if fit.jitter_detected:
        yield Finding("CHECK", Notice(LOOK_TRIGGER_JITTER, where, jitter_us=1e6 * fit.jitter_s))


def examine_beat(where: str, frequencies_hz: Sequence[float], fit: TriggerFit, frames: int) -> Iterator[Finding]:
    """Yield driven lines that the camera rate aliases onto each other or onto zero."""
    rate_hz = 1.0 / fit.period_s
    lines = np.array(sorted(frequencies_hz), dtype=np.float64)
    bins = separation_bins(lines, rate_hz, frames) if len(lines) else np.inf
    if bins < CLOSE_BINS:
        clear = nearest_clear_rate(lines, rate_hz, frames)
        advice = f", such as {clear:.6g} frames/s" if clear is not None else ""
        aliases = zip(lines, alias_frequency(lines, rate_hz), strict=True)
        driven = "driven lines (" + ", ".join(f"{f:g} Hz at {a:.3g} Hz" for f, a in aliases) + ")"
        notice = Notice(ALIASED_LINES, where, lines=driven, advice=advice, rate_hz=rate_hz, distance_bins=bins)
        yield Finding("REPEAT" if bins < LOST_BINS else "CHECK", notice)
    elif 0 < len(lines) <= 5:
        harmonics: FloatArray = np.outer(lines, (1.0, 2.0, 3.0)).ravel()
        bins = separation_bins(harmonics, rate_hz, frames)
        if bins < CLOSE_BINS:
            text = "driven lines and their harmonics up to the third"
            notice = Notice(ALIASED_LINES, where, lines=text, advice="", rate_hz=rate_hz, distance_bins=bins)
            yield Finding("CHECK", notice)
