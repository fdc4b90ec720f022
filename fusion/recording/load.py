"""Manifests read from disk and checked against each other."""

from __future__ import annotations

import json
import re
import tomllib
from collections.abc import Collection, Iterable, Iterator
from dataclasses import dataclass
from difflib import get_close_matches
from pathlib import Path
from typing import Any, TypeVar, get_args

from pydantic import BaseModel, ValidationError
from pydantic_core import ErrorDetails

from fusion.base import InputError
from fusion.recording.manifest import ChannelEntry, Daq, Excitation, Frames, Images, PointFiles, RecordingFile, Take
from fusion.recording.rig import Part, Rig, Stereo
from fusion.recording.values import Block, Context, PathScope, describe, natural_key, repeated_name

# Checks that no single table can make: what a recording names must exist in it and in its rig.


Measured = RecordingFile | Take
Located = tuple[str, Daq, ChannelEntry]


def check_rig_and_recording(rig: Rig, rig_path: Path, record: RecordingFile, path: Path) -> None:
    """Raise `InputError` for the first reference between rig and recording that leads nowhere."""
    _check_something_measured(record, path)
    _check_stereo(rig, rig_path, record)
    for prefix, block in measured_blocks(record):
        _check_triggers(block, prefix, path)
        _check_outputs(block, prefix, path, rig, rig_path)
    _check_common(record, path)
    _check_reference(record, path)
    _check_excitation(record, path)
    _check_parts(rig, record, path)


def quoted(name: str) -> str:
    """A name as part of a key path, in quotes unless TOML takes it bare."""
    return name if re.fullmatch(r"[A-Za-z0-9_-]+", name) else f'"{name}"'


def measured_blocks(record: RecordingFile) -> Iterator[tuple[str, Measured]]:
    """Yield what was recorded at once, with its key prefix: the top level, then every take."""
    if record.daq or record.images or record.points:
        yield "", record
    for number, take in enumerate(record.take, 1):
        yield f"take[{number}].", take


def located_channels(block: Measured, prefix: str) -> Iterator[Located]:
    """Yield every channel of a block with its key path."""
    for daq in block.daq:
        for entry in daq.channel:
            yield f"{prefix}daq.{quoted(daq.name)}.channel.{quoted(entry.name)}", daq, entry


def _check_something_measured(record: RecordingFile, path: Path) -> None:
    """A recording needs a clock, but for one whose readings stand in the table that its excitation names."""
    if not record.daq and not record.take and record.excitation.file is None:
        raise InputError(path, "daq", "none", "at least one [[daq]] or [[take]] block")


def _check_stereo(rig: Rig, rig_path: Path, record: RecordingFile) -> None:
    """Images need a calibration; a scale needs an uncertainty, stated or from the calibration."""
    pictured = [images.stereo for _, block in measured_blocks(record) for images in block.images]
    tabled = [points.stereo for _, block in measured_blocks(record) for points in block.points]
    for name in dict.fromkeys(pictured + tabled):
        pair = rig.stereo[name]
        if name in pictured and pair.calibration is None:
            expected = f"the calibration that the images of {name} need"
            raise InputError(rig_path, f"stereo.{quoted(name)}.calibration", "no calibration", expected)
        if pair.scale_uncertainty is None and (name in tabled or not has_covariance(pair)):
            expected = "the relative standard uncertainty of all lengths, required without a calibration's covariance"
            raise InputError(rig_path, f"stereo.{quoted(name)}.scale_uncertainty", "nothing", expected)


def has_covariance(pair: Stereo) -> bool:
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


def _check_triggers(block: Measured, prefix: str, path: Path) -> None:
    """Frames belong to the edges of a trigger channel recorded with them, and to one set of frames per pair."""
    triggers = {entry.name for _, _, entry in located_channels(block, prefix) if entry.quantity == "trigger"}
    kinds: tuple[tuple[str, tuple[Frames, ...]], ...] = (("images", block.images), ("points", block.points))
    for kind, entries in kinds:
        for frames in entries:
            if frames.trigger not in triggers:
                found = f'"{frames.trigger}"; trigger channels are {", ".join(sorted(triggers)) or "none"}'
                expected = 'the name of a channel with quantity = "trigger"'
                raise InputError(path, f"{prefix}{kind}.{quoted(frames.stereo)}.trigger", found, expected)
    twice = repeated_name([frames.stereo for _, entries in kinds for frames in entries])
    if twice is not None:
        found = f'two blocks for "{twice}"'
        raise InputError(
            path, f"{prefix}images.{quoted(twice)}.stereo", found, "one images or points block per stereo pair"
        )


