"""All stereo pairs of a take: followed here one after another, or by a crew, pair by pair and block by block."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from fusion.crew import Crew, Pending
from fusion.manifest import Manifest
from fusion.settings import ProgressCallback, Settings
from fusion.stereo_motion import (
    BodyInputs,
    OpenImages,
    StereoMotion,
    body_inputs,
    measure_images,
    seen_motion,
    told_of_images,
)
from photogram.device import resolve_device
from photogram.measure import BodyScene, FollowedBlock, body_motion, follow_block, prepare_body


def measure_pairs(
    manifest: Manifest,
    images: Sequence[OpenImages],
    settings: Settings,
    progress: ProgressCallback,
    crew: Crew | None = None,
) -> tuple[StereoMotion, ...]:
    """Track the images of stereo pairs and fit the rigid motion of the body that each sees.

    A crew opens the images itself, by the same paths, and its motions are those found without one to the last bit.
    """
    if crew is None:
        return tuple(measure_images(manifest, item, settings, progress) for item in images)
    prepared = [crew.submit(0, _prepared, body_inputs(item, settings), settings.device) for item in images]
    begun = []
    for item, pending in zip(images, prepared, strict=True):
        scene: BodyScene = _opened(manifest, item, pending)
        blocks = [crew.submit(1, _followed, pending, frames, settings.device) for frames in scene.blocks]
        begun.append((item, scene, blocks))
    return tuple(_joined(manifest, *pair, progress) for pair in begun)


def _joined(
    manifest: Manifest, images: OpenImages, scene: BodyScene, pending: Sequence[Pending], progress: ProgressCallback
) -> StereoMotion:
    """The motion of one pair from the answers about its blocks."""
    stage, total = f"track {images.entry.stereo}", 2 * len(images.left)
    blocks = []
    for frames, answer in zip(scene.blocks, pending, strict=True):
        progress(stage, 2 * frames.start, total)
        blocks.append(_opened(manifest, images, answer))
    progress(stage, total, total)
    with told_of_images(manifest, images):
        body = body_motion(scene, blocks)
    return seen_motion(images, body)


def _opened(manifest: Manifest, images: OpenImages, pending: Pending) -> Any:
    """What a task about some images found; what it refused is told as wrong input."""
    answer = pending.result()
    with told_of_images(manifest, images):
        return answer.opened()


def _prepared(inputs: BodyInputs, device: str) -> BodyScene:
    """A task: what following a body needs."""
    return prepare_body(*inputs, resolve_device(device))


def _followed(scene: BodyScene, frames: range, device: str) -> FollowedBlock:
    """A task: one block of frames."""
    return follow_block(scene, frames, resolve_device(device))
