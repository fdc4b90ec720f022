"""DICe: camera systems in XML, and the text of 16 intrinsic and 6 or 12 extrinsic numbers before it."""

from __future__ import annotations

import re
from xml.etree import ElementTree

import numpy as np

from photogram._checks import FloatArray
from photogram.calibration_import.build import Found, numbers, right_from_left, rotation_from_cardan
from photogram.calibration_import.lens import EVEN, Lens
from photogram.notice import Notice

FORMAT = "DICe"
_SYSTEM_FILE = "dice_xml_camera_system_file"
_POWERS = {  # of r in the factor by which x and y are multiplied
    "OPENCV_LENS_DISTORTION": EVEN,
    "K1R1_K2R2_K3R3": (0, 1, 2),  # r + k1·r + k2·r² + k3·r³
    "K1R2_K2R4_K3R6": (1, 3, 5),
    "K1R3_K2R5_K3R7": EVEN,
    "VIC3D_LENS_DISTORTION": EVEN,  # the numbers are VIC-3D's own
}
_LINEAR = "K1R1_K2R2_K3R3"
_NONE = "NO_LENS_DISTORTION"
_BEYOND = ("K4", "K5", "K6", "S1", "S2", "S3", "S4", "T1", "T2")
_TEXT_ORDER = "cx cy fx fy fs k1 k2 k3 of either camera, alpha beta gamma or R11…R33, tx ty tz, [height width]"


def read_dice_xml(root: ElementTree.Element) -> Found:
    """Return what a DICe camera system file holds (`DICe_Camera.cpp`, `DICe_CameraSystem.cpp` of dicengine).

    Either camera has x_camera = R·x_world + t, or, with `extrinsics_relative_camera_to_camera`, the second one
    x₁ = R·x₀ + t. Angles ALPHA BETA GAMMA in degrees, R = R_z·R_y·R_x. Lengths in the unit of the target's spacing, mm
    by the program's habit.
    """
    system = _parameters(root)
    kind = system.get("XML_FILE_FORMAT", "")
    if kind.lower() != _SYSTEM_FILE:
        raise ValueError(f"xml_file_format: expected DICe_xml_camera_system_file, found {kind or 'none'}")
    lists = {part.get("name", "").upper(): part for part in root.findall("parameterlist")}
    cameras = sorted(name for name in lists if name.startswith("CAMERA "))
    if cameras != ["CAMERA 0", "CAMERA 1"]:
        raise ValueError(f"CAMERA: expected CAMERA 0 and CAMERA 1, found {', '.join(cameras) or 'none'}")
    first, second = (_camera(name, lists[name]) for name in cameras)
    rotation, translation = second[2], second[3]
    if system.get("EXTRINSICS_RELATIVE_CAMERA_TO_CAMERA", "false").lower() != "true":
        rotation, translation = right_from_left((first[2], first[3]), (second[2], second[3]))
    notices = _linear_notice(first[0], second[0])
    return Found(FORMAT, (first[0], second[0]), (first[1], second[1]), rotation, translation, "mm", notices)


def read_dice_text(text: str) -> Found:
    """Return what DICe's former text holds: one number a line, comments after #.

    Order: cx cy fx fy fs k1 k2 k3 of either camera, then α β γ (degrees) or R by rows, tx ty tz of x₁ = R·x₀ + t, then
    height and width where they are given. The program's readers differ in what they do with k1 k2 k3; they are taken as
    what its own calibration (OpenCV's) and VIC-3D, from where such lists are copied, write: 1 + k1·r² + k2·r⁴ + k3·r⁶.
    """
    lines = [line.split("#", 1)[0].strip() for line in text.splitlines()]
    words = [line for line in lines if line]
    extrinsic, has_size = {22: (6, False), 24: (6, True), 28: (12, False), 30: (12, True)}.get(len(words), (0, False))
    if not extrinsic:
        raise ValueError(f"expected 22, 24, 28 or 30 numbers, one a line ({_TEXT_ORDER}), found {len(words)}")
    values = numbers("content", words, len(words))
    outer = values[16 : 16 + extrinsic]
    rotation = rotation_from_cardan(outer[:3]) if extrinsic == 6 else outer[:9].reshape(3, 3)
    size = (int(values[-1]), int(values[-2])) if has_size else None
    lenses = tuple(
        Lens(each[2:4], each[:2], each[5:8], np.zeros(2), skew_px=float(each[4])) for each in (values[:8], values[8:16])
    )
    return Found(FORMAT, (lenses[0], lenses[1]), (size, size), rotation, outer[-3:], "mm", _text_notices(values))


