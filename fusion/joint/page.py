"""report.html of a campaign: one self-contained page with what its recordings say together."""

from __future__ import annotations

from typing import Any

import numpy as np

from fusion.joint import tables
from fusion.joint.curves import curve_pictures, curve_tables, headlines, main_points, output_pictures
from fusion.joint.evaluation import CampaignEvaluation
from fusion.joint.h5_file import campaign_origin
from fusion.joint.points import curve_points
from fusion.matrix import LEAST_SINGULAR, CrossTalk
from fusion.page import origin_frame, render_page
from fusion.plots.matrix import CrosstalkMap, ExcitationDrawing, draw_crosstalk, draw_excitation
from fusion.plots.style import Picture

LARGEST_MAPS = 6
"""Number of frequencies whose cross-talk is drawn: those spread evenly over all."""


def render_campaign(evaluation: CampaignEvaluation) -> str:
    """HTML text of the page; style and figures are inside, nothing is fetched from elsewhere."""
    return render_page("campaign.html", _context(evaluation))


def _context(evaluation: CampaignEvaluation) -> dict[str, Any]:
    """Everything the template shows."""
    origin = campaign_origin(evaluation.recorded, ())
    mains = main_points(evaluation, curve_points(evaluation))
    return {
        "name": evaluation.name,
        "subject": _subject(evaluation),
        "headlines": headlines(evaluation, mains),
        "curves": curve_pictures(evaluation, mains),
        "curve_tables": curve_tables(mains),
        "outputs": output_pictures(evaluation),
        "maps": crosstalk_pictures(evaluation),
        "crosstalk": tables.crosstalk_tables(evaluation),
        "rank": tables.rank_sentences(evaluation),
        "excitations": excitation_pictures(evaluation),
        "agreement": tables.agreement_table(evaluation),
        "repeats": tables.repeats_table(evaluation),
        "linearity": tables.linearity_table(evaluation),
        "recordings": tables.recording_rows(evaluation),
        **origin_frame(origin, evaluation.notices),
    }


def _subject(evaluation: CampaignEvaluation) -> list[tuple[str, str]]:
    """What was measured: sensor, rigs, recordings, mountings, frequencies."""
    facts, sensor, recorded = [], evaluation.sensor, evaluation.recorded
    if sensor is not None:
        facts.append(("Sensor", f"{sensor.name}, serial number {sensor.serial}" if sensor.serial else sensor.name))
    facts.append(("Rig", "; ".join(dict.fromkeys(entry.rig for entry in recorded))))
    count = f"{len(recorded)} evaluated"
    facts.append(("Recordings", f"{count}, {len(evaluation.failed)} failed" if evaluation.failed else count))
    facts.append(("Mountings", str(len({entry.mounting for entry in recorded}))))
    frequency = [drive.frequency_hz for entry in recorded for drive in entry.drives]
    if frequency:
        facts.append(("Frequencies", f"{min(frequency):.6g} Hz to {max(frequency):.6g} Hz"))
    return facts


def crosstalk_pictures(evaluation: CampaignEvaluation) -> list[Picture]:
    """Maps of cross-talk, none where no matrix or no rated loads are known."""
    found = evaluation.cross_talks
    if not found:
        return []
    chosen = np.unique(np.linspace(0, len(found) - 1, min(len(found), LARGEST_MAPS)).round().astype(int))
    return [draw_crosstalk([_map(found[place]) for place in chosen])]


def excitation_pictures(evaluation: CampaignEvaluation) -> list[Picture]:
    """Strength of the independent excitations where there are matrices."""
    fits = evaluation.matrices
    items = [ExcitationDrawing(fit.frequency_hz, fit.excitation.singular, LEAST_SINGULAR) for fit in fits]
    return [draw_excitation(items)] if items else []


def _map(found: CrossTalk) -> CrosstalkMap:
    """Cross-talk at one frequency as the figure takes it."""
    return CrosstalkMap(
        frequency_hz=found.frequency_hz,
        channels=found.channels,
        components=found.components,
        size=100.0 * np.abs(found.value),
        half_axis=100.0 * found.half_axis,
        holds_zero=found.holds_zero,
        main=found.main,
    )
