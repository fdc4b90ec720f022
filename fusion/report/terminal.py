"""Terminal output: text of every encoding, tables, notices, progress."""

from __future__ import annotations

import codecs
import errno
import logging
import os
import re
import shutil
import sys
import textwrap
import time
import unicodedata
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from contextvars import ContextVar
from typing import TYPE_CHECKING, Any

from fusion.base import PROGRAM, ProgressCallback, cleanup_on_signal, count_text, no_progress
from shakercal._common.digits import PLAIN_DIGITS
from shakercal._common.notices import Notice

if TYPE_CHECKING:
    from rich.console import Console, ConsoleOptions
    from rich.segment import Segment

MOST_NOTES = 3  # that are shown one by one after the warnings
log = logging.getLogger(PROGRAM)

# Output of tables and sentences: a terminal with its width, or a pipe without line breaks.


PIPE_WIDTH = 10_000
"""Width of a console without line breaks."""
SPELLED = str.maketrans(
    {"\N{MINUS SIGN}": "-", "±": "+-", "·": "*", "×": "x", "°": " deg", "µ": "u", "μ": "u"}
    | {"–": "-", "—": "-", "…": "...", "“": '"', "”": '"', "‘": "'", "’": "'", "→": "->", "≤": "<=", "≥": ">="}
    | {"≈": "~", "√": "sqrt", "∞": "inf", "Ω": "Ohm", "✓": "yes"}
)
"""ASCII spelling of characters that the encoding of the output lacks."""
RAISED = re.compile("[⁻⁰¹²³⁴⁵⁶⁷⁸⁹]+")
UNPRINTABLE = re.compile(r"[\x00-\x08\x0b-\x1f\x7f-\x9f\u200e\u200f\u202a-\u202e\u2066-\u2069]")
"""Characters that control a terminal: escape sequences, and changes of the writing direction."""


def printable(text: str) -> str:
    """Return a text with control characters as escapes.

    Names may come from files of other people.
    """
    return UNPRINTABLE.sub(lambda found: ascii(found[0])[1:-1], text)


def _spelled(error: UnicodeError) -> tuple[str, int]:
    """Return the replacement of characters that an encoding lacks, and the next position."""
    if not isinstance(error, UnicodeEncodeError):
        raise error
    parts = []
    lacking = RAISED.sub(lambda power: f"^{power[0].translate(PLAIN_DIGITS)}", error.object[error.start : error.end])
    for sign in lacking:
        text = sign.translate(SPELLED)
        if text == sign and unicodedata.name(sign, "").startswith("GREEK "):
            text = unicodedata.name(sign).rpartition("LETTER ")[2].lower()
        elif text == sign:
            text = unicodedata.normalize("NFKD", sign)
        parts.append("".join(part if part.isascii() else "?" for part in text if not unicodedata.combining(part)))
    return "".join(parts), error.end


class Terminal:
    """Output stream that accepts every text: missing characters are spelled, control characters escaped."""

    def __init__(self, stream: Any) -> None:
        self.stream = stream
        codecs.register_error("spelled", _spelled)
        if hasattr(stream, "reconfigure"):
            stream.reconfigure(errors="spelled")

    def write(self, text: str) -> int:
        """Write a text; line feeds and tabs remain."""
        return int(self.stream.write(printable(text)))

    def __getattr__(self, name: str) -> Any:
        return getattr(self.stream, name)


def _behind(stream: Any) -> Any:
    """Return the stream of a terminal, to which consoles write their colours."""
    return stream.stream if isinstance(stream, Terminal) else stream


def stdout_console() -> Console:
    """Return a console on stdout that prints text without control characters."""
    from rich.console import Console

    class Stdout(Console):
        def render(self, renderable: Any, options: ConsoleOptions | None = None) -> Iterator[Segment]:
            for segment in super().render(renderable, options):
                yield segment if segment.control else segment._replace(text=printable(segment.text))

        def on_broken_pipe(self) -> None:
            raise BrokenPipeError(errno.EPIPE, os.strerror(errno.EPIPE))

    width = None if sys.stdout.isatty() else PIPE_WIDTH
    return Stdout(file=_behind(sys.stdout), width=width, highlight=False, markup=False)


