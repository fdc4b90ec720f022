"""Archives of many recordings: what listing, resuming, collecting, queries and compare cost, by their number.

    python benchmarks/archive.py [--sizes 10 100 1000] [--rows 1000 10000 100000] [--folder FOLDER] [--docs docs]

The demo recording is evaluated once, and multiplied: each copy has a manifest of its own with another name and date,
its 100 images and channels as hard links, and a result with noise of 10⁻³, whose fields of images are left out. The
store is the local disk by its address (file://), so that no latency of a network is included. Times are CPU times of
all threads, the smallest of three. The exponent p of cost ~ number^p is that from the second largest to the largest
archive, and extrapolates the cost of the largest to 10⁵ recordings, at least in proportion. Databases of 10⁵
recordings are not extrapolated: the rows of the largest archive are multiplied for them.
"""

from __future__ import annotations

import argparse
import csv
import json
import math
import os
import resource
import sys
import tempfile
import time
from collections.abc import Callable, Mapping
from concurrent.futures import ProcessPoolExecutor
from datetime import date, timedelta
from multiprocessing import get_context
from pathlib import Path
from unittest.mock import patch

import h5py
import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.parquet as pq
from marked import existing_folder, markdown_row, markdown_table, write_marked

from fusion.base import Settings
from fusion.campaign.run import run_path
from fusion.campaign.stored_campaign import SOURCE_FILE, fetched_campaign
from fusion.recording.load import RECORDING_NAME
from fusion.report.folder import RESULT_FILE, SENSITIVITY_FILE
from fusion.report.object_store import ObjectStore
from fusion.report.result_database import NUMBERS, collect_results, query_results
from fusion.sensor.compare.comparison_evaluation import evaluate_comparison
from fusion.sensor.compare.comparison_inputs import read_compared

DEMO = Path(__file__).resolve().parent.parent / "sample_images" / "demo"
RECORDING = "Fz-0080"
KEPT = ("sensor", "sensitivity", "element", "evidence", "provenance")
NOISE, PER_SENSOR, REPEATS, FULL = 1e-3, 50, 3, 100_000
RENEWED: list[float] = []
"""CPU times of additions to databases, s."""
CONDITION = "serial = 'S0000' and channel = 'Fz' and component = 'Fz' and kind = 'element'"


def make_archive(folder: Path, size: int, results: Path) -> None:
    """Write a campaign of so many recordings with results."""
    rng = np.random.default_rng(size)
    for path in (path for path in DEMO.rglob("*") if path.is_file() and RECORDING not in path.parts):
        link(path, folder / path.relative_to(DEMO))
    text = (DEMO / RECORDING / RECORDING_NAME).read_text(encoding="utf-8")
    for number in range(size):
        place = folder / f"{RECORDING}-{number:05d}"
        for path in (path for path in (DEMO / RECORDING).rglob("*") if path.is_file() and "results" not in path.parts):
            if path.name != RECORDING_NAME:
                link(path, place / path.relative_to(DEMO / RECORDING))
        (place / RECORDING_NAME).write_text(f"# {number}\n{text}", encoding="utf-8")
        after = folder / "results" / place.name
        after.mkdir(parents=True)
        with h5py.File(results / RESULT_FILE) as old, h5py.File(after / RESULT_FILE, "w") as new:
            new.attrs.update(old.attrs)
            for name in filter(old.__contains__, KEPT):
                old.copy(name, new, name=name)
            new.attrs["date"] = (date(2024, 1, 1) + timedelta(days=number % PER_SENSOR * 20)).isoformat()
            new["sensor"].attrs["serial"] = f"S{number // PER_SENSOR:04d}"
            new["provenance/input_sha256"][0] = f"{number:064x}"
        with (results / SENSITIVITY_FILE).open(encoding="utf-8") as table:
            rows = list(csv.DictReader(table))
        with (after / SENSITIVITY_FILE).open("w", encoding="utf-8", newline="") as table:
            writer = csv.DictWriter(table, rows[0])
            writer.writeheader()
            for row in rows:
                varied = {name: repr(float(row[name]) * (1.0 + NOISE * rng.standard_normal())) for name in NUMBERS[1:]}
                writer.writerow(row | varied)


