"""When samples were taken, as files of all kinds state it: units, segments, stamps, and statements that differ."""

from __future__ import annotations

import re
from datetime import datetime, timedelta
from fractions import Fraction
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest
import scipy.io

from shaker import read_channels
from shaker.io.channel import RawChannel, times_of_stamps
from tests import tdms_factory as tdms
from tests import universal_factory as uff
from tests.contracts import refused

COUNT, RATE_HZ = 400, 8000.0
TIME_S = np.arange(COUNT) / RATE_HZ
LOST = np.delete(np.arange(COUNT), [100, 101, 250])
RNG = np.random.default_rng(1)
JITTER = TIME_S + np.clip(0.2 * RNG.standard_normal(COUNT), -0.45, 0.45) / RATE_HZ
SAMPLES = np.arange(float(COUNT))


def hdf5(path: Path, time: Any, units: str | None, **attributes: Any) -> RawChannel:
    """Write times and as many samples, and read them."""
    with h5py.File(path, "w") as file:
        file["time"] = time
        file.create_dataset("a", data=SAMPLES[: len(time)]).attrs.update(attributes)
        if units is not None:
            file["time"].attrs["units"] = units
    return read_channels(path, ["a"])["a"]


def csv(path: Path, time: np.ndarray, digits: str, head: str = "time", rate: float | None = None) -> RawChannel:
    """Write a table with times of some digits, and read it."""
    rows = "".join(f"{t:{digits}},{k}\n" for k, t in enumerate(time))
    path.write_text(f"{head},a\n{rows}")
    return read_channels(path, ["a"], rate)["a"]


@pytest.mark.parametrize(
    ("unit", "per_second"),
    [("ms", 1e3), ("Milliseconds", 1e3), ("us", 1e6), ("µs", 1e6), ("ns", 1e9), ("min", 1 / 60), (None, 1.0)],
)
def test_units_of_time_in_all_formats(tmp_path, unit, per_second):
    """The same times in a data set, a vector of MATLAB, a TDMS channel, an abscissa, a column and a table of pandas."""
    pyarrow = pytest.importorskip("pyarrow")
    stamps, found = 1.5 * per_second + per_second * TIME_S, {}
    found["h5"] = hdf5(tmp_path / "a.h5", stamps, unit)
    stated = {} if unit is None else {"time_unit": unit}
    scipy.io.savemat(tmp_path / "a.mat", {"time": stamps, "a": SAMPLES, **stated})
    found["mat"] = read_channels(tmp_path / "a.mat", ["a"])["a"]
    properties = {} if unit is None else {"unit_string": unit}
    entries = [
        tdms.entry("/'g'/'Time'", tdms.plain("f8", COUNT), properties),
        tdms.entry("/'g'/'a'", tdms.plain("f8", COUNT), {}),
    ]
    data = stamps.astype("<f8").tobytes() + SAMPLES.astype("<f8").tobytes()
    (tmp_path / "a.tdms").write_bytes(tdms.segment(entries, data))
    found["tdms"] = read_channels(tmp_path / "a.tdms", ["a"])["a"]
    found["csv"] = csv(tmp_path / "a.csv", stamps, ".12g", "time" if unit is None else f"time [{unit}]")
    time = pyarrow.field("time", pyarrow.float64(), metadata=None if unit is None else {"unit": unit})
    table = pyarrow.table([stamps, SAMPLES], schema=pyarrow.schema([time, pyarrow.field("a", pyarrow.float64())]))
    __import__("pyarrow.parquet").parquet.write_table(table, tmp_path / "a.parquet")
    found["parquet"] = read_channels(tmp_path / "a.parquet", ["a"])["a"]
    for kind, channel in found.items():
        assert channel.gap is None, kind
        assert channel.sample_rate_hz == pytest.approx(RATE_HZ, rel=1e-7), kind
        assert channel.start_s == pytest.approx(0.0 if kind == "parquet" else 1.5, abs=1e-6), kind


@pytest.mark.parametrize("even", [True, False])
def test_unit_of_an_abscissa(tmp_path, even):
    path = tmp_path / "a.uff"
    text = uff.text_function(1, 4, 1e3 * TIME_S, SAMPLES, even)
    for unit, rate in (("ms", RATE_HZ), ("s", RATE_HZ / 1e3), ("NONE", RATE_HZ / 1e3), ("mm", None)):
        lines = text.split(b"\n")
        lines[9] = lines[9][:47] + unit.ljust(20).encode() + lines[9][67:]
        path.write_bytes(b"\n".join(lines))
        if rate is None:
            refused("abscissa: .*'mm'", read_channels, path)
        else:
            assert read_channels(path)["12+Z"].sample_rate_hz == pytest.approx(rate, rel=1e-5)


