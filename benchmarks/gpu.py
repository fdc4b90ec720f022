"""Six components of two bodies from four cameras of 1.3 Mpx by the batched engine: counted, and timed on a GPU.

Usage: python benchmarks/gpu.py [--device auto|cpu|cuda] [--frames 1025] [--keep FOLDER] [--docs docs]

Renders 20 poses of both pairs of `large_recording.py` (12 bit), which repeat, for subsets of 31 x 31 px and septic
splines. On a GPU, with the pictures in memory: pictures, subsets and pixels per second from pictures to six components,
both bodies at once; beside it the parts: decoding, transfer, prefilter, subsets, grey-value fit. Everywhere: how far
the motion is from the CPU's, in its standard uncertainties, when both are iterated to the end, and which frames each
rejects.

Counted everywhere, the line of the motion known and unknown: batches, and how often a frame is compared with all cells.

With --docs the table of times and the comparison with the CPU go to performance.md there, from a GPU only.
"""

from __future__ import annotations

import argparse
import tempfile
import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from pathlib import Path
from unittest.mock import patch

import numpy as np
import torch
from large_recording import POSES, SIDES, camera_folder, cameras_from_world, sequence_of, setups, write_recording
from marked import existing_folder, markdown_table, write_marked

from photogram.device import resolve_device
from photogram.direct import direct_fit, fit_torch
from photogram.direct.fit_torch import fit_frames, torch_view
from photogram.images.sequence import ImageSequence
from photogram.measure import follow_torch
from photogram.measure.body import follow_block
from photogram.measure.follow import BodyPrior, BodyScene, prepare_body, sine_terms
from photogram.measure.follow_torch import MOST_FRAMES
from photogram.subsets.icgn import TrackSettings
from photogram.subsets.icgn_torch import PRECISION, register_frames, splines_of, torch_reference, upload_images

RADIUS_PX, COMPARED = 15, 64
SETTINGS = TrackSettings(RADIUS_PX, degree=7)
TO_THE_END = 1e-5  # standard uncertainties from the converged motion, where engines are compared
MPX = 1e-6


@dataclass(frozen=True)
class Body:
    """A prepared body, and its pictures in memory."""

    scene: BodyScene
    pictures: tuple[np.ndarray, np.ndarray]


def bodies(folder: Path, frames: int) -> list[Body]:
    """Both bodies with so many frames, of which pictures come from memory, and whose line is known."""
    found, known = [], BodyPrior(terms=sine_terms(np.arange(frames, dtype=np.float64), np.array([1.0 / POSES])))
    for setup in setups():
        rig, (left_from_world, _) = cameras_from_world(setup)
        files = [sequence_of(folder / camera_folder(setup, side), setup, POSES + 1) for side in SIDES]
        pictures = tuple(np.stack([one.read(k) for k in range(POSES + 1)]) for one in files)
        images = tuple(repeated(stack, one, frames) for stack, one in zip(pictures, files, strict=True))
        scene = prepare_body((images[0], images[1]), rig, left_from_world.inverse(), SETTINGS, prior=known)
        found.append(Body(scene, (pictures[0], pictures[1])))
    return found


def repeated(stack: np.ndarray, source: ImageSequence, frames: int) -> ImageSequence:
    """The first picture, and then the others in turn."""
    names = tuple(f"{k}" for k in range(frames))
    return ImageSequence(names, source.size_px, source.full_scale, lambda k: stack[1 + (k - 1) % POSES if k else 0])


# Agreement with the CPU, and what is timed on a GPU.


def agreement(some: list[Body], device: str) -> tuple[float, int]:
    """Largest difference of the motion from the CPU's in its standard uncertainties; frames that one alone rejects."""
    worst, unlike = 0.0, 0
    for body in some:
        frames = range(2, 2 + COMPARED)
        with (
            patch.object(direct_fit, "MAX_REMAINING_STEP", TO_THE_END),
            patch.object(fit_torch, "MAX_REMAINING_STEP", TO_THE_END),
        ):
            here, there = (follow_block(body.scene, frames, where) for where in ("cpu", device))
        for (_, one), (_, other) in zip(here, there, strict=True):
            if one is None or other is None:
                unlike += (one is None) != (other is None)
                continue
            u = np.sqrt(np.diagonal(one.covariance))
            worst = max(worst, float(np.max(np.abs(other.moved.pose - one.moved.pose) / u)))
    return worst, unlike


def counted(some: list[Body], device: str) -> str:
    """The table of what `COMPARED` frames of each body take, their line known and unknown."""
    rows, views = list[str](), len(some[0].scene.views)
    for name, scenes in (
        ("known", [body.scene for body in some]),
        ("unknown", [replace(body.scene, body=BodyPrior()) for body in some]),
    ):
        with (
            patch.object(fit_torch, "_compared", wraps=fit_torch._compared) as compare,
            patch.object(follow_torch, "fit_frames", wraps=fit_frames) as fit_all,
        ):
            for scene in scenes:
                follow_block(scene, range(2, 2 + COMPARED), device)
        compared = [len(call.args[2]) for call in compare.call_args_list]
        batches = ", ".join(str(len(call.args[2])) for call in fit_all.call_args_list)
        all_cells = sum(compared) / views / (COMPARED * len(some))
        rows.append(f"| {name} | {batches} | {len(compared) // views} | {all_cells:.2f} |")
    return markdown_table("| line | frames of the batches, both bodies | steps | comparisons of a frame |", rows)


