"""`fusion.read_results`: what the tables of a run say, as labelled arrays, pandas tables and xarray data sets."""

from __future__ import annotations

import csv
import importlib
import io
import shutil
from itertools import cycle
from pathlib import Path

import h5py
import numpy as np
import pytest
from contracts import refused
from recordings import make_once

from fusion import InputError, read_results
from fusion.campaign.joint_report import write_campaign
from fusion.report.h5 import h5_content, write_value
from fusion.report.recording_report import result_tables, write_h5
from fusion.report.report_notices import OTHER_FORMAT
from fusion.sensitivity.analyse import Evaluation


@pytest.fixture(scope="module")
def folder(demo_evaluation: Evaluation, tmp_path_factory: pytest.TempPathFactory) -> Path:
    def write(path: Path) -> Path:
        path.mkdir()
        for name, text in result_tables(demo_evaluation).items():
            (path / name).write_text(text)
        write_h5(path / "result.h5", demo_evaluation, [])
        return path

    return make_once(tmp_path_factory, "labelled", write)


def rows(path: Path) -> list[dict[str, str]]:
    with path.open(newline="") as file:
        return list(csv.DictReader(file))


def test_arrays_say_what_the_tables_say(folder):
    results = read_results(str(folder))
    for table, of in (("sensitivity.csv", results.sensitivity), ("load.csv", results.load)):
        column = "channel" if table == "sensitivity.csv" else "body"
        reported = [row for row in rows(folder / table) if row.get("kind") != "element"]
        assert len(reported) == np.isfinite(of.value).sum()
        for row in reported:
            k = int(np.argmin(np.abs(of.frequency_hz - float(row["frequency_hz"]))))
            e = of.elements.index(f"{row[column]}/{row['component']}")
            assert of.value[k, e] == complex(float(row["re"]), float(row["im"]))
            assert of.unit[e] == row["unit"]
            assert np.sqrt(of.covariance[k, e, e]) == pytest.approx(float(row["u_re"]), rel=1e-12)
            assert np.array_equal(of.of(row[column], row["component"]), of.value[:, e], equal_nan=True)
    assert {row["source"] for row in rows(folder / "acceleration.csv")} == {
        name.partition("-")[2] for name in results.acceleration
    }
    assert repr(results.load) == "load: load/Fz = (229.77 ± 0.16) N at 80.0002 Hz (k = 1.97); 6 elements at 3 lines"
    assert len(repr(results).splitlines()) == 1 + 3 + len(results.acceleration)


def test_pandas_has_the_rows_of_the_tables(folder):
    pytest.importorskip("pandas")
    frame = read_results(folder / "result.h5").load.to_dataframe()
    reported = rows(folder / "load.csv")
    assert len(frame) == len(reported)
    for name in ("frequency_hz", "re", "im", "u_re", "u_im", "r", "dof", "u_phase_rad", "dof_phase"):
        assert np.allclose(frame[name], [float(row[name]) for row in reported], rtol=1e-9)
    assert list(frame["component"]) == [row["component"] for row in reported]


def test_xarray_has_values_and_covariance_by_name(folder):
    pytest.importorskip("xarray")
    results = read_results(folder)
    data = results.sensitivity.to_xarray()
    with h5py.File(folder / "result.h5") as file:
        covariance = file["sensitivity/uncertainty/covariance"][()]
    found = data["covariance"].sel(row="Re Fz/Fz", column="Im Fz/Fz").to_numpy()
    assert np.allclose(found, covariance[:, 2, 8], rtol=1e-12)
    assert data["value"].attrs["units"] == "(V/V)/N"
    assert "units" not in results.load.to_xarray()["value"].attrs


def test_what_is_not_installed_is_said_in_one_sentence(folder, monkeypatch):
    def absent(name: str) -> None:
        raise ModuleNotFoundError(name)

    load = read_results(folder).load
    monkeypatch.setattr(importlib, "import_module", absent)
    refused("pip install pandas", load.to_dataframe, error=ImportError)
    refused("pip install xarray", load.to_xarray, error=ImportError)


