"""What a recording holds, what its instruments can observe, what is missing: read, never computed."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from fusion.base import InputError
from fusion.estimation.uncertainty import rounded
from fusion.phasors.timing import channel_pulse_width, no_pulse_width
from fusion.recording.files import ScannedPoint, check_response, read_takes, scanned_points, split_scan, take_blocks
from fusion.recording.load import Manifest
from fusion.recording.manifest import ChannelEntry, Daq, Frames, Images, PointFiles
from fusion.recording.values import PULSE
from shaker.io.channel import RawChannel
from shaker.labels import LOAD_COMPONENTS, MOTION_COMPONENTS

BODIES = ("load", "base")
NO_REFERENCE = "no channel"
ROW_TOLERANCE = 1e-9
"""Relative singular value below which instruments do not tell two motions apart."""


@dataclass(frozen=True)
class Observability:
    """Which of the six motion components of a body an instrument determines by its place and direction alone."""

    body: str
    instrument: str
    rows: NDArray[np.float64]

    @property
    def components(self) -> tuple[str, ...]:
        """Names of the components determined."""
        return tuple(name for name, seen in zip(MOTION_COMPONENTS, observable(self.rows), strict=True) if seen)


@dataclass(frozen=True)
class CheckReport:
    """What `shakercal check` tells: contents, what each instrument observes, remarks, and what is wrong."""

    name: str
    path: Path
    contents: tuple[str, ...]
    observed: tuple[Observability, ...]
    remarks: tuple[str, ...]
    problems: tuple[str, ...]

    @property
    def lines(self) -> tuple[str, ...]:
        """The report as lines of text."""
        seen = [f"{item.body}: {item.instrument}: {_listed(item.components)}" for item in self.observed]
        sections = (
            ("contains", self.contents),
            ("can observe", seen or ["no motion"]),
            ("remarks", self.remarks),
            ("wrong", self.problems),
        )
        told = [
            line for title, items in sections if items for line in (f"  {title}", *(f"    {item}" for item in items))
        ]
        return (f"{self.name} ({self.path})", *told)

    def __str__(self) -> str:
        return "\n".join(self.lines)


def observable(rows: NDArray[np.float64]) -> NDArray[np.bool_]:
    """Which unit motions (6,) lie in the row space of geometric rows (M, 6) = [d, r×d], hence are determined.

    Lever arms are measured in units of the longest one, so that the tolerance knows no length.
    """
    if len(rows) == 0:
        return np.zeros(6, dtype=bool)
    longest = float(np.abs(rows[:, 3:]).max())
    scaled = rows / np.repeat([1.0, longest if longest > 0 else 1.0], 3)
    _, singular, directions = np.linalg.svd(scaled, full_matrices=False)
    basis = directions[singular > ROW_TOLERANCE * max(singular[0], 1e-300)]
    return np.asarray(np.sum(basis**2, axis=0) > 1 - 1e-6)


def geometric_row(entry: ChannelEntry) -> NDArray[np.float64]:
    """Row (6,) of a single-axis instrument: [d, r×d], or [0, d] of one that senses rotation."""
    direction = np.array(entry.direction, dtype=float)
    if entry.quantity == "angular_velocity":
        return np.concatenate([np.zeros(3), direction])
    return np.concatenate([direction, np.cross(np.array(entry.point, dtype=float), direction)])


def check(manifest: Manifest) -> CheckReport:
    """Look at what a manifest names, without tracking or fitting anything."""
    if manifest.excitation.file is not None:
        return _check_table(manifest, manifest.excitation.file)
    takes = _takes(manifest)
    contents, problems = _contents(manifest, takes)
    observed = _observed(manifest, takes)
    return CheckReport(
        name=manifest.name,
        path=manifest.path,
        contents=tuple(contents),
        observed=tuple(observed),
        remarks=tuple(_remarks(manifest, takes, observed)),
        problems=tuple(problems),
    )


def _check_table(manifest: Manifest, path: Path) -> CheckReport:
    """Look at the table of a rotation test."""
    from shaker.io.text import table_units

    told, problems = f"table {path.name}, {_size([path])}", []
    try:
        units = table_units(path)
        told += ": " + ", ".join(f"{name} [{unit}]" if unit else name for name, unit in units.items())
    except (OSError, ValueError) as error:
        problems.append(str(error))
    contents = [f"excitation: rotation {'with' if manifest.excitation.with_load else 'without'} load", told]
    if manifest.rig.load is not None:
        contents.append(f"load mass: {manifest.rig.load.true_mass:g} kg")
    remarks = ("shakercal rotate evaluates this recording, by gravity alone",)
    return CheckReport(manifest.name, manifest.path, tuple(contents), (), remarks, tuple(problems))


def _takes(manifest: Manifest) -> list[Manifest]:
    """What was recorded at once: the top level, every take, every point of a scan that can be read."""
    found: list[Manifest] = []
    for _, block in take_blocks(manifest):
        try:
            found += [part for part, _ in split_scan(block)]
        except InputError:
            found.append(block)
    return found


def _contents(manifest: Manifest, takes: Sequence[Manifest]) -> tuple[list[str], list[str]]:
    """One line for each file group, and what is wrong with it."""
    excitation = manifest.excitation
    lines = ", ".join(f"{line:g} Hz" for line in excitation.frequencies or ())
    contents, problems = [f"excitation: {excitation.kind}" + (f" at {lines}" if lines else "")], []
    if len(takes) > 1:
        contents.append(f"takes: {len(takes)}, tied by {_reference(takes)}")
    blocks = take_blocks(manifest)
    for where, block in blocks:
        told = [_read_daq(block, daq) for daq in block.daq]
        told += [_read_images(images) for images in block.images]
        told += [_describe_points(points) for points in block.points]
        told += [_measure_exposure(block, frames) for frames in _pulse_exposed(block)]
        problems += _unreadable_responses(block)
        prefix = f"{where.rstrip('.')} " if len(blocks) > 1 and where else ""
        contents += [prefix + line for line, _ in told]
        problems += [prefix + problem for _, wrong in told for problem in wrong]
    if len(takes) > 1 and _reference(takes) == NO_REFERENCE:
        problems.append("takes: no channel with reference = true that is the same in every take")
    mounted = [f"{part.name} {part.true_mass:g} kg on the {part.body}" for part in manifest.part]
    if manifest.rig.load is not None:
        contents.append(f"load mass: {manifest.rig.load.true_mass:g} kg" + "".join(f", {part}" for part in mounted))
    return contents, problems


def _reference(takes: Sequence[Manifest]) -> str:
    """Name of the channel that ties takes to each other."""
    named = [{entry.name for daq in take.daq for entry in daq.channel if entry.reference} for take in takes]
    return ", ".join(sorted(set.intersection(*named))) or NO_REFERENCE


def _read_daq(block: Manifest, daq: Daq) -> tuple[str, list[str]]:
    """Channels of a DAQ file, with samples and rate as the file has them."""
    from shaker.io.read import read_channels

    names = [entry.name for entry in daq.channel]
    listed = ", ".join(f"{entry.name} ({entry.quantity})" for entry in daq.channel)
    told = f"daq {daq.name}: {daq.file.name}, {_size([daq.file])}: {listed}"
    try:
        points = scanned_points(block, daq)
        channels = read_channels(daq.file, names, daq.sample_rate) if points is None else _of_all(points)
    except (OSError, ValueError, KeyError, InputError) as error:
        return told, [f"daq {daq.name}: {' '.join(str(error).split())}"]
    first = next(iter(channels.values()))
    holes = [name for name, channel in channels.items() if not np.isfinite(channel.samples).all()]
    told += f"; {first.samples.size} samples at {first.sample_rate_hz:g} Hz"
    told += "" if points is None else f", a scan of {len(points)} points, each a take"
    return told, [f"daq {daq.name}: channel {name} holds values that are no finite numbers" for name in holes]


def _of_all(points: Sequence[ScannedPoint]) -> dict[str, RawChannel]:
    """Channels of all points of a scan by block and point."""
    return {f"{name}/{point.number}": channel for point in points for name, channel in point.raw.items()}


def _unreadable_responses(block: Manifest) -> list[str]:
    """What is wrong with the response files that channels name."""
    wrong = []
    for path in dict.fromkeys(entry.response for daq in block.daq for entry in daq.channel if entry.response):
        try:
            check_response(path)
        except InputError as error:
            wrong.append(str(error))
    return wrong


def _read_images(images: Images) -> tuple[str, list[str]]:
    """Frames of both cameras, with their size as the files have it."""
    from photogram.images import open_sequence

    told = f"images {images.stereo}: {_size([*images.left, *images.right])}"
    try:
        left, right = (open_sequence(paths, images.bit_depth) for paths in (images.left, images.right))
    except (OSError, ValueError) as error:
        return told, [f"images {images.stereo}: {' '.join(str(error).split())}"]
    told += f", {len(left)} frames of {left.size_px[0]} x {left.size_px[1]} px, grey values up to {left.full_scale:g}"
    wrong = []
    if len(left) != len(right):
        wrong.append(f"images {images.stereo}: {len(left)} frames left and {len(right)} right")
    if len(left) < 3:
        wrong.append(f"images {images.stereo}: {len(left)} frames, at least 3 are needed")
    return told, wrong


def _describe_points(points: PointFiles) -> tuple[str, list[str]]:
    """Point tables: how many files."""
    empty = [path.name for path in points.files if path.stat().st_size == 0]
    told = f"points {points.stereo}: {len(points.files)} files, {_size(points.files)}"
    return told, [f"points {points.stereo}: {empty[0]} is empty ({len(empty)} such files)"] if empty else []


def _pulse_exposed(block: Manifest) -> list[Frames]:
    """Images and points whose exposure is the width of the trigger's pulses."""
    return [frames for frames in (*block.images, *block.points) if frames.exposure == PULSE]


