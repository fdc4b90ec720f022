"""Draft of recording.toml for the files of a folder."""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from fusion.planning.draft.channel_guess import (
    HEAD,
    TRIGGER_WORDS,
    ChannelGuess,
    RecorderFile,
    body_line,
    guess_recorders,
    has_word,
    key_line,
    optional_line,
    question_line,
    sort_body_views,
)
from fusion.planning.draft.inventory import FoundCameras, FoundChannel, Inventory
from fusion.recording.manifest import SCAN
from fusion.recording.rig import OTHER_UNITS
from fusion.recording.toml import UNFILLED
from fusion.recording.transducer import TRANSDUCERS
from shaker.labels import LOAD_COMPONENTS
from shaker.lines.detection import survey_lines
from shakercal._common.arrays import FloatArray

LOOKED_AT = 1 << 17  # samples in which the excitation is searched for
FEWEST = 64  # least number of samples for a search of lines
FAINT = 1e-3  # least amplitude of a line over the largest channel of its unit: less is hum or cross-talk
STRONG, MOST_DRIVEN = 0.1, 30  # least amplitude over the strongest line; largest number of lines of a multisine
FARTHEST_M = 5.0  # of a point of a body: larger coordinates are in mm
COORDINATES = {"x", "y", "z", "x0", "y0", "z0", "frame", "status"}


@dataclass(frozen=True)
class SurveyedRecording:
    """Contents of a folder, guessed channels, and the driven lines in Hz with their file."""

    inventory: Inventory
    recorders: tuple[RecorderFile, ...]
    lines_hz: tuple[float, ...]
    where: str

    @staticmethod
    def of(inventory: Inventory) -> SurveyedRecording:
        """Return the channels and lines of a folder."""
        found = tuple(guess_recorders(inventory.daqs))
        lines_hz, where = driven_lines(found)
        return SurveyedRecording(inventory, found, tuple(lines_hz), where)


def recording_text(surveyed: SurveyedRecording, rig: str, pair_names: Sequence[str] = ()) -> str:
    """Return the draft of recording.toml.

    `rig`: the relative path of its rig.toml; `pair_names`: stereo pairs of an existing rig.toml.
    """
    inventory, found = surveyed.inventory, surveyed.recorders
    folder = inventory.folder.resolve()
    lines = [HEAD, "format = 1", key_line("name", folder.name), key_line("rig", rig)]
    lines += ["# date = 2026-01-31  # of the recording", optional_line("operator", "", "who recorded it")]
    lines += [optional_line("mounting", "1", "recordings with another text have another mounting")]
    lines += _excitation(folder.name, list(surveyed.lines_hz), surveyed.where)
    for recorder in found:
        lines += _daq_block(recorder, inventory.responses)
    lines += _frames(inventory, found, pair_names)
    left = [f"{daq.path.name}: {daq.problem or 'no channel over time'}" for daq in inventory.daqs if not daq.channels]
    left += [f"{camera.pattern}: {camera.problem}" for camera in inventory.cameras]
    if left:
        lines += ["\n# Left out:", *(f"# {' '.join(text.split())}" for text in left)]
    return "\n".join(lines) + "\n"


# Excitation.


def driven_lines(found: Sequence[RecorderFile]) -> tuple[list[float], str]:
    """Return the driven lines in Hz, and their source.

    They are from the first file with a line.
    """
    for recorder in found:
        usable = [
            i for i in recorder.channels if i.quantity != "trigger" and not has_word(TRIGGER_WORDS, i.found.title)
        ]
        usable = [i for i in usable if i.quantity != UNFILLED] or usable  # channels with a known quantity
        chosen = [i.found for i in usable if i.found.samples >= FEWEST]
        chosen = [c for c in chosen if (c.rate_hz, c.samples) == (chosen[0].rate_hz, chosen[0].samples)]
        chosen = [c for c in chosen if np.isfinite(recorder.daq.raw[c.name].samples[:LOOKED_AT]).all()]
        values = [recorder.daq.raw[channel.name].samples[:LOOKED_AT] for channel in chosen]
        values = [samples - samples.mean() for samples in values]
        if not values:
            continue
        survey = survey_lines(np.stack(values, axis=1), chosen[0].rate_hz)
        amplitude = np.nan_to_num(survey.amplitude)
        amplitude = np.where(amplitude >= FAINT * np.array(_largest_of_unit(chosen, values)), amplitude, 0.0)
        # The strength of a line is its largest amplitude, each channel relative to its strongest line.
        strength = (amplitude / np.maximum(amplitude.max(axis=0, initial=0.0), 1e-300)).max(axis=1, initial=0.0)
        lines = [
            _nominal(frequency, u)
            for frequency, u, origin, share in zip(
                survey.frequency_hz.tolist(), survey.u_frequency_hz.tolist(), survey.origin, strength, strict=True
            )
            if origin.kind == "fundamental" and share >= STRONG
        ]
        if lines:
            return lines, f"in {recorder.daq.path.name}"
    return [], ""


