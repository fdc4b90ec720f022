"""All sequential set-ups of a recording as one.

All are referred to the first set-up by a common reference channel: R_1/R_i times the phasors of set-up i. A channel in
several set-ups becomes one reading; their scatter is noise.
"""

from __future__ import annotations

from collections.abc import Hashable, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from fusion.estimation.measurement_model import Observation
from fusion.estimation.variance_components import EstimatedNoise
from fusion.instruments.channel import ChannelReading, ChannelRelativeError, nonzero_errors, observe_channels
from fusion.instruments.stereo import SCOPES, StereoReading
from fusion.phasors.channel_phasors import ChannelResult
from fusion.phasors.phasor_notices import LARGE_REFERENCE_DRIFT, REFERENCE_DRIFT, TAKE_FREQUENCY_DIFFERS, TAKES_SCATTER
from fusion.phasors.set_up import MeasuredSetUp, PreparedSetUp
from fusion.phasors.steadiness import line_stationarity, stationarity_notices
from fusion.phasors.stereo_phasors import StereoResult
from fusion.phasors.timing import ClockResult
from fusion.recording.manifest import ChannelEntry
from shaker.lines.frequencies import LineFrequencies
from shaker.sine.phasor import Phasors, real_stacked_diagonal
from shaker.sine.sine_fit import Stationarity
from shakercal._common.arrays import Arrays, BoolArray, ComplexArray, FloatArray
from shakercal._common.notices import Notice

MIN_SNR = 6.0
"""Smallest reference over its standard uncertainty; 1/R_i is biased by u²/R², 3 % there."""
NOTED_DRIFT, LARGE_DRIFT = 1e-3, 2e-2
SAME_FREQUENCY = 1e-4  # relative difference of clocks and generators between set-ups
REMAINING_NOISE = 1e-6  # share of a covariance that remains beside an unknown, to be positive definite
MIN_SPREAD = 1e-9  # of the reading: rounding below it would look like scatter


# Tie of a set-up to the first one, and its uncertainty.


@dataclass(frozen=True)
class SetUpResult(Arrays, shapes="frequency_hz K; value K; factor K; drift K; u_drift K"):
    """Tie of one set-up to the first by its reference channel.

    With the exact lines on its clock. `frequency_hz` (K,) in the order of the evaluation's lines. `value` (K,): phasors
    R_i of the reference on the set-up's clock. `factor` (K,): R_1/R_i, by which all phasors of the set-up are
    multiplied, NaN where the reference is not significant. `drift` (K,): |R_i/R_1| - 1, with its standard uncertainty
    by noise.
    """

    name: str
    reference: str
    frequency_hz: FloatArray
    value: ComplexArray
    factor: ComplexArray
    drift: FloatArray
    u_drift: FloatArray


@dataclass(frozen=True)
class ReferenceTie:
    """Tie of one set-up to the first: its phasors times `factor` (K,).

    NaN at lines without a reference. `first`: the set-up to which all are referred. `frequency_hz` (K,): its lines,
    those of the results. `noise`: noise of the reference in this set-up as relative errors (K, 1) of its phasor, at
    significant lines. `errors`: those that all referred phasors of the set-up share.
    """

    name: str
    first: bool
    frequency_hz: FloatArray
    factor: ComplexArray
    noise: tuple[ChannelRelativeError, ...]
    errors: tuple[ChannelRelativeError, ...]
    result: SetUpResult

    def phasors(self, phasors: Phasors) -> Phasors:
        """Return phasors of the set-up as those of the first."""
        return replace(phasors.scaled(self.factor[:, None]), frequency_hz=self.frequency_hz)

    def reading(self, reading: ChannelReading) -> ChannelReading:
        """Return a channel as one of the first set-up, with errors of its clock."""
        chain = replace(reading.chain, clock=f"{self.name}: {reading.chain.clock}")
        further = nonzero_errors([*_clock_errors(self.name, reading), *self.errors])
        return ChannelReading(reading.entry, self.phasors(reading.phasors), chain, further)

    def reference(self, reading: ChannelReading) -> ChannelReading:
        """Return the reference channel of the first set-up with its noise as shared errors."""
        significant = np.zeros(len(self.frequency_hz), dtype=np.bool_)
        for error in self.noise:
            significant |= error.effect[:, 0] != 0.0
        phasors = reading.phasors
        remaining = np.where(significant, REMAINING_NOISE, 1.0)[:, None, None]
        referred = self.reading(replace(reading, phasors=replace(phasors, covariance=phasors.covariance * remaining)))
        return replace(referred, further_errors=nonzero_errors([*referred.further_errors, *self.noise]))

    def stereo(self, pair: StereoReading) -> StereoReading:
        """Return a stereo pair as one of the first set-up; its errors remain separate."""
        effects = {
            f"{what}, {self.name}" if SCOPES.get(what) == "recording" else what: change * self.factor[:, None]
            for what, change in pair.effects.items()
        }
        named = [replace(e, name=f"{self.name}: {e.name}", label=f"{self.name}: {e.label}") for e in pair.errors]
        referred = [error.scaled(self.factor[:, None]) for error in named]
        through = None if pair.through_surface is None else pair.through_surface * self.factor[:, None]
        phasors, errors = self.phasors(pair.phasors), (*referred, *self.errors)
        return replace(pair, phasors=phasors, effects=effects, errors=errors, through_surface=through)


