"""What ordinary cameras do: turned bodies, gamma, full wells, readout, flicker, mosaics; rendered by formulas here."""

from __future__ import annotations

from functools import lru_cache

import numpy as np
import pytest
from camera_faults import (
    MIDDLE,
    codes,
    flickering_rows,
    full_wells,
    gain_errors,
    gains,
    gamma,
    light,
    measured,
    sensed,
    swing,
    turn,
)
from contracts import refused, slow
from speckle import PIXEL_M, camera

from photogram.direct.surface import Patches, PlacedCamera, PlainShapes, patch_rates, warps_of_points
from photogram.geometry import RigidTransform
from photogram.images.noise import noise_notices
from photogram.images.sequence import alternating_gain
from photogram.measure.body import BodyMotion
from shakercal._common.notices import Notice

EVEN_COLUMNS = np.array([[1.0, 0.98]])
MOSAIC = np.array([[1.0, 0.6], [0.5, 1.0]])


@lru_cache
def of_linear_sensor(amplitude_px: float, bits: int = 12) -> tuple[BodyMotion, list[Notice]]:
    """What a linear sensor gives of a body that swings."""
    return measured(sensed(light(swing(18, amplitude_px)), np.random.default_rng(6)), bits)


def test_rates_after_a_motion_precede_its_warp():
    """W(T·δ) = W(T)∘(1 + rates·δ) for each component and shape, T a turn by 100° with a tilt and a shift."""
    placed = PlacedCamera(camera(MIDDLE, (-0.1, 0.2, 1e-3, -1e-3, 0.0)), RigidTransform.from_pose(np.array(
        [0.01, -0.02, 0.4, 0.2, -0.3, 0.1])))  # fmt: skip
    rng = np.random.default_rng(4)
    middle = rng.uniform(-0.02, 0.02, (7, 1, 2))
    arm_m = 4.0 * PIXEL_M
    flat = middle + arm_m * np.array([[0, 0], [1, 0], [-1, 0], [0, 1], [0, -1]])
    points = np.concatenate([flat, 0.1 * flat[..., :1]], axis=2)
    patches = Patches(placed.project(points[:, 0]), 4.0, points, placed.project(points))
    moved, shapes = (
        RigidTransform.from_pose(np.array([0.003, -0.002, 0.01, 0.1, -0.2, 1.75])),
        PlainShapes.of(points[:, 0]),
    )
    rates = patch_rates(placed, patches, shapes, moved)
    whole = warps_of_points(placed, patches, points, moved)
    linear = np.eye(2) + whole.reshape(-1, 2, 3)[:, :, 1:]
    displaced = shapes(points.reshape(-1, 3)).reshape(6, 7, 5, 3)
    for parameter, size in enumerate([1e-6] * 3 + [1e-5] * 3 + [1e-6] * 6):
        small = np.eye(12)[parameter] * size
        by = moved @ RigidTransform.from_pose(small[:6])
        found = warps_of_points(placed, patches, points + np.tensordot(small[6:], displaced, 1), by)
        predicted = linear @ (rates @ small).reshape(-1, 2, 3)
        np.testing.assert_allclose((found - whole).reshape(-1, 2, 3), predicted, atol=1e-3 * np.abs(predicted).max())


@pytest.mark.parametrize("device", ["cpu", *slow("cpu:0")])
def test_a_body_that_turns_by_15_degrees_between_frames_is_where_it_is(device):
    """Up to 165°. With the rates at rest, the mean of 8 series was 55 standard uncertainties off in z at 75° to 90°."""
    poses = turn(12, 15.0)
    body, notices = measured(sensed(light(poses, half_m=(0.02, 0.018)), np.random.default_rng(11)), 12, device)
    u = np.sqrt(2.0 * np.diagonal(body.motion.covariance, axis1=1, axis2=2))  # the reference has noise of its own
    normalised = ((body.motion.pose - poses) / u)[1:]
    assert np.max(np.abs(normalised)) < 6.0  # the noise of the surface, which is not in the covariance, turns with it
    assert np.sqrt(np.mean(normalised**2)) < 2.5
    assert notices == []


