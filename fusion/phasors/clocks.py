"""Clocks tied by lines in channels, and trigger periods by lines in frames."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import replace

import numpy as np

from fusion.errors import InputError
from fusion.phasors.channel_phasors import MIN_BEAT_PERIODS, channels_of_same_times, fastest_channel, line_clock
from fusion.phasors.phasor_notices import FRAMES_FREE_RUNNING, IMAGES_REFUSED, PERIODS_DISAGREE
from fusion.phasors.stereo_motion import StereoMotion, resolved_lines
from fusion.phasors.timing import U_FRAME_RATE, TimeBase, frame_sight
from fusion.recording.load import Manifest
from fusion.recording.manifest import Images, PointFiles
from fusion.recording.transducer import STATIONARY, TRANSDUCERS
from shaker.labels import MOTION_COMPONENTS, component_units
from shaker.lines.frequencies import LineFrequencies
from shaker.sine.aliasing import alias_frequency
from shaker.sine.sine_fit import fit_sines
from shaker.sine.solve import SineModel
from shaker.timebase.tie import ClockTie, tie_clocks
from shaker.timebase.trigger import MAX_DISAGREEMENT_SIGMAS, TriggerFit, nominal_trigger
from shakercal._common.arrays import FloatArray
from shakercal._common.notices import Notice

UNCERTAIN_SAMPLES, JITTERS = {"sampled": 0.15, "resolved": 0.01}, 3.0
"""Uncertainty of the burst's length above which edges are nearly locked: in samples, and over that by jitter."""
MIN_IMPROVEMENT = 0.5
"""Largest u of another period, over that by edges, for it to be used (chosen)."""

RATE_STEP = 0.2
"""Turns of a line over the record from one frame rate to the next of a search (chosen)."""
LARGEST_RATE_ERROR, LEAST_EXPLAINED = 3.0 * U_FRAME_RATE, 0.5
"""Largest relative error of a stated frame rate, and least share of the motion's variance in the lines (chosen)."""
TURN = 0.01
"""Phase in rad at the end of a record by an uncertain rate, above which lines refine it: 2e-5 of the amplitude."""
U_SHARED_FREQUENCY = 1e-8
"""Relative standard uncertainty of a frequency common to two blocks: the drift of a generator in a minute."""
ValueWithU = tuple[float, float]
"""A value and its standard uncertainty."""


# Rates of clocks by the lines.


def refine_ties(base: TimeBase, lines: LineFrequencies) -> tuple[TimeBase, LineFrequencies]:
    """Return ties refined by the lines, and the lines on that clock.

    A wrong rate r costs a sine over T seconds (πfTr)²/6 of its amplitude, which no first-order uncertainty includes.
    Ties whose u of the rate turns every line by less than `TURN` over half the record are unchanged. Frequencies that
    contradict the edges are reported and change no tie.
    """
    length_s = max(float(np.ptp(fit.edge_s)) for fit in base.triggers.values()) if base.triggers else 0.0
    turn = np.pi * float(lines.frequency_hz.max()) * length_s
    uncertain_ties = {
        name: tie for name, tie in base.ties.items() if tie is not None and turn * tie.covariance[1, 1] ** 0.5 > TURN
    }
    seen = line_rates(base, lines, list(uncertain_ties))
    ties = {name: tie.with_rate(*seen[name]) for name, tie in uncertain_ties.items() if name in seen}
    return (base, lines) if not ties else with_ties(base, lines, ties)


def with_ties(base: TimeBase, lines: LineFrequencies, ties: Mapping[str, ClockTie]) -> tuple[TimeBase, LineFrequencies]:
    """Return a time base with some ties replaced, and the lines on its clock."""
    fastest, refined = fastest_channel(base), replace(base, ties={**base.ties, **ties})
    if fastest is None or fastest[0].entry.name not in ties:
        return refined, lines
    found_in = fastest[0].entry.name
    scale = base.ties[found_in].rate / refined.ties[found_in].rate  # type: ignore[union-attr]
    plain = replace(
        lines,
        frequency_hz=lines.frequency_hz * scale,
        u_frequency_hz=_relative_u_without_clock(base, lines) * lines.frequency_hz,
        nuisance_hz=lines.nuisance_hz * scale,
    )
    return refined, refined.add_clock_uncertainty(plain, line_clock(refined))


