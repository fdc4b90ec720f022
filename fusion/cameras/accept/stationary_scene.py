"""Stationary scene: noise floor of the six components and of each subset, drift, and vibrations."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np

from fusion.cameras.accept.acceptance_manifest import StationaryBlock, Tolerances
from fusion.cameras.accept.acceptance_rows import AcceptanceRow
from fusion.cameras.accept.tracked_test import TrackedTest
from photogram.camera import StereoRig
from photogram.measure.epipolar import check_epipolar
from photogram.measure.epipolar_notices import CAMERA_DRIFTS, CAMERA_MOVED
from shaker.labels import AXES
from shaker.lines.detection import Survey, survey_lines
from shakercal._common.arrays import Arrays, FloatArray
from shakercal._common.notices import Notice

NAME = "stationary scene"
COMPONENTS = (*AXES, *(f"r{axis}" for axis in AXES))
"""Translations along, and rotations about, the axes of the left camera."""
FALSE_ALARM = 1e-3
"""Probability that noise alone shows a vibration."""


@dataclass(frozen=True, eq=False, repr=False)
class StationaryTest(
    Arrays,
    shapes="time F; pose F 6; predicted 6; noise 6; drift 6; u_drift 6; subset_noise N 3; subset_predicted N 3;"
    "subset_px N 2",
):
    """Motion of a body at rest over F frames.

    Attributes
    ----------
    time : (F,), s, or frames without a frame rate.
    pose : (F, 6) about the centre of the body, m and rad, without its mean.
    predicted : (6,), standard deviation by the Cramér-Rao bound of these images.
    noise : (6,), measured standard deviation about drift and vibrations.
    drift, u_drift : (6,), change over the record with standard uncertainty.
    freedom : degrees of freedom of the noise.
    lines : vibrations.
    subset_noise, subset_predicted : (N, 3), standard deviation of single points, m.
    subset_px : (N, 2), their places in the left image.
    lever_m : distance of the outermost point from the centre.
    rows : the results.
    """

    time: FloatArray
    pose: FloatArray
    predicted: FloatArray
    noise: FloatArray
    drift: FloatArray
    u_drift: FloatArray
    freedom: int
    lines: Survey
    subset_noise: FloatArray
    subset_predicted: FloatArray
    subset_px: FloatArray
    lever_m: float
    has_rate: bool
    pixel_m: float
    rows: tuple[AcceptanceRow, ...]
    notices: tuple[Notice, ...]

    @property
    def arms(self) -> FloatArray:
        """Largest displacement of a point per unit of each component (6,)."""
        return np.array([1.0, 1.0, 1.0, self.lever_m, self.lever_m, self.lever_m])

    @property
    def vibrations(self) -> tuple[FloatArray, FloatArray]:
        """Largest amplitudes of a point (L, 6) with standard uncertainty.

        By each component of each line.
        """
        return (
            np.nan_to_num(self.lines.amplitude) * self.arms,
            np.nan_to_num(self.lines.u_amplitude) * self.arms,
        )


def measure_stationary(
    rig: StereoRig, block: StationaryBlock, tracked: TrackedTest, tolerances: Tolerances
) -> StationaryTest:
    """Return the noise floor, drift and vibrations of a scene at rest, with the rows."""
    body = tracked.body
    assert body is not None
    motion = body.motion.about(tracked.centre_m)
    pose = motion.pose
    fitted = np.isfinite(pose).all(axis=1)
    frames = np.flatnonzero(fitted)
    number = np.arange(len(pose))
    even = np.stack([np.interp(number, frames, column[fitted]) for column in pose.T], axis=1)
    rate = block.frame_rate or 1.0
    time = number / rate
    line = np.column_stack([np.ones(len(time)), time - time.mean()])
    without = even - line @ (np.linalg.pinv(line) @ even)
    lines = survey_lines(without, rate, false_alarm=FALSE_ALARM)
    phases = 2.0 * np.pi * np.outer(time, lines.frequency_hz)
    design = np.concatenate([line, np.cos(phases), np.sin(phases)], axis=1)
    parts = np.linalg.pinv(design[fitted]) @ even[fitted]
    left_over = even[fitted] - design[fitted] @ parts
    freedom = max(len(left_over) - design.shape[1], 1)
    noise = np.sqrt(np.sum(left_over**2, axis=0) / freedom)
    duration = float(np.ptp(time))
    spread = float(np.sqrt(np.sum((time[fitted] - time[fitted].mean()) ** 2)))
    offset = tracked.points.position_m[0] - tracked.centre_m
    predicted = np.sqrt(np.mean(np.diagonal(motion.covariance[fitted][1:], axis1=1, axis2=2), axis=0))
    later = tracked.points.position_m[1:]
    made = StationaryTest(
        time=time,
        pose=even - even.mean(axis=0),
        predicted=predicted,
        noise=noise,
        drift=parts[1] * duration,
        u_drift=noise * _colour(left_over) * duration / spread,
        freedom=freedom,
        lines=lines,
        subset_noise=np.std(later, axis=0, ddof=1),
        subset_predicted=np.sqrt(np.mean(np.diagonal(tracked.points.covariance_m2[1:], axis1=2, axis2=3), axis=0)),
        subset_px=tracked.left_px[0],
        lever_m=float(np.max(np.linalg.norm(offset, axis=1))),
        has_rate=block.frame_rate is not None,
        pixel_m=tracked.pixel_m,
        rows=(),
        notices=check_epipolar(body.tracked, rig, body.subset_frames).notices,
    )
    return replace(made, rows=tuple(_rows(made, tolerances)))


def _colour(left_over: FloatArray) -> FloatArray:
    """Return the factor (6,) by which neighbouring frames' correlation increases the uncertainty of a mean."""
    centred = left_over - left_over.mean(axis=0)
    correlation = np.sum(centred[1:] * centred[:-1], axis=0) / np.sum(centred**2, axis=0)
    correlation = np.clip(correlation, 0.0, 0.95)
    return np.asarray(np.sqrt((1.0 + correlation) / (1.0 - correlation)))


