"""MATLAB: stereoParameters as JSON, and Bouguet's calibration toolbox as text."""

from __future__ import annotations

import json
import re
from typing import Any

import numpy as np

from photogram._checks import FloatArray
from photogram.calibration_import.build import Found, LengthUnit, numbers
from photogram.calibration_import.lens import Lens
from photogram.rigid import rotation_from_vector, skew

MATLAB, BOUGUET = "MATLAB", "Bouguet's toolbox"
_UNITS: dict[str, LengthUnit] = {"mm": "mm", "millimeters": "mm", "millimetres": "mm", "m": "m", "meters": "m"}
_ESSENTIAL = 1e-3  # relative departure of an essential matrix from that of R and T above which they contradict
_ASSIGNMENT = re.compile(r"\b([A-Za-z]\w*)\s*=\s*(?:\[([^\]]*)\]|([-+]?[\d.][\w.+-]*))")


def read_matlab(text: str) -> Found:
    """Return what jsonencode(toStruct(stereoParams)), or jsonencode(stereoParams), wrote.

    Pixels count from 1 there, so that 1 is taken off the principal point (MathWorks, `stereoParametersToOpenCV`).
    `K` is the camera matrix and `PoseCamera2` has x₂ = R·x₁ + T; the older `IntrinsicMatrix` and `RotationOfCamera2`
    are the transposed ones, x₂ᵀ = x₁ᵀ·R + T. An `EssentialMatrix` in the file must agree with R and T.
    """
    content = json.loads(text)
    cameras = [_object(content, f"CameraParameters{number}") for number in (1, 2)]
    lenses = [_lens(f"CameraParameters{number}", camera) for number, camera in enumerate(cameras, start=1)]
    sizes = [_size(f"CameraParameters{number}", camera) for number, camera in enumerate(cameras, start=1)]
    rotation, translation = _extrinsics(content)
    _check_essential(content, rotation, translation)
    unit = _UNITS.get(str(content.get("WorldUnits", cameras[0].get("WorldUnits", ""))).lower())
    return Found(MATLAB, (lenses[0], lenses[1]), (sizes[0], sizes[1]), rotation, translation, unit)


def read_bouguet(text: str) -> Found:
    """Return what Bouguet's stereo calibration prints or saves as assignments: fc_left = [ … ], …, om, T.

    x_right = R(om)·x_left + T in mm; kc: k1 k2 p1 p2 k3; skew alpha_c·fc(1); the toolbox counts pixels from 0, as it
    takes 1 off every corner (`click_ima_calib.m`). `nx`, `ny`: image size, where they are given.
    """
    uncommented = re.sub(r"^\s*%.*$", "", text, flags=re.MULTILINE)
    values: dict[str, str] = {}
    for name, inside, scalar in _ASSIGNMENT.findall(uncommented):
        values.setdefault(name, inside or scalar)

    def array(name: str, count: int) -> FloatArray:
        if name not in values:
            raise ValueError(f"{name}: missing")
        return numbers(name, re.findall(r"[^\s,;]+", values[name]), count)

    lenses = []
    for side in ("left", "right"):
        focal, centre, kc = array(f"fc_{side}", 2), array(f"cc_{side}", 2), array(f"kc_{side}", 5)
        alpha = float(array(f"alpha_c_{side}", 1)[0]) if f"alpha_c_{side}" in values else 0.0
        lenses.append(Lens(focal, centre, kc[[0, 1, 4]], kc[2:4], skew_px=alpha * float(focal[0])))
    rotation = array("R", 9).reshape(3, 3) if "om" not in values else rotation_from_vector(array("om", 3))
    size = (int(array("nx", 1)[0]), int(array("ny", 1)[0])) if {"nx", "ny"} <= set(values) else None
    return Found(BOUGUET, (lenses[0], lenses[1]), (size, size), rotation, array("T", 3), "mm")


def _object(content: Any, name: str) -> dict[str, Any]:
    """Return an object within the content."""
    found = content.get(name)
    if not isinstance(found, dict):
        raise ValueError(f"{name}: expected an object, found {str(found)[:40]!r}")
    return found


def _lens(name: str, camera: dict[str, Any]) -> Lens:
    """Return one camera's lens, its principal point counted from 0."""
    inner = camera.get("Intrinsics") if isinstance(camera.get("Intrinsics"), dict) else camera
    parameters = {**camera, **inner} if inner is not None else camera
    if parameters.get("K") is not None:
        k = numbers(f"{name}.K", parameters["K"], (3, 3))
    elif parameters.get("IntrinsicMatrix") is not None:
        k = numbers(f"{name}.IntrinsicMatrix", parameters["IntrinsicMatrix"], (3, 3)).T
    else:
        raise ValueError(f"{name}: expected K or IntrinsicMatrix, found neither")
    if k[1, 0] != 0 or not np.array_equal(k[2], [0, 0, 1]):
        raise ValueError(f"{name}: expected a camera matrix, found {k.tolist()}")
    radial = np.zeros(3)
    coefficients = np.atleast_1d(np.asarray(parameters.get("RadialDistortion", [0, 0])))
    if coefficients.size not in (2, 3):
        raise ValueError(f"{name}.RadialDistortion: expected 2 or 3 numbers, found {coefficients.size}")
    radial[: coefficients.size] = numbers(f"{name}.RadialDistortion", coefficients, coefficients.size)
    tangential = numbers(f"{name}.TangentialDistortion", parameters.get("TangentialDistortion", [0, 0]), 2)
    return Lens(np.array([k[0, 0], k[1, 1]]), k[:2, 2] - 1.0, radial, tangential, skew_px=float(k[0, 1]))


def _size(name: str, camera: dict[str, Any]) -> tuple[int, int] | None:
    """Return width and height of a camera's pictures, which MATLAB keeps as rows and columns."""
    inner = camera.get("Intrinsics")
    given = camera.get("ImageSize") or (inner.get("ImageSize") if isinstance(inner, dict) else None)
    if not given:
        return None
    rows, columns = numbers(f"{name}.ImageSize", given, 2)
    return int(columns), int(rows)


def _extrinsics(content: dict[str, Any]) -> tuple[FloatArray, FloatArray]:
    """Return R and T of x₂ = R·x₁ + T."""
    pose = content.get("PoseCamera2")
    if isinstance(pose, dict):
        if pose.get("A") is not None:
            matrix = numbers("PoseCamera2.A", pose["A"], (4, 4))
            return matrix[:3, :3], matrix[:3, 3]
        rotation = numbers("PoseCamera2.R", pose.get("R"), (3, 3))
        return rotation, numbers("PoseCamera2.Translation", pose.get("Translation"), 3)
    if content.get("RotationOfCamera2") is None:
        raise ValueError("expected PoseCamera2, or RotationOfCamera2 and TranslationOfCamera2, found neither")
    rotation = numbers("RotationOfCamera2", content["RotationOfCamera2"], (3, 3)).T
    return rotation, numbers("TranslationOfCamera2", content.get("TranslationOfCamera2"), 3)


def _check_essential(content: dict[str, Any], rotation: FloatArray, translation: FloatArray) -> None:
    """Raise `ValueError` where the file's essential matrix is not [T]ₓ·R up to a factor."""
    if content.get("EssentialMatrix") is None:
        return
    found = numbers("EssentialMatrix", content["EssentialMatrix"], 9)
    expected = (skew(translation) @ rotation).ravel()
    share = abs(found @ expected) / (np.linalg.norm(found) * np.linalg.norm(expected))
    if not 1.0 - share < _ESSENTIAL**2:
        raise ValueError("EssentialMatrix: expected the one of the file's rotation and translation, found another")
