"""Errors that end a command: options, files, limits of the machine, internal errors."""

from __future__ import annotations

import os
import re
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from functools import cache
from importlib import import_module
from pathlib import Path

from shakercal._common.notices import DeclaredNotice, Value, fill_template, plain_value

ARGUMENT = re.compile(r"^[a-z_]+(, [a-z_]+)*: (?=expected )")
"""The name of a function's argument before its sentence, which means nothing to a user."""


class DeclaredError(Exception):
    """An error of a declaration with the values of the case."""

    declared: DeclaredNotice
    values: dict[str, Value]

    @property
    def code(self) -> str:
        """The code of the declaration."""
        return self.declared.code

    @property
    def sentence(self) -> str:
        """What was found, without code and place."""
        return fill_template(self.declared.template, self.values)


class InputError(DeclaredError):
    """A mistake in the user's input, with the file and key to correct.

    Attributes
    ----------
    declared : the declaration, with `code`, `effect` and `remedy`.
    file : the file in which the mistake is to be corrected.
    key : TOML key path, column or channel; empty where the file as a whole is meant.
    values : the values of the case by name.
    others : further mistakes of the same file or of files read with it; the sentence only counts them.

    Examples
    --------
    >>> from fusion import InputError
    >>> from shakercal._common.notices import DeclaredNotice
    >>> WRONG_MASS = DeclaredNotice("SC-999", "error", "expected a number above 0, found {found}")
    >>> print(InputError(WRONG_MASS, "rig.toml", "load.mass", found="0"))
    SC-999 rig.toml: load.mass: expected a number above 0, found 0
    """

    def __init__(
        self,
        declared: DeclaredNotice,
        file: Path | str,
        key: str = "",
        /,
        *,
        others: Iterable[InputError] = (),
        **values: Value,
    ) -> None:
        super().__init__(declared, file, key, values, tuple(others))
        self.declared = declared
        self.file = Path(file)
        self.key = key
        self.values = {name: plain_value(value) for name, value in values.items()}
        self.others: tuple[InputError, ...] = self.args[4]

    def __reduce__(self) -> tuple[object, ...]:
        return _input_error, self.args, vars(self)

    def at(self, key: str) -> InputError:
        """Return the same mistake at another key of the file."""
        return _input_error(self.declared, self.file, key, self.values, self.others)

    def in_file(self, file: Path) -> InputError:
        """Return the same mistake of another file."""
        return _input_error(self.declared, file, self.key, self.values, self.others)

    @classmethod
    def together(cls, errors: Iterable[InputError]) -> InputError:
        """Return the first of some mistakes, which carries the others."""
        first, *others = [single for error in errors for single in error.each]
        return _input_error(first.declared, first.file, first.key, first.values, tuple(others))

    @property
    def each(self) -> tuple[InputError, ...]:
        """Return every mistake by itself, this one first."""
        return _input_error(self.declared, self.file, self.key, self.values), *self.others

    @classmethod
    def from_exception(
        cls, error: Exception, file: Path, key: str = "", declared: DeclaredNotice | None = None
    ) -> InputError:
        """Return the refusal of a reader or algorithm as an `InputError`."""
        text = str(error)
        if isinstance(error, OSError) and error.filename is not None and error.strerror is not None:
            text = f"{error.filename}: {error.strerror}"
        prefix = f"{file}: "
        text = text.removeprefix(prefix) if text.startswith(prefix) else ARGUMENT.sub("", text, count=1)
        reason = text.replace(f"{file.parent.resolve()}{os.sep}", "")
        return cls(declared or REFUSED_BY_READER, file, key, reason=reason)

    def __str__(self) -> str:
        where = f"{self.file}: {self.key}: " if self.key else f"{self.file}: "
        more = len(self.others)
        files = {other.file.name for other in self.others if other.file != self.file}
        around = f", also in {' and '.join(sorted(files))}" if files else " in this file"
        rest = f" ({more} more problem{'s' if more > 1 else ''}{around})" if more else ""
        return " ".join(f"{self.code} {where}{self.sentence}{rest}".split())


