"""Tracks of a grid of subsets: through time in one camera, and left to right."""

from __future__ import annotations

import ctypes
import sys
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from importlib.util import find_spec
from typing import Any

import numpy as np
from numpy.typing import NDArray

from photogram.arrays import Arrays, BoolArray, FloatArray, Notice, check_shape
from photogram.bspline import Spline, spline_of_image
from photogram.camera import StereoRig, epipolar_residual
from photogram.images.sequence import GreyImage, ImageSequence
from photogram.subsets.icgn import (
    Registration,
    TrackSettings,
    noise_of_residual,
    position_covariance,
    register,
    resolved,
)
from photogram.subsets.reference import PARAMETERS, Reference, TrackStatus, prepare_reference
from photogram.subsets.search import (
    affine_field,
    affine_starts,
    match_features,
    neighbour_starts,
    predict_warp,
    template_shifts,
)
from photogram.subsets.texture import (
    aliasing_bias,
    aliasing_notice,
    lay_grid,
    saturated,
    speckle_size,
    subset_mean,
    textured_area,
    without_saturated,
)

DEVICES = ("auto", "cpu", "cuda")


def resolve_device(choice: str) -> str:
    """The device 'cpu' or 'cuda' meant by `choice`: 'auto' is 'cuda' where torch can use one, 'cpu' elsewhere.

    Importing torch takes seconds, so 'auto' asks it only where an NVIDIA driver can be loaded.
    """
    if choice not in DEVICES:
        raise ValueError(f"device: expected one of {', '.join(DEVICES)}, found {choice!r}")
    if choice == "cpu" or (choice == "auto" and not _has_driver()):
        return "cpu"
    if _torch_finds_cuda():
        return "cuda"
    if choice == "cuda":
        raise ValueError("device: expected a GPU that torch can use for 'cuda', found none (try 'auto' or 'cpu')")
    return "cpu"


def _has_driver() -> bool:
    """Whether the NVIDIA driver's library is there; takes microseconds where it is not."""
    try:
        ctypes.CDLL("nvcuda.dll" if sys.platform == "win32" else "libcuda.so.1")
    except OSError:
        return False
    return True


def _torch_finds_cuda() -> bool:
    """Whether torch is installed, built for CUDA, and finds a device."""
    if find_spec("torch") is None:
        return False
    import torch

    return bool(torch.cuda.is_available())


Image = NDArray[Any]
Progress = Callable[[int], None]
EPIPOLAR_TOLERANCE_PX = 2.0
OVERLAP = 0.95
BORDER_PX = 5
HISTORY = 6
LARGEST_LOST_SHARE = 0.1


@dataclass(frozen=True, eq=False, repr=False)
class StereoTracks(Arrays, shapes="speckle_px 2; noise_grey 2; bias_px 2"):
    """One body seen by two cameras: the same N subsets in `left` and `right`, and what the images are like.

    speckle_px (2,): speckle size, noise_grey (2,): image noise in grey values, bias_px (2,): amplitude of the error,
    periodic in the pixel, that sampling and interpolation may leave in the mean of all subsets (`aliasing_bias`), NaN
    where it cannot be told; of the left and the right camera.
    """

    left: Tracks
    right: Tracks
    notices: tuple[Notice, ...]
    speckle_px: FloatArray
    noise_grey: FloatArray
    bias_px: FloatArray

    def __post_init__(self) -> None:
        super().__post_init__()
        check_shape("right.position_px", self.right.position_px, self.left.position_px.shape)


@dataclass(frozen=True)
class FollowedFrame:
    """One frame, its spline where tracking made one, and where the subsets are in it."""

    image: GreyImage
    spline: Spline | None
    found: Registration


@dataclass(frozen=True, eq=False, repr=False)
class StereoGrid(Arrays, shapes="left_px N 2; right_px N 2"):
    """Subsets of one body in the first images: left_px (N,2), right_px (N,2), the textured areas (H,W), and remarks."""

    left_px: FloatArray
    right_px: FloatArray
    areas: tuple[BoolArray, BoolArray]
    notices: tuple[Notice, ...]


