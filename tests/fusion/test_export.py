"""`shakercal export`: results and records in universal files have the numbers of the results, read by pyuff."""

from __future__ import annotations

import re
from pathlib import Path

import h5py
import numpy as np
import pytest
import pyuff

from fusion import read_results
from fusion.cli import main
from fusion.report.recording_report import write_h5
from fusion.report.report_notices import NO_RESULTS
from fusion.sensitivity.analyse import Evaluation
from shaker import read_channels, read_universal_functions, read_universal_shapes

pytestmark = pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning")  # pyuff leaves files open
DEMO = Path(__file__).resolve().parents[2] / "sample_images" / "demo" / "Fz-0080"


@pytest.fixture(scope="module")
def results(demo_evaluation: Evaluation, tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("export")
    write_h5(folder / "result.h5", demo_evaluation, [])
    return folder


def test_sensitivities_are_frequency_responses_of_outputs_over_loads(results, tmp_path, capsys):
    file = tmp_path / "out.uff"
    assert main(["export", str(results), "-o", str(file)]) == 0
    assert re.search(r"\b12 \w+, 0 \w+, 7 ", capsys.readouterr().out)
    found = read_results(results)
    sets = [data for data in pyuff.UFF(str(file)).read_sets() if data["type"] == 58]
    by_name = {data["id1"]: data for data in sets}
    for of in (found.sensitivity, found.element):
        for e, (channel, component) in enumerate(zip(of.channel, of.component, strict=True)):
            data, known = by_name[f"{of.name}: output {channel} over load {component}"], np.isfinite(of.value[:, e])
            np.testing.assert_array_equal(data["data"], of.value[known, e])
            np.testing.assert_array_equal(data["x"], of.frequency_hz[known])
            assert (data["func_type"], data["ref_dir"], data["ref_node"]) == (4, 3, 1)
            assert data["ordinate_axis_units_lab"].strip() == "V/V"
            assert data["orddenom_axis_units_lab"].strip() == "N"
    assert main(["export", str(results), "-o", str(file)]) == 2
    assert "--force" in capsys.readouterr().err
    assert main(["export", str(tmp_path), "-o", str(tmp_path / "no.uff")]) == 2
    assert NO_RESULTS.code in capsys.readouterr().err
    assert not (tmp_path / "no.uff").exists()


def test_records_of_a_recording_are_time_responses_in_si(tmp_path):
    file = tmp_path / "records.uff"
    assert main(["export", str(DEMO), "-o", str(file)]) == 0
    raw = read_channels(DEMO / "bridge.h5")
    functions = {function.name: function for function in read_universal_functions(file)}
    for name in ("Fz", "Mx"):
        function, channel = functions[name], raw[name]
        scale = function.value[10] / channel.samples[10]
        assert np.allclose(function.value, scale * channel.samples, rtol=1e-12, atol=0.0)
        times = np.arange(len(channel.samples)) / channel.sample_rate_hz
        assert np.allclose(np.diff(function.abscissa), np.diff(times), rtol=1e-7)
        assert (function.kind, function.unit, function.abscissa_unit) == ("time response", "V/V", "s")
    assert functions["velocity_1"].response.endswith("+Z")
    sets = pyuff.UFF(str(file)).read_sets()
    (nodes,) = [data for data in sets if data["type"] == 2411]
    assert len(nodes["node_nums"]) == 4


def test_transfer_functions_and_shapes_of_an_element(tmp_path):
    frequency, value = 200.0 + np.arange(50.0), np.exp(1j * np.linspace(0.0, 3.0, 50))[:, None]
    with h5py.File(tmp_path / "transfer.h5", "w") as file:
        file.attrs["recording"] = "chirp"
        ratio = file.create_group("references/base/transfer/ratio")
        ratio.parent.attrs["reference"] = "base"
        ratio["frequency_hz"], ratio["value"] = frequency, value
        ratio["channels"], ratio["unit"] = ["top"], ["1"]
    assert main(["export", str(tmp_path), "-o", str(tmp_path / "t.uff"), "--text"]) == 0
    (function,) = read_universal_functions(tmp_path / "t.uff")
    assert (function.kind, function.name, function.titles[0]) == ("transmissibility", "top", "top over base")
    np.testing.assert_allclose(function.value, value[:, 0], rtol=1e-12, atol=1e-12)
    (tmp_path / "transfer.h5").unlink()
    motion = np.random.default_rng(3).standard_normal((12, 2))
    with h5py.File(tmp_path / "elastomer.h5", "w") as file:
        file.attrs["name"] = "cross"
        file["frame/node_m"], file["frame/node_motion"] = np.eye(3)[:2], motion
        file["frame/modes/frequency_hz"] = [310.0, 1250.5]
    assert main(["export", str(tmp_path), "-o", str(tmp_path / "s.uff")]) == 0
    shapes = read_universal_shapes(tmp_path / "s.uff")
    assert [shape.frequency_hz for shape in shapes] == [310.0, 1250.5]
    np.testing.assert_allclose(shapes[1].value, motion[:, 1].reshape(2, 6), rtol=1e-5)
