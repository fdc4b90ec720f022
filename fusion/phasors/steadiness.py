"""Deviations from a steady motion, harmonics of outputs without motion, and effects of missing filters."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from fusion.estimation.coverage import coverage_factor
from fusion.estimation.uncertainty import Scope
from fusion.instruments.channel import (
    NOISE_REACH,
    ChannelReading,
    ChannelRelativeError,
    chain_errors,
    nonzero_errors,
    u_of_filter,
)
from fusion.phasors.channel_phasors import HARMONICS, ChannelResult, describe_folds, folding
from fusion.phasors.phasor_notices import (
    ALIASED_HARMONICS,
    CUBIC_DISTORTION,
    FILTER_DELAY,
    HARMONIC_DISTORTION,
    HIGH_HARMONICS_NOT_ASSESSED,
    LINE_UNSTEADY,
    OUTPUT_UNSTEADY,
)
from fusion.phasors.timing import ClockResult
from fusion.recording.transducer import TRANSDUCERS
from shaker.lines.frequencies import LineFrequencies
from shaker.sine.sine_fit import Stationarity
from shakercal._common.digits import number_text, round_to_uncertainty
from shakercal._common.notices import Notice, Value

if TYPE_CHECKING:
    from fusion.phasors.stereo_phasors import StereoResult
    from shaker.sine.aliasing import AliasedHarmonic

SURE = 1.0 / 16000.0  # probability of a reported change by noise and clock rates
MATTERS = 1e-3  # of the amplitude, or rad, over the record: a mean over another stretch differs by up to half of it

# Parts of the readings of outputs that are not caused by the load.

DISTORTION, DRIFT = "distortion", "drift over the record"
SCOPES: dict[str, Scope] = {DISTORTION: "rig", DRIFT: "recording"}


class Doubt(NamedTuple):
    """Share of a `channel` at a line that may not belong to the load."""

    channel: str
    frequency_hz: float
    share: float


def enlarge_doubted(
    readings: Sequence[ChannelReading], changes: Sequence[LineStationarity], distorted: Iterable[HarmonicDistortion]
) -> tuple[ChannelReading, ...]:
    """Return the readings of a set-up with the errors of unsteady and distorted channels."""
    doubts = {DISTORTION: [found.doubt for found in distorted]}
    doubts[DRIFT] = [
        doubt for frequency in _frequencies(changes) for doubt in _significant_changes(changes, frequency).doubts
    ]
    return tuple(_doubted(reading, doubts) for reading in readings)


def _doubted(reading: ChannelReading, doubts: Mapping[str, Sequence[Doubt]]) -> ChannelReading:
    """Return a reading with its additional errors.

    The largest share a at a line has a uniform direction in the complex plane: an arc-sine distribution with a/√2 in
    either part.
    """
    name, quantity, errors = reading.entry.name, reading.entry.quantity, []
    for what, found in doubts.items():
        u = np.zeros(len(reading.phasors.frequency_hz))
        for doubt in (doubt for doubt in found if doubt.channel == name):
            at_line = reading.phasors.frequency_hz == doubt.frequency_hz
            u[at_line] = np.maximum(u[at_line], doubt.share / np.sqrt(2.0))
        for part, turn in (("in phase", 1.0), ("in quadrature", 1.0j)):
            unknown, effect = f"{what} of {quantity} {name}: {part}", np.asarray(turn * u[:, None], np.complex128)
            errors.append(
                ChannelRelativeError(unknown, f"{quantity}: {what}", float(u.max()), "1", effect, SCOPES[what])
            )
    return replace(reading, further_errors=nonzero_errors([*reading.further_errors, *errors]))


# How far amplitude and phase of the driven lines changed while each instrument was recording.


@dataclass(frozen=True)
class LineStationarity:
    """Change of one line in one channel over its record: relative `amplitude` and `phase_rad`.

    `chance`: of blocks that far from their mean by noise and uncertain clock rates. `sure_amplitude`, `sure_phase_rad`:
    values exceeded once in 16 000 cases. `wander`: scatter of the blocks about the effect of a wrong rate, beyond
    noise, as the change of a straight line with the same scatter. `output`: of the sensor.
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
    sure_amplitude: float
    sure_phase_rad: float
    wander: float = 0.0
    output: bool = False


