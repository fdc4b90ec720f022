"""Quantities derived from a calibrated stereo pair, with their standard uncertainties."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Literal, NamedTuple

import numpy as np

from photogram.calibration.calibration_result import COVERAGE_CELLS, CalibratedImage, CalibratedView, Calibration
from photogram.camera import LEFT, RIGHT, ROTATION, TRANSLATION, Camera, StereoRig, triangulate
from photogram.geometry import fit_rigid, skew
from shakercal._common.arrays import FloatArray, IntArray
from shakercal._common.propagation import derivatives

Side = Literal["left", "right"]

SIDES: tuple[Side, Side] = ("left", "right")
STEP = 1e-3  # of a parameter's uncertainty: step of a derivative
CELLS_ACROSS = 16  # cells along the image width in which residuals are averaged
NEIGHBOURS = 3  # points along a row and rows whose residuals are compared in one image
LENGTH_SHARE = 0.1  # length whose uncertainty is stated, as a share of the working distance


class DerivedQuantity(NamedTuple):
    """A value and its standard uncertainty (k = 1)."""

    value: float
    u: float


@dataclass(frozen=True, eq=False)
class DistortionField:
    """Lens distortion on a grid of pixels (R, C, 2) with its uncertainty.

    `displacement_px` (R, C, 2) is relative to a lens without distortion, `u_px` (R, C) its standard uncertainty per
    coordinate; NaN without such a ray.
    """

    pixel: FloatArray
    displacement_px: FloatArray
    u_px: FloatArray


@dataclass(frozen=True, eq=False)
class ResidualMap:
    """Residuals of one camera in square cells: centre (K, 2), mean (K, 2), points (K,).

    Cells without points are omitted. `within_px`: rms length about the means; `systematic_px`: rms length of the means
    themselves, corrected for their random scatter (one-way analysis of variance, random effects).
    """

    side_px: float
    centre_px: FloatArray
    mean_px: FloatArray
    count: IntArray
    within_px: float
    systematic_px: float


@dataclass(frozen=True, eq=False)
class TargetShape:
    """Deviation of the target's points from the flat lattice, in plane and height."""

    lattice_m: FloatArray
    inside_m: FloatArray
    height_m: FloatArray


@dataclass(frozen=True)
class ResidualParts:
    """Rms lengths of the common parts of one camera's residuals, without random scatter.

    The parts overlap. `position_px`: at the same position in the image; `point_px`, `point_m`: at the same point of the
    target, in its plane; `smooth_px`: among neighbours in one image; `alone_px`: not shared by neighbours.
    """

    whole_px: float
    position_px: float
    point_px: float
    point_m: float
    smooth_px: float
    alone_px: float


def covariance_of(rig: StereoRig) -> FloatArray:
    """Return the covariance (32, 32) of a calibrated rig."""
    if rig.covariance is None:
        raise ValueError("rig: expected a calibrated pair with the covariance of its parameters, found none")
    return rig.covariance


def camera_of(rig: StereoRig, side: Side) -> tuple[Camera, FloatArray]:
    """Return one camera and the covariance (13, 13) of its parameters."""
    indices = LEFT if side == "left" else RIGHT
    return (rig.left if side == "left" else rig.right), covariance_of(rig)[np.ix_(indices, indices)]


def baseline_m(rig: StereoRig) -> DerivedQuantity:
    """Return the distance of the two cameras: |t|, u² = eᵀ·C·e with e = t/|t|."""
    translation = rig.right_from_left.translation_m
    length = float(np.linalg.norm(translation))
    direction = translation / length
    return DerivedQuantity(length, _root(direction @ covariance_of(rig)[TRANSLATION, TRANSLATION] @ direction))


def axes_angle_rad(rig: StereoRig) -> DerivedQuantity:
    """Return the angle between the optical axes.

    It is α with a·b = cos α for a = e_z, b = R·e_z. A small rotation δ changes α by δ·(a × b)/|a × b|. Parallel axes
    have no such direction; the largest u is used then.
    """
    axis = rig.right_from_left.rotation[:, 2]
    across = np.cross([0.0, 0.0, 1.0], axis)
    sine = float(np.linalg.norm(across))
    covariance = covariance_of(rig)[ROTATION, ROTATION]
    if sine < 1e-12:
        return DerivedQuantity(0.0, _root(np.linalg.eigvalsh(covariance[:2, :2])[-1]))
    return DerivedQuantity(float(np.arctan2(sine, axis[2])), _root(across @ covariance @ across) / sine)


