"""Camera images whose pixels move with the body at every line.

The displacement of the body (fused, rigid) moves the plane of the tracked points, which the camera sees. Pixels beside
the tracked points stay. templates/moving.js draws the image magnified, in the phase of the scene (`report_scene`).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import cv2
import numpy as np
from jinja2.utils import htmlsafe_json_dumps
from markupsafe import Markup

from fusion.phasors.stereo_motion import read_rig, sensor_from_camera
from fusion.phasors.stereo_phasors import StereoResult
from fusion.recording.rig import Stereo
from fusion.report.page_images import jpeg_source, neighbour_distance, reduced_image
from photogram.camera import Camera
from photogram.geometry import RigidTransform, displacement_jacobian
from shakercal._common.arrays import ComplexArray, FloatArray

COLUMNS = 24  # cells of the mesh that bends an image
SHOWN_SHARE = 0.025  # of the width: largest displacement at the first magnification
STEP_M = 1e-6  # of the difference quotient of the projection


class MovingImage(NamedTuple):
    """An image of a page with its mesh; `json` is safe within a page."""

    name: str
    body: str
    width: int
    height: int
    source: str
    json: Markup


def moving_images(
    pairs: Sequence[StereoResult], stated: Mapping[str, Stereo], displaced: Mapping[str, ComplexArray]
) -> list[MovingImage]:
    """Return the first left image of every pair whose body moves, the load first.

    `stated`: pairs by name. `displaced`: phasors (K, 6) of the displacement by body.
    """
    found = [
        _moving_image(item, stated[item.name], displaced[item.body])
        for item in pairs
        if item.name in stated and item.body in displaced and item.reference_image is not None
    ]
    return sorted(found, key=lambda image: image.body != "load")


def _moving_image(item: StereoResult, stated: Stereo, moved: ComplexArray) -> MovingImage:
    """Return an image and the displacement of its mesh.

    `moved` (K, 6): phasors of the body.
    """
    camera, pose = read_rig(stated, ()).camera_poses[0][0], sensor_from_camera(stated)
    height, width = np.asarray(item.reference_image).shape
    small, scale = reduced_image(np.asarray(item.reference_image))
    nodes = _nodes(width, height)
    share = _share(nodes, np.asarray(item.subsets_px, dtype=np.float64))
    flow = share[None, :, None] * _image_phasors(item, camera, pose, moved, nodes)
    largest = np.abs(flow).max(initial=0.0, axis=(1, 2))
    data = {
        "columns": COLUMNS,
        "at": np.round(scale * nodes, 1).ravel().tolist(),
        "flow": [
            [float(f"{x:.3g}") for x in np.stack([line.real, line.imag], axis=-1).ravel()] for line in scale * flow
        ],
        "size": [float(f"{SHOWN_SHARE * width / most:.2g}") if most > 0.0 else 0.0 for most in largest],
    }
    size = small.shape[1], small.shape[0]
    return MovingImage(
        item.name, item.body, *size, jpeg_source(small), htmlsafe_json_dumps(data, separators=(",", ":"))
    )


def _nodes(width: int, height: int) -> FloatArray:
    """Return the nodes (N, 2) of the mesh, row by row."""
    rows = max(2, round(COLUMNS * height / width))
    x, y = np.linspace(-0.5, width - 0.5, COLUMNS + 1), np.linspace(-0.5, height - 0.5, rows + 1)
    return np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2)


def _share(nodes: FloatArray, subsets_px: FloatArray) -> FloatArray:
    """Return the share (N,) of the body's motion: 1 at the tracked points, 0 elsewhere."""
    hull = cv2.convexHull(subsets_px.astype(np.float32))
    reach = 1.5 * neighbour_distance(subsets_px, 1.0)
    inside = np.array([cv2.pointPolygonTest(hull, (float(x), float(y)), True) for x, y in nodes])
    return np.clip(2.0 + inside / max(reach, 1e-9), 0.0, 1.0)


def _image_phasors(
    item: StereoResult, camera: Camera, pose: RigidTransform, moved: ComplexArray, nodes: FloatArray
) -> ComplexArray:
    """Return phasors (K, N, 2) of the nodes in pixels.

    The nodes are in the plane of the tracked points.
    """
    from_sensor = pose.inverse()
    seen = from_sensor.apply(_points(item))
    middle = seen.mean(axis=0)
    normal = np.linalg.svd(seen - middle, full_matrices=False)[2][2]
    rays = np.column_stack([camera.undistort(nodes), np.ones(len(nodes))])
    points = rays * ((middle @ normal) / (rays @ normal))[:, None]
    slope = np.stack(
        [
            (camera.project(points + step) - camera.project(points - step)) / (2.0 * STEP_M)
            for step in STEP_M * np.eye(3)
        ],
        axis=-1,
    )
    by_motion = slope @ from_sensor.rotation @ displacement_jacobian(pose.apply(points))
    return np.asarray(np.nan_to_num(np.einsum("npm,km->knp", by_motion, moved)))


def _points(item: StereoResult) -> FloatArray:
    """Return the tracked points (N, 3) at rest in the sensor frame."""
    reference = (
        item.deflection.reference_m if item.deflection is not None else next(iter(item.surface or ())).reference_m
    )
    return np.asarray(reference[np.isfinite(reference).all(axis=1)])
