"""`shakercal step` against a sensor whose differential equation scipy solved, and the simulated six components."""

from __future__ import annotations

import csv
import json
import shutil
from dataclasses import replace
from pathlib import Path

import h5py
import numpy as np
import pytest
from scipy import optimize
from step_factory import StepFolder, Truth

from fusion.cli import main
from fusion.recording.load import load_manifest
from fusion.sensor.models_file import read_models
from fusion.sensor.step.evaluate import measured_response
from fusion.sensor.step.releases import read_recording

TRUTH = Truth(length_s=0.03)
COTTON = Truth(release_s=2e-3, onset_s=0.0047, length_s=0.03)
FILES = {"releases.csv", "models.csv", "indices.csv", "methods.csv", "models.json", "step.h5", "step.html"}


@pytest.fixture(scope="module")
def campaign(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Three releases by fishing line and one by cotton rope, evaluated."""
    folder = StepFolder(tmp_path_factory.mktemp("step") / "campaign").start()
    for number in (1, 2, 3):
        folder.add(f"line-{number}", TRUTH)
    folder.add("cotton-1", COTTON, release="cotton rope")
    assert main(["step", str(folder.path), "-q"]) == 0
    return folder.path


def table(path: Path) -> list[dict[str, str]]:
    """Rows of a CSV file."""
    with path.open(encoding="utf-8", newline="") as stream:
        return list(csv.DictReader(stream))


def number(campaign: Path, file: str, name: str, channel: str = "Fz") -> tuple[float, float]:
    """Value and U of a number in a table."""
    rows = [r for r in table(campaign / "step" / file) if r["name"] == name and r["channel"] == channel]
    assert len(rows) == 1
    return float(rows[0]["value"]), float(rows[0]["U"])


def gain(frequency_hz: float) -> float:
    """|H| of the truth over its static gain."""
    top, bottom = TRUTH.transfer
    s = 2j * np.pi * frequency_hz
    return float(abs(np.polyval(top, s) / np.polyval(bottom, s)) / TRUTH.gain)


def test_all_files_are_there_and_the_page_stands_alone(campaign):
    assert {path.name for path in (campaign / "step").iterdir()} == FILES
    page = (campaign / "step" / "step.html").read_text(encoding="utf-8")
    assert 'src="http' not in page
    assert "<link" not in page
    assert "line-1: record, fit and residual" in page
    assert "Output Fz over load Fz" in page


def test_models_hold_the_truth(campaign):
    found = read_models(campaign / "step")["Fz", "Fz"]
    assert (found.unit, found.sample_rate_hz) == ("V/V", 50_000.0)
    assert found.recording == "line-1, line-2, line-3"
    assert found.noise == pytest.approx(TRUTH.noise, rel=0.1)
    assert found.model.frequency_hz[0] == pytest.approx(TRUTH.frequency_hz, rel=1e-4)
    assert found.model.damping_ratio[0] == pytest.approx(TRUTH.damping_ratio, rel=5e-3)
    assert found.model.static_gain == pytest.approx(TRUTH.gain, rel=1e-3)


@pytest.mark.parametrize(
    ("name", "truth"),
    [("natural_hz", TRUTH.frequency_hz), ("damping_ratio", TRUTH.damping_ratio), ("static_gain", TRUTH.gain)],
)
def test_numbers_lie_within_their_uncertainty(campaign, name, truth):
    value, expanded = number(campaign, "indices.csv", name)
    assert 0.0 < expanded < 0.1 * truth
    assert abs(value - truth) < 1.5 * expanded


@pytest.mark.parametrize(("name", "level"), [("band_5_hz", 1.05), ("band_10_hz", 1.10)])
def test_bands_end_where_the_true_gain_leaves_them(campaign, name, level):
    value, expanded = number(campaign, "indices.csv", name)
    truth = optimize.brentq(lambda f: gain(f) - level, 1.0, 1500.0)
    assert value == pytest.approx(truth, rel=2e-3)
    assert abs(value - truth) < 1.5 * expanded


def test_every_output_has_its_static_gain(campaign):
    for channel, truth in (("Fz", TRUTH.gain), ("Fx", TRUTH.cross * TRUTH.gain)):
        value, expanded = number(campaign, "indices.csv", "read_static_gain", channel)
        assert abs(value - truth) < 1.5 * expanded


def test_releases_tell_how_the_ropes_let_go(campaign):
    rows = table(campaign / "step" / "releases.csv")
    driven = {row["recording"]: row for row in rows if row["channel"] == "Fz"}
    assert len(rows) == 8
    assert [name for name, row in driven.items() if row["used"] == "yes"] == ["line-1", "line-2", "line-3"]
    for name, row in driven.items():
        truth = COTTON if name.startswith("cotton") else TRUTH
        assert float(row["fit_release_s"]) == pytest.approx(truth.release_s, rel=0.1)
        assert float(row["step_amplitude"]) == truth.amplitude
        assert float(row["baseline"]) == pytest.approx(-truth.gain * truth.amplitude, rel=1e-2)


def test_records_fits_and_residuals_are_in_the_file(campaign):
    with h5py.File(campaign / "step" / "step.h5") as file:
        fit = file["Fz/releases/line-1/fit"]
        rest = fit["residual"][()]
        assert rest.shape == fit["time_s"].shape
        assert np.std(rest) == pytest.approx(TRUTH.noise, rel=0.2)
        assert file["Fz/pooled/model/covariance"].shape == (6, 6)


def test_one_recording_has_its_own_folder_and_the_summary_says_so(campaign, tmp_path, capsys):
    assert main(["step", str(campaign / "line-2"), "-o", str(tmp_path / "one")]) == 0
    told = capsys.readouterr()
    assert "Fz: 1 of 1 releases in the model; f_n (1700." in told.out
    assert "one release only: what releases scatter by is not in U" in told.err


def test_results_of_other_recordings_are_not_overwritten(campaign, capsys):
    assert main(["step", str(campaign / "line-1"), "-o", str(campaign / "step")]) == 2
    assert "found results of other input files" in capsys.readouterr().err


METHODS = ["pencil", "arx", "sim", "sim_zoh", "evolution", "evolution_coefficients"]


def rows_of(path: Path) -> list[dict[str, str]]:
    """Rows of a CSV file."""
    with path.open(encoding="utf-8", newline="") as stream:
        return list(csv.DictReader(stream))


@pytest.mark.slow
def test_the_amplifier_is_in_bands_and_their_u_even_where_it_hides(tmp_path):
    campaign = tmp_path / "campaign"
    assert main(["simulate", str(campaign), "--preset", "steps", "-q"]) == 0
    for folder in [path for path in campaign.iterdir() if path.is_dir() and path.name[:2] not in ("Fx", "Mx")]:
        shutil.rmtree(folder)
    assert main(["step", str(campaign), "-q"]) == 0
    truth = json.loads((campaign / "truth.json").read_text(encoding="utf-8"))
    found = {(row["component"], row["name"]): row for row in rows_of(campaign / "step" / "indices.csv")}
    for component in ("Fx", "Mx"):
        natural = truth["frequency_hz"][truth["components"].index(component)]
        pole = float(np.ravel(truth["real_hz"])[0])

        def size(hertz: float, natural: float = natural, pole: float = pole) -> float:
            share = hertz / natural
            return float(abs(1.0 / (1.0 - share**2 + 0.03j * share) / (1.0 + 1j * hertz / pole)))

        band = optimize.brentq(lambda hertz: size(hertz) - 1.05, 1.0, 0.5 * natural)
        for name, value in (("natural_hz", natural), ("damping_ratio", 0.015), ("band_5_hz", band)):
            row = found[component, name]
            assert abs(float(row["value"]) - value) < 1.6 * float(row["U"]), (component, name)
            assert float(row["U"]) < 0.25 * value


@pytest.mark.slow
def test_every_method_has_its_row_and_its_curve(tmp_path):
    folder = StepFolder(tmp_path / "campaign").start().add("one", replace(Truth(), length_s=0.025))
    assert main(["step", str(folder), "--method", "all", "-q"]) == 0
    rows = {row["method"]: row for row in rows_of(folder / "step" / "methods.csv")}
    assert list(rows) == METHODS
    for method in ("pencil", "arx"):
        assert float(rows[method]["natural_hz"]) == pytest.approx(1700.0, rel=1e-3)
    page = (folder / "step" / "step.html").read_text(encoding="utf-8")
    assert "How the methods came to their models" in page
    assert "differential evolution on coefficients" in page


@pytest.mark.parametrize("force", [False, True])
def test_response_without_a_model_is_that_of_the_equation(tmp_path, force):
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


def test_noise_of_a_response_is_as_large_as_told(tmp_path):
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
