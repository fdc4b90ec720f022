"""Calibrations of other programs as this program has them: lens models, parameters; VIC-3D files."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Literal
from xml.etree import ElementTree

import numpy as np

from photogram.arrays import Arrays, FloatArray, IntArray, Notice
from photogram.camera import Camera, StereoRig
from photogram.geometry import RigidTransform, nearest_rotation

EVEN = (2, 4, 6)
"""Exponents of the radial polynomial 1 + k1·r² + k2·r⁴ + k3·r⁶, which is this program's."""
_LINEAR, _RADIAL = [0, 1, 2, 3, 9], [4, 5, 8]  # places of fx fy cx cy and the turn, of k1 k2 k3, among the parameters
_GRID = 21  # points along each side of the picture at which two cameras are compared
_STEPS = 200  # fixed-point steps of the inverse
_INVERTED_PX = 1e-6


@dataclass(frozen=True, eq=False, repr=False)
class Lens(Arrays, shapes="focal_px 2; centre_px 2; radial 3; tangential 2"):
    """A pinhole with skew, radial and tangential distortion: focal_px, centre_px (2,), radial (3,), tangential (2,).

    With x = X/Z, y = Y/Z, r² = x² + y² and the factor g = 1 + Σ radial·r^exponents:
    x_d = g·x + 2·p1·x·y + p2·(r² + 2x²), y_d = g·y + p1·(r² + 2y²) + 2·p2·x·y,
    u = fx·x_d + skew·y_d + cx, v = fy·y_d + cy.
    """

    focal_px: FloatArray
    centre_px: FloatArray
    radial: FloatArray
    tangential: FloatArray
    skew_px: float = 0.0
    exponents: tuple[int, int, int] = EVEN

    @property
    def is_exact(self) -> bool:
        """Whether a `Camera` describes it without any difference."""
        return self.skew_px == 0.0 and (self.exponents == EVEN or not self.radial.any())

    def project(self, normalised: FloatArray) -> FloatArray:
        """Return the pixels (N, 2) of normalised coordinates (N, 2)."""
        x, y = normalised.T
        radius = np.hypot(x, y)
        factor = 1.0 + sum(k * radius**power for k, power in zip(self.radial, self.exponents, strict=True))
        p1, p2 = self.tangential
        x_d = factor * x + 2 * p1 * x * y + p2 * (radius**2 + 2 * x**2)
        y_d = factor * y + p1 * (radius**2 + 2 * y**2) + 2 * p2 * x * y
        pixel = np.stack([self.focal_px[0] * x_d + self.skew_px * y_d, self.focal_px[1] * y_d], axis=1)
        return np.asarray(pixel + self.centre_px)


@dataclass(frozen=True, eq=False)
class Nearest:
    """The camera nearest to a lens: `camera` sees in a frame turned by `turn_rad` about its axis what the lens sees.

    `largest_px`: the largest difference left over the picture.
    """

    camera: Camera
    turn_rad: float
    largest_px: float


def nearest_camera(lens: Lens, size_px: IntArray) -> Nearest:
    """Return the camera that sees, with least squares over the picture, what a lens sees.

    A lens of this program's form is taken over as it is. Another radial polynomial is fitted by this one's, with the
    matrix. Of a skew, u = … + s·y_d, about one half is a turn about the axis by −s/(fx + fy), which the camera's frame
    takes up; the other half, a stretch along the diagonals, is no part of this program's camera and remains.
    """
    start = np.concatenate([lens.focal_px, lens.centre_px, lens.radial[:2], lens.tangential, lens.radial[2:]])
    if lens.is_exact:
        return Nearest(Camera.from_parameters(start, size_px), 0.0, 0.0)
    if lens.exponents != EVEN:
        start[_RADIAL] = 0.0
    normalised = _seen(lens, size_px)
    pixel = lens.project(normalised)
    free = _LINEAR if lens.exponents == EVEN else [*_LINEAR, *_RADIAL]
    found = _fit(normalised, pixel, (np.append(start, 0.0), free), size_px)
    camera, turn = Camera.from_parameters(found[:9], size_px), float(found[9])
    left = np.linalg.norm(camera.project(_rays(normalised, turn)) - pixel, axis=1)
    return Nearest(camera, turn, float(left.max()))


