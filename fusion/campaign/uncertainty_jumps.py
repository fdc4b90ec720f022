"""Recordings of a campaign with U several times that of their neighbours, and the cause."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from typing import NamedTuple

import numpy as np

from fusion.campaign.campaign_notices import UNCERTAINTY_JUMP
from fusion.campaign.excited_line import FREQUENCY_TOLERANCE, ExcitedLine
from fusion.campaign.recording_results import RecordingResults
from fusion.campaign.repeats import drive_values
from fusion.sensitivity.load_phasors import budget
from fusion.sensitivity.ratio import StatedMatrix, driven_component
from shaker.labels import LOAD_COMPONENTS
from shakercal._common.notices import Notice

JUMP = 3.0
"""Ratio of a recording's relative U to the median of its neighbours from which it is named."""
NEIGHBOURS = 2
"""Number of neighbours on each side in frequency."""


class LinePrecision(NamedTuple):
    """Relative u of a main sensitivity, with the largest influence and its share."""

    folder: str
    frequency_hz: float
    u: float
    influence: str
    share: float


def uncertainty_jumps(
    recorded: Iterable[RecordingResults], capacity: Sequence[float] | None, stated: StatedMatrix | None
) -> Iterator[Notice]:
    """Yield a notice for every line with U much larger than its neighbours.

    The neighbours are recordings of the same component at other frequencies, or at the same one without those.
    """
    found: dict[int, list[LinePrecision]] = {}
    for entry in recorded:
        for drive in entry.excited_lines:
            component = driven_component(drive.direction, capacity)
            precision = _line_precision(entry.folder, drive, component, stated)
            if precision is not None:
                found.setdefault(component, []).append(precision)
    for component, lines in found.items():
        for one in lines:
            usual = _usual(one, lines)
            if usual is not None and one.u >= JUMP * usual:
                yield Notice(
                    UNCERTAINTY_JUMP,
                    one.folder,
                    component=LOAD_COMPONENTS[component],
                    frequency_hz=one.frequency_hz,
                    factor=one.u / usual,
                    U_percent=200.0 * one.u,
                    influence=one.influence,
                    share_percent=100.0 * one.share,
                )


def _line_precision(
    folder: str, drive: ExcitedLine, component: int, stated: StatedMatrix | None
) -> LinePrecision | None:
    """Return the relative u of the main output over its load, or None."""
    usable = [name for name, value in zip(drive.channels, drive.outputs, strict=True) if np.isfinite(value) and value]
    usable = [name for name in usable if stated is None or name in stated.channels]
    if not usable or drive.load[component] == 0.0 or not drive.observed[component]:
        return None
    main = LOAD_COMPONENTS[component]
    channel = main if main in usable else max(usable, key=lambda name: abs(drive.output(name)))
    _, ((value, uncertainty),) = drive_values([drive], component, stated, [channel])
    entries = budget(uncertainty, value[None])
    variances = np.array([entry.u_relative[0, 0] ** 2 for entry in entries])
    total = float(np.sum(variances))
    if not total > 0.0:
        return None
    largest = int(np.argmax(variances))
    return LinePrecision(
        folder, drive.frequency_hz, total**0.5, entries[largest].label, float(variances[largest]) / total
    )


def _usual(one: LinePrecision, lines: Sequence[LinePrecision]) -> float | None:
    """Return the median u of the nearest other recordings, None without two of them."""
    far = [other for other in lines if abs(other.frequency_hz / one.frequency_hz - 1.0) > FREQUENCY_TOLERANCE]
    if not far:
        near = [other.u for other in lines if other is not one]
        return float(np.median(near)) if len(near) >= NEIGHBOURS else None
    hertz = np.unique([other.frequency_hz for other in far])
    below, above = hertz[hertz < one.frequency_hz][-NEIGHBOURS:], hertz[hertz > one.frequency_hz][:NEIGHBOURS]
    # Each frequency counts once, whatever the number of its repeats.
    levels = [
        float(np.median([other.u for other in far if other.frequency_hz == frequency]))
        for frequency in (*below, *above)
    ]
    return float(np.median(levels)) if len(levels) >= NEIGHBOURS else None
