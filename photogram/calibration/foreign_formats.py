"""Calibration files of OpenCV, DICe, VIC-3D, MATLAB and Bouguet's toolbox, told apart by what they look like."""

from __future__ import annotations

import json
import re
import zipfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import numpy as np

from photogram.arrays import FloatArray, Notice
from photogram.calibration.foreign import (
    EVEN,
    SIDES,
    ImportedCalibration,
    LengthUnit,
    Lens,
    Stated,
    build,
    numbers,
    right_from_left,
    rotation_from_cardan,
)
from photogram.geometry import rotation_from_vector, skew


def parse_xml(content: bytes) -> ElementTree.Element:
    """Return the root of an XML text, all tags and attributes in lower case."""
    try:
        root = ElementTree.fromstring(content)
    except ElementTree.ParseError as error:
        raise ValueError(f"expected an XML text, found: {error}") from error
    for element in root.iter():
        element.tag = element.tag.lower()
        for name in list(element.attrib):
            element.attrib[name.lower()] = element.attrib.pop(name)
    return root


# OpenCV: FileStorage in YAML, XML or JSON, and plain JSON with the same content in lists.

_MATRICES = ("cameramatrix", "cammatrix", "intrinsicmatrix", "intrinsics", "camera", "matrix", "mtx", "cm", "m", "k")
_DISTORTIONS = ("distcoeffs", "distcoeff", "distortioncoefficients", "distortioncoeffs", "distortion", "dist", "d")
_SIDES = (("1", "2"), ("left", "right"), ("l", "r"), ("0", "1"))
_ROTATIONS = ("r", "rotation", "rotationmatrix", "rmat", "stereor", "rvec")
_TRANSLATIONS = ("t", "translation", "translationvector", "tvec", "stereot")
_SIZES = ("imagesize", "imgsize", "size", "resolution")
_WIDTHS, _HEIGHTS = ("imagewidth", "imgwidth", "width", "w"), ("imageheight", "imgheight", "height", "h")
_BEYOND = ("k4", "k5", "k6", "s1", "s2", "s3", "s4", "tauX", "tauY")
_LENGTHS = (4, 5, 8, 12, 14)

Values = dict[str, tuple[str, Any]]
"""Values of a file by simplified name, each with the name as it stands there."""


def read_opencv(text: str, extrinsics: str | None = None) -> Stated:
    """Return what an OpenCV file holds: matrices and distortions of two cameras, R and T with x₂ = R·x₁ + T.

    Names in any of the usual spellings (M1 D1 M2 D2 R T, cameraMatrix1 distCoeffs1, K_left, mtxL, left: {…}); a
    rotation vector is accepted for R. Distortion in OpenCV's order k1 k2 p1 p2 k3; later coefficients must be zero.
    """
    values = _values(text)
    if extrinsics is not None:
        values |= _values(extrinsics)
    matrices, distortions = _pair(values, _MATRICES, "M1 and M2"), _pair(values, _DISTORTIONS, "D1 and D2")
    left, right = (_lens(matrix, distortion) for matrix, distortion in zip(matrices, distortions, strict=True))
    size = _size(values)
    name, value = _one(values, _ROTATIONS, "rotation R")
    is_vector = np.size(np.asarray(value, dtype=object)) == 3
    rotation = rotation_from_vector(numbers(name, value, 3)) if is_vector else numbers(name, value, (3, 3))
    translation = numbers(*_one(values, _TRANSLATIONS, "translation T"), 3)
    return Stated("OpenCV", (left, right), (size, size), rotation, translation, None)


def _values(text: str) -> Values:
    """Return every value of a text."""
    content = _json(text) if text.lstrip().startswith(("{", "[")) else _storage(text)
    return {re.sub(r"[^a-z0-9]", "", name.lower()): (name, value) for name, value in _flat("", content)}


def _json(text: str) -> Any:
    """Return the content of a JSON text."""
    try:
        return json.loads(text)
    except ValueError as error:
        raise ValueError(f"expected a JSON text, found: {error}") from error


def _flat(prefix: str, content: Any) -> Iterator[tuple[str, Any]]:
    """Yield name and value of everything, the names of objects within objects joined by points."""
    if not isinstance(content, dict):
        yield prefix, content
    elif "data" in content and ("rows" in content or "sizes" in content):  # a matrix; a vector of OpenCV 5
        yield prefix, content["data"]
    else:
        for name, value in content.items():
            yield from _flat(f"{prefix}.{name}" if prefix else name, value)