def match_stereo(left_image: Image, right_image: Image, points_px: FloatArray, settings: TrackSettings) -> Tracks:
    """Positions in the right image (F = 1) of the subsets centred at points_px (N,2) in the left image.

    Starts from local affine maps of matched features, then from neighbours that were found.
    """
    check_shape("points_px", points_px, (None, 2))
    spline = spline_of_image(left_image, settings.degree)
    reference = prepare_reference(spline, points_px, settings.radius_px, settings.shape_order)
    right = right_image, spline_of_image(right_image, settings.degree)
    found = find_from_features(reference, left_image, right, settings)
    if not np.any(found.status == TrackStatus.OK):
        anywhere = replace(settings, reach_px=max(right_image.shape))
        found = find_by_search(reference, left_image, right, identity(reference).warp, anywhere)
    return tracks_of([find_from_neighbours(reference, right[1], found, settings)], reference, settings.degree)


def prepare_sequence(sequence: ImageSequence, points_px: FloatArray, settings: TrackSettings) -> Reference:
    """The subsets centred at points_px (N,2) in frame 0, which stays the reference of the whole sequence.

    Centres may lie between pixels; a NaN centre is carried along as `NO_START`.
    """
    check_shape("points_px", points_px, (None, 2))
    first = sequence.read(0)
    spline = spline_of_image(first, settings.degree)
    reference = prepare_reference(spline, points_px, settings.radius_px, settings.shape_order)
    return without_saturated(reference, first, sequence.full_scale)


def follow_sequence(
    sequence: ImageSequence,
    reference: Reference,
    settings: TrackSettings,
    device: str = "cpu",
    frames: range | None = None,
) -> Iterator[FollowedFrame]:
    """Every frame, or only some, in turn with where the subsets of `reference` (`prepare_sequence`) are in it.

    On the `device` "cpu" frames are read and held one at a time, and each starts from where the last ones foretell the
    subsets, the first after frame 0 or of later `frames` from the reference alone; on "cuda" they are registered in
    batches (`icgn_torch.follow_frames`), to the same positions.
    """
    wanted = range(len(sequence)) if frames is None else frames
    first = sequence.read(0)
    if wanted.start == 0:
        yield FollowedFrame(first, spline_of_image(first, settings.degree), identity(reference))
    later = range(max(1, wanted.start), wanted.stop)
    if device == "cpu":
        followed = _follow_one_by_one(sequence, first, reference, settings, later)
    else:
        from photogram.subsets.icgn_stream import follow_frames

        images = (sequence.read(number) for number in later)
        batched = follow_frames(reference, first, images, settings, device)
        followed = (FollowedFrame(image, None, found) for image, found in batched)
    for frame in followed:
        centres = reference.centre_px + frame.found.warp[:, [0, 3]]
        full = saturated(frame.image, sequence.full_scale, centres, settings.radius_px)
        yield replace(frame, found=dropped(frame.found, full, TrackStatus.SATURATED))


def track_sequence(
    sequence: ImageSequence, points_px: FloatArray, settings: TrackSettings, progress: Progress | None = None
) -> Tracks:
    """Positions in every frame of the subsets centred at points_px (N,2) in frame 0.

    `progress` is called with the number of finished frames.
    """
    reference = prepare_sequence(sequence, points_px, settings)
    found = []
    for frame in follow_sequence(sequence, reference, settings):
        found.append(frame.found)
        if progress is not None:
            progress(len(found))
    return tracks_of(found, reference, settings.degree)


