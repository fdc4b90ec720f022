"""Drawings of the acceptance test of a stereo rig: the residual fields of single faults."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from style import GREY, new_figure

from photogram.camera import Camera, StereoRig, epipolar_residual, triangulate
from photogram.geometry import RigidTransform, rotation_from_vector

SIZE_PX, FOCAL_PX, DISTANCE_M, HALF_ANGLE_RAD = np.array([2400, 2000]), 12000.0, 0.5, np.radians(12.5)
TRAVEL_M = 0.01
K1 = -0.1
REACH = 0.2, 0.2, 0.8
"""Ends of the colour scales, equal for all faults: px, %, µm for a travel of 10 mm."""


def _rig() -> StereoRig:
    """Return two equal cameras at 25°, 0.5 m from the plate."""
    numbers = [FOCAL_PX, FOCAL_PX, *(0.5 * (SIZE_PX - 1)), K1, 0.0, 0.0, 0.0, 0.0]
    camera = Camera.from_parameters(np.array(numbers), SIZE_PX)
    turn = rotation_from_vector(np.array([0.0, 2.0 * HALF_ANGLE_RAD, 0.0]))
    centre = np.array([0.0, 0.0, DISTANCE_M])
    return StereoRig(camera, camera, RigidTransform(turn, centre - turn @ centre))


def _turned(rig: StereoRig, vector: tuple[float, float, float]) -> StereoRig:
    turn = RigidTransform(rotation_from_vector(np.array(vector)), np.zeros(3))
    return replace(rig, right_from_left=turn @ rig.right_from_left)


def _changed(camera: Camera, factor: float = 1.0, shift_px: float = 0.0, distortion: float = 1.0) -> Camera:
    matrix = camera.matrix.copy()
    matrix[:2, :2] *= factor
    matrix[0, 2] += shift_px
    return replace(camera, matrix=matrix, distortion=distortion * camera.distortion)


def _faults(rig: StereoRig) -> dict[str, StereoRig]:
    """Return calibrations with one fault each."""
    right = rig.right_from_left
    longer = RigidTransform(right.rotation, 1.002 * right.translation_m)
    flat = {"left": _changed(rig.left, distortion=0.0), "right": _changed(rig.right, distortion=0.0)}
    return {
        "camera turned\nabout its axis,\n0.2 mrad": _turned(rig, (0.0, 0.0, 2e-4)),
        "camera turned\nsideways,\n0.2 mrad": _turned(rig, (0.0, 2e-4, 0.0)),
        "focal length,\none camera,\n0.1 %": replace(rig, left=_changed(rig.left, factor=1.001)),
        "principal point,\none camera,\n5 px": replace(rig, right=_changed(rig.right, shift_px=5.0)),
        "distortion\nignored": replace(rig, **flat),
        "spacing of the\ntarget, 0.2 %": replace(rig, right_from_left=longer),
    }


def acceptance_faults() -> Figure:
    """Draw epipolar residuals, scale and bending over the left image for single faults of a calibration."""
    rig = _rig()
    x, y = np.meshgrid(np.linspace(-0.035, 0.035, 29), np.linspace(-0.03, 0.03, 25))
    turn = rotation_from_vector(np.array([0.0, -HALF_ANGLE_RAD, 0.0]))
    plate = np.stack([x.ravel(), y.ravel(), np.zeros(x.size)], axis=1) @ turn.T + [0.0, 0.0, DISTANCE_M]
    along, normal = turn[:, 0], turn[:, 2]
    ends = [rig.project(plate + share * TRAVEL_M * along) for share in (-0.5, 0.5)]
    left, right = (np.stack(side) for side in zip(*ends, strict=True))
    figure, panels = new_figure(4.4, 3, 6)
    names = ("epipolar\nresidual / px", "error of\nthe scale / %", "apparent motion\nout of plane / µm")
    images = list[Any]()
    for column, (title, wrong) in zip(panels.T, _faults(rig).items(), strict=True):
        residual, *_ = epipolar_residual(wrong, left[0], right[0])
        first, last = triangulate(wrong, left, right).position_m
        moved = last - first
        scale = 100.0 * (moved @ along / TRAVEL_M - 1.0)
        out = 1e6 * moved @ normal
        fields = (residual, scale, out - out.mean())
        for panel, values, reach in zip(column, fields, REACH, strict=True):
            shown = panel.imshow(values.reshape(x.shape), cmap="RdBu_r", vmin=-reach, vmax=reach, aspect="auto")
            low, high = (f"{value:+.2g}" if abs(value) > 1e-4 else "0" for value in (values.min(), values.max()))
            panel.set_xlabel(f"{low} to {high}" if low != high else low, fontsize=7.5, color=GREY, labelpad=2)
            panel.set_xticks([])
            panel.set_yticks([])
            images.append(shown)
        column[0].set_title(title, fontsize=7.5)
    for panel, name in zip(panels[:, 0], names, strict=True):
        panel.set_ylabel(name, fontsize=8.0)
    for row, image in zip(panels, images, strict=False):
        bar = figure.colorbar(image, ax=row, extend="both", aspect=12, pad=0.01)
        bar.ax.tick_params(labelsize=7.5)
    return figure


DRAWINGS = (acceptance_faults,)
