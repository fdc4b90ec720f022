"""Every block of README and tutorials runs in an empty folder, shows its output, and leads to the true values."""

from __future__ import annotations

import re
import shutil
import tomllib
from pathlib import Path

import numpy as np
import pytest
from nameless_files import forget_names
from recordings import make_once
from support import complex_of, rows, truth_of

from docs.walkthrough import LANGUAGES, ROOT, Step, blocks, follow, same_line
from fusion.cli import main
from fusion.planning.check import check
from fusion.planning.draft.init import run_init
from fusion.recording.load import load_manifest
from fusion.simulate import simulate

TUTORIALS = sorted((ROOT / "docs" / "tutorials").glob("*.md"))
LABORATORY = ROOT / "docs" / "tutorials" / "own-laboratory.md"
PAGES = [ROOT / "README.md", *TUTORIALS]
KINDS = ("", "file", "change", "part of", "output")
MOST_TYPED, MOST_TYPED_WITHOUT_UNITS = 15, 25


@pytest.mark.parametrize("page", PAGES, ids=lambda path: path.stem)
def test_every_block_is_run_or_has_a_reason(page: Path) -> None:
    found = blocks(page)
    assert found
    for block in found:
        assert block.kind in (*KINDS, "not run"), block
        assert block.kind != "not run" or len(block.argument.split()) >= 2, "a block is not run without a reason"
        assert block.kind or block.language in LANGUAGES, block
        assert (block.kind in ("file", "change", "part of")) <= bool(block.argument), block


def go(page: Path, folder: Path) -> list[Step]:
    """Follow a page, and return its steps; nothing may fail, and the page shows what is printed."""
    for name in ("sample_images", "examples"):
        (folder / name).symlink_to(ROOT / name)
    steps = list(follow(page, folder))
    for step in steps:
        assert step.status == 0, f"{step.command}\n{step.printed}"
        assert step.differences == [], f"{step.command}\n{step.printed}"
    return steps


@pytest.mark.slow
@pytest.mark.parametrize("page", [page for page in PAGES if page != LABORATORY], ids=lambda path: path.stem)
def test_a_page_can_be_followed(page: Path, tmp_path: Path) -> None:
    assert go(page, tmp_path)


@pytest.fixture(scope="module")
def followed(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, list[Step]]:
    """The folder in which the tutorial of a laboratory was followed, and its steps."""

    def make(folder: Path) -> tuple[Path, list[Step]]:
        folder.mkdir()
        return folder, go(LABORATORY, folder)

    return make_once(tmp_path_factory, "followed-laboratory", make)


@pytest.mark.slow
def test_few_values_are_typed_and_one_check_suffices(followed: tuple[Path, list[Step]]) -> None:
    _, steps = followed
    stated = [line for block in blocks(LABORATORY) for line in block.text.splitlines() if block.kind == "change"]
    stated += ['mounting = "2"']
    typed = sum(len(step.typed) for step in steps) + sum(" = " in line for line in stated)
    assert 10 < typed <= MOST_TYPED
    checks = [step for step in steps if step.command.startswith("shakercal check")]
    assert [" wrong" in step.printed for step in checks] == [False]


@pytest.mark.slow
def test_the_results_agree_with_the_truth_within_u(followed: tuple[Path, list[Step]]) -> None:
    folder, _ = followed
    curve = [row for row in rows(folder / "lab/results/curve.csv") if row["channel"] == row["component"] == "Fz"]
    nominal = [63.0, 125.0, 250.0]
    table = shown_results(LABORATORY.read_text(encoding="utf-8"))
    for frequency, shown in zip(nominal, table, strict=True):
        (row,) = (row for row in curve if abs(float(row["frequency_hz"]) - frequency) < 0.1)
        truth = np.mean([true_ratio(folder / "files" / f"Fz_{frequency:03.0f}Hz_{mount}") for mount in "12"])
        assert abs(float(row["magnitude"]) - abs(truth)) <= float(row["U_magnitude"])
        assert abs(float(row["phase_rad"]) - np.angle(truth)) <= float(row["U_phase_rad"])
        assert float(row["U_magnitude"]) < 1e-3 * abs(truth)
        numbers = (1e7 * float(row["magnitude"]), 1e7 * float(row["U_magnitude"]), 1e7 * abs(truth))
        phases = (float(row["phase_rad"]), float(row["U_phase_rad"]), float(np.angle(truth)))
        np.testing.assert_allclose(shown, (frequency, *numbers, *phases), rtol=0.05, atol=1e-4)
        np.testing.assert_allclose(shown[1::2][:2], numbers[::2], rtol=3e-5)


