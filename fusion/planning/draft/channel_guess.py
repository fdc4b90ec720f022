"""Quantity and scale of a recorder's channels, guessed from names, units and signals."""

from __future__ import annotations

import json
import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from datetime import date
from typing import Any

from fusion.base import PROGRAM, __version__, natural_key
from fusion.planning.draft.camera_pairs import FoundCameras
from fusion.planning.draft.inventory import FoundChannel, FoundDaq, FoundPoints, TriggerPulses
from fusion.recording.dsi import NONE
from fusion.recording.instruments import Library
from fusion.recording.toml import UNFILLED
from fusion.recording.transducer import TRANSDUCERS
from fusion.recording.units import QUANTITY_OF, recorded_unit
from shaker.labels import LOAD_COMPONENTS

SAME_RATE = 1e-3  # relative difference of the rates of one trigger
LONG_NAME = 40  # characters
HEAD = f"""\
# Drafted by {PROGRAM} {__version__} from the files of this folder.
# "?" marks values to fill in: `shakercal check` lists them first, and `shakercal run` refuses them.
# "guessed" gives the reason of a guessed value. Lines that begin with "# " are optional keys, with a usual value.
"""
"""Beginning of a drafted file."""


# Lines of a manifest: stated, to fill in, optional.


def key_line(key: str, value: Any, why: str = "") -> str:
    """Return the line of a key with a known or guessed value."""
    shown = value.isoformat() if isinstance(value, date) else json.dumps(value, ensure_ascii=False)
    return f"{key} = {shown}" + (f"  # {why}" if why else "")


def question_line(key: str, why: str) -> str:
    """Return the line of a key for the laboratory to fill in.

    `why`: the expected value.
    """
    return key_line(key, UNFILLED, why)


def optional_line(key: str, value: Any, why: str) -> str:
    """Return the commented line of an optional key."""
    return f"# {key_line(key, value, why)}"


# Quantity of a channel by its name, unit and signal.


@dataclass(frozen=True)
class ChannelGuess:
    """Guessed quantity and scale of a file's channel.

    `scale`: None if unknown; `name`: that in the recording; `base_why`: the reason if it is on the base;
    `component`: of a sensor's output, empty if unknown; `instrument`: of the library, which has the keys `provided`.
    """

    found: FoundChannel
    quantity: str
    why: str
    scale: float | None = None
    scale_why: str = ""
    name: str = ""
    base_why: str = ""
    component: str = ""
    instrument: str = ""
    provided: tuple[str, ...] = ()

    @property
    def order(self) -> tuple[int, tuple[object, ...]]:
        """Position in its block: motion first, triggers last, otherwise by name."""
        kinds = [*TRANSDUCERS, "force", "output", "voltage", UNFILLED, "trigger"]
        kind = kinds.index(self.quantity) if self.quantity in kinds else len(kinds)
        return kind, natural_key(self.name)


NAMES = (
    ("velocity", r"vel\w*|vib\w*|ldv\w*|laser\w*|psv\w*|lsv\w*|speed\w*"),
    ("acceleration", r"acc\w*|accel\w*|beschl\w*|icp\w*"),
    ("displacement", r"disp\w*|weg\w*"),
    ("angular_velocity", r"gyro\w*|rate"),
    ("output", r"bridge\w*|output\w*"),
    ("force", r"force\w*|kraft\w*|load_?cell\w*"),
    ("voltage", r"volt\w*|drive|generator|excitation"),
)
"""Quantities by words of a channel's name; the first match counts."""
GAUGE_WORDS = r"load_?cell\w*|gauge|reference|ref|hammer|stinger|kraftmess\w*"
TRIGGER_WORDS = r"\w*trig\w*|sync\w*|strobe\w*|cam\w*|kamera\w*"
BASE_WORDS, LOAD_WORDS = r"base|table|tisch|bottom|lower|shaker|armature", r"load|mass|top|upper|masse|last"


