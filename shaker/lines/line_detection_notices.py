"""Notices of the search for the lines of a recording."""

from __future__ import annotations

from shakercal._common.notices import DeclaredNotice

HARMONICS_ON_ALIAS = DeclaredNotice(
    "SC-305",
    "warning",
    "{frequency_hz:.6g} Hz, sampled at {rate_hz:.6g} Hz, is read at its alias {alias_hz:.5g} Hz, which it would "
    "share with {harmonics}.",
    effect="These harmonics add to the line if the motion contains them.",
    remedy="Use a camera rate that separates them; `shakercal plan` proposes one.",
    link="planning.md",
)
HARMONIC_OUT_OF_REACH = DeclaredNotice(
    "SC-306",
    "warning",
    "Harmonic {multiple} of {fundamental_hz:.6g} Hz lies above {limit_hz:.6g} Hz, the limit of the fastest channel.",
    effect="The harmonic has no result.",
    remedy="Remove it from `harmonics`, or sample faster.",
    link="signals.md",
)
OTHER_LINES = DeclaredNotice(
    "SC-307",
    "note",
    "The record contains {count} other lines: {lines}.",
    effect="They have no result.",
    remedy="Add a line to the driven frequencies if it is driven.",
    link="signals.md",
)
NO_NOMINAL_LINE = DeclaredNotice(
    "SC-308",
    "warning",
    "No line exceeds the noise within {capture_hz:.3g} Hz of the nominal {nominal_hz:.6g} Hz.",
    effect="Other lines are not explained by this frequency.",
    remedy="Check the nominal frequency and whether the excitation was on.",
    link="signals.md",
)
TOO_MANY_LINES = DeclaredNotice(
    "SC-309",
    "note",
    "A channel has more than {most} lines.",
    effect="The {left_out} weakest lines are left out.",
    link="signals.md",
)
