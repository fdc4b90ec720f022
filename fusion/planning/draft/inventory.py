"""Files of a folder without a manifest: recorders, cameras, calibrations, tables."""

from __future__ import annotations

import json
import re
from collections import Counter, defaultdict
from collections.abc import Iterable
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import lru_cache
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from fusion.base import FileIdentity, natural_key
from fusion.planning.draft.camera_pairs import FoundCameras, pair_cameras
from fusion.planning.draft.image_series import FoundCamera, find_cameras, find_images
from fusion.recording.manifest import SCAN
from photogram.images.image_files import SUFFIXES as IMAGE_SUFFIXES
from shaker.io import EXPORTS, SUFFIXES, read_channels
from shaker.io.channel import MissingRateError, open_hdf5, time_unit
from shaker.io.table import is_table, table_units
from shaker.io.table_head import split_unit
from shaker.timebase.edges import Edges, find_edges
from shaker.timebase.trigger import fit_trigger
from shakercal._common.arrays import FloatArray

if TYPE_CHECKING:
    from shaker.io.channel import RawChannel

SAME_PULSES = 1e-4  # relative difference of the rates of two channels with the same pulses
UNEQUAL, VERY_UNEQUAL, DECAYING = 0.15, 1.0, 0.8  # spread of heights over their median; correlation with their order
NEAR_A_LEVEL, TWO_LEVELS = 0.15, 0.9  # distance from a level over the step; share of samples within it
LEAST_COUNT = 8  # samples that may be numbers of rows; a record without a rate has more
STEPS, UNEVEN = 1000, 0.02  # samples whose steps are compared; their spread over the median
TABLE_KEYS = {"frequency_hz"}
FOREIGN = (".yml", ".yaml", ".xml", ".caldat")
FOREIGN_WORDS = re.compile(rb"opencv-matrix|opencv_storage|camera_m(atrix|odel)|<calibration|Cam0_Fx|<ParameterList")
"""Suffixes and words of stereo calibrations of other programs."""
HDF5 = (".h5", ".hdf5")
TDMS, TABLES = ".tdms", (".csv", ".txt", ".dat")
TEXTS = (".txt", ".dat")  # of recorders or of people
OTHER_FILES = {*EXPORTS, *IMAGE_SUFFIXES, ".toml", ".json", ".xml", ".html", ".md", ".pdf", ".py", ".m", ".ini", ".zip"}
"""Suffixes of files that are examined elsewhere or are no tables."""
LABELS = re.compile(r"names?\b|labels?\b|channels?\b|columns?\b|signals?\b", re.IGNORECASE)
"""Attributes that may list the names of a table's columns."""
MOST_LABELS = 10_000  # texts in a list of column names


@dataclass(frozen=True)
class TriggerPulses:
    """Pulses of a channel with two levels: number, rate, width and first edge in s."""

    edges: int
    rate_hz: float
    width_s: float
    first_s: float = 0.0

    def same_as(self, other: TriggerPulses) -> bool:
        """Return whether two channels of one recorder have the same pulses."""
        shift_s = abs(self.first_s - other.first_s)
        same_rate = abs(self.rate_hz / other.rate_hz - 1.0) < SAME_PULSES
        return self.edges == other.edges and same_rate and shift_s * self.rate_hz < 0.5


@dataclass(frozen=True)
class FoundChannel:
    """A channel of a file with unit, rate, length, range and pulses.

    `rate_hz`: 0 if the file states none; `label`: its name in a list of the file's columns, empty without one.
    `short`: its name without group or unit, if the reader accepts it, otherwise that in the file.
    """

    name: str
    unit: str
    rate_hz: float
    samples: int
    low: float
    high: float
    pulses: TriggerPulses | None
    label: str = ""
    short: str = ""

    @property
    def title(self) -> str:
        """Name of the channel: its label, otherwise its name in the file."""
        return self.label or self.name


