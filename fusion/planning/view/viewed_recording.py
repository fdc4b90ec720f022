"""Recordings of `shakercal view` with their results, opened on request."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property, lru_cache
from pathlib import Path
from threading import RLock
from typing import Any

import numpy as np

from fusion.errors import InputError
from fusion.estimation.labelled_phasors import LabelledPhasors
from fusion.phasors.stereo_motion import read_rig
from fusion.planning.planning_notices import RESULTS_WITHOUT_RECORDING
from fusion.planning.view.extremes import Extremes
from fusion.recording.daq_records import check_uniform, recorded_channels
from fusion.recording.load import Manifest, find_recordings, load_manifest
from fusion.recording.manifest import ChannelEntry, Daq, Images
from fusion.report.folder import RESULT_FILE
from fusion.report.h5 import open_results
from fusion.report.labelled_results import CAMPAIGN_FILE, read_results
from photogram.camera import Rig
from photogram.images.image_files import open_sequence
from photogram.images.sequence import ImageSequence
from shaker.io.channel import RawChannel

DEFAULT_RESULTS = "results"
DARKEST, BRIGHTEST = 0.001, 0.999  # quantiles of the first image that are displayed as black and white
ALONE = (".h5", ".hdf5", ".tdms")  # files of which single channels can be read


@dataclass(frozen=True)
class ViewSource:
    """A recording to view: its recording.toml and the folder of its results, or None."""

    recording: Path
    results: Path | None


def find_sources(path: Path, recording: Path | None = None) -> list[ViewSource]:
    """Return the recordings of a folder of recordings or results.

    `recording`: where the recordings of the results are.
    """
    if not any((path / name).is_file() for name in (RESULT_FILE, CAMPAIGN_FILE)):
        found = find_recordings(path)
        top = found[0].parent if len(found) == 1 and found[0].parent.name == path.resolve().name else path
        return [ViewSource(one, _results_of(one, top / DEFAULT_RESULTS)) for one in found]
    resolved = path.resolve()
    nearby = [resolved.parent, resolved.parent.parent / resolved.name, resolved.parent.parent]
    for candidate in [recording] if recording else nearby:
        try:
            found = find_recordings(candidate)
        except InputError:
            if recording:
                raise
            continue
        if (path / RESULT_FILE).is_file():
            named = [one for one in found if one.parent.name == resolved.name]
            found = named or found[:1]
        with_results = [ViewSource(one, _results_of(one, path)) for one in found]
        if any(one.results for one in with_results):
            return with_results
    expected = "--recording, the recording of these results"
    raise InputError(RESULTS_WITHOUT_RECORDING, path, found="none near them", expected=expected)


def _results_of(recording: Path, results: Path) -> Path | None:
    """Return the folder of a recording's results: the given one or one below."""
    below = results / recording.resolve().parent.name
    return next((folder for folder in (below, results) if (folder / RESULT_FILE).is_file()), None)


@dataclass(frozen=True)
class ViewedPair:
    """A stereo pair's images in one set-up of a recording."""

    name: str
    manifest: Manifest
    entry: Images

    @cached_property
    def sequences(self) -> tuple[ImageSequence, ...]:
        """Images of the left and the right camera, or of a single one."""
        return tuple(open_sequence(paths, self.entry.bit_depth) for _, paths in self.entry.cameras)

    @cached_property
    def rig(self) -> Rig:
        """The calibrated cameras."""
        return read_rig(self.manifest.rig.stereo[self.entry.stereo], self.sequences)

    @cached_property
    def shades(self) -> tuple[np.typing.NDArray[np.uint8], ...]:
        """Displayed shade of each grey value, for each camera."""
        return tuple(_shades(images) for images in self.sequences)

    def image_bytes(self, side: int, frame: int) -> bytes:
        """Return the grey values of an image as bytes, row by row."""
        images = self.sequences[side]
        if not 0 <= frame < len(images):
            raise ValueError(f"frame: expected 0 to {len(images) - 1}, found {frame}")
        return bytes(self.shades[side][images.read(frame)].tobytes())


def _shades(images: ImageSequence) -> np.typing.NDArray[np.uint8]:
    """Return the shade (G,) of every possible grey value.

    Shades are stretched to the range of the first image.
    """
    low, high = np.quantile(images.read(0), (DARKEST, BRIGHTEST))
    grey = np.arange(1 << (8 if images.full_scale < 256 else 16))
    return np.asarray(np.clip((grey - low) * (255.0 / max(high - low, 1.0)), 0, 255), dtype=np.uint8)


