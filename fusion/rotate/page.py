"""rotation.html: one self-contained page with readings, masses, budgets and origin of a rotation test."""

from __future__ import annotations

from typing import Any

from fusion.evaluated import page_frame
from fusion.load import LOAD_COMPONENTS, LOAD_UNITS
from fusion.page import render_page
from fusion.plots.rotate import Deviations, TurnedReadings, draw_deviations, draw_readings
from fusion.plots.style import FloatArray, Picture
from fusion.rotate import tables
from fusion.rotate.result import RotationEvaluation, RotationRecording
from shaker.models.weights.harmonics import turning_sense

PAGE_FILE = "rotation.html"


def render_rotation_page(evaluation: RotationEvaluation) -> str:
    """HTML text of the page; style and figures are inside, nothing is fetched from elsewhere."""
    return render_page("rotate.html", _context(evaluation))


def _context(evaluation: RotationEvaluation) -> dict[str, Any]:
    """Everything the template shows."""
    return {
        "name": evaluation.name,
        "subject": _subject(evaluation),
        "headlines": tables.headlines(evaluation),
        "masses": tables.masses_table(evaluation),
        "differences": tables.differences_table(evaluation),
        "centres": tables.centres_table(evaluation),
        "deviations": _deviations(evaluation),
        "recordings": tables.recordings_table(evaluation),
        "repeats": tables.repeats_tables(evaluation),
        "readings": [picture for recording in evaluation.recordings for picture in _pictures(recording)],
        "harmonics": [table for recording in evaluation.recordings for table in tables.harmonics_tables(recording)],
        "axis": tables.axis_table(evaluation),
        "budgets": tables.budget_tables(evaluation),
        "surroundings": tables.surroundings_table(evaluation),
        **page_frame(evaluation),
    }


def _subject(evaluation: RotationEvaluation) -> list[tuple[str, str]]:
    """What was turned: sensor, rig, recordings."""
    rig = evaluation.recordings[0].manifest.rig
    facts = [("Rig", rig.name)]
    if rig.sensor is not None:
        facts.append(("Sensor", f"{rig.sensor.name} {rig.sensor.serial}".strip()))
    told = [f"{recording.name} ({recording.manifest.name})" for recording in evaluation.recordings]
    facts.append(("Recordings", ", ".join(told)))
    return facts


def _pictures(recording: RotationRecording) -> list[Picture]:
    """Forces and moments of a recording over the angle."""
    fit, found = recording.fit, []
    inverse = recording.inverse
    for kind, unit, wanted in (("forces", LOAD_UNITS[0], slice(0, 3)), ("moments", LOAD_UNITS[3], slice(3, 6))):
        places = [i for i in recording.told if i in range(6)[wanted]]
        if not places:
            continue

        def curve(angle_rad: FloatArray, places: list[int] = places) -> FloatArray:
            return fit.curve(angle_rad) @ inverse[places].T

        found.append(
            draw_readings(
                TurnedReadings(
                    recording=recording.name,
                    kind=kind,
                    unit=unit,
                    components=tuple(LOAD_COMPONENTS[i] for i in places),
                    angle_rad=fit.angle_rad,
                    sense=turning_sense(fit.angle_rad),
                    reading=recording.load[:, places],
                    residual=fit.residual @ inverse[places].T,
                    curve=curve,
                )
            )
        )
    return found


def _deviations(evaluation: RotationEvaluation) -> list[Picture]:
    """Load mass by each axis and by all against the weighed mass."""
    found = [q for q in evaluation.quantities if q.name == "load_mass_relative_deviation"]
    weighed = evaluation.find("weighed_mass", "stated")
    if not found or weighed is None:
        return []
    own = 100.0 * weighed.expanded / weighed.value
    names = tuple(q.component for q in found)
    return [draw_deviations(Deviations(names, [q.value for q in found], [q.expanded for q in found], own))]
