"""Simulator of non-sinusoidal recordings: closed form, another integrator, OpenCV, and the program on sines."""

from __future__ import annotations

import json
from pathlib import Path

import cv2
import numpy as np
import pytest
from nonsinusoidal_rig import AMPLIFIER_HZ, drive, integrate, make_rig, make_system
from nonsinusoidal_truth import EXPOSURE_S, SAMPLE_RATE_HZ, Order, sample_errors, simulate, write
from nonsinusoidal_views import TEXTURE_M, TOP_M, View, make_cameras, make_texture
from scipy.integrate import solve_ivp
from scipy.ndimage import map_coordinates, spline_filter
from scipy.spatial.transform import Rotation
from scipy.stats import chi2

from fusion import evaluate_recording, load_manifest

HERTZ = 407.3


def amplifier(hertz: float) -> complex:
    ratio = hertz / AMPLIFIER_HZ
    return 1.0 / (1.0 - ratio**2 + 1j * np.sqrt(2.0) * ratio)


@pytest.mark.parametrize("draw", [0, 1])
def test_a_rig_keeps_its_promises(draw: int) -> None:
    """Dampers lose energy, the loads are those of inertia and tilted weight, bending has a Q of 20."""
    rig = make_rig(draw)
    assert np.linalg.eigvalsh(rig.stiffness).min() > 0.0
    assert np.linalg.eigvalsh(rig.damping).min() > 0.0
    poles = np.linalg.eigvals(make_system(rig).a)
    bending = min(poles, key=lambda pole: abs(pole - 2j * np.pi * rig.natural()[0][0]))
    assert poles.real.max() < 0.0
    assert abs(bending) / (-2.0 * bending.real) == pytest.approx(20.0, rel=0.05)
    pose, load, _ = (part[0] for part in rig.responses(np.array([HERTZ])))
    deformation = rig.base_per_table(np.array([HERTZ]))[0] - pose
    spring = rig.stiffness + 2j * np.pi * HERTZ * rig.damping
    np.testing.assert_allclose(spring @ deformation, load, atol=1e-9 * np.abs(load).max())


def test_time_steps_agree_with_a_runge_kutta_method() -> None:
    """For a force that is linear between its points, whatever the step."""
    system, step_s = make_system(make_rig(1)), 1.0 / SAMPLE_RATE_HZ
    grid_s = np.arange(400) * step_s
    force = drive("train", np.asarray(grid_s + 0.017), 0.03, 0.0, np.random.default_rng(0))
    times_s = np.array([0.0043, 0.0101234, 0.0149])
    rows = np.eye(38)[[4, 16, 28]]
    samples, poses = integrate(system, force, step_s, rows, (slice(None), times_s))
    solved = solve_ivp(
        lambda time_s, state: system.a @ state + system.b * np.interp(time_s, grid_s, force),
        *((0.0, times_s[-1]), np.zeros(38)),
        **{"method": "DOP853", "rtol": 1e-7, "atol": 1e-13, "t_eval": times_s, "max_step": 2.0 * step_s},
    )
    np.testing.assert_allclose(poses, solved.y[14:20].T, atol=1e-5 * np.abs(poses).max())
    finer = np.interp(np.arange(1597) * step_s / 4.0, grid_s, force)
    again, same = integrate(system, finer, step_s / 4.0, rows, (slice(0, None, 4), times_s))
    np.testing.assert_allclose(again, samples, atol=1e-8 * np.abs(samples).max())
    np.testing.assert_allclose(same, poses, atol=1e-8 * np.abs(poses).max())


