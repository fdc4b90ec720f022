"""Speed and memory of the readers on large files, beside the libraries that others read them with.

Usage: python benchmarks/signals_readers.py [--megabytes 128] [--text-megabytes 100]

Writes one file of every kind into a temporary folder, then reads all channels of each in a process of its own, with
every program in turn. Printed: megabytes of the file per second, and the largest memory of the process while it read,
less what it held before, over the size of the result (all channels as float64). A result alone is 1. Every program's
numbers are compared with those written. Some two minutes on one core.
"""

from __future__ import annotations

import argparse
import multiprocessing
import struct
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from shaker.io import read_channels

FloatArray = NDArray[np.float64]
CHANNELS = 16
SLOPE, RATE_HZ = 1e-3, 51_200.0
WARM_UP = 2000  # samples of the small file that a process reads first, so that imports are not counted


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--megabytes", type=float, default=128.0, help="size of the binary files")
    parser.add_argument("--text-megabytes", type=float, default=100.0, help="size of the text files")
    options = parser.parse_args()
    print("| file | MB | program | MB/s | memory / result |\n|---|---|---|---|---|", flush=True)
    with tempfile.TemporaryDirectory() as folder:
        for name, (suffix, write, programs) in KINDS.items():
            text = name.startswith(("CSV", "LVM", "UFF 58 text"))
            megabytes = options.text_megabytes if text else options.megabytes
            path, small = Path(folder) / f"large{suffix}", Path(folder) / f"small{suffix}"
            write(small, WARM_UP)
            write(path, int(megabytes / (small.stat().st_size / WARM_UP) * 1e6))
            for program in ("shakercal", *programs):
                report(name, path, small, program)
            path.unlink()


def report(name: str, path: Path, small: Path, program: str) -> None:
    """Read a file with one program in a process of its own, and print its row."""
    context = multiprocessing.get_context("spawn")
    with context.Pool(1) as pool:
        seconds, memory, result = pool.apply(measured, (path, small, program))
    megabytes = path.stat().st_size / 1e6
    print(f"| {name} | {megabytes:.0f} | {program} | {megabytes / seconds:.0f} | {memory / result:.2f} |", flush=True)


def measured(path: Path, small: Path, program: str) -> tuple[float, float, float]:
    """Return seconds, bytes of memory above the start's, and bytes of the result of one reading."""
    read = PROGRAMS[program]
    check(read(small))
    before, begin = status("VmRSS"), time.process_time()
    columns = read(path)
    seconds = time.process_time() - begin
    memory = status("VmHWM") - before
    check(columns)
    return seconds, memory, float(sum(len(column) for column in columns) * 8)


def status(key: str) -> float:
    """Return a number of bytes from the process's status, NaN where the system has none."""
    try:
        lines = Path("/proc/self/status").read_text().splitlines()
    except OSError:
        return float("nan")
    return next(float(line.split()[1]) * 1024 for line in lines if line.startswith(key))


def check(columns: list[FloatArray]) -> None:
    """Compare the ends of all channels with what was written."""
    for number, column in enumerate(columns):
        for part in (slice(0, 100), slice(len(column) - 100, len(column))):
            np.testing.assert_allclose(column[part], raw(len(column), number)[part] * SLOPE, rtol=1e-6, atol=1e-9)


def raw(count: int, channel: int) -> NDArray[np.int16]:
    """Return the integers (S,) of a channel."""
    return ((np.arange(count) * 7919 + channel * 104_729) % 20_011 - 10_000).astype(np.int16)


def by_shakercal(path: Path) -> list[FloatArray]:
    """Read all channels."""
    return [channel.samples for channel in read_channels(path, sample_rate_hz=RATE_HZ).values()]


def by_nptdms(path: Path) -> list[FloatArray]:
    """Read the whole file, then every channel."""
    from nptdms import TdmsFile

    file = TdmsFile.read(path)
    return [np.asarray(channel[:], dtype=np.float64) for group in file.groups() for channel in group.channels()]


def by_h5py(path: Path) -> list[FloatArray]:
    """Read every dataset whole, or the table whole."""
    import h5py

    with h5py.File(path) as file:
        whole = [np.asarray(dataset[()]).astype(np.float64) for dataset in file.values()]
    return whole if whole[0].ndim == 1 else list(np.ascontiguousarray(whole[0].T))


def by_loadtxt(path: Path) -> list[FloatArray]:
    """Read the rows below the header (LVM: comma as decimal point) with numpy."""
    if path.suffix == ".csv":
        return list(np.loadtxt(path, delimiter=",", skiprows=1, unpack=True))
    with path.open() as stream:
        while not stream.readline().startswith("X_Value"):
            pass
        lines = (line.replace(",", ".")[1:] for line in stream)
        return list(np.loadtxt(lines, delimiter="\t", unpack=True))


def by_pyuff(path: Path) -> list[FloatArray]:
    """Read all data sets."""
    import pyuff

    return [np.asarray(record["data"]) for record in pyuff.UFF(str(path)).read_sets()]