def true_ratio(recording: Path) -> complex:
    """The true ratio of output Fz to load Fz at the first line."""
    return complex(complex_of(truth_of(recording)["ratio"])[0][2])


def shown_results(page: str) -> list[list[float]]:
    """The numbers of each row of the table that compares results with true values."""
    (table,) = re.findall(r"<!-- truth -->(.*?)<!-- end of truth -->", page, re.DOTALL)
    found = [re.findall(r"-?\d+\.?\d*", line.replace("−", "-")) for line in table.strip().splitlines()[2:]]
    return [[float(number) for number in numbers] for numbers in found]


@pytest.mark.slow
def test_results_of_the_folder_are_a_certificate(followed: tuple[Path, list[Step]]) -> None:
    folder, _ = followed
    page = (folder / "lab/certificate/certificate.html").read_text(encoding="utf-8")
    assert "SPECIMEN 2026-041" in page
    assert "W6-031" in page


def test_files_without_names_and_units_need_few_more_values(tmp_path: Path) -> None:
    """One round: what is typed makes a recording that `check` accepts, with the scale of the outputs in V/V."""
    simulate(tmp_path / "files", "files", 1, recordings=1, frames=8, image_scale=0.3)
    folder = tmp_path / "lab"
    shutil.copytree(tmp_path / "files" / "Fz_063Hz_1", folder / "Fz_063Hz_1")
    forget_names(folder / "Fz_063Hz_1")
    calibration = str(tmp_path / "files" / "Kalibrierung" / "stereo.yml")
    assert main(["import-calibration", calibration, "-o", str(folder / "stereo.json")]) == 0
    known = {"Kanal 1.quantity": "velocity", "quantity": "output", "channels": "Fx Fy Fz Mx My Mz"}
    known |= {"unit": "V/V", "defaults.scale": "1e-3", "mass": "2.4063 ± 0.0004 (k = 2)"}
    known |= {"sense": "on_sensor", "point": "0 0 0.069", "direction": "0 0 1", "exposure": "60e-6"}
    known |= {"scale": "0.1 ± 0.1 % (k = 2)", "rotation": "1 0 0 0 -1 0 0 0 -1", "translation": "0 0 0.4"}
    known |= {"internal_mass": "0.214", "centre_of_mass": "0 0 0.0385", "inertia": "2e-3 2e-3 2e-3"}
    known |= {"scale_uncertainty": "2e-4"}
    asked: list[str] = []

    def reply(question: str) -> str:
        key = re.findall(r"^\d+ left\. (.*?): ", question, re.MULTILINE)[-1]
        asked.append(key)
        end = max((end for end in known if key == end or key.endswith(f".{end}")), key=len)
        return known[end]

    assert run_init(folder, reply=reply).unfilled == 0, asked
    assert len(asked) <= MOST_TYPED_WITHOUT_UNITS
    assert check(load_manifest(folder / "Fz_063Hz_1")).problems == ()
    text = tomllib.loads((folder / "Fz_063Hz_1" / "recording.toml").read_text(encoding="utf-8"))
    channels = [channel for block in text["daq"] for channel in block["channel"]]
    outputs = {channel["name"]: channel["channel"] for channel in channels if channel["quantity"] == "output"}
    assert outputs == {"AI0": "Fx", "AI1": "Fy", "AI2": "Fz", "AI3": "Mx", "AI4": "My", "AI5": "Mz"}


def test_lines_are_compared_by_text_and_by_numbers_within_their_digits() -> None:
    assert same_line("U 0.0039 at  63 Hz", "U 0.0040 at 63 Hz")
    assert same_line("x = -0.00 ± 5.34", "x = 0.00 ± 5.35")
    assert not same_line("6 recordings", "7 recordings")
    assert not same_line("phase -0.013", "phase 0.013")
    assert not same_line("magnitude 6.9998", "magnitude 7.9998")
    assert not same_line("KEEP", "CHECK")
