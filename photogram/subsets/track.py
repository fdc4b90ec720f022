"""Tracks of a grid of subsets: through time in one camera, and left to right."""

from __future__ import annotations

import ctypes
import sys
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from importlib.util import find_spec
from typing import Any

import numpy as np
from numpy.typing import NDArray

from photogram.arrays import BoolArray, FloatArray, Notice, check_shape
from photogram.bspline import Spline, spline_of_image
from photogram.camera import Camera, StereoRig
from photogram.geometry import skew
from photogram.images import GreyImage, ImageSequence
from photogram.subsets.follow import (
    Tracks,
    TrackSettings,
    dropped,
    find_anew,
    find_by_search,
    find_from,
    find_from_neighbours,
    follow,
    identity,
    predict_warp,
    tracks_of,
    without_saturated,
)
from photogram.subsets.grid import lay_grid, saturated, speckle_size, subsets_inside, textured_area
from photogram.subsets.icgn import Registration
from photogram.subsets.quality import AliasingBias, aliasing_bias, aliasing_notice
from photogram.subsets.reference import Reference, TrackStatus, prepare_reference
from photogram.subsets.search import affine_starts, agreeing, epipolar_distance, match_features

# Which processor the batched tracking runs on.


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


# Subsets followed from the left to the right camera and through time.


Image = NDArray[Any]
Progress = Callable[[int], None]
EPIPOLAR_TOLERANCE_PX = 2.0
OVERLAP = 0.95
BORDER_PX = 5
HISTORY = 6
LARGEST_LOST_SHARE = 0.1


@dataclass(frozen=True)
class StereoTracks:
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
        check_shape("right.position_px", self.right.position_px, self.left.position_px.shape)
        check_shape("speckle_px", self.speckle_px, (2,))
        check_shape("noise_grey", self.noise_grey, (2,))
        check_shape("bias_px", self.bias_px, (2,))


@dataclass(frozen=True)
class FollowedFrame:
    """One frame, its spline where tracking made one, and where the subsets are in it."""

    image: GreyImage
    spline: Spline | None
    found: Registration


@dataclass(frozen=True)
class StereoGrid:
    """Subsets of one body in the first images: left_px (N,2), right_px (N,2), the textured areas (H,W), and remarks."""

    left_px: FloatArray
    right_px: FloatArray
    areas: tuple[BoolArray, BoolArray]
    notices: tuple[Notice, ...]

    def __post_init__(self) -> None:
        check_shape("left_px", self.left_px, (None, 2))
        check_shape("right_px", self.right_px, self.left_px.shape)


def match_stereo(
    left_image: Image,
    right_image: Image,
    points_px: FloatArray,
    settings: TrackSettings,
    fundamental: FloatArray | None = None,
) -> Tracks:
    """Positions in the right image (F = 1) of the subsets centred at points_px (N,2) in the left image.

    Starts from local affine maps of matched features, then from neighbours that were found. With `fundamental` (3,3),
    matches off the epipolar lines F·[left; 1] by more than 2 px from the median distance are dropped.
    """
    check_shape("points_px", points_px, (None, 2))
    spline = spline_of_image(left_image, settings.degree)
    reference = prepare_reference(spline, points_px, settings.radius_px, settings.shape_order)
    target = spline_of_image(right_image, settings.degree)
    source, matched = match_features(left_image, right_image)
    if fundamental is not None and len(source) > 0:
        kept = agreeing(epipolar_distance(fundamental, source, matched), EPIPOLAR_TOLERANCE_PX)
        source, matched = source[kept], matched[kept]
    found = find_from(reference, target, affine_starts(points_px, source, matched), settings)
    if not np.any(found.status == TrackStatus.OK):
        anywhere = replace(settings, reach_px=max(right_image.shape))
        found = find_by_search(reference, left_image, (right_image, target), np.zeros_like(found.warp), anywhere)
    found = find_from_neighbours(reference, target, found, settings)
    if fundamental is not None:
        right_px = points_px + found.warp[:, [0, 3]]
        kept = agreeing(epipolar_distance(fundamental, points_px, right_px), EPIPOLAR_TOLERANCE_PX)
        found = dropped(found, ~kept & (found.status == TrackStatus.OK), TrackStatus.LOW_CORRELATION)
    return tracks_of([found], reference, settings.degree)


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
    followed = _follow_here if device == "cpu" else _follow_on_device
    for frame in followed(sequence, first, reference, settings, range(max(1, wanted.start), wanted.stop), device):
        centres = reference.centre_px + frame.found.warp[:, [0, 3]]
        full = saturated(frame.image, sequence.full_scale, centres, settings.radius_px)
        yield replace(frame, found=dropped(frame.found, full, TrackStatus.SATURATED))


