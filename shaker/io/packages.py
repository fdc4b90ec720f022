"""Files that optional packages read: ASAM MDF 4, Dewesoft, Parquet.

`pip install shakercal[formats]` installs asammdf, dwdatareader (a wrapper of Dewesoft's library) and pyarrow. Only the
requested channels are read. Times count from the earliest of these, because a time of day in floating-point seconds has
steps of a quarter of a microsecond.
"""

from __future__ import annotations

import gc
import json
import os
import pickle
import subprocess
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, redirect_stderr, redirect_stdout
from dataclasses import replace
from importlib import import_module
from io import StringIO
from pathlib import Path
from tempfile import TemporaryDirectory
from threading import Thread, get_ident
from traceback import clear_frames
from typing import Any

import numpy as np
from numpy.typing import NDArray

from shaker.io.channel import (
    RawChannel,
    SampleTimes,
    agreed_rate,
    as_sample_array,
    check_size,
    is_time,
    select_by_either_name,
    select_names,
    times_of_stamps,
)
from shakercal._common.arrays import FloatArray

_LONGEST_S, _SLOWEST = 8.0, 2e6  # Dewesoft's library: seconds of the processor, and bytes that it reads in each
_PATIENCE = 30.0  # how many times as long a process may take by the clock on a loaded machine
_MDF_REAL = 5  # the last of the data types that are numbers (ASAM MDF 4.1, channel block, cn_data_type)
_MDF_TIME, _MDF_INDEX = (0, 1), 4  # kinds of master channels: times or none, and numbers of samples (cn_sync_type)
_Samples = Callable[[], tuple[NDArray[Any] | None, FloatArray, str]]
"""Reads the stamps of a channel (None: it has none; floats are seconds), its samples and their unit."""


def _package(path: Path, name: str) -> Any:
    """Import an optional package; `ValueError` with the command that installs it if missing."""
    try:
        return import_module(name)
    except ImportError as error:
        kind = path.suffix.lower()
        raise ValueError(
            f"{path}: expected the package {name}, which reads {kind} files, found none; install shakercal[formats]"
        ) from error


@contextmanager
def _suppress_output() -> Iterator[None]:
    """Suppress the output of a package about damaged files, including that of deleted objects."""
    error_text, hook = "", sys.unraisablehook
    sys.unraisablehook = lambda _: None
    try:
        with redirect_stdout(StringIO()), redirect_stderr(StringIO()):
            try:
                yield
            except Exception as error:
                if isinstance(error, ValueError) and ": expected " in str(error):
                    raise
                error_text = " ".join(f"{type(error).__name__} {error}".split())[:200]
                cause: BaseException | None = error
                while cause is not None:
                    clear_frames(cause.__traceback__)
                    cause = cause.__cause__ or cause.__context__
            if error_text:
                gc.collect()
    finally:
        sys.unraisablehook = hook
    if error_text:
        raise ValueError(f"expected a readable file, found a damaged one ({error_text})")


def read_mdf(
    path: Path, names: Sequence[str] | None = None, sample_rate_hz: float | None = None
) -> dict[str, RawChannel]:
    """Read channels of an MDF 4 file as physical values with their times.

    Channels are called `group/channel`, with the group's acquisition name or number, or `channel` where only one group
    has it. Text, arrays and bus frames are skipped. `sample_rate_hz` is used for groups without a time.
    """
    asammdf = _package(path, "asammdf")
    with path.open("rb") as stream:
        if stream.read(10) not in (b"MDF     4.", b"UnFinMF 4."):
            raise ValueError(f"{path}: not a readable MDF file of version 4")
    with _suppress_output(), asammdf.MDF(path) as file:
        present: dict[str, tuple[int, int]] = {}
        for number, group in enumerate(file.groups):
            group_name = group.channel_group.acq_name or f"{number}"
            for index, channel in enumerate(group.channels):
                if index != file.masters_db.get(number) and channel.data_type <= _MDF_REAL:
                    key = f"{group_name}/{channel.name}"
                    present[key if key not in present else f"{group_name} {number}.{index}/{channel.name}"] = (
                        number,
                        index,
                    )
        short = [file.groups[number].channels[index].name for number, index in present.values()]

        def samples(position: tuple[int, int]) -> _Samples:
            def read() -> tuple[NDArray[Any] | None, FloatArray, str]:
                group = file.groups[position[0]].channel_group
                check_size(path, f"group {position[0]}", max(group.cycles_nr, 1) * group.samples_byte_nr)
                signal = file.get(group=position[0], index=position[1])
                master, kind = signal.master_metadata or ("", 0)
                if kind not in (*_MDF_TIME, _MDF_INDEX):
                    raise ValueError(f'{path}: group {position[0]}: expected samples over time, found over "{master}"')
                dated = kind in _MDF_TIME and len(signal.timestamps)
                return signal.timestamps if dated else None, signal.samples, signal.unit

            return read

        selected = select_by_either_name(path, names, present, short)
        return _make_channels(
            path, {key: samples(position) for key, position in selected.items()}, names, sample_rate_hz
        )


