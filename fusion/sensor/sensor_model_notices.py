"""Notices and errors of the files of models that commands of a sensor exchange."""

from shakercal._common.notices import DeclaredNotice

WRONG_MODEL_FORMAT = DeclaredNotice(
    "SC-790",
    "error",
    "expected format {expected}, found format {found}",
    effect="The file was written by another version of the program.",
    remedy="Run {again} again.",
    link="results.md",
)
DAMAGED_MODEL_FILE = DeclaredNotice(
    "SC-791",
    "error",
    "expected {expected} as written by shakercal {command}, found {found}",
    effect="The file is not used.",
    remedy="Run {again} again.",
    link="results.md",
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
