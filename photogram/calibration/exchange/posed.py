"""Calibrations with several posed cameras: COLMAP, Metashape, mrcal, anipose and caliscope."""

from __future__ import annotations

import ast
import struct
import tomllib
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any
from xml.etree import ElementTree

import numpy as np

from photogram.calibration.calibration_notices import ARBITRARY_SCALE
from photogram.calibration.exchange.lens import (
    NO_ROTATION,
    LengthUnit,
    Lens,
    StatedCalibration,
    parse_numbers,
    right_from_left,
)
from photogram.calibration.exchange.vision import read_lens
from photogram.geometry import rotation_from_vector
from shakercal._common.arrays import FloatArray
from shakercal._common.notices import Notice

_HALF_PX = 0.5  # COLMAP and Metashape count pixels from the image's corner, this program from a pixel's centre
_NAMED = 8  # cameras named in an error
_MOST = 100_000  # cameras and images of a binary file
FOUR_POWERS = (2, 4, 6, 8)
"""Exponents of a radial polynomial with k4."""


@dataclass(frozen=True, eq=False)
class PosedCamera:
    """A camera of a file, with its pose x_camera = rotation·x_world + translation."""

    name: str
    lens: Lens
    size_px: tuple[int, int]
    rotation: FloatArray
    translation: FloatArray


def pair_of(
    program: str,
    cameras: Sequence[tuple[str, Callable[[], PosedCamera]]],
    chosen: tuple[str, str] | None,
    habit: LengthUnit | None,
    notices: tuple[Notice, ...] = (),
) -> StatedCalibration:
    """Return the pair of the chosen cameras, left and right, or of the only two.

    `cameras` are names, each with the function that reads this camera.
    """
    names = [name for name, _ in cameras]
    listed = ", ".join(names[:_NAMED]) + (" …" if len(names) > _NAMED else "")
    if chosen is None:
        if len(cameras) != 2:
            raise ValueError(f"cameras: expected the names of the left and the right camera, found {listed or 'none'}")
        chosen = names[0], names[1]
    for name in chosen:
        if names.count(name) != 1:
            count = names.count(name)
            raise ValueError(f"cameras: expected {name[:60]!r} once among {listed or 'none'}, found it {count} times")
    if chosen[0] == chosen[1]:
        raise ValueError(f"cameras: expected two different cameras, found {chosen[0][:60]!r} twice")
    pair = [cameras[names.index(name)][1]() for name in chosen]
    for camera in pair:
        if not np.abs(camera.rotation @ camera.rotation.T - np.eye(3)).max() <= NO_ROTATION:
            raise ValueError(f"{camera.name}: expected an orthonormal rotation, found {camera.rotation.tolist()}")
    rotation, translation = right_from_left(*((camera.rotation, camera.translation) for camera in pair))
    lenses, sizes = (pair[0].lens, pair[1].lens), (pair[0].size_px, pair[1].size_px)
    return StatedCalibration(program, lenses, sizes, rotation, translation, None, notices, habit)


def _whole(where: str, value: Any) -> tuple[int, int]:
    """Return width and height of an image."""
    width, height = parse_numbers(where, value, 2)
    return int(width), int(height)


# COLMAP: cameras and images, as text or binary.

