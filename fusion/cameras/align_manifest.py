"""alignment.toml as checked values, and its static evidence.

The keys are in the table of `docs/cameras.md`.
"""

from __future__ import annotations

import csv
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import zip_longest
from pathlib import Path
from typing import Annotated, Any, Literal, Self

import numpy as np
from pydantic import BeforeValidator, model_validator

from fusion.cameras.camera_notices import (
    IMAGE_SIZE_MISMATCH,
    NEEDS_STEREO_PAIR,
    PIXEL_TABLE,
    RAYS_DO_NOT_MEET,
    RIGHT_PIXEL_MISSING,
    SCALE_OF_SINGLE_CAMERA,
    SCALE_UNSTATED,
    SYMMETRIC_TARGET,
    UNLIKELY_SPACING,
)
from fusion.errors import InputError, as_input_error
from fusion.recording.toml import read_text, read_toml, validate
from fusion.recording.values import (
    ZERO3,
    ZERO6,
    Context,
    Direction,
    ExistingFile,
    ExistingFiles,
    FreeVector,
    ManifestBlock,
    NotNegative,
    PathScope,
    PoseUncertainty,
    Positive,
    Rotation,
    Text,
    Uncertainty3,
    Version,
    array_of_tables,
    describe,
    refusal,
    repeated_name,
    vector,
)
from photogram.alignment.alignment_evidence import (
    KnownFace,
    KnownPixels,
    KnownPoints,
    KnownPoses,
    PoseEvidence,
    StatedFrame,
    calibration_steps,
    measure_target_pose,
    triangulate_points,
)
from photogram.calibration.calibration_file import is_single, read_calibration, read_camera
from photogram.calibration.initial_bundle import target_symmetries
from photogram.camera import LEFT, RIG_PARAMETERS, StereoRig
from photogram.geometry import RigidTransform, displacement_jacobian
from photogram.images.image_files import read_image
from photogram.targets.find_target import find_target
from photogram.targets.target_view import LONGEST_M, SHORTEST_M, Target, TargetView
from shakercal._common.arrays import FloatArray
from shakercal._common.notices import Notice


def _size(value: Any) -> tuple[int, int]:
    """Check columns and rows of a target."""
    if not (isinstance(value, list | tuple) and len(value) == 2 and all(type(item) is int for item in value)):
        raise refusal("2 integers, columns and rows", f"{value}"[:60])
    return value[0], value[1]


PIXEL_COLUMNS = ("left_x", "left_y", "right_x", "right_y")
FEWEST_FACE_POINTS = 3  # points that determine a plane
LARGEST_TABLE = 50_000_000  # bytes
Pixel = Annotated[tuple[float, float], BeforeValidator(vector(2))]
Blocks = BeforeValidator(array_of_tables)


class PointBlock(ManifestBlock):
    """A point of known position with its pixels in both cameras, or in one."""

    name: Text
    position: FreeVector
    position_uncertainty: Uncertainty3 = ZERO3
    left: Pixel
    right: Pixel | None = None
    pixel_uncertainty: Positive


class FaceBlock(ManifestBlock):
    """A flat face of known position, and a table of pixels of points on it."""

    name: Text
    point: FreeVector
    normal: Direction
    offset_uncertainty: NotNegative = 0.0
    normal_uncertainty: NotNegative = 0.0
    pixels: ExistingFile
    pixel_uncertainty: Positive


class TargetBlock(ManifestBlock):
    """The calibration target of the views."""

    kind: Literal["chessboard", "charuco", "aprilgrid", "dots", "asymmetric-dots"]
    spacing: Positive
    size: Annotated[tuple[int, int] | None, BeforeValidator(_size)] = None
    dictionary: Text | None = None
    tag_spacing: Positive | None = None
    first_id: int | None = None

    @property
    def target(self) -> Target:
        """The target."""
        return Target(self.kind, self.spacing, self.size, self.dictionary, self.tag_spacing, self.first_id)

    @model_validator(mode="after")
    def _can_be_looked_for(self) -> Self:
        try:
            _ = self.target
        except ValueError as error:
            key, _, sentence = str(error).partition(": expected ")
            expected, _, found = sentence.rpartition(", found ")
            raise refusal(expected, found, key=key.removesuffix("_m")) from error
        return self