def reference_ties(set_ups: Sequence[PreparedSetUp]) -> tuple[ReferenceTie, ...]:
    """Tie set-ups to the first one by their reference channel.

    The one with `reference = true` in all of them. The factor is R_1/R_i of the reference's phasors, corrected for
    delay and response. Its scale, delay and response cancel. Its noise in set-up i is one complex unknown per line for
    all phasors of that set-up; its noise in the first one acts on all others and on itself. A drift of its amplitude is
    corrected, but related changes are not known: d = ||R_i/R_1| - 1|, less its noise and with twice the relative change
    of the frequency, acts on magnitude and phase of all phasors of set-up i at that line (type B, rectangular of
    half-width d).
    """
    references = []
    for prepared in set_ups:
        marked = [reading for reading in prepared.readings if reading.entry.reference]
        if len(marked) != 1:
            expected = "one channel with reference = true, the same in every take"
            found = f"{len(marked) or 'none'}"
            raise prepared.refusal("daq", found=found, expected=expected)
        references += marked
    return tuple(_tie(set_ups, references, index) for index in range(len(set_ups)))


def _tie(set_ups: Sequence[PreparedSetUp], references: Sequence[ChannelReading], index: int) -> ReferenceTie:
    prepared, first, reference = set_ups[index], references[0], references[index]
    significant = _standing_out(reference) & _standing_out(first)
    _check_driven(prepared, reference, significant)
    base_hz = first.phasors.frequency_hz
    value, first_value = reference.phasors.value[:, 0], first.phasors.value[:, 0]
    factor = np.full(len(base_hz), complex(np.nan, np.nan))
    np.divide(first_value, value, out=factor, where=significant)
    u_drift = np.hypot(_u_relative(reference), _u_relative(first)) if index else np.zeros(len(base_hz))
    drift = 1.0 / np.abs(factor) - 1.0
    noise = _noise(prepared.name, reference, base_hz, _standing_out(reference))
    errors: tuple[ChannelRelativeError, ...] = ()
    if index:
        certain_drift = np.sqrt(np.maximum(drift**2 - u_drift**2, 0.0))
        half_width = certain_drift + 2.0 * np.abs(reference.phasors.frequency_hz / base_hz - 1.0)
        first_name = set_ups[0].name
        inherited = [*_noise(first_name, first, base_hz, significant), *_clock_errors(first_name, first)]
        lost = [*noise, *_clock_errors(prepared.name, reference)]
        taken_off = [replace(error, effect=-error.effect) for error in lost]
        drifted = _drift(prepared.name, base_hz, np.where(significant, half_width, 0.0))
        errors = nonzero_errors([*inherited, *taken_off, *drifted])
    frequency_hz = reference.phasors.frequency_hz
    result = SetUpResult(prepared.name, reference.entry.name, frequency_hz, value, factor, drift, u_drift)
    used = factor if index else np.ones(len(base_hz), dtype=np.complex128)
    return ReferenceTie(prepared.name, index == 0, base_hz, used, noise, errors, result)


def _u_relative(reading: ChannelReading) -> FloatArray:
    """Return the standard uncertainty (K,) of a part over the amplitude, mean of both parts."""
    phasors = reading.phasors
    u = np.sqrt((phasors.u_re[:, 0] ** 2 + phasors.u_im[:, 0] ** 2) / 2.0)
    size = np.abs(phasors.value[:, 0])
    return np.asarray(np.divide(u, size, out=np.full(len(u), np.inf), where=size > 0.0))


