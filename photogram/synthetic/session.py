"""A calibration session that was never held: the covariance that a stereo pair's parameters would have."""

from __future__ import annotations

import numpy as np

from photogram._checks import FloatArray
from photogram.camera import RIG_PARAMETERS, StereoRig
from photogram.rigid import RigidTransform, rotation_from_vector

# Steps of the numeric derivative, and what is known before the session (focal lengths and centres in px, the
# distortion of a good lens, rotation in rad, translation in m). Without the latter k3 of a narrow field is open.
_CAMERA_STEP = (0.1, 0.1, 0.1, 0.1, 1e-4, 1e-3, 1e-5, 1e-5, 1e-2)
_CAMERA_PRIOR = (100.0, 100.0, 30.0, 30.0, 0.2, 0.5, 2e-3, 2e-3, 0.5)
_STEPS = np.array([*_CAMERA_STEP, *_CAMERA_STEP, *[1e-6] * 3, *[1e-6] * 3])
_PRIOR = np.array([*_CAMERA_PRIOR, *_CAMERA_PRIOR, *[0.1] * 3, *[0.05] * 3])
_POSE_STEPS = np.array([1e-6] * 3 + [1e-6] * 3)


def session_covariance(
    rig: StereoRig, working_point_m: FloatArray, field_m: float, noise_px: float, views: int, rng: np.random.Generator
) -> FloatArray:
    """Return the covariance (24, 24) of the rig after `views` views of a flat target around the working point.

    The target, 13 x 10 points over 0.9 of the field `field_m`, is held in random poses (tilts up to 0.5 rad, shifts
    up to 0.12 of the field, in depth 0.4); corners are found to `noise_px` per coordinate. Inverse Fisher
    information with the target's poses marginalised (Schur complement of each view's 6 x 6 block); the target's own
    scale counts as exact and belongs to `scale_uncertainty`.
    """
    target = _target(field_m)
    information = np.diag(1 / _PRIOR**2)
    for _ in range(views):
        pose = np.concatenate(
            [rng.uniform(-1, 1, 3) * field_m * np.array([0.12, 0.12, 0.4]), rng.uniform(-0.5, 0.5, 3)]
        )
        rig_slope, pose_slope = _slopes(rig, target, pose, working_point_m)
        cross = rig_slope.T @ pose_slope
        information += (
            rig_slope.T @ rig_slope - cross @ np.linalg.solve(pose_slope.T @ pose_slope, cross.T)
        ) / noise_px**2
    scale = np.sqrt(np.diagonal(information))
    covariance = np.linalg.inv(information / np.outer(scale, scale)) / np.outer(scale, scale)
    return np.asarray((covariance + covariance.T) / 2)


def _target(field_m: float) -> FloatArray:
    """Return the points (130, 3) of a flat grid that fills 0.9 of the field."""
    x, y = np.meshgrid(np.linspace(-0.45, 0.45, 13) * field_m, np.linspace(-0.36, 0.36, 10) * field_m)
    return np.stack([x.ravel(), y.ravel(), np.zeros(x.size)], axis=-1)


def _slopes(
    rig: StereoRig, target: FloatArray, pose: FloatArray, working_point_m: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Return the derivatives of a view's pixels by the rig (Q, 24) and by the target's pose (Q, 6)."""
    points = target @ rotation_from_vector(pose[3:]).T + pose[:3] + working_point_m
    rig_slope = np.empty((4 * len(points), len(RIG_PARAMETERS)))
    for i, step in enumerate(_STEPS):
        delta = np.zeros(len(_STEPS))
        delta[i] = step
        rig_slope[:, i] = (_pixels(rig.perturbed(delta), points) - _pixels(rig.perturbed(-delta), points)) / (2 * step)
    pose_slope = np.empty((4 * len(points), 6))
    for i, step in enumerate(_POSE_STEPS):
        delta = np.zeros(6)
        delta[i] = step
        centred = points - working_point_m
        ahead = RigidTransform.from_pose(delta).apply(centred) + working_point_m
        behind = RigidTransform.from_pose(-delta).apply(centred) + working_point_m
        pose_slope[:, i] = (_pixels(rig, ahead) - _pixels(rig, behind)) / (2 * step)
    return rig_slope, pose_slope


def _pixels(rig: StereoRig, points: FloatArray) -> FloatArray:
    """Return all pixel coordinates (4·N,) of points seen by both cameras."""
    left, right = rig.project(points)
    return np.concatenate([left.ravel(), right.ravel()])
