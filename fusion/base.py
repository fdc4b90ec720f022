"""What every stage needs: errors, notices, settings, single files, numbers as they are printed."""

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
from dataclasses import dataclass, field, replace
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple, Protocol, TypeAlias

if TYPE_CHECKING:
    from numpy.typing import ArrayLike

    from photogram.arrays import Notice as ImageNotice
    from shaker.arrays import Notice, Severity

PROGRAM = "shakercal"
AnyNotice: TypeAlias = "Notice | ImageNotice"


def warnings_first(notices: Iterable[AnyNotice]) -> list[AnyNotice]:
    """Return every notice once, warnings first; what is said of several places in one text is one notice of all."""
    alike: dict[tuple[str, str], list[AnyNotice]] = {}
    for notice in notices:
        alike.setdefault((notice.severity, notice.text), []).append(notice)
    once = [
        replace(first, where=", ".join(dict.fromkeys(notice.where for notice in (first, *others) if notice.where)))
        for first, *others in alike.values()
    ]
    return sorted(once, key=lambda notice: notice.severity != "warning")


NUMBER = re.compile(r"(?<![\w.])[-+−]?\d+(?:\.\d+)?(?:e[-+]?\d+)?")
"""A number in a notice; digits within a name, such as that of a channel, are none."""


@dataclass(frozen=True)
class GatheredNotice:
    """A notice of several recordings; where its texts differ in numbers alone, `text` gives their ranges.

    `recordings`: names of all that it concerns, `everywhere`: whether these are all there are of several; `each`: every
    text with the recordings that state it.
    """

    severity: Severity
    where: str
    text: str
    recordings: tuple[str, ...]
    everywhere: bool
    each: tuple[tuple[str, tuple[str, ...]], ...]

    @property
    def concerned(self) -> str:
        """Return the names of all recordings that it concerns."""
        return f"all {len(self.recordings)} recordings" if self.everywhere else ", ".join(self.recordings)


def counted(count: int, what: str) -> str:
    """Return a number with what it counts, such as `1 recording` and `2 recordings`."""
    return f"{count} {what}{'' if count == 1 else 's'}"


def gather(groups: Sequence[tuple[str, Iterable[AnyNotice]]]) -> list[GatheredNotice]:
    """Return the notices of named recordings, each once: warnings first, then those of most recordings."""
    found: dict[tuple[Severity, str, tuple[str, ...]], dict[str, dict[str, None]]] = {}
    for name, notices in groups:
        for notice in notices:
            key = notice.severity, notice.where, tuple(NUMBER.split(notice.text))
            found.setdefault(key, {}).setdefault(notice.text, {})[name] = None
    gathered = []
    for (severity, where, _), texts in found.items():
        names = dict.fromkeys(name for own in texts.values() for name in own)
        each = tuple((text, tuple(own)) for text, own in texts.items())
        everywhere = len(names) == len(groups) > 1
        gathered.append(GatheredNotice(severity, where, _in_ranges(list(texts)), tuple(names), everywhere, each))
    return sorted(gathered, key=lambda notice: (notice.severity != "warning", -len(notice.recordings)))


def _in_ranges(texts: Sequence[str]) -> str:
    """Return texts that differ in numbers alone as one, with the least and the largest of every number."""
    words, columns = NUMBER.split(texts[0]), zip(*(NUMBER.findall(text) for text in texts), strict=True)
    ranges = []
    for numbers in columns:
        ordered = sorted(set(numbers), key=lambda number: float(number.replace("−", "-")))
        ranges.append(ordered[0] if len(ordered) == 1 else f"{ordered[0]} to {ordered[-1]}")
    return "".join(part for pair in zip(words, [*ranges, ""], strict=True) for part in pair)


# The two ways a run can fail: the user's input is wrong, or something could not be computed.


ARGUMENT = re.compile(r"^[a-z_]+(, [a-z_]+)*: (?=expected )")
"""The name of a function's argument before its sentence, which means nothing to a user."""


