"""Letters as outlines, so that a picture looks alike wherever it is opened: DejaVu Sans, as matplotlib brings it."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from functools import cache
from importlib.util import find_spec
from pathlib import Path
from struct import unpack_from
from typing import NamedTuple

from fusion.base import ComputeError

FONT = "mpl-data/fonts/ttf/DejaVuSans.ttf"


class Point(NamedTuple):
    """A point of an outline in units of the font; those that are not `on` it pull it as those of a parabola do."""

    x: float
    y: float
    on: bool


Contours = list[list[Point]]


@dataclass(frozen=True)
class Glyph:
    """One letter: how far the next one stands from it, and its outline as an SVG path, both in units of the font."""

    advance: int
    path: str


@dataclass(frozen=True)
class _Font:
    """A TrueType file: its bytes, where its tables begin, and the ranges of letters (first, last, number of glyph)."""

    data: bytes
    tables: dict[bytes, int]
    ranges: tuple[tuple[int, int, int], ...]

    def numbers(self, table: bytes, offset: int, layout: str) -> tuple[int, ...]:
        """Big-endian numbers at an offset of a table."""
        return unpack_from(f">{layout}", self.data, self.tables[table] + offset)


@cache
def _font() -> _Font:
    """The font's file in the installed matplotlib, which is not imported for that."""
    spec = find_spec("matplotlib")
    if spec is None or not spec.submodule_search_locations:
        raise ComputeError("the package matplotlib, whose font the figures are written in, is not installed")
    data = (Path(spec.submodule_search_locations[0]) / FONT).read_bytes()
    entries = (unpack_from(">4sIII", data, 12 + 16 * k) for k in range(unpack_from(">H", data, 4)[0]))
    tables = {name: start for name, _, start, _ in entries}
    font = _Font(data, tables, ())
    for k in range(font.numbers(b"cmap", 2, "H")[0]):
        (start,) = font.numbers(b"cmap", 8 + 8 * k, "I")
        if font.numbers(b"cmap", start, "H") == (12,):  # ranges of all letters of Unicode
            (count,) = font.numbers(b"cmap", start + 12, "I")
            flat = font.numbers(b"cmap", start + 16, f"{3 * count}I")
            return _Font(data, tables, tuple(zip(flat[::3], flat[1::3], flat[2::3], strict=True)))
    raise ComputeError(f"{FONT} of the installed matplotlib: expected a table of letters of format 12, found none")


@cache
def em() -> int:
    """Units of the font in the size of its letters."""
    return _font().numbers(b"head", 18, "H")[0]


def width(text: str) -> float:
    """Width of a text over the size of its letters."""
    return sum(glyph(letter).advance for letter in text) / em()


@cache
def glyph(letter: str) -> Glyph:
    """One letter; of one that the font lacks its empty box."""
    font, code = _font(), ord(letter)
    number = next((code - first + start for first, last, start in font.ranges if first <= code <= last), 0)
    (wide,) = font.numbers(b"hhea", 34, "H")
    (advance,) = font.numbers(b"hmtx", 4 * min(number, wide - 1), "H")
    return Glyph(advance, "".join(map(_path, _contours(font, number))))


def _contours(font: _Font, number: int) -> Contours:
    """Closed lines of a glyph, those of its parts where it is made of others."""
    place = (
        font.numbers(b"loca", 4 * number, "2I")
        if font.numbers(b"head", 50, "h")[0]
        else tuple(2 * half for half in font.numbers(b"loca", 2 * number, "2H"))
    )
    if place[0] == place[1]:
        return []
    (count,) = font.numbers(b"glyf", place[0], "h")
    return _simple(font, place[0] + 10, count) if count >= 0 else list(_composed(font, place[0] + 10))


def _simple(font: _Font, at: int, count: int) -> Contours:
    """Closed lines of an outline: their ends, a flag for each point, then its steps along x and along y."""
    ends = font.numbers(b"glyf", at, f"{count}H")
    at += 2 * count + 2 + font.numbers(b"glyf", at + 2 * count, "H")[0]
    flags: list[int] = []
    while len(flags) <= ends[-1]:
        flag, more = font.numbers(b"glyf", at, "2B")
        again = more if flag & 8 else 0
        flags += [flag] * (1 + again)
        at += 2 if flag & 8 else 1
    ways = []
    for short, same in ((2, 16), (4, 32)):
        value, values = 0, []
        for flag in flags:
            if flag & short:
                value += font.numbers(b"glyf", at, "B")[0] * (1 if flag & same else -1)
                at += 1
            elif not flag & same:
                value += font.numbers(b"glyf", at, "h")[0]
                at += 2
            values.append(value)
        ways.append(values)
    points = [Point(x, y, bool(flag & 1)) for x, y, flag in zip(*ways, flags, strict=True)]
    return [points[first:end] for first, end in zip([0, *(e + 1 for e in ends)], [e + 1 for e in ends], strict=False)]


def _composed(font: _Font, at: int) -> Iterator[list[Point]]:
    """Closed lines of all parts of a glyph, each turned and moved to its place."""
    more = True
    while more:
        flag, number = font.numbers(b"glyf", at, "2H")
        dx, dy = font.numbers(b"glyf", at + 4, "2h" if flag & 1 else "2b")
        at += 8 if flag & 1 else 6
        kind = next((kind for bit, kind in ((8, "h"), (64, "2h"), (128, "4h")) if flag & bit), "")
        factors = [value / 16384.0 for value in font.numbers(b"glyf", at, kind)] if kind else [1.0]
        at += 2 * len(factors) if kind else 0
        xx, xy, yx, yy = factors if len(factors) == 4 else (factors[0], 0.0, 0.0, factors[-1])
        for line in _contours(font, number):
            yield [Point(dx + xx * p.x + yx * p.y, dy + xy * p.x + yy * p.y, p.on) for p in line]
        more = bool(flag & 32)


def _path(points: list[Point]) -> str:
    """SVG path of a closed line; between two points that pull it, it goes through their middle."""
    whole: list[Point] = []
    for before, point in zip([points[-1], *points], points, strict=False):
        if not before.on and not point.on:
            whole.append(Point((before.x + point.x) / 2.0, (before.y + point.y) / 2.0, on=True))
        whole.append(point)
    first = next(k for k, point in enumerate(whole) if point.on)
    whole = [*whole[first:], *whole[: first + 1]]
    parts, k = [f"M{whole[0].x:g} {whole[0].y:g}"], 1
    while k < len(whole):
        parts.append(("L" if whole[k].on else "Q") + f"{whole[k].x:g} {whole[k].y:g}")
        if not whole[k].on:
            k += 1
            parts.append(f" {whole[k].x:g} {whole[k].y:g}")
        k += 1
    return "".join(parts) + "Z"
