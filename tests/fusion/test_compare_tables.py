"""Tables of other laboratories: columns named once, repeated frequencies, signs, uncertainties by a formula."""

from __future__ import annotations

import csv
from collections import defaultdict
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from support import refusals, rows

from fusion.cli import main
from fusion.report.h5 import open_results, read_notices

FREQUENCY = np.array([10.0, 16.0, 25.0, 40.0, 63.0, 100.0, 160.0, 250.0])
COLUMNS = """format = 1
[columns]
frequency = "f"
magnitude = "S"
u_magnitude = "U(S)"
phase = "phi"
u_phase = "U(phi)"
channel = "acc"
component = "a_z"
"""
OF_OTHER = """[columns_of.other]
phase_unit = "deg"
u_magnitude_unit = "%"
magnitude_unit = "mV/(m/s^2)"
k = 2
"""


def _table(
    path: Path, draws: np.random.Generator, *, repeats: int, write: Callable[[complex, float], list[float]]
) -> None:
    """Write a table of a sensitivity of 1 V/(m/s²) with a lag of 20 µs and a scatter of 0.1 %."""
    order = draws.permutation(np.repeat(FREQUENCY, repeats))
    with path.open("w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file)
        writer.writerow(["", "f", "S", "U(S)", "phi", "U(phi)"])
        for index, f in enumerate(order.tolist()):
            error = 1e-3 * (draws.standard_normal() + 1j * draws.standard_normal())
            share = 1e-3 * float(draws.uniform(0.7, 1.4))
            writer.writerow([index, f, *write(complex((1.0 + error) * np.exp(-2j * np.pi * f * 20e-6)), share)])


def _radians(value: complex, share: float) -> list[float]:
    return [abs(value), share * abs(value), float(np.angle(value)), 1e-3]


def _degrees(value: complex, share: float) -> list[float]:
    return [1e3 * abs(value), 200.0 * share, float(np.degrees(np.angle(-value))), float(np.degrees(2e-3))]


def _words(place: Path, columns: str) -> list[str]:
    """Write the file of columns, and return the command."""
    (place / "columns.toml").write_text(columns, encoding="utf-8")
    words = ["compare", f"one={place / 'one.csv'}", f"other={place / 'other.csv'}", "-o", str(place / "out"), "-q"]
    return [*words, "--columns", str(place / "columns.toml")]


def _compare(place: Path, columns: str) -> tuple[list[dict[str, str]], set[str]]:
    """Compare two tables, and return the rows and the codes of the notices."""
    assert main(_words(place, columns)) == 0
    with open_results(place / "out" / "comparison.h5") as file:
        codes = {notice.code for notice in read_notices(file)}
    return rows(place / "out" / "comparison.csv"), codes


def test_units_signs_and_loops_of_two_laboratories(tmp_path: Path) -> None:
    """One states V/(m/s²), rad and u, the other mV/(m/s²), deg, per cent, U with k = 2, and the opposite sign."""
    draws = np.random.default_rng(3)
    _table(tmp_path / "one.csv", draws, repeats=9, write=_radians)
    _table(tmp_path / "other.csv", draws, repeats=5, write=_degrees)
    of_both = COLUMNS.replace("component", 'magnitude_unit = "V/(m/s^2)"\ncomponent')
    found, codes = _compare(tmp_path, of_both + OF_OTHER)
    assert len(found) == 2 * 2 * len(FREQUENCY)
    phases = [row for row in found if row["quantity"] == "phase"]
    assert {row["sign_changed"] for row in phases if row["result"] == "one"} == {"no"}
    assert {row["sign_changed"] for row in phases if row["result"] == "other"} == {"yes"}
    for row in phases:
        assert float(row["value"]) == pytest.approx(-2 * np.pi * float(row["frequency_hz"]) * 20e-6, abs=4e-3)
    for row in (row for row in found if row["quantity"] == "magnitude"):
        assert float(row["value"]) == pytest.approx(1.0, abs=4e-3), "in the first result's unit"
        assert 0.9e-3 < float(row["u"]) < 1.5e-3, "repetition does not reduce the stated uncertainty"
    assert sum(abs(float(row["E_n_largest_pair"])) > 1.0 for row in found) <= 2
    assert "SC-778" in codes
    assert "SC-971" not in codes, "each point has its uncertainty"


def test_an_uncertainty_by_a_formula_is_named(tmp_path: Path) -> None:
    draws = np.random.default_rng(4)
    _table(tmp_path / "one.csv", draws, repeats=3, write=_radians)
    _table(tmp_path / "other.csv", draws, repeats=3, write=lambda value, _: _radians(value, 1e-3))
    assert "SC-971" in _compare(tmp_path, COLUMNS)[1]


@pytest.mark.parametrize(
    ("columns", "key"),
    [
        (COLUMNS.replace('"S"', '"T"', 1), "columns"),
        (COLUMNS.replace("u_phase", "u_phases"), "columns.u_phases"),
        (COLUMNS + "[columns_of.third]\nk = 2\n", "columns_of.third"),
        (COLUMNS + '[columns_of.other]\nk = "2"\n', "columns_of.other.k"),
        ("format = 1\ncolumns = 3\n", "columns"),
        ("format = 1\n[columns_of]\nother = 3\n", "columns_of.other"),
    ],
)
def test_wrong_columns_are_one_sentence(
    tmp_path: Path, columns: str, key: str, capsys: pytest.CaptureFixture[str]
) -> None:
    draws = np.random.default_rng(5)
    for name in ("one", "other"):
        _table(tmp_path / f"{name}.csv", draws, repeats=2, write=_radians)
    assert key in refusals(capsys)(*_words(tmp_path, columns))
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize("cell", ["0.0", "-1", "nan", "x", ""])
def test_wrong_cells_are_one_sentence(tmp_path: Path, cell: str, capsys: pytest.CaptureFixture[str]) -> None:
    for name in ("one", "other"):
        _table(tmp_path / f"{name}.csv", np.random.default_rng(5), repeats=2, write=_radians)
    lines = (tmp_path / "other.csv").read_text(encoding="utf-8").splitlines()
    parts = lines[3].split(",")
    lines[3] = ",".join([*parts[:2], cell, *parts[3:]])
    (tmp_path / "other.csv").write_text("\n".join(lines), encoding="utf-8")
    assert "other.csv" in refusals(capsys)(*_words(tmp_path, COLUMNS))
    assert not (tmp_path / "out").exists()


def _loops(path: Path) -> dict[float, np.ndarray]:
    """Return magnitude, phase and their stated uncertainties of every loop, by frequency."""
    loops: dict[float, list[list[float]]] = defaultdict(list)
    for row in rows(path):
        loops[round(float(row["freqs"]), 3)].append(
            [float(row[key]) for key in ("mag", "phase", "maguncer", "phaseuncer")]
        )
    return {f: np.array(loops[f]) for f in sorted(loops)}


@pytest.mark.parametrize("copy", ["MPU9250_CEM", "MPU9250_CEM_uncer_from_S"])
def test_two_institutes_and_one_accelerometer(tmp_path: Path, data_dir: Path, copy: str) -> None:
    """E_n of every frequency against an independent computation, of 17 frequencies with nine or ten loops each."""
    data = data_dir / "accelerometer_two_institutes"
    columns = COLUMNS.replace('"f"', '"freqs"').replace('"S"', '"mag"').replace('"U(S)"', '"maguncer"')
    columns = columns.replace('"phi"', '"phase"').replace('"U(phi)"', '"phaseuncer"') + "k = 2\n"
    for name, file in (("one", "MPU9250_PTB"), ("other", copy)):
        (tmp_path / f"{name}.csv").write_bytes((data / f"{file}.csv").read_bytes())
    found, codes = _compare(tmp_path, columns)
    first, second = _loops(tmp_path / "one.csv"), _loops(tmp_path / "other.csv")
    assert len(found) == 4 * 17
    for f, one, other in ((f, first[f], second[f]) for f in first):
        expected = []
        for loops in (one, other):
            u = np.hypot(loops[:, 2:].mean(axis=0) / 2.0, loops[:, :2].std(axis=0, ddof=1) / np.sqrt(len(loops)))
            expected.append((loops[:, :2].mean(axis=0), u))
        difference = expected[1][0] - expected[0][0]
        difference[1] -= np.pi
        assert -0.0037 <= difference[0] / expected[0][0][0] <= -0.0009 + 5e-6
        assert abs(difference[1]) < 2.2e-3
        normalised = np.abs(difference) / (2.0 * np.hypot(expected[0][1], expected[1][1]))
        here = [row for row in found if float(row["frequency_hz"]) == pytest.approx(f)]
        for row in here:
            index = ("magnitude", "phase").index(row["quantity"])
            assert abs(float(row["E_n_largest_pair"])) == pytest.approx(normalised[index], rel=0.01, abs=1e-3)
    assert "SC-778" in codes
    assert ("SC-971" in codes) == (copy == "MPU9250_CEM")
