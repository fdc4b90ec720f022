"""`shakercal view`: recordings and stored results, opened on request."""

from __future__ import annotations

from collections.abc import Mapping
from functools import cached_property, lru_cache
from pathlib import Path
from threading import RLock

import numpy as np

from fusion.errors import ComputeError, InputError, as_input_error
from fusion.estimation.labelled_phasors import LabelledPhasors
from fusion.planning.check import read_as_command
from fusion.planning.look.data_checks import fit_trigger_channel
from fusion.planning.planning_notices import MANIFEST_NEWER, RESULTS_WITHOUT_RECORDING
from fusion.planning.view.extremes import Extremes
from fusion.planning.view.field_views import FieldViews
from fusion.planning.view.readable import ReadableRecording, StatedChannel, notice_of, read_recording, version_of
from fusion.planning.view.subset_views import SubsetViews
from fusion.planning.view.view_sources import ViewSource, result_names
from fusion.planning.view.viewed_pair import ViewedPair
from fusion.recording.daq_records import DaqRecord, FileCache, check_samples, check_uniform, recorded_channels
from fusion.recording.load import Manifest
from fusion.recording.recording_notices import UNREADABLE_DAQ_FILE
from fusion.report.folder import read_provenance
from fusion.report.labelled_results import read_results
from shaker.io import read_channels
from shaker.io.channel import RawChannel
from shaker.lines.spectrum import Spectrum, amplitude_spectrum
from shaker.timebase.trigger import TriggerFit
from shakercal._common.arrays import FloatArray
from shakercal._common.notices import Notice

MOST_LISTED = 20  # images of a camera whose errors are listed; each shows its own
MOST_EXAMINED = 100_000_000  # bytes of a recording that are examined when the page opens; `check` has no limit
ALONE = (".h5", ".hdf5", ".tdms")  # files of which single channels can be read


