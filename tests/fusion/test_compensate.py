"""`shakercal compensate`: from models or numbers to filters, C code and filtered recordings; models in files."""

from __future__ import annotations

import json
import shutil
import subprocess
from dataclasses import replace
from importlib import import_module
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import h5py
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from page_outline import self_contained
from scipy.stats import binom
from support import block, channel, rows

from fusion.cli import main
from fusion.errors import InputError
from fusion.sensor import model_notices as raised
from fusion.sensor.compensate.compensation_evaluation import evaluate_compensation, white_noise
from fusion.sensor.compensate.compensation_report import header_text, json_text, read_compensation_filters
from fusion.sensor.compensate.compensation_subjects import CompensationSettings, read_sources
from fusion.sensor.model_files import (
    MODELS_FILE,
    ModelEntry,
    ModelsFile,
    UncertaintyBasis,
    model_text,
    models_text,
    read_models,
)
from shaker.compensation.filter import CompensationFilter
from shaker.lti.indices import LABELS, indices
from shaker.lti.system import ModalModel
from shaker.model_notices import FIGURES_NOT_LINEAR
from shaker.release.load_model import LoadModel

RATE = 50e3
GAIN = 2.0e-3
LOAD_MASS = 0.048
TWO_MASSES = LoadModel("Fy", "Fy", "V", 0.240, 2.36e6, 6.0, sensitivity=GAIN, covariance=np.diag([10.0, 1e-3]) ** 2)


def _mode(fn: float, zeta: float, gain: float) -> ModalModel:
    """One mode of a given static gain, with covariance."""
    omega = 2 * np.pi * fn
    upper = omega * (-zeta + 1j * np.sqrt(1 - zeta**2))
    residue = gain * omega**2 / (2j * upper.imag)
    spread = np.diag([0.01, 2e-6, 1e-6, 1e-6]) ** 2
    return ModalModel(np.array([fn]), np.array([zeta]), np.array([residue]), np.zeros(0), np.zeros(0), spread)


def _write_models(folder: Path) -> Path:
    folder.mkdir()
    entries = tuple(
        ModelEntry(name, component, "V", "pencil", model, RATE, 1e-4, "release-1")
        for name, component, model in (
            ("Fz", "Fz", _mode(500.0, 0.004, GAIN)),
            ("Fz", "Mx", _mode(700.0, 0.01, 5 * GAIN)),
            ("Mx", "Mx", _mode(900.0, 0.01, 0.1)),
        )
    )
    file = folder / "models.json"
    file.write_text(models_text(ModelsFile("bench", "sensor", "7", entries)), encoding="utf-8")
    return file


def _write_loads(folder: Path, *, with_covariance: bool = False) -> Path:
    """load.json of three masses, with a covariance on request."""
    folder.mkdir()
    covariance = np.diag([100.0, 0.01, 200.0, 0.05]) ** 2 if with_covariance else None
    model = LoadModel(
        "Fy", "Fy", "V", 0.240, 2.36e6, 6.0, 1.89e6, 4.0, GAIN,
        covariance=covariance, load_masses=(0.0, 0.048, 0.198),
    )  # fmt: skip
    file = folder / "load.json"
    file.write_text(model_text([(model, UncertaintyBasis())], "bench", "sensor", "shakercal"), encoding="utf-8")
    return file


def _write_recording(folder: Path) -> None:
    """A release of 40 N from a sensor of two masses."""
    time = np.arange(5000) / RATE
    clean = 0.3 - 40.0 * TWO_MASSES.system(LOAD_MASS).step(time - 0.02)
    noisy = clean + np.random.default_rng(4).normal(scale=2e-5, size=len(time))
    folder.mkdir(parents=True)
    np.savetxt(folder / "daq.csv", np.stack([time, noisy], axis=1), delimiter=",", header="time,Fy", comments="")
    sensor = {"name": "sensor", "channels": ["Fy"], "unit": "V", "sense": "on_load", "internal_mass": 0.24}
    load = {"mass": LOAD_MASS, "centre_of_mass": [0, 0, 0.01], "inertia": (1e-6 * np.eye(3)).tolist()}
    rig = block(format=1, name="bench") + block("sensor", **sensor) + block("load", **load)
    (folder / "rig.toml").write_text(rig, encoding="utf-8")
    step = block("excitation", kind="step", component="Fy", step_amplitude=-40.0)
    daq = block("[daq]", name="a", file="daq.csv") + channel("Fy", "output", channel="Fy")
    head = block(format=1, name="release", rig="rig.toml")
    (folder / "recording.toml").write_text(head + step + daq, encoding="utf-8")


