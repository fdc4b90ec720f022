"""`shakercal step` against a sensor whose differential equation scipy solved, simulated components, wrong input."""

from __future__ import annotations

import json
import re
import shutil
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import h5py
import numpy as np
import pytest
from numpy.typing import NDArray
from page_outline import self_contained
from scipy import optimize, signal
from support import edit, rows

from fusion.base import InputError
from fusion.cli import main
from fusion.recording.load import load_manifest
from fusion.sensor.models_file import read_models
from fusion.sensor.step.evaluate import measured_response
from fusion.sensor.step.records import read_step
from fusion.sensor.step.releases import read_recording

FloatArray = NDArray[np.float64]
RATE_HZ = 50_000.0
FINE = 8
RIG = """format = 1
name = "rope rig"

[sensor]
name = "test sensor"
serial = "7"
channels = ["Fx", "Fz"]
unit = "V/V"
sense = "on_sensor"
static_sensitivity = [[0.0, 0.0, 2e-8, 0.0, 0.0, 0.0], [0.0, 0.0, 2e-6, 0.0, 0.0, 0.0]]
static_sensitivity_uncertainty = 1e-3
internal_mass = 0.05
"""


@dataclass(frozen=True)
class Truth:
    """A second-order sensor behind a first-order amplifier, and its releases by one rope."""

    frequency_hz: float = 1700.0
    damping_ratio: float = 0.015
    chain_hz: float = 6000.0
    gain: float = 2e-6
    amplitude: float = -100.0
    onset_s: float = 0.00513
    release_s: float = 2e-4
    noise: float = 2e-7
    length_s: float = 0.05
    cross: float = 0.01

    @property
    def transfer(self) -> tuple[FloatArray, FloatArray]:
        """Numerator and denominator in s of output over load."""
        omega, pole = 2 * np.pi * self.frequency_hz, 2 * np.pi * self.chain_hz
        bottom = np.polymul([1.0, 2 * self.damping_ratio * omega, omega**2], [1.0, pole])
        return np.array([self.gain * omega**2 * pole]), np.asarray(bottom, dtype=np.float64)

    def outputs(self, rng: np.random.Generator) -> tuple[FloatArray, FloatArray]:
        """Load (N,) and outputs Fx, Fz (2, N) of a load that goes along a straight line from `amplitude` to none."""
        time = np.arange(round(self.length_s * RATE_HZ) * FINE) / (RATE_HZ * FINE)
        share = np.clip((time - self.onset_s) / max(self.release_s, 1e-9), 0.0, 1.0)
        load = self.amplitude * share
        _, ringing, _ = signal.lsim(self.transfer, load, time)
        driven = ringing[::FINE] - self.gain * self.amplitude
        both = np.stack([self.cross * driven, driven])
        return load[::FINE], np.asarray(both + self.noise * rng.standard_normal(both.shape), dtype=np.float64)


@dataclass(frozen=True)
class StepFolder:
    """A campaign folder that is being filled."""

    path: Path
    rng: np.random.Generator = field(default_factory=lambda: np.random.default_rng(8))

    def start(self, rig: str = RIG) -> StepFolder:
        """Write rig.toml."""
        self.path.mkdir(parents=True, exist_ok=True)
        (self.path / "rig.toml").write_text(rig, encoding="utf-8")
        return self

    def add(
        self,
        name: str,
        truth: Truth,
        *,
        release: str = "fishing line",
        mounting: str = "1",
        force: bool = False,
        channels: Sequence[str] = ("Fx", "Fz"),
    ) -> Path:
        """Write one release and return its folder."""
        folder = self.path / name
        folder.mkdir()
        load, outputs = truth.outputs(self.rng)
        samples = dict(zip(("Fx", "Fz"), outputs, strict=True))
        with h5py.File(folder / "daq.h5", "w") as file:
            for channel in channels:
                file[channel] = samples[channel]
            if force:
                file["load cell"] = load - truth.amplitude + 0.001 * self.rng.standard_normal(len(load))
            for data in file.values():
                data.attrs["sample_rate"] = RATE_HZ
        text = [
            'format = 1\nrig = "../rig.toml"',
            f'name = "{name}"\nmounting = "{mounting}"\n',
            f'[excitation]\nkind = "step"\ncomponent = "Fz"\nstep_amplitude = {truth.amplitude}\nrelease = "{release}"',
            'force = "load cell"\n' if force else "",
            '[[daq]]\nname = "daq"\nfile = "daq.h5"\n',
            *(f'[[daq.channel]]\nname = "{c}"\nquantity = "output"\nchannel = "{c}"\n' for c in channels),
            '[[daq.channel]]\nname = "load cell"\nquantity = "force"\n' if force else "",
        ]
        (folder / "recording.toml").write_text("\n".join(text), encoding="utf-8")
        return folder


