"""Definitions of every stage: settings, single files, clean-up on signals, printed numbers."""

from __future__ import annotations

import contextlib
import logging
import math
import os
import platform
import re
import signal
import sys
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import contextmanager
from contextvars import ContextVar
from dataclasses import dataclass, field
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple, Protocol

from fusion.errors import InputError

if TYPE_CHECKING:
    from numpy.typing import ArrayLike

    from shakercal._common.notices import Notice

PROGRAM = "shakercal"


def count_text(count: int, what: str) -> str:
    """Return a number with what it counts, such as `1 recording` and `2 recordings`."""
    return f"{count} {what}{'' if count == 1 else 's'}"


# What a command reads and writes: files that stay what they were, places for new ones.


FILE_TIME_RESOLUTION_S = 2.0
"""Resolution of the times of files, the coarsest there is."""


class FileIdentity(NamedTuple):
    """What tells that a file is no longer what it was: its size and time of change, and where it lies."""

    size: int
    mtime_ns: int
    inode: int
    device: int

    @classmethod
    def of(cls, path: Path) -> FileIdentity | None:
        """Return the identity of a file at this moment; None where there is none."""
        try:
            found = path.stat()
        except OSError:
            return None
        return cls(found.st_size, found.st_mtime_ns, found.st_ino, found.st_dev)

    @property
    def is_settled(self) -> bool:
        """Whether the file was changed so long ago that a further change would show in its time."""
        return self.mtime_ns * 1e-9 <= time.time() - FILE_TIME_RESOLUTION_S


def natural_key(name: str) -> tuple[tuple[tuple[int, int | str], ...], str]:
    """Sort key that orders runs of digits by value: `a2` before `a10`; ties by the text itself."""
    parts = re.split(r"([0-9]+)", name)
    return tuple((0, int(part)) if part.isdigit() else (1, part) for part in parts if part), name


def check_names(files: Iterable[Path]) -> None:
    """Raise `InputError` for a file whose path is not UTF-8, so that no result could name it."""
    from fusion.recording.recording_notices import PATH_NOT_UTF8

    for path in files:
        if any("\ud800" <= sign <= "\udfff" for sign in str(path)):  # Python's escapes of bytes that are not UTF-8
            raise InputError(PATH_NOT_UTF8, path, found="other bytes", expected="a path whose names are text in UTF-8")


def check_new_file(path: Path, *, force: bool) -> None:
    """Raise `InputError` for a path that exists (a file: unless `force`) or that has no folder."""
    from fusion.commands.command_notices import OUTPUT_EXISTS, OUTPUT_FOLDER_MISSING

    if path.exists() and not (force and path.is_file()):
        found = f"a {'file' if path.is_file() else 'folder'} of this name"
        raise InputError(OUTPUT_EXISTS, path, found=found, expected="a new file (--force replaces it)")
    if not path.absolute().parent.is_dir():
        found = f"no folder {path.parent}"
        raise InputError(OUTPUT_FOLDER_MISSING, path, found=found, expected="a file in an existing folder")


# What is undone when a signal ends the process: whoever begins something that must not be left registers its undoing.


_undo: list[Callable[[], object]] = []
_uninterrupted: list[None] = []
_waiting: list[int] = []


@contextmanager
def cleanup_on_signal(undo: Callable[[], object]) -> Iterator[None]:
    """Call a function at the end, or when a signal ends the process meanwhile; to call it twice does no harm."""
    _undo.append(undo)
    try:
        yield
    finally:
        undo()
        _undo.remove(undo)


@contextmanager
def defer_signals() -> Iterator[None]:
    """Let no signal end the process within a few steps that belong together; it ends after them."""
    _uninterrupted.append(None)
    try:
        yield
    finally:
        _uninterrupted.pop()
        if _waiting and not _uninterrupted:
            end_process(_waiting[0])


