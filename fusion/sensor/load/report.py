"""The page of load characteristics."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any, NamedTuple

import numpy as np

from fusion.base import DASH, rounded, typeset
from fusion.report.numbers import capital, factor, measured
from fusion.report.table import Column, Headline, Table, known, word
from fusion.sensor.load.evaluate import ComponentLoads, LoadEvaluation, NamedLimit, Solution
from fusion.sensor.load.figures import GRAM, draw_characteristics, draw_spectra, small_unit
from fusion.sensor.models_file import parameter_units
from shaker.arrays import FloatArray
from shaker.release.load_model import PARAMETERS, LoadCurve

RECORDED, PREDICTED, DRAWN = "recorded", "predicted", "curve"


class LoadRow(NamedTuple):
    """One load of a component by one solution: recorded, asked for, or on the grid that is drawn."""

    component: ComponentLoads
    solution: Solution
    kind: str
    recording: str
    curve: LoadCurve
    place: int
    u_mass: float
    bands: FloatArray

    @property
    def is_recorded(self) -> bool:
        """Return whether this load was measured."""
        return self.kind == RECORDED

    @property
    def is_damped(self) -> bool:
        """Return whether the model tells damping."""
        ratio = self.curve.damping_ratio
        return bool(np.any(ratio[np.isfinite(ratio)] > 1e-9))


def _of_curve(name: str, of: str, mode: int, *, expanded: bool = False) -> Column[LoadRow]:
    """Column of the model's curve, empty where it tells nothing."""

    def value(row: LoadRow) -> float | None:
        if "damping" in of and not row.is_damped:
            return None
        return known(getattr(row.curve, of)[row.place, mode] * (row.component.k if expanded else 1.0))

    return Column(name, value)


def _of_measured(name: str, of: str, mode: int) -> Column[LoadRow]:
    """Column of what a record or a table shows of one load."""

    def value(row: LoadRow) -> float | None:
        return known(getattr(row.component.series.measured, of)[row.place, mode]) if row.is_recorded else None

    return Column(name, value)


LOADS: list[Column[LoadRow]] = [
    word("component", lambda row: row.component.name),
    word("channel", lambda row: row.solution.model.channel),
    Column("solution", lambda row: row.solution.model.solution),
    word("kind", lambda row: row.kind),
    word("recording", lambda row: row.recording),
    Column("load_mass", lambda row: float(row.curve.load_mass[row.place])),
    Column("u_load_mass", lambda row: row.u_mass),
    word("mass_unit", lambda row: "kg.m^2" if row.component.name.startswith("M") else "kg"),
    _of_curve("first_hz", "frequency_hz", 0),
    _of_curve("u_first_hz", "u_frequency_hz", 0),
    _of_curve("U_first_hz", "u_frequency_hz", 0, expanded=True),
    _of_curve("second_hz", "frequency_hz", 1),
    _of_curve("u_second_hz", "u_frequency_hz", 1),
    _of_curve("U_second_hz", "u_frequency_hz", 1, expanded=True),
    Column("k", lambda row: row.component.k if row.component.covers else None),
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
    Column("formula_hz", lambda row: known(row.component.formula_hz[row.place]) if row.is_recorded else None),
    Column("band_5_hz", lambda row: known(row.bands[0])),
    Column("band_10_hz", lambda row: known(row.bands[1])),
]


class ParameterRow(NamedTuple):
    """One number of a model in parameters.csv; `u_given_masses`: without what the masses add."""

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


def load_rows(evaluation: LoadEvaluation) -> Iterator[LoadRow]:
    """One row per load: those recorded, those asked for, and a grid."""
    for component in evaluation.components:
        names, u_mass = component.series.names, component.series.masses.u_load
        for solution in component.solutions:
            for place, name in enumerate(names):
                curve, u, bands = solution.recorded, float(u_mass[place]), solution.bands[place]
                yield LoadRow(component, solution, RECORDED, name, curve, place, u, bands)
            for place, bands in enumerate(solution.predicted_bands):
                yield LoadRow(component, solution, PREDICTED, "", solution.predicted, place, 0.0, bands)
            for place in range(len(solution.drawn.load_mass)):
                yield LoadRow(component, solution, DRAWN, "", solution.drawn, place, 0.0, np.full(2, np.nan))