def _linear_notice(*lenses: Lens) -> tuple[Notice, ...]:
    """A warning where a distortion grows with r itself, which is a change of the focal length and seldom meant."""
    if not any(lens.exponents == _POWERS[_LINEAR] and lens.radial.any() for lens in lenses):
        return ()
    text = (
        f"the lenses are taken as {_LINEAR}, as the file says; DICe writes this also for files that it converted from "
        "its former text, whose numbers are OpenCV's or VIC-3D's: K1R3_K2R5_K3R7 would be right there"
    )
    return (Notice("warning", text, "distortion"),)


def _text_notices(values: FloatArray) -> tuple[Notice, ...]:
    """How the distortion of a text was read, where there is any."""
    if not values[[5, 6, 7, 13, 14, 15]].any():
        return ()
    text = "k1 k2 k3 are taken as the factor 1 + k1 r^2 + k2 r^4 + k3 r^6, r = 1 one focal length off the centre"
    return (Notice("info", text, "distortion"),)


def _parameters(element: ElementTree.Element) -> dict[str, str]:
    """Return the values of a list's own parameters by upper-case name."""
    return {part.get("name", "").upper(): part.get("value", "") for part in element.findall("parameter")}


def _camera(name: str, element: ElementTree.Element) -> tuple[Lens, tuple[int, int], FloatArray, FloatArray]:
    """Return lens, size, rotation and translation of one camera."""
    values = _parameters(element)

    def number(key: str) -> float:
        return float(numbers(f"{name}.{key}", values.get(key, "0"), 1)[0])

    for key in ("CX", "CY", "FX", "FY", "IMAGE_HEIGHT_WIDTH"):
        if key not in values:
            raise ValueError(f"{name}.{key}: missing")
    for key in _BEYOND:
        if number(key) != 0:
            raise ValueError(f"{name}.{key}: expected k1 k2 k3 p1 p2 alone, found {key} = {number(key):g}")
    model = values.get("LENS_DISTORTION_MODEL", _NONE).upper()
    if model != _NONE and model not in _POWERS:
        raise ValueError(f"{name}.LENS_DISTORTION_MODEL: expected {', '.join((_NONE, *_POWERS))}, found {model}")
    radial = np.array([number("K1"), number("K2"), number("K3")]) * (model != _NONE)
    tangential = np.array([number("P1"), number("P2")]) * (model == "OPENCV_LENS_DISTORTION")
    lens = Lens(
        np.array([number("FX"), number("FY")]),
        np.array([number("CX"), number("CY")]),
        radial,
        tangential,
        skew_px=number("FS"),
        exponents=_POWERS.get(model, EVEN),
    )
    height, width = _list(f"{name}.IMAGE_HEIGHT_WIDTH", values["IMAGE_HEIGHT_WIDTH"], 2)
    translation = np.array([number("TX"), number("TY"), number("TZ")])
    return lens, (int(width), int(height)), _rotation(name, element, values), translation


def _rotation(name: str, element: ElementTree.Element, values: dict[str, str]) -> FloatArray:
    """Return the rotation of one camera: matrix, angles, or none."""
    for part in element.findall("parameterlist"):
        if part.get("name", "").lower() == "rotation_3x3_matrix":
            rows = _parameters(part)
            return np.array([_list(f"{name}.ROW {i}", rows.get(f"ROW {i}", ""), 3) for i in range(3)])
    angles = [values.get(key, "0") for key in ("ALPHA", "BETA", "GAMMA")]
    return rotation_from_cardan(numbers(f"{name}.ALPHA, BETA, GAMMA", angles, 3))


def _list(where: str, text: str, count: int) -> FloatArray:
    """Return the numbers of a text like { 1, 2 }."""
    return numbers(where, re.findall(r"[^\s,{}]+", text), count)