def _check_outputs(block: Measured, prefix: str, path: Path, rig: Rig, rig_path: Path) -> None:
    """Outputs belong to the sensor under test, each of its channels once at a time."""
    seen: list[tuple[str, str]] = []
    for key, daq, entry in located_channels(block, prefix):
        if entry.channel is None:
            continue
        if rig.sensor is None:
            raise InputError(rig_path, "sensor", "nothing", f"the [sensor] whose output {entry.name} is recorded")
        if entry.channel not in rig.sensor.channels:
            expected = "one of the sensor's channels " + ", ".join(rig.sensor.channels)
            raise InputError(path, f"{key}.channel", f'"{entry.channel}"', expected)
        output = entry.channel, daq.data_set(entry)[1]
        if output in seen:
            found = f'"{entry.channel}" twice'
            raise InputError(path, f"{key}.channel", found, "each output of the sensor once")
        seen.append(output)


def _check_common(record: RecordingFile, path: Path) -> None:
    """Channels of one instrument share a relative error, hence measure one quantity."""
    first: dict[str, ChannelEntry] = {}
    for prefix, block in measured_blocks(record):
        for key, _, entry in located_channels(block, prefix):
            if entry.common is None:
                continue
            model = first.setdefault(entry.common, entry)
            if entry.quantity != model.quantity:
                expected = f'"{model.quantity}" as in channel {model.name}, which has common = "{entry.common}" too'
                raise InputError(path, f"{key}.quantity", f'"{entry.quantity}"', expected)


def _check_reference(record: RecordingFile, path: Path) -> None:
    """Takes need one reference channel, the same in each of them."""
    marked = [
        [
            (key, daq.name, daq.data_set(entry)[0])
            for key, daq, entry in located_channels(block, prefix)
            if entry.reference
        ]
        for prefix, block in measured_blocks(record)
    ]
    for keys in marked:
        if len({(daq, name) for _, daq, name in keys}) > 1:
            found = f"{len(keys)} of them"
            raise InputError(path, f"{keys[1][0]}.reference", found, "one channel with reference = true")
    if not record.take:
        return
    for (prefix, _), keys in zip(measured_blocks(record), marked, strict=True):
        names = {(daq, name) for _, daq, name in keys}
        same = marked[0] and names == {(marked[0][0][1], marked[0][0][2])}
        if not same:
            found = "none" if not keys else f"{keys[0][1]}.{keys[0][2]}"
            expected = "one channel with reference = true, the same in every take"
            raise InputError(path, f"{prefix}daq", found, expected)


def _check_excitation(record: RecordingFile, path: Path) -> None:
    """Channels that the excitation names must be recorded."""
    names = {entry.name for prefix, block in measured_blocks(record) for _, _, entry in located_channels(block, prefix)}
    excitation = record.excitation
    force = (excitation.force,) if excitation.force is not None else ()
    named = (("response", excitation.response), ("reference", excitation.reference), ("force", force))
    for key, channels in named:
        for channel in channels:
            if channel not in names:
                found = f'"{channel}"; channels are {", ".join(sorted(names))}'
                raise InputError(path, f"excitation.{key}", found, "the name of a recorded channel")


def _check_parts(rig: Rig, record: RecordingFile, path: Path) -> None:
    """A part stands in the rig or in the recording, once."""
    twice = repeated_name([part.name for part in rig.part + record.part])
    if twice is not None:
        raise InputError(
            path, f"part.{quoted(twice)}.name", f'"{twice}" twice', "parts of different names in rig and recording"
        )


# TOML text → checked models; every mistake becomes one InputError that names file and key.


RECORDING_NAME = "recording.toml"
LARGEST_TOML = 4_000_000  # bytes; no manifest is anywhere near
AnyBlock = TypeVar("AnyBlock", bound=Block)


