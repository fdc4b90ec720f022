"""Calibration files that are damaged or hostile: read, or refused in one sentence that names the file; never a crash.

Every format that can be written here, and samples of other programs where they are at hand, with bytes flipped, cut
off, repeated, with numbers replaced and with lists within lists. The files are read in a process of its own, since what
is looked for is also that this dies, which no test could catch.
"""

from __future__ import annotations

import os
import re
import signal
import subprocess
import sys
from collections.abc import Iterator
from importlib.util import find_spec
from pathlib import Path

import numpy as np
import pytest
from calibration_files import ros, write_all
from posed_files import write_posed

from photogram.calibration.calibration_file import read_calibration, read_camera
from photogram.calibration.exchange.exchange_files import import_calibration
from photogram.calibration.exchange.lens import LengthUnit

SECONDS = 10  # for one file
NUMBERS = (
    "1e300",
    "-1e300",
    "NaN",
    "nan",
    "inf",
    "-1",
    "0",
    "9" * 400,
    "1e-300",
    "",
    "true",
    '"x"',
    "[]",
    "{}",
    "null",
)
NUMBER = re.compile(rb"-?\d+\.?\d*(?:[eE][-+]?\d+)?")
SAMPLES = ("matchid/calib.caldat", "kalibr/open_vins_euroc_kalibr_imucam_chain.yaml", "ros_camera_info/left.yaml")
SAMPLES += ("matlab_stereo/stereoParams.mat", "vic3d/cal_a.xml", "vic3d/project_xml_from_z3d.xml", "dice/cal_a.txt")
SAMPLES += ("dice/sim_dot_cal_gold.xml", "dice/cal_a_with_R.txt")


def _mutated(content: bytes, rng: np.random.Generator) -> bytes:
    """Return a damaged copy: one of the ways in which files break, or are made to break a reader."""
    kind = rng.integers(7)
    data = bytearray(content)
    if kind == 0:
        return bytes(data[: rng.integers(len(data))])
    if kind == 1:
        for place in rng.integers(len(data), size=rng.integers(1, 6)):
            data[place] ^= 1 << rng.integers(8)
        return bytes(data)
    if kind == 2:  # a part left out or repeated
        start, stop = sorted(rng.integers(len(data) + 1, size=2))
        return content[:start] + content[start:stop] * int(rng.choice([0, 2, 50])) + content[stop:]
    numbers = list(NUMBER.finditer(content))
    if kind in (3, 4) and numbers:
        for match in reversed([numbers[i] for i in sorted({int(rng.integers(len(numbers))) for _ in range(kind - 2)})]):
            data[match.start() : match.end()] = str(rng.choice(NUMBERS)).encode()
        return bytes(data)
    place, depth = int(rng.integers(len(data) + 1)), int(rng.choice([100, 5000, 200_000]))
    if kind == 5:  # what is nested: in lists, objects, names, dashes, elements, quotes that close nothing
        nest = rng.choice(
            np.array(["[", '{"a":', "a: ", "- ", "<a>", '["]",', "[ ']', ", "fc_left=[", "<calibration "])
        )
        return content[:place] + str(nest).encode() * depth + content[place:]
    filler = rng.choice(np.array(["\n", " ", "\t", "a", "\\", '"', "0", "\0", " %", "\u2003"]))
    return content[:place] + str(filler).encode() * depth + content[place:]


READER = """
import signal, sys
from test_calibration_mutated import read
for line in sys.stdin:
    signal.alarm(SECONDS)
    print(read(line.rstrip()), flush=True)
""".replace("SECONDS", str(SECONDS))


def _unit(name: str) -> LengthUnit | None:
    """The unit that a file's user states; this program's export for OpenCV has one."""
    return None if "opencv" in name else "mm"


def read(path: str) -> str:
    """Return what comes of a file: read, refused in one sentence of the file's name, or what must not be."""
    first, reads = Path(path), []
    ros = "ros" in first.name
    if first.parent.name == "posed":
        reads = [lambda: read_posed(first)]
    elif first.name.endswith("own.json"):
        reads = [lambda: read_calibration(first)]
    elif first.name.endswith("camera.json"):
        reads = [lambda: read_camera(first)]
    else:
        unit = _unit(first.name)
        reads = [lambda: import_calibration(first, (1280, 1024), unit, first.with_name("right") if ros else None)]
        reads += [lambda: import_calibration(first.with_name("first"), (1280, 1024), None, first)] * (not ros)
    for way in reads:
        try:
            way()
        except ValueError as error:
            told = str(error)
            named = told.startswith((f"{first}: ", f"{first.with_name('first')}: ", f"{first.with_name('right')}: "))
            if not named or "\n" in told or len(told) > 700:
                return f"sentence: {told!r:.300}"
        except BaseException as error:  # what must not be
            return f"{type(error).__name__}: {error!s:.200}"
    return "good"