def test_the_published_case_from_numbers(tmp_path, capsys):
    out = tmp_path / "out"
    arguments = ["--sensor-frequency", "500", "--sensor-damping", "0.004", "--frequency", "1000", "--damping", "0.5"]
    assert main(["compensate", *arguments, "-o", str(out)]) == 0
    printed = capsys.readouterr().out
    for before, after in (("98.751 %", "16.303 %"), ("150.76 Hz", "472.77 Hz"), ("311.03 ms", "1.2854 ms")):
        assert f": {before} -> {after}" in printed
    assert sorted(path.name for path in out.iterdir()) == [
        "compensate.csv", "compensate.h5", "compensate.html", "compensation.h", "compensation.json",
    ]  # fmt: skip
    found = {row["name"]: row for row in rows(out / "compensate.csv")}
    assert float(found["after_band_10_hz"]["value"]) == pytest.approx(472.8, abs=0.05)
    assert found["after_band_10_hz"]["unit"] == "Hz"
    page = (out / "compensate.html").read_text(encoding="utf-8")
    self_contained(page)
    assert "16.303" in page


@pytest.mark.usefixtures("no_pages")
def test_models_of_a_step_campaign(tmp_path):
    """One filter per channel, by the model of its own component, in the units of that model."""
    out = tmp_path / "out"
    models = _write_models(tmp_path / "step")
    assert main(["compensate", str(models.parent), "--bandwidth", "1200", "--calibrated", "-o", str(out)]) == 0
    filters = {(one.channel, one.component): one for one in read_compensation_filters(out)}
    assert list(filters) == [("Fz", "Fz"), ("Mx", "Mx")]
    found = filters["Fz", "Fz"].sections
    assert found.sample_rate_hz == RATE
    assert found.gain == pytest.approx(1.0 / GAIN, rel=1e-9)
    content = json.loads((out / "compensation.json").read_text(encoding="utf-8"))["filters"][0]
    assert (content["input_unit"], content["output_unit"]) == ("V", "N")
    assert content["sensor"]["u"][0] == pytest.approx(0.01, rel=1e-3)
    with h5py.File(out / "compensate.h5") as file:
        gain = file["filters/Fz/before"][:] * file["filters/Fz/filter"][:]
        hertz = file["filters/Fz/frequency_hz"][:]
        assert np.max(np.abs(np.abs(gain[hertz < 1200.0]) - 1.0)) < 0.1
        assert np.all(file["filters/Fz/u_gain"][:] >= 0)


@pytest.mark.usefixtures("no_pages")
def test_a_filter_for_every_load_of_one_target(tmp_path, capsys):
    out, loads = tmp_path / "out", _write_loads(tmp_path / "load", with_covariance=True)
    options = ["--frequency", "1000", "--damping", "0.5", "--modes", "2", "--load-mass", "0", "0.198"]
    assert main(["compensate", str(loads), *options, "-o", str(out)]) == 0
    found = read_compensation_filters(out)
    assert [one.load_mass for one in found] == [0.0, 0.198]
    assert {len(one.sections.sos) for one in found} == {2}
    assert "Fy, load 198 g" in capsys.readouterr().out
    with h5py.File(out / "compensate.h5") as file:
        ringing = file["filters/Fy, load 0 g/load_ringing"][:]
    assert np.all(np.diff(ringing) > 0)


def test_force_feedback_with_and_without_the_load(tmp_path, refused):
    options = {"frequency_hz": 1000.0, "modes": 2, "load_masses": (0.198,), "sample_rate_hz": 20e3}
    settings = CompensationSettings(**options, ball_stiffness=1000.0)
    found = evaluate_compensation(read_sources([_write_loads(tmp_path / "load")]), settings, None, {})
    gains = {case.name: case.largest_gain for case in found.haptics.cases}
    assert gains["filter for 198 g"] > 10 * max(gains["no filter"], gains["filter for no load"])
    assert f"{OPTION} " in refused("compensate", *NUMBERS, "--frequency", "900", "--ball", "1000")


