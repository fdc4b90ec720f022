"""Results declared once, a `Column` each, and numbers as pages print them: rounded to their U, with powers and units.

A list of columns is the declaration of a table. Files (`csv_text`), pages (`table`) and the terminal (`text_lines`) are
views of it, so that names, numbers and heads cannot run apart and no row can be shorter than its head.
"""

from __future__ import annotations

import csv
import io
import re
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, fields
from functools import lru_cache
from itertools import islice
from operator import attrgetter
from pathlib import Path
from typing import Any, Generic, TypeVar

import numpy as np
from markupsafe import Markup

from fusion.base import DASH, round_to_uncertainty
from fusion.errors import InputError
from fusion.estimation.coverage import CoverageRegion, Polar, RealQuantity
from shaker.arrays import ComplexArray
from shaker.labels import typeset

R = TypeVar("R")


@dataclass(frozen=True)
class TableColumn(Generic[R]):
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


def text_column(name: str, value: Callable[[R], Any], head: str | None = None) -> TableColumn[R]:
    """Return a column of words: in files under `name`, on pages under `head`."""
    return TableColumn(name, value, head, None, "l")


def page_column(head: str, shown: Callable[[R], str], align: str = "r") -> TableColumn[R]:
    """Return a column that pages alone have."""
    return TableColumn("", shown, head, shown, align)


