"""Step recordings that cannot be evaluated: one sentence each, with file and key, and its exit status."""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path

import h5py
import numpy as np
import pytest
from step_factory import StepFolder, Truth

from fusion.base import InputError
from fusion.cli import main
from fusion.recording.load import load_manifest
from fusion.sensor.step.records import read_step, read_step_record

TRUTH = replace(Truth(), length_s=0.02)
OUTPUT = '[[daq.channel]]\nname = "Fz"\nquantity = "output"\nchannel = "Fz"\n'
CASES = [
    ("onset", 'release = "fishing line"', "onset = 0.5", "excitation.onset: expected a time within the record"),
    (
        "force",
        'release = "fishing line"',
        'force = "cell"',
        'excitation.force: expected the name of a recorded channel, found "cell"',
    ),
    ("force", 'release = "fishing line"', 'force = "Fx"', 'found "Fx", of quantity output'),
    ("output", OUTPUT, "", "daq.channel: expected the output Fz, the component that is driven, found Fx"),
    ("kind", "step_amplitude = -100.0\n", "", "excitation.step_amplitude: expected this key, required for kind"),
    (
        "zero",
        "step_amplitude = -100.0",
        "step_amplitude = 0.0",
        "excitation.step_amplitude: expected a step other than 0",
    ),
]


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """One short release."""
    return StepFolder(tmp_path / "campaign").start().add("one", TRUTH)


def refused(path: Path, capsys: pytest.CaptureFixture[str], *options: str) -> str:
    """The sentence with which the command refuses a recording."""
    assert main(["step", str(path), "-q", *options]) == 2
    told = capsys.readouterr().err
    assert told.count("\n") == 1
    assert not (path / "step").exists()
    return told


@pytest.mark.parametrize(("what", "old", "new", "told"), CASES)
def test_a_mistake_is_one_sentence(folder, what, old, new, told, capsys):
    path = folder / "recording.toml"
    text = path.read_text(encoding="utf-8")
    assert old in text, what
    path.write_text(text.replace(old, new), encoding="utf-8")
    sentence = refused(folder, capsys)
    assert "recording.toml: " in sentence
    assert re.search(told, sentence), sentence


def test_without_outputs_there_is_nothing_to_evaluate(folder, capsys):
    path = folder / "recording.toml"
    text = re.sub(r'quantity = "output"\nchannel = "F[xz]"', 'quantity = "voltage"', path.read_text(encoding="utf-8"))
    path.write_text(text, encoding="utf-8")
    assert 'daq.channel: expected a channel with quantity = "output", found none' in refused(folder, capsys)


def rewrite(folder: Path, change: object) -> None:
    """Change the samples of output Fz."""
    with h5py.File(folder / "daq.h5", "r+") as file:
        file["Fz"][...] = change(file["Fz"][()])


def test_a_record_without_a_step_is_named(folder, capsys):
    rng = np.random.default_rng(1)
    rewrite(folder, lambda samples: 1e-7 * rng.standard_normal(len(samples)))
    assert "daq.channel.Fz: " in refused(folder, capsys)


def test_a_clipped_record_is_named(folder, capsys):
    rewrite(folder, lambda samples: np.clip(samples, -0.7e-4, None))
    assert "daq.channel.Fz: expected an output that was not clipped" in refused(folder, capsys)


def test_other_kinds_go_to_their_commands(folder, capsys):
    for command, told in (("run", "shakercal step takes this one"), ("transfer", "shakercal step takes this one")):
        assert main([command, str(folder), "-q"]) == 2
        assert told in capsys.readouterr().err
    assert main(["check", str(folder), "-q"]) == 0
    assert "shakercal step evaluates this recording" in capsys.readouterr().out
    path = folder / "recording.toml"
    text = re.sub(
        r'kind = "step".*?release = "fishing line"',
        'kind = "noise"\ndirection = [0, 0, 1]',
        path.read_text(),
        flags=re.DOTALL,
    )
    path.write_text(text, encoding="utf-8")
    assert (
        "excitation.kind: expected step, the kind that shakercal step evaluates (shakercal transfer takes this one), found noise"
        in refused(folder, capsys)
    )