def link(path: Path, target: Path) -> None:
    target.parent.mkdir(parents=True, exist_ok=True)
    os.link(path, target)


def mark_current(address: str) -> None:
    """Write the sources of all results, as a run does."""
    with fetched_campaign(address) as campaign:
        for recording in campaign.recordings.values():
            if recording.target is not None:
                content = json.dumps({"address": recording.address, "key": recording.key_of(Settings())})
                recording.target.write({SOURCE_FILE: content.encode()})


def check(address: str) -> None:
    """Ask for every recording whether its results are current, as a run does."""
    with fetched_campaign(address) as campaign:
        for manifest, recording in campaign.recordings.items():
            if not recording.is_current(campaign.output / manifest.parent.name, Settings()):
                raise RuntimeError(f"{recording.address}: expected current results")


def cpu_s(work: Callable[[], object], before: Callable[[], object] = lambda: None, repeats: int = REPEATS) -> float:
    """Return the smallest CPU time of some calls, each after `before`."""
    times = []
    for _ in range(repeats):
        before()
        begun = time.process_time()
        work()
        times.append(time.process_time() - begun)
    return min(times)


def transfer(address: str) -> None:
    """Fetch the files of a recording."""
    with fetched_campaign(address) as campaign:
        recording = next(iter(campaign.recordings.values()))
        with recording.fetched():
            pass


def measured(folder: Path, size: int) -> dict[str, float]:
    """Return CPU times in s of every step for an archive, its peak memory in MB, and its database in kB."""
    address, database = folder.as_uri(), folder.with_suffix(".parquet")
    mark_current(address)
    found = {
        "list all files": cpu_s(lambda: ObjectStore(address).files()),
        "list, read manifests, find all results current": cpu_s(lambda: check(address)),
        "collect all results": cpu_s(
            lambda: collect_results(folder, database), lambda: database.unlink(missing_ok=True), 2
        ),
        "collect, none changed": cpu_s(lambda: collect_results(folder, database)),
    }
    return found | {"memory": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e3, "size": size}


def multiply_rows(database: Path, target: Path, recordings: int) -> None:
    """Write a database of so many recordings from that of fewer."""
    table = pq.read_table(database)
    paths = table["path"].to_pylist()
    count = len(set(paths))
    parts, rng = [], np.random.default_rng(recordings)
    for turn in range(math.ceil(recordings / count)):
        part = table
        for name in ("path", "serial", "input_hash", "result"):
            texts = pa.array([f"{turn}{text}" if turn else text for text in table[name].to_pylist()])
            part = part.set_column(part.schema.get_field_index(name), table.schema.field(name), texts)
        for name in NUMBERS[1:]:
            numbers = pa.array(np.asarray(table[name]) * (1.0 + NOISE * rng.standard_normal(len(table))))
            part = part.set_column(part.schema.get_field_index(name), table.schema.field(name), numbers)
        parts.append(part)
    whole = pa.concat_tables(parts).sort_by(
        [(name, "ascending") for name in ("serial", "channel", "component", "kind")]
    )
    pq.write_table(whole, target, compression="zstd", row_group_size=50_000)


def compare(database: Path) -> None:
    """Compare two years of a sensor."""
    queries: Mapping[str, str] = {str(year): f"{database}?{CONDITION} and year(date) = {year}" for year in (2024, 2025)}
    evaluate_comparison(read_compared(queries))


