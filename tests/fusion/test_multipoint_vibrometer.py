"""Parallel vibrometer points: rigid motion by hand, numpy's own statistics, drawn errors; tables, figure and file."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import h5py
import numpy as np
import pytest
from instrument_factory import channel_entry, with_values
from numpy.typing import NDArray
from page_outline import outline

from fusion.estimation.fuse import fuse
from fusion.estimation.measurement_model import Observation
from fusion.estimation.uncertainty import Contribution, Influence, Uncertainty
from fusion.instruments.channel import ChainUncertainty, ChannelReading, delay_errors, observe_channels, output_phasors
from fusion.instruments.vibrometer import PointRatios, PointSpread, axis_name, point_spreads
from fusion.report.figure import Figure
from fusion.report.recording_report import render_report, write_h5
from fusion.report.result_figures import point_figures
from fusion.report.uncertainty_tables import point_tables
from fusion.sensitivity.analyse import Evaluation
from fusion.sensitivity.load_phasors import load_phasors
from fusion.sensitivity.moving_body import Body, make_moving_part
from fusion.sensitivity.ratio import Sensitivity, sensitivity_ratio, with_ratios
from shaker.sine.phasor import Phasors

ComplexArray = NDArray[np.complex128]
LINES_HZ = np.array([375.9, 751.8])
OMEGA = 2 * np.pi * LINES_HZ
TRUTH = np.array([[0, 0, 60.0, 9j, -14.0, 0], [0, 0, 0.3 - 0.1j, 0.05, 0.02j, 0]], dtype=np.complex128)
ANGLE = np.deg2rad([0, 90, 180, 270, 45, 135, 225, 315])
RADIUS = np.repeat([0.022, 0.048], 4)
POINTS = [(r * np.cos(a), r * np.sin(a), 0.0973) for r, a in zip(RADIUS, ANGLE, strict=True)]
STATED: dict[str, Any] = {"scale_uncertainty": 2.5e-4, "point_uncertainty": (5e-4,) * 3, "individual_uncertainty": 1e-4}
BODY = Body((make_moving_part("load", 6.9605, [0, 0, 0], np.diag([0.01] * 3), (1e-3, 0.0, 0.0)),))
SENSITIVITY = 2e-7 * np.exp(-0.1j)


def _reading(value: ComplexArray, sigma: float, unit: str, u_clock_s: float = 0.0, **entry: Any) -> ChannelReading:
    covariance = np.repeat(sigma**2 * np.eye(2)[None], len(LINES_HZ), axis=0)
    name = str(entry["name"])
    found = Phasors(LINES_HZ, value[:, None], covariance, (name,), (unit,), np.full(len(LINES_HZ), 200.0))
    tied = delay_errors("clock daq: time", LINES_HZ, u_clock_s)
    return ChannelReading(channel_entry(**{"common": "laser"} | entry), found, ChainUncertainty(), tied)


def lasers(
    points: Sequence[Sequence[float]] = POINTS, sigma: float = 1e-8, u_clock_s: float = 0.0, **stated: Any
) -> Observation:
    """Velocities along z without any error, as v = (a_z + α_x·y − α_y·x)/(jω)."""
    readings = []
    for number, point in enumerate(points):
        value = (TRUTH[:, 2] + TRUTH[:, 3] * point[1] - TRUTH[:, 4] * point[0]) / (1j * OMEGA)
        readings.append(_reading(value, sigma, "m/s", u_clock_s, name=f"p{number}", point=tuple(point), **stated))
    (observation,) = observe_channels(readings)
    return observation


def spread_of(observation: Observation) -> PointSpread:
    (found,) = point_spreads([observation], [fuse([observation])])
    return found


def test_a_rigid_motion_is_a_plane():
    spread = spread_of(lasers())
    expected = np.array([TRUTH[:, 2] + TRUTH[:, 3] * y - TRUTH[:, 4] * x for x, y, _ in POINTS]).T
    np.testing.assert_allclose(spread.value, expected, rtol=1e-12)
    np.testing.assert_allclose(spread.plane, TRUTH[:, 2:5], rtol=1e-10)
    np.testing.assert_allclose(spread.residual, 0.0, atol=1e-12)
    np.testing.assert_allclose(spread.axes, [[1, 0, 0], [0, 1, 0]], atol=1e-15)
    np.testing.assert_allclose(spread.place_m, np.array(POINTS)[:, :2], atol=1e-15)
    assert spread.channels == tuple(f"p{n}" for n in range(8))
    np.testing.assert_allclose(spread.amplitude_spread[0], np.std(np.abs(expected[0]), ddof=1) / 60.0, rtol=1e-12)


def test_one_point_apart_is_what_the_plane_leaves():
    """The plane through seven equal points and one 3 % higher, by numpy's least squares."""
    observation = lasers()
    spread = spread_of(with_values(observation, observation.phasors.value * np.where(np.arange(8) == 5, 1.03, 1.0)))
    columns = np.array([[1.0, y, -x] for x, y, _ in POINTS])
    best = np.linalg.lstsq(columns.astype(np.complex128), spread.value.T, rcond=None)[0]
    np.testing.assert_allclose(spread.plane, best.T, rtol=1e-9)
    np.testing.assert_allclose(spread.residual, spread.value - (columns @ best).T, atol=1e-10)
    assert int(np.argmax(np.abs(spread.residual[0]))) == 5
    assert spread.left_relative[0] > 10 * spread.left_expected[0]


