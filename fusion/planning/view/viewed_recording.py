"""`shakercal view`: recordings and stored results, opened on request."""

from __future__ import annotations

import json
import warnings
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property, lru_cache
from pathlib import Path
from threading import RLock
from typing import Any

import numpy as np

from fusion.errors import InputError
from fusion.estimation.labelled_phasors import LabelledPhasors
from fusion.phasors.stereo_motion import read_rig, sensor_from_camera
from fusion.planning.look.data_checks import fit_trigger_channel
from fusion.planning.planning_notices import RESULTS_WITHOUT_RECORDING
from fusion.recording.daq_records import DaqRecord, check_uniform, recorded_channels
from fusion.recording.load import Manifest, find_recordings, load_manifest
from fusion.recording.manifest import ChannelEntry, Daq, Images
from fusion.report.folder import RESULT_FILE
from fusion.report.h5 import open_results
from fusion.report.labelled_results import CAMPAIGN_FILE, read_results
from fusion.report.page_images import neighbour_distance
from fusion.report.recording_report import POINT_COLUMNS
from photogram.camera import Rig, StereoRig
from photogram.geometry import rotation_from_vector
from photogram.images.image_files import open_sequence
from photogram.images.sequence import ImageSequence
from shaker.io.channel import RawChannel
from shaker.labels import AXES
from shaker.lines.spectrum import amplitude_spectrum
from shaker.timebase.trigger import TriggerFit
from shakercal._common.arrays import FloatArray, IntArray

FINEST = 64  # samples of the smallest block
COARSER = 8  # blocks in one of the next level
PARTS = 8  # least number of blocks of a column: its ends are exact within an eighth
PLAIN = 2  # samples per column up to which the samples are returned


@dataclass(frozen=True)
class ExtremeColumns:
    """Extremes of consecutive samples in columns.

    Column i is from `edge[i]` to `edge[i + 1]` (I + 1,), exclusive. `low`, `high` (I,): its smallest and largest
    sample.
    """

    edge: IntArray
    low: FloatArray
    high: FloatArray


