"""Initial values of the bundle adjustment: pairing of views, poses, cameras."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from typing import Any, Literal

import numpy as np

from photogram.calibration.adjust import RigPrior, adjust, refine_pose, residuals
from photogram.calibration.bundle import Bundle, ImageObservations, ShapeKind, make_shape
from photogram.calibration.calibration_result import Rejection, check_view_angles
from photogram.camera import LEFT, RIGHT, ROTATION, TRANSLATION, Camera, StereoRig
from photogram.geometry import RigidTransform
from photogram.targets.target_view import Target, TargetView
from shakercal._common.arrays import FloatArray, IntArray

ViewPair = tuple[TargetView | None, TargetView | None]
Poses = dict[int, RigidTransform]
LensKind = Literal["polynomial", "rational"]

_STRANGE = 5.0  # times the median disagreement, beyond which a pair is inconsistent
_TOLERATED = 0.05  # disagreement that is always consistent: rad, share of the distance
_QUARTER_TURN = np.array([[0, -1], [1, 0]])


def _pair_up(
    pairs: Sequence[ViewPair], left_poses: Poses, right_poses: Poses, target: Target
) -> tuple[RigidTransform, list[ViewPair], Poses, list[int]]:
    """Return the relative pose that agrees best with all pairs, and the inconsistent pairs.

    Also returned are the pairs and their right poses, renumbered. A target with a symmetry of half a turn (a square one
    of a quarter) may be numbered differently in the two images of a pair. If one camera is rolled about its axis, it is
    in all of them. Each pair therefore gives a relative pose for every numbering of its right image. The result is the
    pose to which all pairs are closest, each with its best numbering. Raises `ValueError` if most pairs disagree: the
    two lists of images do not correspond.
    """
    common = sorted(set(left_poses) & set(right_poses))
    if not common:
        raise ValueError(
            "both cameras see the target in no common position; both lists of images must have the same order"
        )
    depth = float(np.median([np.linalg.norm(left_poses[view].translation_m) for view in common]))
    turns = [(np.eye(2, dtype=np.int64), np.zeros(2)), *target_symmetries(target)]
    numberings = [_numbering(turn, shift * target.spacing_m) for turn, shift in turns]
    offered = [[right_poses[view] @ each.inverse() for each in numberings] for view in common]
    relatives = [
        each @ left_poses[view].inverse() for view, poses in zip(common, offered, strict=True) for each in poses
    ]
    disagreement = _disagreement(relatives, depth).reshape(len(relatives), len(common), len(turns))
    typical = np.median(disagreement.min(axis=2), axis=1)
    best = int(np.argmin(typical))
    limit = max(_TOLERATED, _STRANGE * float(typical[best]))
    numbered, poses, strange = list(pairs), dict(right_poses), []
    for row, view in enumerate(common):
        nearest = int(np.argmin(disagreement[best, row]))
        if disagreement[best, row, nearest] > limit:
            strange.append(view)
            continue
        left, right = pairs[view]
        assert right is not None
        numbered[view], poses[view] = (left, renumber_points(right, *turns[nearest])), offered[row][nearest]
    if len(strange) * 2 > len(common) or limit > 10 * _TOLERATED:
        raise ValueError(
            "the left and right images do not correspond: no relative pose of the cameras fits most pairs; "
            "name all left images first, then all right ones in the same order"
        )
    return relatives[best], numbered, poses, strange


def _disagreement(poses: Sequence[RigidTransform], depth_m: float) -> FloatArray:
    """Return the distances (N, N) of poses: rotation in rad or shift over the distance."""
    rotation = np.array([pose.rotation.ravel() for pose in poses])
    shift = np.array([pose.translation_m for pose in poses])
    turn = np.arccos(np.clip((rotation @ rotation.T - 1.0) / 2.0, -1.0, 1.0))
    return np.asarray(np.maximum(turn, np.linalg.norm(shift[:, None] - shift, axis=2) / depth_m))


def target_symmetries(target: Target) -> list[tuple[IntArray, FloatArray]]:
    """Return the rotations of lattice indices that leave the target unchanged.

    Each is a matrix (2, 2) and a shift (2,).
    """
    if target.size is None or target.kind in ("charuco", "aprilgrid"):
        return []
    columns, rows = target.size
    asymmetric, chessboard = target.kind == "asymmetric-dots", target.kind == "chessboard"
    asymmetric_colours = (columns + rows) % 2 == 1 if chessboard else asymmetric and rows % 2 == 1
    if asymmetric_colours:
        return []
    last = np.array([2 * columns - 1 if asymmetric else columns - 1, rows - 1])
    turns = [-np.eye(2, dtype=np.int64)]
    if columns == rows and not asymmetric and not (chessboard and columns % 2 == 1):  # odd: corners of two colours
        turns += [_QUARTER_TURN, -_QUARTER_TURN]
    return [(turn, (last - turn @ last) / 2) for turn in turns]


def _numbering(turn: IntArray, shift_m: FloatArray) -> RigidTransform:
    """Return the transform of the target's points for another numbering."""
    rotation = np.eye(3)
    rotation[:2, :2] = turn
    return RigidTransform(rotation, np.append(shift_m, 0.0))


