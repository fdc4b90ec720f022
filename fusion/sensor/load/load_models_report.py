"""Files, page and printed lines of load characteristics, and the command."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import h5py
import numpy as np

from fusion.base import GRAM
from fusion.estimation.coverage import NamedQuantity
from fusion.recording.load import load_for_command
from fusion.report.folder import CommandReport, hash_files
from fusion.report.h5 import write_fields, write_value
from fusion.report.table import (
    Headline,
    Table,
    TableColumn,
    capitalise,
    columns_of,
    csv_text,
    factor_text,
    finite_or_none,
    page_column,
    table,
    text_column,
)
from fusion.sensor.load.load_evaluation import (
    ComponentLoads,
    LoadEvaluation,
    LoadSettings,
    LoadSolution,
    evaluate_loads,
    read_series,
    read_table,
)
from fusion.sensor.load.load_figures import draw_characteristics, draw_spectra, small_unit
from fusion.sensor.model_files import LOAD_MODEL_FILE, UncertaintyBasis, model_text, parameter_units
from fusion.sensor.unmodelled_effects import budget_table
from shaker.release.load_model import PARAMETERS, LoadCurve
from shakercal._common.arrays import FloatArray
from shakercal._common.digits import DASH, number_text, quantity_text, signed_text, typeset

RECORDED, PREDICTED, DRAWN = "recorded", "predicted", "curve"
LABELS = {
    "stiffness": "stiffness k",
    "damping": "damping c",
    "coupling_stiffness": "stiffness of the coupling k_L",
    "coupling_damping": "damping of the coupling c_L",
    "moving_mass": "moving mass m_E",
}
NO_LIMIT = "no limit, or not possible"

# Tables in files


class LoadRow(NamedTuple):
    """One load of a component by one solution: recorded, predicted, or on the grid."""

    component: ComponentLoads
    solution: LoadSolution
    kind: str
    recording: str
    curve: LoadCurve
    load_index: int
    u_mass: float
    bands: FloatArray
    u_bands: FloatArray

    def band_hz(self, index: int) -> tuple[float, float]:
        """Return the limit of the ±5 % (`index` 0) or ±10 % band, with U."""
        return float(self.bands[index]), self.component.k * float(self.u_bands[index])

    @property
    def mass_text(self) -> str:
        """Return the load in g or g·m²."""
        return number_text(GRAM * self.curve.load_mass[self.load_index], 6)

    def model_hz(self, mode: int) -> tuple[float, float]:
        """Return a resonance of the model with U."""
        return self._resonance(self.curve.frequency_hz, self.curve.u_frequency_hz, mode)

    def measured_hz(self, mode: int) -> tuple[float, float]:
        """Return a resonance of the record with U."""
        seen = self.component.series.measured
        return self._resonance(seen.frequency_hz, seen.u_frequency_hz, mode)

    def _resonance(self, value: FloatArray, u: FloatArray, mode: int) -> tuple[float, float]:
        return float(value[self.load_index, mode]), self.component.k * float(u[self.load_index, mode])


def _of_curve(name: str, of: str, mode: int, *, expanded: bool = False) -> TableColumn[LoadRow]:
    def value(row: LoadRow) -> float | None:
        if "damping" in of and not np.any(np.nan_to_num(row.curve.damping_ratio) > 1e-9):
            return None  # the model has no damping
        return finite_or_none(getattr(row.curve, of)[row.load_index, mode] * (row.component.k if expanded else 1.0))

    return TableColumn(name, value)


def _of_measured(name: str, of: str, mode: int) -> TableColumn[LoadRow]:
    return _if_recorded(name, lambda row: getattr(row.component.series.measured, of)[row.load_index, mode])


def _if_recorded(name: str, value: Callable[[LoadRow], float]) -> TableColumn[LoadRow]:
    return TableColumn(name, lambda row: finite_or_none(value(row)) if row.kind == RECORDED else None)


LOADS: list[TableColumn[LoadRow]] = [
    text_column("component", lambda row: row.component.name),
    text_column("channel", lambda row: row.solution.model.channel),
    TableColumn("solution", lambda row: row.solution.model.solution),
    text_column("kind", lambda row: row.kind),
    text_column("recording", lambda row: row.recording),
    TableColumn("load_mass", lambda row: float(row.curve.load_mass[row.load_index])),
    TableColumn("u_load_mass", lambda row: row.u_mass),
    text_column("mass_unit", lambda row: parameter_units(row.component.name)["moving_mass"]),
    _of_curve("first_hz", "frequency_hz", 0),
    _of_curve("u_first_hz", "u_frequency_hz", 0),
    _of_curve("U_first_hz", "u_frequency_hz", 0, expanded=True),
    _of_curve("second_hz", "frequency_hz", 1),
    _of_curve("u_second_hz", "u_frequency_hz", 1),
    _of_curve("U_second_hz", "u_frequency_hz", 1, expanded=True),
    TableColumn("k", lambda row: row.component.k if row.component.covers else None),
    _of_curve("damping_first", "damping_ratio", 0),
    _of_curve("u_damping_first", "u_damping_ratio", 0),
    _of_curve("damping_second", "damping_ratio", 1),
    _of_curve("u_damping_second", "u_damping_ratio", 1),
    _of_measured("measured_first_hz", "frequency_hz", 0),
    _of_measured("u_measured_first_hz", "u_frequency_hz", 0),
    _of_measured("measured_second_hz", "frequency_hz", 1),
    _of_measured("u_measured_second_hz", "u_frequency_hz", 1),
    _of_measured("measured_damping_first", "damping_ratio", 0),
    _of_measured("u_measured_damping_first", "u_damping_ratio", 0),
    _if_recorded("formula_hz", lambda row: row.component.formula_hz[row.load_index]),
    TableColumn("band_5_hz", lambda row: finite_or_none(row.bands[0])),
    TableColumn("band_10_hz", lambda row: finite_or_none(row.bands[1])),
    TableColumn("u_band_5_hz", lambda row: finite_or_none(row.u_bands[0])),
    TableColumn("U_band_5_hz", lambda row: finite_or_none(row.band_hz(0)[1])),
    TableColumn("u_band_10_hz", lambda row: finite_or_none(row.u_bands[1])),
    TableColumn("U_band_10_hz", lambda row: finite_or_none(row.band_hz(1)[1])),
]


def load_rows(component: ComponentLoads, solution: LoadSolution) -> Iterator[LoadRow]:
    """Yield one row per load: recorded loads, predicted loads, and a grid."""
    u_mass = component.series.masses.u_load
    for index, name in enumerate(component.series.names):
        u, bands = float(u_mass[index]), (solution.bands[index], solution.u_bands[index])
        yield LoadRow(component, solution, RECORDED, name, solution.recorded, index, u, *bands)
    for index, pair in enumerate(zip(solution.predicted_bands, solution.u_predicted_bands, strict=True)):
        yield LoadRow(component, solution, PREDICTED, "", solution.predicted, index, 0.0, *pair)
    unknown = np.full(2, np.nan)
    for index in range(len(solution.drawn.load_mass)):
        yield LoadRow(component, solution, DRAWN, "", solution.drawn, index, 0.0, unknown, unknown)


class LoadParameter(NamedTuple):
    """One number of a model, and its u given the masses, NaN if unknown."""

    solution: int
    quantity: NamedQuantity
    u_given_masses: float


def parameters(component: ComponentLoads, solution: LoadSolution) -> Iterator[LoadParameter]:
    """Yield stiffnesses, dampings if determined, and moving mass of a model."""
    model, units = solution.model, parameter_units(component.name)
    size, total = len(model.vector), model.total_covariance
    u = np.full(size + 1, np.nan) if total is None else np.sqrt(np.diag(total))
    given = np.full(size, np.nan) if model.covariance is None else np.sqrt(np.diag(model.covariance))
    names, values = [*PARAMETERS[:size], "moving_mass"], [*model.vector, model.moving_mass]
    for name, value, spread, u_given in zip(names, values, u, [*given, 0.0], strict=True):
        if "damping" not in name or model.damping:
            quantity = NamedQuantity(float(value), float(spread), component.dof, units[name], name, LABELS[name])
            yield LoadParameter(model.solution, quantity, u_given)


class ParameterRow(NamedTuple):
    """One number of a model in parameters.csv."""

    component: str
    channel: str
    solution: int
    name: str
    value: float | None
    u: float | None = None
    U: float | None = None
    k: float | None = None
    unit: str = "1"
    u_given_masses: float | None = None


def parameter_rows(evaluation: LoadEvaluation) -> Iterator[ParameterRow]:
    """Yield one row per number of a model, permitted load, and mass error.

    Mass errors are in their u.
    """
    for component in evaluation.components:
        for solution in component.solutions:
            model = solution.model
            rows = list(parameters(component, solution))
            if model.unit:
                unit, name = f"{model.unit}/{'(N.m)' if component.name.startswith('M') else 'N'}", "sensitivity"
                sensitivity = NamedQuantity(model.sensitivity, model.u_sensitivity, component.dof, unit, name, name)
                rows.append(LoadParameter(model.solution, sensitivity, np.nan))
            for one in solution.limits:
                limit = NamedQuantity(one.value, one.u, one.dof, one.unit, f"{one.name}: {one.label}", one.label)
                rows.append(LoadParameter(model.solution, limit, np.nan))
            for number, one, given in rows:
                value, u, expanded, u_given = map(finite_or_none, (one.value, one.u, one.expanded, given))
                numbers = (value, u, expanded, one.k, one.unit, u_given)
                yield ParameterRow(component.name, model.channel, number, one.name, *numbers)
        fit = component.identification.chosen[0]
        for name, value in zip(component.series.masses.names, fit.deviates, strict=True):
            yield ParameterRow(component.name, component.series.output.channel, 1, f"error of {name}", value)


def texts(evaluation: LoadEvaluation) -> dict[str, str | bytes]:
    """Return tables and models."""
    program, models, rows = evaluation.versions.get("shakercal", ""), [], list[LoadRow]()
    for component in evaluation.components:
        influences = component.series.influences
        basis = UncertaintyBasis(component.dof, influences.scope, influences.outside)
        models += [(solution.model, basis) for solution in component.solutions]
        rows += [row for solution in component.solutions for row in load_rows(component, solution)]
    return {
        "load.csv": csv_text(LOADS, rows),
        "parameters.csv": csv_text(columns_of(ParameterRow), parameter_rows(evaluation)),
        LOAD_MODEL_FILE: model_text(models, evaluation.name, evaluation.sensor, program),
    }


def fill(file: h5py.File, evaluation: LoadEvaluation) -> None:
    """Fill the HDF5 file with measured values, fits, solutions and decays."""
    file.attrs["name"] = evaluation.name
    components = file.create_group("components", track_order=True)
    for component in evaluation.components:
        group = components.create_group(component.name, track_order=True)
        series, identification = component.series, component.identification
        for name in ("reason", "from_records"):
            group.attrs[name] = getattr(identification, name)
        group.attrs["k"] = component.k
        group.attrs["scope"], group.attrs["outside"] = series.influences.scope, series.influences.outside
        write_value(group, "recordings", series.names)
        write_value(group, "formula_hz", component.formula_hz)
        for name in ("output", "measured", "masses"):
            write_fields(group.create_group(name), getattr(series, name))
        write_fields(group.create_group("two_masses"), identification.rigid)
        for number, fit in enumerate(identification.elastic, 1):
            write_fields(group.create_group(f"three_masses_{number}"), fit)
        for solution in component.solutions:
            solution_group = group.create_group(f"solution_{solution.model.solution}", track_order=True)
            for name in ("model", "recorded", "predicted", "drawn"):
                write_fields(solution_group.create_group(name), getattr(solution, name))
            write_value(solution_group, "bands_hz", solution.bands)
            write_value(solution_group, "u_bands_hz", solution.u_bands)
        decays = group.create_group("decays", track_order=True)
        for decay in series.decays:
            write_fields(decays.create_group(decays.free_name(decay.name)), decay)


# Page and terminal


def page_context(evaluation: LoadEvaluation) -> dict[str, Any]:
    """Return the content of the page."""
    named = [("Rig", evaluation.rig), ("Sensor", evaluation.sensor)]
    loads = "; ".join(f"{component.name}: {', '.join(component.series.names)}" for component in evaluation.components)
    permitted = evaluation.chosen.permitted
    return {
        "subject": [*((head, text) for head, text in named if text), ("Loads", loads)],
        "components": [
            {
                "name": component.name,
                "reason": component.identification.reason,
                "structure": capitalise(_structure(component.solutions[0])),
                "headlines": headlines(component),
                "parameters": parameters_table(component),
                "budget": parameters_budget(component),
                "loads": [loads_table(component, solution) for solution in component.solutions],
                "bands": [bands_table(component, solution) for solution in component.solutions],
                "limits": limits_table(component),
                "masses": masses_table(component),
                "characteristics": [draw_characteristics(component, permitted)],
                "spectra": [figure for figure in [draw_spectra(component)] if figure is not None],
                "from_records": component.identification.from_records,
            }
            for component in evaluation.components
        ],
    }


def headlines(component: ComponentLoads) -> list[Headline]:
    """Return stiffnesses, resonance without load, and the first limit of the first solution."""
    solution = component.solutions[0]
    remark = (f"U: k = {factor_text(component.k)}" if component.covers else "without U") + _which(solution)
    lines = [
        Headline(capitalise(one.label), quantity_text(one.value, one.expanded, typeset(one.unit)), remark)
        for _, one, _ in parameters(component, solution)
        if one.name.endswith("stiffness")
    ]
    bare = next(row for row in load_rows(component, solution) if row.kind == DRAWN)
    lines.append(Headline("Resonance without load", quantity_text(*bare.model_hz(0), "Hz"), "by the model"))
    limit = solution.limits[0]
    if np.isfinite(limit.value):
        lines.append(Headline("Two-mass formula valid up to", _limit(component, limit), limit.label))
    return lines


def parameters_table(component: ComponentLoads) -> Table | None:
    """Return every number of the model, of each solution."""

    def relative(row: LoadParameter) -> str:
        one = row.quantity
        return number_text(100.0 * one.expanded / one.value, 2) if one.u > 0.0 and one.value else DASH

    def given_masses(row: LoadParameter) -> str:
        one, given = row.quantity, row.u_given_masses
        return quantity_text(one.value, one.k * given) if given > 0.0 else DASH

    columns: list[TableColumn[LoadParameter]] = [
        page_column("solution", lambda row: f"{row.solution}", "l"),
        page_column("quantity", lambda row: capitalise(row.quantity.label), "l"),
        page_column("value", lambda row: quantity_text(row.quantity.value, row.quantity.expanded)),
        page_column("unit", lambda row: typeset(row.quantity.unit), "l"),
        page_column("U relative / %", relative),
        page_column("for the stated masses", given_masses),
    ]
    several, solutions = len(component.solutions) > 1, component.solutions
    rows = (row for solution in solutions for row in parameters(component, solution))
    caption = f"Parameters with U = k·u, k = {factor_text(component.k)} (95 %), {component.series.influences.scope}"
    return table(caption, columns if several else columns[1:], rows)


def parameters_budget(component: ComponentLoads) -> Table | None:
    """Return the budget of the first model's numbers, with influences that are not assessed."""
    model, influences = component.solutions[0].model, component.series.influences
    if model.total_covariance is None:
        return None
    effects = influences.effects(lambda *part: model.altered(*part).numbers)
    parts = influences.budget(np.diag(model.total_covariance), effects, "records and masses")
    names = (*PARAMETERS[: len(model.vector)], "moving_mass")
    numbers = {LABELS[name]: float(value) for name, value in zip(names, model.numbers, strict=True)}
    return budget_table("Budget of the parameters", numbers, parts, influences)


