"""A compensation filter as JSON and C, and its result folder."""

from __future__ import annotations

import json
import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from operator import itemgetter
from pathlib import Path
from typing import Any

import h5py
import numpy as np

from fusion.base import InputError
from fusion.report.folder import Command
from fusion.report.h5 import write_value
from fusion.report.provenance import hash_files
from fusion.report.table import Column, columns_of, csv_text
from fusion.sensor.compensate.evaluate import (
    CompensateEvaluation,
    evaluate_compensation,
    read_outputs,
    with_load,
)
from fusion.sensor.compensate.figures import frequencies, label
from fusion.sensor.compensate.report import NumberRow, page_context, printed, quantity_rows
from fusion.sensor.compensate.source import (
    COMMAND,
    CompensatedRecording,
    LoadFilter,
    Sources,
    SubjectResult,
    Wish,
    read_sources,
    stated,
)
from shaker.compensation.effects import gain_band
from shaker.compensation.filter import Sections, SensorDynamics, single_mode

FORMAT = 1
JSON_FILE, HEADER_FILE = "compensation.json", "compensation.h"
CONVENTIONS = (
    "y = gain * product of sections; a section is (b0 + b1/z + b2/z^2)/(1 + a1/z + a2/z^2), sos rows b0 b1 b2 1 a1 a2, "
    "each of static gain 1; continuous: gain * product (s - zero)/(s - pole), rad/s; numbers are exact doubles"
)


@dataclass(frozen=True)
class StoredFilter:
    """A filter read back from compensation.json: for a channel and a load in kg, None where it is not modelled."""

    channel: str
    component: str
    load_mass: float | None
    sections: Sections


def json_text(evaluation: CompensateEvaluation) -> str:
    """Return the content of compensation.json."""
    content = {
        "format": FORMAT,
        "name": evaluation.name,
        "program": evaluation.versions.get("shakercal", ""),
        "conventions": CONVENTIONS,
        "filters": [_entry(result, found) for result in evaluation.subjects for found in result.filters],
    }
    return json.dumps(content, indent=2, ensure_ascii=False, allow_nan=False) + "\n"


def read_compensation_filters(path: str | Path) -> tuple[StoredFilter, ...]:
    """Read compensation.json, or the one in a folder, to the last bit; `InputError` names what cannot be read.

    >>> from fusion import read_compensation_filters
    >>> filters = read_compensation_filters("my-steps/step/compensate")  # doctest: +SKIP
    """
    file = Path(path) / JSON_FILE if Path(path).is_dir() else Path(path)
    try:
        content = json.loads(file.read_text(encoding="utf-8"))
        if content["format"] != FORMAT:
            found = f"format {content['format']}"
            raise InputError(file, "format", found=found, expected=f"format {FORMAT}; compensate writes it anew")
        return tuple(_stored(item) for item in content["filters"])
    except OSError as error:
        raise InputError(file, "", found=error.strerror or str(error), expected="a file that can be read") from error
    except (KeyError, TypeError, ValueError) as error:
        found = f"no key {error}" if isinstance(error, KeyError) else str(error)
        raise InputError(file, "", found=found, expected="filters as shakercal compensate writes them") from error


def header_text(evaluation: CompensateEvaluation) -> str:
    """Return the C header: tables of all filters, and start, step and switch as the program runs them."""
    most = max(len(result.filters[0].sections.sos) for result in evaluation.subjects)
    tables = "\n".join(line for result in evaluation.subjects for line in _table(result))
    program = f"shakercal {evaluation.versions.get('shakercal', '')}".strip()
    return HEADER.replace("@PROGRAM@", program).replace("@MOST@", str(most)).replace("@TABLES@", tables)


def identifier(result: SubjectResult) -> str:
    """Return the name of a channel's table in C."""
    return "compensate_" + re.sub(r"\W", "_", result.subject.name.replace(" for ", "_"), flags=re.ASCII)


def _entry(result: SubjectResult, found: LoadFilter) -> dict[str, Any]:
    """One filter as nested dictionaries."""
    design, sections = found.compensation, found.sections
    u = [None if np.isnan(one) else float(one) for one in design.sensor.u]
    system = design.system
    return {
        "channel": result.subject.channel,
        "component": result.subject.component,
        "input_unit": result.subject.unit,
        "output_unit": result.output_unit,
        "load_mass_kg": found.load_mass,
        "sensor": {
            "frequency_hz": design.sensor.frequency_hz.tolist(),
            "damping_ratio": design.sensor.damping_ratio.tolist(),
            "real_hz": design.sensor.real_hz.tolist(),
            "static_gain": design.sensor.static_gain,
            "u": u,
        },
        "target": {
            "frequency_hz": design.target.frequency_hz,
            "damping_ratio": design.target.damping_ratio,
            "real_hz": design.target.real_hz,
            "low_pass_hz": design.target.low_pass_hz,
        },
        "continuous": {
            "zeros": [[zero.real, zero.imag] for zero in system.zeros.tolist()],
            "poles": [[pole.real, pole.imag] for pole in system.poles.tolist()],
            "gain": system.gain,
        },
        "sample_rate_hz": sections.sample_rate_hz,
        "gain": sections.gain,
        "sos": sections.sos.tolist(),
        "white_noise_gain": found.noise_gain,
        "discretisation_error": found.discretisation_error,
    }


