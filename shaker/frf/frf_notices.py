"""Notices of transfer-function measurements: hits, periods, estimators and resolution."""

from __future__ import annotations

from shakercal._common.notices import DeclaredNotice

HIT_WITHOUT_WINDOW = DeclaredNotice(
    "SC-320",
    "warning",
    "Hit {number} at {time_s:.6g} s is rejected because the record ends before its window does.",
    effect="The transfer function uses the other hits.",
    remedy="Stop the recording later, or use a shorter window.",
    link="transfer.md",
)
HIT_OVERLOADED = DeclaredNotice(
    "SC-321",
    "warning",
    "Hit {number} at {time_s:.6g} s is rejected because a channel is overloaded.",
    effect="The transfer function uses the other hits.",
    remedy="Increase the range of the channel, or hit more softly.",
    link="transfer.md",
)
HIT_REPEATED = DeclaredNotice(
    "SC-322",
    "warning",
    "Hit {number} at {time_s:.6g} s is rejected because a second pulse follows {samples} samples later.",
    effect="The transfer function uses the other hits.",
    remedy="Avoid rebounds of the hammer.",
    link="transfer.md",
)
EXPONENTIAL_WINDOW = DeclaredNotice(
    "SC-323",
    "note",
    "The responses have an exponential window exp(-{decay_per_s:.6g}/s·t).",
    effect="The transfer function is H(a + jω); fits correct for the window.",
    remedy="A longer window needs less added decay.",
    link="transfer.md",
)
SINGLE_HIT = DeclaredNotice(
    "SC-324",
    "warning",
    "Only one hit is valid.",
    effect="The uncertainty is that of the noise before the hit.",
    remedy="Record at least five hits.",
    link="transfer.md",
)
SINGLE_HIT_WITHOUT_NOISE = DeclaredNotice(
    "SC-325",
    "warning",
    "Only one hit is valid, and there are too few samples before it to estimate the noise.",
    effect="The transfer function has no uncertainty.",
    remedy="Record at least five hits, or use a longer `pretrigger_s`.",
    link="transfer.md",
)
NARROW_PEAKS = DeclaredNotice(
    "SC-326",
    "warning",
    "The resonance at {frequencies} Hz has a half-power width of only {width_lines:.2g} lines.",
    effect="{cause} lowers and widens such a peak.",
    remedy="Use lines {spacing_hz:.2g} Hz apart.",
    link="transfer.md",
)
PERIODIC_ESTIMATE = DeclaredNotice(
    "SC-327",
    "note",
    "The transfer function at {lines} lines is the ratio of means over {periods} periods of {period_s:.9g} s (relative "
    "standard uncertainty {u_relative:.1e}).",
    effect="It has no leakage and no bias by noise on either channel.",
    link="transfer.md",
)
EXCITATION_AMPLITUDE_CHANGES = DeclaredNotice(
    "SC-328",
    "note",
    "The amplitude of the excitation changes by {change_percent:.2g} % between periods.",
    effect="The transfer function is not affected.",
    link="transfer.md",
)
NOT_SETTLED = DeclaredNotice(
    "SC-329",
    "warning",
    "The first period differs from the others between {low_hz:.6g} and {high_hz:.6g} Hz, by up to "
    "{difference_percent:.2g} % of the response.",
    effect="The structure had not settled.",
    remedy="Skip one more period (`settle_periods`).",
    link="transfer.md",
)
RESPONSE_DRIFTS = DeclaredNotice(
    "SC-330",
    "warning",
    "The transfer function drifts over the periods between {low_hz:.6g} and {high_hz:.6g} Hz.",
    effect="The result is the mean over the periods.",
    remedy="Wait for a constant temperature, and check the mounting.",
    link="transfer.md",
)
NONLINEAR_DISTORTIONS = DeclaredNotice(
    "SC-331",
    "warning",
    "Lines that are not excited show non-linear distortions: {levels}, relative to the excited lines.",
    effect="The transfer function depends on the amplitude.",
    remedy="Use a smaller amplitude, and check for loose or touching parts.",
    link="transfer.md",
)
ESTIMATOR_REQUESTED = DeclaredNotice(
    "SC-332",
    "note",
    "The estimator is {estimator} of {averaged}, as requested.",
    link="transfer.md",
)
ESTIMATOR_H1 = DeclaredNotice(
    "SC-333",
    "note",
    "The estimator is {estimator} of {averaged}.",
    effect="Noise on {reference} biases it by less than its uncertainty.",
    link="transfer.md",
)
ESTIMATOR_H2 = DeclaredNotice(
    "SC-334",
    "note",
    "The estimator is {estimator} of {averaged}.",
    effect="The noise is mainly on {reference}, little on the responses.",
    link="transfer.md",
)
ESTIMATOR_HV = DeclaredNotice(
    "SC-335",
    "note",
    "The estimator is {estimator} of {averaged}.",
    effect="The noise is on {reference} and on the responses, with powers in the ratio 1 : {noise_ratio:.3g}.",
    link="transfer.md",
)
ESTIMATOR_FEW_HITS = DeclaredNotice(
    "SC-336",
    "note",
    "The estimator is {estimator} of {averaged}, because fewer than {enough} hits do not show where the noise is.",
    effect="The force window removes most of the noise on the force.",
    link="transfer.md",
)
