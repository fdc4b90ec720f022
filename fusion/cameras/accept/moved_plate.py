"""Translation and rotation tests: a moved plate is rigid, straight and to scale."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np

from fusion.cameras.accept.acceptance_manifest import RotationBlock, Tolerances, TranslationBlock
from fusion.cameras.accept.acceptance_rows import AcceptanceRow
from fusion.cameras.accept.apparent_field import ApparentField, apparent_field, local_noise
from fusion.cameras.accept.calibration_faults import MovedPlate, plate_noise
from fusion.cameras.accept.tracked_test import TrackedTest, fitted_path
from photogram.camera import StereoRig, epipolar_residual
from photogram.geometry import rotation_from_vector
from photogram.motion import RigidMotion, fit_motion
from shakercal._common.arrays import Arrays, FloatArray

MOST_LATE = 2
"""Frames by which a camera may be late, in the search for it."""
LATE_TERMS = 3
"""Offset, slope and curvature of one camera's motion over that of the other: the perspective."""
CLEARLY_LATE = 4.0
"""Ratio of the mean squares, without and with a delay, from which there is one."""
VISIBLE_PX = 0.05
"""Rms departure of the cameras' motions by one frame below which a delay cannot be seen."""


@dataclass(frozen=True, eq=False, repr=False)
class MotionTest(Arrays, shapes="along F; centre_m F 3; epipolar_px N; position_px N 2"):
    """Measured motion of a plate in one test.

    Attributes
    ----------
    name, kind : of the test.
    along : (F,), travelled distance (m) or angle (rad): stated, else measured.
    centre_m : (F, 3), displacement of the centre.
    motion : rigid motion of the points about their centre.
    field : apparent deformation per travel.
    epipolar_px : (N,), mean epipolar residual of each subset at `position_px` in the left image.
    late : frames by which the right camera is late; None if the steps cannot show it.
    plate : for the search for faults; of translations.
    rows : the results.
    """

    name: str
    kind: str
    along: FloatArray
    centre_m: FloatArray
    motion: RigidMotion
    field: ApparentField
    epipolar_px: FloatArray
    position_px: FloatArray
    late: int | None
    plate: MovedPlate | None
    rows: tuple[AcceptanceRow, ...]
    tracked: TrackedTest

    @property
    def label(self) -> str:
        """Kind and name, as in the rows."""
        return f"{self.kind} {self.name}"

    @property
    def travel(self) -> float:
        """Whole distance or angle."""
        return float(np.ptp(self.along))

    @property
    def direction(self) -> FloatArray:
        """Direction (3,) of the motion in the left camera's frame."""
        mean = self.field.axes @ self.field.rates[:3]
        return np.asarray(mean / np.linalg.norm(mean))

    @property
    def departure_m(self) -> FloatArray:
        """Displacement (F, 3) of the centre less the straight line over the travel."""
        line = np.column_stack([np.ones_like(self.along), self.along])
        return np.asarray(self.centre_m - line @ (np.linalg.pinv(line) @ self.centre_m))


def frames_late(tracked: TrackedTest) -> int | None:
    """Return by how many frames the right camera is late, None if undetermined.

    The mean displacement of the subsets in one image is a smooth function of that in the other, a polynomial of second
    degree. If a camera is late, that is only true of shifted frames.
    """
    sides = []
    for position in (tracked.left_px, tracked.right_px):
        moved = position.mean(axis=1) - position[0].mean(axis=0)
        _, _, directions = np.linalg.svd(moved - moved.mean(axis=0), full_matrices=False)
        sides.append(moved @ directions[0])
    left, right = sides
    frames = np.arange(MOST_LATE, len(left) - MOST_LATE)
    if len(frames) <= LATE_TERMS:
        return None
    scatter = []
    for late in range(-MOST_LATE, MOST_LATE + 1):
        powers = np.vander(left[frames - late], LATE_TERMS)
        left_over = right[frames] - powers @ (np.linalg.pinv(powers) @ right[frames])
        scatter.append(float(left_over @ left_over) / (len(frames) - LATE_TERMS))
    now, best = scatter[MOST_LATE], int(np.argmin(scatter))
    if now > VISIBLE_PX**2 and scatter[best] < now / CLEARLY_LATE:
        return best - MOST_LATE
    shifted = min(scatter[MOST_LATE - 1], scatter[MOST_LATE + 1])
    return 0 if shifted > VISIBLE_PX**2 else None


