"""Values that several channels share: defaults of a daq block, instruments of a laboratory's library."""

from __future__ import annotations

import os
from collections import Counter
from collections.abc import Collection, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, ClassVar, Literal

from pydantic import BeforeValidator

from fusion.errors import InputError
from fusion.recording.recording_notices import UNKNOWN_NAME
from fusion.recording.toml import UNFILLED, expand_statements, key_path, read_toml, validate
from fusion.recording.values import (
    Angle,
    Context,
    Delay,
    ExistingFile,
    ManifestBlock,
    NotNegative,
    Number,
    PathScope,
    Share,
    Text,
    Uncertainty3,
    describe,
)

LIBRARY_NAME = "instruments.toml"
HIGHEST = 4  # folders above rig.toml that may have the library of a laboratory
FILES = ("response", "dcc")  # keys of files, which start at the folder of the library


class ChannelDefaults(ManifestBlock):
    """Values of the channels of a block that do not state them.

    Triggers take none. A channel takes only the keys that its quantity permits.
    """

    body: Literal["load", "base", "room", "head"] | None = None
    head: Text | None = None
    point_uncertainty: Uncertainty3 | None = None
    direction_uncertainty: Angle | None = None
    scale: Number | None = None
    scale_uncertainty: Share | None = None
    common: Text | None = None
    individual_uncertainty: Share | None = None
    transverse_sensitivity: Share | None = None
    delay: Delay | None = None
    delay_uncertainty: NotNegative | None = None
    delay_of: Literal["pure", "filter"] | None = None
    response: ExistingFile | None = None
    response_result: Text | None = None


def _tuple_of_list(value: object) -> object:
    return tuple(value) if isinstance(value, list) else value


class Instrument(ChannelDefaults):
    """An instrument of the library: values of its channels, and texts about it.

    `names`: words of channel names by which `shakercal init` finds it.
    """

    quantity: Text | None = None
    serial: Text | None = None
    certificate: Text | None = None
    names: Annotated[tuple[Text, ...], BeforeValidator(_tuple_of_list)] = ()

    TEXTS: ClassVar[tuple[str, ...]] = ("serial", "certificate", "names")


class InstrumentLibrary(ManifestBlock):
    """instruments.toml: instruments by name."""

    instrument: dict[Text, Instrument]


@dataclass(frozen=True)
class Library:
    """Instruments of a file by name, as written there, with the models."""

    path: Path
    values: dict[str, dict[str, Any]]
    instruments: dict[str, Instrument]


def find_library(rig: Path) -> Library | None:
    """Return the library in the folder of rig.toml, or in one above it."""
    folder = rig.absolute().parent
    places = [folder, *folder.parents][: HIGHEST + 1]
    path = next((place / LIBRARY_NAME for place in places if (place / LIBRARY_NAME).is_file()), None)
    if path is None:
        return None
    text = read_toml(path)
    scope = PathScope(path.parent, path.parent, of="of the library")
    # References to certificates are resolved where a channel takes them.
    plain = _without_references(text)
    checked = validate(InstrumentLibrary, expand_statements(plain, path)[0], path, Context(scope))
    return Library(path, text.get("instrument", {}), checked.instrument)


def _without_references(value: Any) -> Any:
    """Return values without tables that refer to a certificate."""
    if not isinstance(value, dict):
        return value
    return {k: _without_references(v) for k, v in value.items() if not (isinstance(v, dict) and "dcc" in v)}


