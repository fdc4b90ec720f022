"""TDMS, HDF5, MATLAB and WAV: every layout, written byte by byte; npTDMS as the second opinion."""

import struct
from fractions import Fraction
from pathlib import Path

import h5py
import numpy as np
import pytest
import scipy.io
import tdms_factory as tdms
from contracts import refused
from hypothesis import given, settings
from hypothesis import strategies as st
from nptdms import ChannelObject, TdmsFile, TdmsWriter

from shaker.io import binary as datasets
from shaker.io import read_channels
from shaker.io import tdms as reader
from shaker.io.channel import RawChannel

A, B = "/'daq'/'a'", "/'daq'/'b'"
RATE = {"wf_increment": 1.0 / 1024.0}


def read(folder: Path, content: bytes, names: list[str] | None = None) -> dict[str, RawChannel]:
    path = folder / "a.tdms"
    path.write_bytes(content)
    return read_channels(path, names)


def second_opinion(folder: Path) -> dict[str, np.ndarray]:
    file = TdmsFile.read(folder / "a.tdms")
    return {f"{group.name}/{channel.name}": channel[:] for group in file.groups() for channel in group.channels()}


@pytest.mark.parametrize("order", ["<", ">"])
@pytest.mark.parametrize("interleaved", [False, True])
def test_scaled_integers_and_floats_in_several_segments(tmp_path, order, interleaved):
    rng = np.random.default_rng(0)
    counts = rng.integers(-30_000, 30_000, 90).astype(order + "i2")
    floats = rng.normal(size=90).astype(order + "f4")
    flags = tdms.RAW | (tdms.BIG_ENDIAN if order == ">" else 0) | (tdms.INTERLEAVED if interleaved else 0)

    def raw(part: slice) -> bytes:
        arrays = counts[part], floats[part]
        return tdms.interleaved(*arrays) if interleaved else b"".join(array.tobytes() for array in arrays)

    entries = [
        tdms.entry(A, tdms.plain("i2", 10, order), {**RATE, **tdms.linear(0.5, -2.0)}, order),
        tdms.entry(B, tdms.plain("f4", 10, order), {**RATE, "unit_string": "m/s²"}, order),
    ]
    # Three chunks in the first segment, a second without metadata, a third that only takes up the list again.
    content = tdms.segment(entries, raw(slice(0, 10)) + raw(slice(10, 20)) + raw(slice(20, 30)), flags | 6)
    content += tdms.segment([], raw(slice(30, 40)), flags)
    repeated = [tdms.entry(name, tdms.AS_BEFORE, None, order) for name in (A, B)]
    content += tdms.segment(repeated, b"".join(raw(slice(i, i + 10)) for i in range(40, 90, 10)), flags | tdms.METADATA)
    found = read(tmp_path, content)
    np.testing.assert_array_equal(found["daq/a"].samples, counts * 0.5 - 2.0)
    np.testing.assert_array_equal(found["daq/b"].samples, floats.astype(float))
    assert (found["daq/b"].unit, found["daq/b"].sample_rate_hz) == ("m/s²", 1024.0)
    for name, samples in second_opinion(tmp_path).items():
        np.testing.assert_allclose(found[name].samples, samples, rtol=1e-12)


def test_channels_that_pause_and_texts_between_them(tmp_path):
    """A channel without data in one segment, a text channel passed over, a layout that changes."""
    words = np.array([2, 4], dtype="<u4").tobytes() + b"abcd"
    entries = [
        tdms.entry("/'daq'/'remark'", tdms.texts(2, len(words))),
        tdms.entry(A, tdms.plain("i4", 3), RATE),
        tdms.entry(B, tdms.plain("u1", 2), RATE),
    ]
    content = tdms.segment(entries, words + np.array([1, 2, 3], dtype="<i4").tobytes() + bytes([7, 8]))
    pause = [tdms.entry("/'daq'/'remark'", tdms.NO_DATA), tdms.entry(A, tdms.NO_DATA)]
    content += tdms.segment(pause, bytes([9, 10]), tdms.METADATA | tdms.RAW)
    content += tdms.segment(
        [tdms.entry(A, tdms.plain("i4", 1))], np.array([4], dtype="<i4").tobytes() + bytes([11, 12]), 10
    )
    found = read(tmp_path, content)
    assert sorted(found) == ["daq/a", "daq/b"]
    np.testing.assert_array_equal(found["daq/a"].samples, [1.0, 2.0, 3.0, 4.0])
    np.testing.assert_array_equal(found["daq/b"].samples, np.arange(7.0, 13.0))
    np.testing.assert_array_equal(second_opinion(tmp_path)["daq/a"], found["daq/a"].samples)


