"""Notices and errors of the fusion of all instruments of a body into its acceleration."""

from shakercal._common.notices import DeclaredNotice

UNOBSERVED_COMPONENTS = DeclaredNotice(
    "SC-458",
    "note",
    "The readings of {instruments} do not determine {components} at {lines} of {all_lines} lines.",
    effect="These components have no value.",
    remedy="Add measuring points or directions.",
    link="uncertainty.md",
)
UNBOUNDED_MOTION = DeclaredNotice(
    "SC-459",
    "warning",
    "No instrument measures {driven}, which `excitation.direction` states as driven.",
    effect="The size of that motion has no limit, so results that it can affect have no value{unused}.",
    remedy="Add an instrument that measures {driven}, or correct `excitation.direction`.",
    acknowledgeable=False,
    link="uncertainty.md",
)
UNBOUNDED_READINGS = DeclaredNotice(
    "SC-460",
    "error",
    "No instrument measures {driven}, which `excitation.direction` states as driven{unused}.",
    effect="The size of that motion has no limit, and every reading may contain it.",
    remedy="Add an instrument that measures {driven}, or correct `excitation.direction`.",
    link="uncertainty.md",
)
NOISE_ONLY = DeclaredNotice(
    "SC-461",
    "warning",
    "No instrument ({instruments}) states a systematic uncertainty.",
    effect="U includes noise only.",
    remedy="State the uncertainties of scales, poses and positions.",
    link="uncertainty.md",
)
GROSS_ERROR = DeclaredNotice(
    "SC-462",
    "warning",
    "{instrument} is rejected: it differs by {deviation:.3g} standard uncertainties from the others{ratio}.",
    effect="It has a gross error or a wrong statement; without it all others agree.",
    remedy="Check scale, sign, position and direction of the instrument.",
    link="uncertainty.md",
)
COMPARED_ONLY = DeclaredNotice(
    "SC-463",
    "note",
    "It states no systematic uncertainty and differs by {deviation:.2g} standard uncertainties from the others{ratio}.",
    effect="It is compared with the others and not used.",
    remedy="State its uncertainty to use it.",
    link="uncertainty.md",
)
INSTRUMENTS_DISAGREE = DeclaredNotice(
    "SC-464",
    "warning",
    "The instruments disagree (χ² {chi2:.3g}, {dof} degrees of freedom): {suspects}.",
    effect="U is enlarged to cover the disagreement. The others agree without {agreeing}. Possible causes: {causes}.",
    remedy="Check {checks} of these instruments.",
    link="uncertainty.md",
)
INSTRUMENTS_DISPUTED = DeclaredNotice(
    "SC-465",
    "warning",
    "The instruments disagree (χ² {chi2:.3g}, {dof} degrees of freedom): {suspects}.",
    effect="The data cannot show which instrument is wrong, so {components} and the load have no value. "
    "The others agree without {agreeing}. Possible causes: {causes}. Alternatives: {values}.",
    remedy="Check {checks} of these instruments.",
    acknowledgeable=False,
    link="uncertainty.md",
)
READINGS_SCATTER = DeclaredNotice(
    "SC-466",
    "warning",
    "Its readings scatter beyond their stated uncertainties: by {amplitude:.2g} of the motion in amplitude and "
    "{phase_rad:.2g} rad in phase at {frequency_hz:.6g} Hz.",
    effect="U includes this scatter.",
    remedy="Check positions and directions of its channels, or state larger uncertainties.",
    link="uncertainty.md",
)
SINGLE_ERROR_NOT_ASSESSED = DeclaredNotice(
    "SC-467",
    "note",
    "A single gross error in one instrument, up to {limit:g} times its stated u, could be undetected.",
    remedy="Add measuring points or a second stereo pair.",
    possible_size="{shifts}",
    link="uncertainty.md",
)
