"""From simulated records to the sensor as a mechanical system, by the commands that a laboratory types."""

from __future__ import annotations

import csv
import json
import shutil
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from fusion.cli import main
from fusion.recording.load import find_recordings, for_kinds
from fusion.sensitivity.evaluate import EVALUATED_KINDS
from fusion.sensor.identify.evaluate import evaluate_campaign
from fusion.sensor.identify.measured import IdentifySettings, read_campaign
from fusion.sensor.transfer.evaluate import KINDS
from fusion.simulate import chirp as masses
from fusion.simulate import chirp as pitching
from fusion.simulate import simulate_loads
from fusion.simulate.chirp import Chirp
from fusion.simulate.sines import STEP_HZ

QUICK = Chirp(sample_rate_hz=12800.0, period_s=0.64, periods=4, band_hz=(900.0, 2200.0))
STEPS = (1, 5, 11, 15, 19)


def _truth(folder: Path) -> dict[str, float]:
    found: dict[str, Any] = json.loads((folder / "truth.json").read_text(encoding="utf-8"))
    named = {f"stiffness_{axis}": value for axis, value in found["stiffness"].items()}
    named |= {f"damping_{axis}": value for axis, value in found["damping"].items()}
    return named | {"internal_mass": found["internal_mass_kg"]}


def _table(path: Path) -> list[dict[str, str]]:
    with path.open(encoding="utf-8", newline="") as file:
        return list(csv.DictReader(file))


@pytest.fixture(scope="module")
def axial(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two loads on the axial spring, two short chirps and five sines."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(masses, "STAND", replace(masses.STAND, chirp=QUICK))
        patch.setattr(masses, "STEPS", STEPS)
        return simulate_loads(tmp_path_factory.mktemp("axial") / "try", "masses", 7)


def test_two_chirps_give_stiffness_damping_and_internal_mass(axial, tmp_path, capsys):
    out = tmp_path / "out"
    assert main(["identify", str(axial), "-o", str(out)]) == 0
    assert "internal mass m_i" in capsys.readouterr().out
    rows = {row["name"]: row for row in _table(out / "parameters.csv")}
    bars = {"stiffness_z": 5e-4, "damping_z": 0.02, "internal_mass": 3e-3}
    for name, true in _truth(axial).items():
        value, u = float(rows[name]["value"]), float(rows[name]["u"])
        assert abs(value - true) < 3.3 * u
        assert u < 0.5 * bars[name] * true
        assert abs(value - true) < bars[name] * true
    readings = {row["method"]: row for row in _table(out / "readings.csv") if "4.236" in row["recording"]}
    assert float(readings["half_power"]["damping"]) == pytest.approx(900.0, rel=0.02)
    assert float(readings["half_amplitude"]["damping"]) == pytest.approx(900.0 * 3**0.5, rel=0.02)
    assert (out / "identify.html").stat().st_size > 10_000


def test_pitching_leaves_the_translational_stiffness(tmp_path, monkeypatch):
    monkeypatch.setattr(pitching, "STAND", replace(pitching.PITCHING_STAND, chirp=QUICK))
    folder = simulate_loads(tmp_path / "try", "pitching", 8)
    (component,) = evaluate_campaign(read_campaign(folder), IdentifySettings()).components
    assert component.fit.model == "pitching"
    for name, true in _truth(folder).items():
        found = component.fit.identification[name]
        assert abs(found.value - true) < 3.3 * found.u
    stiffness = component.fit.identification["stiffness_x"].value
    assert stiffness == pytest.approx(_truth(folder)["stiffness_x"], rel=2e-3)
    overlapping = [r.stiffness for r in component.readings if r.method == "maximum" and "6.962" in r.recording]
    assert max(abs(value / stiffness - 1.0) for value in overlapping) > 0.02


def test_every_command_takes_the_kinds_it_evaluates_out_of_a_mixed_campaign(axial, tmp_path):
    chirps, sines = ["chirp-4kg", "chirp-9kg"], [f"Fz-{STEP_HZ * step:06.1f}" for step in STEPS]
    found = find_recordings(axial)
    assert [path.parent.name for path in for_kinds(found, KINDS)] == chirps
    assert [path.parent.name for path in for_kinds(found, EVALUATED_KINDS)] == sines
    assert for_kinds(found, ["step"]) == found
    broken = tmp_path / "recording.toml"
    broken.write_text("format =", encoding="utf-8")
    assert broken in for_kinds([*found, broken], KINDS)


@pytest.mark.slow
def test_sines_tell_the_lag_of_the_chain_from_the_spring(axial, tmp_path):
    folder = tmp_path / "try"
    shutil.copytree(axial, folder)
    assert main(["run", str(folder), "-q"]) == 0
    assert len([path for path in (folder / "results").iterdir() if path.is_dir()]) == len(STEPS)
    (component,) = evaluate_campaign(read_campaign(folder), IdentifySettings()).components
    compared = component.sensitivity.comparison
    assert compared.best.chain.kind == "lag"
    lag = compared["lag"]
    assert abs(lag.chain.lag_s - 50e-6) < 3.3 * lag.u("lag_s") < 1e-6
    assert abs(lag.spring_time_s - 2e-6) < 3.3 * lag.u("spring_time_s") < 0.1e-6
    assert compared.damping.contradicts
    assert compared.damping.needed_s == pytest.approx(52e-6, rel=0.1)
