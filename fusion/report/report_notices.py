"""Errors of results, reports and files: writing, and reading of earlier results."""

from __future__ import annotations

from shakercal._common.notices import DeclaredNotice

# Writing.


NOT_WRITTEN = DeclaredNotice(
    "SC-550",
    "error",
    "could not be written: {reason}",
    effect="Files that were there before are unchanged.",
    remedy="Check free space and permissions; close the file in other programs.",
    link="results.md#whole-or-not-at-all-and-resumed",
)
PATH_TOO_LONG = DeclaredNotice(
    "SC-551",
    "error",
    "could not be written: {reason}; its path of {characters} characters may be too long for the system",
    effect="Files that were there before are unchanged.",
    remedy="Use a shorter output folder, or enable long paths.",
    link="install.md#long-paths",
)
LOCKED = DeclaredNotice(
    "SC-552",
    "error",
    "another run is writing to this place",
    effect="This run ended before it wrote anything.",
    remedy="Start this run again when the other one has ended.",
    link="results.md#whole-or-not-at-all-and-resumed",
)
NO_BOKEH = DeclaredNotice(
    "SC-553",
    "error",
    "the package bokeh, which draws the figures of the page, is not installed",
    effect="No page is written.",
    remedy="Run `pip install bokeh`.",
)

NO_BROWSER = DeclaredNotice(
    "SC-945",
    "error",
    "expected a browser that prints the summary, found none of {names}",
    effect="The command did not start.",
    remedy="Install Chromium, Chrome or Edge, or leave the option out: any browser prints the page, the summary first.",
    link="results.md#on-paper",
)
NOT_PRINTED = DeclaredNotice(
    "SC-946",
    "error",
    "the browser {browser} printed no summary ({reason})",
    effect="The results are complete; only the PDF file is missing.",
    remedy="Open the page in a browser and print it; its first sheet is the summary.",
    link="results.md#on-paper",
)

# Object storage and databases of results.

ARCHIVE_PACKAGES_MISSING = DeclaredNotice(
    "SC-958",
    "error",
    "expected the packages that `pip install {packages}` installs, found not all ({reason})",
    effect="The command did not start.",
    remedy='Run `pip install "shakercal[archive]"`, and the package of the store, such as s3fs, gcsfs or adlfs.',
    link="archive.md",
)
STORE_REFUSED = DeclaredNotice(
    "SC-959",
    "error",
    "the store refused to list, read or write ({reason})",
    effect="No file is left half-written. The other recordings are evaluated.",
    remedy="Check address, permissions and connection, and run again; finished recordings are kept.",
    link="archive.md",
)
WRONG_CONDITION = DeclaredNotice(
    "SC-960",
    "error",
    "expected a database of `shakercal collect` and a condition on its columns, {reason}",
    effect="The command did not start.",
    remedy="Correct the condition. `docs/archive.md` lists the columns.",
    link="archive.md#columns",
)

# Input files that are hashed.


CHANGED_INPUT = DeclaredNotice(
    "SC-555",
    "error",
    "{change} while it was read",
    effect="No results were written.",
    remedy="Start again when no other program writes to it.",
    link="results.md#whole-or-not-at-all-and-resumed",
)
UNREADABLE_INPUT = DeclaredNotice(
    "SC-556",
    "error",
    "expected a readable file, found {reason}",
    effect="No results were written.",
    remedy="Check the path and the permissions.",
)
HASHING_ENDED = DeclaredNotice(
    "SC-557",
    "error",
    "the run ended before all input files were read",
    effect="No results were written.",
    remedy="Start the run again.",
)

# Folders for results.


OUTPUT_IS_FILE = DeclaredNotice(
    "SC-560",
    "error",
    "expected a folder for the results, found a file",
    effect="No file was written.",
    remedy="Choose another output folder.",
    link="results.md",
)
OUTPUT_NOT_WRITABLE = DeclaredNotice(
    "SC-561",
    "error",
    "expected a place for a folder with the results, found {found} at {above}",
    effect="No file was written.",
    remedy="Choose another output folder, or change the permissions.",
    link="results.md",
)
OTHER_CONTENT = DeclaredNotice(
    "SC-562",
    "error",
    "expected an empty folder for the results, found {found}",
    effect="No file was written.",
    remedy="Choose another output folder, or use `--force`, which replaces only result files.",
    link="results.md#whole-or-not-at-all-and-resumed",
)
RESERVED_NAME = DeclaredNotice(
    "SC-563",
    "error",
    "expected this file of the whole campaign, found a recording of the same name",
    effect="No file was written.",
    remedy="Rename the folder of the recording.",
    link="results.md#what-a-campaign-leaves",
)
OTHER_CAMPAIGN_CONTENT = DeclaredNotice(
    "SC-564",
    "error",
    "expected results of this campaign only, found other files, for example {found}",
    effect="No file was written.",
    remedy="Choose another output folder, or use `--force`, which replaces only result files.",
    link="results.md#what-a-campaign-leaves",
)

# Results that are read again.


DAMAGED_RESULTS = DeclaredNotice(
    "SC-570",
    "error",
    "expected results of an earlier run, found damaged ones ({reason})",
    effect="They are not used.",
    remedy="Evaluate again with `--force`.",
    link="results.md#resulth5",
)
RESULTS_TOO_LARGE = DeclaredNotice(
    "SC-571",
    "error",
    "expected results of an earlier run, found more data than the memory can take",
    effect="They are not used.",
    remedy="Use a machine with more memory, or evaluate again with `--force`.",
    link="results.md#resulth5",
)
OTHER_STRUCTURE = DeclaredNotice(
    "SC-572",
    "error",
    "expected results of an earlier run, found a file with other groups and numbers",
    effect="They are not used.",
    remedy="Check the path, or evaluate again with `--force`.",
    link="results.md#resulth5",
)
OTHER_FORMAT = DeclaredNotice(
    "SC-573",
    "error",
    "expected results of format {expected}, found {found}",
    effect="They are not used.",
    remedy="Evaluate again with `--force`.",
    link="results.md#resulth5",
)
INCOMPLETE_RESULTS = DeclaredNotice(
    "SC-574",
    "error",
    "the results are incomplete ({reason})",
    effect="They are not used.",
    remedy="Evaluate again with `--force`.",
    link="results.md#resulth5",
)
NO_RESULTS = DeclaredNotice(
    "SC-575",
    "error",
    "expected a folder with {expected}, found none of these",
    effect="No file was read.",
    remedy="Check the path, or evaluate the recording first.",
    link="results.md",
)
UNREADABLE_TABLE = DeclaredNotice(
    "SC-576",
    "error",
    "expected a table of results, found {reason}",
    effect="The table is not used.",
    remedy="Evaluate again with `--force`.",
    link="results.md",
)
NO_SENSITIVITY_TO_EXPORT = DeclaredNotice(
    "SC-577",
    "error",
    "expected results with a sensitivity, found none",
    effect="No universal file is written.",
    remedy="Evaluate a recording with outputs and a load.",
    link="results.md#universal-files",
)
NO_FIELDS = DeclaredNotice(
    "SC-936",
    "error",
    "expected results of a stereo pair with tracked subsets, found none",
    effect="No field is written.",
    remedy="Evaluate a recording with the images of a stereo pair.",
    link="results.md#fields-over-the-images",
)
FIELD_FOLDER_EXISTS = DeclaredNotice(
    "SC-937",
    "error",
    "expected a new folder for the fields, found one with {name}",
    effect="No file is written.",
    remedy="State another folder, or `--force` to replace the fields in it.",
    link="results.md#fields-over-the-images",
)