def seconds(act: Callable[[], object]) -> float:
    """Least time of three, the first of four left out, the GPU's queue emptied before and after."""
    least = np.inf
    for number in range(4):
        torch.cuda.synchronize()
        begun = time.perf_counter()
        act()
        torch.cuda.synchronize()
        least = min(least, time.perf_counter() - begun) if number else np.inf
    return float(least)


def timed(some: list[Body], folder: Path, device: str) -> str:
    """The table of a GPU."""
    scenes = [body.scene for body in some]
    frames = len(scenes[0].images[0])

    def whole() -> None:
        with ThreadPoolExecutor(len(scenes)) as crew:
            list(crew.map(lambda scene: follow_block(scene, range(2, frames), device), scenes))

    pictures, size = 4 * (frames - 2), some[0].pictures[0][0].size
    subsets = np.mean([len(reference.centre_px) for scene in scenes for reference in scene.references])
    rate = pictures / seconds(whole)
    rows = [
        f"| {pictures} images to six components, both bodies | {rate:.0f} images/s |",
        f"| the same, in subsets and pixels | {rate * subsets:.3g} subsets/s, {rate * size * MPX:.0f} Mpx/s |",
        f"| the same, in frames of four cameras | {rate / 4:.0f} frames/s |",
    ]
    parts = stages(some[0], device)
    rows += [f"| {name} alone | {1e3 * seconds(act) / MOST_FRAMES:.3f} ms/image |" for name, act in parts.items()]
    took = seconds(parts["subsets"])
    found = len(some[0].scene.references[0].centre_px) * MOST_FRAMES
    side = 2 * RADIUS_PX + 1
    rows.append(f"| subsets of {side} × {side} px, from a start of 0.3 px | {found / took:.3g} /s |")
    setup = next(setups())
    files = sequence_of(folder / camera_folder(setup, SIDES[0]), setup, POSES + 1)
    begun = time.perf_counter()
    for k in range(POSES + 1):
        files.read(k)
    rows.append(f"| decoding (CPU, one thread) | {1e3 * (time.perf_counter() - begun) / (POSES + 1):.2f} ms/image |")
    return markdown_table(f"| {torch.cuda.get_device_name()}, {PRECISION} | result |", rows)


def stages(body: Body, device: str) -> dict[str, Callable[[], object]]:
    """The parts of following one camera's batch, each to be called by itself; fits are those of both cameras' pairs."""
    scene = body.scene
    stack, right = ([side[1 + k % POSES] for k in range(MOST_FRAMES)] for side in body.pictures)
    reference = torch_reference(scene.references[0], device, PRECISION)
    _, there = upload_images(stack, device)
    splines = splines_of(there, SETTINGS.degree, PRECISION)
    other = splines_of(upload_images(right, device)[1], SETTINGS.degree, PRECISION)
    targets = [(one, range(MOST_FRAMES)) for one in (splines, other)]
    true = follow_block(scene, range(1, 1 + MOST_FRAMES))
    start = np.stack([found[0].warp for found, _ in true if found is not None])
    start[..., [0, 3]] += 0.3 / np.sqrt(2.0)
    begun = np.array([one.moved.pose for _, one in true if one is not None])
    begun[:, :3] += 2e-7
    assert len(begun) == MOST_FRAMES
    views = [torch_view(view, device, PRECISION) for view in scene.views]
    return {
        "transfer": lambda: upload_images(stack, device),
        "prefilter": lambda: splines_of(there, SETTINGS.degree, PRECISION),
        "subsets": lambda: register_frames(reference, splines, start, SETTINGS),
        "grey-value fit of a pair": lambda: fit_frames(views, targets, begun),
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--device", default="auto")
    parser.add_argument("--frames", type=int, default=1025)
    parser.add_argument("--keep", type=Path, help="folder for the pictures, kept and used again")
    parser.add_argument("--docs", type=existing_folder, help="folder of performance.md, whose tables are replaced")
    options = parser.parse_args()
    device = resolve_device(options.device)
    with tempfile.TemporaryDirectory() as scratch:
        folder = options.keep or Path(scratch)
        if not (folder / camera_folder(next(setups()), SIDES[0])).is_dir():
            write_recording(folder, POSES + 1)
        some = bodies(folder, options.frames)
        there = "cpu:0" if device == "cpu" else device
        (worst, unlike), counts = agreement(some, there), counted(some, there)
        table = timed(some, folder, device) if device != "cpu" else "No GPU here: nothing is timed."
    where = "torch's CPU device" if device == "cpu" else torch.cuda.get_device_name()
    told = f"In {2 * COMPARED} frames, the motion on {where} differs from that on the CPU by at most {worst:.1g} u"
    text = f"{table}\n\n{told}, and {unlike} frames are rejected by only one of them."
    print(f"{text}\n\n{counts}")
    if options.docs and device != "cpu":
        write_marked(options.docs / "performance.md", {"gpu": text})


if __name__ == "__main__":
    main()