def track_sequence(
    sequence: ImageSequence,
    points_px: FloatArray,
    settings: TrackSettings,
    progress: Progress | None = None,
    device: str = "cpu",
) -> Tracks:
    """Positions in every frame of the subsets centred at points_px (N,2) in frame 0.

    `progress` is called with the number of finished frames.
    """
    reference = prepare_sequence(sequence, points_px, settings)
    found = []
    for frame in follow_sequence(sequence, reference, settings, device):
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
    areas = textured_area(images[0]), textured_area(images[1])
    areas = areas[0] & _away_from_border(images[0].shape), areas[1] & _away_from_border(images[1].shape)
    points = lay_grid(areas[0], settings.radius_px, settings.grid_step_px)
    if len(points) < 3:
        raise ValueError(f"left: expected a speckled body, found room for {len(points)} subsets in {left.names[0]}")
    matched = match_stereo(images[0], images[1], points, settings)
    right_px = matched.position_px[0]
    kept = (matched.status[0] == TrackStatus.OK) & subsets_inside(areas[1], right_px, settings.radius_px, OVERLAP)
    for image, camera, centres in ((images[0], left, points), (images[1], right, right_px)):
        kept &= ~saturated(image, camera.full_scale, centres, settings.radius_px)
    notices: list[Notice] = []
    if rig is not None:
        kept &= _on_epipolar_lines(rig, points, np.where(kept[:, None], right_px, np.nan), notices)
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
    speckle = np.array([speckle_size(image, area) for image, area in zip(images, grid.areas, strict=True)])
    levels = np.array([_middle(track.noise_grey) for track in tracks])
    notices, biases = list(grid.notices), list[AliasingBias]()
    for image, area, side, track in zip(images, grid.areas, ("left", "right"), tracks, strict=True):
        noise = _middle(track.noise_grey)
        biases.append(aliasing_bias(image, area, noise, settings.radius_px, settings.degree))
        unresolved = aliasing_notice(image, area, noise, biases[-1], f"{side} camera")
        notices += [unresolved] if unresolved is not None else []
        notices += _lost(track, side)
    bias = np.array([found.mean_px for found in biases])
    return StereoTracks(*tracks, tuple(notices), speckle, levels, bias)


def track_stereo(
    left: ImageSequence,
    right: ImageSequence,
    rig: StereoRig | None,
    settings: TrackSettings,
    progress: Progress | None = None,
) -> StereoTracks:
    """Follow the subsets of `lay_stereo_grid` through both cameras' images.

    `progress` is called with the number of finished frames, first of the left, then of the right camera: 1…2F.
    """
    grid = lay_stereo_grid(left, right, rig, settings)
    left_tracks = track_sequence(left, grid.left_px, settings, progress)
    after = None if progress is None else lambda done: progress(len(left) + done)
    right_tracks = track_sequence(right, grid.right_px, settings, after)
    return stereo_tracks((left.read(0), right.read(0)), grid, (left_tracks, right_tracks), settings)


def _follow_here(
    sequence: ImageSequence, first: Image, reference: Reference, settings: TrackSettings, frames: range, _: str
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


def _follow_on_device(
    sequence: ImageSequence, first: Image, reference: Reference, settings: TrackSettings, frames: range, device: str
) -> Iterator[FollowedFrame]:
    """Later frames, in batches on a device."""
    from photogram.subsets.icgn_stream import follow_frames

    images = (sequence.read(number) for number in frames)
    for image, found in follow_frames(reference, first, images, settings, device):
        yield FollowedFrame(image, None, found)


def _away_from_border(shape: tuple[int, ...]) -> BoolArray:
    """Pixels that can move by a few pixels without leaving the image."""
    inside = np.zeros(shape, dtype=np.bool_)
    inside[BORDER_PX:-BORDER_PX, BORDER_PX:-BORDER_PX] = True
    return inside


def _on_epipolar_lines(rig: StereoRig, left_px: FloatArray, right_px: FloatArray, notices: list[Notice]) -> BoolArray:
    """Which matches lie within 2 px of the epipolar lines; a calibration that misses all of them is noted."""
    essential = skew(rig.right_from_left.translation_m) @ rig.right_from_left.rotation
    rays = [_undistorted(camera, points) for camera, points in ((rig.left, left_px), (rig.right, right_px))]
    focal = float(np.mean(np.diag(rig.right.matrix)[:2]))
    distance = focal * epipolar_distance(essential, rays[0], rays[1])
    off = _middle(distance)
    if abs(off) > 1.0:
        text = (
            f"matched points lie {off:.1f} px off their epipolar lines on average: the calibration does not belong "
            "to these images, or a camera has moved since"
        )
        notices.append(Notice("warning", text, "stereo calibration"))
    return agreeing(distance, EPIPOLAR_TOLERANCE_PX)


def _undistorted(camera: Camera, points_px: FloatArray) -> FloatArray:
    """Normalised coordinates, NaN where the point is NaN."""
    rays = np.full_like(points_px, np.nan)
    known = np.isfinite(points_px).all(axis=1)
    if known.any():
        rays[known] = camera.undistort(points_px[known])
    return rays


def _lost(tracks: Tracks, side: str) -> list[Notice]:
    """A warning when many subsets were lost on the way."""
    share = float(np.mean(tracks.status != TrackStatus.OK))
    if share <= LARGEST_LOST_SHARE:
        return []
    reasons, counts = np.unique(tracks.status[tracks.status != TrackStatus.OK], return_counts=True)
    why = TrackStatus(int(reasons[np.argmax(counts)])).name.lower().replace("_", " ")
    return [
        Notice(
            "warning", f"{100 * share:.0f} % of the subset positions are missing, most often: {why}", f"{side} camera"
        )
    ]


def _middle(values: FloatArray) -> float:
    """Median of the finite values."""
    finite = values[np.isfinite(values)]
    return float(np.median(finite)) if len(finite) else float("nan")