def _relative_u_without_clock(base: TimeBase, lines: LineFrequencies) -> FloatArray:
    """Return the relative u (K,) of the frequencies on the clock of their channel."""
    clock = float(np.linalg.norm([error.rate for error in line_clock(base)]))
    return np.sqrt(np.maximum((lines.u_frequency_hz / lines.frequency_hz) ** 2 - clock**2, 0.0))


def line_rates(base: TimeBase, lines: LineFrequencies, names: Sequence[str]) -> dict[str, tuple[float, float]]:
    """Return the rates of other blocks' ties, with u, from the lines alone.

    One generator drives the lines of all blocks. The ratio of two clock rates is that of the frequencies found, orders
    of magnitude more precise than from edges between samples. Blocks without lines are omitted.
    """
    fastest, first = fastest_channel(base), base.records[0].entry.name
    if fastest is None or not names:
        return {}
    found_in = fastest[0].entry.name
    stretches = {found_in: (0.0, float(_relative_u_without_clock(base, lines).min()))}
    for name in {first, *names} - {found_in}:
        found = line_stretch(base, name, lines)
        stretches |= {} if found is None else {name: found}
    rates = {}
    for name in (name for name in names if name in stretches and first in stretches):
        tie, (stretch, u), (reference, u_reference) = base.ties[name], stretches[name], stretches[first]
        assert tie is not None
        seen = tie.rate * (1.0 + stretch) / (1.0 + reference)
        rates[name] = seen, tie.rate * float(np.linalg.norm([u, u_reference, U_SHARED_FREQUENCY]))
    return rates


def line_stretch(
    base: TimeBase, name: str, lines: LineFrequencies, body: str = "", span_s: tuple[float, float] = (-np.inf, np.inf)
) -> tuple[float, float] | None:
    """Return the relative offset of all line frequencies in a block, with u, or None.

    None if the block has no lines. `body`: use channels of its motion only. `span_s`: use samples in this interval.
    """
    record = base.record(name)
    groups = sorted(channels_of_same_times(record), key=lambda group: -record.raw[group[0].name].sample_rate_hz)
    for group in groups:
        chosen = [c for c in group if not body or (c.quantity in TRANSDUCERS and c.body == body)]
        if not chosen:
            continue
        rate_hz = record.raw[group[0].name].sample_rate_hz
        frequency_hz = lines.frequency_hz[lines.frequency_hz < rate_hz / 2.0]
        time_s = base.to_base_s(name, record.time_s(group[0].name))
        inside = (time_s >= span_s[0]) & (time_s <= span_s[1])
        with suppress(ValueError):
            names, free = [member.name for member in chosen], SineModel(free=(0,) * len(frequency_hz))
            values = record.usable_samples(chosen).select_rows(None if inside.all() else inside)
            fit = fit_sines(time_s[inside], values, frequency_hz, names, names, model=free)
            ratio = float(fit.phasors.frequency_hz[0] / frequency_hz[0])
            return ratio - 1.0, float(fit.u_frequency_hz[0] / frequency_hz[0])
    return None


# Periods of camera triggers by the motion.


def tie_clocks_by_motion(
    manifest: Manifest, base: TimeBase, motions: Sequence[StereoMotion], lines: LineFrequencies
) -> tuple[TimeBase, tuple[StereoMotion, ...], LineFrequencies]:
    """Return clocks, exposures and lines with periods of camera triggers from the motion.

    For periods that edges leave uncertain and other data determine. Motion at a frequency f known from channels turns
    by 2πfT from frame to frame, so that its alias in the frames determines the trigger's period T. Another block that
    records the trigger determines it by its edges, on a clock whose rate the lines determine.

    Edges at equal positions between samples leave T uncertain by a sample over the record. With T, the intervals of
    edges that pass a sample determine the instants of all, and with them the ties. Phases determine no instants: the
    phase of the outputs is the measurand, and the fusion compares delays of cameras and other instruments on one body.
    A period that contradicts the edges is reported and changes no clock. Without an uncertain period the same objects
    are returned. Frames without a trigger have no edges: the motion alone determines their period.
    """
    tied, free = base, {entry.trigger: entry for entry in manifest.images if entry.frame_rate is not None}
    for trigger in dict.fromkeys(measured.sight.exposure.trigger for measured in motions):
        of_trigger = [measured for measured in motions if measured.sight.exposure.trigger == trigger]
        if trigger in free:
            tied = _with_frame_rate(manifest, tied, free[trigger], of_trigger, lines)
        else:
            tied, lines = _refined(tied, of_trigger, lines, trigger)
    if tied is base:
        return base, tuple(motions), lines
    entries: dict[str, Images | PointFiles] = {entry.stereo: entry for entry in manifest.images}
    entries |= {entry.stereo: entry for entry in manifest.points}
    renewed = []
    for measured in motions:
        sight = measured.sight
        first = int(sight.edge[0])
        renewed_sight = frame_sight(manifest, tied, entries[sight.name], sight.edge - first, first_edge=first)
        sight = replace(sight, time_s=renewed_sight.time_s, model_share=renewed_sight.model_share)
        renewed.append(replace(measured, sight=sight))
    return tied, tuple(renewed), lines


