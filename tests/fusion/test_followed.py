"""Blocks of frames that were followed: on a disk, without a name, in a pickle; a run that goes on from them."""

from __future__ import annotations

import copy
import errno
import os
import pickle
import sys
import tempfile
from dataclasses import fields
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from speckle import render_images

from fusion.errors import ComputeError
from fusion.phasors import tracked_blocks
from fusion.phasors.phasor_notices import STORAGE_FULL
from fusion.phasors.tracked_blocks import TrackedBlocks
from fusion.report.atomic_files import Checkpoint, remove_abandoned
from fusion.report.folder import check_folder
from photogram.direct.direct_fit import DirectFit
from photogram.geometry import RigidTransform
from photogram.images.sequence import ImageSequence
from photogram.measure import body, follow
from photogram.measure.follow import FollowedBlock
from photogram.subsets.icgn import Registration, TrackSettings

REGISTRATION = [field.name for field in fields(Registration)]
BLOCKS_OF_THREE = range(2, 5), range(5, 8)
IMAGES = SimpleNamespace(sight=SimpleNamespace(name="top"), left=ImageSequence(("a",) * 9, (1, 1), 255, None))


def followed(kept: Any) -> TrackedBlocks:
    """What was followed of two blocks of a pair."""
    return TrackedBlocks(IMAGES, SimpleNamespace(blocks=BLOCKS_OF_THREE), "cpu", kept)


def drawn_block(seed: int) -> FollowedBlock:
    """Three frames, two of them with five subsets, one with a direct fit alone."""
    rng = np.random.default_rng(seed)

    def found() -> Registration:
        status = rng.integers(0, 3, 5).astype(np.int8)
        return Registration(rng.normal(size=(5, 6)), *rng.normal(size=(3, 5)), status, rng.integers(0, 9, 5))

    moved = RigidTransform.from_pose(rng.normal(size=6))
    shapes = (
        rng.normal(size=4),
        rng.normal(size=(4, 4)),
        rng.normal(size=(2, 2)),
        np.ones((seed % 2 * 9, 6), np.float32),
    )
    fits = [None, DirectFit(moved, rng.normal(size=(6, 6)), 1.1, 7, *shapes), None]
    return tuple(((found(), found()) if fit is None else None, fit) for fit in fits)


def bits(block: FollowedBlock) -> list[bytes]:
    """All numbers of a block."""
    numbers = []
    for sides, fit in block:
        numbers += [np.asarray(getattr(side, name)).tobytes() for side in sides or () for name in REGISTRATION]
        if fit is not None:
            parts = fit.moved.rotation, fit.moved.translation_m, fit.covariance, np.array([fit.noise_ratio, fit.cells])
            numbers += [
                part.tobytes() for part in (*parts, fit.amplitude, fit.amplitude_covariance, fit.misfit, fit.scores)
            ]
    return numbers


class Refusing:
    """A place that keeps nothing, on some disk."""

    def __init__(self, disk: Path) -> None:
        self.disk = disk

    def get(self, _: str) -> bytes | None:
        return None

    def put(self, *_: Any) -> bool:
        return False


