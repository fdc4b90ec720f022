"""`shakercal step` against a sensor whose differential equation scipy solved, simulated components, wrong input."""

from __future__ import annotations

import json
import re
from dataclasses import replace
from pathlib import Path

import h5py
import numpy as np
import pytest
from page_outline import self_contained
from release_factory import Truth
from scipy import optimize
from support import block, channel, documented_columns, edit, rows

from fusion.cli import main
from fusion.errors import InputError
from fusion.recording.load import load_manifest
from fusion.recording.recording_notices import WRONG_EXCITATION_KIND
from fusion.report.h5 import read_notices
from fusion.sensor import model_notices as raised
from fusion.sensor.model_files import read_models
from fusion.sensor.step.step_figures import MeasuredResponse, measured_response
from fusion.sensor.step.step_records import StepInput, read_step
from fusion.sensor.step.step_releases import LABELS, read_recording
from shakercal._common.notices import Notice

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
NOISE, CROSS = 2e-7, 0.01
TRUTH = Truth(gain=2e-6, amplitude=-100.0, baseline=2e-4, onset_s=5.13e-3, release_s=2e-4, rate_hz=50e3, length_s=0.03)
COTTON = replace(TRUTH, release_s=2e-3, onset_s=4.7e-3)
SHORT = replace(TRUTH, length_s=0.02)
FILES = {
    "releases.csv",
    "models.csv",
    "indices.csv",
    "budget.csv",
    "methods.csv",
    "models.json",
    "step.h5",
    "step.html",
}


def write(
    folder: Path, truth: Truth, rng: np.random.Generator | None = None, *, release: str = "fishing line",
    force: bool = False, noise: float = NOISE, cross: float = CROSS,
) -> Path:  # fmt: skip
    """Write one release into the folder of a recording, beside the rig, and return the folder."""
    rng = np.random.default_rng(8) if rng is None else rng
    folder.mkdir(parents=True)
    (folder.parent / "rig.toml").write_text(RIG, encoding="utf-8")
    clean = np.stack([cross * truth.clean(), truth.clean()])
    samples = dict(zip(("Fx", "Fz"), clean + noise * rng.standard_normal(clean.shape), strict=True))
    text = block(format=1, rig="../rig.toml", name=folder.name, mounting="1")
    step = {"kind": "step", "component": "Fz", "step_amplitude": truth.amplitude, "release": release}
    text += block("excitation", **step, **({"force": "load cell"} if force else {}))
    text += block("[daq]", name="daq", file="daq.h5") + "".join(channel(c, "output", channel=c) for c in samples)
    if force:
        load = truth.amplitude * truth.load(np.arange(clean.shape[1]) / truth.rate_hz)
        samples["load cell"] = load - truth.amplitude + 0.001 * rng.standard_normal(len(load))
        text += channel("load cell", "force")
    with h5py.File(folder / "daq.h5", "w") as file:
        for name, values in samples.items():
            file[name] = values
            file[name].attrs["sample_rate"] = truth.rate_hz
    (folder / "recording.toml").write_text(text, encoding="utf-8")
    return folder


