"""The numbers of a page by the rule of `shakercal._common.digits`: what breaks it."""

from __future__ import annotations

import re
from dataclasses import dataclass, field
from html.parser import HTMLParser

VERBATIM = ("Settings", "Versions", "Input files", "Inputs", "not as installed")
"""Captions of tables whose cells are quoted from files or programs."""
PYTHON = re.compile(r"(?<![\w.])[-−]?\d+(?:\.\d+)?e[+-]?\d+\b")
HYPHEN = re.compile(r"(?<![\w.–…/)\]:-])-\d+\.?\d*(?![\w-])")
PLACE = re.compile(r" at \([-0-9., ]+\)")
"""Place in the name of an unknown, as the manifest states it."""
WITH_U = re.compile(r"([−-]?\d+(?:\.\d+)?) ± (\d+(?:\.\d+)?)")
POWER = re.compile(r" × 10[⁻⁰¹²³⁴⁵⁶⁷⁸⁹]+")
ROUNDED = re.compile(r"\(?−?\d+\.\d+(?: ± \d+(?:\.\d+)?)?\)?(?: × 10[⁻⁰¹²³⁴⁵⁶⁷⁸⁹]+)?")
"""A cell that is a measured number without a unit."""
PURE = re.compile(
    r"(?i)\bk\b|dof|χ²|ζ|\bE_n\b|\bp\b|share|factor|ratio|deviation|misfit|criterion|probability|chance|weight"
    r"|gain|correlation|condition|degrees|^in the |^of |difference over|over its U|distance|quality|\bQ\b|noise ×|value"
    r"|found|reference|estimate|remaining|left|stated u|k = |version|tolerance|residual|multiple|coefficient|periods"
    r"|load|^[xyz]$|Hz$|index"
)
"""Words of heads of dimensionless columns, or of columns whose rows name the unit."""


@dataclass
class PageTable:
    """A table of a page: caption, and rows of cells with the head first."""

    caption: str = ""
    rows: list[list[str]] = field(default_factory=list)


class _Reader(HTMLParser):
    """Tables and free texts of a page."""

    def __init__(self) -> None:
        super().__init__()
        self.tables: list[PageTable] = []
        self.texts: list[str] = []
        self._skipped = 0
        self._cell: str | None = None

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self._skipped += tag in ("style", "script", "svg", "code")
        if tag == "table":
            self.tables.append(PageTable())
        elif tag == "tr":
            self.tables[-1].rows.append([])
        elif tag in ("td", "th", "caption"):
            self._cell = ""
        elif tag == "br" and self._cell is not None:
            self._cell += "; "

    def handle_endtag(self, tag: str) -> None:
        self._skipped -= tag in ("style", "script", "svg", "code")
        if tag == "caption":
            self.tables[-1].caption, self._cell = self._cell or "", None
        elif tag in ("td", "th"):
            self.tables[-1].rows[-1].append(self._cell or "")
            self._cell = None

    def handle_data(self, data: str) -> None:
        if self._skipped:
            return
        if self._cell is not None:
            self._cell += data
        else:
            self.texts.append(data)


def number_faults(page: str) -> list[str]:
    """Return what a page prints against the rule: notation, signs, digits of U, heads without units, mixed powers."""
    reader = _Reader()
    reader.feed(page)
    faults = [f"text: {fault}" for text in reader.texts for fault in _of_text(text)]
    for table in reader.tables:
        if table.caption.startswith(VERBATIM) or "SHA-256" in "".join(table.rows[0] if table.rows else []):
            continue
        faults += [f"{table.caption[:60]}: {fault}" for row in table.rows for cell in row for fault in _of_text(cell)]
        faults += [f"{table.caption[:60]}: {fault}" for fault in _of_columns(table)]
    return list(dict.fromkeys(faults))


def _of_text(text: str) -> list[str]:
    """Return faults of notation, and values that do not end where their U does."""
    faults = [f"Python's notation in “{text.strip()[:80]}”" for _ in PYTHON.findall(text)]
    without_places = PLACE.sub("", text)
    faults += [f"hyphen for a minus in “{text.strip()[:80]}”" for _ in HYPHEN.findall(without_places)]
    for value, expanded in WITH_U.findall(text):
        digits = expanded.replace(".", "").lstrip("0").rstrip("0" if "." not in expanded else "")
        places = [len(one.partition(".")[2]) for one in (value, expanded)]
        if places[0] != places[1] or len(digits) > 2:
            faults.append(f"digits of {value} ± {expanded}")
    return faults


def _of_columns(table: PageTable) -> list[str]:
    """Return heads of numbers without a unit, and columns with several powers of ten for one unit."""
    head, *rows = table.rows or [[]]
    faults = []
    by_row = any(name in ("unit", "quantity / unit") for name in head) or any(" / " in row[0] for row in rows if row)
    for index, name in enumerate(head):
        cells = [row[index] for row in rows if index < len(row)]
        measured = [cell for cell in cells if ROUNDED.fullmatch(cell)]
        says = (
            " / " in name + table.caption
            or "(" in name
            or " in " in table.caption
            or "%" in table.caption
            or bool(PURE.search(name))
        )
        if measured and name and not says and not by_row and len(measured) == len([c for c in cells if c not in "–"]):
            faults.append(f"no unit in the head “{name}” of {measured[0]}")
        if " / " in name and not by_row:
            powers = {match[0] for cell in measured for match in POWER.finditer(cell)}
            if len(powers) > 1:
                faults.append(f"powers {sorted(powers)} in “{name}”")
    return faults
