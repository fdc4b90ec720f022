"""Joint results of a campaign: curves, matrices and cross-talk against a known truth, their files, and the page."""

from __future__ import annotations

import csv
import io
import itertools
import re
from collections.abc import Sequence
from dataclasses import replace

import h5py
import numpy as np
import pytest
from browsing import below_the_first_screen, paper
from contracts import refused
from evaluation_factory import Choice, make_evaluation
from page_outline import outline
from simulated_drives import CAPACITY, MAIN, DriveErrors, drive_setup, eight_setups, simulate_drives, true_matrix
from support import DOCS, examples, rows, undescribed_datasets

from fusion.campaign import joint_report as joint_write
from fusion.campaign.campaign_notices import (
    FAILED_RECORDINGS,
    MISSING_EXCITATIONS,
    NO_JOINT_RESULT,
    SEVERAL_SENSORS,
)
from fusion.campaign.excited_line import ExcitedLine
from fusion.campaign.joint_evaluation import (
    CampaignEvaluation,
    curve_points,
    evaluate_campaign,
    headlines,
    main_points,
)
from fusion.campaign.joint_report import (
    campaign_h5,
    campaign_origin,
    campaign_tables,
    linearity_table,
    recordings_table,
    render_campaign,
    repeats_table,
    unknowns_table,
    write_campaign,
)
from fusion.campaign.recording_results import RecordingResults, SensorFacts
from fusion.campaign.unknowns import JointUnknown
from fusion.errors import InputError
from fusion.estimation.coverage import coverage_factor
from fusion.phasors.timing import EdgeGrid
from fusion.report import recording_report as results
from fusion.report.folder import Provenance
from fusion.report.h5 import read_uncertainty
from fusion.report.recording_report import CAMPAIGN_FILES, check_campaign_folder, write_results
from fusion.report.report_notices import OTHER_CAMPAIGN_CONTENT
from shaker.labels import LOAD_COMPONENTS as LOADS
from shakercal._common.notices import DeclaredNotice, Notice

FAILED = {"Fz-0999": "recording.toml: daq.laser.scale: expected a number, found <nothing>"}
SWEEP_HZ = (53.7, 161.1, 375.9, 590.7, 805.5, 1020.3)
MATRIX_HZ = (80.0, 170.0)
STATIC = np.diag(MAIN)
SENSOR = SensorFacts("six-component transducer", "0815", LOADS, "V/V", "on_load", CAPACITY, STATIC, 1e-4)
MATRIX = true_matrix(np.random.default_rng(42))
POLAR = "magnitude,phase_rad,u_magnitude,u_phase_rad,re,im,u_re,u_im,r,dof"
TAIL = "dof_magnitude,dof_phase,k_magnitude,k_phase,region_re,region_im,region_r"
HEADER = (
    f"frequency_hz,channel,component,{POLAR},k,U_magnitude,U_phase_rad,relative,u_relative,U_relative,unit,recordings,"
    f"mountings,kind,{TAIL}"
)


def truth(frequency_hz: float) -> np.ndarray:
    """The true matrix (6, 6): static times a resonance."""
    return MATRIX / (1.0 - (frequency_hz / 2600.0) ** 2) * np.exp(-2j * np.pi * frequency_hz * 20e-6)


def recorded(name: str, drives: Sequence[ExcitedLine]) -> RecordingResults:
    """What the result file of a recording tells of its drives."""
    return RecordingResults(
        folder=name.replace(" ", "-").replace(",", ""),
        name=name,
        mounting=drives[0].mounting,
        rig="10 kN shaker",
        kind="sine" if len(drives) == 1 else "multisine",
        direction=drives[0].direction,
        frequencies=tuple(drive.nominal_hz for drive in drives),
        sensor=SENSOR,
        excited_lines=tuple(replace(drive, recording=name) for drive in drives),
        notices=(Notice(DeclaredNotice("SC-999", "warning", "the phase drifts"), "velocity"),),
        origin=Provenance({f"{name}/recording.toml": "ab" * 32}, {"spline_degree": 5}, {"shakercal": "0.1.0"}, ()),
    )


