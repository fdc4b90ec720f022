"""Subsets followed from the left to the right camera and through time."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from enum import IntEnum

import numpy as np
from numpy.typing import NDArray

from photogram._checks import FloatArray, check_shape
from photogram.camera import StereoRig
from photogram.images import ImageSequence
from photogram.notice import Notice

Progress = Callable[[int], None]


class TrackStatus(IntEnum):
    """What became of one subset in one frame; every status but `OK` comes with NaN positions."""

    OK = 0
    NOT_CONVERGED = 1
    LOW_CORRELATION = 2
    LEFT_IMAGE = 3
    FLAT = 4
    SATURATED = 5
    NO_START = 6


@dataclass(frozen=True)
class TrackSettings:
    """How subsets are compared: size (2·radius+1)², spline degree, convergence in px, least correlation."""

    radius_px: int = 10
    step_px: int | None = None
    degree: int = 5
    max_iterations: int = 30
    convergence_px: float = 1e-4
    min_zncc: float = 0.6


@dataclass(frozen=True)
class Tracks:
    """Subset positions: position_px (F,N,2), covariance_px2 (F,N,2,2), zncc (F,N), status (F,N) of `TrackStatus`."""

    position_px: FloatArray
    covariance_px2: FloatArray
    zncc: FloatArray
    status: NDArray[np.int8]

    def __post_init__(self) -> None:
        check_shape("position_px", self.position_px, (None, None, 2))
        frames, points, _ = self.position_px.shape
        check_shape("covariance_px2", self.covariance_px2, (frames, points, 2, 2))
        check_shape("zncc", self.zncc, (frames, points))
        check_shape("status", self.status, (frames, points))


@dataclass(frozen=True)
class StereoTracks:
    """One body seen by two cameras: the same N subsets in `left` and `right`, and what the images are like.

    `speckle_px` (2,) is the speckle size, `noise_grey` (2,) the image noise of the left and right camera.
    """

    left: Tracks
    right: Tracks
    notices: tuple[Notice, ...]
    speckle_px: FloatArray
    noise_grey: FloatArray


def match_stereo(
    left_image: NDArray[np.generic],
    right_image: NDArray[np.generic],
    points_px: FloatArray,
    settings: TrackSettings,
    fundamental: FloatArray | None = None,
) -> Tracks:
    """Positions in the right image (F = 1) of the subsets centred at points_px (N,2) in the left image."""
    raise NotImplementedError


def track_sequence(
    sequence: ImageSequence,
    points_px: FloatArray,
    settings: TrackSettings,
    progress: Progress | None = None,
) -> Tracks:
    """Positions in every frame of the subsets centred at points_px (N,2) in frame 0."""
    raise NotImplementedError


def track_stereo(
    left: ImageSequence,
    right: ImageSequence,
    rig: StereoRig | None,
    settings: TrackSettings,
    progress: Progress | None = None,
) -> StereoTracks:
    """Lay a grid over the body in the first left image, match it to the right image, follow both through time."""
    raise NotImplementedError
