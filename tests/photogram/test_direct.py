"""Six components from the grey values: rendered truth, Monte Carlo against the stated covariance and the bound."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pytest

from photogram.bspline import Spline, spline_of_image
from photogram.camera import Camera
from photogram.direct import BodyView, fit_direct, image_noise, rest_covariance, view_body
from photogram.geometry import RigidTransform
from photogram.images import NoiseModel
from photogram.motion import PlacedCamera
from photogram.subsets.texture import textured_area
from photogram.synthetic.scene import Face, ImageSensor, motion_bound, render, speckle_texture, view_of

PIXEL_M, FOCAL = 2e-4, 1500.0
SENSOR = ImageSensor(12, 8.0, 6.0)
POSE = np.array([6e-5, -8e-5, 5e-5, 8e-4, -6e-4, 1.2e-3])
TRIALS = 120


@dataclass(frozen=True)
class Scene:
    """A round speckled face before two cameras: clean images at rest and moved, fractions of full scale."""

    places: tuple[PlacedCamera, PlacedCamera]
    face: Face
    rest: tuple[np.ndarray, np.ndarray]
    moved: tuple[np.ndarray, np.ndarray]

    def known_m(self) -> np.ndarray:
        """Points of the surface, a few more than its rim."""
        u, v = np.meshgrid(np.linspace(-0.018, 0.018, 13), np.linspace(-0.018, 0.018, 13))
        return np.column_stack([u.ravel(), v.ravel(), np.zeros(u.size)])


@pytest.fixture(scope="module")
def scene() -> Scene:
    texture = speckle_texture((0.04, 0.04), 5 * PIXEL_M, PIXEL_M / 4, 1.2 * PIXEL_M, np.random.default_rng(7))
    axes = np.eye(3)
    face = Face(np.zeros(3), axes[0], axes[1], np.array([0.017, 0.017]), True, texture, 0.6 * PIXEL_M)
    matrix = np.array([[FOCAL, 0, 110], [0, FOCAL, 100], [0, 0, 1.0]])
    camera = Camera(matrix, np.array([-0.1, 0.1, 2e-4, -1e-4, 0.0]), np.array([220, 200]))
    places = tuple(
        PlacedCamera(
            camera,
            RigidTransform(np.eye(3), np.array([0, 0, FOCAL * PIXEL_M]))
            @ RigidTransform.from_pose(np.array([0, 0, 0, 0.1, angle, 0])),
        )
        for angle in np.radians([-14.0, 14.0])
    )
    views = [view_of(place.camera, place.camera_from_body) for place in places]
    images = [[render(view, face, pose[None], np.ones(1)) for view in views] for pose in (np.zeros(6), POSE)]
    return Scene((places[0], places[1]), face, (images[0][0], images[0][1]), (images[1][0], images[1][1]))


def splines(images: tuple[np.ndarray, np.ndarray], rng: np.random.Generator | None) -> list[Spline]:
    """Both cameras' images with noise; without `rng` neither noise nor rounding."""
    if rng is None:
        return [spline_of_image(image * SENSOR.full_scale) for image in images]
    return [spline_of_image(SENSOR.digitise(image, rng)) for image in images]


def body_views(scene: Scene, rng: np.random.Generator | None, noise: NoiseModel) -> list[BodyView]:
    rest = splines(scene.rest, rng)
    return [
        view_body(place, (spline, area(image), SENSOR.full_scale), scene.known_m(), 21, noise)
        for place, spline, image in zip(scene.places, rest, scene.rest, strict=True)
    ]


def area(image: np.ndarray) -> np.ndarray:
    inside = np.zeros(image.shape, dtype=bool)
    inside[5:-5, 5:-5] = True
    return textured_area(image * SENSOR.full_scale) & inside


def model() -> NoiseModel:
    return NoiseModel(SENSOR.read_noise_grey**2 + 1 / 12, 1 / SENSOR.electrons_per_grey)


def sigma(covariance: np.ndarray) -> np.ndarray:
    return np.sqrt(np.diagonal(covariance))


def test_a_motion_is_found_without_noise_from_a_pixel_away(scene: Scene) -> None:
    """What is left of the interpolation is a few ten-thousandths of a pixel."""
    views = body_views(scene, None, model())
    fit = fit_direct(views, splines(scene.moved, None), RigidTransform.identity())
    assert fit is not None
    error = fit.moved.pose - POSE
    assert np.max(np.abs(POSE[:3])) > 0.4 * PIXEL_M * 0.9
    assert np.max(np.abs(error[:2])) < 2e-4 * PIXEL_M
    assert abs(error[2]) < 1e-3 * PIXEL_M
    assert np.max(np.abs(error[3:])) < 1e-3 * PIXEL_M / 0.017


