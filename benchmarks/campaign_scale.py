"""Campaigns of thousands of recordings: what listing, resuming and joining them costs, by their number.

    python benchmarks/campaign_scale.py [100 1000 10000] [--folder FOLDER] [--amplitudes] [--matrix]

Twelve recordings of the preset `sweep` (12 frequencies, other program's points) are evaluated. Their results folders
are multiplied: inputs as hard links under manifests of their own, in `result.h5` what a campaign reads, with another
name, mounting (two recordings each) and noise of 10⁻³ on loads and outputs. `shakercal run` finds nothing to compute
and joins them. With --amplitudes loads grow by a half within each excitation, which asks for the slope over amplitude.
Prints the rows of the table in docs/campaigns.md.
"""

from __future__ import annotations

import argparse
import hashlib
import os
import re
import shutil
import subprocess
import sys
import tempfile
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context
from pathlib import Path

import h5py
import numpy as np

from fusion.base import Settings
from fusion.campaign.recording_results import READ
from fusion.campaign.run import run_path
from fusion.recording.load import RECORDING_NAME
from fusion.report.folder import RESULT_FILE
from fusion.report.recording_report import MERGED_FILES
from fusion.simulate import simulate

FREQUENCIES, PER_FREQUENCY, PER_MOUNTING = 12, 4, 2
NOISE = 1e-3
STEM = re.compile(", (?:mounting|simulated)")
RUN = "import sys; from fusion.cli import main; sys.exit(main(sys.argv[1:]))"


def evaluated(folder: Path, preset: str) -> Path:
    """Return a campaign of one evaluated recording per frequency or excitation, made where it is not there yet."""
    if not (folder / "results").is_dir():
        made = folder.with_name(f"made-{preset}")
        simulate(made, preset, 1)
        for number, place in enumerate(sorted(path.parent for path in made.glob(f"*/{RECORDING_NAME}"))):
            if preset == "sweep" and number % PER_FREQUENCY:
                shutil.rmtree(place)
        made.rename(folder)
        for outcome in run_path(folder, None, Settings()):
            if outcome.error is not None:
                raise outcome.error
    return folder


def multiply(base: Path, campaign: Path, recordings: int, amplitudes: bool) -> None:
    """Make a campaign of so many finished recordings from the few of another one."""
    rng = np.random.default_rng(recordings)
    originals = sorted(path.parent.name for path in base.glob(f"*/{RECORDING_NAME}"))
    for file in (path for path in base.iterdir() if path.is_file()):
        _link(file, campaign / file.name)
    for number in range(recordings):
        original = originals[number % len(originals)]
        turn = number // len(originals)
        copy = f"{original.rpartition('-')[0]}-{turn + 1:05d}"
        text = (base / original / RECORDING_NAME).read_text(encoding="utf-8")
        name = text.partition('name = "')[2].partition('"')[0]
        before_it = text.partition('mounting = "')[2].partition('"')[0]
        other, mounting = f"{STEM.split(name)[0]}, recording {turn + 1}", f"{before_it}-{turn // PER_MOUNTING + 1}"
        text = text.replace(f'name = "{name}"', f'name = "{other}"', 1)
        text = text.replace(f'mounting = "{before_it}"', f'mounting = "{mounting}"', 1)
        for file in (base / original).iterdir():
            if file.is_file() and file.name != RECORDING_NAME:
                _link(file, campaign / copy / file.name)
        (campaign / copy / RECORDING_NAME).write_text(text, encoding="utf-8")
        before, after = base / "results" / original, campaign / "results" / copy
        for file in before.iterdir():
            if file.name in MERGED_FILES:
                after.mkdir(parents=True, exist_ok=True)
                (after / file.name).write_text(file.read_text(encoding="utf-8").replace(name, other), encoding="utf-8")
            elif file.name != RESULT_FILE:
                _link(file, after / file.name)
        size = 1.0 + (0.5 * (turn % 8) / 7 if amplitudes else 0.0)
        noise = size * (1.0 + NOISE * rng.standard_normal(2))
        with h5py.File(before / RESULT_FILE) as old, h5py.File(after / RESULT_FILE, "w", track_order=True) as new:
            for key, value in old.attrs.items():
                new.attrs[key] = {"recording": other, "mounting": mounting}.get(key, value)
            for group in filter(old.__contains__, READ):
                old.copy(group, new, name=group)
            for place, factor in zip(("load/value", "outputs/phasors/value"), noise, strict=True):
                new[place][...] = old[place][()] * factor
            _rename(new, original, copy, hashlib.sha256(text.encode()).hexdigest())


def _link(file: Path, place: Path) -> None:
    place.parent.mkdir(parents=True, exist_ok=True)
    os.link(file, place)


def _rename(file: h5py.File, original: str, copy: str, digest: str) -> None:
    """Let results come from the inputs of another folder, whose manifest has a hash of its own."""
    names = [name.replace(f"{original}/", f"{copy}/") for name in file["provenance/input_file"].asstr()[()]]
    file["provenance/input_file"][...] = names
    file["provenance/input_sha256"][names.index(f"{copy}/{RECORDING_NAME}")] = digest


def cost(campaign: Path) -> tuple[float, float, float, str]:
    """Run a campaign as a user does: CPU time of program and system, s, peak memory, GB, and what was printed."""
    with tempfile.TemporaryFile() as out:
        process = subprocess.Popen([sys.executable, "-c", RUN, "run", "-q", str(campaign)], stdout=out)
        _, status, usage = os.wait4(process.pid, 0)
        if status:
            raise RuntimeError(f"{campaign}: the run ended with {status}")
        out.seek(0)
        told = out.read().decode()
    unit = 1.0 if sys.platform == "darwin" else 1024.0
    return usage.ru_utime, usage.ru_stime, usage.ru_maxrss * unit / 1e9, told


def main(sizes: list[int], folder: Path, amplitudes: bool, preset: str) -> None:
    """Print one row for each number of recordings."""
    with ProcessPoolExecutor(1, get_context("spawn")) as other:  # what forks hands its own peak memory on
        base = other.submit(evaluated, folder / f"base-{preset}", preset).result()
    print("| recordings | CPU time / s | peak memory / GB | joint files / MB |")
    print("|---|---|---|---|")
    for size in sizes:
        campaign = folder / f"{preset}-{size}{'-amplitudes' if amplitudes else ''}"
        if not campaign.exists():
            multiply(base, campaign, size, amplitudes)
        user, system, peak, told = cost(campaign)
        if "evaluated" in told:
            raise RuntimeError(f"{campaign}: expected results that are all there, found {told[:500]}")
        written = sum(file.stat().st_size for file in (campaign / "results").iterdir() if file.is_file()) / 1e6
        print(f"| {size} | {user + system:.1f} | {peak:.2f} | {written:.1f} |", flush=True)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("sizes", nargs="*", type=int, default=[100, 1000, 10000], help="numbers of recordings")
    parser.add_argument("--folder", type=Path, help="where everything is kept (default: nowhere)")
    parser.add_argument("--amplitudes", action="store_true", help="recordings of several amplitudes")
    parser.add_argument("--matrix", action="store_true", help="recordings of a 6 x 6 matrix")
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as temporary:
        where = Path(temporary) if options.folder is None else options.folder
        main(options.sizes, where, options.amplitudes, "matrix" if options.matrix else "sweep")
