"""Files of a folder without a manifest: recorders, cameras, calibrations, tables."""

from __future__ import annotations

import json
import os
import re
from collections import defaultdict
from collections.abc import Iterable, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from fusion.base import natural_key
from fusion.recording.manifest import SCAN
from photogram.images.image_files import SUFFIXES as IMAGE_SUFFIXES
from photogram.images.image_files import open_sequence
from photogram.images.tiff import TIFF_SUFFIXES
from photogram.images.video import VIDEO_READERS
from shaker.io import SUFFIXES, read_channels
from shaker.io.channel import open_hdf5
from shaker.io.text import table_units
from shaker.timebase.edges import find_edges
from shaker.timebase.trigger import fit_trigger

if TYPE_CHECKING:
    from photogram.images.sequence import ImageSequence
    from shaker.io.channel import RawChannel

MOST_FILES = 100_000  # images that are examined in one folder
FEWEST_ALONE = 8  # least number of frames of a single camera; fewer are photographs
LOOKED_AT = 4  # images of a camera from which its bit depth is estimated
GREY_BITS = (8, 10, 12, 14, 16)  # usual bit depths of cameras
NEAR_A_LEVEL, TWO_LEVELS = 0.15, 0.9  # distance from a level over the step; share of samples within it
TABLE_KEYS = {"frequency_hz"}
HDF5 = (".h5", ".hdf5")
LABELS = re.compile(r"names?\b|labels?\b|channels?\b|columns?\b|signals?\b", re.IGNORECASE)
"""Attributes that may list the names of a table's columns."""
MOST_LABELS = 10_000  # texts in a list of column names
SIDES = (("left", "right"), ("l", "r"), ("a", "b"), ("0", "1"), ("1", "2"))


@dataclass(frozen=True)
class TriggerPulses:
    """Pulses of a channel with two levels: number, rate, and width (s; 0 if unknown)."""

    edges: int
    rate_hz: float
    width_s: float


@dataclass(frozen=True)
class FoundChannel:
    """A channel of a file with unit, rate, length, range and pulses.

    `label`: its name in a list of the file's columns, empty without one.
    """

    name: str
    unit: str
    rate_hz: float
    samples: int
    low: float
    high: float
    pulses: TriggerPulses | None
    label: str = ""

    @property
    def title(self) -> str:
        """Name of the channel: its label, otherwise its name in the file."""
        return self.label or self.name


@dataclass(frozen=True)
class FoundDaq:
    """A file of a recorder with its channels, or its problem.

    `raw`: the samples by the name of the channel.
    """

    path: Path
    channels: tuple[FoundChannel, ...]
    raw: dict[str, RawChannel]
    problem: str = ""


@dataclass(frozen=True)
class FoundCamera:
    """Images of one camera.

    `pattern`: of their paths below the recording. `bits`: the smallest depth for the brightest pixel of a few images;
    `brightest`: that pixel's grey value.
    """

    pattern: str
    frames: int
    size_px: tuple[int, int]
    bits: int
    brightest: int
    exposure_s: float | None
    problem: str = ""

    @property
    def summary(self) -> str:
        """Number of frames and their size."""
        return f"{self.frames} frames of {self.size_px[0]} x {self.size_px[1]} px"


@dataclass(frozen=True)
class FoundCameras:
    """Two cameras whose names differ only by left and right, or a single one.

    `name` is the common part of their names.
    """

    name: str
    left: FoundCamera
    right: FoundCamera | None

    @property
    def cameras(self) -> tuple[FoundCamera, ...]:
        """The left and the right camera, or the single one."""
        return (self.left,) if self.right is None else (self.left, self.right)


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

    @property
    def empty(self) -> bool:
        """Whether it has no recorded data."""
        return not (self.daqs or self.camera_systems or self.cameras or self.points)


