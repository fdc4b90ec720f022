"""Where benchmarks write their tables: between two marks of a page, `<!-- NAME -->` and `<!-- end of NAME -->`."""

from __future__ import annotations

from argparse import ArgumentTypeError
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path


def existing_file(text: str) -> Path:
    """Return the path of an option; an argument error if there is no such file, before anything is measured."""
    if not Path(text).is_file():
        raise ArgumentTypeError(f"expected a file, found none: {text}")
    return Path(text)


def existing_folder(text: str) -> Path:
    """Return the path of an option; an argument error if there is no such folder, before anything is measured."""
    if not Path(text).is_dir():
        raise ArgumentTypeError(f"expected a folder, found none: {text}")
    return Path(text)


def write_marked(page: Path, parts: Mapping[str, str]) -> None:
    """Replace what stands between the marks of each name; KeyError for one that the page does not hold once."""
    text = page.read_text(encoding="utf-8")
    for name, content in parts.items():
        begin, end = f"<!-- {name} -->\n", f"<!-- end of {name} -->\n"
        if text.count(begin) != 1 or text.count(end) != 1:
            raise KeyError(f"{page}: expected {begin.strip()} and {end.strip()} once each")
        (before, rest), inside = text.split(begin), content.strip("\n")
        text = f"{before}{begin}{inside}\n{end}{rest.split(end)[1]}"
    page.write_text(text, encoding="utf-8", newline="\n")


def markdown_row(*cells: str) -> str:
    """Return a row of a table."""
    return f"| {' | '.join(cells)} |"


def markdown_table(head: str, rows: list[str]) -> str:
    """Return a table of its head and rows, each `| a | b |`."""
    return "\n".join([head, "|---" * (head.count("|") - 1) + "|", *rows])


def short_table(
    head: str, rows: list[str], columns: Sequence[int], keep: Callable[[list[str]], bool] = lambda cells: True
) -> str:
    """Return the table that a page shows: some columns of the rows whose cells are kept."""
    cells = [[cell.strip() for cell in line.strip().strip("|").split("|")] for line in (head, *rows)]
    chosen = [cells[0], *filter(keep, cells[1:])]
    first, *others = [markdown_row(*(line[column] for column in columns)) for line in chosen]
    return markdown_table(first, others)
