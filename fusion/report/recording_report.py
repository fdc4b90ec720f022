"""Result files of one recording: tables, tracked points, HDF5 file and page."""

from __future__ import annotations

import os
import re
from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import fields
from operator import itemgetter
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from fusion.errors import InputError
from fusion.estimation.coverage import Polar
from fusion.estimation.fuse import Acceleration
from fusion.phasors.stereo_phasors import StereoResult
from fusion.report import tables, uncertainty_tables
from fusion.report.atomic_files import write_file, write_files
from fusion.report.field_data import FIRST_IMAGE, pair_fields
from fusion.report.field_images import field_page
from fusion.report.figure import Figure
from fusion.report.folder import (
    CURVE_FILE,
    RECORDED_AT,
    RESULT_FILE,
    RESULT_FORMAT,
    SENSITIVITY_FILE,
    InputFiles,
    check_folder,
    origin_frame,
    read_provenance,
    render_page,
    write_folder,
    write_provenance,
)
from fusion.report.h5 import EVIDENCE, h5_content, write_fields, write_value
from fusion.report.h5_tree import Group
from fusion.report.labelled_results import CAMPAIGN_FILE
from fusion.report.motion_figures import pair_motion_figures, subset_figures
from fusion.report.moving_image import moving_images
from fusion.report.page_images import reduced_image
from fusion.report.report_notices import OTHER_CAMPAIGN_CONTENT, RESERVED_NAME
from fusion.report.report_scene import body_displacements, evaluation_scene, scene_page
from fusion.report.result_figures import (
    acceleration_figures,
    channel_figures,
    draw_budget,
    point_figures,
    sensitivity_figures,
    trigger_figures,
)
from fusion.report.table import TableColumn, capitalise, csv_text, polar_columns, text_column
from fusion.report.traceability import trace_inputs, traceability
from fusion.report.vtk import collection, poly_data
from fusion.sensitivity.analyse import NOT_SHOWN, Evaluation
from fusion.sensitivity.input_evidence import InputEvidence, find_evidence
from fusion.sensitivity.load_phasors import LoadResult
from fusion.sensitivity.moving_body import moving_parts
from fusion.sensitivity.ratio import Sensitivity
from fusion.sensitivity.sensitivity_notices import NO_RESULT_AT_LINES
from photogram.geometry import displacement_jacobian, pose_rate, rotation_from_vector
from shaker.labels import AXES, sensitivity_unit
from shakercal._common.arrays import BoolArray, FloatArray
from shakercal._common.digits import number_text, quantity_text

# Its tables as CSV files, and how a campaign joins those of several.


ACCELERATION_FILE, LOAD_FILE = "acceleration.csv", "load.csv"


class ResultElement(NamedTuple):
    """One complex value with its frequency, component, unit and origin.

    `of`: output or body; `origin`: kind of the sensitivity, or source of the acceleration.
    """

    frequency_hz: float
    of: str
    component: str
    value: Polar
    unit: str
    origin: str
    recording: str


def _element_columns(of: str, size: str, origin: str) -> list[TableColumn[ResultElement]]:
    """Return the columns of a table of complex values."""
    return [
        TableColumn("frequency_hz", lambda e: e.frequency_hz),
        text_column(of, lambda e: e.of),
        text_column("component", lambda e: e.component),
        *polar_columns(size, lambda e: e.value),
        text_column("unit", lambda e: e.unit),
        text_column(origin, lambda e: e.origin),
        text_column("recording", lambda e: e.recording),
        *polar_columns(size, lambda e: e.value, freedom=True),
    ]


SENSITIVITY = _element_columns("channel", "magnitude", "kind")
PHASORS = _element_columns("body", "amplitude", "source")
MERGED_FILES = {SENSITIVITY_FILE: SENSITIVITY, ACCELERATION_FILE: PHASORS, LOAD_FILE: PHASORS}
"""Columns of the tables that a campaign joins, by file name."""
POSE = ("x_m", "y_m", "z_m", "rx_rad", "ry_rad", "rz_rad")
MOTION: list[TableColumn[tuple[float, ...]]] = [
    TableColumn(name, itemgetter(place))
    for place, name in enumerate(("time_s", *POSE, *(f"u_{name}" for name in POSE), "residual_m", "points"))
]


