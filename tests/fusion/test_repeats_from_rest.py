"""`shakercal transfer`, `check` and `identify` on sweeps from rest to rest in files of their own."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from identify_factory import DAMPING, SMALL, STIFFNESS, write_campaign
from scipy.signal import butter, sosfilt
from support import AT_ORIGIN, block, channel, edit, refusals, write_daq
from sweep_factory import FINER, MODES, RATE_HZ, accelerance, recorded, simulate, sweep, through

from fusion.cli import main
from fusion.recording.load import load_manifest
from fusion.sensor.identify.identification_evaluation import evaluate_identification
from fusion.sensor.identify.identification_inputs import IdentifySettings, read_campaign
from fusion.sensor.transfer.transfer_evaluation import evaluate_transfer
from fusion.sensor.transfer.transfer_records import ReferenceResult, TransferSettings
from shaker.signal_notices import AMPLITUDE_DEPENDENCE, EVALUATED_AS_NOISE, REPEATS_DIFFER, REST_ESTIMATE, SINGLE_REPEAT

LEVELS = {"sweep-1.h5": 1.0, "sweep-2.h5": 2.0, "sweep-3.h5": 1.5}


def write_sweeps(folder: Path, levels: dict[str, float] = LEVELS, noise: tuple[float, float] = (0.01, 0.02)) -> None:
    """Write files of sweeps that begin at different times, with noise on both channels."""
    rng = np.random.default_rng(4)
    for number, (name, level) in enumerate(levels.items()):
        force, top = simulate(lambda t, n=number, a=level: sweep(t, a, 0.08 + 0.02 * n))
        noisy = {
            key: clean + u * rng.standard_normal(len(clean))
            for key, clean, u in (("force", force, noise[0]), ("top", top, noise[1]))
        }
        write_daq(folder / name, RATE_HZ, noisy)


@pytest.fixture(scope="module")
def files(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Three sweeps of different levels."""
    folder = tmp_path_factory.mktemp("sweeps")
    write_sweeps(folder)
    return folder


@pytest.fixture
def recording(files: Path, tmp_path: Path) -> Path:
    """A recording of three sweeps, named by a pattern."""
    folder = tmp_path / "plate"
    folder.mkdir()
    for file in files.iterdir():
        (folder / file.name).write_bytes(file.read_bytes())
    (tmp_path / "rig.toml").write_text('format = 1\nname = "plate"\n', encoding="utf-8")
    at = {"body": "base", "scale_uncertainty": 1e-4} | AT_ORIGIN
    excited = {"kind": "chirp", "direction": [0.0, 0.0, 1.0], "band": [110.0, 490.0], "reference": ["force"]}
    head = block(format=1, name="plate", rig="../rig.toml") + block("excitation", **excited)
    daq = block("[daq]", name="daq", file="sweep-1.h5", repeats="sweep-*.h5")
    text = head + daq + channel("force", "force", **at) + channel("top", "acceleration", **at)
    (folder / "recording.toml").write_text(text, encoding="utf-8")
    return folder


def result_of(folder: Path, **choices: object) -> tuple[ReferenceResult, set[str]]:
    found = evaluate_transfer(load_manifest(folder), TransferSettings(**choices), {})
    return found.references[0], {notice.code for notice in found.notices}


@pytest.mark.usefixtures("no_pages")
def test_repeats_of_different_levels_are_joined(recording: Path, capsys: pytest.CaptureFixture[str]) -> None:
    result, codes = result_of(recording)
    ratio = result.transfer.ratio
    assert {REST_ESTIMATE.code} <= codes
    assert REPEATS_DIFFER.code not in codes
    assert np.all(result.transfer.averages == 3.0)
    assert result.transfer.line_spacing_hz == 0.5
    # With one standard uncertainty of the scale of 1e-4 in both channels, less than the noise.
    error = np.abs(ratio.value[:, 0] / accelerance(ratio.frequency_hz) - 1.0)
    u = np.sqrt(np.trace(ratio.covariance, axis1=1, axis2=2)) / np.abs(ratio.value[:, 0])
    assert 0.8 < np.sqrt(np.mean((error / u) ** 2)) < 1.1
    for mode, (frequency_hz, damping, _) in zip(result.resonances, MODES, strict=True):
        assert abs(mode.fit.frequency_hz - frequency_hz) < 3.0 * mode.u_frequency_hz
        assert abs(mode.fit.damping_ratio - damping) < 3.0 * mode.u_damping_ratio
    assert main(["check", str(recording)]) == 0
    assert "2 repeats" in capsys.readouterr().out
    assert main(["transfer", str(recording)]) == 0


def test_one_file_is_evaluated_too_and_lists_of_files_are_permitted(recording: Path) -> None:
    edit(recording / "recording.toml", 'repeats = "sweep-*.h5"', 'repeats = ["sweep-3.h5"]')
    assert np.all(result_of(recording)[0].transfer.averages == 2.0)
    edit(recording / "recording.toml", 'repeats = ["sweep-3.h5"]\n', "")
    result, codes = result_of(recording, resolution_hz=1.0)
    assert SINGLE_REPEAT.code in codes
    assert result.transfer.line_spacing_hz == 1.0


def test_repeatability_is_a_line_of_the_budget(recording: Path) -> None:
    """A resonance that moves from file to file has the line "repeatability" in its budget."""
    moved = [(f * 1.0005, zeta, a) for f, zeta, a in MODES]
    force, top = simulate(lambda t: sweep(t, 1.5), moved)
    rng = np.random.default_rng(1)
    signals = {
        "force": force + 0.01 * rng.standard_normal(len(force)),
        "top": top + 0.02 * rng.standard_normal(len(top)),
    }
    write_daq(recording / "sweep-2.h5", RATE_HZ, signals)
    result, codes = result_of(recording)
    assert len(codes & {REPEATS_DIFFER.code, AMPLITUDE_DEPENDENCE.code}) == 1
    for mode in result.resonances:
        assert mode.budget["repeatability"][0] > mode.budget["noise"][0]
        assert not any(name.startswith("repeat ") for name in mode.budget)


