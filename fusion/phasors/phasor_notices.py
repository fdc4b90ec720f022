"""Notices and errors of the stage from recorded files to the phasors of every instrument."""

from shakercal._common.notices import DeclaredNotice

# Lines and channels.

LINE_ABOVE_SAMPLING = DeclaredNotice(
    "SC-400",
    "error",
    "expected {expected}, found {found}",
    effect="The channels cannot resolve this line.",
    remedy="Correct `excitation.frequencies`, record with a higher sampling rate, or remove the channel.",
    link="signals.md",
)
LINES_NOT_FOUND = DeclaredNotice(
    "SC-401",
    "error",
    "{reason} ({instruments})",
    effect="Without the lines no phasor can be determined.",
    remedy="Compare `excitation.frequencies` with the spectrum of the recording.",
    link="signals.md",
)
LINES_FROM_BAND = DeclaredNotice(
    "SC-402",
    "note",
    "The manifest states no frequencies; {count} lines were found in the band: {frequencies} Hz.",
    remedy="State `excitation.frequencies` if these are not the driven lines.",
    link="signals.md",
)
ALIASED_HARMONICS = DeclaredNotice(
    "SC-403",
    "note",
    "At {rate_hz:g} samples per second, {aliases}.",
    effect="The recording cannot separate them from the driven line.",
    remedy="Use an anti-aliasing filter and state it as `response`, or choose another frequency.",
    link="signals.md",
)
HIGH_HARMONICS_NOT_ASSESSED = DeclaredNotice(
    "SC-404",
    "note",
    "High harmonics that alias onto a driven line at {rate_hz:g} samples per second: {aliases}.",
    remedy="State the anti-aliasing filter as `response`.",
    possible_size="below a third of u of the line, by the harmonics that were measured",
    link="signals.md",
)
FILTER_DELAY = DeclaredNotice(
    "SC-405",
    "warning",
    "A low-pass filter with the stated delay of {delay_us:.4g} µs changes {frequency_hz:.6g} Hz by up to {loss:.2%}.",
    effect="U includes this change.",
    remedy='State delay_of = "pure" if no filter causes the delay; otherwise state the filter as `response`.',
    link="signals.md",
)
UNUSABLE_CHANNEL = DeclaredNotice(
    "SC-406",
    "error",
    "expected {expected}, found {found}",
    effect="The channel has too few usable samples for a phasor.",
    remedy="Repeat the recording with another input range, or remove the channel.",
    link="signals.md",
)
REJECTED_SAMPLES = DeclaredNotice(
    "SC-407",
    "warning",
    "The channel {defect}.",
    effect="These samples are rejected.",
    remedy="Check the recorder and its memory.",
    link="signals.md",
)
CLIPPED_CHANNEL = DeclaredNotice(
    "SC-408",
    "warning",
    "The channel {defect}.",
    effect="These samples are rejected, which leaves {u_percent:.2g} % of the amplitude undetermined; U includes it.",
    remedy="Use a larger input range of the recorder.",
    link="signals.md",
)
COARSE_CONVERTER = DeclaredNotice(
    "SC-409",
    "warning",
    "The driven line has an amplitude of only {steps:.2g} converter steps.",
    effect="Quantisation changes it by up to {bound_percent:.2g} %, which U includes.",
    remedy="Use a smaller input range of the recorder.",
    link="signals.md",
)
TIME_STAMP_GAP = DeclaredNotice(
    "SC-410",
    "note",
    "The file has a gap: {gap}.",
    effect="Sines are fitted at the times that the file states.",
    link="signals.md",
)
HARMONIC_UNRESOLVED = DeclaredNotice(
    "SC-411",
    "warning",
    "{take} cannot separate harmonic {order} of {fundamental_hz:g} Hz from another line.",
    effect="This harmonic is omitted from all takes.",
    remedy="Record every take with the same sampling rate and length.",
    link="signals.md",
)

# Steady excitation and distortion.

