"""Units of recorded channels: units of files compared with those that the manifest requires."""

from __future__ import annotations

import re
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import cache
from math import pi
from typing import TYPE_CHECKING

import numpy as np

from fusion.errors import InputError
from fusion.recording.dcc import SUFFIX, read_dcc
from fusion.recording.dcc_curves import curve_named
from fusion.recording.dsi import NONE, Dimension, parse_unit
from fusion.recording.recording_notices import (
    CERTIFIED_SCALE_UNIT,
    CONVERTER_CODES,
    OUTPUT_EXCEEDS_SUPPLY,
    RESPONSE_WITHOUT_UNIT,
    SCALE_CONTRADICTS_UNIT,
    SCALE_REQUIRED,
    UNIT_OF_ANOTHER_QUANTITY,
    UNKNOWN_FILE_UNIT,
)
from fusion.recording.response import ELEMENTS, read_chain, read_table
from fusion.recording.toml import quote_key
from shakercal._common.notices import DeclaredNotice, Notice, Value

if TYPE_CHECKING:
    from pathlib import Path

    from fusion.recording.load import Manifest
    from fusion.recording.manifest import ChannelEntry, Daq, ResponseColumns
    from fusion.recording.rig import Rig
    from shaker.io.channel import RawChannel

LENGTH, SPEED, ACCELERATION, TURN_RATE, FORCE = (
    parse_unit(unit).dimension for unit in ("m", "m/s", "m/s^2", "1/s", "N")
)
QUANTITY_OF = {
    LENGTH: "displacement",
    SPEED: "velocity",
    ACCELERATION: "acceleration",
    TURN_RATE: "angular_velocity",
    FORCE: "force",
}
"""Quantity of a channel by the dimension of its unit."""
FREE_FALL_MPS2, POUND_N, INCH_M = 9.80665, 4.4482216152605, 0.0254
DIFFERENT = {
    "g": (FREE_FALL_MPS2, ACCELERATION),
    "mg": (1e-3 * FREE_FALL_MPS2, ACCELERATION),
    "ug": (1e-6 * FREE_FALL_MPS2, ACCELERATION),
    "gal": (1e-2, ACCELERATION),
    "in/s^2": (INCH_M, ACCELERATION),
    "in/s": (INCH_M, SPEED),
    "in": (INCH_M, LENGTH),
    "mil": (1e-3 * INCH_M, LENGTH),
    "deg/s": (pi / 180.0, TURN_RATE),
    "rpm": (pi / 30.0, TURN_RATE),
    "hz": (2.0 * pi, TURN_RATE),
    "lbf": (POUND_N, FORCE),
    "kgf": (FREE_FALL_MPS2, FORCE),
    "%": (1e-2, NONE),
}
"""Units in small letters that the D-SI lacks or defines differently, in SI: the g of accelerometers is no gram."""
WORDS = {
    **dict.fromkeys(("volt", "volts"), "V"),
    **dict.fromkeys(("millivolt", "millivolts", "mv"), "mV"),
    "mv/v": "mV/V",
    **dict.fromkeys(("ampere", "amperes", "amp", "amps"), "A"),
    **dict.fromkeys(("newton", "newtons"), "N"),
    **dict.fromkeys(("gn", "g_n", "gs"), "g"),
    **dict.fromkeys(("metre", "meter", "metres", "meters"), "m"),
    **dict.fromkeys(("micron", "microns"), "um"),
    **dict.fromkeys(("mps2", "mps^2", "ms^-2"), "m/s^2"),
    **dict.fromkeys(("mps", "ms^-1"), "m/s"),
    **dict.fromkeys(("inch", "inches"), "in"),
    **dict.fromkeys(("mils", "thou"), "mil"),
    **dict.fromkeys(("lb", "lbs", "pound", "pounds"), "lbf"),
    **dict.fromkeys(("dps", "\u00b0/s", "degree/s", "degrees/s"), "deg/s"),
    **dict.fromkeys(("rev/min", "1/min"), "rpm"),
    **dict.fromkeys(("percent", "pct"), "%"),
    "ips": "in/s",
}
"""Other spellings of units, in small letters."""
RAW = ("count", "counts", "digit", "digits", "lsb", "adc", "code", "codes", "raw", "bit", "bits")
"""Words in small letters for the integers of a converter, which have no unit of a quantity."""
NOT_STATED = ("", "-", "none", "n/a", "na", "unit", "units", "unknown", "undefined")
"""Texts in small letters of files that state no unit."""
SUPPLY = 1.0
"""V/V: an amplitude that no bridge has."""
SAME = 1e-9
"""Relative difference of factors up to which two units are one: rounding."""
CORRECTED = 0.1
"""Relative deviation of a scale from the factor between two units that a correction of a calibration may have."""
PLAIN = (0.5, 2.0)
"""Magnitudes of a response without unit that are those of an amplifier or filter, not of a sensitivity."""


