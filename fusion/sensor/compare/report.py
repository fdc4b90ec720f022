"""The comparison's table, page and command."""

from __future__ import annotations

import os
from collections.abc import Iterator, Sequence
from datetime import date as Date
from pathlib import Path
from typing import Any, NamedTuple

import h5py
import numpy as np

from fusion.base import InputError
from fusion.report.folder import Command, hash_files
from fusion.report.h5 import write_value
from fusion.report.style import COLOURS, GREY, Picture, frequency_axis, sheet
from fusion.report.table import Column, csv_text, known, measured, on_page, signed, table, word
from fusion.sensor.compare.evaluate import Compared, ComparisonEvaluation, evaluate_comparison
from fusion.sensor.compare.read import read_result, result_file


class Row(NamedTuple):
    """One result in one comparison."""

    of: Compared
    place: int


def rows(evaluation: ComparisonEvaluation) -> Iterator[Row]:
    """Yield every result of every comparison."""
    yield from (Row(found, place) for found in evaluation.compared for place in range(len(found.names)))


COMPARISON: list[Column[Row]] = [
    Column("frequency_hz", lambda row: row.of.frequency_hz),
    word("channel", lambda row: row.of.channel),
    word("component", lambda row: row.of.component),
    word("quantity", lambda row: row.of.quantity),
    word("result", lambda row: row.of.names[row.place]),
    Column("value", lambda row: row.of.value[row.place]),
    Column("u", lambda row: row.of.u[row.place]),
    word("unit", lambda row: row.of.unit),
    Column("reference", lambda row: known(row.of.reference.value)),
    Column("u_reference", lambda row: known(row.of.reference.u)),
    Column("deviation", lambda row: known(row.of.reference.deviation[row.place])),
    Column("U_deviation", lambda row: known(row.of.reference.expanded[row.place])),
    Column("E_n", lambda row: known(row.of.reference.normalised[row.place])),
    Column("E_n_largest_pair", lambda row: np.abs(row.of.normalised[row.place]).max()),
    word("in_reference", lambda row: "yes" if row.of.reference.used[row.place] else "no"),
    Column("chi_squared", lambda row: known(row.of.reference.chi_squared)),
    Column("chi_squared_dof", lambda row: row.of.reference.dof),
    Column("p", lambda row: row.of.reference.p),
    Column("per_year", lambda row: row.of.per_year),
    Column("u_per_year", lambda row: row.of.u_per_year),
]


def _main(evaluation: ComparisonEvaluation) -> list[Compared]:
    return [found for found in evaluation.compared if found.channel == found.component] or list(evaluation.compared)


def draw_normalised(evaluation: ComparisonEvaluation) -> Picture:
    """E_n against the reference value over frequency, of every result."""
    with sheet("normalised", 4.6, 2) as drawn:
        for axes, quantity in zip(drawn.panels, ("magnitude", "phase"), strict=True):
            own = [found for found in _main(evaluation) if found.quantity == quantity]
            for place, result in enumerate(evaluation.results):
                shown = [
                    (f.frequency_hz, f.reference.normalised[f.names.index(result.name)])
                    for f in own
                    if result.name in f.names
                ]
                if shown:
                    x, y = np.array(shown).T
                    axes.plot(x, y, "o", color=COLOURS[place % len(COLOURS)], label=result.name, markersize=4)
            axes.axhspan(-1.0, 1.0, color=GREY, alpha=0.15, linewidth=0)
            axes.set_ylabel(f"$E_n$ of {quantity}")
        drawn.panels[0].legend()
        ends = np.array([found.frequency_hz for found in _main(evaluation)])
        frequency_axis(drawn.panels[-1], np.array([0.95 * ends.min(), 1.05 * ends.max()]))
        text = "Deviation from the reference value over its expanded uncertainty; within the band it is covered."
        return drawn.picture("Deviations from the reference value", text)