def _fit(
    normalised: FloatArray, pixel: FloatArray, start: tuple[FloatArray, list[int]], size_px: IntArray
) -> FloatArray:
    """Return parameters and turn (10,) by least squares over the free ones, each scaled to about 1 px at the corner."""
    from scipy.optimize import least_squares

    first, free = start
    radius = float(np.linalg.norm(normalised, axis=1).max())
    reach = radius * float(first[:2].mean())
    steps = np.array([1 / radius, 1 / radius, 1, 1, *(1 / (reach * radius**n) for n in (2, 4, 1, 1, 6, 0))])

    def moved(scaled: FloatArray) -> FloatArray:
        values = first.copy()
        values[free] += scaled * steps[free]
        return values

    def difference(scaled: FloatArray) -> FloatArray:
        values = moved(scaled)
        camera = Camera.from_parameters(values[:9], size_px)
        return np.asarray((camera.project(_rays(normalised, values[9])) - pixel).ravel())

    solution = least_squares(difference, np.zeros(len(free)), method="lm", xtol=1e-14, ftol=1e-14, gtol=1e-14)
    return moved(solution.x)


def _rays(normalised: FloatArray, turn_rad: float) -> FloatArray:
    """Return the directions (N, 3) in a frame turned by an angle about the optical axis."""
    cosine, sine = np.cos(turn_rad), np.sin(turn_rad)
    x, y = normalised.T
    return np.stack([cosine * x - sine * y, sine * x + cosine * y, np.ones(len(x))], axis=1)


def _seen(lens: Lens, size_px: IntArray) -> FloatArray:
    """Return the normalised coordinates (N, 2) of a grid of pixels over the picture, by fixed-point steps."""
    width, height = (float(length) - 1.0 for length in size_px)
    columns, rows = np.meshgrid(np.linspace(0.0, width, _GRID), np.linspace(0.0, height, _GRID))
    pixel = np.stack([columns.ravel(), rows.ravel()], axis=1)
    normalised = (pixel - lens.centre_px) / lens.focal_px
    for _ in range(_STEPS):
        difference = pixel - lens.project(normalised)
        if np.abs(difference).max() < _INVERTED_PX:
            return np.asarray(normalised)
        if not np.isfinite(difference).all():
            break
        normalised = normalised + difference / lens.focal_px
    raise ValueError("distortion: expected coefficients with an inverse over the picture, found none")


# From what a file holds to a stereo rig: units, rotations written with few digits, differences of camera models.

LengthUnit = Literal["m", "mm"]
METRES = {"m": 1.0, "mm": 1e-3}
FEW_DIGITS = 1e-5  # departure from a rotation above which the user is told
NO_ROTATION = 1e-3  # and above which it is none
REMARKABLE_PX = 0.05  # difference between the file's camera and this program's that is worth a warning
UNUSABLE_PX = 0.5  # and that is refused
SIDES = ("left", "right")


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
    size, unit = _size(found.sizes_px, image_size), length_unit or found.unit
    if unit is None:
        raise ValueError(f"length_unit: expected m or mm, which a file of {found.format} does not say")
    rotation, notices = _rotation(found.rotation)
    sides = [
        (side, lens, _nearest(side, lens, size)) for side, lens in zip(("left", "right"), found.lenses, strict=True)
    ]
    (_, _, left), (_, _, right) = sides
    given = RigidTransform(rotation, found.translation * METRES[unit])
    turns = [RigidTransform.from_pose(np.array([0, 0, 0, 0, 0, near.turn_rad])) for near in (left, right)]
    between = turns[1] @ given @ turns[0].inverse()
    cosine = np.clip((np.trace(between.rotation) - 1.0) / 2.0, -1.0, 1.0)
    told = (
        f"the cameras are {1e3 * np.linalg.norm(between.translation_m):.2f} mm apart and turned by "
        f"{np.rad2deg(np.arccos(cosine)):.2f} degrees against each other (lengths in the file taken as {unit})"
    )
    missing = "no uncertainties came with it: state scale_uncertainty under [stereo.NAME] in rig.toml"
    remarks = (
        *found.notices,
        *notices,
        *(_model_notice(*each) for each in sides),
        *(_centre_notice(side, near.camera) for side, _, near in sides),
        Notice("info", told, "extrinsics"),
        Notice("info", missing, "covariance"),
    )
    rig = StereoRig(left.camera, right.camera, between)
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