def result_tables(evaluation: Evaluation) -> dict[str, str]:
    """Return the text of every CSV file of one recording, by file name."""
    name, found = (
        evaluation.manifest.name,
        [result for result in (evaluation.sensitivity, evaluation.element) if result],
    )
    accelerations, load = evaluation.accelerations, evaluation.load
    moved = (entry for result in accelerations for entry in _phasors(result, result.body, result.source, name))
    texts = {
        SENSITIVITY_FILE: csv_text(
            SENSITIVITY, (row for result in found for row in sensitivity_elements(result, name))
        ),
        ACCELERATION_FILE: csv_text(PHASORS, moved),
        LOAD_FILE: csv_text(PHASORS, [] if load is None else _phasors(load, "load", "fused", name)),
    }
    return {**texts, **{f"motion-{stereo.name}.csv": csv_text(MOTION, poses(stereo)) for stereo in evaluation.stereo}}


def sensitivity_elements(found: Sensitivity, recording: str) -> Iterator[ResultElement]:
    """Yield one entry per determined line and element of a recording or campaign."""
    for k, c, j in np.argwhere(np.isfinite(found.value)).tolist():
        unit, component = sensitivity_unit(found.unit, found.components[j]), found.components[j]
        value = tables.sensitivity_element(found, k, c, j)
        yield ResultElement(
            float(found.frequency_hz[k]), found.channels[c], component, value, unit, found.kind[k], recording
        )


def row_element(row: Mapping[str, str]) -> Polar:
    """Return one element of a sensitivity.csv from the texts of its row."""
    return Polar(**{field.name: float(row[field.name]) for field in fields(Polar)})


def _phasors(result: Acceleration | LoadResult, body: str, source: str, recording: str) -> Iterator[ResultElement]:
    """Yield one entry per line and observed component."""
    phasors = result.phasors
    for k, row in enumerate(result.polar):
        for c, value in enumerate(row):
            if value is not None:
                frequency, component = float(phasors.frequency_hz[k]), phasors.channels[c]
                yield ResultElement(frequency, body, component, value, phasors.unit[c], source, recording)


def poses(stereo: StereoResult) -> Iterator[tuple[float, ...]]:
    """Yield the motion of every frame relative to the first one.

    Time, pose, its u, rms residual and number of points, as in `MOTION`. A failed frame has `nan` and no points.
    """
    motion = stereo.motion
    u_pose = np.sqrt(motion.covariance.diagonal(axis1=1, axis2=2))
    frames = zip(stereo.time_s, motion.pose, u_pose, motion.residual_m, motion.points, strict=True)
    for time, pose, u, residual, points in frames:
        failed = not np.isfinite(pose).all()
        numbers = [np.nan] * 13 if failed else [*pose.tolist(), *u.tolist(), float(residual)]
        yield float(time), *numbers, 0 if failed else int(points)


def merged_table(name: str, folders: Sequence[Path]) -> Iterator[str]:
    """Yield one of `MERGED_FILES` of several recordings: its first line, then the rows of each.

    `folders`: the recordings' results folders in the order of the rows; a folder without the table is skipped. Raises
    `ValueError` for a table with other columns.
    """
    head = ",".join(column.name for column in MERGED_FILES[name])
    yield f"{head}\n"
    for path in (folder / name for folder in folders):
        if path.is_file():
            first, _, body = path.read_text(encoding="utf-8").partition("\n")
            if first != head:
                raise ValueError(f"{path}: expected the columns {head}, found {first}")
            yield body if body.endswith("\n") or not body else f"{body}\n"


# Figures of the report of one recording.


def draw_all(evaluation: Evaluation) -> dict[str, list[Figure]]:
    """Return all figures of a recording by the section of its report."""
    return {
        "sensitivity": sensitivity_figures(evaluation),
        "acceleration": acceleration_figures(evaluation),
        "points": point_figures(evaluation),
        "budget": [figure for figure in [draw_budget(evaluation)] if figure],
        "motion": [figure for stereo in evaluation.stereo for figure in pair_motion_figures(stereo)],
        "subsets": subset_figures(evaluation),
        "channels": channel_figures(evaluation),
        "trigger": trigger_figures(evaluation),
    }


# report.html: one self-contained page with results, figures and origin of one recording.


REPORT_FILE = "report.html"


