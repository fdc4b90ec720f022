"""Reading of manifests: recording.toml with its rig.toml, checked.

Every error becomes one `InputError` that names file and key.
"""

from __future__ import annotations

import logging
from collections.abc import Collection, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field, replace
from datetime import date as Date
from functools import cached_property
from pathlib import Path
from typing import Any

from fusion.base import FileIdentity, check_names, natural_key
from fusion.errors import InputError
from fusion.recording.acknowledged import Acknowledgement
from fusion.recording.certified import CertifiedInputs, resolve_certificates
from fusion.recording.cross_checks import find_contradictions
from fusion.recording.excitation import KINDS, ONE_SET_UP, ExcitationEntry, join_alternatives, kinds_of
from fusion.recording.instruments import complete_channels, without_defaults
from fusion.recording.manifest import (
    KEYS,
    Daq,
    Images,
    PointFiles,
    RecordingFile,
    RigContext,
    Take,
)
from fusion.recording.plausibility import plausibility_notices
from fusion.recording.recording_notices import (
    CERTIFICATE_EXPIRED,
    INVALID_VALUE,
    MISSING_FILE,
    NO_RECORDING,
    ONE_RECORDING_EXPECTED,
    ONE_SET_UP_EXPECTED,
    PATH_NOT_ALLOWED,
    RECORDINGS_OF_DIFFERENT_RIGS,
    UNREADABLE_FILE,
    WRONG_EXCITATION_KIND,
)
from fusion.recording.repair import AnyBlock, Repair, is_doubtful
from fusion.recording.rig import InstrumentHead, Rig, RigPart, Shaker, Stereo
from fusion.recording.toml import (
    UncertainInput,
    expand_statements,
    find_unfilled,
    quote_key,
    read_toml,
    uncertain_inputs,
)
from fusion.recording.values import Context, PathScope, describe
from shaker.io import unsupported_suffix
from shakercal._common.notices import Notice

log = logging.getLogger("shakercal")
RECORDING_NAME = "recording.toml"
TRUTH = "truth.json"
"""File that the simulator writes next to a recording: marks it as simulated."""
SIMULATED_NAME = ", simulated"
"""End of the name of a simulated recording."""
PLACEHOLDER_MIRROR_M = 1e6
"""Coordinates of a mirror that is no channel's point, for heads of a rig with errors."""