def test_blocks_come_back_to_the_last_bit_and_damaged_ones_not_at_all(tmp_path):
    kept, block = Checkpoint(tmp_path / "results", lambda: "key"), drawn_block(1)
    followed(kept).add(BLOCKS_OF_THREE[0], block)
    assert bits(next(iter(followed(kept)))) == bits(block)
    assert followed(kept).missing() == [BLOCKS_OF_THREE[1]]
    assert followed(Checkpoint(tmp_path / "results", lambda: "other")).missing() == [*BLOCKS_OF_THREE]
    (file,) = (tmp_path / ".results.so-far").iterdir()
    content = bytearray(file.read_bytes())
    content[len(content) // 2] ^= 1
    for damaged in (bytes(content), file.read_bytes()[:-50], b""):
        file.write_bytes(damaged)
        assert followed(kept).missing() == [*BLOCKS_OF_THREE]
    kept.remove()
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("kept", [None, "refusing"])
@pytest.mark.parametrize("memory_bytes", [0, 3000, 1 << 20])
def test_blocks_without_a_checkpoint_are_iterated_repeatedly(kept, memory_bytes, tmp_path, monkeypatch):
    """In memory, in a file without a name, and from a pickle; two iterations are independent."""
    monkeypatch.setattr(tracked_blocks, "MEMORY_BYTES", memory_bytes)
    blocks = [drawn_block(1), drawn_block(2)]
    tracked = followed(None if kept is None else Refusing(tmp_path))
    for frames, block in zip(BLOCKS_OF_THREE, blocks, strict=True):
        tracked.add(frames, block)
    for found in (tracked, pickle.loads(pickle.dumps(tracked)), copy.deepcopy(tracked)):
        assert found.missing() == []
        for one, other, block in zip(found, found, blocks, strict=True):
            assert bits(one) == bits(other) == bits(block)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.skipif(sys.platform == "win32", reason="files without names")
def test_the_temporary_file_lies_on_the_disk_of_the_results_and_goes_with_its_owner(tmp_path, monkeypatch):
    monkeypatch.setattr(tracked_blocks, "MEMORY_BYTES", 1)
    made: list[str] = []
    temporary = tempfile.TemporaryFile
    monkeypatch.setattr(tempfile, "TemporaryFile", lambda **told: made.append(told["dir"]) or temporary(**told))
    opened = len(os.listdir("/proc/self/fd")) if Path("/proc").is_dir() else 0
    tracked = followed(Refusing(tmp_path))
    tracked.add(BLOCKS_OF_THREE[0], drawn_block(1))
    assert made == [str(tmp_path)]
    assert list(tmp_path.iterdir()) == []
    del tracked
    assert not opened or len(os.listdir("/proc/self/fd")) == opened


def test_in_a_mounted_folder_blocks_are_stored_for_the_next_run(tmp_path, monkeypatch):
    """As in a container, whose results folder is often a disk of its own."""
    place = tmp_path / "results"
    place.mkdir()
    monkeypatch.setattr(os.path, "ismount", lambda path: Path(path) == place)
    kept, block = Checkpoint(place, lambda: "key"), drawn_block(1)
    followed(kept).add(BLOCKS_OF_THREE[0], block)
    assert kept.disk == place
    assert [entry.name for entry in tmp_path.iterdir()] == ["results"]
    check_folder(place, {}, force=False)
    assert remove_abandoned(place) == []
    assert bits(next(iter(followed(Checkpoint(place, lambda: "key"))))) == bits(block)
    kept.remove()
    assert list(place.iterdir()) == []


def test_a_full_disk_is_reported_with_pair_and_frames(tmp_path, monkeypatch):
    monkeypatch.setattr(tracked_blocks, "MEMORY_BYTES", 1)
    with pytest.raises(ComputeError) as error:
        followed(Refusing(tmp_path / "gone")).add(BLOCKS_OF_THREE[0], drawn_block(1))
    assert error.value.code == STORAGE_FULL.code
    reason = os.strerror(errno.ENOENT).lower()
    assert error.value.values == {"pair": "top", "first": 2, "last": 4, "reason": reason}


def test_a_run_that_ended_behind_its_first_block_goes_on_to_the_same_bits(tmp_path, monkeypatch):
    monkeypatch.setattr(follow, "BLOCK_FRAMES", 2)
    poses = np.sin(2.1 * np.arange(6))[:, None] * np.array([6e-4, 9e-4, 2e-4, 2e-3, -2e-3, 3e-3])
    series = (*render_images(poses, (0.013, 0.012), (100, 90), 41), TrackSettings(radius_px=8, degree=5))
    whole = body.measure_body(*series)

    def run() -> tuple[TrackedBlocks, int]:
        found = TrackedBlocks(
            IMAGES, follow.prepare_body(*series), "cpu", Checkpoint(tmp_path / "results", lambda: "key")
        )
        missing = found.missing()
        for frames in missing:
            found.add(frames, body.follow_block(found.scene, frames))
            if len(missing) == 2:
                raise KeyboardInterrupt
        return found, len(missing)

    with pytest.raises(KeyboardInterrupt):
        run()
    found, missing = run()
    assert missing == 1
    again = body.body_motion(found.scene, found)
    for name in ("pose", "covariance", "residual_m"):
        assert getattr(again.motion, name).tobytes() == getattr(whole.motion, name).tobytes()
    for one, other in zip(again.surface, whole.surface, strict=True):
        assert one.residual_m.tobytes() == other.residual_m.tobytes()
    assert again.notices == whole.notices
