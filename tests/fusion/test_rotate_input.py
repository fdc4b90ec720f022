"""Rotation tests that cannot be evaluated: one sentence each, with file and key, and exit status 2."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

from fusion.cli import main
from fusion.simulate import simulate_rotation
from fusion.simulate.statics import BARE, LOADED

RIG, RECORDING, TABLE = "rig.toml", f"{BARE}/recording.toml", f"{BARE}/readings.csv"
CASES = [
    (RIG, "latitude = 52.296\n", "", "environment.gravity", "local gravity, or latitude and height"),
    (RIG, "height = 79.0\n", "", "environment.height", "the height above the sea"),
    (RIG, "latitude = 52.296", "latitude = 152.0", "environment.latitude", "at most 90"),
    (RIG, "height = 79.0", "height = 79.0\nhumidity = 45.0", "environment.humidity", "at most 1"),
    (RIG, "height = 79.0", "height = 79.0\npressure = 1013.25", "environment.pressure", "at least 30000"),
    (RECORDING, 'angle_unit = "deg"', 'angle_unit = "rad"', "excitation.angle_unit", "the unit of the column angle"),
    (RECORDING, "axis = [0.0, 0.0, 1.0]", "axis = [0.0, 0.0, -1.0]", "excitation.axis", "reverse the axis"),
    (RECORDING, "axis = [0.0, 0.0, 1.0]", "axis = [0.0, 1.0, 0.0]", "excitation.axis", "one across gravity"),
    (RECORDING, "with_load = false\n", "", "excitation.with_load", "required for kind"),
    (RECORDING, "with_load = false", "with_load = false\nscale = 0", "excitation.scale", "a number other than 0"),
    (RECORDING, 'file = "readings.csv"', 'file = "no.csv"', "excitation.file", "an existing file"),
    (TABLE, "angle [deg]", "theta", "angle", "a column of this name"),
    (TABLE, "Fx [mV/V]", "Fx [kN]", "Fx", 'expected "V/V"'),
    (TABLE, "Fx [mV/V]", "Fx [N]", "Fy", "N or N.m as of Fx"),
    (
        TABLE,
        "Fx [mV/V],Fy [mV/V],Fz [mV/V],Mx [mV/V],My [mV/V],Mz [mV/V]",
        "a,b,c,d,e,f",
        None,
        "columns of the sensor",
    ),
    (TABLE, "\n22.5,", "\n22.5,nan,0,0,0,0,0\n22.5,", "Fx", "a number in every row"),
    (TABLE, "\n22.5,", "\ntwenty,", None, "expected numbers"),
]


@pytest.fixture(scope="module")
def campaign(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A simulated rotation test, mended after every case."""
    folder = tmp_path_factory.mktemp("input") / "campaign"
    simulate_rotation(folder, 2)
    return folder


@pytest.mark.parametrize(("file", "old", "new", "key", "expected"), CASES)
def test_a_mistake_is_one_sentence(
    campaign: Path,
    file: str,
    old: str,
    new: str,
    key: str | None,
    expected: str,
    capsys: pytest.CaptureFixture[str],
) -> None:
    path = campaign / file
    text = path.read_text(encoding="utf-8")
    assert old in text
    path.write_text(text.replace(old, new), encoding="utf-8")
    try:
        status = main(["rotate", "-q", str(campaign)])
    finally:
        path.write_text(text, encoding="utf-8")
    told = capsys.readouterr().err
    assert status == 2
    assert len(told.strip().splitlines()) == 1
    assert Path(file).name in told
    assert expected in told
    assert key is None or re.search(rf"{re.escape(key)}: ", told)
    assert not (campaign / "rotate").exists()


def test_other_recordings_are_refused(campaign: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    simulate_rotation(tmp_path / "other", 2)
    assert main(["rotate", str(campaign / BARE), str(tmp_path / "other" / LOADED)]) == 2
    assert "the rig of without-load" in capsys.readouterr().err
    (tmp_path / "rig.toml").write_text('format = 1\nname = "no sensor"\n')
    text = (campaign / RECORDING).read_text().replace("../rig.toml", "rig.toml")
    (tmp_path / "recording.toml").write_text(text)
    (tmp_path / "readings.csv").write_bytes((campaign / TABLE).read_bytes())
    assert main(["rotate", str(tmp_path / "recording.toml")]) == 2
    assert "environment.gravity" in capsys.readouterr().err
    (tmp_path / "rig.toml").write_text('format = 1\nname = "no sensor"\n[environment]\ngravity = [0, 0, -9.81]\n')
    assert main(["rotate", str(tmp_path / "recording.toml")]) == 2
    assert "rig.toml: sensor: expected the [sensor]" in capsys.readouterr().err


def test_outputs_without_a_matrix_are_refused(campaign: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = campaign / RIG
    text = path.read_text(encoding="utf-8")
    lines = [line for line in text.splitlines() if not line.startswith("static_sensitivity ")]
    path.write_text("\n".join(lines), encoding="utf-8")
    try:
        assert main(["rotate", str(campaign)]) == 2
    finally:
        path.write_text(text, encoding="utf-8")
    assert (
        "sensor.static_sensitivity: expected the sensitivities that turn outputs into loads" in capsys.readouterr().err
    )


def test_recordings_with_other_channels_are_refused(campaign: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = campaign / TABLE
    text = path.read_text(encoding="utf-8")
    path.write_text(text.replace("Mz [mV/V]", "remark"), encoding="utf-8")
    try:
        assert main(["rotate", str(campaign)]) == 2
    finally:
        path.write_text(text, encoding="utf-8")
    assert "the channels of without-load" in capsys.readouterr().err


def test_a_channel_that_stands_still_or_is_missing_is_left_out(
    campaign: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr("fusion.sensor.rotate.run.render_rotation_page", lambda _: "")
    before = {name: (campaign / name / "readings.csv").read_text() for name in (BARE, LOADED)}
    try:
        for name, text in before.items():
            lines = text.replace("Fz [mV/V]", "remark").splitlines()
            rows = [re.sub(r",[^,]*$", ",0", row) if i else row for i, row in enumerate(lines)]
            (campaign / name / "readings.csv").write_text("\n".join(rows))
        assert main(["rotate", str(campaign), "-o", str(campaign / "still")]) == 0
    finally:
        for name, text in before.items():
            (campaign / name / "readings.csv").write_text(text)
    told = capsys.readouterr().err
    assert "Mz: every reading is the same, left out" in told
    assert "without-load: readings.csv has no column of Fz" in told


def test_the_same_seed_gives_the_same_test(tmp_path: Path) -> None:
    for name in ("one", "two"):
        assert main(["simulate", str(tmp_path / name), "--preset", "rotation", "--seed", "5"]) == 0
    for path in (tmp_path / "one").rglob("*.*"):
        assert path.read_bytes() == (tmp_path / "two" / path.relative_to(tmp_path / "one")).read_bytes()
    assert main(["simulate", str(tmp_path / "one"), "--preset", "rotation", "--force"]) == 0
