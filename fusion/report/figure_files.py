"""Figures as files: SVG, and PNG or PDF of the same drawing by matplotlib."""

from __future__ import annotations

import io
import re
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal
from xml.etree import ElementTree

import matplotlib as mpl
import numpy as np
from matplotlib.artist import Artist
from matplotlib.figure import Figure as Canvas
from matplotlib.patches import PathPatch, Rectangle
from matplotlib.path import Path as Outline
from matplotlib.text import Text
from matplotlib.transforms import Affine2D, Transform

from fusion.report.figure import WIDTH_IN, Figure
from fusion.report.static_figure import PT, static_svg

PNG_DPI = 200
"""Resolution of PNG files (chosen for print)."""
UNDATED: dict[str, dict[str, Any]] = {"svg": {"Date": None, "Creator": None}, "pdf": {"CreationDate": None}, "png": {}}
STYLE = mpl.rc_params_from_file(Path(__file__).with_name("templates") / "figures.mplstyle", use_default_template=False)
ALIGNMENT: dict[str, Literal["left", "center", "right"]] = {"start": "left", "middle": "center", "end": "right"}
COMMAND = re.compile("([MLZh])([^MLZh]*)")
"""A command of a path with its numbers."""
DOT_PT = np.array([0.01, 0.0])  # a stroke that is a dot


@dataclass(frozen=True)
class PrintedFigure:
    """One figure as SVG text with an identifier, a title and a caption."""

    name: str
    title: str
    caption: str
    svg: str


@contextmanager
def drawing(name: str) -> Iterator[None]:
    """Apply the style, with SVG identifiers that depend only on the name of the figure."""
    settings: Any = {**STYLE, "svg.hashsalt": name}
    with mpl.rc_context(settings):
        yield


def new_figure(height_in: float, width_in: float = WIDTH_IN) -> Canvas:
    """Return an empty figure of the page's width."""
    return Canvas(figsize=(width_in, height_in))


def figure_bytes(figure: Canvas, kind: str) -> bytes:
    """Return a figure as a png, svg or pdf file without a date."""
    stream = io.BytesIO()
    figure.savefig(stream, format=kind, dpi=PNG_DPI, metadata=UNDATED[kind])
    return stream.getvalue()


def finish(figure: Canvas, name: str, title: str, caption: str) -> PrintedFigure:
    """Return a figure as SVG text without a date."""
    return PrintedFigure(name, title, caption, figure_bytes(figure, "svg").decode())


def render_figure(figure: Figure, kind: str = "svg") -> bytes:
    """Return a figure as a file: svg, png or pdf.

    Equal figures give equal bytes.
    """
    svg = static_svg(figure)
    if kind == "svg":
        return svg.encode()
    with drawing(figure.name):
        canvas = new_figure(figure.height_in, figure.width_in)
        page = Affine2D().scale(1.0 / PT, -1.0 / PT).translate(0.0, figure.height_in) + canvas.dpi_scale_trans
        for artist in _artists(svg, page):
            canvas.add_artist(artist)
        return figure_bytes(canvas, kind)


def _artists(svg: str, page: Transform) -> Iterator[Artist]:
    """Yield the paths and texts of a still picture; `page` transforms its pt."""
    windows: dict[str, Rectangle] = {}
    makers = {"path": _path, "text": _text}

    def inside(parent: ElementTree.Element, window: Rectangle | None) -> Iterator[Artist]:
        for element in parent:
            kind = element.tag.rpartition("}")[2]
            if kind == "clipPath":
                x, y, width, height = (float(element[0].attrib[key]) for key in ("x", "y", "width", "height"))
                windows[f"url(#{element.attrib['id']})"] = Rectangle((x, y), width, height, transform=page)
            elif kind == "g":
                yield from inside(element, windows.get(element.attrib.get("clip-path", "")))
            elif kind in makers:
                artist = makers[kind](element, page)
                if window is not None:
                    artist.set_clip_path(window)
                yield artist

    yield from inside(ElementTree.fromstring(svg.encode()), None)


def _path(element: ElementTree.Element, page: Transform) -> Artist:
    """Return lines, areas and dots."""
    look, corners, codes = element.attrib, list[Any](), list[np.uint8]()
    first = last = np.zeros(2)
    for letter, text in COMMAND.findall(look["d"]):
        points = np.array(text.split(), dtype=np.float64)
        point = {"Z": first, "h": last + DOT_PT}.get(letter, points)
        first, last = point if letter == "M" else first, point
        corners.append(point)
        codes.append({"M": Outline.MOVETO, "Z": Outline.CLOSEPOLY}.get(letter, Outline.LINETO))
    width, dashes = float(look.get("stroke-width", 0.0)), look.get("stroke-dasharray", "").split()
    fill, opacity = look.get("fill", "none"), float(look.get("fill-opacity", 1.0))
    return PathPatch(
        Outline(corners, codes),
        transform=page,
        facecolor="none" if fill == "none" else (fill, opacity),
        edgecolor=look.get("stroke", "none"),
        linewidth=width,
        linestyle=(0, [float(part) / width for part in dashes]) if dashes else "-",
        capstyle={"round": "round", "square": "projecting"}.get(look.get("stroke-linecap", ""), "butt"),
        joinstyle="round",
        snap=None if look.get("stroke-linecap") != "round" else False,  # a dot would vanish between two pixels
    )


def _text(element: ElementTree.Element, page: Transform) -> Artist:
    """Return a text, horizontal or upright."""
    look = element.attrib
    return Text(
        float(look["x"]),
        float(look["y"]),
        "".join(element.itertext()),
        transform=page,
        color=look["fill"],
        fontsize=float(look["font-size"]),
        horizontalalignment=ALIGNMENT[look["text-anchor"]],
        rotation=90 if "transform" in look else 0,
        rotation_mode="anchor",
        parse_math=False,
    )
