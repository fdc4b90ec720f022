"""HDF5, MATLAB and WAV: vectors, tables, records, structs."""

from __future__ import annotations

import struct
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest
import scipy.io

from shaker.io import channel as datasets
from shaker.io import read_channels
from shaker.io.channel import RawChannel

RNG = np.random.default_rng(0)
TABLE = RNG.integers(-3000, 3000, (400, 3)).astype(np.int16)


@pytest.mark.parametrize("options", [{}, {"chunks": (64, 2), "compression": "gzip"}])
@pytest.mark.parametrize("block", [16, 1 << 20])
@pytest.mark.parametrize("turned", [False, True])
def test_hdf5_tables(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, options: dict[str, Any], block: int, turned: bool
) -> None:
    monkeypatch.setattr(datasets, "BLOCK", block)
    if turned and options:
        options = {**options, "chunks": options["chunks"][::-1]}
    with h5py.File(tmp_path / "a.h5", "w") as file:
        group = file.create_group("daq")
        group.attrs["sample_rate"] = np.array([1024.0])
        data = group.create_dataset("table", data=TABLE.T if turned else TABLE, **options)
        data.attrs["unit"] = ["V", "mV", "A"]
        data.attrs["start_time"] = [0.0, 1e-3, 2e-3]
        file["picture"] = np.zeros((40, 50))
    found = read_channels(tmp_path / "a.h5")
    assert list(found) == ["daq/table/1", "daq/table/2", "daq/table/3"]
    for column, channel in zip(TABLE.T, found.values(), strict=True):
        np.testing.assert_array_equal(channel.samples, column)
    second = read_channels(tmp_path / "a.h5", ["daq/table/2"])["daq/table/2"]
    np.testing.assert_array_equal(second.samples, TABLE[:, 1])
    assert (second.unit, second.start_s, second.sample_rate_hz) == ("mV", 1e-3, 1024.0)


def test_hdf5_records_and_a_time_beside(tmp_path: Path) -> None:
    records = np.zeros(50, [("time", "f8"), ("Fz", "f4"), ("label", "S3")])
    records["time"], records["Fz"] = 0.25 + np.arange(50) / 200.0, np.arange(50)
    with h5py.File(tmp_path / "a.h5", "w") as file:
        file["daq"] = records
        file["other/time"] = 2.0 + np.arange(7) / 10.0
        file["other/a"] = np.arange(7)
        file["other/a"].attrs["units"] = np.bytes_(b"m/s^2")
    found = read_channels(tmp_path / "a.h5")
    assert list(found) == ["daq/Fz", "other/a"]
    force, other = found.values()
    np.testing.assert_array_equal(force.samples, np.arange(50.0))
    assert (force.sample_rate_hz, force.start_s) == (pytest.approx(200.0), 0.25)
    assert (other.sample_rate_hz, other.start_s, other.unit) == (pytest.approx(10.0), 2.0, "m/s^2")


@pytest.mark.parametrize("key", ["sample_rate", "sampling_rate", "sampling_frequency", "fs"])
def test_hdf5_spellings_of_the_rate(tmp_path: Path, key: str) -> None:
    with h5py.File(tmp_path / "a.h5", "w") as file:
        file["a"], file["b"] = np.arange(7, dtype=">f4"), np.arange(7)
        file.attrs[key] = np.float32(512.0)
        file["b"].attrs[key] = 256.0  # a dataset's own counts before the file's
    assert read_channels(tmp_path / "a.h5")["b"].sample_rate_hz == 256.0
    channel = read_channels(tmp_path / "a.h5", ["a"], 9.0)["a"]
    assert (channel.sample_rate_hz, channel.samples.dtype) == (512.0, np.float64)


@pytest.mark.parametrize("rate", ["fast", -1.0, np.nan, [1.0, 2.0]])
def test_hdf5_rates_that_are_none(tmp_path: Path, rate: Any) -> None:
    with h5py.File(tmp_path / "a.h5", "w") as file:
        file["a"] = np.arange(7)
        file["a"].attrs["sample_rate"] = rate
    with pytest.raises(ValueError, match=r'a\.h5: (channel "a": expected|expected a positive sampling rate)'):
        read_channels(tmp_path / "a.h5", ["a"])


def _mat_7_3(path: Path) -> None:
    """Write variables as MATLAB does: turned, with classes, structs as groups, cells by reference."""
    with h5py.File(path, "w", userblock_size=512) as file:

        def put(name: str, value: np.ndarray, kind: bytes = b"double") -> None:
            file[name] = value
            file[name].attrs["MATLAB_class"] = np.bytes_(kind)

        put("x", np.arange(50.0)[None, :])
        put("fs", np.array([[256.0]]))
        put("table", TABLE.T)
        put("rec/Fz", np.arange(30.0)[:, None])
        put("rec/fs", np.array([[512.0]]))
        put("rec/unit", np.array([[ord(c)] for c in "mV/V"], dtype=np.uint16), b"char")
        put("rec/deep/a", np.arange(20.0)[None, :])
        put("late/time", 5.0 + np.arange(40)[None, :] / 8.0)
        put("late/a", np.arange(40.0)[None, :])
        put("list", np.array([[file["x"].ref]], dtype=h5py.ref_dtype), b"cell")
        put("many/x", np.array([[file["x"].ref, file["x"].ref]], dtype=h5py.ref_dtype))
        put("nothing", np.array([0, 0], dtype=np.uint64))
        file["nothing"].attrs["MATLAB_empty"] = np.uint8(1)
        file["#refs#/a"] = np.arange(9.0)