class InputError(Exception):
    """A mistake in the user's input, told in one sentence: which file, which key, what was expected, what was found.

    `file`: the file in which the mistake is to be corrected. `key`: TOML key path, column or channel; empty where
    the file as a whole is meant. `found`, `expected`: short phrases without a full stop; where `expected` is empty,
    `found` is a sentence of its own. `others`: further mistakes, of the same file or of those read with it, which the
    sentence only counts.

    >>> from fusion import InputError
    >>> print(InputError("rig.toml", "load.mass", found="0", expected="a number above 0"))
    rig.toml: load.mass: expected a number above 0, found 0
    """

    def __init__(
        self, file: Path | str, key: str, found: str, expected: str, others: Iterable[InputError] = ()
    ) -> None:
        super().__init__(file, key, found, expected, tuple(others))
        self.file = Path(file)
        self.key = key
        self.found = found
        self.expected = expected
        self.others: tuple[InputError, ...] = self.args[4]

    @classmethod
    def together(cls, errors: Iterable[InputError]) -> InputError:
        """Return the first of some mistakes, which holds the others."""
        first, *others = [single for error in errors for single in error.each]
        return cls(first.file, first.key, first.found, first.expected, others)

    @property
    def each(self) -> tuple[InputError, ...]:
        """Return every mistake by itself, this one first."""
        return InputError(self.file, self.key, self.found, self.expected), *self.others

    @classmethod
    def told_by(cls, error: Exception, file: Path, key: str = "") -> InputError:
        """Put what a reader or an algorithm says behind file and key, each file named once and seen from `file`."""
        text = str(error)
        if isinstance(error, OSError) and error.filename is not None and error.strerror is not None:
            text = f"{error.filename}: {error.strerror}"
        own = f"{file}: "
        text = text.removeprefix(own) if text.startswith(own) else ARGUMENT.sub("", text, count=1)
        return cls(file, key, found=text.replace(f"{file.parent.resolve()}{os.sep}", ""), expected="")

    def __str__(self) -> str:
        where = f"{self.file}: {self.key}: " if self.key else f"{self.file}: "
        more = len(self.others)
        files = {other.file.name for other in self.others if other.file != self.file}
        around = f", also in {' and '.join(sorted(files))}" if files else " in this file"
        rest = f" ({more} more problem{'s' if more > 1 else ''}{around})" if more else ""
        told = f"expected {self.expected}, found {self.found}" if self.expected else self.found
        return " ".join(f"{where}{told}{rest}".split())


@contextmanager
def as_input_error(file: Path, key: str = "") -> Iterator[None]:
    """Tell what a reader or an algorithm refuses meanwhile as wrong input: of a file, at a key of it."""
    try:
        yield
    except (OSError, ValueError) as error:
        raise InputError.told_by(error, file, key) from error


class ComputeError(Exception):
    """Something could not be computed although the input could be read; the text says what to do.

    >>> from fusion import ComputeError
    >>> raise ComputeError("only 3 subsets are followed through all frames; look at the images")
    Traceback (most recent call last):
        ...
    fusion.base.ComputeError: only 3 subsets are followed through all frames; look at the images
    """


def is_interruption(error: BaseException) -> bool:
    """Whether the user interrupted; compiled code wraps an interruption into an error of its own."""
    cause = error.__cause__ or error.__context__
    return isinstance(error, KeyboardInterrupt) or isinstance(cause, KeyboardInterrupt)


SHORT_OF_MEMORY = re.compile(
    "can't start new thread|failed to map segment|[Ii]nsufficient memory|annot allocate memory"
)
"""What threads, shared libraries, OpenCV and the system say where they get no memory."""


def told(error: Exception) -> InputError | ComputeError:
    """Return a failure as one that the user can be told; what the program does not expect becomes a `ComputeError`."""
    if isinstance(error, InputError | ComputeError):
        return error
    if isinstance(error, MemoryError) or SHORT_OF_MEMORY.search(str(error)):
        return ComputeError(f"the memory does not suffice ({' '.join(str(error).split()) or type(error).__name__})")
    if isinstance(error, OSError):
        return ComputeError(f"the system refused to read or write ({error})")
    return ComputeError(f"internal error ({type(error).__name__}: {error}); please report it, -v shows where")


# What a command reads and writes: files that stay what they were, places for new ones.


JUST_NOW_S = 2.0
"""Resolution of the times of files, the coarsest there is."""


class Identity(NamedTuple):
    """What tells that a file is no longer what it was: its size and time of change, and where it lies."""

    size: int
    mtime_ns: int
    inode: int
    device: int

    @classmethod
    def of(cls, path: Path) -> Identity | None:
        """Return the identity of a file at this moment; None where there is none."""
        try:
            found = path.stat()
        except OSError:
            return None
        return cls(found.st_size, found.st_mtime_ns, found.st_ino, found.st_dev)

    @property
    def settled(self) -> bool:
        """Whether the file was changed so long ago that a further change would show in its time."""
        return self.mtime_ns * 1e-9 <= time.time() - JUST_NOW_S


