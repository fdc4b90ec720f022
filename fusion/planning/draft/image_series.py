"""Image series of a folder: which files belong to one camera, and what they show."""

from __future__ import annotations

import os
import re
from collections import defaultdict
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from fnmatch import fnmatchcase
from itertools import pairwise
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from fusion.base import natural_key
from photogram.images.image_files import SUFFIXES, open_sequence
from photogram.images.tiff import TIFF_SUFFIXES
from photogram.images.video import VIDEO_READERS

if TYPE_CHECKING:
    from photogram.images.sequence import ImageSequence

MOST_FILES = 100_000  # images that are examined in one folder
DEEPEST = 4  # folders below the recording that may contain images
FEWEST_ALONE = 8  # least number of frames of a camera by itself; fewer are photographs
FEW_FILES = 4  # files of many pages that are cameras, not parts of one series
LOOKED_AT = 4  # images of a camera from which its bit depth is estimated
GREY_BITS = (8, 10, 12, 14, 16)  # usual bit depths of cameras
SHARED = 0.5  # least share of frame numbers that two cameras have in common, if they have any
PAUSE = 3.0  # step of the frame number from one camera to the next, over the steps within a camera
OTHER_FOLDERS = re.compile(r"[ck]alib|target|dark|flat|result|report|backup|thumb|preview", re.IGNORECASE)
"""Folders of images that belong to no recording."""
UNREADABLE = (
    ".jpg", ".jpeg", ".pgm", ".ppm", ".gif", ".webp", ".jp2", ".raw", ".dng", ".b16", ".pcoraw", ".seq", ".im7", ".imx",
    ".rec", ".ser", ".wmv", ".mpg", ".mpeg",
)  # fmt: skip
"""Files of cameras that have no reader."""


@dataclass(frozen=True)
class FoundCamera:
    """Images of one camera.

    `pattern`: of their paths below the recording; `files`: the images. `bits`: the smallest depth for the brightest
    pixel of a few images; `brightest`: that pixel's grey value.
    """

    pattern: str
    frames: int
    size_px: tuple[int, int]
    bits: int
    brightest: int
    exposure_s: float | None
    problem: str = ""
    files: tuple[Path, ...] = field(default=(), repr=False)

    @property
    def summary(self) -> str:
        """Number of frames and their size."""
        return f"{self.frames} frames of {self.size_px[0]} x {self.size_px[1]} px"


def find_images(folder: Path) -> tuple[list[Path], list[FoundCamera]]:
    """Return the images and videos of a recording, and those without a reader."""
    found: list[Path] = []
    unreadable: dict[str, list[Path]] = defaultdict(list)
    level = [folder]
    for depth in range(DEEPEST + 1):
        entries = [entry for place in level for entry in place.iterdir()]
        files = [path for path in entries if path.suffix.lower() in SUFFIXES and path.is_file()]
        found += sorted(files[:MOST_FILES], key=lambda path: (str(path.parent), natural_key(path.name)))
        for path in entries:
            if path.suffix.lower() in UNREADABLE and path.is_file():
                unreadable[(path.parent.relative_to(folder) / f"*{path.suffix}").as_posix()].append(path)
        below = (entry for entry in entries if depth < DEEPEST and entry.is_dir())
        level = sorted(p for p in below if not p.name.startswith(".") and not OTHER_FOLDERS.search(p.name))
    why = "no reader; save the images as TIFF or PNG, without loss"
    others = [
        FoundCamera(pattern, len(paths), (0, 0), 8, 0, None, f"{len(paths)} files, {why}", tuple(paths))
        for pattern, paths in unreadable.items()
    ]
    return found, others


def find_cameras(folder: Path, images: Sequence[Path]) -> list[FoundCamera]:
    """Return the cameras to which the images of a recording belong."""
    neighbours: dict[Path, list[str]] = defaultdict(list)
    for path in images:
        neighbours[path.parent].append(path.name)
    return [_camera(folder, group, neighbours[group[0].parent]) for group in _series(images)]


def _series(images: Iterable[Path]) -> list[tuple[Path, ...]]:
    """Return groups of images whose names differ in numbers that count or date the frames.

    A video, and each of a few files of many pages, is a separate group.
    """
    similar: dict[tuple[Path, tuple[str, ...]], list[tuple[tuple[str, ...], Path]]] = defaultdict(list)
    series: list[tuple[Path, ...]] = []
    alone: list[tuple[Path, ...]] = []
    for path in images:
        if path.suffix.lower() in VIDEO_READERS:
            alone.append((path,))
            continue
        parts = re.split(r"(\d+)", path.name)
        similar[path.parent, tuple(parts[::2])].append((tuple(parts[1::2]), path))
    for members in similar.values():
        files = tuple(path for _, path in members)
        if 1 < len(files) <= FEW_FILES and all(_pages(path) >= FEWEST_ALONE for path in files):
            alone += [(path,) for path in files]
            continue
        columns = np.array([numbers for numbers, _ in members], dtype=object).reshape(len(members), -1).T
        own = _camera_numbers(columns.tolist())
        groups: dict[tuple[str, ...], list[Path]] = defaultdict(list)
        for numbers, path in members:
            groups[tuple(numbers[i] for i in own)].append(path)
        series += [tuple(group) for group in groups.values()]
    return [group for group in series if len(group) >= 3 or group[0].suffix.lower() in TIFF_SUFFIXES] + alone