def measure_translation(
    rig: StereoRig, block: TranslationBlock, tracked: TrackedTest, tolerances: Tolerances
) -> MotionTest:
    """Return the result of a translation, with its rows."""
    position = tracked.points.position_m
    moved = position - position[0]
    centre = moved.mean(axis=1)
    along = np.array(block.positions) if block.positions is not None else _travelled(centre)
    left, right = fitted_path(rig, tracked, along)
    travel = float(np.ptp(along))
    u_scale = None
    if block.positions is not None:
        u_scale = float(np.hypot(block.scale_uncertainty, block.position_uncertainty / _spread(along)))
    noise = plate_noise(rig, left, right, travel)
    plate = MovedPlate(left, right, travel, u_scale, block.rotation_uncertainty, noise)
    epipolar, *_ = epipolar_residual(rig, tracked.left_px, tracked.right_px)
    test = MotionTest(
        name=block.name,
        kind="translation",
        along=along,
        centre_m=centre,
        motion=fit_motion(tracked.points, None, tracked.centre_m),
        field=apparent_field(position[0], moved, along),
        epipolar_px=epipolar.mean(axis=0),
        position_px=tracked.left_px.mean(axis=0),
        late=frames_late(tracked),
        plate=plate,
        rows=(),
        tracked=tracked,
    )
    return replace(test, rows=tuple(_translation_rows(test, block, tolerances, u_scale)))


def _spread(along: FloatArray) -> float:
    """Return the root sum of squares about the mean; repeated settings count once."""
    settings = along[np.concatenate([[True], np.diff(along) != 0.0])]
    return float(np.linalg.norm(settings - settings.mean()))


def _travelled(centre: FloatArray) -> FloatArray:
    """Return the distances (F,) along the path of the centre (F, 3)."""
    _, _, directions = np.linalg.svd(centre - centre.mean(axis=0), full_matrices=False)
    along = centre @ directions[0]
    return np.asarray(along if along[np.argmax(np.abs(along))] >= 0.0 else -along)


def _translation_rows(
    test: MotionTest, block: TranslationBlock, tolerances: Tolerances, u_scale: float | None
) -> Iterator[AcceptanceRow]:
    """Yield the rows of a translation."""
    field, travel, pixel, name = test.field, test.travel, test.tracked.pixel_m, test.label
    if test.late is not None:
        yield AcceptanceRow(name, "synchronisation", "frames of delay", float(test.late), 0.0, 0.5, "1")
    yield _epipolar_row(name, test, tolerances)
    off = test.departure_m @ test.direction
    across = np.linalg.norm(test.departure_m - np.outer(off, test.direction), axis=1)
    noise = _frame_noise(test)
    if u_scale is not None:
        size = float(np.linalg.norm(field.rates[:3]))
        u = float(np.hypot(size * u_scale, field.covariance[:3, :3].trace() ** 0.5))
        label = "error of the scale (measured over stated travel)"
        yield AcceptanceRow(name, "scale", label, size - 1.0, u, tolerances.scale, "share")
        u = float(np.hypot(block.position_uncertainty, noise))
        cause, remedy = "the stage misses its positions", "Check the steps, backlash and settling time of the stage."
        limit = tolerances.position_px * pixel
        label = "largest departure from the stated positions"
        yield AcceptanceRow(name, "position", label, float(np.max(np.abs(off))), u, limit, "m", cause, remedy)
    relative, u = field.scale_over_field(field.axes.T @ test.direction)
    largest = float(np.max(np.abs(relative)))
    label = "change of the scale over the field"
    yield AcceptanceRow(name, "scale_variation", label, largest, u, tolerances.scale_variation, "share")
    cause, remedy = "the path of the stage is curved", "State `straightness_uncertainty` of the stage, or replace it."
    u = float(np.hypot(block.straightness_uncertainty, noise))
    limit = tolerances.straightness_px * pixel
    label = "largest departure from a straight line"
    yield AcceptanceRow(name, "straightness", label, float(np.max(across)), u, limit, "m", cause, remedy)
    turn, u_turn = field.rotation
    u = float(np.hypot(block.rotation_uncertainty, travel * u_turn))
    cause, remedy = "the stage turns", "State `rotation_uncertainty` of the stage, or use a better one."
    label = "apparent rotation over the travel"
    yield AcceptanceRow(name, "rotation", label, travel * turn, u, tolerances.rotation, "rad", cause, remedy)
    yield from _deformation_rows(name, test, tolerances)


