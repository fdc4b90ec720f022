"""`shakercal identify` end to end: a simulated campaign against its truth, its files, and the model read back."""

from __future__ import annotations

import json
import re
import shutil
from dataclasses import replace
from pathlib import Path

import h5py
import numpy as np
import pytest
from identify_factory import DAMPING, LAG_S, SENSITIVITY, SINES_HZ, SMALL, STIFFNESS, write_campaign, write_sines
from page_outline import self_contained
from support import DOCS, documented_columns, rows, without_pages

from fusion.base import Settings
from fusion.campaign.run import run_path
from fusion.cli import main
from fusion.errors import InputError
from fusion.recording.excitation import kinds_of
from fusion.recording.load import find_recordings, select_kinds
from fusion.report.figure import Line
from fusion.sensor.identify.identification_evaluation import (
    IdentifiedComponent,
    IdentifyEvaluation,
    evaluate_identification,
)
from fusion.sensor.identify.identification_figures import POINTS, draw_explained
from fusion.sensor.identify.identification_inputs import IdentifySettings, read_campaign
from fusion.sensor.identify.identification_report import IDENTIFY, read_sensor_models
from fusion.sensor.identify.joint_fit import model_sensitivity
from fusion.sensor.model_notices import DAMAGED_MODEL_FILE
from fusion.sensor.response_notices import DAMPING_CONTRADICTED, SENSITIVITY_EXPLANATION, SENSITIVITY_NOT_EXPLAINED
from fusion.sensor.transfer.transfer_evaluation import KINDS as TRANSFER_KINDS
from fusion.simulate.world import Draws, true_part
from shaker.identification.sensitivity import CHAIN_WORDS
from shaker.identification.sensor import Load, correct_phasors
from shaker.model_notices import OUTPUT_LEADS
from shaker.sine.phasor import Phasors

GUIDE = (DOCS / "identify.md").read_text(encoding="utf-8")
SETTINGS = IdentifySettings(load_masses_kg=(2.0, 20.0))