class TargetViewBlock(ManifestBlock):
    """Images of the target at a known pose: x_sensor = rotation · x_target + translation."""

    name: Text
    left: ExistingFiles = ()
    right: ExistingFiles = ()
    rotation: Rotation
    translation: FreeVector
    pose_uncertainty: PoseUncertainty = ZERO6

    @model_validator(mode="after")
    def _check_images(self) -> Self:
        if not self.left and not self.right:
            raise refusal("the images of at least one camera", "none", key="left")
        if self.left and self.right and len(self.left) != len(self.right):
            raise refusal(f"{len(self.left)} images as on the left", f"{len(self.right)}", key="right")
        return self


class CommonView(ManifestBlock):
    """Images of the target, in any pose, by both stereo pairs."""

    name: Text
    left: ExistingFile
    right: ExistingFile
    other_left: ExistingFile
    other_right: ExistingFile


class OtherPair(ManifestBlock):
    """The other stereo pair of common views.

    Without its pose the result is relative to its left camera.
    """

    stereo: Text
    calibration: ExistingFile
    scale_uncertainty: NotNegative | None = None
    rotation: Rotation | None = None
    translation: FreeVector | None = None
    pose_uncertainty: PoseUncertainty = ZERO6

    @model_validator(mode="after")
    def _whole_pose(self) -> Self:
        if (self.rotation is None) != (self.translation is None):
            missing = "rotation" if self.rotation is None else "translation"
            raise refusal("rotation and translation, or neither", "one of them", key=missing)
        return self


class MotionBlock(ManifestBlock):
    """Recordings of one set-up in which the sensor origin moves along a known direction."""

    name: Text
    recordings: ExistingFiles
    direction: Direction | None = None
    direction_uncertainty: NotNegative


class AxisBlock(ManifestBlock):
    """Recordings of one set-up in which the body turns about a known axis."""

    name: Text
    recordings: ExistingFiles
    point: FreeVector
    point_uncertainty: Uncertainty3 = ZERO3
    direction: Direction
    direction_uncertainty: NotNegative


class PosePriorBlock(ManifestBlock):
    """Prior pose with its uncertainty."""

    rotation: Rotation
    translation: FreeVector
    pose_uncertainty: PoseUncertainty

    @model_validator(mode="after")
    def _no_certainty(self) -> Self:
        if min(self.pose_uncertainty) <= 0.0:
            raise refusal("6 numbers above 0 (3 in m, 3 in rad)", f"{min(self.pose_uncertainty):g}", "pose_uncertainty")
        return self


class AlignmentFile(ManifestBlock):
    """alignment.toml: the evidence about the pose of a pair's left camera in the sensor frame."""

    format: Version
    stereo: Text
    calibration: ExistingFile | None = None
    scale_uncertainty: NotNegative | None = None
    datum_uncertainty: PoseUncertainty = ZERO6
    pose: PosePriorBlock | None = None
    target: TargetBlock | None = None
    other: OtherPair | None = None
    point: Annotated[tuple[PointBlock, ...], Blocks] = ()
    face: Annotated[tuple[FaceBlock, ...], Blocks] = ()
    target_view: Annotated[tuple[TargetViewBlock, ...], Blocks] = ()
    common_view: Annotated[tuple[CommonView, ...], Blocks] = ()
    motion: Annotated[tuple[MotionBlock, ...], Blocks] = ()
    axis: Annotated[tuple[AxisBlock, ...], Blocks] = ()

    @model_validator(mode="after")
    def _belongs_together(self) -> Self:
        for key in ("point", "face", "target_view", "common_view", "motion", "axis"):
            blocks = getattr(self, key)
            twice = repeated_name([block.name for block in blocks])
            if twice is not None:
                raise refusal("different names", f'"{twice}" twice', key=key)
            if blocks and self.calibration is None and key not in ("motion", "axis"):
                raise refusal(f"the calibration that [[{key}]] requires", "nothing", key="calibration")
        if (self.target_view or self.common_view) and self.target is None:
            raise refusal("the [target] of the views", "nothing", key="target")
        if self.common_view and self.other is None:
            raise refusal("the [other] pair of the common views", "nothing", key="other")
        if self.other is not None and self.other.rotation is None:
            stray = next(
                (key for key in ("point", "face", "target_view", "motion", "axis") if getattr(self, key)), None
            )
            if stray is not None or self.pose is not None:
                raise refusal(
                    "the pose of the other pair, without which all other evidence refers to another frame",
                    "nothing",
                    key="other.rotation",
                )
        if not any((self.point, self.face, self.target_view, self.common_view, self.motion, self.axis)):
            raise refusal("at least one block of evidence such as [[point]] or [[motion]]", "none")
        return self


