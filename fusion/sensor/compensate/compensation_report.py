"""Files, page and printed lines of compensation filters, and the command."""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from importlib.resources import files
from itertools import chain
from operator import itemgetter
from pathlib import Path
from typing import Any, NamedTuple

import h5py
import numpy as np
from markupsafe import Markup

from fusion.base import GRAM, MILLI, PERCENT
from fusion.estimation.coverage import coverage_factor
from fusion.report.folder import CommandReport, hash_files
from fusion.report.h5 import write_value
from fusion.report.table import (
    Headline,
    Table,
    TableColumn,
    capitalise,
    columns_of,
    csv_text,
    finite_or_none,
    page_column,
    table,
)
from fusion.sensor.compensate.compensation_evaluation import (
    HAND_DAMPING,
    HAND_STIFFNESS,
    HANDLE_MASS,
    PUSH_M,
    PUSH_S,
    CompensateEvaluation,
    HapticCase,
    add_recorded_load,
    evaluate_compensation,
    read_outputs,
)
from fusion.sensor.compensate.compensation_figures import (
    draw_bode,
    draw_channel,
    draw_force_feedback,
    draw_mismatch,
    draw_noise,
    draw_step,
    frequencies,
)
from fusion.sensor.compensate.compensation_subjects import (
    CompensationSettings,
    IndexEstimates,
    LoadFilter,
    SubjectResult,
    read_sources,
    stated_sensor,
    wrong_option,
)
from fusion.sensor.model_files import model_file_text, pairs, read_model_file
from shaker.compensation.effects import gain_band
from shaker.compensation.filter import Sections, band_ratio, best_damping
from shaker.lti.indices import LABELS, unit_of
from shakercal._common.digits import DASH, number_text, quantity_text, signed_text

JSON_FILE, HEADER_FILE = "compensation.json", "compensation.h"
HEADER = files("fusion.report").joinpath("templates", HEADER_FILE)
"""Template of the C header with functions to start, step and switch."""
CONVENTIONS = (
    "y = gain * product of sections; a section is (b0 + b1/z + b2/z^2)/(1 + a1/z + a2/z^2), sos rows b0 b1 b2 1 a1 a2, "
    "each of static gain 1; continuous: gain * product (s - zero)/(s - pole), rad/s; numbers are exact doubles"
)
SHOWN = (
    *("natural_hz", "damping_ratio", "peak_hz", "peak_gain", "band_5_hz", "band_10_hz", "half_power_hz"),
    *("overshoot", "rise_s", "settling_5_s", "settling_2_s"),
)
SCALE = {"s": (MILLI, "ms"), "Hz": (1.0, "Hz"), "": (1.0, "")}
PRINTED = {"band_10_hz": "±10 % band", "overshoot": "overshoot", "settling_2_s": "2 % settling"}
ERRORS = (0.01, 0.02, 0.05, 0.1, 0.2)
LOOP = (
    f"A hand ({HAND_STIFFNESS:g} N/m, {HAND_DAMPING:g} N·s/m) pushes a handle of {HANDLE_MASS:g} kg by "
    f"{MILLI * PUSH_M:g} mm in {PUSH_S:g} s against a virtual ball of {{:g}} N/m. The device "
    "pushes back with the force of the ball and K times its difference to the indicated force, one sample late. "
    "Tracking error: rms of applied less fed-back force over rms of the latter while the ball is touched."
)
"""Description of the force-feedback check, with the stiffness of the ball."""


# Filters as JSON and C.


@dataclass(frozen=True)
class StoredFilter:
    """A filter of a channel for a load in kg, None without a load model."""

    channel: str
    component: str
    load_mass: float | None
    sections: Sections


def json_text(evaluation: CompensateEvaluation) -> str:
    """Return the content of compensation.json."""
    content = {
        "name": evaluation.name,
        "program": evaluation.versions.get("shakercal", ""),
        "conventions": CONVENTIONS,
        "filters": [_entry(made) for made in evaluation.filters],
    }
    return model_file_text(content)


