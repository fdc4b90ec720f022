"""Damaged and cut-off files of every kind: one sentence that begins with the file, and never another kind of error."""

from __future__ import annotations

from functools import cache
from pathlib import Path
from tempfile import TemporaryDirectory

import h5py
import numpy as np
import pytest
import scipy.io
import tdms_factory as tdms
import universal_factory as uff
from hypothesis import HealthCheck, example, given, settings
from hypothesis import strategies as st

from shaker.io import read_channels
from shaker.io.universal import read_universal_functions, read_universal_shapes

X = np.arange(120) / 100.0
Y = np.random.default_rng(0).normal(size=120)
LVM = (
    "LabVIEW Measurement\t\nSeparator\tTab\nDecimal_Separator\t.\nX_Columns\tNo\n***End_of_Header***\t\n\t\n"
    "Channels\t1\t\nSamples\t120\t\nDelta_X\t0.01\t\n***End_of_Header***\t\nX_Value\tU\tComment\n"
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
    found = len(read_channels(path, sample_rate_hz=100.0))
    if path.suffix in (".uff", ".unv"):
        found += len(read_universal_functions(path)) + len(read_universal_shapes(path))
    return found


def one_sentence(path: Path, error: Exception) -> None:
    assert str(error).startswith(f"{path}: "), error
    assert "\n" not in str(error)


@pytest.mark.parametrize("kind", KINDS)
def test_sound_files_are_read(tmp_path: Path, kind: str) -> None:
    suffix, content = whole(kind)
    (tmp_path / f"a{suffix}").write_bytes(content)
    assert read_all(tmp_path / f"a{suffix}") > 0


@pytest.mark.parametrize("kind", [kind for kind in KINDS if kind != "csv"])
def test_cut_off_files_are_refused(tmp_path: Path, kind: str) -> None:
    """CSV does not say how long it is; all others do, and a file cut anywhere is refused."""
    suffix, content = whole(kind)
    path = tmp_path / f"a{suffix}"
    for share in (0.02, 0.1, 0.3, 0.5, 0.7, 0.9, 0.97):
        path.write_bytes(content[: int(share * len(content))])
        with pytest.raises((OSError, ValueError)) as caught:
            read_all(path)
        one_sentence(path, caught.value)


@pytest.mark.parametrize("suffix", [".h5", ".tdms", ".uff", ".mat", ".csv", ".wav", ".lvm", ".asc"])
@pytest.mark.parametrize("content", [b"", b"\x00\x01\x02garbage" * 40])
def test_files_of_nothing_and_of_garbage_are_refused(tmp_path: Path, suffix: str, content: bytes) -> None:
    path = tmp_path / f"a{suffix}"
    path.write_bytes(content)
    with pytest.raises((OSError, ValueError)) as caught:
        read_channels(path, ["Fz"], sample_rate_hz=100.0)
    one_sentence(path, caught.value)


def test_missing_and_unknown_files(tmp_path: Path) -> None:
    with pytest.raises(FileNotFoundError, match=r"none\.h5: expected a file, found none"):
        read_channels(tmp_path / "none.h5")
    with pytest.raises(ValueError, match=r"a\.xls: expected a file of type .*, found \.xls"):
        read_channels(tmp_path / "a.xls")


@pytest.mark.parametrize("kind", KINDS)
@settings(max_examples=15, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(
    changes=st.lists(
        st.tuples(st.floats(0.0, 1.0, exclude_max=True), st.binary(min_size=1, max_size=4)), min_size=1, max_size=4
    )
)
@example(changes=[(0.0, b"\xff\xff\xff\xff")])
def test_damaged_files_give_one_sentence_or_numbers(
    tmp_path: Path, kind: str, changes: list[tuple[float, bytes]]
) -> None:
    suffix, content = whole(kind)
    damaged = bytearray(content)
    for share, new in changes:
        place = int(share * len(content))
        damaged[place : place + len(new)] = new
    path = tmp_path / f"a{suffix}"
    path.write_bytes(bytes(damaged))
    try:
        read_all(path)
    except (OSError, ValueError) as error:
        one_sentence(path, error)