def line_stationarity(
    channels: Sequence[ChannelResult],
    stereo: Sequence[StereoResult],
    lines: LineFrequencies,
    clocks: Sequence[ClockResult],
) -> tuple[LineStationarity, ...]:
    """Return the changes of the driven lines in every channel and every stereo pair.

    Of a pair in its strongest component. The drift of a phase is as uncertain as the rates behind it: of a clock tied
    to the first one, of the trigger of the frames, and of the line's frequency. The stated rate of a clock has no
    effect, because the frequency is found on the same clock.
    """
    u_rate = {clock.daq: float(np.sqrt(clock.tie.covariance[1, 1])) for clock in clocks if clock.tie is not None}
    shown = [(c.name, c.stationarity, u_rate.get(c.daq, 0.0), c.quantity == "output") for c in channels]
    shown += [(f"stereo pair {pair.name}", pair.stationarity, pair.u_rate, False) for pair in stereo]
    first = lines.multiple == 1
    driven = list(zip(lines.frequency_hz[first].tolist(), lines.u_frequency_hz[first].tolist(), strict=True))
    return tuple(
        change
        for name, steady, u, output in shown
        if steady is not None
        for change in _of_lines(name, steady, driven, u, output=output)
    )


def stationarity_notices(changes: Sequence[LineStationarity]) -> tuple[Notice, ...]:
    """Return a notice per line for amplitude, phase, and other changes over the record.

    A notice for each of amplitude and phase that changes significantly, and one for significant changes that are not
    linear, such as over a part of a beat. They differ if only outputs of the sensor change and the motion does not.
    """
    notices: list[Notice] = []
    for frequency in _frequencies(changes):
        grown, drifting, bent, doubts = _significant_changes(changes, frequency)
        for quantity, changed in (
            ("amplitude", [f"{100.0 * d.amplitude:+.2g} % in {d.name}" for d in grown]),
            ("phase", [f"{1e3 * d.phase_rad:+.2g} mrad in {d.name}" for d in drifting]),
            ("phasor", [f"{number_text(100.0 * d.wander, 2)} % in {d.name}" for d in bent]),
        ):
            if changed:
                declared, listed = OUTPUT_UNSTEADY if doubts else LINE_UNSTEADY, ", ".join(changed)
                where = f"{number_text(frequency, 6)} Hz"
                notices.append(Notice(declared, where, quantity=quantity, frequency_hz=frequency, changes=listed))
    return tuple(notices)


class _SignificantChanges(NamedTuple):
    """The reported changes of a line, and `doubts`: those of outputs without motion."""

    grown: list[LineStationarity]
    drifting: list[LineStationarity]
    bent: list[LineStationarity]
    doubts: list[Doubt]


def _frequencies(changes: Sequence[LineStationarity]) -> list[float]:
    return list(dict.fromkeys(line.frequency_hz for line in changes))


def _significant_changes(changes: Sequence[LineStationarity], frequency_hz: float) -> _SignificantChanges:
    """Return the significant and relevant changes of a line."""
    of_line = [line for line in changes if line.frequency_hz == frequency_hz]
    grown = [d for d in of_line if abs(d.amplitude) > max(MATTERS, d.sure_amplitude)]
    drifting = [d for d in of_line if abs(d.phase_rad) > max(MATTERS, d.sure_phase_rad)]
    named = {d.name for d in (*grown, *drifting)}
    bent = [d for d in of_line if d.chance < SURE and d.wander > MATTERS and d.name not in named]
    doubts = []
    if {d.output for d in (*grown, *drifting, *bent)} == {True} and not all(d.output for d in of_line):
        for d in dict.fromkeys((*grown, *drifting, *bent)):
            along = np.hypot(d.amplitude * (d in grown), d.phase_rad * (d in drifting))
            doubts.append(Doubt(d.name, frequency_hz, float(max(along, d.wander))))
    return _SignificantChanges(grown, drifting, bent, doubts)