def parameter_rows(evaluation: LoadEvaluation) -> Iterator[ParameterRow]:
    """One row per number of a model, per permitted load, and per named mass error, in its standard uncertainties."""
    for component in evaluation.components:
        k, units = component.k, parameter_units(component.name)
        for solution in component.solutions:
            model = solution.model
            head = (component.name, model.channel, model.solution)
            size, total = len(model.vector), model.total_covariance
            u = np.full(size + 1, np.nan) if total is None else np.sqrt(np.diag(total))
            own = np.full(size, np.nan) if model.covariance is None else np.sqrt(np.diag(model.covariance))
            names = [*PARAMETERS[:size], "moving_mass"]
            values = [*model.vector, model.moving_mass]
            for name, value, spread, given in zip(names, values, u, [*own, 0.0], strict=True):
                if "damping" not in name or model.damping:
                    yield ParameterRow(
                        *head, name, value, known(spread), known(k * spread), k, units[name], known(given)
                    )
            if model.unit:
                unit = f"{model.unit}/{'(N.m)' if component.name.startswith('M') else 'N'}"
                spread = model.u_sensitivity
                yield ParameterRow(*head, "sensitivity", model.sensitivity, known(spread), known(k * spread), k, unit)
            for limit in solution.limits:
                name, unit = f"{limit.name}: {limit.label}", units["moving_mass"]
                yield ParameterRow(*head, name, known(limit.load_mass), known(limit.u), known(k * limit.u), k, unit)
        fit = component.identification.chosen[0]
        for name, value in zip(component.series.masses.names, fit.deviates, strict=True):
            yield ParameterRow(component.name, component.series.output.channel, 1, f"error of {name}", value)


LABELS = {
    "stiffness": "stiffness k",
    "damping": "damping c",
    "coupling_stiffness": "stiffness of the coupling k_L",
    "coupling_damping": "damping of the coupling c_L",
    "moving_mass": "moving mass m_E",
}


def headlines(component: ComponentLoads) -> list[Headline]:
    """Stiffnesses, resonance without load, and the first limit, of the first solution."""
    solution = component.solutions[0]
    found = []
    for name, value, u in _numbers(component, solution):
        if name.endswith("stiffness"):
            unit = parameter_units(component.name)[name]
            remark = f"U: k = {factor(component.k)}" if component.covers else "without U"
            remark += _which(solution)
            found.append(Headline(capital(LABELS[name]), measured(value, component.k * u, unit_text(unit)), remark))
    bare = solution.drawn
    value, u = float(bare.frequency_hz[0, 0]), float(bare.u_frequency_hz[0, 0])
    found.append(Headline("Resonance without load", measured(value, component.k * u, "Hz"), "by the model"))
    for limit in solution.limits[:1]:
        if np.isfinite(limit.load_mass):
            found.append(Headline("Two-mass formula holds to", _mass(component, limit), limit.label))
    return found


def parameters_table(component: ComponentLoads) -> Table:
    """Every number of the model, of each solution."""
    units = parameter_units(component.name)
    rows = []
    for solution in component.solutions:
        model = solution.model
        own = () if model.covariance is None else np.sqrt(np.diag(model.covariance)).tolist()
        given = dict(zip(PARAMETERS, own, strict=False))
        for name, value, u in _numbers(component, solution):
            alone = measured(value, component.k * given[name]) if given.get(name) else DASH
            relative = f"{100.0 * component.k * u / value:.2g}" if u > 0.0 and value else DASH
            told = measured(value, component.k * u)
            rows.append((f"{model.solution}", capital(LABELS[name]), told, unit_text(units[name]), relative, alone))
    head = ("solution", "quantity", "value", "unit", "U relative / %", "for the stated masses")
    caption = f"Parameters with U = k·u, k = {factor(component.k)} (95 %)"
    return _without_first(component, Table(caption, head, "llrlrr", tuple(rows)))


def loads_table(component: ComponentLoads, solution: Solution) -> Table:
    """Every recorded load: what was measured, what the model says, what the two-mass formula says."""
    seen, rows = component.series.measured, []
    for place, name in enumerate(component.series.names):
        first, second = (
            measured(float(seen.frequency_hz[place, m]), component.k * float(seen.u_frequency_hz[place, m]))
            if np.isfinite(seen.frequency_hz[place, m])
            else DASH
            for m in range(2)
        )
        known = float(seen.frequency_hz[place, 0])
        model, formula = float(solution.recorded.frequency_hz[place, 0]), float(component.formula_hz[place])
        rigid = float(component.identification.rigid.frequency_hz[place, 0])
        cells = (_percent(model / known - 1.0), _percent(formula / known - 1.0), _percent(rigid / known - 1.0))
        mass = f"{GRAM * component.series.masses.load[place]:.6g}"
        rows.append((name, mass, first, second, *cells))
    head = (
        "recording",
        f"load / {small_unit(component)}",
        "first / Hz",
        "second / Hz",
        "model / %",
        "formula / %",
        "two masses / %",
    )
    caption = f"Resonances with U; first ones of the models less measured{_which(solution)}"
    return Table(caption, head, "lrrrrrr", tuple(rows))


