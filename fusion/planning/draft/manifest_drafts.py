"""Drafts of rig.toml and recording.toml for the files of a folder."""

from __future__ import annotations

import json
import os
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from datetime import date
from pathlib import Path

from fusion.planning.draft.camera_pairs import FoundCameras
from fusion.planning.draft.channel_guess import (
    HEAD,
    ChannelGuess,
    RecorderFile,
    assign_instruments,
    body_line,
    guess_recorders,
    key_line,
    optional_line,
    question_line,
    sort_body_views,
    with_quantities,
)
from fusion.planning.draft.excitation_guess import DrivenLines, driven_lines, excitation_lines, guess_bodies
from fusion.planning.draft.inventory import (
    FoundPoints,
    Inventory,
    find_calibrations,
    find_foreign_calibration,
    states_scale,
)
from fusion.recording.instruments import LIBRARY_NAME, find_library
from fusion.recording.manifest import SCAN
from fusion.recording.rig import OTHER_UNITS
from fusion.recording.toml import UNFILLED, quote_key
from fusion.recording.transducer import TRANSDUCERS
from photogram.calibration.calibration_file import is_single

# The rig.


SENSOR_KEYS = (
    ("serial", "", ""),
    ("capacity", [500.0, 500.0, 1000.0, 25.0, 25.0, 25.0], "rated loads, N and N m"),
    ("static_sensitivity", [[0.0] * 6], "a row per channel, unit per N and N m: corrects for cross-talk"),
    ("cross_talk", 0.01, "rated, relative, without a static matrix"),
    ("internal_mass_uncertainty", 5e-4, "kg"),
    ("internal_centre_of_mass", [0.0, 0.0, 0.0], "m"),
    ("internal_centre_of_mass_uncertainty", 1e-3, "m"),
    ("internal_inertia", [[0.0] * 3] * 3, "kg m^2, about its centre of mass"),
    ("internal_inertia_uncertainty", 1e-6, "kg m^2"),
)
RECORDING_KEYS = (
    ("simulated", True, "a program computed the data, they were not measured"),
    ("date", date(2026, 1, 31), "of the recording"),
    ("operator", "", "who recorded it"),
    ("mounting", "1", "recordings with another text have another mounting"),
)
LOAD_KEYS = (("centre_of_mass_uncertainty", 1e-4, "m"), ("inertia_uncertainty", 1e-5, "kg m^2"))
PART_KEYS = (
    ("name", "adapter plate", ""),
    ("body", "load", '"load" or "base"'),
    ("mass", 0.1, "kg"),
    ("mass_uncertainty", 1e-4, "kg"),
    ("centre_of_mass", [0.0, 0.0, 0.0], "m"),
    ("centre_of_mass_uncertainty", 1e-4, "m"),
    ("inertia", [[0.0] * 3] * 3, "kg m^2"),
    ("inertia_uncertainty", 1e-6, "kg m^2"),
)
AROUND_KEYS = (
    ("gravity", [0.0, 0.0, -9.81], "m/s^2 in sensor axes, downward: corrects tilt"),
    ("temperature", 23.0, "°C"),
    ("air_density", 1.19, "kg/m^3"),
)
HEAD_KEYS = (
    ("mirror", [0.0, 0.0, 0.6], "m, origin of the beams; or standoff, its distance"),
    ("rotation_uncertainty", 2e-3, "rad"),
    ("point_uncertainty", 5e-4, "m"),
)
POSE_KEYS = (("pose_uncertainty", [1e-4] * 3 + [5e-4] * 3, "m and rad"), ("delay", 0.0, "s, from trigger to exposure"))


