"""Readers against files written by other libraries or byte by byte."""

from __future__ import annotations

from pathlib import Path

import h5py
import numpy as np
import pytest
import pyuff
import scipy.io
from nptdms import ChannelObject, TdmsWriter

from shaker.io.read import read_channels
from shaker.io.text import read_scan_asc

RATE = 1024.0
SAMPLES = np.sin(np.arange(64) / 3.0)


def _write_h5(path: Path) -> None:
    with h5py.File(path, "w") as file:
        file.attrs["sample_rate"] = RATE
        data = file.create_dataset("velocity", data=SAMPLES)
        data.attrs["unit"] = "V"
        data.attrs["start_time"] = 1.5
        other = file.create_dataset("daq/trigger", data=np.arange(64, dtype=np.int16))
        other.attrs["sample_rate"] = 2 * RATE
        file.create_dataset("picture", data=np.zeros((4, 4)))


def _write_tdms(path: Path) -> None:
    properties = {"wf_increment": 1.0 / RATE, "wf_start_offset": 0.25, "unit_string": "mV/V"}
    with TdmsWriter(str(path)) as writer:
        writer.write_segment(
            [
                ChannelObject("bridge", "Fz", SAMPLES, properties=properties),
                ChannelObject("bridge", "clock", np.arange(64), properties=properties),
                ChannelObject("other", "clock", np.arange(64) * 2, properties=properties),
            ]
        )


def _write_uff(path: Path, binary: int = 0) -> None:
    file = pyuff.UFF(str(path))
    for node, direction in ((12, 3), (13, -1)):
        data = pyuff.prepare_58(
            binary=binary, func_type=1, rsp_node=node, rsp_dir=direction, ref_node=0, ref_dir=0, id1="a",
            rsp_ent_name="NONE", ref_ent_name="NONE", ordinate_axis_units_lab="m/s", abscissa_spacing=1,
            abscissa_min=0.0, abscissa_inc=1.0 / RATE, num_pts=64, ord_data_type=4, data=SAMPLES * node,
            x=np.arange(64) / RATE, abscissa_spec_data_type=17, ordinate_spec_data_type=11,
            orddenom_spec_data_type=0, z_axis_spec_data_type=0, z_axis_value=0.0,
        )  # fmt: skip
        file.write_sets([data], "add")


def test_hdf5(tmp_path: Path) -> None:
    path = tmp_path / "a.h5"
    _write_h5(path)
    found = read_channels(path)
    assert sorted(found) == ["daq/trigger", "velocity"]
    np.testing.assert_array_equal(found["velocity"].samples, SAMPLES)
    assert (found["velocity"].sample_rate_hz, found["velocity"].start_s, found["velocity"].unit) == (RATE, 1.5, "V")
    assert found["daq/trigger"].sample_rate_hz == 2 * RATE
    with pytest.raises(ValueError, match=r'a\.h5: expected a channel "Fz", found "daq/trigger", "velocity"'):
        read_channels(path, ["Fz"])


def test_tdms(tmp_path: Path) -> None:
    path = tmp_path / "a.tdms"
    _write_tdms(path)
    found = read_channels(path, ["Fz", "other/clock"])
    np.testing.assert_array_equal(found["Fz"].samples, SAMPLES)
    np.testing.assert_array_equal(found["other/clock"].samples, np.arange(64) * 2.0)
    assert found["Fz"].sample_rate_hz == pytest.approx(RATE)
    assert (found["Fz"].start_s, found["Fz"].unit) == (0.25, "mV/V")
    with pytest.raises(ValueError, match='expected a channel "clock", found'):
        read_channels(path, ["clock"])


@pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning")  # pyuff leaves files open
@pytest.mark.parametrize("binary", [0, 1])
def test_universal_file(tmp_path: Path, binary: int) -> None:
    path = tmp_path / "a.uff"
    _write_uff(path, binary)
    found = read_channels(path)
    assert list(found) == ["12+Z", "13-X"]
    np.testing.assert_allclose(found["13-X"].samples, SAMPLES * 13, rtol=1e-6)
    assert found["12+Z"].sample_rate_hz == pytest.approx(RATE, rel=1e-5)
    assert found["12+Z"].unit == "m/s"


def test_matlab_old_and_new(tmp_path: Path) -> None:
    old, new = tmp_path / "old.mat", tmp_path / "new.mat"
    scipy.io.savemat(old, {"Fz": SAMPLES[:, None], "count": np.arange(64, dtype=np.int16), "name": "x", "m": np.eye(3)})
    with h5py.File(new, "w", userblock_size=512) as file:
        file["Fz"] = SAMPLES[None, :]
        file["sample_rate"] = np.array([[RATE]])
    found = read_channels(old, sample_rate_hz=RATE)
    assert sorted(found) == ["Fz", "count"]
    np.testing.assert_array_equal(found["Fz"].samples, SAMPLES)
    again = read_channels(new, ["Fz"])["Fz"]
    np.testing.assert_array_equal(again.samples, SAMPLES)
    assert again.sample_rate_hz == RATE
    with pytest.raises(ValueError, match=r'old\.mat: expected a sampling rate for channel "Fz", found none'):
        read_channels(old, ["Fz"])


@pytest.mark.parametrize(
    "text",
    [
        "# remark\ntime,Fz,Fx\n0.0,1.5,2\n0.5,nan,3\n1.0,3.5,4\n",
        "time;Fz;Fx\ns;[mV/V];(V)\n0,0;1,5;2\n0,5;;3\n1,0;3,5;4\n",
        '"time"\t"Fz"\t"Fx"\t\n0.0\t1.5\t2\t\n0.5\tnan\t3\t\n1.0\t3.5\t4\t\n',
        "time Fz Fx\n0.0 1.5 2\n0.5 nan 3\n1.0 3.5 4\n",
    ],
)
def test_csv_of_many_dialects(tmp_path: Path, text: str) -> None:
    path = tmp_path / "a.csv"
    path.write_text(text.replace("\t\n", "\n") if text.startswith('"') else text)
    found = read_channels(path)
    assert sorted(found) == ["Fx", "Fz"]
    np.testing.assert_array_equal(found["Fz"].samples, [1.5, np.nan, 3.5])
    assert found["Fz"].sample_rate_hz == pytest.approx(2.0)
    assert found["Fz"].unit == ("mV/V" if ";" in text else "")


def test_csv_without_time_needs_a_rate(tmp_path: Path) -> None:
    path = tmp_path / "a.csv"
    path.write_text("Fz\n1\n2\n3\n")
    np.testing.assert_array_equal(read_channels(path, sample_rate_hz=5.0)["Fz"].samples, [1.0, 2.0, 3.0])
    with pytest.raises(ValueError, match=r"a\.csv: expected a sampling rate"):
        read_channels(path)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("time,Fz\n0,1\n1\n", "line 3: expected 2 columns, found 1"),
        ("time,Fz\n0,1\n1,x\n", "line 3: expected numbers"),
        ("time,Fz\n0,1\n1,2\n5,3\n", "expected times in uniform steps"),
        ("time,Fz\n", "expected a header and rows of numbers"),
        ("1,2\n3,4\n", "line 1: expected a header"),
    ],
)
def test_csv_errors_name_the_line(tmp_path: Path, text: str, message: str) -> None:
    path = tmp_path / "bad.csv"
    path.write_text(text)
    with pytest.raises(ValueError, match=r"bad\.csv") as caught:
        read_channels(path)
    assert message in str(caught.value)


