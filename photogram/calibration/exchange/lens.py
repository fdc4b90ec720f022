"""Conversion of other lens models, units and rotations to those of this program."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any, Literal

import numpy as np

from photogram.calibration.calibration_file import LARGEST, check_plausible
from photogram.calibration.calibration_notices import (
    APPROXIMATED_CAMERA,
    CAMERA_GEOMETRY,
    CENTRE_FAR_FROM_MIDDLE,
    CENTRE_OUTSIDE_IMAGE,
    INEXACT_ROTATION,
    NO_COMMON_VIEW,
    POORLY_APPROXIMATED_CAMERA,
    UNCERTAINTIES_MISSING,
    UNUSUAL_DISTANCE,
)
from photogram.camera import CAMERA_PARAMETERS, Camera, StereoRig
from photogram.geometry import RigidTransform, nearest_rotation, rotation_from_vector, skew
from shakercal._common.arrays import Arrays, FloatArray, IntArray
from shakercal._common.notices import Notice

EVEN = (2, 4, 6)
"""Exponents of this program's radial polynomial 1 + k1·r² + k2·r⁴ + k3·r⁶."""
_GRID = 41  # points along each side of the image for the comparison of two cameras
_STEPS = 200  # fixed-point steps of the inverse
_TANGENTIAL_STEPS = 20  # the same for a fisheye lens's tangential terms, of some 1e-3
_INVERTED_PX = 1e-6  # residual of the inverse that ends the steps
_ESSENTIAL = 1e-3  # largest relative deviation of an essential matrix from that of R and T


@dataclass(frozen=True, eq=False, repr=False)
class Lens(Arrays, shapes="focal_px 2; centre_px 2; radial K; tangential 2; divisor 3; angular 4"):
    """A pinhole camera with skew, radial and tangential distortion.

    With x = X/Z, y = Y/Z, r² = x² + y² and the factor g = (1 + Σ radial·r^exponents)/(1 + Σ divisor·r^(2, 4, 6)): x_d =
    g·x + 2·p1·x·y + p2·(r² + 2x²), y_d = g·y + p1·(r² + 2y²) + 2·p2·x·y, u = fx·x_d + skew·y_d + cx, v = fy·y_d + cy.

    With `angular` (4,), for a fisheye lens, g is θ_d/r, with θ = arctan r and θ_d = θ·(1 + k1·θ² + k2·θ⁴ + k3·θ⁶ +
    k4·θ⁸) (Kannala and Brandt 2006, IEEE Transactions on Pattern Analysis and Machine Intelligence 28, 1335; OpenCV's
    `fisheye`, "equidistant" of ROS and Kalibr). Its tangential terms are those of (x, y)·θ/r, as Metashape's.
    """

    focal_px: FloatArray
    centre_px: FloatArray
    radial: FloatArray = field(default_factory=lambda: np.zeros(3))
    tangential: FloatArray = field(default_factory=lambda: np.zeros(2))
    skew_px: float = 0.0
    exponents: tuple[int, ...] = EVEN
    divisor: FloatArray = field(default_factory=lambda: np.zeros(3))
    angular: FloatArray | None = None

    @staticmethod
    def from_matrix(name: str, matrix: FloatArray, **distortion: FloatArray) -> Lens:
        """Return the lens of a camera matrix (3, 3) that a file calls `name`."""
        if matrix[1, 0] != 0 or not np.array_equal(matrix[2], [0, 0, 1]):
            raise ValueError(f"{name}: expected [[fx, s, cx], [0, fy, cy], [0, 0, 1]], found {matrix.tolist()}")
        inner: dict[str, Any] = {"skew_px": float(matrix[0, 1]), **distortion}
        return Lens(np.diagonal(matrix)[:2].copy(), matrix[:2, 2].copy(), **inner)

    @property
    def is_exact(self) -> bool:
        """Whether a `Camera` describes it exactly."""
        return self.angular is None and (self.exponents == EVEN or not self.radial.any())

    @property
    def model(self) -> str:
        """Name of the distortion model in a notice."""
        return f"a distortion in powers {self.exponents} of r" if self.angular is None else "a fisheye distortion"

    @property
    def parameters(self) -> FloatArray:
        """Vector (13,) of `CAMERA_PARAMETERS`, for any exponents."""
        k1, k2, k3 = self.radial[:3]
        return np.array([*self.focal_px, *self.centre_px, k1, k2, *self.tangential, k3, *self.divisor, self.skew_px])

    def project(self, normalised: FloatArray) -> FloatArray:
        """Return the pixels (N, 2) of normalised coordinates (N, 2)."""
        x, y = normalised.T
        radius = np.hypot(x, y)
        if self.angular is None:
            factor = 1.0 + sum(k * radius**power for k, power in zip(self.radial, self.exponents, strict=True))
            factor = factor / (1.0 + sum(k * radius**power for k, power in zip(self.divisor, EVEN, strict=True)))
        else:
            factor = fisheye_radius(np.arctan(radius), self.angular) / np.where(radius > 0, radius, 1.0)
            factor = np.where(radius > 0, factor, 1.0)
        x_d, y_d = (factor[:, None] * normalised + self.decentring(normalised)).T
        pixel = np.stack([self.focal_px[0] * x_d + self.skew_px * y_d, self.focal_px[1] * y_d], axis=1)
        return np.asarray(pixel + self.centre_px)

    def decentring(self, normalised: FloatArray) -> FloatArray:
        """Return the tangential distortion (N, 2) at normalised coordinates (N, 2)."""
        radius, (p1, p2) = np.linalg.norm(normalised, axis=1), self.tangential
        angle = radius if self.angular is None else np.arctan(radius)
        x, y = normalised.T * (angle / np.where(radius > 0, radius, 1.0))
        square = x * x + y * y
        return np.column_stack([2 * p1 * x * y + p2 * (square + 2 * x * x), p1 * (square + 2 * y * y) + 2 * p2 * x * y])