def read_compensation_filters(path: str | Path) -> tuple[StoredFilter, ...]:
    """Read the filters of compensation.json without loss of precision.

    Parameters
    ----------
    path
        The file, or a folder that contains it.

    Returns
    -------
    tuple of StoredFilter : one per channel and load.

    Raises
    ------
    InputError : the file is missing, or damaged at the named entry.

    Examples
    --------
    >>> from fusion import read_compensation_filters
    >>> filters = read_compensation_filters("my-steps/step/compensate")  # doctest: +SKIP
    """

    def stored(item: dict[str, Any]) -> StoredFilter:
        sos, mass = np.array(item["sos"], dtype=np.float64), item["load_mass_kg"]
        sections = Sections(sos, float(item["gain"]), float(item["sample_rate_hz"]))
        load_mass = None if mass is None else float(mass)
        return StoredFilter(str(item["channel"]), str(item["component"]), load_mass, sections)

    return read_model_file(
        Path(path), JSON_FILE, "compensate", lambda content: tuple(map(stored, content["filters"])), "filters"
    )


def _entry(made: LoadFilter) -> dict[str, Any]:
    """Return one filter as nested dictionaries."""
    design, sections, subject = made.compensation, made.sections, made.subject
    sensor, target, system = design.sensor, design.target, design.system
    return {
        "channel": subject.channel,
        "component": subject.component,
        "input_unit": subject.unit,
        "output_unit": made.output_unit,
        "load_mass_kg": made.load_mass,
        "sensor": {
            **{name: getattr(sensor, name).tolist() for name in ("frequency_hz", "damping_ratio", "real_hz")},
            "static_gain": sensor.static_gain,
            "u": [finite_or_none(u) for u in sensor.u],
        },
        "target": {name: getattr(target, name) for name in ("frequency_hz", "damping_ratio", "real_hz", "low_pass_hz")},
        "continuous": {"zeros": pairs(system.zeros), "poles": pairs(system.poles), "gain": system.gain},
        "sample_rate_hz": sections.sample_rate_hz,
        "gain": sections.gain,
        "sos": sections.sos.tolist(),
        "white_noise_gain": made.noise_gain,
        "discretisation_error": made.discretisation_error,
    }


def header_text(evaluation: CompensateEvaluation) -> str:
    """Return the C header with the tables of all filters and the functions."""
    longest = max(len(result.filters[0].sections.sos) for result in evaluation.subjects)
    tables = "\n".join(line for result in evaluation.subjects for line in _table(result))
    program = f"shakercal {evaluation.versions.get('shakercal', '')}".strip()
    template = HEADER.read_text(encoding="utf-8")
    return template.replace("@PROGRAM@", program).replace("@MOST@", str(longest)).replace("@TABLES@", tables)


def _table(result: SubjectResult) -> Iterator[str]:
    """Yield the coefficients of a channel, load by load."""
    first, subject, loads = result.filters[0], result.subject, result.filters
    name = "compensate_" + re.sub(r"\W", "_", subject.name.replace(" for ", "_"), flags=re.ASCII)
    count, rate, target = len(first.sections.sos), first.sections.sample_rate_hz, first.compensation.target
    comment = (
        f"{subject.name}: {subject.unit} to {first.output_unit}, {number_text(rate, 12)} Hz, to "
        f"{number_text(target.frequency_hz, 6)} Hz, damping ratio {number_text(target.damping_ratio, 4)}"
    )
    yield f"/* {comment.replace('*/', '* /')} */"  # without the end of a comment
    rows = [row for made in loads for row in made.sections.sos.tolist()]
    yield from _array(f"{name}_sos", [value for row in rows for value in (*row[:3], *row[4:])], 5)
    yield from _array(f"{name}_gain", [made.sections.gain for made in loads], 1)
    yield from _array(f"{name}_load_mass", [made.load_mass or 0.0 for made in loads], 1)
    yield f"static const shakercal_table {name} = {{{count}, {len(loads)}, {rate.hex()},"
    yield f"    {name}_load_mass, {name}_gain, {name}_sos}};"
    yield ""


def _array(name: str, values: Sequence[float], per_line: int) -> Iterator[str]:
    """Yield an array of exact doubles, with their decimal form as a comment."""
    yield f"static const double {name}[{len(values)}] = {{"
    for start in range(0, len(values), per_line):
        part = values[start : start + per_line]
        comment = ", ".join(f"{value:.6g}" for value in part)
        yield f"    {', '.join(value.hex() for value in part)}, /* {comment} */"
    yield "};"


