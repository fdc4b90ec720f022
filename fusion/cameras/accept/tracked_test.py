"""Images of one test tracked: subsets of both cameras, and their points."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from fusion.base import ProgressCallback
from fusion.cameras.accept.acceptance_manifest import MOST_FRAMES, AcceptanceFile, ImagePair
from fusion.cameras.accept.acceptance_notices import TEST_IMAGES, TOO_FEW_SUBSETS
from fusion.cameras.accept.apparent_field import CUBIC, plate_axes, polynomials
from fusion.errors import InputError, as_input_error
from photogram.camera import Points3D, StereoRig, triangulate
from photogram.geometry import RigidTransform
from photogram.images.image_files import open_sequence
from photogram.images.sequence import ImageSequence, find_copied_frames, inspect_first_image
from photogram.measure.body import BodyMotion, body_motion, follow_block
from photogram.measure.follow import BodyScene, FollowedBlock, iterate_blocks, prepare_body
from photogram.subsets.icgn import TrackSettings
from photogram.subsets.texture import radius_from_image_px
from photogram.subsets.track import build_tracks
from shakercal._common.arrays import Arrays, BoolArray, FloatArray
from shakercal._common.notices import Notice

if TYPE_CHECKING:
    from collections.abc import Sequence

SPLINE_DEGREE = 7
FEWEST_SUBSETS = 30
"""Of a plate: fewer do not determine the cubic polynomials that separate smooth errors from noise."""
OUTLIER = 6.0
"""Robust standard deviations from a cubic polynomial beyond which a subset is a mismatch."""
SMALLEST_MOTION = 3.0
"""Root mean square of the subsets' motion over its standard uncertainty, below which a body is at rest; chosen."""
STATIONARY_SUBSET_FRAMES = 200
"""Frames of a stationary scene in which subsets are searched; their scatter is then known to 5 %."""
OpenedPair = tuple[tuple[ImageSequence, ImageSequence], int]
"""Images of both cameras, and the radius of the subsets."""


@dataclass(frozen=True, eq=False, repr=False)
class TrackedTest(Arrays, shapes="left_px F N 2; right_px F N 2; centre_m 3"):
    """N subsets of a body in F pairs of images of a test.

    Attributes
    ----------
    left_px, right_px : (F, N, 2), positions in each camera; all of them finite.
    points : (F, N) in the left camera's frame.
    centre_m : (3,), mean of the points in the first pair.
    pixel_m : size of a pixel of the left camera on the body.
    radius_px : of the subsets.
    body : motion by the grey values and notices; only of stationary scenes.
    """

    left_px: FloatArray
    right_px: FloatArray
    points: Points3D
    centre_m: FloatArray
    pixel_m: float
    radius_px: int
    body: BodyMotion | None = None
    notices: tuple[Notice, ...] = ()


def open_pair(file: AcceptanceFile, key: str, block: ImagePair, fewest: int, listed: str = "") -> OpenedPair:
    """Return the images of both cameras, checked, and the radius of the subsets.

    `listed`: key of the numbers that are stated for each image.
    """
    sequences, radius = list[ImageSequence](), 0
    cameras = (("left", block.left, file.rig.left), ("right", block.right, file.rig.right))
    for side, paths, camera in cameras:
        with as_input_error(file.path, f"{key}.{side}"):
            images = open_sequence(paths, file.tables.bit_depth)
            first = images.read(0)
            sequences.append(inspect_first_image(images, first))
        size = tuple(int(n) for n in camera.size_px)
        if images.size_px != size:
            found = "{} x {} px".format(*images.size_px)
            expected = "images of {} x {} px as in the calibration".format(*size)
            raise InputError(TEST_IMAGES, file.path, f"{key}.{side}", found=found, expected=expected)
        radius = radius or radius_from_image_px(first)
    left, right = sequences
    if len(left) != len(right):
        expected = f"{len(left)} images as on the left"
        raise InputError(TEST_IMAGES, file.path, f"{key}.right", found=f"{len(right)}", expected=expected)
    if not fewest <= len(left) <= MOST_FRAMES:
        expected = f"{fewest} to {MOST_FRAMES} images"
        raise InputError(TEST_IMAGES, file.path, f"{key}.left", found=f"{len(left)}", expected=expected)
    for side, images in zip(("left", "right"), sequences, strict=True):
        if (copied := find_copied_frames(images)).any():
            found = f"{Path(images.names[int(np.argmax(copied))]).name}, a copy of an earlier image"
            raise InputError(
                TEST_IMAGES, file.path, f"{key}.{side}", found=found, expected="images with their own noise"
            )
    numbers = getattr(block, listed) if listed else None
    if numbers is not None and len(numbers) != len(left):
        expected = f"{len(left)} numbers, one for each image"
        raise InputError(TEST_IMAGES, file.path, f"{key}.{listed}", found=f"{len(numbers)}", expected=expected)
    return (left, right), radius


