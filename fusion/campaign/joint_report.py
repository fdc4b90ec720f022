"""Tables, HDF5 file and page of a campaign."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import replace
from itertools import chain
from pathlib import Path
from tempfile import TemporaryFile
from typing import Any, NamedTuple
from urllib.parse import quote

import numpy as np
from markupsafe import Markup

from fusion.base import count_text
from fusion.campaign.campaign_figures import (
    draw_crosstalk,
    draw_curve,
    draw_deviations,
    draw_excitation,
    draw_outputs,
    draw_recordings,
)
from fusion.campaign.curve import CurvePoint, Linearity
from fusion.campaign.excited_line import DiskStore
from fusion.campaign.joint_evaluation import (
    CampaignEvaluation,
    best_points,
    curve_points,
    curve_tables,
    evaluate_campaign,
    headlines,
    largest_crosstalk,
    main_channel,
    main_points,
)
from fusion.campaign.matrix import CrossTalk
from fusion.campaign.matrix_solve import MIN_SINGULAR
from fusion.campaign.recording_results import RecordingResults, read_recorded
from fusion.campaign.repeats import RepeatMean
from fusion.campaign.unknowns import JointUnknown
from fusion.estimation.coverage import Polar, polar
from fusion.estimation.uncertainty import polar_elements
from fusion.report.atomic_files import report_write_errors, staging_dir, write_files, write_together
from fusion.report.figure import Figure
from fusion.report.folder import (
    CURVE_FILE,
    RESULT_FILE,
    RESULT_FORMAT,
    SENSITIVITY_FILE,
    InputFiles,
    Provenance,
    origin_frame,
    render_page,
    write_provenance,
)
from fusion.report.h5 import EVIDENCE, h5_content, write_fields, write_value
from fusion.report.h5_tree import Group
from fusion.report.labelled_results import CAMPAIGN_FILE
from fusion.report.recording_report import (
    CAMPAIGN_FILES,
    CROSSTALK_FILE,
    MERGED_FILES,
    REPORT_FILE,
    SENSITIVITY,
    merged_table,
    sensitivity_elements,
)
from fusion.report.result_figures import draw_contributions
from fusion.report.table import Table, TableColumn, csv_text, page_column, polar_columns, table, text_column
from fusion.report.tables import result_name
from fusion.report.traceability import largest_of, trace_inputs, traceability
from fusion.sensitivity.input_evidence import InputEvidence
from fusion.sensitivity.load_phasors import budget
from fusion.sensitivity.sensitivity_notices import NO_RESULT_AT_LINES
from shaker.labels import LOAD_COMPONENTS, LOAD_UNITS
from shakercal._common.arrays import FloatArray
from shakercal._common.digits import DASH, number_text, quantity_text, scaled_text, signed_text, small, typeset
from shakercal._common.notices import gather


class CrossTalkElement(NamedTuple):
    """One element of the cross-talk, with the larger half axis of its 95 % region.

    `holds_zero`: whether that region includes zero.
    """

    frequency_hz: float
    channel: str
    component: str
    value: Polar
    half_axis: float
    holds_zero: bool


CURVE: list[TableColumn[CurvePoint]] = [
    TableColumn("frequency_hz", lambda point: point.frequency_hz),
    text_column("channel", lambda point: point.channel),
    text_column("component", lambda point: point.component),
    *polar_columns("magnitude", lambda point: point.element),
    TableColumn("k", lambda point: point.element.k),
    TableColumn("U_magnitude", lambda point: point.element.expanded_magnitude),
    TableColumn("U_phase_rad", lambda point: point.element.expanded_phase_rad),
    TableColumn("relative", lambda point: np.nan if point.relative is None else point.relative.magnitude),
    TableColumn("u_relative", lambda point: np.nan if point.relative is None else point.relative.u_magnitude),
    TableColumn("U_relative", lambda point: np.nan if point.relative is None else point.relative.expanded_magnitude),
    text_column("unit", lambda point: point.unit),
    TableColumn("recordings", lambda point: point.recordings),
    TableColumn("mountings", lambda point: point.mountings),
    text_column("kind", lambda point: point.kind),
    *polar_columns("magnitude", lambda point: point.element, freedom=True),
]
CROSSTALK: list[TableColumn[CrossTalkElement]] = [
    TableColumn("frequency_hz", lambda element: element.frequency_hz),
    text_column("channel", lambda element: element.channel),
    text_column("component", lambda element: element.component),
    *polar_columns("magnitude", lambda element: element.value),
    TableColumn("U_region", lambda element: element.half_axis),
    text_column("holds_zero", lambda element: "yes" if element.holds_zero else "no"),
    *polar_columns("magnitude", lambda element: element.value, freedom=True),
]


def campaign_tables(evaluation: CampaignEvaluation, folders: Sequence[Path]) -> dict[str, Iterable[str]]:
    """Return every joint table in parts, by file name.

    `folders`: of the recordings in order of the rows.

    The matrices are rows of the sensitivities, with the campaign as their recording.
    """
    tables: dict[str, Iterable[str]] = {name: merged_table(name, folders) for name in MERGED_FILES}
    tables[SENSITIVITY_FILE] = chain(tables[SENSITIVITY_FILE], _of_matrices(evaluation))
    tables[CURVE_FILE] = [csv_text(CURVE, curve_points(evaluation))]
    cross_talk = (element for found in evaluation.cross_talks for element in _side_elements(found))
    tables[CROSSTALK_FILE] = [csv_text(CROSSTALK, cross_talk)]
    return tables


def _of_matrices(evaluation: CampaignEvaluation) -> Iterator[str]:
    """Yield the rows of every matrix for the table of sensitivities."""
    if evaluation.sensor is not None:
        for fit in evaluation.matrices:
            elements = sensitivity_elements(fit.sensitivity(evaluation.sensor.unit), evaluation.name)
            yield csv_text(SENSITIVITY, elements).partition("\n")[2]


def _side_elements(found: CrossTalk) -> Iterator[CrossTalkElement]:
    """Yield every element except the main ones."""
    (elements,) = polar_elements(found.value.reshape(1, -1), found.uncertainty)
    for (c, j), value in zip(np.ndindex(found.value.shape), elements, strict=True):
        if found.main[c] != j and value is not None:
            size, zero = float(found.half_axis[c, j]), bool(found.holds_zero[c, j])
            yield CrossTalkElement(found.frequency_hz, found.channels[c], found.components[j], value, size, zero)


# campaign.h5: joint results with every covariance and correlation.


JOINT_FIELDS = ("curves", "repeats", "linearity", "matrices", "cross_talks", "unknowns", "notices")


def campaign_h5(evaluation: CampaignEvaluation, files: Sequence[str]) -> bytes:
    """Return the content of campaign.h5; `files` are the names of all joint files.

    Equal input gives equal bytes.
    """

    def fill(file: Group) -> None:
        file.attrs["format"] = RESULT_FORMAT
        file.attrs["campaign"] = evaluation.name
        file.attrs["phasors"] = "x(t) = Re{X exp(+j omega t)}; covariances of [all Re, all Im]; k = 1"
        write_provenance(file, campaign_origin(evaluation.recorded), files)
        recordings = file.create_group("recordings")
        for name in ("folder", "name", "mounting", "rig", "kind"):
            write_value(recordings, name, [getattr(entry, name) for entry in evaluation.recorded])
        write_value(recordings, "date", ["" if e.date is None else e.date.isoformat() for e in evaluation.recorded])
        write_value(recordings, "failed", list(evaluation.failed))
        write_value(recordings, "reason", list(evaluation.failed.values()))
        if evaluation.sensor is not None:
            write_fields(file.create_group("sensor", track_order=True), evaluation.sensor)
        if evidence := _evidence(evaluation):
            write_value(file, EVIDENCE, evidence)
        for name in JOINT_FIELDS:
            write_value(file, name, getattr(evaluation, name))

    return h5_content(fill)


def _evidence(evaluation: CampaignEvaluation) -> tuple[InputEvidence, ...]:
    """Return the sources of the inputs of all recordings, each once."""
    return tuple(dict.fromkeys(row for entry in evaluation.recorded for row in entry.evidence))


def _traceability(evaluation: CampaignEvaluation) -> dict[str, Any]:
    """Return the inputs of the main elements, of ratios only if there is nothing else."""
    kinds = {curve.kind for curve in evaluation.curves}
    kind = next((kind for kind in ("matrix", "element", "ratio") if kind in kinds), None)
    evidence = _evidence(evaluation)
    parts, names = [], list[str]()
    for curve in (curve for curve in evaluation.curves if curve.kind == kind):
        mains = [e for e, (c, j) in enumerate(curve.elements) if c == main_channel(evaluation, curve.channels, j)]
        parts.append(trace_inputs(curve.value[:, mains], curve.uncertainty.at(mains), evidence))
        names += [curve.name(e) for e in mains]
    return traceability(largest_of(parts), ", ".join(dict.fromkeys(names)))


def campaign_origin(recorded: Sequence[RecordingResults]) -> Provenance:
    """Return the inputs of all recordings, with settings and versions of the first."""
    hashes: dict[str, str] = {}
    for entry in recorded:
        for name, digest in entry.origin.input_hashes.items():
            hashes[name if hashes.get(name, digest) == digest else f"{entry.folder}: {name}"] = digest
    first = recorded[0].origin if recorded else Provenance({}, {}, {}, ())
    return Provenance(dict(sorted(hashes.items())), first.settings, first.versions, ())


# The tables of a campaign's page: recordings, matrices, repeats and linearity.


MOST_ROWS = 1000
"""Largest number of recordings and input files on the page; longer pages are slow to open (chosen)."""


def recordings_table(evaluation: CampaignEvaluation) -> Table | None:
    """Return the table of recordings with links to their reports, failed ones last."""
    blank = "\N{NO-BREAK SPACE}"

    def name(entry: RecordingResults) -> str:
        link = f"{quote(entry.folder)}/{REPORT_FILE}"
        return Markup('<a href="{}">{}</a><br><span class="below">{}</span>').format(link, entry.name, entry.folder)

    def excitation(entry: RecordingResults) -> str:
        direction = f",{blank}".join(number_text(number, 4) for number in entry.direction)
        return f"{entry.kind}{blank}({direction})" if direction else entry.kind

    def result(entry: RecordingResults) -> str:
        if any(notice.code == NO_RESULT_AT_LINES.code for notice in entry.notices):
            return "driven lines without a result"
        return "evaluated" if entry.excited_lines else "no load or no output"

    columns: list[TableColumn[RecordingResults]] = [
        page_column("recording", name, "l"),
        page_column("mounting", lambda entry: entry.mounting, "l"),
        page_column("excitation", excitation, "l"),
        page_column(
            "frequency / Hz",
            lambda entry: ", ".join(number_text(d.frequency_hz, 6) for d in entry.excited_lines) or DASH,
        ),
        page_column("warnings", lambda entry: str(sum(notice.severity == "warning" for notice in entry.notices))),
        page_column("result", result, "l"),
    ]
    caption, count = "Recordings in the order of the tables; names lead to their reports", len(evaluation.recorded)
    if count > MOST_ROWS:
        caption += f". The first {MOST_ROWS} of {count}; {SENSITIVITY_FILE} has all, and every folder has a report"
    found = table(caption, columns, evaluation.recorded[:MOST_ROWS])
    twice = Markup('{0}<br><span class="below">{0}</span>')
    failed = [(twice.format(f), *[DASH] * 4, f"failed: {reason}") for f, reason in evaluation.failed.items()]
    return None if found is None else replace(found, rows=(*found.rows, *failed))


def _agreement_table(evaluation: CampaignEvaluation) -> Table | None:
    """Return the agreement of every recording with the matrix of all others."""
    fits = evaluation.matrices
    if not any(np.isfinite(item.normalised_deviation) for fit in fits for item in fit.agreement):
        return None
    cells = {(item.recording, k): item for k, fit in enumerate(fits) for item in fit.agreement}
    compared = {name for name, _ in cells}
    names = [entry.name for entry in evaluation.recorded if entry.name in compared]
    rows = []
    for name in names:
        row = [cells.get((name, k)) for k in range(len(fits))]
        mounting = next(item.mounting for item in row if item is not None)
        rows.append(
            (name, mounting, *(DASH if item is None else signed_text(item.normalised_deviation) for item in row))
        )
    total = tuple(f"{fit.chi2:.1f} / {fit.dof}" for fit in fits)
    rows.append((Markup("<b>χ² / degrees of freedom</b>"), "", *total))
    head = ("recording", "mounting", *(f"{number_text(fit.frequency_hz, 6)} Hz" for fit in fits))
    caption = "Each recording against the matrix that all others give (normalised deviation: 1 is expected)"
    return Table(caption, head, "ll" + "r" * len(fits), tuple(rows))


def _rank_sentences(evaluation: CampaignEvaluation) -> list[str]:
    """Return sentences on the weakest independent load, or on missing excitations."""
    sentences, fits = [], evaluation.matrices
    if fits:
        least = min(fits, key=lambda fit: float(fit.excitation.singular[-1]))
        lines, count = [fit.frequency_hz for fit in fits], len(fits)
        frequencies = f"At {count} frequencies from {number_text(min(lines), 6)} Hz to {number_text(max(lines), 6)} Hz"
        sentences.append(
            f"{frequencies if count > 1 else f'At {lines[0]:.6g} Hz'} the recordings excite six independent loads. The "
            f"weakest of them is {number_text(float(least.excitation.singular[-1]))} times its standard uncertainty at "
            f"{number_text(least.frequency_hz, 6)} Hz; a matrix needs {MIN_SINGULAR:g}."
        )
    return sentences + [notice.explanation for notice in evaluation.refused]


def repeats_table(evaluation: CampaignEvaluation) -> Table | None:
    """Return the scatter of recordings and mountings of one excitation, for the main output."""

    def expanded(found: RepeatMean) -> tuple[str, str]:
        """Return U of the mean in per cent, and its coverage factor."""
        channel = main_channel(evaluation, found.channels, found.component)
        ((element,),) = polar_elements(found.value[None, [channel]], found.uncertainty.at([channel]))
        if element is None:
            return DASH, DASH
        return small(100.0 * element.expanded_magnitude / element.magnitude), f"{element.k:.2f}"

    def percent(found: RepeatMean, share: FloatArray) -> str:
        """Return a standard deviation; a dash if it is not determined."""
        deviation = share[main_channel(evaluation, found.channels, found.component)]
        return DASH if not np.isfinite(deviation) else small(100.0 * deviation) if deviation > 0.0 else "0"

    columns: list[TableColumn[RepeatMean]] = [
        page_column("frequency / Hz", lambda found: f"{found.frequency_hz:.4f}"),
        page_column("load", lambda found: LOAD_COMPONENTS[found.component], "l"),
        page_column(
            "amplitude", lambda found: f"{number_text(found.amplitude, 4)} {typeset(LOAD_UNITS[found.component])}"
        ),
        page_column("recordings", lambda found: str(len(found.recordings))),
        page_column("mountings", lambda found: str(len(set(found.mountings)))),
        page_column("within / %", lambda found: percent(found, found.within)),
        page_column("between / %", lambda found: percent(found, found.between)),
        page_column("U of magnitude / %", lambda found: expanded(found)[0]),
        page_column("k", lambda found: expanded(found)[1]),
    ]
    caption = (
        "Repeats: relative standard deviation of a recording (within) and of a mounting (between) beyond their stated "
        "uncertainties, and U of the mean"
    )
    return table(caption, columns, evaluation.repeats)


def linearity_table(evaluation: CampaignEvaluation) -> Table | None:
    """Return the change of the sensitivity with amplitude, for the main output."""

    def change(found: Linearity) -> tuple[str, str, str]:
        """Return the change of magnitude and phase with U, and the verdict."""
        channel = main_channel(evaluation, found.channels, found.component)
        size, u = complex(found.change[channel]), polar(1.0 + 0.0j, found.covariance[channel], found.dof)
        magnitude = scaled_text(100.0 * size.real, 100.0 * u.expanded_magnitude, 0)
        turn = scaled_text(1e3 * size.imag, 1e3 * u.expanded_phase_rad, 0)
        return magnitude, turn, "linear within U" if found.linear[channel] else "not linear"

    def amplitudes(found: Linearity) -> str:
        low, high = float(np.min(found.amplitude)), float(np.max(found.amplitude))
        return f"{number_text(low, 4)} to {number_text(high, 4)} {typeset(LOAD_UNITS[found.component])}"

    columns: list[TableColumn[Linearity]] = [
        page_column("frequency / Hz", lambda found: f"{found.frequency_hz:.4f}"),
        page_column("load", lambda found: LOAD_COMPONENTS[found.component], "l"),
        page_column("amplitudes", amplitudes),
        page_column("recordings", lambda found: str(len(found.recordings))),
        page_column("kind", lambda found: found.kind, "l"),
        page_column("change of magnitude / %", lambda found: change(found)[0]),
        page_column("of phase / mrad", lambda found: change(found)[1]),
        page_column("verdict", lambda found: change(found)[2], "l"),
    ]
    caption = "Linearity: change of the sensitivity from the smallest to the largest amplitude, with U"
    return table(caption, columns, evaluation.linearity)


def unknowns_table(evaluation: CampaignEvaluation) -> Table | None:
    """Return the joint estimates of the unknowns of the rig, best ones first."""

    def value(found: JointUnknown) -> str:
        unit = "" if found.unit == "1" else found.unit
        return quantity_text(found.u * found.estimate, 2.0 * found.u * found.remaining, unit)

    columns: list[TableColumn[JointUnknown]] = [
        page_column("unknown", lambda found: found.name, "l"),
        page_column(
            "stated u",
            lambda found: f"{number_text(found.u, 2)} {'' if found.unit == '1' else typeset(found.unit)}".strip(),
        ),
        page_column("value by the campaign", value),
        page_column("u / u stated", lambda found: f"{found.remaining:.2f}"),
        page_column("contributing recordings", lambda found: str(found.recordings)),
        page_column("", lambda found: "as stated" if found.is_as_stated else "", "l"),
    ]
    caption = "Unknowns of the rig by all recordings: deviation from the stated values, with U (k = 2)"
    return table(caption, columns, sorted(evaluation.unknowns, key=lambda found: found.remaining)[:MOST_ROWS])


def _crosstalk_table(found: CrossTalk) -> Table:
    """Return the cross-talk at one frequency in per cent.

    An upper bound if a region includes zero.
    """
    rows = []
    for c, channel in enumerate(found.channels):
        cells: list[str] = [f"output {channel}"]
        for j in range(len(found.components)):
            size, half_axis = 100.0 * float(abs(found.value[c, j])), 100.0 * float(found.half_axis[c, j])
            if found.main[c] == j:
                cells.append("100")
            elif found.holds_zero[c, j]:
                cells.append(Markup("&lt; {}").format(number_text(size + half_axis, 2)))
            else:
                cells.append(scaled_text(size, half_axis, 0))
        rows.append(tuple(cells))
    caption = (
        f"Cross-talk at {found.frequency_hz:.6g} Hz in per cent of the rated output, ± half axis of its 95 % region"
    )
    return Table(caption, ("", *found.components), "l" + "r" * len(found.components), tuple(rows))


# report.html of a campaign: one self-contained page with its joint results.


def _heading(evaluation: CampaignEvaluation, best: Sequence[Sequence[CurvePoint]]) -> str:
    """Return what a campaign measured, empty without a result."""
    if evaluation.matrices:
        channels, count = len(evaluation.matrices[0].channels), len(evaluation.matrices)
        return f"{channels} × 6 matrix of sensitivities at {count_text(count, 'frequency')}"
    if not best:
        return ""
    loads = ", ".join(points[0].component for points in best)
    return f"Sensitivity to {loads} at {count_text(max(map(len, best)), 'frequency')}"


def render_campaign(evaluation: CampaignEvaluation) -> str:
    """Return the HTML text of the page.

    Style and figures are included, no other file is loaded.
    """
    mains = main_points(evaluation, curve_points(evaluation))
    ratios = [curve for curve in evaluation.curves if curve.kind == "ratio" and len(curve.channels) > 1]
    stated = None if evaluation.sensor is None else evaluation.sensor.stated_matrix
    # If there are elements, ratios are in the tables only.
    drawn = [
        [p for p in points if p.kind != "ratio" or all(other.kind != "element" for other in points)]
        for points in mains.values()
    ]
    singles = [draw_recordings(points, evaluation.curves, evaluation.excited_lines, stated) for points in drawn]
    best = [best_points(points) for points in mains.values()]
    gathered = gather([(entry.folder, entry.joint_notices) for entry in evaluation.recorded])
    listed = [notice for notice in gathered if notice.is_listed]
    tabulated = [notice.each[0][0] for notice in gathered if not notice.is_listed]
    frame = origin_frame(campaign_origin(evaluation.recorded), [*evaluation.notices, *tabulated])
    inputs: Table = frame["inputs"]
    if len(inputs.rows) > MOST_ROWS:
        what = f"{inputs.caption}: the first {MOST_ROWS} of {len(inputs.rows)}; {CAMPAIGN_FILE} has all"
        frame["inputs"] = replace(inputs, caption=what, rows=inputs.rows[:MOST_ROWS])
    of_recordings = [notice for notice in listed if notice.severity == "warning"]
    frame["notices"] = sorted([*frame["notices"], *of_recordings], key=lambda notice: notice.severity != "warning")
    context = {
        "name": evaluation.name,
        "heading": _heading(evaluation, best),
        "simulated": any(entry.simulated for entry in evaluation.recorded),
        "subject": _subject(evaluation),
        "headlines": headlines(evaluation, mains),
        "failed": len(evaluation.failed),
        "pictures": _main_pictures(evaluation, drawn, best),
        "budget": [figure for figure in [_main_budget(evaluation, best)] if figure],
        "curves": [draw_curve(points, evaluation.curves) for points in drawn] if len(drawn) > 1 else [],
        "singles": [figure for figure in singles if figure],
        "curve_tables": curve_tables(mains),
        "outputs": [draw_outputs(c, main_channel(evaluation, c.channels, c.elements[0][1])) for c in ratios],
        "maps": [figure for figure in [draw_crosstalk(evaluation.cross_talks)] if figure],
        "crosstalk": [_crosstalk_table(found) for found in evaluation.cross_talks],
        "rank": _rank_sentences(evaluation),
        "excitations": [figure for figure in [draw_excitation(evaluation.matrices)] if figure],
        "agreement": _agreement_table(evaluation),
        "repeats": repeats_table(evaluation),
        "linearity": linearity_table(evaluation),
        "unknowns": unknowns_table(evaluation),
        "recordings": recordings_table(evaluation),
        **_traceability(evaluation),
        "count": count_text(len(evaluation.recorded) + len(evaluation.failed), "recording"),
        "notes": listed[len(of_recordings) :],
        **frame,
    }
    return render_page("campaign.html", context)


def _main_pictures(
    evaluation: CampaignEvaluation, drawn: Sequence[Sequence[CurvePoint]], best: Sequence[Sequence[CurvePoint]]
) -> list[Figure]:
    """Return the figures of the first screen.

    These are the curve or all main elements, and the map of the largest cross-talk. `drawn`, `best`: points of every
    main element to draw, and those of the best kind.
    """
    figures = [draw_curve(drawn[0], evaluation.curves)] if len(drawn) == 1 else [draw_deviations(best)] if best else []
    largest = largest_crosstalk(evaluation)
    found = None if largest is None else draw_crosstalk([largest[0]])
    return figures if found is None else [*figures, replace(found, name="crosstalk-largest")]


def _main_budget(evaluation: CampaignEvaluation, best: Sequence[Sequence[CurvePoint]]) -> Figure | None:
    """Return the budget of the first value of the first main element."""
    first = next((points[0] for points in best if points), None)
    for curve in evaluation.curves:
        for e, (c, j) in enumerate(curve.elements):
            here = (curve.kind, curve.channels[c], LOAD_COMPONENTS[j])
            if first is None or here != (first.kind, first.channel, first.component):
                continue
            line = int(np.argmin(np.abs(curve.frequency_hz - first.frequency_hz)))
            entries = budget(curve.uncertainty.at([e]).at_lines([line]), curve.value[line, e].reshape(1, 1))
            name = result_name(first.kind, first.channel, first.component, main=True)
            return draw_contributions(entries, (0, 0), f"{name}, {first.frequency_hz:.4f} Hz")
    return None


def _page(evaluation: CampaignEvaluation, folders: Sequence[Path]) -> str:
    """Return the page of the campaign, or of its only recording."""
    own = folders[0] / REPORT_FILE
    if len(folders) > 1 or evaluation.failed or not own.is_file():
        return render_campaign(evaluation)
    return own.read_text(encoding="utf-8")


def _subject(evaluation: CampaignEvaluation) -> list[tuple[str, str]]:
    """Return sensor, rigs, recordings, mountings and frequencies."""
    facts, sensor, recorded = [], evaluation.sensor, evaluation.recorded
    if sensor is not None:
        facts.append(("Sensor", f"{sensor.name}, serial number {sensor.serial}" if sensor.serial else sensor.name))
    facts.append(("Rig", "; ".join(dict.fromkeys(entry.rig for entry in recorded))))
    count = f"{len(recorded)} evaluated"
    facts.append(("Recordings", f"{count}, {len(evaluation.failed)} failed" if evaluation.failed else count))
    facts.append(("Mountings", str(len({entry.mounting for entry in recorded}))))
    frequency = [drive.frequency_hz for entry in recorded for drive in entry.excited_lines]
    if frequency:
        ends = f"{number_text(min(frequency), 6)} Hz", f"{number_text(max(frequency), 6)} Hz"
        facts.append(("Frequencies", " to ".join(dict.fromkeys(ends))))
    return facts


# The joint files of a campaign: tables, curves, cross-talk, everything with its correlations, and the page.


def write_campaign(
    top: Path, name: str, folders: Sequence[Path], failed: Mapping[str, str]
) -> tuple[CampaignEvaluation, list[Path]]:
    """Write the joint files of a campaign into the folder `top`.

    Return its evaluation and their paths.

    `folders`: results folders of the evaluated recordings in the order of the tables. All data are read from them, so
    that equal results give equal files. `failed`: reasons by folder of the others. The files appear together, or none
    if results change while they are read.
    """
    inputs = InputFiles.without_hashes(folder / file for folder in folders for file in (*MERGED_FILES, RESULT_FILE))
    with ExitStack() as stack:
        with report_write_errors(top):
            store = DiskStore(stack.enter_context(TemporaryFile(dir=staging_dir(top))))
            entries = (read_recorded(folder) for folder in folders)
            recorded = [_stored_on_disk(entry, store) for entry in entries]
        evaluation = evaluate_campaign(name, recorded, failed, store.put)
        return evaluation, _write(top, evaluation, folders, inputs)


def _stored_on_disk(entry: RecordingResults, store: DiskStore) -> RecordingResults:
    """Return a recording whose large tables are on disk."""
    knowledge = None if entry.knowledge is None else store.store(entry.knowledge())
    return replace(entry, excited_lines=tuple(map(store.put, entry.excited_lines)), knowledge=knowledge)


def _write(top: Path, evaluation: CampaignEvaluation, folders: Sequence[Path], inputs: InputFiles) -> list[Path]:
    """Write the joint files together, unless inputs have changed."""

    def make(temporary: Path) -> list[str]:
        names = write_files(temporary, campaign_tables(evaluation, folders))
        names += write_files(temporary, {REPORT_FILE: _page(evaluation, folders)})
        return names + write_files(temporary, {CAMPAIGN_FILE: campaign_h5(evaluation, [*names, CAMPAIGN_FILE])})

    return write_together(top, make, lambda: CAMPAIGN_FILES, inputs.check)
