"""Contradictions between recording.toml and rig.toml that no single table shows."""

from __future__ import annotations

import json
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from fusion.errors import InputError
from fusion.recording.excitation import KINDS
from fusion.recording.manifest import SCAN, ChannelEntry, Daq, Frames, RecordingFile, SetUpFiles
from fusion.recording.placement import CLOSE_TO_AXIS_RAD, aim_contradiction, carrier, unit_direction
from fusion.recording.recording_notices import (
    CONTRADICTING_DIRECTION,
    CONTRADICTING_VALUES,
    INVALID_SYNTAX,
    KEY_NOT_APPLICABLE,
    MISSING_KEY,
    REFERENCE_CHANNEL_REQUIRED,
    REPEATED_NAME,
    UNKNOWN_NAME,
    UNREADABLE_FILE,
)
from fusion.recording.rig import Rig, Stereo
from fusion.recording.toml import quote_key
from fusion.recording.transducer import HEAD, STATIONARY, TRANSDUCERS
from fusion.recording.values import describe, repeated_name
from shakercal._common.notices import DeclaredNotice

MAX_SURFACE_TILT_DEG = 80.0
"""Largest angle between the view and the normal of the surface before a single camera: 1/cos is 6 there."""
LocatedChannel = tuple[str, Daq, ChannelEntry]
"""Key path of a channel, its block, its entry."""


def _error(declared: DeclaredNotice, path: Path, key: str, found: str, expected: str) -> InputError:
    return InputError(declared, path, key, found=found, expected=expected)


def find_contradictions(rig: Rig, rig_path: Path, record: RecordingFile, path: Path) -> Iterator[InputError]:
    """Yield every contradiction between a rig and a recording."""
    if not record.daq and not record.take and not KINDS[record.excitation.kind].readings_in_table:
        yield _error(MISSING_KEY, path, "daq", "none", "at least one [[daq]] or [[take]] block")
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
    yield from _stereo_errors(rig, rig_path, blocks)
    yield from _image_errors(rig, blocks, path)
    for (prefix, block), located in zip(blocks, channels, strict=True):
        yield from _trigger_errors(
            block, {entry.name for _, _, entry in located if entry.quantity == "trigger"}, prefix, path
        )
        yield from _free_running_errors(block, located, rig, prefix, path)
        yield from _output_errors(located, path, rig, rig_path)
    for key, daq, entry in (item for located in channels for item in located):
        aim = None if daq.data_set(entry)[1] == "" and daq.file.suffix.lower() == SCAN else aim_contradiction(entry)
        if aim is not None:
            yield _error(CONTRADICTING_DIRECTION, path, f"{key}.direction", aim[1], aim[0])
    yield from _standoff_errors((item for located in channels for item in located), path)
    yield from _carrier_errors([item for located in channels for item in located], path)
    first: dict[str, ChannelEntry] = {}  # channels of one instrument share a relative error, hence measure one quantity
    for key, _, entry in (item for located in channels for item in located if item[2].common is not None):
        model = first.setdefault(str(entry.common), entry)
        if entry.quantity != model.quantity:
            expected = f'"{model.quantity}" as in channel {model.name}, which has common = "{entry.common}" too'
            yield _error(CONTRADICTING_VALUES, path, f"{key}.quantity", f'"{entry.quantity}"', expected)
    yield from _reference_errors([prefix for prefix, _ in blocks], channels, several=bool(record.take), path=path)
    recorded_names = {entry.name for located in channels for _, _, entry in located}
    for key, names in record.excitation.channels:
        for channel in names:
            if channel not in recorded_names:
                found = f'"{channel}"; channels are {", ".join(sorted(recorded_names))}'
                yield _error(UNKNOWN_NAME, path, f"excitation.{key}", found, "the name of a recorded channel")
    twice = repeated_name([part.name for part in rig.part + record.part])
    if twice is not None:
        expected = "parts of different names in rig and recording"
        yield _error(REPEATED_NAME, path, f"part.{quote_key(twice)}.name", f'"{twice}" twice', expected)


def _standoff_errors(located: Iterable[LocatedChannel], path: Path) -> Iterator[InputError]:
    """Yield errors of diverging beams of a head without a mirror."""
    first: dict[str, ChannelEntry] = {}
    for key, _, entry in located:
        if entry.head is not None and entry.head.stated.standoff is not None:
            model = first.setdefault(entry.head.name, entry)
            if unit_direction(model) @ unit_direction(entry) < np.cos(CLOSE_TO_AXIS_RAD):
                expected = f"nearly the direction of channel {model.name}, whose beam leaves head {entry.head.name} too"
                yield _error(
                    CONTRADICTING_DIRECTION, path, f"{key}.direction", f"{list(entry.direction or ())}", expected
                )


