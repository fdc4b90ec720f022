"""Files, page and printed lines of a comparison, and the command."""

from __future__ import annotations

import os
from collections.abc import Iterator, Sequence
from datetime import date as Date
from itertools import combinations
from pathlib import Path
from typing import Any, NamedTuple

import h5py
import numpy as np

from fusion.base import count_text
from fusion.errors import InputError
from fusion.report.figure import COLOURS, GREY, RED, Figure, empty_figure, frequency_axis, padded_limits
from fusion.report.folder import CommandReport, hash_files
from fusion.report.h5 import write_value
from fusion.report.table import Headline, TableColumn, csv_text, finite_or_none, page_column, table, text_column
from fusion.sensor.compare import draft_report
from fusion.sensor.compare.comparison_evaluation import (
    PROCEDURE_A,
    ComparedQuantity,
    ComparisonEvaluation,
    ComparisonMethod,
    evaluate_comparison,
)
from fusion.sensor.compare.comparison_inputs import QUERY, ComparedResult, read_compared, result_files, split_query
from fusion.sensor.compare.consistency import SharedInput, list_titles
from fusion.sensor.compare.linking import Participant
from fusion.sensor.result_notices import WRONG_COMPARISON_OPTION
from shakercal._common.digits import number_text, quantity_text, signed_text, small


class ResultRow(NamedTuple):
    """One result in one comparison."""

    of: ComparedQuantity
    result: int


def rows(evaluation: ComparisonEvaluation) -> Iterator[ResultRow]:
    """Yield every result of every comparison."""
    yield from (ResultRow(found, result) for found in evaluation.quantities for result in range(len(found.names)))


def _complex_largest(found: ComparedQuantity, result: int) -> float | None:
    """Return the largest E_n of complex values of a result's pairs, None without any."""
    pairs = None if found.complex_normalised is None else np.delete(found.complex_normalised[result], result)
    return None if pairs is None or not np.isfinite(pairs).any() else float(np.nanmax(pairs))


COMPARISON: list[TableColumn[ResultRow]] = [
    TableColumn("frequency_hz", lambda row: row.of.frequency_hz),
    text_column("channel", lambda row: row.of.channel),
    text_column("component", lambda row: row.of.component),
    text_column("quantity", lambda row: row.of.quantity),
    text_column("result", lambda row: row.of.names[row.result]),
    TableColumn("value", lambda row: row.of.value[row.result]),
    TableColumn("u", lambda row: row.of.u[row.result]),
    text_column("unit", lambda row: row.of.unit),
    TableColumn("reference", lambda row: finite_or_none(row.of.reference.value)),
    TableColumn("u_reference", lambda row: finite_or_none(row.of.reference.u)),
    TableColumn("deviation", lambda row: finite_or_none(row.of.reference.deviation[row.result])),
    TableColumn("U_deviation", lambda row: finite_or_none(row.of.reference.expanded[row.result])),
    TableColumn("E_n", lambda row: finite_or_none(row.of.reference.normalised[row.result])),
    TableColumn("E_n_largest_pair", lambda row: np.abs(row.of.normalised[row.result]).max()),
    text_column("in_reference", lambda row: "yes" if row.of.reference.used[row.result] else "no"),
    TableColumn("chi_squared", lambda row: finite_or_none(row.of.reference.chi_squared)),
    TableColumn("chi_squared_dof", lambda row: row.of.reference.dof),
    TableColumn("p", lambda row: row.of.reference.p),
    TableColumn("per_year", lambda row: row.of.per_year),
    TableColumn("u_per_year", lambda row: row.of.u_per_year),
    TableColumn("E_n_complex_largest_pair", lambda row: _complex_largest(row.of, row.result)),
    text_column(
        "shared", lambda row: "; ".join(list_titles(s for s in row.of.shared if row.of.names[row.result] in s.unknowns))
    ),
    text_column("sign_changed", lambda row: "yes" if row.of.names[row.result] in row.of.opposite_sign else "no"),
]


def _main(evaluation: ComparisonEvaluation) -> list[ComparedQuantity]:
    return [found for found in evaluation.quantities if found.channel == found.component] or list(evaluation.quantities)


