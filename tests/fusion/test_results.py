"""The result files: columns, full precision, what has no row, whole or not at all, resumed, merged."""

from __future__ import annotations

import csv
import dataclasses
from pathlib import Path

import h5py
import numpy as np
import pytest
from evaluation_factory import ACCELERATION, Choice, make_evaluation

from fusion.base import InputError
from fusion.report.csv_files import merge_tables
from fusion.report.provenance import is_current
from fusion.report.recording import recording as results
from fusion.report.recording import write_results
from fusion.sensitivity.analyse import Evaluation

SENSITIVITY = (
    "frequency_hz,channel,component,magnitude,phase_rad,u_magnitude,u_phase_rad,re,im,u_re,u_im,r,dof,unit,kind,"
    "recording"
)
PHASOR = (
    "frequency_hz,body,component,amplitude,phase_rad,u_amplitude,u_phase_rad,re,im,u_re,u_im,r,dof,unit,source,"
    "recording"
)
MOTION = "time_s,x_m,y_m,z_m,rx_rad,ry_rad,rz_rad,u_x_m,u_y_m,u_z_m,u_rx_rad,u_ry_rad,u_rz_rad,residual_m,points"


@pytest.fixture(scope="module")
def evaluation(tmp_path_factory: pytest.TempPathFactory) -> Evaluation:
    return make_evaluation(tmp_path_factory.mktemp("Fz"), Choice(frames=62, images=True))


