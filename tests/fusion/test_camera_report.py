"""What a calibrated pair means in plain quantities, against Monte Carlo, OpenCV and closed formulas, and its page."""

from __future__ import annotations

import html
import re
from dataclasses import replace

import cv2
import numpy as np
import pytest
from calibration_factory import SIZE_PX, SPACING_M, Session, make_calibration
from contracts import refused
from page_outline import outline, self_contained

from fusion.cameras import camera_quantities
from fusion.cameras.camera_figures import draw_coverage, draw_image_residuals, draw_views
from fusion.cameras.camera_report import (
    STATES,
    camera_headlines,
    correlations_table,
    dropped_table,
    lengths_table,
    parameters_table,
    render_camera_report,
    verdict,
    views_table,
)
from fusion.report.figure_files import render_figure
from fusion.report.folder import Provenance
from photogram.calibration.calibration_notices import FEW_VIEWS
from photogram.calibration.calibration_result import CalibratedImage, CalibratedView, Calibration, Rejection
from photogram.camera import RIG_PARAMETERS, StereoRig
from photogram.geometry import RigidTransform, rotation_from_vector
from shakercal._common.digits import python_number
from shakercal._common.notices import Notice

DRAWS = 1500
PROVENANCE = Provenance({"left-01.tif": "ab" * 32}, {"target": "dots"}, {"shakercal": "0.1.0"}, ("top.json",))


@pytest.fixture(scope="module")
def calibration() -> Calibration:
    return make_calibration()


@pytest.fixture(scope="module")
def draws(calibration: Calibration) -> list[StereoRig]:
    """Rigs within the covariance of the calibrated one."""
    rng = np.random.default_rng(1)
    covariance = camera_quantities.covariance_of(calibration.rig)[:24, :24]
    u = np.sqrt(np.diagonal(covariance))
    deltas = rng.multivariate_normal(np.zeros(24), covariance / np.outer(u, u), DRAWS) * u
    return [calibration.rig.perturbed(delta) for delta in deltas]


def test_baseline_and_angle_scatter_as_stated_also_of_parallel_axes(
    calibration: Calibration, draws: list[StereoRig]
) -> None:
    baseline, angle = camera_quantities.baseline_m(calibration.rig), camera_quantities.axes_angle_rad(calibration.rig)
    lengths = [np.linalg.norm(rig.right_from_left.translation_m) for rig in draws]
    angles = [np.arccos(rig.right_from_left.rotation[2, 2]) for rig in draws]
    assert baseline.value == pytest.approx(np.linalg.norm([0.168, -0.003, 0.036]), abs=4 * baseline.u)
    assert baseline.u == pytest.approx(np.std(lengths), rel=0.06)
    assert angle.value == pytest.approx(np.linalg.norm([0.011, 0.42]), abs=4 * angle.u + 1e-4)
    assert angle.u == pytest.approx(np.std(angles), rel=0.06)
    parallel = replace(calibration.rig, right_from_left=RigidTransform(np.eye(3), np.array([-0.1, 0, 0])))
    angle = camera_quantities.axes_angle_rad(parallel)
    assert angle.value == 0.0
    assert angle.u >= np.sqrt(np.diagonal(camera_quantities.covariance_of(parallel))[18:20]).max()


def test_distance_scatters_as_stated(calibration: Calibration) -> None:
    view, rng = calibration.views[2], np.random.default_rng(2)
    u = np.sqrt(np.diagonal(view.covariance))
    deltas = rng.multivariate_normal(np.zeros(6), view.covariance / np.outer(u, u), DRAWS) * u
    middle = calibration.shape_m.mean(axis=0)
    places = [
        rotation_from_vector(delta[3:]) @ view.left_from_target.rotation @ middle
        + view.left_from_target.translation_m
        + delta[:3]
        for delta in deltas
    ]
    distance = camera_quantities.distance_m(calibration, view)
    assert distance.value == pytest.approx(np.linalg.norm(view.left_from_target.apply(middle)))
    assert distance.u == pytest.approx(np.std(np.linalg.norm(places, axis=1)), rel=0.06)