def complete_channels(
    text: dict[str, Any], path: Path, rig: Path, quantities: Mapping[str, Collection[str]]
) -> tuple[dict[str, Any], tuple[Path, ...]]:
    """Return recording.toml with the values that channels share, and the library if one is used.

    `quantities`: the keys that a channel of each quantity may have. A value of the channel comes first, then that of
    its instrument, then the default of its block. Channels of one instrument are `common`.
    """
    blocks = [block for block in _daq_blocks(text) if isinstance(block.get("channel"), list)]
    used = Counter(entry.get("instrument") for block in blocks for entry in block["channel"] if isinstance(entry, dict))
    del used[None]
    library = find_library(rig) if used else None
    completed: dict[int, dict[str, Any]] = {}
    for block in blocks:
        own = block.get("defaults", {})
        channels = []
        for entry in block["channel"]:
            if not isinstance(entry, dict):
                channels.append(entry)
                continue
            shared = dict(own) if isinstance(own, dict) else {}
            shared |= _of_instrument(entry, library, path, text, used)
            quantity = entry.get("quantity", shared.get("quantity"))
            permitted = {*quantities.get(str(quantity), ()), "quantity"} if quantity != "trigger" else {"quantity"}
            taken = {k: v for k, v in shared.items() if k in permitted and v != UNFILLED}
            channels.append({**taken, **entry})
        completed[id(block)] = {**block, "channel": channels}
    return _with_blocks(text, completed), () if library is None else (library.path,)


def _with_blocks(text: dict[str, Any], completed: dict[int, dict[str, Any]]) -> dict[str, Any]:
    """Return a recording or take with daq blocks replaced by their identity."""
    if isinstance(text.get("daq"), list):
        text = {**text, "daq": [completed.get(id(block), block) for block in text["daq"]]}
    if isinstance(text.get("take"), list):
        takes = (_with_blocks(take, completed) if isinstance(take, dict) else take for take in text["take"])
        text = {**text, "take": list(takes)}
    return text


def without_defaults(text: dict[str, Any]) -> dict[str, Any]:
    """Return recording.toml without the defaults of its blocks, whose values its channels have."""
    if isinstance(text.get("daq"), list):
        text = {**text, "daq": [_no_defaults(block) for block in text["daq"]]}
    if isinstance(text.get("take"), list):
        text = {**text, "take": [without_defaults(take) if isinstance(take, dict) else take for take in text["take"]]}
    return text


def _no_defaults(block: Any) -> Any:
    return {k: v for k, v in block.items() if k != "defaults"} if isinstance(block, dict) else block


def _daq_blocks(text: dict[str, Any]) -> Iterator[dict[str, Any]]:
    """Yield the daq blocks of a recording and of its takes."""
    takes = text.get("take", [])
    for place in (text, *(takes if isinstance(takes, list) else [])):
        blocks = place.get("daq", []) if isinstance(place, dict) else []
        yield from (block for block in (blocks if isinstance(blocks, list) else []) if isinstance(block, dict))


def _of_instrument(
    entry: dict[str, Any], library: Library | None, path: Path, text: dict[str, Any], used: Counter[Any]
) -> dict[str, Any]:
    """Return the values of a channel's instrument; files start at the folder of the recording."""
    name = entry.get("instrument")
    if name is None:
        return {}
    available = {} if library is None else library.values
    if library is None or not isinstance(name, str) or name not in available:
        found = f"{describe(name)}; {'there is no ' + LIBRARY_NAME if library is None else ', '.join(available)}"
        expected = f"the name of an instrument of {LIBRARY_NAME}, next to rig.toml or in a folder above it"
        where: list[int | str] = next(
            (
                ["daq", i, "channel", j, "instrument"]
                for i, block in enumerate(text.get("daq", []))
                for j, other in enumerate(block.get("channel", []) if isinstance(block, dict) else [])
                if other is entry
            ),
            ["take"],
        )
        raise InputError(UNKNOWN_NAME, path, key_path(text, where), found=found, expected=expected)
    values = {k: v for k, v in available[name].items() if k not in Instrument.TEXTS}
    if used[name] > 1:
        values.setdefault("common", name)
    moved = _moved(values, library.path.parent, path.absolute().parent)
    return dict(moved) if isinstance(moved, dict) else {}


def _moved(value: Any, start: Path, folder: Path, key: str = "") -> Any:
    """Return values with paths relative to another folder."""
    if isinstance(value, dict):
        return {k: _moved(v, start, folder, k) for k, v in value.items()}
    if key in FILES and isinstance(value, str):
        return Path(os.path.relpath(start / value, folder)).as_posix()
    return value
