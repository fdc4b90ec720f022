"""What a recording holds, what its instruments can observe, what is missing, what its command would refuse."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from fusion.base import AnyNotice, ComputeError, InputError, rounded
from fusion.instruments.channel import errors_are_stated, scale_is_stated
from fusion.instruments.stereo import GEOMETRY, carrier_of
from fusion.instruments.transducer import ROOM, TRANSDUCERS, Beams, carrier, chain_name, main_direction, placed_at
from fusion.instruments.vibrometer import beam_notices
from fusion.phasors.channels import folding, folds_told
from fusion.phasors.timing import no_pulse_width
from fusion.recording.excitation import KINDS, Recorded
from fusion.recording.files import AlreadyRead, read_set_ups, recorded_channels, scanned_points, split_scan
from fusion.recording.load import Manifest
from fusion.recording.manifest import ChannelEntry, Daq, Frames, Images
from fusion.recording.plausible import doubts
from fusion.recording.response import check_response, read_response
from fusion.recording.rig import Rig, Stereo
from fusion.recording.toml import quoted
from fusion.recording.units import unit_doubts
from fusion.recording.values import PULSE
from photogram.images.sequence import ImageSequence
from shaker.arrays import BoolArray, FloatArray
from shaker.frf.chain import ChainResponse
from shaker.labels import LOAD_COMPONENTS, MOTION_COMPONENTS

BODIES = ("load", "base")
NO_REFERENCE, TOGETHER = "no channel", "all together"
EXACT, FEWEST_SUBSETS = 1e-4, 6
REFERENCE_HZ = 160.0
"""At which responses are read where no lines are stated (ISO 16063-21)."""
ROW_TOLERANCE = 1e-9
"""Relative singular value below which instruments do not tell two motions apart."""


@dataclass(frozen=True)
class Observability:
    """Which of the six motion components of a body an instrument determines by its place and direction alone."""

    body: str
    instrument: str
    rows: FloatArray

    @property
    def components(self) -> tuple[str, ...]:
        """Names of the components determined."""
        return tuple(name for name, seen in zip(MOTION_COMPONENTS, observable(self.rows), strict=True) if seen)

    def __str__(self) -> str:
        return f"{self.body}: {self.instrument}: {' '.join(self.components) or 'no component by itself'}"


@dataclass(frozen=True)
class CheckReport:
    """What `shakercal check` tells: contents, what each instrument observes, remarks, and what is wrong.

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

    def parts(self) -> dict[str, Any]:
        """Return everything that is told by its name, as JSON knows it."""
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


def observable(rows: FloatArray) -> BoolArray:
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


