"""Notices of missing filters: aliased harmonics, and delays that an unstated filter may cause."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from fusion.instruments.channel import NOISE_REACH, ChannelReading, chain_errors, u_of_filter
from fusion.phasors.channel_phasors import HARMONICS, ChannelResult, describe_folds, folding
from fusion.phasors.phasor_notices import ALIASED_HARMONICS, FILTER_DELAY, HIGH_HARMONICS_NOT_ASSESSED
from shakercal._common.notices import Notice

if TYPE_CHECKING:
    from shaker.lines.frequencies import LineFrequencies
    from shaker.sine.aliasing import AliasedHarmonic

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
    """Return warnings of stated delays that attenuating filters may cause.

    `path`: of the manifest.
    """
    notices = []
    for entry, phasors in ((reading.entry, reading.phasors) for reading in readings if reading.entry.delay_of is None):
        loss = np.sqrt(3.0) * u_of_filter(phasors.frequency_hz, entry.filter_delay_s)[0]
        line = int(np.argmax(loss))
        if loss[line] > ATTENUATED:
            values = {"delay_us": 1e6 * entry.delay, "frequency_hz": phasors.frequency_hz[line], "loss": loss[line]}
            notices.append(Notice(FILTER_DELAY, f"{path.name}: channel.{entry.name}.delay", **values))
    return notices
