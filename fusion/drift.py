"""How far amplitude and phase of the driven lines changed while each instrument was recording."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from fusion.measured_results import ChannelResult, ClockResult, StereoResult
from fusion.notices import AnyNotice, Notice
from shaker.signals.frequencies import Lines
from shaker.signals.stationarity import Stationarity

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