def distance_m(calibration: Calibration, view: CalibratedView) -> DerivedQuantity:
    """Return the distance of the target's centre from the left camera."""
    rotated = view.left_from_target.rotation @ calibration.shape_m.mean(axis=0)
    centre = rotated + view.left_from_target.translation_m
    length = float(np.linalg.norm(centre))
    gradient = np.concatenate([centre, -centre @ skew(rotated)]) / length
    return DerivedQuantity(length, _root(gradient @ view.covariance @ gradient))


def target_middles_m(calibration: Calibration) -> FloatArray:
    """Return the centre (V, 3) of the target in the left camera's frame."""
    middle = calibration.shape_m.mean(axis=0)
    return np.array([view.left_from_target.apply(middle) for view in calibration.views])


def working_point_m(calibration: Calibration) -> FloatArray:
    """Return the median (3,) of the target's centre over the views."""
    return np.asarray(np.median(target_middles_m(calibration), axis=0))


def tilts_rad(calibration: Calibration) -> FloatArray:
    """Return the tilt (V, 2) of the target's normal to the right and down.

    The angle is that to the left camera's axis.
    """
    normal = np.array([view.left_from_target.rotation[:, 2] for view in calibration.views])
    normal *= -np.sign(np.sum(normal * target_middles_m(calibration), axis=1, keepdims=True))
    across = np.linalg.norm(normal[:, :2], axis=1, keepdims=True)
    angle = np.arctan2(across, -normal[:, 2:])
    return np.asarray(angle * normal[:, :2] / np.where(across > 0, across, 1.0))


def turns_rad(calibration: Calibration) -> FloatArray:
    """Return the rotation (V,) of the target in the left image, clockwise from the right."""
    axis = np.array([view.left_from_target.rotation[:2, 0] for view in calibration.views])
    return np.asarray(np.arctan2(axis[:, 1], axis[:, 0]))


def length_u(calibration: Calibration) -> FloatArray:
    """Return relative standard uncertainties (3,) of lengths along x, y, z by the calibration.

    Axes are those of the left camera. Lengths are `LENGTH_SHARE` of the working distance, about the working point. The
    rig's parameters are perturbed and the same pixels triangulated.
    """
    rig, middle = calibration.rig, working_point_m(calibration)
    half = 0.5 * LENGTH_SHARE * float(np.linalg.norm(middle)) * np.eye(3)
    left, right = rig.project(np.concatenate([middle + half, middle - half]))

    def lengths(delta: FloatArray) -> FloatArray:
        ends = triangulate(rig.perturbed(delta), left[None], right[None]).position_m[0]
        return np.asarray(np.log(np.linalg.norm(ends[:3] - ends[3:], axis=1)))

    return _propagated(lengths, covariance_of(rig))


def distortion(calibration: Calibration, side: Side, columns: int = 33) -> DistortionField:
    """Return the distortion of one camera on a grid, with the uncertainty of all parameters."""
    camera, covariance = camera_of(calibration.rig, side)
    width, height = camera.size_px
    rows = max(3, round(columns * height / width))
    across, down = np.linspace(0, width - 1, columns), np.linspace(0, height - 1, rows)
    pixel = np.stack(np.meshgrid(across, down), axis=-1)

    def displaced(delta: FloatArray) -> FloatArray:
        moved = Camera.from_parameters(camera.parameters + delta, camera.size_px)
        k = moved.matrix
        return np.asarray(pixel - (moved.undistort(pixel) @ k[:2, :2].T + k[:2, 2]))

    u = _propagated(displaced, covariance)
    return DistortionField(pixel, displaced(np.zeros(len(covariance))), np.sqrt((u**2).mean(axis=-1)))


def images_of_camera(calibration: Calibration, side: Side) -> list[CalibratedImage | None]:
    """Return the image of one camera in every view."""
    return [view.left if side == "left" else view.right for view in calibration.views]


def used_points(calibration: Calibration, side: Side) -> tuple[FloatArray, FloatArray, IntArray]:
    """Return positions (M, 2) and residuals (M, 2) of all fitted points, with views."""
    taken = [(view, image) for view, image in enumerate(images_of_camera(calibration, side)) if image is not None]
    empty = [np.empty((0, 2)), np.empty((0, 2)), np.empty(0, int)]
    each = ((p.position_px[p.used], p.residual_px[p.used], np.full(p.used.sum(), view)) for view, p in taken)
    position, residual, view = (np.concatenate(parts) for parts in zip(empty, *each, strict=True))
    return position, residual, view


def residual_map(position_px: FloatArray, residual_px: FloatArray, side_px: float) -> ResidualMap:
    """Return the means of residuals (M, 2) at positions (M, 2) in square cells."""
    cells, mean, count, within, between = _one_way(residual_px, np.floor((position_px + 0.5) / side_px))
    return ResidualMap(side_px, (cells + 0.5) * side_px - 0.5, mean, count, within, between)


