"""Notices of the trigger model and of the ties between clocks."""

from __future__ import annotations

from shakercal._common.notices import DeclaredNotice

CONTRADICTORY_PERIOD = DeclaredNotice(
    "SC-310",
    "warning",
    "The trigger period from the frames or from other records is {relative_difference:.2g} (relative) {direction} than "
    "that of the edges, with a standard uncertainty of {u_relative:.2g}.",
    effect="The period of the edges is used.",
    remedy="Check for missing frames or edges, and whether the lines belong to the observed motion.",
    link="clocks.md",
)
MISSING_EDGES = DeclaredNotice(
    "SC-311",
    "warning",
    "{missing} edges are missing (numbers {numbers}).",
    effect="The other edges are numbered by their period.",
    remedy="Check the trigger signal and its threshold.",
    link="clocks.md",
)
DOUBLED_EDGES = DeclaredNotice(
    "SC-312",
    "warning",
    "{doubled} doubled edges are rejected.",
    effect="The nearest edge of each group is used.",
    remedy="Check the trigger line for bouncing or reflections.",
    link="clocks.md",
)
STRAY_EDGES = DeclaredNotice(
    "SC-313",
    "warning",
    "{stray} edges off the period of {period_s:.6g} s are rejected.",
    effect="The remaining edges are used.",
    remedy="Check the trigger line for interference.",
    link="clocks.md",
)
TRIGGER_JITTER = DeclaredNotice(
    "SC-314",
    "warning",
    "The edges jitter by {jitter_us:.3g} µs, more than 0.1 % of the period.",
    effect="The uncertainty of the frame times includes the jitter.",
    remedy="Use a trigger source with less jitter.",
    link="clocks.md",
)
EXTERNAL_PERIOD = DeclaredNotice(
    "SC-315",
    "note",
    "The trigger period is taken from the frames or from other records, because the edges do not determine it.",
    effect="Its relative standard uncertainty is {u_relative:.2g}.",
    link="clocks.md",
)
LOCKED_EDGES = DeclaredNotice(
    "SC-316",
    "note",
    "The edges always have the same phases between two samples.",
    effect="Their instants have a standard uncertainty of {u_us:.2g} µs.",
    remedy="Use a trigger period that is no simple multiple of the sampling interval.",
    link="clocks.md",
)
CONTRADICTORY_CLOCK_RATE = DeclaredNotice(
    "SC-317",
    "warning",
    "The lines of the record are {relative_difference:.2g} (relative) {direction} than the trigger edges predict, "
    "with a standard uncertainty of {u_relative:.2g}.",
    effect="The clock rate of the edges is used.",
    remedy="Check the edges, and whether the same excitation drove both records.",
    link="clocks.md",
)
START_TIMES_DISAGREE = DeclaredNotice(
    "SC-318",
    "note",
    "The start times put edge 0 at edge {start_time_edge} of the first clock, but {evidence} put it at {used_edge}.",
    effect="Edge {used_edge} is used.",
    remedy="State `first_edge` if that is wrong.",
    link="clocks.md",
)
