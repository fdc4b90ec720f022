"""Runs that are killed, disks that are full, inputs that change: the figures of docs/reliability.md.

    python benchmarks/faults.py [--kills 200] [--disks 50] [--changes 20] [--workers 2] [--seed 1]

Every run is a process of its own, ended at a random moment of its life, in the middle of a write as often as not, and
started again until one finishes: its files must be those of a run that nobody disturbed. Pages stand for themselves by
one line: drawing figures would take most of the time and writes nothing. 200 kills take some 20 minutes on one core.
"""

from __future__ import annotations

import argparse
import os
import random
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path

from fusion.report.folder import read_provenance
from fusion.simulate import simulate

LIGHT = """
import signal, sys
from fusion import cli

def lighten():
    import fusion.campaign.joint_report, fusion.report.recording_report
    fusion.report.recording_report.render_report = lambda evaluation: "<!doctype html>"
    fusion.campaign.joint_report.render_campaign = lambda evaluation: "<!doctype html>"

def act(options, act=cli._act):
    lighten()
    return act(options)

cli._act = act
if __name__ == "__main__":
    signal.signal(signal.SIGINT, cli._end)  # a background job starts with the signal ignored
    sys.exit(cli.main())
if __name__ == "__mp_main__":
    lighten()
"""
ROOT = Path(__file__).resolve().parents[1]
PATIENCE_S, ORPHAN_S, LISTEN_S = 600.0, 20.0, 0.002
RECORDINGS = 2


@dataclass(frozen=True)
class End:
    """How a process ended: its status, what it told on stderr, and whether others of its session outlived it."""

    status: int
    told: tuple[str, ...]
    orphans: bool = False


@dataclass
class Found:
    """What was counted: trials, and how many ended as promised (`good`) or with a certain `fault`."""

    tried: int = 0
    good: int = 0
    fault: Counter[str] = field(default_factory=Counter)


def _tell(what: str, found: Found) -> None:
    print(f"{what}: {found.tried}, {dict(found.fault)}", end="\r", file=sys.stderr)


# Processes that are started, disturbed and looked at.


def begin(arguments: Sequence[str], folder: Path) -> subprocess.Popen[bytes]:
    """Start the command in a session of its own."""
    script = folder / "light.py"
    if not script.exists():
        script.write_text(LIGHT)
    return subprocess.Popen(
        [sys.executable, str(script), *arguments],
        env={**os.environ, "PYTHONPATH": str(ROOT)},
        stdout=subprocess.DEVNULL,
        stderr=subprocess.PIPE,
        start_new_session=True,
    )


def ended(process: subprocess.Popen[bytes]) -> End:
    """Wait for the end of a process and of its session."""
    _, told = process.communicate(timeout=PATIENCE_S)
    until = time.monotonic() + ORPHAN_S
    while (orphans := _of_session(process.pid)) and time.monotonic() < until:
        time.sleep(0.05)
    for orphan in orphans:
        os.kill(orphan, signal.SIGKILL)
    return End(process.returncode, tuple(told.decode(errors="replace").splitlines()), bool(orphans))


def _of_session(session: int) -> list[int]:
    """Return the living processes of a session, as Linux tells them."""
    found = []
    for stat in Path("/proc").glob("[0-9]*/stat"):
        try:
            state, _, _, own, *_ = stat.read_text().rpartition(")")[2].split()
        except OSError:  # it has just ended
            continue
        if int(own) == session and state != "Z":
            found.append(int(stat.parent.name))
    return found


def signalled(arguments: Sequence[str], number: int, after_s: float) -> End:
    """Send a signal to the command as it is, all of it, some time after the interpreter has come to it."""
    script = (
        "import signal, sys\nfrom fusion import cli\nsignal.signal(signal.SIGINT, cli._end)\n"
        "print(flush=True)\nsys.exit(cli.main(sys.argv[1:]))"
    )
    command, environment = [sys.executable, "-c", script, *arguments], {**os.environ, "PYTHONPATH": str(ROOT)}
    pipe = subprocess.PIPE
    process = subprocess.Popen(command, env=environment, stdout=pipe, stderr=pipe, start_new_session=True)
    assert process.stdout is not None
    process.stdout.read(1)
    time.sleep(after_s)
    os.killpg(process.pid, number)
    return ended(process)


def make_campaign(folder: Path) -> Path:
    """Simulate recordings of sines whose motion is given as points."""
    return simulate(folder / "campaign", "sweep", 3, recordings=RECORDINGS)


