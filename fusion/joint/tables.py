"""The tables of a campaign's page: recordings, matrices, repeats and linearity."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from urllib.parse import quote

import numpy as np
from markupsafe import Markup

from fusion.joint.evaluation import CampaignEvaluation, main_channel
from fusion.linearity import Linearity
from fusion.load import LOAD_COMPONENTS, LOAD_UNITS
from fusion.matrix import LEAST_SINGULAR, CrossTalk, MatrixFit
from fusion.polar import DASH, element_covariance, polar, typeset
from fusion.read_results import Recorded
from fusion.repeats import Repeats
from fusion.report import REPORT_FILE
from fusion.report_numbers import fixed, number, small
from fusion.report_tables import Table


@dataclass(frozen=True)
class RecordingRow:
    """One recording of the list: cells of the table, and where its report lies, empty where there is none."""

    name: str
    folder: str
    mounting: str
    excitation: str
    frequency: str
    warnings: str
    result: str
    link: str


def recording_rows(evaluation: CampaignEvaluation) -> list[RecordingRow]:
    """Every recording that could be evaluated, then those that could not, with the reason."""
    rows = [_recording_row(entry) for entry in evaluation.recorded]
    for folder, reason in evaluation.failed.items():
        rows.append(RecordingRow(folder, folder, DASH, DASH, DASH, DASH, f"failed: {reason}", ""))
    return rows


def crosstalk_tables(evaluation: CampaignEvaluation) -> list[Table]:
    """One table of cross-talk per frequency, in per cent, with the larger half axis of its 95 % region."""
    return [_crosstalk_table(found) for found in evaluation.cross_talks]


def agreement_table(evaluation: CampaignEvaluation) -> Table | None:
    """How every recording agrees with the matrix that all others give, one column per frequency."""
    fits = evaluation.matrices
    if not any(np.isfinite(item.normalised_deviation) for fit in fits for item in fit.agreement):
        return None
    cells = {(item.recording, k): item for k, fit in enumerate(fits) for item in fit.agreement}
    names = [entry.name for entry in evaluation.recorded if any(name == entry.name for name, _ in cells)]
    rows = []
    for name in names:
        own = [cells.get((name, k)) for k in range(len(fits))]
        mounting = next(item.mounting for item in own if item is not None)
        rows.append(
            (name, mounting, *(DASH if item is None else _deviation(item.normalised_deviation) for item in own))
        )
    total = tuple(f"{fit.chi2:.1f} / {fit.dof}" for fit in fits)
    rows.append((Markup("<b>χ² / degrees of freedom</b>"), "", *total))
    head = ("recording", "mounting", *(f"{fit.frequency_hz:.6g} Hz" for fit in fits))
    caption = "Each recording against the matrix that all others give (normalised deviation: 1 is expected)"
    return Table(caption, head, "ll" + "r" * len(fits), tuple(rows))


def rank_sentences(evaluation: CampaignEvaluation) -> list[str]:
    """What the excitations determine, or what is missing."""
    told = [_determined(evaluation.matrices)] if evaluation.matrices else []
    return told + [_sentence(notice.text) for notice in evaluation.refused]


def repeats_table(evaluation: CampaignEvaluation) -> Table | None:
    """What recordings and mountings of one excitation scatter by, for the output that belongs to the load."""
    rows = tuple(_repeats_row(evaluation, found) for found in evaluation.repeats)
    head = ("frequency / Hz", "load", "amplitude", "recordings", "mountings", "within / %", "between / %", "U / %", "k")
    caption = (
        "Repeats: relative standard deviation of a recording (within) and of a mounting (between) beyond what is "
        "stated for them, and U of the mean"
    )
    return Table(caption, head, "rlrrrrrrr", rows) if rows else None


def linearity_table(evaluation: CampaignEvaluation) -> Table | None:
    """How the sensitivity changes with amplitude, for the output that belongs to the load."""
    rows = tuple(_linearity_row(evaluation, found) for found in evaluation.linearity)
    head = (
        "frequency / Hz",
        "load",
        "amplitudes",
        "recordings",
        "change of magnitude / %",
        "of phase / mrad",
        "verdict",
    )
    caption = "Linearity: change of the sensitivity from the smallest to the largest amplitude, with U"
    return Table(caption, head, "rlrrrrl", rows) if rows else None


def _repeats_row(evaluation: CampaignEvaluation, found: Repeats) -> tuple[str, ...]:
    """One excitation that was recorded more than once."""
    channel = main_channel(evaluation, found.channels, found.component)
    covariance = element_covariance(found.uncertainty.covariance[0], channel)
    element = polar(complex(found.value[channel]), covariance, float(found.uncertainty.dof()[0, channel]))
    return (
        f"{found.frequency_hz:.4f}",
        LOAD_COMPONENTS[found.component],
        f"{found.amplitude:.4g} {typeset(LOAD_UNITS[found.component])}",
        str(len(found.recordings)),
        str(len(set(found.mountings))),
        _percent(found.within[channel]),
        _percent(found.between[channel]),
        small(100.0 * element.expanded_magnitude / element.magnitude),
        f"{element.k:.2f}",
    )


def _linearity_row(evaluation: CampaignEvaluation, found: Linearity) -> tuple[str, ...]:
    """One series of amplitudes."""
    channel = main_channel(evaluation, found.channels, found.component)
    change = complex(found.change[channel])
    expanded = polar(1.0 + 0.0j, found.covariance[channel], found.dof)
    low, high = float(np.min(found.amplitude)), float(np.max(found.amplitude))
    return (
        f"{found.frequency_hz:.4f}",
        LOAD_COMPONENTS[found.component],
        f"{low:.4g} to {high:.4g} {typeset(LOAD_UNITS[found.component])}",
        str(len(found.recordings)),
        fixed(100.0 * change.real, 100.0 * expanded.expanded_magnitude, 0),
        fixed(1e3 * change.imag, 1e3 * expanded.expanded_phase_rad, 0),
        "linear within U" if found.linear[channel] else "not linear",
    )


def _percent(share: float) -> str:
    """A relative standard deviation in per cent: a dash where nothing tells it, zero where nothing is left."""
    if not np.isfinite(share):
        return DASH
    return small(100.0 * share) if share > 0.0 else "0"


def _recording_row(entry: Recorded) -> RecordingRow:
    """One recording that was evaluated."""
    direction = ",\N{NO-BREAK SPACE}".join(f"{number:.4g}" for number in entry.direction)
    return RecordingRow(
        name=entry.name,
        folder=entry.folder,
        mounting=entry.mounting,
        excitation=f"{entry.kind}\N{NO-BREAK SPACE}({direction})" if direction else entry.kind,
        frequency=", ".join(f"{drive.frequency_hz:.6g}" for drive in entry.drives) or DASH,
        warnings=str(sum(notice.severity == "warning" for notice in entry.notices)),
        result="evaluated" if entry.drives else "no load or no output",
        link=f"{quote(entry.folder)}/{REPORT_FILE}",
    )


def _crosstalk_table(found: CrossTalk) -> Table:
    """Cross-talk at one frequency: outputs down, loads across."""
    rows = []
    for c, channel in enumerate(found.channels):
        cells = [_crosstalk_cell(found, c, j) for j in range(len(found.components))]
        rows.append((f"output {channel}", *cells))
    caption = (
        f"Cross-talk at {found.frequency_hz:.6g} Hz in per cent of the rated output, ± half axis of its 95 % region"
    )
    return Table(caption, ("", *found.components), "l" + "r" * len(found.components), tuple(rows))


def _crosstalk_cell(found: CrossTalk, channel: int, component: int) -> Markup:
    """Magnitude with the half axis, or an upper bound where the region holds zero."""
    if found.main[channel] == component:
        return Markup("1")
    size = 100.0 * float(abs(found.value[channel, component]))
    half_axis = 100.0 * float(found.half_axis[channel, component])
    if found.holds_zero[channel, component]:
        return Markup("&lt; {}").format(f"{size + half_axis:.2g}")
    return fixed(size, half_axis, 0)


def _deviation(value: float) -> str:
    """A normalised deviation, a dash where nothing tests it."""
    return f"{value:.2f}" if np.isfinite(value) else DASH


def _determined(fits: Sequence[MatrixFit]) -> str:
    """How well the excitations tell the six columns apart, where they do so least."""
    least = min(fits, key=lambda fit: float(fit.excitation.singular[-1]))
    size = float(least.excitation.singular[-1])
    return (
        f"{places_text([fit.frequency_hz for fit in fits])} the recordings excite six independent loads. The weakest "
        f"of them is {number(size)} times its standard uncertainty at {least.frequency_hz:.6g} Hz; a matrix needs "
        f"{LEAST_SINGULAR:g}."
    )


def places_text(frequency_hz: Sequence[float]) -> str:
    """One or several frequencies in words."""
    if len(frequency_hz) == 1:
        return f"At {frequency_hz[0]:.6g} Hz"
    return f"At {len(frequency_hz)} frequencies from {min(frequency_hz):.6g} Hz to {max(frequency_hz):.6g} Hz"


def _sentence(text: str) -> str:
    """A notice as a sentence."""
    return f"{text[:1].upper()}{text[1:]}."
