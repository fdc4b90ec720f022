"""Notices of a calibration from target views."""

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
    "The points cover {share_percent:.0f} % of the {side} image.",
    effect="The distortion is extrapolated in the rest.",
    remedy="Add views with the target near the edges, or measure within the covered area.",
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
    remedy="Check for a print stretched along one axis, too few tilted views, or images scaled in one direction.",
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
    link="cameras.md#from-pictures-of-a-target-to-a-stereo-pair",
)
KNOWN_LENGTH_USED = DeclaredNotice(
    "SC-262",
    "note",
    "The known length of {stated_mm:.6g} mm from {first} to {second} is {measured_mm:.6g} mm by the target's spacing "
    "({difference_percent:+.2g} %, U = {expanded_percent:.2g} %).",
    effect="All lengths are changed by {change_percent:+.2g} %, with U = {scale_expanded_percent:.2g} % (k = 2).",
    link="cameras.md#from-pictures-of-a-target-to-a-stereo-pair",
)
KNOWN_LENGTH_CONTRADICTED = DeclaredNotice(
    "SC-263",
    "warning",
    "The known length of {stated_mm:.6g} mm from {first} to {second} contradicts the target's spacing, by which it is "
    "{measured_mm:.6g} mm ({difference_percent:+.2g} %, {deviation:.1f} standard uncertainties).",
    effect="All lengths are changed by {change_percent:+.2g} %, with the enlarged U = {scale_expanded_percent:.2g} % "
    "(k = 2).",
    remedy="Measure the length and the spacing again.",
    link="cameras.md#from-pictures-of-a-target-to-a-stereo-pair",
)
