"""Results that share inputs: by evidence only, in reference value and E_n, against simulated laboratories."""

from __future__ import annotations

import shutil
from collections.abc import Sequence
from dataclasses import replace
from datetime import date
from pathlib import Path

import h5py
import numpy as np
import pytest
import simulated_drives
from contracts import acceptance
from simulated_drives import CAPACITY, DriveErrors, drive_setup, simulate_drives, true_matrix
from support import refusals, rows, undescribed_datasets

from fusion.campaign.joint_evaluation import evaluate_campaign
from fusion.campaign.joint_report import campaign_h5, campaign_tables
from fusion.campaign.recording_results import RecordingResults, SensorFacts, read_recorded
from fusion.cli import main
from fusion.recording.load import load_manifest
from fusion.report.folder import Provenance, hash_files
from fusion.report.h5 import read_notices
from fusion.report.recording_report import write_results
from fusion.sensitivity.input_evidence import InputEvidence
from fusion.sensor.compare.comparison_evaluation import ComparisonEvaluation, evaluate_comparison
from fusion.sensor.compare.comparison_inputs import ComparedResult, ComparedValue, read_result
from fusion.sensor.compare.consistency import covariance_of, find_shared_inputs, weighted_mean
from fusion.sensor.result_notices import CONTRADICTORY_CLAIMS, POSSIBLY_SHARED
from shaker.labels import LOAD_COMPONENTS

MASS = InputEvidence("load: mass", "mass", 9.73, 6e-3, "kg", "M-1", "", "", "rig.toml: load.mass")
SENSOR = SensorFacts("transducer", "1", LOAD_COMPONENTS, "V/V", "on_load", CAPACITY, None, 0.0)
MAIN = "Fz", "magnitude"
U_MASS = 6e-3  # kg of 9.73 kg: 6.2e-4, with 3.0e-4 of each laboratory


def laboratory(
    seed: int, mass: float | None, evidence: Sequence[InputEvidence] = (MASS,), day: date | None = None
) -> tuple[RecordingResults, complex]:
    """One laboratory's recording of one sensor along z, and the true sensitivity; `mass`: error of its load in u."""
    sensor = np.random.default_rng(0)
    setup, truth = drive_setup(sensor, "Fz 100 Hz", "z", (0.0, 0.0, 0.08)), true_matrix(sensor)
    setup = replace(setup, acceleration=np.where(np.arange(6) == 2, setup.acceleration, 0.0))
    errors = DriveErrors(np.random.default_rng([1, seed]))
    if mass is not None:
        errors.drawn["load: mass "] = mass
    drives = simulate_drives([setup], truth, errors)
    origin = Provenance({"rig.toml": f"{seed:064x}"}, {}, {"shakercal": "0.2.0"}, ())
    named = "Fz 100 Hz", "Fz 100 Hz", "1", "rig", "sine", (0.0, 0.0, 1.0), (100.0,)
    recorded = RecordingResults(*named, SENSOR, drives, (), origin, day, evidence=tuple(evidence))
    return recorded, complex(truth[2, 2])


def results_of(folder: Path, recorded: RecordingResults, name: str) -> ComparedResult:
    """What a comparison reads of a campaign of one recording."""
    evaluation = evaluate_campaign(name, [recorded], {})
    folder.mkdir(exist_ok=True)
    (folder / "campaign.h5").write_bytes(campaign_h5(evaluation, []))
    (folder / "curve.csv").write_text("".join(campaign_tables(evaluation, [])["curve.csv"]))
    return read_result(name, folder)


@pytest.fixture
def heavy(monkeypatch: pytest.MonkeyPatch) -> None:
    """A mass that is uncertain enough to matter most."""
    monkeypatch.setattr(simulated_drives, "_U_MASS_KG", U_MASS)


def compared(results: Sequence[ComparedResult]) -> ComparisonEvaluation:
    return evaluate_comparison(results, {}, 1e-3, {})


def agreement(evaluation: ComparisonEvaluation, truth: complex) -> list[float]:
    """E_n of the pair's magnitudes and of its complex values, and of the reference value from the truth (or NaN)."""
    found = next(c for c in evaluation.quantities if c.quantity == "magnitude")
    assert found.complex_normalised is not None
    off = abs(found.reference.value - abs(truth)) / (2.0 * found.reference.u)
    return [found.largest, found.complex_normalised[0, 1], off]