def _results(folder: Path) -> dict[str, bytes]:
    """Return all tables; of HDF5 files and pages, which hold durations, the names."""
    files = [path for path in folder.rglob("*") if path.is_file()]
    return {path.relative_to(folder).as_posix(): path.read_bytes() if path.suffix == ".csv" else b"" for path in files}


def _hidden(folder: Path) -> set[str]:
    return {path.name for path in folder.rglob(".*")}


def _broken(out: Path) -> bool:
    """Whether results that say they are complete are not."""
    for path in out.rglob("*.h5"):
        if ".part" not in str(path) and path.name in ("result.h5", "campaign.h5"):
            origin = read_provenance(path.parent, path.name)
            if origin is None or any(not (path.parent / name).is_file() for name in origin.files):
                return True
    return False


def undisturbed(command: Sequence[str], folder: Path, out: Path) -> tuple[dict[str, bytes], float]:
    """Run the command and return its files and how long it took."""
    started = time.monotonic()
    end = ended(begin(command, folder))
    assert end.status == 0, end
    return _results(out), time.monotonic() - started


# Kills.

SIGNALS = (
    (signal.SIGKILL, False),
    (signal.SIGKILL, True),
    (signal.SIGINT, True),
    (signal.SIGTERM, False),
    (signal.SIGTERM, True),
)
"""Each to the first process, or to all of them as a terminal or a queue does."""


def kills(campaign: Path, folder: Path, count: int, rng: random.Random, workers: int) -> Found:
    """End runs at random moments, start them again until one finishes, and compare its files."""
    out, found = folder / f"results-{workers}", Found()
    command = ["run", str(campaign), "-o", str(out), "-q", "--workers", str(workers)]
    reference, whole_s = undisturbed(command, folder, out)
    shutil.rmtree(out)
    while found.tried < count or out.exists():
        _tell(f"kills, {workers}", found)
        before, process = _hidden(folder), begin(command, folder)
        number = _disturb(process, rng, whole_s, folder) if found.tried < count else 0
        end = ended(process)
        if end.status == 0:
            if _results(out) != reference or _hidden(folder):
                found.fault[f"another result, {_hidden(folder)}"] += 1
            shutil.rmtree(out)
        elif number == 0:
            found.fault[f"{end.status}: {end.told[-1:]}"] += 1
        else:
            found.tried += 1
            fault = _fault(end, number, folder, before)
            found.fault.update([fault] if fault else [])
    found.good = found.tried - found.fault.total()
    return found


def _disturb(process: subprocess.Popen[bytes], rng: random.Random, whole_s: float, folder: Path) -> int:
    """End a run at a random moment, or as it writes, by a random signal; return it, 0 where the run ended before."""
    until, as_it_writes = time.monotonic() + rng.uniform(0.0, whole_s), rng.random() < 0.5
    while process.poll() is None and (as_it_writes or time.monotonic() < until):
        if as_it_writes and any(folder.rglob(".*.part")):
            time.sleep(rng.expovariate(1.0 / 0.01))
            break
        time.sleep(LISTEN_S)
    if process.poll() is not None:
        return 0
    number, group = rng.choice(SIGNALS)
    (os.killpg if group else os.kill)(process.pid, number)
    return int(number)


def _fault(end: End, number: int, folder: Path, before: set[str]) -> str:
    """Return what is wrong with what a run left that was ended by a signal; `before`: what an earlier one had left."""
    if end.orphans:
        return "orphan"
    if _broken(folder):
        return "results in pieces"
    if number == signal.SIGKILL:
        return ""
    if not _hidden(folder) <= before:
        return f"left behind: {_hidden(folder) - before}"
    silent = end.status == -number  # before the interpreter had come to the program
    as_told = end.status == 128 + number and len(end.told) == 1
    return "" if silent or as_told else f"{signal.Signals(number).name}: {end.status} {end.told[-3:]}"


# Full disks.