@dataclass(frozen=True)
class Manifest:
    """One recording with its rig, checked: every path resolved and existing, every reference known.

    `path`: recording.toml; `folder`: where it stands; `root`: the folder of rig.toml. `mounting`: recordings with
    another text were mounted anew. `part`: those of rig and recording together. `files`: every input file, both
    manifests first.
    """

    path: Path
    folder: Path
    root: Path
    rig_path: Path
    rig: Rig
    name: str
    mounting: str
    excitation: Excitation
    daq: tuple[Daq, ...]
    images: tuple[Images, ...]
    points: tuple[PointFiles, ...]
    take: tuple[Take, ...]
    part: tuple[Part, ...]
    files: tuple[Path, ...]


def find_recordings(path: Path) -> list[Path]:
    """List the recording.toml files a command is to work on: the one of a recording, or those of a campaign folder."""
    if path.is_file():
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
        raise InputError(path, "", "none", f"{RECORDING_NAME} in this folder or in a folder directly below it")
    return found


def for_kinds(recordings: list[Path], kinds: Collection[str]) -> list[Path]:
    """Return the recordings of a campaign whose excitation a command evaluates; what cannot be read is not left out.

    Where none is left, all are returned, so that the command says of each what it expects.
    """
    kept = [recording for recording in recordings if _kind(recording) in (None, *kinds)]
    return kept or recordings


def load_manifest(recording: Path, allow_outside: bool = False) -> Manifest:
    """Read and check recording.toml (or the folder it stands in) and the rig.toml it names."""
    path = recording if recording.is_file() else recording / RECORDING_NAME
    text = read_toml(path)
    rig_path = _rig_path(path, text)
    root, folder = rig_path.parent.resolve(), path.parent.resolve()
    if not allow_outside and not folder.is_relative_to(root):
        expected = "a rig.toml in a folder above the recording (--allow-outside permits others)"
        raise InputError(path, "rig", f'"{text["rig"]}"', expected)
    rig = validate(Rig, read_toml(rig_path), rig_path, Context(PathScope(root, root, allow_outside), {}))
    record = validate(RecordingFile, text, path, Context(PathScope(folder, root, allow_outside), rig.stereo))
    check_rig_and_recording(rig, rig_path, record, path)
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
        files=_input_files(path, rig_path, rig, record),
    )


def read_toml(path: Path) -> dict[str, Any]:
    """Read a TOML file; syntax errors tell the line."""
    try:
        if path.stat().st_size > LARGEST_TOML:
            raise InputError(path, "", f"{path.stat().st_size} bytes", f"a manifest of at most {LARGEST_TOML} bytes")
        return tomllib.loads(path.read_bytes().decode("utf-8-sig"))
    except FileNotFoundError as error:
        raise InputError(path, "", "no such file", "an existing file") from error
    except OSError as error:
        raise InputError(path, "", error.strerror or str(error), "a file that can be read") from error
    except UnicodeDecodeError as error:
        raise InputError(path, "", f"byte {error.start} is something else", "UTF-8 text") from error
    except (ValueError, RecursionError) as error:
        raise InputError(path, "", str(error), "TOML") from error


def _kind(recording: Path) -> str | None:
    """The kind of excitation that a recording.toml names, None where it names none."""
    try:
        excitation = read_toml(recording).get("excitation")
    except InputError:
        return None
    kind = excitation.get("kind") if isinstance(excitation, dict) else None
    return kind if isinstance(kind, str) else None


def validate(model: type[AnyBlock], text: dict[str, Any], path: Path, context: Context | None = None) -> AnyBlock:
    """Check TOML values against a model; the first problem becomes an `InputError`."""
    try:
        return model.model_validate(text, context=context)
    except ValidationError as error:
        raise _input_error(model, text, path, error) from error


def _rig_path(path: Path, text: dict[str, Any]) -> Path:
    """Path of rig.toml as a recording names it."""
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
    """Every file that bears on the result, once each."""
    groups: list[Iterable[Path]] = [(path.resolve(), rig_path.resolve()), rig.files]
    measured: tuple[RecordingFile | Take, ...] = (record, *record.take)
    for block in measured:
        groups += [[daq.file, *(entry.response for entry in daq.channel if entry.response)] for daq in block.daq]
        groups += [[*images.left, *images.right] for images in block.images]
        groups += [points.files for points in block.points]
    if record.excitation.file is not None:
        groups.append((record.excitation.file,))
    listed = [file for group in groups for file in group]
    return tuple(dict.fromkeys(beside for file in listed for beside in _with_companion(file)))


