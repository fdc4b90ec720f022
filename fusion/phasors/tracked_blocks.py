"""Blocks of tracked frames on disk: low memory, and continuation of interrupted runs.

Functions that track import numba; others do not.
"""

from __future__ import annotations

import hashlib
import io
import weakref
import zipfile
import zlib
from collections.abc import Iterator
from dataclasses import fields
from tempfile import SpooledTemporaryFile
from typing import TYPE_CHECKING, Any

import numpy as np

from fusion.base import CheckpointStore
from fusion.errors import ComputeError
from fusion.phasors.phasor_notices import STORAGE_FULL
from photogram.geometry import RigidTransform

if TYPE_CHECKING:
    from fusion.phasors.stereo_motion import PreparedImages
    from photogram.measure.follow import BodyScene, FollowedBlock

MEMORY_BYTES = 1 << 26


def track_block(scene: BodyScene, frames: range, device: str) -> FollowedBlock:  # a task, so of this module
    """Track a body through a block of frames on the chosen device."""
    from photogram.kernels import resolve_device
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
        names_of_fits = ("rotation", "translation", "covariance", "noise", "cells", "amplitude", "shape-covariance")
        of_fits = (arrays[name] for name in ("fitted", *names_of_fits))
        for number, rotation, translation, covariance, noise, cells, *shapes in zip(*of_fits, strict=True):
            moved = RigidTransform(rotation, translation)
            fits[number] = DirectFit(moved, covariance, float(noise), int(cells), *shapes)
        found: list[tuple[Registration, ...] | None] = [None] * frames
        cameras = range(sum(name.startswith(f"{names[0]}-") for name in arrays))
        for k, number in enumerate(arrays["sought"].tolist()):
            cut = ([arrays[f"{name}-{side}"][k].copy() for name in names] for side in cameras)
            found[number] = tuple(Registration(*one) for one in cut)
    except (ValueError, KeyError, IndexError, EOFError, zipfile.BadZipFile):
        return None
    return tuple(zip(found, fits, strict=True))
