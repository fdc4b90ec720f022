"""Errors and notices of reading a recording: files, manifests, certificates, tables, units."""

from __future__ import annotations

from shakercal._common.notices import DeclaredNotice

# Files.

MISSING_FILE = DeclaredNotice(
    "SC-100",
    "error",
    "expected {expected}, found {found}",
    effect="The recording is not read.",
    remedy="Correct the path, or put the file there.",
    link="recording-format.md",
)
UNREADABLE_FILE = DeclaredNotice(
    "SC-101",
    "error",
    "expected {expected}, found {found}",
    effect="The recording is not read.",
    remedy="Check the permissions of the file and the connection of its drive.",
)
FILE_TOO_LARGE = DeclaredNotice(
    "SC-102",
    "error",
    "expected {expected}, found {found}",
    effect="The file is not read.",
    remedy="Check that the path names the intended file.",
)
WRONG_ENCODING = DeclaredNotice(
    "SC-103",
    "error",
    "expected {expected}, found {found}",
    effect="The file is not read.",
    remedy="Save the file as UTF-8 text.",
)
INVALID_SYNTAX = DeclaredNotice(
    "SC-104",
    "error",
    "expected {expected}, found {found}",
    effect="The file is not read.",
    remedy="Correct the syntax at the stated line.",
    link="recording-format.md",
)
PATH_NOT_ALLOWED = DeclaredNotice(
    "SC-105",
    "error",
    "expected {expected}, found {found}",
    effect="The file is not read.",
    remedy="Use a path relative to the manifest, inside the campaign folder, or `--allow-outside`.",
    link="recording-format.md",
)
NO_RECORDING = DeclaredNotice(
    "SC-106",
    "error",
    "expected {expected}, found {found}",
    effect="The command has no recording to work on.",
    remedy="Name the folder of a recording or of a campaign. `shakercal init FOLDER` drafts a manifest.",
    link="drafting.md",
)
ONE_RECORDING_EXPECTED = DeclaredNotice(
    "SC-107",
    "error",
    "expected {expected}, found {found}",
    effect="The command did not start.",
    remedy="Name the folder of one recording.",
)
RECORDINGS_OF_DIFFERENT_RIGS = DeclaredNotice(
    "SC-108",
    "error",
    "expected {expected}, found {found}",
    effect="The recordings cannot be evaluated together.",
    remedy="Evaluate the recordings of each rig separately.",
    link="campaigns.md",
)
WRONG_EXCITATION_KIND = DeclaredNotice(
    "SC-109",
    "error",
    "expected {expected}, found {found}",
    effect="The command does not evaluate this recording.",
    remedy="Use the command that evaluates this kind of excitation.",
    link="recording-format.md#excitation",
)

# Keys and values of manifests.