def survey_folder(folder: Path) -> Inventory:
    """Read the files of a folder and of the image folders directly below it."""
    files = sorted((path for path in folder.iterdir() if path.is_file()), key=lambda path: natural_key(path.name))
    tables = {path: _columns(path) for path in files if path.suffix.lower() == ".csv"}
    responses = tuple(path for path, columns in tables.items() if set(columns) >= TABLE_KEYS)
    points = tuple(_points(path, columns) for path, columns in tables.items() if {"x", "y", "z"} <= set(columns))
    taken = {*responses, *(item.path for item in points)}
    recorders = [path for path in files if path.suffix.lower() in SUFFIXES and path not in taken]
    below = [entry for entry in folder.iterdir() if entry.is_dir() and not entry.name.startswith(".")]
    images = [path for path_folder in (folder, *below) for path in _image_files(path_folder)]
    sights, single = _paired([_camera(folder, group) for group in _series(images)])
    classified = {*taken, *recorders, *images}
    return Inventory(
        folder,
        tuple(map(_daq, recorders)),
        sights,
        single,
        points,
        responses,
        tuple(path for path in files if path not in classified and path.suffix != ".toml"),
    )


def is_recording_folder(folder: Path) -> bool:
    """Return whether a folder contains a recorder's file or images."""
    found = [path.suffix.lower() for path in folder.iterdir() if path.is_file()]
    return any(suffix in SUFFIXES or suffix in IMAGE_SUFFIXES for suffix in found)


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
    try:
        raw = read_channels(path)
    except (OSError, ValueError) as error:
        return FoundDaq(path, (), {}, str(error).removeprefix(f"{path}: "))
    if path.suffix.lower() == SCAN:
        raw = {name.partition("/")[0]: channel for name, channel in reversed(raw.items())}
    labels = _column_labels(path, raw) if path.suffix.lower() in HDF5 else {}
    return FoundDaq(path, tuple(_channel(name, channel, labels.get(name, "")) for name, channel in raw.items()), raw)


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
    if fit.edges < 3 or fit.spurious > fit.edges / 10:
        return None
    up = float(np.mean(samples >= middle))
    return TriggerPulses(fit.edges, 1.0 / fit.period_s, up * len(samples) / raw.sample_rate_hz / fit.edges)


# Cameras.


def _image_files(folder: Path) -> list[Path]:
    """Return the images and videos of a folder in natural order."""
    found = [path for path in folder.iterdir() if path.suffix.lower() in IMAGE_SUFFIXES and path.is_file()]
    return sorted(found[:MOST_FILES], key=lambda path: natural_key(path.name))


def _series(images: Iterable[Path]) -> list[tuple[Path, ...]]:
    """Return groups of images that differ in one number of their names.

    A video, and a file of many pages, is a separate group. Of the numbers of a name the one with most values counts the
    frames; the others distinguish cameras.
    """
    similar: dict[tuple[Path, tuple[str, ...]], list[tuple[tuple[str, ...], Path]]] = defaultdict(list)
    alone = []
    for path in images:
        if path.suffix.lower() in VIDEO_READERS:
            alone.append((path,))
            continue
        parts = re.split(r"(\d+)", path.name)
        similar[path.parent, tuple(parts[::2])].append((tuple(parts[1::2]), path))
    series = []
    for members in similar.values():
        numbers = list(zip(*(numbers for numbers, _ in members), strict=True))
        counted = max(range(len(numbers)), key=lambda i: len(set(numbers[i])), default=0)
        groups: dict[tuple[str, ...], list[Path]] = defaultdict(list)
        for frame_numbers, path in members:
            groups[frame_numbers[:counted] + frame_numbers[counted + 1 :]].append(path)
        series += [tuple(group) for group in groups.values()]
    return [group for group in series if len(group) >= 3 or group[0].suffix.lower() in TIFF_SUFFIXES] + alone


def _pattern(folder: Path, group: Sequence[Path]) -> str:
    """Return the pattern of a camera's image names, as a path below the recording."""
    names = [path.name for path in group]
    start = next((i for i, letters in enumerate(zip(*names, strict=False)) if len(set(letters)) > 1), len(names[0]))
    while start and names[0][start - 1].isdigit():
        start -= 1
    ends = [re.sub(r"^\d+", "", name[start:]) for name in names]
    name = f"{names[0][:start]}*{ends[0]}" if len(names) > 1 else names[0]
    return (group[0].parent / name).relative_to(folder).as_posix()