def check(manifest: Manifest) -> CheckReport:
    """Read what a manifest names as the command that evaluates it does, up to where images would be followed.

    >>> from fusion import check, load_manifest
    >>> print(check(load_manifest("sample_images/demo/Fz-0080")))  # doctest: +ELLIPSIS
    Fz 80.0 Hz, simulated (...)
      contains
        excitation: sine at 80 Hz
    ...
    """
    kind, excitation = KINDS[manifest.excitation.kind], manifest.excitation
    remarks = [
        *kind.command_remark,
        *(f"{notice.where}: {notice.text}" for notice in (*manifest.certified, *doubts(manifest))),
    ]
    if kind.tabled and excitation.file is not None:
        contents, problems = _table(manifest, excitation.file)
        problems += _refused(manifest, AlreadyRead())[0] if not problems else []
        return CheckReport(manifest.name, manifest.path, tuple(contents), (), tuple(remarks), tuple(problems))
    already = AlreadyRead()
    takes = [take for _, block in manifest.set_ups for take in _takes(block)]
    contents, problems = _contents(manifest, takes, already)
    named = {(where, daq.name): (block, daq) for where, block in manifest.set_ups for daq in block.daq}
    doubted = [unit_doubts(*named[place], raw) for place, raw in already.channels.items()]
    remarks += [f"{notice.where}: {notice.text}" for notices in doubted for notice in notices]
    observed = _observed(manifest.rig, takes)
    told_alone = _alone(manifest.rig, takes, observed, already)
    blank = _blank(takes, already)
    seen = {item.instrument for item in observed} - {TOGETHER} - {f"stereo {name}" for name, _ in blank}
    (remarks if seen else problems).extend(text for _, text in blank)
    # Every channel once by its name.
    placed = [entry for take in takes for daq in take.daq for entry in daq.channel]
    entries = list({entry.name: entry for entry in placed}.values())
    contents += _heads(placed)
    if kind.remarks is None:
        remarks += [f"{notice.where}: {notice.text}" for notice in beam_notices(placed)]
        remarks += told_alone
        remarks += _motion_remarks(manifest.rig, excitation.direction or (), entries, observed)
        seen = {manifest.rig.stereo[one.stereo].body for take in takes for one in (*take.images, *take.points)}
        remarks += _unstated(manifest, entries, seen)
        remarks += [remark for take in takes for remark in _clock_remarks(take.daq)]
        problems += _without_place(manifest, takes) if "run" in kind.commands else []
    else:
        outputs = tuple(entry.channel for entry in entries if entry.quantity == "output")
        forces = tuple(entry.name for entry in entries if entry.quantity == "force")
        remarks += kind.remarks(excitation, Recorded(outputs, forces, len(takes)))
    refused, warned = _refused(manifest, already) if not problems else ([], [])
    problems, remarks = [*problems, *refused], [*remarks, *warned]
    return CheckReport(manifest.name, manifest.path, tuple(contents), tuple(observed), tuple(remarks), tuple(problems))


def _refused(manifest: Manifest, already: AlreadyRead) -> tuple[list[str], list[str]]:
    """What the command that evaluates a recording refuses of its files, and what it warns of in its images.

    An image beyond the first is not looked at.
    """
    command = KINDS[manifest.excitation.kind].commands[0]
    try:
        manifest.check_command(command)
        notices = _read_as(command, manifest, already)
    except InputError as error:
        return [str(error)], []
    except ComputeError:  # the files are as they should be
        return [], []
    return [], [f"{notice.where}: {notice.text}" for notice in notices if notice.severity == "warning"]


def _read_as(command: str, manifest: Manifest, already: AlreadyRead) -> list[AnyNotice]:
    """Read what a command reads, and return the notices of its images; its modules are imported for it alone."""
    notices = list[AnyNotice]()
    if command == "run":
        from fusion.phasors.setup import open_set_ups, with_channels

        for opened in open_set_ups(manifest, already):
            with_channels(opened, shown=False)
            notices += [notice for images in opened.images for notice in images.notices]
    elif command == "transfer":
        from fusion.sensor.transfer.evaluate import estimated
        from fusion.sensor.transfer.records import TransferSettings, read_together

        for together in read_together(manifest):
            estimated(manifest, together, TransferSettings())
    elif command == "step":
        from fusion.sensor.step.releases import read_recording

        read_recording(manifest)
    else:
        from fusion.sensor.rotate.readings import read_rotation

        read_rotation(manifest)
    return notices


def check_together(manifests: Sequence[Manifest]) -> list[str]:
    """Return what recordings of a campaign that are evaluated together say otherwise of their sensor."""
    loads = [manifest for manifest in manifests if "load" in KINDS[manifest.excitation.kind].commands]
    transfers = [manifest for manifest in manifests if "transfer" in KINDS[manifest.excitation.kind].commands]
    told = list[str]()
    if max(len(loads), len(transfers)) < 2:
        return told
    from fusion.sensor.identify.measured import check_sensor
    from fusion.sensor.load.evaluate import check_one_sensor

    for own, check_them in ((loads, check_one_sensor), (transfers, check_sensor)):
        try:
            if len(own) > 1:
                check_them(own)
        except InputError as error:
            told.append(str(error))
    return told


