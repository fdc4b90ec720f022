"""Files that optional packages read, against what their makers' or other programs printed of the same files."""

from __future__ import annotations

import sys
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest
from contracts import refused

from shaker.io import packages, read_channels


def test_mdf_of_three_programs(data_dir):
    """Values printed by asammdf's own tools; groups of several rates, conversions linear, rational and by table."""
    pytest.importorskip("asammdf")
    folder = data_dir / "formats" / "mdf4"
    path = folder / "ASAP2_Demo_V171.mf4"
    names = ("SBYTE.IDENTICAL.DISCRETE", "UBYTE.FORM_X_PLUS_4", "SLONG.IDENTICAL", "UBYTE.RAT_FUNC.DIV_10")
    names = tuple(f"ASAM.M.SCALAR.{name}" for name in names)
    found = read_channels(path, names)
    hours, rpm, slong, speed = (found[name] for name in names)
    assert hours.samples[[0, 1, 2, -1]].tolist() == [0, 10, 20, -26]
    assert hours.samples.mean() == pytest.approx(-1.774193548, abs=1e-9)
    assert (rpm.unit, rpm.samples[[0, 1, 2, -1]].tolist()) == ("rpm", [29, 32, 34, 159])
    assert slong.samples.mean() == pytest.approx(548.450088695, abs=1e-9)
    assert (speed.unit, speed.samples[[0, -1]].tolist()) == ("km/h", [14.4, 12.8])
    # times count from the earliest channel asked for, here the one at 1 kHz from 0.0132693 s on
    assert (slong.start_s, slong.sample_rate_hz) == (0.0, pytest.approx(12401 / (12.414284664 - 0.0132693)))
    assert hours.start_s == pytest.approx(0.1127576 - 0.0132693, abs=1e-7)
    clock = read_channels(folder / "test_meas_4.10.mf4")["0/MAIN_CLOCK"]
    assert (clock.samples.min(), clock.samples.max(), clock.samples.mean()) == (1123, 2605, 1864.0)
    bus = folder / "canedge_FCBF0606_00000001-60B621D9.MF4"
    assert str(read_channels(bus, ["CAN_DataFrame.ID"])["CAN_DataFrame.ID"].gap).endswith("gaps")  # as they arrived
    refused('"Fz"', read_channels, path, ["Fz"])


def test_mdf_records_larger_than_the_file_are_not_made(tmp_path):
    """The reader makes a whole record, of whatever length its group declares (ASAM MDF 4.1, block CG)."""
    asammdf = pytest.importorskip("asammdf")
    with asammdf.MDF(version="4.10") as file:
        file.append([asammdf.Signal(np.arange(9.0), np.arange(9) / 10.0, name="Fz")], acq_name="a")
        path = Path(file.save(tmp_path / "a.mf4", overwrite=True, compression=2))
    assert len(read_channels(path, ["Fz"])["Fz"].samples) == 9
    content = bytearray(path.read_bytes())
    position = content.index(b"##CG") + 96
    assert content[position : position + 4] == (16).to_bytes(4, "little")
    content[position : position + 4] = (1 << 30).to_bytes(4, "little")
    path.write_bytes(content)
    refused("group 0: .*537 MB.*9664 MB", read_channels, path, ["Fz"])


def test_dewesoft_files_of_two_generations(data_dir):
    """Values printed by dwdatareader; the header of the second one states another rate than its samples have."""
    pytest.importorskip("dwdatareader")
    folder = data_dir / "formats" / "dewesoft"
    old = read_channels(folder / "Example_Drive01.d7d")
    assert (old["GPSvel"].unit, old["GPSvel"].sample_rate_hz, len(old["GPSvel"].samples)) == ("kph", 100.0, 9580)
    assert old["GPSvel"].samples.mean() == pytest.approx(71.0240221123, abs=1e-9)
    assert old["X absolute"].start_s == pytest.approx(0.64)
    new = read_channels(folder / "test_acc_001.dxd")
    assert [(name, channel.unit, len(channel.samples)) for name, channel in new.items()] == [
        (f"ACC_{axis}_nr{n}", "g", 60000) for n, axis in enumerate("XYZ", 1)
    ]
    assert [channel.sample_rate_hz for channel in new.values()] == pytest.approx([100.0] * 3)
    means = [0.0379724609, 0.0223764095, -0.9976381226]
    np.testing.assert_allclose([channel.samples.mean() for channel in new.values()], means, atol=1e-9)
    refused('channel "ENG_RPM": ', read_channels, folder / "Example_Drive01.d7d", ["ENG_RPM"])


