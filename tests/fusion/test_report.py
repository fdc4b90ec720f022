"""The page of a recording: well formed, needs nothing else, and says and shows what the numbers say."""

from __future__ import annotations

import html
import json
from dataclasses import replace
from xml.etree import ElementTree

import numpy as np
import pytest
from evaluation_factory import FREQUENCY_HZ, Choice, make_evaluation
from markupsafe import Markup
from page_outline import outline, self_contained

from fusion.phasors.deformation import DeflectionShape, deflection_shape
from fusion.report.figure import Figure, decimate_edges, empty_figure, extremes, padded_limits
from fusion.report.figure_files import render_figure
from fusion.report.motion_figures import (
    beat_curve,
    camera_rate_hz,
    draw_deflection,
    draw_epipolar,
    folded_curve,
    main_frequency,
    residual_spectrum,
)
from fusion.report.recording_report import draw_all, render_report
from fusion.report.table import degrees_of_freedom
from fusion.report.tables import headlines, source_tables
from fusion.report.uncertainty_tables import budget_tables, other_loads_table
from fusion.sensitivity.analyse import Evaluation
from photogram.camera import Points3D
from photogram.geometry import rotation_from_vector
from photogram.motion import Deformation, deformation, fit_motion
from shakercal._common.digits import number_text, power_text, quantity_text, scaled_text, times_ten

RIG_NAME = "<script>alert(1)</script> & co"


@pytest.fixture(scope="module")
def evaluation(tmp_path_factory: pytest.TempPathFactory) -> Evaluation:
    made = make_evaluation(tmp_path_factory.mktemp("Fz"))
    made.manifest.rig = made.manifest.rig.model_copy(update={"name": RIG_NAME})
    return made


@pytest.fixture(scope="module")
def pictures(evaluation: Evaluation) -> dict[str, list[Figure]]:
    return draw_all(evaluation)


@pytest.fixture(scope="module")
def page(evaluation: Evaluation, pictures: dict[str, list[Figure]]) -> str:
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("fusion.report.recording_report.draw_all", lambda _: pictures)
        return render_report(evaluation)


def test_page_is_self_contained_and_shows_results_warnings_and_origin(page, evaluation):
    found = self_contained(page)
    assert any(address.startswith("#") for address in found.addresses)
    assert len(page.encode()) < 6_000_000
    text = "".join(found.text)
    assert "(1.9720 ± 0.0019) × 10⁻⁷ (V/V)/N" in text
    assert "(−0.03370 ± 0.00099) rad" in text
    assert all(notice.text in text for notice in evaluation.notices)  # one of them with < and &
    assert text.index("Warning") < text.index("Note")
    assert "cd" * 32 in text
    assert "subset_radius_px" in text
    assert "(6.9605 ± 0.0020) kg" in text
    assert "4.20 ± 0.20" in text  # clock rate in 1e-6
    assert html.escape(RIG_NAME) in page
    assert "<script>alert" not in page


def test_a_recording_without_anything_to_determine_still_has_a_page(evaluation):
    nothing = {"accelerations": (), "load": None, "sensitivity": None, "notices": ()}
    page = render_report(replace(evaluation, stereo=(), channels=(), clocks=(), **nothing))
    assert html.escape(RIG_NAME) in page
    assert "result" in outline(page).ids
    assert not {"sensitivity", "acceleration", "load"} & set(outline(page).ids)


def test_undetermined_values_do_not_break_the_page(tmp_path):
    evaluation = make_evaluation(tmp_path, Choice(frames=100))
    assert camera_rate_hz(evaluation.stereo[0]) == pytest.approx(52.874)  # missing frames count
    lost = evaluation.sensitivity.value.copy()
    lost[0] = np.nan
    changed = replace(evaluation.sensitivity, value=lost)
    page = render_report(replace(evaluation, sensitivity=changed, stereo=evaluation.stereo[:1]))
    assert "nan" not in "".join(outline(page).text).lower().replace("resonan", "")