LINE_UNSTEADY = DeclaredNotice(
    "SC-412",
    "warning",
    "The {quantity} at {frequency_hz:.6g} Hz changes over the record: {changes}.",
    effect="Results are means over the record of each instrument.",
    remedy="Wait until the excitation is steady, or record all instruments at the same time.",
    link="signals.md",
)
OUTPUT_UNSTEADY = DeclaredNotice(
    "SC-413",
    "warning",
    "The {quantity} of outputs at {frequency_hz:.6g} Hz changes over the record, the motion does not: {changes}.",
    effect="U includes a change of this size in any direction. Results are means over the record of each instrument.",
    remedy="Check for an aliased harmonic (no anti-aliasing filter) and for drift of the amplifier.",
    link="signals.md",
)
HARMONIC_DISTORTION = DeclaredNotice(
    "SC-414",
    "warning",
    "Distortion: harmonic {order} of {frequency_hz:.6g} Hz exceeds that of {reference} by ({share} ± {expanded}) % of "
    "the fundamental.",
    effect="The {device} is not linear. U includes {u_percent:.2g} % in any direction.",
    remedy="Reduce the load or the input level.",
    link="signals.md",
)
CUBIC_DISTORTION = DeclaredNotice(
    "SC-415",
    "warning",
    "Distortion: harmonic 3 of {frequency_hz:.6g} Hz exceeds that of {reference} by ({share} ± {expanded}) % of the "
    "fundamental.",
    effect="The {device} is not linear. A cubic characteristic makes the ratio at the fundamental too {sign} by about "
    "{ratio_percent:.2g} %. U includes {u_percent:.2g} % in any direction.",
    remedy="Reduce the load or the input level.",
    link="signals.md",
)

# Clocks, triggers and the instants of frames.

PERIODS_DISAGREE = DeclaredNotice(
    "SC-416",
    "warning",
    "Frames and other records give trigger periods that differ by {difference:.2g} of the period (u {u:.2g}).",
    effect="The period measured from the trigger's edges is used.",
    remedy="Check for missing frames or edges, and whether the camera sees the body of the channels.",
    link="clocks.md",
)
INVERTED_TRIGGER = DeclaredNotice(
    "SC-417",
    "warning",
    "The pulses of {trigger} last {first_share:.1%} of the period in {first_block} and {second_share:.1%} in "
    "{second_block}.",
    effect="One of them is probably inverted, so that different edges are paired.",
    remedy='State edge = "falling" for the inverted channel.',
    link="clocks.md",
)
NO_SHARED_TRIGGER = DeclaredNotice(
    "SC-418",
    "error",
    "expected {expected}, found {found}",
    effect="The clocks of the two blocks cannot be tied.",
    remedy="Record the same trigger in both blocks.",
    link="clocks.md",
)
EDGES_AMBIGUOUS = DeclaredNotice(
    "SC-419",
    "error",
    "expected {expected}, found {found}",
    effect="The frames cannot be assigned to edges of the trigger.",
    remedy="State `first_edge` or `edge_step`.",
    link="clocks.md",
)
TOO_FEW_EDGES = DeclaredNotice(
    "SC-420",
    "error",
    "expected {expected}, found {found}",
    effect="Some frames have no edge of the trigger.",
    remedy="Check `trigger`, `first_edge` and the number of frames.",
    link="clocks.md",
)
EXPOSURE_REFUSED = DeclaredNotice(
    "SC-421",
    "error",
    "expected {expected}, found {found}",
    effect="The instants of the frames depend on exposure and row time, which must end before the next frame.",
    remedy="State `exposure` and `row_time` in seconds.",
    link="recording-format.md",
)
FRAME_NUMBERS_SHIFTED = DeclaredNotice(
    "SC-422",
    "warning",
    "The file numbers begin with {first} ({first_camera}) and {second} ({second_camera}).",
    effect="Frames are paired in their order. If equal numbers belong to one edge, one camera is late.",
    remedy="Check which frames belong together, and state `first_edge` of each camera if these are others.",
    link="cameras.md#frames-of-other-edges",
)
FRAME_NUMBER_GAP = DeclaredNotice(
    "SC-423",
    "warning",
    "The numbers of the {count} files from {first} to {last} have gaps: {missing} are missing.",
    effect="The frames after a gap are assigned to edges by {assignment}.",
    remedy="Check whether frames were lost.",
    link="clocks.md",
)

# Images of a pair before tracking.

