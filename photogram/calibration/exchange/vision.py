"""Calibrations of computer vision: OpenCV, ROS `camera_info`, Kalibr, MATLAB, Bouguet's toolbox."""

from __future__ import annotations

import json
import re
import warnings
from collections.abc import Callable, Iterator
from functools import partial
from itertools import count
from pathlib import Path
from typing import Any

import numpy as np

from photogram.calibration.exchange.lens import (
    NO_ROTATION,
    SIDES,
    DistortionModel,
    Lens,
    StatedCalibration,
    parse_numbers,
    unit_of,
)
from photogram.geometry import rotation_from_vector
from shakercal._common.arrays import FloatArray
from shakercal._common.mat5 import check_mat5, load_mat

# OpenCV: FileStorage in YAML, XML or JSON, and plain JSON with the same content in lists.

_MATRICES = ("cameramatrix", "cammatrix", "intrinsicmatrix", "intrinsics", "camera", "matrix", "mtx", "cm", "m", "k")
_DISTORTIONS = (
    *("distcoeffs", "distcoeff", "distortioncoefficients", "distortioncoeffs", "distortionvector"),
    *("distortion", "dist", "d"),
)
_SIDES = (("1", "2"), ("left", "right"), ("l", "r"), ("0", "1"), ("camera0", "camera1"), ("camera1", "camera2"))
_ROTATIONS = ("r", "rotation", "rotationmatrix", "rmat", "stereor", "rvec")
_TRANSLATIONS = ("t", "translation", "translationvector", "tvec", "stereot")
_SIZES = ("imagesize", "imgsize", "size", "resolution")
_WIDTHS, _HEIGHTS = ("imagewidth", "imgwidth", "width", "w"), ("imageheight", "imgheight", "height", "h")
_UNITS = ("lengthunit", "worldunits")
_BEYOND = ("s1", "s2", "s3", "s4", "tauX", "tauY")
_LENGTHS = (4, 5, 8, 12, 14)  # numbers of OpenCV's distortion coefficients
_FEW = 4  # coefficients: k1 k2 p1 p2, or a fisheye lens's k1 k2 k3 k4
_MODEL_KEY = re.compile(r"(distortion|camera|lens)(model|type)|fisheye|^model$")
_FLAG_KEY = re.compile(r"distortiontype|fisheye")  # keys whose number is a model: 0 or 1 (OpenCV's sample, MC-Calib)
_MODELS: dict[str, DistortionModel | None] = {  # None: no statement about the distortion
    **dict.fromkeys(("plumbbob", "radtan", "radialtangential", "brown", "brownconrady", "opencv"), "plumb_bob"),
    **dict.fromkeys(("rational", "rationalpolynomial", "fullopencv", "none", "0", "false", "no"), "plumb_bob"),
    **dict.fromkeys(("fisheye", "equidistant", "equi", "kannalabrandt", "1", "true", "yes"), "fisheye"),
    **dict.fromkeys(("pinhole", "perspective"), None),
}
_OTHER_MODELS = re.compile(r"omni|^mei|^ds$|doublesphere|^eucm|scaramuzza|ocam|fov|division|thinprism|kannala|fisheye")
_DEEPEST = 500  # levels; OpenCV's parser crashes beyond about 30 000
_LONGEST = 2000  # elements of one list or object; a file may also contain image points
_MOST_VALUES = 500_000  # of a whole file; a calibration has some hundred
_LARGEST_YAML = 2**18  # characters; PyYAML reads about 50 000 per second

Values = dict[str, tuple[str, Any]]
"""Values of a file by simplified name, each with its name in the file."""