@pytest.fixture(scope="module")
def campaign(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two chirps and five sines, the sines evaluated."""
    folder = write_campaign(tmp_path_factory.mktemp("identify") / "campaign")
    write_sines(folder)
    with pytest.MonkeyPatch.context() as patch:
        without_pages(patch)
        outcomes = run_path(folder, None, Settings())
    assert [outcome.error for outcome in outcomes] == [None] * len(SINES_HZ)
    return folder


@pytest.fixture(scope="module")
def evaluation(campaign: Path) -> IdentifyEvaluation:
    return evaluate_identification(read_campaign(campaign), SETTINGS)


@pytest.fixture(scope="module")
def component(evaluation: IdentifyEvaluation) -> IdentifiedComponent:
    (found,) = evaluation.components
    return found


@pytest.fixture(scope="module")
def results(evaluation: IdentifyEvaluation, tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("results") / "identify"
    IDENTIFY.write(evaluation, folder)
    return folder


def _internal_mass() -> float:
    return float(true_part(SMALL.internal, Draws(1, True)).mass_kg)


def test_stiffness_damping_and_internal_mass_are_found(component):
    found = component.fit.identification
    truth = {"stiffness_z": (STIFFNESS, 5e-4), "damping_z": (DAMPING, 0.02), "internal_mass": (_internal_mass(), 3e-3)}
    assert (component.fit.model, component.fit.mass_is_free) == ("translation", True)
    for name, (value, bar) in truth.items():
        assert abs(found.value(name) - value) < min(3.5 * found.u(name), bar * value)
        assert found.u(name) / value < bar


def test_chirps_and_the_steps_of_one_load_are_fitted_together(component):
    lines = [item.measured.ratio.value.shape for item in component.fit.prepared]
    assert lines == [(1025, 2), (1025, 2), (len(SINES_HZ), 1)]
    steps = component.fit.prepared[2].measured
    assert steps.name == "5 steps of sines, 10 kN shaker, load 9 kg"
    np.testing.assert_allclose(steps.ratio.frequency_hz, SINES_HZ, rtol=1e-6)
    load, internal = (true_part(part, Draws(1, True)) for part in (SMALL.loads["9kg"], SMALL.internal))
    true = SMALL.transfer(load, internal, (0.0, 0.0, 0.1), np.array(SINES_HZ))
    np.testing.assert_allclose(steps.ratio.value[:, 0], true, rtol=1e-4)


def test_one_transducer_is_one_unknown_in_all_recordings(component):
    names = [unknown.name for unknown in component.fit.identification.unknowns]
    assert len(set(names)) == len(names)
    assert {"base: scale", "top_1: delay", "clock of daq", "load 4.236 kg: mass"} <= set(names)


def test_the_budget_adds_up_to_the_uncertainty(component):
    found = component.fit.identification
    total = np.sqrt(np.sum([change**2 for change in found.budget.values()], axis=0))
    np.testing.assert_allclose(total, [estimate.u for estimate in found.estimates], rtol=1e-6)
    assert max(found.budget, key=lambda cause: abs(found.budget[cause][0])).endswith(": mass")


def test_lag_of_the_chain_is_separated_from_the_spring(evaluation, component):
    comparison = component.sensitivity.comparison
    assert comparison.best.chain.kind == "lag"
    assert abs(comparison.best.chain.lag_s - LAG_S) < 3.5 * comparison.best.u("lag_s")
    assert abs(comparison.best.spring_time_s - DAMPING / STIFFNESS) < 3.5 * comparison.best.u("spring_time_s")
    assert comparison.damping.contradicts
    notices = [notice for notice in evaluation.notices if notice.where == "sensitivity Fz"]
    assert [notice.code for notice in notices] == [SENSITIVITY_EXPLANATION.code, DAMPING_CONTRADICTED.code]
    assert CHAIN_WORDS["lag"] in notices[0].values["supported"]
    assert CHAIN_WORDS["none"] in notices[0].values["contradicted"]


def test_output_that_leads_the_force_gives_a_warning(evaluation, component):
    measured = component.sensitivity.measured
    early = measured.value * np.exp(2j * np.pi * measured.frequency_hz * 50e-6)
    found = model_sensitivity(component.fit, replace(measured, value=early), evaluation.sensor)
    assert [notice.code for notice in found.notices if notice.where == "Fz"] == [OUTPUT_LEADS.code]


def test_a_sensitivity_without_an_explanation_is_not_reported_as_missing(evaluation, component, monkeypatch):
    def refuse(*_: object) -> None:
        raise ValueError("value: expected one curve, found none")

    monkeypatch.setattr("fusion.sensor.identify.joint_fit.fit_sensitivity", refuse)
    found = model_sensitivity(component.fit, component.sensitivity.measured, evaluation.sensor)
    assert [notice.code for notice in found.notices] == [SENSITIVITY_NOT_EXPLAINED.code]
    assert (found.model.chain.kind, found.sensitivity) == ("none", None)


def test_curves_of_the_sensitivity_are_within_the_axes(component):
    stiff = replace(component.model, damping=20.0 * component.model.damping)
    for panel in draw_explained(replace(component, model=stiff), component.sensitivity).panels:
        low, high = panel.y.limits
        curves = [mark.y for mark in panel.marks if isinstance(mark, Line)]
        assert [len(curve) for curve in curves] == [POINTS] * 3
        assert low < np.min(curves) < np.max(curves) < high


def test_force_on_the_load_uses_the_identified_internal_mass(component):
    assert abs(component.model.sensitivity - SENSITIVITY) < 3.5 * np.sqrt(component.model.covariance[0, 0])
    errors = {error.name for error in component.sensitivity.measured.errors}
    assert "internal mass: mass" in errors
    assert not any("internal mass 0.769 kg: mass" in name for name in errors)


def test_every_method_reads_the_resonance(component):
    mass = _internal_mass() + true_part(SMALL.loads["4kg"], Draws(1, True)).mass_kg
    f0, zeta = np.sqrt(STIFFNESS / mass) / (2.0 * np.pi), 0.5 * DAMPING / np.sqrt(STIFFNESS * mass)
    readings = [item for item in component.readings if "4.236" in item.recording and item.response == "top_1"]
    methods = ["maximum_bin", "maximum", "half_power", "half_amplitude", "circle", "oscillator", "joint"]
    assert [item.method for item in readings] == methods
    found = {item.method: item for item in readings}
    assert abs(found["joint"].frequency_hz - f0) < 3.5 * found["joint"].u_frequency_hz
    assert found["maximum_bin"].frequency_hz == pytest.approx(f0, abs=0.5 / 0.64)
    assert found["maximum"].frequency_hz == pytest.approx(f0 * (1.0 - zeta**2), rel=3e-5)
    for method in ("half_power", "circle", "oscillator", "joint"):
        assert found[method].damping_ratio == pytest.approx(zeta, rel=5e-3)
        assert found[method].damping == pytest.approx(DAMPING, rel=5e-3)
        assert found[method].stiffness == pytest.approx(STIFFNESS, rel=1e-3)
    assert found["half_amplitude"].damping_ratio == pytest.approx(np.sqrt(3.0) * zeta, rel=5e-3)


def test_usable_bands_are_those_of_the_selected_masses(component):
    assert component.loads == (2.0, 20.0)
    for kg, band in zip(component.loads, component.bands, strict=True):
        w = 2.0 * np.pi * band.upper_hz
        spring = STIFFNESS - (kg + _internal_mass()) * w**2 + 1j * w * DAMPING
        output = abs(STIFFNESS / spring / (1.0 + 1j * w * LAG_S))
        assert output == pytest.approx(1.05, abs=2e-4)


def test_files_contain_the_results(results, component):
    names = {"parameters.csv", "readings.csv", "model.json", "identify.h5", "identify.html"}
    assert {entry.name for entry in results.iterdir()} == names
    parameters = rows(results / "parameters.csv")
    assert list(parameters[0]) == documented_columns("identify.md", "parameters.csv")
    named = {row["name"]: row for row in parameters}
    estimate, row = component.fit.identification["stiffness_z"], named["stiffness_z"]
    assert (row["component"], row["unit"], row["method"]) == ("z", "N/m", "joint fit, translation")
    assert float(row["value"]) == pytest.approx(estimate.value, rel=1e-12)
    assert float(row["U"]) == pytest.approx(float(row["k"]) * estimate.u, rel=1e-9)
    assert named["lag_s"]["method"].startswith("sensitivity over frequency")
    assert len(rows(results / "readings.csv")) == len(component.readings) == 28
    with h5py.File(results / "identify.h5") as file:
        found = file["z/identification"]
        assert found["covariance"].shape == found["correlation"].shape == (3, 3)
        curve = file["z/recordings/000"]
        residual = curve["ratio/value"][()] - curve["model"][()]
        np.testing.assert_array_equal(curve["residual"][()], residual)
        assert set(file["provenance/files"].asstr()[()]) == names
        assert any(name.endswith("result.h5") for name in file["provenance/input_file"].asstr()[()])
    page = (results / "identify.html").read_text(encoding="utf-8")
    self_contained(page)
    assert page.count("<figure") == 7
    for part in ("Nyquist circles", "half-amplitude width", "Correlation", "Budget"):
        assert part in page


def test_the_model_is_read_back_to_the_last_bit(results, component):
    file = read_sensor_models(results)
    found, model = file["Fz"], component.model
    assert (file.name, file.campaign) == ("six-component transducer", "campaign")
    assert (found.channel, found.structure, found.sensitivity_measured) == ("Fz", "translation", True)
    assert found.range_hz == component.range_hz
    for name in ("sensitivity", "stiffness", "damping", "internal_mass", "unit"):
        assert getattr(found.sensor, name) == getattr(model, name)
    assert found.sensor.chain.kind == model.chain.kind
    np.testing.assert_array_equal(found.sensor.chain.parameters, model.chain.parameters)
    np.testing.assert_array_equal(found.sensor.covariance, model.covariance)
    with pytest.raises(ValueError, match=r"component.*Fz.*Mx"):
        file["Mx"]


def test_a_correction_with_the_model_gives_the_force(results):
    sensor, frequency, load_kg = read_sensor_models(results)["Fz"].sensor, np.array([300.0, 900.0]), 5.0
    s = 2j * np.pi * frequency
    spring = STIFFNESS + s * DAMPING + s * s * (load_kg + _internal_mass())
    output = 3.0 * SENSITIVITY * STIFFNESS / spring / (1.0 + s * LAG_S)  # of 3 N on the load, the base at rest
    phasors = Phasors(frequency, output[:, None], np.zeros((2, 2, 2)), ("Fz",), ("V/V",), np.full(2, np.inf))
    force = correct_phasors(phasors, sensor, Load(load_kg, "force"))
    assert force.phasors.unit == ("N",)
    u = np.sqrt(force.covariance.diagonal(axis1=1, axis2=2))
    error = force.phasors.value[:, 0] - 3.0
    assert np.all(np.abs(error.real) < 3.5 * u[:, 0])
    assert np.all(np.abs(error.imag) < 3.5 * u[:, 1])
    np.testing.assert_allclose(force.phasors.value[:, 0], 3.0, rtol=1e-3)


def test_the_example_of_the_guide_corrects_a_record(results, tmp_path, monkeypatch, capsys):
    (code,) = re.findall(r"^```python\n(.*?)^```", GUIDE, re.DOTALL | re.MULTILINE)
    shutil.copytree(results, tmp_path / "try" / "identify")
    monkeypatch.chdir(tmp_path)
    exec(compile(code, "identify.md", "exec"), {})
    printed = capsys.readouterr().out
    w = 2.0 * np.pi * 600.0
    spring = STIFFNESS - (4.236 + _internal_mass()) * w**2 + 1j * w * DAMPING
    factor = abs(STIFFNESS / spring / (1.0 + 1j * w * LAG_S))
    assert f"uncorrected at 600 Hz: {factor:.3f}" in printed
    force = float(printed.split("force: ")[1].split(" N")[0])
    assert force == pytest.approx(2e-5 / SENSITIVITY / factor, rel=2e-3)


def test_the_guide_shows_the_keys_of_the_model(results):
    (text,) = re.findall(r"^```json\n(.*?)^```", GUIDE, re.DOTALL | re.MULTILINE)
    shown, found = json.loads(text), json.loads((results / "model.json").read_text(encoding="utf-8"))
    assert list(shown) == list(found)
    (one,), (other,) = shown["components"], found["components"]
    assert list(one) == list(other)
    for key in ("name", "unit"):
        assert [parameter[key] for parameter in one["parameters"]] == [p[key] for p in other["parameters"]]
    assert list(one["usable_bands"][0]) == list(other["usable_bands"][0])


def test_a_file_that_is_no_model_is_refused(results, tmp_path):
    content = json.loads((results / "model.json").read_text(encoding="utf-8"))
    content["components"][0]["chain"] = "rope"
    (tmp_path / "model.json").write_text(json.dumps(content), encoding="utf-8")
    for path in (tmp_path, tmp_path / "model.json"):
        with pytest.raises(InputError, match="rope") as caught:
            read_sensor_models(path)
        assert (caught.value.code, caught.value.values["command"]) == (DAMAGED_MODEL_FILE.code, "identify")


@pytest.mark.usefixtures("no_pages")
def test_command_prints_results_and_notices(campaign, evaluation, tmp_path, monkeypatch, capsys):
    monkeypatch.setattr("fusion.sensor.identify.identification_report.evaluate_identification", lambda *_: evaluation)
    assert main(["identify", str(campaign), "-o", str(tmp_path / "out"), "-v"]) == 0
    printed = capsys.readouterr()
    assert "stiffness k, z: (4.500" in printed.out
    assert "lag of the chain: " in printed.out
    assert DAMPING_CONTRADICTED.code in printed.err


def test_every_command_selects_its_kinds_from_a_mixed_campaign(campaign, tmp_path):
    found = find_recordings(campaign)
    assert [path.parent.name for path in select_kinds(found, TRANSFER_KINDS)] == ["chirp-4kg", "chirp-9kg"]
    assert [path.parent.name for path in select_kinds(found, kinds_of("run"))] == [f"sine-{f:04.0f}" for f in SINES_HZ]
    assert select_kinds(found, ["step"]) == found
    broken = tmp_path / "recording.toml"
    broken.write_text("format =", encoding="utf-8")
    assert broken in select_kinds([*found, broken], TRANSFER_KINDS)