def render_report(evaluation: Evaluation) -> str:
    """Return the HTML text of the report; style and figures are included."""
    images = moving_images(evaluation.stereo, evaluation.manifest.rig.stereo, body_displacements(evaluation))
    context = {
        "name": evaluation.manifest.name,
        "simulated": evaluation.manifest.simulated,
        "subject": _subject(evaluation),
        "missing": [capitalise(notice.text) for notice in evaluation.notices if notice.code == NO_RESULT_AT_LINES.code],
        "headlines": tables.headlines(evaluation),
        "curve": bool(tables.curve_lines(evaluation)),
        "rig": scene_page(evaluation_scene(evaluation)),
        "images": images,
        "field_page": field_page(pair_fields(evaluation), evaluation.stereo, [image.name for image in images]),
        "pictures": draw_all(evaluation),
        "sensitivity": tables.sensitivity_table(evaluation),
        "sources": tables.source_tables(evaluation),
        "load": tables.load_table(evaluation),
        "points": uncertainty_tables.point_tables(evaluation),
        "consistency": uncertainty_tables.consistency_tables(evaluation),
        "others": uncertainty_tables.other_loads_table(evaluation),
        "budgets": uncertainty_tables.budget_tables(evaluation),
        "monte_carlo": uncertainty_tables.monte_carlo_tables(evaluation),
        "stereo": tables.stereo_table(evaluation.stereo),
        "shapes": tables.shape_tables(evaluation),
        "lines": tables.lines_table(evaluation),
        "channels": tables.channels_table(evaluation),
        "drift": tables.drift_table(evaluation),
        "takes": tables.takes_table(evaluation),
        "supports": tables.supports_table(evaluation),
        "clocks": tables.clocks_table(evaluation),
        "stated": uncertainty_tables.inputs_table(evaluation.manifest.inputs),
        **_traceability(evaluation),
        **origin_frame(evaluation, evaluation.notices),
        "duration_s": evaluation.duration_s,
    }
    return render_page("report.html", context)


def _evidence(evaluation: Evaluation) -> tuple[InputEvidence, ...]:
    """Return the sources of the inputs of all results."""
    parts = (evaluation.load, evaluation.outputs, evaluation.sensitivity, evaluation.element)
    influences = [influence for part in parts if part is not None for influence in part.uncertainty.influences]
    return find_evidence(evaluation.manifest, influences, evaluation.input_hashes)


def _traceability(evaluation: Evaluation) -> dict[str, Any]:
    """Return inputs of the main result, and the recalibration that pays most."""
    main = tables.main_result(evaluation)
    if main is None:
        return {"traceability": None}
    found, index = main
    labelled = found.labelled()
    driven = [line for line, kind in enumerate(labelled.kind) if kind != "harmonic"]
    uncertainty = labelled.uncertainty.at([index]).at_lines(driven)
    inputs = trace_inputs(labelled.value[driven][:, [index]], uncertainty, _evidence(evaluation))
    return traceability(inputs, labelled.elements[index])


def _subject(evaluation: Evaluation) -> list[tuple[str, str]]:
    """Return rig, sensor, load mass, excitation and surroundings."""
    rig, excitation = evaluation.manifest.rig, evaluation.manifest.excitation
    facts = [("Rig", rig.name)]
    if rig.sensor is not None:
        serial = f", serial number {rig.sensor.serial}" if rig.sensor.serial else ""
        facts.append(("Sensor", f"{rig.sensor.name}{serial}"))
    if rig.load is not None:
        stated = quantity_text(rig.load.mass, 2.0 * rig.load.mass_uncertainty, "kg")
        facts.append(("Load mass", f"{stated}, k = 2"))
    nominal = ", ".join(f"{number_text(frequency, 6)} Hz" for frequency in excitation.frequencies or ())
    direction = ", ".join(number_text(element, 6) for element in excitation.direction or ())
    excitation_texts = [excitation.kind, nominal, f"direction ({direction})" if direction else ""]
    facts.append(("Excitation", ", ".join(filter(None, excitation_texts))))
    manifest, around = evaluation.manifest, rig.surroundings
    parts = moving_parts(rig, manifest.part)
    if parts:
        mass, u = sum(part.mass_kg for part in parts), np.linalg.norm([part.u_mass_kg for part in parts])
        moved = quantity_text(mass, 2.0 * float(u), "kg")
        facts.append(("Moving mass", f"{moved}, k = 2, including the moving parts of the sensor"))
    if around.temperature is not None:
        facts.append(("Temperature of the air", f"{number_text(around.temperature, 6)} °C"))
    if around.sensor_temperature is not None:
        felt = quantity_text(around.sensor_temperature, 2.0 * around.sensor_temperature_uncertainty, "°C")
        facts.append(("Sensor temperature", f"{felt}, k = 2" if around.sensor_temperature_uncertainty else felt))
    day = (("Date", manifest.date), ("Operator", manifest.operator), ("Procedure", manifest.procedure))
    return [*facts, *((name, str(value)) for name, value in day if value is not None)]


