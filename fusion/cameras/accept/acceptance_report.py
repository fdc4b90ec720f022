"""Files, page and printed lines of the acceptance test of a rig, and the command."""

from __future__ import annotations

import json
from collections.abc import Iterator
from itertools import groupby
from pathlib import Path
from typing import Any

import numpy as np

from fusion.base import ProgressCallback, prefix
from fusion.cameras.accept.acceptance_evaluation import AcceptanceEvaluation, evaluate_acceptance
from fusion.cameras.accept.acceptance_figures import (
    draw_drift,
    draw_fields,
    draw_local_scale,
    draw_noise_spectrum,
    draw_steps,
)
from fusion.cameras.accept.acceptance_manifest import read_acceptance
from fusion.cameras.accept.acceptance_rows import FILE_UNIT, AcceptanceRow, Verdict, overall
from fusion.cameras.accept.calibration_faults import FaultFit
from fusion.cameras.accept.moved_plate import MotionTest
from fusion.cameras.accept.stationary_scene import COMPONENTS, StationaryTest
from fusion.report.folder import CommandReport, hash_files
from fusion.report.h5 import write_fields, write_value
from fusion.report.h5_tree import Group
from fusion.report.table import (
    Headline,
    Table,
    TableColumn,
    capitalise,
    csv_text,
    finite_or_none,
    page_column,
    table,
    text_column,
)
from shaker.labels import AXES
from shakercal._common.digits import number_text, quantity_text

PRINTED_ROWS = 12
"""Rows other than PASS that the terminal lists; the page lists all."""
ROWS: list[TableColumn[AcceptanceRow]] = [
    text_column("test", lambda row: row.test, "test"),
    text_column("quantity", lambda row: row.name),
    TableColumn("", lambda row: capitalise(row.label), "quantity", None, "l"),
    TableColumn("value", lambda row: row.value, "value ± U", lambda row: row.value_text),
    TableColumn("U", lambda row: row.expanded),
    TableColumn("tolerance", lambda row: row.tolerance, "tolerance", lambda row: row.tolerance_text),
    text_column("unit", lambda row: FILE_UNIT.get(row.unit, row.unit)),
    text_column("verdict", lambda row: row.verdict, "verdict"),
]


def texts(evaluation: AcceptanceEvaluation) -> dict[str, str]:
    """Return the files of the results by name."""
    columns = [column for column in ROWS if column.name]
    rows = [{column.name: _plain(column.value(row)) for column in columns} for row in evaluation.rows]
    faults = [] if evaluation.diagnosis is None else [_fault(fit) for fit in _fits(evaluation)]
    content = {
        "name": evaluation.name,
        "verdict": evaluation.verdict,
        "rows": rows,
        "faults": faults,
        "notices": [notice.as_dict() for notice in evaluation.notices],
    }
    return {
        "acceptance.csv": csv_text(columns, evaluation.rows),
        "acceptance.json": json.dumps(content, indent=1, ensure_ascii=False, allow_nan=False) + "\n",
    }


def _plain(value: Any) -> Any:
    return finite_or_none(value) if isinstance(value, float) else value


def _fits(evaluation: AcceptanceEvaluation) -> tuple[FaultFit, ...]:
    found = evaluation.diagnosis
    return () if found is None else (found.best, *found.similar, *found.others)


def _fault(fit: FaultFit) -> dict[str, Any]:
    return {
        "fault": fit.kind.name,
        "value": fit.value.tolist(),
        "U": (2.0 * fit.u).tolist(),
        "chi2": fit.chi2,
        "chi2_without": fit.chi2_without,
        "count": fit.count,
    }


def fill(file: Group, evaluation: AcceptanceEvaluation) -> None:
    """Fill the HDF5 file with fields and series of all tests."""
    file.attrs["name"], file.attrs["verdict"] = evaluation.name, evaluation.verdict
    if evaluation.stationary is not None:
        group = file.create_group("stationary")
        for name in ("time", "pose", "predicted", "noise", "drift", "u_drift", "subset_noise", "subset_px"):
            write_value(group, name, getattr(evaluation.stationary, name))
    for test in (*evaluation.translations, *evaluation.rotations):
        group = file.create_group(file.free_name(test.label))
        for name in ("along", "centre_m", "epipolar_px", "position_px"):
            write_value(group, name, getattr(test, name))
        write_fields(group.create_group("motion"), test.motion)
        write_fields(group.create_group("field"), test.field)


