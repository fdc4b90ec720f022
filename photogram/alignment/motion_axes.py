"""Direction of a body's motion, and the axis about which it turns."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from photogram.alignment.alignment_evidence import perpendicular_directions
from photogram.geometry import rotation_from_vector, rotation_vector_rate, skew
from photogram.motion import RigidMotion
from shakercal._common.arrays import Arrays, ComplexArray, FloatArray

_RANK = 1e-10  # singular values below this share of the largest count as zero
_STEPS = 30  # limit of the Gauss–Newton steps; some five are usual
_CONVERGED = 1e-12  # relative step that ends the iteration, near rounding
_LEAST_TURN = 5.0  # least rotation of a body in standard uncertainties


def linear_motion(
    phasor: ComplexArray, covariance: FloatArray, effects: ComplexArray
) -> tuple[FloatArray, FloatArray, FloatArray, float]:
    """Return the motion (6,) along the major axis of the translation's ellipse.

    Input are displacement phasors (6,), their `covariance` (12, 12) of [all Re, all Im] and `effects` (P, 6).
    Multiplied by e^{−jφ}, with the phase φ of Σ u² = |·|·e^{2jφ} over the translations u, the phasors have the motion
    at its largest translation as real part and the minor axis as imaginary part. Returned are motion, covariance (6,
    6), effects (P, 6) and the ratio of minor to major axis. The ratio is the angle (rad) between the translation and a
    line.
    """
    phase = 0.5 * np.angle(np.sum(phasor[:3] ** 2))
    rotated = phasor * np.exp(-1j * phase)
    real_part = np.concatenate([np.cos(phase) * np.eye(6), np.sin(phase) * np.eye(6)], axis=1)
    minor = float(np.linalg.norm(rotated[:3].imag) / np.linalg.norm(rotated[:3].real))
    changes = (effects * np.exp(-1j * phase)).real
    return rotated.real, real_part @ covariance @ real_part.T, changes, minor


@dataclass(frozen=True, eq=False, repr=False)
class RotationAxis(Arrays, shapes="line 6; covariance 6 6"):
    """A fixed axis about which a body turned, with covariance and goodness of fit.

    `line` (6,): the point (m) nearest to the motion's origin and the direction (unit vector), with `covariance` (6, 6).
    `chi2` and `dof` test the motion against a rotation about that axis. Above 1, χ²/dof multiplies the covariance: the
    axis then moved more than the noise of the frames.
    """

    line: FloatArray
    covariance: FloatArray
    chi2: float
    dof: int


def fit_axis(motion: RigidMotion) -> RotationAxis:
    """Return the axis about which a body turns, from its poses relative to frame 0.

    Least squares over the rotation vectors and the displacements of the axis points across the axis; displacements
    along the axis are free. The noise of frame 0 is a common unknown with that frame's covariance. Angles may be large;
    their sequence has no influence.
    """
    used = np.isfinite(motion.pose).all(axis=1) & motion.pose.any(axis=1)
    pose, covariance = motion.pose[used], motion.covariance[used]
    if len(pose) < 3:
        raise ValueError(f"motion: expected at least 3 frames after the first, found {len(pose)}")
    direction = np.linalg.svd(pose[:, 3:], full_matrices=False)[2][0]
    tilt = perpendicular_directions(direction)
    projected = tilt @ (np.eye(3) - rotation_from_vector(pose[:, 3:])) @ tilt.T
    point = np.linalg.lstsq(projected.reshape(-1, 2), (pose[:, :3] @ tilt.T).ravel(), rcond=None)[0]
    line = np.concatenate([point @ tilt, direction])  # the point with the least motion
    angle = np.ptp(pose[:, 3:] @ direction)
    noise = float(np.sqrt(np.median(covariance[:, 3:, 3:] @ line[3:] @ line[3:])))
    if not angle > _LEAST_TURN * noise:
        raise ValueError(f"motion: expected a body that turns, found {angle:.2g} rad with a noise of {noise:.2g}")
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
    return RotationAxis(line + origin, free * max(1.0, chi2 / dof), chi2, dof)


def _equations(
    pose: FloatArray, covariance: FloatArray, reference: FloatArray, line: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return whitened rows (4F + 6, 10), residuals and tangents (6, 4) of an axis.

    Residuals of a frame are its rotation vector and the displacement of the axis point, both across the axis. Unknown
    are two components of the point, two of the direction, and six of the noise of frame 0. The point stays the one
    nearest to the origin, so a change of direction moves it along the axis: the fourth block of the tangents.
    """
    point, direction = line[:3], line[3:]
    tilt = perpendicular_directions(direction)
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
    by_axis[:, :2, 2:] = -(pose[:, 3:] @ direction)[:, None, None] * np.eye(2)
    by_axis[:, 2:, 2:] = -(moved @ direction)[:, None, None] * np.eye(2)
    first = np.zeros((len(pose), 6, 6))  # T·exp(n): the noise of frame 0 multiplies every pose from the right
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


def sum_of_squares(rows: FloatArray, residual: FloatArray) -> tuple[float, int]:
    """Return the least sum of squares of residual + rows·x and its degrees of freedom."""
    if not len(rows):
        return 0.0, 0
    scale = np.linalg.norm(rows, axis=0)
    u, singular, _ = np.linalg.svd(rows / np.where(scale > 0.0, scale, 1.0), full_matrices=False)
    fitted = u[:, singular > _RANK * singular[0]]
    left = residual - fitted @ (fitted.T @ residual)
    return float(left @ left), len(rows) - fitted.shape[1]