def test_bursts_of_noise_are_from_rest_and_lasting_noise_is_not(recording: Path) -> None:
    manifest, rng = recording / "recording.toml", np.random.default_rng(3)
    edit(manifest, 'kind = "chirp"', 'kind = "noise"')
    edit(manifest, 'repeats = "sweep-*.h5"\n', "")
    white = sosfilt(butter(4, 600.0, fs=FINER * RATE_HZ, output="sos"), rng.normal(size=FINER * 16384))
    for span_s, chosen in (((0.1, 1.0), True), ((-1.0, 9.0), False)):
        signals = simulate(lambda t, span_s=span_s: 20.0 * white * ((t > span_s[0]) & (t < span_s[1])))
        noisy = [clean + 0.01 * rng.standard_normal(len(clean)) for clean in signals]
        write_daq(recording / "sweep-1.h5", RATE_HZ, dict(zip(("force", "top"), noisy, strict=True)))
        assert (result_of(recording)[0].transfer.estimator == "rest") == chosen


def test_records_without_rest_are_named_with_their_file(recording: Path, capsys: pytest.CaptureFixture[str]) -> None:
    refused, (force, top) = refusals(capsys), simulate(sweep)
    write_daq(recording / "sweep-2.h5", RATE_HZ, {"force": force[3000:], "top": top[3000:]})
    text = refused("transfer", recording)
    assert "sweep-2.h5" in text
    assert "beginning" in text
    edit(recording / "recording.toml", 'file = "sweep-1.h5"\nrepeats = "sweep-*.h5"', 'file = "sweep-2.h5"')
    result, codes = result_of(recording)
    assert EVALUATED_AS_NOISE.code in codes
    assert result.transfer.estimator != "rest"
    assert "sweep-2.h5" in refused("transfer", recording, "--estimator", "rest")


def test_a_damaged_repeat_is_named_by_its_key(recording: Path, capsys: pytest.CaptureFixture[str]) -> None:
    damaged = recording / "sweep-3.h5"
    damaged.write_bytes(damaged.read_bytes()[:3000])
    assert "daq.daq.repeats: sweep-3.h5" in refusals(capsys)("transfer", recording)


def test_repeats_that_do_not_fit_are_refused(recording: Path, capsys: pytest.CaptureFixture[str]) -> None:
    refused, manifest = refusals(capsys), recording / "recording.toml"
    write_daq(recording / "sweep-3.h5", 8000.0, dict.fromkeys(("force", "top"), simulate(sweep)[0]))
    assert "daq.repeats" in refused("transfer", recording)
    edit(manifest, 'kind = "chirp"', 'kind = "sine"')
    edit(manifest, 'band = [110.0, 490.0]\nreference = ["force"]\n', "frequencies = [200.0]\n")
    assert "daq.daq.repeats" in refused("check", recording)
    edit(manifest, 'repeats = "sweep-*.h5"', 'repeats = ["sweep-7.h5"]')
    assert "sweep-7.h5" in refused("check", recording)


def as_sweeps_from_rest(folder: Path, internal_kg: float) -> None:
    """Replace the chirps of a simulated campaign by sweeps from rest to rest, whose channels have no errors."""
    rng, rate_hz = np.random.default_rng(2), 12800.0
    time_s = np.arange(FINER * 12800) / (FINER * rate_hz)
    for name, load in SMALL.loads.items():
        where = folder / f"chirp-{name}"
        edit(where / "recording.toml", "period = 0.64\nsettle_periods = 1\n", "")
        edit(where / "recording.toml", 'response = "amplifier.toml"\n', "")
        edit(where / "recording.toml", 'file = "accelerometers.h5"', 'file = "sweep-0.h5"\nrepeats = "sweep-*.h5"')
        for number, level in enumerate((2.0, 1.0, 3.0)):
            base = sweep(time_s, level, 0.1, 0.7, from_hz=700.0, to_hz=2500.0)
            spring = [DAMPING, STIFFNESS]
            top = through(spring, [load.mass + internal_kg, *spring], base, 1.0 / (FINER * rate_hz))
            below, above = recorded([base, top])
            signals = {"base": below, "top_1": above, "top_2": above}
            noisy = {key: clean / 100.0 + 2e-5 * rng.standard_normal(len(clean)) for key, clean in signals.items()}
            write_daq(where / f"sweep-{number}.h5", rate_hz, noisy)
        (where / "accelerometers.h5").unlink()


def test_a_campaign_of_sweeps_from_rest_identifies_the_sensor(tmp_path: Path) -> None:
    folder, internal_kg = write_campaign(tmp_path / "campaign"), 0.77
    as_sweeps_from_rest(folder, internal_kg)
    (component,) = evaluate_identification(read_campaign(folder), IdentifySettings()).components
    found = component.fit.identification
    assert all(np.all(item.measured.ratio.frequency_hz >= 800.0) for item in component.fit.prepared)
    truth = {"stiffness_z": (STIFFNESS, 1e-3), "damping_z": (DAMPING, 0.02), "internal_mass": (internal_kg, 5e-3)}
    for name, (value, bar) in truth.items():
        assert abs(found.value(name) - value) < min(3.0 * found.u(name), bar * value)
