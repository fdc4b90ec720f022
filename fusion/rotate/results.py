"""The folder of a rotation test's results: table, HDF5 file and page, whole or not at all."""

from __future__ import annotations

import re
from pathlib import Path

import h5py

from fusion.evaluated import ResultFolder
from fusion.results_csv import csv_text
from fusion.results_h5 import write_fields, write_value
from fusion.rotate.page import PAGE_FILE, render_rotation_page
from fusion.rotate.result import RotationEvaluation
from fusion.rotate.tables import COLUMNS, quantity_rows

FORMAT = 1
TABLE_FILE, H5_FILE = "rotation.csv", "rotation.h5"
OWN_FILE = re.compile(r"rotation\.(csv|h5|html)")


def write_rotation(evaluation: RotationEvaluation, folder: Path, *, force: bool = False) -> list[Path]:
    """Write every result file and return their paths; other folders are refused unless `force`."""
    return ResultFolder(H5_FILE, OWN_FILE, _texts, _fill).write(evaluation, folder, force=force)


def _texts(evaluation: RotationEvaluation) -> dict[str, str]:
    """Table and page."""
    return {
        TABLE_FILE: csv_text(COLUMNS, quantity_rows(evaluation)),
        PAGE_FILE: render_rotation_page(evaluation),
    }


def _fill(file: h5py.File, evaluation: RotationEvaluation) -> None:
    """Fill the HDF5 file."""
    file.attrs["format"] = FORMAT
    file.attrs["name"] = evaluation.name
    file.attrs["harmonics"] = "reading = design . coefficient; A exp(+j angle), A = cos - j sin; k = 1"
    for key in ("gravity", "air"):
        known = getattr(evaluation, key)
        write_value(file.create_group(key), "value", known.value)
        write_value(file[key], "u", known.u)
        write_value(file[key], "source", known.source)
    _write_recordings(file.create_group("recordings", track_order=True), evaluation)
    _write_weights(file.create_group("weights", track_order=True), evaluation)
    _write_repeats(file, evaluation)
    _write_quantities(file.create_group("quantities", track_order=True), evaluation)


def _write_recordings(group: h5py.Group, evaluation: RotationEvaluation) -> None:
    """Readings, loads and the fit of every recording."""
    for recording in evaluation.recordings:
        own = group.create_group(recording.name, track_order=True)
        own.attrs["with_load"] = recording.with_load
        write_value(own, "unit", recording.unit)
        write_value(own, "load", recording.load)
        write_fields(own, recording.fit)


def _write_weights(group: h5py.Group, evaluation: RotationEvaluation) -> None:
    """Value and covariance of the fit of weights, and each cause of error with its effect."""
    weights = evaluation.weights
    for name in ("names", "value", "covariance", "load"):
        write_value(group, name, getattr(weights, name))
    for name in ("chi_squared", "dof", "departure"):
        group.attrs[name] = getattr(weights, name)
    sources = group.create_group("sources", track_order=True)
    for source in weights.sources:
        own = sources.create_group(source.name)
        own.attrs["type"], own.attrs["dof"] = source.kind, source.dof
        own["effect"] = source.effect


def _write_repeats(file: h5py.File, evaluation: RotationEvaluation) -> None:
    """What states that were recorded repeatedly scatter by."""
    for again in evaluation.repeats:
        write_fields(file.require_group("repeats").create_group(again.state), again)


def _write_quantities(group: h5py.Group, evaluation: RotationEvaluation) -> None:
    """Every number with its budget."""
    for quantity in evaluation.quantities:
        name = " ".join(filter(None, (quantity.name, quantity.component, quantity.recording)))
        own = group.create_group(name)
        for key in ("value", "u", "dof", "unit"):
            own.attrs[key] = getattr(quantity, key)
        own.create_group("budget").attrs.update(quantity.budget)
