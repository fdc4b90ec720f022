"""Cameras of a pair that are not exposed at the same time, by their motion across the epipolar lines alone."""

from __future__ import annotations

import numpy as np
import pytest

from fusion.errors import ComputeError
from fusion.phasors.image_effects import check_in_step
from fusion.phasors.phasor_notices import CAMERA_DELAYED, CAMERAS_OUT_OF_STEP
from photogram.camera import Camera, StereoRig
from photogram.geometry import RigidTransform, rotation_from_vector
from shakercal._common.notices import Notice

FREQUENCY_HZ, PERIOD_S, NOISE_PX = 80.0, 0.0261, 2e-3
CAMERA = Camera.from_parameters(np.array([2000.0, 2000, 320, 240, 0, 0, 0, 0, 0]), np.array([640, 480]))
RIG = StereoRig(
    CAMERA, CAMERA, RigidTransform(rotation_from_vector(np.array([0.0, 0.3, 0.02])), np.array([-0.15, 0.002, 0.03]))
)


def phasor_frames(late_s: float, motion_m: np.ndarray, rng: np.random.Generator) -> list[np.ndarray]:
    """Return mean positions and phasors of 200 points of a body that moves as Re{motion · exp(jωt)}; right is late."""
    points = np.array([0.0, 0.0, 0.5]) + rng.uniform(-0.04, 0.04, (200, 3)) * [1.0, 1.0, 0.3]
    frames = []
    for camera_from_left, delay_s in ((None, 0.0), (RIG.right_from_left, late_s)):
        phasor = motion_m * np.exp(-2j * np.pi * FREQUENCY_HZ * delay_s)
        moved = [points + step for step in (np.zeros(3), phasor.real, phasor.imag)]
        seen = [p if camera_from_left is None else camera_from_left.apply(p) for p in moved]
        places = np.stack([CAMERA.project(one) for one in seen])
        frames.append(places + NOISE_PX * rng.normal(size=places.shape) / np.sqrt(2.0))
    return frames


def checked(late_s: float, motion_m: np.ndarray, seed: int = 1) -> tuple[Notice, ...]:
    frames = phasor_frames(late_s, motion_m, np.random.default_rng(seed))
    times = PERIOD_S * np.arange(24.0)
    return check_in_step(RIG, frames, np.array([FREQUENCY_HZ]), times)


ACROSS, ALONG = np.array([5e-6, 3e-5 * np.exp(0.7j), 1e-5j]), np.array([3e-5 + 0j, 0.0, 0.0])


@pytest.mark.parametrize("motion", [ACROSS, ALONG, 1e-9 * ACROSS], ids=["across", "along", "still"])
def test_cameras_in_step_are_not_doubted(motion):
    assert not any(checked(0.0, motion, seed) for seed in range(20))


@pytest.mark.parametrize(("late_s", "side"), [(60e-6, "right"), (-200e-6, "left")])
def test_a_lag_is_measured_within_its_uncertainty(late_s, side):
    (notice,) = checked(late_s, ACROSS)
    assert (notice.code, notice.values["late"]) == (CAMERA_DELAYED.code, side)
    lag_us, u_mrad = notice.values["delay_us"], notice.values["u_mrad"]
    assert abs(1e-6 * lag_us - abs(late_s)) < 3e-3 * u_mrad / (2 * np.pi * FREQUENCY_HZ)
    assert u_mrad < 3.0


@pytest.mark.parametrize(("count", "side"), [(1, "right"), (-1, "left"), (3, "right"), (-2, "left")])
def test_whole_frames_are_named(count, side):
    with pytest.raises(ComputeError) as error:
        checked(count * PERIOD_S, ACROSS)
    assert (error.value.code, error.value.values["late"]) == (CAMERAS_OUT_OF_STEP.code, side)
    assert error.value.values["frames"] == abs(count)
    assert error.value.values["delay_ms"] == pytest.approx(1e3 * abs(count) * PERIOD_S)