def _measure_exposure(block: Manifest, frames: Frames) -> tuple[str, list[str]]:
    """How wide the pulses are that the first DAQ block has of the trigger."""
    daq = next(daq for daq in block.daq if frames.trigger in [entry.name for entry in daq.channel])
    told = f"exposure of {frames.stereo}: width of the pulses of {frames.trigger} in {daq.name}"
    try:
        record = read_takes(replace(block, daq=(daq,), images=(), points=()))[0].records[0]
        pulse = channel_pulse_width(record, frames.trigger)
    except InputError as error:
        return told, [str(error)]
    except ValueError as error:
        return told, [str(no_pulse_width(block, daq.name, frames, error))]
    width, expanded, _ = rounded(1e6 * pulse.width_s, 2e6 * pulse.u_width_s, 0)
    return f"{told}, ({width} ± {expanded}) µs, U (k = 2)", []


def _size(paths: Sequence[Path]) -> str:
    """Total size of files."""
    size = float(sum(path.stat().st_size for path in paths))
    for unit in ("B", "kB", "MB"):
        if size < 1000:
            return f"{size:.3g} {unit}"
        size /= 1000
    return f"{size:.3g} GB"


def _observed(manifest: Manifest, takes: Sequence[Manifest]) -> list[Observability]:
    """Rows of every instrument, then of all instruments of a body together."""
    frames = {entry.stereo: entry for take in takes for entry in (*take.images, *take.points)}
    single = [*(_stereo(manifest, entry) for entry in frames.values()), *_instruments(takes)]
    found = []
    for body in BODIES:
        own = [item for item in single if item.body == body]
        found += own
        if len(own) > 1:
            found.append(Observability(body, "all together", np.concatenate([item.rows for item in own])))
    return found