class Extremes:
    """Smallest and largest samples of the blocks of one channel, level by level.

    They need 1/28 of its memory.

    >>> import numpy as np
    >>> found = Extremes(np.sin(np.arange(100_000.0))).columns(0, 100_000, 50)
    >>> len(found.low), round(float(found.high.min()), 3)
    (49, 1.0)
    """

    def __init__(self, samples: FloatArray) -> None:
        self.samples = samples
        self.levels: list[tuple[int, FloatArray, FloatArray]] = []
        low, high, block = samples, samples, FINEST
        factor = FINEST
        while len(low) > factor:
            first = np.arange(0, len(low), factor)
            low, high = np.minimum.reduceat(low, first), np.maximum.reduceat(high, first)
            self.levels.append((block, low, high))
            factor, block = COARSER, block * COARSER

    def columns(self, first: int, last: int, most: int) -> ExtremeColumns:
        """Return the extremes of samples `first` to `last` (exclusive) in at most `most` columns.

        Columns end at the ends of blocks. The outermost ones may extend beyond, by less than a column.
        """
        first = min(max(first, 0), len(self.samples) - 1)
        last = min(max(last, first + 1), len(self.samples))
        width = (last - first) / most
        if width <= PLAIN:
            plain = self.samples[first:last]
            return ExtremeColumns(np.arange(first, last + 1), plain, plain)
        block, low, high = 1, self.samples, self.samples
        for level in self.levels:
            if level[0] * PARTS <= width:
                block, low, high = level
        begin, end = first // block, -(-last // block)
        each = -(-(end - begin) // most)
        starts = np.arange(begin, end, each)
        edge = np.append(starts, end) * block
        part = slice(begin, end)
        lowest = np.minimum.reduceat(low[part], starts - begin)
        highest = np.maximum.reduceat(high[part], starts - begin)
        return ExtremeColumns(np.minimum(edge, len(self.samples)), lowest, highest)


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

    @cached_property
    def subset_views(self) -> SubsetViews:
        """Its stereo pairs with their stored results."""
        return SubsetViews(self)

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


NO_RESULTS = "Subsets, residuals and tracks require results of shakercal run."
LINES_ONLY = (
    "Subsets are at the positions of the rigid motion. The results contain the deformation at the lines only; "
    "shakercal run --save-points stores every subset in every frame."
)
EVERY_FRAME = "Subsets and their deformation as measured in every frame (points-NAME.csv)."
NO_RESIDUALS = "The epipolar residual of each subset is the mean over the frames."
SIDES = ("left", "right")
FARTHEST, NEAREST, STEPS = 1e3, 2.0, 400  # of an epipolar line, in distances of the cameras


def table(head: Mapping[str, Any], *arrays: np.typing.NDArray[Any]) -> bytes:
    """Return numbers in the page's binary format.

    The length of a head, JSON, and arrays of doubles, aligned to 8 bytes.
    """
    text = json.dumps({**head, "lengths": [array.size for array in arrays]}, allow_nan=False).encode()
    text += b" " * (-(len(text) + 8) % 8)
    body = b"".join(np.ascontiguousarray(array, dtype="<f8").tobytes() for array in arrays)
    return len(text).to_bytes(8, "little") + text + body


@dataclass(frozen=True)
class SubsetResults:
    """Stored results of a stereo pair; fields as in `fusion.phasors.stereo_phasors.StereoResult`."""

    time_s: FloatArray
    subsets_px: FloatArray
    pose: FloatArray
    origin_m: FloatArray
    reference_m: FloatArray
    line_hz: FloatArray
    deflection_m: np.typing.NDArray[np.complex128]
    epipolar_px: FloatArray
    table: Path

    @classmethod
    def read(cls, folder: Path, name: str) -> SubsetResults | None:
        """Read a pair from a result folder; None without results of its images."""
        with open_results(folder / RESULT_FILE) as file:
            group = file.get(f"stereo/{name}")
            if group is None or "subsets_px" not in group or "deflection" not in group:
                return None
            inner = group["deflection"]
            residual = (
                group["epipolar/residual_px"][()] if "epipolar" in group else np.full(len(group["subsets_px"]), np.nan)
            )
            return cls(
                group["time_s"][()],
                group["subsets_px"][()],
                group["motion/pose"][()],
                group["motion/origin_m"][()],
                inner["reference_m"][()],
                inner["frequency_hz"][()],
                inner["value"][()],
                residual,
                folder / f"points-{name}.csv",
            )

    @cached_property
    def deformation_m(self) -> FloatArray:
        """Deformation (F, N, 3), of every frame if the points were saved.

        Otherwise it is the part at the lines.
        """
        if self.table.is_file():
            found = np.full((len(self.time_s), len(self.reference_m), 3), np.nan)
            finite = np.flatnonzero(np.isfinite(self.reference_m).all(axis=1))
            columns = [POINT_COLUMNS.index(name) for name in ("frame", "point", *(f"rest_{axis}_m" for axis in AXES))]
            with warnings.catch_warnings():
                warnings.simplefilter("ignore", UserWarning)  # an empty table
                rows = np.loadtxt(self.table, delimiter=",", skiprows=1, usecols=columns, ndmin=2)
            found[rows[:, 0].astype(int), finite[rows[:, 1].astype(int)]] = rows[:, 2:]
            return found
        turn = np.exp(2j * np.pi * np.outer(self.time_s, self.line_hz))
        part = np.einsum("fk,kni->fni", turn, np.nan_to_num(self.deflection_m)).real
        return np.asarray(part)

    def positions_m(self, frame: int, *, rigid: bool = False) -> FloatArray:
        """Return the positions (N, 3) of the points in a frame; `rigid`: without deformation."""
        turn = rotation_from_vector(self.pose[frame, 3:])
        moved = self.origin_m + self.pose[frame, :3] + (self.reference_m - self.origin_m) @ turn.T
        return np.asarray(moved if rigid else moved + self.deformation_m[frame])

    @property
    def radius_px(self) -> float:
        """Half-width of the subsets, which are adjacent."""
        return (neighbour_distance(self.subsets_px, 0.5) - 1) / 2


class SubsetViews:
    """The stereo pairs of an opened recording with their stored results."""

    def __init__(self, recording: ViewedRecording) -> None:
        self.recording = recording
        results = recording.source.results
        self.results = [
            None if results is None else SubsetResults.read(results, pair.entry.stereo) for pair in recording.pairs
        ]

    def description(self, number: int) -> Mapping[str, Any]:
        """Return times of the frames, phases (F) of each line, and missing data."""
        results, pair = self.results[number], self.recording.pairs[number]
        entry = pair.entry
        more = {"region": entry.region, "mask": entry.mask}
        if results is not None:
            kind = EVERY_FRAME if results.table.is_file() else LINES_ONLY
            found = {"missing": f"{kind} {NO_RESIDUALS}"} | _beat(results.time_s, results.line_hz)
        else:
            times = self._times(pair)
            nominal = np.asarray(self.recording.manifest.excitation.frequencies or ())
            found = {"missing": NO_RESULTS} | ({} if times is None else _beat(times, nominal))
        return found | {key: value for key, value in more.items() if value}

    def _times(self, pair: ViewedPair) -> FloatArray | None:
        """Return the times of frames by their trigger alone; None if it is not periodic."""
        for number, channel in enumerate(self.recording.channels):
            if channel.entry.name == pair.entry.trigger and channel.daq in pair.manifest.daq:
                try:
                    raw = {channel.entry.name: self.recording.raw(number)}
                    fit = fit_trigger_channel(DaqRecord(channel.daq, raw, 0.0), channel.entry)
                except (OSError, ValueError, InputError):
                    return None
                if isinstance(fit, TriggerFit):
                    return np.asarray(fit.period_s * np.arange(len(pair.sequences[0])))
        return None

    def frame(self, number: int, frame: int) -> Mapping[str, Any]:
        """Return the pixels of the subsets (N, 2), and their deformation in px."""
        results = self.results[number]
        if results is None or not 0 <= frame < len(results.time_s):
            return {"told": ""}
        if not np.isfinite(results.pose[frame]).all():
            return {"told": "No motion was found in this frame."}
        whole, rigid = (self._seen(number, results.positions_m(frame, rigid=only)) for only in (False, True))
        sides = {side: _pairs(pixels) for side, pixels in zip(SIDES, whole, strict=False)}
        rest = {side: _pairs(a - b) for side, a, b in zip(SIDES, whole, rigid, strict=False)}
        return {**sides, "residual": rest, "radius": results.radius_px, "told": ""}

    def _seen(self, number: int, points_m: FloatArray) -> list[FloatArray]:
        """Return the pixels (N, 2) of points (N, 3) in each camera.

        Points are in the sensor frame.
        """
        pair = self.recording.pairs[number]
        left = sensor_from_camera(pair.manifest.rig.stereo[pair.entry.stereo]).inverse().apply(points_m)
        return [camera.project(from_left.apply(left)) for camera, from_left in pair.rig.camera_poses]

    def epipolar(self, number: int, side: int, position: tuple[float, float]) -> Mapping[str, Any]:
        """Return a pixel of one camera and its epipolar line in the other one.

        The line is limited to the image. For a single camera it is the pixel itself.
        """
        pair = self.recording.pairs[number]
        rig = pair.rig
        if not isinstance(rig, StereoRig):
            return {SIDES[side]: [list(position)]}
        cameras = (rig.left, rig.right)
        other_from_camera = rig.right_from_left if side == 0 else rig.right_from_left.inverse()
        ray = np.append(cameras[side].undistort(np.array([position]))[0], 1.0)
        distance_m = float(np.linalg.norm(rig.right_from_left.translation_m))
        depth = distance_m / np.linspace(1 / FARTHEST, NEAREST, STEPS)
        pixels = cameras[1 - side].project(other_from_camera.apply(depth[:, None] * ray))
        width, height = pair.sequences[1 - side].size_px
        inside = ((pixels >= -0.1 * width) & (pixels <= 1.1 * np.array([width, height]))).all(axis=1)
        return {
            SIDES[side]: [list(position)],
            SIDES[1 - side]: pixels[inside & np.isfinite(pixels).all(axis=1)].tolist(),
        }

    def track(self, number: int, point: int) -> bytes:
        """Return curves of a subset: its motion, its deformation, and the spectrum of both."""
        results = self.results[number]
        if results is None:
            raise ValueError(NO_RESULTS)
        if not 0 <= point < len(results.reference_m):
            raise ValueError(f"point: expected 0 to {len(results.reference_m) - 1}, found {point}")
        frames = np.flatnonzero(np.isfinite(results.pose).all(axis=1))
        moved = np.array([results.positions_m(frame)[point] for frame in frames.tolist()]) - results.reference_m[point]
        rest = results.deformation_m[frames, point]
        fine = np.isfinite(moved).all(axis=1)
        time, moved, rest = results.time_s[frames][fine], 1e6 * moved[fine], 1e6 * rest[fine]
        if len(time) < 2:
            raise ValueError(f"subset {point}: expected at least 2 frames in which it was found, found {len(time)}")
        spectra = [amplitude_spectrum(values, (len(time) - 1) / (time[-1] - time[0])) for values in (moved, rest)]
        arrays = [time, *moved.T, *rest.T]
        for found in spectra:
            arrays += [found.frequency_hz[1:], *found.amplitude[1:].T]
        name = "deformation" if results.table.is_file() else "deformation, at the lines only"
        panels = []
        for title, x, columns in (
            (f"subset {point}: displacement", "time / s", (0, 1)),
            (f"subset {point}: {name}", "time / s", (0, 4)),
            (f"subset {point}: spectrum of the displacement, aliased by the frame rate", "frequency / Hz", (7, 8)),
            (f"subset {point}: spectrum of {name}", "frequency / Hz", (11, 12)),
        ):
            curves = [[axis, columns[0], columns[1] + i] for i, axis in enumerate(AXES)]
            y = "displacement / µm" if x.startswith("time") else "amplitude / µm"
            panels.append({"title": title, "x": x, "y": y, "curves": curves})
        mean = results.epipolar_px[point]
        text = f"Subset {point}: mean epipolar residual {mean:.4f} px." if np.isfinite(mean) else f"Subset {point}."
        return table({"panels": panels, "told": text}, *arrays)


def _beat(times: FloatArray, line_hz: FloatArray) -> dict[str, Any]:
    """Return times, and the phase of each line at each, in periods."""
    phases = [(np.nan_to_num(times) * frequency % 1.0).tolist() for frequency in line_hz]
    return {"times": [_finite(value) for value in times], "beats": line_hz.tolist(), "phases": phases}


def _finite(value: float) -> float | None:
    return float(value) if np.isfinite(value) else None


def _pairs(values: FloatArray) -> list[list[float | None]]:
    """Return rows of numbers, None for undefined ones."""
    return [[_finite(value) for value in row] for row in values]