# Page and terminal


def tests(evaluation: AcceptanceEvaluation) -> Iterator[tuple[str, tuple[AcceptanceRow, ...]]]:
    """Yield each test by name with its rows."""
    for name, rows in groupby(evaluation.rows, key=lambda row: row.test):
        yield name, tuple(rows)


def headlines(evaluation: AcceptanceEvaluation) -> list[Headline]:
    """Return the verdict of the rig and of each test."""
    lines = [Headline("Stereo rig", evaluation.verdict, _reason(evaluation.rows))]
    lines += [Headline(capitalise(name), overall(rows), _reason(rows)) for name, rows in tests(evaluation)]
    return lines


def _reason(rows: tuple[AcceptanceRow, ...]) -> str:
    """Return the row that decides: the one farthest beyond its tolerance, or nearest to it."""
    order: dict[Verdict, int] = {"FAIL": 2, "UNDECIDED": 1, "PASS": 0}
    worst = max(rows, key=lambda row: (order[row.verdict], (abs(row.value) + row.expanded) / row.tolerance))
    return f"{worst.label}: {worst.value_text}, tolerance {worst.tolerance_text}"


def noise_table(test: StationaryTest) -> Table | None:
    """Return the noise of each component and its prediction."""

    def unit(index: int) -> tuple[float, str]:
        factor, letter = prefix(test.noise[index])
        return factor, f"{letter}{'m' if index < len(AXES) else 'rad'}"

    def measured(index: int) -> str:
        factor, name = unit(index)
        value = float(test.noise[index]) / factor
        return quantity_text(value, 2.0 * value / np.sqrt(2.0 * test.freedom), name)

    def predicted(index: int) -> str:
        factor, name = unit(index)
        return number_text(float(test.predicted[index]) / factor, 3, name)

    def drift(index: int) -> str:
        factor, name = unit(index)
        return quantity_text(float(test.drift[index]) / factor, 2.0 * float(test.u_drift[index]) / factor, name)

    def ratio(index: int) -> str:
        return f"{test.noise[index] / test.predicted[index]:.2f}"

    columns: list[TableColumn[int]] = [
        page_column("component", lambda index: COMPONENTS[index], "l"),
        page_column("noise ± U", measured),
        page_column("predicted", predicted),
        page_column("ratio", ratio),
        page_column("drift ± U", drift),
    ]
    return table("Standard deviation of single frames, left camera's axes", columns, range(6))


def subset_table(test: StationaryTest) -> Table | None:
    """Return the noise of single subsets."""
    columns: list[TableColumn[int]] = [
        page_column("component", lambda index: COMPONENTS[index], "l"),
        page_column("median noise / nm", lambda index: f"{1e9 * np.median(test.subset_noise[:, index]):.0f}"),
        page_column("noise / px", lambda index: f"{np.median(test.subset_noise[:, index]) / test.pixel_m:.4f}"),
        page_column("predicted / nm", lambda index: f"{1e9 * np.median(test.subset_predicted[:, index]):.0f}"),
        page_column("95 % of the subsets below / nm", lambda index: f"{1e9 * _p95(test, index):.0f}"),
    ]
    return table(f"Noise of single subsets ({len(test.subset_noise)} subsets)", columns, range(3))


def _p95(test: StationaryTest, index: int) -> float:
    return float(np.quantile(test.subset_noise[:, index], 0.95))