@pytest.fixture(scope="module")
def campaign(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Three releases by fishing line and one by cotton rope, evaluated."""
    folder, rng = tmp_path_factory.mktemp("step") / "campaign", np.random.default_rng(8)
    for number in (1, 2, 3):
        write(folder / f"line-{number}", TRUTH, rng)
    write(folder / "cotton-1", COTTON, rng, release="cotton rope")
    assert main(["step", str(folder), "-q"]) == 0
    return folder


def number(campaign: Path, file: str, name: str, channel: str = "Fz") -> tuple[float, float]:
    """Value and U of a number in a table."""
    (row,) = (r for r in rows(campaign / "step" / file) if r["name"] == name and r["channel"] == channel)
    return float(row["value"]), float(row["U"])


def test_all_files_exist_and_the_page_is_self_contained(campaign):
    assert {path.name for path in (campaign / "step").iterdir()} == FILES
    assert list(rows(campaign / "step" / "models.csv")[0]) == documented_columns("steps.md", "models.csv")
    page = (campaign / "step" / "step.html").read_text(encoding="utf-8")
    self_contained(page)
    assert page.count("<figure") >= 2


def test_models_agree_with_the_truth(campaign):
    entry = read_models(campaign / "step")["Fz", "Fz"]
    assert (entry.unit, entry.sample_rate_hz) == ("V/V", 50_000.0)
    assert entry.recording == "line-1, line-2, line-3"
    assert entry.scope == "for these 3 releases in one mounting"
    assert entry.noise == pytest.approx(NOISE, rel=0.1)
    assert entry.model.frequency_hz[0] == pytest.approx(1700.0, rel=1e-4)
    assert entry.model.damping_ratio[0] == pytest.approx(TRUTH.damping_ratio, rel=5e-3)
    assert entry.model.static_gain == pytest.approx(TRUTH.gain, rel=1e-3)


def test_numbers_lie_within_their_uncertainty(campaign):
    def above(frequency_hz: float, level: float) -> float:
        return float(abs(TRUTH.response(frequency_hz)) / TRUTH.gain) - level

    truth = {"natural_hz": 1700.0, "damping_ratio": TRUTH.damping_ratio, "static_gain": TRUTH.gain}
    bands = {f"band_{n}_hz": optimize.brentq(above, 1.0, 1500.0, args=(1.0 + n / 100,)) for n in (5, 10)}
    for name, true in (truth | bands).items():
        value, expanded = number(campaign, "indices.csv", name)
        assert 0.0 < expanded < 0.1 * true, name
        assert abs(value - true) < 1.5 * expanded, name
        assert name not in bands or value == pytest.approx(true, rel=2e-3)
    for output, true in (("Fz", TRUTH.gain), ("Fx", CROSS * TRUTH.gain)):
        value, expanded = number(campaign, "indices.csv", "read_static_gain", output)
        assert abs(value - true) < 1.5 * expanded


def test_releases_have_the_shapes_of_their_devices(campaign):
    table = rows(campaign / "step" / "releases.csv")
    driven = {row["recording"]: row for row in table if row["channel"] == "Fz"}
    assert len(table) == 8
    assert [name for name, row in driven.items() if row["used"] == "yes"] == ["line-1", "line-2", "line-3"]
    for name, row in driven.items():
        truth = COTTON if name.startswith("cotton") else TRUTH
        assert float(row["fit_release_s"]) == pytest.approx(truth.release_s, rel=0.1)
        assert float(row["step_amplitude"]) == truth.amplitude
        assert float(row["baseline"]) == pytest.approx(-truth.gain * truth.amplitude, rel=1e-2)


def test_records_fits_and_residuals_are_in_the_file(campaign):
    with h5py.File(campaign / "step" / "step.h5") as file:
        fit = file["Fz/releases/line-1/fit"]
        assert fit["residual"].shape == fit["time_s"].shape
        assert np.std(fit["residual"][()]) == pytest.approx(NOISE, rel=0.2)
        assert file["Fz/pooled/model/covariance"].shape == (6, 6)


@pytest.mark.usefixtures("no_pages")
def test_one_recording_has_a_separate_folder_and_scope(campaign, tmp_path, capsys):
    assert main(["step", str(campaign / "line-2"), "-o", str(tmp_path / "one")]) == 0
    assert "f_n (1700." in capsys.readouterr().out
    with h5py.File(tmp_path / "one" / "step.h5") as file:
        assert file["Fz"].attrs["scope"] == "within this record of one release"
        (notice,) = (one for one in read_notices(file) if one.code == raised.MODEL_INFLUENCES_NOT_ASSESSED.code)
        assert notice.values == {name: file["Fz"].attrs[name] for name in ("scope", "outside")}


METHODS = ["pencil", "arx", "sim", "sim_zoh", "evolution", "evolution_coefficients"]


@pytest.mark.slow
def test_the_amplifier_is_in_bands_and_their_u_even_where_it_hides(commanded):
    campaign = commanded("steps")
    truth = json.loads((campaign / "truth.json").read_text(encoding="utf-8"))
    table = {(row["component"], row["name"]): row for row in rows(campaign / "step" / "indices.csv")}
    for component in ("Fx", "Mx"):
        natural = truth["frequency_hz"][truth["components"].index(component)]
        pole = float(np.ravel(truth["real_hz"])[0])

        def size(hertz: float, natural: float = natural, pole: float = pole) -> float:
            share = hertz / natural
            return float(abs(1.0 / (1.0 - share**2 + 0.03j * share) / (1.0 + 1j * hertz / pole)))

        band = optimize.brentq(lambda hertz: size(hertz) - 1.05, 1.0, 0.5 * natural)
        for name, value in (("natural_hz", natural), ("damping_ratio", 0.015), ("band_5_hz", band)):
            row = table[component, name]
            assert abs(float(row["value"]) - value) < 1.6 * float(row["U"]), (component, name)
            assert float(row["U"]) < 0.25 * value


@pytest.mark.slow
def test_every_method_has_its_row_and_its_curve(tmp_path):
    folder = write(tmp_path / "one", replace(TRUTH, length_s=0.025))
    assert main(["step", str(folder), "--method", "all", "-q"]) == 0
    found = {row["method"]: row for row in rows(folder / "step" / "methods.csv")}
    assert list(found) == METHODS
    for method in ("pencil", "arx"):
        assert float(found[method]["natural_hz"]) == pytest.approx(1700.0, rel=1e-3)
    page = (folder / "step" / "step.html").read_text(encoding="utf-8")
    assert all(LABELS[method] in page for method in METHODS)


def response_of(folder: Path, truth: Truth) -> MeasuredResponse:
    """The response without a model, for onset and length of the release as they are."""
    release, _ = read_recording(load_manifest(folder))
    true = {"onset_s": truth.onset_s, "release_s": truth.release_s, "u_release_s": 0.0, "shape": "ramp"}
    return measured_response(replace(release, readings=(replace(release.reading, **true), *release.readings[1:])))


@pytest.mark.parametrize("force", [False, True])
def test_response_without_a_model_is_that_of_the_equation(tmp_path, force):
    truth = replace(TRUTH, damping_ratio=0.05, release_s=3e-4, length_s=0.05)
    seen = response_of(write(tmp_path / "one", truth, force=force, noise=2e-9), truth)
    inside = (seen.frequency_hz > 15.0) & (seen.frequency_hz < 2400.0)
    assert np.count_nonzero(inside) > 50
    assert np.abs(seen.value[inside] / truth.response(seen.frequency_hz[inside]) - 1.0).max() < 0.02
    assert np.all(seen.frequency_hz[1:] > seen.frequency_hz[:-1])


def test_noise_of_a_response_is_as_large_as_reported(tmp_path):
    rng = np.random.default_rng(8)
    responses = [response_of(write(tmp_path / f"{n}", TRUTH, rng, noise=1e-6), TRUTH) for n in range(5)]
    values = np.stack([one.value for one in responses])
    scatter = np.sqrt(np.mean(np.abs(values - values.mean(axis=0)) ** 2, axis=0) * 5 / 4)
    inside = (responses[0].frequency_hz > 200.0) & (responses[0].frequency_hz < 3000.0)
    ratio = scatter[inside] / np.mean([one.u for one in responses], axis=0)[inside]
    assert np.sqrt(np.mean(ratio**2)) == pytest.approx(1.0, rel=0.12)


CHAIN = "frequency_hz,magnitude,phase_rad\n0,1,0\n10000,1,-0.1\n"
OUTPUT = '[[daq.channel]]\nname = "Fz"\nquantity = "output"\nchannel = "Fz"\n'
CASES = [  # old and new text of recording.toml, the key of the refusal, its code where this command declares it
    ('release = "fishing line"', "onset = 0.5", "excitation.onset", raised.ONSET_OUTSIDE_RECORD.code),
    ('release = "fishing line"', 'force = "cell"', "excitation.force", ""),
    ('release = "fishing line"', 'force = "Fx"', "excitation.force", raised.WRONG_FORCE_CHANNEL.code),
    (OUTPUT, "", "daq.channel", raised.DRIVEN_OUTPUT_MISSING.code),
    ("step_amplitude = -100.0\n", "", "excitation.step_amplitude", ""),
    ("= -100.0", "= 0.0", "excitation.step_amplitude", ""),
]


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """One short release."""
    return write(tmp_path / "campaign" / "one", SHORT)


@pytest.mark.parametrize(("old", "new", "key", "code"), CASES)
def test_a_mistake_is_one_sentence(folder, old, new, key, code, refused):
    edit(folder / "recording.toml", old, new)
    refusal = refused("step", folder, "-q")
    assert f"{code} " in refusal
    assert f"recording.toml: {key}: " in refusal
    assert not (folder / "step").exists()


def test_a_recording_without_outputs_is_refused(folder, refused):
    path = folder / "recording.toml"
    text = re.sub(r'quantity = "output"\nchannel = "F[xz]"', 'quantity = "voltage"', path.read_text(encoding="utf-8"))
    path.write_text(text, encoding="utf-8")
    refusal = refused("step", folder, "-q")
    assert f"{raised.MISSING_STEP_ENTRY.code} " in refusal
    assert ": daq.channel: " in refusal


def rewrite(folder: Path, change: object) -> None:
    """Change the samples of output Fz."""
    with h5py.File(folder / "daq.h5", "r+") as file:
        file["Fz"][...] = change(file["Fz"][()])


def test_records_without_a_step_or_clipped_are_named(folder, refused):
    rewrite(folder, lambda samples: np.clip(samples, -0.7e-4, None))
    refusal = refused("step", folder, "-q")
    assert f"{raised.DRIVEN_OUTPUT_CLIPPED.code} " in refusal
    assert ": daq.channel.Fz: " in refusal
    rng = np.random.default_rng(1)
    rewrite(folder, lambda samples: 1e-7 * rng.standard_normal(len(samples)))
    refusal = refused("step", folder, "-q")
    assert f"{raised.NO_STEP_FOUND.code} " in refusal
    assert ": daq.channel.Fz: " in refusal


def test_other_kinds_go_to_their_commands(folder, refused, capsys):
    for command in ("run", "transfer"):
        assert "shakercal step" in refused(command, folder, "-q")
    assert main(["check", str(folder), "-q"]) == 0
    assert "shakercal step" in capsys.readouterr().out
    path, noise = folder / "recording.toml", 'kind = "noise"\ndirection = [0, 0, 1]'
    text = re.sub(r'kind = "step".*?release = "fishing line"', noise, path.read_text(), flags=re.DOTALL)
    path.write_text(text, encoding="utf-8")
    refusal = refused("step", folder, "-q")
    assert f"{WRONG_EXCITATION_KIND.code} {path}: excitation.kind: " in refusal
    assert "noise" in refusal


def test_two_rigs_are_not_compared_and_a_measured_release_needs_a_force(folder, tmp_path, refused):
    refusal = refused("step", folder, "-q", "--release", "measured")
    assert f"{raised.MISSING_STEP_ENTRY.code} " in refusal
    assert ": excitation.force: " in refusal
    other = write(tmp_path / "other" / "two", SHORT)
    assert ": rig: " in refused("step", folder, other, "-q")


def test_what_does_not_oscillate_or_settle_has_no_model_and_the_reason_is_named(folder, refused):
    rng = np.random.default_rng(2)

    def ramp(samples: np.ndarray) -> np.ndarray:
        return np.where(np.arange(len(samples)) < 300, 1e-4, -1e-4) + 1e-6 * rng.standard_normal(len(samples))

    rewrite(folder, ramp)
    (folder / "chain.csv").write_text(CHAIN, encoding="utf-8")  # a warning that is not the reason
    edit(folder / "recording.toml", 'channel = "Fz"\n', 'channel = "Fz"\nresponse = "chain.csv"\n')
    refusal = refused("step", folder, "-q", "--release", "step", status=1)
    assert f"{raised.NO_STEP_MODEL.code} " in refusal
    reason = Notice(raised.RELEASE_WITHOUT_MODEL, "one", channel="Fz", reason="")
    assert reason.text.partition("(")[0] in refusal


def step_of(folder: Path) -> StepInput:
    return read_step(load_manifest(folder))


def test_a_record_has_its_outputs_on_one_time_base(tmp_path):
    folder = write(tmp_path / "one", SHORT, force=True)
    record = step_of(folder).record
    assert (record.name, record.channels, record.unit) == ("one", ("Fx", "Fz"), "V/V")
    assert (record.component, record.amplitude, record.release) == ("Fz", -100.0, "fishing line")
    assert record.force[:100].mean() == pytest.approx(100.0, rel=1e-3)
    with h5py.File(folder / "daq.h5") as file:
        assert np.array_equal(record.samples[1], file["Fz"][()])


def test_delays_of_channels_are_taken_off(tmp_path):
    folder, late = write(tmp_path / "one", SHORT, noise=0.0, cross=1.0), 3.4 / 50_000.0
    edit(folder / "recording.toml", 'channel = "Fz"\n', f'channel = "Fz"\ndelay = {late}\n')
    record = step_of(folder).record
    shifted = np.interp(record.time_s + late, record.time_s, record.samples[0])
    inside = slice(600, -100)
    assert record.samples[1][inside] == pytest.approx(shifted[inside], abs=2e-6)
    assert np.abs(record.samples[1] - record.samples[0])[inside].max() > 5e-6


def test_a_stated_chain_in_the_model_is_reported(folder):
    (folder / "chain.csv").write_text(CHAIN, encoding="utf-8")
    edit(folder / "recording.toml", 'channel = "Fz"\n', 'channel = "Fz"\nresponse = "chain.csv"\n')
    (notice,) = step_of(folder).notices
    assert (notice.code, notice.values) == (raised.CHAIN_IN_MODEL.code, {"channels": "Fz"})


def chained(folder: Path, *elements: tuple[int, float]) -> Path:
    """Return a recording whose driven output states low-pass filters of orders and corners."""
    text = "".join(
        f'[[element]]\nname = "f"\nfilter = "butterworth"\norder = {n}\ncorner = {hz}\n' for n, hz in elements
    )
    (folder / "chain.toml").write_text("format = 1\n" + text, encoding="utf-8")
    edit(folder / "recording.toml", 'channel = "Fz"\n', 'channel = "Fz"\nresponse = "chain.toml"\n')
    return folder


def test_a_stated_filter_without_a_lag_does_not_state_that_of_the_amplifier(tmp_path):
    both = step_of(chained(write(tmp_path / "both", TRUTH), (1, 6e3), (4, 10e3))).record
    assert both.lag_s == pytest.approx(1.0 / (2.0 * np.pi * 6e3), rel=1e-3)
    alone = step_of(chained(write(tmp_path / "alone", TRUTH), (4, 10e3))).record
    assert alone.lag_s is None
    delay_s = 2.6131 / (2.0 * np.pi * 10e3)  # sum of the filter's 1/Q over its corner, at low frequencies
    assert (both.delay_s, alone.delay_s) == (pytest.approx(delay_s, rel=0.03), pytest.approx(delay_s, rel=0.03))


def noticed(folder: Path) -> dict[str, Notice]:
    """Return the notices of an evaluation by code."""
    assert main(["step", str(folder), "-q"]) == 0
    with h5py.File(folder / "step" / "step.h5") as file:
        return {notice.code: notice for notice in read_notices(file)}


def test_the_delay_of_a_chain_is_outside_u_and_a_stated_one_leaves_the_quadrature_without(tmp_path):
    unknown = noticed(write(tmp_path / "one", TRUTH))[raised.CHAIN_DELAY_UNKNOWN.code]
    assert unknown.possible_size
    assert not unknown.is_listed
    # At resonance the phase falls by 2/(f ζ) over frequency, a delay by 2π.
    expected = 2.0 * np.pi * 1700.0 * 1e-5 * 0.5 * 1700.0 * TRUTH.damping_ratio * 2.0
    assert unknown.values["shift_hz"] == pytest.approx(expected, rel=0.2)
    found = noticed(chained(write(tmp_path / "two", TRUTH), (1, 6e3), (4, 10e3)))
    assert raised.CHAIN_DELAY_UNKNOWN.code not in found
    assert found[raised.CHAIN_DELAY_NOT_IN_MODEL.code].values["delay_us"] == pytest.approx(41.6, rel=0.03)
    assert np.isnan(number(tmp_path / "two", "indices.csv", "quadrature_hz")[1])
    assert number(tmp_path / "two", "indices.csv", "band_5_hz")[1] > 0.0


def test_several_takes_are_refused(folder):
    path = folder / "recording.toml"
    text = path.read_text(encoding="utf-8")
    head, blocks = text[: text.index("[[daq]]")], text[text.index("[[daq]]") :].replace("[[daq", "[[take.daq")
    blocks = blocks.replace('channel = "Fx"\n', 'channel = "Fx"\nreference = true\n')
    path.write_text(head + ("[[take]]\n" + blocks) * 2, encoding="utf-8")
    with pytest.raises(InputError) as caught:
        step_of(folder)
    assert (caught.value.file, caught.value.key) == (path, "take")
