"""Calibrations of image correlation programs: DICe, VIC-3D, MatchID."""

from __future__ import annotations

import re
from dataclasses import replace
from xml.etree import ElementTree

import numpy as np

from photogram.calibration.calibration_notices import (
    EVEN_POWERS_REQUESTED,
    LINEAR_POWERS,
    UNUSED_COEFFICIENTS,
)
from photogram.calibration.exchange.lens import (
    EVEN,
    NO_ROTATION,
    Lens,
    StatedCalibration,
    parse_numbers,
    right_from_left,
    rotation_from_cardan,
    unit_of,
)
from shakercal._common.arrays import FloatArray
from shakercal._common.notices import Notice

# DICe: camera systems in XML, and the text of 16 intrinsic and 6 or 12 extrinsic numbers before it.

_SYSTEM_FILE = "dice_xml_camera_system_file"
_POWERS = {  # of r in the factor of x and y
    "OPENCV_LENS_DISTORTION": EVEN,
    "K1R1_K2R2_K3R3": (0, 1, 2),  # r + k1·r + k2·r² + k3·r³
    "K1R2_K2R4_K3R6": (1, 3, 5),
    "K1R3_K2R5_K3R7": EVEN,
    "VIC3D_LENS_DISTORTION": EVEN,  # the numbers are those of VIC-3D
}
_LINEAR = "K1R1_K2R2_K3R3"
_NONE = "NO_LENS_DISTORTION"
_COEFFICIENTS = ("K1", "K2", "K3", "P1", "P2", "K4", "K5", "K6")
_USED = {_NONE: 0, "OPENCV_LENS_DISTORTION": len(_COEFFICIENTS)}  # of these, by model; other models use K1 K2 K3
_DICE_BEYOND = ("S1", "S2", "S3", "S4", "T1", "T2")
_TEXT_ORDER = "cx cy fx fy fs k1 k2 k3 of either camera, alpha beta gamma or R11…R33, tx ty tz, [height width]"


def read_dice_xml(root: ElementTree.Element, even_radial: bool = False) -> StatedCalibration:
    """Read a DICe camera system (`DICe_Camera.cpp`, `DICe_CameraSystem.cpp` of dicengine).

    Each camera has x_camera = R·x_world + t, or, with `extrinsics_relative_camera_to_camera`, the second one x₁ = R·x₀
    + t. Angles ALPHA BETA GAMMA in degrees, R = R_z·R_y·R_x. Lengths are in the unit of the target's spacing, by
    default mm. `even_radial`: coefficients stated for r, r², r³ are used for r², r⁴, r⁶.
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
        rotation, translation = right_from_left(first[2:4], second[2:4])
    lenses, notices = _by_order(first[0], second[0], even_radial)
    notices = (*first[4], *second[4], *notices)
    return StatedCalibration("DICe", lenses, (first[1], second[1]), rotation, translation, None, notices, "mm")


def _by_order(left: Lens, right: Lens, even_radial: bool) -> tuple[tuple[Lens, Lens], tuple[Notice, ...]]:
    """Return both lenses with the chosen radial powers and a notice of the choice."""
    linear = [lens for lens in (left, right) if lens.exponents == _POWERS[_LINEAR]]
    if even_radial and not linear:
        raise ValueError(f"even_radial: expected coefficients of {_LINEAR}, found others, with stated powers of r")
    if not any(lens.radial.any() for lens in linear):
        return (left, right), ()
    if even_radial:
        even = replace(left, exponents=EVEN), replace(right, exponents=EVEN)
        return even, (Notice(EVEN_POWERS_REQUESTED, "distortion"),)
    percent = {"left_percent": 100 * left.radial[0], "right_percent": 100 * right.radial[0]}
    return (left, right), (Notice(LINEAR_POWERS, "distortion", model=_LINEAR, **percent),)


def read_dice_text(text: str, even_radial: bool = False) -> StatedCalibration:
    """Read DICe's former text format: one number a line, comments after #.

    Order: cx cy fx fy fs k1 k2 k3 of each camera, then α β γ (degrees) or R by rows, tx ty tz of x₁ = R·x₀ + t, then
    optionally height and width. k1 k2 k3 are those of r, r², r³, as DICe reads them
    (`Camera_System::read_camera_system_file`, K1R1_K2R2_K3R3), with `even_radial` those of r², r⁴, r⁶.
    """
    words = [word for line in text.splitlines() if (word := line.split("#", 1)[0].strip())]
    extrinsic, has_size = {22: (6, False), 24: (6, True), 28: (12, False), 30: (12, True)}.get(len(words), (0, False))
    if not extrinsic:
        raise ValueError(f"expected 22, 24, 28 or 30 numbers, one a line ({_TEXT_ORDER}), found {len(words)}")
    values = parse_numbers("content", words, len(words))
    outer = values[16 : 16 + extrinsic]
    rotation = rotation_from_cardan(outer[:3]) if extrinsic == 6 else outer[:9].reshape(3, 3)
    size = (int(values[-1]), int(values[-2])) if has_size else None
    left, right = (
        Lens(each[2:4], each[:2], each[5:8], np.zeros(2), skew_px=float(each[4]), exponents=_POWERS[_LINEAR])
        for each in (values[:8], values[8:16])
    )
    lenses, notices = _by_order(left, right, even_radial)
    return StatedCalibration("DICe", lenses, (size, size), rotation, outer[-3:], None, notices, "mm")


def _parameters(element: ElementTree.Element) -> dict[str, str]:
    """Return the values of a list's direct parameters by upper-case name."""
    return {part.get("name", "").upper(): part.get("value", "") for part in element.findall("parameter")}