def wrapped(text: str, stream: Any) -> str:
    """Return a text with lines wrapped between words if `stream` is a terminal."""
    if not stream.isatty():
        return text
    width, lines = shutil.get_terminal_size().columns, list[str]()
    for line in text.split("\n"):
        indent = line[: len(line) - len(line.lstrip(" "))] + "  "
        parts = textwrap.wrap(
            line, width, subsequent_indent=indent, break_long_words=False, break_on_hyphens=False, drop_whitespace=True
        )
        lines += parts or [line]
    return "\n".join(lines)


def print_text(text: str) -> None:
    """Print sentences on stdout, wrapped between words on a terminal."""
    print(wrapped(text, sys.stdout))


# Tables with whole numbers on terminals of every width.

LONGEST_WORD = 24
"""Characters of a text column below which its words are broken."""
MOST_PARTS = 2
"""Parts into which a table is split at most."""
FRAME = 3
"""Characters of a column beside its cells: two spaces and a rule."""


def print_table(title: str, head: Sequence[str], align: str, sections: Sequence[Sequence[Sequence[str]]]) -> None:
    """Print sections of rows as a table with a rule between them.

    `align`: `l` or `r` per column.
    On a narrow terminal texts and heads are wrapped between words. If this does not suffice, the table is continued
    below with its first column repeated, or its rows become sentences. Numbers are never broken.
    """
    from rich.table import Table

    console = stdout_console()
    columns = [[row[i] for rows in sections for row in rows] for i in range(len(head))]
    spaces = [_column_space(*column) for column in zip(head, align, columns, strict=True)]
    parts = _fitting_parts(spaces, console.width - 1)
    if len(parts) > MOST_PARTS:
        print_text("\n".join([*filter(None, [title]), *(_sentence(head, row) for rows in sections for row in rows)]))
        return
    for part in parts:
        widths = _widths([spaces[i] for i in part], console.width - 1)
        shown = Table(title=title if 1 in (*part, len(head)) else None, title_justify="left")
        for i, width in zip(part, widths, strict=True):
            shown.add_column(head[i], justify="left" if align[i] == "l" else "right", width=width, overflow="fold")
        for rows in sections:
            for row in rows:
                shown.add_row(*(row[i] for i in part))
            shown.add_section()
        console.print(shown)


def _sentence(head: Sequence[str], row: Sequence[str]) -> str:
    """Return a row as a sentence."""
    return "  " + "; ".join(f"{name}: {cell}" for name, cell in zip(head, row, strict=True) if cell)


def _column_space(head: str, align: str, cells: Sequence[str]) -> tuple[int, int]:
    """Return the least and the natural width of a column."""
    from rich.cells import cell_len

    whole = cells if align == "r" else [word for cell in cells for word in cell.split()]
    least = max((cell_len(word) for word in (*head.split(), *whole)), default=1)
    natural = max(cell_len(text) for text in (head, *cells))
    return (least if align == "r" else min(least, LONGEST_WORD)), natural


def _fitting_parts(spaces: Sequence[tuple[int, int]], width: int) -> list[list[int]]:
    """Return the columns of parts that fit in a width, each with the first one."""
    parts, used = [[0]], spaces[0][0] + FRAME
    for i, (least, _) in enumerate(spaces[1:], 1):
        if len(parts[-1]) > 1 and used + least + FRAME > width:
            parts.append([0])
            used = spaces[0][0] + FRAME
        parts[-1].append(i)
        used += least + FRAME
    return parts


def _widths(spaces: Sequence[tuple[int, int]], width: int) -> list[int]:
    """Return the widths of columns: the least ones, larger if there is room."""
    left, widths = width - sum(least + FRAME for least, _ in spaces), []
    for least, natural in spaces:
        more = min(max(0, left), natural - least)
        widths.append(least + more)
        left -= more
    return widths


# Notices.


