"""From what a file holds to a stereo rig: units, rotations written with few digits, differences of camera models."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Literal

import numpy as np

from photogram._checks import FloatArray, IntArray
from photogram.calibration_import.lens import EVEN, Lens, Nearest, nearest_camera
from photogram.camera import StereoRig
from photogram.notice import Notice
from photogram.rigid import RigidTransform, nearest_rotation

LengthUnit = Literal["m", "mm"]
METRES = {"m": 1.0, "mm": 1e-3}
FEW_DIGITS = 1e-5  # departure from a rotation above which the user is told
NO_ROTATION = 1e-3  # and above which it is none
REMARKABLE_PX = 0.05  # difference between the file's camera and this program's that is worth a warning
UNUSABLE_PX = 0.5  # and that is refused


@dataclass(frozen=True, eq=False)
class ImportedCalibration:
    """A stereo pair read from another program's file, that file's format, and what the user should know."""

    rig: StereoRig
    format: str
    notices: tuple[Notice, ...]


@dataclass(frozen=True, eq=False)
class Found:
    """What a file holds: lenses, sizes (None where it has none), x_right = rotation·x_left + translation (file units).

    `unit` is the unit that the format fixes or its program uses, None where nobody can know.
    """

    format: str
    lenses: tuple[Lens, Lens]
    sizes_px: tuple[tuple[int, int] | None, tuple[int, int] | None]
    rotation: FloatArray
    translation: FloatArray
    unit: LengthUnit | None
    notices: tuple[Notice, ...] = ()


def build(found: Found, image_size: tuple[int, int] | None, length_unit: LengthUnit | None) -> ImportedCalibration:
    """Return the stereo rig of what was found in a file."""
    size = _size(found.sizes_px, image_size)
    unit = _unit(found, length_unit)
    rotation, notices = _rotation(found.rotation)
    nearest = [_nearest(side, lens, size) for side, lens in zip(("left", "right"), found.lenses, strict=True)]
    given = RigidTransform(rotation, found.translation * METRES[unit])
    turns = [RigidTransform.from_pose(np.array([0, 0, 0, 0, 0, side.turn_rad])) for side in nearest]
    rig = StereoRig(nearest[0].camera, nearest[1].camera, turns[1] @ given @ turns[0].inverse())
    remarks = [
        *found.notices,
        *notices,
        *(_model_notice(*each) for each in zip(("left", "right"), found.lenses, nearest, strict=True)),
        *_sanity(rig),
        _baseline(rig, unit),
        Notice(
            "info",
            "no uncertainties came with it: state scale_uncertainty under [stereo.NAME] in rig.toml",
            "covariance",
        ),
    ]
    return ImportedCalibration(rig, found.format, tuple(remark for remark in remarks if remark is not None))


def numbers(where: str, values: Any, count: int | tuple[int, ...]) -> FloatArray:
    """Return texts or numbers as an array of `count` elements or of that shape; `ValueError` names what is wrong."""
    shape = (count,) if isinstance(count, int) else count
    try:
        array = np.asarray(values, dtype=np.float64)
    except (TypeError, ValueError) as error:
        raise ValueError(f"{where}: expected {_shape_text(shape)}, found {str(values)[:60]!r}") from error
    if array.size != int(np.prod(shape)):
        raise ValueError(f"{where}: expected {_shape_text(shape)}, found {array.size}")
    if not np.isfinite(array).all():
        raise ValueError(f"{where}: expected finite numbers, found NaN or infinity")
    return array.reshape(shape)


def _shape_text(shape: tuple[int, ...]) -> str:
    """The shape in words."""
    return " x ".join(str(length) for length in shape) + " numbers"


def rotation_from_cardan(angles_deg: FloatArray) -> FloatArray:
    """Return R = R_z(γ)·R_y(β)·R_x(α) of the Cardan angles α, β, γ (3,) in degrees of VIC-3D and DICe.

    Dicengine, `Camera_Info::eulers_to_rotation_matrix`; the same matrix is in sdynpy's reader of VIC-3D projects.
    """
    (sa, sb, sc), (ca, cb, cc) = np.sin(np.deg2rad(angles_deg)), np.cos(np.deg2rad(angles_deg))
    about_x = np.array([[1, 0, 0], [0, ca, -sa], [0, sa, ca]])
    about_y = np.array([[cb, 0, sb], [0, 1, 0], [-sb, 0, cb]])
    about_z = np.array([[cc, -sc, 0], [sc, cc, 0], [0, 0, 1]])
    return np.asarray(about_z @ about_y @ about_x)


def right_from_left(
    left_from_world: tuple[FloatArray, FloatArray], right_from_world: tuple[FloatArray, FloatArray]
) -> tuple[FloatArray, FloatArray]:
    """Return rotation and translation from the left to the right camera, of two poses x_camera = R·x_world + t."""
    (left, left_t), (right, right_t) = left_from_world, right_from_world
    rotation = right @ np.linalg.inv(left)
    return rotation, right_t - rotation @ left_t


def _size(sizes: tuple[tuple[int, int] | None, ...], option: tuple[int, int] | None) -> IntArray:
    """Return the one image size (2,), width and height, from the file or from the caller."""
    found = {size for size in sizes if size is not None}
    if len(found) > 1:
        raise ValueError(f"image size: expected one for both cameras, found {_times(sizes[0])} and {_times(sizes[1])}")
    if not found and option is None:
        raise ValueError("image_size: expected width and height of the pictures, which the file does not hold")
    size = found.pop() if found else option
    if option is not None and size != option:
        raise ValueError(f"image_size: expected {_times(size)} as in the file, found {_times(option)}")
    return np.array(size, dtype=np.int64)


def _times(size: tuple[int, int] | None) -> str:
    """The size as users write it."""
    return "none" if size is None else f"{size[0]}x{size[1]}"


def _unit(found: Found, option: LengthUnit | None) -> LengthUnit:
    """Return the unit of the translation."""
    if option is not None:
        return option
    if found.unit is None:
        raise ValueError(f"length_unit: expected m or mm, which a file of {found.format} does not say")
    return found.unit


def _rotation(matrix: FloatArray) -> tuple[FloatArray, list[Notice]]:
    """Return the nearest rotation, and a warning where the matrix is one to a few digits only."""
    departure = float(np.abs(matrix.T @ matrix - np.eye(3)).max())
    if not departure <= NO_ROTATION or np.linalg.det(matrix) < 0:
        raise ValueError(
            f"rotation: expected an orthonormal matrix with determinant +1, found one {departure:.1e} from "
            f"orthonormal with determinant {np.linalg.det(matrix):+.2f}"
        )
    if departure <= FEW_DIGITS:
        return nearest_rotation(matrix), []
    text = f"the rotation is written with so few digits that it is {1e3 * departure:.2f} mrad away from one"
    return nearest_rotation(matrix), [Notice("warning", text, "rotation")]


def _nearest(side: str, lens: Lens, size: IntArray) -> Nearest:
    """Return the nearest camera of one side; `ValueError` where nothing near enough exists."""
    try:
        nearest = nearest_camera(lens, size)
    except ValueError as error:
        raise ValueError(f"{side} camera: {error}") from error
    if nearest.largest_px > UNUSABLE_PX:
        raise ValueError(
            f"{side} camera: {_difference(lens)} cannot be taken over: up to {nearest.largest_px:.2f} px of it remain "
            f"over the picture, {UNUSABLE_PX} px are allowed"
        )
    return nearest


def _difference(lens: Lens) -> str:
    """What the lens has that this program's camera has not."""
    skew = f"a skew of {lens.skew_px:.3g} px" if lens.skew_px else ""
    odd = "" if lens.exponents == EVEN or not lens.radial.any() else f"a distortion in powers {lens.exponents} of r"
    return " and ".join(part for part in (skew, odd) if part)