def _table(manifest: Manifest, path: Path) -> tuple[list[str], list[str]]:
    """Look at the table of a recording whose readings stand in one: contents, and what is wrong."""
    from shaker.io.text import table_units

    told, problems = f"table {path.name}, {_size([path])}", []
    try:
        units = table_units(path)
        told += ": " + ", ".join(f"{name} [{unit}]" if unit else name for name, unit in units.items())
    except (OSError, ValueError) as error:
        problems.append(str(error))
    excitation = manifest.excitation
    contents = [f"excitation: {excitation.kind} {'with' if excitation.with_load else 'without'} load", told]
    if manifest.rig.load is not None:
        contents.append(f"load mass: {manifest.rig.load.true_mass:g} kg")
    return contents, problems


def _takes(block: Manifest) -> list[Manifest]:
    """Return what a block recorded at once: itself, or every point of its scan where that can be read."""
    try:
        return [part for part, _ in split_scan(block)]
    except InputError:
        return [block]


def _contents(manifest: Manifest, takes: Sequence[Manifest], already: AlreadyRead) -> tuple[list[str], list[str]]:
    """One line for each file group, and what is wrong with it; what is read for it is `already` there."""
    excitation = manifest.excitation
    lines = ", ".join(f"{line:g} Hz" for line in excitation.frequencies or ())
    contents, problems = [f"excitation: {excitation.kind}" + (f" at {lines}" if lines else "")], []
    marked = [{entry.name for daq in take.daq for entry in daq.channel if entry.reference} for take in takes]
    reference = ", ".join(sorted(set.intersection(*marked))) or NO_REFERENCE
    if len(takes) > 1:
        contents.append(f"takes: {len(takes)}, tied by {reference}")
    for where, block in manifest.set_ups:
        told = [_read_daq(block, daq, where, already) for daq in block.daq]
        highest = max(block.excitation.frequencies or (0.0,))
        told += [_read_images(images, manifest.rig.stereo[images.stereo], already, highest) for images in block.images]
        for points in block.points:
            empty = [path.name for path in points.files if path.stat().st_size == 0]
            wrong = [f"points {points.stereo}: {empty[0]} is empty ({len(empty)} such files)"] if empty else []
            told.append((f"points {points.stereo}: {len(points.files)} files, {_size(points.files)}", wrong))
        told += [_exposure(block, frames) for frames in (*block.images, *block.points) if frames.exposure == PULSE]
        entries = [entry for daq in block.daq for entry in daq.channel]
        for path, columns in dict.fromkeys((e.response, e.response_columns) for e in entries if e.response):
            try:
                check_response(path, columns)
            except InputError as error:
                problems.append(str(error))
        prefix = f"{where.rstrip('.')} " if where and len(manifest.set_ups) > 1 else ""
        contents += [prefix + line for line, _ in told]
        problems += [prefix + problem for _, wrong in told for problem in wrong]
    if len(takes) > 1 and reference == NO_REFERENCE:
        problems.append("takes: no channel with reference = true that is the same in every take")
    mounted = [f"{part.name} {part.true_mass:g} kg on the {part.body}" for part in manifest.part]
    if manifest.rig.load is not None:
        contents.append(f"load mass: {manifest.rig.load.true_mass:g} kg" + "".join(f", {part}" for part in mounted))
    measured, wrong = _measured_modes(manifest, takes)
    return [*contents, *measured], [*problems, *wrong]


def _measured_modes(manifest: Manifest, takes: Sequence[Manifest]) -> tuple[list[str], list[str]]:
    """One line for each stereo pair that measures modes of the load, and what is wrong with their tables."""
    load, told, wrong = manifest.rig.load, list[str](), dict[str, None]()
    asked = {name for part in (load.elastic if load is not None else ()) for name in part.measured_by}
    for name in dict.fromkeys(images.stereo for take in takes for images in take.images):
        if name in asked:
            from fusion.sensitivity.mode_shapes import mode_shapes  # what the other recordings do without

            shapes = mode_shapes(load, name)
            if shapes is not None:
                told.append(f"stereo {name} measures modes of the load: {', '.join(shapes.names)}")
                try:
                    shapes(np.zeros((1, 3)))
                except InputError as error:
                    wrong[str(error)] = None
    return told, list(wrong)


