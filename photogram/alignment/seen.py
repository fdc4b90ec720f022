"""What a calibrated pair sees in the left camera's frame, with the calibration's effects on it."""

from __future__ import annotations

import numpy as np

from photogram._checks import FloatArray
from photogram.calibrate.model import see
from photogram.calibrate.pose import target_pose
from photogram.camera import StereoRig, principal_components
from photogram.rigid import RigidTransform
from photogram.target.view import Target, TargetView
from photogram.triangulate import triangulate


def calibration_steps(rig: StereoRig, scale_u: float = 0.0) -> FloatArray:
    """Return the steps (P, 24) of the rig's parameters, one standard uncertainty each, that stand for its errors.

    The principal components of its covariance, and the baseline's length by `scale_u`, relative, where that is stated
    apart from it.
    """
    steps = [] if rig.covariance is None else [*principal_components(rig.covariance)]
    if scale_u > 0.0:
        steps.append(np.concatenate([np.zeros(21), scale_u * rig.right_from_left.translation_m]))
    return np.array(steps).reshape(-1, 24)


def by_parameters(change: FloatArray, steps: FloatArray) -> FloatArray:
    """Return the derivatives (6, 24) by the rig's parameters of what changes by `change` (6, P) with `steps` (P, 24).

    The smallest ones, in units of the parameters' standard uncertainties, that give these changes.
    """
    sigma = np.sqrt((steps**2).sum(axis=0))
    scale = np.where(sigma > 0.0, sigma, 1.0)
    return np.asarray((np.linalg.pinv(steps / scale) @ change.T).T / scale)


def seen_points(
    rig: StereoRig, steps: FloatArray, left_px: FloatArray, right_px: FloatArray, u_px: float
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return points (N, 3) in the left camera's frame, covariance (N, 3, 3) of the pixels' noise, effects (P, N, 3).

    `left_px`, `right_px` (N, 2) with standard uncertainty `u_px` in each coordinate; `steps` of `calibration_steps`.
    """
    noise = u_px**2 * np.eye(2)
    found = triangulate(rig, left_px[None], right_px[None], noise, noise)
    nominal = found.position_m[0]
    effects = np.empty((len(steps), *nominal.shape))
    for place, step in enumerate(steps):
        effects[place] = triangulate(rig.perturbed(step), left_px[None], right_px[None]).position_m[0] - nominal
    return nominal, found.covariance_m2[0], effects


def seen_target(
    rig: StereoRig, steps: FloatArray, target: Target, left: TargetView | None, right: TargetView | None
) -> tuple[RigidTransform, FloatArray, FloatArray]:
    """Return the pose `left_from_target`, covariance (6, 6) of the pictures' noise, and effects (P, 6).

    Covariance and effects are those of translation (m) and left-multiplied rotation (rad); at least one picture. With
    J and G the derivatives of the pixels by pose and rig and W their weights, a step s of the rig changes the most
    likely pose by −(Jᵀ·W·J)⁻¹·Jᵀ·W·G·s.
    """
    pose, covariance = target_pose(rig, target, left, right)
    change = np.zeros((6, 24))
    for side, view in enumerate((left, right)):
        if view is not None:
            change -= covariance @ _pulled_by_rig(rig, target, pose, view, side)
    return pose, covariance, steps @ change.T


def _pulled_by_rig(rig: StereoRig, target: Target, pose: RigidTransform, view: TargetView, side: int) -> FloatArray:
    """Return Jᵀ·W·G (6, 24) of one picture."""
    points = target.spacing_m * np.column_stack([view.index, np.zeros(len(view.index))])
    camera = rig.right if side else rig.left
    relative = rig.right_from_left if side else RigidTransform.identity()
    seen = see(camera, relative, pose, points, view.radius * target.spacing_m)
    weight = np.linalg.inv(view.covariance_px2)
    return np.asarray(np.einsum("nki,nkl,nlj->ij", seen.by_pose, weight, seen.by_rig(side)))
