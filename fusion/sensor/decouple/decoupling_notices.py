"""Notices and errors of decoupling filters (`shakercal decouple`)."""

from shakercal._common.notices import DeclaredNotice

DIFFERENT_RECORDS = DeclaredNotice(
    "SC-700",
    "error",
    "expected {expected} as in {recording}, found {found}",
    effect="All releases must have the same outputs in the same units at one sampling rate.",
    remedy="Leave out this recording, or correct its channels.",
    link="decoupling.md",
)
MISSING_RELEASES = DeclaredNotice(
    "SC-701",
    "error",
    "expected a release of every load that the sensor measures ({missing} missing), found {found}",
    effect="The response to the missing loads is not determined.",
    remedy="Record a release of each missing load.",
    link="decoupling.md",
)
LOADS_NOT_SEPARABLE = DeclaredNotice(
    "SC-702",
    "error",
    "{reason}",
    effect="The releases do not determine the outputs of every load separately.",
    remedy="Add releases of other loads.",
    link="decoupling.md",
)
NO_COMMON_MODEL = DeclaredNotice(
    "SC-703",
    "error",
    "no model of the releases was found ({reason})",
    effect="No filter is designed.",
    link="decoupling.md",
)
NO_DECOUPLING_FILTER = DeclaredNotice(
    "SC-704",
    "error",
    "no filter was found ({reason})",
    remedy="Use a lower `--frequency`.",
    link="decoupling.md",
)
TARGET_ABOVE_LIMIT = DeclaredNotice(
    "SC-705",
    "error",
    "expected a target frequency below a quarter of the sampling rate, {rate_hz:g} Hz, found {frequency_hz:g} Hz",
    remedy="Use a lower `--frequency`, or a higher sampling rate.",
    link="decoupling.md",
)
TARGET_NOT_REACHED = DeclaredNotice(
    "SC-706",
    "warning",
    "From {frequency_hz:.0f} Hz on, the loads deviate from the target dynamics by more than {limit_percent:g} %.",
    effect="Noise of the outputs limits the filter there.",
    remedy="Use a lower `--frequency`.",
    link="decoupling.md",
)
NO_RATED_LOADS = DeclaredNotice(
    "SC-707",
    "note",
    "No rated loads are stated.",
    effect="Cross-talk between forces and moments is not compared.",
    remedy="State `capacity` of the sensor in rig.toml.",
    link="decoupling.md",
)
RELEASED_LOADS_EXACT = DeclaredNotice(
    "SC-708",
    "note",
    "The released loads of {components} are treated as exact.",
    effect="U includes noise and fit only.",
    remedy="State `step_amplitude` with its uncertainty.",
    link="decoupling.md",
)
