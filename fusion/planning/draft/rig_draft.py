"""Draft of rig.toml for the recordings of a campaign."""

from __future__ import annotations

import os
from collections.abc import Iterator, Sequence
from pathlib import Path

from fusion.planning.draft.channel_guess import (
    HEAD,
    ChannelGuess,
    RecorderFile,
    body_line,
    has_word,
    key_line,
    optional_line,
    question_line,
    sort_body_views,
)
from fusion.planning.draft.inventory import FoundCameras, FoundPoints, Inventory, find_calibrations, states_scale
from fusion.recording.toml import quote_key
from fusion.recording.transducer import TRANSDUCERS
from photogram.calibration.calibration_file import is_single
from shaker.labels import LOAD_COMPONENTS

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
    """Return the draft of rig.toml.

    `found`: the recorders of the first recording.
    """
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
    named = [next((name for name in LOAD_COMPONENTS if has_word(name.lower(), o.found.title)), "") for o in outputs]
    units = {o.found.unit.strip().lower() for o in outputs}
    yield "\n[sensor]"
    yield key_line("name", "sensor under test", "its name in a certificate")
    if all(named):
        yield key_line("channels", named, "its outputs in the files")
    else:
        yield question_line(
            "channels", f'the names of its outputs, such as ["Fx", "Fy", "Fz"]; {len(outputs)} were found'
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
            yield question_line("calibration", "a file of shakercal cameras or import-calibration")
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