@dataclass(frozen=True)
class RecordedUnit:
    """The unit of a recorder's file, or converter codes (`raw`).

    `factor`: to the SI unit of its `dimension`.
    """

    factor: float
    dimension: Dimension
    raw: bool = False

    def over(self, other: RecordedUnit) -> float | None:
        """Return the factor from this unit to another one, None if no factor converts them."""
        factor = self.factor / other.factor
        convertible = self.dimension == other.dimension and self.raw == other.raw
        return (1.0 if abs(factor - 1.0) <= SAME else factor) if convertible else None

    @property
    def mechanical(self) -> bool:
        """Whether it is a unit of a motion or a force."""
        return self.dimension in QUANTITY_OF


def _spelt(text: str) -> str:
    """Return a unit in plain ASCII without brackets: `m/s^2` of `[m/s\u00b2]`, `um` of `\u00b5m`."""
    plain = text.strip()
    if len(plain) > 2 and plain[0] + plain[-1] in ("[]", "{}"):
        plain = plain[1:-1].strip()
    for old, new in (("\u00b5", "u"), ("\u03bc", "u"), ("\u00b2", "2"), ("\u00b9", "1"), ("\u207b", "-"), ("**", "^")):
        plain = plain.replace(old, new)
    plain = re.sub(r"(?i)[ _]?(rms|eff|peak|pk|p-p|pp)$", "", plain)
    plain = re.sub(r"(?i)\bsec(onds?)?\b", "s", re.sub(r"\s*/\s*", "/", plain))
    return re.sub(r"(?<=[A-Za-z])(?=-?\d(?![\d.]))", "^", plain)


def _capital(found: re.Match[str]) -> str:
    return found[1] + found[2].upper()


@cache
def recorded_unit(text: str) -> RecordedUnit | None:
    """Return the unit of a channel, None if it is missing or not recognised.

    >>> from fusion.recording.units import recorded_unit
    >>> recorded_unit("mm/s").factor, recorded_unit("g").factor, recorded_unit("EU")
    (0.001, 9.80665, None)
    """
    plain = _spelt(text)
    if plain.lower() in RAW:
        return RecordedUnit(1.0, NONE, raw=True)
    plain = WORDS.get(plain.lower(), plain)
    if plain.lower() in DIFFERENT:
        return RecordedUnit(*DIFFERENT[plain.lower()])
    if plain.lower() in NOT_STATED:
        return None
    spellings = [plain]
    if plain.islower() or plain.isupper():  # a recorder that knows one case of letters only
        spellings.append(re.sub(r"(?<![a-z])([mku]?)([nvac])(?![a-z])", _capital, plain.lower()))
    for spelling in spellings:
        with suppress(ValueError):
            unit = parse_unit(spelling)
            return RecordedUnit(unit.factor, unit.dimension)
    return None


# Scales that a manifest must state if the unit of a file is not that of the quantity.


def in_stated_units(manifest: Manifest, daq: Daq, raw: Mapping[str, RawChannel]) -> dict[str, RawChannel]:
    """Return the channels of a block, converted if they have no `scale`.

    A unit that no factor converts requires a `scale`: `InputError`. A unit that is not stated, or not recognised, is
    taken as that of the quantity; `unit_notices` warns of the latter.
    """
    channels, missing = dict(raw), list[InputError]()
    for entry in daq.channel:
        if entry.quantity == "trigger" or "scale" in entry.model_fields_set:
            continue
        channel = channels[entry.name]
        found = recorded_unit(channel.unit)
        required = None if found is None else _required_unit(entry, manifest.rig)
        if found is None or required is None:
            continue
        factor = found.over(required)
        if factor is None:
            key, unit = f"daq.{daq.name}.channel.{entry.name}.scale", manifest.rig.unit_of(entry.quantity)
            expected = f"the factor in {unit} per {channel.unit}, the unit of {entry.stored_name} in {daq.file.name}"
            expected += " (1 if the response is the sensitivity)" if entry.response is not None else ""
            missing.append(InputError(SCALE_REQUIRED, manifest.path, key, found="no such key", expected=expected))
        elif factor != 1.0:
            unit = manifest.rig.unit_of(entry.quantity)
            channels[entry.name] = replace(channel, samples=channel.samples * factor, unit=unit)
    if missing:
        raise InputError.together(missing)
    return channels


