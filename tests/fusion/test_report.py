"""The report: one well-formed page that needs nothing else and says what the numbers say."""

from __future__ import annotations

import dataclasses
import html
import re
from pathlib import Path

import numpy as np
import pytest
from evaluation_factory import Choice, make_evaluation
from markupsafe import Markup
from page_outline import outline

from fusion.report.more_tables import budget_tables, other_loads_table
from fusion.report.numbers import degrees_of_freedom, fixed, measured, short, times_ten
from fusion.report.recording import render_report
from fusion.report.tables import headlines, source_tables
from fusion.sensitivity.analyse import Evaluation


@pytest.fixture(scope="module")
def evaluation(tmp_path_factory: pytest.TempPathFactory) -> Evaluation:
    return make_evaluation(tmp_path_factory.mktemp("Fz"))


@pytest.fixture(scope="module")
def page(evaluation: Evaluation) -> str:
    return render_report(evaluation)


def test_page_is_well_formed_and_self_contained(page: str) -> None:
    found = outline(page)
    assert page.startswith("<!doctype html>")
    assert len(found.ids) == len(set(found.ids))
    anchors = [address[1:] for address in found.addresses if address.startswith("#")]
    assert anchors
    assert set(anchors) <= set(found.ids)
    others = [address for address in found.addresses if not address.startswith("#")]
    assert all(address.startswith("data:image/svg+xml,%3Csvg") for address in others)
    assert not re.search(r"url\((?!%23)|@import", page)
    assert len(page.encode()) < 6_000_000


def test_page_shows_results_warnings_and_origin(page: str) -> None:
    text = "".join(outline(page).text)
    assert "(1.9720 ± 0.0019) × 10−7 (V/V)/N" in text
    assert "(−0.03370 ± 0.00099) rad" in text
    assert "318.75 Hz is left out: <u> above its limit & more" in text
    assert text.index("Warning") < text.index("Note")
    assert "cd" * 32 in text
    assert "subset_radius_px" in text
    assert "(6.9605 ± 0.0020) kg" in text
    assert "4.20 ± 0.20" in text  # clock rate in 1e-6


def test_texts_are_escaped(evaluation: Evaluation) -> None:
    manifest = evaluation.manifest
    manifest.rig.name = "<script>alert(1)</script> & co"  # type: ignore[misc]
    page = render_report(dataclasses.replace(evaluation, stereo=(), channels=(), clocks=()))
    outline(page)
    assert html.escape("<script>alert(1)</script> & co") in page


def test_recording_without_anything_to_determine_still_has_a_page(evaluation: Evaluation) -> None:
    bare = dataclasses.replace(
        evaluation, stereo=(), channels=(), clocks=(), accelerations=(), load=None, sensitivity=None, notices=()
    )
    assert "neither an acceleration nor a sensitivity" in "".join(outline(render_report(bare)).text)


def test_undetermined_values_do_not_break_the_page(tmp_path: Path) -> None:
    evaluation = make_evaluation(tmp_path, Choice(frames=24))
    sensitivity = evaluation.sensitivity
    assert sensitivity is not None
    lost = sensitivity.value.copy()
    lost[0] = np.nan
    changed = dataclasses.replace(sensitivity, value=lost)
    page = render_report(dataclasses.replace(evaluation, sensitivity=changed, stereo=evaluation.stereo[:1]))
    assert "nan" not in "".join(outline(page).text).lower().replace("resonan", "")


def test_headlines_name_the_deviation_from_the_static_sensitivity(evaluation: Evaluation) -> None:
    first = headlines(evaluation)[0]
    assert first.label == "Sensitivity Fz per Fz, 106.2503 Hz"
    assert "from static: (−1.40 ± 0.22) %" in first.remark  # 1.972/2 - 1, and 1.96 of 4.9e-4 and 1e-3


def test_sources_stand_side_by_side(evaluation: Evaluation) -> None:
    load, base = source_tables(evaluation)
    assert load.head == ("", "unit", "fused", "photogrammetry", "vibrometer", "accelerometer")
    assert base.head == ("", "unit", "fused")
    assert load.rows[3][4] == "–"


def test_budget_is_sorted_and_its_shares_make_a_whole(evaluation: Evaluation) -> None:
    table, load, motion = budget_tables(evaluation)
    assert table.rows[0][0] == "internal mass"
    assert table.rows[0][2:5] == (Markup("2 × 10<sup>−3</sup> kg"), "−0.13", "−0.13")
    for column in (6, 8):
        assert sum(float(row[column]) for row in table.rows[:-1]) == pytest.approx(100.0, abs=0.4)
    by_name = {row[0]: row for row in table.rows}
    assert by_name["scatter of the sine approximation"][1:5] == ("A, 204", "–", "–", "–")
    assert by_name["delay of the exposure"][2:5] == (Markup("1 × 10<sup>−7</sup> s"), "≈ 0", "−670")
    assert "load Fz" in load.caption
    assert "acceleration z of the load" in motion.caption


def test_what_other_loads_explain(evaluation: Evaluation) -> None:
    table = other_loads_table(evaluation)
    assert table is not None
    shares = {row[0]: row[1:] for row in table.rows}
    assert shares["Fz"][0] == "0"  # the static sensitivity of the factory is diagonal
    # Fx: 5.1e-7 V/V/N times 0.33 m/s² times 7.7 kg over an output of 3e-7 V/V: several times the whole output.
    assert float(shares["Fx"][0].partition(" ")[0].replace("−", "-")) != 0.0
    assert other_loads_table(dataclasses.replace(evaluation, load=None)) is None


def test_weak_components_are_judged_by_their_region(evaluation: Evaluation) -> None:
    load = source_tables(evaluation)[0]
    weak = load.rows[5][2]  # rz: 0.06 - 0.02j rad/s² ± 0.4
    assert "not distinguishable from 0" in weak
    assert weak.startswith("region ± ")
    strong = load.rows[2][2]
    assert "189" in strong
    assert "k = 1.97" in strong


def test_numbers_as_html() -> None:
    assert short(9.97e-5) == Markup("1 × 10<sup>−4</sup>")
    assert short(-502.0) == Markup("−500")
    assert (degrees_of_freedom(999.6), degrees_of_freedom(1e5), degrees_of_freedom(np.inf)) == ("1000", "> 1000", "∞")
    assert measured(1.9719871e-7, 2.04e-10, "(V/V)/N") == Markup("(1.9720 ± 0.0020) × 10<sup>−7</sup> (V/V)/N")
    assert measured(1.0, 0.5) == Markup("1.00 ± 0.50")
    assert measured(2.5, 0.0, "m/s^2") == Markup("2.5 m/s²")
    assert fixed(2.1e-10, 6.1e-11, -7) == Markup("0.00210 ± 0.00061")
    assert times_ten(0, "N.m") == Markup("N·m")
