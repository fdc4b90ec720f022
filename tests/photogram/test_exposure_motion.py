"""Frames looked at again with a known motion: paths of exposures, motion from row to row."""

from __future__ import annotations

import numpy as np
import pytest

from photogram.geometry import RigidTransform
from photogram.measure.exposure_motion import ExposureMotion, apply_motion, blur_along_path, row_delay_s, undo_motion

X = np.array([[2e-4 + 1e-4j, -3e-4j, 1e-3, 1e-3j, -2e-3, 1e-3 + 1e-3j], [1e-5, 2e-5j, 3e-5, 0.0, 1e-4, 1e-4j]])
HERTZ = np.array([80.0, 160.0])


def swing(exposure_s: float = 0.0, row_s: float = 0.0) -> ExposureMotion:
    return ExposureMotion(HERTZ, X, np.arange(8) / 38.3, exposure_s, (row_s, row_s), motion_blur=exposure_s > 0.0)


def true_pose(time_s: float) -> RigidTransform:
    return RigidTransform.from_pose(np.real(np.exp(2j * np.pi * HERTZ * time_s) @ X))


def test_a_body_is_carried_from_one_instant_to_another():
    points, times = np.random.default_rng(1).uniform(-0.05, 0.05, (3, 4, 3)), np.linspace(0.0, 0.01, 12).reshape(3, 4)
    carried = swing().relative_motion(0.003, times)
    there = apply_motion(carried, points)
    for place in np.ndindex(3, 4):
        expected = (true_pose(times[place]) @ true_pose(0.003).inverse()).apply(points[place])
        np.testing.assert_allclose(there[place], expected, atol=1e-15)
    np.testing.assert_allclose(undo_motion(carried, there), points, atol=1e-15)


def test_the_mean_over_an_exposure_is_that_of_many_instants():
    nodes = np.linspace(-2.5e-3, 2.5e-3, 20001)
    translations = np.stack([np.real(np.exp(2j * np.pi * HERTZ * (0.004 + t)) @ X)[:3] for t in nodes])
    mean = swing(5e-3).pose(np.asarray(0.004), 5e-3)[1]
    np.testing.assert_allclose(mean, translations.mean(axis=0), rtol=1e-4, atol=1e-9)


def test_rows_follow_the_one_that_is_read_first():
    rows = np.array([0.0, 10.0, 99.0])
    np.testing.assert_allclose(row_delay_s(1e-5, rows, 100), [0.0, 1e-4, 9.9e-4])
    np.testing.assert_allclose(row_delay_s(-1e-5, rows, 100), [9.9e-4, 8.9e-4, 0.0], atol=1e-18)


@pytest.mark.parametrize("along", [0, 1])
def test_a_wave_is_blurred_to_its_mean_over_the_path(along):
    share = np.array([0.2, 0.5, 0.3])
    shift = np.array([-1.3, 0.1, 0.7])
    grow = 0.01  # of the shift for each pixel along x
    y, x = np.mgrid[0:60, 0:80].astype(float)
    place, k = (x, y)[along], 2.0 * np.pi / 9.0
    path = np.zeros((1, 3, 2, 3))
    path[0, :, along, 0], path[0, :, along, 1] = shift, grow * shift
    expected = sum(w * np.cos(k * (place - d * (1.0 + grow * x))) for w, d in zip(share, shift, strict=True))
    found = blur_along_path(1000.0 * np.cos(k * place), path, share)
    np.testing.assert_allclose(found[8:-8, 8:-8] / 1000.0, expected[8:-8, 8:-8], atol=2e-3)