def test_one_mode_of_two_is_reported(tmp_path):
    sources, options = (
        read_sources([_write_loads(tmp_path / "load")]),
        CompensationSettings(frequency_hz=1000.0, load_masses=(0.198,)),
    )
    found = evaluate_compensation(sources, options, None, {})
    (notice,) = (notice for notice in found.notices if notice.code == raised.MODE_NOT_COMPENSATED.code)
    assert notice.values["share_percent"] > 1.0


@pytest.mark.usefixtures("no_pages")
def test_a_recording_is_filtered_for_the_load_of_its_rig(tmp_path):
    """The record of a sensor that rings comes out as the step of the target, within its uncertainty."""
    file, out = tmp_path / "load.json", tmp_path / "out"
    file.write_text(model_text([(TWO_MASSES, UncertaintyBasis())], "bench", "sensor", "shakercal"), encoding="utf-8")
    _write_recording(tmp_path / "release")
    options = ["--frequency", "1000", "--damping", "0.6", "--calibrated", "--apply", str(tmp_path / "release")]
    assert main(["compensate", str(file), *options, "-o", str(out)]) == 0
    assert read_compensation_filters(out)[0].load_mass == LOAD_MASS
    table = np.genfromtxt(out / "compensated.csv", delimiter=",", names=True)
    omega, since = 2 * np.pi * 1000.0, np.maximum(table["time_s"] - 0.02, 0.0)
    swing = np.cos(0.8 * omega * since) + 0.75 * np.sin(0.8 * omega * since)  # of ζ = 0.6: √(1 - ζ²) = 0.8
    aim = 0.3 / GAIN - 40.0 * (1.0 - np.exp(-0.6 * omega * since) * swing)
    late = np.abs(table["time_s"] - 0.02) > 1.5e-4
    deviation = np.abs(table["Fy"] - aim)[late]
    assert np.mean(deviation < table["U_Fy"][late]) > 0.93
    assert np.max(np.abs(table["Fy"][table["time_s"] > 0.03] - aim[-1])) < 0.4
    with h5py.File(out / "compensate.h5") as file:
        assert file["compensated/Fy"].attrs["unit"] == "N"
        np.testing.assert_array_equal(file["compensated/Fy/value"][:], table["Fy"])


def test_noise_by_third_differences_is_that_of_the_samples():
    rng = np.random.default_rng(2)
    slow = np.sin(2 * np.pi * 50.0 * np.arange(20_000) / RATE)
    assert white_noise(slow + rng.normal(scale=0.01, size=20_000)) == pytest.approx(0.01, rel=0.03)


PROGRAM = """
#include <stdio.h>
#include "compensation.h"
int main(void)
{
    shakercal_filter filter;
    double value;
    int place = 0;
    if (scanf("%la", &value) != 1) return 1;
    shakercal_start(&filter, &compensate_Fy, 0, value);
    do {
        if (place++ == 300) shakercal_switch(&filter, 1);
        printf("%a\\n", shakercal_step(&filter, value));
    } while (scanf("%la", &value) == 1);
    return 0;
}
"""


def test_the_c_header_gives_the_same_bits(tmp_path):
    """Compiled and run beside the program's own filter, with a switch of the load on the way."""
    compiler = shutil.which("cc")
    if compiler is None:
        pytest.skip("no C compiler (cc) on this machine")
    out = tmp_path / "out"
    out.mkdir()
    options = CompensationSettings(
        frequency_hz=1000.0, damping_ratio=0.5, modes=2, load_masses=(0.0, 0.198), calibrated=True
    )
    evaluation = evaluate_compensation(read_sources([_write_loads(tmp_path / "load")]), options, None, {})
    (out / "compensation.h").write_text(header_text(evaluation), encoding="utf-8")
    (out / "compensation.json").write_text(json_text(evaluation), encoding="utf-8")
    (out / "main.c").write_text(PROGRAM, encoding="utf-8")
    flags = ["-std=c99", "-O2", "-ffp-contract=off", "-Wall", "-Wextra", "-Werror", "-o", str(out / "run")]
    subprocess.run([compiler, *flags, str(out / "main.c")], check=True)
    data = 5.0 + np.random.default_rng(9).normal(size=700).cumsum()
    text = "\n".join(value.hex() for value in data.tolist())
    output = subprocess.run([str(out / "run")], input=text, capture_output=True, text=True, check=True).stdout
    in_c = np.array([float.fromhex(line) for line in output.split()])
    first, second = (one.sections for one in read_compensation_filters(out))
    stream = CompensationFilter(first, level=None)
    before = stream(data[None, :300])
    stream.switch(second)
    in_python = np.concatenate([before, stream(data[None, 300:])], axis=1)[0]
    np.testing.assert_allclose(in_c, in_python, rtol=1e-14, atol=1e-12 * np.max(np.abs(in_python)))
    if "x86_64" in subprocess.run(["uname", "-m"], capture_output=True, text=True, check=True).stdout:
        np.testing.assert_array_equal(in_c, in_python)