def rig_text(root: Path, inventories: Sequence[Inventory], found: Sequence[RecorderFile]) -> str:
    """Return the draft of rig.toml. `found`: the recorders of the first recording."""
    outputs = [item for recorder in found for item in recorder.channels if item.quantity == "output"]
    lines = [HEAD, "format = 1", key_line("name", root.resolve().name)]
    if outputs:
        lines += _sensor(outputs)
        lines += ["\n[load]  # everything mounted above the sensor, without the sensor's moving part"]
        lines += [
            question_line("mass", "the true mass in kg"),
            question_line("mass_uncertainty", "its standard uncertainty (k = 1) in kg"),
        ]
        lines += [question_line("centre_of_mass", "the centre of mass in the sensor frame, in m")]
        lines += [question_line("inertia", "the 3 x 3 tensor about the centre of mass in kg m^2")]
        lines += [optional_line(*entry) for entry in LOAD_KEYS]
        lines += [
            "\n# [[part]]  # adapters, screws, accelerometers: any number",
            *(optional_line(*e) for e in PART_KEYS),
        ]
    lines += ["\n# [environment]", *(optional_line(*entry) for entry in AROUND_KEYS)]
    files = find_calibrations([root, root / "calibration", *(inventory.folder for inventory in inventories)])
    if sum(item.quantity in TRANSDUCERS for recorder in found for item in recorder.channels) > 1:
        lines += ["\n# [head.laser]  # common errors of the beams of a laser, or the axes of an accelerometer"]
        lines += [optional_line(*entry) for entry in HEAD_KEYS]
    width_s = next((pulses.width_s for recorder in found for _, pulses in recorder.triggers), 0.0)
    every: list[FoundCameras | FoundPoints] = []
    for inventory in inventories:
        every += [*inventory.points, *inventory.camera_systems]
    for item in sort_body_views({item.name: item for item in every}.values()):
        lines += _sight(item, root, files, width_s)
    return "\n".join(lines) + "\n"


def _sensor(outputs: Sequence[ChannelGuess]) -> Iterator[str]:
    """Yield the block of the sensor."""
    named = [output.component for output in outputs]
    units = {o.found.unit.strip().lower() for o in outputs}
    yield "\n[sensor]"
    yield key_line("name", "sensor under test", "its name in a certificate")
    if all(named):
        yield key_line("channels", named, "its outputs in the files")
    else:
        yield question_line(
            "channels",
            f"the names of its outputs in the order of the channels, such as Fx Fy Fz; {len(outputs)} were found",
        )
    if units <= {"mv/v", "v/v"}:
        yield key_line("unit", "V/V", "of the outputs after their scale")
    elif len(units) == 1 and units <= {"v", "n"}:
        yield key_line("unit", units.pop().upper(), "of the outputs after their scale")
    else:
        yield question_line("unit", "the unit of the outputs after their scale")
    yield question_line(
        "sense", '"on_load" or "on_sensor": on which the wrench acts for which its outputs are positive'
    )
    yield question_line(
        "internal_mass", "the mass of the sensor that moves with the load, above its elastic element, in kg"
    )
    yield from (optional_line(*entry) for entry in SENSOR_KEYS)


