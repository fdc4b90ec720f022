"""`shakercal check`: contents of a recording, observable motions, remarks and problems."""

from __future__ import annotations

import os
import re
from collections.abc import Collection, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from fusion.errors import ComputeError, InputError
from fusion.instruments.channel import errors_are_stated, scale_is_stated
from fusion.instruments.vibrometer import beam_notices
from fusion.phasors.channel_phasors import describe_folds, folding
from fusion.phasors.timing import pulse_width_error
from fusion.planning.observability import (
    BODIES,
    TOGETHER,
    Observability,
    calibration_problems,
    describe_single_cameras,
    instrument_observability,
    observable_components,
)
from fusion.recording.daq_records import FileCache, read_set_ups, recorded_channels, scanned_points, split_scan
from fusion.recording.excitation import KINDS, RecordedChannels
from fusion.recording.load import Manifest
from fusion.recording.manifest import ChannelEntry, Daq, Frames, Images
from fusion.recording.placement import LaserBeams, chain_name
from fusion.recording.response import check_response, read_response
from fusion.recording.rig import Rig, Stereo
from fusion.recording.toml import quote_key
from fusion.recording.transducer import TRANSDUCERS
from fusion.recording.units import unit_notices
from fusion.recording.values import PULSE
from fusion.sensitivity.exact_inputs import exact_inputs
from shaker.frf.chain import ChainResponse
from shaker.labels import LOAD_COMPONENTS, MOTION_COMPONENTS
from shaker.signal_notices import PERIODIC_ESTIMATE, REST_ESTIMATE
from shakercal._common.digits import number_text, round_to_uncertainty
from shakercal._common.notices import Notice

RIG, NO_REFERENCE = "rig.toml", "no channel"
CODE = re.compile(r"^SC-\d{3} ")
"""Code at the beginning of an error."""
ASSUMED_EXACT, NOT_FUSED = "assumed exact", "compared with the others, not fused"
"""Use of a channel without a stated scale uncertainty."""
METHODS = (PERIODIC_ESTIMATE.code, REST_ESTIMATE.code)
"""Notes of what the command will do."""
REFERENCE_HZ = 160.0
"""Frequency at which responses are read without stated lines (ISO 16063-21)."""


@dataclass(frozen=True)
class CheckReport:
    """Report of `shakercal check`.

    Attributes
    ----------
    name, path : Of the recording.
    contents : One text per group of files.
    observed : Motion components that each instrument determines.
    remarks : Limits of the results, and warnings.
    problems : Errors that its command would refuse.

    Examples
    --------
    >>> from fusion import CheckReport, check, load_manifest
    >>> report = check(load_manifest("sample_images/demo/Fz-0080"))
    >>> isinstance(report, CheckReport), report.problems
    (True, ())
    """

    name: str
    path: Path
    contents: tuple[str, ...]
    observed: tuple[Observability, ...]
    remarks: tuple[str, ...]
    problems: tuple[str, ...]

    def without_repeats(self, shown: set[str]) -> CheckReport:
        """Return the report without texts about shared files that other recordings have `shown`.

        Shared files are those of the rig, which a campaign shows once. The texts of this report are added to `shown`.
        """
        folder, above = f"{self.path.parent}{os.sep}", str(self.path.parent.parent)

        def new(texts: tuple[str, ...]) -> tuple[str, ...]:
            starts = ((text, CODE.sub("", text)) for text in texts)
            shared = {text for text, at in starts if at.startswith((RIG, above)) and not at.startswith(folder)}
            remaining = tuple(text for text in texts if text not in shared or text not in shown)
            shown.update(shared)
            return remaining

        return replace(self, remarks=new(self.remarks), problems=new(self.problems))

    def parts(self) -> dict[str, Any]:
        """Return all parts by their names, for JSON."""
        observed = [
            {"body": one.body, "instrument": one.instrument, "components": one.components} for one in self.observed
        ]
        texts = {name: list(getattr(self, name)) for name in ("contents", "remarks", "problems")}
        return {"name": self.name, "path": str(self.path), "observed": observed, **texts}

    def __str__(self) -> str:
        sections = (
            ("contains", self.contents),
            ("can observe", [str(item) for item in self.observed] or ["no motion"]),
            ("remarks", self.remarks),
            ("wrong", self.problems),
        )
        lines = [f"{self.name} ({self.path})"]
        for title, items in sections:
            lines += [f"  {title}", *(f"    {item}" for item in items)] if items else []
        return "\n".join(lines)