def _stored(item: dict[str, Any]) -> StoredFilter:
    """One filter from its dictionary."""
    sos = np.array(item["sos"], dtype=np.float64)
    sections = Sections(sos, float(item["gain"]), float(item["sample_rate_hz"]))
    mass = item["load_mass_kg"]
    return StoredFilter(str(item["channel"]), str(item["component"]), None if mass is None else float(mass), sections)


def _table(result: SubjectResult) -> Iterator[str]:
    """The coefficients of a channel, load by load."""
    name, first = identifier(result), result.filters[0].sections
    loads, count = len(result.filters), len(first.sos)
    yield f"/* {_comment(result)} */"
    rows = [row for one in result.filters for row in one.sections.sos.tolist()]
    yield from _array(f"{name}_sos", [value for row in rows for value in (*row[:3], *row[4:])], 5)
    yield from _array(f"{name}_gain", [one.sections.gain for one in result.filters], 1)
    yield from _array(f"{name}_load_mass", [one.load_mass or 0.0 for one in result.filters], 1)
    rate = first.sample_rate_hz.hex()
    yield f"static const shakercal_table {name} = {{{count}, {loads}, {rate},"
    yield f"    {name}_load_mass, {name}_gain, {name}_sos}};"
    yield ""


def _comment(result: SubjectResult) -> str:
    """What a table is of, without what would end a comment."""
    rate = result.filters[0].sections.sample_rate_hz
    target = result.filters[0].compensation.target
    text = (
        f"{result.subject.name}: {result.subject.unit} to {result.output_unit}, {rate:.12g} Hz, to "
        f"{target.frequency_hz:.6g} Hz, damping ratio {target.damping_ratio:.4g}"
    )
    return text.replace("*/", "* /")


def _array(name: str, values: Sequence[float], per_line: int) -> Iterator[str]:
    """An array of doubles, each to the last bit, with its decimal form beside it."""
    yield f"static const double {name}[{len(values)}] = {{"
    for start in range(0, len(values), per_line):
        part = values[start : start + per_line]
        told = ", ".join(f"{value:.6g}" for value in part)
        yield f"    {', '.join(value.hex() for value in part)}, /* {told} */"
    yield "};"


HEADER = """\
/* Compensation filters, written by @PROGRAM@. C99; numbers are exact doubles.
 *
 *     shakercal_filter filter;
 *     shakercal_start(&filter, &compensate_Fz, 0, first_sample);
 *     for (;;) out = shakercal_step(&filter, in);
 *     shakercal_switch(&filter, 2);    load number 2 of the table, from the next sample on, without a jump
 *
 * With -ffp-contract=off the output has the bits of the program's own. Samples must be finite.
 */
#ifndef SHAKERCAL_COMPENSATION_H
#define SHAKERCAL_COMPENSATION_H

#define SHAKERCAL_MOST_SECTIONS @MOST@

typedef struct {
    int sections, loads;
    double sample_rate_hz;
    const double *load_mass, *gain, *sos; /* kg; out of the last section; b0 b1 b2 a1 a2 by load and section */
} shakercal_table;

typedef struct {
    const shakercal_table *table;
    int load;
    double past[SHAKERCAL_MOST_SECTIONS + 1][2]; /* the last two values before and after every section, older first */
    double state[SHAKERCAL_MOST_SECTIONS][2];
} shakercal_filter;

static inline const double *shakercal_section(const shakercal_filter *filter, int section)
{
    return filter->table->sos + 5 * (filter->load * filter->table->sections + section);
}

/* Use the coefficients of another load from the next sample on. */
static inline void shakercal_switch(shakercal_filter *filter, int load)
{
    filter->load = load;
    for (int s = 0; s < filter->table->sections; s++) {
        const double *c = shakercal_section(filter, s), *x = filter->past[s], *y = filter->past[s + 1];
        filter->state[s][1] = c[2] * x[1] - c[4] * y[1];
        filter->state[s][0] = c[1] * x[1] - c[3] * y[1] + c[2] * x[0] - c[4] * y[0];
    }
}

/* Start as if the input had been at one level for ever. */
static inline void shakercal_start(shakercal_filter *filter, const shakercal_table *table, int load, double level)
{
    filter->table = table;
    filter->load = load;
    filter->past[0][0] = filter->past[0][1] = level;
    for (int s = 0; s < table->sections; s++) {
        const double *c = shakercal_section(filter, s);
        filter->past[s + 1][0] = filter->past[s][0] * ((c[0] + c[1] + c[2]) / (1.0 + c[3] + c[4]));
        filter->past[s + 1][1] = filter->past[s + 1][0];
    }
    shakercal_switch(filter, load);
}

/* One sample in, one sample out. */
static inline double shakercal_step(shakercal_filter *filter, double value)
{
    filter->past[0][0] = filter->past[0][1];
    filter->past[0][1] = value;
    for (int s = 0; s < filter->table->sections; s++) {
        const double *c = shakercal_section(filter, s);
        double *z = filter->state[s], out = c[0] * value + z[0];
        z[0] = c[1] * value - c[3] * out + z[1];
        z[1] = c[2] * value - c[4] * out;
        value = out;
        filter->past[s + 1][0] = filter->past[s + 1][1];
        filter->past[s + 1][1] = value;
    }
    return filter->table->gain[filter->load] * value;
}

@TABLES@
#endif
"""


