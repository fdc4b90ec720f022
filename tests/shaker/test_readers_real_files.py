"""One test per file that other laboratories wrote, each read a second time without the readers.

The films and displacements beside the hammer records are images, and tested with those.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from nptdms import TdmsFile

from shaker.io import read_channels
from shaker.io.channel import RawChannel
from shaker.io.universal import read_universal_functions, read_universal_shapes


def present(data_dir: Path, *parts: str) -> Path:
    path = data_dir.joinpath(*parts)
    if not path.is_file():
        pytest.skip(f"no real data: {path} does not exist")
    return path


def fields(path: Path, first: int, last: int | None, width: int) -> np.ndarray:
    """Numbers of fixed width in lines of text, counted from 0."""
    lines = [line.rstrip() for line in path.read_text(encoding="latin-1").splitlines()[first:last]]
    return np.array([float(line[i : i + width]) for line in lines for i in range(0, len(line), width)])


def test_uff_text_with_a_short_last_line(data_dir: Path) -> None:
    path = present(data_dir, "uff", "time-history-not-all-columns-filled.uff")
    channel = read_channels(path)["1x"]
    np.testing.assert_array_equal(channel.samples, fields(path, 13, -1, 13))
    assert (len(channel.samples), channel.sample_rate_hz, channel.start_s) == (13, 20_000.0, 0.0)
    assert channel.unit == "m/s²"


def test_uff_text_of_a_power_spectral_density(data_dir: Path) -> None:
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


def test_uff_binary_of_single_precision(data_dir: Path) -> None:
    path = present(data_dir, "uff", "Sample_UFF58b_bin.uff")
    channel = read_channels(path)["Mic 01"]
    raw = path.read_bytes()
    assert raw.endswith(b"    -1\r\n")
    np.testing.assert_array_equal(channel.samples, np.frombuffer(raw[-8 - 4 * 79_292 : -8], "<f4"))
    assert (len(channel.samples), channel.unit) == (79_292, "Pa")
    assert channel.sample_rate_hz == pytest.approx(65_536.0, rel=1e-6)


def test_uff_binary_of_double_precision(data_dir: Path) -> None:
    path = present(data_dir, "uff", "binary8byte.uff")
    channel = read_channels(path)["sine 5 Hz"]
    raw = path.read_bytes()
    np.testing.assert_array_equal(channel.samples, np.frombuffer(raw[-8 - 8 * 250 : -8], "<f8"))
    np.testing.assert_allclose(channel.samples, np.sin(2 * np.pi * 5.0 * np.arange(250) / 100.0), atol=1e-5)
    assert (channel.sample_rate_hz, channel.unit) == (100.0, "g")


def npTDMS(path: Path) -> dict[str, np.ndarray]:
    file = TdmsFile.read(path)
    return {f"{group.name}/{channel.name}": channel[:] for group in file.groups() for channel in group.channels()}


def compare(found: dict[str, RawChannel], other: dict[str, np.ndarray]) -> None:
    assert list(found) == list(other)
    for name, samples in other.items():
        np.testing.assert_array_equal(found[name].samples, samples)


def test_tdms_of_a_card_with_seven_channels(data_dir: Path) -> None:
    path = present(data_dir, "tdms", "raw1.tdms")
    found = read_channels(path)
    compare(found, npTDMS(path))
    counts = np.frombuffer(path.read_bytes()[4737 : 4737 + 28_000], "<i2").reshape(2000, 7)
    for column, channel in zip(counts.T, found.values(), strict=True):
        np.testing.assert_allclose(channel.samples, column * 0.0003051850947599719, rtol=1e-15)
        assert (channel.unit, channel.start_s) == ("Volts", 0.0)
        assert channel.sample_rate_hz == pytest.approx(50_000.0)


def test_tdms_with_the_most_significant_byte_first(data_dir: Path) -> None:
    path = present(data_dir, "tdms", "big_endian.tdms")
    found = read_channels(path)
    compare(found, npTDMS(path))
    tail = np.frombuffer(path.read_bytes()[-48_000:], ">f8").reshape(6, 2, 500)
    np.testing.assert_array_equal(found["Measured Data/Phase sweep"].samples[500:], tail[:, 1].ravel())
    assert found["Measured Data/Amplitude sweep"].sample_rate_hz == pytest.approx(1000.0)


def test_tdms_of_a_digital_line(data_dir: Path) -> None:
    path = present(data_dir, "tdms", "Digital_Input.tdms")
    found = read_channels(path)
    compare(found, npTDMS(path))
    group = "07/09/2012 06:58:23 PM - Digital Input - All Data"
    line = found[f"{group}/Dev1_port3_line7 - line 0"]
    np.testing.assert_array_equal(line.samples, np.frombuffer(path.read_bytes()[1678:21_678], "u1"))
    assert (len(line.samples), line.sample_rate_hz, set(line.samples)) == (20_000, 2000.0, {0.0, 1.0})
    assert [channel.sample_rate_hz for channel in found.values()] == [2000.0, 40.0, 0.8]


@pytest.mark.parametrize(("factor", "samples"), [(16, 63_041), (128, 7881), (256, 3941)])
def test_lvm_of_three_tones(data_dir: Path, factor: int, samples: int) -> None:
    path = present(data_dir, "shaker_three_tone", f"data_set_1_downsampled_by_{factor}.lvm")
    found = read_channels(path)
    table = np.loadtxt(path, skiprows=23, delimiter="\t")
    np.testing.assert_array_equal(np.stack([channel.samples for channel in found.values()], axis=1), table[:, 1:])
    assert len(table) == samples
    assert [channel.unit for channel in found.values()] == ["Volts", "Pounds", "g"]
    assert {channel.sample_rate_hz for channel in found.values()} == {51_200.0 / factor}


@pytest.mark.parametrize("name", ["acceleration", "camera"])
def test_lvm_of_hammer_records_with_decimal_comma(data_dir: Path, name: str) -> None:
    path = present(data_dir, "undersampled_video", f"{name}.lvm")
    acceleration, force = read_channels(path).values()
    lines = path.read_text().replace(",", ".").splitlines()[23:]
    table = np.array([[float(cell) for cell in line.split("\t")[1:3]] for line in lines if line.strip()])
    np.testing.assert_array_equal(np.stack([acceleration.samples, force.samples], axis=1), table)
    assert (acceleration.unit, force.unit, len(table)) == ("g", "Newtons", 50_030)
    assert acceleration.sample_rate_hz == pytest.approx(50_000.0, rel=1e-12)
