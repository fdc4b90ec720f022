"""identify.html: one self-contained page with curves, parameters, readings, sensitivity and origin."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from fusion.evaluated import page_frame
from fusion.identify import tables
from fusion.identify.pictures import curve_pictures, sensitivity_pictures
from fusion.identify.result import ComponentResult, IdentifyEvaluation
from fusion.page import render_page
from fusion.plots.style import Picture
from fusion.report_tables import Table

PAGE_FILE = "identify.html"


@dataclass(frozen=True)
class ComponentSection:
    """What the page shows of one component."""

    name: str
    reason: str
    parameters: Table
    correlation: Table
    recordings: Table
    curves: list[Picture]
    readings: list[Table]
    sentences: list[str]
    explanations: Table | None
    sensitivity: list[Picture]
    bands: Table | None
    budget: Table


def render_identify_page(evaluation: IdentifyEvaluation) -> str:
    """HTML text of the page; style and figures are inside, nothing is fetched from elsewhere."""
    return render_page("identify.html", _context(evaluation))


def _context(evaluation: IdentifyEvaluation) -> dict[str, Any]:
    """Everything the template shows."""
    return {
        "name": evaluation.name,
        "subject": _subject(evaluation),
        "headlines": tables.headlines(evaluation),
        "components": [_section(component) for component in evaluation.components],
        **page_frame(evaluation),
    }


def _section(component: ComponentResult) -> ComponentSection:
    """Everything of one component."""
    return ComponentSection(
        name=component.name,
        reason=f"{component.fit.model}: {component.fit.reason}",
        parameters=tables.parameters_table(component),
        correlation=tables.correlation_table(component),
        recordings=tables.recordings_table(component),
        curves=curve_pictures(component),
        readings=tables.readings_tables(component),
        sentences=_sentences(component),
        explanations=tables.explanations_table(component),
        sensitivity=sensitivity_pictures(component),
        bands=tables.bands_table(component),
        budget=tables.budget_table(component),
    )


def _sentences(component: ComponentResult) -> list[str]:
    """Which explanation the data support, and whether the damping contradicts the resonance."""
    if component.sensitivity is None:
        return ["No sensitivity over frequency was evaluated: whether the chain has a lag remains open."]
    comparison = component.sensitivity.comparison
    return [comparison.text, *([] if comparison.damping is None else [comparison.damping.text])]


def _subject(evaluation: IdentifyEvaluation) -> list[tuple[str, str]]:
    """What was measured: sensor, rigs, recordings."""
    facts, sensor = [], evaluation.sensor
    if sensor is not None:
        facts.append(("Sensor", f"{sensor.name}, serial number {sensor.serial}" if sensor.serial else sensor.name))
    prepared = [item for component in evaluation.components for item in component.fit.prepared]
    facts.append(("Rigs", "; ".join(dict.fromkeys(item.manifest.rig.name for item in prepared))))
    facts.append(("Recordings", f"{len(prepared)} with load over base"))
    return facts