NUMBERS = ["--sensor-frequency", "500", "--sensor-damping", "0.004"]


OPTION = raised.WRONG_COMPENSATION_OPTION.code


@pytest.mark.parametrize(
    ("arguments", "code", "found"),
    [
        (NUMBERS, OPTION, "--bandwidth"),
        ([*NUMBERS, "--frequency", "900", "--bandwidth", "900"], OPTION, "--bandwidth"),
        ([*NUMBERS, "--bandwidth", "900", "--damping", "0.5"], OPTION, "--damping: "),
        (["--frequency", "900"], OPTION, "models.json"),
        ([*NUMBERS[:2], "--sensor-damping", "1.5", "--frequency", "900"], OPTION, "--sensor-damping: "),
        (
            [*NUMBERS, "--frequency", "900", "--sample-rate", "1000"],
            raised.FILTER_REFUSED.code,
            "--sample-rate (sensor): ",
        ),
        ([*NUMBERS, "--frequency", "900", "--permitted-error", "200"], OPTION, "--permitted-error: "),
        ([*NUMBERS, "--frequency", "900", "--channel", "Fq"], OPTION, "Fq"),
        ([*NUMBERS, "--frequency", "900", "--load-mass", "0.1"], OPTION, "0.1 kg"),
        ([*NUMBERS, "--frequency", "900", "--modes", "2"], raised.FILTER_REFUSED.code, "--modes (sensor): "),
        (["nowhere", "--frequency", "900"], "", "nowhere"),
    ],
)
def test_bad_input_is_one_sentence(arguments, code, found, refused):
    refusal = refused("compensate", *arguments)
    assert f"{code} " in refusal
    assert found in refusal


def test_bad_files_are_one_sentence(tmp_path, refused):
    empty, broken, loads = tmp_path / "empty", tmp_path / "broken.json", _write_loads(tmp_path / "load")
    empty.mkdir()
    broken.write_text('{"models": 3}', encoding="utf-8")
    _write_recording(tmp_path / "release")
    both = ["--load-mass", "0", "0.1", "--apply", tmp_path / "release", "-o", tmp_path / "out"]
    for path, more, code in (
        (empty, [], raised.NO_MODEL_FILE.code),
        (broken, [], raised.DAMAGED_MODEL_FILE.code),
        (loads, ["--real-pole", "9000"], f"{OPTION} shakercal compensate: --real-pole:"),
        (loads, both, f"{OPTION} shakercal compensate: --load-mass:"),
        (_write_models(tmp_path / "step"), ["--modes", "2"], raised.FILTER_REFUSED.code),
    ):
        assert f"{code} " in refused("compensate", path, "--frequency", "900", *more)
    for read, again in (
        (read_compensation_filters, "`shakercal compensate`"),
        (lambda path: read_sources([path]), "`shakercal step` or `shakercal load`"),
    ):
        with pytest.raises(InputError) as caught:
            read(broken)
        assert (caught.value.code, caught.value.values["to_repeat"]) == (raised.DAMAGED_MODEL_FILE.code, again)


SIZES = st.tuples(st.integers(1, 3), st.integers(0, 2))


def random_model(modes: int, reals: int, rng: np.random.Generator) -> ModalModel:
    """A stable model with a full covariance."""
    half = rng.standard_normal((4 * modes + 2 * reals,) * 2)
    return ModalModel(
        frequency_hz=100.0 * np.cumsum(1.0 + rng.random(modes)),
        damping_ratio=rng.uniform(1e-4, 0.9, modes),
        residue=rng.standard_normal(modes) + 1j * rng.standard_normal(modes),
        real_hz=1e3 * np.cumsum(1.0 + rng.random(reals)),
        real_residue=rng.standard_normal(reals),
        covariance=half @ half.T,
    )


