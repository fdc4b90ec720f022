"""A camera rate that folds the driven line onto zero: other instruments go on, and cameras alone fail in words."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from drive_factory import AMPLITUDE_M, CLEAR_HZ, DRIVEN_HZ, FOLDING_HZ, evaluate, recording

from fusion.base import ComputeError
from fusion.cli import main


def test_a_vibrometer_goes_on_where_the_cameras_lose_the_line(tmp_path: Path) -> None:
    evaluation = evaluate(recording(tmp_path, FOLDING_HZ, laser=True))
    assert evaluation.stereo == ()
    texts = [notice.text for notice in evaluation.notices]
    assert any("106.25 Hz is dropped" in text and "onto zero" in text for text in texts)
    assert any("a camera rate of" in text for text in texts)  # that cures it
    assert "stereo pair base is left out: its camera rate tells no line of the recording apart" in texts
    (fused,) = [a for a in evaluation.accelerations if a.source == "fused"]
    expected = AMPLITUDE_M * (2.0 * np.pi * DRIVEN_HZ) ** 2
    assert abs(abs(fused.phasors.value[0, 2]) / expected - 1.0) < 1e-3


def test_a_harmonic_that_folds_onto_zero_is_left_to_the_laser(tmp_path: Path) -> None:
    evaluation = evaluate(recording(tmp_path, 0.75 * DRIVEN_HZ, laser=True, harmonics="[3]", overtone=0.2))
    assert evaluation.stereo[0].usable.tolist() == [True, False]
    dropped = [notice.text for notice in evaluation.notices if "dropped" in notice.text]
    assert len(dropped) == 1
    assert "318.75 Hz is dropped" in dropped[0]
    (fused,) = [a for a in evaluation.accelerations if a.source == "fused"]
    omega = 2.0 * np.pi * DRIVEN_HZ
    expected = -AMPLITUDE_M * np.array([1.0, 0.2 * 9.0]) * omega**2
    np.testing.assert_allclose(fused.phasors.value[:, 2], expected, rtol=2e-3)
    assert fused.chi2 < 20.0


def test_cameras_alone_fail_in_one_sentence(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    place = recording(tmp_path, FOLDING_HZ, laser=False)
    with pytest.raises(ComputeError, match=r"no instrument sees the motion .* at 106\.25 Hz .*a camera rate of"):
        evaluate(place)
    assert main(["run", str(place), "--quiet"]) == 1
    told = capsys.readouterr().err.strip()
    assert told.count("\n") == 0
    assert "folds to" in told
    assert "Traceback" not in told


def test_a_clear_rate_needs_no_notice(tmp_path: Path) -> None:
    evaluation = evaluate(recording(tmp_path, CLEAR_HZ, laser=True))
    assert len(evaluation.stereo) == 1
    assert not [notice for notice in evaluation.notices if "dropped" in notice.text]
