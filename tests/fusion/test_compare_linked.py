"""Key comparisons: degrees of equivalence, procedure B, rounds linked by a pilot, stability of the artefact."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from datetime import date
from pathlib import Path

import numpy as np
import pytest
from page_outline import self_contained
from support import refusals, rows

from fusion.cli import main
from fusion.report.h5 import open_results, read_notices
from fusion.sensitivity.input_evidence import InputEvidence
from fusion.sensor import result_notices as raised
from fusion.sensor.compare.comparison_evaluation import (
    PROCEDURE_A,
    ComparedQuantity,
    ComparisonEvaluation,
    ComparisonMethod,
    evaluate_comparison,
)
from fusion.sensor.compare.comparison_inputs import ComparedResult, ComparedValue, year_of
from fusion.sensor.compare.consistency import median_reference, pair_differences, reference_value

SHARED = InputEvidence("mass", "mass", 1.0, 1e-3, "kg", "M-1", "", "", "")
FREQUENCIES = 40.0 * 1.4 ** np.arange(12)
U = {"ptb": 2e-3, "nist": 3e-3, "cem": 2.5e-3, "kriss": 4e-3, "nim": 3e-3, "lab": 3e-3, "inm": 5e-3}
U_SHARED = 4e-3
"""Relative u that two results have in common, and in mrad/1000 that of their phases."""


def result(
    name: str, error: np.ndarray, u: float, shared: float | None = None, artefact: complex = 2.0, year: float = np.nan
) -> ComparedResult:
    """A result over 12 frequencies with errors (12, 2) in u, and the error of the shared input in its u."""
    common = 0.0 if shared is None else U_SHARED
    total = float(np.hypot(u, common))
    values = []
    for frequency_hz, (along, across) in zip(FREQUENCIES, error, strict=True):
        change = u * along + common * (shared or 0.0)
        turn = u * across - common * (shared or 0.0)
        size, phase = abs(artefact) * (1.0 + change), float(np.angle(artefact)) + turn
        effects = {} if shared is None else {"mass": (U_SHARED, -U_SHARED)}
        named = float(frequency_hz), "Fz", "Fz", False, "V/N"
        values.append(ComparedValue(*named, size, size * total, phase, total, effects, year))
    evidence = () if shared is None else (SHARED,)
    return ComparedResult(name, Path(f"{name}.csv"), tuple(values), evidence=evidence)


def compared(results: Sequence[ComparedResult], method: ComparisonMethod = PROCEDURE_A) -> ComparisonEvaluation:
    return evaluate_comparison(results, {}, 1e-3, {}, method)


def covered(evaluation: ComparisonEvaluation, names: Sequence[str]) -> list[bool]:
    """Whether U covers the degrees of equivalence; the truth of all is 0."""
    every = [(found, found.names.index(name)) for found in evaluation.quantities for name in names]
    return [bool(abs(found.reference.normalised[n]) <= 1.0) for found, n in every if found.reference.used.any()]


def complex_pairs(evaluation: ComparisonEvaluation) -> list[float]:
    """Return E_n of the complex values of all pairs."""
    every = [found.complex_normalised for found in evaluation.quantities if found.complex_normalised is not None]
    return [float(e_n) for found in every for e_n in found[np.triu_indices(len(found), 1)]]


# Degrees of equivalence of one round.


@pytest.mark.slow
def test_u_covers_the_degrees_of_equivalence_of_five_laboratories_in_95_percent() -> None:
    """250 comparisons, two laboratories share an input; the truth is that all measure one artefact."""
    rng, names, found, pairs = np.random.default_rng(3), ["ptb", "nist", "cem", "kriss", "nim"], [], []
    both = list[float]()
    for _ in range(250):
        mass = float(rng.standard_normal())
        drawn = [result(n, rng.standard_normal((12, 2)), U[n], mass if n in names[:2] else None) for n in names]
        evaluation = compared(drawn)
        found += covered(evaluation, names)
        pairs += [np.abs(q.normalised[np.triu_indices(5, 1)]) <= 1.0 for q in evaluation.quantities]
        both += complex_pairs(evaluation)
    assert 0.93 <= np.mean(found) <= 0.97
    assert 0.93 <= np.mean(pairs) <= 0.97
    assert 0.93 <= np.mean(np.array(both) <= 1.0) <= 0.97, "magnitude and phase together"


def test_pairs_have_the_u_of_their_difference() -> None:
    covariance = np.array([[4.0, 1.0], [1.0, 9.0]])
    difference, expanded = pair_differences(np.array([5.0, 3.0]), covariance)
    assert difference[0, 1] == 2.0
    assert expanded[0, 1] == pytest.approx(2.0 * (4.0 + 9.0 - 2.0) ** 0.5)


# Procedure B.


@pytest.mark.parametrize(("count", "variance"), [(3, 0.44867), (5, 0.28683), (7, 0.21045)])
def test_the_median_of_equal_results_has_the_variance_of_order_statistics(count: int, variance: float) -> None:
    """Variance of the median of a normal sample, as tabulated (Sarhan and Greenberg 1962)."""
    found = median_reference(np.full(count, 7.0), np.eye(count))
    assert found.value == pytest.approx(7.0, abs=0.01)
    assert found.u == pytest.approx(variance**0.5, rel=0.01)
    assert found.interval == pytest.approx((7.0 - 1.96 * variance**0.5, 7.0 + 1.96 * variance**0.5), abs=0.04)


def test_the_median_of_separate_results_is_the_middle_one_whatever_an_outlier() -> None:
    value, u = np.array([1.0, 2.0, 3.0, 2.5, 90.0]), np.array([0.01, 0.02, 0.01, 0.015, 0.3])
    found = median_reference(value, np.diag(u**2))
    assert (found.value, found.u) == pytest.approx((2.5, 0.015), rel=0.01)
    assert found.deviation == pytest.approx(value - 2.5, abs=1e-3)
    expected = 1.96 * np.hypot(u, 0.015)
    expected[3] = 0.0  # it is the median in every draw
    assert found.expanded == pytest.approx(expected, rel=0.03, abs=1e-3)
    assert found.used.all()
    assert not reference_value(value[[0, 1, 3, 4]], np.diag(u[[0, 1, 3, 4]] ** 2)).used.any()


def test_an_error_of_all_results_is_an_error_of_the_median_and_of_no_deviation() -> None:
    alone = median_reference(np.zeros(3), np.eye(3))
    found = median_reference(np.zeros(3), np.eye(3) + 100.0)
    assert found.u == pytest.approx(np.hypot(10.0, 0.44867**0.5), rel=0.01)
    assert found.expanded == pytest.approx(alone.expanded, rel=0.02)


# Rounds linked by a pilot.


def two_rounds(rng: np.random.Generator, mass: float | None) -> list[ComparedResult]:
    """A key comparison of four, and a regional one with another artefact; the pilot's results share an input."""
    key = [result(f"kc/{n}", rng.standard_normal((12, 2)), U[n], mass if n == "ptb" else None) for n in list(U)[:4]]
    other = {"ptb": mass, "lab": None, "inm": None}
    artefact = 7.0 * np.exp(2.0j)
    return key + [result(f"rc/{n}", rng.standard_normal((12, 2)), U[n], m, artefact) for n, m in other.items()]