def cell_px(calibration: Calibration, side: Side) -> float:
    """Return the side of the square cells in which residuals are averaged."""
    return float(camera_of(calibration.rig, side)[0].size_px[0]) / CELLS_ACROSS


def residual_parts(calibration: Calibration, side: Side) -> ResidualParts:
    """Return the common parts of one camera's residuals."""
    (position, residual, view), spacing = used_points(calibration, side), calibration.target.spacing_m
    index = np.concatenate([p.index[p.used] for p in images_of_camera(calibration, side) if p is not None])
    lattice = calibration.target.points_m(index)
    step = 1e-3 * spacing * np.array([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])
    on_target = np.empty_like(residual)  # in the target's plane, in m
    for number in np.unique(view):
        mine = view == number
        points = calibration.views[number].left_from_target.apply(lattice[mine, None] + step)
        pixel = calibration.rig.project(points)[SIDES.index(side)]
        jacobian = np.swapaxes(pixel[:, 1:] - pixel[:, :1], 1, 2) / (1e-3 * spacing)
        on_target[mine] = np.linalg.solve(jacobian, residual[mine, :, None])[..., 0]
    *_, position_px = _one_way(residual, np.floor((position + 0.5) / cell_px(calibration, side)))
    *_, print_m = _one_way(on_target, index)
    *_, alone, smooth = _one_way(residual, np.column_stack([view, index // NEIGHBOURS]))
    whole = _root((residual**2).sum(axis=1).mean())
    scale = whole / _root((on_target**2).sum(axis=1).mean())
    return ResidualParts(whole, position_px, print_m * scale, print_m, smooth, alone)


def target_shape(calibration: Calibration) -> TargetShape | None:
    """Return the deviation of the target from its flat lattice; None for a flat model.

    The lattice is fitted as a rigid body.
    """
    lattice = calibration.target.points_m(calibration.shape_index)
    if np.abs(calibration.shape_m - lattice).max() < 1e-12:
        return None
    departure = fit_rigid(calibration.shape_m, lattice).apply(calibration.shape_m) - lattice
    return TargetShape(lattice[:, :2], departure[:, :2], departure[:, 2])


def empty_cells(position_px: FloatArray, size_px: Sequence[int] | IntArray) -> FloatArray:
    """Return the corners (K, 4) x0 y0 x1 y1 of cells without a point."""
    width, height = (float(size) for size in size_px)
    columns, rows = COVERAGE_CELLS
    across, down = np.linspace(-0.5, width - 0.5, columns + 1), np.linspace(-0.5, height - 0.5, rows + 1)
    counts, _, _ = np.histogram2d(position_px[:, 0], position_px[:, 1], bins=[across, down])
    i, j = np.nonzero(counts == 0)
    return np.stack([across[i], down[j], across[i + 1], down[j + 1]], axis=1)


def correlation(covariance: FloatArray) -> FloatArray:
    """Return the correlation coefficients of a covariance; NaN for exact parameters."""
    u = np.sqrt(np.diagonal(covariance))
    u = np.where(u > 0, u, np.nan)
    return np.asarray(covariance / np.outer(u, u))


def _one_way(vector: FloatArray, key: FloatArray | IntArray) -> tuple[FloatArray, FloatArray, IntArray, float, float]:
    """Return keys, means and sizes of groups of vectors, and two rms lengths.

    Keys (K, C), means (K, 2) and sizes (K,) are of vectors (M, 2) of equal key (M, C). The rms lengths are those within
    and between the groups. Analysis of variance with random effects: the mean square between groups minus its
    expectation by chance.
    """
    keys, member = np.unique(np.asarray(key, dtype=np.float64), axis=0, return_inverse=True)
    member = member.reshape(-1)
    count = np.bincount(member)
    mean = np.stack([np.bincount(member, weights=vector[:, axis]) for axis in (0, 1)], axis=1) / count[:, None]
    within = float(np.sum((vector - mean[member]) ** 2)) / max(len(vector) - len(count), 1)
    between = float(count @ (mean**2).sum(axis=1)) / len(vector)
    return keys, mean, count, _root(within), _root(between - within * len(count) / len(vector))


def _propagated(function: Callable[[FloatArray], FloatArray], covariance: FloatArray) -> FloatArray:
    """Return standard uncertainties (...) of a function (P,) → (...) of parameters about zero."""
    jacobian = derivatives(function, STEP * np.sqrt(np.diagonal(covariance)))
    variance = np.einsum("...i,ij,...j->...", jacobian, covariance, jacobian)
    return np.asarray(np.sqrt(np.maximum(variance, 0.0)))


def _root(variance: FloatArray | float) -> float:
    """Return the square root; rounding may make a variance of zero slightly negative."""
    return float(np.sqrt(np.maximum(variance, 0.0)))
