"""Manifests read from disk and checked against each other.

Every mistake becomes one `InputError` that names file and key.
"""

from __future__ import annotations

import json
import logging
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field, replace
from datetime import date as Date
from pathlib import Path
from typing import Any

import numpy as np

from fusion.base import FileIdentity, check_names, natural_key
from fusion.errors import InputError
from fusion.instruments.transducer import (
    CLOSE_TO_AXIS_RAD,
    HEAD,
    STATIONARY,
    aim_contradiction,
    carrier,
    unit_direction,
)
from fusion.recording.acknowledged import Acknowledgement
from fusion.recording.certified import CertifiedInputs, certified_inputs
from fusion.recording.excitation import KINDS, ONE_SET_UP, ExcitationEntry, join_alternatives, kinds_of
from fusion.recording.manifest import (
    SCAN,
    ChannelEntry,
    Daq,
    Frames,
    Images,
    PointFiles,
    RecordingFile,
    SetUpFiles,
    Take,
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
from fusion.recording.values import Context, PathScope, describe, repeated_name
from shaker.io import unsupported_suffix
from shakercal._common.notices import Notice

log = logging.getLogger("shakercal")
RECORDING_NAME = "recording.toml"
FAR_AWAY_M = 1e6
MOST_TURNED_DEG = 80.0
"""Of the surface before a camera alone."""


@dataclass(frozen=True)
class Manifest:
    """One recording with its rig, checked: every path resolved and existing, every reference known.

    `path`: recording.toml; `folder`: where it stands; `root`: the folder of rig.toml. `mounting`: recordings with
    another text were mounted anew. `part`: those of rig and recording together. `files`: every input file, both
    manifests first; `read`: what they were when the manifests were read. `inputs`: what has an uncertainty. The rig's
    environment is that of the recording.

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
    acknowledged: tuple[Acknowledgement, ...] = ()
    inputs: tuple[UncertainInput, ...] = ()
    signature_notices: tuple[Notice, ...] = ()
    file_identities: Mapping[Path, FileIdentity] = field(default_factory=dict)

    def __repr__(self) -> str:
        return f"Manifest({self.name!r}, {self.excitation.kind}, {str(self.path)!r})"

    @property
    def set_ups(self) -> list[tuple[str, Manifest]]:
        """What was recorded at once, with its key prefix: the top level, where it holds anything, and every take."""
        blocks = [("", replace(self, take=()))] if self.daq or not self.take else []
        for number, take in enumerate(self.take, 1):
            part = replace(self, daq=take.daq, images=take.images, points=take.points, take=())
            blocks.append((f"take[{number}].", part))
        return blocks

    @property
    def certificate_notices(self) -> tuple[Notice, ...]:
        """Return the notices of all certificates: those that were not valid, and those of signatures."""
        return (*self.expiry_notices, *self.signature_notices)

    @property
    def expiry_notices(self) -> tuple[Notice, ...]:
        """Return a warning for every certificate that was no longer valid on the day of the recording, else today."""
        day = self.date or Date.today()
        told = []
        for item in self.inputs:
            if item.stated is not None and (item.stated.valid_until or day) < day:
                text = f"the certificate of {item.key} ({item.source}) was not valid on {day}"
                told.append(Notice("warning", text, item.file.name))
        return tuple(told)

    def check_command(self, command: str) -> None:
        """Raise `InputError` where `shakercal COMMAND` evaluates no such recording."""
        kind, kinds = self.excitation.kind, kinds_of(command)
        if kind not in kinds:
            which = "kind" if len(kinds) == 1 else "kinds"
            other = f"(shakercal {KINDS[kind].commands[0]} takes this one)"
            expected = f"{join_alternatives(kinds)}, the {which} that shakercal {command} evaluates {other}"
            raise InputError(self.path, "excitation.kind", found=kind, expected=expected)
        if self.take and command in ONE_SET_UP:
            raise InputError(self.path, "take", found=f"{len(self.take)} takes", expected=ONE_SET_UP[command])


def check_one_rig(manifests: Sequence[Manifest]) -> None:
    """Raise `InputError` where recordings that are evaluated together are not all of the first one's rig."""
    first = manifests[0]
    for manifest in manifests:
        if manifest.rig_path.resolve() != first.rig_path.resolve():
            expected = f"{first.rig_path}, the rig of {first.folder.name}"
            raise InputError(manifest.path, "rig", found=str(manifest.rig_path), expected=expected)


def find_recordings(path: str | Path) -> list[Path]:
    """List the recording.toml files a command is to work on: the one of a recording, or those of a campaign folder.

    >>> from fusion import find_recordings
    >>> [recording.parent.name for recording in find_recordings("sample_images/demo")]
    ['Fz-0080']
    """
    path = Path(path)
    if path.is_file():
        if unsupported_suffix(path) is None:
            expected = f"a recording's folder or {RECORDING_NAME}; shakercal init {path.parent} drafts one"
            raise InputError(path, "", "a recorder's file", expected)
        return [path]
    if not path.is_dir():
        raise InputError(
            path, "", "nothing at this path", "a recording folder, its recording.toml, or a campaign folder"
        )
    if (path / RECORDING_NAME).is_file():
        return [path / RECORDING_NAME]
    try:
        below = sorted((entry for entry in path.iterdir() if entry.is_dir()), key=lambda entry: natural_key(entry.name))
        found = [entry / RECORDING_NAME for entry in below if (entry / RECORDING_NAME).is_file()]
    except OSError as error:
        raise InputError(path, "", error.strerror or str(error), "a folder that can be read") from error
    if not found:
        expected = f"{RECORDING_NAME} in this folder or directly below it; shakercal init {path} drafts one"
        raise InputError(path, "", "none", expected)
    return found


def find_single_recording(path: str | Path) -> Path:
    """Return the one recording.toml at a path, as `find_recordings` finds it."""
    found = find_recordings(path)
    if len(found) > 1:
        raise InputError(Path(path), "", found=f"a campaign of {len(found)}", expected="one recording")
    return found[0]


def select_kinds(recordings: Sequence[Path], kinds: Collection[str]) -> list[Path]:
    """Return the recordings of a campaign that have one of some kinds of excitation, or that cannot be read.

    Where none is left, all are returned, so that the command says of each what it expects.
    """
    kept = []
    for recording in recordings:
        try:
            excitation = read_toml(recording).get("excitation")
        except InputError:
            excitation = None
        kind = excitation.get("kind") if isinstance(excitation, dict) else None
        if not isinstance(kind, str) or kind in kinds:
            kept.append(recording)
    return kept or list(recordings)


def load_for_command(paths: Sequence[str | Path], command: str, *, allow_outside: bool = False) -> list[Manifest]:
    """Load the recordings at paths that a command evaluates, each once; of a campaign's others the user is told.

    >>> from fusion import load_for_command
    >>> [manifest.name for manifest in load_for_command(["sample_images/demo"], "run")]
    ['Fz 80.0 Hz, simulated']
    """
    kinds = kinds_of(command)
    manifests: dict[Path, Manifest] = {}
    for path in paths:
        recordings = find_recordings(path)
        chosen = select_kinds(recordings, kinds)
        for recording in chosen:
            manifest = load_manifest(recording, allow_outside=allow_outside)
            manifest.check_command(command)
            manifests.setdefault(manifest.path.resolve(), manifest)
        others = [recording.parent.name for recording in recordings if recording not in chosen]
        if others:
            log.info("%s: left out, since their kind is not %s: %s", path, join_alternatives(kinds), ", ".join(others))
    return list(manifests.values())


def load_manifest(recording: str | Path, allow_outside: bool = False) -> Manifest:
    """Read and check recording.toml (or the folder it stands in) and the rig.toml it names.

    >>> from fusion import load_manifest
    >>> load_manifest("sample_images/demo/Fz-0080").excitation.frequencies
    (80.0,)
    """
    path = Path(recording)
    path = path if path.is_file() else path / RECORDING_NAME
    at_first = {path.resolve(): FileIdentity.of(path)}
    text = read_toml(path)
    try:
        rig_path = _rig_path(path, text)
        root, folder = rig_path.parent.resolve(), path.parent.resolve()
        if not allow_outside and not folder.is_relative_to(root):
            expected = "a rig.toml in a folder above the recording (--allow-outside permits others)"
            raise InputError(path, "rig", f'"{text["rig"]}"', expected)
        at_first[rig_path.resolve()] = FileIdentity.of(rig_path)
        rig_text = read_toml(rig_path)
    except InputError as error:
        raise InputError.together([error, *_without_rig(path, text)]) from error
    folders = PathScope(folder, root, allow_outside), PathScope(root, root, allow_outside)
    of_certificates = _certificates((path, text), (rig_path, rig_text), folders)
    text, rig_text = (found.text for found in of_certificates)
    certificates = {file: identity for found in of_certificates for file, identity in found.files.items()}
    rig, record = _checked_files((path, text), (rig_path, rig_text), folders)
    own = expand_statements(text, path)[0].get("environment", {})
    of_rig = tuple(
        item
        for item in uncertain_inputs(rig_text, rig_path)
        if f"{item.key}_uncertainty" not in (f"environment.{key}" for key in own)
    )
    rig = rig.model_copy(update={"environment": record.environment or rig.environment})
    files = tuple(dict.fromkeys((*_input_files(path, rig_path, rig, record), *certificates)))
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
        acknowledged=(*rig.acknowledged, *record.acknowledged),
        inputs=(*of_rig, *uncertain_inputs(text, path), *(item for found in of_certificates for item in found.curves)),
        signature_notices=tuple(
            dict.fromkeys(notice for found in of_certificates for notice in found.signature_notices)
        ),
        file_identities={file: identity for file, identity in seen.items() if identity is not None},
    )


