"""Stereo pairs tracked block by block: low memory, and continuation of interrupted runs.

Functions that track import numba; others do not.
"""

from __future__ import annotations

import hashlib
import io
import weakref
import zipfile
import zlib
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import fields
from functools import partial
from tempfile import SpooledTemporaryFile
from typing import TYPE_CHECKING, Any, TypeVar

import numpy as np

from fusion.base import CheckpointStore, Executor, Pending, ProgressCallback, Settings, Threads
from fusion.errors import ComputeError, InputError, as_input_error
from fusion.phasors.phasor_notices import STORAGE_FULL
from fusion.phasors.stereo_motion import (
    PreparedImages,
    RejectedPair,
    StereoMotion,
    motion_from_tracks,
    sensor_from_camera,
)
from fusion.recording.manifest import MINIMUM_FRAMES
from photogram.camera import Rig
from photogram.geometry import RigidTransform

if TYPE_CHECKING:
    from photogram.images.sequence import ImageSequence
    from photogram.measure.follow import BodyScene, FollowedBlock
    from photogram.subsets.icgn import TrackSettings
    from shaker.lines.frequencies import LineFrequencies

    BodyInputs = tuple[tuple[ImageSequence, ...], Rig, RigidTransform, TrackSettings]

T = TypeVar("T")

MEMORY_BYTES = 1 << 26
MIN_SUBSET_FRAMES, SPARED, TIMES_UNKNOWNS = 24, 8, 2
"""Fewest frames with subsets: number, inverse share of all, and multiple of the unknowns of the lines (chosen)."""


def track_block(scene: BodyScene, frames: range, device: str) -> FollowedBlock:  # a task, so of this module
    """Track a body through a block of frames on the chosen device."""
    from photogram.device import resolve_device
    from photogram.measure.body import follow_block

    return follow_block(scene, frames, resolve_device(device))


class TrackedBlocks:
    """The tracked blocks of a pair's frames, read one at a time, in order, repeatedly.

    Blocks are in memory up to `MEMORY_BYTES`, and in the checkpoints. Others are in a temporary file on the disk of the
    results, or in the system's folder without results. The file has no name if the system permits it, and vanishes with
    this object or its process. Checkpoints that were deleted are tracked again. A pickle contains all blocks of any
    size; it is restored in memory and the system's folder.
    """

    def __init__(
        self, images: PreparedImages, scene: BodyScene, device: str, checkpoints: CheckpointStore | None
    ) -> None:
        self.scene = scene
        self._device, self._checkpoints = device, checkpoints if len(scene.blocks) > 1 else None
        pair = "\n".join([images.sight.name, *images.left.names[:1]])  # the first image distinguishes takes
        self._sight, self._pair = images.sight.name, hashlib.sha256(pair.encode()).hexdigest()[:12]
        self._reset(None if checkpoints is None else str(checkpoints.disk))

    def _reset(self, folder: str | None) -> None:
        self._positions: dict[range, tuple[int, int]] = {}
        self._ready: dict[range, FollowedBlock] = {}
        self._free_bytes = MEMORY_BYTES
        self._file = SpooledTemporaryFile(max_size=1, dir=folder)  # noqa: SIM115  (made when needed, closed with this)
        weakref.finalize(self, self._file.close)

    def __getstate__(self) -> dict[str, Any]:
        content = {frames: pack_block(block) for frames, block in zip(self.scene.blocks, self, strict=True)}
        plain = {name: self.__dict__[name] for name in ("scene", "_device", "_sight", "_pair")}
        return {**plain, "content": content}

    def __setstate__(self, state: dict[str, Any]) -> None:
        content = state.pop("content")
        self.__dict__.update(state, _checkpoints=None)
        self._reset(None)
        for frames, block in content.items():
            self._unpacked(frames, block)
            if frames not in self._ready:
                self._put(frames, block)

    def missing(self) -> list[range]:
        """Return the blocks that are not tracked yet."""
        return [frames for frames in self.scene.blocks if self._found(frames) is None]

    def add(self, frames: range, block: FollowedBlock) -> None:
        """Store a tracked block."""
        content = pack_block(block)
        if (
            len(content) <= self._free_bytes
        ):  # a copy: as followed, arrays lie scattered among those of pictures and splines
            self._unpacked(frames, content)
        stored = self._checkpoints is not None and self._checkpoints.put(self._name(frames), content)
        if not stored and frames not in self._ready:
            self._put(frames, content)

    def _put(self, frames: range, content: bytes) -> None:
        start = self._file.seek(0, io.SEEK_END)
        try:
            self._file.write(content)
            self._file.flush()
        except OSError as error:
            reason = (error.strerror or str(error)).lower()
            first, last = frames.start, frames.stop - 1
            raise ComputeError(STORAGE_FULL, pair=self._sight, first=first, last=last, reason=reason) from error
        self._positions[frames] = start, len(content)

    def __iter__(self) -> Iterator[FollowedBlock]:
        for frames in self.scene.blocks:
            block = self._found(frames)
            if block is None:
                block = track_block(self.scene, frames, self._device)
                self.add(frames, block)
            yield block

    def _name(self, frames: range) -> str:
        return f"{self._pair}-{frames.start}-{frames.stop}"

    def _found(self, frames: range) -> FollowedBlock | None:
        if frames in self._ready:
            return self._ready[frames]
        content = None
        if frames in self._positions:
            start, length = self._positions[frames]
            self._file.seek(start)
            content = self._file.read(length)
        elif self._checkpoints is not None:
            content = self._checkpoints.get(self._name(frames))
        return None if content is None else self._unpacked(frames, content)

    def _unpacked(self, frames: range, content: bytes) -> FollowedBlock | None:
        block = unpack_block(content, len(frames))
        if block is not None and len(content) <= self._free_bytes:
            self._ready[frames], self._free_bytes = block, self._free_bytes - len(content)
        return block


