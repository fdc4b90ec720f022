"""Notices and errors of campaigns: joint evaluation, matrices, repeats, worker processes and clusters."""

from __future__ import annotations

from shakercal._common.notices import DeclaredNotice

# Recordings that are evaluated together.


SEVERAL_SENSORS = DeclaredNotice(
    "SC-500",
    "warning",
    "The recordings tested several sensors: {sensors}.",
    effect="No joint sensitivity is reported.",
    remedy="Use one campaign folder for each sensor.",
    link="campaigns.md",
    acknowledgeable=False,
)
FAILED_RECORDINGS = DeclaredNotice(
    "SC-501",
    "warning",
    "{count} of the recordings could not be evaluated: {names}.",
    effect="They are not included in any joint result.",
    remedy="Correct the errors that are reported for them and run again.",
    link="campaigns.md",
)
NO_JOINT_RESULT = DeclaredNotice(
    "SC-502",
    "warning",
    "No {result} could be computed: {reason}.",
    effect="The results of the individual recordings are not affected.",
    remedy="Check whether these recordings belong to one campaign.",
    link="campaigns.md",
)
UNCERTAINTY_JUMP = DeclaredNotice(
    "SC-949",
    "warning",
    "U of this recording's sensitivity to {component} at {frequency_hz:.6g} Hz is {U_percent:.2g} %, {factor:.2g} "
    "times that at neighbouring frequencies; {share_percent:.0f} % of its variance comes from {influence}.",
    effect="The recording is included; its small weight in the curve follows from its U.",
    remedy="Compare this recording with its neighbours, correct the cause, or record it again.",
    link="campaigns.md",
)

# Unknowns of the rig that all recordings estimate together.


CONTRADICTING_RECORDINGS = DeclaredNotice(
    "SC-505",
    "warning",
    "The readings of {recordings} contradict all other recordings about poses, scales or other unknowns of the rig "
    "(test at {level_percent:.0f} %).",
    effect="No joint estimate is used; every recording keeps its individual estimate.",
    remedy="Check whether the rig changed between these recordings.",
    link="campaigns.md#what-a-campaign-knows-of-poses-and-scales",
)
JOINT_UNKNOWNS = DeclaredNotice(
    "SC-506",
    "note",
    "All recordings together determine {improved} of {count} unknowns of the rig better than stated.",
    effect="The other unknowns keep their stated uncertainty.",
    link="campaigns.md#what-a-campaign-knows-of-poses-and-scales",
)
RECORDINGS_WITHOUT_ESTIMATE = DeclaredNotice(
    "SC-507",
    "note",
    "{count} recordings have no load, or instruments that contradict each other.",
    effect="They do not contribute to the joint estimate of the unknowns of the rig.",
    link="campaigns.md#what-a-campaign-knows-of-poses-and-scales",
)

# The 6 x 6 matrix.


MISSING_EXCITATIONS = DeclaredNotice(
    "SC-510",
    "note",
    "No matrix at {frequencies}: the recordings excite too few independent loads (missing: {missing}).",
    effect="Only ratios and elements of single recordings are reported at these frequencies.",
    remedy="Add {additions}.",
    link="campaigns.md",
)
NO_MATRIX = DeclaredNotice(
    "SC-511",
    "warning",
    "No matrix at {frequencies}: {reason}.",
    effect="Only ratios and elements of single recordings are reported at these frequencies.",
    remedy="Check the recordings at these frequencies.",
    link="campaigns.md",
)
MISSING_MATRIX_ROW = DeclaredNotice(
    "SC-512",
    "warning",
    "The matrix has no row for {channels}: the recordings of these outputs excite too few independent loads.",
    effect="No matrix element of these outputs is reported.",
    remedy="Record these outputs in all recordings of the campaign.",
    link="campaigns.md",
)
UNTESTED_MATRIX = DeclaredNotice(
    "SC-513",
    "note",
    "{count} recordings at {frequency_hz:.6g} Hz determine the matrix without redundancy.",
    effect="No further recording tests it.",
    remedy="Add a recording in another direction.",
    link="campaigns.md",
)
INCONSISTENT_MATRIX = DeclaredNotice(
    "SC-514",
    "warning",
    "Recordings at {frequency_hz:.6g} Hz disagree beyond their uncertainties (chi-square {chi2:.3g} for {dof} degrees "
    "of freedom).",
    effect="The largest deviation is that of {recording}, {normalised_deviation:.3g} times the expected one. "
    "U includes a further {discrepancy:.2g} of every output.",
    remedy="Check {recording} and repeat it.",
    link="campaigns.md",
)

