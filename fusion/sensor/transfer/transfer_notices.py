"""Notices and errors of transfer functions (`shakercal transfer`), also of commands that align channels."""

from shakercal._common.notices import DeclaredNotice

MISSING_TRANSFER_ENTRY = DeclaredNotice(
    "SC-685",
    "error",
    "expected {expected}, found none",
    effect="The transfer functions cannot be estimated.",
    remedy="Add it to `[excitation]` of recording.toml.",
    link="transfer.md",
)
WRONG_CHANNEL_NAME = DeclaredNotice(
    "SC-686",
    "error",
    'expected {expected}, found "{found}"',
    remedy="Correct the name, or rename the channel.",
    link="transfer.md",
)
CHANNELS_NOT_SIMULTANEOUS = DeclaredNotice(
    "SC-687",
    "error",
    "expected channels that were recorded at the same time, found records that do not overlap",
    remedy="Select channels of simultaneous records.",
    link="transfer.md",
)
DEFECTIVE_SAMPLES = DeclaredNotice(
    "SC-688",
    "error",
    "expected samples within the range of the recorder, without gaps, found a record that {defect}",
    remedy="Record again, or leave the channel out.",
    link="transfer.md",
)
COARSE_CONVERTER_STEPS = DeclaredNotice(
    "SC-689",
    "warning",
    "The {measure} of the signal is only {size:.2g}{unit}, at converter steps of {step:.4g}.",
    effect="U does not include the effect of this rounding.",
    remedy="Use a smaller range of the recorder.",
    link="transfer.md",
)
CHANNELS_RESAMPLED = DeclaredNotice(
    "SC-690",
    "note",
    "Channels of different clocks or rates are resampled at the times of {channel}, {rate_hz:.9g} Hz.",
    effect="They are used up to {highest_hz:.6g} Hz.",
    link="transfer.md",
)
PERIOD_WITHOUT_SIGNAL = DeclaredNotice(
    "SC-691",
    "error",
    "expected the period with which the excitation repeats, found {found_s:g} s, at whose harmonics {channel} contains "
    "only noise",
    remedy="Correct `period`.",
    link="transfer.md",
)
BAND_ABOVE_LIMIT = DeclaredNotice(
    "SC-692",
    "error",
    "expected a band that begins below {limit_hz:.6g} Hz, the limit of the slowest channel, found {low_hz:g} to "
    "{high_hz:g} Hz",
    remedy="Correct `band`, or leave out the slowest channel.",
    link="transfer.md",
)
CHIRP_WITHOUT_PERIOD = DeclaredNotice(
    "SC-693",
    "warning",
    "No period of the chirp is stated, so it is evaluated as noise.",
    effect="The uncertainty is estimated from neighbouring lines.",
    remedy="State `period` if the chirp repeats.",
    link="transfer.md",
)
PEAK_NOT_FITTED = DeclaredNotice(
    "SC-694",
    "note",
    "No oscillator was fitted to the peak at {frequency_hz:.6g} Hz ({reason}).",
    effect="The resonance is not reported.",
    link="transfer.md",
)
PEAK_DEPARTS = DeclaredNotice(
    "SC-695",
    "warning",
    "The peak at {frequency_hz:.6g} Hz deviates from one oscillator by {ratio:.2g} times the noise.",
    effect="Its frequency and damping ratio depend on the lines that are fitted.",
    remedy="Use the joint fit of `shakercal identify`, or record with finer lines.",
    link="transfer.md",
)
SCALE_UNCERTAINTY_NOT_STATED = DeclaredNotice(
    "SC-696",
    "warning",
    "No uncertainty of the scale is stated for {channels}.",
    effect="U does not include the scale of these channels.",
    remedy="State `scale_uncertainty`.",
    link="transfer.md",
)