def _camera(
    name: str, element: ElementTree.Element
) -> tuple[Lens, tuple[int, int], FloatArray, FloatArray, tuple[Notice, ...]]:
    """Return lens, size, rotation, translation and notices of one camera."""
    values = _parameters(element)

    def number(key: str) -> float:
        return float(parse_numbers(f"{name}.{key}", values.get(key, "0"), 1)[0])

    for key in ("CX", "CY", "FX", "FY", "IMAGE_HEIGHT_WIDTH"):
        if key not in values:
            raise ValueError(f"{name}.{key}: missing")
    for key in _DICE_BEYOND:
        if number(key) != 0:
            raise ValueError(f"{name}.{key}: expected only k1 … k6, p1 and p2, found {key} = {number(key):g}")
    model = values.get("LENS_DISTORTION_MODEL", _NONE).upper()
    if model != _NONE and model not in _POWERS:
        raise ValueError(f"{name}.LENS_DISTORTION_MODEL: expected {', '.join((_NONE, *_POWERS))}, found {model}")
    unused = [key for key in _COEFFICIENTS[_USED.get(model, 3) :] if number(key) != 0]
    if unused and "LENS_DISTORTION_MODEL" not in values:
        raise ValueError(f"{name}.LENS_DISTORTION_MODEL: expected the model of {', '.join(unused)}, found none")
    radial = np.array([number("K1"), number("K2"), number("K3")]) * (model != _NONE)
    is_opencv = model == "OPENCV_LENS_DISTORTION"
    tangential = np.array([number("P1"), number("P2")]) * is_opencv
    lens = Lens(
        np.array([number("FX"), number("FY")]),
        np.array([number("CX"), number("CY")]),
        radial,
        tangential,
        skew_px=number("FS"),
        exponents=_POWERS.get(model, EVEN),
        divisor=np.array([number("K4"), number("K5"), number("K6")]) * is_opencv,
    )
    height, width = _list(f"{name}.IMAGE_HEIGHT_WIDTH", values["IMAGE_HEIGHT_WIDTH"], 2)
    rotation = rotation_from_cardan(np.array([number("ALPHA"), number("BETA"), number("GAMMA")]))
    for part in element.findall("parameterlist"):
        if part.get("name", "").lower() == "rotation_3x3_matrix":
            rows = _parameters(part)
            matrix = np.array([_list(f"{name}.ROW {i}", rows.get(f"ROW {i}", ""), 3) for i in range(3)])
            if {"ALPHA", "BETA", "GAMMA"} & set(values) and not np.abs(matrix - rotation).max() <= NO_ROTATION:
                off = float(np.abs(matrix - rotation).max())
                expected = "the angles of rotation_3x3_matrix"
                raise ValueError(
                    f"{name}.ALPHA, BETA, GAMMA: expected {expected}, off by {off:.2g}: are they in degrees?"
                )
            rotation = matrix
    ignored = {"camera": name, "coefficients": ", ".join(unused), "model": model}
    notices = (Notice(UNUSED_COEFFICIENTS, "distortion", **ignored),) if unused else ()
    shift = np.array([number("TX"), number("TY"), number("TZ")])
    return lens, (int(width), int(height)), rotation, shift, notices


