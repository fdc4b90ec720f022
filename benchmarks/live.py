"""How fast `shakercal look --live` follows a stereo pair of 1280 x 1024 px, and what it costs.

Usage: python benchmarks/live.py [--frames 326] [--keep FOLDER] [--docs docs] [--rates 25 53 80 --seconds 40 --cores 2]

Renders one pair whose motion repeats after 80 frames. Printed, with --docs into live.md there: CPU time of reading,
following and evaluating, and the rate that two cores carry with an evaluation share of `EVALUATION_SHARE`.

With --rates, on a machine without other work, the frames are also linked into a folder, as a camera writes them, while
the command analyses them on so many cores. Printed: the share of analysed frames, the frames that wait at the end, CPU
time of a pair, and U of the last state.
"""

from __future__ import annotations

import argparse
import json
import os
import resource
import shutil
import subprocess
import sys
import tempfile
import time
from concurrent.futures import ProcessPoolExecutor
from dataclasses import replace
from multiprocessing import get_context
from pathlib import Path
from threading import Thread

import tifffile
from large_recording import setups
from marked import existing_folder, markdown_table, write_marked

from fusion.planning.look.live import START_FRAMES, LiveEvaluation, LiveFrame
from fusion.planning.look.live_command import EVALUATION_SHARE
from fusion.simulate.preset import Preset, read_preset
from fusion.simulate.sines import rendered_run, write_run
from fusion.simulate.world import Draws, make_world
from photogram.images.image_files import open_sequence

RATE_HZ, PERIOD = 53.0, 80  # of the simulation; other rates only feed faster or slower
HEAD = "| offered frames/s | analysed | waiting at the end | user CPU of a pair / ms | U (95 %) / % |"