def _sight(
    item: FoundCameras | FoundPoints, root: Path, files: dict[Path, tuple[int, int]], width_s: float
) -> Iterator[str]:
    """Yield the block of a stereo pair, a single camera with its surface, or points."""
    yield f"\n[stereo.{quote_key(item.name)}]"
    yield body_line(item.name)
    scaled, is_camera = False, isinstance(item, FoundCameras)
    alone = isinstance(item, FoundCameras) and item.right is None
    if isinstance(item, FoundCameras):
        sized = [path for path, size in files.items() if size == item.left.size_px]
        same_kind = [path for path in sized if is_single(path) == alone]
        named = [path for path in (sized if alone else same_kind) if item.name.lower() in path.stem.lower()]
        matching = named or (same_kind if len(same_kind) == 1 else [])
        if matching:
            why = f"guessed: its name, and images of {item.left.size_px[0]} x {item.left.size_px[1]} px"
            yield key_line("calibration", Path(os.path.relpath(matching[0], root)).as_posix(), why)
            scaled = states_scale(matching[0])
        elif alone:
            yield question_line(
                "calibration", "a file of shakercal cameras --mono, or of a pair whose left camera it is"
            )
        else:
            foreign = find_foreign_calibration(root)
            how = f" (shakercal import-calibration {foreign} -o {root / 'stereo.json'})" if foreign else ""
            yield question_line("calibration", f"a file of shakercal cameras or import-calibration{how}")
    frame = ("camera" if alone else "left camera") if is_camera else "points"
    yield question_line(
        "rotation", f"3 x 3, of x_sensor = rotation x_{frame.replace(' ', '_')} + translation (shakercal align)"
    )
    yield question_line("translation", f"in m, where the frame of the {frame} begins in the sensor frame")
    yield from (optional_line(*entry) for entry in POSE_KEYS)
    why = "relative standard uncertainty (k = 1) of all lengths"
    yield (
        optional_line("scale_uncertainty", 1e-4, f"{why}, in addition to the calibration's")
        if scaled or alone
        else question_line("scale_uncertainty", why)
    )
    if isinstance(item, FoundCameras):
        brightest = max(camera.brightest for camera in item.cameras)
        bits = max(camera.bits for camera in item.cameras)
        yield key_line("bit_depth", bits, f"guessed: the brightest grey value seen is {brightest}")
    if isinstance(item, FoundCameras) and item.left.exposure_s is not None:
        yield key_line("exposure", "file", f"the files state {1e6 * item.left.exposure_s:.4g} us")
    else:
        width = f" ({1e6 * width_s:.4g} us)" if width_s else ""
        yield question_line(
            "exposure", f'its length in s, or "pulse" where it lasts as long as the trigger is active{width}'
        )
    yield optional_line("delay_uncertainty", 1e-6, "s")
    if alone:
        yield f"\n[stereo.{quote_key(item.name)}.surface]  # the plane face in view of the single camera, at rest"
        yield question_line("point", "a point of it in the sensor frame, in m, by the drawing")
        yield question_line("normal", "across it, such as [0, 0, 1]")
        yield question_line(
            "distance_uncertainty", "its standard uncertainty (k = 1) along the normal in m: drawing, paint"
        )
        yield question_line("tilt_uncertainty", "standard uncertainty (k = 1) of its tilts in rad")
    elif is_camera:
        yield optional_line("row_time", 1e-5, "s from row to row of a rolling shutter, negative from the last row on")


U_SCALE = "relative standard uncertainty (k = 1) of the scale"
FARTHEST_M = 5.0  # of a point of a body: larger coordinates are in mm
COORDINATES = {"x", "y", "z", "x0", "y0", "z0", "frame", "status"}


@dataclass(frozen=True)
class SurveyedRecording:
    """Contents of a folder, guessed channels, and the driven lines."""

    inventory: Inventory
    recorders: tuple[RecorderFile, ...]
    lines: DrivenLines

    @staticmethod
    def of(inventory: Inventory, quantities: Mapping[str, str] | None = None) -> SurveyedRecording:
        """Return the channels and lines of a folder.

        `quantities`: stated ones, by the paths of their keys in recording.toml.
        """
        library = find_library(inventory.folder / "rig.toml")
        guessed = with_quantities(guess_recorders(inventory.daqs), quantities or {})
        found = tuple(assign_instruments(guessed, library))
        lines = driven_lines(found)
        return SurveyedRecording(inventory, tuple(guess_bodies(found, lines)), lines)


def recording_text(surveyed: SurveyedRecording, rig: str, pair_names: Sequence[str] = ()) -> str:
    """Return the draft of recording.toml.

    `rig`: the relative path of its rig.toml; `pair_names`: stereo pairs of an existing rig.toml.
    """
    inventory, found = surveyed.inventory, surveyed.recorders
    folder = inventory.folder.resolve()
    lines = [HEAD]
    if inventory.unreadable:
        lines += ["# Cannot be read:", *(f"# {' '.join(text.split())}" for text in inventory.unreadable), ""]
    lines += ["format = 1", key_line("name", folder.name), key_line("rig", rig)]
    lines += [optional_line(*entry) for entry in RECORDING_KEYS]
    lines += excitation_lines(folder.name, found, surveyed.lines)
    for recorder in found:
        lines += _daq_block(recorder, inventory.path_of(recorder.daq), inventory.responses)
    lines += _frames(inventory, found, pair_names)
    left = [f"{camera.pattern}: {camera.problem}" for camera in inventory.cameras]
    if left:
        lines += ["\n# Left out:", *(f"# {' '.join(text.split())}" for text in left)]
    return "\n".join(lines) + "\n"


