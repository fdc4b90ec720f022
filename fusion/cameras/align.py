"""Pose of the cameras in the sensor frame, as a block of rig.toml.

The recordings are of a body that moves along a known direction or turns about a known axis. They are evaluated by this
module rather than read from results of a run. Those results include the uncertainty of the pose to be determined, and
not the calibration's share by its principal components, which all evidence has in common.
"""

from __future__ import annotations

import json
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from fusion.base import K2, FileIdentity, ProgressCallback, Settings, check_new_file, no_progress
from fusion.cameras.align_manifest import (
    AlignmentFile,
    AxisBlock,
    CalibratedPair,
    MotionBlock,
    orientation_notices,
    prior_pose_evidence,
    read_alignment,
    read_pair,
    static_evidence,
)
from fusion.cameras.calibrate import IMAGE_FILE_SUFFIXES, log_each_notice
from fusion.cameras.camera_notices import (
    ELLIPTICAL_MOTION,
    FUNDAMENTAL_UNRESOLVED,
    NO_AXIS,
    NO_POSE,
    UNSTEADY_AXIS,
    UNSUITABLE_RECORDING,
)
from fusion.errors import ARGUMENT, ComputeError, InputError
from fusion.instruments.stereo import CALIBRATION
from fusion.phasors.channel_phasors import find_channel_lines
from fusion.phasors.shutter_refinement import refine_rolling_shutter
from fusion.phasors.stereo_motion import (
    StereoMotion,
    measure_points,
    motion_lines,
    prepare_images,
    sensor_from_camera,
)
from fusion.phasors.stereo_phasors import stereo_phasors
from fusion.phasors.timing import TimeBase, tie_daqs
from fusion.phasors.tracked_blocks import measure_images
from fusion.recording.daq_records import read_daqs
from fusion.recording.load import Manifest, load_manifest
from fusion.report.atomic_files import write_atomically
from fusion.report.folder import hash_files, sha256
from photogram.alignment.alignment_evidence import (
    KnownAxis,
    KnownDirection,
    PoseEvidence,
    calibration_steps,
    parameter_derivatives,
)
from photogram.alignment.pose_estimation import Alignment, align, fit_axis, linear_motion
from photogram.camera import StereoRig, triangulate
from photogram.geometry import RigidTransform
from photogram.images.tiff import read_orientations, tag_notices
from photogram.motion import RigidMotion, fit_motion
from shakercal._common.arrays import FloatArray
from shakercal._common.digits import number_text
from shakercal._common.notices import Notice

EFFECT_FRAMES = 12  # frames and subsets for the effect of the calibration on an axis, which is smooth
EFFECT_SUBSETS = 200
FEWEST_SUBSETS = 6  # least number of subsets for the pose of a body with redundancy
UNSTEADY = 4.0  # reduced chi-square of the frames against a fixed axis for a warning
EVIDENCE = (
    ("point", "point", "points"),
    ("face", "face", "faces"),
    ("target_view", "target view", "target views"),
    ("common_view", "common view", "common views"),
    ("motion", "direction of motion", "directions of motion"),
    ("axis", "rotation axis", "rotation axes"),
)


