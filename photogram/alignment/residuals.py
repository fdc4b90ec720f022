"""What a piece of evidence says at a trial pose, in the form that the least squares take."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from photogram._checks import BoolArray, FloatArray, check_shape
from photogram.rigid import skew

CALIBRATION = "calibration"
"""Name of the effects of the pair's own calibration."""


@dataclass(frozen=True, eq=False)
class Residuals:
    """B groups of b residuals, predicted − known, at a trial pose, linear about it.

    `residual` (B, b); `jacobian` (B, b, 6): change for a small displacement of the pose multiplied from the left,
    shift of the sensor origin (m) and rotation about it (rad); `covariance` (B, b, b), groups independent of each
    other; `common`: by the name of what is common, changes (P, B, b) for one standard uncertainty of each of its P
    unknowns; `piece` (B,): the name under which each group is tested; `determines` (6,): the components that this
    evidence may determine: what it says about others counts only beside evidence that determines them.
    """

    residual: FloatArray
    jacobian: FloatArray
    covariance: FloatArray
    common: Mapping[str, FloatArray]
    piece: tuple[str, ...]
    determines: BoolArray

    def __post_init__(self) -> None:
        """Refuse shapes that do not belong together."""
        check_shape("residual", self.residual, (len(self.piece), None))
        check_shape("jacobian", self.jacobian, (*self.residual.shape, 6))
        check_shape("covariance", self.covariance, (*self.residual.shape, self.residual.shape[1]))
        check_shape("determines", self.determines, (6,))
        for name, changes in self.common.items():
            check_shape(f"common {name}", changes, (None, *self.residual.shape))


def displacement_jacobian(points_m: FloatArray) -> FloatArray:
    """Return [I, −[y]×] (..., 3, 6): how points (..., 3) answer a small shift and rotation about the origin."""
    points = np.asarray(points_m, dtype=np.float64)
    return np.concatenate([np.broadcast_to(np.eye(3), (*points.shape, 3)), -skew(points)], axis=-1)


def across(direction: FloatArray) -> FloatArray:
    """Return two unit vectors (2, 3) perpendicular to a direction (3,) and to each other."""
    return np.asarray(np.linalg.svd(np.asarray(direction, dtype=np.float64)[None])[2][1:])