def _standing_out(reading: ChannelReading) -> BoolArray:
    """Return the lines (K,) at which a reference is far above its noise."""
    return np.asarray(np.nan_to_num(_u_relative(reading), nan=np.inf) * MIN_SNR < 1.0)


def _check_driven(prepared: PreparedSetUp, reference: ChannelReading, significant: BoolArray) -> None:
    """Raise if a reference does not show a driven line."""
    driven = np.ones(0, dtype=np.bool_) if prepared.lines is None else prepared.lines.multiple == 1
    lost = np.flatnonzero(driven & ~significant)
    if len(lost):
        key = f"daq.{reference.chain.clock}.channel.{reference.entry.name}.reference"
        amplitude, u = np.abs(reference.phasors.value[lost[0], 0]), reference.phasors.u_re[lost[0], 0]
        frequency = f"{reference.phasors.frequency_hz[lost[0]]:.6g} Hz"
        found = f"an amplitude of {amplitude:.2g} with a standard uncertainty of {u:.2g} in {prepared.name}"
        expected = f"a channel that shows the driven line at {frequency} in every take"
        raise prepared.refusal(key, found=found, expected=expected)


def _noise(
    name: str, reading: ChannelReading, frequency_hz: FloatArray, lines: BoolArray
) -> tuple[ChannelRelativeError, ...]:
    """Return the noise of a reference as two relative errors at each chosen line."""
    errors = []
    phasors = reading.phasors
    for k in np.flatnonzero(lines):
        (turn,) = real_stacked_diagonal(1.0 / phasors.value[k : k + 1])
        variances, vectors = np.linalg.eigh(turn @ phasors.covariance[k] @ turn.T)
        for part, (variance, vector) in enumerate(zip(variances.tolist(), vectors.T, strict=True)):
            relative = np.zeros((len(frequency_hz), 1), dtype=np.complex128)
            relative[k, 0] = np.sqrt(max(variance, 0.0)) * complex(*vector)
            unknown = f"reference noise of {name} at {frequency_hz[k]:.9g} Hz, part {part + 1}"
            errors.append(ChannelRelativeError(unknown, "reference noise", 1.0, "1", relative, "recording", "A"))
    return tuple(errors)


def _clock_errors(name: str, reading: ChannelReading) -> list[ChannelRelativeError]:
    """Return a channel's errors by clock and frequencies, named by the set-up."""
    errors = reading.further_errors
    return [error if error.scope == "rig" else replace(error, name=f"{name}: {error.name}") for error in errors]


def _drift(name: str, frequency_hz: FloatArray, half_width: FloatArray) -> list[ChannelRelativeError]:
    """Return the relative errors of magnitude and phase by drift of a reference."""
    label, errors = "drift between takes", []
    for k in np.flatnonzero(half_width > 0.0):
        u = float(half_width[k]) / np.sqrt(3.0)
        for part, unit, turn in (("magnitude", "1", 1.0 + 0.0j), ("phase", "rad", 1.0j)):
            relative = np.zeros((len(frequency_hz), 1), dtype=np.complex128)
            relative[k, 0] = u * turn
            unknown = f"{label}: {part} of {name} at {frequency_hz[k]:.9g} Hz"
            errors.append(ChannelRelativeError(unknown, label, u, unit, relative))
    return errors


def drift_notices(ties: Sequence[ReferenceTie], driven: BoolArray) -> tuple[Notice, ...]:
    """Return notices of changed reference amplitude or frequency at the `driven` lines (K,)."""
    notices = []
    for tie in ties:
        result = tie.result
        changed = np.abs(result.frequency_hz / tie.frequency_hz - 1.0)
        for k in np.flatnonzero(driven & np.isfinite(result.drift)):
            drift, first_hz = result.drift[k], tie.frequency_hz[k]
            if abs(drift) > NOTED_DRIFT:
                declared = LARGE_REFERENCE_DRIFT if abs(drift) > LARGE_DRIFT else REFERENCE_DRIFT
                percent, name = 100.0 * drift, result.reference
                notices.append(Notice(declared, tie.name, reference=name, drift_percent=percent, frequency_hz=first_hz))
            if changed[k] > SAME_FREQUENCY:
                hertz = result.frequency_hz[k]
                notices.append(Notice(TAKE_FREQUENCY_DIFFERS, tie.name, frequency_hz=hertz, first_hz=first_hz))
    return tuple(notices)


