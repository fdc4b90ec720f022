"""Columns of tables, declared once for all views, rounded numbers, notices on pages.

A list of columns is the declaration of a table. Files (`csv_text`) and pages (`table`) use the same declaration, so
that names, numbers and heads always agree.
"""

from __future__ import annotations

import csv
import io
import re
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, fields
from functools import lru_cache
from itertools import islice
from operator import attrgetter
from pathlib import Path
from typing import Any, Generic, TypeVar

import numpy as np
from markupsafe import Markup, escape

from fusion.errors import InputError
from fusion.estimation.coverage import CoverageRegion, Polar, RealQuantity
from fusion.report.report_notices import UNREADABLE_TABLE
from shakercal._common.arrays import ComplexArray
from shakercal._common.digits import DASH, power_text, quantity_text, round_to_uncertainty, scaled_text
from shakercal._common.notices import Notice, warnings_first

R = TypeVar("R")


@dataclass(frozen=True)
class TableColumn(Generic[R]):
    """One column of a table whose rows are objects R.

    `name`: in files, with the unit of a dimensional number; empty for pages only. `value`: of a row, text or number;
    None is an empty cell of a file. `head`: on pages and the terminal, None for files only; `shown`: the printed cell
    if it differs from the value; `align`: `l` for texts, `r` for numbers.
    """

    name: str
    value: Callable[[R], Any]
    head: str | None = None
    shown: Callable[[R], str] | None = None
    align: str = "r"

    def cell(self, row: R) -> str:
        """Return the printed cell of a row."""
        return str(self.value(row)) if self.shown is None else self.shown(row)


def text_column(name: str, value: Callable[[R], Any], head: str | None = None) -> TableColumn[R]:
    """Return a column of texts: in files under `name`, on pages under `head`."""
    return TableColumn(name, value, head, None, "l")


def page_column(head: str, shown: Callable[[R], str], align: str = "r") -> TableColumn[R]:
    """Return a column for pages only."""
    return TableColumn("", shown, head, shown, align)


def polar_columns(size: str, value: Callable[[R], Polar], *, freedom: bool = False) -> list[TableColumn[R]]:
    """Return the ten columns of a complex value; `size` is the name of its magnitude.

    `freedom`: instead those of degrees of freedom, factors and region, for the end of a table.
    """

    def column(field: str) -> TableColumn[R]:
        return TableColumn(field.replace("magnitude", size), lambda row: getattr(value(row), field))

    return [column(field.name) for field in (fields(Polar)[10:] if freedom else fields(Polar)[:10])]


def quantity_columns(quantity: Callable[[R], RealQuantity]) -> list[TableColumn[R]]:
    """Return the six columns of a real quantity."""
    return [
        TableColumn("value", lambda row: quantity(row).value),
        TableColumn("u", lambda row: quantity(row).u),
        TableColumn("U", lambda row: quantity(row).expanded),
        TableColumn("k", lambda row: quantity(row).k),
        text_column("unit", lambda row: quantity(row).unit),
        TableColumn("dof", lambda row: quantity(row).dof),
    ]


def columns_of(row: type[Any]) -> list[TableColumn[Any]]:
    """Return one column per field of named tuples or data classes."""
    names = getattr(row, "_fields", None) or [field.name for field in fields(row)]
    return [TableColumn(name, attrgetter(name)) for name in names]


@dataclass(frozen=True)
class Table:
    """A table for pages: caption, heads, alignment (`l` or `r` per column) and rows."""

    caption: str
    head: tuple[str, ...]
    align: str
    rows: tuple[tuple[str, ...], ...]


@dataclass(frozen=True)
class Headline:
    """One of the main results: its name, its value with U, a remark."""

    label: str
    value: str
    remark: str


def csv_rows(text: str) -> list[dict[str, str | float | None]]:
    """Return the rows of a CSV text as dictionaries.

    Numbers as numbers, empty cells as None.
    """

    def cell(value: str) -> str | float | None:
        try:
            number = float(value)
        except ValueError:
            return value
        return number if np.isfinite(number) else None

    return [{name: cell(value) for name, value in row.items()} for row in csv.DictReader(io.StringIO(text))]


def table(caption: str, columns: Sequence[TableColumn[R]], rows: Iterable[R]) -> Table | None:
    """Return rows for pages under the columns with a head; None without rows."""
    shown = [column for column in columns if column.head is not None]
    cells = tuple(tuple(column.cell(row) for column in shown) for row in rows)
    head = tuple(column.head or "" for column in shown)
    return Table(caption, head, "".join(column.align for column in shown), cells) if cells else None


def csv_text(columns: Sequence[TableColumn[R]], rows: Iterable[R]) -> str:
    """Return header and rows as CSV text; floats in the shortest exact form."""
    written, stream = [column for column in columns if column.name], io.StringIO()
    writer = csv.writer(stream, lineterminator="\n")
    writer.writerow([column.name for column in written])
    writer.writerows([_cell(column.value(row)) for column in written] for row in rows)
    return stream.getvalue()


FORMULA, QUOTED = re.compile(r"'*[=+\-@\t\r]"), re.compile(r"'+[=+\-@\t\r]")
NUMBER = re.compile(r"[+-]?(\d+\.?\d*|\.\d+)([eE][+-]?\d+)?|[+-]?(inf|nan)")


def _cell(value: Any) -> Any:
    """Return the CSV form of a value: texts escaped, floats in full, None empty.

    A text that a spreadsheet would read as a formula gets a leading apostrophe, also if it begins with one already.
    Names may come from files of other people. `read_rows` removes it.
    """
    if isinstance(value, str):
        return _escaped(value)
    return float(value) if isinstance(value, np.floating) else value