def _model_notice(side: str, lens: Lens, nearest: Nearest) -> Notice | None:
    """What became of a lens that this program's camera cannot describe exactly."""
    if lens.is_exact:
        return None
    turned = f", its frame turned by {1e3 * nearest.turn_rad:.3f} mrad about its axis" if lens.skew_px else ""
    text = (
        f"{_difference(lens)} is described by the nearest camera without it{turned}; "
        f"up to {nearest.largest_px:.3f} px remain over the picture"
    )
    return Notice("warning" if nearest.largest_px > REMARKABLE_PX else "info", text, f"{side} camera")


def _sanity(rig: StereoRig) -> list[Notice]:
    """Warnings where the numbers cannot belong to a picture of that size."""
    notices = []
    for side, camera in (("left", rig.left), ("right", rig.right)):
        centre = camera.matrix[:2, 2]
        if (centre < 0).any() or (centre >= camera.size_px).any():
            text = (
                f"its principal point ({centre[0]:.0f}, {centre[1]:.0f}) lies outside a picture of "
                f"{camera.size_px[0]}x{camera.size_px[1]}: width and height may be exchanged"
            )
            notices.append(Notice("warning", text, f"{side} camera"))
    return notices


def _baseline(rig: StereoRig, unit: LengthUnit) -> Notice:
    """The distance and the angle of the cameras, by which a wrong unit shows at once."""
    transform = rig.right_from_left
    cosine = np.clip((np.trace(transform.rotation) - 1.0) / 2.0, -1.0, 1.0)
    text = (
        f"the cameras are {1e3 * np.linalg.norm(transform.translation_m):.2f} mm apart and turned by "
        f"{np.rad2deg(np.arccos(cosine)):.2f} degrees against each other (lengths in the file taken as {unit})"
    )
    return Notice("info", text, "extrinsics")
