"""One campaign here, by two processes and on a Dask cluster of two workers: the same tables, and how long each takes.

    python benchmarks/campaign.py [--recordings 48] [--folder FOLDER]

Recordings of another program's points (preset `sweep`: 12 frequencies, 4 recordings each) with their reports, computed
one way after the other on the same machine. Prints a table.
"""

from __future__ import annotations

import argparse
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from fusion.base import Settings
from fusion.campaign.run import run_path
from fusion.simulate import simulate

WORKERS = 2


@contextmanager
def cluster(folder: Path) -> Iterator[str]:
    """Start a scheduler and its workers as a laboratory does, and yield the scheduler's address."""
    from distributed import Client

    dask = [sys.executable, "-m", "dask"]
    place = folder / "scheduler.json"
    named = ["--scheduler-file", str(place), "--no-dashboard"]
    words = [[*dask, "scheduler", "--port", "0"], *[[*dask, "worker", "--nthreads", "1", "--no-nanny"]] * WORKERS]
    quiet = subprocess.DEVNULL
    started = [subprocess.Popen([*own, *named], stdout=quiet, stderr=quiet, cwd=folder) for own in words]
    try:
        while not place.exists():
            time.sleep(0.1)
        with Client(scheduler_file=str(place), set_as_default=False) as client:
            client.wait_for_workers(WORKERS)
            address = str(client.scheduler_info()["address"])
        yield address
    finally:
        for process in started:
            process.kill()
            process.wait()


def timed(campaign: Path, out: Path, workers: int | str = 1) -> float:
    """Run the campaign and return the time it took, in seconds."""
    started = time.perf_counter()
    for outcome in run_path(campaign, out, Settings(), workers=workers):
        if outcome.error is not None:
            raise outcome.error
    return time.perf_counter() - started


def tables(folder: Path) -> dict[str, bytes]:
    """Every table below a folder of results."""
    return {path.relative_to(folder).as_posix(): path.read_bytes() for path in folder.rglob("*.csv")}


def main(recordings: int, folder: Path) -> None:
    """Print one row for each way."""
    campaign = folder / "campaign"
    simulate(campaign, "sweep", 1, recordings=recordings)
    print("| computed by | s | of the serial run | tables equal to the serial run's |")
    print("|---|---|---|---|")
    serial = timed(campaign, folder / "serial")
    expected = tables(folder / "serial")
    print(f"| this process | {serial:.0f} | 1 | {len(expected)} |", flush=True)
    with cluster(folder) as address:
        ways: dict[str, int | str] = {f"{WORKERS} processes": WORKERS, f"Dask, {WORKERS} workers": address}
        for number, (name, workers) in enumerate(ways.items()):
            out = folder / f"way-{number}"
            seconds = timed(campaign, out, workers)
            found = tables(out)
            equal = sum(found.get(table) == content for table, content in expected.items())
            print(f"| {name} | {seconds:.0f} | {seconds / serial:.2f} | {equal} of {len(expected)} |", flush=True)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--recordings", type=int, default=48, help="how many (default: 48)")
    parser.add_argument("--folder", type=Path, help="where everything is kept (default: nowhere)")
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as temporary:
        main(options.recordings, Path(temporary) if options.folder is None else options.folder)