def renumber_points(view: TargetView, turn: IntArray, shift: FloatArray) -> TargetView:
    """Return the view with points counted from another corner of a symmetric target."""
    return replace(view, index=np.rint(view.index @ turn.T + shift).astype(np.int64))


# Pose of a target from views of a calibrated pair.

_WORST_PX = 3.0  # largest rms of points in one pose of the target
_FITTED_PLACES = 5  # of a part on a board, the nearest ones
_PLACED_PX, _DISTINCT = 2.0, 0.25  # the same of a part at its place on the board, and over that of the next best place


def estimate_target_pose(
    rig: StereoRig, target: Target, left: TargetView | None, right: TargetView | None
) -> tuple[RigidTransform, FloatArray]:
    """Return the pose `left_from_target` and its covariance (6, 6).

    Both refer to translation (m) and left-multiplied rotation (rad). Gauss–Newton on the points of one or both images,
    from the better of the two possible poses of a plane (Collins and Bartoli 2014, International Journal of Computer
    Vision 109, 252). The covariance is that of the image noise. The uncertainties of calibration and spacing are common
    to all poses and not included.
    """
    seen = [(view, side) for side, view in enumerate((left, right)) if view is not None]
    if not seen:
        raise ValueError("left, right: expected at least one image of the target, found none")
    pose, covariance, rms_px = _posed(rig, target, seen)
    if not rms_px <= _WORST_PX:
        names = " and ".join(view.name for view, _ in seen)
        found = f"none within {rms_px:.1f} px (rms)" if np.isfinite(rms_px) else "none"
        raise ValueError(f"{names}: expected one pose of a target with spacing {target.spacing_m:g} m, found {found}")
    return pose, covariance


def match_numbering(
    rig: StereoRig, target: Target, left: TargetView | None, right: TargetView | None
) -> TargetView | None:
    """Return the right view of a symmetric target numbered as the left one."""
    turns = target_symmetries(target)
    if left is None or right is None or not turns:
        return right
    offered = [right, *(renumber_points(right, *turn) for turn in turns)]
    return min(offered, key=lambda view: _posed(rig, target, [(left, 0), (view, 1)])[2])