def _without_place(manifest: Manifest, takes: Sequence[Manifest]) -> list[str]:
    """Which instruments on the load a table of elastic modes does not tell the motion of."""
    channels = [entry for take in takes for daq in take.daq for entry in daq.channel if entry.quantity in TRANSDUCERS]
    pairs = [frames.stereo for take in takes for frames in (*take.images, *take.points)]
    names = [entry.name for entry in channels if entry.body == "load"]
    names += [name for name in pairs if manifest.rig.stereo[name].body == "load"]
    told = []
    for part in manifest.rig.load.elastic if manifest.rig.load is not None else ():
        missing = [name for name in dict.fromkeys(names) if part.mode and name not in part.mode[0].displacement]
        if missing:
            key = f"load.elastic.{quoted(part.name)}.mode.displacement"
            told.append(
                f"{manifest.rig_path.name}: {key}: expected every instrument on the load, found no {missing[0]}"
            )
    return told


def _heads(entries: Sequence[ChannelEntry]) -> list[str]:
    """One line for each head that channels name: where its beams leave, and how many points or axes it has."""
    heads = {entry.head.name: entry.head.stated for entry in entries if entry.head is not None}
    told = []
    for name, stated in heads.items():
        count = sum(entry.head is not None and entry.head.name == name for entry in entries)
        place = "beams or axes stand as stated"
        if stated.mirror is not None:
            place = f"mirror at ({', '.join(f'{x:g}' for x in stated.mirror)}) m"
        elif stated.standoff is not None:
            place = f"mirror {stated.standoff:g} m away"
        told.append(f"head {name}: {place}, {count} channels or points")
    return told


def _read_daq(block: Manifest, daq: Daq, where: str, already: AlreadyRead) -> tuple[str, list[str]]:
    """Channels of a DAQ file, with samples and rate as the file has them."""
    listed = ", ".join(f"{entry.name} ({entry.quantity})" for entry in daq.channel)
    told = f"daq {daq.name}: {daq.file.name}, {_size([daq.file])}: {listed}"
    try:
        points = scanned_points(block, daq)
        if points is None:
            channels = already.channels[where, daq.name] = recorded_channels(block, daq)
        else:
            channels = {f"{name}/{point.number}": channel for point in points for name, channel in point.raw.items()}
    except (OSError, ValueError, KeyError, InputError) as error:
        return told, [f"daq {daq.name}: {' '.join(str(error).split())}"]
    first = next(iter(channels.values()))
    holes = [name for name, channel in channels.items() if not np.isfinite(channel.samples).all()]
    told += f"; {first.samples.size} samples at {first.sample_rate_hz:g} Hz"
    folds = folding(block.excitation.frequencies or (), first.sample_rate_hz, first.samples.size)
    told += f" ({folds_told(folds)} unless an anti-aliasing filter keeps it off)" if folds else ""
    told += "" if points is None else f", a scan of {len(points)} points, each a take"
    return told, [f"daq {daq.name}: channel {name} holds values that are no finite numbers" for name in holes]