def read_opencv(
    content: str | dict[str, Any], extrinsics: str | None = None, model: DistortionModel | None = None
) -> StatedCalibration:
    """Read an OpenCV file: matrices and distortions of two cameras, x₂ = R·x₁ + T.

    Names are in any of the usual spellings (M1 D1 M2 D2 R T, cameraMatrix1 distCoeffs1, K_left, mtxL, left: {…}); a
    rotation vector is accepted for R. Distortion in OpenCV's order k1 k2 p1 p2 k3 k4 k5 k6; later coefficients, of thin
    prisms and tilted sensors, must be zero. Four coefficients are k1 k2 p1 p2 or those of OpenCV's fisheye module.
    Their numbers do not distinguish them: a key such as `distortion_model` or `fisheye_model`, or the caller, states
    the model. `length_unit` is an extension of this program. `content`: the text, or arrays by name.
    """
    values = _values(content)
    if extrinsics is not None:
        values |= _values(extrinsics)
    matrices, distortions = _pair(values, _MATRICES, "M1 and M2"), _pair(values, _DISTORTIONS, "D1 and D2")
    model = _model(values, model)
    left, right = (
        read_lens(matrix, distortion, model) for matrix, distortion in zip(matrices, distortions, strict=True)
    )
    sizes = _sizes(values)
    name, value = _one(values, _ROTATIONS, "rotation R")
    is_vector = np.size(np.asarray(value, dtype=object)) == 3
    rotation = rotation_from_vector(parse_numbers(name, value, 3)) if is_vector else parse_numbers(name, value, (3, 3))
    translation = parse_numbers(*_one(values, _TRANSLATIONS, "translation T"), 3)
    stated = next((str(values[name][1]) for name in _UNITS if name in values), None)
    essentials = [values[name] for name in ("e", "essential", "essentialmatrix") if name in values]
    essential = next(((name, parse_numbers(name, value, (3, 3))) for name, value in essentials), None)
    unit = unit_of(stated)
    return StatedCalibration("OpenCV", (left, right), sizes, rotation, translation, unit, essential=essential)


def _model(values: Values, requested: DistortionModel | None) -> DistortionModel | None:
    """Return the distortion model of a file's keys or of the caller, None if unknown."""
    found: dict[DistortionModel, str] = {} if requested is None else {requested: f"{requested} as requested"}
    for name, (key, value) in values.items():
        if re.fullmatch(r"xi(\d|l|r|left|right)?|(left|right|camera\d)xi", name):
            raise ValueError(f"{key}: expected a pinhole or a fisheye lens, found one of the omnidirectional model")
        number = isinstance(value, float | int) and not isinstance(value, bool)
        if not (_FLAG_KEY if number else _MODEL_KEY).search(name) or not isinstance(value, str | float | int):
            continue
        word = re.sub(r"[^a-z0-9]", "", f"{value:g}" if number else str(value).lower())
        if word not in _MODELS and ("distortion" in name or _OTHER_MODELS.search(word)):
            expected = "plumb_bob, rational_polynomial or fisheye, the available models of distortion"
            raise ValueError(f"{key}: expected {expected}, found {str(value)[:40]}")
        stated = _MODELS.get(word)
        if stated is not None:
            found.setdefault(stated, f"{key} = {str(value)[:40]}")
    if len(found) > 1:
        raise ValueError(f"distortion_model: expected one model of distortion, found {' and '.join(found.values())}")
    return next(iter(found), None)


def _values(text: str | dict[str, Any]) -> Values:
    """Return every value of a text, or of arrays by name."""
    if isinstance(text, dict):
        content: Any = text
    elif text.lstrip().startswith(("{", "[")):
        content = parse_json(text)
    else:
        content = _storage(text) if text.lstrip().startswith(("%YAML", "<")) else parse_yaml(text)
    return {re.sub(r"[^a-z0-9]", "", str(name).lower()): (str(name), value) for name, value in _flat("", content)}


def parse_json(text: str) -> Any:
    """Return the content of a JSON text."""
    try:
        return json.loads(text)
    except (ValueError, RecursionError) as error:
        raise ValueError(f"expected a JSON text, found: {error}") from error


def _flat(prefix: str, content: Any) -> Iterator[tuple[str, Any]]:
    """Yield name and value of everything; names of nested objects are joined by points."""
    if not isinstance(content, dict):
        yield prefix, content
    elif "data" in content and ("rows" in content or "sizes" in content):  # a matrix; a vector of OpenCV 5
        yield prefix, content["data"]
    else:
        for name, value in content.items():
            yield from _flat(f"{prefix}.{name}" if prefix else name, value)