UNKNOWN_KEY = DeclaredNotice(
    "SC-110",
    "error",
    "expected {expected}, found {found}",
    effect="The manifest is refused, because a misspelt key would be ignored silently.",
    remedy="Correct the key, or remove it.",
    link="recording-format.md#every-key",
)
MISSING_KEY = DeclaredNotice(
    "SC-111",
    "error",
    "expected {expected}, found {found}",
    effect="The manifest is incomplete.",
    remedy="Add the key.",
    link="recording-format.md#every-key",
)
WRONG_VALUE_TYPE = DeclaredNotice(
    "SC-112",
    "error",
    "expected {expected}, found {found}",
    effect="The manifest is refused. Values are not converted.",
    remedy="Write the value in the type that the format describes.",
    link="recording-format.md#every-key",
)
INVALID_VALUE = DeclaredNotice(
    "SC-113",
    "error",
    "expected {expected}, found {found}",
    effect="The manifest is refused.",
    remedy="Correct the value.",
    link="recording-format.md#every-key",
)
VALUE_OUT_OF_RANGE = DeclaredNotice(
    "SC-114",
    "error",
    "expected {expected}, found {found}",
    effect="The manifest is refused.",
    remedy="Check the value and its unit. Manifests use SI units without prefixes.",
    link="recording-format.md#every-key",
)
KEY_NOT_APPLICABLE = DeclaredNotice(
    "SC-115",
    "error",
    "expected {expected}, found {found}",
    effect="The manifest is refused, because the key would have no effect.",
    remedy="Remove the key, or correct the kind of the table.",
    link="recording-format.md#every-key",
)
REPEATED_NAME = DeclaredNotice(
    "SC-116",
    "error",
    "expected {expected}, found {found}",
    effect="Results could not be assigned to one of them.",
    remedy="Give each a separate name.",
)
UNKNOWN_NAME = DeclaredNotice(
    "SC-117",
    "error",
    "expected {expected}, found {found}",
    effect="The manifest is refused.",
    remedy="Correct the name, or add the entry that it refers to.",
    link="recording-format.md",
)
CONTRADICTING_VALUES = DeclaredNotice(
    "SC-118",
    "error",
    "expected {expected}, found {found}",
    effect="The manifest is refused.",
    remedy="Correct one of the two statements.",
    link="recording-format.md",
)
IMPOSSIBLE_MASS_PROPERTIES = DeclaredNotice(
    "SC-119",
    "error",
    "expected {expected}, found {found}",
    effect="No body has this mass and these moments of inertia.",
    remedy="State the mass in kg and the inertia in kg m^2 about the centre of mass.",
    link="recording-format.md#load",
)
NAME_NOT_USABLE_IN_FILES = DeclaredNotice(
    "SC-120",
    "error",
    "expected {expected}, found {found}",
    effect="Results are written to files with this name, which not every system accepts.",
    remedy="Choose another name.",
)
UNFILLED_VALUE = DeclaredNotice(
    "SC-121",
    "error",
    "expected {expected}, found {found}",
    effect="The drafted manifest is incomplete.",
    remedy='Replace "?" with the value.',
    link="drafting.md",
)
INVALID_UNCERTAINTY_STATEMENT = DeclaredNotice(
    "SC-122",
    "error",
    "expected {expected}, found {found}",
    effect="The standard uncertainty cannot be determined.",
    remedy="State value, U (or U_relative) and k as the certificate does.",
    link="recording-format.md#inputs-as-certificates-state-them",
)
CONTRADICTING_DIRECTION = DeclaredNotice(
    "SC-123",
    "error",
    "expected {expected}, found {found}",
    effect="The direction of the beam is ambiguous.",
    remedy="Correct the direction, the point or the head; or remove the direction of a beam that a mirror aims.",
    link="recording-format.md#headname",
)
FRAMES_DO_NOT_MATCH = DeclaredNotice(
    "SC-124",
    "error",
    "expected {expected}, found {found}",
    effect="The images or points of this pair cannot be evaluated.",
    remedy="Check which files the patterns match.",
    link="recording-format.md#images",
)
ONE_SET_UP_EXPECTED = DeclaredNotice(
    "SC-125",
    "error",
    "expected {expected}, found {found}",
    effect="The command does not evaluate recordings of several set-ups.",
    remedy="Move each set-up to a separate recording folder.",
    link="recording-format.md#take",
)
REFERENCE_CHANNEL_REQUIRED = DeclaredNotice(
    "SC-126",
    "error",
    "expected {expected}, found {found}",
    effect="The phases of the set-ups cannot be related.",
    remedy="Mark the same channel with `reference = true` in every set-up.",
    link="recording-format.md#take",
)

# Channels of DAQ files.

NONUNIFORM_SAMPLES = DeclaredNotice(
    "SC-130",
    "error",
    "expected {expected}, found {found}",
    effect="The channel cannot be evaluated by this command.",
    remedy="Record the channel without pauses and at a constant rate.",
    link="recording-format.md#what-is-read-from-daq-files",
)
NON_FINITE_SAMPLES = DeclaredNotice(
    "SC-131",
    "error",
    "expected {expected}, found {found}",
    effect="The channel cannot be evaluated.",
    remedy="Export the channel again, or shorten the record.",
    link="recording-format.md#what-is-read-from-daq-files",
)
TOO_FEW_SAMPLES = DeclaredNotice(
    "SC-132",
    "error",
    "expected {expected}, found {found}",
    effect="The channel cannot be evaluated.",
    remedy="Check that the file is complete.",
)
CONSTANT_CHANNEL = DeclaredNotice(
    "SC-133",
    "error",
    "expected {expected}, found {found}",
    effect="The channel carries no signal.",
    remedy="Check the cable and the name of the channel, or remove the channel from the manifest.",
)
SCALE_REQUIRED = DeclaredNotice(
    "SC-134",
    "error",
    "expected {expected}, found {found}",
    effect="The unit of the file cannot be converted into the unit of the quantity.",
    remedy="State the `scale` of the channel.",
    link="recording-format.md#units-of-files",
)
UNKNOWN_DATA_SET = DeclaredNotice(
    "SC-135",
    "error",
    "expected {expected}, found {found}",
    effect="The channel cannot be read.",
    remedy="Name a data set of the scan: BLOCK, or BLOCK/POINT.",
    link="recording-format.md#what-is-read-from-daq-files",
)
ONE_SCAN_EXPECTED = DeclaredNotice(
    "SC-136",
    "error",
    "expected {expected}, found {found}",
    effect="The scans cannot be assigned to each other.",
    remedy="Describe each scan in a separate recording.",
)

