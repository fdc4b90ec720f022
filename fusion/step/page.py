"""step.html: one self-contained page with releases, models, indices, methods and origin."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from fusion.evaluated import page_frame
from fusion.page import render_page
from fusion.plots.style import Picture
from fusion.report_tables import Table
from fusion.step import tables
from fusion.step.pictures import component_pictures
from fusion.step.result import ComponentResult, StepEvaluation

PAGE_FILE = "step.html"


@dataclass(frozen=True)
class ComponentSection:
    """What the page shows of one load component."""

    name: str
    channel: str
    reason: str
    indices: Table | None
    parameters: Table | None
    releases: Table
    ropes: Table | None
    gains: Table
    methods: Table | None
    pictures: list[Picture]


def render_step_page(evaluation: StepEvaluation) -> str:
    """HTML text of the page; style and figures are inside, nothing is fetched from elsewhere."""
    return render_page("step.html", _context(evaluation))


def _context(evaluation: StepEvaluation) -> dict[str, Any]:
    """Everything the template shows."""
    compared = evaluation.settings["method"] == "all"
    return {
        "name": evaluation.name,
        "subject": _subject(evaluation),
        "headlines": tables.headlines(evaluation),
        "summary": tables.summary_table(evaluation),
        "components": [_section(component, compared) for component in evaluation.components],
        "compared": compared,
        **page_frame(evaluation),
    }


def _section(component: ComponentResult, compared: bool) -> ComponentSection:
    """Everything of one component; methods where more than one was asked for."""
    return ComponentSection(
        name=component.component,
        channel=component.channel,
        reason=component.reason,
        indices=tables.indices_table(component),
        parameters=tables.parameters_table(component),
        releases=tables.releases_table(component),
        ropes=tables.ropes_table(component),
        gains=tables.gains_table(component),
        methods=tables.methods_table(component) if compared else None,
        pictures=list(component_pictures(component)),
    )


def _subject(evaluation: StepEvaluation) -> list[tuple[str, str]]:
    """What was released: sensor, rig, recordings."""
    facts, sensor = [("Rig", evaluation.rig)], evaluation.sensor
    if sensor is not None:
        facts.append(("Sensor", f"{sensor.name} {sensor.serial}".strip()))
    count = sum(len(component.releases) for component in evaluation.components)
    names = ", ".join(component.component for component in evaluation.components)
    facts.append(("Recordings", f"{count} of {names}"))
    return facts