def _storage(text: str) -> Any:
    """Return the content of a FileStorage text as nested objects.

    OpenCV's parser is recursive without a limit and can crash the process. A YAML text that may have more than
    `_DEEPEST` levels is therefore refused before: levels by brackets, by indents, and by names and dashes on one line.
    XML is checked by the caller.
    """
    import cv2

    if not text.lstrip().startswith("<"):
        lines = [line for line in text.splitlines() if not line.lstrip().startswith("#")]
        indents = {len(line) - len(line.lstrip()) for line in lines}
        pieces = re.split(r"[\n,\[\]{}]", "\n".join(lines))
        levels = max((1 + piece.count(":") + piece.count("- ") for piece in pieces), default=1)
        if max(len(indents), 1) * levels > _DEEPEST:
            raise ValueError("expected an OpenCV FileStorage text, found one nested too deep for it")
    level = cv2.utils.logging.getLogLevel()
    cv2.utils.logging.setLogLevel(cv2.utils.logging.LOG_LEVEL_SILENT)
    try:
        storage = cv2.FileStorage(text, cv2.FILE_STORAGE_READ | cv2.FILE_STORAGE_MEMORY)  # its nodes require it
        return _node(storage.root(), count())
    except (SystemError, cv2.error) as error:
        raise ValueError("expected an OpenCV FileStorage text, found one that OpenCV cannot parse") from error
    finally:
        cv2.utils.logging.setLogLevel(level)


def _node(node: Any, visited: Iterator[int]) -> Any:
    """Return a node of a FileStorage as plain value, None if it is long.

    Every access to an element walks the list to it.
    """
    if next(visited) > _MOST_VALUES:
        raise ValueError(f"expected at most {_MOST_VALUES} values in a calibration, found more")
    if (node.isMap() or node.isSeq()) and node.size() > _LONGEST:
        return None
    if node.isMap():
        names = node.keys()
        return {name: _node(node.getNode(name), visited) for name in names}
    if node.isSeq():
        return [_node(node.at(index), visited) for index in range(node.size())]
    return node.string() if node.isString() else node.real()


def _pair(values: Values, names: tuple[str, ...], what: str) -> tuple[tuple[str, Any], tuple[str, Any]]:
    """Return the values of the left and the right camera, or raise `ValueError`."""
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


def read_lens(matrix: tuple[str, Any], distortion: tuple[str, Any], model: DistortionModel | None) -> Lens:
    """Return one camera's lens; four coefficients need a model."""
    name, value = matrix
    k = parse_numbers(name, value, (3, 3))
    where = name
    name, value = distortion
    length = np.size(np.asarray(value, dtype=object))
    if length not in _LENGTHS:
        raise ValueError(f"{name}: expected {', '.join(map(str, _LENGTHS))} coefficients, found {length}")
    coefficients = parse_numbers(name, value, length)
    if model == "fisheye":
        if length != _FEW:
            raise ValueError(f"{name}: expected the {_FEW} coefficients of a fisheye lens, found {length}")
        return Lens.from_matrix(where, k, angular=coefficients)
    if length == _FEW and model is None:
        found = f"4 coefficients in {name}: k1 k2 p1 p2 (plumb_bob) or k1 k2 k3 k4 (fisheye)"
        raise ValueError(f"distortion_model: expected plumb_bob or fisheye, found none for {found}")
    for label, coefficient in zip(_BEYOND, coefficients[8:], strict=False):
        if coefficient != 0:
            of = "a tilted sensor (Scheimpflug)" if label.startswith("tau") else "a thin prism"
            raise ValueError(
                f"{name}: expected the distortion k1 k2 p1 p2 k3 k4 k5 k6, found {label} = {coefficient:g} of {of}; "
                "calibrate without it"
            )
    k1, k2, p1, p2, k3, *divisor = np.concatenate([coefficients, np.zeros(4)])[:8]
    radial, tangential = np.array([k1, k2, k3]), np.array([p1, p2])
    return Lens.from_matrix(where, k, radial=radial, tangential=tangential, divisor=np.array(divisor))