def natural_key(name: str) -> tuple[tuple[tuple[int, int | str], ...], str]:
    """Sort key that orders runs of digits by value: `a2` before `a10`; ties by the text itself."""
    parts = re.split(r"([0-9]+)", name)
    return tuple((0, int(part)) if part.isdigit() else (1, part) for part in parts if part), name


def check_names(files: Iterable[Path]) -> None:
    """Raise `InputError` for a file whose path is no text, so that no result could name it."""
    for path in files:
        if any("\ud800" <= sign <= "\udfff" for sign in str(path)):  # in which Python holds bytes that are no UTF-8
            raise InputError(path, "", found="other bytes", expected="a path whose names are text in UTF-8")


def check_new_file(path: Path, *, force: bool) -> None:
    """Refuse a place for a file that is taken (by a file: unless `force`) or that is in no folder."""
    if path.exists() and not (force and path.is_file()):
        what = "file" if path.is_file() else "folder"
        raise InputError(path, "", found=f"a {what} of this name", expected="a new file (--force replaces it)")
    if not path.absolute().parent.is_dir():
        raise InputError(path, "", found=f"no folder {path.parent}", expected="a file in an existing folder")


# What is undone when a signal ends the process: whoever begins something that must not be left registers its undoing.


_undo: list[Callable[[], object]] = []
_uninterrupted: list[None] = []
_waiting: list[int] = []


@contextmanager
def undone(undo: Callable[[], object]) -> Iterator[None]:
    """Call a function at the end, or when a signal ends the process meanwhile; to call it twice does no harm."""
    _undo.append(undo)
    try:
        yield
    finally:
        undo()
        _undo.remove(undo)


@contextmanager
def uninterrupted() -> Iterator[None]:
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


class Answer(Protocol):
    """What a task returned or raised, and what it logged."""

    def opened(self) -> Any:
        """Return or raise what the task did."""

    def log(self, name: str) -> None:
        """Log what the task logged, behind the name of what it was about."""


class Pending(Protocol):
    """The answer of a task that another process computes."""

    def result(self) -> Answer:
        """Return it, or raise why there is none."""

    def add_done_callback(self, told: Callable[[Any], object]) -> None:
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

    def submit(self, rank: int, function: Callable[..., Any], *arguments: Any) -> Future[Returned]:
        """Have a function called as soon as a thread is free, whatever its rank; answers that are there are opened."""
        held = [argument.result().opened() if isinstance(argument, Future) else argument for argument in arguments]
        return self._pool.submit(Returned.by, function, held)


@dataclass(frozen=True, eq=False)
class Returned:
    """What a task of this process returned or raised; what it logged is told already."""

    value: Any
    error: Exception | None = None

    @staticmethod
    def by(function: Callable[..., Any], arguments: Sequence[Any]) -> Returned:
        """Call a function and return what became of it."""
        try:
            return Returned(function(*arguments))
        except Exception as error:
            return Returned(None, error)

    def opened(self) -> Any:
        """Return or raise what the task did."""
        if self.error is not None:
            raise self.error
        return self.value

    def log(self, name: str) -> None:
        """Nothing is left to be told."""


_MOST_THREADS: ContextVar[int | None] = ContextVar("most threads", default=None)


@contextmanager
def most_threads(count: int) -> Iterator[None]:
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


class Keeper(Protocol):
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


class Rounded(NamedTuple):
    """A value and its expanded uncertainty as decimal texts, both times ten to the power `exponent`."""

    value: str
    expanded: str
    exponent: int

    @property
    def text(self) -> str:
        """Return both for the terminal: `(2.0012 ± 0.0013)e-7`, without an uncertainty the value alone."""
        body = self.value if self.expanded == DASH else f"({self.value} ± {self.expanded})"
        return f"{body}e{self.exponent}" if self.exponent else body


def rounded(value: float, expanded: float, exponent: int | None = None) -> Rounded:
    """Return a value rounded to the second significant digit of its expanded uncertainty (GUM 7.2.6).

    `exponent`: power of ten to take off, by default none for sizes from 0.01 to 100 000 and else that of the larger of
    the two. Without a usable uncertainty the value has five significant digits and the uncertainty is a dash.
    """
    if not math.isfinite(value):
        return Rounded(DASH, DASH, 0)
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
    return Rounded(signed, texts[1], power)


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