def _rows(test: StationaryTest, tolerances: Tolerances) -> Iterator[AcceptanceRow]:
    """Yield the worst component of noise, drift and vibration."""
    ratio = test.noise / test.predicted
    worst = int(np.argmax(ratio))
    u = float(ratio[worst] / np.sqrt(2.0 * test.freedom))
    label = f"noise over its prediction, component {COMPONENTS[worst]}"
    cause = "light that flickers, moving air, or vibrations faster than the frames"
    remedy = "Use steady light and a shorter path through still air; record faster to see the vibrations."
    value, dof = float(ratio[worst]), test.freedom
    yield AcceptanceRow(NAME, "noise_ratio", label, value, u, tolerances.noise_ratio, "1", cause, remedy, dof)
    size = np.abs(test.drift) * test.arms
    worst = int(np.argmax(size))
    codes = {notice.code for notice in test.notices}
    cause, remedy = "the body or the stand of both cameras moves slowly", "Wait for the warm-up, and fix the body."
    if codes & {CAMERA_DRIFTS.code, CAMERA_MOVED.code}:
        cause = "the cameras move against each other (epipolar residuals change)"
        remedy = "Let the cameras warm up for an hour, fix them and their cables, then calibrate."
    label, limit = f"drift over the record, component {COMPONENTS[worst]}", tolerances.drift_px * test.pixel_m
    u = float(test.u_drift[worst] * test.arms[worst])
    yield AcceptanceRow(NAME, "drift", label, float(size[worst]), u, limit, "m", cause, remedy, dof)
    label, size_m, u = "strongest vibration", 0.0, float(np.max(test.noise * test.arms)) * np.sqrt(2.0 / test.freedom)
    cause = remedy = ""
    if len(test.lines.frequency_hz):
        amplitude, u_amplitude = test.vibrations
        row, column = np.unravel_index(int(np.argmax(amplitude)), amplitude.shape)
        size_m = float(amplitude[row, column])
        u = float(u_amplitude[row, column])
        where = f"{test.lines.frequency_hz[row]:.4g} " + ("Hz" if test.has_rate else "periods per frame")
        label = f"strongest vibration, {where}, component {COMPONENTS[column]}"
        cause = f"a vibration at {where} of body, stand or floor, or an alias of a faster one"
        remedy = "Find the source (fan, pump, floor), stiffen the stand, or isolate the table."
    limit = tolerances.vibration_px * test.pixel_m
    yield AcceptanceRow(NAME, "vibration", label, size_m, u, limit, "m", cause, remedy, dof)