def lay_stereo_grid(
    left: ImageSequence, right: ImageSequence, rig: StereoRig | None, settings: TrackSettings
) -> StereoGrid:
    """Lay a grid over the textured body in the first left image and match it to the first right image.

    Only subsets that were found there, that are not saturated and, with `rig`, that lie on their epipolar lines are
    kept. Raises `ValueError` when the cameras have unlike numbers of frames or fewer than three subsets are left.
    """
    if len(left) != len(right):
        raise ValueError(f"right: expected {len(left)} frames as in left, found {len(right)}")
    images = left.read(0), right.read(0)
    areas = _inner_area(images[0]), _inner_area(images[1])
    points = lay_grid(areas[0], settings.radius_px, settings.grid_step_px)
    if len(points) < 3:
        raise ValueError(f"left: expected a speckled body, found room for {len(points)} subsets in {left.names[0]}")
    matched = match_stereo(images[0], images[1], points, settings)
    right_px = matched.position_px[0]
    kept = (matched.status[0] == TrackStatus.OK) & (subset_mean(areas[1], right_px, settings.radius_px) >= OVERLAP)
    for image, camera, centres in ((images[0], left, points), (images[1], right, right_px)):
        kept &= ~saturated(image, camera.full_scale, centres, settings.radius_px)
    notices: list[Notice] = []
    if rig is not None:
        distance, _, _ = epipolar_residual(rig, points, np.where(kept[:, None], right_px, np.nan))
        off = _middle(distance)
        kept &= np.abs(distance - off) <= EPIPOLAR_TOLERANCE_PX
        if abs(off) > 1.0:
            text = (
                f"matched points lie {off:.1f} px off their epipolar lines on average: the calibration does not belong "
                "to these images, or a camera has moved since"
            )
            notices.append(Notice("warning", text, "stereo calibration"))
    if kept.sum() < 3:
        raise ValueError(
            f"right: expected the body of {left.names[0]}, found {kept.sum()} of its {len(points)} subsets "
            f"in {right.names[0]}"
        )
    return StereoGrid(points[kept], right_px[kept], areas, tuple(notices))


def stereo_tracks(
    images: tuple[GreyImage, GreyImage], grid: StereoGrid, tracks: tuple[Tracks, Tracks], settings: TrackSettings
) -> StereoTracks:
    """The tracks of both cameras with what their first images are like, and remarks on both."""
    notices, speckle, levels, biases = list(grid.notices), [], [], []
    for image, area, track, where in zip(images, grid.areas, tracks, ("left camera", "right camera"), strict=True):
        noise = _middle(track.noise_grey)
        bias = aliasing_bias(image, area, noise, settings.radius_px, settings.degree)
        unresolved = aliasing_notice(image, area, noise, bias, where)
        notices += [unresolved] if unresolved is not None else []
        lost = track.status[track.status != TrackStatus.OK]
        if lost.size > LARGEST_LOST_SHARE * track.status.size:
            reasons, counts = np.unique(lost, return_counts=True)
            why = TrackStatus(int(reasons[np.argmax(counts)])).name.lower().replace("_", " ")
            share = f"{100 * lost.size / track.status.size:.0f} %"
            notices.append(Notice("warning", f"{share} of the subset positions are missing, most often: {why}", where))
        speckle.append(speckle_size(image, area))
        levels.append(noise)
        biases.append(bias.mean_px)
    return StereoTracks(*tracks, tuple(notices), np.array(speckle), np.array(levels), np.array(biases))


def track_stereo(
    left: ImageSequence,
    right: ImageSequence,
    rig: StereoRig | None,
    settings: TrackSettings,
    progress: Progress | None = None,
) -> StereoTracks:
    """Follow the subsets of `lay_stereo_grid` through both cameras' images.

    `progress` is called with the number of finished frames, first of the left, then of the right camera: 1…2F.

    >>> from scipy.ndimage import gaussian_filter
    >>> noise = gaussian_filter(np.random.default_rng(1).standard_normal((96, 96)), 2.0, mode="wrap")
    >>> picture = np.rint(128 + 300 * noise).astype(np.uint8)
    >>> images = ImageSequence(("before", "after"), (96, 96), 255, lambda k: np.roll(picture, 2 * k, axis=1))
    >>> left = track_stereo(images, images, None, TrackSettings(radius_px=7)).left.position_px
    >>> np.median(left[1] - left[0], axis=0).round(2)
    array([2., 0.])
    """
    grid = lay_stereo_grid(left, right, rig, settings)
    left_tracks = track_sequence(left, grid.left_px, settings, progress)
    after = None if progress is None else lambda done: progress(len(left) + done)
    right_tracks = track_sequence(right, grid.right_px, settings, after)
    return stereo_tracks((left.read(0), right.read(0)), grid, (left_tracks, right_tracks), settings)


