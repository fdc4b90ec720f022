"""Notices of images, of the subsets in them, and of the motion fitted to them."""

from shakercal._common.notices import DeclaredNotice

LOSSY_IMAGES = DeclaredNotice(
    "SC-200",
    "warning",
    "{images} images have lossy compression, which changes grey values.",
    effect="Such errors are not included in any uncertainty.",
    remedy="Record images without compression, or with lossless compression.",
    link="tracking.md#noise",
)
ORIENTATION_NOT_APPLIED = DeclaredNotice(
    "SC-201",
    "warning",
    "The orientation tag {tag} ({rotation}) of {tagged} of {files} image files is not applied.",
    effect="The pixels are used as the sensor stored them. A calibration by a program that applies such tags "
    "does not fit.",
    remedy="Calibrate by `shakercal cameras`, or with images without the tag.",
    link="cameras.md",
)
RAW_PHOTRON_FRAMES = DeclaredNotice(
    "SC-202",
    "note",
    "The header calls the frames raw, as it does for monochrome frames of 12 bits.",
    effect="They are treated as monochrome, not as a colour mosaic.",
    link="recording-format.md",
)
EXPOSURE_VARIES = DeclaredNotice(
    "SC-203",
    "warning",
    "The exposure is {exposure_us:.4g} µs, but {different} of {frames} frames state another one.",
    effect="The exposure of all frames is treated as equal to the median.",
    remedy="Record with a constant exposure, or state `exposure` in the recording.",
    link="shutter.md",
)
COMPANDED_CODES = DeclaredNotice(
    "SC-204",
    "note",
    "The pixels have companded codes of 10 bits.",
    effect="Grey values are rounded to 0.1 % of full scale.",
    remedy="Save uncompressed or 12-bit packed frames to avoid the rounding.",
)
FILM_DECODED = DeclaredNotice(
    "SC-205",
    "note",
    "The images are a film of {bits} bits.",
    effect="Its player may have changed grey values.",
    remedy="Raw frames of the camera are better.",
)
COMPRESSED_VIDEO = DeclaredNotice(
    "SC-206",
    "warning",
    "The video is compressed ({codec}): its codec changes grey values and moves edges, differently in every frame.",
    effect="Such errors are not included in any uncertainty.",
    remedy="Record uncompressed frames (TIFF, cine, raw video).",
    link="tracking.md#noise",
)
SENSOR_CLIPS = DeclaredNotice(
    "SC-207",
    "warning",
    "The sensor clips at {clip_level}, below full scale {full_scale}: {saturated_percent:.2g} % of the pixels of the "
    "first image are saturated.",
    effect="These pixels are excluded.",
    remedy="Use less light or a shorter exposure.",
    link="look.md",
)
SENSOR_SATURATES = DeclaredNotice(
    "SC-244",
    "warning",
    "The sensor saturates at about {level:.0f}: the brightest {share_percent:.2g} % of the body's pixels scatter less "
    "than the noise of darker ones allows.",
    effect="The texture is cut off. Motions below a pixel are too small by some {shortening_percent:.2g} %. The stated "
    "error periodic in the pixel covers a part of it.",
    remedy="Use less light or a shorter exposure.",
    link="tracking.md#sensor-errors-and-their-effects",
)
NOISE_FALLS = DeclaredNotice(
    "SC-245",
    "note",
    "The noise variance falls by {fall_percent:.2g} % from dark to bright pixels: grey values are not proportional to "
    "light, as with a gamma of about 0.45.",
    effect="Motions change by less than 0.01 %, because the curve moves with the texture.",
    remedy="Switch off the gamma of the camera, for example to check its exposure and noise.",
    link="tracking.md#sensor-errors-and-their-effects",
)
NOISE_OF_ROWS = DeclaredNotice(
    "SC-246",
    "note",
    "Rows have a common error of {row_grey:.2g} grey values that changes between frames, compared with "
    "{pixel_grey:.2g} of a single pixel.",
    effect="Motions across the rows scatter more than the noise of single pixels predicts. The uncertainty of lines "
    "includes it, since it is computed from the scatter.",
    remedy="Record more frames, or use a camera whose rows have no noise in common.",
    link="tracking.md#sensor-errors-and-their-effects",
)
COLUMNS_ALTERNATE = DeclaredNotice(
    "SC-247",
    "note",
    "Even and odd {lines} differ in gain by {gain_percent:.2g} %, as with a readout by two amplifiers.",
    effect="Every image is corrected by this ratio. Without it motions across the {lines} below a pixel would be "
    "shortened by up to {shortening_percent:.2g} %.",
    remedy="Correct the gain of the {lines} in the camera, or state flat images.",
    link="tracking.md#sensor-errors-and-their-effects",
)