# A channel that several set-ups recorded: one reading from all of them.


def merge_readings(
    set_ups: Sequence[tuple[str, Sequence[ChannelReading]]],
) -> tuple[tuple[ChannelReading, ...], tuple[Notice, ...]]:
    """Return every channel of several set-ups once.

    Each set-up: its name and readings, referred to the first. The same channel at the same position, and the same
    output of the sensor, becomes one reading. Channels of one name at different positions are rows of one instrument,
    each named by its set-up.
    """
    groups: dict[Hashable, list[tuple[str, ChannelReading]]] = {}
    for name, readings in set_ups:
        for reading in readings:
            entry = reading.entry
            where = (entry.name, entry.quantity, entry.body, entry.point, entry.direction, entry.common)
            groups.setdefault(entry.channel if entry.quantity == "output" else where, []).append((name, reading))
    names = [group[0][1].entry.name for group in groups.values()]
    merged, notices = [], []
    for group in groups.values():
        set_up, entry = group[0][0], group[0][1].entry
        if names.count(entry.name) > 1:  # the channel by its set-up, the instrument by its name
            entry = entry.model_copy(update={"name": f"{set_up}: {entry.name}", "common": entry.common or entry.name})
        reading, scatter = _merged([reading for _, reading in group], entry)
        merged.append(reading)
        notices += scatter
    return tuple(merged), tuple(notices)


def _merged(readings: Sequence[ChannelReading], entry: ChannelEntry) -> tuple[ChannelReading, list[Notice]]:
    """Return one reading of a channel in T set-ups, and warnings of additional scatter.

    Readings are weighted by their whole covariance over the set-ups, in which a complex value has one variance, the sum
    of those of its parts. If chi-square exceeds its degrees of freedom, all set-ups get the variance that makes it
    equal to them (Paule & Mandel 1982, J. Res. NBS 87, 377). Its noise includes the cost of weights by estimated noise,
    and the scatter; further errors keep their names.
    """
    first = readings[0]
    if len(readings) == 1:
        return replace(first, entry=entry), []
    name, frequency_hz = first.entry.name, first.phasors.frequency_hz
    weight = np.zeros((len(readings), len(frequency_hz)))
    spread, lost = np.zeros(len(frequency_hz)), np.zeros(len(frequency_hz))
    value = np.stack([reading.phasors.value[:, 0] for reading in readings])
    covariance, notices = _between_set_ups(readings, value), []
    for k, f in enumerate(frequency_hz):
        finite = np.flatnonzero(np.isfinite(value[:, k]))
        if len(finite) == 1:
            weight[finite, k] = 1.0
        elif len(finite):
            noise = [(readings[t].phasors.covariance[k], float(readings[t].phasors.dof[k])) for t in finite.tolist()]
            found = _weighted(value[finite, k], covariance[k][np.ix_(finite, finite)], noise)
            weight[finite, k], spread[k], lost[k] = found.weight, found.spread, found.lost
            if found.fails:
                share = spread[k] / np.nanmax(np.abs(value[:, k]))
                notices.append(Notice(TAKES_SCATTER, name, spread_percent=100.0 * share, frequency_hz=f))
    further = [
        replace(error, effect=w[:, None] * error.effect)
        for w, reading in zip(weight, readings, strict=True)
        for error in reading.further_errors
    ]
    mean = replace(_mean([reading.phasors for reading in readings], weight, spread, lost), channels=(entry.name,))
    return ChannelReading(entry, mean, first.chain, nonzero_errors(further)), notices


def _mean(parts: Sequence[Phasors], weight: FloatArray, spread: FloatArray, lost: FloatArray) -> Phasors:
    """Return the weighted mean with covariance and degrees of freedom (Welch-Satterthwaite).

    Of noise and scatter. The cost `lost` (K,) of estimated weights enlarges the noise.
    """
    used, square = np.any(weight != 0.0, axis=0), weight**2
    value = np.nansum([w * p.value[:, 0] for w, p in zip(weight, parts, strict=True)], axis=0)
    variances = np.nan_to_num([s[:, None, None] * p.covariance for s, p in zip(square, parts, strict=True)])
    noise = np.trace(variances, axis1=2, axis2=3).sum(axis=0)
    variances = variances * (1.0 + np.divide(lost, noise, out=np.zeros(len(lost)), where=noise > 0.0))[:, None, None]
    scatter = square.sum(axis=0) * spread**2
    covariance = variances.sum(axis=0) + scatter[:, None, None] / 2.0 * np.eye(2)
    noise = np.trace(variances, axis1=2, axis2=3)
    weighted = np.sum(noise**2 / np.maximum([p.dof for p in parts], 1.0), axis=0)
    weighted += scatter**2 / np.maximum(np.sum(weight != 0.0, axis=0) - 1.0, 1.0)
    total = np.trace(covariance, axis1=1, axis2=2)
    return replace(
        parts[0],
        value=np.where(used, value, complex(np.nan, np.nan))[:, None],
        covariance=np.where(used[:, None, None], covariance, np.nan),
        dof=np.divide(total**2, weighted, out=np.full(len(total), np.inf), where=weighted > 0.0),
    )