def entry(model: ModalModel, channel: str = "Fz", component: str = "Fz") -> ModelEntry:
    """One entry of a file."""
    return ModelEntry(channel, component, "V/V", "pencil", model, 1e5, 3.3e-7, "a, b", 2.0)


@settings(max_examples=15, deadline=None)
@given(SIZES, st.integers(0, 2**32 - 1))
def test_model_is_read_back_to_the_last_bit(sizes, seed):
    model = random_model(*sizes, np.random.default_rng(seed))
    file = ModelsFile("campaign µ", "sensor", "7", (entry(model), entry(model, "Fx")))
    with TemporaryDirectory() as folder:
        (Path(folder) / MODELS_FILE).write_text(models_text(file), encoding="utf-8")
        back = read_models(Path(folder))
    assert (back.name, back.sensor, back.serial) == ("campaign µ", "sensor", "7")
    found = back["Fz", "Fz"]
    assert np.array_equal(found.model.vector, model.vector)
    assert np.array_equal(found.model.covariance, np.asarray(model.covariance))
    assert (found.unit, found.method, found.sample_rate_hz, found.noise) == ("V/V", "pencil", 1e5, 3.3e-7)
    assert (found.recording, found.dof) == ("a, b", 2.0)
    assert [(one.channel, one.component) for one in back] == [("Fz", "Fz"), ("Fx", "Fz")]
    assert [one.channel for one in back.driven] == ["Fz"]
    with pytest.raises(ValueError, match=r"^key: .*Fz.*Fx.*Mx"):
        back["Mx", "Mx"]


def test_poles_zeros_and_gain_for_other_programs_are_those_of_the_model():
    model = random_model(2, 1, np.random.default_rng(3))
    item = json.loads(models_text(ModelsFile("c", "", "", (entry(model),))))["models"][0]
    zeros, poles = (np.array([complex(*root) for root in item[name]]) for name in ("zeros", "poles"))
    s = 2j * np.pi * np.array([0.0, 37.0, 210.0, 900.0])
    by_roots = item["gain"] * np.prod(s[:, None] - zeros, axis=1) / np.prod(s[:, None] - poles, axis=1)
    assert by_roots == pytest.approx(model.response(s.imag / (2 * np.pi)), rel=1e-8)
    assert item["static_gain"] == model.static_gain


def without(*keys: Any) -> dict[str, Any]:
    """A good file without one entry."""
    model = random_model(1, 1, np.random.default_rng(2))
    content: dict[str, Any] = json.loads(models_text(ModelsFile("c", "", "", (entry(model),))))
    table: Any = content
    for key in keys[:-1]:
        table = table[key]
    del table[keys[-1]]
    return content


@pytest.mark.parametrize(
    ("content", "declared", "found"),
    [
        (None, None, ""),
        (without("models"), raised.DAMAGED_MODEL_FILE, "'models'"),
        (without("models", 0, "modes", 0, "damping_ratio"), raised.DAMAGED_MODEL_FILE, "'damping_ratio'"),
        ({**without("name"), "format": 2, "name": "c"}, raised.WRONG_MODEL_FORMAT, "2"),
        (without("models", 0, "covariance", 0), raised.DAMAGED_MODEL_FILE, "(6, 6)"),
        ([], raised.DAMAGED_MODEL_FILE, "str"),
    ],
)
def test_an_unreadable_file_is_named(tmp_path, content, declared, found):
    path = tmp_path / MODELS_FILE
    if content is not None:
        path.write_text(json.dumps(content), encoding="utf-8")
    with pytest.raises(InputError) as caught:
        read_models(tmp_path)
    assert caught.value.file == path
    assert declared is None or caught.value.code == declared.code
    assert declared is None or found in caught.value.values["found"]