def check(manifest: Manifest) -> CheckReport:
    """Check a recording: read its files as its command does, without tracking images.

    Parameters
    ----------
    manifest
        The recording.

    Returns
    -------
    Contents, observable motions, remarks and problems.

    Examples
    --------
    >>> from fusion import check, load_manifest
    >>> print(check(load_manifest("sample_images/demo/Fz-0080")))  # doctest: +ELLIPSIS
    Fz 80.0 Hz, simulated (...)
      contains
        excitation: sine at 80 Hz
    ...
    """
    already = FileCache()
    report = inspect_recording(manifest, already)
    if report.problems:
        return report
    problems, notices = read_for_command(manifest, already)
    shown = [notice for notice in notices if notice.severity == "warning" or notice.code in METHODS]
    warned = [f"{notice.where}: {notice.text}" for notice in shown]
    return replace(report, problems=tuple(problems), remarks=(*report.remarks, *warned))


def inspect_recording(manifest: Manifest, already: FileCache) -> CheckReport:
    """Return contents, observable motions and the problems of single files.

    Data that were read are stored in `already`.
    """
    kind, excitation = KINDS[manifest.excitation.kind], manifest.excitation
    together = ["shakercal run evaluates this recording, shakercal transfer its channels alone"]
    remarks = [
        *(together if manifest.is_broadband else kind.command_remark),
        *(f"{notice.where}: {notice.text}" for notice in manifest.notices),
    ]
    if kind.readings_in_table and excitation.file is not None:
        contents, problems = _table(manifest, excitation.file)
        return CheckReport(manifest.name, manifest.path, tuple(contents), (), tuple(remarks), tuple(problems))
    takes = [take for _, block in manifest.set_ups for take in _takes(block)]
    contents, problems = _contents(manifest, takes, already)
    named = {(where, daq.name): (block, daq) for where, block in manifest.set_ups for daq in block.daq}
    doubted = [unit_notices(*named[key], raw) for key, raw in already.channels.items()]
    remarks += [f"{notice.where}: {notice.text}" for notices in doubted for notice in notices]
    observed = instrument_observability(manifest.rig, takes)
    alone = describe_single_cameras(manifest.rig, takes, observed, already)
    blank = _blank(takes, already)
    seen = {item.instrument for item in observed} - {TOGETHER} - {f"stereo {name}" for name, _ in blank}
    (remarks if seen else problems).extend(text for _, text in blank)
    # Every channel once, by its name.
    placed = [entry for take in takes for daq in take.daq for entry in daq.channel]
    entries = list({entry.name: entry for entry in placed}.values())
    contents += _heads(placed)
    if kind.remarks is None:
        remarks += [f"{notice.where}: {notice.text}" for notice in beam_notices(placed)]
        remarks += alone
        remarks += _motion_remarks(manifest.rig, excitation.direction or (), entries, observed)
        seen = {manifest.rig.stereo[one.stereo].body for take in takes for one in (*take.images, *take.points)}
        remarks += _unstated(manifest, entries, seen)
        exact = exact_inputs(manifest, entries) if manifest.rig.sensor is not None else ""
        remarks += [f"counted as exact, no uncertainty stated: {exact}"] * bool(exact)
        remarks += [remark for take in takes for remark in _clock_remarks(take.daq)]
        problems += _missing_mode_entries(manifest, takes) if "run" in kind.commands else []
    else:
        outputs = tuple(entry.channel for entry in entries if entry.quantity == "output")
        forces = tuple(entry.name for entry in entries if entry.quantity == "force")
        remarks += kind.remarks(excitation, RecordedChannels(outputs, forces, len(takes)))
    return CheckReport(manifest.name, manifest.path, tuple(contents), tuple(observed), tuple(remarks), tuple(problems))


def read_for_command(manifest: Manifest, already: FileCache) -> tuple[list[str], list[Notice]]:
    """Return the errors and notices of the recording's command while it reads the files.

    Images after the first one are not read.
    """
    try:
        return [], read_as_command(manifest, already)
    except InputError as error:
        return [str(error)], []
    except ComputeError:  # the files are correct
        return [], []