@pytest.mark.slow
@pytest.mark.usefixtures("heavy")
def test_two_laboratories_with_one_mass_agree_in_95_percent(tmp_path) -> None:
    """1000 pairs of simulated laboratories: shared mass, everything else independent; the truth is the simulator's."""
    draws, rng = 1000, np.random.default_rng(5)
    read = [results_of(tmp_path / name, laboratory(n, 0.0)[0], name) for n, name in enumerate(("one", "two"))]
    outcomes: dict[str, list[list[float]]] = {"shared": [], "independent": []}
    for draw in range(draws):
        error, drawn = float(rng.standard_normal()), []
        for index, result in enumerate(read):
            recorded, truth = laboratory(2 + 2 * draw + index, error)
            (drive,) = recorded.excited_lines
            value = complex(drive.outputs[2] / drive.load[2])
            (stated,) = (v for v in result.values if v.channel == "Fz")
            found: ComparedValue = replace(stated, magnitude=abs(value), phase_rad=float(np.angle(value)))
            drawn.append(replace(result, values=(found,)))
        outcomes["shared"].append(agreement(compared(drawn), truth))
        outcomes["independent"].append(agreement(compared([replace(r, evidence=()) for r in drawn]), truth))
    e_n = {name: np.array(found) for name, found in outcomes.items()}
    shared, independent = (np.sum(found <= 1.0, axis=0) / np.isfinite(found).sum(axis=0) for found in e_n.values())
    low, high = np.array(acceptance(draws, 3)) / draws
    assert low <= shared[0] <= high
    assert low <= shared[1] <= high
    assert low <= shared[2] <= high, "U of the mean contains the mass once"
    assert independent[0] > 0.99, "visibly too many"
    assert independent[1] > 0.975
    assert independent[2] < 0.92, "a mean of two that are taken as independent is too sure"


@pytest.mark.usefixtures("heavy")
def test_a_shared_mass_is_the_covariance_of_two_results(tmp_path) -> None:
    """Closed form: relative covariance (6e-3 kg/9.73 kg)²; E_n over U of the difference without it."""
    results = [results_of(tmp_path / n, laboratory(k, 0.3, day=date(2020 + k, 7, 1))[0], n) for k, n in enumerate("ab")]
    evaluation = compared(results)
    assert [(item.of, item.evidence) for item in evaluation.shared] == [("mass", "certificate M-1")]
    found = next(c for c in evaluation.quantities if (c.channel, c.quantity) == ("Fz", "magnitude"))
    common = (U_MASS / 9.73) ** 2 * found.value[0] * found.value[1]
    assert found.covariance[0, 1] == pytest.approx(common, rel=1e-3)
    spread = found.u[0] ** 2 + found.u[1] ** 2 - 2.0 * common
    assert found.largest == pytest.approx(abs(found.value[0] - found.value[1]) / (2.0 * spread**0.5), rel=1e-3)
    assert found.reference.u**2 > common, "no mean is better than what all share"
    assert found.year == pytest.approx([2020.5, 2021.5], abs=0.01)
    assert found.u_per_year == pytest.approx(spread**0.5, rel=2e-3), "of two results one year apart"


def test_a_shared_relative_error_pulls_no_mean_below_its_values() -> None:
    """Peelle's puzzle: 1.5 and 1.0, 10 % each and 20 % in common, are 0.88 if readings scale what is common."""
    value, separate = np.array([1.5, 1.0]), np.array([0.15, 0.10])
    u = np.hypot(separate, 0.2 * value)
    mean, u_mean, _, _ = weighted_mean(value, covariance_of(np.array([[0.2, 0.2]]), u, value)[0])
    naive = np.diag(u**2) + 0.04 * np.outer(value, value) * (1.0 - np.eye(2))
    assert weighted_mean(value, naive)[0] == pytest.approx(0.882, abs=1e-3), "as published"
    weights = separate**-2 / np.sum(separate**-2)
    assert mean == pytest.approx(weights @ value)
    assert u_mean == pytest.approx(np.hypot(np.sum(separate**-2) ** -0.5, 0.2 * mean), rel=1e-9)