def _with_frame_rate(
    manifest: Manifest, base: TimeBase, entry: Images, motions: Sequence[StereoMotion], lines: LineFrequencies
) -> TimeBase:
    """Return clocks in which the motion determines the period of frames without a trigger.

    Their start remains unknown within a period of the lowest line: a rectangular distribution (GUM 4.3.7).
    """
    daq, fit = base.first_with(entry.trigger)
    near = [_at_near_rate(measured, lines) for measured in motions]
    seen, stated_hz = period_from_motion(base, near, lines), entry.frame_rate
    assert stated_hz is not None
    moving = [measured for measured in near if measured.sight.pair.body != STATIONARY]
    explained = 0.0 if seen is None else min(_explained(measured, lines, seen[0]) for measured in moving)
    if seen is None or explained < LEAST_EXPLAINED or abs(1.0 / (seen[0] * stated_hz) - 1.0) > LARGEST_RATE_ERROR:
        where, found = f"images.{entry.stereo}.frame_rate", f"{stated_hz:g} Hz, which the motion does not confirm"
        within = f"the rate within {100.0 * LARGEST_RATE_ERROR:g} %"
        expected = f"{within}, and two periods of the beat of a driven line or more, which determine it"
        raise InputError(IMAGES_REFUSED, manifest.path, where, found=found, expected=expected)
    u_start_s = 1.0 / (np.sqrt(12.0) * float(lines.frequency_hz.min()))
    start = nominal_trigger(fit.edges, seen[0], np.diag([u_start_s, seen[1]]) ** 2)
    notice = Notice(FRAMES_FREE_RUNNING, "frames", rate_hz=1.0 / seen[0], u_relative=seen[1] / seen[0])
    free = replace(start, known_period_s=seen, notices=(notice,))
    return replace(base, triggers={**base.triggers, (daq, entry.trigger): free})


def _explained(measured: StereoMotion, lines: LineFrequencies, period_s: float) -> float:
    """Return the share of a motion's variance, first component, that lines at a rate explain."""
    sight, values = measured.sight, measured.motion.pose[:, 0]
    edge, usable = sight.edge - sight.edge[0], np.isfinite(values)
    wave = np.exp(2j * np.pi * period_s * np.multiply.outer(edge[usable], lines.frequency_hz))
    design = np.concatenate([np.ones((len(wave), 1)), wave.real, wave.imag], axis=1)
    residual = values[usable] - design @ np.linalg.lstsq(design, values[usable], rcond=None)[0]
    return float(1.0 - np.var(residual) / np.var(values[usable]))


def _at_near_rate(measured: StereoMotion, lines: LineFrequencies) -> StereoMotion:
    """Return the largest motion, as its first component, at a better frame rate.

    It is the rate near the stated one at which the first line is largest. With a rolling shutter no frame shows a rigid
    body: the motion is the first principal component of the subsets' positions.
    """
    time_s, series = measured.sight.time_s, measured.motion.pose[:, :3]
    if any(measured.sight.pair.row_time) and measured.view is not None:
        series = np.concatenate([block.left.position_px for block in measured.view.tracks]).reshape(len(time_s), -1)
    usable = np.isfinite(measured.motion.pose).all(axis=1)
    moved = np.nan_to_num(series[usable] - series[0])
    moved -= moved.mean(axis=0)
    driven = np.full(len(time_s), np.nan)
    driven[usable] = moved @ np.linalg.svd(moved, full_matrices=False)[2][0]
    middle, frequency_hz = float(time_s.mean()), float(lines.frequency_hz[0])
    step = RATE_STEP / (frequency_hz * float(np.ptp(time_s)))
    most = np.ceil(LARGEST_RATE_ERROR / step)
    stretch = 1.0 + step * np.arange(-most, most + 1)
    turn = 2j * np.pi * frequency_hz * np.multiply.outer(stretch, time_s[usable] - middle)
    best = stretch[np.argmax(np.abs(np.exp(-turn) @ driven[usable]))]
    sight = replace(measured.sight, time_s=middle + best * (time_s - middle))
    return replace(measured, sight=sight, motion=replace(measured.motion, pose=driven[:, None] * np.eye(6)[0]))