def _sizes(values: Values) -> tuple[tuple[int, int] | None, tuple[int, int] | None]:
    """Return width and height of each camera's images, if the file has them."""
    for sides in _SIDES:
        for spelling in ("{name}{side}", "{side}{name}"):
            first, second = (_size(values, partial(spelling.format, side=side)) for side in sides)
            if first is not None and second is not None:
                return first, second
    size = _size(values, "{name}".format)
    return size, size


def _size(values: Values, spelled: Callable[..., str]) -> tuple[int, int] | None:
    """Return width and height under one spelling of the names."""
    for name in _SIZES:
        if (key := spelled(name=name)) in values:
            width, height = parse_numbers(*values[key], 2)
            return int(width), int(height)
    spellings = ([spelled(name=name) for name in names] for names in (_WIDTHS, _HEIGHTS))
    sides = [next((values[name] for name in names if name in values), None) for names in spellings]
    whole = [int(parse_numbers(*side, 1)[0]) for side in sides if side is not None]
    return (whole[0], whole[1]) if len(whole) == 2 else None


# ROS and Kalibr: YAML.

_ROS_MODELS: dict[str, tuple[tuple[int, ...], DistortionModel]] = {  # numbers of coefficients and OpenCV's model
    "plumb_bob": ((5, 4), "plumb_bob"),
    "rational_polynomial": ((8,), "plumb_bob"),
    "equidistant": ((4,), "fisheye"),
    "fisheye": ((4,), "fisheye"),
}
_POSE_KEYS = ("T_cn_cnm1", "T_cam_imu", "T_imu_cam")


def parse_yaml(text: str) -> dict[str, Any]:
    """Return the content of a YAML text of plain values, without references."""
    try:
        import yaml
    except ImportError as error:
        raise ValueError(
            "expected the package PyYAML, which reads YAML, found none; install shakercal[formats]"
        ) from error
    if len(text) > _LARGEST_YAML:
        raise ValueError(f"expected a YAML text of at most {_LARGEST_YAML >> 10} kB, found {len(text) >> 10} kB")
    body = re.sub(r"\A%YAML:1\.0[^\n]*\n", "", text)  # OpenCV's header is not valid YAML
    references = False
    try:
        references = any(isinstance(token, yaml.AliasToken) for token in yaml.scan(body))
        content = None if references else yaml.safe_load(body)
    except Exception as error:  # damaged texts lead to any exception
        raise ValueError(f"expected a YAML text, found: {' '.join(str(error).split())[:200]}") from error
    if references:
        raise ValueError("expected a YAML text without references, found one")
    if not isinstance(content, dict):
        raise ValueError(f"expected a YAML text of named values, found {str(content)[:40]!r}")
    return content


