"""The two ways a run can fail: the user's input is wrong, or something could not be computed."""

from __future__ import annotations

from pathlib import Path


class InputError(Exception):
    """A mistake in the user's input, told in one sentence: which file, which key, what was expected, what was found.

    `file`: the file in which the mistake is to be corrected. `key`: TOML key path, column or channel; empty where
    the file as a whole is meant. `found`, `expected`: short phrases without a full stop. `more`: number of further
    problems of the same file that are not told.
    """

    def __init__(self, file: Path | str, key: str, found: str, expected: str, more: int = 0) -> None:
        super().__init__(file, key, found, expected, more)
        self.file = Path(file)
        self.key = key
        self.found = found
        self.expected = expected
        self.more = more

    def __str__(self) -> str:
        where = f"{self.file}: {self.key}: " if self.key else f"{self.file}: "
        rest = f" ({self.more} more problem{'s' if self.more > 1 else ''} in this file)" if self.more else ""
        return " ".join(f"{where}expected {self.expected}, found {self.found}{rest}".split())


class ComputeError(Exception):
    """Something could not be computed although the input could be read; the text says what to do."""
