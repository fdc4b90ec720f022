"""Files that lie: they declare what they do not hold, lead to other files, inflate, nest, or are no files at all."""

from __future__ import annotations

import os
import struct
import zlib
from pathlib import Path

import h5py
import numpy as np
import pytest
import scipy.io
import tdms_factory as tdms
from contracts import refused

from shaker.io import channel, read_channels
from shaker.io.channel import LONGEST_LINE, MOST_CHANNELS
from shaker.io.table import table_units
from shaker.lines import spectrum
from shakercal._common.mat5 import check_mat5, load_mat


def _declared(path: Path, shape: tuple[int, ...], **options: object) -> None:
    with h5py.File(path, "w") as file:
        file.attrs["fs"] = 10.0
        file.create_dataset("a", shape=shape, dtype="f8", **options)


@pytest.mark.parametrize("suffix", [".h5", ".mat"])
def test_samples_that_are_declared_but_not_stored_are_refused(tmp_path, suffix):
    path = tmp_path / f"a{suffix}"
    _declared(path, (10**12,), chunks=(1 << 16,))
    refused(f'a{suffix}: dataset "a": ', read_channels, path, sample_rate_hz=10.0)
    with h5py.File(path, "a") as file:
        file["a"][:10] = 1.0
    refused('channel "a": .*590 MB.*8000000 MB', read_channels, path, sample_rate_hz=10.0)
    _declared(path, (10**6,), chunks=(1 << 16,), compression="gzip")
    with h5py.File(path, "a") as file:
        file["a"][:] = 0.0
    assert len(read_channels(path, ["a"], 10.0)["a"].samples) == 10**6  # zeros shrink a thousand times, and are read
    _declared(path, (10**9,), chunks=(10**8,), compression="gzip")
    with h5py.File(path, "a") as file:
        file["a"].id.write_direct_chunk((0,), zlib.compress(bytes(100)))
    refused("chunk: .*5.. MB.*800 MB", read_channels, path, None, 1.0)


@pytest.mark.parametrize("suffix", [".h5", ".mat"])
def test_samples_in_other_files_are_refused_by_name(tmp_path, suffix):
    """HDF5 follows external storage, virtual datasets and links to anywhere on the disk."""
    (tmp_path / "secret").write_bytes(np.arange(100.0).tobytes())
    other, path = tmp_path / "other.h5", tmp_path / f"a{suffix}"
    with h5py.File(other, "w") as file:
        file["a"] = np.arange(100.0)
    _declared(path, (100,), external=[(str(tmp_path / "secret"), 0, 800)])
    refused(r'dataset "a": .*external', read_channels, path, ["a"], 1.0)
    layout = h5py.VirtualLayout(shape=(100,), dtype="f8")
    layout[:] = h5py.VirtualSource(str(other), "a", shape=(100,))
    with h5py.File(path, "w", libver="latest") as file:
        file.create_virtual_dataset("a", layout)
    refused(r'dataset "a": .*virtual', read_channels, path, ["a"], 1.0)
    with h5py.File(path, "w") as file:
        file["a"] = h5py.ExternalLink(str(other), "/a")
    refused(r'"a": .*link', read_channels, path, ["a"], 1.0)
    with h5py.File(path, "w") as file:
        file["own"] = np.arange(100.0)
        file["soft"] = h5py.SoftLink("/own")
    np.testing.assert_array_equal(read_channels(path, ["own"], 1.0)["own"].samples, np.arange(100.0))
    with h5py.File(path, "w") as file:
        group = file
        for _ in range(80):
            group = group.create_group("g")
        group["a"] = np.arange(10.0)
    refused(f"a{suffix}: .* 64 ", read_channels, path, None, 1.0)


def _element(kind: int, content: bytes) -> bytes:
    return struct.pack("<II", kind, len(content)) + content + bytes(-len(content) % 8)


@pytest.mark.parametrize("packed", [False, True])
def test_matlab_structures_inside_one_another_and_bombs_are_refused(tmp_path, monkeypatch, packed):
    """The reader of such files ends the program somewhere between 10 000 and 20 000 cells in one another."""
    cell = _element(6, struct.pack("<II", 1, 0)) + _element(5, struct.pack("<ii", 1, 1)) + _element(1, b"")
    content = b"".join(struct.pack("<II", 14, 48 * (50_000 - n) - 8) + cell for n in range(50_000))
    squeezed = zlib.compress(content)
    head = b"MATLAB 5.0 MAT-file".ljust(124) + struct.pack("<H", 0x0100) + b"IM"
    path = tmp_path / "a.mat"
    path.write_bytes(head + (struct.pack("<II", 15, len(squeezed)) + squeezed if packed else content))
    refused(r"a\.mat: .* 64 ", read_channels, path)
    if packed:
        monkeypatch.setattr(channel, "_FREE", 1 << 20)
        scipy.io.savemat(path, {"a": np.zeros(10**7, np.uint8), "fs": 1.0}, do_compression=True)
        refused(r"a\.mat: .*\d+ MB", read_channels, path)


