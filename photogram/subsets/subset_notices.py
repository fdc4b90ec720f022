"""Notices of matching and tracking subsets."""

from shakercal._common.notices import DeclaredNotice

UNUSED_SUBSETS = DeclaredNotice(
    "SC-210",
    "note",
    "{unused} of {subsets} subsets are not used: {reasons}.",
    effect="The remaining subsets determine the motion.",
    link="tracking.md",
)
UNRESOLVED_TEXTURE = DeclaredNotice(
    "SC-211",
    "warning",
    "The texture is finer than the camera resolves: speckle of {speckle_px:.1f} px, {share_percent:.1f} % of its power "
    "beyond 0.4 cycles per pixel.",
    effect="Positions may err by {subset_bias_px:.2g} px per subset and {mean_bias_px:.2g} px in the mean of all, "
    "periodic in the pixel. The error appears as false harmonics of the motion.",
    remedy="Use speckle of 3 to 5 px with soft rims, or defocus slightly.",
    link="tracking.md#interpolation",
)
LOST_SUBSETS = DeclaredNotice(
    "SC-212",
    "warning",
    "{lost_percent:.0f} % of the subset positions are missing, mainly with the status {status}.",
    effect="The remaining positions determine the motion of the points.",
    remedy="Use more frames per second, and even light without reflections.",
    link="tracking.md",
)
OFF_EPIPOLAR_LINES = DeclaredNotice(
    "SC-213",
    "warning",
    "Matched points are {offset_px:.1f} px off their epipolar lines on average.",
    effect="The calibration does not belong to these images, or a camera has moved since.",
    remedy="Calibrate the pair again, or use the calibration of this recording.",
    link="tracking.md#whether-the-cameras-still-are-what-was-calibrated",
)