def track_test(
    file: AcceptanceFile,
    key: str,
    pair: OpenedPair,
    progress: ProgressCallback,
    *,
    at_rest: bool = False,
) -> TrackedTest:
    """Return the tracked subsets of a test; `at_rest`: with the motion by the grey values."""
    images, radius = pair
    frames = STATIONARY_SUBSET_FRAMES if at_rest else None
    tables = file.tables
    settings = TrackSettings(radius, degree=SPLINE_DEGREE, region=tables.region, mask=tables.mask, frames=frames)

    def report(done: int) -> None:
        progress(key, min(done, len(images[0])), len(images[0]))

    with as_input_error(file.path, key):
        scene = prepare_body(images, file.rig, RigidTransform.identity(), settings, progress=report)
        blocks = [follow_block(scene, frames, progress=report) for frames in scene.blocks]
        body = body_motion(scene, blocks) if at_rest else None
    of_images = [notice for side in images for notice in side.notices]
    notices = (*of_images, *(scene.grid.notices if body is None else body.notices))
    found = _tracked(file, key, scene, blocks)
    if not at_rest:
        _check_motion(file, key, found)
    return replace(found, body=body, notices=notices)


def _check_motion(file: AcceptanceFile, key: str, tracked: TrackedTest) -> None:
    """Refuse a body at rest, whose motion has neither a direction nor a scale."""
    moved = tracked.points.position_m - tracked.points.position_m[0]
    covariance = tracked.points.covariance_m2 + tracked.points.covariance_m2[0]
    squared = np.sum(moved * np.linalg.solve(covariance, moved[..., None])[..., 0], axis=2)
    if np.mean(squared, axis=1).max() < SMALLEST_MOTION**2 * moved.shape[2]:
        raise InputError(TEST_IMAGES, file.path, f"{key}.left", found="a body at rest", expected="one that moves")


def _tracked(file: AcceptanceFile, key: str, scene: BodyScene, blocks: Sequence[FollowedBlock]) -> TrackedTest:
    """Return the subsets that both cameras show in all frames, and their points."""
    found = [both for block in iterate_blocks(scene, blocks) for both, _ in block if both is not None]
    left, right = (
        build_tracks([both[side] for both in found], scene.references[side], scene.settings.degree) for side in (0, 1)
    )
    points = triangulate(file.rig, left.position_px, right.position_px, left.covariance_px2, right.covariance_px2)
    seen = np.flatnonzero(np.isfinite(points.covariance_m2).all(axis=(0, 2, 3)))
    if len(seen) < FEWEST_SUBSETS:
        raise InputError(TOO_FEW_SUBSETS, file.path, key, expected=FEWEST_SUBSETS, found=len(seen))
    seen = seen[_inliers(points.position_m[:, seen])]
    position, covariance = points.position_m[:, seen], points.covariance_m2[:, seen]
    depth = float(np.median(position[0, :, 2]))
    return TrackedTest(
        left.position_px[:, seen],
        right.position_px[:, seen],
        Points3D(position, covariance, points.reprojection_px[:, seen]),
        position[0].mean(axis=0),
        depth / float(file.rig.left.matrix[0, 0]),
        scene.settings.radius_px,
    )


def _inliers(position_m: FloatArray) -> BoolArray:
    """Return which points (N,) move like a smooth function of their place in all frames."""
    moved = np.concatenate(position_m[1:] - position_m[0], axis=1)
    offset = position_m[0] - np.median(position_m[0], axis=0)
    plane = (offset @ plate_axes(offset))[:, :2]
    good = np.ones(len(plane), dtype=np.bool_)
    for _ in range(3):
        design = polynomials(plane, CUBIC)
        left_over = np.abs(moved - design @ (np.linalg.pinv(design[good]) @ moved[good]))
        scatter = 1.4826 * np.median(left_over[good], axis=0) + 1e-12
        good = np.asarray((left_over <= OUTLIER * scatter).all(axis=1))
    return good


def fitted_path(rig: StereoRig, tracked: TrackedTest, along: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return smoothed positions (2, N, 2) in each camera at both ends of a motion.

    The path of each subset over the travelled distance `along` (F,) is a polynomial of second degree, which contains
    the perspective; with two different positions it is a straight line.
    """
    degree = min(2, len(np.unique(np.round(along, 12))) - 1)
    scaled = (along - along.min()) / np.ptp(along)
    powers = np.vander(scaled, degree + 1, increasing=True)
    ends = np.vander([0.0, 1.0], degree + 1, increasing=True)
    smoothing = ends @ np.linalg.pinv(powers)
    left, right = (np.einsum("ef,fni->eni", smoothing, side) for side in (tracked.left_px, tracked.right_px))
    return left, right