def test_points_may_look_the_other_way_and_along_any_axis():
    points, sign = [(0.05, 0.03, 0.0), (0.05, -0.03, 0.02), (0.05, 0.0, -0.04)], (1.0, -1.0, 1.0)
    value = [TRUTH[:, 4] * z - TRUTH[:, 5] * y for _, y, z in points]
    readings = [
        _reading(s * v / (1j * OMEGA), 1e-8, "m/s", name=f"p{n}", point=p, direction=(s, 0.0, 0.0))
        for n, (s, v, p) in enumerate(zip(sign, value, points, strict=True))
    ]
    spread = spread_of(*observe_channels(readings))
    np.testing.assert_allclose(spread.direction, [1.0, 0.0, 0.0], atol=1e-15)
    np.testing.assert_allclose(spread.value, np.array(value).T, atol=1e-12)
    np.testing.assert_allclose(spread.plane[:, 1:], TRUTH[:, 4:6], atol=1e-9)


@pytest.mark.parametrize("points", [POINTS[:2], [(x, 0.0, 0.0) for x in (-0.04, 0.0, 0.02, 0.04)]])
def test_fewer_than_three_points_or_a_line_of_them_are_no_plane(points):
    observation = lasers(points)
    assert point_spreads([observation], [fuse([observation])]) == ()


def test_a_common_scale_is_in_the_mean_and_not_in_what_the_plane_leaves():
    spread = spread_of(lasers(sigma=1e-12, scale_uncertainty=2.5e-4))
    u_mean = np.sqrt(np.trace(spread.plane_uncertainty.at([0]).covariance, axis1=1, axis2=2))
    np.testing.assert_allclose(u_mean, 2.5e-4 * np.abs(TRUTH[:, 2]), rtol=1e-4)
    assert (spread.left_expected < 1e-6).all()


def test_drawn_errors_are_covered():
    """300 draws of scale, placement and noise: normalised errors of mean and rocking have unit variance."""
    rng, observation = np.random.default_rng(4), lasers(sigma=2e-6, **STATED)
    spread, columns = spread_of(observation), np.array([[1.0, y, -x] for x, y, _ in POINTS])
    u = np.sqrt(spread.plane_uncertainty.covariance.diagonal(axis1=1, axis2=2))
    left, normalised = [], []
    for _ in range(300):
        error = np.sum([rng.normal() * common.effect(TRUTH) for common in observation.common], axis=0)
        error = error + 2e-6 * (rng.normal(size=(2, 8)) + 1j * rng.normal(size=(2, 8)))
        value = (observation.phasors.value + error) * (1j * OMEGA[:, None])
        plane = np.linalg.lstsq(columns, value.T, rcond=None)[0].T
        off = plane - TRUTH[:, 2:5]
        normalised.append(np.concatenate([off.real, off.imag], axis=1) / u)
        left.append(np.mean(np.abs(value - plane @ columns.T) ** 2, axis=1))
    np.testing.assert_allclose(np.std(normalised, axis=0), 1.0, atol=0.16)
    np.testing.assert_allclose(np.sqrt(np.mean(left, axis=0)) / np.abs(spread.mean), spread.left_expected, rtol=0.05)


def _with_ratios(
    observation: Observation, u_clock_s: float = 0.0, driven: int = 2
) -> tuple[PointRatios | None, Sensitivity]:
    value = SENSITIVITY * 6.9605 * TRUTH[:, 2]
    entry = {"name": "Fz", "channel": "Fz", "common": None, "quantity": "output"}
    acceleration, outputs = fuse([observation]), output_phasors([_reading(value, 1e-13, "V/V", u_clock_s, **entry)])
    ratio = sensitivity_ratio(outputs, load_phasors(acceleration, BODY), driven, (1, 2))
    (spread,) = point_spreads([observation], [acceleration])
    return with_ratios(spread, outputs, ratio, BODY).ratios, ratio


def test_ratios_of_the_points_are_output_over_mass_times_acceleration():
    ratios, found = _with_ratios(lasers())
    points = np.array([TRUTH[:, 2] + TRUTH[:, 3] * y - TRUTH[:, 4] * x for x, y, _ in POINTS]).T
    expected = SENSITIVITY * TRUTH[:, 2:3] / points
    np.testing.assert_allclose(ratios.value, expected, rtol=1e-10)
    np.testing.assert_allclose(ratios.mean_magnitude, np.mean(np.abs(expected), axis=1), rtol=1e-12)
    np.testing.assert_allclose(ratios.magnitude_spread, np.std(np.abs(expected), axis=1, ddof=1), rtol=1e-12)
    np.testing.assert_allclose(ratios.phase_spread_rad, np.std(np.angle(expected), axis=1, ddof=1), rtol=1e-6)
    np.testing.assert_allclose(ratios.fused, found.value[:, 0, 2])
    assert (ratios.channel, ratios.component) == ("Fz", "Fz")
    assert _with_ratios(lasers(), driven=0)[0] is None  # points across the driven force