EXPANDED = 2.0


def _fill(file: h5py.File, evaluation: CompensateEvaluation) -> None:
    """Fill the HDF5 file."""
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


def _sources(models: Sequence[Path], sensor: tuple[float | None, float | None]) -> Sources:
    """Models from files, or the stated sensor; one of the two."""
    frequency, damping = sensor
    if models:
        if frequency is not None or damping is not None:
            expected = "either models or --sensor-frequency with --sensor-damping"
            raise InputError(COMMAND, "", found="both", expected=expected)
        return read_sources(models)
    if frequency is None or damping is None:
        expected = "models.json, load.json, a folder with one, or --sensor-frequency with --sensor-damping"
        raise InputError(COMMAND, "", found="nothing of it", expected=expected)
    return stated(_single(frequency, damping))


def _check_loads(sources: Sources, wish: Wish) -> None:
    """Refuse loads where no model follows the load."""
    if wish.load_masses and not any(subject.is_scheduled for subject in sources.subjects):
        found = ", ".join(f"{mass:g} kg" for mass in wish.load_masses)
        raise InputError(COMMAND, "--load-mass", found=found, expected="a model over the load (load.json) for it")


def _single(frequency: float, damping: float) -> SensorDynamics:
    """The stated sensor."""
    if not damping < 1.0:
        expected = "a damping ratio below 1, of a sensor that oscillates"
        raise InputError(COMMAND, "--sensor-damping", found=f"{damping:g}", expected=expected)
    return single_mode(frequency, damping)


def _texts(evaluation: CompensateEvaluation) -> dict[str, str | bytes]:
    """Filters, numbers, and the filtered recording with U (k = 2) of every sample."""
    texts: dict[str, str | bytes] = {
        JSON_FILE: json_text(evaluation),
        HEADER_FILE: header_text(evaluation),
        "compensate.csv": csv_text(columns_of(NumberRow), quantity_rows(evaluation)),
    }
    applied = evaluation.applied
    if applied is not None:
        names = ["time_s", *(name for one in applied.channels for name in (one.channel, f"U_{one.channel}"))]
        samples = [applied.time_s, *(part for one in applied.channels for part in (one.value, EXPANDED * one.u))]
        columns: list[Column[list[float]]] = [Column(name, itemgetter(place)) for place, name in enumerate(names)]
        texts["compensated.csv"] = csv_text(columns, np.stack(samples, axis=1).tolist())
    return texts


FILES = (JSON_FILE, HEADER_FILE, "compensate.csv", "compensated.csv")
COMPENSATE = Command("compensate", "compensate", FILES, _texts, _fill, page_context, printed)


def run_compensate(
    models: Sequence[Path],
    sensor: tuple[float | None, float | None],
    wish: Wish,
    output: Path | None,
    *,
    recording: Path | None = None,
    force: bool = False,
    allow_outside: bool = False,
) -> None:
    """Make the filters of some models or of a stated `sensor` (Hz, damping ratio), write them and print the summary.

    Results stand in folder `compensate` beside the first model, or in the working folder, or in `output`.
    """
    sources = _sources(models, sensor)
    record = None if recording is None else read_outputs(recording, allow_outside=allow_outside)
    beside = sources.files[0].parent if sources.files else Path.cwd()
    _check_loads(sources, wish)

    def evaluate(hashes: dict[str, str]) -> CompensateEvaluation:
        return evaluate_compensation(sources, with_load(wish, sources, record), record, hashes)

    files = [*sources.files, *(() if record is None else record.manifest.files)]
    folder = beside / COMPENSATE.name if output is None else output
    COMPENSATE.run(hash_files(files, beside), folder, evaluate, force=force)