def read_alignment(path: Path, allow_outside: bool = False) -> AlignmentFile:
    """Read and check alignment.toml, with paths relative to and within its folder."""
    folder = path.parent.resolve()
    scope = PathScope(folder, folder, allow_outside, "of this file")
    return validate(AlignmentFile, read_toml(path), path, Context(scope))


@dataclass(frozen=True, eq=False)
class CalibratedPair:
    """A calibrated stereo pair and the steps (P, 32) that represent its calibration errors.

    `is_single`: of a single camera, used as the left and the right one.
    """

    rig: StereoRig
    steps: FloatArray
    is_single: bool = False


def read_pair(path: Path, calibration: Path, scale_u: float | None, key: str = "") -> CalibratedPair:
    """Read a calibration that `path` names; one without covariance requires a stated scale."""
    with as_input_error(calibration):
        if is_single(calibration):
            return _single_camera(path, calibration, scale_u, key)
        rig = read_calibration(calibration)
    if rig.covariance is None and scale_u is None:
        expected = "the relative standard uncertainty of all lengths"
        raise InputError(SCALE_UNSTATED, path, f"{key}scale_uncertainty", found="nothing", expected=expected)
    return CalibratedPair(rig, calibration_steps(rig, scale_u or 0.0))


def _single_camera(path: Path, calibration: Path, scale_u: float | None, key: str) -> CalibratedPair:
    """Return a single camera, which has no scale."""
    if scale_u is not None:
        key = f"{key}scale_uncertainty"
        raise InputError(SCALE_OF_SINGLE_CAMERA, path, key, found="one", expected="none of a single camera")
    camera, camera_covariance = read_camera(calibration)
    covariance = np.zeros((len(RIG_PARAMETERS),) * 2)
    covariance[np.ix_(LEFT, LEFT)] = camera_covariance
    rig = StereoRig(camera, camera, RigidTransform.identity(), covariance)
    return CalibratedPair(rig, calibration_steps(rig), is_single=True)


def _check_cameras(path: Path, file: AlignmentFile, pair: CalibratedPair) -> None:
    """Refuse evidence of two cameras from one, and of one camera from two."""
    if pair.is_single:
        for kind in ("face", "common_view", "motion", "axis"):
            if getattr(file, kind):
                expected = "[[point]] or [[target_view]]"
                raise InputError(NEEDS_STEREO_PAIR, path, kind, found="one", expected=expected)
        for key in (f"target_view.{view.name}.right" for view in file.target_view if view.right):
            raise InputError(NEEDS_STEREO_PAIR, path, key, found="images", expected="none")
    for point in file.point:
        key = f"point.{point.name}.right"
        if pair.is_single and point.right is not None:
            raise InputError(NEEDS_STEREO_PAIR, path, key, found="a pixel", expected="none")
        if not pair.is_single and point.right is None:
            expected = "the point's pixel in the right camera"
            raise InputError(RIGHT_PIXEL_MISSING, path, key, found="nothing", expected=expected)


def orientation_notices(file: AlignmentFile) -> list[Notice]:
    """Return a notice of a symmetric target without other evidence about its orientation."""
    if file.target is None or not (file.target_view or file.common_view):
        return []
    target = file.target.target
    if not target_symmetries(target) or file.pose or file.point or file.face or file.motion or file.axis:
        return []
    return [Notice(SYMMETRIC_TARGET, "target")]