def test_distortion_is_that_of_opencv_and_scatters_as_stated(calibration: Calibration, draws: list[StereoRig]) -> None:
    field, camera = camera_quantities.distortion(calibration, "right", columns=7), calibration.rig.right
    ideal = (field.pixel - field.displacement_px).reshape(-1, 2)
    rays = np.column_stack([(ideal - camera.matrix[:2, 2]) / np.diagonal(camera.matrix)[:2], np.ones(len(ideal))])
    pixel, _ = cv2.projectPoints(rays, np.zeros(3), np.zeros(3), camera.matrix, camera.distortion)
    np.testing.assert_allclose(pixel.reshape(field.pixel.shape), field.pixel, atol=1e-6)
    field = camera_quantities.distortion(calibration, "left", columns=9)
    corner = field.pixel[0, 0]
    moved = []
    for rig in draws:
        k = rig.left.matrix
        moved.append(corner - rig.left.undistort(corner) * [k[0, 0], k[1, 1]] - [k[0, 2], k[1, 2]])
    scatter = np.sqrt(np.var(moved, axis=0).mean())
    assert field.u_px[0, 0] == pytest.approx(scatter, rel=0.08)
    assert np.linalg.norm(np.mean(moved, axis=0) - field.displacement_px[0, 0]) < 6 * scatter / np.sqrt(DRAWS) + 0.01


def test_lengths_scale_with_the_baseline_and_depth_is_less_certain(calibration: Calibration) -> None:
    across, down, away = camera_quantities.length_u(calibration)
    assert calibration.scale_u < min(across, down)
    assert away > 1.5 * across
    assert all(float(row[1]) > 200 * calibration.scale_u for row in lengths_table(calibration).rows)
    baseline = np.zeros(24)
    baseline[21:] = calibration.rig.right_from_left.translation_m
    rig = replace(calibration.rig, covariance=1e-4**2 * np.outer(baseline, baseline))
    found = camera_quantities.length_u(replace(calibration, rig=rig))
    np.testing.assert_allclose(found, 1e-4, rtol=1e-6)


def test_systematic_part_of_residuals_is_told_from_noise() -> None:
    rng = np.random.default_rng(3)
    position = rng.uniform(0, 2000, (20000, 2))
    noise = rng.normal(0.0, 0.2, position.shape)
    pattern = 0.05 * np.sign(np.sin(2 * np.pi * (position + 0.5) / 400.0))
    plain, wavy = (camera_quantities.residual_map(position, residual, 100.0) for residual in (noise, noise + pattern))
    assert plain.systematic_px < 0.01
    assert wavy.systematic_px == pytest.approx(0.05 * np.sqrt(2), rel=0.06)
    assert wavy.within_px == pytest.approx(0.2 * np.sqrt(2), rel=0.02)
    assert wavy.count.sum() == len(position)
    assert (np.abs(position[:, None] - wavy.centre_px).max(axis=2).min(axis=1) <= 50.0).all()


def test_errors_of_the_print_are_told_from_those_of_the_lens(calibration: Calibration) -> None:
    rng = np.random.default_rng(4)
    shift = dict(zip(map(tuple, calibration.shape_index), rng.normal(0.0, 10e-6, (567, 2)), strict=True))

    def moved(view: CalibratedView, side: int, picture: CalibratedImage | None) -> CalibratedImage | None:
        if picture is None:
            return None
        flat = np.zeros((2, len(picture.index), 3))
        flat[:, :, :2] = SPACING_M * picture.index
        flat[1, :, :2] += [shift[tuple(index)] for index in picture.index]
        true, wrong = calibration.rig.project(view.left_from_target.apply(flat))[side]
        return replace(picture, residual_px=wrong - true + rng.normal(0.0, 0.02, true.shape))

    views = tuple(
        replace(view, left=moved(view, 0, view.left), right=moved(view, 1, view.right)) for view in calibration.views
    )
    for side in camera_quantities.SIDES:
        found = camera_quantities.residual_parts(replace(calibration, views=views), side)
        assert found.point_m == pytest.approx(10e-6 * np.sqrt(2), rel=0.06)
        assert found.whole_px == pytest.approx(np.hypot(found.point_px, 0.02 * np.sqrt(2)), rel=0.02)
        assert found.position_px < 0.2 * found.point_px
        assert found.smooth_px < 0.2 * found.point_px


def test_residuals_of_a_lens_that_the_model_does_not_follow(calibration: Calibration) -> None:
    plain = make_calibration(Session(unmodelled_px=0.0))
    for side in camera_quantities.SIDES:
        wavy, noise = camera_quantities.residual_parts(calibration, side), camera_quantities.residual_parts(plain, side)
        assert noise.alone_px == pytest.approx(0.12 * np.sqrt(2), rel=0.03)
        assert max(noise.position_px, noise.point_px, noise.smooth_px) < 0.02
        assert 0.06 < wavy.position_px <= wavy.smooth_px < 0.15
        assert wavy.point_px < 0.02