def _context(evaluation: ComparisonEvaluation) -> dict[str, Any]:
    columns: list[Column[Compared]] = [
        on_page("element", lambda f: f"{f.channel} per {f.component}", "l"),
        on_page("quantity", lambda f: f.quantity, "l"),
        on_page("frequency / Hz", lambda f: f"{f.frequency_hz:.4f}"),
        on_page("results", lambda f: str(len(f.names))),
        on_page(
            "reference ± U",
            lambda f: (
                measured(f.reference.value, 2.0 * f.reference.u, f.unit)
                if f.reference.used.any()
                else "none, they contradict each other"
            ),
        ),
        on_page("p of consistency", lambda f: f"{f.reference.p:.3f}"),
        on_page(
            "left out",
            lambda f: ", ".join(n for n, u in zip(f.names, f.reference.used, strict=True) if not u) or "none",
            "l",
        ),
        on_page("largest E_n of a pair", lambda f: signed(f.largest)),
    ]
    changes: list[Column[Compared]] = [
        *columns[:3],
        on_page("drift per year ± U", lambda f: measured(f.per_year or 0.0, 2.0 * (f.u_per_year or 0.0), f.unit)),
    ]
    single: list[Column[Any]] = [
        on_page("result", lambda entry: entry[0], "l"),
        on_page("element", lambda entry: f"{entry[1].channel} per {entry[1].component}", "l"),
        on_page("frequency / Hz", lambda entry: f"{entry[1].frequency_hz:.4f}"),
    ]
    dated = [found for found in evaluation.compared if found.per_year is not None]
    return {
        "subject": [("Results", ", ".join(f"{result.name} ({result.file})" for result in evaluation.results))],
        "reference": table("Reference values, U: k = 2", columns, evaluation.compared),
        "figures": [draw_normalised(evaluation)],
        "drift": table("Drift, U: k = 2", changes, dated),
        "alone": table("Not compared", single, evaluation.alone),
    }


def printed(evaluation: ComparisonEvaluation) -> Iterator[str]:
    """Lines for the terminal."""
    for quantity in ("magnitude", "phase"):
        own = [found for found in evaluation.compared if found.quantity == quantity]
        if own:
            above = sum(found.largest > 1.0 for found in own)
            left = sum(not found.reference.used.all() for found in own)
            counts = f"|E_n| of a pair above 1 at {above}, not consistent at {left}"
            yield f"{quantity}: {len(own)} values compared, {counts}"
    if evaluation.alone:
        yield f"{len(evaluation.alone)} values without a partner"


def _fill(file: h5py.File, evaluation: ComparisonEvaluation) -> None:
    """Every comparison with E_n of every pair."""
    for number, found in enumerate(evaluation.compared):
        group = file.create_group(f"comparison/{number}")
        for name in ("frequency_hz", "channel", "component", "quantity", "unit", "names", "value", "u", "normalised"):
            write_value(group, name, getattr(found, name))


COMPARE = Command(
    "compare",
    "comparison",
    ("comparison.csv",),
    lambda evaluation: {"comparison.csv": csv_text(COMPARISON, rows(evaluation))},
    _fill,
    _context,
    printed,
)


def run_compare(
    inputs: Sequence[str],
    output: Path | None,
    dates: Sequence[str] = (),
    tolerance: float = 1e-3,
    *,
    force: bool = False,
) -> None:
    """Compare results, each `PATH` or `NAME=PATH`, dated by `NAME=YYYY-MM-DD`; write results and print the summary."""
    named: dict[str, Path] = {}
    for text in inputs:
        first, equals, rest = text.partition("=")
        path = Path(rest if equals else text)
        name = first if equals else path.stem
        if not name or name in named:
            raise InputError(path, "", found=f'the name "{name}" twice', expected="NAME=PATH with names of their own")
        named[name] = path
    days: dict[str, Date] = {}
    for text in dates:
        name, _, day = text.partition("=")
        if name not in named:
            raise InputError("--date", name, found=text, expected=f"one of the names {', '.join(named)}")
        try:
            days[name] = Date.fromisoformat(day)
        except ValueError as error:
            raise InputError("--date", name, found=f'"{day}"', expected="a day as YYYY-MM-DD") from error
    results = [read_result(name, path) for name, path in named.items()]
    days = {result.name: result.date for result in results if result.date is not None} | days
    root = Path(os.path.commonpath([result.file.resolve().parent for result in results]))
    files = hash_files([result_file(path) for path in named.values()], root)
    folder = Path("comparison") if output is None else output
    COMPARE.run(files, folder, lambda hashes: evaluate_comparison(results, days, tolerance, hashes), force=force)