def end_process(number: int) -> None:
    """End the process as the signal of this number asks: all is undone, one line told, the status 128 + number.

    It ends at once and not by an exception, which compiled code, callbacks and libraries may swallow or wrap.
    """
    if _uninterrupted:
        _waiting.append(number)
        return
    logging.disable(logging.CRITICAL)  # threads that lose what they work with have nothing to tell any more
    for undo in reversed(_undo.copy()):
        with contextlib.suppress(Exception):
            undo()
    what = "interrupted" if number == signal.SIGINT else f"ended by {signal.Signals(number).name}"
    with contextlib.suppress(OSError):
        os.write(2, f"{PROGRAM}: {what}; nothing half-written was left behind\n".encode())
    os._exit(128 + number)


# What a user may choose about a run, beside the manifest.


DEFAULT_SEED = 20180401
FEWEST_DRAWS, MOST_DRAWS = 1000, 1_000_000
"""Of a Monte Carlo run: 95 % intervals of fewer draws mean nothing, more do not fit into memory."""
ProgressCallback = Callable[[str, int, int], None]
"""Called as (stage, done, total) during long work."""


def no_progress(stage: str, done: int, total: int) -> None:
    """Ignore progress, the default of library calls."""


@dataclass(frozen=True)
class Settings:
    """Choices that change results and therefore belong to a result's identity.

    `subset_radius_px`: subsets are squares of 2·radius + 1 pixels, laid side by side so that their noise is
    independent; None takes it from the speckle size found in the images. `spline_degree`: B-spline interpolation of
    the images, 3, 5 or 7 (7 keeps the interpolation bias below the noise of a whole recording). `device`: where subsets
    are tracked, "auto", "cpu" or "cuda"; the positions agree to 1e-6 px, so that it does not count in `as_dict`.
    `monte_carlo`: draws that check the first-order uncertainties, 0 for none, from the streams of `seed`.
    `save_points`: every point of every frame is written too.

    >>> from fusion import Settings
    >>> Settings(monte_carlo=1000, seed=1).as_dict()
    {'subset_radius_px': 'from speckle', 'spline_degree': 7, 'monte_carlo': 1000, 'seed': 1}
    """

    subset_radius_px: int | None = None
    spline_degree: int = 7
    device: str = "auto"
    monte_carlo: int = 0
    seed: int = DEFAULT_SEED
    save_points: bool = False

    def __post_init__(self) -> None:
        if self.subset_radius_px is not None and not 4 <= self.subset_radius_px <= 100:
            raise ValueError(f"subset_radius_px: expected 4 to 100, found {self.subset_radius_px}")
        if self.spline_degree not in (3, 5, 7):
            raise ValueError(f"spline_degree: expected 3, 5 or 7, found {self.spline_degree}")
        if self.monte_carlo and not FEWEST_DRAWS <= self.monte_carlo <= MOST_DRAWS:
            raise ValueError(f"monte_carlo: expected {FEWEST_DRAWS} to {MOST_DRAWS}, found {self.monte_carlo}")
        if self.seed < 0:
            raise ValueError(f"seed: expected 0 or more, found {self.seed}")

    def as_dict(self) -> dict[str, str | float | int]:
        """Return the settings as plain values for the result files."""
        radius = "from speckle" if self.subset_radius_px is None else self.subset_radius_px
        drawn = {"monte_carlo": self.monte_carlo, "seed": self.seed} if self.monte_carlo else {}
        saved = {"save_points": "yes"} if self.save_points else {}
        return {"subset_radius_px": radius, "spline_degree": self.spline_degree, **drawn, **saved}


# Those who compute tasks for a run: what a recording needs to know of them.


class TaskResult(Protocol):
    """What a task returned or raised, and what it logged."""

    def unwrap(self) -> Any:
        """Return or raise what the task did."""

    def log(self, name: str) -> None:
        """Log what the task logged, behind the name of what it was about."""


class Pending(Protocol):
    """The answer of a task that another process computes."""

    def result(self) -> TaskResult:
        """Return it, or raise why there is none."""

    def add_done_callback(self, callback: Callable[[Any], object]) -> None:
        """Have a function called as soon as there is an answer or none will be."""


