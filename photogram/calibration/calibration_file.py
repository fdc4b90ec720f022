"""The stereo calibration file: checked JSON of format 1, written atomically."""

from __future__ import annotations

import json
import os
import secrets
from pathlib import Path
from typing import Any

import numpy as np

from photogram.calibration.calibration_result import Calibration
from photogram.camera import CAMERA_PARAMETERS, LEFT, RIG_PARAMETERS, Camera, StereoRig, undistort
from photogram.geometry import RigidTransform, nearest_rotation
from shakercal._common.arrays import FloatArray, check_shape

_LARGEST_FILE = 2**22  # bytes; a file of this program has about 20 kB
LARGEST = 1e12
"""Limit of every number in a calibration."""
_SHORTEST = 0.1  # focal length over the longer side of the image: a field of view of 158°
_WIDEST, _FOCAL = 100_000, 1e9  # px
_NEAR, _FAR = 1e-6, 1e4  # m
_KEYS = ("format", "image_size", "left", "right", "rotation", "translation", "reprojection_rms", "covariance")


def read_calibration(path: str | Path) -> StereoRig:
    """Read the stereo pair of a calibration file.

    Parameters
    ----------
    path
        JSON file of format 1, lengths in m, pixels in px.

    Returns
    -------
    The pair. Parameters that its covariance omits have variance zero. A rotation within 10⁻⁶ of an orthonormal matrix
    is replaced by the nearest exact one.

    Raises
    ------
    ValueError : Names file and key of unknown, missing or repeated keys, wrong shapes, a rotation that is none, or an
        implausible camera (`check_plausible`).

    Examples
    --------
    >>> from tempfile import TemporaryDirectory
    >>> camera = Camera.from_parameters(np.array([1000.0, 1000, 320, 240, 0, 0, 0, 0, 0]), np.array([640, 480]))
    >>> rig = StereoRig(camera, camera, RigidTransform(np.eye(3), np.array([-0.1, 0.0, 0.0])))
    >>> with TemporaryDirectory() as folder:
    ...     write_calibration(f"{folder}/rig.json", rig)
    ...     read_calibration(f"{folder}/rig.json").right_from_left.translation_m
    array([-0.1,  0. ,  0. ])
    """
    path = Path(path)
    content = _content(path)
    try:
        return check_plausible(_rig(content))
    except ValueError as error:
        raise ValueError(f"{path}: {error}") from error


def check_plausible(rig: StereoRig) -> StereoRig:
    """Return the pair unless its values are impossible for cameras.

    Images have up to 10⁵ px along a side. Focal lengths are within 1 and 10⁹ px, with a field of view below 158°.
    Cameras are within 1 µm and 10 km of each other. A ray leads to the centre of each image. Otherwise `ValueError`.
    """
    for side, camera in (("left", rig.left), ("right", rig.right)):
        if not ((camera.size_px >= 1) & (camera.size_px <= _WIDEST)).all():
            raise ValueError(f"image_size: expected 1 to {_WIDEST} px, found {camera.size_px.tolist()}")
        focal = np.diagonal(camera.matrix)[:2]
        if not ((focal >= 1.0) & (focal <= _FOCAL)).all():
            raise ValueError(f"{side}.matrix: expected focal lengths of 1 to {_FOCAL:g} px, found {focal.tolist()}")
        if focal.min() < _SHORTEST * camera.size_px.max():
            expected = f"focal lengths in px of at least {_SHORTEST:g} of the image's {camera.size_px.max()} px"
            raise ValueError(f"{side}.matrix: expected {expected}, found {focal.tolist()}: are they in mm?")
        middle = (camera.size_px - 1) / 2
        # Plain Python computes this one point: numba would slow down the import.
        if not np.isfinite(undistort.plain(*middle.tolist(), camera.parameters.tolist())).all():
            found = f"none: principal point {camera.matrix[:2, 2].tolist()}, distortion {camera.distortion.tolist()}"
            raise ValueError(f"{side}: expected a ray to the centre of the image, found {found}")
    distance = float(np.linalg.norm(rig.right_from_left.translation_m))
    if not _NEAR <= distance <= _FAR:
        expected = f"the right camera {_NEAR:g} to {_FAR:g} m from the left one"
        raise ValueError(f"translation: expected {expected}, found {distance:g} m")
    return rig