def test_a_campaign_has_curves_and_the_rest_is_refused(folder, tmp_path):
    write_campaign(tmp_path, "one", [folder], {})
    results = read_results(tmp_path)
    assert (results.name, results.load, results.acceleration) == ("one", None, {})
    reported = [row for row in rows(tmp_path / "curve.csv") if row["kind"] == "ratio"]
    curve = next(curve for curve in results.curve if curve.kind[0] == "ratio")
    assert sorted(set(curve.channel)) == sorted({row["channel"] for row in reported})
    assert curve.of("Fz", "Fz")[0].real == pytest.approx(
        next(float(row["re"]) for row in reported if row["channel"] == "Fz"), rel=1e-12
    )
    refused("Mx", curve.of, "Fz", "Mx")
    refused("result.h5", read_results, tmp_path / "none", error=InputError)
    with h5py.File(tmp_path / "result.h5", "w") as file:
        file.attrs["format"] = 1
    error = refused(OTHER_FORMAT.code, read_results, tmp_path / "result.h5", error=InputError)
    assert (error.code, error.values["expected"]) == (OTHER_FORMAT.code, "2")


def test_files_of_other_commands_say_units_and_axes_as_far_as_names_tell():
    def fill(file):
        figures = file.create_group("figures")
        figures["value"], figures["u"], figures["dof"] = [1.0, 2.0], [0.1, 0.2], [9.0, np.inf]
        figures["unit"] = ["Hz", "1"]
        turned = file.create_group("turned")
        turned["reading"], turned["unit"] = np.ones((5, 2)), ["V/V", "V/V"]
        turned["load"], turned["loads"] = np.ones((5, 6)), np.ones(3)
        fit = file.create_group("fit")
        fit["time_s"], fit["fitted"], fit["value"] = np.arange(4.0), np.arange(4.0), np.ones(3)

    with h5py.File(io.BytesIO(h5_content(fill))) as file:
        reported = {name: file[name].attrs.get("units") for name in ("figures/value", "figures/u", "figures/dof")}
        assert reported == {"figures/value": "[unit]", "figures/u": "[unit]", "figures/dof": "1"}
        assert file["turned/reading"].attrs["units"] == "V/V"
        assert file["turned/load"].attrs["units"] == "[N, N, N, N.m, N.m, N.m]"
        assert "units" not in file["turned/loads"].attrs
        assert "units" not in file["fit/value"].attrs  # nothing says of which
        assert file["fit/fitted"].dims[0][0].name == "/fit/time_s"


AWKWARD = ("a/b", "a_b", "/", ".", "..", "a/", "uncertainty", "CON", "x" * 300)


def test_any_name_of_a_user_is_a_name_in_the_file():
    def fill(file):
        write_value(file, "by name", {name: {"value": np.arange(3.0)} for name in AWKWARD})
        for name in AWKWARD:
            file.create_group(file.free_name(name)).attrs["name"] = name

    with h5py.File(io.BytesIO(h5_content(fill))) as file:
        assert [group.attrs.get("label", name) for name, group in file["by name"].items()] == list(AWKWARD)
        assert all(group["value"][()].tolist() == [0.0, 1.0, 2.0] for group in file["by name"].values())
        assert [group.attrs["name"] for group in file.values() if "name" in group.attrs] == list(AWKWARD)


@pytest.mark.parametrize("part", ["covariance", "dof"])
@pytest.mark.parametrize("other", [h5py.Empty("f"), np.zeros(2, dtype=[("a", "f8")]), [b"x"], "nan"])
def test_numbers_of_another_kind_or_shape_are_refused_before_they_are_used(folder, tmp_path, part, other):
    path = tmp_path / "result.h5"
    shutil.copyfile(folder / "result.h5", path)
    with h5py.File(path, "a") as file:
        random = file["load/uncertainty/random"]
        group = next(group for group in random.values() if part in group)
        del group[part]
        group[part] = other
    refused(f"{path}: ", read_results, path, error=InputError)


def test_a_file_with_one_thing_changed_opens_or_is_refused_in_one_sentence(ready_evaluation, tmp_path):
    """Some groups and data sets are replaced in turn by a text, a number, an empty array or an empty group."""
    names: list[str] = []
    write_h5(tmp_path / "whole.h5", ready_evaluation, [])
    with h5py.File(tmp_path / "whole.h5") as file:
        file.visit(names.append)
    path = tmp_path / "result.h5"
    refusals = []
    for name, other in zip(names[::61], cycle(["a text", 3, np.zeros((2, 0, 5)), None]), strict=False):
        shutil.copyfile(tmp_path / "whole.h5", path)
        with h5py.File(path, "a") as file:
            del file[name]
            if other is None:
                file.create_group(name)
            else:
                file[name] = other
        try:
            assert read_results(path).name
        except InputError as error:
            refusals.append(error)
    assert len(refusals) > 3
    assert all(error.file == path and "\n" not in str(error) for error in refusals)
