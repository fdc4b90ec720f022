"""Checks that no single table can make: what a recording names must exist in it and in its rig."""

from __future__ import annotations

import json
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from fusion.errors import InputError
from fusion.manifest.recording import ChannelEntry, Daq, Frames, RecordingFile, Take
from fusion.manifest.rig import Rig, Stereo
from fusion.manifest.values import repeated_name

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
