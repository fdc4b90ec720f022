"""How the views of a session are spread: over the pictures, and in the angles of the target."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from photogram._checks import FloatArray, IntArray
from photogram.calibrate.result import CalibratedPicture
from photogram.rigid import RigidTransform

COVERAGE_CELLS = (8, 6)  # columns and rows of the cells by which coverage is told
_NO_TURN_RAD = np.radians(2.0)


def covered_share(pictures: Sequence[CalibratedPicture], size_px: IntArray) -> float:
    """Return the share of the picture's cells, 8 x 6, in which some point of some picture lies."""
    points = np.concatenate([picture.position_px[picture.used] for picture in pictures])
    cells = np.floor((points + 0.5) / size_px * COVERAGE_CELLS).astype(np.int64)
    inside = np.clip(cells, 0, np.array(COVERAGE_CELLS) - 1)
    return len(np.unique(inside, axis=0)) / (COVERAGE_CELLS[0] * COVERAGE_CELLS[1])


def spread_of_turns(poses: Sequence[RigidTransform]) -> tuple[FloatArray, FloatArray]:
    """Return how far the target's normal spreads (2,), in rad, and along which directions (columns) of the picture."""
    normal = np.array([pose.rotation[:, 2] * np.sign(pose.rotation[2, 2]) for pose in poses])
    variance, axes = np.linalg.eigh(np.cov(normal[:, :2].T, bias=True))
    return np.sqrt(np.maximum(variance, 0.0)), axes


def refuse_similar_views(poses: Sequence[RigidTransform]) -> None:
    """Raise `ValueError` when all views show the target under nearly one angle, which leaves the cameras open."""
    spread, _ = spread_of_turns(poses)
    if spread.max() < _NO_TURN_RAD:
        raise ValueError(
            f"all {len(poses)} views show the target under nearly one angle ({np.degrees(spread.max()):.1f}° rms), "
            "which does not determine the cameras; add views turned by 20° and more about both axes of the picture"
        )