@pytest.mark.parametrize("direction", [None, "x", "rx"])
def test_a_simulated_sine_has_the_transfer_of_the_closed_form(direction: str | None) -> None:
    order = Order("sine", 1, HERTZ, exact=True, duration_s=0.5, direction=direction)
    rig = make_rig(1, exact=True, driven=order.driven)
    motion = simulate(order, rig, sample_errors(order), np.random.default_rng(1))
    phase = 2j * np.pi * HERTZ * np.arange(len(motion["samples"])) / SAMPLE_RATE_HZ
    basis = np.stack([np.exp(phase), np.exp(-phase)], 1)
    phasors = np.linalg.lstsq(basis, motion["samples"].astype(complex))[0][0]
    pose, load, matrix = (part[0] for part in rig.responses(np.array([HERTZ])))
    velocity = 2j * np.pi * HERTZ * (pose[2] - 0.033 * pose[4])
    np.testing.assert_allclose(
        phasors[6:12] / phasors[0],
        amplifier(HERTZ) * matrix @ load / velocity,
        atol=1e-7 * np.abs(matrix @ load / velocity).max(),
    )
    middle = np.exp(2j * np.pi * HERTZ * motion["middle"])[:, None] * (pose * phasors[0] / velocity)
    np.testing.assert_allclose(motion["pose"], 2.0 * middle.real, atol=1e-7 * np.abs(middle).max())
    loss = np.sinc(HERTZ * EXPOSURE_S)
    np.testing.assert_allclose(motion["mean"], loss * motion["pose"], atol=1e-7 * np.abs(middle).max())


def test_images_show_the_face_where_opencv_projects_it() -> None:
    """Grey values at projected points are those of the texture, which determines the pose to some nanometres."""
    rng, pose = np.random.default_rng(0), np.array([3e-5, -5e-5, 1e-4, 2e-4, -1e-4, 3e-4])
    texture, camera = make_texture(rng), make_cameras()[0]
    body = np.concatenate([rng.uniform(-0.02, 0.02, (4000, 2)), np.full((4000, 1), TOP_M)], 1)
    points = Rotation.from_rotvec(pose[3:]).apply(body) + pose[:3]
    turn = camera.axes.T
    seen = cv2.projectPoints(
        points, cv2.Rodrigues(turn)[0], -turn @ camera.place_m, camera.matrix, np.array(camera.distortion)
    )
    pixels = seen[0][:, 0]
    view = View.of(camera, texture)
    image = view.image(pose)
    spline = spline_filter(image, 5)
    grey = [map_coordinates(spline, (pixels + shift)[:, ::-1].T, order=5, prefilter=False) for shift in np.eye(3, 2)]
    drawn = 255.0 * map_coordinates(texture, body[:, :2].T / TEXTURE_M + 319.5, order=5, prefilter=False)
    slopes = np.stack([side - grey[2] for side in grey[:2]], 1)
    shift_px = np.linalg.lstsq(slopes, drawn - grey[2])[0]
    assert np.abs(shift_px).max() < 1e-4
    moved = np.array([1e-8, 1e-8, 4e-6, 1e-6, 1e-6, 1e-7])
    nodes, weights = np.polynomial.legendre.leggauss(5)
    mean = sum(
        0.5 * weight * view.image(pose + 0.5 * node * moved) for node, weight in zip(nodes, weights, strict=True)
    )
    assert np.abs(mean - image).max() < 0.01


@pytest.mark.slow
@pytest.mark.parametrize("draw", [0, 2])
def test_the_program_finds_the_sensitivity_of_a_sine(tmp_path: Path, draw: int) -> None:
    """Points in place of images, with every stated error sampled."""
    folder = tmp_path / "sine"
    write(Order("sine", draw, HERTZ, poses=True, duration_s=2.0), folder)
    truth = json.loads((folder / "truth.json").read_text(encoding="utf-8"))
    element = evaluate_recording(load_manifest(folder)).element
    assert element is not None
    expected = complex(truth["sensitivity"]["re"][0][2][2], truth["sensitivity"]["im"][0][2][2])
    value, covariance = element.value[0, 2, 2], element.covariance[0, 2, 2]
    deviation = np.array([(value - expected).real, (value - expected).imag])
    assert np.sqrt(np.trace(covariance)) < 3e-3 * abs(expected)
    assert deviation @ np.linalg.solve(covariance, deviation) < chi2.ppf(0.999, 2)