def _camera(folder: Path, group: Sequence[Path]) -> FoundCamera:
    """Examine the images of a camera."""
    pattern = _pattern(folder, group)
    try:
        images = open_sequence(group)
        chosen = sorted({round(i * (len(images) - 1) / (LOOKED_AT - 1)) for i in range(LOOKED_AT)})
        brightest = max(int(images.read(i).max()) for i in chosen)
    except (OSError, ValueError) as error:
        problem = " ".join(str(error).split()).replace(f"{group[0].parent}{os.sep}", "")
        return FoundCamera(pattern, len(group), (0, 0), 8, 0, None, problem)
    bits = next(bits for bits in GREY_BITS if brightest < 2**bits)
    bits = images.full_scale.bit_length() if _states_its_depth(group, images) else bits
    return FoundCamera(pattern, len(images), images.size_px, bits, brightest, images.exposure_s)


def _states_its_depth(group: Sequence[Path], images: ImageSequence) -> bool:
    """Return whether the files state their bit depth."""
    return group[0].suffix.lower() in VIDEO_READERS or images.full_scale != 2**16 - 1


def _paired(cameras: Sequence[FoundCamera]) -> tuple[tuple[FoundCameras, ...], tuple[FoundCamera, ...]]:
    """Return pairs and single cameras, and all other cameras with the reason."""
    sights, rest, odd = list[FoundCameras](), list(cameras), list[FoundCamera]()
    for left_word, right_word in SIDES:
        for camera in list(rest):
            span = _word(camera.pattern, left_word)
            if camera not in rest or span is None:
                continue
            other = camera.pattern[: span[0]] + right_word + camera.pattern[span[1] :]
            partner = next((item for item in rest if item.pattern.lower() == other.lower()), None)
            if partner is None:
                continue
            rest = [item for item in rest if item not in (camera, partner)]
            if partner.frames == camera.frames:
                sights.append(FoundCameras(_common_name(camera.pattern, span), camera, partner))
                continue
            for one, partner_camera in ((camera, partner), (partner, camera)):
                odd.append(
                    replace(
                        one,
                        problem=one.problem
                        or f"{one.summary}, and {partner_camera.pattern} has {partner_camera.summary}",
                    )
                )
    for camera in rest:
        if camera.problem or camera.frames < FEWEST_ALONE:
            odd.append(replace(camera, problem=camera.problem or f"{camera.summary}, without a second camera"))
        else:
            left = _word(camera.pattern, SIDES[0][0]) or (0, 0)
            sights.append(FoundCameras(_common_name(camera.pattern, left, "camera"), camera, None))
    names = [sight.name for sight in sights]
    counts = [names[:i].count(name) for i, name in enumerate(names)]
    named = [replace(s, name=f"{s.name}{n + 1}" if n else s.name) for s, n in zip(sights, counts, strict=True)]
    return tuple(named), tuple(odd)


def _word(pattern: str, word: str) -> tuple[int, int] | None:
    """Return the last position of a separate word in a pattern."""
    before = r"(?<![0-9])" if word.isdigit() else r"(?<![A-Za-z])"
    after = r"(?![0-9])" if word.isdigit() else r"(?![A-Za-z])"
    found = list(re.finditer(before + word + after, pattern, re.IGNORECASE))
    return found[-1].span() if found else None


def _common_name(pattern: str, span: tuple[int, int], default: str = "pair") -> str:
    """Return the name of a camera without left or right, frame number and common words."""
    rest = pattern[: span[0]] + "/" + pattern[span[1] :]
    words = [word for word in re.split(r"[^A-Za-z0-9]+", rest.rpartition(".")[0]) if word]
    dull = {"cam", "camera", "img", "image", "frame", "kamera", "pair", "stereo"}
    specific = [word for word in words if word.lower() not in dull]
    return "-".join(specific)[:40] or default


# Calibrations.


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
