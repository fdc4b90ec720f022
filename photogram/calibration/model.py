"""What a calibration estimates from: views of targets, parameters of a pair, shape of the target."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from photogram.arrays import BoolArray, FloatArray, IntArray, Notice, check_shape
from photogram.camera import RIG_PARAMETERS, Camera, StereoRig
from photogram.geometry import RigidTransform, skew
from photogram.targets.view import Target

# What a calibration leaves: the rig with its covariance, every residual, and what was dropped.


Determined = Literal["determined", "indistinct", "open"]


@dataclass(frozen=True)
class Parameter:
    """One parameter of the rig: value, standard uncertainty (k = 1) and unit ("px", "1", "rad", "m").

    `state`: "determined"; "indistinct", well known but not distinguishable from zero (distortion only); "open", known
    no better than before the session: the views say nothing about it and its value is the assumption's.
    """

    name: str
    value: float
    u: float
    unit: str
    state: Determined


@dataclass(frozen=True, eq=False)
class CalibratedPicture:
    """One picture in the fit: points (N,), of which `used` went into it.

    `index` (N, 2) lattice indices, `position_px` (N, 2) as found, `residual_px` (N, 2) found − modelled,
    `normalised` (N,) length of the residual over its standard uncertainty.
    """

    name: str
    index: IntArray
    position_px: FloatArray
    residual_px: FloatArray
    normalised: FloatArray
    used: BoolArray

    @property
    def rms_px(self) -> float:
        """Rms length of the used points' residuals (OpenCV's definition of the reprojection error)."""
        squares = (self.residual_px[self.used] ** 2).sum(axis=1)
        return float(squares.mean() ** 0.5) if self.used.any() else float("nan")


@dataclass(frozen=True, eq=False)
class CalibratedView:
    """One position of the target: `left_from_target` with covariance (6, 6), and the picture of either camera.

    The pose's covariance holds translation (m) and left-multiplied rotation (rad), in the order x y z rx ry rz.
    """

    left_from_target: RigidTransform
    covariance: FloatArray
    left: CalibratedPicture | None
    right: CalibratedPicture | None


@dataclass(frozen=True)
class Dropped:
    """A picture, or points of one, that did not go into the fit, and why; `points` 0 stands for the whole picture."""

    name: str
    points: int
    reason: str


@dataclass(frozen=True, eq=False)
class Calibration:
    """A calibrated stereo pair and how it came about.

    `rms_px`: rms length of all residuals, OpenCV's definition of the reprojection error, `rms_sides_px` (left, right)
    apart. `added_px` (left, right): noise per coordinate that comes on top of the points' own; `sigma_factor`:
    √(reduced χ²) of `dof` degrees of freedom with both, a factor of the covariance.
    `shape_m` (P, 3): estimated positions of the target's points (`shape_index` (P, 2)), the flat lattice where it was
    held flat. `scale_u`: relative standard uncertainty of the target's spacing, contained in the rig's covariance.
    `covered`: (left, right), share of each picture's area within the points' cells.
    """

    rig: StereoRig
    target: Target
    views: tuple[CalibratedView, ...]
    parameters: tuple[Parameter, ...]
    rms_px: float
    rms_sides_px: tuple[float, float]
    added_px: tuple[float, float]
    sigma_factor: float
    dof: float
    shape_index: IntArray
    shape_m: FloatArray
    scale_u: float
    covered: tuple[float, float]
    dropped: tuple[Dropped, ...]
    notices: tuple[Notice, ...]


# How the views of a session are spread: over the pictures, and in the angles of the target.


COVERAGE_CELLS = (8, 6)  # columns and rows of the cells by which coverage is told
_NO_TURN_RAD = np.radians(2.0)


def covered_share(pictures: Sequence[CalibratedPicture], size_px: IntArray) -> float:
    """Return the share of the picture's cells, 8 x 6, in which some point of some picture lies."""
    points = np.concatenate([picture.position_px[picture.used] for picture in pictures])
    cells = np.floor((points + 0.5) / size_px * COVERAGE_CELLS).astype(np.int64)
    inside = np.clip(cells, 0, np.array(COVERAGE_CELLS) - 1)
    return len(np.unique(inside, axis=0)) / (COVERAGE_CELLS[0] * COVERAGE_CELLS[1])


