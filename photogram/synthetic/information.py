"""The Cramér-Rao bound of the motion in a set of images: how well any program could place the body."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from photogram._checks import FloatArray
from photogram.synthetic.noise import ImageSensor
from photogram.synthetic.render import render
from photogram.synthetic.scene import Face, View

_STEP_M = 2e-6  # translation and, at 0.1 m from the origin, rotation of a few hundredths of a pixel
_STEP_RAD = 2e-5


def motion_bound(
    views: Sequence[View], face: Face, sensor: ImageSensor, pose: FloatArray | None = None, nodes: int = 2
) -> FloatArray:
    """Return the smallest covariance (6, 6) of x y z rx ry rz (m, rad, at the world origin) of one frame.

    (Σ w·JᵀJ)⁻¹ over all pixels of all views: J = ∂grey/∂pose by central differences of the rendered images,
    w = 1/noise variance. The appearance of the body is taken as known: gain, offset and a reference's noise are
    not among the unknowns, so a program that estimates those from the images lies somewhat above.
    """
    start = np.zeros(6) if pose is None else np.asarray(pose, dtype=np.float64)
    information = np.zeros((6, 6))
    for view in views:
        grey = render(view, face, start[None], np.ones(1), nodes) * sensor.full_scale
        slope = np.stack([_slope(view, face, start, i, nodes) for i in range(6)], axis=-1) * sensor.full_scale
        information += np.einsum("hwi,hwj,hw->ij", slope, slope, 1 / sensor.variance(grey), optimize=True)
    return np.asarray(np.linalg.inv(information))


def _slope(view: View, face: Face, pose: FloatArray, component: int, nodes: int) -> FloatArray:
    """Return the image's derivative (H, W) by one component of the pose."""
    step = np.zeros(6)
    step[component] = _STEP_M if component < 3 else _STEP_RAD
    ahead = render(view, face, (pose + step)[None], np.ones(1), nodes)
    behind = render(view, face, (pose - step)[None], np.ones(1), nodes)
    return np.asarray((ahead - behind) / (2 * step[component]))