def read_ros(text: str, second: str | None) -> StatedCalibration:
    """Read the `camera_info` files of a left and a right camera (sensor_msgs/CameraInfo, REP 104).

    Lengths in m. The rectifying rotations transform both cameras into one frame, x_rect = R·x, in which P of the right
    one has the baseline, P₁₄ = fx·B: x_right = R_rightᵀ·(R_left·x_left + (B, 0, 0)).
    """
    if second is None:
        raise ValueError("camera_info: expected the right camera's file as the second file, found the left one alone")
    rotations, shifts, lenses, sizes = [], [], [], []
    for side, content in (("left", parse_yaml(text)), ("right", parse_yaml(second))):
        kind = str(content.get("distortion_model"))
        if kind not in _ROS_MODELS:
            raise ValueError(f"{side} distortion_model: expected {' or '.join(_ROS_MODELS)}, found {kind[:40]}")
        names = "camera_matrix", "distortion_coefficients", "rectification_matrix", "projection_matrix"
        matrix, distortion, rectification, projection = (_ros_data(side, content, name) for name in names)
        lengths, model = _ROS_MODELS[kind]
        if (length := np.size(np.asarray(distortion[1], dtype=object))) not in lengths:
            raise ValueError(f"{distortion[0]}: expected {lengths[0]} coefficients for {kind}, found {length}")
        lenses.append(read_lens(matrix, distortion, model))
        for key, value in _reduced(content):
            expected = "the value of full-size images, to which camera_matrix refers"
            raise ValueError(f"{side} {key}: expected {expected}, found {value:g}")
        rotations.append(parse_numbers(*rectification, (3, 3)))
        p = parse_numbers(*projection, (3, 4))
        if not p[0, 0] > 0:
            raise ValueError(f"{projection[0]}: expected a focal length above 0, found {p[0, 0]:g}")
        shifts.append(p[0, 3] / p[0, 0])
        size = parse_numbers(
            f"{side} image_width, image_height", [content.get(f"image_{n}") for n in ("width", "height")], 2
        )
        sizes.append((int(size[0]), int(size[1])))
    if shifts[0] == shifts[1]:
        raise ValueError("projection_matrix: expected a baseline of a stereo pair, found two single cameras")
    back = np.linalg.inv(rotations[1])
    translation = back @ np.array([shifts[1] - shifts[0], 0.0, 0.0])
    pair, both = (lenses[0], lenses[1]), (sizes[0], sizes[1])
    return StatedCalibration("ROS", pair, both, back @ rotations[0], translation, None, habit="m")


def _reduced(content: dict[str, Any]) -> Iterator[tuple[str, float]]:
    """Yield the keys of binned or cropped images, to which `camera_matrix` does not refer."""
    region = content.get("roi")
    parts = region if isinstance(region, dict) else {}
    for key, value, whole in (
        *((key, content.get(key), (0, 1)) for key in ("binning_x", "binning_y")),
        *((f"roi.{key}", parts.get(key), (0,)) for key in ("x_offset", "y_offset")),
    ):
        if value is not None and float(parse_numbers(key, value, 1)[0]) not in whole:
            yield key, float(value)


def _ros_data(side: str, content: dict[str, Any], name: str) -> tuple[str, Any]:
    """Return name and numbers of one matrix of a camera."""
    value = content.get(name)
    if not isinstance(value, dict) or "data" not in value:
        raise ValueError(f"{side} {name}: expected rows, cols and data, found {str(value)[:40]}")
    return f"{side} {name}", value["data"]


def read_kalibr(text: str) -> StatedCalibration:
    """Read a Kalibr camchain of two pinhole cameras: `radtan`, `equidistant` or `none`.

    Lengths in m. `T_cn_cnm1` (4, 4): x_cam1 = T·x_cam0. Otherwise both cameras have `T_cam_imu`, x_cam = T·x_imu, or
    its inverse `T_imu_cam`.
    """
    content = parse_yaml(text)
    names = sorted(name for name in content if re.fullmatch(r"cam\d+", str(name)))
    if names != ["cam0", "cam1"]:
        raise ValueError(f"camchain: expected cam0 and cam1, found {', '.join(names) or 'none'}")
    lenses, sizes, poses = [], [], []
    for name in names:
        camera = content[name]
        if not isinstance(camera, dict):
            raise ValueError(f"{name}: expected named values, found {str(camera)[:40]!r}")
        models = camera.get("camera_model"), camera.get("distortion_model")
        if models[0] != "pinhole" or models[1] not in ("radtan", "equidistant", "none"):
            expected = "a camera pinhole-radtan, pinhole-equidistant or pinhole-none"
            raise ValueError(f"{name}: expected {expected}, found {models[0]}-{models[1]}")
        fx, fy, cx, cy = parse_numbers(f"{name}.intrinsics", camera.get("intrinsics"), 4)
        k = np.zeros(4)
        if models[1] != "none":
            k = parse_numbers(f"{name}.distortion_coeffs", camera.get("distortion_coeffs"), 4)
        centre = np.array([[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]])
        of_angle = models[1] == "equidistant"
        shape = {"angular": k} if of_angle else {"radial": np.array([*k[:2], 0.0]), "tangential": k[2:]}
        lenses.append(Lens.from_matrix(name, centre, **shape))
        width, height = parse_numbers(f"{name}.resolution", camera.get("resolution"), 2)
        sizes.append((int(width), int(height)))
        poses.append(
            {key: _pose_matrix(f"{name}.{key}", camera[key]) for key in _POSE_KEYS if camera.get(key) is not None}
        )
    if "T_cn_cnm1" in poses[1]:
        between = poses[1]["T_cn_cnm1"]
    elif "T_cam_imu" in poses[0] and "T_cam_imu" in poses[1]:
        between = poses[1]["T_cam_imu"] @ np.linalg.inv(poses[0]["T_cam_imu"])
    elif "T_imu_cam" in poses[0] and "T_imu_cam" in poses[1]:
        between = np.linalg.inv(poses[1]["T_imu_cam"]) @ poses[0]["T_imu_cam"]
    else:
        raise ValueError(f"cam1: expected its pose relative to cam0, one of {', '.join(_POSE_KEYS)}, found none")
    pair, both = (lenses[0], lenses[1]), (sizes[0], sizes[1])
    return StatedCalibration("Kalibr", pair, both, between[:3, :3], between[:3, 3], None, habit="m")


