"""TDMS: every layout of raw data, written byte by byte; npTDMS as the second opinion."""

from __future__ import annotations

from fractions import Fraction
from pathlib import Path

import numpy as np
import pytest
import tdms_factory as tdms
from hypothesis import given, settings
from hypothesis import strategies as st
from nptdms import ChannelObject, TdmsFile, TdmsWriter

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
def test_scaled_integers_beside_floats_in_several_segments(tmp_path: Path, order: str, interleaved: bool) -> None:
    rng = np.random.default_rng(0)
    counts = rng.integers(-30_000, 30_000, 90).astype(order + "i2")
    floats = rng.normal(size=90).astype(order + "f4")
    flags = tdms.RAW | (tdms.BIG_ENDIAN if order == ">" else 0) | (tdms.INTERLEAVED if interleaved else 0)

    def raw(part: slice) -> bytes:
        own = counts[part], floats[part]
        return tdms.interleaved(*own) if interleaved else b"".join(array.tobytes() for array in own)

    entries = [
        tdms.entry(A, tdms.plain("i2", 10, order), {**RATE, **tdms.linear(0.5, -2.0)}, order),
        tdms.entry(B, tdms.plain("f4", 10, order), {**RATE, "unit_string": "m/s²"}, order),
    ]
    # Three chunks in the first segment, a second without metadata, a third that only takes up the list again.
    content = tdms.segment(entries, raw(slice(0, 10)) + raw(slice(10, 20)) + raw(slice(20, 30)), flags | 6)
    content += tdms.segment([], raw(slice(30, 40)), flags)
    again = [tdms.entry(name, tdms.AS_BEFORE, None, order) for name in (A, B)]
    content += tdms.segment(again, b"".join(raw(slice(i, i + 10)) for i in range(40, 90, 10)), flags | tdms.METADATA)
    found = read(tmp_path, content)
    np.testing.assert_array_equal(found["daq/a"].samples, counts * 0.5 - 2.0)
    np.testing.assert_array_equal(found["daq/b"].samples, floats.astype(float))
    assert (found["daq/b"].unit, found["daq/b"].sample_rate_hz) == ("m/s²", 1024.0)
    for name, samples in second_opinion(tmp_path).items():
        np.testing.assert_allclose(found[name].samples, samples, rtol=1e-12)


@pytest.mark.parametrize("interleaved", [False, True])
@pytest.mark.parametrize("block", [1, 7, 64, 1000])
def test_blocks_of_any_size_give_the_same(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, interleaved: bool, block: int
) -> None:
    monkeypatch.setattr(reader, "BLOCK", 8 * block)
    a, b = np.arange(100.0), np.arange(100, dtype="<i2")
    raw = tdms.interleaved(a, b) if interleaved else a.tobytes() + b.tobytes()
    entries = [tdms.entry(A, tdms.plain("f8", 100), RATE), tdms.entry(B, tdms.plain("i2", 100), RATE)]
    found = read(tmp_path, tdms.segment(entries, raw, 6 | tdms.RAW | (tdms.INTERLEAVED if interleaved else 0)))
    np.testing.assert_array_equal(found["daq/a"].samples, a)
    np.testing.assert_array_equal(found["daq/b"].samples, b)
    alone = read_channels(tmp_path / "a.tdms", ["b"])
    np.testing.assert_array_equal(alone["b"].samples, b)


def test_channels_that_pause_and_texts_between_them(tmp_path: Path) -> None:
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


def test_raw_data_of_two_cards_with_their_scales(tmp_path: Path) -> None:
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


def test_digital_lines_of_a_card(tmp_path: Path) -> None:
    port = np.array([0b00, 0b01, 0b10, 0b11, 0b01], dtype="u1")
    entries = [
        tdms.entry(name, tdms.card(5, [("u1", 0, bit, 0)], (1,), digital=True), {**RATE, "NI_Number_Of_Scales": 1})
        for bit, name in enumerate((A, B))
    ]
    found = read(tmp_path, tdms.segment(entries, port.tobytes(), 14 | tdms.DAQMX))
    np.testing.assert_array_equal(found["daq/a"].samples, [0, 1, 0, 1, 1])
    np.testing.assert_array_equal(found["daq/b"].samples, [0, 0, 1, 1, 0])


def test_channels_start_by_their_time_stamps(tmp_path: Path) -> None:
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
def test_channel_of_time_stamps_gives_the_rate(tmp_path: Path, order: str) -> None:
    step = Fraction(1, 51_200)
    record = np.dtype([("s", f"{order}i8"), ("f", f"{order}u8")] if order == ">" else [("f", "<u8"), ("s", "<i8")])
    times = np.zeros(200, record)
    for i in range(200):
        now = Fraction(3_700_000_000) + Fraction(1, 3) + i * step
        times[i]["s"], times[i]["f"] = now.__floor__(), int((now - now.__floor__()) * 2**64)
    flags = 14 | (tdms.BIG_ENDIAN if order == ">" else 0)
    entries = [
        tdms.entry("/'daq'/'Time'", tdms.stamps(200, order), None, order),
        tdms.entry(A, tdms.plain("f8", 200, order), None, order),
    ]
    raw = times.tobytes() + np.arange(200.0).astype(f"{order}f8").tobytes()
    found = read(tmp_path, tdms.segment(entries, raw, flags))
    assert list(found) == ["daq/a"]
    assert found["daq/a"].sample_rate_hz == pytest.approx(51_200.0, rel=1e-10)
    assert found["daq/a"].start_s == pytest.approx(1.0 / 3.0, abs=1e-9)