def test_tilt_has_angle_and_direction(calibration: Calibration) -> None:
    tilts = camera_quantities.tilts_rad(calibration)
    angle = [np.arccos(abs(view.left_from_target.rotation[2, 2])) for view in calibration.views]
    np.testing.assert_allclose(np.linalg.norm(tilts, axis=1), angle, atol=1e-9)
    facing = rotation_from_vector(np.array([np.pi, 0.0, 0.0]))
    right = rotation_from_vector(np.array([0.0, -0.3, 0.0])) @ facing  # the normal −z turns towards +x
    pose = RigidTransform(right, np.array([0.0, 0.0, 0.4]))
    one = replace(calibration, views=(replace(calibration.views[0], left_from_target=pose),))
    np.testing.assert_allclose(camera_quantities.tilts_rad(one), [[0.3, 0.0]], atol=1e-12)
    behind = replace(one.views[0], left_from_target=RigidTransform(right @ facing, pose.translation_m))
    np.testing.assert_allclose(camera_quantities.tilts_rad(replace(one, views=(behind,))), [[0.3, 0.0]], atol=1e-12)


@pytest.mark.parametrize("side", camera_quantities.SIDES)
def test_empty_cells_are_what_is_not_covered(calibration: Calibration, side: camera_quantities.Side) -> None:
    position, residual, view = camera_quantities.used_points(calibration, side)
    cells = camera_quantities.empty_cells(position, SIZE_PX)
    area = ((cells[:, 2] - cells[:, 0]) * (cells[:, 3] - cells[:, 1])).sum() / SIZE_PX.prod()
    assert area == pytest.approx(1 - calibration.image_coverage[camera_quantities.SIDES.index(side)])
    assert len(position) == len(residual) == len(view)
    rms = np.sqrt((residual**2).sum(axis=1).mean())
    assert rms == pytest.approx(calibration.rms_sides_px[camera_quantities.SIDES.index(side)])


def test_shape_is_laid_onto_its_lattice(calibration: Calibration) -> None:
    shape = camera_quantities.target_shape(calibration)
    assert shape is not None
    assert np.ptp(shape.height_m) == pytest.approx(60e-6, rel=1e-3)
    assert abs(shape.height_m.mean()) < 1e-9
    moved = RigidTransform.from_pose(np.array([1e-3, 2e-3, 3e-3, 0.01, -0.02, 0.03]))
    again = camera_quantities.target_shape(replace(calibration, shape_m=moved.apply(calibration.shape_m)))
    assert again is not None
    np.testing.assert_allclose(again.height_m, shape.height_m, atol=1e-12)
    assert camera_quantities.target_shape(make_calibration(Session(views=4, bow_m=0.0))) is None


def test_correlations_are_sorted_and_none_without_uncertainty(calibration: Calibration) -> None:
    strongest = [abs(float(row[2].replace("−", "-"))) for row in correlations_table(calibration).rows]
    assert strongest == sorted(strongest, reverse=True)
    assert strongest[0] > 0.9
    refused("covariance", camera_quantities.covariance_of, replace(calibration.rig, covariance=None))
    covariance = camera_quantities.covariance_of(calibration.rig).copy()
    covariance[8], covariance[:, 8] = 0.0, 0.0
    found, held = camera_quantities.correlation(covariance), [8, *range(24, 32)]
    assert np.isnan(found[held]).all()
    np.testing.assert_allclose(np.delete(np.diagonal(found), held), 1.0)


def test_page_says_what_was_found_and_is_well_formed_and_self_contained(calibration: Calibration) -> None:
    page = render_camera_report(calibration, "top", PROVENANCE, 12.3)
    found = self_contained(page)
    assert page.count("<figure") == 11
    figures = [address for address in found.addresses if not address.startswith("#")]
    assert all(address.startswith("data:image/svg+xml,%3Csvg") for address in figures)
    assert len(page.encode()) < 6_000_000
    text = "".join(found.text)
    note, warning = calibration.notices
    assert all(name in text for name in RIG_PARAMETERS[:24])
    assert warning.text in text
    assert text.index(warning.text) < text.index(note.text)
    assert "(3.50000 ± 0.00020) mm, k = 2" in text
    assert "U (k = 2) = 0.0058 %" in text
    assert "0.029 µm" in text
    assert "6.1 px" in text
    assert "ab" * 32 in text
    assert "top.json" in text
    assert "nan" not in text.lower()