class Executor(Protocol):
    """Processes that compute tasks, one each at a time; a recording that another one has is waited for `patience_s`."""

    patience_s: float

    @property
    def size(self) -> int:
        """How many there are."""

    def submit(self, rank: int, function: Callable[..., Any], *arguments: Any) -> Any:
        """Have a module's function called; of the tasks that wait, the lowest rank comes first.

        Answers that are there may be arguments: the function receives what they hold.
        """


class Threads:
    """Threads of this process that compute tasks, one each at a time, in their turn; at the end of `with` all end.

    `size`: how many, by default as many as there are cores to use, which OMP_NUM_THREADS may limit.
    """

    patience_s = 0.0  # no other process computes what these do

    def __init__(self, size: int | None = None) -> None:
        self.size = usable_cores() if size is None else size
        self._pool = ThreadPoolExecutor(self.size)

    def __enter__(self) -> Threads:
        return self

    def __exit__(self, *reason: object) -> None:
        self._pool.shutdown(cancel_futures=True)

    def submit(self, rank: int, function: Callable[..., Any], *arguments: Any) -> Future[LocalResult]:
        """Have a function called as soon as a thread is free, whatever its rank; answers that are there are opened."""
        held = [argument.result().unwrap() if isinstance(argument, Future) else argument for argument in arguments]
        return self._pool.submit(LocalResult.run, function, held)


@dataclass(frozen=True, eq=False)
class LocalResult:
    """What a task of this process returned or raised; what it logged is told already."""

    value: Any
    error: Exception | None = None

    @staticmethod
    def run(function: Callable[..., Any], arguments: Sequence[Any]) -> LocalResult:
        """Call a function and return what became of it."""
        try:
            return LocalResult(function(*arguments))
        except Exception as error:
            return LocalResult(None, error)

    def unwrap(self) -> Any:
        """Return or raise what the task did."""
        if self.error is not None:
            raise self.error
        return self.value

    def log(self, name: str) -> None:
        """Nothing is left to be told."""


_MOST_THREADS: ContextVar[int | None] = ContextVar("most threads", default=None)


@contextmanager
def limit_threads(count: int) -> Iterator[None]:
    """Let `Threads` that are made inside, by this thread, be no more than `count`."""
    token = _MOST_THREADS.set(count)
    try:
        yield
    finally:
        _MOST_THREADS.reset(token)


def usable_cores() -> int:
    """Return how many cores this process, or this thread of it, may keep busy."""
    if sys.platform == "linux":
        there = len(os.sched_getaffinity(0))
    else:
        there = os.cpu_count() or 1
    limit = os.environ.get("OMP_NUM_THREADS", "")
    return min(there, int(limit) if limit.isdecimal() and int(limit) else there, _MOST_THREADS.get() or there)


class CheckpointStore(Protocol):
    """A place for what a run has found so far, from which it goes on when it was ended."""

    @property
    def disk(self) -> Path:
        """A folder on the disk of the results, for nameless files that last as long as the run."""

    def get(self, name: str) -> bytes | None:
        """Return what was kept under a name by a run of the same inputs and settings, None where nothing was."""

    def put(self, name: str, content: bytes) -> bool:
        """Keep something until the results are written, and return whether that is done."""


# How numbers and units are printed: to two digits of their uncertainty, with powers of ten or SI prefixes.


K2 = 2.0
"""Coverage factor of expanded uncertainties whose degrees of freedom are not counted."""
MILLI, GRAM, PERCENT = 1e3, 1e3, 100.0
"""Factors from SI units to those in which numbers are shown: mm, ms or mrad; g of kg; % of a share."""
LARGEST_PLAIN = 1e5
SMALLEST_PLAIN = 1e-2
DASH = "–"
PREFIXES = ((1.0, ""), (1e-3, "m"), (1e-6, "µ"), (1e-9, "n"))


