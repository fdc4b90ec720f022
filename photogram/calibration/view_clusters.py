"""Views of one pose of the target: copies, clusters, and the errors they share."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np

from photogram.calibration.bundle import Bundle, ImageObservations
from photogram.calibration.calibration_result import Rejection
from photogram.calibration.initial_bundle import FEWEST_POINTS, ViewPair
from photogram.targets.target_view import TargetView
from shakercal._common.arrays import BoolArray, FloatArray, IntArray

_ONE_POSE = 0.02  # largest difference of one pose: rad, share of the image diagonal, share of the distance
_COPY = 1 / 3  # rms difference of the points of one image over that of two independent ones, below which it is a copy


def reject_copies(pairs: Sequence[ViewPair]) -> tuple[list[ViewPair], tuple[Rejection, ...]]:
    """Return the views without copies of earlier images of the same camera, and the copies.

    Two images have new noise in every point. Points that agree within a third of it are those of one image: the same
    file under two names, or encoded a second time. Raises `ValueError` if the images of both cameras are the same.
    """
    both = [pair for pair in pairs if None not in pair]
    same = [pair for pair in both if _originals(pair)]
    if 2 * len(same) > len(both):
        names = " and ".join(view.name for view in same[0] if view is not None)
        raise ValueError(
            f"the images of both cameras are the same, such as {names}: name the images of the other camera"
        )
    originals = [_originals([pair[side] for pair in pairs]) for side in (0, 1)]
    rejections = []
    remaining: list[ViewPair] = []
    for number, pair in enumerate(pairs):
        sides: list[TargetView | None] = []
        for view, original in zip(pair, originals, strict=True):
            copied = original.get(number)
            sides.append(view if copied is None else None)
            if view is not None and copied is not None:
                rejections.append(Rejection(view.name, 0, f"a copy of {copied}", copy=True))
        if sides != [None, None]:
            remaining.append((sides[0], sides[1]))
    return remaining, tuple(rejections)


def _originals(views: Sequence[TargetView | None]) -> dict[int, str]:
    """Return the number of each copied image of a camera, with its original's name."""
    numbers = [number for number, view in enumerate(views) if view is not None]
    seen = [view for view in views if view is not None]
    if not seen:
        return {}
    index = np.concatenate([view.index for view in seen])
    _, column = np.unique(index, axis=0, return_inverse=True)
    position = np.full((len(seen), int(column.max()) + 1, 2), np.nan)
    variance = np.full(position.shape[:2], np.nan)
    ends = np.cumsum([0, *(len(view.index) for view in seen)])
    for row, view in enumerate(seen):
        mine = column.ravel()[ends[row] : ends[row + 1]]
        position[row, mine], variance[row, mine] = view.position_px, np.einsum("nii->n", view.covariance_px2)
    found: dict[int, str] = {}
    for row in range(len(seen)):
        if numbers[row] in found:
            continue
        ratio = ((position[row + 1 :] - position[row]) ** 2).sum(axis=2) / (variance[row + 1 :] + variance[row])
        both = np.isfinite(ratio)
        enough = both.sum(axis=1) >= np.maximum(FEWEST_POINTS, np.isfinite(variance[row]).sum() / 2)
        total = np.where(both, ratio, 0.0).sum(axis=1)
        for other in np.flatnonzero(enough & (total < _COPY**2 * both.sum(axis=1))):
            found.setdefault(numbers[row + 1 + other], seen[row].name)
    return found