def test_headlines_are_the_truth_within_their_uncertainty(calibration: Calibration) -> None:
    found = {headline.label: headline.value for headline in camera_headlines(calibration)}
    for label, truth in (
        ("Baseline", 171.8400),
        ("Angle between the optical axes", 24.0718),
        ("Focal length fx of the left camera", 3512.4),
        ("Focal length fx of the right camera", 3498.9),
    ):
        value, expanded = (float(number) for number in re.findall(r"[\d.]+", found[label])[:2])
        assert abs(value - truth) < 2 * expanded, label
    assert re.findall(r"\d+", found["Views"]) == ["13", "14"]


def test_every_parameter_has_its_row(calibration: Calibration) -> None:
    rows = parameters_table(calibration).rows
    turn = dict(zip(RIG_PARAMETERS[18:21], calibration.rig.right_from_left.pose[3:], strict=True))
    assert [row[0] for row in rows] == list(RIG_PARAMETERS[:24])
    for row, item in zip(rows, calibration.parameters, strict=True):
        power = re.match(r"10[⁻⁰¹²³⁴⁵⁶⁷⁸⁹]+", row[5])
        scale = python_number(f"1 × {power[0]}") if power else 1.0
        scale *= 1e-3 if row[5].endswith("mm") else 1.0
        value, u, expanded = (scale * float(cell.replace("−", "-")) for cell in row[2:5])
        assert value == pytest.approx(turn.get(item.name, item.value), abs=0.06 * 2 * item.u)
        assert u == pytest.approx(item.u, rel=0.06)
        assert expanded == pytest.approx(2 * item.u, rel=0.06)


def test_states_in_plain_words(calibration: Calibration) -> None:
    changed = list(calibration.parameters)
    changed[8] = replace(changed[8], state="undetermined", u=2.0)
    changed[7] = replace(changed[7], state="indistinct")
    changed[6] = replace(changed[6], u=0.0)
    other = replace(calibration, parameters=tuple(changed), notices=())
    assert [row[6] for row in parameters_table(other).rows[5:9]] == [
        "determined",
        "fixed",
        STATES["indistinct"],
        STATES["undetermined"],
    ]
    assert verdict(other).endswith(" left.k3.")
    warning = Notice(FEW_VIEWS, "views", count=5, kind="pairs", least=8)
    twice = replace(calibration, notices=(warning, warning))
    assert verdict(twice).startswith("2 ")
    assert warning.text in verdict(twice)


def test_views_and_what_was_left_out(calibration: Calibration) -> None:
    rows = views_table(calibration).rows
    assert rows[5][1] == "left-06.tif<br>–"
    assert rows[5][3].endswith("<br>–")
    dropped = dropped_table(calibration)
    assert dropped is not None
    assert [row[1] for row in dropped.rows[:2]] == ["all", "all"]
    left_out = sum(int(row[1]) for row in dropped.rows[2:])
    every = [picture for view in calibration.views for picture in (view.left, view.right) if picture is not None]
    assert left_out == sum(int((~picture.used).sum()) for picture in every)
    assert dropped_table(replace(calibration, rejections=())) is None


def test_flat_target_missing_pictures_and_odd_names_still_have_a_page() -> None:
    names = ("<script>alert(1)</script>", "$x_1$ & \\co")
    made = make_calibration(Session(views=6, bow_m=0.0, scale_u=0.0, missing_right=(0, 2, 3), names=names))
    views = (*made.views[:4], replace(made.views[4], left=None), made.views[5])
    bare = replace(made, views=views, notices=(), rejections=())
    page = render_camera_report(bare, "<b>top</b>", PROVENANCE, 1.0)
    assert html.escape("<script>alert(1)</script>-01.tif") in page
    assert html.escape("$x_1$ & \\co-02.tif") in page
    assert "<h1>&lt;b&gt;top&lt;/b&gt;</h1>" in page
    text = "".join(outline(page).text)
    assert page.count("<figure") == 10
    assert camera_headlines(bare)[1].value == "2 pairs in 6 views"
    assert "Notices" not in text
    assert "nan" not in text.lower()


def test_figures_of_a_long_session_with_many_dropped_pictures_are_the_same_each_time() -> None:
    made = make_calibration(Session(views=24, missing_right=()))
    many = tuple(Rejection(f"picture-{n:03d}.tif", 0, "blurred") for n in range(12))
    changed = replace(made, rejections=many)
    for draw in (draw_coverage, draw_views, draw_image_residuals):
        assert draw(changed).json() == draw(changed).json()
    svg = render_figure(draw_coverage(changed))
    assert svg.startswith(b"<?xml")
    assert svg == render_figure(draw_coverage(changed))
