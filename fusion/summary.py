"""What the command prints when it is done: the sensitivity and where the report lies."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

from fusion.console import stdout_console
from fusion.coverage import region_factor
from fusion.execution.job import Outcome
from fusion.polar import Polar, rounded
from fusion.results_csv import SENSITIVITY_FILE, read_rows, row_element

if TYPE_CHECKING:
    from rich.table import Table


def print_outcomes(outcomes: Sequence[Outcome]) -> None:
    """Print one block per recording: its sensitivity with expanded uncertainty and the path of its report."""
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
    """Return the rows of a sensitivity.csv as a table with U = k·u for 95 %, two significant digits of it.

    Of a value that is not distinguishable from 0 the half-axes of its region stand in place of magnitude and phase.
    """
    from rich.table import Table

    names = dict.fromkeys(row["recording"] for row in rows)
    table = Table(title=f"Sensitivity, {', '.join(names)} (U = k·u, 95 %)", title_justify="left")
    table.add_column("frequency / Hz", justify="right")
    table.add_column("element")
    table.add_column("magnitude ± U", justify="right")
    table.add_column("unit")
    table.add_column("phase ± U / rad", justify="right")
    table.add_column("k", justify="right")
    table.add_column("kind")
    for row in rows:
        name = f"{row['channel']} / {row['component']}"
        magnitude, phase, factor = _cells(row_element(row))
        table.add_row(f"{float(row['frequency_hz']):.4f}", name, magnitude, row["unit"], phase, factor, row["kind"])
    return table


def _cells(element: Polar) -> tuple[str, str, str]:
    """Magnitude and phase with U, and k."""
    if not element.region.holds_zero:
        magnitude = _with_u(element.magnitude, element.expanded_magnitude)
        return magnitude, _with_u(element.phase_rad, element.expanded_phase_rad), f"{element.k:.2f}"
    large, small = element.region.half_axes
    first = rounded(large, large)
    second = rounded(small, large, first.exponent)
    pair = f"(region ± {first.value}, ± {second.value})" + (f"e{first.exponent:d}" if first.exponent else "")
    return pair, "not distinguishable from 0", f"{region_factor(element.dof):.2f}"


def _with_u(value: float, expanded: float) -> str:
    """Return value ± U with the power of ten they share."""
    text = rounded(value, expanded)
    pair = f"{text.value} ± {text.expanded}"
    return f"({pair})e{text.exponent:d}" if text.exponent else pair
