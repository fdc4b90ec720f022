"""Where the bundle adjustment starts: pairing of views, poses, cameras."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from typing import Any, Literal

import numpy as np

from photogram.arrays import FloatArray, IntArray
from photogram.calibration.adjust import RigPrior
from photogram.calibration.bundle import Bundle, ImageObservations, ShapeKind, make_shape, step_poses
from photogram.calibration.calibration_result import Rejection, check_view_angles
from photogram.camera import LEFT, RIGHT, ROTATION, TRANSLATION, Camera, StereoRig
from photogram.geometry import RigidTransform
from photogram.targets.target_view import Target, TargetView

ViewPair = tuple[TargetView | None, TargetView | None]
Poses = dict[int, RigidTransform]
LensKind = Literal["polynomial", "rational"]

_STRANGE = 5.0  # times the median disagreement, beyond which a pair is strange
_TOLERATED = 0.05  # disagreement that is never strange: rad, share of the distance
_QUARTER_TURN = np.array([[0, -1], [1, 0]])


def _pair_up(
    pairs: Sequence[ViewPair], left_poses: Poses, right_poses: Poses, target: Target
) -> tuple[RigidTransform, list[ViewPair], Poses, list[int]]:
    """Return the relative pose of the pair that agrees best with all others, and the numbers of those that do not.

    Between them the pairs and their right poses, numbered anew.

    A target that looks alike after half a turn (a square one after a quarter) may be numbered differently in the two
    pictures of a pair, and is in all of them where one camera is rolled about its axis. So each pair offers a relative
    pose for every numbering of its right picture; the one to which all pairs come closest, each by the numbering that
    suits it, is the cameras'. Raises `ValueError` when most pairs do not agree: the two lists of pictures do not belong
    together.
    """
    common = sorted(set(left_poses) & set(right_poses))
    if not common:
        raise ValueError(
            "no position of the target is seen by both cameras; the two lists of pictures must be in one order"
        )
    depth = float(np.median([np.linalg.norm(left_poses[view].translation_m) for view in common]))
    turns = [(np.eye(2, dtype=np.int64), np.zeros(2)), *target_symmetries(target)]
    numberings = [_numbering(turn, shift * target.spacing_m) for turn, shift in turns]
    offered = [[right_poses[view] @ each.inverse() for each in numberings] for view in common]
    relatives = [
        each @ left_poses[view].inverse() for view, poses in zip(common, offered, strict=True) for each in poses
    ]
    apart = _disagreement(relatives, depth).reshape(len(relatives), len(common), len(turns))
    typical = np.median(apart.min(axis=2), axis=1)
    best = int(np.argmin(typical))
    limit = max(_TOLERATED, _STRANGE * float(typical[best]))
    numbered, poses, strange = list(pairs), dict(right_poses), []
    for place, view in enumerate(common):
        nearest = int(np.argmin(apart[best, place]))
        if apart[best, place, nearest] > limit:
            strange.append(view)
            continue
        left, right = pairs[view]
        assert right is not None
        numbered[view], poses[view] = (left, renumber_points(right, *turns[nearest])), offered[place][nearest]
    if len(strange) * 2 > len(common) or limit > 10 * _TOLERATED:
        raise ValueError(
            "the left and right pictures do not belong together: no relative pose of the cameras fits most pairs; "
            "give all left pictures first, then all right ones in the same order"
        )
    return relatives[best], numbered, poses, strange


def _disagreement(poses: Sequence[RigidTransform], depth_m: float) -> FloatArray:
    """Return how far poses (N) are apart (N, N): rotation in rad or shift in distances, whichever is more."""
    rotation = np.array([pose.rotation.ravel() for pose in poses])
    shift = np.array([pose.translation_m for pose in poses])
    turn = np.arccos(np.clip((rotation @ rotation.T - 1.0) / 2.0, -1.0, 1.0))
    return np.asarray(np.maximum(turn, np.linalg.norm(shift[:, None] - shift, axis=2) / depth_m))


def target_symmetries(target: Target) -> list[tuple[IntArray, FloatArray]]:
    """Return the turns (matrix (2, 2), shift (2,)) of lattice indices after which the target looks the same."""
    if target.size is None or target.kind == "charuco":
        return []
    columns, rows = target.size
    asymmetric, chessboard = target.kind == "asymmetric-dots", target.kind == "chessboard"
    unlike = (columns + rows) % 2 == 1 if chessboard else asymmetric and rows % 2 == 1
    if unlike:
        return []
    last = np.array([2 * columns - 1 if asymmetric else columns - 1, rows - 1])
    turns = [-np.eye(2, dtype=np.int64)]
    if columns == rows and not asymmetric and not (chessboard and columns % 2 == 1):  # odd: corners of two colours
        turns += [_QUARTER_TURN, -_QUARTER_TURN]
    return [(turn, (last - turn @ last) / 2) for turn in turns]


def _numbering(turn: IntArray, shift_m: FloatArray) -> RigidTransform:
    """Return the transform of the target's points to where another numbering has them."""
    rotation = np.eye(3)
    rotation[:2, :2] = turn
    return RigidTransform(rotation, np.append(shift_m, 0.0))