def write_calibration(path: str | Path, rig: StereoRig, reprojection_rms_px: float | None = None) -> None:
    """Write a stereo pair as a calibration file of format 1, in one atomic step.

    Parameters
    ----------
    path
        File to write.
    rig
        Stereo pair, with or without covariance.
    reprojection_rms_px
        Rms length of the residuals in px; default None.

    Examples
    --------
    >>> from tempfile import TemporaryDirectory
    >>> camera = Camera.from_parameters(np.array([1000.0, 1000, 320, 240, 0, 0, 0, 0, 0]), np.array([640, 480]))
    >>> rig = StereoRig(camera, camera, RigidTransform(np.eye(3), np.array([-0.1, 0.0, 0.0])))
    >>> with TemporaryDirectory() as folder:
    ...     write_calibration(f"{folder}/rig.json", rig, reprojection_rms_px=0.04)
    """
    sizes = [[int(length) for length in camera.size_px] for camera in (rig.left, rig.right)]
    # The lens's further terms, after the 24 parameters of every file, are written only if they are uncertain
    stated = [
        n for n in range(len(RIG_PARAMETERS)) if rig.covariance is not None and (n < 24 or rig.covariance[n, n] > 0)
    ]
    content = {
        "format": 1,
        "image_size": sizes[0] if sizes[0] == sizes[1] else sizes,
        "left": _lens(rig.left),
        "right": _lens(rig.right),
        "rotation": rig.right_from_left.rotation.tolist(),
        "translation": rig.right_from_left.translation_m.tolist(),
        "reprojection_rms": None if reprojection_rms_px is None else float(reprojection_rms_px),
        "covariance": None if rig.covariance is None else _block(rig.covariance, RIG_PARAMETERS, stated),
    }
    _write(Path(path), content)


_CAMERA_KEYS = ("format", "image_size", "camera", "reprojection_rms", "covariance")


def write_camera(path: str | Path, calibration: Calibration) -> None:
    """Write the left camera of a calibration as a file with its covariance.

    Its keys: format 1, image_size, camera (matrix, distortion), reprojection_rms, covariance (parameters, matrix).
    """
    camera, covariance = calibration.rig.left, calibration.rig.covariance
    assert covariance is not None
    covariance = covariance[np.ix_(LEFT, LEFT)]
    content = {
        "format": 1,
        "image_size": [int(size) for size in camera.size_px],
        "camera": _lens(camera),
        "reprojection_rms": calibration.rms_px,
        "covariance": _block(covariance, CAMERA_PARAMETERS, np.flatnonzero(np.diagonal(covariance) > 0).tolist()),
    }
    _write(Path(path), content)


def _block(covariance: FloatArray, names: tuple[str, ...], stated: list[int]) -> dict[str, Any]:
    """Return the keys of the covariance of the parameters `stated`."""
    return {"parameters": [names[n] for n in stated], "matrix": covariance[np.ix_(stated, stated)].tolist()}


def read_camera(path: str | Path) -> tuple[Camera, FloatArray]:
    """Return a single camera and the covariance (13, 13) of its parameters.

    The file is one of `write_camera` or of a stereo pair, whose left camera is used.
    """
    path = Path(path)
    content = _content(path)
    try:
        if isinstance(content, dict) and "left" in content:
            rig = check_plausible(_rig(content))
            whole = np.zeros((len(RIG_PARAMETERS),) * 2) if rig.covariance is None else rig.covariance
            return rig.left, whole[np.ix_(LEFT, LEFT)]
        _check_keys("", content, _CAMERA_KEYS)
        camera = _camera("camera", content["camera"], _size(content["image_size"]))
        covariance = _covariance(content["covariance"], CAMERA_PARAMETERS)
    except ValueError as error:
        raise ValueError(f"{path}: {error}") from error
    return camera, np.zeros((len(CAMERA_PARAMETERS),) * 2) if covariance is None else covariance


def is_single(path: str | Path) -> bool:
    """Return whether the keys of a file are those of a single camera (`write_camera`)."""
    content = _content(Path(path))
    return isinstance(content, dict) and "camera" in content and "left" not in content


def _content(path: Path) -> Any:
    """Return the content of a JSON text of limited size."""
    with path.open("rb") as file:
        text = file.read(_LARGEST_FILE + 1)
    try:
        if len(text) > _LARGEST_FILE:
            raise ValueError(f"more than {_LARGEST_FILE >> 20} MB")
        return json.loads(text.decode("utf-8"), object_pairs_hook=_without_repeats)
    except (ValueError, RecursionError) as error:
        raise ValueError(f"{path}: expected a JSON text, found: {error}") from error


def write_whole(path: Path, text: str) -> None:
    """Write a text under a temporary name and rename it.

    The name is random, since containers on one host share process numbers.
    """
    temporary = path.with_name(f"{path.name}.{secrets.token_hex(6)}.tmp")
    try:
        temporary.write_text(text, encoding="utf-8")
        os.replace(temporary, path)
    finally:
        temporary.unlink(missing_ok=True)


def _write(path: Path, content: dict[str, Any]) -> None:
    write_whole(path, json.dumps(content, indent=1, allow_nan=False) + "\n")


def _lens(camera: Camera) -> dict[str, Any]:
    """Return a camera's keys with five coefficients, or eight of a rational lens."""
    coefficients = camera.distortion if camera.distortion[5:].any() else camera.distortion[:5]
    return {"matrix": camera.matrix.tolist(), "distortion": coefficients.tolist()}