@dataclass(frozen=True)
class Manifest:
    """One recording with its rig; every path and every reference exists.

    Attributes
    ----------
    path, folder : recording.toml and its folder.
    root, rig_path : folder of rig.toml, and rig.toml.
    rig : the rig, with the environment of the recording.
    mounting : recordings with another text were mounted again.
    part : parts of rig and recording.
    files : every input file, both manifests first.
    inputs : inputs with an uncertainty.
    signature_notices : notices of the signatures of certificates.
    file_identities : identities of the files when the manifests were read.
    acknowledged : acknowledgements of notices.
    address : where the recording is, if that is not `path`: its address in an object store.

    Examples
    --------
    >>> from fusion import Manifest, load_manifest
    >>> manifest = load_manifest("sample_images/demo/Fz-0080")
    >>> isinstance(manifest, Manifest), manifest.excitation.kind, manifest.rig.sensor.channels
    (True, 'sine', ('Fx', 'Fy', 'Fz', 'Mx', 'My', 'Mz'))
    """

    path: Path
    folder: Path
    root: Path
    rig_path: Path
    rig: Rig
    name: str
    mounting: str
    excitation: ExcitationEntry
    daq: tuple[Daq, ...]
    images: tuple[Images, ...]
    points: tuple[PointFiles, ...]
    take: tuple[Take, ...]
    part: tuple[RigPart, ...]
    shaker: Shaker
    files: tuple[Path, ...]
    date: Date | None = None
    operator: str | None = None
    procedure: str | None = None
    simulated: bool = False
    acknowledged: tuple[Acknowledgement, ...] = ()
    inputs: tuple[UncertainInput, ...] = ()
    signature_notices: tuple[Notice, ...] = ()
    file_identities: Mapping[Path, FileIdentity] = field(default_factory=dict)
    address: str = ""

    def __repr__(self) -> str:
        return f"Manifest({self.name!r}, {self.excitation.kind}, {str(self.path)!r})"

    @property
    def set_ups(self) -> list[tuple[str, Manifest]]:
        """Set-ups with their key prefixes: the top level, unless it is empty, and every take."""
        blocks = [("", replace(self, take=()))] if self.daq or not self.take else []
        for number, take in enumerate(self.take, 1):
            part = replace(self, daq=take.daq, images=take.images, points=take.points, take=())
            blocks.append((f"take[{number}].", part))
        return blocks

    @property
    def notices(self) -> tuple[Notice, ...]:
        """Notices of certificates and of implausible statements."""
        return (*self.certificate_notices, *self.plausibility_notices)

    @cached_property
    def plausibility_notices(self) -> tuple[Notice, ...]:
        """Notices of implausible statements."""
        channels = [
            (f"{where}daq.{quote_key(daq.name)}.channel.{quote_key(entry.name)}", entry)
            for where, block in self.set_ups
            for daq in block.daq
            for entry in daq.channel
        ]
        files = self.rig_path.name, self.path.name
        return plausibility_notices(self.rig, self.part, channels, self.excitation.frequencies or (), files)

    @property
    def certificate_notices(self) -> tuple[Notice, ...]:
        """Notices of all certificates: expired ones, and those of signatures."""
        return (*self.expiry_notices, *self.signature_notices)

    @property
    def expiry_notices(self) -> tuple[Notice, ...]:
        """Warnings of certificates that were not valid on the day of the recording, else today."""
        day = self.date or Date.today()
        return tuple(
            Notice(CERTIFICATE_EXPIRED, item.file.name, key=item.key, source=item.source, day=str(day))
            for item in self.inputs
            if item.stated is not None and (item.stated.valid_until or day) < day
        )

    @property
    def is_broadband(self) -> bool:
        """Whether `run` evaluates the motion of images or points by the spectrum of the channels."""
        seen = [one for _, block in self.set_ups for one in (*block.images, *block.points)]
        return KINDS[self.excitation.kind].is_broadband and bool(seen)

    def check_command(self, command: str) -> None:
        """Raise `InputError` if `shakercal COMMAND` does not evaluate this recording."""
        kind, kinds = self.excitation.kind, kinds_of(command)
        if kind not in kinds and not (command == "run" and self.is_broadband):
            which = "kind" if len(kinds) == 1 else "kinds"
            other = f"shakercal {KINDS[kind].commands[0]} evaluates this one"
            if command == "run" and KINDS[kind].is_broadband:
                other = f"{kind} only with [[images]] or [[points]]; {other} without them"
            expected = f"{join_alternatives(kinds)}, the {which} that shakercal {command} evaluates ({other})"
            raise InputError(WRONG_EXCITATION_KIND, self.path, "excitation.kind", found=kind, expected=expected)
        if self.take and command in ONE_SET_UP:
            raise InputError(
                ONE_SET_UP_EXPECTED, self.path, "take", found=f"{len(self.take)} takes", expected=ONE_SET_UP[command]
            )


def check_one_rig(manifests: Sequence[Manifest]) -> None:
    """Raise `InputError` if recordings for one evaluation have different rigs."""
    first = manifests[0]
    for manifest in manifests:
        if manifest.rig_path.resolve() != first.rig_path.resolve():
            expected = f"{first.rig_path}, the rig of {first.folder.name}"
            raise InputError(
                RECORDINGS_OF_DIFFERENT_RIGS, manifest.path, "rig", found=str(manifest.rig_path), expected=expected
            )


def find_recordings(path: str | Path) -> list[Path]:
    """Return the recording.toml files of a recording or of a campaign folder.

    Parameters
    ----------
    path : str or Path
        Recording folder, its recording.toml, or campaign folder.

    Returns
    -------
    Files in natural order.

    Raises
    ------
    InputError : if there is no recording.

    Examples
    --------
    >>> from fusion import find_recordings
    >>> [recording.parent.name for recording in find_recordings("sample_images/demo")]
    ['Fz-0080']
    """
    path = Path(path)
    if path.is_file():
        if unsupported_suffix(path) is None:
            expected = f"a recording's folder or {RECORDING_NAME}; shakercal init {path.parent} drafts one"
            raise InputError(NO_RECORDING, path, found="a recorder's file", expected=expected)
        return [path]
    if not path.is_dir():
        raise InputError(
            NO_RECORDING,
            path,
            found="no file or folder",
            expected="a recording folder, its recording.toml, or a campaign folder",
        )
    if (path / RECORDING_NAME).is_file():
        return [path / RECORDING_NAME]
    try:
        below = sorted((entry for entry in path.iterdir() if entry.is_dir()), key=lambda entry: natural_key(entry.name))
        found = [entry / RECORDING_NAME for entry in below if (entry / RECORDING_NAME).is_file()]
    except OSError as error:
        raise InputError(
            UNREADABLE_FILE, path, found=error.strerror or str(error), expected="a folder that can be read"
        ) from error
    if not found:
        expected = f"{RECORDING_NAME} in this folder or directly below it; shakercal init {path} drafts one"
        raise InputError(NO_RECORDING, path, found="none", expected=expected)
    return found


