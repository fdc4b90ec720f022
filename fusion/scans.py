"""A scanning vibrometer's text in a recording: every scan point is a take of its own."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import TypeVar

import numpy as np

from fusion.errors import InputError
from fusion.manifest import ChannelEntry, Daq, Frames, Manifest
from shaker._checks import FloatArray
from shaker.signals.files import Scan, read_scan_asc
from shaker.signals.recording import RawChannel

SUFFIX = ".asc"
SCANNING = ("velocity", "displacement")
AnyFrames = TypeVar("AnyFrames", bound=Frames)


@dataclass(frozen=True)
class ScannedPoint:
    """One point of a scan: the DAQ block as it was there, its channels named by their block alone, their samples.

    `number`: as channels name the point, counted from "1".
    """

    number: str
    daq: Daq
    raw: dict[str, RawChannel]


def scanned_points(manifest: Manifest, daq: Daq) -> tuple[ScannedPoint, ...] | None:
    """Return the points that a block of a scan holds, in the order of the scan; None for any other file.

    A channel that names its block alone was recorded at every point. A velocity or displacement that does so, and is
    not the reference, is what looked at the points: its `point` is where the origin of the file's coordinates lies in
    the sensor frame, whose axes they share. All others stand at their own.
    """
    if daq.file.suffix.lower() != SUFFIX:
        return None
    try:
        scan = read_scan_asc(daq.file)
    except (OSError, ValueError) as error:
        raise InputError.told_by(error, manifest.path, f"daq.{daq.name}.file") from error
    if len(scan.point_m) == 1:
        return None
    present = [str(number + 1) for number in range(len(scan.point_m))]
    sets = [daq.data_set(entry) for entry in daq.channel]
    for entry, (block, point) in zip(daq.channel, sets, strict=True):
        if point and (block, "") in sets:
            found = f"{block} beside it, which is recorded at every point"
            raise InputError(manifest.path, f"daq.{daq.name}.channel.{entry.name}", found, "each data set once")
        if point not in ("", *present) or block not in scan.take(0):
            expected = f"block/point of {len(scan.samples)} blocks and {len(present)} points, or a block alone"
            raise InputError(daq.file, entry.name, found="no such data set", expected=expected)
    named = {point for _, point in sets}
    return tuple(_point(daq, scan, place) for place, point in enumerate(present) if named & {"", point})


def split_scan(manifest: Manifest) -> Iterator[tuple[Manifest, ScannedPoint | None]]:
    """Yield what was recorded at once of a block of a manifest: itself, or one part for each point of its scan.

    What was recorded beside a scan belongs to its first point, images and points whose trigger names a point to that.
    """
    scans = {daq.name: points for daq in manifest.daq if (points := scanned_points(manifest, daq)) is not None}
    if len(scans) > 1:
        found, expected = f"{len(scans)}: {', '.join(scans)}", "one scan of several points at a time"
        raise InputError(manifest.path, "daq", found=found, expected=expected)
    if not scans:
        yield manifest, None
    for name, points in scans.items():
        for point in points:
            first = point is points[0]
            daq = tuple(
                point.daq if block.name == name else block for block in manifest.daq if first or block.name == name
            )
            images = tuple(_of_point(manifest.images, point, first))
            yield (
                replace(manifest, daq=daq, images=images, points=tuple(_of_point(manifest.points, point, first))),
                point,
            )


def _of_point(frames: Sequence[AnyFrames], point: ScannedPoint, first: bool) -> Iterator[AnyFrames]:
    """Yield the images or points of a scan point, their trigger named as its channels are."""
    for entry in frames:
        block, slash, number = entry.trigger.partition("/")
        if slash and block in point.raw and number.isdecimal():
            if number == point.number:
                yield entry.model_copy(update={"trigger": block})
        elif first:
            yield entry


def _point(daq: Daq, scan: Scan, place: int) -> ScannedPoint:
    """Return what a block holds at a scan point, by its place."""
    entries = tuple(
        _entry(entry, daq, scan.point_m[place])
        for entry in daq.channel
        if daq.data_set(entry)[1] in ("", str(place + 1))
    )
    samples = scan.take(place)
    raw = {entry.name: samples[entry.name] for entry in entries}
    return ScannedPoint(str(place + 1), daq.model_copy(update={"channel": entries}), raw)


def _entry(entry: ChannelEntry, daq: Daq, point_m: FloatArray) -> ChannelEntry:
    """Return a channel as it was at a scan point, named by its block."""
    block, point = daq.data_set(entry)
    if point or entry.point is None or entry.reference or entry.quantity not in SCANNING:
        return entry.model_copy(update={"name": block})
    place = np.asarray(entry.point, dtype=np.float64) + point_m
    return entry.model_copy(update={"name": block, "point": tuple(place.tolist())})