def _without_repeats(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    """Return the object of a JSON text; a repeated key is refused."""
    found: dict[str, Any] = {}
    for key, value in pairs:
        if key in found:
            raise ValueError(f"key {key!r:.60} occurs twice")
        found[key] = value
    return found


def _rig(content: Any) -> StereoRig:
    """Return the checked stereo pair of the parsed text."""
    _check_keys("", content, _KEYS)
    given = content["image_size"]
    both = isinstance(given, list) and len(given) == 2 and all(isinstance(part, list) for part in given)
    left, right = map(_size, given if both else [given, given])
    if content["reprojection_rms"] is not None:
        _numbers("reprojection_rms", content["reprojection_rms"], ())
    translation = _numbers("translation", content["translation"], (3,))
    pose = RigidTransform(_numbers("rotation", content["rotation"], (3, 3)), translation)
    return StereoRig(
        left=_camera("left", content["left"], left),
        right=_camera("right", content["right"], right),
        right_from_left=RigidTransform(nearest_rotation(pose.rotation), translation),
        covariance=_covariance(content["covariance"], RIG_PARAMETERS),
    )


def _size(found: Any) -> FloatArray:
    """Return the width and height of the images."""
    size = _numbers("image_size", found, (2,))
    if (size != np.round(size)).any() or (size < 1).any():
        raise ValueError(f"image_size: expected two integers in pixels, found {found!r:.60}")
    return size


def _check_keys(where: str, found: Any, expected: tuple[str, ...]) -> None:
    """Raise `ValueError` unless `found` is an object with the expected keys, of format 1."""
    prefix = f"{where}." if where else ""
    if not isinstance(found, dict):
        keys = ", ".join(expected)
        raise ValueError(f"{where or 'content'}: expected an object with keys {keys}, found {found!r:.60}")
    for key in found:
        if key not in expected:
            raise ValueError(f"{prefix}{key:.60}: unknown key, expected {', '.join(expected)}")
    for key in expected:
        if key not in found:
            raise ValueError(f"{prefix}{key}: missing key")
    if "format" in expected and (isinstance(found["format"], bool) or found["format"] != 1):
        raise ValueError(f"format: expected 1, found {found['format']!r:.60}")


def _numbers(where: str, found: Any, shape: tuple[int, ...], largest: float = LARGEST) -> FloatArray:
    """Return nested lists of JSON numbers as an array of the given shape."""
    try:
        array = np.asarray(_plain(where, found), dtype=np.float64)
    except (OverflowError, RecursionError) as error:
        raise ValueError(
            f"{where}: expected finite numbers, found one too large, or lists nested too deeply"
        ) from error
    check_shape(where, array, shape)
    if not (np.abs(array) <= largest).all():
        raise ValueError(f"{where}: expected finite numbers up to {largest:g}, found {array.ravel()[:16].tolist()}")
    return array


def _plain(where: str, found: Any) -> Any:
    """Return a number, or lists of equal length of numbers, unchanged."""
    if isinstance(found, list):
        parts = [_plain(where, part) for part in found]
        if len({len(part) if isinstance(part, list) else -1 for part in parts}) > 1:
            raise ValueError(f"{where}: expected rows of one length")
        return parts
    if isinstance(found, bool) or not isinstance(found, int | float):
        raise ValueError(f"{where}: expected numbers, found {found!r:.60}")
    return found


def _camera(side: str, found: Any, size: FloatArray) -> Camera:
    """Return the camera of one side."""
    _check_keys(side, found, ("matrix", "distortion"))
    matrix = _numbers(f"{side}.matrix", found["matrix"], (3, 3))
    given = found["distortion"]
    coefficients = 8 if isinstance(given, list) and len(given) == 8 else 5
    distortion = _numbers(f"{side}.distortion", given, (coefficients,))
    try:
        return Camera(matrix, distortion, size.astype(np.int64))
    except ValueError as error:
        raise ValueError(f"{side}.{error}") from error


def _covariance(found: Any, parameters: tuple[str, ...]) -> FloatArray | None:
    """Return the covariance (N, N), zero for parameters that the file omits."""
    if found is None:
        return None
    _check_keys("covariance", found, ("parameters", "matrix"))
    names = found["parameters"]
    if not isinstance(names, list) or not names:
        raise ValueError(f"covariance.parameters: expected a list of names, found {names!r:.60}")
    unknown = [name for name in names if name not in parameters]
    if unknown:
        raise ValueError(f"covariance.parameters: expected names like {parameters[0]!r}, found {unknown[0]!r:.60}")
    if len(set(names)) < len(names):
        raise ValueError("covariance.parameters: expected each name once, found one twice")
    matrix = _numbers("covariance.matrix", found["matrix"], (len(names), len(names)), LARGEST**2)
    full = np.zeros((len(parameters), len(parameters)))
    index = [parameters.index(name) for name in names]
    full[np.ix_(index, index)] = matrix
    return full
