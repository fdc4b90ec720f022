"""A task that another process computes: what it returns, raises and logs comes back as one answer."""

from __future__ import annotations

import logging
import pickle
import threading
import traceback
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any

log = logging.getLogger("shakercal")
_ALONE = threading.Lock()  # threads of one process share the logger and what the libraries are limited to


@dataclass(frozen=True, eq=False)
class Answer:
    """What a task returned or raised, and what it logged."""

    value: Any
    error: Exception | None
    told: tuple[logging.LogRecord, ...]

    def __reduce__(self) -> tuple[Callable[..., Answer], tuple[bytes]]:
        """Travel in one piece: a cluster hands over large arrays apart, read where they lie in a message.

        There they begin at any byte, and kernels and sums over such an array are others than over one that numpy made.
        """
        return _arrived, (pickle.dumps((self.value, self.error, self.told)),)

    def opened(self) -> Any:
        """Return or raise what the task did."""
        if self.error is not None:
            raise self.error
        return self.value

    def log(self, name: str) -> None:
        """Log what the task logged, behind the name of what it was about."""
        for record in self.told:
            if log.isEnabledFor(record.levelno):
                log.log(record.levelno, "%s: %s", name, record.getMessage())


def call(function: Callable[..., Any], *arguments: Any) -> Answer:
    """Call a function, one at a time in a process; answers among its arguments are opened.

    An exception carries the place it came from as its note.
    """
    with _ALONE, _kept_log() as told:
        try:
            return Answer(function(*(_opened(argument) for argument in arguments)), None, tuple(told))
        except Exception as error:
            error.add_note(traceback.format_exc())
            return Answer(None, error, tuple(told))


def _arrived(packed: bytes) -> Answer:
    """The answer that has travelled."""
    return Answer(*pickle.loads(packed))


def _opened(argument: Any) -> Any:
    """The value of an answer; anything else as it is."""
    return argument.opened() if isinstance(argument, Answer) else argument


@contextmanager
def _kept_log() -> Iterator[list[logging.LogRecord]]:
    """Collect what the program logs instead of telling it here."""
    kept: list[logging.LogRecord] = []
    before = log.handlers, log.propagate, log.level
    log.handlers, log.propagate = [_Keeper(kept)], False
    log.setLevel(logging.DEBUG)
    try:
        yield kept
    finally:
        log.handlers, log.propagate = before[:2]
        log.setLevel(before[2])


class _Keeper(logging.Handler):
    """Keeps records as plain text, which can go to another process."""

    def __init__(self, kept: list[logging.LogRecord]) -> None:
        super().__init__()
        self._kept = kept

    def emit(self, record: logging.LogRecord) -> None:
        plain = logging.makeLogRecord({**vars(record), "msg": record.getMessage(), "args": None, "exc_info": None})
        self._kept.append(plain)
