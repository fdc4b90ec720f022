"""Driven lines without a result; what a campaign says of its recordings, its mountings and the static value."""

from __future__ import annotations

import json
import re
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from support import block, channel, recording_head, rows, write_daq

from fusion.cli import main
from fusion.sensitivity.analyse import Analysis, Inputs
from fusion.sensitivity.recording_evaluation import missing_result
from fusion.sensitivity.sensitivity_notices import NO_RESULT_AT_LINES, REPEATABILITY_NOT_ASSESSED

MASS_KG, SENSITIVITY, ACCELERATION, LINE_HZ = 2.0, 2e-6 * np.exp(-0.05j), 50.0 * np.exp(0.4j), 106.25
ALONG = {"body": "load", "point": [0.0] * 3, "direction": [0.0, 0.0, 1.0], "scale": 1.0, "scale_uncertainty": 1e-3}
SENSOR = {"name": "s", "channels": ["Fx", "Fz"], "unit": "V/V", "sense": "on_load", "internal_mass": 0.0}
STATIC = {"capacity": [100.0] * 3 + [5.0] * 3, "static_sensitivity": [[2e-6, *[0.0] * 5], [0.0, 0.0, 2e-6, *[0.0] * 3]]}
LOAD = {"mass": MASS_KG, "mass_uncertainty": 1e-4, "centre_of_mass": [0.0] * 3, "inertia": np.diag([1e-3] * 3).tolist()}
OUTPUT, OTHER_OUTPUT = (channel("Fz", "output", channel=name, scale=1.0) for name in ("Fz", "Fx"))


def write_rig(folder: Path, sensor: dict[str, Any] | None = None, load: dict[str, Any] | None = None) -> None:
    text = block(format=1, name="bench") + block("sensor", **SENSOR, **(sensor or {}))
    text += block("load", **(LOAD if load is None else load)) if load != {} else ""
    text += block("shaker", transverse_motion=1e-3, rocking_motion=1e-3 if load is None else 0.5)
    (folder / "rig.toml").write_text(text, encoding="utf-8")


def write_recording(
    folder: Path, name: str, seed: int = 0, output: str = OUTPUT, mounting: str = "1", **keys: Any
) -> Path:
    """One accelerometer along z on the load and one output below it, all driven along z whatever the manifest says."""
    rng, time_s = np.random.default_rng(seed), np.arange(10_000) / 1e4
    turn = np.exp(2j * np.pi * LINE_HZ * time_s)
    signals = {"acc": (ACCELERATION * turn).real, "Fz": (SENSITIVITY * MASS_KG * ACCELERATION * turn).real}
    (folder / name).mkdir(parents=True)
    noisy = {key: own + 1e-5 * np.abs(own).max() * rng.standard_normal(len(own)) for key, own in signals.items()}
    write_daq(folder / name / "daq.h5", 1e4, noisy)
    head = recording_head(name, LINE_HZ, **keys).replace("[excitation]", f'mounting = "{mounting}"\n[excitation]')
    text = head + channel("acc", "acceleration", **ALONG) + output
    (folder / name / "recording.toml").write_text(text, encoding="utf-8")
    return folder / name


UNREPEATED_EXCITATIONS, ONE_MOUNTING, TWO_REPEATS = "SC-522", "SC-520", "SC-521"
"""Codes of notices of a campaign on its repeats."""
X, ECCENTRIC = {"direction": [1.0, 0.0, 0.0]}, {**LOAD, "centre_of_mass": [0.1, 0.0, 0.05]}


@pytest.mark.parametrize(
    ("keys", "output", "load", "expected_text"),
    [
        (X, OUTPUT, None, r"(?i)no sensitivity .*Fx at 106\.25 Hz \(1 of 1 .*acc .*only z .*\[1, 0, 0\]"),
        (X, "", None, r"(?i)no acceleration .*x at 106\.25 Hz .*acc .*only z .*\[1, 0, 0\]"),
        ({}, OUTPUT, {}, r"(?i)no sensitivity .*Fz at 106\.25 Hz .*\[load\]"),
        ({}, OUTPUT, ECCENTRIC, r"(?i)no sensitivity .*Fz .*x, y, rx, ry, rz"),
        ({}, OTHER_OUTPUT, None, r"(?i)no sensitivity .*output Fz "),
        ({}, OUTPUT, None, ""),
        ({}, "", None, ""),
    ],
)
def test_a_driven_line_without_a_result_is_status_1_and_the_first_line(
    tmp_path, capsys, keys, output, load, expected_text
):
    write_rig(tmp_path, load=load)
    recording = write_recording(tmp_path, "one", output=output, **keys)
    assert main(["run", str(recording)]) == (1 if expected_text else 0)
    reported = capsys.readouterr()
    assert re.match(expected_text, reported.out) if expected_text else not re.match(r"(?i)no .* Hz \(", reported.out)
    assert (NO_RESULT_AT_LINES.code in reported.err) is bool(expected_text)
    assert (recording / "results" / "acceleration.csv").is_file()
    page = (recording / "results" / "report.html").read_text(encoding="utf-8")
    assert ("<b>No " in page) is bool(expected_text)
    # The second run finds the results of the first.
    assert main(["run", str(recording), "--json", "-q"]) == (1 if expected_text else 0)
    (entry,) = json.loads(capsys.readouterr().out)["recordings"]
    assert re.match(expected_text, entry["missing"]) if expected_text else entry["missing"] is None


