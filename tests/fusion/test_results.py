"""The result files: columns, full precision, whole or not at all, resumed, merged, read back to the last bit."""

from __future__ import annotations

import hashlib
from collections.abc import Callable
from dataclasses import fields, is_dataclass, replace
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest
from contracts import refused
from evaluation_factory import ACCELERATION, LOAD_COMPONENTS, STATIC, Choice, make_evaluation
from support import documented_columns, folder_contents, rows, without_pages

from fusion.base import versions
from fusion.campaign.campaign_notices import NO_RECORDING_RESULTS
from fusion.campaign.excited_line import excited_lines_of
from fusion.campaign.recording_results import read_recorded
from fusion.errors import InputError
from fusion.estimation.uncertainty import Influence, Uncertainty
from fusion.report import recording_report as results
from fusion.report.folder import check_folder, hash_files, is_current, read_provenance, sha256
from fusion.report.recording_report import MERGED_FILES, merged_table, write_results
from fusion.report.report_notices import DAMAGED_RESULTS, OTHER_CONTENT, OTHER_FORMAT, OUTPUT_IS_FILE
from fusion.report.tables import headlines, sensitivity_table
from fusion.sensitivity.analyse import Evaluation
from fusion.sensor.identify import sine_curves
from fusion.sensor.identify.identification_inputs import EvaluatedSines

FORMAT = "results.md"
SENSITIVITY, PHASOR = (",".join(documented_columns(FORMAT, f"{name}.csv")) for name in ("sensitivity", "acceleration"))
MOTION = "time_s,x_m,y_m,z_m,rx_rad,ry_rad,rz_rad,u_x_m,u_y_m,u_z_m,u_rx_rad,u_ry_rad,u_rz_rad,residual_m,points"


@pytest.fixture(scope="module")
def evaluation(tmp_path_factory: pytest.TempPathFactory) -> Evaluation:
    return make_evaluation(tmp_path_factory.mktemp("Fz"), Choice(frames=62, images=True))