def fisheye_radius(angle_rad: FloatArray, coefficients: FloatArray) -> FloatArray:
    """Return θ_d of rays at angles θ to the axis for fisheye coefficients (4,)."""
    return np.asarray(angle_rad * np.polynomial.polynomial.polyval(angle_rad**2, [1.0, *coefficients]))


@dataclass(frozen=True, eq=False)
class NearestCamera:
    """The camera nearest to a lens, in a rotated frame, with the largest difference.

    `turn` (3,): rotation vector in rad of that frame. `largest_px`: largest difference over the image.
    `largest_scale`: largest derivative of the difference by the pixel, the relative error of small displacements.
    """

    camera: Camera
    turn: FloatArray
    largest_px: float
    largest_scale: float


def nearest_camera(lens: Lens, size_px: IntArray) -> NearestCamera:
    """Return the least-squares camera for a lens over the image.

    A lens of this program's form is used unchanged. A radial polynomial in other powers is approximated by this one,
    together with the matrix; one with more powers, and a fisheye lens, by the rational model.
    """
    if lens.is_exact:
        return NearestCamera(Camera.from_parameters(lens.parameters, size_px), np.zeros(3), 0.0, 0.0)
    start = lens.parameters
    if lens.angular is not None:
        normalised = _seen_by_fisheye(lens, lens.angular, size_px)
        free = (*RADIAL, *DIVISOR, *(("cx", "cy", "p1", "p2") if lens.tangential.any() else ()))
        return fit_camera(lens.project(normalised), normalised, start, free, size_px)
    normalised = _seen(lens, size_px)
    if lens.exponents[: len(EVEN)] == EVEN:
        return fit_camera(lens.project(normalised), normalised, start, (*RADIAL, *DIVISOR), size_px)
    start[[4, 5, 8]] = 0.0
    start[:2] *= 1.0 + sum(k for k, power in zip(lens.radial, lens.exponents, strict=True) if power == 0)
    return fit_camera(lens.project(normalised), normalised, start, ("fx", "fy", "cx", "cy", *RADIAL), size_px)


RADIAL = ("k1", "k2", "k3")
DIVISOR = ("k4", "k5", "k6")
TURN = ("x", "y", "z")


