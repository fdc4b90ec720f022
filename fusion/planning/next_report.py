"""`shakercal plan --next`: results of a campaign in, proposed recordings out."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import cycle
from pathlib import Path

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
from fusion.report.figure import COLOURS, empty_figure
from fusion.report.figure_files import render_figure
from fusion.report.folder import RESULT_FILE
from fusion.report.h5 import open_results
from fusion.report.table import TableColumn, csv_text, page_column, text_column
from fusion.report.terminal import print_table, print_text
from shaker.labels import LOAD_COMPONENTS, sensitivity_unit
from shakercal._common.digits import DASH, number_text

HELPS = 0.95
"""Ratio of U after to U before above which recordings do not help."""


@dataclass(frozen=True)
class NextPlan:
    """Proposed recordings of a campaign. `unit`: of the outputs; `hours`: available."""

    campaign: str
    unit: str
    hours: float
    proposal: Proposal


def plan_next(folder: Path, elements: Sequence[tuple[str, str]] | None, hours: float, minutes: Minutes) -> NextPlan:
    """Return the recordings that lower U of elements (output, load; by default the main ones) most in some hours.

    `folder`: results of a campaign with a matrix. Raises `InputError` without one, for an element that it lacks, and
    if no recording fits into the time.
    """
    folders = sorted(path.parent for path in folder.glob(f"*/{RESULT_FILE}"))
    recorded = with_unique_names([read_recorded(one) for one in folders])
    evaluation = evaluate_campaign(folder.name, recorded, {})
    if not evaluation.matrices:
        found = f"{len(folders)} recordings without one"
        raise InputError(NEXT_WITHOUT_MATRIX, folder, "--next", found=found, expected="a campaign with a matrix")
    chosen, fits = _chosen(evaluation, elements)
    length_s = {one.name: _length_s(one) for one in folders}
    joint, names = bool(evaluation.unknowns), list[str]()
    candidates = list_candidates(recorded, length_s, names, minutes)
    least = min(one.minutes for one in candidates)
    if hours * 60.0 < least:
        expected = f"at least {number_text(least / 60.0, 2)} h, the shortest recording with its mounting"
        raise InputError(NEXT_HOURS, "--hours", found=f"{hours:g} h", expected=expected)
    information = joint_information(recorded, fits, chosen, candidates, joint=joint)
    names = _exchangeable(information)
    if names:
        candidates = list_candidates(recorded, length_s, names, minutes)
        information = joint_information(recorded, fits, chosen, candidates, joint=joint)
    unit = "" if evaluation.sensor is None else evaluation.sensor.unit
    return NextPlan(folder.name, unit, hours, propose(chosen, candidates, information, 60.0 * hours))


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


@dataclass(frozen=True)
class _Point:
    """One element at one frequency, after some of the proposed recordings."""

    plan: NextPlan
    step: int
    frequency: int
    element: int

    @property
    def candidate(self) -> Candidate | None:
        """The last recording, None for the present campaign."""
        proposal = self.plan.proposal
        return proposal.candidates[proposal.chosen[self.step - 1]] if self.step else None

    @property
    def hours(self) -> float:
        """Time of all recordings so far."""
        proposal = self.plan.proposal
        return sum(proposal.candidates[q].minutes for q in proposal.chosen[: self.step]) / 60.0

    @property
    def at(self) -> JointInformation:
        """Information at the frequency."""
        return self.plan.proposal.information[self.frequency]

    @property
    def name(self) -> str:
        """Output and load."""
        channel, load = self.plan.proposal.elements[self.element]
        return f"{channel}/{LOAD_COMPONENTS[load]}"

    @property
    def magnitude(self) -> float:
        """Magnitude of the element."""
        return self.at.present[self.element].magnitude

    @property
    def expanded_now(self) -> float:
        """Present U of the magnitude."""
        return self.at.present[self.element].expanded_magnitude

    @property
    def expanded(self) -> float:
        """Predicted U of the magnitude, with the present coverage factor."""
        return self.expanded_now * float(self.plan.proposal.ratios(self.step)[self.frequency, self.element])

    @property
    def limit(self) -> float:
        """U that no number of repeats reduces further."""
        return self.expanded_now * float(self.plan.proposal.repeated[self.frequency, self.element])

    @property
    def largest(self) -> tuple[str, float, float]:
        """Largest common influence: label, share of the variance, and U with half its u."""
        counts = self.plan.proposal.counts(self.step)
        shares = {label: share[self.element] for label, share in self.at.shares(counts, 1).items()}
        if not shares:
            return DASH, 0.0, self.expanded
        label = max(shares, key=lambda one: float(shares[one]))
        less = self.at.halved(counts, label)[self.element] / self.at.variance(counts)[self.element]
        return label, float(shares[label]), self.expanded * float(np.sqrt(less))

    @property
    def unit(self) -> str:
        """Unit of the element."""
        return sensitivity_unit(self.plan.unit, LOAD_COMPONENTS[self.plan.proposal.elements[self.element][1]])

    def percent(self, expanded: float) -> str:
        """Return U as a percentage of the magnitude."""
        return number_text(100.0 * expanded / self.magnitude, 3)


def _points(plan: NextPlan, step: int) -> list[_Point]:
    """Return all elements at all frequencies after some recordings."""
    shape = len(plan.proposal.information), len(plan.proposal.elements)
    return [_Point(plan, step, f, e) for f, e in np.ndindex(shape)]


COLUMNS: list[TableColumn[_Point]] = [
    TableColumn("step", lambda point: point.step),
    TableColumn("hours", lambda point: point.hours),
    TableColumn("recording", lambda point: point.candidate and point.candidate.folder),
    TableColumn("change", lambda point: point.candidate and point.candidate.change),
    page_column("element", lambda point: point.name, "l"),
    TableColumn("channel", lambda point: point.name.partition("/")[0]),
    TableColumn("component", lambda point: point.name.partition("/")[2]),
    TableColumn("frequency_hz", lambda point: point.at.frequency_hz, "f / Hz", lambda p: f"{p.at.frequency_hz:.2f}"),
    TableColumn("magnitude", lambda point: point.magnitude),
    TableColumn("U_now", lambda point: point.expanded_now, "U now / %", lambda p: p.percent(p.expanded_now)),
    TableColumn("U_predicted", lambda point: point.expanded, "then / %", lambda p: p.percent(p.expanded)),
    TableColumn("U_limit", lambda point: point.limit, "limit / %", lambda p: p.percent(p.limit)),
    TableColumn("unit", lambda point: point.unit),
    text_column("common_influence", lambda point: point.largest[0], "largest common influence"),
    TableColumn("share", lambda point: point.largest[1], "share / %", lambda p: f"{100.0 * p.largest[1]:.0f}"),
    TableColumn("U_halved", lambda point: point.largest[2], "halved / %", lambda p: p.percent(p.largest[2])),
]


def next_csv(plan: NextPlan) -> str:
    """Return the prediction after every recording, by element and frequency; step 0 is the present campaign."""
    steps = range(len(plan.proposal.chosen) + 1)
    return csv_text(COLUMNS, (point for step in steps for point in _points(plan, step)))


def print_next(plan: NextPlan) -> None:
    """Print proposed recordings, predicted U, and what limits it to stdout."""
    proposal = plan.proposal
    rows = []
    for step, chosen in enumerate(proposal.chosen, 1):
        one, hours = proposal.candidates[chosen], _Point(plan, step, 0, 0).hours
        ratio = f"{float(np.mean(proposal.ratios(step))):.3f}"
        rows.append([str(step), one.folder, one.change or "the same again", f"{hours:.2f}", ratio])
    if rows:
        head = ["", "recording", "mounted anew", "hours", "U / now"]
        print_table(f"Next recordings of {plan.campaign}, {plan.hours:g} h", head, "rllrr", [rows])
    else:
        print_text("No further recording of these set-ups lowers U noticeably.")
    last = _points(plan, len(rows))
    worst = [
        max((point for point in last if point.element == e), key=lambda point: point.expanded / point.magnitude)
        for e in range(len(proposal.elements))
    ]
    shown = [column for column in COLUMNS if column.head is not None]
    align = "".join(column.align for column in shown)
    cells = [[column.cell(point) for column in shown] for point in worst]
    print_table("Elements, each at the frequency of its largest U", [c.head or "" for c in shown], align, [cells])
    for point in worst:
        if point.expanded > HELPS * point.expanded_now:
            label, share, halved = point.largest
            print_text(
                f"{point.name}: these recordings lower U by less than {100.0 * (1.0 - HELPS):.0f} %. {label} has "
                f"{100.0 * share:.0f} % of the variance; half its u lowers U by "
                f"{100.0 * (1.0 - halved / point.expanded):.0f} %."
            )
    print_text(
        "U / now: mean of predicted over present U; then: after these recordings; limit: with endless repeats of all; "
        "halved: then, with half the u of the largest common influence"
    )


def draw_next(plan: NextPlan, kind: str) -> bytes:
    """Draw the predicted U of every element over the time, mean of the frequencies.

    `kind` is the file format: png, svg or pdf.
    """
    drawn, proposal = empty_figure("next", 3.0), plan.proposal
    steps, (panel,) = range(len(proposal.chosen) + 1), drawn.panels
    hours = np.array([_Point(plan, step, 0, 0).hours for step in steps])
    ratios = np.array([np.mean(proposal.ratios(step), axis=0) for step in steps])
    limits = np.mean(proposal.repeated, axis=0)
    for e, (point, colour) in enumerate(zip(_points(plan, 0), cycle(COLOURS), strict=False)):
        if e < len(proposal.elements):
            panel.line(hours, ratios[:, e], point.name, colour=colour)
            panel.points(hours, ratios[:, e], colour=colour, size=3.5)
            panel.rule(limits[e], "endless repeats", colour=colour, dashed=True, width=0.6)
    panel.x.label, panel.y.label = "time / h", "U over present U"
    panel.y.limits = (0.0, 1.05)
    return render_figure(drawn.with_title("Next recordings", "Predicted U over the time."), kind)
