"""sensitivity.csv, acceleration.csv, load.csv and motion-NAME.csv of a recording, and how a campaign joins them."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import fields
from pathlib import Path
from typing import NamedTuple

import numpy as np

from fusion.estimation.uncertainty import Polar, Quantity, element_covariance, polar
from fusion.phasors.stereo_phasors import StereoResult
from fusion.report.table import Column, R, csv_text, word
from fusion.sensitivity.analyse import Evaluation
from fusion.sensitivity.ratio import Sensitivity
from shaker.arrays import BoolArray, FloatArray
from shaker.sine.phasor import Phasors

SENSITIVITY_FILE, ACCELERATION_FILE, LOAD_FILE = "sensitivity.csv", "acceleration.csv", "load.csv"


class Element(NamedTuple):
    """One complex value of a recording: of an output and load, or of a body and component, and where it is from."""

    frequency_hz: float
    of: str
    component: str
    value: Polar
    unit: str
    origin: str
    recording: str


class Pose(NamedTuple):
    """Motion of one frame: time, the pose's six components with u, rms residual, number of points."""

    time_s: float
    pose: FloatArray
    u: FloatArray
    residual_m: float
    points: int


def polar_columns(size: str, value: Callable[[R], Polar]) -> list[Column[R]]:
    """Return the ten columns of a complex value, of which `size` is the magnitude's name."""

    def column(field: str) -> Column[R]:
        return Column(field.replace("magnitude", size), lambda row: getattr(value(row), field))

    return [column(field.name) for field in fields(Polar)]


def quantity_columns(quantity: Callable[[R], Quantity]) -> list[Column[R]]:
    """Return the six columns of a real quantity."""
    return [
        Column("value", lambda row: quantity(row).value),
        Column("u", lambda row: quantity(row).u),
        Column("U", lambda row: quantity(row).expanded),
        Column("k", lambda row: quantity(row).k),
        word("unit", lambda row: quantity(row).unit),
        Column("dof", lambda row: quantity(row).dof),
    ]


def _element_columns(of: str, size: str, origin: str) -> list[Column[Element]]:
    """Columns of a table of complex values."""
    return [
        Column("frequency_hz", lambda e: e.frequency_hz),
        word(of, lambda e: e.of),
        word("component", lambda e: e.component),
        *polar_columns(size, lambda e: e.value),
        word("unit", lambda e: e.unit),
        word(origin, lambda e: e.origin),
        word("recording", lambda e: e.recording),
    ]


SENSITIVITY = _element_columns("channel", "magnitude", "kind")
PHASORS = _element_columns("body", "amplitude", "source")
MERGED_FILES = {SENSITIVITY_FILE: SENSITIVITY, ACCELERATION_FILE: PHASORS, LOAD_FILE: PHASORS}
"""Columns of the tables that a campaign joins, by file name."""
POSE = ("x_m", "y_m", "z_m", "rx_rad", "ry_rad", "rz_rad")


def _pose_column(place: int, prefix: str = "") -> Column[Pose]:
    """Column of one component of the pose, or of its u."""
    return Column(prefix + POSE[place], lambda frame: float((frame.u if prefix else frame.pose)[place]))


MOTION: list[Column[Pose]] = [
    Column("time_s", lambda frame: frame.time_s),
    *(_pose_column(place) for place in range(len(POSE))),
    *(_pose_column(place, "u_") for place in range(len(POSE))),
    Column("residual_m", lambda frame: frame.residual_m),
    Column("points", lambda frame: frame.points),
]


def result_tables(evaluation: Evaluation) -> dict[str, str]:
    """Text of every CSV file of one recording, by file name."""
    name, found = evaluation.manifest.name, evaluation.sensitivity
    tables = {
        SENSITIVITY_FILE: csv_text(SENSITIVITY, [] if found is None else sensitivity_elements(found, name)),
        ACCELERATION_FILE: csv_text(PHASORS, _accelerations(evaluation)),
        LOAD_FILE: csv_text(PHASORS, _loads(evaluation)),
    }
    return {**tables, **{f"motion-{stereo.name}.csv": csv_text(MOTION, poses(stereo)) for stereo in evaluation.stereo}}


