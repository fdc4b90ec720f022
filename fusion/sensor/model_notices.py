"""Notices and errors of releases, models and filters (`shakercal step`, `load`, `decouple`, `compensate`)."""

from shakercal._common.notices import DeclaredNotice

# Files of models that commands exchange.


WRONG_MODEL_FORMAT = DeclaredNotice(
    "SC-790",
    "error",
    "expected format {expected}, found format {found}",
    effect="The file was written by another version of the program.",
    remedy="Run {to_repeat} again.",
    link="results.md",
)
DAMAGED_MODEL_FILE = DeclaredNotice(
    "SC-791",
    "error",
    "expected {expected} as written by shakercal {command}, found {found}",
    effect="The file is not used.",
    remedy="Run {to_repeat} again.",
    link="results.md",
)
DAMPING_NOT_LINEAR = DeclaredNotice(
    "SC-920",
    "warning",
    "The damping depends on the amplitude so much that a linear model has no damping ratio (±{percent:.2g} %).",
    effect="Damping ratio, peak gain and settling times are reported without U.",
    remedy="Check the mounting for friction and loose joints, and use releases as large as the loads to be measured.",
    link="steps.md",
)
CHAIN_DELAY_UNKNOWN = DeclaredNotice(
    "SC-921",
    "note",
    "The delay of the output's chain, which a record does not distinguish from a later release: not stated.",
    effect="U of quadrature_hz and of phases excludes it.",
    remedy="State the `response` of the output's channel, with its anti-aliasing filter, or measure the force.",
    possible_size="{shift_hz:.2g} Hz of quadrature_hz for {delay_us:.2g} µs",
    link="steps.md",
)
CHAIN_DELAY_NOT_IN_MODEL = DeclaredNotice(
    "SC-922",
    "warning",
    "The stated response of the output's channel has a delay of {delay_us:.2g} µs that the model does not include.",
    effect="The delay moves quadrature_hz by {shift_hz:.2g} Hz and adds to settling times. These and the rise time are"
    " those of a sensor without the delay, and have no U.",
    remedy="Add the delay where the sensor is used with this chain.",
    link="steps.md",
)
MODEL_COVERAGE = DeclaredNotice(
    "SC-792",
    "note",
    "U of the model applies {scope}.",
    link="uncertainty.md",
)
MODEL_INFLUENCES_NOT_ASSESSED = DeclaredNotice(
    "SC-793",
    "note",
    "U of the model applies {scope} and does not include {outside}.",
    remedy="State these influences in `[model]` of rig.toml.",
    link="uncertainty.md",
    possible_size="not known",
)


# `shakercal load`.


