"""Universal file format: time responses of data set 58, text and binary."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from shaker.signals.files.common import checked_rate, chosen, numbers
from shaker.signals.recording import RawChannel

_TIME_RESPONSE = 1  # function type of data set 58
_DIRECTIONS = {0: "", 1: "+X", -1: "-X", 2: "+Y", -2: "-Y", 3: "+Z", -3: "-Z"}
_DIRECTIONS |= {4: "+RX", -4: "-RX", 5: "+RY", -5: "-RY", 6: "+RZ", -6: "-RZ"}
_NOTHING = ("", "NONE", "none")


def read_universal(path: Path, names: Sequence[str] | None, sample_rate_hz: float | None) -> dict[str, RawChannel]:
    """Read the time responses of a universal file.

    A channel is called by its response entity name (`rsp_ent_name`) where it has one, else by the label of its
    ordinate, else by node and direction (`12+Z`); names that occur twice get node and direction after them
    (`Mic 3+X`), and where these do not tell them apart either, the place in the file (`Mic #2`). Its unit is the
    ordinate's units label. Data sets of other kinds are passed over. Text headers hold the sampling interval with
    six digits, so a clock read from them may be wrong by several parts in 10⁷; the trigger edges put that right.
    """
    import pyuff

    if not path.read_bytes()[-1024:].rstrip().endswith(b"-1"):
        raise ValueError(f"{path}: expected the end mark -1 of the last data set, found the file cut off")
    file = pyuff.UFF(str(path))
    kinds = [int(kind) for kind in file.get_set_types()]
    if not kinds:
        raise ValueError(f"{path}: expected data sets of a universal file, found none")
    sets = [file.read_sets(i) for i, kind in enumerate(kinds) if kind == 58]
    records = {name: record for name, record in _named(sets).items() if record["func_type"] == _TIME_RESPONSE}
    wanted = chosen(path, names, records)
    return {name: _channel(path, name, records[name], sample_rate_hz) for name in wanted}


def _named(sets: list[dict[str, Any]]) -> dict[str, dict[str, Any]]:
    """Return the data sets by unique names."""
    plain = [_plain_name(record) for record in sets]
    full = [
        name if plain.count(name) == 1 else f"{name} {_point(record)}".strip()
        for name, record in zip(plain, sets, strict=True)
    ]
    return {
        name if full.count(name) == 1 else f"{name} #{i + 1}": record
        for i, (name, record) in enumerate(zip(full, sets, strict=True))
    }


def _plain_name(record: dict[str, Any]) -> str:
    """Return the entity name, the ordinate's label, or node and direction."""
    for key in ("rsp_ent_name", "ordinate_axis_lab"):
        text = str(record.get(key, "")).strip()
        if text not in _NOTHING:
            return text
    return _point(record)


def _point(record: dict[str, Any]) -> str:
    """Return response node and direction, as 12+Z."""
    return f"{int(record['rsp_node'])}{_DIRECTIONS.get(int(record['rsp_dir']), '')}"


def _channel(path: Path, name: str, record: dict[str, Any], sample_rate_hz: float | None) -> RawChannel:
    """Turn one data set into a channel."""
    step = float(record.get("abscissa_inc", 0.0))
    if not step and len(record["x"]) > 1:
        step = float(record["x"][-1] - record["x"][0]) / (len(record["x"]) - 1)
    unit = str(record.get("ordinate_axis_units_lab", "")).strip()
    expected = int(record["num_pts"])
    samples = numbers(path, name, record["data"])
    if len(samples) != expected:
        raise ValueError(f'{path}: channel "{name}": expected {expected} samples, found {len(samples)}')
    return RawChannel(
        samples,
        checked_rate(path, 1.0 / step if step else sample_rate_hz, f'channel "{name}"'),
        float(record.get("abscissa_min", 0.0)),
        "" if unit in _NOTHING else unit,
    )