def test_a_campaign_names_the_recording_without_a_result_and_gives_the_others(tmp_path, capsys):
    write_rig(tmp_path)
    write_recording(tmp_path, "turned", **X)
    write_recording(tmp_path, "sound")
    assert main(["run", str(tmp_path), "-o", str(tmp_path / "results")]) == 1
    reported = capsys.readouterr()
    assert re.match(r"turned: .*Fx at 106[.]25 Hz", reported.out)
    assert "(turned)" in reported.err
    assert [row["component"] for row in rows(tmp_path / "results" / "curve.csv")] == ["Fz"]
    page = (tmp_path / "results" / "report.html").read_text(encoding="utf-8")
    assert re.search(r'Fx at 106.* \(<a href="turned/report.html">turned</a>\)', page)


@pytest.mark.parametrize(
    ("mountings", "codes"),
    [
        ("1", {REPEATABILITY_NOT_ASSESSED.code}),
        ("11", {ONE_MOUNTING, TWO_REPEATS}),
        ("12", {TWO_REPEATS}),
        ("123", set()),
    ],
)
def test_notices_on_recordings_and_mountings(tmp_path, capsys, mountings, codes):
    write_rig(tmp_path)
    for number, mounting in enumerate(mountings):
        write_recording(tmp_path, f"run-{number}", number, mounting=mounting)
    assert main(["run", str(tmp_path), "-o", str(tmp_path / "results"), "-v"]) == 0
    reported = capsys.readouterr().err
    page = (tmp_path / "results" / "report.html").read_text(encoding="utf-8")
    every = {UNREPEATED_EXCITATIONS, ONE_MOUNTING, TWO_REPEATS, REPEATABILITY_NOT_ASSESSED.code}
    assert {code for code in every if code in page} == codes
    # The terminal leaves out what is not assessed.
    assert {code for code in every if code in reported} == codes & {TWO_REPEATS}
    several = re.search(rf"campaign \S+, {len(mountings)} recordings", page) is not None
    assert several is (len(mountings) > 1), "a folder of one recording has the page of that recording"


@pytest.mark.parametrize("stated", [{}, {"static_sensitivity_uncertainty": 3e-3}])
def test_the_deviation_from_the_static_value_has_one_u(tmp_path, stated):
    write_rig(tmp_path, {**STATIC, "cross_talk_uncertainty": 1e-3, **stated})
    write_recording(tmp_path, "one")
    assert main(["run", str(tmp_path), "-o", str(tmp_path / "results"), "-q"]) == 0
    top = tmp_path / "results"
    found = [
        re.findall(r"static value, difference ([^<]+)<", (folder / "report.html").read_text())
        for folder in (top, top / "one")
    ]
    u = np.hypot(1e-3, stated.get("static_sensitivity_uncertainty", 1e-3))  # of the accelerometer, of the static value
    assert found[0] == found[1] == [f"(0.00 ± {196 * u:.2f}) %"]
    row = next(row for row in rows(top / "curve.csv") if row["kind"] == "element")
    assert float(row["u_relative"]) == pytest.approx(u, rel=0.01)


@pytest.mark.parametrize(
    ("lacking", "count"), [([False, True], "1 of 2"), ([True, True], "2 of 2"), ([False, False], "")]
)
def test_some_of_several_lines_without_a_result_are_named(lacking, count):
    """Two driven lines and a harmonic, whose value counts for neither of them."""
    known = ~np.array([*lacking, False])
    seen = np.zeros((3, 6), bool)
    seen[:, 2] = known
    lines = SimpleNamespace(multiple=np.array([1, 1, 2]), nominal_hz=np.array([80.0, 160.0, 80.0]))
    moved = SimpleNamespace(source="fused", body="load", observed=seen, disputed=None, instruments=("laser",))
    value = np.where(known[:, None, None], 1.0 + 0j, np.nan) * np.ones((1, 1, 6))
    found = SimpleNamespace(value=value, channels=("Fz",))
    sensor = SimpleNamespace(channels=("Fz",), capacity=None, static_sensitivity=None)
    inputs = Inputs(lines, (), SimpleNamespace(), SimpleNamespace(), sensor, (0.0, 0.0, 1.0))
    analysis = Analysis((moved,), SimpleNamespace(observed=seen), inputs.outputs, found)
    notices = list(missing_result(inputs, analysis))
    assert len(notices) == bool(count)
    for notice in notices:
        assert (notice.code, f"{notice.values['lost']} of {notice.values['driven']}") == (
            NO_RESULT_AT_LINES.code,
            count,
        )
        assert notice.values["frequencies"].endswith("160")
