"""One driven line of one recording as several recordings are compared: load, outputs, and which unknowns they share."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from fusion.uncertainty import Contribution, Influence, Uncertainty
from shaker._checks import ComplexArray, FloatArray, IntArray, check_shape

if TYPE_CHECKING:
    from fusion.evaluation import Evaluation
    from fusion.load import LoadResult
    from fusion.outputs import Outputs


LOADS = 6
FREQUENCY_TOLERANCE = 0.01
"""Relative width of a group of lines taken as one frequency: a multi-axis shaker drives several lines side by side."""


@dataclass(frozen=True)
class Drive:
    """One driven line (its fundamental) of one recording.

    `mounting`: recordings with another text were mounted anew. `direction`: 3 or 6 numbers of the excitation. `load`
    (6,) in N and N·m, whole, with the uncertainty of what nobody observed; `outputs` (C,) in the sensor's unit, NaN
    where a channel has no usable reading; their uncertainties have one line (K = 1) and the names of the recording.
    """

    recording: str
    mounting: str
    frequency_hz: float
    nominal_hz: float
    direction: tuple[float, ...]
    load: ComplexArray
    load_uncertainty: Uncertainty
    outputs: ComplexArray
    outputs_uncertainty: Uncertainty
    channels: tuple[str, ...]

    def __post_init__(self) -> None:
        channels = len(self.channels)
        check_shape("load", self.load, (LOADS,))
        check_shape("outputs", self.outputs, (channels,))
        check_shape("load_uncertainty", self.load_uncertainty.random[0].covariance, (1, 2 * LOADS, 2 * LOADS))
        check_shape(
            "outputs_uncertainty", self.outputs_uncertainty.random[0].covariance, (1, 2 * channels, 2 * channels)
        )

    @property
    def name(self) -> str:
        """Return what tells this drive from others: its recording and its frequency."""
        return f"{self.recording} ({self.nominal_hz:g} Hz)"

    def shared(self) -> tuple[Uncertainty, Uncertainty]:
        """Return the uncertainties of load and outputs with the names that hold between recordings."""
        return (
            between_recordings(self.load_uncertainty, self.recording, self.mounting),
            between_recordings(self.outputs_uncertainty, self.recording, self.mounting),
        )


def drives_of(evaluation: Evaluation) -> tuple[Drive, ...]:
    """Return the driven lines of a recording, none without a load, an output or a stated direction."""
    manifest, load, outputs = evaluation.manifest, evaluation.load, evaluation.outputs
    if load is None or outputs is None or manifest.excitation.direction is None:
        return ()
    lines, direction = evaluation.lines, manifest.excitation.direction
    return line_drives(manifest.name, manifest.mounting, direction, lines.nominal_hz, lines.multiple, load, outputs)


def line_drives(
    recording: str,
    mounting: str,
    direction: Sequence[float],
    nominal_hz: FloatArray,
    multiple: IntArray,
    load: LoadResult,
    outputs: Outputs,
) -> tuple[Drive, ...]:
    """Return the drives of one recording: its lines of multiple 1 at which the load is known.

    `nominal_hz`, `multiple` (K,): of the lines of `load` and `outputs`.
    """
    driven = np.flatnonzero((multiple == 1) & np.isfinite(load.value).all(axis=1))
    return tuple(
        Drive(
            recording=recording,
            mounting=mounting,
            frequency_hz=float(load.frequency_hz[line]),
            nominal_hz=float(nominal_hz[line]),
            direction=tuple(float(number) for number in direction),
            load=load.value[line],
            load_uncertainty=at_line(load.uncertainty, line),
            outputs=outputs.phasors.value[line],
            outputs_uncertainty=at_line(outputs.uncertainty, line),
            channels=outputs.phasors.channels,
        )
        for line in driven.tolist()
    )


def between_recordings(uncertainty: Uncertainty, recording: str, mounting: str) -> Uncertainty:
    """Return the uncertainty with every unknown under the name that identifies it among all recordings of a campaign.

    An unknown of the rig keeps its name; one of the mounting is the same in recordings of equal `mounting` only, one of
    the recording in this recording only. The names are final: all scopes become "rig".
    """
    return replace(
        uncertainty, influences=tuple(_between(influence, recording, mounting) for influence in uncertainty.influences)
    )


def _between(influence: Influence, recording: str, mounting: str) -> Influence:
    """One unknown under its name among all recordings."""
    suffix = {"rig": "", "mounting": f" [{mounting}]", "recording": f" [{recording}]"}[influence.scope]
    return replace(influence, name=f"{influence.name}{suffix}", scope="rig")


def at_line(uncertainty: Uncertainty, line: int) -> Uncertainty:
    """Return the uncertainty of the values at one of the K lines."""
    here = slice(line, line + 1)
    random = tuple(
        replace(part, covariance=part.covariance[here], dof=None if part.dof is None else part.dof[here])
        for part in uncertainty.random
    )
    return Uncertainty(random, tuple(replace(i, effect=i.effect[here]) for i in uncertainty.influences))


def over_lines(parts: Sequence[Uncertainty]) -> Uncertainty:
    """Return uncertainties of the same C values at single lines, joined to one of K lines, unknowns of one name as one.

    Names must hold between the recordings that the parts come from (`between_recordings`).
    """
    lines, size = len(parts), parts[0].random[0].covariance.shape[1]
    random: dict[str, Contribution] = {}
    influences: dict[str, Influence] = {}
    for line, part in enumerate(parts):
        for own in Uncertainty(part.random).grouped():
            known = random.get(own.label)
            if known is None:
                empty = np.zeros((lines, size, size))
                known = random[own.label] = Contribution(own.label, own.type, empty, np.full(lines, np.inf))
            known.covariance[line] = own.covariance[0]
            if own.dof is not None and known.dof is not None:
                known.dof[line] = own.dof[0]
        for influence in part.influences:
            if influence.name not in influences:
                influences[influence.name] = replace(influence, effect=np.zeros((lines, size)))
            influences[influence.name].effect[line] = influence.effect[0]
    return Uncertainty(tuple(random.values()), tuple(influences.values()))


def group_by_frequency(
    drives: Sequence[Drive], tolerance: float = FREQUENCY_TOLERANCE
) -> tuple[tuple[Drive, ...], ...]:
    """Return the drives in groups of one frequency, ascending, each at most `tolerance` (relative) wide."""
    groups: list[list[Drive]] = []
    for drive in sorted(drives, key=lambda drive: drive.frequency_hz):
        if groups and drive.frequency_hz <= groups[-1][0].frequency_hz * (1.0 + tolerance):
            groups[-1].append(drive)
        else:
            groups.append([drive])
    return tuple(tuple(group) for group in groups)
