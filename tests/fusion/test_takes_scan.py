"""A scanning vibrometer's text: every scan point is a take, and each is placed where the file says."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from take_factory import HEAD, LASER, LOAD, OUTPUT, POINTS, RATE_HZ, REFERENCE, RIG, Shot, signals

from fusion.base import Settings
from fusion.cli import main
from fusion.commands.options import EXIT_DONE, EXIT_INPUT
from fusion.recording.files import read_takes
from fusion.recording.load import load_manifest
from fusion.sensitivity.analyse import Evaluation
from fusion.sensitivity.evaluate import evaluate_recording

ORIGIN = (0.0, 0.0, 0.05)  # of the file's coordinates in the sensor frame
DAQ = '[[daq]]\nname = "scan"\nfile = "Scan_time.asc"\n'
SCANNED = POINTS[:4]
BLOCKS = ("velocity_1", "drive", "Fz")


def _scan(folder: Path, rng: np.random.Generator, points: int = 4) -> Path:
    """Write a scan in the layout of the published description: points from line 19, acquisition, blocks."""
    takes = []
    for number, point in enumerate(SCANNED[:points]):
        level = complex((1.0 + 2e-3 * number) * np.exp(1j * number))
        takes.append(signals(Shot([point], level, samples=3000), rng))
    lines = ["Scanning vibrometer"] * 18
    lines += [" ".join(f"{x:.12f}" for x in np.subtract(point, ORIGIN)) for point in SCANNED[:points]]
    lines += ["", f"3000 {1.0 / RATE_HZ:.9g}"]
    for name in BLOCKS:
        lines.append(f"block {name}")
        lines += [" ".join(f"{x:.9e}" for x in row) for row in np.column_stack([take[name] for take in takes])]
    recording = folder / "takes"
    recording.mkdir()
    (folder / "rig.toml").write_text(RIG)
    (recording / "Scan_time.asc").write_text("\n".join(lines) + "\n")
    return recording


def _text(folder: Path, *channels: str) -> Path:
    (folder / "recording.toml").write_text(HEAD.format(harmonics="[1]") + DAQ + "".join(channels))
    return folder


def _short(folder: Path) -> Path:
    """Channels by their block: recorded at every point."""
    laser = LASER.format(at="", name="1", point=list(ORIGIN))
    return _text(folder, laser, REFERENCE.format(at="", name="2", mark="true"), OUTPUT.format(at="", name="3"))


def _long(folder: Path) -> Path:
    """Every channel by block and point, lasers with their own place."""
    channels = []
    for number, point in enumerate(SCANNED, 1):
        channels.append(LASER.format(at="", name=f"1/{number}", point=list(point)))
        channels.append(REFERENCE.format(at="", name=f"2/{number}", mark="true"))
        channels.append(OUTPUT.format(at="", name=f"3/{number}"))
    return _text(folder, *channels)


def _blocks(folder: Path) -> Path:
    """The same as blocks of takes."""
    text = HEAD.format(harmonics="[1]")
    for number, point in enumerate(SCANNED, 1):
        text += "[[take]]\n" + DAQ.replace("[[daq]]", "[[take.daq]]")
        text += LASER.format(at="take.", name=f"1/{number}", point=list(point))
        text += REFERENCE.format(at="take.", name=f"2/{number}", mark="true")
        text += OUTPUT.format(at="take.", name=f"3/{number}")
    (folder / "recording.toml").write_text(text)
    return folder


def _evaluate(folder: Path) -> Evaluation:
    return evaluate_recording(load_manifest(folder), Settings(), {})


def test_every_point_of_a_scan_is_a_take(tmp_path: Path) -> None:
    folder = _scan(tmp_path, np.random.default_rng(6))
    found = [_evaluate(describe(folder)) for describe in (_short, _long, _blocks)]
    values = [f.accelerations[0].phasors.value[0] for f in found]
    assert [len(f.takes) for f in found] == [4, 4, 4]
    for value in values[1:]:
        np.testing.assert_allclose(value, values[0], rtol=1e-9)
    np.testing.assert_allclose(values[0][2:5], LOAD[2:5], atol=1e-4 * abs(LOAD[2]))
    assert [f"{take.drift[0]:.4f}" for take in found[0].takes] == ["0.0000", "0.0020", "0.0040", "0.0060"]


def test_points_are_placed_where_the_file_says(tmp_path: Path) -> None:
    takes = read_takes(load_manifest(_short(_scan(tmp_path, np.random.default_rng(6)))))
    placed = [take.records[0].entry.channel[0].point for take in takes]
    np.testing.assert_allclose(np.array(placed, dtype=np.float64), SCANNED, atol=1e-9)
    assert {take.records[0].entry.channel[1].point for take in takes} == {(0.0, 0.0, -0.1)}  # the reference stays


def test_a_scan_of_one_point_needs_no_reference(tmp_path: Path) -> None:
    folder = _scan(tmp_path, np.random.default_rng(6), points=1)
    laser = LASER.format(at="", name="1", point=list(SCANNED[0]))
    found = _evaluate(_text(folder, laser))
    assert found.takes == ()


@pytest.mark.parametrize(
    ("channels", "sentence"),
    [
        ([LASER.format(at="", name="1", point=list(ORIGIN))], "daq: expected one channel with reference = true"),
        ([LASER.format(at="", name="1/9", point=list(ORIGIN))], "Scan_time.asc: 1/9: expected block/point of 3 blocks"),
        ([LASER.format(at="", name="7", point=list(ORIGIN))], "Scan_time.asc: 7: expected block/point of 3 blocks and"),
        (
            [LASER.format(at="", name=name, point=list(ORIGIN)) for name in ("1", "1/2")],
            "daq.scan.channel.1/2: expected each data set once, found 1 beside it",
        ),
    ],
)
def test_wrong_scans_are_one_sentence(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], channels: list[str], sentence: str
) -> None:
    folder = _text(_scan(tmp_path, np.random.default_rng(6)), *channels)
    assert main(["run", str(folder)]) == EXIT_INPUT
    told = capsys.readouterr().err
    assert told.count("\n") == 1
    assert sentence in told


def test_check_counts_the_points_of_a_scan(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    folder = _short(_scan(tmp_path, np.random.default_rng(6)))
    assert main(["check", str(folder)]) == EXIT_DONE
    told = capsys.readouterr().out
    assert "3000 samples at 4000 Hz, a scan of 4 points, each a take" in told
    assert "takes: 4, tied by 2" in told
    assert "load: laser: z rx ry" in told