def test_raw_data_and_digital_lines_of_cards(tmp_path):
    """Two buffers of different length and width in every chunk; a digital line is one bit of a byte."""
    first = np.arange(24, dtype="<i2").reshape(12, 2)  # card 0: two channels, 6 rows in each of two chunks
    second = np.arange(100, 108, dtype="<i4").reshape(8, 1)  # card 1: one channel, 4 rows in each chunk
    scale = {
        "NI_Number_Of_Scales": 2,
        "NI_Scale[1]_Scale_Type": "Polynomial",
        "NI_Scale[1]_Polynomial_Coefficients_Size": 3,
        **{f"NI_Scale[1]_Polynomial_Coefficients[{i}]": v for i, v in enumerate((1.0, 0.5, 0.25))},
        "NI_Scale[1]_Polynomial_Input_Source": 0,
    }
    entries = [
        tdms.entry(A, tdms.card(6, [("i2", 0, 0, 0)], (4, 4)), {**RATE, **scale}),
        tdms.entry(B, tdms.card(6, [("i2", 0, 2, 0)], (4, 4)), {**RATE, **scale}),
        tdms.entry("/'daq'/'c'", tdms.card(4, [("i4", 1, 0, 0)], (4, 4)), {**RATE, **scale}),
    ]
    raw = first[:6].tobytes() + second[:4].tobytes() + first[6:].tobytes() + second[4:].tobytes()
    found = read(tmp_path, tdms.segment(entries, raw, 14 | tdms.DAQMX))
    for name, counts in (("a", first[:, 0]), ("b", first[:, 1]), ("c", second[:, 0])):
        np.testing.assert_array_equal(
            found[f"daq/{name}"].samples, 1.0 + 0.5 * counts + 0.25 * counts.astype(float) ** 2
        )
        np.testing.assert_array_equal(second_opinion(tmp_path)[f"daq/{name}"], found[f"daq/{name}"].samples)
    port = np.array([0b00, 0b01, 0b10, 0b11, 0b01], dtype="u1")
    entries = [
        tdms.entry(name, tdms.card(5, [("u1", 0, bit, 0)], (1,), digital=True), {**RATE, "NI_Number_Of_Scales": 1})
        for bit, name in enumerate((A, B))
    ]
    found = read(tmp_path, tdms.segment(entries, port.tobytes(), 14 | tdms.DAQMX))
    np.testing.assert_array_equal(found["daq/a"].samples, [0, 1, 0, 1, 1])
    np.testing.assert_array_equal(found["daq/b"].samples, [0, 0, 1, 1, 0])


def test_channels_start_by_their_time_stamps(tmp_path):
    """To the full resolution of 2^-64 s, 3.7 billion seconds after 1904; the year 1904 itself means nothing was set."""
    start = Fraction(3_700_000_000) + Fraction(1, 3)
    starts = {A: start + Fraction(1, 1000), B: start, "/'daq'/'c'": Fraction(0)}
    entries = [
        tdms.entry(name, tdms.plain("u1", 2), {**RATE, "wf_start_time": stamp, "wf_start_offset": 0.25})
        for name, stamp in starts.items()
    ]
    found = read(tmp_path, tdms.segment(entries, bytes(6)))
    assert found["daq/a"].start_s == pytest.approx(0.251, abs=1e-12)
    assert (found["daq/b"].start_s, found["daq/c"].start_s) == (0.25, 0.25)
    assert read_channels(tmp_path / "a.tdms", ["a"])["a"].start_s == 0.25


@pytest.mark.parametrize("order", ["<", ">"])
def test_channel_of_time_stamps_gives_the_rate(tmp_path, order):
    step = Fraction(1, 51_200)
    record = np.dtype([("s", f"{order}i8"), ("f", f"{order}u8")] if order == ">" else [("f", "<u8"), ("s", "<i8")])
    times = np.zeros(200, record)
    for i in range(200):
        now = Fraction(3_700_000_000) + Fraction(1, 3) + i * step
        times[i]["s"], times[i]["f"] = now.__floor__(), int((now - now.__floor__()) * 2**64)
    flags = 14 | (tdms.BIG_ENDIAN if order == ">" else 0)
    entries = [
        tdms.entry("/'daq'/'Time'", tdms.plain("stamp", 200, order), None, order),
        tdms.entry(A, tdms.plain("f8", 200, order), None, order),
    ]
    raw = times.tobytes() + np.arange(200.0).astype(f"{order}f8").tobytes()
    found = read(tmp_path, tdms.segment(entries, raw, flags))
    assert (list(found), found["daq/a"].sample_rate_hz) == (["daq/a"], pytest.approx(51_200.0, rel=1e-10))
    assert found["daq/a"].start_s == pytest.approx(1.0 / 3.0, abs=1e-9)
    seconds = 0.5 + np.arange(50) / 400.0
    entries = [tdms.entry("/'daq'/'time'", tdms.plain("f8", 50)), tdms.entry(A, tdms.plain("f8", 50))]
    found = read(tmp_path, tdms.segment(entries, seconds.tobytes() + np.zeros(50).tobytes()), ["a"])
    assert (found["a"].sample_rate_hz, found["a"].start_s) == (pytest.approx(400.0), 0.5)