def first_gap(channel: RawChannel) -> tuple[float, int] | None:
    """Return the length of the first gap in s and the sample before it."""
    if channel.gap is None:
        return None
    length_s, sample = re.findall(r"[\d.]+", channel.gap)[:2]
    return float(length_s), int(sample)


@pytest.mark.parametrize("kind", ["timestamp[ms]", "timestamp[us]", "timestamp[ns]", "duration[us]"])
def test_time_stamps_and_durations(tmp_path, kind):
    """At 1 kHz stamps of a millisecond are exact; of lost samples the gap is."""
    pyarrow = pytest.importorskip("pyarrow")
    sample_numbers = np.delete(np.arange(COUNT), 100)
    since = [timedelta(milliseconds=int(k)) for k in sample_numbers]
    stamps = since if kind.startswith("d") else [datetime(2024, 5, 6, 10) + step for step in since]
    unit = kind.partition("[")[2][:-1]
    typed = pyarrow.duration(unit) if kind.startswith("d") else pyarrow.timestamp(unit)
    table = pyarrow.table({"time": pyarrow.array(stamps, typed), "a": SAMPLES[:-1]})
    __import__("pyarrow.parquet").parquet.write_table(table, tmp_path / "a.parquet")
    if unit == "ms":  # a rounded clock of 997.5 Hz looks the same
        refused(r" 0\.001 s .*sample_rate", read_channels, tmp_path / "a.parquet")
        return
    channel = read_channels(tmp_path / "a.parquet")["a"]
    np.testing.assert_allclose(channel.time_s, sample_numbers * 1e-3, atol=1e-9)
    assert first_gap(channel) == (0.002, 99)


@pytest.mark.parametrize(("time", "uniform"), [(TIME_S, True), (TIME_S[LOST], False), (JITTER, False)])
@pytest.mark.parametrize("digits", [".5f", ".7f", ".9g", ".6e", "r"])
def test_stamps_count_within_their_printed_digits(tmp_path, time, uniform, digits):
    """Uniform times come back as a rate of the least-squares slope, others as they are; zeros at the end may lack."""
    channel = csv(tmp_path / "a.csv", 3.0 + time, "" if digits == "r" else digits)
    assert (channel.gap is None) == uniform
    last = {".5f": 1e-5, ".7f": 1e-7, ".9g": 1e-8, ".6e": 1e-6, "r": 1e-12}[digits]
    np.testing.assert_allclose(channel.time_s, time - time[0], atol=1.6 * last)
    if uniform:
        # rounding has a standard deviation of q/√12, the slope through n samples one of √12/n^(3/2) intervals of that
        assert channel.sample_rate_hz == pytest.approx(RATE_HZ, rel=5.0 * last * RATE_HZ / COUNT**1.5 + 1e-12)


@pytest.mark.parametrize("dtype", ["f4", "f8"])
def test_stamps_of_single_precision_are_uniform_within_theirs(tmp_path, dtype):
    time = (100.0 + TIME_S).astype(dtype)  # single precision has steps of 7.6 µs here
    channel = hdf5(tmp_path / "a.h5", time, "s")
    assert channel.gap is None
    assert channel.sample_rate_hz == pytest.approx(RATE_HZ, rel=1e-4 if dtype == "f4" else 1e-9)


def test_digits_that_would_hide_lost_samples_need_a_rate(tmp_path):
    path, time = tmp_path / "a.csv", np.delete(np.arange(1000), np.arange(50, 1000, 100)) / 1000.0
    refused(r" 0\.001 s .*sample_rate", csv, path, time, ".3f")
    assert first_gap(csv(path, time, ".4f")) == (0.002, 49)
    assert csv(path, np.arange(1000) / 1000.0, ".3f").sample_rate_hz == pytest.approx(1000.0, rel=1e-12)
    assert csv(path, np.arange(1000) / 10240.0, ".4f", rate=10240.0).sample_rate_hz == 10240.0
    refused("sample_rate.* 10240.* 10000", csv, path, np.arange(1000) / 10240.0, ".6f", rate=1e4)


