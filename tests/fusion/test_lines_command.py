"""`shakercal lines` and the lines of a run, against records whose lines are known."""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest
from support import AT_ORIGIN, RefusedCommand, block, channel, recording_head, rows, write_daq

from fusion.cli import main
from fusion.errors import InputError
from fusion.phasors.channel_phasors import channel_phasors, find_channel_lines
from fusion.phasors.clocks import refine_ties
from fusion.phasors.timing import TimeBase, tie_daqs
from fusion.recording.daq_records import read_daqs
from fusion.recording.load import Manifest, load_manifest
from fusion.report.recording_report import write_h5
from fusion.report.tables import lines_table
from fusion.sensitivity.analyse import Evaluation
from shaker.lines.frequencies import find_lines

RATE = 12_800.0


def _signals(path: Path, tones: dict[float, float]) -> Path:
    """Two seconds of tones by frequency and amplitude, in noise of a hundredth."""
    rng = np.random.default_rng(0)
    time = np.arange(25_600) / RATE
    values = 0.01 * rng.normal(size=len(time))
    for frequency, amplitude in tones.items():
        values += amplitude * np.cos(2 * np.pi * frequency * time + rng.uniform(0.0, 2 * np.pi))
    with h5py.File(path, "w") as file:
        file["a"] = values
        file["a"].attrs["sample_rate"] = RATE
        file["a"].attrs["unit"] = "m/s^2"
    return path


def _recording(folder: Path, tones: dict[float, float], **driven: Any) -> Path:
    """A multisine with the keys of its excitation, and the tones that are recorded."""
    run = folder / "run"
    run.mkdir()
    (folder / "rig.toml").write_text(block(format=1, name="test"))
    _signals(run / "signals.h5", tones)
    text = block(format=1, name="three lines", rig="../rig.toml")
    text += block("excitation", kind="multisine", direction=[0.0, 0.0, 1.0], **driven)
    text += block("[daq]", name="vibrometer", file="signals.h5")
    (run / "recording.toml").write_text(text + channel("a", "acceleration", body="load", **AT_ORIGIN))
    return run


