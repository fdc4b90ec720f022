"""Page and result folder of a recording, and the result folder of any finished evaluation."""

from __future__ import annotations

import re
from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import Any

import h5py

from fusion.base import InputError
from fusion.recording.load import Manifest
from fusion.report import tables
from fusion.report.csv_files import MERGED_FILES, result_tables
from fusion.report.figures import acceleration_pictures, draw_budget, sensitivity_pictures
from fusion.report.folder import origin_frame, render_page, write_folder
from fusion.report.h5 import write_fields, write_value
from fusion.report.more_tables import (
    budget_tables,
    channels_table,
    clocks_table,
    consistency_tables,
    drift_table,
    lines_table,
    monte_carlo_tables,
    other_loads_table,
    point_tables,
)
from fusion.report.motion_figures import motion_pictures, subset_pictures
from fusion.report.numbers import measured
from fusion.report.provenance import (
    RESULT_FILE,
    RESULT_FORMAT,
    Provenance,
    check_folder,
    read_provenance,
    write_provenance,
)
from fusion.report.signal_figures import channel_pictures, point_pictures, trigger_pictures
from fusion.report.style import Picture
from fusion.report.tables import takes_table
from fusion.sensitivity.analyse import Evaluation

# Which figures the report of one recording holds.


def draw_all(evaluation: Evaluation) -> dict[str, list[Picture]]:
    """All figures of a recording, by the section of the report that shows them."""
    return {
        "sensitivity": sensitivity_pictures(evaluation),
        "acceleration": acceleration_pictures(evaluation),
        "points": point_pictures(evaluation),
        "budget": [picture for picture in [draw_budget(evaluation)] if picture],
        "motion": [picture for stereo in evaluation.stereo for picture in motion_pictures(stereo)],
        "subsets": subset_pictures(evaluation),
        "channels": channel_pictures(evaluation),
        "trigger": trigger_pictures(evaluation),
    }


# report.html: one self-contained page with results, figures and origin of one recording.


REPORT_FILE = "report.html"


def render_report(evaluation: Evaluation) -> str:
    """HTML text of the report; style and figures are inside, nothing is fetched from elsewhere."""
    return render_page("report.html", _context(evaluation))


def _context(evaluation: Evaluation) -> dict[str, Any]:
    """Everything the template shows."""
    return {
        "name": evaluation.manifest.name,
        "subject": _subject(evaluation),
        "headlines": tables.headlines(evaluation),
        "pictures": draw_all(evaluation),
        "sensitivity": tables.sensitivity_table(evaluation),
        "sources": tables.source_tables(evaluation),
        "load": tables.load_table(evaluation),
        "points": point_tables(evaluation),
        "consistency": consistency_tables(evaluation),
        "others": other_loads_table(evaluation),
        "budgets": budget_tables(evaluation),
        "monte_carlo": monte_carlo_tables(evaluation),
        "stereo": tables.stereo_table(evaluation.stereo),
        "lines": lines_table(evaluation),
        "channels": channels_table(evaluation),
        "drift": drift_table(evaluation),
        "takes": takes_table(evaluation),
        "clocks": clocks_table(evaluation),
        **origin_frame(evaluation, evaluation.notices),
        "duration_s": evaluation.duration_s,
    }


def _subject(evaluation: Evaluation) -> list[tuple[str, str]]:
    """What was measured: rig, sensor, load mass, excitation, surroundings."""
    rig, excitation = evaluation.manifest.rig, evaluation.manifest.excitation
    facts = [("Rig", rig.name)]
    if rig.sensor is not None:
        serial = f", serial number {rig.sensor.serial}" if rig.sensor.serial else ""
        facts.append(("Sensor", f"{rig.sensor.name}{serial}"))
    if rig.load is not None:
        mass = measured(rig.load.mass, 2.0 * rig.load.mass_uncertainty, "kg").striptags()
        facts.append(("Load mass", f"{mass}, k = 2"))
    nominal = ", ".join(f"{frequency:g} Hz" for frequency in excitation.frequencies or ())
    direction = ", ".join(f"{element:g}" for element in excitation.direction or ())
    told = [excitation.kind, nominal, f"direction ({direction})" if direction else ""]
    facts.append(("Excitation", ", ".join(filter(None, told))))
    if rig.environment is not None and rig.environment.temperature is not None:
        facts.append(("Temperature", f"{rig.environment.temperature:g} °C"))
    return facts


