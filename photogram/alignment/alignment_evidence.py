"""Six kinds of evidence about the pose of the left camera in the sensor frame, and what the cameras see of them.

Points, pixels of points, faces, poses, motions and axes: each holds what the cameras saw, in the left camera's frame,
and what is known of it in the sensor frame. What was seen carries its own noise as covariance, and the calibration's
errors as effects: the changes of what was seen for one standard uncertainty of each principal component of the
calibration's covariance, which all evidence has in common.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Protocol

import numpy as np

from photogram.arrays import Arrays, BoolArray, ComplexArray, FloatArray, check_shape, derivatives
from photogram.calibration.bundle import model_pixels
from photogram.calibration.initial_bundle import estimate_target_pose, match_numbering
from photogram.camera import TRANSLATION, Camera, StereoRig, principal_components, triangulate
from photogram.geometry import (
    RigidTransform,
    displacement_jacobian,
    rotation_from_vector,
    rotation_vector_rate,
    skew,
    vector_from_rotation,
)
from photogram.motion import RigidMotion
from photogram.targets.target_view import Target, TargetView

_POINT_STEP_M = 1e-6
FEWEST_PIXELS = 4
"""Points whose pixels in one camera leave one pose."""
CALIBRATION = "calibration"
"""Name of the effects of the pair's own calibration."""


@dataclass(frozen=True, eq=False, repr=False)
class EvidenceResiduals(Arrays, shapes="piece B; residual B b; jacobian B b 6; covariance B b b; determines 6"):
    """B groups of b residuals, predicted − known, at a trial pose, linear about it.

    `residual` (B, b); `jacobian` (B, b, 6): change for a small displacement of the pose multiplied from the left,
    shift of the sensor origin (m) and rotation about it (rad); `covariance` (B, b, b), groups independent of each
    other; `common`: by the name of what is common, changes (P, B, b) for one standard uncertainty of each of its P
    unknowns; `piece` (B,): the name under which each group is tested; `determines` (6,): the components that this
    evidence may determine: what it says about others counts only beside evidence that determines them.
    """

    residual: FloatArray
    jacobian: FloatArray
    covariance: FloatArray
    common: Mapping[str, FloatArray]
    piece: tuple[str, ...]
    determines: BoolArray = field(default_factory=lambda: np.ones(6, dtype=np.bool_))

    def __post_init__(self) -> None:
        super().__post_init__()
        for name, changes in self.common.items():
            check_shape(f"common {name}", changes, (None, *self.residual.shape))


def perpendicular_directions(direction: FloatArray) -> FloatArray:
    """Return two unit vectors (2, 3) perpendicular to a direction (3,) and to each other."""
    return np.asarray(np.linalg.svd(np.asarray(direction, dtype=np.float64)[None])[2][1:])


class PoseEvidence(Protocol):
    """Anything that says at a trial pose how far what was seen is from what is known."""

    def residuals(self, sensor_from_camera: RigidTransform) -> EvidenceResiduals:
        """Return the residuals at a trial pose, linear about it."""
        ...


@dataclass(frozen=True, eq=False, repr=False)
class StatedFrame(Arrays, shapes="u 6"):
    """The frame in which something is stated, and how well that frame agrees with the sensor's.

    `u` (6,): standard uncertainties of the position of its origin (m) and of the rotation about it (rad), sensor axes.
    What names the same frame shares its error.
    """

    name: str
    u: FloatArray

    def common(self, jacobian: FloatArray) -> dict[str, FloatArray]:
        """Return the changes (P, B, b) of residuals with this jacobian (B, b, 6)."""
        kept = np.flatnonzero(self.u)
        return {self.name: np.moveaxis(jacobian[..., kept] * self.u[kept], -1, 0)} if len(kept) else {}


SENSOR_FRAME = StatedFrame("", np.zeros(6))


