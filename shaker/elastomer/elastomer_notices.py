"""Notices of the stage that models the cross-beam element."""

from __future__ import annotations

from shakercal._common.notices import DeclaredNotice

PLATFORM_NOT_VALIDATED = DeclaredNotice(
    "SC-398",
    "warning",
    "Mass, height and moments of inertia of the platform are fitted to the frequencies.",
    effect="Other half-sizes fit them too, with other data; agreement does not validate the model.",
    remedy="State platform data from a drawing or a balance.",
    link="elastomer.md",
)
PLATFORM_MISFIT = DeclaredNotice(
    "SC-399",
    "warning",
    "No platform has all target frequencies; the largest deviation is {misfit_percent:.2f} %.",
    effect="The platform with the least relative squares is reported.",
    remedy="Check the names of the frequencies and the dimensions of the beams.",
    link="elastomer.md",
)