def test_a_file_is_listed_with_reasons(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    file = _signals(tmp_path / "signals.h5", {106.25: 1.0, 318.75: 0.02, 50.02: 0.05})
    table, picture = tmp_path / "lines.csv", tmp_path / "lines.png"
    assert main(["lines", str(file), "--csv", str(table), "--figure", str(picture)]) == 0
    told = capsys.readouterr().out
    assert re.search("signals.h5: a; 25600 .* 12800 Hz, 2 s", told)
    for text in ("fundamental", "harmonic 3 of 106.25 Hz, 0.02 of it", "mains hum (50 Hz)"):
        assert text in told
    listed = rows(table)
    assert [float(row["frequency_hz"]) for row in listed] == pytest.approx([50.02, 106.25, 318.75], abs=5e-3)
    assert [float(row["amplitude"]) for row in listed] == pytest.approx([0.05, 1.0, 0.02], rel=0.02)
    assert {row["unit"] for row in listed} == {"m/s^2"}
    assert picture.read_bytes().startswith(b"\x89PNG")


def test_a_band_keeps_its_lines(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    file = _signals(tmp_path / "signals.h5", {106.25: 1.0, 318.75: 0.02})
    assert main(["lines", str(file), "--band", "200:400", "--channel", "a"]) == 0
    told = capsys.readouterr().out
    assert "harmonic 3" in told
    assert "fundamental\n" not in told
    assert main(["lines", str(file), "--band", "1000:1001"]) == 0
    assert "1000" not in capsys.readouterr().out


def test_wrong_input_is_one_sentence(tmp_path: Path, refused: RefusedCommand) -> None:
    file = _signals(tmp_path / "signals.h5", {106.25: 1.0})
    (tmp_path / "there.csv").write_text("")
    for arguments, sentence in (
        ([tmp_path / "none.h5"], "none.h5: "),
        ([file, "--channel", "b"], 'found "a"'),
        ([file, "--csv", tmp_path / "there.csv"], "--force replaces it"),
        ([tmp_path], "recording.toml"),
    ):
        assert sentence in refused("lines", *arguments)
    run = _recording(tmp_path, {106.25: 1.0}, frequencies=[106.25])
    assert "--band" in refused("lines", run, "--band", "1:2")
    (tmp_path / "empty").mkdir()
    run = _recording(tmp_path / "empty", {100.0: 1.0}, band=[2000.0, 3000.0], period=1.0)
    assert re.search("2000 .* 3000 Hz", refused("lines", run))
    for wrong in ("5", "7:3", "a:b"):
        with pytest.raises(SystemExit, match="2"):
            main(["lines", str(file), "--band", wrong])


def test_a_recording_says_what_is_fitted(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    run = _recording(tmp_path, {53.7: 1.0, 107.4: 0.01, 50.02: 0.05, 777.7: 0.001}, frequencies=[53.7])
    table = tmp_path / "lines.csv"
    assert main(["lines", str(run), "--csv", str(table)]) == 0
    listed = {round(float(row["frequency_hz"]), 1): row for row in rows(table)}
    uses = {frequency: row["use"] for frequency, row in listed.items()}
    assert uses == {53.7: "fitted", 107.4: "fitted", 50.0: "fitted in addition", 777.7: "not fitted"}
    assert float(listed[53.7]["amplitude"]) == pytest.approx(1.0, abs=2e-3)
    assert re.search(r"\b2 of 53\.7 Hz, 0\.0099 ", listed[107.4]["what"])
    assert uses[50.0] in capsys.readouterr().out


def test_a_campaign_is_listed_recording_by_recording(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], refused: RefusedCommand
) -> None:
    run = _recording(tmp_path, {53.7: 1.0}, frequencies=[53.7])
    run.rename(tmp_path / "first")
    _recording(tmp_path, {61.1: 1.0}, frequencies=[61.1])
    assert main(["lines", str(tmp_path)]) == 0
    text = capsys.readouterr().out
    assert "53.7000" in text
    assert "61.1000" in text
    assert "2 recordings" in refused("lines", tmp_path, "--csv", tmp_path / "lines.csv")
    assert not (tmp_path / "lines.csv").exists()


def test_a_frequency_that_no_sampling_could_tell_is_refused(tmp_path: Path) -> None:
    """At 12.8 kHz half a per cent of 5 MHz is twice the whole band; 20 kHz is looked for where it folds to."""
    run = _recording(tmp_path, {53.7: 1.0}, frequencies=[5e6])
    manifest = load_manifest(run)
    with pytest.raises(InputError, match=r"frequencies: "):
        find_channel_lines(manifest, tie_daqs(manifest, read_daqs(manifest)))


def test_channels_are_fitted_with_what_leaks_into_their_lines(tmp_path: Path) -> None:
    run = _recording(tmp_path, {53.7: 1.0, 50.02: 0.5}, frequencies=[53.7])
    manifest = load_manifest(run)
    base = tie_daqs(manifest, read_daqs(manifest))
    lines = find_channel_lines(manifest, base)
    assert lines is not None
    (channel,), _ = channel_phasors(manifest, base, lines)
    np.testing.assert_array_equal(channel.phasors.frequency_hz, lines.frequency_hz)
    # The hum alone would leak up to 0.5/(π·7.4) = 2e-2.
    assert np.abs(channel.phasors.value[0, 0]) == pytest.approx(1.0, abs=5e-4)
    assert channel.residual_rms == pytest.approx(0.01, rel=0.05)


@pytest.mark.parametrize("period", [1.0, 0.1])
def test_a_multisine_may_state_a_band_only(tmp_path: Path, period: float) -> None:
    tones = {100.0: 1.0, 120.0: 0.8, 150.0: 0.9, 50.03: 0.5, 300.0: 0.02, 1000.0: 1.0}
    run = _recording(tmp_path, tones, band=[80.0, 400.0], period=period)
    manifest = load_manifest(run)
    lines = find_channel_lines(manifest, tie_daqs(manifest, read_daqs(manifest)))
    assert lines is not None
    assert lines.nominal_hz[lines.multiple == 1].tolist() == pytest.approx([100.0, 120.0, 150.0])
    assert "100, 120, 150" in lines.notices[0].text


def test_three_tones_of_a_shaker(data_dir: Path, capsys: pytest.CaptureFixture[str]) -> None:
    file = data_dir / "shaker_three_tone" / "data_set_1_downsampled_by_256.lvm"
    assert main(["lines", str(file), "--channel", "Voltage"]) == 0
    told = capsys.readouterr().out
    assert "0.499299" in told  # 150 Hz, seen at 50 Hz
    assert "0.499368" in told  # 120 Hz, seen at 80 Hz
    assert main(["lines", str(data_dir / "undersampled_video" / "acceleration.lvm")]) == 0
    assert re.search("50030 .* 50000 Hz", capsys.readouterr().out)


def test_report_and_result_file_hold_the_other_lines(tmp_path: Path, ready_evaluation: Evaluation) -> None:
    rng = np.random.default_rng(1)
    time = np.arange(25_600) / RATE
    values = np.cos(2 * np.pi * 106.25 * time) + 0.01 * rng.normal(size=len(time))
    values += 0.1 * np.cos(2 * np.pi * 50.02 * time) + 0.05 * np.cos(2 * np.pi * 777.7 * time)
    lines = find_lines(time, values, [106.25])
    table = lines_table(replace(ready_evaluation, lines=lines))
    assert [(row[3], row[4].partition(",")[0]) for row in table.rows] == [
        ("fitted in addition", "mains hum (50 Hz)"),
        ("result", "fundamental"),
        ("not fitted", "unexplained"),
    ]
    write_h5(tmp_path / "result.h5", replace(ready_evaluation, lines=lines), [])
    with h5py.File(tmp_path / "result.h5") as file:
        others = file["lines/others"]
        np.testing.assert_allclose(others["frequency_hz"], lines.others.frequency_hz)
        assert others["origin/kind"].asstr()[0] == "mains"


def _two_clocks(folder: Path, rate: float) -> tuple[Manifest, TimeBase]:
    """A line of 1020.3 Hz and amplitude 1 on two clocks, the second `rate` times as slow, tied by their trigger."""
    run = folder / "run"
    run.mkdir()
    (folder / "rig.toml").write_text(block(format=1, name="two clocks"), encoding="utf-8")
    text = recording_head("two clocks", 1020.3).partition("[[daq]]")[0]
    for name, pace in (("first", 1.0), ("second", rate)):
        time_s = pace * np.arange(16_000) / 8e3
        trigger = ((time_s > 0.1) & (time_s < 1.9) & (time_s % (1.0 / 52.11) < 4e-3)).astype(float)
        noise = 1e-4 * np.random.default_rng(len(name)).normal(size=len(time_s))
        sine = np.cos(2.0 * np.pi * 1020.3 * time_s + 0.3) + noise
        write_daq(run / f"{name}.h5", 8e3, {f"trigger_{name}": trigger, "camera": trigger, name: sine})
        text += block("[daq]", name=name, file=f"{name}.h5")
        text += channel("camera", "trigger") + channel(name, "voltage")
    (run / "recording.toml").write_text(text, encoding="utf-8")
    manifest = load_manifest(run)
    return manifest, tie_daqs(manifest, read_daqs(manifest))


def _spoiled(base: TimeBase, true_rate: float, rate_off: float, u_rate: float) -> TimeBase:
    """The same clocks with a tie that is right in the middle of the record and has a wrong rate."""
    tie = base.ties["second"]
    assert tie is not None
    middle_s = 1.0
    spread = np.array([[1e-12 + (middle_s * u_rate) ** 2, -middle_s * u_rate**2], [-middle_s * u_rate**2, u_rate**2]])
    line = {"offset_s": -middle_s * rate_off, "rate": true_rate + rate_off, "covariance": spread}
    return replace(base, ties={"first": None, "second": replace(tie, **line)})


def test_lines_refine_the_rates_of_clocks(tmp_path: Path) -> None:
    """A rate wrong by r costs a sine over T seconds (πfTr)²/6, which no first-order uncertainty holds."""
    manifest, base = _two_clocks(tmp_path, 1.0 + 3e-5)
    wrong = _spoiled(base, 1.0 + 3e-5, 6e-5, 5e-5)
    lines = find_channel_lines(manifest, wrong)
    assert lines is not None
    lost = (np.pi * 1020.3 * 2.0 * 6e-5) ** 2 / 6.0
    (_, spoiled), _ = channel_phasors(manifest, wrong, lines)
    assert 1.0 - np.abs(spoiled.phasors.value[0, 0]) == pytest.approx(lost, rel=0.02)
    refined, lines = refine_ties(wrong, lines)
    tie = refined.ties["second"]
    assert tie is not None
    assert tie.rate == pytest.approx(1.0 + 3e-5, abs=4.0 * np.sqrt(tie.covariance[1, 1]))
    assert np.sqrt(tie.covariance[1, 1]) < 1e-7
    # What the edges know of the middle of the record stays: nothing else tells it.
    assert float(tie.to_base_s(np.array(1.0))) == pytest.approx(1.0 + 3e-5, abs=1e-8)
    assert float(tie.u_to_base_s(np.array(1.0))) == pytest.approx(1e-6, rel=1e-3)
    (_, channel_of_second), _ = channel_phasors(manifest, refined, lines)
    assert np.abs(channel_of_second.phasors.value[0, 0]) == pytest.approx(1.0, abs=1e-5)


def test_lines_that_contradict_the_edges_are_told_and_known_rates_stay(tmp_path: Path) -> None:
    manifest, base = _two_clocks(tmp_path, 1.0)
    wrong = _spoiled(base, 1.0, 2e-4, 1e-5)
    lines = find_channel_lines(manifest, wrong)
    assert lines is not None
    tie = refine_ties(wrong, lines)[0].ties["second"]
    assert tie is not None
    assert tie.rate == pytest.approx(1.0 + 2e-4, abs=1e-6)
    assert "2 × 10⁻⁴" in tie.notices[-1].text
    well_known = _spoiled(base, 1.0, 0.0, 1e-7)
    assert refine_ties(well_known, lines) == (well_known, lines)
