"""What the recordings of a campaign say together: matrices, cross-talk, repeats, linearity, one curve per element."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

from fusion.drive import Drive, group_by_frequency
from fusion.matrix import CrossTalk, MatrixFit, MissingExcitationError, cross_talk, fit_matrix
from fusion.notices import Notice
from fusion.read_results import Recorded, SensorFacts
from shaker.notice import Severity


@dataclass(frozen=True)
class CampaignEvaluation:
    """All that several recordings of one sensor yield together.

    `name` of the campaign; `recorded`: what could be evaluated, in order; `failed`: why others could not, by folder;
    `matrices` and `cross_talks` (none where rated loads are not stated): one per frequency that determines a matrix;
    `refused`: why the other frequencies do not.
    """

    name: str
    recorded: tuple[Recorded, ...]
    failed: Mapping[str, str]
    sensor: SensorFacts | None
    matrices: tuple[MatrixFit, ...]
    cross_talks: tuple[CrossTalk, ...]
    refused: tuple[Notice, ...]
    notices: tuple[Notice, ...]


def evaluate_campaign(name: str, recorded: Sequence[Recorded], failed: Mapping[str, str]) -> CampaignEvaluation:
    """Evaluate the recordings of a campaign together, in the order given."""
    known = distinct_names(recorded)
    sensor, notices = _one_sensor(known)
    drives = [drive for entry in known for drive in entry.drives] if sensor is not None else []
    matrices, refused = fit_matrices(drives, () if sensor is None else sensor.channels)
    capacity = None if sensor is None else sensor.capacity
    found = [notice for fit in matrices for notice in fit.notices]
    return CampaignEvaluation(
        name=name,
        recorded=known,
        failed=dict(failed),
        sensor=sensor,
        matrices=matrices,
        cross_talks=() if capacity is None else tuple(cross_talk(fit, capacity.tolist()) for fit in matrices),
        refused=refused,
        notices=(*notices, *(notice for notice in refused if notice.severity == "warning"), *found),
    )


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
