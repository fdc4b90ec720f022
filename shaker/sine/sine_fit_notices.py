"""Notices of the sine approximation: missing samples, spikes, and lines that sampling cannot separate."""

from __future__ import annotations

from shakercal._common.notices import DeclaredNotice

MISSING_SAMPLES = DeclaredNotice(
    "SC-300",
    "note",
    "{missing} of {samples} samples are missing.",
    effect="The sine fit uses the complete samples only.",
    remedy="Check the recorder if no samples should be missing.",
    link="signals.md",
)
SPIKES_REJECTED = DeclaredNotice(
    "SC-301",
    "warning",
    "{spikes} of {samples} samples exceed {limit_sigmas:.2g} standard deviations of the noise, the first at "
    "{first_s:.6g} s.",
    effect="These samples are left out of the sine fit.",
    remedy="Check the signal for interference, loose contacts or lost samples.",
    link="signals.md",
)
INSEPARABLE_LINE = DeclaredNotice(
    "SC-302",
    "warning",
    "{frequency_hz:.6g} Hz cannot be separated from the other lines at these sampling times.",
    effect="The line is dropped and has no result.",
    remedy="Excite fewer lines, or record for longer.",
    link="planning.md",
)
ALIASED_LINE = DeclaredNotice(
    "SC-303",
    "warning",
    "{frequency_hz:.6g} Hz aliases to {alias_hz:.4g} Hz, {distance_hz:.3g} Hz from {neighbour}, when sampled at "
    "{rate_hz:.6g} Hz.",
    effect="{duration_s:.4g} s of record resolve only {resolution_hz:.3g} Hz. The line is dropped and has no result.",
    remedy="No nearby camera rate separates the line. Change its frequency, or record for longer.",
    link="planning.md",
)
ALIASED_LINE_OTHER_RATE = DeclaredNotice(
    "SC-304",
    "warning",
    "{frequency_hz:.6g} Hz aliases to {alias_hz:.4g} Hz, {distance_hz:.3g} Hz from {neighbour}, when sampled at "
    "{rate_hz:.6g} Hz.",
    effect="{duration_s:.4g} s of record resolve only {resolution_hz:.3g} Hz. The line is dropped and has no result.",
    remedy="Use a camera rate of {better_rate_hz:.3f} Hz ({rate_change_hz:+.3f} Hz), which separates {separated}.",
    link="planning.md",
)
