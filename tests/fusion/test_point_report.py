"""The report of parallel vibrometer points: tables hold the numbers, the figure is there, result.h5 has the spread."""

from __future__ import annotations

from collections import defaultdict
from dataclasses import replace
from pathlib import Path

import h5py
import numpy as np
import pytest
from page_outline import outline

from fusion.estimation.uncertainty import Contribution, Influence, Uncertainty
from fusion.report.h5 import write_h5
from fusion.report.more_tables import point_tables
from fusion.report.recording import render_report
from fusion.report.signal_figures import draw_points, point_pictures
from fusion.report.style import Picture
from fusion.sensitivity.analyse import Evaluation
from fusion.sensitivity.multipoint_vibrometer import PointRatios, PointSpread, axis_name

FREQUENCY = np.array([106.2503, 212.5006, 425.0012])
PLACE = np.array([[0.03, 0.0], [0.0, 0.03], [-0.03, 0.0], [0.0, -0.03]])


def _uncertainty(lines: int, count: int, u: float) -> Uncertainty:
    noise = Contribution("noise", "A", np.tile(u**2 * np.eye(2 * count), (lines, 1, 1)), np.full(lines, 60.0))
    scale = Influence("laser: scale", "laser: scale", 2.5e-4, "1", np.full((lines, 2 * count), 1e-3), "rig")
    return Uncertainty((noise,), (scale,))


def make_spread(lines: int = 3) -> PointSpread:
    """Four points on a circle that rocks about y: amplitudes differ along x by ±1 %, the third is 0.2 % too low."""
    mean = np.array([100.0, 1.0, 0.5])[:lines] + 0j
    factor = np.array([1.01, 1.0, 0.99 - 0.002, 1.0])
    value = mean[:, None] * factor
    columns = np.stack([np.ones(4), PLACE[:, 1], -PLACE[:, 0]], axis=1)
    plane = value @ np.linalg.pinv(columns).T
    residual = value - plane @ columns.T
    ratios = PointRatios(
        "Fz", "Fz", "V/V", 2e-7 / factor * np.ones((lines, 1)) * np.exp(-0.1j), _uncertainty(lines, 4, 1e-11),
        np.full(lines, 2e-7 * np.exp(-0.1j)),
    )  # fmt: skip
    return PointSpread(
        "laser", "load", FREQUENCY[:lines], ("p1", "p2", "p3", "p4"), np.array([0.0, 0.0, 1.0]),
        np.array([[1.0, 0.0, 0.0], [0.0, 1.0, 0.0]]), PLACE, value, _uncertainty(lines, 4, 0.01), plane,
        _uncertainty(lines, 3, 0.005), residual, _uncertainty(lines, 4, 0.01), ratios,
    )  # fmt: skip


@pytest.fixture(scope="module")
def evaluation(ready_evaluation: Evaluation) -> Evaluation:
    return replace(ready_evaluation, points=(make_spread(),))


def test_tables_hold_the_numbers(evaluation: Evaluation) -> None:
    points, spread, ratios = point_tables(evaluation)
    assert points.caption.startswith("4 points of laser along z on the load at 106.2503 Hz")
    assert points.rows[0][:3] == ("p1", "30.0", "0.0")
    assert points.rows[0][5] == "+1.051"  # 1.01 over the mean of 0.9995
    assert points.rows[2][5] == "\N{MINUS SIGN}1.151"
    values = np.array([1.01, 1.0, 0.988, 1.0])
    assert spread.rows[0][3] == f"{100 * np.std(values, ddof=1) / values.mean():.3g}"
    rocking = 1e6 * 100.0 * (1.01 - 0.988) / 0.06 / (2 * np.pi * 106.2503) ** 2
    assert spread.rows[0][6].startswith(f"{rocking:.3f}")
    assert ratios.rows[0][2] == f"{100 * np.std(1 / values, ddof=1) / np.mean(1 / values):.3g}"
    assert ratios.rows[0][5] == f"+{100 * (np.mean(1 / values) - 1):.3f}"


def test_the_page_shows_points_where_there_are_some(evaluation: Evaluation, monkeypatch: pytest.MonkeyPatch) -> None:
    def only_points(shown: Evaluation) -> dict[str, list[Picture]]:
        return defaultdict(list, points=point_pictures(shown))

    monkeypatch.setattr("fusion.report.recording.draw_all", only_points)
    page = outline(render_report(evaluation))
    assert "points" in page.ids
    assert "figure-points-0" in page.ids
    without = outline(render_report(replace(evaluation, points=())))
    assert "points" not in without.ids


def test_the_figure_is_the_same_every_time(evaluation: Evaluation) -> None:
    (picture,) = point_pictures(evaluation)
    assert picture.svg == draw_points(evaluation.points[0], 0, 0).svg
    assert "425" not in picture.caption


def test_result_file_holds_the_spread(evaluation: Evaluation, tmp_path: Path) -> None:
    write_h5(tmp_path / "result.h5", evaluation, [])
    with h5py.File(tmp_path / "result.h5") as file:
        (group,) = file["points"].values()
        np.testing.assert_array_equal(group["plane"], evaluation.points[0].plane)
        np.testing.assert_array_equal(group["ratios/value"], evaluation.points[0].ratios.value)  # type: ignore[union-attr]


def test_directions_have_names() -> None:
    assert axis_name(np.array([0.0, 0.0, 1.0])) == "z"
    assert axis_name(np.array([0.0, -1.0, 0.0])) == "\N{MINUS SIGN}y"
    assert axis_name(np.array([0.6, 0.8, 0.0])) == "(0.6, 0.8, 0)"


def test_three_points_leave_nothing_to_tell(evaluation: Evaluation) -> None:
    four = make_spread()
    kept = (0, 1, 2)
    three = replace(
        four, channels=four.channels[:3], place_m=PLACE[:3], value=four.value[:, :3],
        uncertainty=four.uncertainty.at(kept), residual=0 * four.residual[:, :3],
        residual_uncertainty=four.residual_uncertainty.at(kept), ratios=None,
    )  # fmt: skip
    points, spread = point_tables(replace(evaluation, points=(three,)))
    assert {row[7] for row in points.rows} == {"–"}
    assert {row[7:] for row in spread.rows} == {("–", "–")}
