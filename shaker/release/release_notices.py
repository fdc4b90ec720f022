"""Notices of the stages that evaluate releases: reading, step models, load models."""

from __future__ import annotations

from shakercal._common.notices import DeclaredNotice

OUTPUT_AT_LIMIT = DeclaredNotice(
    "SC-365",
    "warning",
    "The output reached its limit and is clipped.",
    effect="Its peaks, its poles and the model are wrong.",
    remedy="Use a larger range of the amplifier, or a smaller load.",
    link="steps.md",
)
OTHER_CHANNEL_TIMES = DeclaredNotice(
    "SC-366",
    "note",
    "The output changes by only {strength:.2g} standard deviations of its noise.",
    effect="It is read at the times of {channel}.",
    remedy="",
    link="steps.md",
)
RELEASE_BY_LINE = DeclaredNotice(
    "SC-367",
    "warning",
    "The release cannot be fitted by modes and a lag.",
    effect="Onset and length follow from a straight line through 10 % and 90 % of the change.",
    remedy="Use a shorter release, or a longer record after it.",
    link="steps.md",
)
RELEASE_MISFIT = DeclaredNotice(
    "SC-368",
    "warning",
    "Around the release, the residual of the fit is {factor:.3g} times the noise at rest.",
    effect="Onset and length are less certain than stated.",
    remedy="Measure the force, or use a release with a simpler time course.",
    link="steps.md",
)
LEVEL_DRIFT = DeclaredNotice(
    "SC-369",
    "warning",
    "The level {stage} drifts by {share:.2g} of the change over its samples.",
    effect="The static gain may be wrong by a part of the drift.",
    remedy="Wait until the output has settled before recording.",
    link="steps.md",
)
FORCE_CONTRADICTS_AMPLITUDE = DeclaredNotice(
    "SC-370",
    "warning",
    "The force changes by {measured:.5g}, but {stated:.5g} is stated.",
    effect="The static gain is relative to the stated change.",
    remedy="Check the stated load and the scale of the force channel.",
    link="steps.md",
)
RELEASE_SHAPE_UNDETERMINED = DeclaredNotice(
    "SC-371",
    "note",
    "The record does not determine whether the release is {alternatives}.",
    effect="Gains between static and resonance depend on it; U includes both.",
    remedy="Measure the force, or use a shorter release.",
    link="steps.md",
)
NO_CONTINUOUS_MODEL = DeclaredNotice(
    "SC-372",
    "warning",
    "The fitted difference equation has no equivalent in continuous time: {reason}.",
    effect="The sampled model is reported instead.",
    remedy="Use the default method, or another sampling rate.",
    link="steps.md",
)
OUTPUT_DIVERGES = DeclaredNotice(
    "SC-373",
    "warning",
    "The output of the model grows without bound.",
    effect="The mean of the measured output is shown instead.",
    remedy="Use the default method.",
    link="steps.md",
)
GROWING_POLE = DeclaredNotice(
    "SC-374",
    "warning",
    "The model has a growing pole at {frequency_hz:.5g} Hz: it is unstable.",
    effect="A sensor has no such pole; the model is wrong at it.",
    remedy="Check the record for drift, or fit fewer poles.",
    link="steps.md",
)
DOUBTFUL_MODE = DeclaredNotice(
    "SC-375",
    "warning",
    "The mode at {frequency_hz:.5g} Hz, ζ = {damping_ratio:.2g} ± {u_damping_ratio:.1g}, may not belong to the sensor.",
    effect="Hum or another disturbance may be fitted as a mode.",
    remedy="Check the record for hum, or state the number of modes.",
    link="steps.md",
)
MODE_NEAR_SAMPLING_LIMIT = DeclaredNotice(
    "SC-376",
    "warning",
    "The mode at {frequency_hz:.5g} Hz is near half the sampling rate of {rate_hz:.6g} Hz.",
    effect="Its parameters are uncertain, and it may be an alias.",
    remedy="Record at a higher sampling rate.",
    link="steps.md",
)
DOUBTFUL_REAL_POLE = DeclaredNotice(
    "SC-377",
    "warning",
    "The record hardly determines the real pole at {frequency_hz:.3g} ± {u_hz:.1g} Hz.",
    effect="The record may not distinguish its lag from the duration of the release.",
    remedy="Use a shorter release, or measure the force.",
    link="steps.md",
)
RESIDUAL_ABOVE_NOISE = DeclaredNotice(
    "SC-378",
    "warning",
    "The residual is {factor:.3g} times the noise before the release.",
    effect="The order of the model is doubtful.",
    remedy="State the number of modes, or check the record for other disturbances.",
    link="steps.md",
)
COLOURED_NOISE = DeclaredNotice(
    "SC-379",
    "note",
    "The noise is coloured.",
    effect="The uncertainty of the poles is {factor:.2g} times as large as for white noise.",
    remedy="",
    link="steps.md",
)
ONSET_UNCERTAIN = DeclaredNotice(
    "SC-380",
    "note",
    "The onset has a standard uncertainty of {u_onset_s:.1g} s.",
    effect="The phases of the residues are equally uncertain; poles and static gain do not depend on it.",
    remedy="",
    link="steps.md",
)
RELEASE_OUTSIDE_SEARCH = DeclaredNotice(
    "SC-381",
    "warning",
    "The release at {middle_s:.6g} s is outside the searched part of the record.",
    effect="Its time and shape are not resolved.",
    remedy="State the onset of the release.",
    link="steps.md",
)
ONSET_CONTRADICTED = DeclaredNotice(
    "SC-382",
    "warning",
    "The onset found, {found_s:.6g} s, differs from the stated one, {stated_s:.6g} s.",
    effect="The phases of the residues depend on it.",
    remedy="Check the stated onset.",
    link="steps.md",
)
SECOND_MODE_EXCLUDED = DeclaredNotice(
    "SC-383",
    "warning",
    "Second modes that no coupling of the load explains are excluded: {modes}.",
    effect="They belong to another motion and do not enter the fit.",
    remedy="Check the fixing of the load.",
    link="load.md",
)
THREE_MASSES = DeclaredNotice(
    "SC-384",
    "note",
    "Three masses are required by {evidence}.",
    effect="Two masses miss the resonance by {two_percent:.2g} % with {two_load}, "
    "three by {three_percent:.2g} % with {three_load}.",
    remedy="",
    link="load.md",
)
TWO_MASSES_SUFFICIENT = DeclaredNotice(
    "SC-385",
    "note",
    "Two masses with a rigid load explain the resonances.",
    effect="Two masses miss the resonance by {two_percent:.2g} % with {two_load}, "
    "three by {three_percent:.2g} % with {three_load}.",
    remedy="",
    link="load.md",
)
TWO_MASSES_ASSUMED = DeclaredNotice(
    "SC-386",
    "note",
    "One resonance of one load does not determine the stiffness of the coupling.",
    effect="The load is assumed to be rigid (two masses).",
    remedy="Record a second load, or the same load with a second mode.",
    link="load.md",
)
AMBIGUOUS_SOLUTIONS = DeclaredNotice(
    "SC-387",
    "warning",
    "The recorded loads do not distinguish {count} solutions: {solutions}.",
    effect="All are reported; without load their resonances would be {unloaded}.",
    remedy="Record another load mass.",
    link="load.md",
)
SERIES_SCATTER = DeclaredNotice(
    "SC-388",
    "warning",
    "The {quantity} scatter about the model by {scatter_percent:.2g} % more than their uncertainties explain.",
    effect="U includes the scatter. The model is fitted to the {quantity}, not to the records.",
    remedy="Check the fixing of the loads and the stated masses.",
    link="load.md",
)
SCATTER_UNCERTAINTY = DeclaredNotice(
    "SC-389",
    "note",
    "No uncertainties of the {quantity} are stated.",
    effect="U follows from their scatter of {scatter_percent:.2g} %.",
    remedy="",
    link="load.md",
)
NO_SERIES_UNCERTAINTY = DeclaredNotice(
    "SC-390",
    "warning",
    "There are neither stated uncertainties nor more resonances than unknowns.",
    effect="No U is available.",
    remedy="State the uncertainties, or record more loads.",
    link="load.md",
)
MASS_CONTRADICTED = DeclaredNotice(
    "SC-391",
    "warning",
    "The resonances require {cause} to deviate by {deviation:+.1f} times its stated standard uncertainty.",
    effect="This mass, or its uncertainty, is stated incorrectly.",
    remedy="Weigh the part again.",
    link="load.md",
)