@pytest.mark.parametrize("bits", [8, 12])
def test_a_gamma_is_named_and_changes_no_motion(bits):
    poses = swing(18, 0.5)
    linear, quiet = of_linear_sensor(0.5, bits)
    curved, notices = measured(gamma(0.45)(light(poses), np.random.default_rng(6)), bits)
    assert quiet == []
    assert codes(notices) == {"SC-245"}
    assert all(notice.severity == "note" and 5.0 < notice.values["fall_percent"] < 20.0 for notice in notices)
    (error, u), (plain, _) = gain_errors(curved, poses), gain_errors(linear, poses)
    assert np.max(np.abs(error - plain)[:5] / u[:5]) < 1.0  # the same electrons, weighted differently
    assert np.max(np.abs(error - plain)[:2]) < 1e-4


@pytest.mark.parametrize(("level", "share", "shortened"), [(0.68, 0.062, 8e-4), (0.6, 0.18, 3.4e-3)])
def test_wells_that_are_full_below_full_scale_are_named_with_their_size(level, share, shortened):
    """The read noise hides the level from the histogram. A motion of 0.1 px becomes small by about what is said."""
    poses = swing(18, 0.1)
    plain, _ = of_linear_sensor(0.1)
    full, notices = measured(full_wells(level)(light(poses), np.random.default_rng(6)), 12)
    said = [notice for notice in notices if notice.code == "SC-244"]
    assert [notice.where for notice in said] == ["left camera", "right camera"]
    for notice in said:
        assert notice.values["level"] == pytest.approx(4095 * level, rel=0.01)
        assert notice.values["share_percent"] == pytest.approx(100 * share, rel=0.15)
        assert notice.values["shortening_percent"] == pytest.approx(100 * shortened, rel=0.3)
    change = gain_errors(full, poses)[0] - gain_errors(plain, poses)[0]
    assert -2.0 * shortened < change[:2].mean() < -0.5 * shortened


@pytest.mark.parametrize(("size", "times"), [(1e-3, (0.7, 2.0)), (5e-3, (2.0, 8.0))])
def test_rows_that_flicker_are_named_with_their_size(size, times):
    """The motion across the rows scatters more than its covariance says, that along the rows does not."""
    poses = swing(18, 0.5)
    plain, quiet = of_linear_sensor(0.5)
    body, notices = measured(flickering_rows(size)(light(poses), np.random.default_rng(6)), 12)
    said = [notice for notice in notices if notice.code == "SC-246"]
    assert quiet == []
    assert [notice.severity for notice in said] == ["note", "note"]
    assert all(notice.values["row_grey"] == pytest.approx(4095 * size, rel=0.3) for notice in said)
    scatter = [np.std((one.motion.pose - poses)[1:, :2], axis=0) for one in (body, plain)]
    along, across = scatter[0] / scatter[1]
    assert times[0] < across < times[1]
    assert along == pytest.approx(1.0, abs=0.3)


@pytest.mark.parametrize(("axis", "component"), [(1, 0), (0, 1)])
def test_even_and_odd_columns_or_rows_are_named_with_a_bound_of_their_effect_and_corrected(axis, component):
    poses = swing(18, 0.1)
    pattern = EVEN_COLUMNS if axis == 1 else EVEN_COLUMNS.T
    plain, _ = of_linear_sensor(0.1)
    signal = gains(pattern)(light(poses), np.random.default_rng(6))
    alternating, notices = measured(signal, 12, corrected=False)
    said = [notice for notice in notices if notice.code == "SC-247"]
    assert len(said) == 2
    assert {notice.values["lines"] for notice in said} == {"columns" if axis == 1 else "rows"}
    assert all(notice.values["gain_percent"] == pytest.approx(2.0, abs=0.25) for notice in said)
    change = 100.0 * (gain_errors(alternating, poses)[0] - gain_errors(plain, poses)[0])
    bound = said[0].values["shortening_percent"]
    assert -bound < change[component] < -0.2 * bound
    assert abs(change[1 - component]) < 0.05 * bound
    corrected, _ = measured(signal, 12)
    assert np.all(np.abs(gain_errors(corrected, poses)[0] - gain_errors(plain, poses)[0])[:2] < 1e-4)


