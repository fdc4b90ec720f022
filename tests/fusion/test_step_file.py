"""Poles of a release in one file, without a manifest: against a sensor that scipy integrated, and wrong files."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from contracts import refused as raises
from release_factory import Truth

from fusion.cli import main
from fusion.sensor import model_notices as raised
from shaker import fit_step, read_step_record

TRUTH = Truth(release_s=2e-4, rate_hz=50e3, length_s=0.03)
CHAIN_HZ = 6000.0


def write(path: Path, **channels: np.ndarray) -> Path:
    time = np.arange(len(next(iter(channels.values())))) / TRUTH.rate_hz
    table = np.column_stack([time, *channels.values()])
    head = f"time,{','.join(channels)}\ns{',V' * len(channels)}"
    np.savetxt(path, table, fmt="%.9f", delimiter=",", header=head, comments="")
    return path


@pytest.fixture
def release(tmp_path: Path) -> Path:
    rng = np.random.default_rng(4)
    (driven,) = TRUTH.record(rng, 40.0).samples
    return write(tmp_path / "line 1.csv", Fz=driven, Mx=0.01 * rng.standard_normal(len(driven)))


def test_the_command_prints_poles_that_contain_the_truth_and_writes_nothing(release, capsys):
    assert main(["step", str(release), "--json"]) == 0
    shown = json.loads(capsys.readouterr().out)
    mode, *rest = shown["poles"]
    assert {pole["channel"] for pole in shown["poles"]} == {"Fz"}
    assert abs(mode["frequency_hz"] - 1700.0) <= mode["U_frequency_hz"] < 2.0
    assert abs(mode["damping_ratio"] - 0.015) <= mode["U_damping_ratio"] < 2e-3
    for pole in rest:
        assert pole["damping_ratio"] == 1.0
        assert abs(pole["frequency_hz"] - CHAIN_HZ) <= pole["U_frequency_hz"] < pole["frequency_hz"]
    assert shown["files"] == []
    assert main(["step", str(release)]) == 0
    name, first, *_ = capsys.readouterr().out.splitlines()
    assert name == "line 1.csv"
    assert first.startswith("Fz: f_n (1700.")
    assert [path.name for path in release.parent.iterdir()] == [release.name]


def test_a_file_is_the_record_of_one_channel(release):
    record = read_step_record(release, "Fz", amplitude=-20.0)
    assert (record.name, record.channels, record.unit, record.amplitude) == ("line 1", ("Fz",), "V", -20.0)
    assert record.sample_rate_hz == pytest.approx(TRUTH.rate_hz)
    whole = fit_step(record, "Fz").model
    assert whole.static_gain == pytest.approx(TRUTH.gain, rel=0.02)
    relative = fit_step(read_step_record(release, "Fz"), "Fz").model
    np.testing.assert_allclose(relative.poles, whole.poles, rtol=1e-6)
    raises("channel: expected one of Fz, Mx, found none", read_step_record, release)


def test_files_without_a_release_and_damaged_ones_are_refused(tmp_path, refused):
    noise = np.random.default_rng(5).standard_normal(1500)
    assert f"{raised.NO_STEP_MODEL.code} " in refused("step", write(tmp_path / "noise.csv", Fz=noise), status=1)
    noise[7] = np.nan
    lost = write(tmp_path / "lost.csv", Fz=noise)
    assert "lost.csv" in refused("step", lost)
    raises("number in every sample, found 1", read_step_record, lost)
    uneven = tmp_path / "uneven.csv"
    uneven.write_text("time,Fz\ns,V\n0.0000,1.0\n0.1000,1.0\n0.4000,0.0\n0.5000,0.0\n")
    raises("evenly spaced", read_step_record, uneven)
    assert f"{raised.POLES_BY_ONE_METHOD.code} " in refused("step", lost, "--method", "all")