def number_partial(
    rig: StereoRig, target: Target, left: TargetView | None, right: TargetView | None
) -> tuple[TargetView | None, TargetView | None]:
    """Return views of a part of a chessboard numbered by the other camera's view.

    Every place of the part on the board is tried, in each orientation with the right colours. The nearest ones by the
    pose of the whole view are fitted by one pose for both. The best is used if its rms residual is below 2 px, and a
    quarter of that of any other place. A part without such a place, or without a view of the whole board, becomes None.
    """
    if not any(view is not None and view.is_partial for view in (left, right)):
        return left, right
    if left is None or right is None or left.is_partial == right.is_partial:
        return whole_views((left, right))
    part, whole = (left, right) if left.is_partial else (right, left)
    places = [
        replace(renumber_points(part, turn, shift), is_partial=False) for turn, shift in _places(part.index, target)
    ]
    pose, side = _posed(rig, target, [(whole, int(left.is_partial))])[0], int(not left.is_partial)
    seen = (rig.right, rig.right_from_left) if side else (rig.left, RigidTransform.identity())

    def distance(place: TargetView) -> float:
        """Return the median distance, in px, of a place's corners from those seen."""
        pixel = seen[0].project(seen[1].apply(pose.apply(target.points_m(place.index))))
        return float(np.median(np.linalg.norm(np.nan_to_num(pixel, nan=np.inf) - place.position_px, axis=1)))

    places = sorted(places, key=distance)[:_FITTED_PLACES]
    pairs = [(place, whole) if left.is_partial else (whole, place) for place in places]
    with np.errstate(all="ignore"):  # a wrong place may have no pose
        rms = np.array([_posed(rig, target, [(one, 0), (other, 1)])[2] for one, other in pairs])
    order = np.argsort(rms)
    if len(rms) and rms[order[0]] < _PLACED_PX and (len(rms) == 1 or rms[order[0]] < _DISTINCT * rms[order[1]]):
        return pairs[int(order[0])]
    return whole_views((left, right))


def whole_views(pair: ViewPair) -> ViewPair:
    """Return a pair without views of a part of the target."""
    left, right = (None if view is None or view.is_partial else view for view in pair)
    return left, right


def _places(index: IntArray, target: Target) -> list[tuple[IntArray, FloatArray]]:
    """Return turns (2, 2) and shifts (2,) that put a part on the board.

    `index` (N, 2) is that of the part. A quarter turn exchanges the colours, so that the part is then displaced by an
    odd number of squares.
    """
    assert target.size is not None
    places = []
    for quarters, turn in enumerate(
        (np.eye(2, dtype=np.int64), _QUARTER_TURN, -np.eye(2, dtype=np.int64), -_QUARTER_TURN)
    ):
        rotated = index @ turn.T
        low, room = rotated.min(axis=0), np.array(target.size) - 1 - np.ptp(rotated, axis=0)
        for column in range(int(room[0]) + 1):
            for row in range(int(room[1]) + 1):
                shift = np.array([column, row]) - low
                if (int((rotated[0] + shift).sum()) - int(index[0].sum()) - quarters) % 2 == 0:
                    places.append((np.asarray(turn), shift.astype(np.float64)))
    return places


def _posed(
    rig: StereoRig, target: Target, seen: Sequence[tuple[TargetView, int]]
) -> tuple[RigidTransform, FloatArray, float]:
    """Return pose, covariance and rms residual (px), infinite without a pose."""
    import cv2

    index = np.unique(np.concatenate([view.index for view, _ in seen]), axis=0)
    shape = make_shape("flat", index, target)
    images = [image_observations(view, 0, side, index, target.spacing_m) for view, side in seen]
    first = images[0]
    rays = (rig.right if first.side else rig.left).undistort(first.position_px)
    count, turns, shifts, _ = cv2.solvePnPGeneric(
        shape.flat_m[first.point], rays, np.eye(3), np.zeros(5), flags=cv2.SOLVEPNP_IPPE
    )
    if not count:
        raise ValueError("left, right: expected points of a target that are not all on one line")
    to_left = rig.right_from_left.inverse() if first.side else RigidTransform.identity()
    starts = [to_left @ pose for pose in _opencv_poses(turns, shifts)]
    fits = [refine_pose(Bundle(rig, (start,), shape), images) for start in starts]
    pose, covariance, squares = min(fits, key=lambda fit: fit[2])
    if not np.isfinite(squares):
        return pose, covariance, np.inf
    off = np.concatenate(residuals(Bundle(rig, (pose,), shape), images))
    return pose, covariance, float(np.sqrt((off**2).sum(axis=1).mean()))


