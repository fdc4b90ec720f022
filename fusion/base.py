"""What every stage needs: errors, notices, settings, single files, the terminal."""

from __future__ import annotations

import contextlib
import importlib.metadata
import math
import os
import platform
import re
import shutil
import socket
import sys
import time
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple, Protocol, TypeAlias

if TYPE_CHECKING:
    from numpy.typing import ArrayLike
    from rich.console import Console

    from photogram.arrays import Notice as ImageNotice
    from shaker.arrays import Notice

AnyNotice: TypeAlias = "Notice | ImageNotice"


def warnings_first(notices: Iterable[AnyNotice]) -> list[AnyNotice]:
    """Return all distinct notices, warnings first."""
    distinct = {(notice.severity, notice.where, notice.text): notice for notice in notices}
    return sorted(distinct.values(), key=lambda notice: notice.severity != "warning")


# The two ways a run can fail: the user's input is wrong, or something could not be computed.


ARGUMENT = re.compile(r"^[a-z_]+(, [a-z_]+)*: (?=expected )")
"""The name of a function's argument before its sentence, which means nothing to a user."""


class InputError(Exception):
    """A mistake in the user's input, told in one sentence: which file, which key, what was expected, what was found.

    `file`: the file in which the mistake is to be corrected. `key`: TOML key path, column or channel; empty where
    the file as a whole is meant. `found`, `expected`: short phrases without a full stop; where `expected` is empty,
    `found` is a sentence of its own. `more`: number of further problems of the same file that are not told.

    >>> from fusion import InputError
    >>> print(InputError("rig.toml", "load.mass", found="0", expected="a number above 0"))
    rig.toml: load.mass: expected a number above 0, found 0
    """

    def __init__(self, file: Path | str, key: str, found: str, expected: str, more: int = 0) -> None:
        super().__init__(file, key, found, expected, more)
        self.file = Path(file)
        self.key = key
        self.found = found
        self.expected = expected
        self.more = more

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
        rest = f" ({self.more} more problem{'s' if self.more > 1 else ''} in this file)" if self.more else ""
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


def told(error: Exception) -> InputError | ComputeError:
    """Return a failure as one that the user can be told; what the program does not expect becomes a `ComputeError`."""
    if isinstance(error, InputError | ComputeError):
        return error
    if isinstance(error, OSError):
        return ComputeError(f"the system refused to read or write ({error})")
    return ComputeError(f"internal error ({type(error).__name__}: {error}); please report it, -v shows where")


# What a command writes: where it may go, and how it appears whole or not at all.


TEMPORARY = re.compile(r"\..+-(?P<process>\d+)@(?P<host>[^/]+)")
FORGOTTEN_S = 86_400.0
"""Age after which what a process of another machine left unfinished is taken for abandoned."""


def check_new_file(path: Path, *, force: bool) -> None:
    """Refuse a place for a file that is taken (by a file: unless `force`) or that is in no folder."""
    if path.exists() and not (force and path.is_file()):
        what = "file" if path.is_file() else "folder"
        raise InputError(path, "", found=f"a {what} of this name", expected="a new file (--force replaces it)")
    if not path.absolute().parent.is_dir():
        raise InputError(path, "", found=f"no folder {path.parent}", expected="a file in an existing folder")


def write_whole(path: Path, content: str | bytes) -> None:
    """Write a file by a temporary name and one rename; text as UTF-8 with its line ends as they are."""
    temporary = temporary_beside(path)
    try:
        temporary.write_bytes(content if isinstance(content, bytes) else content.encode("utf-8"))
        os.replace(temporary, path)
    finally:
        temporary.unlink(missing_ok=True)


def temporary_beside(path: Path) -> Path:
    """Return the hidden name beside `path` under which this process prepares it: it tells process and machine."""
    return path.with_name(f".{path.name}-{os.getpid()}@{socket.gethostname()}")


def remove_abandoned(folder: Path) -> list[Path]:
    """Remove from a folder what processes that are gone were preparing there, and return its paths.

    A process of another machine cannot be asked: what it left counts as abandoned after a day without any change.
    """
    removed = [entry for entry in folder.iterdir() if _abandoned(entry)] if folder.is_dir() else []
    for entry in removed:
        if entry.is_dir() and not entry.is_symlink():
            shutil.rmtree(entry, ignore_errors=True)
        else:
            entry.unlink(missing_ok=True)
    return removed


def _abandoned(entry: Path) -> bool:
    """Whether an entry of a folder is a temporary one of a process that is gone."""
    named = TEMPORARY.fullmatch(entry.name)
    if named is None:
        return False
    try:
        if named["host"] != socket.gethostname() or sys.platform == "win32":
            return time.time() - entry.stat().st_mtime > FORGOTTEN_S
        os.kill(int(named["process"]), 0)  # asks whether it exists
    except ProcessLookupError:
        return True
    except (PermissionError, FileNotFoundError):  # of another user; finished in between
        return False
    return False


# Where tables and sentences for the user go: a terminal of its own width, a pipe of 120 columns.


PIPE_WIDTH = 120


def stdout_console() -> Console:
    """Return a console on stdout that prints text as it is."""
    from rich.console import Console

    return Console(width=None if sys.stdout.isatty() else PIPE_WIDTH, highlight=False, markup=False)


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
    """Processes that compute tasks, one each at a time."""

    @property
    def size(self) -> int:
        """How many there are."""

    def submit(self, rank: int, function: Callable[..., Any], *arguments: Any) -> Any:
        """Have a module's function called; of the tasks that wait, the lowest rank comes first.

        Answers that are there may be arguments: the function receives what they hold.
        """


# A progress bar on a terminal, nothing in a pipe.


@contextmanager
def progress_bar(enabled: bool) -> Iterator[ProgressCallback]:
    """Yield a callback that draws one bar per stage on stderr when it is a terminal and `enabled`."""
    if not (enabled and sys.stderr.isatty()):
        yield no_progress
        return
    from rich.console import Console
    from rich.progress import BarColumn, MofNCompleteColumn, Progress, TaskID, TextColumn, TimeRemainingColumn

    tasks: dict[str, TaskID] = {}
    columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn())
    with Progress(*columns, console=Console(stderr=True), transient=True) as bars:

        def update(stage: str, done: int, total: int) -> None:
            if stage not in tasks:
                tasks[stage] = bars.add_task(stage, total=total)
            bars.update(tasks[stage], completed=done, total=total)

        yield update


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


PROGRAM = "shakercal"
__version__ = importlib.metadata.version(PROGRAM)
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


def versions() -> dict[str, str]:
    """Versions of this program, of Python, of the system, and of the libraries that have been imported."""
    found = {PROGRAM: __version__, "python": platform.python_version()}
    for module, distribution in LIBRARIES.items():
        if module not in sys.modules:
            continue
        with contextlib.suppress(importlib.metadata.PackageNotFoundError):
            found[distribution] = importlib.metadata.version(distribution)
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