def _required_unit(entry: ChannelEntry, rig: Rig) -> RecordedUnit | None:
    """Return the required unit of samples times `scale`, None if it is undetermined.

    A response with a stated unit converts the quantity into an electrical one. Without a unit, a response that is a
    sensitivity by its size leaves it undetermined.
    """
    unit = recorded_unit(rig.unit_of(entry.quantity))
    if unit is None or entry.response is None:
        return unit
    stated = entry.response_columns.magnitude_unit if entry.response_columns is not None else None
    if entry.response.suffix.lower() == SUFFIX:
        of_response = curve_named(read_dcc(entry.response), entry.response_result or "").unit.dimension
    elif stated is not None:
        of_response = parse_unit(stated).dimension
    else:
        plain = PLAIN[0] <= _usual_magnitude(entry.response, entry.response_columns) <= PLAIN[1]
        return unit if plain else None
    dimension = tuple(a + b for a, b in zip(unit.dimension, of_response, strict=True))
    return RecordedUnit(1.0 if any(of_response) else unit.factor, dimension)


def _usual_magnitude(path: Path, columns: ResponseColumns | None) -> float:
    """Return the typical magnitude of a response without unit.

    It is the median of a table, or the product of a chain's gains; 0 if it cannot be read, which the commands that use
    it refuse.
    """
    with suppress(InputError):
        if path.suffix.lower() == ELEMENTS:
            return float(np.prod([abs(element.gain) for element in read_chain(path).element]))
        return float(np.median(read_table(path, columns).magnitude))
    return 0.0


def unit_notices(manifest: Manifest, daq: Daq, raw: Mapping[str, RawChannel]) -> tuple[Notice, ...]:
    """Return a notice for every channel whose file states another unit than its `scale` implies."""
    notices = []
    certified = {item.key for item in manifest.inputs if item.stated is not None and item.stated.certificate}
    for entry in (entry for entry in daq.channel if entry.quantity != "trigger"):
        key = f"daq.{quote_key(daq.name)}.channel.{quote_key(entry.name)}.scale"
        of_certificate = any(other.endswith(key) for other in certified)
        channel = raw[entry.name]
        found = _unit_contradiction(entry, channel.unit, manifest.rig, of_certificate)
        found = found or _excessive_output(entry, channel, manifest.rig)
        if found is not None:
            declared, values = found
            notices.append(Notice(declared, manifest.path.name, key=key, **values))
    return tuple(notices)


def _excessive_output(
    entry: ChannelEntry, channel: RawChannel, rig: Rig
) -> tuple[DeclaredNotice, dict[str, Value]] | None:
    """Return the notice on an output above the supply of its bridge, with its values."""
    if entry.quantity != "output" or rig.unit_of(entry.quantity) != "V/V":
        return None
    peak = abs(entry.scale) * float(np.ptp(np.nan_to_num(channel.samples))) / 2.0
    return (OUTPUT_EXCEEDS_SUPPLY, {"amplitude": peak}) if peak > SUPPLY else None


def _unit_contradiction(
    entry: ChannelEntry, stated: str, rig: Rig, of_certificate: bool
) -> tuple[DeclaredNotice, dict[str, Value]] | None:
    """Return the notice on the unit of a channel, with its values."""
    unit, quantity_unit = recorded_unit(stated), rig.unit_of(entry.quantity)
    values: dict[str, Value] = {"unit": stated, "quantity_unit": quantity_unit}
    scale_stated = "scale" in entry.model_fields_set
    required = None if unit is None else _required_unit(entry, rig)
    factor = None if unit is None or required is None else unit.over(required)
    found: tuple[DeclaredNotice, dict[str, Value]] | None = None
    if unit is None:
        if not scale_stated and _spelt(stated).lower() not in (*NOT_STATED, _spelt(quantity_unit).lower()):
            found = UNKNOWN_FILE_UNIT, values
    elif not scale_stated:
        if required is None and entry.response is not None and unit.factor != 1.0:
            found = RESPONSE_WITHOUT_UNIT, {"unit": stated}
    elif factor is not None and required is not None:
        # The scale of volts and ratios may be an amplifier's, unless it is 1.
        deviates = abs(abs(entry.scale) / factor - 1.0) > CORRECTED
        if deviates if required.mechanical else abs(entry.scale) == 1.0 != factor:
            found = SCALE_CONTRADICTS_UNIT, values | {"factor": factor, "scale": entry.scale}
    elif unit.raw and entry.scale == 1.0 and entry.response is None:
        found = CONVERTER_CODES, values
    elif of_certificate and not unit.mechanical and unit.factor != 1.0:
        found = CERTIFIED_SCALE_UNIT, {"unit": stated}
    elif required is not None and unit.mechanical and required.mechanical:
        found = UNIT_OF_ANOTHER_QUANTITY, values | {"quantity": entry.quantity}
    return found