def main() -> None:
    """Render, feed at each rate, print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--frames", type=int, default=326)
    parser.add_argument("--rates", type=float, nargs="+", default=[])
    parser.add_argument("--seconds", type=float, default=40.0)
    parser.add_argument("--cores", type=int, default=2)
    parser.add_argument("--keep", type=Path, help="folder for the recording, kept and used again")
    parser.add_argument("--docs", type=existing_folder)
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as scratch:
        source = options.keep or Path(scratch)
        if not (source / "rig.toml").is_file():
            with ProcessPoolExecutor(max_workers=1, mp_context=get_context("spawn")) as pool:
                pool.submit(write_recording, source).result()
        table = markdown_table("| step | CPU time |", costs(source, options.frames))
        print(table)
        if options.rates:
            rows = [follow(source, rate, options.seconds, options.cores) for rate in options.rates]
            print(markdown_table(HEAD, rows))
    if options.docs:
        write_marked(options.docs / "live.md", {"live rates": table})


def write_recording(folder: Path) -> None:
    """Write the recording of one pair on the load, whose images repeat after `PERIOD` frames."""
    line_hz = RATE_HZ * (2.0 + 1.0 / PERIOD)
    preset = read_preset(Preset, "nitsche2018")
    preset = replace(preset, stereo=tuple(setups())[:1], camera_rate_hz=RATE_HZ, frames=PERIOD, fundamental_hz=line_hz)
    draws = Draws(1, False)
    recording = write_run(folder, rendered_run(preset), make_world(preset, draws, 0.0), draws)
    for path in recording.glob("*/*.tif"):  # uncompressed, as cameras write them
        tifffile.imwrite(path, tifffile.imread(path), photometric="minisblack", metadata=None)


def costs(source: Path, frames: int) -> list[str]:
    """Return rows: CPU time of the steps, in this process, one after the other."""
    (given,) = source.glob("*/recording.toml")
    files = [sorted(folder.glob("*.tif")) for folder in sorted(given.parent.iterdir()) if folder.is_dir()]
    read_s, follow_s, now = 0.0, list[float](), time.process_time
    with LiveEvaluation(given, RATE_HZ) as evaluation:
        (pair,) = evaluation.pairs
        for number in range(frames):
            begun = now()
            images = tuple(open_sequence([side[number % len(side)]]).read(0) for side in files)
            read_s += now() - begun
            begun = now()
            evaluation.add(LiveFrame(pair, number, images))
            evaluation.snapshot(1 if number < frames - 1 else 0)
            follow_s.append(now() - begun)
        begun = now()
        state = evaluation.state()
        evaluate_s = now() - begun
    start_s, each_s = sum(follow_s[:START_FRAMES]), sum(follow_s[START_FRAMES:]) / (frames - START_FRAMES)
    rate_hz = (2.0 - EVALUATION_SHARE) / (each_s + read_s / frames)
    assert state.driven is not None
    return [
        f"| start, {START_FRAMES} pairs | {start_s:.1f} s |",
        f"| read a pair, uncompressed TIFF | {1e3 * read_s / frames:.1f} ms |",
        f"| follow a pair | {1e3 * each_s:.0f} ms |",
        f"| evaluate {frames} pairs | {evaluate_s:.1f} s |",
        f"| computed from these: pairs/s that two cores carry | {rate_hz:.0f} |",
    ]


def follow(source: Path, rate_hz: float, seconds: float, cores: int) -> str:
    """Return a row: one rate offered for some time."""
    (given,) = source.glob("*/recording.toml")
    with tempfile.TemporaryDirectory(dir=source.parent) as scratch:
        folder = Path(scratch)
        shutil.copy(source / "rig.toml", folder)
        shutil.copytree(source / "calibration", folder / "calibration")
        (folder / "live").mkdir()
        recording = folder / "live" / "recording.toml"
        shutil.copy(given, recording)
        feeder = Thread(target=feed, args=(given.parent, recording.parent, rate_hz, seconds))
        processors = ",".join(map(str, sorted(os.sched_getaffinity(0))[:cores]))
        command = ["taskset", "-c", processors, sys.executable, "-m", "shakercal", "look", "--live"]
        before = resource.getrusage(resource.RUSAGE_CHILDREN).ru_utime
        with subprocess.Popen(
            [*command, str(recording.parent), "--rate", str(RATE_HZ), "--json"],
            stdout=subprocess.PIPE,
            text=True,
            env=os.environ | {"OMP_NUM_THREADS": str(cores)},
        ) as process:
            assert process.stdout is not None
            next(process.stdout)  # after the imports
            feeder.start()
            states, end = [], None
            while end is None or time.monotonic() < end:
                event = json.loads(process.stdout.readline())
                states += [event] if event["event"] == "live" else []
                if end is None and not feeder.is_alive():
                    end = time.monotonic()
            process.terminate()
        cpu_s = resource.getrusage(resource.RUSAGE_CHILDREN).ru_utime - before
    last = states[-1]
    count = max(last["frames"].values())
    offered = count + last["skipped"] + last["behind"]
    value = next((v for v in last["values"] if v["driven"] and v["body"] == "load"), None)
    percent = "" if value is None else f"{100 * value['U'] / value['amplitude']:.2g}"
    share = f"{100 * count / offered:.0f} %"
    return f"| {rate_hz:g} | {share} | {last['behind']} | {1e3 * cpu_s / count:.0f} | {percent} |"


def feed(source: Path, target: Path, rate_hz: float, seconds: float) -> None:
    """Link frames into a folder at a rate."""
    cameras = [entry for entry in source.iterdir() if entry.is_dir()]
    files = {camera.name: sorted(camera.glob("*.tif")) for camera in cameras}
    for name in files:
        (target / name).mkdir(exist_ok=True)
    start = time.monotonic()
    for number in range(int(rate_hz * seconds)):
        time.sleep(max(0.0, start + number / rate_hz - time.monotonic()))
        for name, paths in files.items():
            os.link(paths[number % len(paths)], target / name / f"{number:06d}.tif")


if __name__ == "__main__":
    main()
