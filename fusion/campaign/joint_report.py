"""Tables, HDF5 file and page of a campaign."""

from __future__ import annotations

import io
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple
from urllib.parse import quote

import h5py
import numpy as np
from markupsafe import Markup

from fusion.base import DASH, typeset, write_whole
from fusion.campaign.curve import Linearity
from fusion.campaign.joint import (
    CampaignEvaluation,
    CurvePoint,
    curve_pictures,
    curve_points,
    curve_tables,
    evaluate_campaign,
    headlines,
    main_channel,
    main_points,
    output_pictures,
)
from fusion.campaign.matrix import CrossTalk, MatrixFit
from fusion.campaign.matrix_solve import LEAST_SINGULAR
from fusion.campaign.recorded import Recorded, read_recorded
from fusion.campaign.repeats import Repeats
from fusion.estimation.uncertainty import Polar, element_covariance, polar
from fusion.report.campaign_figures import CrosstalkMap, ExcitationDrawing, draw_crosstalk, draw_excitation
from fusion.report.csv_files import SENSITIVITY, SENSITIVITY_FILE, merge_tables, polar_columns, sensitivity_elements
from fusion.report.folder import origin_frame, render_page
from fusion.report.h5 import write_fields, write_value
from fusion.report.numbers import fixed, number, small
from fusion.report.provenance import RESULT_FORMAT, Provenance, write_provenance
from fusion.report.recording import CAMPAIGN_FILE, CROSSTALK_FILE, CURVE_FILE, REPORT_FILE
from fusion.report.style import Picture
from fusion.report.table import Column, Table, csv_text, word
from shaker.labels import LOAD_COMPONENTS, LOAD_UNITS


class CrossTalkElement(NamedTuple):
    """One element of the cross-talk, with the larger half axis of its 95 % region and whether that holds zero."""

    frequency_hz: float
    channel: str
    component: str
    value: Polar
    half_axis: float
    holds_zero: bool


CURVE: list[Column[CurvePoint]] = [
    Column("frequency_hz", lambda point: point.frequency_hz),
    word("channel", lambda point: point.channel),
    word("component", lambda point: point.component),
    *polar_columns("magnitude", lambda point: point.element),
    Column("k", lambda point: point.element.k),
    Column("U_magnitude", lambda point: point.element.expanded_magnitude),
    Column("U_phase_rad", lambda point: point.element.expanded_phase_rad),
    Column("relative", lambda point: np.nan if point.relative is None else point.relative.magnitude),
    Column("u_relative", lambda point: np.nan if point.relative is None else point.relative.u_magnitude),
    Column("U_relative", lambda point: np.nan if point.relative is None else point.relative.expanded_magnitude),
    word("unit", lambda point: point.unit),
    Column("recordings", lambda point: point.recordings),
    Column("mountings", lambda point: point.mountings),
    word("kind", lambda point: point.kind),
]
CROSSTALK: list[Column[CrossTalkElement]] = [
    Column("frequency_hz", lambda element: element.frequency_hz),
    word("channel", lambda element: element.channel),
    word("component", lambda element: element.component),
    *polar_columns("magnitude", lambda element: element.value),
    Column("U_region", lambda element: element.half_axis),
    word("holds_zero", lambda element: "yes" if element.holds_zero else "no"),
]


def campaign_tables(evaluation: CampaignEvaluation, folders: Sequence[Path]) -> dict[str, str]:
    """Return the text of every joint table, by file name; `folders`: of the recordings, in the order of the rows.

    The matrices stand among the sensitivities, with the campaign in place of a recording.
    """
    tables, sensor = merge_tables(folders), evaluation.sensor
    units = [] if sensor is None else [sensor.unit] * len(evaluation.matrices)
    for fit, unit in zip(evaluation.matrices, units, strict=False):
        elements = sensitivity_elements(fit.sensitivity(unit), evaluation.name)
        tables[SENSITIVITY_FILE] += csv_text(SENSITIVITY, elements).partition("\n")[2]
    tables[CURVE_FILE] = csv_text(CURVE, curve_points(evaluation))
    cross_talk = (element for found in evaluation.cross_talks for element in _beside_the_main(found))
    tables[CROSSTALK_FILE] = csv_text(CROSSTALK, cross_talk)
    return tables


