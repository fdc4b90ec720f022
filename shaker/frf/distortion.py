"""Harmonics above the band of a periodic excitation, which a linear structure does not have."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from shaker.frf.periodic import find_period, period_phasors
from shaker.frf.result import TransferRecord
from shaker.signal_notices import NONLINEAR_DISTORTIONS
from shakercal._common.notices import Notice

_HIGHEST = 0.45  # share of the sampling rate up to which harmonics are examined
_GUARD = 1.02  # factor above the last excited line from which lines are examined
_SIGNIFICANT = 6.0  # standard deviations of the mean power of noise
_OF_REFERENCE = (
    2.0  # times the reference's harmonics, amplified as the last excited lines, from which a response has own
)


def harmonics_above_band(
    record: TransferRecord, period_s: float, settle_periods: int, highest_hz: float
) -> Iterator[Notice]:
    """Yield a notice of every response with more harmonics above the band than the reference.

    A spring or damper that depends on the amplitude turns part of the excitation into harmonics; noise differs between
    periods. `period_s` is the stated period.
    """
    rate = record.sample_rate_hz
    period = find_period(record.reference, period_s * rate, settle_periods)
    if period.count < 3 or _GUARD * highest_hz >= _HIGHEST * rate:
        return
    data = np.column_stack([record.reference, record.responses])
    above = period_phasors(data, period, (_GUARD * highest_hz / rate, _HIGHEST)).value
    mean, count = above.mean(axis=0), len(above)
    noise = np.var(above, axis=0, ddof=1).mean(axis=0) / count
    power = np.mean(np.abs(mean) ** 2, axis=0)
    inside = period_phasors(data, period, (0.5 * highest_hz / rate, highest_hz / rate)).value.mean(axis=0)
    size = np.sqrt(np.mean(np.abs(inside) ** 2, axis=0))
    own = power - noise
    lines = len(mean)
    for channel, name in enumerate(record.channels, 1):
        chance = _SIGNIFICANT * noise[channel] / np.sqrt(lines)
        gain = max(1.0, float(size[channel] / size[0]))
        linear = (_OF_REFERENCE * gain) ** 2 * max(0.0, float(own[0]))
        if own[channel] > chance + linear:
            level = 20.0 * np.log10(np.sqrt(own[channel]) / size[channel])
            yield Notice(NONLINEAR_DISTORTIONS, name, levels=f"{level:.0f} dB above the excited band")
