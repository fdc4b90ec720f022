"""Errors of simulations."""

from __future__ import annotations

from shakercal._common.notices import DeclaredNotice

SIMULATION_FOLDER_IN_USE = DeclaredNotice(
    "SC-910",
    "error",
    "expected {expected}, found {found}",
    effect="No file was written: `--force` replaces only unchanged files of an earlier simulation.",
    remedy="Choose another folder, or move the other files away.",
)
