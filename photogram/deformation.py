"""What a body does beside its rigid motion: residual of every point, with covariance."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from photogram._checks import FloatArray, check_shape
from photogram.motion import RigidMotion
from photogram.rigid import rotation_from_vector, rotation_vector_rate, skew
from photogram.triangulate import Points


@dataclass(frozen=True, eq=False)
class Deformation:
    """Displacement of N points against the rigidly moving body, in its axes in the pose of the reference.

    reference_m (N, 3): where the points are at rest; residual_m (F, N, 3): about each point's mean over time;
    covariance_m2 (F, N, 3, 3). NaN = missing.
    """

    reference_m: FloatArray
    residual_m: FloatArray
    covariance_m2: FloatArray

    def __post_init__(self) -> None:
        """Refuse shapes that do not belong together."""
        check_shape("reference_m", self.reference_m, (None, 3))
        check_shape("residual_m", self.residual_m, (None, len(self.reference_m), 3))
        check_shape("covariance_m2", self.covariance_m2, (*self.residual_m.shape, 3))


def deformation(points: Points, motion: RigidMotion, reference_m: FloatArray | None = None) -> Deformation:
    """Return what remains of points (F, N) after their body's `motion` against reference (N, 3), by default frame 0.

    e = Rᵀ·(x' − o − t) − (x − o) without each point's mean over the F frames in which it is seen, which takes out the
    noise of the reference: it is constant in the axes of the body. Bending looks smaller by its best rigid fit.

    Vₖ = Rᵀ·(Cₖ − J·Pₖ·Jᵀ)·R, J = [I, −[R·(x − o)]×], with the point's covariance Cₖ and that of the pose Pₖ (as shift
    and small left rotation): the least-squares residual's own, C − J·(Σ Jᵀ·C⁻¹·J)⁻¹·Jᵀ, for points that the fit used,
    and the same for a motion from more than these points (an efficient estimate is uncorrelated with its difference
    from another one: Hausman 1978, Econometrica 46, 1251). The mean leaves (1 − 2/F)·Vₖ + Σ V/F².
    """
    reference = points.position_m[0] if reference_m is None else np.asarray(reference_m, dtype=np.float64)
    frames, count, _ = points.position_m.shape
    check_shape("reference_m", reference, (count, 3))
    check_shape("motion.pose", motion.pose, (frames, 6))
    rotation = rotation_from_vector(motion.pose[:, 3:])
    rest = reference - motion.origin_m
    carried = points.position_m - motion.origin_m - motion.pose[:, None, :3]
    residual = carried @ rotation - rest
    arm = rest @ np.swapaxes(rotation, 1, 2)
    own = np.swapaxes(rotation, 1, 2)[:, None] @ (points.covariance_m2 - _leverage(arm, motion)) @ rotation[:, None]
    seen = np.asarray(np.isfinite(residual).all(axis=2) & np.isfinite(own).all(axis=(2, 3)))
    number = np.maximum(seen.sum(axis=0), 1)
    mean = np.sum(np.where(seen[..., None], residual, 0.0), axis=0) / number[:, None]
    shared = np.sum(np.where(seen[..., None, None], own, 0.0), axis=0) / (number**2)[:, None, None]
    covariance = (1.0 - 2.0 / number)[:, None, None] * own + shared
    return Deformation(
        reference,
        np.where(seen[..., None], residual - mean, np.nan),
        np.where(seen[..., None, None], covariance, np.nan),
    )


def _leverage(arm: FloatArray, motion: RigidMotion) -> FloatArray:
    """Covariance (F, N, 3, 3) of the rigidly moved points with arms (F, N, 3), from that of the pose."""
    step_of_pose = np.broadcast_to(np.eye(6), motion.covariance.shape).copy()
    step_of_pose[:, 3:, 3:] = np.linalg.inv(rotation_vector_rate(motion.pose[:, 3:]))
    covariance = step_of_pose @ motion.covariance @ np.swapaxes(step_of_pose, 1, 2)
    leverage = np.empty((*arm.shape, 3))
    for frame, here in enumerate(arm):
        slope = np.concatenate([np.broadcast_to(np.eye(3), (len(here), 3, 3)), -skew(here)], axis=2)
        leverage[frame] = slope @ covariance[frame] @ np.swapaxes(slope, 1, 2)
    return leverage