@pytest.mark.parametrize("kind", [np.int16, np.int32, np.float32])
def test_wav_numbers_come_as_they_are(tmp_path: Path, kind: type) -> None:
    path = tmp_path / "a.wav"
    stereo = np.stack([np.arange(50), -np.arange(50)], axis=1).astype(kind)
    scipy.io.wavfile.write(path, 48_000, stereo)
    found = read_channels(path)
    assert sorted(found) == ["1", "2"]
    np.testing.assert_array_equal(found["2"].samples, -np.arange(50.0))
    assert found["1"].sample_rate_hz == 48_000.0


_LVM_HEAD = (
    "LabVIEW Measurement\t\nWriter_Version\t2\nSeparator\tTab\nDecimal_Separator\t{point}\n"
    "X_Columns\t{columns}\n***End_of_Header***\t\n\t\n"
)
_LVM_SEGMENT = (
    "Channels\t2\t\t\nSamples\t{n}\t{n}\t\nDate\t2020/08/06\t2020/08/06\t\nTime\t16:58:{second}\t16:58:{second}\t\n"
    "Y_Unit_Label\tVolts\tg\t\nX0\t0\t0\t\nDelta_X\t{dx}\t{dx}\t\n***End_of_Header***\t\t\t\nX_Value\tU\ta\tComment\n"
)


def _lvm(segments: list[tuple[str, int, int]], dx: str = "0.5", columns: str = "No", point: str = ".") -> str:
    text = _LVM_HEAD.format(point=point, columns=columns)
    for second, first, count in segments:
        text += _LVM_SEGMENT.format(n=count, second=second, dx=dx)
        for i in range(first, first + count):
            text += f"\t{i}.25\t{-i}.5\t{'a remark' if i == first else ''}\n".replace(".", point)
        text += "\n"
    return text


@pytest.mark.parametrize("point", [".", ","])
def test_lvm_segments_are_joined(tmp_path: Path, point: str) -> None:
    path = tmp_path / "a.lvm"
    path.write_text(_lvm([("10.25", 0, 4), ("12.25", 4, 3)], dx=f"0{point}5", point=point))
    found = read_channels(path)
    assert list(found) == ["U", "a"]
    np.testing.assert_array_equal(found["U"].samples, np.arange(7) + 0.25)
    assert (found["U"].sample_rate_hz, found["U"].unit, found["a"].unit) == (2.0, "Volts", "g")


def test_lvm_segments_with_a_gap_are_refused(tmp_path: Path) -> None:
    path = tmp_path / "a.lvm"
    path.write_text(_lvm([("10.25", 0, 4), ("15.25", 4, 3)]))
    with pytest.raises(
        ValueError, match=r"a\.lvm: line 30: expected a segment that goes on at 2\.0+ s, found one from 5\.0"
    ):
        read_channels(path)


def test_lvm_column_of_a_decimated_file_rules_its_header(tmp_path: Path) -> None:
    path = tmp_path / "a.lvm"
    text = _LVM_HEAD.format(point=".", columns="One") + _LVM_SEGMENT.format(n=100, second="10", dx="0.001")
    path.write_text(text + "".join(f"{0.016 * i:.3f}\t{i}\t{-i}\n" for i in range(7)))
    assert read_channels(path)["U"].sample_rate_hz == pytest.approx(62.5, rel=1e-12)


def test_lvm_with_fewer_samples_than_its_header_says_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "a.lvm"
    path.write_text(_lvm([("10.25", 0, 4)]).replace("Samples\t4\t4", "Samples\t9\t9"))
    with pytest.raises(ValueError, match="expected 9 samples as the header says, found 4"):
        read_channels(path)


def _write_asc(path: Path, points: np.ndarray, blocks: np.ndarray, interval: float, by_rows: bool) -> None:
    """Write the layout that content.txt describes: points from line 19 on, acquisition, blocks with titles."""
    lines = [f"text {i}" for i in range(18)] + [" ".join(f"{v:.6f}" for v in p) for p in points]
    lines += ["", "acquisition", f"{blocks.shape[2]} {interval:.9g}"]
    for block in blocks:
        lines += ["", "Data block"]
        lines += [" ".join(f"{v:.9g}" for v in row) for row in (block.T if by_rows else block.reshape(-1, 1))]
    path.write_text("\n".join(lines) + "\n")