def fit_camera(
    pixel: FloatArray, normalised: FloatArray, start: FloatArray, free: Sequence[str], size_px: IntArray
) -> NearestCamera:
    """Fit a camera that projects X/Z, Y/Z (N, 2) to pixels (N, 2).

    The pixels are those of `pixel_grid`. Parameters (13,) begin at `start`. `free` names the fitted ones and components
    of the rotation about x, y, z.
    """
    from scipy.optimize import least_squares

    rays = np.column_stack([normalised, np.ones(len(normalised))])
    names = (*CAMERA_PARAMETERS, *TURN)
    indices = [names.index(name) for name in free]
    # Each unknown in steps that move the corner by about 1 px.
    radius = float(np.linalg.norm(normalised, axis=1).max())
    reach = float(start[:2].mean())
    powers = {"k1": 3, "k2": 5, "k3": 7, "k4": 3, "k5": 5, "k6": 7, "x": 0, "y": 0, "z": 1}
    steps = np.array(
        [
            {"c": 1.0, "f": 1 / radius, "s": 1 / radius}.get(name[0]) or 1 / (reach * radius ** powers.get(name, 2))
            for name in free
        ]
    )

    def moved(scaled: FloatArray) -> tuple[Camera, FloatArray]:
        values = np.concatenate([start, np.zeros(3)])
        values[indices] += scaled * steps
        return Camera.from_parameters(values[:-3], size_px), values[-3:]

    def difference(scaled: FloatArray) -> FloatArray:
        camera, turn = moved(scaled)
        return np.asarray(camera.project(rays @ rotation_from_vector(turn).T) - pixel)

    tight = {"xtol": 1e-14, "ftol": 1e-14, "gtol": 1e-14}
    fit = least_squares(lambda x: difference(x).ravel(), np.zeros(len(free)), method="lm", **tight).x
    left = difference(fit)
    steps_px = (size_px - 1.0) / (_GRID - 1)
    slopes = np.gradient(left.reshape(_GRID, _GRID, 2), *steps_px[::-1], axis=(0, 1), edge_order=2)
    scale = np.linalg.norm(np.stack(slopes, axis=-1), ord=2, axis=(2, 3))
    return NearestCamera(*moved(fit), float(np.linalg.norm(left, axis=1).max()), float(scale.max()))


def pixel_grid(size_px: IntArray) -> FloatArray:
    """Return a grid (N, 2) of pixels over the image, including its corners."""
    width, height = (float(length) - 1.0 for length in size_px)
    columns, rows = np.meshgrid(np.linspace(0.0, width, _GRID), np.linspace(0.0, height, _GRID))
    return np.stack([columns.ravel(), rows.ravel()], axis=1)


def _seen(lens: Lens, size_px: IntArray) -> FloatArray:
    """Return the normalised coordinates (N, 2) of a grid of pixels, by fixed-point steps."""
    pixel = pixel_grid(size_px)
    normalised = (pixel - lens.centre_px) / lens.focal_px
    for _ in range(_STEPS):
        difference = pixel - lens.project(normalised)
        if np.abs(difference).max() < _INVERTED_PX:
            return np.asarray(normalised)
        if not np.isfinite(difference).all():
            break
        normalised = normalised + difference / lens.focal_px
    raise ValueError("distortion: expected coefficients with an inverse over the image, found none")


def _seen_by_fisheye(lens: Lens, coefficients: FloatArray, size_px: IntArray) -> FloatArray:
    """Return the normalised coordinates (N, 2) of a grid of pixels of a fisheye lens."""
    matrix = np.array([[lens.focal_px[0], lens.skew_px], [0.0, lens.focal_px[1]]])
    distorted = np.linalg.solve(matrix, (pixel_grid(size_px) - lens.centre_px).T).T
    angle = np.linspace(0.0, WIDEST_RAD, 20_001)
    table, radius = fisheye_radius(angle, coefficients), np.linalg.norm(distorted, axis=1)
    growing = int(np.argmin(np.append(np.diff(table) > 0, False)))  # range with an inverse
    if not radius.max() <= table[growing]:
        expected = f"a field of view of at most {np.degrees(angle[growing]):.0f} degrees off the axis"
        raise ValueError(f"distortion: expected {expected}, the range of the fisheye model's inverse, found more")

    def undistorted(target: FloatArray) -> FloatArray:
        radius = np.linalg.norm(target, axis=1)
        theta = np.interp(radius, table[: growing + 1], angle[: growing + 1])
        return np.asarray(target * (np.tan(theta) / np.where(radius > 0, radius, 1.0))[:, None])

    normalised = undistorted(distorted)
    for _ in range(_TANGENTIAL_STEPS if lens.tangential.any() else 0):
        normalised = undistorted(distorted - lens.decentring(normalised))
    return normalised


