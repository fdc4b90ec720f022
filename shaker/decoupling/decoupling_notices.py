"""Notices of the stage that fits models with common poles for decoupling."""

from __future__ import annotations

from shakercal._common.notices import DeclaredNotice

RELEASE_TOO_SLOW = DeclaredNotice(
    "SC-392",
    "warning",
    "No release is shorter than a period of the modes at {frequencies} Hz.",
    effect="The effect of this load on these modes may deviate by more than U.",
    remedy="Use a faster release.",
    link="decoupling.md",
)
SINGLE_RELEASE = DeclaredNotice(
    "SC-393",
    "note",
    "There is only one release of {component}.",
    effect="The difference between releases is not included in U.",
    remedy="Record a second release.",
    link="decoupling.md",
    possible_size="not known from one release",
)
RELEASE_SIZE_SCATTER = DeclaredNotice(
    "SC-394",
    "note",
    "The sizes of the {count} releases scatter by {scatter_percent:.2g} %.",
    effect="U includes this scatter.",
    remedy="",
    link="decoupling.md",
)
RELEASE_SHAPE_MISFIT = DeclaredNotice(
    "SC-395",
    "warning",
    "The residual of the model is {factor:.1f} times the noise of {channel}.",
    effect="The time course of the load may be neither a ramp nor half a cosine.",
    remedy="Use another release device, or check the record for disturbances.",
    link="decoupling.md",
)
DURATION_AMBIGUOUS = DeclaredNotice(
    "SC-396",
    "warning",
    "Release {record} may have lasted {duration_ms:.3g} ms or {other_ms:.3g} ms (χ² differs by {difference:.1f}).",
    effect="The records do not distinguish both durations; U includes both.",
    remedy="Record a release of another duration.",
    link="decoupling.md",
)
DURATION_UNLIKELY = DeclaredNotice(
    "SC-397",
    "note",
    "Release {record} lasted {duration_ms:.3g} ms, or less likely {other_ms:.3g} ms (χ² differs by {difference:.1f}).",
    effect="U includes both durations.",
    remedy="Record a release of another duration.",
    link="decoupling.md",
)