_COLMAP_MODELS = {  # number in binary files: name, focal lengths, and the distortion's coefficients
    0: ("SIMPLE_PINHOLE", 1, ()),
    1: ("PINHOLE", 2, ()),
    2: ("SIMPLE_RADIAL", 1, ("k1",)),
    3: ("RADIAL", 1, ("k1", "k2")),
    4: ("OPENCV", 2, ("k1", "k2", "p1", "p2")),
    5: ("OPENCV_FISHEYE", 2, ("a1", "a2", "a3", "a4")),
    6: ("FULL_OPENCV", 2, ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6")),
    8: ("SIMPLE_RADIAL_FISHEYE", 1, ("a1",)),
    9: ("RADIAL_FISHEYE", 1, ("a1", "a2")),
}
_OTHER_COLMAP = {7: ("FOV", 5), 10: ("THIN_PRISM_FISHEYE", 12), 11: ("RAD_TAN_THIN_PRISM_FISHEYE", 16)}
_NAMES = {name: (focal, terms) for name, focal, terms in _COLMAP_MODELS.values()}
_IMAGE = 10  # texts of an image: number, quaternion, translation, camera, name

ColmapCamera = tuple[str, tuple[int, int], FloatArray]
"""Model, size and parameters."""
ColmapImage = tuple[str, int, FloatArray]
"""Name, number of the camera, quaternion and translation (7,)."""


def is_colmap(content: bytes) -> bool:
    """Return whether a file is COLMAP's list of cameras, by its content."""
    if b"\0" in content[:64]:
        return _binary_cameras(content) is not None
    lines = [line.split() for line in content[:2000].splitlines() if line.strip() and not line.startswith(b"#")]
    models = {name.encode() for name in (*_NAMES, *(name for name, _ in _OTHER_COLMAP.values()))}
    return bool(lines) and len(lines[0]) > 4 and lines[0][0].isdigit() and lines[0][1] in models


def read_colmap(content: bytes, images: bytes | None, chosen: tuple[str, str] | None) -> StatedCalibration:
    """Read COLMAP's cameras and images, each as text or binary.

    An image has a quaternion (w, x, y, z) and a translation, x_camera = R·x_world + t, and the number of its camera.
    Pixels count from the corner of the image, half a pixel before the first pixel's centre. The unit is arbitrary.
    """
    if images is None:
        raise ValueError("extrinsics: expected COLMAP's images.txt or images.bin, which has the poses, found none")
    binary = _binary_cameras(content)
    cameras = _text_cameras(content.decode("utf-8", errors="replace")) if binary is None else binary
    posed = _text_images(images) if b"\0" not in images else _binary_images(images)

    def read(name: str, number: int, pose: FloatArray) -> PosedCamera:
        if number not in cameras:
            raise ValueError(f"{name}: expected one of the cameras {', '.join(map(str, cameras))[:60]}, found {number}")
        model, size, parameters = cameras[number]
        rotation = _rotation_of_quaternion(name, pose[:4])
        return PosedCamera(name, _colmap_lens(name, model, parameters), size, rotation, pose[4:])

    notices = (Notice(ARBITRARY_SCALE, "extrinsics", program="COLMAP"),)
    return pair_of("COLMAP", [(image[0], partial(read, *image)) for image in posed], chosen, None, notices)


def _rotation_of_quaternion(name: str, quaternion: FloatArray) -> FloatArray:
    """Return the rotation matrix of a unit quaternion (w, x, y, z)."""
    from scipy.spatial.transform import Rotation

    if not abs(float(np.linalg.norm(quaternion)) - 1.0) <= NO_ROTATION:
        raise ValueError(f"{name}: expected a quaternion of length 1, found {quaternion.tolist()}")
    return np.asarray(Rotation.from_quat(np.roll(quaternion, -1)).as_matrix())


def _colmap_lens(name: str, model: str, parameters: FloatArray) -> Lens:
    """Return the lens of a camera's model and parameters."""
    if model not in _NAMES:
        raise ValueError(f"{name}: expected a camera of COLMAP's {', '.join(_NAMES)}, found {model[:40]}")
    count, terms = _NAMES[model]
    if len(parameters) != count + 2 + len(terms):
        raise ValueError(f"{name}: expected {count + 2 + len(terms)} parameters of {model}, found {len(parameters)}")
    focal, centre = np.resize(parameters[:count], 2), parameters[count : count + 2] - _HALF_PX
    values = dict(zip(terms, parameters[count + 2 :].tolist(), strict=True))
    if "a1" in values:
        return Lens(focal, centre, angular=np.array([values.get(f"a{k}", 0.0) for k in range(1, 5)]))
    radial, tangential, divisor = (
        np.array([values.get(key, 0.0) for key in keys])
        for keys in (("k1", "k2", "k3"), ("p1", "p2"), ("k4", "k5", "k6"))
    )
    return Lens(focal, centre, radial, tangential, divisor=divisor)


def _text_cameras(text: str) -> dict[int, ColmapCamera]:
    """Return the cameras of cameras.txt by number."""
    cameras: dict[int, ColmapCamera] = {}
    for line in text.splitlines():
        words = line.split()
        if not words or words[0].startswith("#"):
            continue
        if len(words) < 5 or not words[0].isdecimal():
            expected = "a camera's number, model, width, height and parameters"
            raise ValueError(f"cameras: expected {expected}, found {line[:60]!r}")
        where = f"camera {words[0][:12]}"
        parameters = parse_numbers(where, words[4:], len(words) - 4)
        cameras[int(words[0])] = words[1], _whole(where, words[2:4]), parameters
    return cameras


def _text_images(content: bytes) -> Iterator[ColmapImage]:
    """Yield the images of images.txt.

    A line of points, which may be empty, follows each one.
    """
    is_image = True
    for line in content.decode("utf-8-sig", errors="replace").splitlines():
        words = line.split(maxsplit=_IMAGE - 1)
        if line.lstrip().startswith("#") or (is_image and not words):
            continue
        if not is_image:
            is_image = True
            if len(words) != _IMAGE or _is_number(words[-1].split()[-1]):
                continue
        if len(words) != _IMAGE or not words[0].isdecimal() or not words[8].isdecimal():
            expected = "an image's number, quaternion, translation, camera and name"
            raise ValueError(f"images: expected {expected}, found {line[:60]!r}")
        yield words[9], int(words[8]), parse_numbers(words[9][:60], words[1:8], 7)
        is_image = False


def _is_number(word: str) -> bool:
    try:
        float(word)
    except ValueError:
        return False
    return True


def _binary_cameras(content: bytes) -> dict[int, ColmapCamera] | None:
    """Return the cameras of cameras.bin by number, None of another file."""
    cameras: dict[int, ColmapCamera] = {}
    try:
        (count,), at = struct.unpack_from("<Q", content), 8
        if not 0 < count <= _MOST:
            return None
        for _ in range(count):
            number, code, width, height = struct.unpack_from("<IiQQ", content, at)
            name, focal, terms = _COLMAP_MODELS.get(code, ("", 0, ()))
            name, length = (name, focal + 2 + len(terms)) if name else _OTHER_COLMAP.get(code, ("", -1))
            if length < 0:
                return None
            at += 24
            parameters = np.array(struct.unpack_from(f"<{length}d", content, at))
            at += 8 * length
            where = f"camera {number}"
            cameras[number] = name, _whole(where, [width, height]), parse_numbers(where, parameters, length)
    except struct.error:
        return None
    return cameras if at == len(content) else None


def _binary_images(content: bytes) -> Iterator[ColmapImage]:
    """Yield the images of images.bin."""
    try:
        (count,), at = struct.unpack_from("<Q", content), 8
        if count > _MOST:
            raise ValueError(f"images: expected at most {_MOST} images, found {count}")
        for _ in range(count):
            _, *pose, camera = struct.unpack_from("<I7dI", content, at)
            at += 64
            end = content.index(b"\0", at)
            name = content[at:end].decode("utf-8", errors="replace")
            (points,) = struct.unpack_from("<Q", content, end + 1)
            at = end + 9 + 24 * points
            yield name, camera, parse_numbers(name[:60], pose, 7)
    except (struct.error, ValueError) as error:
        if isinstance(error, ValueError) and "expected" in str(error):
            raise
        raise ValueError("images: expected COLMAP's images.bin, found a file that ends within an image") from error
    if at != len(content):
        raise ValueError(f"images: expected COLMAP's images.bin, found {len(content) - at} bytes after the last image")


# mrcal: one .cameramodel for each camera.

_MRCAL_TERMS = {"PINHOLE": 0, "OPENCV4": 4, "OPENCV5": 5, "OPENCV8": 8, "OPENCV12": 12}
_MRCAL_KEYS = ("lensmodel", "lens_model")


def is_mrcal(text: str) -> bool:
    """Return whether a text is a camera model of mrcal."""
    return "LENSMODEL_" in text and any(f"{mark}{key}{mark}" in text for key in _MRCAL_KEYS for mark in "'\"")


def read_mrcal(text: str, second: str | None) -> StatedCalibration:
    """Read the camera models of the left and, as second file, of the right camera.

    `extrinsics` are a rotation vector and a translation in m, x_camera = R·x_reference + t; both files have one
    reference. The intrinsics are those of OpenCV, fx fy cx cy and its coefficients; pixels count from a pixel's centre.
    """
    if second is None:
        raise ValueError("extrinsics: expected the right camera's .cameramodel as the second file, found the left one")
    cameras = [(side, partial(_mrcal_camera, side, content)) for side, content in (("left", text), ("right", second))]
    return pair_of("mrcal", cameras, None, "m")


def _mrcal_camera(side: str, text: str) -> PosedCamera:
    """Return the camera of a camera model, which is a dictionary as Python writes it."""
    try:
        content = ast.literal_eval(text.strip())
    except (ValueError, SyntaxError, TypeError) as error:
        raise ValueError(f"{side} camera: expected a camera model of mrcal, found: {type(error).__name__}") from error
    if not isinstance(content, dict):
        raise ValueError(f"{side} camera: expected named values of mrcal, found {str(content)[:40]!r}")
    model = str(next((content[key] for key in _MRCAL_KEYS if key in content), "none"))
    terms = _MRCAL_TERMS.get(model.removeprefix("LENSMODEL_"))
    if terms is None:
        known = ", ".join(f"LENSMODEL_{name}" for name in _MRCAL_TERMS)
        expected = f"one of {known}, into which mrcal-convert-lensmodel converts"
        raise ValueError(f"{side} lensmodel: expected {expected}, found {model[:60]}")
    values = parse_numbers(f"{side} intrinsics", content.get("intrinsics"), 4 + terms)
    if model.endswith("OPENCV12") and not values[12:].any():
        values = values[:12]
    matrix = np.array([[values[0], 0.0, values[2]], [0.0, values[1], values[3]], [0.0, 0.0, 1.0]])
    coefficients = values[4:] if terms else np.zeros(5)
    lens = read_lens((f"{side} intrinsics", matrix), (f"{side} intrinsics", coefficients), "plumb_bob")
    pose = parse_numbers(f"{side} extrinsics", content.get("extrinsics"), 6)
    size = _whole(f"{side} imagersize", content.get("imagersize"))
    return PosedCamera(side, lens, size, rotation_from_vector(pose[:3]), pose[3:])


# anipose and caliscope: TOML.

_CALISCOPE = ("port", "cam_id", "rotation_count", "grid_count")


def is_toml_of_cameras(text: str) -> bool:
    """Return whether a text is a TOML file with cameras of anipose or caliscope."""
    lines = [line.strip() for line in text.splitlines()]
    tables = any(line.startswith("[") and line.endswith("]") and "=" not in line for line in lines)
    return tables and any(line.startswith("distortions") and "=" in line for line in lines)


def read_toml_cameras(text: str, chosen: tuple[str, str] | None) -> StatedCalibration:
    """Read the cameras of anipose (`[cam_0]`) or caliscope (`[cam_0]` or `[cameras.0]`).

    Each has `matrix`, `distortions`, `size`, `rotation` (vector or matrix) and `translation`, x_camera = R·x_world + t;
    with `fisheye` the coefficients are those of OpenCV's fisheye module. Cameras to `ignore` and those without a pose
    are not offered. caliscope writes m, anipose the unit of its board.
    """
    try:
        content: dict[str, Any] = tomllib.loads(text)
    except (tomllib.TOMLDecodeError, RecursionError) as error:
        raise ValueError(f"expected a TOML text, found: {' '.join(str(error).split())[:200]}") from error
    inner = content.get("cameras")
    tables = inner if isinstance(inner, dict) else content
    found = {name: table for name, table in tables.items() if isinstance(table, dict) and "matrix" in table}
    cameras = []
    for section, table in found.items():
        if table.get("ignore") or table.get("rotation") is None or table.get("translation") is None:
            continue
        name = section if chosen is not None and section in chosen else str(table.get("name", section))
        cameras.append((name, partial(_toml_camera, section, table)))
    if not cameras:
        raise ValueError("cameras: expected cameras with rotation and translation, found none")
    of_caliscope = any(key in table for table in found.values() for key in _CALISCOPE)
    return pair_of("caliscope" if of_caliscope else "anipose", cameras, chosen, "m" if of_caliscope else None)


def _toml_camera(section: str, table: dict[str, Any]) -> PosedCamera:
    """Return one camera."""
    is_fisheye = table.get("fisheye", False)
    if not isinstance(is_fisheye, bool):
        raise ValueError(f"{section}.fisheye: expected true or false, found {str(is_fisheye)[:40]!r}")
    distortion = f"{section}.distortions", table.get("distortions")
    lens = read_lens((f"{section}.matrix", table["matrix"]), distortion, "fisheye" if is_fisheye else "plumb_bob")
    turn = np.ravel(np.asarray(table["rotation"], dtype=object))
    where = f"{section}.rotation"
    rotation = (
        rotation_from_vector(parse_numbers(where, turn, 3)) if turn.size == 3 else parse_numbers(where, turn, (3, 3))
    )
    translation = parse_numbers(f"{section}.translation", table["translation"], 3)
    return PosedCamera(section, lens, _whole(f"{section}.size", table.get("size")), rotation, translation)


# Metashape: XML of cameras.


def is_metashape(root: ElementTree.Element) -> bool:
    """Return whether an XML text is Metashape's."""
    return root.tag == "document" or (root.tag == "calibration" and root.find("projection") is not None)


def read_metashape(root: ElementTree.Element, chosen: tuple[str, str] | None) -> StatedCalibration:
    """Read the cameras that Metashape exports (Agisoft XML), tags in lower case.

    u = w/2 + cx + x'·(f + b1) + y'·b2 and v = h/2 + cy + y'·f, from the corner of the image. x' = x·(1 + k1·r² + k2·r⁴
    + k3·r⁶ + k4·r⁸) + p1·(r² + 2·x²) + 2·p2·x·y and y' likewise with p1 and p2 exchanged (Metashape User Manual,
    Appendix D), so that p1 is OpenCV's p2. For a fisheye camera x and y are multiplied by θ/r before. A camera's
    transform (4, 4) is x_chunk = T·x_camera; the chunk's scale makes it m.
    """
    chunk = root.find("chunk")
    if root.tag == "calibration" or chunk is None:
        expected = "Metashape's exported cameras, a chunk with sensors and cameras"
        raise ValueError(f"expected {expected}, found {'one lens alone' if root.tag == 'calibration' else 'no chunk'}")
    sensors = {sensor.get("id"): sensor for sensor in chunk.iterfind("sensors/sensor")}
    components = {component.get("id"): component for component in chunk.iterfind("components/component")}
    scales: dict[str | None, float | None] = {}

    def read(name: str, camera: ElementTree.Element) -> PosedCamera:
        matrix = parse_numbers(f"{name}: transform", str(camera.findtext("transform")).split(), (4, 4))
        sensor, component = sensors.get(camera.get("sensor_id")), camera.get("component_id")
        if sensor is None:
            raise ValueError(f"{name}: expected one of the file's sensors, found {str(camera.get('sensor_id'))[:40]}")
        scales[component] = _metashape_scale(chunk, components.get(component))
        lens, size = _metashape_lens(name, sensor)
        turn = matrix[:3, :3].T
        return PosedCamera(name, lens, size, turn, -turn @ matrix[:3, 3] * (scales[component] or 1.0))

    cameras = [
        (name, partial(read, name, camera))
        for camera in chunk.iter("camera")
        if camera.find("transform") is not None and (name := str(camera.get("label", camera.get("id"))))
    ]
    stated = pair_of("Metashape", cameras, chosen, None)
    if len(scales) > 1:
        raise ValueError("cameras: expected two cameras of one component, found them in two")
    if next(iter(scales.values())) is not None:
        return replace(stated, habit="m")
    return replace(stated, notices=(Notice(ARBITRARY_SCALE, "extrinsics", program="Metashape"),))


def _metashape_scale(chunk: ElementTree.Element, component: ElementTree.Element | None) -> float | None:
    """Return the scale of a camera's component or else of the chunk, None without one."""
    for part in (component, chunk):
        text = None if part is None else part.findtext("transform/scale")
        if text is not None:
            scale = float(parse_numbers("transform scale", text.split(), 1)[0])
            if not scale > 0:
                raise ValueError(f"transform scale: expected a number above 0, found {scale:g}")
            return scale
    return None


def _metashape_lens(name: str, sensor: ElementTree.Element) -> tuple[Lens, tuple[int, int]]:
    """Return lens and image size of a sensor, the adjusted ones if there are several."""
    offered = [each for each in sensor.iterfind("calibration") if each.find("f") is not None]
    if not offered:
        raise ValueError(f"{name}: expected a sensor with a calibration, found none: align the photos in Metashape")
    calibration = max(offered, key=lambda each: each.get("class") == "adjusted")
    kind = calibration.get("type", sensor.get("type", "frame"))
    if kind not in ("frame", "fisheye"):
        raise ValueError(f"{name}: expected a camera of the type frame or fisheye, found {kind[:40]}")
    values = dict.fromkeys(("f", "cx", "cy", "b1", "b2", "k1", "k2", "k3", "k4", "p1", "p2", "p3", "p4"), 0.0)
    for key in values:
        text = calibration.findtext(key)
        if text is not None:
            values[key] = float(parse_numbers(f"{name}: {key}", text.split(), 1)[0])
    if values["p3"] or values["p4"]:
        raise ValueError(f"{name}: expected a lens without p3 and p4, found {values['p3']:g} and {values['p4']:g}")
    resolution = calibration.find("resolution")
    resolution = sensor.find("resolution") if resolution is None else resolution
    stated = {} if resolution is None else resolution.attrib
    size = _whole(f"{name}: resolution", [stated.get("width"), stated.get("height")])
    centre = np.array(size) / 2 + [values["cx"], values["cy"]] - _HALF_PX
    focal = np.array([values["f"] + values["b1"], values["f"]])
    tangential, radial = np.array([values["p2"], values["p1"]]), np.array([values[f"k{k}"] for k in range(1, 5)])
    if kind == "fisheye":
        return Lens(focal, centre, tangential=tangential, skew_px=values["b2"], angular=radial), size
    four = values["k4"] != 0
    exponents = FOUR_POWERS if four else FOUR_POWERS[:3]
    return Lens(focal, centre, radial[: len(exponents)], tangential, values["b2"], exponents), size
