"""Frames from the folders of cameras, in order, as their files are completed."""

from __future__ import annotations

import os
import re
import time
from dataclasses import dataclass, field
from fnmatch import fnmatchcase
from pathlib import Path, PurePosixPath
from typing import Any

import numpy as np

from fusion.base import natural_key
from fusion.errors import InputError
from fusion.planning.look.live import LiveFrame
from fusion.planning.look.look_notices import LIVE_NOT_POSSIBLE
from fusion.recording.recording_notices import WRONG_VALUE_TYPE
from fusion.recording.toml import read_toml
from fusion.recording.values import MAGIC, describe
from photogram.frame_statistics import spread_choice
from photogram.images.image_files import open_sequence
from photogram.images.sequence import GreyImage, numbers_of_names
from photogram.images.video import VIDEO_READERS

LATE_S = 1.0  # that a frame may be later than the next one, before it counts as lost
UNREADABLE_S = 3.0  # that a file of constant size may be unreadable, before it counts as damaged
MIN_NUMBERED = 3  # files that show how names count
MOST_BEHIND, MOST_AT_START = 96, 512
"""Waiting frames of a pair above which only a part of them is analysed; more of those that are there at the start."""
LAST_NUMBER = re.compile(r"(\d+)\D*$")


@dataclass
class FrameCounts:
    """Counts of frames that were not analysed.

    `skipped`: to keep up; `missing`: of lost numbers; `repeated`: equal to the frame before; `damaged`: unreadable.
    """

    skipped: int = 0
    missing: int = 0
    repeated: int = 0
    damaged: int = 0


class CameraFolder:
    """Files of one camera: `complete` by frame number, once their size is constant.

    `emptied`: whether all files have been removed.
    """

    def __init__(self, folder: Path, pattern: str) -> None:
        self.folder, self.pattern = folder, pattern
        self.complete: dict[int, Path] = {}
        self.emptied = False
        self._sizes: dict[str, int] = {}
        self._known: set[str] = set()
        self._unnumbered: list[str] = []
        self._first: int | None = None
        self._step = 0  # 0: counted by order

    def poll(self) -> None:
        """List the folder, and add the files whose size is that of the last poll."""
        names = self._listed()
        self.emptied = self.emptied or bool(self._known and not names)
        sizes: dict[str, int] = {}
        for name in names:
            if name in self._known:
                continue
            try:
                size = (self.folder / name).stat().st_size
            except OSError:
                continue
            if size > 0 and self._sizes.get(name) == size:
                self._known.add(name)
                self._unnumbered.append(name)
            else:
                sizes[name] = size
        self._sizes = sizes
        self._number()

    @property
    def growing(self) -> bool:
        """Whether files may not be complete."""
        return bool(self._sizes)

    def _listed(self) -> list[str]:
        try:
            with os.scandir(self.folder) as entries:
                return [one.name for one in entries if fnmatchcase(one.name, self.pattern) and one.name[0] != "."]
        except OSError:
            return []

    def _number(self) -> None:
        """Number the new files, by the last number of their names if it counts."""
        names = sorted(self._unnumbered, key=natural_key)
        if self._first is None:
            if len(names) < MIN_NUMBERED:
                return
            counted, last = numbers_of_names(names), [LAST_NUMBER.search(Path(name).stem) for name in names]
            self._first = 0
            if counted is not None and counted.exact and all(last):
                self._first, self._step = int(last[0][1]), counted.step  # type: ignore[index]
        self._unnumbered = []
        for name in names:
            number = self._first
            if self._step:
                found = LAST_NUMBER.search(Path(name).stem)
                number = -1 if found is None else (int(found[1]) - self._first) // self._step
            else:
                self._first += 1
            if number >= 0:
                self.complete[number] = self.folder / name


@dataclass
class _PairFolders:
    """Cameras of a pair, the next number, and the beginning of a wait for it.

    `skipped`: later numbers that are not analysed. `before`: images of the last frame.
    """

    name: str
    cameras: tuple[CameraFolder, ...]
    next: int = 0
    skipped: set[int] = field(default_factory=set)
    waiting_s: float | None = None
    before: tuple[GreyImage, ...] = ()

    def ready(self) -> list[int]:
        """Return the numbers whose files are complete in all cameras."""
        common = set.intersection(*(set(camera.complete) for camera in self.cameras))
        return sorted(number for number in common if number >= self.next)

    def advance(self, number: int) -> None:
        """Forget the files before a number."""
        self.next, self.waiting_s = number, None
        self.skipped = {key for key in self.skipped if key >= number}
        for camera in self.cameras:
            camera.complete = {key: path for key, path in camera.complete.items() if key >= number}


