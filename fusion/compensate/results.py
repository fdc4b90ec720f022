"""The folder of a compensation: filters as JSON and C, table, HDF5 file and page, whole or not at all."""

from __future__ import annotations

import re
from collections.abc import Iterator
from pathlib import Path

import h5py
import numpy as np

from fusion.compensate.evaluation import CompensateEvaluation
from fusion.compensate.export import HEADER_FILE, JSON_FILE, header_text, json_text
from fusion.compensate.page import PAGE_FILE, frequencies, render_compensate_page
from fusion.compensate.result import CompensatedRecording, LoadFilter
from fusion.compensate.tables import COLUMNS, label, quantity_rows
from fusion.evaluated import ResultFolder
from fusion.results_csv import Row, csv_text
from fusion.results_h5 import write_value
from shaker.models.compensation.uncertainty import gain_band

FORMAT = 1
TABLE_FILE, H5_FILE, SIGNAL_FILE = "compensate.csv", "compensate.h5", "compensated.csv"
OWN_FILE = re.compile(r"compensate\.(csv|h5|html)|compensation\.(json|h)|compensated\.csv")
EXPANDED = 2.0


def write_compensation(evaluation: CompensateEvaluation, folder: Path, *, force: bool = False) -> list[Path]:
    """Write every result file and return their paths; other folders are refused unless `force`."""
    return ResultFolder(H5_FILE, OWN_FILE, _texts, _fill).write(evaluation, folder, force=force)


def _texts(evaluation: CompensateEvaluation) -> dict[str, str]:
    """Filters, table, page, and the filtered recording."""
    texts = {
        JSON_FILE: json_text(evaluation),
        HEADER_FILE: header_text(evaluation),
        TABLE_FILE: csv_text(COLUMNS, quantity_rows(evaluation)),
        PAGE_FILE: render_compensate_page(evaluation),
    }
    if evaluation.applied is not None:
        columns = [name for one in evaluation.applied.channels for name in (one.channel, f"U_{one.channel}")]
        texts[SIGNAL_FILE] = csv_text(["time_s", *columns], _signal_rows(evaluation.applied))
    return texts


def _signal_rows(applied: CompensatedRecording) -> Iterator[Row]:
    """One row per sample: time, then value and U (k = 2) of every channel."""
    columns = [applied.time_s, *(part for one in applied.channels for part in (one.value, EXPANDED * one.u))]
    yield from np.stack(columns, axis=1).tolist()


def _fill(file: h5py.File, evaluation: CompensateEvaluation) -> None:
    """Fill the HDF5 file."""
    file.attrs["format"] = FORMAT
    file.attrs["name"] = evaluation.name
    filters = file.create_group("filters", track_order=True)
    for result in evaluation.subjects:
        for found in result.filters:
            group = filters.create_group(label(result, found))
            group.attrs["channel"], group.attrs["component"] = result.subject.channel, result.subject.component
            group.attrs["input_unit"], group.attrs["output_unit"] = result.subject.unit, result.output_unit
            _write_filter(group, found)
    if evaluation.applied is not None:
        _write_signals(file.create_group("compensated", track_order=True), evaluation.applied)


def _write_filter(group: h5py.Group, found: LoadFilter) -> None:
    """Coefficients, the sensor's parameters with covariance, and curves over frequency."""
    design, hertz = found.compensation, frequencies(found)
    for name in ("load_mass", "noise_gain", "noise", "band_hz", "discretisation_error", "after_s"):
        value = getattr(found, name)
        if value is not None:
            group.attrs[name] = value
    for name in ("off_frequency", "off_ringing", "off_load", "load_ringing"):
        write_value(group, name, getattr(found, name))
    write_value(group, "sos", found.sections.sos)
    group.attrs["gain"], group.attrs["sample_rate_hz"] = found.sections.gain, found.sections.sample_rate_hz
    write_value(group, "sensor", design.sensor.vector)
    if design.sensor.covariance is not None:
        write_value(group, "covariance", design.sensor.covariance)
        band = gain_band(design, hertz)
        write_value(group, "u_gain", band.u_gain)
        write_value(group, "u_phase_rad", band.u_phase_rad)
    write_value(group, "frequency_hz", hertz)
    write_value(group, "before", design.sensor.system.response(hertz))
    write_value(group, "filter", design.system.response(hertz))
    write_value(group, "filter_for_samples", found.sections.response(hertz))


def _write_signals(group: h5py.Group, applied: CompensatedRecording) -> None:
    """The filtered channels with their standard uncertainty."""
    group.attrs["recording"] = applied.name
    group.attrs["sample_rate_hz"], group.attrs["start_s"] = applied.sample_rate_hz, applied.start_s
    for one in applied.channels:
        own = group.create_group(one.channel)
        own.attrs["unit"], own.attrs["u_noise"] = one.unit, one.u_noise
        write_value(own, "value", one.value)
        write_value(own, "u", one.u)