def draw_normalised(evaluation: ComparisonEvaluation) -> Figure:
    """Draw E_n of every result relative to the reference value over frequency."""
    drawn = empty_figure("normalised", 4.6, 2)
    ends = np.array([found.frequency_hz for found in _main(evaluation)])
    for panel, quantity in zip(drawn.panels, ("magnitude", "phase"), strict=True):
        of_quantity = [found for found in _main(evaluation) if found.quantity == quantity]
        panel.span(-1.0, 1.0, "covered by U", colour=GREY)
        for index, name in enumerate(evaluation.laboratories):
            of_result = [found for found in of_quantity if name in found.names]
            if of_result:
                x = np.array([f.frequency_hz for f in of_result])
                y = np.array([f.reference.normalised[f.names.index(name)] for f in of_result])
                panel.points(x, y, name, colour=COLOURS[index % len(COLOURS)], size=4.0)
        panel.rule([-1.0, 1.0], "limits ±1", colour=RED, dashed=True, width=1.0)
        normalised = [found.reference.normalised for found in of_quantity]
        reach = float(np.nanmax(np.abs(np.concatenate([[1.0], *normalised]))))
        panel.y.limits = (-1.15 * reach, 1.15 * reach)
        panel.y.label = f"E_n of {quantity}"
        frequency_axis(panel.x, np.array([0.95 * ends.min(), 1.05 * ends.max()]))
    drawn.panels[0].x.label = ""
    text = "Deviation from the reference value over its expanded uncertainty; within the band U covers it."
    return drawn.with_title("Deviations from the reference value", text)


def _largest_text(found: ComparedQuantity) -> str:
    largest = (_complex_largest(found, n) for n in range(len(found.names)))
    every = [value for value in largest if value is not None]
    return signed_text(max(every)) if every else "–"


DRIFT = "drift per year ± U"
IN_FILE = ("frequency_hz", "channel", "component", "quantity", "unit", "names", "value", "u")
MAX_CHARTS, MAX_LINES = 6, 6
"""Elements of which the page has a chart, and frequencies in one of them."""


def draw_charts(evaluation: ComparisonEvaluation) -> list[Figure]:
    """Draw control charts of every element: deviations over the years, with U."""
    dated: dict[tuple[str, str], list[ComparedQuantity]] = {}
    for found in _main(evaluation):
        if len(np.unique(found.year[np.isfinite(found.year)])) > 1:
            dated.setdefault((found.channel, found.component), []).append(found)
    return [_chart(element, quantities) for element, quantities in list(dated.items())[:MAX_CHARTS]]


def _chart(element: tuple[str, str], quantities: Sequence[ComparedQuantity]) -> Figure:
    """Draw magnitude and phase of one element over the years."""
    channel, component = element
    span = float(np.ptp([year for found in quantities for year in found.year[np.isfinite(found.year)]]))
    drawn = empty_figure(f"chart-{channel}-{component}", 4.6, 2)
    for panel, quantity in zip(drawn.panels, ("magnitude", "phase"), strict=True):
        lines = [found for found in quantities if found.quantity == quantity]
        chosen = np.unique(np.linspace(0, len(lines) - 1, min(len(lines), MAX_LINES)).astype(int))
        reach = []
        for index, line in enumerate([lines[n] for n in chosen]):
            factor = 100.0 / abs(line.centre) if quantity == "magnitude" else 1e3
            label, colour = f"{number_text(line.frequency_hz, 5)} Hz", COLOURS[index % len(COLOURS)]
            dates = line.year + 0.006 * index * span
            deviation, expanded = factor * (line.value - line.centre), 2.0 * factor * line.u
            if line.reference.used.any():
                low, high = (factor * (end - line.centre) for end in line.reference.interval)
                panel.span(low, high, label, colour=colour, opacity=0.08)  # bands overlap
            panel.points(dates, deviation, label, half_y=expanded, colour=colour, size=4.0, names=tuple(line.names))
            reach += [deviation + expanded, deviation - expanded]
        panel.rule(0.0, colour=GREY)
        panel.y.label = "magnitude / %" if quantity == "magnitude" else "phase / mrad"
        if reach:
            every = np.concatenate(reach)
            panel.y.limits = padded_limits(float(np.nanmin(every)), float(np.nanmax(every)))
    drawn.panels[-1].x.label = "year"
    text = (
        "Deviation of every dated result from the reference value with its U (k = 2), in relative terms of the "
        "magnitude; the bands are U of the reference values. If results contradict each other, there is none, and "
        "deviations are from their weighted mean. Frequencies are shifted for legibility."
    )
    return drawn.with_title(f"Control chart of {channel} per {component}", text, main=True)


def largest_share(evaluation: ComparisonEvaluation, title: str) -> float:
    """Return the largest share of a variance of the shared inputs of a title."""
    every = [(found, [item.title == title for item in found.shared]) for found in evaluation.quantities]
    return float(max(np.sum((found.effects[chosen] / found.u) ** 2, axis=0).max() for found, chosen in every))