@dataclass(frozen=True)
class FoundDaq:
    """A file of a recorder with its channels, or its problem.

    `raw`: the samples by the name of the channel; `rate_missing`: with a rate of 1 Hz, since the file states none.
    """

    path: Path
    channels: tuple[FoundChannel, ...]
    raw: dict[str, RawChannel]
    problem: str = ""
    rate_missing: bool = False


@dataclass(frozen=True)
class FoundPoints:
    """A table of 3-D points of another program: its columns and the largest coordinate."""

    path: Path
    columns: tuple[str, ...]
    reach: float

    @property
    def name(self) -> str:
        """Name of the stereo pair of the table, by its file's name."""
        words = [word for word in re.split(r"[^A-Za-z0-9]+", self.path.stem) if word.lower() != "points"]
        return "-".join(words) or "pair"


@dataclass(frozen=True)
class Inventory:
    """Contents of a recording folder.

    Attributes
    ----------
    folder : The folder.
    daqs : Files of recorders.
    camera_systems : Pairs and single cameras that observe a body.
    cameras : Other cameras.
    points : Tables of points.
    responses : Tables over frequency.
    others : All other files.
    """

    folder: Path
    daqs: tuple[FoundDaq, ...]
    camera_systems: tuple[FoundCameras, ...]
    cameras: tuple[FoundCamera, ...]
    points: tuple[FoundPoints, ...]
    responses: tuple[Path, ...]
    others: tuple[Path, ...]

    def path_of(self, daq: FoundDaq) -> str:
        """Return the path of a recorder's file in the folder, as manifests state it."""
        return daq.path.relative_to(self.folder).as_posix()

    @property
    def unreadable(self) -> list[str]:
        """Files of recorders that cannot be read, each with the reason."""
        return [
            f"{self.path_of(daq)}: {daq.problem or 'no channel over time'}" for daq in self.daqs if not daq.channels
        ]

    @property
    def empty(self) -> bool:
        """Whether it has no recorded data that can be read."""
        channels = any(daq.channels for daq in self.daqs)
        return not (channels or self.camera_systems or self.cameras or self.points)


def survey_folder(folder: Path) -> Inventory:
    """Read the files of a folder and of the image folders below it."""
    places = filter(None, (folder, recorder_folder(folder)))
    found = (path for place in places for path in place.iterdir() if path.is_file())
    files = sorted(found, key=lambda path: natural_key(path.name))
    tables = {path: _columns(path) for path in files if path.suffix.lower() == ".csv"}
    responses = tuple(path for path, columns in tables.items() if set(columns) >= TABLE_KEYS)
    points = tuple(_points(path, columns) for path, columns in tables.items() if {"x", "y", "z"} <= set(columns))
    taken = {*responses, *(item.path for item in points)}
    recorders = [path for path in files if _is_recorder_file(path) and path not in taken]
    images, unreadable = find_images(folder)
    calibrations = find_calibrations(calibration_folders(folder))
    cameras = find_cameras(folder, images)
    sizes = {camera.size_px for camera in cameras}
    sights, single = pair_cameras(cameras, [path for path, size in calibrations.items() if size in sizes])
    unsupported = [path for path in files if path.suffix.lower() in EXPORTS]
    classified = {*taken, *recorders, *images, *unsupported}
    return Inventory(
        folder,
        tuple(map(_daq, [*recorders, *unsupported])),
        sights,
        (*single, *unreadable),
        points,
        responses,
        tuple(path for path in files if path not in classified and path.suffix != ".toml"),
    )


def is_recording_folder(folder: Path) -> bool:
    """Return whether a folder contains a recorder's file or images, and no results."""
    files = [path for path in folder.iterdir() if path.is_file()]
    if any(_is_result(path) for path in files if path.suffix.lower() in HDF5):
        return False
    return any(path.suffix.lower() in IMAGE_SUFFIXES or _is_recorder_file(path) for path in files)