def _stereo(manifest: Manifest, frames: Frames) -> Observability:
    """A stereo pair determines all six components of the body it sees."""
    return Observability(manifest.rig.stereo[frames.stereo].body, f"stereo {frames.stereo}", np.eye(6))


def _instruments(takes: Sequence[Manifest]) -> list[Observability]:
    """Single-axis channels, those of one `common` name or else of one DAQ file taken together."""
    groups: dict[tuple[str, str], list[NDArray[np.float64]]] = {}
    for take in takes:
        for daq in take.daq:
            for entry in daq.channel:
                if entry.quantity in ChannelEntry.MOTION and entry.body is not None:
                    rows = groups.setdefault((entry.body, entry.common or f"{daq.name}.{entry.name}"), [])
                    rows.append(geometric_row(entry))
    return [Observability(body, name, np.stack(rows)) for (body, name), rows in groups.items()]


def _remarks(manifest: Manifest, takes: Sequence[Manifest], observed: list[Observability]) -> list[str]:
    """What the results will lack, and why."""
    if manifest.excitation.kind == "step":
        return _step_remarks(manifest, takes)
    rig, told = manifest.rig, []
    together = {body: _all_rows(observed, body) for body in BODIES}
    told += [
        f"{body}: nobody observes {_listed(_unseen(rows))}"
        for body, rows in together.items()
        if 0 < len(_unseen(rows)) < 6
    ]
    told += [f"{name} has no instrument" for name, rows in together.items() if len(rows) == 0]
    told += [
        f"load: nobody observes the driven component {name}" for name in _driven_but_unseen(manifest, together["load"])
    ]
    if rig.load is None:
        told.append("rig.toml has no [load]: no load and no sensitivity")
    if rig.sensor is None:
        told.append("rig.toml has no [sensor]: no sensitivity")
    elif not any(entry.quantity == "output" for entry in _entries(takes)):
        told.append("no channel is an output of the sensor: no sensitivity")
    if rig.environment is None or rig.environment.gravity is None:
        told.append("rig.toml states no gravity: tilt is not corrected")
    told += [
        f"channel {entry.name} states no uncertainty of its scale: compared with the others, not fused"
        for entry in _entries(takes)
        if entry.quantity in ChannelEntry.MOTION and not (entry.scale_uncertainty or entry.individual_uncertainty)
    ]
    told += [
        f"daq {name} shares no trigger channel with another block: its clock cannot be tied" for name in _loose(takes)
    ]
    return told