def nearly_locked(fit: TriggerFit) -> bool:
    """Return whether equal positions of edges between samples leave the burst's length uncertain.

    By `UNCERTAIN_SAMPLES` of a sample and more, as standard uncertainty. Jitter contributes σ·√(12/E) over their length
    to the slope of a line through E edges. It is the same in all blocks that record them, and is unchanged.
    """
    length = float(np.sqrt(fit.covariance[1, 1])) * fit.edges
    return bool(
        length > max(UNCERTAIN_SAMPLES[fit.kind] * fit.sample_s, JITTERS * fit.jitter_s * np.sqrt(12.0 / fit.edges))
    )


def _refined(
    base: TimeBase, motions: Sequence[StereoMotion], lines: LineFrequencies, trigger: str
) -> tuple[TimeBase, LineFrequencies]:
    """Return clocks and lines with the uncertain periods of one trigger replaced.

    Each block gets the mean of the periods by the motion and by the certain edges in other blocks. A tie, which reads
    the intervals of both its blocks, gets those by motion and lines. Resolved edges are paired as they are, because a
    common error of both rises is not known.
    """
    fits = {daq: fit for (daq, name), fit in base.triggers.items() if name == trigger}
    first, origin = next(iter(fits)), base.records[0].entry.name
    if not any(nearly_locked(fit) for fit in fits.values()):
        return base, lines
    seen = period_from_motion(base, motions, lines)
    others = [daq for daq in fits if daq != origin and base.shared_triggers(origin, daq)[:1] == [trigger]]
    rates = {first: (1.0, 0.0), **line_rates(base, lines, others)}  # seconds of the first clock in one of the block's
    by_edges = {
        daq: _times((fits[daq].period_s, float(fits[daq].covariance[1, 1] ** 0.5)), rates[daq]) for daq in rates
    }
    triggers, ties, by_motion = dict(base.triggers), dict[str, ClockTie](), dict(fits)
    for daq, rate in rates.items():
        fit, limit, back = fits[daq], MIN_IMPROVEMENT * by_edges[daq][1], (1.0 / rate[0], rate[1] / rate[0] ** 2)
        readings = [] if seen is None else [seen]
        readings += [by_edges[name] for name in rates if name != daq and not nearly_locked(fits[name])]
        if readings and nearly_locked(fit):
            triggers[daq, trigger] = _with_period(fit, readings, limit, back)
        if seen is not None and seen[1] < limit:
            by_motion[daq] = fit.with_period(*_times(seen, back))
        tie = base.ties[daq]
        found = [triggers[name, trigger] for name in (first, daq)]
        sampled = all(fit.kind == "sampled" for fit in found)
        if daq != first and tie is not None and sampled and any(fit.known_period_s for fit in found):
            pair = [replace(by_motion[n], open_s=one.open_s) for n, one in zip((first, daq), found, strict=True)]
            ties[daq] = _renewed_tie(tie, *pair, rate=rate)
    return with_ties(replace(base, triggers=triggers), lines, ties)


def _with_period(fit: TriggerFit, readings: Sequence[ValueWithU], limit: float, back: ValueWithU) -> TriggerFit:
    """Return a trigger with the mean period, if readings agree and determine it better."""
    mean = _mean(readings)
    difference, both = float(np.ptp([value for value, _ in readings])), float(np.linalg.norm([u for _, u in readings]))
    if difference > MAX_DISAGREEMENT_SIGMAS * both:
        notice = Notice(PERIODS_DISAGREE, "trigger", difference=difference / mean[0], u=both / mean[0])
        return replace(fit, notices=(*fit.notices, notice))
    return fit.with_period(*_times(mean, back)) if mean[1] < limit else fit


def _renewed_tie(tie: ClockTie, base: TriggerFit, other: TriggerFit, *, rate: ValueWithU) -> ClockTie:
    """Return a tie by both blocks' edges and the lines' rate, if these agree."""
    agreed = tie.with_rate(*rate)
    if len(agreed.notices) > len(tie.notices):
        return replace(tie, notices=tuple(dict.fromkeys(agreed.notices)))
    renewed = tie_clocks(base, other, tie.shift, rate=rate)
    return replace(renewed, decided_by=tie.decided_by, notices=(*tie.notices, *renewed.notices))


