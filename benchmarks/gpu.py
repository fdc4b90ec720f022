"""Six components of two bodies from four cameras of 1.3 Mpx by the batched engine: on a GPU timed, elsewhere counted.

Usage: python benchmarks/gpu.py [--device auto|cpu|cuda] [--frames 513] [--keep FOLDER] [--docs docs]

Renders 20 poses of both pairs of `large_recording.py` (12 bit), which repeat, for subsets of 31 x 31 px and septic
splines. On a GPU, with the pictures in memory: pictures, subsets and pixels per second from pictures to six components,
both bodies at once; beside it the parts: decoding, transfer, prefilter, subsets, grey-value fit. Everywhere: how far
the motion is from the CPU's, in its standard uncertainties, and which frames each rejects.

Without a GPU nothing is timed. One batch is worked on by torch's CPU device in portions of a GPU's size, its operations
are counted (each taken for one launch of a kernel), with the bytes of all their operands (nothing kept in a cache) and
the arithmetic of matrix products, gathers and elementwise operations; what an H200 would take at its peak rates is
estimated from these, and marked as such.

With --docs the tables go to performance.md there. Asked of an H200: 2·10⁶ subsets of 31 x 31 px/s, 1000 pictures/s of
1.3 Mpx for the six components, four cameras followed faster than the 53 frames/s at which they are taken.
"""

from __future__ import annotations

import argparse
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from large_recording import POSES, SIDES, camera_folder, cameras_from_world, sequence_of, setups, write_recording
from marked import markdown_table, write_marked
from torch.utils._python_dispatch import TorchDispatchMode

from photogram.direct.fit_torch import fit_frames, torch_view
from photogram.geometry import RigidTransform
from photogram.images.sequence import ImageSequence
from photogram.measure.follow import BodyScene, follow_block, prepare_body
from photogram.subsets import icgn_torch
from photogram.subsets.icgn import TrackSettings
from photogram.subsets.icgn_stream import PRECISION
from photogram.subsets.icgn_torch import register_frames, spline_frames, splines_of, torch_reference, uploaded
from photogram.subsets.track import resolve_device

RADIUS_PX, BATCH, COMPARED = 15, 32, 24
SETTINGS = TrackSettings(RADIUS_PX, degree=7)
H200 = {"bytes/s": 4.8e12, "flop/s": 67e12, "launch": 5e-6, "transfer bytes/s": 55e9}
"""Peak of memory and float32, a launch that waits for the last one, 16 lanes of PCIe 5."""
MPX = 1e-6


@dataclass(frozen=True)
class Body:
    """A prepared body, and its pictures in memory."""

    scene: BodyScene
    pictures: tuple[np.ndarray, np.ndarray]


def bodies(folder: Path, frames: int) -> list[Body]:
    """Both bodies with so many frames, of which pictures come from memory."""
    found = []
    for setup in setups():
        rig, (left_from_world, _) = cameras_from_world(setup)
        files = [sequence_of(folder / camera_folder(setup, side), setup, POSES + 1) for side in SIDES]
        pictures = tuple(np.stack([one.read(k) for k in range(POSES + 1)]) for one in files)
        images = tuple(repeated(stack, one, frames) for stack, one in zip(pictures, files, strict=True))
        scene = prepare_body((images[0], images[1]), rig, left_from_world.inverse(), SETTINGS)
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
        here, there = (follow_block(body.scene, frames, where) for where in ("cpu", device))
        for (_, one), (_, other) in zip(here, there, strict=True):
            if one is None or other is None:
                unlike += (one is None) != (other is None)
                continue
            u = np.sqrt(np.diagonal(one.covariance))
            worst = max(worst, float(np.max(np.abs(other.moved.pose - one.moved.pose) / u)))
    return worst, unlike


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
        f"| pictures to six components, both bodies | {rate:.0f} pictures/s | ≥ 1000 |",
        f"| the same | {rate * subsets:.3g} subsets/s, {rate * size * MPX:.0f} Mpx/s | |",
        f"| four cameras | {rate / 4:.0f} frames/s | ≥ 53 |",
    ]
    parts = stages(some[0], device)
    rows += [f"| {name} alone | {1e3 * seconds(act) / BATCH:.3f} ms/picture | |" for name, act in parts.items()]
    took = seconds(parts["subsets"])
    found = len(some[0].scene.references[0].centre_px) * BATCH
    side = 2 * RADIUS_PX + 1
    rows.append(f"| subsets of {side} × {side} px, from a start of 0.3 px | {found / took:.3g} /s | ≥ 2·10⁶ |")
    setup = next(setups())
    files = sequence_of(folder / camera_folder(setup, SIDES[0]), setup, POSES + 1)
    begun = time.perf_counter()
    for k in range(POSES + 1):
        files.read(k)
    rows.append(
        f"| decoding (CPU, one thread) | {1e3 * (time.perf_counter() - begun) / (POSES + 1):.2f} ms/picture | |"
    )
    return markdown_table(f"| {torch.cuda.get_device_name()}, {PRECISION} | found | asked |", rows)