@pytest.mark.parametrize("by_rows", [True, False])
@pytest.mark.parametrize("count", [1, 8])
def test_scanning_vibrometer_text(tmp_path: Path, by_rows: bool, count: int) -> None:
    rng = np.random.default_rng(0)
    points, blocks = rng.normal(size=(count, 3)), rng.normal(size=(3, count, 50))
    path = tmp_path / "Scan_time.asc"
    _write_asc(path, points, blocks, 1.0 / 51_200.0, by_rows)
    scan = read_scan_asc(path)
    np.testing.assert_allclose(scan.point_m, points, atol=1e-6)
    np.testing.assert_allclose(scan.samples, blocks, rtol=1e-8)
    assert scan.sample_rate_hz == pytest.approx(51_200.0)
    take = scan.take(count - 1)
    assert list(take) == ["1", "2", "3"]
    np.testing.assert_array_equal(take["2"].samples, scan.samples[1, count - 1])
    np.testing.assert_array_equal(read_channels(path, [f"3/{count}"])[f"3/{count}"].samples, scan.samples[2, -1])


def test_scan_with_a_torn_block_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "torn.asc"
    _write_asc(path, np.ones((2, 3)), np.ones((3, 2, 50)), 1e-3, True)
    path.write_text("\n".join(path.read_text().splitlines()[:-3]))
    with pytest.raises(
        ValueError, match=r"torn\.asc: expected whole blocks of 2 points with 50 samples \(100 numbers\)"
    ):
        read_channels(path)


def test_missing_and_unknown_files(tmp_path: Path) -> None:
    with pytest.raises(FileNotFoundError, match=r"none\.h5: expected a file, found none"):
        read_channels(tmp_path / "none.h5")
    with pytest.raises(ValueError, match=r"a\.xls: expected a file of type .*, found \.xls"):
        read_channels(tmp_path / "a.xls")


@pytest.mark.parametrize("suffix", [".h5", ".tdms", ".uff", ".mat", ".csv", ".wav", ".lvm", ".asc"])
@pytest.mark.parametrize("content", [b"", b"\x00\x01\x02garbage" * 40])
def test_damaged_files_give_one_sentence(tmp_path: Path, suffix: str, content: bytes) -> None:
    path = tmp_path / f"damaged{suffix}"
    path.write_bytes(content)
    with pytest.raises((OSError, ValueError)) as caught:
        read_channels(path, ["Fz"], sample_rate_hz=RATE)
    text = str(caught.value)
    assert text.startswith(str(path))
    assert "\n" not in text


@pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning")  # pyuff leaves files open
@pytest.mark.parametrize("kind", ["h5", "tdms", "uff", "binary", "mat", "wav", "lvm"])
def test_truncated_files_are_noticed(tmp_path: Path, kind: str) -> None:
    path = tmp_path / ("a.uff" if kind == "binary" else f"a.{kind}")
    if kind == "mat":
        scipy.io.savemat(path, {"Fz": np.random.default_rng(0).normal(size=500)})
    elif kind == "wav":
        scipy.io.wavfile.write(path, 1000, np.arange(500, dtype=np.int16))
    elif kind == "lvm":
        path.write_text(_lvm([("10.25", 0, 40)]))
    else:
        {"h5": _write_h5, "tdms": _write_tdms, "uff": _write_uff, "binary": lambda p: _write_uff(p, 1)}[kind](path)
    whole = path.read_bytes()
    path.write_bytes(whole[: len(whole) * 2 // 3])
    with pytest.raises((OSError, ValueError), match=str(path)):
        read_channels(path, sample_rate_hz=RATE)
