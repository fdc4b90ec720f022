"""The numbers printed by three publications, recomputed by the program from their printed inputs.

Usage: python benchmarks/papers.py [--docs FOLDER]

Prints the tables of docs/papers.md; with --docs the page's tables are replaced. Takes some seconds.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable
from math import pi
from re import sub

import numpy as np
import papers_rows_load as loads
import papers_rows_wrist as wrist
import published_paper as paper
from marked import existing_folder, markdown_row, markdown_table, write_marked
from papers_rows import HOLDS, Row, motion, oscillator, resonance, rotation, sensitivity, table_2

from shaker.identification.oscillator import PeakReadings


def spacing_rows() -> list[tuple[str, ...]]:
    """Return for every printed resonance what lines of 0.78125 Hz do to the readings of an exact oscillator."""
    cases = [
        ("Fz", m, f, b) for m, f, b in zip(paper.LOADS_KG, paper.RESONANCE_HZ, paper.DAMPING_KG_PER_S, strict=True)
    ]
    for load, hertz, _, coefficients in paper.TABLE_2:
        cases += [
            (name, load, hertz[c], coefficients[c]) for c, name in ((0, "f1x"), (1, "f1y"), (2, "f2x"), (3, "f2y"))
        ]
    rows = []
    for name, load, f0, damping in cases:
        zeta = damping / (4 * pi * f0 * (load + paper.INTERNAL_KG))
        readings = [oscillator(f0, zeta, shift) for shift in np.linspace(-0.5, 0.5, 11)]

        def off(of: Callable[[PeakReadings], float], true: float, found: list[PeakReadings] = readings) -> float:
            return max(abs(of(reading) / true - 1) for reading in found)

        lines = readings[0].lines_in_width
        errors = (
            2 * off(lambda r: r.maximum_bin.frequency_hz, f0),
            2 * off(lambda r: r.maximum.frequency_hz, f0),
            off(lambda r: r.half_amplitude.damping_ratio, zeta),
            off(lambda r: r.half_power.damping_ratio, zeta),
        )
        rows.append((f"{name}, {load} kg", f"{0.5 / zeta:.0f}", f"{lines:.1f}", *map(_percent, errors)))
    return rows


def _percent(value: float) -> str:
    """Return a relative deviation in per cent, nothing finer than 0.001 %."""
    return f"{100 * value:.3f} %" if value >= 1e-5 else "< 0.001 %"


def tables() -> dict[str, list[str]]:
    """Return the tables of docs/papers.md by name, as lines of Markdown."""
    head = ("where", "published", "from", "program", "verdict", "remark")
    parts = {"motion": motion, "rotation": rotation, "resonance": resonance, "table 2": table_2}
    of_wrist = {
        "wrist statics": wrist.statics,
        "wrist frequencies": wrist.frequencies,
        "wrist SIM": wrist.simultaneous,
        "wrist DE": wrist.evolution,
    }
    of_load = {
        "load oscillation": loads.oscillation,
        "load series": loads.load_series,
        "load filter": loads.compensation,
    }
    every = {**parts, "sensitivity": sensitivity, **of_wrist, **of_load}
    found = {name: _short_table(head, rows()) for name, rows in every.items()}
    fine = ("resonance", "Q", "lines in Δf", "k: line of maximum", "k: maximum", "b: half amplitude", "b: half power")
    return {**found, "spacing": _table(fine, spacing_rows())}


def _short_table(head: tuple[str, ...], rows: list[Row]) -> list[str]:
    """Return a table of the rows that are not simply reproduced, and these in one line below it."""
    lines = _table(head, [row for row in rows if row.verdict != HOLDS])
    reproduced = [f"{row.where}: {row.program}" for row in rows if row.verdict == HOLDS]
    return [*lines, "", f"Reproduced: {_minus('; '.join(reproduced))}."] if reproduced else lines


def _minus(text: str) -> str:
    """Return a text with typographic minus signs before numbers."""
    return sub(r"(?<![\w.)⁻])-(?=\d)", "\N{MINUS SIGN}", text)


def _table(head: tuple[str, ...], rows: list[Row] | list[tuple[str, ...]]) -> list[str]:
    """Return a table, with typographic minus signs before numbers."""
    return markdown_table(markdown_row(*head), [_minus(markdown_row(*row)) for row in rows]).split("\n")


def main() -> None:
    """Print the tables, and write them where asked to."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--docs", type=existing_folder, help="folder of papers.md, whose tables are replaced")
    options = parser.parse_args()
    parts = tables()
    print("\n\n".join("\n".join((name, "", *lines)) for name, lines in parts.items()))
    if options.docs is not None:
        write_marked(options.docs / "papers.md", {name: "\n".join(lines) for name, lines in parts.items()})


if __name__ == "__main__":
    main()