def find_single_recording(path: str | Path) -> Path:
    """Return the single recording.toml at a path; `InputError` for several."""
    found = find_recordings(path)
    if len(found) > 1:
        raise InputError(
            ONE_RECORDING_EXPECTED, Path(path), found=f"a campaign of {len(found)}", expected="one recording"
        )
    return found[0]


def select_kinds(recordings: Sequence[Path], kinds: Collection[str], *, images: bool = False) -> list[Path]:
    """Return the recordings with one of some kinds of excitation, or that cannot be read.

    With `images` also those with images or points that are evaluated by the spectrum of the channels.
    If there are none, all are returned, so that the command reports its expectation.
    """
    selected = []
    for recording in recordings:
        try:
            text = read_toml(recording)
        except InputError:
            text = {}
        excitation = text.get("excitation")
        kind = excitation.get("kind") if isinstance(excitation, dict) else None
        seen = images and kind in KINDS and KINDS[kind].is_broadband and bool(text.keys() & {"images", "points"})
        if not isinstance(kind, str) or kind in kinds or seen:
            selected.append(recording)
    return selected or list(recordings)


def load_for_command(paths: Sequence[str | Path], command: str, *, allow_outside: bool = False) -> list[Manifest]:
    """Return the recordings at paths that a command evaluates, each once.

    Other recordings of a campaign are logged.

    Parameters
    ----------
    paths : sequence of str or Path
        Recordings or campaigns.
    command : str
        Name of a command, such as "run".
    allow_outside : bool
        Accept files outside the folder of rig.toml (default: False).

    Returns
    -------
    Checked manifests.

    Raises
    ------
    InputError : for wrong manifests, and for recordings that the command does not evaluate.

    Examples
    --------
    >>> from fusion import load_for_command
    >>> [manifest.name for manifest in load_for_command(["sample_images/demo"], "run")]
    ['Fz 80.0 Hz, simulated']
    """
    kinds = kinds_of(command)
    manifests: dict[Path, Manifest] = {}
    for path in paths:
        recordings = find_recordings(path)
        chosen = select_kinds(recordings, kinds, images=command == "run")
        for recording in chosen:
            manifest = load_manifest(recording, allow_outside=allow_outside)
            manifest.check_command(command)
            manifests.setdefault(manifest.path.resolve(), manifest)
        others = [recording.parent.name for recording in recordings if recording not in chosen]
        if others:
            log.info("%s: skipped, since their kind is not %s: %s", path, join_alternatives(kinds), ", ".join(others))
    return list(manifests.values())


