"""NI TDMS: channels `group/channel` with their scales, in one pass over the file, block by block."""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from fractions import Fraction
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
from numpy.typing import NDArray

from shaker._checks import FloatArray
from shaker.signals.files.common import BLOCK, checked_rate, chosen, is_time, rate_of_times
from shaker.signals.files.tdms_index import DAQMX, Field, Region, TdmsIndex, path_parts, read_index
from shaker.signals.recording import RawChannel

_SCALES = ("Polynomial", "Linear", "RTD", "Strain", "Table", "Thermistor", "Thermocouple", "Add", "Subtract")
_SCALE_KEY = re.compile(r"NI_Scale\[(\d+)\]_Scale_Type")
_MOST_SCALES = 1000
_SCALE_BLOCK = 1 << 14  # samples scaled at a time: their intermediate results stay in the cache
_Key = tuple[str, int]  # a channel's path and the number of its raw scale


@dataclass
class _Sink:
    """Values (S,) of a channel, how many are in, and the scale that each block gets at once (None: none, or later)."""

    values: FloatArray
    scale: Any = None
    filled: int = 0


@dataclass(frozen=True)
class _Raw:
    """What the library's scales take: values, or values by the number of the raw scale."""

    data: FloatArray | None
    scaler_data: dict[int, FloatArray] = field(default_factory=dict)


def read_tdms(path: Path, names: Sequence[str] | None, sample_rate_hz: float | None) -> dict[str, RawChannel]:
    """Read channels by `group/channel`, or by the channel's name alone where only one group has it.

    The interval is `wf_increment`; without it, a channel `time` (numbers in seconds, or time stamps) of the same group
    and length counts, then `sample_rate_hz`. A channel starts at `wf_start_offset`, plus the lead of its
    `wf_start_time` over the earliest of the channels asked for. Scales of the hardware (`NI_Scale`) are applied. Texts
    and complex numbers are passed over. Memory: the result and one block.
    """
    with path.open("rb") as stream:
        index = read_index(path, stream)
        types = {own.path: own.dtype for region in index.regions for own in region.fields}
        lengths = _lengths(index.regions)
        present = {
            "/".join(path_parts(name)): name
            for name, dtype in types.items()
            if dtype.kind in "biuf" and any(lengths[key] for key in lengths if key[0] == name)
        }
        bare = [path_parts(name)[-1] for name in present.values()]
        alone = {tail: name for tail, name in zip(bare, present.values(), strict=True) if bare.count(tail) == 1}
        if names is not None:
            chosen(path, names, [*present, *(tail for tail in alone if tail not in present)])
        paths = present if names is None else {name: present.get(name) or alone[name] for name in names}
        times = {name: _time_of(name, index, types, lengths) for name in paths.values()}
        wanted = {*paths.values(), *(time for time in times.values() if time)}
        values = _values(path, stream, index, wanted)
        starts = _starts(stream, index, types, {times[own] or own for own in paths.values()})
    result = {}
    for name, own in paths.items():
        rate, start = _clock(path, name, index.properties.get(own, {}), values, times[own], sample_rate_hz)
        result[name] = RawChannel(
            values[own],
            rate,
            start + starts.get(times[own] or own, 0.0),
            str(index.properties.get(own, {}).get("unit_string", "")),
        )
    return result


def _lengths(regions: Iterable[Region]) -> dict[_Key, int]:
    """Return the number of values of every channel and raw scale."""
    lengths: dict[_Key, int] = {}
    for region in regions:
        for own in region.fields:
            key = own.path, own.scale
            lengths[key] = lengths.get(key, 0) + own.count * region.repeats
    return lengths


def _time_of(
    name: str, index: TdmsIndex, types: Mapping[str, np.dtype[Any]], lengths: Mapping[_Key, int]
) -> str | None:
    """Return the time channel that belongs to a channel without `wf_increment`."""
    if index.properties.get(name, {}).get("wf_increment"):
        return None
    group, *_ = path_parts(name)
    for other in types:
        own_group, *tail = path_parts(other)
        fits = lengths.get((other, DAQMX)) == lengths.get((name, DAQMX))
        if other != name and own_group == group and tail and is_time(tail[0]) and fits:
            return other
    return None


def _values(path: Path, stream: BinaryIO, index: TdmsIndex, wanted: set[str]) -> dict[str, FloatArray]:
    """Return the values of the channels wanted, scaled; time stamps in seconds from their first second.

    A card's channel without scale is its first raw scale.
    """
    sinks = {key: _Sink(np.empty(length)) for key, length in _lengths(index.regions).items() if key[0] in wanted}
    keys = {name: [key for key in sinks if key[0] == name] for name in wanted}
    scales = {name: _scale(path, name, index) for name in wanted}
    for name, own in keys.items():
        if len(own) == 1:
            sinks[own[0]].scale = scales[name]
    bases: dict[str, int] = {}
    for region in index.regions:
        fields = [own for own in region.fields if own.path in wanted]
        if fields:
            _read_region(path, stream, region, fields, sinks, bases)
    for name, own in keys.items():
        if len(own) > 1 and scales[name] is not None:
            _apply(scales[name], {key[1]: sinks[key].values for key in own})
    return {name: sinks[own[0]].values for name, own in keys.items()}