# The results folder: tables, HDF5 file and report, whole or not at all.


CURVE_FILE, CROSSTALK_FILE, CAMPAIGN_FILE = "curve.csv", "crosstalk.csv", "campaign.h5"
CAMPAIGN_FILES = (*MERGED_FILES, CURVE_FILE, CROSSTALK_FILE, REPORT_FILE, CAMPAIGN_FILE)
"""Files at the top of a campaign's results."""
OWN_FILE = re.compile(r"(sensitivity|acceleration|load|motion-.+)\.csv|result\.h5|report\.html")


def write_results(evaluation: Evaluation, folder: Path, *, force: bool = False) -> list[Path]:
    """Write every result file of one recording and return their paths, as `write_folder` does."""
    fill = partial(_fill, evaluation=evaluation)
    return write_folder(folder, evaluation.input_hashes, fill, force=force, marker=RESULT_FILE, own=OWN_FILE)


def check_campaign_folder(top: Path, recordings: Sequence[str], *, force: bool) -> None:
    """Refuse a place for a campaign's results that holds something else, or joint files without their recordings.

    `recordings`: names of the recordings' folders, each of which is checked when its turn comes. Hidden files are
    none of the program's business.
    """
    check_folder(top, {}, force=True)
    names = {entry.name for entry in top.iterdir()} if top.exists() and not force else set()
    ours = {name for name in names if name in recordings or read_provenance(top / name) is not None}
    other = {name for name in names - ours if not name.startswith(".") and not (ours and name in CAMPAIGN_FILES)}
    if other:
        expected = "results of this campaign only (--force writes beside them and replaces only result files)"
        raise InputError(top, "", found=f"other files, for example {min(other)}", expected=expected)


def _fill(folder: Path, evaluation: Evaluation) -> list[str]:
    """Make all files in a folder; the HDF5 file, which says that the folder is complete, comes last."""
    tables = result_tables(evaluation)
    for name, text in tables.items():
        (folder / name).write_text(text, encoding="utf-8", newline="\n")
    (folder / REPORT_FILE).write_text(render_report(evaluation), encoding="utf-8", newline="\n")
    names = [*tables, REPORT_FILE, RESULT_FILE]
    write_h5(folder / RESULT_FILE, evaluation, names)
    return names


# What every command does with a finished evaluation: tell its notices, put its origin on a page, write a folder.


SENSOR_FIELDS = (
    "name",
    "serial",
    "channels",
    "unit",
    "sense",
    "capacity",
    "static_sensitivity",
    "static_sensitivity_uncertainty",
)


def write_h5(path: Path, evaluation: Evaluation, files: Sequence[str]) -> None:
    """Write the evaluation and its provenance to a new HDF5 file; `files` are the names of all result files."""
    origin = Provenance(evaluation.input_hashes, evaluation.settings, evaluation.versions, tuple(files))
    with h5py.File(path, "w", track_order=True) as file:
        file.attrs["format"] = RESULT_FORMAT
        file.attrs["recording"] = evaluation.manifest.name
        file.attrs["rig"] = evaluation.manifest.rig.name
        file.attrs["phasors"] = "x(t) = Re{X exp(+j omega t)}; covariances of [all Re, all Im]; k = 1"
        write_provenance(file, origin)
        _write_subject(file, evaluation.manifest)
        write_fields(file, evaluation)


def _write_subject(file: h5py.File, manifest: Manifest) -> None:
    """Write what was driven, how it was mounted, and which sensor was tested: what a campaign has to know."""
    file.attrs["mounting"] = manifest.mounting
    driven = file.create_group("excitation")
    for name in ("kind", "direction", "frequencies"):
        write_value(driven, name, getattr(manifest.excitation, name))
    if manifest.rig.sensor is not None:
        sensor = file.create_group("sensor")
        for name in SENSOR_FIELDS:
            write_value(sensor, name, getattr(manifest.rig.sensor, name))
