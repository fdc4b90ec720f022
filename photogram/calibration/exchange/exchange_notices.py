"""Notices of the import and export of other programs' calibrations."""

from shakercal._common.notices import DeclaredNotice

EVEN_POWERS_REQUESTED = DeclaredNotice(
    "SC-264",
    "note",
    "k1, k2 and k3 are used as coefficients of r², r⁴ and r⁶, as requested by `--even-radial`.",
    effect="DICe uses them as coefficients of r, r² and r³.",
    link="cameras.md#dices-text",
)
LINEAR_POWERS = DeclaredNotice(
    "SC-265",
    "warning",
    "k1, k2 and k3 are used as coefficients of r, r² and r³ ({model}), as DICe does.",
    effect="The focal lengths differ by {left_percent:+.2g} % and {right_percent:+.2g} % from fx.",
    remedy="If the numbers are from OpenCV or VIC-3D, use `--even-radial`.",
    link="cameras.md#dices-text",
)
UNUSED_COEFFICIENTS = DeclaredNotice(
    "SC-266",
    "warning",
    "{camera}: {coefficients} are ignored because {model} has no such coefficients.",
    effect="The program that wrote the file ignores them, too.",
    remedy="Check `LENS_DISTORTION_MODEL`.",
    link="cameras.md#calibrations-of-other-programs",
)
MALFORMED_XML = DeclaredNotice(
    "SC-267",
    "warning",
    "The file is not well-formed XML.",
    effect="Only its calibration and the size of its images are read.",
    remedy="Export the file again.",
    link="cameras.md#calibrations-of-other-programs",
)
INEXACT_ROTATION = DeclaredNotice(
    "SC-268",
    "warning",
    "The rotation matrix deviates from an orthonormal one by {deviation_mrad:.2f} mrad.",
    effect="It has too few digits and is replaced by the nearest rotation.",
    link="cameras.md#calibrations-of-other-programs",
)
CAMERA_GEOMETRY = DeclaredNotice(
    "SC-269",
    "note",
    "The cameras are {distance_mm:.2f} mm apart and rotated by {angle_deg:.2f}° against each other.",
    effect="Lengths in the file are in {unit}.",
    remedy="Compare both with the rig. If the distance is wrong, state `--length-unit`.",
    link="cameras.md#calibrations-of-other-programs",
)
NO_COMMON_VIEW = DeclaredNotice(
    "SC-270",
    "warning",
    "The right camera does not see the middle of the left image.",
    effect="The file may be misread; all positions would then be wrong.",
    remedy="Check that the pose is x_right = R·x_left + T.",
    link="cameras.md#calibrations-of-other-programs",
)
UNCERTAINTIES_MISSING = DeclaredNotice(
    "SC-271",
    "note",
    "The file has no uncertainties.",
    remedy="State `scale_uncertainty` under `[stereo.NAME]` in rig.toml.",
    link="cameras.md#calibrations-of-other-programs",
)
UNUSUAL_DISTANCE = DeclaredNotice(
    "SC-272",
    "warning",
    "The cameras are {distance_m:.3g} m apart with lengths in {unit}.",
    effect="The file may be misread; all positions would then be wrong.",
    remedy="Check the unit.",
    link="cameras.md#calibrations-of-other-programs",
)
APPROXIMATED_CAMERA = DeclaredNotice(
    "SC-273",
    "note",
    "The nearest camera without {missing} differs by up to {largest_px:.3f} px over the image.",
    link="cameras.md#calibrations-of-other-programs",
)
POORLY_APPROXIMATED_CAMERA = DeclaredNotice(
    "SC-274",
    "warning",
    "The nearest camera without {missing} differs by up to {largest_px:.3f} px over the image.",
    effect="This systematic difference is not included in U.",
    remedy="Calibrate with a camera model that both programs have.",
    link="cameras.md#calibrations-of-other-programs",
)
CENTRE_OUTSIDE_IMAGE = DeclaredNotice(
    "SC-275",
    "warning",
    "The principal point ({x_px:.0f}, {y_px:.0f}) is outside the image of {width_px} × {height_px} px.",
    effect="The file may be misread; all positions would then be wrong.",
    remedy="Check whether width and height are exchanged.",
    link="cameras.md#calibrations-of-other-programs",
)
CENTRE_FAR_FROM_MIDDLE = DeclaredNotice(
    "SC-276",
    "warning",
    "The principal point ({x_px:.0f}, {y_px:.0f}) is far from the middle of the image of {width_px} × {height_px} px.",
    effect="The file may be misread; all positions would then be wrong.",
    remedy="Check that the camera matrix is that of images of this size that are not cropped.",
    link="cameras.md#calibrations-of-other-programs",
)
SKEW_IGNORED = DeclaredNotice(
    "SC-277",
    "warning",
    "OpenCV's functions ignore the skew of {skew_px:.3g} px.",
    effect="Its projections differ from those of this camera.",
    remedy="Calibrate without skew for use in OpenCV.",
    link="cameras.md#and-out-again",
)
COVARIANCE_NOT_EXPORTED = DeclaredNotice(
    "SC-278",
    "note",
    "A {program} file has no covariance.",
    remedy="Keep the original file.",
    link="cameras.md#and-out-again",
)