def renumber_points(view: TargetView, turn: IntArray, shift: FloatArray) -> TargetView:
    """Return the view with its points counted from another corner of a target that looks alike."""
    return replace(view, index=np.rint(view.index @ turn.T + shift).astype(np.int64))


# Where a target stands, seen by a calibrated pair.

_STEPS = 30
_CONVERGED = 1e-9  # expected decrease of the sum of squares that ends the iteration
_WORST_PX = 3.0  # rms beyond which points are not those of the target in one pose before these cameras


def estimate_target_pose(
    rig: StereoRig, target: Target, left: TargetView | None, right: TargetView | None
) -> tuple[RigidTransform, FloatArray]:
    """Return the pose `left_from_target` and its covariance (6, 6): translation (m), left-multiplied rotation (rad).

    Gauss–Newton on the points of one or both pictures, from the better of the two poses in which a plane looks alike
    (Collins and Bartoli 2014, International Journal of Computer Vision 109, 252). The covariance is that of the
    pictures' noise: the calibration's and the spacing's uncertainty are common to all poses and not contained.
    """
    seen = [(view, side) for side, view in enumerate((left, right)) if view is not None]
    if not seen:
        raise ValueError("left, right: expected at least one picture of the target, found none")
    pose, covariance, rms_px = _posed(rig, target, seen)
    if not rms_px <= _WORST_PX:
        names = " and ".join(view.name for view, _ in seen)
        found = f"none within {rms_px:.1f} px (rms)" if np.isfinite(rms_px) else "none"
        raise ValueError(f"{names}: expected one pose of a target with spacing {target.spacing_m:g} m, found {found}")
    return pose, covariance


def match_numbering(
    rig: StereoRig, target: Target, left: TargetView | None, right: TargetView | None
) -> TargetView | None:
    """Return the right view numbered as the left one, of a target that looks alike after a turn."""
    turns = target_symmetries(target)
    if left is None or right is None or not turns:
        return right
    offered = [right, *(renumber_points(right, *turn) for turn in turns)]
    return min(offered, key=lambda view: _posed(rig, target, [(left, 0), (view, 1)])[2])


def _posed(
    rig: StereoRig, target: Target, seen: Sequence[tuple[TargetView, int]]
) -> tuple[RigidTransform, FloatArray, float]:
    """Return pose and covariance from pictures with their sides, and the rms residual (px), infinite of no pose."""
    import cv2

    index = np.unique(np.concatenate([view.index for view, _ in seen]), axis=0)
    shape = make_shape("flat", index, target.spacing_m)
    pictures = [image_observations(view, 0, side, index, target.spacing_m) for view, side in seen]
    first = pictures[0]
    rays = (rig.right if first.side else rig.left).undistort(first.position_px)
    count, turns, shifts, _ = cv2.solvePnPGeneric(
        shape.flat_m[first.point], rays, np.eye(3), np.zeros(5), flags=cv2.SOLVEPNP_IPPE
    )
    if not count:
        raise ValueError("left, right: expected points of a target that are not all on one line")
    to_left = rig.right_from_left.inverse() if first.side else RigidTransform.identity()
    starts = [to_left @ pose for pose in _opencv_poses(turns, shifts)]
    fits = [refine_pose(Bundle(rig, (start,), shape), pictures) for start in starts]
    pose, covariance, squares = min(fits, key=lambda fit: fit[2])
    if not np.isfinite(squares):
        return pose, covariance, np.inf
    bundle = Bundle(rig, (pose,), shape)
    residuals = [picture.position_px - bundle.model_pixels(picture).pixel for picture in pictures]
    return pose, covariance, float(np.sqrt((np.concatenate(residuals) ** 2).sum(axis=1).mean()))


