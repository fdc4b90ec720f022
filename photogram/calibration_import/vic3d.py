"""VIC-3D: the calibration in a project's XML, on its own or inside a .z3d file."""

from __future__ import annotations

from xml.etree import ElementTree

import numpy as np

from photogram._checks import FloatArray
from photogram.calibration_import.build import Found, numbers, right_from_left, rotation_from_cardan
from photogram.calibration_import.lens import Lens

FORMAT = "VIC-3D"
PROJECT = "project.xml"
"""The file inside a .z3d file that holds the calibration."""


def read_vic3d(root: ElementTree.Element) -> Found:
    """Return what a VIC-3D project or calibration holds.

    `camera`: cx cy fx fy s k1 k2 k3, as text or split into `intrinsics` and `distortion`, with u = fx·x_d + s·y_d + cx;
    `orientation`: α β γ (degrees) tx ty tz (mm) of x_camera = R_z(γ)·R_y(β)·R_x(α)·x_world + t (sdynpy,
    `camera_matrix_from_vic_parameters`; dicengine, `DICe_CameraSystem.cpp`). The distortion is not published; of the
    usual polynomials, 1 + k1·r² + k2·r⁴ + k3·r⁶ leaves the smallest epipolar residuals in a recording of the DIC
    challenge with its VIC-3D calibration (`tests/photogram/test_calibration_import_peers.py`).
    """
    cameras = {camera.get("id", ""): camera for camera in root.iter("camera")}
    if set(cameras) != {"0", "1"}:
        raise ValueError(f"camera: expected the ids 0 and 1, found {', '.join(sorted(cameras)) or 'none'}")
    lenses = [_lens(f"camera {key}", cameras[key]) for key in "01"]
    poses = [_pose(f"camera {key}", cameras[key]) for key in "01"]
    rotation, translation = right_from_left(poses[0], poses[1])
    size = _size(root)
    return Found(FORMAT, (lenses[0], lenses[1]), (size, size), rotation, translation, "mm")


def _lens(name: str, camera: ElementTree.Element) -> Lens:
    """Return the lens of one camera in either spelling."""
    intrinsics, distortion = camera.find("intrinsics"), camera.find("distortion")
    if intrinsics is None:
        words = (camera.text or "").split()
        inner, radial = words[:5], words[5:]
    else:
        inner = (intrinsics.text or "").split()
        radial = [] if distortion is None else (distortion.text or "").split()
    cx, cy, fx, fy, skew = numbers(f"{name}.intrinsics", inner, 5)
    coefficients = numbers(f"{name}.distortion", radial, len(radial))
    if coefficients[3:].any():
        raise ValueError(
            f"{name}.distortion: expected k1 k2 k3, found {coefficients[3:].tolist()} beside them, "
            "whose meaning is not published; calibrate with radial distortion alone"
        )
    padded = np.zeros(3)
    padded[: min(3, len(coefficients))] = coefficients[:3]
    return Lens(np.array([fx, fy]), np.array([cx, cy]), padded, np.zeros(2), skew_px=float(skew))


def _pose(name: str, camera: ElementTree.Element) -> tuple[FloatArray, FloatArray]:
    """Return rotation and translation (mm) of one camera."""
    orientation = camera.find("orientation")
    if orientation is None:
        raise ValueError(f"{name}.orientation: missing")
    values = numbers(f"{name}.orientation", (orientation.text or "").split(), 6)
    return rotation_from_cardan(values[:3]), values[3:]


def _size(root: ElementTree.Element) -> tuple[int, int] | None:
    """Return the size of the pictures, which stands at an area of interest where there is one."""
    for mask in root.iter("polygonmask"):
        if mask.get("width") and mask.get("height"):
            width, height = numbers("polygonmask", [mask.get("width"), mask.get("height")], 2)
            return int(width), int(height)
    return None
