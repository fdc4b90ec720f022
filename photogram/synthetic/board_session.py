"""Random stereo pairs, and random poses of a calibration target before them: sessions with known truth."""

from __future__ import annotations

import numpy as np

from photogram._checks import FloatArray, IntArray
from photogram.camera import Camera, StereoRig
from photogram.rigid import RigidTransform, rotation_from_vector
from photogram.synthetic.board import Board

_TRIES = 1500  # random poses tried for each that is wanted
_STEEPEST_RAD = 0.9  # between the board's normal and the ray to either camera


def random_rig(rng: np.random.Generator, size_px: IntArray, field_m: float) -> StereoRig:
    """Return a stereo pair whose axes cross where either picture is about `field_m` wide.

    Half the left field of view 8 … 25°, the angle between the axes 10 … 35°, focal lengths of a pair within 5 %,
    principal points within 3 % of the width, distortion |k1| ≤ 0.15, |k2| ≤ 0.1, |p| ≤ 5·10⁻⁴, |k3| ≤ 0.05.
    """
    focal = float(size_px[0]) / 2 / np.tan(rng.uniform(np.radians(8), np.radians(25)))
    distance = field_m * focal / float(size_px[0])
    rotation = rotation_from_vector(np.array([0.0, rng.uniform(np.radians(10), np.radians(35)), 0.0]))
    rotation = rotation_from_vector(rng.uniform(-0.03, 0.03, 3)) @ rotation
    crossing = np.array([0.0, 0.0, distance])
    seen = np.array([0.0, 0.0, distance * rng.uniform(0.95, 1.05)]) + rng.uniform(-0.02, 0.02, 3) * field_m
    return StereoRig(
        _camera(rng, size_px, focal),
        _camera(rng, size_px, focal * rng.uniform(0.95, 1.05)),
        RigidTransform(rotation, seen - rotation @ crossing),
    )


def _camera(rng: np.random.Generator, size_px: IntArray, focal_px: float) -> Camera:
    """Return a camera of about this focal length."""
    centre = (size_px - 1) / 2 + rng.uniform(-0.03, 0.03, 2) * size_px[0]
    fy = focal_px * rng.uniform(0.998, 1.002)
    distortion = rng.uniform(-1, 1, 5) * [0.15, 0.1, 5e-4, 5e-4, 0.05]
    return Camera.from_parameters(np.array([focal_px, fy, *centre, *distortion]), size_px)


def random_poses(
    rng: np.random.Generator, rig: StereoRig, board: Board, count: int, max_tilt_rad: float = 0.6
) -> list[RigidTransform]:
    """Return `count` poses left_from_target of a board that both cameras see whole, tilted by up to `max_tilt_rad`.

    The tilt is that of the board's normal against the bisector of the two axes, about any axis in the plane; the board
    turns in its plane by up to 0.5 rad and lies anywhere between the cameras where it fits, in depth within 12 %. Of
    dots with ring markers only the markers and the dots around them have to be seen.
    """
    centre, facing, distance = _working_point(rig, board)
    lateral = 0.5 * distance * float(rig.left.size_px[0]) / rig.left.matrix[0, 0]
    poses: list[RigidTransform] = []
    for _ in range(_TRIES * count):
        turn = rotation_from_vector(np.array([0.0, 0.0, rng.uniform(-0.5, 0.5)]))
        rotation = facing @ rotation_from_vector(_tilt(rng, max_tilt_rad)) @ turn
        shift = rng.uniform(-1, 1, 3) * [lateral, lateral, 0.12 * distance]
        pose = RigidTransform(rotation, centre + shift - rotation @ _middle(board))
        if _seen(rig, pose, board):
            poses.append(pose)
        if len(poses) == count:
            return poses
    raise ValueError(
        f"board: expected one that fits into both pictures, found {len(poses)} poses in {_TRIES * count} tries"
    )


def _tilt(rng: np.random.Generator, max_tilt_rad: float) -> FloatArray:
    """Return a rotation vector in the board's plane, its length uniform up to the largest tilt."""
    direction, angle = rng.uniform(0, 2 * np.pi), rng.uniform(0, max_tilt_rad)
    return angle * np.array([np.cos(direction), np.sin(direction), 0.0])


def _working_point(rig: StereoRig, board: Board) -> tuple[FloatArray, FloatArray, float]:
    """Return where the axes meet, the rotation of a board that faces both cameras, and the distance from the left."""
    left_from_right = rig.right_from_left.inverse()
    axes = np.stack([[0.0, 0.0, 1.0], left_from_right.rotation[:, 2]])
    across = np.eye(3) - axes[:, :, None] * axes[:, None, :]
    centre = np.linalg.solve(across.sum(axis=0), across[1] @ left_from_right.translation_m)
    z = axes.sum(axis=0) / np.linalg.norm(axes.sum(axis=0))
    x = np.cross([0.0, 1.0, 0.0], z)
    x /= np.linalg.norm(x)
    facing = np.column_stack([x, np.cross(z, x), z])
    if board.rings is not None:
        facing = facing * [1.0, -1.0, -1.0]
    return centre, facing, float(centre[2])


def _required(board: Board) -> FloatArray:
    """Return the points (N, 3) in the target's frame that a picture has to show."""
    if board.rings is not None:
        x, y = board.rings
        corners = np.array([[-1.0, -1.0], [x + 1, -1], [x + 1, y + 1], [-1, y + 1]])
    else:
        x0, x1, y0, y1 = board.extent_m / board.target.spacing_m
        inset = board.margin - 0.25
        corners = np.array([[x0, y0], [x1, y0], [x1, y1], [x0, y1]]) + inset * np.array(
            [[1.0, 1.0], [-1, 1], [-1, -1], [1, -1]]
        )
    return np.column_stack([corners, np.zeros(4)]) * board.target.spacing_m


def _middle(board: Board) -> FloatArray:
    """Return the middle (3,) of what has to be seen."""
    return np.asarray(_required(board).mean(axis=0))


def _seen(rig: StereoRig, pose: RigidTransform, board: Board) -> bool:
    """Return whether both cameras see the board whole and not too steeply."""
    points = pose.apply(_required(board))
    for camera, camera_from_left in ((rig.left, RigidTransform.identity()), (rig.right, rig.right_from_left)):
        pixels = camera.project(camera_from_left.apply(points))
        if not ((pixels > 4) & (pixels < camera.size_px - 5)).all():
            return False
        rays = points + camera_from_left.rotation.T @ camera_from_left.translation_m
        cosine = rays @ pose.rotation[:, 2] / np.linalg.norm(rays, axis=1)
        if not (np.abs(cosine) > np.cos(_STEEPEST_RAD)).all():
            return False
    return True
