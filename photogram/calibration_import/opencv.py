"""OpenCV: FileStorage in YAML, XML or JSON, and plain JSON with the same content in lists."""

from __future__ import annotations

import json
import re
from collections.abc import Iterator
from typing import Any

import numpy as np

from photogram._checks import FloatArray
from photogram.calibration_import.build import Found, numbers
from photogram.calibration_import.lens import Lens
from photogram.rigid import rotation_from_vector

FORMAT = "OpenCV"
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


def read_opencv(text: str, extrinsics: str | None = None) -> Found:
    """Return what an OpenCV file holds: matrices and distortions of two cameras, R and T with x₂ = R·x₁ + T.

    Names in any of the usual spellings (M1 D1 M2 D2 R T, cameraMatrix1 distCoeffs1, K_left, mtxL, left: {…}); a
    rotation vector is accepted for R. Distortion in OpenCV's order k1 k2 p1 p2 k3; later coefficients must be zero.
    """
    values = _values(text)
    if extrinsics is not None:
        values |= _values(extrinsics)
    matrices, distortions = _pair(values, _MATRICES, "M1 and M2"), _pair(values, _DISTORTIONS, "D1 and D2")
    lenses = [_lens(matrix, distortion) for matrix, distortion in zip(matrices, distortions, strict=True)]
    size = _size(values)
    rotation_name, rotation = _one(values, _ROTATIONS, "rotation R")
    translation_name, translation = _one(values, _TRANSLATIONS, "translation T")
    return Found(
        FORMAT,
        (lenses[0], lenses[1]),
        (size, size),
        _rotation(rotation_name, rotation),
        numbers(translation_name, translation, 3),
        None,
    )


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
    elif _is_array(content):
        yield prefix, content["data"]
    else:
        for name, value in content.items():
            yield from _flat(f"{prefix}.{name}" if prefix else name, value)


def _is_array(content: dict[str, Any]) -> bool:
    """Whether a map is an OpenCV matrix: two-dimensional, or of any dimension as OpenCV 5 writes vectors."""
    return "data" in content and ("rows" in content or "sizes" in content)


def _storage(text: str) -> dict[str, Any]:
    """Return the content of a FileStorage text as nested objects."""
    import cv2

    level = cv2.utils.logging.getLogLevel()
    cv2.utils.logging.setLogLevel(cv2.utils.logging.LOG_LEVEL_SILENT)
    try:
        storage = cv2.FileStorage(text, cv2.FILE_STORAGE_READ | cv2.FILE_STORAGE_MEMORY)
        return dict(_children(storage.root()))
    except (SystemError, cv2.error) as error:
        raise ValueError("expected an OpenCV FileStorage text, found one that OpenCV cannot parse") from error
    finally:
        cv2.utils.logging.setLogLevel(level)


def _children(node: Any) -> Iterator[tuple[str, Any]]:
    """Yield name and content of everything in a map."""
    names = node.keys()
    for name in names:
        yield name, _node(node.getNode(name))


def _node(node: Any) -> Any:
    """Return a node as number, text, list, array, or object of such."""
    if node.isMap():
        children = dict(_children(node))
        return np.asarray(node.mat(), dtype=np.float64) if _is_array(children) else children
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


def _rotation(name: str, value: Any) -> FloatArray:
    """Return R of a matrix or of a rotation vector."""
    if np.size(np.asarray(value, dtype=object)) == 3:
        return rotation_from_vector(numbers(name, value, 3))
    return numbers(name, value, (3, 3))


def _size(values: Values) -> tuple[int, int] | None:
    """Return width and height where the file holds them."""
    for name in _SIZES:
        if name in values:
            width, height = numbers(values[name][0], values[name][1], 2)
            return int(width), int(height)
    width_value = [values[name] for name in _WIDTHS if name in values]
    height_value = [values[name] for name in _HEIGHTS if name in values]
    if not (width_value and height_value):
        return None
    return int(numbers(*width_value[0], 1)[0]), int(numbers(*height_value[0], 1)[0])
