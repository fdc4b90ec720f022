"""Five kinds of evidence about the pose of the left camera in the sensor frame: points, faces, poses, motions, axes.

Each holds what the cameras saw, in the left camera's frame, and what is known of it in the sensor frame. What was seen
carries its own noise as covariance, and the calibration's errors as effects: the changes of what was seen for one
standard uncertainty of each principal component of the calibration's covariance, which all evidence has in common.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Protocol

import numpy as np

from photogram.arrays import Arrays, BoolArray, FloatArray, check_shape
from photogram.geometry import RigidTransform, displacement_jacobian, rotation_vector_rate, skew, vector_from_rotation

CALIBRATION = "calibration"
"""Name of the effects of the pair's own calibration."""


@dataclass(frozen=True, eq=False, repr=False)
class Residuals(Arrays, shapes="piece B; residual B b; jacobian B b 6; covariance B b b; determines 6"):
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
    determines: BoolArray

    def __post_init__(self) -> None:
        super().__post_init__()
        for name, changes in self.common.items():
            check_shape(f"common {name}", changes, (None, *self.residual.shape))


def across(direction: FloatArray) -> FloatArray:
    """Return two unit vectors (2, 3) perpendicular to a direction (3,) and to each other."""
    return np.asarray(np.linalg.svd(np.asarray(direction, dtype=np.float64)[None])[2][1:])


# Five kinds of evidence about the pose of the left camera in the sensor frame.

_ALL = np.ones(6, dtype=np.bool_)
_TURN = np.arange(6) >= 3


class Evidence(Protocol):
    """Anything that says at a trial pose how far what was seen is from what is known."""

    def residuals(self, sensor_from_camera: RigidTransform) -> Residuals:
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
NO_EFFECTS: Mapping[str, FloatArray] = {}


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

    def residuals(self, sensor_from_camera: RigidTransform) -> Residuals:
        """Return R·x + t − X and how it answers."""
        rotation, placed = sensor_from_camera.rotation, sensor_from_camera.apply(self.camera_m)
        jacobian = displacement_jacobian(placed)
        return Residuals(
            placed - self.sensor_m,
            jacobian,
            rotation @ self.camera_covariance_m2 @ rotation.T + self.sensor_covariance_m2,
            {CALIBRATION: self.calibration @ rotation.T, **self.frame.common(jacobian)},
            self.names,
            _ALL,
        )


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

    def residuals(self, sensor_from_camera: RigidTransform) -> Residuals:
        """Return the distances of the points from the face and how they answer."""
        placed = sensor_from_camera.apply(self.camera_m)
        seen = sensor_from_camera.rotation.T @ self.normal
        jacobian = (self.normal @ displacement_jacobian(placed))[:, None, :]
        lever = (placed - self.point_m) @ across(self.normal).T
        own = np.concatenate([np.full((1, len(placed)), self.u_offset_m), self.u_normal_rad * lever.T])
        kept = np.array([self.u_offset_m > 0.0, self.u_normal_rad > 0.0, self.u_normal_rad > 0.0])
        return Residuals(
            ((placed - self.point_m) @ self.normal)[:, None],
            jacobian,
            np.einsum("i,nij,j->n", seen, self.camera_covariance_m2, seen)[:, None, None],
            {
                CALIBRATION: (self.calibration @ seen)[..., None],
                self.name: own[kept][..., None],
                **self.frame.common(jacobian),
            },
            (self.name,) * len(placed),
            _ALL,
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
    common: Mapping[str, FloatArray] = field(default_factory=lambda: NO_EFFECTS)
    frame: StatedFrame = SENSOR_FRAME

    def residuals(self, sensor_from_camera: RigidTransform) -> Residuals:
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
        return Residuals(
            np.concatenate([shift, turn], axis=1),
            jacobian,
            both @ self.camera_covariance @ both.T + self.sensor_covariance,
            {
                CALIBRATION: self.calibration @ both.T,
                **{name: -changes for name, changes in self.common.items()},
                **self.frame.common(jacobian),
            },
            self.names,
            _ALL,
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

    def residuals(self, sensor_from_camera: RigidTransform) -> Residuals:
        """Return the direction of motion across the known one: e·R·v/|v|, v = u + θ × (o − q) at the origin o.

        Where the origin is decides little as long as the body hardly rocks; that little is no evidence about it.
        """
        rotation, across_it = sensor_from_camera.rotation, across(self.direction)
        origin = sensor_from_camera.inverse().translation_m
        at_origin = displacement_jacobian(origin - self.camera_point_m)
        moved = (at_origin @ self.motion[:, :, None])[..., 0] @ rotation.T
        sign = np.where(moved @ self.direction < 0.0, -1.0, 1.0)
        rows = (sign / np.linalg.norm(moved, axis=1))[:, None, None] * across_it
        spins = skew(self.motion[:, 3:] @ rotation.T)
        by_motion = rows @ rotation @ at_origin
        return Residuals(
            (rows @ moved[..., None])[..., 0],
            rows @ np.concatenate([-spins, -skew(moved)], axis=2),
            by_motion @ self.covariance @ np.swapaxes(by_motion, 1, 2),
            {
                CALIBRATION: np.einsum("vij,pvj->pvi", by_motion, self.calibration),
                self.name: np.repeat(_spread(2, self.u_direction_rad)[:, None], len(moved), axis=1),
            },
            (self.name,) * len(moved),
            _TURN,
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

    def residuals(self, sensor_from_camera: RigidTransform) -> Residuals:
        """Return tilt (rad) and offset (m) of the axis seen, across the known one, at its known point."""
        rotation, across_it = sensor_from_camera.rotation, across(self.direction)
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
        known[:2, :, :2] = _spread(2, self.u_direction_rad)[:, None]
        known[2:, :, 2:] = (across_it * self.u_point_m).T[:, None]
        residual = np.concatenate([tilt @ axis[..., None], across_it @ (place - self.point_m)[..., None]], axis=1)
        return Residuals(
            residual[..., 0],
            jacobian,
            by_axis @ self.covariance @ np.swapaxes(by_axis, 1, 2),
            {CALIBRATION: np.einsum("vij,pvj->pvi", by_axis, self.calibration), self.name: known},
            (self.name,) * count,
            _ALL,
        )


def _spread(count: int, u: float) -> FloatArray:
    """Return the effects (count, count) of independent errors of standard uncertainty u."""
    return u * np.eye(count)


def _check_direction(name: str, direction: FloatArray) -> None:
    """Raise `ValueError` unless direction (3,) is a unit vector."""
    check_shape(name, direction, (3,))
    length = float(np.linalg.norm(direction))
    if not abs(length - 1.0) < 1e-9:
        raise ValueError(f"{name}: expected a unit vector, found one of length {length:.9g}")