def _carrier_errors(located: Sequence[LocatedChannel], path: Path) -> Iterator[InputError]:
    """Yield errors of channels for the motion of a head without beams at a body."""
    carried = {carrier(entry) for _, _, entry in located if entry.body not in (STATIONARY, HEAD)}
    for key, _, entry in located:
        if entry.body in (STATIONARY, HEAD) and entry.head is not None and carrier(entry) not in carried:
            expected = "a head with a laser beam at the load or the base"
            yield _error(UNKNOWN_NAME, path, f"{key}.head", f'"{entry.head.name}"', expected)


def _stereo_errors(rig: Rig, rig_path: Path, blocks: Iterable[tuple[str, SetUpFiles]]) -> Iterator[InputError]:
    """Yield errors of stereo pairs: missing calibration or scale uncertainty, support, surface."""
    with_images = [images.stereo for _, block in blocks for images in block.images]
    with_points = [points.stereo for _, block in blocks for points in block.points]
    recorded = dict.fromkeys(with_images + with_points)
    carried = {rig.stereo[name].support or name for name in recorded if rig.stereo[name].body != STATIONARY}
    for name in recorded:
        pair = rig.stereo[name]
        if pair.body == STATIONARY and pair.support not in carried:
            supports = ", ".join(sorted(carried)) or "none"
            expected = "a support of cameras at the load or the base, or the name of their pair"
            found = f"{describe(pair.support)}; other cameras have {supports}"
            yield _error(UNKNOWN_NAME, rig_path, f"stereo.{quote_key(name)}.support", found, expected)
        if name in with_images and pair.calibration is None:
            expected = f"the calibration that the images of {name} need"
            yield _error(MISSING_KEY, rig_path, f"stereo.{quote_key(name)}.calibration", "no calibration", expected)
        if pair.surface is not None:
            key, axis = f"stereo.{quote_key(name)}.surface", np.array(pair.rotation)[:, 2]
            distance_m = float(axis @ np.subtract(pair.surface.point, pair.translation))
            tilt_deg = float(np.degrees(np.arccos(min(1.0, abs(float(axis @ np.array(pair.surface.normal)))))))
            if name in with_points:
                yield _error(KEY_NOT_APPLICABLE, rig_path, key, "one", "no such key for 3-D points")
            elif distance_m <= 0.0 or tilt_deg > MAX_SURFACE_TILT_DEG:
                found = f"one {distance_m:.3g} m before it, tilted by {tilt_deg:.3g}°"
                expected = f"a plane before the camera, tilted by at most {MAX_SURFACE_TILT_DEG:g}°"
                yield _error(CONTRADICTING_VALUES, rig_path, key, found, expected)
        scaled = pair.surface is not None or pair.scale_uncertainty is not None
        if not scaled and (name in with_points or not _has_covariance(pair)):
            expected = "the relative standard uncertainty of all lengths, required without a calibration's covariance"
            yield _error(MISSING_KEY, rig_path, f"stereo.{quote_key(name)}.scale_uncertainty", "no such key", expected)


def _has_covariance(pair: Stereo) -> bool:
    """Whether the calibration of a stereo pair states a covariance."""
    if pair.calibration is None:
        return False
    try:
        content: Any = json.loads(pair.calibration.read_text(encoding="utf-8"))
    except OSError as error:
        raise InputError(
            UNREADABLE_FILE, pair.calibration, found=error.strerror or str(error), expected="a file that can be read"
        ) from error
    except (ValueError, RecursionError) as error:
        raise InputError(INVALID_SYNTAX, pair.calibration, found=str(error), expected="JSON") from error
    return isinstance(content, dict) and content.get("covariance") is not None


def _image_errors(rig: Rig, blocks: Iterable[tuple[str, SetUpFiles]], path: Path) -> Iterator[InputError]:
    """Yield errors of images: missing or superfluous second camera, missing region of shared images."""
    for prefix, block in blocks:
        for images in block.images:
            key = f"{prefix}images.{quote_key(images.stereo)}.right"
            single = rig.stereo[images.stereo].surface is not None
            if single and images.right:
                expected = "no such key for a single camera, whose surface rig.toml states"
                yield _error(KEY_NOT_APPLICABLE, path, key, "images", expected)
            if not single and not images.right:
                expected = "the images of the right camera (or the surface before a single camera in rig.toml)"
                yield _error(MISSING_KEY, path, key, "no such key", expected)
        shown = {images.left for images in block.images if rig.stereo[images.stereo].body == STATIONARY}
        for images in block.images:
            if images.left in shown and images.region is None and not images.mask:
                part = "the stationary object" if rig.stereo[images.stereo].body == STATIONARY else "the body"
                expected = f"the region of the images that shows {part}, since they show both"
                yield _error(
                    MISSING_KEY, path, f"{prefix}images.{quote_key(images.stereo)}.region", "no such key", expected
                )