def _storage(text: str) -> Any:
    """Return the content of a FileStorage text as nested objects."""
    import cv2

    level = cv2.utils.logging.getLogLevel()
    cv2.utils.logging.setLogLevel(cv2.utils.logging.LOG_LEVEL_SILENT)
    try:
        storage = cv2.FileStorage(text, cv2.FILE_STORAGE_READ | cv2.FILE_STORAGE_MEMORY)  # its nodes live as long
        return _node(storage.root())
    except (SystemError, cv2.error) as error:
        raise ValueError("expected an OpenCV FileStorage text, found one that OpenCV cannot parse") from error
    finally:
        cv2.utils.logging.setLogLevel(level)


def _node(node: Any) -> Any:
    """Return a node of a FileStorage as number, text, list, or object of such."""
    if node.isMap():
        names = node.keys()
        return {name: _node(node.getNode(name)) for name in names}
    if node.isSeq():
        return [_node(node.at(index)) for index in range(node.size())]
    return node.string() if node.isString() else node.real()


def _pair(values: Values, names: tuple[str, ...], what: str) -> tuple[tuple[str, Any], tuple[str, Any]]:
    """Return the values of the left and the right camera; `ValueError` where there are none, or those of one only."""
    for first, second in _SIDES:
        for name in names:
            for left, right in ((name + first, name + second), (first + name, second + name)):
                if left in values and right in values:
                    return values[left], values[right]
    single = [values[name][0] for name in names if name in values]
    if single:
        raise ValueError(f"{single[0]}: expected two cameras ({what}), found the calibration of a single one")
    raise ValueError(f"expected {what}, or the same under another usual name, found neither")


def _one(values: Values, names: tuple[str, ...], what: str) -> tuple[str, Any]:
    """Return the first value under any of the names."""
    for name in names:
        if name in values:
            return values[name]
    raise ValueError(f"expected the {what} from the first to the second camera, found none: is it in a second file?")


def _lens(matrix: tuple[str, Any], distortion: tuple[str, Any]) -> Lens:
    """Return one camera's lens."""
    name, value = matrix
    k = numbers(name, value, (3, 3))
    if k[0, 1] != 0 or k[1, 0] != 0 or not np.array_equal(k[2], [0, 0, 1]):
        raise ValueError(f"{name}: expected [[fx, 0, cx], [0, fy, cy], [0, 0, 1]], found {k.tolist()}")
    name, value = distortion
    length = np.size(np.asarray(value, dtype=object))
    if length not in _LENGTHS:
        raise ValueError(f"{name}: expected {', '.join(map(str, _LENGTHS))} coefficients, found {length}")
    coefficients = numbers(name, value, length)
    for label, coefficient in zip(_BEYOND, coefficients[5:], strict=False):
        if coefficient != 0:
            raise ValueError(
                f"{name}: expected the distortion k1 k2 p1 p2 k3, found {label} = {coefficient:g} of a larger model; "
                "calibrate without it"
            )
    k1, k2, p1, p2, k3 = (*coefficients[:5], 0.0)[:5]
    return Lens(np.array([k[0, 0], k[1, 1]]), k[:2, 2].copy(), np.array([k1, k2, k3]), np.array([p1, p2]))


def _size(values: Values) -> tuple[int, int] | None:
    """Return width and height where the file holds them."""
    for name in _SIZES:
        if name in values:
            width, height = numbers(*values[name], 2)
            return int(width), int(height)
    sides = [next((values[name] for name in names if name in values), None) for names in (_WIDTHS, _HEIGHTS)]
    whole = [int(numbers(*side, 1)[0]) for side in sides if side is not None]
    return (whole[0], whole[1]) if len(whole) == 2 else None


# DICe: camera systems in XML, and the text of 16 intrinsic and 6 or 12 extrinsic numbers before it.

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
_DICE_BEYOND = ("K4", "K5", "K6", "S1", "S2", "S3", "S4", "T1", "T2")
_TEXT_ORDER = "cx cy fx fy fs k1 k2 k3 of either camera, alpha beta gamma or R11…R33, tx ty tz, [height width]"


