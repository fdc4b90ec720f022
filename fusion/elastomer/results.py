"""The folder of an element's models: tables, pictures, HDF5 file and page, whole or not at all."""

from __future__ import annotations

import re
from pathlib import Path

import h5py

from fusion.elastomer import tables
from fusion.elastomer.page import PAGE_FILE, render_element_page, shape_pictures
from fusion.elastomer.result import ElementEvaluation
from fusion.evaluated import ResultFolder
from fusion.results_csv import csv_text
from fusion.results_h5 import write_fields, write_value

FORMAT = 1
H5_FILE = "elastomer.h5"
OWN_FILE = re.compile(
    r"(modes|stiffness|comparison|statics|platform)\.csv|shapes-(frame|solid)\.png|elastomer\.(h5|html)"
)


def write_element(evaluation: ElementEvaluation, folder: Path, *, force: bool = False) -> list[Path]:
    """Write every result file and return their paths; other folders are refused unless `force`."""
    return ResultFolder(H5_FILE, OWN_FILE, _texts, _fill).write(evaluation, folder, force=force)


def _texts(evaluation: ElementEvaluation) -> dict[str, str | bytes]:
    """Tables, pictures and page."""
    shapes = shape_pictures(evaluation)
    found: dict[str, str | bytes] = {
        "comparison.csv": csv_text(tables.COMPARISON, tables.comparison_rows(evaluation)),
        "modes.csv": csv_text(tables.MODES, tables.mode_rows(evaluation)),
        "stiffness.csv": csv_text(tables.STIFFNESS, tables.stiffness_rows(evaluation)),
        "statics.csv": csv_text(tables.STATICS, tables.statics_rows(evaluation)),
    }
    if evaluation.fits:
        found["platform.csv"] = csv_text(tables.PLATFORM, tables.platform_rows(evaluation))
    found.update({name: png for name, (_, png) in shapes.items()})
    found[PAGE_FILE] = render_element_page(evaluation, [picture for picture, _ in shapes.values()])
    return found


def _fill(file: h5py.File, evaluation: ElementEvaluation) -> None:
    """Fill the HDF5 file."""
    file.attrs["format"] = FORMAT
    file.attrs["name"] = evaluation.name
    file.attrs["shapes"] = "unknowns ux uy uz rx ry rz of the platform's point in the plane of the beams, then of nodes"
    definition = evaluation.definition
    write_value(file, "beams", definition.beams)
    write_value(file, "platform", definition.platform)
    _write_frame(file.create_group("frame", track_order=True), evaluation)
    if evaluation.solid is not None:
        group = file.create_group("solid", track_order=True)
        for refinement, model in zip(evaluation.solid.refinements, evaluation.solid.meshes, strict=True):
            write_fields(group.create_group(f"mesh_{refinement}", track_order=True), model)
        write_fields(group.create_group("rigid_platform", track_order=True), evaluation.solid.rigid)
    columns = file.create_group("comparison", track_order=True)
    for column in evaluation.columns:
        write_fields(columns.create_group(column.name, track_order=True), column)
    write_value(file, "sensitivity", evaluation.sensitivity)
    for fit in evaluation.fits:
        own = file.require_group("fits").create_group(f"half_size_{fit.half_size_m:g}", track_order=True)
        write_value(own, "platform", fit.platform)
        write_value(own, "frequency_hz", fit.frequency_hz)
        own.attrs["largest_misfit"] = fit.misfit
    write_value(file, "mounted", evaluation.mounted)


def _write_frame(group: h5py.Group, evaluation: ElementEvaluation) -> None:
    """Nodes, beams and modes of the frame."""
    model = evaluation.frame
    for name in ("node_m", "beam", "rigid", "clamped"):
        write_value(group, name, getattr(model.frame, name))
    write_value(group, "modes", model.modes)
    write_value(group, "stiffness", model.stiffness)
    write_value(group, "node_motion", model.frame.reduction @ model.modes.shape)
