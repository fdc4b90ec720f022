"""Summary of `shakercal run` on the terminal and as JSON: results, notices, files."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from math import isfinite
from pathlib import Path
from typing import TYPE_CHECKING, Any

from fusion.base import count_text
from fusion.estimation.coverage import Polar
from fusion.report.folder import CURVE_FILE, RESULT_FILE, SENSITIVITY_FILE, command_json
from fusion.report.h5 import open_results, read_notices
from fusion.report.labelled_results import CAMPAIGN_FILE
from fusion.report.recording_report import ACCELERATION_FILE, REPORT_FILE, row_element
from fusion.report.table import WEAK, factor_text, half_axes, has_phase, magnitude_phase_text, read_rows
from fusion.report.tables import result_name
from fusion.report.terminal import log_notices, print_text, stdout_console
from shakercal._common.digits import DASH, quantity_text, typeset
from shakercal._common.notices import GatheredNotice, Notice, gather

if TYPE_CHECKING:
    from rich.table import Table

    from fusion.campaign.run import Outcome

MOST_ROWS = 300  # of the sensitivity that the terminal shows
COUNTS = "recordings (mountings)"
NO_OUTPUT = "no sensitivity: no output of a sensor was recorded"
CAMPAIGN = "campaign"
"""Name under which notices of the campaign itself are listed."""
Row = dict[str, str]


def notices_of(done: Sequence[Outcome], *, campaign: bool) -> list[GatheredNotice]:
    """Return every notice of the finished recordings once: warnings first, then those of most recordings."""
    found = gather(
        [(one.name, _notices_in(one.folder / RESULT_FILE) if one.notices is None else one.notices) for one in done]
    )
    if campaign and done:
        found = [*gather([(CAMPAIGN, _notices_in(done[0].folder.parent / CAMPAIGN_FILE))]), *found]
    return sorted(found, key=lambda notice: notice.severity != "warning")


def _notices_in(path: Path) -> tuple[Notice, ...]:
    """Return the notices of a result file; none if it is missing."""
    if not path.is_file():
        return ()
    with open_results(path, "notices") as file:
        return read_notices(file)


def main_rows(rows: Sequence[Row]) -> list[Row]:
    """Return the rows of the main outputs at driven frequencies of a recording's sensitivity.csv.

    A ratio is omitted if the recording gives the sensor's element. Harmonics are used only if there are no driven
    lines.
    """

    def of(row: Row, *keys: str) -> tuple[str, ...]:
        return tuple(row[key] for key in ("frequency_hz", "component", *keys))

    with_element = {of(row, "channel") for row in rows if row["kind"] == "element"}
    shown = [row for row in rows if row["kind"] != "ratio" or of(row, "channel") not in with_element]
    mains = _main_channels(shown, of)
    shown = [row for row in shown if mains[of(row)] == row["channel"]]
    driven = [row for row in shown if row["kind"] != "harmonic"]
    return sorted(driven or shown, key=lambda row: float(row["frequency_hz"]))


def main_curve(rows: Sequence[Row]) -> list[Row]:
    """Return the rows of the best kind (`best_kind`) of every main element of a curve.csv."""
    from fusion.campaign.joint_evaluation import best_kind

    mains = _main_channels(rows, lambda row: (row["component"],))
    found: dict[str, list[Row]] = {}
    for row in rows:
        if mains[(row["component"],)] == row["channel"]:
            found.setdefault(row["component"], []).append(row)
    best = [row for of_one in found.values() for row in best_kind(of_one, lambda row: row["kind"])]
    return sorted(best, key=lambda row: (row["component"], float(row["frequency_hz"])))


def sensitivity_table(rows: Sequence[Row], width: int | None = None) -> Table:
    """Return rows as a table with U = k·u for 95 %.

    U has two significant digits. A value that is not distinguishable from 0 has the half-axes of its region instead of
    magnitude and phase. If the table is wider than `width` characters, columns that only explain the values are
    omitted.
    """
    from rich.table import Table

    curve = "recordings" in rows[0]
    kinds, units = {row["kind"] for row in rows}, {row["unit"] for row in rows}
    head = "Sensitivity" if kinds & {"element", "matrix"} else "Output over load"
    head += f" ({', '.join(kinds)})" if len(kinds) == 1 else ""
    whose = "means of all recordings" if curve else rows[0]["recording"]
    whose += f", the first {MOST_ROWS} of {len(rows)}" if len(rows) > MOST_ROWS else ""
    table_cells = [_cells_of(row) for row in rows[:MOST_ROWS]]
    # A kind that all rows share is in the title.
    shown = [column for column in table_cells[0] if column != "kind" or len(kinds) > 1]
    for name in ("k", COUNTS, "kind", *(("unit",) if len(units) == 1 else ())):
        if width is None or _width(table_cells, shown) <= width:
            break
        shown = [column for column in shown if column != name]
    unit = "" if "unit" in shown else f" in {units.pop()}"
    table = Table(title=f"{head}{unit}, {whose} (U = k·u, 95 %)", title_justify="left")
    for column in shown:
        left = column in ("quantity", "unit", "kind")
        table.add_column(column, justify="left" if left else "right", overflow="fold")
    for cells in table_cells:
        table.add_row(*(cells[column] for column in shown))
    return table


def _main_channels(rows: Sequence[Row], of: Callable[[Row], tuple[str, ...]]) -> dict[tuple[str, ...], str]:
    """Return the output of the load's name, else the largest one, for equal `of`."""
    mains: dict[tuple[str, ...], str] = {}
    for row in sorted(rows, key=lambda row: (row["channel"] != row["component"], -float(row["magnitude"]))):
        mains.setdefault(of(row), row["channel"])
    return mains