def sweep() -> tuple[RecordingResults, ...]:
    """Recordings purely along z: two mountings of two recordings at every frequency."""
    rng = np.random.default_rng(0)
    errors, found = DriveErrors(rng), []
    base = drive_setup(rng, "", "z", (0.0, 0.0, 0.08))
    base = replace(base, acceleration=np.where(np.arange(6) == 2, base.acceleration, 0.0))
    for f, mounting, take in itertools.product(SWEEP_HZ, "12", "ab"):
        name = f"Fz {f:g} Hz, {mounting}{take}"
        setup = replace(base, recording=name, mounting=mounting, frequency_hz=f)
        found.append(recorded(name, simulate_drives([setup], truth(f), errors)))
    return tuple(found)


def eight() -> tuple[RecordingResults, ...]:
    """Eight recordings whose loads are independent, at two frequencies each."""
    rng = np.random.default_rng(0)
    errors, setups = DriveErrors(rng), eight_setups(rng)
    lines = [simulate_drives([replace(s, frequency_hz=f) for s in setups], truth(f), errors) for f in MATRIX_HZ]
    return tuple(recorded(f"run {n}", drives) for n, drives in enumerate(zip(*lines, strict=True), 1))


@pytest.fixture(scope="module")
def swept() -> CampaignEvaluation:
    return evaluate_campaign("sweep along z", sweep(), FAILED)


def table_of(evaluation: CampaignEvaluation, name: str) -> list[dict[str, str]]:
    return list(csv.DictReader(io.StringIO("".join(campaign_tables(evaluation, [])[name]))))


@pytest.fixture(scope="module")
def matrix() -> CampaignEvaluation:
    return evaluate_campaign("eight recordings", eight(), {})


def within(row: dict[str, str], true: complex) -> bool:
    """Whether both parts lie as close to the truth as in all but one case in 1000, 3.3 u of many degrees of freedom."""
    error = complex(float(row["re"]), float(row["im"])) - true
    k = coverage_factor(min(float(row["dof_magnitude"]), float(row["dof_phase"])), 0.999)
    return abs(error.real) < k * float(row["u_re"]) and abs(error.imag) < k * float(row["u_im"])


def test_one_curve_over_frequency_relative_to_static_where_that_is_stated(swept):
    rows = table_of(swept, "curve.csv")
    assert ",".join(rows[0]) == HEADER
    assert [float(row["frequency_hz"]) for row in rows[::6]] == pytest.approx(SWEEP_HZ, rel=1e-6)
    head = {(row["component"], row["kind"], row["recordings"], row["mountings"]) for row in rows}
    assert head == {("Fz", "ratio", "4", "2")}
    for row in rows:
        assert all(row.values())
        assert within(row, complex(truth(float(row["frequency_hz"]))[LOADS.index(row["channel"]), 2]))
        assert float(row["U_magnitude"]) == pytest.approx(float(row["k"]) * float(row["u_magnitude"]), rel=1e-12)
    shared = np.linalg.norm([2.5e-4, 1e-3 / 9.73, 1e-4, 1e-4])  # scales of motion, bridge and channel, and the mass
    main = [row for row in rows if row["channel"] == "Fz"]
    for row in main:
        assert float(row["relative"]) == pytest.approx(float(row["magnitude"]) / STATIC[2, 2], rel=1e-12)
        share = float(row["u_magnitude"]) / float(row["magnitude"])
        assert 0.999 * shared < share  # what is shared does not average away
        assert float(row["u_relative"]) / float(row["relative"]) == pytest.approx(np.hypot(share, 1e-4), rel=1e-9)
    assert float(main[0]["u_magnitude"]) / float(main[0]["magnitude"]) < 2.0 * shared
    assert {row["relative"] for row in rows if row["channel"] != "Fz"} == {"nan"}


def test_elements_of_the_matrix_are_rows_of_the_sensitivities(matrix):
    rows = table_of(matrix, "sensitivity.csv")
    assert {(row["kind"], row["recording"]) for row in rows} == {("matrix", "eight recordings")}
    assert len(rows) == 36 * len(MATRIX_HZ)
    for row in rows:
        true = truth(float(row["frequency_hz"]))[LOADS.index(row["channel"]), LOADS.index(row["component"])]
        assert within(row, complex(true))
    assert {row["unit"] for row in rows if row["component"] == "Mx"} == {"(V/V)/(N.m)"}


