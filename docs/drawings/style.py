"""One look for the drawings of the documents, and where they are written."""

from __future__ import annotations

import io
from pathlib import Path
from typing import Any

import matplotlib as mpl
from matplotlib.figure import Figure
from PIL import Image

IMAGES = Path(__file__).resolve().parents[1] / "images"
WIDTH_IN = 7.2
BLUE, ORANGE, GREEN, RED, VIOLET, GREY = "#0b62a4", "#d9730d", "#2b8a3e", "#c92a2a", "#7048a8", "#6b7280"
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
    with mpl.rc_context(RC):
        figure = Figure(figsize=(WIDTH_IN, height_in), layout="constrained")
        return figure, figure.subplots(rows, columns, **arguments)


def write_drawing(figure: Figure, name: str) -> Path:
    """Write a figure as an image of 64 colours, `docs/images/NAME.png`."""
    path = IMAGES / f"{name}.png"
    buffer = io.BytesIO()
    with mpl.rc_context(RC):
        figure.savefig(buffer, format="png", dpi=160)
    Image.open(buffer).convert("RGB").quantize(64, dither=Image.Dither.NONE).save(path, optimize=True)
    return path