UNUSED_SUBSETS = DeclaredNotice(
    "SC-210",
    "note",
    "{unused} of {subsets} subsets are not used, or only across their edges: {reasons}.",
    effect="The remaining subsets determine the motion.",
    remedy="If most are missing, spray a speckle pattern, or use more light.",
    link="poor-surfaces.md",
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
    link="tracking.md#check-of-the-calibration-in-every-run",
)


BODY_DEFORMS = DeclaredNotice(
    "SC-220",
    "warning",
    "The points depart from a rigid motion by {misfit_um:.1f} µm rms, {ratio:.0f} times their noise.",
    effect="The body bends, or parts of it move separately. The six components describe its best rigid fit.",
    remedy="Check the mounting; restrict `region` to the stiff part of the body.",
    link="tracking.md#deformation-of-the-body",
)
FRAMES_WITHOUT_GREY_FIT = DeclaredNotice(
    "SC-221",
    "warning",
    "In {failed} of {frames} frames the motion could not be fitted to the grey values.",
    effect="These frames have the motion of their points, which has more noise.",
    remedy="Check the light and the texture in these frames.",
    link="tracking.md#fit-to-the-grey-values",
)
GREY_FIT_DISAGREES = DeclaredNotice(
    "SC-222",
    "warning",
    "The motion fitted to the grey values differs from that of the tracked points by {ratio:.1f} standard "
    "uncertainties.",
    effect="The body bends, something in front of it moves, or its texture is not resolved.",
    remedy="Keep the view free, and check the texture and the mounting.",
    link="tracking.md#fit-to-the-grey-values",
)

# The fixed pattern of the sensors.

PATTERN_CORRECTED = DeclaredNotice(
    "SC-214",
    "note",
    "The fixed pattern of the image sensors (about {prnu_percent:.2g} % PRNU) shortens the motion of {motion_px:.2g} "
    "px (rms) at {frequency_hz:.6g} Hz by {correction_percent:.2g} %.",
    effect="This is corrected by the growth of the misfit with the motion. {u_percent:.2g} % (u) remain, which are in "
    "U: also by cells of the image that err alike in every period.",
    remedy="For a smaller uncertainty state `dark` and `flat` images of each camera.",
    link="tracking.md#fixed-pattern",
)
PATTERN_UNKNOWN = DeclaredNotice(
    "SC-215",
    "warning",
    "A motion of {motion_px:.2g} px (rms) at {frequency_hz:.6g} Hz does not show how large the fixed pattern of the "
    "image sensors is: u of this camera pair's amplitude by it is {u_percent:.2g} %, more than noise.",
    effect="U includes this, for the pattern that is stated or for that of a common industrial sensor.",
    remedy="State `dark` and `flat` images or `prnu` and `dsnu` of each camera, or `displaced_left` and "
    "`displaced_right`: some images with the body displaced by 1 to 5 px.",
    link="tracking.md#fixed-pattern",
)
PATTERN_CONTRADICTED = DeclaredNotice(
    "SC-219",
    "warning",
    "The fixed pattern of the {camera} camera's sensor is {ratio:.1f} times (u {u:.1f}) the one that is stated for it.",
    effect="The measured size is used, and its uncertainty is in U.",
    remedy="Check that the dark and flat images, or `prnu` and `dsnu`, are those of this camera and of these settings.",
    link="tracking.md#fixed-pattern",
)