def _pages(path: Path) -> int:
    """Return the number of images of a file that may have several."""
    try:
        return len(open_sequence([path])) if path.suffix.lower() in TIFF_SUFFIXES else 1
    except (OSError, ValueError):
        return 1


def _camera_numbers(columns: Sequence[Sequence[str]]) -> list[int]:
    """Return which numbers of the names distinguish cameras.

    The number with most values counts the frames. Another one distinguishes cameras if the frame numbers of its values
    are the same, or begin anew far away; seconds and minutes of a time stamp do neither.
    """
    varying = [i for i, values in enumerate(columns) if len(set(values)) > 1]
    if not varying:
        return []
    counter = max(varying, key=lambda i: (len(set(columns[i])), i))
    frame = [int(value) for value in columns[counter]]
    others = {i: [tuple(int(columns[k][n]) for k in varying if k != i) for n in range(len(frame))] for i in varying}
    return [
        i for i in varying if i != counter and (_alternates(columns[i], others[i]) or _is_of_cameras(columns[i], frame))
    ]


def _alternates(values: Sequence[str], others: Sequence[tuple[int, ...]]) -> bool:
    """Return whether every value occurs once in each round of frames.

    The other numbers order the frames.
    """
    cameras = len(set(values))
    order = [values[i] for i in sorted(range(len(values)), key=lambda i: others[i])]
    rounds = [order[i : i + cameras] for i in range(0, len(order), cameras)]
    return len(rounds) >= FEWEST_ALONE and all(len(set(part)) == cameras for part in rounds)


def _is_of_cameras(values: Sequence[str], frame: Sequence[int]) -> bool:
    groups: dict[str, list[int]] = defaultdict(list)
    for value, number in zip(values, frame, strict=True):
        groups[value].append(number)
    if min(map(len, groups.values())) < 3 and len(groups) * 2 > len(frame):
        return False
    if len(groups) > min(len(set(group)) for group in groups.values()):
        return False  # more cameras than frames
    sets = [set(group) for group in groups.values()]
    common = set.intersection(*sets)
    if common:
        return len(common) >= SHARED * max(map(len, sets))
    width = max(len(str(number)) for number in frame)
    stamps = [int(value) * 10**width + number for value, number in zip(values, frame, strict=True)]
    return not (_continues(values, frame) or _continues(values, stamps))


def _continues(values: Sequence[str], stamps: Sequence[int]) -> bool:
    """Return whether the frames of one value follow those of the one before."""
    order = sorted(range(len(stamps)), key=lambda i: stamps[i])
    steps = [(stamps[b] - stamps[a], int(values[b]) - int(values[a])) for a, b in pairwise(order)]
    changes = [step for step, change in steps if change]
    within = [step for step, change in steps if not change]
    ascending = all(change >= 0 for _, change in steps)
    return ascending and len(changes) < len(set(values)) and max(changes) <= PAUSE * max(within, default=1)


def _pattern(folder: Path, group: Sequence[Path], neighbours: Sequence[str]) -> str:
    """Return the pattern of a camera's image names, as a path below the recording.

    `neighbours`: the names of all images of its folder.
    """
    names = {path.name for path in group}
    place = group[0].parent.relative_to(folder)
    if len(names) == 1:
        return (place / group[0].name).as_posix()
    parts = [re.split(r"(\d+)", name) for name in names]
    constant = [len({part[i] for part in parts}) == 1 for i in range(len(parts[0]))]
    literal = [re.sub(r"([*?\[])", r"[\1]", text) for text in parts[0]]
    for wild in ("*", "[0-9]*"):
        pattern = "".join(text if same else wild for text, same in zip(literal, constant, strict=True))
        if {name for name in neighbours if fnmatchcase(name, pattern)} == names:
            break
    return (Path(*(re.sub(r"([*?\[])", r"[\1]", part) for part in place.parts)) / pattern).as_posix()


def _camera(folder: Path, group: tuple[Path, ...], neighbours: Sequence[str]) -> FoundCamera:
    """Examine the images of a camera."""
    pattern = _pattern(folder, group, neighbours)
    try:
        images = open_sequence(group)
        chosen = sorted({round(i * (len(images) - 1) / (LOOKED_AT - 1)) for i in range(LOOKED_AT)})
        brightest = max(int(images.read(i).max()) for i in chosen)
    except (OSError, ValueError) as error:
        problem = " ".join(str(error).split()).replace(f"{group[0].parent}{os.sep}", "")
        return FoundCamera(pattern, len(group), (0, 0), 8, 0, None, problem, group)
    bits = next(bits for bits in GREY_BITS if brightest < 2**bits)
    bits = images.full_scale.bit_length() if _states_its_depth(group, images) else bits
    return FoundCamera(pattern, len(images), images.size_px, bits, brightest, images.exposure_s, "", group)


def _states_its_depth(group: Sequence[Path], images: ImageSequence) -> bool:
    """Return whether the files state their bit depth."""
    return group[0].suffix.lower() in VIDEO_READERS or images.full_scale != 2**16 - 1