def has_word(words: str, name: str) -> bool:
    """Return whether a name has one of some words, separated by other signs.

    Words are in lower case with | between them.
    """
    return re.search(rf"(?<![a-z])({words})(?![a-z])", name.lower().replace("_", " ").replace("/", " ")) is not None


COMPONENT = re.compile(
    r"(?<![a-z])(?:(f|force|kraft|load)|m|moment|torque|drehmoment)[ _-]*([xyz])\d?(?![a-z])"
    r"|(?<![a-z])([xyz])[ _-]*(?:(force|kraft)|moment|torque)(?![a-z])",
    re.IGNORECASE,
)
SENSITIVITY = re.compile(
    r"(?P<per>\d+(?:[.,]\d+)?(?:e[-+]?\d+)?)\s*\(?\s*(?P<unit>[^\s\d/()]+(?:/s(?:\^?2|²)?)?)\s*\)?\s*(?:/|per|pro)\s*V(?![a-z/])"
    r"|(?P<volts>\d+(?:[.,]\d+)?)\s*(?P<prefix>[mµu]?)V\s*(?:/|per|pro)\s*\(?\s*"
    r"(?P<of>m/s(?:\^?2|²)|[mk]?g(?!\w)|[mk]?N(?!\w)|m?m/s(?![\^²2])|[muµ]?m(?![\w/]))\)?",
    re.IGNORECASE,
)


def component_of(title: str) -> str:
    """Return the load component that a channel's name states, such as Fz; empty without one."""
    found = COMPONENT.search(title.replace("_", " "))
    if found is None:
        return ""
    return ("F" if found[1] or found[4] else "M") + (found[2] or found[3]).lower()


def _stated_sensitivity(title: str) -> tuple[str, float, str] | None:
    """Return quantity, scale (SI per V) and text of a sensitivity in a channel's name.

    Such as `VIB 25 mm/s/V` or `ICP 100 mV/g`.
    """
    for found in SENSITIVITY.finditer(title):
        unit = recorded_unit(found["unit"] or found["of"])
        quantity = None if unit is None or unit.raw else QUANTITY_OF.get(unit.dimension)
        if unit is None or quantity is None:
            continue
        number = float((found["per"] or found["volts"]).replace(",", "."))
        volts = {"": 1.0, "m": 1e-3}.get((found["prefix"] or "").lower(), 1e-6)
        if number > 0.0:
            scale = number * unit.factor if found["per"] else unit.factor / (number * volts)
            return quantity, float(f"{scale:.12g}"), found[0].strip()
    return None


def guess_channel(channel: FoundChannel) -> ChannelGuess:
    """Return the guessed quantity and scale of a file's channel, with the reason."""
    unit, volt = recorded_unit(channel.unit), recorded_unit("V")
    if channel.pulses is not None:
        pulses = channel.pulses
        rate = f" at {pulses.rate_hz:.6g} Hz" if channel.rate_hz else ""
        why = f"guessed: two levels, {pulses.edges} edges{rate}"
        return ChannelGuess(channel, "trigger", why, 1.0)
    by_name = next((quantity for quantity, words in NAMES if has_word(words, channel.title)), None)
    by_name = "output" if component_of(channel.title) else by_name
    sensitivity = _stated_sensitivity(channel.title) if unit == volt or not channel.unit.strip() else None
    if sensitivity is not None:
        quantity, scale, text = sensitivity
        return ChannelGuess(channel, quantity, "guessed: its name", scale, f"its name says {text}")
    by_unit = None if unit is None or unit.raw else QUANTITY_OF.get(unit.dimension)
    if unit is not None and unit.dimension == NONE and "/" in channel.unit:
        by_unit = "output"
    if by_unit == "angular_velocity" and not re.search("rad|d|\u00b0", channel.unit.lower()):
        by_unit = None  # revolutions of a rotating machine
    if by_name == "output" and by_unit in (None, "force"):
        scaled = 1.0 if unit is not None and unit.factor == 1.0 and (by_unit or unit == volt) else None
        why = f"the file says {channel.unit}"
        return ChannelGuess(channel, "output", "guessed: its name", scaled, why, component=component_of(channel.title))
    if by_unit is not None and unit is not None:
        component = component_of(channel.title) if by_unit == "output" else ""
        why, scale_why = f"the file says {channel.unit}", f"from {channel.unit}"
        return ChannelGuess(channel, by_unit, why, unit.factor, scale_why, component=component)
    if by_name is not None:
        volts = by_name == "voltage" and (unit == volt or not channel.unit.strip())
        return ChannelGuess(channel, by_name, "guessed: its name", 1.0 if volts else None, "V")
    return ChannelGuess(channel, UNFILLED, "velocity, acceleration, displacement, force, output or voltage")