def _certificates(
    of_recording: tuple[Path, dict[str, Any]], of_rig: tuple[Path, dict[str, Any]], folders: tuple[PathScope, PathScope]
) -> tuple[CertifiedInputs, CertifiedInputs]:
    """Read the certificates that recording and rig name; the `InputError` raised has every mistake of both."""
    (path, text), (rig_path, rig_text) = of_recording, of_rig
    sensor = rig_text.get("sensor")
    unit = str(sensor.get("unit", "1")) if isinstance(sensor, dict) else "1"
    found = certified_inputs(text, path, folders[0], unit), certified_inputs(rig_text, rig_path, folders[1], unit)
    wrong = [error for one in found for error in one.errors]
    if wrong:
        raise InputError.together([*find_unfilled(text, path), *find_unfilled(rig_text, rig_path), *wrong])
    return found


def _checked_files(
    of_recording: tuple[Path, dict[str, Any]], of_rig: tuple[Path, dict[str, Any]], folders: tuple[PathScope, PathScope]
) -> tuple[Rig, RecordingFile]:
    """Check what two files say, and what they say of each other; the `InputError` raised has every mistake of both.

    Values that are still to be filled in come first.
    """
    (path, text), (rig_path, rig_text) = of_recording, of_rig
    unknown, wrong = [*find_unfilled(text, path), *find_unfilled(rig_text, rig_path)], list[InputError]()
    rig, record, doubtful = None, None, dict[Path, set[str]]()
    with _added_to(wrong):
        rig = _validated(
            Rig, expand_statements(rig_text, rig_path)[0], rig_path, Context(folders[1], {}), wrong, doubtful
        )
    with _added_to(wrong):
        values = expand_statements(text, path)[0]
        around = values.get("environment")
        if isinstance(around, dict):
            # What the recording states takes the place of what the rig does: together they must be as valid as one.
            values["environment"] = expand_statements(rig_text, rig_path)[0].get("environment", {}) | around
        stereo, head = _named_in(rig_text)
        if rig is not None:
            stereo |= {name: pair for name, pair in rig.stereo.items() if name not in doubtful[rig_path]}
            head |= {name: stated for name, stated in rig.head.items() if name not in doubtful[rig_path]}
        record = _validated(RecordingFile, values, path, Context(folders[0], stereo, head), wrong, doubtful)
    if rig is not None and record is not None:
        # A rig with placeholders may lack what the recording names.
        with _added_to(wrong), suppress(*[KeyError] if wrong else []):
            told = {(error.file, error.key) for error in wrong}
            for one in _contradictions(rig, rig_path, record, path):
                wrong += [one] if (one.file, one.key) not in told and not is_doubtful(one, doubtful) else []
    wrong = [*unknown, *(error for error in wrong if (error.file, error.key) not in {(e.file, e.key) for e in unknown})]
    if rig is None or record is None or wrong:
        raise InputError.together(wrong)
    return rig, record


