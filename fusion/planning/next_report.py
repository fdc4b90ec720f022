"""`shakercal plan --next`: results of a campaign in, proposed recordings out."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from itertools import cycle
from pathlib import Path
from typing import NamedTuple

import numpy as np

from fusion.campaign.joint_evaluation import CampaignEvaluation, evaluate_campaign, with_unique_names
from fusion.campaign.matrix import MatrixFit, main_components
from fusion.campaign.recording_results import read_recorded
from fusion.errors import InputError
from fusion.planning.next_recordings import (
    INTERNAL,
    WORTH,
    Candidate,
    Element,
    JointInformation,
    Minutes,
    Proposal,
    joint_information,
    list_candidates,
    propose,
)
from fusion.planning.planning_notices import NEXT_ELEMENT, NEXT_HOURS, NEXT_WITHOUT_MATRIX
from fusion.recording.load import RECORDING_NAME
from fusion.report.figure import COLOURS, GREY, empty_figure
from fusion.report.figure_files import render_figure
from fusion.report.folder import RESULT_FILE
from fusion.report.h5 import open_results
from fusion.report.table import TableColumn, csv_text, text_column
from fusion.report.terminal import print_table, print_text
from shaker.labels import LOAD_COMPONENTS
from shakercal._common.digits import DASH, number_text

HELPS = 0.95
"""Ratio of U after to U before above which recordings do not help."""


def plan_next(folder: Path, elements: Sequence[tuple[str, str]] | None, hours: float, minutes: Minutes) -> Proposal:
    """Return the recordings that lower U of elements most in some hours.

    `folder`: results of a campaign with a matrix. `elements`: output and load, by default the main ones. Raises
    `InputError` without a matrix, for an element that it lacks, and if no recording fits into the time.
    """
    folders = sorted(path.parent for path in folder.glob(f"*/{RESULT_FILE}"))
    if not folders:
        raise InputError(NEXT_WITHOUT_MATRIX, folder, "--next", found=_kind(folder), expected="results of a campaign")
    recorded = with_unique_names([read_recorded(one) for one in folders])
    evaluation = evaluate_campaign(folder.name, recorded, {})
    if not evaluation.matrices:
        found = f"{len(folders)} recordings without one"
        raise InputError(NEXT_WITHOUT_MATRIX, folder, "--next", found=found, expected="a campaign with a matrix")
    chosen, fits = _chosen(evaluation, elements)
    length_s = {one.name: _length_s(one) for one in folders}
    if not evaluation.unknowns:
        recorded = [replace(entry, knowledge=None) for entry in recorded]
    candidates = list_candidates(recorded, length_s, (), minutes)
    names = _exchangeable(joint_information(recorded, fits, chosen, candidates))
    candidates = list_candidates(recorded, length_s, names, minutes)
    least = min(one.minutes for one in candidates) / 60.0
    if hours < least:
        expected = f"at least {number_text(least, 2)} h, the shortest recording with its mounting"
        raise InputError(NEXT_HOURS, "--hours", found=f"{hours:g} h", expected=expected)
    return propose(chosen, candidates, joint_information(recorded, fits, chosen, candidates), 60.0 * hours)


def _kind(folder: Path) -> str:
    """Return what a folder without results of a campaign is."""
    if not folder.exists():
        return "no such folder"
    if folder.is_file():
        return "a file"
    if (folder / RESULT_FILE).is_file():
        return "results of one recording"
    if (folder / RECORDING_NAME).is_file():
        return "a recording"
    recordings = any(folder.glob(f"*/{RECORDING_NAME}"))
    return "recordings of a campaign, not its results" if recordings else "a folder without results"


def _chosen(
    evaluation: CampaignEvaluation, elements: Sequence[tuple[str, str]] | None
) -> tuple[list[Element], list[MatrixFit]]:
    """Return elements, and the matrices that have them."""
    first = evaluation.matrices[0]
    if elements is None:
        mains = main_components(first.value, first.load_size)
        elements = [(channel, LOAD_COMPONENTS[j]) for channel, j in zip(first.channels, mains, strict=True)]
    needed = {channel for channel, _ in elements}
    fits = [fit for fit in evaluation.matrices if needed <= set(fit.channels)]
    if not fits or not {load for _, load in elements} <= set(LOAD_COMPONENTS):
        expected = f"outputs of {', '.join(first.channels)} over loads of {', '.join(LOAD_COMPONENTS)}"
        found = ",".join("/".join(pair) for pair in elements)
        raise InputError(NEXT_ELEMENT, "--elements", found=found, expected=expected)
    return [(channel, LOAD_COMPONENTS.index(load)) for channel, load in elements], fits


def _length_s(folder: Path) -> float:
    """Return the length of the longest record of a recording."""
    with open_results(folder / RESULT_FILE, "channels") as file:
        records = [dict(group.attrs) for group in [*file["channels"].values()]]
    return max(float(one["samples"]) / float(one["sample_rate_hz"]) for one in records)


def _exchangeable(information: Sequence[JointInformation]) -> list[str]:
    """Return masses and instruments with a share of a variance that is worth an exchange."""
    largest: dict[str, float] = {}
    for one in information:
        for name, share in one.shares(np.zeros(len(one.added)), 0).items():
            largest[name] = max(largest.get(name, 0.0), float(share.max()))
    return [name for name, share in largest.items() if share > WORTH and name and not name.startswith(INTERNAL)]


# Table, figure and text.


class Prediction(NamedTuple):
    """Relative U of the magnitude of one element at one frequency, after some recordings.

    `now`, `then`, `limit`: present, predicted, and with endless repeats. `influence`: largest common one, with its
    share of the variance, and U with half its u.
    """

    step: int
    hours: float
    candidate: Candidate | None
    element: str
    frequency_hz: float
    now: float
    then: float
    limit: float
    influence: str
    share: float
    halved: float


def predictions(proposal: Proposal, step: int) -> list[Prediction]:
    """Return all elements at all frequencies after some recordings."""
    counts, ratios, limits, found = proposal.counts(step), proposal.ratios(step), proposal.repeated, []
    done = [proposal.candidates[q] for q in proposal.chosen[:step]]
    for f, information in enumerate(proposal.information):
        labels, variance = information.shares(counts, 1), information.variance(counts)
        for e, (channel, load) in enumerate(proposal.elements):
            now = information.present[e].expanded_magnitude / information.present[e].magnitude
            then = now * float(ratios[f, e])
            label = max(labels, key=lambda one: float(labels[one][e]), default=DASH)
            less = float(np.sqrt(information.halved(counts, label)[e] / variance[e]))
            where = f"{channel}/{LOAD_COMPONENTS[load]}", information.frequency_hz
            limit, share = now * float(limits[f, e]), float(labels[label][e]) if labels else 0.0
            last, hours = done[-1] if done else None, sum(one.minutes for one in done) / 60.0
            found.append(Prediction(step, hours, last, *where, now, then, limit, label, share, then * less))
    return found


def _percent(name: str, head: str, value: Callable[[Prediction], float]) -> TableColumn[Prediction]:
    """Return the column of a ratio, shown in per cent with three digits."""

    def shown(row: Prediction) -> str:
        text = f"{100.0 * value(row):#.3g}".removesuffix(".")
        return text if "e" not in text else number_text(100.0 * value(row), 3)

    return TableColumn(name, value, f"{head} / %", shown)


COLUMNS: list[TableColumn[Prediction]] = [
    TableColumn("step", lambda row: row.step),
    TableColumn("hours", lambda row: row.hours),
    TableColumn("recording", lambda row: row.candidate and row.candidate.folder),
    TableColumn("change", lambda row: row.candidate and row.candidate.change),
    text_column("element", lambda row: row.element, "element"),
    TableColumn("frequency_hz", lambda row: row.frequency_hz, "f / Hz", lambda row: f"{row.frequency_hz:.2f}"),
    _percent("U_now_relative", "U now", lambda row: row.now),
    _percent("U_then_relative", "then", lambda row: row.then),
    _percent("U_limit_relative", "limit", lambda row: row.limit),
    text_column("common_influence", lambda row: row.influence, "largest common influence"),
    _percent("share", "share", lambda row: row.share),
    _percent("U_halved_relative", "halved", lambda row: row.halved),
]


def next_csv(proposal: Proposal) -> str:
    """Return the predictions after every recording; step 0 is the present campaign."""
    return csv_text(COLUMNS, (row for step in range(len(proposal.chosen) + 1) for row in predictions(proposal, step)))


def print_next(proposal: Proposal) -> None:
    """Print proposed recordings, predicted U, and what limits it to stdout."""
    steps = [predictions(proposal, step)[0] for step in range(1, len(proposal.chosen) + 1)]
    rows = [
        [str(row.step), one.folder, one.change or "the same again", f"{row.hours:.2f}",
         f"{float(np.mean(proposal.ratios(row.step))):.3f}"]
        for row in steps
        if (one := row.candidate) is not None
    ]  # fmt: skip
    if rows:
        print_table("Next recordings", ["", "recording", "mounted anew", "hours", "U / now"], "rllrr", [rows])
    else:
        print_text("No further recording of these set-ups lowers U noticeably.")
    last, count = predictions(proposal, len(rows)), len(proposal.elements)
    worst = [max(last[e::count], key=lambda row: row.then) for e in range(count)]
    shown = [column for column in COLUMNS if column.head is not None]
    heads, align = [column.head or "" for column in shown], "".join(column.align for column in shown)
    cells = [[column.cell(row) for column in shown] for row in worst]
    print_table("Elements, each at the frequency of its largest U", heads, align, [cells])
    for row in worst:
        if row.then > HELPS * row.now:
            print_text(
                f"{row.element}: these recordings lower U by less than {100.0 * (1.0 - HELPS):.0f} %. {row.influence} "
                f"has {100.0 * row.share:.0f} % of the variance; half its u lowers U by "
                f"{100.0 * (1.0 - row.halved / row.then):.0f} %."
            )
    print_text(
        "U / now: mean of predicted over present U; then: after these recordings; limit: with endless repeats of all, "
        "with the present instruments; halved: then, with half the u of the largest common influence"
    )


def draw_next(proposal: Proposal, kind: str) -> bytes:
    """Draw the predicted U of every element over the time, mean of the frequencies.

    `kind` is the file format: png, svg or pdf.
    """
    drawn, steps = empty_figure("next", 3.0), range(len(proposal.chosen) + 1)
    (panel,) = drawn.panels
    hours = [predictions(proposal, step)[0].hours for step in steps]
    ratios = np.array([np.mean(proposal.ratios(step), axis=0) for step in steps])
    limits, names = np.mean(proposal.repeated, axis=0), [row.element for row in predictions(proposal, 0)]
    for e, (limit, colour) in enumerate(zip(limits, cycle(COLOURS), strict=False)):
        panel.line(hours, ratios[:, e], names[e], colour=colour)
        panel.points(hours, ratios[:, e], colour=colour, size=3.5)
        panel.rule(limit, colour=colour, dashed=True, width=0.6)
    panel.rule(np.nan, "endless repeats, present instruments", colour=GREY, dashed=True, width=0.6)
    panel.x.label, panel.y.label, panel.y.limits = "time / h", "U over present U", (0.0, 1.05)
    return render_figure(drawn.with_title("Next recordings", "Predicted U over the time."), kind)