# Numbers of all filters, and the page.


class NumberRow(NamedTuple):
    """One number of one filter in compensate.csv; fields that do not apply are empty."""

    channel: str
    component: str
    load_mass_kg: float | None
    name: str
    value: float | None
    u: float | None
    unit: str
    U: float | None
    k: float | None
    dof: float | None


def over(top: str, bottom: str) -> str:
    """Return the quotient of two units; 1 of equal ones."""
    if top == bottom:
        return "1"
    parts = [f"({unit})" if "/" in unit or "." in unit else unit for unit in (top, bottom)]
    return "/".join(parts)


def number_rows(made: LoadFilter) -> Iterator[NumberRow]:
    """Yield one row per number of one filter."""
    sensor, target = made.compensation.sensor, made.compensation.target

    def row(name: str, value: float | None, unit: str, u: float | None = None, dof: float = np.inf) -> NumberRow:
        k = None if u is None else coverage_factor(dof)
        of_u = (None, None, None) if u is None or k is None else (k * u, k, dof)
        return NumberRow(made.subject.channel, made.subject.component, made.load_mass, name, value, u, unit, *of_u)

    modes = len(sensor.frequency_hz)
    names = [f"sensor_{name}_{m + 1}" for name in ("frequency_hz", "damping_ratio") for m in range(modes)]
    names += [f"sensor_real_hz_{q + 1}" for q in range(len(sensor.real_hz))] + ["sensor_static_gain"]
    gain_unit = over(made.subject.unit, made.subject.load_unit)
    for name, value, u, dof in zip(names, sensor.vector, sensor.u, made.sensor_dof.tolist(), strict=True):
        unit = "Hz" if "_hz" in name else gain_unit if name == "sensor_static_gain" else "1"
        yield row(name, float(value), unit, finite_or_none(u), dof)
    yield row("target_frequency_hz", target.frequency_hz, "Hz")
    yield row("target_damping_ratio", target.damping_ratio, "1")
    after_unit = over(made.output_unit, made.subject.load_unit)
    for when, figures, of_gain in (("before", made.before, gain_unit), ("after", made.after, after_unit)):
        for name, value in figures.indices.figures().items():
            unit = of_gain if name == "static_gain" else unit_of(name) or "1"
            yield row(f"{when}_{name}", value, unit, figures.u[name], figures.dof[name])
    yield row("white_noise_gain", made.noise_gain, over(made.output_unit, made.subject.unit))
    yield row("noise", made.noise, made.output_unit)
    yield row("discretisation_error", made.discretisation_error, "1")
    for off, ringing in zip(made.off_frequency, made.off_ringing, strict=True):
        yield row(f"ringing_frequency_{off:+g}", float(ringing), "1")
    for load, ringing in zip(made.off_load, made.load_ringing, strict=True):
        yield row(f"ringing_load_{load:.12g}_kg", float(ringing), "1")


def headlines(evaluation: CompensateEvaluation) -> list[Headline]:
    """Return band, overshoot and settling of the first filter, before and after, and its noise."""
    made = evaluation.filters[0]
    labels = {"band_10_hz": "±10 % of the static gain up to", "overshoot": "Overshoot", "settling_2_s": "2 % settling"}
    lines = [
        Headline(text, cell(made.after, name), f"before: {cell(made.before, name)}; {made.name}")
        for name, text in labels.items()
    ]
    remark = f"white noise at {number_text(made.sections.sample_rate_hz, 6)} Hz; {made.name}"
    return [*lines, Headline("Noise", f"× {number_text(made.noise_factor)}", remark)]


def cell(figures: IndexEstimates, name: str, *, plain: bool = False) -> str:
    """Return an index with U and unit, as HTML or as `plain` text."""
    value, u = figures.indices.figures()[name], figures.expanded(name)
    if value is None or not np.isfinite(value):
        return "no end" if value is not None else "none" if plain else DASH
    scale, unit = (PERCENT, "%") if name == "overshoot" else SCALE[unit_of(name)]
    expanded = 0.0 if u is None else scale * u
    return quantity_text(scale * value, expanded, unit)