def pose_clusters(bundle: Bundle) -> IntArray:
    """Return the pose number (V,) of each view, in the order of first views.

    Two poses are one if the target differs by less than 0.02 in rotation (rad), in the place of its centre in the left
    image (over the diagonal), and in distance (relative): a hand that holds it moves it by less, a new pose differs by
    more. The closest ones are merged first, and replaced by their mean.
    """
    rotation = np.stack([pose.rotation for pose in bundle.poses]).reshape(-1, 9) / np.sqrt(2)
    centre = np.stack([pose.apply(bundle.shape.flat_m.mean(axis=0)) for pose in bundle.poses])
    camera, depth = bundle.rig.left, np.abs(centre[:, 2:])
    place = camera.parameters[:2] * centre[:, :2] / depth / float(np.linalg.norm(camera.size_px))
    mean, weight = np.concatenate([rotation, place, np.log(depth)], axis=1), np.ones(len(centre))
    cluster = np.arange(len(centre))
    distance = np.stack([_pose_distance(mean, each) for each in mean])
    np.fill_diagonal(distance, np.inf)
    while distance.min() < _ONE_POSE:
        first, second = sorted(np.unravel_index(int(distance.argmin()), distance.shape))
        cluster[cluster == second] = first
        mean[first] = np.average(mean[[first, second]], axis=0, weights=weight[[first, second]])
        weight[first] += weight[second]
        alive = np.isin(np.arange(len(cluster)), cluster)
        distance[first] = distance[:, first] = np.where(alive, _pose_distance(mean, mean[first]), np.inf)
        distance[first, first] = distance[second] = distance[:, second] = np.inf
    return np.asarray(np.unique(cluster, return_inverse=True)[1].ravel(), dtype=np.int64)


def _pose_distance(poses: FloatArray, pose: FloatArray) -> FloatArray:
    """Return the largest difference (V,) of poses (V, 12) in rotation, place and distance."""
    difference = poses - pose
    parts = [np.linalg.norm(difference[:, part], axis=1) for part in (slice(9), slice(9, 11), slice(11, 12))]
    return np.asarray(np.max(parts, axis=0))


def _repeated(cluster: IntArray, images: Sequence[ImageObservations]) -> Iterator[list[int]]:
    """Yield the numbers of several images of one camera and pose."""
    groups: dict[tuple[int, int], list[int]] = {}
    for number, image in enumerate(images):
        groups.setdefault((int(cluster[image.view]), image.side), []).append(number)
    yield from (members for members in groups.values() if len(members) > 1)


def repeated_variance(
    cluster: IntArray,
    images: Sequence[ImageObservations],
    residuals: Sequence[FloatArray],
    used: Sequence[BoolArray],
    parameters: float,
) -> FloatArray:
    """Return the variance (I,), px², added to images that repeat a pose.

    Per coordinate it is (n − 1)·s² for n images. With it, they together determine as much as their mean, whose variance
    is s² + w/n.

    Let a point of a pose have the residuals rᵢ in n images. With the variance w of one image alone and s² of all, the
    mean residual has the variance s² + w/n and the mean product of two residuals is s². The adjustment takes six
    degrees of freedom per image from w, and six per pose and `parameters` altogether from the means.
    """
    repeated = np.zeros(len(images))
    groups = list(_repeated(cluster, images))
    if not groups:
        return repeated
    views = len({image.view for image in images})
    coordinates = 2 * sum(int(each.sum()) for each in used)
    alone = max(1 - 6 * views / coordinates, 0.1)
    points = len({(int(cluster[p.view]), p.side, k) for p, u in zip(images, used, strict=True) for k in p.point[u]})
    means = max(1 - (6 * len(np.unique(cluster)) + parameters) / (2 * points), 0.1)
    for members in groups:
        point = np.concatenate([images[n].point[used[n]] for n in members])
        residual = np.concatenate([residuals[n][used[n]] for n in members])
        seen = np.bincount(point)
        total = np.stack([np.bincount(point, weights=each) for each in residual.T], axis=1)
        square = np.bincount(point, weights=(residual**2).sum(axis=1))
        several = seen > 1
        if not several.any():
            continue
        number = seen[several]
        product = ((total[several] ** 2).sum(axis=1) - square[several]) / (2 * number * (number - 1))
        single = square[several] / (2 * number)
        size = float(number.mean())
        within = max(float((single - product).mean()) / alone, 0.0)
        mean = (float(product.mean()) + within * alone / size) / means
        repeated[members] = (len(members) - 1) * max(mean - within / size, 0.0)
    return repeated
