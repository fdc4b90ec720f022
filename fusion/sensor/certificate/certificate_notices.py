"""Errors of calibration certificates (`shakercal certificate`)."""

from shakercal._common.notices import DeclaredNotice

WARNINGS_NOT_REVIEWED = DeclaredNotice(
    "SC-780",
    "error",
    "expected true, or results without warnings, found {count} warnings that are not reviewed, the first: {first}",
    effect="A certificate states only results whose warnings were reviewed.",
    remedy="Let the authoriser review the warnings, and set the key to true.",
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
