"""A scanning vibrometer's text in a recording: every scan point is a take of its own."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np

from fusion.errors import InputError
from fusion.manifest import ChannelEntry, Daq, Manifest
from shaker.signals.files import Scan, read_scan_asc
from shaker.signals.recording import RawChannel

SUFFIX = ".asc"


@dataclass(frozen=True)
class ScannedPoint:
    """One point of a scan: the DAQ block as it was there, its channels named by their block alone, their samples."""

    daq: Daq
    raw: dict[str, RawChannel]


def named_point(entry: ChannelEntry) -> tuple[str, int | None]:
    """Return the block and the point, counted from 1, that a channel of a scan names; None stands for all points."""
    block, slash, point = entry.name.partition("/")
    return (block, int(point)) if slash and point.isdecimal() else (entry.name, None)


def scanned_points(manifest: Manifest, daq: Daq) -> tuple[ScannedPoint, ...] | None:
    """Return the points that a block of a scan holds, in the order of the scan; None for any other file.

    A channel that names its block alone was recorded at every point. Its `point` is where the origin of the file's
    coordinates lies in the sensor frame, whose axes they share; a channel that names its point stands at its own.
    """
    if daq.file.suffix.lower() != SUFFIX:
        return None
    try:
        scan = read_scan_asc(daq.file)
    except (OSError, ValueError) as error:
        raise InputError.told_by(error, manifest.path, f"daq.{daq.name}.file") from error
    if len(scan.point_m) == 1:
        return None
    named = [named_point(entry)[1] for entry in daq.channel]
    chosen = range(1, len(scan.point_m) + 1) if None in named else sorted({point for point in named if point})
    return tuple(_point(daq, scan, point) for point in chosen)


def split_scan(manifest: Manifest) -> Iterator[tuple[Manifest, ScannedPoint | None]]:
    """Yield what was recorded at once of a block of a manifest: itself, or one part for each point of its scan.

    What was recorded beside a scan belongs to its first point.
    """
    scans = {daq.name: points for daq in manifest.daq if (points := scanned_points(manifest, daq)) is not None}
    if len(scans) > 1:
        found, expected = f"{len(scans)}: {', '.join(scans)}", "one scan of several points at a time"
        raise InputError(manifest.path, "daq", found=found, expected=expected)
    if not scans:
        yield manifest, None
    for name, points in scans.items():
        for number, point in enumerate(points):
            alone = replace(manifest, daq=(point.daq,), images=(), points=())
            beside = tuple(point.daq if daq.name == name else daq for daq in manifest.daq)
            yield (alone if number else replace(manifest, daq=beside)), point


def _point(daq: Daq, scan: Scan, point: int) -> ScannedPoint:
    """Return what a block holds at a scan point, counted from 1."""
    entries = [_entry(entry, scan, point) for entry in daq.channel if named_point(entry)[1] in (None, point)]
    present = scan.take(point - 1) if point <= len(scan.point_m) else {}
    for entry in entries:
        if entry.name not in present:
            blocks, points = len(scan.samples), len(scan.point_m)
            expected = f"block/point of {blocks} blocks and {points} points, or a block alone"
            raise InputError(daq.file, f"{entry.name}/{point}", found="no such data set", expected=expected)
    block = daq.model_copy(update={"channel": tuple(entries)})
    return ScannedPoint(block, {entry.name: present[entry.name] for entry in entries})


def _entry(entry: ChannelEntry, scan: Scan, point: int) -> ChannelEntry:
    """Return a channel as it was at a scan point, named by its block."""
    block, own = named_point(entry)
    if own is not None or entry.point is None or point > len(scan.point_m):
        return entry.model_copy(update={"name": block})
    place = np.asarray(entry.point, dtype=np.float64) + scan.point_m[point - 1]
    return entry.model_copy(update={"name": block, "point": tuple(place.tolist())})