NO_MOVING_MASS = DeclaredNotice(
    "SC-600",
    "error",
    "expected a mass or moment of inertia above 0, found {found:g}",
    effect="A resonance determines only ratios of masses, so the stiffness cannot be determined.",
    remedy="State the mass, or moment of inertia, that moves above the spring of the sensor.",
    link="load.md",
)
COMPONENT_WITHOUT_MOVING_MASS = DeclaredNotice(
    "SC-601",
    "warning",
    "The component is left out because {key} is 0.",
    effect="Its stiffness cannot be determined.",
    remedy="State the mass, or moment of inertia, that moves above the spring of the sensor.",
    link="load.md",
)
MOVING_MASS_NOT_STATED = DeclaredNotice(
    "SC-602",
    "error",
    "expected [sensor] with internal_mass, found none",
    effect="A resonance determines only ratios of masses, so the stiffness cannot be determined.",
    remedy="Add `[sensor]` with `internal_mass` or `internal_inertia` to rig.toml.",
    link="load.md",
)
NO_FREE_OSCILLATION = DeclaredNotice(
    "SC-603",
    "error",
    "the free oscillation after the release cannot be evaluated ({reason})",
    effect="The resonances of this load are not determined.",
    remedy="Check the record of this channel, or leave the recording out.",
    link="load.md",
)
CONTRADICTORY_MOVING_MASS = DeclaredNotice(
    "SC-604",
    "error",
    "expected {expected:g} as in {file}, found {found:g}",
    effect="All recordings are of one sensor, so its moving mass must be stated once.",
    remedy="State the same value in both files.",
    link="load.md",
)
CONTRADICTORY_MODEL_STATEMENT = DeclaredNotice(
    "SC-605",
    "error",
    "expected the same [model] as in {file}, found different values",
    effect="All recordings are of one sensor, so they must state the same model.",
    remedy="State the same values in both files, or state them in one file only.",
    link="load.md",
)
PART_WITHOUT_LOAD = DeclaredNotice(
    "SC-606",
    "error",
    "expected the [load] that the part {part} belongs to, found none",
    effect="The mass on the sensor is not determined.",
    remedy="Add `[load]` to rig.toml, or remove the part.",
    link="load.md",
)
LOAD_TABLE_NOT_READABLE = DeclaredNotice(
    "SC-607",
    "error",
    "expected a table in text, found {reason}",
    remedy="Export the table as CSV with one row per load.",
    link="load.md",
)
TOO_MANY_LOADS = DeclaredNotice(
    "SC-608",
    "error",
    "expected at most {limit} loads, one in each row, found {found} rows",
    remedy="Remove rows, or evaluate the table in parts.",
    link="load.md",
)
LOAD_COLUMN_MISSING = DeclaredNotice(
    "SC-609",
    "error",
    "expected this column and one row for every load, found none",
    remedy="Add the column to the table.",
    link="load.md",
)
UNKNOWN_LOAD_COLUMN = DeclaredNotice(
    "SC-610",
    "error",
    "expected only the columns {expected}, found this column",
    remedy="Rename or remove the column.",
    link="load.md",
)
WRONG_LOAD_NUMBER = DeclaredNotice(
    "SC-611",
    "error",
    "expected {expected}, found {found}",
    remedy="Correct the cell; a value that is not known is an empty cell.",
    link="load.md",
)
EXTRAPOLATED_LOAD = DeclaredNotice(
    "SC-612",
    "warning",
    "The requested load {loads} {unit} exceeds the largest recorded load, {largest:.4g} {unit}.",
    effect="The model is extrapolated, and U does not cover a change of the model beyond the recorded loads.",
    remedy="Record a release with a load of this size.",
    link="load.md",
)
NO_LOAD_MODEL = DeclaredNotice(
    "SC-613",
    "error",
    "no load model was found ({reason})",
    effect="Stiffness and resonance over the load are not determined.",
    remedy="Check the loads and the resonances of the recordings.",
    link="load.md",
)


# `shakercal step`, also of commands that read releases.