# The results folder: tables, HDF5 file and report, whole or not at all.


CROSSTALK_FILE = "crosstalk.csv"
CAMPAIGN_FILES = (*MERGED_FILES, CURVE_FILE, CROSSTALK_FILE, REPORT_FILE, CAMPAIGN_FILE)
"""Files at the top of a campaign's results."""
REPLACEABLE_FILES = re.compile(
    r"(sensitivity|acceleration|load|motion-.+)\.csv|points-.+\.(csv|pvd|vtp)|result\.h5|report\.html"
)


def write_results(
    evaluation: Evaluation, folder: Path, inputs: InputFiles | None = None, *, force: bool = False
) -> list[Path]:
    """Write every result file of one recording and return the paths, as `write_folder` does."""

    def make(temporary: Path) -> list[str]:
        names = write_files(temporary, {**result_tables(evaluation), REPORT_FILE: render_report(evaluation)})
        if "save_points" in evaluation.settings:
            names += [name for stereo in evaluation.stereo for name in save_points(temporary, stereo)]
        names.append(RESULT_FILE)
        write_h5(temporary / RESULT_FILE, evaluation, names, folder)
        return names

    inputs = InputFiles(evaluation.input_hashes) if inputs is None else inputs
    return write_folder(folder, inputs, make, force=force, marker=RESULT_FILE, replaceable=REPLACEABLE_FILES)


def check_campaign_folder(top: Path, recordings: Sequence[str], *, force: bool) -> None:
    """Refuse a place for a campaign's results that contains other files.

    `recordings`: names of the recordings' folders, each of which is checked when it is written. Hidden files are
    ignored.
    """
    check_folder(top, {}, force=True)
    taken = next((name for name in recordings if name in CAMPAIGN_FILES), None)
    if taken is not None:
        raise InputError(RESERVED_NAME, top / taken)
    names = {entry.name for entry in top.iterdir()} if top.exists() and not force else set()
    expected = set(recordings)
    ours = {name for name in names if name in expected or read_provenance(top / name) is not None}
    other = {name for name in names - ours if not name.startswith(".") and not (ours and name in CAMPAIGN_FILES)}
    if other:
        raise InputError(OTHER_CAMPAIGN_CONTENT, top, found=min(other))


SENSOR = [
    *("name", "serial", "channels", "unit", "sense", "capacity", "static_sensitivity"),
    *("static_sensitivity_uncertainty", "cross_talk", "cross_talk_uncertainty"),
]
"""Information on the tested sensor that a campaign needs."""


def write_h5(path: Path, evaluation: Evaluation, files: Sequence[str], folder: Path | None = None) -> None:
    """Write the evaluation and its provenance to a new HDF5 file.

    `files`: names of all result files. `folder`: where they will be.
    """
    manifest = evaluation.manifest
    recorded = manifest.path.resolve()

    def fill(file: Group) -> None:
        file.attrs["format"] = RESULT_FORMAT
        file.attrs["recording"] = manifest.name
        file.attrs[RECORDED_AT[1]] = manifest.address or str(recorded)
        if not manifest.address:
            with suppress(ValueError):  # of another drive
                place = os.path.relpath(recorded, (folder or path.parent).resolve())
                file.attrs[RECORDED_AT[0]] = Path(place).as_posix()
        file.attrs["rig"] = manifest.rig.name
        file.attrs["phasors"] = "x(t) = Re{X exp(+j omega t)}; covariances of [all Re, all Im]; k = 1"
        write_provenance(file, evaluation, files)
        file.attrs["mounting"] = manifest.mounting
        if manifest.rig.administration is not None and manifest.rig.administration.laboratory is not None:
            file.attrs["laboratory"] = manifest.rig.administration.laboratory
        if manifest.simulated:
            file.attrs["simulated"] = True
        if manifest.date is not None:
            file.attrs["date"] = manifest.date.isoformat()
        if evidence := _evidence(evaluation):
            write_value(file, EVIDENCE, evidence)
        driven = file.create_group("excitation")
        for name in ("kind", "direction", "frequencies"):
            write_value(driven, name, getattr(manifest.excitation, name))
        if manifest.rig.sensor is not None:
            sensor = file.create_group("sensor")
            for name in SENSOR:
                write_value(sensor, name, getattr(manifest.rig.sensor, name))
        write_fields(file, evaluation)
        _write_first_images(file, evaluation.stereo)
        for name in ("sensitivity/budget", "element/budget"):
            if name in file:
                file[name].attrs["not_assessed"] = ", ".join(NOT_SHOWN)

    write_file(path, h5_content(fill))