def test_cross_talk_at_rated_loads(matrix):
    rows = table_of(matrix, "crosstalk.csv")
    assert ",".join(rows[0]) == f"frequency_hz,channel,component,{POLAR},U_region,holds_zero,{TAIL}"
    assert len(rows) == 30 * len(MATRIX_HZ)
    for row in rows:
        i, j = LOADS.index(row["channel"]), LOADS.index(row["component"])
        true = truth(float(row["frequency_hz"]))
        assert within(row, complex(true[i, j] * CAPACITY[j] / (true[i, i] * CAPACITY[i])))
        assert float(row["U_region"]) >= 1.9 * max(float(row["u_re"]), float(row["u_im"]))
        if float(row["magnitude"]) > float(row["U_region"]):
            assert row["holds_zero"] == "no"


def test_uncertainties_are_stored_with_their_names(matrix):
    with h5py.File(io.BytesIO(campaign_h5(matrix, ["a.csv"]))) as file:
        assert file.attrs["campaign"] == "eight recordings"
        assert file["provenance/files"].asstr()[()].tolist() == ["a.csv"]
        assert len(file["provenance/input_file"]) == 8
        fit = file["matrices/000"]
        assert np.array_equal(fit["value"][()], matrix.matrices[0].value)
        back, kept = read_uncertainty(fit["uncertainty"]), matrix.matrices[0].uncertainty
        assert [i.name for i in back.influences] == [i.name for i in kept.influences]
        assert np.array_equal(back.covariance, kept.covariance)
        assert file["cross_talks/001/holds_zero"].shape == (6, 6)
        assert file["recordings/name"].asstr()[2] == "run 3"
        kinds = [curve.attrs["kind"] for curve in file["curves"].values()]
    assert kinds[-1] == "matrix"


def test_every_number_of_a_campaign_has_unit_words_and_named_axes(swept, matrix):
    for evaluation in (swept, matrix):
        with h5py.File(io.BytesIO(campaign_h5(evaluation, ["a.csv"]))) as file:
            assert undescribed_datasets(file) == []
            assert file["curves/000/value"].attrs["units"] == "(V/V)/N"
            assert file["curves/000/value"].dims[1][0].asstr()[0] == "Fx/Fz" if evaluation is swept else "Fx/Fx"
    with h5py.File(io.BytesIO(campaign_h5(matrix, []))) as file:
        fit = file["matrices/000"]
        rows = fit["uncertainty/covariance"].dims[1][0].asstr()[()].tolist()
        assert rows[:7] == ["Re Fx/Fx", "Re Fx/Fy", "Re Fx/Fz", "Re Fx/Mx", "Re Fx/My", "Re Fx/Mz", "Re Fy/Fx"]
        units = fit["uncertainty/effect"].attrs["units"].strip("[]").split(", ")
        assert units == 6 * (3 * ["(V/V)/N"] + 3 * ["(V/V)/(N.m)"])
        assert file["cross_talks/000/value"].attrs["units"] == "1"


def test_joint_estimates_of_poses_and_scales_are_in_file_and_page(matrix):
    turned = JointUnknown("stereo top: pose rotation x", "stereo top: pose", 5e-3, "rad", 0.5, 0.2, 8)
    found = replace(matrix, unknowns=(JointUnknown("clock rate", "clock", 1e-6, "1", 0.0, 1.0, 0), turned))
    with h5py.File(io.BytesIO(campaign_h5(found, []))) as file:
        assert undescribed_datasets(file) == []
        assert file["unknowns/remaining"][()].tolist() == [1.0, 0.2]
    table = unknowns_table(found)
    assert [row[0] for row in table.rows] == [turned.name, "clock rate"]
    assert table.rows[0][1:5] == ("0.005 rad", "(0.0025 ± 0.0020) rad", "0.20", "8")
    assert table.rows[1][5]
    assert not table.rows[0][5]
    assert "Poses and scales" in render_campaign(found)
    assert "Poses and scales" not in render_campaign(matrix)


def test_equal_input_gives_equal_bytes_and_without_six_loads_there_is_no_matrix(swept):
    again = evaluate_campaign("sweep along z", sweep(), FAILED)
    texts = [{name: "".join(t) for name, t in campaign_tables(one, []).items()} for one in (swept, again)]
    assert texts[0] == texts[1]
    assert campaign_h5(swept, []) == campaign_h5(again, [])
    assert swept.matrices == ()
    assert table_of(swept, "crosstalk.csv") == []
    assert swept.refused[0].code == MISSING_EXCITATIONS.code


