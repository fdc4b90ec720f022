"""Page of a comparison like a Draft B: participants, artefact, degrees of equivalence."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from datetime import date as Date
from functools import partial
from typing import Any

import numpy as np

from fusion.base import K2, MILLI, PERCENT
from fusion.report.figure import COLOURS, GREY, Figure, empty_figure, frequency_axis, padded_limits
from fusion.report.table import Table, TableColumn, page_column, table
from fusion.sensor.compare.comparison_evaluation import ComparedQuantity, ComparisonEvaluation
from fusion.sensor.compare.comparison_inputs import DAYS, ComparedResult, ComparedValue
from fusion.sensor.compare.linking import ArtefactStability, ComparedGroup, Participant, RoundLink
from shakercal._common.arrays import FloatArray
from shakercal._common.digits import DASH, exponent_of, number_text, quantity_text, scaled_text, signed_text, times_ten

SHIFT = 0.008
"""Shift of the points of neighbouring laboratories on the frequency axis, as a share of the axis."""


def element_columns(value: Callable[[Any], Any]) -> list[TableColumn[Any]]:
    """Return columns of element and frequency of rows with a compared value."""
    return [
        page_column("element", lambda row: f"{value(row).channel} per {value(row).component}", "l"),
        page_column("frequency / Hz", lambda row: f"{value(row).frequency_hz:.4f}"),
    ]


# Participants, artefact, and results as stated.


def participants(evaluation: ComparisonEvaluation) -> Table | None:
    """Return the table of all results: round, laboratory, day, file, and its certificates."""
    several = len({Participant.of(result.name).round for result in evaluation.results}) > 1
    columns: list[TableColumn[ComparedResult]] = [
        page_column("laboratory", lambda result: Participant.of(result.name).laboratory, "l"),
        page_column("date", _date, "l"),
        page_column("file", lambda result: result.file.as_posix(), "l"),
        page_column("values", lambda result: str(len(result.values))),
        page_column("repeats averaged", lambda result: DASH if result.repeats == 1 else f"up to {result.repeats}"),
        page_column("certificates", _certificates, "l"),
    ]
    if several:
        columns.insert(0, page_column("round", lambda result: Participant.of(result.name).round, "l"))
    return table("Participants", columns, evaluation.results)


def _date(result: ComparedResult) -> str:
    """Return the day of a result, or those of its first and last value."""
    if result.date is not None:
        return result.date.isoformat()
    years = np.array([value.year for value in result.values])
    if not np.isfinite(years).any():
        return DASH
    ends = (Date.fromordinal(1 + round((year - 1.0) * DAYS)) for year in (np.nanmin(years), np.nanmax(years)))
    return " to ".join(dict.fromkeys(day.isoformat() for day in ends))


def _certificates(result: ComparedResult) -> str:
    numbers = [result.certificate, *(row.certificate for row in result.evidence)]
    return ", ".join(dict.fromkeys(filter(None, numbers))) or DASH


def _change(value: ComparedValue, quantity: str, change: float, u: float) -> str:
    """Return a change per year: in percent of the magnitude, or in mrad."""
    factor, unit = (PERCENT, "%") if quantity == "magnitude" else (MILLI, "mrad")
    return quantity_text(factor * change, K2 * factor * u, unit)


def artefact(evaluation: ComparisonEvaluation) -> list[Table | None]:
    """Return the tables of the artefact's stability and of the links of rounds."""
    stable: list[TableColumn[ArtefactStability]] = [
        page_column("laboratory", lambda row: row.laboratory, "l"),
        *element_columns(lambda row: row.value),
        page_column("quantity", lambda row: row.quantity, "l"),
        page_column("results", lambda row: str(row.repeats)),
        page_column("change per year ± U", lambda row: _change(row.value, row.quantity, row.per_year, row.u_per_year)),
        page_column("p of a stable artefact", lambda row: number_text(row.p, 2)),
        page_column("drift removed", lambda row: "yes" if row.removed else "no", "l"),
    ]
    linked: list[TableColumn[RoundLink]] = [
        page_column("round", lambda row: row.round, "l"),
        page_column("linked by", lambda row: ", ".join(row.laboratories), "l"),
        *element_columns(lambda row: row.value),
        page_column(
            "artefacts' ratio or difference of phases ± U",
            lambda row: quantity_text(row.transfer, K2 * row.u, "" if row.quantity == "magnitude" else "rad"),
        ),
        page_column("p of consistency", lambda row: number_text(row.p, 2)),
    ]
    return [
        table("Stability of the artefact, U: k = 2", stable, evaluation.stability),
        table("Links to the first round, U: k = 2", linked, evaluation.links),
    ]