def renew(database: Path, archive: Path) -> None:
    """Collect one new result into a database in which all others are unchanged."""
    table = pq.read_table(database)
    first = next(path for path in table["path"].unique().to_pylist() if (archive / path).is_file())
    pq.write_table(table.filter(pc.not_equal(table["path"], first)), database)
    tags = dict(zip(table["path"].to_pylist(), table["tag"].to_pylist(), strict=True))
    with patch.object(ObjectStore, "files", lambda _: tags):
        begun = time.process_time()
        found = collect_results(archive, database)
        RENEWED.append(time.process_time() - begun)
    if (found.read, found.rows) != (1, table.num_rows):
        raise RuntimeError(f"{database}: expected one result to be read, found {found}")


def database_row(database: Path, archive: Path, recordings: int) -> str:
    """Return the row of a database: size, query, compare, renewal."""
    rows = len(query_results(database, CONDITION))
    if not 0 < rows <= PER_SENSOR:
        raise RuntimeError(f"{database}: expected {PER_SENSOR} rows, found {rows}")
    query = cpu_s(lambda: query_results(database, CONDITION))
    compared = cpu_s(lambda: compare(database))
    renew(database, archive)
    mb = database.stat().st_size / 1e6
    total = pq.read_metadata(database).num_rows
    return markdown_row(
        f"{recordings}", f"{total}", f"{mb:.1f}", f"{1e3 * query:.0f}", f"{1e3 * compared:.0f}", f"{RENEWED[-1]:.2g}"
    )


def main(sizes: list[int], rows: list[int], folder: Path, docs: Path | None) -> None:
    results = folder / "demo-results"
    if not results.is_dir():
        run_path(DEMO / RECORDING, results, Settings())
    table = []
    for size in sizes:
        archive = folder / f"archive-{size}"
        if not archive.is_dir():
            make_archive(archive, size, results)
        with ProcessPoolExecutor(1, get_context("spawn")) as other:
            table.append(other.submit(measured, archive, size).result())
            print(table[-1], file=sys.stderr, flush=True)
    steps = [name for name in table[0] if name not in ("memory", "size")]
    lines = []
    for step in steps:
        costs = [found[step] for found in table]
        p = math.log(costs[-1] / costs[-2]) / math.log(sizes[-1] / sizes[-2])
        full = costs[-1] * (FULL / sizes[-1]) ** max(p, 1.0)
        each = [f"{1e3 * cost / size:.2g}" for cost, size in zip(costs, sizes, strict=True)]
        lines.append(markdown_row(step, *each, f"{p:.2f}", f"{full / 60:.2g}"))
    memory = [f"{found['memory']:.0f}" for found in table]
    lines.append(markdown_row("peak memory of all steps / MB", *memory, "–", "–"))
    counts = " | ".join(f"{size} recordings" for size in sizes)
    costs_table = markdown_table(
        f"| CPU time for each recording / ms | {counts} | exponent p | 10⁵ recordings / min |", lines
    )
    databases = []
    for count in rows:
        database = folder / f"rows-{count}.parquet"
        multiply_rows(folder / f"archive-{sizes[-1]}.parquet", database, count)
        databases.append(database_row(database, folder / f"archive-{sizes[-1]}", count))
        print(databases[-1], file=sys.stderr, flush=True)
    head = "| recordings | rows | MB | query of one sensor / ms | compare of two years / ms | add one result / s |"
    made = {"archive costs": costs_table, "archive databases": markdown_table(head, databases)}
    print("\n\n".join(made.values()))
    if docs is not None:
        write_marked(docs / "archive.md", made)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--sizes", nargs="+", type=int, default=[10, 100, 1000], help="recordings of the archives")
    parser.add_argument("--rows", nargs="+", type=int, default=[1000, 10_000, 100_000], help="recordings of databases")
    parser.add_argument("--folder", type=Path, help="where everything is kept (default: nowhere)")
    parser.add_argument("--docs", type=existing_folder, help="folder of the page that gets the tables")
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as temporary:
        main(options.sizes, options.rows, options.folder or Path(temporary), options.docs)
