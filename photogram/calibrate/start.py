"""Where the bundle adjustment starts: each camera alone by OpenCV, the relative pose by agreement of the views."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from photogram._checks import FloatArray
from photogram.calibrate.adjust import Bundle, Prior
from photogram.calibrate.pairing import Pair, pair_up
from photogram.calibrate.result import Dropped
from photogram.calibrate.shape import ShapeKind, make_shape
from photogram.calibrate.views import refuse_similar_views
from photogram.camera import Camera, StereoRig
from photogram.rigid import RigidTransform, rotation_from_vector
from photogram.target.view import Target, TargetView

FEWEST_VIEWS = 3
FEWEST_POINTS = 6
_STRANGE = 5.0  # times the median rms of all pictures: beyond it a picture is not of this camera or target
_TOLERATED_PX = 1.0  # rms that is never strange

# What is known of a lens beforehand: principal point off the middle in widths of the picture; the terms of distortion
# at the picture's corner, radial relative to the radius (k1, k2, k3), decentring likewise.
_CENTRE_SPREAD = 0.05
_RADIAL_SPREAD = (0.1, 0.05, 0.05)
_DECENTRING_SPREAD = 0.005
_ASPECT_SPREAD = 1e-3


@dataclass(frozen=True, eq=False)
class Start:
    """The first bundle, the pairs that take part in it (one per pose), and what was dropped."""

    bundle: Bundle
    pairs: tuple[Pair, ...]
    dropped: tuple[Dropped, ...]


def start_bundle(pairs: Sequence[Pair], target: Target, shape: ShapeKind) -> Start:
    """Return the first guess of everything from target views (left, right), None for a picture without target.

    A picture whose points fit its camera's others badly is dropped, and a pair whose relative pose is not the
    others'. Raises `ValueError` when fewer than three views remain for a camera, or no pair.
    """
    sides = [_single(pairs, side, target) for side in (0, 1)]
    dropped = [item for side in sides for item in side.dropped]
    for side in sides:
        refuse_similar_views(list(side.poses.values()))
    pairing = pair_up(pairs, sides[0].poses, sides[1].poses, target)
    relative, strange, pairs = pairing.right_from_left, pairing.strange, pairing.pairs
    for view in strange:
        names = " and ".join(seen.name for seen in pairs[view] if seen is not None)
        reason = "the two pictures do not show one position of the target (mixed up, mirrored, or it moved in between)"
        dropped.append(Dropped(names, 0, reason))
    kept, poses = [], []
    for view, pair in enumerate(pairs):
        used = [
            seen if view in side.poses and view not in strange else None for seen, side in zip(pair, sides, strict=True)
        ]
        if used[0] is None and used[1] is None:
            continue
        kept.append((used[0], used[1]))
        poses.append(sides[0].poses[view] if used[0] is not None else relative.inverse() @ pairing.right_poses[view])
    _check_count(kept)
    rig = StereoRig(sides[0].camera, sides[1].camera, relative)
    index = np.unique(np.concatenate([seen.index for pair in kept for seen in pair if seen is not None]), axis=0)
    return Start(Bundle(rig, tuple(poses), make_shape(shape, index, target.spacing_m)), tuple(kept), tuple(dropped))


def lens_prior(rig: StereoRig) -> Prior:
    """Return what is known of any two lenses: their middle and their distortion, nothing of focal lengths and places.

    Principal point within 5 % of the picture's width; at the picture's corner k1 changes the radius by 10 %, k2 and k3
    by 5 %, the decentring terms by 0.5 %; fx and fy differ by 0.1 % (standard deviations). Only what the views leave
    open keeps these values.
    """
    value, sigma = np.zeros(24), np.full(24, np.inf)
    for first, camera in ((0, rig.left), (9, rig.right)):
        corner = float(np.linalg.norm(camera.size_px / 2) / np.mean(camera.parameters[:2]))
        value[first + 2 : first + 4] = (camera.size_px - 1) / 2
        sigma[first + 2 : first + 4] = _CENTRE_SPREAD * camera.size_px[0]
        k1, k2, k3 = (spread / corner**power for spread, power in zip(_RADIAL_SPREAD, (2, 4, 6), strict=True))
        tangential = _DECENTRING_SPREAD / corner
        sigma[first + 4 : first + 9] = k1, k2, tangential, tangential, k3
    left, right = (_ASPECT_SPREAD * float(camera.parameters[0]) for camera in (rig.left, rig.right))
    return Prior(value, sigma, (left, right))


@dataclass(frozen=True, eq=False)
class _Single:
    """One camera alone: its parameters, the target's pose in it by view, and what was dropped."""

    camera: Camera
    poses: dict[int, RigidTransform]
    dropped: tuple[Dropped, ...]