def _pose_matrix(where: str, value: Any) -> FloatArray:
    """Return a transform (4, 4) after a check that it can be inverted."""
    matrix = parse_numbers(where, value, (4, 4))
    if not np.array_equal(matrix[3], [0, 0, 0, 1]) or abs(np.linalg.det(matrix)) < 0.5:
        raise ValueError(f"{where}: expected a rigid transform with a last row 0 0 0 1, found {matrix.tolist()}")
    return matrix


# MATLAB: stereoParameters as JSON or `.mat`, and Bouguet's calibration toolbox as text or `.mat`.

_LARGEST_UNPACKED, _MOST_ARRAYS = 2**26, 3000  # bytes and arrays; a calibration with its images' points has some MB
_ASSIGNMENT = re.compile(r"\b([A-Za-z]\w*)\s*=\s*(?:\[([^\[\]]*)\]|([-+]?[\d.][\w.+-]*))")


def read_matlab(content: dict[str, Any]) -> StatedCalibration:
    """Read jsonencode(toStruct(stereoParams)) or jsonencode(stereoParams).

    Pixels count from 1, so 1 is subtracted from the principal point (MathWorks, `stereoParametersToOpenCV`). `K` is the
    camera matrix and `PoseCamera2` has x₂ = R·x₁ + T. The older `IntrinsicMatrix` and `RotationOfCamera2` are the
    transposed ones, x₂ᵀ = x₁ᵀ·R + T. An `EssentialMatrix` in the file must agree with R and T.
    """
    (left, left_size, unit), (right, right_size, _) = (
        _matlab_camera(name, content.get(name)) for name in ("CameraParameters1", "CameraParameters2")
    )
    rotation, translation = _extrinsics(content)
    name, essential = "EssentialMatrix", content.get("EssentialMatrix")
    given = None if essential is None else (name, parse_numbers(name, essential, (3, 3)))
    word = str(content.get("WorldUnits", unit))
    file_unit, sizes = unit_of(word), (left_size, right_size)
    stated = None if file_unit == "mm" else file_unit  # millimetres are also MATLAB's default unit
    return StatedCalibration(
        "MATLAB", (left, right), sizes, rotation, translation, stated, habit=file_unit, essential=given
    )


def read_mat(path: Path) -> StatedCalibration:
    """Read a `.mat` file: stereoParameters, its toStruct, or the toolbox's variables."""
    variables = _variables(path)
    for value in variables.values():
        if isinstance(value, dict) and "CameraParameters1" in value:
            return read_matlab(value)
    if "fc_left" in variables:
        return _bouguet({name: np.asarray(value).ravel() for name, value in variables.items()})
    names = ", ".join(sorted(variables)[:8]) or "none"
    raise ValueError(f"expected a variable with stereoParameters, or fc_left and the like, found {names}")