def _read_images(images: Images, pair: Stereo, already: AlreadyRead, highest_hz: float) -> tuple[str, list[str]]:
    """Frames of each camera, with their size as the files have it, and whether the pair's calibration is one of it.

    Of a rolling shutter also how much later the last row is exposed, and how far a line at most turns meanwhile.
    """
    from photogram.images.files import open_sequence

    told = f"images {images.stereo}: {_size([*images.left, *images.right])}"
    try:
        for _, paths in images.cameras:
            already.images[paths, images.bit_depth] = open_sequence(paths, images.bit_depth)
    except (OSError, ValueError) as error:
        return told, [f"images {images.stereo}: {' '.join(str(error).split())}", *_no_rig(pair, ())]
    sequences = [already.images[paths, images.bit_depth] for _, paths in images.cameras]
    left = sequences[0]
    told += f", {len(left)} frames of {left.size_px[0]} x {left.size_px[1]} px, grey values up to {left.full_scale:g}"
    told += f", exposure {1e6 * left.exposure_s:.4g} µs by the file" if left.exposure_s is not None else ""
    if any(pair.row_time):
        read_s = pair.readout_s(left.size_px[1])
        told += f", rows exposed one after the other over {1e3 * read_s:.4g} ms"
        told += f" ({360.0 * highest_hz * read_s:.3g}° at {highest_hz:g} Hz)" if highest_hz else ""
    wrong = _no_rig(pair, sequences)
    if len(left) != len(sequences[-1]):
        wrong.append(f"images {images.stereo}: {len(left)} frames left and {len(sequences[-1])} right")
    if len(left) < 3:
        wrong.append(f"images {images.stereo}: {len(left)} frames, at least 3 are needed")
    return told, wrong


def _blank(takes: Sequence[Manifest], already: AlreadyRead) -> list[tuple[str, str]]:
    """Stereo pairs whose first image shows no pattern, each with what is said of it; `run` leaves them out."""
    from photogram.images.exposure import without_pattern

    told = list[tuple[str, str]]()
    for images in (images for take in takes for images in take.images):
        for side, paths in images.cameras:
            sequence = already.images.get((paths, images.bit_depth))
            with suppress(OSError, ValueError):  # of which the command that reads it says more
                why = without_pattern(sequence.read(0), sequence.full_scale) if sequence is not None else ""
                if why:
                    told.append((images.stereo, f"images {images.stereo}: {side}: no pattern is seen: {why}"))
    return told


def _no_rig(pair: Stereo, sequences: Sequence[ImageSequence]) -> list[str]:
    """Return what is wrong with a pair's calibration, also against the size of its pictures."""
    from fusion.phasors.stereo_motion import read_rig

    try:
        read_rig(pair, sequences)
    except InputError as error:
        return [str(error)]
    return []


def _exposure(block: Manifest, frames: Frames) -> tuple[str, list[str]]:
    """How wide the pulses are that the first DAQ block has of the trigger."""
    daq = next(daq for daq in block.daq if frames.trigger in [entry.name for entry in daq.channel])
    told = f"exposure of {frames.stereo}: width of the pulses of {frames.trigger} in {daq.name}"
    try:
        record = read_set_ups(replace(block, daq=(daq,), images=(), points=()))[0].records[0]
        pulse = record.pulse_width(frames.trigger)
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


def _observed(rig: Rig, takes: Sequence[Manifest]) -> list[Observability]:
    """Rows of every instrument, then of all instruments of a body together.

    A stereo pair determines all six components of the body it sees. Channels of one `common` name are one instrument.
    Of what looks at the room or sits on a head it is the motion of what carries it.
    """
    names = dict.fromkeys(entry.stereo for take in takes for entry in (*take.images, *take.points))
    pairs = [(name, rig.stereo[name]) for name in names]
    single = [
        Observability(carrier_of(name, pair) if pair.body == ROOM else pair.body, f"stereo {name}", GEOMETRY)
        for name, pair in pairs
    ]
    groups: dict[tuple[str, str], list[FloatArray]] = {}
    for daq in (daq for take in takes for daq in take.daq):
        for entry in daq.channel:
            if entry.quantity in TRANSDUCERS and entry.body is not None:
                seen = entry.body if entry.body in BODIES else carrier(entry) or entry.body
                rows = groups.setdefault((seen, entry.common or f"{daq.name}.{entry.name}"), [])
                rows.append(TRANSDUCERS[entry.quantity].geometry(placed_at(entry), main_direction(entry)))
    single += [Observability(body, name, np.stack(rows)) for (body, name), rows in groups.items()]
    observed = []
    for body in dict.fromkeys((*BODIES, *(item.body for item in single))):
        own = [item for item in single if item.body == body]
        observed += own
        if len(own) > 1:
            observed.append(Observability(body, TOGETHER, np.concatenate([item.rows for item in own])))
    return observed