def align_file(
    path: Path,
    output: Path | None,
    settings: Settings,
    *,
    force: bool = False,
    allow_outside: bool = False,
    progress: ProgressCallback = no_progress,
) -> str:
    """Return the block of rig.toml for alignment.toml, and write it to `output` if given.

    The pose of the left camera is from all evidence that alignment.toml names. Notices are logged.
    """
    if output is not None:
        check_new_file(output, force=force)
    read = {path.resolve(): seen} if (seen := FileIdentity.of(path)) else {}
    file = read_alignment(path, allow_outside)
    blocks: list[MotionBlock | AxisBlock] = [*file.motion, *file.axis]
    recorded = [load_manifest(name, allow_outside).files for block in blocks for name in block.recordings]
    stated_files = list(_paths(file.model_dump()))
    named = [path, *stated_files, *(name for files in recorded for name in files)]
    inputs = hash_files(named, path.parent, read)
    pair = None if file.calibration is None else read_pair(path, file.calibration, file.scale_uncertainty)
    evidence = [] if pair is None else static_evidence(path, file, pair)
    moving, stated, notices = _moving_evidence(path, file, pair, settings, progress, allow_outside)
    evidence += moving
    notices += orientation_notices(file)
    if file.pose is not None:
        evidence.append(prior_pose_evidence(file.pose))
    shown = file.pose is not None or file.target_view or file.common_view  # these give the search a start
    try:
        alignment = align(evidence, None if shown else stated)
    except ValueError as error:
        raise ComputeError(NO_POSE, str(path), reason=_without_argument(error)) from error
    orientation_tags = tag_notices(
        read_orientations(p for p in stated_files if p.suffix.lower() in IMAGE_FILE_SUFFIXES)
    )
    log_each_notice((*orientation_tags, *notices, *alignment.notices))
    text = pose_text(file, alignment, pair)
    inputs.check()
    if output is not None:
        write_atomically(output, text)
    return text


def _without_argument(error: ValueError) -> str:
    """Return a sentence without the name of a function's argument."""
    return ARGUMENT.sub("", str(error), count=1)


def _paths(value: object) -> Iterator[Path]:
    """Yield every path in the values of a manifest."""
    if isinstance(value, Path):
        yield value
    elif isinstance(value, dict | list | tuple):
        for item in value.values() if isinstance(value, dict) else value:
            yield from _paths(item)


@dataclass(frozen=True, eq=False)
class _Recorded:
    """One recording of the pair, evaluated up to the body's motion."""

    manifest: Manifest
    base: TimeBase
    measured: StereoMotion

    @property
    def sensor_from_camera(self) -> RigidTransform:
        """Pose in the recording's rig.toml."""
        return sensor_from_camera(self.measured.sight.pair)


def _moving_evidence(
    path: Path,
    file: AlignmentFile,
    pair: CalibratedPair | None,
    settings: Settings,
    progress: ProgressCallback,
    allow_outside: bool,
) -> tuple[list[PoseEvidence], RigidTransform | None, list[Notice]]:
    """Evaluate all recordings of alignment.toml.

    Also returned are the pose in the first one's rig.toml, and notices.
    """
    evidence: list[PoseEvidence] = []
    notices: list[Notice] = []
    stated = None
    steps = 0 if pair is None else len(pair.steps)
    blocks: list[MotionBlock | AxisBlock] = [*file.motion, *file.axis]
    for block in blocks:
        kind = "motion" if isinstance(block, MotionBlock) else "axis"
        key = f"{kind}.{block.name}.recordings"
        manifests = [load_manifest(recording, allow_outside=allow_outside) for recording in block.recordings]
        recorded = [_record(path, key, file, manifest, settings, progress) for manifest in manifests]
        stated = recorded[0].sensor_from_camera if stated is None else stated
        if isinstance(block, MotionBlock):
            direction = _stated_direction(path, block, manifests)
            each = [_direction(block, direction, item, steps) for item in recorded]
        else:
            each = [_axis(block, item, pair) for item in recorded]
        for item_evidence, remarks in each:
            evidence.append(item_evidence)
            notices += remarks
    return evidence, stated, notices