def image_observations(
    view: TargetView, number: int, side: int, index: IntArray, spacing_m: float
) -> ImageObservations:
    """Return a target view as observations, with points as rows of `index` (P, 2)."""
    rows = {tuple(pair): row for row, pair in enumerate(index.tolist())}
    point = np.array([rows[tuple(pair)] for pair in view.index.tolist()], dtype=np.int64)
    precision = np.asarray(np.linalg.inv(view.covariance_px2), dtype=np.float64)
    return ImageObservations(number, side, point, view.position_px, precision, view.radius * spacing_m)


def _opencv_poses(turns: Sequence[Any], shifts: Sequence[Any]) -> list[RigidTransform]:
    """Return poses from OpenCV's rotation vectors and translations."""
    poses = [np.concatenate([np.ravel(shift), np.ravel(turn)]) for turn, shift in zip(turns, shifts, strict=True)]
    return [RigidTransform.from_pose(pose.astype(np.float64)) for pose in poses]


# Start of the bundle adjustment: each camera from two starts, the relative pose by agreement of the views.

FEWEST_VIEWS = 3  # least number of views for focal length and principal point
FEWEST_POINTS = 6  # least number of points for a useful view
_TOLERATED_PX = 1.0  # rms that is always consistent
START_NOISE_PX = 0.2  # noise added to that of every point
_TILTED_RAD, _AFFINE_PX = 0.25, 0.5  # tilt of a view from which perspective shows; rms of an affine map without any
_NO_PERSPECTIVE = 6.9  # F with two degrees of freedom, exceeded by chance in 0.1 % of views, whose median is taken

# Prior of a lens: offset of the principal point in image widths; terms of distortion at the image corner, relative to
# the radius (k1, k2, k3), and decentring.
_CENTRE_SPREAD = 0.05
_RADIAL_SPREAD = (0.1, 0.05, 0.05)
_DECENTRING_SPREAD = 0.005
_WIDE = 10.0  # times the spread of the radial terms of a lens that needs the rational model
_ASPECT_SPREAD = 1e-3


def start_bundle(
    pairs: Sequence[ViewPair], target: Target, shape: ShapeKind
) -> tuple[Bundle, tuple[ViewPair, ...], tuple[Rejection, ...]]:
    """Return the first bundle, the pairs of target views used, and the rejected images.

    `pairs` are views (left, right), None for an image without target; without any right view the result is that of a
    single camera. An image is rejected if its points contradict the others of its camera, and a pair if its relative
    pose contradicts the others. Raises `ValueError` for fewer than three views of a camera, or without a pair.
    """
    sides = [_single(pairs, side, target) for side in ((0,) if all(right is None for _, right in pairs) else (0, 1))]
    dropped = [item for side in sides for item in side.dropped]
    for side in sides:
        check_view_angles(list(side.poses.values()))
    strange: list[int] = []
    relative, right_poses = RigidTransform.identity(), Poses()
    if len(sides) > 1:
        relative, pairs, right_poses, strange = _pair_up(pairs, sides[0].poses, sides[1].poses, target)
    for view in strange:
        names = " and ".join(seen.name for seen in pairs[view] if seen is not None)
        reason = "the two images do not show one position of the target (mixed up, mirrored, or moved in between)"
        dropped.append(Rejection(names, 0, reason))
    used_pairs, poses = [], []
    for view, pair in enumerate(pairs):
        left, right = (
            seen if view in known and view not in strange else None
            for seen, known in zip(pair, (sides[0].poses, right_poses), strict=True)
        )
        if left is not None or right is not None:
            used_pairs.append((left, right))
            poses.append(sides[0].poses[view] if left is not None else relative.inverse() @ right_poses[view])
    both = sum(left is not None and right is not None for left, right in used_pairs)
    if len(sides) > 1 and both < FEWEST_VIEWS:
        raise ValueError(f"both cameras see {both} positions of the target, at least {FEWEST_VIEWS} are needed")
    rig = StereoRig(sides[0].camera, sides[-1].camera, relative)
    index = np.unique(np.concatenate([seen.index for pair in used_pairs for seen in pair if seen is not None]), axis=0)
    return Bundle(rig, tuple(poses), make_shape(shape, index, target)), tuple(used_pairs), tuple(dropped)