def recorder_folder(folder: Path) -> Path | None:
    """Return the folder of a recorder whose images are in folders next to it.

    It is the only one with such files, and has no images.
    """
    if any(_is_recorder_file(path) for path in folder.iterdir() if path.is_file()):
        return None
    below = [path for path in folder.iterdir() if path.is_dir()]
    having = [path for path in below if any(_is_recorder_file(file) for file in path.iterdir() if file.is_file())]
    if len(having) != 1 or find_images(having[0])[0] or not find_images(folder)[0]:
        return None
    return having[0]


def _is_recorder_file(path: Path) -> bool:
    """Return whether a file is a recorder's, by its suffix or its table."""
    suffix = path.suffix.lower()
    return (suffix in SUFFIXES and suffix not in TEXTS) or (
        suffix not in OTHER_FILES and _is_table(path, FileIdentity.of(path))
    )


@lru_cache(maxsize=1024)
def _is_table(path: Path, _identity: FileIdentity | None) -> bool:
    """Return whether an unchanged file is a table; `init` asks several times."""
    return is_table(path)


def _is_result(path: Path) -> bool:
    """Return whether an HDF5 file has the provenance of a result."""
    with suppress(OSError, ValueError), open_hdf5(path) as file:
        return "input_sha256" in file.get("provenance", {})
    return False


# Recorders.


def _columns(path: Path) -> tuple[str, ...]:
    """Return the names of a table's columns, empty without a header."""
    try:
        return tuple(table_units(path))
    except (OSError, ValueError):
        return ()


def _points(path: Path, columns: tuple[str, ...]) -> FoundPoints:
    """Return a table of points with the largest coordinate of its first rows."""
    with path.open(encoding="utf-8", errors="replace") as file:
        rows = [line for _, line in zip(range(200), file, strict=False)][1:]
    columns_xyz = [columns.index(axis) for axis in ("x", "y", "z")]
    cells = [re.split(r"[,;\t]", row) for row in rows]
    numbers = [
        abs(float(row[column])) for row in cells for column in columns_xyz if len(row) > column and row[column].strip()
    ]
    return FoundPoints(path, columns, max(numbers, default=0.0))


def _daq(path: Path) -> FoundDaq:
    """Read a recorder's file and examine each of its channels.

    Of a scan the channels of the first point are examined.
    """
    maker, _, export = EXPORTS.get(path.suffix.lower(), "").partition(": ")
    if maker:
        return FoundDaq(path, (), {}, f"{maker}; {export}")
    if path.suffix.lower() not in SUFFIXES:
        return FoundDaq(path, (), {}, "a text table; end its name in .txt")
    raw, problem, missing = _read(path)
    if problem:
        renamed = path.suffix.lower() == SCAN and is_table(path)
        return FoundDaq(path, (), {}, "a text table and no scan; end its name in .txt" if renamed else problem)
    if path.suffix.lower() == SCAN:
        raw = {name.partition("/")[0]: channel for name, channel in reversed(raw.items())}
    labels = _column_labels(path, raw) if path.suffix.lower() in HDF5 else {}
    channels = {name: channel for name, channel in raw.items() if not _is_empty_or_time(channel)}
    short = _short_names(path, raw)
    made = (_channel(name, channel, labels.get(name, "")) for name, channel in channels.items())
    named = tuple(replace(found, short=short[found.name]) for found in made)
    named = tuple(replace(channel, rate_hz=0.0) for channel in named) if missing else named
    return FoundDaq(path, named, channels, rate_missing=missing)


def _short_names(path: Path, names: Iterable[str]) -> dict[str, str]:
    """Return the short names of channels: without the group of TDMS, the unit of tables."""
    suffix = path.suffix.lower()
    short = {
        name: name.rpartition("/")[2] if suffix == TDMS else split_unit(name)[0] if suffix in TABLES else name
        for name in names
    }
    count = Counter(short.values())
    return {name: plain if count[plain] == 1 and plain not in short else name for name, plain in short.items()}