@dataclass(frozen=True, eq=False, repr=False)
class KnownPoints(
    Arrays,
    shapes="names N; camera_m N 3; sensor_m N 3; camera_covariance_m2 N 3 3; sensor_covariance_m2 N 3 3; calibration "
    "P N 3",
):
    """Points seen at `camera_m` (N, 3) whose places `sensor_m` (N, 3) are known, both with covariance (N, 3, 3).

    `calibration` (P, N, 3): effects of the calibration on the points seen. Residual R·x + t − X.

    >>> seen = np.array([[0.0, 0, 0.5], [0.1, 0, 0.5], [0, 0.1, 0.5]])
    >>> known, variance = seen - [0, 0, 0.5], np.broadcast_to(1e-12 * np.eye(3), (3, 3, 3))
    >>> points = KnownPoints(("a", "b", "c"), seen, variance, known, variance, calibration=np.zeros((0, 3, 3)))
    >>> points.residuals(RigidTransform(np.eye(3), np.array([0, 0, -0.5]))).residual.any()
    np.False_
    """

    names: tuple[str, ...]
    camera_m: FloatArray
    camera_covariance_m2: FloatArray
    sensor_m: FloatArray
    sensor_covariance_m2: FloatArray
    calibration: FloatArray
    frame: StatedFrame = SENSOR_FRAME

    def __post_init__(self) -> None:
        super().__post_init__()
        lost = [name for name, point in zip(self.names, self.camera_m, strict=True) if not np.isfinite(point).all()]
        if lost:
            raise ValueError(f"camera_m: expected finite points, found none for {lost[0]}")

    def residuals(self, sensor_from_camera: RigidTransform) -> EvidenceResiduals:
        """Return R·x + t − X and how it answers."""
        rotation, placed = sensor_from_camera.rotation, sensor_from_camera.apply(self.camera_m)
        jacobian = displacement_jacobian(placed)
        return EvidenceResiduals(
            placed - self.sensor_m,
            jacobian,
            rotation @ self.camera_covariance_m2 @ rotation.T + self.sensor_covariance_m2,
            {CALIBRATION: self.calibration @ rotation.T, **self.frame.common(jacobian)},
            self.names,
        )


@dataclass(frozen=True, eq=False, repr=False)
class KnownPixels(
    Arrays,
    shapes="names N; pixel_px N 2; pixel_covariance_px2 N 2 2; sensor_m N 3; sensor_covariance_m2 N 3 3; calibration "
    "P 13",
):
    """Points of known places `sensor_m` (N, 3) seen by one camera at `pixel_px` (N, 2), both with covariance.

    `calibration` (P, 13): steps of the camera's parameters that stand for its errors. Residual: the pixel where the
    camera would show the point, less the one where it does.

    >>> camera = Camera.from_parameters(np.array([1000.0, 1000, 320, 240, 0, 0, 0, 0, 0]), np.array([640, 480]))
    >>> known = np.array([[0.0, 0, 0], [0.1, 0, 0], [0, 0.1, 0], [0, 0, 0.1]])
    >>> seen, noise = camera.project(known + [0, 0, 0.5]), np.broadcast_to(0.01 * np.eye(2), (4, 2, 2))
    >>> points = KnownPixels(tuple("abcd"), camera, seen, noise, known, np.zeros((4, 3, 3)), np.zeros((0, 13)))
    >>> points.residuals(RigidTransform(np.eye(3), np.array([0, 0, -0.5]))).residual.any()
    np.False_
    """

    names: tuple[str, ...]
    camera: Camera
    pixel_px: FloatArray
    pixel_covariance_px2: FloatArray
    sensor_m: FloatArray
    sensor_covariance_m2: FloatArray
    calibration: FloatArray
    frame: StatedFrame = SENSOR_FRAME

    def residuals(self, sensor_from_camera: RigidTransform) -> EvidenceResiduals:
        """Return the residuals, and how they answer: x = Rᵀ·(X − t) by −Rᵀ·[I, −[X]×] to a displacement of the pose."""
        to_camera = sensor_from_camera.inverse()
        placed = to_camera.apply(self.sensor_m)
        shown = self.camera.project(placed)
        lost = [name for name, place in zip(self.names, shown, strict=True) if not np.isfinite(place).all()]
        if lost:
            raise ValueError(f"evidence: expected {lost[0]} before the camera, found it behind; check for mix-ups")
        rate = derivatives(lambda step: self.camera.project(placed + step), np.full(3, _POINT_STEP_M))
        by_place = rate @ to_camera.rotation
        jacobian = -by_place @ displacement_jacobian(self.sensor_m)
        moved = [
            Camera.from_parameters(self.camera.parameters + step, self.camera.size_px).project(placed) - shown
            for step in self.calibration
        ]
        return EvidenceResiduals(
            shown - self.pixel_px,
            jacobian,
            self.pixel_covariance_px2 + by_place @ self.sensor_covariance_m2 @ by_place.mT,
            {CALIBRATION: np.array(moved).reshape(-1, *shown.shape), **self.frame.common(jacobian)},
            self.names,
        )

    @property
    def start(self) -> RigidTransform | None:
        """A pose by perspective from four points or more (Terzakis and Lourakis 2020, ECCV, 478); None of fewer, or of
        points on a line."""
        import cv2

        if len(self.names) < FEWEST_PIXELS:
            return None
        rays = self.camera.undistort(self.pixel_px)
        try:
            found, *pose = cv2.solvePnP(self.sensor_m, rays, np.eye(3), np.zeros(5), flags=cv2.SOLVEPNP_SQPNP)
        except cv2.error:  # as it tells points that leave the rotation open
            return None
        turn, shift = (np.asarray(part, dtype=np.float64).ravel() for part in pose)
        return RigidTransform(rotation_from_vector(turn), shift).inverse() if found else None