@pytest.mark.parametrize(
    ("other", "shared"),
    [
        ({}, 1),
        ({"unknown": "weight 9.73 kg: mass"}, 1),  # whatever a laboratory calls it
        ({"certificate": "M-2"}, 0),
        ({"certificate": ""}, 0),  # the same name alone
        ({"value": 9.7301}, 0),
        ({"u": 7e-3}, 0),
        ({"of": "inertia 0 xy"}, 0),
        ({"certificate": "", "sha256": "ab" * 32}, 0),
    ],
)
def test_inputs_are_shared_by_evidence_only(other, shared) -> None:
    one = ComparedResult("one", Path("a"), (), evidence=(MASS,))
    two = ComparedResult("two", Path("b"), (), evidence=(replace(MASS, **other),))
    assert len(find_shared_inputs([one, two])) == shared


def test_a_file_is_evidence_and_several_axes_are_distinguished() -> None:
    table = InputEvidence("amp: response phase", "response of output phase", np.nan, 1.0, "1", "", "", "cd" * 32, "")
    axes = [
        InputEvidence(f"a{axis}: scale", "scale of acceleration", 100.0, 0.003, "1", "K-9", "", "", "")
        for axis in "xyz"
    ]
    one = ComparedResult("one", Path("a"), (), evidence=(table, *axes))
    renamed = [replace(row, unknown=f"b{n}: scale") for n, row in enumerate(axes)]
    two = ComparedResult("two", Path("b"), (), evidence=(replace(table, unknown="bridge: response phase"), *renamed))
    assert [item.of for item in find_shared_inputs([one, two])] == ["response of output phase"], (
        "the axes are not distinguished"
    )
    three = ComparedResult("three", Path("c"), (), evidence=(axes[1],))
    assert [item.unknowns for item in find_shared_inputs([one, three])] == [{"one": "ay: scale", "three": "ay: scale"}]


def test_two_certificates_behind_one_unknown_are_both_needed() -> None:
    both = (MASS, replace(MASS, certificate="M-2"))
    one, two = (
        ComparedResult("one", Path("a"), (), evidence=both),
        ComparedResult("two", Path("b"), (), evidence=(MASS,)),
    )
    assert not find_shared_inputs([one, two])
    assert len(find_shared_inputs([one, replace(two, evidence=both)])) == 1


@pytest.mark.usefixtures("heavy")
def test_page_table_and_terminal_name_shared_inputs(tmp_path, capsys) -> None:
    days = date(2024, 5, 2), date(2025, 5, 2), date(2026, 5, 2)
    stated = (MASS,), (MASS,), (replace(MASS, u=8e-3),)
    for n, name in enumerate("abc"):
        results_of(tmp_path / name, laboratory(n, 0.3, stated[n], days[n])[0], name)
    out = tmp_path / "out"
    assert main(["compare", *(str(tmp_path / name) for name in "abc"), "-o", str(out)]) == 0
    assert "mass (certificate M-1)" in capsys.readouterr().out
    with h5py.File(out / "comparison.h5") as file:
        claims = [notice.values for notice in read_notices(file) if notice.code == CONTRADICTORY_CLAIMS.code]
    assert {"first": "a", "second": "c", "inputs": "mass (certificate M-1)"} in claims
    found = {row["result"]: row for row in rows(out / "comparison.csv") if (row["channel"], row["quantity"]) == MAIN}
    assert [found[name]["shared"] for name in "abc"] == ["mass (certificate M-1)", "mass (certificate M-1)", ""]
    assert float(found["a"]["per_year"]) != 0.0, "dated by its recordings"
    page = (out / "comparison.html").read_text(encoding="utf-8")
    assert "mass (certificate M-1)" in page
    assert "chart-Fz-Fz" in page
    with h5py.File(out / "comparison.h5") as file:
        assert file["comparison/0/covariance"].shape == (3, 3)


@pytest.mark.usefixtures("heavy")
def test_equal_names_without_evidence_are_a_note(tmp_path) -> None:
    """Two results of one rig without a certificate of its mass are independent, with a notice."""
    bare = replace(MASS, certificate="")
    light = replace(bare, unknown="bridge: scale", of="scale of output", u=1e-4, unit="1")
    for n, name in enumerate("ab"):
        results_of(tmp_path / name, laboratory(n, 0.3, (bare, light))[0], name)
    assert main(["compare", str(tmp_path / "a"), str(tmp_path / "b"), "-o", str(tmp_path / "out")]) == 0
    with h5py.File(tmp_path / "out" / "comparison.h5") as file:
        (notice,) = (one for one in read_notices(file) if one.code == POSSIBLY_SHARED.code)
        assert not [name for name in file["comparison"].values() if len(name["shared"])]
    assert notice.values == {"first": "a", "second": "b", "inputs": "load: mass"}, "the scale has 2 % of a variance"


