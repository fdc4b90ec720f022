"""`shakercal decouple` on a simulated campaign: files, filter, refusals, exit status."""

import json
import shutil
from dataclasses import replace
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest
from page_outline import self_contained
from support import documented_columns
from support import rows as read_rows

from fusion.cli import main
from fusion.errors import InputError
from fusion.recording.load import load_for_command
from fusion.sensor.decouple.decoupling_evaluation import (
    DecoupleEvaluation,
    DecoupleSettings,
    evaluate_decoupling,
    read_decoupling_filter,
)
from fusion.sensor.decouple.decoupling_report import DECOUPLE, draw_step
from fusion.sensor.model_notices import DAMAGED_MODEL_FILE, LOADS_NOT_SEPARABLE, MISSING_RELEASES
from fusion.simulate.preset import read_preset
from fusion.simulate.releases import StepRig, sensor_model, write_steps
from fusion.simulate.world import Draws

RIG = read_preset(
    StepRig,
    "steps",
    frequency_hz=(170.0, 181.0, 200.0, 350.0, 370.0, 500.0),
    chain_hz=900.0,
    sample_rate_hz=6e3,
    before_s=20e-3,
    after_s=0.18,
)


@pytest.fixture(scope="module")
def campaign(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """One release by a fishing line of every load."""
    folder = tmp_path_factory.mktemp("decouple") / "campaign"
    folder.mkdir()
    for recording in write_steps(folder, 4, RIG):
        if not recording.name.endswith("fishing-line-1"):
            shutil.rmtree(recording)
    return folder


@pytest.fixture(scope="module")
def evaluation(campaign: Path) -> DecoupleEvaluation:
    """Evaluation by the command, whose results are in the folder of the campaign."""
    evaluations: list[DecoupleEvaluation] = []

    def keep(*inputs: Any) -> DecoupleEvaluation:
        evaluations.append(evaluate_decoupling(*inputs))
        return evaluations[-1]

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("fusion.sensor.decouple.decoupling_report.evaluate_decoupling", keep)
        assert main(["decouple", str(campaign), "--frequency", "90", "--damping", "0.6", "-q"]) == 0
    return evaluations[0]


@pytest.fixture(scope="module")
def results(evaluation: DecoupleEvaluation, campaign: Path) -> Path:
    return campaign / "decouple"


def test_all_files_are_written(results):
    names = {"decoupling.json", "model.csv", "crosstalk.csv", "decouple.h5", "decouple.html"}
    assert {path.name for path in results.iterdir()} == names
    page = (results / "decouple.html").read_text(encoding="utf-8")
    self_contained(page)
    assert page.count("<figure") >= 1
    with h5py.File(results / "decouple.h5") as file:
        assert file["model/covariance"].shape[0] == file["model/covariance"].shape[1]


def test_modes_are_the_simulated_ones(results):
    quantities = read_rows(results / "model.csv")
    assert list(quantities[0]) == documented_columns("decoupling.md", "model.csv")
    rows = [row for row in quantities if row["quantity"] == "frequency_hz"]
    found = sorted((float(row["value"]), float(row["u"])) for row in rows)
    for frequency in RIG.frequency_hz:
        value, u = min(found, key=lambda pair: abs(pair[0] - frequency))
        assert abs(value - frequency) < 4.0 * u + 1e-3 * frequency


def test_filter_decouples_the_simulated_sensor(results):
    decoupler = read_decoupling_filter(results / "decoupling.json")
    model, capacity = sensor_model(RIG, Draws(4, True)), np.array(RIG.capacity)
    frequency_hz = np.array([1.0, 20.0, 90.0, 170.0, 181.0])
    truth = np.array([[one.response(frequency_hz) for one in row] for row in model]).transpose(2, 0, 1)
    off = ~np.eye(6, dtype=np.bool_)
    after = np.abs(decoupler.response(frequency_hz) @ truth) * capacity / capacity[:, None]
    static = np.linalg.inv(truth[0].real)
    before = np.abs(static @ truth) * capacity / capacity[:, None]
    assert after[:3, off].max() < 0.02
    assert after[3:, off].max() < 0.2 * before[3:, off].max()


def test_crosstalk_table_contains_every_stage(results):
    rows = [row for row in read_rows(results / "crosstalk.csv") if row["quantity"] == "step_peak"]
    assert len(rows) == 3 * 36
    assert {row["stage"] for row in rows} == {"raw", "static", "filtered"}

    def worst(stage: str) -> float:
        return max(float(row["rated"]) for row in rows if row["stage"] == stage and row["reading"] != row["load"])

    assert worst("filtered") < 0.25 * worst("static")
    assert worst("static") <= worst("raw") * 1.5


def test_without_rated_loads_only_loads_of_one_unit_are_compared(evaluation):
    for capacity, count in ((evaluation.capacity, 5), (None, 2)):
        drawn = draw_step(replace(evaluation, capacity=capacity))
        assert [len(panel.marks) for panel in drawn.panels] == [count] * 3
    shown = [mark.label for mark in drawn.panels[0].marks]
    stepped = drawn.name.removeprefix("decouple-step-")
    assert {*shown, stepped} in ({"Fx", "Fy", "Fz"}, {"Mx", "My", "Mz"})


def test_loads_of_which_none_has_the_unit_of_another_have_no_figures(evaluation, monkeypatch):
    monkeypatch.setattr(DecoupleEvaluation, "ratio", np.where(np.eye(6, dtype=np.bool_), 1.0, np.nan))
    page = DECOUPLE.page(replace(evaluation, capacity=None))
    assert "<figure" not in page


def test_filter_file_reads_back_to_the_last_bit(results, tmp_path):
    content = json.loads((results / "decoupling.json").read_text(encoding="utf-8"))
    decoupler = read_decoupling_filter(results / "decoupling.json")
    assert content["delay_samples"] == decoupler.delay
    assert decoupler.poles.real.tolist() == [pair[0] for pair in content["poles"]]
    broken = tmp_path / "decoupling.json"
    broken.write_text(json.dumps({**content, "kind": "other"}), encoding="utf-8")
    with pytest.raises(InputError, match="'other'") as caught:
        read_decoupling_filter(broken)
    assert (caught.value.code, caught.value.values["command"]) == (DAMAGED_MODEL_FILE.code, "decouple")


def test_missing_load_is_refused_by_name(campaign, tmp_path, refused):
    part = tmp_path / "part"
    shutil.copytree(campaign, part, ignore=shutil.ignore_patterns("decouple", "My-*"))
    refusal = refused("decouple", part)
    assert f"{MISSING_RELEASES.code} " in refusal
    assert "My" in refusal
    assert not (part / "decouple").exists()


def test_loads_that_outputs_do_not_distinguish_are_an_error_of_the_files(campaign, monkeypatch):
    reason = "expected loads that the outputs distinguish, found Fx, found My in one direction"

    def refuse(_: object) -> None:
        raise ValueError(f"components: {reason}")

    monkeypatch.setattr("fusion.sensor.decouple.decoupling_evaluation.fit_steps", refuse)
    with pytest.raises(InputError) as caught:
        evaluate_decoupling("one", load_for_command([campaign], "decouple"), DecoupleSettings(), {})
    assert (caught.value.code, caught.value.key) == (LOADS_NOT_SEPARABLE.code, "components")
    assert caught.value.values == {"reason": reason}


def test_a_target_damping_above_one_is_refused(campaign):
    with pytest.raises(SystemExit) as stopped:
        main(["decouple", str(campaign), "--damping", "1.5"])
    assert stopped.value.code == 2