def read_dice_xml(root: ElementTree.Element) -> Stated:
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
        rotation, translation = right_from_left(first[2:], second[2:])
    lenses, notices = (first[0], second[0]), list[Notice]()
    if any(lens.exponents == _POWERS[_LINEAR] and lens.radial.any() for lens in lenses):
        text = (
            f"the lenses are taken as {_LINEAR}, as the file says; DICe writes this also for files that it converted "
            "from its former text, whose numbers are OpenCV's or VIC-3D's: K1R3_K2R5_K3R7 would be right there"
        )
        notices.append(Notice("warning", text, "distortion"))  # r itself: a change of focal length, seldom meant
    return Stated("DICe", lenses, (first[1], second[1]), rotation, translation, "mm", tuple(notices))


def read_dice_text(text: str) -> Stated:
    """Return what DICe's former text holds: one number a line, comments after #.

    Order: cx cy fx fy fs k1 k2 k3 of either camera, then α β γ (degrees) or R by rows, tx ty tz of x₁ = R·x₀ + t, then
    height and width where they are given. The program's readers differ in what they do with k1 k2 k3; they are taken as
    what its own calibration (OpenCV's) and VIC-3D, from where such lists are copied, write: 1 + k1·r² + k2·r⁴ + k3·r⁶.
    """
    words = [word for line in text.splitlines() if (word := line.split("#", 1)[0].strip())]
    extrinsic, has_size = {22: (6, False), 24: (6, True), 28: (12, False), 30: (12, True)}.get(len(words), (0, False))
    if not extrinsic:
        raise ValueError(f"expected 22, 24, 28 or 30 numbers, one a line ({_TEXT_ORDER}), found {len(words)}")
    values = numbers("content", words, len(words))
    outer = values[16 : 16 + extrinsic]
    rotation = rotation_from_cardan(outer[:3]) if extrinsic == 6 else outer[:9].reshape(3, 3)
    size = (int(values[-1]), int(values[-2])) if has_size else None
    left, right = (
        Lens(each[2:4], each[:2], each[5:8], np.zeros(2), skew_px=float(each[4])) for each in (values[:8], values[8:16])
    )
    notices: tuple[Notice, ...] = ()
    if values[[5, 6, 7, 13, 14, 15]].any():
        told = "k1 k2 k3 are taken as the factor 1 + k1 r^2 + k2 r^4 + k3 r^6, r = 1 one focal length off the centre"
        notices = (Notice("info", told, "distortion"),)
    return Stated("DICe", (left, right), (size, size), rotation, outer[-3:], "mm", notices)


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
    for key in _DICE_BEYOND:
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
    rotation = rotation_from_cardan(np.array([number("ALPHA"), number("BETA"), number("GAMMA")]))
    for part in element.findall("parameterlist"):
        if part.get("name", "").lower() == "rotation_3x3_matrix":
            rows = _parameters(part)
            rotation = np.array([_list(f"{name}.ROW {i}", rows.get(f"ROW {i}", ""), 3) for i in range(3)])
    return lens, (int(width), int(height)), rotation, np.array([number("TX"), number("TY"), number("TZ")])


def _list(where: str, text: str, count: int) -> FloatArray:
    """Return the numbers of a text like { 1, 2 }."""
    return numbers(where, re.findall(r"[^\s,{}]+", text), count)


# VIC-3D: the calibration in a project's XML, on its own or inside a .z3d file.

_PROJECT = "project.xml"  # the file inside a .z3d file that holds the calibration


def read_vic3d(root: ElementTree.Element) -> Stated:
    """Return what a VIC-3D project or calibration holds.

    `camera`: cx cy fx fy s k1 k2 k3, as text or split into `intrinsics` and `distortion`, with u = fx·x_d + s·y_d + cx;
    `orientation`: α β γ (degrees) tx ty tz (mm) of x_camera = R_z(γ)·R_y(β)·R_x(α)·x_world + t (sdynpy,
    `camera_matrix_from_vic_parameters`; dicengine, `DICe_CameraSystem.cpp`). The distortion is not published; of the
    usual polynomials, 1 + k1·r² + k2·r⁴ + k3·r⁶ leaves the smallest epipolar residuals in a recording of the DIC
    challenge with its VIC-3D calibration (`tests/photogram/test_calibration_import.py`).
    """
    cameras = {camera.get("id", ""): camera for camera in root.iter("camera")}
    if set(cameras) != {"0", "1"}:
        raise ValueError(f"camera: expected the ids 0 and 1, found {', '.join(sorted(cameras)) or 'none'}")
    (left, *left_pose), (right, *right_pose) = (_vic3d_camera(f"camera {key}", cameras[key]) for key in "01")
    rotation, translation = right_from_left(left_pose, right_pose)
    size = None  # of the pictures: it stands at an area of interest where there is one
    for mask in root.iter("polygonmask"):
        if size is None and mask.get("width") and mask.get("height"):
            width, height = numbers("polygonmask", [mask.get("width"), mask.get("height")], 2)
            size = int(width), int(height)
    return Stated("VIC-3D", (left, right), (size, size), rotation, translation, "mm")


