"""Notices and errors of `shakercal cameras`, `align` and the commands that convert calibrations."""

from shakercal._common.notices import DeclaredNotice

ELLIPTICAL_MOTION = DeclaredNotice(
    "SC-280",
    "warning",
    "{recording}: the body moves on an ellipse {width_mrad:.2g} mrad wide, but `direction_uncertainty` is "
    "{stated_mrad:.2g} mrad.",
    remedy="Check the uncertainty of the direction.",
    link="cameras.md#motion",
)
UNSTEADY_AXIS = DeclaredNotice(
    "SC-281",
    "warning",
    "{recording}: the frames deviate from a fixed axis by {ratio:.2g} times their noise.",
    effect="The uncertainty of the axis is enlarged by this factor.",
    remedy="Check that the body turns about a fixed axis.",
    link="cameras.md#motion",
)
SYMMETRIC_TARGET = DeclaredNotice(
    "SC-282",
    "warning",
    "The target is symmetric, and no other evidence determines its orientation.",
    effect="Its first axis is assumed to point to the right in the left image. If it does not, the pose is rotated.",
    remedy="State `[pose]`, or use a target with markers.",
    link="cameras.md#points-faces-target-views",
)
NO_POSE = DeclaredNotice(
    "SC-283",
    "error",
    "The evidence does not determine the pose: {reason}.",
    remedy="Add evidence, or state a prior pose in `[pose]`.",
    link="cameras.md#the-camera-frame-in-the-sensor-frame",
)
FUNDAMENTAL_UNRESOLVED = DeclaredNotice(
    "SC-284",
    "error",
    "The camera rate of stereo pair {pair} resolves no fundamental of {recording}.",
    remedy="Use a recording with another camera rate.",
    link="cameras.md#motion",
)
NO_AXIS = DeclaredNotice(
    "SC-285",
    "error",
    "The recording does not determine a rotation axis: {reason}.",
    remedy="Use a recording in which the body turns by a larger angle, and check its images.",
    link="cameras.md#motion",
)
SCALE_UNSTATED = DeclaredNotice(
    "SC-286",
    "error",
    "expected {expected}, found {found}",
    effect="A calibration without covariance does not state the uncertainty of its lengths.",
    remedy="State `scale_uncertainty`.",
    link="cameras.md#top-level",
)
SCALE_OF_SINGLE_CAMERA = DeclaredNotice(
    "SC-287",
    "error",
    "expected {expected}, found {found}",
    effect="A single camera has no scale.",
    remedy="Remove `scale_uncertainty`.",
    link="cameras.md#top-level",
)
NEEDS_STEREO_PAIR = DeclaredNotice(
    "SC-288",
    "error",
    "expected {expected}, found {found}",
    effect="This evidence requires two cameras, but the calibration is that of a single one.",
    remedy="Use `[[point]]` or `[[target_view]]`, or the calibration of a pair.",
    link="cameras.md#points-faces-target-views",
)
RIGHT_PIXEL_MISSING = DeclaredNotice(
    "SC-289",
    "error",
    "expected {expected}, found {found}",
    remedy="State the point's pixel in the right camera.",
    link="cameras.md#point",
)
UNLIKELY_SPACING = DeclaredNotice(
    "SC-290",
    "error",
    "expected {expected}, found {found}",
    remedy="State the spacing in m.",
    link="cameras.md#target",
)
RAYS_DO_NOT_MEET = DeclaredNotice(
    "SC-291",
    "error",
    "expected {expected}, found {found}",
    effect="The pixels of both cameras do not belong to one point.",
    remedy="Check the pixels, and whether left and right are exchanged.",
    link="cameras.md#points-faces-target-views",
)
PIXEL_TABLE = DeclaredNotice(
    "SC-292",
    "error",
    "expected {expected}, found {found}",
    remedy="Correct the table of pixels.",
    link="cameras.md#face",
)
IMAGE_SIZE_MISMATCH = DeclaredNotice(
    "SC-293",
    "error",
    "expected {expected}, found {found}",
    effect="The calibration is that of images of another size.",
    link="cameras.md#target_view",
)
UNSUITABLE_RECORDING = DeclaredNotice(
    "SC-294",
    "error",
    "expected {expected}, found {found}",
    effect="The recording cannot be used as evidence.",
    remedy="Correct the key, or name another recording.",
    link="cameras.md#motion",
)
TOO_FEW_IMAGES = DeclaredNotice(
    "SC-295",
    "error",
    "expected {expected}, found {found}",
    effect="The remaining images do not determine a calibration.",
    remedy="Check the options of the target, and add images.",
    link="cameras.md#how-a-good-session-looks",
)
IMAGE_LISTS = DeclaredNotice(
    "SC-296",
    "error",
    "expected {expected}, found {found}",
    remedy="Name the left images first, then the right ones in the same order.",
    link="cameras.md#from-images-of-a-target-to-a-stereo-pair",
)
OUTPUT_SUFFIX = DeclaredNotice(
    "SC-297",
    "error",
    "expected {expected}, found {found}",
    remedy="Choose a name with this suffix by `-o`.",
    link="cameras.md#from-images-of-a-target-to-a-stereo-pair",
)