def spread_of_turns(poses: Sequence[RigidTransform]) -> tuple[FloatArray, FloatArray]:
    """Return how far the target's normal spreads (2,), in rad, and along which directions (columns) of the picture."""
    normal = np.array([pose.rotation[:, 2] * np.sign(pose.rotation[2, 2]) for pose in poses])
    variance, axes = np.linalg.eigh(np.cov(normal[:, :2].T, bias=True))
    return np.sqrt(np.maximum(variance, 0.0)), axes


def refuse_similar_views(poses: Sequence[RigidTransform]) -> None:
    """Raise `ValueError` when all views show the target under nearly one angle, which leaves the cameras open."""
    spread, _ = spread_of_turns(poses)
    if spread.max() < _NO_TURN_RAD:
        raise ValueError(
            f"all {len(poses)} views show the target under nearly one angle ({np.degrees(spread.max()):.1f}° rms), "
            "which does not determine the cameras; add views turned by 20° and more about both axes of the picture"
        )


# Where the points of a target are seen in a picture, and how that answers camera, poses and target.


_RIM_POINTS = 12  # points on the rim of a dot at which the lens's distortion is looked at


@dataclass(frozen=True, eq=False)
class Seen:
    """Modelled pixels (N, 2) of one picture with derivatives by the camera's parameters (N, 2, 9), by its pose after
    the left camera (N, 2, 6), by the target's pose (N, 2, 6) and by the point in the target's frame (N, 2, 3).

    Poses: translation, then left-multiplied rotation.
    """

    pixel: FloatArray
    by_camera: FloatArray
    by_relative: FloatArray
    by_pose: FloatArray
    by_point: FloatArray

    def by_rig(self, side: int) -> FloatArray:
        """Return the derivatives (N, 2, 24) by the parameters of a pair, this being its left (0) or right (1) side."""
        slope = np.zeros((len(self.pixel), 2, len(RIG_PARAMETERS)))
        slope[..., 9 * side : 9 * side + 9] = self.by_camera
        if side:
            slope[..., 18:21], slope[..., 21:24] = self.by_relative[..., 3:], self.by_relative[..., :3]
        return slope


def see(
    camera: Camera,
    camera_from_left: RigidTransform,
    left_from_target: RigidTransform,
    point_m: FloatArray,
    radius_m: float,
) -> Seen:
    """Return where a camera sees points (N, 3) of the target; dots of `radius_m` > 0 by the centre of their ellipse.

    The derivatives leave out how the lens's bending of a dot's rim changes, some 10⁻⁵ of them.
    """
    normal_left = left_from_target.rotation[:, 2]
    normal = camera_from_left.rotation @ normal_left
    turned = point_m @ left_from_target.rotation.T
    in_camera_turned = (turned + left_from_target.translation_m) @ camera_from_left.rotation.T
    in_camera = in_camera_turned + camera_from_left.translation_m
    flat, flat_by_place, flat_by_normal = ellipse_centres(in_camera, normal, radius_m)
    placed, by_flat = distorted(camera, flat)
    by_flat = np.array([camera.matrix[0, 0], camera.matrix[1, 1]])[:, None] * by_flat
    by_place, by_normal = by_flat @ flat_by_place, by_flat @ flat_by_normal
    by_left, by_left_normal = by_place @ camera_from_left.rotation, by_normal @ camera_from_left.rotation
    if radius_m > 0:
        placed = placed + _bent(camera, in_camera, camera_from_left.rotation @ left_from_target.rotation, radius_m)
    return Seen(
        camera_pixels(camera, placed),
        _by_camera(camera, flat, placed),
        np.concatenate([by_place, -by_place @ skew(in_camera_turned) - by_normal @ skew(normal)], axis=-1),
        np.concatenate([by_left, -by_left @ skew(turned) - by_left_normal @ skew(normal_left)], axis=-1),
        by_left @ left_from_target.rotation,
    )


def camera_pixels(camera: Camera, distorted: FloatArray) -> FloatArray:
    """Return the pixels (N, 2) of distorted normalised coordinates (N, 2)."""
    k = camera.matrix
    return np.asarray(distorted * [k[0, 0], k[1, 1]] + [k[0, 2], k[1, 2]])