def _follow_one_by_one(
    sequence: ImageSequence, first: Image, reference: Reference, settings: TrackSettings, frames: range
) -> Iterator[FollowedFrame]:
    """Later frames, one by one on the CPU."""
    history: list[Registration] = []
    for number in frames:
        image = sequence.read(number)
        target = spline_of_image(image, settings.degree)
        if history:
            start = predict_warp([past.warp for past in history])
            found = follow(reference, first, (image, target), start, settings)
        else:
            found = find_anew(reference, first, (image, target), settings)
            history = [identity(reference)] if number == 1 else []
        history = [*history[1 - HISTORY :], found]
        yield FollowedFrame(image, target, found)


def _inner_area(image: Image) -> BoolArray:
    """Textured pixels that can move by a few pixels without leaving the image."""
    inside = slice(BORDER_PX, -BORDER_PX)
    return np.pad(textured_area(image)[inside, inside], BORDER_PX)


def _middle(values: FloatArray) -> float:
    """Median of the finite values."""
    finite = values[np.isfinite(values)]
    return float(np.median(finite)) if len(finite) else float("nan")


# Subsets of one image found in another: by prediction, by search, from their neighbours; and the tracks they leave.

NEIGHBOUR_ROUNDS = 8
SEEDS = 12


@dataclass(frozen=True, eq=False, repr=False)
class Tracks(Arrays, shapes="position_px F N 2; covariance_px2 F N 2 2; zncc F N; status F N; noise_grey N"):
    """Subset centres through time: position_px (F,N,2), covariance_px2 (F,N,2,2), zncc (F,N), status (F,N).

    The covariance is that of the frame's own image noise; the reference frame's noise is one constant offset of the
    whole series. Frame 0, whose positions are exact by definition, is given the covariance that it would have as any
    other frame. noise_grey (N,): image noise at each subset. Where status is not `TrackStatus.OK`, numbers are NaN.
    """

    position_px: FloatArray
    covariance_px2: FloatArray
    zncc: FloatArray
    status: NDArray[np.int8]
    noise_grey: FloatArray


def find_anew(reference: Reference, first: Image, frame: tuple[Image, Spline], settings: TrackSettings) -> Registration:
    """Subsets of the first image in a frame of which nothing is foretold: from rest and by search, the better one.

    A start at rest finds some subsets of a body that moved by a speckle in a wrong place; a search slides along edges.
    """
    rest = identity(reference).warp
    found = follow(reference, first, frame, rest, settings)
    searched = find_by_search(reference, first, frame, rest, settings)
    return find_from_neighbours(reference, frame[1], merged(found, searched), settings)


def follow(
    reference: Reference, first: Image, frame: tuple[Image, Spline], start: FloatArray, settings: TrackSettings
) -> Registration:
    """Subsets of the first image in a later one: from the prediction; where that loses most, by search.

    Searched seeds within `reach_px` of the prediction, then in the whole image, then matched features, which stand
    rotation as well; at last the lost ones from their neighbours.
    """
    found = register(reference, frame[1], start, settings)
    for attempt in range(3):
        if np.sum(found.status == TrackStatus.OK) >= 0.5 * np.sum(reference.status == TrackStatus.OK):
            break
        if attempt < 2:
            reach = settings.reach_px if attempt == 0 else max(frame[0].shape)
            more = find_by_search(reference, first, frame, start, replace(settings, reach_px=reach))
        else:
            more = find_from_features(reference, first, frame, settings)
        found = merged(found, more)
    return find_from_neighbours(reference, frame[1], found, settings)


def find_from_features(
    reference: Reference, first: Image, frame: tuple[Image, Spline], settings: TrackSettings
) -> Registration:
    """All subsets from the affine maps of matched features around them."""
    source, moved = match_features(first, frame[0])
    starts = np.full((len(reference.centre_px), 6), np.nan)
    usable = reference.status == TrackStatus.OK
    starts[usable] = affine_starts(reference.centre_px[usable], source, moved)
    return register(reference, frame[1], starts, settings)


