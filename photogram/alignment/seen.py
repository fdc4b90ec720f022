"""What a calibrated pair sees of points, targets and motions, with the effects of its calibration's errors."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from photogram.alignment.evidence import across
from photogram.alignment.solve import sum_of_squares
from photogram.arrays import Arrays, ComplexArray, FloatArray
from photogram.calibration.bundle import see
from photogram.calibration.start import target_pose
from photogram.camera import StereoRig, principal_components, triangulate
from photogram.geometry import RigidTransform, rotation_from_vector, rotation_vector_rate, skew
from photogram.motion import RigidMotion
from photogram.targets.view import Target, TargetView


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
            points = target.spacing_m * np.column_stack([view.index, np.zeros(len(view.index))])
            camera = rig.right if side else rig.left
            relative = rig.right_from_left if side else RigidTransform.identity()
            seen = see(camera, relative, pose, points, view.radius * target.spacing_m)
            weight = np.linalg.inv(view.covariance_px2)
            change -= covariance @ np.asarray(np.einsum("nki,nkl,nlj->ij", seen.by_pose, weight, seen.by_rig(side)))
    return pose, covariance, steps @ change.T


# The direction in which a body moves, and the axis about which it turns.

_STEPS = 30
_CONVERGED = 1e-12
_LEAST_TURN = 5.0  # turn of the body in standard uncertainties below which it has no axis


def linear_motion(
    phasor: ComplexArray, covariance: FloatArray, effects: ComplexArray
) -> tuple[FloatArray, FloatArray, FloatArray, float]:
    """Return the motion (6,) along the major axis of the translation's ellipse, from displacement phasors (6,).

    `covariance` (12, 12) of [all Re, all Im], `effects` (P, 6) changes of the phasors. Turned by the phase φ of
    Σ u² = |·|·e^{2jφ} over the translations u, the real part of phasors times e^{−jφ} is the motion at its largest
    translation, and the imaginary part the minor axis. Returned are motion, covariance (6, 6), effects (P, 6), and the
    ratio of minor to major axis: the angle (rad) by which the body's translation departs from a line.
    """
    phase = 0.5 * np.angle(np.sum(phasor[:3] ** 2))
    turned = phasor * np.exp(-1j * phase)
    real_part = np.concatenate([np.cos(phase) * np.eye(6), np.sin(phase) * np.eye(6)], axis=1)
    minor = float(np.linalg.norm(turned[:3].imag) / np.linalg.norm(turned[:3].real))
    changes = (effects * np.exp(-1j * phase)).real
    return turned.real, real_part @ covariance @ real_part.T, changes, minor


@dataclass(frozen=True, eq=False, repr=False)
class Axis(Arrays, shapes="line 6; covariance 6 6"):
    """A fixed axis about which a body turned: `line` (6,) a point (m) and the direction (unit vector), `covariance`.

    The point is the one nearest to the motion's origin. `chi2`, `dof`: of the motion against a rotation about that
    axis; the covariance is enlarged by χ²/dof where that is above 1, since then the axis was not as fixed as the frames
    are exact. `turn_rad`: range of the angles.
    """

    line: FloatArray
    covariance: FloatArray
    chi2: float
    dof: int
    turn_rad: float


def fit_axis(motion: RigidMotion) -> Axis:
    """Return the axis about which a body turns, from its poses against the first frame.

    Least squares over the rotation vectors and the displacements of the axis' points across the axis; those along it
    are left free. The noise of the first frame, against which all poses count, is a common unknown whose covariance is
    that of frame 0. Angles may be large, and their sequence is of no account.
    """
    used = np.isfinite(motion.pose).all(axis=1) & motion.pose.any(axis=1)
    pose, covariance = motion.pose[used], motion.covariance[used]
    if len(pose) < 3:
        raise ValueError(f"motion: expected at least 3 frames after the first, found {len(pose)}")
    line = _start(pose)
    spread = _turns(pose, line[3:])
    noise = float(np.sqrt(np.median(covariance[:, 3:, 3:] @ line[3:] @ line[3:])))
    if not np.ptp(spread) > _LEAST_TURN * noise:
        raise ValueError(
            f"motion: expected a body that turns, found {np.ptp(spread):.2g} rad with a noise of {noise:.2g}"
        )
    reference = motion.covariance[0] if np.isfinite(motion.covariance[0]).all() else covariance[0]
    for _ in range(_STEPS):
        rows, residual, tangents = _equations(pose, covariance, reference, line)
        step = np.linalg.lstsq(rows, -residual, rcond=None)[0]
        point, direction = np.split(line + tangents @ step[:4], 2)
        direction = direction / np.linalg.norm(direction)
        line = np.concatenate([point - (point @ direction) * direction, direction])  # the point nearest to the origin
        if np.abs(step[:4]).max() <= _CONVERGED * max(1.0, float(np.abs(line).max())):
            break
    rows, residual, tangents = _equations(pose, covariance, reference, line)
    chi2, dof = sum_of_squares(rows, residual)
    free = tangents @ np.linalg.inv(rows.T @ rows)[:4, :4] @ tangents.T
    origin = np.concatenate([motion.origin_m, np.zeros(3)])
    return Axis(line + origin, free * max(1.0, chi2 / dof), chi2, dof, float(np.ptp(spread)))


def _turns(pose: FloatArray, direction: FloatArray) -> FloatArray:
    """Return the angles (F,) about a direction."""
    return np.asarray(pose[:, 3:] @ direction)


def _start(pose: FloatArray) -> FloatArray:
    """Return a first axis: principal direction of the rotation vectors, and the point that moves least."""
    direction = np.linalg.svd(pose[:, 3:], full_matrices=False)[2][0]
    tilt = across(direction)
    held = tilt @ (np.eye(3) - rotation_from_vector(pose[:, 3:])) @ tilt.T
    point = np.linalg.lstsq(held.reshape(-1, 2), (pose[:, :3] @ tilt.T).ravel(), rcond=None)[0]
    return np.concatenate([point @ tilt, direction])


def _equations(
    pose: FloatArray, covariance: FloatArray, reference: FloatArray, line: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return whitened rows (4F + 6, 10), residuals and the tangents (6, 4) of the axis.

    Residuals of a frame: its rotation vector and the displacement of the axis' point, both across the axis. Unknown are
    two components of the point, two of the direction, and six of the first frame's noise. With the point held nearest
    to the origin, a change of direction moves it along the axis, which the fourth block of the tangents says.
    """
    point, direction = line[:3], line[3:]
    tilt = across(direction)
    rotation = rotation_from_vector(pose[:, 3:])
    moved = rotation @ point + pose[:, :3] - point
    residual = np.concatenate([pose[:, 3:] @ tilt.T, moved @ tilt.T], axis=1)
    left = np.linalg.inv(rotation_vector_rate(pose[:, 3:]))
    by_pose = np.zeros((len(pose), 4, 6))
    by_pose[:, :2, 3:] = tilt
    by_pose[:, 2:, :3] = tilt
    by_pose[:, 2:, 3:] = -tilt @ skew(rotation @ point) @ left
    by_axis = np.zeros((len(pose), 4, 4))
    by_axis[:, 2:, :2] = tilt @ (rotation - np.eye(3)) @ tilt.T
    by_axis[:, :2, 2:] = -_turns(pose, direction)[:, None, None] * np.eye(2)
    by_axis[:, 2:, 2:] = -(moved @ direction)[:, None, None] * np.eye(2)
    first = np.zeros((len(pose), 6, 6))  # T·exp(n): the first frame's noise moves every pose from the right
    first[:, :3, :3] = rotation
    first[:, 3:, 3:] = rotation_vector_rate(-pose[:, 3:])
    by_first = by_pose @ first
    white = np.linalg.cholesky(by_pose @ covariance @ np.swapaxes(by_pose, 1, 2))
    stacked = np.concatenate([by_axis, by_first @ np.linalg.cholesky(reference), residual[..., None]], axis=2)
    stacked = np.linalg.solve(white, stacked).reshape(-1, 11)
    rows = np.concatenate([stacked[:, :10], np.eye(10)[4:]])
    tangents = np.zeros((6, 4))
    tangents[:3, :2] = tilt.T
    tangents[3:, 2:] = tilt.T
    tangents[:3, 2:] = -np.outer(direction, tilt @ point)
    return rows, np.concatenate([stacked[:, 10], np.zeros(6)]), tangents