@dataclass(frozen=True, eq=False, repr=False)
class KnownFace(Arrays, shapes="camera_m N 3; camera_covariance_m2 N 3 3; point_m 3; calibration P N 3"):
    """Points seen at `camera_m` (N, 3), with covariance (N, 3, 3), on a flat face of known place.

    `point_m` (3,) lies on the face, `normal` (3,) points out of the body; `u_offset_m` along the normal at that point,
    `u_normal_rad` about either direction across it. `calibration` (P, N, 3). Residual n·(R·x + t − p).
    """

    name: str
    camera_m: FloatArray
    camera_covariance_m2: FloatArray
    point_m: FloatArray
    normal: FloatArray
    calibration: FloatArray
    u_offset_m: float = 0.0
    u_normal_rad: float = 0.0
    frame: StatedFrame = SENSOR_FRAME

    def __post_init__(self) -> None:
        super().__post_init__()
        _check_direction("normal", self.normal)
        if not np.isfinite(self.camera_m).all():
            raise ValueError("camera_m: expected finite points, found NaN")

    def residuals(self, sensor_from_camera: RigidTransform) -> EvidenceResiduals:
        """Return the distances of the points from the face and how they answer."""
        placed = sensor_from_camera.apply(self.camera_m)
        seen = sensor_from_camera.rotation.T @ self.normal
        jacobian = (self.normal @ displacement_jacobian(placed))[:, None, :]
        lever = (placed - self.point_m) @ perpendicular_directions(self.normal).T
        own = np.concatenate([np.full((1, len(placed)), self.u_offset_m), self.u_normal_rad * lever.T])
        kept = np.array([self.u_offset_m > 0.0, self.u_normal_rad > 0.0, self.u_normal_rad > 0.0])
        return EvidenceResiduals(
            ((placed - self.point_m) @ self.normal)[:, None],
            jacobian,
            np.einsum("i,nij,j->n", seen, self.camera_covariance_m2, seen)[:, None, None],
            {
                CALIBRATION: (self.calibration @ seen)[..., None],
                self.name: own[kept][..., None],
                **self.frame.common(jacobian),
            },
            (self.name,) * len(placed),
        )


@dataclass(frozen=True, eq=False, repr=False)
class KnownPoses(
    Arrays,
    shapes="names V; left_from_body V; sensor_from_body V; camera_covariance V 6 6; sensor_covariance V 6 6; "
    "calibration P V 6",
):
    """A body seen V times at `left_from_body`, each with covariance (6, 6), whose pose in the sensor frame is known.

    `sensor_from_body` and `sensor_covariance` (V, 6, 6) hold what is known of each time; both covariances are those of
    translation (m) and left-multiplied rotation (rad). `calibration` (P, V, 6): effects on the poses seen, in camera
    axes; `common`: changes (P, V, 6) of the known poses, in sensor axes, by the name of what they have in common.
    """

    names: tuple[str, ...]
    left_from_body: tuple[RigidTransform, ...]
    camera_covariance: FloatArray
    sensor_from_body: tuple[RigidTransform, ...]
    sensor_covariance: FloatArray
    calibration: FloatArray
    common: Mapping[str, FloatArray] = field(default_factory=dict)
    frame: StatedFrame = SENSOR_FRAME

    def residuals(self, sensor_from_camera: RigidTransform) -> EvidenceResiduals:
        """Return position and rotation of the bodies as seen against the known ones."""
        placed = [sensor_from_camera @ seen for seen in self.left_from_body]
        shift = np.array(
            [p.translation_m - k.translation_m for p, k in zip(placed, self.sensor_from_body, strict=True)]
        )
        turned = [p.rotation @ k.rotation.T for p, k in zip(placed, self.sensor_from_body, strict=True)]
        turn = vector_from_rotation(np.array(turned).reshape(-1, 3, 3))
        jacobian = np.zeros((len(placed), 6, 6))
        jacobian[:, :3] = displacement_jacobian(np.array([p.translation_m for p in placed]).reshape(-1, 3))
        jacobian[:, 3:, 3:] = rotation_vector_rate(turn)
        both = np.kron(np.eye(2), sensor_from_camera.rotation)
        return EvidenceResiduals(
            np.concatenate([shift, turn], axis=1),
            jacobian,
            both @ self.camera_covariance @ both.T + self.sensor_covariance,
            {
                CALIBRATION: self.calibration @ both.T,
                **{name: -changes for name, changes in self.common.items()},
                **self.frame.common(jacobian),
            },
            self.names,
        )