# Conversion of a file's content to a stereo rig: units, inexact rotations, differences of camera models.

LengthUnit = Literal["m", "mm", "cm", "um", "in"]
METRES = {"m": 1.0, "mm": 1e-3, "cm": 1e-2, "um": 1e-6, "in": 0.0254}
_UNIT_WORDS: dict[str, LengthUnit] = {
    **dict.fromkeys(("m", "meter", "meters", "metre", "metres"), "m"),
    **dict.fromkeys(("mm", "millimeter", "millimeters", "millimetre", "millimetres"), "mm"),
    **dict.fromkeys(("cm", "centimeter", "centimeters", "centimetre", "centimetres"), "cm"),
    **dict.fromkeys(("um", "µm", "μm", "micrometer", "micrometers", "micrometre", "micrometres", "microns"), "um"),
    **dict.fromkeys(("in", "inch", "inches"), "in"),
}
DistortionModel = Literal["plumb_bob", "fisheye"]
"""Model of four distortion coefficients: k1 k2 p1 p2, or those of an angle."""
FEW_DIGITS = 1e-5  # deviation from a rotation for a warning
NO_ROTATION = 1e-3  # and for a refusal
WIDEST_RAD = np.radians(79.0)  # off the axis; the widest field of view of a camera of this program
_OFF_MIDDLE = 0.2  # of the image's side; at half the resolution the offset is 0.25, of a real lens about 0.02
REMARKABLE_PX = 0.05  # difference between the file's camera and this program's for a warning
NEAR_M, FAR_M = 1e-3, 20.0  # usual distances of two cameras; others suggest a wrong unit
_DEPTHS = np.geomspace(0.3, 1000.0, 40)  # in baselines, of points in a common field of view
UNUSABLE_PX = 0.5  # and for a refusal
REMARKABLE_SCALE, UNUSABLE_SCALE = 1e-3, 1e-2  # the same of the error of small displacements
SIDES = ("left", "right")


@dataclass(frozen=True, eq=False)
class ImportedCalibration:
    """A stereo pair from another program's file, with that file's format and notices."""

    rig: StereoRig
    format: str
    notices: tuple[Notice, ...]


@dataclass(frozen=True, eq=False)
class StatedCalibration:
    """Content of a calibration file: lenses, sizes, rotation and translation in file units.

    x_right = rotation·x_left + translation. A size is None if the file has none. `unit` is fixed by the file or its
    format, otherwise None. `habit` is the usual unit of its program, None if there is none. `essential` is name and
    value (3, 3) of the pair's essential matrix, if the file has one.
    """

    format: str
    lenses: tuple[Lens, Lens]
    sizes_px: tuple[tuple[int, int] | None, tuple[int, int] | None]
    rotation: FloatArray
    translation: FloatArray
    unit: LengthUnit | None
    notices: tuple[Notice, ...] = ()
    habit: LengthUnit | None = None
    essential: tuple[str, FloatArray] | None = None


def unit_of(word: str | None) -> LengthUnit | None:
    """Return the unit of length of a file's word, None for another word."""
    return None if word is None else _UNIT_WORDS.get(word.strip().lower())