@lru_cache(1000)  # a table has few words, and many times
def _escaped(text: str) -> str:
    return f"'{text}" if FORMULA.match(text) and not NUMBER.fullmatch(text) else text


def finite_or_none(value: float | None) -> float | None:
    """Return a finite number, None for NaN, which is an empty cell in a file."""
    return None if value is None or not np.isfinite(value) else float(value)


def read_rows(path: Path, most: int | None = None) -> list[dict[str, str]]:
    """Return the rows of a result table as dictionaries of texts.

    `most`: largest number of rows.
    """
    try:
        with path.open(encoding="utf-8", newline="") as stream:
            rows = list(islice(csv.DictReader(stream), most))
    except (csv.Error, UnicodeDecodeError) as error:
        raise InputError(UNREADABLE_TABLE, path, reason=str(error)) from error
    return [{name: text[1:] if text and QUOTED.match(text) else text for name, text in row.items()} for row in rows]


# Complex values and degrees of freedom as pages print them.


LARGEST_PHASE_U = 1.0
"""Expanded uncertainty in rad above which a phase is printed as not determined."""
LARGEST_DOF = 1000
"""Degrees of freedom from which k differs from that of infinity by less than 0.2 %."""
WEAK = "not distinguishable from 0"


def has_phase(element: Polar) -> bool:
    """Return whether a phase is determined."""
    may_vanish = element.expanded_magnitude >= element.magnitude or element.region.holds_zero
    return element.expanded_phase_rad <= LARGEST_PHASE_U and not may_vanish


def phase(element: Polar) -> str:
    """Return the phase with U, or a dash if it is not determined."""
    return quantity_text(element.phase_rad, element.expanded_phase_rad) if has_phase(element) else DASH


def polar_cells(element: Polar, exponent: int | None = None) -> tuple[str, str, str]:
    """Return magnitude and phase with U, and k.

    A value that may be zero has the half-axes of its region, and their factor.
    """
    region = element.region
    if region.holds_zero:
        return half_axes(region, exponent), WEAK, factor_text(element.region_factor)
    size, expanded = element.magnitude, element.expanded_magnitude
    cell = quantity_text(size, expanded) if exponent is None else scaled_text(size, expanded, exponent)
    return cell, phase(element), magnitude_phase_text(factor_text(element.k), factor_text(element.k_phase))


def magnitude_phase_text(of_magnitude: str, of_phase: str) -> str:
    """Return the texts for magnitude and phase, only one if they are equal."""
    return of_magnitude if of_magnitude == of_phase else f"{of_magnitude}; {of_phase}"


def polar_freedom(element: Polar) -> str:
    """Return the degrees of freedom of magnitude and phase."""
    return magnitude_phase_text(degrees_of_freedom(element.dof_magnitude), degrees_of_freedom(element.dof_phase))


def half_axes(region: CoverageRegion, exponent: int | None = None) -> str:
    """Return the half-axes of a region; `exponent`: power that the head names."""
    if not np.isfinite(region.half_axes[0]):
        return DASH
    large, small_axis = region.half_axes
    first = round_to_uncertainty(large, large, exponent)
    second = round_to_uncertainty(small_axis, small_axis, first.exponent)
    text = f"region ± {first.value}, ± {second.value}"
    return f"({text}) × {power_text(first.exponent)}" if exponent is None and first.exponent else text


def factor_text(value: float) -> str:
    """Return a coverage factor as text."""
    return f"{value:.2f}" if np.isfinite(value) else DASH


def common_exponent(values: ComplexArray) -> int:
    """Return the power of ten of the largest finite value, 0 if it is readable."""
    sizes = np.abs(values[np.isfinite(values)])
    return round_to_uncertainty(float(sizes.max()), 0.0).exponent if sizes.size else 0


def degrees_of_freedom(value: float) -> str:
    """Return degrees of freedom as an integer; infinity if there are thousands."""
    return f"{value:.0f}" if value <= LARGEST_DOF else ("∞" if np.isinf(value) else f"> {LARGEST_DOF}")


def microseconds(value_s: float | None, u_s: float | None) -> str:
    """Return a duration with U, or a dash if it is not known."""
    return DASH if value_s is None or u_s is None else quantity_text(1e6 * value_s, 2e6 * u_s)


def capitalise(text: str) -> str:
    """Return a text with a capital first letter."""
    return text[:1].upper() + text[1:]


# Notices on pages.


def notice_frame(notices: Iterable[Notice]) -> dict[str, Any]:
    """Return the notices of a page, and tables of acknowledged and of not assessed ones."""
    every = warnings_first(notices)
    seen = [one for one in every if one.acknowledged]
    assumed = [one for one in every if one.possible_size and not one.acknowledged]
    heads = ("code", "where", "notice", "reason (by, date)"), ("code", "influence", "where", "size", "how to assess it")
    rows = [(_named(one), one.where, code_html(one.text), one.acknowledged) for one in seen]
    sized = [(_named(one), *map(code_html, (one.text, one.where, one.possible_size, one.remedy))) for one in assumed]
    return {
        "notices": [one for one in every if one.is_listed],
        "acknowledged": Table("Acknowledged", heads[0], "llll", tuple(rows)) if seen else None,
        "not_assessed": Table("Influences outside U", heads[1], "lllll", tuple(sized)) if assumed else None,
    }


def code_html(text: str) -> Markup:
    """Return a text with its `code` marked for pages."""
    return Markup(re.sub(r"`([^`]+)`", r"<code>\1</code>", str(escape(text))))


def _named(notice: Notice) -> Markup:
    """Return the code of a notice, which stays on one line."""
    return Markup('<span class="code">{}</span>').format(notice.code)