def log_notices(notices: Iterable[tuple[Notice, str]]) -> None:
    """Log notices with a remark each.

    Every warning is logged; more than a few notes are only counted, unless -v is given.
    """
    given = list(notices)
    shown = [(notice, remark) for notice, remark in given if notice.is_listed]
    verbose = log.isEnabledFor(logging.DEBUG)
    notes = sum(notice.severity != "warning" for notice, _ in shown)
    by_code: dict[str, list[tuple[Notice, str]]] = {}
    for notice, remark in shown:
        if notice.severity == "warning" or verbose or notes <= MOST_NOTES:
            by_code.setdefault(notice.code, []).append((notice, remark))
    for code, group in by_code.items():
        level = logging.WARNING if group[0][0].severity == "warning" else logging.INFO
        for number, text in enumerate(_sentences(group)):
            log.log(level, "%s %s", " " * len(code) if number else code, text)
    if notes > MOST_NOTES and not verbose:
        log.info("%d notes on the page, or here with -v", notes)
    if acknowledged := sum(bool(notice.acknowledged) for notice, _ in given):
        log.info("%s on the page", count_text(acknowledged, "acknowledged notice"))
    if named := " ".join(filter(None, by_code)):
        log.info("effect and remedy: shakercal explain %s", named)


def _sentences(group: Sequence[tuple[Notice, str]]) -> Iterator[str]:
    """Yield the sentences of notices of one code, each with all its places."""
    places: dict[str, list[str]] = {}
    for notice, remark in group:
        where = "" if notice.text.startswith(f"{notice.where}:") else notice.where
        places.setdefault(f"{notice.text.strip()}{remark}", []).append(where)
    for text, found in places.items():
        where = ", ".join(dict.fromkeys(filter(None, found)))
        yield f"{where}: {text}" if where else text


# A progress bar on a terminal only.


AS_JSON: ContextVar[bool] = ContextVar("as_json", default=False)
"""Whether commands print JSON."""
_DRAWN: ContextVar[bool] = ContextVar("drawn", default=False)
"""Whether a progress bar is shown."""


@contextmanager
def progress_bar(enabled: bool) -> Iterator[ProgressCallback]:
    """Yield a callback that shows one bar per stage on stderr.

    Bars are shown if stderr is a terminal and `enabled` is true. With -v the log has the duration of each stage.
    """
    if not (enabled and sys.stderr.isatty()):
        yield _timed(no_progress)
        return
    from rich.console import Console
    from rich.progress import BarColumn, MofNCompleteColumn, Progress, TaskID, TextColumn, TimeRemainingColumn

    tasks: dict[str, TaskID] = {}
    columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn())
    console = Console(file=_behind(sys.stderr))
    with Progress(*columns, console=console, transient=True) as bars, cleanup_on_signal(bars.stop), _drawn():

        def update(stage: str, done: int, total: int) -> None:
            if stage not in tasks:
                tasks[stage] = bars.add_task(printable(stage), total=total)
            bars.update(tasks[stage], completed=done, total=total)

        yield _timed(update)


@contextmanager
def _drawn() -> Iterator[None]:
    """Record that a progress bar is shown."""
    token = _DRAWN.set(True)
    try:
        yield
    finally:
        _DRAWN.reset(token)


def _timed(update: ProgressCallback) -> ProgressCallback:
    """Return a callback that also logs the duration of a complete stage."""
    begun: dict[str, float] = {}

    def timed(stage: str, done: int, total: int) -> None:
        start = begun.setdefault(stage, time.monotonic())
        update(stage, done, total)
        if done >= total:
            log.debug("%s: %.1f s", stage, time.monotonic() - start)
            del begun[stage]

    return timed


@contextmanager
def show_activity(what: str) -> Iterator[None]:
    """Show on a terminal that work goes on, with its duration.

    Messages of the level "info" must be enabled. With -v the log has the duration.
    """
    timed = _timed(no_progress)
    timed(what, 0, 1)
    with _spinner(what):
        yield
    timed(what, 1, 1)


@contextmanager
def _spinner(what: str) -> Iterator[None]:
    """Show a spinner on a terminal."""
    loud = sys.stderr.isatty() and log.isEnabledFor(logging.INFO)
    if not loud or _DRAWN.get():
        yield
        return
    from rich.console import Console
    from rich.progress import Progress, SpinnerColumn, TextColumn, TimeElapsedColumn

    columns = (SpinnerColumn(), TextColumn("{task.description}"), TimeElapsedColumn())
    with (
        Progress(*columns, console=Console(file=_behind(sys.stderr)), transient=True) as bar,
        cleanup_on_signal(bar.stop),
    ):
        bar.add_task(printable(what), total=None)
        yield