def build_rig(
    stated: StatedCalibration, image_size: tuple[int, int] | None, length_unit: LengthUnit | None
) -> ImportedCalibration:
    """Return the stereo rig of a file's content."""
    sizes, unit = _sizes(stated.sizes_px, image_size), length_unit or stated.unit or stated.habit
    if unit is None:
        raise ValueError(f"length_unit: expected m or mm, which a file of {stated.format} does not state")
    if stated.unit is not None and unit != stated.unit:
        raise ValueError(f"length_unit: expected {stated.unit} as in the file, found {unit}")
    departure = float(np.abs(stated.rotation.T @ stated.rotation - np.eye(3)).max())
    if not departure <= NO_ROTATION or np.linalg.det(stated.rotation) < 0:
        raise ValueError(
            f"rotation: expected an orthonormal matrix with determinant +1, found one {departure:.1e} from "
            f"orthonormal with determinant {np.linalg.det(stated.rotation):+.2f}"
        )
    notices = list(stated.notices)
    if departure > FEW_DIGITS:
        notices.append(Notice(INEXACT_ROTATION, "rotation", deviation_mrad=1e3 * departure))
    if stated.essential is not None:
        _check_essential(*stated.essential, stated)
    left, right = (_camera(*each, notices) for each in zip(SIDES, stated.lenses, sizes, strict=True))
    between = RigidTransform(nearest_rotation(stated.rotation), stated.translation * METRES[unit])
    cosine = np.clip((np.trace(between.rotation) - 1.0) / 2.0, -1.0, 1.0)
    distance_mm, angle_deg = 1e3 * float(np.linalg.norm(between.translation_m)), float(np.rad2deg(np.arccos(cosine)))
    geometry = Notice(CAMERA_GEOMETRY, "extrinsics", distance_mm=distance_mm, angle_deg=angle_deg, unit=unit)
    rig, by_habit = check_plausible(StereoRig(left, right, between)), length_unit is None and stated.unit is None
    notices += [geometry, *_distance(between, unit, by_habit)]
    if not _see_the_same(rig):
        notices.append(Notice(NO_COMMON_VIEW, "extrinsics"))
    return ImportedCalibration(rig, stated.format, (*notices, Notice(UNCERTAINTIES_MISSING, "covariance")))


def _distance(between: RigidTransform, unit: str, by_habit: bool) -> list[Notice]:
    """Return a notice of two cameras too near or too far apart for a pair.

    `ValueError` if the unit is only the usual one of the program.
    """
    distance = float(np.linalg.norm(between.translation_m))
    if NEAR_M <= distance <= FAR_M:
        return []
    if by_habit:
        found = f"cameras {distance:.3g} m apart with lengths in {unit}"
        raise ValueError(f"length_unit: expected the unit of lengths, which the file does not state, found {found}")
    return [Notice(UNUSUAL_DISTANCE, "extrinsics", distance_m=distance, unit=unit)]


def _see_the_same(rig: StereoRig) -> bool:
    """Return whether the fields of view overlap, for the middle half of the left image.

    Only the matrices are used: distortion is negligible for this purpose.
    """
    middle, baseline = (rig.left.size_px - 1) / 2, float(np.linalg.norm(rig.right_from_left.translation_m))
    pixel = middle + (pixel_grid(rig.left.size_px) - middle) / 2
    rays = np.column_stack([pixel, np.ones(len(pixel))]) @ np.linalg.inv(rig.left.matrix).T
    points = rig.right_from_left.apply((_DEPTHS[:, None, None] * baseline * rays).reshape(-1, 3))
    seen = points[points[:, 2] > 0] @ rig.right.matrix.T
    pixel_right = seen[:, :2] / seen[:, 2:]
    return bool(((pixel_right > -0.5) & (pixel_right < rig.right.size_px - 0.5)).all(axis=1).any())


def _check_essential(name: str, given: FloatArray, stated: StatedCalibration) -> None:
    """Raise `ValueError` unless the essential matrix is that of rotation and translation."""
    expected = skew(stated.translation) @ stated.rotation
    share = abs(float((given * expected).sum())) / (np.linalg.norm(given) * np.linalg.norm(expected))
    if not 1.0 - share < _ESSENTIAL**2:
        raise ValueError(f"{name}: expected the one of the file's rotation and translation, found another")