DUPLICATE_OUTPUT = DeclaredNotice(
    "SC-662",
    "error",
    'expected one record of every output of the sensor, found "{output}" twice',
    remedy="Rename or remove one of the two channels.",
    link="steps.md",
)
MISSING_STEP_ENTRY = DeclaredNotice(
    "SC-663",
    "error",
    "expected {expected}, found none",
    effect="The release cannot be evaluated.",
    remedy="Add it to recording.toml.",
    link="steps.md",
)
ONSET_OUTSIDE_RECORD = DeclaredNotice(
    "SC-664",
    "error",
    "expected a time within the record, {start_s:.6g} s to {end_s:.6g} s, found {found_s:g} s",
    remedy="Correct `onset`, or remove it.",
    link="steps.md",
)
WRONG_FORCE_CHANNEL = DeclaredNotice(
    "SC-665",
    "error",
    'expected the name of one channel with quantity = "force", found {found}',
    remedy="Correct `force`, or the quantity of the channel.",
    link="steps.md",
)
CHAIN_IN_MODEL = DeclaredNotice(
    "SC-666",
    "warning",
    "The stated response of {channels} is not corrected.",
    effect="The model describes sensor and measuring chain together. `step` uses its lag as that of the whole chain: a"
    " further lag of an amplifier is attributed to the release and is not in U, unless the stated response has no lag.",
    remedy="State the response of the whole chain of the channel.",
    link="steps.md",
)
FILTER_IN_MODEL = DeclaredNotice(
    "SC-667",
    "warning",
    "The delay of {channels} may be that of a low-pass filter, of which only the delay is corrected.",
    effect="The model describes sensor and filter together.",
    remedy='State `delay_of = "pure"` if there is no filter.',
    link="steps.md",
)
DRIVEN_OUTPUT_MISSING = DeclaredNotice(
    "SC-668",
    "error",
    "expected the output {expected}, the component that is driven, found {found}",
    remedy="Record this output, or correct the component of the excitation.",
    link="steps.md",
)
OTHER_DRIVEN_OUTPUT = DeclaredNotice(
    "SC-669",
    "error",
    "expected {expected}, the output that is driven in {recording}, found {found}",
    effect="All releases of a component must drive the same output.",
    remedy="Check the component and the channels of the recording.",
    link="steps.md",
)
DRIVEN_OUTPUT_CLIPPED = DeclaredNotice(
    "SC-670",
    "error",
    "expected an output that was not clipped, found samples at the limit of the range",
    remedy="Record again with a larger range, or a smaller load.",
    link="steps.md",
)
NO_STEP_FOUND = DeclaredNotice(
    "SC-671",
    "error",
    "expected a step in the output that {component} drives, found a change of {change:.2g} {unit}, no more than noise",
    remedy="Check the component of the excitation, and that the record contains the release.",
    link="steps.md",
)
CLIPPED_OUTPUT = DeclaredNotice(
    "SC-672",
    "warning",
    "Output {channel} was clipped and is left out.",
    effect="Its static gain and its spectrum are not reported.",
    remedy="Record again with a larger range.",
    link="steps.md",
)
RELEASE_WITHOUT_MODEL = DeclaredNotice(
    "SC-673",
    "warning",
    "No model of {channel} was found ({reason}).",
    effect="The release does not contribute to the model of the component.",
    link="steps.md",
)
COMPONENT_WITHOUT_MODEL = DeclaredNotice(
    "SC-674",
    "warning",
    "No model of {channel} was found: {reason}.",
    effect="Only readings and static gains are reported for this component.",
    link="steps.md",
    acknowledgeable=False,
)
SHAPE_OF_DEVICE_UNDETERMINED = DeclaredNotice(
    "SC-675",
    "note",
    "Releases by {device} do not determine whether the load changes along {shapes}.",
    effect="U includes the difference.",
    link="steps.md",
)
STRUCTURE_NOT_FOUND = DeclaredNotice(
    "SC-676",
    "warning",
    "No model of {channel} with {structure}, the structure of most releases, was found.",
    effect="The release is left out of the model of the component.",
    link="steps.md",
)
RELEASES_REFITTED = DeclaredNotice(
    "SC-677",
    "note",
    "The releases were fitted again with {structure}, the structure of most releases.",
    link="steps.md",
)
RELEASE_NOT_AVERAGED = DeclaredNotice(
    "SC-870",
    "warning",
    "The model of {channel} by this release is not used: {reason}.",
    effect="The model of the component rests on the other releases.",
    remedy="Look for drift, hum or a second event in this record.",
    link="steps.md",
)
RELEASES_AVERAGED = DeclaredNotice(
    "SC-871",
    "note",
    "The {count} releases differ by more than their noise, and each has a model of its own.",
    effect="The model of the component is the mean of these models, and U includes their scatter.",
    remedy="Compare the models of the releases in `releases.csv`.",
    link="steps.md",
)
METHOD_WITHOUT_MODEL = DeclaredNotice(
    "SC-678",
    "note",
    "The method {method} found no model ({reason}).",
    effect="The table of methods has no row of it.",
    link="steps.md",
)
METHOD_REMARK = DeclaredNotice(
    "SC-679",
    "note",
    "{method}: {remark}",
    effect="It concerns the comparison of methods, not the model of the component.",
    link="steps.md",
)
RELEASES_SELECTED = DeclaredNotice(
    "SC-680",
    "note",
    "The model of {channel} is based on {reason}.",
    effect="The other releases are reported, but not used for the model.",
    link="steps.md",
)
NO_REAL_POLE = DeclaredNotice(
    "SC-681",
    "note",
    "No release shows a real pole in addition to the modes of {channel}.",
    effect="A lag of amplifier or filter looks like a later onset and would move the bands by more than their U.",
    remedy="Use `--real-poles 1` to include such a lag.",
    link="steps.md",
)
GAIN_NOT_STATED = DeclaredNotice(
    "SC-682",
    "note",
    "rig.toml states no static_sensitivity of this component.",
    effect="Bands are reported relative to the static gain of the model only.",
    remedy="State `static_sensitivity` of the sensor in rig.toml.",
    link="steps.md",
)
GAIN_DEVIATES = DeclaredNotice(
    "SC-683",
    "warning",
    "The static gain of {channel} and the stated static sensitivity differ by {ratio:.2f} times the U of their "
    "difference.",
    effect="The stated load, the stated sensitivity, or one of their uncertainties is wrong.",
    remedy="Check the load and the calibration of the sensor.",
    link="steps.md",
)
NO_STEP_MODEL = DeclaredNotice(
    "SC-684",
    "error",
    "no model was found of any output ({recording}: {reason})",
    effect="No results are written.",
    remedy="Check the first notice of every recording.",
    link="steps.md",
)
POLES_BY_ONE_METHOD = DeclaredNotice(
    "SC-938",
    "error",
    "expected {expected} for a data file, found {found}",
    effect="Methods are compared only for recordings with a manifest.",
    remedy="Remove `--method`, or make a recording of the file.",
    link="steps.md#poles-from-one-file",
)