def image_observations(
    view: TargetView, number: int, side: int, index: IntArray, spacing_m: float
) -> ImageObservations:
    """Return a target view as picture of view `number`, its points as rows of `index` (P, 2)."""
    rows = {tuple(pair): row for row, pair in enumerate(index.tolist())}
    point = np.array([rows[tuple(pair)] for pair in view.index.tolist()], dtype=np.int64)
    precision = np.asarray(np.linalg.inv(view.covariance_px2), dtype=np.float64)
    return ImageObservations(number, side, point, view.position_px, precision, view.radius * spacing_m)


def _opencv_poses(turns: Sequence[Any], shifts: Sequence[Any]) -> list[RigidTransform]:
    """Return poses from OpenCV's rotation vectors and translations."""
    poses = [np.concatenate([np.ravel(shift), np.ravel(turn)]) for turn, shift in zip(turns, shifts, strict=True)]
    return [RigidTransform.from_pose(pose.astype(np.float64)) for pose in poses]


def refine_pose(bundle: Bundle, images: list[ImageObservations]) -> tuple[RigidTransform, FloatArray, float]:
    """Return the pose after Gauss–Newton, its covariance and the sum of squares (infinite where it diverges)."""
    for _ in range(_STEPS):
        normal, side, squares = np.zeros((6, 6)), np.zeros(6), 0.0
        for picture in images:
            seen = bundle.model_pixels(picture)
            residual = picture.position_px - seen.pixel
            weighted = picture.precision @ seen.by_pose
            normal += np.einsum("nki,nkj->ij", seen.by_pose, weighted)
            side += np.einsum("nki,nk->i", weighted, residual)
            squares += float(np.einsum("ni,nij,nj->", residual, picture.precision, residual))
        if not np.isfinite(squares):
            break
        step = np.asarray(np.linalg.solve(normal, side), dtype=np.float64)
        middle = bundle.shape.flat_m.mean(axis=0)
        bundle = replace(bundle, poses=step_poses(middle, bundle.poses, step[None], np.zeros(2)))
        if side @ step < _CONVERGED:
            return bundle.poses[0], np.asarray(np.linalg.inv(normal), dtype=np.float64), squares
    return bundle.poses[0], np.full((6, 6), np.nan), np.inf


# Where the bundle adjustment starts: each camera alone by OpenCV, the relative pose by agreement of the views.

FEWEST_VIEWS = 3
FEWEST_POINTS = 6
_TOLERATED_PX = 1.0  # rms that is never strange

# What is known of a lens beforehand: principal point off the middle in widths of the picture; the terms of distortion
# at the picture's corner, radial relative to the radius (k1, k2, k3), decentring likewise.
_CENTRE_SPREAD = 0.05
_RADIAL_SPREAD = (0.1, 0.05, 0.05)
_DECENTRING_SPREAD = 0.005
_WIDE = 10.0  # times the spread of the radial terms of a lens that needs the rational model
_ASPECT_SPREAD = 1e-3