class ViewedRecording:
    """A recording with its readable images and channels; data are cached after the first reading.

    `version`: hash of recording.toml. `errors`: of the manifests, of results and of images.
    """

    def __init__(self, source: ViewSource, *, allow_outside: bool = False) -> None:
        self.path, self.results = source.recording, source.results
        self.version = version_of(self.path)
        self.readable: ReadableRecording = read_recording(self.path, allow_outside=allow_outside)
        self.errors = [notice_of(error, self.path) for error in self.readable.errors]
        self._check_results()
        pairs = [ViewedPair(stated, self.path) for stated in self.readable.images]
        self.pairs = [pair for pair in pairs if pair.cameras]
        for pair in self.pairs:
            for side, camera in pair.cameras.items():
                listed = list(camera.refused.values())[:MOST_LISTED]
                self.errors += [pair.notice(error, side) for error in listed]
        self.channels = self.readable.channels
        self._raw: dict[object, dict[str, RawChannel]] = {}
        self._extremes: dict[int, Extremes] = {}
        self._remarks: dict[int, dict[str, str] | None] = {}
        self._spectrum = lru_cache(maxsize=2)(self._make_spectrum)
        self._lock = RLock()

    def _check_results(self) -> None:
        """Refuse results of another recording; unreadable ones are not shown."""
        if self.results is None:
            return
        provenance, (name, _) = read_provenance(self.results, provenance_only=True), result_names(self.results)
        if name not in ("", self.readable.name):
            expected = f"those of “{self.readable.name}” ({self.path})"
            raise InputError(RESULTS_WITHOUT_RECORDING, self.results, found=f"results of “{name}”", expected=expected)
        if provenance is None:
            error = InputError(RESULTS_WITHOUT_RECORDING, self.results, found="damaged results", expected="results")
            self.errors.append(notice_of(error, self.path))
            self.results = None
        elif provenance.input_hashes and self.version not in provenance.input_hashes.values():
            notice = Notice(MANIFEST_NEWER, self.path.name)
            remedy = MANIFEST_NEWER.remedy or ""
            self.errors.append({"code": notice.code, "where": notice.where, "text": notice.text, "remedy": remedy})

    @property
    def manifest(self) -> Manifest:
        """The manifest; the first error of one that has any."""
        if self.readable.manifest is None:
            raise InputError.together(self.readable.errors)
        return self.readable.manifest

    def raw(self, number: int) -> RawChannel:
        """Return the samples of a channel in its unit.

        Other channels that are read in one step are cached.
        """
        channel = self.channels[number]
        if channel.file is None:
            key = f"daq.{channel.recorder}"
            listed = [one for one in self.readable.errors if one.key.startswith(key)]
            raise listed[0] if listed else ComputeError(UNREADABLE_DAQ_FILE, key, reason="no file")
        with self._lock:
            block = id(channel.block[1]) if channel.block is not None else channel.file
            cached = self._raw.setdefault(block, {})
            if channel.name not in cached:
                with as_input_error(self.path, f"daq.{channel.recorder}.file", UNREADABLE_DAQ_FILE):
                    cached |= self._read(channel, channel.file)
            return cached[channel.name]

    def _read(self, channel: StatedChannel, file: Path) -> dict[str, RawChannel]:
        """Read a channel and those read in the same step, times their scales."""
        alone = file.suffix.lower() in ALONE
        if channel.block is not None and channel.entry is not None:
            manifest, daq = channel.block
            daq = daq.model_copy(update={"channel": (channel.entry,)}) if alone else daq
            found, scales = recorded_channels(manifest, daq), {one.name: one.scale for one in daq.channel}
        else:
            own = [one for one in self.channels if one.file == file and (one.name == channel.name or not alone)]
            try:
                stored = read_channels(file, [one.stored_name for one in own], channel.rate_hz)
            except ValueError:  # another channel may be the missing one
                own = [channel]
                stored = read_channels(file, [channel.stored_name], channel.rate_hz)
            found = {one.name: stored[one.stored_name] for one in own}
            scales = {one.name: one.scale or 1.0 for one in own}
        for name, raw in found.items():
            if not len(raw.samples):
                raise ValueError(f"{name}: expected samples, found none")
        return {name: _scaled(raw, scales[name]) for name, raw in found.items()}

    def unit(self, number: int) -> str:
        """Return the unit of a channel: of its quantity, or of its file."""
        channel = self.channels[number]
        unscaled = channel.block is None and channel.scale is None and self.raw(number).unit
        return self.raw(number).unit if unscaled else channel.unit

    @cached_property
    def accelerations(self) -> Mapping[str, LabelledPhasors]:
        """Accelerations of the results by body and source, and the load."""
        if self.results is None:
            return {}
        found = read_results(self.results)
        return found.acceleration | ({} if found.load is None else {"load": found.load})

    @cached_property
    def subset_views(self) -> SubsetViews:
        """Its stereo pairs with their stored results."""
        return SubsetViews(self.pairs, self.results, self.frame_times, self.readable.frequencies_hz)

    @cached_property
    def field_views(self) -> FieldViews:
        """The fields of its results."""
        return FieldViews(self.subset_views, self.results)

    def frame_times(self, pair: ViewedPair) -> FloatArray | None:
        """Return the times of a pair's frames by their trigger alone.

        None if it is not periodic.
        """
        block = pair.stated.manifest
        for number, channel in enumerate(self.channels):
            if channel.name != pair.stated.trigger or channel.entry is None or channel.block is None:
                continue
            if channel.block[1] not in (() if block is None else block.daq):
                continue
            try:
                record = DaqRecord(channel.block[1], {channel.name: self.raw(number)}, 0.0)
                fit = fit_trigger_channel(record, channel.entry)
            except (ComputeError, InputError, OSError, ValueError):
                return None
            return np.asarray(fit.period_s * np.arange(len(pair.frames))) if isinstance(fit, TriggerFit) else None
        return None

    def extremes(self, number: int) -> Extremes:
        """Return the extremes of a channel, computed once."""
        with self._lock:
            if number not in self._extremes:
                self._extremes[number] = Extremes(self.raw(number).samples)
            return self._extremes[number]

    def remark(self, number: int) -> dict[str, str] | None:
        """Return why a run refuses the samples of a channel, examined once."""
        with self._lock:
            if number not in self._remarks:
                self._remarks[number] = self._examine(number)
            return self._remarks[number]

    def _examine(self, number: int) -> dict[str, str] | None:
        channel, manifest, raw = self.channels[number], self.readable.manifest, self.raw(number)
        gaps = channel.quantity != "trigger" and (manifest is None or manifest.excitation.slowest_hz is not None)
        try:
            check_samples(channel.file or self.path, channel.stored_name, raw, channel.quantity, gaps=gaps)
            check_uniform(channel.file or self.path, channel.stored_name, raw)
        except InputError as error:
            return notice_of(error, self.path)
        return None

    @cached_property
    def refusals(self) -> list[dict[str, str]]:
        """Reasons why the recording's command refuses its data.

        Data of more than some size are not examined.
        """
        manifest, found = self.readable.manifest, list[Exception]()
        files = set(manifest.files) if manifest is not None else {one.file for one in self.channels if one.file}
        if sum(file.stat().st_size for file in files if file.is_file()) > MOST_EXAMINED:
            return []
        try:
            if manifest is not None:
                read_as_command(manifest, FileCache())
        except InputError as error:
            found += error.each
        except (ComputeError, OSError) as error:
            found.append(error)
        for number, channel in enumerate(self.channels) if manifest is None else ():
            try:
                self.raw(number) if channel.file is not None else None
            except (InputError, ComputeError, OSError, ValueError) as error:
                found.append(error)
        return [notice_of(error, self.path) for error in found]

    def spectrum(self, number: int) -> Spectrum:
        """Return the whole amplitude spectrum of a channel; lost samples are replaced by the mean."""
        with self._lock:
            return self._spectrum(number)

    def _make_spectrum(self, number: int) -> Spectrum:
        raw = self.raw(number)
        finite = np.isfinite(raw.samples)
        samples = raw.samples if finite.all() else np.where(finite, raw.samples, raw.samples[finite].mean())
        return amplitude_spectrum(samples, raw.sample_rate_hz)


def _scaled(raw: RawChannel, scale: float) -> RawChannel:
    samples: FloatArray = raw.samples if scale == 1.0 else np.asarray(scale * raw.samples)
    return RawChannel(samples, raw.sample_rate_hz, raw.start_s, raw.unit, raw.stamp_s)


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

    def renewed(self, query: Mapping[str, str]) -> ViewedRecording:
        """Return the recording of a query, read anew if its recording.toml has changed."""
        with self.lock:
            found = self.recording(query)
            if found.version != version_of(found.path):
                self._cached.cache_clear()
                found = self.recording(query)
            return found
