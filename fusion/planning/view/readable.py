"""Readable parts of a recording whose manifest has errors: images, channels, errors."""

from __future__ import annotations

import hashlib
import re
import tomllib
from collections.abc import Iterator, Mapping
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, TypeGuard

from pydantic import ValidationError

from fusion.errors import ComputeError, InputError
from fusion.recording.load import Manifest, load_manifest
from fusion.recording.manifest import ChannelEntry, Daq, Images
from fusion.recording.recording_notices import INVALID_SYNTAX, WRONG_ENCODING
from fusion.recording.rig import OTHER_UNITS, Stereo
from fusion.recording.toml import LARGEST_TOML, expand_statements, read_toml
from fusion.recording.transducer import TRANSDUCERS
from fusion.recording.values import Context, Outline, PathScope, outline, outlines

MOST_LINES = 20  # of a manifest that are left out because they are no TOML


@dataclass(frozen=True)
class StatedImages:
    """An `[[images]]` block as stated.

    `place`: of the block among those of its set-up, and the number of that, 0 for the top level. `files`: of each
    camera by its key, empty without any. `entry`, `manifest`: of a recording without errors. `pair`: of the rig.
    """

    name: str
    stereo: str
    place: tuple[int, int]
    files: Mapping[str, tuple[Path, ...]]
    bit_depth: int | None
    trigger: str
    region: Outline | None = None
    mask: tuple[Outline, ...] = ()
    pair: Stereo | None = None
    entry: Images | None = None
    manifest: Manifest | None = None


@dataclass(frozen=True)
class StatedChannel:
    """A channel as stated; `scale` is None where none is stated.

    `block`: the set-up and the DAQ block of a recording without errors, `entry` its channel.
    """

    recorder: str
    name: str
    stored_name: str
    quantity: str
    unit: str
    scale: float | None
    file: Path | None
    rate_hz: float | None = None
    block: tuple[Manifest, Daq] | None = None
    entry: ChannelEntry | None = None


@dataclass(frozen=True)
class ReadableRecording:
    """Readable parts of a recording, and its errors.

    `manifest` is None if there are any.
    """

    name: str
    manifest: Manifest | None
    images: tuple[StatedImages, ...]
    channels: tuple[StatedChannel, ...]
    frequencies_hz: tuple[float, ...]
    errors: tuple[InputError, ...] = field(default=())


def read_recording(path: Path, *, allow_outside: bool = False) -> ReadableRecording:
    """Return a recording; with errors of its manifests, what its text states."""
    try:
        manifest = load_manifest(path, allow_outside)
    except InputError as error:
        return _Text(path, allow_outside=allow_outside).recording(error.each)
    images, channels = list[StatedImages](), list[StatedChannel]()
    for number, (where, block) in enumerate(manifest.set_ups):
        take = number + (manifest.set_ups[0][0] != "")
        for place, entry in enumerate(block.images):
            named, files = (f"{where}{entry.stereo}", entry.stereo, (take, place)), dict(entry.cameras)
            drawn = entry.region, entry.mask, manifest.rig.stereo[entry.stereo]
            images.append(StatedImages(*named, files, entry.bit_depth, entry.trigger, *drawn, entry, block))
        channels += [_stated_channel(block, daq, entry) for daq in block.daq for entry in daq.channel]
    lines = tuple(manifest.excitation.frequencies or ())
    return ReadableRecording(manifest.name, manifest, tuple(images), tuple(channels), lines)


def _stated_channel(block: Manifest, daq: Daq, entry: ChannelEntry) -> StatedChannel:
    unit = "" if entry.quantity == "trigger" else block.rig.unit_of(entry.quantity)
    scale = entry.scale if "scale" in entry.model_fields_set else None
    names = daq.name, entry.name, entry.stored_name
    return StatedChannel(*names, entry.quantity, unit, scale, daq.file, daq.sample_rate, (block, daq), entry)