def test_files_without_evidence_stay_readable(tmp_path) -> None:
    result = results_of(tmp_path, laboratory(0, 0.0, ())[0], "old")
    with h5py.File(tmp_path / "campaign.h5", "r+") as file:
        del file["recordings/date"]
    assert str(read_result("old", tmp_path).values) == str(result.values)
    assert not result.evidence
    assert all(np.isnan(value.year) for value in result.values)


@pytest.mark.parametrize("damage", ["evidence/of", "recordings/name", "date", "whole"])
def test_a_damaged_companion_file_is_one_sentence(damage, tmp_path, capsys) -> None:
    for name in "ab":
        results_of(tmp_path / name, laboratory(0, 0.0)[0], name)
    if damage == "whole":
        (tmp_path / "b" / "campaign.h5").write_bytes(b"no results")
    else:
        with h5py.File(tmp_path / "b" / "campaign.h5", "r+") as file:
            if damage == "date":
                file["recordings/date"][0] = "March"
            else:
                del file[damage]
    assert "campaign.h5" in refusals(capsys)("compare", tmp_path / "a", tmp_path / "b", "-o", tmp_path / "out")


CERTIFIED = [
    ("rig.toml", "\nmass = 2.4063\nmass_uncertainty = 0.0002\n",
     '\nmass = { value = 2.4063, U = 4e-4, k = 2, certificate = "M-1", laboratory = "Example" }\n'),
    ("Fz-0080/recording.toml", 'rig = "../rig.toml"\n', 'rig = "../rig.toml"\ndate = 2026-03-02\n'),
    ("Fz-0080/recording.toml", "scale = 0.1\n",
     'scale = { value = 0.1, U_relative = 1e-3, k = 2, certificate = "L-7" }\n'),
    ("Fz-0080/recording.toml", "\nscale_uncertainty = 0.0005\n", "\n"),
]  # fmt: skip


def test_a_recording_has_date_and_evidence_of_its_unknowns(tmp_path, demo_recording, demo_evaluation, no_pages):
    """Every name in the evidence is one of the result's, and what is mounted anew is not among them."""
    shutil.copytree(demo_recording, tmp_path / "demo")
    for file, old, new in CERTIFIED:
        text = (tmp_path / "demo" / file).read_text(encoding="utf-8")
        assert old in text
        (tmp_path / "demo" / file).write_text(text.replace(old, new), encoding="utf-8")
    manifest = load_manifest(tmp_path / "demo" / "Fz-0080")
    files = hash_files(manifest.files, manifest.root)
    write_results(replace(demo_evaluation, manifest=manifest, input_hashes=files.hashes), tmp_path / "out")
    recorded = read_recorded(tmp_path / "out")
    assert recorded.date == date(2026, 3, 2)
    found = {row.unknown: row for row in recorded.evidence}
    load = {i.name: i for i in (*recorded.excited_lines[0].load_uncertainty.influences,)}
    mass, laser = found["load 2.4063 kg: mass"], found["laser: scale"]
    assert (mass.of, mass.value, mass.u, mass.unit, mass.certificate) == ("mass", 2.4063, 2e-4, "kg", "M-1")
    assert (laser.of, laser.certificate) == ("scale of velocity", "L-7")
    assert not [name for name in found if "centre of mass" in name]
    assert not found["amplifier: delay"].proven, "it has a row, without evidence"
    assert {name for name in found if name in load} >= {"load 2.4063 kg: mass", "laser: scale"}
    (table,) = {row.sha256 for name, row in found.items() if name.startswith("amplifier: response")}
    assert table in files.hashes.values()
    assert {row.sha256 for row in recorded.evidence} - {""} <= set(files.hashes.values())
    result = read_result("demo", tmp_path / "out")
    (value,) = (v for v in result.values if v.channel == "Fz")
    mass_effect, u_relative = value.effects["load 2.4063 kg: mass"], 2e-4 / (2.4063 + 0.1835 + 0.214)
    assert mass_effect[0] == pytest.approx(-u_relative, rel=0.01), "a heavier load, a smaller sensitivity"
    assert value.year == pytest.approx(2026.17, abs=0.01)
    with h5py.File(tmp_path / "out" / "result.h5") as file:
        assert undescribed_datasets(file) == []