def index_table(made: LoadFilter) -> Table | None:
    """Return the indices of one filter before and after."""
    columns: list[TableColumn[str]] = [
        page_column("figure", lambda name: capitalise(LABELS[name]), "l"),
        page_column("sensor", lambda name: cell(made.before, name)),
        page_column("compensated", lambda name: cell(made.after, name)),
    ]
    coverage = "" if made.compensation.sensor.covariance is None else f", with U (95 %) {made.subject.scope}".rstrip()
    return table(f"{made.name}: before and after{coverage}", columns, SHOWN)


def _poles(made: LoadFilter) -> Markup:
    """Return the frequencies in Hz that a filter cancels."""
    sensor = made.compensation.sensor
    modes_with_u = zip(sensor.frequency_hz, sensor.u, made.sensor_dof, strict=False)
    modes = [
        quantity_text(hertz, 0.0 if np.isnan(u) else coverage_factor(float(dof)) * u) for hertz, u, dof in modes_with_u
    ]
    return Markup("; ").join([*modes, *(f"real {number_text(hertz, 5)}" for hertz in sensor.real_hz)])


FILTERS: list[TableColumn[LoadFilter]] = [
    page_column("filter", lambda made: made.name, "l"),
    page_column("from / Hz", _poles),
    page_column(
        "ζ", lambda made: "; ".join(number_text(zeta, 4) for zeta in made.compensation.sensor.damping_ratio) or DASH
    ),
    page_column("to / Hz", lambda made: number_text(made.compensation.target.frequency_hz, 6)),
    page_column("to ζ", lambda made: number_text(made.compensation.target.damping_ratio, 4)),
    page_column("rate / Hz", lambda made: number_text(made.sections.sample_rate_hz, 6)),
    page_column("noise ×", lambda made: number_text(made.noise_factor)),
    page_column(
        "noise after", lambda made: DASH if made.noise is None else f"{number_text(made.noise)} {made.output_unit}"
    ),
    page_column("sampling / %", lambda made: number_text(PERCENT * made.discretisation_error, 2)),
]
"""Cancelled dynamics, target, and cost of every filter."""


def mismatch_tables(evaluation: CompensateEvaluation) -> list[Table]:
    """Return the residual ringing of every filter with other loads or a frequency error."""
    tables = []
    for result in evaluation.subjects:
        first, subject = result.filters[0], result.subject
        loads = len(first.off_load) > 1
        if loads:
            head, condition = [subject.load_text(float(load)) for load in first.off_load], "with other loads"
        else:
            head = [f"{signed_text(PERCENT * off, '+g')} %" if off else "0 %" for off in first.off_frequency]
            condition = "with a sensor whose frequency is off"
        rows = [
            (made.name, *(number_text(PERCENT * r) for r in (made.load_ringing if loads else made.off_ringing)))
            for made in result.filters
        ]
        caption = (
            f"{subject.name}: residual ringing {condition}, % of the step after {number_text(MILLI * first.after_s)} ms"
        )
        if head:
            tables.append(Table(caption, ("filter for", *head), "l" + "r" * len(head), tuple(rows)))
    return tables


def haptics_table(evaluation: CompensateEvaluation) -> Table | None:
    """Return largest stable gain and tracking error of the force feedback by treatment."""
    check = evaluation.haptics
    if check is None:
        return None

    def at_shared(case: HapticCase) -> str:
        error = case.run.tracking_error
        return f"{number_text(PERCENT * error)} %" if np.isfinite(error) and case.run.stable else "diverges"

    columns: list[TableColumn[HapticCase]] = [
        page_column("signal", lambda case: case.name, "l"),
        page_column("largest stable K", lambda case: number_text(case.largest_gain, 4)),
        page_column("tracking error at half of it", lambda case: f"{number_text(PERCENT * case.half_gain_error)} %"),
        page_column(f"at K = {number_text(check.gain)}", at_shared),
    ]
    caption = f"{check.channel}: force feedback with a load of {number_text(GRAM * check.load_mass, 4)} g"
    return table(caption, columns, check.cases)