def _epipolar_row(name: str, test: MotionTest, tolerances: Tolerances) -> AcceptanceRow:
    """Return the row of the epipolar residuals, of which matching errors are a part."""
    size = float(np.sqrt(np.mean(test.epipolar_px**2)))
    u = float(local_noise(test.field.plane_m, test.epipolar_px[:, None])[0]) / np.sqrt(len(test.epipolar_px))
    return AcceptanceRow(name, "epipolar", "epipolar residual, rms", size, u, tolerances.epipolar_px, "px")


def _deformation_rows(name: str, test: MotionTest, tolerances: Tolerances) -> Iterator[AcceptanceRow]:
    """Yield the rows of strain and bending, which a rigid plate does not have."""
    travel, pixel = test.travel, test.tracked.pixel_m
    strain, u = test.field.strain
    label = "apparent strain at the end of the motion"
    yield AcceptanceRow(name, "strain", label, travel * strain, travel * u, tolerances.strain, "1")
    bending, u = test.field.bending
    label = "apparent bending at the end of the motion, rms"
    yield AcceptanceRow(name, "bending", label, travel * bending, travel * u, tolerances.bending_px * pixel, "m")


def _frame_noise(test: MotionTest) -> float:
    """Return the standard uncertainty of the centre in one frame, largest component."""
    covariance = test.motion.covariance[:, :3, :3]
    return float(np.sqrt(np.nanmax(np.linalg.eigvalsh(covariance)[:, -1])))


def measure_rotation(rig: StereoRig, block: RotationBlock, tracked: TrackedTest, tolerances: Tolerances) -> MotionTest:
    """Return the result of a rotation, with its rows."""
    position = tracked.points.position_m
    motion = fit_motion(tracked.points, None, tracked.centre_m)
    rotations = rotation_from_vector(motion.pose[:, 3:])
    rest = position[0] - tracked.centre_m
    carried = position - tracked.centre_m - motion.pose[:, None, :3]
    along = np.array(block.angles)
    epipolar, *_ = epipolar_residual(rig, tracked.left_px, tracked.right_px)
    test = MotionTest(
        name=block.name,
        kind="rotation",
        along=along,
        centre_m=(position - position[0]).mean(axis=1),
        motion=motion,
        field=apparent_field(position[0], carried @ rotations - rest, along),
        epipolar_px=epipolar.mean(axis=0),
        position_px=tracked.left_px.mean(axis=0),
        late=None,
        plate=None,
        rows=(),
        tracked=tracked,
    )
    return replace(test, rows=tuple(_rotation_rows(test, block, tolerances)))


def _rotation_rows(test: MotionTest, block: RotationBlock, tolerances: Tolerances) -> Iterator[AcceptanceRow]:
    """Yield the rows of a rotation: angle, axis, hand, and deformation."""
    name, centred = test.label, test.along - test.along.mean()
    spread = float(np.sqrt(centred @ centred))
    vector = centred @ test.motion.pose[:, 3:] / spread**2
    size = float(np.linalg.norm(vector))
    axis = vector / size
    frame = test.motion.covariance[:, 3:, 3:].mean(axis=0)
    # Uncertainty of the rate: noise of the frames, and of the stated angles.
    by_noise, by_angle = np.sqrt(axis @ frame @ axis) / spread, size * block.angle_uncertainty / _spread(test.along)
    u_along = float(np.hypot(by_noise, by_angle))
    yield _epipolar_row(name, test, tolerances)
    label = "error of the angle (measured over stated)"
    yield AcceptanceRow(name, "angle", label, size - 1.0, u_along, tolerances.angle, "share")
    if block.axis is not None:
        stated = np.array(block.axis)
        hand = float(np.sign(axis @ stated))
        off = float(np.arccos(np.clip(abs(axis @ stated), 0.0, 1.0)))
        u = float(np.hypot(block.axis_uncertainty, np.sqrt(frame.trace()) / spread / size))
        label = "angle between measured and stated axis"
        cause = "the axis is stated in another frame, or the camera was turned"
        remedy = "State the axis in the left camera's frame: x right, y down, z away."
        yield AcceptanceRow(name, "axis", label, off, u, tolerances.axis, "rad", cause, remedy)
        cause = "left and right are exchanged, images are mirrored, or angles are counted in the other sense"
        remedy = "Check which camera is the left one, and the sign of the angles by the right-hand rule."
        label = "wrong hand of the coordinate system (0: right, 1: wrong)"
        yield AcceptanceRow(name, "hand", label, 0.0 if hand > 0 else 1.0, 0.0, 0.5, "1", cause, remedy)
    yield from _deformation_rows(name, test, tolerances)
