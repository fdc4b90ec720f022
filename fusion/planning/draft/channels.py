"""What channels of recorders' files seem to read, by their names, units and signals; lines of a drafted manifest."""

from __future__ import annotations

import json
import re
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from fusion.base import PROGRAM, __version__, natural_key
from fusion.instruments.transducer import TRANSDUCERS
from fusion.planning.draft.inventory import FoundChannel, FoundDaq, FoundPoints, FoundSight, TriggerPulses
from fusion.recording.toml import UNFILLED

SAME_RATE = 1e-3  # relative difference of the rates of one trigger
LONG_NAME = 40  # characters
HEAD = f"""\
# Drafted by {PROGRAM} {__version__} from the files of this folder.
# "?" marks what only you know: `shakercal check` lists these values first, and `shakercal run` refuses them.
# "guessed" says why a value is what it is. Lines that begin with "# " are optional keys, with a usual value.
"""
"""How a drafted file begins."""


# Lines of a manifest: stated, asked for, optional.


def stated(key: str, value: Any, why: str = "") -> str:
    """Return the line of a key whose value is known or guessed."""
    shown = json.dumps(value, ensure_ascii=False)
    return f"{key} = {shown}" + (f"  # {why}" if why else "")


def asked(key: str, why: str) -> str:
    """Return the line of a key whose value only the laboratory knows; `why`: what is expected."""
    return stated(key, UNFILLED, why)


def optional(key: str, value: Any, why: str) -> str:
    """Return the line of a key that may be left out."""
    return f"# {stated(key, value, why)}"


# What a channel reads, by its name, its unit and its signal.


@dataclass(frozen=True)
class Guess:
    """What a channel of a file seems to read; `scale`: None where nothing says it; `name`: that of the recording."""

    found: FoundChannel
    quantity: str
    why: str
    scale: float | None = None
    scale_why: str = ""
    name: str = ""

    @property
    def order(self) -> tuple[int, tuple[object, ...]]:
        """Return where the channel stands in its block: motion first, triggers last, else as its name says."""
        kinds = [*TRANSDUCERS, "force", "output", "voltage", UNFILLED, "trigger"]
        return kinds.index(self.quantity), natural_key(self.name)


UNITS: dict[str, tuple[str, float]] = {
    **{unit: ("displacement", scale) for unit, scale in {"m": 1.0, "mm": 1e-3, "um": 1e-6, "nm": 1e-9}.items()},
    **{unit: ("velocity", scale) for unit, scale in {"m/s": 1.0, "mm/s": 1e-3, "um/s": 1e-6}.items()},
    **dict.fromkeys(("m/s^2", "m/s2", "m/s/s"), ("acceleration", 1.0)),
    **dict.fromkeys(("g", "gn", "g_n"), ("acceleration", 9.80665)),
    **dict.fromkeys(("rad/s",), ("angular_velocity", 1.0)),
    **{unit: ("angular_velocity", float(np.pi / 180)) for unit in ("deg/s", "dps", "°/s")},
    **{unit: ("force", scale) for unit, scale in {"n": 1.0, "newton": 1.0, "newtons": 1.0, "kn": 1e3}.items()},
    **dict.fromkeys(("lbf", "pounds", "pound"), ("force", 4.4482216152605)),
    **{unit: ("output", scale) for unit, scale in {"mv/v": 1e-3, "v/v": 1.0}.items()},
}
"""Quantity and SI unit over the unit, by the unit of a file in small letters."""
NAMES = (
    ("output", r"[fm][xyz]\d?"),
    ("velocity", r"vel\w*|vib\w*|ldv\w*|laser\w*|psv\w*|lsv\w*|speed\w*"),
    ("acceleration", r"acc\w*|accel\w*|beschl\w*|icp\w*"),
    ("displacement", r"disp\w*|weg\w*"),
    ("angular_velocity", r"gyro\w*|rate"),
    ("output", r"bridge\w*|output\w*"),
    ("force", r"force\w*|kraft\w*|load_?cell\w*"),
    ("voltage", r"volt\w*|drive|generator|excitation"),
)
"""Quantities by a word of a channel's name, the first that fits."""
TRIGGER_WORDS = r"\w*trig\w*|sync\w*|strobe\w*|cam\w*"
BASE_WORDS, LOAD_WORDS = r"base|table|tisch|bottom|lower|shaker|armature", r"load|mass|top|upper|masse|last"


