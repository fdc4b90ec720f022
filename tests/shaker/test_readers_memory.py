"""Large files need the memory of their result and a few blocks more, whatever their layout."""

from __future__ import annotations

import tracemalloc
from pathlib import Path

import h5py
import numpy as np
import pytest
import tdms_factory as tdms
import universal_factory as uff

from shaker.io import read_channels
from shaker.io.channel import BLOCK

CHANNELS, SAMPLES = 8, 500_000
COUNTS = (np.arange(SAMPLES) % 30_011).astype("<i2")


def _tdms(path: Path, interleaved: bool) -> None:
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
        (".tdms", lambda path: _tdms(path, True)),
        (".tdms", lambda path: _tdms(path, False)),
        (".h5", lambda path: _hdf5(path, False)),
        (".h5", lambda path: _hdf5(path, True)),
        (".csv", _csv),
        (".uff", _uff),
    ],
    ids=["TDMS interleaved", "TDMS", "HDF5", "HDF5 table", "CSV", "UFF binary"],
)
def test_memory_is_that_of_the_result(tmp_path: Path, suffix: str, write: object) -> None:
    path = tmp_path / f"large{suffix}"
    assert callable(write)
    write(path)
    first = list(read_channels(path, sample_rate_hz=1e3))[:1]  # loads the libraries
    for names in (first, None):
        tracemalloc.start()
        try:
            channels = read_channels(path, names, 1e3)
            _, peak = tracemalloc.get_traced_memory()
        finally:
            tracemalloc.stop()
        assert peak < sum(channel.samples.nbytes for channel in channels.values()) + 8 * BLOCK
