"""Units of recorded channels: what a file states against what the manifest needs."""

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
from fusion.recording.response import ELEMENTS, read_chain, read_table
from fusion.recording.toml import quote_key
from shakercal._common.notices import Notice

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
"""Units in small letters that the D-SI lacks or means otherwise, in SI: the g of accelerometers is no gram."""
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
"""Spellings in small letters of units that have another one."""
RAW = ("count", "counts", "digit", "digits", "lsb", "adc", "code", "codes", "raw", "bit", "bits")
"""Words in small letters for the integers of a converter, which are in no unit of a quantity."""
NOT_STATED = ("", "-", "none", "n/a", "na", "unit", "units", "unknown", "undefined")
"""Texts in small letters that stand where a file states no unit."""
SUPPLY = 1.0
"""V/V: an amplitude that no bridge has."""
SAME = 1e-9
"""Relative difference of factors up to which two units are one: rounding."""
CORRECTED = 0.1
"""Relative deviation of a scale from the factor between two units that a correction of a calibration may have."""
PLAIN = (0.5, 2.0)
"""Magnitudes of a response without unit that may be those of an amplifier or filter, and so no sensitivity."""


@dataclass(frozen=True)
class RecordedUnit:
    """A unit as a recorder writes it: `factor` to the SI unit of its `dimension`; `raw`: codes of a converter."""

    factor: float
    dimension: Dimension
    raw: bool = False

    def over(self, other: RecordedUnit) -> float | None:
        """Return what values in this unit are multiplied by to be in another one; None where no factor does that."""
        factor = self.factor / other.factor
        alike = self.dimension == other.dimension and self.raw == other.raw
        return (1.0 if abs(factor - 1.0) <= SAME else factor) if alike else None

    @property
    def mechanical(self) -> bool:
        """Whether it is a unit of a motion or a force."""
        return self.dimension in QUANTITY_OF


def _spelt(text: str) -> str:
    """Return a unit in plain ASCII, without brackets around it: `m/s^2` of `[m/s\u00b2]`, `um` of `\u00b5m`."""
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
    """Read the unit of a channel; None of a text that states none and of a spelling that is not known.

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


# What a manifest has to state where the unit of a file is not that of the quantity.


def in_stated_units(manifest: Manifest, daq: Daq, raw: Mapping[str, RawChannel]) -> dict[str, RawChannel]:
    """Return the channels of a block; those without `scale` are converted into the units of their quantities.

    A unit that no factor converts needs a `scale`: `InputError`. One that the file does not state is taken for that of
    the quantity, as is one that is not known (`unit_doubts` asks about that).
    """
    channels, missing = dict(raw), list[InputError]()
    for entry in daq.channel:
        if entry.quantity == "trigger" or "scale" in entry.model_fields_set:
            continue
        channel = channels[entry.name]
        found = recorded_unit(channel.unit)
        wanted = None if found is None else _wanted(entry, manifest.rig)
        if found is None or wanted is None:
            continue
        factor = found.over(wanted)
        if factor is None:
            key, what = f"daq.{daq.name}.channel.{entry.name}.scale", manifest.rig.unit_of(entry)
            named = f"the factor in {what} per {channel.unit}, the unit of {entry.stored_name} in {daq.file.name}"
            named += " (1 if the response is the sensitivity)" if entry.response is not None else ""
            missing.append(InputError(manifest.path, key, found="nothing", expected=named))
        elif factor != 1.0:
            unit = manifest.rig.unit_of(entry)
            channels[entry.name] = replace(channel, samples=channel.samples * factor, unit=unit)
    if missing:
        raise InputError.together(missing)
    return channels


def _wanted(entry: ChannelEntry, rig: Rig) -> RecordedUnit | None:
    """Return the unit that samples times `scale` have to have, None where that is not known.

    A response whose unit is stated turns the quantity into what it is measured by. Of another one that is a sensitivity
    by its size the unit is open.
    """
    unit = recorded_unit(rig.unit_of(entry))
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
    """Return the size of a response without unit: of a table the median, of a chain the product of its gains.

    0 of one that cannot be read, which commands that use it refuse.
    """
    with suppress(InputError):
        if path.suffix.lower() == ELEMENTS:
            return float(np.prod([abs(element.gain) for element in read_chain(path).element]))
        return float(np.median(read_table(path, columns).magnitude))
    return 0.0


def unit_notices(manifest: Manifest, daq: Daq, raw: Mapping[str, RawChannel]) -> tuple[Notice, ...]:
    """Return a question for every channel whose file states another unit than its `scale` lets expect."""
    told = []
    certified = {item.key for item in manifest.inputs if item.stated is not None and item.stated.certificate}
    for entry in daq.channel:
        where = f"daq.{quote_key(daq.name)}.channel.{quote_key(entry.name)}.scale"
        of_certificate = any(key.endswith(where) for key in certified)
        unit = raw[entry.name].unit
        doubt = None if entry.quantity == "trigger" else _doubt(entry, unit, manifest.rig, of_certificate)
        peak = abs(entry.scale) * float(np.ptp(np.nan_to_num(raw[entry.name].samples))) / 2.0
        if doubt is None and entry.quantity == "output" and manifest.rig.unit_of(entry) == "V/V" and peak > SUPPLY:
            doubt = f"the output swings by {peak:.3g} V/V, more than its supply: are scale and in_file right?"
        if doubt is not None:
            told.append(Notice("warning", f"{where}: {doubt}", manifest.path.name))
    return tuple(told)


def _doubt(entry: ChannelEntry, stated: str, rig: Rig, of_certificate: bool) -> str | None:
    """Return what is to be asked of the scale of a channel whose file states a unit."""
    unit, quantity, text = recorded_unit(stated), rig.unit_of(entry), None
    given, wanted = "scale" in entry.model_fields_set, None if unit is None else _wanted(entry, rig)
    factor = None if unit is None or wanted is None else unit.over(wanted)
    if unit is None:
        if not given and _spelt(stated).lower() not in (*NOT_STATED, _spelt(quantity).lower()):
            text = f"which is not known and taken for {quantity}: is it that, with a scale of 1?"
    elif not given:
        if wanted is None and entry.response is not None and unit.factor != 1.0:
            text = f"and the response none: is it the sensitivity per {stated}, with a scale of 1?"
    elif factor is not None and wanted is not None:
        # Of volts and ratios the scale may be an amplifier's, unless it says that the file is in the unit itself.
        off = abs(abs(entry.scale) / factor - 1.0) > CORRECTED
        if off if wanted.mechanical else abs(entry.scale) == 1.0 != factor:
            text = f"of which {factor:.6g} makes {quantity}: is {entry.scale:g} right?"
    elif unit.raw and entry.scale == 1.0 and entry.response is None:
        text = f"codes of a converter: is one of them 1 {quantity}?"
    elif of_certificate and not unit.mechanical and unit.factor != 1.0:
        text = f"and the scale is that of a certificate: is it per {stated}?"
    elif wanted is not None and unit.mechanical and wanted.mechanical:
        text = f"of which no factor makes {quantity}: is this channel {entry.quantity}?"
    return None if text is None else f'the file states the unit "{stated}", {text}'