def start_bundle(
    pairs: Sequence[ViewPair], target: Target, shape: ShapeKind
) -> tuple[Bundle, tuple[ViewPair, ...], tuple[Rejection, ...]]:
    """Return the first bundle, the pairs of target views that take part in it (one per pose), and what was dropped.

    The pairs are views (left, right), None for a picture without target; without any right one a single camera's. A
    picture whose points fit its camera's others badly is dropped, and a pair whose relative pose is not the others'.
    Raises `ValueError` when fewer than three views remain for a camera, or no pair.
    """
    if all(right is None for _, right in pairs):
        return _start_single(pairs, target, shape)
    sides = [_single(pairs, side, target) for side in (0, 1)]
    dropped = [item for side in sides for item in side.dropped]
    for side in sides:
        check_view_angles(list(side.poses.values()))
    relative, pairs, right_poses, strange = _pair_up(pairs, sides[0].poses, sides[1].poses, target)
    for view in strange:
        names = " and ".join(seen.name for seen in pairs[view] if seen is not None)
        reason = "the two pictures do not show one position of the target (mixed up, mirrored, or it moved in between)"
        dropped.append(Rejection(names, 0, reason))
    kept, poses = [], []
    for view, pair in enumerate(pairs):
        used = [
            seen if view in side.poses and view not in strange else None for seen, side in zip(pair, sides, strict=True)
        ]
        if used[0] is None and used[1] is None:
            continue
        kept.append((used[0], used[1]))
        poses.append(sides[0].poses[view] if used[0] is not None else relative.inverse() @ right_poses[view])
    both = sum(left is not None and right is not None for left, right in kept)
    if both < FEWEST_VIEWS:
        raise ValueError(f"{both} positions of the target are seen by both cameras, at least {FEWEST_VIEWS} are needed")
    rig = StereoRig(sides[0].camera, sides[1].camera, relative)
    index = np.unique(np.concatenate([seen.index for pair in kept for seen in pair if seen is not None]), axis=0)
    return Bundle(rig, tuple(poses), make_shape(shape, index, target.spacing_m)), tuple(kept), tuple(dropped)


def _start_single(
    pairs: Sequence[ViewPair], target: Target, shape: ShapeKind
) -> tuple[Bundle, tuple[ViewPair, ...], tuple[Rejection, ...]]:
    """Return the same of one camera alone, the left one of a pair whose right one nothing sees."""
    side = _single(pairs, 0, target)
    check_view_angles(list(side.poses.values()))
    kept = tuple(pairs[view] for view in side.poses)
    index = np.unique(np.concatenate([seen.index for seen, _ in kept if seen is not None]), axis=0)
    rig = StereoRig(side.camera, side.camera, RigidTransform.identity())
    return Bundle(rig, tuple(side.poses.values()), make_shape(shape, index, target.spacing_m)), kept, side.dropped


def lens_prior(rig: StereoRig, lens: LensKind = "polynomial", single: bool = False) -> RigPrior:
    """Return what is known of any two lenses: their middle and their distortion, nothing of focal lengths and places.

    Principal point within 5 % of the picture's width; at the picture's corner k1 changes the radius by 10 %, k2 and k3
    by 5 %, the decentring terms by 0.5 %; fx and fy differ by 0.1 % (standard deviations). Only what the views leave
    open keeps these values. Of a `rational` lens, a wide one, all six radial coefficients are estimated, with ten
    times the spread; a skew is held as it is. Of a `single` camera, the left one, all of the right one is held.
    """
    value, sigma = rig.values, np.zeros(len(rig.parameters))
    sigma[ROTATION] = sigma[TRANSLATION] = np.inf
    for places, camera in ((LEFT, rig.left), (RIGHT, rig.right)):
        corner = float(np.linalg.norm(camera.size_px / 2) / np.mean(camera.parameters[:2]))
        value[places[2:4]], value[places[4:9]] = (camera.size_px - 1) / 2, 0.0
        sigma[places[:2]], sigma[places[2:4]] = np.inf, _CENTRE_SPREAD * camera.size_px[0]
        k1, k2, k3 = (spread / corner**power for spread, power in zip(_RADIAL_SPREAD, (2, 4, 6), strict=True))
        tangential = _DECENTRING_SPREAD / corner
        sigma[places[4:9]] = k1, k2, tangential, tangential, k3
        if lens == "rational":
            value[places[9:12]] = 0.0
            sigma[places[[4, 5, 8]]] = sigma[places[9:12]] = _WIDE * np.array([k1, k2, k3])
    if single:
        sigma[RIGHT] = sigma[ROTATION] = sigma[TRANSLATION] = 0.0
    left, right = (_ASPECT_SPREAD * float(camera.parameters[0]) for camera in (rig.left, rig.right))
    return RigPrior(value, sigma, (left, right))