def disks(campaign: Path, folder: Path, count: int, rng: random.Random) -> Found | None:
    """Run on file systems of random size that are too small, then on the same one made larger; None without a right."""
    disk, plain, found = folder / "disk", folder / "plain", Found()
    disk.mkdir()
    reference, _ = undisturbed(["run", str(campaign), "-o", str(plain), "-q"], folder, plain)
    needed = sum(path.stat().st_size for path in plain.rglob("*") if path.is_file())
    if subprocess.run(
        ["mount", "-t", "tmpfs", "-o", "size=64k", "tmpfs", disk], capture_output=True, check=False
    ).returncode:
        return None
    out = disk / "results"
    command = ["run", str(campaign), "-o", str(out), "-q"]
    try:
        while found.tried < count:
            _tell("disks", found)
            _resize(disk, rng.randrange(4096, int(0.9 * needed)))
            end = ended(begin([*command, "--workers", rng.choice(["1", "2"])], folder))
            found.tried += 1
            sentences = [line for line in end.told if "could not be written: no space left on device" in line]
            failed = [line for line in end.told if "Error" in line or "Traceback" in line]
            if end.status != 1 or not sentences or failed or end.orphans or _hidden(disk) or _broken(disk):
                found.fault[f"{end.status} {end.told[-1:]} {_hidden(disk)}"] += 1
            _resize(disk, 4 * needed)
            if ended(begin(command, folder)).status != 0 or _results(out) != reference:
                found.fault["another result"] += 1
            shutil.rmtree(out)
    finally:
        subprocess.run(["umount", disk], check=True)
    found.good = found.tried - found.fault.total()
    return found


def _resize(disk: Path, size: int) -> None:
    subprocess.run(["mount", "-o", f"remount,size={size}", disk], check=True)


# Inputs that change.


def changes(campaign: Path, folder: Path, count: int, rng: random.Random) -> Found:
    """Change an input at a random moment between its being hashed and the end of a run; the run must refuse it."""
    recording = sorted(campaign.glob("*/recording.toml"))[0].parent
    out, found = folder / "changing", Found()
    command = ["run", str(recording), "-o", str(out), "-q"]
    _, whole_s = undisturbed(command, folder, out)
    named = read_provenance(out)
    assert named is not None
    files = [campaign / name for name in named.input_hashes]
    lock = folder / f".{out.name}.shakercal-lock"
    while found.tried < count:
        _tell("changes", found)
        shutil.rmtree(out, ignore_errors=True)
        process, file = begin(command, folder), rng.choice(files)
        content = file.read_bytes()
        while not lock.exists() and process.poll() is None:
            time.sleep(LISTEN_S)
        time.sleep(rng.uniform(0.0, 0.3 * whole_s))
        if lock.exists():
            _change(file, content, rng)
        late = not lock.exists()  # it may have been done before the change
        end = ended(process)
        file.write_bytes(content)
        if late:
            continue
        found.tried += 1
        told = end.told[-1] if end.told else ""
        if end.status == 2 and f"{file.name}: changed while it was read" in told and not out.exists():
            found.good += 1
        else:
            found.fault[f"{end.status} {told}"] += 1
    return found


def _change(file: Path, content: bytes, rng: random.Random) -> None:
    """Change a file: more of it, another byte of it, or another file in its place."""
    place = rng.randrange(len(content))
    other = content[:place] + bytes([content[place] ^ 1]) + content[place + 1 :]
    how = rng.choice(["longer", "in place", "replaced"])
    if how == "replaced":
        beside = file.with_name("copy in progress")
        beside.write_bytes(other)
        os.replace(beside, file)
    else:
        with file.open("r+b") as stream:
            stream.seek(len(content) if how == "longer" else place)
            stream.write(b"\n" if how == "longer" else other[place : place + 1])


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    for name, default in (("kills", 200), ("disks", 50), ("changes", 20), ("workers", 2), ("seed", 1)):
        parser.add_argument(f"--{name}", type=int, default=default)
    options = parser.parse_args()
    rng = random.Random(options.seed)
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        campaign = make_campaign(folder)
        several = options.kills // 2
        trials: dict[str, tuple[int, Callable[..., Found | None]]] = {
            "runs ended, one process": (options.kills - several, partial(kills, workers=1)),
            f"runs ended, {options.workers} workers": (several, partial(kills, workers=options.workers)),
            "full disks": (options.disks, disks),
            "inputs changed": (options.changes, changes),
        }
        rows = {what: tried(campaign, folder, count, rng=rng) for what, (count, tried) in trials.items() if count}
    print("| fault | tried | as promised | else |\n|---|---|---|---|")
    for what, found in rows.items():
        if found is not None:
            print(f"| {what} | {found.tried} | {found.good} | {dict(found.fault) or 'none'} |")


if __name__ == "__main__":
    main()