def _input_error(
    declared: DeclaredNotice, file: Path, key: str, values: dict[str, Value], others: tuple[InputError, ...] = ()
) -> InputError:
    """Return an `InputError` of its arguments, as `pickle` needs it."""
    return InputError(declared, file, key, others=others, **values)


@contextmanager
def as_input_error(file: Path, key: str = "", declared: DeclaredNotice | None = None) -> Iterator[None]:
    """Convert the refusal of a reader or algorithm to an `InputError`."""
    try:
        yield
    except (OSError, ValueError) as error:
        raise InputError.from_exception(error, file, key, declared) from error


class ComputeError(DeclaredError):
    """A result that could not be computed although the input could be read.

    Attributes
    ----------
    declared : the declaration, with `code`, `effect` and `remedy`.
    values : the values of the case by name.

    Examples
    --------
    >>> from fusion import ComputeError
    >>> from shakercal._common.notices import DeclaredNotice
    >>> FEW = DeclaredNotice("SC-998", "error", "only {count} subsets are followed through all frames")
    >>> raise ComputeError(FEW, count=3)
    Traceback (most recent call last):
        ...
    fusion.errors.ComputeError: SC-998 only 3 subsets are followed through all frames
    """

    def __init__(self, declared: DeclaredNotice, where: str = "", /, **values: Value) -> None:
        super().__init__(declared, where, values)
        self.declared = declared
        self.where = where
        self.values = {name: plain_value(value) for name, value in values.items()}

    def __reduce__(self) -> tuple[object, ...]:
        return _compute_error, (type(self), *self.args), vars(self)

    def at(self, where: str) -> ComputeError:
        """Return the same failure, of a named place."""
        return type(self)(self.declared, f"{where}: {self.where}" if self.where else where, **self.values)

    def __str__(self) -> str:
        where = f"{self.where}: " if self.where else ""
        return f"{self.code} {where}{self.sentence}".strip()


def _compute_error(
    kind: type[ComputeError], declared: DeclaredNotice, where: str, values: dict[str, Value]
) -> ComputeError:
    """Return a `ComputeError` of its arguments, as `pickle` needs it."""
    return kind(declared, where, **values)


# Declarations of the command line.


PATH_NOT_UTF8 = DeclaredNotice(
    "SC-127",
    "error",
    "expected {expected}, found {found}",
    effect="No result could name the file.",
    remedy="Rename the file or folder.",
)
OUTPUT_EXISTS = DeclaredNotice(
    "SC-900",
    "error",
    "expected {expected}, found {found}",
    effect="The command did not start.",
    remedy="Choose another name, or use `--force` to replace earlier results.",
)
OUTPUT_FOLDER_MISSING = DeclaredNotice(
    "SC-901",
    "error",
    "expected {expected}, found {found}",
    effect="The command did not start.",
    remedy="Create the folder, or choose another one.",
)
INVALID_OPTION = DeclaredNotice(
    "SC-903",
    "error",
    "{reason}",
    effect="The command did not start.",
    remedy="Correct the option. `--help` lists its values.",
)
CONFLICTING_OPTIONS = DeclaredNotice(
    "SC-904",
    "error",
    "expected {expected}, found {found}",
    effect="The command did not start.",
    remedy="Remove one of the options.",
)
OPTION_OF_ANOTHER_INPUT = DeclaredNotice(
    "SC-905",
    "error",
    "expected {expected}, found {found}",
    effect="The command did not start.",
    remedy="Remove the option.",
)
LENGTH_UNIT_REQUIRED = DeclaredNotice(
    "SC-906",
    "error",
    "expected {expected}, found {found}",
    effect="The scale of the calibration would be wrong by a factor of 1000 if mm were meant.",
    remedy="State the unit with the number.",
    link="cameras.md",
)
FREQUENCIES_NOT_ASCENDING = DeclaredNotice(
    "SC-907",
    "error",
    "expected {expected}, found {found}",
    effect="The command did not start.",
    remedy="State the lower frequency first.",
)
ADDRESS_SPACE_TOO_SMALL = DeclaredNotice(
    "SC-908",
    "error",
    "expected {expected_mb:.0f} MB of addresses, found {found_mb:.0f} MB (ulimit -v)",
    effect="Libraries end the process, or wait forever, if they get no memory.",
    remedy="Raise the limit of the address space.",
)
REFUSED_BY_READER = DeclaredNotice(
    "SC-950", "error", "{reason}", effect="The file is not used.", remedy="Correct the file at this place."
)
TOO_LITTLE_MEMORY = DeclaredNotice(
    "SC-951",
    "error",
    "the memory does not suffice ({reason})",
    effect="The command ended before it wrote results.",
    remedy="Run with fewer `--workers`, or on a machine with more memory.",
)
SYSTEM_REFUSED = DeclaredNotice(
    "SC-952",
    "error",
    "the system refused to read or write ({reason})",
    effect="The command ended before it wrote results.",
    remedy="Check permissions, free space and the connection of the drive.",
)
INTERNAL_ERROR = DeclaredNotice(
    "SC-953",
    "error",
    "internal error ({reason})",
    effect="The command ended before it wrote results.",
    remedy="Please report it with the output of `-v`.",
)
UNKNOWN_CODE = DeclaredNotice(
    "SC-954",
    "error",
    "expected a code between {first} and {last}",
    remedy="`shakercal explain` without a code lists all of them.",
    link="notices.md",
)


