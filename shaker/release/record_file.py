"""Record of a release from one file, without a manifest."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from shaker.io import read_channels
from shaker.io.channel import RawChannel
from shaker.release.record import StepRecord


def read_step_record(
    path: str | Path, channel: str | None = None, amplitude: float = 1.0, sample_rate_hz: float | None = None
) -> StepRecord:
    r"""Read the record of one release from a file, for poles without a manifest.

    Parameters
    ----------
    path
        file of any format that `read_channels` reads
    channel
        name of the output in the file, default None: the only one
    amplitude
        signed change of the load, N or N·m, default 1: gains are then changes of the output. Poles do not depend on it.
    sample_rate_hz
        sampling rate, Hz, for a file that states none

    Returns
    -------
    StepRecord : of the one output, named like the file

    Raises
    ------
    OSError, ValueError : the file cannot be read, has several channels, or samples are missing or unevenly spaced

    Examples
    --------
    >>> from pathlib import Path
    >>> from tempfile import TemporaryDirectory
    >>> from shaker import read_step_record
    >>> with TemporaryDirectory() as folder:
    ...     file = Path(folder, "line.csv")
    ...     _ = file.write_text("time,Fz\ns,V\n0.0,2.0\n0.1,0.1\n0.2,-0.1\n")
    ...     read_step_record(file)
    StepRecord(line: Fz changes by 1, 3 samples at 10 Hz of Fz [V])
    """
    channels = read_channels(path, None if channel is None else [channel], sample_rate_hz)
    if len(channels) != 1:
        raise ValueError(f"{path}: channel: expected one of {', '.join(channels)}, found none")
    ((name, raw),) = channels.items()
    return step_record(path, name, raw, amplitude)


def step_record(path: str | Path, name: str, raw: RawChannel, amplitude: float = 1.0) -> StepRecord:
    """Return the record of one release from a channel of a file.

    Raises `ValueError` if samples are missing or unevenly spaced.
    """
    if raw.stamp_s is not None:
        raise ValueError(f"{path}: {name}: expected evenly spaced samples, found {raw.gap}")
    if missing := np.count_nonzero(~np.isfinite(raw.samples)):
        raise ValueError(f"{path}: {name}: expected a number in every sample, found {missing} without one")
    return StepRecord(Path(path).stem, (name,), raw.unit, raw.samples[None], raw.sample_rate_hz, name, amplitude)
