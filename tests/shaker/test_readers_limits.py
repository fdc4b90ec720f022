"""Damaged files end in one sentence, large ones need little memory, those of other laboratories are read."""

import tracemalloc
from functools import cache
from pathlib import Path
from tempfile import TemporaryDirectory

import h5py
import numpy as np
import pytest
import scipy.io
import tdms_factory as tdms
import universal_factory as uff
from contracts import refused
from hypothesis import HealthCheck, example, given, settings
from hypothesis import strategies as st
from nptdms import TdmsFile

from shaker.io import read_channels
from shaker.io.channel import BLOCK, RawChannel
from shaker.io.universal import read_universal_functions, read_universal_shapes

X, Y = np.arange(120) / 100.0, np.random.default_rng(0).normal(size=120)
LVM = (
    "LabVIEW Measurement\t\nSeparator\tTab\nDecimal_Separator\t.\nX_Columns\tNo\n***End_of_Header***\t\n\t\n"
    "Channels\t1\t\nSamples\t120\t\nDelta_X\t1.0000E-2\t\n***End_of_Header***\t\nX_Value\tU\tComment\n"
)


def _tdms(interleaved: bool) -> bytes:
    entries = [
        tdms.entry(f"/'g'/'{name}'", tdms.plain("f8", 60), {"wf_increment": 0.01, **tdms.linear(2.0, 1.0)})
        for name in "ab"
    ]
    raw = [tdms.interleaved(part, part) if interleaved else part.tobytes() * 2 for part in (Y[:60], Y[60:])]
    return tdms.segment(entries, raw[0], 14 | (32 if interleaved else 0)) + tdms.segment(
        [], raw[1], 8 | (32 * interleaved)
    )


def _by_library(suffix: str) -> bytes:
    """A file that another library writes."""
    with TemporaryDirectory() as folder:
        path = Path(folder) / f"a{suffix}"
        if suffix == ".wav":
            scipy.io.wavfile.write(path, 1000, (Y * 1000).astype(np.int16))
        elif suffix == ".mat":
            scipy.io.savemat(path, {"Fz": Y, "rec": {"x": Y, "fs": 3.0}, "name": "text"}, do_compression=True)
        else:
            with h5py.File(path, "w") as file:
                file.attrs["sample_rate"] = 100.0
                file.create_dataset("daq/Fz", data=Y, chunks=(30,), compression="gzip")
        return path.read_bytes()


@cache
def whole(kind: str) -> tuple[str, bytes]:
    """Suffix and content of a sound file."""
    rows = "".join(f"\t{y:.6f}\n" for y in Y)
    return {
        "tdms": lambda: (".tdms", _tdms(False)),
        "interleaved tdms": lambda: (".tdms", _tdms(True)),
        "text 58": lambda: (".uff", uff.text_function(1, 4, X, Y, True)),
        "binary 58": lambda: (".uff", uff.binary_function(4, X, Y, True, "<")),
        "shape": lambda: (".unv", uff.shape(5, [53.7], [1, 2, 3], np.ones((3, 3), dtype=complex))),
        "lvm": lambda: (".lvm", (LVM + rows).encode()),
        "csv": lambda: (".csv", ("time,Fz\ns,N\n" + "".join(f"{x},{y}\n" for x, y in zip(X, Y, strict=True))).encode()),
        "h5": lambda: (".h5", _by_library(".h5")),
        "mat": lambda: (".mat", _by_library(".mat")),
        "wav": lambda: (".wav", _by_library(".wav")),
    }[kind]()


KINDS = ("tdms", "interleaved tdms", "text 58", "binary 58", "shape", "lvm", "csv", "h5", "mat", "wav")


def read_all(path: Path) -> int:
    """Read a file by every door; return how much there is."""
    found = len(read_channels(path, sample_rate_hz=3.0 if path.suffix == ".mat" else None))
    if path.suffix in (".uff", ".unv"):
        found += len(read_universal_functions(path)) + len(read_universal_shapes(path))
    return found