def find_by_search(
    reference: Reference, first: Image, frame: tuple[Image, Spline], start: FloatArray, settings: TrackSettings
) -> Registration:
    """All subsets from one affine motion through a few well-textured seeds, which are searched by correlation."""
    usable = np.flatnonzero(reference.status == TrackStatus.OK)
    spread = usable[np.linspace(0, len(usable) - 1, min(len(usable), 4 * SEEDS)).astype(np.int64)]
    seeds = spread[np.argsort(-reference.energy[spread])[:SEEDS]]
    points = reference.centre_px[seeds]
    guess = np.nan_to_num(start[seeds][:, [0, 3]])
    shifts = template_shifts(first, frame[0], points, settings.radius_px, settings.reach_px, guess)
    field = affine_field(points, shifts, reference.centre_px)
    return register(reference, frame[1], field, settings)


def find_from_neighbours(
    reference: Reference, target: Spline, found: Registration, settings: TrackSettings
) -> Registration:
    """Lost subsets once more from the affine maps of their nearest neighbours, as long as that finds some."""
    for _ in range(NEIGHBOUR_ROUNDS):
        lost = (found.status != TrackStatus.OK) & (reference.status == TrackStatus.OK)
        if not lost.any() or lost.all():
            break
        start = neighbour_starts(reference.centre_px, found.warp)
        start[~lost] = np.nan
        more = register(reference, target, start, settings)
        if not np.any(more.status[lost] == TrackStatus.OK):
            break
        found = merged(found, more)
    return resolved(reference, found)


def merged(first: Registration, second: Registration) -> Registration:
    """`first`, with the subsets that only `second` found, or that it found where they correlate better."""
    worse = (first.status != TrackStatus.OK) | (first.zncc < second.zncc)
    better = worse & (second.status == TrackStatus.OK)
    return Registration(
        warp=np.where(better[:, None], second.warp, first.warp),
        zncc=np.where(better, second.zncc, first.zncc),
        gain=np.where(better, second.gain, first.gain),
        residual_grey2=np.where(better, second.residual_grey2, first.residual_grey2),
        status=np.where(better, second.status, first.status),
        iterations=first.iterations + second.iterations,
    )


def dropped(found: Registration, which: BoolArray, status: TrackStatus) -> Registration:
    """`found` without the subsets `which`, which receive the status."""
    return replace(
        found, warp=np.where(which[:, None], np.nan, found.warp), status=np.where(which, np.int8(status), found.status)
    )


def identity(reference: Reference) -> Registration:
    """The reference found in itself; its noise is filled in from the other frames."""
    ones = np.where(reference.status == TrackStatus.OK, 1.0, np.nan)
    warp = np.outer(ones, np.zeros(max(6, PARAMETERS[reference.order])))
    nothing, none = np.full(len(ones), np.nan), np.zeros(len(ones), np.int64)
    return Registration(warp, ones, ones, nothing, reference.status, none)


def tracks_of(found: Sequence[Registration], reference: Reference, degree: int) -> Tracks:
    """Positions and covariances of all frames; the first of several is the reference itself."""
    status = np.stack([here.status for here in found])
    ok = status == TrackStatus.OK
    noise = np.stack([noise_of_residual(reference, here, degree) for here in found])
    noise[~ok] = np.nan
    seen = np.isfinite(noise)
    pooled = np.sqrt(np.sum(np.where(seen, noise, 0.0) ** 2, axis=0) / np.maximum(seen.sum(axis=0), 1))
    pooled = np.where(seen.any(axis=0), pooled, np.nan)
    noise[0] = np.where(np.isfinite(noise[0]) | ~ok[0], noise[0], pooled)
    position = np.stack([reference.centre_px + here.warp[:, [0, 3]] for here in found])
    covariance = np.stack(
        [position_covariance(reference, here, level) for here, level in zip(found, noise, strict=True)]
    )
    position[~ok], covariance[~ok] = np.nan, np.nan
    zncc = np.where(ok, np.stack([here.zncc for here in found]), np.nan)
    return Tracks(position, covariance, zncc, status, pooled)