def test_a_link_by_one_pilot_is_the_closed_form() -> None:
    """Of phases: d = x - x_pilot + d_pilot, with U by the covariance of all results written out."""
    evaluation = compared(two_rounds(np.random.default_rng(1), 0.7))
    assert evaluation.laboratories == ["kc/ptb", "kc/nist", "kc/cem", "kc/kriss", "rc/lab", "rc/inm"]
    stated = {result.name: result.values[0] for result in evaluation.results}
    phase: ComparedQuantity = next(q for q in evaluation.quantities if q.quantity == "phase")
    names = list(stated)
    x = np.array([stated[name].phase_rad for name in names])
    covariance = np.diag([stated[name].u_phase_rad ** 2 for name in names])
    covariance[0, 4] = covariance[4, 0] = U_SHARED**2  # the pilot's results
    u = np.array([stated[name].u_phase_rad for name in names[:4]])
    weights = np.append(u**-2 / np.sum(u**-2), np.zeros(3))
    pilot = np.eye(7)[0] - weights
    for name in ("rc/lab", "rc/inm"):
        row = np.eye(7)[names.index(name)] - np.eye(7)[4] + pilot
        n = phase.names.index(name)
        assert phase.reference.deviation[n] == pytest.approx(row @ x, abs=1e-12)
        assert phase.reference.expanded[n] == pytest.approx(2.0 * (row @ covariance @ row) ** 0.5, rel=1e-9)
    alone = compared(evaluation.results[:4])
    of_key = next(q for q in alone.quantities if q.quantity == "phase").reference
    assert phase.reference.deviation[:4] == pytest.approx(of_key.deviation), "a link leaves the key comparison as it is"
    assert phase.reference.expanded[:4] == pytest.approx(of_key.expanded)