def _stated_cell(name: str, quantity: str, group: ComparedGroup) -> str:
    """Return a value as a result states it, or a dash."""
    value = dict(zip(group.names, group.values, strict=True)).get(name)
    if value is None or (quantity == "phase" and value.phase_rad is None):
        return DASH
    if quantity == "magnitude":
        return quantity_text(value.magnitude, K2 * value.u_magnitude, value.unit)
    return quantity_text(float(value.phase_rad or 0.0), K2 * value.u_phase_rad, "rad")


def stated(evaluation: ComparisonEvaluation) -> list[Table | None]:
    """Return magnitudes and phases as the results state them."""
    found = []
    for quantity in ("magnitude", "phase"):
        columns = element_columns(lambda group: group.values[0])
        for result in evaluation.results:
            columns.append(page_column(result.name, partial(_stated_cell, result.name, quantity)))
        groups = evaluation.stated if quantity == "magnitude" else [g for g in evaluation.stated if _has_phase(g)]
        found.append(table(f"{quantity.capitalize()}s as stated, U: k = 2", columns, groups))
    return found


def _has_phase(group: ComparedGroup) -> bool:
    return any(value.phase_rad is not None for value in group.values)


# Degrees of equivalence of laboratories and of pairs.


def _displayed(found: ComparedQuantity) -> tuple[float, str]:
    """Return the factor and unit of deviations: percent of the reference value, or mrad."""
    return (PERCENT / abs(found.centre), "%") if found.quantity == "magnitude" else (MILLI, "mrad")


def _equivalence_cell(name: str, found: ComparedQuantity) -> str:
    """Return the degree of equivalence of a laboratory, or a dash."""
    if name not in found.names or not found.reference.used.any():
        return DASH
    factor, index = _displayed(found)[0], found.names.index(name)
    return scaled_text(factor * found.reference.deviation[index], factor * found.reference.expanded[index])


def equivalence(evaluation: ComparisonEvaluation) -> list[Table | None]:
    """Return the degrees of equivalence of all laboratories, of magnitudes and of phases."""
    found = []
    for quantity, unit in (("magnitude", "%"), ("phase", "mrad")):
        columns = element_columns(lambda row: row)
        for name in evaluation.laboratories:
            columns.append(page_column(name, partial(_equivalence_cell, name)))
        of_quantity = [one for one in evaluation.quantities if one.quantity == quantity]
        found.append(table(f"Degrees of equivalence of {quantity}s, d ± U in {unit}", columns, of_quantity))
    return found


