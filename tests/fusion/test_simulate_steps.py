"""The simulated calibration by releases: its files, its truth, and that both agree."""

from __future__ import annotations

import json
from pathlib import Path

import h5py
import numpy as np
import pytest
from scipy.signal import lsim

from fusion.recording.load import load_manifest
from fusion.sensor.step.records import read_step_record
from fusion.simulate.preset import read_preset
from fusion.simulate.releases import DAQ_FILE, StepRig, releases, write_steps
from shaker.labels import LOAD_COMPONENTS
from shaker.release.reading import compare_releases, read_release

SEED = 3
RIG = read_preset(StepRig, "steps")


@pytest.fixture(scope="module")
def campaign(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A simulated campaign."""
    folder = tmp_path_factory.mktemp("steps")
    write_steps(folder, SEED)
    return folder


def _truth(folder: Path) -> dict:  # type: ignore[type-arg]
    """What truth.json holds."""
    return json.loads((folder / "truth.json").read_text(encoding="utf-8"))  # type: ignore[no-any-return]


def test_every_component_is_released_and_one_by_three_ropes(campaign: Path) -> None:
    found = sorted(path.name for path in campaign.iterdir() if path.is_dir())
    assert found == sorted(release.name for release in releases(RIG))
    excitations = [load_manifest(campaign / name).excitation for name in found]
    assert {e.component for e in excitations} == set(LOAD_COMPONENTS)
    assert {e.release for e in excitations if e.component == "Fz"} == {"cotton rope", "fishing line", "plastic rope"}
    assert all(e.kind == "step" and e.step_amplitude and e.step_amplitude < 0 for e in excitations)


@pytest.mark.parametrize("name", ["Fz-cotton-rope-1", "My-fishing-line-2"])
def test_outputs_are_what_the_poles_and_residues_answer(campaign: Path, name: str) -> None:
    """Integrated by scipy: the transfer functions of truth.json under the load that it states, for 20 ms."""
    whole, truth = _truth(campaign), _truth(campaign / name)
    record = read_step_record(load_manifest(campaign / name))
    fine, count = 5, 2000
    time = np.arange(count * fine) / (record.sample_rate_hz * fine)
    share = np.clip((time - truth["onset_s"]) / truth["release_s"], 0.0, 1.0)
    place = LOAD_COMPONENTS.index(truth["component"])
    noise = np.array(truth["noise"])
    for channel in (place, (place + 1) % 6):
        answer = np.zeros(len(time))
        for m, (f, z) in enumerate(zip(whole["frequency_hz"], whole["damping_ratio"], strict=True)):
            omega = 2 * np.pi * f
            pole = omega * complex(-z, np.sqrt(1 - z * z))
            r = complex(whole["residue"]["re"][channel][place][m], whole["residue"]["im"][channel][place][m])
            top = [2 * r.real, -2 * (r * pole.conjugate()).real]
            answer += lsim((top, [1.0, 2 * z * omega, omega**2]), share, time)[1]
        corner = 2 * np.pi * whole["real_hz"][0]
        answer += lsim(([whole["real_residue"][channel][place][0]], [1.0, corner]), share, time)[1]
        clean = truth["baseline"][channel] + truth["amplitude"] * answer[::fine]
        left = record.samples[channel, :count] - clean
        assert abs(left.mean()) < 5.0 * noise[channel] / np.sqrt(len(left))
        assert left.std() == pytest.approx(noise[channel], rel=0.08)


def test_every_mode_has_the_relative_degree_of_an_oscillator_behind_a_lag(campaign: Path) -> None:
    """Residues, and residues times poles, sum to 0: the response to a step begins like t³."""
    whole = _truth(campaign)
    residue = np.array(whole["residue"]["re"]) + 1j * np.array(whole["residue"]["im"])
    omega, zeta = 2 * np.pi * np.array(whole["frequency_hz"]), np.array(whole["damping_ratio"])
    pole = omega * (-zeta + 1j * np.sqrt(1 - zeta**2))
    lag, real = -2 * np.pi * whole["real_hz"][0], np.array(whole["real_residue"])[:, :, 0]
    for order in (0, 1):
        total = 2 * np.sum(residue * pole**order, axis=2).real + real * lag**order
        assert np.all(np.abs(total) < 1e-9 * np.max(np.abs(residue * pole**order), axis=2))
    static = -2 * np.sum(residue / pole, axis=2).real - real / lag
    assert static == pytest.approx(np.array(whole["static_gain"]), rel=1e-9)
    own = np.array(RIG.sensitivity) * np.array(RIG.capacity)
    ratio = static * np.array(RIG.capacity) / own[:, None]
    assert np.diagonal(ratio) == pytest.approx(np.ones(6), abs=6 * RIG.mixing**2)
    assert np.max(np.abs(ratio - np.diag(np.diagonal(ratio)))) < 2.5 * RIG.mixing


def test_the_converter_has_its_steps_and_noise_is_where_it_is_said(campaign: Path) -> None:
    with h5py.File(campaign / "Fx-fishing-line-1" / DAQ_FILE) as file:
        volts = np.asarray(file["Fx"], dtype=np.float64)
    step = 2 * RIG.range_v / 2**RIG.bits
    assert np.abs(volts / step - np.round(volts / step)).max() < 1e-2
    assert volts[:900].std() == pytest.approx(RIG.noise * 3.0, rel=0.1)
    assert np.abs(volts).max() < RIG.range_v
    steady = _truth(campaign / "Fx-fishing-line-1")["steady"][0] * RIG.gain
    assert volts[-1000:].mean() == pytest.approx(steady, abs=5.0 * RIG.noise * 3.0 / np.sqrt(1000))


def test_readings_of_the_campaign_hold_the_truth_and_rank_the_ropes(campaign: Path) -> None:
    readings, deviations = [], []
    for release in releases(RIG):
        truth = _truth(campaign / release.name)
        record = read_step_record(load_manifest(campaign / release.name))
        reading = read_release(record, release.component)
        place = record.channels.index(release.component)
        deviations += [
            (reading.onset_s - truth["onset_s"]) / reading.u_onset_s,
            (reading.release_s - truth["release_s"]) / reading.u_release_s,
            (reading.static_gain - truth["static_gain"][place]) / reading.u_static_gain,
        ]
        assert not reading.notices
        peak = max(reading.peaks, key=lambda found: found.share)
        assert peak.frequency_hz == pytest.approx(RIG.frequency_hz[place], rel=0.004)
        readings += [reading] if release.component == "Fz" else []
    held = np.abs(deviations) < 2.0
    assert np.count_nonzero(held) >= 48  # of 57; a perfect program has fewer once in 1000 seeds
    ranked = compare_releases(readings)
    assert [kind.release for kind in ranked] == ["fishing line", "plastic rope", "cotton rope"]
    assert all(kind.faster > 0.99 for kind in ranked[:-1])
