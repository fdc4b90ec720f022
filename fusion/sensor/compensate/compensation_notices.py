"""Notices and errors of compensation filters (`shakercal compensate`)."""

from shakercal._common.notices import DeclaredNotice

WRONG_COMPENSATION_OPTION = DeclaredNotice(
    "SC-720",
    "error",
    "expected {expected}, found {found}",
    effect="No filter is made.",
    remedy="Correct the options of the command.",
    link="compensation.md",
)
DUPLICATE_MODEL = DeclaredNotice(
    "SC-721",
    "error",
    "expected one model per channel, found a second model of {channel}",
    remedy="Leave out one of the files.",
    link="compensation.md",
)
NO_MODEL_FILE = DeclaredNotice(
    "SC-722",
    "error",
    "expected {expected}, found none",
    remedy="Run `shakercal step` or `shakercal load` first, or name the file of its results.",
    link="compensation.md",
)
EQUIVALENT_SOLUTIONS = DeclaredNotice(
    "SC-723",
    "warning",
    "The data cannot distinguish {count} solutions of the load model.",
    effect="Filters are based on the first solution, and differ from the others at loads that were not measured.",
    remedy="Record a release with another load.",
    link="compensation.md",
)
WRONG_RECORDING = DeclaredNotice(
    "SC-724",
    "error",
    "expected {expected}, found {found}",
    effect="The filters cannot be applied to this recording.",
    link="compensation.md",
)
OUTPUTS_NOT_FILTERED = DeclaredNotice(
    "SC-725",
    "note",
    "There is no filter for {channels}.",
    effect="These outputs are left out.",
    link="compensation.md",
)
NO_REAL_POLE_TO_MOVE = DeclaredNotice(
    "SC-726",
    "note",
    "The model has no real pole, so --real-pole has no effect.",
    link="compensation.md",
)
COVARIANCE_NOT_STATED = DeclaredNotice(
    "SC-727",
    "note",
    "The model has no covariance.",
    effect="The uncertainty of the compensated signal by errors of the model is not known.",
    link="compensation.md",
)
MODE_UNCERTAIN = DeclaredNotice(
    "SC-728",
    "warning",
    "u of the mode at {frequency_hz:.4g} Hz is {share_percent:.0f} % of the half-width of its resonance.",
    effect="Around it, the first-order uncertainty of the compensated signal is only approximate.",
    remedy="Record more releases to determine the mode better.",
    link="compensation.md",
)
WIDER_BAND_POSSIBLE = DeclaredNotice(
    "SC-729",
    "note",
    "With ζ = {damping_ratio:g} the gain stays within ±{permitted_percent:g} % up to {band_hz:.4g} Hz.",
    effect="With ζ = {best_damping_ratio:.3f} it stays within this limit up to {widest_hz:.4g} Hz.",
    link="compensation.md",
)
BAND_NOT_REACHED = DeclaredNotice(
    "SC-730",
    "warning",
    "Up to {band_hz:g} Hz the gain deviates from the static gain by {deviation_percent:.3g} %.",
    effect="The target is that of another load.",
    remedy="Use a smaller `--bandwidth`, or one load mass.",
    link="compensation.md",
)
MODE_NOT_COMPENSATED = DeclaredNotice(
    "SC-731",
    "warning",
    "The mode at {frequency_hz:.4g} Hz (ζ = {damping_ratio:.3g}) is not compensated and contributes "
    "{share_percent:.2g} % of a step.",
    remedy="Use `--modes` to compensate it, too.",
    link="compensation.md",
)
SAMPLING_ERROR = DeclaredNotice(
    "SC-732",
    "warning",
    "At {rate_hz:g} Hz the sampled filter deviates from the continuous one by up to {deviation_percent:.2g} % below "
    "{band_hz:.4g} Hz.",
    remedy="Use a higher sampling rate.",
    link="compensation.md",
)
NOISE_AMPLIFIED = DeclaredNotice(
    "SC-733",
    "warning",
    "The filter amplifies white noise by a factor of {factor:.3g}.",
    remedy="Use a lower target frequency, or `--low-pass`.",
    link="compensation.md",
)
FILTER_FOR_ONE_LOAD = DeclaredNotice(
    "SC-734",
    "note",
    "The filter is made for a load of {load}.",
    remedy="Name other loads with `--load-mass`.",
    link="compensation.md",
)
FILTER_REFUSED = DeclaredNotice(
    "SC-735",
    "error",
    "{reason}",
    effect="The filter of this channel cannot be made.",
    remedy="Correct the option, or use another model.",
    link="compensation.md",
)