def test_dewesoft_library_that_looks_for_ever_is_ended(tmp_path, monkeypatch):
    (tmp_path / "dwdatareader.py").write_text("def DWFile(path):\n    while True:\n        pass\n")
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.setitem(sys.modules, "dwdatareader", ModuleType("dwdatareader"))
    monkeypatch.setattr(packages, "_LONGEST_S", 1.0)
    (tmp_path / "a.dxd").write_bytes(bytes(100))
    refused(r"a\.dxd: .* 1 s ", read_channels, tmp_path / "a.dxd")


def test_parquet_columns_have_units_and_a_time(tmp_path):
    pa, parquet = pytest.importorskip("pyarrow"), pytest.importorskip("pyarrow.parquet")
    fields = [
        pa.field("time", pa.float64()),
        pa.field("Fz", pa.float32(), metadata={"unit": "N"}),
        ("text", pa.string()),
    ]
    columns = [np.arange(5) / 250.0 + 3.0, np.arange(5, dtype=np.float32), list("abcde")]
    parquet.write_table(pa.table(columns, schema=pa.schema(fields)), tmp_path / "a.parquet")
    (channel,) = read_channels(tmp_path / "a.parquet").values()
    assert (channel.unit, channel.start_s, channel.sample_rate_hz) == ("N", 0.0, pytest.approx(250.0))
    np.testing.assert_array_equal(channel.samples, np.arange(5))
    refused('channel "text": ', read_channels, tmp_path / "a.parquet", ["text"])
    parquet.write_table(pa.table({"Fz": np.arange(5.0)}), tmp_path / "b.parquet")
    refused("sample_rate", read_channels, tmp_path / "b.parquet", ["Fz"])
    assert read_channels(tmp_path / "b.parquet", None, 100.0)["Fz"].sample_rate_hz == 100.0


@pytest.mark.parametrize(("suffix", "package"), [("mf4", "asammdf"), ("dxd", "dwdatareader"), ("parquet", "pyarrow")])
def test_a_missing_package_and_a_damaged_file_are_named(tmp_path, monkeypatch, suffix, package):
    path = tmp_path / f"a.{suffix}"
    path.write_bytes(b"junk" * 400)
    pytest.importorskip(package)
    refused(rf"a.{suffix}: .*readable", read_channels, path)

    def without(name: str) -> object:
        raise ImportError(name)

    monkeypatch.setattr(packages, "import_module", without)
    refused(rf"a.{suffix}: .*{package}.*shakercal\[formats\]", read_channels, path)


def test_damaged_mdf_files_are_refused_or_read(tmp_path: Path, data_dir: Path, capsys: pytest.CaptureFixture[str]):
    pytest.importorskip("asammdf")
    whole, rng = (data_dir / "formats" / "mdf4" / "test_meas_4.10.mf4").read_bytes(), np.random.default_rng(2)
    path = tmp_path / "damaged.mf4"
    for trial in range(10):
        data = bytearray(whole[: len(whole) // 2] if trial < 3 else whole)
        for index in rng.integers(0, min(len(data), 4000), 1 + trial % 5):
            data[index] = rng.integers(256)
        path.write_bytes(data)
        try:
            read_channels(path)
        except (OSError, ValueError) as error:
            text = str(error)
        else:
            text = str(path)
        assert text.startswith(str(path))
        assert capsys.readouterr().out == ""