def test_sources_are_columns_and_headlines_name_the_deviation_from_static(evaluation):
    load, base = source_tables(evaluation)
    assert load.head == ("", "unit", "fused", "photogrammetry", "vibrometer", "accelerometer")
    assert base.head == ("", "unit", "fused")
    assert load.rows[3][4] == "–"
    weak, strong = load.rows[5][2], load.rows[2][2]  # rz: 0.06 - 0.02j rad/s² ± 0.4, judged by its region
    assert "not distinguishable from 0" in weak
    assert weak.startswith(("region ± ", "(region ± "))
    assert "189" in strong
    assert "k = 1.97" in strong
    first = headlines(evaluation)[0]
    assert first.label == "Ratio Fz output / Fz load, 106.3 Hz"
    assert (
        "differs from the static value, difference (−1.40 ± 0.22) %" in first.remark
    )  # 1.972/2 - 1, and 1.96 of 4.9e-4 and 1e-3


def test_budget_is_sorted_and_its_shares_make_a_whole(evaluation):
    table, load, motion = budget_tables(evaluation)
    assert table.rows[0][0] == "internal mass"
    assert table.rows[0][2:5] == ("0.002 kg", "−0.13", "−0.13")
    named = [float(row[6]) for row in table.rows if row[1]]
    assert named == sorted(named, reverse=True), "by the magnitude, as the figure"
    # One recording has nothing to say of these two, and they are no zeros.
    *causes, repeated, mounted, _ = table.rows
    assert [row[:3] for row in (repeated, mounted)] == [
        (n, "", "not assessed") for n in ("repeatability", "mounting anew")
    ]
    for column in (6, 8):
        assert sum(float(row[column]) for row in causes) == pytest.approx(100.0, abs=0.4)
    by_name = {row[0]: row for row in table.rows}
    assert by_name["scatter of the sine approximation"][1:5] == ("A, 204", "–", "–", "–")
    assert by_name["delay of the exposure"][2:5] == ("1 × 10⁻⁷ s", "≈ 0", "−670")
    assert "load Fz" in load.caption
    assert "acceleration z of the load" in motion.caption


def test_share_of_other_loads(evaluation):
    table = other_loads_table(evaluation)
    shares = {row[0]: row[1:] for row in table.rows}
    assert shares["Fz"][0] == "–"  # the static sensitivity of the factory is diagonal and tells nothing of cross-talk
    # Fx: 5.1e-7 V/V/N times 0.33 m/s² times 7.7 kg over an output of 3e-7 V/V: several times the whole output.
    assert float(shares["Fx"][0].partition(" ")[0].replace("−", "-")) != 0.0
    assert other_loads_table(replace(evaluation, load=None)) is None


def test_numbers_as_html():
    assert number_text(9.97e-5, 2) == "1 × 10⁻⁴"
    assert number_text(-502.0, 2) == Markup("−500")
    assert (degrees_of_freedom(999.6), degrees_of_freedom(1e5), degrees_of_freedom(np.inf)) == ("1000", "> 1000", "∞")
    assert quantity_text(1.9719871e-7, 2.04e-10, "(V/V)/N") == "(1.9720 ± 0.0020) × 10⁻⁷ (V/V)/N"
    assert quantity_text(1.0, 0.5) == Markup("1.00 ± 0.50")
    assert quantity_text(2.5, 0.0, "m/s^2") == Markup("2.5 m/s²")
    assert scaled_text(2.1e-10, 6.1e-11, -7) == Markup("0.00210 ± 0.00061")
    assert times_ten(0, "N.m") == Markup("N·m")


def test_every_figure_is_data_and_the_main_ones_are_pictures(pictures):
    every = [picture for group in pictures.values() for picture in group]
    assert len({picture.name for picture in every}) == len(every) >= 13
    for picture in every:
        assert picture.title
        assert picture.caption.endswith(".")
        assert json.loads(picture.json(), parse_constant=pytest.fail)["name"] == picture.name
    for picture in (one for one in every if one.main):
        root = ElementTree.fromstring(render_figure(picture))
        assert root.tag.endswith("svg")
        assert root.attrib["font-family"].endswith("sans-serif")  # one that every viewer has