class _ExternalDataError(Exception):
    """A file refers to data in other files."""


def _has_external_data(path: Path) -> bool:
    """Return whether an HDF5 file (version 7.3) refers to data in other files."""
    import h5py

    def is_external(_: str, node: Any) -> bool | None:
        return (isinstance(node, h5py.Dataset) and bool(node.is_virtual or node.external)) or None

    def linked(_: bytes, link: Any) -> bool | None:
        return link.type not in (h5py.h5l.TYPE_HARD, h5py.h5l.TYPE_SOFT) or None

    with h5py.File(path, "r") as file:
        return bool(file.id.links.visit(linked, info=True) or file.visititems(is_external))


def _variables(path: Path) -> dict[str, Any]:
    """Return the variables of a `.mat` file, structs and objects as dictionaries."""
    from scipy.io.matlab import MatlabOpaque

    check_mat5(path, _LARGEST_UNPACKED, _MOST_ARRAYS)
    try:
        with path.open("rb") as file:
            is_hdf5 = file.read(10) == b"MATLAB 7.3"
        if is_hdf5 and _has_external_data(path):
            raise _ExternalDataError
        if not is_hdf5:
            found = load_mat(path, simplify_cells=True)
            if not any(isinstance(value, MatlabOpaque) for value in found.values()):
                return {name: value for name, value in found.items() if not name.startswith("__")}
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            from matio import load_from_mat

            return {name: _plain(value) for name, value in load_from_mat(str(path)).items()}
    except ImportError as error:
        raise ValueError(
            "expected the package mat-io, which reads MATLAB's objects, found none; install shakercal[formats], or in "
            "MATLAB write jsonencode(toStruct(stereoParams)) to a file and import that"
        ) from error
    except _ExternalDataError as error:
        raise ValueError("expected data in this file, found some in other files") from error
    except Exception as error:  # damaged bytes lead to any exception of the readers
        raise ValueError(f"expected a .mat file that can be read, found {type(error).__name__} in it") from error


def _plain(value: Any, depth: int = 0) -> Any:
    """Return MATLAB's objects and structs as dictionaries, with the fields of `any`."""
    if depth > 12:
        return None
    if hasattr(value, "properties"):
        value = value.properties
    if isinstance(value, np.ndarray) and value.size == 1 and (value.dtype == object or value.dtype.names):
        return _plain(value.ravel()[0], depth + 1)
    if isinstance(value, np.void) and value.dtype.names:
        value = {name: value[name] for name in value.dtype.names}
    if not isinstance(value, dict):
        return value.tolist() if isinstance(value, np.ndarray) and value.dtype != object else value
    fields = {str(name): _plain(part, depth + 1) for name, part in value.items()}
    inner = fields.pop("any", None)
    return {**fields, **inner} if isinstance(inner, dict) else fields


def read_bouguet(text: str) -> StatedCalibration:
    """Read the assignments of Bouguet's stereo calibration: fc_left = [ … ], …, om, T.

    x_right = R(om)·x_left + T in mm; kc: k1 k2 p1 p2 k3; skew alpha_c·fc(1). The toolbox counts pixels from 0, since it
    subtracts 1 from every corner (`click_ima_calib.m`). `nx`, `ny`: optional image size.
    """
    uncommented = re.sub(r"^[ \t]*%.*$", "", text, flags=re.MULTILINE)
    values: dict[str, Any] = {}
    for name, inside, scalar in _ASSIGNMENT.findall(uncommented):
        values.setdefault(name, re.findall(r"[^\s,;]+", inside or scalar))
    return _bouguet(values)


