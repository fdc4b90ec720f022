"""Definitions of every stage: settings, single files, clean-up on signals, prefixes of units."""

from __future__ import annotations

import contextlib
import logging
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

from fusion.errors import OUTPUT_EXISTS, OUTPUT_FOLDER_MISSING, PATH_NOT_UTF8, InputError

if TYPE_CHECKING:
    from numpy.typing import ArrayLike

    from shakercal._common.notices import Notice

PROGRAM = "shakercal"


def count_text(count: int, what: str) -> str:
    """Return a number with its noun, such as `1 recording`, `2 recordings`, `3 frequencies`."""
    if count == 1:
        return f"1 {what}"
    return f"{count} {what.removesuffix('y')}ies" if what.endswith("cy") else f"{count} {what}s"


def list_names(names: Sequence[str], most: int) -> str:
    """Return names as text, only the first ones of many."""
    more = len(names) - most
    return ", ".join(names[:most]) + (f" and {more} more" if more > 0 else "")


# Files of a command: unchanged inputs, new outputs.


FILE_TIME_RESOLUTION_S = 2.0
"""Coarsest resolution of file times (FAT)."""


class FileIdentity(NamedTuple):
    """Identity of an unchanged file: size, time of change, inode, device."""

    size: int
    mtime_ns: int
    inode: int
    device: int

    @classmethod
    def of(cls, path: Path) -> FileIdentity | None:
        """Return the identity of a file, None if there is no file."""
        try:
            found = path.stat()
        except OSError:
            return None
        return cls(found.st_size, found.st_mtime_ns, found.st_ino, found.st_dev)

    @property
    def is_settled(self) -> bool:
        """Whether a further change of the file would change its time."""
        return self.mtime_ns * 1e-9 <= time.time() - FILE_TIME_RESOLUTION_S


def natural_key(name: str) -> tuple[tuple[tuple[int, int | str], ...], str]:
    """Return a sort key that orders runs of digits by value: `a2` before `a10`.

    The text decides between equal keys.
    """
    parts = re.split(r"([0-9]+)", name)
    return tuple((0, int(part)) if part.isdigit() else (1, part) for part in parts if part), name


def check_names(files: Iterable[Path]) -> None:
    """Raise `InputError` for a path that is not UTF-8: results could not name it."""
    for path in files:
        if any("\ud800" <= sign <= "\udfff" for sign in str(path)):  # Python's escapes of bytes that are not UTF-8
            raise InputError(PATH_NOT_UTF8, path, found="other bytes", expected="a path whose names are text in UTF-8")


ADDRESS = re.compile(r"[a-z][a-z0-9+.-]+(://|::)")
"""Beginning of an address; a path of Windows has one letter before its colon."""


def is_address(text: str) -> bool:
    """Return whether a text is the address of an object store, such as `s3://bucket/campaign`."""
    return ADDRESS.match(text) is not None


def check_new_file(path: Path, *, force: bool) -> None:
    """Raise `InputError` for an existing path (a file: unless `force`) or a missing folder."""
    if path.exists() and not (force and path.is_file()):
        found = f"a {'file' if path.is_file() else 'folder'} of this name"
        expected = "a new file (--force replaces it)" if path.is_file() else "the name of a file"
        raise InputError(OUTPUT_EXISTS, path, found=found, expected=expected)
    if not path.absolute().parent.is_dir():
        found = f"no folder {path.parent}"
        raise InputError(OUTPUT_FOLDER_MISSING, path, found=found, expected="a file in an existing folder")


# Clean-up functions that run if a signal ends the process.


_undo: list[Callable[[], object]] = []
_deferring: list[None] = []
_waiting: list[int] = []


@contextmanager
def cleanup_on_signal(undo: Callable[[], object]) -> Iterator[None]:
    """Call a function at the end, or if a signal ends the process."""
    _undo.append(undo)
    try:
        yield
    finally:
        undo()
        _undo.remove(undo)


@contextmanager
def defer_signals() -> Iterator[None]:
    """Defer signals during a few inseparable steps."""
    _deferring.append(None)
    try:
        yield
    finally:
        _deferring.pop()
        if _waiting and not _deferring:
            end_process(_waiting[0])


