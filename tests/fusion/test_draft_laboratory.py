"""Drafts of a campaign whose files have the names of its recorders and cameras, with numbers."""

from __future__ import annotations

import re
import shutil
import tomllib
from pathlib import Path
from typing import Any

import h5py
import pytest
from calibration_files import write_all
from support import edit, folder_contents

from fusion.cli import main
from fusion.planning.check import check
from fusion.planning.draft.init import run_init
from fusion.planning.draft.inventory import find_foreign_calibration
from fusion.planning.planning_notices import MANIFEST_EXISTS
from fusion.recording.load import load_manifest
from fusion.simulate import simulate

ANSWERS = """
sense = "on_sensor"
point = [0.0, 0.0, 0.069]
direction = [0.0, 0.0, 1.0]
Laser.scale = { value = 0.1, U_relative = 1e-3, k = 2 }
exposure = 60e-6
rotation = [[1.0, 0.0, 0.0], [0.0, -1.0, 0.0], [0.0, 0.0, -1.0]]
translation = [0.0, 0.0, 0.4]
stereo.pair.scale_uncertainty = 2e-4
[sensor]
internal_mass = { value = 0.214, U = 0.0005, k = 1 }
[load]
mass = { value = 2.4063, U = 0.0004, k = 2 }
centre_of_mass = [0.0, 0.0, 0.0385]
inertia = [[0.00193, 0.0, 0.0], [0.0, 0.00193, 0.0], [0.0, 0.0, 0.00225]]
"""