def _of_lines(
    name: str, steady: Stationarity, driven: Sequence[tuple[float, float]], u_rate: float, *, output: bool
) -> list[LineStationarity]:
    """Return the changes of the `driven` lines, each in the clearest channel."""
    length, changes = steady.length_s, []
    for frequency, u_frequency in driven:
        turn = 2.0 * np.pi * float(np.hypot(frequency * u_rate, u_frequency))
        chance, scatter = steady.p_value_with_rate(turn), steady.excess_variance(turn)
        for line in np.flatnonzero(steady.frequency_hz == frequency):
            mean = np.abs(steady.value[:, line].mean(axis=0))
            clear = mean / np.maximum(steady.u_amplitude_per_s[line], np.finfo(np.float64).tiny)
            c = int(np.argmax(clear))
            if mean[c] > 0.0:
                part = length / mean[c]
                u_amplitude, u_noise_phase = steady.u_amplitude_per_s[line, c] * part, steady.u_phase_rad_per_s[line, c]
                u_phase = float(np.hypot(u_noise_phase, turn))
                dof = max(float(steady.dof[line]), 1.0)
                # The rates are known, the noise is estimated (Welch and Satterthwaite).
                dof_phase = dof * (u_phase / u_noise_phase) ** 4 if u_noise_phase > 0.0 else np.inf
                # A straight line from -D/2 to D/2 has the variance D²/12.
                wander = np.sqrt(12.0 * scatter[line, c]) / mean[c]
                changes.append(
                    LineStationarity(
                        name,
                        float(frequency),
                        len(steady.time_s),
                        steady.periods,
                        steady.whole,
                        float(steady.amplitude_per_s[line, c] * part),
                        float(u_amplitude),
                        float(steady.phase_rad_per_s[line, c] * length),
                        u_phase * length,
                        float(chance[line, c]),
                        coverage_factor(dof, 1.0 - SURE) * float(u_amplitude),
                        coverage_factor(dof_phase, 1.0 - SURE) * u_phase * length,
                        float(wander),
                        output,
                    )
                )
    return changes


# Harmonics of outputs that the load's motion does not have, and of the motion that no output answers to.

STRONG = 0.5  # of the largest fundamental: outputs and motion channels whose harmonics are compared
CHANGED = 0.3  # relative difference of the sensitivity between harmonic and fundamental


class HarmonicDistortion(NamedTuple):
    """Distortion of a channel by one of its harmonics."""

    doubt: Doubt
    notice: Notice


def distortions(channels: Sequence[ChannelResult], lines: LineFrequencies) -> Iterator[HarmonicDistortion]:
    """Yield significant harmonics of outputs that the load's motion does not have, and vice versa.

    Harmonics are compared relative to the fundamental: of the outputs with the largest response, of the acceleration in
    the channels with the largest motion. A motion channel is compared with all others: a harmonic that neither the
    outputs nor the other motion channels have is caused by the channel, such as an amplifier that saturates before a
    filter. Of x - ε·x³ the third harmonic is ε/4 of the amplitude and the fundamental is lower by 3ε/4, the error of
    the ratio. For other harmonics the error is assumed to be as large as the harmonic. No harmonic is reported if no
    channel measures the load's motion.
    """
    outputs = [c for c in channels if c.quantity == "output" and c.harmonics is not None]
    motion = [c for c in channels if c.quantity in TRANSDUCERS and c.body == "load" and c.harmonics is not None]
    for f in lines.frequency_hz[lines.multiple == 1].tolist():
        moving, responding = _strongest(motion, f), _strongest(outputs, f)
        for m in HARMONICS:
            shares = {c.name: share for c in (*moving, *responding) if (share := _share(c, f, m)) is not None}
            for channel in (*responding, *moving):
                compared = moving if channel in responding else (*responding, *(c for c in moving if c is not channel))
                theirs = [shares[c.name] for c in compared if c.name in shares]
                if channel.name in shares and theirs and moving and responding:
                    yield from _distortion(channel, f, m, shares[channel.name], theirs)


