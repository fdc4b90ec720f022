"""Operating deflection shapes from points that bend as they are told."""

from __future__ import annotations

import numpy as np
import pytest

from fusion.phasors.results import deflection_shape
from photogram.camera import Points
from photogram.geometry import rotation_from_vector
from photogram.motion import Deformation, deformation, fit_motion

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
    points = Points(moved, covariance, np.zeros(moved.shape[:2]))
    return time, saddle, deformation(points, fit_motion(points, None, np.zeros(3)))


@pytest.mark.parametrize("bend", [0.0, BEND])
def test_the_shape_comes_back_within_its_uncertainty(bend: complex) -> None:
    """Errors of real and imaginary parts over the stated uncertainty, of all points, directions and 4 series."""
    ratios = []
    for seed in range(4):
        time, saddle, residual = bending_body(seed, bend)
        shape = deflection_shape(time, LINES_HZ, residual, EXPOSURE_S)
        truth = np.zeros_like(shape.value)
        truth[0, :, 2] = bend * saddle
        error = (shape.value - truth) / shape.u
        ratios.append(np.stack([error.real, error.imag]))
    assert np.mean(np.square(ratios)) == pytest.approx(1.0, abs=0.06)
    if bend:
        fitted = np.sum(shape.value[0, :, 2] * saddle) / np.sum(saddle**2)
        u = shape.u[0, :, 2].mean() / np.sqrt(np.sum(saddle**2))
        assert abs(fitted - bend) < 3.5 * u < 0.1 * abs(bend)


def test_missing_frames_cost_nothing_but_their_share() -> None:
    time, _, residual = bending_body(1, BEND)
    residual.residual_m[::3, 5] = np.nan
    residual.residual_m[:90, 6] = np.nan
    shape = deflection_shape(time, LINES_HZ, residual, EXPOSURE_S)
    assert np.isnan(shape.value[:, 6]).all()
    assert np.isnan(shape.u[:, 6]).all()
    assert shape.u[0, 5].mean() == pytest.approx(shape.u[0, 7].mean() * np.sqrt(96 / 64), rel=0.25)
    assert np.isfinite(np.delete(shape.value, 6, axis=1)).all()