def read_as_command(manifest: Manifest, already: FileCache) -> list[Notice]:
    """Return the notices of the recording's command while it reads the files.

    Its modules are imported only for that command.
    """
    command, notices = KINDS[manifest.excitation.kind].commands[0], list[Notice]()
    command = "run" if manifest.is_broadband else command
    manifest.check_command(command)
    if command == "run":
        from fusion.phasors.phasor_notices import ROWS_NEED_LINES
        from fusion.phasors.set_up import prepare_set_ups, with_channels
        from fusion.phasors.stereo_motion import RejectedPair

        for set_up in prepare_set_ups(manifest, already):
            notices += [notice for images in set_up.images for notice in images.notices]
            sights = [images.sight for images in set_up.images if set_up.broadband is not None]
            rolling = [sight.name for sight in sights if any(sight.pair.row_time)]
            notices += [RejectedPair(name, ComputeError(ROWS_NEED_LINES, name)).notice for name in rolling]
            notices += [notice for channel in with_channels(set_up, shown=False).channels for notice in channel.notices]
    elif command == "transfer":
        from fusion.sensor.transfer.transfer_estimate import estimate_transfer
        from fusion.sensor.transfer.transfer_records import TransferSettings, read_synchronous

        for together in read_synchronous(manifest):
            notices += estimate_transfer(manifest, together, TransferSettings()).notices
    elif command == "step":
        from fusion.sensor.step.step_releases import read_recording

        notices += read_recording(manifest)[1]
    else:
        from fusion.sensor.rotate.rotation_readings import read_rotations

        read_rotations([manifest])
    return notices


def check_together(manifests: Sequence[Manifest]) -> list[str]:
    """Return the contradictions between recordings that are evaluated together."""
    loads = [manifest for manifest in manifests if "load" in KINDS[manifest.excitation.kind].commands]
    transfers = [manifest for manifest in manifests if "transfer" in KINDS[manifest.excitation.kind].commands]
    contradictions = list[str]()
    if max(len(loads), len(transfers)) < 2:
        return contradictions
    from fusion.sensor.identify.identification_inputs import check_sensor
    from fusion.sensor.load.load_evaluation import check_one_sensor

    for group, check_them in ((loads, check_one_sensor), (transfers, check_sensor)):
        try:
            if len(group) > 1:
                check_them(group)
        except InputError as error:
            contradictions.append(str(error))
    return contradictions


def _table(manifest: Manifest, path: Path) -> tuple[list[str], list[str]]:
    """Return contents and problems of a recording with a table of readings."""
    from shaker.io.table import table_units

    text, problems = f"table {path.name}, {_size([path])}", []
    try:
        units = table_units(path)
        text += ": " + ", ".join(f"{name} [{unit}]" if unit else name for name, unit in units.items())
    except (OSError, ValueError) as error:
        problems.append(str(error))
    excitation = manifest.excitation
    contents = [f"excitation: {excitation.kind} {'with' if excitation.with_load else 'without'} load", text]
    if manifest.rig.load is not None:
        contents.append(f"load mass: {number_text(manifest.rig.load.true_mass, 6)} kg")
    return contents, problems


def _takes(block: Manifest) -> list[Manifest]:
    """Return a block, or every point of its scan if that can be read."""
    try:
        return [part for part, _ in split_scan(block)]
    except InputError:
        return [block]