@dataclass(frozen=True)
class ViewedChannel:
    """A channel of a recorder: its block and entry, and its unit after scaling."""

    daq: Daq
    entry: ChannelEntry
    unit: str


class ViewedRecording:
    """A recording with manifest, images and channels; data are cached after the first reading."""

    def __init__(self, source: ViewSource, *, allow_outside: bool = False) -> None:
        self.source = source
        self.manifest = load_manifest(source.recording, allow_outside)
        if source.results is not None:
            with open_results(source.results / RESULT_FILE) as file:
                name = str(file.attrs.get("recording", ""))
            if name != self.manifest.name:
                expected = f"those of “{self.manifest.name}” ({source.recording})"
                found = f"results of “{name}”"
                raise InputError(RESULTS_WITHOUT_RECORDING, source.results, found=found, expected=expected)
        self.pairs = [
            ViewedPair(f"{where}{entry.stereo}", block, entry)
            for where, block in self.manifest.set_ups
            for entry in block.images
        ]
        self.channels = [
            ViewedChannel(daq, entry, "" if entry.quantity == "trigger" else block.rig.unit_of(entry.quantity))
            for _, block in self.manifest.set_ups
            for daq in block.daq
            for entry in daq.channel
        ]
        self._raw: dict[int, dict[str, RawChannel]] = {}
        self._extremes: dict[int, Extremes] = {}
        self._lock = RLock()

    def raw(self, number: int) -> RawChannel:
        """Return the samples of a channel as in its file.

        Other channels that are read in one step are cached.
        """
        channel = self.channels[number]
        daq, name = channel.daq, channel.entry.name
        with self._lock:
            cached = self._raw.setdefault(id(daq), {})
            if name not in cached:
                alone = daq.file.suffix.lower() in ALONE
                block = daq.model_copy(update={"channel": (channel.entry,)}) if alone else daq
                cached |= recorded_channels(self.manifest, block)
            check_uniform(daq.file, channel.entry.stored_name, cached[name])
            return cached[name]

    @cached_property
    def accelerations(self) -> Mapping[str, LabelledPhasors]:
        """Accelerations of the results by body and source, and the load."""
        if self.source.results is None:
            return {}
        found = read_results(self.source.results)
        return found.acceleration | ({} if found.load is None else {"load": found.load})

    def extremes(self, number: int) -> Extremes:
        """Return the extremes of a channel, computed once."""
        with self._lock:
            if number not in self._extremes:
                self._extremes[number] = Extremes(self.raw(number).samples)
            return self._extremes[number]

    def description(self) -> Mapping[str, Any]:
        """Return the data that the page needs first."""
        pairs = []
        for number, pair in enumerate(self.pairs):
            sizes = [list(images.size_px) for images in pair.sequences]
            frames = min(map(len, pair.sequences))
            files = [[Path(name).name for name in images.names] for images in pair.sequences]
            pairs.append({"number": number, "name": pair.name, "frames": frames, "sizes": sizes, "files": files})
        channels = [
            {"name": one.entry.name, "daq": one.daq.name, "quantity": one.entry.quantity, "unit": one.unit}
            for one in self.channels
        ]
        lines = list(self.manifest.excitation.frequencies or ())
        return {"name": self.manifest.name, "pairs": pairs, "channels": channels, "lines": lines}


class ViewSession:
    """All recordings of a page."""

    def __init__(self, sources: list[ViewSource], *, allow_outside: bool = False) -> None:
        self.sources = sources
        self.allow_outside = allow_outside
        self.lock = RLock()
        self._cached = lru_cache(maxsize=2)(self._load)

    def _load(self, number: int) -> ViewedRecording:
        return ViewedRecording(self.sources[number], allow_outside=self.allow_outside)

    def recording(self, query: Mapping[str, str]) -> ViewedRecording:
        """Return the recording of a query; the last two remain open."""
        number = int(query.get("recording", "0"))
        if not 0 <= number < len(self.sources):
            raise ValueError(f"recording: expected 0 to {len(self.sources) - 1}, found {number}")
        with self.lock:
            return self._cached(number)