@dataclass(frozen=True)
class RecorderFile:
    """A recorder's file and the guesses for its channels.

    `copies`: channels with the same pulses as a trigger, with its name.
    """

    daq: FoundDaq
    channels: tuple[ChannelGuess, ...]
    copies: tuple[tuple[str, str], ...] = ()

    @property
    def triggers(self) -> list[tuple[str, TriggerPulses]]:
        """Triggers with their names in the recording, and their pulses."""
        return [(item.name, item.found.pulses) for item in self.channels if item.found.pulses is not None]


def guess_recorders(daqs: Iterable[FoundDaq]) -> list[RecorderFile]:
    """Return the guesses for all files, files with motion channels first.

    Pulses of one rate in several files are one trigger, named by a channel with a trigger's name if there is one.
    """
    found = [_without_copies(RecorderFile(daq, tuple(_guess_file(daq)))) for daq in daqs if daq.channels]
    rates = [pulses.rate_hz for recorder in found for _, pulses in recorder.triggers]

    def named(recorder: RecorderFile) -> RecorderFile:
        names: list[str] = []
        for item in recorder.channels:
            name = _name_of(item.found)
            if item.found.pulses is not None:
                name = common[_same_rate(rates, item.found.pulses.rate_hz)]
            names.append(item.found.name if name in names else name)
        guesses = (replace(item, name=name) for item, name in zip(recorder.channels, names, strict=True))
        return replace(recorder, channels=tuple(sorted(guesses, key=lambda item: item.order)))

    triggers = [item.found for recorder in found for item in recorder.channels if item.found.pulses is not None]
    common: dict[float, str] = {}
    for channel in sorted(triggers, key=lambda channel: not has_word(TRIGGER_WORDS, channel.title)):
        if channel.pulses is not None:
            common.setdefault(_same_rate(rates, channel.pulses.rate_hz), _name_of(channel))
    files = map(named, found)
    return sorted(files, key=lambda recorder: (-_motions(recorder), natural_key(recorder.daq.path.name)))


def _name_of(channel: FoundChannel) -> str:
    """Return the name of a channel in the recording."""
    name = channel.label or channel.short or channel.name
    return name if len(name) <= LONG_NAME else name.rpartition("/")[2]


def _guess_file(daq: FoundDaq) -> list[ChannelGuess]:
    """Return the guesses for a file's channels.

    Three forces, alone or with three moments, are a sensor's outputs in their usual order.
    """
    guesses = [guess_channel(channel) for channel in daq.channels]
    loads = [item for item in guesses if item.quantity == "force" and not has_word(GAUGE_WORDS, item.found.title)]
    moments = [item for item in guesses if recorded_unit(item.found.unit) == recorded_unit("N m")]
    if len(loads) != 3 or len(moments) not in (0, 3):
        return guesses
    components = dict(zip((id(item) for item in (*loads, *moments)), LOAD_COMPONENTS, strict=False))
    return [
        replace(item, quantity="output", component=components[id(item)], why="guessed: three forces of one file")
        if id(item) in components
        else item
        for item in guesses
    ]