def _list(where: str, text: str, count: int) -> FloatArray:
    """Return the numbers of a text like { 1, 2 }."""
    return parse_numbers(where, re.findall(r"[^\s,{}]+", text), count)


# VIC-3D: the calibration in a project's XML, separate or inside a .z3d file.


def read_vic3d(root: ElementTree.Element) -> StatedCalibration:
    """Read a VIC-3D project or calibration.

    `camera`: cx cy fx fy s k1 k2 k3, as text or split into `intrinsics` and `distortion`, with u = fx·x_d + s·y_d + cx;
    `orientation`: α β γ (degrees) tx ty tz (mm) of x_camera = R_z(γ)·R_y(β)·R_x(α)·x_world + t (sdynpy,
    `camera_matrix_from_vic_parameters`; dicengine, `DICe_CameraSystem.cpp`). The distortion is not published. Of the
    usual polynomials, 1 + k1·r² + k2·r⁴ + k3·r⁶ has the smallest epipolar residuals in a recording of the DIC challenge
    with its VIC-3D calibration (`tests/photogram/test_calibration_import.py`).
    """
    cameras = {camera.get("id", ""): camera for camera in root.iter("camera")}
    if set(cameras) != {"0", "1"}:
        raise ValueError(f"camera: expected the ids 0 and 1, found {', '.join(sorted(cameras)) or 'none'}")
    (left, *left_pose), (right, *right_pose) = (_vic3d_camera(f"camera {key}", cameras[key]) for key in "01")
    rotation, translation = right_from_left(left_pose, right_pose)
    size = None  # of the images: stated at an area of interest, if there is one
    for mask in root.iter("polygonmask"):
        if size is None and mask.get("width") and mask.get("height"):
            width, height = parse_numbers("polygonmask", [mask.get("width"), mask.get("height")], 2)
            size = int(width), int(height)
    return StatedCalibration("VIC-3D", (left, right), (size, size), rotation, translation, None, habit="mm")


def _vic3d_camera(name: str, camera: ElementTree.Element) -> tuple[Lens, FloatArray, FloatArray]:
    """Return lens, rotation and translation (mm) of one camera."""
    intrinsics, distortion, orientation = (camera.find(tag) for tag in ("intrinsics", "distortion", "orientation"))
    words = (camera.text or "").split()
    inner, radial = words[:5], words[5:]
    if intrinsics is not None:
        inner = (intrinsics.text or "").split()
        radial = [] if distortion is None else (distortion.text or "").split()
    cx, cy, fx, fy, skew = parse_numbers(f"{name}.intrinsics", inner, 5)
    coefficients = parse_numbers(f"{name}.distortion", radial, len(radial))
    if coefficients[3:].any():
        raise ValueError(
            f"{name}.distortion: expected k1 k2 k3, found also {coefficients[3:].tolist()}, "
            "whose definition is not published; calibrate with radial distortion only"
        )
    if orientation is None:
        raise ValueError(f"{name}.orientation: missing")
    pose = parse_numbers(f"{name}.orientation", (orientation.text or "").split(), 6)
    padded = np.concatenate([coefficients, np.zeros(3)])[:3]
    lens = Lens(np.array([fx, fy]), np.array([cx, cy]), padded, np.zeros(2), skew_px=float(skew))
    return lens, rotation_from_cardan(pose[:3]), pose[3:]