class RoundedValue(NamedTuple):
    """A value and its expanded uncertainty as decimal texts, both times ten to the power `exponent`."""

    value: str
    expanded: str
    exponent: int

    @property
    def text(self) -> str:
        """Return both for the terminal: `(2.0012 ± 0.0013)e-7`, without an uncertainty the value alone."""
        body = self.value if self.expanded == DASH else f"({self.value} ± {self.expanded})"
        return f"{body}e{self.exponent}" if self.exponent else body


def round_to_uncertainty(value: float, expanded: float, exponent: int | None = None) -> RoundedValue:
    """Return a value rounded to the second significant digit of its expanded uncertainty (GUM 7.2.6).

    `exponent`: power of ten to take off, by default none for sizes from 0.01 to 100 000 and else that of the larger of
    the two. Without a usable uncertainty the value has five significant digits and the uncertainty is a dash.
    """
    if not math.isfinite(value):
        return RoundedValue(DASH, DASH, 0)
    usable = math.isfinite(expanded) and expanded > 0.0
    size = max(abs(value), expanded if usable else 0.0)
    plain = size == 0.0 or SMALLEST_PLAIN <= size < LARGEST_PLAIN
    power = exponent if exponent is not None else 0 if plain else math.floor(math.log10(size))
    texts = [f"{value * 10.0**-power:.5g}", DASH]
    if usable:
        # A negative number of decimal places rounds to tens or hundreds.
        decimals = 1 - int(f"{expanded * 10.0**-power:.1e}".partition("e")[2])
        texts = [f"{round(x * 10.0**-power, decimals):.{max(decimals, 0)}f}" for x in (value, expanded)]
    signed = texts[0].lstrip("-") if not texts[0].strip("-0.") else texts[0].replace("-", "\N{MINUS SIGN}")
    return RoundedValue(signed, texts[1], power)


def prefix(values: ArrayLike, *, coarse: bool = False) -> tuple[float, str]:
    """Return factor and SI prefix that bring the largest size of values to a readable one (`coarse`: at least 1)."""
    import numpy as np  # here, for the command line lists its commands without it

    sizes = np.abs(values)
    largest = np.max(sizes[np.isfinite(sizes)], initial=0.0) if np.any(np.isfinite(sizes)) else 1.0
    threshold = 1.0 if coarse else 0.5
    return next((pair for pair in PREFIXES if largest >= threshold * pair[0]), PREFIXES[-1])


# The program and the libraries that compute with it.


__version__ = "0.2.0"
"""Written here, for to find that of the installed package a file has to be parsed; a test compares them."""
LIBRARIES = {
    "numpy": "numpy",
    "scipy": "scipy",
    "cv2": "opencv-contrib-python-headless",
    "skimage": "scikit-image",
    "torch": "torch",
    "kornia": "kornia",
    "numba": "numba",
    "pydantic": "pydantic",
    "h5py": "h5py",
    "tifffile": "tifffile",
    "nptdms": "npTDMS",
    "matplotlib": "matplotlib",
    "jinja2": "jinja2",
    "skfem": "scikit-fem",
}


@cache
def _version(distribution: str) -> str | None:
    """Version of an installed distribution, None where there is none: a folder is searched and a file parsed."""
    from importlib.metadata import PackageNotFoundError, version

    with contextlib.suppress(PackageNotFoundError):
        return version(distribution)
    return None


def versions() -> dict[str, str]:
    """Versions of this program, of Python, of the system, and of the libraries that have been imported."""
    found = {PROGRAM: __version__, "python": platform.python_version()}
    for module, distribution in LIBRARIES.items():
        if module in sys.modules and (version := _version(distribution)) is not None:
            found[distribution] = version
    found["platform"] = f"{platform.system()} {platform.machine()}"
    return found


@dataclass(frozen=True, kw_only=True)
class CommandEvaluation:
    """What every evaluation of a command has: what was evaluated, what the user should know, and where it comes from.

    `settings`: what was chosen; `input_hashes`: of all input files by their name; `duration_s`: how long it took.
    """

    name: str
    notices: tuple[Notice, ...]
    settings: dict[str, str | float | int]
    versions: dict[str, str] = field(default_factory=versions)
    input_hashes: dict[str, str]
    duration_s: float