def _vic3d_camera(name: str, camera: ElementTree.Element) -> tuple[Lens, FloatArray, FloatArray]:
    """Return lens, in either spelling, rotation and translation (mm) of one camera."""
    intrinsics, distortion, orientation = (camera.find(tag) for tag in ("intrinsics", "distortion", "orientation"))
    words = (camera.text or "").split()
    inner, radial = words[:5], words[5:]
    if intrinsics is not None:
        inner = (intrinsics.text or "").split()
        radial = [] if distortion is None else (distortion.text or "").split()
    cx, cy, fx, fy, skew = numbers(f"{name}.intrinsics", inner, 5)
    coefficients = numbers(f"{name}.distortion", radial, len(radial))
    if coefficients[3:].any():
        raise ValueError(
            f"{name}.distortion: expected k1 k2 k3, found {coefficients[3:].tolist()} beside them, "
            "whose meaning is not published; calibrate with radial distortion alone"
        )
    if orientation is None:
        raise ValueError(f"{name}.orientation: missing")
    pose = numbers(f"{name}.orientation", (orientation.text or "").split(), 6)
    padded = np.concatenate([coefficients, np.zeros(3)])[:3]
    lens = Lens(np.array([fx, fy]), np.array([cx, cy]), padded, np.zeros(2), skew_px=float(skew))
    return lens, rotation_from_cardan(pose[:3]), pose[3:]


# MATLAB: stereoParameters as JSON, and Bouguet's calibration toolbox as text.

_UNITS: dict[str, LengthUnit] = {"mm": "mm", "millimeters": "mm", "millimetres": "mm", "m": "m", "meters": "m"}
_ESSENTIAL = 1e-3  # relative departure of an essential matrix from that of R and T above which they contradict
_ASSIGNMENT = re.compile(r"\b([A-Za-z]\w*)\s*=\s*(?:\[([^\]]*)\]|([-+]?[\d.][\w.+-]*))")


def read_matlab(content: dict[str, Any]) -> Stated:
    """Return what jsonencode(toStruct(stereoParams)), or jsonencode(stereoParams), wrote.

    Pixels count from 1 there, so that 1 is taken off the principal point (MathWorks, `stereoParametersToOpenCV`).
    `K` is the camera matrix and `PoseCamera2` has x₂ = R·x₁ + T; the older `IntrinsicMatrix` and `RotationOfCamera2`
    are the transposed ones, x₂ᵀ = x₁ᵀ·R + T. An `EssentialMatrix` in the file must agree with R and T.
    """
    (left, left_size, unit), (right, right_size, _) = (
        _matlab_camera(name, content.get(name)) for name in ("CameraParameters1", "CameraParameters2")
    )
    rotation, translation = _extrinsics(content)
    if content.get("EssentialMatrix") is not None:
        given = numbers("EssentialMatrix", content["EssentialMatrix"], 9)
        expected = (skew(translation) @ rotation).ravel()
        share = abs(given @ expected) / (np.linalg.norm(given) * np.linalg.norm(expected))
        if not 1.0 - share < _ESSENTIAL**2:
            raise ValueError("EssentialMatrix: expected the one of the file's rotation and translation, found another")
    known = _UNITS.get(str(content.get("WorldUnits", unit)).lower())
    return Stated("MATLAB", (left, right), (left_size, right_size), rotation, translation, known)


def read_bouguet(text: str) -> Stated:
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
    for side in SIDES:
        focal, centre, kc = array(f"fc_{side}", 2), array(f"cc_{side}", 2), array(f"kc_{side}", 5)
        alpha = float(array(f"alpha_c_{side}", 1)[0]) if f"alpha_c_{side}" in values else 0.0
        lenses.append(Lens(focal, centre, kc[[0, 1, 4]], kc[2:4], skew_px=alpha * float(focal[0])))
    rotation = array("R", 9).reshape(3, 3) if "om" not in values else rotation_from_vector(array("om", 3))
    size = (int(array("nx", 1)[0]), int(array("ny", 1)[0])) if {"nx", "ny"} <= set(values) else None
    return Stated("Bouguet's toolbox", (lenses[0], lenses[1]), (size, size), rotation, array("T", 3), "mm")


