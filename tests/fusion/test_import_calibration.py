"""The command import-calibration: exit status, what it says, and that nothing is overwritten unasked."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest

from fusion.cli import main
from fusion.commands.options import EXIT_DONE, EXIT_INPUT
from photogram.calibration.file import read_calibration

MATRIX = np.array([[3200.0, 0, 640], [0, 3200, 512], [0, 0, 1]])
Capture = pytest.CaptureFixture[str]


@pytest.fixture
def opencv_file(tmp_path: Path) -> Path:
    """A calibration as OpenCV writes it."""
    path = tmp_path / "stereo.yml"
    storage = cv2.FileStorage(str(path), cv2.FILE_STORAGE_WRITE)
    for name, value in (("M1", MATRIX), ("D1", np.zeros((1, 5))), ("M2", MATRIX), ("D2", np.zeros((1, 5)))):
        storage.write(name, value)
    storage.write("R", np.eye(3))
    storage.write("T", np.array([[-150.0], [0.0], [0.0]]))
    storage.release()
    return path


def test_a_calibration_is_written_and_explained(opencv_file: Path, tmp_path: Path, capsys: Capture) -> None:
    output = tmp_path / "top.json"
    command = ["import-calibration", str(opencv_file), "-o", str(output), "--image-size", "1280x1024"]
    assert main([*command, "--length-unit", "mm"]) == EXIT_DONE
    told = capsys.readouterr()
    assert told.out == f"calibration of OpenCV written: {output}\n"
    assert "150.00 mm apart" in told.err
    assert "scale_uncertainty" in told.err
    rig = read_calibration(output)
    np.testing.assert_allclose(rig.right_from_left.translation_m, [-0.15, 0, 0])
    assert rig.left.size_px.tolist() == [1280, 1024]

    written = output.read_bytes()
    assert main([*command, "--length-unit", "m"]) == EXIT_INPUT
    assert "expected a new file (--force replaces it)" in capsys.readouterr().err
    assert output.read_bytes() == written
    assert main([*command, "--length-unit", "m", "--force"]) == EXIT_DONE
    assert read_calibration(output).right_from_left.translation_m[0] == -150.0


@pytest.mark.parametrize(
    ("options", "told"),
    [
        (["--image-size", "1280x1024"], "stereo.yml: --length-unit: expected m or mm"),
        (["--length-unit", "mm"], "stereo.yml: --image-size: expected width and height"),
    ],
)
def test_what_is_missing_is_said_in_one_sentence(
    opencv_file: Path, tmp_path: Path, capsys: Capture, options: list[str], told: str
) -> None:
    output = tmp_path / "top.json"
    assert main(["import-calibration", str(opencv_file), "-o", str(output), *options]) == EXIT_INPUT
    error = capsys.readouterr().err
    assert told in error
    assert error.count("\n") == 1
    assert not output.exists()


def test_a_missing_file_is_wrong_input(tmp_path: Path, capsys: Capture) -> None:
    arguments = ["import-calibration", str(tmp_path / "none.xml"), "-o", str(tmp_path / "top.json")]
    assert main(arguments) == EXIT_INPUT
    assert "none.xml" in capsys.readouterr().err
