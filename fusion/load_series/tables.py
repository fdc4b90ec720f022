"""The tables of load.html, and what the command prints."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from fusion.load_series.model_file import parameter_units
from fusion.load_series.result import ComponentLoads, LoadEvaluation, NamedLimit, Solution
from fusion.polar import DASH, rounded, typeset
from fusion.report_numbers import factor, measured
from fusion.report_tables import Headline, Table
from shaker.models.load_series.characteristics import LoadCurve
from shaker.models.load_series.model import PARAMETERS

LABELS = {
    "stiffness": "stiffness k",
    "damping": "damping c",
    "coupling_stiffness": "stiffness of the coupling k_L",
    "coupling_damping": "damping of the coupling c_L",
    "moving_mass": "moving mass m_E",
}
GRAM = 1e3


def headlines(component: ComponentLoads) -> list[Headline]:
    """Stiffnesses, resonance without load, and the first limit, of the first solution."""
    solution = component.solutions[0]
    found = []
    for name, value, u in _numbers(component, solution):
        if name.endswith("stiffness"):
            unit = parameter_units(component.name)[name]
            remark = f"U: k = {factor(component.k)}" if component.covers else "without U"
            remark += _which(solution)
            found.append(Headline(_capital(LABELS[name]), measured(value, component.k * u, unit_text(unit)), remark))
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
            rows.append((f"{model.solution}", _capital(LABELS[name]), told, unit_text(units[name]), relative, alone))
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
            rows.append((f"{solution.model.solution}", _capital(limit.label), told))
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


def small_unit(component: ComponentLoads) -> str:
    """Unit in which loads are told."""
    return "g·m²" if component.name.startswith("M") else "g"


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


def _capital(text: str) -> str:
    """Text with a capital letter at its beginning."""
    return text[:1].upper() + text[1:]
