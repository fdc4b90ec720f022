"""The pose of the left camera in the sensor frame, from points, faces, target poses, directions and axes of motion."""

from photogram.alignment.evidence import (
    Evidence,
    KnownAxis,
    KnownDirection,
    KnownFace,
    KnownPoints,
    KnownPoses,
    StatedFrame,
)
from photogram.alignment.seen import by_parameters, calibration_steps, seen_points, seen_target
from photogram.alignment.solve import Alignment, OpenPose, Piece, align
from photogram.alignment.turning import Axis, fit_axis, linear_motion

__all__ = [
    "Alignment",
    "Axis",
    "Evidence",
    "KnownAxis",
    "KnownDirection",
    "KnownFace",
    "KnownPoints",
    "KnownPoses",
    "OpenPose",
    "Piece",
    "StatedFrame",
    "align",
    "by_parameters",
    "calibration_steps",
    "fit_axis",
    "linear_motion",
    "seen_points",
    "seen_target",
]