def test_magnitudes_are_linked_in_relative_terms() -> None:
    evaluation = compared(two_rounds(np.random.default_rng(1), None))
    stated = {result.name: result.values[0].magnitude for result in evaluation.results}
    found = evaluation.quantities[0]
    n = found.names.index("rc/lab")
    assert found.value[n] == pytest.approx(stated["rc/lab"] * stated["kc/ptb"] / stated["rc/ptb"])
    relative = [U["lab"], U["ptb"], U["ptb"]]
    assert found.u[n] / found.value[n] == pytest.approx(np.linalg.norm(relative), rel=0.01)
    assert found.complex_normalised is not None
    assert np.isfinite(found.complex_normalised).all()


def test_two_linking_laboratories_are_weighted_and_tested() -> None:
    """The difference of artefacts is the mean of both differences, weighted by their variances."""
    rng = np.random.default_rng(2)
    results = [*two_rounds(rng, None), result("rc/nist", rng.standard_normal((12, 2)), U["nist"], None, 7 * np.exp(2j))]
    evaluation = compared(results)
    stated = {one.name: one.values[0] for one in evaluation.results}
    link = next(link for link in evaluation.links if link.quantity == "phase")
    assert set(link.laboratories) == {"ptb", "nist"}
    both = np.array([stated[f"rc/{n}"].phase_rad - stated[f"kc/{n}"].phase_rad for n in ("ptb", "nist")])
    weights = np.array([U[n] ** -2 for n in ("ptb", "nist")])
    assert link.transfer == pytest.approx(weights @ both / weights.sum())
    assert link.u == pytest.approx((0.5 * weights.sum()) ** -0.5)
    assert 0.0 < link.p < 1.0
    only = compared(results, ComparisonMethod(link=("ptb",)))
    assert {one.laboratories for one in only.links} == {("ptb",)}
    assert "rc/nist" in only.laboratories, "as a laboratory of its own in this round"
    shifted = [*results[:-1], result("rc/nist", np.full((12, 2), 12.0), U["nist"], None, 7 * np.exp(2j))]
    assert raised.LINKS_INCONSISTENT.code in {notice.code for notice in compared(shifted).notices}


def test_values_without_a_link_are_not_compared() -> None:
    """The pilot has no phase in the second round, and no value at its last frequency."""
    results = two_rounds(np.random.default_rng(1), 0.4)
    values = tuple(replace(value, phase_rad=None, u_phase_rad=np.nan) for value in results[4].values[:-1])
    evaluation = compared([*results[:4], replace(results[4], values=values), *results[5:]])
    magnitudes = [found for found in evaluation.quantities if found.quantity == "magnitude"]
    assert [len(found.names) for found in magnitudes] == [6] * 11 + [4]
    assert {name for name, _ in evaluation.unmatched} == {"rc/lab", "rc/inm"}
    phases = [found for found in evaluation.quantities if found.quantity == "phase"]
    assert {found.names for found in phases} == {("kc/ptb", "kc/nist", "kc/cem", "kc/kriss")}
    assert {link.quantity for link in evaluation.links} == {"magnitude"}