@pytest.mark.parametrize("order", ["<", ">"])
@pytest.mark.parametrize(
    ("array_class", "data", "found"),
    [
        (6, (0, 8), "type 0 with 8 bytes"),  # each of these ends SciPy's process
        (6, (14, 8), "type 14"),
        (6, (19, 8), "type 19"),
        (4, (0, 8), "type 0"),
        (4, (4, 1 << 31), "variable"),
        (23, (9, 8), "class 23"),
        (1, (14, 8), "1000000 .*16 bytes"),
    ],
)
def test_matlab_tags_that_the_reader_would_trust_are_refused(tmp_path, order, array_class, data, found):
    def words(*numbers: int) -> bytes:
        return struct.pack(f"{order}{len(numbers)}I", *numbers)

    shape = (1000, 1000) if array_class == 1 else (1, 1)
    content = words(6, 8, array_class, 0, 5, 8, *shape, 1, 1) + b"a".ljust(8, b"\0") + words(*data) + bytes(8)
    head = b"MATLAB 5.0 MAT-file".ljust(124) + struct.pack(f"{order}2H", 0x0100, 0x4D49)
    (tmp_path / "a.mat").write_bytes(head + words(14, len(content)) + content)
    refused(rf"a\.mat: .*{found}", read_channels, tmp_path / "a.mat", None, 1.0)
    (tmp_path / "a.mat").write_bytes(head + words(14, len(content) + 8) + content)
    refused(r"a\.mat: .*variable", read_channels, tmp_path / "a.mat", None, 1.0)


def test_matlab_files_of_many_writers_pass(tmp_path):
    """SciPy brings files that MATLAB 5 to 7.4 wrote on several machines: what it reads of them is not refused."""
    samples = sorted((Path(scipy.io.__file__).parent / "matlab/tests/data").glob("*.mat"))
    if not samples:
        pytest.skip("SciPy is installed without its sample files")
    for path in samples:
        try:
            load_mat(path)
        except (TypeError, ValueError, NotImplementedError, zlib.error):
            continue
        check_mat5(path, 1 << 24, 1000)


def test_sums_of_scales_of_a_card_are_counted(tmp_path):
    """Each scale adds the one before to itself: 2⁶⁰ evaluations."""
    scales: dict[str, object] = {"wf_increment": 0.01, **tdms.linear(1.0, 0.0), "NI_Number_Of_Scales": 61}
    for n in range(1, 61):
        scales[f"NI_Scale[{n}]_Scale_Type"] = "Add"
        scales[f"NI_Scale[{n}]_Add_Left_Operand_Input_Source"] = n - 1
        scales[f"NI_Scale[{n}]_Add_Right_Operand_Input_Source"] = n - 1
    path = tmp_path / "a.tdms"
    path.write_bytes(tdms.segment([tdms.entry("/'g'/'a'", tdms.plain("f8", 8), scales)], bytes(64)))
    refused(r'a\.tdms: channel "g/a": .* 1000 ', read_channels, path)


@pytest.mark.parametrize(
    ("name", "head"),
    [
        ("a.csv", b"a,b\n1,2\n"),
        ("b.csv", b""),
        ("a.asc", b"\n" * 18 + b"1 2 3\n10 0.1\n"),
        (
            "a.lvm",
            b"LabVIEW Measurement\t\n***End_of_Header***\t\n\t\nDelta_X\t1\t\n***End_of_Header***\t\nX_Value\tU\n",
        ),
        ("a.uff", b"    -1\n    58\n"),
    ],
)
def test_lines_without_an_end_are_refused(tmp_path, name, head):
    path = tmp_path / name
    path.write_bytes(head + b"1" * (2 * LONGEST_LINE))
    refused(rf"{name}: ", read_channels, path, None, 1.0)


def test_thousands_of_columns_do_not_take_minutes(tmp_path):
    path = tmp_path / "a.lvm"
    titles = "\t".join(["X_Value", *["a"] * (2 * MOST_CHANNELS)])
    path.write_text(
        f"LabVIEW Measurement\t\n***End_of_Header***\t\n\t\nDelta_X\t1\t\n***End_of_Header***\t\n{titles}\n"
    )
    refused(r"a\.lvm: line \d+: .*10000.*20001", read_channels, path)
    path = tmp_path / "a.csv"
    path.write_text(",".join(f"c{n}" for n in range(15_000)) + "\n" + ",".join(["1.5"] * 15_000) + "\n")
    assert len(table_units(path)) == 15_000


def test_a_path_that_is_no_file_is_refused_before_opening(tmp_path):
    os.mkfifo(tmp_path / "pipe.csv")
    (tmp_path / "folder.h5").mkdir()
    (tmp_path / "self.mat").symlink_to("self.mat")
    (tmp_path / "zero.wav").symlink_to("/dev/zero")
    for name, found in (
        ("pipe.csv", "pipe"),
        ("folder.h5", "folder"),
        ("self.mat", "symbolic"),
        ("zero.wav", "pipe"),
        ("nul\0.csv", "null"),
        ("a" * 300 + ".csv", "long"),
    ):
        refused(f": .*{found}", read_channels, tmp_path / name, error=FileNotFoundError)


@pytest.mark.parametrize("count", [16 * 3 * 5 * 101, 17 * 16 * 45 + 17])
def test_long_transforms_put_together_are_those_of_the_whole(monkeypatch, count):
    """Against the definition of the discrete Fourier transform at a few bins, and numpy's transform of the whole."""
    monkeypatch.setattr(spectrum, "_MIN_SPLIT_SAMPLES", 1)
    monkeypatch.setattr(spectrum, "_BLOCK_BINS", 1 << 10)
    samples, n = np.random.default_rng(1).normal(size=count) + 3.0, np.arange(count)
    flat = (samples - samples.mean()) * (1.0 + np.cos(2.0 * np.pi / count * (n - (count - 1) / 2.0)))
    found = spectrum.centred_spectrum(samples)
    k = np.arange(len(found))
    expected = np.fft.rfft(flat) * np.exp(1j * np.pi * k * (count - 1) / count) * 2.0 / count
    np.testing.assert_allclose(found, expected, rtol=0.0, atol=1e-12)
    for bin_number in (1, 77, len(found) - 1):
        direct = 2.0 / count * (flat @ np.exp(-2j * np.pi * bin_number * (n - (count - 1) / 2.0) / count))
        assert abs(found[bin_number] - direct) < 1e-12