def _times(one: ValueWithU, other: ValueWithU) -> ValueWithU:
    """Return the product of two independent quantities."""
    return one[0] * other[0], float(np.hypot(one[1] * other[0], other[1] * one[0]))


def _mean(readings: Sequence[ValueWithU]) -> ValueWithU:
    """Return the weighted mean of independent readings of one quantity.

    Weighted by their variances; readings that differ by more than their u enlarge it (Birge ratio).
    """
    value, u = np.array(readings).T
    weight = u**-2.0
    mean = float(weight @ value / np.sum(weight))
    birge = max(1.0, float(weight @ (value - mean) ** 2) / max(len(value) - 1, 1))
    return mean, float(np.sqrt(birge / np.sum(weight)))


def period_from_motion(base: TimeBase, motions: Sequence[StereoMotion], lines: LineFrequencies) -> ValueWithU | None:
    """Return a trigger's period as the motion of some pairs determines it, or None.

    None if its edges are more precise. On the clock of the first block that records the trigger. Lines are compared
    with channels that measure the same body during the frames, first on that block, else with all channels. The
    frequencies that these find have the error of their clock, and so has the period.
    """
    daq, fit = base.first_with(motions[0].sight.exposure.trigger)
    limit, tie = MIN_IMPROVEMENT * float(np.sqrt(fit.covariance[1, 1])), base.ties[daq]
    moving = [measured for measured in motions if measured.sight.pair.body != STATIONARY]
    frames = [(measured, seen) for measured in moving if (seen := frame_interval(measured, lines)) is not None]
    if not frames or _mean([seen for _, seen in frames])[1] > limit:
        return None
    periods, u_lines = [], U_SHARED_FREQUENCY
    for measured, seen in frames:
        reference = _reference(base, daq, measured, lines)
        if reference is None:
            return None
        periods.append(_times(seen, (1.0 / (1.0 + reference[0]) / (1.0 if tie is None else tie.rate), 0.0)))
        u_lines = max(u_lines, reference[1])
    period_s, u = _mean(periods)
    u = float(np.hypot(u, u_lines * period_s))
    return (period_s, u) if u < limit else None


def frame_interval(measured: StereoMotion, lines: LineFrequencies) -> ValueWithU | None:
    """Return the time between frames, with u, on the clock with the stated line frequencies.

    A fit with one free change of all frequencies (four parameters, IEEE 1057) to frames at even distances, whose error
    is that of the lines with opposite sign. For lines with two beats or more; over fewer, a change of frequency is not
    separable from the offset and the line. None without such a line.
    """
    number, time_s = np.arange(len(measured.sight.time_s)), measured.sight.time_s
    start_s, distance_s = np.polynomial.Polynomial.fit(number, time_s, 1).convert().coef.tolist()
    frequency_hz = lines.frequency_hz[resolved_lines(measured, lines)[0]]
    alias = alias_frequency(frequency_hz, 1.0 / distance_s)
    beats = len(number) * distance_s * np.minimum(alias, 0.5 / distance_s - alias)
    free = np.where(beats >= MIN_BEAT_PERIODS, 0, -1)
    if not np.any(free == 0):
        return None
    even_s, model = start_s + distance_s * number, SineModel(free=tuple(free.tolist()), robust=True)
    names, units, first = MOTION_COMPONENTS, component_units(0), int(np.argmax(free == 0))
    try:
        fit = fit_sines(even_s, measured.motion.pose, frequency_hz, names, units, model=model)
    except ValueError:
        return None
    found = float(fit.phasors.frequency_hz[first]), float(fit.u_frequency_hz[first])
    return _times((distance_s, 0.0), (found[0] / frequency_hz[first], found[1] / frequency_hz[first]))


def _reference(base: TimeBase, daq: str, measured: StereoMotion, lines: LineFrequencies) -> ValueWithU | None:
    """Return the relative offset of line frequencies in the channels for a pair's frames."""
    sight = measured.sight
    span_s = float(sight.time_s.min()), float(sight.time_s.max())
    names = sorted((record.entry.name for record in base.records), key=lambda name: name != daq)
    for body in (sight.pair.body, ""):
        for name in names:
            found = line_stretch(base, name, lines, body, span_s)
            if found is not None:
                clocks = [] if name == daq else [*base.tie_errors(name), *base.tie_errors(daq)]
                return found[0], float(np.linalg.norm([found[1], *(error.rate for error in clocks)]))
    return None