def damping_table(evaluation: CompensateEvaluation) -> Table | None:
    """Return the damping ratio with the widest band for each permitted error, and that band."""
    damping_ratio = evaluation.filters[0].compensation.target.damping_ratio
    columns: list[TableColumn[float]] = [
        page_column("permitted error", lambda error: f"±{number_text(PERCENT * error, 6)} %", "l"),
        page_column("best ζ", lambda error: f"{best_damping(error):.4f}"),
        page_column("band / fn", lambda error: f"{band_ratio(best_damping(error) * (1 + 1e-12), error):.4f}"),
        page_column(
            f"band / fn with ζ = {number_text(damping_ratio, 4)}",
            lambda error: f"{band_ratio(damping_ratio, error):.4f}",
        ),
    ]
    ratios = sorted({*ERRORS, evaluation.target_settings.permitted_error})
    return table("One mode: the damping ratio with the widest band", columns, ratios)


def printed(evaluation: CompensateEvaluation) -> Iterator[str]:
    """Yield the printed lines, with U (95 %) if it is known."""
    for made in evaluation.filters:
        target = made.compensation.target
        yield f"{made.name}{f', U {made.subject.scope}' if made.subject.scope else ''}"
        yield f"  natural frequency: {cell(made.before, 'natural_hz', plain=True)} -> {target.frequency_hz:.6g} Hz"
        yield f"  damping ratio: {cell(made.before, 'damping_ratio', plain=True)} -> {target.damping_ratio:.4g}"
        for name, text in PRINTED.items():
            yield f"  {text}: {cell(made.before, name, plain=True)} -> {cell(made.after, name, plain=True)}"
        yield f"  white noise at {number_text(made.sections.sample_rate_hz, 6)} Hz: × {number_text(made.noise_factor)}"


def _context(evaluation: CompensateEvaluation) -> dict[str, Any]:
    """Return the content of the page."""
    settings, applied, haptics = evaluation.target_settings, evaluation.applied, evaluation.haptics
    error, aim = settings.permitted_error, f"{number_text(settings.frequency_hz or 0.0, 6)} Hz"
    if settings.bandwidth_hz is not None:
        aim = f"±{number_text(PERCENT * error, 6)} % to {number_text(settings.bandwidth_hz, 6)} Hz"
    kind = "matched poles and zeros" if settings.discretisation == "matched" else "Tustin, prewarped at each mode"
    models = [(f"Model of {one.subject.name}", one.subject.source) for one in evaluation.subjects]
    recording = [] if applied is None else [("Recording", applied.name)]
    mismatches = [draw_mismatch(f"mismatch-{n}", result) for n, result in enumerate(evaluation.subjects)]
    return {
        "subject": [("Target", aim), ("For samples", kind), *models, *recording],
        "filters": table("Filters, with U (95 %) where it is known", FILTERS, evaluation.filters),
        "damping": damping_table(evaluation),
        "parts": [
            (made.name, [draw_bode(f"bode-{n}", made, error), draw_step(f"step-{n}", made)], index_table(made))
            for n, made in enumerate(evaluation.filters)
        ],
        "noise": [draw_noise(evaluation)],
        "mismatch": [figure for figure in mismatches if figure is not None],
        "mismatches": mismatch_tables(evaluation),
        "applied": [] if applied is None else [draw_channel(applied, one) for one in applied.channels],
        "haptics": haptics_table(evaluation),
        "haptics_pictures": [figure for figure in [draw_force_feedback(evaluation)] if figure is not None],
        "loop": LOOP.format(0.0 if haptics is None else haptics.ball_stiffness),
    }


# The result folder.


def _fill(file: h5py.File, evaluation: CompensateEvaluation) -> None:
    """Fill the HDF5 file: every filter, then the filtered channels with their standard uncertainty."""
    file.attrs["name"] = evaluation.name
    write_value(file, "filters", {made.name: _stored(made) for made in evaluation.filters})
    applied = evaluation.applied
    if applied is not None:
        channels = {
            one.channel: {name: getattr(one, name) for name in ("unit", "u_noise", "value", "u", "k")}
            for one in applied.channels
        }
        origin = {"recording": applied.name, "sample_rate_hz": applied.sample_rate_hz, "start_s": applied.start_s}
        write_value(file, "compensated", channels)
        file["compensated"].attrs.update(origin)


