"""The two ways a run can fail: the user's input is wrong, or something could not be computed."""

from __future__ import annotations

import os
import re
from pathlib import Path

ARGUMENT = re.compile(r"^[a-z_]+(, [a-z_]+)*: (?=expected )")
"""The name of a function's argument before its sentence, which means nothing to a user."""


class InputError(Exception):
    """A mistake in the user's input, told in one sentence: which file, which key, what was expected, what was found.

    `file`: the file in which the mistake is to be corrected. `key`: TOML key path, column or channel; empty where
    the file as a whole is meant. `found`, `expected`: short phrases without a full stop; where `expected` is empty,
    `found` is a sentence of its own. `more`: number of further problems of the same file that are not told.
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


class ComputeError(Exception):
    """Something could not be computed although the input could be read; the text says what to do."""


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