IMAGES_REFUSED = DeclaredNotice(
    "SC-424",
    "error",
    "expected {expected}, found {found}",
    effect="The images of the pair cannot be evaluated.",
    remedy="Correct the `images` block of recording.toml, or remove the pair.",
    link="recording-format.md",
)
COPIED_FRAMES = DeclaredNotice(
    "SC-425",
    "warning",
    "The {camera} camera has {count} copies of earlier frames: {names}.",
    effect="These frames of the pair are rejected.",
    remedy="Check the recorder for lost frames.",
    link="recording-format.md",
)
EXPOSURE_DIFFERS = DeclaredNotice(
    "SC-426",
    "warning",
    "The file states an exposure of {file_us:.4g} µs; {used_us:.4g} µs is used.",
    effect="A wrong exposure changes amplitude and phase of the motion.",
    remedy="Correct `exposure`.",
    link="recording-format.md",
)
FRAME_RATE_DIFFERS = DeclaredNotice(
    "SC-427",
    "warning",
    "The file has a frame every {frame_s:.6g} s, the trigger an edge every {edge_s:.6g} s.",
    effect="Frames may belong to other edges.",
    remedy="Check `trigger`, `first_edge` and `edge_step`.",
    link="clocks.md",
)
FILE_TIMES_GAP = DeclaredNotice(
    "SC-428",
    "warning",
    "The times in the file have gaps between frames {frames}.",
    effect="Frames were lost, or the times are wrong.",
    remedy="Check the recording software for lost frames.",
    link="clocks.md",
)
SINGLE_CAMERA_NOT_ASSESSED = DeclaredNotice(
    "SC-429",
    "note",
    "Deformation, the position of the stated surface and the calibration: a single camera cannot measure them.",
    remedy="Use a second camera.",
    possible_size="not known",
    link="cameras.md",
)
CALIBRATION_REFUSED = DeclaredNotice(
    "SC-430",
    "error",
    "expected {expected}, found {found}",
    effect="The calibration does not fit the images of the pair.",
    remedy="Use the calibration of this pair with this image size.",
    link="cameras.md",
)

# Motion that a pair measures.

