"""Findings of `shakercal look`."""

from shakercal._common.notices import DeclaredNotice

CONTRADICTORY_READINGS = DeclaredNotice(
    "SC-817",
    "warning",
    "Readings contradict each other: {readings}.",
    remedy="Check these instruments and their keys in the manifest.",
    link="look.md#how-instruments-are-compared",
)
EXPLAINED_CONTRADICTION = DeclaredNotice(
    "SC-818",
    "warning",
    "Readings contradict each other: {readings}. They agree as if {causes}.",
    remedy="Correct the manifest.",
    link="look.md#how-instruments-are-compared",
)
FILE_PROBLEM = DeclaredNotice(
    "SC-819",
    "error",
    "{reason}",
    effect="A run of this recording is not possible.",
    remedy="Correct the manifest, or record again.",
    link="look.md",
)
REMARK = DeclaredNotice(
    "SC-804",
    "warning",
    "{remark}",
    effect="Such a remark of `shakercal check` limits the result.",
    link="look.md",
)
INCOMPLETE_RECORDING = DeclaredNotice(
    "SC-820",
    "error",
    "The recording is not complete: {reason}",
    remedy="Wait until all files are written.",
    link="look.md",
)
CAMERAS_DIFFER_IN_FRAMES = DeclaredNotice(
    "SC-821",
    "error",
    "The left camera has {left} frames and the right camera {right}.",
    remedy="Record again, with all frames of both cameras.",
    link="look.md#what-is-examined-in-channels-and-images",
)
LOOK_MISSING_EDGES = DeclaredNotice(
    "SC-822",
    "error",
    "{frames} frames have only {edges} trigger edges.",
    effect="The times of some frames are unknown.",
    remedy="Record the trigger from the first frame to the last.",
    link="look.md#what-is-examined-in-channels-and-images",
)
FIRST_EDGE_UNSTATED = DeclaredNotice(
    "SC-823",
    "error",
    "{frames} frames have {edges} trigger edges.",
    effect="The edge of the first frame is unknown.",
    remedy="State `first_edge` of these images.",
    link="look.md#what-is-examined-in-channels-and-images",
)
AIM_MISSED = DeclaredNotice(
    "SC-824",
    "warning",
    "U (k = 2) of {channel} at {frequency_hz:g} Hz will be about {expected_percent:.2g} %, more than the target of "
    "{aim_percent:.2g} %.",
    remedy="Increase the excitation or the duration of the record, or use instruments with smaller stated uncertainty.",
    link="look.md#the-uncertainty-to-expect",
)
NO_SPECKLE = DeclaredNotice(
    "SC-825",
    "error",
    "No speckled body is visible: {reason}.",
    remedy="Check light, focus and field of view.",
    link="look.md#what-is-examined-in-channels-and-images",
)
OVEREXPOSED = DeclaredNotice(
    "SC-826",
    "warning",
    "{share_percent:.2g} % of the body's pixels are saturated (at {level} of {full_scale}).",
    remedy="Reduce exposure or light.",
    link="look.md#what-is-examined-in-channels-and-images",
)
LOW_CONTRAST = DeclaredNotice(
    "SC-827",
    "warning",
    "The contrast of the speckle is {share_percent:.2g} % of full scale (rms).",
    remedy="Increase exposure or light.",
    link="look.md#what-is-examined-in-channels-and-images",
)
PATTERN_COST = DeclaredNotice(
    "SC-850",
    "note",
    "Pixels that differ in sensitivity by {prnu_percent:.2g} % (PRNU) would make motions below 0.5 px appear "
    "{shortening_percent:.2g} % too small, at the speckle contrast of {contrast:.2f}.",
    effect="Pixels that differ twice as much have four times the effect. Motions of 0.1 to 2 px show the size of the "
    "pattern, by which `run` corrects them.",
    remedy="For smaller motions record dark and flat images, or some images with the body displaced by 1 to 5 px.",
    link="tracking.md#fixed-pattern",
)
SPECKLE_SIZE = DeclaredNotice(
    "SC-828",
    "warning",
    "The speckle size is {size_px:.2g} px; 3 to 5 px are best.",
    effect="Fine speckle causes aliasing. Coarse speckle, or a camera out of focus, increases the noise.",
    remedy="Check the focus, or use another pattern.",
    link="look.md#what-is-examined-in-channels-and-images",
)
DARK_IMAGES = DeclaredNotice(
    "SC-829",
    "warning",
    "The brightest pixel is {brightest} of {full_scale}.",
    remedy="Increase exposure or light, or correct `bit_depth`.",
    link="look.md#what-is-examined-in-channels-and-images",
)
DARK_FRAMES = DeclaredNotice(
    "SC-830",
    "error",
    "{dark} of {examined} examined frames are dark, such as frame {example}.",
    remedy="Check the light during the record.",
    link="look.md#what-is-examined-in-channels-and-images",
)
CAMERA_OUT_OF_FOCUS = DeclaredNotice(
    "SC-831",
    "warning",
    "The {side} camera is out of focus: the speckle size is {left_px:.2g} px left and {right_px:.2g} px right.",
    remedy="Focus this camera, and calibrate the pair again.",
    link="look.md#what-is-examined-in-channels-and-images",
)
REPEATING_PATTERN = DeclaredNotice(
    "SC-832",
    "warning",
    "The pattern repeats every {period_px:.3g} px.",
    effect="Subsets may be matched to another period.",
    remedy="Use a random pattern.",
    link="look.md#what-is-examined-in-channels-and-images",
)
FEW_COMMON_FEATURES = DeclaredNotice(
    "SC-833",
    "warning",
    "Only {count} features are visible in both images.",
    effect="The calibration of the pair cannot be checked.",
    remedy="Check that both cameras see the same body.",
    link="look.md#what-is-examined-in-channels-and-images",
)
CAMERAS_EXCHANGED = DeclaredNotice(
    "SC-834",
    "error",
    "The features are on the epipolar lines of exchanged cameras.",
    remedy="Exchange `left` and `right` of these images.",
    link="look.md#what-is-examined-in-channels-and-images",
)
CALIBRATION_CONTRADICTED = DeclaredNotice(
    "SC-835",
    "error",
    "Only {share_percent:.2g} % of {count} features are on their epipolar lines.",
    effect="The calibration is that of another pair, or the cameras see different bodies.",
    remedy="Correct `calibration` of this pair, or calibrate again.",
    link="look.md#what-is-examined-in-channels-and-images",
)
EPIPOLAR_OFFSET = DeclaredNotice(
    "SC-836",
    "warning",
    "The features deviate by {offset_px:.2g} px from their epipolar lines.",
    effect="A camera has probably moved since the calibration.",
    remedy="Calibrate the pair again.",
    link="look.md#what-is-examined-in-channels-and-images",
)
LOOK_CONSTANT_CHANNEL = DeclaredNotice(
    "SC-837",
    "error",
    "All samples are {value:.4g} {unit}.",
    remedy="Check sensor, cable and amplifier.",
    link="look.md#what-is-examined-in-channels-and-images",
)
SIGNAL_DEFECT = DeclaredNotice(
    "SC-838",
    "warning",
    "The signal has a defect: {defect}.",
    remedy="Check range and connection of this channel, and record again.",
    link="signals.md",
)
ALIASED_HARMONIC = DeclaredNotice(
    "SC-839",
    "warning",
    "{lines} at {rate_hz:g} samples/s.",
    effect="Without an anti-aliasing filter it changes the amplitude of the driven line.",
    remedy="Use another sampling rate or a filter, and state the response of the filter.",
    link="look.md#what-is-examined-in-channels-and-images",
)
MAINS_PICKUP = DeclaredNotice(
    "SC-840",
    "warning",
    "The mains line at {frequency_hz:.4g} Hz has {share_percent:.2g} % of the driven line.",
    remedy="Check grounding and shielding.",
    link="look.md#what-is-examined-in-channels-and-images",
)
DRIVEN_LINE_MISSING = DeclaredNotice(
    "SC-841",
    "error",
    "No line is visible at the driven {frequency_hz:g} Hz.",
    remedy="Check this channel and the excitation.",
    link="look.md#what-is-examined-in-channels-and-images",
)
OTHER_LINE_DRIVEN = DeclaredNotice(
    "SC-842",
    "error",
    "No line is visible at the driven {frequency_hz:g} Hz; the strongest line is at {found_hz:.6g} Hz.",
    remedy="Correct `excitation.frequencies`.",
    link="look.md#what-is-examined-in-channels-and-images",
)
SIGNAL_DRIFT = DeclaredNotice(
    "SC-843",
    "warning",
    "The signal drifts by {drift:.3g} {unit}, {share_percent:.2g} % of its driven line.",
    remedy="Let the instrument warm up.",
    link="look.md#what-is-examined-in-channels-and-images",
)
NO_PERIODIC_TRIGGER = DeclaredNotice(
    "SC-844",
    "error",
    "The trigger is not periodic: {reason}.",
    remedy="Check channel, threshold and edge of the trigger.",
    link="look.md#what-is-examined-in-channels-and-images",
)
IRREGULAR_EDGES = DeclaredNotice(
    "SC-845",
    "warning",
    "{count} of {edges} trigger edges are {kind}.",
    remedy="Check level and cable of the trigger.",
    link="look.md#what-is-examined-in-channels-and-images",
)
LOOK_TRIGGER_JITTER = DeclaredNotice(
    "SC-846",
    "warning",
    "The trigger edges scatter by {jitter_us:.2g} µs.",
    remedy="Check the source of the trigger.",
    link="look.md#what-is-examined-in-channels-and-images",
)
ALIASED_LINES = DeclaredNotice(
    "SC-847",
    "warning",
    "At {rate_hz:.6g} frames/s {lines} are aliased to within {distance_bins:.2g} of a bin of each other or of 0 Hz.",
    effect="The images cannot resolve these lines.",
    remedy="Choose a camera rate by `shakercal plan`{advice}.",
    link="planning.md",
)
OTHER_DIRECTION_DRIVEN = DeclaredNotice(
    "SC-848",
    "warning",
    "The {body} moves along {axis} at {frequency_hz:.6g} Hz, with {share_percent:.2g} % of its motion along the stated "
    "direction {direction}.",
    remedy="Correct `excitation.direction`.",
    link="look.md#how-instruments-are-compared",
)
INDISTINCT_SENSITIVITY = DeclaredNotice(
    "SC-849",
    "warning",
    "The sensitivity to {component} at {frequency_hz:.6g} Hz is not significantly different from zero.",
    remedy="Increase the excitation or the duration of the record.",
    link="look.md#how-instruments-are-compared",
)
LIVE_NOT_POSSIBLE = DeclaredNotice(
    "SC-976",
    "error",
    "For `look --live` expected {expected}, found {found}.",
    remedy="Record, and evaluate the complete recording by `shakercal run`.",
    link="live.md#requirements",
)
