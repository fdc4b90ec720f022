"""Six kinds of evidence about the pose of the left camera in the sensor frame.

The kinds are points, pixels of points, faces, poses, motions and axes. Each kind combines observations in the left
camera's frame with stated positions in the sensor frame. Observations have a covariance from image noise and effects of
the calibration. An effect is the change of an observation for one standard uncertainty of a principal component of the
calibration's covariance. All evidence shares these components.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Protocol

import numpy as np

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
from photogram.targets.target_view import Target, TargetView
from shakercal._common.arrays import Arrays, BoolArray, FloatArray, check_shape
from shakercal._common.propagation import derivatives

_POINT_STEP_M = 1e-6  # step of the numeric derivative by a point, moves its image by far less than a pixel
FEWEST_PIXELS = 4
"""Least number of points for a unique pose from one camera."""
CALIBRATION_ERROR = "calibration"
"""Name of the common error of the pair's calibration in `EvidenceResiduals.common`."""


@dataclass(frozen=True, eq=False, repr=False)
class EvidenceResiduals(Arrays, shapes="piece_name B; residual B b; jacobian B b 6; covariance B b b; determines 6"):
    """B groups of b residuals (predicted − stated) at a trial pose, with derivatives.

    Attributes
    ----------
    residual : (B, b).
    jacobian : (B, b, 6), change for a small displacement of the pose, multiplied from the left: shift of the sensor
        origin (m) and rotation about it (rad).
    covariance : (B, b, b); the groups are independent of each other.
    common : By the name of a common error, changes (P, B, b) for one standard uncertainty of each of its P unknowns.
    piece_name : (B,), name of the piece of evidence to which each group belongs; each piece is tested as a whole.
    determines : (6,), components that this evidence may determine. Its information about other components counts only
        together with evidence that determines them.
    """

    residual: FloatArray
    jacobian: FloatArray
    covariance: FloatArray
    common: Mapping[str, FloatArray]
    piece_name: tuple[str, ...]
    determines: BoolArray = field(default_factory=lambda: np.ones(6, dtype=np.bool_))

    def __post_init__(self) -> None:
        super().__post_init__()
        for name, changes in self.common.items():
            check_shape(f"common {name}", changes, (None, *self.residual.shape))


def perpendicular_directions(direction: FloatArray) -> FloatArray:
    """Return two unit vectors (2, 3) perpendicular to a direction (3,) and to each other."""
    return np.asarray(np.linalg.svd(np.asarray(direction, dtype=np.float64)[None])[2][1:])


class PoseEvidence(Protocol):
    """Evidence with residuals between observed and stated quantities at a trial pose."""

    def residuals(self, sensor_from_camera: RigidTransform) -> EvidenceResiduals:
        """Return the residuals at a trial pose with their derivatives."""
        ...


@dataclass(frozen=True, eq=False, repr=False)
class StatedFrame(Arrays, shapes="u 6"):
    """A frame in which positions are stated, with its uncertainty relative to the sensor frame.

    `u` (6,): standard uncertainties of the position of its origin (m) and of the rotation about it (rad), sensor axes.
    Evidence stated in the same frame shares its error.
    """

    name: str
    u: FloatArray

    def common(self, jacobian: FloatArray) -> dict[str, FloatArray]:
        """Return the effects (P, B, b) of the frame's error on residuals.

        `jacobian` (B, b, 6) is that of the residuals by the pose.
        """
        uncertain = np.flatnonzero(self.u)
        return {self.name: np.moveaxis(jacobian[..., uncertain] * self.u[uncertain], -1, 0)} if len(uncertain) else {}


SENSOR_FRAME = StatedFrame("", np.zeros(6))