def test_the_sign_of_a_linked_laboratory_is_recognised() -> None:
    results = two_rounds(np.random.default_rng(1), 0.4)
    values = tuple(replace(value, phase_rad=(value.phase_rad or 0.0) + np.pi) for value in results[5].values)
    evaluation = compared([*results[:5], replace(results[5], values=values), results[6]])
    phases = [found for found in evaluation.quantities if found.quantity == "phase"]
    assert {found.opposite_sign for found in phases} == {("rc/lab",)}
    assert max(abs(found.reference.deviation).max() for found in phases) < 0.05


@pytest.mark.slow
def test_u_covers_the_degrees_of_equivalence_of_linked_laboratories_in_95_percent() -> None:
    """250 comparisons of two rounds with different artefacts, the pilot's results share an input."""
    rng, found, linked, both = np.random.default_rng(4), [], [], list[float]()
    for _ in range(250):
        evaluation = compared(two_rounds(rng, float(rng.standard_normal())))
        found += covered(evaluation, evaluation.laboratories[:4])
        linked += covered(evaluation, ["rc/lab", "rc/inm"])
        both += complex_pairs(evaluation)
    assert 0.93 <= np.mean(found) <= 0.97
    assert 0.93 <= np.mean(linked) <= 0.97
    assert 0.93 <= np.mean(np.array(both) <= 1.0) <= 0.97, "magnitude and phase together"


# Stability of the artefact.


def dated_round(rng: np.random.Generator, per_year: float) -> list[ComparedResult]:
    """Three results of the pilot over a year, and three laboratories between; the artefact changes per year."""
    stations = [("ptb@2024-01-01", "ptb"), ("nist", "nist"), ("ptb@2024-07-01", "ptb"), ("cem", "cem")]
    found = []
    for n, (name, laboratory) in enumerate([*stations, ("nim", "nim"), ("ptb@2025-01-01", "ptb")]):
        year = 2024.0 + 0.2 * n
        u = 0.5 * U[laboratory]
        found.append(
            result(name, rng.standard_normal((12, 2)), u, None, 2.0 * (1.0 + per_year * (year - 2024.5)), year)
        )
    return found


def test_repeats_of_a_stable_artefact_are_one_result() -> None:
    evaluation = compared(dated_round(np.random.default_rng(6), 0.0))
    assert evaluation.laboratories == ["ptb", "nist", "cem", "nim"]
    assert len(evaluation.stability) == 24
    assert np.mean([one.removed for one in evaluation.stability]) < 0.25, "one in twenty by chance"
    stable = next(q for q, s in zip(evaluation.quantities, evaluation.stability, strict=True) if not s.removed)
    assert stable.u[0] / stable.value[0] == pytest.approx(0.5 * U["ptb"] / 3**0.5, rel=0.01)


@pytest.mark.slow
def test_a_drift_of_the_artefact_is_removed_and_covered() -> None:
    """2 % per year, eight times U of the laboratories; all measure the same artefact at its day."""
    rng, found, slopes, u = np.random.default_rng(7), [], [], 0.0
    for _ in range(60):
        evaluation = compared(dated_round(rng, 0.02))
        found += [c for q in evaluation.quantities[::2] for c in np.abs(q.reference.normalised) <= 1.0]
        magnitudes = [one for one in evaluation.stability if one.quantity == "magnitude"]
        assert all(one.removed for one in magnitudes)
        slopes += [one.per_year for one in magnitudes]
        u = magnitudes[0].u_per_year
    assert raised.DRIFT_REMOVED.code in {notice.code for notice in evaluation.notices}
    assert 0.93 <= np.mean(found) <= 0.97
    assert np.mean(slopes) == pytest.approx(0.02, abs=4.0 * u / len(slopes) ** 0.5 + 1e-4)
    assert np.std(slopes) == pytest.approx(u, rel=0.1)