PAIR_REJECTED = DeclaredNotice(
    "SC-431",
    "warning",
    "The pair is rejected: {reason}.",
    effect="The other instruments are evaluated without it.",
    remedy="Inspect the images and the calibration of the pair.",
    link="tracking.md",
)
NO_RIGID_MOTION = DeclaredNotice(
    "SC-432",
    "error",
    "The motion of stereo pair {pair} cannot be fitted: {reason}.",
    remedy="Inspect its images or points.",
    link="tracking.md",
)
PAIR_DECALIBRATED = DeclaredNotice(
    "SC-433",
    "error",
    "{reason}",
    effect="The cameras are no longer as calibrated.",
    remedy="Calibrate the cameras again.",
    link="cameras.md",
)
CAMERAS_OUT_OF_STEP = DeclaredNotice(
    "SC-434",
    "error",
    "The {late} camera is later than the {early} one by {delay_ms:.4g} ms (frames: {frames}). To state it: {stated}"
    "{alike}.",
    effect="The images of the two cameras do not belong together.",
    remedy="If one camera began to save earlier, state this key; other instruments show which camera is right. "
    "Otherwise check the trigger of both.",
    link="cameras.md#frames-of-other-edges",
)
FRAMES_OUT_OF_ORDER = DeclaredNotice(
    "SC-515",
    "error",
    "Frames were lost or repeated: {changes} (frames from 0). To state it: {stated}{alike}.",
    effect="These frames show the body at other edges of the trigger than assumed.",
    remedy="If the recorder lost or repeated frames there, state this key.",
    link="cameras.md#frames-of-other-edges",
)
ROWS_INTERLACED = DeclaredNotice(
    "SC-517",
    "error",
    "Odd and even rows of the {side} camera are exposed at different times: they differ by {distance_px:.2g} px (rms) "
    "while the body moves by {moved_px:.2g} px.",
    effect="The camera is interlaced. Amplitude and phase are those of neither half of the rows.",
    remedy="Record all rows at once (progressive), or save each half as an image with its own instants.",
    link="cameras.md#interlaced-rows",
)
FRAMES_OF_OTHER_EDGES = DeclaredNotice(
    "SC-516",
    "warning",
    "The pair agrees with {instruments} if its frames belong to edges that are {side} by {count} (a phase of "
    "{phase_mrad:.3g} mrad at {frequency_hz:.6g} Hz). To state it: {stated}.",
    effect="The instruments contradict each other. A wrong edge turns the phase of the pair.",
    remedy="Check which edge belongs to the first frame.",
    link="cameras.md#frames-of-other-edges",
)
CAMERA_DELAYED = DeclaredNotice(
    "SC-435",
    "warning",
    "The {late} camera is exposed {delay_us:.3g} µs later than the other one ({phase_mrad:.3g} mrad at "
    "{frequency_hz:.6g} Hz, u {u_mrad:.2g} mrad).",
    effect="The error of depth and phase is not included in U.",
    remedy="Synchronise the exposures of the two cameras.",
    link="shutter.md",
)
PAIR_BODY_DEFORMS = DeclaredNotice(
    "SC-436",
    "warning",
    "The body deforms at {frequency_hz:.6g} Hz: {shape} of {amplitude_nm:.3g} nm (u {u_nm:.2g} nm, chance "
    "{chance:.1e} for a rigid body).",
    effect="The body bends or stretches, or one camera moves relative to the other.",
    remedy="State [[load.elastic]] with `measured_by`, or check the mounting of the cameras.",
    link="modes.md",
)
BODY_DISPLACED = DeclaredNotice(
    "SC-437",
    "warning",
    "The body moves by {distance_mm:.3g} mm between frames {before} and {after} (from 0) and remains there.",
    effect="U includes the effect on the lines.",
    remedy="Check whether the body was touched.",
    link="tracking.md",
)
BODY_LOST = DeclaredNotice(
    "SC-438",
    "error",
    "The body moves by {distance_mm:.3g} mm between frames {before} and {after} (from 0), more than its whole motion.",
    effect="It was touched, or tracking followed another part of a repeating pattern.",
    remedy="Repeat the recording, or use a pattern that does not repeat.",
    link="tracking.md",
)
TOO_FEW_FRAMES_FOR_STEP = DeclaredNotice(
    "SC-439",
    "note",
    "A displacement of the body within the record: {frames} frames are too few to detect it, {needed} are needed.",
    remedy="Record more frames.",
    possible_size="not known",
    link="tracking.md",
)
UNEQUAL_FRAMES = DeclaredNotice(
    "SC-440",
    "warning",
    "The variance of the measured motion differs between frames by up to a factor of {factor:.2g}.",
    effect="Each frame is weighted by its variance.",
    remedy="Check the illumination and whether the body is partly hidden.",
    link="tracking.md",
)
ROLLING_SHUTTER = DeclaredNotice(
    "SC-441",
    "note",
    "The rows of the body are exposed over {duration_ms:.3g} ms, in which {frequency_hz:.6g} Hz turns by {angle:.3g}°.",
    effect="Every row is evaluated at its exposure.",
    link="shutter.md",
)
COARSE_ROWS = DeclaredNotice(
    "SC-442",
    "warning",
    "The rows of the smallest cells span {periods:.2g} periods of {frequency_hz:.6g} Hz.",
    effect="The effect on the phasors is not included in U.",
    remedy="Use a shorter `row_time` or smaller cells.",
    link="shutter.md",
)
MOTION_BLUR = DeclaredNotice(
    "SC-443",
    "note",
    "Motion blur in exposures of {exposure_ms:.3g} ms would bias the amplitude by about {bias_percent:.2g} %.",
    effect="The fit accounts for the blur.",
    link="shutter.md",
)
SHUTTER_NOT_CONVERGED = DeclaredNotice(
    "SC-444",
    "warning",
    "The fit of the motion within exposures did not converge: {change_percent:.2g} % remains.",
    effect="This error is not included in U.",
    remedy="Use a shorter exposure.",
    link="shutter.md",
)
STORAGE_FULL = DeclaredNotice(
    "SC-445",
    "error",
    "The tracked subsets of stereo pair {pair}, frames {first} to {last}, cannot be stored: {reason}.",
    remedy="Free space on the disk of the results.",
    link="tracking.md",
)

# Lines that the frames of a pair resolve.

NO_INSTRUMENT = DeclaredNotice(
    "SC-446",
    "error",
    "No channel or camera of this recording measures {quantity}{reason}.",
    effect="The recording has no result.",
    remedy="Add such an instrument to recording.toml.",
    link="recording-format.md",
)