def polar_columns(size: str, value: Callable[[R], Polar], *, freedom: bool = False) -> list[TableColumn[R]]:
    """Return the ten columns of a complex value, of which `size` is the magnitude's name.

    `freedom`: instead those of degrees of freedom, factors and of its region, which stand at the end of a table.
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


def sensitivity_unit(output_unit: str, component: str) -> str:
    """ASCII unit of output per load component, `(V/V)/N` or `(V/V)/(N.m)`."""
    numerator = f"({output_unit})" if "/" in output_unit else output_unit
    return f"{numerator}/N" if component.startswith("F") else f"{numerator}/(N.m)"


def columns_of(row: type[Any]) -> list[TableColumn[Any]]:
    """Return the columns of a table in a file whose rows are named tuples or data classes: one for each field."""
    names = getattr(row, "_fields", None) or [field.name for field in fields(row)]
    return [TableColumn(name, attrgetter(name)) for name in names]


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


def plain_text(marked: str) -> str:
    """Return what a page shows as plain text, powers with a caret."""
    return Markup(re.sub(r"<sup>(.*?)</sup>", r"^\1", str(marked))).striptags()


def csv_rows(text: str) -> list[dict[str, str | float | None]]:
    """Return the rows of a table in a file, numbers as such, None for those that are not known."""

    def cell(value: str) -> str | float | None:
        try:
            number = float(value)
        except ValueError:
            return value
        return number if np.isfinite(number) else None

    return [{name: cell(value) for name, value in row.items()} for row in csv.DictReader(io.StringIO(text))]


def table(caption: str, columns: Sequence[TableColumn[R]], rows: Iterable[R]) -> Table | None:
    """Return rows as pages show them, under the columns that have a head; None where there are none."""
    shown = [column for column in columns if column.head is not None]
    cells = tuple(tuple(column.cell(row) for column in shown) for row in rows)
    head = tuple(column.head or "" for column in shown)
    return Table(caption, head, "".join(column.align for column in shown), cells) if cells else None


def csv_text(columns: Sequence[TableColumn[R]], rows: Iterable[R]) -> str:
    """Return header and rows as CSV text; floats in the shortest form that reads back to the same double."""
    written, stream = [column for column in columns if column.name], io.StringIO()
    writer = csv.writer(stream, lineterminator="\n")
    writer.writerow([column.name for column in written])
    writer.writerows([_cell(column.value(row)) for column in written] for row in rows)
    return stream.getvalue()


FORMULA, QUOTED = re.compile(r"'*[=+\-@\t\r]"), re.compile(r"'+[=+\-@\t\r]")
NUMBER = re.compile(r"[+-]?(\d+\.?\d*|\.\d+)([eE][+-]?\d+)?|[+-]?(inf|nan)")


def _cell(value: Any) -> Any:
    """What csv writes of a value: texts as `_escaped`, floats in full, nothing for None.

    A text that a spreadsheet would take for a formula has an apostrophe in front, as has one that begins so already:
    names come from files of others. `read_rows` takes it away.
    """
    if isinstance(value, str):
        return _escaped(value)
    return float(value) if isinstance(value, np.floating) else value


@lru_cache(1000)  # a table has few words, and many times
def _escaped(text: str) -> str:
    return f"'{text}" if FORMULA.match(text) and not NUMBER.fullmatch(text) else text


def finite_or_none(value: float | None) -> float | None:
    """Return a number, None where it is not known (NaN), which leaves the cell of a file empty."""
    return None if value is None or not np.isfinite(value) else float(value)


def text_lines(shown: Table) -> Iterator[str]:
    """Yield the lines of a table in plain text, for the terminal and for a pipe alike."""
    plain = [[Markup(cell).striptags() for cell in row] for row in (shown.head, *shown.rows)]
    widths = [max(len(row[i]) for row in plain) for i in range(len(shown.head))]
    for row in plain:
        cells = zip(row, widths, shown.align, strict=True)
        yield "  ".join(cell.ljust(width) if side == "l" else cell.rjust(width) for cell, width, side in cells).rstrip()


def read_rows(path: Path, most: int | None = None) -> list[dict[str, str]]:
    """Return the rows of a result table as dictionaries of texts, the first so many where `most` says so."""
    try:
        with path.open(encoding="utf-8", newline="") as stream:
            rows = list(islice(csv.DictReader(stream), most))
    except (csv.Error, UnicodeDecodeError) as error:
        raise InputError(path, "", found=str(error), expected="a table of results") from error
    return [{name: text[1:] if text and QUOTED.match(text) else text for name, text in row.items()} for row in rows]


# Numbers as pages print them: rounded to their expanded uncertainty, with powers of ten and units, as HTML.


LARGEST_PHASE_U = 1.0
"""Expanded uncertainty in rad above which a phase is printed as not determined."""
LARGEST_DOF = 1000
WEAK = "not distinguishable from 0"


def quantity_html(value: float, expanded: float, unit: str = "") -> Markup:
    """Value and expanded uncertainty as HTML: `(2.0012 ± 0.0013) × 10⁻⁷ V/N`."""
    text = round_to_uncertainty(value, expanded)
    body = text.value if text.expanded == DASH else f"{text.value} ± {text.expanded}"
    bracketed = f"({body})" if text.expanded != DASH and (unit or text.exponent) else body
    minus = "\N{MINUS SIGN}" if text.exponent < 0 else ""
    power = Markup(" × 10<sup>{}{}</sup>").format(minus, abs(text.exponent)) if text.exponent else Markup("")
    return Markup("{}{}{}").format(bracketed, power, f" {typeset(unit)}" if unit else "")


def scaled_html(value: float, expanded: float, exponent: int) -> Markup:
    """Value and expanded uncertainty in units of a power of ten that stands elsewhere."""
    text = round_to_uncertainty(value, expanded, exponent)
    return Markup(text.value if text.expanded == DASH else f"{text.value} ± {text.expanded}")


def times_ten(exponent: int, unit: str) -> Markup:
    """Unit with a power of ten before it."""
    minus = "\N{MINUS SIGN}" if exponent < 0 else ""
    return (
        Markup("10<sup>{}{}</sup> {}").format(minus, abs(exponent), typeset(unit))
        if exponent
        else Markup(typeset(unit))
    )


def has_phase(element: Polar) -> bool:
    """Whether a phase is determined: beside a magnitude that may be 0 it may be any."""
    may_vanish = element.expanded_magnitude >= element.magnitude or element.region.holds_zero
    return element.expanded_phase_rad <= LARGEST_PHASE_U and not may_vanish


def phase(element: Polar) -> Markup:
    """Phase with U, or a dash where it is not determined."""
    return quantity_html(element.phase_rad, element.expanded_phase_rad) if has_phase(element) else Markup(DASH)


def polar_cells(element: Polar, exponent: int | None = None) -> tuple[str, str, str]:
    """Magnitude and phase with U, and k; of a value that may be zero the half-axes of its region, and their factor.

    `exponent`: power of ten that stands elsewhere, by default with the magnitude. k of magnitude and phase, one number
    where they are the same as printed.
    """
    region = element.region
    if region.holds_zero:
        return half_axes(region, exponent), WEAK, factor_text(element.region_factor)
    size, expanded = element.magnitude, element.expanded_magnitude
    cell = quantity_html(size, expanded) if exponent is None else scaled_html(size, expanded, exponent)
    return cell, phase(element), magnitude_phase_text(factor_text(element.k), factor_text(element.k_phase))


def magnitude_phase_text(of_magnitude: str, of_phase: str) -> str:
    """What holds for magnitude and phase: one text where it is the same for both."""
    return of_magnitude if of_magnitude == of_phase else f"{of_magnitude}; {of_phase}"


def polar_freedom(element: Polar) -> str:
    """Degrees of freedom of magnitude and phase: of the parts along a value and across it."""
    return magnitude_phase_text(degrees_of_freedom(element.dof_magnitude), degrees_of_freedom(element.dof_phase))


def half_axes(region: CoverageRegion, exponent: int | None = None) -> Markup:
    """Half-axes of a region, to two digits of the larger one."""
    if not np.isfinite(region.half_axes[0]):
        return Markup(DASH)
    large, small_axis = region.half_axes
    first = round_to_uncertainty(large, large, exponent)
    second = round_to_uncertainty(small_axis, large, first.exponent)
    power = times_ten(first.exponent, "") if exponent is None and first.exponent else Markup("")
    return Markup("region ± {}, ± {}{}").format(
        first.value, second.value, Markup(" × {}").format(power) if power else ""
    )


def factor_text(value: float) -> str:
    """A coverage factor."""
    return f"{value:.2f}" if np.isfinite(value) else DASH


def common_exponent(values: ComplexArray) -> int:
    """Power of ten of the largest finite value, none where it is readable as it is."""
    sizes = np.abs(values[np.isfinite(values)])
    return round_to_uncertainty(float(sizes.max()), 0.0).exponent if sizes.size else 0


def short(value: float) -> Markup:
    """Two significant digits, with a power of ten where that is shorter."""
    if not np.isfinite(value):
        return Markup(DASH)
    value = float(f"{value:.1e}")
    exponent = round_to_uncertainty(value, 0.0).exponent
    text = f"{value / 10.0**exponent:.2g}" if exponent else f"{value:.6g}"
    text = text.replace("-", "\N{MINUS SIGN}")
    return Markup("{} × {}").format(text, times_ten(exponent, "").strip()) if exponent else Markup(text)


def number(value: float | None) -> str:
    """Three significant digits, a dash for what is unknown."""
    return DASH if value is None or not np.isfinite(value) else f"{value:.3g}"


def small(value: float) -> str:
    """Two significant digits of an uncertainty; what is far below the last place of interest is only bounded."""
    return f"{value:#.2g}".removesuffix(".") if value >= 1e-3 else "< 0.001"


def degrees_of_freedom(value: float) -> str:
    """Degrees of freedom as a whole number; thousands of them are as good as any number."""
    return f"{value:.0f}" if value <= LARGEST_DOF else ("∞" if np.isinf(value) else f"> {LARGEST_DOF}")


def microseconds(value_s: float | None, u_s: float | None) -> str:
    """A duration with U, a dash where it is not known."""
    return DASH if value_s is None or u_s is None else quantity_html(1e6 * value_s, 2e6 * u_s)


def quantity_text(value: float, expanded: float, unit: str = "") -> str:
    """Value with U and unit for the terminal, without a power of ten: `(2.0012 ± 0.0013) V/N`."""
    both = round_to_uncertainty(value, expanded, 0)
    if unit:
        return f"{both.text} {typeset(unit)}"
    return both.value if both.expanded == DASH else f"{both.value} ± {both.expanded}"


def signed_text(value: float, form: str = ".2f") -> str:
    """A number with a typographic minus sign, a dash for what is unknown; no sign before zero."""
    text = format(value + 0.0, form) if np.isfinite(value) else DASH
    return text.removeprefix("-") if not text.strip("-0.") else text.replace("-", "\N{MINUS SIGN}")


def capitalise(text: str) -> str:
    """Text with a capital letter at its beginning."""
    return text[:1].upper() + text[1:]