def pack_block(block: FollowedBlock) -> bytes:
    """Return a block of frames as the content of a file."""
    from photogram.subsets.icgn import Registration

    arrays: dict[str, Any] = {}
    searched = [(number, found) for number, (found, _) in enumerate(block) if found is not None]
    arrays["sought"] = np.array([number for number, _ in searched], dtype=np.int64)
    for side, registered in enumerate(zip(*(found for _, found in searched), strict=True)):
        for name in (field.name for field in fields(Registration)):
            arrays[f"{name}-{side}"] = np.array([getattr(found, name) for found in registered])
    fits = [(number, fit) for number, (_, fit) in enumerate(block) if fit is not None]
    arrays["fitted"] = np.array([number for number, _ in fits], dtype=np.int64)
    arrays["rotation"] = np.array([fit.moved.rotation for _, fit in fits]).reshape(-1, 3, 3)
    arrays["translation"] = np.array([fit.moved.translation_m for _, fit in fits]).reshape(-1, 3)
    arrays["covariance"] = np.array([fit.covariance for _, fit in fits]).reshape(-1, 6, 6)
    shape = len(fits), len(fits[0][1].amplitude) if fits else 0
    arrays["amplitude"] = np.array([fit.amplitude for _, fit in fits]).reshape(shape)
    arrays["shape-covariance"] = np.array([fit.amplitude_covariance for _, fit in fits]).reshape(*shape, shape[1])
    arrays["noise"] = np.array([fit.noise_ratio for _, fit in fits], dtype=np.float64)
    arrays["cells"] = np.array([fit.cells for _, fit in fits], dtype=np.int64)
    arrays["misfit"] = np.array([fit.misfit for _, fit in fits])
    arrays["scored"] = np.array([len(fit.scores) > 0 for _, fit in fits], dtype=np.bool_)
    arrays["scores"] = np.array([fit.scores for _, fit in fits if len(fit.scores)], dtype=np.float32)
    content = io.BytesIO()
    np.savez(content, **arrays)
    return content.getvalue() + zlib.crc32(content.getbuffer()).to_bytes(4, "big")


