"""Damaged and lying files for every reader: data, or one sentence that names the file, in bounded time and memory.

Usage: python benchmarks/fuzz_files.py [--inputs 500] [--seed 1] [--only tdms png] [--data ../shared/data]

Small valid files of every kind are written, or taken from the folder of real data where no library writes them. Every
input is one of them with one to four changes: bits flipped, bytes replaced, taken out, put in or doubled, the end cut
off, whole numbers of 1 to 8 bytes and numbers in text set to extreme values. A process of its own reads them, so that
a crash or a hang costs one input. Counted: files read as data, files refused by `OSError`, `ValueError` or
`InputError` with one sentence that begins with the path, anything else (other errors, sentences without the path,
crashes of the process), inputs that took more than ten seconds of the processor or gave no answer within a minute, and
the largest memory.
"""

from __future__ import annotations

import argparse
import json
import os
import re
import resource
import subprocess
import sys
import tempfile
import threading
import warnings
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from queue import Empty, Queue
from typing import Any

import numpy as np

# The packages before the folders of tests that have their names.
sys.path.append(str(Path(__file__).resolve().parents[1]))
sys.path.append(str(Path(__file__).resolve().parents[1] / "tests"))

import fuzz_seeds

from fusion import InputError

LONGEST_S = 10.0  # of the processor
NO_ANSWER_S = 60.0
MEMORY = 4 << 30  # address space of the reading process: nothing may need more
EXTREMES = (0, 1, 0x7F, 0x80, 0xFF, 0x7FFF, 0xFFFF, 0x7FFFFFFF, 0x80000000, 0xFFFFFFFF, 10**12, 2**63 - 1, 2**64 - 1)
TEXTS = (b"0", b"-1", b"1e300", b"nan", b"inf", b"99999999999", b"1" * 5000, b"\xb2", b"1e-300", b"", b"0x1", b"2.5")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--inputs", type=int, default=500, help="for every kind of file")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--only", nargs="*", default=[], help="kinds of files")
    parser.add_argument("--data", type=Path, default=Path(os.environ.get("SHAKERCAL_DATA", "../shared/data")))
    parser.add_argument("--read", nargs=3, metavar=("KIND", "FIRST", "FOLDER"), help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.read:
        kind, first, folder = options.read
        read_inputs(kind, range(int(first), options.inputs), options.seed, Path(folder))
        return
    print(
        "| kind | inputs | data | refused | wrong | slowest s | memory MB |\n|---|---|---|---|---|---|---|", flush=True
    )
    wrong = 0
    for kind in options.only or fuzz_seeds.SEEDS:
        found = fuzzed(kind, options.inputs, options.seed, options.data)
        if found is None:
            print(f"| {kind} | no file to start from |", flush=True)
            continue
        wrong += len(found.wrong)
        print(found.row(kind), flush=True)
        for text in found.wrong[:20]:
            print(f"    {text}", flush=True)
    sys.exit(1 if wrong else 0)


@dataclass
class Found:
    """What became of the inputs of one kind: counts, what went wrong in words, seconds and memory."""

    data: int = 0
    refused: int = 0
    wrong: list[str] = field(default_factory=list)
    slowest_s: float = 0.0
    memory_mb: float = 0.0

    def row(self, kind: str) -> str:
        """Return them as a row of the table."""
        inputs = self.data + self.refused + len(self.wrong)
        counts = f"{inputs} | {self.data} | {self.refused} | {len(self.wrong)}"
        return f"| {kind} | {counts} | {self.slowest_s:.2f} | {self.memory_mb:.0f} |"


def fuzzed(kind: str, inputs: int, seed: int, data: Path) -> Found | None:
    """Return what became of the inputs of one kind, None where there is no file to start from."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        (folder / "sound").mkdir()
        if not fuzz_seeds.SEEDS[kind].write(folder / "sound", data):
            return None
        found, first = Found(), 0
        while first < inputs:
            first = _one_process(kind, first, inputs, seed, folder, found)
        return found


def _one_process(kind: str, first: int, inputs: int, seed: int, folder: Path, found: Found) -> int:
    """Read inputs in one process until it ends or hangs; return the input to go on from."""
    numbers = ["--inputs", str(inputs), "--seed", str(seed), "--read", kind, str(first), str(folder)]
    command = [sys.executable, str(Path(__file__).resolve()), *numbers]
    process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True)
    lines: Queue[str] = Queue()
    assert process.stdout is not None
    reading = threading.Thread(target=lambda: list(map(lines.put, process.stdout or ())), daemon=True)
    reading.start()
    try:
        return _answers(process, reading, lines, range(first, inputs), found)
    finally:
        process.wait()
        reading.join()
        process.stdout.close()


def _answers(
    process: subprocess.Popen[str], reading: threading.Thread, lines: Queue[str], numbers: range, found: Found
) -> int:
    """Collect what a process says of its inputs until it ends or hangs; return the input to go on from."""
    number, inputs = numbers.start, numbers.stop
    while number < inputs:
        try:
            told = json.loads(lines.get(timeout=NO_ANSWER_S if reading.is_alive() or not lines.empty() else 0.2))
        except Empty:
            hangs = process.poll() is None
            process.kill()
            process.wait()
            what = f"no answer within {NO_ANSWER_S:g} s" if hangs else f"the process ended with {process.returncode}"
            found.wrong.append(f"input {number}: {what}")
            return number + 1
        except json.JSONDecodeError:
            continue  # what a library prints of its own
        number += 1
        found.slowest_s = max(found.slowest_s, told["seconds"])
        found.memory_mb = max(found.memory_mb, told["memory_mb"])
        if told["wrong"] or told["seconds"] > LONGEST_S:
            found.wrong.append(f"input {told['number']}: {told['wrong'] or told['seconds']}")
        elif told["data"]:
            found.data += 1
        else:
            found.refused += 1
    return inputs


def read_inputs(kind: str, numbers: range, seed: int, folder: Path) -> None:
    """Read the inputs of these numbers and print a line about each."""
    resource.setrlimit(resource.RLIMIT_AS, (MEMORY, MEMORY))
    warnings.simplefilter("error")
    own = fuzz_seeds.SEEDS[kind]
    for number in numbers:
        path = changed_file(own.paths(folder / "sound"), folder, np.random.default_rng([seed, number]))
        start = _cpu_s()
        data, wrong = outcome(own.reads, path)
        told = {"number": number, "seconds": _cpu_s() - start, "data": data, "wrong": wrong}
        told["memory_mb"] = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024.0
        print(json.dumps(told), flush=True)
        for old in (folder / "read").iterdir():
            old.unlink()


def _cpu_s() -> float:
    """Return the processor time of this process and those that it started and that have ended, in seconds."""
    used = (resource.getrusage(who) for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN))
    return sum(own.ru_utime + own.ru_stime for own in used)


def outcome(reads: Sequence[Callable[[Path], Any]], path: Path) -> tuple[bool, str]:
    """Tell whether any of the calls reads a file as data, and what went wrong (empty where it is as it should be)."""
    data, wrong = False, ""
    for read in reads:
        try:
            read(path)
            data = True
        except (OSError, ValueError, InputError) as error:
            text = str(error).removeprefix(f"{error.code} ") if isinstance(error, InputError) else str(error)
            if not text.startswith(str(path.parent)) or "\n" in text or isinstance(error, UnicodeError):
                wrong = f"{type(error).__name__}: {text[:300]!r}"
        except BaseException as error:
            wrong = f"{type(error).__name__}: {str(error)[:300]!r}"
    return data, wrong


def changed_file(sound: list[Path], folder: Path, rng: np.random.Generator) -> Path:
    """Write a changed copy of one of the sound files, with what stands beside it, and return its path."""
    place = folder / "read"
    place.mkdir(exist_ok=True)
    own = sound[int(rng.integers(len(sound)))]
    for beside in own.parent.iterdir():
        if beside.stem == own.stem and beside != own:
            (place / beside.name).symlink_to(beside)
    path = place / own.name
    path.write_bytes(changed(own.read_bytes(), rng))
    return path


def changed(content: bytes, rng: np.random.Generator) -> bytes:
    """Return content with one to four changes, some of them near its start, where headers stand."""
    data = bytearray(content)
    for _ in range(int(rng.integers(1, 5))):
        if not data:
            break
        reach = len(data) if rng.random() < 0.5 else min(len(data), 2048)
        place = int(rng.integers(reach))
        _CHANGES[int(rng.integers(len(_CHANGES)))](data, place, rng)
    return bytes(data)


def _flip(data: bytearray, place: int, rng: np.random.Generator) -> None:
    data[place] ^= 1 << int(rng.integers(8))


def _replace(data: bytearray, place: int, rng: np.random.Generator) -> None:
    new = rng.bytes(int(rng.integers(1, 9)))
    data[place : place + len(new)] = new


def _number(data: bytearray, place: int, rng: np.random.Generator) -> None:
    size = int(2 ** rng.integers(4))
    value = EXTREMES[int(rng.integers(len(EXTREMES)))] & (256**size - 1)
    place = place // size * size if rng.random() < 0.7 else place
    data[place : place + size] = value.to_bytes(size, "little" if rng.random() < 0.7 else "big")


def _cut(data: bytearray, place: int, rng: np.random.Generator) -> None:
    del data[place:]


def _take_out(data: bytearray, place: int, rng: np.random.Generator) -> None:
    del data[place : place + int(rng.integers(1, 65))]


def _put_in(data: bytearray, place: int, rng: np.random.Generator) -> None:
    data[place:place] = rng.bytes(int(rng.integers(1, 33)))


def _double(data: bytearray, place: int, rng: np.random.Generator) -> None:
    size = int(rng.integers(1, 513))
    data[place:place] = data[place : place + size]


def _text(data: bytearray, place: int, rng: np.random.Generator) -> None:
    match = re.compile(rb"[-+0-9.eE]+").search(data, place)
    if match is not None:
        data[match.start() : match.end()] = TEXTS[int(rng.integers(len(TEXTS)))]


def _zero(data: bytearray, place: int, rng: np.random.Generator) -> None:
    size = min(int(rng.integers(1, 65)), len(data) - place)
    data[place : place + size] = bytes([0, 255][int(rng.integers(2))] for _ in range(size))


_CHANGES = (_flip, _replace, _number, _number, _cut, _take_out, _put_in, _double, _text, _zero)


if __name__ == "__main__":
    main()