def _width(rows: Sequence[Row], columns: Sequence[str]) -> int:
    """Return the width of a table of these columns in characters."""
    return 1 + sum(max(len(column), *(len(cells[column]) for cells in rows)) + 3 for column in columns)


def _cells_of(row: Row) -> dict[str, str]:
    """Return the cells of a sensitivity by column."""
    magnitude, phase, k_factor = _values(row_element(row))
    cells = {
        "f / Hz": f"{float(row['frequency_hz']):.4f}",
        "quantity": result_name(row["kind"], row["channel"], row["component"], main=True),
        "magnitude ± U": magnitude,
        "unit": typeset(row["unit"]),
        "phase ± U / rad": phase,
        "k": k_factor,
        "kind": row["kind"],
    }
    return {**cells, COUNTS: f"{row['recordings']} ({row['mountings']})"} if "recordings" in row else cells


def _values(element: Polar) -> tuple[str, str, str]:
    """Return magnitude and phase with U, and k.

    Value and U have the same power of ten.
    """

    if not element.region.holds_zero:
        magnitude = quantity_text(element.magnitude, element.expanded_magnitude)
        k_factors = magnitude_phase_text(factor_text(element.k), factor_text(element.k_phase))
        phase = quantity_text(element.phase_rad, element.expanded_phase_rad) if has_phase(element) else DASH
        return magnitude, phase, k_factors
    return half_axes(element.region), WEAK, factor_text(element.region_factor)


def print_outcomes(outcomes: Sequence[Outcome], *, campaign: bool) -> None:
    """Print missing results, main sensitivities, files and failures to stdout, and notices to stderr."""
    console, notices = stdout_console(), list[tuple[Notice, str]]()
    done, failed = _parted(outcomes)
    for outcome in (one for one in done if one.missing):
        print_text(f"{outcome.name}: {outcome.missing}" if campaign else outcome.missing)
    if done:
        if rows := _answer(done, campaign=campaign):
            console.print(sensitivity_table(rows, console.width))
            file = done[0].place(_table_file(done, campaign=campaign).name, above=campaign)
            console.print(f"other outputs, harmonics, numbers in full: {file}", soft_wrap=True)
        elif not any(one.missing for one in done):
            file = done[0].place(ACCELERATION_FILE, above=campaign)
            console.print(f"{NO_OUTPUT}; accelerations: {file}", soft_wrap=True)
    if not campaign:
        console.print(outcomes[0].summary, soft_wrap=True)
    else:
        console.print(tally(outcomes))
        for outcome in failed:
            print_text(f"{outcome.name}: {outcome.summary}")
        if done:
            console.print(
                f"report{' of all' * (len(outcomes) > 1)}: {done[0].place(REPORT_FILE, above=True)}", soft_wrap=True
            )
    for gathered in notices_of(done, campaign=campaign):
        single = not campaign or gathered.recordings == (CAMPAIGN,)
        notices.append((gathered, "" if single else f" ({gathered.concerned})"))
    log_notices(notices)