def _named(items: Sequence[SharedInput]) -> str:
    """Return the names of an input in each result, and how many components follow."""
    names = "; ".join(f"{name}: {unknown}" for name, unknown in items[0].unknowns.items())
    return names if len(items) == 1 else f"{names} and {len(items) - 1} more"


def _reference_text(found: ComparedQuantity) -> str:
    reference = found.reference
    if not reference.used.any():
        return "none, results are contradictory"
    return quantity_text(reference.value, reference.expanded_value, found.unit)


def _left_out(found: ComparedQuantity) -> str:
    rounds = [Participant.of(name).round for name in found.names]
    entries = zip(found.names, rounds, found.reference.used, strict=True)
    return ", ".join(name for name, of, used in entries if of == rounds[0] and not used) or "none"


def _source(result: ComparedResult) -> str:
    repeats = "" if result.repeats == 1 else f", up to {result.repeats} repeats at a frequency averaged"
    return f"{result.name} ({result.file}{repeats})"


def _context(evaluation: ComparisonEvaluation) -> dict[str, Any]:
    columns: list[TableColumn[ComparedQuantity]] = [
        page_column("element", lambda f: f"{f.channel} per {f.component}", "l"),
        page_column("quantity", lambda f: f.quantity, "l"),
        page_column("frequency / Hz", lambda f: f"{f.frequency_hz:.4f}"),
        page_column("results", lambda f: str(len(f.names))),
        page_column("reference ± U", _reference_text),
        page_column("p of consistency", lambda f: f"{f.reference.p:.3f}"),
        page_column("left out", _left_out, "l"),
    ]
    largest = [
        *columns[:3],
        page_column("largest E_n of a pair", lambda f: signed_text(f.largest)),
        page_column("of complex values", _largest_text),
    ]
    changes: list[TableColumn[ComparedQuantity]] = [
        *columns[:3],
        page_column(DRIFT, lambda f: quantity_text(f.per_year or 0.0, 2.0 * (f.u_per_year or 0.0), f.unit)),
    ]
    titles: dict[str, list[SharedInput]] = {}
    for item in evaluation.shared:
        titles.setdefault(item.title, []).append(item)
    common: list[TableColumn[str]] = [
        page_column("input (evidence)", lambda title: title, "l"),
        page_column("unknown in each result", lambda title: _named(titles[title]), "l"),
        page_column("largest share of a variance / %", lambda title: small(100.0 * largest_share(evaluation, title))),
    ]
    single: list[TableColumn[Any]] = [
        page_column("result", lambda entry: entry[0], "l"),
        *draft_report.element_columns(lambda entry: entry[1]),
    ]
    dated = [found for found in evaluation.quantities if found.per_year is not None]
    (judged,) = verdict(evaluation)
    return {
        "subject": [("Results", ", ".join(map(_source, evaluation.results)))],
        "contradiction": f"{judged.label}: {judged.value}." if judged.label == DIFFER else "",
        "reference": table("Reference values, U: k = 2", columns, evaluation.quantities),
        "figures": [draft_report.draw_equivalence(evaluation, _main(evaluation))],
        "conclusions": draft_report.conclusions(evaluation),
        "participants": draft_report.participants(evaluation),
        "artefact": draft_report.artefact(evaluation),
        "linked": bool(evaluation.links),
        "stated": draft_report.stated(evaluation),
        "median": evaluation.method.reference == "median",
        "equivalence": draft_report.equivalence(evaluation),
        "pairs": draft_report.pairs(evaluation),
        "consistency": [draw_normalised(evaluation)],
        "largest": table("Largest E_n of pairs", largest, evaluation.quantities),
        "charts": draw_charts(evaluation),
        "shared": table("Shared inputs", common, list(titles)),
        "drift": table("Drift, U: k = 2", changes, dated),
        "alone": table("Not compared", single, evaluation.unmatched),
    }


DIFFER = "Results differ"


def verdict(evaluation: ComparisonEvaluation) -> list[Headline]:
    """Return whether the results agree, and the largest difference over its U."""
    found = evaluation.quantities
    above = sum(one.largest > 1.0 for one in found)
    worst = max(found, key=lambda one: one.largest)
    pairs = list(combinations(range(len(worst.names)), 2))
    first, second = max(pairs, key=lambda pair: abs(float(worst.normalised[pair])))
    value = f"U covers all {len(found)} values" if not above else f"U does not cover {above} of {len(found)} values"
    size = f"largest |E_n| of a pair {signed_text(worst.largest)}: {worst.names[first]} and {worst.names[second]}"
    what = f"{worst.quantity} of {worst.channel} per {worst.component}, {worst.frequency_hz:.4f} Hz"
    return [Headline("Results agree" if not above else DIFFER, value, f"{size}, {what}")]