def _beside_the_main(found: CrossTalk) -> Iterator[CrossTalkElement]:
    """Yield every element beside the main ones."""
    covariance, dof, count = found.uncertainty.covariance[0], found.uncertainty.dof()[0], found.value.size
    for place, (c, j) in enumerate(np.ndindex(found.value.shape)):
        if found.main[c] != j:
            both = [place, place + count]
            value = polar(complex(found.value[c, j]), covariance[np.ix_(both, both)], float(dof[place]))
            size, zero = float(found.half_axis[c, j]), bool(found.holds_zero[c, j])
            yield CrossTalkElement(found.frequency_hz, found.channels[c], found.components[j], value, size, zero)


# campaign.h5: what the recordings of a campaign say together, every covariance and every correlation written out.


JOINT_FIELDS = ("curves", "repeats", "linearity", "matrices", "cross_talks", "notices")


def campaign_h5(evaluation: CampaignEvaluation, files: Sequence[str]) -> bytes:
    """Return the content of campaign.h5; `files` are the names of all joint files. Equal input gives equal bytes."""
    stream = io.BytesIO()
    with h5py.File(stream, "w", track_order=True) as file:
        file.attrs["format"] = RESULT_FORMAT
        file.attrs["campaign"] = evaluation.name
        file.attrs["phasors"] = "x(t) = Re{X exp(+j omega t)}; covariances of [all Re, all Im]; k = 1"
        write_provenance(file, campaign_origin(evaluation.recorded, files))
        _write_recordings(file.create_group("recordings"), evaluation)
        if evaluation.sensor is not None:
            write_fields(file.create_group("sensor", track_order=True), evaluation.sensor)
        for name in JOINT_FIELDS:
            write_value(file, name, getattr(evaluation, name))
    return stream.getvalue()


def campaign_origin(recorded: Sequence[Recorded], files: Sequence[str]) -> Provenance:
    """Return the inputs of all recordings, with the settings and versions that the first was evaluated with."""
    hashes: dict[str, str] = {}
    for entry in recorded:
        for name, digest in entry.origin.input_hashes.items():
            hashes[name if hashes.get(name, digest) == digest else f"{entry.folder}: {name}"] = digest
    first = recorded[0].origin if recorded else Provenance({}, {}, {}, ())
    return Provenance(dict(sorted(hashes.items())), first.settings, first.versions, tuple(files))


def _write_recordings(group: h5py.Group, evaluation: CampaignEvaluation) -> None:
    """Write which recordings there are, and which failed."""
    recorded = evaluation.recorded
    for name in ("folder", "name", "mounting", "rig", "kind"):
        write_value(group, name, [getattr(entry, name) for entry in recorded])
    write_value(group, "failed", list(evaluation.failed))
    write_value(group, "reason", list(evaluation.failed.values()))


# The tables of a campaign's page: recordings, matrices, repeats and linearity.


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


# report.html of a campaign: one self-contained page with what its recordings say together.


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
        "crosstalk": crosstalk_tables(evaluation),
        "rank": rank_sentences(evaluation),
        "excitations": excitation_pictures(evaluation),
        "agreement": agreement_table(evaluation),
        "repeats": repeats_table(evaluation),
        "linearity": linearity_table(evaluation),
        "recordings": recording_rows(evaluation),
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


# The joint files of a campaign: tables, curves, cross-talk, everything with its correlations, and the page.


def write_campaign(top: Path, name: str, folders: Sequence[Path], failed: Mapping[str, str]) -> list[Path]:
    """Write the joint files of the campaign `name` into the folder `top` and return their paths.

    `folders`: results folders of the recordings that could be evaluated, in the order of the tables; everything is
    read from them, so that equal results give equal files. `failed`: folders of the others, by name, and why there is
    no result. Every file is written whole; the HDF5 file, which says that all are there, comes last.
    """
    evaluation = evaluate_campaign(name, [read_recorded(folder) for folder in folders], failed)
    files: dict[str, str | bytes] = {**campaign_tables(evaluation, folders)}
    files[REPORT_FILE] = render_campaign(evaluation)
    files[CAMPAIGN_FILE] = campaign_h5(evaluation, [*files, CAMPAIGN_FILE])
    top.mkdir(parents=True, exist_ok=True)
    for file, content in files.items():
        write_whole(top / file, content)
    return [top / file for file in files]
