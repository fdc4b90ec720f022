"""The report's tables on the agreement of instruments: who deviates, what scatters, what these data do not test."""

from __future__ import annotations

import numpy as np

from fusion.evaluation import Evaluation
from fusion.fuse import Acceleration, CommonEstimate
from fusion.polar import DASH
from fusion.report_tables import Table, chi_square_table, consistency_table
from fusion.verdict import REMAINING, untested

LONGEST = 15
"""Most unknowns that one table lists: those that deviate most."""
MINUS = "\N{MINUS SIGN}"


def consistency_tables(evaluation: Evaluation) -> list[Table]:
    """Return the tables on chi-square, every instrument, scatter, and what the data say of the stated unknowns."""
    fused = [result for result in evaluation.accelerations if result.source == "fused"]
    found = (
        chi_square_table(evaluation),
        consistency_table(evaluation),
        _scatter_table(fused),
        _estimates_table(fused),
        _untested_table(fused),
    )
    return [table for table in found if table]


def _scatter_table(results: list[Acceleration]) -> Table | None:
    """Instruments whose readings scatter beyond what is stated of them."""
    rows = []
    for result in results:
        for scatter in result.scatter:
            parts = zip(result.phasors.frequency_hz, scatter.amplitude, scatter.phase, scatter.dof, strict=True)
            for frequency, amplitude, phase, dof in parts:
                sizes = (f"{100.0 * amplitude:.2g}", f"{1e3 * phase:.2g}")
                freedom = f"{dof:.0f}" if np.isfinite(dof) else DASH
                rows.append((result.body, scatter.instrument, f"{frequency:.4f}", *sizes, freedom))
    head = ("body", "instrument", "frequency / Hz", "amplitude / %", "phase / mrad", "dof")
    caption = "Scatter of an instrument's readings beyond what is stated, relative to the motion (standard deviations)"
    return Table(caption, head, "llrrrr", tuple(rows)) if rows else None


def _estimates_table(results: list[Acceleration]) -> Table | None:
    """What the readings say of the unknowns that they can test."""
    rows = []
    for result in results:
        tested = [u for u in result.unknowns if u.remaining < REMAINING and np.isfinite(u.deviation)]
        for unknown in sorted(tested, key=lambda u: -abs(u.deviation))[:LONGEST]:
            rows.append((result.body, unknown.name, *_stated(unknown), *_found(unknown)))
    head = ("body", "unknown", "stated u", "unit", "asked for", "estimate / u", "deviation", "u left / u")
    caption = (
        "What the readings say of the stated unknowns: the value they ask for, the estimate with what is stated, its "
        "deviation (standard normal if all is as stated) and what remains of u"
    )
    return Table(caption, head, "llrlrrrr", tuple(rows)) if rows else None


def _stated(unknown: CommonEstimate) -> tuple[str, str]:
    """Standard uncertainty of an unknown with its unit."""
    return f"{unknown.u:.2g}", "" if unknown.unit == "1" else unknown.unit


def _found(unknown: CommonEstimate) -> tuple[str, ...]:
    """Estimate of an unknown: value asked for, estimate, deviation, remaining share."""
    numbers = (f"{unknown.wanted:.2g}", f"{unknown.estimate:+.2f}", f"{unknown.deviation:+.2f}")
    return (*(text.replace("-", MINUS) for text in numbers), f"{unknown.remaining:.2f}")


def _untested_table(results: list[Acceleration]) -> Table | None:
    """Unknowns that matter and that nothing in these data tests."""
    rows = []
    for result in results:
        for row in untested(result):
            effect = f"{100.0 * row.relative:.2g}" if np.isfinite(row.relative) else DASH
            unit = "" if row.unit == "1" else row.unit
            share = f"{100.0 * row.share:.0f}"
            rows.append((result.body, row.name, f"{row.u:.2g}", unit, row.component, effect, share))
    head = ("body", "unknown", "stated u", "unit", "touches most", "by / % of it", "share of its variance / %")
    caption = "Not tested by these data: taken as stated, an error beyond that would not be noticed"
    return Table(caption, head, "llrllrr", tuple(rows)) if rows else None
