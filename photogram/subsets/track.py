"""Tracks of a grid of subsets through time, and from left to right."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from itertools import count
from threading import Lock
from typing import Any

import numpy as np
from numpy.typing import NDArray

from photogram.bspline import Spline, spline_of_image
from photogram.camera import StereoRig, epipolar_residual
from photogram.frame_statistics import RunningMean
from photogram.images.image_notices import LOST_SUBSETS, OFF_EPIPOLAR_LINES
from photogram.images.sequence import GreyImage, ImageSequence, missing_pattern_reason
from photogram.subsets.find import (
    BodyNotFound,
    DepthRange,
    Follower,
    find_by_search,
    find_from_features,
    find_from_neighbours,
    find_on_lines,
    identity_registration,
)
from photogram.subsets.icgn import Registration, TrackSettings, position_covariance, subset_noise, subset_positions
from photogram.subsets.reference import ReferenceSubsets, TrackStatus, prepare_reference
from photogram.subsets.search import HISTORY, LARGEST_COEFFICIENT, predict_warp
from photogram.subsets.sweep import TOLERANCE_PX
from photogram.subsets.texture import (
    aliasing_bias,
    aliasing_notice,
    find_saturated,
    mark_unusable,
    place_subsets,
    repeat_distance_px,
    speckle_size,
    subset_mean,
    textured_area,
)
from shakercal._common.arrays import Arrays, BoolArray, FloatArray, IntArray, check_shape
from shakercal._common.notices import Notice

Image = NDArray[Any]
Progress = Callable[[int], None]
OVERLAP = 0.95  # share of a subset that has to lie in the textured area of the right image
BORDER_PX = 5  # in which the body may move without leaving the image
LARGEST_LOST_SHARE = 0.1  # of the positions, above which a warning is given


@dataclass(frozen=True, eq=False, repr=False)
class Tracks(Arrays, shapes="position_px F N 2; covariance_px2 F N 2 2; zncc F N; status F N; noise_grey N"):
    """Subset centres through time; numbers are NaN where status is not `TrackStatus.OK`.

    The covariance is that of the frame's image noise. The reference frame's noise is one constant offset of the whole
    series. Frame 0, whose positions are exact by definition, has the covariance of a frame like it.

    Attributes
    ----------
    position_px : (F, N, 2).
    covariance_px2 : (F, N, 2, 2).
    zncc : (F, N) zero-mean normalised cross-correlation.
    status : (F, N) of `TrackStatus`.
    noise_grey : (N,) image noise at each subset.
    """

    position_px: FloatArray
    covariance_px2: FloatArray
    zncc: FloatArray
    status: NDArray[np.int8]
    noise_grey: FloatArray


@dataclass(frozen=True, eq=False, repr=False)
class StereoTracks(Arrays, shapes="speckle_px C; noise_grey C; bias_px C"):
    """The same N subsets of one body in C cameras, with image properties.

    The only camera counts as the left one.

    Attributes
    ----------
    cameras : the tracks in each camera, of all frames or of some; () for the properties alone.
    notices : of the cameras.
    speckle_px : (C,) speckle size.
    noise_grey : (C,) image noise in grey values.
    bias_px : (C,) amplitude of the error, periodic in the pixel, that sampling and interpolation may leave in the mean
        of all subsets (`aliasing_bias`); NaN where it is undetermined.
    """

    cameras: tuple[Tracks, ...]
    notices: tuple[Notice, ...]
    speckle_px: FloatArray
    noise_grey: FloatArray
    bias_px: FloatArray

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.cameras:
            check_shape("speckle_px", self.speckle_px, (len(self.cameras),))
        for other in self.cameras[1:]:
            check_shape("right.position_px", other.position_px, self.left.position_px.shape)

    @property
    def left(self) -> Tracks:
        """The subsets in the left camera, or in the only one."""
        return self.cameras[0]

    @property
    def right(self) -> Tracks:
        """The subsets in the right camera of a pair."""
        return self.cameras[1]


@dataclass(frozen=True)
class FollowedImage:
    """One image with its spline and the registration of the subsets."""

    image: GreyImage
    spline: Spline
    found: Registration


@dataclass(frozen=True, eq=False, repr=False)
class StereoGrid(Arrays):
    """Centres (N,2) of subsets and textured areas (H,W) in the first images."""

    centres_px: tuple[FloatArray, ...]
    areas: tuple[BoolArray, ...]
    notices: tuple[Notice, ...]

    @property
    def left_px(self) -> FloatArray:
        """Their centres in the left camera, or in the only one."""
        return self.centres_px[0]

    @property
    def right_px(self) -> FloatArray:
        """Their centres in the right camera of a pair."""
        return self.centres_px[1]


SplineFrame = tuple[Image, Spline]
"""An image and its spline."""


def first_frame(sequence: ImageSequence, settings: TrackSettings) -> SplineFrame:
    """Return the image that is the reference of a whole sequence, with its spline."""
    first = sequence.read(0)
    return first, spline_of_image(first, settings.degree)


def match_stereo(
    left_image: Image,
    right_image: Image,
    points_px: FloatArray,
    settings: TrackSettings,
    rig: StereoRig | None = None,
    depth_m: DepthRange | None = None,
    splines: tuple[Spline, ...] | None = None,
) -> Tracks:
    """Return positions in the right image of subsets at points_px (N,2) in the left.

    With `rig` they are found along their epipolar lines (`find_on_lines`, within the depths `depth_m`). Without it, or
    where no surface fits it, local affine maps of matched features lead to them, then neighbours that were found.
    `splines`: of both images. Raises `BodyNotFound` where two surfaces fit equally.
    """
    check_shape("points_px", points_px, (None, 2))
    splines = splines or tuple(spline_of_image(image, settings.degree) for image in (left_image, right_image))
    reference = prepare_reference(splines[0], points_px, settings.radius_px, settings.shape_order)
    right = right_image, splines[1]
    found = None if rig is None else find_on_lines(reference, left_image, right, settings, rig, depth_m)
    if found is not None:
        return build_tracks([found], reference, settings.degree)
    found = find_from_features(reference, left_image, right, settings)
    if not np.any(found.status == TrackStatus.OK):
        anywhere = replace(settings, reach_px=max(right_image.shape))
        found = find_by_search(reference, left_image, right, identity_registration(reference).warp, anywhere)
    return build_tracks([find_from_neighbours(reference, right[1], found, settings)], reference, settings.degree)


def prepare_sequence(
    sequence: ImageSequence, points_px: FloatArray, settings: TrackSettings, frame: SplineFrame | None = None
) -> ReferenceSubsets:
    """Return the subsets centred at points_px (N,2) in frame 0, the reference of the sequence.

    `frame`: its `first_frame`, if available. A NaN centre has the status `NO_START`.
    """
    check_shape("points_px", points_px, (None, 2))
    first, spline = frame or first_frame(sequence, settings)
    reference = prepare_reference(spline, points_px, settings.radius_px, settings.shape_order)
    return mark_unusable(reference, first, sequence.saturation)


def follow_sequence(
    sequence: ImageSequence, reference: ReferenceSubsets, settings: TrackSettings, frames: range | None = None
) -> Iterator[FollowedImage]:
    """Yield every frame, or some of them, with the subsets of `reference` found in it.

    Frames are read one at a time. Each frame starts from the prediction of the last ones. The first frame after frame
    0, or the first of later `frames`, starts from the reference alone.
    """
    selected = range(len(sequence)) if frames is None else frames
    first = sequence.read(0)
    if selected.start == 0:
        yield FollowedImage(first, spline_of_image(first, settings.degree), identity_registration(reference))
    later = range(max(1, selected.start), selected.stop)
    follower = Follower(reference, first, sequence.saturation, settings)
    history = [identity_registration(reference)] if later.start == 1 else []
    for number, image in zip(later, sequence.read_ahead(later), strict=True):
        target = spline_of_image(image, settings.degree)
        first_of_block = number == later.start  # starts from the reference alone
        start = None if first_of_block else predict_warp([past.warp for past in history])
        found = follower.find((image, target), start, history[-1].warp if history else None)
        history = [*history[1 - HISTORY :], found]
        yield FollowedImage(image, target, found)


def track_sequence(
    sequence: ImageSequence, points_px: FloatArray, settings: TrackSettings, progress: Progress | None = None
) -> Tracks:
    """Return the tracks of subsets centred at points_px (N,2) in frame 0; report finished frames."""
    reference = prepare_sequence(sequence, points_px, settings)
    found = []
    for frame in follow_sequence(sequence, reference, settings):
        found.append(frame.found)
        if progress is not None:
            progress(len(found))
    return build_tracks(found, reference, settings.degree)


def lay_stereo_grid(
    left: ImageSequence,
    right: ImageSequence,
    rig: StereoRig | None,
    settings: TrackSettings,
    depth_m: DepthRange | None = None,
    frames: tuple[SplineFrame, ...] | None = None,
) -> StereoGrid:
    """Lay a grid over the body in the first left image, matched to the right.

    frames: their `first_frame`, if available. Kept are only subsets that were found in the right image, are not
    saturated and, with `rig`, lie on their epipolar lines. Raises `ValueError` for different numbers of frames. Raises
    `BodyNotFound` for fewer than three remaining subsets, and where the pattern repeats so that they may be elsewhere.
    """
    if len(left) != len(right):
        raise ValueError(f"right: expected {len(left)} frames as in left, found {len(right)}")
    images, splines = zip(*(frames or [first_frame(side, settings) for side in (left, right)]), strict=True)
    for side, camera, image in (("left", left, images[0]), ("right", right, images[1])):
        _refuse_blank(side, camera, image)
    left_area, points = _textured_grid(left.names[0], images[0], settings)
    areas, chosen = (left_area, _inner_area(images[1])), _chosen_part(left_area.shape, settings)
    matched = match_stereo(images[0], images[1], points, settings, rig, depth_m, splines)
    right_px = matched.position_px[0]
    accepted = (matched.status[0] == TrackStatus.OK) & (subset_mean(areas[1], right_px, settings.radius_px) >= OVERLAP)
    for image, camera, centres in ((images[0], left, points), (images[1], right, right_px)):
        accepted &= ~find_saturated(image, camera.saturation, centres, settings.radius_px)
    notices: list[Notice] = []
    if rig is not None:
        distance, _, _ = epipolar_residual(rig, points, np.where(accepted[:, None], right_px, np.nan))
        off = float(finite_median(distance))
        accepted &= np.abs(distance - off) <= TOLERANCE_PX
        if abs(off) > 1.0:
            period = repeat_distance_px(images[0], points, settings.radius_px)
            if np.isfinite(period):
                raise BodyNotFound(
                    f"right: expected the body on its epipolar lines, found it {off:.1f} px from them. Its pattern "
                    f"repeats every {period:.1f} px: a copy was confused with the original, or the calibration does "
                    "not belong to these images"
                )
            notices.append(Notice(OFF_EPIPOLAR_LINES, "stereo calibration", offset_px=off))
    if accepted.sum() < 3:
        raise BodyNotFound(
            f"right: expected the body of {left.names[0]}, found {accepted.sum()} of its {len(points)} subsets "
            f"in {right.names[0]}"
        )
    if chosen is not None:
        areas = areas[0], areas[1] & _covered(areas[1].shape, right_px[accepted], settings.radius_px)
    return StereoGrid((points[accepted], right_px[accepted]), areas, tuple(notices))


def lay_single_grid(images: ImageSequence, settings: TrackSettings, first: GreyImage) -> StereoGrid:
    """Lay a grid over the textured body in the first image of a single camera.

    Saturated subsets are excluded. Raises `BodyNotFound` when fewer than three subsets remain.
    """
    _refuse_blank("left", images, first)
    area, points = _textured_grid(images.names[0], first, settings)
    accepted = points[~find_saturated(first, images.saturation, points, settings.radius_px)]
    if len(accepted) < 3:
        raise BodyNotFound(
            f"left: expected a speckled body, found {len(accepted)} unsaturated subsets in {images.names[0]}"
        )
    return StereoGrid((accepted,), (area,), ())


def _refuse_blank(side: str, images: ImageSequence, first: Image) -> None:
    why = missing_pattern_reason(first, images.full_scale)
    if why:
        raise BodyNotFound(f"{side}: expected an image of a speckled body, found none in {images.names[0]}: {why}")


def _textured_grid(name: str, image: Image, settings: TrackSettings) -> tuple[BoolArray, FloatArray]:
    """Return the chosen textured area (H,W) of the first image and its grid (N,2)."""
    area = _inner_area(image)
    chosen = _chosen_part(area.shape, settings)
    area = area if chosen is None else area & chosen
    points = place_subsets(area, settings.radius_px, settings.grid_step_px)
    if len(points) < 3:
        raise BodyNotFound(f"left: expected a speckled body, found {len(points)} subsets in {name}")
    return area, points


def stereo_tracks(
    images: tuple[GreyImage, GreyImage],
    grid: StereoGrid,
    tracks: tuple[Tracks, Tracks],
    settings: TrackSettings,
    rig: StereoRig | None = None,
) -> StereoTracks:
    """Return the tracks of both cameras with the properties of their first images.

    With `rig`, positions at which the cameras show a subset in different places are rejected. Raises `BodyNotFound`
    where that happens to the whole body, or it jumps, and its pattern repeats.
    """
    monitor = EpipolarMonitor(rig)
    rejected = monitor.add((tracks[0].position_px, tracks[1].position_px), (tracks[0].status, tracks[1].status))
    summary = monitor.summarize(images, grid, settings, (tracks[0].noise_grey, tracks[1].noise_grey))
    return replace(summary, cameras=drop_rejected(tracks, rejected))


class EpipolarMonitor:
    """Motion and rejected positions of a series, whose frames arrive in blocks.

    With `rig`, a position is rejected where its epipolar distance changes unlike that of the others: it belongs to a
    copy.
    """

    def __init__(self, rig: StereoRig | None) -> None:
        self._rig = rig
        self._first: tuple[FloatArray, ...] = ()
        self._residual = np.empty(0)
        self._common: list[FloatArray] = []
        self._moved: tuple[list[FloatArray], ...] = ()
        self._statuses: IntArray = np.empty(0, np.int64)

    def add(self, positions_px: tuple[FloatArray, ...], statuses: tuple[NDArray[np.int8], ...]) -> BoolArray:
        """Add frames, positions (F,N,2) and statuses (F,N) of each camera; return the rejected (F,N)."""
        if not self._first:
            self._first, self._moved = tuple(side[0] for side in positions_px), tuple([] for _ in positions_px)
            self._statuses = np.zeros((len(positions_px), len(TrackStatus)), np.int64)
            if self._rig is not None:
                self._residual = epipolar_residual(self._rig, *self._first)[0]
        common, rejected = self._epipolar_changes(positions_px)
        self._common.append(common)
        for side, (position, status) in enumerate(zip(positions_px, statuses, strict=True)):
            seen = np.where(rejected[..., None], np.nan, position) - self._first[side]
            self._moved[side].append(np.array([finite_median(frame) for frame in seen]))
            counted = np.where(rejected, np.int8(TrackStatus.NOT_CONVERGED), status)
            self._statuses[side] += np.bincount(counted.ravel(), minlength=len(TrackStatus))
        return rejected

    def add_motion(self, moved_px: tuple[FloatArray, ...]) -> None:
        """Add a frame without subsets, by the displacement (2,) of the body in each camera."""
        self._common.append(np.full(1, np.nan))
        for side, moved in enumerate(moved_px):
            self._moved[side].append(moved[None])

    def find_rejected(self, positions_px: tuple[FloatArray, ...]) -> BoolArray:
        """Return which positions (F, N) of frames that were added are rejected."""
        return self._epipolar_changes(positions_px)[1]

    def _epipolar_changes(self, positions_px: tuple[FloatArray, ...]) -> tuple[FloatArray, BoolArray]:
        """Return the common change of the epipolar distance (F,) and departing subsets (F,N)."""
        if self._rig is None:
            return np.zeros(len(positions_px[0])), np.zeros(positions_px[0].shape[:2], np.bool_)
        change = epipolar_residual(self._rig, *positions_px)[0] - self._residual
        common = np.array([finite_median(frame) for frame in change])
        return common, np.asarray(np.abs(change - common[:, None]) > TOLERANCE_PX)

    def summarize(
        self,
        images: tuple[GreyImage, ...],
        grid: StereoGrid,
        settings: TrackSettings,
        noise_grey: tuple[FloatArray, ...],
    ) -> StereoTracks:
        """Return the properties of the cameras, whose subsets have the noise (N,), without their tracks.

        Raises `BodyNotFound` as `stereo_tracks` does.
        """
        self._refuse_copies(images[0], settings)
        for image, first, moved, side in zip(images, self._first, self._moved, ("left", "right"), strict=False):
            _refuse_jumps(image, first, np.concatenate(moved), settings, side)
        notices, speckle, levels, biases = list(grid.notices), [], [], []
        cameras = zip(images, grid.areas, noise_grey, self._statuses, ("left camera", "right camera"), strict=False)
        for image, area, noises, counts, where in cameras:
            noise = float(finite_median(noises))
            bias = aliasing_bias(image, area, noise, settings.radius_px, settings.degree)
            speckle.append(speckle_size(image, area))
            unresolved = aliasing_notice(image, area, noise, speckle[-1], bias, where)
            notices += [unresolved] if unresolved is not None else []
            lost = counts.sum() - counts[TrackStatus.OK]
            if lost > LARGEST_LOST_SHARE * counts.sum():
                most = np.argmax(np.where(np.arange(len(counts)) == TrackStatus.OK, -1, counts))
                why = TrackStatus(int(most)).name.lower().replace("_", " ")
                notices.append(Notice(LOST_SUBSETS, where, lost_percent=100 * lost / counts.sum(), status=why))
            levels.append(noise)
            biases.append(bias.mean_px)
        return StereoTracks((), tuple(notices), np.array(speckle), np.array(levels), np.array(biases))

    def _refuse_copies(self, image: Image, settings: TrackSettings) -> None:
        """Raise `BodyNotFound` where all subsets leave their epipolar lines and the pattern repeats.

        Either a camera moved, or the whole body was found on a copy of itself in one camera. The images cannot show
        which.
        """
        common = np.concatenate(self._common)
        jumps = np.flatnonzero(np.abs(common) > TOLERANCE_PX)
        if not len(jumps):
            return
        period = repeat_distance_px(image, self._first[0], settings.radius_px)
        if np.isfinite(period):
            raise BodyNotFound(
                f"right: expected the body where the left camera shows it, found it {abs(common[jumps[0]]):.1f} px "
                f"from its epipolar lines in frame {jumps[0]} (counted from 0). Its pattern repeats every "
                f"{period:.1f} px: a copy was confused with the original in one camera, or a camera moved"
            )


def _refuse_jumps(image: Image, first_px: FloatArray, moved: FloatArray, settings: TrackSettings, side: str) -> None:
    """Raise `BodyNotFound` where a body whose pattern repeats jumps by more than half a period.

    The jump is the distance from the prediction. first_px (N, 2): the subsets at first; moved (F, 2): their
    displacement since, NaN where none is found. A copy of the pattern then lies nearer, and the images cannot show
    which one is the body.
    """
    seen = np.isfinite(moved).all(axis=1)
    path = np.vstack([np.zeros(2), moved[seen]])
    extent, step = np.hypot(*np.ptp(path, axis=0)), np.hypot(*np.diff(path, axis=0).T).max(initial=0.0)
    # No rule predicts a larger displacement: that of a sine starts three steps before it.
    if min((1.0 + LARGEST_COEFFICIENT) * extent, (3.0 + LARGEST_COEFFICIENT) * step) <= settings.radius_px:
        return
    warps = np.zeros((len(moved), 1, 6))
    last = np.maximum.accumulate(np.where(seen, np.arange(len(moved)), -1))
    warps[:, 0, [0, 3]] = np.where((last >= 0)[:, None], moved[np.maximum(last, 0)], 0.0)
    predicted = [predict_warp(list(warps[max(0, frame - HISTORY) : frame])) for frame in range(1, len(warps))]
    jump = np.hypot(*(warps[1:] - np.array(predicted).reshape(-1, 1, 6))[:, 0, [0, 3]].T)
    if not (jump > settings.radius_px).any():
        return
    period = repeat_distance_px(image, first_px, settings.radius_px)
    jumps = np.flatnonzero(jump > period / 2.0)
    if len(jumps):
        raise BodyNotFound(
            f"{side}: expected a motion as predicted by the last frames, found a jump of {jump[jumps[0]]:.1f} px in "
            f"frame {jumps[0] + 1} (counted from 0), more than half of the pattern's period of {period:.1f} px. A copy "
            "may have been confused with the original: use a foil that does not repeat, or more frames per second"
        )


def drop_rejected(tracks: tuple[Tracks, ...], rejected: BoolArray) -> tuple[Tracks, ...]:
    """Return the tracks of each camera without the positions `rejected` (F, N)."""
    return tuple(_drop(track, rejected) for track in tracks) if rejected.any() else tracks


def _drop(track: Tracks, which: BoolArray) -> Tracks:
    return replace(
        track,
        position_px=np.where(which[..., None], np.nan, track.position_px),
        covariance_px2=np.where(which[..., None, None], np.nan, track.covariance_px2),
        zncc=np.where(which, np.nan, track.zncc),
        status=np.where(which, np.int8(TrackStatus.NOT_CONVERGED), track.status),
    )


def track_stereo(
    left: ImageSequence,
    right: ImageSequence,
    rig: StereoRig | None,
    settings: TrackSettings,
    progress: Progress | None = None,
) -> StereoTracks:
    """Track the subsets of a textured body through the images of two cameras.

    Each camera has a thread. The subsets are those of `lay_stereo_grid`.

    Parameters
    ----------
    left, right
        The images, of equal number.
    rig
        Calibrated pair; None matches without epipolar lines.
    settings
        Of the subsets.
    progress
        Called with the number of finished frames of both cameras, 1…2F; default None.

    Returns
    -------
    StereoTracks
        Positions in px with covariances, and notices.

    Raises
    ------
    BodyNotFound
        Where fewer than three subsets are found, or a repeating pattern leaves the position undetermined.

    Examples
    --------
    >>> from scipy.ndimage import gaussian_filter
    >>> noise = gaussian_filter(np.random.default_rng(1).standard_normal((96, 96)), 2.0, mode="wrap")
    >>> image = np.rint(128 + 300 * noise).astype(np.uint8)
    >>> images = ImageSequence(("before", "after"), (96, 96), 255, lambda k: np.roll(image, 2 * k, axis=1))
    >>> left = track_stereo(images, images, None, TrackSettings(radius_px=7)).left.position_px
    >>> np.median(left[1] - left[0], axis=0).round(2).tolist() == [2, 0]
    True
    """
    grid = lay_stereo_grid(left, right, rig, settings)
    counted = None if progress is None else _count_together(progress)
    with ThreadPoolExecutor(2) as cameras:
        of_left = cameras.submit(track_sequence, left, grid.left_px, settings, counted)
        of_right = cameras.submit(track_sequence, right, grid.right_px, settings, counted)
        tracks = of_left.result(), of_right.result()
    return stereo_tracks((left.read(0), right.read(0)), grid, tracks, settings, rig)


def _count_together(progress: Progress) -> Progress:
    counting, done = Lock(), count(1)

    def report(_: int) -> None:
        with counting:
            progress(next(done))

    return report


def _inner_area(image: Image) -> BoolArray:
    """Return textured pixels that can move by a few pixels without leaving the image."""
    inside = slice(BORDER_PX, -BORDER_PX)
    return np.pad(textured_area(image)[inside, inside], BORDER_PX)


def _chosen_part(shape: tuple[int, ...], settings: TrackSettings) -> BoolArray | None:
    """Return the pixels (H,W) in the region and in no mask, None without both."""
    if settings.region is None and not settings.mask:
        return None
    import cv2

    chosen = np.full(shape, settings.region is None, dtype=np.uint8)
    for value, outline in ((1, settings.region), *((0, mask) for mask in settings.mask)):
        if outline is not None and isinstance(outline[0], int):
            x, y, width, height = outline
            chosen[y : y + height, x : x + width] = value
        elif outline is not None:
            cv2.fillPoly(chosen, [np.array(outline, dtype=np.int32)], value)
    return chosen.astype(np.bool_)


def _covered(shape: tuple[int, ...], centre_px: FloatArray, radius_px: int) -> BoolArray:
    covered = np.zeros(shape, dtype=bool)
    for x, y in np.rint(centre_px).astype(int).tolist():
        covered[max(y - radius_px, 0) : y + radius_px + 1, max(x - radius_px, 0) : x + radius_px + 1] = True
    return covered


def finite_median(values: FloatArray) -> FloatArray:
    """Return the median of the finite values (N,) or rows (N, K), NaN for none."""
    finite = values[np.isfinite(values).reshape(len(values), -1).all(axis=1)]
    return np.asarray(np.median(finite, axis=0) if len(finite) else np.full(values.shape[1:], np.nan))


def build_tracks(
    found: Sequence[Registration], reference: ReferenceSubsets, degree: int, noise_grey: FloatArray | None = None
) -> Tracks:
    """Return the tracks of frames of a series with the image noise (N,).

    Without noise_grey they are all frames, and the first one is the reference.
    """
    position, status = subset_positions(found, reference)
    ok, noise = status == TrackStatus.OK, subset_noise(found, reference, degree)
    if noise_grey is None:
        pooled = RunningMean()
        pooled.add(noise**2)
        noise_grey = np.sqrt(pooled.mean)
    noise[0] = np.where(np.isfinite(noise[0]) | ~ok[0], noise[0], noise_grey)
    covariance = np.stack([position_covariance(reference, one, level) for one, level in zip(found, noise, strict=True)])
    covariance[~ok] = np.nan
    zncc = np.where(ok, np.stack([frame.zncc for frame in found]), np.nan)
    return Tracks(position, covariance, zncc, status, noise_grey)
