"""Campaigns in object storage, databases and Zarr stores of results: broken transfers, queries by plain Python."""

from __future__ import annotations

import csv
import hashlib
import json
import math
import shutil
import statistics
import sys
import tempfile
import zipfile
from collections.abc import Callable, Iterator
from datetime import date, timedelta
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest
from support import edit, folder_contents, rows

from fusion.base import Settings
from fusion.campaign.run import run_path
from fusion.campaign.stored_campaign import SOURCE_FILE
from fusion.cli import main
from fusion.commands.options import EXIT_DONE, EXIT_INPUT
from fusion.errors import INVALID_OPTION, OUTPUT_FOLDER_MISSING, InputError
from fusion.report.object_store import ObjectStore
from fusion.report.report_notices import ARCHIVE_PACKAGES_MISSING, STORE_REFUSED, WRONG_CONDITION
from fusion.report.result_database import collect_results, query_results
from fusion.sensor.compare.comparison_inputs import read_compared
from fusion.sensor.compare.control_chart import control_charts
from fusion.sensor.result_notices import SAME_FILE

fsspec = pytest.importorskip("fsspec")
pytest.importorskip("pyarrow")
pytest.importorskip("duckdb")

NAMES = ["Fz 106,25 Hz – Prüfung", "Fz 375.90"]
IMAGE = f"{NAMES[0]}/top-left/0000.tif"


@pytest.fixture
def campaign(make_campaign: Callable[..., Path]) -> Path:
    """Two recordings of one rig; one name has blanks and an umlaut."""
    first = make_campaign()
    second = first.with_name(NAMES[1])
    shutil.copytree(first, second)
    edit(second / "recording.toml", 'name = "Fz 106.25 Hz"', 'name = "Fz 375.90 Hz"')
    return first.rename(first.with_name(NAMES[0])).parent


@pytest.fixture
def memory(campaign: Path) -> Iterator[Any]:
    """The campaign in a store in memory, at memory://bucket/campaign."""
    store = fsspec.filesystem("memory")
    for path in (path for path in campaign.rglob("*") if path.is_file()):
        store.pipe_file(f"/bucket/campaign/{path.relative_to(campaign).as_posix()}", path.read_bytes())
    yield store
    store.store.clear()
    store.pseudo_dirs[:] = [""]