def _alone(rig: Rig, takes: Sequence[Manifest], observed: Sequence[Observability], already: AlreadyRead) -> list[str]:
    """What each camera alone tells of its body, and what is left open beside the other instruments there."""
    told = []
    for images in {images.stereo: images for take in takes for images in take.images}.values():
        name, pair, first = (
            images.stereo,
            rig.stereo[images.stereo],
            already.images.get((images.left, images.bit_depth)),
        )
        if pair.surface is None or first is None or _no_rig(pair, (first,)):
            continue
        seen = _seen_alone(name, pair, first)
        if seen is None:
            continue
        own, whole = 1e6 * np.sqrt(np.diagonal(seen[0])), seen[1]
        told.append(
            f"stereo {name} is one camera; of a frame it tells, by noise alone (standard uncertainty, its own axes, "
            f"middle of the face), {own[:2].max():.2g} µm across its axis and {own[2]:.2g} µm along it, "
            f"{own[5]:.2g} µrad about it and {own[3:5].max():.2g} µrad of tilts"
        )
        text = f"{pair.body}, at the sensor origin: {_sizes(whole, whole)} by stereo {name} alone"
        instruments = {item.instrument: item.rows for item in observed if item.body == pair.body}
        others = {key: rows for key, rows in instruments.items() if key not in (TOGETHER, f"stereo {name}")}
        if others:
            rows = np.concatenate(list(others.values()))
            gain = whole @ rows.T @ np.linalg.pinv(rows @ whole @ rows.T, hermitian=True)
            text += (
                f"; {_sizes(np.asarray(whole - gain @ rows @ whole), whole)} beside {', '.join(others)}, taken as exact"
            )
        told.append(text)
    return told


def _seen_alone(name: str, pair: Stereo, images: ImageSequence) -> tuple[FloatArray, FloatArray] | None:
    """Covariance (6, 6) of one frame's motion by the noise of the first image; None where that is of no use.

    (Σ JᵀJ/σ²)⁻¹ over the subsets, J the rates of their pixels: about the middle of the face in the camera's axes, and
    about the sensor origin in those of the sensor.
    """
    from fusion.phasors.stereo_motion import read_rig, sensor_from_camera
    from fusion.planning.look.pictures import look_at_camera
    from photogram.camera import FaceCamera, locate
    from photogram.direct.surface import PlacedCamera, see_points
    from photogram.geometry import RigidTransform

    face, (_, look) = read_rig(pair, (images,)), look_at_camera(name, images)
    if look is None or len(look.points_px) < FEWEST_SUBSETS or not isinstance(face, FaceCamera):
        return None
    points = locate(face, [look.points_px[None]]).position_m[0]

    def covariance(camera_from_body: RigidTransform) -> FloatArray:
        seen = see_points(PlacedCamera(face.camera, camera_from_body), camera_from_body.inverse().apply(points))
        rates = seen.rates.reshape(-1, 6)
        return np.asarray(np.linalg.inv(rates.T @ rates / look.sigma_px**2), dtype=np.float64)

    middle = RigidTransform(np.eye(3), points.mean(axis=0))
    return covariance(middle), covariance(sensor_from_camera(pair).inverse())


def _sizes(covariance: FloatArray, before: FloatArray) -> str:
    """Standard uncertainties of the six components, without those that are exact beside what they were `before`."""
    u = 1e6 * np.sqrt(np.maximum(np.diagonal(covariance), 0.0))
    open_ = u > EXACT * 1e6 * np.sqrt(np.diagonal(before))
    units = ("µm",) * 3 + ("µrad",) * 3
    sizes = [f"{MOTION_COMPONENTS[i]} {u[i]:.2g} {units[i]}" for i in np.flatnonzero(open_)]
    return ", ".join(sizes) or "nothing left open"