TRUTH = Truth(length_s=0.03)
COTTON = Truth(release_s=2e-3, onset_s=0.0047, length_s=0.03)
FILES = {"releases.csv", "models.csv", "indices.csv", "methods.csv", "models.json", "step.h5", "step.html"}


@pytest.fixture(scope="module")
def campaign(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Three releases by fishing line and one by cotton rope, evaluated."""
    folder = StepFolder(tmp_path_factory.mktemp("step") / "campaign").start()
    for number in (1, 2, 3):
        folder.add(f"line-{number}", TRUTH)
    folder.add("cotton-1", COTTON, release="cotton rope")
    assert main(["step", str(folder.path), "-q"]) == 0
    return folder.path


def number(campaign: Path, file: str, name: str, channel: str = "Fz") -> tuple[float, float]:
    """Value and U of a number in a table."""
    (row,) = (r for r in rows(campaign / "step" / file) if r["name"] == name and r["channel"] == channel)
    return float(row["value"]), float(row["U"])


def gain(frequency_hz: float) -> float:
    """|H| of the truth over its static gain."""
    top, bottom = TRUTH.transfer
    s = 2j * np.pi * frequency_hz
    return float(abs(np.polyval(top, s) / np.polyval(bottom, s)) / TRUTH.gain)


def test_all_files_are_there_and_the_page_stands_alone(campaign):
    assert {path.name for path in (campaign / "step").iterdir()} == FILES
    page = (campaign / "step" / "step.html").read_text(encoding="utf-8")
    self_contained(page)
    assert "line-1: record, fit and residual" in page
    assert "Output Fz over load Fz" in page


def test_models_hold_the_truth(campaign):
    found = read_models(campaign / "step")["Fz", "Fz"]
    assert (found.unit, found.sample_rate_hz) == ("V/V", 50_000.0)
    assert found.recording == "line-1, line-2, line-3"
    assert found.noise == pytest.approx(TRUTH.noise, rel=0.1)
    assert found.model.frequency_hz[0] == pytest.approx(TRUTH.frequency_hz, rel=1e-4)
    assert found.model.damping_ratio[0] == pytest.approx(TRUTH.damping_ratio, rel=5e-3)
    assert found.model.static_gain == pytest.approx(TRUTH.gain, rel=1e-3)


def test_numbers_lie_within_their_uncertainty(campaign):
    bands = {name: optimize.brentq(lambda f, level=level: gain(f) - level, 1.0, 1500.0)
             for name, level in (("band_5_hz", 1.05), ("band_10_hz", 1.10))}  # fmt: skip
    truth = {"natural_hz": TRUTH.frequency_hz, "damping_ratio": TRUTH.damping_ratio, "static_gain": TRUTH.gain}
    for name, true in (truth | bands).items():
        value, expanded = number(campaign, "indices.csv", name)
        assert 0.0 < expanded < 0.1 * true, name
        assert abs(value - true) < 1.5 * expanded, name
        assert name not in bands or value == pytest.approx(true, rel=2e-3)


def test_every_output_has_its_static_gain(campaign):
    for channel, truth in (("Fz", TRUTH.gain), ("Fx", TRUTH.cross * TRUTH.gain)):
        value, expanded = number(campaign, "indices.csv", "read_static_gain", channel)
        assert abs(value - truth) < 1.5 * expanded


def test_releases_tell_how_the_ropes_let_go(campaign):
    found = rows(campaign / "step" / "releases.csv")
    driven = {row["recording"]: row for row in found if row["channel"] == "Fz"}
    assert len(found) == 8
    assert [name for name, row in driven.items() if row["used"] == "yes"] == ["line-1", "line-2", "line-3"]
    for name, row in driven.items():
        truth = COTTON if name.startswith("cotton") else TRUTH
        assert float(row["fit_release_s"]) == pytest.approx(truth.release_s, rel=0.1)
        assert float(row["step_amplitude"]) == truth.amplitude
        assert float(row["baseline"]) == pytest.approx(-truth.gain * truth.amplitude, rel=1e-2)


def test_records_fits_and_residuals_are_in_the_file(campaign):
    with h5py.File(campaign / "step" / "step.h5") as file:
        fit = file["Fz/releases/line-1/fit"]
        rest = fit["residual"][()]
        assert rest.shape == fit["time_s"].shape
        assert np.std(rest) == pytest.approx(TRUTH.noise, rel=0.2)
        assert file["Fz/pooled/model/covariance"].shape == (6, 6)


def test_one_recording_has_its_own_folder_and_the_summary_says_so(campaign, tmp_path, capsys):
    assert main(["step", str(campaign / "line-2"), "-o", str(tmp_path / "one")]) == 0
    told = capsys.readouterr()
    assert "Fz: 1 of 1 releases in the model; f_n (1700." in told.out
    assert "one release only: what releases scatter by is not in U" in told.err


def test_results_of_other_recordings_are_not_overwritten(campaign, refused):
    told = refused("step", campaign / "line-1", "-o", campaign / "step")
    assert "found results of other input files" in told


METHODS = ["pencil", "arx", "sim", "sim_zoh", "evolution", "evolution_coefficients"]


@pytest.mark.slow
def test_the_amplifier_is_in_bands_and_their_u_even_where_it_hides(tmp_path):
    campaign = tmp_path / "campaign"
    assert main(["simulate", str(campaign), "--preset", "steps", "-q"]) == 0
    for folder in [path for path in campaign.iterdir() if path.is_dir() and path.name[:2] not in ("Fx", "Mx")]:
        shutil.rmtree(folder)
    assert main(["step", str(campaign), "-q"]) == 0
    truth = json.loads((campaign / "truth.json").read_text(encoding="utf-8"))
    found = {(row["component"], row["name"]): row for row in rows(campaign / "step" / "indices.csv")}
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
def test_every_method_has_its_row_and_its_curve(tmp_path):
    folder = StepFolder(tmp_path / "campaign").start().add("one", replace(Truth(), length_s=0.025))
    assert main(["step", str(folder), "--method", "all", "-q"]) == 0
    found = {row["method"]: row for row in rows(folder / "step" / "methods.csv")}
    assert list(found) == METHODS
    for method in ("pencil", "arx"):
        assert float(found[method]["natural_hz"]) == pytest.approx(1700.0, rel=1e-3)
    page = (folder / "step" / "step.html").read_text(encoding="utf-8")
    assert "How the methods came to their models" in page
    assert "differential evolution on coefficients" in page


@pytest.mark.parametrize("force", [False, True])
def test_response_without_a_model_is_that_of_the_equation(tmp_path, force):
    truth = Truth(damping_ratio=0.05, release_s=3e-4, noise=2e-9)
    folder = StepFolder(tmp_path / "campaign").start().add("one", truth, force=force)
    release, _ = read_recording(load_manifest(folder))
    at = replace(release.reading, onset_s=truth.onset_s, release_s=truth.release_s, u_release_s=0.0, shape="ramp")
    found = measured_response(replace(release, readings=(at, *release.readings[1:])))
    inside = (found.frequency_hz > 15.0) & (found.frequency_hz < 2400.0)
    assert np.count_nonzero(inside) > 50
    top, bottom = truth.transfer
    s = 2j * np.pi * found.frequency_hz[inside]
    expected = np.polyval(top, s) / np.polyval(bottom, s)
    assert np.abs(found.value[inside] / expected - 1.0).max() < 0.02
    assert np.all(found.frequency_hz[1:] > found.frequency_hz[:-1])


def test_noise_of_a_response_is_as_large_as_told(tmp_path):
    truth = replace(Truth(), noise=1e-6, length_s=0.03)
    folder = StepFolder(tmp_path / "campaign").start()
    responses = []
    for number in range(8):
        release, _ = read_recording(load_manifest(folder.add(f"{number}", truth)))
        at = replace(release.reading, onset_s=truth.onset_s, release_s=truth.release_s, shape="ramp")
        responses.append(measured_response(replace(release, readings=(at, *release.readings[1:]))))
    values = np.stack([one.value for one in responses])
    scatter = np.sqrt(np.mean(np.abs(values - values.mean(axis=0)) ** 2, axis=0) * 8 / 7)
    inside = (responses[0].frequency_hz > 200.0) & (responses[0].frequency_hz < 3000.0)
    ratio = scatter[inside] / np.mean([one.u for one in responses], axis=0)[inside]
    assert np.sqrt(np.mean(ratio**2)) == pytest.approx(1.0, rel=0.1)


SHORT = replace(Truth(), length_s=0.02)
OUTPUT = '[[daq.channel]]\nname = "Fz"\nquantity = "output"\nchannel = "Fz"\n'
CASES = [
    ('release = "fishing line"', "onset = 0.5", "excitation.onset: expected a time within the record"),
    ('release = "fishing line"', 'force = "cell"', 'force: expected the name of a recorded channel, found "cell"'),
    ('release = "fishing line"', 'force = "Fx"', 'found "Fx", of quantity output'),
    (OUTPUT, "", "daq.channel: expected the output Fz, the component that is driven, found Fx"),
    ("step_amplitude = -100.0\n", "", "excitation.step_amplitude: expected this key, required for kind"),
    ("= -100.0", "= 0.0", "excitation.step_amplitude: expected a step other than 0"),
]


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """One short release."""
    return StepFolder(tmp_path / "campaign").start().add("one", SHORT)


@pytest.mark.parametrize(("old", "new", "told"), CASES)
def test_a_mistake_is_one_sentence(folder, old, new, told, refused):
    edit(folder / "recording.toml", old, new)
    sentence = refused("step", folder, "-q")
    assert "recording.toml: " in sentence
    assert told in sentence
    assert not (folder / "step").exists()


def test_without_outputs_there_is_nothing_to_evaluate(folder, refused):
    path = folder / "recording.toml"
    text = re.sub(r'quantity = "output"\nchannel = "F[xz]"', 'quantity = "voltage"', path.read_text(encoding="utf-8"))
    path.write_text(text, encoding="utf-8")
    assert 'daq.channel: expected a channel with quantity = "output", found none' in refused("step", folder, "-q")


def rewrite(folder: Path, change: object) -> None:
    """Change the samples of output Fz."""
    with h5py.File(folder / "daq.h5", "r+") as file:
        file["Fz"][...] = change(file["Fz"][()])


def test_records_without_a_step_or_clipped_are_named(folder, refused):
    rewrite(folder, lambda samples: np.clip(samples, -0.7e-4, None))
    told = refused("step", folder, "-q")
    assert "daq.channel.Fz: expected an output that was not clipped" in told
    rng = np.random.default_rng(1)
    rewrite(folder, lambda samples: 1e-7 * rng.standard_normal(len(samples)))
    assert "daq.channel.Fz: " in refused("step", folder, "-q")


def test_other_kinds_go_to_their_commands(folder, refused, capsys):
    for command in ("run", "transfer"):
        assert "shakercal step takes this one" in refused(command, folder, "-q")
    assert main(["check", str(folder), "-q"]) == 0
    assert "shakercal step evaluates this recording" in capsys.readouterr().out
    path, noise = folder / "recording.toml", 'kind = "noise"\ndirection = [0, 0, 1]'
    text = re.sub(r'kind = "step".*?release = "fishing line"', noise, path.read_text(), flags=re.DOTALL)
    path.write_text(text, encoding="utf-8")
    told = refused("step", folder, "-q")
    assert "excitation.kind: expected step, the kind that shakercal step evaluates" in told
    assert told.endswith("found noise")


def test_measured_release_needs_a_force(folder, refused):
    told = refused("step", folder, "-q", "--release", "measured")
    assert "excitation.force: expected the name of the force channel" in told


def test_two_rigs_are_not_compared(folder, tmp_path, refused):
    other = StepFolder(tmp_path / "other").start().add("two", SHORT)
    assert "rig: expected" in refused("step", folder, other, "-q")


def test_what_does_not_oscillate_or_settle_has_no_model_and_status_1(folder, refused):
    rng = np.random.default_rng(2)

    def ramp(samples: np.ndarray) -> np.ndarray:
        return np.where(np.arange(len(samples)) < 300, 1e-4, -1e-4) + 1e-6 * rng.standard_normal(len(samples))

    rewrite(folder, ramp)
    told = refused("step", folder, "-q", "--release", "step", status=1)
    assert "no model was found of any output" in told


def test_a_record_has_its_outputs_on_one_time_base(tmp_path):
    folder = StepFolder(tmp_path / "campaign").start().add("one", SHORT, force=True)
    record = read_step(load_manifest(folder)).record
    assert (record.name, record.channels, record.unit) == ("one", ("Fx", "Fz"), "V/V")
    assert (record.component, record.amplitude, record.release) == ("Fz", -100.0, "fishing line")
    assert record.force[:100].mean() == pytest.approx(100.0, rel=1e-3)
    with h5py.File(folder / "daq.h5") as file:
        assert np.array_equal(record.samples[1], file["Fz"][()])


def test_delays_of_channels_are_taken_off(tmp_path):
    folder = StepFolder(tmp_path / "campaign").start().add("one", replace(SHORT, noise=0.0, cross=1.0))
    path = folder / "recording.toml"
    late = 3.4 / 50_000.0
    text = path.read_text(encoding="utf-8").replace('channel = "Fz"\n', f'channel = "Fz"\ndelay = {late}\n')
    path.write_text(text, encoding="utf-8")
    record = read_step(load_manifest(folder)).record
    shifted = np.interp(record.time_s + late, record.time_s, record.samples[0])
    inside = slice(600, -100)
    assert record.samples[1][inside] == pytest.approx(shifted[inside], abs=2e-6)
    assert np.abs(record.samples[1] - record.samples[0])[inside].max() > 5e-6


def test_a_stated_chain_is_told_to_be_in_the_model(folder):
    (folder / "chain.csv").write_text("frequency_hz,magnitude,phase_rad\n0,1,0\n10000,1,-0.1\n", encoding="utf-8")
    edit(folder / "recording.toml", 'channel = "Fz"\n', 'channel = "Fz"\nresponse = "chain.csv"\n')
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
