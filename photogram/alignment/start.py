"""A first pose from the evidence, near enough for Gauss-Newton steps."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from photogram._checks import FloatArray
from photogram.alignment.evidence import Evidence, KnownFace, KnownPoints, KnownPoses
from photogram.rigid import RigidTransform, fit_rigid, fixes_rotation, nearest_rotation


def starting_pose(evidence: Sequence[Evidence]) -> RigidTransform | None:
    """Return a first `sensor_from_camera` from a known pose, three points or two faces; None without any of them.

    Directions and axes of motion are known up to their sense only and cannot start the search.
    """
    for item in evidence:
        if isinstance(item, KnownPoses):
            return item.sensor_from_body[0] @ item.left_from_body[0].inverse()
    points = [item for item in evidence if isinstance(item, KnownPoints)]
    faces = [item for item in evidence if isinstance(item, KnownFace)]
    found = _from_points(points)
    return _from_faces(faces) if found is None else found


def _from_points(points: Sequence[KnownPoints]) -> RigidTransform | None:
    """Return the rigid fit of all points, None where they leave the rotation open."""
    if sum(len(item.names) for item in points) < 3:
        return None
    camera = np.concatenate([item.camera_m for item in points])
    sensor = np.concatenate([item.sensor_m for item in points])
    try:
        return fit_rigid(camera, sensor)
    except ValueError:
        return None


def _from_faces(faces: Sequence[KnownFace]) -> RigidTransform | None:
    """Return the pose in which the fitted planes lie on the faces, as near as two or more normals decide."""
    flat = [(item, *fitted) for item in faces if (fitted := _plane(item.camera_m)) is not None]
    scatter = sum((np.outer(item.normal, normal) for item, _, normal in flat), start=np.zeros((3, 3)))
    if len(flat) < 2 or not fixes_rotation(scatter):
        return None
    rotation = nearest_rotation(scatter)
    normals = np.array([item.normal for item, _, _ in flat])
    offset = np.array([item.normal @ (item.point_m - rotation @ centre) for item, centre, _ in flat])
    return RigidTransform(rotation, np.linalg.lstsq(normals, offset, rcond=1e-9)[0])


def _plane(points_m: FloatArray) -> tuple[FloatArray, FloatArray] | None:
    """Return centre and normal of the plane of points (N, 3), the normal towards the camera; None on a line."""
    if len(points_m) < 3:
        return None
    centre = points_m.mean(axis=0)
    _, singular, rows = np.linalg.svd(points_m - centre, full_matrices=False)
    if singular[1] < 1e-6 * max(singular[0], 1e-300):
        return None
    return centre, rows[2] if rows[2] @ centre < 0.0 else -rows[2]