def static_evidence(path: Path, file: AlignmentFile, pair: CalibratedPair) -> list[PoseEvidence]:
    """Return the evidence of points, faces and target views."""
    _check_cameras(path, file, pair)
    datum = StatedFrame("datum", np.array(file.datum_uncertainty))
    evidence: list[PoseEvidence] = [_points(path, file.point, pair, datum)] if file.point else []
    evidence += [_face(path, face, pair, datum) for face in file.face]
    if file.target is not None:
        target = file.target.target
        if not target.is_likely:
            found = f"{target.spacing_m:g} m, of a target {target.length_m:.3g} m long"
            expected = f"a spacing in m, of a target {SHORTEST_M:g} to {LONGEST_M:g} m long"
            raise InputError(UNLIKELY_SPACING, path, "target.spacing", found=found, expected=expected)
        evidence += [item for view in file.target_view for item in _views(path, view, target, pair, datum)]
        if file.other is not None and file.common_view:
            evidence += _common(path, file.common_view, file.other, target, pair)
    return evidence


def prior_pose_evidence(prior: PosePriorBlock) -> PoseEvidence:
    """Return the prior pose as evidence.

    Its uncertainties are those of the sensor origin and of the rotation about it.
    """
    translation, u = np.array(prior.translation), np.array(prior.pose_uncertainty)
    moved = np.eye(6)
    moved[:3] = displacement_jacobian(translation)
    covariance = moved @ np.diag(u**2) @ moved.T
    pose = RigidTransform(np.array(prior.rotation), translation)
    identity = (RigidTransform.identity(),)
    return KnownPoses(
        ("the prior pose",), identity, np.zeros((1, 6, 6)), (pose,), covariance[None], np.zeros((0, 1, 6))
    )


def _points(path: Path, points: Sequence[PointBlock], pair: CalibratedPair, datum: StatedFrame) -> PoseEvidence:
    """Return the points, triangulated if two cameras see them."""
    names, left = tuple(f"point {point.name}" for point in points), np.array([point.left for point in points])
    u_px, sensor_m = np.array([point.pixel_uncertainty for point in points]), np.array([p.position for p in points])
    spread = np.array([point.position_uncertainty for point in points])[:, :, None] ** 2 * np.eye(3)
    if pair.is_single:
        noise = u_px[:, None, None] ** 2 * np.eye(2)
        return KnownPixels(names, pair.rig.left, left, noise, sensor_m, spread, pair.steps[:, LEFT], datum)
    right = np.array([point.right for point in points])
    position, covariance, effects = triangulate_points(pair.rig, pair.steps, left, right, u_px)
    for point, point_m in zip(points, position, strict=True):
        if not np.isfinite(point_m).all():
            expected = "pixels of one point in front of both cameras"
            key = f"point.{point.name}"
            raise InputError(RAYS_DO_NOT_MEET, path, key, found="rays that do not meet", expected=expected)
    return KnownPoints(names, position, covariance, sensor_m, spread, effects, datum)


def _face(path: Path, face: FaceBlock, pair: CalibratedPair, datum: StatedFrame) -> KnownFace:
    """Return the triangulated points of a face, without those whose rays do not meet."""
    pixels = _pixel_table(face.pixels)
    position, covariance, effects = triangulate_points(
        pair.rig, pair.steps, pixels[:, :2], pixels[:, 2:], face.pixel_uncertainty
    )
    met = np.isfinite(position).all(axis=1)
    if np.count_nonzero(met) < FEWEST_FACE_POINTS:
        expected = f"at least {FEWEST_FACE_POINTS} points in front of both cameras"
        key, found = f"face.{face.name}.pixels", int(np.count_nonzero(met))
        raise InputError(RAYS_DO_NOT_MEET, path, key, found=found, expected=expected)
    return KnownFace(
        f"face {face.name}",
        position[met],
        covariance[met],
        np.array(face.point),
        np.array(face.normal),
        effects[:, met],
        face.offset_uncertainty,
        face.normal_uncertainty,
        datum,
    )