@pytest.fixture(scope="module")
def folder(evaluation: Evaluation, tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("out") / "results"
    with pytest.MonkeyPatch.context() as patch:
        without_pages(patch)
        write_results(evaluation, out)
    return out


@pytest.fixture
def write(no_pages: None, tmp_path: Path) -> Callable[[Evaluation], Path]:
    """Return a function that writes an evaluation without figures and returns the folder."""

    def written(evaluation: Evaluation) -> Path:
        write_results(evaluation, tmp_path / "out")
        return tmp_path / "out"

    return written


def test_exactly_the_files_columns_and_cells_of_the_format(folder):
    heads = {"sensitivity.csv": SENSITIVITY, "acceleration.csv": PHASOR, "load.csv": PHASOR}
    heads |= {"motion-top.csv": MOTION, "motion-base.csv": MOTION}
    assert {path.name for path in folder.iterdir()} == {*heads, "result.h5", "report.html"}
    assert list(folder.parent.iterdir()) == [folder]
    for name, header in heads.items():
        text = (folder / name).read_bytes().decode("utf-8")
        assert text.splitlines()[0] == header
        assert "\r" not in text
        for row in rows(folder / name):
            assert all(row.values()), f"empty cell in {row}"
            assert row.get("unit", "").isascii()


def test_phasors_are_read_back_to_the_last_bit(folder, evaluation):
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


def test_only_components_that_a_source_determines_have_rows(folder):
    laser = [row for row in rows(folder / "acceleration.csv") if row["source"] == "vibrometer"]
    assert [row["component"] for row in laser] == ["z"] * 3
    driven = next(row for row in rows(folder / "acceleration.csv") if row["component"] == "z")
    assert abs(float(driven["amplitude"]) - abs(ACCELERATION[0, 2])) < 4.0 * float(driven["u_amplitude"])
    found = rows(folder / "sensitivity.csv")
    assert [(row["channel"], row["component"]) for row in found] == [(name, "Fz") for name in LOAD_COMPONENTS] * 3
    assert {row["unit"] for row in found} == {"(V/V)/N"}
    assert [row["kind"] for row in found] == ["ratio"] * 6 + ["harmonic"] * 12
    assert found[-1]["dof"] == "inf"
    assert {row["recording"] for row in found} == {"Fz 106.25 Hz"}
    assert all(-np.pi < float(row["phase_rad"]) <= np.pi for row in found)


def test_elements_have_rows_after_the_ratios_and_are_in_the_headline(write, tmp_path):
    plain = make_evaluation(tmp_path, Choice(frames=24, images=False))
    value = plain.sensitivity.value.copy()
    value[1:] = np.nan
    value[0] *= 1.01
    evaluation = replace(plain, element=replace(plain.sensitivity, value=value, kind=("element",) * 3))
    folder = write(evaluation)
    found = rows(folder / "sensitivity.csv")
    assert [row["kind"] for row in found] == ["ratio"] * 6 + ["harmonic"] * 12 + ["element"] * 6
    with h5py.File(folder / "result.h5") as file:
        assert np.array_equal(file["element/value"][()], value, equal_nan=True)
    assert headlines(evaluation)[0].label == "Sensitivity, output Fz per load Fz, 106.3 Hz"
    assert headlines(plain)[0].label == "Ratio Fz output / Fz load, 106.3 Hz"
    names = [row[1] for row in sensitivity_table(evaluation).rows]
    assert names[2:9:6] == ["Fz per Fz", "ratio Fz output / Fz load"]
    assert names[6] == "response of Fx to load Fz"


def test_failed_frame_keeps_its_row(folder):
    found = rows(folder / "motion-top.csv")
    failed = found[57]
    assert len(found) == 62
    assert failed["points"] == "0"
    assert all(cell == "nan" for name, cell in failed.items() if name not in ("time_s", "points"))
    assert np.isfinite(float(failed["time_s"]))
    assert found[0]["x_m"] == "0.0"
    assert found[1]["points"] == "437"


def test_result_file_contains_everything(folder, evaluation):
    with h5py.File(folder / "result.h5") as file:
        fused = file["accelerations/load-fused"]
        assert np.array_equal(fused["phasors/value"][()], evaluation.accelerations[0].phasors.value)
        assert np.array_equal(fused["phasors/covariance"][()], evaluation.accelerations[0].phasors.covariance)
        assert "scatter of the sine approximation" in fused["uncertainty/random"]
        assert file["sensitivity/uncertainty/covariance"].shape == (3, 12, 12)
        assert file["sensitivity/elements"][()].tolist() == [[channel, 2] for channel in range(6)]
        assert {entry.attrs["type"] for entry in file["sensitivity/budget"].values()} == {"A", "B"}
        assert file["sensitivity/budget"].attrs["not_assessed"] == "repeatability, mounting anew"
        assert file["stereo/top/motion/covariance"].shape == (62, 6, 6)
        assert file["stereo/base/residual"].shape == (62, 6)
        assert file["stereo/top/epipolar/course_px"].shape == (62, 3)
        assert file["stereo/top/epipolar/pattern_covariance"].shape == (3, 3)
        assert file["clocks/bridge/tie"].attrs["rate"] == 1.0 + 4.2e-6
        assert file["lines/why"].asstr()[0] == "nominal frequency, refined"
        assert file["channels/vibrometer-velocity"].attrs["unit"] == "m/s"
        assert file["notices/severity"].asstr()[()].tolist() == ["note", "warning"]
        assert file["accelerations/load-fused/consistency/normalised_deviation"].shape == (2,)
        assert file["provenance/input_file"].asstr()[1] == "Fz/recording.toml"
        assert file["provenance/versions"].attrs["numpy"] == "2.0"


def test_results_are_current_for_the_same_input_only(folder, evaluation, monkeypatch):
    hashes, settings = evaluation.input_hashes, evaluation.settings
    assert is_current(folder, hashes, settings)
    assert not is_current(folder, {**hashes, "rig.toml": "00" * 32}, settings)
    assert not is_current(folder, hashes, {**settings, "subset_radius_px": 11})
    assert not is_current(folder.parent, hashes, settings)
    monkeypatch.setattr("fusion.report.folder.__version__", "99.0")
    assert not is_current(folder, hashes, settings)


@pytest.mark.usefixtures("no_pages")
def test_results_are_replaced_only_by_those_of_the_same_input_or_by_force(evaluation, tmp_path):
    out = tmp_path / "results"
    first = {path.name: path.read_bytes() for path in write_results(evaluation, out) if path.suffix == ".csv"}
    write_results(evaluation, out)
    assert {name: (out / name).read_bytes() for name in first} == first
    (out / "motion-mine.csv").write_text("not a result of the program", encoding="utf-8")
    other = replace(evaluation, stereo=(), input_hashes={"rig.toml": "11" * 32})
    refused(OTHER_CONTENT.code, write_results, other, out, error=InputError)
    write_results(other, out, force=True)
    assert not (out / "motion-top.csv").exists()
    assert (out / "motion-mine.csv").exists()
    assert is_current(out, other.input_hashes, other.settings)
    (out / "load.csv").unlink()
    assert not is_current(out, other.input_hashes, other.settings)
    (tmp_path / "b").mkdir()
    (tmp_path / "b" / "notes.txt").write_text("mine", encoding="utf-8")
    refused(OTHER_CONTENT.code, write_results, evaluation, tmp_path / "b", error=InputError)
    assert [path.name for path in (tmp_path / "b").iterdir()] == ["notes.txt"]
    assert all(path.is_file() for path in write_results(evaluation, tmp_path / "b", force=True))
    assert (tmp_path / "b" / "notes.txt").read_text(encoding="utf-8") == "mine"


@pytest.mark.usefixtures("no_pages")
@pytest.mark.parametrize("existing", [False, True])
def test_a_failure_leaves_everything_as_it_was(evaluation, tmp_path, monkeypatch, existing):
    out = tmp_path / "results"
    if existing:
        write_results(evaluation, out)
    before = folder_contents(tmp_path)

    def fail(_: Evaluation) -> str:
        raise RuntimeError("out of paper")

    monkeypatch.setattr(results, "render_report", fail)
    refused("out of paper", write_results, evaluation, out, error=RuntimeError)
    assert folder_contents(tmp_path) == before
    assert out.exists() == existing


def test_recording_without_sensor_and_cameras(write, tmp_path):
    bare = make_evaluation(tmp_path, Choice(sensor=False, images=False))
    folder = write(bare)
    assert (folder / "sensitivity.csv").read_text(encoding="utf-8") == SENSITIVITY + "\n"
    names = {"sensitivity.csv", "acceleration.csv", "load.csv", "report.html", "result.h5"}
    assert {path.name for path in folder.iterdir()} == names
    found = read_recorded(folder)
    assert (found.sensor, found.excited_lines) == (None, ())
    assert read_recorded(write(replace(bare, notices=()))).notices == ()
    with h5py.File(folder / "result.h5", "r+") as file:
        file.attrs["format"] = 1
    refused(OTHER_FORMAT.code, read_recorded, folder, error=InputError)
    refused(NO_RECORDING_RESULTS.code, read_recorded, tmp_path, error=InputError)


def _external_link(file: h5py.File, other: Path) -> None:
    file["notices/more"] = h5py.ExternalLink(str(other), "/a")


def _external_storage(file: h5py.File, other: Path) -> None:
    file.create_dataset("notices/more", (10,), "f8", external=[(str(other), 0, 80)])


def _virtual(file: h5py.File, other: Path) -> None:
    layout = h5py.VirtualLayout((10,), "f8")
    layout[:] = h5py.VirtualSource(str(other), "a", (10,))
    file.create_virtual_dataset("notices/more", layout)


@pytest.mark.parametrize(
    ("change", "found"), [(_external_link, "link"), (_external_storage, "files"), (_virtual, "virtual")]
)
def test_results_that_lead_to_other_files_are_none(write, tmp_path, change, found):
    """Wherever results are read, and whether or not what leads away is asked for."""
    folder = write(make_evaluation(tmp_path, Choice(images=False)))
    with h5py.File(tmp_path / "other.h5", "w") as file:
        file["a"] = np.arange(10.0)
    assert read_provenance(folder) is not None
    with h5py.File(folder / "result.h5", "r+") as file:
        change(file, tmp_path / "other.h5")
    damaged = rf"^{DAMAGED_RESULTS.code} .*result\.h5: .*notices/more.*{found}"
    refused(damaged, read_recorded, folder, error=InputError)
    sines = EvaluatedSines(make_evaluation(tmp_path, Choice(images=False)).manifest, folder)
    refused(damaged, sine_curves._transfer, sines, "Fz", "", None, error=InputError)
    assert read_provenance(folder) is None
    refused(OTHER_CONTENT.code, check_folder, folder, {}, force=False, error=InputError)


def _group_elsewhere(file: h5py.File, other: Path) -> None:
    with h5py.File(other, "r+") as target:
        file.copy("provenance", target)
    del file["provenance"]
    file["provenance"] = h5py.ExternalLink(str(other), "/provenance")


def _names_elsewhere(file: h5py.File, other: Path) -> None:
    del file["provenance/files"]
    file["provenance/files"] = h5py.ExternalLink(str(other), "/a")


def _names_outside(file: h5py.File, other: Path) -> None:
    del file["provenance/files"]
    file.create_dataset("provenance/files", (10,), "f8", external=[(str(other), 0, 80)])


@pytest.mark.usefixtures("no_pages")
@pytest.mark.parametrize("change", [_group_elsewhere, _names_elsewhere, _names_outside])
def test_replaced_files_are_named_by_the_results(tmp_path, change):
    """What stands elsewhere in the file that is replaced counts no more; the list of files must be its own."""
    evaluation = make_evaluation(tmp_path, Choice(images=False))
    folder = tmp_path / "own"
    write_results(evaluation, folder)
    with h5py.File(tmp_path / "other.h5", "w") as file:
        file["a"] = np.arange(10.0)
    with h5py.File(folder / "result.h5", "r+") as file:
        file["notices/more"] = h5py.ExternalLink(str(tmp_path / "other.h5"), "/a")
    assert read_provenance(folder) is None
    before = read_provenance(folder, provenance_only=True)
    assert before is not None
    assert "result.h5" in before.files
    with h5py.File(folder / "result.h5", "r+") as file:
        change(file, tmp_path / "other.h5")
    assert read_provenance(folder, provenance_only=True) is None


@pytest.mark.usefixtures("no_pages")
def test_campaign_tables_are_the_recordings_rows_in_order(tmp_path):
    folders = []
    for name in ("Fz, first", 'Fz "second"'):
        folders.append(tmp_path / str(len(folders)))
        write_results(make_evaluation(tmp_path, Choice(frames=24, name=name)), folders[-1])
    assert set(MERGED_FILES) == {"sensitivity.csv", "acceleration.csv", "load.csv"}
    for name in MERGED_FILES:
        (tmp_path / name).write_text("".join(merged_table(name, folders)), encoding="utf-8", newline="\n")
        separate = rows(folders[0] / name) + rows(folders[1] / name)
        assert rows(tmp_path / name) == separate
    assert rows(tmp_path / "load.csv")[-1]["recording"] == 'Fz "second"'
    (tmp_path / "load.csv").write_text("a,b\n1,2\n", encoding="utf-8")
    refused(r"load\.csv: ", lambda: list(merged_table("load.csv", [tmp_path])))


def identical(first: Any, second: Any) -> bool:
    """Whether two trees of data classes hold the same types, texts and bits."""
    if isinstance(first, np.ndarray):
        return first.dtype == second.dtype and first.shape == second.shape and first.tobytes() == second.tobytes()
    if is_dataclass(first):
        names = [field.name for field in fields(first)]
        return type(first) is type(second) and all(identical(getattr(first, n), getattr(second, n)) for n in names)
    if isinstance(first, tuple):
        return len(first) == len(second) and all(map(identical, first, second))
    return type(first) is type(second) and first == second


def with_clock(item: Any, seed: int) -> Any:
    """Load or outputs with two unknowns, one of which both have."""
    lines, size = item.uncertainty.random[0].covariance.shape[:2]
    effect = np.random.default_rng(seed).standard_normal((2, lines, size))
    shared = Influence("clock bridge: time", "clock", 1e-7, "s", effect[0], "start")
    own = Influence(f"scale {seed}", "scale", 2.5e-4, "1", effect[1], "rig")
    return replace(item, uncertainty=Uncertainty(item.uncertainty.random, (shared, own)))


def test_drives_are_read_back_to_the_last_bit_with_sensor_excitation_and_notices(write, tmp_path):
    plain = make_evaluation(tmp_path, Choice(frames=24, images=False, mounting="second"))
    evaluation = replace(plain, load=with_clock(plain.load, 1), outputs=with_clock(plain.outputs, 2))
    drives = excited_lines_of(evaluation)
    assert [drive.mounting for drive in drives] == ["second"]
    names = [influence.name for influence in drives[0].outputs_uncertainty.influences]
    assert names == ["clock bridge: time", "scale 2"]
    found = read_recorded(write(evaluation))
    assert identical(drives, found.excited_lines)
    assert [grid.start_s for grid in found.excited_lines[0].grids] == [0.97, 1.4012]
    assert (found.folder, found.name, found.mounting, found.kind) == ("out", "Fz 106.25 Hz", "second", "sine")
    assert (found.direction, found.frequencies) == ((0.0, 0.0, 1.0), (106.25,))
    assert np.array_equal(np.asarray(found.sensor.static), STATIC)
    assert (found.sensor.serial, found.sensor.unit, found.sensor.u_static) == ("0815", "V/V", 1e-3)
    assert (found.sensor.stated_matrix.cross_talk, found.sensor.stated_matrix.u_cross_talk) == (0.02, 2e-4)
    assert [notice.severity for notice in found.notices] == [notice.severity for notice in evaluation.notices]
    assert found.origin.input_hashes == evaluation.input_hashes


def test_hashes_are_of_whole_files_named_from_the_root_and_sorted(tmp_path):
    content = bytes(range(256)) * 9000
    assert len(content) > 2 << 20
    for data, digest in (
        (content, hashlib.sha256(content).hexdigest()),
        (b"abc", "ba7816bf8f01cfea414140de5dae2223b00361a396177a9cb410ff61f20015ad"),  # FIPS 180-4 example
    ):
        (tmp_path / "file").write_bytes(data)
        assert sha256(tmp_path / "file") == digest
    root = tmp_path / "campaign"
    (root / "b").mkdir(parents=True)
    paths = [root / "rig.toml", root / "b" / "x.tif", tmp_path / "elsewhere.h5"]
    for path in paths:
        path.write_bytes(path.name.encode())
    hashes = hash_files([*paths, paths[0]], root).hashes
    assert list(hashes) == sorted(["rig.toml", "b/x.tif", paths[2].resolve().as_posix()])


def test_versions_name_the_program_and_only_imported_libraries():
    assert {"shakercal", "python", "platform", "numpy", "h5py"} <= set(versions())
    assert "pyarrow" not in versions()


def test_folder_rules(tmp_path):
    check_folder(tmp_path / "absent", {}, force=False)
    check_folder(tmp_path, {}, force=False)
    (tmp_path / "thesis.txt").write_text("mine")
    refused(OTHER_CONTENT.code, check_folder, tmp_path, {}, force=False, error=InputError)
    check_folder(tmp_path, {}, force=True)
    refused(OUTPUT_IS_FILE.code, check_folder, tmp_path / "thesis.txt", {}, force=True, error=InputError)
    (tmp_path / "result.h5").write_bytes(b"not HDF5")
    assert read_provenance(tmp_path) is None
    with h5py.File(tmp_path / "result.h5", "w") as file:
        file["data"] = 1.0
    assert read_provenance(tmp_path) is None
