"""Notices of signals: sine approximation, lines, triggers and clocks, transfer functions."""

from __future__ import annotations

from shakercal._common.notices import DeclaredNotice

# Sine approximation.

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

# Lines of a recording.

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

# Trigger model and clock ties.

CONTRADICTORY_PERIOD = DeclaredNotice(
    "SC-310",
    "warning",
    "The trigger period from the frames or from other records is {relative_difference:.2g} (relative) {direction} than "
    "that of the edges, with a standard uncertainty of {u_relative:.2g}.",
    effect="The period of the edges is used.",
    remedy="Check for missing frames or edges, and whether the lines belong to the observed motion.",
    link="clocks.md",
)
MISSING_EDGES = DeclaredNotice(
    "SC-311",
    "warning",
    "{missing} edges are missing (numbers {numbers}).",
    effect="The other edges are numbered by their period.",
    remedy="Check the trigger signal and its threshold.",
    link="clocks.md",
)
DOUBLED_EDGES = DeclaredNotice(
    "SC-312",
    "warning",
    "{doubled} doubled edges are rejected.",
    effect="The nearest edge of each group is used.",
    remedy="Check the trigger line for bouncing or reflections.",
    link="clocks.md",
)
STRAY_EDGES = DeclaredNotice(
    "SC-313",
    "warning",
    "{stray} edges off the period of {period_s:.6g} s are rejected.",
    effect="The remaining edges are used.",
    remedy="Check the trigger line for interference.",
    link="clocks.md",
)
TRIGGER_JITTER = DeclaredNotice(
    "SC-314",
    "warning",
    "The edges jitter by {jitter_us:.3g} µs, more than 0.1 % of the period.",
    effect="The uncertainty of the frame times includes the jitter.",
    remedy="Use a trigger source with less jitter.",
    link="clocks.md",
)
EXTERNAL_PERIOD = DeclaredNotice(
    "SC-315",
    "note",
    "The trigger period is taken from the frames or from other records, because the edges do not determine it.",
    effect="Its relative standard uncertainty is {u_relative:.2g}.",
    link="clocks.md",
)
LOCKED_EDGES = DeclaredNotice(
    "SC-316",
    "note",
    "The edges always have the same phases between two samples.",
    effect="Their instants have a standard uncertainty of {u_us:.2g} µs.",
    remedy="Use a trigger period that is no simple multiple of the sampling interval.",
    link="clocks.md",
)
CONTRADICTORY_CLOCK_RATE = DeclaredNotice(
    "SC-317",
    "warning",
    "The lines of the record are {relative_difference:.2g} (relative) {direction} than the trigger edges predict, "
    "with a standard uncertainty of {u_relative:.2g}.",
    effect="The clock rate of the edges is used.",
    remedy="Check the edges, and whether the same excitation drove both records.",
    link="clocks.md",
)
START_TIMES_DISAGREE = DeclaredNotice(
    "SC-318",
    "note",
    "The start times put edge 0 at edge {start_time_edge} of the first clock, but {evidence} put it at {used_edge}.",
    effect="Edge {used_edge} is used.",
    remedy="State `first_edge` if that is wrong.",
    link="clocks.md",
)

# Transfer functions.

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

# Transfer functions from records that begin and end at rest.

REST_ESTIMATE = DeclaredNotice(
    "SC-337",
    "note",
    "The transfer function at {lines} lines {spacing_hz:.6g} Hz apart is estimated from {repeats} repeats in {records} "
    "records, each from rest to rest.",
    effect="It has no leakage and no bias by noise on either channel.",
    link="transfer.md",
)
SINGLE_REPEAT = DeclaredNotice(
    "SC-338",
    "warning",
    "There is one record from rest to rest only.",
    effect="U includes the noise at rest, but not the repeatability of the measurement.",
    remedy="Record at least three repeats, and name their files in `repeats`.",
    link="transfer.md",
)
REPEATS_DIFFER = DeclaredNotice(
    "SC-902",
    "warning",
    "Between {low_hz:.6g} and {high_hz:.6g} Hz the repeats scatter by {percent:.2g} %, {times:.2g} times their noise.",
    effect="U includes this scatter. The result is the mean of the repeats.",
    remedy="Check mounting, cables and temperature.",
    link="transfer.md",
)
AMPLITUDE_DEPENDENCE = DeclaredNotice(
    "SC-909",
    "warning",
    "Between {low_hz:.6g} and {high_hz:.6g} Hz repeats whose levels differ by a factor of {factor:.3g} scatter by "
    "{percent:.2g} %, {times:.2g} times their noise.",
    effect="The structure may depend on the amplitude. U includes the scatter. The result is the mean of the repeats.",
    remedy="Evaluate each level by itself, and check for loose or touching parts.",
    link="transfer.md",
)
RINGS_AT_END = DeclaredNotice(
    "SC-339",
    "warning",
    "The signal still moves at {frequency_hz:.4g} Hz at the {end} of the record.",
    effect="Lines near this frequency may be wrong by {share_percent:.2g} %, which U does not include.",
    remedy="Start the record earlier or stop it later, so that the signal is at rest.",
    link="transfer.md",
)
EVALUATED_AS_NOISE = DeclaredNotice(
    "SC-698",
    "warning",
    "The chirp is evaluated as noise, because the signal moves at {percent:.2g} % of its largest level at the {end} of "
    "the record.",
    effect="Lines are coarser. The uncertainty is estimated from neighbouring lines.",
    remedy="Record from rest to rest, or state `period` if the chirp repeats.",
    link="transfer.md",
)
