"""Rows of numbers in text files: whole blocks at once, line by line only where a block holds anything unusual."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from io import BytesIO
from pathlib import Path
from typing import BinaryIO

import numpy as np

from shaker._checks import FloatArray
from shaker.signals.files.common import BLOCK

_COMMENT = "#"
_COMMA_TO_POINT = bytes.maketrans(b",", b".")


@dataclass(frozen=True)
class TextLayout:
    """How rows are written: number of columns, delimiter (empty: white space), decimal comma or point.

    `remarks` tells whether what follows the last column is a remark; else it has to be empty.
    """

    path: Path
    columns: int
    delimiter: str
    comma: bool
    remarks: bool = False


def read_columns(layout: TextLayout, start: int, stop: int, line: int, wanted: Sequence[int]) -> list[FloatArray]:
    """Return the columns wanted, each (S,), of the rows in bytes `start` to `stop`, which begin at line number `line`.

    Empty cells are NaN; empty lines and lines that begin with # are passed over. Memory: the result and one block.
    """
    columns = [np.empty(0) for _ in wanted]
    filled = 0
    with layout.path.open("rb") as stream:
        for place, block in whole_lines(stream, start, stop):
            rows = _whole_block(layout, block)
            rows = _line_by_line(layout, block, line, wanted) if rows is None else rows[:, list(wanted)]
            line += block.count(b"\n")
            if columns and filled + len(rows) > len(columns[0]):
                share = (place - start) / (stop - start)
                room = max(filled + len(rows), int((filled + len(rows)) / share * 1.01))
                for column in columns:
                    column.resize(room, refcheck=False)
            for column, own in zip(columns, rows.T, strict=True):
                column[filled : filled + len(rows)] = own
            filled += len(rows)
    for column in columns:
        column.resize(filled, refcheck=False)
    if not filled:
        raise ValueError(f"{layout.path}: line {line}: expected rows of numbers, found none")
    return columns


def find_bytes(stream: BinaryIO, text: bytes, start: int, stop: int) -> int:
    """Return where a text first stands in bytes `start` to `stop` of a file, -1 where it does not."""
    position, tail, overlap = start, b"", len(text) - 1
    stream.seek(start)
    while block := stream.read(min(BLOCK, stop - position)):
        seam = tail + block[:overlap]
        for place, part in ((position - len(tail), seam), (position, block)):
            found = part.find(text)
            if found >= 0:
                return place + found
        position += len(block)
        tail = (seam if len(block) < overlap else block)[-overlap:]
    return -1


def count_lines(stream: BinaryIO, start: int, stop: int) -> int:
    """Return the number of line ends in bytes `start` to `stop` of a file."""
    stream.seek(start)
    lines = 0
    while start < stop and (block := stream.read(min(BLOCK, stop - start))):
        start += len(block)
        lines += block.count(b"\n")
    return lines


def decoded(raw: bytes) -> str:
    """Return text that is UTF-8, with or without mark, or else Latin-1."""
    try:
        return raw.decode("utf-8-sig")
    except UnicodeDecodeError:
        return raw.decode("latin-1")


def whole_lines(stream: BinaryIO, start: int, stop: int) -> Iterator[tuple[int, bytes]]:
    """Yield blocks of whole lines, each ending with a line end, and the place behind them."""
    stream.seek(start)
    rest = b""
    while start < stop and (block := stream.read(min(BLOCK, stop - start))):
        start += len(block)
        head, mark, tail = block.rpartition(b"\n")
        if mark:
            yield start - len(tail), rest + head + mark
            rest = tail
        else:
            rest += tail
    if rest.strip():
        yield stop, rest + b"\n"


def _whole_block(layout: TextLayout, block: bytes) -> FloatArray | None:
    """Return the rows of a block in which every row has the same cells and all hold numbers, else None."""
    delimiter = layout.delimiter.encode()
    block = block.replace(b"\r\n", b"\n")
    if layout.comma:
        block = block.translate(_COMMA_TO_POINT)
    empty_first = bool(delimiter) and block.startswith(delimiter)
    if empty_first:
        block = block[1:].replace(b"\n" + delimiter, b"\n")
    if delimiter and block.find(delimiter + b"\n", 0, block.find(b"\n") + 1) >= 0:
        block = block.replace(delimiter + b"\n", b"\n")
    rows = plain_rows(block, layout.delimiter)
    if rows is None or rows.shape[1] != layout.columns - empty_first:
        return None
    return np.pad(rows, ((0, 0), (1, 0)), constant_values=np.nan) if empty_first else rows


def plain_rows(block: bytes, delimiter: str) -> FloatArray | None:
    """Return the rows (S, columns) of a block with nothing but numbers in equally many cells, else None."""
    if not block.strip() or _COMMENT.encode() in block:
        return None
    try:
        return np.loadtxt(BytesIO(block), delimiter=delimiter or None, comments=None, quotechar='"', ndmin=2)
    except ValueError:
        return None


def _line_by_line(layout: TextLayout, block: bytes, line: int, wanted: Sequence[int]) -> FloatArray:
    """Return the columns wanted (S, W) of a block, or raise `ValueError` naming the line; others may hold texts."""
    rows = []
    for number, text in enumerate(decoded(block.replace(b"\r\n", b"\n")).split("\n"), line):
        if not text.strip() or text.startswith(_COMMENT):
            continue
        cells = text.split(layout.delimiter or None)
        if layout.remarks or not any(cell.strip() for cell in cells[layout.columns :]):
            cells = cells[: layout.columns]
        if len(cells) != layout.columns:
            raise ValueError(f"{layout.path}: line {number}: expected {layout.columns} columns, found {len(cells)}")
        try:
            rows.append([number_of(cells[i], layout.comma) for i in wanted])
        except ValueError as error:
            raise ValueError(f"{layout.path}: line {number}: expected numbers, found {text.strip()[:60]!r}") from error
    return np.array(rows).reshape(-1, len(wanted))


def number_of(cell: str, comma: bool) -> float:
    """Return the number in a cell, NaN where it is empty."""
    cell = cell.strip().strip('"')
    return float(cell.replace(",", ".") if comma else cell) if cell else float("nan")