def bands_table(component: ComponentLoads, solution: Solution) -> Table:
    """Damping and working bands of every load, recorded or asked for."""
    rows = []
    groups = (
        (solution.recorded, solution.bands, component.series.names),
        (solution.predicted, solution.predicted_bands, ("predicted",) * len(solution.predicted.load_mass)),
    )
    for curve, bands, names in groups:
        for place, name in enumerate(names):
            zeta, u = float(curve.damping_ratio[place, 0]), float(curve.u_damping_ratio[place, 0])
            damping = measured(100.0 * zeta, 100.0 * component.k * u) if solution.model.damping else DASH
            five, ten = (f"{edge:.4g}" if np.isfinite(edge) else DASH for edge in bands[place])
            first, second = _curve_cells(component, curve, place)
            rows.append((name, f"{GRAM * curve.load_mass[place]:.6g}", first, second, damping, five, ten))
    head = (
        "load",
        f"mass / {small_unit(component)}",
        "first / Hz",
        "second / Hz",
        "damping ratio / %",
        "±5 % to / Hz",
        "±10 % to / Hz",
    )
    caption = f"Mounted resonances, damping and bands in which the gain is that at rest{_which(solution)}"
    return Table(caption, head, "lrrrrrr", tuple(rows))


def limits_table(component: ComponentLoads) -> Table:
    """Loads that are permitted."""
    rows = []
    for solution in component.solutions:
        for limit in solution.limits:
            told = _mass(component, limit) if np.isfinite(limit.load_mass) else "no limit, or never met"
            rows.append((f"{solution.model.solution}", capital(limit.label), told))
    head = ("solution", "requirement", "largest load")
    return _without_first(component, Table("Load limits with U", head, "llr", tuple(rows)))


def masses_table(component: ComponentLoads) -> Table | None:
    """The named errors of the masses, and where the resonances move them."""
    masses, fit = component.series.masses, component.identification.chosen[0]
    if not masses.names or fit.covariance is None:
        return None
    size = len(fit.numbers)
    rows = []
    for q, name in enumerate(masses.names):
        stated = float(max(abs(masses.moving_effect[q]), np.max(np.abs(masses.load_effect[:, q]), initial=0.0)))
        left = float(np.sqrt(fit.covariance[size + q, size + q]))
        shift = f"{fit.deviates[q]:+.2f}".replace("-", "\N{MINUS SIGN}")
        rows.append((name, f"{GRAM * stated:.3g}", shift, f"{left:.2f}"))
    head = ("mass error", f"stated u / {small_unit(component)}", "found / stated u", "u left / stated u")
    return Table("Masses as unknowns: what the resonances say of them", head, "lrrr", tuple(rows))


def printed(evaluation: LoadEvaluation) -> Iterator[str]:
    """Lines for the terminal, U at 95 %."""
    for component in evaluation.components:
        for solution in component.solutions:
            structure = "two masses" if solution.model.is_rigid else "three masses"
            told = ", ".join(_plain(component, *number) for number in _numbers(component, solution))
            yield f"{component.name} ({structure}{_which(solution)}): {told}"
            for curve, names in (
                (solution.recorded, component.series.names),
                (solution.predicted, ("predicted",) * len(solution.predicted.load_mass)),
            ):
                for place, name in enumerate(names):
                    first, u = float(curve.frequency_hz[place, 0]), float(curve.u_frequency_hz[place, 0])
                    mass = f"{GRAM * curve.load_mass[place]:.6g} {small_unit(component)}"
                    left = _left(component, solution, place, name)
                    yield f"  {name}: load {mass}, resonance {_value(first, component.k * u, 'Hz')}{left}"
            for limit in solution.limits:
                known = np.isfinite(limit.load_mass)
                told = _value(GRAM * limit.load_mass, GRAM * component.k * limit.u, small_unit(component))
                yield f"  {limit.label}: {'load up to ' + told if known else 'no limit, or never met'}"


def _which(solution: Solution) -> str:
    """The number of a solution where there are several."""
    model = solution.model
    return f", solution {model.solution} of {model.solutions}" if model.solutions > 1 else ""