def _between_set_ups(readings: Sequence[ChannelReading], value: ComplexArray) -> FloatArray:
    """Return covariances (K, T, T) of the complex values.

    By noise and errors common to set-ups. Relative errors act on the median amplitude, never on the reading itself.
    """
    size = np.array([np.median(np.abs(v[np.isfinite(v)])) if np.isfinite(v).any() else 0.0 for v in value.T])
    noise = np.array([np.trace(reading.phasors.covariance, axis1=1, axis2=2) for reading in readings])
    noise = np.nan_to_num(noise) + (MIN_SPREAD * size) ** 2
    covariance = np.einsum("tk,ts->kts", noise, np.eye(len(readings)))
    names = dict.fromkeys(error.name for reading in readings for error in reading.further_errors)
    index = {name: number for number, name in enumerate(names)}
    relative = np.zeros((len(names), len(readings), len(size)), dtype=np.complex128)
    for t, reading in enumerate(readings):
        for error in reading.further_errors:
            relative[index[error.name], t] = error.effect[:, 0]
    shared = np.einsum("ntk,nsk->kts", relative, relative.conj()).real
    return np.asarray(covariance + shared * size[:, None, None] ** 2)


class _Weighted(NamedTuple):
    """Weights (T,) of complex values.

    `spread`: standard deviation beyond their covariance; `lost`: variance by estimated weights; `fails`: whether
    chi-square fails at 1 %.
    """

    weight: FloatArray
    spread: float
    lost: float
    fails: bool


def _weighted(
    value: ComplexArray, covariance: FloatArray, parts_noise: Sequence[tuple[FloatArray, float]]
) -> _Weighted:
    """Return the weights of complex values (T,) with a `covariance` (T, T).

    `parts_noise`: covariance (2, 2) of the noise of each value, included in it, and its degrees of freedom.
    """
    from scipy.optimize import brentq

    count = len(value)
    dof, every = 2 * (count - 1), np.arange(2 * count)
    parts = [(np.array([t, t + count]), *part) for t, part in enumerate(parts_noise)]
    noise = EstimatedNoise.from_parts(parts, 2 * count)

    def projector(variance: float) -> FloatArray:
        whole = np.linalg.inv(covariance + variance * np.eye(count))
        summed = whole.sum(axis=1)
        return np.asarray(2.0 * np.kron(np.eye(2), whole - np.outer(summed, summed) / summed.sum()))

    def chi2(variance: float) -> float:
        both = np.concatenate([value.real, value.imag])
        return float(both @ projector(variance) @ both)

    extra, first = 0.0, chi2(0.0)
    if first > dof:
        high = float(np.var(value)) * count
        while chi2(high) > dof:
            high *= 2.0
        extra = float(brentq(lambda v: chi2(v) - dof, 0.0, high, rtol=1e-3, xtol=1e-12 * high))
    weight = _weights(covariance + extra * np.eye(count))
    lost = noise.estimation_covariance(
        projector(extra), np.asarray(np.kron(np.eye(2), weight)[None], dtype=np.float64), every
    )
    return _Weighted(weight, float(np.sqrt(extra)), float(np.trace(lost[0])), noise.fails(first, dof, projector(0.0)))


def _weights(covariance: FloatArray) -> FloatArray:
    """Return the weights (T,) of the best linear mean."""
    solved = np.linalg.solve(covariance, np.ones(len(covariance)))
    return np.asarray(solved / solved.sum())


# The recording as a whole.


