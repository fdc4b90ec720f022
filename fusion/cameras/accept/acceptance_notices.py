"""Notices and errors of the acceptance test of a stereo rig (`shakercal accept`)."""

from shakercal._common.notices import DeclaredNotice

TEST_IMAGES = DeclaredNotice(
    "SC-927",
    "error",
    "expected {expected}, found {found}",
    effect="The test cannot be evaluated.",
    remedy="Correct the images or the list of this test in acceptance.toml.",
    link="acceptance.md#describe-the-tests",
)
TOO_FEW_SUBSETS = DeclaredNotice(
    "SC-928",
    "error",
    "expected at least {expected} subsets that are found in all images, found {found}",
    effect="The motion of so few points does not show a fault of the calibration.",
    remedy="Use a larger speckled plate, sharper images or smaller steps.",
    link="acceptance.md#describe-the-tests",
)
LIKELY_FAULT = DeclaredNotice(
    "SC-929",
    "warning",
    "The most likely cause is {fault}: {size}. It explains {share_percent:.0f} % of the deviations{others}.",
    effect="The positions and displacements that this rig measures are wrong by the amounts in the table.",
    remedy="{remedy}",
    link="acceptance.md#which-pattern-indicates-which-fault",
)
SMALL_FAULT = DeclaredNotice(
    "SC-930",
    "note",
    "The deviations are within the tolerances, but significant. The most likely cause is {fault}: {size}.",
    remedy="{remedy}",
    link="acceptance.md#which-pattern-indicates-which-fault",
)
LATE_FRAMES = DeclaredNotice(
    "SC-931",
    "warning",
    "The {camera} camera is {frames} frames late.",
    effect="The two images of a pair show different instants, so their points do not exist.",
    remedy="Check trigger cables and dropped frames, and pair the images by their numbers.",
    link="acceptance.md#translation",
)
SYNCHRONISATION_UNTESTED = DeclaredNotice(
    "SC-932",
    "note",
    "The steps cannot show whether the cameras are synchronous.",
    remedy="Use at least 7 positions with unequal steps, such as 0, 1, 2.5, 4, 5, 3.5, 1.5 and 0 mm.",
    link="acceptance.md#translation",
)
SCALE_UNTESTED = DeclaredNotice(
    "SC-933",
    "note",
    "The scale is not tested, because no positions of the stage are stated.",
    remedy="State `positions` with their uncertainty.",
    link="acceptance.md#translation",
)
UNEXPLAINED_FAULT = DeclaredNotice(
    "SC-934",
    "warning",
    "No single fault explains the deviations; the nearest is {fault}, with {share_percent:.0f} %.",
    remedy="Check the stage, the fixing of cameras and body, and the air between them; then calibrate again.",
    link="acceptance.md#which-pattern-indicates-which-fault",
)
LIKELY_CAUSE = DeclaredNotice(
    "SC-935",
    "warning",
    "{quantity}: {value}, tolerance {tolerance}: {cause}.",
    remedy="{remedy}",
    link="acceptance.md#which-pattern-indicates-which-fault",
)