def _left(component: ComponentLoads, solution: Solution, place: int, name: str) -> str:
    """How far the model is from what was measured."""
    if name == "predicted":
        return ""
    known = float(component.series.measured.frequency_hz[place, 0])
    return f", measured {known:.6g} Hz ({_percent(float(solution.recorded.frequency_hz[place, 0]) / known - 1.0)} %)"


def _numbers(component: ComponentLoads, solution: Solution) -> list[tuple[str, float, float]]:
    """Name, value and standard uncertainty of every number of a model that is known; NaN without uncertainty."""
    model = solution.model
    total = model.total_covariance
    values = [*model.vector, model.moving_mass]
    u = [float("nan")] * len(values) if total is None else np.sqrt(np.diag(total)).tolist()
    names = [*PARAMETERS[: len(model.vector)], "moving_mass"]
    every = zip(names, (float(v) for v in values), u, strict=True)
    return [(name, value, spread) for name, value, spread in every if "damping" not in name or model.damping]


def _curve_cells(component: ComponentLoads, curve: LoadCurve, place: int) -> tuple[str, str]:
    """First and second resonance of a model with U."""
    first, second = (
        measured(float(curve.frequency_hz[place, m]), component.k * float(curve.u_frequency_hz[place, m]))
        if np.isfinite(curve.frequency_hz[place, m])
        else DASH
        for m in range(2)
    )
    return first, second


def _without_first(component: ComponentLoads, table: Table) -> Table:
    """The table without the number of the solution where there is one only."""
    if len(component.solutions) > 1:
        return table
    return Table(table.caption, table.head[1:], table.align[1:], tuple(row[1:] for row in table.rows))


def _mass(component: ComponentLoads, limit: NamedLimit) -> str:
    """A permitted load in g with U."""
    return measured(GRAM * limit.load_mass, GRAM * component.k * limit.u, small_unit(component))


def unit_text(unit: str) -> str:
    """ASCII unit of the result files as it is printed."""
    return typeset(unit).replace(".", "·")


def _plain(component: ComponentLoads, name: str, value: float, u: float) -> str:
    """A number with U for the terminal."""
    unit = unit_text(parameter_units(component.name)[name])
    symbol = LABELS[name].rpartition(" ")[2]
    return f"{symbol} = {_value(value, component.k * u, unit)}"


def _value(value: float, expanded: float, unit: str) -> str:
    """A value with U and unit as plain text."""
    text = rounded(value, expanded)
    power = f"e{text.exponent}" if text.exponent else ""
    if text.expanded == DASH:
        return f"{text.value}{power} {unit}"
    return f"({text.value} ± {text.expanded}){power} {unit}"


def _percent(share: float) -> str:
    """A deviation in % with a sign."""
    percent = 100.0 * share
    text = f"{percent:+.2f}" if abs(percent) >= 1.0 else f"{percent:+.3f}" if abs(percent) >= 5e-4 else "0.000"
    return text.replace("-", "\N{MINUS SIGN}")


def page_context(evaluation: LoadEvaluation) -> dict[str, Any]:
    """Everything the template shows."""
    return {
        "subject": _subject(evaluation),
        "components": [_component(component, evaluation) for component in evaluation.components],
    }


def _subject(evaluation: LoadEvaluation) -> list[tuple[str, str]]:
    """What was released: rig, sensor, recordings."""
    facts = [("Rig", evaluation.rig)] if evaluation.rig else []
    if evaluation.sensor:
        facts.append(("Sensor", evaluation.sensor))
    told = [f"{c.name}: {', '.join(c.series.names)}" for c in evaluation.components]
    return [*facts, ("Loads", "; ".join(told))]


def _component(component: ComponentLoads, evaluation: LoadEvaluation) -> dict[str, Any]:
    """Tables and figures of one component."""
    first = component.solutions[0]
    return {
        "name": component.name,
        "reason": component.identification.reason,
        "structure": "Two masses" if first.model.is_rigid else "Three masses",
        "headlines": headlines(component),
        "parameters": parameters_table(component),
        "loads": [loads_table(component, solution) for solution in component.solutions],
        "bands": [bands_table(component, solution) for solution in component.solutions],
        "limits": limits_table(component),
        "masses": masses_table(component),
        "characteristics": [draw_characteristics(component, evaluation.chosen.permitted)],
        "spectra": [picture for picture in [draw_spectra(component)] if picture is not None],
        "from_records": component.identification.from_records,
    }
