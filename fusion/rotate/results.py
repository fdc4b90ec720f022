"""The folder of a rotation test's results: table, HDF5 file and page, whole or not at all."""

from __future__ import annotations

import re
from functools import partial
from pathlib import Path

import h5py

from fusion.provenance import Provenance, write_provenance
from fusion.results import write_folder
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
    fill = partial(_fill, evaluation=evaluation)
    return write_folder(folder, evaluation.input_hashes, fill, force=force, marker=H5_FILE, own=OWN_FILE)


def _fill(folder: Path, evaluation: RotationEvaluation) -> list[str]:
    """Make all files in a folder; the HDF5 file, which says that the folder is complete, comes last."""
    texts = {
        TABLE_FILE: csv_text(COLUMNS, quantity_rows(evaluation)),
        PAGE_FILE: render_rotation_page(evaluation),
    }
    for name, text in texts.items():
        (folder / name).write_text(text, encoding="utf-8", newline="\n")
    names = [*texts, H5_FILE]
    origin = Provenance(evaluation.input_hashes, evaluation.settings, evaluation.versions, tuple(names))
    with h5py.File(folder / H5_FILE, "w", track_order=True) as file:
        file.attrs["format"] = FORMAT
        file.attrs["name"] = evaluation.name
        file.attrs["harmonics"] = "reading = design . coefficient; A exp(+j angle), A = cos - j sin; k = 1"
        write_provenance(file, origin)
        for key in ("gravity", "air"):
            known = getattr(evaluation, key)
            write_value(file.create_group(key), "value", known.value)
            write_value(file[key], "u", known.u)
            write_value(file[key], "source", known.source)
        _write_recordings(file.create_group("recordings", track_order=True), evaluation)
        _write_weights(file.create_group("weights", track_order=True), evaluation)
        _write_quantities(file.create_group("quantities", track_order=True), evaluation)
    return names


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


def _write_quantities(group: h5py.Group, evaluation: RotationEvaluation) -> None:
    """Every number with its budget."""
    for quantity in evaluation.quantities:
        name = " ".join(filter(None, (quantity.name, quantity.component, quantity.recording)))
        own = group.create_group(name)
        for key in ("value", "u", "dof", "unit"):
            own.attrs[key] = getattr(quantity, key)
        own.create_group("budget").attrs.update(quantity.budget)