def _step_remarks(manifest: Manifest, takes: Sequence[Manifest]) -> list[str]:
    """What the models of a step response will lack."""
    excitation, entries = manifest.excitation, _entries(takes)
    outputs = [entry.channel for entry in entries if entry.quantity == "output"]
    told = ["shakercal step evaluates this recording"]
    if not outputs:
        told.append("no channel is an output of the sensor: no model")
    elif excitation.component not in outputs:
        told.append(f"no channel is the output {excitation.component}, which is driven: cross-talk only")
    if excitation.force is not None and excitation.force not in [e.name for e in entries if e.quantity == "force"]:
        told.append(f"no force channel is named {excitation.force}")
    if len(takes) > 1:
        told.append("several takes: shakercal step expects one release per recording")
    return told


def _entries(takes: Sequence[Manifest]) -> list[ChannelEntry]:
    """Every channel of a recording, once by its name."""
    return list({entry.name: entry for take in takes for daq in take.daq for entry in daq.channel}.values())


def _all_rows(observed: list[Observability], body: str) -> NDArray[np.float64]:
    """Rows of all instruments of a body."""
    rows = [item.rows for item in observed if item.body == body]
    return np.concatenate(rows) if rows else np.zeros((0, 6))


def _unseen(rows: NDArray[np.float64]) -> tuple[str, ...]:
    """Components that rows do not determine."""
    return tuple(name for name, seen in zip(MOTION_COMPONENTS, observable(rows), strict=True) if not seen)


def _driven_but_unseen(manifest: Manifest, rows: NDArray[np.float64]) -> list[str]:
    """Load components that the excitation drives although the motion behind them is not observed."""
    direction = np.zeros(6)
    given = manifest.excitation.direction or ()
    direction[: len(given)] = given
    seen = observable(rows)
    return [LOAD_COMPONENTS[i] for i in np.flatnonzero(direction) if len(rows) and not seen[i]]


def _loose(takes: Sequence[Manifest]) -> list[str]:
    """DAQ blocks recorded with others whose triggers none of them shares."""
    loose = []
    for block in takes:
        triggers = {d.name: {e.name for e in d.channel if e.quantity == "trigger"} for d in block.daq}
        for name, own in triggers.items():
            others = set[str]().union(*(theirs for other, theirs in triggers.items() if other != name))
            if len(triggers) > 1 and not own & others:
                loose.append(name)
    return loose


def _listed(names: Sequence[str]) -> str:
    """Names in a row, or none."""
    return " ".join(names) if names else "no component by itself"