def draw_equivalence(evaluation: ComparisonEvaluation, quantities: Sequence[ComparedQuantity]) -> Figure:
    """Draw the degrees of equivalence of every laboratory over frequency, with bars of U."""
    drawn = empty_figure("equivalence", 5.2, 2)
    ends = np.array([min(f.frequency_hz for f in quantities), max(f.frequency_hz for f in quantities)])
    frequencies = ends * [0.9, 1.1]
    for panel, quantity in zip(drawn.panels, ("magnitude", "phase"), strict=True):
        of_quantity = [found for found in quantities if found.quantity == quantity and found.reference.used.any()]
        frequency_axis(panel.x, frequencies)
        panel.rule(0.0, colour=GREY)
        reach = []
        for index, name in enumerate(evaluation.laboratories):
            of_name = [(found, found.names.index(name)) for found in of_quantity if name in found.names]
            if of_name:
                x = np.array([found.frequency_hz for found, _ in of_name])
                scaled = [(found.reference, n, _displayed(found)[0]) for found, n in of_name]
                y = np.array([factor * reference.deviation[n] for reference, n, factor in scaled])
                half = np.array([factor * reference.expanded[n] for reference, n, factor in scaled])
                shift = SHIFT * (index - 0.5 * (len(evaluation.laboratories) - 1))
                x = _shifted(x, shift, frequencies, log=panel.x.log)
                panel.points(x, y, name, half_y=half, colour=COLOURS[index % len(COLOURS)], size=4.0)
                reach += [y - half, y + half]
        panel.y.label = "d of magnitude / %" if quantity == "magnitude" else "d of phase / mrad"
        if reach:
            every = np.concatenate(reach)
            panel.y.limits = padded_limits(float(every.min()), float(every.max()))
    drawn.panels[0].x.label = ""
    text = (
        "Difference from the reference value with its U, which includes their correlation. U covers the difference if "
        "the bar reaches the zero line. Laboratories are shifted in frequency for legibility."
    )
    return drawn.with_title("Degrees of equivalence", text, main=True)


def _shifted(x: FloatArray, shift: float, ends: FloatArray, *, log: bool) -> FloatArray:
    """Return frequencies shifted by a share of the axis."""
    return np.asarray(x * (ends[1] / ends[0]) ** shift if log else x + shift * (ends[1] - ends[0]))


def pairs(evaluation: ComparisonEvaluation) -> list[Table | None]:
    """Return the degrees of equivalence of all pairs, where E_n of a pair is largest."""
    found = []
    for quantity in ("magnitude", "phase"):
        of_quantity = [one for one in evaluation.quantities if one.quantity == quantity]
        if of_quantity:
            found.append(_pair_matrix(max(of_quantity, key=lambda one: one.largest)))
    return found


def _pair_matrix(found: ComparedQuantity) -> Table | None:
    """Return D ± U of every pair: row less column."""
    difference, expanded = found.differences
    exponent = exponent_of(float(np.abs([difference, expanded]).max()))

    def cell(column: int, row: int) -> str:
        return DASH if row == column else scaled_text(difference[row, column], expanded[row, column], exponent)

    columns: list[TableColumn[int]] = [page_column("row less column", lambda row: found.names[row], "l")]
    columns += [page_column(name, partial(cell, n)) for n, name in enumerate(found.names)]
    what = f"{found.quantity} of {found.channel} per {found.component} at {found.frequency_hz:.4f} Hz"
    unit = f" in {times_ten(exponent, found.unit)}".rstrip()
    return table(f"Pairs: {what}, D ± U{unit} (k = 2)", columns, range(len(found.names)))


def conclusions(evaluation: ComparisonEvaluation) -> Table | None:
    """Return how often U covers degrees of equivalence by laboratory, and the largest E_n."""

    def normalised(name: str, quantity: str) -> list[tuple[float, float]]:
        of = [found for found in evaluation.quantities if found.quantity == quantity and name in found.names]
        every = [(abs(float(f.reference.normalised[f.names.index(name)])), f.frequency_hz) for f in of]
        return [entry for entry in every if np.isfinite(entry[0])]

    def covered(quantity: str, name: str) -> str:
        found = normalised(name, quantity)
        return f"{sum(e_n <= 1.0 for e_n, _ in found)} of {len(found)}" if found else DASH

    def largest(name: str) -> str:
        found = [(*entry, quantity) for quantity in ("magnitude", "phase") for entry in normalised(name, quantity)]
        e_n, frequency_hz, quantity = max(found, default=(np.nan, np.nan, ""))
        return f"{signed_text(e_n)} ({quantity}, {frequency_hz:.4f} Hz)" if quantity else DASH

    columns: list[TableColumn[str]] = [
        page_column("laboratory", lambda name: name, "l"),
        page_column("|E_n| ≤ 1, magnitudes", partial(covered, "magnitude")),
        page_column("|E_n| ≤ 1, phases", partial(covered, "phase")),
        page_column("largest |E_n|", largest, "l"),
    ]
    return table("Degrees of equivalence that U covers", columns, evaluation.laboratories)