def load_manifest(recording: str | Path, allow_outside: bool = False, text: dict[str, Any] | None = None) -> Manifest:
    """Return a checked recording with the rig that it names.

    Parameters
    ----------
    recording : str or Path
        recording.toml or its folder.
    allow_outside : bool
        Accept files outside the folder of rig.toml (default: False).
    text : dict, optional
        Content in place of that of recording.toml.

    Returns
    -------
    The manifest.

    Raises
    ------
    InputError : with all errors of both files.

    Examples
    --------
    >>> from fusion import load_manifest
    >>> load_manifest("sample_images/demo/Fz-0080").excitation.frequencies
    (80.0,)
    """
    path = Path(recording)
    path = path if path.is_file() else path / RECORDING_NAME
    at_first = {path.resolve(): FileIdentity.of(path)}
    text = read_toml(path) if text is None else text
    try:
        rig_path = _rig_path(path, text)
        root, folder = rig_path.parent.resolve(), path.parent.resolve()
        if not allow_outside and not folder.is_relative_to(root):
            expected = "a rig.toml in a folder above the recording (--allow-outside permits others)"
            raise InputError(PATH_NOT_ALLOWED, path, "rig", found=f'"{text["rig"]}"', expected=expected)
        at_first[rig_path.resolve()] = FileIdentity.of(rig_path)
        rig_text = read_toml(rig_path)
        text, libraries = complete_channels(text, path, rig_path, KEYS)
    except InputError as error:
        raise InputError.together([error, *_without_rig(path, text)]) from error
    folders = PathScope(folder, root, allow_outside), PathScope(root, root, allow_outside)
    of_certificates = _certificates((path, text), (rig_path, rig_text), folders)
    text, rig_text = (found.text for found in of_certificates)
    certificates = {file: identity for found in of_certificates for file, identity in found.files.items()}
    rig, record = _checked_files((path, text), (rig_path, rig_text), folders)
    overridden = expand_statements(text, path)[0].get("environment", {})
    of_rig = tuple(
        item
        for item in uncertain_inputs(rig_text, rig_path)
        if f"{item.key}_uncertainty" not in (f"environment.{key}" for key in overridden)
    )
    rig = rig.model_copy(update={"environment": record.environment or rig.environment})
    files = tuple(dict.fromkeys((*_input_files(path, rig_path, rig, record), *certificates, *libraries)))
    check_names(files)
    seen = {file: FileIdentity.of(file) for file in files} | certificates | at_first
    return Manifest(
        path=path,
        folder=folder,
        root=root,
        rig_path=rig_path,
        rig=rig,
        name=record.name,
        mounting=record.mounting,
        excitation=record.excitation,
        daq=record.daq,
        images=record.images,
        points=record.points,
        take=record.take,
        part=rig.part + record.part,
        shaker=record.shaker or rig.shaker or Shaker(),
        files=files,
        date=record.date,
        operator=record.operator,
        procedure=record.procedure,
        simulated=record.simulated or record.name.endswith(SIMULATED_NAME) or (path.parent / TRUTH).is_file(),
        acknowledged=(*rig.acknowledged, *record.acknowledged),
        inputs=(*of_rig, *_own_inputs(text, path), *(item for found in of_certificates for item in found.curves)),
        signature_notices=tuple(
            dict.fromkeys(notice for found in of_certificates for notice in found.signature_notices)
        ),
        file_identities={file: identity for file, identity in seen.items() if identity is not None},
    )


def _own_inputs(text: dict[str, Any], path: Path) -> tuple[UncertainInput, ...]:
    """Return the inputs of a recording with an uncertainty, those of defaults by their channels."""
    return tuple(uncertain_inputs(without_defaults(text), path))


def _certificates(
    of_recording: tuple[Path, dict[str, Any]], of_rig: tuple[Path, dict[str, Any]], folders: tuple[PathScope, PathScope]
) -> tuple[CertifiedInputs, CertifiedInputs]:
    """Read the certificates of recording and rig; the `InputError` has all errors of both."""
    (path, text), (rig_path, rig_text) = of_recording, of_rig
    sensor = rig_text.get("sensor")
    unit = str(sensor.get("unit", "1")) if isinstance(sensor, dict) else "1"
    certified = resolve_certificates(text, path, folders[0], unit)
    rig_certified = resolve_certificates(rig_text, rig_path, folders[1], unit)
    wrong = [*certified.errors, *rig_certified.errors]
    if wrong:
        raise InputError.together([*find_unfilled(text, path), *find_unfilled(rig_text, rig_path), *wrong])
    return certified, rig_certified


def _checked_files(
    of_recording: tuple[Path, dict[str, Any]], of_rig: tuple[Path, dict[str, Any]], folders: tuple[PathScope, PathScope]
) -> tuple[Rig, RecordingFile]:
    """Check rig and recording, separately and together; the `InputError` has all errors of both.

    Placeholders are reported first.
    """
    (path, text), (rig_path, rig_text) = of_recording, of_rig
    unknown, wrong = [*find_unfilled(text, path), *find_unfilled(rig_text, rig_path)], list[InputError]()
    rig, record, doubtful = None, None, dict[Path, set[str]]()
    with _added_to(wrong):
        rig = _validated(Rig, expand_statements(rig_text, rig_path)[0], rig_path, Context(folders[1]), wrong, doubtful)
    with _added_to(wrong):
        values = expand_statements(text, path)[0]
        around = values.get("environment")
        if isinstance(around, dict):
            # Keys of the recording override those of the rig: together they must be valid.
            values["environment"] = expand_statements(rig_text, rig_path)[0].get("environment", {}) | around
        stereo, head = _named_in(rig_text)
        if rig is not None:
            stereo |= {name: pair for name, pair in rig.stereo.items() if name not in doubtful[rig_path]}
            head |= {name: stated for name, stated in rig.head.items() if name not in doubtful[rig_path]}
        record = _validated(RecordingFile, values, path, RigContext(folders[0], stereo, head), wrong, doubtful)
    if rig is not None and record is not None:
        # A rig with placeholders may lack what the recording names.
        with _added_to(wrong), suppress(*[KeyError] if wrong else []):
            reported = {(error.file, error.key) for error in wrong}
            for one in find_contradictions(rig, rig_path, record, path):
                wrong += [one] if (one.file, one.key) not in reported and not is_doubtful(one, doubtful) else []
    wrong = [*unknown, *(error for error in wrong if (error.file, error.key) not in {(e.file, e.key) for e in unknown})]
    if rig is None or record is None or wrong:
        raise InputError.together(wrong)
    return rig, record