def one_sentence(path: Path, error: Exception) -> None:
    assert str(error).startswith(f"{path}: "), error
    assert "\n" not in str(error)


@pytest.mark.parametrize("kind", KINDS)
def test_sound_files_are_read_and_cut_off_ones_refused(tmp_path, kind):
    """CSV does not say how long it is; all others do, and a file cut anywhere is refused."""
    suffix, content = whole(kind)
    path = tmp_path / f"a{suffix}"
    path.write_bytes(content)
    assert read_all(path) > 0
    for share in (0.02, 0.1, 0.3, 0.5, 0.7, 0.9, 0.97) if kind != "csv" else ():
        path.write_bytes(content[: int(share * len(content))])
        with pytest.raises((OSError, ValueError)) as caught:
            read_all(path)
        one_sentence(path, caught.value)


@pytest.mark.parametrize("suffix", [".h5", ".tdms", ".uff", ".mat", ".csv", ".wav", ".lvm", ".asc"])
@pytest.mark.parametrize("content", [b"", b"\x00\x01\x02garbage" * 40])
def test_empty_files_and_garbage_are_refused(tmp_path, suffix, content):
    path = tmp_path / f"a{suffix}"
    path.write_bytes(content)
    with pytest.raises((OSError, ValueError)) as caught:
        read_channels(path, ["Fz"], sample_rate_hz=100.0)
    one_sentence(path, caught.value)


def test_missing_and_unknown_files(tmp_path):
    with pytest.raises(FileNotFoundError, match=r"none\.h5: "):
        read_channels(tmp_path / "none.h5")
    refused(r"a\.xls: .*\.tdms.*a\.xls", read_channels, tmp_path / "a.xls")
    export = r"a\.svd: .*\.uff.*a\.svd, Polytec"
    refused(export, read_channels, tmp_path / "a.svd")