@pytest.fixture(scope="module")
def files(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The files of two recordings, and their calibration."""
    folder = tmp_path_factory.mktemp("files") / "files"
    simulate(folder, "files", 1, recordings=2, frames=8, image_scale=0.3)
    return folder


@pytest.fixture
def campaign(files: Path, tmp_path: Path) -> Path:
    """The first recording with its manifests, the second one without."""
    folder = tmp_path / "lab"
    shutil.copytree(files / "Fz_063Hz_1", folder / "Fz_063Hz_1")
    calibration = [str(files / "Kalibrierung" / "stereo.yml"), "-o", str(folder / "stereo.json")]
    assert main(["import-calibration", *calibration]) == 0
    (tmp_path / "answers.toml").write_text(ANSWERS, encoding="utf-8")
    assert run_init(folder, answers=tmp_path / "answers.toml").unfilled == 0
    shutil.copytree(files / "Fz_125Hz_1", folder / "Fz_125Hz_1")
    return folder


def blocks(recording: Path) -> Any:
    return tomllib.loads((recording / "recording.toml").read_text(encoding="utf-8"))["daq"]


def test_a_simulated_laboratory_has_no_manifests_and_is_replaced_only_unchanged(
    files: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    names = folder_contents(files)
    assert not [name for name in names if name.endswith((".toml", ".json")) and not name.endswith("truth.json")]
    assert {"Fz_063Hz_1/Messung_0001.csv", "Fz_063Hz_1/CamB/CamB_0007.tif", "Kalibrierung/stereo.yml"} <= set(names)
    head = names["Fz_063Hz_1/Messung_0001.csv"].decode("latin-1").split("\n", 8)
    assert head[0].startswith("Messverstärker;")
    assert head[6].startswith("0,000019531;")
    copy = Path(shutil.copytree(files, tmp_path / "copy"))
    (copy / "Fz_063Hz_1" / "notes.txt").write_text("mine")
    assert main(["simulate", str(copy), "--preset", "files", "--force"]) == 2
    assert "notes.txt in it" in capsys.readouterr().err


def test_one_trigger_in_two_recorders_has_one_name_whatever_the_files_call_it(campaign: Path) -> None:
    first, second = blocks(campaign / "Fz_063Hz_1")
    names = [[channel["name"] for channel in block["channel"]] for block in (first, second)]
    assert names == [["Laser", "Kamera"], ["Fx", "Fy", "Fz", "Mx", "My", "Mz", "Kamera"]]
    assert check(load_manifest(campaign / "Fz_063Hz_1")).problems == ()


def test_a_further_recording_of_numbered_files_asks_for_nothing(campaign: Path, tmp_path: Path) -> None:
    (tmp_path / "second.toml").write_text('mounting = "2"\n')
    drafted = run_init(campaign, campaign / "Fz_063Hz_1", answers=tmp_path / "second.toml")
    assert list(drafted.files) == [campaign / "Fz_125Hz_1" / "recording.toml"]
    assert drafted.unfilled == 0
    stated = [(block["name"], block["file"]) for block in blocks(campaign / "Fz_125Hz_1")]
    assert stated == [("Messung_0002", "Messung_0002.csv"), ("Bruecke_0002", "Bruecke_0002.tdms")]
    manifest = load_manifest(campaign / "Fz_125Hz_1")
    assert (manifest.mounting, check(manifest).problems) == ("2", ())


def test_one_line_states_the_uncertainty_of_all_outputs_and_further_recordings_have_it(campaign: Path) -> None:
    edit(campaign / "Fz_063Hz_1" / "recording.toml", "# scale_uncertainty = 0.0001", "scale_uncertainty = 5e-4")
    run_init(campaign, campaign / "Fz_063Hz_1")
    for name in ("Fz_063Hz_1", "Fz_125Hz_1"):
        _, bridge = load_manifest(campaign / name).daq
        assert [entry.scale_uncertainty for entry in bridge.channel if entry.quantity == "output"] == [5e-4] * 6


def test_recordings_of_the_simulator_are_simulated_whatever_their_manifests_state(campaign: Path) -> None:
    assert load_manifest(campaign / "Fz_063Hz_1").simulated
    (campaign / "Fz_063Hz_1" / "truth.json").unlink()
    assert not load_manifest(campaign / "Fz_063Hz_1").simulated


def test_a_calibration_of_another_program_leads_to_the_command_that_converts_it(files: Path, tmp_path: Path) -> None:
    folder = tmp_path / "lab"
    shutil.copytree(files / "Fz_063Hz_1", folder / "Fz_063Hz_1")
    shutil.copytree(files / "Kalibrierung", folder / "Kalibrierung")
    text = run_init(folder).files[folder / "rig.toml"]
    (command,) = re.findall(r"\(shakercal (import-calibration .*?)\)", text)
    assert main(command.split()) == 0
    (folder / "rig.toml").unlink()
    (folder / "Fz_063Hz_1" / "recording.toml").unlink()
    text = run_init(folder).files[folder / "rig.toml"]
    assert tomllib.loads(text)["stereo"]["pair"]["calibration"] == "stereo.json"


@pytest.mark.parametrize(
    "name", ["opencv.yml", "storage.xml", "dice.xml", "vic3d.xml", "a.caldat", "kalibr.yaml", "ros.yaml"]
)
def test_calibrations_of_other_programs_are_recognised(name: str, tmp_path: Path) -> None:
    write_all(tmp_path)
    (tmp_path / "lab").mkdir()
    shutil.copy(tmp_path / name, tmp_path / "lab" / name)
    (tmp_path / "lab" / "notes.xml").write_text("<notes>made on Monday</notes>")
    assert find_foreign_calibration(tmp_path / "lab") == tmp_path / "lab" / name


def test_results_are_no_recording(campaign: Path, capsys: pytest.CaptureFixture[str]) -> None:
    shutil.rmtree(campaign / "Fz_125Hz_1")
    (campaign / "results").mkdir()
    with h5py.File(campaign / "results" / "campaign.h5", "w") as file:
        file["provenance/input_sha256"] = ["0" * 64]
    (campaign / "results" / "curve.csv").write_text("frequency_hz,magnitude\n80,1\n90,1\n")
    capsys.readouterr()
    assert main(["init", str(campaign)]) == 2
    assert MANIFEST_EXISTS.code in capsys.readouterr().err