def _read_region(
    path: Path,
    stream: BinaryIO,
    region: Region,
    fields: Sequence[Field],
    sinks: Mapping[_Key, _Sink],
    bases: dict[str, int],
) -> None:
    """Read a region block by block into the channels' arrays."""
    if region.stride > BLOCK:
        for position, part in _pieces(region, fields):
            _store(part, _read(path, stream, position, part.count * part.dtype.itemsize), 0, sinks, bases)
        return
    rows = max(1, BLOCK // max(1, region.stride))
    for first in range(0, region.repeats, rows):
        count = min(rows, region.repeats - first)
        block = _read(path, stream, region.position + first * region.stride, count * region.stride)
        for own in fields:
            _store(own, block, region.stride, sinks, bases)


def _pieces(region: Region, fields: Sequence[Field]) -> Iterable[tuple[int, Field]]:
    """Yield position and values of pieces no larger than a block, where a record is larger than that."""
    for repeat in range(region.repeats):
        for own in fields:
            size = own.dtype.itemsize
            for first in range(0, own.count, BLOCK // size):
                count = min(BLOCK // size, own.count - first)
                position = region.position + repeat * region.stride + own.offset + first * size
                yield position, Field(own.path, 0, count, own.dtype, own.scale, own.bit)


def _read(path: Path, stream: BinaryIO, position: int, size: int) -> bytes:
    """Read bytes, all of them."""
    stream.seek(position)
    block = stream.read(size)
    if len(block) < size:
        raise ValueError(f"{path}: expected a complete TDMS file, found its end at byte {position + len(block)}")
    return block


def _store(own: Field, block: bytes, stride: int, sinks: Mapping[_Key, _Sink], bases: dict[str, int]) -> None:
    """Put a channel's values from a block of records into its array."""
    sink = sinks[own.path, own.scale]
    repeats = len(block) // stride if stride else 1
    raw: NDArray[Any] = np.ndarray((repeats, own.count), own.dtype, block, own.offset, (stride, own.dtype.itemsize))
    if own.bit is not None:
        raw = raw >> own.bit & 1
    elif own.dtype.names:
        base = bases.setdefault(own.path, int(raw["seconds"][0, 0]))
        raw = (raw["seconds"] - base) + raw["fraction"] * 2.0**-64
    target = sink.values[sink.filled : sink.filled + repeats * own.count]
    target.reshape(repeats, own.count)[...] = raw
    sink.filled += len(target)
    if sink.scale is not None:
        _apply(sink.scale, {own.scale: target})


def _apply(scale: Any, raw: Mapping[int, FloatArray]) -> None:
    """Put scaled values in the place of the first raw ones, some thousand at a time: they stay in the cache."""
    target = next(iter(raw.values()))
    for first in range(0, len(target), _SCALE_BLOCK):
        numbers = {number: values[first : first + _SCALE_BLOCK] for number, values in raw.items()}
        target[first : first + _SCALE_BLOCK] = scale.scale(_Raw(numbers.get(DAQMX), numbers))


def _scale(path: Path, name: str, index: TdmsIndex) -> Any:
    """Return the library's scale of a channel, None where it has none, or raise `ValueError` for an unknown one."""
    parts = path_parts(name)
    layers = [index.properties.get(key, {}) for key in (name, "/'" + parts[0].replace("'", "''") + "'", "/")]
    scales = {
        match[1]: str(value) for layer in layers for key, value in layer.items() if (match := _SCALE_KEY.fullmatch(key))
    }
    numbers = [int(layer["NI_Number_Of_Scales"]) for layer in layers if "NI_Number_Of_Scales" in layer]
    if not scales and not numbers:
        return None
    where = f'{path}: channel "{"/".join(parts)}"'
    for kind in scales.values():
        if kind not in (*_SCALES, "AdvancedAPI"):
            raise ValueError(f"{where}: expected a known scale, found {kind!r}")
    most = max([*map(int, scales), *numbers])
    if most > _MOST_SCALES:
        raise ValueError(f"{where}: expected at most {_MOST_SCALES} scales, found {most}")
    from nptdms.scaling import get_scaling

    return get_scaling(*layers)


def _starts(
    stream: BinaryIO, index: TdmsIndex, types: Mapping[str, np.dtype[Any]], wanted: Iterable[str]
) -> dict[str, float]:
    """Return by how many seconds every channel begins after the earliest of those wanted, from their time stamps."""
    stamps: dict[str, Fraction] = {}
    for name in wanted:
        stamp = index.properties.get(name, {}).get("wf_start_time")
        if types[name].names:
            stamps[name] = Fraction(_first_second(stream, index, name))
        elif isinstance(stamp, Fraction | int) and stamp > 0:  # 0 is the year 1904: no time was set
            stamps[name] = Fraction(stamp)
    earliest = min(stamps.values(), default=Fraction(0))
    return {name: round(float(stamp - earliest), 12) for name, stamp in stamps.items()}


def _first_second(stream: BinaryIO, index: TdmsIndex, name: str) -> int:
    """Return the whole seconds of a channel's first time stamp."""
    for region in index.regions:
        for own in region.fields:
            if own.path == name and own.count and region.repeats:
                stream.seek(region.position + own.offset)
                return int(np.frombuffer(stream.read(own.dtype.itemsize), own.dtype)["seconds"][0])
    return 0


def _clock(
    path: Path,
    name: str,
    properties: Mapping[str, Any],
    values: Mapping[str, FloatArray],
    time: str | None,
    sample_rate_hz: float | None,
) -> tuple[float, float]:
    """Return rate and start of a channel by its own properties, its time channel, or the rate given."""
    where = f'channel "{name}"'
    if time is not None:
        return rate_of_times(path, values[time], f'{where}: time channel "{path_parts(time)[-1]}"')
    step, start = properties.get("wf_increment"), properties.get("wf_start_offset", 0.0)
    return checked_rate(path, 1.0 / float(step) if step else sample_rate_hz, where), float(start)
