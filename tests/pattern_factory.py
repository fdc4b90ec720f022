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
from photogram.measure.body import BodyMotion, measure_body
from photogram.subsets.icgn import TrackSettings
from photogram.synthetic.scene import render, view_of

FRAMES, AMPLITUDE_PX, PIXEL_M = 24, 0.4, 2e-4
PHASE = 2.0 * np.pi * 0.618 * np.arange(FRAMES)
COLUMNS = np.column_stack([np.ones(FRAMES), np.cos(PHASE), np.sin(PHASE)])
Pixels = Callable[[np.ndarray, np.random.Generator], np.ndarray]


def clean_images() -> list[list[np.ndarray]]:
    """Images of a weakly textured face that moves by 0.4 px, without noise and pattern."""
    face = replace(face_of((0.013, 0.013), 3), bright=0.65, dark=0.35)
    shift_m = AMPLITUDE_PX * PIXEL_M * np.cos(PHASE)
    poses = [np.array([x, 0.3 * x, 0, 0, 0, 0]) for x in shift_m]
    views = [view_of(camera_of((90, 90)), place) for place in two_poses()]
    return [[render(view, face, pose[None], np.ones(1)) for pose in poses] for view in views]


def measured(clean: list[list[np.ndarray]], seed: int, changed: Pixels, known: SensorPattern = TYPICAL) -> BodyMotion:
    """The motion in the images of two sensors whose pixels change the light in an own way."""
    rng = np.random.default_rng(seed)
    images = []
    for side in clean:
        fixed = rng.integers(0, 2**31)
        pixels = [changed(image, np.random.default_rng(fixed)) for image in side]
        images.append(replace(sequence([SENSOR.digitise(one, rng) for one in pixels]), pattern=known))
    one, places = camera_of((90, 90)), two_poses()
    rig = StereoRig(one, one, places[1] @ places[0].inverse())
    return measure_body((images[0], images[1]), rig, places[0].inverse(), TrackSettings())


def relative_error(pose: np.ndarray) -> float:
    amplitude = np.linalg.lstsq(COLUMNS, pose[:, 0], rcond=None)[0][1]
    return float(amplitude / (AMPLITUDE_PX * PIXEL_M) - 1.0)
