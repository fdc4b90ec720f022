"""Notices of doubtful poles and of figures that do not change linearly."""

from __future__ import annotations

from shakercal._common.notices import DeclaredNotice

UNSTABLE_POLES = DeclaredNotice(
    "SC-340",
    "warning",
    "{unstable} of {poles} poles do not decay.",
    effect="The model is unstable and has no step response.",
    remedy="Use a lower order, or a longer record.",
    link="steps.md",
)
ALTERNATING_POLE = DeclaredNotice(
    "SC-341",
    "warning",
    "The pole z = {pole_z:.4g} changes its sign with every sample.",
    effect="It is no motion of a sensor but a product of noise or of too high an order.",
    remedy="Use a lower order.",
    link="steps.md",
)
POLE_ABOVE_NYQUIST = DeclaredNotice(
    "SC-342",
    "warning",
    "The pole at {pole_hz:.4g} Hz lies above half the sampling rate of {rate_hz:.6g} Hz.",
    effect="The samples do not show it.",
    remedy="Use a lower order, or a higher sampling rate.",
    link="steps.md",
)
POLE_ZERO_CANCELLATION = DeclaredNotice(
    "SC-343",
    "note",
    "A zero lies {distance_percent:.2g} % from the pole, and the two nearly cancel.",
    effect="The order may be too high.",
    remedy="Compare with a model of lower order.",
    link="steps.md",
)
FIGURES_WITHOUT_U = DeclaredNotice(
    "SC-344",
    "warning",
    "Within {reach_sigmas:g} standard uncertainties of the model some figures may not exist: {figures}.",
    effect="They have no U.",
    remedy="A more certain model determines whether they exist.",
    link="steps.md",
)
FIGURES_NOT_LINEAR = DeclaredNotice(
    "SC-345",
    "note",
    "Within {reach_sigmas:g} standard uncertainties of the model some figures do not change linearly: {figures}.",
    effect="Their U is increased to include these ranges.",
    link="steps.md",
)