def loads_table(component: ComponentLoads, solution: LoadSolution) -> Table | None:
    """Return measured resonances of every recorded load, with deviations of model and two-mass formula."""
    rigid = component.identification.rigid

    def less_measured(head: str, model_hz: Callable[[LoadRow], float]) -> TableColumn[LoadRow]:
        return page_column(head, lambda row: _percent(model_hz(row) / row.measured_hz(0)[0] - 1.0))

    columns: list[TableColumn[LoadRow]] = [
        page_column("recording", lambda row: row.recording, "l"),
        page_column(f"load / {small_unit(component)}", lambda row: row.mass_text),
        page_column("first / Hz", lambda row: quantity_text(*row.measured_hz(0))),
        page_column("second / Hz", lambda row: quantity_text(*row.measured_hz(1))),
        less_measured("model / %", lambda row: row.model_hz(0)[0]),
        less_measured("formula / %", lambda row: float(component.formula_hz[row.load_index])),
        less_measured("two masses / %", lambda row: float(rigid.frequency_hz[row.load_index, 0])),
    ]
    caption = f"Resonances with U; first ones of the models less measured{_which(solution)}"
    return table(caption, columns, (row for row in load_rows(component, solution) if row.kind == RECORDED))


def bands_table(component: ComponentLoads, solution: LoadSolution) -> Table | None:
    """Return damping and working bands of every load, recorded or predicted."""

    def damping(row: LoadRow) -> str:
        zeta, u = (float(of[row.load_index, 0]) for of in (row.curve.damping_ratio, row.curve.u_damping_ratio))
        return quantity_text(100.0 * zeta, 100.0 * component.k * u) if solution.model.damping else DASH

    columns: list[TableColumn[LoadRow]] = [
        page_column("load", lambda row: row.recording or row.kind, "l"),
        page_column(f"mass / {small_unit(component)}", lambda row: row.mass_text),
        page_column("first / Hz", lambda row: quantity_text(*row.model_hz(0))),
        page_column("second / Hz", lambda row: quantity_text(*row.model_hz(1))),
        page_column("damping ratio / %", damping),
        page_column("±5 % to / Hz", lambda row: quantity_text(*row.band_hz(0))),
        page_column("±10 % to / Hz", lambda row: quantity_text(*row.band_hz(1))),
    ]
    caption = f"Mounted resonances, damping and bands in which the gain is that at rest{_which(solution)}"
    return table(caption, columns, (row for row in load_rows(component, solution) if row.kind != DRAWN))


