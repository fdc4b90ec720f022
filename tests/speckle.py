"""Rendered speckle before stereo pairs: sequences of images with known motion."""

from __future__ import annotations

import numpy as np

from photogram.camera import Camera, StereoRig
from photogram.geometry import RigidTransform
from photogram.images.sequence import ImageSequence
from photogram.subsets.icgn_torch import TorchSplines, splines_of, upload_images
from photogram.synthetic.scene import Face, ImageSensor, render, speckle_texture, view_of

PIXEL_M, FOCAL = 2e-4, 1500.0
SENSOR = ImageSensor(12, 8.0, 6.0)
Stereo = tuple[tuple[ImageSequence, ImageSequence], StereoRig, RigidTransform]


def sequence(images: list[np.ndarray], full_scale: int = SENSOR.full_scale) -> ImageSequence:
    height, width = images[0].shape
    names = tuple(f"frame {index}" for index in range(len(images)))
    return ImageSequence(names, (width, height), full_scale, images.__getitem__)


def face(half_m: tuple[float, float], seed: int, is_round: bool = False) -> Face:
    """A speckled face in the world plane z = 0, dots of 5 px, blur of 1.2 px, its rim's of 0.6 px."""
    texture = speckle_texture((0.04, 0.04), 5 * PIXEL_M, PIXEL_M / 4, 1.2 * PIXEL_M, np.random.default_rng(seed))
    return Face(np.zeros(3), np.eye(3)[0], np.eye(3)[1], np.array(half_m), is_round, texture, 0.6 * PIXEL_M)


def camera(middle: tuple[int, int], distortion: tuple[float, ...] = (0, 0, 0, 0, 0)) -> Camera:
    return Camera.from_parameters(np.array([FOCAL, FOCAL, *middle, *distortion]), 2 * np.array(middle))


def two_poses(tilt: float = 0.0) -> list[RigidTransform]:
    """Camera from body of two cameras that see pixels of PIXEL_M, 28° apart."""
    away = RigidTransform(np.eye(3), np.array([0, 0, FOCAL * PIXEL_M]))
    turns = (np.array([0, 0, 0, tilt, angle, 0]) for angle in np.radians([-14.0, 14.0]))
    return [away @ RigidTransform.from_pose(turn) for turn in turns]


def render_images(
    poses: np.ndarray,
    half_m: tuple[float, float],
    middle: tuple[int, int],
    seed: int,
    sensor: ImageSensor = SENSOR,
    noisy: bool = True,
) -> Stereo:
    """A speckled face before two cameras, 28° apart: both cameras' images, rig, body_from_left."""
    one, body, places = camera(middle), face(half_m, seed), two_poses()
    rng = np.random.default_rng(seed + 1) if noisy else None
    pictures = [[render(view_of(one, place), body, pose[None], np.ones(1)) for pose in poses] for place in places]
    left, right = (sequence([sensor.digitise(each, rng) for each in side], sensor.full_scale) for side in pictures)
    return (left, right), StereoRig(one, one, places[1] @ places[0].inverse()), places[0].inverse()


def spline_frames(images: np.ndarray, degree: int, device: str, precision: str = "float64") -> TorchSplines:
    """The splines of images (B, H, W) on a device."""
    return splines_of(upload_images(list(images), device)[1], degree, precision)