def _read(path: Path) -> tuple[dict[str, RawChannel], str, bool]:
    """Return the channels of a file or its problem, and whether its rate is missing."""
    try:
        return read_channels(path), "", False
    except MissingRateError:
        with suppress(OSError, ValueError):
            raw = read_channels(path, sample_rate_hz=1.0)
            if any(len(channel.samples) > LEAST_COUNT for channel in raw.values()):
                return raw, "", True
        return {}, "no channel has a sampling rate; give sample_rate", False
    except (OSError, ValueError) as error:
        return {}, str(error).removeprefix(f"{path}: "), False


def _is_empty_or_time(channel: RawChannel) -> bool:
    """Return whether a channel has no samples, or rises in equal steps as times do."""
    samples = channel.samples
    if not np.isfinite(samples).any():
        return True
    if len(samples) <= LEAST_COUNT or not (steps := np.diff(samples[:STEPS])).min() > 0.0:
        return False
    if samples[0] in (0.0, 1.0) and np.all(np.diff(samples) == 1.0):
        return True
    if channel.unit and not time_unit(channel.unit):
        return False
    even = float(np.ptp(steps)) <= UNEVEN * float(np.median(steps)) + 4.0 * float(np.spacing(np.abs(samples).max()))
    return even and bool(np.all(np.diff(samples) > 0.0))


def _column_labels(path: Path, names: Iterable[str]) -> dict[str, str]:
    """Return the names of table columns from lists of texts of an HDF5 file.

    The columns are `table/1`, `table/2`, …. A list is an attribute of the table or of a group around it, or a data set
    of the same group. It has as many different texts as the table has columns.
    """
    columns: dict[str, list[str]] = defaultdict(list)
    for name in names:
        table, _, number = name.rpartition("/")
        if table and number.isdecimal():
            columns[table].append(name)
    labels: dict[str, str] = {}
    with suppress(OSError, ValueError, KeyError, RuntimeError), open_hdf5(path, links=True) as file:
        for table, column_names in columns.items():
            node = file[table]
            if len(node.shape) != 2:
                continue
            others = [other for other in [*node.parent.values()] if other is not None]
            data_sets = [other[()] for other in others if _is_list_of_texts(other)]
            around = [node, node.parent, file]
            attributes = [
                value for node_around in around for key, value in node_around.attrs.items() if LABELS.search(key)
            ]
            texts = (_texts(value) for value in (*attributes, *data_sets))
            found = next(
                (list_ for list_ in texts if len(set(list_)) == len(column_names) == len(list_) and all(list_)), None
            )
            labels |= zip(column_names, found, strict=True) if found is not None else {}
    return labels


def _is_list_of_texts(node: Any) -> bool:
    """Return whether a node of an HDF5 file is a short data set of texts."""
    return getattr(node, "ndim", 0) in (1, 2) and node.dtype.kind in "OSU" and node.size <= MOST_LABELS


def _texts(value: object) -> list[str]:
    """Return texts of an attribute or data set, stripped; of one text its parts."""
    parts = np.asarray(value, dtype=object).reshape(-1).tolist()
    texts = [part.decode("utf-8", "replace") if isinstance(part, bytes) else part for part in parts]
    if not all(isinstance(text, str) for text in texts):
        return []
    return [text.strip("\0 \t") for text in (re.split(r"[,;|]", texts[0]) if len(texts) == 1 else texts)]


def _channel(name: str, raw: RawChannel, label: str = "") -> FoundChannel:
    """Examine the samples of a channel."""
    finite = raw.samples[np.isfinite(raw.samples)]
    low, high = (float(finite.min()), float(finite.max())) if len(finite) else (0.0, 0.0)
    return FoundChannel(name, raw.unit, raw.sample_rate_hz, len(raw.samples), low, high, _pulses(raw), label)