def lines_table(test: StationaryTest) -> Table | None:
    """Return the vibrations found."""
    lines = test.lines
    amplitude, u_amplitude = test.vibrations

    def strongest(index: int) -> str:
        column = int(np.argmax(amplitude[index]))
        return quantity_text(1e9 * float(amplitude[index, column]), 2e9 * float(u_amplitude[index, column]), "nm")

    columns: list[TableColumn[int]] = [
        page_column("frequency", lambda index: number_text(float(lines.frequency_hz[index]), 4)),
        page_column("component", lambda index: COMPONENTS[int(np.argmax(amplitude[index]))], "l"),
        page_column("amplitude at the edge ± U", strongest),
        page_column("origin", lambda index: lines.origin[index].text, "l"),
    ]
    unit = "Hz" if test.has_rate else "periods per frame"
    return table(f"Vibrations, frequency in {unit}", columns, range(len(lines.frequency_hz)))


def faults_table(evaluation: AcceptanceEvaluation) -> Table | None:
    """Return how well each single fault explains the translations, None if none is significant."""
    if evaluation.diagnosis is None or not evaluation.diagnosis.is_significant:
        return None
    columns: list[TableColumn[FaultFit]] = [
        page_column("fault", lambda fit: capitalise(fit.kind.label), "l"),
        page_column("size ± U", lambda fit: fit.size_text, "l"),
        page_column("explained / %", lambda fit: f"{100.0 * fit.share:.0f}"),
        page_column("χ² per value, before", lambda fit: number_text(fit.chi2_without / fit.count, 3)),
        page_column("after", lambda fit: number_text(fit.chi2 / fit.count, 3)),
    ]
    return table("Single faults that may explain the translations, the most likely first", columns, _fits(evaluation))


def page_context(evaluation: AcceptanceEvaluation) -> dict[str, Any]:
    """Return the content of the page."""
    stationary = evaluation.stationary
    moved: tuple[MotionTest, ...] = (*evaluation.translations, *evaluation.rotations)
    return {
        "subject": [("Calibration", str(evaluation.settings["calibration"]))],
        "rows": table("All results", [column for column in ROWS if column.head], evaluation.rows),
        "stationary": None
        if stationary is None
        else {
            "figures": [draw_noise_spectrum(stationary), draw_drift(stationary)],
            "tables": [noise_table(stationary), subset_table(stationary), lines_table(stationary)],
        },
        "moved": [
            {
                "id": f"{test.kind}-{number}",
                "name": capitalise(test.label),
                "figures": [draw_fields(test)] + ([draw_steps(test)] if test.kind == "translation" else []),
            }
            for number, test in enumerate(moved, 1)
        ],
        "scale": [draw_local_scale(evaluation.translations)] if evaluation.translations else [],
        "faults": faults_table(evaluation),
    }


def printed(evaluation: AcceptanceEvaluation) -> Iterator[str]:
    """Yield the printed lines: verdicts of the tests, and rows that do not pass."""
    for name, rows in tests(evaluation):
        passed = sum(row.verdict == "PASS" for row in rows)
        yield f"{name}: {overall(rows)}, {passed} of {len(rows)} quantities pass"
    open_rows = [row for row in evaluation.rows if row.verdict != "PASS"]
    for row in open_rows[:PRINTED_ROWS]:
        yield f"  {row.verdict} {row.test}: {row.label}: {row.value_text}, tolerance {row.tolerance_text}"
    if len(open_rows) > PRINTED_ROWS:
        yield f"  and {len(open_rows) - PRINTED_ROWS} more on the page"
    yield f"verdict: {evaluation.verdict}"


ACCEPT = CommandReport(
    "accept",
    "acceptance",
    ("acceptance.csv", "acceptance.json"),
    texts,
    fill,
    page_context,
    printed,
    headlines,
)


def run_acceptance(
    given: Path,
    output: Path | None,
    *,
    force: bool = False,
    allow_outside: bool = False,
    progress: ProgressCallback,
) -> bool:
    """Evaluate acceptance.toml, write the results, print the summary; return whether the rig fails."""
    file = read_acceptance(given, allow_outside=allow_outside)
    inputs = hash_files(file.files, file.path.absolute().parent)
    folder = file.path.parent / ACCEPT.name if output is None else output
    evaluation = ACCEPT.run(inputs, folder, lambda hashes: evaluate_acceptance(file, hashes, progress), force=force)
    return evaluation.verdict == "FAIL"
