"""Points on the faces that stereo pairs see, as another correlation program writes them."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from fusion.simulate.draws import Draws
from fusion.simulate.mechanics import Motion
from fusion.simulate.scenery import StereoSetup, left_camera
from fusion.simulate.world import World, true_pose
from photogram.rigid import RigidTransform
from shaker._checks import FloatArray

COLUMNS = ("frame", "id", "x", "y", "z")
FILE_SCALE = 1e-3  # millimetres in the file
GRID = (8, 5)
_INSIDE = 0.68  # of the half size: the grid's corners stay on a round face
_NOISE_M = (0.7e-6, 0.7e-6, 1.8e-6)  # x, y and along the view of the left camera


def face_points(setup: StereoSetup) -> FloatArray:
    """Return a grid (N, 3) of points on a face, in the sensor frame at rest."""
    across, up = (_INSIDE * half * np.linspace(-1.0, 1.0, n) for half, n in zip(setup.half_size, GRID, strict=True))
    side = np.cross(np.array(setup.face_up), np.array(setup.face_normal))
    grid = across[:, None, None] * side + up[None, :, None] * np.array(setup.face_up)
    return np.asarray(np.array(setup.face_centre) + grid.reshape(-1, 3))


@dataclass(frozen=True, eq=False)
class PointSeries:
    """Points of one stereo pair: position_m (F, N, 3) in the frame of its left camera, with the errors of the pair."""

    setup: StereoSetup
    position_m: FloatArray


def point_series(world: World, setup: StereoSetup, draws: Draws, noise: bool) -> PointSeries:
    """Return the points of a pair through all frames: moved, blurred by the exposure, in its own scale and pose.

    A point of the program is the true one in the camera's frame over the scale 1 + e. An exposure of length T shows
    the mean over T: a line at f is smaller by sin(πfT)/(πfT).
    """
    scale = 1 + float(draws.normal(f"{setup.name}.scale", setup.scale_uncertainty))
    left_from_sensor = true_pose(setup, left_camera(setup), scale, draws).inverse()
    delay = float(draws.normal(f"{setup.name}.delay", setup.delay_uncertainty))
    exposure = world.preset.exposure_s
    motion = world.motion[setup.body]
    seen = Motion(motion.frequency_hz, motion.acceleration * np.sinc(motion.frequency_hz * exposure)[:, None])
    rest = face_points(setup)
    poses = (RigidTransform.from_pose(pose) for pose in seen.pose(world.trigger_s + delay + exposure / 2))
    position = np.stack([left_from_sensor.apply(pose.apply(rest)) for pose in poses]) / scale
    if noise:
        deviate = draws.stream(f"{setup.name}.points").standard_normal(position.shape)
        position = position + deviate * np.array(_NOISE_M)
    return PointSeries(setup, position)


def write_points(path: Path, series: PointSeries) -> None:
    """Write a table with one row per frame and point: `COLUMNS`, lengths in millimetres with six decimals."""
    frames, count = series.position_m.shape[:2]
    place = np.stack(np.meshgrid(np.arange(frames), np.arange(count), indexing="ij"), axis=-1)
    rows = np.concatenate([place, series.position_m / FILE_SCALE], axis=2).reshape(-1, len(COLUMNS))
    text = "\n".join(f"{frame:.0f},{point:.0f},{x:.6f},{y:.6f},{z:.6f}" for frame, point, x, y, z in rows.tolist())
    path.write_text(f"{','.join(COLUMNS)}\n{text}\n", encoding="utf-8", newline="\n")