# Repeats.


ONE_MOUNTING = DeclaredNotice(
    "SC-520",
    "note",
    "{frequencies}: all {recordings} recordings are of one mounting.",
    effect="The effect of a new mounting is not included in U beyond the stated uncertainties of positions and "
    "directions.",
    remedy="Mount the sensor again and repeat the recordings.",
    link="campaigns.md",
    possible_size="not known; a second mounting determines it",
)
TWO_REPEATS = DeclaredNotice(
    "SC-521",
    "note",
    "{frequencies}: there are only two {repeated}.",
    effect="Their reproducibility has one degree of freedom, so that k reaches {k_two:.1f}.",
    remedy="A third one reduces k to {k_three:.1f}.",
    link="campaigns.md",
)
UNREPEATED_EXCITATIONS = DeclaredNotice(
    "SC-522",
    "note",
    "{single} of {count} excitations were recorded once.",
    effect="Their U does not include repeatability and the effect of a new mounting.",
    remedy="Repeat these recordings, preferably after a new mounting.",
    link="campaigns.md",
    possible_size="not known; repeated recordings determine it",
)

# Worker processes and clusters.


WORKER_ENDED = DeclaredNotice(
    "SC-530",
    "error",
    "{attempts} worker processes ended while they computed this recording",
    effect="It has no result.",
    remedy="Check whether the memory is sufficient; use fewer `--workers`.",
    link="campaigns.md#several-processes",
)
CLUSTER_WORKERS_ENDED = DeclaredNotice(
    "SC-531",
    "error",
    "{attempts} workers of the cluster ended while they computed this recording",
    effect="It has no result.",
    remedy="Check whether the memory of the workers is sufficient.",
    link="campaigns.md#a-dask-cluster",
)
SCHEDULER_LOST = DeclaredNotice(
    "SC-532",
    "error",
    "the Dask scheduler has not answered for {timeout_s:.0f} s",
    effect="The run ended before all recordings were evaluated.",
    remedy="Start a scheduler, then start the run again; finished recordings are kept.",
    link="campaigns.md#a-dask-cluster",
)
NO_DASK = DeclaredNotice(
    "SC-533",
    "error",
    'expected the packages that `pip install "shakercal[cluster]"` installs, found none ({reason})',
    effect="The run did not start.",
    remedy='Run `pip install "shakercal[cluster]"`.',
    link="campaigns.md#a-dask-cluster",
)
NO_SCHEDULER = DeclaredNotice(
    "SC-534",
    "error",
    "expected the address of a Dask scheduler such as tcp://10.0.0.1:8786, found no answer at {found}",
    effect="The run did not start.",
    remedy="Check the address and whether the scheduler is running.",
    link="campaigns.md#a-dask-cluster",
)
OTHER_WORKER_VERSION = DeclaredNotice(
    "SC-535",
    "error",
    "expected workers with {expected}, found {found} at {worker}",
    effect="The run did not start, since other versions may give other results.",
    remedy="Install the same version on all workers.",
    link="campaigns.md#a-dask-cluster",
)

# Results of recordings that a campaign reads.


NO_RECORDING_RESULTS = DeclaredNotice(
    "SC-540",
    "error",
    "expected the results of a recording, found none",
    effect="The recording is not used.",
    remedy="Evaluate the recording first: `shakercal run`.",
    link="results.md",
)
