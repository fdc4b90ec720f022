"""Export of calibrations: OpenCV's YAML, VIC-3D's XML, MATLAB's JSON."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from photogram.calibration.calibration_file import write_whole
from photogram.calibration.exchange.exchange_notices import COVARIANCE_NOT_EXPORTED, SKEW_IGNORED
from photogram.calibration.exchange.lens import (
    RADIAL,
    SIDES,
    TURN,
    NearestCamera,
    approximation_notice,
    fit_camera,
    pixel_grid,
)
from photogram.camera import CAMERA_PARAMETERS, Camera, StereoRig
from photogram.geometry import RigidTransform, rotation_from_vector
from shakercal._common.arrays import FloatArray
from shakercal._common.notices import Notice

_FURTHER = ("p1", "p2", "k4", "k5", "k6")
_MATRIX = ("fx", "fy", "cx", "cy", "skew")


def opencv_yaml(rig: StereoRig) -> tuple[str, list[Notice]]:
    """Return an OpenCV FileStorage text and notices.

    It has M1 D1 M2 D2 R T, x₂ = R·x₁ + T in m, with all digits. D has five coefficients, or eight if k4 k5 k6 are not
    zero. OpenCV's functions ignore skew.
    """
    import cv2

    storage = cv2.FileStorage(".yml", cv2.FILE_STORAGE_WRITE | cv2.FILE_STORAGE_MEMORY)
    equal_sizes = np.array_equal(rig.left.size_px, rig.right.size_px)
    for number, camera in enumerate((rig.left, rig.right), start=1):
        for name, length in zip(("image_width", "image_height"), camera.size_px, strict=True):
            if not equal_sizes or number == 1:
                storage.write(name if equal_sizes else f"{name}{number}", int(length))
    storage.write("length_unit", "m")
    for number, camera in enumerate((rig.left, rig.right), start=1):
        storage.write(f"M{number}", camera.matrix)
        storage.write(f"D{number}", camera.distortion[: 8 if camera.distortion[5:].any() else 5].reshape(1, -1))
    storage.write("R", rig.right_from_left.rotation)
    storage.write("T", rig.right_from_left.translation_m.reshape(3, 1))
    skews = [
        Notice(SKEW_IGNORED, f"{side} camera", skew_px=camera.matrix[0, 1])
        for side, camera in zip(SIDES, (rig.left, rig.right), strict=True)
        if camera.matrix[0, 1] != 0
    ]
    return storage.releaseAndGetString(), skews


def vic3d_xml(rig: StereoRig) -> tuple[str, list[Notice]]:
    """Return a project text of VIC-3D, lengths in mm, and notices.

    VIC-3D has only k1 k2 k3 and skew. Tangential distortion and k4 k5 k6 are approximated by least squares over the
    image with the available parameters and rotations of the two cameras' frames. The world is the rotated left camera's
    frame.
    """
    if not np.array_equal(rig.left.size_px, rig.right.size_px):
        found = " and ".join("x".join(map(str, camera.size_px)) for camera in (rig.left, rig.right))
        raise ValueError(f"image_size: expected images of one size, as in VIC-3D's projects, found {found}")
    notices: list[Notice] = []
    free = (*_MATRIX, *RADIAL, *TURN)
    left, right = (
        _without(camera, side, _FURTHER, free, notices)
        for side, camera in zip(SIDES, (rig.left, rig.right), strict=True)
    )
    first, second = (RigidTransform(rotation_from_vector(near.turn), np.zeros(3)) for near in (left, right))
    lines = ['<?xml version="1.0" encoding="ISO-8859-1"?>', "<!DOCTYPE vpml>", "<project>", " <calibration>"]
    for index, (near, pose) in enumerate(((left, first), (right, second @ rig.right_from_left))):
        named = dict(zip(CAMERA_PARAMETERS, near.camera.parameters.tolist(), strict=True))
        inner = " ".join(repr(named[name]) for name in ("cx", "cy", "fx", "fy", "skew", *RADIAL))
        outer = " ".join(map(repr, [*_cardan_deg(pose.rotation).tolist(), *(1e3 * pose.translation_m).tolist()]))
        lines.append(f'  <camera id="{index}">{inner}<orientation>{outer}</orientation></camera>')
    width, height = rig.left.size_px
    lines += [" </calibration>", f' <polygonmask width="{width}" height="{height}"/>', "</project>", ""]
    return "\n".join(lines), notices


def matlab_json(rig: StereoRig) -> tuple[str, list[Notice]]:
    """Return jsonencode(toStruct(stereoParams)) of a pair, lengths in mm, and notices.

    MATLAB counts pixels from 1, and has k1 k2 k3 p1 p2 and skew; k4 k5 k6 are approximated by these, see `vic3d_xml`.
    """
    notices: list[Notice] = []
    content: dict[str, object] = {}
    free = (*_MATRIX, *RADIAL)
    for number, (side, camera) in enumerate(zip(SIDES, (rig.left, rig.right), strict=True), start=1):
        near = _without(camera, side, _FURTHER[2:], free, notices).camera
        k1, k2, p1, p2, k3 = near.distortion[:5].tolist()
        content[f"CameraParameters{number}"] = {
            "K": (near.matrix + np.array([[0, 0, 1], [0, 0, 1], [0, 0, 0]])).tolist(),
            "RadialDistortion": [k1, k2, k3],
            "TangentialDistortion": [p1, p2],
            "ImageSize": camera.size_px[::-1].tolist(),
            "WorldUnits": "millimeters",
        }
    pose = rig.right_from_left
    content["PoseCamera2"] = {
        "Dimensionality": 3,
        "R": pose.rotation.tolist(),
        "Translation": (1e3 * pose.translation_m).tolist(),
    }
    return json.dumps(content, indent=1, allow_nan=False) + "\n", notices


FORMATS = {
    ".yml": ("OpenCV", opencv_yaml),
    ".yaml": ("OpenCV", opencv_yaml),
    ".xml": ("VIC-3D", vic3d_xml),
    ".json": ("MATLAB", matlab_json),
}
"""Program and writer of each file suffix."""


def export_calibration(path: str | Path, rig: StereoRig) -> tuple[str, tuple[Notice, ...]]:
    """Write a stereo pair for another program, chosen by the suffix.

    Parameters
    ----------
    path
        File to write; `.yml`, `.yaml`: OpenCV, `.xml`: VIC-3D, `.json`: MATLAB.
    rig
        Stereo pair.

    Returns
    -------
    The program's name and notices.

    Raises
    ------
    ValueError : Unknown suffix, or the program's camera model cannot describe the pair.

    Examples
    --------
    >>> from tempfile import TemporaryDirectory
    >>> camera = Camera.from_parameters(np.array([1000.0, 1000, 320, 240, 0, 0, 0, 0, 0]), np.array([640, 480]))
    >>> rig = StereoRig(camera, camera, RigidTransform(np.eye(3), np.array([-0.1, 0.0, 0.0])))
    >>> with TemporaryDirectory() as folder:
    ...     export_calibration(f"{folder}/rig.xml", rig)[0]
    'VIC-3D'
    """
    path = Path(path)
    if path.suffix.lower() not in FORMATS:
        raise ValueError(
            f"{path}: expected a name that ends in {', '.join(FORMATS)}, found {path.suffix or 'no suffix'}"
        )
    program, write = FORMATS[path.suffix.lower()]
    text, notices = write(rig)
    if rig.covariance is not None:
        notices.append(Notice(COVARIANCE_NOT_EXPORTED, "covariance", program=program))
    write_whole(path, text)
    return program, tuple(notices)


def _without(
    camera: Camera, side: str, missing: Sequence[str], free: Sequence[str], notices: list[Notice]
) -> NearestCamera:
    """Return the nearest camera with the parameters `missing` zero, and add a notice."""
    start = camera.parameters
    indices = [CAMERA_PARAMETERS.index(name) for name in missing]
    if not start[indices].any():
        return NearestCamera(camera, np.zeros(3), 0.0)
    found = ", ".join(
        f"{name} = {start[index]:.3g}" for name, index in zip(missing, indices, strict=True) if start[index]
    )
    pixel = pixel_grid(camera.size_px)
    start[indices] = 0.0
    near = fit_camera(pixel, camera.undistort(pixel), start, free, camera.size_px)
    notices.append(approximation_notice(f"{side} camera", found, near))
    return near


def _cardan_deg(rotation: FloatArray) -> FloatArray:
    """Return α, β, γ (3,) in degrees of R = R_z(γ)·R_y(β)·R_x(α)."""
    from scipy.spatial.transform import Rotation

    return np.asarray(Rotation.from_matrix(rotation).as_euler("xyz", degrees=True))