@pytest.mark.parametrize(
    ("time", "units", "attributes", "expected"),
    [
        (np.arange(COUNT), None, {}, "times in .*unit"),
        (np.arange(COUNT) / 10.0, None, {"fs": RATE_HZ}, "sample_rate.* 10 Hz.* 8000"),
        (TIME_S, "mm", {}, "times in .*'mm'"),
        (TIME_S[::-1], None, {}, r"times in .*-0\.000125 s .* 0, 0"),
        (np.where(TIME_S > 0.02, np.nan, TIME_S), None, {}, "times in .* 239 "),
    ],
)
def test_undefined_or_contradictory_times_are_refused(tmp_path, time, units, attributes, expected):
    refused(expected, hdf5, tmp_path / "a.h5", time, units, **attributes)


@pytest.mark.parametrize("time", [TIME_S, 1e3 * TIME_S, np.arange(COUNT), np.arange(COUNT) * 125_000])
def test_times_without_unit_next_to_a_rate(tmp_path, time):
    """Seconds, milliseconds, numbers of samples, nanoseconds: the rate decides; a number that is missing is a gap."""
    assert hdf5(tmp_path / "a.h5", time, None, fs=RATE_HZ).sample_rate_hz == RATE_HZ
    gap = hdf5(tmp_path / "a.h5", time[LOST], None, fs=RATE_HZ)
    np.testing.assert_allclose(gap.time_s, TIME_S[LOST], atol=1e-12)


@pytest.mark.parametrize(
    ("attributes", "samples"),
    [
        ({"scale_factor": 0.002, "add_offset": 0.5}, 0.002 * SAMPLES + 0.5),
        ({"add_offset": np.array([3.0])}, SAMPLES + 3.0),
        ({"scale_factor": 2.0, "_FillValue": np.int16(7)}, np.where(SAMPLES == 7.0, np.nan, 2.0 * SAMPLES)),
        ({"conversion": 1e-3, "offset": -1.0}, 1e-3 * SAMPLES - 1.0),
        ({"offset": 2.0}, SAMPLES),
    ],
)
def test_packed_numbers_are_unpacked(tmp_path, attributes, samples):
    """CF conventions 1.11, 8.1; NWB 2.7, TimeSeries.data."""
    with h5py.File(tmp_path / "a.h5", "w") as file:
        file.create_dataset("a", data=SAMPLES.astype("i2")).attrs.update({"fs": 10.0, **attributes})
        file.create_dataset("t/time", data=np.arange(COUNT, dtype="i4"))
        file["t/time"].attrs.update({"units": "s", "scale_factor": 0.01})
        file["t/a"] = SAMPLES
    found = read_channels(tmp_path / "a.h5")
    np.testing.assert_allclose(found["a"].samples, samples, rtol=1e-14)
    assert found["t/a"].sample_rate_hz == pytest.approx(100.0, rel=1e-9)


def _dated(start: float | None, step: float = 0.01, **more: Any) -> dict[str, Any]:
    return {"wf_increment": step, **({} if start is None else {"wf_start_time": Fraction(start)}), **more}


@pytest.mark.parametrize(
    ("writes", "expected"),
    [
        ([_dated(100.0), _dated(100.0)], None),  # stated again
        ([_dated(100.0), _dated(100.5)], None),  # continued
        ([_dated(100.0), {}], None),
        ([{}, _dated(100.0)], None),  # stated once the first values were written
        ([_dated(0.0), _dated(100.0)], None),  # 1904: not set
        ([_dated(100.0), _dated(103.0)], (2.51, 49)),
        ([_dated(100.0), _dated(100.0, wf_start_offset=3.0)], (2.51, 49)),
        ([_dated(100.0), _dated(100.5, 0.02)], " 100 Hz .* 50 .* 50 Hz"),
        ([_dated(None), _dated(None, 0.02)], " 100 Hz .* 50 .* 50 Hz"),
        ([_dated(100.0), _dated(100.2)], r" 0\.5.* s .* 0\.2.* s"),
        ([_dated(100.0), None, _dated(101.0)], "g/a.* changed "),
    ],
)
def test_properties_of_each_write(tmp_path, writes, expected):
    """A TDMS file of writes of 50 values, with or without properties; None ends the values."""
    content, values = b"", True
    for properties in writes:
        if properties is None:
            values = False
            continue
        index = tdms.plain("f8", 50) if values else tdms.NO_DATA
        flags = tdms.METADATA | tdms.NEW_LIST | (tdms.RAW if values else 0)
        content += tdms.segment([tdms.entry("/'g'/'a'", index, properties)], bytes(400) if values else b"", flags)
    (tmp_path / "a.tdms").write_bytes(content)
    if not isinstance(expected, str):
        channel = read_channels(tmp_path / "a.tdms")["g/a"]
        assert channel.sample_rate_hz == pytest.approx(100.0)
        assert first_gap(channel) == expected
    else:
        refused(expected, read_channels, tmp_path / "a.tdms")