def _trigger_errors(block: SetUpFiles, triggers: set[str], prefix: str, path: Path) -> Iterator[InputError]:
    """Yield errors of frames without a trigger channel, or with two blocks per pair."""
    kinds: tuple[tuple[str, tuple[Frames, ...]], ...] = (("images", block.images), ("points", block.points))
    for kind, frames in ((kind, frames) for kind, entries in kinds for frames in entries):
        if frames.trigger not in triggers and getattr(frames, "frame_rate", None) is None:
            found = f'"{frames.trigger}"; trigger channels are {", ".join(sorted(triggers)) or "none"}'
            expected = 'the name of a channel with quantity = "trigger"'
            yield _error(UNKNOWN_NAME, path, f"{prefix}{kind}.{quote_key(frames.stereo)}.trigger", found, expected)
    twice = repeated_name([frames.stereo for _, entries in kinds for frames in entries])
    if twice is not None:
        key, expected = f"{prefix}images.{quote_key(twice)}.stereo", "one images or points block per stereo pair"
        yield _error(REPEATED_NAME, path, key, f'two blocks for "{twice}"', expected)


def _free_running_errors(
    block: SetUpFiles, located: list[LocatedChannel], rig: Rig, prefix: str, path: Path
) -> Iterator[InputError]:
    """Yield errors of frames without a trigger whose body another instrument measures."""
    frames = [*block.images, *block.points]
    for images in (images for images in block.images if images.frame_rate is not None):
        body, key = rig.stereo[images.stereo].body, f"{prefix}images.{quote_key(images.stereo)}.frame_rate"
        others = [
            f"stereo {other.stereo}"
            for other in frames
            if other is not images and rig.stereo[other.stereo].body == body
        ]
        others += [entry.name for _, _, entry in located if entry.quantity in TRANSDUCERS and entry.body == body]
        if not block.daq:
            expected = "a recorder, whose channels determine the frequency of the motion"
            yield _error(MISSING_KEY, path, f"{prefix}daq", "no such key", expected)
        if others:
            expected = f"a trigger, because {others[0]} measures the phase of the {body} too"
            yield _error(KEY_NOT_APPLICABLE, path, key, f"{images.frame_rate:g} Hz", expected)


def _output_errors(located: list[LocatedChannel], path: Path, rig: Rig, rig_path: Path) -> Iterator[InputError]:
    """Yield errors of outputs that the sensor does not have, or that are recorded twice."""
    seen: list[tuple[str, str]] = []
    for key, daq, entry in located:
        if entry.channel is None:
            continue
        if rig.sensor is None:
            yield _error(
                MISSING_KEY, rig_path, "sensor", "no such key", f"the [sensor] whose output {entry.name} is recorded"
            )
            return
        if entry.channel not in rig.sensor.channels:
            expected = "one of the sensor's channels " + ", ".join(rig.sensor.channels)
            yield _error(UNKNOWN_NAME, path, f"{key}.channel", f'"{entry.channel}"', expected)
        output = entry.channel, daq.data_set(entry)[1]
        if output in seen:
            yield _error(
                REPEATED_NAME, path, f"{key}.channel", f'"{entry.channel}" twice', "each output of the sensor once"
            )
        seen.append(output)


def _reference_errors(
    prefixes: list[str], channels: list[list[LocatedChannel]], *, several: bool, path: Path
) -> Iterator[InputError]:
    """Yield errors of reference channels: every take needs the same one."""
    marked = [
        [(key, daq.name, daq.data_set(entry)[0]) for key, daq, entry in located if entry.reference]
        for located in channels
    ]
    for keys in marked:
        if len({(daq, name) for _, daq, name in keys}) > 1:
            expected = "one channel with reference = true"
            yield _error(REFERENCE_CHANNEL_REQUIRED, path, f"{keys[1][0]}.reference", f"{len(keys)} of them", expected)
            return
    for prefix, keys in zip(prefixes, marked, strict=True) if several else ():
        same = marked[0] and {(daq, name) for _, daq, name in keys} == {marked[0][0][1:]}
        if not same:
            found = "none" if not keys else f"{keys[0][1]}.{keys[0][2]}"
            expected = "one channel with reference = true, the same in every take"
            yield _error(REFERENCE_CHANNEL_REQUIRED, path, f"{prefix}daq", found, expected)