def _motion_remarks(
    rig: Rig, direction: Sequence[float], entries: Sequence[ChannelEntry], observed: Sequence[Observability]
) -> list[str]:
    """What the results from the motion of the bodies will lack, and why."""
    told = []
    rows = {body: np.vstack([np.zeros((0, 6)), *(o.rows for o in observed if o.body == body)]) for body in BODIES}
    for body in BODIES:
        unseen = [name for name, seen in zip(MOTION_COMPONENTS, observable(rows[body]), strict=True) if not seen]
        if 0 < len(unseen) < 6:
            told.append(f"{body}: no instrument observes {' '.join(unseen)}")
    told += [f"{body} has no instrument" for body in BODIES if len(rows[body]) == 0]
    seen_of_load = observable(rows["load"])
    hidden = [i for i, share in enumerate(direction) if share and not seen_of_load[i] and len(rows["load"])]
    told += [f"load: no instrument observes the driven component {LOAD_COMPONENTS[i]}" for i in hidden]
    if rig.load is None:
        told.append("rig.toml has no [load]: no load and no sensitivity")
    if rig.sensor is None:
        told.append("rig.toml has no [sensor]: no sensitivity")
    elif not any(entry.quantity == "output" for entry in entries):
        told.append("no channel is an output of the sensor: no sensitivity")
    if rig.surroundings.free_fall_mps2[0] is None:
        size = "" if rig.surroundings.latitude is None else ", only where its size follows from (down is missing)"
        told.append(f"rig.toml states no gravity{size}: tilt is not corrected")
    return told


def _unstated(manifest: Manifest, entries: Sequence[ChannelEntry], pairs: Collection[str]) -> list[str]:
    """Name the motion channels whose scale counts as exact, and what `run` does with instruments that state no errors.

    `pairs`: bodies that stereo pairs see, whose calibrations state theirs.
    """
    lines, read = np.array(manifest.excitation.frequencies or (REFERENCE_HZ,)), dict[Any, ChainResponse | None]()
    readable = list[tuple[ChannelEntry, ChainResponse | None]]()
    for entry in (entry for entry in entries if entry.quantity in TRANSDUCERS):
        file = entry.response, entry.response_result, entry.response_columns
        with suppress(InputError):  # a problem of its own
            if entry.response is not None and file not in read:
                read[file] = read_response(entry.response, lines, entry.response_result, entry.response_columns)
            readable.append((entry, read.get(file)))
    beams = Beams.of([entry for entry, _ in readable])
    instruments = [(str(entry.body), entry.quantity, chain_name(entry)) for entry, _ in readable]
    stated = {
        name for name, (entry, response) in zip(instruments, readable, strict=True)
        if errors_are_stated(entry, response, beams)
    }  # fmt: skip
    remarks = []
    for name, (entry, response) in zip(instruments, readable, strict=True):
        alone = name[0] not in pairs and not any(body == name[0] for body, _, _ in stated)
        effect = "taken as exact" if name in stated or alone else "compared with the others, not fused"
        if not scale_is_stated(entry, response):
            remarks.append(f"channel {entry.name} states no uncertainty of its scale: {effect}")
    return remarks


def _clock_remarks(blocks: Sequence[Daq]) -> list[str]:
    """Which DAQ blocks of one take share no trigger with the others."""
    triggers = {daq.name: {entry.name for entry in daq.channel if entry.quantity == "trigger"} for daq in blocks}
    told = []
    for name, own in triggers.items():
        others = set[str]().union(*(theirs for other, theirs in triggers.items() if other != name))
        if len(triggers) > 1 and not own & others:
            told.append(f"daq {name} shares no trigger channel with another block: its clock cannot be tied")
    return told