def end_process(number: int) -> None:
    """Clean up after a signal, print one line, exit with 128 + number.

    It exits immediately and without an exception, which compiled code, callbacks and libraries may catch or wrap.
    """
    if _deferring:
        _waiting.append(number)
        return
    logging.disable(logging.CRITICAL)  # messages of threads that lose their data are useless
    for undo in reversed(_undo.copy()):
        with contextlib.suppress(Exception):
            undo()
    what = "interrupted" if number == signal.SIGINT else f"ended by {signal.Signals(number).name}"
    with contextlib.suppress(OSError):
        os.write(2, f"{PROGRAM}: {what}; nothing half-written was left behind\n".encode())
    os._exit(128 + number)


# Settings of a run in addition to the manifest.


DEFAULT_SEED = 20180401
FEWEST_DRAWS, MOST_DRAWS = 1000, 1_000_000
"""Of a Monte Carlo run: fewer draws give no 95 % intervals, more do not fit into memory."""
ProgressCallback = Callable[[str, int, int], None]
"""Called as (stage, done, total) during long work."""


def no_progress(stage: str, done: int, total: int) -> None:
    """Ignore progress, the default of library calls."""


@dataclass(frozen=True)
class Settings:
    """Settings of an evaluation that change results and belong to their identity.

    Attributes
    ----------
    subset_radius_px : subsets are adjacent squares of 2·radius + 1 pixels with independent noise; 4 to 100, None: from
        the speckle size in the images (default: None).
    spline_degree : degree of the B-spline interpolation of images: 3, 5 or 7; 7 keeps the interpolation bias below the
        noise of a whole recording (default: 7).
    device : "auto", "cpu" or "cuda", for tracking; positions agree to 1e-6 px, so that it is not in `as_dict` (default:
        "auto").
    monte_carlo : number of draws that check the first-order uncertainties, 1000 to 1 000 000, 0 for none (default: 0).
    seed : of the draws, 0 or more (default: 20180401).
    save_points : write every point of every frame (default: False).

    Examples
    --------
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
        """Return the settings as plain values for result files."""
        radius = "from speckle" if self.subset_radius_px is None else self.subset_radius_px
        drawn = {"monte_carlo": self.monte_carlo, "seed": self.seed} if self.monte_carlo else {}
        saved = {"save_points": "yes"} if self.save_points else {}
        return {"subset_radius_px": radius, "spline_degree": self.spline_degree, **drawn, **saved}


# Executors of tasks for a run.


class Pending(Protocol):
    """A result that another process computes."""

    def result(self) -> LocalResult:
        """Return the result, or raise the reason of its absence."""

    def add_done_callback(self, callback: Callable[[Any], object]) -> None:
        """Call a function when the result is available or impossible."""


class Executor(Protocol):
    """Processes that compute one task each at a time.

    `patience_s`: waiting time for a recording that another executor computes.
    """

    patience_s: float

    @property
    def size(self) -> int:
        """Number of processes."""

    def submit(self, rank: int, function: Callable[..., Any], *arguments: Any) -> Any:
        """Submit a function of a module; waiting tasks start in order of their ranks.

        Available results may be arguments: the function receives their values.
        """


class Threads:
    """Threads of this process that compute tasks in order; `with` ends them.

    `size`: number of threads, by default the available cores, limited by OMP_NUM_THREADS.
    """

    patience_s = 0.0  # no other process computes the same

    def __init__(self, size: int | None = None) -> None:
        self.size = usable_cores() if size is None else size
        self._pool = ThreadPoolExecutor(self.size)

    def __enter__(self) -> Threads:
        return self

    def __exit__(self, *reason: object) -> None:
        self._pool.shutdown(cancel_futures=True)

    def submit(self, rank: int, function: Callable[..., Any], *arguments: Any) -> Future[LocalResult]:
        """Submit a function for the next free thread; results among arguments are unwrapped."""
        values = [argument.result().unwrap() if isinstance(argument, Future) else argument for argument in arguments]
        return self._pool.submit(LocalResult.run, function, values)


@dataclass(frozen=True, eq=False)
class LocalResult:
    """Result or exception of a task of this process, whose messages are logged already."""

    value: Any
    error: Exception | None = None

    @staticmethod
    def run(function: Callable[..., Any], arguments: Sequence[Any]) -> LocalResult:
        """Call a function and return its result."""
        try:
            return LocalResult(function(*arguments))
        except Exception as error:
            return LocalResult(None, error)

    def unwrap(self) -> Any:
        """Return the value of the task, or raise its exception."""
        if self.error is not None:
            raise self.error
        return self.value

    def log(self, name: str) -> None:
        """Write no log: the messages are logged already."""


_MOST_THREADS: ContextVar[int | None] = ContextVar("most threads", default=None)


@contextmanager
def limit_threads(count: int) -> Iterator[None]:
    """Limit the size of `Threads` made inside, by this thread, to `count`."""
    token = _MOST_THREADS.set(count)
    try:
        yield
    finally:
        _MOST_THREADS.reset(token)


def usable_cores() -> int:
    """Return the number of cores available to this process or thread."""
    if sys.platform == "linux":
        cores = len(os.sched_getaffinity(0))
    else:
        cores = os.cpu_count() or 1
    limit = os.environ.get("OMP_NUM_THREADS", "")
    return min(cores, int(limit) if limit.isdecimal() and int(limit) else cores, _MOST_THREADS.get() or cores)


class CheckpointStore(Protocol):
    """A store for intermediate results, from which an interrupted run continues."""

    @property
    def disk(self) -> Path:
        """Folder on the disk of the results, for temporary files of the run."""

    def get(self, name: str) -> bytes | None:
        """Return the content of a name from an identical run, else None."""

    def put(self, name: str, content: bytes) -> bool:
        """Store content until the results are written, and return whether it succeeded."""


# Factors and prefixes of displayed units.


K2 = 2.0
"""Coverage factor if degrees of freedom are not considered (GUM 6.3.3)."""
MILLI, GRAM, PERCENT = 1e3, 1e3, 100.0
"""Factors from SI units to displayed units: mm, ms or mrad; g; %."""
PREFIXES = ((1.0, ""), (1e-3, "m"), (1e-6, "µ"), (1e-9, "n"))


def prefix(values: ArrayLike, *, coarse: bool = False) -> tuple[float, str]:
    """Return factor and SI prefix for the largest of some values (`coarse`: at least 1)."""
    import numpy as np  # imported late: the command line lists its commands without it

    sizes = np.abs(values)
    largest = np.max(sizes[np.isfinite(sizes)], initial=0.0) if np.any(np.isfinite(sizes)) else 1.0
    threshold = 1.0 if coarse else 0.5
    return next((pair for pair in PREFIXES if largest >= threshold * pair[0]), PREFIXES[-1])


# Versions of the program and of its libraries.


__version__ = "0.2.0"
"""A constant, because the metadata of the package is slow to parse; a test compares them."""
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
    """Return the version of an installed distribution, None if there is none (slow)."""
    from importlib.metadata import PackageNotFoundError, version

    with contextlib.suppress(PackageNotFoundError):
        return version(distribution)
    return None


def versions() -> dict[str, str]:
    """Return versions of this program, Python, the system, and imported libraries."""
    found = {PROGRAM: __version__, "python": platform.python_version()}
    for module, distribution in LIBRARIES.items():
        if module in sys.modules and (version := _version(distribution)) is not None:
            found[distribution] = version
    found["platform"] = f"{platform.system()} {platform.machine()}"
    return found


@dataclass(frozen=True, kw_only=True)
class CommandEvaluation:
    """Common properties of all evaluations.

    `settings`: of the evaluation. `input_hashes`: of all input files by name. `duration_s`: computing time.
    `simulated`: whether a recording states that it is simulated.
    """

    name: str
    notices: tuple[Notice, ...]
    settings: dict[str, str | float | int]
    versions: dict[str, str] = field(default_factory=versions)
    input_hashes: dict[str, str]
    duration_s: float
    simulated: bool = False
