"""Whole commands from start to end: CPU time and memory, alone or compared with those of another checkout.

Usage: python benchmarks/commands.py [--before FOLDER] [--repeats 3] [--keep FOLDER] [--docs docs]

Each command is a process of its own; of the repeats, taken in turn with those of the other checkout, the smallest time
counts. Kernels are compiled and modules read once before. The recordings are the demo in the repository and a simulated
`nitsche2018` (844 images of 640 x 512 px, 12 bit, deflated), which takes two minutes to render and is kept in --keep;
the same with cameras of 1280 x 1024 px and some 1000 subsets in each takes four minutes and 1.4 GB. `lines` reads 30
million samples; `step` and `decouple` fit the 19 releases of preset `steps`, `cameras` the images of preset `targets`,
`compensate` uses the models of `elastomer`. CPU time depends little on other programs of the machine. With --docs the
table goes to performance.md there, without the other checkout.
"""

from __future__ import annotations

import argparse
import os
import subprocess
import sys
import tempfile
from dataclasses import dataclass, replace
from pathlib import Path

import h5py
import numpy as np
from marked import existing_folder, markdown_table, write_marked

from fusion.cli import main as shakercal

ROOT = Path(__file__).resolve().parents[1]
DEMO = ROOT / "sample_images" / "demo"
SAMPLES, RATE_HZ = 30_000_000, 51_200.0


@dataclass(frozen=True)
class Case:
    """A command: its name in the table, its arguments."""

    name: str
    arguments: tuple[str, ...]


@dataclass(frozen=True)
class Spent:
    """Resources that a process used."""

    cpu_s: float
    peak_mb: float


def cases(kept: Path, results: Path) -> list[Case]:
    """Return the commands by kind."""
    recording, run = kept / "nitsche2018" / "Fz-0106.25", ("-o", str(results), "--force", "-q")
    pictures, charuco = (str(kept / "targets" / side) for side in ("left", "right")), ("--target", "charuco")
    models = kept / "elastomer" / "models.json"
    free = (*charuco, "--size", "11x8", "--spacing", "9e-3", "--shape", "free", "-o", f"{results}.json", *run[2:])
    return [
        Case("`--help`", ("--help",)),
        Case("`check` of the demo", ("check", str(DEMO), "-q")),
        Case("`run` of the demo, 96 images of 304 × 240 px", ("run", str(DEMO / "Fz-0080"), *run)),
        Case("`run`, 844 images of 640 × 512 px", ("run", str(recording), *run)),
        Case("`run`, 844 images of 1280 × 1024 px", ("run", str(kept / "large" / recording.name), *run)),
        Case("`lines`, 30 million samples", ("lines", str(kept / "long.h5"), "-q")),
        Case("`cameras --shape free`, 2 × 10 images", ("cameras", *pictures, *free)),
        Case("`step --method all`, 19 releases", ("step", str(kept / "steps"), "--method", "all", *run)),
        Case("`decouple`, 19 releases", ("decouple", str(kept / "steps"), *run)),
        Case("`compensate`, six channels", ("compensate", str(models), "--frequency", "900", *run)),
    ]


def make_inputs(kept: Path) -> None:
    """Write what is not there yet."""
    for preset in ("nitsche2018", "steps", "targets", "elastomer"):
        if not (kept / preset).is_dir():
            shakercal(["simulate", str(kept / preset), "--preset", preset, "-q"])
    if not (kept / "large" / "rig.toml").is_file():  # comes last
        # Not above: the memory of this process counts as that of all it begins.
        from large_recording import setups

        from fusion.simulate.preset import Preset, read_preset
        from fusion.simulate.sines import TRIGGER_JITTER_S, rendered_run, write_run
        from fusion.simulate.world import Draws, make_world

        larger, draws = replace(read_preset(Preset, "nitsche2018"), stereo=tuple(setups())), Draws(1, True)
        write_run(kept / "large", rendered_run(larger), make_world(larger, draws, TRIGGER_JITTER_S), draws)
    if not (kept / "long.h5").is_file():
        time_s, rng = np.arange(SAMPLES) / RATE_HZ, np.random.default_rng(1)
        samples = np.sin(2.0 * np.pi * 106.25 * time_s) + 1e-3 * rng.standard_normal(SAMPLES)
        with h5py.File(kept / "long.h5", "w") as file:
            file.create_dataset("Fz", data=samples.astype(np.float32)).attrs["sample_rate"] = RATE_HZ


def spent(checkout: Path, case: Case) -> Spent:
    """Run a command of a checkout and return its resources; exit with its status if it fails."""
    program = [sys.executable, "-c", "from fusion.cli import main; raise SystemExit(main())", *case.arguments]
    with tempfile.TemporaryFile() as told:
        process = subprocess.Popen(program, cwd=checkout, env=os.environ | {"PYTHONPATH": str(checkout)}, stdout=told)
        _, status, used = os.wait4(process.pid, 0)
    if status:
        raise SystemExit(f"shakercal {' '.join(case.arguments)}: ended with status {status >> 8}")
    return Spent(used.ru_utime + used.ru_stime, used.ru_maxrss / 1024)


def row(case: Case, checkouts: list[Path], repeats: int) -> str:
    """Measure a case and return its row."""
    taken: list[list[Spent]] = [[] for _ in checkouts]
    for number in range(repeats + 1):
        for checkout, all_of_it in zip(checkouts, taken, strict=True):
            found = spent(checkout, case)
            if number > 0:  # the first one compiles
                all_of_it.append(found)
    cpu_s = [min(one.cpu_s for one in each) for each in taken]
    before = f" {cpu_s[1]:.1f} ({cpu_s[1] / cpu_s[0]:.2f}×) |" if cpu_s[1:] else ""
    peak = max(one.peak_mb for one in taken[0])
    return f"| {case.name} | {cpu_s[0]:.1f} | {peak:.0f} |{before}"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--before", type=Path, help="another checkout, measured in turn with this one")
    parser.add_argument("--repeats", type=int, default=3)
    parser.add_argument("--keep", type=Path, help="folder for what is simulated")
    parser.add_argument("--docs", type=existing_folder, help="folder of performance.md, whose table is replaced")
    options = parser.parse_args()
    checkouts = [ROOT, *([options.before.resolve()] if options.before else [])]
    with tempfile.TemporaryDirectory() as scratch:
        kept = Path(scratch) if options.keep is None else options.keep.resolve()
        make_inputs(kept)
        rows = []
        for case in cases(kept, Path(scratch) / "results"):
            rows.append(row(case, checkouts, options.repeats))
            print(rows[-1], flush=True)
    before = " CPU time before / s |" if options.before else ""
    table = markdown_table(f"| command | CPU time / s | peak memory / MB |{before}", rows)
    print(table)
    if options.docs and not options.before:
        write_marked(options.docs / "performance.md", {"commands": table})


if __name__ == "__main__":
    main()