def write_tdms(path: Path, count: int, interleaved: bool) -> None:
    """Write one segment of 16-bit integers with a linear scale: all channels row by row, or one after another."""

    def text(value: str) -> bytes:
        return struct.pack("<L", len(value)) + value.encode()

    def entry(name: str, value: str | float | int) -> bytes:
        if isinstance(value, str):
            return text(name) + struct.pack("<L", 0x20) + text(value)
        return text(name) + (
            struct.pack("<Ld", 10, value) if isinstance(value, float) else struct.pack("<LL", 7, value)
        )

    scale: dict[str, str | float] = {"Scale_Type": "Linear", "Linear_Slope": SLOPE, "Linear_Y_Intercept": 0.0}
    entries = [entry("wf_increment", 1.0 / RATE_HZ), entry("NI_Number_Of_Scales", 1)]
    entries += [entry(f"NI_Scale[0]_{key}", value) for key, value in scale.items()]
    metadata = struct.pack("<L", CHANNELS)
    for number in range(CHANNELS):
        metadata += text(f"/'daq'/'{number}'") + struct.pack("<LLLQ", 20, 2, 1, count)
        metadata += struct.pack("<L", len(entries)) + b"".join(entries)
    flags = 0b1110 | (0x20 if interleaved else 0)
    with path.open("wb") as stream:
        size = len(metadata) + 2 * CHANNELS * count
        stream.write(b"TDSm" + struct.pack("<LLQQ", flags, 4713, size, len(metadata)) + metadata)
        if interleaved:
            np.stack([raw(count, number) for number in range(CHANNELS)], axis=1).tofile(stream)
        else:
            for number in range(CHANNELS):
                raw(count, number).tofile(stream)


def write_hdf5(path: Path, count: int, kind: str, table: bool) -> None:
    """Write compressed chunks, one dataset per channel or one table."""
    import h5py

    columns = [(raw(count, number) * SLOPE).astype(kind) for number in range(CHANNELS)]
    with h5py.File(path, "w") as file:
        file.attrs["sample_rate"] = RATE_HZ
        if table:
            file.create_dataset(
                "daq", data=np.stack(columns, axis=1), chunks=(min(4096, count), CHANNELS), compression="lzf"
            )
        for number, column in enumerate([] if table else columns):
            file.create_dataset(f"{number:02d}", data=column, chunks=(min(65_536, count),), compression="lzf")


def write_text(path: Path, count: int, labview: bool) -> None:
    """Write a table with a point and commas, or a LabVIEW file with decimal commas."""
    names = [f"channel {number}" for number in range(CHANNELS)]
    head = ",".join(names) + "\n"
    if labview:
        head = "LabVIEW Measurement\t\nSeparator\tTab\nDecimal_Separator\t,\nX_Columns\tNo\n***End_of_Header***\t\n\t\n"
        head += f"Channels\t{CHANNELS}\nDelta_X" + "\t1,953125E-5" * CHANNELS + "\n***End_of_Header***\n"
        head += "X_Value\t" + "\t".join(names) + "\n"
    with path.open("w", newline="\n") as stream:
        stream.write(head)
        columns = [raw(count, number) for number in range(CHANNELS)]
        for first in range(0, count, 20_011):
            block = np.stack([column[first : first + 20_011] for column in columns], axis=1) * SLOPE
            separator = "\t" if labview else ","
            rows = "\n".join(separator.join([f"{value:.6f}" for value in row]) for row in block.tolist()) + "\n"
            stream.write(("\t" + rows[:-1].replace("\n", "\n\t") + "\n").replace(".", ",") if labview else rows)


def write_universal(path: Path, count: int, binary: bool) -> None:
    """Write data sets 58, single precision, as text or binary."""
    names = [f"c{number}" for number in range(CHANNELS)]
    with path.open("wb") as stream:
        for number, name in enumerate(names):
            values = raw(count, number) * SLOPE
            first = f"    58b     1     2          11{4 * count:12d}     0     0           0           0"
            head = ["    -1", first if binary else "    58", *["NONE"] * 5]
            head += [f"    1         0    0         0 {name:10s}         1   3 NONE               0   0"]
            head += [f"         2{count:10d}         1  0.00000E+00  1.95312E-05  0.00000E+00"]
            head += ["        17    0    0    0 NONE                 s                   "]
            head += ["         0    0    0    0 NONE                 NONE                "] * 3
            stream.write("\n".join(head).encode() + b"\n")
            if binary:
                stream.write(values.astype("<f4").tobytes())
            else:
                rows = values[: count // 6 * 6].reshape(-1, 6)
                lines = [("%13.5E" * 6) % tuple(row) for row in rows.tolist()]
                lines.append("".join(f"{value:13.5E}" for value in values[count // 6 * 6 :]))
                stream.write("\n".join(line for line in lines if line).encode() + b"\n")
            stream.write(b"    -1\n")


PROGRAMS: dict[str, Callable[[Path], list[FloatArray]]] = {
    "shakercal": by_shakercal,
    "npTDMS": by_nptdms,
    "h5py": by_h5py,
    "np.loadtxt": by_loadtxt,
    "pyuff": by_pyuff,
}
KINDS: dict[str, tuple[str, Callable[[Path, int], None], tuple[str, ...]]] = {
    "TDMS int16, scaled, interleaved": (".tdms", lambda p, n: write_tdms(p, n, True), ("npTDMS",)),
    "TDMS int16, scaled, one block per channel": (".tdms", lambda p, n: write_tdms(p, n, False), ("npTDMS",)),
    "HDF5 float32, lzf, datasets": (".h5", lambda p, n: write_hdf5(p, n, "f4", False), ("h5py",)),
    "HDF5 float32, lzf, table": (".h5", lambda p, n: write_hdf5(p, n, "f4", True), ("h5py",)),
    "CSV, 16 columns": (".csv", lambda p, n: write_text(p, n, False), ("np.loadtxt",)),
    "LVM, 16 columns, decimal comma": (".lvm", lambda p, n: write_text(p, n, True), ("np.loadtxt",)),
    "UFF 58 text": (".uff", lambda p, n: write_universal(p, n, False), ("pyuff",)),
    "UFF 58b": (".uff", lambda p, n: write_universal(p, n, True), ("pyuff",)),
}

if __name__ == "__main__":
    main()