def unpack_block(content: bytes, frames: int) -> FollowedBlock | None:
    """Return a packed block of frames to the last bit, None if damaged."""
    from photogram.direct.direct_fit import DirectFit
    from photogram.subsets.icgn import Registration

    content, check = content[:-4], content[-4:]
    if zlib.crc32(content).to_bytes(4, "big") != check:
        return None
    names = [field.name for field in fields(Registration)]
    try:
        with np.load(io.BytesIO(content), allow_pickle=False) as file:
            arrays = {name: file[name] for name in file.files}
        fits: list[DirectFit | None] = [None] * frames
        scores, none = iter(arrays["scores"]), np.empty((0, 6), np.float32)
        names_of_fits = ("rotation", "translation", "scored", "covariance", "noise", "cells")
        of_fits = (arrays[name] for name in ("fitted", *names_of_fits, "amplitude", "shape-covariance", "misfit"))
        for number, rotation, translation, scored, covariance, noise, cells, *rest in zip(*of_fits, strict=True):
            moved, others = RigidTransform(rotation, translation), [*rest, next(scores) if scored else none]
            fits[number] = DirectFit(moved, covariance, float(noise), int(cells), *others)
        found: list[tuple[Registration, ...] | None] = [None] * frames
        cameras = range(sum(name.startswith(f"{names[0]}-") for name in arrays))
        for k, number in enumerate(arrays["sought"].tolist()):
            cut = ([arrays[f"{name}-{side}"][k].copy() for name in names] for side in cameras)
            found[number] = tuple(Registration(*one) for one in cut)
    except (ValueError, KeyError, IndexError, EOFError, zipfile.BadZipFile):
        return None
    return tuple(zip(found, fits, strict=True))


# Stereo pairs tracked side by side, by threads of this process or by processes of an executor.

Motions = Callable[[ProgressCallback], tuple[StereoMotion | RejectedPair, ...]]


@contextmanager
def tracked_pairs(
    images: Sequence[PreparedImages],
    settings: Settings,
    executor: Executor | None = None,
    checkpoints: CheckpointStore | None = None,
    lines: LineFrequencies | None = None,
) -> Iterator[Motions]:
    """Start tracking the images of stereo pairs; yield a function that returns their motions.

    The function returns the rigid motion of the body of each pair, or the reason why there is none. The caller may
    continue with other work before.

    Subsets are tracked in enough frames to resolve the `lines`, in all frames without lines. Files that cannot be read
    are refused. An executor opens the images by the same paths; without one, threads of this process track them.
    Results are identical to the last bit. Blocks of frames in `checkpoints` are not tracked again.
    """
    from photogram.device import resolve_device

    on_gpu = executor is None and resolve_device(settings.device) != "cpu"
    with Threads(
        max(1, len(images)) if on_gpu else None
    ) as threads:  # a GPU processes one block of each body at a time
        crew = threads if executor is None else executor
        prepared = [crew.submit(0, prepare_scene, item, settings, lines) for item in images]

        def motions(progress: ProgressCallback) -> tuple[StereoMotion | RejectedPair, ...]:
            begun = list[tuple[PreparedImages, TrackedBlocks | RejectedPair, dict[range, Pending]]]()
            moved = list[RejectedPair | Pending]()
            for item, pending in zip(images, prepared, strict=True):
                scene: BodyScene | RejectedPair = _attempted(item, partial(_answer, item, pending))
                if isinstance(scene, RejectedPair):
                    begun.append((item, scene, {}))
                    continue
                blocks = TrackedBlocks(item, scene, settings.device, checkpoints)
                shares = blocks.missing()
                submitted = {share: crew.submit(1, track_block, pending, share, settings.device) for share in shares}
                begun.append((item, blocks, submitted))
            for item, tracked, submitted in begun:  # so that no block waits in memory for the motion of another pair
                if isinstance(tracked, RejectedPair):
                    moved.append(tracked)
                    continue
                stage, total = f"track {item.sight.name}", 2 * len(item.left)
                for frames in tracked.scene.blocks:
                    progress(stage, 2 * frames.start, total)
                    if frames in submitted:
                        tracked.add(frames, _answer(item, submitted.pop(frames)))
                progress(stage, total, total)
                moved.append(threads.submit(2, _moved, item, tracked))
            return tuple(
                pending if isinstance(pending, RejectedPair) else _attempted(item, partial(_answer, item, pending))
                for item, pending in zip(images, moved, strict=True)
            )

        yield motions


