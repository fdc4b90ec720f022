"""Errors of `shakercal plan`, `lines`, `init`, `validate` and `view`."""

from shakercal._common.notices import DeclaredNotice

RATE_STEP = DeclaredNotice(
    "SC-800",
    "error",
    "expected {expected}, found {found}",
    effect="No multiple of the step is within the limits of the camera rate.",
    remedy="Use a smaller `--rate-step`.",
    link="planning.md#reading-the-table",
)
TOO_MANY_LISTED_LINES = DeclaredNotice(
    "SC-801",
    "error",
    "expected {expected}, found {found}",
    effect="The plan would need too much time and memory.",
    remedy="Plan fewer frequencies, harmonics or frames.",
    link="planning.md#reading-the-table",
)
TOO_FEW_FRAMES = DeclaredNotice(
    "SC-802",
    "error",
    "expected {expected}, found {found}",
    effect="The frames do not determine all lines.",
    remedy="Use more `--frames` or fewer `--harmonics`.",
    link="planning.md#reading-the-table",
)
MULTISINE_FRAMES = DeclaredNotice(
    "SC-956",
    "error",
    "expected {expected}, found {found}",
    effect="The frames cannot resolve all lines.",
    remedy="Use more `--frames`, fewer `--lines`, or a band with a higher lower end.",
    link="many-lines.md",
)
RATE_LIMITS = DeclaredNotice(
    "SC-803",
    "error",
    "expected {expected}, found {found}",
    effect="No camera rate satisfies both options.",
    link="planning.md",
)
NOISE_UNSTATED = DeclaredNotice(
    "SC-805",
    "error",
    "expected {expected}, found {found}",
    effect="A relative uncertainty requires the noise of one frame.",
    remedy="State it by `--noise`, for example `--noise 2.3e-6` (m).",
    link="planning.md#what-the-figures-are-worth",
)
NEXT_WITHOUT_MATRIX = DeclaredNotice(
    "SC-969",
    "error",
    "expected {expected}, found {found}",
    effect="Only a matrix shows which recordings determine an element.",
    remedy="Name the results folder of a campaign that excites six independent loads.",
    link="next-recordings.md",
)
NEXT_ELEMENT = DeclaredNotice(
    "SC-970",
    "error",
    "expected {expected}, found {found}",
    remedy="Name elements as output/load, for example `--elements Fz/Fz,My/Fx`.",
    link="next-recordings.md",
)
NEXT_HOURS = DeclaredNotice(
    "SC-977",
    "error",
    "expected {expected}, found {found}",
    remedy="State more `--hours`, or the times of your laboratory by `--minutes`.",
    link="next-recordings.md#times",
)
NO_SIGNAL = DeclaredNotice(
    "SC-806",
    "error",
    "expected {expected}, found {found}",
    remedy="Use a file with channels that record the excitation.",
    link="signals.md",
)
NOT_FINITE = DeclaredNotice(
    "SC-807",
    "error",
    "expected {expected}, found {found}",
    effect="The channel contains non-finite samples, so no spectrum is computed.",
    remedy="Select other channels by `--channel`.",
    link="signals.md",
)
NO_RECORDED_FILES = DeclaredNotice(
    "SC-808",
    "error",
    "expected {expected}, found {found}",
    remedy="Name the folder of a recording, or of a campaign.",
    link="drafting.md",
)
MANIFEST_EXISTS = DeclaredNotice(
    "SC-809",
    "error",
    "expected {expected}, found {found}",
    effect="Every recording has a manifest, so none is drafted.",
    remedy="Name a folder without recording.toml.",
    link="drafting.md",
)
FILE_EXISTS = DeclaredNotice(
    "SC-810",
    "error",
    "expected {expected}, found {found}",
    effect="`shakercal init` never replaces a file.",
    remedy="Rename or remove the existing file first.",
    link="drafting.md",
)
UNSUITABLE_FOLDER = DeclaredNotice(
    "SC-811",
    "error",
    "expected {expected}, found {found}",
    remedy="Name an existing folder that can be read.",
    link="drafting.md",
)
UNSUITABLE_TEMPLATE = DeclaredNotice(
    "SC-812",
    "error",
    "expected {expected}, found {found}",
    effect="`--from` copies the rig and the channels of one recording without takes.",
    remedy="Name a recording with `rig` and `[excitation]`, without `take`, by `--from`.",
    link="drafting.md",
)
VALIDATION_OUTPUT = DeclaredNotice(
    "SC-813",
    "error",
    "expected {expected}, found {found}",
    remedy="Choose another folder, or replace the files by `--force`.",
    link="validation.md",
)
RESULTS_WITHOUT_RECORDING = DeclaredNotice(
    "SC-814",
    "error",
    "expected {expected}, found {found}",
    remedy="Name the recording by `--recording`.",
    link="view.md",
)
PORT_IN_USE = DeclaredNotice(
    "SC-815",
    "error",
    "expected {expected}, found {found}",
    remedy="Choose another `--port`, or 0 for any free one.",
    link="view.md",
)
BOKEH_MISSING = DeclaredNotice(
    "SC-816",
    "error",
    "The package bokeh, which draws the curves of the page, is not installed.",
    remedy="Install it by `pip install bokeh`.",
    link="view.md",
)
UNUSED_ANSWER = DeclaredNotice(
    "SC-955",
    "error",
    "expected {expected}, found {found}",
    effect="Nothing is written.",
    remedy="Correct the key of the file of `--answers`; `shakercal init` without it shows the keys.",
    link="drafting.md#questions-and-answers",
)
RECORDING_MOVED = DeclaredNotice(
    "SC-940",
    "error",
    "the recording of these results is no longer at {recording}",
    effect="Images and channels are read from the recording.",
    remedy="Name its present place by `--recording FOLDER`.",
    link="view.md",
)
RECORDING_CHANGED = DeclaredNotice(
    "SC-941",
    "error",
    "the file has changed since the page read it",
    effect="Nothing was written.",
    remedy="Reload the page, which reads the file anew, and draw again.",
    link="view.md#region-of-interest-and-masks",
)
OUTLINE_NOT_WRITTEN = DeclaredNotice(
    "SC-942",
    "error",
    "the block of these images cannot be edited: {reason}",
    effect="Nothing was written.",
    remedy="Copy the lines of the page into recording.toml.",
    link="view.md#region-of-interest-and-masks",
)
MANIFEST_NEWER = DeclaredNotice(
    "SC-943",
    "warning",
    "recording.toml has changed since these results",
    effect="Subsets and phasors may not be those of the present manifest.",
    remedy="Evaluate the recording again by `shakercal run`.",
    link="view.md",
)