def read_dewesoft(
    path: Path, names: Sequence[str] | None = None, sample_rate_hz: float | None = None
) -> dict[str, RawChannel]:
    """Read channels of a Dewesoft file (.dxd, .dxz, .d7d) as physical values.

    Times are those of the samples, because files exist whose header states another rate. Dewesoft's library ends the
    whole program on a damaged file, or never returns. A separate process therefore reads it, with 8 s of processor time
    or one second for every 2 MB; intact files need a tenth.
    """
    _package(path, "dwdatareader")
    longest_s = max(_LONGEST_S, path.stat().st_size / _SLOWEST)
    with TemporaryDirectory() as folder:
        out = Path(folder) / "channels"
        code = "import sys; from shaker.io import packages; packages.dewesoft_process(*sys.argv[1:])"
        command = [sys.executable, "-c", code, str(path.resolve()), str(out), json.dumps(names), str(longest_s)]
        try:
            subprocess.run(
                command,
                check=False,
                env={**os.environ, "PYTHONPATH": os.pathsep.join(sys.path)},
                stdout=subprocess.DEVNULL,
                stderr=subprocess.DEVNULL,
                timeout=_PATIENCE * longest_s,
            )
        except subprocess.TimeoutExpired as error:
            raise ValueError(f"Dewesoft's library had not read it within {error.timeout:.0f} s") from error
        if not out.exists():
            raise ValueError("Dewesoft's library ended without a result")
        found: dict[str, RawChannel] | str = pickle.loads(out.read_bytes())
    if isinstance(found, str):
        raise ValueError(f"{path}{found}" if found.startswith(": ") else found)
    for name, channel in found.items():
        agreed_rate(path, f'channel "{name}"', channel.sample_rate_hz, sample_rate_hz)
    return found


def dewesoft_process(file: str, out: str, names: str, longest_s: str) -> None:
    """Read a Dewesoft file in this process; write channels or refusal to a file."""
    path, requested_names = Path(file), json.loads(names)
    Thread(target=_end_after, args=(float(longest_s), Path(out)), daemon=True).start()
    result: dict[str, RawChannel] | str
    try:
        with _package(path, "dwdatareader").DWFile(file) as dw_file:
            present = {channel.name: channel for channel in dw_file.values() if channel.number_of_samples > 1}

            def samples(channel: Any) -> _Samples:
                return lambda: (*channel.scaled(), channel.unit or "")

            for name, channel in present.items():
                check_size(path, f'channel "{name}"', 16 * channel.number_of_samples)
            selected = {name: samples(present[name]) for name in select_names(path, requested_names, present)}
            result = _make_channels(path, selected, requested_names, None)
    except Exception as error:  # errors of every kind from the library
        result = str(error).removeprefix(file) or type(error).__name__
    _write_result(Path(out), result)


def _write_result(out: Path, result: object) -> None:
    whole = out.with_suffix(f".{get_ident()}")
    whole.write_bytes(pickle.dumps(result))
    whole.replace(out)


def _end_after(longest_s: float, out: Path) -> None:
    """End this process when it has used this many seconds of processor time."""
    while time.process_time() < longest_s:
        time.sleep(0.1)
    if not out.exists():
        _write_result(out, f"Dewesoft's library had not read it within {longest_s:.0f} s of the processor")
    os._exit(0)


def read_parquet(
    path: Path, names: Sequence[str] | None = None, sample_rate_hz: float | None = None
) -> dict[str, RawChannel]:
    """Read columns of a Parquet table with a column `time`.

    Times are time stamps, durations or numbers. A column's metadata may have a `unit`. Floating-point times without a
    unit are seconds; whole numbers need a unit.
    """
    table = _package(path, "pyarrow.parquet").ParquetFile(path)
    rows = table.metadata.num_rows
    check_size(path, f"{rows} rows", 16 * rows)
    fields = {field.name: field for field in table.schema_arrow}
    times = next((name for name in fields if is_time(name)), None)
    selected = select_names(path, names, [name for name in fields if name != times])

    def column(name: str) -> NDArray[Any]:
        return np.asarray(table.read(columns=[name]).column(0).to_numpy())

    def unit(name: str) -> str:
        stated = fields[name].metadata or {}
        return bytes(stated.get(b"unit", stated.get(b"units", b""))).decode("utf-8", "replace")

    stamps = None if times is None else column(times)

    def samples(name: str) -> _Samples:
        return lambda: (stamps, column(name), unit(name))

    time_unit = "" if times is None else unit(times)
    return _make_channels(path, {name: samples(name) for name in selected}, names, sample_rate_hz, time_unit)


def _make_channels(
    path: Path,
    channels_to_read: dict[str, _Samples],
    names: Sequence[str] | None,
    sample_rate_hz: float | None,
    time_unit: str = "",
) -> dict[str, RawChannel]:
    """Return channels from stamps and samples; one without numbers over time is refused if requested."""
    channels, refusals = {}, list[ValueError]()
    for name, read in channels_to_read.items():
        where = f'channel "{name}"'
        try:
            stamps, samples, unit = read()
            values = as_sample_array(path, name, samples)
            if stamps is None:
                times = SampleTimes(agreed_rate(path, where, None, sample_rate_hz))
            else:
                times = times_of_stamps(path, where, stamps, time_unit, given_hz=sample_rate_hz)
        except Exception as error:  # errors of every kind from the packages, for channels that they do not read
            if isinstance(error, ValueError):
                refusals.append(error)
            else:
                cause = " ".join(f"{type(error).__name__} {error}".split())
                refusals.append(ValueError(f"{path}: {where}: expected readable samples, found none ({cause})"))
            if names is not None:
                raise refusals[0] from error
            continue
        channels[name] = RawChannel.from_times(times, values, unit)
    if not channels:
        raise refusals[0] if refusals else ValueError(f"{path}: expected channels of numbers over time, found none")
    first = min(channel.start_s for channel in channels.values())
    return {name: replace(channel, start_s=channel.start_s - first) for name, channel in channels.items()}