def _matlab_camera(name: str, camera: Any) -> tuple[Lens, tuple[int, int] | None, str]:
    """Return one camera's lens, its principal point counted from 0, width and height, and the unit of lengths."""
    if not isinstance(camera, dict):
        raise ValueError(f"{name}: expected an object, found {str(camera)[:40]!r}")
    inner = camera.get("Intrinsics")
    parameters = {**camera, **inner} if isinstance(inner, dict) else camera
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
    lens = Lens(np.array([k[0, 0], k[1, 1]]), k[:2, 2] - 1.0, radial, tangential, skew_px=float(k[0, 1]))
    size = camera.get("ImageSize") or parameters.get("ImageSize")
    rows, columns = numbers(f"{name}.ImageSize", size, 2) if size else (0, 0)
    return lens, (int(columns), int(rows)) if size else None, camera.get("WorldUnits", "")


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


# Calibrations of other programs → `StereoRig`: OpenCV, DICe, VIC-3D, MATLAB, Bouguet's toolbox.


def import_calibration(
    path: str | Path,
    image_size: tuple[int, int] | None = None,
    length_unit: LengthUnit | None = None,
    extrinsics: str | Path | None = None,
) -> ImportedCalibration:
    """Return the stereo pair of another program's calibration file; its content, not its name, tells the format.

    `image_size` (width, height): for files that do not hold it. `length_unit`: for OpenCV's files, which do not say it,
    and against the unit that a format has by habit. `extrinsics`: the second file of OpenCV's sample program, which
    writes intrinsics and extrinsics apart. `ValueError` names the file and what is wrong in it.

    >>> import json
    >>> from pathlib import Path
    >>> from tempfile import TemporaryDirectory
    >>> matrix = [[900, 0, 320], [0, 900, 240], [0, 0, 1]]
    >>> content = {"M1": matrix, "D1": [0] * 5, "M2": matrix, "D2": [0] * 5, "R": np.eye(3).tolist(), "T": [-100, 0, 0]}
    >>> with TemporaryDirectory() as folder:
    ...     _ = Path(folder, "stereo.json").write_text(json.dumps(content))
    ...     imported = import_calibration(f"{folder}/stereo.json", image_size=(640, 480), length_unit="mm")
    >>> imported.format, imported.rig.right_from_left.translation_m
    ('OpenCV', array([-0.1,  0. ,  0. ]))
    """
    path = Path(path)
    if image_size is not None and min(image_size) < 1:
        raise ValueError(f"image_size: expected a width and a height of at least 1, found {image_size}")
    second = None
    if extrinsics is not None:
        try:
            second = Path(extrinsics).read_bytes().decode("utf-8-sig")
        except UnicodeDecodeError as error:
            raise ValueError(f"{extrinsics}: expected a text, found other bytes") from error
    try:
        return build(_read(_content(path), second), image_size, length_unit)
    except ValueError as error:
        raise ValueError(f"{path}: {error}") from error


def _content(path: Path) -> bytes:
    """Return a file's content; of a zipped VIC-3D project the one part that matters."""
    if not zipfile.is_zipfile(path):
        return path.read_bytes()
    with zipfile.ZipFile(path) as archive:
        try:
            return archive.read(_PROJECT)
        except KeyError as error:
            raise ValueError(f"expected {_PROJECT} in this zipped file, found none") from error


def _read(content: bytes, extrinsics: str | None) -> Stated:
    """Return what a file of any known format states."""
    text = content.decode("utf-8-sig", errors="replace")
    if text.lstrip().startswith("<"):
        root = parse_xml(content)
        if root.tag == "parameterlist":
            return read_dice_xml(root)
        if root.tag != "opencv_storage":
            if next(root.iter("camera"), None) is not None:
                return read_vic3d(root)
            raise ValueError(f"expected XML of OpenCV, DICe or VIC-3D, found one that begins with <{root.tag}>")
    elif text.lstrip().startswith("{"):
        values = _json(text)
        if "CameraParameters1" in values:
            return read_matlab(values)
        if values.get("format") == 1 and "rotation" in values:
            raise ValueError("expected another program's calibration, found one of this program, ready for use")
    elif not text.startswith("%YAML"):
        return read_bouguet(text) if "fc_left" in text else read_dice_text(text)
    return read_opencv(text, extrinsics)
