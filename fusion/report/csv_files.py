"""The result tables: rows of every CSV file, written with full double precision, and read back for a campaign."""

from __future__ import annotations

import csv
import io
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from fusion.estimation.uncertainty import Polar, element_covariance, polar
from fusion.phasors.results import StereoResult
from fusion.sensitivity.analyse import Evaluation
from fusion.sensitivity.ratio import Sensitivity
from shaker.arrays import FloatArray
from shaker.sine.phasor import Phasors

SENSITIVITY_FILE, ACCELERATION_FILE, LOAD_FILE = "sensitivity.csv", "acceleration.csv", "load.csv"
POLAR_COLUMNS = ("magnitude", "phase_rad", "u_magnitude", "u_phase_rad", "re", "im", "u_re", "u_im", "r", "dof")
"""Columns of a complex value in sensitivity.csv, in the order of the fields of `Polar`."""
SENSITIVITY_COLUMNS = [
    "frequency_hz",
    "channel",
    "component",
    "magnitude",
    "phase_rad",
    "u_magnitude",
    "u_phase_rad",
    "re",
    "im",
    "u_re",
    "u_im",
    "r",
    "dof",
    "unit",
    "kind",
    "recording",
]
PHASOR_COLUMNS = [
    "frequency_hz",
    "body",
    "component",
    "amplitude",
    "phase_rad",
    "u_amplitude",
    "u_phase_rad",
    "re",
    "im",
    "u_re",
    "u_im",
    "r",
    "dof",
    "unit",
    "source",
    "recording",
]
MERGED_FILES = {SENSITIVITY_FILE: SENSITIVITY_COLUMNS, ACCELERATION_FILE: PHASOR_COLUMNS, LOAD_FILE: PHASOR_COLUMNS}
"""Columns of the tables that a campaign joins, by file name."""
POSE_COLUMNS = ["x_m", "y_m", "z_m", "rx_rad", "ry_rad", "rz_rad"]
MOTION_COLUMNS = ["time_s", *POSE_COLUMNS, *(f"u_{name}" for name in POSE_COLUMNS), "residual_m", "points"]

Cell = str | float | int
Row = list[Cell]


def result_tables(evaluation: Evaluation) -> dict[str, str]:
    """Text of every CSV file of one recording, by file name."""
    tables = {
        SENSITIVITY_FILE: csv_text(SENSITIVITY_COLUMNS, sensitivity_rows(evaluation)),
        ACCELERATION_FILE: csv_text(PHASOR_COLUMNS, acceleration_rows(evaluation)),
        LOAD_FILE: csv_text(PHASOR_COLUMNS, load_rows(evaluation)),
    }
    for stereo in evaluation.stereo:
        tables[f"motion-{stereo.name}.csv"] = csv_text(MOTION_COLUMNS, motion_rows(stereo))
    return tables


def csv_text(columns: Sequence[str], rows: Iterator[Row]) -> str:
    """Header and rows as CSV text; floats in the shortest form that reads back to the same double."""
    stream = io.StringIO()
    writer = csv.writer(stream, lineterminator="\n")
    writer.writerow(columns)
    writer.writerows([_cell(cell) for cell in row] for row in rows)
    return stream.getvalue()


def sensitivity_unit(output_unit: str, component: str) -> str:
    """ASCII unit of output per load component, `(V/V)/N` or `(V/V)/(N.m)`."""
    numerator = f"({output_unit})" if "/" in output_unit else output_unit
    return f"{numerator}/N" if component.startswith("F") else f"{numerator}/(N.m)"


def sensitivity_rows(evaluation: Evaluation) -> Iterator[Row]:
    """One row per line and element of the sensitivity that could be determined."""
    if evaluation.sensitivity is not None:
        yield from element_rows(evaluation.sensitivity, evaluation.manifest.name)


def element_rows(found: Sensitivity, recording: str) -> Iterator[Row]:
    """Rows of a sensitivity that comes from `recording`, or from a campaign of this name."""
    covariance, dof = found.covariance, found.dof
    for k, c, j in np.argwhere(np.isfinite(found.value)).tolist():
        element = polar(complex(found.value[k, c, j]), covariance[k, c, j], float(dof[k, c, j]))
        unit = sensitivity_unit(found.unit, found.components[j])
        head: Row = [float(found.frequency_hz[k]), found.channels[c], found.components[j]]
        yield [*head, *polar_cells(element), unit, found.kind[k], recording]