def _contents(manifest: Manifest, takes: Sequence[Manifest], already: FileCache) -> tuple[list[str], list[str]]:
    """Return one line for each group of files, and their problems."""
    excitation = manifest.excitation
    lines = ", ".join(f"{number_text(line, 6)} Hz" for line in excitation.frequencies or ())
    contents, problems = [f"excitation: {excitation.kind}" + (f" at {lines}" if lines else "")], []
    marked = [{entry.name for daq in take.daq for entry in daq.channel if entry.reference} for take in takes]
    reference = ", ".join(sorted(set.intersection(*marked))) or NO_REFERENCE
    if len(takes) > 1:
        contents.append(f"takes: {len(takes)}, tied by {reference}")
    for where, block in manifest.set_ups:
        texts = [_read_daq(block, daq, where, already) for daq in block.daq]
        highest = max(block.excitation.frequencies or (0.0,))
        texts += [_read_images(images, manifest.rig.stereo[images.stereo], already, highest) for images in block.images]
        for points in block.points:
            empty = [path.name for path in points.files if path.stat().st_size == 0]
            wrong = [f"points {points.stereo}: {empty[0]} is empty ({len(empty)} such files)"] if empty else []
            texts.append((f"points {points.stereo}: {len(points.files)} files, {_size(points.files)}", wrong))
        texts += [_exposure(block, frames) for frames in (*block.images, *block.points) if frames.exposure == PULSE]
        entries = [entry for daq in block.daq for entry in daq.channel]
        for path, columns in dict.fromkeys((e.response, e.response_columns) for e in entries if e.response):
            try:
                check_response(path, columns)
            except InputError as error:
                problems.append(str(error))
        prefix = f"{where.rstrip('.')} " if where and len(manifest.set_ups) > 1 else ""
        contents += [prefix + line for line, _ in texts]
        problems += [prefix + problem for _, wrong in texts for problem in wrong]
    if len(takes) > 1 and reference == NO_REFERENCE:
        problems.append("takes: no common channel with reference = true in every take")
    mounted = [f"{part.name} {number_text(part.true_mass, 6)} kg on the {part.body}" for part in manifest.part]
    if manifest.rig.load is not None:
        contents.append(
            f"load mass: {number_text(manifest.rig.load.true_mass, 6)} kg" + "".join(f", {part}" for part in mounted)
        )
    measured, wrong = _measured_modes(manifest, takes)
    return [*contents, *measured], [*problems, *wrong]


def _measured_modes(manifest: Manifest, takes: Sequence[Manifest]) -> tuple[list[str], list[str]]:
    """Return one line for each pair that measures modes of the load, and problems."""
    load, texts, wrong = manifest.rig.load, list[str](), dict[str, None]()
    measuring = {name for part in (load.elastic if load is not None else ()) for name in part.measured_by}
    for name in dict.fromkeys(images.stereo for take in takes for images in take.images):
        if name in measuring:
            from fusion.sensitivity.mode_shapes import mode_shapes  # not needed by other recordings

            shapes = mode_shapes(load, name)
            if shapes is not None:
                texts.append(f"stereo {name} measures modes of the load: {', '.join(shapes.names)}")
                try:
                    shapes(np.zeros((1, 3)))
                except InputError as error:
                    wrong[str(error)] = None
    return texts, list(wrong)


def _missing_mode_entries(manifest: Manifest, takes: Sequence[Manifest]) -> list[str]:
    """Return the instruments on the load that a table of elastic modes omits."""
    channels = [entry for take in takes for daq in take.daq for entry in daq.channel if entry.quantity in TRANSDUCERS]
    pairs = [frames.stereo for take in takes for frames in (*take.images, *take.points)]
    names = [entry.name for entry in channels if entry.body == "load"]
    names += [name for name in pairs if manifest.rig.stereo[name].body == "load"]
    missing_entries = []
    for part in manifest.rig.load.elastic if manifest.rig.load is not None else ():
        missing = [name for name in dict.fromkeys(names) if part.mode and name not in part.mode[0].displacement]
        if missing:
            key = f"load.elastic.{quote_key(part.name)}.mode.displacement"
            missing_entries.append(
                f"{manifest.rig_path.name}: {key}: expected every instrument on the load, found no {missing[0]}"
            )
    return missing_entries


def _heads(entries: Sequence[ChannelEntry]) -> list[str]:
    """Return one line for each head of channels: its mirror and its number of channels."""
    heads = {entry.head.name: entry.head.stated for entry in entries if entry.head is not None}
    texts = []
    for name, stated in heads.items():
        count = sum(entry.head is not None and entry.head.name == name for entry in entries)
        mirror = "beams or axes as stated"
        if stated.mirror is not None:
            mirror = f"mirror at ({', '.join(f'{number_text(x, 6)}' for x in stated.mirror)}) m"
        elif stated.standoff is not None:
            mirror = f"mirror {number_text(stated.standoff, 6)} m away"
        texts.append(f"head {name}: {mirror}, {count} channels or points")
    return texts


