"""What the recordings of a campaign say together: matrices, cross-talk, repeats, linearity, one curve per element."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import TypeVar

import numpy as np

from fusion.curve import Curve, matrix_curve, ratio_curves, relative_curve
from fusion.drive import Drive, group_by_frequency
from fusion.linearity import Linearity, find_linearity
from fusion.load import LOAD_COMPONENTS
from fusion.matrix import CrossTalk, MatrixFit, MissingExcitationError, cross_talk, fit_matrix
from fusion.notices import Notice
from fusion.read_results import Recorded, SensorFacts
from fusion.repeats import Repeats, find_repeats
from shaker.notice import Severity

Joint = TypeVar("Joint")


@dataclass(frozen=True)
class CampaignEvaluation:
    """All that several recordings of one sensor yield together.

    `name` of the campaign; `recorded`: what could be evaluated, in order; `failed`: why others could not, by folder;
    `curves`: ratios by driven component, then elements of matrices; `relative`: each over its static sensitivity, None
    where none is stated; `repeats`: every excitation that was recorded more than once; `matrices` and `cross_talks`
    (none where rated loads are not stated): one per frequency that determines a matrix; `refused`: why the other
    frequencies do not.
    """

    name: str
    recorded: tuple[Recorded, ...]
    failed: Mapping[str, str]
    sensor: SensorFacts | None
    curves: tuple[Curve, ...]
    relative: tuple[Curve | None, ...]
    repeats: tuple[Repeats, ...]
    linearity: tuple[Linearity, ...]
    matrices: tuple[MatrixFit, ...]
    cross_talks: tuple[CrossTalk, ...]
    refused: tuple[Notice, ...]
    notices: tuple[Notice, ...]

    @property
    def drives(self) -> tuple[Drive, ...]:
        """Return the driven lines of all recordings."""
        return tuple(drive for entry in self.recorded for drive in entry.drives)


def evaluate_campaign(name: str, recorded: Sequence[Recorded], failed: Mapping[str, str]) -> CampaignEvaluation:
    """Evaluate the recordings of a campaign together, in the order given."""
    known = distinct_names(recorded)
    sensor, several = _one_sensor(known)
    drives = [drive for entry in known for drive in entry.drives] if sensor is not None else []
    capacity = None if sensor is None or sensor.capacity is None else sensor.capacity.tolist()
    matrices, refused = fit_matrices(drives, () if sensor is None else sensor.channels)
    ratios, no_ratios = _attempt("curves of ratios", lambda: ratio_curves(drives, capacity))
    alike, no_repeats = _attempt("means of repeats", lambda: find_repeats(drives, capacity))
    series, no_series = _attempt("linearity", lambda: find_linearity(drives, capacity))
    curves = (*ratios, *matrix_curves(matrices))
    repeats = tuple(found for found in alike if len(found.recordings) > 1)
    failures = [notice for notice in refused if notice.severity == "warning"]
    failures += [*no_ratios, *no_repeats, *no_series]
    found = [notice for fit in matrices for notice in fit.notices]
    found += [notice for repeated in repeats for notice in repeated.notices]
    return CampaignEvaluation(
        name=name,
        recorded=known,
        failed=dict(failed),
        sensor=sensor,
        curves=curves,
        relative=tuple(None if sensor is None else over_static(curve, sensor) for curve in curves),
        repeats=repeats,
        linearity=series,
        matrices=matrices,
        cross_talks=() if capacity is None else tuple(cross_talk(fit, capacity) for fit in matrices),
        refused=refused,
        notices=(*several, *_failures(failed), *failures, *found),
    )


def _attempt(what: str, make: Callable[[], tuple[Joint, ...]]) -> tuple[tuple[Joint, ...], tuple[Notice, ...]]:
    """Return joint results, or why there are none: recordings that do not fit together keep their own results."""
    try:
        return make(), ()
    except ValueError as error:
        return (), (Notice("warning", f"no {what}: {error}", "campaign"),)


def matrix_curves(fits: Sequence[MatrixFit]) -> tuple[Curve, ...]:
    """Return the matrices of all frequencies as one curve for each set of outputs that they have."""
    sets = dict.fromkeys(fit.channels for fit in fits)
    return tuple(matrix_curve([fit for fit in fits if fit.channels == channels]) for channels in sets)


def over_static(curve: Curve, sensor: SensorFacts) -> Curve | None:
    """Return a curve over the static sensitivity, None where that is not stated."""
    if sensor.static is None:
        return None
    rows = [sensor.channels.index(channel) for channel in curve.channels]
    return relative_curve(curve, sensor.static[rows], sensor.u_static)


def main_channel(evaluation: CampaignEvaluation, channels: Sequence[str], component: int) -> int:
    """Return which of the outputs belongs to a load component.

    The one of the same name, else the largest by static sensitivity, else the largest found.
    """
    sensor = evaluation.sensor
    if LOAD_COMPONENTS[component] in channels:
        return list(channels).index(LOAD_COMPONENTS[component])
    if sensor is not None and sensor.static is not None:
        rows = [sensor.channels.index(channel) for channel in channels]
        return int(np.argmax(np.abs(sensor.static[rows, component])))
    size = np.zeros(len(channels))
    for curve in evaluation.curves:
        for e, (channel, j) in enumerate(curve.elements):
            if j == component and curve.channels[channel] in channels:
                place = list(channels).index(curve.channels[channel])
                size[place] = max(size[place], float(np.nanmax(np.abs(curve.value[:, e]), initial=0.0)))
    return int(np.argmax(size))


def distinct_names(recorded: Sequence[Recorded]) -> tuple[Recorded, ...]:
    """Return the recordings with names that tell them apart: a name that occurs twice gets the folder's beside it.

    Unknowns of single recordings are known by the recording's name.
    """
    names = [entry.name for entry in recorded]
    return tuple(
        entry if names.count(entry.name) == 1 else _renamed(entry, f"{entry.name} [{entry.folder}]")
        for entry in recorded
    )


def fit_matrices(drives: Sequence[Drive], channels: Sequence[str]) -> tuple[tuple[MatrixFit, ...], tuple[Notice, ...]]:
    """Return the matrix of every frequency that determines one, and why the others do not."""
    fits: list[MatrixFit] = []
    refused: dict[tuple[Severity, str], list[float]] = {}
    recorded = [name for name in channels if any(name in drive.channels for drive in drives)]
    for group in group_by_frequency(drives):
        try:
            fits.append(fit_matrix(group, recorded))
        except ValueError as error:
            refused.setdefault(_reason(error), []).append(group[0].frequency_hz)
    notices = tuple(_refusal(*reason, places) for reason, places in refused.items())
    return tuple(fits), notices


def _reason(error: ValueError) -> tuple[Severity, str]:
    """Why there is no matrix, and how severe that is: ratios need no matrix, a fit that fails is a surprise."""
    if isinstance(error, MissingExcitationError):
        return "info", "the recordings excite too few independent loads; " + str(error).partition("; ")[2]
    return "warning", str(error)


def _refusal(severity: Severity, reason: str, frequency_hz: Sequence[float]) -> Notice:
    """One sentence for all frequencies without a matrix for the same reason."""
    first, last = min(frequency_hz), max(frequency_hz)
    where = (
        f"{first:.6g} Hz"
        if len(frequency_hz) == 1
        else f"{len(frequency_hz)} frequencies, {first:.6g} to {last:.6g} Hz"
    )
    return Notice(severity, f"no matrix at {where}: {reason}", "matrix")


def _failures(failed: Mapping[str, str]) -> tuple[Notice, ...]:
    """Name the recordings that could not be evaluated."""
    if not failed:
        return ()
    text = f"{len(failed)} of the recordings could not be evaluated and are in no result: {', '.join(failed)}"
    return (Notice("warning", text, "campaign"),)


def _renamed(entry: Recorded, name: str) -> Recorded:
    """A recording under another name."""
    return replace(entry, name=name, drives=tuple(replace(drive, recording=name) for drive in entry.drives))


def _one_sensor(recorded: Sequence[Recorded]) -> tuple[SensorFacts | None, tuple[Notice, ...]]:
    """The sensor of all recordings; none where they tested several, which have nothing to say together."""
    sensors = {(entry.sensor.name, entry.sensor.serial): entry.sensor for entry in recorded if entry.sensor is not None}
    if len(sensors) > 1:
        names = ", ".join(f"{name} {serial}".strip() for name, serial in sensors)
        text = f"the recordings tested several sensors ({names}): no joint sensitivity; a campaign has one sensor"
        return None, (Notice("warning", text, "campaign"),)
    return next(iter(sensors.values()), None), ()