def lens_prior(rig: StereoRig, lens: LensKind = "polynomial", single: bool = False) -> RigPrior:
    """Return the prior of any two lenses: principal points and distortion.

    Standard deviations: principal point 5 % of the image width; at the image corner k1 changes the radius by 10 %, k2
    and k3 by 5 %, the decentring terms by 0.5 %; fx and fy differ by 0.1 %. The prior matters only for parameters that
    the views do not determine. For a `rational` lens, a wide-angle one, all six radial coefficients are estimated, with
    ten times the spread. A skew is fixed. For a `single` camera, the left one, the right one is fixed.
    """
    value, sigma = rig.values, np.zeros(len(rig.parameters))
    sigma[ROTATION] = sigma[TRANSLATION] = np.inf
    for indices, camera in ((LEFT, rig.left), (RIGHT, rig.right)):
        corner = float(np.linalg.norm(camera.size_px / 2) / np.mean(camera.parameters[:2]))
        value[indices[2:4]], value[indices[4:9]] = (camera.size_px - 1) / 2, 0.0
        sigma[indices[:2]], sigma[indices[2:4]] = np.inf, _CENTRE_SPREAD * camera.size_px[0]
        k1, k2, k3 = (spread / corner**power for spread, power in zip(_RADIAL_SPREAD, (2, 4, 6), strict=True))
        tangential = _DECENTRING_SPREAD / corner
        sigma[indices[4:9]] = k1, k2, tangential, tangential, k3
        if lens == "rational":
            value[indices[9:12]] = 0.0
            sigma[indices[[4, 5, 8]]] = sigma[indices[9:12]] = _WIDE * np.array([k1, k2, k3])
    if single:
        sigma[RIGHT] = sigma[ROTATION] = sigma[TRANSLATION] = 0.0
    left, right = (_ASPECT_SPREAD * float(camera.parameters[0]) for camera in (rig.left, rig.right))
    return RigPrior(value, sigma, (left, right))


@dataclass(frozen=True, eq=False)
class _Single:
    """One camera: its parameters, the target's pose in each view, and the rejected images."""

    camera: Camera
    poses: Poses
    dropped: tuple[Rejection, ...]


def _single(pairs: Sequence[ViewPair], side: int, target: Target) -> _Single:
    """Calibrate one camera without inconsistent images."""
    seen = [(number, pair[side]) for number, pair in enumerate(pairs)]
    views = {number: view for number, view in seen if view is not None and len(view.index) >= FEWEST_POINTS}
    views, dropped = _of_one_size(views)
    _refuse_telecentric(("left", "right")[side], list(views.values()))
    while True:
        if len(views) < FEWEST_VIEWS:
            camera_name, reasons = ("left", "right")[side], [f"; {item.name}: {item.reason}" for item in dropped]
            raise ValueError(
                f"the {camera_name} camera has {len(views)} usable images of the target, at least {FEWEST_VIEWS} are "
                f"needed{''.join(reasons)}"
            )
        camera, poses, rms = _adjusted_camera(list(views.values()), target)
        limit = max(_STRANGE * float(np.median(rms)), _TOLERATED_PX)
        worst = int(np.argmax(rms))
        if rms[worst] <= limit:
            return _Single(camera, dict(zip(views, poses, strict=True)), tuple(dropped))
        view = list(views)[worst]
        reason = f"its points are {rms[worst]:.1f} px away from the prediction by the other images of this camera"
        dropped.append(Rejection(views.pop(view).name, 0, reason))


