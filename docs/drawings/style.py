"""One look for the drawings of the documents, their shapes, the tables they show, and where they are written."""

from __future__ import annotations

import io
import re
from pathlib import Path
from typing import Any

import matplotlib as mpl
import numpy as np
from matplotlib.figure import Figure
from matplotlib.patches import FancyArrowPatch, FancyBboxPatch, Polygon
from numpy.typing import NDArray
from PIL import Image

FloatArray = NDArray[np.float64]
ROOT = Path(__file__).resolve().parents[2]
DOCS = ROOT / "docs"
IMAGES = DOCS / "images"
WIDTH_IN = 7.2
BLUE, ORANGE, GREEN, RED, VIOLET, GREY = "#0b62a4", "#d9730d", "#2b8a3e", "#c92a2a", "#7048a8", "#6b7280"
DARK = "#222222"
PALE = {BLUE: "#e3eef7", ORANGE: "#fdeedd", GREEN: "#e4f3e7", RED: "#fbe5e5", GREY: "#eef0f2", VIOLET: "#efeaf6"}
RC = {
    "font.family": "DejaVu Sans",
    "font.size": 9.0,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.prop_cycle": mpl.cycler(color=[BLUE, ORANGE, GREEN, RED, VIOLET, GREY]),
    "axes.titlesize": 9.5,
    "axes.titleweight": "bold",
    "axes.titlelocation": "left",
    "legend.frameon": False,
    "lines.linewidth": 1.6,
}


def new_figure(height_in: float = 2.8, rows: int = 1, columns: int = 1, **arguments: Any) -> tuple[Figure, Any]:
    """Return a figure of the documents' width and its axes (one, or an array of rows × columns)."""
    figure = Figure(figsize=(WIDTH_IN, height_in), layout="constrained")
    return figure, figure.subplots(rows, columns, **arguments)


def blank(axes: Any, x: tuple[float, float], y: tuple[float, float], aspect: str = "equal") -> None:
    """Prepare axes without frame for a sketch; `aspect`: "auto" for different units of both directions."""
    axes.set(xlim=x, ylim=y, aspect=aspect)
    axes.axis("off")


def arrow(axes: Any, start: tuple[float, float], end: tuple[float, float], colour: str, style: str = "-|>") -> None:
    """Draw an arrow whose ends are exact."""
    axes.add_patch(FancyArrowPatch(start, end, arrowstyle=style, mutation_scale=11, color=colour, shrinkA=0, shrinkB=0))


def flow_box(axes: Any, corner: tuple[float, float], size: tuple[float, float], text: str, colour: str) -> None:
    """Draw a pale, rounded box of a flow chart with a text in its middle."""
    rounded = "round,pad=0,rounding_size=0.06"
    axes.add_patch(FancyBboxPatch(corner, *size, boxstyle=rounded, fc=PALE[colour], ec=colour, lw=1.1))
    middle = corner[0] + size[0] / 2, corner[1] + size[1] / 2
    axes.text(*middle, text, ha="center", va="center", fontsize=7.6, linespacing=1.25)


def flow_arrow(axes: Any, start: tuple[float, float], end: tuple[float, float], colour: str = GREY) -> None:
    """Draw an arrow between boxes of a flow chart."""
    arrowprops = {"arrowstyle": "-|>", "color": colour, "lw": 1.2, "shrinkA": 0, "shrinkB": 0}
    axes.annotate("", end, start, arrowprops=arrowprops)


def camera_shape(axes: Any, place: FloatArray, towards: FloatArray, size: float = 1.0) -> None:
    """Draw a camera from the side: its body and its lens, which looks towards a point."""
    along = (towards - place) / np.linalg.norm(towards - place)
    across = np.array([-along[1], along[0]])
    body = [place + size * (a * along + b * across) for a, b in ((-1.6, -0.7), (0, -0.7), (0, 0.7), (-1.6, 0.7))]
    lens = [place + size * (a * along + b * across) for a, b in ((0, -0.35), (0.6, -0.5), (0.6, 0.5), (0, 0.35))]
    for shape in (body, lens):
        axes.add_patch(Polygon(shape, facecolor="#dbe4ee", edgecolor=BLUE, linewidth=1.3))


def marked_table(page: str, name: str) -> list[list[str]]:
    """Return the cells of a table that a benchmark writes into a page, row by row without the head."""
    text = (DOCS / page).read_text(encoding="utf-8")
    (content,) = re.findall(f"<!-- {name} -->\n(.*?)<!-- end of {name} -->", text, re.DOTALL)
    lines = [line for line in content.splitlines() if line.startswith("|")][2:]
    return [[cell.strip() for cell in line.strip("|").split("|")] for line in lines]


def write_drawing(figure: Figure, name: str) -> Path:
    """Write a figure as an image of 64 colours, `docs/images/NAME.png`."""
    path = IMAGES / f"{name}.png"
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png", dpi=160)
    Image.open(buffer).convert("RGB").quantize(64, dither=Image.Dither.NONE).save(path, optimize=True)
    return path