def _record(
    path: Path, key: str, file: AlignmentFile, manifest: Manifest, settings: Settings, progress: ProgressCallback
) -> _Recorded:
    """Measure the motion observed by the pair in one recording."""
    images = next((entry for entry in manifest.images if entry.stereo == file.stereo), None)
    points = next((entry for entry in manifest.points if entry.stereo == file.stereo), None)
    if images is None and points is None:
        expected = f'images or points of the stereo pair "{file.stereo}"'
        raise InputError(UNSUITABLE_RECORDING, path, key, found=f"none in {manifest.path}", expected=expected)
    base = tie_daqs(manifest, read_daqs(manifest))
    if points is not None:
        return _Recorded(manifest, base, measure_points(manifest, base, points))
    assert images is not None
    calibration = manifest.rig.stereo[file.stereo].calibration
    if file.calibration is None or calibration is None or sha256(calibration) != sha256(file.calibration):
        found = "none" if file.calibration is None else "another calibration"
        expected = f"the one of {file.stereo} in {manifest.rig_path}"
        raise InputError(UNSUITABLE_RECORDING, path, "calibration", found=found, expected=expected)
    prepared = replace(prepare_images(manifest, base, images), depth_m=None)  # depends on the pose to be determined
    measured = measure_images(prepared, settings, progress)
    lines = find_channel_lines(manifest, base) or motion_lines(manifest, base, [measured])[0]
    measured = refine_rolling_shutter(measured, (prepared,), lines)
    fixed = measured.sight.pair.model_copy(update={"pose_by_calibration": None})  # effects in the camera's frame
    return _Recorded(manifest, base, replace(measured, sight=replace(measured.sight, pair=fixed)))


