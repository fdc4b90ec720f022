"""Notices and errors of frequency responses (`shakercal transfer`, `identify`)."""

from shakercal._common.notices import DeclaredNotice

# `shakercal transfer`, also of commands that align channels.


MISSING_TRANSFER_ENTRY = DeclaredNotice(
    "SC-685",
    "error",
    "expected {expected}, found none",
    effect="The transfer functions cannot be estimated.",
    remedy="Add it to `[excitation]` of recording.toml.",
    link="transfer.md",
)
WRONG_CHANNEL_NAME = DeclaredNotice(
    "SC-686",
    "error",
    'expected {expected}, found "{found}"',
    remedy="Correct the name, or rename the channel.",
    link="transfer.md",
)
PERIOD_WITHOUT_SIGNAL = DeclaredNotice(
    "SC-691",
    "error",
    "expected the period with which the excitation repeats, found {found_s:g} s, at whose harmonics {channel} contains "
    "only noise",
    remedy="Correct `period`.",
    link="transfer.md",
)
BAND_ABOVE_LIMIT = DeclaredNotice(
    "SC-692",
    "error",
    "expected a band that begins below {limit_hz:.6g} Hz, the limit of the slowest channel, found {low_hz:g} to "
    "{high_hz:g} Hz",
    remedy="Correct `band`, or leave out the slowest channel.",
    link="transfer.md",
)
CHIRP_WITHOUT_PERIOD = DeclaredNotice(
    "SC-693",
    "warning",
    "No period of the chirp is stated, so it is evaluated as noise.",
    effect="The uncertainty is estimated from neighbouring lines.",
    remedy="State `period` if the chirp repeats.",
    link="transfer.md",
)
NOT_FROM_REST = DeclaredNotice(
    "SC-697",
    "error",
    "expected a record that begins and ends at rest, found motion of {percent:.2g} % of its largest level at the {end}",
    effect="Only records from rest to rest are joined as repeats.",
    remedy="Start the record earlier or stop it later. State `period` for an excitation that repeats in one file.",
    link="transfer.md",
)
PEAK_NOT_FITTED = DeclaredNotice(
    "SC-694",
    "note",
    "No oscillator was fitted to the peak at {frequency_hz:.6g} Hz ({reason}).",
    effect="The resonance is not reported.",
    link="transfer.md",
)
PEAK_DEPARTS = DeclaredNotice(
    "SC-695",
    "warning",
    "The peak at {frequency_hz:.6g} Hz deviates from one linear oscillator by {ratio:.2g} times the noise.",
    effect="The data refute the model: frequency and damping ratio have no U. The peak may be of two modes, or its "
    "stiffness or damping may change with the amplitude.",
    remedy="Repeat at half the level: a resonance that moves is not linear. Use the joint fit of `shakercal identify`.",
    link="transfer.md",
)
SCALE_UNCERTAINTY_NOT_STATED = DeclaredNotice(
    "SC-696",
    "warning",
    "No uncertainty of the scale is stated for {channels}.",
    effect="U does not include the scale of these channels.",
    remedy="State `scale_uncertainty`.",
    link="transfer.md",
)
RESONANCE_LOSS_FACTOR = DeclaredNotice(
    "SC-897",
    "note",
    "The damping at {frequency_hz:.6g} Hz follows a loss factor η = 2ζ rather than a damper.",
    effect="f₀ is √(k/m)/2π with this damping.",
    link="transfer.md",
)
LAW_UNDECIDED = DeclaredNotice(
    "SC-898",
    "note",
    "The curve does not show whether the damping at {frequency_hz:.6g} Hz is viscous or a loss factor.",
    effect="The values are those of viscous damping. U covers both: f₀ differs by the share {share:.2g}.",
    remedy="Record more lines below the resonance, with less noise.",
    link="transfer.md",
)


# `shakercal identify`.