def sensitivity_element(sensitivity: Sensitivity, line: int, channel: int, component: int) -> Polar:
    """One element of the sensitivity at one line, as magnitude and phase."""
    place = line, channel, component
    return polar(complex(sensitivity.value[place]), sensitivity.covariance[place], float(sensitivity.dof[place]))


def row_element(row: Mapping[str, str]) -> Polar:
    """One element of a sensitivity.csv, from the texts of its row."""
    return Polar(*(float(row[name]) for name in POLAR_COLUMNS))


def acceleration_rows(evaluation: Evaluation) -> Iterator[Row]:
    """One row per body, source, line and component that this source determines."""
    for result in evaluation.accelerations:
        tail: Row = [result.source, evaluation.manifest.name]
        determined = result.observed & np.isfinite(result.phasors.value)
        yield from _phasor_rows(result.phasors, result.uncertainty.dof(), determined, result.body, tail)


def load_rows(evaluation: Evaluation) -> Iterator[Row]:
    """One row per line and load component."""
    load = evaluation.load
    if load is not None:
        phasors, tail = load.phasors, ["fused", evaluation.manifest.name]
        yield from _phasor_rows(phasors, load.uncertainty.dof(), np.isfinite(phasors.value), "load", tail)


def _phasor_rows(
    phasors: Phasors, dof: FloatArray, determined: NDArray[np.bool_], body: str, tail: Sequence[Cell]
) -> Iterator[Row]:
    """Rows of the elements marked `determined` (K, C), each with its own degrees of freedom (K, C)."""
    for k, c in np.argwhere(determined):
        element = polar(complex(phasors.value[k, c]), element_covariance(phasors.covariance[k], c), float(dof[k, c]))
        head: Row = [float(phasors.frequency_hz[k]), body, phasors.channels[c]]
        yield [*head, *polar_cells(element), phasors.unit[c], *tail]


def motion_rows(stereo: StereoResult) -> Iterator[Row]:
    """One row per frame: the motion from the first frame's pose; a failed frame has `nan` and no points."""
    motion = stereo.motion
    u_pose = np.sqrt(motion.covariance.diagonal(axis1=1, axis2=2))
    for time, pose, u, residual, points in zip(
        stereo.time_s, motion.pose, u_pose, motion.residual_m, motion.points, strict=True
    ):
        failed = not np.isfinite(pose).all()
        numbers = np.full(13, np.nan) if failed else np.concatenate([pose, u, [residual]])
        yield [float(time), *map(float, numbers), 0 if failed else int(points)]


def merge_tables(folders: Sequence[Path]) -> dict[str, str]:
    """The recordings' sensitivity, acceleration and load tables joined by rows, as texts by file name.

    `folders`: the recordings' results folders, in the order of the rows. A folder without one of the tables is left
    out of that table.
    """
    merged = {}
    for name, header in MERGED_FILES.items():
        lines = [",".join(header)]
        for folder in folders:
            lines += _body(folder / name, lines[0])
        merged[name] = "\n".join(lines) + "\n"
    return merged


def read_rows(path: Path) -> list[dict[str, str]]:
    """Rows of a result table as dictionaries of texts."""
    with path.open(encoding="utf-8", newline="") as stream:
        return list(csv.DictReader(stream))


def _body(path: Path, header: str) -> list[str]:
    """Lines below the header of one table, which must be the one expected."""
    if not path.is_file():
        return []
    first, *body = path.read_text(encoding="utf-8").removesuffix("\n").split("\n")
    if first != header:
        raise ValueError(f"{path}: expected the columns {header}, found {first}")
    return body


def polar_cells(element: Polar) -> list[Cell]:
    """The ten numeric cells shared by all tables of phasors."""
    return [
        element.magnitude,
        element.phase_rad,
        element.u_magnitude,
        element.u_phase_rad,
        element.re,
        element.im,
        element.u_re,
        element.u_im,
        element.r,
        element.dof,
    ]


def _cell(cell: Cell) -> str:
    """Text of one cell."""
    return repr(float(cell)) if isinstance(cell, float) else str(cell)