@dataclass(frozen=True, eq=False, repr=False)
class KnownDirection(Arrays, shapes="motion V 6; covariance V 6 6; camera_point_m V 3; calibration P V 6"):
    """V motions of a body of which the material point at the sensor origin moves along a known direction.

    `motion` (V, 6): shift (m) of the body's point at `camera_point_m` (V, 3) and rotation (rad), camera axes, small, of
    either sign; `covariance` (V, 6, 6); `calibration` (P, V, 6). `direction` (3,) in the sensor frame with standard
    uncertainty `u_direction_rad` about either direction across it, common to all V motions.
    """

    name: str
    motion: FloatArray
    covariance: FloatArray
    camera_point_m: FloatArray
    direction: FloatArray
    calibration: FloatArray
    u_direction_rad: float = 0.0

    def __post_init__(self) -> None:
        super().__post_init__()
        _check_direction("direction", self.direction)
        if not np.linalg.norm(self.motion[:, :3], axis=1).all():
            raise ValueError("motion: expected a translation, found none")

    def residuals(self, sensor_from_camera: RigidTransform) -> EvidenceResiduals:
        """Return the direction of motion across the known one: e·R·v/|v|, v = u + θ × (o − q) at the origin o.

        Where the origin is decides little as long as the body hardly rocks; that little is no evidence about it.
        """
        rotation, across_it = sensor_from_camera.rotation, perpendicular_directions(self.direction)
        origin = sensor_from_camera.inverse().translation_m
        at_origin = displacement_jacobian(origin - self.camera_point_m)
        moved = (at_origin @ self.motion[:, :, None])[..., 0] @ rotation.T
        sign = np.where(moved @ self.direction < 0.0, -1.0, 1.0)
        rows = (sign / np.linalg.norm(moved, axis=1))[:, None, None] * across_it
        spins = skew(self.motion[:, 3:] @ rotation.T)
        by_motion = rows @ rotation @ at_origin
        return EvidenceResiduals(
            (rows @ moved[..., None])[..., 0],
            rows @ np.concatenate([-spins, -skew(moved)], axis=2),
            by_motion @ self.covariance @ np.swapaxes(by_motion, 1, 2),
            {
                CALIBRATION: np.einsum("vij,pvj->pvi", by_motion, self.calibration),
                self.name: np.repeat(self.u_direction_rad * np.eye(2)[:, None], len(moved), axis=1),
            },
            (self.name,) * len(moved),
            np.arange(6) >= 3,
        )