def test_names_with_slashes_and_quotes(tmp_path):
    entries = [
        tdms.entry("/'07/09 - all'/'Dev1/ai0'", tdms.plain("u1", 2), RATE),
        tdms.entry("/'it''s'/'b'", tdms.plain("u1", 2), RATE),
    ]
    found = read(tmp_path, tdms.segment(entries, bytes([1, 2, 3, 4])))
    assert list(found) == ["07/09 - all/Dev1/ai0", "it's/b"]
    np.testing.assert_array_equal(read_channels(tmp_path / "a.tdms", ["Dev1/ai0"])["Dev1/ai0"].samples, [1.0, 2.0])


def test_complex_numbers_are_passed_over_and_unknown_scales_refused(tmp_path):
    entries = [tdms.entry(A, tdms.plain("c16", 1), RATE), tdms.entry(B, tdms.plain("f8", 1), RATE)]
    assert list(read(tmp_path, tdms.segment(entries, bytes(24)))) == ["daq/b"]
    scale = {"NI_Number_Of_Scales": 1, "NI_Scale[0]_Scale_Type": "Magic"}
    with pytest.raises(ValueError, match=r'a\.tdms: channel "daq/b": .*Magic'):
        read(tmp_path, tdms.segment([tdms.entry(B, tdms.plain("f8", 1), {**RATE, **scale})], bytes(8)))


def test_files_of_another_writer(tmp_path):
    properties = {"wf_increment": 1.0 / 1024.0, "wf_start_offset": 0.25, "unit_string": "mV/V"}
    channels = (("bridge", "Fz", 1.5), ("bridge", "clock", 1.0), ("other", "clock", 2.0))
    with TdmsWriter(str(tmp_path / "a.tdms")) as writer:
        writer.write_segment([ChannelObject(g, n, np.arange(64) * k, properties=properties) for g, n, k in channels])
    found = read_channels(tmp_path / "a.tdms", ["Fz", "other/clock"])
    np.testing.assert_array_equal(found["Fz"].samples, np.arange(64) * 1.5)
    np.testing.assert_array_equal(found["other/clock"].samples, np.arange(64) * 2.0)
    assert (found["Fz"].sample_rate_hz, found["Fz"].start_s, found["Fz"].unit) == (1024.0, 0.25, "mV/V")
    refused(r'a\.tdms: .*"clock"', read_channels, tmp_path / "a.tdms", ["clock"])


@settings(max_examples=30, deadline=None)
@given(data=st.data())
def test_any_layout_is_read_as_written(tmp_path_factory, data):
    """Random types, chunks, segments and blocks: what was written is what is read, all of it and one channel alone."""
    kinds = data.draw(st.lists(st.sampled_from(["i1", "i2", "u4", "f4", "f8"]), min_size=1, max_size=4))
    order = data.draw(st.sampled_from("<>"))
    interleaved = data.draw(st.booleans())
    names = [f"/'g'/'{i}'" for i in range(len(kinds))]
    written: list[list[np.ndarray]] = [[] for _ in kinds]
    rng, content = np.random.default_rng(data.draw(st.integers(0, 99))), b""
    for _ in range(data.draw(st.integers(1, 3))):
        count, chunks = data.draw(st.integers(1, 100)), data.draw(st.integers(1, 3))
        raw = b""
        for _ in range(chunks):
            part = [rng.integers(0, 100, count).astype(order + kind) for kind in kinds]
            raw += tdms.interleaved(*part) if interleaved else b"".join(array.tobytes() for array in part)
            for parts, array in zip(written, part, strict=True):
                parts.append(array)
        entries = [tdms.entry(n, tdms.plain(k, count, order), RATE, order) for n, k in zip(names, kinds, strict=True)]
        flags = 14 | (tdms.BIG_ENDIAN if order == ">" else 0) | (tdms.INTERLEAVED if interleaved else 0)
        content += tdms.segment(entries, raw, flags)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(reader, "BLOCK", data.draw(st.sampled_from([8, 56, 512, 1 << 20])))
        folder = tmp_path_factory.mktemp("tdms")
        found = read(folder, content)
        last = read_channels(folder / "a.tdms", [f"{len(kinds) - 1}"])
    for channel, parts in zip([*found.values(), *last.values()], [*written, written[-1]], strict=True):
        np.testing.assert_array_equal(channel.samples, np.concatenate(parts))


