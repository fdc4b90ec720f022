"""What the command prints when it is done: the sensitivity and where the report lies."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

from fusion.console import stdout_console
from fusion.job import Outcome
from fusion.polar import rounded
from fusion.results_csv import SENSITIVITY_FILE, read_rows

if TYPE_CHECKING:
    from rich.table import Table

COVERAGE_FACTOR = 2.0


def print_outcomes(outcomes: Sequence[Outcome]) -> None:
    """Print one block per recording: its sensitivity with expanded uncertainty (k = 2) and the path of its report."""
    console = stdout_console()
    for outcome in outcomes:
        if outcome.error is not None:
            console.print(f"{outcome.recording.parent.name}: failed, {outcome.error}", soft_wrap=True)
            continue
        rows = read_rows(outcome.folder / SENSITIVITY_FILE)
        console.print(sensitivity_table(rows) if rows else "no sensitivity: see the report for what was observed")
        what = "unchanged since the last run" if outcome.resumed else "written"
        console.print(f"report ({what}): {outcome.folder / 'report.html'}", soft_wrap=True)


def sensitivity_table(rows: Sequence[dict[str, str]]) -> Table:
    """Return the rows of a sensitivity.csv as a table with U at k = 2, two significant digits of it."""
    from rich.table import Table

    names = dict.fromkeys(row["recording"] for row in rows)
    table = Table(title=f"Sensitivity, {', '.join(names)} (U: expanded uncertainty, k = 2)", title_justify="left")
    table.add_column("frequency / Hz", justify="right")
    table.add_column("element")
    table.add_column("magnitude ± U", justify="right")
    table.add_column("unit")
    table.add_column("phase ± U / rad", justify="right")
    table.add_column("kind")
    for row in rows:
        magnitude = _with_u(float(row["magnitude"]), float(row["u_magnitude"]))
        phase = _with_u(float(row["phase_rad"]), float(row["u_phase_rad"]))
        element = f"{row['channel']} / {row['component']}"
        table.add_row(f"{float(row['frequency_hz']):.4f}", element, magnitude, row["unit"], phase, row["kind"])
    return table


def _with_u(value: float, u: float) -> str:
    """Return value ± U with the power of ten they share."""
    text = rounded(value, COVERAGE_FACTOR * u)
    pair = f"{text.value} ± {text.expanded}"
    return f"({pair})e{text.exponent:d}" if text.exponent else pair
