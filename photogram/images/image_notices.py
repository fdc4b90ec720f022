"""Notices of opening a camera's image files."""

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
COLOUR_MOSAIC = DeclaredNotice(
    "SC-208",
    "warning",
    "Neighbouring pixels differ by {contrast_percent:.2g} % in a pattern of 2 x 2, as in the raw mosaic of a "
    "colour camera.",
    effect="The pattern counts as texture and biases positions.",
    remedy="Use a monochrome camera, or only one colour.",
    link="look.md",
)