def printed(evaluation: ComparisonEvaluation) -> Iterator[str]:
    """Yield the printed lines."""
    for line in verdict(evaluation):
        yield f"{line.label}: {line.value} ({line.remark})"
    for quantity in ("magnitude", "phase"):
        of_quantity = [found for found in evaluation.quantities if found.quantity == quantity]
        if of_quantity:
            above = sum(found.largest > 1.0 for found in of_quantity)
            left = sum(_left_out(found) != "none" for found in of_quantity)
            counts = f"|E_n| of a pair above 1 at {above}, not consistent at {left}"
            opposite_sign = dict.fromkeys(name for found in of_quantity for name in found.opposite_sign)
            if opposite_sign and quantity == "phase":
                counts += f"; sign (180°) of {', '.join(opposite_sign)} changed"
            yield f"{quantity}: {count_text(len(of_quantity), 'value')} compared, {counts}"
    if evaluation.shared:
        yield f"shared inputs: {'; '.join(list_titles(evaluation.shared))}"
    if evaluation.unmatched:
        yield f"{len(evaluation.unmatched)} values without a partner"


def _fill(file: h5py.File, evaluation: ComparisonEvaluation) -> None:
    """Fill the HDF5 file with every comparison."""
    for number, found in enumerate(evaluation.quantities):
        group = file.create_group(f"comparison/{number}")
        for name in (*IN_FILE, "covariance", "normalised", "year"):
            write_value(group, name, getattr(found, name))
        for name, matrix in zip(("difference", "U_difference"), found.differences, strict=True):
            write_value(group, name, matrix)
        write_value(group, "reference_interval", np.array(found.reference.interval))
        write_value(group, "shared", list_titles(found.shared))
        if found.complex_normalised is not None:
            write_value(group, "complex_normalised", found.complex_normalised)


COMPARE = CommandReport(
    "compare",
    "comparison",
    ("comparison.csv",),
    lambda evaluation: {"comparison.csv": csv_text(COMPARISON, rows(evaluation))},
    _fill,
    _context,
    printed,
    headlines=verdict,
)


def run_compare(
    inputs: Sequence[str],
    output: Path | None,
    dates: Sequence[str] = (),
    tolerance: float = 1e-3,
    columns: Path | None = None,
    method: ComparisonMethod = PROCEDURE_A,
    *,
    force: bool = False,
) -> None:
    """Compare results, each `PATH` or `[ROUND/]NAME[@DATE]=PATH`; write results and print the summary.

    `dates` are `NAME=YYYY-MM-DD`. `columns` is a file with the columns of tables of others.
    """
    named: dict[str, Path] = {}
    for text in inputs:
        first, equals, rest = text.partition("=")
        named_result = equals and QUERY not in first
        path = Path(rest if named_result else text)
        name = first if named_result else split_query(path)[0].stem
        if not name or name in named:
            raise InputError(WRONG_COMPARISON_OPTION, path, found=name, expected="NAME=PATH with unique names")
        named[name] = path
    days: dict[str, Date] = {}
    stated = [f"{name}={Participant.of(name).day}" for name in named if Participant.of(name).day]
    for text in (*stated, *dates):
        name, _, day = text.partition("=")
        if name not in named:
            expected = f"one of the names {', '.join(named)}"
            raise InputError(WRONG_COMPARISON_OPTION, "--date", name, found=text, expected=expected)
        try:
            days[name] = Date.fromisoformat(day)
        except ValueError as error:
            expected = "a day as YYYY-MM-DD"
            raise InputError(WRONG_COMPARISON_OPTION, "--date", name, found=day, expected=expected) from error
    results = read_compared(named, columns)
    days = {result.name: result.date for result in results if result.date is not None} | days
    inputs_read = [file for path in named.values() for file in result_files(path)]
    inputs_read += [] if columns is None else [columns]
    root = Path(os.path.commonpath([file.resolve().parent for file in inputs_read]))
    files = hash_files(inputs_read, root)
    folder = Path("comparison") if output is None else output
    COMPARE.run(
        files, folder, lambda hashes: evaluate_comparison(results, days, tolerance, hashes, method), force=force
    )