def test_measured_release_needs_a_force(folder, capsys):
    assert "excitation.force: expected the name of the force channel" in refused(
        folder, capsys, "--release", "measured"
    )


def test_two_rigs_are_not_compared(folder, tmp_path, capsys):
    other = StepFolder(tmp_path / "other").start().add("two", TRUTH)
    assert main(["step", str(folder), str(other), "-q"]) == 2
    assert "rig: expected" in capsys.readouterr().err


def test_what_does_not_oscillate_or_settle_has_no_model_and_status_1(folder, capsys):
    rng = np.random.default_rng(2)

    def ramp(samples: np.ndarray) -> np.ndarray:
        return np.where(np.arange(len(samples)) < 300, 1e-4, -1e-4) + 1e-6 * rng.standard_normal(len(samples))

    rewrite(folder, ramp)
    assert main(["step", str(folder), "-q", "--release", "step"]) == 1
    assert "no model was found of any output" in capsys.readouterr().err


def test_a_record_has_its_outputs_on_one_time_base(tmp_path):
    folder = StepFolder(tmp_path / "campaign").start().add("one", TRUTH, force=True)
    record = read_step_record(load_manifest(folder))
    assert (record.name, record.channels, record.unit) == ("one", ("Fx", "Fz"), "V/V")
    assert (record.component, record.amplitude, record.release) == ("Fz", -100.0, "fishing line")
    assert record.force[:100].mean() == pytest.approx(100.0, rel=1e-3)
    with h5py.File(folder / "daq.h5") as file:
        assert np.array_equal(record.samples[1], file["Fz"][()])


def test_delays_of_channels_are_taken_off(tmp_path):
    folder = StepFolder(tmp_path / "campaign").start().add("one", replace(TRUTH, noise=0.0, cross=1.0))
    path = folder / "recording.toml"
    late = 3.4 / 50_000.0
    text = path.read_text(encoding="utf-8").replace('channel = "Fz"\n', f'channel = "Fz"\ndelay = {late}\n')
    path.write_text(text, encoding="utf-8")
    record = read_step_record(load_manifest(folder))
    shifted = np.interp(record.time_s + late, record.time_s, record.samples[0])
    inside = slice(600, -100)
    assert record.samples[1][inside] == pytest.approx(shifted[inside], abs=2e-6)
    assert np.abs(record.samples[1] - record.samples[0])[inside].max() > 5e-6


def test_a_stated_chain_is_told_to_be_in_the_model(folder):
    (folder / "chain.csv").write_text("frequency_hz,magnitude,phase_rad\n0,1,0\n10000,1,-0.1\n", encoding="utf-8")
    path = folder / "recording.toml"
    text = path.read_text(encoding="utf-8").replace('channel = "Fz"\n', 'channel = "Fz"\nresponse = "chain.csv"\n')
    path.write_text(text, encoding="utf-8")
    notices = read_step(load_manifest(folder)).notices
    assert [n.severity for n in notices] == ["warning"]
    assert "the stated response of Fz is not taken off" in notices[0].text


def test_several_takes_are_refused(folder):
    path = folder / "recording.toml"
    text = path.read_text(encoding="utf-8")
    head, blocks = text[: text.index("[[daq]]")], text[text.index("[[daq]]") :].replace("[[daq", "[[take.daq")
    blocks = blocks.replace('channel = "Fx"\n', 'channel = "Fx"\nreference = true\n')
    path.write_text(head + ("[[take]]\n" + blocks) * 2, encoding="utf-8")
    with pytest.raises(InputError, match="take: expected one release per recording"):
        read_step(load_manifest(folder))