def _without_rig(path: Path, text: dict[str, Any]) -> list[InputError]:
    """Return the mistakes of a recording whose rig cannot be read."""
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
        context = Context(PathScope(folder, folder, allow_outside=True), *_named_in(named))
        _validated(RecordingFile, values, path, context, found, {})
    return [*find_unfilled(text, path), *(error for error in found if error.key != "rig")]


def _tables(values: Any, *keys: str) -> Iterator[dict[str, Any]]:
    """Yield the tables in the lists at some keys of a table."""
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
    """Return a valid block, placeholders in the place of mistakes; add these, and the names of blocks that have one."""
    found = Repair(model, values, path, context)
    wrong += found.wrong
    doubtful[path] = found.names
    return found.block


@contextmanager
def _added_to(wrong: list[InputError]) -> Iterator[None]:
    """Add every mistake that is found meanwhile to a list."""
    try:
        yield
    except InputError as error:
        wrong += error.each


def _named_in(rig_text: dict[str, Any]) -> tuple[dict[str, Stereo], dict[str, InstrumentHead]]:
    """Return stereo pairs and heads of a rig that has mistakes, so that the recording can be looked at all the same."""
    names = {key: rig_text[key] if isinstance(rig_text.get(key), dict) else {} for key in ("stereo", "head")}
    pairs = {name: Stereo.model_construct(exposure=0.0) for name in names["stereo"]}
    return pairs, {name: InstrumentHead.model_construct(mirror=(FAR_AWAY_M,) * 3) for name in names["head"]}


