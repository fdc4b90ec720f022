"""Notices of models of a sensor: poles, identification, releases, decoupling, cross-beam element."""

from __future__ import annotations

from shakercal._common.notices import DeclaredNotice

# Doubtful poles, and figures that do not change linearly.

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

# Identification of structures and sensors.

RESIDUAL_NOISE = DeclaredNotice(
    "SC-350",
    "note",
    "The measured curves deviate from the model by {factor:.2g} times their stated noise.",
    effect="The uncertainties are enlarged by this factor.",
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

# Releases: reading, step models, load models.

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
LAG_NOT_ATTRIBUTED = DeclaredNotice(
    "SC-860",
    "warning",
    "The record does not show whether the chain of the output lags by {low_us:.3g} or {high_us:.3g} µs.",
    effect="The rest is a slower release. Bands, overshoot, rise time and phase depend on it; U includes both.",
    remedy="State the response of the output's channel, measure the force, or add releases by a much faster device.",
    link="steps.md",
)
STATED_LAG_CONTRADICTED = DeclaredNotice(
    "SC-862",
    "warning",
    "The record contradicts a lag of {stated_us:.3g} µs, which the stated response of the output's channel has.",
    effect="The stated lag is not used. The sensor may have a further lag, or the release another shape.",
    remedy="Check that `response` describes the whole chain of the channel.",
    link="steps.md",
)
AMPLITUDE_DEPENDENT = DeclaredNotice(
    "SC-861",
    "warning",
    "The mode at {frequency_hz:.5g} Hz depends on its amplitude: towards the first swing of {amplitude:.3g} {unit}, its"
    " frequency changes by {frequency_percent:+.2g} % and its damping ratio by {damping_percent:+.2g} %.",
    effect="The model is linear. U of frequency and damping ratio covers swings up to the first, not larger ones.",
    remedy="Use releases as large as the loads to be measured. Check the mounting for friction and loose joints.",
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
    link="steps.md",
)
ONSET_UNCERTAIN = DeclaredNotice(
    "SC-380",
    "note",
    "The onset has a standard uncertainty of {u_onset_s:.1g} s.",
    effect="The phases of the residues are equally uncertain; poles and static gain do not depend on it.",
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
    link="load.md",
)
TWO_MASSES_SUFFICIENT = DeclaredNotice(
    "SC-385",
    "note",
    "Two masses with a rigid load explain the resonances.",
    effect="Two masses miss the resonance by {two_percent:.2g} % with {two_load}, "
    "three by {three_percent:.2g} % with {three_load}.",
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
LOADS_AMPLITUDE_DEPENDENT = DeclaredNotice(
    "SC-882",
    "warning",
    "From the largest amplitude to {share_percent:.0f} % of it, the resonance changes by {f_percent:+.2g} % and the "
    "damping ratio by {zeta_percent:+.2g} %.",
    effect="The spring softens, or there is friction. U includes the linear models within this range of amplitude.",
    remedy="Use the model within this range, or record smaller loads.",
    link="load.md",
)
LOSS_FACTOR = DeclaredNotice(
    "SC-883",
    "warning",
    "A constant loss factor explains the damping better than dampers: χ² {chi2:.3g} instead of {viscous:.3g}, {dof} "
    "degrees of freedom.",
    effect="The dampers depend on frequency. U includes their values from {low_hz:.4g} Hz to {high_hz:.4g} Hz.",
    remedy="Use the model within this range of resonances.",
    link="load.md",
)

# Models with common poles for decoupling.

RELEASE_TOO_SLOW = DeclaredNotice(
    "SC-392",
    "warning",
    "No release is shorter than a period of the modes at {frequencies} Hz.",
    effect="The effect of this load on these modes may deviate by more than U.",
    remedy="Use a faster release.",
    link="decoupling.md",
)
SINGLE_RELEASE = DeclaredNotice(
    "SC-393",
    "note",
    "There is only one release of {component}.",
    effect="The difference between releases is not included in U.",
    remedy="Record a second release.",
    link="decoupling.md",
    possible_size="not known from one release",
)
RELEASE_SIZE_SCATTER = DeclaredNotice(
    "SC-394",
    "note",
    "The sizes of the {count} releases scatter by {scatter_percent:.2g} %.",
    effect="U includes this scatter.",
    link="decoupling.md",
)
RELEASE_SHAPE_MISFIT = DeclaredNotice(
    "SC-395",
    "warning",
    "The residual of the model is {factor:.1f} times the noise of {channel}.",
    effect="The time course of the load may be none of the fitted shapes.",
    remedy="Use another release device, or check the record for disturbances.",
    link="decoupling.md",
)
RELEASE_MODEL_REJECTED = DeclaredNotice(
    "SC-925",
    "warning",
    "The records refute the model: its residual is up to {factor:.1f} times the noise at rest.",
    effect="Poles, residues and cross-talk have no U. The load may have had another time course than those fitted, "
    "or springs and dampers may not be linear.",
    remedy="Compare releases of two sizes, use another release device, or check the records for disturbances.",
    link="decoupling.md",
)
DURATION_AMBIGUOUS = DeclaredNotice(
    "SC-396",
    "warning",
    "Release {record} may have lasted {duration_ms:.3g} ms or {other_ms:.3g} ms (χ² differs by {difference:.1f}).",
    effect="The records do not distinguish both durations; U includes both.",
    remedy="Record a release of another duration.",
    link="decoupling.md",
)
DURATION_UNLIKELY = DeclaredNotice(
    "SC-397",
    "note",
    "Release {record} lasted {duration_ms:.3g} ms, or less likely {other_ms:.3g} ms (χ² differs by {difference:.1f}).",
    effect="U includes both durations.",
    remedy="Record a release of another duration.",
    link="decoupling.md",
)
RELEASE_SHAPE_AMBIGUOUS = DeclaredNotice(
    "SC-880",
    "note",
    "The releases of {loads} may have had the shape {shape} or {other} (χ² differs by {difference:.1f}).",
    effect="The records do not distinguish both shapes; U includes both.",
    remedy="Record releases of another duration.",
    link="decoupling.md",
)
LAG_OR_RELEASE = DeclaredNotice(
    "SC-881",
    "warning",
    "The sensor may have the lag {lag_us:.4g} µs or {other_us:.4g} µs (χ² differs by {difference:.1f}).",
    effect="An exponential release acts like a lag; the records do not show which one the sensor has. U includes both.",
    remedy="Record releases of another duration, or measure the force.",
    link="decoupling.md",
)

# Models of the cross-beam element.

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
