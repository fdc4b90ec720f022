"""Excitation of a recording guessed from its spectra: lines, direction, base and load."""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from itertools import pairwise

import numpy as np

from fusion.planning.draft.channel_guess import (
    BASE_WORDS,
    LOAD_WORDS,
    TRIGGER_WORDS,
    RecorderFile,
    has_word,
    key_line,
    optional_line,
    question_line,
)
from fusion.planning.draft.inventory import FoundChannel
from fusion.recording.toml import UNFILLED
from fusion.recording.transducer import TRANSDUCERS
from shaker.labels import LOAD_COMPONENTS
from shaker.lines.detection import survey_lines
from shakercal._common.arrays import FloatArray

LOOKED_AT = 1 << 17  # samples in which the excitation is searched for
FEWEST = 64  # least number of samples for a search of lines
FAINT = 1e-3  # least amplitude of a line over the largest channel of its unit: less is hum or cross-talk
STRONG, MOST_DRIVEN = 0.1, 30  # least amplitude over the strongest line; largest number of lines of a multisine
DOMINANT = 3.0  # least ratio of the largest line of the forces to the next one
CLEAR_STEP = 3.0  # least ratio of the step between base and load to other steps
LESS, MUCH_LESS = 1.02, 20.0  # ratio of two lines of which the smaller one may be that of the base


@dataclass(frozen=True)
class DrivenLines:
    """Driven lines in Hz, their source, and the strongest one in each channel.

    `amplitude`: of the strongest line, in the file's unit, by the names of the file `file` and of the channel in it.
    """

    lines_hz: tuple[float, ...] = ()
    where: str = ""
    amplitude: dict[tuple[str, str], float] = field(default_factory=dict)


def driven_lines(found: Sequence[RecorderFile]) -> DrivenLines:
    """Return the driven lines of the first file with a line."""
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
        if not values or recorder.daq.rate_missing:
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
            strongest = survey.amplitude[int(np.argmax(strength))].tolist()
            names = ((recorder.daq.path.name, channel.name) for channel in chosen)
            return DrivenLines(
                tuple(lines), f"in {recorder.daq.path.name}", dict(zip(names, map(float, strongest), strict=True))
            )
    return DrivenLines()


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


def _largest_output(found: Sequence[RecorderFile], driven: DrivenLines) -> tuple[list[float] | None, str]:
    """Return the direction of the output with the largest line, and the reason."""
    items = [(recorder, item) for recorder in found for item in recorder.channels if item.quantity == "output"]
    forces = [(r, i) for r, i in items if i.component[:1] == "F"]
    sizes: dict[str, float] = {}
    for recorder, item in forces:
        size = driven.amplitude.get((recorder.daq.path.name, item.found.name), 0.0)
        sizes[item.component] = size * abs(item.scale or 1.0)
    units = {(item.found.unit, item.scale) for _, item in forces}
    if len(sizes) == len(items) == 1:
        return driven_axis(next(iter(sizes))), f"{next(iter(sizes))} is the only output"
    order = sorted(sizes, key=lambda name: -sizes[name])
    if len(order) < 2 or len(units) > 1 or sizes[order[0]] < DOMINANT * sizes[order[1]] or not sizes[order[0]]:
        return None, ""
    return driven_axis(order[0]), f"{order[0]} has the largest line of the forces"


def guess_bodies(found: Sequence[RecorderFile], driven: DrivenLines) -> Iterator[RecorderFile]:
    """Yield recorders with base and load guessed from the lines of their channels.

    Below the resonance of a sensor its load moves more than its base. The largest step between the sizes separates them
    where it is much larger than all others. Channels across the motion are small and are not compared.
    """
    for recorder in found:
        size = {
            item: driven.amplitude.get((recorder.daq.path.name, item.found.name), 0.0) * abs(item.scale or 1.0)
            for item in recorder.channels
            if item.quantity in TRANSDUCERS
        }
        largest = max(size.values(), default=0.0)
        order = sorted((i for i in size if size[i] * MUCH_LESS >= largest > 0.0), key=lambda item: size[item])
        named = any(has_word(f"{BASE_WORDS}|{LOAD_WORDS}", item.found.title) for item in size)
        if len(order) < 2 or named or len({(item.quantity, item.found.unit, item.scale) for item in size}) > 1:
            yield recorder
            continue
        steps = [float(np.log(size[high] / size[low])) for low, high in pairwise(order)]
        at = int(np.argmax(steps))
        others = max(steps[:at] + steps[at + 1 :], default=0.0)
        if steps[at] < np.log(LESS) or steps[at] < CLEAR_STEP * others:
            yield recorder
            continue
        low, high = order[at], order[at + 1]
        smaller = 100 * (1.0 - size[low] / size[high])
        why = f"guessed: its line is at least {smaller:.3g} % smaller than that of {high.name}"
        base = order[: at + 1]
        channels = (replace(item, base_why=why) if item in base else item for item in recorder.channels)
        yield replace(recorder, channels=tuple(channels))


def excitation_lines(name: str, found: Sequence[RecorderFile], driven: DrivenLines) -> Iterator[str]:
    """Yield the lines of the excitation's block."""
    lines, where = list(driven.lines_hz), driven.where
    few = 0 < len(lines) <= MOST_DRIVEN
    yield "\n[excitation]"
    if few:
        reason = "one line and its harmonics" if len(lines) == 1 else f"{len(lines)} lines above the noise"
        yield key_line("kind", "sine" if len(lines) == 1 else "multisine", f"guessed: {reason} {where}")
    else:
        reason = f"{len(lines)} lines above the noise {where}" if lines else "no line above the noise"
        yield question_line("kind", f"one of sine, multisine, chirp, noise, impact, step, rotation; {reason}")
    axis, why = driven_axis(name), "the name of the folder"
    if axis is None:
        axis, why = _largest_output(found, driven)
    if axis is None:
        yield question_line("direction", "the driven axis, 3 numbers such as [0, 0, 1], or 6 where a moment is driven")
    else:
        yield key_line("direction", axis, f"guessed: {why}")
    if few:
        yield key_line("frequencies", lines, "Hz, nominal")
        yield optional_line("harmonics", "auto", '"auto", those above the noise, or a list of multiples')