def test_a_raw_mosaic_is_refused_by_name():
    signal = gains(MOSAIC)(light(swing(3, 0.1)), np.random.default_rng(9))
    refused("^left: .* frame 0: a raw mosaic of a colour camera, .* differ by 6[0-9] % ", measured, signal, 12)


@pytest.mark.parametrize("across", [False, True], ids=["lamp", "gradient"])
def test_light_that_swings_with_the_body_moves_nothing_or_as_little_as_documented(across):
    """10 % of the light, in phase with x. A gradient across the field displaces by less than 2·10⁻⁴ px."""
    poses = swing(18, 0.5)
    plain, _ = measured(sensed(0.9 * light(poses), np.random.default_rng(10)), 12)
    phase = 0.1 * poses[:, 0] / poses[:, 0].max()
    field = np.linspace(-0.5, 0.5, 2 * MIDDLE[0]) if across else np.ones(2 * MIDDLE[0])
    lit = 0.9 * light(poses) * (1.0 + phase[:, None, None] * field)
    swung, notices = measured(sensed(lit, np.random.default_rng(10)), 12)
    assert notices == []
    change_px = 0.5 * (gain_errors(swung, poses)[0] - gain_errors(plain, poses)[0])[0]
    assert abs(change_px) < (2e-4 if across else 1e-5)


def noisy(grey: np.ndarray, variance: np.ndarray, seed: int) -> list[str]:
    """The codes for residuals of these variances, 40 000 pixels in rows of 200."""
    rng = np.random.default_rng(seed)
    residual = np.sqrt(variance) * rng.standard_normal(len(grey))
    return [notice.code for notice in noise_notices(grey, residual, np.arange(len(grey)) // 200, "left camera")]


@pytest.mark.parametrize(
    ("variance", "expected"),
    [
        (lambda g: 40.0 + 0.4 * g, []),
        (lambda g: np.full_like(g, 300.0), []),  # read noise alone
        (lambda g: np.full_like(g, 0.2), []),  # rounding alone
        (lambda g: 400.0 * (g / 1000.0) ** (2.0 - 1.0 / 0.45), ["SC-245"]),
        (lambda g: np.where(g > 2700.0, 20.0, 40.0 + 0.4 * g), ["SC-244"]),
    ],
    ids=["linear", "read noise", "rounding", "gamma", "full wells"],
)
def test_noise_that_a_linear_sensor_has_is_never_named_and_other_noise_always(variance, expected):
    for seed in range(20):
        grey = np.random.default_rng(1000 + seed).uniform(700.0, 2900.0, 40_000)
        assert noisy(grey, variance(grey), seed) == expected


def test_alternating_columns_are_found_by_gain_and_never_without():
    """Speckle of ten draws, in its noise: gains of 1 % are found within 0.3 %, offsets and equal columns are none."""
    columns = np.arange(320) % 2
    for seed in range(10):
        rng = np.random.default_rng(seed)
        wave = rng.uniform(-0.8, 0.8, (100, 2))
        y, x = np.mgrid[:256, :320]
        grey = 2000.0 + 85.0 * sum(np.cos(a * x + b * y + k) for k, (a, b) in enumerate(wave))
        grey = grey + 30.0 * rng.standard_normal(grey.shape)
        assert alternating_gain(grey, 1) == alternating_gain(grey, 0) == 0.0
        assert alternating_gain(grey + 40.0 * columns, 1) == 0.0
        assert alternating_gain(grey * (1.0 + 0.01 * columns), 1) == pytest.approx(0.01, abs=0.003)
        assert alternating_gain(grey * (1.0 - 0.01 * columns), 1) == pytest.approx(-0.01, abs=0.003)
