"""The curves of a campaign as points: magnitude and phase of every element at every frequency, and of recordings."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from fusion.curve import Curve
from fusion.joint.evaluation import CampaignEvaluation
from fusion.load import LOAD_COMPONENTS
from fusion.polar import Polar, element_covariance, polar
from fusion.repeats import drive_ratio
from fusion.results_csv import sensitivity_unit
from fusion.uncertainty import Uncertainty
from shaker._checks import ComplexArray


@dataclass(frozen=True)
class CurvePoint:
    """One element of the sensitivity at one frequency.

    `channel` and `component` by name; `element`: the value; `relative`: over its static sensitivity, None where that
    is not stated; `recordings` and `mountings` behind it; `kind`: ratio or matrix.
    """

    frequency_hz: float
    channel: str
    component: str
    unit: str
    element: Polar
    relative: Polar | None
    recordings: int
    mountings: int
    kind: str


def curve_points(evaluation: CampaignEvaluation) -> tuple[CurvePoint, ...]:
    """Return all points of all curves: curve by curve, frequencies ascending."""
    mounting = {entry.name: entry.mounting for entry in evaluation.recorded}
    unit = "" if evaluation.sensor is None else evaluation.sensor.unit
    points = []
    for curve, relative in zip(evaluation.curves, evaluation.relative, strict=True):
        values = curve_elements(curve)
        ratios = {} if relative is None else _by_element(relative)
        for k, row in enumerate(values):
            mountings = len({mounting[name] for name in curve.recordings[k]})
            for (c, j), element in zip(curve.elements, row, strict=True):
                if element is not None:
                    points.append(
                        CurvePoint(
                            frequency_hz=float(curve.frequency_hz[k]),
                            channel=curve.channels[c],
                            component=LOAD_COMPONENTS[j],
                            unit=sensitivity_unit(unit, LOAD_COMPONENTS[j]),
                            element=element,
                            relative=ratios[c, j][k] if (c, j) in ratios else None,
                            recordings=len(curve.recordings[k]),
                            mountings=mountings,
                            kind=curve.kind,
                        )
                    )
    return tuple(points)


def single_points(evaluation: CampaignEvaluation, curve: Curve, element: int) -> list[tuple[float, str, Polar]]:
    """Return frequency, mounting and ratio of every recording behind one element of a curve of ratios."""
    c, component = curve.elements[element]
    channel = curve.channels[c]
    behind = {(name, k) for k, names in enumerate(curve.recordings) for name in names}
    found = []
    for drive in evaluation.drives:
        line = int(np.argmin(np.abs(curve.frequency_hz - drive.frequency_hz)))
        if (drive.recording, line) in behind and channel in drive.channels:
            value, uncertainty = drive_ratio(drive, component, [channel])
            point = elements(value[None], uncertainty)[0][0]
            if point is not None:
                found.append((drive.frequency_hz, drive.mounting, point))
    return found


def curve_elements(curve: Curve) -> list[list[Polar | None]]:
    """Return every element (K lines of E) with magnitude and phase, None where there is no value."""
    return elements(curve.value, curve.uncertainty)


def elements(value: ComplexArray, uncertainty: Uncertainty) -> list[list[Polar | None]]:
    """Return complex values (K, C) with magnitude and phase, None where there is no value."""
    covariance, dof = uncertainty.covariance, uncertainty.dof()
    return [
        [
            polar(complex(entry), element_covariance(covariance[k], c), float(dof[k, c]))
            if np.isfinite(entry)
            else None
            for c, entry in enumerate(row)
        ]
        for k, row in enumerate(value)
    ]


def _by_element(curve: Curve) -> dict[tuple[int, int], Sequence[Polar | None]]:
    """Elements of a curve over frequency, by channel and component."""
    return dict(zip(curve.elements, zip(*curve_elements(curve), strict=True), strict=True))