@dataclass(frozen=True, eq=False)
class _Single:
    """One camera alone: its parameters, the target's pose in it by view, and what was dropped."""

    camera: Camera
    poses: Poses
    dropped: tuple[Rejection, ...]


def _single(pairs: Sequence[ViewPair], side: int, target: Target) -> _Single:
    """Calibrate one camera by OpenCV (focal length and k1), leaving out pictures that do not fit the others."""
    seen = [(number, pair[side]) for number, pair in enumerate(pairs)]
    views = {number: view for number, view in seen if view is not None and len(view.index) >= FEWEST_POINTS}
    views, dropped = _of_one_size(views)
    while True:
        if len(views) < FEWEST_VIEWS:
            camera_name, reasons = ("left", "right")[side], [f"; {item.name}: {item.reason}" for item in dropped]
            raise ValueError(
                f"the {camera_name} camera has {len(views)} usable pictures of the target, at least {FEWEST_VIEWS} are "
                f"needed{''.join(reasons)}"
            )
        camera, poses, rms = _opencv(list(views.values()), target)
        limit = max(_STRANGE * float(np.median(rms)), _TOLERATED_PX)
        worst = int(np.argmax(rms))
        if rms[worst] <= limit:
            return _Single(camera, dict(zip(views, poses, strict=True)), tuple(dropped))
        view = list(views)[worst]
        reason = f"its points are {rms[worst]:.1f} px off what the other pictures of this camera say"
        dropped.append(Rejection(views.pop(view).name, 0, reason))


def _of_one_size(views: dict[int, TargetView]) -> tuple[dict[int, TargetView], list[Rejection]]:
    """Return the views of the size that most pictures of a camera have, and the others, dropped."""
    sizes = Counter(tuple(view.size_px.tolist()) for view in views.values())
    if len(sizes) < 2:
        return views, []
    (most, count), (second, _), *_ = sizes.most_common()
    if 2 * count <= len(views):
        shown = (
            f"{next(view.name for view in views.values() if tuple(view.size_px.tolist()) == size)} of {_times(size)} px"
            for size in (most, second)
        )
        raise ValueError(f"pictures of one camera differ in size: {' and '.join(shown)}")
    kept = {number: view for number, view in views.items() if tuple(view.size_px.tolist()) == most}
    dropped = [
        Rejection(view.name, 0, f"{_times(view.size_px)} px, most pictures of this camera have {_times(most)}")
        for number, view in views.items()
        if number not in kept
    ]
    return kept, dropped


def _times(size: Iterable[int]) -> str:
    """The size of a picture as users write it."""
    return " x ".join(str(int(length)) for length in size)


def _opencv(views: Sequence[TargetView], target: Target) -> tuple[Camera, list[RigidTransform], FloatArray]:
    """Return camera, target poses and the rms residual of every picture."""
    import cv2

    objects = [
        np.column_stack([seen.index * target.spacing_m, np.zeros(len(seen.index))]).astype(np.float32) for seen in views
    ]
    pixels = [seen.position_px.astype(np.float32).reshape(-1, 1, 2) for seen in views]
    shape = tuple(views[0].size_px.tolist())
    flags = cv2.CALIB_FIX_K2 | cv2.CALIB_FIX_K3 | cv2.CALIB_ZERO_TANGENT_DIST
    flags |= cv2.CALIB_FIX_PRINCIPAL_POINT | cv2.CALIB_FIX_ASPECT_RATIO  # hardly determined with long focal lengths
    centred = np.array([[shape[0], 0.0, (shape[0] - 1) / 2], [0.0, shape[0], (shape[1] - 1) / 2], [0.0, 0.0, 1.0]])
    try:
        _, matrix, distortion, turns, shifts, *_, rms = cv2.calibrateCameraExtended(
            objects, pixels, shape, centred, np.zeros(5), flags=flags
        )
    except cv2.error as error:
        raise ValueError(f"the pictures of {views[0].name} and others do not determine a camera") from error
    parameters = np.array([matrix[0, 0], matrix[1, 1], matrix[0, 2], matrix[1, 2], *np.ravel(distortion)[:5]])
    return (
        Camera.from_parameters(parameters, views[0].size_px),
        _opencv_poses(turns, shifts),
        np.array(rms, float).ravel(),
    )