@pytest.mark.parametrize(("times", "count"), [(1.0, 60), pytest.param(10.0, 200, marks=pytest.mark.slow)])
def test_u_of_figures_includes_all_poles_and_zeros(tmp_path, times, count):
    # Truth: indices of models drawn from the covariance, through the filter that was made for the one found.
    spread = times * np.array([1e-3, 2e-6, 0.05, 0.05, 6.0, 0.04])
    mode = _mode(500.0, 0.02, GAIN)
    model = ModalModel(
        *mode.vector[:2].reshape(2, 1), mode.residue, np.array([3000.0]), np.array([4.0]), np.diag(spread**2)
    )
    file = tmp_path / "models.json"
    file.write_text(models_text(ModelsFile("bench", "sensor", "7", (entry(model),))), encoding="utf-8")
    found = evaluate_compensation(
        read_sources([file]), CompensationSettings(frequency_hz=1000.0, damping_ratio=0.5), None, {}
    )
    ((made,),) = (subject.filters for subject in found.subjects)
    rng, drawn = np.random.default_rng(8), []
    for vector in model.vector + spread * rng.normal(size=(count, len(spread))):
        sensor = model.with_vector(vector).system
        drawn.append([indices(one) for one in (sensor, sensor.times(made.compensation.system))])
    for stage, figures in enumerate((made.before, made.after)):
        for name in ("band_10_hz", "overshoot", "natural_hz"):
            u = figures.u[name]
            assert u is not None
            values = [one[stage].figures()[name] for one in drawn]
            value = figures.indices.figures()[name]
            assert times > 1.0 or u == pytest.approx(np.std(values), rel=3.0 / np.sqrt(2 * count)), (stage, name)
            assert np.sum(np.abs(np.array(values) - value) <= 2.0 * u) >= binom.ppf(1e-2, count, 0.954), (stage, name)


def test_a_band_that_a_peak_may_cut_short_is_covered(tmp_path):
    """Truth: sensors drawn from the covariance; the filter's gain may touch +10 %, where the band then ends."""
    mode = _mode(1700.0, 0.015, GAIN)
    omega, pole = 2 * np.pi * 1700.0, 2 * np.pi * 4900.0

    def drawn(lag_s: float) -> ModalModel:
        upper = omega * (-0.015 + 1j * np.sqrt(1 - 0.015**2))
        top = GAIN * omega**2 / lag_s
        residue, real = top / ((upper - upper.conjugate()) * (upper + 1 / lag_s)), top / abs(1 / lag_s + upper) ** 2
        lag_hz = np.array([1 / (2 * np.pi * lag_s)])
        return ModalModel(mode.frequency_hz, mode.damping_ratio, np.array([residue]), lag_hz, np.array([real]))

    u = 0.09 / pole
    model = drawn(1 / pole)
    slope = (drawn(1 / pole + 1e-3 * u).vector - drawn(1 / pole - 1e-3 * u).vector) / 2e-3
    model = replace(model, covariance=np.outer(slope, slope))
    file = tmp_path / "models.json"
    file.write_text(models_text(ModelsFile("bench", "sensor", "7", (entry(model),))), encoding="utf-8")
    found = evaluate_compensation(read_sources([file]), CompensationSettings(frequency_hz=2550.0), None, {})
    ((made,),) = (subject.filters for subject in found.subjects)
    value, u_value = made.after.indices.band_10_hz, made.after.u["band_10_hz"]
    lags = 1 / pole + u * np.random.default_rng(4).normal(size=60)
    ends = [indices(drawn(lag).system.times(made.compensation.system)).band_10_hz for lag in lags]
    assert value is not None
    assert u_value is not None
    assert np.mean(np.abs(np.array(ends, float) - value) < 2.0 * u_value) >= 0.9
    nonlinear = [notice for notice in found.notices if notice.code == FIGURES_NOT_LINEAR.code]
    stated = [notice.values["figures"] for notice in nonlinear if notice.where == "Fz, after the filter"]
    assert any(LABELS["band_10_hz"] in text for text in stated)


@pytest.mark.slow
def test_bands_and_overshoot_of_simulated_campaigns_agree_with_the_truth(monkeypatch):
    """Each of 12 figures per row is covered 95 times in 100: fewer than 10 occur by chance once in 50."""
    monkeypatch.syspath_prepend(str(Path(__file__).parents[2] / "benchmarks"))
    found = import_module("steps").errors_over_u
    ratio = np.abs(np.array([one for seed in (1, 3) for one in found(seed).values()]))
    assert ratio.shape == (12, 3, 2)
    assert np.min(np.sum(ratio <= 1.0, axis=0)) >= 10