@dataclass(frozen=True, eq=False, repr=False)
class KnownAxis(Arrays, shapes="camera_axis V 6; covariance V 6 6; calibration P V 6; point_m 3; u_point_m 3"):
    """V times a body was seen to turn about an axis that is known in the sensor frame.

    `camera_axis` (V, 6): a point of the axis (m) and its direction (unit vector of either sign) in the left camera's
    frame, `covariance` (V, 6, 6) of it, `calibration` (P, V, 6). `point_m`, `direction` (3,) in the sensor frame,
    `u_point_m` (3,), `u_direction_rad` about either direction across it, common to all V. Where along the axis the body
    is stays open.
    """

    name: str
    camera_axis: FloatArray
    covariance: FloatArray
    point_m: FloatArray
    direction: FloatArray
    calibration: FloatArray
    u_point_m: FloatArray = field(default_factory=lambda: np.zeros(3))
    u_direction_rad: float = 0.0

    def __post_init__(self) -> None:
        super().__post_init__()
        _check_direction("direction", self.direction)

    def residuals(self, sensor_from_camera: RigidTransform) -> EvidenceResiduals:
        """Return tilt (rad) and offset (m) of the axis seen, across the known one, at its known point."""
        rotation, across_it = sensor_from_camera.rotation, perpendicular_directions(self.direction)
        axis = self.camera_axis[:, 3:] @ rotation.T
        sign = np.where(axis @ self.direction < 0.0, -1.0, 1.0)
        tilt = sign[:, None, None] * across_it
        start = sensor_from_camera.apply(self.camera_axis[:, :3])
        along = ((self.point_m - start) @ self.direction) / (axis @ self.direction)
        place = start + along[:, None] * axis
        count = len(axis)
        jacobian, by_axis = np.zeros((count, 4, 6)), np.zeros((count, 4, 6))
        jacobian[:, :2, 3:] = -tilt @ skew(axis)
        jacobian[:, 2:] = across_it @ displacement_jacobian(place)
        by_axis[:, :2, 3:] = tilt @ rotation
        by_axis[:, 2:, :3] = across_it @ rotation
        by_axis[:, 2:, 3:] = along[:, None, None] * (across_it @ rotation)
        known = np.zeros((5, count, 4))
        known[:2, :, :2] = self.u_direction_rad * np.eye(2)[:, None]
        known[2:, :, 2:] = (across_it * self.u_point_m).T[:, None]
        residual = np.concatenate([tilt @ axis[..., None], across_it @ (place - self.point_m)[..., None]], axis=1)
        return EvidenceResiduals(
            residual[..., 0],
            jacobian,
            by_axis @ self.covariance @ np.swapaxes(by_axis, 1, 2),
            {CALIBRATION: np.einsum("vij,pvj->pvi", by_axis, self.calibration), self.name: known},
            (self.name,) * count,
        )


def _check_direction(name: str, direction: FloatArray) -> None:
    """Raise `ValueError` unless direction (3,) is a unit vector."""
    check_shape(name, direction, (3,))
    length = float(np.linalg.norm(direction))
    if not abs(length - 1.0) < 1e-9:
        raise ValueError(f"{name}: expected a unit vector, found one of length {length:.9g}")


# What a calibrated pair sees of points, targets and motions, with the effects of its calibration's errors.


def calibration_steps(rig: StereoRig, scale_u: float = 0.0) -> FloatArray:
    """Return the steps (P, 32) of the rig's parameters, one standard uncertainty each, that stand for its errors.

    The principal components of its covariance, and the baseline's length by `scale_u`, relative, where that is stated
    apart from it.
    """
    steps = [] if rig.covariance is None else [*principal_components(rig.covariance)]
    if scale_u > 0.0:
        along = np.zeros(len(rig.parameters))
        along[TRANSLATION] = scale_u * rig.right_from_left.translation_m
        steps.append(along)
    return np.array(steps).reshape(-1, len(rig.parameters))


def parameter_derivatives(change: FloatArray, steps: FloatArray) -> FloatArray:
    """Return the derivatives (6, 32) by the rig's parameters of what changes by `change` (6, P) with `steps` (P, 24).

    The smallest ones, in units of the parameters' standard uncertainties, that give these changes.
    """
    sigma = np.sqrt((steps**2).sum(axis=0))
    scale = np.where(sigma > 0.0, sigma, 1.0)
    return np.asarray((np.linalg.pinv(steps / scale) @ change.T).T / scale)