RNG = np.random.default_rng(0)
TABLE = RNG.integers(-3000, 3000, (400, 3)).astype(np.int16)


@pytest.mark.parametrize("options", [{}, {"chunks": (64, 2), "compression": "gzip"}])
@pytest.mark.parametrize("block", [16, 1 << 20])
@pytest.mark.parametrize("transposed", [False, True])
def test_hdf5_tables(tmp_path, monkeypatch, options, block, transposed):
    monkeypatch.setattr(datasets, "BLOCK", block)
    if transposed and options:
        options = {**options, "chunks": options["chunks"][::-1]}
    with h5py.File(tmp_path / "a.h5", "w") as file:
        group = file.create_group("daq")
        group.attrs["sample_rate"] = np.array([1024.0])
        data = group.create_dataset("table", data=TABLE.T if transposed else TABLE, **options)
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


def test_hdf5_records_and_a_neighbouring_time(tmp_path):
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
def test_hdf5_spellings_of_the_rate(tmp_path, key):
    with h5py.File(tmp_path / "a.h5", "w") as file:
        file["a"], file["b"] = np.arange(7, dtype=">f4"), np.arange(7)
        file.attrs[key] = np.float32(512.0)
        file["b"].attrs[key] = 256.0  # a dataset's own counts before the file's
    assert read_channels(tmp_path / "a.h5")["b"].sample_rate_hz == 256.0
    channel = read_channels(tmp_path / "a.h5", ["a"], 512.0)["a"]
    assert (channel.sample_rate_hz, channel.samples.dtype) == (512.0, np.float64)


@pytest.mark.parametrize("rate", ["fast", -1.0, np.nan, [1.0, 2.0]])
def test_hdf5_rates_that_are_none(tmp_path, rate):
    with h5py.File(tmp_path / "a.h5", "w") as file:
        file["a"] = np.arange(7)
        file["a"].attrs["sample_rate"] = rate
    with pytest.raises(ValueError, match=r'a\.h5: .*"a"'):
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
def test_matlab_structs_and_tables(tmp_path, write):
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
    many = "many" if write is _mat_5 else "many.x"
    for name, kind in (("list", "cell"), ("nothing", "empty"), (many, "array")):
        refused(rf'a\.mat: channel "{name}": .*{kind}', read_channels, path, [name])
    refused(r'a\.mat: .*"y"', read_channels, path, ["y"])


@pytest.mark.parametrize("new", [False, True])
def test_matlab_times_give_the_rate(tmp_path, new):
    path, times = tmp_path / "a.mat", 5.0 + np.arange(40) / 8.0
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
def test_wav_of_24_bits_and_floats(tmp_path, form):
    numbers = np.array([[0, -(2**23)], [1, 2**23 - 1], [2, -1]], dtype="<i4")
    raw = b"".join(int(n).to_bytes(3, "little", signed=True) for n in numbers.ravel())
    channel = _channel_two(tmp_path, _wave(1, 24, raw, 2, **form))
    np.testing.assert_array_equal(channel.samples, numbers[:, 1] * 256.0)
    assert channel.sample_rate_hz == 48_000.0
    for kind in ("<f4", "<f8"):
        floats = RNG.normal(size=(5, 2)).astype(kind)
        channel = _channel_two(tmp_path, _wave(3, floats.itemsize * 8, floats.tobytes(), 2, **form))
        np.testing.assert_array_equal(channel.samples, floats[:, 1])


def test_wav_numbers_come_as_they_are(tmp_path):
    for kind in (np.int16, np.int32, np.float32):
        stereo = np.stack([np.arange(50), -np.arange(50)], axis=1).astype(kind)
        scipy.io.wavfile.write(tmp_path / "a.wav", 48_000, stereo)
        found = read_channels(tmp_path / "a.wav")
        assert sorted(found) == ["1", "2"]
        np.testing.assert_array_equal(found["2"].samples, -np.arange(50.0))