# `shakercal decouple`.


DIFFERENT_RECORDS = DeclaredNotice(
    "SC-700",
    "error",
    "expected {expected} as in {recording}, found {found}",
    effect="All releases must have the same outputs in the same units at one sampling rate.",
    remedy="Leave out this recording, or correct its channels.",
    link="decoupling.md",
)
MISSING_RELEASES = DeclaredNotice(
    "SC-701",
    "error",
    "expected a release of every load that the sensor measures ({missing} missing), found {found}",
    effect="The response to the missing loads is not determined.",
    remedy="Record a release of each missing load.",
    link="decoupling.md",
)
LOADS_NOT_SEPARABLE = DeclaredNotice(
    "SC-702",
    "error",
    "{reason}",
    effect="The releases do not determine the outputs of every load separately.",
    remedy="Add releases of other loads.",
    link="decoupling.md",
)
NO_COMMON_MODEL = DeclaredNotice(
    "SC-703",
    "error",
    "no model of the releases was found ({reason})",
    effect="No filter is designed.",
    link="decoupling.md",
)
NO_DECOUPLING_FILTER = DeclaredNotice(
    "SC-704",
    "error",
    "no filter was found ({reason})",
    remedy="Use a lower `--frequency`.",
    link="decoupling.md",
)
TARGET_ABOVE_LIMIT = DeclaredNotice(
    "SC-705",
    "error",
    "expected a target frequency below a quarter of the sampling rate, {rate_hz:g} Hz, found {frequency_hz:g} Hz",
    remedy="Use a lower `--frequency`, or a higher sampling rate.",
    link="decoupling.md",
)
TARGET_NOT_REACHED = DeclaredNotice(
    "SC-706",
    "warning",
    "From {frequency_hz:.0f} Hz on, the loads deviate from the target dynamics by more than {limit_percent:g} %.",
    effect="Noise of the outputs limits the filter there.",
    remedy="Use a lower `--frequency`.",
    link="decoupling.md",
)
NO_RATED_LOADS = DeclaredNotice(
    "SC-707",
    "note",
    "No rated loads are stated.",
    effect="Cross-talk between forces and moments is not compared.",
    remedy="State `capacity` of the sensor in rig.toml.",
    link="decoupling.md",
)
RELEASED_LOADS_EXACT = DeclaredNotice(
    "SC-708",
    "note",
    "The released loads of {components} are treated as exact.",
    effect="U includes noise and fit only.",
    remedy="State `step_amplitude` with its uncertainty.",
    link="decoupling.md",
)


# `shakercal compensate`.


