"""Notices of the check whether a stereo pair agrees with its calibration."""

from shakercal._common.notices import DeclaredNotice

PAIR_CHANGED = DeclaredNotice(
    "SC-230",
    "warning",
    "The epipolar residual is {residual_px:.3f} px, but {source} explains {explained_px:.3f} px.",
    effect="The cameras no longer agree with their calibration; positions may be wrong.",
    remedy="Calibrate again.",
    link="tracking.md#check-of-the-calibration-in-every-run",
)
CAMERA_ROTATED = DeclaredNotice(
    "SC-231",
    "warning",
    "The epipolar residual is {residual_px:.3f} px, but {source} explains {explained_px:.3f} px: the right camera "
    "seems rotated by {about_x_mrad:.2f} mrad about its x axis and {about_z_mrad:.2f} mrad about its optical axis.",
    effect="The cameras no longer agree with their calibration. The rotation displaces the points by at least "
    "{displaced_mm:.3f} mm.",
    remedy="Calibrate again.",
    link="tracking.md#check-of-the-calibration-in-every-run",
)
CAMERA_MOVED = DeclaredNotice(
    "SC-232",
    "warning",
    "A camera moved before frame {frame} (counted from 0): the epipolar residual changes by {change_px:.3f} px.",
    effect="Positions before and after that frame do not agree.",
    remedy="Fix the cameras and record again, or evaluate both parts separately.",
    link="tracking.md#check-of-the-calibration-in-every-run",
)
CAMERA_DRIFTS = DeclaredNotice(
    "SC-233",
    "warning",
    "A camera drifts: the epipolar residual changes by {change_px:.3f} px from the first to the last frame.",
    effect="Positions change slowly without a motion of the body.",
    remedy="Let the cameras warm up, and fix them.",
    link="tracking.md#check-of-the-calibration-in-every-run",
)