def test_channel_of_times_in_seconds(tmp_path: Path) -> None:
    times = 0.5 + np.arange(50) / 400.0
    entries = [tdms.entry("/'daq'/'time'", tdms.plain("f8", 50)), tdms.entry(A, tdms.plain("f8", 50))]
    found = read(tmp_path, tdms.segment(entries, times.tobytes() + np.zeros(50).tobytes()), ["a"])
    assert (found["a"].sample_rate_hz, found["a"].start_s) == (pytest.approx(400.0), 0.5)


def test_names_with_slashes_and_quotes(tmp_path: Path) -> None:
    entries = [
        tdms.entry("/'07/09 - all'/'Dev1/ai0'", tdms.plain("u1", 2), RATE),
        tdms.entry("/'it''s'/'b'", tdms.plain("u1", 2), RATE),
    ]
    found = read(tmp_path, tdms.segment(entries, bytes([1, 2, 3, 4])))
    assert list(found) == ["07/09 - all/Dev1/ai0", "it's/b"]
    np.testing.assert_array_equal(read_channels(tmp_path / "a.tdms", ["Dev1/ai0"])["Dev1/ai0"].samples, [1.0, 2.0])


def test_complex_numbers_are_passed_over_and_unknown_scales_refused(tmp_path: Path) -> None:
    entries = [tdms.entry(A, tdms.plain("c16", 1), RATE), tdms.entry(B, tdms.plain("f8", 1), RATE)]
    assert list(read(tmp_path, tdms.segment(entries, bytes(24)))) == ["daq/b"]
    scale = {"NI_Number_Of_Scales": 1, "NI_Scale[0]_Scale_Type": "Magic"}
    with pytest.raises(ValueError, match=r'a\.tdms: channel "daq/b": expected a known scale, found \'Magic\''):
        read(tmp_path, tdms.segment([tdms.entry(B, tdms.plain("f8", 1), {**RATE, **scale})], bytes(8)))


def test_files_of_another_writer(tmp_path: Path) -> None:
    properties = {"wf_increment": 1.0 / 1024.0, "wf_start_offset": 0.25, "unit_string": "mV/V"}
    channels = (("bridge", "Fz", 1.5), ("bridge", "clock", 1.0), ("other", "clock", 2.0))
    with TdmsWriter(str(tmp_path / "a.tdms")) as writer:
        writer.write_segment([ChannelObject(g, n, np.arange(64) * k, properties=properties) for g, n, k in channels])
    found = read_channels(tmp_path / "a.tdms", ["Fz", "other/clock"])
    np.testing.assert_array_equal(found["Fz"].samples, np.arange(64) * 1.5)
    np.testing.assert_array_equal(found["other/clock"].samples, np.arange(64) * 2.0)
    assert (found["Fz"].sample_rate_hz, found["Fz"].start_s, found["Fz"].unit) == (1024.0, 0.25, "mV/V")
    with pytest.raises(ValueError, match='expected a channel "clock", found'):
        read_channels(tmp_path / "a.tdms", ["clock"])


@settings(max_examples=30, deadline=None)
@given(data=st.data())
def test_any_layout_comes_back(tmp_path_factory: pytest.TempPathFactory, data: st.DataObject) -> None:
    """Random types, chunks and segments: what was written is what is read."""
    kinds = data.draw(st.lists(st.sampled_from(["i1", "i2", "u4", "f4", "f8"]), min_size=1, max_size=4))
    order = data.draw(st.sampled_from("<>"))
    interleaved = data.draw(st.booleans())
    names = [f"/'g'/'{i}'" for i in range(len(kinds))]
    written: list[list[np.ndarray]] = [[] for _ in kinds]
    rng = np.random.default_rng(data.draw(st.integers(0, 99)))
    content = b""
    for _ in range(data.draw(st.integers(1, 3))):
        count, chunks = data.draw(st.integers(1, 5)), data.draw(st.integers(1, 3))
        raw = b""
        for _ in range(chunks):
            part = [rng.integers(0, 100, count).astype(order + kind) for kind in kinds]
            raw += tdms.interleaved(*part) if interleaved else b"".join(array.tobytes() for array in part)
            for own, array in zip(written, part, strict=True):
                own.append(array)
        entries = [tdms.entry(n, tdms.plain(k, count, order), RATE, order) for n, k in zip(names, kinds, strict=True)]
        flags = 14 | (tdms.BIG_ENDIAN if order == ">" else 0) | (tdms.INTERLEAVED if interleaved else 0)
        content += tdms.segment(entries, raw, flags)
    found = read(tmp_path_factory.mktemp("tdms"), content)
    for channel, own in zip(found.values(), written, strict=True):
        np.testing.assert_array_equal(channel.samples, np.concatenate(own))
