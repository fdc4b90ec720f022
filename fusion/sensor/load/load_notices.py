"""Notices and errors of load characteristics (`shakercal load`)."""

from shakercal._common.notices import DeclaredNotice

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