@pytest.fixture(autouse=True)
def scratch(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The folder of temporary files."""
    folder = tmp_path / "scratch"
    folder.mkdir()
    monkeypatch.setattr(tempfile, "tempdir", str(folder))
    return folder


@pytest.fixture
def transfers(monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """Names of all fetched files."""
    names: list[str] = []
    fetch = ObjectStore.fetch

    def listed(store: ObjectStore, of: Any, folder: Path) -> None:
        of = list(of)
        names.extend(of)
        fetch(store, of, folder)

    monkeypatch.setattr(ObjectStore, "fetch", listed)
    return names


def _h5_numbers(path: Path) -> dict[str, Any]:
    """Every data set of a file."""
    found: dict[str, Any] = {}
    with h5py.File(path) as file:
        file.visititems(lambda name, item: found.update({name: item[()]}) if isinstance(item, h5py.Dataset) else None)
    return found


def test_a_stored_campaign_has_the_results_of_a_local_one(campaign, memory, evaluated, tmp_path, scratch):
    address = "memory://bucket/campaign"
    run_path(campaign, tmp_path / "local", Settings())
    assert main(["run", address, "-q"]) == EXIT_DONE
    memory.get("/bucket/campaign/results/", str(tmp_path / "stored"), recursive=True)
    local, stored = folder_contents(tmp_path / "local"), folder_contents(tmp_path / "stored")
    assert {name for name in stored if not name.endswith(SOURCE_FILE)} == set(local)
    tables = [name for name in local if name.endswith(".csv")]
    assert len(tables) >= 8
    assert {name: stored[name] for name in tables} == {name: local[name] for name in tables}
    for name in NAMES:
        here, there = (_h5_numbers(tmp_path / where / name / "result.h5") for where in ("local", "stored"))
        assert here.keys() == there.keys()
        for key, value in here.items():
            np.testing.assert_array_equal(value, there[key])
        with h5py.File(tmp_path / "stored" / name / "result.h5") as file:
            assert file.attrs["recording_path"] == f"{address}/{name}/recording.toml"
            inputs = zip(*(file[f"provenance/input_{key}"].asstr()[()] for key in ("file", "sha256")), strict=True)
            for path, digest in inputs:
                assert digest == hashlib.sha256((campaign / path).read_bytes()).hexdigest()
    assert list(scratch.iterdir()) == []


def test_only_changed_recordings_are_fetched_again(memory, evaluated, transfers):
    address = ["run", "memory://bucket/campaign", "-q"]
    assert main(address) == EXIT_DONE
    assert sorted(evaluated) == sorted(NAMES)
    assert IMAGE in transfers
    del evaluated[:], transfers[:]
    assert main(address) == EXIT_DONE
    assert evaluated == []
    assert not [name for name in transfers if name.endswith(".tif")]
    memory.pipe_file(f"/bucket/campaign/{IMAGE}", b"other")
    assert main(address) == EXIT_DONE
    assert evaluated == [NAMES[0]]
    del evaluated[:]
    memory.rm("/bucket/campaign/results/" + NAMES[1] + "/result.h5")
    assert main(address) == EXIT_DONE
    assert evaluated == [NAMES[1]]
    assert main([*address, "--force"]) == EXIT_DONE
    assert len(evaluated) == 3


def test_a_single_recording_needs_the_rig_above_it_and_nothing_else(memory, evaluated, transfers, tmp_path, capsys):
    command = ["run", f"memory://bucket/campaign/{NAMES[0]}", "-o", str(tmp_path / "here"), "--json", "-q"]
    assert main(command) == EXIT_DONE
    (recording,) = json.loads(capsys.readouterr().out)["recordings"]
    assert (recording["state"], recording["results"]) == ("evaluated", str(tmp_path / "here"))
    assert not [name for name in transfers if name.startswith(NAMES[1])]
    del transfers[:]
    assert main(command) == EXIT_DONE
    assert json.loads(capsys.readouterr().out)["recordings"][0]["state"] == "unchanged"
    assert not [name for name in transfers if name.endswith(".tif")]


@pytest.mark.parametrize("folder", ["", "camp/"])
def test_a_zip_is_read_and_refuses_results_before_the_evaluation(campaign, evaluated, tmp_path, refused, folder):
    file = tmp_path / "all in one.zip"
    with zipfile.ZipFile(file, "w") as packed:
        for path in campaign.rglob("*"):
            packed.write(path, f"{folder}{path.relative_to(campaign).as_posix()}")
    address = f"zip://{folder.rstrip('/')}::{file}" if folder else f"zip::{file}"
    assert STORE_REFUSED.code in refused("run", address)
    assert STORE_REFUSED.code in refused("run", f"zip://{file}")
    assert evaluated == []
    assert main(["run", address, "-q", "-o", str(tmp_path / "out")]) == EXIT_DONE
    assert sorted(evaluated) == sorted(NAMES)
    assert (tmp_path / "out" / NAMES[0] / "result.h5").is_file()
    assert main(["run", f"zip://{folder}{NAMES[0]}::{file}", "-q", "-o", str(tmp_path / "one")]) == EXIT_DONE
    assert (tmp_path / "one" / "result.h5").is_file()


def test_processes_share_stored_recordings(campaign, evaluated, tmp_path, monkeypatch):
    from cluster_factory import InlineExecutor

    monkeypatch.setattr("fusion.campaign.run.Workers", lambda size: InlineExecutor(size, waits=True))
    address = campaign.as_uri().replace("%20", " ")
    assert main(["run", address, "-q", "--workers", "2", "-o", f"{tmp_path.as_uri()}/out"]) == EXIT_DONE
    assert sorted(evaluated) == sorted(NAMES)
    assert {SOURCE_FILE, "result.h5"} < {path.name for path in (tmp_path / "out" / NAMES[0]).iterdir()}
    assert not list((tmp_path / "out").rglob("*.part"))


def test_a_vanished_object_fails_its_recording_only(memory, evaluated, monkeypatch, capsys, scratch):
    files, gone = ObjectStore.files, f"/bucket/campaign/{IMAGE}"

    def then_removed(store: ObjectStore) -> dict[str, str]:
        found = files(store)
        if memory.exists(gone):
            memory.rm(gone)
        return found

    monkeypatch.setattr(ObjectStore, "files", then_removed)
    assert main(["run", "memory://bucket/campaign", "-q"]) == EXIT_INPUT
    assert evaluated == [NAMES[1]]
    assert f"{NAMES[0]}: failed, {STORE_REFUSED.code} " in capsys.readouterr().out
    assert not memory.exists(f"/bucket/campaign/results/{NAMES[0]}")
    assert list(scratch.iterdir()) == []


def test_an_interrupted_upload_is_repeated(memory, evaluated, monkeypatch):
    write = ObjectStore.write

    def broken(store: ObjectStore, contents: dict[str, bytes]) -> None:
        if SOURCE_FILE in contents and store.name == NAMES[0]:
            raise InputError(STORE_REFUSED, "store", reason="connection lost")
        write(store, contents)

    monkeypatch.setattr(ObjectStore, "write", broken)
    address = ["run", "memory://bucket/campaign", "-q"]
    assert main(address) == EXIT_INPUT
    monkeypatch.setattr(ObjectStore, "write", write)
    del evaluated[:]
    assert main(address) == EXIT_DONE
    assert evaluated == [NAMES[0]]
    assert memory.exists(f"/bucket/campaign/results/{NAMES[0]}/{SOURCE_FILE}")


def test_places_that_cannot_be_used_are_refused_before_the_evaluation(memory, campaign, evaluated, refused):
    class ReadOnly(type(memory)):
        protocol = "readonly"

        def pipe_file(self, path: str, value: bytes, **_: Any) -> None:
            raise PermissionError(f"AccessDenied: {path}")

    fsspec.register_implementation("readonly", ReadOnly, clobber=True)
    assert STORE_REFUSED.code in refused("run", "readonly://bucket/campaign")
    secret = refused("run", "readonly://me:secret@bucket/campaign")
    assert "secret" not in secret
    assert "SC-905" in refused("run", str(campaign), "-o", "memory://bucket/out")
    assert "SC-" in refused("run", "memory://bucket/nothing", "-o", str(campaign / "out"))
    assert evaluated == []


def test_names_that_leave_the_folder_are_refused(monkeypatch, memory, tmp_path):
    store = ObjectStore("memory://bucket/campaign")
    monkeypatch.setattr(type(memory), "find", lambda *_, **__: {"/bucket/campaign/../../etc/passwd": {"size": 1}})
    with pytest.raises(InputError, match=STORE_REFUSED.code):
        store.files()


@pytest.mark.parametrize("concurrent", [False, True])
def test_names_are_no_patterns(memory, tmp_path, concurrent):
    store = ObjectStore("memory://bucket/names")
    if concurrent:  # as stores of the network are
        wrapper = pytest.importorskip("fsspec.implementations.asyn_wrapper").AsyncFileSystemWrapper
        store._fs = wrapper(memory, asynchronous=False)
    contents = {"a[1].txt": b"1", "Prüf[x]/b.txt": b"2", "a1.txt": b"3", "Prüfx/b.txt": b"4"}
    store.write(contents)
    assert store.files().keys() == contents.keys()
    store.fetch(["a[1].txt", "Prüf[x]/b.txt"], tmp_path / "here")
    assert folder_contents(tmp_path / "here") == {"a[1].txt": b"1", "Prüf[x]/b.txt": b"2"}
    assert store.read([*contents]) == contents
    store.remove(["Prüf[x]/b.txt"])
    assert store.files().keys() == contents.keys() - {"Prüf[x]/b.txt"}
    with pytest.raises(InputError, match=STORE_REFUSED.code):
        store.fetch(["gone"], tmp_path)


def test_missing_packages_are_named(monkeypatch, refused):
    monkeypatch.setitem(sys.modules, "fsspec", None)
    sentence = refused("run", "s3://bucket/campaign")
    assert ARCHIVE_PACKAGES_MISSING.code in sentence


def test_the_package_of_an_address_is_named(monkeypatch):
    monkeypatch.setitem(sys.modules, "s3fs", None)
    with pytest.raises(InputError, match=ARCHIVE_PACKAGES_MISSING.code) as caught:
        ObjectStore("s3://bucket/campaign")
    assert caught.value.values["packages"] == "s3fs"


# Databases of results.


def _copy(original: Path, folder: Path, factor: float = 1.0, **attrs: str) -> None:
    """Copy a result with magnitudes times a factor, other attributes, and inputs of its own unless `same_input`."""
    folder.mkdir(parents=True)
    shutil.copy(original / "result.h5", folder)
    with h5py.File(folder / "result.h5", "r+") as file:
        if attrs.pop("same_input", ""):
            file["provenance/versions"].attrs["shakercal"] = attrs.pop("program", "0.2.0")
        else:
            file["provenance/input_sha256"][0] = hashlib.sha256(str(folder).encode()).hexdigest()
        for name, value in attrs.items():
            file.attrs[name] = value
        file["sensitivity/value"][...] = file["sensitivity/value"][()] * factor
    table = rows(original / "sensitivity.csv")
    with (folder / "sensitivity.csv").open("w", encoding="utf-8", newline="") as file:
        writer = csv.DictWriter(file, table[0])
        writer.writeheader()
        writer.writerows(row | {"magnitude": repr(float(row["magnitude"]) * factor)} for row in table)


@pytest.fixture
def archive(campaign: Path, evaluated: list[str], tmp_path: Path) -> Path:
    """Four results of two days, in folders of several depths."""
    run_path(campaign, tmp_path / "run", Settings())
    original, top = tmp_path / "run" / NAMES[1], tmp_path / "archive"
    for number, day in enumerate(("2024-05-02", "2024-05-02", "2026-03-09", "2026-03-09")):
        place = top / f"Jahr {day[:4]}" / ("tief/er" if number % 2 else "") / f"Größe {number}"
        _copy(original, place, 1.0 + 1e-3 * number, date=day)
    return top


def _expected(archive: Path) -> dict[tuple[str, float, str, str], float]:
    """Magnitudes of all results by file, frequency, output and component, from the files."""
    found = {}
    for path in archive.rglob("result.h5"):
        with h5py.File(path) as file:
            part = file["sensitivity"]
            channels, value = part["channels"].asstr()[()], part["value"][()]
            for line, frequency in enumerate(part["frequency_hz"][()].tolist()):
                for c, j in part["elements"][()].tolist():
                    name, component = path.relative_to(archive).as_posix(), ("Fx", "Fy", "Fz", "Mx", "My", "Mz")[j]
                    found[name, frequency, channels[c], component] = abs(value[line, c, j])
    return {key: value for key, value in found.items() if math.isfinite(value)}


def _magnitudes(database: Path) -> dict[tuple[str, float, str, str], float]:
    selected = query_results(database, "kind <> 'element'")
    keys = [(row["path"], row["frequency_hz"], row["channel"], row["component"]) for row in selected]
    assert len(set(keys)) == len(keys)
    return dict(zip(keys, (row["magnitude"] for row in selected), strict=True))


def test_a_database_has_every_value_of_the_files_once(archive, tmp_path):
    database = tmp_path / "results.parquet"
    assert collect_results(archive, database).read == 4
    expected = _expected(archive)
    assert len(expected) > 4
    assert _magnitudes(database) == pytest.approx(expected)
    content = database.read_bytes()
    again = collect_results(archive, database)
    assert (again.read, again.unchanged) == (0, 4)
    assert database.read_bytes() == content
    _copy(archive / "Jahr 2024" / "Größe 0", archive / "new", 1.5)
    shutil.rmtree(archive / "Jahr 2026" / "Größe 2")
    assert collect_results(archive, database).read == 1
    assert _magnitudes(database) == pytest.approx(_expected(archive))


def test_u_and_units_are_those_of_the_table_of_the_run(archive, tmp_path):
    collect_results(tmp_path / "run", tmp_path / "results.parquet")
    table = [row for row in rows(tmp_path / "run" / NAMES[0] / "sensitivity.csv") if row["kind"] == "ratio"]
    found = query_results(tmp_path / "results.parquet", "kind = 'ratio' and recording = 'Fz 106.25 Hz'")
    assert len(table) == len(found) > 0
    by_element = {(row["channel"], row["component"]): row for row in found}
    for row in table:
        one = by_element[row["channel"], row["component"]]
        assert one["unit"] == row["unit"]
        for name in ("u_magnitude", "k_magnitude", "phase_rad", "u_phase_rad"):
            assert one[name] == pytest.approx(float(row[name]), rel=1e-9)


def test_a_damaged_result_is_reported_and_the_others_are_collected(archive, tmp_path, capsys):
    damaged = archive / "Jahr 2024" / "Größe 0" / "result.h5"
    damaged.write_bytes(damaged.read_bytes()[: damaged.stat().st_size // 2])
    database = tmp_path / "results.parquet"
    assert main(["collect", str(archive), "-o", str(database), "-q"]) == EXIT_INPUT
    with pytest.raises(InputError, match=OUTPUT_FOLDER_MISSING.code):
        collect_results(tmp_path / "absent", database)
    assert "Jahr 2024/Größe 0/result.h5" in capsys.readouterr().err
    assert len({row["path"] for row in query_results(database)}) == 3


def test_a_store_is_collected_as_its_folder(archive, tmp_path, memory):
    memory.put(str(archive), "/results", recursive=True)
    for place, name in ((archive, "local.parquet"), ("memory://results", "stored.parquet")):
        collect_results(place, tmp_path / name)
    assert _magnitudes(tmp_path / "local.parquet") == _magnitudes(tmp_path / "stored.parquet")
    with pytest.raises(InputError, match="SC-900"):
        collect_results(archive, tmp_path / "stored.parquet")


def test_a_file_of_another_type_is_not_written(archive, tmp_path, refused):
    for suffix in (".csv", ".zip", ""):
        file = tmp_path / f"other{suffix}"
        with pytest.raises(SystemExit):
            main(["collect", str(archive), "-o", str(file)])
        assert INVALID_OPTION.code in refused("export", str(archive / "Jahr 2024" / "Größe 0"), "-o", str(file))
        assert not file.exists()


def test_copies_count_once_and_the_newest_version_of_a_recording_is_used(archive, tmp_path):
    original = archive / "Jahr 2024" / "Größe 0"
    shutil.copytree(original, archive / "copy of it")
    _copy(original, archive / "older", 2.0, same_input="yes", program="0.1.10")
    _copy(original, archive / "oldest", 3.0, same_input="yes", program="0.1.9")
    database = tmp_path / "results.parquet"
    found = collect_results(archive, database)
    assert (found.read, found.copies) == (6, 1)
    assert len({row["path"] for row in query_results(database)}) == 4
    assert {row["path"] for row in query_results(database, "program < '0.2'")} == {"older/result.h5"}


def test_wrong_conditions_are_refused(archive, tmp_path):
    collect_results(archive, tmp_path / "results.parquet")
    for condition in ("nofield = 1", "1 = 1) union (select", "channel", "1=1); select (1", "", "serial = '1", "1 /* 2"):
        with pytest.raises(InputError, match=WRONG_CONDITION.code) as caught:
            query_results(tmp_path / "results.parquet", condition)
        assert "partition" not in str(caught.value)  # part of the query around the condition


def test_compare_takes_means_of_selected_rows(archive, tmp_path, refused, capsys):
    database = tmp_path / "results.parquet"
    collect_results(archive, database)
    queries = {str(year): f"{database}?channel = 'Fz' and year(date) = {year}" for year in (2024, 2026)}
    for result, year in zip(read_compared(queries), (2024, 2026), strict=True):
        (value,) = (value for value in result.values if value.component == "Fz")
        every = query_results(database, "channel = 'Fz' and component = 'Fz' and kind = 'ratio'")
        used = [row for row in every if row["date"].year == year]
        magnitudes = [row["magnitude"] for row in used]
        assert len(used) == result.repeats == 2
        assert value.magnitude == pytest.approx(statistics.mean(magnitudes))
        stated = statistics.mean(row["u_magnitude"] * max(row["k_magnitude"] / 2.0, 1.0) for row in used)
        expected = math.hypot(stated, statistics.stdev(magnitudes) / math.sqrt(2))
        assert value.u_magnitude == pytest.approx(expected)
        assert int(value.year) == year
    arguments = [f"{name}={query}" for name, query in queries.items()]
    assert main(["compare", *arguments, "-o", str(tmp_path / "comparison"), "-q"]) == EXIT_DONE
    for other, warned in ((arguments[1], False), (f"every={database}?channel = 'Fz'", True)):
        capsys.readouterr()
        assert main(["compare", arguments[0], other, "-o", str(tmp_path / "json"), "--force", "--json"]) == EXIT_DONE
        codes = [notice["code"] for notice in json.loads(capsys.readouterr().out)["notices"]]
        assert (SAME_FILE.code in codes) == warned
    with (tmp_path / "comparison" / "comparison.csv").open(encoding="utf-8") as file:
        assert {row["channel"] for row in csv.DictReader(file)} == {"Fz"}
    assert WRONG_CONDITION.code in refused("compare", f"a={database}?serial = 'none'", arguments[0])
    with h5py.File(archive / "Jahr 2024" / "Größe 0" / "result.h5", "r+") as file:
        file["sensor"].attrs["serial"] = "another"
    collect_results(archive, database)
    assert WRONG_CONDITION.code in refused("compare", *arguments)


def test_xarray_opens_a_zarr_store_with_the_numbers_of_the_results(archive, tmp_path):
    zarr, xarray = pytest.importorskip("zarr"), pytest.importorskip("xarray")
    store, folder = tmp_path / "result.zarr", archive / "Jahr 2024" / "Größe 0"
    assert main(["export", str(folder), "-o", str(store)]) == EXIT_DONE
    before = folder_contents(store)
    assert main(["export", str(folder), "-o", str(store)]) == EXIT_INPUT
    assert main(["export", str(folder), "-o", str(store), "--force"]) == EXIT_DONE
    assert folder_contents(store) == before
    with h5py.File(folder / "result.h5") as file:
        part, load = file["sensitivity"], file["load/value"][()]
        value, covariance = part["value"][()], part["uncertainty/covariance"][()]
        elements = part["elements"][()].tolist()
    with xarray.open_zarr(store, group="sensitivity", consolidated=False) as opened:
        np.testing.assert_array_equal(opened["value"], np.stack([value[:, c, j] for c, j in elements], axis=1))
        np.testing.assert_array_equal(opened["covariance"], covariance)
        assert opened["unit"].values.tolist()[2] == "(V/V)/N"
    with xarray.open_zarr(store, group="load", consolidated=False) as opened:
        seen = np.isfinite(opened["value"].values)
        np.testing.assert_array_equal(opened["value"].values[seen], load[seen])
    assert zarr.open_group(store, mode="r").attrs["name"]


# Control charts.


def _row(day: date, magnitude: float, frequency: float = 80.0, **more: Any) -> dict[str, Any]:
    facts = {"serial": "1", "channel": "Fz", "component": "Fz", "kind": "element", "unit": "(V/V)/N"}
    numbers = {
        "frequency_hz": frequency,
        "magnitude": magnitude,
        "u_magnitude": 0.5,
        "phase_rad": 3.1,
        "u_phase_rad": 0.1,
    }
    return facts | numbers | {"date": day} | more


def test_limits_are_those_of_the_moving_range():
    days = [date(2024, 1, 1) + timedelta(days=30 * number) for number in range(5)]
    found = [_row(day, value) for day, value in zip(days, (10.0, 12.0, 11.0, 13.0, 10.0), strict=True)]
    found += [_row(days[0], 10.0, phase_rad=3.1 - 2.0 * math.pi), _row(days[1], 9.0, kind="harmonic")]
    found += [_row(days[0], 7.0, 80.1), _row(days[1], 7.0, 80.1)]
    magnitude, phase = control_charts(reversed(found))
    assert magnitude.days == tuple(days)
    assert magnitude.centre == pytest.approx(11.2)
    assert 3.0 * magnitude.sigma == pytest.approx(2.66 * statistics.mean([2.0, 1.0, 2.0, 3.0]), rel=1e-3)
    assert not magnitude.outside.any()
    assert phase.sigma == pytest.approx(0.0, abs=1e-12)


def test_equal_values_are_within_the_limits():
    days = [date(2024, 1, 1) + timedelta(days=number) for number in range(3)]
    for value in (0.1, 2.7e-10):  # whose computed means differ from them
        charts = control_charts(_row(day, value, phase_rad=0.1) for day in days)
        assert not any(chart.outside.any() for chart in charts)
    changed = [_row(day, value) for day, value in zip(days, (1.0, 1.0, 1.0 + 1e-9), strict=True)]
    assert not control_charts(changed)[0].outside.any()
    assert control_charts(changed, 2)[0].outside.tolist() == [False, False, True]


def test_days_of_a_stable_sensor_are_rarely_beyond_the_limits_and_a_change_is():
    rng = np.random.default_rng(1)
    values = 100.0 + rng.standard_normal(4000)
    values[2000] += 8.0
    days = [date(2000, 1, 1) + timedelta(days=number) for number in range(len(values))]
    chart = control_charts(_row(day, value) for day, value in zip(days, values.tolist(), strict=True))[0]
    assert chart.sigma == pytest.approx(1.0, abs=0.06)
    assert chart.outside[2000]
    shifted = np.where(np.arange(len(values)) < 1000, values, values + 8.0)
    rows_of = [_row(day, value) for day, value in zip(days, shifted.tolist(), strict=True)]
    later = control_charts(rows_of, 1000)[0].outside[1000:]
    assert later.mean() > 0.99
    assert 1 <= np.count_nonzero(chart.outside) - 1 <= 24  # 10.8 expected, normal distribution


def test_charts_are_drawn_from_a_database(archive, tmp_path, refused):
    _copy(archive / "Jahr 2024" / "Größe 0", archive / "third", 1.01, date="2025-01-07")
    database = tmp_path / "results.parquet"
    collect_results(archive, database)
    query = f"{database}?channel = 'Fz' and component = 'Fz'"
    figure, table = tmp_path / "chart.svg", tmp_path / "chart.csv"
    assert main(["chart", query, "--figure", str(figure), "--csv", str(table)]) == EXIT_DONE
    assert figure.stat().st_size > 1000
    found = [row for row in rows(table) if row["chart"].endswith("magnitude")]
    assert [row["date"] for row in found] == ["2024-05-02", "2025-01-07", "2026-03-09"]
    every = query_results(database, "channel = 'Fz' and component = 'Fz' and kind = 'ratio'")
    used = [row for row in every if row["date"].year == 2024]
    assert float(found[0]["value"]) == pytest.approx(statistics.mean(row["magnitude"] for row in used))
    assert WRONG_CONDITION.code in refused("chart", f"{database}?year(date) = 2024")