def _without_copies(recorder: RecorderFile) -> RecorderFile:
    """Return a recorder whose channels with the same pulses are one trigger.

    It is the one with a trigger's name, if there is one.
    """
    triggers = [(item, item.found.pulses) for item in recorder.channels if item.found.pulses is not None]
    triggers.sort(key=lambda trigger: not has_word(TRIGGER_WORDS, trigger[0].found.title))
    first: list[tuple[ChannelGuess, TriggerPulses]] = []
    copies: dict[str, str] = {}
    for item, pulses in triggers:
        same = [one for one, other in first if other.same_as(pulses)]
        if same:
            copies[item.found.name] = same[0].found.title
        else:
            first.append((item, pulses))
    channels = tuple(item for item in recorder.channels if item.found.name not in copies)
    return replace(recorder, channels=channels, copies=tuple(copies.items()))


def with_quantities(recorders: Iterable[RecorderFile], stated: Mapping[str, str]) -> Iterator[RecorderFile]:
    """Yield recorders with stated quantities, by the paths of their keys."""
    for recorder in recorders:
        channels = []
        for item in recorder.channels:
            quantity = stated.get(f"daq.{recorder.daq.path.stem}.channel.{item.name}.quantity", item.quantity)
            scale = item.scale if quantity == item.quantity else None
            why = item.why if quantity == item.quantity else "stated"
            channels.append(replace(item, quantity=quantity, scale=scale, why=why))
        yield replace(recorder, channels=tuple(channels))


def assign_instruments(recorders: Iterable[RecorderFile], library: Library | None) -> Iterator[RecorderFile]:
    """Yield recorders whose channels have the instruments of the library that their names indicate."""
    for recorder in recorders:
        channels = (_with_instrument(item, library) for item in recorder.channels)
        yield replace(recorder, channels=tuple(sorted(channels, key=lambda item: item.order)))


def _with_instrument(item: ChannelGuess, library: Library | None) -> ChannelGuess:
    """Return a channel with its instrument, if its name indicates exactly one."""
    if library is None or item.quantity == "trigger":
        return item
    fitting = [
        name
        for name, instrument in library.instruments.items()
        if instrument.quantity in (None, item.quantity) or item.quantity == UNFILLED
        if any(has_word(re.escape(word.lower()), item.found.title) for word in (name, *instrument.names))
    ]
    if len(fitting) != 1:
        return item
    quantity = item.quantity if item.quantity != UNFILLED else library.instruments[fitting[0]].quantity or UNFILLED
    # The scale of an instrument counts per volt: values in another unit have theirs.
    in_volts = recorded_unit(item.found.unit) == recorded_unit("V") or not item.found.unit.strip()
    provided = tuple(key for key in library.values[fitting[0]] if key != "scale" or in_volts)
    return replace(item, instrument=fitting[0], provided=provided, quantity=quantity)


def _same_rate(rates: Sequence[float], rate_hz: float) -> float:
    """Return the first of some rates that equals another one."""
    return next(rate for rate in rates if abs(rate / rate_hz - 1.0) < SAME_RATE)


def _motions(recorder: RecorderFile) -> int:
    return sum(item.quantity in TRANSDUCERS for item in recorder.channels)


def body_line(name: str, base_why: str = "") -> str:
    """Return the line of the observed body: the load, unless a reason indicates the base."""
    if base_why:
        return key_line("body", "base", base_why)
    if has_word(BASE_WORDS, name):
        return key_line("body", "base", "guessed: its name")
    reason = "its name" if has_word(LOAD_WORDS, name) else "its name does not indicate the base"
    return key_line("body", "load", f"guessed: {reason}")


def sort_body_views(items: Iterable[FoundCameras | FoundPoints]) -> list[FoundCameras | FoundPoints]:
    """Return cameras and tables of points, those of the base last."""
    return sorted(items, key=lambda item: (has_word(BASE_WORDS, item.name), natural_key(item.name)))
