"""A speckled face that moves in a sine before two sensors with a fixed pattern."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
from speckle import SENSOR, sequence, two_poses
from speckle import camera as camera_of
from speckle import face as face_of

from photogram.camera import StereoRig
from photogram.images.sensor_pattern import TYPICAL, SensorPattern
from photogram.measure.body import BodyMotion, BodyPrior, body_motion, follow_block, prepare_body
from photogram.subsets.icgn import TrackSettings
from photogram.synthetic.scene import render, view_of

FRAMES, AMPLITUDE_PX, PIXEL_M = 24, 0.4, 2e-4
PHASE = 2.0 * np.pi * 0.618 * np.arange(FRAMES)
COLUMNS = np.column_stack([np.ones(FRAMES), np.cos(PHASE), np.sin(PHASE)])
SHIFT_PX = AMPLITUDE_PX * np.cos(PHASE)
Pixels = Callable[[np.ndarray, np.random.Generator], np.ndarray]


def clean_images(shift_px: np.ndarray = SHIFT_PX) -> list[list[np.ndarray]]:
    """Images of a weakly textured face that is displaced along its plane, without noise and pattern."""
    face = replace(face_of((0.013, 0.013), 3), bright=0.65, dark=0.35)
    poses = [np.array([x, 0.3 * x, 0, 0, 0, 0]) for x in shift_px * PIXEL_M]
    views = [view_of(camera_of((90, 90)), place) for place in two_poses()]
    return [[render(view, face, pose[None], np.ones(1)) for pose in poses] for view in views]


def measured(
    clean: list[list[np.ndarray]],
    seed: int,
    changed: Pixels,
    known: SensorPattern = TYPICAL,
    displaced: list[list[np.ndarray]] | None = None,
) -> BodyMotion:
    """The motion in the images of two sensors whose pixels change the light in their own fashion."""
    rng = np.random.default_rng(seed)
    images, further = [], []
    for side, places in zip(clean, displaced or [[], []], strict=True):
        fixed = rng.integers(0, 2**31)
        pixels = [changed(image, np.random.default_rng(fixed)) for image in [*side, *places]]
        grey = [SENSOR.digitise(one, rng) for one in pixels]
        images.append(replace(sequence(grey[: len(side)]), pattern=known))
        further += [sequence(grey[len(side) :])] if places else []
    one, (left, right) = camera_of((90, 90)), two_poses()
    rig, prior = StereoRig(one, one, right @ left.inverse()), BodyPrior(displaced=tuple(further))
    scene = prepare_body((images[0], images[1]), rig, left.inverse(), TrackSettings(), prior=prior)
    return body_motion(scene, [follow_block(scene, block) for block in scene.blocks])


def relative_error(pose: np.ndarray) -> float:
    amplitude = np.linalg.lstsq(COLUMNS, pose[:, 0], rcond=None)[0][1]
    return float(amplitude / (AMPLITUDE_PX * PIXEL_M) - 1.0)