def _with_companion(file: Path) -> tuple[Path, ...]:
    """A .cih or .cihx header together with the .mraw that holds its frames."""
    if file.suffix.lower() not in (".cih", ".cihx"):
        return (file,)
    frames = [file.with_suffix(suffix) for suffix in (".mraw", ".MRAW")]
    return (file, *[frame for frame in frames if frame.is_file()][:1])


def _input_error(model: type[Block], text: dict[str, Any], path: Path, error: ValidationError) -> InputError:
    """The sentence about the first problem; an unknown key comes before the key that is missing in its stead."""
    problems = error.errors(include_url=False)
    first = min(problems, key=lambda problem: problem["type"] != "extra_forbidden")
    place = list(first["loc"])
    own = first.get("ctx", {}).get("key")
    key = key_path(text, [*place, own] if own else place)
    expected, found = _phrases(model, first)
    return InputError(path, key, found, expected, more=len(problems) - 1)


def key_path(text: dict[str, Any], place: list[int | str]) -> str:
    """Key path for people: blocks of an array by their name, else counted from 1: `daq.bridge.channel.Fz.scale`."""
    told = ""
    value: Any = text
    for step in place:
        child = value[step] if _has(value, step) else None
        name = step if isinstance(step, str) else _block_name(value, child)
        if isinstance(step, int) and not name:
            told += f"[{step + 1}]"
        else:
            told += f".{quoted(name)}" if told else quoted(name)
        value = child
    return told


def _has(value: Any, step: int | str) -> bool:
    """Whether the TOML values go on below `step`."""
    if isinstance(step, int):
        return isinstance(value, list | tuple) and step < len(value)
    return isinstance(value, dict) and step in value


def _block_name(siblings: Any, block: Any) -> str:
    """What identifies a block among its siblings, empty if nothing does."""
    for key in ("name", "stereo"):
        names = [item.get(key) for item in siblings if isinstance(item, dict)] if isinstance(block, dict) else []
        if isinstance(block, dict) and isinstance(block.get(key), str) and names.count(block[key]) == 1:
            return str(block[key])
    return ""


def _phrases(model: type[Block], problem: ErrorDetails) -> tuple[str, str]:
    """What was expected and what was found, for any error of pydantic's."""
    kind, context = problem["type"], problem.get("ctx", {})
    if kind == "refused":
        return str(context["expected"]), str(context["found"])
    if kind == "missing":
        return "this key, which is required", "nothing"
    if kind == "extra_forbidden":
        return _known_keys(model, problem["loc"]), "an unknown key"
    expected = {
        "float_type": "a number",
        "finite_number": "a finite number",
        "int_type": "a whole number",
        "bool_type": "true or false",
        "string_type": "a text",
        "string_too_short": "a text that is not empty",
        "too_short": "at least {min_length} element",
        "greater_than": "a number above {gt:g}",
        "greater_than_equal": "a number of at least {ge:g}",
        "less_than_equal": "a number of at most {le:g}",
        "literal_error": "{expected}",
        "model_type": "a table",
        "dict_type": "a table",
    }.get(kind)
    return expected.format(**context) if expected else problem["msg"], describe(problem["input"])


def _known_keys(model: type[Block], place: tuple[int | str, ...]) -> str:
    """Which key was probably meant, else all keys of the table."""
    known = _fields_at(model, place[:-1])
    close = get_close_matches(str(place[-1]), known, n=1)
    return f'a known key, probably "{close[0]}"' if close else "one of the keys " + ", ".join(known)


def _fields_at(model: type[BaseModel], place: tuple[int | str, ...]) -> list[str]:
    """Keys of the table at a place below a model."""
    for step in place:
        field = model.model_fields.get(step) if isinstance(step, str) else None
        below = next(_models_in(field.annotation), None) if field is not None else None
        model = below or model
    return list(model.model_fields)


def _models_in(annotation: Any) -> Iterator[type[BaseModel]]:
    """The models that an annotation such as tuple[Daq, ...] names."""
    if isinstance(annotation, type) and issubclass(annotation, BaseModel):
        yield annotation
    for argument in get_args(annotation):
        yield from _models_in(argument)