@dataclass(frozen=True, eq=False, repr=False)
class KnownPoints(
    Arrays,
    shapes="names N; camera_m N 3; sensor_m N 3; camera_covariance_m2 N 3 3; sensor_covariance_m2 N 3 3; "
    "calibration_effects P N 3",
):
    """Points observed in the camera frame whose positions in the sensor frame are known.

    Attributes
    ----------
    names : Of the N points.
    camera_m, camera_covariance_m2 : (N, 3) and (N, 3, 3), observed in the left camera's frame.
    sensor_m, sensor_covariance_m2 : (N, 3) and (N, 3, 3), known in the sensor frame.
    calibration_effects : (P, N, 3), effects of the calibration on the observed points.
    frame : The frame of `sensor_m`; default the sensor frame without uncertainty.

    Notes
    -----
    The residual is R·x + t − X.

    Examples
    --------
    >>> seen = np.array([[0.0, 0, 0.5], [0.1, 0, 0.5], [0, 0.1, 0.5]])
    >>> known, variance = seen - [0, 0, 0.5], np.broadcast_to(1e-12 * np.eye(3), (3, 3, 3))
    >>> points = KnownPoints(("a", "b", "c"), seen, variance, known, variance, calibration_effects=np.zeros((0, 3, 3)))
    >>> points.residuals(RigidTransform(np.eye(3), np.array([0, 0, -0.5]))).residual.any()
    np.False_
    """

    names: tuple[str, ...]
    camera_m: FloatArray
    camera_covariance_m2: FloatArray
    sensor_m: FloatArray
    sensor_covariance_m2: FloatArray
    calibration_effects: FloatArray
    frame: StatedFrame = SENSOR_FRAME

    def __post_init__(self) -> None:
        super().__post_init__()
        lost = [name for name, point in zip(self.names, self.camera_m, strict=True) if not np.isfinite(point).all()]
        if lost:
            raise ValueError(f"camera_m: expected finite points, found NaN for {lost[0]}")

    def residuals(self, sensor_from_camera: RigidTransform) -> EvidenceResiduals:
        """Return R·x + t − X with its derivatives."""
        rotation, placed = sensor_from_camera.rotation, sensor_from_camera.apply(self.camera_m)
        jacobian = displacement_jacobian(placed)
        return EvidenceResiduals(
            placed - self.sensor_m,
            jacobian,
            rotation @ self.camera_covariance_m2 @ rotation.T + self.sensor_covariance_m2,
            {CALIBRATION_ERROR: self.calibration_effects @ rotation.T, **self.frame.common(jacobian)},
            self.names,
        )