def _pulses(raw: RawChannel) -> TriggerPulses | None:
    """Return the pulses of a channel with two levels and a period, otherwise None."""
    samples = raw.samples
    if len(samples) < 8 or raw.stamp_s is not None or not np.isfinite(samples).all() or np.ptp(samples) == 0.0:
        return None
    # Levels are the medians above and below the middle: pulses may be short.
    middle = (float(samples.min()) + float(samples.max())) / 2
    levels = float(np.median(samples[samples < middle])), float(np.median(samples[samples >= middle]))
    step = levels[1] - levels[0]
    near = np.minimum(np.abs(samples - levels[0]), np.abs(samples - levels[1])) < NEAR_A_LEVEL * step
    if float(np.mean(near)) < TWO_LEVELS:
        return None
    try:
        edges = find_edges(samples, raw.sample_rate_hz)
        fit = fit_trigger(edges)
    except ValueError:
        return None
    if fit.edges < 3 or fit.spurious > fit.edges / 10 or not _equal_pulses(samples, edges):
        return None
    up = float(np.mean(samples >= middle))
    width_s = up * len(samples) / raw.sample_rate_hz / fit.edges
    return TriggerPulses(fit.edges, 1.0 / fit.period_s, width_s, float(edges.estimate_s[0]))


def _equal_pulses(samples: FloatArray, edges: Edges) -> bool:
    """Return whether all pulses have one height; those of a ringing signal decay."""
    first = np.searchsorted(np.arange(len(samples)), edges.upper_s * (len(samples) / edges.record_s) - 0.5)
    highest = np.maximum.reduceat(samples, first)
    lowest = np.minimum.reduceat(samples, first)[:-1]
    for peaks in (highest - edges.threshold, edges.threshold - lowest):
        spread = float(np.ptp(peaks)) / float(np.median(peaks))
        trend = abs(float(np.corrcoef(np.arange(len(peaks)), peaks)[0, 1])) if spread > 0.0 and len(peaks) > 2 else 0.0
        if spread > UNEQUAL and (trend > DECAYING or spread > VERY_UNEQUAL):
            return False
    return True


# Calibrations.


def calibration_folders(folder: Path) -> list[Path]:
    """Return the folders that may contain the calibrations of a recording."""
    places = (folder, folder.absolute().parent)
    return [place for around in places for place in (around, around / "calibration")]


def find_calibrations(folders: Iterable[Path]) -> dict[Path, tuple[int, int]]:
    """Return the calibration files of some folders with the size of their left images."""
    found: dict[Path, tuple[int, int]] = {}
    for folder in dict.fromkeys(folders):
        for path in sorted(folder.glob("*.json")) if folder.is_dir() else ():
            content = _content(path)
            size = content.get("image_size")
            size = size[0] if isinstance(size, list) and size and isinstance(size[0], list) else size
            is_calibration = {"left", "right", "translation"} <= set(content) or "camera" in content
            if is_calibration and isinstance(size, list) and len(size) == 2:
                found[path] = size[0], size[1]
    return found


def find_foreign_calibration(folder: Path) -> Path | None:
    """Return the first file of another program's stereo calibration in a folder or directly below."""
    found = [path for pattern in ("*", "*/*") for path in sorted(folder.glob(pattern))]
    for path in found:
        if path.suffix.lower() in FOREIGN and path.is_file():
            with suppress(OSError), path.open("rb") as stream:
                if FOREIGN_WORDS.search(stream.read(1 << 16)):
                    return path
    return None


def _content(path: Path) -> dict[str, Any]:
    """Return a small JSON file's table, otherwise an empty one."""
    try:
        content = json.loads(path.read_bytes()) if path.stat().st_size < 1 << 22 else None
    except (OSError, ValueError, RecursionError):
        return {}
    return content if isinstance(content, dict) else {}


def states_scale(path: Path) -> bool:
    """Return whether a calibration has a covariance, which includes the scale."""
    return _content(path).get("covariance") is not None