LINES_UNRESOLVED = DeclaredNotice(
    "SC-447",
    "error",
    "No instrument measures the motion of the driven line at {frequencies}{reasons}.",
    effect="The recording has no result.",
    remedy="Choose another frame rate, or add a channel that measures the motion.",
    link="planning.md",
)
LINE_UNOBSERVED = DeclaredNotice(
    "SC-448",
    "warning",
    "No instrument measures the motion at the driven line {frequency_hz:.6g} Hz.",
    effect="This line has no result.",
    remedy="Choose another frame rate, or add a channel that measures the motion.",
    link="planning.md",
)
HARMONIC_WITHOUT_FUNDAMENTAL = DeclaredNotice(
    "SC-449",
    "warning",
    "The harmonic is rejected because its fundamental is not resolved.",
    effect="The pair has no value at this line.",
    remedy="Choose another frame rate.",
    link="planning.md",
)
SHORT_BEAT = DeclaredNotice(
    "SC-450",
    "warning",
    "The record contains {beats:.2g} beats of {frequency_hz:.6g} Hz ({frames} frames at {rate_hz:.6g} Hz).",
    effect="U of the amplitude is dominated by effects that are not separated from the line: {causes} (u).",
    remedy="Record longer, or choose another frame rate{suggestion}.",
    link="planning.md",
)
PERIODIC_JITTER = DeclaredNotice(
    "SC-451",
    "warning",
    "The edges of trigger {trigger} scatter by {jitter_us:.2g} µs about equal distances.",
    effect="If the jitter is periodic rather than random, it could change {frequency_hz:.6g} Hz by up to "
    "{change_percent:.2g} %, which is not included in U.",
    remedy="Record the trigger with a higher sampling rate, or use a steadier trigger.",
    link="clocks.md",
)
FREQUENCIES_UNSTATED = DeclaredNotice(
    "SC-452",
    "error",
    "expected {expected}, found {found}",
    effect="Cameras alone cannot determine the frequencies.",
    remedy="State `excitation.frequencies`.",
    link="recording-format.md",
)

# Channels at common times.

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

# Chirps, noise and blows with images.

BROADBAND_REFUSED = DeclaredNotice(
    "SC-939",
    "error",
    "expected {expected}, found {found}",
    effect="The motion of the frames follows from the spectrum of the channels in the band.",
    remedy="Correct the key; without images use `shakercal transfer`.",
    link="sweeps.md",
)
LINES_WITHOUT_SIGNAL = DeclaredNotice(
    "SC-944",
    "warning",
    "No channel follows the reference at {frequencies} Hz.",
    effect="These frequencies have no result.",
    remedy="Excite them, state a narrower `band`, or choose another `reference`.",
    link="sweeps.md",
)
TOO_FEW_FRAMES_FOR_BROADBAND = DeclaredNotice(
    "SC-947",
    "error",
    "{reason}",
    effect="The frames cannot determine how the body follows the channels.",
    remedy="Record longer, or with fewer channels.",
    link="sweeps.md",
)
ROWS_NEED_LINES = DeclaredNotice(
    "SC-948",
    "error",
    "The rows of a rolling shutter can be corrected at the lines of sines only.",
    effect="The pair is not used for a chirp, noise or blows.",
    remedy="Use cameras with a global shutter, or sines.",
    link="sweeps.md",
)

# Takes.

TAKES_REFUSED = DeclaredNotice(
    "SC-453",
    "error",
    "expected {expected}, found {found}",
    effect="The takes cannot be referred to the first one.",
    remedy="Excite the same lines in all takes and state `reference = true` for one channel with a strong signal.",
    link="signals.md",
)
REFERENCE_DRIFT = DeclaredNotice(
    "SC-454",
    "note",
    "Reference {reference} differs from the first take by {drift_percent:+.2g} % at {frequency_hz:.6g} Hz.",
    effect="The level is corrected; U includes the drift.",
    link="signals.md",
)
LARGE_REFERENCE_DRIFT = DeclaredNotice(
    "SC-455",
    "warning",
    "Reference {reference} differs from the first take by {drift_percent:+.2g} % at {frequency_hz:.6g} Hz.",
    effect="The level is corrected; U includes the drift.",
    remedy="Check whether the excitation or the reference changed between takes.",
    link="signals.md",
)
TAKE_FREQUENCY_DIFFERS = DeclaredNotice(
    "SC-456",
    "warning",
    "The driven frequency is {frequency_hz:.7g} Hz, in the first take {first_hz:.6g} Hz.",
    effect="U includes the relative difference.",
    remedy="Use the same frequency in all takes.",
    link="signals.md",
)
TAKES_SCATTER = DeclaredNotice(
    "SC-457",
    "warning",
    "Readings of takes differ by {spread_percent:.2g} % at {frequency_hz:.6g} Hz (standard deviation beyond noise and "
    "drift).",
    effect="U includes the scatter.",
    remedy="Check for changes between takes.",
    link="signals.md",
)
FRAMES_FREE_RUNNING = DeclaredNotice(
    "SC-957",
    "warning",
    "No trigger dates the frames: their motion determines the rate, {rate_hz:.8g} Hz (relative u {u_relative:.1e}), "
    "but not when they began.",
    effect="Magnitudes are valid. The phase relative to other instruments is unknown, and its U covers a whole turn.",
    remedy="Use a strobe or an LED whose signal is recorded as the trigger, if the phase is required.",
    link="one-camera.md#a-film-without-a-trigger",
)
