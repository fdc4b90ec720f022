"""Notices of the stage that identifies structures and sensors."""

from __future__ import annotations

from shakercal._common.notices import DeclaredNotice

RESIDUAL_NOISE = DeclaredNotice(
    "SC-350",
    "note",
    "The measured curves deviate from the model by {factor:.2g} times their stated noise.",
    effect="The uncertainties are enlarged by this factor.",
    remedy="",
    link="identify.md",
)
MODEL_MISFIT = DeclaredNotice(
    "SC-351",
    "warning",
    "The measured curves deviate from the model by {factor:.2g} times their stated noise.",
    effect="The uncertainties are enlarged by this factor, but the parameters depend on the selection of lines.",
    remedy="Check the model and the stated parts of the load, or restrict the band.",
    link="identify.md",
)
FIT_UNSETTLED = DeclaredNotice(
    "SC-352",
    "warning",
    "The fit ended {distance:.2g} standard uncertainties before its minimum.",
    effect="The parameters deviate from the best ones by about this distance.",
    remedy="State known parameters, or fit fewer components.",
    link="identify.md",
)
FIT_NOT_CONVERGED = DeclaredNotice(
    "SC-353",
    "warning",
    "The fit of {model} did not converge.",
    effect="The data may not determine some of its parameters; these may be wrong.",
    remedy="State known parameters, or fit a simpler model.",
    link="identify.md",
)
INERTIA_UNDETERMINED = DeclaredNotice(
    "SC-354",
    "warning",
    "The data do not determine the {parameter} (u = {u:.2g} {unit}).",
    effect="Parameters that depend on it are undetermined too.",
    remedy="Record loads that differ more, or state its value.",
    link="identify.md",
)
STIFFNESS_UNDETERMINED = DeclaredNotice(
    "SC-355",
    "warning",
    "The data do not determine the {parameter} (u = {u:.2g} {unit}).",
    effect="The resonance of this spring is not observed, or the masses are undetermined.",
    remedy="Record a band that contains its resonance, or state the masses.",
    link="identify.md",
)
DAMPING_UNDETERMINED = DeclaredNotice(
    "SC-356",
    "warning",
    "The data do not determine the {parameter} (u = {u:.2g} {unit}).",
    effect="The decay and the time constant b/k of this spring are undetermined.",
    remedy="Record lines closer to its resonance.",
    link="identify.md",
)
NEGATIVE_WITHIN_U = DeclaredNotice(
    "SC-357",
    "note",
    "The {parameter} is {value:.4g} ± {u:.2g} {unit} (k = 1), zero within its uncertainty.",
    effect="The value is negative by chance.",
    remedy="",
    link="identify.md",
)
NEGATIVE_INERTIA = DeclaredNotice(
    "SC-358",
    "warning",
    "The {parameter} is {value:.4g} ± {u:.2g} {unit} (k = 1), significantly below zero.",
    effect="The resonances belong to another motion than the assumed one, e.g. pitching or a compliant mount.",
    remedy="Fit another structure, or exclude these resonances from the band.",
    link="identify.md",
)
NEGATIVE_DAMPING = DeclaredNotice(
    "SC-359",
    "warning",
    "The {parameter} is {value:.4g} ± {u:.2g} {unit} (k = 1), significantly below zero.",
    effect="A delay or a mode outside the model rotates the phase at the resonance.",
    remedy="Fit the delay of the channel, or include the mode in the structure.",
    link="identify.md",
)
STATED_VALUE_UNCHANGED = DeclaredNotice(
    "SC-360",
    "note",
    "The {parameter} stays as stated, {value:.6g} ± {u:.2g} {unit}.",
    effect="The data do not improve it.",
    remedy="",
    link="identify.md",
)
STATED_VALUE_CONTRADICTED = DeclaredNotice(
    "SC-361",
    "warning",
    "The stated {parameter}, {value:.6g} ± {u:.2g} {unit}, is contradicted by the recordings ({estimate:.6g} {unit}).",
    effect="The estimate from both is {deviation:.2g} standard deviations from the stated value.",
    remedy="Check the stated value and its uncertainty.",
    link="identify.md",
)
STATED_ERROR_TOO_SMALL = DeclaredNotice(
    "SC-362",
    "warning",
    "The fit requires {cause} to deviate by {deviation:.2g} times its stated standard uncertainty.",
    effect="Its uncertainty may be stated too small.",
    remedy="Check the statement of this influence.",
    link="identify.md",
)
OUTPUT_LEADS = DeclaredNotice(
    "SC-363",
    "warning",
    "The output leads the force by {lead_us:.4g} ± {expanded_us:.2g} µs (k = 2).",
    effect="No measuring chain has a negative delay; the reference is late.",
    remedy="Check the stated delays of the channels.",
    link="identify.md",
)
SIGNAL_ABOVE_BAND = DeclaredNotice(
    "SC-364",
    "warning",
    "The output contains {rms:.3g} {unit} rms above {band_hz:g} Hz.",
    effect="This part is removed and not corrected.",
    remedy="Use a wider band if the sensor model is valid there.",
    link="identify.md",
)