def stages(body: Body, device: str) -> dict[str, Callable[[], object]]:
    """The parts of following one camera's batch, each to be called by itself; fits are those of both cameras' pairs."""
    scene, stack = body.scene, np.stack([body.pictures[0][1 + k % POSES] for k in range(BATCH)])
    reference = torch_reference(scene.references[0], device, PRECISION)
    there = uploaded(stack, device)
    splines = splines_of(there, SETTINGS.degree, PRECISION)
    right = np.stack([body.pictures[1][1 + k % POSES] for k in range(BATCH)])
    targets = [(splines, range(BATCH)), (spline_frames(right, SETTINGS.degree, device, PRECISION), range(BATCH))]
    true = follow_block(scene, range(1, 1 + BATCH))
    start = np.stack([found[0].warp for found, _ in true])
    start[..., [0, 3]] += 0.3 / np.sqrt(2.0)
    fits = [fit for _, fit in true if fit is not None]
    begun = [RigidTransform(fit.moved.rotation, fit.moved.translation_m + 2e-7) for fit in fits]
    assert len(fits) == BATCH
    views = [torch_view(view, device, PRECISION) for view in scene.views]
    return {
        "transfer": lambda: uploaded(stack, device),
        "prefilter": lambda: splines_of(there, SETTINGS.degree, PRECISION),
        "subsets": lambda: register_frames(reference, splines, start, SETTINGS),
        "grey-value fit of a pair": lambda: fit_frames(views, targets, begun),
    }


# Without a GPU: what there is to do, and what its peak rates would make of that.


class Counted(TorchDispatchMode):
    """Counts operations that compute, bytes of their operands and arithmetic."""

    def __init__(self) -> None:
        super().__init__()
        self.launches, self.bytes, self.flops = Counter[str](), 0.0, 0.0

    def __torch_dispatch__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        out = func(*args, **(kwargs or {}))
        name = func.overloadpacket.__name__
        given = [one for one in torch.utils._pytree.tree_leaves((args, kwargs)) if isinstance(one, torch.Tensor)]
        made = [one for one in torch.utils._pytree.tree_leaves(out) if isinstance(one, torch.Tensor)]
        stored = {one.untyped_storage().data_ptr() for one in given}
        inplace = name.endswith("_") or any(one.untyped_storage().data_ptr() in stored for one in made)
        if not made or (inplace and not name.endswith("_")) or name in ("empty", "new_empty", "empty_strided"):
            return out  # a view, or memory alone
        self.launches[name] += 1
        numel = sum(one.numel() for one in made[:1])
        if "embedding_bag" in name:  # gathers windows of as many coefficients as it makes sums
            taps = given[1].numel()
            self.flops += 2.0 * taps * made[0].shape[1]
            self.bytes += taps * (made[0].shape[1] + 2) * 4 + made[0].numel() * 4
            return out
        inner = given[0].shape[-1] if name in ("mm", "bmm", "addmm") else 1
        self.flops += (2.0 * inner if inner > 1 else 1.0) * numel
        self.bytes += sum(one.numel() * one.element_size() for one in (*given, *made))
        return out


def estimated(body: Body) -> str:
    """The table of what is counted for a batch, and the estimate."""
    icgn_torch.WORKING_BYTES["cpu"] = icgn_torch.WORKING_BYTES["cuda"]
    rows, total = [], 0.0
    size = body.pictures[0][0].nbytes
    for name, act in stages(body, "cpu").items():
        if name == "transfer":
            took, told = BATCH * size / H200["transfer bytes/s"], f"0 | {size / 1e6:.2f} | 0"
        else:
            with Counted() as counts:
                act()
            launches = sum(counts.launches.values())
            work = max(counts.bytes / H200["bytes/s"], counts.flops / H200["flop/s"])
            took = launches * H200["launch"] + work
            told = f"{launches} | {counts.bytes / BATCH / 1e6:.0f} | {counts.flops / BATCH / 1e9:.2f}"
        total += took / 2.0 if name.startswith("grey") else took  # a pair is two pictures
        rows.append(f"| {name} | {told} | {1e3 * took / BATCH:.3f} |")
    subsets = len(body.scene.references[0].centre_px)
    rows.append(f"| all, one after the other | | | | {1e3 * total / BATCH:.3f}: {BATCH / total:.0f} pictures/s |")
    head = f"| batch of {BATCH} pictures, {subsets} subsets of {2 * RADIUS_PX + 1} px | launches | MB/picture | "
    return markdown_table(f"{head}GFLOP/picture | ms/picture of an H200, estimated, not measured |", rows)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--device", default="auto")
    parser.add_argument("--frames", type=int, default=513)
    parser.add_argument("--keep", type=Path, help="folder for the pictures, kept and used again")
    parser.add_argument("--docs", type=Path, help="folder of performance.md, whose tables are replaced")
    options = parser.parse_args()
    device = resolve_device(options.device)
    with tempfile.TemporaryDirectory() as scratch:
        folder = options.keep or Path(scratch)
        if not (folder / camera_folder(next(setups()), SIDES[0])).is_dir():
            write_recording(folder, POSES + 1)
        some = bodies(folder, options.frames)
        worst, unlike = agreement(some, "cpu:0" if device == "cpu" else device)
        table = estimated(some[0]) if device == "cpu" else timed(some, folder, device)
    where = "torch's CPU device" if device == "cpu" else torch.cuda.get_device_name()
    told = f"Motion of {2 * COMPARED} frames on {where}: within {worst:.1g} of its standard uncertainty of the CPU's; "
    told += f"frames that only one of them rejects: {unlike}."
    print(f"{table}\n\n{told}")
    if options.docs:
        name = "gpu-estimate" if device == "cpu" else "gpu"
        write_marked(options.docs / "performance.md", {name: f"{table}\n\n{told}"})


if __name__ == "__main__":
    sys.exit(main())
