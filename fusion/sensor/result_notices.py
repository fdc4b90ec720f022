"""Notices and errors of results (`shakercal compare`, `certificate`)."""

from shakercal._common.notices import DeclaredNotice

# `shakercal compare`.


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
    "{first} and {second} are the same file, or have rows of a database in common.",
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
    effect="The sign of the output or of the load probably differs. Phases are compared after a change of this sign.",
    remedy="Check the sign of the output and `sense` of the sensor in both.",
    link="comparison.md",
)
ROUND_NOT_LINKED = DeclaredNotice(
    "SC-972",
    "error",
    "expected a laboratory that links round {round} with round {first}, found none",
    effect="The artefacts of different rounds differ, so that their values cannot be compared.",
    remedy="Name the results of a laboratory in both rounds, and the laboratory in `--link` if this option is used.",
    link="comparison.md",
)
LINKS_INCONSISTENT = DeclaredNotice(
    "SC-973",
    "warning",
    "The laboratories that link round {round} contradict each other in {channel} per {component} (p = {p:.2g} at one "
    "of {count} values).",
    effect="The degrees of equivalence of the linked laboratories depend on which of them link the rounds.",
    remedy="Examine the results of the linking laboratories, or state in `--link` those that are stable.",
    link="comparison.md",
)
DRIFT_REMOVED = DeclaredNotice(
    "SC-974",
    "warning",
    "The artefact drifts by repeated results of {laboratory}: {channel} per {component}, {count} of {points} values.",
    effect="This drift is removed from the results of the round. Its uncertainty is included.",
    link="comparison.md",
)
DRIFT_NOT_REMOVED = DeclaredNotice(
    "SC-975",
    "warning",
    "The artefact drifts by repeated results of {laboratory}: {channel} per {component}, {count} of {points} values. "
    "Not every result of the round has a date.",
    effect="The drift is neither removed nor included in U.",
    remedy="State the day of every result, `NAME@YYYY-MM-DD` or `--date`.",
    link="comparison.md",
)
UNCERTAINTY_BY_FORMULA = DeclaredNotice(
    "SC-971",
    "warning",
    "The stated uncertainty of {result}'s magnitude is {percent:.3g} % of the value at {count} of {points} points.",
    effect="Such an uncertainty follows from a formula, for example a stated capability, not from these measurements. "
    "It does not show at which frequencies the result scatters, so E_n may be too large or too small.",
    remedy="Ask for the uncertainty of every point, or its scatter over repeats.",
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


# `shakercal certificate`.


WARNINGS_NOT_REVIEWED = DeclaredNotice(
    "SC-780",
    "error",
    "expected an acknowledgement of every kind of warning, found {count} warnings without one: {codes}; the first is "
    "{first}",
    effect="A certificate states only results whose warnings the authoriser has reviewed.",
    remedy="Let the authoriser review the warnings, and state code, reason, name and date in `[[acknowledged]]` of "
    "certificate.toml, rig.toml or recording.toml.",
    link="certificate.md",
)
OUTDATED_RESULTS = DeclaredNotice(
    "SC-781",
    "error",
    "expected the results of {expected}, found results of other input files ({changed} has changed)",
    remedy="Run `shakercal {command}` again.",
    link="certificate.md",
)
NOT_ONE_SENSOR = DeclaredNotice(
    "SC-782",
    "error",
    "expected the one sensor that was calibrated, found {found}",
    remedy="State `[sensor]`, the same in every rig.toml.",
    link="certificate.md",
)
MISSING_CERTIFICATE_ENTRIES = DeclaredNotice(
    "SC-783",
    "error",
    "expected the entries that a certificate must state, found none",
    effect="ISO/IEC 17025:2017, 7.8.2 requires them.",
    remedy="Fill in these keys.",
    link="certificate.md",
)
EXPIRED_CERTIFICATES = DeclaredNotice(
    "SC-784",
    "error",
    "expected inputs whose certificates were valid when it was recorded, found expired ones: {inputs}",
    remedy="State a certificate that was valid on the day of the recording.",
    link="certificate.md",
)
ISSUED_BEFORE_CALIBRATION = DeclaredNotice(
    "SC-785",
    "error",
    "expected a day not before {last}, the last day of the calibration, found {found}",
    remedy="Correct the day of issue, or the days of the calibration.",
    link="certificate.md",
)
NO_CERTIFIABLE_RESULT = DeclaredNotice(
    "SC-786",
    "error",
    "expected {expected}, found none",
    effect="No certificate is written.",
    remedy="Name the folder of results with `--results`.",
    link="certificate.md",
)
NO_CERTIFICATE_FORM = DeclaredNotice(
    "SC-787",
    "error",
    "expected certificate.toml with the statements of the laboratory, found no file",
    remedy="Write a new one with `--draft`, and fill it in.",
    link="certificate.md",
)
DAMAGED_RESULT_TABLE = DeclaredNotice(
    "SC-788",
    "error",
    "expected the table of shakercal {command}, found a damaged line ({reason})",
    remedy="Run `shakercal {command}` again.",
    link="certificate.md",
)
UNIT_WITHOUT_DSI = DeclaredNotice(
    "SC-789",
    "error",
    'expected a unit made of V, A, C, N, m and similar ones, such as mV/V, found "{found}"',
    effect="The unit cannot be written in the D-SI format of the certificate.",
    remedy="State another unit of the sensor.",
    link="certificate.md",
)
SIMULATED_RECORDINGS = DeclaredNotice(
    "SC-961",
    "error",
    "expected measured recordings, found {count} of {total} simulated",
    effect="No item was calibrated.",
    remedy="Use `--specimen` for a page and a file that are marked as a specimen.",
    link="certificate.md",
)
UNNAMED_SENSOR = DeclaredNotice(
    "SC-962",
    "error",
    'expected the name of the item, found "{found}", as `shakercal init` drafts it',
    remedy="State the name of the sensor, and evaluate again.",
    link="certificate.md",
)
RECEIVED_AFTER_CALIBRATION = DeclaredNotice(
    "SC-963",
    "error",
    "expected a day not after {first}, the first day of the calibration, found {found}",
    remedy="Correct the day of receipt, or the days of the calibration.",
    link="certificate.md",
)
CERTIFICATE_REFUSED = DeclaredNotice(
    "SC-964",
    "error",
    "expected nothing that refuses a certificate, found {count} reasons: {problems}",
    effect="No certificate is written.",
    remedy="Correct all of them.",
    link="certificate.md",
)
NOT_A_SPECIMEN = DeclaredNotice(
    "SC-965",
    "error",
    "expected simulated recordings for a specimen, found measured ones",
    effect="A specimen certifies nothing.",
    remedy="Omit `--specimen`.",
    link="certificate.md",
)
WRONG_SIGNATURE = DeclaredNotice(
    "SC-966",
    "error",
    "expected a signature by the key of the X.509 certificate in it, found another one ({reason})",
    effect="The signer is not the one that the file states.",
    remedy="Ask the laboratory for the original file.",
    link="certificate.md",
)
UNKNOWN_CERTIFIED_INPUT = DeclaredNotice(
    "SC-924",
    "error",
    "expected keys of inputs with an uncertainty, found {found}",
    remedy="Name the end of a key, such as `load.mass`. The inputs are: {keys}.",
    link="certificate.md",
)
OTHER_PAGE = DeclaredNotice(
    "SC-967",
    "error",
    "expected the page whose hash the XML states, found a page with another one",
    effect="What people read may differ from what was certified.",
    remedy="Ask the laboratory for the original page.",
    link="certificate.md",
)