def _centre_notice(side: str, camera: Camera) -> Notice | None:
    """A warning where the principal point cannot belong to a picture of that size."""
    centre, (width, height) = camera.matrix[:2, 2], camera.size_px
    if (centre >= 0).all() and (centre < camera.size_px).all():
        return None
    text = (
        f"its principal point ({centre[0]:.0f}, {centre[1]:.0f}) lies outside a picture of {width}x{height}: "
        "width and height may be exchanged"
    )
    return Notice("warning", text, f"{side} camera")


# VIC-3D: the calibration in a project's XML, on its own or inside a .z3d file.

FORMAT = "VIC-3D"
PROJECT = "project.xml"
"""The file inside a .z3d file that holds the calibration."""


def read_vic3d(root: ElementTree.Element) -> Found:
    """Return what a VIC-3D project or calibration holds.

    `camera`: cx cy fx fy s k1 k2 k3, as text or split into `intrinsics` and `distortion`, with u = fx·x_d + s·y_d + cx;
    `orientation`: α β γ (degrees) tx ty tz (mm) of x_camera = R_z(γ)·R_y(β)·R_x(α)·x_world + t (sdynpy,
    `camera_matrix_from_vic_parameters`; dicengine, `DICe_CameraSystem.cpp`). The distortion is not published; of the
    usual polynomials, 1 + k1·r² + k2·r⁴ + k3·r⁶ leaves the smallest epipolar residuals in a recording of the DIC
    challenge with its VIC-3D calibration (`tests/photogram/test_calibration_files.py`).
    """
    cameras = {camera.get("id", ""): camera for camera in root.iter("camera")}
    if set(cameras) != {"0", "1"}:
        raise ValueError(f"camera: expected the ids 0 and 1, found {', '.join(sorted(cameras)) or 'none'}")
    lenses = [_lens(f"camera {key}", cameras[key]) for key in "01"]
    poses = [_pose(f"camera {key}", cameras[key]) for key in "01"]
    rotation, translation = right_from_left(poses[0], poses[1])
    size = _vic3d_size(root)
    return Found(FORMAT, (lenses[0], lenses[1]), (size, size), rotation, translation, "mm")


def _lens(name: str, camera: ElementTree.Element) -> Lens:
    """Return the lens of one camera in either spelling."""
    intrinsics, distortion = camera.find("intrinsics"), camera.find("distortion")
    if intrinsics is None:
        words = (camera.text or "").split()
        inner, radial = words[:5], words[5:]
    else:
        inner = (intrinsics.text or "").split()
        radial = [] if distortion is None else (distortion.text or "").split()
    cx, cy, fx, fy, skew = numbers(f"{name}.intrinsics", inner, 5)
    coefficients = numbers(f"{name}.distortion", radial, len(radial))
    if coefficients[3:].any():
        raise ValueError(
            f"{name}.distortion: expected k1 k2 k3, found {coefficients[3:].tolist()} beside them, "
            "whose meaning is not published; calibrate with radial distortion alone"
        )
    padded = np.zeros(3)
    padded[: min(3, len(coefficients))] = coefficients[:3]
    return Lens(np.array([fx, fy]), np.array([cx, cy]), padded, np.zeros(2), skew_px=float(skew))


def _pose(name: str, camera: ElementTree.Element) -> tuple[FloatArray, FloatArray]:
    """Return rotation and translation (mm) of one camera."""
    orientation = camera.find("orientation")
    if orientation is None:
        raise ValueError(f"{name}.orientation: missing")
    values = numbers(f"{name}.orientation", (orientation.text or "").split(), 6)
    return rotation_from_cardan(values[:3]), values[3:]


def _vic3d_size(root: ElementTree.Element) -> tuple[int, int] | None:
    """Return the size of the pictures, which stands at an area of interest where there is one."""
    for mask in root.iter("polygonmask"):
        if mask.get("width") and mask.get("height"):
            width, height = numbers("polygonmask", [mask.get("width"), mask.get("height")], 2)
            return int(width), int(height)
    return None
