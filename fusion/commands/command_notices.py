"""Errors of the command line: options, output files, limits of the machine."""

from __future__ import annotations

from shakercal._common.notices import DeclaredNotice

OUTPUT_EXISTS = DeclaredNotice(
    "SC-900",
    "error",
    "expected {expected}, found {found}",
    effect="The command did not start.",
    remedy="Choose another name, or use `--force` to replace earlier results.",
)
OUTPUT_FOLDER_MISSING = DeclaredNotice(
    "SC-901",
    "error",
    "expected {expected}, found {found}",
    effect="The command did not start.",
    remedy="Create the folder, or choose another one.",
)
INVALID_OPTION = DeclaredNotice(
    "SC-903",
    "error",
    "{reason}",
    effect="The command did not start.",
    remedy="Correct the option. `--help` lists its values.",
)
CONFLICTING_OPTIONS = DeclaredNotice(
    "SC-904",
    "error",
    "expected {expected}, found {found}",
    effect="The command did not start.",
    remedy="Remove one of the options.",
)
OPTION_OF_ANOTHER_INPUT = DeclaredNotice(
    "SC-905",
    "error",
    "expected {expected}, found {found}",
    effect="The command did not start.",
    remedy="Remove the option.",
)
LENGTH_UNIT_REQUIRED = DeclaredNotice(
    "SC-906",
    "error",
    "expected {expected}, found {found}",
    effect="The scale of the calibration would be wrong by a factor of 1000 if mm were meant.",
    remedy="State the unit with the number.",
    link="cameras.md",
)
FREQUENCIES_NOT_ASCENDING = DeclaredNotice(
    "SC-907",
    "error",
    "expected {expected}, found {found}",
    effect="The command did not start.",
    remedy="State the lower frequency first.",
)
ADDRESS_SPACE_TOO_SMALL = DeclaredNotice(
    "SC-908",
    "error",
    "expected {expected_mb:.0f} MB of addresses, found {found_mb:.0f} MB (ulimit -v)",
    effect="Libraries end the process, or wait forever, if they get no memory.",
    remedy="Raise the limit of the address space.",
)