def _single(pairs: Sequence[Pair], side: int, target: Target) -> _Single:
    """Calibrate one camera by OpenCV (focal length and k1), leaving out pictures that do not fit the others."""
    seen = {view: pair[side] for view, pair in enumerate(pairs)}
    views = {view: found for view, found in seen.items() if found is not None and len(found.index) >= FEWEST_POINTS}
    sizes = {tuple(found.size_px.tolist()) for found in views.values()}
    if len(sizes) > 1:
        names = [
            next(found.name for found in views.values() if tuple(found.size_px.tolist()) == s) for s in sorted(sizes)
        ]
        raise ValueError(f"pictures of one camera differ in size: {names[0]} and {names[1]}")
    dropped: list[Dropped] = []
    while True:
        if len(views) < FEWEST_VIEWS:
            raise ValueError(_too_few(side, len(views), dropped))
        camera, poses, rms = _opencv(list(views.values()), target)
        limit = max(_STRANGE * float(np.median(rms)), _TOLERATED_PX)
        worst = int(np.argmax(rms))
        if rms[worst] <= limit:
            return _Single(camera, dict(zip(views, poses, strict=True)), tuple(dropped))
        view = list(views)[worst]
        reason = f"its points are {rms[worst]:.1f} px off what the other pictures of this camera say"
        dropped.append(Dropped(views.pop(view).name, 0, reason))


def _too_few(side: int, found: int, dropped: Sequence[Dropped]) -> str:
    """Return the sentence about too few views of a camera."""
    camera = ("left", "right")[side]
    text = f"the {camera} camera has {found} usable pictures of the target, at least {FEWEST_VIEWS} are needed"
    return text + "".join(f"; {item.name}: {item.reason}" for item in dropped)


def _opencv(views: Sequence[TargetView], target: Target) -> tuple[Camera, list[RigidTransform], FloatArray]:
    """Return camera, target poses and the rms residual of every picture."""
    import cv2

    objects = [
        np.column_stack([seen.index * target.spacing_m, np.zeros(len(seen.index))]).astype(np.float32) for seen in views
    ]
    pixels = [seen.position_px.astype(np.float32).reshape(-1, 1, 2) for seen in views]
    size = views[0].size_px
    shape = (int(size[0]), int(size[1]))
    flags = cv2.CALIB_FIX_K2 | cv2.CALIB_FIX_K3 | cv2.CALIB_ZERO_TANGENT_DIST
    flags |= cv2.CALIB_FIX_PRINCIPAL_POINT | cv2.CALIB_FIX_ASPECT_RATIO  # hardly determined with long focal lengths
    centred = np.array([[shape[0], 0.0, (shape[0] - 1) / 2], [0.0, shape[0], (shape[1] - 1) / 2], [0.0, 0.0, 1.0]])
    try:
        found = cv2.calibrateCameraExtended(objects, pixels, shape, centred, np.zeros(5), flags=flags)
    except cv2.error as error:
        raise ValueError(f"the pictures of {views[0].name} and others do not determine a camera") from error
    _, matrix, distortion, turns, shifts, *_, rms = found
    parameters = np.array([matrix[0, 0], matrix[1, 1], matrix[0, 2], matrix[1, 2], *np.ravel(distortion)[:5]])
    poses = [
        RigidTransform(rotation_from_vector(np.array(turn, float).ravel()), np.array(shift, float).ravel())
        for turn, shift in zip(turns, shifts, strict=True)
    ]
    return Camera.from_parameters(parameters, size), poses, np.array(rms, float).ravel()


def _check_count(pairs: Sequence[Pair]) -> None:
    """Refuse a session with fewer than three pairs seen by both cameras."""
    both = sum(left is not None and right is not None for left, right in pairs)
    if both < FEWEST_VIEWS:
        raise ValueError(f"{both} positions of the target are seen by both cameras, at least {FEWEST_VIEWS} are needed")