# Any exception as an error of the user.


def is_interruption(error: BaseException) -> bool:
    """Whether the user interrupted; compiled code wraps an interruption into an error of its own."""
    cause = error.__cause__ or error.__context__
    return isinstance(error, KeyboardInterrupt) or isinstance(cause, KeyboardInterrupt)


SHORT_OF_MEMORY = re.compile(
    "can't start new thread|failed to map segment|[Ii]nsufficient memory|annot allocate memory"
)
"""What threads, shared libraries, OpenCV and the system say where they get no memory."""


def as_user_error(error: Exception) -> InputError | ComputeError:
    """Return an `InputError` or `ComputeError` for any exception."""
    if isinstance(error, InputError | ComputeError):
        return error
    text = " ".join(str(error).split())
    if isinstance(error, MemoryError) or SHORT_OF_MEMORY.search(str(error)):
        return ComputeError(TOO_LITTLE_MEMORY, reason=text or type(error).__name__)
    if isinstance(error, OSError):
        return ComputeError(SYSTEM_REFUSED, reason=text)
    return ComputeError(INTERNAL_ERROR, reason=f"{type(error).__name__}: {text}")


# Every declaration, for `shakercal explain`, the manifest's `[[acknowledged]]` and the documentation.


@cache
def declared_notices() -> dict[str, tuple[str, DeclaredNotice]]:
    """Return title and declaration of every notice and error by code, ascending."""
    found = {notice.code: (title, notice) for _, notices in declared_by_stage() for title, notice in notices.items()}
    return dict(sorted(found.items()))


@cache
def declared_by_stage() -> tuple[tuple[str, dict[str, DeclaredNotice]], ...]:
    """Return the titles of all modules `*_notices` with their declarations by title, in ascending codes.

    Those of this module are the last.
    """
    stages = []
    for name in [*_modules_of_notices(), __name__]:
        module = import_module(name)
        found = [pair for pair in vars(module).items() if isinstance(pair[1], DeclaredNotice)]
        found.sort(key=lambda pair: pair[1].code)
        title = (module.__doc__ or "").partition("\n")[0].rstrip(".")
        stages.append((title, {name.replace("_", " ").capitalize(): notice for name, notice in found}))
    return (*sorted(stages[:-1], key=lambda stage: next(iter(stage[1].values())).code), stages[-1])


def _modules_of_notices() -> Iterator[str]:
    """Yield the names of the modules `*_notices` of the three packages."""
    for package in ("photogram", "shaker", "fusion"):
        top = Path(str(import_module(package).__file__)).parent
        for path in sorted(top.rglob("*_notices.py")):
            yield ".".join((package, *path.relative_to(top).with_suffix("").parts))
