"""Notices of the estimation of a camera's pose in the sensor frame."""

from shakercal._common.notices import DeclaredNotice

CONTRADICTORY_EVIDENCE = DeclaredNotice(
    "SC-279",
    "warning",
    "The evidence is contradictory (χ² = {chi2:.3g} with {dof} degrees of freedom). The largest deviation is that of "
    "{piece}, {ratio:.2g} times the stated uncertainty.",
    effect="The uncertainties of the pose are enlarged by {enlargement:.2g}.",
    remedy="Check this piece of evidence and its stated uncertainty.",
    link="cameras.md#uncertainty",
)