def test_the_example_of_the_page_combines_two_elements(swept, tmp_path, monkeypatch):
    (tmp_path / "results").mkdir()
    (tmp_path / "results" / "campaign.h5").write_bytes(campaign_h5(swept, []))
    blocks = examples((DOCS / "results.md").read_text(encoding="utf-8"), "python")
    code = next(block for block in blocks if "curves" in block)
    monkeypatch.chdir(tmp_path)
    found: dict[str, np.ndarray] = {}
    exec(code, found)
    curve = swept.curves[0]
    assert np.array_equal(found["ratio"], curve.value[:, 2] / curve.value[:, 0])
    both = curve.uncertainty.at([2, 0])
    change = np.stack([1.0 / curve.value[:, 2], -1.0 / curve.value[:, 0]], axis=1)[:, None]
    jacobian = np.block([[change.real, -change.imag], [change.imag, change.real]])
    expected = both.transformed(jacobian).covariance
    assert found["u_relative"] == pytest.approx(np.sqrt(expected[:, 0, 0]), rel=1e-9)
    assert found["u_phase_rad"] == pytest.approx(np.sqrt(expected[:, 1, 1]), rel=1e-9)
    line = found["over_frequency"]
    assert line.shape == (6, 2, 6, 2)
    assert line[0, 0, 0, 0] == pytest.approx(both.covariance[0, 0, 0], rel=1e-9)
    assert line[0, 0, 5, 0] / np.sqrt(line[0, 0, 0, 0] * line[5, 0, 5, 0]) > 0.5


def test_page_of_a_sweep(swept):
    found = outline(render_campaign(swept))
    sections = {"result", "notices", "sensitivity", "outputs", "matrix", "repeats", "recordings", "origin"}
    assert sections | {"figure-curve-Fz-Fz", "figure-recordings-Fz-Fz"} <= set(found.ids)
    reports = [address for address in found.addresses if not address.startswith(("#", "data:image/svg+xml"))]
    assert set(reports) == {f"{entry.folder}/report.html" for entry in swept.recorded}
    text = "".join(found.text)
    assert swept.refused[0].text in text
    (failed,) = (notice for notice in swept.notices if notice.code == FAILED_RECORDINGS.code)
    assert failed.values == {"count": 1, "names": "Fz-0999"}
    assert failed.text in text
    assert FAILED["Fz-0999"] in text
    assert headlines(swept, main_points(swept, curve_points(swept)))[-1].label in text


def test_page_of_a_matrix(matrix):
    found = outline(render_campaign(replace(matrix, curves=matrix.curves[-2:], relative=matrix.relative[-2:])))
    assert {
        "figure-crosstalk",
        "figure-crosstalk-largest",
        "figure-excitation",
        "figure-curve-Mz-Mz",
        "figure-budget",
    } <= set(found.ids)
    text = "".join(found.text)
    assert headlines(matrix, {})[-1].label in text
    assert f"{matrix.matrices[0].chi2:.1f} / {matrix.matrices[0].dof}" in text


@pytest.mark.parametrize("name", ["swept", "matrix"])
def test_first_screen_and_paper_of_a_campaign(browser, name, request, tmp_path):
    file = tmp_path / "report.html"
    file.write_text(render_campaign(request.getfixturevalue(name)), encoding="utf-8")
    assert below_the_first_screen(browser, file, ".front .plot") == []
    found = paper(browser, file, tmp_path / "report.pdf")
    assert found.pop("summary_mm") < 297.0 - 2 * 16.0
    assert found == {"missing": [], "broken": 0, "wide": [], "blank": []}


def weaker(entry: RecordingResults, share: float) -> RecordingResults:
    """The same recording with a smaller load."""
    factor = np.full((1, 6), share, dtype=np.complex128)
    drives = tuple(
        replace(
            drive,
            recording=f"{entry.name}, weak",
            load=share * drive.load,
            load_uncertainty=drive.load_uncertainty.scaled(factor),
            outputs=share * drive.outputs,
            outputs_uncertainty=drive.outputs_uncertainty.scaled(factor),
        )
        for drive in entry.excited_lines
    )
    return replace(entry, name=f"{entry.name}, weak", folder=f"{entry.folder}-weak", excited_lines=drives)