def _pixel_table(file: Path) -> FloatArray:
    """Return the pixels (N, 4) of a table with the columns left_x, left_y, right_x, right_y."""
    reader = csv.DictReader(read_text(file, LARGEST_TABLE, "a table of pixels").splitlines())
    try:
        missing = [name for name in PIXEL_COLUMNS if name not in (reader.fieldnames or ())]
        if missing:
            found = describe(", ".join(reader.fieldnames or ()), plain=True) or "nothing"
            raise InputError(PIXEL_TABLE, file, found=found, expected=f"the columns {', '.join(PIXEL_COLUMNS)}")
        rows = [[float(row[name]) for name in PIXEL_COLUMNS] for row in reader]
    except (TypeError, ValueError, csv.Error) as error:
        found = describe(str(error), plain=True)
        raise InputError(PIXEL_TABLE, file, found=found, expected="a number in each column") from error
    pixels = np.array(rows).reshape(-1, len(PIXEL_COLUMNS))
    if not np.isfinite(pixels).all():
        line = int(np.flatnonzero(~np.isfinite(pixels).all(axis=1))[0]) + 2
        raise InputError(PIXEL_TABLE, file, f"line {line}", found="another one", expected="finite numbers")
    return pixels


def _seen(
    path: Path, key: str, image_paths: Mapping[str, Path | None], target: Target, pair: CalibratedPair
) -> tuple[RigidTransform, FloatArray, FloatArray]:
    """Return the target's pose with covariance and effects from the images of a block."""
    views: list[TargetView | None] = []
    for side, image_path in image_paths.items():
        if image_path is None:
            views.append(None)
            continue
        with as_input_error(path, f"{key}.{side}"):
            image, full_scale = read_image(image_path)
            view = find_target(image, target, image_path.name, full_scale)
        size = (pair.rig.right if side.endswith("right") else pair.rig.left).size_px.tolist()
        if view.size_px.tolist() != size:
            shown = f"{image_path.name} of {view.size_px[0]} x {view.size_px[1]} pixels"
            expected = f"{size[0]} x {size[1]} as the calibration"
            raise InputError(IMAGE_SIZE_MISMATCH, path, f"{key}.{side}", found=shown, expected=expected)
        views.append(view)
    with as_input_error(path, key):
        return measure_target_pose(pair.rig, pair.steps, target, *views)


def _views(
    path: Path, block: TargetViewBlock, target: Target, pair: CalibratedPair, datum: StatedFrame
) -> Iterator[KnownPoses]:
    """Yield the images of the target at one known pose, whose error they share."""
    name, u = f"target view {block.name}", np.array(block.pose_uncertainty)
    common = {name: np.diag(u)[np.flatnonzero(u)][:, None]}
    placed = RigidTransform(np.array(block.rotation), np.array(block.translation))
    for left, right in zip_longest(block.left, block.right):
        pose, covariance, effects = _seen(
            path, f"target_view.{block.name}", {"left": left, "right": right}, target, pair
        )
        no_covariance = np.zeros((1, 6, 6))
        yield KnownPoses((name,), (pose,), covariance[None], (placed,), no_covariance, effects[:, None], common, datum)


def _common(
    path: Path, views: Sequence[CommonView], other: OtherPair, target: Target, pair: CalibratedPair
) -> Iterator[KnownPoses]:
    """Yield the target observed by both pairs, with its pose by the other one.

    The pose is in the sensor frame. If the other pair has no pose, the frame is that of its left camera.
    """
    second = read_pair(path, other.calibration, other.scale_uncertainty, "other.")
    if second.is_single:
        found = f"{other.calibration.name}, of one camera"
        raise InputError(NEEDS_STEREO_PAIR, path, "other.calibration", found=found, expected="that of a pair")
    placed = RigidTransform.identity()
    if other.rotation is not None and other.translation is not None:
        placed = RigidTransform(np.array(other.rotation), np.array(other.translation))
    turn = np.kron(np.eye(2), placed.rotation)
    frame = StatedFrame(f"pose of {other.stereo}", np.array(other.pose_uncertainty))
    for view in views:
        key = f"common_view.{view.name}"
        pose, covariance, effects = _seen(path, key, {"left": view.left, "right": view.right}, target, pair)
        others = {"other_left": view.other_left, "other_right": view.other_right}
        other_pose, other_covariance, other_effects = _seen(path, key, others, target, second)
        yield KnownPoses(
            (f"common view {view.name}",),
            (pose,),
            covariance[None],
            (placed @ other_pose,),
            (turn @ other_covariance @ turn.T)[None],
            effects[:, None],
            {f"calibration of {other.stereo}": (other_effects @ turn.T)[:, None]},
            frame,
        )