def _largest_of_unit(chosen: Sequence[FoundChannel], values: Sequence[FloatArray]) -> list[float]:
    """Return for each channel the largest standard deviation among channels of its unit."""
    sizes = [float(samples.std()) for samples in values]
    return [max(s for s, c in zip(sizes, chosen, strict=True) if c.unit == one.unit) for one in chosen]


def _nominal(frequency_hz: float, u_hz: float) -> float:
    """Return the frequency with fewest digits within the uncertainty of the record."""
    within = max(3 * u_hz, 1e-4 * frequency_hz)
    rounded = (round(frequency_hz, digits) for digits in range(6))
    return next((value for value in rounded if abs(value - frequency_hz) <= within), frequency_hz)


def driven_axis(name: str) -> list[float] | None:
    """Return the direction in a folder's name, such as Fz-0080.

    It has 3 numbers, or 6 of a moment.
    """
    axis = re.search(r"(?<![A-Za-z])([FM][xyz])(?![A-Za-z])", name)
    six = [float(axis is not None and axis[1] == component) for component in LOAD_COMPONENTS]
    return None if axis is None else six[:3] if axis[1][0] == "F" else six


def _excitation(name: str, lines: list[float], where: str) -> Iterator[str]:
    """Yield the block of the excitation."""
    few = 0 < len(lines) <= MOST_DRIVEN
    yield "\n[excitation]"
    if few:
        reason = "one line and its harmonics" if len(lines) == 1 else f"{len(lines)} lines above the noise"
        yield key_line("kind", "sine" if len(lines) == 1 else "multisine", f"guessed: {reason} {where}")
    else:
        reason = f"{len(lines)} lines above the noise {where}" if lines else "no line above the noise"
        yield question_line("kind", f"one of sine, multisine, chirp, noise, impact, step, rotation; {reason}")
    axis = driven_axis(name)
    if axis is None:
        yield question_line("direction", "the driven axis, 3 numbers such as [0, 0, 1], or 6 where a moment is driven")
    else:
        yield key_line("direction", axis, "guessed: the name of the folder")
    if few:
        yield key_line("frequencies", lines, "Hz, nominal")
        yield optional_line("harmonics", "auto", '"auto", those above the noise, or a list of multiples')


# The blocks of a recording.


def _daq_block(recorder: RecorderFile, responses: Sequence[Path]) -> Iterator[str]:
    """Yield the block of a recorder's file."""
    path = recorder.daq.path
    yield "\n[[daq]]"
    yield key_line("name", path.stem)
    yield key_line("file", path.name)
    yield optional_line("clock_uncertainty", 1e-6, "relative, of its sample rate")
    own_responses = [table for table in responses if table.stem.lower().startswith(path.stem.lower())]
    seen: set[str] = set()
    for item in recorder.channels:
        yield "\n[[daq.channel]]"
        yield from _channel_block(item, scan=path.suffix.lower() == SCAN)
        if own_responses and item.quantity != "trigger":
            yield key_line("response", own_responses[0].name, "guessed: named after this file")
        kind = "motion" if item.quantity in TRANSDUCERS else item.quantity
        if kind not in seen:  # only once per kind
            seen.add(kind)
            yield from _options(item, responding=bool(own_responses))


def _channel_block(item: ChannelGuess, *, scan: bool) -> Iterator[str]:
    """Yield the required keys of a channel."""
    found = item.found
    size = f"{found.samples} samples at {found.rate_hz:g} Hz, {found.low:.4g} to {found.high:.4g} {found.unit}"
    yield key_line("name", item.name, size.strip())
    if item.name != found.name:
        yield key_line("in_file", found.name)
    yield key_line("quantity", item.quantity, item.why)
    if item.quantity == "trigger":
        return
    if item.quantity == "output":
        component = next((name for name in LOAD_COMPONENTS if has_word(name.lower(), found.title)), None)
        if component is None:
            yield question_line("channel", "which of the sensor's outputs, as [sensor] channels of rig.toml names them")
        else:
            yield key_line("channel", component, "guessed: its name")
    motion = item.quantity in TRANSDUCERS
    if motion:
        yield body_line(found.title)
        if not TRANSDUCERS[item.quantity].rotational:
            yield question_line("point", "where it measures in the sensor frame, in m, such as [0.03, 0, 0.04]")
        if not scan:
            yield question_line("direction", "its positive sense in sensor axes, such as [0, 0, 1]")
    if item.scale is not None:
        yield key_line("scale", item.scale, item.scale_why)
    elif item.quantity != UNFILLED:
        unit = "the sensor's unit" if item.quantity == "output" else _unit(item.quantity)
        yield question_line("scale", f"its calibration factor, {unit} per {found.unit or 'unit of the file'}")
    if motion:
        yield question_line("scale_uncertainty", "relative standard uncertainty (k = 1) of this factor")


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
        yield optional_line("scale_uncertainty", 1e-4, "relative standard uncertainty (k = 1) of the scale")
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
                yield key_line(key, camera.pattern, camera.problem or (camera.summary if key == "left" else ""))
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