class _Text:
    """The text of a recording with errors, of which every block is read by itself."""

    def __init__(self, path: Path, *, allow_outside: bool) -> None:
        self._folder = path.parent.resolve()
        self._text = _values(path)
        named = self._text.get("rig")
        rig = self._folder / named if isinstance(named, str) and "\0" not in named else path
        self._rig = _values(rig) if rig.is_file() and rig != path else {}
        root = rig.resolve().parent if self._rig else self._folder
        inside = allow_outside or self._folder.is_relative_to(root)
        self._scope = PathScope(self._folder, root if inside else self._folder, allow_outside)
        self._rig_scope = PathScope(root, root, allow_outside)

    def recording(self, errors: tuple[InputError, ...]) -> ReadableRecording:
        """Return the parts."""
        images, channels = list[StatedImages](), list[StatedChannel]()
        set_ups = [self._text, *_tables(self._text, "take")]
        for take, block in enumerate(set_ups):
            where = f"take[{take}]." if take else ""
            images += [self._images(where, (take, n), one) for n, one in enumerate(_tables(block, "images"))]
            channels += [one for daq in _tables(block, "daq") for one in self._channels(daq)]
        listed = next(_tables({"one": [self._text.get("excitation")]}, "one"), {}).get("frequencies")
        lines = [float(hz) for hz in listed if _is_number(hz)] if isinstance(listed, list) else []
        name = self._text.get("name")
        shown = name if isinstance(name, str) else self._folder.name
        return ReadableRecording(shown, None, tuple(images), tuple(channels), tuple(lines), errors)

    def _images(self, where: str, place: tuple[int, int], block: dict[str, Any]) -> StatedImages:
        stereo = str(block.get("stereo", ""))
        stated = self._rig.get("stereo")
        pair = stated.get(stereo) if isinstance(stated, dict) else None
        pair = pair if isinstance(pair, dict) else {}
        bits = block.get("bit_depth", pair.get("bit_depth"))
        return StatedImages(
            f"{where}{stereo or f'images {place[1] + 1}'}",
            stereo,
            place,
            {side: self._files(block[side]) for side in ("left", "right") if isinstance(block.get(side), str)},
            bits if type(bits) is int and 1 <= bits <= 16 else None,
            str(block.get("trigger", "")),
            _checked(outline, block.get("region")),
            _checked(outlines, block.get("mask")) or (),
            self._pair(pair),
        )

    def _files(self, text: str) -> tuple[Path, ...]:
        return _checked(self._scope.files, text) or ()

    def _pair(self, stated: dict[str, Any]) -> Stereo | None:
        try:
            return Stereo.model_validate(stated, context=Context(self._rig_scope))
        except ValidationError:
            return None

    def _channels(self, daq: dict[str, Any]) -> Iterator[StatedChannel]:
        file, rate = daq.get("file"), daq.get("sample_rate")
        path = _checked(self._scope.file, file) if isinstance(file, str) else None
        sensor = self._rig.get("sensor")
        units = {name: one.unit for name, one in TRANSDUCERS.items()} | OTHER_UNITS
        units["output"] = str(sensor.get("unit", "1")) if isinstance(sensor, dict) else ""
        for entry in _tables(daq, "channel"):
            name, quantity = str(entry.get("name", "")), str(entry.get("quantity", ""))
            scale = entry.get("scale")
            yield StatedChannel(
                str(daq.get("name", "")),
                name,
                str(entry.get("in_file", name)),
                quantity,
                units.get(quantity, ""),
                float(scale) if _is_number(scale) and scale else None,
                path,
                float(rate) if _is_number(rate) and rate > 0 else None,
            )


def _is_number(value: object) -> TypeGuard[float]:
    return isinstance(value, int | float) and not isinstance(value, bool)


def _checked(check: Any, value: Any) -> Any:
    """Return a checked value, None for a refused one."""
    try:
        return None if value is None else check(value)
    except (OSError, ValueError):
        return None


def _tables(values: Mapping[str, Any], key: str) -> Iterator[dict[str, Any]]:
    """Yield the tables in a list at a key."""
    found = values.get(key)
    yield from (one for one in found if isinstance(one, dict)) if isinstance(found, list) else ()


def _values(path: Path) -> dict[str, Any]:
    """Return the values of a TOML file; lines that are no TOML are left out."""
    try:
        text = read_toml(path)
        with suppress(InputError):
            text = expand_statements(text, path)[0]
        return text
    except InputError as error:
        if error.declared not in (INVALID_SYNTAX, WRONG_ENCODING) or path.stat().st_size > LARGEST_TOML:
            return {}
    lines = path.read_bytes().decode("utf-8-sig", errors="replace").splitlines()
    for _ in range(MOST_LINES):
        try:
            return tomllib.loads("\n".join(lines))
        except RecursionError:
            return {}
        except ValueError as error:
            at = re.search(r"line (\d+)", str(error))
            if at is None or not 1 <= int(at[1]) <= len(lines):
                return {}
            lines[int(at[1]) - 1] = ""
    return {}


def version_of(recording: Path) -> str:
    """Return the hash of a recording.toml, empty without a file."""
    try:
        return hashlib.sha256(recording.read_bytes()).hexdigest()
    except OSError:
        return ""


# Errors as the page shows them.


def notice_of(error: Exception, file: Path, key: str = "") -> dict[str, str]:
    """Return code, place, sentence and remedy of an error, with paths from the recording's folder."""
    found = error if isinstance(error, InputError | ComputeError) else InputError.from_exception(error, file, key)
    folder = f"{file.parent.resolve()}/"
    if isinstance(found, InputError):
        where = f"{found.file}: {found.key}" if found.key else str(found.file)
    else:
        where = found.where
    text = found.sentence.replace(folder, "")
    where = where.replace(f"{file.parent}/", "").replace(folder, "")
    remedy = found.declared.remedy or ""
    return {"code": found.code, "where": where, "text": text, "remedy": remedy}