def limits_table(component: ComponentLoads) -> Table | None:
    """Return the permitted loads."""
    columns: list[TableColumn[tuple[int, NamedQuantity]]] = [
        page_column("solution", lambda row: f"{row[0]}", "l"),
        page_column("requirement", lambda row: capitalise(row[1].label), "l"),
        page_column("largest load", lambda row: _limit(component, row[1]) if np.isfinite(row[1].value) else NO_LIMIT),
    ]
    several, solutions = len(component.solutions) > 1, component.solutions
    rows = ((solution.model.solution, limit) for solution in solutions for limit in solution.limits)
    return table("Load limits with U", columns if several else columns[1:], rows)


def masses_table(component: ComponentLoads) -> Table | None:
    """Return the named errors of the masses, as estimated from the resonances."""
    masses, fit = component.series.masses, component.identification.chosen[0]
    if fit.covariance is None:
        return None
    largest = np.maximum(np.abs(masses.moving_effect), np.max(np.abs(masses.load_effect), axis=0, initial=0.0))
    u_left = np.sqrt(np.diag(fit.covariance)[len(fit.numbers) :])
    columns: list[TableColumn[int]] = [
        page_column("mass error", lambda index: masses.names[index], "l"),
        page_column(f"stated u / {small_unit(component)}", lambda index: number_text(GRAM * largest[index])),
        page_column("found / stated u", lambda index: signed_text(float(fit.deviates[index]), "+.2f")),
        page_column("u left / stated u", lambda index: f"{u_left[index]:.2f}"),
    ]
    return table("Masses as unknowns, estimated from the resonances", columns, range(len(masses.names)))


