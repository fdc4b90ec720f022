"""Tables as recorders write them are read as they are: rate, samples, units."""

from __future__ import annotations

import numpy as np
import pytest
from recorder_layouts import LAYOUTS, RATE, signals, write_layout

from shaker.io import read_channels
from shaker.io.time_stamps import seconds_of_stamps

WITHOUT_UNITS = {
    "LeCroy",
    "NI SignalExpress",
    "NI LabVIEW",
    "milliseconds since 1970",
    "names in a remark",
    "numbers only",
}
IN_VOLT = {"Keysight": "Volt", "Rigol": "Volt", "PicoScope": "V"}


@pytest.mark.parametrize("newline", ["\r\n", "\n"])
@pytest.mark.parametrize("layout", LAYOUTS)
def test_every_layout_is_read_with_its_rate_samples_and_units(tmp_path, layout, newline):
    channels = read_channels(write_layout(tmp_path, layout, newline))
    _, camera, laser = signals()
    truth = [camera, laser][: 1 if layout in ("LeCroy", "Tektronix, preamble beside the data") else 2]
    assert len(channels) == len(truth)
    for channel, true in zip(channels.values(), truth, strict=True):
        assert channel.sample_rate_hz == pytest.approx(RATE, rel=1e-6)
        assert channel.stamp_s is None
        np.testing.assert_allclose(channel.samples, true, atol=1e-3)
    units = [channel.unit for channel in channels.values()]
    volt = IN_VOLT.get(layout, "V")
    expected = ["", ""] if layout in WITHOUT_UNITS else [volt, volt if layout in IN_VOLT else "m/s"]
    assert units == expected[: len(units)]


@pytest.mark.parametrize("line", ["Marker 1", "Time [s],Laser [m/s]"])
def test_a_line_of_text_between_the_rows_is_refused_by_its_number(tmp_path, line):
    path = tmp_path / "a.csv"
    rows = [f"{i / 1000:.3f},{np.sin(i):.5f}" for i in range(300)]
    path.write_text("\n".join(["Time [s],Laser [m/s]", *rows[:100], line, *rows[100:]]))
    with pytest.raises(ValueError, match="line 102"):
        read_channels(path)


@pytest.mark.parametrize("mark", ["---", "#NV", "1,#QNAN", "N/A", ""])
def test_marks_of_missing_samples_are_none(tmp_path, mark):
    path = tmp_path / "a.csv"
    path.write_text("Zeit [s];Laser [mm/s];Takt [V]\n" + f"0,0;1.234,5;1,0\n0,1;{mark};2,5\n0,2;2.345;0,0\n")
    found = read_channels(path)
    np.testing.assert_array_equal(found["Laser [mm/s]"].samples, [1234.5, np.nan, 2345.0])
    np.testing.assert_array_equal(found["Takt [V]"].samples, [1.0, 2.5, 0.0])


def test_two_groups_of_rates_have_their_own_times(tmp_path):
    """A slow group ends before a fast one: its cells are empty from there on."""
    fast, slow = np.arange(1000) / 1000.0, np.arange(200) / 200.0
    lines = ["Time  1 - fast [s];Fz [N];Time  2 - slow [s];Temp [°C]"]
    for i, t in enumerate(fast):
        lines.append(f"{t:.3f};{i};" + (f"{slow[i]:.3f};{20 + i}" if i < len(slow) else ";"))
    path = tmp_path / "a.csv"
    path.write_text("\n".join(lines).replace(".", ","), encoding="utf-8")
    found = read_channels(path)
    assert [(name, len(c.samples), c.sample_rate_hz) for name, c in found.items()] == [
        ("Fz [N]", 1000, pytest.approx(1000.0)),
        ("Temp [°C]", 200, pytest.approx(200.0)),
    ]


@pytest.mark.parametrize(
    ("cells", "seconds", "first"),
    [
        (["23:59:59.5", "00:00:00.5"], [0.0, 1.0], 86399.5),
        (["59:59,5", "1:00:00,5"], [0.0, 1.0], 3599.5),
        (["12:59 AM", "1:00 AM"], [0.0, 60.0], 3540.0),
        (["1.2.1970 00:00:01", "01.02.70 00:00:02"], [0.0, 1.0], 31 * 86400.0 + 1),
        (["2/1/1970 00:00:01", "2/1/1970 00:00:01.25"], [0.0, 0.25], 31 * 86400.0 + 1),
        (["28/2/1970 23:59:59", "1-Mar-1970 00:00:00"], [0.0, 1.0], 59 * 86400.0 - 1),
        (["1970-01-02T00:00:00Z", "1970/01/02 00:00:00.000000001"], [0.0, 1e-9], 86400.0),
    ],
)
def test_dates_and_times_of_day(cells, seconds, first):
    found, start_s, _ = seconds_of_stamps(cells)
    np.testing.assert_allclose(found, seconds, atol=1e-12)
    assert start_s == first


def test_a_name_in_capital_letters_is_no_unit_of_time(tmp_path):
    path = tmp_path / "a.csv"
    path.write_text("t [s];S;US\n" + "".join(f"{i / 1000};{i % 7};{i % 5}\n" for i in range(50)), encoding="utf-8")
    assert [(name, c.unit) for name, c in read_channels(path).items()] == [("S", ""), ("US", "")]
