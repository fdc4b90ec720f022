"""Where a target stands, seen by a calibrated pair."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from photogram._checks import FloatArray, IntArray
from photogram.calibrate.adjust import Bundle, Picture, moved_pose
from photogram.calibrate.shape import make_shape
from photogram.camera import StereoRig
from photogram.rigid import RigidTransform, rotation_from_vector
from photogram.target.view import Target, TargetView

_STEPS = 30
_CONVERGED = 1e-9  # expected decrease of the sum of squares that ends the iteration


def target_pose(
    rig: StereoRig, target: Target, left: TargetView | None, right: TargetView | None
) -> tuple[RigidTransform, FloatArray]:
    """Return the pose `left_from_target` and its covariance (6, 6): translation (m), left-multiplied rotation (rad).

    Gauss–Newton on the points of one or both pictures, from the better of the two poses in which a plane looks alike
    (Collins and Bartoli 2014, International Journal of Computer Vision 109, 252). The covariance is that of the
    pictures' noise: the calibration's and the spacing's uncertainty are common to all poses and not contained.
    """
    seen = [(view, side) for side, view in enumerate((left, right)) if view is not None]
    if not seen:
        raise ValueError("left, right: expected at least one picture of the target, found none")
    index = np.unique(np.concatenate([view.index for view, _ in seen]), axis=0)
    shape = make_shape("flat", index, target.spacing_m)
    pictures = [picture_of(view, 0, side, index, target.spacing_m) for view, side in seen]
    found = [_refined(Bundle(rig, (start,), shape), pictures) for start in _starts(rig, pictures[0], shape.flat_m)]
    best = min(found, key=lambda fit: fit[2])
    if not np.isfinite(best[2]):
        raise ValueError(f"{seen[0][0].name}: no pose of the target explains its points")
    return best[0], best[1]


def picture_of(view: TargetView, number: int, side: int, index: IntArray, spacing_m: float) -> Picture:
    """Return a target view as picture of view `number`, its points as rows of `index` (P, 2)."""
    rows = {tuple(pair): row for row, pair in enumerate(index.tolist())}
    point = np.array([rows[tuple(pair)] for pair in view.index.tolist()], dtype=np.int64)
    precision = np.asarray(np.linalg.inv(view.covariance_px2), dtype=np.float64)
    return Picture(number, side, point, view.position_px, precision, view.radius * spacing_m)


def _starts(rig: StereoRig, picture: Picture, flat_m: FloatArray) -> list[RigidTransform]:
    """Return the two poses of a plane that one picture allows, as poses in the left camera."""
    import cv2

    camera = rig.right if picture.side else rig.left
    rays = camera.undistort(picture.position_px)
    count, turns, shifts, _ = cv2.solvePnPGeneric(
        flat_m[picture.point], rays, np.eye(3), np.zeros(5), flags=cv2.SOLVEPNP_IPPE
    )
    if not count:
        raise ValueError("left, right: expected points of a target that are not all on one line")
    from_target = [
        RigidTransform(rotation_from_vector(np.array(turn, float).ravel()), np.array(shift, float).ravel())
        for turn, shift in zip(turns, shifts, strict=True)
    ]
    to_left = rig.right_from_left.inverse() if picture.side else None
    return [pose if to_left is None else to_left @ pose for pose in from_target]


def _refined(bundle: Bundle, pictures: list[Picture]) -> tuple[RigidTransform, FloatArray, float]:
    """Return the pose after Gauss–Newton, its covariance and the sum of squares (infinite where it diverges)."""
    for _ in range(_STEPS):
        normal, side, squares = np.zeros((6, 6)), np.zeros(6), 0.0
        for picture in pictures:
            seen = bundle.see(picture)
            residual = picture.position_px - seen.pixel
            weighted = picture.precision @ seen.by_pose
            normal += np.einsum("nki,nkj->ij", seen.by_pose, weighted)
            side += np.einsum("nki,nk->i", weighted, residual)
            squares += float(np.einsum("ni,nij,nj->", residual, picture.precision, residual))
        if not np.isfinite(squares):
            break
        step = np.asarray(np.linalg.solve(normal, side), dtype=np.float64)
        middle = bundle.shape.flat_m.mean(axis=0)
        bundle = replace(bundle, poses=(moved_pose(middle, bundle.poses[0], step, np.zeros(2)),))
        if side @ step < _CONVERGED:
            return bundle.poses[0], np.asarray(np.linalg.inv(normal), dtype=np.float64), squares
    return bundle.poses[0], np.full((6, 6), np.nan), np.inf
