"""load.csv and parameters.csv: characteristics over the load, and the numbers behind them."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from fusion.load_series.model_file import parameter_units
from fusion.load_series.result import ComponentLoads, LoadEvaluation, Solution
from fusion.results_csv import Row
from shaker.models.load_series.characteristics import LoadCurve
from shaker.models.load_series.model import PARAMETERS

RECORDED, PREDICTED, DRAWN = "recorded", "predicted", "curve"
LOAD_COLUMNS = [
    "component",
    "channel",
    "solution",
    "kind",
    "recording",
    "load_mass",
    "u_load_mass",
    "mass_unit",
    "first_hz",
    "u_first_hz",
    "U_first_hz",
    "second_hz",
    "u_second_hz",
    "U_second_hz",
    "k",
    "damping_first",
    "u_damping_first",
    "damping_second",
    "u_damping_second",
    "measured_first_hz",
    "u_measured_first_hz",
    "measured_second_hz",
    "u_measured_second_hz",
    "measured_damping_first",
    "u_measured_damping_first",
    "formula_hz",
    "band_5_hz",
    "band_10_hz",
]
PARAMETER_COLUMNS = ["component", "channel", "solution", "name", "value", "u", "U", "k", "unit", "u_given_masses"]


def load_rows(evaluation: LoadEvaluation) -> Iterator[Row]:
    """One row per load: those recorded, those asked for, and a grid; what is not known is left empty."""
    for component in evaluation.components:
        for solution in component.solutions:
            for place, name in enumerate(component.series.names):
                head = _head(component, solution, RECORDED, name)
                u_mass = float(component.series.masses.u_load[place])
                tail = [*_measured(component, place), component.formula_hz[place], *solution.bands[place]]
                yield _row(head, solution.recorded, place, u_mass, component, tail)
            for place in range(len(solution.predicted.load_mass)):
                head = _head(component, solution, PREDICTED, "")
                tail = [*_unmeasured(), *solution.predicted_bands[place]]
                yield _row(head, solution.predicted, place, 0.0, component, tail)
            for place in range(len(solution.drawn.load_mass)):
                head = _head(component, solution, DRAWN, "")
                yield _row(head, solution.drawn, place, 0.0, component, [*_unmeasured(), np.nan, np.nan])


def parameter_rows(evaluation: LoadEvaluation) -> Iterator[Row]:
    """One row per number of a model, per permitted load, and per named mass error, in its standard uncertainties."""
    for component in evaluation.components:
        k, units = component.k, parameter_units(component.name)
        for solution in component.solutions:
            model = solution.model
            head: Row = [component.name, model.channel, model.solution]
            size, total = len(model.vector), model.total_covariance
            u = np.full(size + 1, np.nan) if total is None else np.sqrt(np.diag(total))
            own = np.full(size, np.nan) if model.covariance is None else np.sqrt(np.diag(model.covariance))
            names = [*PARAMETERS[:size], "moving_mass"]
            values = [*model.vector, model.moving_mass]
            for name, value, spread, given in zip(names, values, u, [*own, 0.0], strict=True):
                if "damping" in name and not model.damping:
                    continue
                yield [*head, name, value, *_none(spread, k * spread), k, units[name], *_none(given)]
            u_gain = model.u_sensitivity
            unit = f"{model.unit}/{'(N.m)' if component.name.startswith('M') else 'N'}"
            if model.unit:
                yield [*head, "sensitivity", model.sensitivity, *_none(u_gain, k * u_gain), k, unit, ""]
            for limit in solution.limits:
                spread = limit.u
                cells = _none(limit.load_mass, spread, k * spread)
                yield [*head, f"{limit.name}: {limit.label}", *cells, k, units["moving_mass"], ""]
        fit = component.identification.chosen[0]
        for name, value in zip(component.series.masses.names, fit.deviates, strict=True):
            yield [component.name, component.series.output.channel, 1, f"error of {name}", value, "", "", "", "1", ""]


def _head(component: ComponentLoads, solution: Solution, kind: str, recording: str) -> Row:
    """What a row belongs to."""
    model = solution.model
    return [component.name, model.channel, model.solution, kind, recording]


def _row(head: Row, curve: LoadCurve, place: int, u_mass: float, component: ComponentLoads, tail: Row) -> Row:
    """One row of load.csv."""
    mass = "kg.m^2" if component.name.startswith("M") else "kg"
    cells = [*head, float(curve.load_mass[place]), u_mass, mass]
    for mode in range(2):
        u = curve.u_frequency_hz[place, mode]
        cells += _none(curve.frequency_hz[place, mode], u, component.k * u)
    cells.append(component.k if component.covers else "")
    damped = bool(np.any(curve.damping_ratio[np.isfinite(curve.damping_ratio)] > 1e-9))
    for mode in range(2):
        pair = (curve.damping_ratio[place, mode], curve.u_damping_ratio[place, mode])
        cells += _none(*pair) if damped else ["", ""]
    return [*cells, *_none(*tail)]


def _measured(component: ComponentLoads, place: int) -> Row:
    """What a record or a table shows of one load."""
    seen = component.series.measured
    first, second = seen.frequency_hz[place]
    u_first, u_second = seen.u_frequency_hz[place]
    return [first, u_first, second, u_second, seen.damping_ratio[place, 0], seen.u_damping_ratio[place, 0]]


def _unmeasured() -> Row:
    """Empty cells in place of what was measured, and of the formula."""
    return [np.nan] * 7


def _none(*values: float | str | None) -> Row:
    """Numbers, nothing where there is none."""
    return ["" if value is None or not np.isfinite(float(value)) else float(value) for value in values]