def test_few_numbers_of_a_page_have_ten_digits_and_nan_is_null():
    drawn = empty_figure("numbers", 2.0)
    many = np.exp(np.linspace(-30.0, 30.0, 1000))
    drawn.panels[0].points([np.pi, np.nan, -np.inf], [-1e-7 / 3.0, 2.0, 0.0], names=("a nan", "b", "c"))
    drawn.panels[0].line(many, -many)
    few, long = json.loads(drawn.json())["panels"][0]["marks"]
    assert few["x"] == [3.141592654, None, None]
    assert few["y"] == [-3.333333333e-08, 2, 0]
    assert few["names"] == ["a nan", "b", "c"]
    assert np.allclose(long["x"], many, rtol=5e-7, atol=0.0)
    assert np.allclose(long["y"], -many, rtol=5e-7, atol=0.0)


def test_beat_curve_passes_through_the_fit_at_every_frame_and_the_folded_one_is_it_without_offset(evaluation):
    stereo = evaluation.stereo[0]
    assert np.allclose(beat_curve(stereo, stereo.time_s), stereo.fit.model(stereo.time_s), rtol=0, atol=1e-11)
    z = beat_curve(stereo, np.linspace(stereo.time_s[0], stereo.time_s[-1], 4000))[:, 2]
    assert np.count_nonzero(np.diff(np.sign(z))) == 4  # 106.25 Hz - 2 × 52.874 Hz = 0.502 Hz: two periods in 3.97 s
    frequency = main_frequency(stereo)
    assert frequency == FREQUENCY_HZ[0]
    model = stereo.fit.model(stereo.time_s) - stereo.fit.offset
    # The factory's harmonics are 0.6 mHz off the multiples, 2e-5 periods per second.
    folded = folded_curve(stereo, frequency, np.mod(stereo.time_s * frequency, 1.0))
    assert np.allclose(folded[:, 2], model[:, 2], rtol=0, atol=5e-9)


def test_residual_spectrum_shows_the_amplitude_of_an_unfitted_line(evaluation):
    stereo = evaluation.stereo[0]
    rate = camera_rate_hz(stereo)
    bins = 40 * rate / len(stereo.time_s)
    stereo.residual[:, 0] += 2e-6 * np.cos(2.0 * np.pi * bins * (stereo.time_s - stereo.time_s[0]))
    frequency, amplitude = residual_spectrum(stereo)
    peak = int(np.argmax(amplitude[:, 0]))
    assert frequency[peak] == pytest.approx(bins)
    assert amplitude[peak, 0] == pytest.approx(2e-6, rel=0.05)


def test_a_long_line_keeps_its_extremes():
    rng = np.random.default_rng(1)
    x, y = np.arange(100_003.0), rng.standard_normal(100_003)
    y[[777, 50_000]], y[1234] = (60.0, -60.0), np.nan
    few_x, few_y = extremes(x, y)
    assert len(few_x) < 4000
    assert np.all(np.diff(few_x) > 0.0)
    np.testing.assert_array_equal(few_y, y[few_x.astype(int)])
    for start in range(0, 99_000, 333):  # the envelope of every stretch is that of the line
        part = (few_x >= start) & (few_x < start + 333)
        around = y[start + 66 : start + 267]
        assert few_y[part].max() >= np.nanmax(around)
        assert few_y[part].min() <= np.nanmin(around)
    short = extremes(x[:5000], y[:5000])
    assert len(short[0]) == 5000