def _strongest(channels: Sequence[ChannelResult], frequency_hz: float) -> list[ChannelResult]:
    """Return the channels with a strong fundamental, motion as acceleration."""
    size = {}
    for channel in channels:
        seen = channel.phasors.frequency_hz == frequency_hz
        order = TRANSDUCERS[channel.quantity].order if channel.quantity in TRANSDUCERS else 0
        value = channel.phasors.value[seen, 0] * (2.0 * np.pi * frequency_hz) ** -order
        if np.isfinite(value).any():
            size[channel.name] = float(np.abs(value[0]))
    least = STRONG * max(size.values(), default=0.0)
    return [channel for channel in channels if size.get(channel.name, 0.0) > least]


class _Share(NamedTuple):
    """A harmonic over its fundamental, of motion that of the acceleration; `phase_rad`: of the fundamental."""

    value: complex
    u: float
    dof: float
    phase_rad: float


def _share(channel: ChannelResult, frequency_hz: float, m: int) -> _Share | None:
    """Return one harmonic of a channel, None if it has none."""
    found = channel.harmonics
    if found is None:
        return None
    near = [np.flatnonzero(np.abs(found.frequency_hz / (n * frequency_hz) - 1.0) < 1e-9) for n in (1, m)]
    if not all(len(indices) for indices in near):
        return None
    first, index = (int(indices[0]) for indices in near)
    order = TRANSDUCERS[channel.quantity].order if channel.quantity in TRANSDUCERS else 0
    factor = float(m) ** -order / complex(found.value[first, 0])
    u = np.sqrt((found.u_re[index, 0] ** 2 + found.u_im[index, 0] ** 2) / 2.0) * abs(factor)
    value, phase = complex(found.value[index, 0]) * factor, float(np.angle(found.value[first, 0]))
    return _Share(value, float(u), float(found.dof[index]), phase)


def _distortion(
    channel: ChannelResult, frequency_hz: float, m: int, share_of_channel: _Share, theirs: Sequence[_Share]
) -> Iterator[HarmonicDistortion]:
    """Yield the excess of one harmonic of a channel over that of others."""
    from scipy.special import fdtri

    share = np.array([one.value for one in theirs])
    weight = 1.0 / np.maximum([one.u for one in theirs], np.finfo(np.float64).tiny) ** 2
    motion = complex(np.sum(weight * share) / np.sum(weight))
    spread = float(np.sqrt(np.mean(np.abs(share - motion) ** 2) / 2.0))
    u = float(np.sqrt(share_of_channel.u**2 + 1.0 / np.sum(weight) + spread**2 / len(share)))
    excess = share_of_channel.value - motion
    size, dof = abs(excess), max(share_of_channel.dof, 1.0)
    sure = float(np.sqrt(2.0 * fdtri(2.0, dof, 1.0 - SURE / len(HARMONICS)))) * u + CHANGED * abs(motion)
    cubic = 3.0 if m == 3 else 1.0
    # With less than the others have, one of these is distorted.
    if size <= sure or cubic * size <= MATTERS or abs(share_of_channel.value) < size / 2.0:
        return
    part = round_to_uncertainty(100.0 * size, 100.0 * coverage_factor(dof) * u, 0)
    output = channel.quantity == "output"
    values: dict[str, Value] = {
        "frequency_hz": frequency_hz,
        "share": part.value,
        "expanded": part.expanded,
        "reference": "the motion of the load" if output else "the outputs",
        "device": "sensor or its converter" if output else "transducer, its amplifier or its converter",
        "u_percent": 100.0 * cubic * size,
    }
    if m == 3:
        flattened = (excess * np.exp(-2j * share_of_channel.phase_rad)).real < 0.0
        sign = "small" if flattened == output else "large"
        notice = Notice(CUBIC_DISTORTION, channel.name, sign=sign, ratio_percent=300.0 * size, **values)
    else:
        notice = Notice(HARMONIC_DISTORTION, channel.name, order=m, **values)
    yield HarmonicDistortion(Doubt(channel.name, frequency_hz, cubic * size), notice)


