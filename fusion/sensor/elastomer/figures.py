"""Figures of an elastic element: mode shapes in space, models against one another, the resonance under a hand."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from matplotlib import colormaps
from matplotlib.figure import Figure

from fusion.report.style import (
    BLACK,
    BLUE,
    COLOURS,
    GREY,
    RED,
    Picture,
    as_file,
    drawing,
    finish,
    new_figure,
    panel_label,
    sheet,
)
from fusion.sensor.elastomer.evaluate import ElementEvaluation, Shape
from shaker.elastomer.frame import NAMES

ENLARGED = 0.08
"""Largest displacement drawn, over the size of the element."""
VIEW = {"elev": 26.0, "azim": -58.0}
METHOD_COLOURS = (BLACK, *COLOURS, GREY)
MARKERS = ("o", "s", "D", "^", "v", "P", "X", "*")


def draw_shapes(name: str, title: str, shapes: Sequence[Shape]) -> tuple[Picture, bytes]:
    """Six modes in space, at rest as lines and deformed as faces coloured by displacement; picture and png file."""
    with drawing(name):
        figure = new_figure(4.6)
        for place, shape in enumerate(shapes):
            _panel(figure, place, shape)
        figure.subplots_adjust(left=0.0, right=1.0, bottom=0.0, top=0.96, wspace=0.0, hspace=0.06)
        caption = (
            "Grey lines: at rest. Colour: displacement, from none (dark) to the largest (bright); the same largest "
            "displacement is drawn in every panel, far larger than any real one."
        )
        return finish(figure, name, title, caption), as_file(figure, "png")


def draw_compared(evaluation: ElementEvaluation) -> Picture:
    """Every column's frequencies as departure from those of the frame."""
    columns = evaluation.columns
    frame = next(column for column in columns if column.kind == "frame")
    places, width = np.arange(len(NAMES)), 0.7 / len(columns)
    with sheet("elastomer-comparison", 3.0) as drawn:
        (axes,) = drawn.panels
        for c, column in enumerate(columns):
            departure = 100.0 * (column.frequency_hz / frame.frequency_hz - 1.0)
            expanded = np.nan_to_num(200.0 * column.u_hz / frame.frequency_hz)
            look: dict[str, Any] = {"fmt": MARKERS[c % len(MARKERS)], "color": METHOD_COLOURS[c % len(METHOD_COLOURS)]}
            known, shift = np.isfinite(departure), (c - 0.5 * (len(columns) - 1)) * width
            if known.any():
                axes.errorbar(places[known] + shift, departure[known], expanded[known], label=column.name, **look)
        axes.axhline(0.0, color=GREY, linewidth=0.8, zorder=1)
        axes.set_xticks(places, NAMES)
        axes.set_xlim(-0.5, len(places) - 0.5)
        axes.set_ylabel(f"less {frame.name} / %")
        panel_label(axes, "natural frequencies")
        axes.legend(loc="lower right", ncols=4, bbox_to_anchor=(1.0, 1.0), borderaxespad=0.0)
        caption = "Departure of every column from the frame. Bars: expanded uncertainty U (k = 2) where there is one."
        return drawn.picture("Models against one another", caption, top=0.5, bottom=0.3)


def draw_hand(evaluation: ElementEvaluation) -> Picture | None:
    """The resonance over the mass of a hand joined without a spring, and the modes of the chain with springs."""
    mounted, stated = evaluation.mounted, evaluation.definition.file.mounting
    if mounted is None or stated is None:
        return None
    scale, unit = (1e3, "g") if mounted.direction.startswith("T") else (1e6, "kg·mm²")
    with sheet("elastomer-mounted", 2.8) as drawn:
        (axes,) = drawn.panels
        label = "hand joined without a spring (eq. 17)"
        axes.plot(scale * mounted.hand_mass, mounted.mounted_hz, color=BLUE, label=label)
        places = np.full(len(mounted.frequency_hz), scale * stated.hand_mass)
        axes.plot(places, mounted.frequency_hz, "o", color=RED, label="hand, sensor and pedestal on springs")
        axes.set_ylim(0.0, 1.1 * max(float(mounted.frequency_hz.max()), float(mounted.mounted_hz.max())))
        axes.set_xlabel(f"{'mass' if unit == 'g' else 'moment of inertia'} of the hand / {unit}")
        axes.set_ylabel("natural frequency / Hz")
        panel_label(axes, f"mounted sensor, {mounted.direction}")
        axes.legend(loc="lower right", ncols=2, bbox_to_anchor=(1.0, 1.0), borderaxespad=0.0)
        caption = "What a hand or gripper leaves of the element's own frequency."
        return drawn.picture(f"Resonance of the mounted sensor, {mounted.direction}", caption, top=0.3)


def _panel(figure: Figure, place: int, shape: Shape) -> None:
    """One mode."""
    from mpl_toolkits.mplot3d.art3d import Line3DCollection, Poly3DCollection

    axes: Any = figure.add_subplot(2, 3, place + 1, projection="3d", computed_zorder=False)
    size = np.linalg.norm(shape.motion, axis=2)
    largest = float(size.max()) or 1.0
    extent = float(np.ptp(shape.rest_m[..., 0]))
    moved = 1e3 * (shape.rest_m + shape.motion * (ENLARGED * extent / largest))
    rest = 1e3 * np.concatenate([shape.rest_m, shape.rest_m[:, :1]], axis=1)
    faces = Poly3DCollection(moved, facecolors=colormaps["viridis"](size.mean(axis=1) / largest), zorder=2)
    faces.set_edgecolor((0.0, 0.0, 0.0, 0.25))
    faces.set_linewidth(0.25)
    lines = Line3DCollection(rest, colors=GREY, linewidths=0.3, alpha=0.5, zorder=1)
    for drawn in (lines, faces):
        drawn.set_rasterized(True)
        drawn.set_clip_on(False)
        axes.add_collection3d(drawn)
    half = 0.5e3 * extent
    axes.set(xlim=(-half, half), ylim=(-half, half), zlim=(-0.35 * half, 0.35 * half))
    axes.set_box_aspect((1.0, 1.0, 0.35), zoom=1.45)
    axes.view_init(**VIEW)
    axes.set_axis_off()
    foot = half * np.array([0.80, -1.12, 0.0])
    for along, label in zip(0.2 * half * np.eye(3), "xyz", strict=True):
        axes.plot(*np.stack([foot, foot + along], axis=1), color=BLACK, linewidth=0.8, clip_on=False)
        axes.text(*(foot + 1.3 * along), label, fontsize=7.0, ha="center", va="center")
    told = f"{shape.name}   {shape.frequency_hz:.0f} Hz"
    axes.set_title(told, fontsize=8.5, fontweight="bold", pad=-6.0, loc="center")