def _rig_path(path: Path, text: dict[str, Any]) -> Path:
    name = text.get("rig")
    if not isinstance(name, str) or not name or "\\" in name:
        raise InputError(path, "rig", describe(name), 'the path of rig.toml such as "../rig.toml"')
    parts = [part for part in Path(name).parts if part != "."]
    folder = path.parent
    while parts and parts[0] == ".." and folder.name not in ("", "..") and not folder.is_symlink():
        folder, parts = folder.parent, parts[1:]
    rig_path = folder.joinpath(*parts)
    if not rig_path.is_file():
        raise InputError(path, "rig", f"no file {rig_path}", "an existing file")
    return rig_path


def _input_files(path: Path, rig_path: Path, rig: Rig, record: RecordingFile) -> tuple[Path, ...]:
    named = [path.resolve(), rig_path.resolve(), *rig.files, *record.files]
    named += [file for take in record.take for file in take.files]
    named += [] if record.excitation.file is None else [record.excitation.file]
    files: dict[Path, None] = {}
    for file in named:
        files[file] = None
        if file.suffix.lower() in (".cih", ".cihx"):  # the frames of such a header stand beside it
            frames = [file.with_suffix(suffix) for suffix in (".mraw", ".MRAW")]
            files |= dict.fromkeys([frame for frame in frames if frame.is_file()][:1])
    return tuple(files)


# What no single table can check: what a recording names must exist in it and in its rig.


def _contradictions(rig: Rig, rig_path: Path, record: RecordingFile, path: Path) -> Iterator[InputError]:
    """Yield every reference between rig and recording that leads nowhere."""
    if not record.daq and not record.take and not KINDS[record.excitation.kind].readings_in_table:
        yield InputError(path, "daq", "none", "at least one [[daq]] or [[take]] block")
    blocks: list[tuple[str, SetUpFiles]] = [("", record)] if record.daq or record.images or record.points else []
    blocks += [(f"take[{number}].", take) for number, take in enumerate(record.take, 1)]
    channels = [
        [
            (f"{prefix}daq.{quote_key(daq.name)}.channel.{quote_key(entry.name)}", daq, entry)
            for daq in block.daq
            for entry in daq.channel
        ]
        for prefix, block in blocks
    ]
    yield from _of_stereo(rig, rig_path, blocks)
    yield from _of_pictures(rig, blocks, path)
    for (prefix, block), located in zip(blocks, channels, strict=True):
        yield from _of_triggers(
            block, {entry.name for _, _, entry in located if entry.quantity == "trigger"}, prefix, path
        )
        yield from _of_outputs(located, path, rig, rig_path)
    for key, daq, entry in (item for located in channels for item in located):
        wrong = None if daq.data_set(entry)[1] == "" and daq.file.suffix.lower() == SCAN else aim_contradiction(entry)
        if wrong is not None:
            yield InputError(path, f"{key}.direction", wrong[1], wrong[0])
    yield from _of_standoffs((item for located in channels for item in located), path)
    yield from _of_carriers([item for located in channels for item in located], path)
    first: dict[str, ChannelEntry] = {}  # channels of one instrument share a relative error, hence measure one quantity
    for key, _, entry in (item for located in channels for item in located if item[2].common is not None):
        model = first.setdefault(str(entry.common), entry)
        if entry.quantity != model.quantity:
            expected = f'"{model.quantity}" as in channel {model.name}, which has common = "{entry.common}" too'
            yield InputError(path, f"{key}.quantity", f'"{entry.quantity}"', expected)
    yield from _of_references([prefix for prefix, _ in blocks], channels, several=bool(record.take), path=path)
    names = {entry.name for located in channels for _, _, entry in located}
    for key, named in record.excitation.channels:
        for channel in named:
            if channel not in names:
                found = f'"{channel}"; channels are {", ".join(sorted(names))}'
                yield InputError(path, f"excitation.{key}", found, "the name of a recorded channel")
    twice = repeated_name([part.name for part in rig.part + record.part])
    if twice is not None:
        expected = "parts of different names in rig and recording"
        yield InputError(path, f"part.{quote_key(twice)}.name", f'"{twice}" twice', expected)


