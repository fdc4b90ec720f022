"""What a calibration leaves: the rig with its covariance, every residual, and what was dropped."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from photogram._checks import BoolArray, FloatArray, IntArray
from photogram.camera import StereoRig
from photogram.notice import Notice
from photogram.rigid import RigidTransform
from photogram.target.view import Target

Determined = Literal["determined", "indistinct", "open"]


@dataclass(frozen=True)
class Parameter:
    """One parameter of the rig: value, standard uncertainty (k = 1) and unit ("px", "1", "rad", "m").

    `state`: "determined"; "indistinct", well known but not distinguishable from zero (distortion only); "open", known
    no better than before the session: the views say nothing about it and its value is the assumption's.
    """

    name: str
    value: float
    u: float
    unit: str
    state: Determined


@dataclass(frozen=True, eq=False)
class CalibratedPicture:
    """One picture in the fit: points (N,), of which `used` went into it.

    `index` (N, 2) lattice indices, `position_px` (N, 2) as found, `residual_px` (N, 2) found − modelled,
    `normalised` (N,) length of the residual over its standard uncertainty.
    """

    name: str
    index: IntArray
    position_px: FloatArray
    residual_px: FloatArray
    normalised: FloatArray
    used: BoolArray

    @property
    def rms_px(self) -> float:
        """Rms length of the used points' residuals (OpenCV's definition of the reprojection error)."""
        squares = (self.residual_px[self.used] ** 2).sum(axis=1)
        return float(squares.mean() ** 0.5) if self.used.any() else float("nan")


@dataclass(frozen=True, eq=False)
class CalibratedView:
    """One position of the target: `left_from_target` with covariance (6, 6), and the picture of either camera.

    The pose's covariance holds translation (m) and left-multiplied rotation (rad), in the order x y z rx ry rz.
    """

    left_from_target: RigidTransform
    covariance: FloatArray
    left: CalibratedPicture | None
    right: CalibratedPicture | None


@dataclass(frozen=True)
class Dropped:
    """A picture, or points of one, that did not go into the fit, and why; `points` 0 stands for the whole picture."""

    name: str
    points: int
    reason: str


@dataclass(frozen=True, eq=False)
class Calibration:
    """A calibrated stereo pair and how it came about.

    `rms_px`: rms length of all residuals, OpenCV's definition of the reprojection error, `rms_sides_px` (left, right)
    apart. `added_px` (left, right): noise per coordinate that comes on top of the points' own; `sigma_factor`:
    √(reduced χ²) of `dof` degrees of freedom with both, a factor of the covariance.
    `shape_m` (P, 3): estimated positions of the target's points (`shape_index` (P, 2)), the flat lattice where it was
    held flat. `scale_u`: relative standard uncertainty of the target's spacing, contained in the rig's covariance.
    `covered`: (left, right), share of each picture's area within the points' cells.
    """

    rig: StereoRig
    target: Target
    views: tuple[CalibratedView, ...]
    parameters: tuple[Parameter, ...]
    rms_px: float
    rms_sides_px: tuple[float, float]
    added_px: tuple[float, float]
    sigma_factor: float
    dof: float
    shape_index: IntArray
    shape_m: FloatArray
    scale_u: float
    covered: tuple[float, float]
    dropped: tuple[Dropped, ...]
    notices: tuple[Notice, ...]