@pytest.mark.parametrize("kind", KINDS)
@settings(max_examples=15, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(
    changes=st.lists(
        st.tuples(st.floats(0.0, 1.0, exclude_max=True), st.binary(min_size=1, max_size=4)), min_size=1, max_size=4
    )
)
@example(changes=[(0.0, b"\xff\xff\xff\xff")])
def test_damaged_files_give_one_sentence_or_numbers(tmp_path, kind, changes):
    suffix, content = whole(kind)
    damaged = bytearray(content)
    for share, new in changes:
        position = int(share * len(content))
        damaged[position : position + len(new)] = new
    path = tmp_path / f"a{suffix}"
    path.write_bytes(bytes(damaged))
    try:
        read_all(path)
    except (OSError, ValueError) as error:
        one_sentence(path, error)


CHANNELS, SAMPLES = 8, 500_000
COUNTS = (np.arange(SAMPLES) % 30_011).astype("<i2")


def _large_tdms(path: Path, interleaved: bool) -> None:
    entries = [
        tdms.entry(f"/'g'/'{i}'", tdms.plain("i2", SAMPLES), {"wf_increment": 1e-3, **tdms.linear(0.5, 0.0)})
        for i in range(CHANNELS)
    ]
    raw = tdms.interleaved(*[COUNTS] * CHANNELS) if interleaved else COUNTS.tobytes() * CHANNELS
    path.write_bytes(tdms.segment(entries, raw, 14 | (tdms.INTERLEAVED if interleaved else 0)))


def _hdf5(path: Path, table: bool) -> None:
    with h5py.File(path, "w") as file:
        file.attrs["sample_rate"] = 1e3
        if table:
            file.create_dataset("t", data=np.stack([COUNTS] * CHANNELS, axis=1), chunks=(4096, 8), compression="lzf")
        for i in range(0 if table else CHANNELS):
            file.create_dataset(f"{i}", data=COUNTS, chunks=(65_536,), compression="lzf")


def _csv(path: Path) -> None:
    rows = "\n".join(f"{value}.5" + f";{value}" * (CHANNELS - 1) for value in COUNTS[:30_000].tolist())
    path.write_text(";".join(f"c{i}" for i in range(CHANNELS)) + "\n" + rows.replace(".", ",") + "\n")


def _uff(path: Path) -> None:
    one = uff.binary_function(2, np.arange(2.0), COUNTS.astype(float), True, "<")
    path.write_bytes(one * CHANNELS)


@pytest.mark.parametrize(
    ("suffix", "write"),
    [
        (".tdms", lambda path: _large_tdms(path, True)),
        (".tdms", lambda path: _large_tdms(path, False)),
        (".h5", lambda path: _hdf5(path, False)),
        (".h5", lambda path: _hdf5(path, True)),
        (".csv", _csv),
        (".uff", _uff),
    ],
    ids=["TDMS interleaved", "TDMS", "HDF5", "HDF5 table", "CSV", "UFF binary"],
)
def test_memory_is_that_of_the_result(tmp_path, suffix, write):
    path = tmp_path / f"large{suffix}"
    assert callable(write)
    write(path)
    rate = 1e3 if suffix == ".csv" else None
    first = list(read_channels(path, sample_rate_hz=rate))[:1]  # loads the libraries
    for names in (first, None):
        tracemalloc.start()
        try:
            channels = read_channels(path, names, rate)
            _, peak = tracemalloc.get_traced_memory()
        finally:
            tracemalloc.stop()
        assert peak < sum(channel.samples.nbytes for channel in channels.values()) + 8 * BLOCK


def present(data_dir: Path, *parts: str) -> Path:
    path = data_dir.joinpath(*parts)
    if not path.is_file():
        pytest.skip(f"no real data: {path} does not exist")
    return path


def fields(path: Path, first: int, last: int | None, width: int) -> np.ndarray:
    """Numbers of fixed width in lines of text, counted from 0."""
    lines = [line.rstrip() for line in path.read_text(encoding="latin-1").splitlines()[first:last]]
    return np.array([float(line[i : i + width]) for line in lines for i in range(0, len(line), width)])


def test_uff_text_with_a_short_last_line(data_dir):
    path = present(data_dir, "uff", "time-history-not-all-columns-filled.uff")
    channel = read_channels(path)["1x"]
    np.testing.assert_array_equal(channel.samples, fields(path, 13, -1, 13))
    assert (len(channel.samples), channel.sample_rate_hz, channel.start_s) == (13, 20_000.0, 0.0)
    assert channel.unit == "m/s²"


def test_uff_text_of_a_power_spectral_density(data_dir):
    path = present(data_dir, "uff", "sample_dataset58_psd.uff")
    (function,) = read_universal_functions(path)
    triples = fields(path, 13, -1, 13).reshape(-1, 3)
    np.testing.assert_array_equal(function.abscissa, triples[:, 0])
    np.testing.assert_array_equal(function.value, triples[:, 1] + 1j * triples[:, 2])
    assert len(function.value) == 3201
    assert (function.abscissa[-1], function.value[-1]) == (3200.0, 2.634827e-10)
    assert (function.name, function.kind, function.unit) == ("Pilot 1", "power spectral density", "g²/Hz")
    assert not read_channels(path)
    assert not read_universal_shapes(path)


@pytest.mark.parametrize(
    ("file", "name", "kind", "count", "rate", "unit"),
    [
        ("Sample_UFF58b_bin.uff", "Mic 01", "<f4", 79_292, pytest.approx(65_536.0, rel=1e-6), "Pa"),
        ("binary8byte.uff", "sine 5 Hz", "<f8", 250, 100.0, "g"),
    ],
)
def test_uff_binary(data_dir, file, name, kind, count, rate, unit):
    path = present(data_dir, "uff", file)
    channel, raw = read_channels(path)[name], path.read_bytes()
    expected = np.frombuffer(raw[-8 - int(kind[-1]) * count : -8], kind)  # what follows is the mark of the end
    np.testing.assert_array_equal(channel.samples, expected)
    assert (len(channel.samples), channel.sample_rate_hz, channel.unit) == (count, rate, unit)
    if name == "sine 5 Hz":
        np.testing.assert_allclose(expected, np.sin(2 * np.pi * 5.0 * np.arange(250) / 100.0), atol=1e-5)


def as_npTDMS_reads_it(path: Path) -> dict[str, RawChannel]:
    """The channels of a file, compared with those of the other library."""
    found, groups = read_channels(path), TdmsFile.read(path).groups()
    other = {f"{group.name}/{channel.name}": channel[:] for group in groups for channel in group.channels()}
    assert list(found) == list(other)
    for name, samples in other.items():
        np.testing.assert_array_equal(found[name].samples, samples)
    return found


def test_tdms_of_a_card_with_seven_channels(data_dir):
    path = present(data_dir, "tdms", "raw1.tdms")
    found = as_npTDMS_reads_it(path)
    counts = np.frombuffer(path.read_bytes()[4737 : 4737 + 28_000], "<i2").reshape(2000, 7)
    for column, channel in zip(counts.T, found.values(), strict=True):
        np.testing.assert_allclose(channel.samples, column * 0.0003051850947599719, rtol=1e-15)
        assert (channel.unit, channel.start_s) == ("Volts", 0.0)
        assert channel.sample_rate_hz == pytest.approx(50_000.0)


def test_tdms_with_the_most_significant_byte_first(data_dir):
    path = present(data_dir, "tdms", "big_endian.tdms")
    found = as_npTDMS_reads_it(path)
    tail = np.frombuffer(path.read_bytes()[-48_000:], ">f8").reshape(6, 2, 500)
    np.testing.assert_array_equal(found["Measured Data/Phase sweep"].samples[500:], tail[:, 1].ravel())
    assert found["Measured Data/Amplitude sweep"].sample_rate_hz == pytest.approx(1000.0)


def test_tdms_of_a_digital_line(data_dir):
    path = present(data_dir, "tdms", "Digital_Input.tdms")
    found = as_npTDMS_reads_it(path)
    group = "07/09/2012 06:58:23 PM - Digital Input - All Data"
    line = found[f"{group}/Dev1_port3_line7 - line 0"]
    np.testing.assert_array_equal(line.samples, np.frombuffer(path.read_bytes()[1678:21_678], "u1"))
    assert (len(line.samples), line.sample_rate_hz, set(line.samples)) == (20_000, 2000.0, {0.0, 1.0})
    assert [channel.sample_rate_hz for channel in found.values()] == [2000.0, 40.0, 0.8]


def test_lvm_of_three_tones(data_dir):
    path = present(data_dir, "shaker_three_tone", "data_set_1_downsampled_by_256.lvm")
    found = read_channels(path)
    table = np.loadtxt(path, skiprows=23, delimiter="\t")
    np.testing.assert_array_equal(np.stack([channel.samples for channel in found.values()], axis=1), table[:, 1:])
    assert len(table) == 3941
    assert [channel.unit for channel in found.values()] == ["Volts", "Pounds", "g"]
    assert {channel.sample_rate_hz for channel in found.values()} == {51_200.0 / 256}


def test_lvm_of_hammer_records_with_decimal_comma(data_dir):
    path = present(data_dir, "undersampled_video", "acceleration.lvm")
    acceleration, force = read_channels(path).values()
    lines = path.read_text().replace(",", ".").splitlines()[23:]
    table = np.array([[float(cell) for cell in line.split("\t")[1:3]] for line in lines if line.strip()])
    np.testing.assert_array_equal(np.stack([acceleration.samples, force.samples], axis=1), table)
    assert (acceleration.unit, force.unit, len(table)) == ("g", "Newtons", 50_030)
    assert acceleration.sample_rate_hz == pytest.approx(50_000.0, rel=1e-12)