def test_thinning_keeps_peaks_and_axes_have_room():
    y = np.ones(1000)
    y[512] = 9.0
    few_x, few_y = decimate_edges(np.arange(1.0, 1001.0), y, np.geomspace(1.0, 1001.0, 50))
    assert len(few_x) < 60
    assert (few_y.max(), few_x[np.argmax(few_y)]) == (9.0, 513.0)
    assert np.all(np.diff(few_x) > 0.0)
    ends = [np.array([1.0, 2.0, 2.5, 4.0]), np.array([3.0, 1.0, 1.0, 0.0]), np.array([2.0, 3.0, 3.5])]
    assert np.array_equal(
        decimate_edges(*ends), [[1.0, 2.0, 4.0], [3.0, 1.0, 0.0]]
    )  # an interval without any, and equals
    assert padded_limits(0.0, 10.0, 0.1) == (-1.0, 11.0)
    assert padded_limits(2.0, 2.0)[0] < 2.0 < padded_limits(2.0, 2.0)[1]
    assert power_text(-7) == "10⁻⁷"


def test_recording_without_cameras_and_sensor_has_the_figures_it_can_have(tmp_path):
    pictures = draw_all(make_evaluation(tmp_path, Choice(sensor=False, images=False)))
    assert not pictures["sensitivity"]
    assert not pictures["motion"]
    assert not pictures["budget"]
    assert pictures["channels"]


RIGID = np.array([1e-7, 2e-7j, 2e-5, 0, 0, 0], dtype=complex)


def shape_of(bend_m: float, seed: int = 0, axis: int = 2) -> DeflectionShape:
    """A plate normal to `axis`, bent, with noise."""
    rng = np.random.default_rng(seed)
    first, second = np.meshgrid(np.linspace(-0.05, 0.05, 24), np.linspace(-0.03, 0.03, 14))
    reference = np.zeros((first.size, 3))
    across = [i for i in range(3) if i != axis]
    reference[:, across[0]], reference[:, across[1]] = first.ravel(), second.ravel()
    value = np.zeros((2, first.size, 3), dtype=complex)
    value[1, :, axis] = bend_m * 1j * (first.ravel() / 0.05) ** 2
    u = np.full(value.shape, 3e-8)
    value += u * (rng.normal(size=value.shape) + 1j * rng.normal(size=value.shape))
    return DeflectionShape(np.array([50.0, 106.25]), reference, value, u)


@pytest.mark.parametrize("axis", [0, 1, 2])
def test_a_bent_plate_is_drawn_from_any_side(axis):
    picture = draw_deflection(shape_of(1e-6, axis=axis), 1, RIGID, "top", "load")
    assert picture.name == "deflection-top"
    assert "106.2500 Hz" in picture.caption
    assert f"along {'xyz'[axis]}, " in picture.caption
    assert "translation along z" in picture.caption
    amplitude = picture.panels[0].marks[0].values  # in µm, of 1 µm at the edges
    np.testing.assert_allclose(np.max(amplitude), 1.0, atol=0.15)


def test_noise_alone_is_above_its_level_at_one_point_in_twenty():
    counts = []
    for seed in range(6):
        picture = draw_deflection(shape_of(0.0, seed), 0, RIGID, "top", "load")
        counts.append(int(picture.caption.split("; ")[1].split(" of ")[0]))
    assert np.mean(counts) / 336 == pytest.approx(0.05, abs=0.015)


def test_points_without_a_phasor_are_left_out():
    shape = shape_of(1e-6)
    value = shape.value.copy()
    value[:, :100] = np.nan
    picture = draw_deflection(replace(shape, value=value), 1, RIGID, "top", "load")
    assert " of 236 points" in picture.caption
    value[:, 2:] = np.nan
    assert draw_deflection(replace(shape, value=value), 1, RIGID, "top", "load") is None


RATE_HZ, LINES_HZ, EXPOSURE_S = 52.874, np.array([106.25, 212.5]), 100e-6
SIGMA_M = np.array([0.2, 0.2, 0.4]) * 1e-6
BEND = 0.5e-6 * np.exp(0.7j)