def test_a_drift_is_only_reported_if_a_day_is_missing() -> None:
    results = dated_round(np.random.default_rng(8), 0.02)
    results[1] = result("nist", np.zeros((12, 2)), U["nist"])
    evaluation = compared(results)
    assert not any(one.removed for one in evaluation.stability)
    assert raised.DRIFT_NOT_REMOVED.code in {notice.code for notice in evaluation.notices}


# The command.


def write_round(folder: Path, results: Sequence[ComparedResult]) -> list[str]:
    """Write results as tables, and return the arguments that name them."""
    head, arguments = "frequency_hz,channel,component,magnitude,u_magnitude,phase_rad,u_phase_rad,unit", []
    for n, one in enumerate(results):
        lines = [
            f"{v.frequency_hz},Fz,Fz,{v.magnitude},{v.u_magnitude},{v.phase_rad},{v.u_phase_rad},V/N"
            for v in one.values
        ]
        (folder / f"{n}.csv").write_text("\n".join([head, *lines]) + "\n")
        arguments.append(f"{one.name}={folder / f'{n}.csv'}")
    return arguments


def test_page_and_files_of_a_linked_comparison(tmp_path) -> None:
    arguments = write_round(tmp_path, two_rounds(np.random.default_rng(5), None))
    out = tmp_path / "out"
    assert main(["compare", *arguments, "--link", "ptb", "--reference", "median", "-o", str(out), "-q"]) == 0
    table = rows(out / "comparison.csv")
    assert {row["result"] for row in table} == {"kc/ptb", "kc/nist", "kc/cem", "kc/kriss", "rc/lab", "rc/inm"}
    assert {row["in_reference"] for row in table if row["result"].startswith("rc/")} == {"no"}
    with open_results(out / "comparison.h5") as file:
        group = file["comparison/0"]
        assert group["U_difference"].shape == group["difference"].shape == (6, 6)
        low, high = group["reference_interval"]
        assert low < float(table[0]["reference"]) < high
    page = self_contained((out / "comparison.html").read_text(encoding="utf-8"))
    text = "".join(page.text)
    for part in ("Participants", "Results as stated", "Degrees of equivalence", "Pairs of laboratories", "Consistency"):
        assert part in text
    assert "linked by" in text


def test_dates_in_names_date_the_results(tmp_path) -> None:
    arguments = write_round(tmp_path, dated_round(np.random.default_rng(9), 0.02))
    dates = [f"{name}=2024-05-01" for name in ("nist", "cem", "nim")]
    out = tmp_path / "out"
    more = [text for day in dates for text in ("--date", day)]
    assert main(["compare", *arguments, *more, "-o", str(out), "-q"]) == 0
    with open_results(out / "comparison.h5") as file:
        assert raised.DRIFT_REMOVED.code in {notice.code for notice in read_notices(file)}
        assert year_of(date(2024, 1, 1)) < file["comparison/0/year"][0] < year_of(date(2025, 1, 1))


@pytest.mark.parametrize(
    ("names", "more", "found"),
    [
        (("kc/a", "kc/b", "rc/c"), [], f"{raised.ROUND_NOT_LINKED.code} "),
        (("kc/a", "kc/b", "rc/b"), ["--link", "a"], f"{raised.WRONG_COMPARISON_OPTION.code} --link: a: "),
        (("a", "b@March"), [], f"{raised.WRONG_COMPARISON_OPTION.code} --date: b@March: "),
        (("kc/a", "rc/a", "rc/b"), [], f"{raised.WRONG_RESULT_COUNT.code} "),
    ],
)
def test_wrong_names_are_one_sentence(tmp_path, capsys, names, more, found) -> None:
    arguments = write_round(tmp_path, [result(name, np.zeros((12, 2)), 1e-3) for name in names])
    assert found in refusals(capsys)("compare", *arguments, *more, "-o", tmp_path / "out")