def _refuse_telecentric(camera_name: str, views: Sequence[TargetView]) -> None:
    """Raise `ValueError` for a camera without perspective, which determines neither distance nor focal length.

    Its views of a tilted target are affine maps with radial distortion: a homography, with two parameters more, leaves
    no smaller residual.
    """
    tilts, ratios, misfits = [], [], []
    for view in views:
        x, y = (view.index - view.index.mean(axis=0)).T
        one, zero = np.ones(len(x)), np.zeros(len(x))
        from_middle = (view.position_px - (view.size_px - 1) / 2) / view.size_px.max()
        radial = from_middle * np.sum(from_middle**2, axis=1, keepdims=True)
        u, v = ((view.position_px - view.position_px.mean(axis=0)) / view.size_px.max()).T
        rows = [
            [x, y, one, zero, zero, zero, radial[:, 0], -u * x, -u * y],
            [zero, zero, zero, x, y, one, radial[:, 1], -v * x, -v * y],
        ]
        design, target = np.concatenate([np.column_stack(row) for row in rows]), np.concatenate([u, v])
        design /= np.linalg.norm(design, axis=0)
        fits = [np.linalg.lstsq(part, target)[0] for part in (design[:, :7], design)]
        left = [float(np.sum((target - design[:, : len(fit)] @ fit) ** 2)) for fit in fits]
        linear, *_ = np.linalg.lstsq(np.column_stack([x, y, one]), np.column_stack([u, v]))
        stretch = np.linalg.svd(linear[:2], compute_uv=False)
        tilts.append(float(np.arccos(stretch[1] / stretch[0])))
        misfits.append(float(view.size_px.max()) * np.sqrt(left[0] / len(target)))
        ratios.append(0.5 * (left[0] - left[1]) * (len(target) - 9) / max(left[1], 1e-30))
    tilted = np.array(tilts) >= _TILTED_RAD
    if np.count_nonzero(tilted) < FEWEST_VIEWS:
        return
    misfit_px = float(np.median(np.array(misfits)[tilted]))
    if misfit_px < _AFFINE_PX and float(np.median(np.array(ratios)[tilted])) < _NO_PERSPECTIVE:
        raise ValueError(
            f"{camera_name} camera: expected a lens with perspective, found views of a target tilted by up to "
            f"{np.rad2deg(max(tilts)):.0f}° without any (affine to {misfit_px:.2g} px), as of a telecentric lens"
        )


def _of_one_size(views: dict[int, TargetView]) -> tuple[dict[int, TargetView], list[Rejection]]:
    """Return the views of the most frequent image size, and the others as rejected."""
    sizes = Counter(tuple(view.size_px.tolist()) for view in views.values())
    if len(sizes) < 2:
        return views, []
    (most, count), (second, _), *_ = sizes.most_common()
    if 2 * count <= len(views):
        shown = (
            f"{next(view.name for view in views.values() if tuple(view.size_px.tolist()) == size)} of {_times(size)} px"
            for size in (most, second)
        )
        raise ValueError(f"images of one camera differ in size: {' and '.join(shown)}")
    usable = {number: view for number, view in views.items() if tuple(view.size_px.tolist()) == most}
    dropped = [
        Rejection(view.name, 0, f"{_times(view.size_px)} px, most images of this camera have {_times(most)}")
        for number, view in views.items()
        if number not in usable
    ]
    return usable, dropped


def _times(size: Iterable[int]) -> str:
    """Return the size of an image as users write it."""
    return " x ".join(str(int(length)) for length in size)