@dataclass(frozen=True, eq=False, repr=False)
class KnownPixels(
    Arrays,
    shapes="names N; pixel_px N 2; pixel_covariance_px2 N 2 2; sensor_m N 3; sensor_covariance_m2 N 3 3; "
    "camera_steps P 13",
):
    """Points of known position that one camera observes as pixels.

    `pixel_px` (N, 2) and `sensor_m` (N, 3) both have a covariance. `camera_steps` (P, 13): steps of the camera's
    parameters that represent its calibration errors, as from `calibration_steps`. The residual is the predicted pixel
    minus the observed one.

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
    camera_steps: FloatArray
    frame: StatedFrame = SENSOR_FRAME

    def residuals(self, sensor_from_camera: RigidTransform) -> EvidenceResiduals:
        """Return predicted minus observed pixels with their derivatives.

        The point x = Rᵀ·(X − t) in the camera frame changes by −Rᵀ·[I, −[X]×] with the pose.
        """
        to_camera = sensor_from_camera.inverse()
        placed = to_camera.apply(self.sensor_m)
        shown = self.camera.project(placed)
        lost = [name for name, pixel in zip(self.names, shown, strict=True) if not np.isfinite(pixel).all()]
        if lost:
            raise ValueError(
                f"evidence: expected {lost[0]} in front of the camera, found it behind; "
                "check the names and positions of the points"
            )
        rate = derivatives(lambda step: self.camera.project(placed + step), np.full(3, _POINT_STEP_M))
        by_position = rate @ to_camera.rotation
        jacobian = -by_position @ displacement_jacobian(self.sensor_m)
        moved = [
            Camera.from_parameters(self.camera.parameters + step, self.camera.size_px).project(placed) - shown
            for step in self.camera_steps
        ]
        return EvidenceResiduals(
            shown - self.pixel_px,
            jacobian,
            self.pixel_covariance_px2 + by_position @ self.sensor_covariance_m2 @ by_position.mT,
            {CALIBRATION_ERROR: np.array(moved).reshape(-1, *shown.shape), **self.frame.common(jacobian)},
            self.names,
        )

    @property
    def perspective_pose(self) -> RigidTransform | None:
        """Return the pose from the perspective of at least four points, or None.

        None: there are fewer points, or they do not determine the pose.

        Method: Terzakis and Lourakis 2020, ECCV, 478.
        """
        import cv2

        if len(self.names) < FEWEST_PIXELS:
            return None
        rays = self.camera.undistort(self.pixel_px)
        try:
            found, *pose = cv2.solvePnP(self.sensor_m, rays, np.eye(3), np.zeros(5), flags=cv2.SOLVEPNP_SQPNP)
        except cv2.error:  # points that do not determine the rotation
            return None
        turn, shift = (np.asarray(part, dtype=np.float64).ravel() for part in pose)
        return RigidTransform(rotation_from_vector(turn), shift).inverse() if found else None


@dataclass(frozen=True, eq=False, repr=False)
class KnownFace(Arrays, shapes="camera_m N 3; camera_covariance_m2 N 3 3; point_m 3; calibration_effects P N 3"):
    """Points observed at `camera_m` (N, 3) on a flat face of known position.

    `camera_covariance_m2` (N, 3, 3). `point_m` (3,) lies on the face, `normal` (3,) points out of the body.
    `u_offset_m` acts along the normal at that point, `u_normal_rad` about both directions in the face.
    `calibration_effects` (P, N, 3). The residual is n·(R·x + t − p).
    """

    name: str
    camera_m: FloatArray
    camera_covariance_m2: FloatArray
    point_m: FloatArray
    normal: FloatArray
    calibration_effects: FloatArray
    u_offset_m: float = 0.0
    u_normal_rad: float = 0.0
    frame: StatedFrame = SENSOR_FRAME

    def __post_init__(self) -> None:
        super().__post_init__()
        _check_direction("normal", self.normal)
        if not np.isfinite(self.camera_m).all():
            raise ValueError("camera_m: expected finite points, found NaN")

    def residuals(self, sensor_from_camera: RigidTransform) -> EvidenceResiduals:
        """Return the distances of the points from the face with their derivatives."""
        placed = sensor_from_camera.apply(self.camera_m)
        camera_normal = sensor_from_camera.rotation.T @ self.normal
        jacobian = (self.normal @ displacement_jacobian(placed))[:, None, :]
        lever = (placed - self.point_m) @ perpendicular_directions(self.normal).T
        stated_changes = np.concatenate([np.full((1, len(placed)), self.u_offset_m), self.u_normal_rad * lever.T])
        uncertain = np.array([self.u_offset_m > 0.0, self.u_normal_rad > 0.0, self.u_normal_rad > 0.0])
        return EvidenceResiduals(
            ((placed - self.point_m) @ self.normal)[:, None],
            jacobian,
            np.einsum("i,nij,j->n", camera_normal, self.camera_covariance_m2, camera_normal)[:, None, None],
            {
                CALIBRATION_ERROR: (self.calibration_effects @ camera_normal)[..., None],
                self.name: stated_changes[uncertain][..., None],
                **self.frame.common(jacobian),
            },
            (self.name,) * len(placed),
        )


@dataclass(frozen=True, eq=False, repr=False)
class KnownPoses(
    Arrays,
    shapes="names V; left_from_body V; sensor_from_body V; camera_covariance V 6 6; sensor_covariance V 6 6; "
    "calibration_effects P V 6",
):
    """A body observed in V poses that are known in the sensor frame.

    `left_from_body` are the observed poses with `camera_covariance` (V, 6, 6). `sensor_from_body` and
    `sensor_covariance` (V, 6, 6) are the known ones. Both covariances are those of translation (m) and left-multiplied
    rotation (rad). `calibration_effects` (P, V, 6): on the observed poses, camera axes. `common`: changes (P, V, 6) of
    the known poses, sensor axes, by the name of the common error.
    """

    names: tuple[str, ...]
    left_from_body: tuple[RigidTransform, ...]
    camera_covariance: FloatArray
    sensor_from_body: tuple[RigidTransform, ...]
    sensor_covariance: FloatArray
    calibration_effects: FloatArray
    common: Mapping[str, FloatArray] = field(default_factory=dict)
    frame: StatedFrame = SENSOR_FRAME

    def residuals(self, sensor_from_camera: RigidTransform) -> EvidenceResiduals:
        """Return observed minus known position and rotation of the body with their derivatives."""
        placed = [sensor_from_camera @ seen for seen in self.left_from_body]
        shift = np.array(
            [p.translation_m - k.translation_m for p, k in zip(placed, self.sensor_from_body, strict=True)]
        )
        relative = [p.rotation @ k.rotation.T for p, k in zip(placed, self.sensor_from_body, strict=True)]
        turn = vector_from_rotation(np.array(relative).reshape(-1, 3, 3))
        jacobian = np.zeros((len(placed), 6, 6))
        jacobian[:, :3] = displacement_jacobian(np.array([p.translation_m for p in placed]).reshape(-1, 3))
        jacobian[:, 3:, 3:] = rotation_vector_rate(turn)
        both = np.kron(np.eye(2), sensor_from_camera.rotation)
        return EvidenceResiduals(
            np.concatenate([shift, turn], axis=1),
            jacobian,
            both @ self.camera_covariance @ both.T + self.sensor_covariance,
            {
                CALIBRATION_ERROR: self.calibration_effects @ both.T,
                **{name: -changes for name, changes in self.common.items()},
                **self.frame.common(jacobian),
            },
            self.names,
        )


@dataclass(frozen=True, eq=False, repr=False)
class KnownDirection(Arrays, shapes="motion V 6; covariance V 6 6; camera_point_m V 3; calibration_effects P V 6"):
    """V motions whose point at the sensor origin moves along a known direction.

    `motion` (V, 6): shift (m) of the body's point at `camera_point_m` (V, 3) and rotation (rad), camera axes, small, of
    either sign; `covariance` (V, 6, 6); `calibration_effects` (P, V, 6). `direction` (3,) in the sensor frame has the
    standard uncertainty `u_direction_rad` about both perpendicular directions, common to all V motions.
    """

    name: str
    motion: FloatArray
    covariance: FloatArray
    camera_point_m: FloatArray
    direction: FloatArray
    calibration_effects: FloatArray
    u_direction_rad: float = 0.0

    def __post_init__(self) -> None:
        super().__post_init__()
        _check_direction("direction", self.direction)
        if not np.linalg.norm(self.motion[:, :3], axis=1).all():
            raise ValueError("motion: expected a translation, found none")

    def residuals(self, sensor_from_camera: RigidTransform) -> EvidenceResiduals:
        """Return the components of the motion's direction perpendicular to the known one.

        They are e·R·v/|v| with v = u + θ × (o − q) at the origin o. The position of the origin has little influence as
        long as the body hardly rocks, and is not used as evidence.
        """
        rotation, perpendicular = sensor_from_camera.rotation, perpendicular_directions(self.direction)
        origin = sensor_from_camera.inverse().translation_m
        at_origin = displacement_jacobian(origin - self.camera_point_m)
        moved = (at_origin @ self.motion[:, :, None])[..., 0] @ rotation.T
        sign = np.where(moved @ self.direction < 0.0, -1.0, 1.0)
        rows = (sign / np.linalg.norm(moved, axis=1))[:, None, None] * perpendicular
        spins = skew(self.motion[:, 3:] @ rotation.T)
        by_motion = rows @ rotation @ at_origin
        return EvidenceResiduals(
            (rows @ moved[..., None])[..., 0],
            rows @ np.concatenate([-spins, -skew(moved)], axis=2),
            by_motion @ self.covariance @ np.swapaxes(by_motion, 1, 2),
            {
                CALIBRATION_ERROR: np.einsum("vij,pvj->pvi", by_motion, self.calibration_effects),
                self.name: np.repeat(self.u_direction_rad * np.eye(2)[:, None], len(moved), axis=1),
            },
            (self.name,) * len(moved),
            np.arange(6) >= 3,
        )


@dataclass(frozen=True, eq=False, repr=False)
class KnownAxis(Arrays, shapes="camera_axis V 6; covariance V 6 6; calibration_effects P V 6; point_m 3; u_point_m 3"):
    """V rotations of a body about an axis that is known in the sensor frame.

    `camera_axis` (V, 6): a point of the axis (m) and its direction (unit vector of either sign) in the left camera's
    frame, with `covariance` (V, 6, 6) and `calibration_effects` (P, V, 6). `point_m` and `direction` (3,) are in the
    sensor frame. Their uncertainties `u_point_m` (3,) and `u_direction_rad`, about both perpendicular directions, are
    common to all V. The position along the axis remains undetermined.
    """

    name: str
    camera_axis: FloatArray
    covariance: FloatArray
    point_m: FloatArray
    direction: FloatArray
    calibration_effects: FloatArray
    u_point_m: FloatArray = field(default_factory=lambda: np.zeros(3))
    u_direction_rad: float = 0.0

    def __post_init__(self) -> None:
        super().__post_init__()
        _check_direction("direction", self.direction)

    def residuals(self, sensor_from_camera: RigidTransform) -> EvidenceResiduals:
        """Return tilt (rad) and offset (m) of the observed axis perpendicular to the known one.

        The offset is that at the known point.
        """
        rotation, perpendicular = sensor_from_camera.rotation, perpendicular_directions(self.direction)
        axis = self.camera_axis[:, 3:] @ rotation.T
        sign = np.where(axis @ self.direction < 0.0, -1.0, 1.0)
        tilt = sign[:, None, None] * perpendicular
        start = sensor_from_camera.apply(self.camera_axis[:, :3])
        along = ((self.point_m - start) @ self.direction) / (axis @ self.direction)
        intersection = start + along[:, None] * axis
        count = len(axis)
        jacobian, by_axis = np.zeros((count, 4, 6)), np.zeros((count, 4, 6))
        jacobian[:, :2, 3:] = -tilt @ skew(axis)
        jacobian[:, 2:] = perpendicular @ displacement_jacobian(intersection)
        by_axis[:, :2, 3:] = tilt @ rotation
        by_axis[:, 2:, :3] = perpendicular @ rotation
        by_axis[:, 2:, 3:] = along[:, None, None] * (perpendicular @ rotation)
        stated_changes = np.zeros((5, count, 4))
        stated_changes[:2, :, :2] = self.u_direction_rad * np.eye(2)[:, None]
        stated_changes[2:, :, 2:] = (perpendicular * self.u_point_m).T[:, None]
        residual = np.concatenate(
            [tilt @ axis[..., None], perpendicular @ (intersection - self.point_m)[..., None]], axis=1
        )
        return EvidenceResiduals(
            residual[..., 0],
            jacobian,
            by_axis @ self.covariance @ np.swapaxes(by_axis, 1, 2),
            {
                CALIBRATION_ERROR: np.einsum("vij,pvj->pvi", by_axis, self.calibration_effects),
                self.name: stated_changes,
            },
            (self.name,) * count,
        )


def _check_direction(name: str, direction: FloatArray) -> None:
    """Raise `ValueError` unless direction (3,) is a unit vector."""
    check_shape(name, direction, (3,))
    length = float(np.linalg.norm(direction))
    if not abs(length - 1.0) < 1e-9:
        raise ValueError(f"{name}: expected a unit vector, found one of length {length:.9g}")


# Points and target poses measured by a calibrated pair, with the effects of its calibration.


def calibration_steps(rig: StereoRig, scale_u: float = 0.0) -> FloatArray:
    """Return parameter steps (P, 32) of one standard uncertainty that represent calibration errors.

    The steps are the principal components of the rig's covariance. `scale_u` adds one for a separately stated relative
    standard uncertainty of the baseline's length.
    """
    steps = [] if rig.covariance is None else [*principal_components(rig.covariance)]
    if scale_u > 0.0:
        along = np.zeros(len(rig.parameters))
        along[TRANSLATION] = scale_u * rig.right_from_left.translation_m
        steps.append(along)
    return np.array(steps).reshape(-1, len(rig.parameters))


def parameter_derivatives(change: FloatArray, steps: FloatArray) -> FloatArray:
    """Return the derivatives (6, 32) by the rig's parameters from the effects of steps.

    `change` (6, P): changes of six values by the parameter `steps` (P, 32). If the steps do not determine all
    derivatives, the result is the solution of minimum norm, in units of the parameters' standard uncertainties.
    """
    sigma = np.sqrt((steps**2).sum(axis=0))
    scale = np.where(sigma > 0.0, sigma, 1.0)
    return np.asarray((np.linalg.pinv(steps / scale) @ change.T).T / scale)


def triangulate_points(
    rig: StereoRig, steps: FloatArray, left_px: FloatArray, right_px: FloatArray, u_px: float | FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return points (N, 3), their covariance (N, 3, 3) and calibration effects (P, N, 3).

    Points are in the left camera's frame; the covariance is that of the pixel noise. `left_px` and `right_px` (N, 2)
    have the standard uncertainty `u_px` in each coordinate, common or (N,). `steps` are those of `calibration_steps`.
    """
    noise = np.asarray(u_px)[..., None, None] ** 2 * np.eye(2)
    points = triangulate(rig, left_px[None], right_px[None], noise, noise)
    nominal = points.position_m[0]
    moved = [triangulate(rig.perturbed(step), left_px[None], right_px[None]).position_m[0] for step in steps]
    return nominal, points.covariance_m2[0], np.array(moved).reshape(len(steps), *nominal.shape) - nominal


