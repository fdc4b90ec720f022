"""Notices of camera calibrations, their import and export, and poses in the sensor frame."""

from shakercal._common.notices import DeclaredNotice

FEW_VIEWS = DeclaredNotice(
    "SC-250",
    "warning",
    "Only {count} {kind} were used.",
    effect="The calibration cannot be checked.",
    remedy="Use {least} to 20 {kind}.",
    link="cameras.md#how-a-good-session-looks",
)
LITTLE_TILT = DeclaredNotice(
    "SC-251",
    "warning",
    "The target is tilted by only {spread_deg:.1f}° (rms) about the {axis} axis of the image.",
    effect="Focal length and distance are poorly resolved.",
    remedy="Add views tilted by 20° or more about this axis.",
    link="cameras.md#how-a-good-session-looks",
)
LOW_COVERAGE = DeclaredNotice(
    "SC-252",
    "warning",
    "The points cover {share_percent:.0f} % of the {side} image and {corners} of its 4 corners.",
    effect="The distortion is extrapolated in the rest.",
    remedy="Add views with the target near the edges and in the corners, or measure within the covered area.",
    link="cameras.md#how-a-good-session-looks",
)
UNCERTAIN_FOCAL_LENGTH = DeclaredNotice(
    "SC-253",
    "warning",
    "The standard uncertainty of {parameter} is {u_percent:.1f} % (k = 1).",
    effect="Distances, and so all positions, scale with it.",
    remedy="Add tilted views at other distances.",
    link="cameras.md#how-a-good-session-looks",
)
ASPECT_RATIO = DeclaredNotice(
    "SC-254",
    "warning",
    "The ratio of {side}.fx to {side}.fy is {ratio:.4f} with U = {expanded:.4f} (k = 2).",
    effect="A sensor with square pixels has the ratio 1.",
    remedy="Check for a print stretched along one axis, too few tilted views, or images scaled in one direction. A "
    "tilted sensor (Scheimpflug) needs no remedy.",
    link="cameras.md#how-it-is-calculated",
)
FOCAL_DRIFT = DeclaredNotice(
    "SC-255",
    "warning",
    "The {side} focal length changed by {change_percent:+.3f} % (U = {expanded_percent:.3f} %, k = 2) from the first "
    "view to the last.",
    effect="The result is that of the middle of the session. U includes the range.",
    remedy="Let the cameras warm up, and fix the lenses.",
    link="cameras.md#how-it-is-calculated",
)
MODEL_DIFFERENCE = DeclaredNotice(
    "SC-256",
    "warning",
    "A {shape} target with a {lens} lens changes the results: {differences}.",
    effect="Views left out are predicted to {used_px:.3f} px by the model used ({used_shape}, {used_lens}), and to "
    "{other_px:.3f} px by this one.",
    remedy="Prefer the model with the smaller prediction residual (`--shape`, `--lens`).",
    link="cameras.md#how-it-is-calculated",
)
PARAMETERS_UNDETERMINED = DeclaredNotice(
    "SC-257",
    "note",
    "These views do not determine {parameters}.",
    effect="Their values are those of an ordinary lens.",
    remedy="Add views with points near the edges of the image, and views tilted by 20°.",
    link="cameras.md#how-it-is-calculated",
)
PARAMETERS_INDISTINCT = DeclaredNotice(
    "SC-258",
    "note",
    "Not significantly different from zero: {parameters}.",
    link="cameras.md#how-it-is-calculated",
)
TARGET_DEVIATION = DeclaredNotice(
    "SC-259",
    "note",
    "The target's points deviate from their lattice by {x_um:.{digits}f} µm and {y_um:.{digits}f} µm rms in its plane, "
    "and by {z_um:.{digits}f} µm across it.",
    effect="This deviation was estimated together with the cameras.",
    link="cameras.md#how-it-is-calculated",
)
EXCESS_NOISE = DeclaredNotice(
    "SC-260",
    "warning",
    "The residuals exceed the image noise by {added_px:.2f} px per coordinate.",
    effect="Causes are a rough print, a bent target, or a lens that the model does not describe.",
    remedy="Examine the residual maps.",
    link="cameras.md#how-a-good-session-looks",
)
SPACING_UNCERTAINTY_UNSTATED = DeclaredNotice(
    "SC-261",
    "warning",
    "The uncertainty of the target's spacing is not stated.",
    effect="The uncertainty of all lengths does not include it.",
    remedy="State it by `--scale-uncertainty`.",
    link="cameras.md#from-images-of-a-target-to-a-stereo-pair",
)
KNOWN_LENGTH_USED = DeclaredNotice(
    "SC-262",
    "note",
    "The known length of {stated_mm:.6g} mm from {first} to {second} is {measured_mm:.6g} mm by the target's spacing "
    "({difference_percent:+.2g} %, U = {expanded_percent:.2g} %).",
    effect="All lengths are changed by {change_percent:+.2g} %, with U = {scale_expanded_percent:.2g} % (k = 2).",
    link="cameras.md#from-images-of-a-target-to-a-stereo-pair",
)
KNOWN_LENGTH_CONTRADICTED = DeclaredNotice(
    "SC-263",
    "warning",
    "The known length of {stated_mm:.6g} mm from {first} to {second} contradicts the target's spacing, by which it is "
    "{measured_mm:.6g} mm ({difference_percent:+.2g} %, {deviation:.1f} standard uncertainties).",
    effect="All lengths are changed by {change_percent:+.2g} %, with the enlarged U = {scale_expanded_percent:.2g} % "
    "(k = 2).",
    remedy="Measure the length and the spacing again.",
    link="cameras.md#from-images-of-a-target-to-a-stereo-pair",
)
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
    effect="The calibration counts as exact.",
    remedy="State `scale_uncertainty` under `[stereo.NAME]` in rig.toml.",
    link="cameras.md#calibrations-of-other-programs",
)
ARBITRARY_SCALE = DeclaredNotice(
    "SC-240",
    "warning",
    "The lengths of {program} are in an arbitrary unit unless its model was scaled.",
    effect="All positions and motions scale with it.",
    remedy="Scale the model by a measured length there, and state `scale_uncertainty` under `[stereo.NAME]`.",
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
    "The nearest camera without {missing} differs by up to {largest_px:.4f} px over the image, and by up to "
    "{percent:.2g} % in small displacements.",
    link="cameras.md#calibrations-of-other-programs",
)
POORLY_APPROXIMATED_CAMERA = DeclaredNotice(
    "SC-274",
    "warning",
    "The nearest camera without {missing} differs by up to {largest_px:.4f} px over the image, and by up to "
    "{percent:.2g} % in small displacements.",
    effect="This systematic difference is not included in U.",
    remedy="Calibrate with a camera model that both programs have, or add the difference to `scale_uncertainty`.",
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
    link="cameras.md#export-to-other-programs",
)
COVARIANCE_NOT_EXPORTED = DeclaredNotice(
    "SC-278",
    "note",
    "A file of {program} has no covariance.",
    remedy="Keep the original file.",
    link="cameras.md#export-to-other-programs",
)
CONTRADICTORY_EVIDENCE = DeclaredNotice(
    "SC-279",
    "warning",
    "The evidence is contradictory (χ² = {chi2:.3g} with {dof} degrees of freedom). The largest deviation is that of "
    "{piece}, {ratio:.2g} times the stated uncertainty.",
    effect="The uncertainties of the pose are enlarged by {enlargement:.2g}.",
    remedy="Check this piece of evidence and its stated uncertainty.",
    link="cameras.md#uncertainty",
)
REPEATED_POSES = DeclaredNotice(
    "SC-298",
    "note",
    "{views} views show {poses} different poses of the target.",
    effect="Images of one pose share errors. Uncertainties and tests count them as one view.",
    remedy="Move and tilt the target between the images.",
    link="cameras.md#how-a-good-session-looks",
)
COPIED_IMAGES = DeclaredNotice(
    "SC-299",
    "warning",
    "{count} images are copies of others, such as {first}.",
    effect="Each image is counted once.",
    remedy="Remove the copies, and check that the camera stored every exposure.",
    link="cameras.md#how-a-good-session-looks",
)