LVM = (
    "LabVIEW Measurement\nSeparator\tTab\nDecimal_Separator\t.\nX_Columns\t{x}\n***End_of_Header***\n\n"
    "Channels\t3\nSamples\t{samples}\nY_Unit_Label\t{units}\nX0\t{zeros}\nDelta_X\t{steps}\n***End_of_Header***\n"
)


def lvm(path: Path, delta: str, x: str = "No", units: str = "V\tN\tg", samples: int = 100, digits: int = 9) -> Path:
    """Write a LabVIEW file of three channels, 100 rows at 10.24 kHz."""
    blank = "\t\t" if x == "Multi" else "\t"
    parts = {
        key: blank.join([value] * 3) for key, value in (("samples", str(samples)), ("zeros", "0"), ("steps", delta))
    }
    titles = "X_Value\tU\tX_Value\tF\tX_Value\ta\n" if x == "Multi" else "X_Value\tU\tF\ta\n"
    rows = []
    for k in range(100):
        time = f"{k / 10240:.{digits}f}" if x != "No" else ""
        rows.append(f"{time}\t{k}\t{time}\t{k}\t{time}\t{k}\n" if x == "Multi" else f"{time}\t{k}\t{k}\t{k}\n")
    path.write_text(LVM.format(x=x, units=units, **parts) + titles + "".join(rows))
    return path


@pytest.mark.parametrize(
    ("x", "units", "expected"),
    [
        ("No", "V\tN\tg", ["V", "N", "g"]),
        ("One", "V\t\tg", ["V", "", "g"]),
        ("Multi", "V\t\tN\t\tg", ["V", "N", "g"]),
        ("Multi", "\t\tN\t\tg", ["", "N", "g"]),
        ("Multi", "V\t\t\t\tg", ["V", "", "g"]),
        ("Multi", "V", ["V", "", ""]),
    ],
)
def test_units_of_a_labview_file_are_above_their_channels(tmp_path, x, units, expected):
    found = read_channels(lvm(tmp_path / "a.lvm", "9.765625E-5", x, units))
    assert [channel.unit for channel in found.values()] == expected


@pytest.mark.parametrize(
    ("delta", "x", "digits", "given", "expected"),
    [
        ("9.765625E-5", "No", 9, None, 10240.0),
        ("0.000098", "No", 9, None, r"Delta_X: .* 0\.000098 .*sample_rate"),
        ("0.0001", "No", 9, None, r"Delta_X: .* 0\.0001 "),
        ("0.000100", "No", 9, None, 10000.0),  # a rate that people set, and no other within a half of the last digit
        ("0.000098", "No", 9, 10240.0, 10240.0),
        ("0.0001", "No", 9, 10240.0, 10240.0),
        ("0.000098", "No", 9, 8000.0, "sample_rate.* 10204.* 8000"),
        ("0.000098", "One", 9, None, 10240.0),  # the column has more digits
        ("0.000098", "Multi", 7, None, 10240.0),
        ("9.765625E-5", "One", 6, None, 10240.0),
        ("9.765625E-5", "One", 6, 10240.0, 10240.0),
        ("9.765625E-5", "One", 6, 10000.0, " 10000 "),
    ],
)
def test_intervals_of_few_digits(tmp_path, delta, x, digits, given, expected):
    path = lvm(tmp_path / "a.lvm", delta, x, digits=digits)
    if isinstance(expected, str):
        refused(expected, read_channels, path, None, given)
    else:
        assert read_channels(path, None, given)["F"].sample_rate_hz == pytest.approx(expected, rel=2e-5)


def test_rows_that_no_header_dates(tmp_path):
    refused(" 60 .* 100;", read_channels, lvm(tmp_path / "a.lvm", "9.765625E-5", samples=60))
    dated = read_channels(lvm(tmp_path / "b.lvm", "9.765625E-5", "One", samples=60))["a"]
    assert (len(dated.samples), dated.sample_rate_hz) == (100, 10240.0)


def test_stamps_far_from_their_origin_keep_their_intervals():
    """Nanoseconds since 1970 as whole numbers, and numbers of days."""
    stamps = 1_714_989_600_000_000_000 + (1e9 * TIME_S).astype(np.int64)
    assert times_of_stamps(Path("a"), "time", stamps, "ns").rate_hz == pytest.approx(RATE_HZ, rel=1e-9)
    days = times_of_stamps(Path("a"), "time", 2.0 + TIME_S / 86400.0, "days since 2024-01-01")
    assert days.rate_hz == pytest.approx(RATE_HZ, rel=1e-9)
