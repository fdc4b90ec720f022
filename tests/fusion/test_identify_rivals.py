"""`identify` and `transfer` under other dampings, filters and springs: chosen model, notices, values without U."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import h5py
import numpy as np
import pytest
from identify_factory import QUICK, SMALL, STIFFNESS
from numpy.typing import NDArray
from support import rows

from fusion.cli import main
from fusion.recording.load import load_manifest
from fusion.recording.toml import to_toml
from fusion.sensor import response_notices as raised
from fusion.sensor.identify.identification_evaluation import IdentifiedComponent, evaluate_identification
from fusion.sensor.identify.identification_inputs import IdentifySettings, read_campaign
from fusion.sensor.identify.identification_report import read_sensor_models
from fusion.sensor.transfer.transfer_evaluation import evaluate_transfer
from fusion.sensor.transfer.transfer_records import ReferenceResult, TransferSettings, uncertainty
from fusion.simulate.chirp import (
    chirp_channels,
    chirp_samples,
    chirp_tables,
    rig_file,
    suspension_rig,
    write_chirp_files,
)
from fusion.simulate.world import Draws, true_part
from shaker.identification.sensor import Load, correct_phasors
from shaker.sine.phasor import Phasors

Ratio = Callable[[NDArray[np.float64], float], NDArray[np.complex128]]
ETA = 0.016
TOP = (0.0, 0.0, 0.1)


def _write(folder: Path, ratio: Ratio, seed: int = 2) -> Path:
    """A chirp of each load; `ratio` of frequencies and of the moving mass."""
    draws = Draws(seed, True)
    internal = true_part(SMALL.internal, draws).mass_kg
    folder.mkdir()
    for name, stated in SMALL.loads.items():
        mass = true_part(stated, draws).mass_kg + internal
        (folder / rig_file(name)).write_text(to_toml(suspension_rig(SMALL, stated, draws)), encoding="utf-8")
        samples = chirp_samples(QUICK, draws, {"top": lambda f, mass=mass: ratio(f, mass)}, f"{name}.")
        channels = chirp_channels(QUICK, SMALL.base, {"top": TOP}, SMALL.direction)
        tables = chirp_tables(QUICK, f"chirp {name}", f"../{rig_file(name)}", channels)
        write_chirp_files(folder / f"chirp-{name}", QUICK, samples, tables, {})
    return folder


def _spring(frequency_hz: NDArray[np.float64], mass: float, b: float = 900.0) -> NDArray[np.complex128]:
    s = 2j * np.pi * frequency_hz
    return np.asarray((STIFFNESS + b * s) / (STIFFNESS + b * s + mass * s * s))


def _lossy(frequency_hz: NDArray[np.float64], mass: float) -> NDArray[np.complex128]:
    k, s = STIFFNESS * (1.0 + 1j * ETA), 2j * np.pi * frequency_hz
    return np.asarray(k / (k + mass * s * s))


def _odd(frequency_hz: NDArray[np.float64], mass: float) -> NDArray[np.complex128]:
    """A curve that no spring, mount or filter has."""
    return np.asarray(_spring(frequency_hz, mass) * (1.0 + 0.2 * np.sin(frequency_hz / 30.0)))


def _lagging(frequency_hz: NDArray[np.float64], mass: float) -> NDArray[np.complex128]:
    return np.asarray(_spring(frequency_hz, mass) / (1.0 + 2j * np.pi * frequency_hz * 8e-6))


def _identified(folder: Path) -> tuple[IdentifiedComponent, dict[str, dict[str, object]]]:
    found = evaluate_identification(read_campaign(folder), IdentifySettings())
    return found.components[0], {notice.code: dict(notice.values) for notice in found.notices}


def _resonance(folder: Path) -> tuple[ReferenceResult, set[str]]:
    found = evaluate_transfer(load_manifest(folder / "chirp-4kg"), TransferSettings(), {})
    return found.references[0], {notice.code for notice in found.notices}


def test_a_loss_factor_is_the_law_of_both_commands(tmp_path):
    folder = _write(tmp_path / "campaign", _lossy)
    component, notices = _identified(folder)
    found = component.fit.reported
    assert component.fit.choice.best.model.loss_factor
    assert abs(found.value("loss_factor_z") - ETA) < 3.0 * found.u("loss_factor_z")
    assert abs(found.value("stiffness_z") - STIFFNESS) < 3.0 * found.u("stiffness_z")
    assert raised.LOSS_FACTOR_FOUND.code in notices
    # Output over force stays within 5 % of its value at low frequencies up to |1 + jη| / |1 + jη - r²| = 1.05.
    band, mass = component.bands[0], component.loads[0] + found.value("internal_mass")
    r2 = (2.0 * np.pi * band.upper_hz) ** 2 * mass / found.value("stiffness_z")
    assert abs(1.0 + 1j * ETA) / abs(1.0 + 1j * ETA - r2) == pytest.approx(1.05, abs=2e-5)
    result, codes = _resonance(folder)
    (resonance,) = result.resonances
    true = np.sqrt(STIFFNESS / (true_part(SMALL.loads["4kg"], Draws(2, True)).mass_kg + 0.769)) / (2.0 * np.pi)
    assert resonance.fit.law == "loss factor"
    assert resonance.fit.frequency_hz == pytest.approx(true, rel=5e-4)
    assert resonance.fit.damping_ratio == pytest.approx(0.5 * ETA, rel=2e-3)
    assert raised.RESONANCE_LOSS_FACTOR.code in codes


def test_a_lag_that_is_not_stated_is_named_by_both_commands(tmp_path):
    folder = _write(tmp_path / "campaign", _lagging)
    component, notices = _identified(folder)
    found = component.fit.reported
    for name, true in (("stiffness_z", STIFFNESS), ("damping_z", 900.0)):
        assert abs(found.value(name) - true) < 3.0 * found.u(name)
    assert abs(notices[raised.UNSTATED_FILTER_FOUND.code]["lag_us"]) == pytest.approx(8.0, rel=0.1)
    assert component.fit.choice.undecided  # of one response over one reference, either may be late
    result, codes = _resonance(folder)
    assert raised.UNSTATED_FILTER_FOUND.code in codes
    hertz = result.transfer.ratio.frequency_hz
    mass_kg = true_part(SMALL.loads["4kg"], Draws(2, True)).mass_kg + 0.769
    late = np.angle(result.transfer.ratio.value[:, 0] / _spring(hertz, mass_kg))
    U = 1.96 * uncertainty(result.transfer.ratio.value[:, 0], result.transfer.ratio.covariance)[1]
    seen = np.abs(hertz - result.resonances[0].fit.frequency_hz) > 30.0  # a resonance that is not quite the same
    assert np.mean(np.abs(late[seen]) < U[seen]) > 0.95
    assert np.median(U / (2.0 * np.pi * hertz * 8e-6)) < 1.5


def test_a_plain_spring_has_none_of_these_notices(tmp_path):
    folder = _write(tmp_path / "campaign", _spring)
    component, notices = _identified(folder)
    assert str(component.fit.choice.best.model) == "translation"
    assert len(component.fit.choice.tried) == 2
    named = {f"SC-{number}" for number in range(890, 900)}
    assert named & notices.keys() == {raised.MOUNT_TREATED_AS_RIGID.code}
    result, codes = _resonance(folder)
    assert named & codes <= {raised.LAW_UNDECIDED.code}  # the band begins at half the resonance
    assert result.resonances[0].amplitude is None


def test_a_refuted_model_has_values_without_u(tmp_path, capsys):
    folder, out = _write(tmp_path / "campaign", _odd), tmp_path / "out"
    assert main(["identify", str(folder), "-o", str(out)]) == 0
    printed = capsys.readouterr()
    assert raised.MODEL_REJECTED.code in printed.err
    assert "refuted by the data" in printed.out
    assert " ± " not in printed.out
    parameters = rows(out / "parameters.csv")
    assert {row["u"] for row in parameters} == {row["U"] for row in parameters} == {""}
    assert all(row["value"] for row in parameters)
    (component,) = json.loads((out / "model.json").read_text(encoding="utf-8"))["components"]
    assert component["covariance"] is None
    assert {parameter["u"] for parameter in component["parameters"]} == {None}
    sensor = read_sensor_models(out)["Fz"].sensor
    frequency = np.array([200.0])
    reading = Phasors(frequency, np.ones((1, 1), complex), np.zeros((1, 2, 2)), ("Fz",), ("V/V",), np.full(1, np.inf))
    assert np.all(np.isnan(correct_phasors(reading, sensor, Load(4.0, "force")).covariance))
    with h5py.File(out / "identify.h5") as file:
        assert np.all(np.isnan(file["z/identification/covariance"][()]))
        assert len(file["z/rivals"]) > 2
    assert "The data refute it" in (out / "identify.html").read_text(encoding="utf-8")


def test_a_refuted_resonance_has_no_u(tmp_path, capsys):
    def doubled(frequency_hz: NDArray[np.float64], mass: float) -> NDArray[np.complex128]:
        return np.asarray(0.5 * (_spring(frequency_hz, mass) + _spring(frequency_hz, 1.01 * mass)))

    folder = _write(tmp_path / "campaign", doubled)
    assert main(["transfer", str(folder / "chirp-4kg"), "-o", str(tmp_path / "out")]) == 0
    printed = capsys.readouterr()
    assert raised.PEAK_DEPARTS.code in printed.err
    (line,) = [text for text in printed.out.splitlines() if "resonance of" in text]
    assert "±" not in line
    assert line.endswith("(model refuted by the data)")


def test_damping_choices_restrict_the_rivals(tmp_path):
    folder = _write(tmp_path / "campaign", lambda f, mass: _spring(f, mass, 900.0 if mass < 6.0 else 1800.0))
    component, notices = _identified(folder)
    assert component.fit.choice.best.model.each
    values = notices[raised.DAMPING_DIFFERS.code]
    assert (values["lowest"], values["highest"]) == pytest.approx((900.0, 1800.0), rel=0.01)
    common = evaluate_identification(read_campaign(folder), IdentifySettings(model="translation", damping="common"))
    assert common.components[0].fit.is_rejected
    assert all(not one.model.each for one in common.components[0].fit.choice.tried)
    bare = replace(component.model, covariance=np.full_like(component.model.covariance, np.nan))
    assert np.all(np.isnan(bare.covariance_root(Load(4.0, "force"))))
