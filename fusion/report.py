"""report.html: one self-contained page with results, figures and origin of one recording."""

from __future__ import annotations

from typing import Any

from fusion import report_tables as tables
from fusion.budget_tables import budget_tables, other_loads_table
from fusion.consistency_tables import consistency_tables
from fusion.evaluation import Evaluation
from fusion.monte_carlo_tables import monte_carlo_tables
from fusion.page import origin_frame, render_page
from fusion.plots.gallery import draw_all
from fusion.point_tables import point_tables
from fusion.report_numbers import measured
from fusion.signal_tables import channels_table, clocks_table, drift_table, lines_table
from fusion.take_tables import takes_table

REPORT_FILE = "report.html"


def render_report(evaluation: Evaluation) -> str:
    """HTML text of the report; style and figures are inside, nothing is fetched from elsewhere."""
    return render_page("report.html", _context(evaluation))


def _context(evaluation: Evaluation) -> dict[str, Any]:
    """Everything the template shows."""
    return {
        "manifest": evaluation.manifest,
        "subject": _subject(evaluation),
        "headlines": tables.headlines(evaluation),
        "pictures": draw_all(evaluation),
        "sensitivity": tables.sensitivity_table(evaluation),
        "sources": tables.source_tables(evaluation),
        "load": tables.load_table(evaluation),
        "points": point_tables(evaluation),
        "consistency": consistency_tables(evaluation),
        "others": other_loads_table(evaluation),
        "budgets": budget_tables(evaluation),
        "monte_carlo": monte_carlo_tables(evaluation),
        "stereo": tables.stereo_table(evaluation.stereo),
        "lines": lines_table(evaluation),
        "channels": channels_table(evaluation),
        "drift": drift_table(evaluation),
        "takes": takes_table(evaluation),
        "clocks": clocks_table(evaluation),
        **origin_frame(evaluation, evaluation.notices),
        "duration_s": evaluation.duration_s,
    }


def _subject(evaluation: Evaluation) -> list[tuple[str, str]]:
    """What was measured: rig, sensor, load mass, excitation, surroundings."""
    rig, excitation = evaluation.manifest.rig, evaluation.manifest.excitation
    facts = [("Rig", rig.name)]
    if rig.sensor is not None:
        serial = f", serial number {rig.sensor.serial}" if rig.sensor.serial else ""
        facts.append(("Sensor", f"{rig.sensor.name}{serial}"))
    if rig.load is not None:
        mass = measured(rig.load.mass, 2.0 * rig.load.mass_uncertainty, "kg").striptags()
        facts.append(("Load mass", f"{mass}, k = 2"))
    nominal = ", ".join(f"{frequency:g} Hz" for frequency in excitation.frequencies or ())
    direction = ", ".join(f"{element:g}" for element in excitation.direction or ())
    told = [excitation.kind, nominal, f"direction ({direction})" if direction else ""]
    facts.append(("Excitation", ", ".join(filter(None, told))))
    if rig.environment is not None and rig.environment.temperature is not None:
        facts.append(("Temperature", f"{rig.environment.temperature:g} °C"))
    return facts
