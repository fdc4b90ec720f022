"""The joint tables of a campaign: matrices among the sensitivities, curves over frequency, cross-talk."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np

from fusion.joint.evaluation import CampaignEvaluation
from fusion.joint.points import curve_points
from fusion.matrix import CrossTalk
from fusion.polar import polar
from fusion.results import CROSSTALK_FILE, CURVE_FILE
from fusion.results_csv import (
    SENSITIVITY_COLUMNS,
    SENSITIVITY_FILE,
    Row,
    csv_text,
    element_rows,
    merge_tables,
    polar_cells,
)

CURVE_COLUMNS = [
    *SENSITIVITY_COLUMNS[:13],
    "k",
    "U_magnitude",
    "U_phase_rad",
    "relative",
    "u_relative",
    "U_relative",
    "unit",
    "recordings",
    "mountings",
    "kind",
]
CROSSTALK_COLUMNS = [*SENSITIVITY_COLUMNS[:13], "U_region", "holds_zero"]


def campaign_tables(evaluation: CampaignEvaluation, folders: Sequence[Path]) -> dict[str, str]:
    """Return the text of every joint table, by file name; `folders`: of the recordings, in the order of the rows."""
    tables = merge_tables(folders)
    matrices = csv_text(SENSITIVITY_COLUMNS, matrix_rows(evaluation)).partition("\n")[2]
    tables[SENSITIVITY_FILE] += matrices
    tables[CURVE_FILE] = csv_text(CURVE_COLUMNS, curve_rows(evaluation))
    rows = (row for found in evaluation.cross_talks for row in crosstalk_rows(found))
    tables[CROSSTALK_FILE] = csv_text(CROSSTALK_COLUMNS, rows)
    return tables


def matrix_rows(evaluation: CampaignEvaluation) -> Iterator[Row]:
    """One row per frequency and element of the matrices, the campaign in place of a recording."""
    if evaluation.sensor is not None:
        for fit in evaluation.matrices:
            yield from element_rows(fit.sensitivity(evaluation.sensor.unit), evaluation.name)


def curve_rows(evaluation: CampaignEvaluation) -> Iterator[Row]:
    """One row per frequency and element of the curves; what is not relative to a static sensitivity is `nan` there."""
    for point in curve_points(evaluation):
        element, relative = point.element, point.relative
        head: Row = [point.frequency_hz, point.channel, point.component, *polar_cells(element)]
        expanded: Row = [element.k, element.expanded_magnitude, element.expanded_phase_rad]
        ratio: Row = [np.nan] * 3
        if relative is not None:
            ratio = [relative.magnitude, relative.u_magnitude, relative.expanded_magnitude]
        yield [*head, *expanded, *ratio, point.unit, point.recordings, point.mountings, point.kind]


def crosstalk_rows(found: CrossTalk) -> Iterator[Row]:
    """One row per element beside the main ones."""
    covariance, dof, count = found.uncertainty.covariance[0], found.uncertainty.dof()[0], found.value.size
    for place, (c, j) in enumerate(np.ndindex(found.value.shape)):
        if found.main[c] != j:
            both = [place, place + count]
            element = polar(complex(found.value[c, j]), covariance[np.ix_(both, both)], float(dof[place]))
            head: Row = [found.frequency_hz, found.channels[c], found.components[j]]
            zero = "yes" if found.holds_zero[c, j] else "no"
            yield [*head, *polar_cells(element), float(found.half_axis[c, j]), zero]