UNREADABLE_DAQ_FILE = DeclaredNotice(
    "SC-137",
    "error",
    "{reason}",
    effect="The channels of this file are not read.",
    remedy="Correct the names of the file and of its channels, or export the file again.",
    link="recording-format.md#what-is-read-from-daq-files",
)

# Tables and chains of frequency responses.

MISSING_RESPONSE_COLUMN = DeclaredNotice(
    "SC-140",
    "error",
    "expected {expected}, found {found}",
    effect="The frequency response of the channel is not read.",
    remedy="Add the column, or name the columns of the file in `response_columns`.",
    link="recording-format.md#response-files",
)
INVALID_RESPONSE_VALUE = DeclaredNotice(
    "SC-141",
    "error",
    "expected {expected}, found {found}",
    effect="The frequency response of the channel is not read.",
    remedy="Correct the table.",
    link="recording-format.md#response-files",
)
RESPONSE_RANGE_TOO_SMALL = DeclaredNotice(
    "SC-142",
    "error",
    "expected {expected}, found {found}",
    effect="The response of the channel is not known at a frequency of the recording. It is not extrapolated.",
    remedy="Use a table that covers all frequencies of the recording.",
    link="recording-format.md#response-files",
)
RESPONSE_UNIT_CONTRADICTION = DeclaredNotice(
    "SC-143",
    "error",
    "expected {expected}, found {found}",
    effect="The frequency response of the channel is not read.",
    remedy="Correct the unit in the file or in `response_columns`.",
    link="recording-format.md#response_columns-of-a-channel",
)
PHASE_NOT_IN_RADIANS = DeclaredNotice(
    "SC-144",
    "error",
    "expected {expected}, found {found}",
    effect="The phase of the response would be wrong.",
    remedy='State `phase_unit = "deg"` in `response_columns`, or convert the column.',
    link="recording-format.md#response_columns-of-a-channel",
)
AMBIGUOUS_PHASE_SIGN = DeclaredNotice(
    "SC-145",
    "error",
    "expected {expected}, found {found}",
    effect="The sign of the phase is ambiguous.",
    remedy="Use a column whose name states a phase, or a lag with positive numbers.",
    link="recording-format.md#response-files",
)

UNREADABLE_RESPONSE_FILE = DeclaredNotice(
    "SC-146",
    "error",
    "{reason}",
    effect="The frequency response of the channel is not read.",
    remedy="Correct the file, or the names in `response_columns`.",
    link="recording-format.md#response-files",
)

# Digital Calibration Certificates.

