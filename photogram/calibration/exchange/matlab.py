"""Calibrations of MATLAB, as JSON or `.mat`, and of Bouguet's toolbox for it."""

from __future__ import annotations

import re
import warnings
from pathlib import Path
from typing import Any

import numpy as np

from photogram.calibration.exchange.lens import NO_ROTATION, SIDES, Lens, StatedCalibration, parse_numbers, unit_of
from photogram.geometry import rotation_from_vector
from shakercal._common.arrays import FloatArray
from shakercal._common.mat5 import check_mat5

# MATLAB: stereoParameters as JSON, and Bouguet's calibration toolbox as text.

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
    from scipy.io import loadmat
    from scipy.io.matlab import MatlabOpaque

    check_mat5(path, _LARGEST_UNPACKED, _MOST_ARRAYS)
    try:
        with path.open("rb") as file:
            is_hdf5 = file.read(10) == b"MATLAB 7.3"
        if is_hdf5 and _has_external_data(path):
            raise _ExternalDataError
        if not is_hdf5:
            found = loadmat(path, simplify_cells=True)
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