def _of_standoffs(located: Iterable[tuple[str, Daq, ChannelEntry]], path: Path) -> Iterator[InputError]:
    """Beams that leave one mirror look along nearly one direction: of a head whose stand-off alone is known, too."""
    first: dict[str, ChannelEntry] = {}
    for key, _, entry in located:
        if entry.head is not None and entry.head.stated.standoff is not None:
            model = first.setdefault(entry.head.name, entry)
            if unit_direction(model) @ unit_direction(entry) < np.cos(CLOSE_TO_AXIS_RAD):
                expected = f"nearly the direction of channel {model.name}, whose beam leaves head {entry.head.name} too"
                yield InputError(path, f"{key}.direction", f"{list(entry.direction or ())}", expected)


def _of_carriers(located: Sequence[tuple[str, Daq, ChannelEntry]], path: Path) -> Iterator[InputError]:
    """What tells how a head moves belongs to one whose beams look at what is measured."""
    carried = {carrier(entry) for _, _, entry in located if entry.body not in (STATIONARY, HEAD)}
    for key, _, entry in located:
        if entry.body in (STATIONARY, HEAD) and entry.head is not None and carrier(entry) not in carried:
            expected = "a head with a laser beam at the load or the base"
            yield InputError(path, f"{key}.head", f'"{entry.head.name}"', expected)


def _of_stereo(rig: Rig, rig_path: Path, blocks: Iterable[tuple[str, SetUpFiles]]) -> Iterator[InputError]:
    """Images need a calibration; a scale needs an uncertainty, stated or from the calibration."""
    pictured = [images.stereo for _, block in blocks for images in block.images]
    tabled = [points.stereo for _, block in blocks for points in block.points]
    recorded = dict.fromkeys(pictured + tabled)
    carried = {rig.stereo[name].support or name for name in recorded if rig.stereo[name].body != STATIONARY}
    for name in recorded:
        pair = rig.stereo[name]
        if pair.body == STATIONARY and pair.support not in carried:
            listed = ", ".join(sorted(carried)) or "none"
            expected = "what cameras at the load or the base stand on as well: their support, or the name of their pair"
            found = f"{describe(pair.support)}; others stand on {listed}"
            yield InputError(rig_path, f"stereo.{quote_key(name)}.support", found, expected)
        if name in pictured and pair.calibration is None:
            expected = f"the calibration that the images of {name} need"
            yield InputError(rig_path, f"stereo.{quote_key(name)}.calibration", "no calibration", expected)
        if pair.surface is not None:
            key, looks = f"stereo.{quote_key(name)}.surface", np.array(pair.rotation)[:, 2]
            away = float(looks @ np.subtract(pair.surface.point, pair.translation))
            turned = float(np.degrees(np.arccos(min(1.0, abs(float(looks @ np.array(pair.surface.normal)))))))
            if name in tabled:
                yield InputError(rig_path, key, "one", "no such key where points in space are given")
            elif away <= 0.0 or turned > MOST_TURNED_DEG:
                found = f"one {away:.3g} m before it, turned by {turned:.3g}°"
                expected = f"a plane before the camera, turned from facing it by at most {MOST_TURNED_DEG:g}°"
                yield InputError(rig_path, key, found, expected)
        if pair.surface is None and pair.scale_uncertainty is None and (name in tabled or not _has_covariance(pair)):
            expected = "the relative standard uncertainty of all lengths, required without a calibration's covariance"
            yield InputError(rig_path, f"stereo.{quote_key(name)}.scale_uncertainty", "nothing", expected)


def _has_covariance(pair: Stereo) -> bool:
    """Whether the calibration of a stereo pair states a covariance; its other content is the calibration reader's."""
    if pair.calibration is None:
        return False
    try:
        content: Any = json.loads(pair.calibration.read_text(encoding="utf-8"))
    except OSError as error:
        raise InputError(pair.calibration, "", error.strerror or str(error), "a file that can be read") from error
    except (ValueError, RecursionError) as error:
        raise InputError(pair.calibration, "", str(error), "JSON") from error
    return isinstance(content, dict) and content.get("covariance") is not None