INVALID_CERTIFICATE_FILE = DeclaredNotice(
    "SC-150",
    "error",
    "expected {expected}, found {found}",
    effect="The certificate is not used.",
    remedy="Ask the laboratory for a certificate in the DCC schema, or type its values.",
    link="recording-format.md#inputs-as-certificates-state-them",
)
CERTIFICATE_CHANGED = DeclaredNotice(
    "SC-151",
    "error",
    "expected {expected}, found {found}",
    effect="The certificate was changed after signing and is not used.",
    remedy="Ask the laboratory for the original file.",
    link="recording-format.md#inputs-as-certificates-state-them",
)
SIGNATURE_NOT_CHECKED = DeclaredNotice(
    "SC-152",
    "warning",
    "The signature of the certificate was not checked: {reason}.",
    effect="A change after signing would not be noticed.",
    remedy="Verify the file with the laboratory's tool.",
    link="recording-format.md#inputs-as-certificates-state-them",
)
SIGNER_NOT_VERIFIED = DeclaredNotice(
    "SC-153",
    "note",
    "The content of the certificate was not changed after signing: its digests agree.",
    effect="The identity of the signer was not verified.",
    link="recording-format.md#inputs-as-certificates-state-them",
)
CERTIFICATE_EXPIRED = DeclaredNotice(
    "SC-154",
    "warning",
    "The certificate of {key} ({source}) was not valid on {day}.",
    effect="The stated uncertainty may be too small.",
    remedy="Have the instrument recalibrated, or state the value of a valid certificate.",
    link="recording-format.md#inputs-as-certificates-state-them",
)
CERTIFIED_RESULT_NOT_FOUND = DeclaredNotice(
    "SC-155",
    "error",
    "expected {expected}, found {found}",
    effect="The certificate is not used.",
    remedy="Name one result of the certificate by its id, name or type.",
    link="recording-format.md#inputs-as-certificates-state-them",
)
CERTIFIED_UNIT_MISMATCH = DeclaredNotice(
    "SC-156",
    "error",
    "expected {expected}, found {found}",
    effect="The result of the certificate does not fit the key.",
    remedy="Name another result of the certificate, or correct the key.",
    link="recording-format.md#inputs-as-certificates-state-them",
)
CERTIFIED_VALUE_NOT_USABLE = DeclaredNotice(
    "SC-157",
    "error",
    "expected {expected}, found {found}",
    effect="The result of the certificate is not used.",
    remedy="Name another result of the certificate, or type value, U and k.",
    link="recording-format.md#inputs-as-certificates-state-them",
)
KEY_TAKES_NO_CERTIFICATE = DeclaredNotice(
    "SC-158",
    "error",
    "expected {expected}, found {found}",
    effect="The manifest is refused.",
    remedy="Type the value at this key.",
    link="recording-format.md#inputs-as-certificates-state-them",
)

# Units of files compared with the scale of channels.

OUTPUT_EXCEEDS_SUPPLY = DeclaredNotice(
    "SC-180",
    "warning",
    "{key}: the output has an amplitude of {amplitude:.3g} V/V, more than its supply.",
    effect="The sensitivity would be wrong by a factor.",
    remedy="Check `scale` and `in_file` of the channel.",
    link="recording-format.md#units-of-files",
)
UNKNOWN_FILE_UNIT = DeclaredNotice(
    "SC-181",
    "warning",
    '{key}: the file states the unit "{unit}", which is not recognised. It is taken as {quantity_unit}.',
    effect="The results would be wrong by a factor if it is another unit.",
    remedy="State the `scale` of the channel.",
    link="recording-format.md#units-of-files",
)
RESPONSE_WITHOUT_UNIT = DeclaredNotice(
    "SC-182",
    "warning",
    '{key}: the file states the unit "{unit}" and the response states none. It is taken as the sensitivity per {unit}.',
    effect="The results would be wrong by a factor if it is not.",
    remedy="State the `scale` of the channel, or the unit of the response in `response_columns`.",
    link="recording-format.md#units-of-files",
)
SCALE_CONTRADICTS_UNIT = DeclaredNotice(
    "SC-183",
    "warning",
    '{key}: the file states the unit "{unit}", which {factor:.6g} converts into {quantity_unit}. The stated scale is '
    "{scale:g}.",
    effect="The results would be wrong by a factor.",
    remedy="Check the scale.",
    link="recording-format.md#units-of-files",
)
CONVERTER_CODES = DeclaredNotice(
    "SC-184",
    "warning",
    '{key}: the file states the unit "{unit}", codes of a converter. One code is taken as 1 {quantity_unit}.',
    effect="The results would be wrong by a factor.",
    remedy="State in `scale` how much one code is.",
    link="recording-format.md#units-of-files",
)
CERTIFIED_SCALE_UNIT = DeclaredNotice(
    "SC-185",
    "warning",
    '{key}: the file states the unit "{unit}", and the scale is that of a certificate. It is taken as per {unit}.',
    effect="The results would be wrong by a factor if the certificate means another unit.",
    remedy="Check the unit of the certificate.",
    link="recording-format.md#units-of-files",
)
UNIT_OF_ANOTHER_QUANTITY = DeclaredNotice(
    "SC-186",
    "warning",
    '{key}: the file states the unit "{unit}", which no factor converts into {quantity_unit}.',
    effect="The channel may measure another quantity than {quantity}.",
    remedy="Check the quantity and the name of the channel.",
    link="recording-format.md#units-of-files",
)