def measure_target_pose(
    rig: StereoRig, steps: FloatArray, target: Target, left: TargetView | None, right: TargetView | None
) -> tuple[RigidTransform, FloatArray, FloatArray]:
    """Return the pose `left_from_target`, its covariance (6, 6) and calibration effects (P, 6).

    The covariance is that of the image noise. Both refer to translation (m) and left-multiplied rotation (rad). At
    least one view is required. With the derivatives J and G of the pixels by pose and rig and their weights W, a step s
    of the rig changes the most likely pose by −(Jᵀ·W·J)⁻¹·Jᵀ·W·G·s.
    """
    right = match_numbering(rig, target, left, right)
    pose, covariance = estimate_target_pose(rig, target, left, right)
    change = np.zeros((6, steps.shape[1]))
    for side, view in enumerate((left, right)):
        if view is not None:
            points = target.points_m(view.index)
            camera = rig.right if side else rig.left
            relative = rig.right_from_left if side else RigidTransform.identity()
            seen = model_pixels(camera, relative, pose, points, view.radius * target.spacing_m)
            weight = np.linalg.inv(view.covariance_px2)
            change -= covariance @ np.asarray(np.einsum("nki,nkl,nlj->ij", seen.by_pose, weight, seen.by_rig(side)))
    return pose, covariance, steps @ change.T
