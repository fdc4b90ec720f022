"""Time of a run over its number of frames, and the share of each stage.

Usage: python benchmarks/growth.py [--frames 53 106 211 422] [--repeats 3] [--keep FOLDER] [--docs docs]

Recordings of the preset `nitsche2018` (two stereo pairs of 640 x 512 px) with a frame rate that resolves the lines in
short ones too, rendered once in some minutes and kept in --keep. Each is run in a process of its own on one core, the
smallest time of the repeats counts, and the compiled functions are cached before. The stages are those of the longest
recording: the time of a thread in each function without the stages that it calls. With --docs the tables go to
performance.md there.
"""

from __future__ import annotations

import argparse
import json
import os
import resource
import subprocess
import sys
import tempfile
import threading
import time
from collections import defaultdict
from collections.abc import Callable
from dataclasses import replace
from functools import wraps
from importlib import import_module
from pathlib import Path
from typing import Any

from marked import existing_folder, markdown_table, write_marked

PRESET, RECORDING, CAMERAS, RATE_HZ = "nitsche2018", "Fz-0106.25", 4, 48.345
STAGES = {
    "decode the images": "photogram.images.sequence ImageSequence.read",
    "spline coefficients of the images": "photogram.measure.follow spline_of_image",
    "registration of the subsets": "photogram.subsets.find Follower.find",
    "fit of the motion to the grey values": "photogram.measure.follow fit_direct",
    "body and reference image": "fusion.phasors.tracked_blocks prepare_scene",
    "checks and prediction of each frame": "fusion.phasors.tracked_blocks track_block",
    "points, deformation, image checks": "fusion.phasors.tracked_blocks _moved",
    "channels and clocks": (
        "fusion.sensitivity.recording_evaluation prepare_set_ups; fusion.phasors.set_up with_channels"
    ),
    "phasors with covariance": "fusion.phasors.set_up fit_motions",
    "fusion, load, sensitivity": "fusion.sensitivity.recording_evaluation evaluate_set_ups",
    "page and files": "fusion.campaign.run write_results",
}
"""Functions by the stage that they do."""
REST = "start of the program, hashes of the inputs"


class Stopwatch:
    """CPU time of every thread by stage, each without the stages inside."""

    def __init__(self) -> None:
        self.spent_s: dict[str, float] = defaultdict(float)
        self._local, self._lock = threading.local(), threading.Lock()

    def timed(self, stage: str, function: Callable[..., Any]) -> Callable[..., Any]:
        """Return a function that adds its time to a stage."""

        @wraps(function)
        def measured(*arguments: Any, **named: Any) -> Any:
            stack = self._local.__dict__.setdefault("stack", [])
            begun = time.thread_time()
            stack.append(0.0)
            try:
                return function(*arguments, **named)
            finally:
                whole, inside = time.thread_time() - begun, stack.pop()
                if stack:
                    stack[-1] += whole
                with self._lock:
                    self.spent_s[stage] += whole - inside

        return measured


def run_one(recording: Path, results: Path, staged: bool) -> None:
    """Run a recording in this process and print its time, memory and stages."""
    os.sched_setaffinity(0, [min(os.sched_getaffinity(0))])
    watch = Stopwatch()
    for stage, places in STAGES.items() if staged else ():
        for place in places.split("; "):
            module, name = place.split()
            *owners, attribute = name.split(".")
            owner: Any = import_module(module)
            for part in owners:
                owner = getattr(owner, part)
            setattr(owner, attribute, watch.timed(stage, getattr(owner, attribute)))
    from fusion.cli import main as shakercal

    status = shakercal(["run", str(recording), "-o", str(results), "-q", "--force"])
    if status:
        raise SystemExit(status)
    used = resource.getrusage(resource.RUSAGE_SELF)
    cpu_s = used.ru_utime + used.ru_stime
    stages = {**watch.spent_s, REST: cpu_s - sum(watch.spent_s.values())}
    print("measured", json.dumps({"cpu_s": cpu_s, "peak_mb": used.ru_maxrss / 1024, "stages": stages}))


def measured(recording: Path, results: Path, *, staged: bool = False) -> dict[str, Any]:
    """Return what `run_one` printed in a process of its own."""
    words = [sys.executable, __file__, "--one", str(recording), str(results), *(["--staged"] if staged else [])]
    told = subprocess.run(words, capture_output=True, text=True, check=True).stdout
    (line,) = (line for line in told.splitlines() if line.startswith("measured "))
    return dict(json.loads(line.removeprefix("measured ")))


def least(recording: Path, results: Path, repeats: int, *, staged: bool = False) -> dict[str, Any]:
    """Return the fastest of some runs, after one that compiles."""
    found = [measured(recording, results, staged=staged) for _ in range(repeats + 1)]
    return min(found[1:], key=lambda one: float(one["cpu_s"]))


def write_recording(folder: Path, frames: int) -> None:
    """Render a recording with so many frames of each camera."""
    # Not above: its memory would count as that of the run.
    from fusion.simulate.preset import Preset, read_preset
    from fusion.simulate.sines import TRIGGER_JITTER_S, rendered_run, write_run
    from fusion.simulate.world import Draws, make_world

    preset = replace(read_preset(Preset, PRESET), camera_rate_hz=RATE_HZ).reduced(frames, 1.0)
    longer = tuple(replace(daq, duration_s=frames / RATE_HZ + 1.5) for daq in preset.daqs)
    preset = replace(preset, daqs=longer)
    draws = Draws(1, True)
    write_run(folder, rendered_run(preset), make_world(preset, draws, TRIGGER_JITTER_S), draws)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--frames", type=int, nargs="+", default=[53, 106, 211, 422])
    parser.add_argument("--repeats", type=int, default=3)
    parser.add_argument("--keep", type=Path, help="folder for the recordings")
    parser.add_argument("--docs", type=existing_folder, help="folder of performance.md, whose tables are replaced")
    parser.add_argument("--one", type=Path, nargs=2, help=argparse.SUPPRESS)
    parser.add_argument("--staged", action="store_true", help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.one:
        recording, results = options.one
        run_one(recording, results, options.staged)
        return
    rows = []
    with tempfile.TemporaryDirectory() as scratch:
        for frames in options.frames:
            folder = (options.keep or Path(scratch)) / f"frames-{frames}"
            if not (folder / "rig.toml").is_file():
                write_recording(folder, frames)
            recording, images = folder / RECORDING, CAMERAS * frames
            one = least(recording, Path(scratch) / "out", options.repeats)
            row = f"{one['cpu_s']:.1f} | {1e3 * one['cpu_s'] / images:.0f} | {one['peak_mb']:.0f}"
            rows.append(f"| {frames} | {images} | {row} |")
            print(rows[-1], flush=True)
        stages = least(recording, Path(scratch) / "out", options.repeats, staged=True)["stages"]
    whole = sum(stages.values())
    ordered = sorted(stages.items(), key=lambda entry: -entry[1])
    shares = [f"| {name} | {spent_s:.2f} | {100 * spent_s / whole:.0f} |" for name, spent_s in ordered]
    tables = {
        "growth": markdown_table("| frames | images | CPU time / s | per image / ms | peak memory / MB |", rows),
        "stages": markdown_table("| stage | CPU time / s | share / % |", shares),
    }
    print("\n\n".join(tables.values()))
    if options.docs:
        write_marked(options.docs / "performance.md", tables)


if __name__ == "__main__":
    main()