def _read_daq(block: Manifest, daq: Daq, where: str, already: FileCache) -> tuple[str, list[str]]:
    """Return channels, samples and rate of a DAQ file, and its problems."""
    listed = ", ".join(f"{entry.name} ({entry.quantity})" for entry in daq.channel)
    further = daq.further_files
    repeats = f" and {len(further)} repeats" if further else ""
    text = f"daq {daq.name}: {daq.file.name}{repeats}, {_size([daq.file, *further])}: {listed}"
    try:
        points = scanned_points(block, daq)
        if points is None:
            channels = already.channels[where, daq.name] = recorded_channels(block, daq)
        else:
            channels = {f"{name}/{point.number}": channel for point in points for name, channel in point.raw.items()}
    except (OSError, ValueError, KeyError, InputError) as error:
        return text, [f"daq {daq.name}: {' '.join(str(error).split())}"]
    first = next(iter(channels.values()))
    periodic = block.excitation.slowest_hz is not None  # a periodic signal may have missing samples
    holes = [name for name, one in channels.items() if not periodic and not np.isfinite(one.samples).all()]
    text += f"; {first.samples.size} samples at {number_text(first.sample_rate_hz, 6)} Hz"
    text += "" if first.gap is None else f", not uniform: {first.gap}"
    folds = folding(block.excitation.frequencies or (), first.sample_rate_hz, first.samples.size)
    text += f" ({describe_folds(folds)} unless an anti-aliasing filter removes it)" if folds else ""
    text += "" if points is None else f", a scan of {len(points)} points, each a take"
    return text, [f"daq {daq.name}: channel {name} has values that are not finite" for name in holes]


def _read_images(images: Images, pair: Stereo, already: FileCache, highest_hz: float) -> tuple[str, list[str]]:
    """Return the frames of each camera with their size, and problems.

    The calibration is checked against the size. For a rolling shutter the readout time and the largest phase of a line
    over it are reported.
    """
    from photogram.images.image_files import open_sequence

    text = f"images {images.stereo}: {_size([*images.left, *images.right])}"
    try:
        for _, paths in images.cameras:
            already.images[paths, images.bit_depth] = open_sequence(paths, images.bit_depth)
    except (OSError, ValueError) as error:
        return text, [f"images {images.stereo}: {' '.join(str(error).split())}", *calibration_problems(pair, ())]
    sequences = [already.images[paths, images.bit_depth] for _, paths in images.cameras]
    left = sequences[0]
    sizes = dict.fromkeys(f"{width} x {height}" for width, height in (images.size_px for images in sequences))
    text += f", {len(left)} frames of {' and '.join(sizes)} px, grey values up to {number_text(left.full_scale, 6)}"
    text += f", exposure {number_text(1e6 * left.exposure_s, 4)} µs by the file" if left.exposure_s is not None else ""
    if any(pair.row_time):
        read_s = pair.readout_s(left.size_px[1])
        text += f", rows exposed successively over {number_text(1e3 * read_s, 4)} ms"
        text += (
            f" ({number_text(360.0 * highest_hz * read_s)}° at {number_text(highest_hz, 6)} Hz)" if highest_hz else ""
        )
    wrong = calibration_problems(pair, sequences)
    if len(left) != len(sequences[-1]) and not isinstance(images.first_edge, dict):
        wrong.append(f"images {images.stereo}: {len(left)} frames left and {len(sequences[-1])} right")
    if len(left) < 3:
        wrong.append(f"images {images.stereo}: {len(left)} frames, at least 3 are needed")
    return text, wrong


def _blank(takes: Sequence[Manifest], already: FileCache) -> list[tuple[str, str]]:
    """Return the stereo pairs whose first image has no pattern; `run` omits them."""
    from photogram.images.sequence import missing_pattern_reason

    texts = list[tuple[str, str]]()
    for images in (images for take in takes for images in take.images):
        for side, paths in images.cameras:
            sequence = already.images.get((paths, images.bit_depth))
            with suppress(OSError, ValueError):  # the command that reads it reports the error
                why = missing_pattern_reason(sequence.read(0), sequence.full_scale) if sequence is not None else ""
                if why:
                    texts.append((images.stereo, f"images {images.stereo}: {side}: no pattern is visible: {why}"))
    return texts


def _exposure(block: Manifest, frames: Frames) -> tuple[str, list[str]]:
    """Return the width of the trigger pulses in the first DAQ block that records them."""
    daq = next(daq for daq in block.daq if frames.trigger in [entry.name for entry in daq.channel])
    text = f"exposure of {frames.stereo}: width of the pulses of {frames.trigger} in {daq.name}"
    try:
        record = read_set_ups(replace(block, daq=(daq,), images=(), points=()))[0].records[0]
        pulse = record.pulse_width(frames.trigger)
    except InputError as error:
        return text, [str(error)]
    except ValueError as error:
        return text, [str(pulse_width_error(block, daq.name, frames, error))]
    width, expanded, _ = round_to_uncertainty(1e6 * pulse.width_s, 2e6 * pulse.u_width_s, 0)
    return f"{text}, ({width} ± {expanded}) µs, U (k = 2)", []