def word_in(words: str, name: str) -> bool:
    """Whether a name has one of some words, in small letters and with | between them, between other signs."""
    return re.search(rf"(?<![a-z])({words})(?![a-z])", name.lower().replace("_", " ").replace("/", " ")) is not None


def guess(channel: FoundChannel) -> Guess:
    """Return what a channel of a file seems to read, and why."""
    unit = channel.unit.strip().replace("µ", "u").replace("μ", "u").replace("²", "^2").lower()
    if channel.pulses is not None:
        pulses = channel.pulses
        why = f"guessed: two levels, {pulses.edges} edges at {pulses.rate_hz:.6g} Hz"
        return Guess(channel, "trigger", why, 1.0)
    by_name = next((quantity for quantity, words in NAMES if word_in(words, channel.name)), None)
    by_unit, scale = UNITS.get(unit, (None, None))
    if by_name == "output" and by_unit in (None, "force"):
        scaled = 1.0 if unit in ("n", "v", "v/v") else None
        return Guess(channel, "output", "guessed: its name", scaled, f"the file says {channel.unit}")
    if by_unit is not None:
        return Guess(channel, by_unit, f"the file says {channel.unit}", scale, f"from {channel.unit}")
    if by_name is not None:
        volts = by_name == "voltage" and unit in ("", "v", "volt", "volts")
        return Guess(channel, by_name, "guessed: its name", 1.0 if volts else None, "V")
    return Guess(channel, UNFILLED, "velocity, acceleration, displacement, force, output or voltage")


@dataclass(frozen=True)
class Recorder:
    """A recorder's file and what its channels seem to read."""

    daq: FoundDaq
    channels: tuple[Guess, ...]

    @property
    def triggers(self) -> list[tuple[str, TriggerPulses]]:
        """Return the triggers by the names that the recording gives them, with their pulses."""
        return [(item.name, item.found.pulses) for item in self.channels if item.found.pulses is not None]


def recorders(daqs: Iterable[FoundDaq]) -> list[Recorder]:
    """Return what the channels of all files seem to read, files that measure motion first.

    Pulses of one rate in several files are one trigger, and get the name of one of them that says so.
    """
    found = [Recorder(daq, tuple(map(guess, daq.channels))) for daq in daqs if daq.channels]
    rates = [pulses.rate_hz for recorder in found for _, pulses in recorder.triggers]

    def named(recorder: Recorder) -> Recorder:
        names: list[str] = []
        for item in recorder.channels:
            name = item.found.name if len(item.found.name) <= LONG_NAME else item.found.name.rpartition("/")[2]
            if item.found.pulses is not None:
                name = telling.get(_same_rate(rates, item.found.pulses.rate_hz), name)
            names.append(item.found.name if name in names else name)
        own = (replace(item, name=name) for item, name in zip(recorder.channels, names, strict=True))
        return Recorder(recorder.daq, tuple(sorted(own, key=lambda item: item.order)))

    telling: dict[float, str] = {}
    for item in (item for recorder in found for item in recorder.channels if item.found.pulses is not None):
        if item.found.pulses is not None and word_in(TRIGGER_WORDS, item.found.name):
            telling.setdefault(_same_rate(rates, item.found.pulses.rate_hz), item.found.name)
    files = map(named, found)
    return sorted(files, key=lambda recorder: (-_motions(recorder), natural_key(recorder.daq.path.name)))


def _same_rate(rates: Sequence[float], rate_hz: float) -> float:
    """Return the first of some rates that is the same as another one."""
    return next(rate for rate in rates if abs(rate / rate_hz - 1.0) < SAME_RATE)


def _motions(recorder: Recorder) -> int:
    return sum(item.quantity in TRANSDUCERS for item in recorder.channels)


def body(name: str) -> str:
    """Return the line that says whose motion something sees: of the load, unless its name says otherwise."""
    if word_in(BASE_WORDS, name):
        return stated("body", "base", "guessed: its name")
    told = "its name" if word_in(LOAD_WORDS, name) else "its name says nothing of the base"
    return stated("body", "load", f"guessed: {told}")


def ordered(items: Iterable[FoundSight | FoundPoints]) -> list[FoundSight | FoundPoints]:
    """Return cameras and tables of points, those of the base last."""
    return sorted(items, key=lambda item: (word_in(BASE_WORDS, item.name), natural_key(item.name)))
