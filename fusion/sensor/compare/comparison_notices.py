"""Notices and errors of comparisons (`shakercal compare`)."""

from shakercal._common.notices import DeclaredNotice

WRONG_RESULT_COUNT = DeclaredNotice(
    "SC-760",
    "error",
    "expected 2 to {limit} results to compare, found {found}",
    remedy="Name more, or fewer, results.",
    link="comparison.md",
)
NO_COMMON_VALUE = DeclaredNotice(
    "SC-761",
    "error",
    "expected an element whose frequencies agree within {tolerance:g} (relative), found none",
    effect="No value has a partner in another result.",
    remedy="Check names of channels and components, and the frequencies; or use a larger `--tolerance`.",
    link="comparison.md",
)
ONLY_DIFFERENT_KINDS = DeclaredNotice(
    "SC-762",
    "error",
    "expected an element whose frequencies agree within {tolerance:g} (relative), found ratios and elements of the "
    "sensor ({kinds})",
    effect="A ratio contains the effect of other loads and is not compared with an element.",
    remedy="State the calibration matrix, or evaluate a campaign that determines it.",
    link="comparison.md",
)
UNIT_NOT_CONVERTIBLE = DeclaredNotice(
    "SC-763",
    "error",
    "expected a unit that converts into {expected}, found {found}",
    remedy="State the results in units of the same dimension.",
    link="comparison.md",
)
NO_RESULT_TABLE = DeclaredNotice(
    "SC-764",
    "error",
    "expected a folder of results with {expected}, found neither",
    remedy="Name the folder of results, or the table itself.",
    link="comparison.md",
)
WRONG_RESULT_TABLE = DeclaredNotice(
    "SC-765",
    "error",
    "expected {expected}, found {found}",
    effect="The result cannot be compared.",
    remedy="Correct the table.",
    link="comparison.md",
)
WRONG_RESULT_CELL = DeclaredNotice(
    "SC-766",
    "error",
    "expected {expected}, found {found} in line {line}",
    effect="The result cannot be compared.",
    remedy="Correct the cell.",
    link="comparison.md",
)
WRONG_CERTIFIED_RESULT = DeclaredNotice(
    "SC-767",
    "error",
    "expected {expected}, found {found}",
    effect="The certificate cannot be compared.",
    link="comparison.md",
)
WRONG_COMPARISON_OPTION = DeclaredNotice(
    "SC-768",
    "error",
    'expected {expected}, found "{found}"',
    remedy="Correct the arguments of the command.",
    link="comparison.md",
)
RESULTS_INDEPENDENT = DeclaredNotice(
    "SC-769",
    "note",
    "The results are treated as independent.",
    effect="An input that two results share without evidence, such as the mass of one load, cancels in their "
    "difference. E_n is then too small.",
    remedy="State the certificates of the inputs.",
    link="comparison.md",
    possible_size="not known",
)
RESULTS_SHARE_INPUTS = DeclaredNotice(
    "SC-770",
    "note",
    "The results are treated as independent, except for inputs that certificates or files show as shared.",
    effect="A further input that two results share without evidence cancels in their difference. "
    "E_n is then too small.",
    remedy="State the certificates of the inputs.",
    link="comparison.md",
    possible_size="not known",
)
CONTRADICTORY_CLAIMS = DeclaredNotice(
    "SC-771",
    "warning",
    "{first} and {second} name the same certificate for {inputs}, but state different values or U.",
    effect="These inputs are not treated as shared.",
    remedy="Check the statements of both against the certificate.",
    link="comparison.md",
)
POSSIBLY_SHARED = DeclaredNotice(
    "SC-772",
    "note",
    "{first} and {second} both depend on {inputs} with the same u, and state no certificate of it.",
    effect="The inputs are treated as independent.",
    remedy="State the certificates of the inputs.",
    link="comparison.md",
)
SAME_FILE = DeclaredNotice(
    "SC-773",
    "warning",
    "{first} and {second} are the same file.",
    effect="Their agreement is no evidence.",
    link="comparison.md",
)
UNMATCHED_VALUES = DeclaredNotice(
    "SC-774",
    "note",
    "Values without a partner in another result: {count}.",
    effect="They are not compared.",
    link="comparison.md",
)
RATIOS_COMPARED = DeclaredNotice(
    "SC-775",
    "note",
    "Ratios of outputs and driven load are compared only with ratios.",
    effect="Each ratio contains the effect of the other loads of its recording.",
    remedy="State the calibration matrix, or evaluate a campaign that determines it, to compare elements.",
    link="comparison.md",
)
RESPONSES_LEFT_OUT = DeclaredNotice(
    "SC-776",
    "note",
    "Ratios of outputs that do not belong to the driven load are left out: {counts}.",
    effect="The effect of other loads dominates these outputs. Other ratios are compared only with ratios.",
    remedy="State the calibration matrix, or evaluate a campaign that determines it, to compare elements.",
    link="comparison.md",
)
KINDS_NOT_COMPARED = DeclaredNotice(
    "SC-777",
    "warning",
    "{channel} per {component}: {ratios} state ratios, {elements} state elements of the sensor.",
    effect="They are not compared, since a ratio contains the effect of other loads.",
    remedy="State the calibration matrix, or evaluate a campaign that determines it, to compare elements.",
    link="comparison.md",
)
PHASES_DIFFER_BY_180 = DeclaredNotice(
    "SC-778",
    "warning",
    "{channel} per {component}: the phases of {first} and {second} differ by 180° at every common frequency.",
    effect="The sign of the output or of the load probably differs.",
    remedy="Check the sign of the output and `sense` of the sensor in both.",
    link="comparison.md",
)
PHASES_OPPOSITE = DeclaredNotice(
    "SC-779",
    "warning",
    "{channel} per {component}: the phases of {first} and {second} have opposite signs at every common frequency.",
    effect="The sign convention of the phase probably differs.",
    remedy="Check whether one of them counts a lag as positive.",
    link="comparison.md",
)
