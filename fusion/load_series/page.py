"""load.html: one self-contained page with models, resonances over the load, limits and origin."""

from __future__ import annotations

from typing import Any

import numpy as np

from fusion.evaluated import page_frame
from fusion.load_series import tables
from fusion.load_series.result import ComponentLoads, LoadEvaluation, Solution
from fusion.page import render_page
from fusion.plots.load import DecaySpectrum, MeasuredLoads, ModelCurve, draw_characteristics, draw_spectra
from fusion.plots.style import Picture
from shaker.models.load_series.decay import projected

PAGE_FILE = "load.html"
PERCENT = 100.0


def render_load_page(evaluation: LoadEvaluation) -> str:
    """HTML text of the page; style and figures are inside, nothing is fetched from elsewhere."""
    return render_page("load.html", _context(evaluation))


def _context(evaluation: LoadEvaluation) -> dict[str, Any]:
    """Everything the template shows."""
    return {
        "name": evaluation.name,
        "subject": _subject(evaluation),
        "components": [_component(component, evaluation) for component in evaluation.components],
        **page_frame(evaluation),
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
        "headlines": tables.headlines(component),
        "parameters": tables.parameters_table(component),
        "loads": [tables.loads_table(component, solution) for solution in component.solutions],
        "bands": [tables.bands_table(component, solution) for solution in component.solutions],
        "limits": tables.limits_table(component),
        "masses": tables.masses_table(component),
        "characteristics": [_characteristics(component, evaluation.chosen.permitted)],
        "spectra": _spectra(component),
        "from_records": component.identification.from_records,
    }


def _characteristics(component: ComponentLoads, permitted: float) -> Picture:
    """Resonances and damping over the load."""
    curves = [_curve(component, solution) for solution in component.solutions]
    seen, load = component.series.measured, tables.GRAM * component.series.masses.load
    first = seen.frequency_hz[:, 0]
    model = component.solutions[0].recorded.frequency_hz[:, 0]
    rigid = component.identification.rigid.frequency_hz[:, 0]
    compared = ["two masses, by the lightest load", "two masses, all loads"]
    columns = [component.formula_hz, rigid]
    if not component.solutions[0].model.is_rigid:
        compared.append("three masses")
        columns.append(model)
    measured = MeasuredLoads(
        load=load,
        frequency_hz=seen.frequency_hz,
        expanded=component.k * seen.u_frequency_hz,
        damping=PERCENT * seen.damping_ratio[:, 0],
        expanded_damping=PERCENT * component.k * seen.u_damping_ratio[:, 0],
        compared=tuple(compared),
        deviation=np.stack([PERCENT * (column / first - 1.0) for column in columns], axis=1),
        permitted=permitted,
        unit=tables.small_unit(component),
    )
    grid = component.solutions[0].drawn.load_mass
    masses = component.series.masses
    lightest = int(np.argmin(masses.load))
    scale = np.sqrt((masses.moving + masses.load[lightest]) / (masses.moving + grid))
    return draw_characteristics(f"load-{component.name}", curves, measured, first[lightest] * scale)


def _curve(component: ComponentLoads, solution: Solution) -> ModelCurve:
    """A solution as it is drawn."""
    drawn, model = solution.drawn, solution.model
    label = "two masses" if model.is_rigid else "three masses"
    return ModelCurve(
        label=f"{label}, solution {model.solution}" if model.solutions > 1 else label,
        load=tables.GRAM * drawn.load_mass,
        frequency_hz=drawn.frequency_hz,
        expanded=component.k * drawn.u_frequency_hz,
        damping=PERCENT * drawn.damping_ratio[:, 0],
        expanded_damping=PERCENT * component.k * drawn.u_damping_ratio[:, 0],
    )


def _spectra(component: ComponentLoads) -> list[Picture]:
    """Spectra of the records, none of a table."""
    model, found = component.solutions[0].model, []
    for place, decay in enumerate(component.series.decays):
        poles = model.poles(float(component.series.masses.load[place]))
        residual, _ = projected(decay, poles[poles.imag > 0.0])
        window = np.hanning(len(decay.value))
        both = [np.abs(np.fft.rfft(window * part)) for part in (decay.value - np.mean(decay.value), residual)]
        largest = float(both[0].max())
        load = tables.GRAM * component.series.masses.load[place]
        found.append(
            DecaySpectrum(
                label=f"{decay.name}, load {load:.5g} {tables.small_unit(component)}",
                frequency_hz=np.asarray(np.fft.rfftfreq(len(decay.value), 1.0 / decay.rate_hz)),
                amplitude=both[0] / largest,
                residual=both[1] / largest,
                modes_hz=component.solutions[0].recorded.frequency_hz[place],
            )
        )
    return [draw_spectra(f"spectra-{component.name}", found)] if found else []