WRONG_COMPENSATION_OPTION = DeclaredNotice(
    "SC-720",
    "error",
    "expected {expected}, found {found}",
    effect="No filter is made.",
    remedy="Correct the options of the command.",
    link="compensation.md",
)
DUPLICATE_MODEL = DeclaredNotice(
    "SC-721",
    "error",
    "expected one model per channel, found a second model of {channel}",
    remedy="Leave out one of the files.",
    link="compensation.md",
)
NO_MODEL_FILE = DeclaredNotice(
    "SC-722",
    "error",
    "expected {expected}, found none",
    remedy="Run `shakercal step` or `shakercal load` first, or name the file of its results.",
    link="compensation.md",
)
EQUIVALENT_SOLUTIONS = DeclaredNotice(
    "SC-723",
    "warning",
    "The data cannot distinguish {count} solutions of the load model.",
    effect="Filters are based on the first solution, and differ from the others at loads that were not measured.",
    remedy="Record a release with another load.",
    link="compensation.md",
)
WRONG_RECORDING = DeclaredNotice(
    "SC-724",
    "error",
    "expected {expected}, found {found}",
    effect="The filters cannot be applied to this recording.",
    link="compensation.md",
)
OUTPUTS_NOT_FILTERED = DeclaredNotice(
    "SC-725",
    "note",
    "There is no filter for {channels}.",
    effect="These outputs are left out.",
    link="compensation.md",
)
NO_REAL_POLE_TO_MOVE = DeclaredNotice(
    "SC-726",
    "note",
    "The model has no real pole, so --real-pole has no effect.",
    link="compensation.md",
)
COVARIANCE_NOT_STATED = DeclaredNotice(
    "SC-727",
    "note",
    "The model has no covariance.",
    effect="The uncertainty of the compensated signal by errors of the model is not known.",
    link="compensation.md",
)
MODE_UNCERTAIN = DeclaredNotice(
    "SC-728",
    "warning",
    "u of the mode at {frequency_hz:.4g} Hz is {share_percent:.0f} % of the half-width of its resonance.",
    effect="Around it, the first-order uncertainty of the compensated signal is only approximate.",
    remedy="Record more releases to determine the mode better.",
    link="compensation.md",
)
WIDER_BAND_POSSIBLE = DeclaredNotice(
    "SC-729",
    "note",
    "With ζ = {damping_ratio:g} the gain stays within ±{permitted_percent:g} % up to {band_hz:.4g} Hz.",
    effect="With ζ = {best_damping_ratio:.3f} it stays within this limit up to {widest_hz:.4g} Hz.",
    link="compensation.md",
)
BAND_NOT_REACHED = DeclaredNotice(
    "SC-730",
    "warning",
    "Up to {band_hz:g} Hz the gain deviates from the static gain by {deviation_percent:.3g} %.",
    effect="The target is that of another load.",
    remedy="Use a smaller `--bandwidth`, or one load mass.",
    link="compensation.md",
)
MODE_NOT_COMPENSATED = DeclaredNotice(
    "SC-731",
    "warning",
    "The mode at {frequency_hz:.4g} Hz (ζ = {damping_ratio:.3g}) is not compensated and contributes "
    "{share_percent:.2g} % of a step.",
    remedy="Use `--modes` to compensate it, too.",
    link="compensation.md",
)
SAMPLING_ERROR = DeclaredNotice(
    "SC-732",
    "warning",
    "At {rate_hz:g} Hz the sampled filter deviates from the continuous one by up to {deviation_percent:.2g} % below "
    "{band_hz:.4g} Hz.",
    remedy="Use a higher sampling rate.",
    link="compensation.md",
)
NOISE_AMPLIFIED = DeclaredNotice(
    "SC-733",
    "warning",
    "The filter amplifies white noise by a factor of {factor:.3g}.",
    remedy="Use a lower target frequency, or `--low-pass`.",
    link="compensation.md",
)
FILTER_FOR_ONE_LOAD = DeclaredNotice(
    "SC-734",
    "note",
    "The filter is made for a load of {load}.",
    remedy="Name other loads with `--load-mass`.",
    link="compensation.md",
)
FILTER_REFUSED = DeclaredNotice(
    "SC-735",
    "error",
    "{reason}",
    effect="The filter of this channel cannot be made.",
    remedy="Correct the option, or use another model.",
    link="compensation.md",
)