@dataclass(frozen=True)
class Joined:
    """All data of a recording on the first set-up's clock and lines.

    `readings`, `pairs`: every channel and stereo pair with its errors. `clock_uncertainty`: relative, of that clock.
    `set_ups`: empty for a single one.
    """

    lines: LineFrequencies
    clocks: tuple[ClockResult, ...]
    channels: tuple[ChannelResult, ...]
    stereo: tuple[StereoResult, ...]
    readings: tuple[ChannelReading, ...]
    pairs: tuple[StereoReading, ...]
    clock_uncertainty: float
    set_ups: tuple[SetUpResult, ...]
    aliased: tuple[Notice, ...]
    notices: tuple[Notice, ...]

    def observed(self, gravity_mps2: tuple[float, float, float] | None) -> tuple[Observation, ...]:
        """Return stereo pairs and channels as rows of the linear model."""
        channels = observe_channels(self.readings, gravity_mps2, self.clock_uncertainty)
        return (*(pair.observation() for pair in self.pairs), *channels)


def join_set_ups(set_ups: Sequence[MeasuredSetUp]) -> Joined:
    """Refer all set-ups to the first, named by their set-up; a single one is unchanged."""
    first = set_ups[0]
    prepared, lines, clock = first.prepared, first.lines, first.prepared.base.records[0].entry.clock_uncertainty
    if len(set_ups) == 1:
        clocks, stereo = prepared.base.results(), tuple(item.result for item in first.stereo)
        changes = stationarity_notices(line_stationarity(prepared.channels, stereo, lines, clocks))
        pairs = tuple(item.reading for item in first.stereo)
        seen = (clocks, prepared.channels, stereo, prepared.readings, pairs)
        return Joined(lines, *seen, clock, (), first.line_notices, (*first.notices, *changes))
    ties = reference_ties([item.prepared for item in set_ups])
    named_pairs: list[StereoReading] = []
    clocks_named: list[ClockResult] = []
    channels: list[ChannelResult] = []
    by_name: dict[str, StereoResult] = {}
    referred: list[tuple[str, list[ChannelReading]]] = []
    notices: list[Notice] = []
    for item, tie in zip(set_ups, ties, strict=True):
        name = tie.name
        named_pairs += [tie.stereo(pair.reading) for pair in item.stereo]
        # The reference is that of the first set-up and counts once.
        used = [r for r in item.prepared.readings if tie.first or not r.entry.reference]
        referred.append((name, [tie.reference(r) if r.entry.reference else tie.reading(r) for r in used]))
        clocks_named += [replace(c, daq=f"{name}: {c.daq}") for c in item.prepared.base.results()]
        for channel in item.prepared.channels:  # data of the figures are unchanged
            steady = _at_lines(channel.stationarity, item.lines, lines.frequency_hz)
            referred_channel = replace(channel, phasors=tie.phasors(channel.phasors), stationarity=steady)
            channels.append(replace(referred_channel, name=f"{name}: {channel.name}", daq=f"{name}: {channel.daq}"))
        for result in (pair.result for pair in item.stereo):  # one that saw several set-ups is named by the later ones
            key = f"{result.name}-{name.replace(' ', '')}" if result.name in by_name else result.name
            steady = _at_lines(result.stationarity, item.lines, lines.frequency_hz)
            by_name[key] = replace(result, name=key, stationarity=steady)
        notices += [notice.at(f"{name}, {notice.where}") for notice in item.notices]
    readings, scattered = merge_readings(referred)
    results = tuple(by_name.values())
    changes = stationarity_notices(line_stationarity(channels, results, lines, clocks_named))
    return Joined(
        lines=lines,
        clocks=tuple(clocks_named),
        channels=tuple(channels),
        stereo=results,
        readings=readings,
        pairs=tuple(named_pairs),
        clock_uncertainty=clock,
        set_ups=tuple(tie.result for tie in ties),
        aliased=tuple(notice for item in set_ups for notice in item.line_notices),
        notices=(*notices, *drift_notices(ties, lines.multiple == 1), *scattered, *changes),
    )


def _at_lines(steady: Stationarity | None, lines: LineFrequencies, frequency_hz: FloatArray) -> Stationarity | None:
    """Return the stationarity of a set-up's lines at the lines `frequency_hz` (K,)."""
    if steady is None:
        return None
    first = dict(zip(lines.frequency_hz.tolist(), frequency_hz.tolist(), strict=True))
    return replace(steady, frequency_hz=np.array([first.get(f, f) for f in steady.frequency_hz.tolist()]))
