"""`shakercal step` on the simulated six-component sensor, and with every method."""

from __future__ import annotations

import csv
import json
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy import optimize
from step_factory import StepFolder, Truth

from fusion.cli import main

METHODS = ["pencil", "arx", "sim", "sim_zoh", "evolution", "evolution_coefficients"]


def rows_of(path: Path) -> list[dict[str, str]]:
    """Rows of a CSV file."""
    with path.open(encoding="utf-8", newline="") as stream:
        return list(csv.DictReader(stream))


@pytest.mark.slow
def test_the_amplifier_is_in_bands_and_their_u_even_where_it_hides(tmp_path: Path) -> None:
    campaign = tmp_path / "campaign"
    assert main(["simulate", str(campaign), "--preset", "steps", "-q"]) == 0
    for folder in [path for path in campaign.iterdir() if path.is_dir() and path.name[:2] not in ("Fx", "Mx")]:
        shutil.rmtree(folder)
    assert main(["step", str(campaign), "-q"]) == 0
    truth = json.loads((campaign / "truth.json").read_text(encoding="utf-8"))
    found = {(row["component"], row["name"]): row for row in rows_of(campaign / "step" / "indices.csv")}
    for component in ("Fx", "Mx"):
        natural = truth["frequency_hz"][truth["components"].index(component)]
        pole = float(np.ravel(truth["real_hz"])[0])

        def size(hertz: float, natural: float = natural, pole: float = pole) -> float:
            share = hertz / natural
            return float(abs(1.0 / (1.0 - share**2 + 0.03j * share) / (1.0 + 1j * hertz / pole)))

        band = optimize.brentq(lambda hertz: size(hertz) - 1.05, 1.0, 0.5 * natural)
        for name, value in (("natural_hz", natural), ("damping_ratio", 0.015), ("band_5_hz", band)):
            row = found[component, name]
            assert abs(float(row["value"]) - value) < 1.6 * float(row["U"]), (component, name)
            assert float(row["U"]) < 0.25 * value


@pytest.mark.slow
def test_every_method_has_its_row_and_its_curve(tmp_path: Path) -> None:
    folder = StepFolder(tmp_path / "campaign").start().add("one", replace(Truth(), length_s=0.025))
    assert main(["step", str(folder), "--method", "all", "-q"]) == 0
    rows = {row["method"]: row for row in rows_of(folder / "step" / "methods.csv")}
    assert list(rows) == METHODS
    for method in ("pencil", "arx"):
        assert float(rows[method]["natural_hz"]) == pytest.approx(1700.0, rel=1e-3)
    page = (folder / "step" / "step.html").read_text(encoding="utf-8")
    assert "How the methods came to their models" in page
    assert "differential evolution on coefficients" in page