# Missing filters: aliased harmonics, and delays that an unstated filter may cause.

FOLDED = 20
"""Order up to which aliased harmonics are searched (chosen)."""
OF_U = 1.0 / 3.0
"""Predicted aliased harmonic, over u of the line, above which it is reported (chosen)."""


def folding_notices(
    channels: Sequence[ChannelResult], readings: Sequence[ChannelReading], lines: LineFrequencies
) -> list[Notice]:
    """Return notices of harmonics that alias onto the lines of a block.

    Harmonics up to the fifth are reported unless a response of the channel states a filter. Higher ones are reported if
    those measured by a channel predict more than a third of its u at the line, and are otherwise not assessed.
    """
    driven = lines.frequency_hz[lines.multiple == 1].tolist()
    blocks: dict[tuple[str, float], list[tuple[ChannelResult, ChannelReading]]] = {}
    for channel, reading in zip(channels, readings, strict=True):
        if reading.entry.response is None:
            blocks.setdefault((channel.daq, channel.sample_rate_hz), []).append((channel, reading))
    notices = []
    for (daq, rate_hz), members in blocks.items():
        found: dict[bool, list[AliasedHarmonic]] = {True: [], False: []}
        for fold in folding(driven, rate_hz, members[0][0].samples, FOLDED):
            found[fold.multiple <= HARMONICS[-1] or any(_expected(*one, fold) for one in members)].append(fold)
        for important, declared in ((True, ALIASED_HARMONICS), (False, HIGH_HARMONICS_NOT_ASSESSED)):
            if found[important]:
                notices.append(Notice(declared, daq, rate_hz=rate_hz, aliases=describe_folds(found[important])))
    return notices


def _expected(channel: ChannelResult, reading: ChannelReading, fold: AliasedHarmonic) -> bool:
    """Return whether the measured harmonics of a channel predict a significant one at an alias.

    Coefficients of a waveform without jumps fall at least as 1/m² with their order m (Zygmund 1959, Trigonometric
    Series I, II.4). The prediction starts at the measured one that predicts most; it is significant relative to the u
    of the line.
    """
    if channel.harmonics is None:
        return False
    seen, order = channel.harmonics, channel.harmonics.frequency_hz / fold.fundamental_hz
    size, noise = np.abs(seen.value[:, 0]), np.hypot(seen.u_re[:, 0], seen.u_im[:, 0])
    counted = (np.abs(order - np.rint(order)) < 1e-9 * order) & (order > 1.5) & (size > NOISE_REACH * noise)
    line = int(np.argmin(np.abs(channel.phasors.frequency_hz - fold.line_hz)))
    relative = [np.abs(error.effect[line, 0]) for error in chain_errors([reading])]
    at_line = channel.phasors.at_lines(np.array([line]))
    u = np.linalg.norm([at_line.u_re[0, 0], at_line.u_im[0, 0], np.abs(at_line.value[0, 0]) * np.linalg.norm(relative)])
    return bool(np.max((size * (order / fold.multiple) ** 2)[counted], initial=0.0) > OF_U * u)


ATTENUATED = 1e-3
"""Relative attenuation that a filter of a stated delay may have, from which on the user is asked about it."""


def delay_notices(readings: Sequence[ChannelReading], path: Path) -> list[Notice]:
    """Return warnings of stated delays that attenuating filters may cause; `path`: of the manifest."""
    notices = []
    for entry, phasors in ((reading.entry, reading.phasors) for reading in readings if reading.entry.delay_of is None):
        loss = np.sqrt(3.0) * u_of_filter(phasors.frequency_hz, entry.filter_delay_s)[0]
        line = int(np.argmax(loss))
        if loss[line] > ATTENUATED:
            values = {"delay_us": 1e6 * entry.delay, "frequency_hz": phasors.frequency_hz[line], "loss": loss[line]}
            notices.append(Notice(FILTER_DELAY, f"{path.name}: channel.{entry.name}.delay", **values))
    return notices