def sensitivity_unit(output_unit: str, component: str) -> str:
    """ASCII unit of output per load component, `(V/V)/N` or `(V/V)/(N.m)`."""
    numerator = f"({output_unit})" if "/" in output_unit else output_unit
    return f"{numerator}/N" if component.startswith("F") else f"{numerator}/(N.m)"


def sensitivity_elements(found: Sensitivity, recording: str) -> Iterator[Element]:
    """One entry per line and element that could be determined, of a `recording` or of a campaign of this name."""
    for k, c, j in np.argwhere(np.isfinite(found.value)).tolist():
        unit, component = sensitivity_unit(found.unit, found.components[j]), found.components[j]
        value = sensitivity_element(found, k, c, j)
        yield Element(float(found.frequency_hz[k]), found.channels[c], component, value, unit, found.kind[k], recording)


def sensitivity_element(sensitivity: Sensitivity, line: int, channel: int, component: int) -> Polar:
    """One element of the sensitivity at one line, as magnitude and phase."""
    place = line, channel, component
    return polar(complex(sensitivity.value[place]), sensitivity.covariance[place], float(sensitivity.dof[place]))


def row_element(row: Mapping[str, str]) -> Polar:
    """One element of a sensitivity.csv, from the texts of its row."""
    return Polar(**{field.name: float(row[field.name]) for field in fields(Polar)})


def _accelerations(evaluation: Evaluation) -> Iterator[Element]:
    """One entry per body, source, line and component that this source determines."""
    for result in evaluation.accelerations:
        determined = result.observed & np.isfinite(result.phasors.value)
        origin = (result.body, result.source, evaluation.manifest.name)
        yield from _phasors(result.phasors, result.uncertainty.dof(), determined, origin)


def _loads(evaluation: Evaluation) -> Iterator[Element]:
    """One entry per line and load component."""
    load = evaluation.load
    if load is not None:
        origin = ("load", "fused", evaluation.manifest.name)
        yield from _phasors(load.phasors, load.uncertainty.dof(), np.isfinite(load.phasors.value), origin)


def _phasors(
    phasors: Phasors, dof: FloatArray, determined: BoolArray, origin: tuple[str, str, str]
) -> Iterator[Element]:
    """Elements marked `determined` (K, C), each with own degrees of freedom (K, C); origin: body, source, recording."""
    body, source, recording = origin
    for k, c in np.argwhere(determined):
        value = polar(complex(phasors.value[k, c]), element_covariance(phasors.covariance[k], c), float(dof[k, c]))
        frequency, component = float(phasors.frequency_hz[k]), phasors.channels[c]
        yield Element(frequency, body, component, value, phasors.unit[c], source, recording)


def poses(stereo: StereoResult) -> Iterator[Pose]:
    """One entry per frame: the motion from the first frame's pose; a failed frame has `nan` and no points."""
    motion, unknown = stereo.motion, np.full(6, np.nan)
    u_pose = np.sqrt(motion.covariance.diagonal(axis1=1, axis2=2))
    frames = zip(stereo.time_s, motion.pose, u_pose, motion.residual_m, motion.points, strict=True)
    for time, pose, u, residual, points in frames:
        failed = not np.isfinite(pose).all()
        numbers = (unknown, unknown, np.nan, 0) if failed else (pose, u, float(residual), int(points))
        yield Pose(float(time), *numbers)


def merge_tables(folders: Sequence[Path]) -> dict[str, str]:
    """The recordings' sensitivity, acceleration and load tables joined by rows, as texts by file name.

    `folders`: the recordings' results folders, in the order of the rows. A folder without one of the tables is left
    out of that table. Raises `ValueError` for a table of other columns.
    """
    merged = {}
    for name, columns in MERGED_FILES.items():
        lines = [",".join(column.name for column in columns)]
        for path in (folder / name for folder in folders):
            if path.is_file():
                first, *body = path.read_text(encoding="utf-8").removesuffix("\n").split("\n")
                if first != lines[0]:
                    raise ValueError(f"{path}: expected the columns {lines[0]}, found {first}")
                lines += body
        merged[name] = "\n".join(lines) + "\n"
    return merged