def _to_camera_axes(
    to_camera: RigidTransform, value: FloatArray, covariance: FloatArray, changes: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return two vectors (1, 6), their covariance (1, 6, 6) and changes in camera axes."""
    turn = np.kron(np.eye(2), to_camera.rotation)
    return (turn @ value)[None], (turn @ covariance @ turn.T)[None], (changes @ turn.T)[:, None]


def _direction(
    block: MotionBlock, direction: FloatArray, item: _Recorded, steps: int
) -> tuple[PoseEvidence, list[Notice]]:
    """Return the direction of the body's motion at its strongest line."""
    name, notices = f"motion {block.name}", list[Notice]()
    moved, covariance, changes, minor = _strongest(item)
    to_camera = item.sensor_from_camera.inverse()
    changes = np.pad(changes, ((0, steps - len(changes)), (0, 0)))
    motion, covariance, effects = _to_camera_axes(to_camera, moved, covariance, changes)
    if minor > block.direction_uncertainty:
        widths = {"width_mrad": 1e3 * minor, "stated_mrad": 1e3 * block.direction_uncertainty}
        notices.append(Notice(ELLIPTICAL_MOTION, name, recording=item.manifest.name, **widths))
    origin, u = to_camera.translation_m[None], block.direction_uncertainty
    return KnownDirection(name, motion, covariance, origin, direction, effects, u), notices


def _stated_direction(path: Path, block: MotionBlock, manifests: Sequence[Manifest]) -> FloatArray:
    """Return the stated direction of the block, or that of its recordings' excitation."""
    if block.direction is not None:
        return np.array(block.direction)
    stated = [manifest.excitation.direction for manifest in manifests]
    for manifest, direction in zip(manifests, stated, strict=True):
        if direction is None or len(direction) != 3:
            expected = f"3 numbers, or the key direction in motion.{block.name} of {path}"
            key, found = "excitation.direction", "no direction of a translation"
            raise InputError(UNSUITABLE_RECORDING, manifest.path, key, found=found, expected=expected)
        if direction != stated[0]:
            key, expected = f"motion.{block.name}.recordings", "recordings of one direction in a block"
            raise InputError(UNSUITABLE_RECORDING, path, key, found="several directions", expected=expected)
    return np.array(stated[0])


def _strongest(item: _Recorded) -> tuple[FloatArray, FloatArray, FloatArray, float]:
    """Return motion (6,), covariance, calibration effects and ellipse at the strongest fundamental."""
    lines = find_channel_lines(item.manifest, item.base) or motion_lines(item.manifest, item.base, [item.measured])[0]
    seen = stereo_phasors(item.base, item.measured, lines).reading
    value = seen.phasors.value
    size = np.where(lines.multiple == 1, np.linalg.norm(value[:, :3], axis=1), np.nan)
    if not np.isfinite(size).any():
        name, recording = item.measured.sight.name, str(item.manifest.path)
        raise ComputeError(FUNDAMENTAL_UNRESOLVED, f"stereo pair {name}", pair=name, recording=recording)
    line = int(np.nanargmax(size))
    covariance = seen.phasors.covariance[line].copy()
    for what, changes in seen.effects.items():
        if what != CALIBRATION:
            stacked = np.concatenate([changes[:, line].real, changes[:, line].imag], axis=1)
            covariance += stacked.T @ stacked
    calibration = seen.effects.get(CALIBRATION)
    effects = np.zeros((0, 6), dtype=np.complex128) if calibration is None else calibration[:, line]
    return linear_motion(value[line], covariance, effects)


def _axis(block: AxisBlock, item: _Recorded, pair: CalibratedPair | None) -> tuple[PoseEvidence, list[Notice]]:
    """Return the axis about which the body turned, with its known position."""
    name, notices = f"axis {block.name}", list[Notice]()
    to_camera = item.sensor_from_camera.inverse()
    try:
        axis = fit_axis(item.measured.motion)
        changes = _axis_effects(item, pair, axis.line)
    except ValueError as error:
        raise ComputeError(NO_AXIS, str(item.manifest.path), reason=_without_argument(error)) from error
    if axis.dof and axis.chi2 / axis.dof > UNSTEADY:
        ratio = float(np.sqrt(axis.chi2 / axis.dof))
        notices.append(Notice(UNSTEADY_AXIS, name, recording=item.manifest.name, ratio=ratio))
    line, covariance, effects = _to_camera_axes(to_camera, axis.line, axis.covariance, changes)
    line[:, :3] += to_camera.translation_m
    point, direction, u_point = (np.array(values) for values in (block.point, block.direction, block.point_uncertainty))
    u = block.direction_uncertainty
    return KnownAxis(name, line, covariance, point, direction, effects, u_point, u), notices


def _axis_effects(item: _Recorded, pair: CalibratedPair | None, line: FloatArray) -> FloatArray:
    """Return the changes (P, 6) of the axis for each step of the rig.

    A few frames and subsets are evaluated from the tracks onward with each perturbed rig. The effect of the calibration
    on an axis is smooth over the image and the frames, so twelve frames over the range of angles are sufficient.
    """
    view = item.measured.view
    if pair is None or view is None:
        return np.zeros((0 if pair is None else len(pair.steps), 6))
    motion = item.measured.motion
    fitted = np.flatnonzero(np.isfinite(motion.pose).all(axis=1))
    ordered = fitted[np.argsort(motion.pose[fitted, 3:] @ line[3:])]
    chosen = ordered[np.unique(np.linspace(0, len(ordered) - 1, EFFECT_FRAMES).astype(int))]
    both, start = [], 0
    for block in view.tracks:
        rows = np.intersect1d(chosen - start, np.arange(len(block.left.position_px)))
        both.append(np.concatenate([block.left.position_px[rows], block.right.position_px[rows]], axis=2))
        start += len(block.left.position_px)
    pixels = np.concatenate(both)[np.argsort(np.argsort(chosen))]
    common = np.flatnonzero(np.isfinite(pixels).all(axis=(0, 2)))
    if len(common) < FEWEST_SUBSETS:
        raise ValueError(f"only {len(common)} subsets are followed through all frames; check the images")
    subsets = common[np.unique(np.linspace(0, len(common) - 1, EFFECT_SUBSETS).astype(int))]
    left, right = pixels[:, subsets, :2], pixels[:, subsets, 2:]
    covariance = motion.covariance[chosen]

    def axis_of(rig: StereoRig) -> FloatArray:
        points = triangulate(rig, left, right).transformed(item.sensor_from_camera)
        seen: RigidMotion = replace(fit_motion(points, None, np.zeros(3)), covariance=covariance)
        axis = fit_axis(seen).line
        return np.asarray(axis * np.repeat([1.0, np.sign(axis[3:] @ line[3:])], 3))

    nominal = axis_of(pair.rig)
    return np.array([axis_of(pair.rig.perturbed(step)) - nominal for step in pair.steps]).reshape(-1, 6)


def pose_text(file: AlignmentFile, alignment: Alignment, pair: CalibratedPair | None) -> str:
    """Return the block of rig.toml, with comments on uncertainty and origin.

    `pose_by_calibration` is the sensitivity of the pose to the pair's calibration, which `pose_uncertainty` includes. A
    run uses the same calibration and needs it to count these errors once. The calibration's stated uncertainty is used,
    even if this evidence would reduce it, since a run does the same.
    """
    relative = file.other is not None and file.other.rotation is None
    frame = f"the left camera of {file.other.stereo}" if relative and file.other else "the sensor frame"
    u, sensitivity = alignment.u, np.zeros((0, 0))
    if pair is not None and pair.rig.covariance is not None and not relative:
        if not pair.is_single:  # a run does not use it for a single camera
            covered = len(calibration_steps(pair.rig))
            sensitivity = parameter_derivatives(alignment.by_calibration[:, :covered], pair.steps[:covered])
            sensitivity = sensitivity if sensitivity[:, 24:].any() else sensitivity[:, :24]
        u = np.sqrt(np.diagonal(alignment.conditional_covariance) + (alignment.by_calibration**2).sum(axis=1))
    exact = K2 * np.sqrt(np.diagonal(alignment.conditional_covariance))
    blocks = [(len(getattr(file, key)), one, many) for key, one, many in EVIDENCE]
    origin = [f"{count} {one if count == 1 else many}" for count, one, many in blocks if count]
    origin += ["the prior pose"] if file.pose is not None else []
    sources = " and ".join([", ".join(origin[:-1]), origin[-1]] if len(origin) > 1 else origin)
    camera = "camera" if pair is not None and pair.is_single else "left camera"
    comments = [
        f"Pose of the {camera} of {file.stereo} in {frame}, from {sources}.",
        f"U (k = 2): position {_numbers(1e3 * K2 * u[:3])} mm, rotation {_numbers(1e3 * K2 * u[3:])} mrad (x, y, z).",
        f"Without the calibration's share: {_numbers(1e3 * exact[:3])} mm and {_numbers(1e3 * exact[3:])} mrad.",
        f"chi2 = {number_text(alignment.chi2)} with {alignment.dof} degrees of freedom.",
    ]
    if alignment.enlargement > 1.0:
        comments.append(f"The evidence is contradictory: U is enlarged by {number_text(alignment.enlargement)}.")
    pose = alignment.sensor_from_camera
    name = file.stereo if file.stereo.replace("_", "").replace("-", "").isalnum() else json.dumps(file.stereo)
    lines = [f"# {comment}" for comment in comments]
    lines.append(f"[relative.{name}]" if relative else f"[stereo.{name}]")
    lines.append(f"rotation = {_rows(pose.rotation)}")
    lines += [f"translation = {_row(pose.translation_m)}", f"pose_uncertainty = {_row(u)}"]
    if sensitivity.size:
        lines.append(f"pose_by_calibration = {_rows(sensitivity)}")
    return "\n".join(lines) + "\n"


def _numbers(values: FloatArray) -> str:
    """Return three values with two digits."""
    return " ".join(number_text(value, 2) for value in values)


def _row(values: FloatArray) -> str:
    """Return a row of TOML with all digits."""
    return f"[{', '.join(repr(float(value)) for value in values)}]"


def _rows(values: FloatArray) -> str:
    """Return a matrix in TOML, a row in every line."""
    return "[\n  " + ",\n  ".join(_row(row) for row in values) + "]"
