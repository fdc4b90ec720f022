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
from photogram.camera import Camera, StereoRig
from photogram.geometry import skew
from photogram.images import GreyImage, ImageSequence
from photogram.subsets.icgn import Registration, noise_of_residual, position_covariance, register
from photogram.subsets.reference import PARAMETERS, Reference, TrackStatus, prepare_reference
from photogram.subsets.search import (
    affine_field,
    affine_starts,
    agreeing,
    epipolar_distance,
    match_features,
    neighbour_starts,
    predict_warp,
    template_shifts,
)
from photogram.subsets.texture import (
    AliasingBias,
    aliasing_bias,
    aliasing_notice,
    lay_grid,
    saturated,
    speckle_size,
    subsets_inside,
    textured_area,
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


# Subsets of one image found in another: by prediction, by search, from their neighbours; and the tracks they leave.

NEIGHBOUR_ROUNDS = 8
SEEDS = 12


@dataclass(frozen=True)
class TrackSettings:
    """How subsets are compared.

    radius_px: subsets have (2·radius+1)² pixels; step_px: distance in the grid, by default just without overlap, so
    that their noise is independent; degree: of the spline, 3 or 5; convergence_px: movement below which a subset stands
    still; min_zncc: correlation below which it is lost; reach_px: how far it is looked for when prediction fails,
    before it is looked for in the whole image; shape_order: of the shape function, 0 (translation), 1 (affine) or 2.

    >>> TrackSettings(radius_px=12).grid_step_px
    25
    """

    radius_px: int = 10
    step_px: int | None = None
    degree: int = 5
    max_iterations: int = 30
    convergence_px: float = 1e-4
    min_zncc: float = 0.75
    reach_px: int = 32
    shape_order: int = 1

    def __post_init__(self) -> None:
        if self.shape_order not in PARAMETERS:
            raise ValueError(f"shape_order: expected 0, 1 or 2, found {self.shape_order}")
        if self.radius_px < 3:
            raise ValueError(f"radius_px: expected at least 3, found {self.radius_px}")
        if self.step_px is not None and self.step_px < 1:
            raise ValueError(f"step_px: expected at least 1, found {self.step_px}")

    @property
    def grid_step_px(self) -> int:
        """Distance of neighbouring subsets."""
        return 2 * self.radius_px + 1 if self.step_px is None else self.step_px


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


def find_from(reference: Reference, target: Spline, start: FloatArray, settings: TrackSettings) -> Registration:
    """Registration with the settings' limits."""
    limits = (settings.max_iterations, settings.convergence_px, settings.min_zncc)
    return register(reference, target, start, *limits)


def find_anew(reference: Reference, first: Image, frame: tuple[Image, Spline], settings: TrackSettings) -> Registration:
    """Subsets of the first image in a frame of which nothing is foretold.

    From rest, and from one affine motion through searched seeds, each where it correlates better: a start at rest finds
    some subsets of a body that has moved by a speckle in a wrong place, and a search slides along edges.
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
    found = find_from(reference, frame[1], start, settings)
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
    return find_from(reference, frame[1], starts, settings)


def find_by_search(
    reference: Reference, first: Image, frame: tuple[Image, Spline], start: FloatArray, settings: TrackSettings
) -> Registration:
    """All subsets from one affine motion through a few well-textured seeds, which are searched by correlation."""
    image, target = frame
    usable = np.flatnonzero(reference.status == TrackStatus.OK)
    spread = usable[np.linspace(0, len(usable) - 1, min(len(usable), 4 * SEEDS)).astype(np.int64)]
    seeds = spread[np.argsort(-reference.energy[spread])[:SEEDS]]
    points = reference.centre_px[seeds]
    guess = np.nan_to_num(start[seeds][:, [0, 3]])
    shifts = template_shifts(first, image, points, settings.radius_px, settings.reach_px, guess)
    field = affine_field(points, shifts, reference.centre_px)
    return find_from(reference, target, field, settings)


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
        more = find_from(reference, target, start, settings)
        if not np.any(more.status[lost] == TrackStatus.OK):
            break
        found = merged(found, more)
    return found


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
        found,
        warp=np.where(which[:, None], np.nan, found.warp),
        status=np.where(which, np.int8(status), found.status),
    )


def identity(reference: Reference) -> Registration:
    """The reference found in itself; its noise is filled in from the other frames."""
    count = len(reference.centre_px)
    usable = reference.status == TrackStatus.OK
    ones = np.where(usable, 1.0, np.nan)
    return Registration(
        np.where(usable[:, None], 0.0, np.nan) * np.ones(max(6, PARAMETERS[reference.order])),
        ones,
        ones,
        np.full(count, np.nan),
        reference.status,
        np.zeros(count, np.int64),
    )


def without_saturated(reference: Reference, image: GreyImage, full_scale: int) -> Reference:
    """`reference` without NaN centres and without subsets that are saturated in it."""
    absent = ~np.isfinite(reference.centre_px).all(axis=1)
    full = saturated(image, full_scale, reference.centre_px, reference.radius_px)
    status = np.where(full, np.int8(TrackStatus.SATURATED), reference.status)
    return replace(reference, status=np.where(absent, np.int8(TrackStatus.NO_START), status))


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
