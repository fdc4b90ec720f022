"""Notices of fitting the rigid motion of a body."""

from shakercal._common.notices import DeclaredNotice

BODY_DEFORMS = DeclaredNotice(
    "SC-220",
    "warning",
    "The points depart from a rigid motion by {misfit_um:.1f} µm rms, {ratio:.0f} times their noise.",
    effect="The body bends, or parts of it move separately. The six components describe its best rigid fit.",
    remedy="Check the mounting; restrict `region` to the stiff part of the body.",
    link="tracking.md#what-the-body-does-beside",
)
FRAMES_WITHOUT_GREY_FIT = DeclaredNotice(
    "SC-221",
    "warning",
    "In {failed} of {frames} frames the motion could not be fitted to the grey values.",
    effect="These frames have the motion of their points, which has more noise.",
    remedy="Check the light and the texture in these frames.",
    link="tracking.md#what-the-fit-to-the-grey-values-does",
)
GREY_FIT_DISAGREES = DeclaredNotice(
    "SC-222",
    "warning",
    "The motion fitted to the grey values differs from that of the tracked points by {ratio:.1f} standard "
    "uncertainties.",
    effect="The body bends, something in front of it moves, or its texture is not resolved.",
    remedy="Keep the view free, and check the texture and the mounting.",
    link="tracking.md#what-the-fit-to-the-grey-values-does",
)