def parse_numbers(where: str, values: Any, count: int | tuple[int, ...]) -> FloatArray:
    """Return texts or numbers as an array of `count` elements or of that shape."""
    shape = (count,) if isinstance(count, int) else count
    expected = " x ".join(str(length) for length in shape) + " numbers"
    try:
        array = np.asarray(values, dtype=np.float64)
    except (TypeError, ValueError, OverflowError) as error:
        raise ValueError(f"{where}: expected {expected}, found {str(values)[:60]!r}") from error
    if array.size != int(np.prod(shape)):
        raise ValueError(f"{where}: expected {expected}, found {array.size}")
    if not (np.abs(array) <= LARGEST).all():
        raise ValueError(f"{where}: expected finite numbers up to {LARGEST:g}, found {array.ravel()[:16].tolist()}")
    return array.reshape(shape)


def rotation_from_cardan(angles_deg: FloatArray) -> FloatArray:
    """Return R = R_z(γ)·R_y(β)·R_x(α) of Cardan angles (3,) in degrees.

    The convention of VIC-3D and DICe (dicengine, `Camera_Info::eulers_to_rotation_matrix`; sdynpy's reader of VIC-3D
    projects).
    """
    from scipy.spatial.transform import Rotation

    return np.asarray(Rotation.from_euler("xyz", angles_deg, degrees=True).as_matrix())


def right_from_left(left: Sequence[FloatArray], right: Sequence[FloatArray]) -> tuple[FloatArray, FloatArray]:
    """Return rotation and translation from left to right, of poses x_camera = R·x_world + t."""
    rotation = right[0] @ np.linalg.inv(left[0])
    return rotation, right[1] - rotation @ left[1]


def _sizes(sizes: tuple[tuple[int, int] | None, ...], option: tuple[int, int] | None) -> list[IntArray]:
    """Return the image sizes (2,), width and height, from the file or from the caller."""
    found = []
    for size in sizes:
        if size is None and option is None:
            raise ValueError("image_size: expected width and height of the images, which the file does not have")
        if size is not None and option is not None and size != option:
            raise ValueError(f"image_size: expected {_times(size)} as in the file, found {_times(option)}")
        found.append(np.array(size or option, dtype=np.int64))
    return found


def _times(size: tuple[int, int]) -> str:
    """Return the size as users write it."""
    return f"{size[0]}x{size[1]}"


def approximation_notice(where: str, beyond: str, nearest: NearestCamera) -> Notice:
    """Return a notice of an approximated camera; `ValueError` for a large difference."""
    percent = 100 * nearest.largest_scale
    if not (nearest.largest_px <= UNUSABLE_PX and nearest.largest_scale <= UNUSABLE_SCALE):
        limits = f"at most {UNUSABLE_PX} px and {100 * UNUSABLE_SCALE:g} % of small displacements over the image"
        expected = f"a camera without {beyond} that differs by {limits}"
        raise ValueError(f"{where}: expected {expected}, found {nearest.largest_px:.3f} px and {percent:.2g} %")
    remarkable = nearest.largest_px > REMARKABLE_PX or nearest.largest_scale > REMARKABLE_SCALE
    declared = POORLY_APPROXIMATED_CAMERA if remarkable else APPROXIMATED_CAMERA
    return Notice(declared, where, missing=beyond, largest_px=nearest.largest_px, percent=percent)


def _camera(side: str, lens: Lens, size: IntArray, notices: list[Notice]) -> Camera:
    """Return the camera of one side, and add notices of its approximation and centre."""
    where = f"{side} camera"
    try:
        nearest = nearest_camera(lens, size)
    except ValueError as error:
        raise ValueError(f"{where}: {error}") from error
    if not lens.is_exact:
        notices.append(approximation_notice(where, lens.model, nearest))
    centre, (width, height) = nearest.camera.matrix[:2, 2], size
    values = {"x_px": float(centre[0]), "y_px": float(centre[1]), "width_px": int(width), "height_px": int(height)}
    if not ((centre >= 0).all() and (centre < size).all()):
        notices.append(Notice(CENTRE_OUTSIDE_IMAGE, where, **values))
    elif (np.abs(centre - (size - 1) / 2) > _OFF_MIDDLE * size).any():
        notices.append(Notice(CENTRE_FAR_FROM_MIDDLE, where, **values))
    return nearest.camera