# The blocks of a recording.


def _daq_block(recorder: RecorderFile, file: str, responses: Sequence[Path]) -> Iterator[str]:
    """Yield the block of a recorder's file."""
    path = recorder.daq.path
    yield "\n[[daq]]"
    yield key_line("name", path.stem)
    yield key_line("file", file)
    if recorder.daq.rate_missing:
        yield question_line("sample_rate", "sampling rate in Hz, which the file does not state")
    yield optional_line("clock_uncertainty", 1e-6, "relative, of its sample rate")
    for name, trigger in recorder.copies:
        yield f"# {json.dumps(name, ensure_ascii=False)} has the same pulses as {trigger}"
    own_responses = [table for table in responses if table.stem.lower().startswith(path.stem.lower())]
    seen: set[str] = set()
    measuring = [item for item in recorder.channels if item.quantity != "trigger"]
    shared = _shared_keys(measuring)
    response = key_line("response", own_responses[0].name, "guessed: named after this file") if own_responses else ""
    outputs_only = {item.quantity for item in measuring} == {"output"}
    if len(measuring) > 1 and (shared or response or outputs_only):
        yield "\n[daq.defaults]  # of all channels of this file that do not state them"
        yield from [question_line(key, why) for key, why in shared.items()]
        yield from [response] if response else []
        if len({item.quantity for item in measuring}) == 1 and measuring[0].quantity != UNFILLED:
            yield from _options(measuring[0], responding=bool(response))
            seen.add("motion" if measuring[0].quantity in TRANSDUCERS else measuring[0].quantity)
        response = ""
    for item in recorder.channels:
        yield "\n[[daq.channel]]"
        yield from _channel_block(item, shared, scan=path.suffix.lower() == SCAN)
        if response and item.quantity != "trigger":
            yield response
        kind = "motion" if item.quantity in TRANSDUCERS else item.quantity
        if kind not in seen:  # only once per kind
            seen.add(kind)
            yield from _options(item, responding=bool(own_responses))
        elif kind == "output" and not outputs_only:
            yield optional_line("scale_uncertainty", 1e-4, U_SCALE)


def _shared_keys(items: Sequence[ChannelGuess]) -> dict[str, str]:
    """Return the keys to fill in once for all channels of one quantity and unit."""
    kinds = {(item.quantity, item.found.unit, item.scale, item.instrument) for item in items}
    if len(items) < 2 or len(kinds) > 1 or items[0].quantity == UNFILLED:
        return {}
    asked = dict(_scale_questions(items[0]))
    return {key: f"{why}; a channel with another one states it" for key, why in asked.items()}


def _scale_questions(item: ChannelGuess) -> Iterator[tuple[str, str]]:
    """Yield the keys of a channel's scale to fill in, with the expected values."""
    if item.scale is None and "scale" not in item.provided and item.quantity != UNFILLED:
        unit = "the sensor's unit" if item.quantity == "output" else _unit(item.quantity)
        yield "scale", f"its calibration factor, {unit} per {item.found.unit or 'unit of the file'}"
    if item.quantity in TRANSDUCERS and not {"scale", "scale_uncertainty", "response"} & set(item.provided):
        yield "scale_uncertainty", "relative standard uncertainty (k = 1) of this factor"


def _channel_block(item: ChannelGuess, shared: Mapping[str, str], *, scan: bool) -> Iterator[str]:
    """Yield the required keys of a channel; `shared`: those that its block has."""
    found = item.found
    rate = f" at {found.rate_hz:g} Hz" if found.rate_hz else ""
    size = f"{found.samples} samples{rate}, {found.low:.4g} to {found.high:.4g} {found.unit}"
    yield key_line("name", item.name, size.strip())
    if item.name not in (found.name, found.short):
        yield key_line("in_file", found.short or found.name)
    if item.instrument:
        yield key_line("instrument", item.instrument, f"guessed: its name, of {LIBRARY_NAME}")
    yield key_line("quantity", item.quantity, item.why)
    if item.quantity == "trigger":
        return
    if item.quantity == "output":
        if not item.component:
            yield question_line("channel", "which of the sensor's outputs, as [sensor] channels of rig.toml names them")
        else:
            why = "its name" if item.component in found.title else "its name or the order of the channels"
            yield key_line("channel", item.component, f"guessed: {why}")
    motion = item.quantity in TRANSDUCERS
    if motion:
        yield body_line(found.title, item.base_why)
        if not TRANSDUCERS[item.quantity].rotational:
            yield question_line("point", "where it measures in the sensor frame, in m, such as [0.03, 0, 0.04]")
        if not scan:
            yield question_line("direction", "its positive sense in sensor axes, such as [0, 0, 1]")
    if item.scale is not None and "scale" not in item.provided:
        yield key_line("scale", item.scale, item.scale_why)
    yield from [question_line(key, why) for key, why in _scale_questions(item) if key not in shared]