def _mat_5(path: Path) -> None:
    cells = np.empty(2, dtype=object)
    cells[:] = [np.arange(3.0), "text"]
    many = np.zeros(2, dtype=[("x", object)])
    many["x"] = [np.arange(3.0), np.arange(4.0)]
    scipy.io.savemat(
        path,
        {
            "x": np.arange(50.0)[:, None],
            "fs": 256.0,
            "table": TABLE,
            "rec": {"Fz": np.arange(30.0), "fs": 512.0, "unit": "mV/V", "deep": {"a": np.arange(20.0)}},
            "late": {"time": 5.0 + np.arange(40) / 8.0, "a": np.arange(40.0)},
            "list": cells,
            "many": many,
            "nothing": np.zeros((0, 0)),
            "square": np.eye(3),
            "words": "x",
        },
        do_compression=True,
    )


@pytest.mark.parametrize("write", [_mat_5, _mat_7_3])
def test_matlab_structs_and_tables(tmp_path: Path, write: Any) -> None:
    path = tmp_path / "a.mat"
    write(path)
    found = read_channels(path)
    assert sorted(found) == ["late.a", "rec.Fz", "rec.deep.a", "table/1", "table/2", "table/3", "x"]
    np.testing.assert_array_equal(found["x"].samples, np.arange(50.0))
    np.testing.assert_array_equal(found["table/3"].samples, TABLE[:, 2])
    for name, rate in (("x", 256.0), ("table/1", 256.0), ("rec.Fz", 512.0), ("rec.deep.a", 512.0)):
        assert found[name].sample_rate_hz == rate
    assert (found["rec.Fz"].unit, found["rec.deep.a"].unit, found["x"].unit) == ("mV/V", "mV/V", "")
    np.testing.assert_array_equal(read_channels(path, ["rec.Fz"])["rec.Fz"].samples, np.arange(30.0))
    kinds = {"list": "a cell array", "nothing": "an empty array"}
    for name, kind in kinds.items():
        with pytest.raises(ValueError, match=rf'a\.mat: channel "{name}": expected a vector of numbers, found {kind}'):
            read_channels(path, [name])
    many = "many" if write is _mat_5 else "many.x"
    with pytest.raises(ValueError, match=rf'channel "{many}": expected a vector of numbers, found an array of'):
        read_channels(path, [many])
    with pytest.raises(ValueError, match=r'a\.mat: expected a channel "y", found'):
        read_channels(path, ["y"])


@pytest.mark.parametrize("new", [False, True])
def test_matlab_times_give_the_rate(tmp_path: Path, new: bool) -> None:
    path = tmp_path / "a.mat"
    times = 5.0 + np.arange(40) / 8.0
    if new:
        with h5py.File(path, "w") as file:
            file["late/time"], file["late/signals/values"] = times[None, :], np.arange(40.0)[None, :]
    else:
        scipy.io.savemat(path, {"late": {"time": times, "signals": {"values": np.arange(40.0)}}})
    channel = read_channels(path, ["late.signals.values"])["late.signals.values"]
    assert (channel.sample_rate_hz, channel.start_s) == (pytest.approx(8.0), 5.0)


def _wave(kind: int, bits: int, raw: bytes, channels: int, extensible: bool = False, rf64: bool = False) -> bytes:
    width = bits // 8 * channels
    form = struct.pack("<HHLLHH", 0xFFFE if extensible else kind, channels, 48_000, 48_000 * width, width, bits)
    if extensible:
        form += struct.pack("<HHLH", 22, bits, 0, kind) + bytes.fromhex("000000001000800000aa00389b71")
    chunks = b"fmt " + struct.pack("<L", len(form)) + form
    chunks += b"bext" + struct.pack("<L", 4) + b"note"
    size = 0xFFFFFFFF if rf64 else len(raw)
    chunks += b"data" + struct.pack("<L", size) + raw
    if rf64:
        head = b"ds64" + struct.pack("<LQQQL", 28, len(chunks) + 40, len(raw), len(raw) // width, 0)
        return b"RF64" + struct.pack("<L", 0xFFFFFFFF) + b"WAVE" + head + chunks
    return b"RIFF" + struct.pack("<L", len(chunks) + 4) + b"WAVE" + chunks


def _channel_two(folder: Path, content: bytes) -> RawChannel:
    (folder / "a.wav").write_bytes(content)
    return read_channels(folder / "a.wav", ["2"])["2"]


@pytest.mark.parametrize("form", [{}, {"extensible": True}, {"rf64": True}])
def test_wav_of_24_bits_and_floats(tmp_path: Path, form: dict[str, bool]) -> None:
    numbers = np.array([[0, -(2**23)], [1, 2**23 - 1], [2, -1]], dtype="<i4")
    raw = b"".join(int(n).to_bytes(3, "little", signed=True) for n in numbers.ravel())
    channel = _channel_two(tmp_path, _wave(1, 24, raw, 2, **form))
    np.testing.assert_array_equal(channel.samples, numbers[:, 1] * 256.0)
    assert channel.sample_rate_hz == 48_000.0
    for kind in ("<f4", "<f8"):
        floats = RNG.normal(size=(5, 2)).astype(kind)
        channel = _channel_two(tmp_path, _wave(3, floats.itemsize * 8, floats.tobytes(), 2, **form))
        np.testing.assert_array_equal(channel.samples, floats[:, 1])


@pytest.mark.parametrize("kind", [np.int16, np.int32, np.float32])
def test_wav_numbers_come_as_they_are(tmp_path: Path, kind: type) -> None:
    stereo = np.stack([np.arange(50), -np.arange(50)], axis=1).astype(kind)
    scipy.io.wavfile.write(tmp_path / "a.wav", 48_000, stereo)
    found = read_channels(tmp_path / "a.wav")
    assert sorted(found) == ["1", "2"]
    np.testing.assert_array_equal(found["2"].samples, -np.arange(50.0))