def bending_body(seed: int, bend: complex) -> tuple[np.ndarray, np.ndarray, Deformation]:
    """Times, true saddle (N,), and the residuals of a plate that moves, rocks and bends at 106.25 Hz."""
    rng = np.random.default_rng(seed)
    time = 0.3 + np.arange(96) / RATE_HZ
    x, y = np.meshgrid(np.linspace(-0.05, 0.05, 11), np.linspace(-0.05, 0.05, 11))
    rest = np.column_stack([x.ravel(), y.ravel(), np.zeros(x.size)])
    saddle = (rest[:, 0] ** 2 - rest[:, 1] ** 2) / 0.05**2
    turn = np.exp(2j * np.pi * LINES_HZ[0] * time)
    pose = (np.multiply.outer(turn, np.array([1e-6, 2e-6j, 2e-5, 1e-5, 2e-5j, 1e-6]))).real
    gain = np.sinc(LINES_HZ[0] * EXPOSURE_S)
    bent = rest + np.multiply.outer((gain * bend * turn).real, saddle)[..., None] * np.array([0, 0, 1.0])
    moved = bent @ np.swapaxes(rotation_from_vector(pose[:, 3:]), 1, 2) + pose[:, None, :3]
    moved += SIGMA_M * rng.normal(size=moved.shape)
    covariance = np.broadcast_to(np.diag(SIGMA_M**2), (*moved.shape, 3))
    points = Points3D(moved, covariance, np.zeros(moved.shape[:2]))
    return time, saddle, deformation(points, fit_motion(points, None, np.zeros(3)))


@pytest.mark.parametrize("bend", [0.0, BEND])
def test_the_shape_comes_back_within_its_uncertainty(bend):
    """Errors of real and imaginary parts over the stated uncertainty, of all points, directions and 4 series."""
    ratios = []
    for seed in range(4):
        time, saddle, residual = bending_body(seed, bend)
        shape = deflection_shape(time, LINES_HZ, (residual,), EXPOSURE_S)
        truth = np.zeros_like(shape.value)
        truth[0, :, 2] = bend * saddle
        error = (shape.value - truth) / shape.u
        ratios.append(np.stack([error.real, error.imag]))
    assert np.mean(np.square(ratios)) == pytest.approx(1.0, abs=0.06)
    if bend:
        fitted = np.sum(shape.value[0, :, 2] * saddle) / np.sum(saddle**2)
        u = shape.u[0, :, 2].mean() / np.sqrt(np.sum(saddle**2))
        assert abs(fitted - bend) < 3.5 * u < 0.1 * abs(bend)


def test_missing_frames_cost_only_their_share():
    time, _, residual = bending_body(1, BEND)
    residual.residual_m[::3, 5] = np.nan
    residual.residual_m[:90, 6] = np.nan
    shape = deflection_shape(time, LINES_HZ, (residual,), EXPOSURE_S)
    assert np.isnan(shape.value[:, 6]).all()
    assert np.isnan(shape.u[:, 6]).all()
    assert shape.u[0, 5].mean() == pytest.approx(shape.u[0, 7].mean() * np.sqrt(96 / 64), rel=0.25)
    assert np.isfinite(np.delete(shape.value, 6, axis=1)).all()


@pytest.mark.parametrize("with_covariance", [True, False])
def test_the_epipolar_figure_shows_the_uncertainty_of_the_calibration(evaluation, with_covariance):
    stereo = evaluation.stereo[0]
    check = stereo.epipolar if with_covariance else replace(stereo.epipolar, pattern_covariance=None)
    picture = draw_epipolar(check, stereo.time_s, "top")
    assert picture.caption.count("k = 2") == 1 + with_covariance  # image noise, and the band of the calibration
    nothing = replace(
        check, residual_trend_px=np.full_like(check.residual_trend_px, np.nan), residual_px=check.residual_px * np.nan
    )
    assert render_figure(draw_epipolar(nothing, stereo.time_s, "top"))