def _write_first_images(file: Group, pairs: Sequence[StereoResult]) -> None:
    """Write the first left image of each pair, for exports of fields."""
    for pair in pairs:
        group = file.get(f"stereo/{pair.name}")
        if group is not None and pair.reference_image is not None:
            image, scale = reduced_image(np.asarray(pair.reference_image))
            group[FIRST_IMAGE] = image
            group[FIRST_IMAGE].attrs["pixels_per_px"] = scale


# Every tracked point of a stereo pair in every frame, as tables and VTK files.


POINT_COLUMNS = ("frame", "time_s", "point", *(f"{name}_m" for name in AXES))
POINT_COLUMNS += tuple(f"{before}{name}_m" for before in ("d", "u_d", "rest_", "u_rest_") for name in AXES)
"""Columns of the table: position in the first frame, displacement and its part that is not rigid, each with u."""


def save_points(folder: Path, stereo: StereoResult) -> list[str]:
    """Write the points of a pair into a folder and return the file names.

    points-NAME.csv, points-NAME/FRAME.vtp and points-NAME.pvd, which lists the frames with their times for ParaView.
    """
    if stereo.surface is None:
        return []
    name = f"points-{stereo.name}"
    names, steps = [f"{name}.csv", f"{name}.pvd"], list[tuple[float, str]]()
    (folder / name).mkdir()
    reference_m = next(iter(stereo.surface)).reference_m
    finite = np.asarray(np.isfinite(reference_m).all(axis=1))
    positions = reference_m[finite]

    def rows() -> Iterator[str]:
        """Yield the table frame by frame, and write the file of each frame."""
        yield ",".join(POINT_COLUMNS) + "\n"
        for number, vectors in _point_frames(stereo, finite):
            time_s = float(stereo.time_s[number])
            seen = np.asarray(np.isfinite(vectors["deviation_m"]).all(axis=1))
            names.append(f"{name}/{number:04d}.vtp")
            shown = {key: np.where(seen[:, None], values, 0.0) for key, values in vectors.items()}
            content = poly_data(positions, {**shown, "seen": seen.astype(np.uint8)}, vectors="displacement_m")
            write_file(folder / names[-1], content)
            steps.append((time_s, names[-1]))
            numbers = np.hstack([positions, *vectors.values()])
            for point in np.flatnonzero(seen).tolist():
                yield f"{number},{time_s!r},{point},{','.join(map(repr, numbers[point].tolist()))}\n"

    write_file(folder / names[0], rows())
    write_file(folder / names[1], collection(steps))
    return names


def _point_frames(stereo: StereoResult, finite: BoolArray) -> Iterator[tuple[int, dict[str, FloatArray]]]:
    """Yield every frame with a motion, and its vectors (N, 3) in sensor axes.

    Displacement and deviation from the rigid body, each with u:
    x' − x = R·(x − o) + o + t + R·e − x with the deviation e about each point's mean over time. The covariance is that
    of the rotated e, R·V·Rᵀ, plus J·P·Jᵀ of the pose, J = [I, −[R·(x − o)]×]. Common errors of all points, such as
    those of the calibration, are not included. Points without a reference position are excluded.
    """
    motion = stereo.motion
    each = ((part, row) for part in stereo.surface or () for row in range(len(part.residual_m)))
    for number, (part, row) in enumerate(each):
        if not np.isfinite(motion.pose[number]).all():
            continue
        arm = part.reference_m[finite] - motion.origin_m
        turn = rotation_from_vector(motion.pose[number, 3:])
        rest = part.residual_m[row, finite] @ turn.T
        local = turn @ part.covariance_m2[row, finite] @ turn.T
        rotated = arm @ turn.T
        jacobian = displacement_jacobian(rotated) @ np.linalg.inv(pose_rate(motion.pose[number]))
        whole = local + jacobian @ motion.covariance[number] @ jacobian.swapaxes(1, 2)
        u_moved, u_rest = (np.sqrt(np.maximum(v.diagonal(axis1=1, axis2=2), 0.0)) for v in (whole, local))
        moved = rotated - arm + motion.pose[number, :3] + rest
        yield (
            number,
            {"displacement_m": moved, "u_displacement_m": u_moved, "deviation_m": rest, "u_deviation_m": u_rest},
        )