def _of_pictures(rig: Rig, blocks: Iterable[tuple[str, SetUpFiles]], path: Path) -> Iterator[InputError]:
    """A pair has two cameras, unless it states the surface that one alone sees; where one picture shows a body and what
    stands still, each has its part of it."""
    for prefix, block in blocks:
        for images in block.images:
            alone, key = (
                rig.stereo[images.stereo].surface is not None,
                f"{prefix}images.{quote_key(images.stereo)}.right",
            )
            if alone and images.right:
                yield InputError(path, key, "images", "none of a camera alone, whose surface rig.toml states")
            if not alone and not images.right:
                expected = "the right camera's images (of a camera alone rig.toml states the surface that it sees)"
                yield InputError(path, key, "nothing", expected)
        shown = {images.left for images in block.images if rig.stereo[images.stereo].body == STATIONARY}
        for images in block.images:
            if images.left in shown and images.region is None and not images.mask:
                part = "what stands still" if rig.stereo[images.stereo].body == STATIONARY else "the body"
                expected = f"the part of the pictures that shows {part}, since they show both"
                yield InputError(path, f"{prefix}images.{quote_key(images.stereo)}.region", "nothing", expected)


def _of_triggers(block: SetUpFiles, triggers: set[str], prefix: str, path: Path) -> Iterator[InputError]:
    """Frames belong to the edges of a trigger channel recorded with them, and to one set of frames per pair."""
    kinds: tuple[tuple[str, tuple[Frames, ...]], ...] = (("images", block.images), ("points", block.points))
    for kind, frames in ((kind, frames) for kind, entries in kinds for frames in entries):
        if frames.trigger not in triggers:
            found = f'"{frames.trigger}"; trigger channels are {", ".join(sorted(triggers)) or "none"}'
            expected = 'the name of a channel with quantity = "trigger"'
            yield InputError(path, f"{prefix}{kind}.{quote_key(frames.stereo)}.trigger", found, expected)
    twice = repeated_name([frames.stereo for _, entries in kinds for frames in entries])
    if twice is not None:
        key, expected = f"{prefix}images.{quote_key(twice)}.stereo", "one images or points block per stereo pair"
        yield InputError(path, key, f'two blocks for "{twice}"', expected)


def _of_outputs(
    located: list[tuple[str, Daq, ChannelEntry]], path: Path, rig: Rig, rig_path: Path
) -> Iterator[InputError]:
    """Outputs belong to the sensor under test, each of its channels once at a time."""
    seen: list[tuple[str, str]] = []
    for key, daq, entry in located:
        if entry.channel is None:
            continue
        if rig.sensor is None:
            yield InputError(rig_path, "sensor", "nothing", f"the [sensor] whose output {entry.name} is recorded")
            return
        if entry.channel not in rig.sensor.channels:
            expected = "one of the sensor's channels " + ", ".join(rig.sensor.channels)
            yield InputError(path, f"{key}.channel", f'"{entry.channel}"', expected)
        output = entry.channel, daq.data_set(entry)[1]
        if output in seen:
            yield InputError(path, f"{key}.channel", f'"{entry.channel}" twice', "each output of the sensor once")
        seen.append(output)


def _of_references(
    prefixes: list[str], channels: list[list[tuple[str, Daq, ChannelEntry]]], *, several: bool, path: Path
) -> Iterator[InputError]:
    """Takes need one reference channel, the same in each of them."""
    marked = [
        [(key, daq.name, daq.data_set(entry)[0]) for key, daq, entry in located if entry.reference]
        for located in channels
    ]
    for keys in marked:
        if len({(daq, name) for _, daq, name in keys}) > 1:
            expected = "one channel with reference = true"
            yield InputError(path, f"{keys[1][0]}.reference", f"{len(keys)} of them", expected)
            return
    for prefix, keys in zip(prefixes, marked, strict=True) if several else ():
        same = marked[0] and {(daq, name) for _, daq, name in keys} == {marked[0][0][1:]}
        if not same:
            found = "none" if not keys else f"{keys[0][1]}.{keys[0][2]}"
            expected = "one channel with reference = true, the same in every take"
            yield InputError(path, f"{prefix}daq", found, expected)