def as_json(outcomes: Sequence[Outcome], *, campaign: bool) -> str:
    """Return the content of `print_outcomes` as JSON, with all digits, every notice, and paths."""
    done, _ = _parted(outcomes)
    notices = notices_of(done, campaign=campaign)
    top = outcomes[0].folder.parent if campaign else outcomes[0].folder
    files = [REPORT_FILE, SENSITIVITY_FILE, *([CURVE_FILE, CAMPAIGN_FILE] if campaign else [RESULT_FILE])]
    return command_json(
        "run",
        sensitivity=[_entry(row) for row in (_answer(done, campaign=campaign) if done else [])],
        notices=[{**notice.as_dict(), "recordings": names} for gathered in notices for notice, names in gathered.each],
        recordings=[
            {
                "name": outcome.name,
                "state": "failed" if outcome.error else "unchanged" if outcome.resumed else "evaluated",
                "error": None if outcome.error is None else str(outcome.error),
                "missing": outcome.missing or None,
                "results": None if outcome.error else outcome.place(),
            }
            for outcome in outcomes
        ],
        files=[outcomes[0].place(name, above=campaign) for name in files if (top / name).is_file()],
    )


def _parted(outcomes: Sequence[Outcome]) -> tuple[list[Outcome], list[Outcome]]:
    """Return successful and failed outcomes."""
    return [one for one in outcomes if one.error is None], [one for one in outcomes if one.error is not None]


def _table_file(done: Sequence[Outcome], *, campaign: bool) -> Path:
    """Return the table of a recording, or of a campaign's curve.

    For a campaign of one recording its table.
    """
    top = done[0].folder.parent if campaign else done[0].folder
    return top / (CURVE_FILE if campaign and len(done) > 1 else SENSITIVITY_FILE)


def _answer(done: Sequence[Outcome], *, campaign: bool) -> list[Row]:
    """Return the main rows of that table."""
    file = _table_file(done, campaign=campaign)
    rows = read_rows(file)
    return main_curve(rows) if file.name == CURVE_FILE else main_rows(rows)


def _entry(row: Row) -> dict[str, Any]:
    """Return one sensitivity as numbers; None if a magnitude or phase would mislead."""
    element, zero = row_element(row), row_element(row).region.holds_zero
    numbers = {
        "frequency_hz": float(row["frequency_hz"]),
        "magnitude": None if zero else element.magnitude,
        "U_magnitude": None if zero else element.expanded_magnitude,
        "k_magnitude": None if zero else element.k,
        "phase_rad": element.phase_rad if has_phase(element) and not zero else None,
        "U_phase_rad": element.expanded_phase_rad if has_phase(element) and not zero else None,
        "k_phase": None if zero else element.k_phase,
        "re": element.re,
        "im": element.im,
        "u_re": element.u_re,
        "u_im": element.u_im,
        "r": element.r,
    }
    finite = {name: value if value is not None and isfinite(value) else None for name, value in numbers.items()}
    words = {name: row[name] for name in ("channel", "component", "kind", "unit")}
    return {**words, **finite, "distinguishable_from_0": not zero}


def tally(outcomes: Sequence[Outcome]) -> str:
    """Return the numbers of evaluated, unchanged and failed recordings."""
    failed = sum(outcome.error is not None for outcome in outcomes)
    resumed = sum(outcome.resumed for outcome in outcomes)
    parts = [(len(outcomes) - failed - resumed, "evaluated"), (resumed, "unchanged since the last run")]
    counts = ", ".join(f"{count} {what}" for count, what in (*parts, (failed, "failed")) if count)
    return f"{count_text(len(outcomes), 'recording')}: {counts}"