@pytest.fixture(scope="module")
def folder(evaluation: Evaluation, tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("out") / "results"
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(results, "render_report", lambda _: "<!doctype html>\n")
        write_results(evaluation, out)
    return out


@pytest.fixture
def quick(monkeypatch: pytest.MonkeyPatch) -> None:
    """Leave the figures out where only the handling of files is tested."""
    monkeypatch.setattr(results, "render_report", lambda _: "<!doctype html>\n")


def rows(path: Path) -> list[dict[str, str]]:
    with path.open(encoding="utf-8", newline="") as stream:
        return list(csv.DictReader(stream))


def test_exactly_the_files_of_the_format(folder: Path) -> None:
    names = {path.name for path in folder.iterdir()}
    wanted = {"sensitivity.csv", "acceleration.csv", "load.csv", "motion-top.csv", "motion-base.csv"}
    assert names == wanted | {"result.h5", "report.html"}
    assert list(folder.parent.iterdir()) == [folder]


@pytest.mark.parametrize(
    ("name", "header"),
    [
        ("sensitivity.csv", SENSITIVITY),
        ("acceleration.csv", PHASOR),
        ("load.csv", PHASOR),
        ("motion-top.csv", MOTION),
    ],
)
def test_columns_and_cells(folder: Path, name: str, header: str) -> None:
    text = (folder / name).read_text(encoding="utf-8")
    assert text.splitlines()[0] == header
    assert "\r" not in text
    for row in rows(folder / name):
        assert all(row.values()), f"empty cell in {row}"
        assert row.get("unit", "").isascii()


def test_phasors_are_read_back_to_the_last_bit(folder: Path, evaluation: Evaluation) -> None:
    fused = evaluation.accelerations[0].phasors
    found = [row for row in rows(folder / "acceleration.csv") if (row["body"], row["source"]) == ("load", "fused")]
    value = np.array([float(row["re"]) + 1j * float(row["im"]) for row in found]).reshape(3, 6)
    assert np.array_equal(value, fused.value)
    assert np.array_equal(
        [float(row["u_re"]) for row in found], np.sqrt(fused.covariance[:, range(6), range(6)]).ravel()
    )
    first = found[2]
    assert float(first["amplitude"]) == pytest.approx(abs(fused.value[0, 2]), rel=1e-15)
    assert float(first["r"]) == pytest.approx(0.3)
    assert (first["component"], first["unit"]) == ("z", "m/s^2")
    assert float(first["dof"]) == pytest.approx(204.0)


def test_only_what_a_source_determines_has_rows(folder: Path) -> None:
    found = rows(folder / "acceleration.csv")
    laser = [row for row in found if row["source"] == "vibrometer"]
    assert {row["component"] for row in laser} == {"z"}
    assert len(laser) == 3
    assert {(row["channel"], row["component"]) for row in rows(folder / "sensitivity.csv")} == {
        (channel, "Fz") for channel in ("Fx", "Fy", "Fz", "Mx", "My", "Mz")
    }


def test_sensitivity_rows(folder: Path) -> None:
    found = rows(folder / "sensitivity.csv")
    assert {row["unit"] for row in found} == {"(V/V)/N"}
    assert [row["kind"] for row in found] == ["ratio"] * 6 + ["harmonic"] * 12
    assert found[-1]["dof"] == "inf"
    assert {row["recording"] for row in found} == {"Fz 106.25 Hz"}
    assert all(-np.pi < float(row["phase_rad"]) <= np.pi for row in found)


def test_failed_frame_keeps_its_row(folder: Path) -> None:
    found = rows(folder / "motion-top.csv")
    failed = found[57]
    assert len(found) == 62
    assert failed["points"] == "0"
    assert all(cell == "nan" for name, cell in failed.items() if name not in ("time_s", "points"))
    assert np.isfinite(float(failed["time_s"]))
    assert found[0]["x_m"] == "0.0"
    assert found[1]["points"] == "437"


def test_result_file_holds_everything(folder: Path, evaluation: Evaluation) -> None:
    with h5py.File(folder / "result.h5") as file:
        fused = file["accelerations/load-fused"]
        assert np.array_equal(fused["phasors/value"][()], evaluation.accelerations[0].phasors.value)
        assert np.array_equal(fused["phasors/covariance"][()], evaluation.accelerations[0].phasors.covariance)
        assert "scatter of the sine approximation" in fused["uncertainty/random"]
        assert file["sensitivity/uncertainty/covariance"].shape == (3, 12, 12)
        assert file["sensitivity/elements"][()].tolist() == [[channel, 2] for channel in range(6)]
        assert {entry.attrs["type"] for entry in file["sensitivity/budget"].values()} == {"A", "B"}
        assert file["stereo/top/motion/covariance"].shape == (62, 6, 6)
        assert file["stereo/base/residual"].shape == (62, 6)
        assert file["clocks/bridge/tie"].attrs["rate"] == 1.0 + 4.2e-6
        assert file["lines/why"].asstr()[0] == "nominal frequency, refined"
        assert file["channels/vibrometer-velocity"].attrs["unit"] == "m/s"
        assert file["notices/severity"].asstr()[()].tolist() == ["info", "warning"]
        assert file["accelerations/load-fused/consistency/normalised_deviation"].shape == (2,)
        assert file["provenance/input_file"].asstr()[1] == "Fz/recording.toml"
        assert file["provenance/versions"].attrs["numpy"] == "2.0"


def test_results_answer_for_the_same_input_only(
    folder: Path, evaluation: Evaluation, monkeypatch: pytest.MonkeyPatch
) -> None:
    hashes, settings = evaluation.input_hashes, evaluation.settings
    assert is_current(folder, hashes, settings)
    assert not is_current(folder, {**hashes, "rig.toml": "00" * 32}, settings)
    assert not is_current(folder, hashes, {**settings, "subset_radius_px": 11})
    assert not is_current(folder.parent, hashes, settings)
    monkeypatch.setattr("fusion.report.provenance.importlib.metadata.version", lambda _: "99.0")
    assert not is_current(folder, hashes, settings)


@pytest.mark.usefixtures("quick")
def test_incomplete_folder_is_not_current(evaluation: Evaluation, tmp_path: Path) -> None:
    write_results(evaluation, tmp_path / "results")
    (tmp_path / "results" / "load.csv").unlink()
    assert not is_current(tmp_path / "results", evaluation.input_hashes, evaluation.settings)


@pytest.mark.usefixtures("quick")
def test_other_peoples_files_are_refused_and_survive_force(evaluation: Evaluation, tmp_path: Path) -> None:
    (tmp_path / "notes.txt").write_text("mine", encoding="utf-8")
    with pytest.raises(InputError):
        write_results(evaluation, tmp_path)
    assert [path.name for path in tmp_path.iterdir()] == ["notes.txt"]
    written = write_results(evaluation, tmp_path, force=True)
    assert all(path.is_file() for path in written)
    assert (tmp_path / "notes.txt").read_text(encoding="utf-8") == "mine"


@pytest.mark.usefixtures("quick")
def test_results_of_other_input_are_refused_and_replaced_by_force(evaluation: Evaluation, tmp_path: Path) -> None:
    out = tmp_path / "results"
    write_results(evaluation, out)
    (out / "motion-mine.csv").write_text("not a result of the program", encoding="utf-8")
    other = dataclasses.replace(evaluation, stereo=(), input_hashes={"rig.toml": "11" * 32})
    with pytest.raises(InputError, match="other input"):
        write_results(other, out)
    write_results(other, out, force=True)
    assert not (out / "motion-top.csv").exists()
    assert (out / "motion-mine.csv").exists()
    assert is_current(out, other.input_hashes, other.settings)


@pytest.mark.parametrize("existing", [False, True])
def test_a_failure_leaves_everything_as_it_was(
    evaluation: Evaluation, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, existing: bool
) -> None:
    out = tmp_path / "results"
    monkeypatch.setattr(results, "render_report", lambda _: "<!doctype html>\n")
    if existing:
        write_results(evaluation, out)
    before = {path: path.read_bytes() for path in tmp_path.rglob("*") if path.is_file()}

    def fail(_: Evaluation) -> str:
        raise RuntimeError("out of paper")

    monkeypatch.setattr(results, "render_report", fail)
    with pytest.raises(RuntimeError, match="out of paper"):
        write_results(evaluation, out)
    assert {path: path.read_bytes() for path in tmp_path.rglob("*") if path.is_file()} == before
    assert out.exists() == existing


@pytest.mark.usefixtures("quick")
def test_rewriting_gives_the_same_tables(evaluation: Evaluation, tmp_path: Path) -> None:
    written = write_results(evaluation, tmp_path / "results")
    before = {path.name: path.read_bytes() for path in written if path.suffix == ".csv"}
    write_results(evaluation, tmp_path / "results")
    assert {name: (tmp_path / "results" / name).read_bytes() for name in before} == before


@pytest.mark.usefixtures("quick")
def test_recording_without_sensor_and_cameras(tmp_path: Path) -> None:
    bare = make_evaluation(tmp_path, Choice(sensor=False, images=False))
    written = write_results(bare, tmp_path / "results")
    assert (tmp_path / "results" / "sensitivity.csv").read_text(encoding="utf-8") == SENSITIVITY + "\n"
    assert {path.name for path in written} == {
        "sensitivity.csv",
        "acceleration.csv",
        "load.csv",
        "report.html",
        "result.h5",
    }


@pytest.mark.usefixtures("quick")
def test_campaign_tables_are_the_recordings_rows_in_order(tmp_path: Path) -> None:
    folders = []
    for name in ("Fz, first", 'Fz "second"'):
        folders.append(tmp_path / str(len(folders)))
        write_results(make_evaluation(tmp_path, Choice(frames=24, name=name)), folders[-1])
    tables = merge_tables(folders)
    assert set(tables) == {"sensitivity.csv", "acceleration.csv", "load.csv"}
    for name, text in tables.items():
        (tmp_path / name).write_text(text, encoding="utf-8", newline="\n")
        separate = rows(folders[0] / name) + rows(folders[1] / name)
        assert rows(tmp_path / name) == separate
    assert rows(tmp_path / "load.csv")[-1]["recording"] == 'Fz "second"'


def test_campaign_refuses_a_table_of_another_format(tmp_path: Path) -> None:
    (tmp_path / "load.csv").write_text("a,b\n1,2\n", encoding="utf-8")
    with pytest.raises(ValueError, match=r"load\.csv: expected the columns"):
        merge_tables([tmp_path])


def test_true_acceleration_lies_within_its_uncertainty(folder: Path) -> None:
    driven = next(row for row in rows(folder / "acceleration.csv") if row["component"] == "z")
    assert abs(float(driven["amplitude"]) - abs(ACCELERATION[0, 2])) < 4.0 * float(driven["u_amplitude"])