class FolderFrames:
    """Frames of all pairs of a recording, as their files arrive.

    Parameters
    ----------
    recording : its recording.toml, whose [[images]] name patterns such as top-left/*.tif.
    """

    def __init__(self, recording: Path) -> None:
        self.counts = FrameCounts()
        self._pairs = [_pair(recording, block) for block in _tables(recording, "images")]

    @property
    def emptied(self) -> bool:
        """Whether the files of a camera have been removed."""
        return any(camera.emptied for pair in self._pairs for camera in pair.cameras)

    @property
    def behind(self) -> int:
        """Number of waiting frames, of the pair with most."""
        return max(len(pair.ready()) for pair in self._pairs)

    @property
    def growing(self) -> bool:
        """Whether files are being written or wait."""
        return self.behind > 0 or any(camera.growing for pair in self._pairs for camera in pair.cameras)

    def take(self, most: int) -> list[LiveFrame]:
        """Return the next frames of all pairs, at most so many of each."""
        return [frame for pair in self._pairs for frame in self._taken(pair, most)]

    def _taken(self, pair: _PairFolders, most: int) -> list[LiveFrame]:
        for camera in pair.cameras:
            camera.poll()
        frames = list[LiveFrame]()
        for number in self._without_skipped(pair)[:most]:
            lost = [gap for gap in range(pair.next, number) if gap not in pair.skipped]
            if lost and not self._gave_up(pair, LATE_S):
                break
            images = self._read(pair, number)
            if images is None:
                break
            self.counts.missing += len(lost)
            pair.advance(number + 1)
            if images and pair.before and all(map(np.array_equal, images, pair.before)):
                self.counts.repeated += 1
            elif images:
                pair.before = images
                frames.append(LiveFrame(pair.name, number, images))
        return frames

    def _without_skipped(self, pair: _PairFolders) -> list[int]:
        """Return the numbers of complete frames; skip some if there are too many.

        The choice has no period, so that lines which all frames resolve are not aliased onto each other.
        """
        ready = pair.ready()
        limit = MOST_BEHIND if pair.next else MOST_AT_START
        if len(ready) <= limit:
            return ready
        chosen = spread_choice(np.array(ready), limit / 2 / len(ready)).tolist()
        skipped = {number for number, keep in zip(ready, chosen, strict=True) if not keep}
        self.counts.skipped += len(skipped)
        pair.skipped |= skipped
        for camera in pair.cameras:
            camera.complete = {key: path for key, path in camera.complete.items() if key not in skipped}
        return [number for number in ready if number not in skipped]

    @staticmethod
    def _gave_up(pair: _PairFolders, limit_s: float) -> bool:
        """Whether a missing or unreadable file has been awaited for longer than a limit."""
        now = time.monotonic()
        pair.waiting_s = now if pair.waiting_s is None else pair.waiting_s
        return now - pair.waiting_s > limit_s

    def _read(self, pair: _PairFolders, number: int) -> tuple[GreyImage, ...] | None:
        """Return the images of a frame, () if damaged, None if perhaps still written."""
        try:
            images = tuple(_image(camera.complete[number]) for camera in pair.cameras)
        except (OSError, ValueError):
            if not self._gave_up(pair, UNREADABLE_S):
                return None
            self.counts.damaged += 1
            return ()
        return images


def _image(path: Path) -> GreyImage:
    return open_sequence([path]).read(0)


def _pair(recording: Path, block: dict[str, Any]) -> _PairFolders:
    """Return the folders of a pair; refuse files without a pattern."""
    cameras = []
    for side in (side for side in ("left", "right") if side in block):
        text = block[side]
        path = PurePosixPath(text) if isinstance(text, str) else None
        if (
            path is None
            or not MAGIC.search(path.name)
            or MAGIC.search(str(path.parent))
            or path.suffix in VIDEO_READERS
        ):
            found, expected = f"{text!r}", 'a pattern of image files such as "top-left/*.tif"'
            raise InputError(LIVE_NOT_POSSIBLE, recording, f"images.{side}", found=found, expected=expected)
        cameras.append(CameraFolder(recording.parent / path.parent, path.name))
    return _PairFolders(str(block.get("stereo")), tuple(cameras))


def recorder_files(recording: Path) -> list[Path]:
    """Return the files of the recorders that a recording names."""
    files = []
    for block in _tables(recording, "daq"):
        name = block.get("file")
        if not isinstance(name, str):
            expected = "the name of the file that the recorder will write"
            raise InputError(WRONG_VALUE_TYPE, recording, "daq.file", found=describe(name), expected=expected)
        files.append(recording.parent / name)
    return files


def _tables(recording: Path, key: str) -> list[dict[str, Any]]:
    """Return the blocks of a name, none without any; refuse other values."""
    blocks = read_toml(recording).get(key, [])
    if not isinstance(blocks, list) or not all(isinstance(block, dict) for block in blocks):
        found, expected = describe(blocks), f"blocks in double brackets, [[{key}]]"
        raise InputError(WRONG_VALUE_TYPE, recording, key, found=found, expected=expected)
    return blocks
