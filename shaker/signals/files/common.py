"""What all file readers share: choosing channels by name, and errors of one sentence that name the file."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

import numpy as np

from shaker._checks import FloatArray

BLOCK = 1 << 20  # bytes read at a time
UNIFORM = 0.5  # of a sampling interval: how far a time column may stray from a uniform one


@contextmanager
def reading(path: Path) -> Iterator[None]:
    """Turn whatever goes wrong with a file into `OSError` or `ValueError`: one sentence that begins with its path."""
    if not path.is_file():
        raise FileNotFoundError(f"{path}: expected a file, found none")
    try:
        yield
    except MemoryError:
        raise
    except Exception as error:
        # The libraries answer damaged files with errors of every kind; here they become one.
        text = " ".join(str(error).split())
        if isinstance(error, OSError | ValueError) and text.startswith(str(path)):
            raise
        kind, cause = path.suffix.lower(), f"{type(error).__name__}: {text}"
        raise ValueError(f"{path}: expected a readable {kind} file, found a damaged one ({cause})") from error


def chosen(path: Path, names: Sequence[str] | None, present: Iterable[str]) -> list[str]:
    """Return the names wanted (all present ones for None), or raise `ValueError` naming those present."""
    available = list(present)
    if names is None:
        return available
    for name in names:
        if name not in available:
            raise ValueError(f'{path}: expected a channel "{name}", found {listed(available)}')
    return list(names)


def listed(names: Sequence[str], most: int = 12) -> str:
    """Return names as a readable list."""
    if not names:
        return "no channels"
    more = f" and {len(names) - most} more" if len(names) > most else ""
    return ", ".join(f'"{name}"' for name in names[:most]) + more


def is_time(name: str) -> bool:
    """Tell whether a channel or column is the time by its name, in whatever case."""
    return name.strip().lower() == "time"


def checked_rate(path: Path, rate: float | None, where: str) -> float:
    """Return a sampling rate, or raise `ValueError` where there is none or it is not positive."""
    if rate is None:
        raise ValueError(f"{path}: expected a sampling rate for {where}, found none; give sample_rate")
    if not (np.isfinite(rate) and rate > 0.0):
        raise ValueError(f"{path}: expected a positive sampling rate for {where}, found {rate}")
    return float(rate)


def numbers(path: Path, name: str, samples: object) -> FloatArray:
    """Return samples as float64 (S,), or raise `ValueError` naming the channel."""
    array = np.asarray(samples)
    if array.ndim != 1 or array.dtype.kind not in "biuf":
        raise ValueError(
            f'{path}: channel "{name}": expected one row of real numbers, found {array.dtype} of shape {array.shape}'
        )
    if not len(array):
        raise ValueError(f'{path}: channel "{name}": expected samples, found none')
    return np.ascontiguousarray(array, dtype=np.float64)


def rate_of_times(path: Path, time_s: FloatArray, where: str) -> tuple[float, float]:
    """Return rate and start of a uniform time column, or raise `ValueError`."""
    if len(time_s) < 2:
        raise ValueError(f"{path}: {where}: expected at least 2 samples, found {len(time_s)}")
    interval = float(time_s[-1] - time_s[0]) / (len(time_s) - 1)
    stray = np.max(np.abs(time_s - time_s[0] - interval * np.arange(len(time_s)))) if interval > 0.0 else np.inf
    if not stray <= UNIFORM * interval:
        raise ValueError(f"{path}: {where}: expected times in uniform steps, found gaps or steps back")
    return 1.0 / interval, float(time_s[0])
