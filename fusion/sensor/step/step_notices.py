"""Notices and errors of step responses (`shakercal step`), also of commands that read releases."""

from shakercal._common.notices import DeclaredNotice

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
    effect="The model describes sensor and measuring chain together.",
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