def _adjusted_camera(views: Sequence[TargetView], target: Target) -> tuple[Camera, list[RigidTransform], FloatArray]:
    """Return camera, target poses and the rms residual of every image.

    Adjusted from two starts, of which the one with the smaller residuals remains: that of OpenCV, whose solver may stop
    in a poor minimum, and that in closed form.
    """
    index = np.unique(np.concatenate([view.index for view in views]), axis=0)
    shape, images = make_shape("flat", index, target), []
    for number, view in enumerate(views):
        image = image_observations(view, number, 0, index, target.spacing_m)
        total = view.covariance_px2 + START_NOISE_PX**2 * np.eye(2)
        images.append(replace(image, precision=np.asarray(np.linalg.inv(total), dtype=np.float64)))
    fits: list[tuple[float, Bundle, FloatArray]] = []
    for start in (_opencv_start, _closed_form_start):
        with suppress(ValueError, np.linalg.LinAlgError):
            camera, poses = start(views, target)
            rig = StereoRig(camera, camera, RigidTransform.identity())
            bundle = Bundle(rig, tuple(poses), shape)
            with suppress(ValueError):  # views that determine too little: their angles are named later
                bundle = adjust(bundle, images, lens_prior(rig, single=True)).bundle
            rms = np.sqrt([float((off**2).sum(axis=1).mean()) for off in residuals(bundle, images)])
            if np.isfinite(rms).all():
                fits.append((float(rms @ rms), bundle, rms))
    if not fits:
        raise ValueError(f"the images of {views[0].name} and others do not determine a camera")
    _, bundle, rms = min(fits, key=lambda fit: fit[0])
    return bundle.rig.left, list(bundle.poses), rms


def _opencv_start(views: Sequence[TargetView], target: Target) -> tuple[Camera, list[RigidTransform]]:
    """Return camera (focal length and k1) and target poses by OpenCV."""
    import cv2

    objects = [target.points_m(seen.index).astype(np.float32) for seen in views]
    pixels = [seen.position_px.astype(np.float32).reshape(-1, 1, 2) for seen in views]
    shape = tuple(views[0].size_px.tolist())
    flags = cv2.CALIB_FIX_K2 | cv2.CALIB_FIX_K3 | cv2.CALIB_ZERO_TANGENT_DIST
    flags |= cv2.CALIB_FIX_PRINCIPAL_POINT | cv2.CALIB_FIX_ASPECT_RATIO  # poorly determined with long focal lengths
    centred = np.array([[shape[0], 0.0, (shape[0] - 1) / 2], [0.0, shape[0], (shape[1] - 1) / 2], [0.0, 0.0, 1.0]])
    try:
        _, matrix, distortion, turns, shifts, *_ = cv2.calibrateCamera(
            objects, pixels, shape, centred, np.zeros(5), flags=flags
        )
    except cv2.error as error:
        raise ValueError(str(error)) from error
    parameters = np.array([matrix[0, 0], matrix[1, 1], matrix[0, 2], matrix[1, 2], *np.ravel(distortion)[:5]])
    return Camera.from_parameters(parameters, views[0].size_px), _opencv_poses(turns, shifts)


def _closed_form_start(views: Sequence[TargetView], target: Target) -> tuple[Camera, list[RigidTransform]]:
    """Return camera and target poses from the homographies of the views.

    Zhang 2000 (IEEE PAMI 22, 1330, eqs. 3 and 4) for square pixels, the principal point in the middle and no
    distortion: the columns g and h of a homography H have g·h = 0 and g·g = h·h after division of their first two rows
    by the focal length.
    """
    import cv2

    centre, equations, flat = (views[0].size_px - 1) / 2, [], []
    for view in views:
        flat.append(target.points_m(view.index))
        homography, _ = cv2.findHomography(flat[-1][:, :2], view.position_px - centre)
        if homography is None:
            raise ValueError(f"{view.name}: expected points of a target that are not all on one line")
        g, h = (homography[:, :2] / np.linalg.norm(homography[:2, :2])).T
        equations += [[g[:2] @ h[:2], g[2] * h[2]], [g[:2] @ g[:2] - h[:2] @ h[:2], g[2] ** 2 - h[2] ** 2]]
    across, along = np.array(equations).T
    inverse_square = -float(across @ along) / float(across @ across)
    if not inverse_square > 0:
        raise ValueError("the homographies give no focal length")
    focal = inverse_square**-0.5
    camera = Camera.from_parameters(np.array([focal, focal, *centre, *np.zeros(5)]), views[0].size_px)
    found = [
        cv2.solvePnP(points, view.position_px, camera.matrix, np.zeros(5), flags=cv2.SOLVEPNP_IPPE)
        for points, view in zip(flat, views, strict=True)
    ]
    return camera, _opencv_poses([turn for _, turn, _ in found], [shift for *_, shift in found])