SECOND = {"colmap.bin": "images.bin", "colmap.txt": "images.txt", "mrcal": "right.mrcal"}
FIRST = {second: first for first, second in SECOND.items()}


def read_posed(path: Path) -> None:
    """Read a file with cameras of `posed_files`, together with the second file that belongs to it."""
    whole = path.parent.parent / "whole"
    first = whole / FIRST[path.name] if path.name in FIRST else path
    second = path if path.name in FIRST else whole / SECOND[path.name] if path.name in SECOND else None
    try:
        import_calibration(first, None, "m", second)
    except ValueError as error:
        raise ValueError(str(error).replace(str(first), str(path)).replace(str(second), str(path))) from error


class Process:
    """A process that reads files; one that dies is told and replaced."""

    def __init__(self) -> None:
        self.start()

    def start(self) -> None:
        path = os.pathsep.join([str(Path(__file__).parent), str(Path(__file__).parents[1]), *sys.path])
        self.process = subprocess.Popen(
            [sys.executable, "-W", "error", "-c", READER],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.DEVNULL,
            text=True,
            env={**os.environ, "PYTHONPATH": path},
        )

    def read(self, path: Path) -> str:
        assert self.process.stdin is not None
        assert self.process.stdout is not None
        self.process.stdin.write(f"{path}\n")
        self.process.stdin.flush()
        told = self.process.stdout.readline().strip()
        if told:
            return told
        code = self.process.wait()
        self.start()
        return f"no end within {SECONDS} s" if code == -signal.SIGALRM else f"died with {code}"


@pytest.fixture
def process() -> Iterator[Process]:
    reader = Process()
    yield reader
    reader.process.kill()
    reader.process.communicate()


def _damage(folder: Path, whole: dict[str, bytes], process: Process, count: int, seed: int) -> list[str]:
    """Return what must not be of `count` damaged copies of each file."""
    rng, wrong = np.random.default_rng(seed), []
    damaged = folder / "damaged"
    damaged.mkdir()
    (damaged / "first").write_bytes(whole["opencv.yml"])
    (damaged / "right").write_text(ros()[1], encoding="utf-8")
    for name, content in whole.items():
        path = damaged / name.replace("/", "_")
        for trial in range(count):
            path.write_bytes(_mutated(content, rng))
            told = process.read(path)
            if told != "good":
                wrong.append(f"{name} {trial}: {told}")
                if "WRONG" in os.environ:
                    Path(os.environ["WRONG"], f"{trial}-{path.name}").write_bytes(path.read_bytes())
    return wrong


@pytest.mark.skipif(not hasattr(signal, "alarm"), reason="needs signals")
@pytest.mark.parametrize("count", [4, pytest.param(int(os.environ.get("DAMAGED", "30")), marks=pytest.mark.slow)])
def test_damaged_calibrations_are_read_or_refused_in_one_sentence(tmp_path, process, count, request):
    (tmp_path / "whole").mkdir()
    whole = write_all(tmp_path / "whole")
    (tmp_path / "right").write_text(ros()[1], encoding="utf-8")
    for name in whole:  # whole ones are read, so that damage is all that is tried
        first = tmp_path / "whole" / name
        if name == "camera.json":
            read_camera(first)
        elif name == "own.json":
            read_calibration(first)
        elif name != "ros.yaml" or find_spec("yaml") is not None:
            import_calibration(first, (1280, 1024), _unit(name), tmp_path / "right" if name == "ros.yaml" else None)
    if count > 4 and (samples := request.getfixturevalue("data_dir") / "formats").is_dir():
        whole |= {name: (samples / name).read_bytes() for name in SAMPLES}
    assert not _damage(tmp_path, whole, process, count, seed=count)


@pytest.mark.skipif(not hasattr(signal, "alarm"), reason="needs signals")
@pytest.mark.parametrize("count", [4, pytest.param(200, marks=pytest.mark.slow)])
def test_damaged_files_with_posed_cameras_are_read_or_refused_in_one_sentence(tmp_path, process, count):
    whole, posed = tmp_path / "whole", tmp_path / "posed"
    whole.mkdir()
    posed.mkdir()
    rng, wrong = np.random.default_rng(count), []
    for name, content in write_posed(whole).items():
        (posed / name).write_bytes(content)
        read_posed(posed / name)
        for trial in range(count):
            (posed / name).write_bytes(_mutated(content, rng))
            told = process.read(posed / name)
            wrong += [f"{name} {trial}: {told}"] if told != "good" else []
    assert not wrong