def test_mass_and_scale_are_in_every_ratio():
    ratios, _ = _with_ratios(lasers(sigma=1e-12, scale_uncertainty=2.5e-4))
    u = np.sqrt(np.trace(ratios.uncertainty.at([3]).covariance, axis1=1, axis2=2))
    np.testing.assert_allclose(u / np.abs(ratios.value[:, 3]), np.hypot(2.5e-4, 1e-3 / 6.9605), rtol=1e-4)


def test_a_clock_of_both_sides_cancels():
    """A microsecond of one clock turns output and acceleration alike; of the points alone it turns the ratio."""
    both, _ = _with_ratios(lasers(sigma=1e-12, u_clock_s=1e-6), 1e-6)
    alone, _ = _with_ratios(lasers(sigma=1e-12, u_clock_s=1e-6), 0.0)
    turned = [np.sqrt(np.trace(r.uncertainty.at([0]).covariance, axis1=1, axis2=2)) for r in (both, alone)]
    mass = 1e-3 / 6.9605 * np.abs(both.value[:, 0])
    np.testing.assert_allclose(turned[0], mass, rtol=1e-2)
    np.testing.assert_allclose(turned[1], np.hypot(mass, OMEGA * 1e-6 * np.abs(both.value[:, 0])), rtol=1e-3)


FREQUENCY = np.array([106.2503, 212.5006, 425.0012])
PLACE = np.array([[0.03, 0.0], [0.0, 0.03], [-0.03, 0.0], [0.0, -0.03]])


def _uncertainty(count: int, u: float) -> Uncertainty:
    noise = Contribution("noise", "A", np.tile(u**2 * np.eye(2 * count), (3, 1, 1)), np.full(3, 60.0))
    scale = Influence("laser: scale", "laser: scale", 2.5e-4, "1", np.full((3, 2 * count), 1e-3), "rig")
    return Uncertainty((noise,), (scale,))


def make_spread() -> PointSpread:
    """Four points on a circle that rocks about y: amplitudes differ along x by ±1 %, the third is 0.2 % too low."""
    mean = np.array([100.0, 1.0, 0.5]) + 0j
    factor = np.array([1.01, 1.0, 0.99 - 0.002, 1.0])
    value = mean[:, None] * factor
    columns = np.stack([np.ones(4), PLACE[:, 1], -PLACE[:, 0]], axis=1)
    plane = value @ np.linalg.pinv(columns).T
    residual = value - plane @ columns.T
    ratios = PointRatios(
        "Fz", "Fz", "V/V", 2e-7 / factor * np.ones((3, 1)) * np.exp(-0.1j), _uncertainty(4, 1e-11),
        np.full(3, 2e-7 * np.exp(-0.1j)),
    )  # fmt: skip
    return PointSpread(
        "laser", "load", FREQUENCY, ("p1", "p2", "p3", "p4"), np.array([0.0, 0.0, 1.0]),
        np.array([[1.0, 0.0, 0.0], [0.0, 1.0, 0.0]]), PLACE, value, _uncertainty(4, 0.01), plane,
        _uncertainty(3, 0.005), residual, _uncertainty(4, 0.01), ratios,
    )  # fmt: skip


@pytest.fixture(scope="module")
def evaluation(ready_evaluation: Evaluation) -> Evaluation:
    return replace(ready_evaluation, points=(make_spread(),))


def test_tables_hold_the_numbers(evaluation):
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


def test_the_page_shows_points_where_there_are_some(evaluation, monkeypatch):
    def only_points(shown: Evaluation) -> dict[str, list[Figure]]:
        return defaultdict(list, points=point_figures(shown))

    monkeypatch.setattr("fusion.report.recording_report.draw_all", only_points)
    page = outline(render_report(evaluation))
    assert "points" in page.ids
    assert "figure-points-0" in page.ids
    without = outline(render_report(replace(evaluation, points=())))
    assert "points" not in without.ids


def test_figure_and_file_hold_the_spread(evaluation, tmp_path):
    (picture,), spread = point_figures(evaluation), evaluation.points[0]
    assert "425" not in picture.caption
    points = picture.panels[1].marks[1]
    np.testing.assert_allclose(points.x, 100.0 * ((spread.value[0] / spread.mean[0]).real - 1.0), atol=1e-9)
    write_h5(tmp_path / "result.h5", evaluation, [])
    with h5py.File(tmp_path / "result.h5") as file:
        (group,) = file["points"].values()
        np.testing.assert_array_equal(group["plane"], spread.plane)
        np.testing.assert_array_equal(group["ratios/value"], spread.ratios.value)


def test_directions_have_names():
    assert axis_name(np.array([0.0, 0.0, 1.0])) == "z"
    assert axis_name(np.array([0.0, -1.0, 0.0])) == "\N{MINUS SIGN}y"
    assert axis_name(np.array([0.6, 0.8, 0.0])) == "(0.6, 0.8, 0)"


def test_three_points_leave_nothing_to_tell(evaluation):
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