def _stored(made: LoadFilter) -> dict[str, Any]:
    """Return coefficients, sensor parameters with covariance, and curves of one filter."""
    design, sections, subject, hertz = made.compensation, made.sections, made.subject, frequencies(made)
    names = ("output_unit", "load_mass", "noise_gain", "noise", "band_hz", "discretisation_error", "after_s")
    curves = ("off_frequency", "off_ringing", "off_load", "load_ringing")
    band = None if design.sensor.covariance is None else gain_band(design, hertz)
    return {
        "channel": subject.channel,
        "component": subject.component,
        "scope": subject.scope,
        "input_unit": subject.unit,
        **{name: getattr(made, name) for name in (*names, *curves)},
        **vars(sections),
        "sensor": design.sensor.vector,
        "covariance": design.sensor.covariance,
        "covariance_of_scatter": design.sensor.scatter,
        "dof": subject.basis.dof,
        **({} if band is None else {"u_gain": band.u_gain, "u_phase_rad": band.u_phase_rad}),
        "frequency_hz": hertz,
        "before": design.sensor.system.response(hertz),
        "filter": design.system.response(hertz),
        "filter_for_samples": sections.response(hertz),
    }


def _texts(evaluation: CompensateEvaluation) -> dict[str, str | bytes]:
    """Return filters, numbers, and the filtered recording with U (95 %) of every sample."""
    texts: dict[str, str | bytes] = {
        JSON_FILE: json_text(evaluation),
        HEADER_FILE: header_text(evaluation),
        "compensate.csv": csv_text(columns_of(NumberRow), chain.from_iterable(map(number_rows, evaluation.filters))),
    }
    applied = evaluation.applied
    if applied is not None:
        names = ["time_s", *(name for one in applied.channels for name in (one.channel, f"U_{one.channel}"))]
        samples = [applied.time_s, *(part for one in applied.channels for part in (one.value, one.expanded))]
        columns: list[TableColumn[list[float]]] = [
            TableColumn(name, itemgetter(index)) for index, name in enumerate(names)
        ]
        texts["compensated.csv"] = csv_text(columns, np.stack(samples, axis=1).tolist())
    return texts


FILES = (JSON_FILE, HEADER_FILE, "compensate.csv", "compensated.csv")
COMPENSATE = CommandReport("compensate", "compensate", FILES, _texts, _fill, _context, printed, headlines)


def run_compensate(
    models: Sequence[Path],
    sensor: tuple[float | None, float | None],
    settings: CompensationSettings,
    output: Path | None,
    *,
    recording: Path | None = None,
    force: bool = False,
    allow_outside: bool = False,
) -> None:
    """Design filters, write them and print the summary; `sensor`: frequency (Hz) and damping ratio."""
    frequency, damping = sensor
    if models and sensor != (None, None):
        raise wrong_option("both", "either models or --sensor-frequency with --sensor-damping")
    if not models and (frequency is None or damping is None):
        expected = "models.json, load.json, a folder with one, or --sensor-frequency with --sensor-damping"
        raise wrong_option("none of them", expected)
    sources = read_sources(models) if frequency is None or damping is None else stated_sensor(frequency, damping)
    record = None if recording is None else read_outputs(recording, allow_outside=allow_outside)
    root = sources.files[0].parent if sources.files else Path.cwd()
    if settings.load_masses and not any(subject.is_scheduled for subject in sources.subjects):
        found = ", ".join(f"{number_text(mass, 6)} kg" for mass in settings.load_masses)
        raise wrong_option(found, "a model over the load (load.json) for it", "--load-mass")

    def evaluate(hashes: dict[str, str]) -> CompensateEvaluation:
        return evaluate_compensation(sources, add_recorded_load(settings, sources, record), record, hashes)

    files, read = ((), {}) if record is None else (record.manifest.files, record.manifest.file_identities)
    inputs = hash_files([*sources.files, *files], root, read)
    if sources.files:
        sources = read_sources(models)  # as they are hashed
    folder = root / COMPENSATE.name if output is None else output
    COMPENSATE.run(inputs, folder, evaluate, force=force)
