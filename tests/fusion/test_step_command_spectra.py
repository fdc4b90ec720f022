"""What a release shows over frequency without a model, against the differential equation it was made from."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from step_factory import StepFolder, Truth

from fusion.recording.load import load_manifest
from fusion.sensor.step.evaluate import measured_response
from fusion.sensor.step.releases import read_recording


@pytest.mark.parametrize("force", [False, True])
def test_response_without_a_model_is_that_of_the_equation(tmp_path: Path, force: bool) -> None:
    truth = Truth(damping_ratio=0.05, release_s=3e-4, noise=2e-9)
    folder = StepFolder(tmp_path / "campaign").start().add("one", truth, force=force)
    release, _ = read_recording(load_manifest(folder))
    at = replace(release.reading, onset_s=truth.onset_s, release_s=truth.release_s, u_release_s=0.0, shape="ramp")
    found = measured_response(replace(release, readings=(at, *release.readings[1:])))
    inside = (found.frequency_hz > 15.0) & (found.frequency_hz < 2400.0)
    assert np.count_nonzero(inside) > 50
    top, bottom = truth.transfer
    s = 2j * np.pi * found.frequency_hz[inside]
    expected = np.polyval(top, s) / np.polyval(bottom, s)
    assert np.abs(found.value[inside] / expected - 1.0).max() < 0.02
    assert np.all(found.frequency_hz[1:] > found.frequency_hz[:-1])


def test_noise_of_a_response_is_as_large_as_told(tmp_path: Path) -> None:
    truth = replace(Truth(), noise=1e-6, length_s=0.03)
    folder = StepFolder(tmp_path / "campaign").start()
    responses = []
    for number in range(8):
        release, _ = read_recording(load_manifest(folder.add(f"{number}", truth)))
        at = replace(release.reading, onset_s=truth.onset_s, release_s=truth.release_s, shape="ramp")
        responses.append(measured_response(replace(release, readings=(at, *release.readings[1:]))))
    values = np.stack([one.value for one in responses])
    scatter = np.sqrt(np.mean(np.abs(values - values.mean(axis=0)) ** 2, axis=0) * 8 / 7)
    inside = (responses[0].frequency_hz > 200.0) & (responses[0].frequency_hz < 3000.0)
    ratio = scatter[inside] / np.mean([one.u for one in responses], axis=0)[inside]
    assert np.sqrt(np.mean(ratio**2)) == pytest.approx(1.0, rel=0.1)