def printed(evaluation: LoadEvaluation) -> Iterator[str]:
    """Yield the printed lines, with U at 95 %."""
    for component in evaluation.components:
        small = small_unit(component)
        for solution in component.solutions:
            numbers = []
            for _, one, _ in parameters(component, solution):
                size = quantity_text(one.value, one.expanded, one.unit)
                numbers.append(f"{one.label.rpartition(' ')[2]} = {size}")
            which, scope = f"{_structure(solution)}{_which(solution)}", component.series.influences.scope
            yield f"{component.name} ({which}): {', '.join(numbers)}; U {scope}"
            for row in (row for row in load_rows(component, solution) if row.kind != DRAWN):
                model, named = row.model_hz(0), row.recording or row.kind
                line = f"  {named}: load {row.mass_text} {small}, resonance {quantity_text(*model, 'Hz')}"
                if row.kind == RECORDED:
                    seen, _ = row.measured_hz(0)
                    line += f", measured {number_text(seen, 6)} Hz ({_percent(model[0] / seen - 1.0)} %)"
                yield line
            for limit in solution.limits:
                mass = quantity_text(GRAM * limit.value, GRAM * limit.expanded, small)
                yield f"  {limit.label}: {f'load up to {mass}' if np.isfinite(limit.value) else NO_LIMIT}"