def test_a_series_of_amplitudes_determines_linearity():
    strong = sweep()[:4]
    found = evaluate_campaign("series", (*strong, *(weaker(entry, 0.5) for entry in strong)), {})
    assert [len(repeated.recordings) for repeated in found.repeats] == [4, 4]
    assert [point.recordings for point in curve_points(found)] == [8] * 6
    series, repeats = linearity_table(found), repeats_table(found)
    assert re.fullmatch(r"48\d\S* to 97\d\S* N", series.rows[0][2])
    assert (series.rows[0][1], series.rows[0][3]) == ("Fz", "8")
    assert series.rows[0][-1] == "linear within U"
    assert [row[3:5] for row in repeats.rows] == [("4", "2"), ("4", "2")]
    with h5py.File(io.BytesIO(campaign_h5(found, []))) as file:
        assert file["linearity/000/amplitude"].shape == (8,)
        assert file["repeats/001/mountings"].asstr()[()].tolist().count("2") == 2


def test_recordings_and_inputs_of_equal_names_are_distinguished():
    first, second = (replace(entry, name="the same") for entry in sweep()[:2])
    found = evaluate_campaign("twice", (first, second), {})
    assert [entry.name for entry in found.recorded] == [f"the same [{entry.folder}]" for entry in (first, second)]
    assert [drive.recording for drive in found.excited_lines] == [entry.name for entry in found.recorded]
    assert [drive.start for drive in found.excited_lines] == [drive.recording for drive in found.excited_lines]
    grids = (EdgeGrid(0.1, 0.02, 2e-5, 0.0, np.nan),)
    alike = (replace(e, excited_lines=tuple(replace(d, grids=grids) for d in e.excited_lines)) for e in (first, second))
    assert {drive.start for drive in evaluate_campaign("twice", tuple(alike), {}).excited_lines} == {
        found.recorded[0].name
    }
    hashes = {"rig.toml": "cd" * 32, **first.origin.input_hashes}
    known = replace(first, origin=replace(first.origin, input_hashes=hashes))
    other = replace(second, origin=replace(second.origin, input_hashes={"rig.toml": "ef" * 32}))
    assert campaign_origin([known, other]).input_hashes == {**hashes, f"{second.folder}: rig.toml": "ef" * 32}


def no_common_output(entry: RecordingResults) -> RecordingResults:
    drives = [replace(drive, channels=tuple(f"{name}'" for name in drive.channels)) for drive in entry.excited_lines]
    return replace(entry, excited_lines=tuple(drives))


@pytest.mark.parametrize(
    ("change", "declared"),
    [
        (lambda entry: replace(entry, sensor=replace(SENSOR, serial="4711")), SEVERAL_SENSORS),
        (no_common_output, NO_JOINT_RESULT),
    ],
)
def test_recordings_without_joint_results_keep_their_individual_results(change, declared):
    first, second = sweep()[:2]
    found = evaluate_campaign("two", (first, change(second)), {})
    assert found.curves == ()
    assert found.notices[0].code == declared.code
    bare = evaluate_campaign("bare", (replace(first, sensor=None, excited_lines=()),), {})
    assert bare.curves == ()
    assert recordings_table(bare).rows[0][-1] in "".join(outline(render_campaign(bare)).text)


def test_files_are_written_from_files(tmp_path, monkeypatch):
    monkeypatch.setattr(results, "render_report", lambda _: "<!doctype html>\n")
    monkeypatch.setattr(joint_write, "render_campaign", lambda evaluation: f"<!doctype html>{evaluation.name}\n")
    top, folders = tmp_path / "results", []
    for number, mounting in enumerate(("1", "1", "2")):
        folders.append(top / f"run-{number}")
        choice = Choice(frames=24, images=False, name=f"run {number}", mounting=mounting)
        write_results(make_evaluation(tmp_path, choice), folders[-1])
    paths = write_campaign(top, "three", folders, {})[1]
    assert {path.name for path in paths} == set(CAMPAIGN_FILES)
    before = {path.name: path.read_bytes() for path in paths}
    assert all(write_campaign(top, "three", folders, {})[1])
    assert {path.name: path.read_bytes() for path in paths} == before
    seen = {(row["channel"], row["recordings"], row["mountings"]) for row in rows(top / "curve.csv")}
    assert seen == {(name, "3", "2") for name in LOADS}
    check_campaign_folder(top, [folder.name for folder in folders], force=False)
    (top / "notes.txt").write_text("mine", encoding="utf-8")
    names = [folder.name for folder in folders]
    code = OTHER_CAMPAIGN_CONTENT.code
    error = refused(code, check_campaign_folder, top, names, force=False, error=InputError)
    assert (error.code, error.file, error.values) == (code, top, {"found": "notes.txt"})
