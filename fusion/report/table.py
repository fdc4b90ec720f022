"""Results declared once: a `Column` says what a number is called, where it comes from and how it is printed.

A list of columns is the declaration of a table. Files (`csv_text`), pages (`table`) and the terminal (`text_lines`) are
views of it, so that names, numbers and heads cannot run apart and no row can be shorter than its head.
"""

from __future__ import annotations

import csv
import io
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, fields
from operator import attrgetter
from pathlib import Path
from typing import Any, Generic, TypeVar

import numpy as np
from markupsafe import Markup

R = TypeVar("R")


@dataclass(frozen=True)
class Column(Generic[R]):
    """One column of a table whose rows are objects R.

    `name`: in files, with the unit of a dimensional number; empty for pages only. `value`: of a row, text or number;
    None leaves the cell of a file empty. `head`: on pages and the terminal, None for files only; `shown`: the printed
    cell where it differs from the value; `align`: `l` for words, `r` for numbers.
    """

    name: str
    value: Callable[[R], Any]
    head: str | None = None
    shown: Callable[[R], str] | None = None
    align: str = "r"

    def cell(self, row: R) -> str:
        """Return the printed cell of a row."""
        return str(self.value(row)) if self.shown is None else self.shown(row)


def word(name: str, value: Callable[[R], Any], head: str | None = None) -> Column[R]:
    """Return a column of words: in files under `name`, on pages under `head`."""
    return Column(name, value, head, None, "l")


def on_page(head: str, shown: Callable[[R], str], align: str = "r") -> Column[R]:
    """Return a column that pages alone have."""
    return Column("", shown, head, shown, align)


def columns_of(row: type[Any]) -> list[Column[Any]]:
    """Return the columns of a table in a file whose rows are named tuples or data classes: one for each field."""
    names = getattr(row, "_fields", None) or [field.name for field in fields(row)]
    return [Column(name, attrgetter(name)) for name in names]


@dataclass(frozen=True)
class Table:
    """A table as pages show it: caption, column heads, rows of cells, and per column `l` or `r` for its alignment."""

    caption: str
    head: tuple[str, ...]
    align: str
    rows: tuple[tuple[str, ...], ...]


@dataclass(frozen=True)
class Headline:
    """One of the main results: what it is, its value with U, a remark."""

    label: str
    value: str
    remark: str


def table(caption: str, columns: Sequence[Column[R]], rows: Iterable[R]) -> Table | None:
    """Return rows as pages show them, under the columns that have a head; None where there are none."""
    shown = [column for column in columns if column.head is not None]
    cells = tuple(tuple(column.cell(row) for column in shown) for row in rows)
    head = tuple(column.head or "" for column in shown)
    return Table(caption, head, "".join(column.align for column in shown), cells) if cells else None


def csv_text(columns: Sequence[Column[R]], rows: Iterable[R]) -> str:
    """Return header and rows as CSV text; floats in the shortest form that reads back to the same double."""
    written, stream = [column for column in columns if column.name], io.StringIO()
    writer = csv.writer(stream, lineterminator="\n")
    writer.writerow([column.name for column in written])
    writer.writerows([_text(column.value(row)) for column in written] for row in rows)
    return stream.getvalue()


def _text(value: Any) -> str:
    """Text of one cell of a file."""
    if value is None:
        return ""
    return repr(float(value)) if isinstance(value, float | np.floating) else str(value)


def known(value: float | None) -> float | None:
    """Return a number, None where it is not known (NaN), which leaves the cell of a file empty."""
    return None if value is None or not np.isfinite(value) else float(value)


def text_lines(shown: Table) -> Iterator[str]:
    """Yield the lines of a table in plain text, for the terminal and for a pipe alike."""
    plain = [[Markup(cell).striptags() for cell in row] for row in (shown.head, *shown.rows)]
    widths = [max(len(row[i]) for row in plain) for i in range(len(shown.head))]
    for row in plain:
        cells = zip(row, widths, shown.align, strict=True)
        yield "  ".join(cell.ljust(width) if side == "l" else cell.rjust(width) for cell, width, side in cells).rstrip()


def read_rows(path: Path) -> list[dict[str, str]]:
    """Return the rows of a result table as dictionaries of texts."""
    with path.open(encoding="utf-8", newline="") as stream:
        return list(csv.DictReader(stream))
