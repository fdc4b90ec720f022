"""Drawings of files: the frames of a stereo pair and its pixels, and the response of a chain of elements."""

from __future__ import annotations

import re
import tempfile
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Polygon, Rectangle
from style import BLUE, DARK, DOCS, GREY, ORANGE, RED, blank, new_figure

from fusion.recording.response import read_response


def files_stereo() -> Figure:
    """Draw the frames of the two cameras of a pair, and the coordinates of a pixel."""
    figure, (above, pixels) = new_figure(2.9, 1, 2, width_ratios=(1.5, 1.0))
    blank(above, (-1.2, 4.6), (-1.1, 3.6))
    for x, name, colour in ((0.0, "left", BLUE), (3.0, "right", ORANGE)):
        above.add_patch(
            Polygon([(x - 0.28, -0.7), (x + 0.28, -0.7), (x + 0.28, 0.0), (x - 0.28, 0.0)], color="#59636e")
        )
        _arrow(above, (x, 0.0), (0.0, 1.3), f"z_{name}", colour)
        _arrow(above, (x, 0.0), (1.0, 0.0), f"x_{name}", colour)
    above.annotate("", (2.65, -0.35), (0.35, -0.35), arrowprops={"arrowstyle": "<|-", "color": GREY, "lw": 1.3})
    above.text(1.5, -0.8, "translation = [−b, 0, 0]", color=GREY, fontsize=8, ha="center")
    above.plot([0.0, 1.6, 3.0], [0.0, 3.0, 0.0], color=GREY, lw=0.7, ls="--")
    above.plot([1.6], [3.0], "o", color=RED, ms=5)
    above.text(
        1.75,
        3.05,
        "point: x_right = rotation · x_left + translation",
        color=RED,
        fontsize=7.5,
        va="bottom",
        ha="center",
    )
    above.set_title("The pair from above, y down")
    blank(pixels, (-0.9, 4.6), (3.7, -1.1))
    for row in range(4):
        for column in range(5):
            pixels.add_patch(Rectangle((column - 0.5, row - 0.5), 1.0, 1.0, fc="white", ec=GREY, lw=0.8))
    pixels.plot([0], [0], "o", color=BLUE, ms=5)
    pixels.text(0.0, 0.33, "(0, 0)", color=BLUE, fontsize=7.5, ha="center")
    pixels.plot([2.5], [1.5], "o", color=RED, ms=5)
    pixels.text(2.6, 1.33, "(2.5, 1.5)", color=RED, fontsize=7.5)
    pixels.annotate("", (1.6, -0.8), (-0.5, -0.8), arrowprops={"arrowstyle": "-|>", "color": DARK})
    pixels.text(1.75, -0.8, "x", style="italic", va="center")
    pixels.annotate("", (-0.75, 1.6), (-0.75, -0.5), arrowprops={"arrowstyle": "-|>", "color": DARK})
    pixels.text(-0.75, 1.95, "y", style="italic", ha="center")
    pixels.set_title("An integer is the middle of a pixel")
    return figure


def files_response() -> Figure:
    """Draw the response of the chain of docs/files.md, with U."""
    text = (DOCS / "files.md").read_text(encoding="utf-8")
    (chain,) = (
        part for part in re.findall(r"^```toml\n(.*?)^```", text, re.DOTALL | re.MULTILINE) if "[[element]]" in part
    )
    hertz = np.geomspace(0.3, 20e3, 400)
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "chain.toml"
        path.write_text(chain, encoding="utf-8")
        value = read_response(path, hertz).value
    figure, (size, phase) = new_figure(3.2, 2, 1, sharex=True)
    size.loglog(hertz, np.abs(value), color=BLUE)
    phase.semilogx(hertz, np.degrees(np.unwrap(np.angle(value))), color=BLUE)
    for axes in (size, phase):
        axes.grid(alpha=0.25, which="major")
        for corner, name in ((1.0, "charge amplifier, 1 Hz"), (10e3, "filter, 10 kHz")):
            axes.axvline(corner, color=GREY, lw=0.8, ls=":")
            if axes is size:
                axes.text(
                    corner * (1.08 if corner < 10 else 0.93),
                    0.42,
                    name,
                    color=GREY,
                    fontsize=8,
                    ha="left" if corner < 10 else "right",
                )
    size.set(ylabel="|H|", ylim=(0.1, 2.0), yticks=[0.1, 0.2, 0.5, 1, 2])
    size.set_yticklabels(["0.1", "0.2", "0.5", "1", "2"])
    size.minorticks_off()
    phase.set(ylabel="phase / °", xlabel="frequency / Hz", xlim=(0.3, 20e3))
    size.set_title("Response of the example: charge amplifier, anti-alias filter, mounted accelerometer")
    return figure


def _arrow(axes: Axes, origin: tuple[float, float], way: tuple[float, float], name: str, colour: str) -> None:
    tip = np.add(origin, way)
    axes.annotate("", tip, origin, arrowprops={"arrowstyle": "-|>", "color": colour, "lw": 1.5})
    axes.text(
        *np.add(origin, np.asarray(way) * (1.18 if way[1] else 1.42)),
        name,
        color=colour,
        fontsize=8,
        ha="center",
        va="center",
    )


DRAWINGS = (files_stereo, files_response)