def _attempted(images: PreparedImages, act: Callable[[], T]) -> T | RejectedPair:
    """Return the result of an action on a pair, rejected if its body is lost."""
    from photogram.subsets.find import BodyNotFound

    try:
        return act()
    except InputError as error:
        if not isinstance(error.__cause__, BodyNotFound):
            raise
        return RejectedPair(images.sight.name, error)


def _moved(images: PreparedImages, followed: TrackedBlocks) -> StereoMotion:
    from photogram.measure.body import body_motion

    with as_input_error(*images.sight.where):
        body = body_motion(followed.scene, followed)
    return motion_from_tracks(images, body)


def _answer(images: PreparedImages, pending: Pending) -> Any:
    """Return the result of a task on some images; raise its refusal as wrong input."""
    answer = pending.result()
    with as_input_error(*images.sight.where):
        return answer.unwrap()


def prepare_scene(
    images: PreparedImages, settings: Settings, lines: LineFrequencies | None
) -> BodyScene:  # a task, so of this module
    """Return the scene of a pair's body, its subsets in enough frames for the lines."""
    from photogram.device import resolve_device
    from photogram.measure.follow import BodyPrior, prepare_body, sine_terms
    from photogram.subsets.find import BodyNotFound

    left = int(np.count_nonzero(~images.copied))
    if left < MINIMUM_FRAMES:
        why = f"{left} of {len(images.copied)}, since the others are copies of earlier frames, grey value by grey value"
        raise BodyNotFound(f"expected at least {MINIMUM_FRAMES} different frames, found {why}")
    inputs, terms = body_inputs(images, settings, None if lines is None else len(lines.frequency_hz)), None
    if lines is not None:
        strongest = np.argsort(lines.multiple, kind="stable")  # mostly
        terms = sine_terms(images.sight.time_s, lines.frequency_hz[strongest])
    rolls = any(images.sight.pair.row_time)
    absent = images.copied if images.copied.any() else None
    prior = BodyPrior(images.depth_m, images.modes, rolls, terms, absent, images.displaced)
    return prepare_body(*inputs, resolve_device(settings.device), prior=prior)


def measure_images(images: PreparedImages, settings: Settings, progress: ProgressCallback) -> StereoMotion:
    """Track the images of one stereo pair and fit the rigid motion of its body."""
    with tracked_pairs((images,), settings) as motions:
        (found,) = motions(progress)
    if isinstance(found, RejectedPair):
        raise found.error
    return found


def body_inputs(images: PreparedImages, settings: Settings, lines: int | None = None) -> BodyInputs:
    """Return the inputs of `photogram.measure` for a stereo pair: images, rig, pose, and settings.

    With so many `lines`, and if points are not saved, a part of the frames is enough for deformation and the test of
    the calibration.
    """
    from photogram.subsets.icgn import TrackSettings
    from photogram.subsets.texture import radius_from_image_px

    radius = settings.subset_radius_px or radius_from_image_px(images.first)
    entry, frames = images.entry, None
    if lines is not None and not settings.save_points and not any(images.sight.pair.row_time):
        frames = max(MIN_SUBSET_FRAMES, len(images.left) // SPARED, TIMES_UNKNOWNS * (2 * lines + 1))
    options = TrackSettings(radius, degree=settings.spline_degree, region=entry.region, mask=entry.mask, frames=frames)
    return images.cameras, images.rig, sensor_from_camera(images.sight.pair), options