NO_TRANSFER_RECORDING = DeclaredNotice(
    "SC-640",
    "error",
    "expected a recording of the kind {expected}, found only {found}",
    effect="Without a transfer function, stiffness and damping cannot be determined.",
    remedy="Add a recording with broadband excitation.",
    link="identify.md",
)
DIFFERENT_SENSOR = DeclaredNotice(
    "SC-641",
    "error",
    'expected "{expected}", the sensor of {file}, found "{found}"',
    effect="Recordings of different sensors cannot be evaluated together.",
    remedy="Select recordings of one sensor, or correct its name or serial number.",
    link="identify.md",
)
OUTDATED_SINE_RESULTS = DeclaredNotice(
    "SC-642",
    "error",
    "expected the results of these input files, found results of other input files",
    remedy="Run `shakercal run` on this recording again.",
    link="identify.md",
)
MISSING_MOTION_CHANNEL = DeclaredNotice(
    "SC-643",
    "error",
    'expected a {expected} with body = "{body}", found {found}',
    effect="The motion of the load over that of the base cannot be determined.",
    remedy="Name such a channel, and state its `body`.",
    link="identify.md",
)
REFERENCE_ACROSS_DRIVE = DeclaredNotice(
    "SC-644",
    "error",
    'expected a motion along the excitation, found "{found}", which measures perpendicular to excitation.direction',
    remedy="Select another reference, or correct its direction.",
    link="identify.md",
)
MISSING_IDENTIFICATION_ENTRY = DeclaredNotice(
    "SC-645",
    "error",
    "expected {expected}, found none",
    effect="The model of the sensor depends on it.",
    remedy="Add it to the file.",
    link="identify.md",
)
BAND_WITHOUT_LINES = DeclaredNotice(
    "SC-646",
    "error",
    "expected a --band with lines between {first_hz:.6g} and {last_hz:.6g} Hz, found {low_hz:g} to {high_hz:g} Hz",
    remedy="Select another band.",
    link="identify.md",
)
PITCHING_NOT_DRIVEN = DeclaredNotice(
    "SC-647",
    "error",
    "expected a drive along or about x or y for --model pitching, found {found}",
    effect="Other drives do not couple translation and rotation of the load.",
    remedy="Select another model.",
    link="identify.md",
)
EQUAL_LOAD_MASSES = DeclaredNotice(
    "SC-648",
    "error",
    "expected load masses that differ, found one of {load:.6g} {unit} in {recordings}",
    effect="With one load mass, the internal mass and the stiffness cannot be separated.",
    remedy="Add a recording with another load mass, or use `--internal-mass stated`.",
    link="identify.md",
)
NO_MODEL_FITTED = DeclaredNotice(
    "SC-649",
    "error",
    "no model was fitted to {recordings} ({reason})",
    effect="Stiffness and damping are not determined.",
    remedy="Select the lines of one resonance with `--band`.",
    link="identify.md",
)
STIFFNESS_NOT_DETERMINED = DeclaredNotice(
    "SC-650",
    "error",
    "the recordings do not determine stiffness, damping or internal mass of {component}",
    remedy="Add a recording with another load mass, or use `--internal-mass stated`.",
    link="identify.md",
)
SINES_NOT_EVALUATED = DeclaredNotice(
    "SC-651",
    "note",
    "Recordings of sines without results of `shakercal run`: {count}.",
    effect="Their sensitivity is not used.",
    remedy="Run `shakercal run` on them first.",
    link="identify.md",
)
REFERENCES_NOT_USED = DeclaredNotice(
    "SC-652",
    "note",
    "Of several references {used} is used, and {unused} is not used.",
    link="identify.md",
)
ELASTIC_LOAD = DeclaredNotice(
    "SC-653",
    "note",
    "The load is not rigid; stated are {stated}.",
    effect="The joint model includes them. Readings of single curves treat the load as rigid.",
    link="identify.md",
)
SECOND_PEAK_NOT_EXPLAINED = DeclaredNotice(
    "SC-654",
    "warning",
    "The model of one translation does not explain the second peak.",
    effect="Stiffness, damping and internal mass may be wrong.",
    remedy="Use `--model adapter` or `--model pitching`, or select one resonance with `--band`.",
    link="identify.md",
)
PEAK_NOT_READ = DeclaredNotice(
    "SC-655",
    "note",
    "No peak was read from the curve ({reason}).",
    effect="The table of readings has no row of this curve; the joint fit uses it.",
    link="identify.md",
)
NO_BAND_OF_PITCHING_LOAD = DeclaredNotice(
    "SC-656",
    "note",
    "No usable band is reported for a load that pitches.",
    effect="Its band depends on the point at which the force acts, and not only on its mass.",
    link="identify.md",
)
SENSITIVITY_EXPLANATION = DeclaredNotice(
    "SC-657",
    "note",
    "The sensitivity over frequency supports {supported}, and contradicts {contradicted}.",
    effect="The model of the sensor uses the explanation of the largest weight, among the supported ones if there are "
    "any.",
    link="identify.md",
)
DAMPING_AGREES = DeclaredNotice(
    "SC-658",
    "note",
    "Sensitivity and resonance agree on b/k: {needed_us:.3g} µs and {resonance_us:.3g} µs, normalised deviation "
    "{deviation:.1f}.",
    effect="The sensitivity over frequency requires no other damping than that of the resonance.",
    link="identify.md",
)
DAMPING_CONTRADICTED = DeclaredNotice(
    "SC-659",
    "warning",
    "Sensitivity and resonance contradict each other on b/k: {needed_us:.3g} µs and {resonance_us:.3g} µs, normalised "
    "deviation {deviation:.1f}.",
    effect="The damper of the sensor alone does not explain the sensitivity over frequency.",
    remedy="Check the measuring chain for a lag, a filter or a delay that is not stated.",
    link="identify.md",
)
SENSITIVITY_NOT_EXPLAINED = DeclaredNotice(
    "SC-660",
    "warning",
    "The sensitivity of {channel} over frequency was not explained ({reason}).",
    effect="The model has no measuring chain, and the static sensitivity of rig.toml or one output per force.",
    link="identify.md",
)
SENSITIVITY_NOT_MEASURED = DeclaredNotice(
    "SC-661",
    "note",
    "No sensitivity over frequency was evaluated for {component}.",
    effect="The model has {sensitivity} and no measuring chain.",
    remedy="Run `shakercal run` on sines of at least {fewest} frequencies.",
    link="identify.md",
)
MODEL_REJECTED = DeclaredNotice(
    "SC-890",
    "warning",
    "The data refute every model that was tried; {model} leaves residuals of {factor:.3g} times their noise.",
    effect="Its values have no U.",
    remedy="Check the mounting, the stated parts of the load and the measuring chains, or restrict the band.",
    link="identify.md#rival-models",
)
UNSTATED_FILTER_FOUND = DeclaredNotice(
    "SC-891",
    "warning",
    "The chain of {channel} has a delay or filter that is not stated: {lag_us:+.3g} µs at low frequencies, "
    "{change_percent:+.2g} % of the magnitude at {frequency_hz:.4g} Hz.",
    effect="{consequence}",
    remedy="State `delay` or `response` of this channel.",
    link="identify.md#rival-models",
)
LOSS_FACTOR_FOUND = DeclaredNotice(
    "SC-892",
    "note",
    "The damping follows a loss factor rather than a damper (Akaike's criterion differs by {difference:.3g}).",
    effect="b is given for {frequency_hz:.5g} Hz; at other frequencies it changes as 1/f.",
    link="identify.md#rival-models",
)
DAMPING_DIFFERS = DeclaredNotice(
    "SC-893",
    "warning",
    "The recordings have different dampings, from {lowest:.4g} to {highest:.4g} {unit}.",
    effect="Each recording has a separate damping. The model has their mean, and its U includes their scatter.",
    remedy="Check the joints of the loads, and whether the damping changes with the amplitude.",
    link="identify.md#rival-models",
)
MODELS_UNDECIDED = DeclaredNotice(
    "SC-894",
    "warning",
    "The data do not decide between these models: {models}.",
    effect="The values are those of the first one; U covers those of the others.",
    remedy="Record another load mass, or state what is known of mounting and chains.",
    link="identify.md#rival-models",
)
COMPLIANT_MOUNT_FOUND = DeclaredNotice(
    "SC-895",
    "warning",
    "The mount between base accelerometer and sensor gives: its stiffness is {ratio:.3g} times that of the sensor.",
    effect="Mount and sensor are fitted as two springs.",
    remedy="Measure the base at the foot of the sensor.",
    link="identify.md#rival-models",
)
MOUNT_TREATED_AS_RIGID = DeclaredNotice(
    "SC-896",
    "note",
    "The mount between base accelerometer and sensor is treated as rigid, because the data show no other.",
    effect="k is the stiffness between the measured motions of base and load.",
    remedy="Measure the base at the foot of the sensor.",
    link="identify.md#rival-models",
    possible_size="k too low by the share k/k_mount, 9 % for a light mount ten times as stiff as the sensor",
)
CHANGES_WITH_AMPLITUDE = DeclaredNotice(
    "SC-899",
    "warning",
    "Stiffness and damping change with the amplitude, by {stiffness_percent:+.2g} % and {damping_percent:+.2g} % over "
    "{range}.",
    effect="Spring and damper are not linear. U covers linear models within this range of amplitude, not beyond it.",
    remedy="Record at the level of the later use.",
    link="identify.md#rival-models",
)