def triangulate_points(
    rig: StereoRig, steps: FloatArray, left_px: FloatArray, right_px: FloatArray, u_px: float | FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return points (N, 3) in the left camera's frame, covariance (N, 3, 3) of the pixels' noise, effects (P, N, 3).

    `left_px`, `right_px` (N, 2) with standard uncertainty `u_px` in each coordinate, of all or (N,); `steps` of
    `calibration_steps`.
    """
    noise = np.asarray(u_px)[..., None, None] ** 2 * np.eye(2)
    points = triangulate(rig, left_px[None], right_px[None], noise, noise)
    nominal = points.position_m[0]
    moved = [triangulate(rig.perturbed(step), left_px[None], right_px[None]).position_m[0] for step in steps]
    return nominal, points.covariance_m2[0], np.array(moved).reshape(len(steps), *nominal.shape) - nominal


def measure_target_pose(
    rig: StereoRig, steps: FloatArray, target: Target, left: TargetView | None, right: TargetView | None
) -> tuple[RigidTransform, FloatArray, FloatArray]:
    """Return the pose `left_from_target`, covariance (6, 6) of the pictures' noise, and effects (P, 6).

    Covariance and effects are those of translation (m) and left-multiplied rotation (rad); at least one picture. With
    J and G the derivatives of the pixels by pose and rig and W their weights, a step s of the rig changes the most
    likely pose by −(Jᵀ·W·J)⁻¹·Jᵀ·W·G·s.
    """
    right = match_numbering(rig, target, left, right)
    pose, covariance = estimate_target_pose(rig, target, left, right)
    change = np.zeros((6, steps.shape[1]))
    for side, view in enumerate((left, right)):
        if view is not None:
            points = target.spacing_m * np.column_stack([view.index, np.zeros(len(view.index))])
            camera = rig.right if side else rig.left
            relative = rig.right_from_left if side else RigidTransform.identity()
            seen = model_pixels(camera, relative, pose, points, view.radius * target.spacing_m)
            weight = np.linalg.inv(view.covariance_px2)
            change -= covariance @ np.asarray(np.einsum("nki,nkl,nlj->ij", seen.by_pose, weight, seen.by_rig(side)))
    return pose, covariance, steps @ change.T


# The direction in which a body moves, and the axis about which it turns.

_RANK = 1e-10  # singular values below this share of the largest count as zero
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
class RotationAxis(Arrays, shapes="line 6; covariance 6 6"):
    """A fixed axis about which a body turned: `line` (6,) a point (m) and the direction (unit vector), `covariance`.

    The point is the one nearest to the motion's origin. `chi2`, `dof`: of the motion against a rotation about that
    axis; the covariance is enlarged by χ²/dof where that is above 1, since then the axis was not as fixed as the frames
    are exact.
    """

    line: FloatArray
    covariance: FloatArray
    chi2: float
    dof: int


def fit_axis(motion: RigidMotion) -> RotationAxis:
    """Return the axis about which a body turns, from its poses against the first frame.

    Least squares over the rotation vectors and the displacements of the axis' points across the axis; those along it
    are left free. The noise of the first frame, against which all poses count, is a common unknown whose covariance is
    that of frame 0. Angles may be large, and their sequence is of no account.
    """
    used = np.isfinite(motion.pose).all(axis=1) & motion.pose.any(axis=1)
    pose, covariance = motion.pose[used], motion.covariance[used]
    if len(pose) < 3:
        raise ValueError(f"motion: expected at least 3 frames after the first, found {len(pose)}")
    direction = np.linalg.svd(pose[:, 3:], full_matrices=False)[2][0]
    tilt = perpendicular_directions(direction)
    held = tilt @ (np.eye(3) - rotation_from_vector(pose[:, 3:])) @ tilt.T
    point = np.linalg.lstsq(held.reshape(-1, 2), (pose[:, :3] @ tilt.T).ravel(), rcond=None)[0]
    line = np.concatenate([point @ tilt, direction])  # the point that moves least
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
    """Return whitened rows (4F + 6, 10), residuals and the tangents (6, 4) of the axis.

    Residuals of a frame: its rotation vector and the displacement of the axis' point, both across the axis. Unknown are
    two components of the point, two of the direction, and six of the first frame's noise. With the point held nearest
    to the origin, a change of direction moves it along the axis, which the fourth block of the tangents says.
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


def sum_of_squares(rows: FloatArray, residual: FloatArray) -> tuple[float, int]:
    """Return the least sum of squares of residual + rows·x and its degrees of freedom."""
    if not len(rows):
        return 0.0, 0
    scale = np.linalg.norm(rows, axis=0)
    u, singular, _ = np.linalg.svd(rows / np.where(scale > 0.0, scale, 1.0), full_matrices=False)
    fitted = u[:, singular > _RANK * singular[0]]
    left = residual - fitted @ (fitted.T @ residual)
    return float(left @ left), len(rows) - fitted.shape[1]
