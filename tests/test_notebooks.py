"""Notebooks of the documents: every cell runs, and the numbers that they show are those of independent truth."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import matplotlib
import matplotlib.pyplot as plt
import numpy as np
import pytest
from contracts import slow

ROOT = Path(__file__).resolve().parent.parent
NOTEBOOKS = ROOT / "docs" / "notebooks"
CELL = re.compile(r"^```\{code-cell\} python\n(.*?)^```$", re.MULTILINE | re.DOTALL)
WIDEST = 90
"""Characters of a line of code that pages show without scrolling."""


def check_first_result(found: dict[str, Any]) -> None:
    assert {(row["channel"], row["component"]) for row in found["evaluation"].element.labelled().rows()} >= {
        ("Fz", "Fz")
    }
    assert abs(found["error"]) <= found["U_relative"] < 2e-3
    (six,) = [row for row in found["evaluation"].element.labelled().rows() if row["channel"] == "Fz"]
    assert abs(six["phase_rad"] - np.angle(found["true_value"])) <= six["k_phase"] * six["u_phase_rad"]


def check_motion_from_images(found: dict[str, Any]) -> None:
    camera, body = (np.median(found["expanded"](found[name]), axis=0) for name in ("about_camera", "about_body"))
    assert body[0] < 0.05 * camera[0]
    assert body[1] < 0.05 * camera[1]
    np.testing.assert_allclose(body[3:], camera[3:])
    error, U = found["length_error_um"](found["about_body"])
    far, _ = found["length_error_um"](found["about_camera"])
    assert np.count_nonzero(np.abs(error) <= U) >= 20, "of 23, with 95 % each: fewer once in 100 cases"
    assert np.sqrt(np.mean(error**2)) < 0.3 * np.sqrt(np.mean(far**2))


def check_poles_of_a_release(found: dict[str, Any]) -> None:
    model, u = found["model"], found["u"]
    assert abs(model.frequency_hz[0] - found["true_hz"]) <= 2 * u["frequency_hz_1"] < 0.5
    assert abs(model.damping_ratio[0] - found["true_damping"]) <= 2 * u["damping_ratio_1"] < 5e-4
    assert abs(model.static_gain + 1.0) < 0.01, "the output falls from 1 V to 0 V"


def check_laboratories_compared(found: dict[str, Any]) -> None:
    for quantity, true in zip(found["magnitudes"], found["true_gain"], strict=True):
        assert quantity.names == ("A", "B", "C", "D")
        np.testing.assert_array_equal(quantity.reference.used, [True, True, True, False])
        weight = quantity.u[:3] ** -2.0
        mean, u_mean = weight @ quantity.value[:3] / weight.sum(), weight.sum() ** -0.5
        assert quantity.reference.value == pytest.approx(mean, rel=1e-6)
        assert abs(mean - true) <= 2 * u_mean
        d, u = quantity.value - mean, np.sqrt(quantity.u**2 + np.array([-1, -1, -1, 1]) * u_mean**2)
        np.testing.assert_allclose(quantity.reference.normalised, d / (2 * u), rtol=1e-3)
        assert quantity.reference.normalised[3] > 1.0


def check_own_instrument(found: dict[str, Any]) -> None:
    (_, before, _), (_, after, causes) = found["before"], found["after"]
    assert after < 0.75 * before
    assert causes["my_accelerometer: scale"] < 1e-4 < found["before"][2]["laser: scale"]
    for value, U, _ in (found["before"], found["after"]):
        assert abs(value / found["true_value"] - 1) <= U


CHECKS = {
    "first-result": check_first_result,
    "poles-of-a-release": check_poles_of_a_release,
    "motion-from-images": check_motion_from_images,
    "laboratories-compared": check_laboratories_compared,
    "own-instrument": check_own_instrument,
}


def test_every_notebook_is_checked() -> None:
    assert {path.stem for path in NOTEBOOKS.glob("*.md")} == set(CHECKS)


@pytest.mark.parametrize("name", [*list(CHECKS)[2:], *slow(*list(CHECKS)[:2])])
def test_cells_run_and_numbers_agree_with_the_truth(
    name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(NOTEBOOKS)
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path))
    matplotlib.use("Agg")
    text, found = (NOTEBOOKS / f"{name}.md").read_text(encoding="utf-8"), dict[str, Any]()
    cells = CELL.findall(text)
    assert len(cells) == text.count("{code-cell}") > 2
    assert max(len(line) for cell in cells for line in cell.splitlines()) <= WIDEST
    assert f"{{nb-download}}`{name}.ipynb`" in text
    try:
        for cell in cells:
            exec(compile(cell, f"{name}.md", "exec"), found)
        (number,) = plt.get_fignums()
        assert all(axes.get_title() or axes.get_ylabel() for axes in plt.figure(number).axes)
    finally:
        plt.close("all")
    assert len(capsys.readouterr().out.splitlines()) >= 3
    CHECKS[name](found)