# MatchID: a table of names and values.

_MATCHID = re.compile(
    r"\s?(cam\d_[a-z]\w*(?: \d)?|t[xyz]|theta|phi|psi)\s?(?:\[(\w+)\]|_(px|mm|m|deg|rad))?\s?[;,:=\t]\s*(\S+)",
    re.ASCII,
)
_MATCHID_ANGLES = {"": 1.0, "deg": 1.0, "degrees": 1.0, "rad": 180 / np.pi, "radians": 180 / np.pi}  # in degrees


def is_matchid(text: str) -> bool:
    """Return whether a text has the names of a MatchID calibration."""
    return re.search(r"^[ \t]*cam\d_fx(_px)?\b", text, re.IGNORECASE | re.MULTILINE) is not None


def read_matchid(text: str) -> StatedCalibration:
    """Read a `.caldat` of MatchID, or its names with `_px`, `_mm`, `_deg`.

    Cameras are numbered 0 and 1 or 1 and 2. Fx Fy Fs Cx Cy in px, Kappa 1 2 3 of r², r⁴, r⁶, P1 P2; x_second =
    R·x_first + T with R = R_z(ψ)·R_y(φ)·R_x(θ), as pyvale writes it for MatchID. A second camera with the same field of
    view requires this order.
    """
    values: dict[str, tuple[str, str]] = {}
    for line in text.lower().splitlines():
        parts = (" ".join(part.split()) for part in line.split("\t"))
        found = _MATCHID.match("\t".join(part for part in parts if part))
        if found:
            name, bracket, suffix, value = found.groups()
            suffixed = re.fullmatch(r"(\w+?)_(px|mm|m|deg|rad)", name)
            unit = bracket or suffix or (suffixed[2] if suffixed else "")
            values[re.sub(r"[ _]", "", (suffixed[1] if suffixed else name)).replace("kappa", "k")] = unit, value

    def number(name: str, default: str | None = None) -> float:
        if name not in values and default is None:
            raise ValueError(f"{name}: missing")
        value = values[name][1] if name in values else default
        return float(parse_numbers(name, [str(value).replace(",", ".")], 1)[0])

    cameras = sorted({name[:4] for name in values if name.startswith("cam")})
    if cameras not in (["cam0", "cam1"], ["cam1", "cam2"]):
        raise ValueError(f"expected the cameras 0 and 1, or 1 and 2, found {', '.join(cameras) or 'none'}")
    left, right = (
        Lens(
            np.array([number(f"{camera}fx"), number(f"{camera}fy")]),
            np.array([number(f"{camera}cx"), number(f"{camera}cy")]),
            np.array([number(f"{camera}k{n}", "0") for n in (1, 2, 3)]),
            np.array([number(f"{camera}p{n}", "0") for n in (1, 2)]),
            skew_px=number(f"{camera}fs", "0"),
        )
        for camera in cameras
    )
    angles = np.array([number(name) for name in ("theta", "phi", "psi")])
    translation = np.array([number(name) for name in ("tx", "ty", "tz")])
    units = {name: values[name][0] for name in ("theta", "phi", "psi", "tx", "ty", "tz")}
    for name, unit in units.items():
        lengths = name[0] == "t" and name != "theta"
        if (unit and unit_of(unit) is None) if lengths else unit not in _MATCHID_ANGLES:
            raise ValueError(f"{name}: expected it in {'m or mm' if lengths else 'deg or rad'}, found {unit}")
    if len({units[name] for name in ("tx", "ty", "tz")}) > 1:
        raise ValueError(f"tx, ty, tz: expected one unit, found {', '.join(list(units.values())[3:])}")
    rotation = rotation_from_cardan(angles * [_MATCHID_ANGLES[units[name]] for name in ("theta", "phi", "psi")])
    size, stated = (None, None), unit_of(units["tx"])
    return StatedCalibration("MatchID", (left, right), size, rotation, translation, stated, habit="mm")