def _without_rig(path: Path, text: dict[str, Any]) -> list[InputError]:
    """Return the errors of a recording whose rig cannot be read."""
    found = list[InputError]()
    with _added_to(found):
        values = expand_statements(text, path)[0]
        blocks = [
            block for part in (values, *_tables(values, "take")) for block in _tables(part, "daq", "images", "points")
        ]
        channels = [channel for block in blocks for channel in _tables(block, "channel")]
        named: dict[str, Any] = {"stereo": {str(block.get("stereo")): {} for block in blocks}}
        named["head"] = {str(channel.get("head")): {} for channel in channels}
        folder = path.parent.resolve()
        context = RigContext(PathScope(folder, folder, allow_outside=True), *_named_in(named))
        _validated(RecordingFile, values, path, context, found, {})
    return [*find_unfilled(text, path), *(error for error in found if error.key != "rig")]


def _tables(values: Any, *keys: str) -> Iterator[dict[str, Any]]:
    """Yield the tables in lists at keys of a table."""
    for key in keys:
        items = values.get(key) if isinstance(values, dict) else None
        yield from (item for item in items if isinstance(item, dict)) if isinstance(items, list) else ()


def _validated(
    model: type[AnyBlock],
    values: dict[str, Any],
    path: Path,
    context: Context,
    wrong: list[InputError],
    doubtful: dict[Path, set[str]],
) -> AnyBlock | None:
    """Return a valid block with placeholders; collect errors and names of such blocks."""
    found = Repair(model, values, path, context)
    wrong += found.errors
    doubtful[path] = found.names
    return found.block


@contextmanager
def _added_to(wrong: list[InputError]) -> Iterator[None]:
    """Add every error raised inside to a list."""
    try:
        yield
    except InputError as error:
        wrong += error.each


def _named_in(rig_text: dict[str, Any]) -> tuple[dict[str, Stereo], dict[str, InstrumentHead]]:
    """Return placeholders for stereo pairs and heads of a rig with errors."""
    names = {key: rig_text[key] if isinstance(rig_text.get(key), dict) else {} for key in ("stereo", "head")}
    pairs = {name: Stereo.model_construct(exposure=0.0) for name in names["stereo"]}
    return pairs, {name: InstrumentHead.model_construct(mirror=(PLACEHOLDER_MIRROR_M,) * 3) for name in names["head"]}


def _rig_path(path: Path, text: dict[str, Any]) -> Path:
    name = text.get("rig")
    if not isinstance(name, str) or not name or "\\" in name:
        raise InputError(
            INVALID_VALUE, path, "rig", found=describe(name), expected='the path of rig.toml such as "../rig.toml"'
        )
    parts = [part for part in Path(name).parts if part != "."]
    folder = path.parent
    while parts and parts[0] == ".." and folder.name not in ("", "..") and not folder.is_symlink():
        folder, parts = folder.parent, parts[1:]
    rig_path = folder.joinpath(*parts)
    if not rig_path.is_file():
        raise InputError(MISSING_FILE, path, "rig", found=f"no file {rig_path}", expected="an existing file")
    return rig_path


def _input_files(path: Path, rig_path: Path, rig: Rig, record: RecordingFile) -> tuple[Path, ...]:
    named = [path.resolve(), rig_path.resolve(), *rig.files, *record.files]
    named += [file for take in record.take for file in take.files]
    named += [] if record.excitation.file is None else [record.excitation.file]
    files: dict[Path, None] = {}
    for file in named:
        files[file] = None
        if file.suffix.lower() in (".cih", ".cihx"):  # the frames of such a header are in a separate file
            frames = [file.with_suffix(suffix) for suffix in (".mraw", ".MRAW")]
            files |= dict.fromkeys([frame for frame in frames if frame.is_file()][:1])
    return tuple(files)