def ellipse_centres(
    centre_m: FloatArray, normal: FloatArray, radius_m: float
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return the centres (N, 2), x/z and y/z, of the ellipses that an ideal camera sees of dots around c (N, 3), and
    their derivatives (N, 2, 3) by c and by the normal n (3,) of the dots' plane.

    The cone through a dot of radius ρ has the dual conic ρ²·(I − n·nᵀ) − c·cᵀ, and the ellipse's centre is the pole
    of the line at infinity, its last column (Heikkilä 2000, IEEE PAMI 22, 1066, eq. 16, written for n):
    e = (c_xy·c_z + ρ²·n_xy·n_z)/(c_z² − ρ²·|n_xy|²).
    """
    across, depth = centre_m[:, :2], centre_m[:, 2:]
    square = radius_m**2
    over = depth**2 - square * float(normal[:2] @ normal[:2])
    centre = (across * depth + square * normal[:2] * normal[2]) / over
    by_place = np.zeros((len(centre_m), 2, 3))
    by_place[:, 0, 0] = by_place[:, 1, 1] = (depth / over)[:, 0]
    by_place[:, :, 2] = (across - 2 * centre * depth) / over
    by_normal = np.empty((len(centre_m), 2, 3))
    by_normal[:, :, :2] = 2 * square * centre[:, :, None] * normal[:2] / over[:, :, None]
    by_normal[:, :, :2] += square * normal[2] * np.eye(2) / over[:, :, None]
    by_normal[:, :, 2] = square * normal[:2] / over
    return centre, by_place, by_normal


def _bent(camera: Camera, centre_m: FloatArray, rotation: FloatArray, radius_m: float) -> FloatArray:
    """Return how far (N, 2), normalised, a lens moves the ellipse beyond its centre, by bending the dot's rim.

    It bends the rim e by q beyond a linear map; the ellipse that fits the bent rim best along its normals n lies
    (Σ n·nᵀ)⁻¹·Σ n·nᵀ·q further.
    """
    centre = ellipse_centres(centre_m, rotation[:, 2], radius_m)[0]
    angle = 2 * np.pi * np.arange(_RIM_POINTS) / _RIM_POINTS
    rim_m = centre_m[:, None] + radius_m * (
        np.cos(angle)[:, None] * rotation[:, 0] + np.sin(angle)[:, None] * rotation[:, 1]
    )
    rim = rim_m[..., :2] / rim_m[..., 2:]
    placed, by_place = distorted(camera, centre)
    offset = np.einsum("nij,nkj->nki", by_place, rim - centre[:, None])
    bent = distorted(camera, rim)[0] - placed[:, None] - offset
    tangent = np.roll(offset, -1, axis=1) - np.roll(offset, 1, axis=1)
    normal = np.stack([-tangent[..., 1], tangent[..., 0]], axis=-1)
    normal /= np.linalg.norm(normal, axis=-1, keepdims=True)
    along = np.einsum("nki,nki->nk", normal, bent)
    matrix = np.einsum("nki,nkj->nij", normal, normal)
    return np.asarray(np.linalg.solve(matrix, np.einsum("nki,nk->ni", normal, along)[..., None])[..., 0])


def distorted(camera: Camera, undistorted: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return distorted normalised coordinates (..., 2) and their derivative (..., 2, 2) by the undistorted ones."""
    k1, k2, p1, p2, k3 = camera.distortion
    x, y = undistorted[..., 0], undistorted[..., 1]
    r2 = x * x + y * y
    gain = 1 + r2 * (k1 + r2 * (k2 + r2 * k3))
    slope = 2 * (k1 + r2 * (2 * k2 + 3 * k3 * r2))
    placed = [x * gain + 2 * p1 * x * y + p2 * (r2 + 2 * x * x), y * gain + p1 * (r2 + 2 * y * y) + 2 * p2 * x * y]
    mixed = slope * x * y + 2 * p1 * x + 2 * p2 * y
    by_x = gain + slope * x * x + 2 * p1 * y + 6 * p2 * x
    by_y = gain + slope * y * y + 6 * p1 * y + 2 * p2 * x
    return np.stack(placed, axis=-1), np.stack(
        [np.stack([by_x, mixed], axis=-1), np.stack([mixed, by_y], axis=-1)], axis=-2
    )


def _by_camera(camera: Camera, flat: FloatArray, placed: FloatArray) -> FloatArray:
    """Return ∂pixel/∂parameters (N, 2, 9) at undistorted and distorted coordinates (N, 2)."""
    focal = np.array([camera.matrix[0, 0], camera.matrix[1, 1]])
    x, y = flat.T
    r2 = x * x + y * y
    by_distortion = np.stack(
        [
            flat * r2[:, None],
            flat * r2[:, None] ** 2,
            np.stack([2 * x * y, r2 + 2 * y * y], axis=-1),
            np.stack([r2 + 2 * x * x, 2 * x * y], axis=-1),
            flat * r2[:, None] ** 3,
        ],
        axis=-1,
    )
    by_camera = np.zeros((len(flat), 2, 9))
    by_camera[:, 0, 0], by_camera[:, 1, 1] = placed.T
    by_camera[:, 0, 2] = by_camera[:, 1, 3] = 1.0
    by_camera[:, :, 4:] = focal[:, None] * by_distortion
    return by_camera


# The target's shape: flat, bowed, or every point where it is.


ShapeKind = Literal["flat", "bowed", "free"]

_BOW = 0.01  # what is known of a bow beforehand: its height over the target's half diagonal
_FREE = 0.01  # and of single points: their displacement over the spacing
_STRETCH = 3.0  # rms displacement by stretch of one axis and by shear, over that of single points


@dataclass(frozen=True, eq=False)
class Shape:
    """Points of a target, flat_m (P, 3) + basis (P, 3, S)·value_m (S,), with what is known of the values beforehand.

    `index` (P, 2): lattice indices. `prior_m` (S,): standard deviations of the values around zero. `group` (S,): values
    of one group have one prior; `from_data`: whether it is estimated together with them; that of the last group is then
    `_STRETCH` times that of the first.
    """

    index: IntArray
    flat_m: FloatArray
    basis: FloatArray
    value_m: FloatArray
    prior_m: FloatArray
    group: IntArray
    from_data: bool

    def __post_init__(self) -> None:
        """Refuse shapes that do not belong together."""
        points, values = len(self.index), len(self.value_m)
        check_shape("flat_m", self.flat_m, (points, 3))
        check_shape("basis", self.basis, (points, 3, values))
        check_shape("prior_m", self.prior_m, (values,))

    @property
    def points_m(self) -> FloatArray:
        """The points (P, 3) as they are estimated."""
        return np.asarray(self.flat_m + self.basis @ self.value_m)

    def moved(self, step_m: FloatArray) -> Shape:
        """Return the shape with its values changed by a step (S,)."""
        return replace(self, value_m=self.value_m + step_m)

    def with_prior_from(self, variance_m2: FloatArray) -> Shape:
        """Return the shape with each group's prior set to the spread of its values, known to `variance_m2` (S,).

        One step of expectation and maximisation: σ² = mean of value² + variance (Dempster, Laird, Rubin 1977).
        """
        if not self.from_data:
            return self
        second = self.value_m**2 + variance_m2
        inside, across = (float(np.sqrt(second[self.group == group].mean())) for group in (0, 1))
        return replace(self, prior_m=np.array([inside, across, _STRETCH * inside])[self.group])


def make_shape(kind: ShapeKind, index: IntArray, spacing_m: float) -> Shape:
    """Return the shape of the lattice points `index` (P, 2) before anything is known of it.

    `bowed`: height as a quadratic form of the place on the target. `free`: every point has an offset of its own, with
    one spread within the plane and one across; scale, place and turn of all points together stay those of the lattice
    to within what the spread allows (Strobl and Hirzinger 2011, ICCV Workshops, 1068). Since printers stretch one axis
    and shear, these two have an rms displacement of their own, three times that of the single points.
    """
    flat = np.column_stack([index * spacing_m, np.zeros(len(index))])
    points = len(index)
    if kind == "flat":
        return Shape(index, flat, np.zeros((points, 3, 0)), np.zeros(0), np.zeros(0), np.zeros(0, np.int64), False)
    if kind == "bowed":
        middle = (flat.min(axis=0) + flat.max(axis=0)) / 2
        half = np.linalg.norm(flat - middle, axis=1).max()
        x, y = ((flat - middle)[:, :2] / half).T
        basis = np.zeros((points, 3, 3))
        basis[:, 2] = np.column_stack([x * x, x * y, y * y])
        return Shape(index, flat, basis, np.zeros(3), np.full(3, _BOW * half), np.zeros(3, np.int64), False)
    place = (flat - flat.mean(axis=0))[:, :2]
    stretch, shear = np.zeros((points, 3, 1)), np.zeros((points, 3, 1))
    stretch[:, :2, 0], shear[:, :2, 0] = place * [1, -1], place[:, ::-1]
    size = np.sqrt((place**2).sum(axis=1).mean())
    single = np.eye(3 * points).reshape(points, 3, 3 * points)
    basis = np.concatenate([single, stretch / size, shear / size], axis=-1)
    group = np.array([*np.tile([0, 0, 1], points), 2, 2])
    prior = np.array([1.0, 1.0, _STRETCH])[group] * _FREE * spacing_m
    return Shape(index, flat, basis, np.zeros(len(group)), prior, group, True)