def _unit(quantity: str) -> str:
    return OTHER_UNITS.get(quantity) or TRANSDUCERS[quantity].unit


def _options(item: ChannelGuess, *, responding: bool) -> Iterator[str]:
    """Yield the optional keys of a channel; `responding`: its response is stated."""
    if item.quantity == "trigger":
        middle = float(f"{(item.found.low + item.found.high) / 2:.3g}")
        yield optional_line("threshold", middle, f"{item.found.unit} of the file, midway between the levels")
        yield optional_line("edge", "rising", 'or "falling": where exposures begin')
        return
    if item.quantity in TRANSDUCERS:
        yield optional_line("point_uncertainty", 1e-3, "m")
        yield optional_line("direction_uncertainty", 5e-3, "rad")
        yield optional_line("transverse_sensitivity", 0.01, "relative")
        yield optional_line("head", "laser", "a head of rig.toml whose errors it shares")
    else:
        yield optional_line("scale_uncertainty", 1e-4, U_SCALE)
    yield optional_line("common", "instrument", "channels with the same name are one instrument and share its errors")
    yield optional_line("individual_uncertainty", 1e-4, "relative, not shared")
    yield optional_line("delay_uncertainty", 1e-6, "s")
    if not responding:
        yield optional_line("response", "response.csv", "frequency response of its amplifier")


def _frames(inventory: Inventory, found: Sequence[RecorderFile], pair_names: Sequence[str]) -> Iterator[str]:
    """Yield the blocks of images and points."""
    edges = {name: pulses.edges for recorder in reversed(found) for name, pulses in recorder.triggers}
    for item in sort_body_views([*inventory.camera_systems, *inventory.points]):
        yield "\n[[images]]" if isinstance(item, FoundCameras) else "\n[[points]]"
        if not pair_names or item.name in pair_names:
            yield key_line("stereo", item.name)
        else:
            yield question_line("stereo", f"which one of rig.toml: {', '.join(pair_names)}")
        if isinstance(item, FoundCameras):
            for key, camera in zip(("left", "right"), item.cameras, strict=False):
                shown = "; ".join(filter(None, (camera.summary, item.why))) if key == "left" else ""
                yield key_line(key, camera.pattern, camera.problem or shown)
            yield from _tied(item.left.frames, edges)
            continue
        yield key_line("files", item.path.name)
        yield key_line("columns", [c if c in COORDINATES or c.startswith("id") else "_" for c in item.columns])
        if item.reach > FARTHEST_M:
            yield key_line("scale", 1e-3, f"guessed: positions up to {item.reach:.4g} are in mm")
        else:
            yield question_line("scale", f"metres per unit of the file, with positions up to {item.reach:.4g}")
        yield from _tied(0, edges)


def _tied(frames: int, edges: dict[str, int]) -> Iterator[str]:
    """Yield the trigger of frames by the number of its edges.

    `frames` is 0 if unknown.
    """
    able = {name: count for name, count in edges.items() if count >= frames}
    if not able:
        reason = f"none has {frames} edges" if edges else "none was found"
        yield question_line("trigger", f"the name of the trigger channel; {reason}")
        return
    name = min(able, key=lambda name: able[name])
    yield key_line("trigger", name, f"it has {able[name]} edges")
    if frames and able[name] > frames:
        yield question_line(
            "first_edge", f"the number, from 0, of the edge that belongs to the first of {frames} frames"
        )
