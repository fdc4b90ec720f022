"""A whole curve from one recording of 40 lines, against the simulated truth."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from support import rows

from fusion import simulate_preset
from fusion.cli import main
from fusion.commands.options import EXIT_DONE

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def evaluated(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    """Return a recording of 40 lines and its results."""
    folder = tmp_path_factory.mktemp("multisine")
    recording = simulate_preset(folder / "campaign", "multisine", 3)
    assert main(["run", str(recording), "-o", str(folder / "results"), "-q"]) == EXIT_DONE
    return recording, folder / "results"


def test_every_line_has_its_element_within_u(evaluated: tuple[Path, Path]) -> None:
    recording, results = evaluated
    truth = json.loads((recording / "truth.json").read_text(encoding="utf-8"))
    table = truth["sensitivity"]
    true = (np.array(table["re"]) + 1j * np.array(table["im"]))[:, 2, 2]
    elements = [
        row
        for row in rows(results / "sensitivity.csv")
        if (row["channel"], row["component"], row["kind"]) == ("Fz", "Fz", "element")
    ]
    found = np.array([complex(float(row["re"]), float(row["im"])) for row in elements])
    u = np.array([[float(row["u_re"]), float(row["u_im"])] for row in elements])
    assert [float(row["frequency_hz"]) for row in elements] == pytest.approx(truth["frequencies"], rel=1e-6)
    error = np.stack([(found - true).real, (found - true).imag], axis=1)
    assert np.abs(error / u).max() < 4.0
    assert np.mean(np.abs(error / u) < 2.0) > 0.8  # errors of all lines have common causes
    assert np.all(np.hypot(*u.T) < 3e-3 * np.abs(true))


def test_the_page_begins_with_the_curve(evaluated: tuple[Path, Path]) -> None:
    page = (evaluated[1] / "report.html").read_text(encoding="utf-8")
    result = page[page.index('<section id="result"') : page.index('<section id="sensitivity"')]
    assert "40 lines from" in result
    assert result.index('id="figure-sensitivity"') < result.index('class="hero')
    assert page.count('id="figure-sensitivity"') == 1
    assert "<details><summary>Sensitivity, and ratios of output and load, with U" in page