def _structure(solution: LoadSolution) -> str:
    return "two masses" if solution.model.is_rigid else "three masses"


def _which(solution: LoadSolution) -> str:
    """Return the number of a solution if there are several."""
    model = solution.model
    return f", solution {model.solution} of {model.solutions}" if model.solutions > 1 else ""


def _limit(component: ComponentLoads, limit: NamedQuantity) -> str:
    """Return a permitted load in g or g·m² with U."""
    return quantity_text(GRAM * limit.value, GRAM * limit.expanded, small_unit(component))


def _percent(share: float) -> str:
    """Return a signed deviation in %, with three decimals below 1 %."""
    percent = 100.0 * share
    return "0.000" if abs(percent) < 5e-4 else signed_text(percent, "+.2f" if abs(percent) >= 1.0 else "+.3f")


# The command

LOAD = CommandReport(
    "load",
    "load",
    ("load.csv", "parameters.csv", LOAD_MODEL_FILE),
    texts,
    fill,
    page_context,
    printed,
    lambda evaluation: [line for component in evaluation.components for line in headlines(component)],
)


def run_loads(
    paths: Sequence[Path],
    output: Path | None,
    settings: LoadSettings,
    *,
    force: bool = False,
    allow_outside: bool = False,
) -> None:
    """Evaluate step recordings of several loads, write the results and print the summary."""
    manifests = load_for_command(paths, LOAD.name, allow_outside=allow_outside)

    def evaluate(hashes: dict[str, str]) -> LoadEvaluation:
        series, notices = read_series(manifests)
        campaign = paths[0] if len(paths) == 1 else manifests[0].root
        name = manifests[0].name if len(manifests) == 1 else f"loads of {campaign.absolute().name}"
        return evaluate_loads(name, series, notices, settings, hashes, manifests[0])

    LOAD.run_recordings(paths, manifests, output, evaluate, force=force)


def run_table(path: Path, output: Path | None, settings: LoadSettings, *, force: bool = False) -> None:
    """Evaluate a table of resonances with the moving mass of the settings, as `run_loads` does."""
    if settings.moving_mass is None:
        raise ValueError("settings: expected the moving mass that the table's resonances belong to, found none")
    inputs = hash_files([path], path.absolute().parent)
    series = read_table(path, *settings.moving_mass)
    folder = path.parent / LOAD.name if output is None else output

    def evaluate(hashes: dict[str, str]) -> LoadEvaluation:
        return evaluate_loads(path.stem, (series,), (), settings, hashes)

    LOAD.run(inputs, folder, evaluate, force=force)