def _size(paths: Sequence[Path]) -> str:
    """Return the total size of files."""
    size = float(sum(path.stat().st_size for path in paths))
    for unit in ("B", "kB", "MB"):
        if size < 1000:
            return f"{number_text(size)} {unit}"
        size /= 1000
    return f"{number_text(size)} GB"


def _motion_remarks(
    rig: Rig, direction: Sequence[float], entries: Sequence[ChannelEntry], observed: Sequence[Observability]
) -> list[str]:
    """Return the parts that the results from the motion will not have, with the reason."""
    remarks = []
    rows = {body: np.vstack([np.zeros((0, 6)), *(o.rows for o in observed if o.body == body)]) for body in BODIES}
    for body in BODIES:
        unobserved = [
            name for name, seen in zip(MOTION_COMPONENTS, observable_components(rows[body]), strict=True) if not seen
        ]
        if 0 < len(unobserved) < 6:
            remarks.append(f"{body}: no instrument observes {' '.join(unobserved)}")
    remarks += [f"{body} has no instrument" for body in BODIES if len(rows[body]) == 0]
    seen_of_load = observable_components(rows["load"])
    hidden = [i for i, share in enumerate(direction) if share and not seen_of_load[i] and len(rows["load"])]
    remarks += [f"load: no instrument observes the driven component {LOAD_COMPONENTS[i]}" for i in hidden]
    if rig.load is None:
        remarks.append("rig.toml has no [load]: no load and no sensitivity")
    if rig.sensor is None:
        remarks.append("rig.toml has no [sensor]: no sensitivity")
    elif not any(entry.quantity == "output" for entry in entries):
        remarks.append("no channel is an output of the sensor: no sensitivity")
    if rig.surroundings.free_fall_mps2[0] is None:
        size = "" if rig.surroundings.latitude is None else ", only where its size follows from (down is missing)"
        remarks.append(f"rig.toml states no gravity{size}: tilt is not corrected")
    return remarks


def _unstated(manifest: Manifest, entries: Sequence[ChannelEntry], pairs: Collection[str]) -> list[str]:
    """Return the motion channels without a stated scale uncertainty, and their use by `run`.

    `pairs`: bodies observed by stereo pairs, whose calibrations have uncertainties.
    """
    lines, read = np.array(manifest.excitation.frequencies or (REFERENCE_HZ,)), dict[Any, ChainResponse | None]()
    readable = list[tuple[ChannelEntry, ChainResponse | None]]()
    for entry in (entry for entry in entries if entry.quantity in TRANSDUCERS):
        file = entry.response, entry.response_result, entry.response_columns
        with suppress(InputError):  # reported as a problem
            if entry.response is not None and file not in read:
                read[file] = read_response(entry.response, lines, entry.response_result, entry.response_columns)
            readable.append((entry, read.get(file)))
    beams = LaserBeams.of([entry for entry, _ in readable])
    instruments = [(str(entry.body), entry.quantity, chain_name(entry)) for entry, _ in readable]
    stated = {
        name for name, (entry, response) in zip(instruments, readable, strict=True)
        if errors_are_stated(entry, response, beams)
    }  # fmt: skip
    remarks = []
    for name, (entry, response) in zip(instruments, readable, strict=True):
        alone = name[0] not in pairs and not any(body == name[0] for body, _, _ in stated)
        effect = ASSUMED_EXACT if name in stated or alone else NOT_FUSED
        if not scale_is_stated(entry, response):
            remarks.append(f"channel {entry.name} states no uncertainty of its scale: {effect}")
    return remarks


def _clock_remarks(blocks: Sequence[Daq]) -> list[str]:
    """Return the DAQ blocks of one take that share no trigger with the others."""
    triggers = {daq.name: {entry.name for entry in daq.channel if entry.quantity == "trigger"} for daq in blocks}
    remarks = []
    for name, own_triggers in triggers.items():
        others = set[str]().union(*(theirs for other, theirs in triggers.items() if other != name))
        if len(triggers) > 1 and not own_triggers & others:
            remarks.append(f"daq {name} shares no trigger channel with another block: its clock cannot be synchronised")
    return remarks