def test_scatter_is_the_stated_one_and_close_to_the_bound(scene: Scene) -> None:
    rng = np.random.default_rng(11)
    views = body_views(scene, rng, model())
    start, found, stated, noise = RigidTransform.from_pose(POSE), [], [], []
    for _ in range(TRIALS):
        fit = fit_direct(views, splines(scene.moved, rng), start)
        assert fit is not None
        found.append(fit.moved.pose)
        stated.append(np.diagonal(fit.covariance))
        noise.append(fit.noise)
    scatter = np.std(found, axis=0, ddof=1)
    bound = sigma(motion_bound([view_of(p.camera, p.camera_from_body) for p in scene.places], scene.face, SENSOR, POSE))
    spread = 1 / np.sqrt(2 * (TRIALS - 1))
    assert np.all(np.abs(scatter / np.sqrt(np.mean(stated, axis=0)) - 1) < 4 * spread)
    assert np.all(scatter / bound > 1 - 3 * spread)
    # The rim and a border of five pixels are left out of this small face, and gain and offset are free: 1.1 to 1.2.
    assert np.all(scatter / bound < 1.25 + 3 * spread)
    assert abs(np.mean(noise) - 1) < 0.02
    np.testing.assert_allclose(sigma(rest_covariance(views, 1.0)), scatter, rtol=5 * spread)


def test_the_camera_noise_is_found(scene: Scene) -> None:
    rng = np.random.default_rng(12)
    views = body_views(scene, rng, NoiseModel(1.0, 0.0))
    targets = splines(scene.moved, rng)
    fit = fit_direct(views, targets, RigidTransform.from_pose(POSE))
    assert fit is not None
    for view, target in zip(views, targets, strict=True):
        found = image_noise(view, target, fit.moved)
        level = np.array([600.0, 1500.0, 3000.0])
        np.testing.assert_allclose(found.variance(level), SENSOR.variance(level), rtol=0.06)


def test_the_lamp_does_not_matter(scene: Scene) -> None:
    """Gain and offset of all cells are free: a lamp that dims and stray light change the pose by rounding only."""
    rng = np.random.default_rng(13)
    views = body_views(scene, rng, model())
    plain = fit_direct(views, splines(scene.moved, None), RigidTransform.identity())
    lit = fit_direct(
        views,
        [spline_of_image(image * 0.8 * SENSOR.full_scale + 40) for image in scene.moved],
        RigidTransform.identity(),
    )
    assert plain is not None
    assert lit is not None
    assert np.all(np.abs(lit.moved.pose - plain.moved.pose) < 0.02 * sigma(rest_covariance(views, 1.0)))


def test_what_moves_in_front_of_the_body_is_left_out(scene: Scene) -> None:
    """A cable across the left image: its cells are dropped, and the motion stays within its noise."""
    rng = np.random.default_rng(14)
    views = body_views(scene, rng, model())
    targets = splines(scene.moved, rng)
    clean = fit_direct(views, targets, RigidTransform.from_pose(POSE))
    covered = scene.moved[0].copy()
    covered[90:104] = 0.6
    hidden = [spline_of_image(SENSOR.digitise(covered, rng)), targets[1]]
    fit = fit_direct(views, hidden, RigidTransform.from_pose(POSE))
    assert clean is not None
    assert fit is not None
    assert fit.cells <= clean.cells - 8
    assert np.all(np.abs(fit.moved.pose - POSE) < 5 * sigma(fit.covariance))


def test_a_body_that_is_not_there_has_no_motion(scene: Scene) -> None:
    views = body_views(scene, np.random.default_rng(15), model())
    blank = [spline_of_image(np.full((200, 220), 700.0))] * 2
    assert fit_direct(views, blank, RigidTransform.identity()) is None
    far = RigidTransform.from_pose(np.array([0.2, 0, 0, 0, 0, 0]))
    assert fit_direct(views, splines(scene.moved, None), far) is None


def test_the_order_of_the_cameras_does_not_matter(scene: Scene) -> None:
    rng = np.random.default_rng(16)
    views, targets = body_views(scene, rng, model()), splines(scene.moved, rng)
    one = fit_direct(views, targets, RigidTransform.identity())
    other = fit_direct(views[::-1], targets[::-1], RigidTransform.identity())
    assert one is not None
    assert other is not None
    np.testing.assert_allclose(one.moved.pose, other.moved.pose, atol=1e-12)
    np.testing.assert_allclose(one.covariance, other.covariance, rtol=1e-6, atol=1e-25)