def _bouguet(values: dict[str, Any]) -> StatedCalibration:
    """Return the calibration of the toolbox's variables."""

    def array(name: str, count: int) -> FloatArray:
        if name not in values:
            raise ValueError(f"{name}: missing")
        return parse_numbers(name, values[name], count)

    lenses = []
    for side in SIDES:
        focal, centre, kc = array(f"fc_{side}", 2), array(f"cc_{side}", 2), array(f"kc_{side}", 5)
        alpha = float(array(f"alpha_c_{side}", 1)[0]) if f"alpha_c_{side}" in values else 0.0
        lenses.append(Lens(focal, centre, kc[[0, 1, 4]], kc[2:4], skew_px=alpha * float(focal[0])))
    rotation = array("R", 9).reshape(3, 3) if "om" not in values else rotation_from_vector(array("om", 3))
    if "om" in values and "R" in values and not np.abs(array("R", 9).reshape(3, 3) - rotation).max() <= NO_ROTATION:
        raise ValueError("om: expected the rotation vector of R, found another")
    size = (int(array("nx", 1)[0]), int(array("ny", 1)[0])) if {"nx", "ny"} <= set(values) else None
    return StatedCalibration(
        "Bouguet's toolbox", (lenses[0], lenses[1]), (size, size), rotation, array("T", 3), None, habit="mm"
    )


def _matlab_camera(name: str, camera: Any) -> tuple[Lens, tuple[int, int] | None, str]:
    """Return one camera's lens, size and unit of lengths; pixels count from 0."""
    if not isinstance(camera, dict):
        raise ValueError(f"{name}: expected an object, found {str(camera)[:40]!r}")
    inner = camera.get("Intrinsics")
    parameters = {**camera, **inner} if isinstance(inner, dict) else camera
    if parameters.get("MappingCoefficients") is not None:
        found = "a fisheye lens by mapping coefficients (Scaramuzza's model)"
        raise ValueError(f"{name}: expected a pinhole camera (cameraParameters), found {found}")
    if parameters.get("K") is not None:
        k = parse_numbers(f"{name}.K", parameters["K"], (3, 3))
    elif parameters.get("IntrinsicMatrix") is not None:
        k = parse_numbers(f"{name}.IntrinsicMatrix", parameters["IntrinsicMatrix"], (3, 3)).T
    else:
        raise ValueError(f"{name}: expected K or IntrinsicMatrix, found neither")
    radial = np.zeros(3)
    coefficients = np.ravel(parameters.get("RadialDistortion", [0, 0]))
    if coefficients.size not in (2, 3):
        raise ValueError(f"{name}.RadialDistortion: expected 2 or 3 numbers, found {coefficients.size}")
    radial[: coefficients.size] = parse_numbers(f"{name}.RadialDistortion", coefficients, coefficients.size)
    tangential = parse_numbers(f"{name}.TangentialDistortion", parameters.get("TangentialDistortion", [0, 0]), 2)
    from_zero = k - [[0, 0, 1], [0, 0, 1], [0, 0, 0]]
    lens = Lens.from_matrix(name, from_zero, radial=radial, tangential=tangential)
    stated = parameters.get("ImageSize")
    size = np.ravel([] if stated is None else stated)
    rows, columns = parse_numbers(f"{name}.ImageSize", size, 2) if size.size else (0, 0)
    unit = "".join(np.ravel(camera.get("WorldUnits", "")).astype(str))
    return lens, (int(columns), int(rows)) if size.size else None, unit


def _extrinsics(content: dict[str, Any]) -> tuple[FloatArray, FloatArray]:
    """Return R and T of x₂ = R·x₁ + T."""
    pose = content.get("PoseCamera2")
    if isinstance(pose, dict):
        if pose.get("A") is not None:
            matrix = parse_numbers("PoseCamera2.A", pose["A"], (4, 4))
            return matrix[:3, :3], matrix[:3, 3]
        rotation = parse_numbers("PoseCamera2.R", pose.get("R"), (3, 3))
        return rotation, parse_numbers("PoseCamera2.Translation", pose.get("Translation"), 3)
    if content.get("RotationOfCamera2") is None:
        raise ValueError("expected PoseCamera2, or RotationOfCamera2 and TranslationOfCamera2, found neither")
    rotation = parse_numbers("RotationOfCamera2", content["RotationOfCamera2"], (3, 3)).T
    return rotation, parse_numbers("TranslationOfCamera2", content.get("TranslationOfCamera2"), 3)
